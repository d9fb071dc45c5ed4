"""Re-tracking in the picture, where positions in metres are too wrong: what trackers were sure of is linked over gaps.

A camera that looks along the ground tells distances badly: a few pixels are metres. The place of a box in the picture
is measured well, and so is its height. Positions, speeds, noise and gates are therefore in heights of the box, in which
people near and far move alike. A tracker associates boxes by their overlap at the rate of the video, which is right
from picture to picture, and often wrong after people were hidden. So its tracks are cut wherever they have a gap, and
which pieces are of one person is decided once for the whole log: an assignment by log odds. These are a logistic
regression, of how well motion and size before a gap fit those after it, and of the tracker's own decision. A second one
weighs each pair against the others that would take its place. What people wear counts, too, where the log has pictures
that tell people apart.

Letters: K pieces of tracks, N rows, E candidate links.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import group_index, ragged_range, run_starts
from mcaptrack.schema import TRACKS, Rows
from mcaptrack.schema.frame_columns import FrameColumns
from mcaptrack.schema.framing import JoinedFrames, filtered_rows, joined_parts, mapped_rows
from mcaptrack.schema.resampling import interval_ns
from mcaptrack.transforms.retrack.appearance import Appearance, AppearanceCalibration, Descriptors, Evidence, Sides
from mcaptrack.transforms.retrack.hypotheses import named
from mcaptrack.transforms.retrack.linking import best_links
from mcaptrack.transforms.retrack.motion_model import Tracks
from mcaptrack.transforms.retrack.weights import Logistic, columns, probability

#: Tracks are cut at gaps of more seconds than that, and more than a missing frame.
CUT_S: Final = 0.2
_MISSING_FRAMES: Final = 1.5
#: The motion at an end is that of so many seconds, in which errors of boxes are independent so often.
_WINDOW_S: Final = 1.0
_ERRORS_PER_S: Final = 10.0
# In heights of the box: the noise of positions, that of ends in addition (a box shrinks where its person is occluded),
# the speed in a second, and how much it changes within a second, per axis.
_NOISE, _END_NOISE, _SPEED, _DRIFT = 0.06, 0.08, 0.6, 0.25
# The same of the logarithm of the height.
_HEIGHT_NOISE, _HEIGHT_END_NOISE, _GROWTH, _HEIGHT_DRIFT = 0.06, 0.12, 0.2, 0.15
#: Pairs are no candidates if their motion, or height, is less likely than the best by more units of log likelihood.
_MOST_MISSED: Final = 10.0
#: Links are made from this share of the odds on that are asked for: a wrong link costs less than a missed one, because
#: the track of one of the two people is often soon over.
_SHARE_OF_ODDS: Final = 0.5
#: Log odds count for no more than that in those of others.
_MOST: Final = 30.0
#: The height of a person, for how far people may have walked between two places in the picture: as if all were as far
#: away as the usual box.
_PERSON_M: Final = 1.7

#: What tells right links from wrong ones; and what tells them among others: their log odds by themselves, and how
#: likely one of the others is that would take the place before or after the gap, as a logarithm.
_PAIRS, _LINKS = Logistic.of("pairs in pictures"), Logistic.of("links in pictures")
FEATURES, AMONG_OTHERS = _PAIRS.names, _LINKS.names


class Linked(NamedTuple):
    """Tracks after linking, and which piece of an input track has which id.

    Attributes
    ----------
    frames : FrameColumns
        The observed rows under their new ids; ``source_id`` is the id in the input. Gaps are not filled.
    source, begin_ns, track : (K,) of int
        Of each piece the id of its input track and when it begins, by which they are ordered, and its id after linking.
    calibration : AppearanceCalibration or None
        How appearance tells people apart; None if nothing was seen of them.
    """

    frames: FrameColumns
    source: Ints
    begin_ns: Ints
    track: Ints
    calibration: AppearanceCalibration | None

    def track_of(self, source: Ints, t_ns: Ints) -> Ints:
        """The ids (N,) of rows of input tracks at these times; -1 for tracks that have no box until then."""
        ids, times = (np.unique(np.concatenate(both)) for both in ((self.source, source), (self.begin_ns, t_ns)))
        have, wanted = (
            np.searchsorted(ids, of) * len(times) + np.searchsorted(times, at)
            for of, at in ((self.source, self.begin_ns), (source, t_ns))
        )
        place = np.searchsorted(have, wanted, "right") - 1
        is_own = (place >= 0) & (np.append(self.source, -1)[place] == source)
        return np.where(is_own, np.append(self.track, -1)[place], -1)


def link_in_picture(
    frames: FrameColumns,
    max_gap_s: float,
    min_confidence: float,
    across_classes: bool,
    fixed: Collection[int] = (),
    looks: Descriptors | None = None,
    rate_hz: float = 2.5,
) -> Linked:
    """Cut tracks at their gaps, and link what is of one person over gaps of up to ``max_gap_s``.

    A link is made if it is right with a probability of at least ``min_confidence``. What continues a track has the id
    of that one; what was cut off and continues none has a new id. No link joins two of the tracks ``fixed``, and these
    are not cut. ``looks`` are compared if they tell tracks apart; their samples come at ``rate_hz``.
    """
    observed = filtered_rows(TRACKS, frames, lambda joined: joined.rows["observed"])
    pieces = find_pieces(observed, fixed)
    calibration, seen = _appearance(pieces, looks, observed.t_ns, rate_hz)
    root = np.arange(len(pieces.source))
    holds = np.isin(pieces.source, np.array(sorted(fixed), np.int64))
    before, after = _links(pieces, max_gap_s, min_confidence, across_classes, seen)
    for link in np.argsort(pieces.t_s[pieces.first[after]], kind="stable").tolist():  # a continuation begins later
        first, other = root[before[link]], after[link]
        if not (holds[first] and holds[other]):
            root[other] = first
            holds[first] |= holds[other]
    begin_ns = observed.t_ns[pieces.frame[pieces.first[:-1]]] if len(root) else root
    linked = Linked(observed, pieces.source, begin_ns, named(root, pieces.source), calibration)

    def renamed(joined: JoinedFrames) -> Rows:
        rows = joined.rows
        track = linked.track_of(rows["track_id"], joined.row_ns)
        rows["source_id"] = rows["track_id"]
        rows["track_id"] = np.where(track >= 0, track, rows["track_id"])
        order = np.lexsort((rows["track_id"], joined.frame))
        return rows[order]

    return linked._replace(frames=mapped_rows(TRACKS, observed, renamed))


class BoxPieces(NamedTuple):
    """The boxes of what trackers were sure of: those of piece k are ``first[k]`` to ``first[k + 1]`` of N, by time.

    ``source`` (K,) are the ids of their tracks and ``classes`` (K,) their classes; pieces are ordered by track, then
    by time. ``usual_s`` is the usual time from frame to frame.
    """

    source: Ints
    first: Ints
    boxes: Floats
    t_s: Floats
    frame: Ints
    classes: Ints
    usual_s: float

    @property
    def piece(self) -> Ints:
        """The piece of each box (N,)."""
        return group_index(np.diff(self.first))


def find_pieces(frames: FrameColumns, fixed: Collection[int]) -> BoxPieces:
    """The boxes of tracks in pixels, cut at gaps; rows without one are left out."""
    parts: list[tuple[Ints, Floats, Ints, Ints]] = []
    for low, _, joined in joined_parts(TRACKS, frames):
        rows = joined.rows
        parts.append((rows["track_id"], columns_to_boxes(rows), joined.frame + low, rows["class_id"]))
    parts = parts or [(np.empty(0, np.int64), np.empty((0, 4)), np.empty(0, np.int64), np.empty(0, np.int64))]
    track, boxes, frame, classes = (np.concatenate(part) for part in zip(*parts, strict=True))
    kept = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:] > 0).all(axis=1)
    order = np.flatnonzero(kept)[np.lexsort((frame[kept], track[kept]))]
    track, boxes, frame = track[order], boxes[order], frame[order]
    usual_s = interval_ns(frames.t_ns) / NS_PER_S
    t_s = (frames.t_ns[frame] - frames.t_ns[:1]) / NS_PER_S
    is_first = run_starts(track)
    gap_s = np.diff(t_s, prepend=t_s[:1])
    is_first |= (gap_s > max(CUT_S, _MISSING_FRAMES * usual_s)) & ~np.isin(track, np.array(sorted(fixed), np.int64))
    first = np.append(np.flatnonzero(is_first), len(track))
    return BoxPieces(track[first[:-1]], first, boxes, t_s, frame, classes[order][first[:-1]], usual_s)


class _Ends(NamedTuple):
    """The ends or the beginnings of K pieces.

    Times (K,) in s; widths (K,) in px; positions (K, 2) in px and velocities (K, 2) in px/s; heights (K,) in px and
    their logarithms (K,) there; variances of positions and of velocities (K,), in squared heights.
    """

    t_s: Floats
    width_px: Floats
    xy_px: Floats
    v_px_per_s: Floats
    height_px: Floats
    log_height: Floats
    variance: Floats
    speed_variance: Floats


def _ends(pieces: BoxPieces, at: Ints) -> _Ends:
    """The motion of pieces at one of their rows (K,), the first or the last: of the boxes within ``_WINDOW_S``."""
    since = pieces.t_s - pieces.t_s[at][pieces.piece]
    near = np.abs(since) <= _WINDOW_S
    piece, since, boxes = pieces.piece[near], since[near], pieces.boxes[near]
    weight = min(1.0, _ERRORS_PER_S * pieces.usual_s) if pieces.usual_s > 0 else 1.0

    def total(values: Floats) -> Floats:
        return np.bincount(piece, values, minlength=len(at)).astype(np.float64)

    count = total(np.ones(len(piece)))
    height_px = total(boxes[:, 3]) / count
    zero, first, two = weight * count, weight * total(since), weight * total(since**2)

    def fitted(values: Floats, noise: float, speed: float) -> Floats:
        """Value and slope at the end, and their variances, (4, K): a line, with slopes of about ``speed``."""
        low, mixed, high = zero / noise**2, first / noise**2, two / noise**2 + 1 / speed**2
        a, b = weight * total(values) / noise**2, weight * total(values * since) / noise**2
        return np.asarray(np.stack([high * a - mixed * b, low * b - mixed * a, high, low]) / (low * high - mixed**2))

    middle = (boxes[:, :2] + boxes[:, 2:] / 2) / height_px[piece, None]
    fits = [fitted(middle[:, axis], _NOISE, _SPEED) for axis in (0, 1)]
    place, speed = (np.stack([fit[k] for fit in fits], axis=-1) * height_px[:, None] for k in (0, 1))
    log_height, *_ = fitted(np.log(boxes[:, 3]), _HEIGHT_NOISE, _GROWTH)
    return _Ends(pieces.t_s[at], pieces.boxes[at, 2], place, speed, height_px, log_height, *fits[0][2:])


def _appearance(
    pieces: BoxPieces, looks: Descriptors | None, times_ns: Ints, rate_hz: float
) -> tuple[AppearanceCalibration | None, Evidence | None]:
    """The calibration of appearance, and its evidence for links where it tells tracks apart.

    Of each piece those boxes count that have been looked at, and one where there is none.
    """
    if looks is None:
        return None, None
    source = pieces.source[pieces.piece]
    look = looks.find(times_ns[pieces.frame], source)
    counts = look >= 0
    is_unseen = np.bincount(pieces.piece, counts, minlength=len(pieces.source)) == 0
    counts[pieces.first[:-1][is_unseen]] = True
    step = np.rint(pieces.t_s * rate_hz).astype(np.int64)[counts]
    middle_px = (pieces.boxes[:, :2] + pieces.boxes[:, 2:] / 2)[counts]
    xy_m = middle_px * (_PERSON_M / np.median(pieces.boxes[:, 3])) if len(step) else middle_px
    samples = Tracks(
        step, pieces.piece[counts], source[counts], np.flatnonzero(counts), xy_m, look[counts], source[counts]
    )
    seen = Appearance.of(looks, samples, 1 / rate_hz)
    if seen is None or not seen.calibration.tells_apart:
        return seen and seen.calibration, None
    return seen.calibration, Sides(seen, samples).of_tracks


def _links(
    pieces: BoxPieces, max_gap_s: float, min_confidence: float, across_classes: bool, seen: Evidence | None
) -> tuple[Ints, Ints]:
    """The links: pieces (E,) and the ones that continue them (E,).

    Links over short pieces have to be likely as a whole: a piece of two frames says little of who is on its other side.
    """
    i, j, features = find_candidates(pieces, max_gap_s, across_classes)
    odds = _PAIRS.log_odds(features) + (0.0 if seen is None else seen(i, j))
    least = min_confidence / (1 - min_confidence) * _SHARE_OF_ODDS
    log_odds = _LINKS.log_odds(among_others(i, j, odds))
    best = best_links(i, j, log_odds - np.log(least), len(pieces.source))
    i, j, likely = i[best], j[best], probability(log_odds[best])
    is_short = np.diff(pieces.first) * pieces.usual_s < CUT_S
    as_a_whole, made = np.ones(len(pieces.source)), np.zeros(len(i), bool)
    for link in np.argsort(pieces.t_s[pieces.first[j]], kind="stable").tolist():
        chance = likely[link] * as_a_whole[i[link]]
        made[link] = chance > least / (1 + least)
        if made[link] and is_short[j[link]]:
            as_a_whole[j[link]] = chance
    return i[made], j[made]


def among_others(i: Ints, j: Ints, odds: Floats) -> Floats:
    """The features (E, 3) of links among others, of pairs (E,) with these log odds by themselves."""
    likely = np.exp(np.minimum(odds, _MOST))
    others = (np.maximum(np.bincount(side, likely)[side] - likely, 0) if len(odds) else odds for side in (i, j))
    return np.column_stack([odds, *map(np.log1p, others)])


def find_candidates(pieces: BoxPieces, max_gap_s: float, across_classes: bool = False) -> tuple[Ints, Ints, Floats]:
    """The pairs of pieces that may be one person: pieces (E,), those that may continue them (E,), features (E, F)."""
    last, first = pieces.first[1:] - 1, pieces.first[:-1]
    lost, begun = _ends(pieces, last), _ends(pieces, first)
    order = np.argsort(begun.t_s, kind="stable")
    low = np.searchsorted(begun.t_s[order], lost.t_s, "right")
    high = np.searchsorted(begun.t_s[order], lost.t_s + max_gap_s, "right")
    i, j = group_index(high - low), order[ragged_range(low, high - low)]
    if not across_classes:
        same = pieces.classes[i] == pieces.classes[j]
        i, j = i[same], j[same]
    gap_s = begun.t_s[j] - lost.t_s[i]
    height_px = np.sqrt(lost.height_px[i] * begun.height_px[j])
    moved = (lost.v_px_per_s[i] + begun.v_px_per_s[j]) / 2 * gap_s[:, None]
    spread = lost.variance[i] + begun.variance[j] + _END_NOISE**2 + _DRIFT**2 * gap_s**3 / 12
    spread += gap_s**2 / 4 * (lost.speed_variance[i] + begun.speed_variance[j])

    def miss_at(edge: float) -> Floats:
        """Half of the squared distance in standard deviations of middles (0), upper (-1) or lower edges (1)."""
        off = begun.xy_px[j] - lost.xy_px[i] - moved
        off[:, 1] += edge / 2 * (np.exp(begun.log_height[j]) - np.exp(lost.log_height[i]))
        return np.asarray(((off / height_px[:, None]) ** 2).sum(axis=1) / spread / 2)

    miss, edge = miss_at(0.0), np.minimum(miss_at(-1.0), miss_at(1.0))  # a box shrinks at one end, where it is hidden
    wider = np.abs(np.log(begun.width_px[j] / lost.width_px[i]))
    tall = _HEIGHT_END_NOISE**2 + (_HEIGHT_DRIFT * gap_s) ** 2
    growth = (begun.log_height[j] - lost.log_height[i]) ** 2 / tall / 2
    near = np.flatnonzero((miss < _MOST_MISSED) & (growth < _MOST_MISSED))
    i, j, gap_s = i[near], j[near], gap_s[near]
    rarity = -np.log(2 * np.pi * spread[near]) - np.log(tall[near]) / 2 - np.log(_births(pieces))
    values = {
        "log miss": np.log1p(edge[near]),
        "log growth": np.log1p(growth[near]),
        "change of width": wider[near],
        "log gap": np.log(gap_s),
        "gap": gap_s,
        "same track": (pieces.source[i] == pieces.source[j]) & (j == i + 1),
        "log rarity": rarity,
    }
    return i, j, columns(FEATURES, values)


def _births(pieces: BoxPieces) -> float:
    """The number of pieces that begin in a second and in a square of the height of the usual box."""
    boxes = pieces.boxes
    if not len(boxes):
        return 1.0
    usual_px = float(np.median(boxes[:, 3]))
    far = (boxes[:, :2] + boxes[:, 2:]).max(axis=0) - boxes[:, :2].min(axis=0)
    seconds = max(float(np.ptp(pieces.t_s)), 1.0)
    return len(pieces.source) / (seconds * max(float(far.prod()) / usual_px**2, 1.0))
