"""The ground plane: a homography between pixels of the image and metres on the ground. Letters: N boxes or points."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from mcaptrack.choices import Point
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY, compose, invert
from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.pinhole import Lens
from mcaptrack.geometry.ragged import run_starts

__all__ = [
    "PERSON_HEIGHT_M", "GroundPlane", "Planes", "is_assumed", "is_estimated", "moved_planes", "origin_of",
    "plane_at", "runs_of_planes", "scene_planes",
]  # fmt: skip

#: The height of a person, for guessing the scale of a scene from its boxes.
PERSON_HEIGHT_M = 1.7


@dataclass(frozen=True)
class GroundPlane:
    """A homography from pixels to metres, and which point of a box touches the ground.

    ``homography`` is row by row, 9 numbers: (x_m, y_m, 1) ~ H (x_px, y_px, 1). ``point`` is "foot", the middle of the
    box's lower edge, or "center". ``assumed`` says that it was not measured but derived from the size of people in the
    picture: a scale alone, or a plane that was estimated. With a ``lens``, pixels are those that it makes, and the
    homography is for pixels without its distortion, with a third component that is positive on the ground. Raises
    McaptrackError if the homography is not 9 finite numbers or is singular.

    ``width_px`` and ``height_px`` are the size of the pictures, None if it isn't known.
    """

    homography: tuple[float, ...]
    width_px: int
    height_px: int
    point: Point = "foot"
    assumed: bool = False
    lens: Lens | None = None

    def __post_init__(self) -> None:
        values = np.asarray(self.homography, np.float64)
        if values.shape != (9,) or not np.isfinite(values).all():
            raise McaptrackError(f"a homography is 9 finite numbers, 3 rows of 3; got {len(self.homography)}")
        if self.point not in get_args(Point):
            raise McaptrackError(
                f"a box touches the ground at its {' or '.join(get_args(Point))}, not at its {self.point}"
            )
        if not any(self._spreads(u, v) for u in (0.0, 0.5, 1.0) for v in (1.0, 0.5, 0.0)):
            raise McaptrackError("the homography is singular: it maps the image onto a line or a point, not a plane")

    def _spreads(self, u: float, v: float) -> bool:
        """Whether the neighbourhood of a point, given as shares of the image's size, is mapped onto an area.

        Decided by the derivative, so that neither the scale nor the origin of the metres matters.
        """
        x, y, w = self.matrix @ [u * self.width_px, v * self.height_px, 1.0]
        derivative = self.matrix[:2, :2] * w - np.outer([x, y], self.matrix[2, :2])
        size = float((derivative**2).sum())
        return size > 0 and abs(float(np.linalg.det(derivative))) > 1e-9 * size

    @property
    def is_estimated(self) -> bool:
        """Whether the plane was estimated from boxes, with its perspective, and is more than a guessed scale."""
        return self.assumed and any(self.homography[6:8])

    @cached_property
    def matrix(self) -> Floats:
        """The homography, (3, 3)."""
        return np.asarray(self.homography, np.float64).reshape(3, 3)

    @cached_property
    def _near_side(self) -> float:
        """The sign of the third component on the ground: at the middle of the image's lower edge."""
        if self.lens is not None:
            return 1.0
        return float(np.sign(self.matrix[2] @ [self.width_px / 2, self.height_px, 1.0])) or 1.0

    def pixels_to_metres(self, xy_px: Floats) -> Floats:
        """Points (N, 2) of the image -> points on the ground (N, 2); NaN above the horizon."""
        straight = xy_px if self.lens is None else self.lens.undistort(xy_px)
        x, y, w = self.matrix @ np.concatenate([straight, np.ones((len(xy_px), 1))], axis=1).T
        w = np.where(w * self._near_side > 0, w, np.nan)
        return np.stack([x / w, y / w], axis=-1)

    def metres_to_pixels(self, xy_m: Floats) -> Floats:
        """Points (N, 2) on the ground -> points of the image (N, 2); NaN behind the camera."""
        x, y, w = np.linalg.inv(self.matrix) @ np.concatenate([xy_m, np.ones((len(xy_m), 1))], axis=1).T
        w = np.where(w * self._near_side > 0, w, np.nan)
        straight = np.stack([x / w, y / w], axis=-1)
        return straight if self.lens is None else self.lens.distort(straight)

    def after(self, motion: Floats) -> GroundPlane:
        """Return the plane for pixels that ``motion`` (2, 3) moves to those that this one takes."""
        if self.lens is not None:
            return replace(self, lens=self.lens.after(motion))
        homography = self.matrix @ np.vstack([motion, [0.0, 0.0, 1.0]])
        return replace(self, homography=tuple(homography.ravel().tolist()))

    def boxes_to_metres(self, xywh: Floats) -> Floats:
        """Boxes (N, 4) -> the points (N, 2) where they touch the ground."""
        return self.pixels_to_metres(self.feet(xywh))

    def feet(self, xywh: Floats) -> Floats:
        """Boxes (N, 4) -> the points (N, 2) of the image that touch the ground."""
        x, y, w, h = xywh.T
        return np.stack([x + w / 2, y + h * self._anchor], axis=-1)

    def standing_boxes(self, xy_m: Floats, size_px: Floats) -> Floats:
        """Boxes (N, 4) of the given widths and heights (N, 2) that touch the ground at points (N, 2)."""
        anchor = self.metres_to_pixels(xy_m)
        return np.concatenate([anchor - size_px * [0.5, self._anchor], size_px], axis=1)

    @property
    def _anchor(self) -> float:
        return 1.0 if self.point == "foot" else 0.5


#: The planes of one camera with the times (ns) from which each is valid; the first is valid from the beginning.
Planes = Sequence[tuple[int, GroundPlane]]


def plane_at(planes: Planes, t_ns: int) -> GroundPlane | None:
    """The plane that is valid at ``t_ns``; None if there is no plane."""
    if not planes:
        return None
    return planes[max(bisect_right(planes, t_ns, key=lambda entry: entry[0]) - 1, 0)][1]


def runs_of_planes(planes: Planes, times: Sequence[int]) -> list[tuple[int, int]]:
    """The first of each run of rising times (F,) with one plane, and the one after its last."""
    valid = np.array([id(plane_at(planes, t_ns)) for t_ns in times])
    first = np.flatnonzero(run_starts(valid)).tolist()
    return list(zip(first, [*first[1:], len(times)], strict=True))


def moved_planes(planes: Planes, path: CameraPath | None) -> Planes:
    """The planes of a camera that moves: one for each picture at which it has another pose.

    A plane that was measured, or guessed, in one picture is carried on from there by the motion of the camera, until
    the next one or another scene begins; there it holds as it is. Without a path the planes stay as they are.
    """
    if path is None or not planes:
        return planes
    out: list[tuple[int, GroundPlane]] = []
    for number, (since_ns, plane) in enumerate(planes):
        until_ns = planes[number + 1][0] if number + 1 < len(planes) else None
        begun = path.pose_at(since_ns) if number else None
        out.append((since_ns, plane))
        for t_ns, pose in path.poses_between(since_ns if number else None, until_ns):
            back = IDENTITY if begun is None or begun.reference != pose.reference else invert(begun.to_reference)
            motion = IDENTITY if pose is begun else compose(back, pose.to_reference)
            moved = plane if motion is IDENTITY else plane.after(motion)
            if out[-1][1] != moved:
                out.append((t_ns, moved))
    return out


def scene_planes(planes: Planes, path: CameraPath | None) -> Planes:
    """The planes of a camera that moves in the pixels of its reference pictures, where they stay as they are.

    Without a path they are those of all pictures.
    """
    if path is None:
        return planes
    out = list(planes[:1])
    for number, (since_ns, plane) in enumerate(planes[1:], start=1):
        until_ns = planes[number + 1][0] if number + 1 < len(planes) else None
        begun = path.pose_at(since_ns)
        first = [(since_ns, begun)] if begun else []
        for t_ns, pose in [*first, *path.poses_between(since_ns, until_ns)]:
            is_there = begun is not None and begun.reference == pose.reference
            back = invert(begun.to_reference) if begun is not None and is_there else IDENTITY
            moved = plane if back is IDENTITY else plane.after(back)
            if out[-1][1] != moved:
                out.append((t_ns, moved))
    return out


def is_assumed(planes: Planes | None) -> bool:
    """Whether there are planes and none of them was measured: all are guessed or estimated."""
    return planes is not None and len(planes) > 0 and all(plane.assumed for _, plane in planes)


def is_estimated(planes: Planes | None) -> bool:
    """Whether there are planes and all of them were estimated from boxes."""
    return planes is not None and len(planes) > 0 and all(plane.is_estimated for _, plane in planes)


def origin_of(planes: Planes) -> Literal["given", "estimated", "assumed"]:
    """Where the planes of a camera are from: measured, estimated from boxes, or a scale that was assumed."""
    if not is_assumed(planes):
        return "given"
    return "estimated" if is_estimated(planes) else "assumed"


#: If the ground is less deep in the picture than this, one scale can't be right for all of it (see ``ground_depth``).
LEAST_DEPTH = 1.8


def ground_depth(xywh: Floats) -> float:
    """The vertical extent of the ground below boxes (N, 4), in heights of a tall person; NaN without boxes.

    From the 5 % to the 95 % quantile of the lower edges, divided by the 95 % quantile of the heights. It is small for a
    camera that looks along the ground: people near and far then differ in size, but touch the ground at the same place
    in the picture. In synthetic scenes with cameras of all heights and tilts, re-tracking on a guessed scale made IDF1
    worse in most scenes below 1.8 and better in nearly all above.
    """
    if len(xywh) == 0:
        return float("nan")
    low, high = np.quantile(xywh[:, 1] + xywh[:, 3], [0.05, 0.95])
    return float((high - low) / np.quantile(xywh[:, 3], 0.95))


def assumed_plane(heights_px: Floats, width_px: int, height_px: int, person_m: float = PERSON_HEIGHT_M) -> GroundPlane:
    """A plane for a scene without calibration: the image itself, scaled so that the median box is ``person_m`` high.

    The origin is the middle of the image and the second axis points up. Distances are right only for a camera that
    looks straight down or from far away; the plane is marked as ``assumed``. Raises McaptrackError if there is no
    positive height among ``heights_px`` (N,).
    """
    heights = heights_px[np.isfinite(heights_px) & (heights_px > 0)]
    if len(heights) == 0:
        raise McaptrackError("there are no boxes to guess a scale from; give a ground plane")
    scale = person_m / float(np.median(heights))
    homography = (scale, 0.0, -scale * width_px / 2, 0.0, -scale, scale * height_px / 2, 0.0, 0.0, 1.0)
    return GroundPlane(homography, width_px, height_px, assumed=True)
