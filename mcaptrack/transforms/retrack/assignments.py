"""Assignments of samples to tracks, collected while tracks run online. Letters: C assignments."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, steps_passed
from mcaptrack.geometry.ragged import find_rows, group_index
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.classes import first_classes
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import frame_numbers, has_any, joined_parts, row_ends, spans_of, split_rows, unique_values
from mcaptrack.transforms.motion_limits import ClassNames, limits_by_class, units_m
from mcaptrack.transforms.retrack.motion_model import WALK_M_PER_S


class Tracks(NamedTuple):
    """Samples that are assigned to tracks, (C,) each: step, track, input id, sample, position (C, 2) in units, the
    descriptor of what is seen of it, or -1, and the online track.
    """

    step: Ints
    track: Ints
    source: Ints
    sample: Ints
    xy_m: Floats
    look: Ints
    online: Ints

    @property
    def order(self) -> Ints:
        """The order by track, then step."""
        return np.lexsort((self.step, self.track))


def column(frames: FrameColumns, name: str) -> NDArray[Any]:
    """A column of all rows of tracks, (N,).

    A person who is seen for an hour has 9,000 samples at 2.5 Hz. What re-tracking holds for each of them, from the
    first step to the last, are numbers: some columns, assignments, the states of its filters, and what is seen of it
    (74 bytes, see ``appearance``). Rows of tracks (153 bytes) and of predictions (840 bytes for each sample) are made
    part by part, and kept as ``FrameColumns``, most of which is not in memory.
    """
    parts = [part.rows[name].copy() for _, _, part in joined_parts(TRACKS, frames)]
    return np.concatenate([np.empty(0, TRACKS.dtype[name]), *parts])


class Assignments:
    """Assignments: each has a step, a track and a sample. Samples are named by step and input id."""

    def __init__(self) -> None:
        self._parts = [np.empty((3, 0), np.int64)]
        self._confirmed: list[tuple[int, Ints]] = []

    def add(self, step: Ints | int, tracks: Ints, sources: Ints) -> None:
        """Assign the samples of the input ids ``sources`` (C,) at ``step`` to ``tracks`` (C,)."""
        self._parts.append(np.stack([np.broadcast_to(step, tracks.shape), tracks, sources]))

    def confirm(self, step: int, tracks: Ints) -> None:
        """Confirm assignments of ``tracks`` (C,) up to ``step``; once this was called, unconfirmed ones are dropped."""
        self._confirmed.append((step, tracks))

    def of(self, samples: FrameColumns, steps: Ints) -> tuple[Ints, Ints, Ints, Ints]:
        """Steps, tracks, input ids and samples of the assignments, in the order in which they were made; (C,) each.

        ``samples`` are those of all ``steps``. A track has one sample a step.
        """
        step, track, source = np.concatenate(self._parts, axis=1)
        row = find_rows((column(samples, "track_id"), np.repeat(steps, np.diff(samples.ends))), (source, step))
        kept = np.flatnonzero((row >= 0) & self._is_confirmed(step, track))
        return step[kept], track[kept], source[kept], row[kept]

    def _is_confirmed(self, step: Ints, track: Ints) -> Bools:
        """Mask the assignments (C,) that are not later than the last confirmation of their track."""
        if not self._confirmed:
            return np.ones(len(step), bool)
        until = np.full(int(track.max(initial=0)) + 1, np.iinfo(np.int64).min)
        for when, tracks in self._confirmed:  # rising
            until[tracks] = when
        return step <= until[track]


class OnlinePass:
    """Online re-tracking of one log: made of its samples, of which it has read all then.

    It leaves for ``offline`` which track had which sample, the ``steps`` (F,) of the frames, and the noise of measured
    positions. ``passed`` (F,) is by how many steps time advanced. It holds for the whole log what ``column`` says, and
    no rows.
    """

    noise_m: float

    def __init__(self, frames: FrameColumns, rate_hz: float, bridged_s: float) -> None:
        self.assignments, self.samples = Assignments(), frames
        passed = [steps_passed(ns, rate_hz, bridged_s) for ns in np.diff(frames.t_ns).tolist()]
        self.passed = np.array([1, *passed][: len(frames)], np.int64)
        self.steps = np.cumsum(self.passed) - 1

    def outputs(self) -> tuple[FrameColumns, FrameColumns]:
        """The online tracks and their predictions, from the past alone, a frame for each step."""
        raise NotImplementedError


# Re-tracking of each class by itself: links, swaps and gaps never join tracks of different classes.
#
# Letters: C classes, F frames.


class Movers(NamedTuple):
    """The unit and the kind of the tracks of one class.

    All of re-tracking is made for people. Other classes are re-tracked in a unit of length in which they move as people
    do: ``unit_m`` metres. ``on_ground`` says that a tracker made their tracks in metres, with velocities, and not
    from boxes in pictures: detections don't merge where objects occlude one another, and the tracker has confirmed each
    track by the scores of its detections. It knows more than samples say, unless people were detected at no higher rate
    than that of the samples; those are re-tracked like others. ``usual_score`` is the median score of the log,
    ``drift_m_per_s`` how much velocities change within a second, None for what the options say.
    """

    unit_m: float = 1.0
    on_ground: bool = False
    usual_score: float = 1.0
    drift_m_per_s: float | None = None


#: Speeds are measured over so many steps, and so many say something. What is slower stands; where most go so much
#: faster than walkers, units are larger.
_PACE_STEPS, _LEAST_SPEEDS = 3, 30
_STANDS_M_PER_S, _FAST = 0.5, 1.5
#: People in pictures.
PEOPLE: Final[Movers] = Movers()


def usual_score(frames: Sequence[Frame]) -> float:
    """The median score of the observed rows of a log; 1 where there are none."""
    parts = [part.rows["score"][part.rows["observed"]] for _, _, part in joined_parts(TRACKS, frames)]
    scores = np.concatenate([np.empty(0, np.float32), *parts])
    scores = scores[np.isfinite(scores)]
    return max(float(np.median(scores)), 1e-6) if len(scores) else 1.0


def movers_of(frames: Sequence[Frame], class_names: ClassNames, usual_score: float, class_limits: str = "") -> Movers:
    """The unit and the kind of the tracks in frames of one class."""
    first = next((frame for frame in frames if len(frame.rows)), None)
    if first is None:
        return PEOPLE
    number = int(first.rows["class_id"][0])
    limits = limits_by_class([number], class_names, class_limits)[number]
    has_velocities = not has_any(TRACKS, frames, lambda rows: ~np.isfinite(rows["vx_m_per_s"]))
    on_ground = has_velocities and not (limits.name == "person" and _is_slow(frames))
    drift_m_per_s = limits.drift_m_per_s if on_ground else None
    (unit_m,) = units_m([number], class_names, class_limits)
    return Movers(unit_m, on_ground, usual_score, drift_m_per_s)


def at_pace_of_log(movers: Movers, frames: Sequence[Frame]) -> Movers:
    """The same kind of tracks in a larger unit, if most of those that go anywhere go faster than people walk.

    Runners and skaters, bicycles, a recording that is read at another rate: in this unit they walk. It takes the whole
    log to know it, so that it is for offline tracks.
    """
    speeds = [np.empty(0)]
    for _, _, part in joined_parts(TRACKS, frames):
        order = np.lexsort((part.row_ns, part.rows["track_id"]))
        track, x_m, y_m = (part.rows[name][order] for name in ("track_id", "x_m", "y_m"))
        before, after = order[:-_PACE_STEPS], order[_PACE_STEPS:]
        passed_s = (part.row_ns[after] - part.row_ns[before]) / NS_PER_S
        way_m = np.hypot(*(values[_PACE_STEPS:] - values[:-_PACE_STEPS] for values in (x_m, y_m)))
        usable = (track[_PACE_STEPS:] == track[:-_PACE_STEPS]) & (passed_s > 0)
        speeds.append(way_m[usable] / passed_s[usable] / movers.unit_m)
    going = np.concatenate(speeds)
    going = going[going > _STANDS_M_PER_S]
    faster = float(np.median(going)) / WALK_M_PER_S if len(going) >= _LEAST_SPEEDS else 0.0
    return movers._replace(unit_m=movers.unit_m * faster) if faster > _FAST else movers


def _is_slow(frames: Sequence[Frame]) -> bool:
    """Whether tracks are at no higher rate than their samples: pictures are counted by the frames' ``index``."""
    passed = np.diff(frame_numbers(frames))
    return bool(len(passed)) and float(np.median(passed)) <= 1


def split_classes(frames: FrameColumns) -> list[FrameColumns]:
    """The frames of each class (C,), all F of them, in the order in which classes appear.

    The class of a track is that of its first row.
    """
    if len(unique_values(TRACKS, frames, "class_id")) < 2:
        return [frames]
    columns = [
        (part.rows["track_id"].copy(), part.rows["class_id"].copy()) for _, _, part in joined_parts(TRACKS, frames)
    ]
    track_id, class_of_row = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    ends = row_ends(frames)
    frame_of = group_index(np.diff(ends))
    ids, track = np.unique(track_id, return_inverse=True)
    class_id = first_classes(track, class_of_row, len(ids))[track]
    classes, first = np.unique(class_id, return_index=True)
    # Ids of tracks tell classes apart that appear in one frame: the order of rows has no influence.
    begins = zip(classes.tolist(), frame_of[first].tolist(), strict=True)
    lowest = [track_id[(frame_of == frame) & (class_id == number)].min() for number, frame in begins]
    order = np.lexsort((np.array(lowest), frame_of[first]))
    numbers = frame_numbers(frames)
    out = [FrameCollector(TRACKS) for _ in classes]
    for low, high, part in joined_parts(TRACKS, frames):
        here = class_id[ends[low] : ends[high]]
        for number, collector in zip(classes[order].tolist(), out, strict=True):
            mine = here == number
            collector.extend(part.t_ns, numbers[low:high], np.append(0, mine.cumsum())[part.ends], part.rows[mine])
    return [collector.done() for collector in out]


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
