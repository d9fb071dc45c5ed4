"""Cameras with known intrinsics: points of the world to pixels, lens distortion, and the ground as a camera sees it.

Conventions are those of OpenCV and ROS: the camera looks along its third axis, the first points right and the second
down; pixels are counted from the centre of the first one. Letters: N points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.affine import IDENTITY, compose, invert, move_points
from mcaptrack.geometry.arrays import Bools, Floats

#: Numbers of coefficients of OpenCV's models: none, plumb_bob, rational_polynomial; and of fisheye (equidistant).
_COEFFICIENTS: Final = (0, 4, 5, 8)
_FISHEYE_COEFFICIENTS: Final = 4
#: A point is beyond the edge of the lens if undistorting and distorting it moves it by more than this.
_LOST_PX: Final = 0.5
_ITERATIONS: Final = 50


@dataclass(frozen=True)
class Lens:
    """The intrinsics of a camera.

    ``focal_px`` and ``centre_px`` along both axes; ``distortion`` k1, k2, p1, p2, k3, k4, k5, k6, of which the first 0,
    4, 5 or 8 are given, or for a fisheye lens (equidistant) k1 to k4. ``motion`` (2x3, row by row) moves pixels to
    those of the picture that the lens made, where they are of another one; () for none. Raises McaptrackError for
    numbers that aren't finite, or of another count.
    """

    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    distortion: tuple[float, ...] = ()
    is_fisheye: bool = False
    motion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        numbers = (*self.focal_px, *self.centre_px, *self.distortion)
        if not np.isfinite(numbers).all() or min(self.focal_px) <= 0:
            raise McaptrackError(f"a camera can't have the focal lengths {self.focal_px} and centre {self.centre_px}")
        counts = (_FISHEYE_COEFFICIENTS,) if self.is_fisheye else _COEFFICIENTS
        if len(self.distortion) not in counts:
            allowed = " or ".join(map(str, counts))
            raise McaptrackError(f"a lens has {allowed} coefficients of distortion, not {len(self.distortion)}")

    @cached_property
    def matrix(self) -> Floats:
        """The camera matrix, (3, 3)."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    @property
    def _motion(self) -> Floats:
        return np.reshape(self.motion, (2, 3)) if self.motion else IDENTITY

    def after(self, motion: Floats) -> Lens:
        """Return the lens for pixels that ``motion`` (2, 3) moves to those that this one takes."""
        return replace(self, motion=tuple(compose(self._motion, motion).ravel().tolist()))

    def scaled(self, across: float, down: float) -> Lens:
        """Return the lens for pictures with another number of pixels."""
        (fx, fy), (cx, cy) = self.focal_px, self.centre_px
        centre = ((cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5)
        return replace(self, focal_px=(fx * across, fy * down), centre_px=centre)

    def undistort(self, xy_px: Floats) -> Floats:
        """Pixels (N, 2) -> pixels (N, 2) of a lens without distortion; NaN where there is no such pixel."""
        moved = move_points(self._motion, xy_px) if self.motion else xy_px
        if not any(self.distortion):
            return moved
        straight = self._undistort(moved)
        back = self._distort(straight)
        return np.where(np.abs(back - moved).max(axis=1, keepdims=True) < _LOST_PX, straight, np.nan)

    def distort(self, xy_px: Floats) -> Floats:
        """Pixels (N, 2) of a lens without distortion -> pixels (N, 2); NaN for points beyond the edge of the lens."""
        moved = xy_px
        if any(self.distortion):
            moved = self._distort(xy_px)
            back = self._undistort(moved)
            # Far outside, polynomials fold back into the picture.
            limit = _LOST_PX + 1e-3 * np.abs(xy_px - self.centre_px).max(axis=1, keepdims=True)
            moved = np.where(np.abs(back - xy_px).max(axis=1, keepdims=True) < limit, moved, np.nan)
        return move_points(invert(self._motion), moved) if self.motion else moved

    def _distort(self, xy_px: Floats) -> Floats:
        x, y = ((xy_px - self.centre_px) / self.focal_px).T
        with np.errstate(all="ignore"):
            r2 = x * x + y * y
            if self.is_fisheye:
                r = np.sqrt(r2)
                angle = np.arctan(r)
                a2 = angle * angle
                k1, k2, k3, k4 = self.distortion
                bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
                scale = np.where(r > 0, bent / np.where(r > 0, r, 1.0), 1.0)
                out = np.stack([x * scale, y * scale], axis=-1)
            else:
                k1, k2, p1, p2, k3, k4, k5, k6 = (*self.distortion, *[0.0] * (8 - len(self.distortion)))
                scale = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
                across = x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
                down = y * scale + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
                out = np.stack([across, down], axis=-1)
        bent_px: Floats = out * self.focal_px + self.centre_px
        return bent_px

    def _undistort(self, xy_px: Floats) -> Floats:
        import cv2

        is_finite = np.isfinite(xy_px).all(axis=1)
        out = np.full(xy_px.shape, np.nan)
        if not is_finite.any():
            return out
        points = np.ascontiguousarray(xy_px[is_finite], np.float64)[:, None]
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, _ITERATIONS, 1e-12)
        undistorted = cv2.fisheye.undistortPoints if self.is_fisheye else cv2.undistortPoints
        distortion, same = np.array(self.distortion), np.eye(3)
        straight = undistorted(points, self.matrix, distortion, R=same, P=self.matrix, criteria=stop)
        out[is_finite] = straight[:, 0]
        return out


def project(points: Floats, lens: Lens, rotation: Floats, translation: Floats) -> tuple[Floats, Bools]:
    """Return where points (N, 3) are in the picture (N, 2), and which are in front of the camera (N,).

    ``rotation`` (3, 3) and ``translation`` (3,) map points to the frame of the camera, as ``TransformTree.lookup`` of
    the camera's frame as target gives them. Points behind it, and beyond the edge of the lens, are NaN.
    """
    x, y, z = (points @ rotation.T + translation).T
    with np.errstate(invalid="ignore"):
        in_front: Bools = z > 0
    depth = np.where(in_front, z, np.nan)
    straight = np.stack([x / depth, y / depth], axis=-1) * lens.focal_px + lens.centre_px
    return lens.distort(straight), in_front


def ground_homography(lens: Lens, rotation: Floats, translation: Floats, ground: Floats) -> tuple[float, ...]:
    """Return the homography (9 numbers) from pixels without distortion to metres on the plane z = 0 of a ground frame.

    ``rotation`` (3, 3) and ``translation`` (3,) map points of the ground frame to the camera's; ``ground`` (3, 3) maps
    (x, y, 1) on the plane to metres. The third component is positive for points in front of the camera. Raises
    McaptrackError if the camera isn't above the plane.
    """
    height_m = float(-(rotation.T @ translation)[2])
    if not height_m > 0:
        raise McaptrackError(f"the camera is {-height_m:.2f} m below the ground")
    seen = lens.matrix @ np.column_stack([rotation[:, 0], rotation[:, 1], translation])
    return tuple((ground @ np.linalg.inv(seen)).ravel().tolist())
