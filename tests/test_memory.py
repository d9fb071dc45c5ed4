"""What commands hold in memory doesn't grow with the rows or pictures of a log; frames in a thread; times by part."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib import import_module

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log, notices, tables
from mcaptrack.errors import McaptrackError
from mcaptrack.pipeline.pictures import Ahead, KeptPictures
from mcaptrack.pipeline.plan import spaces_of_boxes
from mcaptrack.pipeline.runner import Stopwatch
from mcaptrack.schema import TRACKS, Frame, frame_columns, framing
from mcaptrack.schema.frame_columns import FrameColumns, collect
from mcaptrack.sources.ingest.labels.timeline import boxes_extent
from mcaptrack.tables import build, rows
from mcaptrack.transforms import PROFILES, Retrack
from mcaptrack.transforms.retrack import identity_swaps, passes
from mcaptrack.transforms.retrack.passes import LikelihoodPass, Movers
from tests.awaiting import until
from tests.bounded import held

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
    monkeypatch.setattr(passes, "_SAMPLES", 128)
    monkeypatch.setattr(identity_swaps, "_CELLS", 64)


@pytest.mark.usefixtures("small_blocks")
def test_online_retracking_holds_numbers_of_each_sample_and_no_rows():
    """A row of tracks has 153 bytes, the predictions of a sample 840; what is held were rows once, ten times as much."""

    def online(frames: int) -> LikelihoodPass:
        return LikelihoodPass(Retrack(predictor="cv"), Movers(), collect(TRACKS, walks(frames)))

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
