"""Correct the ground planes of cameras by the people that they see together, and write the corrected ones into the log.

The plane that was given stays as it is, in its own channel. The corrected one stands below it, and is used instead
(``sources.cameras``) until the given one is replaced.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.cameras.feet import FootFuser, Places, group, means
from mcaptrack.extensions.cameras.fusing import Gathered, Source, compared_cameras, fusable, read_sources, set_back
from mcaptrack.extensions.cameras.ground_correction import (
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
from mcaptrack.foxglove import views
from mcaptrack.geometry.arrays import Floats, Ints, joined, taken
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import GroundPlane, Planes
from mcaptrack.notices import warn
from mcaptrack.pipeline.checks import cameras_named, describe_origin, may_replace
from mcaptrack.pipeline.staleness import digest_of
from mcaptrack.pipeline.write import Made, RunState, write
from mcaptrack.schema import GROUND_PLANE, Frame
from mcaptrack.schema.as_rows import plane_to_rows
from mcaptrack.schema.provenance import REFINE, Provenance, frame_id_of
from mcaptrack.sources.camera_motion import planes_in
from mcaptrack.sources.cameras import Camera, camera_at, corrected_plane, given_plane, provenance_of, scenes_of
from mcaptrack.sources.cameras import cameras as cameras_of

#: Cameras are compared by at most so many frames.
_COMPARED: Final = 200
#: The reason why a reference stays as it is.
REFERENCE: Final = "it is the reference"
#: How often clocks and planes are estimated in turn.
_TURNS: Final = 2


# Find cameras with a ground plane that is off, and how far, from the people that they see together.
#
# Letters: C cameras, F frames, N feet of one camera, M places.


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
    found: dict[str, Refined] = field(default_factory=dict)

    def refine(self) -> list[Refined]:
        """Return what was found about each camera, in order."""
        self.found = {camera.name: _uncorrected(camera, camera.why_held) for camera in self.cameras}
        if self.trusted:
            self._outwards()
        else:
            self._worst_first()
        return list(self.found.values())

    def _outwards(self) -> None:
        """Judge the camera with the most pairs against those that are right, count it among them, and so on."""
        settled, left = set(self.trusted), [camera for camera in self.cameras if camera.name not in self.trusted]
        while left:
            places = self._places("", settled, 1)
            seen = [self._suspect(camera, places) for camera in left]
            best = int(np.argmax([suspect[2] for suspect in seen]))
            camera = left.pop(best)
            self.found[camera.name] = self._judge(camera, places, seen[best][1])
            settled.add(camera.name)
            self.progress(len(settled), len(self.cameras))

    def _worst_first(self) -> None:
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
            before = self.found[camera.name].matrix
            self.found[camera.name] = self._judge(camera, seen[camera.name][0], seen[camera.name][2])
            turns[camera.name] += 1
            if _moves(camera, before, self.found[camera.name].matrix) > _SAME_M:
                settled, seen = set(), {}
            settled.add(camera.name)
            self.progress(min(number + 1, most - 1), most)
        self.progress(most, most)

    def _places(self, but: str, among: set[str] | frozenset[str], least: int) -> Feet:
        """Return the places where ``least`` of the cameras ``among`` see a person, leaving out ``but``."""
        parts, cameras, classes = [], [], []
        for number, watched in enumerate(self.cameras):
            if watched.name == but or watched.name not in among:
                continue
            feet, kept = moved_feet(self.found[watched.name].matrix, watched.feet)
            parts.append(feet)
            cameras.append(np.full(len(kept), number))
            classes.append(watched.classes[kept])
        if not parts:
            return Feet(np.empty((0, 2)), np.empty((0, 3)), np.empty(0, np.int64))
        feet = joined(parts)
        camera, kind = np.concatenate(cameras), np.concatenate(classes)
        order = np.lexsort((camera, kind, feet.frame))
        feet, camera, kind = taken(feet, order), camera[order], kind[order]
        key = feet.frame * (int(kind.max(initial=0)) + 1) + kind
        bounds = [*np.flatnonzero(np.diff(key, prepend=-1)).tolist(), len(key)]
        out: list[Feet] = []
        for begin, end in pairwise(bounds):
            part = taken(feet, slice(begin, end))
            places = Places(part.xy_m, part.cov)
            of = group(camera[begin:end], places, self.reach[0] ** 2, self.reach[1])
            size = np.bincount(of)
            centre, seen = means(places, of, len(size)), size >= least
            out.append(Feet(centre.xy_m[seen], centre.cov[seen], np.full(int(seen.sum()), feet.frame[begin])))
        return joined(out)

    def _suspect(self, camera: Watched, places: Feet) -> tuple[float, list[Floats], int]:
        """Return how much a correction gains, maps to start its search from, and the number of pairs."""
        if not len(camera.feet.frame) or not len(places.frame):
            return 0.0, [np.eye(3)], 0
        starts = [np.eye(3), vote(camera.feet, places, round(10 * self.rate_hz))]
        if not np.array_equal(self.found[camera.name].matrix, np.eye(3)):
            starts.append(self.found[camera.name].matrix)
        model = Corrector.around("rigid", camera.feet.xy_m)
        fits = [model.fit(camera.feet, places, start) for start in starts]
        costs = [self._cost(camera.feet, places, fit) for fit in fits]
        now = self._cost(camera.feet, places, self.found[camera.name].matrix)
        pairs = max(len(pair(moved_feet(fit, camera.feet)[0], places, _PAIRED_M, GATE).feet) for fit in fits)
        order = np.argsort(costs, kind="stable")
        return (now - min(costs)) * len(camera.feet.frame), [fits[order[0]]], pairs

    def _cost(self, feet: Feet, places: Feet, matrix: Floats) -> float:
        return float(np.nanmean(loss(moved_feet(matrix, feet)[0], places, self.frames)))

    def _judge(self, camera: Watched, places: Feet, starts: Sequence[Floats]) -> Refined:
        """Find the correction that fits best at times it was not fitted to, or why there is none."""
        pairs = pair(moved_feet(starts[0], camera.feet)[0], places, _PAIRED_M, GATE)
        frames = len(np.unique(places.frame[pairs.places]))
        if len(pairs.feet) < LEAST_PAIRS or frames < LEAST_FRAMES:
            return _uncorrected(
                camera,
                f"it can't be compared: {len(pairs.feet)} of its boxes in {frames} frames are near people seen by the "
                f"others, and {LEAST_PAIRS} in {LEAST_FRAMES} are needed",
            )
        models, limit = self._determined(camera, places.xy_m[pairs.places])
        block = np.arange(self.frames) * _BLOCKS // self.frames
        folds = [taken(camera.feet, block[camera.feet.frame] % 2 != fold) for fold in range(2)]
        fits = {"": [np.eye(3)] * 2}
        fits |= {model: [self._best_fit(model, camera, feet, places, starts) for feet in folds] for model in models}
        costs_of = {model: self._held_out(camera, places, pair_, block) for model, pair_ in fits.items()}
        best = min(costs_of, key=lambda model: float(np.nanmean(costs_of[model])))
        chosen = next(model for model in costs_of if _is_as_good(costs_of[model], costs_of[best]))
        matrix = self._best_fit(chosen, camera, camera.feet, places, fits[chosen]) if chosen else np.eye(3)
        moves = _moves(camera, np.eye(3), matrix)
        if not _is_sure(costs_of[""] - costs_of[chosen]) or moves < LEAST_MOVED_M:
            chosen = ""
        before, after = self._residuals(camera, places, fits[chosen], block)
        if camera.why_held:
            return _uncorrected(camera, camera.why_held, before, before)
        if not chosen:
            return _uncorrected(camera, "it agrees with the others", before, after)
        return Refined(camera.name, chosen, matrix, moves, before, after, limit=limit)

    def _best_fit(self, model: str, camera: Watched, feet: Feet, places: Feet, starts: Sequence[Floats]) -> Floats:
        """Return the correction of a kind that fits some feet of a camera best, from any of these starts."""
        corrector = Corrector.around(model, camera.feet.xy_m, camera.plane.homography, camera.plane.lens)
        fits = [corrector.fit(feet, places, start) for start in starts]
        return fits[int(np.argmin([self._cost(feet, places, fit) for fit in fits]))]

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
            feet = taken(camera.feet, block[camera.feet.frame] % 2 == fold)
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
            feet = taken(camera.feet, block[camera.feet.frame] % 2 == fold)
            now, which = moved_feet(fit, feet)
            pairs = pair(now, places, _PAIRED_M)
            apart = feet.xy_m[which[pairs.feet]] - places.xy_m[pairs.places]
            before.append(np.hypot(*apart.T))
            after.append(pairs.distance_m)
        return _residual(np.concatenate(before)), _residual(np.concatenate(after))


def _uncorrected(camera: Watched, why: str, before: Residual | None = None, after: Residual | None = None) -> Refined:
    return Refined(camera.name, "", np.eye(3), 0.0, before, after, why)


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


def calibrate_cameras(
    opened: log.Log,
    names: Sequence[str],
    reference: Sequence[str],
    clock_offset_s: Mapping[str, float],
    progress: Callable[[int, int], None],
) -> tuple[list[Refined], dict[str, float], dict[str, GroundPlane]]:
    """Compare cameras, and return what was found about each, their clocks' offsets, and planes that are corrected.

    Parameters
    ----------
    opened : Log
    names : sequence of str
        The cameras; without any, all that have detections and a measured ground plane.
    reference : sequence of str
        Cameras that are right; without any, what most cameras agree on is.
    clock_offset_s : mapping of str to float
        How much later than the others the times of a camera are; others are estimated.
    progress : callable
        Called as ``progress(done, total)``.

    Raises
    ------
    McaptrackError
        If there are fewer than two cameras to compare, or if two are and none is a reference.
    """
    compared, names_of = _compared(opened, names)
    reference = [names_of.get(name.strip("/"), name.strip("/")) for name in reference]
    chosen = [camera.prefix[1:] for camera in compared]
    for parameter, cameras_given in (("reference", reference), ("clock_offset_s", clock_offset_s)):
        for name in cameras_given:
            if name not in chosen:
                raise McaptrackError(f"`{parameter}=` has {name}, which is not compared; {', '.join(chosen)} are")
    sources = read_sources(opened, compared, clock_offset_s).sources
    cameras = {camera.prefix[1:]: camera for camera in compared}
    sources = [_given(opened, source, cameras[source.view.name], reference) for source in sources]
    chosen = [source.view.name for source in sources]  # without those that have no messages, which was said
    if len(chosen) < 2:
        raise McaptrackError(f"{opened.path}: only {chosen[0]} has boxes; two cameras are compared at least")
    if lacking := sorted(set(reference) - set(chosen)):
        raise McaptrackError(f"`reference=` has {', '.join(lacking)} without any box; {', '.join(chosen)} have some")
    if len(chosen) < 3 and not reference:
        raise McaptrackError(
            f"{opened.path}: of two cameras, {' and '.join(chosen)}, the log doesn't say which is right; name that one "
            "with `reference=`"
        )
    held = {
        source.view.name: _why_held(opened, cameras[source.view.name], source.view.planes, reference)
        for source in sources
    }
    return _in_turns(sources, held, frozenset(reference), clock_offset_s, progress)


def _compared(opened: log.Log, names: Sequence[str]) -> tuple[list[Camera], dict[str, str]]:
    """Return the cameras to compare, and for each name of a camera the one that results use."""
    scenes = scenes_of(opened)
    ours = [camera for camera in cameras_of(opened) if camera.prefix not in scenes]
    names_of = {name.strip("/"): camera.prefix[1:] for camera in ours for name in camera.names}
    wanted = [camera.prefix[1:] for camera in cameras_named(opened, names, ours)]
    if len(wanted) == 1:
        raise McaptrackError(
            f"`cameras=` has {wanted[0]} alone; two cameras with detections and measured ground planes are compared at "
            "least"
        )
    chosen, why = fusable(opened, wanted)
    if not chosen:
        raise McaptrackError(
            f"{opened.path}: two cameras with detections and measured ground planes are compared at least: {why}"
        )
    if why and names:
        raise McaptrackError(f"{opened.path}: {why}; leave that out of `cameras=`")
    if why:
        warn(f"left out: {why}", "left-out")
    return [camera_at(opened, f"/{name}") for name in chosen], names_of


def _given(opened: log.Log, source: Source, camera: Camera, reference: Sequence[str]) -> Source:
    """A camera with the plane that was given, not with the one that was corrected before, unless it is a reference."""
    topic = given_plane(camera)
    if source.view.name in reference or topic == camera.ground_plane:
        return source
    planes = tuple(planes_in(opened, topic))
    return source._replace(view=replace(source.view, planes=planes))


def _why_held(opened: log.Log, camera: Camera, planes: Planes, reference: Sequence[str]) -> str:
    """The reason why a plane stays as it is; "" if it may be corrected."""
    if camera.prefix[1:] in reference:
        return REFERENCE
    provenance = provenance_of(opened, given_plane(camera))
    if provenance is not None and provenance.transform not in ("ingest",):
        return "its plane follows from the transforms of the recording, which stay as they are"
    if len(planes) > 1:
        return "its ground plane changes over time"
    return ""


def _in_turns(
    sources: list[Source],
    held: Mapping[str, str],
    reference: frozenset[str],
    given_offset_s: Mapping[str, float],
    progress: Callable[[int, int], None],
) -> tuple[list[Refined], dict[str, float], dict[str, GroundPlane]]:
    """Correct planes, estimate the offsets of clocks with them, and correct them again at the right times."""
    fuser = FootFuser()
    offset_s = {source.view.name: given_offset_s.get(source.view.name, 0.0) for source in sources}
    refined: list[Refined] = []
    planes = {source.view.name: source.view.planes[0][1] for source in sources}
    for turn in range(_TURNS):
        gathered = Gathered(sources, fuser)

        def report(done: int, total: int, turn: int = turn) -> None:
            progress(turn * total + done, _TURNS * total)

        refined = _refiner(gathered, sources, held, reference, fuser, report).refine()
        planes = {camera.name: corrected(camera, sources) for camera in refined}
        right = [
            source._replace(view=replace(source.view, planes=((source.view.planes[0][0], planes[source.view.name]),)))
            if len(source.view.planes) == 1
            else source
            for source in sources
        ]
        if turn == _TURNS - 1:
            break
        late_s = compared_cameras(right, fuser, given_offset_s).offset_s
        late = {name: seconds for name, seconds in late_s.items() if name not in given_offset_s and seconds}
        if not late:
            progress(1, 1)
            break
        offset_s |= late
        sources = set_back(sources, late)
    return refined, offset_s, {camera.name: planes[camera.name] for camera in refined if camera.model}


def corrected(camera: Refined, sources: Sequence[Source]) -> GroundPlane:
    """The plane of a camera with its correction."""
    plane = next(source.view.planes[0][1] for source in sources if source.view.name == camera.name)
    if not camera.model:
        return plane
    matrix = camera.matrix @ plane.matrix
    if plane.lens is None:
        # Any scale is the same plane; that of the one before is kept, so that numbers stay comparable.
        matrix *= np.linalg.norm(plane.matrix) / np.linalg.norm(matrix)
    return replace(plane, homography=tuple(matrix.ravel().tolist()))


def _refiner(
    gathered: Gathered,
    sources: Sequence[Source],
    held: Mapping[str, str],
    reference: frozenset[str],
    fuser: FootFuser,
    progress: Callable[[int, int], None],
) -> Refiner:
    """Gather the feet that each camera sees at the times of the slowest one, for a ``Refiner``."""
    every = -(-len(gathered) // _COMPARED)
    frames = [frame for number, frame in enumerate(gathered) if number % every == 0]
    size = [len(frame.rows) for frame in frames]
    rows = np.concatenate([frame.rows for frame in frames])
    number = np.repeat(np.arange(len(frames)), size)
    cameras = []
    for index, source in enumerate(sources):
        mine = np.flatnonzero(rows["camera"] == index)
        part = rows[mine]
        xy_m = np.stack([part["x_m"], part["y_m"]], axis=-1)
        cov = np.stack([part[name] for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2")], axis=-1)
        feet = Feet(xy_m, cov, number[mine])
        view = source.view
        cameras.append(Watched(view.name, feet, part["class_id"].astype(np.int64), view.planes[0][1], held[view.name]))
    seconds = float(np.ptp([frame.t_ns for frame in frames])) / NS_PER_S if len(frames) > 1 else 1.0
    reach = (fuser.max_sigma, fuser.max_distance_m)
    return Refiner(cameras, len(frames), len(frames) / max(seconds, 1e-9), reference, reach, progress)


@dataclass(frozen=True)
class CorrectedPlanes:
    """The changes of a log that calibrating makes.

    Attributes
    ----------
    topics : dict of str to str
        The topics of corrected planes by camera.
    new : dict of str to Made
        The planes that the log does not have yet, by topic.
    unchanged : tuple of str
        Cameras with a corrected plane that the log has already.
    dropped : tuple of str
        Topics of corrections that no longer hold.
    """

    topics: Mapping[str, str]
    new: Mapping[str, Made]
    unchanged: tuple[str, ...]
    dropped: tuple[str, ...]


def changes_of(opened: log.Log, refined: Sequence[Refined], planes: Mapping[str, GroundPlane]) -> CorrectedPlanes:
    """Return the corrected planes to write, and those to drop.

    Raises McaptrackError if other software recorded a channel with the name of a corrected plane.
    """
    compared = sorted(camera.name for camera in refined if camera.before is not None)
    topics: dict[str, str] = {}
    new: dict[str, Made] = {}
    dropped: list[str] = []
    for camera in refined:
        base = given_plane(camera_at(opened, f"/{camera.name}"))
        topic = corrected_plane(base)
        if camera.model:
            if not may_replace(opened, topic, REFINE):
                raise McaptrackError(f"{opened.path}: {topic} {describe_origin(opened, topic)}, and is not replaced")
            topics[camera.name] = topic
            parameters = {**as_json(camera), "compared_with": [name for name in compared if name != camera.name]}
            plane = _plane_below(opened, base, planes[camera.name], parameters)
            if not _is_there(opened, topic, plane):
                new[topic] = plane
        elif camera.before is not None and camera.why != REFERENCE and topic in opened.channels:
            dropped += [topic] if may_replace(opened, topic, REFINE) else []
    unchanged = tuple(name for name, topic in topics.items() if topic not in new)
    return CorrectedPlanes(topics, new, unchanged, tuple(dropped))


def _plane_below(opened: log.Log, base: str, plane: GroundPlane, parameters: dict[str, Any]) -> Made:
    """Return a plane at the time of the one that was given."""
    before = opened.frames(base, GROUND_PLANE)[0]
    frame_id = frame_id_of(opened.channels[base].metadata)
    how = Provenance(REFINE, parameters, base, digest_of(opened, base), frame_id=frame_id)
    return Made.of(GROUND_PLANE, [Frame(before.t_ns, before.index, plane_to_rows(plane))], how)


def write_changes(opened: log.Log, changes: CorrectedPlanes, output: Path | None) -> bool:
    """Write corrected planes into the log, or into a copy, and drop those that no longer hold; return if it changed."""
    outlines = {plane.provenance.input + views.SCENE_SUFFIX for plane in changes.new.values()} & opened.channels.keys()
    write(RunState(opened, "", dict(changes.new), outlines | {*changes.dropped}), output)
    return bool(changes.new or changes.dropped)


def _is_there(opened: log.Log, topic: str, channel: Made) -> bool:
    provenance = provenance_of(opened, topic)
    return provenance is not None and provenance.to_metadata() == channel.provenance.to_metadata()


def as_json(camera: Refined) -> dict[str, Any]:
    """Return what was found about a camera as values of JSON."""

    def residual(distances: Any) -> dict[str, Any] | None:
        if distances is None:
            return None
        median, p90 = (None if np.isnan(value) else round(value, 4) for value in distances[:2])
        return {"median_m": median, "p90_m": p90, "pairs": distances.pairs}

    return {
        "correction": camera.model or None,
        "matrix": [round(value, 12) for value in camera.matrix.ravel().tolist()] if camera.model else None,
        "moved_m": round(camera.moved_m, 4),
        "before": residual(camera.before),
        "after": residual(camera.after),
    }
