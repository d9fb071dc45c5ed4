"""What a run owes beside a log: complete after any kill, without leftovers; and of one log only."""

from __future__ import annotations

import json
import os
import resource
import shutil
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import NamedTuple

import pyarrow.parquet as pq
import pytest

import mcaptrack
from mcaptrack import fleet
from mcaptrack.errors import McaptrackError
from tests.bounded import limited
from tests.extension_cases import of_extensions
from tests.interrupted import CALLS, killed
from tests.tiers import one_in, thorough

#: Calls that change something on the disk, or open it for that.
EACH_CALL = (*CALLS, "open", "mkdir", "rmdir", "rename")


def labels(folder: Path, offset: float = 0.0) -> Path:
    path = folder / "world.txt"
    lines = [f"{12 * n} {who} {0.4 * n + who + offset} {who * 5.0}" for n in range(12) for who in (1, 2)]
    path.write_text("\n".join(lines))
    return path


def log_of(path: Path, offset: float = 0.0) -> Path:
    """A log of two people's tracks; those of another offset are another recording."""
    path.parent.mkdir(exist_ok=True)
    source = labels(path.parent, offset)
    mcaptrack.ingest(source, path)
    source.unlink()
    return path


def contents(folder: Path) -> dict[str, bytes | None]:
    return {
        str(entry.relative_to(folder)): entry.read_bytes() if entry.is_file() else None for entry in folder.rglob("*")
    }


class Work(NamedTuple):
    """What is done in a folder; ``again`` is the command that follows a kill, which is at each ``step``-th call."""

    prepare: Callable[[Path], object]
    do: Callable[[Path], object]
    again: Callable[[Path], object]
    step: int = 61


def ingest_once(folder: Path) -> None:
    if not (folder / "b.mcap").exists():
        mcaptrack.ingest(folder / "world.txt", folder / "b.mcap")


def run(folder: Path, **options: object) -> None:
    mcaptrack.run(folder / "a.mcap", **options)


def retrack(folder: Path) -> None:
    mcaptrack.retrack(folder / "a.mcap", retracker="consistency")


def prepare_tables(folder: Path) -> None:
    """Re-track a log that has tables: these are of the tracks before."""
    prepare_run(folder)
    retrack(folder)


def prepare_run(folder: Path) -> None:
    run(log_of(folder / "a.mcap").parent)
    (folder / "a.comparing.layout.json").unlink()


WORKS = {
    "run": Work(lambda folder: log_of(folder / "a.mcap"), run, run),
    "run with another re-tracker": Work(
        prepare_run,
        lambda folder: run(folder, retracker="consistency"),
        lambda folder: run(folder, retracker="consistency"),
    ),
    "retrack": Work(prepare_run, retrack, retrack, 11),
    "run after re-tracking": Work(prepare_tables, run, run, 41),
    "export": Work(
        lambda folder: log_of(folder / "a.mcap"),
        *[lambda folder: mcaptrack.export(folder / "a.mcap", folder / "T", topic="/camera/tracks")] * 2,
        step=29,
    ),
    "ingest": Work(labels, ingest_once, ingest_once, 2),
} | {name: Work(*work) for name, work in of_extensions("WORKS").items()}


def restore(folder: Path, kept: Path) -> None:
    """Make a folder what it was: at the same place, because tables say where their log is."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(kept, folder)


def leave_nothing_undone(work: Work, tmp_path: Path, step: int) -> None:
    folder, kept = tmp_path / "work", tmp_path / "kept"
    folder.mkdir()
    work.prepare(folder)
    shutil.copytree(folder, kept)
    work.do(folder)
    whole = contents(folder)
    kills = 0
    for at in range(1, 3000, step):
        restore(folder, kept)
        if not killed(lambda: work.do(folder), at, EACH_CALL):
            break
        kills += 1
        work.again(folder)
        found = contents(folder)
        assert found.keys() == whole.keys(), at
        assert [name for name in whole if found[name] != whole[name]] == [], at
    assert kills >= 3


@pytest.mark.parametrize("name", one_in(4, sorted(WORKS.keys() - {"run with another re-tracker"})))
def test_killed_at_some_calls_the_next_command_completes_what_is_owed(name, tmp_path):
    leave_nothing_undone(WORKS[name], tmp_path, WORKS[name].step)


def fleet_over(folder: Path) -> None:
    done = fleet.run(mcaptrack.export, [folder / "a.mcap", folder / "b.mcap"], ledger=folder / "ledger.jsonl")
    assert not done.failed


@thorough
def test_a_fleet_that_is_killed_at_any_call_is_completed_by_the_next(tmp_path):
    for name in ("a", "b"):
        log_of(tmp_path / "work" / f"{name}.mcap")
    kept, folder = tmp_path / "kept", tmp_path / "work"
    shutil.copytree(folder, kept)
    fleet_over(folder)
    whole = contents(folder)
    kills = 0
    for at in range(1, 1000):
        restore(folder, kept)
        if not killed(lambda: fleet_over(folder), at, EACH_CALL):
            break
        kills += 1
        fleet_over(folder)
        found = contents(folder)
        assert found.keys() == whole.keys(), at
        assert [name for name in whole if found[name] != whole[name] and name != "ledger.jsonl"] == [], at
        done = [json.loads(line) for line in (folder / "ledger.jsonl").read_bytes().splitlines() if line.endswith(b"}")]
        assert {Path(line["location"]).name for line in done} == {"a.mcap", "b.mcap"}
    assert kills >= 2


@thorough
@pytest.mark.parametrize("name", WORKS)
def test_killed_at_any_call_the_next_command_completes_what_is_owed(name, tmp_path):
    leave_nothing_undone(WORKS[name], tmp_path, 1)


def test_what_is_missing_is_made_again_and_what_was_edited_stays(tmp_path):
    path = log_of(tmp_path / "a.mcap")
    first = mcaptrack.run(path)
    whole = contents(tmp_path)
    assert not first.is_up_to_date
    assert all(file.is_file() for file in first.files)
    assert mcaptrack.run(path).is_up_to_date
    assert contents(tmp_path) == whole
    beside = [tmp_path / name for name in sorted(whole) if name != path.name and (tmp_path / name).is_file()]
    for file in beside[::3]:  # layouts and tables
        file.unlink()
        again = mcaptrack.run(path)
        assert not again.is_up_to_date, file
        assert again.stages == (), file
        assert contents(tmp_path) == whole, file
    layout = tmp_path / "a.layout.json"
    layout.write_bytes(b"{}")
    assert mcaptrack.run(path).is_up_to_date
    assert layout.read_bytes() == b"{}"
    os.utime(layout, ns=(0, 0))  # older than the log: a kill has left it
    assert mcaptrack.run(path).layouts == (layout,)
    assert contents(tmp_path) == whole


@thorough
def test_a_ledger_counts_a_log_as_done_only_with_its_products(tmp_path):
    logs = [log_of(tmp_path / f"{name}.mcap") for name in ("a", "b", "c")]
    given = {"ledger": tmp_path / "ledger.jsonl", "jobs": 1}
    assert fleet.run(mcaptrack.run, logs, **given).counts == {"done": 3}
    (tmp_path / "b.predictions.layout.json").unlink()
    shutil.rmtree(tmp_path / "a.tables")
    assert fleet.run(mcaptrack.run, logs, **given).counts == {"done": 2, "skipped": 1}
    assert (tmp_path / "b.predictions.layout.json").is_file()
    assert (tmp_path / "a.tables/recordings/recording=a/part-0.parquet").is_file()


# Whose tables they are


def locations(folder: Path) -> set[str]:
    found = (pq.read_table(file)["location"].to_pylist() for file in folder.glob("recordings/*/part-0.parquet"))
    return {location for some in found for location in some}


PAIRS = [
    ("a b.mcap", "a_b.mcap"),
    ("x/l.mcap", "y/l.mcap"),
    ("l.mcap", "l.MCAP"),
    ("Walk.mcap", "walk.mcap"),
    ("x/Stra\u00dfe.mcap", "y/STRASSE.mcap"),
    ("1.mcap", "log-1.mcap"),
]


@pytest.mark.parametrize(("names", "form"), one_in(12, product(PAIRS, ["parquet", "csv", "jsonl", "arrow"])))
def test_tables_of_another_log_are_never_replaced_unasked(names, form, tmp_path):
    one, other = (log_of(tmp_path / name, offset) for offset, name in enumerate(names))
    folder = tmp_path / "T"
    mcaptrack.export(one, folder, form=form)
    before = contents(folder)
    for second in ("parquet", form):
        with pytest.raises(McaptrackError, match=r"holds the tables of .*another folder with `output=`") as said:
            mcaptrack.export(other, folder, form=second)
        assert "\n" not in str(said.value)
        assert contents(folder) == before
    mcaptrack.export(one, folder, form=form)
    mcaptrack.export(other, folder, form="parquet", force=True)
    assert str(other) in locations(folder)


@pytest.mark.parametrize(("one", "other"), one_in(6, PAIRS))
def test_logs_that_are_used_together_have_names_of_their_own_or_are_refused(one, other, tmp_path):
    logs = [log_of(tmp_path / name, offset) for offset, name in enumerate((one, other))]
    for log in logs:
        mcaptrack.run(log, tables=False)
    for names_of in of_extensions("TOGETHER").values():
        before = contents(tmp_path)
        try:
            assert len(set(names_of(logs, tmp_path))) == 2
        except McaptrackError as error:
            assert "rename one" in str(error)
            assert contents(tmp_path) == before


def test_a_log_by_two_names_does_not_count_twice(tmp_path, finished):
    link = tmp_path / "link.mcap"
    link.symlink_to(finished)
    with pytest.raises(McaptrackError, match=r"walk\.mcap is named twice; name it once"):
        mcaptrack.evaluate([link, finished])


def test_a_log_is_known_by_what_was_recorded_wherever_it_is_and_whatever_was_added(tmp_path):
    folder, path = tmp_path / "T", log_of(tmp_path / "x/l.mcap")
    mcaptrack.export(path, folder)
    mcaptrack.run(path, tables=False)
    mcaptrack.export(path, folder)
    moved = tmp_path / "y/l.mcap"
    moved.parent.mkdir()
    path.rename(moved)
    mcaptrack.run(moved, tables=False, retracker="consistency")
    mcaptrack.export(moved, folder)
    assert locations(folder) == {str(moved)}
    log_of(path, 1.0)  # another recording, where this one was
    before = contents(folder)
    with pytest.raises(McaptrackError, match="holds the tables of"):
        mcaptrack.export(path, folder)
    path.unlink()
    shutil.copyfile(moved, path)  # a copy may have other results
    with pytest.raises(McaptrackError, match="holds the tables of"):
        mcaptrack.export(path, folder)
    assert contents(folder) == before
    for name in ("y", "T"):  # a copy of logs and tables together
        shutil.copytree(tmp_path / name, tmp_path / "all" / name)
    mcaptrack.export(tmp_path / "all/y/l.mcap", tmp_path / "all/T")
    moved.unlink()
    mcaptrack.export(log_of(moved, 2.0), folder)  # the tables follow the log at their place
    assert locations(folder) == {str(moved)}
    moved.unlink()
    path.unlink()
    with pytest.raises(McaptrackError, match="holds the tables of"):  # that log is gone, but its tables are kept
        mcaptrack.export(log_of(path, 3.0), folder)


def test_scores_of_two_logs_of_one_name_are_not_mixed(finished, tmp_path):
    logs = [tmp_path / name / "l.mcap" for name in "xy"]
    for log in logs:
        log.parent.mkdir()
        shutil.copyfile(finished, log)
    names = {row.sequence for row in mcaptrack.evaluate(logs).results}
    assert names == {"x/l", "y/l", "COMBINED"}


#: What writes a file or folder beside a log, as functions of the log and of what to write.
WRITTEN: dict[str, Callable[[Path, Path], object]] = {
    "a.mot.txt": lambda path, output: mcaptrack.export(path, output, form="mot"),
    "a.mcap": lambda path, output: mcaptrack.drop(path, ["/camera/truth"], output=output),
} | of_extensions("WRITTEN")


@pytest.mark.parametrize("name", one_in(3, WRITTEN))
def test_what_has_no_room_is_named_and_leaves_nothing(name, finished, tmp_path):
    with (
        limited(resource.RLIMIT_FSIZE, 1000),
        pytest.raises(McaptrackError, match=f"{name} can't be written: (File too large|disk I/O)"),
    ):
        WRITTEN[name](finished, tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name] * name.endswith(".jsonl")  # the trials so far
