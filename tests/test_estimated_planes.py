"""Ground planes that `run` estimates from boxes: when, what is said and kept of them, and who decides."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log, pipeline
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import collected
from mcaptrack.pipeline.motion import side_inputs
from mcaptrack.pipeline.planes import (
    AS_BEFORE,
    PlaneChoice,
    fit_in_words,
    fit_of,
    is_poor,
    make_plane,
    plane_in_words,
    planes_to_json,
)
from mcaptrack.pipeline.write import Made, RunState
from mcaptrack.schema import CAMERA_MOTION, DETECTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import Plugin, Provenance
from mcaptrack.transforms import Sort
from mcaptrack.transforms.motion import EstimateMotion
from tests.commands import done
from tests.worlds import ns

HIGH_M, PITCH, FOCAL, WIDTH, HEIGHT = 5.0, np.deg2rad(18.0), 640.0, 640, 480


def seen(x: np.ndarray, y: np.ndarray, high: float = HIGH_M, pitch: float = PITCH) -> np.ndarray:
    """Boxes (N, 4) of people 1.7 m tall at (x, y) metres before a camera."""
    below = high - np.array([[0.0], [1.7]])
    ahead = y * np.cos(pitch) + below * np.sin(pitch)
    down = below * np.cos(pitch) - y * np.sin(pitch)
    foot, head = HEIGHT / 2 + FOCAL * down / ahead
    left = WIDTH / 2 + FOCAL * x / ahead[0]
    return np.stack([left - 0.2 * (foot - head), head, 0.4 * (foot - head), foot - head], axis=1)


def people(frames: int = 60, **camera: float) -> list[np.ndarray]:
    """The boxes of five people who walk through the picture, by frame."""
    n = np.arange(frames)[:, None]
    x = np.array([-3.0, 3.0, -1.5, 2.0, 0.0]) + n * np.array([0.06, -0.05, 0.04, 0.0, -0.02])
    y = np.array([9.0, 11.0, 14.0, 24.0, 18.0]) + n * np.array([0.0, 0.03, -0.05, -0.12, 0.06])
    return [seen(*pair, **camera) for pair in zip(x, y, strict=True)]


BOXES = people()


def detections(boxes: list[np.ndarray] = BOXES) -> list[Frame]:
    frames = []
    for number, some in enumerate(boxes):
        x, y, w, h = some.T
        rows = DETECTIONS.rows(x_px=x, y_px=y, w_px=w, h_px=h, score=np.full(5, 0.9), class_id=np.full(5, 1))
        frames.append(Frame(ns(number / 10), number, rows))
    return frames


def written(path: Path, made: Provenance, frames: list[Frame], schema: Any = DETECTIONS) -> Path:
    """Write a log of boxes."""
    topic = f"/camera/{'tracks' if schema is TRACKS else 'detections'}"
    with log.create(path) as writer:
        number = writer.add_channel(topic, (schema.name, "protobuf", schema.descriptor), "protobuf", made.to_metadata())
        for frame in frames:
            writer.add_message(number, frame.t_ns, frame.index, schema.codec.encode(frame.rows))
    return path


@pytest.fixture(scope="module")
def template(tmp_path_factory) -> Path:
    """A log of boxes that were ingested, after a run."""
    folder = tmp_path_factory.mktemp("boxes")
    lines = [
        f"{number},-1,{','.join(f'{value:.2f}' for value in box)},0.9,-1,-1,-1"
        for number, some in enumerate(BOXES, start=1)
        for box in some
    ]
    (folder / "boxes.txt").write_text("\n".join(lines) + "\n")
    done("ingest", folder / "boxes.txt", "--as", "detections", "--fps", "10", "-o", folder / "raw.mcap", "-q")
    shutil.copy(folder / "raw.mcap", folder / "log.mcap")
    (folder / "said.json").write_text(done("run", folder / "log.mcap", "--no-tables", "--json", "-q").out)
    return folder


@pytest.fixture
def path(template, tmp_path) -> Path:
    return Path(shutil.copy(template / "log.mcap", tmp_path / "log.mcap"))


def plane_of(path: Path) -> Provenance:
    with log.read(path) as opened:
        made = Provenance.from_metadata(opened.channel("/camera/ground_plane").metadata)
    assert made is not None
    return made


def test_run_estimates_a_plane_from_boxes_and_says_how_well_it_fits(template):
    data = json.loads((template / "said.json").read_text())
    (warning,) = data["warnings"]
    summary = data["results"][0]["summary"]
    assert warning["code"] == "estimated-ground-plane"
    assert summary["ground_plane"] == "estimated"
    fit = summary["plane_fit"]
    assert fit["camera_height_m"] == pytest.approx(HIGH_M, rel=0.1)
    assert fit["pitch_deg"] == pytest.approx(18, abs=3)
    assert f"estimated from {fit['boxes']} boxes" in warning["message"]
    assert "m high, looking down by 1" in warning["message"]
    assert warning["message"].endswith(
        "with people 1.7 m high. Give one with `mcaptrack ingest INPUT --ground-plane HOMOGRAPHY`"
    )
    with log.read(template / "log.mcap") as opened:
        ((_, plane),) = pipeline.read_planes(opened, "/camera") or ()
        rows = opened.rows("/camera/tracks", TRACKS).rows
    assert plane.is_estimated
    made = plane_of(template / "log.mcap")
    assert (made.transform, made.input, made.parameters["fit"]) == ("estimate-ground-plane", "/camera/detections", fit)
    boxes = np.stack([rows["x_px"], rows["y_px"], rows["w_px"], rows["h_px"]], axis=1)
    assert np.stack([rows["x_m"], rows["y_m"]], axis=1) == pytest.approx(plane.boxes_to_metres(boxes))
    apart_m = plane.boxes_to_metres(BOXES[0][:2])
    assert np.ptp(apart_m[:, 0]) == pytest.approx(6.0, rel=0.1)


def test_nothing_is_made_again_and_the_warning_is_repeated(path):
    before = path.read_bytes()
    result = mcaptrack.run(path, tables=False)
    assert result.stages == ()
    assert path.read_bytes() == before
    assert [one.code for one in result.warnings] == ["estimated-ground-plane"]


def test_the_choice_of_a_user_is_kept_until_there_is_another(path):
    first = path.read_bytes()
    result = mcaptrack.run(path, tables=False, fit_plane=False)
    assert result.stages[:2] == ("track", "sample")
    assert (result.summary.ground_plane, result.summary.plane_fit) == ("assumed", None)
    assert "taking" in result.warnings[0].message
    assert plane_of(path).parameters == {"fit_plane": False}
    assert mcaptrack.run(path, tables=False).stages == ()
    assert mcaptrack.run(path, tables=False, fit_plane=False).stages == ()
    mcaptrack.track(path)
    assert plane_of(path).transform == "assume-ground-plane"
    mcaptrack.run(path, tables=False, fit_plane=True)
    assert plane_of(path).transform == "estimate-ground-plane"
    assert len(path.read_bytes()) == len(first)


def test_metres_are_proportional_to_the_height_of_people(path):
    with log.read(path) as opened:
        before = opened.rows("/camera/tracks", TRACKS).rows["x_m"]
    result = mcaptrack.run(path, tables=False, person_height_m=0.85)
    with log.read(path) as opened:
        after = opened.rows("/camera/tracks", TRACKS).rows["x_m"]
    assert after == pytest.approx(before / 2, rel=1e-6)
    assert "with people 0.85 m high" in result.warnings[0].message
    assert mcaptrack.run(path, tables=False).stages == ()
    with pytest.raises(McaptrackError, match="person_height_m"):
        mcaptrack.run(path, person_height_m=-1.0)


def test_a_given_plane_wins(template, tmp_path):
    (tmp_path / "plane.txt").write_text("0.05,0,0\n0,0.05,0\n0,0,1\n")
    result = mcaptrack.ingest(
        template / "boxes.txt", tmp_path / "a.mcap", role="detections", fps=10, ground_plane=tmp_path / "plane.txt"
    )
    said = mcaptrack.run(result.log, tables=False, fit_plane=True)
    assert said.summary.ground_plane == "given"
    assert [(one.code, one.message) for one in said.warnings] == [
        ("option-not-used", "a ground plane is given, so that none is estimated")
    ]
    with log.read(result.log) as opened:
        ((_, plane),) = pipeline.read_planes(opened, "/camera") or ()
    assert plane.homography[0] == 0.05


def made_from(
    path: Path, provenance: Provenance, frames: list[Frame] | None = None, choice: PlaneChoice = AS_BEFORE, **more: Any
) -> Provenance:
    """The provenance of the plane that is made from boxes of this origin."""
    frames = detections() if frames is None else frames
    with log.read(written(path, provenance, frames)) as opened:
        _, made = make_plane(RunState(opened, "/camera", more), frames, ("/camera/detections", "x"), choice, "")
    assert made is not None
    return made.provenance


LEARNED = Provenance("detect", {"detector": "onnx"}, "/camera/video")


@pytest.mark.parametrize(
    ("provenance", "transform"),
    [
        (LEARNED, "estimate-ground-plane"),
        (Provenance("ingest", {}), "estimate-ground-plane"),
        (Provenance("detect", {"detector": "knn"}, "/camera/video"), "assume-ground-plane"),
        (Provenance("detect", {"detector": "median"}, "/camera/video"), "assume-ground-plane"),
        (Provenance("detect", {}, "/camera/video"), "assume-ground-plane"),  # the usual one
        (Provenance("detect", {"detector": "of another package"}, "/camera/video"), "assume-ground-plane"),
        (
            Provenance("detect", {"detector": "knn"}, plugins={"transform": Plugin("a", "b:C", "", "")}),
            "estimate-ground-plane",
        ),
    ],
)
def test_boxes_of_motion_detectors_are_not_used(tmp_path, provenance, transform):
    made = made_from(tmp_path / "a.mcap", provenance)
    assert made.transform == transform
    if transform == "assume-ground-plane":
        assert made.parameters == {}  # as always
        asked = made_from(tmp_path / "b.mcap", provenance, choice=PlaneChoice(estimate=True))
        assert asked.parameters == {"refused": "boxes of a motion detector have shadows, and several people in one"}


def test_only_boxes_of_people_count(tmp_path):
    frames = detections()
    for frame in frames:
        frame.rows["class_id"][2:] = 7
    named = Provenance("detect", {"detector": "onnx"}, "/camera/video", classes={"1": "car", "7": "Person"})
    assert " of 120 boxes show whole people" in made_from(tmp_path / "a.mcap", LEARNED, frames).parameters["refused"]
    assert 120 < made_from(tmp_path / "b.mcap", named, frames).parameters["fit"]["boxes"] <= 180


def test_boxes_of_other_things_alone_are_refused(tmp_path):
    frames = detections()
    for frame in frames:
        frame.rows["class_id"] = 7
    named = Provenance("detect", {"detector": "onnx"}, "/camera/video", classes={"1": "person", "7": "car"})
    assert made_from(tmp_path / "a.mcap", named, frames).parameters == {"refused": "none of them is of a person"}
    for frame in frames:
        frame.rows["class_id"] = 0  # unknown
    assert made_from(tmp_path / "b.mcap", named, frames).parameters["fit"]["boxes"] > 120


def test_a_scale_is_that_of_people_where_there_are_other_things(tmp_path):
    frames = detections()[:20]
    alone = made_from(tmp_path / "a.mcap", LEARNED, frames)
    mixed = [frame._replace(rows=np.concatenate([frame.rows] * 4)) for frame in frames]
    for frame in mixed:
        frame.rows["class_id"][5:] = 3
        frame.rows["h_px"][5:] *= 5
    assert alone.parameters["refused"].endswith("120 are needed")
    for one in (frames, mixed):
        with log.read(tmp_path / "a.mcap") as opened:
            planes, _ = make_plane(RunState(opened, "/camera", {}), one, ("/camera/detections", ""), AS_BEFORE, "")
        assert planes is not None
        assert planes[0][1].homography[0] == pytest.approx(1.7 / np.median(np.concatenate(BOXES[:20])[:, 3]), rel=0.1)


def test_a_camera_that_moves_is_refused(tmp_path):
    moves = CAMERA_MOTION.rows(
        m00=[1.0], m01=[0.0], m02_px=[30.0], m10=[0.0], m11=[1.0], m12_px=[0.0],
        r00=[1.0], r01=[0.0], r02_px=[30.0], r10=[0.0], r11=[1.0], r12_px=[0.0],
        reference_frame=[0], inliers=[50.0], verdict=[2], width_px=[WIDTH], height_px=[HEIGHT],
    )  # fmt: skip
    frames = [Frame(frame.t_ns, frame.index, moves) for frame in detections()]
    motion = Made.of(CAMERA_MOTION, frames, Provenance("motion", {}, "/camera/video"))
    made = made_from(tmp_path / "a.mcap", LEARNED, **{"/camera/motion": motion})
    assert made.parameters == {"refused": "the camera moves"}


def test_boxes_that_cannot_tell_give_a_scale_and_the_reason(tmp_path):
    path = written(tmp_path / "a.mcap", Provenance("ingest", {}), detections()[:20])
    with collected() as said:
        mcaptrack.run(path, tables=False)
    messages = [one.message for one in said if one.code == "assumed-ground-plane"]
    assert len(messages) == 1
    words = "no ground plane is known, and boxes don't tell it (79 of 100 boxes show whole people, and 120 are needed): taking "
    assert messages[0].startswith(words)


def test_tracks_of_other_trackers_give_a_plane_too(tmp_path):
    frames = []
    for number, some in enumerate(BOXES):
        x, y, w, h = some.T
        rows = TRACKS.rows(
            track_id=np.arange(1, 6), x_px=x, y_px=y, w_px=w, h_px=h, observed=[True] * 5, source_id=[-1] * 5
        )
        frames.append(Frame(ns(number / 10), number, rows))
    path = written(tmp_path / "a.mcap", Provenance("ingest", {}), frames, TRACKS)
    assert mcaptrack.run(path, tables=False).summary.ground_plane == "estimated"
    result = mcaptrack.run(path, tables=False, fit_plane=False)
    assert "sample" in result.stages
    assert result.summary.ground_plane == "assumed"


def how(name: str, **parameters: Any) -> Provenance:
    return Provenance(f"{name}-ground-plane", parameters, "/camera/detections")


class TestChoice:
    """What a user chooses, beside how the plane of the log was made."""

    @pytest.mark.parametrize(
        ("choice", "made", "settled"),
        [
            ({}, None, (True, 1.7)),
            ({}, how("estimate"), (True, 1.7)),
            ({}, how("assume", fit_plane=False), (False, 1.7)),
            ({}, how("assume", refused="too few", person_height_m=2), (True, 2.0)),
            ({}, how("estimate", person_height_m="tall"), (True, 1.7)),
            ({}, how("estimate", person_height_m=0), (True, 1.7)),
            ({}, how("calibrate", fit_plane=False, person_height_m=1.5), (True, 1.7)),
            ({"estimate": True}, how("assume", fit_plane=False), (True, 1.7)),
            ({"estimate": False}, None, (False, 1.7)),
            ({"person_height_m": 1.6}, how("estimate", person_height_m=1.5), (True, 1.6)),
        ],
    )
    def test_what_is_not_said_is_as_before(self, choice, made, settled):
        assert PlaneChoice(**choice).settled(made) == settled

    @pytest.mark.parametrize(
        ("choice", "made", "is_another"),
        [
            ({}, how("estimate"), False),
            ({"estimate": False}, None, False),
            ({"estimate": False}, Provenance("ingest", {}), False),
            ({"estimate": False}, how("estimate"), True),
            ({"estimate": True}, how("estimate"), False),
            ({"estimate": True}, how("assume"), True),  # it was not tried
            ({"estimate": True}, how("assume", refused="too few"), False),
            ({"estimate": True}, how("assume", fit_plane=False), True),
            ({"estimate": False}, how("assume", fit_plane=False), False),
            ({"person_height_m": 1.7}, how("estimate"), False),
            ({"person_height_m": 1.6}, how("estimate"), True),
            ({"person_height_m": 1.6}, how("calibrate"), False),
            ({"frame": "map"}, how("estimate"), False),
            ({"frame": "map"}, how("calibrate"), True),
            ({"frame": "map"}, how("calibrate", frame="map"), False),
            ({"frame": ""}, how("calibrate", frame="map"), True),
            ({"ground_frame": "base"}, how("calibrate", ground_frame="base"), False),
            ({"ground_frame": "floor"}, how("calibrate", ground_frame="base"), True),
            ({"estimate": True}, how("calibrate", frame="map"), False),
        ],
    )
    def test_a_plane_is_made_again_for_another_choice(self, choice, made, is_another):
        assert PlaneChoice(**choice).is_another(made) is is_another

    def test_frames_are_those_of_a_calibrated_plane(self):
        made = how("calibrate", frame="map", ground_frame="base")
        assert AS_BEFORE.frames(made) == ("map", "base")
        assert AS_BEFORE.frames(how("estimate", frame="map")) == AS_BEFORE.frames(None) == ("", "")
        assert PlaneChoice(frame="odom").frames(made) == ("odom", "base")
        assert PlaneChoice(ground_frame="").frames(made) == ("map", "")


class TestWords:
    FIT = {
        "boxes": 1234, "nearest_m": 3.4, "farthest_m": 21.6, "camera_height_m": 4.26, "pitch_deg": -12.4,
        "residual": 0.123, "depth_sd": 0.05,
    }  # fmt: skip
    PLANE = GroundPlane((0.02, 0, 0, 0, 0.02, 0, 0, 0, 1), 640, 480)

    def test_a_fit(self):
        assert fit_in_words(self.FIT) == (
            "1,234 boxes 3 to 22 m away (camera 4.3 m high, looking up by 12 degrees; heights fit within 12%, metres "
            "along the view are uncertain by 5%)"
        )
        assert "looking down by 0 degrees" in fit_in_words(self.FIT | {"pitch_deg": 0})
        assert fit_in_words({"boxes": "many"}).startswith("nan boxes nan to nan m away")

    def test_only_an_estimated_plane_has_a_fit(self):
        assert fit_of(how("estimate", fit=self.FIT)) == self.FIT
        assert [
            fit_of(one) for one in (None, how("assume", fit=self.FIT), how("estimate", fit=3), how("estimate"))
        ] == [None] * 4

    def test_a_plane(self):
        planes = [(0, self.PLANE)]
        fitted = plane_in_words(planes, how("estimate", fit=self.FIT, person_height_m=1.6))
        assert fitted.startswith("no ground plane is known: one was estimated from 1,234 boxes 3 to 22 m away")
        assert ", with people 1.6 m high. Give one with " in fitted
        for made, why in ((None, ""), (how("assume", refused="no"), ", and boxes don't tell it (no)")):
            assert plane_in_words(planes, made).startswith(
                f"no ground plane is known{why}: taking 50 px for a metre, since people are 1.7 m high; distances"
            )

    @pytest.mark.parametrize(("count", "kept"), [(100, 100), (101, 2)])
    def test_many_planes_are_recorded_by_their_digest(self, count, kept):
        made = planes_to_json([(number, self.PLANE) for number in range(count)])
        assert len(made) == kept
        if kept == 2:
            assert (made[0], len(made[1])) == (101, 64)
            other = planes_to_json([(number, self.PLANE) for number in range(1, count + 1)])
            assert other[1] != made[1]
        else:
            assert made[3][0] == 3
            assert made[3][1]["homography"] == list(self.PLANE.homography)
            assert None not in made[3][1].values()


@pytest.mark.parametrize(("deep_px", "poor"), [(199.0, True), (201.0, False), (0.0, True)])
def test_a_scale_is_poor_where_the_ground_has_less_than_two_heights(deep_px, poor):
    """Boxes of 100 px with lower edges spread evenly: nine tenths of that is the extent of the ground, 1.8 heights."""
    down = np.append(np.linspace(0, deep_px, 41), np.nan)  # a row without a box doesn't count
    rows = TRACKS.rows(
        track_id=np.arange(42), x_px=down, y_px=down + 200, w_px=down * 0 + 40, h_px=down * 0 + 100,
        x_m=np.ones(42), y_m=np.ones(42), observed=[True] * 42, source_id=[-1] * 42,
    )  # fmt: skip
    assert is_poor([Frame(0, 0, rows[:20]), Frame(1, 1, rows[20:])]) == poor


class TestBesideThePictures:
    """The boxes of people that the estimate of the camera's motion leaves out."""

    MOTION = SimpleNamespace(transform=EstimateMotion())

    @staticmethod
    def found(path: Path, provenance: Provenance, job: Any = MOTION, made: dict[str, Made] = {}) -> Any:  # noqa: B006
        with log.read(written(path, provenance, detections())) as opened:
            return side_inputs(RunState(opened, "/camera", made), job)

    def test_they_are_those_of_the_log_by_the_time_of_their_picture(self, tmp_path):
        values, references = self.found(tmp_path / "a.mcap", LEARNED)
        boxes = {t_ns: some.tolist() for t_ns, some in values["known_boxes"].items()}
        assert boxes == {frame.t_ns: BOXES[frame.index].tolist() for frame in detections()}
        assert [*references] == ["/camera/detections"]
        assert len(references["/camera/detections"]) == 64

    def test_they_are_those_of_this_run_if_it_makes_some(self, tmp_path):
        frames = [frame._replace(rows=frame.rows[:3]) for frame in detections()[:4]]
        frames.append(Frame(ns(9), 90, frames[0].rows[:0]))
        made = {"/camera/detections": Made.of(DETECTIONS, frames, LEARNED)}
        values, references = self.found(tmp_path / "a.mcap", LEARNED, made=made)
        assert {t_ns: len(some) for t_ns, some in values["known_boxes"].items()} == {ns(n / 10): 3 for n in range(4)}
        assert references == {"/camera/detections": made["/camera/detections"].provenance.digest}

    @pytest.mark.parametrize("detector", ["knn", "median"])
    def test_a_detector_that_needs_a_still_camera_says_nothing(self, tmp_path, detector):
        still = Provenance("detect", {"detector": detector}, "/camera/video")
        assert self.found(tmp_path / "a.mcap", still) == ({}, {})

    def test_they_are_not_asked_for(self, tmp_path):
        for transform in (EstimateMotion(mask_boxes=False), Sort(camera_motion="off")):
            job = SimpleNamespace(transform=transform)
            assert self.found(tmp_path / f"{type(transform).__name__}.mcap", LEARNED, job) == ({}, {})

    def test_a_tracker_that_is_to_use_a_motion_that_is_not_known_says_so(self, tmp_path):
        for choice, said in (("auto", 0), ("on", 1)):
            job = SimpleNamespace(transform=Sort(camera_motion=choice))
            with collected() as notices:
                assert self.found(tmp_path / f"{choice}.mcap", LEARNED, job) == ({}, {})
            assert len(notices) == said
            if said:
                assert notices[0].message.startswith("the motion of the camera is not known: /camera/motion needs")
