"""Label files that are read in parts: the same log as of the whole file, whatever lies at the ends of parts."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mcaptrack
from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest.labels import reading
from mcaptrack.sources.ingest.labels.reading import read_labels
from mcaptrack.sources.ingest.labels.roles import WantedClasses

read_labels_of_any_length = partial(read_labels, in_parts=True)


@pytest.fixture
def in_parts(monkeypatch):
    """Read every file in parts of so many rows."""

    def set_rows(rows: int) -> None:
        monkeypatch.setattr(reading, "_LONG_BYTES", 0)
        monkeypatch.setattr(reading, "_PART_ROWS", rows)

    return set_rows


def lines(frames: list[int], ids: list[int], kind: int = 1) -> str:
    """MOTChallenge rows at these frames; boxes and scores differ from row to row."""
    return "".join(
        f"{frame},{one},{10 + 3.5 * (row * 5 % 7)},{20 + row * 3 % 5},{5 + row % 3},12,{0.1 + row % 7 / 10:.1f},{kind}\n"
        for row, (frame, one) in enumerate(zip(frames, ids, strict=True))
    )


@pytest.mark.parametrize("rows", [1, 2, 3, 4, 1000])
@pytest.mark.parametrize("role", ["detections", "tracks"])
def test_a_log_of_parts_is_that_of_the_whole_file(tmp_path, in_parts, rows, role):
    frames, ids = [2, 2, 3, 3, 3, 3, 3, 7, 8, 8], [4, 2, 3, 1, 2, 9, 4, 1, 2, 1]
    (tmp_path / "a.txt").write_text(lines(frames, ids, kind=3 if role == "detections" else 1))
    given = {"role": role, "fps": 5, "frames": 12}
    whole = mcaptrack.ingest(tmp_path / "a.txt", tmp_path / "whole.mcap", **given)
    in_parts(rows)
    parts = mcaptrack.ingest(tmp_path / "a.txt", tmp_path / "parts.mcap", **given)
    assert (tmp_path / "parts.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()
    assert parts.warnings == whole.warnings
    assert list(whole.messages.values()) == [12]  # also frames without rows


@settings(max_examples=30)
@given(
    frames=st.lists(st.integers(0, 6), min_size=1, max_size=12).map(sorted),
    rows=st.integers(1, 5),
    name=st.sampled_from(["mot", "trajnet"]),
    with_ids=st.sampled_from(["all", "first", "none"]),
    first_frame=st.sampled_from([None, 0, 3]),
)
def test_parts_together_are_the_whole_file(tmp_path_factory, frames, rows, name, with_ids, first_frame):
    kept = {"all": len(frames), "first": 1, "none": 0}[with_ids]
    ids = [99 - row if row < kept else -1 for row in range(len(frames))]
    text = lines(frames, ids)
    if name == "trajnet":
        text = "".join(f"{frame} {row} {row} 2\n" for row, frame in enumerate(frames))
    path = tmp_path_factory.mktemp("long") / "a.txt"
    path.write_text(text)
    role = "tracks" if with_ids == "all" or name == "trajnet" else "detections"
    whole = read_labels(path, role=role, first_frame=first_frame)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reading, "_LONG_BYTES", 0)
        patch.setattr(reading, "_PART_ROWS", rows)
        long = read_labels_of_any_length(path, role=role, first_frame=first_frame)
    assert long.stored
    parts = [part() for part in long.parts]
    for column in ("frame", "id", "boxes_px", "xy_m", "score", "class_id"):
        wanted = getattr(whole, column)
        found = [getattr(part, column) for part in parts]
        if wanted is None:
            assert found == [None] * len(parts)
        else:
            np.testing.assert_array_equal(np.concatenate(found), wanted)
            assert found[0].dtype == wanted.dtype
    assert all(one.frame[-1] < other.frame[0] for one, other in pairwise(parts))
    for one, other in zip(long.extent, whole.extent, strict=True):
        np.testing.assert_array_equal(one, other)
    for about in ("format", "first_frame", "has_ids", "step", "left_out", "remarks", "doubts", "times_s"):
        assert getattr(long, about) == getattr(whole, about), about
    np.testing.assert_array_equal(long.labelled, whole.labelled)


def test_short_files_are_in_memory(tmp_path):
    (tmp_path / "a.txt").write_text(lines([1, 2], [1, 1]))
    assert not read_labels_of_any_length(tmp_path / "a.txt").stored


def test_rows_that_are_not_in_the_order_of_frames_are_read_as_a_whole(tmp_path, in_parts):
    (tmp_path / "a.txt").write_text(lines([1, 2, 5, 6, 4, 7], [1] * 6))
    in_parts(2)
    labels = read_labels_of_any_length(tmp_path / "a.txt")
    assert not labels.stored
    assert labels.frame.tolist() == [1, 2, 4, 5, 6, 7]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (lines([1, 2, 3, 3, 3], [1, 1, 5, 4, 5]), "id 5 appears twice in frame 3"),
        (lines([1, 2, 3], [1, 1, 1]) + "4,1,x,2,3,4\n", ":4: not MOTChallenge"),
        (lines([1, 2, 3], [1, 1, 1]) + "4,1,1,2,inf,4\n", ":4: a number of the box is missing or not finite"),
    ],
)
def test_errors_name_the_line_of_the_file(tmp_path, in_parts, text, words):
    (tmp_path / "a.txt").write_text(text)
    in_parts(2)
    with pytest.raises(McaptrackError) as error:
        read_labels_of_any_length(tmp_path / "a.txt")
    assert words in str(error.value)


@pytest.mark.parametrize(("role", "classes"), [("truth", "person"), ("tracks", "all"), ("corrections", "person")])
def test_what_depends_on_all_rows_is_read_as_a_whole(tmp_path, in_parts, role, classes):
    (tmp_path / "a.txt").write_text(lines([1, 2, 3], [1, 1, 1]))
    in_parts(1)
    wanted = WantedClasses(classes)
    assert not read_labels_of_any_length(tmp_path / "a.txt", role=role, wanted=wanted).stored
