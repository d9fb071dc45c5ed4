"""Changes of a log that are interrupted, at any call: the old log or the new one, and reading changes nothing."""

from __future__ import annotations

import errno
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from mcaptrack import log, notices
from mcaptrack.errors import McaptrackError
from mcaptrack.log import in_place, journal
from mcaptrack.log.journal import journal_of
from tests.interrupted import CALLS, SCHEMA, add_results, contents, killed, sabotage
from tests.logs import write_stock
from tests.tiers import one_in

#: Results of so many messages are replaced by so many others.
CHANGES = {"grows": (30, 1500), "shrinks": (1500, 30), "stays as long": (400, 400)}


def seen(path: Path) -> dict[str, list[bytes]]:
    with log.read(path) as opened:
        found = {topic: [m.payload for m in opened.messages(topic)] for topic in opened.channels}
        return found | {"layout": [opened.attachment("layout") or b""]}


def counts(found: dict[str, list[bytes]]) -> dict[str, int]:
    """How many messages each channel has; attachments left out."""
    return {topic: len(those) for topic, those in found.items() if topic not in ("layout", "notes.txt")}


def photo(folder: Path) -> dict[str, tuple[bytes, int]]:
    return {entry.name: (entry.read_bytes(), entry.stat().st_mtime_ns) for entry in sorted(folder.iterdir())}


def add_to_irregular(path: Path) -> None:
    """Add to a log without chunks, all of which is written anew."""
    with log.read(path) as opened, log.extend(opened, drop=["b"]) as writer:
        number = writer.add_channel("new", SCHEMA, "json", {}, "media")
        for n in range(300):
            writer.add_message(number, n, n, bytes([n % 256]) * 500)


class Change(NamedTuple):
    old: bytes
    new: bytes
    make: Callable[[Path], None]


@pytest.fixture(scope="module", params=one_in(len(CHANGES) + 1, [*CHANGES, "has two names"]))
def change(request, tmp_path_factory) -> Change:
    """A log before and after a change that is made in place, in several pieces."""
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    if request.param not in CHANGES:
        write_stock(path, [("abc"[n % 3], n, n, bytes([n]) * 2000) for n in range(100)], use_chunking=False)
        os.link(path, path.with_name("also"))
        old, node = path.read_bytes(), path.stat().st_ino
        add_to_irregular(path)
        assert path.stat().st_ino == node
        assert counts(contents(path)) == {"a": 34, "c": 33, "new": 300}
        return Change(old, path.read_bytes(), add_to_irregular)
    before, after = CHANGES[request.param]
    noise = random.Random(1)
    with log.create(path) as writer:
        number = writer.add_channel("/video", SCHEMA, "json", {}, "media")
        for n in range(60):
            writer.add_message(number, n * 10, n, noise.randbytes(20_000))
    add_results(path, 1, before)
    assert len(contents(path)["/result"]) == before
    old, node = path.read_bytes(), path.stat().st_ino
    add_results(path, 2, after)
    assert len(contents(path)["/result"]) == after
    new = path.read_bytes()
    assert path.stat().st_ino == node
    assert (len(new) > len(old), len(new) < len(old)) == (after > before, after < before)
    return Change(old, new, lambda there: add_results(there, 2, after))


@pytest.fixture(scope="module")
def place(tmp_path_factory, change) -> Path:
    """The log that all tests of a change use, because a journal belongs to one file only."""
    path = tmp_path_factory.mktemp("place") / "a.mcap"
    path.write_bytes(change.old)
    if change.make is add_to_irregular:
        os.link(path, tmp_path_factory.mktemp("elsewhere") / "also")
    return path


@pytest.fixture(scope="module")
def kills(place, change) -> list[dict[str, bytes]]:
    """What a process leaves in the folder that is killed at the first call of the change, at the second, and so on."""
    found: list[dict[str, bytes]] = []
    with pytest.MonkeyPatch.context() as patch:
        _use_small_pieces(patch)
        for at in range(1, 300):
            reset(place, change.old)
            if not killed(lambda: change.make(place), at):
                assert place.read_bytes() == change.new
                assert [entry.name for entry in place.parent.iterdir()] == ["a.mcap"]
                return found
            found.append({entry.name: entry.read_bytes() for entry in place.parent.iterdir()})
    raise AssertionError("it goes on and on")


@pytest.fixture
def path(place, change, monkeypatch) -> Path:
    _use_small_pieces(monkeypatch)
    reset(place, change.old)
    return place


def _use_small_pieces(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(in_place, "_PIECE", 100_000)
    patch.setattr(in_place, "_BLOCK", 200_000)
    patch.setattr(journal, "_BLOCK", 128 * journal.ROW)


def left_behind(path: Path, kills: list[dict[str, bytes]]) -> Iterator[dict[str, bytes]]:
    """Put there what each kill left, one after another."""
    for files in kills:
        put(path, files)
        yield files


def put(path: Path, files: dict[str, bytes]) -> None:
    reset(path, files[path.name])
    for name in files.keys() - {path.name}:
        path.with_name(name).write_bytes(files[name])


def reset(path: Path, content: bytes) -> None:
    for entry in path.parent.iterdir():
        if entry != path:
            entry.unlink()
    with path.open("rb+") as stream:  # the file stays the same one
        stream.write(content)
        stream.truncate(len(content))


def mend(path: Path) -> None:
    with log.read(path) as opened:
        opened.lock()


def look(path: Path, change: Change) -> str:
    """What is seen of a log after a kill, and left of it: "old" or "new"; and that looking changes nothing."""
    before = photo(path.parent)
    is_beside = journal_of(path).exists()
    with notices.collected() as said:
        found = seen(path)
    assert photo(path.parent) == before
    assert [(notice.code, "\n" in notice.message) for notice in said] == [("journal", False)] * is_beside
    half = is_beside and "left half written by" in said[0].message
    checked = log.check(path)
    assert [f.kind for f in checked.findings if f.level == "error"] == ["half-written"] * half
    assert photo(path.parent) == before
    with notices.collected() as mended:
        mend(path)
    assert sum("its state before that has been restored" in notice.message for notice in mended) == half
    assert not journal_of(path).exists()
    left = path.read_bytes()
    assert left in (change.old, change.new)
    assert seen(path) == found
    return "old" if left == change.old else "new"


def test_killed_at_any_call_it_is_the_old_log_or_the_new_one(path, change, kills):
    outcomes = [look(path, change) for _ in left_behind(path, kills)]
    assert len(outcomes) > 10
    assert outcomes == sorted(outcomes, reverse=True)  # new from some call on
    assert set(outcomes) == {"old", "new"}


def test_killed_while_it_is_put_back_it_can_be_put_back_still(path, change, kills):
    middles = {tuple(files.items()): files for files in kills if journal_of(path).name in files}
    for files in list(middles.values())[::3]:
        for second in range(1, 100):
            put(path, files)
            if not killed(lambda: mend(path), second):
                break
            look(path, change)
        assert second > 2
        assert not journal_of(path).exists()


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_full_disk_or_an_interruption_leaves_the_old_log_or_the_new_one(path, change, monkeypatch, error):
    def fail() -> None:
        raise error

    outcomes = []
    for at in range(1, 300):
        reset(path, change.old)
        raised = None
        with monkeypatch.context() as patch, notices.collected() as said:
            for name in CALLS:
                patch.setattr(os, name, getattr(os, name))  # put back at the end
            done = sabotage(at, fail)
            try:
                change.make(path)
            except (McaptrackError, KeyboardInterrupt) as found:
                assert "\n" not in str(found)
                raised = found
        if len(done) < at:
            break
        left = path.read_bytes()
        outcomes.append("old" if left == change.old else "new")
        assert outcomes[-1] == "new" or raised is not None
        assert left == change.old or (left == change.new and (said or raised is error or done[at - 1] == "chmod"))
        with notices.collected() as said:
            mend(path)
        assert path.read_bytes() == left
        assert not journal_of(path).exists()
    assert len(done) < at
    assert len(outcomes) > 10
    assert {"old", "new"} == set(outcomes)
    assert path.read_bytes() == change.new


def test_what_can_t_be_put_back_at_once_is_put_back_later(path, change, monkeypatch):
    real, count = os.pwrite, [0]

    def full(*args):
        count[0] += 1
        if count[0] > 1:
            raise OSError(errno.EIO, "Input/output error")
        return real(*args)

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", full)
        patch.setattr(os, "ftruncate", full)
        with pytest.raises(McaptrackError) as said:
            change.make(path)
    if count[0] > 2:
        assert "its old state can't be restored" in str(said.value)
        assert "\n" not in str(said.value)
    assert look(path, change) == "old"


def test_a_newer_log_that_takes_the_place_of_a_half_written_one_is_never_rolled_back(path, change, kills):
    """Also where it is what the interrupted change would have become, which another machine may have finished."""
    newer = path.parent / "newer"
    newer.write_bytes(change.old)
    add_results(newer, 3, 700)
    other = newer.read_bytes()
    for files in kills[::2]:
        for content in (change.new, other):
            put(path, files)
            with path.open("rb+") as stream:  # as cp does: the file stays the same one
                stream.write(content)
                stream.truncate(len(content))
            before, wanted = photo(path.parent), contents(path)
            found = seen(path)
            assert log.check(path).is_sound
            assert counts(found) == counts(wanted)
            assert photo(path.parent) == before
            try:
                mend(path)
            except McaptrackError as error:
                assert "has been changed since" in str(error)
                assert f"`rm {journal_of(path)}`" in str(error)
            assert path.read_bytes() == content


def test_a_writer_that_is_at_work_is_seen_beside(path, change):
    """A reader sees the log as it was, at every step, and does not wait."""
    said: list[notices.Notice] = []
    steps = []

    def watch(name, real):
        def call(*args, **kwargs):
            out = real(*args, **kwargs)
            if journal_of(path).exists() and name in ("pwrite", "replace", "ftruncate"):
                steps.append(name)
                with notices.collected() as heard:
                    assert seen(path) == old
                    with pytest.raises(McaptrackError, match="is being written to by another process"):
                        log.check(path)
                    with pytest.raises(McaptrackError, match="is being written to by another process"):
                        mend(path)
                said.extend(heard)
            return out

        return call

    old = seen(path)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("pwrite", "replace", "ftruncate"):
            patch.setattr(os, name, watch(name, getattr(os, name)))
        change.make(path)
    assert path.read_bytes() == change.new
    assert len(steps) > 1
    assert {notice.message for notice in said} == {
        f"{path} is being written to by another process; its state before that is read"
    }


def test_the_writer_of_a_log_goes_on_seeing_its_content_before_the_change(path, change):
    with log.read(path) as opened:
        before = {topic: [m.payload for m in opened.messages(topic)] for topic in opened.channels}
        dropped = list(before)[1]
        with log.extend(opened, drop=[dropped]) as writer:
            number = writer.add_channel("/more", SCHEMA, "json", {})
            for n in range(300):
                writer.add_message(number, n, n, bytes(1000))
                if n % 100 == 0:
                    assert [m.payload for m in opened.messages(dropped)] == before[dropped]
        assert {topic: [m.payload for m in opened.messages(topic)] for topic in opened.channels} == before
        with pytest.raises(McaptrackError, match="was changed since it was opened; open it again"):
            opened.lock()
    assert counts(seen(path)).keys() == before.keys() - {dropped} | {"/more"}


def test_a_log_that_was_moved_away_with_its_journal_can_be_saved(path, kills, tmp_path):
    """Its journal fits by what it holds, but doesn't name its file: it is used for another file only."""
    for _ in left_behind(path, kills):
        if not journal_of(path).exists():
            continue
        folder = tmp_path / "moved"
        folder.mkdir()
        moved = folder / "a.mcap"
        shutil.copyfile(path, moved)
        shutil.copyfile(journal_of(path), journal_of(moved))
        before = photo(folder)
        with notices.collected() as said:
            report = log.recover(moved, tmp_path / "saved.mcap")
        assert photo(folder) == before
        assert report.lost == []
        assert len(said) == 1
        assert counts(contents(tmp_path / "saved.mcap")) == counts(seen(path))
        shutil.rmtree(folder)
