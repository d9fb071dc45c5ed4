"""Ground planes that `run` estimates from boxes: when, what is said and kept of them, and who decides."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log, pipeline
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.geometry.plane_from_boxes import PlaneFit, plane_from_boxes, whole_people
from mcaptrack.notices import collected
from mcaptrack.pipeline.motion import boxes_input, motion_input
from mcaptrack.pipeline.planes import AS_BEFORE, PlaneChoice, fit_in_words, fit_of, is_poor, make_plane, plane_in_words
from mcaptrack.pipeline.staleness import planes_to_json
from mcaptrack.pipeline.write import Made, RunState
from mcaptrack.schema import CAMERA_MOTION, DETECTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import Plugin, Provenance
from mcaptrack.transforms import Sort
from mcaptrack.transforms.motion import EstimateMotion
from tests.commands import done
from tests.logs import provenance_of
from tests.tiers import thorough
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
    topic = f"/camera/{'tracks' if schema is TRACKS else 'detections'}"
    with log.create(path) as writer:
        number = writer.add_channel(topic, (schema.name, "protobuf", schema.descriptor), "protobuf", made.to_metadata())
        for frame in frames:
            writer.add_message(number, frame.t_ns, frame.index, schema.codec.encode(frame.rows))
    return path


@pytest.fixture(scope="module")
def template(tmp_path_factory) -> Path:
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
    return provenance_of(path, "/camera/ground_plane")


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


def test_boxes_beyond_the_corner_of_the_picture_have_a_scale(tmp_path):
    rows = DETECTIONS.rows(x_px=[-1000.0], y_px=[-2000.0], w_px=[30.0], h_px=[60.0], score=[0.9], class_id=[1])
    path = written(tmp_path / "a.mcap", Provenance("ingest", {}), [Frame(0, 0, rows)])
    assert mcaptrack.run(path, tables=False).summary.ground_plane == "assumed"


@thorough
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

    @staticmethod
    def found(path: Path, provenance: Provenance, made: dict[str, Made] = {}) -> Any:  # noqa: B006
        with log.read(written(path, provenance, detections())) as opened:
            return boxes_input(RunState(opened, "/camera", made), EstimateMotion())

    def test_they_are_those_of_the_log_by_the_time_of_their_picture(self, tmp_path):
        values, references = self.found(tmp_path / "a.mcap", LEARNED)
        boxes = {t_ns: some.tolist() for t_ns, some in values.items()}
        assert boxes == {frame.t_ns: BOXES[frame.index].tolist() for frame in detections()}
        assert [*references] == ["/camera/detections"]
        assert len(references["/camera/detections"]) == 64

    def test_they_are_those_of_this_run_if_it_makes_some(self, tmp_path):
        frames = [frame._replace(rows=frame.rows[:3]) for frame in detections()[:4]]
        frames.append(Frame(ns(9), 90, frames[0].rows[:0]))
        made = {"/camera/detections": Made.of(DETECTIONS, frames, LEARNED)}
        values, references = self.found(tmp_path / "a.mcap", LEARNED, made=made)
        assert {t_ns: len(some) for t_ns, some in values.items()} == {ns(n / 10): 3 for n in range(4)}
        assert references == {"/camera/detections": made["/camera/detections"].provenance.digest}

    @pytest.mark.parametrize("detector", ["knn", "median"])
    def test_a_detector_that_needs_a_still_camera_says_nothing(self, tmp_path, detector):
        still = Provenance("detect", {"detector": detector}, "/camera/video")
        assert self.found(tmp_path / "a.mcap", still) is None

    def test_a_tracker_that_is_to_use_a_motion_that_is_not_known_says_so(self, tmp_path):
        for choice, said in (("auto", 0), ("on", 1)):
            path = written(tmp_path / f"{choice}.mcap", LEARNED, detections())
            with log.read(path) as opened, collected() as notices:
                assert motion_input(RunState(opened, "/camera", {}), Sort(camera_motion=choice)) is None
            assert len(notices) == said
            if said:
                assert notices[0].message.startswith("the motion of the camera is not known: /camera/motion needs")


# The estimate itself, against cameras whose pictures are computed here, by another route


WIDE_PX, HIGH_PX = 1280, 720


class View:
    """A camera ``high`` metres above the origin; x is to the right of it, y away from it, z up."""

    def __init__(self, high: float, pitch_deg: float, focal: float = 1.0, roll_deg: float = 0.0) -> None:
        a, r = np.deg2rad(pitch_deg), np.deg2rad(roll_deg)
        down = np.array([[1, 0, 0], [0, -np.sin(a), -np.cos(a)], [0, np.cos(a), -np.sin(a)]])  # to right, down, ahead
        turn = np.array([[np.cos(r), np.sin(r), 0], [-np.sin(r), np.cos(r), 0], [0, 0, 1]])
        camera = np.diag([focal * WIDE_PX, focal * WIDE_PX, 1.0])
        camera[:2, 2] = WIDE_PX / 2, HIGH_PX / 2
        self.matrix = camera @ turn @ down
        self.high = high

    def pixels(self, xyz: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of points (N, 3) in metres; NaN behind the camera."""
        u, v, w = self.matrix @ (xyz - [0, 0, self.high]).T
        w = np.where(w > 0.2, w, np.nan)
        return np.stack([u / w, v / w], axis=-1)

    def boxes(
        self, count: int, seed: int, noise: float = 0.0, hidden: float = 0.0, far: float = 35.0, spread: float = 0.1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Boxes (N, 4) of people that are wholly in the picture, and where they stand (N, 2)."""
        rng = np.random.default_rng(seed)
        away = rng.uniform(1.0, far, 60 * count)
        x, tall = rng.uniform(-1, 1, len(away)) * away, rng.normal(1.7, spread, len(away))
        around = np.linspace(0, 2 * np.pi, 9)[:-1]
        rim = np.stack([np.cos(around), np.sin(around)], axis=1) * 0.12
        points = np.array([[*side, high] for side in rim for high in (0.0, 1.0)])
        body = points[None] * np.stack([np.ones_like(tall), np.ones_like(tall), tall], axis=1)[:, None]
        body = body + np.stack([x, away, np.zeros_like(x)], axis=1)[:, None]
        pixels = self.pixels(body.reshape(-1, 3)).reshape(len(x), -1, 2)
        low, high = pixels.min(axis=1), pixels.max(axis=1)
        boxes = np.concatenate([low, high - low], axis=1)
        boxes[:, 0] -= 0.12 * boxes[:, 3]  # arms
        boxes[:, 2] += 0.24 * boxes[:, 3]
        boxes += rng.normal(0, noise / np.sqrt(2), boxes.shape) * boxes[:, 3:] * [0, 1, 0, 1]
        is_cut = rng.random(len(boxes)) < hidden
        boxes[is_cut, 3] *= rng.uniform(0.4, 0.95, is_cut.sum())
        seen = (low > 8).all(axis=1) & (high < [WIDE_PX - 8, HIGH_PX - 8]).all(axis=1)
        return boxes[seen][:count], np.stack([x, away], axis=1)[seen][:count]


def fitted(boxes: np.ndarray, **options: float) -> PlaneFit:
    alone = np.arange(len(boxes))  # one in each picture
    return plane_from_boxes(boxes, alone, np.full(len(boxes), np.nan), WIDE_PX, HIGH_PX, **options)


@pytest.mark.parametrize(
    ("high", "pitch", "focal", "roll"),
    [(6.0, 20.0, 1.0, 0.0), (3.0, 8.0, 1.1, 2.0), (8.0, 35.0, 0.9, -2.0), (1.6, 2.0, 1.0, 0.0)],
)
def test_a_camera_is_found_from_people_before_it(high, pitch, focal, roll):
    view = View(high, pitch, focal, roll)
    boxes, places = view.boxes(500, seed=3)
    fit = fitted(boxes)
    assert fit.camera_height_m == pytest.approx(high, rel=0.12)
    assert fit.pitch_deg == pytest.approx(pitch, abs=3.0)
    assert fit.roll_deg == pytest.approx(roll, abs=0.7)
    assert fit.inliers > 0.85
    assert fit.residual < 0.07
    assert fit.plane.assumed
    assert fit.plane.is_estimated
    found = fit.plane.boxes_to_metres(boxes)
    assert np.median(np.abs(found[:, 0] / places[:, 0] - 1)) < 0.04  # across
    assert np.median(np.abs(found[:, 1] / places[:, 1] - 1)) < 0.15  # along: here the focal length is a guess
    near, far = np.quantile(np.hypot(*places.T), [0.05, 0.95])
    assert (fit.nearest_m, fit.farthest_m) == pytest.approx((near, far), rel=0.2)


@thorough
def test_noise_and_hidden_people_change_the_scale_little_over_random_cameras():
    rng = np.random.default_rng(5)
    off = []
    for seed in range(12):
        view = View(rng.uniform(2.5, 10), rng.uniform(5, 45), rng.uniform(0.7, 1.3), rng.normal(0, 1))
        boxes, places = view.boxes(400, seed, noise=0.05, hidden=0.2)
        if len(boxes) < 250:  # steep and low: it sees little ground
            continue
        feet = view.pixels(np.column_stack([places, np.zeros(len(places))]))
        to_right = view.pixels(np.column_stack([places + [0.1, 0], np.zeros(len(places))]))
        try:
            plane = fitted(boxes).plane
        except McaptrackError as error:  # a view of a few metres
            assert "same distance" in str(error)
            continue
        apart = np.linalg.norm(plane.pixels_to_metres(to_right) - plane.pixels_to_metres(feet), axis=1)
        off.append(np.nanmedian(apart) / 0.1 - 1)
    assert len(off) >= 8
    assert np.median(np.abs(off)) < 0.03
    assert np.max(np.abs(off)) < 0.12


def test_all_numbers_of_a_fit_are_values_of_json():
    said = fitted(View(5.0, 20.0).boxes(300, seed=1)[0]).to_json()
    assert said["boxes"] + 0.0 == pytest.approx(300, abs=40)
    assert "plane" not in said
    assert {type(value) for value in said.values()} <= {int, float}


def nothing() -> np.ndarray:
    return np.empty((0, 4))


def few() -> np.ndarray:
    return View(5.0, 20.0).boxes(119, seed=2)[0]


def lane() -> np.ndarray:
    boxes, places = View(1.6, 0.0).boxes(6000, seed=2)
    return boxes[np.abs(places[:, 1] - 12) < 0.5]


def above() -> np.ndarray:
    return View(14.0, 80.0).boxes(300, seed=2, far=6.0)[0] * [1, 1, 0.5, 1]


def unrelated() -> np.ndarray:
    boxes, _ = View(5.0, 20.0).boxes(400, seed=2)
    boxes[:, 3] = np.random.default_rng(1).uniform(30, 300, len(boxes))
    boxes[:, 2] = boxes[:, 3] * 0.4
    return boxes


def sitting(seen_m: float = 1.2) -> np.ndarray:
    boxes, _ = View(4.0, 20.0).boxes(600, seed=2)
    boxes[::2, 1] += boxes[::2, 3] * (1 - seen_m / 1.7)
    boxes[::2, 3] *= seen_m / 1.7
    return boxes


def lying() -> np.ndarray:
    return View(5.0, 20.0).boxes(300, seed=2)[0] * [1, 1, 4, 1]


@pytest.mark.parametrize(
    ("boxes", "words"),
    [
        (nothing, "0 of 0 boxes show whole people, and 120 are needed"),
        (few, "of 119 boxes show whole people, and 120 are needed"),
        pytest.param(lane, "people are all at about the same distance from the camera", marks=thorough),
        (unrelated, "heights of boxes don't follow from where they stand: "),
        (sitting, "heights of boxes don't follow from where they stand"),
        (partial(sitting, 1.4), "heights of boxes don't follow from where they stand"),
        (lying, "0% of the boxes have the shape of an upright person"),
        (above, "looks down|same distance|don't follow|shape|show whole"),
    ],
    ids=["none", "few", "one distance", "unrelated", "sitting", "sitting upright", "lying", "above"],
)
def test_boxes_that_cannot_tell_are_refused(boxes, words):
    with pytest.raises(McaptrackError, match=words):
        fitted(boxes())


def test_people_that_are_cut_off_hidden_or_uncertain_do_not_count():
    boxes = np.array(
        [
            [100, 100, 40, 100],  # whole
            [120, 110, 40, 120],  # whole, and before the first one
            [300, 100, 40, 100],
            [0.5, 100, 40, 100],  # at the left edge
            [1238, 100, 40, 100],  # at the right edge
            [400, 1, 40, 100],  # at the upper edge
            [500, 618, 40, 100],  # at the lower edge
            [600, 100, 90, 100],  # too wide
            [700, 100, 10, 100],  # too narrow
            [800, 100, 40, 100],  # of a low score
            [np.nan, 100, 40, 100],
        ]
    )
    score = np.full(len(boxes), 0.9)
    score[9] = 0.5
    together = np.zeros(len(boxes), np.int64)
    assert np.flatnonzero(whole_people(boxes, together, score, WIDE_PX, HIGH_PX)).tolist() == [1, 2]
    assert np.flatnonzero(whole_people(boxes, together, score * np.nan, WIDE_PX, HIGH_PX)).tolist() == [1, 2, 9]
    apart = np.arange(len(boxes))
    assert np.flatnonzero(whole_people(boxes, apart, score, WIDE_PX, HIGH_PX)).tolist() == [0, 1, 2]
