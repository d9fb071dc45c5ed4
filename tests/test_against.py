"""Trackers compared without ground truth: signs are those that the truth gives, and no trick makes a tracker better."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import TRACKS, Frame
from tests.commands import call, done
from tests.worlds import boxed, ns, replace_channel, tracks_at, walk, write_channels

PEOPLE, TICKS = 14, 100


def tracked(seed: int, broken: float, missed: float = 0.05, noise_m: float = 0.08) -> list[Frame]:
    """People on parallel lines as a tracker sees them, which gives new ids at each sample with a probability."""
    rng = np.random.default_rng(seed)
    names, free, out = list(range(1, PEOPLE + 1)), PEOPLE + 1, []
    for tick in range(TICKS):
        places = {}
        for person in range(PEOPLE):
            if rng.random() < broken:
                names[person], free = free, free + 1
            if rng.random() > missed:
                x, y = rng.normal((0.5 * tick * (-1) ** person, 3.0 * person), noise_m)
                places[names[person]] = (x, y)
        out.append(Frame(ns(tick / 2.5), tick, tracks_at(places)))
    return out


def changed(frames: list[Frame], change: Callable[[np.ndarray, int], np.ndarray]) -> list[Frame]:
    return [frame._replace(rows=change(frame.rows.copy(), frame.index)) for frame in frames]


def renamed(rows: np.ndarray, ids: np.ndarray) -> np.ndarray:
    rows["track_id"] = ids
    return rows[np.unique(ids, return_index=True)[1]] if len(rows) else rows


def moved(rows: np.ndarray, sigma_m: float, seed: int) -> np.ndarray:
    for name in ("x_m", "y_m"):
        rows[name] += np.random.default_rng([seed, len(name)]).normal(0, sigma_m, len(rows))
    return rows


#: What a tracker may do to come out better: it loses half of the people, and so on.
TRICKS = {
    "half": lambda rows, tick: rows[rows["track_id"] % 2 == 0],
    "merged": lambda rows, tick: renamed(rows, np.ones(len(rows), int)),
    "pairs": lambda rows, tick: renamed(rows, rows["track_id"] // 2),
    "split": lambda rows, tick: renamed(rows, rows["track_id"] * 1000 + tick // 5),
    "moved": lambda rows, tick: moved(rows, 0.7, tick),
    "twice": lambda rows, tick: np.concatenate([rows, renamed(moved(rows.copy(), 0.3, tick), rows["track_id"] + 5000)]),
}


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> Path:
    """A log of several trackers, with re-tracking of one, and ``copy`` and ``part``, which repeat it under other ids."""
    path = tmp_path_factory.mktemp("against") / "log.mcap"
    good, truth = tracked(2, 0.005), walk(lambda n: {p: (0.5 * n * (-1) ** p, 3.0 * p) for p in range(PEOPLE)}, TICKS)
    others = {name: changed(good, trick) for name, trick in TRICKS.items()}
    write_channels(path, samples=tracked(1, 0.03), good=good, poor=tracked(3, 0.15), truth=truth, **others)
    done("retrack", path, "-q")
    with log.read(path) as opened:
        reference = list(opened.frames("/camera/retracks", TRACKS))
    copy = changed(reference, lambda rows, tick: renamed(rows, rows["track_id"] + 700))
    for name, frames in {"copy": copy, "part": changed(copy, TRICKS["half"])}.items():
        replace_channel(path, f"/camera/{name}", frames)
    return path


def difference(path: Path, before: str, after: str):
    (row,) = mcaptrack.evaluate(path, against="/camera/retracks", topic=[before, after]).differences
    assert (row.before, row.after) == (f"/camera/{before}", f"/camera/{after}")
    return row


def test_the_sign_is_that_of_the_truth(compared):
    scores = mcaptrack.evaluate(compared, topic=["poor", "good"], gate_m=1.0, similarity="metres")
    wanted = scores.score("IDF1", "good") - scores.score("IDF1", "poor")
    forth, back = difference(compared, "poor", "good"), difference(compared, "good", "poor")
    assert (forth.verdict, back.verdict, wanted > 0.05) == ("better", "worse", True)
    assert forth.idf1 == pytest.approx(-back.idf1)
    assert forth.low <= forth.idf1 <= forth.high


@pytest.mark.parametrize("trick", TRICKS)
def test_no_trick_makes_a_tracker_better(compared, trick):
    row = difference(compared, "good", trick)
    # Rows that the reference lacks may be of people that it misses.
    assert row.verdict == ("undecided" if trick == "twice" else "worse"), row


@pytest.mark.parametrize("name", ["samples", "retracks/online", "copy", "part"])
def test_relatives_of_the_reference_and_copies_of_it_are_never_better(compared, name):
    row = difference(compared, "split", name)
    assert row.idf1 > 0.05
    assert (row.verdict, f"/camera/{name}" in row.why) == ("undecided", True)


def test_several_logs_are_compared_together(compared, tmp_path):
    one, both = (
        mcaptrack.evaluate(paths, against="retracks", topic=["poor", "good"]).differences[0]
        for paths in (compared, [compared, compared])
    )
    assert one.idf1 == pytest.approx(both.idf1)
    assert both.high - both.low < one.high - one.low


def test_levels_are_not_printed(compared):
    outcome = call("evaluate", compared, "--against", "retracks", "--topic", "poor", "--topic", "good", "--json")
    printed = json.loads(outcome.out)
    assert (printed["against"], printed["results"]) == ("retracks", [])
    assert [row["verdict"] for row in printed["differences"]] == ["better"]
    assert "no ground truth" in call("evaluate", compared, "--against", "retracks").out
    with pytest.raises(McaptrackError, match="no ground truth"):
        mcaptrack.evaluate(compared, against="retracks").score("IDF1")


@pytest.mark.parametrize("topic", ["retracks/online", "good", "truth"])
def test_only_offline_retracking_is_a_reference(compared, topic):
    with pytest.raises(McaptrackError, match="can't be a reference"):
        mcaptrack.evaluate(compared, against=topic)


def test_without_metres_there_is_no_comparison(tmp_path):
    path = write_channels(tmp_path / "log.mcap", a=walk(lambda n: {1: (n, 0)}, 20))
    replace_channel(
        path, "/camera/retracks", [f._replace(rows=boxed({1: (2.0, 3.0)})) for f in walk(lambda n: {}, 20)], "retrack"
    )
    with pytest.raises(McaptrackError, match="metres"):
        mcaptrack.evaluate(path, against="retracks")


def test_retracking_is_not_scored_against_itself(compared, tmp_path):
    path = tmp_path / "own.mcap"
    path.write_bytes(compared.read_bytes())
    with log.read(path) as opened:
        own = list(opened.frames("/camera/retracks", TRACKS))
    replace_channel(path, "/camera/truth", changed(own, lambda rows, tick: renamed(rows, rows["track_id"] + 9)))
    for words in ((), ("--json",)):
        outcome = call("evaluate", path, *words)
        assert (outcome.code, len(outcome.err.splitlines()), "--against" in outcome.err) == (1, 1, True)
