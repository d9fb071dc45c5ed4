"""Assignments of samples to tracks, collected while tracks run online. Letters: C assignments."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, steps_passed
from mcaptrack.geometry.ragged import find_rows, group_index
from mcaptrack.schema import TRACKS, Frame, Rows
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


# The samples that are re-tracked: the columns that are computed with in memory, whole rows in a temporary file.
#
# A person who is seen for an hour has 9,000 samples at 2.5 Hz. What re-tracking may hold for each of them, from the
# first step to the last, are numbers: the columns below (33 bytes), assignments, the states of its filters, and
# what is seen of it (74 bytes, see ``appearance``). Rows of tracks (153 bytes) and of predictions (840 bytes for
# each sample) are made part by part, and kept as ``FrameColumns``, most of which is not in memory. Letters: N
# samples, F frames.


#: The columns of samples that are held in memory.
HELD: Final = ("track_id", "class_id", "x_m", "y_m", "score", "observed")


class LogSamples:
    """The samples of one log: ``add`` each frame, then read them."""

    def __init__(self) -> None:
        self._collector = FrameCollector(TRACKS)
        self._held = {name: bytearray() for name in HELD}
        self._counts = array("q")

    def add(self, frame: Frame) -> None:
        """Add the samples of a frame."""
        for name, held in self._held.items():
            held.extend(frame.rows[name].tobytes())
        self._counts.append(len(frame.rows))
        self._collector.append(frame)

    def extend(self, t_ns: Ints, numbers: Ints, ends: Ints, rows: Rows) -> None:
        """Add the samples of F frames at once; the arguments are those of ``FrameCollector.extend``."""
        for name, held in self._held.items():
            held.extend(rows[name].tobytes())
        self._counts.extend(np.diff(ends).tolist())
        self._collector.extend(t_ns, numbers, ends, rows)

    def __len__(self) -> int:
        return len(self._held["observed"])

    @property
    def counts(self) -> Ints:
        """The number of samples of each frame, (F,)."""
        return np.array(self._counts, np.int64)

    def column(self, name: str) -> NDArray[Any]:
        """A column of all samples, (N,). One that isn't ``HELD`` is read from the file."""
        if name in self._held:
            return np.frombuffer(bytes(self._held[name]), TRACKS.dtype[name])
        parts = [part.rows[name].copy() for _, _, part in joined_parts(TRACKS, self._frames)]
        return np.concatenate([np.empty(0, TRACKS.dtype[name]), *parts])

    @cached_property
    def _frames(self) -> FrameColumns:
        return self._collector.done()

    def take(self, places: Ints) -> Rows:
        """The rows of samples, as many as there are ``places``; nothing can be added any more."""
        return self._frames.take(places)


@dataclass
class Assignments:
    """Assignments: each has a step, a track and a sample. Samples are named by step and input id."""

    _steps: bytearray = field(default_factory=bytearray)
    _tracks: bytearray = field(default_factory=bytearray)
    _sources: bytearray = field(default_factory=bytearray)
    _confirmed: list[tuple[int, Ints]] = field(default_factory=list)

    def add(self, step: Ints | int, tracks: Ints, sources: Ints) -> None:
        """Assign the samples of the input ids ``sources`` (C,) at ``step`` to ``tracks`` (C,)."""
        for held, values in ((self._steps, step), (self._tracks, tracks), (self._sources, sources)):
            held.extend(np.broadcast_to(np.asarray(values, np.int64), tracks.shape).tobytes())

    def confirm(self, step: int, tracks: Ints) -> None:
        """Confirm assignments of ``tracks`` (C,) up to ``step``; once this was called, unconfirmed ones are dropped."""
        self._confirmed.append((step, tracks))

    def of(self, samples: LogSamples, steps: Sequence[int]) -> tuple[Ints, Ints, Ints, Ints]:
        """Steps, tracks, input ids and samples of the assignments, in the order in which they were made; (C,) each.

        ``samples`` are those of all ``steps``. A track has one sample a step.
        """
        step, track, source = (np.frombuffer(bytes(h), np.int64) for h in (self._steps, self._tracks, self._sources))
        have = samples.column("track_id"), np.repeat(np.array(steps, np.int64), samples.counts)
        row = find_rows(have, (source, step))
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
    """Online re-tracking of one log: ``step`` for each frame, ``finish``, then ``outputs``.

    It leaves for ``offline`` which track had which sample, the samples, the steps, and the noise of measured positions.
    It may hold for the whole log what ``LogSamples`` says, and no rows.
    """

    noise_m: float

    def __init__(self, rate_hz: float, bridged_s: float) -> None:
        self.assignments, self.samples = Assignments(), LogSamples()
        self.steps: list[int] = []
        self._rate_hz, self._bridged_s = rate_hz, bridged_s
        self._last_ns: int | None = None

    def advance(self, t_ns: int) -> int:
        """Add the step of a time; returns by how many steps time advances."""
        last_ns, self._last_ns = self._last_ns, t_ns
        passed = 1 if last_ns is None else steps_passed(t_ns - last_ns, self._rate_hz, self._bridged_s)
        self.steps.append(self.steps[-1] + passed if self.steps else 0)
        return passed

    def step(self, frame: Frame) -> None:
        """One step: association, update, birth and termination of tracks."""
        raise NotImplementedError

    def finish(self) -> None:
        """No more steps come."""

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
