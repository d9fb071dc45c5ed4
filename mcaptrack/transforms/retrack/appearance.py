"""Appearance: whether two parts of tracks look like one person, as a log likelihood ratio that the log itself gives.

It is one more likelihood beside that of motion, where tracks are linked, cut and exchanged offline. In a log in which
it doesn't tell people apart, as in pictures of people in uniforms, it isn't used (see ``appearance_calibration``).

Letters: C assignments, S descriptors, D bytes of one, E pairs of tracks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.ragged import run_starts
from mcaptrack.transforms.retrack.appearance_calibration import (
    BATCH,
    WINDOW,
    WITHIN_S,
    AppearanceCalibration,
    calibrate,
    usual_distance,
)
from mcaptrack.transforms.retrack.assignments import Tracks

#: The log likelihood ratio that the end of one track and the beginning of another are one person, for pairs of tracks
#: (E,) that are numbered by ascending id.
Evidence = Callable[[Ints, Ints], Floats]


class Descriptors(NamedTuple):
    """Descriptors of samples of tracks, ordered by time and id.

    ``t_ns`` (S,) and ``track_id`` (S,) are those of the sample; ``values`` (S, D) are roots of shares in histograms,
    where 255 is 1, and count where the box ``is_clear`` (S,). ``at_border`` (S,) are boxes next to a border of the
    picture, where people come and go.
    """

    t_ns: Ints
    track_id: Ints
    values: NDArray[np.uint8]
    is_clear: Bools
    at_border: Bools

    def find(self, t_ns: Ints, track_id: Ints) -> Ints:
        """The descriptor of each sample (C,), or -1."""
        if len(self.t_ns) == 0:
            return np.full(len(t_ns), -1)
        times, ids = np.unique(self.t_ns), np.unique(self.track_id)
        have = np.searchsorted(times, self.t_ns) * len(ids) + np.searchsorted(ids, self.track_id)
        at = np.minimum(np.searchsorted(times, t_ns), len(times) - 1)
        who = np.minimum(np.searchsorted(ids, track_id), len(ids) - 1)
        want = at * len(ids) + who
        row = np.minimum(np.searchsorted(have, want), len(have) - 1)
        is_stored = (have[row] == want) & (times[at] == t_ns) & (ids[who] == track_id)
        return np.where(is_stored, row, -1)

    def tracks_of(self, t_ns: Ints, track_id: Ints, track: Ints) -> Ints:
        """The ``track`` of each descriptor (S,), or -1, by those of samples (C,)."""
        row = self.find(t_ns, track_id)
        out = np.full(len(self.t_ns), -1)
        out[row[row >= 0]] = track[row >= 0]
        return out


class Appearance(NamedTuple):
    """What tracks look like, and what distances between ``descriptors`` mean. Steps have ``step_s`` seconds."""

    descriptors: Descriptors
    calibration: AppearanceCalibration
    step_s: float

    @classmethod
    def of(cls, descriptors: Descriptors | None, tracks: Tracks, step_s: float) -> Appearance | None:
        """The appearance of tracks with these descriptors; None if none was seen."""
        if descriptors is None or len(descriptors.t_ns) == 0 or len(tracks.look) == 0:
            return None
        which = np.where((tracks.look >= 0) & descriptors.is_clear[tracks.look], tracks.look, -1)
        calibration = calibrate(descriptors.values, tracks._replace(look=which), step_s)
        return None if calibration is None else cls(descriptors, calibration, step_s)

    def between(self, tracks: Tracks) -> Sides:
        """Compare parts of tracks."""
        return Sides(self, tracks)


class Sides:
    """Compares what is seen on the two sides of gaps between and within tracks; made by ``Appearance.between``.

    Tracks are numbered by ascending id.
    """

    def __init__(self, appearance: Appearance, tracks: Tracks) -> None:
        descriptors, order = appearance.descriptors, tracks.order
        step, starts = tracks.step[order], run_starts(tracks.track[order])
        self._place = np.empty_like(order)
        self._place[order] = np.arange(len(order))
        self._calibration, self._values = appearance.calibration, descriptors.values
        self._step_s = appearance.step_s
        self._starts = np.append(np.flatnonzero(starts), len(order))
        self._number = np.cumsum(starts) - 1  # of the track of each assignment
        self._first_step, self._steps = int(step.min(initial=0)), int(np.ptp(step)) + 2 if len(step) else 2
        self._when = self._number * self._steps + step - self._first_step
        sample = tracks.look[order]
        is_seen = (sample >= 0) & descriptors.is_clear[sample]
        self._at_border = (sample >= 0) & descriptors.at_border[sample]
        self._seen, self._which = step[is_seen], sample[is_seen]
        self._known = np.append(0, np.cumsum(is_seen))  # the number of descriptors before each assignment

    def of_tracks(self, end: Ints, begin: Ints) -> Floats:
        """The log likelihood ratio (E,) that the end of one track and the beginning of another are one person.

        A person who leaves the picture and comes back has two tracks. So where both are at its border, looking alike
        says nothing.
        """
        stop, start = self._starts[end + 1], self._starts[begin]
        ratio = self._compare(end, stop, begin, start)
        return np.where(self._at_border[stop - 1] & self._at_border[start], np.minimum(ratio, 0), ratio)

    def of_assignments(self, before: Ints, after: Ints) -> Floats:
        """The log likelihood ratio (E,) that a track up to an assignment and one from another on are one person."""
        before, after = self._place[before], self._place[after]
        return self._compare(self._number[before], before + 1, self._number[after], after)

    def of_swaps(self, track: Ints, other: Ints, since: Ints, until: Ints) -> Floats:
        """The log likelihood ratio (E,) that two tracks were exchanged from step ``since`` to ``until``."""
        ratio = np.zeros(len(track))
        for before, after, sign in ((track, other, 1), (other, track, 1), (track, track, -1), (other, other, -1)):
            ratio += sign * self._compare(before, self._from(before, since), after, self._from(after, until + 1))
        return ratio

    def _from(self, track: Ints, step: Ints) -> Ints:
        """The first assignments of tracks (E,) at steps or later, or where the next track begins."""
        since = np.clip(step - self._first_step, 0, self._steps - 1)
        return np.searchsorted(self._when, track * self._steps + since)

    def _compare(self, left: Ints, end: Ints, right: Ints, begin: Ints) -> Floats:
        """The log likelihood ratio (E,) that ``left`` up to ``end`` and ``right`` from ``begin`` on are one person."""
        ratio = np.zeros(len(left))
        for low in range(0, len(left), BATCH):
            part = slice(low, low + BATCH)
            ratio[part] = self._ratio(left[part], end[part], right[part], begin[part])
        return ratio

    def _ratio(self, left: Ints, end: Ints, right: Ints, begin: Ints) -> Floats:
        if len(self._seen) == 0:
            return np.zeros(len(left))
        low, high = self._known[self._starts[left]], self._known[end]
        before, is_before, last = self._window(high[:, None] - 1 - np.arange(WINDOW), low, high)
        low, high = self._known[begin], self._known[self._starts[right + 1]]
        after, is_after, first = self._window(low[:, None] + np.arange(WINDOW), low, high)
        distance = usual_distance(self._values, before, is_before, after, is_after)
        ratio = self._calibration.log_ratio(distance, np.abs(first - last) * self._step_s)
        return np.where(is_before.any(axis=1) & is_after.any(axis=1), ratio, 0.0)

    def _window(self, places: Ints, low: Ints, high: Ints) -> tuple[Ints, Bools, Ints]:
        """The descriptors at ``places`` (E, WINDOW), which of them are from ``low`` to before ``high`` and within
        ``WITHIN_S`` of the nearest one, and the step of that, (E,).
        """
        inside = (places >= low[:, None]) & (places < high[:, None])
        places = np.where(inside, places, 0)
        step = self._seen[places]
        inside &= np.abs(step - step[:, :1]) * self._step_s <= WITHIN_S
        return self._which[places], inside, step[:, 0]
