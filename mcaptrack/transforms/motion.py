"""Pictures -> camera motion: how pixels of a scene at rest go from one picture to the next."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Final

from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.camera_path import MotionEstimator, SecondMotion, Verdict
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.schema import CAMERA_MOTION, VIDEO, Frame, Schema
from mcaptrack.schema.as_rows import pose_to_rows
from mcaptrack.transforms.protocol import context, option, parameters

#: Warn from this share of lost pictures on.
_LEAST_LOST: Final = 0.02
#: Warn of a part that moves otherwise than the scene from this share, and this number, of compared pictures on.
_LEAST_DIVIDED, _LEAST_EXAMINED = 0.4, 4


@dataclass(frozen=True, kw_only=True)
@parameters
class EstimateMotion:
    """Estimate how the camera moves, from picture to picture.

    Reads video, writes camera motion: one row per picture, with the transform from the picture before, the one to a
    reference picture, and whether the camera is still, shaking or moving. Trackers move their predictions by it.

    Parameters
    ----------
    mask_boxes : bool
        Look for features outside of detected boxes, because people move by themselves.

    Examples
    --------
    A camera that pans by 3 pixels per picture to the right, so that the scene moves to the left:

    >>> import numpy as np
    >>> from mcaptrack.schema import Frame
    >>> blocks = np.random.default_rng(0).integers(0, 255, (30, 60))
    >>> scene = np.kron(blocks, np.ones((8, 8))).astype(np.uint8)
    >>> pictures = [Frame(t * 40_000_000, t, scene[:, 3 * t : 3 * t + 320]) for t in range(4)]
    >>> [round(float(motion.rows["m02_px"][0])) for (motion,) in EstimateMotion()(pictures)]
    [0, -3, -3, -3]
    """

    mask_boxes: bool = option(True)
    known_boxes: Mapping[int, Floats] = context(dict, is_recorded=False)

    reads: ClassVar[Schema] = VIDEO
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": CAMERA_MOTION})
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": 0.0})

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        camera, boxes = MotionEstimator(), self.known_boxes if self.mask_boxes else {}
        second = SecondMotion()
        times: list[int] = []
        cuts: list[int] = []
        lost = 0
        for frame in frames:
            pose = camera.step(frame.rows, boxes.get(frame.t_ns))
            second.step(frame.rows, pose, boxes.get(frame.t_ns))
            times.append(frame.t_ns)
            cuts += [frame.t_ns] if pose.verdict is Verdict.CUT else []
            lost += pose.verdict is Verdict.LOST
            height, width = frame.rows.shape
            yield (Frame(frame.t_ns, frame.index, pose_to_rows(pose, width, height)),)
        if cuts:
            at = (cuts[0] - times[0]) / NS_PER_S
            many = f"{len(cuts)} cuts, the first" if len(cuts) > 1 else "a cut"
            warn(f"there is {many} at {at:.1f} s: another scene begins there, and tracks end", "view-lost")
        if times and lost >= _LEAST_LOST * len(times):
            share = lost / len(times)
            warn(
                f"the motion of the camera is not known in {share:.0%} of the pictures; it is taken as none",
                "view-lost",
            )

        if second.examined >= _LEAST_EXAMINED and second.divided >= _LEAST_DIVIDED * second.examined:
            warn(
                f"in {second.divided / second.examined:.0%} of the pictures one part moves as a whole, and another one "
                "otherwise or not at all, such as a vehicle that the camera is in: the motion may be of either",
                "camera-moves",
            )

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why no rows came of frames, for a warning."""
        return "it has no pictures that can be decoded"
