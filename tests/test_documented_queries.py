"""Documented queries give the right answers on a log of other rates than the demonstration's.

Its video has 7 frames a second, so that samples, which are 0.4 s apart, seldom fall on a frame. Answers are computed
from the frames of its channels, with NumPy.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import chdir
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import duckdb
import numpy as np
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.schema import (
    DECISIONS,
    EVENTS,
    PREDICTIONS,
    TRACKS,
    ZONE_CROSSINGS,
    Frame,
    Schema,
)  # fmt: skip
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources import demo
from mcaptrack.sources.demo import demo_scene
from mcaptrack.tables.export import export
from tests.extension_cases import of_extensions
from tests.logs import write_channels
from tests.test_query import PRELUDE
from tests.tiers import thorough
from tests.worlds import ns, tracks_at
from tools import pages
from tools.pages import ROOT

pytestmark = thorough
NS = 1_000_000_000
SCENE = replace(demo_scene(), fps=7, width_px=480, height_px=270)
Rows = list[list[Any]]


class Track(NamedTuple):
    t_ns: np.ndarray
    xy_m: np.ndarray
    is_observed: np.ndarray


class Log(NamedTuple):
    """An open log, and a folder with it and its tables."""

    opened: log.Log
    folder: Path

    def frames(self, below: str, schema: Any = TRACKS) -> list[Frame]:
        return list(self.opened.frames(f"/camera/{below}", schema))

    def rows(self, below: str, schema: Any) -> list[tuple[int, Any]]:
        return [(frame.t_ns, row) for frame in self.frames(below, schema) for row in frame.rows]

    def tracks(self, below: str) -> dict[int, Track]:
        of: dict[int, list[tuple[int, float, float, bool]]] = {}
        for t_ns, row in self.rows(below, TRACKS):
            of.setdefault(int(row["track_id"]), []).append((t_ns, row["x_m"], row["y_m"], row["observed"]))
        return {
            who: Track(
                np.array([row[0] for row in rows]), np.array([row[1:3] for row in rows]),
                np.array([row[3] for row in rows], bool),
            )
            for who, rows in sorted(of.items())
        }  # fmt: skip


@pytest.fixture(scope="module")
def seven(tmp_path_factory) -> Iterator[Log]:
    folder = tmp_path_factory.mktemp("seven")
    footage = demo.draw(SCENE, folder)
    path = folder / "log.mcap"
    mcaptrack.ingest(footage.video, path, ground_plane=footage.ground_plane, truth=footage.ground_truth)
    mcaptrack.run(path, **of_extensions("DOCUMENTED_RUN"))
    for name in ("demo.tables", "tables"):
        (folder / name).symlink_to("log.tables")
    with log.read(path) as opened:
        yield Log(opened, folder)


# Answers, by a part of the query


def positions(seven: Log) -> Rows:
    (frame,) = (frame for frame in seven.frames("truth") if frame.t_ns == 10 * NS)
    return sorted([int(row["track_id"]), row["x_m"], row["y_m"]] for row in frame.rows)


def last_positions(seven: Log) -> Rows:
    out = []
    for who, track in seven.tracks("truth").items():
        near = np.flatnonzero((track.t_ns <= 11_110_000_000) & (track.t_ns >= 10_610_000_000))
        out += [[who, track.t_ns[near[-1]] / NS, *track.xy_m[near[-1]]]] if len(near) else []
    return out


def numbers_of_people(seven: Log) -> Rows:
    return sorted(map(list, Counter(len(frame.rows) for frame in seven.frames("truth")).items()))


def arrivals(seven: Log) -> Rows:
    first = [int(track.t_ns[0]) // (10 * NS) * 10 for track in seven.tracks("truth").values()]
    return sorted(map(list, Counter(first).items()))


def stays(seven: Log) -> Rows:
    out = []
    for who, (t_ns, xy_m, _) in seven.tracks("truth").items():
        gaps = np.diff(t_ns[(np.abs(xy_m - [0, 12.5]) <= [2, 1.5]).all(axis=1)]) / NS
        out += [[who, 1 + int((gaps > 1).sum()), np.minimum(gaps, 1).sum()]] if len(gaps) else []
    return out


def areas(seven: Log) -> Rows:
    who: dict[tuple[str, int], list[tuple[int, int]]] = {}
    for t_ns, row in seven.rows("truth", TRACKS):
        for zone, near, far in (("near", 7, 12), ("far", 12, 18)):
            if abs(row["x_m"]) <= 9 and near <= row["y_m"] <= far:
                who.setdefault((zone, t_ns // (10 * NS) * 10), []).append((int(row["track_id"]), t_ns))
    return [
        [*key, len({track for track, _ in seen}), len(seen) / len({t_ns for _, t_ns in seen})]
        for key, seen in sorted(who.items())
    ]


def speeds_of(track: Track) -> np.ndarray:
    later = np.searchsorted(track.t_ns, track.t_ns + NS)
    now = np.flatnonzero(later < len(track.t_ns))
    s = (track.t_ns[later[now]] - track.t_ns[now]) / NS
    m = np.linalg.norm(track.xy_m[later[now]] - track.xy_m[now], axis=1)
    return (m / s)[s < 1.5]


def speeds(seven: Log) -> Rows:
    out = {who: speeds_of(track) for who, track in seven.tracks("truth").items()}
    for walker in SCENE.people:  # and as they were drawn
        begin, end = walker.route[0][0], walker.route[-1][0]
        places = np.array([walker.at(t) for t in np.linspace(begin, end, 400) if walker.at(t)], float)
        path_m = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
        assert out[walker.id].mean() == pytest.approx(path_m / (end - begin), rel=0.15), walker.id
    return [[who, of.mean(), of.max()] for who, of in out.items() if len(of)]


def approaches(seven: Log) -> Rows:
    nearest: dict[tuple[int, int], tuple[float, float]] = {}
    for frame in seven.frames("truth"):
        for one, other in combinations(sorted(frame.rows.tolist()), 2):
            columns = [frame.rows.dtype.names.index(name) for name in ("x_m", "y_m")]
            away = np.hypot(*(one[column] - other[column] for column in columns))
            pair = (int(one[0]), int(other[0]))
            nearest[pair] = min(nearest.get(pair, (np.inf, 0.0)), (away, frame.t_ns / NS))
    return sorted([[*pair, *found] for pair, found in nearest.items()], key=lambda row: row[2])[:5]


def switches(seven: Log) -> Rows:
    return [
        [*(int(row[name]) for name in ("truth_id", "previous_id", "track_id")), t_ns / NS, row["x_m"], row["y_m"]]
        for t_ns, row in seven.rows("tracks/events", EVENTS)
        if row["kind"] == 4
    ]


def occlusions(seven: Log) -> Rows:
    out = []
    for who, track in seven.tracks("retracks/full").items():
        seen = track.t_ns[track.is_observed]
        out += [[who, a / NS, (b - a) / NS] for a, b in pairwise(seen.tolist()) if b - a > NS / 2]
    return sorted(out, key=lambda row: (-row[2], row[0]))[:3]


def misses(seven: Log) -> Rows:
    of: dict[int, list[float]] = {}
    for _, row in seven.rows("tracks/events", EVENTS):
        if row["kind"] == 2:
            of.setdefault(int(row["truth_id"]), []).append(row["duration_s"])
    return [[who, len(times), sum(times)] for who, times in sorted(of.items())]


def place_at(track: Track, t_ns: int) -> np.ndarray | None:
    """The place between two rows that are at most 2 s apart; a microsecond may be missing at the end."""
    if not track.t_ns[0] <= t_ns <= track.t_ns[-1] + 1000:
        return None
    at = int(np.searchsorted(track.t_ns, t_ns, "right"))
    if 0 < at < len(track.t_ns) and track.t_ns[at] - track.t_ns[at - 1] > 2 * NS:
        return None
    seconds = (track.t_ns - t_ns) / NS
    return np.array([np.interp(0.0, seconds, track.xy_m[:, axis]) for axis in range(2)])


def against_tracks(seven: Log) -> Rows:
    tracks, off_m = seven.tracks("samples"), {}
    for t_ns, row in seven.rows("predictions", PREDICTIONS):
        place = place_at(tracks[int(row["track_id"])], t_ns + round(row["ahead_s"] * NS))
        if place is not None:
            off_m.setdefault(round(row["ahead_s"], 1), []).append(np.hypot(*(place - [row["x_m"], row["y_m"]])))
    return [[ahead_s, len(of), np.mean(of)] for ahead_s, of in sorted(off_m.items())]


def settings(seven: Log) -> Rows:
    return [["file", '"truth.txt"'], ["format", '"mot"']]


def chain(seven: Log) -> Rows:
    stages = {"retracks": "retrack", "samples": "sample", "tracks": "track", "detections": "detect", "video": "ingest"}
    topics = [f"/camera/{name}" for name in stages]
    return [list(row) for row in zip(topics, stages.values(), [*topics[1:], None], strict=True)]


def scores(seven: Log) -> Rows:
    found = mcaptrack.evaluate(seven.folder / "log.mcap", similarity="metres", gate_m=1.0)
    return [
        ["log", row["tracks"], row["IDF1"], row["MOTA"], row["IDSW"]]
        for row in sorted(found.rows(), key=lambda row: row["tracks"])
    ]


#: The answer to each query of docs/sql.md with an answer below it, and how exact it is.
ANSWERS: dict[str, tuple[Callable[[Log], Rows], float]] = {
    "t_ns = 10_000_000_000": (positions, 0.051),
    "as seen_s": (last_positions, 0.051),
    "as frames\nfrom (select": (numbers_of_people, 0),
    "as begin": (arrivals, 0),
    "as visits": (stays, 0.051),
    "with zones(": (areas, 0.051),
    "as fastest_m_s": (speeds, 0.051),
    "as closest_m": (approaches, 0.0051),
    "kind = 4": (switches, 0.51),
    "as hidden_s": (occlusions, 0.051),
    "kind = 2": (misses, 0.051),
    "made.input": (against_tracks, 0.0051),
    "json_each": (settings, 0),
    "recursive": (chain, 0),
    "order by recording, topic": (scores, 0.0051),
}


def queries(page: str) -> list[str]:
    return [block.text for block in pages.blocks(ROOT / "docs" / page) if block.language == "sql"]


def the_query(page: str, part: str) -> str:
    (query,) = (query for query in queries(page) if part in query)
    return query


def asked(folder: Path, query: str) -> Rows:
    with chdir(folder), duckdb.connect() as connection:
        connection.execute(PRELUDE)
        for table in Path("log.tables").glob("*"):  # those that only some logs have, too
            connection.execute(f"create view if not exists {table.name} as from '{table}/*/*.parquet'")
        return [list(row) for row in connection.sql(query).fetchall()]


@pytest.mark.parametrize("part", ANSWERS)
def test_queries_give_what_frames_give(seven, part):
    answer, exact_to = ANSWERS[part]
    found, wanted = asked(seven.folder, the_query("sql.md", part)), answer(seven)
    assert len(wanted) > 0
    assert len(found) == len(wanted)
    for row, other in zip(found, wanted, strict=True):
        assert row == pytest.approx(other, abs=exact_to)


def test_every_query_of_the_page_is_asked():
    parts = [*ANSWERS, "create view", "metrics before join"]
    assert [sum(part in query for part in parts) for query in queries("sql.md")] == [1] * len(parts)


@pytest.fixture(scope="module")
def of_two_classes(tmp_path_factory) -> Path:
    """A folder with two logs of a person and a car, before and after an identity was repaired, and their tables."""
    folder = tmp_path_factory.mktemp("classes")
    named = {"1": "person", "2": "car"}

    def frames(ids: Callable[[int], int]) -> list[Frame]:
        rows = [tracks_at({ids(n): (0.4 * n, 0.0), 2: (0.0, 10.0 + 0.1 * n)}) for n in range(20)]
        for of_frame in rows:
            of_frame["class_id"] = [1, 2]
        return [Frame(ns(0.4 * n), n, of_frame) for n, of_frame in enumerate(rows)]

    for name, ids in (("before", lambda n: 1 + 6 * (n >= 10)), ("after", lambda _: 1)):
        warning = [("other", "an example")] if name == "before" else []
        channels = {
            "/camera/truth": (TRACKS, Provenance("ingest", {}, classes=named), frames(lambda _: 1)),
            "/camera/tracks": (TRACKS, Provenance("track", {}, classes=named, warnings=warning), frames(ids)),
        }
        with log.read(write_channels(folder / f"{name}.mcap", channels)) as opened:
            export(opened, folder / "demo.tables")
    (folder / "tables").symlink_to("demo.tables")
    return folder


def test_runs_are_compared_once_and_not_by_class(of_two_classes):
    rows = asked(of_two_classes, the_query("sql.md", "order by recording, topic"))
    assert [row[:2] for row in rows] == [["after", "/camera/tracks"], ["before", "/camera/tracks"]]
    (row,) = asked(of_two_classes, the_query("sql.md", "metrics before join"))
    assert row == [
        "/camera/tracks",
        pytest.approx(1 - rows[1][2], abs=0.011),
        pytest.approx(1 - rows[1][3], abs=0.011),
        -1,
    ]


# docs/tables.md: which keys join


def statement(part: str) -> str:
    """The statement with this text in docs/tables.md, of those that stand in one block."""
    (found,) = (one for query in queries("tables.md") for one in query.split(";") if part in one)
    return found


def test_people_are_counted_in_frames_without_tracks_too(seven):
    found = asked(seven.folder, re.sub(r"f\.t\b", "f.t_ns", statement("as people")))
    assert found == [[frame.t_ns, len(frame.rows)] for frame in seven.frames("tracks")]


def test_summaries_join_the_scores_of_all_classes_together(of_two_classes):
    rows = asked(of_two_classes, statement("mean_speed_m_s"))
    assert sorted(row[:3] for row in rows) == [
        *(["after", "/camera/tracks", track_id] for track_id in (1, 2)),
        *(["before", "/camera/tracks", track_id] for track_id in (1, 2, 7)),
    ]


def test_crossings_join_the_tracks_that_cross(seven):
    found = asked(seven.folder, statement("zone_crossings").replace("z.t,", "z.t_ns,"))
    wanted = []
    for topic in seven.opened.channels:
        if topic.endswith("/zones/crossings"):
            tracks = seven.tracks(topic.removeprefix("/camera/").removesuffix("/zones/crossings"))
            for t_ns, row in seven.rows(topic.removeprefix("/camera/"), ZONE_CROSSINGS):
                xy_m = tracks[int(row["track_id"])].xy_m
                path_m = np.linalg.norm(np.diff(xy_m, axis=0), axis=1).sum()
                wanted.append(["gate", t_ns, int(row["track_id"]), path_m])
    assert len(wanted) > 10 or not of_extensions("DOCUMENTED_RUN")  # without zones both are empty
    for row, other in zip(sorted(found), sorted(wanted), strict=True):
        assert row == pytest.approx(other)


def test_warnings_join_what_made_the_channel(of_two_classes):
    assert asked(of_two_classes, statement("warnings/")) == [["other", "an example", "/camera/tracks", "track"]]


def test_every_statement_of_tables_is_asked():
    parts = ["as people", "mean_speed_m_s", "zone_crossings", "warnings/"]
    statements = [one for query in queries("tables.md") for one in query.split(";") if one.strip()]
    assert [sum(part in one for part in parts) for one in statements] == [1] * len(parts)


# Other pages


def every_channel(seven: Log, schema: Schema) -> Iterator[tuple[str, list[tuple[int, Any]]]]:
    """The topic below the camera of each channel of a schema, and its rows with their times."""
    for topic, channel in sorted(seven.opened.channels.items()):
        if channel.schema_name == schema.name:
            below = topic.removeprefix("/camera/")
            yield below, seven.rows(below, schema)


def ids_by_topic(seven: Log) -> Rows:
    found = every_channel(seven, TRACKS)
    return [[f"/camera/{below}", len({int(row["track_id"]) for _, row in rows})] for below, rows in found]


def long_tracks(seven: Log) -> Rows:
    out = []
    for below, _ in every_channel(seven, TRACKS):
        for who, track in seven.tracks(below).items():
            if track.t_ns[-1] - track.t_ns[0] > 2 * NS:
                steps_m = np.linalg.norm(np.diff(track.xy_m, axis=0), axis=1)
                out.append([f"/camera/{below}", who, (track.t_ns[-1] - track.t_ns[0]) / NS, steps_m.sum()])
    return out


def every_switch(seven: Log) -> Rows:
    columns = ("truth_id", "previous_id", "track_id")
    return [
        [f"/camera/{below}", *(int(row[name]) for name in columns), t_ns]
        for below, rows in every_channel(seven, EVENTS)
        for t_ns, row in rows
        if row["kind"] == 4
    ]


def joins(seven: Log) -> Rows:
    columns = ("track_id", "previous_id", "source_id", "probability", "alternative_id")
    return [
        [t_ns, *(row[name].item() for name in columns)]
        for t_ns, row in seven.rows("retracks/decisions", DECISIONS)
        if row["kind"] == 1
    ]


#: The answers to queries of other pages, by page and a part of the query.
OTHERS: dict[tuple[str, str], Callable[[Log], Rows]] = {
    ("README.md", "from tracks group"): ids_by_topic,
    ("README.md", "log.tables/tracks"): ids_by_topic,
    ("docs/troubleshooting.md", "track_summary"): long_tracks,
    ("docs/results.md", "events"): every_switch,
    ("docs/results.md", "decisions"): joins,
    ("docs/tutorial.md", "count(distinct track_id)"): ids_by_topic,
    ("docs/tutorial.md", "from events"): lambda seven: [
        [row[4], *row[1:4]] for row in every_switch(seven) if row[0] == "/camera/tracks/events"
    ],
} | of_extensions("QUERIES")


@pytest.mark.parametrize(("page", "part"), OTHERS)
def test_queries_of_other_pages_give_what_frames_give(seven, page, part):
    asks = set()
    for block in pages.blocks(ROOT / page):
        if block.language == "sql":
            asks |= {*block.text.split(";")}
        elif block.language == "sh":
            asks |= {*re.findall(r'^mcaptrack query \S+ "(.*)"$', block.text, re.M)}
    (query,) = (query.replace("probability < 0.8", "probability <= 1") for query in asks if part in query)
    wanted = OTHERS[page, part](seven)
    assert len(wanted) > 0
    for row, other in zip(sorted(asked(seven.folder, query)), sorted(wanted), strict=True):
        assert row == pytest.approx(other)


# Python


@pytest.fixture(scope="module")
def returning(tmp_path_factory) -> Iterator[Log]:
    """A log of somebody who leaves the rectangle for 3 s and comes back, and of somebody who stays out, at 7 Hz."""
    folder = tmp_path_factory.mktemp("returning")
    places = [(0.0 if n < 7 or n > 28 else 5.0, 12.0) for n in range(40)]
    frames = [Frame(n * NS // 7, n, tracks_at({1: place, 2: (9.0, 12.0)})) for n, place in enumerate(places)]
    with log.read(
        write_channels(folder / "a.mcap", {"/camera/truth": (TRACKS, Provenance("ingest", {}), frames)})
    ) as opened:
        export(opened, folder / "demo.tables")
        yield Log(opened, folder)


@pytest.mark.parametrize("name", ["seven", "returning"])
def test_stays_and_arrivals_are_the_same_in_all_libraries(name, request):
    of = request.getfixturevalue(name)
    wanted = stays(of), arrivals(of)
    assert max(visits for _, visits, _ in wanted[0]) == 1 + (name == "returning")
    for part, rows in zip(("as visits", "as begin"), wanted, strict=True):
        for row, other in zip(asked(of.folder, the_query("sql.md", part)), rows, strict=True):
            assert row == pytest.approx(other, abs=0.051)
    for block in pages.blocks(ROOT / "docs" / "sql.md"):
        if block.language == "python":
            names: dict[str, Any] = {}
            with chdir(of.folder):
                exec(block.text, names)
            for found, rows in zip((names["seconds"], names["begin"]), wanted, strict=True):
                pairs = found.rows() if hasattr(found, "rows") else list(found.items())
                assert pairs == [(row[0], pytest.approx(row[-1])) for row in rows]


def test_snippets_of_python_measure_people(seven):
    (table, array) = (
        block.text
        for block in pages.blocks(ROOT / "docs" / "python.md")
        if block.language == "python" and ("busiest" in block.text or "speed_m_s" in block.text)
    )
    tracks = seven.tracks("tracks")
    names: dict[str, Any] = {}
    with mcaptrack.open(seven.folder / "log.mcap") as opened:
        names["log"] = opened
        exec(table, names)
        exec(array, names)
    steps = [
        np.linalg.norm(np.diff(track.xy_m, axis=0), axis=1) / (np.diff(track.t_ns) / NS) for track in tracks.values()
    ]
    np.testing.assert_allclose(names["speed_m_s"], np.concatenate(steps))
    assert names["busiest"].to_pylist()[0]["people"] == max(len(frame.rows) for frame in seven.frames("tracks"))
    path_m = {who: np.linalg.norm(np.diff(track.xy_m, axis=0), axis=1).sum() for who, track in tracks.items()}
    assert sorted(names["walkers"]["track_id"]) == [who for who, length_m in path_m.items() if length_m > 1]
    people = mcaptrack.query(seven.folder / "log.mcap", "select tracks from recordings")
    assert people["tracks"].to_pylist() == [len(seven.tracks("retracks"))]
