"""Results as ROS 2 bags: other readers find the same ids, positions and times."""

from __future__ import annotations

import tempfile
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from rosbags.highlevel import AnyReader

import mcaptrack
from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.foxglove import class_colour
from mcaptrack.schema import DETECTIONS, PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import Provenance
from tests.logs import add_rows
from tests.worlds import boxed, boxes_at, ns, tracks_at

NAMES = {"1": "pedestrian", "3": "car"}
T0 = 1_700_000_000_123_456_789
FORMS = ("rosbag2", "rosbag2-sqlite3")


def stamp_of(header: Any) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def read(folder: Path) -> dict[str, list[tuple[int, Any]]]:
    """The messages of a bag by topic, decoded by rosbags with the definitions in the bag."""
    out: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([folder]) as reader:
        for connection in reader.connections:
            out[connection.topic] = []
        for connection, t_ns, raw in reader.messages():
            out[connection.topic].append((t_ns, reader.deserialize(raw, connection.msgtype)))
    return out


def written(path: Path, channels: dict[str, tuple[Any, list[Frame]]], frame_id: str = "map", source: str = "") -> Path:
    with log.create(path) as writer:
        for topic, (schema, frames) in channels.items():
            made = Provenance("track", {}, source, classes=NAMES, frame_id=frame_id)
            add_rows(writer, topic, schema, frames, made=made)
    return path


def bodies(rows: list[tuple[float, ...]]) -> Any:
    """Rows of tracks: id, class, x, y, z, length, width, height, heading, score."""
    names = ("track_id", "class_id", "x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad", "score")
    columns = dict(zip(names, np.array(rows, float).reshape(-1, len(names)).T, strict=True))
    whole = {name: columns[name].astype(kind) for name, kind in (("track_id", np.int64), ("class_id", np.uint32))}
    return TRACKS.rows(**columns | whole, observed=np.ones(len(rows), bool), source_id=np.full(len(rows), -1))


CAR, WALKER = (
    (7, 3, 5214.25, 2393.5, 69.5, 4.5, 1.75, 1.5, 0.5, 0.75),
    (12, 1, 1.0, -2.0, 1.0, 0.5, 0.75, 2.0, -3.0, 0.5),
)
DRIVE = [Frame(T0 + ns(n / 10), n, bodies([CAR, WALKER] if n % 3 else [CAR])) for n in range(6)]

far = st.floats(-1e6, 1e6)
sizes = st.floats(0.01, 50)
row = st.tuples(
    st.integers(0, 2**40), st.sampled_from([0, 1, 3, 9]), far, far, far, sizes, sizes, sizes, st.floats(-3, 3), st.floats(0, 1)
)  # fmt: skip
drives = st.lists(
    st.tuples(st.integers(0, 2**31 * 10**9 - 1), st.lists(row, max_size=4, unique_by=lambda one: one[0])),
    max_size=4,
    unique_by=lambda one: one[0],
)


@settings(max_examples=8, deadline=None, phases=[Phase.explicit, Phase.generate])
@given(drives, st.sampled_from(FORMS), st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=8))
def test_a_bag_holds_the_same_ids_positions_and_times(drive, form, frame_id):
    frames = [Frame(t_ns, n, bodies(rows)) for n, (t_ns, rows) in enumerate(sorted(drive, key=lambda one: one[0]))]
    with tempfile.TemporaryDirectory() as folder:
        path = written(Path(folder, "a.mcap"), {"/lidar/tracks": (TRACKS, frames)}, frame_id)
        mcaptrack.export(path, Path(folder, "bag"), form=form)
        found = read(Path(folder, "bag"))["/lidar/tracks"]
    assert [t_ns for t_ns, _ in found] == [frame.t_ns for frame in frames]
    for (t_ns, message), frame in zip(found, frames, strict=True):
        assert type(message).__name__ == "vision_msgs__msg__Detection3DArray"
        for header in (message.header, *(one.header for one in message.detections)):
            assert (stamp_of(header), header.frame_id) == (t_ns, frame_id or "lidar/ground")
        rows = []
        for one in message.detections:
            (guess,), at, size, turn = one.results, one.bbox.center.position, one.bbox.size, one.bbox.center.orientation
            assert guess.pose.pose == one.bbox.center
            assert (turn.x, turn.y) == (0, 0)
            number = {"pedestrian": 1, "car": 3}.get(guess.hypothesis.class_id) or int(guess.hypothesis.class_id)
            extent = (size.x, size.y, size.z)
            heading = 2 * np.arctan2(turn.z, turn.w)
            rows.append((int(one.id), number, at.x, at.y, at.z, *extent, heading, guess.hypothesis.score))
        back = bodies(rows)
        for name in ("track_id", "class_id", "x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "score"):
            np.testing.assert_array_equal(back[name], frame.rows[name])
        assert back["heading_rad"] == pytest.approx(frame.rows["heading_rad"], abs=1e-12)


def test_markers_replace_one_another_and_have_the_colours_of_classes(tmp_path):
    mcaptrack.export(written(tmp_path / "a.mcap", {"/lidar/tracks": (TRACKS, DRIVE)}), tmp_path / "bag", form="rosbag2")
    for t_ns, message in read(tmp_path / "bag")["/lidar/tracks/markers"]:
        first, *markers = message.markers
        assert first.action == 3  # DELETEALL
        assert {(stamp_of(one.header), one.header.frame_id, one.action) for one in markers} == {(t_ns, "map", 0)}
        cubes = {one.id: one for one in markers if one.type == 1}
        texts = {one.id: one for one in markers if one.type == 9}
        cube, text = cubes[7], texts[7]
        assert set(cubes) == set(texts) <= {7, 12}
        assert (cube.pose.position.x, cube.pose.position.y, cube.pose.position.z) == CAR[2:5]
        assert (cube.scale.x, cube.scale.y, cube.scale.z) == CAR[5:8]
        assert 2 * np.arctan2(cube.pose.orientation.z, cube.pose.orientation.w) == pytest.approx(CAR[8])
        assert (cube.color.r, cube.color.g, cube.color.b) == pytest.approx(class_colour(3, "car"), abs=1e-6)
        assert text.text == "7"
        assert text.pose.position.z > CAR[4] + CAR[7] / 2
        assert {(one.ns, one.id) for one in markers} == {(space, n) for space in ("boxes", "ids") for n in cubes}


def forecast(t_ns: int, index: int) -> Frame:
    names = ("track_id", "step", "ahead_s", "x_m", "y_m")
    rows = [(who, step, 0.4 * step, who + step, float(index)) for step in (1, 2, 3) for who in (12, 7)]
    return Frame(t_ns, index, PREDICTIONS.rows(**dict(zip(names, zip(*rows, strict=True), strict=True))))


def test_predictions_become_paths_at_the_bottom_of_the_boxes(tmp_path):
    futures = [forecast(frame.t_ns, frame.index) for frame in DRIVE[::2]]
    nothing = Frame(T0 + ns(9), 9, PREDICTIONS.empty())
    channels = {"/lidar/tracks": (TRACKS, DRIVE), "/lidar/predictions": (PREDICTIONS, [*futures, nothing])}
    path = written(tmp_path / "a.mcap", channels, source="/lidar/tracks")
    mcaptrack.export(path, tmp_path / "bag", form="rosbag2")
    found = read(tmp_path / "bag")
    paths = found["/lidar/predictions"]
    assert [t_ns for t_ns, _ in paths] == [frame.t_ns for frame in futures for _ in range(2)]
    up = {7: CAR[4] - CAR[7] / 2, 12: WALKER[4] - WALKER[7] / 2}
    for number, (t_ns, message) in enumerate(paths):
        who, index = (7, 12)[number % 2], futures[number // 2].index
        assert (stamp_of(message.header), message.header.frame_id) == (t_ns, "map")
        places = [(p.pose.position.x, p.pose.position.y, p.pose.position.z) for p in message.poses]
        assert places == [(who + step, index, up[who]) for step in (1, 2, 3)]
        assert [stamp_of(p.header) - t_ns for p in message.poses] == [ns(0.4), ns(0.8), ns(1.2)]
    (*drawn, (last_ns, last)) = found["/lidar/predictions/markers"]
    assert (last_ns, [one.action for one in last.markers]) == (nothing.t_ns, [3])  # what was drawn before goes
    for (t_ns, message), frame in zip(drawn, futures, strict=True):
        lines = {one.id: [(p.x, p.y, p.z) for p in one.points] for one in message.markers[1:]}
        assert t_ns == frame.t_ns
        assert lines == {who: [(who + step, frame.index, up[who]) for step in (1, 2, 3)] for who in (7, 12)}


def test_boxes_in_pixels_become_detections_in_2d(tmp_path):
    tracks = [Frame(T0, 0, boxed({5: (10.0, 20.0)})), Frame(T0 + 1, 1, tracks_at({6: (1.0, 2.0)}))]
    detections = [Frame(T0, 0, boxes_at([(50, 60)]))]
    path = tmp_path / "a.mcap"
    with log.create(path) as writer:
        for topic, schema, frames in (("/c/tracks", TRACKS, tracks), ("/c/detections", DETECTIONS, detections)):
            add_rows(writer, topic, schema, frames, made=Provenance("ingest", {}))
    result = mcaptrack.export(path, tmp_path / "bag", form="rosbag2-sqlite3")
    assert [one.message for one in result.warnings] == ["/c/tracks: 1 rows without a box in pixels are not in the bag"]
    found = read(tmp_path / "bag")
    (_, first), (_, second) = found["/c/tracks"]
    (box,) = first.detections
    assert box.id == "5"
    assert (box.bbox.center.position.x, box.bbox.center.position.y) == (15, 30)
    assert (box.bbox.size_x, box.bbox.size_y) == (10, 20)
    assert second.detections == []
    ((_, boxes),) = found["/c/detections"]
    assert [(one.id, one.results[0].hypothesis.class_id) for one in boxes.detections] == [("", "person")]
    people = [[one.type for one in message.markers[1:]] for _, message in found["/c/tracks/markers"]]
    assert people == [[], [3, 9]]  # a cylinder and its number
    assert found["/c/tracks/markers"][1][1].markers[1].header.frame_id == "c/ground"


@pytest.mark.parametrize("robots", [("",), ("/a", "/b")], ids=["one robot", "two, with frames of the same names"])
def test_transforms_are_in_the_bag(tmp_path, robots):
    path, wanted = written(tmp_path / "a.mcap", {"/lidar/tracks": (TRACKS, DRIVE)}), {}
    steps = {"tf": ("map", "base_link", 3), "tf_static": ("base_link", "lidar", 1)}
    with log.read(path) as opened, log.extend(opened, None) as writer:
        moved = foxglove.message_class(foxglove.TRANSFORM)
        for (x, robot), (name, (parent, child, count)) in product(enumerate(robots), steps.items()):
            topic = f"{robot}/{name}"
            number = writer.add_channel(topic, foxglove.schema_record(foxglove.TRANSFORM), "protobuf", {})
            wanted[topic] = [(parent, child, 10.0 * x + n) for n in range(count)]
            for n, (*_, place) in enumerate(wanted[topic]):
                one = moved(parent_frame_id=parent, child_frame_id=child)
                one.timestamp.FromNanoseconds(T0 + ns(n))
                one.translation.x, one.rotation.w = place, 1.0
                writer.add_message(number, T0 + ns(n), n, one.SerializeToString())
    result = mcaptrack.export(path, tmp_path / "bag", form="rosbag2")
    tf = {topic: [message.transforms[0] for _, message in read(tmp_path / "bag")[topic]] for topic in wanted}
    written_to = {
        topic: [(one.header.frame_id, one.child_frame_id, one.transform.translation.x) for one in transforms]
        for topic, transforms in tf.items()
    }
    assert written_to == wanted
    assert {topic for topic in result.rows if "tf" in topic} == {*wanted}


class TestFolders:
    @pytest.fixture
    def path(self, tmp_path):
        return written(tmp_path / "a.mcap", {"/lidar/tracks": (TRACKS, DRIVE)})

    def test_a_bag_is_replaced_on_request_only_and_nothing_else_is(self, path, tmp_path):
        mcaptrack.export(path, tmp_path / "bag", form="rosbag2")
        with pytest.raises(McaptrackError, match="force=True"):
            mcaptrack.export(path, tmp_path / "bag", form="rosbag2")
        mcaptrack.export(path, tmp_path / "bag", form="rosbag2-sqlite3", force=True)
        assert sorted(one.name for one in (tmp_path / "bag").iterdir()) == ["bag.db3", "metadata.yaml"]
        (tmp_path / "mine").mkdir()
        (tmp_path / "mine" / "notes.txt").write_text("keep")
        for force in (False, True):
            with pytest.raises(McaptrackError, match=r"only folders with metadata\.yaml are replaced"):
                mcaptrack.export(path, tmp_path / "mine", form="rosbag2", force=force)
        assert (tmp_path / "mine" / "notes.txt").read_text() == "keep"

    def test_what_can_not_be_written_is_one_line_and_leaves_nothing(self, tmp_path):
        empty = written(tmp_path / "empty.mcap", {})
        early = written(tmp_path / "early.mcap", {"/t": (TRACKS, [Frame(2**31 * 10**9, 0, bodies([CAR]))])})
        for path, words in ((empty, "no detections, tracks or predictions"), (early, "1970 to 2038")):
            with pytest.raises(McaptrackError, match=words):
                mcaptrack.export(path, tmp_path / "bag", form="rosbag2")
        assert sorted(one.name for one in tmp_path.iterdir()) == ["early.mcap", "empty.mcap"]
