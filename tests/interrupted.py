"""Logs that were left half written: processes killed while they extend a log, and journals."""

from __future__ import annotations

import os
import random
import signal
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from select import select
from typing import Final

import pytest
from mcap.reader import make_reader

from mcaptrack import log, notices
from mcaptrack.log import in_place
from tests.logs import SCHEMA


def contents(path: Path) -> dict[str, list[bytes]]:
    """Digests of what the stock reader finds, checksums of chunks checked; and the data section's by hand."""
    whole = path.read_bytes()
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found: dict[str, list[bytes]] = {}
        for _, channel, message in reader.iter_messages():
            found.setdefault(channel.topic, []).append(zlib.crc32(message.data).to_bytes(4, "little"))
        summary = reader.get_summary()
        found |= {attachment.name: [attachment.data] for attachment in reader.iter_attachments()}
    assert summary is not None
    assert summary.statistics.message_count == sum(len(found[c.topic]) for c in summary.channels.values())
    with log.read(path) as opened:
        assert zlib.crc32(whole[: opened.index.data_end]) == opened.index.data_crc
        assert opened.index.regular
    return found


def add_results(path: Path, seed: int, count: int) -> None:
    noise = random.Random(seed)
    with log.read(path) as opened:
        there = [topic for topic in opened.channels if topic.startswith("/result")]
        with log.extend(opened, drop=there, drop_attachments=["layout"]) as writer:
            number = writer.add_channel("/result", SCHEMA, "json", {}, "media")  # not compressed: as long as it is
            for n in range(count):
                writer.add_message(number, n * 10, n, noise.randbytes(400))
            writer.add_attachment("layout", "application/json", noise.randbytes(100))


#: The longest time until a child begins. One that took over a lock of another thread never does: another is tried.
_BEGINS_S: Final = 20.0
CALLS = ("pwrite", "write", "fsync", "replace", "unlink", "ftruncate", "chmod", "fchown")


def sabotage(at: int, fault: Callable[[], object], calls: Sequence[str] = CALLS) -> list[str]:
    """The ``at``-th call that changes something on the disk does half of its work, if it writes, and then ``fault``."""
    done: list[str] = []

    def patched(name, real):
        def call(*args, **kwargs):
            done.append(name)
            if len(done) == at:
                if name in ("pwrite", "write"):
                    real(args[0], bytes(args[1])[: len(args[1]) // 2], *args[2:])
                fault()
            return real(*args, **kwargs)

        return call

    for name in calls:
        setattr(os, name, patched(name, getattr(os, name)))
    return done


def killed(work: Callable[[], object], at: int, calls: Sequence[str] = CALLS) -> bool:
    """Whether a process that does this work is killed at its ``at``-th call that changes something on the disk."""
    ready, begin = os.pipe()
    child = os.fork()
    if child == 0:  # in the child: nothing of pytest is to run again
        try:
            os.write(begin, b"1")
            sabotage(at, lambda: os.kill(os.getpid(), signal.SIGKILL), calls)
            work()
            os._exit(0)
        finally:
            os._exit(1)
    has_begun = bool(select([ready], [], [], _BEGINS_S)[0])
    os.close(ready)
    os.close(begin)
    if not has_begun:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return killed(work, at, calls)
    _, status = os.waitpid(child, 0)
    assert status in (0, signal.SIGKILL), status
    return status != 0


def interrupt(path: Path) -> None:
    """Leave a log half written: killed in the middle of the second of several pieces."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(in_place, "_PIECE", 20_000)
        assert killed(lambda: add_results(path, 2, 200), 2, ["pwrite"])
    with notices.collected() as said, log.read(path):
        assert "was left half written" in said[0].message


def everything(folder: Path) -> dict[str, tuple[object, ...]]:
    """All that is in a folder, without following links or waiting for pipes."""
    found: dict[str, tuple[object, ...]] = {}
    for at, folders, files in os.walk(folder):
        for name in [*folders, *files]:
            entry = Path(at, name)
            there = entry.lstat()
            content = entry.read_bytes() if entry.is_file() and not entry.is_symlink() else None
            found[str(entry)] = (there.st_mode, there.st_ino, there.st_mtime_ns, there.st_size, content)
    return found
