"""Shared parts of all commands: options, notes and progress on stderr, JSON on stdout, errors in one line."""

from __future__ import annotations

import inspect
import io
import json
import logging
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import partial, wraps
from pathlib import Path
from time import monotonic
from typing import Any, Final, NamedTuple, ParamSpec

import typer

from mcaptrack import SCHEMA_VERSION, notices
from mcaptrack.cli.command import check_ranges, is_on_command_line
from mcaptrack.cli.text import Level, is_json, say, with_flags
from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish_bytes, refuse_overwrite, refuse_special, refuse_url
from mcaptrack.location import Location, is_remote, parse
from mcaptrack.notices import Notice
from mcaptrack.streams import LostOutputError

__all__ = ["Talk", "expand", "print_json"]

P = ParamSpec("P")


class Failed(NamedTuple):
    """An input that could not be processed, why, and the state that this left it in, as ``fleet.LogOutcome`` has it."""

    input: str
    error: str
    state: str = "failed"


@dataclass
class _Batch:
    """The number of inputs that the running command has tried, and those that failed."""

    tried: int = 0
    failed: list[Failed] = field(default_factory=list)
    is_early: bool = False


#: A warning of a parameter that has no effect.
_UNUSED: Final = re.compile(r"`(\w+)=` ")
#: The warnings of the running command, and its inputs.
_WARNED: Final[ContextVar[list[Notice]]] = ContextVar("warned")
_BATCH: Final[ContextVar[_Batch]] = ContextVar("batch")
#: Seconds between two lines about progress, with ``--log-format json``.
PROGRESS_S: Final = 5.0

DONE, REFUSED, LOST, GATE_MISSED = 0, 1, 3, 4


class Talk:
    """Prints notes and progress to stderr: progress on a terminal only; with ``quiet`` only warnings."""

    def __init__(self, quiet: bool, verbose: bool = False) -> None:
        self.quiet: bool = quiet
        self.verbose: bool = verbose
        self._bar: Any = None
        self._tasks: dict[str, Any] = {}
        self._shown = 0.0

    def say(self, line: str, level: Level = "info", event: str = "", **about: Any) -> None:
        """Print a line to stderr; see ``text.say``."""
        if not self.quiet:
            self.clear()
            say(line, level, event, **about)

    def detail(self, line: str) -> None:
        """Print a line to stderr with --verbose."""
        if self.verbose:
            self.say(line, "debug")

    def event(self, line: str, event: str, **about: Any) -> None:
        """Print a line that is for programs: with ``--log-format json`` only."""
        if is_json():
            self.say(line, "info", event, **about)

    def _hear(self, notice: Notice) -> None:
        self.clear()
        _show_warning(notice)

    def progress(self, stage: str, done: float, total: float | None) -> None:
        """Show the progress of a stage."""
        now = monotonic()
        if is_json():
            if now - self._shown >= PROGRESS_S:
                self._shown = now
                text = f"{stage}: {done:g}" + (f" of {total:g}" if total is not None else "")
                self.event(text, "progress", stage=stage, done=done, total=total)
            return
        if total is None or self.quiet or not sys.stderr.isatty():
            return
        if now - self._shown < 0.1 and done < total:
            return
        self._shown = now
        if self._bar is None:
            self._start()
        if stage not in self._tasks:
            self._tasks[stage] = self._bar.add_task(stage, total=total)
        self._bar.update(self._tasks[stage], completed=done, total=total)

    def _start(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description:>8}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
        self._bar.start()

    def clear(self) -> None:
        """Remove the bar of progress from the terminal: something is printed, or all is done."""
        if self._bar is not None:
            self._bar.stop()
            self._bar, self._tasks = None, {}

    @contextmanager
    def open(self) -> Iterator[Talk]:
        """Print warnings and notes of the library within this block, and restore the terminal after it."""
        with notices.listening(self._hear), _printing_notes(self):
            try:
                yield self
            finally:
                self.clear()


class _Printer(logging.Handler):
    """Prints the notes that the library logs, and with --verbose its details."""

    def __init__(self, talk: Talk) -> None:
        super().__init__()
        self._talk = talk

    def emit(self, record: logging.LogRecord) -> None:
        """Print one record."""
        (self._talk.say if record.levelno >= logging.INFO else self._talk.detail)(record.getMessage())


@contextmanager
def _printing_notes(talk: Talk) -> Iterator[None]:
    logger, printer = logging.getLogger("mcaptrack"), _Printer(talk)
    level = logger.level
    logger.addHandler(printer)
    logger.setLevel(logging.DEBUG)
    try:
        yield
    finally:
        logger.removeHandler(printer)
        logger.setLevel(level)


# Which inputs a command line names. URLs, pipes and devices are refused before a command opens anything.


#: Arguments that name logs, which may be in a store.
_LOGS: Final = ("logs", "path", "inputs")


def check_paths(values: Mapping[str, Any]) -> None:
    """Raise McaptrackError if a path among the values of a command's options is a URL, a pipe or a device.

    Logs may be URLs of objects in a store.
    """
    for name, value in values.items():
        for path in value if isinstance(value, list | tuple) else [value]:
            if isinstance(path, Path):
                if name not in _LOGS or not is_remote(parse(path)):
                    refuse_url(path)
                refuse_special(path)


def expand(paths: Sequence[Path], *, each: bool = False, folders: bool = False) -> list[Location]:
    """Return the inputs that arguments name; see ``fleet.expansion.find_inputs``.

    ``paths`` are those arguments, ``each`` and ``folders`` as there.
    """
    from mcaptrack.fleet.expansion import find_inputs

    return [found_log.path for found_log in find_inputs(paths, each=each, folders=folders)]


def only_one_output(paths: Sequence[Location], output: Path | None) -> None:
    """Raise McaptrackError if several inputs would be written to one output."""
    if output is not None and len(paths) > 1:
        raise McaptrackError(
            f"{len(paths)} inputs can't all be written to {output}; name a folder for their results, or leave it out"
        )


def one_line(command: Callable[P, None]) -> Callable[P, None]:
    """Wrap a command: print a McaptrackError as one line, exit with 1; print warnings, and keep them for the JSON."""

    @wraps(command)
    def guarded(*args: P.args, **kwargs: P.kwargs) -> None:
        _WARNED.set([])
        batch = _Batch()
        _BATCH.set(batch)
        try:
            check_paths(kwargs)
            check_ranges(kwargs)
            with notices.listening(_show_warning):
                command(*args, **kwargs)
        except (McaptrackError, LostOutputError) as error:
            say(str(error).strip(), "error")
            raise typer.Exit(REFUSED) from None
        except typer.Exit:
            if not batch.failed and not batch.is_early:
                raise
        except Exception as error:
            if not is_json() or isinstance(error, BrokenPipeError):
                raise
            last = traceback.format_exception_only(error)[-1].strip()
            say(f"a fault of the program: {last}", "error", traceback=traceback.format_exc())
            raise typer.Exit(REFUSED) from None
        if batch.failed:
            names = ", ".join(failure.input for failure in batch.failed)
            say(f"{len(batch.failed)} of {batch.tried} failed: {names}", "error", failed=len(batch.failed))
        if batch.failed or batch.is_early:
            raise typer.Exit(LOST)

    return guarded


def tried(inputs: int) -> None:
    """Add to the number of inputs that the running command has tried."""
    _BATCH.get().tried += inputs


def end_early(reason: str) -> None:
    """Say why some inputs were not tried; the command ends with exit code 3."""
    say(reason, "error")
    _BATCH.get().is_early = True


def record_failure(path: Location, error: str, state: str = "failed", **about: Any) -> None:
    """Print why one of several inputs failed, and keep it for the JSON and the end of the command.

    ``about`` is what else ``--log-format json`` prints.
    """
    message = error.strip()
    message = message if str(path) in message else f"{path}: {message}"
    say(message, "error", "log", **({"log": str(path), "state": state} | about))
    _BATCH.get().failed.append(Failed(str(path), with_flags(message), state))


def with_progress(function: Callable[..., Any], progress: Any) -> Callable[..., Any]:
    """Return a function with its parameter ``progress`` given, if it has one."""
    return partial(function, progress=progress) if "progress" in inspect.signature(function).parameters else function


def _show_warning(notice: Notice) -> None:
    """Print a warning to stderr, unless it was printed before."""
    unused = _UNUSED.match(notice.message) if notice.code == "option-not-used" else None
    if unused:
        if not is_on_command_line(unused[1]):
            return  # a file or the environment sets it, for the commands in which it has an effect
        notice = notice._replace(log=None)
    warned = _WARNED.get()
    notice = notice._replace(message=with_flags(notice.message))
    if notice not in warned:
        warned.append(notice)
        say(str(notice), "warning", code=notice.code, log=notice.log)


@contextmanager
def printed_to(output: Path | None, force: bool) -> Iterator[None]:
    """Write to ``output``, if it is given, what the block prints to stdout."""
    if output is None:
        yield
        return
    refuse_overwrite(output, force)
    with redirect_stdout(io.StringIO()) as text:
        yield
    publish_bytes(output, text.getvalue().encode("utf-8"))


def print_json(data: dict[str, Any]) -> None:
    """Print a JSON object to stdout, with the version of the schema, the inputs that failed and all warnings.

    The output is flushed, so that other programs get it while this one continues, as ``view`` does.

    ``data`` is that object, with values of JSON.
    """
    added = {
        "failed": [failure._asdict() for failure in _BATCH.get().failed],
        "warnings": [warning._asdict() for warning in _WARNED.get()],
    }
    whole = {"schema_version": SCHEMA_VERSION} | data | added
    print(json.dumps(whole, indent=2, allow_nan=False), flush=True)
