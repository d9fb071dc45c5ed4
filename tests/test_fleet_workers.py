"""Workers that end while they wait, that don't start, and that can't be started."""

from __future__ import annotations

import os
import pickle
import signal
from pathlib import Path

from mcaptrack import fleet
from mcaptrack.fleet import child
from mcaptrack.fleet.child import Child, WorkerLimits
from mcaptrack.fleet.worker import Reply, Request
from tests import fleet_tasks

#: A worker that answers each request in the same way, without the packages that others import.
LIGHT = """
import json, os, sys
from multiprocessing.connection import Connection
connection = Connection(json.loads(sys.argv[1])[0])
connection.send(None)
while True:
    connection.recv_bytes()
    connection.send_bytes(bytes.fromhex({!r}))
"""


def test_a_worker_that_was_ended_while_it_waited_is_replaced(monkeypatch):
    """The system may end it for its memory. That was a broken pipe, which ended the whole command."""
    answer = pickle.dumps(Reply("done", seconds=7.0)).hex()
    monkeypatch.setattr(child, "_CODE", LIGHT.format(answer))
    worker, request = Child(WorkerLimits()), Request(Path("a.mcap"), b"", {})
    try:
        for number in range(3):
            assert worker.do(request, lambda: False) == Reply("done", seconds=7.0), number
            process = worker._process
            assert process is not None
            os.kill(process.pid, signal.SIGKILL)
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    finally:
        worker.close(0.0)


def test_a_worker_that_does_not_start_is_named_as_that(monkeypatch):
    """Not as a log that took long."""
    monkeypatch.setattr(child, "_CODE", "import signal; signal.pause()")
    monkeypatch.setattr(child, "_START_S", 0.3)
    monkeypatch.setattr(child, "_GRACE_S", 0.2)
    worker = Child(WorkerLimits(timeout_s=3600))
    try:
        reply = worker.do(Request(Path("a.mcap"), b"", {}), lambda: False)
    finally:
        worker.close(0.0)
    assert reply.state == "timed-out"
    assert reply.error == (
        "a.mcap: its worker process did not start within 0.3 s (the machine may be too busy), and was ended"
    )


def test_logs_are_named_where_workers_cannot_be_started(tmp_path, monkeypatch):
    def no_folder(*_: object, **__: object) -> None:
        raise FileNotFoundError(2, "No usable temporary directory found in ['/tmp']")

    (tmp_path / "a.mcap").touch()
    monkeypatch.setattr("mcaptrack.fleet.child.tempfile.TemporaryFile", no_folder)
    done = fleet.run(fleet_tasks.touch, tmp_path)
    assert [(one.state, one.error) for one in done.failed] == [
        (
            "failed",
            f"{tmp_path}/a.mcap: no worker process can be started (No usable temporary directory found in ['/tmp'])",
        )
    ]
