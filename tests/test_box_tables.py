"""Tables, JSON and folders of boxes: every number up to its bound, every sentence in full, expected by hand."""

from __future__ import annotations

import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest.job import fitted
from mcaptrack.sources.ingest.labels import delimited
from mcaptrack.sources.ingest.labels.timeline import Timeline
from tests.label_cases import read, refused, said, table

# Numbers up to their bounds


@pytest.mark.parametrize(
    ("column", "taken", "not_taken", "words"),
    [
        ("frame", ["0", "2147483647"], ["-1", "2147483648", "0.5"], "the frame (a count of pictures, no time) has to be a whole number from 0 to 2147483647, not {:g}"),
        ("id", ["-1", "0", "9007199254740991"], ["-2", "9007199254740992", "1.5"], "the id has to be a whole number from -1 to 9007199254740991, not {:g}"),
        ("class", ["-1", "1", "2147483647"], ["-2", "2147483648", "2.5"], "the class has to be a whole number from -1 to 2147483647, not {:g}"),
        ("score", ["1e9", "-1e9"], ["1.1e9", "-1.1e9"], "a score can't be {:g}"),
        ("x", ["1e8", "-1e8"], ["1.1e8", "-1.1e8"], "a coordinate can't be {:g}; at most 1e+08"),
        ("h", ["0", "1e8"], ["1.1e8"], "a coordinate can't be {:g}; at most 1e+08"),
        ("w", ["0"], ["-0.5"], "a box can't be {:g} wide and 6 high"),
    ],
)  # fmt: skip
def test_a_number_of_a_table_is_taken_up_to_its_bound(column, taken, not_taken, words, tmp_path):
    keys = ["frame", "x", "y", "w", "h", "id", "class", "score"]
    usual = dict(zip(keys, ["3", "10", "20", "5", "6", "7", "2", "0.5"], strict=True))

    def rows(value: str) -> str:
        both = [",".join((usual | more).values()) for more in ({}, {column: value})]
        return table(*both, header="frame,x,y,w,h,track_id,class,score")

    for value in taken:
        labels = read(tmp_path, rows(value))
        assert len(labels.frame) == 2
        if column in ("frame", "id"):
            assert int(float(value)) in getattr(labels, column).tolist()
    for value in not_taken:
        shown = refused(tmp_path, rows(value))
        number = float(value)
        assert shown == ":3: " + words.format(abs(number) if column == "x" else number)


# Frames, ids and classes


def test_shares_become_pixels_once(tmp_path):
    labels = read(tmp_path, table("0,0.25,0.5,0.125,1"))
    assert labels.is_normalised
    for _ in range(2):
        labels = fitted(labels, (64, 32))
        assert labels.boxes_px.tolist() == [[16, 16, 8, 32]]
    assert read(tmp_path, table("0,0.25,0.5,0.125,2")).is_normalised
    assert not read(tmp_path, table("0,0.25,0.5,0.125,2.01")).is_normalised
    assert not read(tmp_path, table("0,1,0,1,2")).is_normalised  # whole numbers
    assert read(tmp_path, table("0,-2,0.5,0.125,0.5")).is_normalised


# Tables


def test_the_first_frame_is_0_or_1_or_given(tmp_path):
    for first, frame in ((0, 0), (1, 1), (1, 5)):
        labels = read(tmp_path, table(f"{frame},1,2,3,4"))
        assert labels.first_frame == first
        words = (
            f": frames begin with {frame}; frame 1 is assumed to be the first picture, `first_frame=` sets the number"
        )
        assert said(tmp_path, labels) == ([words] if frame else [])
    assert said(tmp_path, read(tmp_path, table("5,1,2,3,4"), first_frame=5)) == []


@pytest.mark.parametrize(
    ("header", "unit"),
    [("t", 1), ("time_s", 1), ("t_ms", 1e-3), ("time us", 1e-6), ("timestamp(ns)", 1e-9), ("timestamp_ns", 1e-9)],
)
def test_the_unit_of_times_is_in_the_name_of_the_column(header, unit, tmp_path):
    labels = read(tmp_path, table("5,1,2,3,4", "3,1,2,3,4", "5,9,9,9,9", header=f"{header},x,y,w,h"))
    np.testing.assert_allclose(labels.times_s, [3 * unit, 5 * unit], rtol=1e-15)
    assert (labels.first_frame, labels.frame.tolist()) == (0, [0, 1, 1])


def test_times_reach_to_2262(tmp_path):
    for time in ("0", "9.2e9"):
        assert read(tmp_path, table(f"{time},1,2,3,4", header="t,x,y,w,h")).times_s.tolist() == [float(time)]
    for time in ("-0.1", "9.3e9", "nan"):
        words = f":2: a time is a number of seconds from 0 to the year 2262, not {float(time):g}; "
        words += "the name of its column may end with _ms, _us or _ns"
        assert refused(tmp_path, table(f"{time},1,2,3,4", header="t,x,y,w,h")) == words


def test_a_column_of_ids_that_numbers_rows_is_none(tmp_path):
    rows = ["1,1,2,3,4,7", "1,5,6,7,8,9", "2,5,6,7,8,8"]
    labels = read(tmp_path, table(*rows, header="frame,x,y,w,h,ID"))
    assert labels.id.tolist() == [-1] * 3
    assert f"{tmp_path / 'a'}: every box has another ID, so it numbers rows, not tracks" in labels.remarks
    assert sorted(read(tmp_path, table(*rows, "3,1,1,1,1,7", header="frame,x,y,w,h,ID")).id.tolist()) == [7, 7, 8, 9]
    assert sorted(read(tmp_path, table(*rows, header="frame,x,y,w,h,track_id")).id.tolist()) == [7, 8, 9]
    assert read(tmp_path, table(rows[0], header="frame,x,y,w,h,id")).id.tolist() == [7]
    named = read(tmp_path, table(*rows, header="frame,x,y,w,h,id"), columns={"id": "id"})
    assert sorted(named.id.tolist()) == [7, 8, 9]


def test_a_cell_may_say_nothing(tmp_path):
    for empty in ("", "nan", "None", "NULL", "n/a", "NA"):
        labels = read(tmp_path, table(f"1,1,2,3,4,{empty},{empty}", header="frame,x,y,w,h,score,track_id"))
        assert (str(labels.score.tolist()), labels.id.tolist()) == ("[nan]", [-1])


@pytest.mark.parametrize(
    ("header", "row", "wanted"),
    [
        ("frame,x,y,w,h", "1,10,20,4,6", [10, 20, 4, 6]),
        ("frame,x1,y1,x2,y2", "1,10,20,14,26", [10, 20, 4, 6]),
        ("frame,cx,cy,w,h", "1,10,20,4,6", [8, 17, 4, 6]),
        ("frame,x1,y1,w,h,x2,y2", "1,10,20,640,480,14,26", [10, 20, 4, 6]),
        ("frame;x;y;w;h", "1;10,5;20;4;6", [10.5, 20, 4, 6]),
        ("frame\tx\ty\tw\th", "1\t10.5\t20\t4\t6", [10.5, 20, 4, 6]),
        ("frame\tx\ty\tw\th", "1\t10,5\t20\t4\t6", [10.5, 20, 4, 6]),
    ],
)
def test_boxes_have_corners_or_sizes_or_centres(header, row, wanted, tmp_path):
    labels = read(tmp_path, table(row, header=header))
    assert labels.boxes_px.tolist() == [wanted]
    assert ("; not read: w, h" in labels.remarks[0]) == ("w,h,x2" in header)


@pytest.mark.parametrize(
    ("header", "rows", "classes", "names"),
    [
        # numbers alone, from 0 on and from 1 on
        ("class", ["0", "1", "3"], [1, 2, 4], {}),
        ("class", ["1", "3", "3"], [1, 3, 3], {}),
        # names: people are 1, others by the alphabet, in any case
        ("class", ["dog", "Human", "Car"], [3, 1, 2], {3: "dog", 1: "Human", 2: "Car"}),
        ("class_name", ["dog", "DOG", "pedestrian"], [2, 2, 1], {2: "dog", 1: "pedestrian"}),
        # numbers with their names
        ("class,class_name", ["7,dog", "0,person", "7,dog"], [7, 1, 7], {7: "dog", 1: "person"}),
        # names of something else
        ("team,name", ["7,dog", "0,person"], [1, 1], {}),
        # a number that has two names is none
        ("class,class_name", ["7,dog", "0,person", "7,cat"], [3, 1, 2], {3: "dog", 1: "person", 2: "cat"}),
    ],
)
def test_classes_are_numbers_or_names_or_both(header, rows, classes, names, tmp_path):
    text = table(*(f"{n},1,2,3,4,{row}" for n, row in enumerate(rows)), header=f"frame,x,y,w,h,{header}")
    labels = read(tmp_path, text)
    assert labels.class_id.tolist() == classes
    assert labels.classes == names


def test_a_header_has_four_names_and_no_number(tmp_path):
    assert refused(tmp_path, "a,b,c\n1,2,3").startswith(":1: a row of 3 columns fits no label format")
    assert refused(tmp_path, "a,b,c,d\n1,2,3,4").startswith(":1: no columns for x and x2 (or x and w)")
    assert delimited.header_of(Path("a"), "a,b,c,5") == []
    assert delimited.header_of(Path("a"), '"a b", "c;d",e,f') == ["a b", "c;d", "e", "f"]
    assert delimited.header_of(Path("a"), "abcd") == []


# Times


@pytest.mark.parametrize(
    ("seconds", "fps", "times", "words"),
    [
        ([1.0, 1.5, 2.5], None, [1.0, 1.5, 2.0, 2.5], "4 frames by the times, about 2 a second, 1 of them without boxes"),
        ([3.0], None, [3.0], "1 frames by the times, about 1 a second, 0 of them without boxes"),
        ([1.0, 1.5, 2.3], None, [1.0, 1.5, 2.3], "3 frames by the times, which are irregular; frames without boxes are not known"),
        ([0.0, 1.0, 2.5], None, [0.0, 1.0, 2.5], "3 frames by the times, which are irregular; frames without boxes are not known"),
        ([1.0, 2.0], Fraction(2), [1.0, 1.5, 2.0], "3 frames by the times, about 2 a second, 1 of them without boxes"),
        ([1.0, 1.6], Fraction(2), [1.0, 1.6], "2 frames by the times, about 2 a second, 0 of them without boxes"),
    ],
)  # fmt: skip
def test_pictures_by_times(seconds, fps, times, words):
    made, text = Timeline.of_times(Path("a"), np.array(seconds), fps)
    assert (made.t_ns / 1e9).tolist() == times
    assert made.index.tolist() == list(range(len(times)))
    assert text == words


def test_pictures_by_times_have_limits():
    for last, count in ((99_999.0, 100_000), (100_000.0, 3)):
        made, _ = Timeline.of_times(Path("a"), np.array([0.0, 1.0, last]), None)
        assert len(made.index) == count
    for times in ([0.0, 0.63], [0.0, 0.1, 1.0]):  # the second has two in one frame
        with pytest.raises(McaptrackError, match=r"^a: its times are no multiples of 1/2 s; leave `fps=` out$"):
            Timeline.of_times(Path("a"), np.array(times), Fraction(2))
    with pytest.raises(McaptrackError, match="its times are less than a nanosecond apart"):
        Timeline.of_times(Path("a"), np.array([1.0, 1.0 + 4e-10]), None)


def placed(folder: Path, made: Timeline, *seconds: float) -> list[int]:
    """The row of labels at these times that each picture has; -1 for none."""
    labels = read(folder, table(*(f"{s},1,2,3,4" for s in seconds), header="t,x,y,w,h"))
    return made.place(labels, "tracks", []).number.tolist()


def test_times_of_labels_belong_to_the_nearest_picture_that_is_near(tmp_path):
    even = Timeline.spaced(4, Fraction(10), 10**15, "the pictures")
    assert placed(tmp_path, even, 0.0, 0.3) == [0, -1, -1, 1]
    assert placed(tmp_path, even, 0.049, 0.151) == [0, -1, 1, -1]
    assert placed(tmp_path, even, 0.35) == [-1, -1, -1, 0]
    since_1970 = Timeline.spaced(4, Fraction(10), 1_700_000_000 * 10**9, "the pictures")
    assert placed(tmp_path, since_1970, 1_700_000_000.21, 1_700_000_000.09) == [-1, 0, 1, -1]
    uneven = Timeline(np.arange(5), np.array([0, 1, 2, 9, 10]) * 10**8, "the pictures")
    one = Timeline(np.array([0]), np.array([5 * 10**9]), "the pictures")
    for seconds in (0.4, 0.5, 5.5, 4.5):  # in the log, or since the only picture
        assert placed(tmp_path, one, seconds) == [0]
    for made, times, words in (
        (even, (0.051, 0.149), "0.051 and 0.149 s are nearest to the same of the pictures"),
        (
            uneven,
            (0.15, 0.5, 0.9),
            "1 of 3 times are more than half an interval from any of the pictures, the first at 0.5 s",
        ),
        (uneven, (0.9, 1.06), "its times are from 0.9 to 1.06 s, the pictures from 0.000 to 1.000 s"),
        (one, (0.51,), "from 0.51 to 0.51 s, the pictures from 5.000 to 5.000 s"),
        (one, (5.51,), "from 5.51 to 5.51 s, the pictures from 5.000 to 5.000 s"),
    ):
        with pytest.raises(McaptrackError, match=re.escape(words)):
            placed(tmp_path, made, *times)
