"""Adding to a log in place: it costs what is added, and what stands is not touched."""

from __future__ import annotations

import errno
import os
import random
import zlib
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.log import writer as writing
from mcaptrack.log.checksums import crc_before
from mcaptrack.log.writer import LogWriter
from tests.interrupted import SCHEMA, contents


def recorded(path: Path, count: int = 60, size: int = 100_000) -> None:
    """A log of pictures, large beside what is added to it."""
    noise = random.Random(1)
    with log.create(path) as writer:
        number = writer.add_channel("/video", SCHEMA, "json", {}, "media")
        for n in range(count):
            writer.add_message(number, n * 10, n, noise.randbytes(size))
        writer.add_metadata("about", {"robot": "r2"})


def add_results(path: Path, value: int, count: int = 50) -> None:
    """Replace the results of a log, as a stage that is run again does."""
    with log.read(path) as opened:
        there = [topic for topic in opened.channels if topic.startswith("/result")]
        with log.extend(opened, drop=there, drop_attachments=["layout"]) as writer:
            for topic in ("/result/a", "/result/b"):
                number = writer.add_channel(topic, SCHEMA, "json", {}, group="results")
                for n in range(count):
                    writer.add_message(number, n * 10, n, bytes([value]) * (40 + value))
            writer.add_attachment("layout", "application/json", bytes([value]) * 100)


@given(st.binary(max_size=200), st.binary(max_size=5000))
def test_the_checksum_of_the_beginning_follows_from_that_of_the_whole(first, last):
    assert crc_before(zlib.crc32(first + last), zlib.crc32(last), len(last)) == zlib.crc32(first)


def test_what_stands_is_not_touched_when_something_is_added(tmp_path):
    path = tmp_path / "a.mcap"
    recorded(path)
    before, node = path.read_bytes(), path.stat().st_ino
    with log.read(path) as opened:
        end = opened.index.data_end
    add_results(path, 1)
    after = path.read_bytes()
    assert after[:end] == before[:end]
    assert path.stat().st_ino == node
    assert len(after) < len(before) + 10_000
    assert list(tmp_path.iterdir()) == [path]
    assert len(contents(path)["/result/b"]) == 50


def test_results_are_replaced_in_place_and_leave_nothing_behind(tmp_path):
    path, once = tmp_path / "a.mcap", tmp_path / "b.mcap"
    recorded(path)
    recorded(once)
    node = path.stat().st_ino
    for value in (7, 3, 9, 1):  # larger and smaller
        add_results(path, value)
    add_results(once, 1)
    assert path.stat().st_ino == node
    assert contents(path) == contents(once)
    assert path.read_bytes() == once.read_bytes()


def test_a_log_that_may_not_be_written_to_says_what_to_do(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    recorded(path)

    def refused(name, flags, *rest):
        raise PermissionError(errno.EACCES, "Permission denied", name)

    with log.read(path) as opened, monkeypatch.context() as patch:
        patch.setattr(os, "open", refused)
        with pytest.raises(
            McaptrackError, match="can't be written to: Permission denied; write to another file with `output=`"
        ):
            opened.lock()
    with log.read(path) as opened, log.extend(opened, tmp_path / "copy.mcap") as writer:
        writer.add_channel("/new", SCHEMA, "json", {})
    assert contents(path) == {"/video": contents(path)["/video"]}


def test_damage_that_is_in_the_way_is_said_where_it_stands_and_nothing_changes(tmp_path):
    path = tmp_path / "a.mcap"
    recorded(path)
    add_results(path, 1)
    with log.read(path) as opened:
        (chunk,) = opened.index.chunks[-1:]
    whole = bytearray(path.read_bytes())
    whole[chunk.chunk_start_offset + chunk.chunk_length - 1] ^= 1
    path.write_bytes(whole)
    with pytest.raises(
        McaptrackError,
        match=rf"is damaged: byte {chunk.chunk_start_offset}: .*; `mcaptrack\.recover\(.*a.mcap'\)` saves what is intact$",
    ):
        add_results(path, 2)
    assert path.read_bytes() == bytes(whole)


class FaultyDisk:
    """Passes on what is written, but the first piece of at least 100 bytes has a flipped bit."""

    def __init__(self, sink) -> None:
        self.sink, self.has_failed = sink, False

    def write(self, data: bytes) -> None:
        if len(data) >= 100 and not self.has_failed:
            self.has_failed = True
            data = bytes(data[:50]) + bytes([data[50] ^ 1]) + bytes(data[51:])
        self.sink.write(data)


@pytest.mark.parametrize("way", ["create", "in place", "copy"])
def test_bytes_that_are_read_back_otherwise_than_written_leave_the_log_as_it_was(way, tmp_path, monkeypatch):
    path, copy = tmp_path / "a.mcap", tmp_path / "copy.mcap"
    recorded(path)
    before, init = path.read_bytes(), LogWriter.__init__
    monkeypatch.setattr(LogWriter, "__init__", lambda self, sink, *rest: init(self, FaultyDisk(sink), *rest))
    with pytest.raises(McaptrackError, match="read back of"):
        if way == "create":
            recorded(copy)
        elif way == "in place":
            add_results(path, 1)
        else:
            with log.read(path) as opened, log.extend(opened, copy) as writer:
                writer.add_message(writer.add_channel("/new", SCHEMA, "json", {}, "media"), 1, 1, bytes(1000))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("at", [0, 70_000, -1])
def test_a_copy_that_differs_in_any_byte_is_not_published(at, tmp_path, monkeypatch):
    path, copy = tmp_path / "a.mcap", tmp_path / "copy.mcap"
    recorded(path, count=3)
    extending = import_module("mcaptrack.log.extend")  # mcaptrack.log.extend itself is a function
    monkeypatch.setattr(extending, "BLOCK", 1000)

    def copy_wrongly(source, end, stream) -> None:
        data = bytearray(source[0:end])
        data[at] ^= 1
        stream.write(bytes(data))

    monkeypatch.setattr(extending, "_copy_bytes", copy_wrongly)
    with (
        pytest.raises(McaptrackError, match="does not hold what was written to it"),
        log.read(path) as opened,
        log.extend(opened, copy),
    ):
        pass
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("lost", [4, 4000, 5200])
def test_a_log_of_which_the_disk_lost_the_end_is_not_published(lost, tmp_path, monkeypatch):
    verify = writing.verify

    def cut_first(path: Path, *rest: object) -> None:
        os.truncate(path, path.stat().st_size - lost)
        verify(path, *rest)

    monkeypatch.setattr(writing, "verify", cut_first)
    with pytest.raises(McaptrackError, match="0 messages are read back of 50"):
        recorded(tmp_path / "a.mcap", count=50, size=100)
    assert list(tmp_path.iterdir()) == []


def test_metadata_and_attachments_that_are_replaced_are_listed_once(tmp_path):
    path = tmp_path / "a.mcap"
    recorded(path, count=50, size=100)
    for number in range(3):
        with (
            log.read(path) as opened,
            log.extend(opened, drop_metadata=["about"], drop_attachments=["layout"]) as writer,
        ):
            writer.add_metadata("about", {"robot": f"r{number}"})
            writer.add_attachment("layout", "application/json", bytes([number]))
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert [one.name for one in summary.metadata_indexes] == ["about"]
        assert [one.name for one in summary.attachment_indexes] == ["layout"]
        with log.read(path) as opened:
            assert (opened.metadata("about"), opened.attachment("layout")) == ({"robot": f"r{number}"}, bytes([number]))
    assert log.check(path).findings == []
