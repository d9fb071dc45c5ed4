"""Read published motions of cameras: a 2x3 transform per frame, from pixels of the frame before. Letters: F frames."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY, compose, scale_of
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.camera_path import Verdict, poses_of
from mcaptrack.schema import Frame
from mcaptrack.schema.camera_motion import is_motion, pose_to_rows
from mcaptrack.sources.ingest.labels.number_table import NumberTable, lines_of

_COLUMNS: Final = 7
#: The largest zoom from one frame to the next.
_MOST_ZOOM: Final = 4.0
_KIND: Final = "a camera motion (frame,m00,m01,m02,m10,m11,m12: 7 columns)"


def read_motions(path: Path) -> Floats:
    """Read the motions (F, 2, 3) of frames 0 to F - 1 from a text file.

    Raises McaptrackError, with the line, for anything else.
    """
    table = NumberTable(path, lines_of(path), _KIND, _COLUMNS, _parse)
    if not len(table.values):
        raise McaptrackError(f"{path} holds no camera motion")
    frame, motions = table.values[:, 0], table.values[:, 1:].reshape(-1, 2, 3)
    table.refuse(
        frame != np.arange(len(frame)),
        lambda row: f"frame {frame[row]:g} is not {row}: frames count from 0, without gaps",
    )
    wrong = np.array([not is_motion(motion) for motion in motions])
    table.refuse(wrong, lambda row: "the motion is not finite, or can't be inverted")
    scale = np.array([scale_of(motion) for motion in motions])
    table.refuse(
        (scale > _MOST_ZOOM) | (scale < 1 / _MOST_ZOOM),
        lambda row: f"the motion enlarges the picture {scale[row]:.3g} times; no camera does that in a frame",
    )
    return motions


def _parse(parts: list[str]) -> list[float]:
    if len(parts) != _COLUMNS:
        raise ValueError(f"{len(parts)} columns")
    return [float(part) for part in parts]


def motion_frames(motions: Floats, index: Ints, t_ns: Ints, size: tuple[int, int]) -> list[Frame]:
    """The motions (F, 2, 3) of a file as frames of pictures ``index`` (P,) at ``t_ns`` (P,), of this width and height.

    The motion of a picture that follows on missing ones is that of all of them together. Pictures beyond the last
    motion are lost.
    """
    kept: list[Floats] = []
    last = -1
    for number in index.tolist():
        motion = IDENTITY
        for at in range(last + 1, min(number + 1, len(motions))):
            motion = compose(motions[at], motion) if at else IDENTITY
        kept.append(motion)
        last = number
    poses = poses_of(np.array(kept), *size)
    frames = []
    for pose, number, t in zip(poses, index.tolist(), t_ns.tolist(), strict=True):
        known = pose if number < len(motions) else pose._replace(verdict=Verdict.LOST)
        reference = known._replace(reference=int(index[known.reference]))
        frames.append(Frame(t, number, pose_to_rows(reference, *size)))
    return frames
