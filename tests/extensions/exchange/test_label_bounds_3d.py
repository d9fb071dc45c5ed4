"""Files of KITTI, nuScenes and Argoverse with boxes in space, up to the bounds of what they may hold."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest.labels.reading import is_3d, read_labels
from tests.test_label_bounds_3d import turned


def kitti(*lines: str, folder: Path) -> Path:
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
        read_labels(kitti(CAR, line, folder=tmp_path), "kitti-3d", "detections")
    assert words in str(refused.value)


@pytest.mark.parametrize("place", [10, 11, 12])
def test_a_row_of_kitti_without_a_size_is_left_out(place, tmp_path):
    flat = CAR.split()
    flat[place] = "0"
    region = CAR.replace("Car", "dontcare").replace("3 7", "4 -1")
    path = kitti(" ".join(flat), region, CAR.replace("Car", "Van"), region, folder=tmp_path)
    rows = read_labels(path, "kitti-3d", "truth")
    assert rows.left_out == "2 regions (DontCare) and 1 rows without a 3D box"
    assert rows.at(0) == f"{path}:3"
    assert rows.classes == {2: "Van"}
    assert rows.labelled.tolist() == [3, 4]
    with pytest.raises(McaptrackError, match=r"0001\.txt holds no 3D boxes$"):
        read_labels(kitti(" ".join(flat), region, folder=tmp_path), "kitti-3d", "truth")
    with pytest.raises(McaptrackError, match="holds no 3D boxes"):
        read_labels(kitti("", folder=tmp_path), "kitti-3d", "truth")


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
       "rotation": [1, 0, 0, 0]}  # fmt: skip


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
