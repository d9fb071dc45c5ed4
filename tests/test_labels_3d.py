"""3D labels: tables, KITTI tracking, nuScenes and Argoverse 2, against rotations of SciPy and numbers by hand."""

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
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.oriented_boxes import COLUMNS, bev_corners, columns_to_oriented_boxes
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.schema.framing import join_frames
from tests.commands import call
from tests.logs import recorder
from tests.space_logs import START_NS, WAYS, Robot, write

T0 = 315_966_253_660_357_001  # a float64 can't hold it
HEADER = "t_ns,id,class,x_m,y_m,z_m,length_m,width_m,height_m,heading_rad,points"
LINES = [
    f"{T0},7,car,10.5,-3,0.25,4.5,2,1.5,3.5,9",
    f"{T0},3,pedestrian,1,2,0.9,0.5,0.6,1.8,0,12",
    f"{T0 + 100_000_001},7,car,11.5,-3.25,0.25,4.5,2,1.5,3.5,9",
    f"{T0 + 100_000_001},4,Truck,20,9,1.5,9,2.5,3,-1,9",
]


def table(folder: Path, *lines: str, header: str = HEADER, name: str = "truth.csv") -> Path:
    path = folder / name
    path.write_text("\n".join([header, *(lines or LINES)]) + "\n")
    return path


def ingested(source: Path, role: str = "truth", **options):
    """The result of ``ingest``, and of the log the rows with their times, the times of frames, and the metadata."""
    result = mcaptrack.ingest(source, source.parent / "log.mcap", role=role, force=True, **options)
    with log.read(result.log) as opened:
        topic = f"/camera/{role}"
        frames = opened.frames(topic, DETECTIONS if role == "detections" else TRACKS)
        return (
            result,
            join_frames(DETECTIONS if role == "detections" else TRACKS, frames),
            opened.channel(topic).metadata,
        )


def test_a_table_is_read_exactly_with_its_classes_and_frame(tmp_path):
    result, found, metadata = ingested(table(tmp_path))
    assert found.t_ns.tolist() == [T0, T0 + 100_000_001]
    assert found.rows["track_id"].tolist() == [3, 7, 4, 7]
    wanted = [[1, 2, 0.9, 0.5, 0.6, 1.8, 0], [10.5, -3, 0.25, 4.5, 2, 1.5, 3.5 - 2 * math.pi]]
    np.testing.assert_allclose(columns_to_oriented_boxes(found.rows)[:2], wanted, atol=1e-15)
    assert np.isnan(found.rows["x_px"]).all()
    assert found.rows["class_id"].tolist() == [1, 2, 3, 2]
    assert json.loads(metadata["mcaptrack.classes"]) == {"1": "pedestrian", "2": "car", "3": "Truck"}
    assert metadata["mcaptrack.frame_id"] == "map"
    assert "not read: points" in " ".join(result.notes)
    assert "frame 'map' (assumed)" in " ".join(one.message for one in result.warnings)
    _, found, metadata = ingested(table(tmp_path), frame="odom", classes="car")
    assert metadata["mcaptrack.frame_id"] == "odom"
    assert found.rows["track_id"].tolist() == [7, 7]
    assert len(found.t_ns) == 2


@pytest.mark.parametrize(
    ("header", "line", "options"),
    [
        ("t,id,label,x,y,z,l,w,h,yaw", "{s},7,car,10.5,-3,0.25,4.5,2,1.5,3.5", {}),
        ("timestamp_us;track_id;tx_m;ty_m;tz_m;length;width;height;heading_deg", "{us};7;10,5;-3;0,25;4,5;2;1,5;200.5352283", {}),
        ("when_ns,who,x [m],y [m],z [m],dx,dy,dz,turn", "{ns},7,10.5,-3,.25,4.5,2,1.5,3.5",
         {"columns": "t=when_ns,id=who,heading_rad=turn"}),
        ("qx,qy,qz,qw,t_ns,track_uuid,x_m,y_m,z_m,length_m,width_m,height_m", "0,0,{qz},{qw},{ns},7,10.5,-3,0.25,4.5,2,1.5", {}),
    ],
)  # fmt: skip
def test_other_headers_and_units(header, line, options, tmp_path):
    values = {"s": "1700000000.123456789", "us": "1700000000123456,789", "ns": 1_700_000_000_123_456_789}
    values |= {"qz": math.sin(1.75), "qw": math.cos(1.75)}
    line = line.format(**values).replace(
        "200.5352283", f"{math.degrees(3.5):.12f}".replace(".", ",") if ";" in line else ""
    )
    _, found, _ = ingested(table(tmp_path, line, header=header), **options)
    assert found.t_ns.tolist() == [1_700_000_000_123_456_789]
    assert found.rows["track_id"].tolist() == [7]
    wanted = [10.5, -3, 0.25, 4.5, 2, 1.5, 3.5 - 2 * math.pi]
    np.testing.assert_allclose(columns_to_oriented_boxes(found.rows)[0], wanted, atol=1e-9)


@pytest.mark.parametrize(
    ("header", "lines", "options", "words"),
    [
        (HEADER.replace("length_m", "length_mm"), LINES, {"columns": "length_m=length_mm"}, "length_mm is not in metres"),
        (HEADER, LINES, {"columns": "x_m=far"}, "no column is named far"),
        (HEADER, LINES, {"columns": "x=x_m,x_m=y_m"}, "names x, and 3D boxes have none"),
        (HEADER, [LINES[0].replace("car", "car,van")], {}, "12 columns, and the header has 11"),
        (HEADER, LINES, {"classes": "bus"}, "has no class 'bus'"),
        (HEADER, LINES, {"scene": "scene-1"}, "`scene=` is for nuScenes, "),
    ],
)  # fmt: skip
def test_what_cannot_be_boxes_in_metres_is_refused_in_one_line(header, lines, options, words, tmp_path):
    path = table(tmp_path, *lines, header=header)
    with pytest.raises(McaptrackError) as error:
        mcaptrack.ingest(path, tmp_path / "log.mcap", role="truth", **options)
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "log.mcap").exists()


def test_rows_without_a_box_are_frames_and_detections_need_no_ids(tmp_path):
    header = "t,class,x_m,y_m,z_m,length_m,width_m,height_m,heading_rad,score,vx,vy"
    lines = ["0.5,car,1,2,3,4,5,6,0.5,0.9,1.5,-2", "0.6,,,,,,,,,,,", "0.7,car,1,2,3,4,5,6,0.5,0.25,,"]
    path = table(tmp_path, *lines, header=header)
    _, found, _ = ingested(path, "detections")
    assert found.t_ns.tolist() == [500_000_000, 600_000_000, 700_000_000]
    assert np.diff(found.ends).tolist() == [1, 0, 1]
    assert found.rows["score"].tolist() == pytest.approx([0.9, 0.25])
    assert found.rows["vx_m_per_s"][0] == 1.5
    assert found.rows["source_id"].tolist() == [-1, -1]
    assert np.isnan(found.rows["vy_m_per_s"][1])


# KITTI


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


# nuScenes


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


# Argoverse 2


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


# Into a log


def test_a_frame_that_the_log_does_not_have_is_named(tmp_path):
    path = write(tmp_path / "robot.mcap", Robot(shots=2), WAYS["scene updates"], "protobuf")
    labels = table(tmp_path, f"{START_NS},3,pedestrian,1,2,0.9,0.5,0.6,1.8,0,4")
    said = []
    for frame in ("nowhere", "base_link", "/map"):
        result = mcaptrack.ingest(labels, into=path, role="truth", frame=frame, force=True)
        said.append([one.message for one in result.warnings if one.code == "transforms"])
    assert said[1:] == [[], []]
    assert len(said[0]) == 1
    assert "there is no frame nowhere in " in said[0][0]
    assert "(but base_link, lidar, map)" in said[0][0]


def test_labels_go_beside_the_boxes_of_a_log(tmp_path):
    boxes = "t,class,x_m,y_m,z_m,length_m,width_m,height_m,heading_rad,score\n"
    (tmp_path / "boxes.csv").write_text(
        boxes + "5.5,car,1,2,0,4,2,1.5,0,0.9\n6.5,car,2,2,0,4,2,1.5,0,0.9\n7.5,,,,,,,,,\n"
    )
    log = mcaptrack.ingest(tmp_path / "boxes.csv", tmp_path / "log.mcap", role="detections", camera="lidar").log
    frames = table(tmp_path, "0,7,1,2", "2,7,3,2", header="frame,id,x_m,y_m")
    for options, times in (({}, [5.5, 7.5]), ({"fps": 4}, [5.5, 6.0]), ({"fps": 4, "start_time": 6}, [6.0, 6.5])):
        result = mcaptrack.ingest(frames, into=log, role="truth", force=True, **options)
        assert list(result.messages) == ["/lidar/truth"]
        with mcaptrack.open(log) as opened:
            assert [one["t"].timestamp() for one in opened.table("tracks").to_pylist()] == times
    with pytest.raises(McaptrackError, match="its last frame is 5, and /lidar/detections has 3 messages, from frame 1"):
        mcaptrack.ingest(
            table(tmp_path, "1,7,1,2", "5,7,3,2", header="frame,id,x_m,y_m"), into=log, role="truth", force=True
        )
    with pytest.raises(McaptrackError, match="give the time of the first labels with `start_time=`"):
        mcaptrack.ingest(table(tmp_path), into=log, role="truth", force=True)
    said = call("ingest", table(tmp_path), "--as", "truth", "--into", log, "--force", "--start-time", "5.5", "--json")
    assert said.code == 0, said.err
    assert json.loads(said.out)["results"][0]["messages"] == {"/lidar/truth": 2}


def test_3d_labels_do_not_go_with_pictures(tmp_path):
    boxes = tmp_path / "det.txt"
    boxes.write_text("1,-1,10,20,30,40,0.9\n")
    with pytest.raises(McaptrackError, match=r"truth\.csv holds 3D boxes, and .*det\.txt does not"):
        mcaptrack.ingest(boxes, tmp_path / "log.mcap", fps=10, truth=table(tmp_path))


def test_frames_of_labels_have_the_stamps_of_recorded_boxes(tmp_path):
    log = tmp_path / "robot.mcap"
    with recorder(log) as writer:
        channel = writer.add_channel("/lidar/boxes", ("foxglove.SceneUpdate", "jsonschema", b"{}"))
        for n in range(3):
            stamp = {"sec": 100 + n, "nsec": 7}
            cube = {"pose": {"position": {"x": n, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}}
            entity = {
                "timestamp": stamp,
                "frame_id": "map",
                "id": "1",
                "cubes": [cube | {"size": {"x": 4, "y": 2, "z": 1}}],
            }
            message = {"deletions": [], "entities": [entity]}
            writer.add_message(channel, (100 + n) * 10**9 + 40_000_000, json.dumps(message).encode(), 0)
    frames = table(tmp_path, "0,7,1,2", "2,7,3,2", header="frame,id,x_m,y_m")
    result = mcaptrack.ingest(frames, into=log, role="truth")
    assert list(result.messages) == ["/lidar/truth"]
    with mcaptrack.open(log) as opened:
        assert [one["t_ns"] for one in opened.table("tracks").to_pylist()] == [100 * 10**9 + 7, 102 * 10**9 + 7]
