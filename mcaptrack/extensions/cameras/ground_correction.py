"""Correct a ground plane by people that other cameras see, too: a map of the ground that brings both together.

Letters: N feet of one camera, M places where others see people, P parameters of a correction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Final, NamedTuple, Self

import numpy as np

from mcaptrack.geometry.arrays import Floats, Indices, Ints, taken
from mcaptrack.geometry.neighbours import squared_sigmas
from mcaptrack.geometry.pinhole import Lens, ground_homography

#: Corrections by name, with how many of the generators below each uses: a later one contains the earlier ones.
MODELS: Final[Mapping[str, int]] = MappingProxyType({"shift": 2, "rigid": 3, "similarity": 4, "affine": 6, "full": 8})
#: Corrections of a camera with a known lens: those that are movements of the camera, so that the lens stays right.
LENS_MODELS: Final[Mapping[str, int]] = MappingProxyType({"shift": 2, "rigid": 3, "pose": 6})
#: Generators of maps of the plane: shifts, rotation, scale, two shears, and two tilts.
_GENERATORS: Final = np.array([
    [[0, 0, 1], [0, 0, 0], [0, 0, 0]],
    [[0, 0, 0], [0, 0, 1], [0, 0, 0]],
    [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
    [[1, 0, 0], [0, 1, 0], [0, 0, 0]],
    [[1, 0, 0], [0, -1, 0], [0, 0, 0]],
    [[0, 1, 0], [1, 0, 0], [0, 0, 0]],
    [[0, 0, 0], [0, 0, 0], [1, 0, 0]],
    [[0, 0, 0], [0, 0, 0], [0, 1, 0]],
], np.float64)  # fmt: skip
#: What is expected of the parameters before anything is seen: standard deviations, in the unit of the places' spread.
_EXPECTED: Final = np.array([3.0, 3.0, 0.5, 0.3, 0.3, 0.3, 0.3, 0.3])
#: Pairs are searched up to these distances in turn, in metres, and are then at most so many standard deviations apart.
_REACH_M: Final = (2.0, 1.6, 1.3, 1.1, 0.9, 0.9, 0.9)
GATE: Final = 3.0
#: Differences of more standard deviations count less (Cauchy's weights).
_ROBUST: Final = 1.5
#: Frames are this far apart where neighbours are searched among places and frames at once.
_APART_M: Final = 1e5
#: Steps of the numerical derivative, and of the search for a start.
_STEP, _STARTS = 1e-6, 8
#: A start is found if the parameters change by less than this.
_CLOSE: Final = 1e-4
#: Digits of a step that count: the rest depends on the machine.
_DIGITS: Final = 10
#: Votes that differ by less are the same.
_TIE: Final = 1e-9
#: Terms of the exponential series of a matrix below 1 / 8.
_TERMS: Final = 12
#: Offsets are voted for up to this distance in metres, with cells of this size, blurred by so many cells.
_VOTE_M, _CELL_M, _BLUR = 8.0, 0.25, 1.6
#: Rotations and scales that are voted on.
_TURNS_DEG: Final = tuple(range(-8, 9, 2))
_SCALES: Final = (0.92, 1.0, 1.08)
#: People who stand vote once in so many frames: places of this size in metres are counted once.
_ONCE_M: Final = 0.5


class Feet(NamedTuple):
    """Places on the ground: positions (N, 2) in m, covariances (N, 3) in m^2 (xx, xy, yy), and the frame of each."""

    xy_m: Floats
    cov: Floats
    frame: Ints

    def _in_space(self) -> Floats:
        return np.column_stack([self.xy_m, self.frame * _APART_M])


class Paired(NamedTuple):
    """Which feet are paired with which places (K,) each, their distance in m, and in standard deviations."""

    feet: Indices
    places: Indices
    distance_m: Floats
    sigmas: Floats


def moved(matrix: Floats, xy_m: Floats) -> Floats:
    """Apply a map of the ground (3, 3) to positions (N, 2); NaN beyond its horizon."""
    x, y = xy_m.T
    across, along, w = (row[0] * x + row[1] * y + row[2] for row in matrix.tolist())
    w = np.where(w > 0, w, np.nan)
    return np.stack([across / w, along / w], axis=-1)


def moved_feet(matrix: Floats, feet: Feet) -> tuple[Feet, Indices]:
    """Apply a map of the ground to feet; returns those on this side of its horizon, and which these are."""
    step = 0.01
    at, right, up = (moved(matrix, feet.xy_m + shift) for shift in ([0.0, 0.0], [step, 0.0], [0.0, step]))
    jacobian = np.stack([right - at, up - at], axis=-1) / step
    xx, xy, yy = feet.cov.T
    cov = jacobian @ np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)
    cov = cov @ jacobian.transpose(0, 2, 1)
    out = Feet(at, np.stack([cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]], axis=-1), feet.frame)
    kept = np.flatnonzero(np.isfinite(at).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)))
    return taken(out, kept), kept


def pair(feet: Feet, places: Feet, reach_m: float, gate: float = np.inf) -> Paired:
    """Pair feet and places that are nearest to each other in their frame, up to ``reach_m`` and ``gate`` sigmas."""
    from scipy.spatial import cKDTree

    none = np.empty(0, np.intp)
    if not len(feet.xy_m) or not len(places.xy_m):
        return Paired(none, none, np.empty(0), np.empty(0))
    ours, theirs = feet._in_space(), places._in_space()
    distance, nearest = cKDTree(theirs).query(ours, distance_upper_bound=reach_m)
    _, back = cKDTree(ours).query(theirs, distance_upper_bound=reach_m)
    at = np.flatnonzero(np.isfinite(distance))
    at = at[back[nearest[at]] == at]
    to = nearest[at]
    apart, cov = feet.xy_m[at] - places.xy_m[to], feet.cov[at] + places.cov[to]
    sigmas = np.sqrt(squared_sigmas(*apart.T, *cov.T))
    fits = sigmas <= gate
    return Paired(at[fits], to[fits], distance[at][fits], sigmas[fits])


def loss(feet: Feet, places: Feet, frames: int) -> Floats:
    """Return the misfit of feet and places (frames,): the mean squared distance in sigmas, cut off at the gate.

    Feet without a place count as if they were at the gate, so that a correction can't win by pairing fewer of them. NaN
    in frames without feet.
    """
    paired = pair(feet, places, _REACH_M[-1], GATE)
    cost = np.full(len(feet.frame), GATE**2)
    cost[paired.feet] = paired.sigmas**2
    count = np.bincount(feet.frame, minlength=frames)
    total = np.bincount(feet.frame, cost, frames)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


@dataclass(frozen=True)
class Corrector:
    """Maps of the ground of one kind (``MODELS``, ``LENS_MODELS``) for a camera that sees people around a centre.

    ``centre`` (2,) and ``unit_m`` make positions numbers of about 1. For "pose" ``homography`` (3, 3) and ``lens`` are
    those of the plane: parameters are then movements of the camera, so that the correction follows from them.
    """

    model: str
    centre: tuple[float, float]
    unit_m: float
    homography: tuple[float, ...] = ()
    lens: Lens | None = None

    @classmethod
    def around(cls, model: str, xy_m: Floats, homography: tuple[float, ...] = (), lens: Lens | None = None) -> Self:
        """A corrector for places (N, 2)."""
        x, y = np.median(xy_m, axis=0).tolist()
        spread_m = float(np.sqrt(((xy_m - [x, y]) ** 2).sum(axis=1).mean()))
        return cls(model, (x, y), max(spread_m, 0.5), homography, lens)

    @property
    def size(self) -> int:
        """The number of parameters."""
        return {**MODELS, **LENS_MODELS}[self.model]

    @cached_property
    def _to_unit(self) -> Floats:
        (x, y), s = self.centre, self.unit_m
        return np.array([[1 / s, 0, -x / s], [0, 1 / s, -y / s], [0, 0, 1.0]])

    def matrix(self, parameters: Floats) -> Floats:
        """The map (3, 3) of the ground for parameters (P,), positive at the centre."""
        if self.model == "pose":
            return self._scaled(self._by_pose(parameters))
        return self._scaled(self._from_unit @ self._turned(parameters) @ self._to_unit)

    def _turned(self, parameters: Floats) -> Floats:
        return _exponential(np.einsum("p,pij->ij", parameters, _GENERATORS[: len(parameters)]))

    @cached_property
    def _from_unit(self) -> Floats:
        out: Floats = np.linalg.inv(self._to_unit).astype(np.float64)
        return out

    def _scaled(self, matrix: Floats) -> Floats:
        out: Floats = matrix / (matrix[2] @ [*self.centre, 1.0])
        return out

    @cached_property
    def _pose(self) -> tuple[Floats, Floats]:
        """The pose of the camera: rotation (3, 3) and translation (3,) from the ground's frame to the camera's."""
        assert self.lens is not None
        axes = np.linalg.inv(self.lens.matrix) @ np.linalg.inv(np.reshape(self.homography, (3, 3)))
        scale = np.sqrt(np.linalg.norm(axes[:, 0]) * np.linalg.norm(axes[:, 1]))
        axes *= np.sign(axes[2] @ [*self.centre, 1.0]) / scale
        u, _, vt = np.linalg.svd(np.column_stack([axes[:, :2], np.cross(axes[:, 0], axes[:, 1])]))
        rotation: Floats = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        return rotation, axes[:, 2].astype(np.float64)

    def _by_pose(self, parameters: Floats) -> Floats:
        """The map for three angles about the axes of the camera and a movement of it, in units."""
        from scipy.spatial.transform import Rotation

        assert self.lens is not None
        rotation, translation = self._pose
        eye = -rotation.T @ translation + self.unit_m * parameters[3:]
        turned = Rotation.from_rotvec(parameters[:3]).as_matrix() @ rotation
        return np.reshape(ground_homography(self.lens, turned, -turned @ eye, np.eye(3)), (3, 3)) @ np.linalg.inv(
            np.reshape(self.homography, (3, 3))
        )

    @property
    def _expected(self) -> Floats:
        return np.array([0.3] * 3 + [1.0] * 3) if self.model == "pose" else _EXPECTED[: self.size]

    def fit(self, feet: Feet, places: Feet, start: Floats) -> Floats:
        """Return the map (3, 3) that brings feet to the places where others see these people, from a map near it."""
        state = _State(np.zeros(self.size), np.eye(3))
        begin = moved(start, feet.xy_m)
        is_mapped = np.isfinite(begin).all(axis=1)
        same = np.tile([1.0, 0.0, 1.0], (int(is_mapped.sum()), 1))
        for _ in range(0 if np.array_equal(start, np.eye(3)) else _STARTS):
            before = state.parameters
            state = self._improved(state, feet.xy_m[is_mapped], begin[is_mapped], same, np.inf)
            if np.abs(state.parameters - before).max() < _CLOSE:
                break
        for reach_m in _REACH_M:
            now, which = moved_feet(state.matrix, feet)
            kept = pair(now, places, reach_m, GATE if reach_m <= 1 else np.inf)
            if len(kept.feet) <= self.size:
                break
            cov = now.cov[kept.feet] + places.cov[kept.places]
            own_m = feet.xy_m[which[kept.feet]]
            state = self._improved(state, own_m, places.xy_m[kept.places], cov, _ROBUST)
        return state.matrix

    def _improved(self, state: _State, xy_m: Floats, to_m: Floats, cov: Floats, robust: float) -> _State:
        """One step of Gauss and Newton towards positions (N, 2), weighted by their covariances (N, 3)."""
        at = moved(state.matrix, xy_m)
        apart = (to_m - at)[..., None]
        # In coordinates in which the covariance is the identity, by its Cholesky factor.
        slopes, apart = _whitened(self._slopes(state, xy_m, at), cov), _whitened(apart, cov)[..., 0]
        squared = (apart**2).sum(axis=1)
        fine = np.isfinite(squared) & np.isfinite(slopes).all(axis=(1, 2))
        weight = np.sqrt(np.where(fine, 1 / (1 + squared / robust**2), 0.0))
        rows = (np.where(fine[:, None, None], slopes, 0.0) * weight[:, None, None]).reshape(-1, self.size)
        values = (np.where(fine[:, None], apart, 0.0) * weight[:, None]).ravel()
        # Not by BLAS: its threads take longer for so few columns, and its sums depend on their number.
        normal, right = np.einsum("na,nb->ab", rows, rows), np.einsum("na,n->a", rows, values)
        prior = 1 / self._expected**2
        step: Floats = np.linalg.solve(normal + np.diag(prior), right - prior * state.parameters)
        step /= max(float(np.abs(step / self._expected).max(initial=0.0)), 1.0)
        step = np.round(step, _DIGITS).astype(np.float64)
        parameters = state.parameters + step
        if self.model == "pose":
            return _State(parameters, self.matrix(parameters))
        # The maps of a model are a group, so that a step is one more map: its derivative is that at nothing.
        turned = self._from_unit @ self._turned(step) @ self._to_unit @ state.matrix
        return _State(parameters, self._scaled(turned))

    def _slopes(self, state: _State, xy_m: Floats, at: Floats) -> Floats:
        """The derivatives of positions by the parameters (N, 2, P)."""
        if self.model == "pose":
            steps = np.eye(self.size) * _STEP
            maps = [self.matrix(state.parameters + step) for step in steps]
            return np.stack([(moved(changed, xy_m) - at) / _STEP for changed in maps], axis=-1)
        u, v = ((at - self.centre) / self.unit_m).T
        ones, none = np.ones(len(u)), np.zeros(len(u))
        across = [ones, none, -v, u, u, v, -u * u, -u * v]
        along = [none, ones, u, v, -v, u, -u * v, -v * v]
        return self.unit_m * np.stack([np.stack(part[: self.size], axis=-1) for part in (across, along)], axis=1)


class _State(NamedTuple):
    """The parameters (P,) of a correction, the sum of all steps; and the map (3, 3)."""

    parameters: Floats
    matrix: Floats


def _exponential(matrix: Floats) -> Floats:
    """The exponential of a matrix, by its series; that of SciPy takes a hundred times as long for (3, 3)."""
    halvings = max(int(np.ceil(np.log2(max(float(np.abs(matrix).max()), 1e-12) * 8))), 0)
    small = matrix / 2.0**halvings
    out = term = np.eye(len(matrix))
    for number in range(1, _TERMS):
        term = term @ small / number
        out = out + term
    for _ in range(halvings):
        out = out @ out
    return out


def _whitened(values: Floats, cov: Floats) -> Floats:
    """Divide vectors (N, 2, P) by the Cholesky factors of covariances (N, 3)."""
    xx, xy, yy = cov.T[..., None]
    x, y = values[:, 0], values[:, 1]
    return np.stack([x / np.sqrt(xx), (y - xy / xx * x) / np.sqrt(yy - xy * xy / xx)], axis=1)


def vote(feet: Feet, places: Feet, span: int) -> Floats:
    """Return the rigid map, or one of another scale, that most pairs of feet and places agree on, (3, 3).

    All people of a frame are paired with all others, since with a plane that is off by metres the nearest is another
    person. Pairs of the same two places count once in ``span`` frames: people who stand would outvote those who walk.
    """
    from scipy.ndimage import gaussian_filter
    from scipy.spatial import cKDTree

    ours, theirs = feet._in_space(), places._in_space()
    if not len(ours) or not len(theirs):
        return np.eye(3)
    near = cKDTree(ours).sparse_distance_matrix(cKDTree(theirs), _VOTE_M + 2, output_type="ndarray")
    at, to = near["i"], near["j"]
    if not len(at):
        return np.eye(3)
    cells = np.floor(np.concatenate([feet.xy_m[at], places.xy_m[to]], axis=1) / _ONCE_M).astype(np.int64)
    cells -= cells.min(axis=0)
    sides = cells.max(axis=0) + 1
    key = np.ravel_multi_index((feet.frame[at] // max(span, 1), *cells.T), (int(feet.frame.max()) + 1, *sides))
    once = np.unique(key, return_index=True)[1]
    at, to = at[once], to[once]
    centre = np.median(feet.xy_m[at], axis=0)
    (x, y), theirs_m = (feet.xy_m[at] - centre).T, places.xy_m[to] - centre
    bins = round(2 * _VOTE_M / _CELL_M)
    best, out = -1.0, np.eye(3)
    for scale in _SCALES:
        for turn_deg in _TURNS_DEG:
            c, s = scale * np.cos(np.radians(turn_deg)), scale * np.sin(np.radians(turn_deg))
            turn = np.array([[c, -s], [s, c]])
            apart = theirs_m - np.stack([c * x - s * y, s * x + c * y], axis=-1)
            at_cell = np.floor((apart + _VOTE_M) / _CELL_M).astype(np.int64)
            inside = ((at_cell >= 0) & (at_cell < bins)).all(axis=1)
            counts = np.bincount(at_cell[inside] @ [bins, 1], minlength=bins * bins).reshape(bins, bins)
            votes = gaussian_filter(counts.astype(np.float64), _BLUR, mode="constant")
            if votes.max() > best * (1 + _TIE):
                best = float(votes.max())
                shift = (np.array(np.unravel_index(int(votes.argmax()), votes.shape)) + 0.5) * _CELL_M - _VOTE_M
                out = np.eye(3)
                out[:2, :2], out[:2, 2] = turn, centre + shift - turn @ centre
    return out
