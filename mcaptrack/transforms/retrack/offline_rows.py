"""Rows of offline tracks: described by a few numbers each while tracks are decided about, then made part by part.

Letters: C assignments, R rows, N samples.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.angles import wrapped
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.plane import Planes
from mcaptrack.geometry.ragged import group_index, ragged_range, run_ends, run_starts
from mcaptrack.notices import warn
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.classes import first_classes, majority
from mcaptrack.schema.framing import JoinedFrames, joined_parts, mapped_rows, spans_of
from mcaptrack.schema.resampling import ANGLES, LINEAR
from mcaptrack.transforms.retrack.samples import LogSamples


class TrackRows(NamedTuple):
    """Rows (R,) that are interpolated between samples.

    Attributes
    ----------
    track, step : (R,) of int
    before, after : (R,) of int
        The samples of the track before and after the row; both are the row's own where it has one.
    share : (R,) of float
        How far the row is on the way between the two, from 0 to 1.
    """

    track: Ints
    step: Ints
    before: Ints
    after: Ints
    share: Floats

    @classmethod
    def of(cls, step: Ints, track: Ints, sample: Ints) -> TrackRows:
        """A row for every step of every track from its first to its last; assignments (C,) are by track, then step."""
        is_last = run_ends(run_starts(track))
        count = np.where(is_last, 1, np.append(step[1:], 0)[: len(step)] - step)
        before, within = group_index(count), ragged_range(0, count)
        after = np.where(within > 0, before + 1, before)
        return cls(track[before], step[before] + within, sample[before], sample[after], within / count[before])

    @property
    def is_sample(self) -> Bools:
        """Whether each row is a sample, (R,), and not between two."""
        return np.asarray(self.share == 0)

    def between(self, values: NDArray[Any]) -> NDArray[Any]:
        """A column of the samples (N,), linearly interpolated, (R,)."""
        out = values[self.before]
        out += self.share * (values[self.after] - out)
        return out

    def take(self, which: Bools | Ints | slice) -> TrackRows:
        """Some of the rows."""
        return TrackRows(self.track[which], self.step[which], self.before[which], self.after[which], self.share[which])


class Moved(NamedTuple):
    """Where smoothing moves rows (R,) to: positions (R, 2) in m, and what is added to x_px and y_px, (R, 2), if any."""

    xy_m: Floats
    shift_px: Floats | None

    def take(self, which: Ints) -> Moved:
        """The movements of some of the rows."""
        return Moved(self.xy_m[which], None if self.shift_px is None else self.shift_px[which])


def moved_to(xy_m: Floats, rows: TrackRows, samples: LogSamples, planes: Planes, t_ns: Ints) -> Moved:
    """Move rows (R,) to positions (R, 2) in m, and their boxes with them if there is a ground plane at their times."""
    if not planes:
        return Moved(xy_m, None)
    from_m, size = (
        np.stack([rows.between(samples.column(name)) for name in names], axis=-1)
        for names in (("x_m", "y_m"), ("w_px", "h_px"))
    )
    return Moved(xy_m, _shift(from_m, xy_m, size, planes, t_ns))


def move_rows(rows: Rows, xy_m: Floats, planes: Planes, t_ns: Ints) -> Rows:
    """Move rows (R,) to other positions (R, 2), and their boxes with them if there is a ground plane at their times."""
    out = rows.copy()
    if planes:
        from_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
        _add(out, _shift(from_m, xy_m, columns_to_boxes(rows)[:, 2:], planes, t_ns))
    out["x_m"], out["y_m"] = xy_m.T
    return out


def _shift(from_m: Floats, to_m: Floats, size_px: Floats, planes: Planes, t_ns: Ints) -> Floats:
    """The distance in px by which boxes of this size move between positions in m; all of them (R, 2)."""
    out = np.zeros((len(from_m), 2))
    which = np.maximum(np.searchsorted([since_ns for since_ns, _ in planes], t_ns, side="right") - 1, 0)
    for number in np.unique(which).tolist():
        plane, here = planes[number][1], which == number
        size = size_px[here]
        shift = plane.standing_boxes(to_m[here], size) - plane.standing_boxes(from_m[here], size)
        out[here] = np.where(np.isfinite(shift), shift, 0.0)[:, :2]
    return out


def _add(rows: Rows, shift_px: Floats) -> None:
    rows["x_px"] += shift_px[:, 0]
    rows["y_px"] += shift_px[:, 1]


# The class of a track, where its rows are of several: that of most of them.
#
# Letters: N rows, K tracks.


def settle_classes(frames: Sequence[Frame]) -> Sequence[Frame]:
    """Give each track one class, that of most of its rows; of several, the one that it had first.

    Warns of the tracks that have rows of several classes. Frames are unchanged if there are none.
    """
    pairs = np.empty((2, 0), np.int64)
    for _, _, joined in joined_parts(TRACKS, frames):
        those = np.stack([joined.rows["track_id"].astype(np.int64), joined.rows["class_id"].astype(np.int64)])
        pairs = np.unique(np.concatenate([pairs, those], axis=1), axis=1)
    ids, count = np.unique(pairs[0], return_counts=True)
    if not (count > 1).any():
        return frames
    changed = ids[count > 1]
    parts = [
        joined.rows[["track_id", "class_id"]][np.isin(joined.rows["track_id"], changed)]
        for _, _, joined in joined_parts(TRACKS, frames)
    ]
    rows = np.concatenate(parts)
    track = np.searchsorted(changed, rows["track_id"])
    class_id = majority(track, rows["class_id"], len(changed))

    def settled(joined: JoinedFrames) -> Rows:
        place = np.minimum(np.searchsorted(changed, joined.rows["track_id"]), len(changed) - 1)
        mine = changed[place] == joined.rows["track_id"]
        joined.rows["class_id"][mine] = class_id[place[mine]]
        return joined.rows

    warn(
        f"{len(changed)} of {len(ids)} tracks have detections of several classes; each has the class of most of its "
        "detections",
        "classes",
    )
    return mapped_rows(TRACKS, frames, settled)


def vote(rows: Rows) -> tuple[int, int]:
    """Give each track the class of most of its rows (N,), in place; rows are ordered by time.

    Returns the number of tracks that had several classes, and of all tracks.
    """
    ids, track = np.unique(rows["track_id"], return_inverse=True)
    changed = rows["class_id"] != first_classes(track, rows["class_id"], len(ids))[track]
    if changed.any():
        rows["class_id"] = majority(track, rows["class_id"], len(ids))[track]
    return len(np.unique(track[changed])), len(ids)


def rows_by_step(rows: TrackRows, samples: LogSamples, moved: Moved | None, steps: Sequence[int]) -> Iterator[Rows]:
    """The rows of tracks at each of ``steps``, ordered by id; each track has the class of most of its rows."""
    order = np.lexsort((rows.track, rows.step))
    rows, moved = rows.take(order), moved and moved.take(order)
    ends = np.append(0, np.searchsorted(rows.step, steps, "right"))
    votes = np.empty(len(order), [("track_id", np.int64), ("class_id", np.uint32)])
    votes["track_id"], votes["class_id"] = rows.track, samples.column("class_id")[rows.before]
    vote(votes)
    for low, high in spans_of(ends):
        here = slice(ends[low], ends[high])
        part = _rows(rows.take(here), samples)
        part["class_id"] = votes["class_id"][here]
        if moved is not None:
            part["x_m"], part["y_m"] = moved.xy_m[here].T
            if moved.shift_px is not None:
                _add(part, moved.shift_px[here])
        bounds = (ends[low : high + 1] - ends[low]).tolist()
        yield from (part[start:end] for start, end in pairwise(bounds))


def _rows(which: TrackRows, samples: LogSamples) -> Rows:
    """Rows (R,) of tracks."""
    before, is_sample = samples.take(which.before), which.is_sample
    after, rows = before.copy(), before.copy()
    after[~is_sample] = samples.take(which.after[~is_sample])
    for name in LINEAR:
        rows[name] += which.share * (after[name] - before[name])
    for name in ANGLES:
        step_rad = wrapped(after[name] - before[name])
        rows[name] = np.where(is_sample, rows[name], wrapped(rows[name] + which.share * step_rad))
    rows["source_id"] = np.where(is_sample, rows["track_id"], -1)
    rows["observed"] &= is_sample
    rows["track_id"] = which.track
    return rows
