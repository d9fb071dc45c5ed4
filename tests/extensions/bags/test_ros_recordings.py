"""Recordings that ROS tools read: they stay as they are, and are read together with their results."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode
from rosbags.rosbag2 import Writer as Writer2

import mcaptrack
from mcaptrack import log
from mcaptrack.registry import BUILT_IN
from mcaptrack.schema import TRACKS
from tests.commands import GROUP, call, done
from tests.extensions.bags.bags import FRAMES, ROS2, T0, bag1, bag2, record
from tests.logs import READING, on_a_log, plain

COMMANDS = GROUP.commands


def by_rosbags(folder: Path) -> list[tuple[str, int, bytes]]:
    """All messages of a folder by rosbags, decoded."""
    with AnyReader([folder]) as reader:
        return [(c.topic, t, reader.deserialize(raw, c.msgtype).data.tobytes()) for c, t, raw in reader.messages()]


def on_disk(folder: Path) -> dict[str, tuple[int, bytes]]:
    return {entry.name: (entry.stat().st_mtime_ns, entry.read_bytes()) for entry in folder.iterdir() if entry.is_file()}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """Not to be changed."""
    return record(tmp_path_factory.mktemp("recorded") / "drive")


@pytest.fixture
def path(recorded, tmp_path) -> Path:
    shutil.copytree(recorded.parent, tmp_path / "drive")
    return tmp_path / "drive" / "drive.mcap"


def person(number: int) -> dict[str, float]:
    """Who is seen in a picture."""
    known = {"track_id": 1, "x_px": 2 + number, "y_px": 20, "w_px": 10, "h_px": 16, "score": 1.0}
    return known | {"x_m": np.nan, "y_m": np.nan, "observed": True, "source_id": -1}


def on_recording(path: Path, elsewhere: Path) -> dict[str, list[object]]:
    """A way to give a recording to each command, so that a command finds what those before it wrote."""
    truth = elsewhere / "truth.mcap"
    with log.create(truth) as writer:
        record = (TRACKS.name, "protobuf", TRACKS.descriptor)
        channel = writer.add_channel("/robot/front/truth", record, "protobuf", {})
        for number in range(FRAMES):
            rows = TRACKS.rows(**{name: [value] for name, value in person(number).items()})
            writer.add_message(channel, T0 + number * 100_000_000, number, TRACKS.codec.encode(rows))
    own = {
        "ingest": [truth, "--into", path],
        "detect": [path, "--detector", "knn"],
        "predict": [path, "--predictor", "cv"],
        "drop": [path, "/robot/front/retracks*"],
    }
    names = [name for name in COMMANDS if name in READING]
    return {name: own.get(name) or on_a_log(name, path, elsewhere) for name in names}


def test_no_command_changes_a_recording_that_ros_tools_read(path, tmp_path):
    """Neither its bytes nor what others read of it; what is written stands beside it, and all commands see it."""
    before, theirs = on_disk(path.parent), by_rosbags(path.parent)
    assert len(theirs) == FRAMES
    results = path.with_name("drive.results.mcap")
    for name, words in on_recording(path, tmp_path).items():
        was = results.read_bytes() if results.exists() else b""
        result = call(name, *words)
        assert result.code == 0 or name == "view" or name not in BUILT_IN["command"], result.err
        now = on_disk(path.parent)
        assert {part: now[part] for part in before} == before, name
        if not result.code and "sidecar" in {parameter.name for parameter in COMMANDS[name].params}:
            assert results.read_bytes() != was, name
            lines = [line for line in result.err.splitlines() if str(results) in line]
            assert len(lines) == 1, (name, result.err)
            assert ("earlier results are there" in lines[0]) == bool(was)
            assert was or "drive.mcap is named in" in lines[0]
            assert was or "--in-place writes into it all the same" in lines[0]
    assert by_rosbags(path.parent) == theirs
    with log.read(path) as opened:
        assert "/robot/front/truth" in opened.channels
        assert "/robot/front/detections" in opened.channels
        assert "/robot/front/retracks" not in opened.channels
    assert not list(path.parent.glob("*.retracks*"))


def test_what_was_written_where_and_why_stands_in_the_data(path):
    for why in ("--in-place writes into it all the same", "earlier results are there"):
        method = "median" if "there" in why else "knn"
        (result,) = json.loads(done("detect", path, "--detector", method, "--json").out)["results"]
        assert result["written_to"] == str(path.with_name("drive.results.mcap"))
        assert why in result["written_there_because"]
    (result,) = json.loads(done("detect", path, "--sidecar", "--json").out)["results"]
    assert result["written_there_because"] == "--sidecar was given"


def test_results_that_a_pattern_matches_too_are_part_of_their_log(path):
    done("detect", path, "--detector", "knn")
    pattern = path.parent / "*.mcap"
    assert len(list(path.parent.glob("*.mcap"))) == 2
    (result,) = json.loads(done("track", pattern, "--json").out)["results"]
    assert result["log"] == str(path)
    checked = json.loads(done("check", pattern, "--json").out)["results"]
    assert [result["log"] for result in checked] == [str(path), str(path.with_name("drive.results.mcap"))]


def test_in_place_insists_and_what_is_in_place_goes_on_there(path):
    result = done("detect", path, "--in-place", "--detector", "knn")
    assert f"results are in {path}: --in-place was given; they are ROS messages, for it is named in" in result.err
    with path.open("rb") as stream:
        assert "/robot/front/detections" in {c.topic for c in make_reader(stream).get_summary().channels.values()}
    result = done("track", path)
    (line,) = [line for line in result.err.splitlines() if "results are in" in line]
    assert f"results are in {path}: earlier results are in it; they are ROS messages, for it is named in" in line
    assert [entry.name for entry in path.parent.glob("*.mcap")] == ["drive.mcap"]
    done("drop", path, "/robot/front/*detections*", "/robot/front/tracks*")  # ours
    result = call("drop", path, "/robot/front/image")
    assert result.code == 1
    assert (
        "/robot/front/image was recorded, and can't be made again; -o writes a copy without, --in-place removes"
        in result.err
    )
    done("drop", path, "/robot/front/image", "--in-place")


def test_in_place_is_refused_where_results_stand_beside(path):
    mcaptrack.detect(path, detector="knn", views=True)
    before = on_disk(path.parent)
    result = call("track", path, "--in-place")
    assert result.code == 1
    assert "--in-place would leave them there and make others: remove drive.results.mcap first" in result.err
    assert on_disk(path.parent) == before


def test_a_copy_without_channels_has_its_results_beside_it(path, tmp_path):
    mcaptrack.detect(path, detector="knn", views=True)
    before = on_disk(path.parent)
    out = tmp_path / "small.mcap"
    done("drop", path, "/robot/front/image", "/robot/front/detections/*", "-o", out)
    assert on_disk(path.parent) == before
    with log.read(out) as opened:
        assert "/robot/front/image" not in opened.channels
        assert opened.channel("/robot/front/detections").messages == FRAMES
        assert opened.results is not None
    result = call("track", path, "--in-place", "-o", tmp_path / "b.mcap")
    assert (result.code, "--in-place and -o are two places" in result.err) == (1, True)


METADATA = "rosbag2_bagfile_information:\n  relative_file_paths: [{}]\n"


@pytest.mark.parametrize(
    ("profile", "library", "metadata", "is_beside"),
    [
        ("ros1", "robot", "", True),
        ("ros2", "robot", "", True),
        ("", "robot", "", False),
        ("ros2", "mcaptrack 0.1.0", "", False),
        ("", "robot", METADATA.format("a.mcap"), True),
        ("", "robot", METADATA.format("b.mcap"), False),
        ("ros2", "mcaptrack 0.1.0", METADATA.format("a.mcap"), True),
        ("", "robot", METADATA.format("[a"), True),
        ("", "robot", "other: 1\n", False),
    ],
)
def test_recordings_are_told_by_profile_and_by_the_metadata_beside_them(
    tmp_path, profile, library, metadata, is_beside
):
    path = plain(tmp_path / "a.mcap", profile, library)
    before = path.read_bytes()
    if metadata:
        (tmp_path / "metadata.yaml").write_text(metadata)
    bag1(tmp_path / "a.bag", 3, 50)
    result = done("ingest", tmp_path / "a.bag", "--into", path)
    assert path.with_name("a.results.mcap").exists() == is_beside
    assert (path.read_bytes() == before) == is_beside
    assert ("results are in" in result.err) == is_beside
    link = tmp_path / "elsewhere" / "link.mcap"
    link.parent.mkdir()
    link.symlink_to(path)
    with log.read(link, sidecar=False) as opened:
        from mcaptrack.sources.sidecar import recording_of

        assert bool(recording_of(opened)) == is_beside


def others(folder: Path) -> list[Path]:
    """Recordings that are no logs yet, of every kind."""
    bag1(folder / "a.bag", 3, 50)
    bag2(folder / "files")
    bag2(folder / "logs", "MCAP")
    shutil.copytree(folder / "files", folder / "no metadata; 'x' $y")
    (folder / "no metadata; 'x' $y" / "metadata.yaml").unlink()
    writer = Writer2(folder / "packed", version=9)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/a", "std_msgs/msg/String", typestore=ROS2)
        writer.write(connection, 1, b"\0\1\0\0\0\0\0\0")
    files = [folder / "files" / "files.db3", folder / "packed" / "packed.db3.zstd"]
    return [folder / "a.bag", *(folder / name for name in ("files", "logs", "no metadata; 'x' $y")), *files]


def test_whatever_is_given_a_recording_that_is_no_log_says_how_to_make_one(tmp_path, monkeypatch):
    """And what it says works."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    for number, recording in enumerate(others(tmp_path / "there")):
        said = set()
        for name, words in (on_recording(Path("RECORDING"), tmp_path) | {"view": [Path("RECORDING")]}).items():
            if not words or name == "ingest" or (number > 1 and name != "info"):
                continue  # the kinds are told apart in one place
            result = call(name, *(recording if word == Path("RECORDING") else word for word in words))
            assert result.code == 1, (name, recording, result.err)
            assert result.err.count("\n") == 1, (name, recording, result.err)
            said.add(result.err.split("`")[1])
        (command,) = said
        program, *words = shlex.split(command)
        assert (program, words[0]) == ("mcaptrack", "ingest")
        (tmp_path / str(number)).mkdir()
        monkeypatch.chdir(tmp_path / str(number))
        done(*words)
        (made,) = Path.cwd().iterdir()
        done("info", made)
