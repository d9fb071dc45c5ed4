"""3D labels at their limits: the last number that is taken and the first one that is refused, and all that is said."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mcaptrack import log, notices
from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.sources.ingest.labels.reading import is_3d, read_labels
from mcaptrack.sources.ingest.labels.text import headings, numbered

USUAL = {
    "t_ns": "1000", "id": "1", "class": "car", "x_m": "1", "y_m": "2", "z_m": "3", "length_m": "4", "width_m": "2",
    "height_m": "1.5", "heading_rad": "0.5", "score": "0.5",
}  # fmt: skip


def table(folder: Path, *rows: dict[str, object], name: str = "a.csv", delimiter: str = ",") -> Path:
    """A table with the columns of the first row."""
    lines = [rows[0].keys(), *(row.values() for row in rows)]
    path = folder / name
    path.write_text("".join(delimiter.join(map(str, line)) + "\n" for line in lines))
    return path


def usual(**changes: object) -> dict[str, object]:
    return {key: value for key, value in (USUAL | changes).items() if value is not None}


def framed(**changes: object) -> dict[str, object]:
    """A row with a frame number instead of a time."""
    return {"frame": "1"} | usual(t_ns=None) | changes


#: A column, the numbers that are taken, and those that are not, with the words for the first of them.
BOUNDS = [
    ("x_m", ("1e8", "-1e8"), ("1.0000001e8", "-1.0000001e8"), "a coordinate can't be 1e+08; at most 1e+08 m"),
    ("y_m", ("1e8", "-1e8"), ("1.0000001e8", "-1.0000001e8"), "a coordinate can't be 1e+08; at most 1e+08 m"),
    ("z_m", ("1e8", "-1e8"), ("1.0000001e8", "-1.0000001e8"), "a coordinate can't be 1e+08; at most 1e+08 m"),
    ("x_m", (), ("", "nan", "inf"), "x or y of the box is missing or not finite"),
    ("y_m", (), ("", "-inf"), "x or y of the box is missing or not finite"),
    ("z_m", (), ("", "inf"), r"a number of the box is missing or not finite (z_m), which other boxes have"),
    ("heading_rad", (), ("", "nan"), r"a number of the box is missing or not finite (heading_rad)"),
    ("heading_rad", ("12.56", "-12.56"), ("12.57", "-12.57"), "a heading of 12.57 is not in radians"),
    ("length_m", ("0",), ("-0.001", "", "inf"), "a size can't be -0.001"),
    ("width_m", ("0",), ("-0.001", "nan"), "a size can't be -0.001"),
    ("height_m", ("0",), ("-0.001", "x"), "a size can't be -0.001"),
    ("score", ("1e9", "-1e9", ""), ("1.1e9", "-1.1e9"), "a score can't be 1.1e+09"),
    ("t_ns", ("0", str(2**63 - 1)), ("-1", str(2**63)), "-1 in the column of times is not from 1970 to 2262"),
    ("t_ns", ("999.4",), ("", "noon", "inf"), "'' in the column of times is no number"),
    (
        "frame",
        ("0", str(2**31 - 1)),
        (str(2**31), "-1", "0.5", ""),
        "has to be a whole number from 0 to 2147483647, not 2.14748e+09",
    ),
]
TRIED = [(column, value, "") for column, taken, _, _ in BOUNDS for value in taken] + [
    (column, value, words if value == refused[0] else ":3: ")
    for column, _, refused, words in BOUNDS
    for value in refused
]


@pytest.mark.parametrize(("column", "value", "words"), TRIED)
def test_a_number_is_taken_up_to_its_bound_and_no_further(column, value, words, tmp_path):
    row = framed if column == "frame" else usual
    others = [row(id=2), row(id=1, **{column: value}), row(id=2, frame="7") if row is framed else row(id=2, t_ns=7)]
    path = table(tmp_path, *others)
    if words:
        with pytest.raises(McaptrackError) as refused:
            read_labels(path, role="truth")
        assert words in str(refused.value)
        assert f"{path}:3: " in str(refused.value)
        return
    rows = read_labels(path, role="truth")
    if column == "score":
        np.testing.assert_equal(rows.score, [0.5, float(value or "nan"), 0.5])
    elif column in ("t_ns", "frame"):
        assert int(value.partition(".")[0]) in rows.frame.tolist()
    else:
        found = rows.boxes_m[1, ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad").index(column)]
        assert found == pytest.approx(
            math.remainder(float(value), 2 * math.pi) if "heading" in column else float(value)
        )


@pytest.mark.parametrize(
    ("lengths", "refused"),
    [
        ([0.06, 0.04], ""), ([0.049, 0.049], "0.049"), ([60, 60], ""), ([61, 61], "61"), ([0.01, 7, 0.02], "0.02"),
        ([900, 7, 900], "900"), ([900, 7, 8], ""),
    ],
)  # fmt: skip
def test_the_median_length_tells_whether_sizes_are_metres(lengths, refused, tmp_path):
    rows = [usual(id=n, length_m=length, width_m=0.001, height_m=0.001) for n, length in enumerate(lengths)]
    path = table(tmp_path, *rows)
    if not refused:
        assert read_labels(path, role="truth").boxes_m[:, 3].tolist() == lengths
        return
    with pytest.raises(McaptrackError) as error:
        read_labels(path, role="truth")
    why = f"the median length of its boxes is {refused}; sizes have to be in metres"
    assert str(error.value) == f"{path}: {why}, as positions have, not in centimetres or millimetres"


def test_rows_without_sizes_or_heights_are_boxes_too(tmp_path):
    rows = [{"t": n / 4, "id": 5, "x_m": n, "y_m": -n} for n in range(3)]
    found = read_labels(table(tmp_path, *rows), role="truth")
    assert found.boxes_m[:, :2].tolist() == [[0, 0], [1, -1], [2, -2]]
    assert np.isnan(found.boxes_m[:, 2:]).all()
    assert found.frame.tolist() == [0, 250_000_000, 500_000_000]
    assert not found.doubts


@pytest.mark.parametrize("per_metre", [1, 1000])
def test_positions_in_millimetres_are_said_to_be_no_metres(per_metre, tmp_path):
    rows = [{"t": n / 4, "id": 5, "x_m": 5.5 * n * per_metre, "y_m": 0} for n in range(3)]
    path = table(tmp_path, *rows)
    text = f"{path}: positions spread over 9900 m, as millimetres do; they have to be metres"
    assert read_labels(path, role="truth").doubts == [(text, "units")] * (per_metre > 1)


@pytest.mark.parametrize(
    ("ids", "wanted"),
    [
        (["7", "3"], [7, 3]),
        (["7.0", "3"], [7, 3]),
        (["0", "0009"], [0, 9]),
        ([str(10**15), "9" * 16], [10**15, 10**16 - 1]),
        ([str(10**16), "1"], [1, 2]),
        (["1.5", "1", "1.5"], [1, 2, 1]),
        (["b", "a", "b", "c"], [1, 2, 1, 3]),
        (["²", "1"], [1, 2]),
        ([], []),
    ],
)
def test_ids_are_numbers_or_are_numbered_as_they_come(ids, wanted):
    assert numbered(ids).tolist() == wanted


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([usual(), usual()], "a.csv:3: id 1 appears twice at one time"),
        ([usual(id="b"), usual(id="a"), usual(id="b")], "a.csv:4: id 1 appears twice at one time"),
        ([framed(), framed(frame=2), framed()], "a.csv:4: id 1 appears twice in frame 1"),
        ([usual(id=""), usual(id="none")], "a.csv has no ids (all are -1); truth need ids"),
        (
            [usual(id=n, t_ns=n) for n in (1, 2)],
            "a.csv: every row has another id, so that these number rows, not tracks",
        ),
    ],
)
def test_each_id_is_there_once_in_a_frame(rows, words, tmp_path):
    path = table(tmp_path, *rows)
    with pytest.raises(McaptrackError) as refused:
        read_labels(path, role="truth")
    assert str(refused.value) == f"{path.parent}/{words}"
    found = read_labels(path, role="detections")
    assert len(found.frame) == len(rows)


def test_every_id_may_be_there_once_in_a_single_frame(tmp_path):
    assert read_labels(table(tmp_path, usual(id=4), usual(id=9)), role="truth").id.tolist() == [4, 9]


# Doubts about the axes


def spread(step: tuple[float, float, float], count: int = 21) -> list[dict[str, object]]:
    """One track on a line: 5 to 95 % of it are 18 of 20 steps."""
    place = [tuple(round(n * one, 6) for one in step) for n in range(count)]
    return [usual(t_ns=n * 10**9, x_m=x, y_m=y, z_m=z, heading_rad=0) for n, (x, y, z) in enumerate(place)]


@pytest.mark.parametrize(
    ("step", "words"),
    [
        ((0.16, 0.5, 1.12), "positions spread over 20 m along z, and 2.9 m along x"),
        ((0.5, 0.16, 1.12), "positions spread over 20 m along z, and 2.9 m along y"),
        ((0.02, 0.01, 2.0), "positions spread over 36 m along z, and 0.2 m along y"),
        ((0.16, 0.5, 1.1), ""),
        ((0.17, 0.5, 1.12), ""),
        ((0.5, 0.17, 1.12), ""),
    ],
)
def test_flat_positions_along_x_or_y_are_doubted(step, words, tmp_path):
    path = table(tmp_path, *spread(step))
    doubts = [one for one, code in read_labels(path, role="truth").doubts if "along z" in one and code == "units"]
    assert doubts == ([f"{path}: {words}; z has to be the vertical axis"] if words else [])


@pytest.mark.parametrize(
    ("speed", "heading", "count", "across"),
    [
        (2.0, 1.5, 21, 20), (2.0, 1.5, 20, 0), (1.01, 1.5, 21, 20), (0.99, 1.5, 21, 0), (2.0, 0.79, 21, 20),
        (2.0, 0.78, 21, 0), (2.0, -0.79, 21, 20), (2.0, -0.78, 21, 0), (2.0, math.pi - 0.79, 21, 20),
        (2.0, math.pi - 0.78, 21, 0), (2.0, 0.78 - math.pi, 21, 0),
    ],
)  # fmt: skip
def test_objects_that_move_across_their_heading_are_doubted(speed, heading, count, across, tmp_path):
    """Of one track; another stands still, and a step from one track to the other is none."""
    rows = [usual(t_ns=n * 500_000_000, x_m=n * speed / 2, y_m=5, heading_rad=heading) for n in range(count)]
    rows += [usual(id=9, t_ns=n * 500_000_000, x_m=-50, y_m=50, heading_rad=heading) for n in range(30)]
    path = table(tmp_path, *rows[::-1])
    doubts = [one for one, _ in read_labels(path, role="truth").doubts if "across" in one]
    words = f"{path}: {across} of {count - 1} boxes of moving objects move across their heading"
    assert [one.partition(";")[0] for one in doubts] == ([words] if across else [])


# Classes


@pytest.mark.parametrize(
    ("names", "ids", "classes", "said"),
    [
        (["car", "Person", "truck", "car"], [2, 1, 3, 2], {1: "Person", 2: "car", 3: "truck"}, ""),
        (["van", "Bus"], [3, 2], {2: "Bus", 3: "van"}, ""),
        (["Car", "car", "CAR"], [2, 2, 2], {2: "Car"}, ""),
        (["pedestrian", "human"], [1, 1], {1: "pedestrian"}, ""),
        (["7", "1", "0"], [7, 1, 0], {}, "has no class names; class 1 is taken as people"),
        (["999999999", "2"], [999999999, 2], {}, "has no class names; class 1 is taken as people"),
        (["1234567890", "2"], [2, 3], {2: "1234567890", 3: "2"}, ""),
        (["car", ""], [2, 0], {2: "car"}, "1 boxes without a class have class_id 0"),
        (["", "none", "x"], [0, 0, 2], {2: "x"}, "2 boxes without a class have class_id 0"),
    ],
)
def test_classes_are_people_and_others_by_name(names, ids, classes, said, tmp_path):
    path = table(tmp_path, *(usual(id=n, **{"class": name}) for n, name in enumerate(names)))
    rows = read_labels(path, role="truth")
    assert (rows.class_id.tolist(), rows.classes) == (ids, classes)
    assert [code for _, code in rows.doubts] == (["classes"] if said else [])
    assert all(said in words for words, _ in rows.doubts)


def test_a_table_without_classes_says_so(tmp_path):
    rows = read_labels(table(tmp_path, usual(**{"class": None})), role="truth")
    assert rows.class_id.tolist() == [0]
    assert f"{rows.path} states no classes; class_id is 0" in rows.remarks


# Quaternions


def turned(**angles: float) -> np.ndarray:
    """w, x, y, z of a rotation by angles in degrees."""
    rotation = Rotation.from_euler("zyx", [angles.get(axis, 0) for axis in "zyx"], degrees=True)
    return rotation.as_quat()[[3, 0, 1, 2]]


@pytest.mark.parametrize("length", [0.0, 0.89, 1.11, math.nan])
def test_quaternions_have_the_length_1(length):
    quaternions = np.stack([turned(z=5), turned(z=9) * length, turned(z=7) * 3])
    with pytest.raises(McaptrackError, match=rf"^row 1: a quaternion of length {length:g} is no rotation$"):
        headings(quaternions, Path("a"), lambda row: f"row {row}")


@pytest.mark.parametrize(("tilts", "degrees"), [((44, 44, 90), 0), ((46, 46, 0), 46), ((0, 0, 180), 0)])
def test_z_of_most_boxes_is_up(tilts, degrees):
    quaternions = np.stack([turned(z=20, y=tilt) for tilt in tilts])
    if not degrees:
        np.testing.assert_allclose(np.degrees(headings(quaternions, Path("a"), str)[1]), tilts, atol=1e-5)
        return
    with pytest.raises(McaptrackError) as refused:
        headings(quaternions, Path("a"), str)
    assert str(refused.value) == f"a: z of the boxes is {degrees} degrees from up; it has to be up"


def test_quaternions_of_rows_without_a_box_do_not_count(tmp_path):
    four = dict(zip(("qw", "qx", "qy", "qz"), turned(z=30), strict=True))
    rows = [{"t": n, "id": 1, "x_m": n, "y_m": 0, "z_m": 0} | four for n in range(3)]
    rows[1] = dict.fromkeys(rows[0], "") | {"t": 1, "id": 1}
    found = read_labels(table(tmp_path, *rows), role="truth")
    np.testing.assert_allclose(found.boxes_m[:, 6], np.radians([30, 30]))
    assert found.labelled.tolist() == [0, 10**9, 2 * 10**9]
    rows[2] |= {"qw": 3}
    with pytest.raises(McaptrackError, match=r"a\.csv:4: a quaternion of length"):
        read_labels(table(tmp_path, *rows), role="truth")


# Tables


@pytest.mark.parametrize(
    ("header", "is_one"),
    [
        ("frame,id,x_m,y_m", True), ("frame,id,x_m,south", True), ("frame,id,x1,z_m", True), ("t,id,u,tz_m", True),
        ("frame,id,w,length_m", True), ("a,b,c,Heading (rad)", True), ("a,b,c,heading_deg", True),
        ("t,x,y,z,yaw", True), ("t,x,y,z,qw", True), ("t,x,y,z,speed", False), ("t,x,y,yaw,w,h", False),
        ("frame,left,top,width,height", False), ("1,2,3,4,5,6", False), ("frame,x_m,y_m", False),
    ],
)  # fmt: skip
def test_a_table_of_3d_boxes_is_known_by_its_header(header, is_one, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(header + "\n")
    assert is_3d(path) == is_one
    assert is_3d(path, "csv") == is_one
    assert not is_3d(path, "mot")
    assert is_3d(path, columns={"x_m": "north"})
    assert is_3d(path, columns={"x": "left"}) == is_one


def test_what_is_no_text_is_no_table_of_3d_boxes(tmp_path):
    for name, content in (("a.csv", b"frame,id,x_m,y_m\0\n"), ("b.csv", b"frame,id,x_m,y_m,\xff\n"), ("c.csv", b"")):
        (tmp_path / name).write_bytes(content)
        assert not is_3d(tmp_path / name)
    assert not is_3d(tmp_path / "none.csv")
    assert not is_3d(tmp_path)


#: Tables with several columns for one thing: which of them are read, and which aren't.
CHOICES = [
    ("t,frame,id,x_m,y_m,heading_rad,heading_deg", "t=t in s, id=id, x_m=x_m, y_m=y_m, heading_rad=heading_rad", "frame, heading_deg"),
    ("t,id,x_m,y_m,heading_deg,qw,qx,qy,qz", "t=t in s, id=id, x_m=x_m, y_m=y_m, heading_deg=heading_deg", "qw, qx, qy, qz"),
    ("t,id,x_m,y_m,qw,qx,qz", "t=t in s, id=id, x_m=x_m, y_m=y_m", "qw, qx, qz"),
    ("t,id,x_m,y_m,class,class_name", "t=t in s, id=id, x_m=x_m, y_m=y_m, name=class_name", "class"),
    ("t,id,x_m,y_m,x,y,north", "t=t in s, id=id, x_m=x_m, y_m=y_m", "x, y, north"),
    ("time_ms,id,x_m,y_m,vx,vy", "t=time_ms in ms, id=id, x_m=x_m, y_m=y_m, vx_m_per_s=vx, vy_m_per_s=vy", ""),
]  # fmt: skip


@pytest.mark.parametrize(("header", "used", "unused"), CHOICES)
def test_of_columns_that_say_the_same_one_is_read(header, used, unused, tmp_path):
    row = {name: {"id": 1, "qw": 1, "class": "a", "class_name": "b"}.get(name, 0) for name in header.split(",")}
    rows = read_labels(table(tmp_path, row), role="truth")
    (words,) = [one for one in rows.remarks if ": columns " in one]
    read, _, left = words.removeprefix(f"{rows.path}: columns ").partition("; not read: ")
    assert sorted(read.split(", ")) == sorted(used.split(", "))
    assert left == unused


def test_a_column_that_is_named_is_read_although_others_say_the_same(tmp_path):
    row = {"t": 5, "frame": 9, "id": 1, "x_m": 2, "y_m": 3, "heading_rad": 0.5, "heading_deg": 90}
    rows = read_labels(table(tmp_path, row), role="truth", columns={"frame": "frame", "heading_deg": "heading_deg"})
    assert not rows.facts.is_timed
    assert rows.frame.tolist() == [9]
    assert rows.boxes_m[0, 6] == pytest.approx(math.pi / 2)
    with pytest.raises(McaptrackError, match=r"a\.csv:1: 2 columns are named t, as `columns=` says for x_m"):
        (tmp_path / "b").mkdir()
        path = tmp_path / "b" / "a.csv"
        path.write_text("t,t,x_m,y_m\n1,2,3,4\n")
        read_labels(path, role="truth", columns={"x_m": "t"})


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("t,id,x_m,y_m,z_cm", ""),
        ("t,id,x_m,y_m,length (ft)", ""),
        ("t,id,x,y_m,z", ""),
        ("t,id,x [mm],y_m,z", "no column for x_m; x [mm] is not in metres"),
        ("t,id,x_m,y_px,z", "y_px is not in metres"),
        ("t,id,x_m,north", "no column for y_m"),
        ("t,id,x_cm,y_m,z", "no column for x_m; x_cm is not in metres"),
        ("id,x_m,y_m,z", "no column for the time or the frame of boxes; its columns are id, x_m, y_m, z; name it with"),
    ],
)
def test_columns_are_in_metres(header, words, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(f"{header}\n{','.join(['1'] * len(header.split(',')))}\n")
    if not words:
        assert read_labels(path, role="detections").boxes_m[0, :2].tolist() == [1, 1]
        return
    with pytest.raises(McaptrackError) as refused:
        read_labels(path, role="detections")
    assert f"{path}:1: {words}" in str(refused.value)


def test_times_are_exact_in_every_unit(tmp_path):
    for name, text in (
        ("t", "1.0000000019"),
        ("t_ms", "1000.0000019"),
        ("t_us", "1000000.0019"),
        ("t_ns", "1000000001.9"),
    ):
        row = {name: text, "id": 1, "x_m": 0, "y_m": 0}
        assert read_labels(table(tmp_path, row), role="truth").frame.tolist() == [1_000_000_002], name


# Into a log


def ingested(source: Path, output: Path, into: Path | None = None, **options: object):
    """What ``ingest`` wrote: times, remarks and warnings."""
    role = options.pop("role", "truth")
    with notices.collected(), notices.listening(lambda _: None):
        if into is None:
            report = ingest(source, output, IngestOptions(role=role, **options))
        else:
            with log.read(into) as opened:
                report = ingest(source, into, IngestOptions(role=role, **options), into=opened, force=True)
    with log.read(into or output) as opened:
        (topic,) = report.messages
        times = opened.times(topic).tolist()
    return times, report.remarks, [one.message for one in report.warnings]


S = 10**9


@pytest.mark.parametrize(
    ("frames", "options", "times", "remark", "doubt"),
    [
        ((0, 2), {"fps": 2}, (0, S // 2, S), "frame 0 is at 0.000 s", ""),  # frame 1 is labelled, too
        ((1, 2), {"fps": 2}, (0, S // 2), "frame 1 is at 0.000 s", "frames begin with 1; frame 1 is assumed"),
        ((4, 5), {"fps": 2}, (3 * S // 2, 2 * S), "frame 1 is at 0.000 s", "frames begin with 4; frame 1 is assumed"),
        ((4, 5), {"fps": 2, "first_frame": 4}, (0, S // 2), "frame 4 is at 0.000 s", ""),
        ((4, 5), {"fps": 2, "first_frame": 0, "start_ns": 7 * S}, (9 * S, 19 * S // 2), "frame 0 is at 7.000 s", ""),
    ],
)
def test_frames_have_times_by_a_rate(frames, options, times, remark, doubt, tmp_path):
    path = table(tmp_path, *(framed(frame=frame) for frame in frames))
    options = {**options, "fps": Fraction(options["fps"])}
    found, remarks, warnings = ingested(path, tmp_path / "log.mcap", **options)
    assert found == list(times)
    assert f"{path}: {remark}" in remarks
    doubts = [one for one in warnings if "frames begin" in one]
    assert [one.partition(" to be the first")[0] for one in doubts] == ([f"{path}: {doubt}"] if doubt else [])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"fps": Fraction(2), "first_frame": 5}, "its first frame is 4, before `first_frame=5`"),
        ({}, "counts frames and has no clock; give the frames per second with `fps=`"),
    ],
)
def test_frames_without_a_time_are_refused(options, words, tmp_path):
    with pytest.raises(McaptrackError, match=words):
        ingested(table(tmp_path, framed(frame=4)), tmp_path / "log.mcap", **options)


@pytest.mark.parametrize("name", ["fps", "first_frame"])
def test_times_of_a_table_leave_no_room_for_a_rate(name, tmp_path):
    with pytest.raises(McaptrackError, match=f"has times; leave `{name}=` out"):
        ingested(table(tmp_path, usual()), tmp_path / "log.mcap", **{name: Fraction(1) if name == "fps" else 0})


@pytest.mark.parametrize(
    ("first_s", "is_taken"),
    [(40, True), (39.999, False), (110 + 60, True), (110 + 60.001, False), (100, True)],
)
def test_labels_are_at_most_a_minute_from_their_log(first_s, is_taken, tmp_path):
    """Of a log from 100 to 110 s, and labels of one time."""
    box = usual(id=None, score=None)
    path = table(tmp_path, box | {"t_ns": 100 * S}, box | {"t_ns": 110 * S}, name="boxes.csv")
    ingested(path, tmp_path / "log.mcap", role="detections")
    labels = table(tmp_path, usual(t_ns=5))
    options = {"start_ns": round(first_s * S)}
    if is_taken:
        assert ingested(labels, tmp_path, tmp_path / "log.mcap", **options)[0] == [round(first_s * S)]
        return
    with pytest.raises(McaptrackError, match=r"from 100\.000 to 110\.000 s; give the time of the first labels with"):
        ingested(labels, tmp_path, tmp_path / "log.mcap", **options)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"quality": 5}, "`quality=`"),
        ({"ground_plane": "h.txt"}, "`ground_plane=`"),
        ({"motion": "m.txt"}, "`motion=`"),
        ({"size": (1, 1)}, "`size=`"),
        ({"frames": 0}, "`frames=`"),
    ],
)
def test_options_of_pictures_are_refused(options, name, tmp_path):
    for key, text in (("ground_plane", "1,0,0\n0,1,0\n0,0,1\n"), ("motion", "0,1,0,0,0,1,0\n")):
        if key in options:
            (tmp_path / options[key]).write_text(text)
            options = {key: tmp_path / options[key]}
    with pytest.raises(McaptrackError, match=rf"a\.csv holds 3D boxes; {name} is for pictures and boxes in them"):
        ingested(table(tmp_path, usual()), tmp_path / "log.mcap", **options)


def test_two_files_of_one_role_are_refused(tmp_path):
    path, other = table(tmp_path, usual()), table(tmp_path, usual(), name="b.csv")
    with pytest.raises(McaptrackError) as refused:
        ingested(path, tmp_path / "log.mcap", labels={"truth": other})
    assert str(refused.value) == f"{other} and {path} are both truth; give the role of {other} with `role=`"


@pytest.mark.parametrize("ids", [("1.5", "2.5"), ("-5", "-6"), ("a", "7"), ("7", "8.0"), ("7", "8")])
def test_ids_stay_as_they_are_or_it_is_said(tmp_path, ids):
    path = tmp_path / "a.csv"
    path.write_text("t,id,x_m,y_m,z_m\n" + "".join(f"{at},{who},1,2,0\n" for at in range(3) for who in ids))
    labels = read_labels(path)
    is_said = any("tracks are numbered from 1 on as they come" in remark for remark in labels.remarks)
    assert is_said == ([str(number) for number in labels.id.tolist()] != [who.removesuffix(".0") for who in ids] * 3)
