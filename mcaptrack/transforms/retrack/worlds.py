"""Plausible worlds: identities of tracks, and which are people, as they may be where offline re-tracking is not sure.

Each world is the best set of links under scores with noise of Gumbel's distribution (perturb and MAP: Papandreou and
Yuille 2011), by the same solver. What was decided for reasons that no single link has (encounters, corrections of
people, the sweep before) counts for its links as much as it takes for them to be the best ones without noise.

Letters: W worlds, K tracklets, E candidate links, P tracks.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.schema import WORLDS, Rows
from mcaptrack.transforms.retrack.hypotheses import Hypotheses, best_next, following, named
from mcaptrack.transforms.retrack.linking import chains

#: The scale of the noise of scores: joins hold in as many worlds as are right. (Chosen on synthetic crowds.)
NOISE = 1.35
#: The scale of the noise of the log odds that tracks are people.
PERSON_NOISE = 1.0
#: Tracks of one log are people or clutter together: so many log odds in all tracks of a world of synthetic crowds (a
#: standard deviation), and by how much log odds are larger once that is known (Zeger, Liang and Albert 1988).
_OF_LOG: Final = 2.0
_KNOWN: Final = (1 + 0.346 * _OF_LOG**2) ** 0.5
#: Worlds are drawn with this seed, so the same log has the same ones; links and people have noise of their own.
_SEED, _OF_LINKS, _OF_PEOPLE = 2011, 0, 1
#: What was decided is better than anything else by so much at least, without noise.
_LEAST: Final = 1e-3
#: Log odds of what is certain, with or without noise.
_CERTAIN: Final = 50.0


class Worlds(NamedTuple):
    """The track of each tracklet in each world (W, K), and whether it is kept as a person (W, K)."""

    track: Ints
    kept: Bools


def draw_worlds(
    count: int,
    hypotheses: Hypotheses,
    track: Ints,
    log_odds: Floats,
    kept: Bools,
    min_confidence: float,
    least_steps: int,
    seed: int = 0,
) -> Worlds:
    """Draw worlds; the first ones are the same whatever the ``count``.

    Parameters
    ----------
    count : int
        The number of worlds W.
    hypotheses : Hypotheses
        Those about the tracks that were decided.
    track : (K,) of int
        The track of each tracklet as it was decided.
    log_odds : (P,) of float
        Of each of these tracks to be a person; infinite for certain.
    kept : (P,) of bool
        Which were kept.
    min_confidence : float
        As for the decision.
    least_steps : int
        What lasts fewer steps is no person, unless that is certain.
    seed : int
        Worlds of other tracks of the log have another seed.
    """
    tracklets, before, after, *_ = hypotheses
    size = len(tracklets.first)
    decided = np.flatnonzero(following(track, tracklets.begins)[before] == after)
    gain = favouring(decided, hypotheses, hypotheses.scored().gain(min_confidence))
    of = np.unique(track, return_inverse=True)[1]
    is_person = np.where(kept, np.maximum(log_odds, _LEAST), np.minimum(log_odds, -_LEAST))
    is_certain = is_person > _CERTAIN
    is_person = np.clip(is_person, -_CERTAIN, _CERTAIN)
    out = Worlds(np.empty((count, size), np.int64), np.empty((count, size), bool))
    for world, root in enumerate(draw_links(count, hypotheses, gain, seed)):
        out.track[world] = named(root, track)
        total = np.bincount(root, draw_people(world, is_person, seed)[of] * tracklets.samples, minlength=size)
        first, last = np.full((2, size), [[np.iinfo(np.int64).max], [0]])
        np.minimum.at(first, root, tracklets.begins)
        np.maximum.at(last, root, tracklets.ends)
        certain = np.bincount(root, is_certain[of], minlength=size) > 0
        out.kept[world] = (certain | ((total > 0) & (last - first >= least_steps)))[root]
    return out


def draw_links(count: int, hypotheses: Hypotheses, gain: Floats, seed: int = 0) -> Iterator[Ints]:
    """For each world the first tracklet of the chain that has each one (K,); ``gain`` (E,) is that without noise."""
    tracklets, before, after, *_ = hypotheses
    size = len(tracklets.first)
    for world in range(count):
        random = np.random.default_rng([_SEED, _OF_LINKS, seed, world])
        leaves, comes = random.gumbel(size=(2, size))
        out, into = random.gumbel(size=(2, len(gain)))
        off = (out - leaves[before] + into - comes[after]) / 2
        yield chains(best_next(before, after, gain + NOISE * off, size), tracklets.begins)


def draw_people(world: int, log_odds: Floats, seed: int = 0) -> Floats:
    """The log odds (P,) that tracks are people in a world: above 0 with the probability that ``log_odds`` (P,) say."""
    random = np.random.default_rng([_SEED, _OF_PEOPLE, seed, world])
    noise = _OF_LOG * random.normal() + random.logistic(size=len(log_odds))
    return np.asarray(_KNOWN * log_odds + PERSON_NOISE * noise)


def world_rows(worlds: Worlds, hypotheses: Hypotheses, step_s: float, steps: Ints) -> Iterator[Rows]:
    """The rows of Worlds at each of ``steps``: those of the tracklets that begin there, by world and input id."""
    tracklets, count = hypotheses.tracklets, len(worlds.track)
    for low, high in pairwise(np.append(0, np.searchsorted(tracklets.begins, steps, "right")).tolist()):
        here = low + np.argsort(tracklets.source[low:high], kind="stable")
        rows = WORLDS.empty(count * len(here))
        rows["world"] = np.repeat(np.arange(1, count + 1), len(here))
        rows["kept"] = kept = worlds.kept[:, here].ravel()
        rows["track_id"] = np.where(kept, worlds.track[:, here].ravel(), -1)
        rows["source_id"] = np.tile(tracklets.source[here], count)
        rows["duration_s"] = np.tile((tracklets.ends - tracklets.begins)[here] * step_s, count)
        rows["frames"] = np.tile(tracklets.samples[here], count)
        yield WORLDS.check(rows)


def favouring(decided: Ints, hypotheses: Hypotheses, gain: Floats) -> Floats:
    """Gains (E,) with which the links ``decided`` are the best set.

    They are raised by as little as possible in all: a linear programme over the prices of ends and of beginnings, the
    dual one of the assignment. Links between ends and beginnings that have none are lowered.
    """
    from scipy.optimize import linprog
    from scipy.sparse import csr_array

    _, before, after, *_ = hypotheses
    size = len(hypotheses.tracklets.first)
    gain = gain.copy()
    ends, begins = np.zeros((2, size), bool)
    ends[before[decided]] = begins[after[decided]] = True
    is_free = ~ends[before] & ~begins[after]
    gain[is_free] = np.minimum(gain[is_free], -_LEAST)
    need = gain + _LEAST
    need[decided] = np.maximum(gain[decided], _LEAST)
    counts = np.flatnonzero(~is_free & (need > 0))
    has_price = np.stack([ends[before[counts]], begins[after[counts]]])
    at = np.stack([before[counts], size + after[counts]])[has_price]
    limits = csr_array((-np.ones(len(at)), (np.nonzero(has_price)[1], at)), shape=(len(counts), 2 * size))
    cost = np.concatenate([ends, begins]).astype(np.float64)
    price = linprog(cost, A_ub=limits, b_ub=-need[counts], method="highs").x
    gain[decided] = price[before[decided]] + price[size + after[decided]]
    return gain
