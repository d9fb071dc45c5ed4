"""Adding to a log in place: it costs what is added, and what stands is not touched."""

from __future__ import annotations

import errno
import os
import random
import shutil
import zlib
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from mcaptrack import log, notices
from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish_bytes
from mcaptrack.log import in_place
from mcaptrack.log import writer as writing
from mcaptrack.log.journal import journal_of
from mcaptrack.log.records import crc_before
from mcaptrack.log.writer import LogWriter
from tests.interrupted import contents, killed
from tests.logs import SCHEMA, SOME, STOCK_OPTIONS, our_messages, write_log, write_stock


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


def test_results_are_replaced_in_place_and_leave_nothing_behind(tmp_path):
    path, once = tmp_path / "a.mcap", tmp_path / "b.mcap"
    recorded(path)
    recorded(once)
    before, node = path.read_bytes(), path.stat().st_ino
    with log.read(path) as opened:
        end = opened.index.data_end
    for value in (7, 3, 9, 1):  # larger and smaller
        add_results(path, value)
        assert path.read_bytes()[:end] == before[:end]
    add_results(once, 1)
    assert path.stat().st_ino == node
    assert sorted(tmp_path.iterdir()) == [path, once]
    assert len(path.read_bytes()) < len(before) + 10_000
    assert len(contents(path)["/result/b"]) == 50
    assert contents(path) == contents(once)
    assert path.read_bytes() == once.read_bytes()


def test_a_log_that_may_not_be_written_to_says_what_to_do(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    recorded(path)

    def refused(name, flags, *rest):
        raise PermissionError(errno.EACCES, "Permission denied", name)

    for name, more in (("a.mcap", ", or beside it with `sidecar=True`"), ("b.results.mcap", "")):
        if name != path.name:  # results can't be beside results
            shutil.copy(path, tmp_path / name)
        with log.read(tmp_path / name) as opened, monkeypatch.context() as patch:
            patch.setattr(os, "open", refused)
            with pytest.raises(McaptrackError) as raised:
                opened.lock()
        assert str(raised.value).endswith(f"Permission denied; write to another file with `output=`{more}")
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


# What belongs to a file beside its content stays when a log is changed: other names, links, owner, rights, attributes


AS_ROOT = os.geteuid() == 0
#: An access control list of one more user, as Linux keeps it: entries of tag, rights and number.
ACCESS_LIST = b"\x02\0\0\0" + b"".join(
    tag.to_bytes(2, "little") + rights.to_bytes(2, "little") + number.to_bytes(4, "little", signed=False)
    for tag, rights, number in (
        (1, 6, 2**32 - 1),
        (2, 4, 1001),
        (4, 0, 2**32 - 1),
        (16, 4, 2**32 - 1),
        (32, 0, 2**32 - 1),
    )
)


def add(path: Path) -> None:
    with log.read(path) as opened, log.extend(opened, drop=["b"]) as writer:
        writer.add_message(writer.add_channel("new", SCHEMA, "json", {}), 15, 1, b"added")


def attributes(path: Path) -> dict[str, bytes]:
    return {name: os.getxattr(path, name) for name in os.listxattr(path)}


LOGS: dict[str, Callable[[Path], None]] = {
    "ours": lambda path: write_log(path, SOME),
    **{name: (lambda path, given=given: write_stock(path, SOME, **given)) for name, given in STOCK_OPTIONS.items()},
}


@pytest.fixture(params=LOGS)
def path(request, tmp_path) -> Path:
    path = tmp_path / "a.mcap"
    LOGS[request.param](path)
    return path


def test_a_file_with_two_names_has_both_afterwards(path, tmp_path):
    also = tmp_path / "also.mcap"
    os.link(path, also)
    node = path.stat().st_ino
    add(path)
    assert (path.stat().st_ino, also.stat().st_ino, path.stat().st_nlink) == (node, node, 2)
    assert sorted(our_messages(also)) == ["a", "c", "new"]
    assert log.check(also).is_sound
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.mcap", "also.mcap"]


@pytest.mark.skipif(not AS_ROOT, reason="only root gives files away")
def test_owner_and_group_stay(path):
    os.chown(path, 1001, 1002)
    path.chmod(0o664)
    add(path)
    there = path.stat()
    assert (there.st_uid, there.st_gid, there.st_mode & 0o7777) == (1001, 1002, 0o664)


@pytest.mark.parametrize(
    ("place", "name", "value"),
    [
        ("a.mcap", "user.note", b"take 3"),
        ("a.mcap", "system.posix_acl_access", ACCESS_LIST),
        (".", "system.posix_acl_default", ACCESS_LIST),
    ],
    ids=["note", "access", "of the folder"],
)
def test_attributes_stay_and_what_a_folder_gives_to_new_files_does_not_come(path, place, name, value):
    try:
        os.setxattr(path.parent / place, name, value)
    except OSError as error:
        pytest.skip(f"the file system keeps no attributes: {error.strerror}")
    before = attributes(path), path.stat().st_mode
    assert (name in before[0]) == (place == path.name)
    add(path)
    assert (attributes(path), path.stat().st_mode) == before


def test_where_the_owner_cant_be_kept_the_file_stays_the_same_one(path, monkeypatch):
    def refused(*_):
        raise PermissionError(1, "Operation not permitted")

    other = path.stat().st_uid + 1
    if AS_ROOT:
        os.chown(path, other, -1)
    else:
        monkeypatch.setattr("mcaptrack.log.extend.can_replace", lambda _: False)
    monkeypatch.setattr(os, "chown", refused)
    node = path.stat().st_ino
    add(path)
    assert path.stat().st_ino == node
    assert sorted(our_messages(path)) == ["a", "c", "new"]
    if AS_ROOT:
        assert path.stat().st_uid == other


def test_the_journal_has_the_permissions_of_the_log(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    write_log(path, [("a", n, n, bytes([n]) * 3000) for n in range(100)], "media")
    path.chmod(0o604)
    old = path.read_bytes()
    monkeypatch.setattr(in_place, "_PIECE", 1000)
    assert killed(lambda: add(path), 1, ["pwrite"])
    assert journal_of(path).stat().st_mode & 0o7777 == 0o604
    journal_of(path).unlink()
    path.write_bytes(old)
    monkeypatch.setattr(in_place, "keep_attributes", lambda *_: ["group"])
    assert killed(lambda: add(path), 1, ["pwrite"])
    assert journal_of(path).stat().st_mode & 0o7777 == 0o600


@pytest.mark.parametrize("refused", ["owner", "group", "permissions", "extended attributes"])
def test_what_a_new_file_can_t_be_given_is_said(tmp_path, monkeypatch, refused):
    path = tmp_path / "report.html"
    path.write_bytes(b"old")
    real = path.stat()

    def stat(self, **_):
        if self != path:
            return real
        other = {"owner": (4, real.st_uid + 1), "group": (5, real.st_gid + 1)}.get(refused)
        return os.stat_result(other[1] if other and at == other[0] else value for at, value in enumerate(real[:10]))

    def fail(*_, **__):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(Path, "stat", stat)
    call = {"permissions": (Path, "chmod"), "extended attributes": ("mcaptrack.files", "_keep_extended")}
    at = call.get(refused, (os, "chown"))
    monkeypatch.setattr(*at, fail) if not isinstance(at[0], str) else monkeypatch.setattr(".".join(at), fail)
    with notices.collected() as said:
        publish_bytes(path, b"new")
    assert path.read_bytes() == b"new"
    expected = f"{path} is a new file now, without the {refused} of the old one"
    assert [notice.message for notice in said] == [expected]
