"""Fit what tells right links from wrong ones and people from false tracks, on synthetic scenes with faults.

Writes mcaptrack/transforms/retrack/weights.json. Scenes are those of `crowds.py`: squares, streets, crossings and open
places with groups, people who stand, and bicycles; each is corrupted by `corruptions.py` with faults of its own. They
are sampled and re-tracked, and what re-tracking decides about is compared with who was there: links online first; then
what ends and beginnings of tracklets choose; then which of the tracks that come of these choices are people; and, in
other scenes, how likely what is decided so is right. Links in pictures are fitted by `fit_pictures.py`. No recording is
used. With --check it says whether the same comes out now. With --held nothing is written: scenes of other seeds score
the weights of the file, and say how reliable probabilities are. Some ten minutes of one core.

    .venv/bin/python tools/fit_retrack.py [--check | --held] [--seeds 101 102] [--steps 300]

Letters: K tracks, E candidate links, F features, N rows of trajectories.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
import fit_pictures
from corruptions import with_people
from crowds import drawn
from regression import Chosen, logistic, multinomial, shift, show_reliability
from reproduce import on_clock

from mcaptrack import __version__
from mcaptrack.evaluation.aligned import make_matchup
from mcaptrack.evaluation.metrics import combine, score, summary
from mcaptrack.geometry.arrays import taken
from mcaptrack.geometry.assignment import assign, solve
from mcaptrack.geometry.ragged import find_rows
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.frame_columns import collect
from mcaptrack.transforms import PROFILES, Sample
from mcaptrack.transforms.retrack import false_tracks, hypotheses, linking, offline
from mcaptrack.transforms.retrack.decisions import JOINS, draw_worlds, find_joins
from mcaptrack.transforms.retrack.hypotheses import Hypotheses, Tracklets
from mcaptrack.transforms.retrack.motion_model import Tracks, Trajectories, filtered, to_trajectories
from mcaptrack.transforms.retrack.passes import LikelihoodPass, Movers, motion_model
from mcaptrack.transforms.retrack.weights import WEIGHTS, Choices, Logistic, columns, probability

DEFAULT = PROFILES["default"]
#: The classes of gaps, as in ``hypotheses.GAPS_S``.
GAP_NAMES: Final = ("next step", "up to 1.7 s", "up to 5 s", "longer")
Found = TypeVar("Found")
#: Who is who at encounters changes neither links nor how likely a track is, and takes longest.
FITTED = replace(DEFAULT, resolve_swaps=False)
SEEDS, HELD, STEPS = (101, 102), (201,), 300
#: Which tracks are people is told in scenes of these seeds, too: a scene has few of them that are doubtful.
MORE = (103, 104)
#: Joins are judged in scenes of these seeds and so many steps.
JUDGED, JUDGED_STEPS = (111, 112, 113), 100
#: A track is that of a person who is as near, by most of its first or last so many rows.
GATE_M, ROWS = 1.0, 8
#: A tracklet is that of the person of most of its first or last so many samples.
NEAR: Final = 4
#: The longest gap of pairs that weights are fitted on; and the least log odds of the best set of links.
MAX_GAP_S, LEAST = 30.0, -4.0


class Run(NamedTuple):
    """A scene: its truth, and all that offline re-tracking is given."""

    true: list[Frame]
    samples: list[Frame]
    args: tuple[Any, ...]
    rows: np.ndarray

    def people(self, tracks: Tracks) -> np.ndarray:
        """The person of each sample of tracks (C,), or -1."""
        step, ids, person = self.rows[:, 0] - self.rows[0, 0], self.rows[:, 1], self.rows[:, -1]
        at = find_rows((ids.astype(int), step.astype(int)), (tracks.source, tracks.step))
        return np.where(at >= 0, person[at].astype(int), -1)


def runs(seeds: Iterable[int], steps: int) -> Iterator[Run]:
    """Scenes, tracked online."""
    for seed in seeds:
        for number, (truth, how) in enumerate(drawn(seed, steps)):
            yield prepare(truth, with_people(truth, how, np.random.default_rng([seed, number, 2])))


def prepare(truth: np.ndarray, made: np.ndarray) -> Run:
    """A scene from the rows of the truth and of a tracker, with the person of each."""
    clock = np.arange(int(truth[:, 0].min()), int(truth[:, 0].max()) + 1)
    true = on_clock(truth, clock)
    samples = [frame for (frame,) in Sample(start_ns=true[0].t_ns)(on_clock(made[:, :4], clock))]
    run = LikelihoodPass(DEFAULT, Movers(), collect(TRACKS, samples))
    return Run(true, samples, (DEFAULT, motion_model(DEFAULT, run.noise_m), run), made)


class _Reached(Exception):
    """A function of offline re-tracking is called."""


def reached(name: str, *given: Any) -> tuple[Any, ...]:
    """What a function of offline re-tracking is called with; re-tracking goes no further."""
    function, seen = getattr(offline, name), []

    def stop(*given: Any) -> Any:
        seen.append(given)
        raise _Reached

    setattr(offline, name, stop)
    try:
        offline.offline_tracks(*given)
    except _Reached:
        pass
    finally:
        setattr(offline, name, function)
    return seen[0]


def owners(run: Run, step: np.ndarray, xy_m: np.ndarray, length: np.ndarray) -> np.ndarray:
    """The true id at each of the positions (N, 2), or -1; ``length`` is that of the track of each."""
    owner = np.full(len(step), -1)
    order = np.argsort(step, kind="stable")
    where = dict(zip(run.args[2].steps.tolist(), run.true, strict=True))
    for here in np.split(order, np.flatnonzero(np.diff(step[order])) + 1):
        people = where[int(step[here[0]])].rows
        off = np.hypot(*(xy_m[here, None, k] - people[name] for k, name in enumerate(("x_m", "y_m"))))
        # The longer track is the person; one beside it is a double.
        off = np.where(off < GATE_M, off + 1.5 * (1 - length[here] / length.max())[:, None], np.inf)
        row, column = assign(off, 10.0)
        owner[here[row]] = people["track_id"][column]
    return owner


def owners_of(run: Run, paths: Trajectories) -> np.ndarray:
    """The true id of each row of the trajectories (N,), or -1."""
    length = np.diff(paths.first)
    seen = np.flatnonzero(np.isfinite(paths.xy_m[:, 0]))
    owner = np.full(len(paths.step), -1)
    owner[seen] = owners(run, paths.step[seen], paths.xy_m[seen], np.repeat(length, length)[seen])
    return owner


def usual(owner: np.ndarray, paths: Trajectories, way: int) -> np.ndarray:
    """The true id of each track (K,) at its beginning (``way`` 1) or end (-1); -1 for none."""
    out = np.full(len(paths.first) - 1, -1)
    for track, (low, high) in enumerate(zip(paths.first[:-1], paths.first[1:], strict=True)):
        ids = owner[low:high][::way]
        ids = ids[ids >= 0][:ROWS]
        out[track] = np.bincount(ids).argmax() if len(ids) else -1
    return out


@dataclass
class Pairs:
    """Candidate links (E,) of one scene, from ends to beginnings of ``count`` tracks, and which are right."""

    count: int
    ends: np.ndarray
    begins: np.ndarray
    features: np.ndarray
    right: np.ndarray

    def best(self, gain: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The log odds of the best set of links, which of them are right, and the seconds of their gaps."""
        table, right, gap_s = np.zeros((3, self.count, self.count))
        good = gain > LEAST
        table[self.ends[good], self.begins[good]] = gain[good] - LEAST
        right[self.ends, self.begins] = self.right
        gap_s[self.ends, self.begins] = self.features[:, linking.FEATURES.index("gap")]
        row, column = solve(-table)
        made = table[row, column] > 0
        where = row[made], column[made]
        return table[where] + LEAST, right[where], gap_s[where]


def pairs_of(run: Run) -> Pairs:
    """The candidate links of a scene."""
    log, tracks = reached("hypotheses_of", FITTED, *run.args[1:])
    model = log.model
    _, _, paths = to_trajectories(tracks.step, tracks.track, tracks.xy_m)
    first, last = paths.first[:-1], paths.first[1:] - 1
    forward, backward = filtered(model, paths)
    sides = linking.TrackEnds(model, paths.step[first], paths.step[last], taken(backward, first), taken(forward, last))
    parts = [(i, j) for i, j, _ in linking.pairs_in_reach(sides, MAX_GAP_S)]
    i, j = map(np.concatenate, zip(*parts, strict=True))
    gaps = sides.gaps(i, j)
    gap_s, found = gaps.seconds, columns(linking.FEATURES, linking.motion_terms(sides.model, gaps))
    owner = owners_of(run, paths)
    ends, begins = usual(owner, paths, -1), usual(owner, paths, 1)
    same = np.flatnonzero((ends[i] >= 0) & (ends[i] == begins[j]))
    nearest = same[np.lexsort((gap_s[same], i[same]))]
    _, at = np.unique(i[nearest], return_index=True)  # later returns are links of later tracks
    right = np.zeros(len(i))
    right[nearest[at]] = 1
    return Pairs(len(sides.begins), i, j, found, right)


class People(NamedTuple):
    """The tracks of a scene: their features (K, F), the share of each that is a person, its number of samples, and
    whether it stands for the whole log.
    """

    features: np.ndarray
    share: np.ndarray
    count: np.ndarray
    throughout: np.ndarray


def people_of(run: Run) -> People:
    """The tracks of a scene."""
    model, paths, smoothed, log = reached("log_odds_in_log", FITTED, *run.args[1:])
    observed = np.isfinite(paths.xy_m[:, 0])
    count = np.add.reduceat(observed.astype(float), paths.first[:-1])
    own = np.add.reduceat((owners_of(run, paths) >= 0).astype(float), paths.first[:-1])
    found = false_tracks.features(model, paths, smoothed)
    throughout = false_tracks.stand_throughout(paths, smoothed, found, log, model.step_s)
    return People(found, own / count, count, throughout)


class Judged(NamedTuple):
    """Features of decisions (D, F), and which of them are right (D,)."""

    features: np.ndarray
    are_right: np.ndarray


def choices_of(run: Run) -> Chosen:
    """What the ends and beginnings of tracklets should choose in a scene."""
    log, tracks = reached("hypotheses_of", *run.args)
    tracklets, before, after, gap, terms, leaves, comes, _ = Hypotheses.of(log.model, tracks, log.max_gap_s)
    begins, ends = sides_of(tracks, tracklets, run.people(tracks))
    same = np.flatnonzero((ends[before] >= 0) & (ends[before] == begins[after]))
    right = []
    for side, other in ((before, tracklets.begins[after]), (after, -tracklets.ends[before])):
        nearest = same[np.lexsort((other[same], side[same]))]
        link = np.full(len(ends), -1)
        link[side[nearest][::-1]] = nearest[::-1]
        right.append(link)
    is_right = (right[0][before] == np.arange(len(before))) & (right[1][after] == np.arange(len(before)))
    link_after, link_before = (np.where((link >= 0) & is_right[link], link, -1) for link in right)
    link_after, link_before = np.where(ends < 0, -2, link_after), np.where(begins < 0, -2, link_before)
    return Chosen(before, after, gap, terms, leaves, comes, link_after, link_before)


def sides_of(tracks: Tracks, tracklets: Tracklets, people: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The person at the beginning and at the end of each tracklet (K,): that of most of its first and last samples."""
    order = np.lexsort((tracks.step, tracklets.of))
    low = np.searchsorted(tracklets.of[order], np.arange(len(tracklets.first)))
    parts = np.split(people[order], low[1:])
    return np.array([_most(part[:NEAR]) for part in parts]), np.array([_most(part[-NEAR:]) for part in parts])


def _most(people: np.ndarray) -> int:
    somebody = people[people >= 0]
    return int(np.bincount(somebody).argmax()) if 2 * len(somebody) >= len(people) else -1


def decisions_of(run: Run) -> tuple[Judged, Judged, Judged]:
    """The joins of the offline tracks of a scene, and which tracks are people, of those that are too short apart.

    Joins of two false tracks are neither right nor wrong.
    """
    decided, model, *_ = reached("decision_rows", *run.args)
    tracks, people = decided.tracks, run.people(decided.tracks)
    begins, ends = sides_of(tracks, decided.hypotheses.tracklets, people)
    link = find_joins(decided, model.step_s).link
    sides = np.stack([ends[decided.hypotheses.before[link]], begins[decided.hypotheses.after[link]]])
    counts = (sides >= 0).any(axis=0)
    joins = Judged(decided.hypotheses.scored().log_odds()[link][counts], (sides[0] == sides[1])[counts])
    _, track, count = np.unique(tracks.track, return_inverse=True, return_counts=True)
    is_person = np.bincount(track, people >= 0) * 2 >= count
    log, *_ = reached("_people", *run.args)
    lasts = [np.ptp(tracks.step[tracks.track == name]) for name in np.unique(tracks.track)]
    short = np.array(lasts) < log.least_steps
    return joins, *(Judged(decided.log_odds[some, None], is_person[some]) for some in (~short, short))


def worlds_of(run: Run) -> tuple[Judged, np.ndarray]:
    """In how many of 50 worlds each join of a scene holds, and which joins are right; and the number of people, the
    number that was decided, and those that 5 %, 50 % and 95 % of the worlds don't exceed.
    """
    log, decided = reached("_worlds", replace(DEFAULT, worlds=50), *run.args[1:])
    tracks, choices, tracklets = decided.tracks, decided.hypotheses, decided.hypotheses.tracklets
    some_worlds = draw_worlds(50, decided, DEFAULT.link_confidence, log.least_steps)
    begins, ends = sides_of(tracks, tracklets, run.people(tracks))
    link = find_joins(decided, run.args[1].step_s).link
    before, after = choices.before[link], choices.after[link]
    counts = (ends[before] >= 0) | (begins[after] >= 0)
    share = (some_worlds.track[:, before] == some_worlds.track[:, after]).mean(axis=0)
    joins = Judged(share[counts], (ends[before] == begins[after])[counts])
    many = [len(np.unique(track[kept])) for track, kept in zip(*some_worlds, strict=True)]
    people = np.unique(np.concatenate([frame.rows["track_id"] for frame in run.true]))
    return joins, np.array([len(people), decided.kept.sum(), *np.percentile(many, [5, 50, 95])])


def told(find: Callable[[Run], Found], scenes: list[Run], what: str) -> Iterator[Found]:
    """What is found in each scene; progress goes to stderr."""
    for number, run in enumerate(scenes, 1):
        yield find(run)
        print(f"{what}: {number} of {len(scenes)} scenes", file=sys.stderr, flush=True)


def fit_judged(names: tuple[str, ...], parts: Iterable[Judged]) -> dict[str, Any]:
    """The weights of how likely decisions are right."""
    features, right = (np.concatenate(members) for members in zip(*parts, strict=True))
    weights = logistic(features, right, np.ones(len(right)))
    return {"weights": named(names, weights[:-1]), "bias": round(float(weights[-1]), 3)}


def fit_choices(parts: Sequence[Chosen]) -> dict[str, Any]:
    """The weights of what ends and beginnings choose."""
    fitted = multinomial(parts, len(GAP_NAMES))
    links = dict(zip(GAP_NAMES, fitted.links, strict=True))
    ends, usual = hypotheses.CHOICES.end_terms, (*GAP_NAMES, "none")
    return {
        "links": {name: named(hypotheses.CHOICES.terms, weights) for name, weights in links.items()},
        "leaves": named(ends, fitted.leaves),
        "comes": named(ends, fitted.comes),
        "usual_leaves": named(usual, fitted.usual_leaves),
        "usual_comes": named(usual, fitted.usual_comes),
    }


def fit_decisions(scenes: list[Run]) -> dict[str, Any]:
    """The weights of joins that are made, and of tracks."""
    of_joins, of_people, of_short = zip(*told(decisions_of, scenes, "decisions"), strict=True)
    return {
        "joins": fit_judged(("end", "beginning"), of_joins),
        "decided": fit_judged(("log odds",), of_people),
        "decided short": fit_judged(("log odds",), of_short),
    }


def fit_links(pairs: list[Pairs]) -> dict[str, Any]:
    """The weights of links.

    The best of several competing links is right more often than its own score says: that is fitted in a second step.
    """
    group = np.repeat(np.arange(len(pairs)), [len(one.right) for one in pairs])
    features, right = (np.concatenate([getattr(one, name) for one in pairs]) for name in ("features", "right"))
    weights = logistic(features, right, np.ones(len(right)), group)
    best = [one.best(one.features @ weights[:-1] + weights[-1]) for one in pairs]
    gain, is_right, gap_s = (np.concatenate(parts) for parts in zip(*best, strict=True))
    scale, shift = logistic(gain[:, None], is_right, np.ones(len(gain)))
    likely, gap = probability(scale * gain + shift), np.searchsorted(linking._GAPS_S, gap_s)
    return {
        "weights": named(linking.FEATURES, scale * weights[:-1]),
        "bias": round(float(scale * weights[-1] + shift), 3),
        "usual": round(float(is_right.mean()), 3),
        "usual by gap": [round(float(likely[gap == one].mean()), 3) for one in range(len(linking._BY_GAP))],
        "least": round(float(scale * LEAST + shift), 2),
    }


def fit_people(parts: list[People]) -> dict[str, Any]:
    """The weights of tracks.

    What it counts that a track stands for the whole log is fitted in a second step, so that others are judged as if
    nothing were known of it.
    """
    features, share, count, throughout = (np.concatenate(members) for members in zip(*parts, strict=True))
    weights = logistic(features, share, count)
    names = false_tracks.FEATURES
    found: dict[str, Any] = {"weights": named(names, weights[:-1]), "bias": round(float(weights[-1]), 3)}
    odds = (features @ weights[:-1] + weights[-1])[throughout]
    found["stands throughout"] = round(shift(odds, share[throughout], count[throughout]), 2)
    return found | {"mean": named(names, features.mean(axis=0)), "spread": named(names, features.std(axis=0))}


def named(names: tuple[str, ...], weights: np.ndarray) -> dict[str, float]:
    """Weights by the names of their features."""
    return dict(zip(names, np.round(weights, 3).tolist(), strict=True))


def install(module: Any, name: str, fitted: dict[str, Any]) -> None:
    """Let a module decide by these weights, in this process; ``name`` is that of its regression."""
    weights = fitted["weights"]
    setattr(module, name, Logistic(tuple(weights), np.array([*weights.values()]), fitted["bias"], fitted))


def held(seeds: list[int], steps: int) -> None:
    """Print IDF1 / MOTA / switches of scenes, before and after re-tracking by the weights of the file, how many of the
    decisions are right, and what worlds say of joins and of the number of people.
    """
    parts: tuple[list, list] = ([], [])
    outcomes, in_worlds = [], []
    for run in runs(seeds, steps):
        outcomes.append(decisions_of(run))
        in_worlds.append(worlds_of(run))
        rows = offline.offline_tracks(*run.args)[0][""]
        found = [frame._replace(rows=new) for frame, new in zip(run.samples, rows, strict=True)]
        for side, frames in zip(parts, (run.samples, found), strict=True):
            side.append(score(make_matchup(run.true, frames, "metres", GATE_M), "motmetrics"))
    for name, side in zip(("input", "re-tracked"), parts, strict=True):
        row = summary(combine(side))
        print(f"{name:12}{100 * row['IDF1']:.1f} / {100 * row['MOTA']:.1f} / {row['IDSW']}")
    made, *people = ([np.concatenate(both) for both in zip(*one, strict=True)] for one in zip(*outcomes, strict=True))
    show_reliability("joins", JOINS.probability(made[0]), made[1])
    for name, (log_odds, are_people) in zip(("people and false tracks", "short tracks"), people, strict=True):
        is_person = probability(log_odds[:, 0])
        is_right = np.where(is_person >= 0.5, are_people, ~are_people)
        show_reliability(name, np.maximum(is_person, 1 - is_person), is_right)
    joins, numbers = zip(*in_worlds, strict=True)
    show_reliability("joins in worlds", *(np.concatenate(both) for both in zip(*joins, strict=True)))
    people, decided, low, middle, high = np.array(numbers).T
    inside = ((low <= people) & (people <= high)).mean()
    print(f"people of a scene: {people.mean():.1f}; decided {decided.mean():.1f}; in worlds {middle.mean():.1f}")
    print(
        f"  the 90 % interval, {low.mean():.1f} to {high.mean():.1f}, holds them in {100 * inside:.0f} % of the scenes"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", help=f"by default {SEEDS}; with --held {HELD}")
    parser.add_argument("--steps", type=int, default=STEPS, help="how many steps of each scene")
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--check", action="store_true", help="compare the file with what comes out now")
    either.add_argument("--held", action="store_true", help="score the weights of the file on other scenes")
    given = parser.parse_args()
    seeds = given.seeds or list(HELD if given.held else SEEDS)
    if given.held:
        held(seeds, given.steps)
        return
    scenes = list(runs(seeds, given.steps))
    pairs = list(told(pairs_of, scenes, "links"))
    links = fit_links(pairs)
    install(linking, "_LINKS", links)
    linking._PRIOR = links["usual"]
    linking.MIN_LOG_ODDS = hypotheses.MIN_LOG_ODDS = links["least"]
    linking._BY_GAP = np.array(links["usual by gap"])
    more = [*scenes, *runs(MORE, given.steps)]
    choices = fit_choices(list(told(choices_of, more, "choices")))
    hypotheses.CHOICES = Choices.of(choices)
    others = list(runs(JUDGED, JUDGED_STEPS))
    people = fit_people(list(told(people_of, more, "people")))
    install(false_tracks, "_PEOPLE", people)
    false_tracks._THROUGHOUT = people["stands throughout"]
    for name in ("mean", "spread"):
        setattr(false_tracks, f"_{name.upper()}", np.array(list(people[name].values())))
    offline.PERSON = offline.SHORT = Logistic((), np.ones(1), 0.0, {})  # what is fitted
    offline._SHORT = np.inf
    judged = fit_decisions(others)
    card = {
        "made_by": f"tools/fit_retrack.py --seeds {' '.join(map(str, seeds))} --steps {given.steps}, "
        f"mcaptrack {__version__}",
        "data": f"{len(more)} synthetic scenes of mcaptrack with faults of trackers, and {len(others)} others for "
        "joins and decisions; no recordings",
        "licence": "Apache-2.0",
        "links": str(sum(int(one.right.sum()) for one in pairs)),
    }
    pictures = fit_pictures.fitted(fit_pictures.read(fit_pictures.SEEDS))
    fitted = {"card": card, "links": links, "choices": choices, "people": people} | judged | pictures
    text = json.dumps(fitted, indent=1) + "\n"
    if given.check:
        print("the same" if WEIGHTS.read_text(encoding="utf-8") == text else text)
        return
    WEIGHTS.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
