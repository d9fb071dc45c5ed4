"""The numbers of frames by names of pictures."""

from __future__ import annotations

from pathlib import Path

import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.gathered import GatheredRows, frame_numbers
from mcaptrack.sources.ingest.labels.table import LabelFacts
from mcaptrack.sources.ingest.labels.text import FrameNames


def test_names_of_pictures_are_numbered_in_one_sequence():
    def numbers(names):
        found, by = frame_numbers(names)
        return found if by == "names" else None

    assert numbers(["d/x12_a.jpg", "e\\x007_a.png"]) == [12, 7]
    assert numbers(["1_2.jpg", "1_3.jpg"]) == [2, 3]
    assert numbers(["x1.jpg", "y2.jpg"]) is None
    assert numbers(["x1a.jpg", "x2b.jpg"]) is None
    assert numbers(["x1.jpg", "x01.jpg"]) is None
    assert numbers(["x"]) is None
    assert numbers([f"{2**31 - 1}"]) == [2**31 - 1]
    assert numbers([f"{2**31}"]) is None
    with pytest.raises(ValueError, match=r"names of several sequences, 'a.b' and 'c'"):
        reader = FrameNames()
        assert (reader.number("a.3b.jpg"), reader.number("4c")) == (3, 4)


def test_numbers_may_be_texts():
    rows = GatheredRows(LabelFacts(Path("a.json")), "label")
    assert rows.numbers("7", {"x": " 1.5", "y": "-2e1", "z": 3}, "xyz") == [1.5, -20, 3]
    assert rows.numbers("7", ["1", ".5"], range(2)) == [1, 0.5]
    for text in ("", "one", "nan", "1_0", "1,5", "0x1", "٣", True, [1]):
        with pytest.raises(McaptrackError, match=r"a\.json: label 7 has no box of 2 numbers \(x, y\)"):
            rows.numbers("7", {"x": 1, "y": text}, "xy")
