"""What commands hold in memory doesn't grow with the rows or pictures of a log; frames in a thread; times by part."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from importlib import import_module

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import log, notices, tables
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.aligned import compare_rows
from mcaptrack.evaluation.events import MatchRule
from mcaptrack.evaluation.metrics import clear, hota, identity
from mcaptrack.evaluation.metrics import matchup as matchups
from mcaptrack.evaluation.people import person_scores
from mcaptrack.geometry import assignment, boxes, neighbours
from mcaptrack.geometry.neighbours import near_pairs, touching_pairs
from mcaptrack.geometry.plane_from_boxes import whole_people
from mcaptrack.log import chunks
from mcaptrack.pipeline.pictures import Ahead, KeptPictures
from mcaptrack.pipeline.plan import spaces_of_boxes
from mcaptrack.pipeline.runner import Stopwatch
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, frame_columns, framing
from mcaptrack.schema.frame_columns import FrameColumns, collect
from mcaptrack.sources.ingest.labels.timeline import boxes_extent
from mcaptrack.tables import build, rows
from mcaptrack.transforms import PROFILES, Retrack
from mcaptrack.transforms.ground import GroundTracker
from mcaptrack.transforms.retrack import identity_swaps, likelihood
from mcaptrack.transforms.retrack.likelihood import LikelihoodPass
from mcaptrack.transforms.sort import ByteTrack, OcSort, Sort
from tests.awaiting import until
from tests.memory import held

runner = import_module("mcaptrack.pipeline.runner")  # the package has a function of its name

PEOPLE = 12


def walks(frames: int, people: int = PEOPLE) -> Iterator[Frame]:
    """People who walk side by side, each at another speed, at 2.5 Hz; half of them change their ids every minute."""
    for number in range(frames):
        ids = np.arange(people) + people * (number // 150) * (np.arange(people) % 2)
        x_m = 0.1 * (1 + np.arange(people) % PEOPLE) * number
        rows = TRACKS.rows(
            track_id=ids,
            x_m=x_m,
            y_m=1.5 * np.arange(people),
            observed=[True] * people,
            source_id=[-1] * people,
            class_id=[1] * people,
        )
        yield Frame(400_000_000 * number, number, rows)


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(frame_columns, "BLOCK_BYTES", 2**13)
    monkeypatch.setattr(framing, "PART_ROWS", 256)
    monkeypatch.setattr(rows, "GROUP_ROWS", 256)
    monkeypatch.setattr(rows, "_BUFFER_BYTES", 2**10)
    monkeypatch.setattr(build, "PIECE_ROWS", 256)
    monkeypatch.setattr(likelihood, "_BATCH", 128)
    monkeypatch.setattr(likelihood, "_STEPS", 16)
    monkeypatch.setattr(likelihood, "_SAMPLES", 256)
    monkeypatch.setattr(identity_swaps, "_CELLS", 64)


@pytest.mark.usefixtures("small_blocks")
def test_online_retracking_holds_numbers_of_each_sample_and_no_rows():
    """A row of tracks has 153 bytes, the predictions of a sample 840; what is held were rows once, ten times as much."""

    def online(frames: int) -> LikelihoodPass:
        run = LikelihoodPass(Retrack(predictor="cv"))
        for frame in walks(frames):
            run.step(frame)
        return run

    online(10)  # what is imported, and made once
    short, long = (held(lambda frames=frames: online(frames))[0] for frames in (48, 144))
    assert (long - short) / (96 * PEOPLE) < 200


@pytest.mark.parametrize("name", ["default", "authors"])
@pytest.mark.usefixtures("small_blocks")
def test_retracking_is_the_same_whatever_the_size_of_blocks(name, monkeypatch):
    small = [[frame.rows.tolist() for frame in result] for result in PROFILES[name](walks(40))]
    monkeypatch.setattr(frame_columns, "BLOCK_BYTES", 2**20)
    monkeypatch.setattr(identity_swaps, "_CELLS", 2**18)
    large = [[frame.rows.tolist() for frame in result] for result in PROFILES[name](walks(40))]
    assert repr(small) == repr(large)


@pytest.mark.usefixtures("small_blocks")
def test_a_table_is_made_in_pieces():
    """All rows and their columns would take four times as much."""
    short, long = (collect(TRACKS, walks(frames)) for frames in (100, 400))

    def read(frames: FrameColumns) -> int:
        made = tables.rows_in_pieces(TRACKS, {"/a": frames})
        assert [piece.num_rows for piece in made][:-1] == [256] * (made.num_rows // 256)
        return made.num_rows

    read(short)
    few, many = (held(lambda frames=frames: read(frames))[1] for frames in (short, long))
    assert many - few < 0.6 * (300 * PEOPLE) * TRACKS.dtype.itemsize


@pytest.mark.usefixtures("small_blocks")
def test_rows_that_were_divided_are_ordered_by_track_and_time():
    rng = np.random.default_rng(1)
    frames = [
        Frame(7 * n, n + 3, TRACKS.rows(track_id=rng.integers(-40, 9000, k) ** 3, x_m=rng.random(k), y_m=rng.random(k),
                                        observed=[True] * k, source_id=[-1] * k))
        for n, k in enumerate(rng.integers(0, 40, 200))
    ]  # fmt: skip
    columns = collect(TRACKS, frames)
    parts = list(rows.ordered_rows(TRACKS, columns, by_track=True))
    assert len(parts) > 3
    all_rows = columns.rows()
    order = np.argsort(all_rows["track_id"], kind="stable")
    assert np.concatenate([part.place for part in parts]).tolist() == order.tolist()
    assert np.concatenate([part.rows["x_m"] for part in parts]).tolist() == all_rows["x_m"][order].tolist()
    of_row = np.repeat(np.arange(len(frames)), [len(frame.rows) for frame in frames])
    assert np.concatenate([part.frame for part in parts]).tolist() == of_row[order].tolist()


@pytest.mark.usefixtures("small_blocks")
def test_the_spaces_and_the_extent_of_boxes_are_found_without_all_rows(tmp_path, monkeypatch):
    places = ((frame, 10 * one + frame) for frame in range(1, 61) for one in range(10))
    (tmp_path / "a.txt").write_text("".join(f"{frame},-1,{x},1,20,100,1\n" for frame, x in places))
    mcaptrack.ingest(tmp_path / "a.txt", tmp_path / "a.mcap", role="detections", fps=10)
    opened = log.Log(tmp_path / "a.mcap")
    monkeypatch.delattr(log.Log, "rows")
    assert spaces_of_boxes(opened, "/camera/detections") == {"picture"}
    assert boxes_extent(opened, "/camera/detections") == (60 + 90 + 20, 101)


def test_pictures_that_are_kept_are_not_in_memory():
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (100, 100)).astype(np.uint8)

    def kept() -> KeptPictures:
        pictures = KeptPictures(lambda: (Frame(n, n, np.roll(picture, 50 * n)) for n in range(50)))
        assert len(list(map(np.shape, (frame.rows for frame in pictures)))) == 50
        return pictures

    assert held(kept)[0] < 5 * picture.nbytes


# Frames that are made in a thread


def test_frames_are_made_ahead_and_read_as_often_as_wanted():
    made = []

    class Source:
        def __iter__(self) -> Iterator[Frame]:
            for number in range(20):
                made.append(number)
                yield Frame(number, number, np.zeros(0))

    frames = Ahead(Source())
    reading = iter(frames)
    next(reading)
    until(lambda: len(made) > 2)
    assert len(made) < 8
    assert [frame.index for frame in reading] == list(range(1, 20))
    assert [frame.index for frame in frames] == list(range(20))


def test_errors_and_warnings_of_the_thread_are_those_of_the_reader():
    def broken() -> Iterator[Frame]:
        notices.warn("odd")
        yield Frame(0, 0, np.zeros(0))
        raise McaptrackError("frame 1 can't be decoded")

    with notices.collected() as warnings, pytest.raises(McaptrackError, match="frame 1"):
        list(Ahead(broken()))
    assert [notice.message for notice in warnings] == ["odd"]


def test_the_thread_ends_when_no_more_frames_are_wanted():
    def endless() -> Iterator[Frame]:
        while True:
            yield Frame(0, 0, np.zeros(0))

    before = threading.active_count()
    reading = iter(Ahead(endless()))
    next(reading)
    assert threading.active_count() == before + 1
    reading.close()
    assert threading.active_count() == before


def test_time_counts_for_the_innermost_part(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(runner, "perf_counter", lambda: now[0])

    def passes(seconds: float) -> None:
        now[0] += seconds

    watch = Stopwatch()
    with watch.part("detect"):
        for _ in watch.each("decode", (passes(2.0) for _ in range(3))):
            passes(1.0)
    assert watch.seconds == {"decode": 6.0, "detect": 3.0}


# Allocators


def test_arrow_is_loaded_after_its_allocator_was_chosen():
    """Only then does it read the variable; the command line and workers choose it when these modules are loaded."""
    code = "import sys, mcaptrack.cli, mcaptrack.fleet.worker; sys.exit('pyarrow' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# Work grows with what can be a pair, not with the square of the boxes of a frame or with the channels of a log


RECTANGLES = st.lists(st.tuples(*[st.integers(0, 12)] * 2, *[st.integers(0, 9)] * 2, st.integers(0, 2)), max_size=14)


@given(RECTANGLES, RECTANGLES)
def test_touching_pairs_are_all_pairs_of_a_group_that_touch(one, other):
    a, b = (np.array(part, float).reshape(-1, 5) for part in (one, other))
    sides = [np.concatenate([part[:, :2], part[:, :2] + part[:, 2:4]], axis=1) for part in (a, b)]
    first, second = touching_pairs(*sides, a[:, 4].astype(int), b[:, 4].astype(int))
    low, high = sides[0][:, None, :2], sides[0][:, None, 2:]
    meet = ((low <= sides[1][None, :, 2:]) & (high >= sides[1][None, :, :2])).all(axis=2)
    wanted = np.nonzero(meet & (a[:, None, 4] == b[None, :, 4]))
    assert [first.tolist(), second.tolist()] == [side.tolist() for side in wanted]


def test_near_pairs_of_large_groups_are_those_of_all_pairs():
    rng = np.random.default_rng(0)
    xy, group = rng.uniform(0, 60, (900, 2)), rng.integers(0, 2, 900)
    found = set(zip(*(side.tolist() for side in near_pairs(group, xy, 2.0)), strict=True))
    near = (np.hypot(*(xy[:, None] - xy).transpose(2, 0, 1)) < 2.0) & (group[:, None] == group)
    assert found == set(zip(*(side.tolist() for side in np.nonzero(np.triu(near, 1))), strict=True))


def crowd(count: int, frames: int = 6, seed: int = 0) -> tuple[list[Frame], list[Frame]]:
    """Detections and tracks of people, as dense whatever their number, who walk and are missed now and then."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(count)))
    place = 2.0 * np.stack(np.divmod(np.arange(count), side), axis=1) + rng.uniform(-0.4, 0.4, (count, 2))
    speed = rng.normal(0, 0.6, (count, 2))
    detected, tracked = [], []
    for number in range(frames):
        seen = np.flatnonzero(rng.random(count) < 0.9)
        xy = (place + 0.1 * number * speed)[seen] + rng.normal(0, 0.05, (len(seen), 2))
        ones = np.ones(len(seen))
        where = {
            "x_m": xy[:, 0], "y_m": xy[:, 1], "x_px": 20 * xy[:, 0], "y_px": 20 * xy[:, 1],
            "w_px": 20 * ones, "h_px": 44 * ones, "class_id": ones.astype(int), "source_id": -ones.astype(int),
        }  # fmt: skip
        detected.append(
            Frame(number * 100_000_000, number, DETECTIONS.rows(score=0.4 + 0.6 * rng.random(len(seen)), **where))
        )
        tracks = TRACKS.rows(track_id=seen, observed=ones.astype(bool), **where)
        tracked.append(Frame(number * 100_000_000, number, tracks))
    return detected, tracked


@pytest.fixture
def no_tables(monkeypatch):
    """No table of pairs is made, however small."""
    for module in (assignment, matchups):
        monkeypatch.setattr(module, "LARGE_TABLE", 0)
    monkeypatch.setattr("mcaptrack.transforms.retrack.online_tracker.LARGE_TABLE", 0)
    monkeypatch.setattr(neighbours, "_LARGE_TABLE", 0)
    monkeypatch.setattr(neighbours, "_MANY", 0)
    monkeypatch.setattr(boxes, "_MANY", 0)
    monkeypatch.setattr(boxes, "_VERY_MANY", 0)
    monkeypatch.setattr("mcaptrack.evaluation.aligned._PAIRS_AT_ONCE", 1)


TRACKERS = [Sort(), ByteTrack(), OcSort(), Sort(cost="pixels"), GroundTracker(class_names=((1, "person"),))]


def transformed(transform, frames) -> list[str]:
    return [repr(frame.rows.tolist()) for result in transform(frames) for frame in result]


SMALL = {
    **{f"{type(one).__name__} {one.cost}": (lambda one=one: transformed(one, crowd(60, 20)[0])) for one in TRACKERS},
    "Retrack": lambda: transformed(Retrack(predictor="cv"), crowd(40, 60)[1]),
    "scores": lambda: [scores(crowd(60, seed=1)[1], crowd(60, seed=2)[1], how) for how in ("iou", "metres")],
}


def scores(truth: list[Frame], tracks: list[Frame], similarity: str):
    compared = compare_rows(truth, tracks, similarity, 1.0 if similarity == "metres" else 0.3).matchup
    people = person_scores(truth, tracks, MatchRule(similarity, 1.0 if similarity == "metres" else 0.3))
    located = {name: np.round(values, 9).tolist() for name, values in hota(compared).items()}
    counts = [{k: round(v, 9) for k, v in clear(compared, rules).items()} for rules in ("trackeval", "motmetrics")]
    return located, counts, identity(compared), people.hits.sum(), people.matched.tolist(), people.switches.tolist()


@pytest.mark.parametrize("name", SMALL)
def test_results_are_the_same_with_and_without_tables_of_all_pairs(name, request):
    wanted = SMALL[name]()
    request.getfixturevalue("no_tables")
    assert SMALL[name]() == wanted


def all_scores(count: int) -> Callable[[], object]:
    truth, tracks = crowd(count, 2, seed=1)[1], crowd(count, 2, seed=2)[1]
    return lambda: scores(truth, tracks, "iou")


def whole(count: int) -> Callable[[], object]:
    boxes_px = np.random.default_rng(0).uniform([0, 0, 15, 40], [4000, 3000, 25, 60], (count, 4))
    return lambda: whole_people(boxes_px, np.zeros(count, np.int64), np.ones(count), 4000, 3000)


LARGE = {
    "whole people": whole,
    **{
        f"{type(one).__name__} {one.cost}": (lambda count, one=one: lambda: transformed(one, crowd(count, 3)[0]))
        for one in TRACKERS
    },
    "scores": all_scores,
}


@pytest.mark.parametrize("name", LARGE)
def test_twice_the_boxes_of_a_frame_take_twice_the_memory(name):
    """A table of 3000 x 3000 alone takes 72 MB, four times as much for twice the boxes."""
    LARGE[name](100)()  # what is imported, and made once
    short, long = (held(LARGE[name](count))[1] for count in (1500, 3000))
    assert long < 2.8 * short
    assert long < 60e6


def test_however_many_channels_are_dropped_each_chunk_is_opened_few_times(tmp_path, monkeypatch):
    with log.create(tmp_path / "a.mcap") as writer:
        ids = [writer.add_channel(f"/x/{n}", (f"S{n}", "jsonschema", b"{}"), "json", {}) for n in range(400)]
        for one in ids:
            writer.add_message(one, one, 0, b"{}")
    opened = []
    monkeypatch.setattr(
        sys.modules["mcaptrack.log.extend"], "open_chunk", lambda *a: opened.append(a) or chunks.open_chunk(*a)
    )
    found = mcaptrack.drop(tmp_path / "a.mcap", [f"/x/{n}" for n in range(0, 400, 4)], output=tmp_path / "b.mcap")
    assert len(found.dropped) == 100
    assert len(opened) <= 2 * len(log.Log(tmp_path / "a.mcap").index.chunks)
    assert mcaptrack.check(tmp_path / "b.mcap").is_sound
