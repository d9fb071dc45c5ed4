"""A Dask cluster for tests: a scheduler and two workers, each in a process of its own, on ports of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

#: A log is set aside as soon as one worker has died with it; no process reports to others.
_SETTINGS = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0", "DASK_DISTRIBUTED__ADMIN__LOW_LEVEL_LOG_LENGTH": "0"}


class Running(NamedTuple):
    address: str
    process: subprocess.Popen[bytes]


@contextmanager
def cluster(folder: Path) -> Iterator[Running]:
    file = folder / "scheduler.json"
    scheduler = _start("scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", file)
    workers = []
    try:
        while not file.exists() or not file.read_text():
            time.sleep(0.05)
        address = json.loads(file.read_text())["address"]
        words = ("--no-nanny", "--nthreads", "1", "--local-directory", folder)
        workers += [_start("worker", address, *words) for _ in range(2)]
        yield Running(address, scheduler)
    finally:
        for process in (scheduler, *workers):
            process.kill()
            process.wait()


def _start(program: str, *words: object) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", f"distributed.cli.dask_{program}", *map(str, words), "--no-dashboard"]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, env={**os.environ, **_SETTINGS}, stdout=quiet, stderr=quiet)
