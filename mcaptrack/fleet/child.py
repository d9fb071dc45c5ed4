"""A worker process from the side of its parent: started when needed, watched, ended, and replaced."""

from __future__ import annotations

import fcntl
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing import Pipe
from time import monotonic
from typing import IO, Any, Final

from mcaptrack.environment import THREADS, cores
from mcaptrack.errors import McaptrackError
from mcaptrack.fleet.results import State
from mcaptrack.fleet.worker import Reply, Request
from mcaptrack.processes import resident_bytes_with_children

#: What a new process runs. Its path of modules is that of its parent, without the working folder of ``-c``.
_CODE: Final = (
    "import json, sys; *handles, sys.path[:] = json.loads(sys.argv[1]); "
    "from mcaptrack.fleet.worker import serve; serve(*handles)"
)
#: Seconds between two looks at a busy worker.
_LOOK_S: Final = 0.1
#: Seconds that a worker gets to start, and to end in order.
_START_S: Final = 120.0
_GRACE_S: Final = 3.0
#: The most that is kept of what a worker prints, in bytes.
_PRINTED: Final = 10_000


@dataclass(frozen=True)
class WorkerLimits:
    """Limits of each try (seconds, resident bytes); the number of workers on the machine, and their working folder."""

    workers: int = 1
    folder: str | None = None
    timeout_s: float | None = None
    memory_bytes: int | None = None


class StoppedError(Exception):
    """The fleet is being ended, and this try with it."""


# Limits of workers: their threads and their memory.


_SIZE: Final = re.compile(r"([0-9]+(?:\.[0-9]+)?)\s*([kmgt]?)(i?)b?", re.IGNORECASE)


def environment_of_worker(workers: int) -> dict[str, str]:
    """Return the environment of a worker: each of them gets its share of the cores, unless the user said otherwise."""
    share = str(max(1, cores() // workers))
    return dict.fromkeys(THREADS, share) | dict(os.environ)


def memory_in_bytes(size: str | float | None) -> int | None:
    """Return a limit of memory such as "2GB", "1.5 GiB" or a number of bytes; None for None.

    Raises McaptrackError for text that is no size, and for less than a megabyte.
    """
    if size is None:
        return None
    match, wrong = _SIZE.fullmatch(str(size).strip()), f"needs a size such as 2GB or 500MB, not {str(size)!r:.40}"
    if match is None:
        raise McaptrackError(f"`memory_limit=` {wrong}")
    number, unit, binary = match.groups()
    amount = int(float(number) * (1024 if binary else 1000) ** (" kmgt".index(unit.lower() or " ")))
    if amount < 1_000_000:
        raise McaptrackError(f"`memory_limit=` {wrong}: that is too little")
    return amount


class Child:
    """A worker process. It is started by the first request, and again after one that ended it."""

    def __init__(self, limits: WorkerLimits) -> None:
        self._limits = limits
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Any = None
        self._life: Any = None
        self._output: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115
        flags = fcntl.fcntl(self._output, fcntl.F_GETFL)
        fcntl.fcntl(self._output, fcntl.F_SETFL, flags | os.O_APPEND)  # what is printed starts at 0 again for each log
        self.progress: tuple[str, float, float | None] = ("", 0.0, None)
        self.resident = 0

    def do(self, request: Request, is_stopping: Callable[[], bool]) -> Reply:
        """Let the worker process a log. If the worker dies or exceeds a limit, the reply says so.

        Raises StoppedError when ``is_stopping`` returns true; the worker is ended then.
        """
        began = monotonic()
        self.progress, self.resident, peak = ("starting", 0.0, None), 0, 0
        self._output.truncate(0)
        if self._process is not None and not self._sent(request):
            self.end(grace_s=0.0)  # it was ended while it had nothing to do, which no log is to blame for
        is_started = self._process is not None
        if self._process is None:
            try:
                self._start()
            except OSError as error:
                reason = f"{request.log}: no worker process can be started in {self._limits.folder or '.'}"
                return Reply(request.log, "failed", error=f"{reason} ({error.strerror or error})")
            deadline = began + _START_S
        else:
            deadline = self._deadline()
        assert self._process is not None
        while True:
            if is_stopping():
                self.end()
                raise StoppedError
            try:
                message = self._connection.recv() if self._connection.poll(_LOOK_S) else self
                if message is None:
                    self._connection.send(request)
                    is_started, began, deadline = True, monotonic(), self._deadline()
            except (EOFError, OSError):
                return replace(self._died(request), seconds=monotonic() - began, peak_bytes=peak)
            if isinstance(message, Reply):
                return replace(message, printed=self._printed())
            if isinstance(message, tuple):
                self.progress = message
            self.resident = resident_bytes_with_children(self._process.pid)
            peak = max(peak, self.resident)
            if over := self._over(deadline, peak):
                state, reason = over
                if not is_started and state == "timed-out":
                    reason = f"its worker process did not start within {_START_S:g} s (the machine may be too busy)"
                self.end(grace_s=_GRACE_S if state == "timed-out" else 0.0)
                seconds = round(monotonic() - began, 3)
                reason = f"{request.log}: {reason}, and was ended"
                return Reply(request.log, state, error=reason, seconds=seconds, peak_bytes=peak, detail=self._printed())
            if self._process.poll() is not None and not self._connection.poll(0):
                return replace(self._died(request), seconds=monotonic() - began, peak_bytes=peak)

    def _sent(self, request: Request) -> bool:
        """Send a request to a worker that waits for one. Returns False if it has ended."""
        try:
            self._connection.send(request)
        except OSError:
            return False
        return self._process is not None and self._process.poll() is None

    def _over(self, deadline: float, peak: int) -> tuple[State, str] | None:
        """Return which limit the worker exceeds, and that in words."""
        if monotonic() > deadline:
            return "timed-out", f"took longer than {self._limits.timeout_s or _START_S:g} s"
        most = self._limits.memory_bytes
        if most is not None and self.resident > most:
            return "out-of-memory", f"took {peak / 1e6:,.0f} MB of memory, more than {most / 1e6:,.0f}"
        return None

    def _deadline(self) -> float:
        return float("inf") if self._limits.timeout_s is None else monotonic() + self._limits.timeout_s

    def _start(self) -> None:
        own, its = Pipe()
        life, its_life = Pipe()
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _CODE, json.dumps([its.fileno(), its_life.fileno(), sys.path])],
                stdin=subprocess.DEVNULL,
                stdout=self._output,
                stderr=self._output,
                cwd=self._limits.folder,
                env=environment_of_worker(self._limits.workers),
                pass_fds=[its.fileno(), its_life.fileno()],
                process_group=0,  # Ctrl-C at the terminal is for the parent alone
            )
        except BaseException:
            own.close()
            life.close()
            raise
        finally:
            its.close()
            its_life.close()
        self._connection, self._life = own, life

    def _died(self, request: Request) -> Reply:
        """Return the reply for a worker that ended before it replied."""
        assert self._process is not None
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_GRACE_S)
        code = self._process.poll()
        self.end(grace_s=0.0)
        how = "closed its connection" if code is None else f"exited with code {code}"
        if code is not None and code < 0:
            with suppress(ValueError):
                how = f"was killed by {signal.Signals(-code).name}"
        return Reply(request.log, "killed", error=f"{request.log}: the worker process {how}", detail=self._printed())

    def _printed(self) -> str:
        """Return the last of what the worker has printed since the request."""
        handle = self._output.fileno()
        size = os.fstat(handle).st_size
        text = os.pread(handle, _PRINTED, max(0, size - _PRINTED))
        return text.decode("utf-8", "replace").strip()

    def close(self, grace_s: float = _GRACE_S) -> None:
        """End the process for good."""
        self.end(grace_s)
        self._output.close()

    def end(self, grace_s: float = _GRACE_S) -> None:
        """End the process and those that it started; within ``grace_s`` seconds it may leave things in order."""
        process, self._process = self._process, None
        if process is None:
            return
        with suppress(OSError):
            self._connection.close()
        try:
            if grace_s:
                process.terminate()
                with suppress(subprocess.TimeoutExpired):
                    process.wait(grace_s)
        finally:
            with suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            self._life.close()
