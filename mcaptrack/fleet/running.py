"""Run a function on many logs: which log is next, what became of it, and what has to be tried again."""

from __future__ import annotations

import os
import pickle
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from queue import Empty, SimpleQueue
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

from mcaptrack import __version__
from mcaptrack.errors import McaptrackError
from mcaptrack.files import place_of
from mcaptrack.fleet import ledger
from mcaptrack.fleet.child import StoppedError
from mcaptrack.fleet.digests import digest_of_log
from mcaptrack.fleet.ledger import Claims, Ledger
from mcaptrack.fleet.results import AGAIN, GOOD, FleetResult, FleetStatus, LogOutcome, Watch
from mcaptrack.fleet.worker import Reply, Request
from mcaptrack.location import Location

if TYPE_CHECKING:
    from mcaptrack.fleet import Processes
    from mcaptrack.fleet.cluster import Cluster

T = TypeVar("T")
#: Seconds between two looks at everything, and at logs that another fleet works on.
_TICK_S: Final = 0.25
_WAIT_S: Final = 1.0
#: Seconds that workers get to end in order.
_GRACE_S: Final = 3.0


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
        crew: Processes | Cluster,
        ledger: Ledger | None,
        tries: int,
        keep_going: bool,
        hear: Callable[[LogOutcome[T]], None],
        watch: Watch,
        say: Callable[[str], None],
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
            reply = Reply("killed", error=f"{work.log}: the cluster gave it up")
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


def location_of(log: Location) -> str:
    """Return the name of a log in ledgers and claims: its path without links, or its URL."""
    return str(place_of(log))
