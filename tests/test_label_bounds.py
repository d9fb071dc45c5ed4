"""Which numbers labels may hold: the last one that is taken and the first one that is refused, for every column."""

from __future__ import annotations

from pathlib import Path

import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest.labels.reading import read_labels

#: Every whole number up to this one is a double.
EXACT = 2**53
#: A line of each format, by the names of its columns.
LINES = {
    "mot": "{frame},{id},{x},20,{w},30,{score},{kind}",
    "sdd": '{id} {x} 20 {right} 50 {frame} 0 0 0 "Pedestrian"',
    "trajnet": "{frame} {id} {x} {y}",
    "obsmat": "{frame} {id} {x} 0 {y} 0 0 0",
}
USUAL = {"frame": "1", "id": "1", "x": "10", "y": "10", "w": "5", "right": "15", "score": "0.5", "kind": "1"}
#: What is tried: a column, the formats, values that are taken, and values that are not.
BOUNDS = [
    ("frame", tuple(LINES), ("0", str(2**31 - 1)), ("-1", str(2**31), "1.5", "nan", "inf", "one")),
    ("id", ("mot",), ("-1", "0", str(EXACT - 1)), ("-2", str(EXACT), "0.5", "nan", "x")),
    ("id", ("sdd", "trajnet", "obsmat"), ("0", str(EXACT - 1)), ("-2", str(EXACT), "0.5", "inf")),
    ("x", ("mot", "trajnet", "obsmat"), ("1e8", "-1e8", "0.25"), ("1.000001e8", "-1.000001e8", "nan", "-inf", "")),
    ("y", ("trajnet", "obsmat"), ("1e8", "-1e8"), ("1.000001e8", "nan")),
    ("w", ("mot",), ("0.001", "1e8"), ("1.000001e8", "inf")),
    ("score", ("mot",), ("1e9", "-1e9", "0"), ("1.1e9", "-1.1e9")),
    ("kind", ("mot",), ("-1", "2", str(2**31 - 1)), ("-2", "1.5")),
]


def tried(bounds):
    """A format, a column, a value, and whether it is taken, of each that is tried."""
    rows = [(column, names, value, True) for column, names, taken, _ in bounds for value in taken]
    rows += [(column, names, value, False) for column, names, _, not_taken in bounds for value in not_taken]
    return [(name, column, value, is_taken) for column, names, value, is_taken in rows for name in names]


@pytest.mark.parametrize(("name", "column", "value", "is_taken"), tried(BOUNDS))
def test_a_number_is_taken_up_to_its_bound_and_no_further(name, column, value, is_taken, tmp_path):
    assert_bound(name, LINES[name], column, value, is_taken, tmp_path)


def assert_bound(name: str, line: str, column: str, value: str, is_taken: bool, tmp_path: Path) -> None:
    path = Path(tmp_path / "a.txt")
    path.write_text(f"{line.format_map(USUAL | {'id': '5'})}\n{line.format_map(USUAL | {column: value})}\n")
    role = "tracks" if name in ("sdd", "trajnet", "obsmat") else "detections"
    if not is_taken:
        with pytest.raises(McaptrackError, match=r"^.*a\.txt:2: "):
            read_labels(path, name, role=role)
        return
    labels = read_labels(path, name, role=role)
    assert labels.format == name
    if column in ("frame", "id"):
        assert sorted(getattr(labels, column).tolist()) == sorted([{"frame": 1, "id": 5}[column], int(value)])
    elif column == "kind":
        assert sorted(labels.class_id.tolist()) == sorted([1, 1 if value == "-1" else int(value)])
