"""KITTI tracking, nuScenes and Argoverse 2, against rotations of SciPy and numbers by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather
from scipy.spatial.transform import Rotation

import mcaptrack
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.boxes import ORIENTED_COLUMNS, bev_corners, columns_to_oriented_boxes
from mcaptrack.sources.ingest.labels.reading import is_3d, read_labels
from tests.test_label_bounds_3d import turned
from tests.test_labels_3d import T0, ingested


def kitti(frame: int, track: int, kind: str, *place: float) -> str:
    """height width length x y z rotation"""
    return f"{frame} {track} {kind} 0 0 -10 1 2 3 4 {' '.join(map(str, place))}"


def devkit_corners(height, width, length, x, y, z, rotation) -> np.ndarray:
    """The corners in the camera's frame, as KITTI's readme has them: object coordinates, rotated about y, moved."""
    half_l, half_w = length / 2, width / 2
    own = [(a * half_l, b, c * half_w) for a in (1, -1) for b in (0, -height) for c in (1, -1)]
    cos, sin = math.cos(rotation), math.sin(rotation)
    return np.array([(cos * u + sin * w + x, v + y, -sin * u + cos * w + z) for u, v, w in own])


def test_kitti_boxes_have_the_same_corners_with_z_up(tmp_path):
    rng = np.random.default_rng(1)
    boxes = np.column_stack(
        [
            rng.uniform(0.5, 4, (6, 3)),
            rng.uniform(-20, 20, 6),
            rng.uniform(0, 2, 6),
            rng.uniform(5, 60, 6),
            rng.uniform(-3, 3, 6),
        ]
    )
    path = tmp_path / "0001.txt"
    lines = [kitti(k // 3, k % 3, ("Car", "Pedestrian", "Van")[k % 3], *box) for k, box in enumerate(boxes)]
    path.write_text(
        "\n".join(
            [*lines, *[f"{frame} -1 DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10" for frame in (1, 2)]]
        )
    )
    result, found, metadata = ingested(path, label_format="kitti-3d", fps=10)
    assert found.t_ns.tolist() == [0, 100_000_000, 200_000_000]
    assert np.diff(found.ends).tolist() == [3, 3, 0]  # a picture with a region alone is labelled, too
    assert json.loads(metadata["mcaptrack.classes"]) == {"1": "Pedestrian", "2": "Car", "3": "Van"}
    assert metadata["mcaptrack.frame_id"] == "camera_link"
    assert "x is forward, y left, z up" in " ".join(result.notes)
    assert "also holds 2 regions (DontCare)" in " ".join(one.message for one in result.warnings)
    ours = columns_to_oriented_boxes(found.rows)
    for box, one in zip(boxes, ours, strict=True):
        corners = [(*xy, one[2] + up * one[5] / 2) for xy in bev_corners(one[None])[0] for up in (1, -1)]
        theirs = [(z, -x, -y) for x, y, z in devkit_corners(*box)]
        np.testing.assert_allclose(
            sorted(map(tuple, np.round(corners, 9))), sorted(map(tuple, np.round(theirs, 9))), atol=1e-6
        )
    # An object that faces away from the camera moves forward.
    assert ours[0, 6] == pytest.approx(math.remainder(-boxes[0, 6] - math.pi / 2, 2 * math.pi))
    with pytest.raises(McaptrackError, match="counts frames and has no clock"):
        mcaptrack.ingest(path, tmp_path / "b.mcap", role="truth", label_format="kitti-3d")


def nuscenes(folder: Path, **changed: object) -> Path:
    """The tables of a scene with two boxes of a car and one of an animal."""
    boxes = [
        {"token": f"a{n}", "sample_token": f"s{n % 2}", "instance_token": f"i{n // 2}", "translation": [n, 2, 3],
         "size": [2, 4, 1.5], "rotation": [1, 0, 0, 0], "num_lidar_pts": n, "num_radar_pts": n // 2}
        for n in range(3)
    ]  # fmt: skip
    tables = {
        "scene": [{"token": "one", "name": "scene-1"}],
        "sample": [{"token": f"s{n}", "timestamp": 100 + n, "scene_token": "one"} for n in range(3)],
        "sample_annotation": boxes,
        "instance": [{"token": f"i{n}", "category_token": f"c{n}"} for n in range(2)],
        "category": [{"token": "c0", "name": "vehicle.car"}, {"token": "c1", "name": "animal"}],
    }
    for table_name, rows in (tables | changed).items():
        (folder / f"{table_name}.json").write_text(json.dumps(rows))
    return folder


BOX = {"token": "a0", "sample_token": "s0", "instance_token": "i0", "translation": [0, 2, 3], "size": [2, 4, 1.5],
       "rotation": [1, 0, 0, 0], "num_lidar_pts": 1, "num_radar_pts": 0}  # fmt: skip
TWO_SCENES = [{"token": "one", "name": "scene-1"}, {"token": "two", "name": "scene-2"}]


def test_a_scene_of_nuscenes(tmp_path):
    rng, start_us = np.random.default_rng(2), 1_533_151_603_547_590
    kinds = ["vehicle.car", "human.pedestrian.adult", "animal"]
    annotations = [
        BOX
        | {
            "token": f"a{n}{k}",
            "sample_token": f"s{n}",
            "instance_token": f"i{k}",
            "translation": rng.uniform(0, 900, 3).tolist(),
            "size": rng.uniform(0.5, 4, 3).tolist(),
            "rotation": Rotation.from_euler("z", rng.uniform(-3, 3)).as_quat()[[3, 0, 1, 2]].tolist(),
            "num_lidar_pts": n,
        }
        for n in (0, 1)
        for k in range(3)
    ]
    samples = [{"token": f"s{n}", "timestamp": start_us + 500_000 * n, "scene_token": "one"} for n in (2, 0, 1)]
    (tmp_path / "v1.0-mini").mkdir()
    nuscenes(
        tmp_path / "v1.0-mini",
        scene=TWO_SCENES,
        sample=[*samples, {"token": "x", "timestamp": 1, "scene_token": "two"}],
        sample_annotation=[*annotations, annotations[0] | {"sample_token": "x"}],
        instance=[{"token": f"i{k}", "category_token": f"c{k}"} for k in range(3)],
        category=[{"token": f"c{k}", "name": kind} for k, kind in enumerate(kinds)],
    )
    result, found, metadata = ingested(tmp_path, scene="scene-1")
    assert found.t_ns.tolist() == [1000 * start_us + 500_000_000 * n for n in range(3)]
    assert np.diff(found.ends).tolist() == [2, 2, 0]
    assert json.loads(metadata["mcaptrack.classes"]) == {"1": "pedestrian", "2": "car"}
    assert metadata["mcaptrack.frame_id"] == "map"
    assert "also holds 2 animal" in " ".join(one.message for one in result.warnings)
    assert "3 of 6 boxes have no points of lidar or radar" in " ".join(result.notes)
    wanted = [one for one in annotations if one["instance_token"] != "i2"]
    for row, one in zip(found.rows, wanted, strict=True):
        assert [row[name] for name in ORIENTED_COLUMNS[:3]] == one["translation"]
        assert [row["width_m"], row["length_m"], row["height_m"]] == one["size"]
        forward = Rotation.from_quat(np.array(one["rotation"])[[1, 2, 3, 0]]).apply([1, 0, 0])
        assert row["heading_rad"] == pytest.approx(math.atan2(forward[1], forward[0]))
    _, found, _ = ingested(tmp_path, scene="scene-1", classes="all")
    assert len(found.rows) == 6


def test_categories_of_nuscenes_have_the_classes_of_its_tasks(tmp_path):
    categories = [*NUSCENES_CLASSES, *WITHOUT_CLASS]
    source = nuscenes(
        tmp_path,
        category=[{"token": f"c{k}", "name": name} for k, name in enumerate(categories)],
        instance=[{"token": f"i{k}", "category_token": f"c{k}"} for k in range(len(categories))],
        sample_annotation=[BOX | {"token": f"a{k}", "instance_token": f"i{k}"} for k in range(len(categories))],
    )
    _, found, metadata = ingested(source, scene="scene-1", classes="all")
    names = {int(number): name for number, name in json.loads(metadata["mcaptrack.classes"]).items()}
    order = np.argsort(found.rows["track_id"])
    called = [names[number] for number in found.rows["class_id"][order].tolist()]
    assert called == [*NUSCENES_CLASSES.values(), *WITHOUT_CLASS]
    _, found, _ = ingested(source, scene="scene-1")
    assert len(found.rows) == len(NUSCENES_CLASSES)


@pytest.mark.parametrize(
    ("scene", "changed", "words"),
    [
        ("scene-9", {"scene": TWO_SCENES}, "has no scene 'scene-9'; choose one with `scene=`: scene-1, scene-2"),
        ("scene-1", {"category": {}}, "category.json is not a table of nuScenes"),
        ("scene-1", {"sample": []}, "the scene has no samples"),
        ("scene-1", {"sample_annotation": []}, "the scene has no boxes"),
    ],
)  # fmt: skip
def test_tables_of_nuscenes_that_cannot_be_read(scene, changed, words, tmp_path):
    with pytest.raises(McaptrackError, match=words):
        mcaptrack.ingest(nuscenes(tmp_path, **changed), tmp_path / "log.mcap", role="truth", scene=scene)


def quaternions(rotations: Rotation) -> dict[str, np.ndarray]:
    return dict(zip(("qx", "qy", "qz", "qw"), rotations.as_quat().T, strict=True))


def argoverse(folder: Path, **changed: object) -> Path:
    columns = {
        "timestamp_ns": [5, 5, 9],
        "track_uuid": ["b", "a", "b"],
        "category": ["BUS", "PEDESTRIAN", "BUS"],
        **{f"{name}_m": [4.0, 1.0, 4.0] for name in ("length", "width", "height")},
        **dict(zip(("qw", "qx", "qy", "qz"), np.tile(turned(z=90), (3, 1)).T.tolist(), strict=True)),
        **{name: [1.0, 2.0, 3.0] for name in ("tx_m", "ty_m", "tz_m")},
    }
    feather.write_feather(pa.table(columns | changed), folder / "annotations.feather")
    return folder


def poses(folder: Path, t_ns: list[int], quaternions: list[np.ndarray], x_m: list[float]) -> None:
    columns = {"timestamp_ns": t_ns, "tx_m": x_m, "ty_m": [0.0] * len(t_ns), "tz_m": [0.0] * len(t_ns)}
    columns |= dict(zip(("qw", "qx", "qy", "qz"), np.reshape(quaternions, (-1, 4)).T.tolist(), strict=True))
    feather.write_feather(pa.table(columns), folder / "city_SE3_egovehicle.feather")


def test_a_log_of_argoverse_in_the_citys_frame(tmp_path):
    folder, rng = tmp_path / "log", np.random.default_rng(3)
    folder.mkdir()
    boxes = {
        "timestamp_ns": T0 + 100_000_000 * np.arange(5),
        "track_uuid": [f"{k % 2}-b7" for k in range(5)],
        "category": [("REGULAR_VEHICLE", "PEDESTRIAN")[k % 2] for k in range(5)],
        **{name: rng.uniform(1, 5, 5) for name in ("length_m", "width_m", "height_m")},
        **quaternions(Rotation.from_euler("z", rng.uniform(-3, 3, (5, 1)))),
        **{name: rng.uniform(-50, 50, 5) for name in ("tx_m", "ty_m", "tz_m")},
        "num_interior_pts": np.arange(5),
    }
    argoverse(folder, **boxes)
    result, found, metadata = ingested(folder)
    assert metadata["mcaptrack.frame_id"] == "base_link"
    assert found.rows["x_m"].tolist() == boxes["tx_m"].tolist()
    assert found.rows["track_id"].tolist() == [1, 2, 1, 2, 1]
    assert "boxes stay in the vehicle's frame" in " ".join(result.notes)
    rng = np.random.default_rng(4)
    turn = Rotation.from_euler("zyx", np.column_stack([rng.uniform(-3, 3, 7), rng.uniform(-0.05, 0.05, (7, 2))]))
    moved = rng.uniform(-900, 900, (7, 3))
    order = rng.permutation(7)
    moves = {"timestamp_ns": (T0 + 100_000_000 * np.arange(-1, 6))[order]} | {
        name: 1.03 * values for name, values in quaternions(turn[order]).items()
    }
    moves |= dict(zip(("tx_m", "ty_m", "tz_m"), moved[order].T, strict=True))
    feather.write_feather(pa.table(moves), folder / "city_SE3_egovehicle.feather")
    _, found, metadata = ingested(folder / "annotations.feather")
    assert metadata["mcaptrack.frame_id"] == "map"
    place = np.stack([boxes[name] for name in ("tx_m", "ty_m", "tz_m")], axis=1)
    own = Rotation.from_quat(np.stack([boxes[name] for name in ("qx", "qy", "qz", "qw")], axis=1))
    np.testing.assert_allclose(
        columns_to_oriented_boxes(found.rows)[:, :3], turn[1:6].apply(place) + moved[1:6], atol=1e-9
    )
    forward = (turn[1:6] * own).apply([1, 0, 0])
    np.testing.assert_allclose(found.rows["heading_rad"], np.arctan2(forward[:, 1], forward[:, 0]), atol=1e-9)


def test_tables_of_argoverse_that_cannot_be_read(tmp_path):
    path = tmp_path / "annotations.feather"
    for content, words in ((b"ARROW1\0\0 and so on", "is no table in Feather format"), (b"", "is no table in Feather")):
        path.write_bytes(content)
        with pytest.raises(McaptrackError, match=words):
            mcaptrack.ingest(path, tmp_path / "log.mcap", role="truth")
    feather.write_feather(pa.table({"timestamp_ns": [1]}), path)
    with pytest.raises(
        McaptrackError, match="has no column track_uuid, as Argoverse 2 has; its columns are timestamp_ns"
    ):
        mcaptrack.ingest(path, tmp_path / "log.mcap", role="truth")


def test_boxes_of_argoverse_without_a_category_have_no_class(tmp_path):
    argoverse(tmp_path, category=[None, "PEDESTRIAN", None])
    result, found, metadata = ingested(tmp_path / "annotations.feather")
    assert "None" not in metadata["mcaptrack.classes"]
    assert (found.rows["class_id"] == 0).tolist() == [True, False, True]
    assert "2 boxes without a class have class_id 0" in " ".join(one.message for one in result.warnings)


def test_folders_of_data_sets_without_labels_are_named(tmp_path):
    argoverse(tmp_path)
    (tmp_path / "annotations.feather").rename(tmp_path / "city_SE3_egovehicle.feather")
    with pytest.raises(McaptrackError, match=r"has no annotations\.feather: it is a log of Argoverse 2 without labels"):
        ingested(tmp_path)
    (tmp_path / "city_SE3_egovehicle.feather").unlink()
    (tmp_path / "v1.0-mini").mkdir()
    (nuscenes(tmp_path / "v1.0-mini") / "sample_annotation.json").unlink()
    with pytest.raises(McaptrackError, match=r"has no sample_annotation\.json: it is a set without labels; nuScenes"):
        ingested(tmp_path, scene="scene-1")


# Up to the bounds of what the files may hold


def kitti_file(*lines: str, folder: Path) -> Path:
    path = folder / "0001.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


CAR = "3 7 Car 0 0 -10 1 2 3 4 1.5 2 4 3 1.25 9 0.5"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (" ".join(CAR.split()[:16]), "0001.txt:2: not KITTI tracking (frame id type "),
        (f"{CAR} 1 2", "score), 19 columns: 3 7 Car"),
        (CAR.replace("3 7", "-1 7"), "0001.txt:2: the frame (a count of pictures, no time) has to be a whole number from 0 to"),
        (CAR.replace("3 7", "3 -2"), "0001.txt:2: the id has to be a whole number from -1 to 9007199254740991, not -2"),
        (CAR.replace("1.25 9", "nan 9"), "0001.txt:2: a number of the box is missing or not finite"),
    ],
)  # fmt: skip
def test_lines_of_kitti_that_cannot_be_read(line, words, tmp_path):
    with pytest.raises(McaptrackError) as refused:
        read_labels(kitti_file(CAR, line, folder=tmp_path), "kitti-3d", "detections")
    assert words in str(refused.value)


@pytest.mark.parametrize("place", [10, 11, 12])
def test_a_row_of_kitti_without_a_size_is_left_out(place, tmp_path):
    flat = CAR.split()
    flat[place] = "0"
    region = CAR.replace("Car", "dontcare").replace("3 7", "4 -1")
    path = kitti_file(" ".join(flat), region, CAR.replace("Car", "Van"), region, folder=tmp_path)
    rows = read_labels(path, "kitti-3d", "truth")
    assert rows.left_out == "2 regions (DontCare) and 1 rows without a 3D box"
    assert rows.at(0) == f"{path}:3"
    assert rows.classes == {2: "Van"}
    assert rows.labelled.tolist() == [3, 4]
    with pytest.raises(McaptrackError, match=r"0001\.txt holds no 3D boxes$"):
        read_labels(kitti_file(" ".join(flat), region, folder=tmp_path), "kitti-3d", "truth")
    with pytest.raises(McaptrackError, match="holds no 3D boxes"):
        read_labels(kitti_file("", folder=tmp_path), "kitti-3d", "truth")


@pytest.mark.parametrize("points", [(0, 1), (1, 0), (None, 0), (1, None)])
def test_a_box_with_points_of_one_sensor_is_seen(points, tmp_path):
    lidar, radar = points
    boxes = [BOX | {"num_lidar_pts": lidar, "num_radar_pts": radar}]
    assert "points of lidar" not in " ".join(
        read_labels(nuscenes(tmp_path, sample_annotation=boxes), role="truth").remarks
    )


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"scene": [{"token": "one"}]}, "scene.json: a row has no name: {'token': 'one'}"),
        ({"scene": [{"name": "x", "token": 5}]}, "scene.json: a row has no token"),
        ({"sample": [{"timestamp": 1, "scene_token": "one"}]}, "sample.json: a row has no token"),
        ({"sample": [{"token": "s", "timestamp": True, "scene_token": "one"}]}, "sample.json: timestamp has to be a whole number, not 'True'"),
        ({"category": [{"token": "c0"}]}, "category.json: a row has no name"),
        ({"instance": [{"token": "i0"}]}, "instance.json: a row has no category_token"),
        ({"sample_annotation": [{**BOX, "token": 1}]}, "sample_annotation.json: a row has no token"),
        ({"sample_annotation": [{**BOX, "instance_token": None}]}, "sample_annotation.json: a row has no instance_token"),
        ({"sample_annotation": [{**BOX, "instance_token": "i9"}]}, "annotation a0 is of an instance without a category"),
        ({"sample_annotation": [{**BOX, "size": [1, 2]}]}, "size has to be 3 numbers, not [1, 2]"),
        ({"sample_annotation": [{**BOX, "translation": [1, 2, True]}]}, "translation has to be 3 numbers, not [1, 2, True]"),
        ({"sample_annotation": [{**BOX, "rotation": "1000"}]}, "rotation has to be 4 numbers, not 1000"),
        ({"sample_annotation": [{**BOX, "rotation": [2, 0, 0, 0]}]}, "annotation a0: a quaternion of length 2 is no rotation"),
        ({"sample_annotation": [1]}, "sample_annotation.json is not a table of nuScenes, a list of objects"),
    ],
)  # fmt: skip
def test_tables_of_nuscenes_are_refused_with_their_name(changed, words, tmp_path):
    with pytest.raises(McaptrackError) as refused:
        read_labels(nuscenes(tmp_path, **changed), role="truth")
    assert words in str(refused.value)


def test_the_folder_of_nuscenes_holds_one_set_of_tables(tmp_path):
    for name in ("v1.0-mini", "v1.0-test"):
        (tmp_path / name).mkdir()
    nuscenes(tmp_path / "v1.0-test")
    assert is_3d(tmp_path)
    assert len(read_labels(tmp_path, role="truth", scene="scene-1").boxes_m) == 2
    nuscenes(tmp_path / "v1.0-mini")
    with pytest.raises(McaptrackError, match=r"several sets of tables, v1\.0-mini, v1\.0-test; give the folder of one"):
        read_labels(tmp_path, role="truth")
    (tmp_path / "v1.0-mini" / "category.json").unlink()
    with pytest.raises(McaptrackError, match=r"v1\.0-mini has no category\.json; nuScenes boxes need scene, sample, "):
        read_labels(tmp_path / "v1.0-mini", role="truth")
    (tmp_path / "v1.0-mini" / "category.json").write_text("{")
    with pytest.raises(McaptrackError, match=r"category\.json is not valid JSON"):
        read_labels(tmp_path / "v1.0-mini", role="truth")


def test_boxes_of_argoverse_by_hand(tmp_path):
    rows = read_labels(argoverse(tmp_path), role="truth")
    np.testing.assert_allclose(rows.boxes_m[1], [2, 2, 2, 1, 1, 1, math.pi / 2])
    assert (rows.frame.tolist(), rows.id.tolist(), rows.labelled.tolist()) == ([5, 5, 9], [1, 2, 1], [5, 9])
    assert rows.classes == {1: "PEDESTRIAN", 2: "BUS"}
    # A pose of another length is the same rotation; of two poses at one time the first is taken.
    poses(tmp_path, [5, 9, 5], [turned(z=90) * 2, turned(), turned(z=10)], [100.0, 0.0, 7.0])
    rows = read_labels(tmp_path, role="truth")
    np.testing.assert_allclose(rows.boxes_m[:, :3], [[99, 1, 1], [98, 2, 2], [3, 3, 3]], atol=1e-12)
    np.testing.assert_allclose(np.abs(rows.boxes_m[:, 6]), [math.pi, math.pi, math.pi / 2])


@pytest.mark.parametrize("t_ns", [[], [4], [10], [5, 6]])
def test_a_time_without_a_pose_is_refused(t_ns, tmp_path):
    poses(argoverse(tmp_path), t_ns, [turned()] * len(t_ns), [0.0] * len(t_ns))
    count, first = (1, 9) if 5 in t_ns else (2, 5)
    with pytest.raises(McaptrackError, match=f"has no pose at {count} times of boxes, the first {first} ns$"):
        read_labels(tmp_path, role="truth")


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"timestamp_ns": [5.0, 6.0, 7.0]}, "annotations.feather: timestamp_ns has to be whole numbers"),
        ({"timestamp_ns": ["5", "6", "7"]}, "timestamp_ns has to be whole numbers"),
        ({"timestamp_ns": [5, 5, -1]}, "annotations.feather: row 3: times have to lie between 1970 and 2262"),
        ({"tx_m": ["a", "b", "c"]}, "annotations.feather: tx_m, ty_m, tz_m have to be numbers"),
        ({"track_uuid": ["b", None, "b"]}, "annotations.feather: row 2 has no track_uuid"),
        ({"length_m": [1.0, None, 2.0]}, "annotations.feather: row 2: a number of the box is missing or not finite"),
        ({"qw": [1.0, 5.0, 1.0]}, "annotations.feather: row 2: a quaternion of length 5.04975 is no rotation"),
        ({"qw": [0.0] * 3, "qz": [0.0] * 3, "qx": [1.0] * 3}, "z of the boxes is 180 degrees from up; it has to be up"),
    ],
)
def test_tables_of_argoverse_that_hold_no_boxes(changed, words, tmp_path):
    if "qw" in changed and "qz" not in changed:
        changed = changed | {"qz": [0.0, 0.5**0.5, 0.0]}
    with pytest.raises(McaptrackError) as refused:
        read_labels(argoverse(tmp_path, **changed), role="truth")
    assert words in str(refused.value)


def test_formats_in_space_are_known_by_their_names(tmp_path):
    (tmp_path / "annotations.feather").write_bytes(b"")
    assert is_3d(tmp_path)
    assert is_3d(tmp_path / "annotations.feather")
    assert not is_3d(tmp_path, "mot")
    assert is_3d(tmp_path / "annotations.feather", "kitti-3d")


#: The classes of the detection task as nuScenes defines them; other categories have no class.
NUSCENES_CLASSES = {
    "movable_object.barrier": "barrier",
    "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.car": "car",
    "vehicle.construction": "construction_vehicle",
    "vehicle.motorcycle": "motorcycle",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "movable_object.trafficcone": "traffic_cone",
    "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
}


WITHOUT_CLASS = ("animal", "human.pedestrian.stroller", "vehicle.emergency.police", "static_object.bicycle_rack")
