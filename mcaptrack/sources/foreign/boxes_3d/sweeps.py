"""Find the sweeps of a sensor where a detector writes several messages for each, such as one for each object.

These messages have nearly the same stamp, or were written in a burst. So the gaps between their times are of two kinds:
short ones within a sweep, long ones between two. An object is in a sweep once, so a box is nearer to a box of the next
sweep, the same object, than to the others of its own.

Letters: T times, N boxes.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S

#: The objects of a sweep are measured, and written, within this time.
_LONGEST_NS: Final = NS_PER_S // 4
#: Shorter gaps count as this.
_SHORTEST_NS: Final = 1_000_000
#: Gaps between sweeps are longer by this factor than those within.
_MIN_RATIO: Final = 1.5
#: The number of ways of dividing gaps that are tried, and that of sweeps by which a way is judged.
_TRIED: Final = 5
_JUDGED: Final = 300
#: With fewer sweeps, gaps say nothing.
_MIN_SWEEPS: Final = 3
#: No object is faster, in m/s.
_FASTEST: Final = 100.0


def find_sweeps(t_ns: Ints, log_ns: Ints, place: Ints, centre_m: Floats, class_id: Ints) -> Ints | None:
    """The sweep of each of T times, as numbers that rise with time; None if there is no sign of longer sweeps.

    ``t_ns`` and ``log_ns`` (T,) are when boxes were measured and written, ``place`` (N,) is the time of each box by its
    number. Centres (N, 3) are in the frame of the sensor.
    """
    for times in (t_ns, log_ns):
        gaps = np.maximum(np.diff(np.sort(times)), _SHORTEST_NS)
        for limit in _limits(gaps):
            sweep = _chains(times, limit)
            if _are_sweeps(sweep, t_ns, log_ns, place, centre_m, class_id):
                return sweep
    return None


def are_mixed(t_ns: Ints, place: Ints, centre_m: Floats) -> bool:
    """Whether most of T rising times have one box, and it is of another object than the one before."""
    counts = np.bincount(place, minlength=len(t_ns))
    if len(t_ns) < 4 * _MIN_SWEEPS or not len(place) or (counts[counts > 0] == 1).mean() < 0.9:
        return False
    order = np.argsort(place, kind="stable")
    way = np.linalg.norm(np.diff(np.nan_to_num(centre_m[order]), axis=0), axis=1)
    passed_s = np.diff(t_ns[place[order]]) / NS_PER_S
    return bool((way > 1.0 + _FASTEST * passed_s).mean() > 0.5)


def _limits(gaps: Ints) -> list[int]:
    """Lengths of gaps up to which times may belong together, the most distinct first."""
    lengths = np.sort(gaps)
    if len(lengths) < 2 * _MIN_SWEEPS:
        return []
    ratio = lengths[1:] / lengths[:-1]
    ratio[-1] = 0  # one gap alone may be a pause
    likely = np.argsort(-ratio, kind="stable")[:_TRIED]
    return [int(lengths[one]) for one in likely.tolist() if ratio[one] >= _MIN_RATIO]


def _chains(times: Ints, limit: int) -> Ints:
    """The chain of each of T times: times that are at most ``limit`` apart are in one."""
    order = np.argsort(times, kind="stable")
    chain = np.empty(len(times), np.int64)
    chain[order] = np.concatenate([[0], np.cumsum(np.maximum(np.diff(times[order]), _SHORTEST_NS) > limit)])
    return chain


def _are_sweeps(sweep: Ints, t_ns: Ints, log_ns: Ints, place: Ints, centre_m: Floats, class_id: Ints) -> bool:
    """Whether groups of T times are sweeps: short, of several times mostly, and without an object twice."""
    count = np.bincount(sweep)
    with_boxes = np.bincount(sweep[np.unique(place)])
    if len(count) < _MIN_SWEEPS or not (with_boxes > 1).sum() >= (with_boxes == 1).sum():
        return False
    for times in (t_ns, log_ns):
        first, last = np.full(len(count), np.iinfo(np.int64).max), np.full(len(count), np.iinfo(np.int64).min)
        np.minimum.at(first, sweep, times)
        np.maximum.at(last, sweep, times)
        if (last - first).max() > _LONGEST_NS:
            return False
    return _share_repeated(sweep[place], centre_m, class_id) < 0.5


def _share_repeated(sweep: Ints, centre_m: Floats, class_id: Ints) -> float:
    """The share of boxes (N,) that are nearer to another of their own sweep than to all of the next one."""
    order = np.argsort(sweep, kind="stable")
    numbers, begins = np.unique(sweep[order], return_index=True)
    if len(numbers) < _MIN_SWEEPS:
        return 1.0
    parts = np.split(order, begins[1:])
    judged = np.unique(np.linspace(0, len(numbers) - 2, min(len(numbers) - 1, _JUDGED)).astype(int))
    compared = repeated = 0
    for one in judged.tolist():
        own = _nearest(parts[one], parts[one], centre_m, class_id)
        later = _nearest(parts[one], parts[one + 1], centre_m, class_id)
        compared += int(np.isfinite(later).sum())
        repeated += int((own < later).sum() - (np.isfinite(own) & np.isinf(later)).sum())
    return repeated / compared if compared else 1.0


def _nearest(some: Ints, others: Ints, centre_m: Floats, class_id: Ints) -> Floats:
    """The distance of boxes (S,) to the nearest of others of their class; those at the same place don't count."""
    places = np.nan_to_num(centre_m)
    away = np.linalg.norm(places[some][:, None] - places[others], axis=2)
    is_other = (class_id[some][:, None] == class_id[others]) & (away > 0)
    return np.asarray(np.where(is_other, away, np.inf).min(axis=1, initial=np.inf))
