"""The worker process of a fleet: it runs a function on one log after another, and stays warm between them.

It is a process of its own (not forked, so that no thread of OpenCV, Arrow or ONNX Runtime is cut off), which talks to
its parent through one socket. What a log may do to it is the parent's to notice, which starts it when it is needed,
watches, ends and replaces it (``Child``).
"""

from __future__ import annotations

import faulthandler
import fcntl
import inspect
import json
import os
import pickle
import re
import resource
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic
from types import FrameType
from typing import IO, Any, Final, NoReturn

from mcaptrack.environment import THREADS, cores, set_up_libraries
from mcaptrack.errors import McaptrackError, in_one_line
from mcaptrack.fleet.ledger import digest_of_log
from mcaptrack.fleet.results import LogOutcome, State
from mcaptrack.location import Location
from mcaptrack.notices import Notice, about, listening
from mcaptrack.processes import die_with, resident_bytes_with_children

#: Seconds between two messages about progress.
_PROGRESS_S: Final = 0.2


@dataclass(frozen=True)
class Request:
    """One log to run a function on: the function with its options, pickled, and those that differ between logs."""

    log: Location
    task: bytes
    own: dict[str, Any]


@dataclass(frozen=True)
class Reply(LogOutcome[bytes]):
    """The outcome of one try; ``result`` is pickled; ``digest`` is that of the log afterwards.

    ``files`` are those beside the log that the function owes, by what its result says.
    """

    digest: str = ""
    files: tuple[str, ...] = ()


def do(request: Request, progress: Callable[[str, float, float | None], None]) -> Reply:
    """Run a function on a log. Faults become replies; only signals end this."""
    began, used, warnings = monotonic(), _cpu_seconds(), list[Notice]()
    _reset_peak()
    try:
        function, options = pickle.loads(request.task)  # noqa: S301  # from the parent
        with listening(warnings.append), about(request.own.get("output") or request.log):
            takes_progress = "progress" in inspect.signature(function).parameters
            taken = {"progress": progress} if takes_progress else {}
            result = function(request.log, **options, **request.own, **taken)
        state: State = "up-to-date" if getattr(result, "is_up_to_date", False) else "done"
        answer, digest = pickle.dumps(result), digest_of_log(request.log)
        # Files beside the log that the result names are owed: without them the log isn't done.
        files = tuple(os.path.abspath(file) for file in getattr(result, "files", ()) if isinstance(file, Path))
        reply = Reply(request.log, state, answer, digest=digest, files=files)
    except McaptrackError as error:
        reply = Reply(request.log, "failed", error=in_one_line(error))
    except MemoryError:
        reply = Reply(request.log, "out-of-memory", error=f"{request.log}: the memory of this machine is not enough")
    except Exception as error:
        last = " ".join(traceback.format_exception_only(error)[-1].split())
        text = f"{request.log}: {last}; this is a fault of the program, the ledger and -v have its traceback"
        reply = Reply(request.log, "failed", error=text, detail=traceback.format_exc())
    seconds, cpu = round(monotonic() - began, 3), round(_cpu_seconds() - used, 3)
    unique_warnings = tuple(dict.fromkeys(warnings))
    return replace(reply, seconds=seconds, cpu_seconds=cpu, peak_bytes=_peak_bytes(), warnings=unique_warnings)


def serve(handle: int, life: int) -> None:
    """Answer requests on a socket until the parent closes it or ends, which closes the socket ``life``, too."""
    connection: Connection[Any, Any] = Connection(handle)
    for number in (signal.SIGINT, getattr(signal, "SIGHUP", signal.SIGINT)):  # Windows has no SIGHUP
        signal.signal(number, signal.SIG_IGN)  # Ctrl-C and a closed terminal are for the parent, which ends its workers
    signal.signal(signal.SIGTERM, _end)
    faulthandler.enable(sys.stderr)
    set_up_libraries()
    die_with(life)
    sent = 0.0

    def progress(stage: str, done: float, total: float | None) -> None:
        nonlocal sent
        now = monotonic()
        if now - sent >= _PROGRESS_S:
            sent = now
            connection.send((stage, done, total))

    with suppress(EOFError, OSError):
        connection.send(None)  # ready
        while True:
            request = connection.recv()
            try:
                reply = do(request, progress)
            except SystemExit as ended:
                if _ENDING:
                    raise
                text = f"{request.log}: it ended its process with code {ended.code}"
                reply = Reply(request.log, "failed", error=text)
            sys.stdout.flush()
            sys.stderr.flush()
            connection.send(reply)


#: The signals that ended this worker.
_ENDING: Final[list[int]] = []


def _end(number: int, _: FrameType | None) -> NoReturn:
    """Unwind, so that what is half written is removed."""
    _ENDING.append(number)
    raise SystemExit(128 + number)


def _cpu_seconds() -> float:
    """Return the processor time of this process and of those that it waited for."""
    used = [resource.getrusage(which) for which in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def _reset_peak() -> None:
    """Let the peak of the resident memory begin again, where the system can (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_bytes() -> int:
    """Return the peak of the resident memory since ``_reset_peak``; elsewhere than on Linux since the start."""
    try:
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) * 1024
    except (OSError, IndexError, ValueError):
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most if sys.platform == "darwin" else most * 1024


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
