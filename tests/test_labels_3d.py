"""3D labels: tables, KITTI tracking, nuScenes and Argoverse 2, against rotations of SciPy and numbers by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.boxes import columns_to_oriented_boxes
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.schema.framing import join_frames
from mcaptrack.schema.provenance import CLOCK
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
        (HEADER, LINES, {"scene": "scene-1"}, "`scene=` is for "),
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
    both = mcaptrack.ingest(table(tmp_path, *LINES[2:], name="b.csv"), tmp_path / "b.mcap", truth=table(tmp_path)).log
    with log.read(both) as opened:
        assert opened.metadata(CLOCK) == {"start_ns": str(T0)}  # of the first of all labels


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
