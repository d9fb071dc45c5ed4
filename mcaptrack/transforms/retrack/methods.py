"""The transforms of re-tracking, one for each method, and named sets of their options (profiles).

Each class is re-tracked by itself. Letters: C classes, F frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, repeat
from types import MappingProxyType
from typing import Any, ClassVar, Final, TypeAlias

import numpy as np

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.clocks import seconds_to_ns
from mcaptrack.geometry.plane import Planes
from mcaptrack.geometry.ragged import group_index
from mcaptrack.notices import warn
from mcaptrack.predictors import warn_if_weak
from mcaptrack.schema import APPEARANCE, DECISIONS, TRACKS, WORLDS, Frame, Rows
from mcaptrack.schema.classes import first_classes
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns, collect
from mcaptrack.schema.framing import filtered_rows, joined_parts, spans_of, split_rows
from mcaptrack.schema.resampling import resample_parts
from mcaptrack.transforms.forecasts import Forecaster
from mcaptrack.transforms.protocol import ModelCard
from mcaptrack.transforms.retrack.appearance import AppearanceCalibration, appearance_rows
from mcaptrack.transforms.retrack.consistency import ConsistencyPass
from mcaptrack.transforms.retrack.in_pictures import link_in_picture
from mcaptrack.transforms.retrack.offline import offline_tracks
from mcaptrack.transforms.retrack.options import (
    APPEARANCE_OUTPUT,
    WORLDS_OUTPUT,
    ConsistencyOptions,
    LikelihoodOptions,
    RetrackOptions,
)
from mcaptrack.transforms.retrack.passes import (
    KeptIds,
    LikelihoodPass,
    OnlinePass,
    at_pace_of_log,
    motion_model,
    movers_of,
    usual_score,
)
from mcaptrack.transforms.to_video_rate import steady_s, to_metres


@dataclass(frozen=True, kw_only=True)
class Retrack(LikelihoodOptions):
    """Repair tracks: re-tracking by likelihood.

    Reads samples; writes repaired tracks that use the whole log (offline), repaired tracks that use the past alone
    (online), predictions from the latter, and what was decided offline, with how likely each decision is right.

    Examples
    --------
    A person walks on under another track id; re-tracking gives both tracks one id:

    >>> from mcaptrack.schema import TRACKS
    >>> def row(track_id, x_m):
    ...     return TRACKS.rows(track_id=[track_id], x_m=[x_m], y_m=[0.0], observed=[True], source_id=[-1])
    >>> frames = [Frame(t * 400_000_000, t, row(7 if t < 10 else 8, t / 2)) for t in range(20)]
    >>> {id for offline, *_ in Retrack()(frames) for id in offline.rows["track_id"].tolist()}
    {1}
    """

    #: The class of its online pass.
    new_pass: ClassVar[type[Any]] = LikelihoodPass

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        seen: list[AppearanceCalibration] = []
        yield from _retrack(self, frames, seen)
        object.__setattr__(self, "_seen", seen)

    def model_card(self) -> ModelCard:
        """Whether appearance told tracks apart in the last run, of the class that was seen most; empty without."""
        seen: Sequence[AppearanceCalibration] | None = getattr(self, "_seen", None)
        if seen is None or self.looks is None:
            return ModelCard()
        most = max(seen, key=lambda calibration: calibration.tracks, default=None)
        return ModelCard(facts={"appearance": "not used"} if most is None else most.facts())


@dataclass(frozen=True, kw_only=True)
class RetrackByConsistency(ConsistencyOptions):
    """Repair tracks by prediction consistency: Algorithm 1 of the paper.

    Tracks and observations are compared by their predictions. The profile "paper" has the values of the paper.

    References
    ----------
    Yu and Zhou, "Towards Robust Human Trajectory Prediction in Raw Videos", IROS 2021.
    """

    #: Rows of people outside of the picture stay, as in the paper (see ``pipeline.visible``).
    keeps_unseen: ClassVar[bool] = True
    new_pass: ClassVar[type[Any]] = ConsistencyPass

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        return _retrack(self, frames, [])


Retracking: TypeAlias = Retrack | RetrackByConsistency


def _retrack(
    options: Retracking, frames: Iterable[Frame], seen: list[AppearanceCalibration]
) -> Iterator[tuple[Frame, ...]]:
    """For each frame the offline tracks, the online tracks and their predictions, and further outputs that the options
    write; each class by itself. How appearance tells tracks apart is added to ``seen``, for each class.
    """
    warn_if_weak(options.predictor)
    if options.leaves_unchanged:
        yield from _keep_ids(options, frames, seen)
        return
    frames = _placed(collect(TRACKS, frames))
    classes = [frames] if options.across_classes else split_classes(frames)
    score = usual_score(frames)
    outputs = [_retracked(options, part, score, seen) for part in classes]
    if len(classes) > 1:
        yield from join_classes([list(map(collect, options.writes.values(), part)) for part in outputs])
        return
    for parts in zip(*outputs[0], strict=True):
        yield tuple(frame._replace(rows=frame.rows.copy()) for frame in parts)  # what is kept can't be written to


def _placed(frames: FrameColumns) -> FrameColumns:
    """The frames without the rows that have no position in metres; how many these are is said."""
    placed = filtered_rows(TRACKS, frames, lambda part: np.isfinite(part.rows["x_m"]) & np.isfinite(part.rows["y_m"]))
    lost = int(frames.ends[-1] - placed.ends[-1])
    if not lost:
        return frames
    warn(f"{lost:,} rows of tracks have no position in metres, and are left out", "left-out")
    return placed


def _keep_ids(
    options: RetrackOptions, frames: Iterable[Frame], seen: list[AppearanceCalibration]
) -> Iterator[tuple[Frame, ...]]:
    """For each frame tracks that are linked in the picture, if the method does that; the input and its predictions."""
    settings = options.predictor, options.horizon_s, options.min_history, options.rate_hz
    forecaster = Forecaster(*settings, adapt=options.adapt)
    linked: Iterator[Rows] | None = None
    stored: Iterator[Rows] = repeat(APPEARANCE.empty())
    if options.worlds:
        warn(
            "`worlds=` finds nothing to write: without a measured ground plane tracks are not decided",
            "option-not-used",
        )
    if options.links_in_picture:
        frames = collect(TRACKS, frames)
        limits = options.filled_s, options.link_confidence, options.across_classes
        boxes = frames if options.boxes is None else options.boxes
        result = link_in_picture(boxes, *limits, options.fixed_ids, options.looks, options.rate_hz)
        seen.extend([] if result.calibration is None else [result.calibration])
        linked = _sampled(result.frames, frames.t_ns, steady_s(boxes, options.filled_s), options.ground_planes)
        if (looks := options.stored_looks) is not None:
            stored = appearance_rows(looks, result.track_of(looks.track_id, looks.t_ns), frames.t_ns)
    for frame in frames:
        online = frame.rows[frame.rows["observed"]]
        offline = frame.rows if linked is None else next(linked)
        rows = {"": offline, "online": online, "predictions": forecaster.predict(frame)}
        rows |= {"decisions": DECISIONS.empty(), APPEARANCE_OUTPUT: next(stored), WORLDS_OUTPUT: WORLDS.empty()}
        yield tuple(frame._replace(rows=rows[name]) for name in options.writes)
    forecaster.warn()


def _sampled(tracks: FrameColumns, at_ns: Ints, gap_s: float, planes: Planes) -> Iterator[Rows]:
    """The rows of linked tracks at each of the times ``at_ns``, with gaps of up to ``gap_s`` interpolated."""
    for first, last, rows, at in resample_parts(tracks, at_ns, seconds_to_ns(gap_s)):
        rows["source_id"][~rows["observed"]] = -1
        to_metres(rows, at_ns[at], planes)
        ends = np.searchsorted(at, np.arange(first, last + 1)).tolist()
        yield from (rows[low:high] for low, high in pairwise(ends))


def _retracked(
    options: Retracking, frames: FrameColumns, score: float, seen: list[AppearanceCalibration]
) -> list[Iterable[Frame]]:
    """The outputs of re-tracking without regard to classes; ``score`` is the usual one of the log."""
    movers = movers_of(frames, options.class_names, score, options.class_limits)
    online: OnlinePass = (KeptIds if movers.on_ground else options.new_pass)(options, movers, frames)
    run = online
    if options.follows_speed and not movers.on_ground and (paced := at_pace_of_log(movers, frames)) != movers:
        movers, run = paced, options.new_pass(options, paced, frames)
    model = motion_model(options, run.noise_m, movers)
    rows, calibration = offline_tracks(options, model, run, movers)
    seen.extend([] if calibration is None else [calibration])
    causal, predictions = online.outputs()
    outputs: dict[str, Iterable[Frame]] = {"online": causal, "predictions": predictions}
    for name, of_frames in rows.items():
        outputs[name] = map(Frame, frames.t_ns.tolist(), frames.numbers.tolist(), of_frames)
    return [outputs[name] for name in options.writes]


def split_classes(frames: FrameColumns) -> list[FrameColumns]:
    """The frames of each class (C,), all F of them, in the order in which classes appear.

    The class of a track is that of its first row.
    """
    columns = [part.rows[["track_id", "class_id"]].copy() for _, _, part in joined_parts(TRACKS, frames)]
    rows = np.concatenate([TRACKS.empty()[["track_id", "class_id"]], *columns])
    ids, track = np.unique(rows["track_id"], return_inverse=True)
    class_id = first_classes(track, rows["class_id"], len(ids))[track]
    # Ids of tracks tell classes apart that appear in one frame: the order of rows has no influence.
    order = np.lexsort((rows["track_id"], group_index(np.diff(frames.ends))))
    classes, first = np.unique(class_id[order], return_index=True)
    if len(classes) < 2:
        return [frames]
    out = {number: FrameCollector(TRACKS) for number in classes[np.argsort(first)].tolist()}
    for low, high, part in joined_parts(TRACKS, frames):
        here = class_id[frames.ends[low] : frames.ends[high]]
        for number, collector in out.items():
            mine, numbers = here == number, frames.numbers[low:high]
            collector.extend(part.t_ns, numbers, np.append(0, mine.cumsum())[part.ends], part.rows[mine])
    return [collector.done() for collector in out.values()]


def join_classes(classes: Sequence[Sequence[FrameColumns]]) -> Iterator[tuple[Frame, ...]]:
    """The outputs of several classes (C,) as one: ids follow on those of the class before. A tuple for each frame.

    All outputs of a class have tracks with the same ids: offline and online tracks, predictions and decisions.
    """
    above = np.cumsum([0, *(max(map(_highest_id, outputs)) for outputs in classes)])
    return zip(*(_joined(frames, above) for frames in zip(*classes, strict=True)), strict=True)


def _highest_id(frames: FrameColumns) -> int:
    """The highest id of a track; 0 if there is none."""
    parts = joined_parts(frames.schema, frames)
    return max((int(part.rows["track_id"].max(initial=0)) for _, _, part in parts), default=0)


def _joined(frames: Sequence[FrameColumns], above: Ints) -> Iterator[Frame]:
    """One output of all classes (C,) as one; ids of each are raised ``above`` those of the classes before."""
    schema = frames[0].schema
    for low, high in spans_of(np.sum([frame.ends for frame in frames], axis=0)):
        counts = [np.diff(frame.ends[low : high + 1]) for frame in frames]
        rows = schema.joined([frame.rows(low, high) for frame in frames])
        raised = rows["track_id"] + np.repeat(above[: len(frames)], [int(count.sum()) for count in counts])
        rows["track_id"] = np.where(rows["track_id"] < 0, rows["track_id"], raised)
        order = np.argsort(np.concatenate([group_index(count) for count in counts]), kind="stable")
        ends = np.cumsum(np.sum(counts, axis=0))
        yield from split_rows(frames[0].t_ns[low:high], frames[0].numbers[low:high], rows.take(order), ends)


_PAPER: Final = RetrackByConsistency(
    predictor="cv",
    distance="mean",
    covariance="paper",
    max_distance=3.0,
    gate_m=None,
    noise_m=0.5,
    same_id_bonus=0.0,
    max_age_s=3.2,
    alpha=0.5,
    beta=0.5,
    min_history=4,
    min_hits=2,
    interpolated=True,
    link_s=0.0,
    resolve_swaps=False,
    track_confidence=0.0,
    smooth=False,
)

#: Values of all parameters by name. "paper" is Algorithm 1 with Eq. 1 to 3 to the letter; where the paper gives no
#: number (sigma, d_min, t_max, the probation) it is that of the authors' program. "authors" is what their program does:
#: the largest distance instead of the mean, near pairs first, tracks that start from the smoothed past, and assignments
#: that two matches in a row confirm. "default" is this project's method.
PROFILES: Final[Mapping[str, Retracking]] = MappingProxyType(
    {
        "default": Retrack(),
        "paper": _PAPER,
        "authors": replace(
            _PAPER, distance="max", priority_distance=0.15, birth="smoothed", backfill="all", trim_ends=True
        ),
    }
)
