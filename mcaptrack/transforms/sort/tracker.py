"""SORT (Bewley et al., ICIP 2016), and the life of a track that it shares with its descendants.

A Kalman filter a track says where its box will be; boxes and tracks are paired by their likeness; a track is shown once
it has been seen for long enough and dropped when it has been missed for too long.

Letters: N boxes, K tracks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from types import MappingProxyType
from typing import ClassVar, Final, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry import kalman
from mcaptrack.geometry.arrays import Bools, Floats, Indices
from mcaptrack.geometry.clocks import NS_PER_S, FrameClock
from mcaptrack.geometry.plane import GroundPlane, Planes, plane_at
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Schema
from mcaptrack.transforms.protocol import check_options, context, option
from mcaptrack.transforms.sort.affinity import Cost, Pairs, by_distance, by_overlap, pair
from mcaptrack.transforms.sort.tracks import CLASS, MISSED, SHARED_ROWS, STREAK, Seen, Tracks, look, write

#: How many frames are read and written at once.
_BLOCK = 64
#: So many classes are named.
_NAMED = 20


class Moment(NamedTuple):
    """A frame with its boxes and the tracks before they are paired.

    ``expected`` is where the filters expect the tracks' boxes, left, top, right, bottom (4, K); ``age`` by how much
    tracks have aged since the frame before, ``steps`` how many frames ago that was; ``one_class`` says that boxes so
    far are of one class only.
    """

    seen: Seen
    tracks: Tracks
    expected: Floats
    age: float
    steps: int
    plane: GroundPlane | None
    one_class: bool


# Headings of the options in the help.
_ASSOCIATION: Final = "Association"
_DETECTIONS: Final = "Detections"
_LIFE: Final = "Begin and end of tracks"


@dataclass(frozen=True, kw_only=True)
class Sort:
    """Track detections over time.

    Reads detections, writes tracks: one row per frame for each person who is tracked and detected in it. SORT matches
    detections with the positions that Kalman filters predict for the tracks.
    """

    max_age_s: float = option(
        1.4, "a track ends after this many seconds without a detection", least=0.0, search=(0.2, 4.0), theme=_LIFE
    )
    max_age_frames: int | None = option(
        None, "a track ends after this many frames without a detection, instead of --max-age-s", least=0, theme=_LIFE
    )
    min_hits_s: float = option(
        0.3,
        "a track is written once it was detected without a break for this many seconds",
        least=0.0,
        search=(0.0, 1.0),
        theme=_LIFE,
    )
    min_hits_frames: int | None = option(
        None,
        "a track is written once it was detected in this many frames in a row, instead of --min-hits-s",
        least=0,
        theme=_LIFE,
    )
    cost: Cost = option(
        "iou",
        "how detections and tracks are compared: overlap of boxes (iou), or distance in pixels or in metres",
        theme=_ASSOCIATION,
    )
    min_iou: float = option(
        0.2,
        "least overlap (IoU) of a detection with a track's predicted box",
        least=0.0,
        most=1.0,
        search=(0.05, 0.6),
        theme=_ASSOCIATION,
    )
    max_distance_px: float = option(
        60.0,
        "with --cost pixels: largest distance of a box's centre from the predicted one, in pixels",
        least=0.0,
        theme=_ASSOCIATION,
    )
    max_distance_m: float = option(
        1.0,
        "with --cost metres: largest distance on the ground from the predicted position, in metres",
        least=0.0,
        theme=_ASSOCIATION,
    )
    min_score: float | None = option(None, "ignore detections with a lower score", theme=_DETECTIONS)
    class_id: int | None = option(
        None, "ignore detections of other classes", least=0, most=2**31 - 1, theme=_DETECTIONS
    )
    mix_classes: bool = option(False, "a track may continue with a detection of another class", theme=_ASSOCIATION)
    ground_planes: Planes = context(tuple)

    reads: ClassVar[Schema] = DETECTIONS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": TRACKS})
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": 0.0})

    def __post_init__(self) -> None:
        check_options(self)

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        life, passed = _Life(self, self._no_tracks()), _Passed(self)
        coming = iter(frames)
        while block := list(islice(coming, _BLOCK)):
            columns, ends = look(block, self.min_score, self.class_id)
            passed.count(block, int(ends[-1]))
            life.notice_classes(columns[9])
            spans = pairwise(ends.tolist())
            parts = [self._step(life, f, Seen(columns[:, a:b])) for f, (a, b) in zip(block, spans, strict=True)]
            shown, shown_ends = np.concatenate(parts, axis=1), np.cumsum([0, *(p.shape[1] for p in parts)])
            yield from ((frame,) for frame in write(block, shown, shown_ends.tolist(), self.ground_planes))
        passed.warn()

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why no rows came of frames, for a warning."""
        boxes = sum(len(frame.rows) for frame in given)
        return f"none of {boxes} boxes is followed for long enough (min_hits_s): too few pictures a second, perhaps"

    def _step(self, life: _Life, frame: Frame, seen: Seen) -> Floats:
        """Take one frame; returns the columns of the tracks that are shown in it."""
        tracks, steps = life.tracks, life.tick(frame.t_ns)
        self._age(life, steps)
        plane = plane_at(self.ground_planes, frame.t_ns) if self.cost == "metres" else None
        moment = Moment(seen, tracks, kalman.corners(tracks.state), life.age, steps, plane, life.one_class)
        box, track = self._pair(moment)
        if len(box):
            self._see(tracks, track, seen.take(box), life.hit, steps)
        found = len(box)
        if found < len(seen):
            new = self._may_begin(seen)
            new[box] = False
            born = seen.take(new.nonzero()[0])
            self._begin(tracks, life.next_id, born)
            life.next_id += len(born)
            found += len(born)
        table = tracks.table
        if found == len(tracks):  # no missed detection
            return table[:SHARED_ROWS].compress(life.early | (table[STREAK] >= life.min_hits), axis=1)
        missed = table[MISSED]
        here = missed == 0
        table[STREAK] *= here
        if not life.early:
            here &= table[STREAK] >= life.min_hits
        shown: Floats = table[:SHARED_ROWS].compress(here, axis=1)
        if missed.max() > life.max_age:
            tracks.keep(missed <= life.max_age)
        return shown

    @staticmethod
    def _age(life: _Life, steps: int) -> None:
        """Move all tracks ``steps`` frames on."""
        tracks = life.tracks
        tracks.table[MISSED] += life.age
        if steps > 1:  # a gap in the log: terminate tracks that would have been terminated in it
            tracks.keep(tracks.table[MISSED] <= life.max_age + life.frame_age)
        if life.clock.stretch != 1.0:
            kalman.stretch(tracks.state, life.clock.stretch)
        for _ in range(steps):  # predict through missing frames, too
            kalman.predict(tracks.state)

    def _likeness(self, moment: Moment, least: float) -> tuple[Pairs, float]:
        """The pairs of a moment that are possible at all, and from which likeness on they may be paired."""
        seen = moment.seen
        if self.cost == "iou":
            pairs = by_overlap(seen.corners, moment.expected, seen.measured[2], moment.tracks.table[2])
        elif self.cost == "pixels":
            pairs, least = by_distance(seen.corners, moment.expected, self.max_distance_px, None), 0.0
        elif moment.plane is None:
            raise McaptrackError("cost metres needs a ground plane, and none is known")
        else:
            pairs, least = by_distance(seen.corners, moment.expected, self.max_distance_m, moment.plane), 0.0
        return self._of_one_class(moment, pairs), least

    def _of_one_class(self, moment: Moment, pairs: Pairs) -> Pairs:
        """Without the pairs of a box and a track of different classes, unless these may mix."""
        if self.mix_classes or moment.one_class or not len(pairs.box):
            return pairs
        same = moment.seen.class_id[pairs.box] == moment.tracks.table[CLASS, pairs.track]
        return pairs if same.all() else pairs.where(same)

    # What the descendants do otherwise.

    def _no_tracks(self) -> Tracks:
        return Tracks()

    def _pair(self, moment: Moment) -> tuple[Indices, Indices]:
        """Boxes and tracks that belong together."""
        return pair(*self._likeness(moment, self.min_iou))

    def _may_begin(self, seen: Seen) -> Bools:
        """Which boxes may begin a track if they belong to none, as an array of its own."""
        return np.ones(len(seen), bool)

    def _begin(self, tracks: Tracks, first_id: int, seen: Seen) -> None:
        tracks.add(first_id, seen)

    def _see(self, tracks: Tracks, at: Indices, seen: Seen, hit: float, steps: int) -> None:
        """Track ``at[i]`` is seen in box i, ``steps`` frames after the frame before."""
        tracks.see(at, seen, hit)


class _Passed:
    """Which boxes pass the class and the score that are asked for, to be said if there are none at all."""

    def __init__(self, options: Sort) -> None:
        self._options, self._seen, self._kept = options, 0, 0
        self._classes: set[int] = set()
        self._highest = -np.inf

    def count(self, frames: Sequence[Frame], kept: int) -> None:
        """Count frames, and how many of their detections passed the filters."""
        self._kept += kept
        for rows in (frame.rows for frame in frames if len(frame.rows) and not self._kept):
            self._seen += len(rows)
            self._classes.update(rows["class_id"].tolist())
            self._highest = max(self._highest, float(np.nanmax(rows["score"], initial=-np.inf)))

    def warn(self) -> None:
        """Warn of tracks that are empty because no box passed."""
        wanted, least = self._options.class_id, self._options.min_score
        if self._kept or not self._seen:
            return
        if wanted is not None and wanted not in self._classes:
            there = ", ".join(map(str, sorted(self._classes)[:_NAMED]))
            warn(f"no detection has class {wanted}, so there are no tracks; the classes are {there}", "left-out")
        elif least is not None and self._highest < least:
            words = f"the highest is {self._highest:g}"
            warn(f"no detection has a score of {least:g} or more, so there are no tracks; {words}", "left-out")


class _Life:
    """A run: its tracks and its clock, and what ages and streaks are at the frame that is being looked at.

    They are nanoseconds, or frames where frames were asked for. ``age`` is by how much tracks age, ``frame_age`` by how
    much in a usual frame; ``hit`` is what being seen adds to a streak; ``early`` says that no streak can be long yet.
    """

    def __init__(self, options: Sort, tracks: Tracks) -> None:
        self.tracks, self.clock, self.next_id = tracks, FrameClock(), 1
        self.age = self.frame_age = self.max_age = self.hit = self.min_hits = 0.0
        self.early = True
        self._options = options
        self._class_id: float | None = None
        self.one_class = True
        self._count = 0

    def notice_classes(self, class_id: Floats) -> None:
        """Take the classes of the boxes to come."""
        if len(class_id) and self.one_class:
            self._class_id = class_id[0] if self._class_id is None else self._class_id
            self.one_class = bool((class_id == self._class_id).all())

    def tick(self, t_ns: int) -> int:
        """Take the time of the next frame; returns how many frames on it is."""
        options = self._options
        if self._count == 0:
            self._first_ns = self._last_ns = t_ns
        steps, passed_ns, usual_ns = self.clock.tick(t_ns), t_ns - self._last_ns, self.clock.interval_ns
        self._count, self._last_ns = self._count + 1, t_ns
        if options.max_age_frames is not None:
            self.age, self.frame_age, self.max_age = steps, 1, options.max_age_frames
        else:
            # Where time stands still a miss is one all the same. To half a frame an age is what was asked for.
            self.age, self.frame_age = max(passed_ns, 1), usual_ns
            self.max_age = options.max_age_s * NS_PER_S + usual_ns / 2
        if options.min_hits_frames is not None:
            self.hit, self.min_hits = 1, options.min_hits_frames
            self.early = self._count <= self.min_hits
        else:
            self.hit = min(max(passed_ns, 0), 2 * usual_ns)
            self.min_hits = options.min_hits_s * NS_PER_S - usual_ns / 2
            self.early = t_ns - self._first_ns < self.min_hits
        return steps
