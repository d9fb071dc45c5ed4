"""The report about people: identities over time, numbers that agree, doubts and intervals."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import log
from mcaptrack.evaluation.events import MatchRule
from mcaptrack.evaluation.people import LEAST_PEOPLE, PersonScores, intervals, person_scores
from mcaptrack.extensions.report.figures import counts_over_time, identity_timeline, mean_numbers, pieces
from mcaptrack.extensions.report.identity_events import find_doubts, summarize_events
from mcaptrack.extensions.report.page import LogReport, gather, page
from mcaptrack.schema import Frame
from mcaptrack.viewing.charts import Line
from tests.worlds import crossing_tracks, ns, tracks_at, write_eventful


@pytest.fixture(scope="module")
def eventful(tmp_path_factory) -> Path:
    return write_eventful(tmp_path_factory.mktemp("eventful") / "walk.mcap")


@pytest.fixture(scope="module")
def told(eventful) -> LogReport:
    with log.read(eventful) as opened:
        return gather(opened, None)


@pytest.fixture(scope="module")
def text(eventful) -> str:
    with log.read(eventful) as opened:
        return page([gather(opened, None)])


# Scores of people


def swapped(rng: np.random.Generator) -> tuple[list[Frame], list[Frame]]:
    """Ground truth of random walkers, and tracks of it with noise, misses, false rows and new ids."""
    truth = crossing_tracks(rng, ticks=30)
    tracks = []
    offset = 0
    for frame in truth:
        offset += int(rng.random() < 0.1)
        kept = rng.random(len(frame.rows)) < 0.9
        people = {
            int(row["track_id"]) + 10 * offset: (row["x_m"] + rng.normal(0, 0.3), row["y_m"] + rng.normal(0, 0.3))
            for row in frame.rows[kept]
        }
        if rng.random() < 0.2:
            people[999] = (50.0, 50.0)
        tracks.append(Frame(frame.t_ns, frame.index, tracks_at(people)))
    return truth, tracks


@pytest.mark.parametrize("seed", range(3))
def test_sums_over_people_are_the_scores(seed):
    truth, tracks = swapped(np.random.default_rng(seed))
    found = person_scores(truth, tracks, MatchRule("metres", 1.0))
    (scored,) = mcaptrack.evaluation.evaluate(
        [mcaptrack.evaluation.EvaluationInput("a", truth, [mcaptrack.evaluation.Candidate("tracks", None, tracks)])],
        mcaptrack.evaluation.EvaluateOptions(similarities=("metres",), gates_m=(1.0,)),
    ).results
    counts = scored.score.counts
    assert found.switches.sum() == counts["IDSW"] > 0
    assert found.hits.sum() == counts["IDTP"]
    assert found.matched.sum() == counts["TP"]
    assert (found.rows.sum(), found.false_rows) == (counts["TP"] + counts["FN"], counts["FP"])
    assert found.idf1() == pytest.approx(2 * counts["IDTP"] / (2 * counts["IDTP"] + counts["IDFP"] + counts["IDFN"]))


def people(rows, matched, hits, switches, false_rows=0) -> PersonScores:
    none = np.empty(0, np.int64)
    columns = (np.array(column) for column in (rows, matched, hits, switches))
    return PersonScores(np.arange(len(rows)), *columns, false_rows, none, none, none, none)


def test_a_change_of_all_people_is_sure_and_that_of_one_is_not():
    rows = [100] * 12
    before = people(rows, rows, [60] * 12, [2] * 12)
    all_better = people(rows, rows, [80] * 12, [1] * 12)
    one_better = people(rows, rows, [100, *[60] * 11], [0, *[2] * 11])
    assert (intervals([before], [all_better]).idf1_change.sign, intervals([all_better], [before]).idf1_change.sign) == (
        1,
        -1,
    )
    assert intervals([before], [all_better]).idf1_change.low == pytest.approx(0.2)
    assert intervals([before], [one_better]).idf1_change.sign == 0
    assert intervals([before], [all_better]).switches_change == pytest.approx((-1, -1, -1))


def test_too_few_people_and_other_people_give_no_interval():
    few = people([9] * (LEAST_PEOPLE - 1), *[[9] * (LEAST_PEOPLE - 1)] * 2, [0] * (LEAST_PEOPLE - 1))
    found = intervals([few], [few])
    assert (found.idf1_change.is_known, found.idf1_change.sign, found.idf1[0].value) == (False, 0, 1.0)
    assert intervals([few], [few, few]) is None
    assert intervals([few], [few._replace(ids=few.ids + 1)]) is None


# One number for one thing


def test_the_page_has_one_number_of_switches_for_each_kind_of_tracks(told, text):
    (before,) = {int(number) for number in re.findall(r"tracks as given: (\d+) identity switch", text)}
    (after,) = {int(number) for number in re.findall(r"re-tracked: (\d+) identity switch", text)}
    assert (before, after) == (2, 1)
    values = told.headline.values("IDSW")
    assert values == [before, after]
    assert [int(one.switches.sum()) for one in told.people.values()] == values
    assert f"<dd>{before}\N{NO-BREAK SPACE}→ {after}" in text
    assert all(len(one.events) == count for one, count in zip(told.channel_events, values, strict=True))


# Identities over time


def bars(values) -> dict[str, list[list[tuple[str, float, float]]]]:
    """Ids with their seconds of each lane, by the name of the row."""
    found = {}
    for row in values["rows"]:
        lanes = []
        for lane in row["lanes"]:
            titles = [piece["title"].replace("\N{NO-BREAK SPACE}s", "") for piece in lane["pieces"]]
            lanes.append([re.fullmatch(r"(\d+): ([\d.]+) to ([\d.]+)", title).groups() for title in titles])
        found[row["name"]] = lanes
    return found


def test_each_person_has_a_lane_for_the_tracker_above_one_for_the_re_tracked(told):
    found = bars(identity_timeline(told))
    assert list(found) == ["50", "90"]
    assert found["50"] == [
        [("50", "0.0", "24.0")],
        [("1", "0.0", "8.0"), ("2", "8.0", "16.0"), ("3", "16.0", "24.0")],
        [("1", "0.0", "16.0"), ("3", "16.0", "24.0")],
    ]
    assert found["90"] == [[("90", "0.0", "24.0")]] * 3


@given(st.lists(st.integers(0, 2), max_size=40), st.lists(st.integers(1, 4), min_size=40, max_size=40))
def test_pieces_cover_their_rows_and_nothing_twice(identity, steps):
    t_ns = np.cumsum(np.array(steps[: len(identity)], np.int64)) * 10**9
    found = pieces(np.array(identity, np.int64), t_ns, 0, 1e9)
    seconds = (t_ns / 1e9).tolist()
    for at, one in zip(seconds, identity, strict=True):
        assert [piece.identity for piece in found if piece.first_s <= at < piece.last_s] == [one]
    assert all(a.last_s <= b.first_s for a, b in itertools.pairwise(found))
    assert sum(piece.last_s - piece.first_s for piece in found) <= len(identity) + 1e-9


@given(st.lists(st.integers(0, 5), min_size=1, max_size=400))
def test_people_over_time_keep_their_mean(counts):
    frames = [Frame(ns(t), t, tracks_at(dict.fromkeys(range(count), (0.0, 0.0)))) for t, count in enumerate(counts)]
    at_s, found = counts_over_time(frames, 0, max(len(counts) - 1, 1))
    assert (np.diff(at_s) > 0).all()
    assert 0 <= found.min() <= found.max() <= max(counts)
    if len(counts) <= 160:
        assert found.tolist() == counts


@pytest.mark.parametrize(
    ("first", "last", "words"),
    [
        (0, 9, "On average: tracker 4.0, ground truth 8.0."),
        (
            5,
            9,
            "On average, from 5.0 to 9.0 seconds: tracker 8.0, ground truth 8.0.",
        ),  # nobody is counted as missing before
        (0, 4, "On average, from 0.0 to 4.0 seconds: tracker 0.0, ground truth 8.0."),
        (20, 30, "On average, each while it is there: tracker 4.0, ground truth 8.0."),
    ],
)
def test_mean_numbers_are_of_the_time_that_both_have(first, last, words):
    tracker = Line("tracker", "tracks", np.arange(10.0), np.repeat([0.0, 8.0], 5))
    truth = Line("ground truth", "truth", np.arange(first, last + 1.0), np.full(last + 1 - first, 8.0))
    assert mean_numbers([tracker, truth], "seconds") == words


# Maps and doubts


def joined(jump_m: float, other: bool) -> tuple[list[Frame], list[Frame]]:
    """Tracks that join the tracker's 1 and 2 over a gap of 2 s, a ``jump_m`` away; and the ground truth, another
    person after the gap if ``other``.
    """
    tracks, truth = [], []
    for tick in range(40):
        x_m = 0.4 * tick + (jump_m if tick >= 20 else 0.0)
        if not 15 <= tick < 20:
            rows = tracks_at({7: (x_m, 0.0)})
            rows["source_id"] = 1 if tick < 15 else 2
        else:
            rows = tracks_at({})
        tracks.append(Frame(ns(tick / 2.5), tick, rows))
        truth.append(Frame(ns(tick / 2.5), tick, tracks_at({4 if other and tick >= 18 else 3: (x_m, 0.0)})))
    return tracks, truth


@pytest.mark.parametrize(
    ("other", "verdict"), [(False, "agrees: both are person 3"), (True, "person 3 before, person 4")]
)
def test_doubts_say_how_far_a_repair_is_from_the_expected_place(other, verdict):
    tracks, truth = joined(2.5, other)
    found = mcaptrack.evaluation.events.find_events(tracks, truth)
    told = summarize_events("/a", found.events, None, tracks, truth, (0, ns(16)))
    scores = person_scores(truth, tracks, MatchRule("metres", 1.0))
    (doubt,) = find_doubts(told, tracks, scores)
    assert doubt.away_m == pytest.approx(2.5)
    assert (doubt.is_right, verdict in doubt.text(), "2.5\N{NO-BREAK SPACE}m from" in doubt.text()) == (
        not other,
        True,
        True,
    )
    (alone,) = find_doubts(told, tracks, None)
    assert (alone.is_right, alone.verdict) == (None, "")
    nothing, _ = joined(0.0, False)
    assert find_doubts(told, nothing, None) == []


def test_the_farthest_repair_is_the_first_whenever_it_happened():
    near, far = joined(1.5, False)[0], joined(2.5, False)[0]
    both = []
    for one, other in zip(near, far, strict=True):
        rows = other.rows.copy()
        rows["track_id"] = 8
        rows["source_id"] += 10
        rows["y_m"] += 20
        both.append(Frame(one.t_ns, one.index, np.concatenate([one.rows, rows]).astype(one.rows.dtype)))
    found = mcaptrack.evaluation.events.find_events(both, None)
    told = summarize_events("/a", found.events, None, both, None, (0, ns(16)))
    doubts = find_doubts(told, both, None)
    assert [(int(one.event.row["track_id"]), round(one.away_m, 1)) for one in doubts] == [(8, 2.5), (7, 1.5)]
