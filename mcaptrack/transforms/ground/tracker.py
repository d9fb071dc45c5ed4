"""The ground tracker: tracks of objects in metres, in a frame that doesn't move.

Letters: N detections, K tracks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from types import MappingProxyType
from typing import ClassVar, Final

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats
from mcaptrack.geometry.clocks import JUMP_S, NS_PER_S
from mcaptrack.notices import warn
from mcaptrack.schema import COVARIANCE_M2, DETECTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.framing import join_frames
from mcaptrack.transforms.ground.association import Cost, associate
from mcaptrack.transforms.ground.fast_starts import fast_starts
from mcaptrack.transforms.ground.lost_tracks import LostTracks, continuations
from mcaptrack.transforms.ground.output import Waiting
from mcaptrack.transforms.ground.state import (
    CLASS,
    DETECTION_ROWS,
    ID,
    IS_CONFIRMED,
    LAST_FRAME,
    MISSED_S,
    SCORE,
    SCORES,
    GroundTracks,
    X,
    Y,
)
from mcaptrack.transforms.motion_limits import (
    LIMITS_HELP,
    LIMITS_PATTERN,
    ClassNames,
    MotionLimits,
    limits_by_class,
    read_limits,
)
from mcaptrack.transforms.protocol import check_options, context, option

_ASSOCIATION: Final = "Association"
_DETECTIONS: Final = "Detections"
_LIFE: Final = "Begin and end of tracks"
#: Tracks that are not confirmed end after this many seconds without a detection.
_TENTATIVE_S: Final = 0.6
#: Number of frames that are converted at once.
_BLOCK_FRAMES: Final = 64
#: Columns of detections in the order of the rows of ``state``.
_COLUMNS: Final = (
    "x_m",
    "y_m",
    "z_m",
    "length_m",
    "width_m",
    "height_m",
    "heading_rad",
    "vx_m_per_s",
    "vy_m_per_s",
    "score",
    "class_id",
    "source_id",
)


@dataclass(frozen=True, kw_only=True)
class GroundTracker:
    """Track detections in metres, such as the 3D boxes of a robot's detector.

    Reads detections with positions in metres, writes tracks with positions, sizes, headings and velocities. Detections
    are assigned on the ground plane, a class at a time, to the positions that Kalman filters predict: at constant
    velocity, and on arcs for vehicles. Limits of their motion come from a table by class.

    Detections of several cameras have covariances, by which they are gated, compared and weighted, and scores that are
    probabilities; from the first such detection on each track has a covariance over both axes.

    Rows are written ``delay_s`` late: a track is written from its first detection on if it is confirmed in that time,
    and gaps that end in it are interpolated.

    Examples
    --------
    A car drives 10 m/s and is missed once; a false box is seen once:

    >>> from mcaptrack.schema import DETECTIONS, Frame
    >>> def row(t):
    ...     x_m = [float(t)] if t != 4 else [500.0]
    ...     return DETECTIONS.rows(x_m=x_m, y_m=[0.0], score=[0.8], class_id=[3])
    >>> frames = [Frame(t * 100_000_000, t, row(t)) for t in range(8)]
    >>> tracks = [frame.rows for (frame,) in GroundTracker(class_names=((3, "car"),))(frames)]
    >>> [rows["track_id"].tolist() for rows in tracks]
    [[1], [1], [1], [1], [1], [1], [1], [1]]
    >>> [bool(rows["observed"][0]) for rows in tracks]
    [True, True, True, True, False, True, True, True]

    References
    ----------
    X. Weng et al., "3D Multi-Object Tracking: A Baseline and New Evaluation Metrics", IROS 2020; Z. Pang et al.,
    "SimpleTrack: Understanding and Rethinking 3D Multi-object Tracking", ECCV Workshops 2022; R. A. Singer,
    "Estimating Optimal Tracking Filter Performance for Manned Maneuvering Targets", IEEE T-AES 1970.
    """

    max_age_s: float = option(
        1.6, "a track ends after this many seconds without a detection", least=0.0, search=(0.2, 4.0), theme=_LIFE
    )
    delay_s: float = option(
        1.0,
        "rows are written this many seconds late, so that false births are taken back and short gaps are filled; 0 for "
        "results that depend on the past alone",
        least=0.0,
        theme=_LIFE,
        flag=False,
    )
    link_s: float = option(
        8.0,
        "a new track continues a lost one that it fits, up to this many seconds after its last detection; 0 for never",
        least=0.0,
        theme=_LIFE,
        flag=False,
    )
    confirm_score: float = option(
        0.9,
        "a track is confirmed once the scores of its detections add up to this; detections without a score count 0.5",
        least=0.0,
        search=(0.3, 4.0),
        theme=_LIFE,
        flag=False,
    )
    birth_score: float = option(
        0.2,
        "detections with a lower score continue tracks, but start none",
        least=0.0,
        most=1.0,
        search=(0.0, 0.8),
        theme=_LIFE,
        flag=False,
    )
    cost: Cost = option(
        "metres",
        "how detections and tracks are compared: distance of their centres, or overlap of their boxes seen from above",
        theme=_ASSOCIATION,
        flag=False,
    )
    min_iou: float = option(
        0.05,
        "with cost iou: least overlap (IoU) of a detection with a track's predicted box",
        least=0.0,
        most=1.0,
        theme=_ASSOCIATION,
    )
    min_score: float | None = option(None, "ignore detections with a lower score", theme=_DETECTIONS)
    class_id: int | None = option(
        None,
        "ignore detections of other classes",
        least=0,
        most=2**31 - 1,
        theme=_DETECTIONS,
        flag=False,
    )
    across_classes: bool = option(
        False,
        "a track may continue with a detection of another class; it then has the class of most of its detections",
        theme=_DETECTIONS,
    )
    class_limits: str = option("", LIMITS_HELP, pattern=LIMITS_PATTERN, theme=_ASSOCIATION)
    class_names: ClassNames = context(tuple, is_recorded=False)

    reads: ClassVar[Schema] = DETECTIONS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": TRACKS})
    #: Trackers associate in the "picture" (pixels) or on the "ground" (metres).
    space: ClassVar[str] = "ground"

    def __post_init__(self) -> None:
        check_options(self)
        read_limits(self.class_limits)

    @property
    def latency_s(self) -> MappingProxyType[str, float]:
        """Rows are final once they are written."""
        return MappingProxyType({"": self.delay_s})

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        run = _Run(self)
        coming = iter(frames)
        while block := list(islice(coming, _BLOCK_FRAMES)):
            for frame, found in zip(block, run.detections(block), strict=True):
                run.step(frame, found)
            yield from ((frame,) for frame in run.waiting.written())
        run.waiting.release(np.inf)
        yield from ((frame,) for frame in run.waiting.written())
        run.warn()

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why there are no tracks, for a warning."""
        count = sum(len(frame.rows) for frame in given)
        return f"no track of {count} detections is confirmed (confirm_score)"


class _Run:
    """The state of one run: its tracks, and the rows that are not written yet."""

    def __init__(self, options: GroundTracker) -> None:
        self._options = options
        self.tracks, self.waiting = GroundTracks(), Waiting()
        self._limits: dict[int, MotionLimits] = {}
        self._lost = LostTracks(options.link_s)
        self._last_ns: int | None = None
        self._frame, self._next_id = 0, 1
        self._left_out = 0

    def step(self, frame: Frame, found: Floats) -> None:
        """Take one frame with these detections, (rows, N)."""
        options, tracks = self._options, self.tracks
        dt = 0.0 if self._last_ns is None else (frame.t_ns - self._last_ns) / NS_PER_S
        self._last_ns = frame.t_ns
        if len(found) > DETECTION_ROWS:
            tracks.expect_covariances()
        if dt > max(JUMP_S, options.max_age_s, options.link_s):
            tracks.keep(np.zeros(len(tracks), bool))
        tracks.predict(dt)
        self._lost.wait(dt)
        track, row, is_same = associate(
            tracks.table, found, options.cost, options.min_iou, options.across_classes, tracks.covariances
        )
        fast, at = fast_starts(tracks.table, found, (track, row), options.across_classes)
        if len(fast):
            tracks.allow_speed(fast)
            track, row = np.concatenate([track, fast]), np.concatenate([row, at])
            is_same = np.concatenate([is_same, np.ones(len(fast), bool)])
        if len(track):
            before, after = tracks.update(track, found.take(row, axis=1), is_same, self._frame)
            # One more detection has to be where the velocity says before such a track is confirmed.
            tracks.table[SCORES, fast] = before[SCORES, len(track) - len(fast) :]
            self.waiting.close_gaps(before, after, self._frame, frame.t_ns)
        count = found.shape[1]
        if len(row) < count:
            starts = ~(found[SCORE] < options.birth_score)  # a missing score is not lower
            starts[row] = False
            self._initiate(found[:, starts])
        table = tracks.table
        is_found = table[LAST_FRAME] == self._frame
        is_new = (table[IS_CONFIRMED] == 0) & (table[SCORES] >= options.confirm_score)
        if is_new.any():
            is_found = is_found[self._confirm(is_new)]
            table = tracks.table
        self.waiting.add(frame, table[: ID + 1].compress(is_found, axis=1))
        if not is_found.all():
            age_s = np.where(table[IS_CONFIRMED] == 1, options.max_age_s, min(_TENTATIVE_S, options.max_age_s))
            is_over = table[MISSED_S] > np.maximum(age_s, 1.5 * dt)
            if is_over.any():
                self._lost.add(table.compress(is_over & (table[IS_CONFIRMED] == 1), axis=1))
                tracks.keep(~is_over)
        self._frame += 1
        self.waiting.release(frame.t_ns - options.delay_s * NS_PER_S)

    def _confirm(self, is_new: Bools) -> Bools:
        """Confirm tracks (K,), some of which continue lost ones; returns which tracks are still there."""
        tracks, lost = self.tracks, self._lost
        new, table = is_new.nonzero()[0], tracks.table
        ids = table[ID, new]
        missed = ((table[IS_CONFIRMED] == 1) & (table[LAST_FRAME] < self._frame)).nonzero()[0]
        kept = np.ones(len(tracks), bool)
        if self._options.link_s > 0:
            pool = np.concatenate([lost.table, table[:, missed]], axis=1)
            old, which = continuations(pool, table[:, new])
            tracks.continue_tracks(new[which], pool[:, old])
            count = lost.table.shape[1]
            is_left = np.ones(count, bool)
            is_left[old[old < count]] = False
            lost.keep(is_left)
            kept[missed[old[old >= count] - count]] = False
        table[IS_CONFIRMED, new] = 1
        self.waiting.confirm(ids, table[ID, new])
        if not kept.all():
            tracks.keep(kept)
        return kept

    def _initiate(self, found: Floats) -> None:
        """Start a track at each of these detections, (rows, N)."""
        count = found.shape[1]
        if not count:
            return
        if new := {int(one) for one in np.unique(found[CLASS])} - self._limits.keys():
            self._limits |= limits_by_class(sorted(new), self._options.class_names, self._options.class_limits)
        self.tracks.initiate(self._next_id, found, self._limits, self._frame)
        self._next_id += count

    def detections(self, frames: Sequence[Frame]) -> Iterator[Floats]:
        """For each frame the detections that are used, in an order of their own: (rows, N)."""
        joined, options = join_frames(DETECTIONS, frames), self._options
        rows = joined.rows
        found = np.stack([rows[name] for name in _COLUMNS], dtype=float)
        xx, xy, yy = given = np.stack([rows[name] for name in COVARIANCE_M2])
        is_given = (xx > 0) & (yy > 0) & (xy * xy < xx * yy) & np.isfinite(given).all(axis=0)
        has_any = np.bincount(joined.frame, is_given, len(frames)) > 0
        if has_any.any():
            found = np.concatenate([found, np.where(is_given, given, np.nan)])
        used = np.isfinite(found[X]) & np.isfinite(found[Y])
        self._left_out += len(rows) - int(used.sum())
        if options.min_score is not None:
            used &= ~(found[SCORE] < options.min_score)
        if options.class_id is not None:
            used &= found[CLASS] == options.class_id
        order = np.lexsort((*found[::-1], joined.frame))
        order = order[used[order]]
        found = found.take(order, axis=1)
        ends = np.append(0, np.cumsum(np.bincount(joined.frame[order], minlength=len(frames)))).tolist()
        for low, high, has_covariances in zip(ends[:-1], ends[1:], has_any.tolist(), strict=True):
            yield found[: None if has_covariances else DETECTION_ROWS, low:high]

    def warn(self) -> None:
        """Warn of detections without a position in metres."""
        if self._left_out:
            warn(f"{self._left_out} detections have no position in metres, and no track", "left-out")
