"""Real footage and other people's logs, where they are at hand (see ``data`` in conftest.py)."""

from __future__ import annotations

import json

import pytest
from mcap.records import Channel, Header, Schema

from mcaptrack import log
from mcaptrack.log import records
from tests.commands import printed


@pytest.fixture(scope="module")
def scores(data, tmp_path_factory) -> dict[tuple[str, str, float], dict]:
    folder, path = data / "pets09-s2l1", tmp_path_factory.mktemp("pets") / "pets.mcap"
    plane = ("--ground-plane", folder / "homography.txt", "--point", "foot")
    printed("ingest", folder / "video.avi", "--fps", 7, *plane, "--truth", folder / "gt.txt", "-o", path)
    printed("run", path)
    rows = json.loads(printed("evaluate", path, "--json")[0])["results"]
    return {(row["tracks"].removeprefix("/camera/"), row["similarity"], row["gate"]): row for row in rows}


def test_a_motion_detector_and_sort_find_and_follow_people(scores):
    row = scores["tracks", "iou", 0.5]
    assert row["MOTA"] >= 0.45
    assert row["IDF1"] >= 0.40


def test_retracking_keeps_more_identities_and_takes_switches_away(scores):
    sort, retracked = (scores[name, "metres", 1.0] for name in ("samples", "retracks"))
    assert retracked["IDF1"] >= sort["IDF1"] + 0.05
    assert retracked["IDSW"] <= sort["IDSW"] * 5 / 6


def _fields(records: list[dict], kind: str) -> list[dict]:
    return [dict(record["fields"]) for record in records if record["type"] == kind]


def _data(value: list[str]) -> bytes:
    return bytes(map(int, value))


def test_every_file_of_the_conformance_suite_holds_what_is_written_beside_it(data):
    """Header, schemas, channels, messages, attachments, metadata, statistics, chunk indexes and checksums."""
    files = sorted((data / "mcap" / "conformance").glob("*/*.mcap"))
    assert len(files) > 300
    for path in files:
        said = json.loads(path.with_suffix(".json").read_text())["records"]
        schemas = {int(f["id"]): f for f in _fields(said, "Schema")}
        channels = {int(f["id"]): f for f in _fields(said, "Channel")}
        with log.read(path) as opened:
            index, buffer = opened.index, opened.snapshot.source
            (header,) = _fields(said, "Header")
            assert records.read_header(buffer, records.record_at(buffer, 8)) == Header(
                header["profile"], header["library"]
            )
            assert index.schemas == {
                number: Schema(number, _data(f["data"]), f["encoding"], f["name"]) for number, f in schemas.items()
            }
            assert index.channels == {
                number: Channel(number, f["topic"], f["message_encoding"], f["metadata"], int(f["schema_id"]))
                for number, f in channels.items()
            }
            for number, channel in channels.items():
                wanted = [
                    log.Message(int(f["log_time"]), int(f["sequence"]), int(f["publish_time"]), _data(f["data"]))
                    for f in _fields(said, "Message")
                    if int(f["channel_id"]) == number
                ]
                assert list(opened.messages(channel["topic"])) == sorted(wanted, key=lambda m: m.t_ns), path
            for f in _fields(said, "Metadata"):
                assert opened.metadata(f["name"]) == f["metadata"]
            there = [records.read_attachment(buffer, records.record_at(buffer, a.offset)) for a in index.attachments]
            assert [
                (log_ns, create_ns, name, kind, bytes(content)) for log_ns, create_ns, name, kind, content in there
            ] == [
                (int(f["log_time"]), int(f["create_time"]), f["name"], f["media_type"], _data(f["data"]))
                for f in _fields(said, "Attachment")
            ]
            for f in _fields(said, "Statistics"):
                assert int(f["message_count"]) == sum(index.counts.values())
                assert (int(f["message_start_time"]), int(f["message_end_time"])) == (index.start_ns, index.end_ns)
                assert {int(n): int(c) for n, c in f["channel_message_counts"].items() if c != "0"} == index.counts
            chunks = {chunk.chunk_start_offset: chunk for chunk in index.chunks}
            for f in _fields(said, "ChunkIndex"):
                chunk = chunks[int(f["chunk_start_offset"])]
                sizes = (chunk.chunk_length, chunk.compressed_size, chunk.uncompressed_size)
                names = (
                    "chunk_length", "compressed_size", "uncompressed_size", "message_start_time", "message_end_time",
                )  # fmt: skip
                assert tuple(int(f[name]) for name in names) == (
                    *sizes, chunk.message_start_time, chunk.message_end_time,
                )  # fmt: skip
            (end,) = _fields(said, "DataEnd")
            assert int(end["data_section_crc"]) == index.data_crc


def test_what_others_recorded_is_checked_without_a_complaint_and_recovered_whole(data, tmp_path):
    wrong_by_its_writer = {"convert_a__rewriter_a_0.mcap"}  # says it starts at 1 ms, and has messages at 0
    for path in sorted((data / "mcap").glob("*/**/*.mcap")):
        assert log.check(path).is_sound or path.name in wrong_by_its_writer, path
        report = log.recover(path, tmp_path / "saved.mcap")
        assert report.lost == [], path
        with log.read(path) as theirs, log.read(tmp_path / "saved.mcap") as ours:
            assert ours.index.channels == theirs.index.channels
            for topic in theirs.channels:
                assert list(theirs.messages(topic)) == list(ours.messages(topic)), path
