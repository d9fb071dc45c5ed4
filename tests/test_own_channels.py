"""Rows of a user's own schemas, own forecasts and own events: written, and read as any other channel, by others, too."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Annotated, Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DETECTIONS, EVENTS, PREDICTIONS, SCHEMAS, TRACKS, VIDEO, Frame, Schema
from mcaptrack.schema.own import columns_in_metadata
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.cameras import cameras as cameras_of
from tests.commands import done
from tests.logs import recorder
from tests.tiers import thorough
from tests.worlds import write_clip

DTYPES = ["f8", ">f4", "f2", "i8", ">i4", "i2", "i1", "u8", "u4", "u2", "u1", "?"]
#: Words of Python, ROS and SQL, names that protobuf's JSON takes for one, and names that ours have.
ODD = ["from", "int", "float64", "select", "a1", "a_1", "class_id", "x_px", "rows", "index", "string"]
STEP_NS = 400_000_000
BESIDE = ("t", "t_ns", "frame", "row", "topic", "recording", "class", "zone")
NAMES = st.sampled_from(ODD) | st.from_regex(r"[a-z][a-z0-9]{0,4}(_[a-z0-9]{1,3}){0,2}", fullmatch=True)


def channel_of(recording: mcaptrack.Recording, topic: str) -> log.Channel:
    with recording._now() as opened:
        return opened.channel(topic)


@st.composite
def tables(draw) -> np.ndarray:
    """Structured arrays of any columns that rows can hold, with times in any order."""
    names = draw(st.lists(NAMES.filter(lambda name: name not in BESIDE), min_size=1, max_size=6, unique=True))
    dtype = [(name, draw(st.sampled_from(DTYPES))) for name in names]
    values = draw(arrays(np.dtype(dtype), st.integers(0, 9)))
    out = np.empty(len(values), [("t_ns", "i8"), *dtype])
    out["t_ns"] = draw(arrays(np.int64, len(values), elements=st.integers(0, 4) | st.integers(0, 2**62)))
    for name in names:
        out[name] = values[name]
        if out.dtype[name].kind == "f":
            out[name][np.isnan(out[name])] = np.nan  # one of its many NaNs, as tables have it
    return out


@contextmanager
def folder() -> Iterator[Path]:
    with TemporaryDirectory() as name:
        yield Path(name)


def ros_recording(path: Path) -> Path:
    """A recording of ROS 2 with one message."""
    with recorder(path, "ros2") as writer:
        schema = writer.register_schema("std_msgs/msg/UInt8", "ros2msg", b"uint8 data\n")
        writer.add_message(writer.register_channel("/count", "cdr", schema), 7, b"\0\1\0\0\5", 7)
    return path


def assert_equal(found: Any, wanted: np.ndarray) -> None:
    np.testing.assert_array_equal(np.asarray(found, wanted.dtype).reshape(-1), wanted)  # NaN equals NaN


def by_time(rows: np.ndarray) -> dict[int, np.ndarray]:
    return {t_ns: rows[rows["t_ns"] == t_ns] for t_ns in sorted(set(rows["t_ns"].tolist()))}


class TestRoundTrip:
    @given(tables())
    def test_rows_come_back_and_the_protobuf_runtime_reads_the_same(self, rows):
        with folder() as place, mcaptrack.open(place / "a.mcap", create=True) as opened:
            schema = mcaptrack.schema_of("Thing", rows.dtype)
            wanted = by_time(rows)
            assert opened.write("/any/thing", rows, schema=schema) == len(wanted)
            frames = list(opened.frames("/any/thing"))
            table, array = opened.table("/any/thing"), opened.array("/any/thing")
            with (place / "a.mcap").open("rb") as stream:
                reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
                theirs = {message.log_time: decoded.rows for *_, message, decoded in reader.iter_decoded_messages()}
        assert [frame.t_ns for frame in frames] == list(theirs) == list(wanted)
        assert array["t_ns"].tolist() == sorted(rows["t_ns"].tolist())
        for name in rows.dtype.names[1:]:
            in_order = np.concatenate([part[name] for part in wanted.values()] or [rows[name]])
            assert_equal(array[name], in_order)
            is_float = rows.dtype[name].kind == "f"
            assert table.column(name).null_count == (np.isnan(rows[name]).sum() if is_float else 0)
            for frame, (t_ns, part) in zip(frames, wanted.items(), strict=True):
                assert_equal(frame.rows[name], part[name])
                assert_equal([getattr(row, name) for row in theirs[t_ns]], part[name])

    @given(tables())
    @thorough
    def test_in_a_recording_of_ros_2_rows_are_messages_that_rosbags_reads(self, rows):
        with folder() as place:
            path = ros_recording(place / "a.mcap")
            with mcaptrack.open(path) as opened:
                opened.write("/any/thing", rows, schema=mcaptrack.schema_of("my_tool.Thing", rows.dtype), sidecar=False)
                array = opened.array("/any/thing")
            with AnyReader([path]) as reader:
                found = [(c, t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages()]
        theirs = {t_ns: message.rows for connection, t_ns, message in found if connection.topic == "/any/thing"}
        assert {connection.msgtype for connection, *_ in found} <= {"std_msgs/msg/UInt8", "my_tool_msgs/msg/Thing"}
        wanted = by_time(rows)
        assert list(theirs) == list(wanted)
        for name in rows.dtype.names[1:]:
            attribute = "from_" if name == "from" else name
            assert_equal(array[name], np.concatenate([part[name] for part in wanted.values()] or [rows[name]]))
            for t_ns, part in wanted.items():
                assert_equal([getattr(row, attribute) for row in theirs[t_ns]], part[name])

    @given(tables())
    def test_what_is_read_can_be_written_again_and_is_the_same(self, rows):
        digests = set()
        with folder() as place, mcaptrack.open(place / "a.mcap", create=True) as opened:
            schema = mcaptrack.schema_of("Thing", rows.dtype)
            opened.write("/a", rows, schema=schema)
            for number, again in enumerate((list(opened.frames("/a")), opened.array("/a"), opened.table("/a"))):
                without_text = again if isinstance(again, list) else _without_class(again)
                opened.write(f"/again/a{number}", without_text, schema=schema)
            for topic in ("/a", "/again/a0", "/again/a1", "/again/a2"):
                channel = channel_of(opened, topic)
                digests.add(channel.metadata["mcaptrack.digest"])
                assert channel.schema is schema
        assert len(digests) == 1

    def test_names_that_json_takes_for_one_are_kept_apart(self, tmp_path):
        rows = np.array([(5, 1.0, 2.0)], [("t_ns", "i8"), ("a1", "f8"), ("a_1", "f8")])
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            opened.write("/a", rows)
        with (tmp_path / "a.mcap").open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            ((*_, decoded),) = reader.iter_decoded_messages()
        assert (decoded.rows[0].a1, decoded.rows[0].a_1) == (1.0, 2.0)

    def test_frames_keep_their_numbers_and_those_without_rows(self, tmp_path):
        rows = np.array([(1.5,)], [("speed", "f8")])
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            assert opened.write("/car/speed", [Frame(9, 4, rows), Frame(5, 2, rows[:0])]) == 2
            assert [(f.t_ns, f.index, f.rows["speed"].tolist()) for f in opened.frames("speed")] == [
                (5, 2, []),
                (9, 4, [1.5]),
            ]
            frames = opened.table("frames").select(["topic", "t_ns", "frame", "rows"]).to_pylist()
        assert [tuple(row.values()) for row in frames] == [("/car/speed", 5, 2, 0), ("/car/speed", 9, 4, 1)]

    def test_rows_are_found_by_the_end_of_their_topic_if_it_is_the_only_one(self, tmp_path):
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            opened.write("/a/speed", cars())
            opened.write("/b/speed", cars(v=[1.0, 2.0]))
            opened.write("/b/height", cars())
            assert len(list(opened.frames("height"))) == 2
            for topic, options, words in (
                ("speed", {}, "has 2 channels speed: /a/speed, /b/speed; name one"),
                ("height", {"times": [0]}, "`times=` chooses pictures, and /b/height holds rows"),
                ("width", {}, "no channel width with pictures"),
            ):
                with pytest.raises(McaptrackError, match=words):
                    next(opened.frames(topic, **options))

    def test_pictures_go_before_rows(self, tmp_path):
        path, schema = tmp_path / "a.mcap", mcaptrack.schema_of("Speed", [("speed_m_per_s", "f8")])
        write_clip(tmp_path / "clip.mp4", frames=3)
        mcaptrack.ingest(tmp_path / "clip.mp4", path)
        with log.read(path) as opened, log.extend(opened) as writer:
            record = (schema.name, "protobuf", schema.descriptor)
            writer.add_channel("/x/video", record, "protobuf", {"mcaptrack.columns": columns_in_metadata(schema)})
        with mcaptrack.open(path) as opened:
            assert next(opened.frames("/camera/video")).rows.ndim == 3
            assert next(opened.frames()).rows.ndim == 3
            assert list(opened.frames("/x/video")) == []


def _without_class(rows: Any) -> Any:
    """A table or array without the names of classes, which the rows of a schema don't have."""
    if isinstance(rows, pa.Table):
        return rows.drop_columns(["class"]) if "class" in rows.column_names else rows
    return rows[[name for name in rows.dtype.names if name != "class"]]


@dataclass
class Fix:
    t_ns: int
    lat: Annotated[float, "deg"]
    lon: float | None = field(default=None, metadata={"unit": "deg", "doc": "east of Greenwich"})
    satellites: np.uint8 = np.uint8(0)
    speed_m_per_s: float = np.nan
    is_fixed: bool = True


class TestSchemas:
    def test_dataclasses_dtypes_and_schemas_of_arrow_give_the_same(self):
        columns = [("lat", "f8"), ("lon", "f8"), ("satellites", "u1"), ("speed_m_per_s", "f8"), ("is_fixed", "?")]
        units, doc = {"lat": "deg", "lon": "deg"}, {"lon": "east of Greenwich"}
        kinds = {"f8": pa.float64(), "u1": pa.uint8(), "?": pa.bool_()}
        of_arrow = pa.schema(
            pa.field(name, kinds[kind], metadata={"unit": units.get(name, ""), "description": doc.get(name, "")})
            for name, kind in columns
        )
        schema = mcaptrack.schema_of("Fix", Fix)
        assert mcaptrack.schema_of("Fix", columns, units=units, doc=doc) is schema
        assert mcaptrack.schema_of("own.Fix", of_arrow) is schema
        assert [(c.kind, c.unit) for c in schema.columns] == [
            ("double", "deg"), ("double", "deg"), ("fixed32", ""), ("double", "m/s"), ("bool", ""),
        ]  # fmt: skip

    @pytest.mark.parametrize("encoding", ["protobuf", "cdr"])
    def test_units_and_descriptions_come_back(self, tmp_path, encoding):
        path = ros_recording(tmp_path / "a.mcap")
        with mcaptrack.open(path) as opened:
            opened.write("/gps", [Fix(1, 2.0), Fix(3, 4.0, 5.0)], sidecar=encoding == "protobuf")
            assert channel_of(opened, "/gps").message_encoding == encoding
            table = opened.table("/gps")
        facts = {f.name: (f.metadata[b"unit"], f.metadata[b"description"]) for f in table.schema}
        assert (facts["lon"], facts["speed_m_per_s"][0]) == ((b"deg", b"east of Greenwich"), b"m/s")
        assert (table["lon"].to_pylist(), table["satellites"].to_pylist()) == ([None, 5.0], [0, 0])

    UNFIT = [
        ({"columns": [("name", "U5")]}, "the column name holds text, lists or objects.*np.unique"),
        ({"columns": [("v", "f8", (3,))]}, r"the column v has the shape \(3,\); give each"),
        ({"columns": [("v", "c16")]}, "the column v holds complex numbers"),
        ({"columns": [("v", "M8[ns]")]}, "the column v holds times; give whole nanoseconds"),
        ({"columns": [("v", "O")]}, "the column v holds text, lists or objects"),
        ({"columns": [("Speed", "f8")]}, "'Speed' can't name a column of own.N"),
        ({"columns": [("a__b", "f8")]}, "'a__b' can't name a column"),
        ({"columns": [("zone", "f8")]}, "own.N.zone is a column that tables have"),
        ({"columns": [("t_ns", "i8")]}, "has 0 columns beside the time"),
        ({"columns": "f8"}, "columns are those of a dataclass, of a dtype .* not 'f8'"),
        ({"columns": None}, "columns are those of a dataclass"),
        ({"columns": pa.schema([("v", pa.list_(pa.int8()))])}, "the column v holds text, lists"),
        ({"name": "speed"}, "'speed' can't name a schema"),
        ({"name": "a.b.C"}, "'a.b.C' can't name a schema"),
        ({"name": "sensor.Image"}, "in the package sensor, which is not yours; name the schema own.Image"),
        ({"name": "mcaptrack.Tracks"}, "in the package mcaptrack"),
        ({"units": {"w": "m"}}, "`units=` has w, and the columns are v"),
        ({"units": {"v": "a\nb"}}, "the unit of own.N.v is printable text"),
        ({"doc": {"v": 5}}, "the description of own.N.v is printable text"),
    ]  # fmt: skip

    @pytest.mark.parametrize(("unfit", "words"), UNFIT)
    def test_what_can_be_no_schema_is_refused_in_a_line(self, unfit, words):
        with pytest.raises(McaptrackError, match=words) as refused:
            mcaptrack.schema_of(**({"name": "N", "columns": [("v", "f8")]} | unfit))
        assert "\n" not in str(refused.value)

    def test_metadata_that_others_have_spoiled_are_no_schema(self, tmp_path):
        good = mcaptrack.schema_of("Thing", [("v", "f8")])
        row = np.array([(1.5,)], [("v", "f8")])
        for number, spoiled in enumerate(
            ("", "{", "5", "[5]", "[[]]", '[["v","text","",""]]', '[["V","double","",""]]')
        ):
            path = tmp_path / f"{number}.mcap"
            with log.create(path) as writer:
                record = (good.name, "protobuf", good.descriptor)
                channel = writer.add_channel("/a", record, "protobuf", {"mcaptrack.columns": spoiled})
                writer.add_message(channel, 5, 0, good.codec.encode(row))
            with mcaptrack.open(path) as opened:
                assert channel_of(opened, "/a").schema is None
                assert opened.table("/a").num_rows == 1  # of flattened messages


def cars(**columns: Any) -> np.ndarray:
    """Two rows at 0 and 1 ns."""
    values = {"t_ns": [0, 1]} | (columns or {"speed_m_per_s": [1.0, np.nan]})
    out = np.empty(2, [(name, np.asarray(part).dtype) for name, part in values.items()])
    for name, part in values.items():
        out[name] = part
    return out


class TestWriting:
    UNFIT = [
        ("/a/b", cars(Speed=[1.0, 2.0]), {}, "'Speed' can't name a column"),
        ("/a/b", cars(name=["x", "y"]), {}, "the column name holds text"),
        ("/a/b", cars(**{"class": [1, 2]}), {}, "the column class holds names of classes"),
        ("/a/b", pa.table({"t_ns": [0, 1], "n": [2**60, None]}), {}, r"n has whole numbers above 2\^53, and some are missing"),
        ("/a/b", pa.table({"t_ns": [0, 1], "n": [True, None]}), {}, "n has flags, and some are missing"),
        ("/a/b", [Frame(0, 0, np.zeros(3))], {}, "it is not clear"),
        ("/a/b", [Frame(0, 0, cars())], {}, "t_ns is a column that tables have .* rename it, or leave it out"),
        ("/a/b", [Fix(0, 1.0), 5], {}, "rows are of one dataclass; there are Fix and int"),
        ("/a/b", [Fix(0, "x")], {}, "Fix.lat is float64, and a row has 'x'"),
        ("/a/b", [Fix(0.5, 1.0)], {}, "Fix.t_ns is int64, and a row has 0.5"),
        ("/a/b", cars(), {"schema": "Speed"}, "`schema=` is a schema of .* not 'Speed'"),
        ("/a/b", cars(), {"schema": VIDEO}, "`schema=` is a schema of"),
        ("/a/b", cars(), {"schema": Schema("own.Other")}, "`schema=` is a schema of"),
        ("/a/b", cars(), {"schema": mcaptrack.schema_of("N", [("v", "f8")])}, "own.N has no column speed_m_per_s; it has v"),
        ("/a/b", cars(v=[1.5, 2.0]), {"schema": mcaptrack.schema_of("N", [("v", "i4")])}, "v needs whole numbers"),
        ("/a/b", cars(v=[2**40, 2]), {"schema": mcaptrack.schema_of("N", [("v", "i4")])}, "v holds -2147483648 to 2147483647"),
        ("/a/tracks", cars(), {"schema": mcaptrack.schema_of("N", [("v", "f8")])}, "a channel named tracks holds mcaptrack.Tracks"),
        ("/a/b", cars(), {"classes": {2: "car"}}, "own.AB has no column class_id"),
        ("/a/b", cars(), {"by": "a\nb"}, "`by=` is the name of a program"),
        ("/a/tracks/events", cars(), {}, "is a name of what stages make"),
        ("/a/retracks/predictions", cars(), {}, "is a name of what stages make"),
    ]  # fmt: skip

    def test_what_does_not_fit_is_refused_in_a_line_and_changes_nothing(self, tmp_path):
        path = tmp_path / "a.mcap"
        with mcaptrack.open(path, create=True) as opened:
            before = path.read_bytes()
            for topic, rows, options, words in self.UNFIT:
                with pytest.raises(McaptrackError, match=words) as refused:
                    opened.write(topic, rows, **options)
                assert "\n" not in str(refused.value)
                assert path.read_bytes() == before

    def test_the_columns_decide_what_rows_are(self, tmp_path):
        step = {"track_id": [1, 1], "step": [1, 2], "ahead_s": [0.4, 0.8], "x_m": [1.0, 2.0], "y_m": [0.0, 0.0]}
        for columns, schema in (
            ({"track_id": [1, 2], "x_m": [1.0, 2.0], "y_m": [0.0, 0.0]}, TRACKS),
            ({"x_m": [1.0, 2.0], "y_m": [0.0, 0.0]}, DETECTIONS),
            (step | {"t_ns": [0, 0]}, PREDICTIONS),
            ({"kind": [5, 6], "track_id": [1, 1]}, EVENTS),
        ):
            with mcaptrack.open(tmp_path / f"{schema.name}.mcap", create=True) as opened:
                opened.write("/my/rows", cars(**columns))
                assert channel_of(opened, "/my/rows").schema is schema
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            near = cars(track_id=[1, 2], x_m=[1.0, 2.0], y_m=[0.0, 0.0], gait=[1.0, 2.0])
            with pytest.warns(
                mcaptrack.McaptrackWarning, match="own.MyRows, because mcaptrack.Tracks has no column gait;"
            ):
                opened.write("/my/rows", near)

            box = cars(x_px=[1.0, 2.0], y_px=[1.0, 2.0], w_px=[1.0, 2.0])
            with pytest.warns(
                mcaptrack.McaptrackWarning, match="own.MyBoxes, because mcaptrack.Detections needs h_px, too"
            ):
                opened.write("/my/boxes", box)

    def test_one_name_stands_for_one_set_of_columns(self, tmp_path):
        speed = mcaptrack.schema_of("Speed", [("speed_m_per_s", "f8")])
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            opened.write("/a/speed", cars(), schema=speed)
            opened.write("/b/speed", cars(), schema=speed)
            other = mcaptrack.schema_of("Speed", [("v", "f8")])
            with pytest.raises(McaptrackError, match="/b/speed has other columns of own"):
                opened.write("/a/speed", cars(v=[1.0, 2.0]), schema=other, replace=True)
            with pytest.raises(McaptrackError, match="has /a/speed already; `replace=True` replaces it"):
                opened.write("/a/speed", cars(), schema=speed)
            opened.write("/c/speed", cars(v=[1.0, 2.0]))
            opened.write("/c/speed", cars(w=[1.0, 2.0]), replace=True)
            assert opened.array("/c/speed")["w"].tolist() == [1.0, 2.0]

    def test_rows_that_another_program_recorded_are_never_replaced(self, tmp_path):
        path, schema = tmp_path / "a.mcap", mcaptrack.schema_of("Speed", [("speed_m_per_s", "f8")])
        with log.create(path) as writer:
            record, columns = (schema.name, "protobuf", schema.descriptor), columns_in_metadata(schema)
            writer.add_channel("/a", record, "protobuf", {"mcaptrack.columns": columns})
        before = path.read_bytes()
        with mcaptrack.open(path) as opened, pytest.raises(McaptrackError, match="/a, which other software recorded"):
            opened.write("/a", cars(), schema=schema, replace=True)
        assert path.read_bytes() == before
        assert Provenance("track", {"written_by": "a parameter"}).written_by == ""

    def test_a_topic_that_ros_has_not_is_said(self, tmp_path):
        with mcaptrack.open(ros_recording(tmp_path / "a.mcap")) as opened:
            with pytest.warns(mcaptrack.McaptrackWarning, match="ROS 2 accepts no topic like /ü"):
                opened.write("/ü", cars(), sidecar=False)
            assert opened.array("/ü")["speed_m_per_s"].tolist()[0] == 1.0

    def test_tables_follow_a_log_with_rows_that_were_written_again(self, tmp_path):
        (tmp_path / "there").mkdir()
        path = ros_recording(tmp_path / "a.mcap")
        with mcaptrack.open(path) as opened:
            opened.write("/a", cars(), sidecar=False)
        mcaptrack.export(path, output=tmp_path / "tables")
        path = path.rename(tmp_path / "there" / "a.mcap")
        with mcaptrack.open(path) as opened:
            opened.write("/a", cars(speed_m_per_s=[5.0, 6.0]), sidecar=False, replace=True)
        assert "topics/a" in mcaptrack.export(path, output=tmp_path / "tables").written

    def test_names_of_columns_and_schemas_of_ours_mean_nothing_in_others(self, tmp_path):
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            opened.write("/a", cars(v=[1.0, 2.0]), schema=mcaptrack.schema_of("Tracks", [("v", "f8")]))
            opened.write("/b", cars(track_id=[9, 1], zone_id=[1, 1]))
            assert opened.array("/a")["v"].tolist() == [1.0, 2.0]
            table = opened.table("/b")
        assert table.column_names[5:] == ["track_id", "zone_id", "recording"]
        assert table["track_id"].to_pylist() == [9, 1]  # by time

    def test_who_wrote_a_channel_is_told(self, tmp_path):
        path = tmp_path / "a.mcap"
        with mcaptrack.open(path, create=True) as opened:
            opened.write("/a", cars(), by="my_tool 1.2")
            opened.write("/b", cars())
        told = {channel.topic: (channel.transform, channel.written_by) for channel in mcaptrack.info(path).channels}
        assert told["/a"] == ("ingest", "my_tool 1.2")
        assert told["/b"][1].strip()
        assert str(tmp_path) not in path.read_bytes().decode("latin-1")
        out = done("info", path).out
        assert "/a  written by my_tool 1.2" in out

    @pytest.mark.parametrize(
        ("file", "module", "name"),
        [
            ("/home/me/tool.py", None, "tool.py"),
            ("/venv/bin/pytest", None, f"pytest {pytest.__version__}"),
            ("/venv/bin/own", None, "own"),
            ("x", "pytest.__main__", f"pytest {pytest.__version__}"),
            ("x", "my_tool.cli", "my_tool.cli"),
            (None, None, "Python"),
        ],
    )
    def test_the_running_program_is_the_writer(self, tmp_path, monkeypatch, file, module, name):
        main = SimpleNamespace(__spec__=module and SimpleNamespace(name=module), __file__=file)
        monkeypatch.setitem(sys.modules, "__main__", main)
        monkeypatch.delitem(sys.modules, "ipykernel", raising=False)
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            opened.write("/a", cars())
        (channel,) = mcaptrack.info(tmp_path / "a.mcap").channels
        assert channel.written_by == name

    @thorough
    def test_rows_about_anything_make_no_camera_and_run_goes_on(self, tmp_path):
        path = tmp_path / "a.mcap"
        write_clip(tmp_path / "clip.mp4", frames=20)
        mcaptrack.ingest(tmp_path / "clip.mp4", path)
        with mcaptrack.open(path) as opened:
            opened.write("/gps/speed", cars())
            opened.write("/camera/speed", cars())
            opened.write("/own/events", cars(kind=[5, 6], track_id=[1, 1]))
            own = {topic: opened.array(topic).tobytes() for topic in ("/gps/speed", "/camera/speed")}
        assert "track" in mcaptrack.run(path, tables=False).stages
        assert mcaptrack.run(path, tables=False).stages == ()
        with log.read(path) as opened:
            assert [camera.names for camera in cameras_of(opened)] == [("/camera", "/own")]
        cameras = {channel.topic: channel.camera for channel in mcaptrack.info(path).channels}
        assert (cameras["/camera/speed"], cameras["/gps/speed"]) == ("camera", None)
        assert mcaptrack.check(path).findings == ()
        exported = mcaptrack.export(path)
        assert (exported.rows["topics/gps.speed"], exported.rows["topics/camera.speed"]) == (2, 2)
        with mcaptrack.open(path) as opened:
            assert {topic: opened.array(topic).tobytes() for topic in own} == own
        assert mcaptrack.drop(path, ["/gps/speed", "/camera/speed"]).dropped == ("/camera/speed", "/gps/speed")
        assert "topics/gps.speed" not in mcaptrack.export(path).rows

    def test_boxes_in_space_are_in_a_frame_of_their_own(self, tmp_path):
        flat = cars(track_id=[1, 1], x_m=[0.0, 1.0], y_m=[0.0, 0.0])
        solid = cars(track_id=[1, 1], x_m=[0.0, 1.0], y_m=[0.0, 0.0], z_m=[1.0, np.nan], height_m=[2.0, 2.0])
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            for topic, rows, frame_id in (("/a/tracks", flat, ""), ("/b/tracks", solid, "map")):
                opened.write(topic, rows)
                assert channel_of(opened, topic).metadata.get("mcaptrack.frame_id", "") == frame_id
            opened.write("/b/tracks", solid, frame_id="odom", replace=True)
            assert channel_of(opened, "/b/tracks").metadata["mcaptrack.frame_id"] == "odom"

    def test_names_of_classes_are_kept(self, tmp_path):
        rows = pa.table({"t_ns": [0, 1], "wheels": [4, 2], "class": ["car", "bicycle"]})
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            opened.write("/a", rows)
            found = opened.table("/a").select(["wheels", "class"]).to_pylist()
        assert found == [{"wheels": 4, "class": "car"}, {"wheels": 2, "class": "bicycle"}]


class TestOwnForecasts:
    @staticmethod
    def steps(**columns: Any) -> np.ndarray:
        usual = {
            "t_ns": [7, 7], "track_id": [1, 1], "step": [1, 2], "ahead_s": [0.4, 0.8], "x_m": [0.0, 1], "y_m": [0.0, 0],
        }  # fmt: skip
        return cars(**(usual | columns))

    FAULTS = [
        ({"step": [1, 1]}, "in row 1 step 1 of track 1 stands where 2 is due"),
        ({"step": [1, 3]}, "in row 1 step 3 of track 1 stands where 2 is due"),
        ({"step": [0, 1]}, "in row 0 step 0 of track 1 stands where 1 is due"),
        ({"ahead_s": [0.8, 0.4]}, "in row 1 ahead_s is 0.4, not after 0.8"),
        ({"ahead_s": [0.0, 0.4]}, "in row 0 ahead_s is 0, not after 0"),
        ({"track_id": [-1, -1]}, "in row 0 track_id is -1; ids are not below 0"),
        ({"cov_xx_m2": [1.0, 1]}, "only a part of cov_xx_m2, cov_xy_m2, cov_yy_m2"),
        ({"cov_xx_m2": [1.0, 1], "cov_xy_m2": [0.0, 2], "cov_yy_m2": [1.0, 1]}, "are 1, 2, 1: no covariance"),
        ({"cov_xx_m2": [-1.0, 1], "cov_xy_m2": [0.0, 0], "cov_yy_m2": [1.0, 1]}, "are -1, 0, 1: no covariance"),
        ({"wide_weight": [0.5, 2], "narrow_scale": [1.0, 1], "wide_scale": [1.0, 1]}, "are 2, 1, 1; a weight is from 0 to 1"),
        ({"wide_weight": [0.5, 0.5], "narrow_scale": [1.0, 0], "wide_scale": [1.0, 1]}, "scales are above 0"),
        ({"x_m": [np.inf, 1]}, "x_m is infinite"),
        ({"x_m": [np.nan, 1]}, "x_m is required and missing"),
    ]  # fmt: skip
    EVENT_FAULTS = [
        ({"kind": [5, 1]}, "kind is 1; kinds are 2 miss, 3 false_track"),
        ({"kind": [5, 5], "track_id": [-2, 1]}, "track_id is -2; ids are not below -1"),
        ({"kind": [5, 5], "x_m": [1.0, 1]}, "only a part of x_m, y_m"),
        ({"kind": [5, 5], "duration_s": [1.0, -1]}, "duration_s is -1.0"),
    ]  # fmt: skip

    def test_what_no_forecast_and_no_event_can_be_is_refused(self, tmp_path):
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            for columns, words in self.FAULTS:
                with pytest.raises(McaptrackError, match=words):
                    opened.write("/my/forecasts", self.steps(**columns), schema=PREDICTIONS)
            for columns, words in self.EVENT_FAULTS:
                with pytest.raises(McaptrackError, match=words):
                    opened.write("/my/events", cars(**columns))
            assert opened.topics == ()

    def test_rows_of_every_schema_are_written_as_frames(self, tmp_path):
        with mcaptrack.open(tmp_path / "a.mcap", create=True) as opened:
            for schema in SCHEMAS.values():
                topic = f"/mine/{schema.name.rpartition('.')[2].lower()}x"
                assert opened.write(topic, [Frame(5, 0, schema.empty())], schema=schema) == 1
                assert channel_of(opened, topic).schema is schema

    @pytest.mark.parametrize("above", ["/camera", "/own"])
    @pytest.mark.parametrize("off_m", [0.0, 5.0])
    def test_own_forecasts_of_own_tracks_are_scored_and_drawn(self, tmp_path, above, off_m):
        path = tmp_path / "a.mcap"
        times = np.arange(30)
        walk = np.zeros(30, [("t_ns", "i8"), ("track_id", "i8"), ("x_m", "f8"), ("y_m", "f8")])
        walk["t_ns"], walk["x_m"] = times * STEP_NS, 0.5 * times
        ahead = np.zeros((30, 3), [("t_ns", "i8"), ("step", "u4"), ("ahead_s", "f8"), *walk.dtype.descr[1:]])
        ahead["t_ns"], ahead["step"] = walk["t_ns"][:, None], np.arange(1, 4)
        ahead["ahead_s"] = ahead["step"] * STEP_NS / 1e9
        ahead["x_m"] = walk["x_m"][:, None] + 0.5 * ahead["step"]
        ahead["y_m"] = off_m
        with mcaptrack.open(path, create=True) as opened:
            opened.write("/camera/truth", walk)
            opened.write(f"{above}/tracks", walk)
            assert opened.write(f"{above}/predictions", ahead.ravel(), by="my_predictor 2") == 30
            assert f"{above}/predictions/view/scene" in opened.topics
        (row,) = mcaptrack.evaluate(path, topic=f"{above}/tracks", similarity="metres", gate_m=1.0).rows()
        assert row["displacement"]["ADE_m"] == pytest.approx(off_m, abs=1e-9)
        if above == "/camera":  # forecasts are those of the samples, where there are any
            mcaptrack.sample(path, rate_hz=2.5)
            rows = mcaptrack.evaluate(path, topic=["/camera/tracks", "/camera/samples"], similarity="metres").rows()
            assert {row["tracks"] for row in rows if "displacement" in row} == {"/camera/samples"}
