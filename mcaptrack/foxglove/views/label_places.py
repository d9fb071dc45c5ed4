"""Where labels of people stand who are close to each other: one above the other, and steadily so.

A label moves away from those of lower ids, along the side of its box that its style has, as far as it has to. Once two
labels have met, they stay apart for a while, so that noise of boxes does not make them jump; then the one comes back
slowly, if no other is in its way. Places depend on the
present and the last second alone; they are the same whichever part of a log is drawn.

Letters: N labels, F pictures, K pairs of labels in a picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.foxglove import CuboidMarker, PersonMarker
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.geometry.plane import Planes
from mcaptrack.geometry.ragged import group_index, ragged_range, run_starts
from mcaptrack.schema import Frame

#: Width of a character and height of a line, in sizes of the font: as much as viewers and videos need.
_WIDE: Final = 0.75
_HIGH: Final = 1.5
#: Labels that have met stay apart for this time, unless they are farther apart than this many lines; those that are
#: beside each other come back in its last part.
_HOLD_S: Final = 1.0
_BACK_S: Final = 0.5
_APART: Final = 1.5
#: Labels that would have to move by more lines than this stay where they are.
_MOST_LINES: Final = 4.0
_ROUNDS: Final = 8
#: On the ground: people closer than this are neighbours; labels of neighbours are so far above each other, and so
#: often at most.
_NEIGHBOURS_M: Final = 1.2
_STEP_M: Final = 1.2
_MOST_STEPS: Final = 4


def extents(labels: NDArray[Any], size_px: float) -> Floats:
    """Width and height (N, 2) in px of labels (N,), numbers or texts, as far as it can be known."""
    unique, which = np.unique(labels, return_inverse=True)
    length = np.array([len(str(label)) for label in unique.tolist()], np.float64)
    wide = length[which.reshape(-1)] * (_WIDE * size_px)
    return np.stack([wide, np.full(len(wide), _HIGH * size_px)], axis=-1)


def shifts(at_ns: Ints, frame: Ints, number: Ints, corner_px: Floats, extent_px: Floats, is_down: bool) -> Floats:
    """Compute the shifts that keep labels apart.

    Parameters
    ----------
    at_ns : (F,) of int64
        Times of the pictures, rising.
    frame : (N,) of int64
        The picture of each label, rising.
    number : (N,) of int64
        Ids; lower ones stay where they are.
    corner_px, extent_px : (N, 2)
        Lower left corners; widths and heights.
    is_down : bool
        Labels move down, and not up.

    Returns
    -------
    (N,) of float64
        Pixels to add to the second coordinate: of 0 or less, or of 0 or more with ``is_down``.
    """
    out = np.zeros(len(frame))
    lower, higher, age_s = _held(at_ns, frame, number, *_meeting(frame, number, corner_px, extent_px))
    if not len(lower):
        return out
    left, right = corner_px[:, 0], corner_px[:, 0] + extent_px[:, 0]
    is_beside = (left[lower] >= right[higher]) | (left[higher] >= right[lower])
    share = np.where(is_beside, np.clip((_HOLD_S - age_s) / _BACK_S, 0.0, 1.0), 1.0)
    sign = 1.0 if is_down else -1.0
    away = sign * corner_px[:, 1]
    high = extent_px[:, 1]
    # All pairs of a label in the order of what they move away from: a few rounds settle them all.
    reach = (_APART - 1.0) * high[higher]
    for _ in range(_ROUNDS):
        gap = (away + out)[higher] - (away + out)[lower]
        needed = high[higher] if is_down else high[lower]
        is_near = (gap < needed - 1e-9) & (gap > -needed - reach)
        if not is_near.any():
            break
        moved = (away + out)[lower[is_near]] + needed[is_near] - away[higher[is_near]]
        before = out.copy()
        np.maximum.at(out, higher[is_near], share[is_near] * moved)
        if np.array_equal(out, before):
            break
    out[out > _MOST_LINES * high] = 0.0
    return sign * out


def heights(at_ns: Ints, frame: Ints, number: Ints, at_m: Floats) -> Floats:
    """Compute how much higher labels of people on the ground stand, so that those of neighbours keep apart.

    Viewers see a scene from any side and any distance, so this can't be exact: neighbours are closer than
    ``_NEIGHBOURS_M``, and the label of the higher id is ``_STEP_M`` above that of the lower one. After neighbours have
    parted, labels come back as in pictures.

    Parameters
    ----------
    at_ns : (F,) of int64
        Times of the scenes, rising.
    frame : (N,) of int64
        The scene of each person, rising.
    number : (N,) of int64
        Ids.
    at_m : (N, 2)
        Positions.

    Returns
    -------
    (N,) of float64
        Metres.
    """
    out = np.zeros(len(frame))
    extent = np.full((len(frame), 2), _NEIGHBOURS_M)
    lower, higher, age_s = _held(at_ns, frame, number, *_meeting(frame, number, at_m, extent))
    share = np.clip((_HOLD_S - age_s) / _BACK_S, 0.0, 1.0)
    for _ in range(_MOST_STEPS if len(lower) else 0):
        np.maximum.at(out, higher, share * np.minimum(out[lower] + _STEP_M, _MOST_STEPS * _STEP_M))
    return out


def _meeting(frame: Ints, number: Ints, corner_px: Floats, extent_px: Floats) -> tuple[Ints, Ints]:
    """The pairs (K,) of labels that overlap in a picture: the one with the lower id, and the other."""
    order = np.lexsort((corner_px[:, 0], frame))
    of, left, wide = frame[order], corner_px[order, 0], extent_px[order, 0]
    low = corner_px[order, 1]
    top = low - extent_px[order, 1]
    overlaps: list[tuple[Ints, Ints]] = []
    near = np.arange(max(len(order) - 1, 0))
    step = 1
    while len(near):  # neighbours by their left edges, as long as the first one reaches so far
        near = near[near + step < len(order)]
        other = near + step
        is_near = (of[near] == of[other]) & (left[other] < left[near] + wide[near])
        near, other = near[is_near], other[is_near]
        hit = (low[near] > top[other]) & (low[other] > top[near])
        overlaps.append((order[near[hit]], order[other[hit]]))
        step += 1
    first, other = (np.concatenate([pair[n] for pair in overlaps] or [np.empty(0, np.int64)]) for n in range(2))
    is_first = number[first] < number[other]
    return np.where(is_first, first, other).astype(np.int64), np.where(is_first, other, first).astype(np.int64)


def _held(at_ns: Ints, frame: Ints, number: Ints, lower: Ints, higher: Ints) -> tuple[Ints, Ints, Floats]:
    """The pairs of labels in each picture that overlap in it, or did in the last second, and how long ago, in s."""
    if not len(lower):
        return lower, higher, np.empty(0)
    ids, which = np.unique(number, return_inverse=True)
    pair = which[lower].astype(np.int64) * len(ids) + which[higher]
    order = np.lexsort((frame[lower], pair))
    pair, begin = pair[order], frame[lower][order]
    end = np.searchsorted(at_ns, at_ns[begin] + seconds_to_ns(_HOLD_S), "right")
    starts = run_starts(pair)
    following = np.append(begin[1:], len(at_ns))
    following[np.append(starts[1:], True)] = len(at_ns)
    count = np.minimum(end, following) - begin
    of, at = pair[group_index(count)], ragged_range(begin, count)
    age_s = (at_ns[at] - at_ns[begin[group_index(count)]]) / NS_PER_S
    # Where both are: the rows by picture and id.
    keys = frame * len(ids) + which
    rows = np.argsort(keys, kind="stable")
    sorted_keys = keys[rows]
    rows_of_both = []
    for member in (of // len(ids), of % len(ids)):
        wanted = at * len(ids) + member
        place = np.minimum(np.searchsorted(sorted_keys, wanted), len(rows) - 1)
        rows_of_both.append(np.where(sorted_keys[place] == wanted, rows[place], -1))
    both = (rows_of_both[0] >= 0) & (rows_of_both[1] >= 0)
    return rows_of_both[0][both].astype(np.int64), rows_of_both[1][both].astype(np.int64), age_s[both]


# The styles of tracks: tracked, re-tracked and ground truth can be told apart at a glance.


#: Up to this width of pictures, lines of thickness 1 are 1 px thick and text is 12 px high; on wider ones, more.
_WIDTH_PX: Final = 800


class TrackStyle(NamedTuple):
    """The style of the people of a channel.

    ``name_at`` is the position of the number at a box, different for each style, so that numbers don't overlap.
    ``dash`` is the drawn share of each piece of a trail on pictures; 0 for no trail.
    """

    thickness: float
    is_open: bool
    dash: float
    is_white: bool
    name_at: Literal["above", "below", "beside"]
    marker: PersonMarker
    box: CuboidMarker


#: On the ground the numbers of a person in several channels have different heights, so that all can be read. So have
#: those of 3D boxes, of which re-tracked ones are drawn whole, tracked ones at the bottom and true ones at the top.
RETRACKED: Final = TrackStyle(
    2.5, False, 1.0, False, "above", PersonMarker(0.4, 1.7, 2.2, 4.0), CuboidMarker(0.0, 1.0, 0.5)
)
TRACKED: Final = TrackStyle(
    2.0, True, 0.6, False, "below", PersonMarker(0.6, 0.06, -0.8, 3.0, in_pieces=True), CuboidMarker(0.0, 0.0, -0.8)
)
GROUND_TRUTH: Final = TrackStyle(
    1.0, False, 0.0, True, "beside", PersonMarker(0.12, 4.6, 5.0, 1.5), CuboidMarker(1.0, 1.0, 3.0)
)
#: The opacity of observed and of interpolated positions.
OBSERVED, INTERPOLATED = 1.0, 0.375


def style_of(topic: str, is_retracked: bool = False) -> TrackStyle:
    """The style of a channel of tracks, by its topic and by whether a stage made it that repairs tracks."""
    if topic.endswith("/truth"):
        return GROUND_TRUTH
    return RETRACKED if is_retracked or "/retracks" in topic else TRACKED


def line_unit(frames: Sequence[Frame], planes: Planes) -> float:
    """The thickness in px of a line of thickness 1, by the width of the pictures as far as it is known."""
    width = float(max((plane.width_px for _, plane in planes), default=0))
    if not width:
        for frame in frames:
            if {"x_px", "w_px"} <= set(frame.rows.dtype.names or ()):
                width = float(np.fmax.reduce(frame.rows["x_px"] + frame.rows["w_px"], initial=width))
    return unit_of_width(width)


def unit_of_width(width_px: float) -> float:
    """The thickness in px of a line of thickness 1 on pictures of this width."""
    return float(np.clip(round(width_px / _WIDTH_PX * 4) / 4, 1.0, 5.0))
