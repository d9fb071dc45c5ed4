"""Label formats, readers of messages, exporters and commands of other packages: the examples of docs/extend.md, installed."""

from __future__ import annotations

import json
import os
import re
import shutil
import struct
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import nullcontext
from dataclasses import replace
from functools import cache, partial
from importlib import import_module
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import quote, urlencode, urljoin
from urllib.request import urlopen

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from google.protobuf.message_factory import GetMessages
from mcap.reader import make_reader

import mcaptrack
from mcaptrack import log, testing
from mcaptrack.api.declared import declared
from mcaptrack.api.finishing import PartsOfRun
from mcaptrack.choices import BoxFormat, TableFormat
from mcaptrack.contracts import (
    Box,
    Box3d,
    LabelBoxes,
    RecordedChannel,
    RecordedMessage,
    RecordingReader,
    ReportSection,
    SectionTable,
)
from mcaptrack.errors import McaptrackError
from mcaptrack.fleet import Processes
from mcaptrack.fleet.worker import Reply, Request, WorkerLimits, do
from mcaptrack.location import Url
from mcaptrack.notices import collected
from mcaptrack.objects import AbsentError, StoreCheck, Version, replaced
from mcaptrack.pipeline.scenes import Scenes
from mcaptrack.registry import BUILT_IN, KINDS, Entry, find, others, own
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.schema.provenance import Plugin, Provenance
from mcaptrack.sources import fixed_frame
from mcaptrack.sources.box_files import MotFile
from mcaptrack.sources.ingest.labels.of_packages import format_named
from mcaptrack.testing import LawError
from mcaptrack.viewing.serving import LogPage, WebViewer
from tests.commands import call, done
from tests.distributions import package
from tests.logs import provenance_of, recorder
from tests.tiers import one_in, thorough
from tools import pages

#: A command and a class of an extension; of the core, where there is no extension.
COMMAND_OF_ONE, CLASS_OF_ONE = next(iter(others("command")), "track"), next(iter(others("name")), "RunResult")
PAGE = pages.blocks(pages.ROOT / "docs" / "extend.md")
FILES = {block.marks["file"]: block.text for block in PAGE if "file" in block.marks}
BOXES = "0;a;person;10;20;30;60\n1;b;dog;90;50;40;30\n1;a;person;12;20;30;60\n"
#: The same as a table that mcaptrack reads itself.
TABLE = "frame,id,class,x,y,w,h\n0,1,person,10,20,30,60\n1,2,dog,90,50,40,30\n1,1,person,12,20,30,60\n"


def install(folder: Path, points: dict[str, dict[str, str]], name: str = "my-trackers", version: str = "1.0") -> None:
    modules = {value.partition(":")[0] for own in points.values() for value in own.values()}
    package(folder, name, version, points, sorted(modules))


@pytest.fixture
def site(tmp_path, monkeypatch) -> Iterator[Path]:
    """A folder that stands for installed packages, with that of the page; the working folder is another one."""
    folder = tmp_path / "site"
    install(folder, tomllib.loads(FILES["pyproject.toml"])["project"]["entry-points"])
    for name, text in FILES.items():
        (folder / name).write_text(text)
    monkeypatch.syspath_prepend(str(folder))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    yield folder
    for name in [
        name for name, module in sys.modules.items() if str(folder) in (getattr(module, "__file__", "") or "")
    ]:
        del sys.modules[name]


def add(site: Path, kind: str, name: str, code: str) -> None:
    """Another package, with one entry point."""
    (site / "another.py").write_text(code)
    install(site, {f"mcaptrack.{kind}s": {name: "another:Part"}}, "another", "2.0")


def is_imported(module: str) -> bool:
    return module in sys.modules


def rows_of(path: str, topic: str) -> Any:
    with log.read(Path(path)) as opened:
        frames = list(opened.frames(topic, TRACKS if "detections" not in topic else DETECTIONS))
    return [str((frame.t_ns, frame.index, frame.rows.tolist())) for frame in frames]  # NaN is not equal to itself


def one_line(*words: str, code: int = 1) -> str:
    outcome = call(*words)
    assert outcome.code == code, outcome.err
    errors = [line for line in outcome.err.splitlines() if line.startswith("mcaptrack: ")]
    assert len(errors) == 1, outcome.err
    return errors[0]


# What there is


def test_every_kind_stands_on_the_page_with_an_example_of_at_most_40_lines():
    text = (pages.ROOT / "docs" / "extend.md").read_text()
    assert all(f"`mcaptrack.{kind}s`" in text for kind in KINDS)
    assert all(len(code.splitlines()) <= 40 for name, code in FILES.items() if name.endswith(".py"))
    table = text.partition("| tested by |")[2].partition("\n\n")[0]
    assert {*re.findall(r"`(check_\w+)`", table)} == {name for name in testing.__all__ if name.startswith("check_")}


def test_the_names_of_options_are_those_of_the_registry():
    from typing import get_args

    exporters = (*get_args(TableFormat), *get_args(BoxFormat))
    assert exporters == tuple(BUILT_IN["exporter"])


def test_doctor_lists_what_packages_bring_and_what_of_it_fails(site):
    owners = {("exporter", "csv"): "a built-in exporter csv", ("stage", "longest"): "a command longest"}
    install(site, {f"mcaptrack.{kind}s": {name: "speeds:Speeds"} for kind, name in owners}, "taken", "2.0")
    add(site, "command", "gone", "raise OSError('no\\nlicence')")
    points = {
        "mcaptrack.tracker": {"near": "gone:Near"},
        "mcaptrack.stages": {"placeless": "nearest_tracker:NearestTracker"},
    }
    install(site, points, "old", "1.0")
    with (site / "old-1.0.dist-info" / "METADATA").open("a") as metadata:
        metadata.write("Requires-Dist: numpy<1.0\nRequires-Dist: scipy>=1.0\nRequires-Dist: lost ; extra == 'a'\n")
    result = json.loads(done("doctor", "--json").out)
    found, warned = result["plugins"], [warning["message"] for warning in result["warnings"]]
    stray = found["entry point near (old 1.0)"]
    assert stray.endswith("mcaptrack.tracker is no group of entry points; did you mean mcaptrack.trackers?")
    assert "has input_topic = None" in found["stage placeless (old 1.0)"]
    assert [message for message in warned if message.startswith("old 1.0 needs")] == [
        f"old 1.0 needs numpy<1.0, and version {np.__version__} is installed; install another version of one"
    ]
    for (kind, name), owner in owners.items():
        ignored = f"{kind} {name} (taken 2.0)"
        assert found[ignored] == f"{ignored} is ignored: there is {owner}; rename it"
    assert found["command longest (my-trackers 1.0)"] == ""
    assert {"label format semicolons (my-trackers 1.0)", "exporter speeds (my-trackers 1.0)"} <= found.keys()
    assert found["message reader my_msgs/Things (my-trackers 1.0)"] == ""
    assert found["command gone (another 2.0)"].endswith("can't be imported: OSError: no licence (another.py, line 1)")


# Label formats


@pytest.mark.parametrize("words", [("--format", "semicolons"), (), ("--format", "semicolons:Semicolons")])
def test_a_label_format_gives_what_a_table_gives(site, words):
    Path("a.boxes").write_text(BOXES)
    Path("b.csv").write_text(TABLE)
    done("ingest", "a.boxes", *words, "--fps", "10", "--classes", "all", "-o", "a.mcap")
    done("ingest", "b.csv", "--fps", "10", "--classes", "all", "-o", "b.mcap")
    assert rows_of("a.mcap", "/camera/tracks") == rows_of("b.mcap", "/camera/tracks")
    made, table = provenance_of("a.mcap", "/camera/tracks"), provenance_of("b.mcap", "/camera/tracks")
    assert (made.digest, made.classes) == (table.digest, table.classes)
    name = words[1] if words else "semicolons"
    assert made.parameters["format"] == name
    assert made.plugins == {"label_format": Plugin(name, "semicolons:Semicolons", "my-trackers", "1.0")}
    assert "(my-trackers 1.0)" in done("info", "a.mcap").out


def test_labels_of_built_in_formats_import_no_package_and_stay_as_they_are(site):
    Path("a.boxes").write_text("1,1,10,20,30,60,1\n")  # MOTChallenge, whatever its name
    done("ingest", "a.boxes", "--fps", "10", "-o", "a.mcap")
    assert provenance_of("a.mcap", "/camera/tracks").parameters["format"] == "mot"
    assert not is_imported("semicolons")


def test_a_package_may_read_xml(site):
    code = "from mcaptrack.contracts import LabelBoxes\nclass Part:\n    def recognises(self, path):\n        return b'<yard' in path.read_bytes()\n    def read(self, path):\n        return LabelBoxes(frame=[0], boxes=[[1, 2, 3, 4]])\n"
    add(site, "label_format", "yard", code)
    Path("a.xml").write_text("<?xml version='1.0'?><yard/>")
    Path("b.xml").write_text("<court/>")
    done("ingest", "a.xml", "--as", "detections", "--fps", "10", "-o", "a.mcap")
    assert provenance_of("a.mcap", "/camera/detections").parameters["format"] == "yard"
    said = one_line("ingest", "b.xml", "--as", "detections", "--fps", "10", "-o", "b.mcap")
    assert "b.xml:1: XML that begins with <court> is of no label format (mot, " in said


def test_a_label_file_of_several_formats_is_refused_and_a_broken_one_is_named(site):
    Path("a.boxes").write_text(BOXES)
    code = "class Part:\n    def recognises(self, path):\n        return True\n    def read(self, path): ...\n"
    add(site, "label_format", "also", code)
    said = one_line("ingest", "a.boxes", "--fps", "10", "-o", "a.mcap")
    assert (
        "label format also (another 2.0) and label format semicolons (my-trackers 1.0); choose one with --format"
        in said
    )
    (site / "another.py").write_text("raise ValueError")
    sys.modules.pop("another")
    assert (
        "label format also (another 2.0) can't be imported"
        in done("ingest", "a.boxes", "--fps", "10", "-o", "a.mcap").err
    )


def labels(**columns: Any) -> LabelBoxes:
    usual = {"frame": [0, 1], "track_id": [1, 1], "boxes": [[1, 2, 3, 4], [2, 2, 3, 4]]}
    return LabelBoxes(**{**usual, **columns})


NAN, INF = float("nan"), float("inf")
#: What a format gives, and what is said of it.
WRONG: list[tuple[Any, str]] = [
    (None, "gave a NoneType"),
    ([], "gave a list"),
    (labels(boxes=[[1, 2, 3]] * 2), r"boxes of shape \(2, 3\)"),
    (labels(boxes=[[1, 2, 3, NAN]] * 2), "box 1: a number of the box is missing"),
    (labels(boxes=[[1, 2, -3, 4]] * 2), "box 1: a box can't be -3 wide"),
    (labels(boxes=[[1, 2, 3, 1e300]] * 2), "a coordinate can't be 1e.300"),
    (labels(boxes="no"), "gave what are no boxes"),
    (labels(boxes=[], frame=[], track_id=[]), "holds no boxes"),
    (labels(frame=[0]), "frame of shape"),
    (labels(frame=[0, NAN]), "frame with nan"),
    (labels(frame=[0, 0.5]), "frame with 0.5"),
    (labels(frame=[0, -1]), "frame with -1, which is no number"),
    (labels(frame=[0, 1e30]), "frame with 1e.30, which is no number"),
    (labels(frame=None), "frame and t_s"),
    (labels(t_s=[0, 1]), "frame and t_s"),
    (labels(frame=None, t_s=[0, -1]), "t_s with -1, which is no second"),
    (labels(frame=None, t_s=[0, INF]), "t_s with inf"),
    (labels(frame=None, t_s=["a", "b"]), "could not convert"),
    (labels(track_id=[1]), "track_id of shape"),
    (labels(track_id=[1.5, 2]), "ids are whole numbers or texts"),
    (labels(track_id=[-5, 1]), "the id has to be"),
    (labels(frame=[1, 1]), "id 1 appears twice"),
    (labels(class_name=["person"]), "class_name"),
    (labels(class_name="no"), "class_name"),
    (labels(class_name=[1, 2]), "class_name"),
    (labels(class_name=["dog", "dog"]), "holds no people"),
    (labels(score=[1]), "score of shape"),
    (labels(score=[1e30, 1]), "a score can't be"),
    (labels(labelled=[NAN]), "labelled with nan"),
    (labels(labelled=[0.5]), "labelled with 0.5"),
    (labels(first_frame="1"), "first_frame='1'"),
]


@pytest.mark.parametrize(("gives", "said"), WRONG, ids=range(len(WRONG)))
def test_boxes_that_cannot_be_labels_are_refused_in_one_line_that_names_the_package(site, monkeypatch, gives, said):
    add(site, "label_format", "odd", "class Part:\n    def read(self, path):\n        return self.gives\n")
    import another

    another.Part.gives = gives
    Path("a.odd").write_text("x")
    with pytest.raises(McaptrackError, match=said) as refused:
        mcaptrack.ingest("a.odd", "a.mcap", label_format="odd", role="tracks", fps=10)
    assert str(refused.value).startswith("label format odd (another 2.0)")
    assert "\n" not in str(refused.value)
    assert not Path("a.mcap").exists()


def test_times_names_and_empty_frames_of_labels_are_kept(site):
    add(site, "label_format", "timed", "class Part:\n    def read(self, path):\n        return self.gives\n")
    import another

    another.Part.gives = labels(
        frame=None, t_s=[12.5, 12.0], track_id=["b", ""], boxes=[[1, 2, 3, 4], [5, 6, 7, 8]],
        class_name=["dog", ""], score=[0.5, NAN], labelled=[11.5, 12.0, 12.5],
    )  # fmt: skip
    Path("a.timed").write_text("x")
    mcaptrack.ingest("a.timed", "a.mcap", label_format="timed", role="detections")
    with log.read(Path("a.mcap")) as opened:
        found = list(opened.frames("/camera/detections", DETECTIONS))
    assert [(frame.t_ns, len(frame.rows)) for frame in found] == [
        (11_500_000_000, 0),
        (12_000_000_000, 1),
        (12_500_000_000, 1),
    ]
    assert [frame.rows["class_id"].tolist() for frame in found] == [[], [0], [2]]
    assert found[2].rows["score"].tolist() == [0.5]
    assert provenance_of("a.mcap", "/camera/detections").classes == {"2": "dog"}


def test_boxes_on_the_ground_give_what_a_table_gives(site):
    code = "class Part:\n    in_space = True\n    def recognises(self, path):\n        return path.suffix == '.lidar'\n    def read(self, path):\n        return self.gives\n"
    add(site, "label_format", "lidar", code)
    import another

    boxes = [[1.0 * k, 2.0, 0.5, 4.0, 2.0, 1.5, 0.1] for k in range(4)]
    another.Part.gives = LabelBoxes(
        t_s=[10 + k for k in range(4)], track_id=[7] * 4, boxes=boxes, class_name=["car"] * 4, frame_id="map"
    )
    Path("a.lidar").write_text("not a table")
    head = "t,id,class,x_m,y_m,z_m,length_m,width_m,height_m,heading_rad\n"
    Path("b.csv").write_text(
        head + "".join(f"{10 + k},7,car,{','.join(map(str, box))}\n" for k, box in enumerate(boxes))
    )
    done("ingest", "a.lidar", "-o", "a.mcap")
    done("ingest", "b.csv", "--frame", "map", "-o", "b.mcap")
    assert rows_of("a.mcap", "/camera/tracks") == rows_of("b.mcap", "/camera/tracks")
    assert provenance_of("a.mcap", "/camera/tracks").frame_id == "map"


# Readers of messages


def robot(path: str, schema: str, messages: list[dict[str, Any]]) -> None:
    with recorder(Path(path)) as writer:
        channel = writer.add_channel("/robot/things", (schema, "jsonschema", b"{}"))
        for number, message in enumerate(messages):
            t_ns = 10**18 + number * 10**8
            writer.add_message(channel, t_ns, json.dumps(message).encode(), t_ns, number)


def things(number: int) -> dict[str, Any]:
    return {"left": 10 + number, "top": 20, "right": 40 + number, "bottom": 80, "percent": 50, "label": "person"}


def vision(number: int) -> dict[str, Any]:
    centre = {"position": {"x": 25 + number, "y": 50}, "theta": 0}
    result = {"hypothesis": {"class_id": "person", "score": 0.5}}
    return {"bbox": {"center": centre, "size_x": 30, "size_y": 60}, "results": [result]}


@pytest.mark.parametrize("schema", ["my_msgs/Things", "my_msgs/msg/Things"])
def test_messages_of_another_type_are_tracked_as_those_of_vision_msgs(site, schema):
    robot("a.mcap", schema, [{"things": [things(k)]} for k in range(8)] + [{"things": []}])
    robot(
        "b.mcap", "vision_msgs/Detection2DArray", [{"detections": [vision(k)]} for k in range(8)] + [{"detections": []}]
    )
    for name in ("a.mcap", "b.mcap"):
        done("run", name, "--no-tables")
    assert rows_of("a.mcap", "/robot/tracks") == rows_of("b.mcap", "/robot/tracks")
    assert len(rows_of("a.mcap", "/robot/tracks")) == 9


def test_messages_in_protobuf_and_of_ros_2_are_read_by_their_definitions_in_the_log(site):
    part = "from mcaptrack.contracts import Box\nclass Part:\n    def read(self, message):\n        return [Box(x, 2, 3, 4) for x in message.left]\n"
    add(site, "message_reader", "my_msgs/Rows", part)
    info = site / "another-2.0.dist-info" / "entry_points.txt"
    info.write_text(info.read_text() + "my.Rows = another:Part\n")
    file = FileDescriptorProto(name="rows.proto", package="my", syntax="proto3")
    file.message_type.add(name="Rows").field.add(name="left", number=1, type=1, label=3)
    (packed,) = GetMessages([file]).values()
    cdr = b"\x00\x01\x00\x00" + struct.pack("<I4x2d", 2, 5, 9)
    kinds = {
        "my.Rows": (
            "protobuf",
            "protobuf",
            FileDescriptorSet(file=[file]).SerializeToString(),
            packed(left=[5, 9]).SerializeToString(),
        ),
        "my_msgs/msg/Rows": ("cdr", "ros2msg", b"float64[] left", cdr),
    }
    with recorder(Path("a.mcap")) as writer:
        for name, (encoding, schema_encoding, schema, payload) in kinds.items():
            number = writer.register_channel(
                f"/{encoding}/rows", encoding, writer.register_schema(name, schema_encoding, schema)
            )
            writer.add_message(number, 10**18, payload, 10**18)
    with log.read(Path("a.mcap")) as opened:
        for encoding in ("protobuf", "cdr"):
            (frame,) = fixed_frame.named_detections(opened, f"/{encoding}/rows").frames
            assert frame.rows["x_px"].tolist() == [5, 9]


def test_no_reader_is_imported_for_messages_of_other_types(site):
    robot("a.mcap", "your_msgs/Things", [{"things": []}])
    done("info", "a.mcap")
    assert not is_imported("things")


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("return [1]", "gave what is no Box: TypeError"),
        ("return [(1, 2, 3, 4)]", "gave what is no Box"),
        ("return None", "failed: TypeError"),
        ("return message.nothing", "failed: AttributeError"),
        ("return [Box(1, 2, float('nan'), 4)]", "a box can't be nan x 4"),
        ("return [Box(1, 2, -3, 4)]", "a box can't be -3 x 4"),
        ("return [Box(1, 2, 3, 4, 0.5, 7)]", "an? int where text belongs"),
        ("raise SystemExit(0)", "failed: SystemExit: 0"),
    ],
)
def test_a_reader_that_fails_is_named_with_the_message(site, code, said):
    part = f"from mcaptrack.contracts import Box\nclass Part:\n    def read(self, message):\n        {code}\n"
    add(site, "message_reader", "odd_msgs/Odd", part)
    robot("a.mcap", "odd_msgs/Odd", [{"things": []}])
    line = one_line("track", "a.mcap", "--topic", "/robot/things")
    assert "/robot/things at 1000000000000000000 ns: message reader odd_msgs/Odd (another 2.0)" in line
    assert __import__("re").search(said, line), line


def test_a_broken_reader_does_no_harm_to_commands_that_need_it_not(site):
    add(site, "message_reader", "odd_msgs/Odd", "raise ImportError('gone')")
    robot("a.mcap", "odd_msgs/Odd", [{"things": []}])
    outcome = done("check", "a.mcap")
    assert "gone" not in outcome.err
    assert "/robot/things" in done("info", "a.mcap").out
    assert "can't be imported: ImportError: gone" in call("track", "a.mcap", "--topic", "/robot/things").err


def test_built_in_readers_are_not_replaced(site):
    add(site, "message_reader", "vision_msgs/msg/Detection2DArray", "raise ImportError('gone')")
    robot("a.mcap", "vision_msgs/Detection2DArray", [{"detections": [vision(1)]}])
    done("track", "a.mcap", "--topic", "/robot/things")
    assert not is_imported("another")


# Recording formats


TEXT = '#recording\n/b 20 {"x": 1}\n/a 10 {}\n/b 30 {"x": 2}\n'


def test_a_recording_of_a_format_of_a_package_becomes_a_log_with_all_of_its_messages(site):
    Path("drive.text").write_text(TEXT)
    assert "drive.text is a recording as text, not an MCAP file; " in one_line("info", "drive.text")
    done("ingest", "drive.text")
    with Path("drive.mcap").open("rb") as stream:
        found = [(c.topic, c.message_encoding, m.log_time, m.publish_time, m.sequence, m.data)
                 for _, c, m in make_reader(stream).iter_messages(log_time_order=False)]  # fmt: skip
    assert found == [
        ("/b", "json", 20, 20, 0, b'{"x": 1}'), ("/a", "json", 10, 10, 0, b"{}"), ("/b", "json", 30, 30, 1, b'{"x": 2}'),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("opens", "said"),
    [
        ("raise OSError('gone')", "can't read drive.odd: OSError: gone"),
        ("return 3", "gave an int; open has to give a RecordingReader"),
        ("Odd.channels = ['/a']; return Odd([])", "gave what is no RecordedChannel of its own: '/a'"),
        (
            "Odd.channels = [RecordedChannel('/a', ('A',))]; return Odd([])",
            "gave what is no RecordedChannel of its own",
        ),
        ("Odd.declared_counts = {Odd.channels[0]: 'x'}; return Odd([])", "gave what is no RecordingReader: TypeError"),
        ("Odd.declared_counts = {'/a': 1}; return Odd([])", "gave what is no RecordedChannel of its own: '/a'"),
        ("Odd.close = lambda self: 1 / 0; return Odd([3])", "gave what is no message of a channel of its own: 3"),
        (
            "Odd.notes = lambda self, report: vars(report).update(lost=3); return Odd([])",
            "gave what are no ReadingNotes",
        ),
        (
            "return Odd([RecordedMessage(Odd.channels[0], 1.5, b'')])",
            "gave what is no message of a channel of its own: Rec",
        ),
        ("return Odd([3])", "gave what is no message of a channel of its own: 3"),
        (
            "return Odd([RecordedMessage(RecordedChannel('/a'), 1, b'')])",
            "gave what is no message of a channel of its own: Rec",
        ),
        (
            "return Odd([RecordedMessage(Odd.channels[0], -1, b'')])",
            "gave what is no message of a channel of its own: Rec",
        ),
        ("return Odd(1 / 0 for _ in '1')", "can't read drive.odd: ZeroDivisionError"),
    ],
)
def test_a_recording_format_that_fails_is_named_and_leaves_nothing(site, opens, said):
    code = (
        "from mcaptrack.contracts import RecordedChannel, RecordedMessage, RecordingReader, ReportSection, SectionTable\n"
        "class Odd(RecordingReader):\n    channels = [RecordedChannel('/a')]\n"
        "    def __init__(self, given):\n        super().__init__()\n        self.given = given\n"
        "    def messages(self, report):\n        yield from self.given\n        self.notes(report)\n"
        "    def notes(self, report):\n        pass\n"
        "class Part:\n    def recognises(self, path):\n        return 'odd' * (path.suffix == '.odd')\n"
        f"    def open(self, path):\n        {opens}\n"
    )
    add(site, "recording", "odd", code)
    Path("drive.odd").write_text("x")
    assert f"recording odd (another 2.0) {said}" in one_line("ingest", "drive.odd")
    assert [path.name for path in Path().iterdir()] == ["drive.odd"]


@pytest.mark.parametrize(
    "code",
    [
        "raise ImportError('gone')",
        "class Part:\n    def recognises(self, path): raise OSError('gone')\n    def open(self, path): ...",
    ],
)
def test_a_broken_recording_format_is_named_and_the_others_work(site, code):
    add(site, "recording", "broken", code)
    Path("drive.text").write_text(TEXT)
    outcome = done("ingest", "drive.text")
    assert "gone" in outcome.err
    assert "gone" not in done("info", "drive.mcap").err


def test_an_mcap_file_that_a_format_lists_is_left_as_it_is_and_its_list_is_updated(site):
    code = (
        "from pathlib import Path\n"
        "class Part:\n    def recognises(self, path):\n        return 'a list' * (path / 'list').is_file()\n"
        "    def open(self, path): ...\n"
        "    def listing(self, path):\n"
        "        list_ = path.with_name('list')\n"
        "        return list_ if list_.is_file() and path.name in list_.read_text() else None\n"
        "    def update(self, path):\n        Path('updated').write_text(path.name)\n"
    )
    add(site, "recording", "lists", code)
    Path("lists").mkdir()
    robot("lists/a.mcap", "odd_msgs/Odd", [{"things": []}])
    Path("b.csv").write_text(TABLE)
    Path("lists/list").write_text("a.mcap")
    assert "lists is a list, not an MCAP file; " in one_line("info", "lists")
    labels = ("ingest", "b.csv", "--as", "truth", "--into", "lists/a.mcap", "--fps", "10", "--start-time", "1e9")
    outcome = done(*labels)
    assert f"a.mcap is named in {Path('lists/list')}" in outcome.err
    assert not Path("updated").exists()
    Path("lists/a.results.mcap").unlink()
    done(*labels, "--in-place")
    assert Path("updated").read_text() == "a.mcap"
    Path("b").mkdir()
    Path("lists").rename("b/lists")
    Path("b/c.mcap").write_bytes(Path("b/lists/a.mcap").read_bytes())
    outcome = done("info", "b", "--json")
    assert [result["log"] for result in json.loads(outcome.out)["results"]] == ["b/c.mcap", "b/lists/a.mcap"]
    Path("b/lists/d.mcap").write_bytes(Path("b/c.mcap").read_bytes())  # now it has several files
    Path("b/none").mkdir()
    Path("b/none/list").touch()
    outcome = done("info", "b", "--json")
    assert [result["log"] for result in json.loads(outcome.out)["results"]] == ["b/c.mcap"]
    for name in ("lists", "none"):
        assert outcome.err.count(f"b/{name} is a list, not an MCAP file; ") == 1
    for told in (outcome, done("info", "b/*", "--json")):
        assert told.err.count("its files are left out") == 2


# Exporters


@pytest.fixture
def tracked(site) -> Path:
    Path("b.csv").write_text(TABLE)
    done("ingest", "b.csv", "--fps", "10", "--classes", "all", "-o", "a.mcap")
    return Path("a.mcap")


def test_an_exporter_writes_a_file_that_is_complete_or_not_there(site, tracked):
    before = tracked.read_bytes()
    done("export", "a.mcap", "--format", "speeds")
    assert Path("a.speeds.csv").read_text() == "topic,track_id,t_ns,px_per_s\n/camera/tracks,1,100000000,20.0\n"
    result = mcaptrack.export("a.mcap", "b.csv", form="speeds", force=True)
    assert (result.rows, result.files) == ({"speeds": 1}, (Path("b.csv"),))
    assert "a.speeds.csv exists" in one_line("export", "a.mcap", "--format", "speeds")
    add(
        site,
        "exporter",
        "late",
        "class Part:\n    def write(self, recording, path):\n        path.write_text('half')\n        raise OSError('full')\n",
    )
    Path("a.late").write_text("old")
    line = one_line("export", "a.mcap", "--format", "late", "--force")
    assert "exporter late (another 2.0) failed: OSError: full (another.py, line 4)" in line
    assert Path("a.late").read_text() == "old"
    assert sorted(path.name for path in Path().iterdir()) == ["a.late", "a.mcap", "a.speeds.csv", "b.csv"]
    assert tracked.read_bytes() == before


def test_an_exporter_writes_a_folder_that_is_complete_or_not_there(site, tracked):
    code = "class Part:\n    end = '.parts'\n    is_folder = True\n    def write(self, recording, path):\n        path.mkdir()\n        (path / 'x').write_text(self.text)\n        return {'x': self.rows}\n"
    add(site, "exporter", "parts", code)
    import another

    another.Part.text, another.Part.rows = "one", 1
    done("export", "a.mcap", "--format", "parts")
    assert "exists" in one_line("export", "a.mcap", "--format", "parts")
    another.Part.text, another.Part.rows = "two", "many"
    assert "gave no numbers of rows" in one_line("export", "a.mcap", "--format", "parts", "--force")
    assert Path("a.parts/x").read_text() == "one"
    another.Part.rows = np.int64(2)
    assert json.loads(done("export", "a.mcap", "--format", "parts", "--force", "--json").out)["results"][0]["rows"] == {
        "x": 2
    }
    assert Path("a.parts/x").read_text() == "two"
    assert sorted(path.name for path in Path().iterdir()) == ["a.mcap", "a.parts", "b.csv"]


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("end = 3\n    def write(self, recording, path): ...", "has end = 3"),
        ("end = '/../x'\n    def write(self, recording, path): ...", "has end = '/../x'"),
        ("pass", "has no method write, so it is no exporter"),
        ("def write(self, recording, path): return {}", "wrote no file; it has to make the path it gets"),
        ("def write(self, recording, path): path.mkdir()", "wrote no file; its attribute is_folder says which"),
        ("def __init__(self, a): ...\n    def write(self, recording, path): ...", "could not be made: TypeError"),
        ("def write(self, recording, path): recording.write('x', [])", "has no attribute 'write'"),
        ("def write(self, recording, path): path.write_text('x')", "gave no numbers of rows"),
    ],
)  # fmt: skip
def test_an_exporter_that_cannot_be_is_refused_in_one_line(site, tracked, code, said):
    add(site, "exporter", "odd", f"class Part:\n    {code}\n")
    line = one_line("export", "a.mcap", "--format", "odd")
    assert said in line
    assert "exporter odd (another 2.0)" in line
    assert sorted(path.name for path in Path().iterdir()) == ["a.mcap", "b.csv"]


def test_a_folder_of_others_is_not_replaced(site, tracked):
    code = "class Part:\n    end = '.parts'\n    is_folder = True\n    def write(self, recording, path): ...\n"
    add(site, "exporter", "parts", code)
    for name in (".", "pictures", "x.parts"):
        Path(name).mkdir(exist_ok=True)
        Path(name, "mine").write_text("mine")
    Path("x.parts/a.mcap").write_bytes(tracked.read_bytes())
    said = "exists, and only folders named *.parts are replaced"
    for name in (".", "pictures", "pictures/mine"):
        assert said in one_line("export", "a.mcap", "--format", "parts", "-o", name, "--force")
    assert "is a log, or holds it" in one_line(
        "export", "x.parts/a.mcap", "--format", "parts", "-o", "x.parts", "--force"
    )
    assert all(Path(name, "mine").read_text() == "mine" for name in (".", "pictures", "x.parts"))


def test_an_exporter_does_not_replace_the_log(site, tracked):
    before = tracked.read_bytes()
    assert "a.mcap is a log" in one_line("export", "a.mcap", "--format", "speeds", "-o", "a.mcap", "--force")
    assert tracked.read_bytes() == before


@thorough
def test_many_logs_are_exported_by_a_package_each_to_its_own_file(site, tracked, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(site))
    Path("c.mcap").write_bytes(tracked.read_bytes())
    done("export", "a.mcap", "c.mcap", "--format", "speeds", "-o", "out")
    assert sorted(path.name for path in Path("out").iterdir()) == ["a.speeds.csv", "c.speeds.csv"]


# Commands


def test_help_lists_commands_without_an_import(site):
    outcome = done("--help")
    assert "longest" in outcome.out
    assert "Print the tracks that were seen longest, in seconds (my-trackers 1.0)." in " ".join(outcome.out.split())
    assert "longest" in dir(mcaptrack)
    assert not is_imported("longest")
    assert mcaptrack.longest is __import__("longest").longest


@pytest.mark.parametrize(
    ("code", "line"),
    [
        ('@declared(most_used=("a",), heading="Results")\ndef Part(a: int = (1)):\n    """Count\n    it.\n\n    Yes.\n    """', "Count it (another 2.0)."),
        ("@declared()\ndef Part():\n    'Do.'\n\ndef other():\n    \"\"\"No.\"\"\"", "Of another 2.0."),
        ('def Part():\n    """\x1b[31mRed."""', "[31mRed (another 2.0)."),
        ("\0", "Of another 2.0."),
    ],
)  # fmt: skip
def test_the_line_of_a_command_is_read_from_its_source(site, code, line):
    add(site, "command", "odd", code)
    heading = "Results:" if "heading" in code else "Of installed packages:"
    section = done("--help").out.partition(heading)[2].partition("\n\n")[0]
    assert f"odd {line}" in " ".join(section.split())
    assert not is_imported("another")


def test_a_class_of_a_package_prints_for_its_command(site):
    code = (
        "from mcaptrack.api.declared import declared\nfrom mcaptrack.cli.declared import Once\nfrom mcaptrack.cli.text import show\n"
        "class Printer(Once[int]):\n    def show(self, done, talk):\n        show(f'{done} it is')\n"
        '@declared(printed_by=\'another:Printer\')\ndef Part(count: int = 3) -> int:\n    """Count."""\n    return count\n'
    )
    add(site, "command", "odd", code)
    assert done("odd", "--count", "5").out == "5 it is\n"
    (site / "another.py").write_text(code.replace("another:Printer", "another:Lost"))
    sys.modules.pop("another")
    assert "command odd (another 2.0): another has no class Lost" in one_line("odd")


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("", []),
        ("return 1 / 0 and", ["could not be made: ZeroDivisionError: division by zero (another.py, line 3)"]),
        ("return 3 or", ["gave an int; its function has to give a LogPage"]),
    ],
)
def test_a_page_of_a_package_stands_beside_the_player_and_one_that_breaks_is_left_out(site, tracked, code, said):
    page = "from mcaptrack.viewing.serving import LogPage\ndef Part():\n    return LogPage(lambda opened: opened.path.name.encode(), '')\n"
    add(site, "page", "name-of-it", page.replace("return", code or "return"))
    with mcaptrack.view("a.mcap", port=0) as server:
        index = urlopen(server.address).read().decode()
        assert ('"page-name-of-it"' in index) is not bool(said)
        if not said:
            (address,) = re.findall(r'"name-of-it":"([^"]+)"', index)
            assert urlopen(urljoin(server.address, address)).read() == b"a.mcap"
    warned = [notice.message for notice in server.warnings if notice.code == "left-out"]
    assert warned == [f"page name-of-it (another 2.0) {words}" for words in said]


@pytest.mark.parametrize(("gives", "said"), [("'text'", "a str; make has to give a bytes"), ("1 / 0", "failed: Zero")])
def test_a_page_that_is_no_page_says_so_in_its_place(site, tracked, gives, said):
    code = f"from mcaptrack.viewing.serving import LogPage\ndef Part():\n    return LogPage(lambda _: {gives}, '')\n"
    add(site, "page", "odd", code)
    with mcaptrack.view("a.mcap", port=0) as server:
        (address,) = re.findall(r'"odd":"([^"]+)"', urlopen(server.address).read().decode())
        assert (
            f"page odd (another 2.0) gave {said}".replace("gave f", "f")
            in urlopen(urljoin(server.address, address)).read().decode()
        )


def test_a_viewer_that_fails_is_shown_with_the_reason(site, tracked):
    code = "from mcaptrack.viewing.serving import WebViewer\ndef Part():\n    return WebViewer('.x', *[lambda _: 1 / 0] * 3)\n"
    add(site, "viewer", "odd", code)
    with mcaptrack.view("a.mcap", port=0) as server:
        assert "viewer odd (another 2.0) failed: ZeroDivisionError" in urlopen(server.address).read().decode()


def test_a_player_of_a_package_that_gives_no_page_is_one_line(site, tracked):
    add(
        site,
        "player",
        "a-player",
        "class Part:\n    def show(self, *a, **k): 1 / 0\n    def page(self, *a): return b''\n",
    )
    assert "player a-player (another 2.0) gave a bytes; page has to give a LogPage" in one_line("view", "a.mcap")
    with mcaptrack.open("a.mcap") as opened, pytest.raises(McaptrackError, match=r"failed: ZeroDivisionError"):
        opened.show()


def test_a_name_that_is_not_there_proposes_one_of_an_extension():
    with pytest.raises(AttributeError, match=f"did you mean {COMMAND_OF_ONE}"):
        getattr(mcaptrack, f"{COMMAND_OF_ONE}s")


def test_names_of_extensions_and_of_the_core_are_not_replaced(site):
    add(site, "command", COMMAND_OF_ONE, "raise ImportError")
    install(site, {"mcaptrack.names": dict.fromkeys((CLASS_OF_ONE, "Notice", "log"), "another:Part")}, "more", "1.0")
    assert "another 2.0" not in done("--help").out
    assert [
        getattr(mcaptrack, name).__module__.partition(".")[0] for name in (COMMAND_OF_ONE, CLASS_OF_ONE, "Notice")
    ] == ["mcaptrack"] * 3
    assert mcaptrack.log is log
    ignored = json.loads(done("doctor", "--json").out)["plugins"]
    assert f"there is a built-in command {COMMAND_OF_ONE}" in ignored[f"command {COMMAND_OF_ONE} (another 2.0)"]
    assert (
        CLASS_OF_ONE == "RunResult"
        or f"there is a built-in name {CLASS_OF_ONE}" in ignored[f"name {CLASS_OF_ONE} (more 1.0)"]
    )


def test_help_loads_neither_packages_nor_their_metadata(site):
    code = (
        "import sys\nfrom mcaptrack.__main__ import main\nsys.argv = ['mcaptrack', '--help']\n"
        "try:\n    main()\nexcept SystemExit: pass\n"
        "print('importlib.metadata' in sys.modules, 'longest' in sys.modules, 'numpy' in sys.modules, file=sys.stderr)"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(site), str(pages.ROOT)])}
    outcome = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert outcome.stderr.split() == ["False", "False", "False"]
    assert "longest" in outcome.stdout


def test_a_command_is_called_and_its_result_printed(site, tracked, monkeypatch):
    assert done("longest", "a.mcap").out == "1  0.1\n2  0\n"
    assert json.loads(done("longest", "a.mcap", "--count", "1", "--json").out)["results"] == [{"result": {"1": 0.1}}]
    done("longest", "a.mcap", "-o", "x.txt")
    assert Path("x.txt").read_text() == "1  0.1\n2  0\n"
    monkeypatch.setenv("MCAPTRACK_LONGEST_COUNT", "1")
    assert done("longest", "a.mcap").out == "1  0.1\n"
    monkeypatch.setenv("PYTHONPATH", str(site))
    Path("c.mcap").write_bytes(tracked.read_bytes())
    assert done("longest", "a.mcap", "c.mcap").out == "a.mcap:\n1  0.1\nc.mcap:\n1  0.1\n"
    assert "--count has to be from 1 to 1000" in call("longest", "a.mcap", "--count", "0").err
    assert "did you mean --count?" in call("longest", "a.mcap", "--coutn", "2").err
    assert "command longest (my-trackers 1.0): " in one_line("longest", "nothing.mcap")


def test_settings_of_a_command_are_checked_when_it_is_called_and_harm_no_other(site, tracked, monkeypatch):
    Path("mcaptrack.toml").write_text("[longest]\ncount = 1\n")
    assert done("longest", "a.mcap").out == "1  0.1\n"
    Path("mcaptrack.toml").write_text("[longest]\nconut = 1\n")
    assert "longest has no option conut; did you mean count?" in call("longest", "a.mcap").err
    monkeypatch.setenv("MCAPTRACK_LONGEST_CONUT", "1")
    done("info", "a.mcap")
    assert not is_imported("longest") or True


COMMAND = "from mcaptrack.api.declared import declared\n"


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("raise RuntimeError('a\\nb')", "can't be imported: RuntimeError: a b"),
        ("def Part(): ...", "is not declared"),
        ("class Part: ...", "is not declared"),
        ("Part = 3", "no class but of type int"),
        (COMMAND + "@declared()\ndef Part(x=1):\n    'Do.'", "TypeError: the parameter x of Part has no type; annotate it"),
        (COMMAND + "@declared()\ndef Part(x: dict = {}):\n    'Do.'", "can't be a command"),
        (COMMAND + "@declared()\ndef Part(json: bool = False):\n    'Do.'", "can't have the name of the option json"),
        (COMMAND + "@declared()\ndef Part(a: int = 1):\n    'Do.'\n    raise KeyError(a)", "failed: KeyError: 1"),
        (COMMAND + "import sys\n@declared()\ndef Part(a: int = 1):\n    'Do.'\n    sys.exit(0)", "failed: SystemExit: 0"),
    ],
)  # fmt: skip
def test_a_command_that_cannot_be_is_one_line_and_the_others_work(site, tracked, code, said):
    add(site, "command", "odd", code)
    line = one_line("odd")
    assert said in line
    assert "command odd" in line
    done("longest", "a.mcap")
    assert "odd" in done("--help").out
    assert "no such option: --nope" in call("info", "a.mcap", "--nope").err


def test_names_that_are_no_words_are_left_out(site):
    names = {
        "--help": "longest:longest",
        "a b": "longest:longest",
        "\x1b[31mred": "longest:longest",
        "a:b": "longest:longest",
    }
    install(site, {"mcaptrack.commands": names}, "odd-names")
    said = done("--help").out
    assert "odd-names" not in said
    assert "\x1b[31m" not in said
    assert "there is no command a b" in call("a b").err


def test_two_commands_of_one_name_are_refused(site):
    add(site, "command", "longest", "")
    assert "several installed packages have a command longest" in one_line("longest")


def test_built_in_commands_are_not_replaced(site, tracked):
    add(site, "command", "info", "raise ImportError('gone')")
    assert "/camera/tracks" in done("info", "a.mcap").out
    assert "another" not in done("--help").out


def test_what_a_command_changes_in_the_process_is_undone(site, tracked):
    add(
        site,
        "command",
        "odd",
        COMMAND
        + "import os, sys\n@declared()\ndef Part():\n    'Do.'\n    os.chdir('/')\n    sys.path.clear()\n    print('noise')\n    return None\n",
    )
    before = list(sys.path), os.getcwd()
    outcome = done("odd")
    assert (list(sys.path), os.getcwd()) == before
    assert outcome.out == ""
    assert "command odd (another 2.0) changed sys.path and the working folder; this was undone" in outcome.err


# The checks: each law can be broken


NUMBERS = count()


class Format:
    in_space = False

    def __init__(self, breaks: str = "") -> None:
        self.breaks, self.seen = breaks, 0
        if breaks == "space":
            self.in_space = "air"

    def recognises(self, path: Path) -> bool:
        if self.breaks == "junk":
            return bool(path.read_text("utf-8"))
        return self.breaks == "any" or (self.breaks != "other" and path.suffix == ".numbers")

    def read(self, path: Path) -> LabelBoxes:
        self.seen += 1
        if self.breaks == "file":
            path.write_text(path.read_text("ascii").replace(" 2 ", "  2 "))
        rows = [[float(part) for part in line.split()] for line in path.read_text("ascii").splitlines()]
        if self.breaks == "folder":
            os.chdir("/")
        if self.breaks == "empty" and not rows:
            rows[0].sort()
        if not all(len(row) == 5 for row in rows):
            raise (KeyError if self.breaks == "cut" else ValueError)("not five numbers")
        boxes = np.reshape([row[1:] for row in rows], (-1, 4))
        if self.breaks == "state":
            boxes = boxes + self.seen
        return LabelBoxes(frame=[row[0] for row in rows], boxes=-boxes if self.breaks == "boxes" else boxes)


class Reader:
    def __init__(self, breaks: str = "") -> None:
        self.breaks, self.seen = breaks, 0
        self.in_space = "air" if breaks == "space" else breaks == "ground"

    def read(self, message: Any) -> list[Any]:
        self.seen += 1
        if self.breaks == "folder":
            os.chdir("/")
        if self.breaks == "blank" and not hasattr(message, "boxes"):
            return [Box(0, 0, 1, 1)]
        boxes = message.boxes
        if self.breaks == "message":
            message.boxes = []
        if self.breaks == "fails":
            raise KeyError("x")
        if self.breaks == "ground":
            return [Box3d(0, "", (box.x, 1, 2), (0, 0, 0, 1), (1, 1, -1)) for box in boxes]
        return [
            Box(box.x, self.seen if self.breaks == "state" else 2, -3 if self.breaks == "boxes" else 3, 4)
            for box in boxes
        ]


class Recordings:
    def __init__(self, breaks: str = "") -> None:
        self.breaks, self.seen = breaks, 0

    def recognises(self, path: Path) -> Any:
        text = path.read_text("utf-8", "strict" if self.breaks == "junk" else "replace")
        return {"words": True, "silent": ""}.get(self.breaks, "numbers as text" if text[:1] in "#0" else "")

    def open(self, path: Path) -> RecordingReader:
        self.seen += 1
        if self.breaks == "file":
            path.write_text(path.read_text("utf-8", "replace") + " ")
        if self.breaks == "folder":
            os.chdir("/")
        numbers = path.read_text("utf-8", "replace").split()[1:]
        if not all(map(str.isdigit, numbers)):
            raise (KeyError if self.breaks == "cut" else ValueError)("no number")
        out, channel = RecordingReader(), RecordedChannel("/a", encoding="json")
        out.channels = [channel]
        out.declared_counts = {channel: len(numbers) + 1} if self.breaks == "count" else None
        payload = b"%d" % self.seen if self.breaks == "state" else b"{}"
        channel = RecordedChannel("/b") if self.breaks == "channel" else channel
        messages = [RecordedMessage(channel, int(number) % 2**40, payload) for number in numbers]
        passes = iter(messages if self.breaks != "empty" else [])
        out.messages = lambda report: passes if self.breaks == "once" else [*messages] if self.breaks != "empty" else []
        return out


class Export:
    end = ".txt"
    is_folder = False

    def __init__(self, breaks: str = "") -> None:
        self.breaks, self.seen = breaks, 0
        self.end = "txt" if breaks == "end" else ".txt"

    def write(self, recording: Any, path: Path) -> Any:
        self.seen += 1
        if self.breaks == "fails":
            raise KeyError("x")
        if self.breaks == "empty" and not recording.topics:
            raise KeyError("topic")
        if self.breaks == "folder":
            os.chdir("/")
        if self.breaks == "beside":
            path.with_name("more.txt").write_text("x")
        if self.breaks == "log":
            with Path(recording.path).open("ab") as stream:
                stream.write(b"x")
        if self.breaks != "nothing":
            own = {"name": path.name, "state": str(self.seen)}
            path.write_text("\n".join(recording.topics) + own.get(self.breaks, ""))
        return {"topics": "many"} if self.breaks == "rows" else {"topics": len(recording.topics)}


FORMAT_LAWS = {
    "space": "declares: label format Format has in_space = 'air'", "boxes": "conforms: .* can't be",
    "state": "pure: the same file gives other boxes", "file": "pure: ", "folder": "process: .* the working folder",
    "empty": "damaged: an empty file raises IndexError", "cut": "damaged: .* raises KeyError",
    "other": "recognises: it doesn't", "junk": "recognises: .*UnicodeDecodeError",
    "any": "recognises: it takes a file of noise",
}  # fmt: skip
READER_LAWS = {
    "space": "declares: ", "boxes": "conforms: .* a box can't be", "ground": "conforms: .* a box can't be",
    "fails": "conforms: it raises KeyError", "state": "pure: a message gives other boxes",
    "message": "pure: ", "blank": "empties: ", "folder": "process: ",
}  # fmt: skip
RECORDING_LAWS = {
    "words": "recognises: it says True", "silent": "recognises: it says ''", "junk": "recognises: .*UnicodeDecodeError",
    "empty": "conforms: it has no messages", "channel": "conforms: .* no message of a channel",
    "count": "conforms: .* does not add up", "cut": "damaged: .* raises KeyError", "file": "pure: ",
    "state": "pure: the same recording gives other messages", "once": "pure: its messages don't begin again",
    "folder": "process: ",
}  # fmt: skip
EXPORT_LAWS = {
    "end": "declares: .* has end = 'txt'", "fails": "conforms: .* KeyError", "nothing": "conforms: .* wrote no file",
    "rows": "conforms: .* no numbers of rows", "beside": "conforms: it writes more.txt", "name": "pure: .* other bytes",
    "state": "pure: .* other bytes", "log": "pure: |damaged|conforms", "empty": "empties: ", "folder": "process: ",
}  # fmt: skip
JUDGE_LAWS = {
    "small": "conforms: .* failed at 4 and 4 crops: IndexError", "many": "conforms: .* failed at .*ValueError",
    "nan": "conforms: .* gives nan as log odds", "state": "pure: the same crops give another number",
    "crops": "pure: it changes its crops", "distance": "sign: other crops are likelier", "folder": "process: ",
}  # fmt: skip
PAGE_LAWS = {
    "type": "conforms: .* gave a bytes; its function has to give a LogPage", "policy": "declares: its policy, ''",
    "lines": "declares: its policy", "text": "conforms: .* gave a str; make has to give a bytes",
    "bytes": "conforms: its page is not in UTF-8", "state": "pure: the same log gives another page",
    "log": "pure: it changes the log", "empty": "empties: .* KeyError", "folder": "process: ",
}  # fmt: skip
VIEWER_LAWS = {
    "end": "declares: its end is 'txt'", "refuses": "conforms: it makes no file of this log: too old",
    "number": "conforms: .* gave an int; why_not has to give a str", "text": "conforms: .* make has to give a bytes",
    "plain": "conforms: its link to .* escaped", "nowhere": "conforms: its link to", "scheme": "conforms: its link to",
    "log": "pure: it changes the log", "empty": "empties: .* KeyError",
}  # fmt: skip
PLAYER_LAWS = {
    "silent": "conforms: .* AttributeError", "still": "conforms: .* ZeroDivisionError", "large": "conforms: it takes 17.0 MB",
    "state": "pure: the same log is shown in another way", "type": "conforms: .* gave a bytes; page has to give a LogPage",
    "policy": "declares: its policy", "log": "pure: it changes the log", "empty": "empties: .* KeyError",
}  # fmt: skip
LINE_LAWS = {
    "none": "conforms: it gives no lines", "number": "conforms: a heading .*: \\('a', 3\\)", "lines": "conforms: a heading",
    "blank": "conforms: a heading", "list": "conforms: .* gave a list; it has to give a dict",
    "fails": "conforms: .* failed: ZeroDivisionError", "folder": "process: ",
}  # fmt: skip
STORE_LAWS = {
    "ghost": "absent: `find` finds", "silent": "absent: `why_absent` gives no", "empty": "absent: `read_end` reads",
    "raises": "conforms: find raises KeyError", "lines": "conforms: read_end says", "size": "conforms: the size of a version",
    "end": "conforms: `read_end` of 5 bytes", "ranges": "conforms: `read_ranges` gives other", "etag": "versions: another content",
    "prefix": "conforms: `list_objects` gives others", "stale": "versions: `read_ranges` reads", "left": "conforms: `check` leaves",
    "careless": "versions: `replace` overwrites another version than Version", "writes": "versions: what was refused is written",
    "check": "conforms: `check` says {}", "faults": "conforms: `check` says Store", "keeps": "conforms: `delete` leaves", "folder": "process: ",
}  # fmt: skip
CREW_LAWS = {
    "places": "conforms: it has 0 places after 0.5 s", "silent": "conforms: nothing came of good within", "twice": "conforms: good has a second reply",
    "others": "conforms: good is done, and its reply", "result": "conforms: the result of good is not", "lines": "conforms: good is done",
    "raises": "conforms: good raises KeyError", "here": "conforms: good is done, and its reply .* in the process that asks",
    "idle": "conforms: it is busy with", "lost": "conforms: it is busy with .* it lost 'gone'", "endless": "stop: work goes on",
}  # fmt: skip


class Judge:
    def __init__(self, breaks: str = "") -> None:
        self.breaks, self.seen = breaks, 0

    def __call__(self, before: list[Any], after: list[Any]) -> Any:
        self.seen += 1
        if self.breaks == "folder":
            os.chdir("/")
        if self.breaks == "crops":
            before[0][:] = 0
        a, b = (np.mean([crop[2 if self.breaks == "small" else 0].mean() for crop in side]) for side in (before, after))
        own = {"crops": 0.0, "many": "many", "nan": np.nan, "state": self.seen, "distance": abs(a - b)}
        return own.get(self.breaks, -abs(a - b))


def page_of(breaks: str) -> Any:
    """A page of the topics of a log, which can't be made without any."""

    def make(opened: Any) -> Any:
        if not opened.channels and breaks != "blank":
            raise KeyError("topic") if breaks == "empty" else McaptrackError("nothing is here")
        if breaks == "log":
            with opened.path.open("ab") as stream:
                stream.write(b"x")
        topics = " ".join(opened.channels)
        own = {"text": topics, "bytes": b"\xff", "state": str(next(NUMBERS)).encode()}
        return own.get(breaks, topics.encode())

    policy = {"policy": "", "lines": "default-src 'none'\nX: y"}.get(breaks, "default-src 'none'")
    if breaks == "folder":
        os.chdir("/")
    return b"" if breaks == "type" else LogPage(make, policy)


def viewer_of(breaks: str) -> WebViewer:
    def link(address: str) -> str:
        if breaks == "scheme":
            return f"javascript:open({quote(address)!r})"
        return f"https://a.example/?{f'url={address}' if breaks == 'plain' else urlencode({'url': address * (breaks != 'nowhere')})}"

    def why_not(opened: Any) -> Any:
        return {"refuses": "too old", "number": 3}.get(breaks, "")

    return WebViewer("txt" if breaks == "end" else ".a.txt", page_of(breaks).make, link, why_not)


class Player:
    def __init__(self, breaks: str = "") -> None:
        self.breaks = breaks

    def show(self, opened: Any, at_s: float | None, **options: Any) -> Any:
        if not opened.channels:
            raise KeyError("topic") if self.breaks == "empty" else McaptrackError("nothing is here")
        if self.breaks == "still":
            at_s = at_s and 1 / 0
        own = {"large": "x" * 17_000_000, "state": str(next(NUMBERS))}
        html = own.get(self.breaks, f"{at_s}")
        return SimpleNamespace() if self.breaks == "silent" else SimpleNamespace(_repr_html_=lambda: html)

    def page(self, camera: str, is_above: bool) -> Any:
        return page_of(self.breaks)


class Crew(Processes):
    """Processes, which break a law."""

    def __init__(self, breaks: str = "") -> None:
        super().__init__(WorkerLimits())
        self.breaks = breaks
        self.places = 0 if breaks == "places" else 1

    def start(self, request: Request, then: Callable[[Any], None]) -> None:
        def changed(future: Future[Reply]) -> None:
            if self.breaks == "twice":
                then(future)
            if self.breaks in ("others", "result", "lines"):
                own = {"others": {"log": Path("b")}, "result": {"result": None}, "lines": {"error": "a\nb"}}
                made, future = future.result(), Future()
                future.set_result(replace(made, **own[self.breaks]))
            if self.breaks == "raises":
                future = Future()
                future.set_exception(KeyError("x"))
            then(future)

        if self.breaks == "here":
            here: Future[Reply] = Future()
            here.set_result(do(request, lambda *_: None))
            then(here)
        elif self.breaks != "silent":
            super().start(request, changed)

    def running(self) -> Any:
        return () if self.breaks == "idle" else super().running()

    def lost(self) -> str:
        return "gone" if self.breaks == "lost" else ""

    def stop(self, grace_s: float) -> None:
        if self.breaks != "endless":
            super().stop(grace_s)


def memory(breaks: str, objects: dict[str, bytes]) -> type:
    """A store that keeps objects here, which breaks a law."""

    class Memory:
        def __init__(self, url: Url) -> None:
            if breaks == "folder":
                os.chdir("/")

        def find(self, url: Url) -> Any:
            if breaks in ("raises", "ghost") and url not in objects:
                return Version(1, "a") if breaks == "ghost" else objects[url]
            size, tag = (
                len(objects.get(url, "")) + (breaks == "size"),
                None if breaks == "etag" else str(objects.get(url)),
            )
            return Version(size, tag) if url in objects else None

        def read_end(self, url: Url, size: int) -> Any:
            if url not in objects and breaks != "empty":
                raise AbsentError(f"{url} is not here" + "\n" * (breaks == "lines"))
            return self.find(url), objects.get(url, b"")[-99 if breaks == "end" else -size :]

        def read_ranges(self, url: Url, version: Version, ranges: Any) -> list[bytes]:
            if self.find(url) != version and breaks != "stale":
                raise replaced(url)
            return [objects[url][start:end] for start, end in (reversed(ranges) if breaks == "ranges" else ranges)]

        def replace(self, url: Url, file: Path, before: Version | None) -> Any:
            if self.find(url) != before and breaks != "careless":
                objects.update({url: file.read_bytes()} if breaks == "writes" else {})
                raise McaptrackError(f"{url} was written by another process")
            objects[url] = file.read_bytes()
            return self.find(url)

        def delete(self, url: Url) -> None:
            if breaks != "keeps":
                objects.pop(url, None)

        def list_objects(self, prefix: Url) -> Any:
            return [(url, self.find(url)) for url in objects if url.startswith(prefix + "/" * (breaks != "prefix"))]

        def why_absent(self, url: Url) -> str:
            return "" if breaks == "silent" else "nothing is here"

        def check(self, url: Url) -> Any:
            if breaks == "left":
                objects[url / "b"] = b""
            why = "no" if breaks == "faults" else ""
            return {} if breaks == "check" else StoreCheck(url, "here", "", "none", {"list": why})

    return Memory


def lines_of(breaks: str) -> Any:
    if breaks == "folder":
        os.chdir("/")
    own = {"none": {}, "number": {"a": 3}, "lines": {"a": "b\nc"}, "blank": {"": "b"}, "list": ["a"]}
    return 1 / 0 if breaks == "fails" else own.get(breaks, {"a": "b"})


def check_format(breaks: str) -> None:
    Path("a.numbers").write_text("0 1 2 30 40\n1 2 2 30 40\n1 90 2 30 400\n")
    testing.check_label_format(Format(breaks), Path("a.numbers"))


def check_reader(breaks: str) -> None:
    testing.check_message_reader(Reader(breaks), [{"boxes": [{"x": k}] * k} for k in range(3)])


def check_recording(breaks: str) -> None:
    Path("a.numbers").write_text("#numbers 10 20 20 30\n")
    testing.check_recording_format(Recordings(breaks), Path("a.numbers"))


@cache
def small() -> bytes:
    Path("b.csv").write_text(TABLE)
    done("ingest", "b.csv", "--fps", "10", "--classes", "all", "-o", "a.mcap", "--force")
    return Path("a.mcap").read_bytes()


def small_log() -> str:
    Path("a.mcap").write_bytes(small())
    return "a.mcap"


def check_export(breaks: str) -> None:
    testing.check_exporter(Export(breaks), small_log())


def check_judge(breaks: str) -> None:
    testing.check_judge(Judge(breaks))


def check_page(breaks: str) -> None:
    testing.check_page(lambda: page_of(breaks), small_log())


def check_viewer(breaks: str) -> None:
    testing.check_viewer(lambda: viewer_of(breaks), small_log())


def check_player(breaks: str) -> None:
    testing.check_player(Player(breaks), small_log())


def check_doctor_lines(breaks: str) -> None:
    testing.check_doctor_lines(lambda: lines_of(breaks))


def check_store(breaks: str) -> None:
    testing.check_store(memory(breaks, {}), "s3://bucket/night")


CHECKS: list[tuple[Callable[[str], None], dict[str, str]]] = [
    (check_format, FORMAT_LAWS),
    (check_reader, READER_LAWS),
    (check_recording, RECORDING_LAWS),
    (check_export, EXPORT_LAWS),
    (check_judge, JUDGE_LAWS),
    (check_page, PAGE_LAWS),
    (check_viewer, VIEWER_LAWS),
    (check_player, PLAYER_LAWS),
    (check_doctor_lines, LINE_LAWS),
    (check_store, STORE_LAWS),
]


@pytest.mark.parametrize(
    ("check", "breaks", "said"),
    [(check, breaks, said) for check, laws in CHECKS for breaks, said in ({"": ""} | laws).items()],
    ids=lambda value: value if isinstance(value, str) else value.__name__,
)
def test_a_check_names_the_law_that_is_broken(tmp_path, monkeypatch, check, breaks, said):
    monkeypatch.chdir(tmp_path)
    if not breaks:
        check("")
        return
    with pytest.raises(LawError, match=said):
        check(breaks)
    assert Path.cwd() == tmp_path


def test_a_class_in_the_place_of_an_object_is_refused():
    for check, part in (
        (testing.check_label_format, Format),
        (testing.check_message_reader, Reader),
        (testing.check_exporter, Export),
        (testing.check_recording_format, Recordings),
        (testing.check_player, Player),
        (lambda part, _: testing.check_judge(part), Judge),
        (lambda part, _: testing.check_crew(part), Crew),
    ):
        with pytest.raises(LawError, match="is a class; give an object"):
            check(part, [])
        with pytest.raises(LawError, match="has no method"):
            check(SimpleNamespace(), [])
    with pytest.raises(LawError, match="declares: judge function could not be made"):
        testing.check_judge(lambda before, after: 0.0)
    with pytest.raises(LawError, match="declares: player Show has no method page"):
        testing.check_player(type("Show", (), {"show": print})(), "a.mcap")


def test_a_store_of_a_package_is_read_and_one_that_fails_is_named(site, monkeypatch):
    objects = {"s3://b/a.mcap": Path(small_log()).read_bytes()}
    store = memory("", objects)
    monkeypatch.setattr("mcaptrack.objects.names", lambda _: ("s3",))
    monkeypatch.setattr("mcaptrack.objects.find", lambda *_: Entry("s3", "store", store, "another", "another", "2.0"))
    assert json.loads(done("info", "s3://b/a.mcap", "--json").out)["results"][0]["messages"] == 2
    assert one_line("info", "s3://b/b.mcap") == "mcaptrack: s3://b/b.mcap can't be read: nothing is here"
    assert "s3://b: objects can't be listed" not in call("doctor", "s3://b").err
    objects["s3://b/a.mcap"] = None
    said = (
        "mcaptrack: store s3 (another 2.0) failed at s3://b/a.mcap: TypeError: object of type 'NoneType' has no len()"
    )
    assert one_line("info", "s3://b/a.mcap").startswith(said)
    monkeypatch.setattr("mcaptrack.objects.names", lambda _: ("gs",))
    said = "s3://b/a.mcap is in Amazon S3, and what reads it is an extension that isn't installed"
    monkeypatch.setattr("mcaptrack.installed._extensions", set)
    assert (
        one_line("info", "s3://b/a.mcap")
        == f"mcaptrack: {said}; install mcaptrack again, with mcaptrack/extensions/stores"
    )


@pytest.mark.parametrize(("breaks", "said"), one_in(len(CREW_LAWS) + 1, {"": "", **CREW_LAWS}.items()))
def test_the_check_of_a_crew_names_the_law(breaks, said, monkeypatch):
    monkeypatch.setattr("mcaptrack.testing.crews._STOPPED_S", 10.0 if breaks != "endless" else 1.0)
    crew = Crew(breaks)
    try:
        with pytest.raises(LawError, match=said) if said else nullcontext():
            testing.check_crew(crew, patience_s=60.0 if breaks not in ("silent", "places") else 0.5)
    finally:
        Processes.stop(crew, 0.0)


class Undocumented:
    pass


def inner() -> Callable[[], int]:
    def three() -> int:
        """Three."""
        return 3

    return three


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("Format", Entry, ""),
        ("for", Entry, "is no public name of Python"),
        ("a-name", Entry, "is no public name of Python"),
        ("_hidden", Entry, "is no public name of Python"),
        ("run", Entry, "mcaptrack has the name run already"),
        ("log", Entry, "mcaptrack has the name log already"),
        ("Undocumented", Undocumented, "has no docstring"),
        ("three", 3, "is no class or function but of type int"),
        ("inner", inner(), "can't be read or found by others"),
    ],
)
def test_the_check_of_a_name_names_the_law(name, value, said):
    with pytest.raises(LawError, match=f"declares: .*{said}") if said else nullcontext():
        testing.check_name(name, value)


@pytest.mark.parametrize(
    ("kind", "name"), [(kind, name) for kind in ("page", "player", "doctor_line", "name") for name in own(kind)]
)
def test_parts_of_our_own_keep_the_laws(kind, name, template):
    entry = find(kind, name)
    {
        "page": lambda: testing.check_page(entry.cls, template),
        "player": lambda: testing.check_player(entry.made(), template),
        "doctor_line": lambda: testing.check_doctor_lines(entry.cls),
        "name": lambda: testing.check_name(name, entry.cls),
    }[kind]()


def test_a_file_that_is_not_there_is_one_line():
    for check in (
        partial(testing.check_label_format, Format()),
        partial(testing.check_recording_format, Recordings()),
        partial(testing.check_exporter, Export()),
        partial(testing.check_finisher, silent),
        partial(testing.check_report_section, silent),
        partial(testing.check_scene_maker, silent),
        partial(testing.check_page, silent),
        partial(testing.check_viewer, silent),
        partial(testing.check_player, Player()),
    ):
        with pytest.raises(McaptrackError, match=r"none\.mcap does not exist") as refusal:
            check("none.mcap")
        assert "\n" not in str(refusal.value)


@declared()
def silent(count: int = 1) -> int:
    """Count."""
    return count


@declared()
def hungry(name: str) -> str:
    """Greet.

    Parameters
    ----------
    name : str
        Who is greeted.
    """
    return name


@declared()
def odd() -> Any:
    """Return what can't be printed."""
    return iter(())


@declared()
def moving() -> None:
    """Move."""
    os.chdir("/")


@pytest.mark.parametrize(
    ("function", "arguments", "said"),
    [
        (lambda: None, (), "is not declared"),
        (silent, (), "doesn't say what count means"),
        (hungry, ("a",), "has no default of name"),
        (odd, (), "returns a tuple_iterator"),
        (moving, (), "process: it changes the working folder"),
    ],
)
def test_the_check_of_a_command_names_the_law_that_is_broken(function, arguments, said):
    with pytest.raises(LawError, match=said):
        testing.check_command(function, *arguments)


@pytest.mark.parametrize(
    ("sample", "said"),
    [("mot", ""), ("shifted", "again: mot reads other boxes"), ("cut", "again: mot reads 2 boxes of the 3")],
)
def test_what_an_exporter_writes_is_read_again(site, tracked, sample, said):
    class Changed(MotFile):
        def content(self, boxes):
            text = b"".join(super().content(boxes))
            yield {"shifted": text.replace(b",10.0,", b",11.0,"), "cut": text.partition(b"\n")[2]}.get(sample, text)

    with pytest.raises(LawError, match=said) if said else nullcontext():
        testing.check_exporter(Changed(), tracked, format_named("mot"))


@pytest.mark.parametrize(
    ("part", "replaced", "by", "said"),
    [
        ("crowded", "is_outdated", lambda *_: False, "again: /camera/tracks/crowded is not made again where tracks"),
        (
            "crowded",
            "is_outdated",
            lambda *_: True,
            "again: it makes /camera/tracks/crowded again, which is up to date",
        ),
        ("crowded", "Provenance", lambda name, *how: Provenance("other", *how), "conforms: .* is not below its input"),
        ("crowded", "Crowded", lambda _: SimpleNamespace(make=lambda *_: {}), "conforms: it makes nothing"),
        ("crowded", "Finished", lambda *_: 3, "conforms: .* gave an int; report has to give a Finished"),
        ("crowded", "Provenance", lambda *how: os.chdir("/") or Provenance(*how), "process: .* the working folder"),
        ("lengths", "ReportSection", lambda *_: None, "conforms: it says nothing of this log"),
        ("lengths", "ReportSection", lambda *_: "html", "conforms: .* gave a str; its function has to give"),
        (
            "lengths",
            "ReportSection",
            lambda *all: ReportSection(*all, note=str(next(NUMBERS))),
            "pure: .* another section",
        ),
        ("lengths", "SectionTable", lambda *all: SectionTable("a", [3], []), "conforms: .* 3 is no text"),
        ("lengths", "len", lambda rows: os.chdir("/") or "1", "process: .* the working folder"),
    ],
)
def test_the_check_of_a_finisher_and_of_a_section_names_the_law(site, finished, monkeypatch, part, replaced, by, said):
    module = import_module(part)
    if part == "crowded":
        check = partial(testing.check_finisher, module.crowded, finished, crowded=2)
    else:
        check = partial(testing.check_report_section, module.lengths, finished)
    with collected() as said_of_copies:
        check()
    assert said_of_copies == []
    if part == "crowded":
        with pytest.raises(LawError, match=r"declares: .* can't have its name: the result of run has next"):
            check(name="next")
    monkeypatch.setattr(module, replaced, by, raising=False)
    with pytest.raises(LawError, match=said):
        check()


def test_a_section_of_a_log_without_channels_is_noticed(finished):
    with pytest.raises(LawError, match="empties: a log without channels has a section"):
        testing.check_report_section(lambda *_: ReportSection("a", "b"), finished)


# Scenes of several cameras


MEETING = FILES["meeting.py"].replace("def meeting", "def Part")


@pytest.mark.usefixtures("site")
def test_a_scene_of_a_package_that_is_no_maker_of_scenes_is_one_line():
    entry = Entry("odd", "scene", lambda: 3, "another", "another", "2.0")
    with pytest.raises(
        McaptrackError, match=r"scene odd \(another 2.0\) gave an int; its function has to give a Scene"
    ):
        Scenes([(entry, 3)])


@pytest.fixture
def run_cameras(site, monkeypatch) -> Callable[[str], mcaptrack.RunResult]:
    """Run a log of two cameras where a package has this maker of scenes."""

    def run(code: str) -> mcaptrack.RunResult:
        add(site, "scene", "meeting", code)
        parts = PartsOfRun()
        parts.options(())
        monkeypatch.setattr("mcaptrack.api.run._PARTS", parts)
        Path("boxes.txt").write_text("".join(f"{n},-1,{10 + n},20,20,60,0.9,-1,-1,-1\n" for n in range(1, 13)))
        for name, where in (("left", "output"), ("right", "into")):
            mcaptrack.ingest("boxes.txt", fps=2, role="detections", camera=name, **{where: "a.mcap"})
        return mcaptrack.run("a.mcap", tables=False, predictor="cv")

    return run


def test_a_package_makes_a_scene_of_cameras(site, run_cameras):
    result = run_cameras(MEETING)
    assert [(name, camera.is_scene) for name, camera in result.cameras.items()][-1] == ("world", True)
    assert result.cameras["world"].summary.tracks == 1
    assert mcaptrack.run("a.mcap", tables=False).is_up_to_date
    shutil.rmtree(site / "another-2.0.dist-info")
    assert mcaptrack.run("a.mcap", tables=False).is_up_to_date
    done("retrack", "a.mcap", "--camera", "world")


def test_options_of_a_maker_of_scenes_that_change_nothing_are_named(run_cameras):
    run_cameras(MEETING.replace("] = True", "] = False"))
    said = []
    for _ in range(2):
        with collected() as warnings:
            mcaptrack.run.__wrapped__("a.mcap", tables=False, predictor="cv", meet=True)
        said.append([notice.message for notice in warnings if notice.code == "option-not-used"])
    assert said[0] == []
    assert "meet" in said[1][0]
    assert said[1][0].endswith("changes nothing here: the log has a scene, or another maker of scenes came first")


@thorough
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("        how = ", "        how = 1 / 0\n        how = "), "failed: ZeroDivisionError: division by zero (ano"),
        (("    return Meeting(", "    1 / 0\n    return Meeting("), "failed: ZeroDivisionError: division by zero (ano"),
    ],
)
def test_a_package_that_fails_at_making_a_scene_is_named_and_the_cameras_are_run(run_cameras, change, said):
    with collected() as warnings:
        result = run_cameras(MEETING.replace(*change))
    assert [*result.cameras] == ["left", "right"]
    reasons = (result.not_fused, *(notice.message for notice in warnings))
    assert any(why.startswith(f"scene meeting (another 2.0) {said}") for why in reasons)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("", ""), ""),
        (("list(cameras), ", '["attic"], '), r"conforms: of the cameras \['left', 'right'\] it joins \['attic'\]"),
        (('"fuse", ', '"track", '), "conforms: the detections of the scene are not fused of the cameras"),
        (("x_m=[1.0]", "x_m=[float(next(NUMBERS))]"), "pure: the same cameras give another scene"),
        (("        place = ", "        import os; os.chdir('/')\n        place = "), "process: .* the working folder"),
        (("    return Meeting(", "    return 3 # "), "conforms: .* its function has to give a SceneMaker"),
    ],
)
def test_the_check_of_a_maker_of_scenes_names_the_law(run_cameras, change, said):
    run_cameras(MEETING)
    names: dict[str, Any] = {"NUMBERS": NUMBERS, "__name__": "another"}
    exec(MEETING.replace(*change), names)
    with pytest.raises(LawError, match=said) if said else nullcontext():
        testing.check_scene_maker(names["Part"], "a.mcap")
