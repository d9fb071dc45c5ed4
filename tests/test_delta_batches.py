"""Which tables of which logs are written to Delta tables, by what stands there: decided without writing any."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.tables.delta import DeltaFolder, exported, upkeep
from mcaptrack.tables.delta.commit import Batch, Committed, _differs, _digests, _is_same_log, predicate
from mcaptrack.tables.delta.exported import ExportedLog
from mcaptrack.tables.fields import TABLES

committing = sys.modules["mcaptrack.tables.delta.commit"]


class Log(SimpleNamespace):
    """A log that was exported: its name, the digests of its tables, and its row."""

    def __init__(self, name: str, digests: dict[str, str] | None = None, folder: str = "here", fault: str = "") -> None:
        super().__init__(log=Path(folder, f"{name}.mcap"), recording=name, given=digests or {}, fault=fault)
        self.row = {"location": str(self.log), "digest": f"digest of {name}"}

    @property
    def digests(self) -> dict[str, str]:
        if self.fault:
            raise McaptrackError(self.fault)
        return self.given

    def is_as(self, known: dict[str, str]) -> bool:
        return self.given == known


def row(one: Log, digests: dict[str, str] | None = None, **changed: Any) -> dict[str, Any]:
    """What ``recordings`` says of a log."""
    return one.row | {"tables": json.dumps(one.given if digests is None else digests)} | changed


@pytest.fixture
def batch(tmp_path) -> Batch:
    return Batch(DeltaFolder(tmp_path / "lake"), Committed())


def test_transactions_are_tried_again_with_growing_pauses(batch, monkeypatch, tmp_path):
    pauses: list[float] = []
    monkeypatch.setattr(committing.time, "sleep", pauses.append)
    monkeypatch.setattr(committing.random, "uniform", lambda low, high: low + high)
    with pytest.raises(
        McaptrackError, match=f"{tmp_path / 'lake'} can't be written: other processes were quicker 60 times"
    ):
        for number in batch.attempts():
            assert number == len(pauses) == batch.done.conflicts
    assert pauses == [0.04, 0.08, 0.16, 0.32, 0.64, 1.28] + [2.0] * 53
    assert batch.done.conflicts == 59


def test_logs_of_one_name_are_refused_but_for_the_first(batch):
    b, a, other = Log("b"), Log("a"), Log("b", folder="there")
    assert batch.distinct([b, a, other, b]) == [a, b]
    assert batch.done.failed == {
        other.log: "there/b.mcap: here/b.mcap has the same name in the tables, b; rename one of them"
    }


def test_logs_that_differ_are_written(batch, tmp_path):
    same, new, moved, more = Log("same", {"x": "1"}), Log("new"), Log("moved", {"x": "2"}), Log("more", {"x": "1"})
    stranger, broken = Log("stranger", {"x": "3"}), Log("broken", fault="its tables are damaged")
    known = {
        "same": row(same),
        "moved": row(moved, {"x": "1"}, location="elsewhere/moved.mcap"),  # the same digest
        "more": row(more, {"x": "1", "y": "2"}, digest="changed since"),  # the same place
        "stranger": row(stranger, {"x": "1"}, location="elsewhere/s.mcap", digest="other"),
    }
    logs = [same, new, moved, more, stranger, broken]
    assert batch.changed(logs, known, force=False, again=False) == [new, moved, more]
    assert batch.done.failed == {
        stranger.log: f"here/stranger.mcap: {tmp_path / 'lake'} has another log of the name stranger, elsewhere/s.mcap; "
        "rename one of them, or replace it with `force=True`",
        broken.log: "here/broken.mcap: its tables are damaged",
    }
    batch.done.failed.clear()
    assert batch.changed(logs, known, force=True, again=False) == [new, moved, more, stranger]
    batch.done.failed.clear()
    assert batch.changed(logs, known, force=False, again=True) == [same, new, moved, more]
    batch.done.failed = {new.log: "why"}
    assert batch.changed([new, more], known, force=False, again=False) == [more]
    broken.fault = f"{broken.log} is gone"
    batch.changed([broken], {}, force=False, again=False)
    assert batch.done.failed[broken.log] == "here/broken.mcap is gone"


def test_tables_that_differ_are_written():
    one = Log("a", {"x": "1", "empty": "", "new": "2"})
    known = {"a": row(one, {"x": "1", "gone": "3", "y": "4"})}
    for name, first, again in (
        ("x", False, True), ("empty", False, False), ("new", True, True), ("gone", True, True), ("none", False, False),
    ):  # fmt: skip
        assert (_differs(one, known, name, False), _differs(one, known, name, True)) == (first, again), name
    for before in ({}, {"a": row(one, {})}, {"a": row(one, tables="no json")}, {"b": known["a"]}):
        assert _differs(one, before, "none", False)


def test_digests_are_those_of_the_row():
    assert _digests({"tables": '{"x": "1"}'}) == {"x": "1"}
    for text in (None, "", "{", "[1]", '"x"'):
        assert _digests({"tables": text}) == {}


def test_a_log_is_the_same_by_its_place_or_by_its_content():
    here = {"location": "a", "digest": "1"}
    assert [_is_same_log(here, {"location": where, "digest": what}) for where in ("a", "b", None) for what in "12"] == [
        True, True, True, False, True, True,
    ]  # fmt: skip


def test_tables_are_those_that_logs_have_or_had(batch):
    one, other = Log("a", {"tracks": "1", "topics/b": "2"}), Log("b", {"topics/a": ""})
    usual = [name for name in TABLES if name != "recordings"]
    assert batch.names([one, other], {"a": row(one, {"topics/old": "1"})}) == [
        *usual,
        "topics/a",
        "topics/b",
        "topics/old",
    ]
    assert batch.names([other], {"a": row(one)}) == [*usual, "topics/a"]
    assert batch.names([], {}) == usual


def test_what_was_done_is_added_up():
    total = Committed(["a"], [], ["c"], {Path("x"): "why"}, ["one"], 2, 3)
    total.add(Committed(["d"], ["e"], ["f"], {Path("y"): "so"}, ["two"], 10, 20))
    assert total == Committed(
        ["a", "d"], ["e"], ["c", "f"], {Path("x"): "why", Path("y"): "so"}, ["one", "two"], 12, 23
    )


def test_names_are_quoted():
    assert predicate(["a", "o'b''c"]) == "recording IN ('a', 'o''b''''c')"


@pytest.mark.parametrize(
    ("topics", "known", "is_same"),
    [
        ((), {"recordings": "1", "tracks": "9"}, True),  # by one file only
        ((), {"recordings": "2", "tracks": "2"}, False),
        ((), {}, False),
        ((), {"recordings": "1", "topics/a": "3"}, False),
        (("topics/a",), {"recordings": "1", "tracks": "2"}, False),
        (("topics/a",), {"recordings": "1", "tracks": "2", "topics/a": "3"}, True),
    ],
)
def test_tables_of_a_log_are_compared_by_their_digests(monkeypatch, topics, known, is_same):
    asked = []
    all_of = {"recordings": "1", "tracks": "2", "topics/a": "3"}

    def digest(_: ExportedLog, name: str) -> str:
        asked.append(name)
        return all_of[name]

    monkeypatch.setattr(exported, "TABLES", ("recordings", "tracks"))
    monkeypatch.setattr(ExportedLog, "digest", digest)
    monkeypatch.setattr(ExportedLog, "topics", topics)
    assert ExportedLog(Path("a.mcap"), Path("a.tables")).is_as(known) == is_same
    assert set(asked) <= ({"recordings"} if not topics and "topics/a" not in known else set(all_of))


def test_the_newest_version_is_changed_if_others_were_quicker(monkeypatch, tmp_path):
    import deltalake

    folder, tried = DeltaFolder(tmp_path), []
    monkeypatch.setattr(DeltaFolder, "table", lambda _, name: None if name == "none" else f"version {len(tried)}")

    def work(table: str) -> str:
        tried.append(table)
        if len(tried) < late:
            raise deltalake.exceptions.CommitFailedError("late")
        return f"done with {table}"

    for late in (1, 5):
        tried.clear()
        assert upkeep._repeated(folder, "tracks", work) == f"done with version {late - 1}"
        assert len(tried) == late
    assert upkeep._repeated(folder, "none", work) is None
    late = 9
    tried.clear()
    with pytest.raises(
        McaptrackError, match=r"tracks can't be compacted: other processes write to it; try again later"
    ):
        upkeep._repeated(folder, "tracks", work)
    assert len(tried) == 5


def test_what_was_joined_and_deleted_is_counted(monkeypatch, tmp_path):
    counts = {"tracks": (5, 2), "frames": (0, 0), "gone": None}

    class Table(SimpleNamespace):
        @property
        def optimize(self) -> Any:
            removed, added = counts[self.name]
            done = {"numFilesRemoved": removed, "numFilesAdded": added}
            return SimpleNamespace(compact=lambda target_size: done if target_size == 32 * 2**20 else None)

        def vacuum(self, **options: Any) -> list[str]:
            asked.append(options)
            return ["file"] * counts[self.name][0]

    asked: list[dict[str, Any]] = []
    monkeypatch.setattr(upkeep, "is_delta_folder", lambda _: True)
    monkeypatch.setattr(DeltaFolder, "names", lambda _: list(counts))
    monkeypatch.setattr(DeltaFolder, "table", lambda _, name: None if counts[name] is None else Table(name=name))
    assert upkeep.compact(tmp_path) == {"tracks": (5, 2)}
    assert upkeep.vacuum(tmp_path, 1.5) == 5
    options = {"retention_hours": 36, "dry_run": False, "enforce_retention_duration": False, "full": True}
    assert asked == [options] * 2
