"""Run one function of the library on many logs: in worker processes on this machine, or on a Dask cluster.

``run`` does what the command line does with many logs: one log never takes the others down, a second call does only
what is missing, and several calls can share a folder of logs.
"""

from __future__ import annotations

import inspect
import os
import pickle
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Event, Lock, local
from time import monotonic
from typing import Any, Final, Generic, Protocol, TypeVar

from mcaptrack import __version__
from mcaptrack.api.declared import checked
from mcaptrack.errors import McaptrackError, did_you_mean, list_names
from mcaptrack.files import make_folder, place_of
from mcaptrack.fleet import ledger
from mcaptrack.fleet.expansion import NamedLog, find_logs, outputs_in
from mcaptrack.fleet.ledger import Claims, Ledger, digest_of_log, digest_of_settings
from mcaptrack.fleet.results import AGAIN, GOOD, FleetResult, FleetStatus, LogOutcome, Running, Watch
from mcaptrack.fleet.worker import Child, Reply, Request, StoppedError, WorkerLimits, memory_in_bytes
from mcaptrack.location import Location, Url
from mcaptrack.notices import Progress, Say
from mcaptrack.registry import find

T = TypeVar("T")

__all__ = ["FleetResult", "FleetStatus", "LogOutcome", "NamedLog", "Running", "find_logs", "run"]


# Run a function on many logs: which log is next, what became of it, and what has to be tried again.


#: Seconds between two looks at everything, and at logs that another fleet works on.
_TICK_S: Final = 0.25
_WAIT_S: Final = 1.0
#: Seconds that workers get to end in order.
_GRACE_S: Final = 3.0


class Crew(Protocol):
    """Processes logs: in processes of this machine, or, made by an extension, elsewhere.

    ``lost`` says why no log can be processed any more, and ``stop`` ends all work within that time.
    """

    @property
    def places(self) -> int:
        """The number of logs that it can be busy with."""
        ...

    def start(self, request: Request, then: Callable[[Future[Reply]], None]) -> None: ...

    def running(self) -> tuple[Running, ...]: ...

    def lost(self) -> str: ...

    def stop(self, grace_s: float) -> None: ...


@dataclass
class QueuedLog:
    """A log to process: its place among all, what differs from other logs, and how often it was tried."""

    number: int
    log: Location
    location: str
    own: dict[str, Any]
    claims_in: Path | None
    tries: int = 0
    wait_until: float = 0.0


class Fleet(Generic[T]):
    """Runs one function on many logs."""

    def __init__(
        self,
        function: Callable[..., T],
        options: Mapping[str, Any],
        logs: Sequence[QueuedLog],
        crew: Crew,
        ledger: Ledger | None,
        tries: int,
        keep_going: bool,
        hear: Callable[[LogOutcome[T]], None],
        watch: Watch,
        say: Say,
    ) -> None:
        self._task = task_of(function, options)
        self._crew, self._ledger, self._claims = crew, ledger, Claims()
        self._most_tries, self._keep_going = tries, keep_going
        self._hear, self._watch, self._say = hear, watch, say
        self._logs = logs
        self._left = deque(logs)
        self._busy: dict[int, QueuedLog] = {}
        self._replies: SimpleQueue[tuple[QueuedLog, Future[Reply]]] = SimpleQueue()
        self._outcomes: dict[int, LogOutcome[T]] = {}
        self._stopped = ""
        self._began = monotonic()

    def run(self) -> FleetResult[T]:
        """Process all logs. An exception (Ctrl-C) ends the workers first, and gives all claims up."""
        try:
            self._tidy()
            while (self._left or self._busy) and not self._stopped:
                self._fill()
                self._receive()
                self._claims.beat()
                self._stopped = self._stopped or self._crew.lost()
                self._watch(self._status())
        finally:
            try:
                self._crew.stop(_GRACE_S)
            except KeyboardInterrupt:
                self._crew.stop(0.0)
                raise
            finally:
                self._claims.release_all()
        for work in [*self._busy.values(), *self._left]:
            self._outcomes[work.number] = LogOutcome(work.log, "not-tried", error=self._stopped, tries=work.tries)
        outcomes = tuple(self._outcomes[work.number] for work in self._logs)
        return FleetResult(outcomes, round(monotonic() - self._began, 3), self._stopped)

    def _tidy(self) -> None:
        """Remove what fleets that were killed have left."""
        folders: dict[Path, set[str]] = {}
        for work in self._logs:
            if work.claims_in is not None:
                folders.setdefault(work.claims_in, set()).add(work.location)
        for folder, locations in folders.items():
            ledger.sweep(folder, locations)

    def _fill(self) -> None:
        """Give logs to free workers; those that another fleet works on are put off."""
        for _ in range(len(self._left)):
            if len(self._busy) >= self._crew.places:
                return
            work = self._left.popleft()
            if work.wait_until > monotonic():
                self._left.append(work)
                continue
            if not work.tries and not self._claim(work):
                continue
            work.tries += 1
            self._busy[work.number] = work
            request = Request(work.log, self._task, work.own)
            self._crew.start(request, lambda future, work=work: self._replies.put((work, future)))  # type: ignore[misc]

    def _claim(self, work: QueuedLog) -> bool:
        """Claim a log. Returns False if it is not to be processed now: it is done, or another fleet has it."""
        if self._is_done(work):
            return False
        taken = self._claims.take(work.location, work.claims_in)
        if not taken.is_mine:
            work.wait_until = monotonic() + _WAIT_S
            self._left.append(work)
            return False
        if taken.note:
            self._say(taken.note)
        if self._ledger is not None:
            self._ledger.refresh()  # another fleet may have finished it between the two looks
        if self._is_done(work):
            self._claims.release(work.location)
            return False
        return True

    def _is_done(self, work: QueuedLog) -> bool:
        """Whether the ledger says that a log is done; then it is skipped."""
        if self._ledger is None or not self._ledger.is_done(work.location, digest_of_log(work.log)):
            return False
        self._end(work, LogOutcome(work.log, "skipped"))
        return True

    def _receive(self) -> None:
        """Wait a moment for a log to end, and take all that have ended."""
        try:
            ended = [self._replies.get(timeout=_TICK_S)]
        except Empty:
            return
        while not self._replies.empty():
            ended.append(self._replies.get())
        for work, future in ended:
            if not self._stopped:
                self._take(work, future)

    def _take(self, work: QueuedLog, future: Future[Reply]) -> None:
        try:
            reply = future.result()
        except (CancelledError, StoppedError):
            if self._crew.lost():
                return
            reply = Reply(work.log, "killed", error=f"{work.log}: the cluster gave it up")
        del self._busy[work.number]
        used: dict[str, Any] = {name: getattr(reply, name) for name in ("seconds", "cpu_seconds", "peak_bytes")}
        if self._ledger is not None:
            self._ledger.append(
                location=work.location,
                state=reply.state,
                digest=reply.digest,
                attempt=work.tries,
                ended=datetime.now(UTC).isoformat(timespec="milliseconds"),
                **used,
                warnings=[{"code": warning.code, "message": warning.message} for warning in reply.warnings],
                error=reply.error or None,
                detail=reply.detail or None,
                outputs=[*([os.path.abspath(work.own["output"])] if "output" in work.own else []), *reply.files],
                version=__version__,
            )
        if reply.state in AGAIN and work.tries < self._most_tries:
            self._say(f"{reply.error}; it is tried again")
            self._left.append(work)
            return
        self._claims.release(work.location)
        error = reply.error
        if reply.state in AGAIN and work.tries > 1:
            error += f", {work.tries} times"
        result: T | None = pickle.loads(reply.result) if reply.result else None  # noqa: S301  # from our worker
        self._end(
            work,
            LogOutcome(
                work.log, reply.state, result, error, reply.detail, work.tries, **used,
                warnings=reply.warnings, printed=reply.printed,
            ),
        )  # fmt: skip
        if reply.state not in GOOD and not self._keep_going:
            self._stopped = f"{work.log} failed"

    def _end(self, work: QueuedLog, outcome: LogOutcome[T]) -> None:
        self._outcomes[work.number] = outcome
        self._hear(outcome)

    def _status(self) -> FleetStatus:
        ended = Counter(outcome.state for outcome in self._outcomes.values())
        return FleetStatus(len(self._logs), ended, self._crew.running(), monotonic() - self._began)


def task_of(function: Callable[..., Any], options: Mapping[str, Any]) -> bytes:
    """Return a function and its options as bytes for workers. Raises McaptrackError if they can't be sent."""
    try:
        task = pickle.dumps((function, dict(options)))
    except Exception as error:
        raise McaptrackError(f"{function!r:.80} and its options can't be sent to workers: {error}") from error
    if b"__main__" in task:
        raise McaptrackError(
            f"{function!r:.80} or one of its options is defined in the script itself, where workers can't import it; "
            "put it into a module"
        )
    return task


@checked
def run(
    function: Callable[..., T],
    logs: str | os.PathLike[str] | Iterable[str | os.PathLike[str] | NamedLog],
    options: Mapping[str, Any] | None = None,
    *,
    name: str = "",
    jobs: int | None = None,
    scheduler: str | None = None,
    output_dir: str | os.PathLike[str] | None = None,
    suffix: str = ".mcap",
    ledger: str | os.PathLike[str] | None = None,
    keep_going: bool = True,
    timeout_s: float | None = None,
    memory_limit: str | float | None = None,
    tries: int = 2,
    writes: bool = True,
    on_outcome: Callable[[LogOutcome[T]], None] | None = None,
    on_status: Watch | None = None,
    on_note: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> FleetResult[T]:
    """Run a function on many logs, each in a worker process that stays warm for the next one.

    A log that fails, kills its worker, hangs or takes too much memory is set aside and named; all others are processed.

    Parameters
    ----------
    function : callable
        Called as ``function(log, **options)``, such as ``mcaptrack.run``. Workers import it, so it can't be defined in
        the script itself.
    logs : path or iterable of path
        Logs, folders of logs, patterns, or "-" for a list of logs on standard input.
    options : mapping of str to object, optional
        Keywords of the function, the same for all logs.
    name : str, optional
        Name of the work in the ledger, by default that of the function.
    jobs : int, optional
        Number of logs to process at the same time, by default 1, or one for each thread of the cluster. Each worker
        process gets its share of the cores for its threads.
    scheduler : str, optional
        Address of a Dask scheduler, such as "tcp://host:8786"; its workers process the logs instead. They have to
        see the logs, and the working folder, under the same names.
    output_dir : path, optional
        Folder for the outputs: the function gets ``output=``, a name in this folder, for each log.
    suffix : str, default ".mcap"
        Ending of names in ``output_dir``.
    ledger : path, optional
        File to which a line of JSON is added for each log and try. Logs that it says are done, with the same options,
        and that have not changed since, are skipped.
    keep_going : bool, default True
        Whether to go on after a log that failed.
    timeout_s : float, optional
        Seconds after which a log is given up.
    memory_limit : str or float, optional
        Resident memory at which a worker is ended, such as "2GB", or in bytes. Address space that is reserved but not
        used doesn't count.
    tries : int, default 2
        How often a log is tried that kills its worker, or exceeds a limit. Other failures are not tried again.
    writes : bool, default True
        Whether the function changes logs or writes beside them; then each log is claimed by a small file there while it
        is processed, so that another fleet leaves it alone. A log in a store is claimed by a file beside the ledger,
        or in the working folder, so that only fleets that share it leave it alone.
    on_outcome, on_status, on_note : callable, optional
        Called with a ``LogOutcome`` when a log has ended, with a ``FleetStatus`` several times a second, and with a
        line of text when something is tried again or taken over.
    progress : callable, optional
        Called as ``progress("logs", done, total)``.

    Returns
    -------
    FleetResult
        The outcome of each log, and totals.

    Raises
    ------
    McaptrackError
        If there is no log, if an argument is wrong, or if the ledger can't be written.

    Examples
    --------
    >>> import mcaptrack
    >>> from mcaptrack import fleet
    >>> done = fleet.run(mcaptrack.check, ["log.mcap"], jobs=2)
    >>> done.counts
    {'done': 1}

    """
    for what, value, least in (("jobs", jobs, 1), ("tries", tries, 1), ("timeout_s", timeout_s, 0.001)):
        if value is not None and not least <= value < float("inf"):
            raise McaptrackError(f"`{what}=` has to be at least {least}, not {value}")
    named_logs = _named(logs)
    if not named_logs:
        raise McaptrackError("there are no logs to process")
    keywords, command = dict(options or {}), name or _name_of(function)
    _check_options(function, keywords, command, {"progress", *(["output"] if output_dir is not None else [])})
    folder = None if output_dir is None else Path(output_dir)
    settings = digest_of_settings(function, keywords, str(folder.absolute()) if folder else None)
    entries = None if ledger is None else Ledger(Path(ledger), command, settings)
    claims_in = folder or (None if ledger is None else Path(ledger).absolute().parent)
    work = []
    outputs = outputs_in(folder, named_logs, suffix) if folder is not None else []
    for number, named_log in enumerate(named_logs):
        own = {"output": outputs[number]} if outputs else {}
        place = _claimed_in(named_log.path, claims_in) if writes and folder is None else claims_in
        location = str(place_of(named_log.path))  # its name in ledgers and claims: without links
        work.append(QueuedLog(number, named_log.path, location, own, place))
    for output in outputs:
        make_folder(output.parent)
    limits = WorkerLimits(min(jobs or 1, len(named_logs)), os.getcwd(), timeout_s, memory_in_bytes(memory_limit))

    def watch(status: FleetStatus) -> None:
        if progress is not None:
            progress("logs", status.logs - status.left, status.logs)
        if on_status is not None:
            on_status(status)

    crew: Crew = Processes(limits) if scheduler is None else find("crew", "dask").cls(scheduler, limits, jobs)
    hear, say = on_outcome or (lambda _: None), on_note or (lambda _: None)
    return Fleet(function, keywords, work, crew, entries, tries, keep_going, hear, watch, say).run()


def _claimed_in(log: Location, otherwise: Path | None) -> Path | None:
    """Return the folder in which a log that is changed is claimed: its own, or another one if that can't be written."""
    if isinstance(log, Url):
        return otherwise or Path.cwd()
    return log.parent if os.access(log.parent, os.W_OK) else otherwise


# Worker processes on this machine: a thread for each, which waits for it.


class Processes:
    """Processes logs in workers of their own. ``places`` is how many it can be busy with."""

    def __init__(self, limits: WorkerLimits) -> None:
        self.places = limits.workers
        self._limits, self._stopping, self._lock = limits, Event(), Lock()
        self._threads = ThreadPoolExecutor(limits.workers, "mcaptrack-worker")
        self._own = local()
        self._children: list[Child] = []
        self._busy: dict[Location, tuple[Child, float]] = {}

    def start(self, request: Request, then: Callable[[Future[Reply]], None]) -> None:
        """Begin with a log; ``then`` is called in another thread when it has ended."""
        self._threads.submit(self._attempt, request).add_done_callback(then)

    def _attempt(self, request: Request) -> Reply:
        if not hasattr(self._own, "child"):
            try:
                self._own.child = Child(self._limits)
            except OSError as error:  # no folder for temporary files, or no room there
                text = f"{request.log}: no worker process can be started ({error.strerror or error})"
                return Reply(request.log, "failed", error=text)
            with self._lock:
                self._children.append(self._own.child)
        child: Child = self._own.child
        self._busy[request.log] = (child, monotonic())
        try:
            return child.do(request, self._stopping.is_set)
        finally:
            del self._busy[request.log]

    def running(self) -> tuple[Running, ...]:
        """Return the logs that workers are busy with."""
        now = monotonic()
        return tuple(
            Running(log, *child.progress, seconds=now - since, resident_bytes=child.resident)
            for log, (child, since) in list(self._busy.items())
        )

    def lost(self) -> str:
        """Return why no log can be processed any more; "" if all is well."""
        return ""

    def stop(self, grace_s: float) -> None:
        """End all workers, after ``grace_s`` seconds whatever they do."""
        self._stopping.set()
        if not grace_s:
            for child in self._children:
                child.end(0.0)
        self._threads.shutdown(wait=True, cancel_futures=True)
        for child in self._children:
            child.close(grace_s)


def _named(logs: Any) -> list[NamedLog]:
    if isinstance(logs, str | os.PathLike):
        return find_logs([logs])
    several = list(logs)
    return several if all(isinstance(log, NamedLog) for log in several) else find_logs(several)


def _check_options(function: Callable[..., Any], options: Mapping[str, Any], name: str, own: Collection[str]) -> None:
    """Raise McaptrackError for options that a function doesn't take, and for those that each log has of its ``own``."""
    try:
        parameters = inspect.signature(function).parameters
    except (TypeError, ValueError):  # a function that doesn't say what it takes
        return
    kinds = {name: parameter.kind for name, parameter in parameters.items()}
    log, *named = [name for name, kind in kinds.items() if kind is not inspect.Parameter.VAR_KEYWORD] or [""]
    takes_all = inspect.Parameter.VAR_KEYWORD in kinds.values()
    for key in options:
        if key in (log, *own):
            raise McaptrackError(f"{name}: each log has its own {key}; leave it out of the options")
        if key not in named and not (takes_all and isinstance(key, str)):
            close = did_you_mean(str(key), named)
            raise McaptrackError(f"{name} has no option {key!r:.60}; {close}it has {list_names(named)}")


def _name_of(function: Any) -> str:
    """Return the name of a function, also of one with some arguments given."""
    return str(getattr(getattr(function, "func", function), "__name__", type(function).__name__))
