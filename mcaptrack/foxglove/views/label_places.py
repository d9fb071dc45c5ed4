"""Where labels of people stand who are close to each other: one above the other, and steadily so.

A label moves away from those of lower ids, along the side of its box that its style has, as far as it has to. Once two
labels have met, they stay apart for a while, so that noise of boxes does not make them jump; then the one comes back
slowly, if no other is in its way. Places depend on the
present and the last second alone; they are the same whichever part of a log is drawn.

Letters: N labels, F pictures, K pairs of labels in a picture.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.geometry.ragged import group_index, ragged_range, run_starts

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


def shifts(
    at_ns: Ints, frame: Ints, number: Ints, corner_px: Floats, labels: NDArray[Any], text_px: float, is_down: bool
) -> Floats:
    """Compute the shifts that keep labels apart.

    Parameters
    ----------
    at_ns : (F,) of int64
        Times of the pictures, rising.
    frame : (N,) of int64
        The picture of each label, rising.
    number : (N,) of int64
        Ids; lower ones stay where they are.
    corner_px : (N, 2)
        Lower left corners.
    labels : (N,)
        Numbers or texts.
    text_px : float
        The size of the text.
    is_down : bool
        Labels move down, and not up.

    Returns
    -------
    (N,) of float64
        Pixels to add to the second coordinate: of 0 or less, or of 0 or more with ``is_down``.
    """
    out, extent_px = np.zeros(len(frame)), extents(labels, text_px)
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
