"""A scene that three cameras see: people keep their ids from picture to picture, and pictures show those ids."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from hypothesis import given
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import McaptrackError, log, pipeline
from mcaptrack.api import demonstration
from mcaptrack.extensions.cameras.feet import CameraView
from mcaptrack.extensions.cameras.on_pictures import SceneCamera, SceneOnPictures
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import collected
from mcaptrack.pipeline.pictures import PictureClock
from mcaptrack.pipeline.several import choose_cameras
from mcaptrack.pipeline.write import Made
from mcaptrack.schema import DETECTIONS, EVENTS, SIGHTINGS, TRACKS, EventKind, Frame
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.demo import PLACES, Pedestrian, Pose, SyntheticScene, three_cameras
from mcaptrack.sources.video import write_mp4
from mcaptrack.viewing.links import find_moments
from tests.logs import write_with_views

FPS, NS = 2, 1_000_000_000
#: Coordinates in views are written to a quarter of a pixel.
PX = 0.3
SCENES = {name: replace(scene, fps=FPS, seconds=26.0) for name, scene in three_cameras(2).items()}
BLANK = np.full((360, 640, 3), 128, np.uint8)


def shown(scene: SyntheticScene) -> list[dict[int, tuple[np.ndarray, np.ndarray]]]:
    pictures = []
    for shot in scene.shots(draw=False):
        ends = np.concatenate([shot.boxes[:, :2], shot.boxes[:, :2] + shot.boxes[:, 2:]], axis=1)
        whole = (ends >= 0).all(axis=1) & (ends <= [640, 360, 640, 360]).all(axis=1)
        people = zip(shot.ids, shot.boxes, shot.places_m, whole, strict=True)
        pictures.append({number: (box, at) for number, box, at, is_whole in people if is_whole})
    return pictures


TRUTH = {name: shown(scene) for name, scene in SCENES.items()}


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with the pictures of three cameras, which are blank, and with the boxes of those who are whole in them."""
    folder = tmp_path_factory.mktemp("scene")
    made = folder / "scene.mcap"
    for name, scene in SCENES.items():
        write_mp4(folder / f"{name}.mp4", [BLANK] * len(TRUTH[name]), FPS)
        np.savetxt(folder / "plane.txt", np.reshape(scene.ground_plane().homography, (3, 3)), delimiter=",")
        lines = [
            f"{number},-1,{','.join(f'{value:.3f}' for value in box)},0.9,-1,-1,-1\n"
            for number, people in enumerate(TRUTH[name], 1)
            for box, _ in people.values()
        ]
        (folder / "boxes.txt").write_text("".join(lines))
        where = {"into": made} if made.exists() else {"output": made}
        files = {"ground_plane": folder / "plane.txt", "detections": folder / "boxes.txt"}
        mcaptrack.ingest(folder / f"{name}.mp4", camera=name, **files, **where)
    with collected():
        mcaptrack.fuse(made)
        mcaptrack.run(made, camera="world", predictor="cv", events=False, tables=False)
    return made


def drawn(path: Path, topic: str) -> dict[int, dict[str, tuple[np.ndarray, float]]]:
    """The boxes (4,) of a view and the opacity of their lines by label, for each picture."""
    found = {}
    with log.read(path) as opened:
        for message in opened.messages(topic):
            read = ImageAnnotations.FromString(message.payload)
            loops = [one for one in read.points if one.type == one.LINE_LOOP]
            boxes = [np.array([[point.x, point.y] for point in one.points]) for one in loops]
            ends = [np.concatenate([one.min(axis=0), one.max(axis=0) - one.min(axis=0)]) for one in boxes]
            solid = [one.outline_color.a for one in loops]
            labels = [one.text for one in read.texts]
            found[round(message.t_ns * FPS / NS)] = dict(zip(labels, zip(ends, solid, strict=True), strict=True))
    return found


def test_who_goes_out_of_one_picture_and_comes_into_the_next_keeps_the_id(path: Path) -> None:
    with mcaptrack.open(path) as opened:
        rows = opened.array("tracks", "/world/retracks/full")
    ids: dict[int, list[int]] = {}
    cameras: dict[int, set[str]] = {}
    for number in range(len(TRUTH["left"])):
        now = rows[rows["t_ns"] == round(number * NS / FPS)]
        xy = np.stack([now["x_m"], now["y_m"]], axis=-1)
        for name, pictures in TRUTH.items():
            for person, (_, at) in pictures[number].items():
                away = np.linalg.norm(xy - at, axis=-1)
                if len(away) and away.min() < 0.5:
                    ids.setdefault(person, []).append(int(now["track_id"][away.argmin()]))
                    cameras.setdefault(person, set()).add(name)
    assert len([1 for seen in cameras.values() if {"left", "right"} <= seen]) >= 4
    for person, seen in ids.items():
        assert len(set(seen)) == 1, f"person {person} has the ids {set(seen)}"
    assert len({seen[0] for seen in ids.values()}) == len(ids)


def test_each_picture_has_the_boxes_of_its_camera_with_the_ids_of_the_scene(path: Path) -> None:
    with mcaptrack.open(path) as opened:
        rows = opened.array("tracks", "/world/retracks/full")
    detected, others = set(), set()
    for name, pictures in TRUTH.items():
        views = drawn(path, f"/world/retracks/full/view/image/{name}/video")
        assert len(views) == len(pictures)
        for number, people in enumerate(pictures):
            now = rows[rows["t_ns"] == round(number * NS / FPS)]
            own = set()
            for box, at in people.values():
                away = np.hypot(now["x_m"] - at[0], now["y_m"] - at[1])
                if len(away) and away.min() < 0.5:
                    label = str(now["track_id"][away.argmin()])
                    assert views[number][label][0] == pytest.approx(box, abs=PX), (name, number, label)
                    own.add(label)
            for label, (_, opacity) in views[number].items():
                (detected if label in own else others).add(round(opacity, 3))
    # Boxes that a camera doesn't have itself are fainter.
    assert len(detected) == len(others) == 1
    assert max(others) < min(detected)


def test_layouts_and_videos_show_the_scene_on_the_pictures(path: Path, tmp_path: Path) -> None:
    layout = json.loads(path.with_name("scene.layout.json").read_text())["configById"]
    panels = [one["imageMode"] for name, one in layout.items() if name.startswith("Image!")]
    assert {panel["imageTopic"] for panel in panels} == {f"/{name}/video" for name in SCENES}
    for panel in panels:
        assert f"/world/retracks/full/view/image{panel['imageTopic']}" in panel["annotations"]
    with log.read(path) as opened, collected() as warnings:
        views, pictures = pipeline.find_views(opened, "/right")
    assert (pictures, views[0]) == ("/right/video", "/world/retracks/full/view/image/right/video")
    assert "drawing the tracks of /world on /right/video; `topic=` names those of /right" in warnings[0].message


def test_links_are_to_events_of_the_scene_as_its_ids_are_those_on_the_pictures(path: Path, tmp_path: Path) -> None:
    copy = tmp_path / "scene.mcap"
    copy.write_bytes(path.read_bytes())
    for name in ("left", "world"):
        switch = EVENTS.rows(
            kind=[EventKind.SWITCH], track_id=[5], truth_id=[1], previous_id=[2], source_id=[-1], frames=[0]
        )
        how = Provenance("events", {}, f"/{name}/tracks")
        with log.read(copy) as opened:
            write_with_views(
                opened, f"/{name}", {f"/{name}/tracks/events": Made.of(EVENTS, [Frame(NS, 1, switch)], how)}
            )
    with log.read(copy) as opened:
        assert {"/left/tracks/events", "/world/tracks/events"} <= set(opened.channels)
        assert [moment.topic for moment in find_moments(opened)] == ["/world/tracks"]


@given(st.tuples(*[st.floats(-50, 50)] * 2, st.floats(-360, 360)), st.lists(st.tuples(*[st.floats(-99, 99)] * 2)))
def test_places_before_a_camera_are_placed_back(
    pose: tuple[float, float, float], points: list[tuple[float, float]]
) -> None:
    at = np.array(points).reshape(-1, 2)
    assert np.allclose(Pose(*pose).placed(Pose(*pose).seen(at)), at, atol=1e-9)


def test_the_demonstration_of_three_cameras_draws_and_ingests_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def short(seed: int) -> dict[str, SyntheticScene]:
        people = (Pedestrian(1, ((0.0, 0.0, 12.0), (9.0, 0.5, 12.0))),)
        return {name: replace(one, seconds=0.4, people=people) for name, one in three_cameras(seed).items()}

    def stop(*_: object, **__: object) -> None:
        raise McaptrackError("it is drawn")

    monkeypatch.setitem(PLACES, "three-cameras", short)
    monkeypatch.setattr(demonstration, "run", stop)
    with collected(), pytest.raises(McaptrackError, match="it is drawn"):
        mcaptrack.demo(tmp_path, scene="three-cameras", seed=4)
    with log.read(tmp_path / "demo.mcap") as opened:
        names = {"/world/truth", *(f"/{name}/{part}" for name in SCENES for part in ("video", "ground_plane"))}
        assert names <= opened.channels.keys()
        assert opened.channels["/left/video"].messages == 4
        chosen = choose_cameras(opened)
    assert chosen is not None
    assert (chosen.prefixes, dict(chosen.left_out)) == (("/back", "/left", "/right"), {})


class TestOnOnePicture:
    """Tracks of a scene on the pictures of one camera, row by row; 1 px is 1 cm, and people are 100 px high there."""

    PLANE = GroundPlane((0.01, 0, 0, 0, 0.01, 0, 0, 0, 1), 640, 480)
    VIEW = CameraView(name="b", planes=((0, PLANE),), heights=(0.0, 0.0, 100.0))
    #: In metres; three are at an edge, of which a little more than half, and less, is in the picture; one is far away.
    PLACES = np.array(
        [[1.0, 2.0], [3.0, 2.0], [5.0, 3.0], [0.01, 4.0], [-0.01, 0.7], [2.0, 0.51], [3.0, 5.31], [90.0, 2.0]]
    )

    @classmethod
    def scene(cls, seed: int) -> tuple[list[Frame], SceneOnPictures, SceneCamera]:
        rng = np.random.default_rng(seed)
        tracks, detections, sightings, boxes = [], [], [], []
        for n in range(8):
            t_ns, picture_ns = n * NS, n * NS + (40_000_000 if n != 4 else -1_200_000_000)
            ids = rng.permutation(len(cls.PLACES))
            x, y = cls.PLACES[ids].T
            rows = TRACKS.rows(
                track_id=ids, class_id=np.where(ids == 2, 3, 1), x_m=x, y_m=y, observed=ids != 1,
                source_id=[-1] * len(ids),
            )  # fmt: skip
            tracks.append(Frame(t_ns, n + 7, rows))
            if n == 6:
                continue  # nothing was fused at that time
            there = rng.permutation([0, 1, 2, 3, 5])
            at = cls.PLACES[there] + rng.uniform(-0.3, 0.3, (len(there), 2))
            found = DETECTIONS.rows(x_m=at[:, 0], y_m=at[:, 1], score=[0.9] * len(there), class_id=[1] * len(there))
            detections.append(Frame(t_ns, n, found))
            count = len(there) + 1
            own = SIGHTINGS.empty(2 * count)
            own["camera"] = np.repeat([0, 1], count) if n != 2 else 0  # nothing of this camera in one of them
            own["picture_ns"] = np.where(own["camera"] == 1, picture_ns, t_ns)
            own["box_row"] = np.tile(rng.permutation(count), 2)
            own["detection"] = np.tile([-1, *range(len(there))], 2)
            own["detection"][count + 1] = -1  # the first detection has no box of this camera
            sightings.append(Frame(t_ns, n, own))
            px = rng.uniform(10, 90, (4, count))
            names = ("x_px", "y_px", "w_px", "h_px")
            boxes.append(
                Frame(
                    picture_ns,
                    n,
                    DETECTIONS.rows(**dict(zip(names, px, strict=True)), score=[0.5] * count, class_id=[1] * count),
                )
            )
        boxes.sort(key=lambda frame: frame.t_ns)
        clock = PictureClock("/b/video", np.arange(8) * NS, np.arange(8) * NS)
        camera = SceneCamera(1, clock, cls.VIEW, boxes, 40_000_000)
        return tracks, SceneOnPictures(detections, sightings), camera

    @classmethod
    def slowly(cls, tracks: list[Frame], scene: SceneOnPictures, camera: SceneCamera, is_true: bool) -> list[tuple]:
        out, last_ns = [], -1
        for frame in tracks:
            t_ns, own = frame.t_ns + camera.late_ns, {}
            for number, found in enumerate(scene._detections if not is_true else ()):
                seen = scene._sightings[number].rows
                seen = seen[seen["camera"] == 1]
                if found.t_ns != frame.t_ns or not len(seen):
                    continue
                t_ns = int(seen["picture_ns"][0])
                picture = next(one for one in camera.boxes if one.t_ns == t_ns).rows
                for row in frame.rows:
                    away = np.hypot(found.rows["x_m"] - row["x_m"], found.rows["y_m"] - row["y_m"])
                    used = seen[seen["detection"] == away.argmin()]
                    if row["observed"] and row["class_id"] == 1 and away.min() <= 1 and len(used):
                        box = picture[used["box_row"][0]]
                        own[int(row["track_id"])] = [float(box[name]) for name in ("x_px", "y_px", "w_px", "h_px")]
            if t_ns <= last_ns:
                continue
            last_ns, rows = t_ns, []
            for row in frame.rows:
                one = int(row["track_id"])
                x, y = 100 * row["x_m"], 100 * row["y_m"]
                wide, high = min(x + 20, 640) - max(x - 20, 0), min(y, 480) - max(y - 100, 0)
                observed = bool(row["observed"]) if is_true else one in own
                if one in own or (wide > 20 and high > 50):
                    rows.append((one, observed, own.get(one, [x - 20, y - 100, 40.0, 100.0])))
            out.append((t_ns, frame.index, rows))
        return out

    @pytest.mark.parametrize("part_rows", [1 << 16, 9])
    @pytest.mark.parametrize("is_true", [False, True])
    def test_boxes_are_those_of_the_camera_or_of_who_stands_there(
        self, is_true: bool, part_rows: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("mcaptrack.schema.framing.PART_ROWS", part_rows)
        for seed in range(3):
            tracks, scene, camera = self.scene(seed)
            frames, planes = scene.on_camera(camera, TRACKS, tracks, is_true)
            assert planes == self.VIEW.planes
            wanted = self.slowly(tracks, scene, camera, is_true)
            assert [(frame.t_ns, frame.index) for frame in frames] == [one[:2] for one in wanted]
            assert len(wanted) == (8 if is_true else 7)  # one picture is older than the one before it
            for frame, (_, _, rows) in zip(frames, wanted, strict=True):
                assert [(int(row["track_id"]), bool(row["observed"])) for row in frame.rows] == [
                    one[:2] for one in rows
                ]
                px = np.array([frame.rows[name] for name in ("x_px", "y_px", "w_px", "h_px")]).T
                np.testing.assert_allclose(px, [box for *_, box in rows], atol=1e-4)

    def test_without_heights_nobody_is_drawn_where_the_camera_has_no_box(self) -> None:
        tracks, scene, camera = self.scene(1)
        view = replace(self.VIEW, heights=None)
        frames, _ = scene.on_camera(replace(camera, view=view), TRACKS, tracks, is_true=False)
        assert all(frame.rows["observed"].all() for frame in frames)
        assert sum(len(frame.rows) for frame in frames) > 5
