"""Re-tracking in the picture, where positions in metres are too wrong: tracks keep their ids and are linked over gaps.

A camera that looks along the ground tells distances badly: a few pixels are metres. The place of a box in the picture
is measured well, and so is its height. Positions, speeds, noise and gates are therefore in heights of the box, in which
people near and far move alike. A tracker associates boxes by their overlap at the rate of the video, which samples
can't improve: only ends and beginnings of its tracks are decided here. A link is as likely as the motion and the height
before a gap fit those after it, compared with how often a new track would begin there in this log by chance; and as
likely as what people wear before and after it is one person's, where the log has pictures that tell people apart.

Letters: K tracks, N rows of samples, E candidate links.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.assignment import max_weight_matching
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import group_index, ragged_range
from mcaptrack.schema import TRACKS, Rows
from mcaptrack.schema.frame_columns import FrameColumns
from mcaptrack.schema.framing import joined_parts
from mcaptrack.schema.resampling import LINEAR
from mcaptrack.transforms.retrack.appearance import Appearance, AppearanceCalibration, Descriptors, Evidence
from mcaptrack.transforms.retrack.assignments import Tracks

#: The longest gap of a link, and the mean one: how often gaps are as long falls off exponentially. In seconds.
MAX_GAP_S: Final = 4.0
_GAP_S: Final = 1.0
#: The motion at an end is that of so many seconds.
_WINDOW_S: Final = 1.3
# In heights of the box: the noise of positions, that of ends in addition (a box shrinks where its person is occluded),
# the speed in a second, and how much it changes within a second, per axis.
_NOISE, _END_NOISE, _SPEED, _DRIFT = 0.06, 0.08, 0.6, 0.25
# The same of the logarithm of the height; it differs by so much between any two people.
_HEIGHT_NOISE, _HEIGHT_END_NOISE, _GROWTH, _HEIGHT_DRIFT, _HEIGHTS = 0.06, 0.12, 0.2, 0.15, 0.5
#: The share of ends that are followed by a beginning of the same person.
_RETURNS: Final = 0.5
#: The height of a person, for how far people may have walked between two places in the picture: as if all were as far
#: away as the usual box.
_PERSON_M: Final = 1.7


class Linked(NamedTuple):
    """The rows of each frame; the id of each input track after linking, ``track`` (K,) by ``ids`` (K,) in ascending
    order; and how appearance tells people apart, None if nothing was seen of them.
    """

    rows: Iterator[Rows]
    ids: Ints
    track: Ints
    calibration: AppearanceCalibration | None

    def track_of(self, ids: Ints) -> Ints:
        """The ids (N,) of input tracks after linking; -1 for those that have no box."""
        if len(self.ids) == 0:
            return np.full(len(ids), -1)
        place = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return np.where(self.ids[place] == ids, self.track[place], -1)


def link_in_picture(
    frames: FrameColumns,
    max_gap_s: float,
    min_confidence: float,
    across_classes: bool,
    fixed: Collection[int] = (),
    looks: Descriptors | None = None,
    rate_hz: float = 2.5,
) -> Linked:
    """The rows of each frame, with tracks linked over gaps of up to ``max_gap_s``, and the gaps interpolated.

    A link is made if it is right with a probability of at least ``min_confidence``. A track that continues another has
    the id of that one. No link joins two of the tracks ``fixed``. Where nothing is linked, rows are those of the input.
    ``looks`` are compared if they tell tracks apart; samples come at ``rate_hz``.
    """
    if not len(frames):
        return Linked(iter(()), np.empty(0, np.int64), np.empty(0, np.int64), None)
    tracks = _tracks(frames)
    calibration, seen = _appearance(tracks, looks, frames.t_ns, rate_hz)
    before, after = _links(tracks, min(max_gap_s, MAX_GAP_S), min_confidence, across_classes, seen)
    root = np.arange(len(tracks.ids))
    holds = np.isin(tracks.ids, np.array(sorted(fixed), np.int64))
    is_allowed = np.ones(len(before), bool)
    for link in np.argsort(tracks.t_s[tracks.first[after]], kind="stable").tolist():  # a continuation begins later
        first = root[before[link]]
        is_allowed[link] = not (holds[first] and holds[after[link]])
        if is_allowed[link]:
            root[after[link]] = first
            holds[first] |= holds[after[link]]
    before, after = before[is_allowed], after[is_allowed]
    name = dict(zip(tracks.ids.tolist(), tracks.ids[root].tolist(), strict=True))
    last = tracks.first[1:] - 1
    ends = {int(tracks.ids[i]): int(tracks.ids[j]) for i, j in zip(before, after, strict=True)}
    lost = dict(zip(tracks.ids[before].tolist(), tracks.frame[last[before]].tolist(), strict=True))
    begin_of = dict(zip(tracks.ids[after].tolist(), tracks.frame[tracks.first[after]].tolist(), strict=True))
    gaps = _Gaps(frames, {end: (lost[end], other, begin_of[other]) for end, other in ends.items()})
    return Linked(_renamed(frames, name, gaps), tracks.ids, tracks.ids[root], calibration)


def _renamed(frames: FrameColumns, name: Mapping[int, int], gaps: _Gaps) -> Iterator[Rows]:
    """The rows of each frame and those of gaps there, under the new name of each id."""
    for number, frame in enumerate(frames):
        rows = frame.rows.copy()
        ids = np.array([name.get(track, track) for track in rows["track_id"].tolist()], rows["track_id"].dtype)
        filled = gaps.rows_at(number)
        if len(filled):
            filled["track_id"] = [name[track] for track in filled["track_id"].tolist()]
        renamed = ids != rows["track_id"]
        rows["source_id"][renamed] = rows["track_id"][renamed]
        rows["track_id"] = ids
        if len(filled) or renamed.any():
            rows = np.concatenate([rows, filled])
            rows = rows[np.argsort(rows["track_id"], kind="stable")]
        yield rows


class _Tracks(NamedTuple):
    """The boxes of all tracks: those of track k are ``first[k]`` to ``first[k + 1]`` of N, ordered by time."""

    ids: Ints
    first: Ints
    boxes: Floats
    t_s: Floats
    frame: Ints
    classes: Ints


def _tracks(frames: FrameColumns) -> _Tracks:
    """The boxes of tracks in pixels; rows without one are left out."""
    parts: list[tuple[Ints, Floats, Ints, Ints]] = []
    for low, _, joined in joined_parts(TRACKS, frames):
        rows = joined.rows
        parts.append((rows["track_id"], columns_to_boxes(rows), joined.frame + low, rows["class_id"]))
    track, boxes, frame, classes = (np.concatenate(part) for part in zip(*parts, strict=True))
    kept = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > 0).all(axis=1)
    order = np.flatnonzero(kept)[np.lexsort((frame[kept], track[kept]))]
    ids, count = np.unique(track[order], return_counts=True)
    first = np.concatenate([[0], np.cumsum(count)])
    t_s = (frames.t_ns - frames.t_ns[0])[frame[order]] / NS_PER_S
    return _Tracks(ids, first, boxes[order], t_s, frame[order], classes[order][first[:-1]])


class _Ends(NamedTuple):
    """The ends or the beginnings of K tracks.

    Times (K,) in s; positions (K, 2) in px and velocities (K, 2) in px/s; heights (K,) in px and their logarithms (K,);
    variances of positions and of velocities (K,), in squared heights.
    """

    t_s: Floats
    xy_px: Floats
    v_px_per_s: Floats
    height_px: Floats
    log_height: Floats
    variance: Floats
    speed_variance: Floats


def _ends(tracks: _Tracks, at: Ints) -> _Ends:
    """The motion of tracks at one of their rows (K,), the first or the last: of the samples within ``_WINDOW_S``."""
    track = group_index(np.diff(tracks.first))
    since = tracks.t_s - tracks.t_s[at][track]
    near = np.abs(since) <= _WINDOW_S
    track, since, boxes = track[near], since[near], tracks.boxes[near]
    count = len(at)

    def total(values: Floats) -> Floats:
        return np.bincount(track, values, minlength=count).astype(np.float64)

    height_px = total(boxes[:, 3]) / total(np.ones(len(track)))
    zero, first, two = total(np.ones(len(track))), total(since), total(since**2)

    def fitted(values: Floats, noise: float, speed: float) -> tuple[Floats, Floats, Floats, Floats]:
        """Value and slope at the end, and their variances: a line, with slopes of about ``speed``."""
        low, mixed, high = zero / noise**2, first / noise**2, two / noise**2 + 1 / speed**2
        a, b = total(values) / noise**2, total(values * since) / noise**2
        determinant = low * high - mixed**2
        return (
            (high * a - mixed * b) / determinant,
            (low * b - mixed * a) / determinant,
            high / determinant,
            low / determinant,
        )

    middle = (boxes[:, :2] + boxes[:, 2:] / 2) / height_px[track, None]
    fits = [fitted(middle[:, axis], _NOISE, _SPEED) for axis in (0, 1)]
    place, speed = (np.stack([fit[k] for fit in fits], axis=-1) * height_px[:, None] for k in (0, 1))
    log_height, *_ = fitted(np.log(boxes[:, 3]), _HEIGHT_NOISE, _GROWTH)
    return _Ends(tracks.t_s[at], place, speed, height_px, log_height, fits[0][2], fits[0][3])


def _appearance(
    tracks: _Tracks, looks: Descriptors | None, times_ns: Ints, rate_hz: float
) -> tuple[AppearanceCalibration | None, Evidence | None]:
    """The calibration of appearance, and its evidence for links where it tells tracks apart."""
    step = np.rint(tracks.t_s * rate_hz).astype(np.int64)
    source = np.repeat(tracks.ids, np.diff(tracks.first))
    middle_px = tracks.boxes[:, :2] + tracks.boxes[:, 2:] / 2
    xy_m = middle_px * (_PERSON_M / np.median(tracks.boxes[:, 3])) if len(step) else middle_px
    boxes = np.arange(len(step))
    look = np.full(len(step), -1) if looks is None else looks.find(times_ns[tracks.frame], source)
    samples = Tracks(step, source, source, boxes, xy_m, look, source)
    seen = Appearance.of(looks, samples, 1 / rate_hz)
    if seen is None or not seen.calibration.tells_apart:
        return seen and seen.calibration, None
    return seen.calibration, seen.between(samples).of_tracks


def _links(
    tracks: _Tracks, max_gap_s: float, min_confidence: float, across_classes: bool, seen: Evidence | None
) -> tuple[Ints, Ints]:
    """The links: tracks (E,) and the ones that continue them (E,)."""
    nothing = np.empty(0, np.int64), np.empty(0, np.int64)
    count = len(tracks.ids)
    if count < 2 or max_gap_s <= 0:
        return nothing
    lost, begun = _ends(tracks, tracks.first[1:] - 1), _ends(tracks, tracks.first[:-1])
    order = np.argsort(begun.t_s, kind="stable")
    low = np.searchsorted(begun.t_s[order], lost.t_s, "right")
    high = np.searchsorted(begun.t_s[order], lost.t_s + max_gap_s, "right")
    i, j = group_index(high - low), order[ragged_range(low, high - low)]
    if not across_classes:
        same = tracks.classes[i] == tracks.classes[j]
        i, j = i[same], j[same]
    gain = _log_odds(lost, begun, i, j, _births(tracks)) - np.log(min_confidence / (1 - min_confidence))
    gain += 0.0 if seen is None else seen(i, j)
    good = gain > 0
    if not good.any():
        return nothing
    (i, j), _ = max_weight_matching((i[good], j[good]), np.round(gain[good], 6), (count, count))
    return i, j


def _births(tracks: _Tracks) -> float:
    """The number of tracks that begin in a second and in a square of the height of the usual box."""
    boxes = tracks.boxes
    usual_px = float(np.median(boxes[:, 3]))
    far = (boxes[:, :2] + boxes[:, 2:]).max(axis=0) - boxes[:, :2].min(axis=0)
    seconds = max(float(np.ptp(tracks.t_s)), _GAP_S)
    return len(tracks.ids) / (seconds * max(float(far.prod()) / usual_px**2, 1.0))


def _log_odds(lost: _Ends, begun: _Ends, i: Ints, j: Ints, births: float) -> Floats:
    """The log odds that the beginnings ``j`` (E,) continue the ends ``i`` (E,), and are not those of other people.

    The misfit is the distance from where the mean of both velocities leads.
    """
    gap_s = begun.t_s[j] - lost.t_s[i]
    height_px = np.sqrt(lost.height_px[i] * begun.height_px[j])
    way = begun.xy_px[j] - lost.xy_px[i] - (lost.v_px_per_s[i] + begun.v_px_per_s[j]) / 2 * gap_s[:, None]
    spread = lost.variance[i] + begun.variance[j] + _END_NOISE**2 + _DRIFT**2 * gap_s**3 / 12
    spread += gap_s**2 / 4 * (lost.speed_variance[i] + begun.speed_variance[j])
    moved = -((way / height_px[:, None]) ** 2).sum(axis=1) / spread / 2 - np.log(2 * np.pi * spread)
    tall = _HEIGHT_END_NOISE**2 + (_HEIGHT_DRIFT * gap_s) ** 2
    grown = -((begun.log_height[j] - lost.log_height[i]) ** 2) / tall / 2 - np.log(tall / _HEIGHTS**2) / 2
    lasted = -gap_s / _GAP_S + np.log(_RETURNS / _GAP_S)
    return np.asarray(moved + grown + lasted - np.log(births))


class _Gaps:
    """Interpolated rows of linked tracks: ``links`` has for each id its last frame, the next id and its first frame."""

    def __init__(self, frames: FrameColumns, links: dict[int, tuple[int, int, int]]) -> None:
        self._t_ns = frames.t_ns
        wanted = [(low, ended) for ended, (low, _, _) in links.items()]
        wanted += [(high, other) for _, other, high in links.values()]
        rows: dict[tuple[int, int], Rows] = {}
        for number, own in sorted(wanted):
            tracked = frames[number].rows
            rows[number, own] = tracked[tracked["track_id"] == own].copy()
        self._ends = [(low, high, rows[low, ended], rows[high, other]) for ended, (low, other, high) in links.items()]
        self._open: dict[int, list[int]] = {}
        for link, (low, high, _, _) in enumerate(self._ends):
            for number in range(low + 1, high):
                self._open.setdefault(number, []).append(link)

    def rows_at(self, number: int) -> Rows:
        """The rows of gaps at a frame, with the ids of the tracks before."""
        out = []
        for link in self._open.get(number, ()):
            low, high, before, after = self._ends[link]
            share = (self._t_ns[number] - self._t_ns[low]) / (self._t_ns[high] - self._t_ns[low])
            row = before.copy()
            for name in LINEAR:
                row[name] += share * (after[name] - before[name])
            row["observed"], row["source_id"] = False, -1
            out.append(row)
        return TRACKS.joined(out)
