"""Find cameras with a ground plane that is off, and how far, from the people that they see together.

Letters: C cameras, F frames, N feet of one camera, M places.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.ground_correction import (
    GATE,
    LENS_MODELS,
    MODELS,
    Corrector,
    Feet,
    loss,
    moved,
    moved_feet,
    pair,
    vote,
)
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.transforms.fuse import Places, group, means

#: A camera with fewer comparisons, or with comparisons in fewer frames, is left as it is.
LEAST_PAIRS: Final = 60
LEAST_FRAMES: Final = 20
#: Times are divided into so many blocks; what is fitted to every other one is judged by the rest.
_BLOCKS: Final = 12
#: Corrections that move feet by less than this, in metres, are not made.
LEAST_MOVED_M: Final = 0.25
#: A correction is made if it is better on other times by more than so many standard errors.
_SURE: Final = 2.0
#: Cameras are compared again if another one has moved by more than this.
_SAME_M: Final = 0.15
#: People on one line or in one spot: standard deviations in metres across and along, and their ratio.
_NARROW_M, _NARROW, _SPOT_M = 0.4, 0.1, 0.4
#: Pairs of feet and places are counted up to this distance in metres.
_PAIRED_M: Final = 1.5


@dataclass(frozen=True)
class Watched:
    """A camera: where it sees people by its own ground plane, and whether that has to stay as it is.

    ``classes`` (N,) are those of its feet; ``why_held`` is the reason why the plane stays, "" if it may be corrected.
    """

    name: str
    feet: Feet
    classes: Ints
    plane: GroundPlane
    why_held: str = ""

    @property
    def models(self) -> tuple[str, ...]:
        """The corrections that it may have, the simplest first."""
        return tuple(MODELS if self.plane.lens is None else LENS_MODELS)


class Residual(NamedTuple):
    """Distances in metres of a camera's feet from where others see the same people, at times that weren't fitted."""

    median_m: float
    p90_m: float
    pairs: int


class Refined(NamedTuple):
    """The findings about a camera.

    ``model`` is that of the correction, "" if there is none, and ``matrix`` the map of the ground (3, 3) that it is.
    ``before`` and ``after`` are of the same pairs; None if the camera can't be compared. ``why`` is the reason why
    nothing was corrected, or ``limit`` what is not determined.
    """

    name: str
    model: str
    matrix: Floats
    moved_m: float
    before: Residual | None
    after: Residual | None
    why: str = ""
    limit: str = ""


class _Found(NamedTuple):
    """The best correction of a camera, and how it does at other times."""

    model: str
    matrix: Floats
    moved_m: float
    before: Residual
    after: Residual
    limit: str


@dataclass
class Refiner:
    """Corrects cameras one by one, the worst first, by what the others agree on.

    ``frames`` is their number. Cameras with a name in ``trusted`` are right: others are compared with these alone, and
    with those that were compared already.
    """

    cameras: Sequence[Watched]
    frames: int
    rate_hz: float
    trusted: frozenset[str]
    reach: tuple[float, float]  # sigmas and metres up to which boxes of several cameras are one person
    progress: Callable[[int, int], None] = lambda done, total: None
    maps: dict[str, Floats] = field(default_factory=dict)

    def refine(self) -> list[Refined]:
        """Return what was found about each camera, in order."""
        self.maps = {camera.name: np.eye(3) for camera in self.cameras}
        verdicts: dict[str, _Found | str] = {}
        if self.trusted:
            self._outwards(verdicts)
        else:
            self._worst_first(verdicts)
        return [self._result(camera, verdicts.get(camera.name, "")) for camera in self.cameras]

    def _outwards(self, verdicts: dict[str, _Found | str]) -> None:
        """Judge the camera with the most pairs against those that are right, count it among them, and so on."""
        settled, left = set(self.trusted), [camera for camera in self.cameras if camera.name not in self.trusted]
        while left:
            places = self._places("", settled, 1)
            seen = [self._suspect(camera, places) for camera in left]
            best = int(np.argmax([suspect[2] for suspect in seen]))
            camera = left.pop(best)
            self._take(camera, self._judge(camera, places, seen[best][1]), verdicts)
            settled.add(camera.name)
            self.progress(len(settled), len(self.cameras))

    def _worst_first(self, verdicts: dict[str, _Found | str]) -> None:
        """Correct the camera with the most to gain until none gains; later corrections may change earlier ones."""
        names = {camera.name for camera in self.cameras}
        least = min(len(names) - 1, 2)
        settled: set[str] = set()
        seen: dict[str, tuple[Feet, float, list[Floats], int]] = {}
        turns, most = dict.fromkeys(names, 0), 4 * len(names)
        for number in range(most):
            left = [camera for camera in self.cameras if camera.name not in settled and turns[camera.name] < 3]
            if not left:
                break
            for camera in left:
                if camera.name not in seen:
                    places = self._places(camera.name, names, least)
                    seen[camera.name] = places, *self._suspect(camera, places)
            camera = max(left, key=lambda name_of: seen[name_of.name][1])
            before = self.maps[camera.name]
            self._take(camera, self._judge(camera, seen[camera.name][0], seen[camera.name][2]), verdicts)
            turns[camera.name] += 1
            if _moves(camera, before, self.maps[camera.name]) > _SAME_M:
                settled, seen = set(), {}
            settled.add(camera.name)
            self.progress(min(number + 1, most - 1), most)
        self.progress(most, most)

    def _take(self, camera: Watched, judged: _Found | str, verdicts: dict[str, _Found | str]) -> None:
        verdicts[camera.name] = judged
        self.maps[camera.name] = np.eye(3) if isinstance(judged, str) or camera.why_held else judged.matrix

    def _places(self, but: str, among: set[str] | frozenset[str], least: int) -> Feet:
        """Return the places where ``least`` of the cameras ``among`` see a person, leaving out ``but``."""
        parts, cameras, classes = [], [], []
        for number, watched in enumerate(self.cameras):
            if watched.name == but or watched.name not in among:
                continue
            feet, kept = moved_feet(self.maps[watched.name], watched.feet)
            parts.append(feet)
            cameras.append(np.full(len(kept), number))
            classes.append(watched.classes[kept])
        if not parts:
            return Feet(np.empty((0, 2)), np.empty((0, 3)), np.empty(0, np.int64))
        feet = Feet(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
        camera, kind = np.concatenate(cameras), np.concatenate(classes)
        order = np.lexsort((camera, kind, feet.frame))
        feet, camera, kind = feet.at(order), camera[order], kind[order]
        key = feet.frame * (int(kind.max(initial=0)) + 1) + kind
        bounds = [*np.flatnonzero(np.diff(key, prepend=-1)).tolist(), len(key)]
        out: list[Feet] = []
        for begin, end in pairwise(bounds):
            part = feet.at(np.arange(begin, end))
            places = Places(part.xy_m, part.cov)
            of = group(camera[begin:end], places, self.reach[0] ** 2, self.reach[1])
            size = np.bincount(of)
            centre, seen = means(places, of, len(size)), size >= least
            out.append(Feet(centre.xy_m[seen], centre.cov[seen], np.full(int(seen.sum()), feet.frame[begin])))
        return Feet(*(np.concatenate(columns) for columns in zip(*out, strict=True)))

    def _suspect(self, camera: Watched, places: Feet) -> tuple[float, list[Floats], int]:
        """Return how much a correction gains, maps to start its search from, and the number of pairs."""
        if not len(camera.feet.frame) or not len(places.frame):
            return 0.0, [np.eye(3)], 0
        starts = [np.eye(3), vote(camera.feet, places, round(10 * self.rate_hz))]
        if not np.array_equal(self.maps[camera.name], np.eye(3)):
            starts.append(self.maps[camera.name])
        model = Corrector.around("rigid", camera.feet.xy_m)
        fits = [model.fit(camera.feet, places, start) for start in starts]
        costs = [self._cost(camera.feet, places, fit) for fit in fits]
        now = self._cost(camera.feet, places, self.maps[camera.name])
        pairs = max(len(pair(moved_feet(fit, camera.feet)[0], places, _PAIRED_M, GATE).feet) for fit in fits)
        order = np.argsort(costs, kind="stable")
        return (now - min(costs)) * len(camera.feet.frame), [fits[order[0]]], pairs

    def _cost(self, feet: Feet, places: Feet, matrix: Floats) -> float:
        return float(np.nanmean(loss(moved_feet(matrix, feet)[0], places, self.frames)))

    def _judge(self, camera: Watched, places: Feet, starts: Sequence[Floats]) -> _Found | str:
        """Return the correction that fits best at times it was not fitted to; or why there is none."""
        pairs = pair(moved_feet(starts[0], camera.feet)[0], places, _PAIRED_M, GATE)
        frames = len(np.unique(places.frame[pairs.places]))
        if len(pairs.feet) < LEAST_PAIRS or frames < LEAST_FRAMES:
            return (
                f"it can't be compared: {len(pairs.feet)} of its boxes in {frames} frames are near people seen by the "
                f"others, and {LEAST_PAIRS} in {LEAST_FRAMES} are needed"
            )
        models, limit = self._determined(camera, places.xy_m[pairs.places])
        block = np.arange(self.frames) * _BLOCKS // self.frames
        fits: dict[str, list[Floats]] = {"": [np.eye(3)] * 2}
        for model in models:
            corrector = Corrector.around(model, camera.feet.xy_m, camera.plane.homography, camera.plane.lens)
            fits[model] = []
            for fold in range(2):
                feet = camera.feet.at(block[camera.feet.frame] % 2 != fold)
                tried = [corrector.fit(feet, places, start) for start in starts]
                costs = [self._cost(feet, places, fit) for fit in tried]
                fits[model].append(tried[int(np.argmin(costs))])
        costs_of = {model: self._held_out(camera, places, pair_, block) for model, pair_ in fits.items()}
        best = min(costs_of, key=lambda model: float(np.nanmean(costs_of[model])))
        chosen = next(model for model in costs_of if _is_as_good(costs_of[model], costs_of[best]))
        if not chosen:
            chosen = best  # it is said how little there is to gain
        matrix = np.eye(3)
        if chosen:
            corrector = Corrector.around(chosen, camera.feet.xy_m, camera.plane.homography, camera.plane.lens)
            tried = [corrector.fit(camera.feet, places, start) for start in fits[chosen]]
            matrix = tried[int(np.argmin([self._cost(camera.feet, places, fit) for fit in tried]))]
        moves = _moves(camera, np.eye(3), matrix)
        gain = costs_of[""] - costs_of[chosen]
        if chosen and (not _is_sure(gain) or moves < LEAST_MOVED_M):
            chosen, matrix, moves = "", np.eye(3), 0.0
        return _Found(chosen, matrix, moves, *self._residuals(camera, places, fits[chosen], block), limit)

    def _determined(self, camera: Watched, xy_m: Floats) -> tuple[tuple[str, ...], str]:
        """Return the kinds of correction that people at these places determine, and a remark on what they don't."""
        x, y = (xy_m - xy_m.mean(axis=0)).T
        cov = np.array([[(x * x).mean(), (x * y).mean()], [(x * y).mean(), (y * y).mean()]])
        small, large = np.sqrt(np.maximum(np.linalg.eigvalsh(cov), 0.0)).tolist()
        if large < _SPOT_M:
            return camera.models[:1], "people are seen in one spot: only a shift is determined"
        if small < max(_NARROW_M, _NARROW * large):
            return camera.models[:2], "people walk on one line: only a shift and a rotation are determined"
        return camera.models, ""

    def _held_out(self, camera: Watched, places: Feet, fits: Sequence[Floats], block: Ints) -> Floats:
        """The loss of each block (B,) under the map that was fitted to the other ones."""
        out = np.full(_BLOCKS, np.nan)
        for fold, fit in enumerate(fits):
            feet = camera.feet.at(block[camera.feet.frame] % 2 == fold)
            cost = loss(moved_feet(fit, feet)[0], places, self.frames)
            for number in range(fold, _BLOCKS, 2):
                part = cost[block == number]
                if np.isfinite(part).any():
                    out[number] = np.nanmean(part)
        return out

    def _residuals(
        self, camera: Watched, places: Feet, fits: Sequence[Floats], block: Ints
    ) -> tuple[Residual, Residual]:
        """Distances before and after, of the same pairs, at the times that were not fitted."""
        before, after = [], []
        for fold, fit in enumerate(fits):
            feet = camera.feet.at(block[camera.feet.frame] % 2 == fold)
            now, which = moved_feet(fit, feet)
            pairs = pair(now, places, _PAIRED_M)
            apart = feet.xy_m[which[pairs.feet]] - places.xy_m[pairs.places]
            before.append(np.hypot(*apart.T))
            after.append(pairs.distance_m)
        return _residual(np.concatenate(before)), _residual(np.concatenate(after))

    def _result(self, camera: Watched, judged: _Found | str) -> Refined:
        none = np.eye(3)
        if isinstance(judged, str):
            return Refined(camera.name, "", none, 0.0, None, None, judged or camera.why_held)
        if camera.why_held:
            return Refined(camera.name, "", none, 0.0, judged.before, judged.before, camera.why_held)
        why = "" if judged.model else "it agrees with the others"
        limit = judged.limit if judged.model else ""
        return Refined(
            camera.name, judged.model, judged.matrix, judged.moved_m, judged.before, judged.after, why, limit
        )


def _residual(distance_m: Floats) -> Residual:
    if not len(distance_m):
        return Residual(float("nan"), float("nan"), 0)
    return Residual(float(np.median(distance_m)), float(np.quantile(distance_m, 0.9)), len(distance_m))


def _moves(camera: Watched, before: Floats, after: Floats) -> float:
    """The distance between where two maps put the feet of a camera, as the root of its mean square in metres."""
    apart = moved(after, camera.feet.xy_m) - moved(before, camera.feet.xy_m)
    squared = (apart**2).sum(axis=1)
    squared = squared[np.isfinite(squared)]
    return float(np.sqrt(squared.mean())) if len(squared) else 0.0


def _is_as_good(cost: Floats, best: Floats) -> bool:
    """Whether losses of blocks (B,) are no worse than others, within a standard error."""
    apart = (cost - best)[np.isfinite(cost - best)]
    return len(apart) < 2 or float(apart.mean()) <= float(apart.std(ddof=1) / np.sqrt(len(apart)))


def _is_sure(gain: Floats) -> bool:
    """Whether the mean gain of blocks (B,) is more than chance."""
    gain = gain[np.isfinite(gain)]
    return len(gain) > 2 and float(gain.mean()) > _SURE * float(gain.std(ddof=1) / np.sqrt(len(gain)))
