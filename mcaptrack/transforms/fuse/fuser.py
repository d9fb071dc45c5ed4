"""Fuse the boxes of several cameras on the ground. Letters: N boxes, G groups."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.neighbours import squared_sigmas
from mcaptrack.geometry.ragged import ragged_range
from mcaptrack.schema import DETECTIONS, SIGHTINGS, Frame, Schema
from mcaptrack.schema.framing import split_rows
from mcaptrack.transforms.fuse.view import Joined, Places, Views, joined, pairs_along_x
from mcaptrack.transforms.protocol import Suited, check_options, context, option

# Evidence of the frame before: people stand near a place for longer than one frame, most false boxes do not.
#
# Letters: F frames, G groups, P pairs.


#: How often a person was detected in the frame before, and how often something was detected near a false box.
_STAYS, _NEAR_BY_CHANCE = 0.85, 0.3
#: How far people walk, in metres per second; and how far at most they seem to be from where they were.
_PACE_M_PER_S, _FARTHEST_M = 1.0, 2.5
#: A frame longer ago than this is ignored.
_MOST_S: Final = 1.0
#: Groups that are less probable than this are no people of the frame before.
_LEAST_PROBABLE: Final = 0.02


class LastFrame(NamedTuple):
    """The places of a frame (G,), and how probable a person is at each; ``is_known`` is False without any boxes."""

    t_ns: int
    places: Places
    certainty: Floats
    is_known: bool


def persistence(
    block: Joined, certainty: Floats, before: LastFrame | None, max_sigma: float
) -> tuple[Floats, LastFrame]:
    """The change of the log-odds of each group of a block (G,), and the last frame, for the block that follows.

    A person at one place is expected at one place of the frame before, and the other way round: each group is paired
    with one of the frame before at most, near and probable ones first. Nothing is added to a frame if the one before
    has no boxes at all, or is too long ago.

    Parameters
    ----------
    block : Joined
    certainty : (G,)
        The probability of a person at each place, by its own frame.
    before : LastFrame or None
        The frame before the block.
    max_sigma : float
        Places are paired if they are at most so many standard deviations apart.
    """
    count, sizes = len(certainty), np.bincount(block.frame, minlength=len(block.frames))
    ends = np.cumsum(sizes)
    times = np.array([frame.t_ns for frame in block.frames], np.int64)
    last = slice(int(ends[-1] - sizes[-1]), int(ends[-1]))
    after = LastFrame(
        int(times[-1]), Places(block.centre.xy_m[last], block.centre.cov[last]), certainty[last], bool(block.counts[-1])
    )
    begun = before or LastFrame(int(times[0]), Places(np.empty((0, 2)), np.empty((0, 3))), np.empty(0), is_known=False)
    # Groups of the frame before the block come first; frames are numbered from it.
    extra = len(begun.certainty)
    xy_m = np.concatenate([begun.places.xy_m, block.centre.xy_m])
    cov = np.concatenate([begun.places.cov, block.centre.cov])
    probable = np.concatenate([begun.certainty, certainty])
    frame = np.concatenate([np.zeros(extra, np.int64), block.frame + 1])
    step_s = np.diff(times, prepend=begun.t_ns) / NS_PER_S
    counts = np.append([begun.is_known], block.counts > 0)[:-1] & (step_s > 0) & (step_s <= _MOST_S)
    # Each group is looked for with those of its own frame, and again with those of the next one.
    likely = np.flatnonzero(probable >= _LEAST_PROBABLE)
    first, second = pairs_along_x(
        np.tile(xy_m[likely], (2, 1)), np.append(frame[likely], frame[likely] + 1), _FARTHEST_M
    )
    is_now, was = first < len(likely), second >= len(likely)
    now, then = likely[first[is_now & was]], likely[second[is_now & was] - len(likely)]
    of = frame[now] - 1
    x, y = (xy_m[now] - xy_m[then]).T
    walked = np.array([1.0, 0.0, 1.0]) * ((_PACE_M_PER_S * step_s[of]) ** 2)[:, None]
    apart = squared_sigmas(x, y, *(cov[now] + cov[then] + walked).T)
    fits = (apart <= max_sigma**2) & (x * x + y * y <= _FARTHEST_M**2)
    now, then, apart = now[fits], then[fits], apart[fits]
    order = np.lexsort((then, now, apart - 2 * np.log(probable[now]) - 2 * np.log(probable[then])))
    stays = np.zeros(extra + count)
    taken, continued = set[int](), set[int]()
    for new, other in zip(now[order].tolist(), then[order].tolist(), strict=True):
        if new not in taken and other not in continued:
            taken.add(new)
            continued.add(other)
            stays[new] = probable[other]
    stays = stays[extra:]
    odds = np.log(stays * (_STAYS / _NEAR_BY_CHANCE) + (1 - stays) * ((1 - _STAYS) / (1 - _NEAR_BY_CHANCE)))
    return np.where(counts[block.frame], odds, 0.0), after


#: How often a box of another object, or a false one, fits a group by chance.
_CHANCE: Final = 0.1
_LEAST, _MOST = 0.02, 0.98
#: Limits of people's motion for a tracker of the result (see ``motion_limits``).
_WALKS: Final = "person=:0.4::1.2"
_TRACKED: Final = MappingProxyType({"birth_score": 0.8, "confirm_score": 2.0, "max_age_s": 1.0, "class_limits": _WALKS})


@dataclass(frozen=True, kw_only=True)
class FootFuser:
    """Fuse boxes of several cameras that stand at the same place on the ground.

    Reads sightings: the boxes of all cameras at one time, with the positions and covariances of their feet on one
    ground plane. Writes detections of the scene: positions in metres, each the mean of the boxes that are joined,
    weighted by their certainty. No camera is twice in one. Their score is the probability that a person is there: a
    camera that should see the place, and has no box there, counts against it, as far as the place is in its picture and
    not hidden by others. With several cameras, a detection near it in the frame before counts for it, and none against.

    Examples
    --------
    Two cameras see one person, each along its own axis; a box of the first stands alone:

    >>> from mcaptrack.schema import SIGHTINGS, Frame
    >>> rows = SIGHTINGS.rows(
    ...     camera=[0, 1, 0], picture_ns=[0, 0, 0], box_row=[0, 0, 1], x_m=[1.3, 1.0, 9.0], y_m=[2.0, 2.2, 2.0],
    ...     cov_xx_m2=[0.09, 0.01, 0.09], cov_xy_m2=[0, 0, 0], cov_yy_m2=[0.01, 0.04, 0.01], class_id=[1, 1, 1])
    >>> [(fused, members)] = FootFuser(min_score=0.0)([Frame(0, 0, rows)])
    >>> fused.rows["x_m"].round(2).tolist(), fused.rows["seen_by"].tolist(), members.rows["detection"].tolist()
    ([1.03, 9.0], [2, 1], [0, 0, 1])
    """

    max_sigma: float = option(
        3.0, "boxes are joined if their feet are at most so many standard deviations apart", least=0.0, most=100.0
    )
    max_distance_m: float = option(1.2, "boxes are joined if their feet are at most so many metres apart", least=0.0)
    min_score: float = option(
        0.5, "leave out places where a person is less probable, as the other cameras show", least=0.0, most=1.0
    )
    noise: float = option(0.04, "noise of the lower edges of boxes, as a share of their heights", least=0.001, most=1.0)
    noise_m: float = option(0.1, "noise of the ground planes in metres", least=0.001, most=100.0)
    views: Views = context(tuple)

    reads: ClassVar[Schema] = SIGHTINGS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": DETECTIONS, "sightings": SIGHTINGS})

    #: Scores are probabilities, so that few tracks need begin by mistake; people who stand are seen all the time; and
    #: positions are exact enough to expect steady walks.
    suits: ClassVar[Mapping[str, Suited]] = MappingProxyType({"tracker": Suited("ground", _TRACKED)})

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def latency_s(self) -> Mapping[str, float]:
        """Each frame is fused by itself and the one before."""
        return MappingProxyType({"": 0.0, "sightings": 0.0})

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        yield from self.fused(self.joined(frames))

    def joined(self, frames: Iterable[Frame]) -> Iterator[Joined]:
        """Join the boxes of sightings, block by block; how well the cameras detect people has no influence."""
        return joined(frames, self.views, self.max_sigma, self.max_distance_m)

    def fused(self, blocks: Iterable[Joined]) -> Iterator[tuple[Frame, ...]]:
        """The detections of each frame of blocks, and its sightings with the number of their detections."""
        before: LastFrame | None = None
        for block in blocks:
            expected, odds = self._evidence(block)
            if len(self.views) > 1:  # there is nothing that could confirm the boxes of one camera alone
                more, before = persistence(block, _probability(odds), before, self.max_sigma)
                odds += more
            yield from self._detections(block, expected, _probability(odds))

    def _detections(self, block: Joined, expected: Ints, certainty: Floats) -> Iterator[tuple[Frame, ...]]:
        """Detections and sightings of a block, with how many cameras should see each group, and its score (G,)."""
        centre, seen, of = block.centre, block.seen, block.of
        kept = np.flatnonzero(certainty >= self.min_score)
        x, y = centre.xy_m[kept].T
        kept = kept[np.lexsort((y, x, block.frame[kept]))]  # whatever the order of the cameras
        sizes = np.bincount(block.frame[kept], minlength=len(block.frames))
        number = np.full(len(seen), -1, np.int64)
        number[kept] = ragged_range(0, sizes)
        classes = np.zeros(len(seen), np.int64)
        classes[of] = block.rows["class_id"]
        rows = DETECTIONS.rows(
            x_m=centre.xy_m[kept, 0],
            y_m=centre.xy_m[kept, 1],
            cov_xx_m2=centre.cov[kept, 0],
            cov_xy_m2=centre.cov[kept, 1],
            cov_yy_m2=centre.cov[kept, 2],
            score=certainty[kept],
            class_id=classes[kept],
            seen_by=seen[kept].sum(axis=1),
            expected_by=expected[kept],
        )
        members = block.rows.copy()
        members["detection"] = number[of]
        when, index = [frame.t_ns for frame in block.frames], [frame.index for frame in block.frames]
        yield from zip(
            split_rows(when, index, rows, np.cumsum(sizes)),
            split_rows(when, index, members, np.cumsum(block.counts)),
            strict=True,
        )

    def _evidence(self, block: Joined) -> tuple[Ints, Floats]:
        """The number of cameras that should see each place (G,), and the log-odds (G,) that a person is there."""
        seen = block.seen
        rate = np.full(seen.shape, np.nan)
        false = np.full(seen.shape[1], 0.5)
        for number, view in enumerate(self.views):
            rate[:, number] = view.rate(block.visible[:, number])
            false[number] = view.false_share
        expected = np.where(np.isnan(rate), seen, seen | (rate >= 0.5)).sum(axis=1)
        is_known = ~np.isnan(rate)
        rate = np.clip(rate, _LEAST, _MOST)
        # The first box is true or false as the boxes of its camera are; each further one agrees by more than chance.
        share = np.where(seen, np.clip(false, _LEAST, _MOST), 1.0).min(axis=1)
        odds = np.log((1 - share) / share)
        agrees = np.log(np.maximum(np.where(is_known, rate, 0.5), 0.3) / _CHANCE)
        lacks = np.log((1 - rate) / (1 - _CHANCE))
        odds += np.where(seen, agrees, np.where(is_known, np.minimum(lacks, 0.0), 0.0)).sum(axis=1)
        odds -= np.where(seen, agrees, np.inf).min(axis=1)  # the first one
        return expected, odds


def _probability(odds: Floats) -> Floats:
    out: Floats = 1 / (1 + np.exp(-odds))
    return out
