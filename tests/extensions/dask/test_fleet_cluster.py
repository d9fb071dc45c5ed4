"""Logs on a Dask cluster: what one log does to its worker harms no other, and a lost scheduler is one line."""

from __future__ import annotations

import builtins
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from mcaptrack import fleet
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.dask import cluster
from mcaptrack.fleet.worker import WorkerLimits
from mcaptrack.testing import check_crew
from tests import fleet_tasks
from tests.extensions.dask import fleet_cluster
from tests.tiers import thorough

pytestmark = pytest.mark.usefixtures("never_waits")


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory) -> Iterator[fleet_cluster.Running]:
    with fleet_cluster.cluster(tmp_path_factory.mktemp("cluster")) as running:
        yield running


@thorough
def test_a_cluster_keeps_the_laws(scheduler):
    check_crew(cluster.Cluster(scheduler.address, WorkerLimits(), None))


@thorough
def test_a_cluster_does_what_processes_do_until_its_scheduler_is_lost(scheduler, tmp_path, monkeypatch):
    address, process = scheduler
    monkeypatch.chdir(tmp_path)
    words = {"a": "a", "b": "b", "die": "die", "orphan": "orphan", "refuse": "refuse", "warn": "warn"}
    for name, text in words.items():
        Path(f"{name}.mcap").write_text(text)
    given = {"scheduler": address, "ledger": "ledger.jsonl"}
    done = fleet.run(fleet_tasks.touch, ".", {"add": "+"}, tries=1, **given)
    # What a worker has done and not passed on when another log kills it is done again, and found up to date.
    states = {one.log.name: one.state.replace("up-to-date", "done") for one in done.outcomes}
    good = {f"{name}.mcap": "done" for name in ("a", "b", "warn")}
    killed = dict.fromkeys(("die.mcap", "orphan.mcap"), "killed")
    assert states == good | killed | {"refuse.mcap": "failed"}
    by_name = {one.log.stem: one.error for one in done.outcomes}
    assert by_name["orphan"] == "orphan.mcap: workers of the cluster died while they processed it"
    assert done.outcomes[-1].warnings[0].code == "clock"
    assert Path("a.mcap").read_text() == "a+"
    Path("hang.mcap").write_text("hang")
    late = fleet.run(fleet_tasks.touch, "hang.mcap", {"add": "+"}, timeout_s=2.0, tries=1, **given)
    assert [one.state for one in late.outcomes] == ["timed-out"]
    assert not list(Path().glob(".*"))

    talks = set()

    def lose(status: fleet.FleetStatus) -> None:
        loggers = [name for name in logging.root.manager.loggerDict if name.startswith(("distributed", "tornado"))]
        talks.update(name for name in loggers if logging.getLogger(name).isEnabledFor(logging.ERROR))
        if Path("hang.hangs").exists() and status.running:
            process.kill()

    Path("hang.hangs").unlink(missing_ok=True)
    for name in ("die", "orphan", "refuse"):
        Path(f"{name}.mcap").write_text("good")
    lost = fleet.run(fleet_tasks.touch, ".", {"add": "+"}, on_status=lose, **given)
    assert lost.stopped == f"the scheduler at {address} was lost"
    assert lost.counts["skipped"] >= 2
    assert talks == set()  # what is wrong is one line, and not Dask's
    assert lost.outcomes[3].state == "not-tried"
    assert not list(Path().glob(".*"))
    Path("hang.mcap").write_text("good")
    again = fleet.run(fleet_tasks.touch, ".", {"add": "+"}, ledger="ledger.jsonl")
    assert all(one.is_good for one in again.outcomes)
    assert Path("hang.mcap").read_text() == "good+"


@thorough
def test_what_is_wrong_is_one_line(monkeypatch, tmp_path):
    (tmp_path / "a.mcap").write_text("a")
    monkeypatch.setattr(cluster, "_ANSWER_S", 0.2)
    with pytest.raises(McaptrackError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9: "):
        fleet.run(fleet_tasks.touch, tmp_path, scheduler="tcp://127.0.0.1:9")
    with pytest.raises(McaptrackError, match="no Dask scheduler answers at nonsense"):
        fleet.run(fleet_tasks.touch, tmp_path, scheduler="nonsense://x")
    known = builtins.__import__

    def without(name, *more):
        if name == "distributed":
            raise ImportError(name)
        return known(name, *more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(McaptrackError, match=r"pip install 'mcaptrack\[fleet\]'"):
        fleet.run(fleet_tasks.touch, tmp_path, scheduler="tcp://127.0.0.1:9")
