"""Frames as columns: the same frames in blocks, and the same logs whatever the size of blocks and parts."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove.views import people
from mcaptrack.geometry.ragged import cross_pairs
from mcaptrack.schema import DETECTIONS, TRACKS, Frame, frame_columns, framing
from mcaptrack.schema.frame_columns import FrameCollector, collect
from mcaptrack.schema.framing import (
    filtered_rows,
    frame_times,
    join_frames,
    joined_parts,
    mapped_rows,
    split_rows,
    thinned,
    unique_values,
)
from mcaptrack.schema.provenance import INGEST, Provenance, digest
from tests.tiers import thorough
from tests.worlds import ns


def frames_of(counts: list[int]) -> list[Frame]:
    """Frames with so many rows, numbered through all of them."""
    out, number = [], 0
    for at, count in enumerate(counts):
        rows = TRACKS.empty(count)
        rows["track_id"] = np.arange(number, number + count)
        out.append(Frame(ns(at), at + 5, rows))
        number += count
    return out


def plain(frames) -> list[tuple[int, int, bytes]]:
    return [(frame.t_ns, frame.index, TRACKS.codec.encode(frame.rows)) for frame in frames]


@pytest.fixture
def small(monkeypatch):
    """Blocks of a few rows, parts of a few rows."""
    monkeypatch.setattr(frame_columns, "BLOCK_BYTES", 8 * TRACKS.dtype.itemsize)
    monkeypatch.setattr(framing, "PART_ROWS", 20)
    monkeypatch.setattr(people, "_PART_ROWS", 20)
    monkeypatch.setattr(people, "_PART_STEPS", 50)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 12), max_size=40), st.data())
def test_they_are_the_frames_that_were_collected(counts, data):
    given_frames, before = frames_of(counts), frame_columns.BLOCK_BYTES
    frame_columns.BLOCK_BYTES = 8 * TRACKS.dtype.itemsize
    try:
        one_by_one = collect(TRACKS, given_frames)
        at_once = FrameCollector(TRACKS)
        joined = join_frames(TRACKS, given_frames)
        at_once.extend(joined.t_ns, [frame.index for frame in given_frames], joined.ends, joined.rows)
    finally:
        frame_columns.BLOCK_BYTES = before
    low = data.draw(st.integers(0, len(counts)))
    high = data.draw(st.integers(low, len(counts)))
    for kept in (one_by_one, at_once.done()):
        assert plain(kept) == plain(given_frames)
        assert len(kept) == len(given_frames)
        assert plain(kept[low:high]) == plain(given_frames[low:high])
        assert plain(kept[::3]) == plain(given_frames[::3])
        assert kept.rows(low, high)["track_id"].tolist() == list(range(joined.ends[low], joined.ends[high]))
        assert all(plain([kept[at]]) == plain([given_frames[at]]) for at in range(-len(counts), len(counts)))
    with pytest.raises(IndexError):
        one_by_one[len(counts)]


def test_parts_are_changed_and_chosen_as_the_whole(small):
    given_frames = frames_of([3, 0, 30, 5, 0, 0, 9, 14, 1])
    for frames in (given_frames, collect(TRACKS, given_frames)):
        parts = list(joined_parts(TRACKS, frames))
        assert [part[:2] for part in parts] == [(0, 2), (2, 3), (3, 7), (7, 9)]
        assert np.concatenate([part.rows["track_id"] for _, _, part in parts]).tolist() == list(range(62))
        even = filtered_rows(TRACKS, frames, lambda joined: joined.rows["track_id"] % 2 == 0)
        assert [frame.rows["track_id"].tolist() for frame in even] == [
            [one for one in frame.rows["track_id"].tolist() if one % 2 == 0] for frame in given_frames
        ]
        assert unique_values(TRACKS, mapped_rows(TRACKS, frames, lambda joined: joined.rows), "track_id")[-1] == 61
        assert plain(thinned(frames, 31)) == plain(given_frames[::2])
        assert plain(thinned(frames, 62)) == plain(given_frames)


def test_no_room_for_the_temporary_file_is_said(small, monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    with pytest.raises(McaptrackError, match="TMPDIR names another folder"):
        collect(TRACKS, frames_of([8] * 20))


def write_boxes(path: Path, seconds: float, count: int = 6) -> Path:
    """Write a log with detections and ground truth of people of two classes who walk to and fro, at 10 Hz."""
    rng = np.random.default_rng(3)
    start, pace = rng.uniform([0, 300], [600, 400], (count, 2)), rng.uniform(-40, 40, (count, 2))
    boxes, truth = [], []
    for number in range(round(10 * seconds)):
        x, y = (start + 60 * np.sin(pace * number / 600)).T
        seen = rng.random(count) < 0.9
        row = {"x_px": x, "y_px": y, "w_px": np.full(count, 40.0), "h_px": 100 + y / 10}
        class_id = 1 + np.arange(count) % 2
        some = {name: np.round(values[seen]) for name, values in row.items()}
        boxes.append(
            Frame(ns(number / 10), number, DETECTIONS.rows(**some, score=np.ones(seen.sum()), class_id=class_id[seen]))
        )
        ids, of = np.arange(count), {"observed": np.ones(count, bool), "source_id": np.full(count, -1)}
        truth.append(Frame(ns(number / 10), number, TRACKS.rows(**row, **of, track_id=ids, class_id=class_id)))
    with log.create(path) as new:
        for name, schema, frames in (("detections", DETECTIONS, boxes), ("truth", TRACKS, truth)):
            messages = [(frame.t_ns, frame.index, schema.codec.encode(frame.rows)) for frame in frames]
            made = Provenance(INGEST, {}, digest=digest(messages), classes={"1": "person", "2": "dog"})
            record = (schema.name, "protobuf", schema.descriptor)
            number = new.add_channel(f"/camera/{name}", record, "protobuf", made.to_metadata())
            for message in messages:
                new.add_message(number, *message)
    return path


@thorough
def test_a_log_is_the_same_whatever_the_size_of_blocks_and_parts(tmp_path, request):
    (tmp_path / "whole").mkdir()
    whole = write_boxes(tmp_path / "whole" / "a.mcap", 20.0)
    parts = shutil.copytree(tmp_path / "whole", tmp_path / "parts") / "a.mcap"
    mcaptrack.run(whole, across_classes=True)
    request.getfixturevalue("small")
    mcaptrack.run(parts, across_classes=True)
    assert parts.read_bytes() == whole.read_bytes()
    tables = {
        path.relative_to(tmp_path / "whole"): path
        for path in whole.parent.rglob("*.parquet")
        if "recordings" not in path.parts
    }
    assert tables
    assert all((tmp_path / "parts" / name).read_bytes() == path.read_bytes() for name, path in tables.items())


@pytest.mark.parametrize("way", ["append", "extend"])
def test_rows_with_their_columns_in_another_order_are_taken_and_others_refused(way):
    def collected(rows) -> np.ndarray:
        collector = FrameCollector(TRACKS)
        if way == "append":
            collector.append(Frame(ns(1), 0, rows))
        else:
            collector.extend([ns(1)], [0], [0, len(rows)], rows)
        (frame,) = collector.done()
        return frame.rows

    rows = TRACKS.empty(2)
    rows["track_id"], rows["x_px"] = [3, 4], [5.0, 6.0]
    turned = np.empty(2, [(name, rows.dtype[name]) for name in reversed(rows.dtype.names)])
    for name in rows.dtype.names:
        turned[name] = rows[name]
    for made in (rows, turned):
        assert collected(made).dtype == TRACKS.dtype
        assert collected(made)["track_id"].tolist() == [3, 4]
        assert collected(made)["x_px"].tolist() == [5.0, 6.0]
    with pytest.raises(ValueError, match="columns"):
        collected(np.zeros(2, [("a", float)]))


# Frames as flat rows and back, and all pairs within groups.


COUNTS = st.lists(st.integers(0, 4), max_size=8)


@given(COUNTS)
def test_joined_frames_are_split_into_the_same_frames(counts):
    frames = frames_of(counts)
    joined = join_frames(TRACKS, frames)
    assert joined.t_ns.tolist() == frame_times(frames).tolist() == [frame.t_ns for frame in frames]
    assert joined.row_ns.tolist() == [frame.t_ns for frame in frames for _ in frame.rows]
    assert joined.rows["track_id"].tolist() == list(range(sum(counts)))
    again = split_rows(joined.t_ns, [frame.index for frame in frames], joined.rows, joined.ends[1:])
    assert [(f.t_ns, f.index, f.rows.tobytes()) for f in again] == [(f.t_ns, f.index, f.rows.tobytes()) for f in frames]
    assert all(type(frame.t_ns) is int and type(frame.index) is int for frame in again)


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), max_size=8))
def test_cross_pairs_are_those_of_nested_loops(counts):
    wanted, first, second = [], 0, 0
    for group, (a, b) in enumerate(counts):
        wanted += [(group, i, j) for i in range(first, first + a) for j in range(second, second + b)]
        first, second = first + a, second + b
    found = cross_pairs(*np.array(counts, np.int64).reshape(-1, 2).T)
    assert list(zip(*(part.tolist() for part in found), strict=True)) == wanted
