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
from mcaptrack.geometry.oriented_boxes import COLUMNS, bev_corners, columns_to_oriented_boxes
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


def nuscenes(folder: Path, **changed) -> tuple[Path, list[dict]]:
    rng = np.random.default_rng(2)
    samples = [
        {"token": f"s{n}", "timestamp": 1_533_151_603_547_590 + 500_000 * n, "scene_token": "one"} for n in (2, 0, 1)
    ]
    kinds = ["vehicle.car", "human.pedestrian.adult", "animal"]
    annotations = [
        {
            "token": f"a{n}{k}",
            "sample_token": f"s{n}",
            "instance_token": f"i{k}",
            "visibility_token": "4",
            "translation": rng.uniform(0, 900, 3).tolist(),
            "size": rng.uniform(0.5, 4, 3).tolist(),
            "rotation": Rotation.from_euler("z", rng.uniform(-3, 3)).as_quat()[[3, 0, 1, 2]].tolist(),
            "num_lidar_pts": n,
            "num_radar_pts": 0,
        }
        for n in (0, 1)
        for k in range(3)
    ]
    tables = {
        "scene": [{"token": "one", "name": "scene-0061"}, {"token": "two", "name": "scene-0103"}],
        "sample": [*samples, {"token": "x", "timestamp": 1, "scene_token": "two"}],
        "sample_annotation": [*annotations, annotations[0] | {"sample_token": "x"}],
        "instance": [{"token": f"i{k}", "category_token": f"c{k}"} for k in range(3)],
        "category": [{"token": f"c{k}", "name": kind} for k, kind in enumerate(kinds)],
    } | changed
    place = folder / "v1.0-mini"
    place.mkdir(exist_ok=True)
    for name, rows in tables.items():
        (place / f"{name}.json").write_text(json.dumps(rows))
    return folder, annotations


def test_a_scene_of_nuscenes(tmp_path):
    source, annotations = nuscenes(tmp_path / "data") if (tmp_path / "data").mkdir() is None else None
    result, found, metadata = ingested(source, scene="scene-0061")
    assert found.t_ns.tolist() == [1_533_151_603_547_590_000 + 500_000_000 * n for n in range(3)]
    assert np.diff(found.ends).tolist() == [2, 2, 0]
    assert json.loads(metadata["mcaptrack.classes"]) == {"1": "pedestrian", "2": "car"}
    assert metadata["mcaptrack.frame_id"] == "map"
    assert "also holds 2 animal" in " ".join(one.message for one in result.warnings)
    assert "3 of 6 boxes have no points of lidar or radar" in " ".join(result.notes)
    wanted = [one for one in annotations if one["instance_token"] != "i2"]
    for row, one in zip(found.rows, wanted, strict=True):
        assert [row[name] for name in COLUMNS[:3]] == one["translation"]
        assert [row["width_m"], row["length_m"], row["height_m"]] == one["size"]
        forward = Rotation.from_quat(np.array(one["rotation"])[[1, 2, 3, 0]]).apply([1, 0, 0])
        assert row["heading_rad"] == pytest.approx(math.atan2(forward[1], forward[0]))
    _, found, _ = ingested(source, scene="scene-0061", classes="all")
    assert len(found.rows) == 6


def test_categories_of_nuscenes_have_the_classes_of_its_tasks(tmp_path):
    categories = [*NUSCENES_CLASSES, *WITHOUT_CLASS]
    (tmp_path / "data").mkdir()
    _, (first, *_) = nuscenes(tmp_path / "data")
    source, _ = nuscenes(
        tmp_path / "data",
        category=[{"token": f"c{k}", "name": name} for k, name in enumerate(categories)],
        instance=[{"token": f"i{k}", "category_token": f"c{k}"} for k in range(len(categories))],
        sample_annotation=[first | {"token": f"a{k}", "instance_token": f"i{k}"} for k in range(len(categories))],
    )
    _, found, metadata = ingested(source, scene="scene-0061", classes="all")
    names = {int(number): name for number, name in json.loads(metadata["mcaptrack.classes"]).items()}
    order = np.argsort(found.rows["track_id"])
    called = [names[number] for number in found.rows["class_id"][order].tolist()]
    assert called == [*NUSCENES_CLASSES.values(), *WITHOUT_CLASS]
    _, found, _ = ingested(source, scene="scene-0061")
    assert len(found.rows) == len(NUSCENES_CLASSES)


@pytest.mark.parametrize(
    ("scene", "changed", "words"),
    [
        ("scene-9", {}, "has no scene 'scene-9'; choose one with `scene=`: scene-0061, scene-0103"),
        ("scene-0061", {"category": {}}, "category.json is not a table of nuScenes"),
        ("scene-0061", {"sample": []}, "the scene has no samples"),
        ("scene-0061", {"sample_annotation": []}, "the scene has no boxes"),
    ],
)  # fmt: skip
def test_tables_of_nuscenes_that_cannot_be_read(scene, changed, words, tmp_path):
    (tmp_path / "data").mkdir()
    source, _ = nuscenes(tmp_path / "data", **changed)
    with pytest.raises(McaptrackError, match=words.replace("(", r"\(")):
        mcaptrack.ingest(source, tmp_path / "log.mcap", role="truth", scene=scene)


def quaternions(rotations: Rotation) -> dict[str, np.ndarray]:
    return dict(zip(("qx", "qy", "qz", "qw"), rotations.as_quat().T, strict=True))


def argoverse(folder: Path, count: int = 5) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(3)
    columns = {
        "timestamp_ns": T0 + 100_000_000 * np.arange(count),
        "track_uuid": [f"{k % 2}-b7" for k in range(count)],
        "category": [("REGULAR_VEHICLE", "PEDESTRIAN")[k % 2] for k in range(count)],
        **{name: rng.uniform(1, 5, count) for name in ("length_m", "width_m", "height_m")},
        **quaternions(Rotation.from_euler("z", rng.uniform(-3, 3, (count, 1)))),
        **{name: rng.uniform(-50, 50, count) for name in ("tx_m", "ty_m", "tz_m")},
        "num_interior_pts": np.arange(count),
    }
    feather.write_feather(pa.table(columns), folder / "annotations.feather")
    return columns


def test_a_log_of_argoverse_in_the_citys_frame(tmp_path):
    folder = tmp_path / "log"
    folder.mkdir()
    boxes = argoverse(folder)
    result, found, metadata = ingested(folder)
    assert metadata["mcaptrack.frame_id"] == "base_link"
    assert found.rows["x_m"].tolist() == boxes["tx_m"].tolist()
    assert found.rows["track_id"].tolist() == [1, 2, 1, 2, 1]
    assert "boxes stay in the vehicle's frame" in " ".join(result.notes)
    rng = np.random.default_rng(4)
    turn = Rotation.from_euler("zyx", np.column_stack([rng.uniform(-3, 3, 7), rng.uniform(-0.05, 0.05, (7, 2))]))
    moved = rng.uniform(-900, 900, (7, 3))
    order = rng.permutation(7)
    poses = {"timestamp_ns": (T0 + 100_000_000 * np.arange(-1, 6))[order]} | {
        name: 1.03 * values for name, values in quaternions(turn[order]).items()
    }
    poses |= dict(zip(("tx_m", "ty_m", "tz_m"), moved[order].T, strict=True))
    feather.write_feather(pa.table(poses), folder / "city_SE3_egovehicle.feather")
    _, found, metadata = ingested(folder / "annotations.feather")
    assert metadata["mcaptrack.frame_id"] == "map"
    place = np.stack([boxes[name] for name in ("tx_m", "ty_m", "tz_m")], axis=1)
    own = Rotation.from_quat(np.stack([boxes[name] for name in ("qx", "qy", "qz", "qw")], axis=1))
    np.testing.assert_allclose(
        columns_to_oriented_boxes(found.rows)[:, :3], turn[1:6].apply(place) + moved[1:6], atol=1e-9
    )
    forward = (turn[1:6] * own).apply([1, 0, 0])
    np.testing.assert_allclose(found.rows["heading_rad"], np.arctan2(forward[:, 1], forward[:, 0]), atol=1e-9)
    poses["timestamp_ns"] = poses["timestamp_ns"] + 1
    feather.write_feather(pa.table(poses), folder / "city_SE3_egovehicle.feather")
    with pytest.raises(McaptrackError, match=f"has no pose at 5 times of boxes, the first {T0} ns"):
        ingested(folder / "annotations.feather")


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
    boxes = argoverse(tmp_path)
    boxes["category"] = ["REGULAR_VEHICLE", None, "PEDESTRIAN", None, "BUS"]
    path = tmp_path / "annotations.feather"
    feather.write_feather(pa.table(boxes), path)
    result, found, metadata = ingested(path)
    assert "None" not in metadata["mcaptrack.classes"]
    assert (found.rows["class_id"] == 0).tolist() == [False, True, False, True, False]
    assert "2 boxes without a class have class_id 0" in " ".join(one.message for one in result.warnings)
    boxes["track_uuid"][3] = None
    feather.write_feather(pa.table(boxes), path)
    with pytest.raises(McaptrackError, match="row 4 has no track_uuid"):
        ingested(path)


def test_folders_of_data_sets_without_labels_are_named(tmp_path):
    argoverse(tmp_path)
    (tmp_path / "annotations.feather").rename(tmp_path / "city_SE3_egovehicle.feather")
    with pytest.raises(McaptrackError, match=r"has no annotations\.feather: it is a log of Argoverse 2 without labels"):
        ingested(tmp_path)
    source, _ = nuscenes(tmp_path)
    (tmp_path / "city_SE3_egovehicle.feather").unlink()
    (tmp_path / "v1.0-mini" / "sample_annotation.json").unlink()
    with pytest.raises(McaptrackError, match=r"has no sample_annotation\.json: it is a set without labels; nuScenes"):
        ingested(source, scene="scene-0061")


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
