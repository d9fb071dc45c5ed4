"""All that is read of a label file, column by column, and how its frames are put to pictures; expected by hand."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.clocks import FPS_RANGE
from mcaptrack.installed import missing_parts
from mcaptrack.registry import own
from mcaptrack.sources.ingest.labels import text as texts
from mcaptrack.sources.ingest.labels.reading import read_homography, read_labels
from mcaptrack.sources.ingest.labels.roles import WantedClasses
from mcaptrack.sources.ingest.labels.table import BoxTable
from mcaptrack.sources.ingest.labels.timeline import Timeline, count_frames

NAN = float("nan")
MOT = """3,2,10,20,4,8,0.5,1,1
1,1,11,21,5,9,0.25,1,1
3,1,12,22,6,10,1,7,1
2,4,13,23,7,11,0,1,1
4,5,14,24,8,12,1,3,1
5,6,15,25,9,13,1,-1,1
"""
SDD = """1 10 20 14 28 3 0 0 0 "Pedestrian"
1 11 20 16 29 1 0 0 0 "Pedestrian"
2 1 1 9 9 1 0 0 0 "Biker"
3 1 1 9 9 2 1 0 0 "Biker"
4 5 5 9 9 2 1 0 0 "Pedestrian"
5 5 6 9 9 4 0 1 0 "Scooter"
"""
MOT_BOXES = {k: [10 + k, 20 + k, 4 + k, 8 + k] for k in range(6)}


class Read(NamedTuple):
    """What a file should be read as; ``ignored`` are frames, boxes, which are forgiven, and which are regions."""

    frame: list[int]
    id: list[int]
    boxes_px: list[list[int]] | None
    score: list[float]
    labelled: list[int]
    class_id: list[int]
    classes: dict[int, str] = {}
    left_out: str = ""
    ignored: tuple[list[Any], ...] | None = None


#: Text, format that is detected, role, and what is read, sorted by frame and id.
FILES: dict[str, tuple[str, str, str, Read]] = {
    "mot truth": (MOT, "mot", "truth", Read(
        [1, 3, 5], [1, 2, 6], [MOT_BOXES[k] for k in (1, 0, 5)], [NAN] * 3, [1, 2, 3, 4, 5], [1] * 3, {},
        "1 static person, 1 car and 1 boxes that don't count (score 0)",
        ([3, 2, 4], [MOT_BOXES[k] for k in (2, 3, 4)], [True, False, False], [False] * 3))),
    "mot tracks": (MOT, "mot", "tracks", Read(
        [1, 2, 3, 5], [1, 4, 2, 6], [MOT_BOXES[k] for k in (1, 3, 0, 5)], [0.25, 0.0, 0.5, 1.0],
        [1, 2, 3, 4, 5], [1] * 4, {}, "1 static person, 1 car")),
    "mot detections": (MOT, "mot", "detections", Read(
        [1, 2, 3, 3, 4, 5], [1, 4, 1, 2, 5, 6], [MOT_BOXES[k] for k in (1, 3, 2, 0, 4, 5)], [0.25, 0.0, 1.0, 0.5, 1.0, 1.0],
        [1, 2, 3, 4, 5], [1, 1, 7, 1, 3, 1], {1: "pedestrian", 3: "car", 7: "static person"})),
    "mot without classes": ("2,-1,1,2,3,4\n1,-1,5,6,7,8\n1,-1,4,4,4,4\n", "mot", "detections", Read(
        [1, 1, 2], [-1] * 3, [[5, 6, 7, 8], [4] * 4, [1, 2, 3, 4]], [NAN] * 3, [1, 2], [1] * 3)),
    "mot of ten columns": ("2,1,1,2,3,4,0.5,7,8,9\n", "mot", "truth", Read([2], [1], [[1, 2, 3, 4]], [NAN], [2], [1])),
    "sdd tracks": (SDD, "sdd", "tracks", Read(
        [1, 3], [1, 1], [[11, 20, 5, 9], [10, 20, 4, 8]], [NAN] * 2, [1, 2, 3, 4], [1, 1], {1: "Pedestrian"},
        "2 boxes out of sight (lost) and 1 Biker, 1 Scooter")),
    "sdd detections": (SDD, "sdd", "detections", Read(
        [1, 1, 3, 4], [1, 2, 1, 5], [[11, 20, 5, 9], [1, 1, 8, 8], [10, 20, 4, 8], [5, 6, 4, 3]], [NAN] * 4, [1, 2, 3, 4],
        [1, 2, 1, 7], {1: "Pedestrian", 2: "Biker", 7: "Scooter"}, "2 boxes out of sight (lost)")),
}  # fmt: skip


def test_a_class_of_mot_that_no_row_can_have_is_none(tmp_path):
    kinds = (2**31 - 1, 2**31, -1, 3)
    path = written(tmp_path / "a.txt", "".join(f"{n},{n},1,2,3,4,1,{kind}\n" for n, kind in enumerate(kinds, start=1)))
    labels = read_labels(path, "mot", "tracks", wanted=WantedClasses("all"))
    assert labels.class_id.tolist() == [2**31 - 1, 0, 0, 3]
    assert [code for _, code in labels.doubts] == ["classes"] * 2


@pytest.mark.parametrize(("text", "name", "role", "wanted"), FILES.values(), ids=FILES)
def test_every_column_is_read_as_by_hand(text, name, role, wanted, tmp_path):
    assert_read(text, name, role, wanted, tmp_path)


def assert_read(text: str, name: str, role: str, wanted: Read, tmp_path: Path) -> None:
    path = written(tmp_path / "a.txt", text)
    labels = read_labels(path, role=role)
    assert (labels.format, labels.first_frame) == (name, 1 if name == "mot" else 0)
    ignored = labels.ignored
    read = Read(
        labels.frame.tolist(),
        labels.id.tolist(),
        None if labels.boxes_px is None else labels.boxes_px.astype(int).tolist(),
        labels.score.tolist(),
        labels.labelled.tolist(),
        labels.class_id.tolist(),
        dict(labels.classes),
        labels.left_out,
        ignored
        and tuple(
            one.tolist() for one in (ignored.frame, ignored.boxes_px.astype(int), ignored.forgiven, ignored.region)
        ),
    )
    assert str(read) == str(wanted)  # as text, for NaN is not itself
    assert labels.has_ids == any(one != -1 for one in wanted.id)


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


#: All formats.
FORMATS = ", ".join(own("label_format"))
#: What is said of those that aren't there.
OTHERS = "".join(f"; {text}" for text in [missing_parts("label_format")] if text)
#: The first row of a file, and what it is taken for; None for no format.
GUESSES = {
    "1,1,1,1,1": None,
    "1,1,1,1,1,1": "mot",
    ",".join("1" * 10): "mot",
    ",".join("1" * 11): None,
    "1 1 1 1 1 1": None,
    "1 7 10.5 20 30 40 -1 -1 -1 -1": "mot",
    '1 1 1 1 1 1 0 1 1 "Biker"': "sdd",
    "1 1 1 1 1 1 1 1 1 Biker": None,
    '1 1 1 1 1 1 1 1 "Biker"': None,
    "1 1 Car" + 13 * " 1": None,
    "1 1 Car" + 16 * " 1": None,
    "1 1 5" + 14 * " 1": None,
    "1 1 1 1": "trajnet",
    "1,1,1,1": "trajnet",
    "1 1 1": None,
    "1 1 1 1 1 1 1 1": "obsmat",
    "1 1 1 1 1 1 1": None,
}


@pytest.mark.parametrize(("row", "name"), GUESSES.items())
def test_a_format_is_told_by_the_first_row(row, name, tmp_path):
    path = written(tmp_path / "a.txt", f"# a remark\n\n{row}\n")
    if name:
        assert read_labels(path, role="detections").format == name
        return
    count = len(row.replace(",", " ").split())
    with pytest.raises(McaptrackError) as error:
        read_labels(path)
    assert (
        str(error.value) == f"{path}:3: a row of {count} columns fits no label format ({FORMATS}): {row[:60]}{OTHERS}"
    )


#: What is refused, with the text of the file and the words after its name.
REFUSED = {
    "one column": ("mot", "truth", "1\n", ":1: not MOTChallenge (frame, id, left, top, width, height, score, ...), 1 column: 1"),
    "two columns": ("mot", "truth", "1,1,1,1,1,1\n1,2\n", ":2: not MOTChallenge (frame, id, left, top, width, height, score, ...), 2 columns: 1,2"),
    "eleven": ("mot", "truth", ",".join("1" * 11), ":1: not MOTChallenge (frame, id, left, top, width, height, score, ...), 11 columns: 1,1,1,1,1,1,1,1,1,1,1"),
    "letters": ("auto", "truth", "1,1,1,1,2,2\n2,1,x,1,2,2\n", ":2: not MOTChallenge (frame, id, left, top, width, height, score, ...), not all are numbers: 2,1,x,1,2,2"),
    "another format": ("trajnet", "truth", ",".join("1" * 10), ":1: not TrajNet (frame id x y), 10 columns: 1,1,1,1,1,1,1,1,1,1"),
    "nothing": ("auto", "truth", "\n\n", None),
    "none count": ("mot", "truth", "1,1,1,1,1,1,1,3\n1,2,1,1,1,1,0,1\n", " holds no people, only 1 car and 1 boxes that don't count (score 0); `classes=` takes others"),
    "height": ("mot", "truth", "1,1,1,1,1,-3\n", ":1: a box can't be 1 wide and -3 high"),
    "bikers": ("sdd", "tracks", SDD.splitlines()[2], " holds no people, only 1 Biker; `classes=` takes others"),
    "lost": ("sdd", "detections", SDD.splitlines()[3], " holds no boxes in sight, only 1 boxes out of sight (lost)"),
    "ids": ("trajnet", "tracks", "4 1 1 1\n2 7 1 1\n2 8 1 1\n2 7 1 1\n", ":4: id 7 appears twice in frame 2"),
    "json": ("auto", "tracks", ' \n{"a": 1}', f" is JSON (an object with a) of no label format ({FORMATS}){OTHERS}"),
    "a long line": ("mot", "tracks", "1,1,1,1,1,1\n" + "1," * 2048 + "1", ":2: a line of more than 4096 characters is no row"),
}  # fmt: skip


@pytest.mark.parametrize(("name", "role", "text", "words"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_file_of_labels_is_refused_in_these_words(name, role, text, words, tmp_path):
    assert_refused(name, role, text, words, tmp_path)


def assert_refused(name: str, role: str, text: str, words: str | None, tmp_path: Path) -> None:
    path = written(tmp_path / "a.txt", text)
    with pytest.raises(McaptrackError) as error:
        read_labels(path, name, role)
    assert words is None or str(error.value) == f"{path}{words}"


def test_a_header_of_many_columns_is_no_row_of_kitti(tmp_path):
    header = "recordingId,trackId,frame,xCenter,yCenter," + ",".join(f"a{n}" for n in range(12))
    with pytest.raises(McaptrackError, match="its columns are recordingId, trackId, frame, xCenter"):
        read_labels(written(tmp_path / "a.csv", header + "\n" + ",".join("1" * 17)))


def test_a_line_of_4096_characters_is_read_and_ids_may_repeat_in_detections(tmp_path):
    long = "1,1,1,1,1,1".ljust(4095) + "\n"
    assert len(read_labels(written(tmp_path / "a.txt", long), "mot").frame) == 1
    twice = written(tmp_path / "b.txt", "1,3,1,1,1,1\n1,3,2,2,2,2\n")
    assert read_labels(twice, role="detections").id.tolist() == [3, 3]


def test_a_table_is_no_longer_than_its_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(texts, "MAX_ROWS", 2)
    path = written(tmp_path / "a.txt", "1 1 1 1\n2 1 1 1\n")
    assert len(read_labels(path).frame) == 2
    with pytest.raises(McaptrackError, match="has more than 2 rows; give it in parts"):
        read_labels(written(path, "1 1 1 1\n2 1 1 1\n3 1 1 1\n"))


def test_a_column_of_classes_has_a_limit_of_names(tmp_path, monkeypatch):
    """Data sets have up to 21,841 classes; the limit is for files that have something else in this column."""
    rows = [f'{n} 1 1 2 2 {n} 0 0 0 "c{n % 256}"' for n in range(260)]
    path = written(tmp_path / "a.txt", "\n".join(rows))
    labels = read_labels(path, role="detections")
    assert sorted(labels.classes) == list(range(7, 263))
    assert texts.MAX_NAMES >= 21_841
    monkeypatch.setattr(texts, "MAX_NAMES", 256)
    assert len(read_labels(path, role="detections").classes) == 256
    with pytest.raises(McaptrackError, match=r":261: .*the column of classes has more than 256 names"):
        read_labels(written(path, "\n".join([*rows, '1 1 1 2 2 0 0 0 0 "another"'])), role="detections")


@pytest.mark.parametrize(
    ("name", "frames", "step"),
    [
        ("mot", [1, 13, 25], 12), ("mot", [1, 13, 19], 6), ("mot", [1, 13], 1), ("trajnet", [0, 10], 10),
        ("trajnet", [0, 10, 25], 5), ("trajnet", [4], 1), ("obsmat", [4, 10], 6),
    ],
)  # fmt: skip
def test_the_step_of_labelled_frames(name, frames, step, tmp_path):
    row = {"mot": "{},1,1,1,1,1", "trajnet": "{} 1 1 1", "obsmat": "{} 1 1 1 1 1 1 1"}[name]
    assert read_labels(written(tmp_path / "a.txt", "\n".join(map(row.format, frames)))).step == step


@pytest.mark.parametrize(
    ("text", "shape"),
    [
        ("", "no numbers"),
        ("1 2 3\n4 5\n", "3 + 2 numbers"),
        ("1 2 3\n4 5 6\n7 8 9 10\n", "3 + 3 + 4 numbers"),
        ("1 2 3\n4 5 6\n7 8 9\n1\n2\n", "3 + 3 + 3 + 1 + ... numbers"),
        ("1 2 3\n4 5 6\n", "3 + 3 numbers"),
    ],
)
def test_a_homography_says_how_many_numbers_it_found(text, shape, tmp_path):
    path = written(tmp_path / "h.txt", text)
    with pytest.raises(McaptrackError) as error:
        read_homography(path)
    assert str(error.value) == f"{path} is not a homography: it needs 3 rows of 3 numbers, not {shape}"


def test_numbers_of_a_homography_are_separated_by_commas_or_blanks(tmp_path):
    path = written(tmp_path / "h.txt", "1.0e0\t0\t0\n0,1,0\n0 0 1")
    assert read_homography(path) == (1, 0, 0, 0, 1, 0, 0, 0, 1)


def test_a_ground_plane_among_labels_is_told_where_it_belongs(tmp_path):
    path = written(tmp_path / "h.txt", "1 0 5\n0 1 6\n0 0 1\n")
    with pytest.raises(McaptrackError, match=r"is given with the video: `mcaptrack.ingest\('VIDEO', ground_plane='"):
        read_labels(path)


# Frames and pictures


def labels_of(frames: list[int], tmp_path: Path, first: int | None = None) -> tuple[Path, BoxTable]:
    path = written(tmp_path / "a.txt", "".join(f"{n},1,1,1,1,1\n" for n in frames))
    return path, read_labels(path, "mot", first_frame=first)


def timeline(index: list[int], **more: Any) -> Timeline:
    """Pictures 10 ns apart."""
    return Timeline(np.array(index), np.array(index) * 10, "the pictures of it", **more)


#: Pictures, labelled frames, the first frame, more about the pictures; then index and number of each picture that is
#: labelled, and what is lost.
PLACED: dict[str, tuple[list[int], list[int], int | None, dict[str, Any], list[tuple[int, int]], list[str]]] = {
    "all": ([0, 1, 2], [1, 3], None, {}, [(0, 1), (1, 2), (2, 3)], []),
    "counted from 0": ([0, 1, 2], [0, 2], None, {}, [(0, 0), (1, 1), (2, 2)], []),
    "counted from 5": ([0, 1, 2], [5, 7], 5, {}, [(0, 5), (1, 6), (2, 7)], []),
    "the last lost": (
        [0, 1, 2],
        [1, 4, 5],
        None,
        {"is_complete": False},
        [(0, 1), (1, 2), (2, 3)],
        ["2 labels are of frames after the last picture that could be read, 2"],
    ),
    "one in between lost": (
        [0, 2, 3],
        [1, 2, 3],
        None,
        {"is_complete": False},
        [(0, 1), (2, 3), (3, 4)],
        ["1 labels are of frames with missing pictures"],
    ),
    "steps of two": ([0, 1, 2, 3, 4, 5], [2, 4, 6], None, {}, [(1, 2), (3, 4), (5, 6)], []),
    "names that count every third": ([0, 1, 2], [1, 4, 7], None, {"every": 3}, [(0, 1), (1, 4), (2, 7)], []),
    "names that count, from 4 on": ([0, 1, 2], [4, 7], None, {"every": 3}, [(0, 1), (1, 4), (2, 7)], []),
    "names that labels do not follow": ([0, 1, 2], [1, 2, 3], None, {"every": 3}, [(0, 1), (1, 2), (2, 3)], []),
}


@pytest.mark.parametrize(("index", "frames", "first", "more", "wanted", "said"), PLACED.values(), ids=PLACED)
def test_labels_are_put_to_the_pictures_with_their_number(index, frames, first, more, wanted, said, tmp_path):
    path, labels = labels_of(frames, tmp_path, first)
    lost: list[str] = []
    with notices.listening(lambda _: None), notices.collected() as warned:
        placed = timeline(index, **more).place(labels, "tracks", lost)
    assert list(zip(placed.index.tolist(), placed.number.tolist(), strict=True)) == wanted
    assert placed.t_ns.tolist() == [10 * at for at, _ in wanted]
    assert lost == [f"{path}: {words}" for words in said]
    counts_names = more.get("every", 1) > 1 and frames != [1, 2, 3]
    words = f"{path} counts frames as the names of the pictures of it do, every 3"
    assert [(one.message, one.code) for one in warned] == [(words, "clock")] * counts_names


def test_one_label_of_the_first_picture_counts_in_no_way(tmp_path):
    _, labels = labels_of([1], tmp_path)
    with notices.listening(lambda _: None), notices.collected() as warned:
        placed = timeline([0, 1], every=3).place(labels, "tracks", [])
    assert (placed.number.tolist(), warned) == ([1, 4], [])


END = "the pictures of it end with frame {}, the labels with frame {}"
GIVE = "; give the labels of these pictures, or the part of the file that is of them"
#: Frames, the first of them, more about the pictures 0 to 2, and what is said.
NOT_PLACED: dict[str, tuple[list[int], int | None, dict[str, Any], str]] = {
    "before": ([4, 6], 5, {}, "its first label is of frame 4, and frame 5 is assumed to be the first picture; give the right number with `first_frame=`"),
    "one beyond": ([1, 2, 3, 4], None, {}, f"1 labels are of frames after the last picture: {END.format(3, 4)}{GIVE}"),
    "all beyond": ([4, 7], None, {}, f"all labels are of frames after the last picture: {END.format(3, 7)}{GIVE}"),
    "all beyond what could be read": ([4, 7], None, {"is_complete": False}, f"all labels are of frames after the last picture: {END.format(3, 7)}{GIVE}"),
    "another start": ([2, 4], None, {}, f"1 labels are of frames after the last picture: {END.format(3, 4)}; if frame 2 of the file is the first picture, say so with `first_frame=2`"),
    "no other start": ([2, 5], None, {}, f"1 labels are of frames after the last picture: {END.format(3, 5)}{GIVE}"),
}  # fmt: skip


@pytest.mark.parametrize(("frames", "first", "more", "words"), NOT_PLACED.values(), ids=NOT_PLACED)
def test_labels_without_a_picture_say_what_to_do(frames, first, more, words, tmp_path):
    path, labels = labels_of(frames, tmp_path, first)
    with pytest.raises(McaptrackError) as error:
        timeline([0, 1, 2], **more).place(labels, "tracks", [])
    assert str(error.value) == f"{path}: {words}"


@given(
    st.integers(1, 40),
    st.fractions(*FPS_RANGE)
    | st.sampled_from([Fraction(2048), Fraction(30000, 1001), Fraction(7), Fraction(10**15, 3), Fraction(1, 3)]),
    st.integers(0, 2**60),
)
def test_times_by_a_rate_are_the_nearest_whole_nanoseconds(count, fps, start_ns):
    made = Timeline.spaced(count, fps, start_ns, "it")
    times = [start_ns + round(Fraction(k) / fps * 10**9) for k in range(count)]  # Python rounds half to even
    assert made.t_ns.tolist() == times
    assert made.fits(fps)


def test_times_end_with_the_year_2262():
    fps = Fraction(1, 10**9)  # a picture in 10**18 ns
    assert Timeline.spaced(10, fps, 0, "it").t_ns[-1] == 9 * 10**18
    assert Timeline.spaced(1, fps, 2**63 - 1, "it").t_ns.tolist() == [2**63 - 1]
    with pytest.raises(McaptrackError) as error:
        Timeline.spaced(11, fps, 0, "it")
    days = 11 * 10**9 / 86400
    assert str(error.value) == (
        f"it: 11 frames at 1e-09 a second end {days:.3g} days after the start; times reach to the year 2262"
    )


def test_pictures_fit_a_rate_within_half_a_frame():
    fps, frame_ns = Fraction(10), 10**8
    for off_ns in (0, frame_ns // 2, -frame_ns // 2, frame_ns // 2 + 1, -frame_ns // 2 - 1):
        for which in range(3):  # the first picture is what the others are counted from
            times = 5 + np.array([0, 1, 3]) * frame_ns
            times[which] += off_ns
            assert Timeline(np.array([4, 5, 7]), times, "it").fits(fps) is (abs(off_ns) <= frame_ns // 2)
    assert Timeline(np.array([4, 5, 7]), np.array([0, 1, 3]) * 2 * frame_ns, "it").fps == 5
    assert Timeline(np.array([4]), np.array([7]), "it").fps == 0


def test_a_file_without_pictures_counts_no_more_empty_frames_than_are_likely(tmp_path):
    """100 000 in all, or 100 for each labelled one."""
    for last, ok in ((100_000, True), (100_001, False)):
        path, labels = labels_of([1, 2, last], tmp_path)
        if ok:
            assert count_frames(labels) == last
            continue
        with pytest.raises(McaptrackError) as error:
            count_frames(labels)
        assert str(error.value) == (
            f"{path}: frame {last} would be the last of {last} frames, of which 3 are labelled; `frames={last}` takes "
            "it so, or give the number of the first picture with `first_frame=1`"
        )
    path, labels = labels_of([5, 6, 20_000_000], tmp_path, first=3)
    with pytest.raises(McaptrackError, match=r"of 19999998 frames, .*; at most 10000000 are read, or .*first_frame=5`"):
        count_frames(labels)
    sparse = [1 + 50 * n for n in range(30)] + [1 + 50 * 2990]
    assert count_frames(labels_of(sparse, tmp_path)[1]) == 1 + 50 * 2990  # 31 labelled, a step of 50: up to 155 000
    sparse[-1] = 1 + 50 * 3100
    with pytest.raises(McaptrackError):
        count_frames(labels_of(sparse, tmp_path)[1])
