"""Commands on logs with boxes in space: which tracker, which frame, which channel, and what is said."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from scipy.spatial.transform import Rotation

import mcaptrack
from mcaptrack import McaptrackError, log
from mcaptrack.evaluation import sequence_of_log
from mcaptrack.evaluation.forecasts import score_forecasts
from mcaptrack.foxglove import class_colour
from mcaptrack.pipeline import summary
from mcaptrack.schema import DETECTIONS, EVENTS, PREDICTIONS, TRACKS, EventKind, Frame, Schema
from mcaptrack.sources import fixed_frame
from mcaptrack.sources.cameras import cameras
from mcaptrack.transforms import STAGES
from mcaptrack.transforms.sort import Sort
from tests.commands import done
from tests.logs import provenance_of
from tests.robot_runs import OBJECTS, place, write_passing
from tests.space_logs import (
    LATE_NS,
    NAMES,
    START_NS,
    WAYS,
    Robot,
    Seen,
    by_foxglove,
    by_ros,
    detection_3d_array,
    marker_array,
    scene_update,
    write,
)
from tests.tiers import thorough


@dataclass(frozen=True, kw_only=True)
class ById:
    """A tracker in metres that takes the ids of the detector."""

    space: ClassVar[str] = "ground"
    reads: ClassVar[Schema] = DETECTIONS
    writes: ClassVar[Mapping[str, Schema]] = {"": TRACKS}
    latency_s: ClassVar[Mapping[str, float]] = {"": 0.0}

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        for frame in frames:
            names = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad", "score", "class_id")
            columns = {name: frame.rows[name] for name in names}
            rows = TRACKS.rows(
                track_id=frame.rows["source_id"],
                observed=np.ones(len(frame.rows), bool),
                source_id=frame.rows["source_id"],
                **columns,
            )
            yield (frame._replace(rows=rows),)


@dataclass(frozen=True, kw_only=True)
class Renumbered(ById):
    """The same, where the detector numbers its boxes otherwise in each message."""

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        for number, (frame,) in enumerate(super().__call__(frames)):
            rows = frame.rows.copy()
            rows["source_id"] = (rows["source_id"] + number // 4) % 7
            yield (frame._replace(rows=rows),)


def said(result) -> list[str]:
    return [notice.message for notice in result.warnings]


def tracked(path: Path) -> tuple[np.ndarray, dict[str, str]]:
    with log.read(path) as opened:
        rows = opened.rows("/lidar/tracks", TRACKS)
        return rows.rows, opened.channel("/lidar/tracks").metadata


def test_tracks_are_in_the_root_of_the_frames_and_the_same_in_every_form(tmp_path):
    wanted = Robot(shots=3).wanted()
    found = []
    for way in ("detections since humble", "markers", "scene updates", "json"):
        path = write(tmp_path / "a.mcap", Robot(shots=3), WAYS[way], "ros" if way[0] in "dm" else "protobuf")
        result = mcaptrack.track(path, topic="/lidar/boxes", tracker=ById(), sidecar=False)
        assert result.channels == ("/lidar/tracks",)
        rows, metadata = tracked(path)
        assert metadata["mcaptrack.frame_id"] == "map"
        assert metadata["mcaptrack.input"] == "/lidar/boxes"
        found.append(rows)
    for name in ("x_m", "y_m", "z_m", "heading_rad", "length_m"):
        for rows in found:
            np.testing.assert_allclose(rows[name], [row[name] for row in wanted], atol=1e-6)


def test_ids_of_a_detector_are_no_tracks_that_were_repaired(tmp_path):
    """The ids follow the order in each message, as where a detector numbers its boxes: tracks join none of them."""
    path = write(tmp_path / "a.mcap", Robot(shots=30), WAYS["scene updates"], "protobuf")
    mcaptrack.track(path, topic="/lidar/boxes", tracker=Renumbered(), sidecar=False)
    mcaptrack.events(path, topic="/lidar/tracks")
    with log.read(path) as opened:
        kinds = set(opened.rows("/lidar/tracks/events", EVENTS).rows["kind"].tolist())
        rows = opened.rows("/lidar/tracks", TRACKS).rows
    assert len(np.unique(rows[rows["track_id"] == rows["track_id"][0]]["source_id"])) > 1
    assert kinds == {EventKind.BIRTH}


def test_a_tracker_of_pictures_is_refused_in_one_line_and_one_of_metres_on_pictures(tmp_path, finished):
    path = write(tmp_path / "a.mcap", Robot(shots=2), WAYS["markers"])
    with pytest.raises(
        McaptrackError,
        match="/lidar/boxes has positions in metres, and the tracker sort takes boxes in pixels; `tracker='ground'` takes",
    ):
        mcaptrack.track(path, topic="/lidar/boxes", tracker=Sort())
    with pytest.raises(
        McaptrackError,
        match=r"/camera/detections has boxes in pixels, and the tracker .*ById takes positions in metres",
    ):
        mcaptrack.track(finished, tracker=ById(), output=tmp_path / "b.mcap")


def test_another_frame_makes_tracks_again_and_the_same_stays(tmp_path):
    path = write(tmp_path / "a.mcap", Robot(shots=6), WAYS["scene updates"], "protobuf")
    run = {"tracker": ById(), "tables": False, "events": False, "sidecar": False}
    mcaptrack.run(path, topic="/lidar/boxes", **run)
    assert tracked(path)[1]["mcaptrack.frame_id"] == "map"
    assert mcaptrack.run(path, **run).stages == ()
    assert "track" in mcaptrack.run(path, frame="base_link", **run).stages
    rows, metadata = tracked(path)
    assert metadata["mcaptrack.frame_id"] == "base_link"
    assert np.abs(rows["x_m"]).max() < 100  # the map is at x = 5000 m
    assert mcaptrack.run(path, **run).stages == ()  # as before
    assert mcaptrack.export(path, output=tmp_path / "tables", force=True) is not None
    with pytest.raises(
        McaptrackError, match="there is no frame moon for the boxes of /lidar/boxes; there are base_link, lidar, map"
    ):
        mcaptrack.run(path, frame="moon", **run)


def test_a_log_with_boxes_in_space_alone_needs_no_topic_and_one_with_several_says_which(tmp_path):
    path = write(tmp_path / "a.mcap", Robot(shots=2), WAYS["markers"])
    assert mcaptrack.track(path, tracker=ById(), sidecar=False).channels == ("/lidar/tracks",)

    def both(writer):
        first, second = (
            WAYS["markers"](writer),
            by_foxglove(lambda t, boxes: scene_update(t, boxes).SerializeToString())(Renamed(writer)),
        )
        return lambda number, shot: (first(number, shot), second(number, shot))

    path = write(tmp_path / "b.mcap", Robot(shots=2), both)
    with log.read(path) as opened:
        assert [(camera.prefix, camera.boxes, camera.pictures) for camera in cameras(opened)] == [
            ("/lidar", "/lidar/boxes", None), ("/radar", "/radar/boxes", None)
        ]  # fmt: skip
    with pytest.raises(
        McaptrackError, match="has boxes in space in /lidar/boxes, /radar/boxes; choose one with `topic=`"
    ):
        mcaptrack.track(path, tracker=ById())
    assert mcaptrack.track(path, topic="/radar/boxes", tracker=ById(), sidecar=False).channels == ("/radar/tracks",)


class Renamed:
    """A writer with another name for the channel of boxes."""

    def __init__(self, writer) -> None:
        self._writer = writer

    def __getattr__(self, name: str):
        return getattr(self._writer, name)

    def add_channel(self, topic, *others):
        return self._writer.add_channel("/radar/boxes", *others)


def boxes_in(frame_id: str, own: str = ""):
    return by_ros(lambda t, boxes: detection_3d_array("v4", t, boxes, frame_id, own))


@pytest.mark.parametrize(
    ("boxes", "keep", "count", "words"),
    [
        (WAYS["markers"], lambda s: s < START_NS + 330_000_000, 4, "4 of 8 messages are left out, since the pose of lidar in map isn't known: 4 after the last transform map -> base_link"),
        (WAYS["markers"], lambda s: s > START_NS + 330_000_000, 4, "4 of 8 messages are left out, since the pose of lidar in map isn't known: 4 before the first transform map -> base_link"),
        (boxes_in("roof"), lambda _: True, 8, "no transform has the frame 'roof' (but base_link, lidar, map), so that boxes stay in their frame, roof"),
        (boxes_in("lidar", "roof"), lambda _: True, 8, "no transform has the frame 'roof'"),
        (by_ros(marker_array, late_ns=3600 * 10**9), lambda _: True, 8, "boxes have no stamp, or one that is more than 60 s from the log time: their time is the log time"),
        (by_ros(lambda t, boxes: marker_array(t, [replace(box, size=box.size * 0) for box in boxes])), lambda _: True, 8, "24 boxes have a size of 0: it is unknown"),
    ],
    ids=["end early", "begin late", "unknown frame", "own frame", "another clock", "no size"],
)  # fmt: skip
def test_what_transforms_and_boxes_lack_is_one_line(boxes, keep, count, words, tmp_path):
    path = write(tmp_path / "a.mcap", Robot(), boxes, keep=keep)
    result = mcaptrack.track(path, topic="/lidar/boxes", tracker=ById(), sidecar=False)
    assert result.frames == {"/lidar/tracks": count}
    assert sum(words in line for line in said(result)) == 1, said(result)
    assert not any("\n" in line for line in said(result))
    with mcaptrack.open(path) as opened:
        kept = [row["message"] for row in opened.table("warnings").to_pylist() if row["topic"] == "/lidar/tracks"]
    assert sum(words in line for line in kept) == 1
    assert not any(path.name in line for line in kept)


def test_boxes_without_any_known_pose_are_an_error_and_without_transforms_stay_in_their_frame(tmp_path):
    path = write(tmp_path / "a.mcap", Robot(), WAYS["markers"], keep=lambda s: s < START_NS - 10**9)
    assert mcaptrack.track(path, tracker=ById(), sidecar=False).frames == {"/lidar/tracks": 8}
    assert tracked(path)[1]["mcaptrack.frame_id"] == "base_link"  # the root of what is left
    path = write(tmp_path / "b.mcap", Robot(), boxes_in("roof"))
    with pytest.raises(
        McaptrackError,
        match="the pose of no box of /lidar/boxes in map is known; boxes are in roof, and transforms have base_link, lidar, map; ",
    ):
        mcaptrack.track(path, frame="map", tracker=ById())
    path = write(tmp_path / "c.mcap", Robot(), WAYS["markers"], moving="")
    result = mcaptrack.track(path, tracker=ById(), sidecar=False)
    assert any("the log has no transforms, so that boxes stay in their frame, lidar" in line for line in said(result))


def test_times_are_stamps_and_tables_hold_the_boxes(tmp_path):
    path = write(tmp_path / "a.mcap", Robot(shots=3), WAYS["markers"])
    wanted = Robot(shots=3).wanted()
    with mcaptrack.open(path) as opened:
        rows = opened.table("detections").sort_by([("t_ns", "ascending"), ("source_id", "ascending")])
    assert rows.column("t_ns").to_pylist() == [row["t_ns"] for row in wanted]
    assert rows.column("class").to_pylist() == [
        "person" if row["class"] == "pedestrian" else row["class"] for row in wanted
    ]
    np.testing.assert_allclose(rows.column("x_m").to_numpy(), [row["x_m"] for row in wanted], atol=1e-6)
    assert rows.column("x_px").null_count == len(wanted)
    assert LATE_NS != 0


# One log of a robot in every form of messages: the same tracks; and limits of motion, which all stages take


TRACKED = ("/lidar/tracks", "/lidar/samples", "/lidar/retracks", "/lidar/retracks/online", "/lidar/retracks/full")
PREDICTED = ("/lidar/predictions", "/lidar/retracks/predictions")
FORMS = {
    "detections since humble": "ros",  # behind a static transform, with TFMessage
    "markers": "ros",
    "json": "protobuf",
    "scene updates": "protobuf",
}
LIMITS = "car=5:0.5:0.1:1,pedestrian=2"


class Street(Robot):
    """The robot among objects that keep their velocity in the map; some are occluded for a while."""

    def __init__(self, shots: int = 45) -> None:
        super().__init__(shots=shots, boxes=0)
        rng = np.random.default_rng(6)
        middle = self.place[len(self.place) // 2]
        for number in range(8):
            start, name = middle + [*rng.uniform(-25, 25, 2), rng.uniform(-1, 1)], NAMES[number % 4]
            velocity = np.array([*rng.normal(0, 1 if name == "pedestrian" else 4, 2), 0.0]) * (number != 5)
            ahead = Rotation.from_euler("z", rng.uniform(-3, 3))
            size = np.sort(rng.uniform(0.5, 5, 3))[::-1]
            hidden = range(0) if number % 3 else range(12 + number, 30 + 2 * number)
            for at, shot in enumerate(self.shots):
                if at in hidden or rng.random() < 0.1:
                    continue
                rotation, shift = self.pose(shot.stamp_ns)
                centre = start + velocity * (at / 10) + rng.normal(0, 0.1, 3) - shift
                score = round(float(rng.uniform(0.4, 0.9)), 3)
                turn = (rotation.inv() * ahead).as_quat()
                shot.boxes.append(Seen(rotation.inv().apply(centre), turn, size, name, score, 10 + number))


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> dict[str, Path]:
    """A finished log for each form."""
    folder, robot, out = tmp_path_factory.mktemp("street"), Street(), {}
    for number, (form, moving) in enumerate(FORMS.items()):
        out[form] = write(folder / f"{number}.mcap", robot, WAYS[form], moving)
        mcaptrack.run(out[form], topic="/lidar/boxes", tables=False, events=False, sidecar=False)
    return out


def rows_of(path: Path) -> dict[str, np.ndarray]:
    """The rows of each channel of tracks and predictions, by name of the class, which every log numbers by itself."""
    with log.read(path) as opened:
        found = {topic: opened.rows(topic, TRACKS) for topic in TRACKED}
        found |= {topic: opened.rows(topic, PREDICTIONS) for topic in PREDICTED}
    return {topic: rows.rows for topic, rows in found.items()}


@thorough
def test_limits_of_motion_reach_every_stage_and_are_recorded(street, tmp_path):
    """Channels that were made with other limits are made again; without the option, they stay as they are."""
    path = tmp_path / "a.mcap"
    path.write_bytes(street["markers"].read_bytes())
    before = rows_of(path)
    run = {"tables": False, "events": False, "sidecar": False}
    assert mcaptrack.run(path, **run).stages == ()
    made = mcaptrack.run(path, class_limits=LIMITS, **run)
    taken = {name for name, stage in STAGES.items() if "class_limits" in {f.name for f in fields(stage.default)}}
    assert {"retrack", "predict"} <= taken
    assert {*taken, "track", "sample"} <= set(made.stages)
    for topic in {*TRACKED, *PREDICTED} - {"/lidar/samples"}:
        assert provenance_of(path, topic).parameters["class_limits"] == LIMITS, topic
    after = rows_of(path)
    for topic, rows in before.items():
        assert rows.tobytes() != after[topic].tobytes(), topic
    assert mcaptrack.run(path, **run).stages == ()
    assert mcaptrack.run(path, class_limits=LIMITS, **run).stages == ()
    assert "track" in mcaptrack.run(path, class_limits="", **run).stages
    for topic, rows in rows_of(path).items():
        assert rows.tobytes() == before[topic].tobytes(), topic


def test_limits_in_another_form_are_refused_in_one_line(street):
    for stage in ("track", "retrack", "predict", "run"):
        more = {"tracker": "ground"} if stage == "track" else {}
        with pytest.raises(McaptrackError, match=r"class_limits has 'car'; it is NAME=SPEED:DRIFT:NOISE:GATE"):
            getattr(mcaptrack, stage)(street["json"], class_limits="car", **more)


# The whole line on the log of a robot: what is made of its boxes, and what commands show of it


#: Enough for predictions with a known future, 4.8 s ahead.
SHOTS = 70


@pytest.fixture(scope="module")
def passed(tmp_path_factory) -> Path:
    """A log of a robot with truth, after ``run``."""
    folder = tmp_path_factory.mktemp("robot")
    path, truth = write_passing(folder, shots=SHOTS)
    mcaptrack.ingest(truth, into=path, role="truth", frame="map", sidecar=False)
    mcaptrack.run(path, sidecar=False, tables=False)
    return path


@thorough
def test_recorded_boxes_are_decoded_once_in_a_run(passed, tmp_path, monkeypatch):
    """By the tracker; the table of detections and the number of boxes in the summary are of the same rows."""
    path, decoded = tmp_path / "a.mcap", []
    path.write_bytes(passed.read_bytes())
    read = fixed_frame.named_detections

    def counted(opened, topic, frame_id=""):
        decoded.append((topic, frame_id))
        return read(opened, topic, frame_id)

    monkeypatch.setattr(fixed_frame, "named_detections", counted)
    result = mcaptrack.run(path, force=True, sidecar=False)
    assert decoded == [("/lidar/boxes", "")]
    assert result.summary.boxes == result.tables["detections"] == SHOTS * len(OBJECTS)
    assert mcaptrack.run(path, sidecar=False).summary.boxes == SHOTS * len(OBJECTS)
    assert len(decoded) == 2  # nothing is tracked, and the tables are up to date
    mcaptrack.run(path, frame="base_link", sidecar=False, tables=False)
    assert decoded[2:] == [("/lidar/boxes", "base_link")]


@thorough
def test_the_summary_names_the_frame_in_which_boxes_in_space_were_tracked(passed, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(passed.read_bytes())
    plain = {"sidecar": False, "tables": False, "events": False}
    assert mcaptrack.run(path, **plain).summary.frame_id == "map"
    assert mcaptrack.run(path, frame="base_link", **plain).summary.frame_id == "base_link"
    with log.read(path) as opened, pytest.MonkeyPatch.context() as patch:
        patch.setattr(summary, "has_any", lambda *_: True)  # of tracks on pictures, too, metres may be in a frame
        assert summary.summarise(opened, "/lidar").frame_id is None


def test_limits_of_classes_that_there_are_not_are_named(passed, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(passed.read_bytes())
    limits = {"class_limits": "caar=4, pedestrian=5, truck=30", "sidecar": False, "force": True}
    found = [one for one in mcaptrack.predict(path, **limits).warnings if one.code == "option-not-used"]
    assert len(found) == 1
    assert "names caar: no such class is in the table of limits or in the boxes" in found[0].message


def test_boxes_that_viewers_cannot_draw_have_a_view_in_the_frame_of_the_tracks(passed, tmp_path):
    with log.read(passed) as opened:
        messages = [SceneUpdate.FromString(one.payload) for one in opened.messages("/lidar/boxes/view/scene")]
        layout = json.loads(opened.attachment("mcaptrack.layout.json"))
    assert len(messages) == SHOTS
    start_ns = messages[0].entities[0].timestamp.ToNanoseconds()
    for message in messages:
        assert [entity.frame_id for entity in message.entities] == ["map"] * len(OBJECTS)
        for entity in message.entities:
            number = int(entity.texts[0].text)
            cube, (name, *_, size) = entity.cubes[0], OBJECTS[number]
            centre = place(number, entity.timestamp.ToNanoseconds(), start_ns)
            at = cube.pose.position
            np.testing.assert_allclose([at.x, at.y, at.z], centre, atol=0.02)
            np.testing.assert_allclose([cube.size.x, cube.size.y, cube.size.z], size, atol=0.02)
            assert (cube.color.r, cube.color.g, cube.color.b) == class_colour(1, name)
    shown = [panel["topics"] for name, panel in layout["configById"].items() if name.startswith("3D!recorded")]
    assert [topics["/lidar/boxes/view/scene"]["visible"] for topics in shown] == [True]
    path, _ = write_passing(tmp_path, "scene updates", shots=4)
    mcaptrack.track(path, topic="/lidar/boxes", sidecar=False)
    assert "/lidar/boxes/view/scene" not in {channel.topic for channel in mcaptrack.info(path).channels}


def test_rows_about_tracks_have_their_classes_in_tables(passed):
    with mcaptrack.open(passed) as opened:
        names = {}
        for topic in ("/lidar/samples", "/lidar/retracks/online", "/lidar/retracks"):
            rows = [row for row in opened.table("tracks").to_pylist() if row["topic"] == topic]
            names[topic] = {row["track_id"]: row["class"] for row in rows}
        assert set(names["/lidar/samples"].values()) == {"car", "pedestrian"}
        for topic, tracks in (("predictions", "samples"), ("retracks/predictions", "retracks/online")):
            for table, ending in (("predictions", ""), ("forecast_errors", "/errors")):
                rows = [row for row in opened.table(table).to_pylist() if row["topic"] == f"/lidar/{topic}{ending}"]
                assert len(rows) > 10
                assert all(row["class"] == names[f"/lidar/{tracks}"][row["track_id"]] for row in rows)
        events = [row for row in opened.table("events").to_pylist() if row["topic"] == "/lidar/retracks/events"]
        truth = {number: name for number, (name, *_) in OBJECTS.items()}
        wanted = [names["/lidar/retracks"].get(row["track_id"], truth.get(row["truth_id"])) for row in events]
        assert [row["class"] for row in events] == wanted
        assert None not in wanted


def test_errors_of_predictions_are_those_of_each_class_alone(passed):
    """Both walk and drive straight on: a class scored by itself has the errors that a log of it alone would have."""
    scores = mcaptrack.evaluate(passed, similarity="metres", gate_m=2.0)
    rows = {row.of_class: row.displacement for row in scores.results if row.tracks == "/lidar/samples"}
    assert set(rows) == {None, "car", "pedestrian"}
    with log.read(passed) as opened:
        sequence = sequence_of_log(opened, "/lidar", ("/lidar/samples",))
    (candidate,) = sequence.candidates
    for name, number in (("car", 3), ("pedestrian", 8)):
        class_id = next(one for one, known in candidate.classes.items() if known == name)
        ids = {int(row["track_id"]) for frame in candidate.frames for row in frame.rows if row["class_id"] == class_id}
        alone = [
            [frame._replace(rows=frame.rows[np.isin(frame.rows["track_id"], list(wanted))]) for frame in frames]
            for frames, wanted in (
                (candidate.forecasts, ids), (candidate.frames, ids), (sequence.ground_truth, {number})
            )
        ]  # fmt: skip
        wanted = score_forecasts(*alone, "alone").summary()
        assert rows[name].summary() == wanted
        assert wanted["recall"] > 0.3
    found = {name: rows[name].summary()["ADE_m"] for name in rows}
    assert min(found["car"], found["pedestrian"]) <= found[None] <= max(found["car"], found["pedestrian"])
    out = done("evaluate", passed, "--similarity", "metres").out
    table = out[out.rindex("forecasts of") :].splitlines()
    assert table[0].split()[:3] == ["forecasts", "of", "class"]
    assert [tuple(line.split()[:2]) for line in table[1:4]] == [
        ("/lidar/samples", "all" if name is None else name) for name in rows
    ]
