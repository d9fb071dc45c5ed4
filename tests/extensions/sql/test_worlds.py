"""Queries about worlds of re-tracking: medians and intervals of numbers, and the tracks of each world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.world_tracks import WIDER
from mcaptrack.notices import collected
from mcaptrack.schema import TRACKS, WORLDS


def kept_samples(path: Path) -> list[dict[tuple[int, float], int]]:
    """The track of each sample that a world keeps, by its time and place, from the rows of worlds and samples."""
    with log.Log(path) as opened:
        parts = [(frame.t_ns, row) for frame in opened.frames("/camera/retracks/worlds", WORLDS) for row in frame.rows]
        samples = [(f.t_ns, row) for f in opened.frames("/camera/samples", TRACKS) for row in f.rows if row["observed"]]
        smooth = {
            (frame.t_ns, row["source_id"]): row["x_m"]
            for frame in opened.frames("/camera/retracks", TRACKS)
            for row in frame.rows
        }
    out: list[dict[tuple[int, float], int]] = [{} for _ in range(9)]
    for begin_ns, part in parts:  # in order of time: of two with a sample the later one
        end_ns = begin_ns + part["duration_s"] * 1e9 + 1000
        for t_ns, row in samples:
            if row["track_id"] == part["source_id"] and begin_ns <= t_ns <= end_ns:
                at = t_ns, float(smooth.get((t_ns, row["track_id"]), row["x_m"]))
                out[part["world"] - 1][at] = int(part["track_id"])
    return [{at: track for at, track in world.items() if track >= 0} for world in out]


def test_worlds_have_the_samples_that_they_keep_and_join_whole_tracks_of_them(with_worlds):
    joined = 0
    for world, wanted in enumerate(kept_samples(with_worlds), start=1):
        query = f"select t_ns, x_m, track_id from world_tracks where world = {world} and observed"
        found = {(row["t_ns"], row["x_m"]): row["track_id"] for row in mcaptrack.query(with_worlds, query).to_pylist()}
        assert found.keys() == wanted.keys()
        names = {(wanted[at], track) for at, track in found.items()}
        assert len(names) == len({track for track, _ in names})
        joined += len(names) - len({track for _, track in names})
    assert joined > 0


def test_a_number_has_its_median_and_an_interval_around_those_of_the_worlds(with_worlds):
    query = "select count(distinct track_id) as n, avg(x_m) as x from tracks where observed and x_m > 0"
    (row,) = mcaptrack.query(with_worlds, query, worlds=True).to_pylist()
    (again,) = mcaptrack.query(with_worlds, query, worlds=True).to_pylist()
    grouped = query.replace("tracks", "world_tracks") + " group by world"
    many = mcaptrack.query(with_worlds, grouped).column("n").to_pylist()
    low, middle, high = np.percentile(many, [5, 50, 95])
    assert len(set(many)) > 1
    assert (row, row["n"], row["worlds"]) == (again, middle, 9)
    assert max(low - WIDER * middle, 0) - 1 < row["n_from"] <= low <= high <= row["n_to"] < high + WIDER * middle + 1
    assert row["x_from"] < row["x"] < row["x_to"]


def test_unseen_rows_of_a_track_that_was_seen_are_straight_and_no_track_is_at_two_places_at_once(with_worlds):
    rows = mcaptrack.query(with_worlds, "from world_tracks order by world, track_id, t_ns").to_pylist()
    seen = {(row["world"], row["track_id"]) for row in rows if row["observed"]}
    for one, row, other in zip(rows, rows[1:], rows[2:], strict=False):
        ends = (one, row, other)
        if len({(end["world"], end["track_id"]) for end in ends}) == 1:
            assert one["t_ns"] < row["t_ns"]
            if not row["observed"] and (row["world"], row["track_id"]) in seen:
                times, places = [end["t_ns"] for end in ends], [end["x_m"] for end in ends]
                assert row["x_m"] == pytest.approx(np.interp(times[1], times[::2], places[::2]))
    assert any(not row["observed"] for row in rows)


def test_numbers_of_pairs_have_no_interval(with_worlds):
    for pairs in (
        "tracks a join tracks b using (t_ns)",
        "tracks a, tracks b",
        "tracks as a left join tracks b using (t_ns)",
    ):
        with collected() as warnings:
            (row,) = mcaptrack.query(with_worlds, f"select count(*) as n from {pairs}", worlds=True).to_pylist()
        assert (row["n_from"], row["n_to"], row["n"] > 0) == (None, None, True)
        assert ["no interval" in warning.message for warning in warnings] == [True]


def test_rows_are_told_apart_by_texts_and_counts_of_missing_rows_are_none(with_worlds):
    query = "select track_id::text as track, count(*) as n from tracks group by all"
    rows = mcaptrack.query(with_worlds, query, worlds=True).to_pylist()
    per_world = mcaptrack.query(
        with_worlds, "select world, track_id, count(*) as n from world_tracks group by all"
    ).to_pylist()
    for row in rows:
        many = [found["n"] for found in per_world if str(found["track_id"]) == row["track"]]
        assert (row["worlds"], row["n"]) == (len(many), np.median(many + [0] * (9 - len(many))))
        assert 0 <= row["n_from"] <= row["n"] <= row["n_to"]


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("select count(*) from zone_visits", "not zone_visits"),
        ("select 1 as n", "nothing else"),
        ("select count(*) from tracks where topic = '/camera/samples'", "not /camera/samples"),
        ("create table a as from tracks; select count(*) from a", "one SELECT"),
        ("select track_id from tracks", "same texts"),
    ],
)
def test_what_worlds_do_not_change_is_refused(with_worlds, query, message):
    with pytest.raises(McaptrackError, match=message):
        mcaptrack.query(with_worlds, query, worlds=True)


def test_logs_without_worlds_are_refused(template):
    with pytest.raises(McaptrackError, match="has no worlds"):
        mcaptrack.query(template, "select count(*) as n from tracks", worlds=True)
