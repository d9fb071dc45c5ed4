"""A log that other processes change while it is read: the old content, the new one or one error; never a mixture."""

from __future__ import annotations

import os
from collections.abc import Callable
from itertools import product
from pathlib import Path

import pytest
from mcap.writer import CompressionType

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.log import byte_source
from tests.logs import write_stock
from tests.tiers import one_in

KINDS = {
    "chunks": {"chunk_size": 150},
    "plain chunks": {"chunk_size": 150, "compression": CompressionType.NONE},
    "no checksums": {"chunk_size": 150, "compression": CompressionType.NONE, "enable_crcs": False},
    "no chunks": {"use_chunking": False},
}


def write_value(path: Path, value: int, **options) -> bytes:
    """A log in which all messages say one value; logs of two values have all records at the same places."""
    write_stock(path, [("abc"[n % 3], n, n, bytes([value]) * 60) for n in range(4)], **options)
    return path.read_bytes()


def overwrite(path: Path, new: bytes) -> None:
    with path.open("rb+") as stream:
        stream.write(new)
        stream.truncate(len(new))


def replace(path: Path, new: bytes) -> None:
    beside = path.with_name("new")
    beside.write_bytes(new)
    os.replace(beside, path)


CHANGES: dict[str, Callable[[Path, bytes], object]] = {
    "overwritten": overwrite,
    "replaced": replace,
    "longer": lambda path, new: overwrite(path, new + bytes(100)),
    "shortened": lambda path, new: os.truncate(path, len(new) // 2),
    "emptied": lambda path, new: os.truncate(path, 0),
    "removed": lambda path, new: path.unlink(),
}


def all_messages(path: Path) -> object:
    with log.read(path) as opened:
        return {topic: [m.payload for m in opened.messages(topic)] for topic in sorted(opened.channels)}


def all_streamed(path: Path) -> object:
    with log.read(path) as opened:
        return [m.payload for _, m in log.stream(opened)]


def facts(path: Path) -> object:
    with log.read(path) as opened:
        places = [[found.tolist() for found in opened.places(topic)] for topic in "abc"]
        return opened.metadata("about"), opened.attachment("notes.txt"), opened.fingerprint(), places


@pytest.mark.parametrize(
    ("kind", "change", "look"), one_in(7, product(KINDS, CHANGES, [all_messages, all_streamed, facts]))
)
def test_a_change_before_any_read_gives_the_old_content_the_new_one_or_an_error(
    tmp_path, monkeypatch, kind, change, look
):
    for name in ("BLOCK", "MIN_AHEAD", "_MAX_AHEAD"):
        monkeypatch.setattr(
            byte_source, name, 150
        )  # many small reads, so that the change comes between any two records
    path = tmp_path / "a.mcap"
    new = write_value(path, 2, **KINDS[kind])
    wanted = [look(path)]
    old = write_value(path, 1, **KINDS[kind])
    wanted.append(look(path))
    assert wanted[0] != wanted[1]
    assert len(old) == len(new)
    seen, real = [], os.pread

    def reading(at: int) -> Callable[[int, int, int], bytes]:
        def read(handle: int, size: int, offset: int) -> bytes:
            seen.append(offset)
            if len(seen) == at:
                CHANGES[change](path, new)
            return real(handle, size, offset)

        return read

    outcomes = set()
    for at in range(1 + len(kind) % 2, 500, 2):  # every second read, and not the same ones of each kind
        path.write_bytes(old)
        seen.clear()
        with monkeypatch.context() as patch:
            patch.setattr(os, "pread", reading(at))
            try:
                found = look(path)
            except McaptrackError as error:
                assert "\n" not in str(error)
                outcomes.add("error")
            else:
                assert found in wanted
                outcomes.add("found")
        if len(seen) < at:
            break
    assert len(seen) < at
    assert "found" in outcomes


def test_one_log_is_never_of_two_times(tmp_path):
    """Also what is read after the change is of the time when the log was opened, or is refused."""
    path = tmp_path / "a.mcap"
    for kind in KINDS.values():
        new = write_value(path, 2, **kind)
        write_value(path, 1, **kind)
        with log.read(path) as opened:
            first = [m.payload[0] for m in opened.messages("a")]
            overwrite(path, new)
            with pytest.raises(McaptrackError, match="was changed by another process while it was being read"):
                list(opened.messages("b"))
            assert set(first) == {1}


def test_a_log_that_is_open_is_read_on_when_something_is_added_to_it(tmp_path):
    path = tmp_path / "a.mcap"
    write_stock(path, [("a", n, n, bytes(2000)) for n in range(200)])
    with log.read(path) as opened:
        before = opened.fingerprint("a")
        with log.read(path) as other, log.extend(other) as writer:
            writer.add_message(writer.add_channel("new", ("", "", b""), "json", {}), 5, 1, b"x" * 1000)
        assert path.stat().st_ino == os.fstat(opened.snapshot.source.pieces[0].file.handle).st_ino
        assert len(list(opened.messages("a"))) == len(opened.times("a")) == 200
        assert opened.fingerprint("a") == before
        assert "new" not in opened.channels
