"""Results of a fleet: the outcome of each log, and totals."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Generic, Literal, TypeVar

from mcaptrack.location import Location
from mcaptrack.notices import Notice

T = TypeVar("T")

State = Literal[
    "done", "up-to-date", "skipped", "failed", "killed", "timed-out", "out-of-memory", "interrupted", "not-tried"
]
#: States of logs that can be used: they were done now, had nothing to do, or were done before.
GOOD: Final = ("done", "up-to-date", "skipped")
#: States of logs that are tried again: the reason may lie outside the log.
AGAIN: Final = ("killed", "timed-out", "out-of-memory")


@dataclass(frozen=True)
class LogOutcome(Generic[T]):
    """The outcome of one log.

    Attributes
    ----------
    log : pathlib.Path or str
        The log, as it was named.
    state : str
        "done", "up-to-date" (there was nothing to do), "skipped" (done before, as the ledger says), "failed",
        "killed" (its worker died), "timed-out", "out-of-memory", "interrupted", or "not-tried".
    result : object or None
        What the function returned; None unless the log is done or up to date.
    error : str
        Why there is no result; one line.
    detail : str
        The traceback of a fault of the program, or the last lines that a killed worker printed.
    tries : int
        How often the log was tried.
    seconds, cpu_seconds : float
        How long the last try took, and how much processor time it used.
    peak_bytes : int
        Largest resident memory of the worker during the last try; 0 if it is not known.
    warnings : tuple of mcaptrack.Notice
        What was assumed, left out or looks odd.
    printed : str
        What plug-ins and libraries printed.

    """

    log: Location
    state: State
    result: T | None = None
    error: str = ""
    detail: str = ""
    tries: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_bytes: int = 0
    warnings: tuple[Notice, ...] = ()
    printed: str = ""

    @property
    def is_good(self) -> bool:
        """Whether the log is done, now or before."""
        return self.state in GOOD


@dataclass(frozen=True)
class FleetResult(Generic[T]):
    """The outcomes of many logs.

    Attributes
    ----------
    outcomes : tuple of LogOutcome
        One for each log, in the order of the logs.
    seconds : float
        How long it took.
    stopped : str
        Why it ended before all logs were tried; "" if all were.

    """

    outcomes: tuple[LogOutcome[T], ...]
    seconds: float
    stopped: str = ""

    @property
    def results(self) -> dict[Location, T]:
        """The results of the function, for logs that were done now."""
        return {outcome.log: outcome.result for outcome in self.outcomes if outcome.result is not None}

    @property
    def failed(self) -> tuple[LogOutcome[T], ...]:
        """The logs that were tried, and are not done."""
        return tuple(outcome for outcome in self.outcomes if not outcome.is_good and outcome.state != "not-tried")

    @property
    def counts(self) -> dict[str, int]:
        """Number of logs by state."""
        return dict(Counter(outcome.state for outcome in self.outcomes))

    @property
    def peak_bytes(self) -> int:
        """Largest resident memory of a worker."""
        return max((outcome.peak_bytes for outcome in self.outcomes), default=0)

    @property
    def cpu_seconds(self) -> float:
        """Processor time of all last tries."""
        return sum(outcome.cpu_seconds for outcome in self.outcomes)

    def to_json(self) -> dict[str, Any]:
        """Return the totals as values of JSON."""
        return {
            "logs": len(self.outcomes),
            **{state: self.counts.get(state, 0) for state in ("done", "up-to-date", "skipped")},
            "failed": len(self.failed),
            "not-tried": self.counts.get("not-tried", 0),
            "seconds": round(self.seconds, 3),
            "cpu_seconds": round(self.cpu_seconds, 3),
            "peak_bytes": self.peak_bytes,
            "stopped": self.stopped or None,
        }


@dataclass(frozen=True)
class Running:
    """A log that a worker is busy with: the stage, how much of it is done, since when, and its memory.

    ``done`` of ``total`` steps are done, None if it isn't known of how many; ``seconds`` have passed since the log
    began, and ``resident_bytes`` of memory are used.
    """

    log: Location
    stage: str = ""
    done: float = 0.0
    total: float | None = None
    seconds: float = 0.0
    resident_bytes: int = 0


@dataclass(frozen=True)
class FleetStatus:
    """The progress of a fleet: number of logs, by state of those that ended, and those that run.

    ``running`` are those that run now, and ``seconds`` have passed since it began.
    """

    logs: int
    ended: Mapping[State, int] = field(default_factory=dict)
    running: tuple[Running, ...] = ()
    seconds: float = 0.0

    @property
    def left(self) -> int:
        """Number of logs that didn't end yet."""
        return self.logs - sum(self.ended.values())


Watch = Callable[[FleetStatus], None]
