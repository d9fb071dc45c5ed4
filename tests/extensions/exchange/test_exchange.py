"""Boxes as files of other programs: what is written is read again, and what they write is read; expected by hand."""

from __future__ import annotations

import json
import sys
import zipfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import mcaptrack
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.exchange.cvat import KEYFRAME_PX, CvatFile
from mcaptrack.extensions.exchange.gathered import GatheredRows, frame_numbers
from mcaptrack.extensions.exchange.kitti import KittiFile
from mcaptrack.registry import find
from mcaptrack.sources.box_files import BoxFile, ExportedBoxes, MotFile
from mcaptrack.sources.ingest.labels.of_packages import format_named
from mcaptrack.sources.ingest.labels.reading import read_labels
from mcaptrack.sources.ingest.labels.roles import WantedClasses
from mcaptrack.sources.ingest.labels.table import LabelFacts
from mcaptrack.sources.ingest.labels.text import FrameNames
from mcaptrack.testing import check_exporter

ALL = WantedClasses("all")
NAMES = {1: "person", 2: "bicycle", 3: "traffic light", 7: 'a "b" <c> & d'}
#: The example of CVAT's documentation of its XML format, for videos, without what says nothing about boxes.
CVAT_EXAMPLE = """<?xml version="1.0" encoding="utf-8"?>
<annotations>
  <version>1.0</version>
  <meta>
    <task>
      <id>1062</id>
      <name>My interpolation task</name>
      <size>30084</size>
      <mode>interpolation</mode>
      <overlap>20</overlap>
      <bugtracker></bugtracker>
      <labels><label><name>car</name><attributes><attribute>@select=model:1,2,3,4</attribute></attributes></label></labels>
      <segments><segment><id>3085</id><start>0</start><stop>30083</stop></segment></segments>
      <owner><username>admin</username><email></email></owner>
    </task>
    <dumped>2018-06-06 15:52:11.138470+03:00</dumped>
  </meta>
  <track id="0" label="car">
    <box frame="110" xtl="634.12" ytl="37.68" xbr="661.50" ybr="71.37" outside="0" occluded="1" keyframe="1">
      <attribute name="model">1</attribute>
    </box>
    <box frame="111" xtl="634.21" ytl="38.50" xbr="661.59" ybr="72.19" outside="0" occluded="1" keyframe="0">
      <attribute name="model">1</attribute>
    </box>
    <box frame="112" xtl="634.30" ytl="39.32" xbr="661.67" ybr="73.01" outside="1" occluded="1" keyframe="1">
      <attribute name="model">1</attribute>
    </box>
  </track>
  <track id="1" label="car">
    <box frame="0" xtl="626.81" ytl="30.96" xbr="656.05" ybr="58.88" outside="0" occluded="0" keyframe="1">
      <attribute name="model">3</attribute>
    </box>
    <box frame="1" xtl="626.63" ytl="31.56" xbr="655.87" ybr="59.48" outside="0" occluded="0" keyframe="0">
      <attribute name="model">3</attribute>
    </box>
    <box frame="2" xtl="626.09" ytl="33.38" xbr="655.33" ybr="61.29" outside="1" occluded="0" keyframe="1">
      <attribute name="model">3</attribute>
    </box>
  </track>
</annotations>
"""

_FORMATS = {name: find("exporter", name).cls() for name in ("mot", "kitti", "coco", "cvat", "boxes-csv")}


def box(frame: int, left: float, outside: int = 0, more: str = "", inner: str = "") -> str:
    corners = f'xtl="{left}" ytl="10" xbr="{left + 10}" ybr="30"'
    return f'<box frame="{frame}" {corners} outside="{outside}" keyframe="1" {more}>{inner}</box>'


def track(number: int, *boxes: str) -> str:
    return f'<track id="{number}" label="person">{"".join(boxes)}</track>'


ONE = f"<annotations>{track(0, box(0, 1))}</annotations>"


def read(tmp_path: Path, text: str | bytes, name: str = "a.xml", role: str = "tracks", wanted=ALL):
    path = tmp_path / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_labels(path, "auto", role, wanted=wanted)


@st.composite
def tables(draw, has_ids: bool = True) -> ExportedBoxes:
    """Rows of tracks: each id once a frame, and one class a track."""
    last = draw(st.integers(0, 12))
    frames = np.arange(last + 1)
    ids = draw(st.lists(st.integers(0, 2**40), min_size=1, max_size=4, unique=True))
    class_of = {one: draw(st.sampled_from([1, 1, 2, 3, 7])) for one in ids}
    pairs = [(frame, one) for frame in range(last + 1) for one in sorted(ids)]
    kept = sorted(draw(st.sets(st.sampled_from(pairs), min_size=1)))
    places = st.floats(-500, 5000, allow_nan=False, width=64)
    sizes = st.floats(0, 800, allow_nan=False, width=64)
    boxes = np.array([[draw(places), draw(places), draw(sizes), draw(sizes)] for _ in kept]) + 3.25
    boxes[:, 2:] = np.abs(boxes[:, 2:])
    scores = [draw(st.floats(0, 1, width=32)) for _ in kept]
    return ExportedBoxes(
        "/camera/tracks",
        frames,
        frames * 40_000_000,
        np.array([frame for frame, _ in kept]),
        np.array([one if has_ids else -1 for _, one in kept]),
        boxes,
        np.full((len(kept), 2), np.nan),
        np.array(scores, np.float32),
        np.array([class_of[one] for _, one in kept]),
        np.array([draw(st.booleans()) for _ in kept]),
        NAMES,
        has_ids,
        False,
        (1920, 1080),
        (),
    )


@pytest.mark.parametrize("form", _FORMATS)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(table=tables())
def test_what_is_written_is_read_again(form, table, tmp_path):
    labels = read(tmp_path, b"".join(_FORMATS[form].content(table)), f"a.{form}")
    first = labels.first_frame if form != "mot" else 1
    order = np.lexsort((table.id, table.frame))
    assert (labels.frame - first).tolist() == table.frame[order].tolist()
    assert labels.id.tolist() == table.id[order].tolist()
    np.testing.assert_allclose(labels.boxes_px, table.boxes[order], rtol=0, atol=1e-9)
    if "scores" in _FORMATS[form].holds:
        assert labels.score.astype(np.float32).tolist() == table.score[order].tolist()
    if form != "mot":
        names = [labels.classes[one] for one in labels.class_id.tolist()]
        in_kitti = {1: "Pedestrian", 2: "bicycle", 3: "traffic_light", 7: "a_b_c_d"}
        assert names == [(in_kitti if form == "kitti" else NAMES)[one] for one in table.class_id[order].tolist()]
    if form in ("coco", "cvat"):
        assert labels.observed.tolist() == table.observed[order].tolist()


@pytest.mark.parametrize("form", _FORMATS)
@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(table=tables(has_ids=False))
def test_detections_are_read_again_without_ids(form, table, tmp_path):
    if form == "cvat":  # whose boxes of videos are tracks, of one frame each
        labels = read(tmp_path, b"".join(_FORMATS[form].content(table)), "a.xml")
        assert len(np.unique(labels.id)) == len(table.frame)
        return
    labels = read(tmp_path, b"".join(_FORMATS[form].content(table)), f"a.{form}", "detections")
    assert not labels.has_ids
    assert sorted(map(tuple, labels.boxes_px.round(6))) == sorted(map(tuple, table.boxes.round(6)))


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(table=tables())
def test_cvat_interpolates_what_is_no_keyframe(table, tmp_path):
    """CVAT keeps keyframes alone, and interpolates: no corner is farther than ``KEYFRAME_PX`` from where it was."""
    lines = b"".join(_FORMATS["cvat"].content(table)).decode().splitlines()
    sparse = "\n".join(line for line in lines if 'keyframe="0"' not in line)
    labels = read(tmp_path, sparse)
    order = np.lexsort((table.id, table.frame))
    assert labels.id.tolist() == table.id[order].tolist()
    corners = [np.hstack([b[:, :2], b[:, :2] + b[:, 2:]]) for b in (labels.boxes_px, table.boxes[order])]
    np.testing.assert_allclose(*corners, rtol=0, atol=KEYFRAME_PX + 1e-9)


def test_a_straight_walk_needs_few_keyframes(tmp_path):
    """A walk on a line, 2 px off in one picture, and hidden in five."""
    count = 50
    frames = np.arange(count)
    boxes = np.stack([frames * 3.0, frames * 0.5, np.full(count, 20.0), np.full(count, 50.0)], axis=-1)
    boxes[20, 0] += 2
    observed = (frames < 30) | (frames >= 35)
    table = ExportedBoxes(
        "/t", frames, frames, frames, np.full(count, 4), boxes, boxes[:, :2], np.full(count, np.nan, np.float32),
        np.ones(count, int), observed, {}, True, False, None, (),
    )  # fmt: skip
    text = b"".join(_FORMATS["cvat"].content(table)).decode()
    assert text.count("<box ") == count
    lines = text.splitlines()
    keys = [line.split('"')[1] for line in lines if 'keyframe="1"' in line]
    assert keys == ["0", "19", "20", "21", "30", "35", "49"]
    labels = read(tmp_path, "\n".join(line for line in lines if 'keyframe="0"' not in line))
    assert labels.observed.tolist() == observed.tolist()
    np.testing.assert_allclose(labels.boxes_px, boxes, atol=KEYFRAME_PX)


class TestCvat:
    def test_the_example_of_its_documentation(self, tmp_path):
        labels = read(tmp_path, CVAT_EXAMPLE)
        assert (labels.format, labels.frame.tolist(), labels.id.tolist()) == ("cvat", [0, 1, 110, 111], [1, 1, 0, 0])
        np.testing.assert_allclose(labels.boxes_px[2], [634.12, 37.68, 27.38, 33.69])
        assert labels.classes == {2: "car"}
        assert labels.observed.tolist() == [True, True, False, False]
        assert (labels.labelled[0], labels.labelled[-1]) == (0, 30083)

    def test_a_zip_file_of_cvat(self, tmp_path):
        with zipfile.ZipFile(tmp_path / "task.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("images/frame_000000.png", b"\0")
            archive.writestr("annotations.xml", CVAT_EXAMPLE.replace("30084", "200"))
        result = mcaptrack.ingest(tmp_path / "task.zip", tmp_path / "b.mcap", fps=10, classes="car")
        assert result.messages == {"/camera/tracks": 200}

    def test_annotations_of_images_are_detections(self, tmp_path):
        text = (
            '<annotations><version>1.1</version><image id="0" name="a.jpg" width="600" height="400"/>'
            '<image id="2" name="c.jpg" width="600" height="400"><box label="person" occluded="0" xtl="1" ytl="2" '
            'xbr="4" ybr="8"></box><polygon label="car" points="1,2;3,4"/><tag label="good"/></image></annotations>'
        )
        labels = read(tmp_path, text, role="detections")
        assert (labels.frame.tolist(), labels.boxes_px.tolist(), labels.has_ids) == ([2], [[1, 2, 3, 6]], False)
        assert labels.labelled.tolist() == [0, 2]
        assert [code for _, code in labels.doubts if "1 of <polygon>, 1 of <tag>" in _] == ["left-out"]

    BOMB = '<!DOCTYPE a [<!ENTITY b "bbbb"><!ENTITY c "&b;&b;">]><annotations>&c;</annotations>'
    OUTER = '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><annotations>&x;</annotations>'

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            (BOMB, ":1: a document type, which CVAT doesn't write"),
            (OUTER, ":1: a document type"),
            ("<labels><object/></labels>", ":1: XML that begins with <labels>"),
            ("<annotations>\n<track>", ":2: not valid XML: no element found"),
            ("<annotations></annotations>", " holds no boxes"),
            ('<annotations><image id="0"><points label="a" points="1,2"/></image></annotations>', "only 1 of <points>"),
            ('<annotations><track><box frame="1" xtl="1"/></track></annotations>', "a box without 'ytl'"),
            (ONE.replace('"30"', '"z"'), "corners that aren't numbers"),
            (ONE.replace('"30"', '"nan"'), "not finite"),
            (ONE.replace('"30"', '"3"'), "can't be 10 wide and -7 high"),
            (f'<?xml version="1.0" encoding="foo"?>{ONE}', "unknown encoding: foo"),
            ('<annotations><image id="4"/><image id="4"/></annotations>', "image 4 is there before"),
        ],
    )  # fmt: skip
    def test_what_it_would_not_write_is_refused_in_one_line(self, text, words, tmp_path):
        with pytest.raises(McaptrackError) as error:
            read(tmp_path, text)
        assert words in str(error.value)
        assert "\n" not in str(error.value)

    def test_a_zip_file_that_is_damaged_is_refused(self, tmp_path):
        path = tmp_path / "a.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("annotations.xml", CVAT_EXAMPLE * 3)
        data = bytearray(path.read_bytes())
        data[60:80] = bytes(20)
        path.write_bytes(data)
        with pytest.raises(McaptrackError, match=r"zip file with an annotations.xml that can't be read"):
            read_labels(path, "cvat", "tracks")

    @pytest.mark.parametrize(
        ("names", "words"),
        [
            (["task/annotations.xml", "images/a.png"], None),
            (["../../annotations.xml"], None),  # it is read, not extracted
            (["a/annotations.xml", "b/annotations.xml"], "holds 2 of annotations.xml; give each as a file"),
            (["instances.json"], "without the annotations.xml of CVAT: it holds instances.json; unpack other"),
            ([], "without the annotations.xml of CVAT: it is empty"),
        ],
    )
    def test_zip_files_as_others_make_them(self, names, words, tmp_path):
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
            for name in names:
                archive.writestr(name, ONE)
        if words is None:
            assert read_labels(tmp_path / "a.zip").frame.tolist() == [0]
            return
        with pytest.raises(McaptrackError) as error:
            read_labels(tmp_path / "a.zip")
        assert words in str(error.value)


def test_coco_of_polygons_and_of_numbers_with_a_point(tmp_path):
    """The box around polygons, where there is no bbox; a mask that can't be read is refused; 1.0 is 1, as pandas writes it."""
    images = [{"id": 1, "file_name": "0.jpg"}, {"id": 2, "file_name": "1.jpg"}]
    shape = {"image_id": 2.0, "category_id": 1.0, "segmentation": [[5, 7, 9, 7, 9, 20], [4, 8, 5, 8, 5, 9]]}
    content = {"images": images, "annotations": [shape], "categories": [{"id": 1, "name": "person"}]}
    labels = read(tmp_path, json.dumps(content), "a.json", role="detections")
    assert (labels.frame.tolist(), labels.boxes_px.tolist()) == ([1], [[4, 7, 5, 13]])
    assert any("1 boxes are those around polygons" in words for words in labels.remarks)
    shape["segmentation"] = {"counts": "abc", "size": [80, 100]}
    with pytest.raises(McaptrackError, match="annotation 0 has no bbox, and a mask that can't be read"):
        read(tmp_path, json.dumps(content), "a.json")


def remarks(form: BoxFile, names: dict[int, str], kinds: list[int], ids: list[int]) -> list[str]:
    """What a format says of boxes of these classes and tracks."""
    row, ones = np.arange(len(kinds)), np.ones((len(kinds), 4))
    table = ExportedBoxes(
        "/t", row, row, row, np.array(ids), ones, ones[:, :2], ones[:, 0].astype(np.float32), np.array(kinds),
        np.ones(len(kinds), bool), names, True, False, None, (),
    )  # fmt: skip
    return [remark for remark in form.remarks(table) if remark]


def test_classes_that_a_file_cannot_tell_apart_are_said():
    lights = {1: "person", 2: "traffic light", 3: "traffic-light", 4: "car"}
    assert remarks(KittiFile(), lights, [1, 2, 3, 4], [1, 2, 3, 4]) == [
        "classes that the file can't tell apart: traffic light and traffic-light are both traffic_light"
    ]
    (said,) = remarks(MotFile(), {1: "person", 2: "pedestrian", 3: "car"}, [1, 2, 3], [1, 2, 3])
    assert "person and pedestrian are both 1" in said
    assert remarks(KittiFile(), NAMES, [*NAMES], [*NAMES]) == []
    assert not any("tell apart" in said for said in remarks(MotFile(), NAMES, [*NAMES], [*NAMES]))
    (said,) = remarks(CvatFile(), {}, [3, 2, 3, 2], [1, 1, 1, 2])
    assert "1 boxes get that of their track" in said


class TestCommand:
    @pytest.mark.parametrize("form", _FORMATS)
    def test_a_channel_goes_out_and_comes_back(self, form, template):
        label_format = format_named("csv" if form == "boxes-csv" else form)
        check_exporter(_FORMATS[form], template, label_format, "/camera/retracks/full")

    def test_a_recording_of_rerun_needs_its_library(self, template, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "rerun", None)
        with pytest.raises(McaptrackError, match=r"pip install 'mcaptrack\[rerun\]'"):
            mcaptrack.export(template, tmp_path / "a.rrd", form="rerun")
        assert not list(tmp_path.iterdir())

    def test_frames_and_sizes_of_coco_are_those_of_the_pictures(self, template, tmp_path):
        mcaptrack.export(template, tmp_path / "a.json", form="coco", topic="/camera/truth")
        content = json.loads((tmp_path / "a.json").read_text())
        assert [image["frame_id"] for image in content["images"]] == list(range(30))
        assert {(image["width"], image["height"]) for image in content["images"]} == {(64, 48)}
        assert all(b["timestamp_ns"] > a["timestamp_ns"] for a, b in pairwise(content["images"]))
        assert {one["track_id"] for one in content["annotations"]} == {1, 2}
        assert [one["name"] for one in content["categories"]] == ["person"]

    @pytest.mark.parametrize(
        ("given", "words"),
        [
            ({"topic": "/camera/video"}, "/camera/video has no detections and no tracks"),
            ({"topic": "/nothing"}, "/nothing"),
            ({"topic": ["/camera/tracks", "/camera/truth"]}, "writes one channel, not /camera/tracks, /camera/truth"),
            ({"output": "there"}, "is a folder"),
        ],
    )
    def test_mistakes_are_refused(self, given, words, template, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "there").mkdir()
        with pytest.raises(McaptrackError, match=words):
            mcaptrack.export(template, **{"output": "x.txt", "form": "mot", **given})
        assert [path.name for path in tmp_path.iterdir()] == ["there"]

    def test_what_a_format_has_no_place_for_is_said_once(self, template, tmp_path):
        said = [one.message for one in mcaptrack.export(template, tmp_path / "a.xml", form="cvat").warnings]
        assert len(said) == 1
        assert "CVAT has no place for positions in metres" in said[0]
        assert not mcaptrack.export(template, tmp_path / "a.csv", form="boxes-csv").warnings


def test_mot15_is_read_as_it_is(data):
    path = data / "mot15" / "ETH-Sunnyday" / "gt" / "gt.txt"
    labels = read_labels(path, "mot", "truth")
    lines = [line.split(",") for line in path.read_text().splitlines()]
    assert len(labels.frame) == sum(float(line[6]) != 0 for line in lines)
    boxes = np.array([[float(one) for one in line[2:6]] for line in lines if float(line[6])])
    rows = sorted(map(tuple, boxes)), sorted(map(tuple, labels.boxes_px))
    assert rows[0] == rows[1]


# The numbers of frames by names of pictures.


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
    for text in ("", "one", "nan", "1_0", "1,5", "0x1", "\N{ARABIC-INDIC DIGIT THREE}", True, [1]):
        with pytest.raises(McaptrackError, match=r"a\.json: label 7 has no box of 2 numbers \(x, y\)"):
            rows.numbers("7", {"x": 1, "y": text}, "xy")
