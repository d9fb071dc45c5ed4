"""Appearance: whether two parts of tracks look like one person, as a log likelihood ratio that the log itself gives.

It is one more likelihood beside that of motion, where tracks are linked, cut and exchanged offline. In a log in which
it doesn't tell people apart, as in pictures of people in uniforms, it isn't used (see ``AppearanceCalibration``).

Descriptors of people in pictures are histograms of the colours of the upper body and of the legs. Histograms forget
where exactly a colour is, so that they change little while a person walks and turns. They say what a person wears and
nothing else: there are no features of faces, and none that outlast a change of clothes.

Letters: N boxes, C assignments, S descriptors, D bytes of one, E pairs of tracks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Bools, Floats, Image, Ints, taken
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.ragged import find_rows, group_index, ragged_range, run_starts
from mcaptrack.schema import APPEARANCE, BodyPart, Rows
from mcaptrack.schema.framing import rows_at
from mcaptrack.transforms.retrack.motion_model import Tracks

#: Boxes are brought to this size (width, height) in pixels; the parts of the body are these rows of it.
_WIDTH, _HEIGHT = 16, 32
_PARTS: Final = ((5, 16), (16, 29))
#: The lightness and both axes of colour (CIELAB in 8 bits): the ends of the first and of the last bin, and how many.
#: Bins are wide and a pixel counts for two of them, so that a change of light moves little.
_AXES: Final = ((20.0, 235.0, 8), (98.0, 158.0, 10), (98.0, 158.0, 10))
#: The names of the bins of one part of the body, in their order.
BINS: Final = tuple(
    f"{axis}_{number + 1}"
    for axis, (_, _, count) in zip(("lightness", "green_red", "blue_yellow"), _AXES, strict=True)
    for number in range(count)
)
#: The length of a descriptor, in bytes.
LENGTH: Final = len(_PARTS) * len(BINS)
#: Boxes that another one covers to more than this share may show another person.
_MAX_COVERED: Final = 0.35
#: Smaller boxes have too few pixels, and those that end at a border of the picture show less than a person.
_MIN_WIDTH_PX, _MIN_HEIGHT_PX = 4.0, 8.0
#: Boxes are at a border that is so many of their widths or heights away: that far people walk between two samples.
_BORDER_WIDTHS, _BORDER_HEIGHTS = 1.0, 0.25


def describe(picture: Image, boxes: Floats) -> NDArray[np.uint8]:
    """Histograms of colours in boxes, as roots of shares: (N, ``LENGTH``), where 255 is 1.

    The distance of two rows is that of Hellinger, for each part and axis alike. Background shows at the sides of a box:
    its middle counts most.

    Parameters
    ----------
    picture : (height, width, 3) uint8
        Blue, green, red.
    boxes : (N, 4) float
        Left, top, width and height in px. They overlap the picture, as those of which ``is_clear`` is true.
    """
    import cv2

    height, width = picture.shape[:2]
    patches = np.empty((len(boxes), _HEIGHT, _WIDTH, 3), np.uint8)
    corners = np.rint(np.hstack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]])).astype(np.int64)
    for patch, (left, top, right, bottom) in zip(patches, corners.tolist(), strict=True):
        inside = picture[max(top, 0) : min(bottom, height), max(left, 0) : min(right, width)]
        patch[:] = cv2.resize(inside, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_AREA)
    if len(boxes) == 0:
        return np.empty((0, LENGTH), np.uint8)
    lab: Image = np.asarray(cv2.cvtColor(patches.reshape(-1, _WIDTH, 3), cv2.COLOR_BGR2LAB), np.uint8)
    lab = lab.reshape(patches.shape)
    parts = [_histogram(lab[:, low:high, :, axis], *_AXES[axis]) for low, high in _PARTS for axis in range(3)]
    return np.asarray(np.rint(255 * np.sqrt(np.hstack(parts) / len(parts))), np.uint8)


def mean_shares(descriptors: NDArray[np.uint8], group: Ints, count: int) -> Floats:
    """The mean histograms of groups of descriptors (N, ``LENGTH``): shares of pixels, (count, parts of the body, BINS).

    ``group`` (N,) is from 0 to below ``count``; no group is empty. The shares of each axis are 1 together.
    """
    squares = np.square(descriptors / 255.0)
    mean = np.stack([np.bincount(group, column, count) for column in squares.T], axis=-1)
    shares = mean.reshape(count, len(_PARTS), len(BINS))
    starts = np.cumsum([0, *(bins for _, _, bins in _AXES[:-1])])
    total = np.add.reduceat(shares, starts, axis=2)
    return np.asarray(shares / np.repeat(total, [bins for _, _, bins in _AXES], axis=2))


def _histogram(values: NDArray[np.uint8], low: float, high: float, count: int) -> Floats:
    """The share of pixels in each bin, (N, count), of values (N, rows, ``_WIDTH``); the middle columns count most."""
    number, rows, width = values.shape
    middle = (width - 1) / 2
    weight = 1 - ((np.arange(width) - middle) / (middle - 1)) ** 2
    weights = np.broadcast_to(np.maximum(weight, 0.0), (number, rows, width)).ravel()
    place = np.clip((values.ravel() - low) / (high - low) * (count - 1), 0, count - 1)
    lower: Ints = np.minimum(place.astype(np.int64), count - 2)
    upper_share = place - lower
    cell = np.repeat(np.arange(number) * count, rows * width) + lower
    total = np.bincount(cell, weights * (1 - upper_share), number * count)
    total += np.bincount(cell + 1, weights * upper_share, number * count)
    return np.asarray(total.reshape(number, count) / weights[: rows * width].sum())


def is_clear(boxes: Floats, width_px: int, height_px: int) -> Bools:
    """Whether boxes (N, 4) of one picture are large enough, inside of it, and not covered by another one, (N,)."""
    x0, y0, w, h = boxes.T
    x1, y1 = x0 + w, y0 + h
    is_inside = (x0 >= 1) & (y0 >= 1) & (x1 <= width_px - 1) & (y1 <= height_px - 1)
    wide = np.minimum(x1[:, None], x1) - np.maximum(x0[:, None], x0)
    tall = np.minimum(y1[:, None], y1) - np.maximum(y0[:, None], y0)
    common = np.maximum(wide, 0) * np.maximum(tall, 0)
    np.fill_diagonal(common, 0)
    is_covered = common.max(axis=1, initial=0.0) > _MAX_COVERED * w * h
    return np.asarray(is_inside & (w >= _MIN_WIDTH_PX) & (h >= _MIN_HEIGHT_PX) & ~is_covered)


def at_border(boxes: Floats, width_px: int, height_px: int) -> Bools:
    """Whether boxes (N, 4) are next to a border of the picture, (N,)."""
    x0, y0, w, h = boxes.T
    aside, above = _BORDER_WIDTHS * w, _BORDER_HEIGHTS * h
    is_aside = (x0 < aside) | (x0 + w > width_px - aside)
    return np.asarray(is_aside | (y0 < above) | (y0 + h > height_px - above))


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
        return find_rows((self.t_ns, self.track_id), (t_ns, track_id))


# Log likelihood ratios of distances between descriptors, calibrated in the log itself.
#
# Two pictures of a person differ, by light, pose and background, and more so after a longer time; two people may be
# dressed alike. How much either is the case differs from log to log. So distances are compared with those that the
# log is known to have: within one input track over a gap of about that length (one person, nearly always), and
# between input tracks that are there at one time (two people). Nothing is fitted on other recordings.
#
# Letters: C samples, S descriptors, D bytes of one, B pieces of a track, P pairs of these.


#: Log likelihood ratios are no larger than this, and this share of comparisons is of something else than two people:
#: of a pole before one of them, or of the person beside. So looking different says less than looking alike.
MOST: Final = 3.0
_OTHERWISE: Final = 0.1
#: From this separation on, less its standard error, appearance is used.
LEAST_SEPARATION: Final = 0.6
#: The number of descriptors that are compared on either side of a gap, those within so many seconds of the nearest, and
#: the quantile of the distances between them that is taken for theirs.
WINDOW: Final = 8
WITHIN_S: Final = 5.0
_QUANTILE: Final = 0.25
#: Gaps from each of these on, in seconds, are compared with each other; longer ones than the last aren't looked at.
_LAGS_S: Final = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 16.0])
_LONGEST_S: Final = 24.0
#: The number of tracks that have to be seen before and after gaps of a length; else what people differ by then is
#: what they differ by after shorter gaps, times a factor.
_MIN_TRACKS: Final = 3
_LONGER: Final = 1.4
#: The least that a person differs by after a gap, as a share of the noise of descriptors.
_LEAST_DRIFT: Final = 0.1
#: Two people are compared if one could have walked to where the other is: those are who may be confused.
_REACH_M, _SPEED_M_PER_S = 1.0, 2.5
#: Standard deviation of bias and slope before any pair was seen.
_PRIOR_SD: Final = 2.0
#: The width of bins of log ratios of distances, and their number to either side of 0.
_BIN, _BINS = 0.05, 200
#: Longer logs are calibrated by so many pieces, of so many stretches.
_MOST_PIECES, _STRETCHES = 800, 8
#: Pairs of pieces that are computed with at once.
BATCH: Final = 10_000


class AppearanceCalibration(NamedTuple):
    """The meaning of distances between descriptors in one log.

    ``noise`` is the variance of single descriptors, summed over their values; ``drift`` what a person changes over gaps
    of each class of ``_LAGS_S``. ``bias`` and ``slope`` make log odds of how much larger a distance is than that.
    ``separation`` is the probability that two people differ more than one does, with its standard ``error``, and
    ``tracks`` how many tracks were seen before and after a gap.
    """

    noise: float
    drift: Floats
    bias: float
    slope: float
    separation: float
    error: float
    tracks: int

    def excess(self, distance: Floats, gap_s: Floats) -> Floats:
        """The logarithms of squared distances (P,), relative to those of one person."""
        drift = self.drift[np.searchsorted(_LAGS_S, gap_s, "right") - 1]
        return np.asarray(np.log(np.maximum(distance, 1e-9) / (self.noise + drift)))

    def log_ratio(self, distance: Floats, gap_s: Floats) -> Floats:
        """The log likelihood ratio (P,) of one person against two."""
        ratio = np.clip(self.bias - self.slope * self.excess(distance, gap_s), -MOST, MOST)
        return np.asarray(np.log((1 - _OTHERWISE) * np.exp(ratio) + _OTHERWISE))

    def facts(self) -> dict[str, str]:
        """Facts for the provenance."""
        is_used = "used" if self.tells_apart else "not used"
        return {"appearance": is_used, "separation": f"{self.separation:.3f}", "tracks": str(self.tracks)}

    @property
    def tells_apart(self) -> bool:
        """Whether people look different enough for appearance to be used."""
        return self.separation - self.error >= LEAST_SEPARATION and self.slope > 0


def usual_distance(values: NDArray[np.uint8], mine: Ints, is_one: Bools, other: Ints, is_other: Bools) -> Floats:
    """A low quantile of the squared distances of some descriptors to others, (E,): rows of ``values``, (E, WINDOW).

    A pole before a person changes one descriptor, and a mean with it; most pairs stay as they are.
    """
    out = np.zeros(len(mine))
    for low in range(0, len(mine), BATCH):
        here = slice(low, low + BATCH)
        a, b = values[mine[here]] / np.float32(255), values[other[here]] / np.float32(255)
        squared = np.square(a).sum(2)[:, :, None] + np.square(b).sum(2)[:, None] - 2 * (a @ b.swapaxes(1, 2))
        squared = np.where(is_one[here, :, None] & is_other[here, None], squared, np.inf).reshape(len(a), -1)
        squared.sort(axis=1)
        count = is_one[here].sum(axis=1) * is_other[here].sum(axis=1)
        at = np.floor(_QUANTILE * np.maximum(count - 1, 0)).astype(np.int64)
        distances = squared[np.arange(len(a)), at]
        out[here] = np.where(np.isfinite(distances), np.maximum(distances, 0), 0)
    return out


class _Pieces(NamedTuple):
    """Up to ``WINDOW`` consecutive descriptors of one input track (B,): the first and the last step and position; the
    number of the track, and when it begins and ends.
    """

    first: Ints
    last: Ints
    from_m: Floats
    to_m: Floats
    track: Ints
    begins: Ints
    ends: Ints


def calibrate(descriptors: Descriptors, tracks: Tracks, step_s: float) -> AppearanceCalibration | None:
    """Measure how descriptors tell the input tracks of samples (C,) apart.

    None if no two tracks that are there at one time were seen before and after a gap.
    """
    tracks = taken(tracks, tracks.look >= 0)
    tracks = taken(tracks, np.lexsort((tracks.step, tracks.source)))
    if len(tracks.look) < 2:
        return None
    step, starts = tracks.step, run_starts(tracks.source)
    begin, number = np.flatnonzero(starts), np.cumsum(starts) - 1
    within = (np.arange(len(number)) - begin[number]) % WINDOW
    first, end = np.flatnonzero(within == 0), np.append(begin[1:], len(number)) - 1
    last, track = np.append(first[1:], len(number)) - 1, number[first]
    sides = step[first], step[last], tracks.xy_m[first], tracks.xy_m[last]
    before, after, gap_s = _pairs(_Pieces(*sides, track, step[begin][track], step[end][track]), step_s)
    two = np.flatnonzero(within > 0)
    now, then = (descriptors.values[tracks.look[which]] / np.float32(255) for which in (two, two - 1))
    noise = max(float(np.median(np.square(now - then).sum(axis=1))) if len(two) else 1.0, 1e-6)
    windows = GapWindows(descriptors, tracks._replace(track=np.cumsum(within == 0) - 1), step_s)
    distance, *_ = windows.distances(before, windows.starts[before + 1], after, windows.starts[after])
    lag = np.searchsorted(_LAGS_S, gap_s, "right") - 1
    low, high = np.sort([track[before], track[after]], axis=0)
    is_same = low == high
    count = len(np.unique(low[is_same]))
    if count < 2 or is_same.all():  # nothing to compare with
        return None
    drift = _drift(distance - noise, lag, track[before], is_same, noise)
    calibration = AppearanceCalibration(noise, drift, 0.0, 0.0, 0.5, 0.5, count)
    _, pair, often = np.unique(low * (high.max() + 1) + high, return_inverse=True, return_counts=True)
    weight = 1 / often[pair]
    bias, slope, separation = _fit(calibration.excess(distance, gap_s), is_same, weight)
    # that of the rank sum of as many independent members
    error = np.sqrt((1 / weight[is_same].sum() + 1 / weight[~is_same].sum()) / 12)
    return calibration._replace(bias=bias, slope=max(slope, 0.0), separation=separation, error=float(error))


def _pairs(pieces: _Pieces, step_s: float) -> tuple[Ints, Ints, Floats]:
    """Pairs (P,) of successive pieces, of one track or of two that exist at the same time within reach, and the seconds
    between them.
    """
    order = np.argsort(pieces.first, kind="stable")
    if len(order) > _MOST_PIECES:
        order = order[np.arange(len(order)) % (len(order) // _STRETCHES) < _MOST_PIECES // _STRETCHES]
    begins, ends = pieces.first[order], pieces.last[order]
    low = np.searchsorted(begins, ends, "right")
    many = np.searchsorted(begins, ends + round(_LONGEST_S / step_s), "right") - low
    before, after = order[group_index(many)], order[ragged_range(low, many)]
    gap_s = np.asarray((pieces.first[after] - pieces.last[before]) * step_s, np.float64)
    way = pieces.from_m[after] - pieces.to_m[before]
    meet = np.minimum(pieces.ends[before], pieces.ends[after]) > np.maximum(pieces.begins[before], pieces.begins[after])
    meet &= np.hypot(way[:, 0], way[:, 1]) <= _REACH_M + _SPEED_M_PER_S * gap_s
    counts = meet | (pieces.track[before] == pieces.track[after])
    return before[counts], after[counts], gap_s[counts]


def _drift(beyond: Floats, lag: Ints, track: Ints, is_same: Bools, noise: float) -> Floats:
    """The change of one person over gaps of each class, from squared distances beyond noise (P,); never less later."""
    drift: list[float] = []
    for each in range(len(_LAGS_S)):
        those = np.flatnonzero(is_same & (lag == each))
        least = drift[-1] if drift else _LEAST_DRIFT * noise
        if len(np.unique(track[those])) >= _MIN_TRACKS:
            drift.append(max(float(np.median(beyond[those])), least))
        else:
            drift.append(least * _LONGER if drift else noise)
    return np.array(drift)


def _fit(excess: Floats, is_same: Bools, weight: Floats) -> tuple[float, float, float]:
    """Bias and slope of the log odds that pairs (P,) are of one person, where as many are of one as of two; and the
    probability that a pair of two exceeds one of one.

    A logistic regression on histograms. Pairs of one track, or of the same two tracks, count for one together, because
    they say the same; and those of two people together for as many as those of one.
    """
    place = np.clip(np.rint(excess / _BIN).astype(np.int64) + _BINS, 0, 2 * _BINS)
    same, different = (np.bincount(place[of], weight[of], 2 * _BINS + 1) for of in (is_same, ~is_same))
    total = min(float(same.sum()), float(different.sum()))
    same, different = same * total / same.sum(), different * total / different.sum()
    below = np.cumsum(same) - same / 2
    separation = float((below * different).sum() / total**2)
    x = np.stack([np.ones(2 * _BINS + 1), -_BIN * (np.arange(2 * _BINS + 1) - _BINS)], axis=1)
    estimate = np.zeros(2)
    for _ in range(50):
        is_one = 1 / (1 + np.exp(-np.clip(x @ estimate, -30, 30)))
        slope = x.T @ (same - (same + different) * is_one) - estimate / _PRIOR_SD**2
        curve = (x * ((same + different) * is_one * (1 - is_one))[:, None]).T @ x + np.eye(2) / _PRIOR_SD**2
        change = np.linalg.solve(curve, slope)
        estimate = estimate + change
        if np.abs(change).max() < 1e-9:
            break
    return float(estimate[0]), float(estimate[1]), separation


class Appearance(NamedTuple):
    """The looks of tracks, and the meaning of distances between ``descriptors``. Steps have ``step_s`` seconds."""

    descriptors: Descriptors
    calibration: AppearanceCalibration
    step_s: float

    @classmethod
    def of(cls, descriptors: Descriptors | None, tracks: Tracks, step_s: float) -> Appearance | None:
        """The appearance of tracks with these descriptors; None if none was seen."""
        if descriptors is None or len(descriptors.t_ns) == 0 or len(tracks.look) == 0:
            return None
        which = np.where((tracks.look >= 0) & descriptors.is_clear[tracks.look], tracks.look, -1)
        calibration = calibrate(descriptors, tracks._replace(look=which), step_s)
        return None if calibration is None else cls(descriptors, calibration, step_s)


class GapWindows:
    """Descriptors next to gaps between and within tracks (K,), which are numbered by ascending id."""

    def __init__(self, descriptors: Descriptors, tracks: Tracks, step_s: float) -> None:
        order = tracks.order
        step, starts = tracks.step[order], run_starts(tracks.track[order])
        self._values, self._step_s = descriptors.values, step_s
        self.starts = np.append(np.flatnonzero(starts), len(order))
        number = np.cumsum(starts) - 1  # of the track of each assignment
        self._first_step, self._steps = int(step.min(initial=0)), int(np.ptp(step)) + 2 if len(step) else 2
        self._when = number * self._steps + step - self._first_step
        sample = tracks.look[order]
        is_seen = (sample >= 0) & descriptors.is_clear[sample]
        self.at_border = (sample >= 0) & descriptors.at_border[sample]
        self._seen, self._which = np.append(step[is_seen], 0), np.append(sample[is_seen], 0)  # the last one of none
        self._known = np.append(0, np.cumsum(is_seen))  # the number of descriptors before each assignment

    def since(self, track: Ints, step: Ints) -> Ints:
        """The first assignments of tracks (E,) at steps or later, or where the next track begins."""
        since = np.clip(step - self._first_step, 0, self._steps - 1)
        return np.searchsorted(self._when, track * self._steps + since)

    def distances(self, left: Ints, end: Ints, right: Ints, begin: Ints) -> tuple[Floats, Floats, Bools]:
        """The distances (E,) of ``left`` up to the assignment ``end`` to ``right`` from ``begin`` on, the seconds
        between them, and whether something is seen of both.
        """
        low, high = self._known[self.starts[left]], self._known[end]
        before, is_before, last = self._window(high[:, None] - 1 - np.arange(WINDOW), low, high)
        low, high = self._known[begin], self._known[self.starts[right + 1]]
        after, is_after, first = self._window(low[:, None] + np.arange(WINDOW), low, high)
        distance = usual_distance(self._values, before, is_before, after, is_after)
        are_seen = np.asarray(is_before.any(axis=1) & is_after.any(axis=1))
        return distance, np.abs(first - last) * self._step_s, are_seen

    def _window(self, places: Ints, low: Ints, high: Ints) -> tuple[Ints, Bools, Ints]:
        """The descriptors at ``places`` (E, WINDOW), which of them are from ``low`` to before ``high`` and within
        ``WITHIN_S`` of the nearest one, and the step of that, (E,).
        """
        inside = (places >= low[:, None]) & (places < high[:, None])
        places = np.where(inside, places, 0)
        step = self._seen[places]
        inside &= np.abs(step - step[:, :1]) * self._step_s <= WITHIN_S
        return self._which[places], inside, step[:, 0]


class Sides:
    """Compares what is seen on the two sides of gaps between and within tracks, which are numbered by ascending id."""

    def __init__(self, appearance: Appearance, tracks: Tracks) -> None:
        self._calibration = appearance.calibration
        self._windows = GapWindows(appearance.descriptors, tracks, appearance.step_s)

    def of_tracks(self, end: Ints, begin: Ints) -> Floats:
        """The log likelihood ratio (E,) that the end of one track and the beginning of another are one person.

        A person who leaves the picture and comes back has two tracks. So where both are at its border, looking alike
        says nothing.
        """
        windows = self._windows
        stop, start = windows.starts[end + 1], windows.starts[begin]
        ratio = self._compare(end, stop, begin, start)
        return np.where(windows.at_border[stop - 1] & windows.at_border[start], np.minimum(ratio, 0), ratio)

    def of_swaps(self, track: Ints, other: Ints, since: Ints, until: Ints) -> Floats:
        """The log likelihood ratio (E,) that two tracks were exchanged from step ``since`` to ``until``."""
        ratio, at = np.zeros(len(track)), self._windows.since
        for before, after, sign in ((track, other, 1), (other, track, 1), (track, track, -1), (other, other, -1)):
            ratio += sign * self._compare(before, at(before, since), after, at(after, until + 1))
        return ratio

    def _compare(self, left: Ints, end: Ints, right: Ints, begin: Ints) -> Floats:
        """The log likelihood ratio (E,) that ``left`` up to ``end`` and ``right`` from ``begin`` on are one person."""
        distance, gap_s, are_seen = self._windows.distances(left, end, right, begin)
        return np.where(are_seen, self._calibration.log_ratio(distance, gap_s), 0.0)


# The appearance of tracks as rows: the mean histograms of the pictures in which they are seen clearly.
#
# Letters: S descriptors, T frames, K tracks.


def appearance_rows(descriptors: Descriptors, track: Ints, times_ns: Ints) -> Iterator[Rows]:
    """The rows of Appearance at each of ``times_ns`` (T,), ordered by track and part of the body.

    ``track`` (S,) is the track that each descriptor is of, or -1. The rows of a track stand at the last of its
    descriptors that count, which is at one of the times; a track without any has none.
    """
    used = np.flatnonzero(descriptors.is_clear & (track >= 0))
    ids, group = np.unique(track[used], return_inverse=True)
    t_ns = descriptors.t_ns[used]
    first, last = np.full(len(ids), np.iinfo(np.int64).max), np.zeros(len(ids), np.int64)
    np.minimum.at(first, group, t_ns)
    np.maximum.at(last, group, t_ns)
    rows = APPEARANCE.empty(len(ids) * len(BodyPart))
    of_parts = {
        "track_id": ids,
        "pictures": np.bincount(group, minlength=len(ids)),
        "duration_s": (last - first) / NS_PER_S,
    }
    for name, values in of_parts.items():
        rows[name] = np.repeat(values, len(BodyPart))
    rows["body_part"] = np.tile(list(BodyPart), len(ids))
    shares = mean_shares(descriptors.values[used], group, len(ids)).reshape(len(rows), len(BINS))
    for name, share in zip(BINS, shares.T, strict=True):
        rows[name] = share
    at = np.repeat(last, len(BodyPart))
    order = np.argsort(at, kind="stable")
    return rows_at(APPEARANCE, rows.take(order), at[order], times_ns)
