"""The worker process of a fleet: it runs a function on one log after another, and stays warm between them.

It is a process of its own (not forked, so that no thread of OpenCV, Arrow or ONNX Runtime is cut off), which talks to
its parent through one socket. What a log may do to it is the parent's to notice: see ``child``.
"""

from __future__ import annotations

import faulthandler
import inspect
import os
import pickle
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic
from types import FrameType
from typing import Any, Final, NoReturn

from mcaptrack.environment import set_up_libraries
from mcaptrack.errors import McaptrackError, in_one_line
from mcaptrack.fleet.ledger import digest_of_log
from mcaptrack.fleet.results import LogOutcome, State
from mcaptrack.location import Location
from mcaptrack.notices import Notice, about, listening
from mcaptrack.processes import die_with

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
