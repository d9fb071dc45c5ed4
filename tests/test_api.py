"""A log in Python: tables, arrays, pictures, and messages by their place in the file."""

from __future__ import annotations

import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log, tables
from mcaptrack.api.scoring import Scores
from mcaptrack.errors import McaptrackError
from mcaptrack.sources import ingest
from tests.logs import some_log
from tests.worlds import write_clip

ROOT = Path(__file__).parent.parent


def test_importing_is_light():
    code = "import sys, mcaptrack; print(sorted({'numpy', 'pyarrow', 'av', 'cv2', 'mcap'} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert found.stdout.strip() == "[]"
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        mcaptrack.nonsense  # noqa: B018


def test_tables_have_the_name_of_the_log_as_exported_ones_do(tmp_path):
    with mcaptrack.open(str(some_log(tmp_path / "a.mcap"))) as opened:
        assert opened.tables == tuple(tables.TABLES)
        for name in opened.tables:
            table = opened.table(name)
            assert table.column_names[-1] == "recording"
            assert set(table.column("recording").to_pylist()) <= {"a"}
        assert opened.table("tracks", "/camera/truth").num_rows == 6
        assert opened.table("/imu").column("gyro_x").to_pylist() == [0.5] * 4
        with pytest.raises(McaptrackError, match="has no table or channel nothing; there are frames, detections"):
            opened.table("nothing")
        with pytest.raises(McaptrackError, match="has no channel /nowhere"):
            opened.table("tracks", "/nowhere")


def test_arrays_hold_the_rows_with_times(tmp_path):
    path = some_log(tmp_path / "a.mcap")
    with mcaptrack.open(path) as opened, log.read(path) as raw:
        rows = opened.array("tracks", "/camera/tracks")
        wanted = raw.rows("/camera/tracks", mcaptrack.schema.TRACKS)
        rows.sort(order="row")
        for name in wanted.rows.dtype.names:
            np.testing.assert_array_equal(rows[name], wanted.rows[name])
        assert rows["t"].dtype == np.dtype("datetime64[ns]")
        assert (
            rows["t"].astype(np.int64).tolist()
            == rows["t_ns"].tolist()
            == np.repeat(wanted.t_ns, wanted.counts).tolist()
        )
        assert np.isnan(rows["x_px"]).all()
        assert opened.array("predictions").shape == (0,)


def clip_log(tmp_path):
    images = write_clip(tmp_path / "clip.mp4", frames=30, options={"g": "10", "qp": "0"})
    ingest.ingest(tmp_path / "clip.mp4", tmp_path / "clip.mcap", ingest.IngestOptions())
    return tmp_path / "clip.mcap", images


def test_pictures_are_decoded_with_their_times(tmp_path):
    path, images = clip_log(tmp_path)
    with mcaptrack.open(path) as opened, log.read(path) as raw:
        frames = list(opened.frames("video"))
        assert [frame.index for frame in frames] == list(range(30))
        assert [frame.t_ns for frame in frames] == raw.times("/camera/video").tolist()
        for frame, image in zip(frames, images, strict=True):
            assert np.abs(frame.rows.astype(int) - image).mean() < 6
        (rgb,) = opened.frames("/camera/video", times=[0], colour="rgb")
        assert (rgb.rows == frames[0].rows[..., ::-1]).all()
        (grey,) = opened.frames("camera/video", times=[0], colour="grey")
        assert grey.rows.shape == frames[0].rows.shape[:2]


def test_pictures_at_given_times_are_those_shown_at_these_times(tmp_path):
    path, _ = clip_log(tmp_path)
    with mcaptrack.open(path) as opened:
        all_frames = list(opened.frames())
        t_ns = [frame.t_ns for frame in all_frames]
        found = list(opened.frames(times=[t_ns[25] + 1, t_ns[3], t_ns[3], t_ns[29] + 10**12]))
        assert [frame.index for frame in found] == [3, 3, 25, 29]
        for frame in found:
            assert (frame.rows == all_frames[frame.index].rows).all()
        assert list(opened.frames(times=[])) == []
        with pytest.raises(McaptrackError, match="has no picture at -5 ns"):
            opened.frames(times=[-5])


def test_times_of_pictures_are_whole_nanoseconds(tmp_path):
    path, _ = clip_log(tmp_path)
    with mcaptrack.open(path) as opened:
        for times in ([0.5], ["a"], [[0, 1]], 5, [np.nan], [2**64]):
            with pytest.raises(McaptrackError, match=r"`times=` needs .*nanoseconds"):
                opened.frames(times=times)
        with pytest.raises(McaptrackError, match="`colour=` can't be 'gray'; did you mean grey"):
            opened.frames(colour="gray")
        assert [frame.index for frame in opened.frames(times=np.array([0, 10], "datetime64[s]"))] == [0, 29]


def test_a_log_that_was_closed_says_so(tmp_path):
    path, _ = clip_log(tmp_path)
    opened = mcaptrack.open(path)
    row = opened.table("frames").to_pylist()[0]
    late = opened.frames("video")
    before = path.read_bytes()
    opened.close()
    for work in (
        lambda: opened.table("frames"),
        lambda: opened.array("/camera/video"),
        lambda: opened.frames("video"),
        lambda: opened.fetch(row),
        lambda: opened.supervision("tracks"),
        lambda: opened.write("/own/tracks", []),
    ):
        with pytest.raises(McaptrackError, match=r"clip.mcap is closed; `mcaptrack.open\('.*'\)` opens it again"):
            work()
    with pytest.raises(McaptrackError, match="is closed"):
        next(late)
    assert (opened.topics, opened.path, path.read_bytes()) == (("/camera/video",), path, before)
    opened.close()


def test_threads_may_share_a_log(tmp_path):
    with mcaptrack.open(some_log(tmp_path / "a.mcap")) as opened, ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda name: opened.table(name).num_rows, [*opened.tables] * 3))
        assert found == [opened.table(name).num_rows for name in opened.tables] * 3


def test_a_channel_without_pictures_is_refused(tmp_path):
    with mcaptrack.open(some_log(tmp_path / "a.mcap")) as opened, pytest.raises(McaptrackError, match="no pictures"):
        opened.frames("video")


def test_every_message_is_fetched_by_its_row_of_frames(tmp_path):
    path, _ = clip_log(tmp_path)
    with mcaptrack.open(path) as opened, log.read(path) as raw:
        pointers = opened.table("frames")
        wanted = {topic: list(raw.messages(topic)) for topic in opened.topics}
        assert pointers.num_rows == sum(map(len, wanted.values()))
        for row in pointers.to_pylist():
            message = wanted[row["topic"]].pop(0)
            found = opened.fetch(row)
            assert found == (row["topic"], message.t_ns, message.publish_ns, message.sequence, message.payload)
        first = pointers.to_pandas().iloc[0]  # a row of pandas, as numbers of its own
        assert opened.fetch(first).t_ns == first["t_ns"]
        assert opened.fetch(opened.array("frames")[0]).t_ns == first["t_ns"]  # a row of an array


def test_messages_outside_chunks_and_in_results_are_fetched(tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "loose.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start()
        schema = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        channel = writer.register_channel("/image", "json", schema)
        for n in range(3):
            writer.add_message(channel, n, b"{}", n)
        writer.finish()
    with log.read(path, sidecar=True) as opened, log.extend(opened) as results:
        number = results.add_channel("/result", ("foxglove.CompressedImage", "jsonschema", b"{}"), "json", {})
        results.add_message(number, 8, 0, b'{"a": 1}')
    with mcaptrack.open(path) as opened:
        rows = opened.table("frames").to_pandas()
        assert rows["chunk_offset"].isna().tolist() == [True, True, True, False]
        found = [opened.fetch(row) for _, row in rows.iterrows()]
        assert [(f.topic, f.t_ns, f.payload) for f in found] == [
            *(("/image", n, b"{}") for n in range(3)),
            ("/result", 8, b'{"a": 1}'),
        ]


def test_rows_of_a_log_that_has_changed_are_refused(tmp_path):
    path = some_log(tmp_path / "a.mcap")
    with mcaptrack.open(path) as opened:
        rows = opened.table("frames").to_pylist()
    with log.read(path) as old, log.extend(old, drop=["/imu"]):
        pass
    with mcaptrack.open(path) as opened:
        for row in rows:
            try:
                found = opened.fetch(row)
            except McaptrackError as error:
                assert "export its tables again" in str(error)
            else:
                assert (found.topic, found.t_ns) == (row["topic"], row["t_ns"])
        for wrong in (
            {"chunk_offset": 3},
            {"message_offset": 1},
            {"message_offset": 2**62},
            {"t_ns": 5},
            {"topic": "/x"},
            {"message_offset": -9},
        ):
            with pytest.raises(McaptrackError, match="no such message at this place"):
                opened.fetch(opened.table("frames").to_pylist()[0] | wrong)
        with pytest.raises(McaptrackError, match="not part of this log"):
            opened.fetch(rows[0] | {"file": "b.mcap"})
        with pytest.raises(McaptrackError, match="does not say where its message is"):
            opened.fetch({"t_ns": 5})


def test_topics_and_names_are_text(tmp_path):
    with mcaptrack.open(some_log(tmp_path / "a.mcap")) as opened:
        with pytest.raises(McaptrackError, match=r"^`topic=` is text, not 3$"):
            opened.frames(topic=3)
        with pytest.raises(McaptrackError, match=r"^`topic=` is text, not \['/x'\]$"):
            opened.table("tracks", ["/x"])
        assert opened.table("tracks", None).num_rows == opened.table("tracks").num_rows


def test_results_are_shown_in_a_line(tmp_path):
    info = mcaptrack.info(some_log(tmp_path / "a.mcap"))
    assert repr(info) == f"LogInfo({str(info.log)!r}, {len(info.channels)} channels, {info.messages} messages)"
    row = {
        "sequence": "<a>", "tracks": "/camera/tracks", "similarity": "iou", "gate": 0.5, "HOTA": 0.5, "MOTA": -0.25,
        "IDF1": 1,
    }  # fmt: skip
    scores = Scores((SimpleNamespace(to_json=lambda: row),), (), ())  # type: ignore[arg-type]
    assert repr(scores) == "Scores(1 results; `rows` returns them)"
    shown = ["&lt;a&gt;", "/camera/tracks", "iou", "0.5", "0.5000", "-0.2500", "1.0000"]
    assert re.findall(r"<td>(.*?)</td>", scores._repr_html_()) == shown
