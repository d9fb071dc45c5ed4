"""Commands on hostile input, each in a process of its own with bounds on its time and memory.

``python -m tests.bounded`` loads the command line once, then forks for each line of JSON on its stdin.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

#: Seconds of processor time, and bytes beyond what the loaded program takes.
CPU_S, MEMORY_BYTES = 5, 10**9


class Outcome(NamedTuple):
    """How a command ended: ``code`` is negative if a signal ended it."""

    code: int
    err: str
    cpu_s: float
    peak_bytes: int


@contextmanager
def commands() -> Iterator[Commands]:
    """A process that runs commands."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MCAPTRACK_")}
    environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.bounded"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
        cwd=Path(__file__).parent.parent,
    )
    try:
        yield Commands(process)
    finally:
        process.stdin.close()
        process.wait(timeout=60)
        process.stdout.close()


class Commands:
    def __init__(self, process: subprocess.Popen) -> None:
        self._process = process

    def run(self, *words: object) -> Outcome:
        """Run a command of mcaptrack within the bounds."""
        print(json.dumps([str(word) for word in words]), file=self._process.stdin, flush=True)
        return Outcome(*json.loads(self._process.stdout.readline()))


def on_disk(*folders: Path) -> dict[str, tuple[int, bytes]]:
    """All that lies in some folders: names, times and bytes."""
    found = (entry for folder in folders for entry in (folder, *folder.rglob("*")))
    return {str(entry): (entry.lstat().st_mtime_ns, entry.read_bytes() if entry.is_file() else b"") for entry in found}


def _serve(lines: Iterable[str]) -> None:
    from mcaptrack.__main__ import main
    from mcaptrack.cli import app  # noqa: F401
    from mcaptrack.ingest import database, ingest, plain_yaml, rosbag1, rosbag2  # noqa: F401

    for line in lines:
        with tempfile.TemporaryFile() as err:
            child = os.fork()
            if child == 0:
                _run(main, json.loads(line), err.fileno())
            _, status, used = os.wait4(child, 0)
            err.seek(0)
            words = err.read().decode("utf-8", "replace")
        outcome = Outcome(
            os.waitstatus_to_exitcode(status), words, used.ru_utime + used.ru_stime, used.ru_maxrss * 1024
        )
        print(json.dumps(outcome), flush=True)


def _run(main: object, words: list[str], err: int) -> None:
    """In the child: run the command and be gone."""
    code = 99
    try:
        with Path("/proc/self/statm").open() as stream:
            now = int(stream.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (now + MEMORY_BYTES,) * 2)
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S + 1))
        signal.alarm(60)  # for what waits without computing
        os.dup2(err, 2)
        os.dup2(os.open(os.devnull, os.O_RDWR), 1)
        os.dup2(1, 0)
        sys.argv = ["mcaptrack", *words]
        main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 98
    finally:
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    _serve(sys.stdin)
