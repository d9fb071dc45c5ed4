"""SORT (Bewley et al., ICIP 2016), the lifecycle of tracks, which the trackers derived from it share, and ByteTrack.

A Kalman filter for each track predicts its box; detections are assigned to tracks by similarity. A track is confirmed,
and written, after ``min_hits`` of detections without a miss; it terminates after ``max_age`` without a detection.

Letters: N detections, K tracks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from types import MappingProxyType
from typing import ClassVar, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.choices import CameraMotionUse
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry import kalman
from mcaptrack.geometry.affine import IDENTITY
from mcaptrack.geometry.arrays import Bools, Floats, Indices
from mcaptrack.geometry.assignment import max_weight_matching, one_to_one
from mcaptrack.geometry.boxes import columns_to_boxes, overlapping
from mcaptrack.geometry.camera_path import CameraPath
from mcaptrack.geometry.clocks import NS_PER_S, FrameClock
from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.geometry.plane import GroundPlane, Planes, moved_planes, plane_at
from mcaptrack.notices import warn
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.framing import join_frames
from mcaptrack.transforms.protocol import context, option, parameters, setting

#: Number of frames that are converted at once.
_BLOCK_FRAMES = 64
#: A detection with such a score says as much of whether a track is real as others in so many nanoseconds.
_SURE_SCORE: Final = 0.5
_SURE_NS: Final = NS_PER_S // 10
#: Number of classes that a warning lists at most.
_MAX_LISTED = 20


# Detections and tracks as arrays: frames to measurements, the table of tracks, and tracks to frames.
#
# Several frames are converted at once, because the overhead of NumPy calls is per call.
#
# Letters: N detections in a frame, K tracks, F frames.


#: Rows of the table of tracks, below those of the filter: score and class of the last detection; time since it (0 if it
#: is in this frame); how long the track has been detected without a miss; track id. ``tracker`` says the unit of time.
SCORE, CLASS, SINCE_UPDATE, HIT_STREAK, ID = range(kalman.STATE_ROWS, kalman.STATE_ROWS + 5)
#: Number of rows that all trackers have; a tracker may add its own below.
SHARED_ROWS: Final = ID + 1
#: Limits of boxes, so that areas and aspect ratios are finite.
_MIN_PX: Final = 1e-4
_MAX_PX: Final = 1e12


@dataclass(slots=True)
class Measurements:
    """Detections of a frame, one column each: left, top, right, bottom; the filter's measurement; score and class."""

    columns: Floats

    def __len__(self) -> int:
        return int(self.columns.shape[1])

    @property
    def corners(self) -> Floats:
        """Left, top, right, bottom (4, N)."""
        return self.columns[:4]

    @property
    def measured(self) -> Floats:
        """Measurements of the filter: centre, area and aspect ratio (4, N)."""
        return self.columns[4:8]

    @property
    def score(self) -> Floats:
        """Scores (N,), NaN where the detector gives none."""
        row: Floats = self.columns[8]
        return row

    @property
    def class_id(self) -> Floats:
        """Classes (N,)."""
        row: Floats = self.columns[9]
        return row

    def take(self, at: Indices) -> Measurements:
        """The detections with these indices, in this order."""
        return Measurements(self.columns.take(at, axis=1))


def frames_to_measurements(
    frames: Sequence[Frame], min_score: float | None, class_id: int | None
) -> tuple[Floats, NDArray[np.int64]]:
    """The detections of F frames with at least this score, or none, and of this class; degenerate boxes are left out.

    Returns the columns of ``Measurements`` for all frames, and the ends of each frame's columns (F + 1,), from 0.
    """
    joined = join_frames(DETECTIONS, frames)
    rows, ends = joined.rows, joined.ends
    boxes = columns_to_boxes(rows)
    kept = (boxes[:, 2:] > _MIN_PX).all(axis=1) & (np.abs(boxes) < _MAX_PX).all(axis=1)
    if min_score is not None:
        kept &= ~(rows["score"] < min_score)
    if class_id is not None:
        kept &= rows["class_id"] == class_id
    if not kept.all():
        ends = np.concatenate([[0], kept.cumsum()])[ends]
        rows, boxes = rows[kept], boxes[kept]
    boxes = boxes.T
    columns = np.concatenate(
        [boxes[:2], boxes[:2] + boxes[2:], kalman.measure(boxes), [rows["score"]], [rows["class_id"]]]
    )
    return columns, ends


class BoxTracks:
    """K tracks, one column of ``table`` each: the filter's state, the rows named above, then ``extra_rows``."""

    def __init__(self, extra_rows: int = 0) -> None:
        self.table: Floats = np.empty((SHARED_ROWS + extra_rows, 0))

    def __len__(self) -> int:
        return int(self.table.shape[1])

    @property
    def state(self) -> Floats:
        """The states of the filters (17, K); writing to it writes to the tracks."""
        return self.table[: kalman.STATE_ROWS]

    def keep(self, kept: Bools) -> None:
        """Terminate all other tracks."""
        self.table = self.table.compress(kept, axis=1)  # rows stay whole in memory, unlike with [:, kept]

    def initiate(self, first_id: int, detections: Measurements) -> None:
        """Start a track at each of these detections, with ids from ``first_id``."""
        new = np.empty((len(self.table), len(detections)))
        kalman.start(new[: kalman.STATE_ROWS], detections.measured)
        new[SCORE : CLASS + 1] = detections.columns[8:]
        new[SINCE_UPDATE : HIT_STREAK + 1] = 0.0
        new[ID] = range(first_id, first_id + len(detections))
        new[SHARED_ROWS:] = np.nan
        self.table = np.concatenate([self.table, new], axis=1)

    def update(self, at: Indices, detections: Measurements, hit: Floats | float) -> None:
        """Correct track ``at[i]`` with detection i (N,); its hit streak grows by ``hit``, (N,) or for all."""
        table = self.table.take(at, axis=1)
        kalman.correct(table[: kalman.STATE_ROWS], detections.measured)
        table[SCORE : CLASS + 1] = detections.columns[8:]
        table[SINCE_UPDATE] = 0.0
        table[HIT_STREAK] += hit
        self.table[:, at] = table


def tracks_to_frames(frames: Sequence[Frame], table: Floats, ends: Sequence[int], planes: Planes) -> list[Frame]:
    """Rows of F frames from columns of a table, of which ``ends`` (F + 1,) are the ends of each frame's columns."""
    boxes = kalman.corners(table)
    boxes[2:] -= boxes[:2]
    rows = TRACKS.empty(table.shape[1])
    rows["track_id"] = table[ID]
    rows["x_px"], rows["y_px"], rows["w_px"], rows["h_px"] = boxes
    rows["x_m"] = rows["y_m"] = np.nan
    rows["score"] = table[SCORE]
    rows["observed"] = True
    rows["source_id"] = -1
    rows["class_id"] = table[CLASS]
    spans = list(pairwise(ends))
    if planes:
        for frame, (low, high) in zip(frames, spans, strict=True):
            plane = plane_at(planes, frame.t_ns)
            if plane is not None and low < high:
                rows["x_m"][low:high], rows["y_m"][low:high] = plane.boxes_to_metres(boxes[:, low:high].T).T
    return [Frame(frame.t_ns, frame.index, rows[low:high]) for frame, (low, high) in zip(frames, spans, strict=True)]


# Candidate pairs of detections and tracks, and their assignment. Letters: N detections, K tracks, P pairs.


Cost = Literal["iou", "pixels", "metres"]


class CandidatePairs(NamedTuple):
    """Pairs that pass the gate: detection (P,), track (P,), similarity (P,) in (0, 1]; ``shape`` is (N, K).

    ``class_id`` (P,) are their classes, None if all are associated together.
    """

    detection: Indices
    track: Indices
    similarity: Floats
    shape: tuple[int, int]
    class_id: Floats | None = None

    def select(self, kept: Bools | Indices) -> CandidatePairs:
        """Some of the pairs."""
        of = None if self.class_id is None else self.class_id[kept]
        return CandidatePairs(self.detection[kept], self.track[kept], self.similarity[kept], self.shape, of)


def iou_pairs(boxes: Floats, predicted: Floats, area: Floats, predicted_area: Floats) -> CandidatePairs:
    """Pairs of detected boxes (4, N) and predicted ones (4, K) that overlap; their similarity is IoU.

    Boxes are left, top, right, bottom; areas are (N,) and (K,).
    """
    return CandidatePairs(*overlapping(boxes, predicted, area, predicted_area), (boxes.shape[1], predicted.shape[1]))


def distance_pairs(boxes: Floats, predicted: Floats, gate: float, plane: GroundPlane | None) -> CandidatePairs:
    """Pairs by the distance of centres in pixels or, given a plane, of positions on the ground in metres.

    Similarity is 1 at distance 0 and falls to 0 at the gate; gating excludes pairs beyond it.
    """
    here, predicted_at = (_positions(corners, plane) for corners in (boxes, predicted))
    pairs = Pairing(here, predicted_at, np.full(here.shape[1], gate))
    distance = np.hypot(*(pairs.of_first(here) - pairs.of_second(predicted_at)))
    is_near = distance < gate  # NaN, above the horizon, is beyond every gate
    return CandidatePairs(*pairs.chosen(is_near), 1 - distance[is_near] / gate, pairs.shape)


def _positions(corners: Floats, plane: GroundPlane | None) -> Floats:
    if plane is None:
        return (corners[:2] + corners[2:]) / 2
    return plane.boxes_to_metres(np.concatenate([corners[:2], corners[2:] - corners[:2]]).T).T


def associate(pairs: CandidatePairs, min_similarity: float) -> tuple[Indices, Indices]:
    """Assign detections to tracks; returns the detections and the tracks of pairs of at least ``min_similarity``.

    If no detection and no track is in two pairs, these are the assignment. Otherwise the assignment with the largest
    total similarity is taken, and pairs below ``min_similarity`` are removed afterwards, as in the original program.

    Each class is associated by itself, as if there were no others.
    """
    if not len(pairs.detection):
        return pairs.detection, pairs.track
    if pairs.class_id is not None:
        alone = pairs._replace(class_id=None)
        by_class = [
            associate(alone.select(pairs.class_id == kind), min_similarity) for kind in np.unique(pairs.class_id)
        ]
        detections, tracks = zip(*by_class, strict=True)
        return np.concatenate(detections), np.concatenate(tracks)
    above = pairs.similarity > min_similarity
    count = np.count_nonzero(above)
    if count:
        near = pairs if count == len(above) else pairs.select(above)
        if one_to_one(near.detection, near.track):
            return near.detection, near.track
    (detection, track), similarity = max_weight_matching((pairs.detection, pairs.track), pairs.similarity, pairs.shape)
    if count == len(above):
        return detection, track
    enough = similarity >= min_similarity
    return detection[enough], track[enough]


class AssociationInput(NamedTuple):
    """The detections of a frame and the tracks, before association.

    Attributes
    ----------
    detections : Measurements
    tracks : BoxTracks
        After the prediction of the filters.
    predicted : (4, K) of float, in px
        Predicted boxes of the tracks: left, top, right, bottom.
    age : float
        How much tracks aged since the previous frame, in the unit of ``SINCE_UPDATE``.
    frames : int
        Number of frames since the previous one: 1, or more where frames are missing.
    plane : GroundPlane or None
        For distances in metres.
    one_class : bool
        Whether all detections so far have the same class.
    """

    detections: Measurements
    tracks: BoxTracks
    predicted: Floats
    age: float
    frames: int
    plane: GroundPlane | None
    one_class: bool


#: What trackers do about the motion of the camera.

# Headings of the options in the help.
_ASSOCIATION: Final = "Association"
_DETECTIONS: Final = "Detections"
_LIFE: Final = "Begin and end of tracks"


@dataclass(frozen=True, kw_only=True)
@parameters
class Sort:
    """Track detections over time.

    Reads detections, writes tracks: one row per frame for each person who is tracked and detected in it. SORT matches
    detections with the positions that Kalman filters predict for the tracks.

    Parameters
    ----------
    max_age_s : float
        A track ends after this many seconds without a detection.
    max_age_frames : int or None
        A track ends after this many frames without a detection, instead of --max-age-s.
    min_hits_s : float
        A track is written once it was detected without a break for this many seconds; a detection with a score of
        0.5 or more counts for 0.1 s at least.
    min_hits_frames : int or None
        A track is written once it was detected in this many frames in a row, instead of --min-hits-s.
    cost : str
        How detections and tracks are compared: overlap of boxes (iou), or distance in pixels or in metres.
    min_iou : float
        Least overlap (IoU) of a detection with a track's predicted box.
    max_distance_px : float
        With cost pixels: largest distance of a box's centre from the predicted one, in pixels.
    max_distance_m : float
        With cost metres: largest distance on the ground from the predicted position, in metres.
    min_score : float or None
        Ignore detections with a lower score.
    class_id : int or None
        Ignore detections of other classes.
    across_classes : bool
        A track may continue with a detection of another class; it then has the class of most of its detections.
    camera_motion : str
        Move predictions with the camera: if it moves or has cuts (auto), also if it only shakes (on), or never
        (off).

    Examples
    --------
    A person walks through eight pictures, and is missed in one:

    >>> from mcaptrack.schema import DETECTIONS, Frame
    >>> def row(t):
    ...     box = {"x_px": [100.0 + 3 * t], "y_px": [50.0], "w_px": [40.0], "h_px": [120.0]}
    ...     return DETECTIONS.rows(class_id=[1], **box)
    >>> frames = [Frame(t * 100_000_000, t, DETECTIONS.empty() if t == 4 else row(t)) for t in range(8)]
    >>> [tracks.rows["track_id"].tolist() for (tracks,) in Sort(min_hits_s=0.0)(frames)]
    [[1], [1], [1], [1], [], [1], [1], [1]]

    References
    ----------
    A. Bewley et al., "Simple Online and Realtime Tracking", ICIP 2016.
    """

    max_age_s: float = option(1.4, least=0.0, search=(0.2, 4.0), theme=_LIFE)
    max_age_frames: int | None = setting(None, least=0, theme=_LIFE)
    min_hits_s: float = option(0.3, least=0.0, search=(0.0, 1.0), theme=_LIFE)
    min_hits_frames: int | None = setting(None, least=0, theme=_LIFE)
    cost: Cost = setting("iou", theme=_ASSOCIATION)
    min_iou: float = option(0.2, least=0.0, most=1.0, search=(0.05, 0.6), theme=_ASSOCIATION)
    max_distance_px: float = setting(60.0, least=0.0, theme=_ASSOCIATION)
    max_distance_m: float = setting(1.0, least=0.0, theme=_ASSOCIATION)
    min_score: float | None = option(None, theme=_DETECTIONS)
    class_id: int | None = setting(None, least=0, most=2**31 - 1, theme=_DETECTIONS)
    across_classes: bool = setting(False, theme=_DETECTIONS)
    camera_motion: CameraMotionUse = setting("auto", theme=_ASSOCIATION)
    ground_planes: Planes = context(tuple)
    camera_path: CameraPath | None = context(lambda: None, is_recorded=False)

    reads: ClassVar[Schema] = DETECTIONS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": TRACKS})
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": 0.0})

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        run, report = _Run(self, self._empty_tracks()), _FilterReport(self)
        coming = iter(frames)
        while block := list(islice(coming, _BLOCK_FRAMES)):
            columns, ends = frames_to_measurements(block, self.min_score, self.class_id)
            report.count(block, int(ends[-1]))
            run.note_classes(columns[9])
            spans = pairwise(ends.tolist())
            parts = [self._step(run, f, Measurements(columns[:, a:b])) for f, (a, b) in zip(block, spans, strict=True)]
            written, written_ends = np.concatenate(parts, axis=1), np.cumsum([0, *(p.shape[1] for p in parts)])
            tracked = tracks_to_frames(block, written, written_ends.tolist(), run.planes)
            yield from ((frame,) for frame in tracked)
        report.warn()

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why there are no tracks, for a warning."""
        count = sum(len(frame.rows) for frame in given)
        return f"no track of {count} detections is confirmed (min_hits_s): too few pictures a second, perhaps"

    def _step(self, run: _Run, frame: Frame, detections: Measurements) -> Floats:
        """Take one frame; returns the columns of the tracks that are written in it."""
        tracks, before_ns, passed_frames = run.tracks, run.last_ns, run.tick(frame.t_ns)
        self._predict(run, passed_frames)
        if run.camera_path is not None and before_ns is not None:
            self._compensate(tracks, run.camera_path.between(before_ns, frame.t_ns))
        plane = plane_at(run.planes, frame.t_ns) if self.cost == "metres" else None
        predicted = kalman.corners(tracks.state)
        step = AssociationInput(detections, tracks, predicted, run.age, passed_frames, plane, run.one_class)
        matched, track = self._associate(step)
        if len(matched):
            hits = detections.take(matched)
            self._update(tracks, track, hits, run.hit_of(hits), passed_frames)
        detected = len(matched)
        if detected < len(detections):
            starts = self._can_start(detections)
            starts[matched] = False
            births = detections.take(starts.nonzero()[0])
            self._initiate(tracks, run.next_id, births)
            run.next_id += len(births)
            detected += len(births)
        table = tracks.table
        if detected == len(tracks):  # no missed detection
            return table[:SHARED_ROWS].compress(run.is_starting | (table[HIT_STREAK] >= run.min_hits), axis=1)
        since_update = table[SINCE_UPDATE]
        is_written = since_update == 0
        table[HIT_STREAK] *= is_written
        if not run.is_starting:
            is_written &= table[HIT_STREAK] >= run.min_hits
        written: Floats = table[:SHARED_ROWS].compress(is_written, axis=1)
        if since_update.max() > run.max_age:
            tracks.keep(since_update <= run.max_age)
        return written

    @staticmethod
    def _predict(run: _Run, frames: int) -> None:
        """Age and predict all tracks by a number of frames."""
        tracks = run.tracks
        tracks.table[SINCE_UPDATE] += run.age
        if frames > 1:  # a gap in the log: terminate tracks that would have been terminated in it
            tracks.keep(tracks.table[SINCE_UPDATE] <= run.max_age + run.frame_age)
        if run.clock.stretch != 1.0:
            kalman.stretch(tracks.state, run.clock.stretch)
        for _ in range(frames if len(tracks) else 0):  # predict through missing frames, too
            kalman.predict(tracks.state)

    def _compensate(self, tracks: BoxTracks, motion: Floats | None) -> None:
        """Move predictions (2, 3) with the camera. At a cut, where there is no motion, all tracks end."""
        if motion is None:
            tracks.keep(np.zeros(len(tracks), bool))
        elif motion is not IDENTITY and len(tracks):
            self._move(tracks, motion)

    def _candidate_pairs(self, step: AssociationInput, min_iou: float) -> tuple[CandidatePairs, float]:
        """The pairs that pass the gate, and the least similarity of an assignment."""
        boxes, predicted = step.detections.corners, step.predicted
        if self.cost == "iou":
            pairs = iou_pairs(boxes, predicted, step.detections.measured[2], step.tracks.table[2])
            return self._of_same_class(step, pairs), min_iou
        if self.cost == "metres" and step.plane is None:
            raise McaptrackError("cost metres needs a ground plane, and none is known")
        gate = self.max_distance_px if self.cost == "pixels" else self.max_distance_m
        return self._of_same_class(step, distance_pairs(boxes, predicted, gate, step.plane)), 0.0

    def _of_same_class(self, step: AssociationInput, pairs: CandidatePairs) -> CandidatePairs:
        """The pairs of a detection and a track of the same class; all pairs with ``across_classes``."""
        if self.across_classes or step.one_class or not len(pairs.detection):
            return pairs
        class_id = step.detections.class_id[pairs.detection]
        pairs = pairs._replace(class_id=class_id)
        same = class_id == step.tracks.table[CLASS, pairs.track]
        return pairs if same.all() else pairs.select(same)

    # What derived trackers override.

    def _empty_tracks(self) -> BoxTracks:
        return BoxTracks()

    def _move(self, tracks: BoxTracks, motion: Floats) -> None:
        """Move all that is remembered of tracks by the motion (2, 3) of the camera."""
        kalman.move(tracks.state, motion)

    def _associate(self, step: AssociationInput) -> tuple[Indices, Indices]:
        """Indices of detections and of the tracks that they are assigned to."""
        return associate(*self._candidate_pairs(step, self.min_iou))

    def _can_start(self, detections: Measurements) -> Bools:
        """Mask the detections that may start a track if they are assigned to none. Returns a new array."""
        return np.ones(len(detections), bool)

    def _initiate(self, tracks: BoxTracks, first_id: int, detections: Measurements) -> None:
        """Start a track at each of these detections."""
        tracks.initiate(first_id, detections)

    def _update(
        self, tracks: BoxTracks, at: Indices, detections: Measurements, hit: Floats | float, frames: int
    ) -> None:
        """Correct track ``at[i]`` with detection i, ``frames`` after the previous frame."""
        tracks.update(at, detections, hit)


def used_path(path: CameraPath | None, use: CameraMotionUse) -> CameraPath | None:
    """The path of a camera if tracks take it into account."""
    return path if path is not None and (use == "on" or (use == "auto" and path.matters)) else None


class _FilterReport:
    """Counts the detections that pass the filters of class and score, and warns if none does."""

    def __init__(self, options: Sort) -> None:
        self._options, self._count, self._kept, self._without_box = options, 0, 0, 0
        self._classes: set[int] = set()
        self._highest = -np.inf

    def count(self, frames: Sequence[Frame], kept: int) -> None:
        """Count frames, and how many of their detections passed the filters."""
        self._kept += kept
        self._without_box += sum(int(np.isnan(frame.rows["x_px"]).sum()) for frame in frames)
        for rows in (frame.rows for frame in frames if len(frame.rows) and not self._kept):
            self._count += len(rows)
            self._classes.update(rows["class_id"].tolist())
            self._highest = max(self._highest, float(np.nanmax(rows["score"], initial=-np.inf)))

    def warn(self) -> None:
        """Warn if no detection passed, and of detections that have a position in metres only."""
        if self._without_box:
            warn(f"{self._without_box} detections have no box in pixels and are left out", "left-out")
        wanted, least = self._options.class_id, self._options.min_score
        if self._kept or not self._count:
            return
        if wanted is not None and wanted not in self._classes:
            listed = ", ".join(map(str, sorted(self._classes)[:_MAX_LISTED]))
            warn(f"no detection has class {wanted}, so there are no tracks; the classes are {listed}", "left-out")
        elif least is not None and self._highest < least:
            text = f"the highest is {self._highest:g}"
            warn(f"no detection has a score of {least:g} or more, so there are no tracks; {text}", "left-out")


class _Run:
    """The state of one run: its tracks, its clock, and the units of ages and hit streaks at the current frame.

    Ages and streaks are in nanoseconds, or in frames with the options in frames. ``age`` is how much tracks age at this
    frame, ``frame_age`` how much at a usual frame, ``hit`` how much a detection adds to a streak. ``is_starting`` is
    true while the log is shorter than ``min_hits``: all detected tracks are written then.
    """

    def __init__(self, options: Sort, tracks: BoxTracks) -> None:
        self.tracks, self.clock, self.next_id = tracks, FrameClock(), 1
        self.age = self.frame_age = self.max_age = self.hit = self.min_hits = 0.0
        self.is_starting = True
        self._options = options
        self._class_id: float | None = None
        self.one_class = True
        self._count = 0
        self.last_ns: int | None = None
        self.camera_path = used_path(options.camera_path, options.camera_motion)
        self.planes = moved_planes(options.ground_planes, self.camera_path)

    def note_classes(self, class_id: Floats) -> None:
        """Note the classes of the next detections."""
        if len(class_id) and self.one_class:
            self._class_id = class_id[0] if self._class_id is None else self._class_id
            self.one_class = bool((class_id == self._class_id).all())

    def hit_of(self, detections: Measurements) -> Floats | float:
        """The part (N,) of a streak that each detection adds, or that all add."""
        if self._options.min_hits_frames is not None or self.hit >= _SURE_NS:
            return self.hit
        return np.where(detections.score >= _SURE_SCORE, _SURE_NS, self.hit)  # NaN is not sure

    def tick(self, t_ns: int) -> int:
        """Take the time of the next frame; returns the number of frames since the previous one."""
        options = self._options
        if self.last_ns is None:
            self._first_ns = self.last_ns = t_ns
        frames, passed_ns, usual_ns = self.clock.tick(t_ns), t_ns - self.last_ns, self.clock.interval_ns
        self._count, self.last_ns = self._count + 1, t_ns
        if options.max_age_frames is not None:
            self.age, self.frame_age, self.max_age = frames, 1, options.max_age_frames
        else:
            # At least 1: a miss counts even if two frames have one time. Limits are rounded to the nearest frame.
            self.age, self.frame_age = max(passed_ns, 1), usual_ns
            self.max_age = options.max_age_s * NS_PER_S + usual_ns / 2
        if options.min_hits_frames is not None:
            self.hit, self.min_hits = 1, options.min_hits_frames
            self.is_starting = self._count <= self.min_hits
        else:
            self.hit = min(max(passed_ns, 0), 2 * usual_ns)
            self.min_hits = options.min_hits_s * NS_PER_S - usual_ns / 2
            self.is_starting = t_ns - self._first_ns < self.min_hits
        return frames


@dataclass(frozen=True, kw_only=True)
@parameters
class ByteTrack(Sort):
    """ByteTrack: association in two steps.

    Detections with a high score are matched with all tracks first, then those with a low score with the remaining
    tracks that were detected in the previous frame: people who are partly hidden score low, but stand where predicted.

    Parameters
    ----------
    high_score : float
        Detections with at least this score, or without a score, are matched first.
    new_score : float
        Detections with at least this score may begin a track.
    low_min_iou : float
        Least overlap (IoU) for detections with a low score, which are matched second.

    Examples
    --------
    A detection with a low score continues a track, and starts none:

    >>> from mcaptrack.schema import DETECTIONS, Frame
    >>> def row(score):
    ...     box = {"x_px": [100.0], "y_px": [50.0], "w_px": [40.0], "h_px": [120.0]}
    ...     return DETECTIONS.rows(score=[score], class_id=[1], **box)
    >>> frames = [Frame(t * 100_000_000, t, row(0.9 if 5 <= t < 10 else 0.3)) for t in range(15)]
    >>> [len(tracks.rows) for (tracks,) in ByteTrack()(frames)]
    [0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1]

    References
    ----------
    Y. Zhang et al., "ByteTrack: Multi-Object Tracking by Associating Every Detection Box", ECCV 2022.
    """

    high_score: float = setting(0.5, search=(0.2, 0.9))
    new_score: float = setting(0.6, search=(0.2, 0.9))
    low_min_iou: float = setting(0.5, least=0.0, most=1.0, search=(0.2, 0.8))

    def _associate(self, step: AssociationInput) -> tuple[Indices, Indices]:
        pairs, min_similarity = self._candidate_pairs(step, self.min_iou)
        high = ~(step.detections.score < self.high_score)  # NaN is high
        if high.all():
            return associate(pairs, min_similarity)
        is_high = high[pairs.detection]
        detection, track = associate(pairs.select(is_high), min_similarity)
        remaining = step.tracks.table[SINCE_UPDATE] == step.age  # detected in the previous frame
        remaining[track] = False
        low = pairs.select(~is_high & remaining[pairs.track])
        low_detection, low_track = associate(low, self.low_min_iou if self.cost == "iou" else min_similarity)
        return np.concatenate([detection, low_detection]), np.concatenate([track, low_track])

    def _can_start(self, detections: Measurements) -> Bools:
        starts: Bools = ~(detections.score < self.new_score)
        return starts
