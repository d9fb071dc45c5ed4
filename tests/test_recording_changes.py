"""An open ``Recording`` is never stale: whatever changes the log, the next call gives what is there, or one error."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier, Event
from typing import Any

import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.log import byte_source
from tests.commands import done
from tests.extension_cases import needs
from tests.logs import SCHEMA, some_log
from tests.test_log_changed import KINDS, overwrite, replace, write_value
from tests.tiers import thorough

#: What each method gives, in a form that can be compared.
LOOKS: dict[str, Callable[[Any], object]] = {
    "topics": lambda opened: opened.topics,
    "table": lambda opened: {name: opened.table(name).to_pylist() for name in opened.tables},
    "array": lambda opened: opened.array("channels").tolist(),
    "messages": lambda opened: list(opened.messages(decode=False)),
    "fetch": lambda opened: [opened.fetch(row) for row in opened.table("frames").to_pylist()],
}


def extended(path: Path, beside: Path) -> None:
    with log.read(path) as opened, log.extend(opened, drop=["/imu"] if "/imu" in opened.channels else []) as writer:
        writer.add_message(writer.add_channel(f"/new{path.stat().st_size}", SCHEMA, "json", {}), 5, 1, b"{}")


def results_come(path: Path, beside: Path) -> None:
    with log.read(path, sidecar=True) as opened, log.extend(opened) as writer:
        writer.add_message(writer.add_channel("/result", SCHEMA, "json", {}), 5, 1, b"{}")


CHANGES: dict[str, Callable[[Path, Path], object]] = {
    "extended in place": extended,
    "overwritten": lambda path, beside: overwrite(path, beside.read_bytes()),
    "replaced": lambda path, beside: replace(path, beside.read_bytes()),
    "results come": results_come,
    "results change": lambda path, beside: extended(log.results_path(path), beside),
    "results go": lambda path, beside: log.results_path(path).unlink(),
    "by a command": lambda path, beside: done("drop", path, "/camera/truth"),
}


@pytest.fixture
def certain(monkeypatch) -> None:
    """Take it that every change gives a file another size or other times, also right after the last one."""
    monkeypatch.setattr(byte_source, "_TICK_S", 0)


@pytest.mark.parametrize("look", LOOKS)
def test_every_method_gives_what_is_there_now(tmp_path, look, certain):
    path = some_log(tmp_path / "a.mcap")
    beside = some_log(tmp_path / "b.mcap", **{"/more": (mcaptrack.schema.TRACKS, [])})
    with mcaptrack.open(path) as opened:
        seen = [LOOKS[look](opened)]
        for name, change in CHANGES.items():
            change(path, beside)
            with mcaptrack.open(path) as fresh:
                seen.append(LOOKS[look](fresh))
            assert LOOKS[look](opened) == seen[-1], name
    assert len(set(map(repr, seen))) > 1


@needs("Player")
def test_pictures_players_and_boxes_are_those_of_now(finished, template, tmp_path):
    path = Path(shutil.copy(finished, tmp_path / "a.mcap"))

    def look(opened: Any) -> object:
        pictures = [(frame.t_ns, frame.rows.tobytes()) for frame in opened.frames(colour="grey")]
        return pictures, opened.show(end_s=0.3).pictures

    with mcaptrack.open(path) as opened:
        before = look(opened)
        overwrite(path, template.read_bytes())
        with mcaptrack.open(path) as fresh:
            assert look(opened) == look(fresh) != before


def test_a_change_within_the_resolution_of_file_times_is_seen(tmp_path, monkeypatch):
    """The content has the same size, and the file the same times."""
    monkeypatch.setattr(byte_source, "_TICK_S", float("inf"))
    monkeypatch.setattr(
        byte_source.Signature, "of", classmethod(lambda cls, handle: cls(os.fstat(handle).st_size, 0, 0))
    )
    path = tmp_path / "a.mcap"
    new = write_value(path, 2, **KINDS["plain chunks"])
    assert len(write_value(path, 1, **KINDS["plain chunks"])) == len(new)
    with mcaptrack.open(path) as opened:
        assert {m.data[0] for _, _, m, _ in opened.messages(decode=False)} == {1}
        overwrite(path, new)
        assert {m.data[0] for _, _, m, _ in opened.messages(decode=False)} == {2}


def test_a_log_that_was_not_changed_is_not_read_again(tmp_path, monkeypatch, certain):
    path = some_log(tmp_path / "a.mcap")
    with mcaptrack.open(path) as opened:
        for look in LOOKS.values():
            look(opened)
        monkeypatch.setattr(log, "read", None)
        for look in LOOKS.values():
            look(opened)
        (first, second) = (opened.table("tracks") for _ in range(2))
        assert first.equals(second)


def test_a_link_that_leads_to_another_log_is_followed(tmp_path, certain):
    some_log(tmp_path / "one.mcap")
    write_value(tmp_path / "other.mcap", 1)
    link = tmp_path / "a.mcap"
    link.symlink_to("one.mcap")
    with mcaptrack.open(link) as opened:
        assert "/imu" in opened.topics
        link.unlink()
        link.symlink_to("other.mcap")
        assert opened.topics == ("a", "b", "c")


def test_a_log_in_another_working_folder_is_found(tmp_path, monkeypatch):
    (tmp_path / "below").mkdir()
    monkeypatch.chdir(tmp_path)
    some_log(tmp_path / "a.mcap")
    with mcaptrack.open("a.mcap") as opened:
        monkeypatch.chdir(tmp_path / "below")
        assert "/imu" in opened.topics
        write_value(tmp_path / "a.mcap", 1)
        assert opened.topics == ("a", "b", "c")
        assert opened.path == tmp_path / "a.mcap"


def test_a_log_that_goes_is_missed_and_one_that_comes_back_is_read(tmp_path):
    path = some_log(tmp_path / "a.mcap")
    content = path.read_bytes()
    with mcaptrack.open(path) as opened:
        topics = opened.topics
        path.unlink()
        for _ in range(2):
            with pytest.raises(McaptrackError, match=r"a.mcap does not exist"):
                opened.table("tracks")
        path.write_bytes(b"no log")
        with pytest.raises(McaptrackError, match=r"a.mcap can't be read as an MCAP file"):
            opened.table("tracks")
        path.write_bytes(content)
        assert opened.topics == topics


# What was begun


@pytest.mark.parametrize("change", [overwrite, replace])
@pytest.mark.parametrize("kind", KINDS)
def test_an_iterator_goes_on_over_what_it_began_with_or_ends_with_one_error(tmp_path, kind, change):
    path = tmp_path / "a.mcap"
    new = write_value(path, 2, **KINDS[kind])
    for taken in range(5):
        path.write_bytes(b"")
        write_value(path, 1, **KINDS[kind])
        with mcaptrack.open(path) as opened:
            found = opened.messages(decode=False)
            values = [next(found).message.data[0] for _ in range(taken)]
            change(path, new)
            assert {one.message.data[0] for one in opened.messages(decode=False)} == {2}  # opened again meanwhile
            try:
                values += [one.message.data[0] for one in found]
                assert values == [1] * 4
            except McaptrackError as error:
                assert "was changed by another process while it was being read" in str(error)
                assert change is overwrite
            assert set(values) <= {1}


def test_an_iterator_goes_on_when_something_is_added(finished, tmp_path):
    path = Path(shutil.copy(finished, tmp_path / "a.mcap"))
    rows = mcaptrack.detections([[9, 20, 17, 28]], t_ns=0, box_format="xyxy")

    def begun(opened: Any) -> tuple[Iterator[Any], ...]:
        return (opened.messages(decode=False), opened.frames(colour="grey"), opened.supervision("camera/tracks"))

    with mcaptrack.open(path) as opened:
        wanted = [len(list(found)) for found in begun(opened)[:2]]
        late = begun(opened)[:2]
        for found in late:
            next(found)
        opened.write("/mine/detections", [rows])
        assert "/mine/detections" in opened.topics
        assert [1 + len(list(found)) for found in late] == wanted


def test_closing_ends_also_what_was_begun_before_a_change(tmp_path):
    path = some_log(tmp_path / "a.mcap")
    before = len(os.listdir("/proc/self/fd"))
    opened = mcaptrack.open(path)
    begun = []
    for _ in range(3):
        begun.append(opened.messages())
        next(begun[-1])
        extended(path, path)
        assert opened.topics
    opened.close()
    for found in begun:
        with pytest.raises(McaptrackError, match="is closed"):
            next(found)
    assert len(os.listdir("/proc/self/fd")) == before


def test_logs_that_nothing_reads_any_more_are_closed(tmp_path):
    path = some_log(tmp_path / "a.mcap")
    with mcaptrack.open(path) as opened:
        before = len(os.listdir("/proc/self/fd"))
        for _ in range(5):
            extended(path, path)
            assert list(opened.messages(decode=False))
        assert len(os.listdir("/proc/self/fd")) == before


# Threads and processes


def test_threads_that_read_while_the_log_is_changed_get_one_of_its_states(tmp_path):
    path = some_log(tmp_path / "a.mcap")
    beside = some_log(tmp_path / "b.mcap", **{"/more": (mcaptrack.schema.TRACKS, [])})
    contents = [path.read_bytes(), beside.read_bytes()]
    states: dict[str, list[object]] = {name: [] for name in LOOKS}
    for content in contents:
        replace(path, content)
        with mcaptrack.open(path) as fresh:
            for name, look in LOOKS.items():
                states[name].append(look(fresh))
    barrier = Barrier(len(LOOKS) + 1)

    def read(name: str) -> None:
        try:
            assert LOOKS[name](opened) in states[name] or name == "table"  # that is several calls
        except McaptrackError as error:
            text = str(error)  # a row of the other state, or a change while the places of rows were read
            assert "export its tables again" in text or (name == "table" and "while it was being read" in text)

    def after_each_other(work: Callable[[int], object]) -> None:
        try:
            for number in range(6):
                barrier.wait()
                work(number)
        except BaseException:
            barrier.abort()
            raise

    with mcaptrack.open(path) as opened, ThreadPoolExecutor(len(LOOKS) + 1) as pool:
        running = [pool.submit(after_each_other, lambda number: replace(path, contents[number % 2]))]
        running += [pool.submit(after_each_other, lambda _, name=name: read(name)) for name in LOOKS]
        for one in running:
            one.result()
        assert all(LOOKS[name](opened) == states[name][1] for name in LOOKS)


def test_threads_may_share_an_iterator(tmp_path):
    path = some_log(tmp_path / "a.mcap")
    with mcaptrack.open(path) as opened, ThreadPoolExecutor(8) as pool:
        wanted = list(opened.messages(decode=False))
        shared = opened.messages(decode=False)
        parts = [one.result() for one in [pool.submit(lambda: list(shared)) for _ in range(8)]]
        found = [one for part in parts for one in part]
        assert len(found) == len(wanted)
        assert all(one in wanted for one in found)


@needs("Player")
def test_closing_waits_for_a_call_and_what_follows_is_refused(finished):
    opened, begun, go_on = mcaptrack.open(finished), Event(), Event()

    def progress(*_: object) -> None:
        begun.set()
        go_on.wait()

    with ThreadPoolExecutor(2) as pool:
        shown = pool.submit(lambda: opened.show(end_s=0.3, progress=progress))
        begun.wait()
        closed = pool.submit(opened.close)
        go_on.set()
        assert shown.result().pictures
        closed.result()
    with pytest.raises(McaptrackError, match="is closed"):
        opened.table("tracks")


def test_a_recording_is_opened_again_where_it_is_unpickled(tmp_path, monkeypatch):
    path = some_log(tmp_path / "a.mcap")
    monkeypatch.chdir(tmp_path)
    with mcaptrack.open("a.mcap") as opened:
        sent = pickle.dumps(opened)
        monkeypatch.chdir("/")
        with pickle.loads(sent) as received:
            assert (type(received), received.path) == (mcaptrack.Recording, path)
            assert list(received.messages(decode=False)) == list(opened.messages(decode=False))
    with pytest.raises(McaptrackError, match="is closed"):
        pickle.dumps(opened)


FORK = """
import os, sys, threading
import mcaptrack

opened = mcaptrack.open(sys.argv[1])
begun = opened.messages(decode=False)
first = next(begun)
rest = list(opened.messages(decode=False))[1:]
held, leave = threading.Event(), threading.Event()

def hold():
    with opened._now():
        held.set()
        leave.wait()

thread = threading.Thread(target=hold)
thread.start()
held.wait()
child = os.fork()
if child == 0:  # where that thread does not exist
    ok = list(begun) == rest and opened.table("tracks").num_rows > 0
    opened.close()
    os._exit(0 if ok else 1)
leave.set()
thread.join()
assert os.waitpid(child, 0)[1] == 0
assert list(begun) == rest  # the child has read on by itself
print("done")
"""


@thorough
def test_a_forked_process_reads_by_itself(tmp_path):
    path = some_log(tmp_path / "a.mcap")
    command = [sys.executable, "-W", "ignore", "-c", FORK, path]
    assert subprocess.run(command, capture_output=True, text=True, timeout=600, check=True).stdout == "done\n"
