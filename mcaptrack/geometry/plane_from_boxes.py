"""Estimate the ground plane of a camera from boxes of people who stand on it.

A person near the camera is taller in the picture than one far away, and touches the ground lower in it. With a pinhole
camera this fixes the horizon and how high the camera stands, in heights of a person; how tall people are gives the
scale. See D. Hoiem et al., "Putting objects in perspective", IJCV 2008, and F. Lv et al., "Camera calibration from
video of a walking human", PAMI 2006. The focal length shows only in how heights deviate from a straight line, so that
usual cameras are expected. What the boxes can't tell is derived from the fit; where it is too much, there is no plane.

Letters: N boxes, M of them that are fitted, P parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Bools, Floats, Indices, Ints
from mcaptrack.geometry.neighbours import touching_pairs
from mcaptrack.geometry.plane import PERSON_HEIGHT_M, GroundPlane

# Boxes that count: whole people, away from the borders of the picture (a share of its size, and pixels), not hidden by
# boxes in front of them (share of their area), upright (width by height), with good scores among those of the log.
_BORDER, _BORDER_PX = 0.005, 2.0
_MOST_HIDDEN: Final = 0.1
_RATIOS: Final = (0.15, 0.85)
_LEAST_OF_SCORES: Final = 0.6
_LEAST_BOXES, _MOST_BOXES = 120, 3000
_LEAST_UPRIGHT: Final = 0.4  # share of all boxes
# The search begins with some of the boxes.
_FIRST_BOXES: Final = 500
# The feet are divided into rows and columns. Each cell weighs as much as so many boxes at most: boxes of one place are
# not independent, and a place where people stand must not outweigh the others.
_ROWS, _COLUMNS = 12, 3
_BOXES_A_CELL: Final = 15.0
#: Heights of boxes differ by this much (relative standard deviation): people and detectors do.
_SPREAD: Final = 0.1
# What is expected of cameras: focal length in widths of the picture, its standard deviation as a logarithm, and that
# of the roll.
_FOCAL, _FOCAL_SPREAD = 1.0, 0.35
_ROLL_SPREAD: Final = float(np.deg2rad(3.0))
#: How far people extend along the ground, in their heights: a box ends at the nearest foot and the back of the head.
_GIRTH: Final = 0.15
#: Pitches (degrees) that the search begins with.
_STARTS: Final = (3.0, 12.0, 25.0, 40.0, 60.0)
_MOST_STEPS: Final = 100
# People with a hidden lower part, or who sit, have boxes that are too short: after a first fit, boxes further than
# so many standard deviations below or above are left out, twice. People differ by more than the least one.
_BELOW, _ABOVE, _ROUNDS = 2.0, 2.5, 2
_LEAST_SPREAD: Final = 0.03
# What is refused: fewer boxes that agree than this share, a typical deviation of more, people who are about as tall in
# the picture wherever they stand (ratio), a steeper camera (degrees), or metres that are less certain (relative
# standard deviation).
_LEAST_INLIERS, _MOST_RESIDUAL, _LEAST_GROWTH, _STEEPEST = 0.6, 0.12, 1.25, 65.0
_MOST_SCALE_SD, _MOST_DEPTH_SD = 0.05, 0.5


class FittedCamera(NamedTuple):
    """A pinhole camera above the ground.

    Attributes
    ----------
    focal_px : float
        The focal length in pixels.
    pitch_rad, roll_rad : float
        How far it looks down, and how far it is turned about its axis.
    height : float
        Its height above the ground, in heights of a person.

    """

    focal_px: float
    pitch_rad: float
    roll_rad: float
    height: float

    def axes(self) -> Floats:
        """To the right, away from the camera, and down, in its own axes: (3, 3), one a row."""
        turn = np.array([np.sin(self.roll_rad), np.cos(self.roll_rad)])  # where down is in the picture
        down = np.array([*(np.cos(self.pitch_rad) * turn), np.sin(self.pitch_rad)])
        away = np.array([*(-np.sin(self.pitch_rad) * turn), np.cos(self.pitch_rad)])
        return np.stack([np.cross(down, away), away, down])

    def expected_heights(self, feet: Floats) -> Floats:
        """Heights in px of boxes with feet (N, 2) in px from the middle of the picture; 0 or less above the horizon."""
        axes = self.axes()
        ray = np.concatenate([feet, np.full((len(feet), 1), self.focal_px)], axis=1)
        size = ray @ axes[2] / self.height  # the foot is at ray / size
        away = ray - np.outer(ray @ axes[2], axes[2])
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        head = ray + size[:, None] * (_GIRTH * away - axes[2])
        with np.errstate(divide="ignore", invalid="ignore"):
            height = feet[:, 1] - self.focal_px * head[:, 1] / head[:, 2]
        return np.where((size > 0) & (head[:, 2] > 0), height, 0.0)

    def plane(self, width_px: int, height_px: int, person_m: float) -> GroundPlane:
        """The ground plane: metres to the right of the camera and away from it, from the point below it."""
        centre = np.array([[1.0, 0.0, -width_px / 2], [0.0, 1.0, -height_px / 2], [0.0, 0.0, self.focal_px]])
        scale = np.array([self.height * person_m, self.height * person_m, 1.0])
        homography = (self.axes() * scale[:, None]) @ centre
        homography /= np.abs(homography[2]).max()
        rounded = [float(f"{value:.10g}") for value in homography.ravel()]  # the same on all machines
        return GroundPlane(tuple(rounded), width_px, height_px, assumed=True)


@dataclass(frozen=True, kw_only=True)
class PlaneFit:
    """A ground plane from boxes, and how well it fits them.

    Attributes
    ----------
    plane : GroundPlane
        Metres to the right of the camera and away from it; the origin is the point below it.
    boxes : int
        Number of boxes that agree with it.
    inliers : float
        Their share of all boxes of whole people.
    residual : float
        Typical relative deviation of their heights from the expected ones.
    camera_height_m, pitch_deg, roll_deg, focal_px : float
        The camera: height above the ground, how far it looks down, how far it is turned, focal length.
    nearest_m, farthest_m : float
        Distances from the camera, along the ground, between which 90 % of the feet are.
    scale_sd, depth_sd : float
        Relative standard deviations of metres across the line of sight, and along it.

    """

    plane: GroundPlane
    boxes: int
    inliers: float
    residual: float
    camera_height_m: float
    pitch_deg: float
    roll_deg: float
    focal_px: float
    nearest_m: float
    farthest_m: float
    scale_sd: float
    depth_sd: float

    def to_json(self) -> dict[str, Any]:
        """Convert all but the plane to JSON values, rounded to four digits."""
        values = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "plane"}
        return {name: value if isinstance(value, int) else float(f"{value:.4g}") for name, value in values.items()}


def plane_from_boxes(
    boxes: Floats, frame: Ints, score: Floats, width_px: int, height_px: int, person_m: float = PERSON_HEIGHT_M
) -> PlaneFit:
    """Estimate the ground plane of a still camera from boxes of people.

    Parameters
    ----------
    boxes : (N, 4) array, in px
        Left, top, width, height.
    frame : (N,) array of int
        The picture of each box.
    score : (N,) array
        Scores of a detector; NaN where there is none.
    width_px, height_px : int
        Size of the pictures.
    person_m : float, default 1.7
        Mean height of people in metres.

    Returns
    -------
    PlaneFit

    Raises
    ------
    McaptrackError
        If the boxes can't tell, with the reason as a clause.

    Examples
    --------
    People 1.7 m tall before a camera 5 m above the ground that looks down by 20 degrees:

    >>> import numpy as np
    >>> camera = FittedCamera(1000.0, np.deg2rad(20), 0.0, 5 / 1.7)
    >>> feet = np.random.default_rng(1).uniform([-400, -100], [400, 300], (500, 2))
    >>> tall = camera.expected_heights(feet)
    >>> boxes = np.stack([feet[:, 0] + 480, feet[:, 1] + 360 - tall, 0.4 * tall, tall], axis=1)
    >>> fit = plane_from_boxes(boxes, np.arange(500), np.full(500, np.nan), 960, 720)
    >>> round(fit.camera_height_m, 1), round(fit.pitch_deg)
    (5.0, 20)
    """
    whole = boxes[whole_people(boxes, frame, score, width_px, height_px)]
    upright = float(_is_upright(boxes).mean()) if len(boxes) else 0.0
    if len(boxes) >= _LEAST_BOXES and upright < _LEAST_UPRIGHT:
        raise McaptrackError(f"{upright:.0%} of the boxes have the shape of an upright person")
    if len(whole) < _LEAST_BOXES:
        raise McaptrackError(f"{len(whole)} of {len(boxes)} boxes show whole people, and {_LEAST_BOXES} are needed")
    if len(whole) > _MOST_BOXES:
        whole = whole[_evenly(len(whole), _MOST_BOXES)]
    centre = np.array([width_px / 2, height_px / 2])
    feet = np.stack([whole[:, 0] + whole[:, 2] / 2, whole[:, 1] + whole[:, 3]], axis=1) - centre
    solved, agrees = _fit(feet, whole[:, 3], _FOCAL * width_px)
    camera = solved.camera
    off = _deviations(camera, feet[agrees], whole[agrees, 3])
    distances = np.hypot(*camera.plane(width_px, height_px, person_m).pixels_to_metres(feet[agrees] + centre).T)
    nearest, farthest = np.nanquantile(distances, [0.05, 0.95])
    scale_sd, depth_sd = solved.uncertainty(np.median(feet[agrees], axis=0))
    fit = PlaneFit(
        plane=camera.plane(width_px, height_px, person_m),
        boxes=int(agrees.sum()),
        inliers=float(agrees.mean()),
        residual=float(1.4826 * np.median(np.abs(off))),
        camera_height_m=camera.height * person_m,
        pitch_deg=float(np.rad2deg(camera.pitch_rad)),
        roll_deg=float(np.rad2deg(camera.roll_rad)),
        focal_px=camera.focal_px,
        nearest_m=float(nearest),
        farthest_m=float(farthest),
        scale_sd=scale_sd,
        depth_sd=depth_sd,
    )
    shortest, tallest = np.quantile(camera.expected_heights(feet[agrees]), [0.05, 0.95])
    _refuse_if_unsure(fit, float(tallest / shortest))
    return fit


def _refuse_if_unsure(fit: PlaneFit, growth: float) -> None:
    """Raise McaptrackError, with the reason as a clause, if a plane isn't certain enough to be used.

    ``growth`` is how much taller people are in the picture where they are near than where they are far.
    """
    if fit.inliers < _LEAST_INLIERS or fit.residual > _MOST_RESIDUAL:
        raise McaptrackError(
            f"heights of boxes don't follow from where they stand: {fit.inliers:.0%} agree, within {fit.residual:.0%}"
        )
    if growth < _LEAST_GROWTH or not fit.depth_sd <= _MOST_DEPTH_SD or not fit.scale_sd <= _MOST_SCALE_SD:
        raise McaptrackError("people are all at about the same distance from the camera")
    if fit.pitch_deg > _STEEPEST:
        raise McaptrackError(f"the camera looks down, by about {fit.pitch_deg:.0f} degrees")


def whole_people(boxes: Floats, frame: Ints, score: Floats, width_px: int, height_px: int) -> Bools:
    """Which boxes (N, 4) show a whole upright person.

    Not so where a box touches the border of the picture, where a box of the same frame (N,) that is nearer to the
    camera hides a part of it, and where the score (N,) is low among all.
    """
    left, top, width, height = boxes.T
    size = np.array([width_px, height_px], np.float64)
    edge_x, edge_y = np.maximum(_BORDER_PX, _BORDER * size)
    use: Bools = _is_upright(boxes) & (left > edge_x) & (top > edge_y)
    use &= (left + width < size[0] - edge_x) & (top + height < size[1] - edge_y)
    has_score = np.isfinite(score)
    if has_score.any():
        use &= ~has_score | (score >= _LEAST_OF_SCORES * np.quantile(score[has_score], 0.95))
    finite = np.flatnonzero(np.isfinite(boxes).all(axis=1))
    corners = np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1)
    own, other = (finite[pair] for pair in touching_pairs(*[corners[finite]] * 2, *[frame[finite]] * 2))
    nearer = corners[other, 3] > corners[own, 3]
    own, other = own[nearer], other[nearer]
    low, high = np.maximum(corners[own, :2], corners[other, :2]), np.minimum(corners[own, 2:], corners[other, 2:])
    hidden = np.zeros(len(boxes))
    np.maximum.at(hidden, own, np.clip(high - low, 0, None).prod(axis=1))
    use &= hidden <= _MOST_HIDDEN * width * height
    return use


def _is_upright(boxes: Floats) -> Bools:
    """Which boxes (N, 4) have the shape of an upright person."""
    width, height = boxes.T[2:]
    is_upright: Bools = np.isfinite(boxes).all(axis=1) & (width > 0) & (height > 0)
    is_upright &= (width > height * _RATIOS[0]) & (width < height * _RATIOS[1])
    return is_upright


def _evenly(count: int, most: int) -> Indices:
    """Numbers from 0 to ``count``, ``most`` of them at equal distances."""
    numbers: Indices = np.linspace(0, count - 1, min(count, most)).round().astype(np.intp)
    return numbers


class _Solved(NamedTuple):
    """Parameters (P,) of a camera, and their covariance (P, P)."""

    values: Floats
    covariance: Floats

    @property
    def camera(self) -> FittedCamera:
        return _camera(self.values)

    def uncertainty(self, foot: Floats) -> tuple[float, float]:
        """Relative standard deviations of metres across the line of sight, and along it, at a foot (2,)."""

        def metres_a_px(values: Floats) -> Floats:
            camera = _camera(values)
            ray = np.array([*foot, camera.focal_px])
            down = float(ray @ camera.axes()[2])
            across = camera.height / down if down > 0 else np.nan
            return np.log([across, across * camera.focal_px / down]) if down > 0 else np.full(2, np.nan)

        step = 1e-5
        slopes = [(metres_a_px(self.values + d) - metres_a_px(self.values - d)) / (2 * step) for d in step * np.eye(4)]
        gradient = np.array(slopes).T
        across, along = np.sqrt(np.einsum("ij,jk,ik->i", gradient, self.covariance, gradient))
        return float(across), float(along)


def _camera(values: Floats) -> FittedCamera:
    """The camera with these parameters: logarithm of the focal length, pitch, roll, logarithm of the height."""
    return FittedCamera(float(np.exp(values[0])), float(values[1]), float(values[2]), float(np.exp(values[3])))


def _fit(feet: Floats, heights: Floats, focal_px: float) -> tuple[_Solved, Bools]:
    """Fit a camera to feet (M, 2), from the middle of the picture, and heights (M,); and which of them (M,) agree."""
    some = _evenly(len(feet), _FIRST_BOXES)
    solve = _solver(feet[some], heights[some], focal_px)
    first = [_start(feet, heights, focal_px, float(np.deg2rad(pitch))) for pitch in _STARTS]
    starts = [start for start in first if start is not None]
    if not starts:
        raise McaptrackError("heights of boxes don't follow from where they stand")
    solved = min((solve(start) for start in starts), key=lambda result: result[1])[0]
    solved, _ = _solver(feet, heights, focal_px)(solved.values)
    agrees = np.ones(len(feet), bool)
    for _ in range(_ROUNDS):
        agrees = _agreeing(_deviations(solved.camera, feet, heights))
        solved, _ = _solver(feet[agrees], heights[agrees], focal_px)(solved.values)
    return solved, agrees


def _start(feet: Floats, heights: Floats, focal_px: float, pitch_rad: float) -> Floats | None:
    """Parameters to begin with at a pitch; None if most feet would be above the horizon."""
    down = feet[:, 1] * np.cos(pitch_rad) + focal_px * np.sin(pitch_rad)
    if np.median(down) <= 0:
        return None
    height = float(np.median(down[down > 0] / heights[down > 0])) * np.cos(pitch_rad)
    return np.array([np.log(focal_px), pitch_rad, 0.0, np.log(height)])


def _solver(feet: Floats, heights: Floats, focal_px: float) -> Callable[[Floats], tuple[_Solved, float]]:
    """A function that improves parameters; it returns them and their cost."""
    from scipy.optimize import least_squares

    row, column = _cells(feet)
    cell = row * _COLUMNS + column
    count = np.bincount(cell)[cell]
    weight = np.sqrt(np.minimum(count, _BOXES_A_CELL) / count)

    def residuals(values: Floats) -> Floats:
        off = _deviations(_camera(values), feet, heights) / _SPREAD
        off = np.sign(off) * np.sqrt(2.25 * np.log1p(off**2 / 2.25))  # Cauchy's loss, as a residual
        expected = [(values[0] - np.log(focal_px)) / _FOCAL_SPREAD, values[2] / _ROLL_SPREAD]
        return np.concatenate([off * weight, expected])

    def solve(start: Floats) -> tuple[_Solved, float]:
        result = least_squares(residuals, start, max_nfev=_MOST_STEPS)
        return _Solved(result.x, np.linalg.pinv(result.jac.T @ result.jac)), float(result.cost)

    return solve


def _deviations(camera: FittedCamera, feet: Floats, heights: Floats) -> Floats:
    """Relative deviations of heights (M,) from what is expected at feet (M, 2), as logarithms."""
    return np.clip(np.log(heights / np.maximum(camera.expected_heights(feet), 1e-3)), -5.0, 5.0)


def _agreeing(off: Floats) -> Bools:
    """Which deviations (M,) belong to people who are seen whole: those about the mode.

    Their spread is measured above the mode, because boxes of people who are partly hidden are too short.
    """
    centre = np.median(off)
    spread = 0.0
    for _ in range(5):
        spread = max(1.4826 * float(np.median(off[off >= centre] - centre)), _LEAST_SPREAD)
        centre = np.median(off[np.abs(off - centre) <= 2 * spread])
    return (off >= centre - _BELOW * spread) & (off <= centre + _ABOVE * spread)


def _cells(feet: Floats) -> tuple[Ints, Ints]:
    """The row and the column of feet (M, 2) in a grid over all of them."""
    low, high = np.quantile(feet, [0.01, 0.99], axis=0)
    share = np.clip((feet - low) / np.maximum(high - low, 1e-9), 0.0, 1.0 - 1e-9)
    column, row = (share * [_COLUMNS, _ROWS]).astype(np.int64).T
    return row, column
