"""Commands that take many logs: their options, one worker process a log at a time, and a summary at the end."""

from __future__ import annotations

import re
import signal
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Generic, TypeVar

import typer

from mcaptrack import notices
from mcaptrack.api.declared import Option, Parameter
from mcaptrack.api.options import PathLike
from mcaptrack.cli import common
from mcaptrack.cli.declared import Called, parameters_of
from mcaptrack.cli.help import LAST_PANELS
from mcaptrack.cli.text import counted, is_json, say, stdout_to_stderr
from mcaptrack.environment import variable, whole_number
from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location

if TYPE_CHECKING:
    from mcaptrack.fleet import FleetResult, FleetStatus, LogOutcome, NamedLog

T = TypeVar("T")
#: Heading of the options in the help.
PANEL: Final = LAST_PANELS[1]
_TIME: Final = re.compile(r"([0-9]+(?:\.[0-9]+)?)\s*([smh]?)")
_SECONDS: Final = {"": 1, "s": 1, "m": 60, "h": 3600}
_MB: Final = 1_000_000
#: The number of logs from which on the summary repeats why logs failed.
_REPEATED: Final = 20


@dataclass(frozen=True)
class ManyOptions:
    """The options for many logs."""

    jobs: Annotated[
        int | None,
        Option(
            PANEL,
            1,
            1024,
            help="Number of logs to process at the same time; by default 1, or one for each thread of a cluster.",
        ),
    ] = None
    ledger: Annotated[
        PathLike | None,
        Option(
            PANEL,
            metavar="FILE",
            help="Add a line of JSON to this file for each log and try, and skip logs that it says are done; by "
            "default none.",
        ),
    ] = None
    timeout: Annotated[
        str | None,
        Option(PANEL, metavar="TIME", help="Give a log up after this time, such as 90s, 10m or 2h; by default none."),
    ] = None

    @property
    def concern_one(self) -> bool:
        """Whether an option is set for which a single log, too, has to be processed by workers."""
        return any((variable("MCAPTRACK_SCHEDULER"), self.ledger, self.timeout))

    def for_fleet(self) -> dict[str, Any]:
        """Return the arguments of ``mcaptrack.fleet.run``. Raises McaptrackError for a time that is none."""
        return {
            "jobs": self.jobs,
            "scheduler": variable("MCAPTRACK_SCHEDULER") or None,
            "ledger": self.ledger,
            "timeout_s": _seconds(self.timeout),
            "memory_limit": _MB * whole_number("MCAPTRACK_MAX_WORKER_MB", 0) or None,
        }


NAMES: Final = tuple(field.name for field in fields(ManyOptions))
#: Commands that take long on many logs; the others have no ledger and no time limit (`mcaptrack.fleet.run` has).
_OF_FLEETS: Final = ("run", "ingest", "detect", "retrack", "export")


class EachLog(Called[T]):
    """A command that calls its function with each log, here or in workers: ``function(log, output=..., **arguments)``.

    ``many`` has the options for many logs, and ``inputs`` are the logs, once the command runs.
    """

    #: Whether logs, or files beside them, are changed.
    writes: ClassVar[bool] = True
    #: Whether results are what is printed to stdout: one after the other, in the order of the logs.
    prints_results: ClassVar[bool] = False
    #: Whether all logs have one output, a folder.
    shares_output = False
    #: Whether the output of a log is a folder itself.
    makes_folders = False
    #: Whether each input always has an output of its own, by default in the working folder.
    names_output = False

    def __init__(self, name: str, values: Mapping[str, Any]) -> None:
        super().__init__(name, values)
        self.inputs: Sequence[NamedLog] = ()
        self.many: ManyOptions = ManyOptions(**{option: values[option] for option in NAMES if option in values})

    @classmethod
    def options(cls, name: str) -> list[Parameter]:
        """Return the options that the function has no use for: also those for many logs."""
        own = NAMES if name in _OF_FLEETS else ("jobs",)
        return [*super().options(name), *(option for option in parameters_of(ManyOptions) if option.name in own)]

    def logs(self) -> Sequence[NamedLog]:
        """Return the inputs."""
        from mcaptrack.fleet import find_logs

        return find_logs(self.values["logs"])

    def suffix(self) -> str:
        """Return the end of the names of outputs in a folder."""
        return ".mcap"

    def line(self, done: T) -> str:
        """Return a result as a line of text."""
        raise NotImplementedError

    def show(self, log: Location, done: T, talk: common.Talk) -> None:
        """Print the result of one log alone."""
        talk.say(f"{log}: {self.line(done)}")

    def print_result(self, results: Sequence[T], totals: Mapping[str, Any]) -> None:
        """Print the results of all logs, with totals if there are several: as JSON."""
        if self.values["json"]:
            common.print_json({"results": [self.data(done) for done in results], **totals})

    def code(self, results: Sequence[T]) -> int:
        """Return the exit code."""
        return common.DONE

    def folder(self, output: Path | None) -> Path | None:
        """Return an output that is a folder, in which the result of each log gets the name of the log; None for a file.

        A name without an ending is one of a folder, but for what is a folder itself.
        """
        if output is None or self.shares_output:
            return None
        is_itself = self.makes_folders and len(self.inputs) == 1
        is_folder = not is_itself and (output.is_dir() or not output.suffix)
        return output if is_folder else None

    def run(self, names: Mapping[str, str]) -> None:
        """Call the function with each log and its ``arguments``, and print what it returns."""
        with self.printed():
            with common.Talk(self.values["quiet"], self.values["verbose"]).open() as talk:
                self.inputs = self.logs()
                arguments = self.arguments(names)
                results, totals = self._process(self.inputs, arguments, arguments.pop("output", None), talk)
            self.print_result(results, totals)
        if code := self.code(results):
            raise typer.Exit(code)

    def _process(
        self, logs: Sequence[NamedLog], arguments: Mapping[str, Any], output: Path | None, talk: common.Talk
    ) -> tuple[list[T], dict[str, Any]]:
        """Process one log here, or several in workers. Returns the results, and totals for the JSON of several.

        ``output`` is that of a single log. An error in one of several logs is printed and does not stop the others; the
        command ends with exit code 3 then.
        """
        options = dict(arguments)
        if not logs:
            talk.say("the list of logs is empty; there is nothing to do")
            return [], {}
        folder = self.folder(output)
        if output is not None and folder is None:
            options["output"] = output
            if not self.shares_output:
                common.only_one_output([log.path for log in logs], output)
        if len(logs) == 1 and folder is None and not self.many.concern_one:
            with notices.about(output or logs[0].path):
                return [self._process_here(logs[0].path, options, talk)], {}
        if folder is None and output is None and self.names_output:
            folder = Path()
        done = self._process_in_workers(logs, options, folder, talk)
        _summarise(done, talk)
        return [done.results[log.path] for log in logs if log.path in done.results], {"fleet": done.to_json()}

    def _process_here(self, path: Location, options: Mapping[str, Any], talk: common.Talk) -> T:
        with stdout_to_stderr():
            result: T = common.with_progress(self.function, talk.progress)(path, **options)
        talk.clear()
        self.show(path, result, talk)
        state = "up-to-date" if getattr(result, "is_up_to_date", False) else "done"
        talk.event(f"{path}: {state}", "log", log=str(path), state=state)
        return result

    def _process_in_workers(
        self, logs: Sequence[NamedLog], options: Mapping[str, Any], folder: PathLike | None, talk: common.Talk
    ) -> FleetResult[T]:
        from mcaptrack.fleet import run as run_fleet

        listener: _Printer[T] = _Printer(self, talk, [log.path for log in logs])
        try:
            return run_fleet(
                self.function,
                logs,
                options,
                name=self.name,
                output_dir=folder,
                suffix=self.suffix(),
                writes=self.writes,
                on_outcome=listener.hear,
                on_status=listener.watch,
                on_note=talk.say,
                **self.many.for_fleet(),
            )
        except (KeyboardInterrupt, SystemExit) as ended:
            if isinstance(ended, KeyboardInterrupt) or ended.code == 128 + signal.SIGTERM:
                talk.say(
                    f"ended by a signal: {listener.ended} of {len(logs)} logs were processed; the same command goes on"
                )
            raise


class _Printer(Generic[T]):
    """Prints the outcomes of logs; results for stdout in the order of the logs."""

    def __init__(self, work: EachLog[T], talk: common.Talk, logs: Sequence[Location]) -> None:
        self._work, self._talk = work, talk
        self._shown = monotonic()
        self.ended = 0
        self._next = deque(logs)
        self._waiting: dict[Location, T | None] = {}

    def hear(self, outcome: LogOutcome[T]) -> None:
        """Print what became of a log."""
        self.ended += 1
        for line in outcome.printed.splitlines():
            self._talk.say(f"{outcome.log}: {line}")
        for notice in outcome.warnings:
            with notices.about(notice.log or outcome.log):
                notices.warn(notice.message, notice.code)
        if outcome.state == "skipped":
            self._talk.detail(f"{outcome.log}: done before, as the ledger says")
        elif outcome.result is None:
            for line in outcome.detail.splitlines():
                self._talk.detail(line)
            common.record_failure(outcome.log, outcome.error, **_about(outcome))
        if self._work.prints_results:
            self._show_in_order(outcome)
        elif outcome.result is not None and self._talk.verbose:
            self._work.show(outcome.log, outcome.result, self._talk)
        elif outcome.result is not None:
            summary = self._work.line(outcome.result)
            self._talk.say(f"{outcome.log}: {summary}", "info", "log", **_about(outcome))

    def watch(self, status: FleetStatus) -> None:
        """Show how far the logs are: in a bar, or now and then in a line for programs."""
        ended = status.logs - status.left
        if not is_json():
            if not self._work.prints_results:
                self._talk.progress("logs", ended, status.logs)
        elif monotonic() - self._shown >= common.PROGRESS_S:
            self._shown = monotonic()
            running = [{**asdict(log), "log": str(log.log), "seconds": round(log.seconds, 1)} for log in status.running]
            text = f"{ended} of {status.logs} logs"
            self._talk.event(
                text, "progress", done=ended, total=status.logs, states=dict(status.ended), running=running
            )

    def _show_in_order(self, outcome: LogOutcome[T]) -> None:
        self._waiting[outcome.log] = outcome.result
        while self._next and self._next[0] in self._waiting:
            log = self._next.popleft()
            result = self._waiting.pop(log)
            if result is not None:
                self._work.show(log, result, self._talk)


def _about(outcome: LogOutcome[Any]) -> dict[str, Any]:
    """Return the outcome of a log as values of JSON, without what it made."""
    return {
        "log": str(outcome.log),
        "state": outcome.state,
        "tries": outcome.tries,
        "seconds": outcome.seconds,
        "cpu_seconds": outcome.cpu_seconds,
        "peak_bytes": outcome.peak_bytes,
    }


def _summarise(done: FleetResult[Any], talk: common.Talk) -> None:
    """Print the totals, and with many logs once more why some failed."""
    common.tried(len(done.outcomes))
    counts = [f"{count} {state}" for state, count in done.counts.items()]
    rate = len(done.outcomes) / max(done.seconds, 1e-3)
    count = len(done.outcomes)
    line = f"{counted(count, 'log')} in {done.seconds:.1f} s ({rate:.1f} a second): {', '.join(counts)}"
    if done.peak_bytes:
        ran = [outcome for outcome in done.outcomes if outcome.tries]
        used = done.cpu_seconds / max(1, len(ran))
        line += f"; at most {done.peak_bytes / 1e6:,.0f} MB of memory, {used:.2f} s of processor time a log"
    talk.say(line, "info", "summary", **done.to_json())
    if len(done.outcomes) >= _REPEATED:
        for outcome in done.failed:
            say(f"  {outcome.state}: {outcome.error}", "info", "log", **_about(outcome))
    if done.stopped:
        left = done.counts.get("not-tried", 0)
        common.end_early(f"{done.stopped}; {left} of {len(done.outcomes)} logs are left, and the same command goes on")


def _seconds(text: str | None) -> float | None:
    """Return a time such as 90s, 10m or 2h in seconds; None for None."""
    if text is None:
        return None
    match = _TIME.fullmatch(text.strip().lower())
    if match is None or not float(match[1]):
        raise McaptrackError(f"--timeout needs a time such as 90s, 10m or 2h, not {text!r:.40}")
    return float(match[1]) * _SECONDS[match[2]]
