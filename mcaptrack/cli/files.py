"""``mcaptrack check``, ``recover``, ``drop`` and ``cut``: what they print about a log's bytes, and what was saved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from mcaptrack.cli import common
from mcaptrack.cli.declared import Once
from mcaptrack.cli.many import EachLog
from mcaptrack.cli.text import counted, print_table, refuse_usage, show
from mcaptrack.errors import command, list_names
from mcaptrack.location import Location, is_remote, parse

if TYPE_CHECKING:
    from mcaptrack import CutResult, DropResult, LogCheck, LogRecovery
    from mcaptrack.fleet import NamedLog
    from mcaptrack.log import CheckResult

#: The most losses of a log that are printed without -v.
_SHOWN: Final = 20
#: Ending of the names of logs that were saved.
_RECOVERED: Final = ".recovered.mcap"


class Check(EachLog["LogCheck"]):
    """Check logs; the findings are printed at the end."""

    writes = False

    def show(self, log: Location, done: LogCheck, talk: common.Talk) -> None:
        """Print nothing yet."""

    def line(self, done: LogCheck) -> str:
        """Return the verdict on one of many logs."""
        errors = sum(finding.level == "error" for finding in done.findings)
        return "sound" if done.is_sound else f"damaged, {counted(errors, 'error')}"

    def data(self, done: LogCheck) -> dict[str, Any]:
        """Return the findings in a log and its results as values of JSON."""
        return {"files": [_as_json(file) for file in done.files]}

    def print_result(self, results: Sequence[LogCheck], totals: Mapping[str, Any]) -> None:
        """Print the findings in each file."""
        files = [file for checked in results for file in checked.files]
        if self.values["json"]:
            common.print_json({"results": [_as_json(file) for file in files], **totals})
        else:
            for file in files:
                _print_check(file, self.values["quiet"])

    def code(self, results: Sequence[LogCheck]) -> int:
        """Return the exit code: 1 if there are errors."""
        return common.DONE if all(checked.is_sound for checked in results) else common.REFUSED


def _as_json(checked: CheckResult) -> dict[str, object]:
    return {
        "log": str(checked.path),
        "sound": checked.is_sound,
        "messages": checked.messages,
        "chunks": checked.chunks,
        "findings": [
            {"level": f.level, "kind": f.kind, "byte": f.where, "times": f.times, "words": f.words}
            for f in checked.findings
        ],
    }


def _print_check(checked: CheckResult, quiet: bool) -> None:
    from rich.text import Text

    if not quiet:
        verdict = "sound" if checked.is_sound else "damaged"
        show(f"{checked.path}: {verdict}; {_contents(checked)}")
    findings = [finding for finding in checked.findings if not quiet or finding.level == "error"]
    if not findings:
        return
    rows: list[list[str | Text]] = [
        [Text(f.level, "red" if f.level == "error" else "yellow"), str(f.where), str(f.times), f.kind, f.words]
        for f in findings
    ]
    print_table(("level", "byte", "times", "kind", "what"), rows, ("byte", "times"))


class Recover(EachLog["LogRecovery"]):
    """Save what is intact in damaged logs."""

    def logs(self) -> Sequence[NamedLog]:
        """Return the damaged logs: results beside a log are saved by themselves, logs that were saved are left out."""
        from mcaptrack.fleet import find_logs

        return find_logs(self.values["logs"], each=True, leave_out=_RECOVERED)

    def suffix(self) -> str:
        """Return the end of the names of outputs."""
        return _RECOVERED

    def show(self, log: Location, done: LogRecovery, talk: common.Talk) -> None:
        """Print what was saved and what was lost."""
        talk.say(f"{done.output}: {_contents(done)} saved")
        _say_lost(done.lost, talk)
        if not done.lost:
            talk.say("nothing was lost")

    def line(self, done: LogRecovery) -> str:
        """Return what was saved in a line."""
        saved = f"{_contents(done)} saved in {done.output}"
        return f"{saved}; {f'{len(done.lost)} losses' if done.lost else 'nothing was lost'}"

    def data(self, done: LogRecovery) -> dict[str, Any]:
        """Return the result as values of JSON."""
        saved = {"log": str(done.log), "output": str(done.output), "messages": done.messages}
        return saved | {"chunks": done.chunks, "lost": list(done.lost)}

    def code(self, results: Sequence[LogRecovery]) -> int:
        """Return the exit code: 3 if anything was lost."""
        return common.LOST if any(done.lost for done in results) else common.DONE


def _say_lost(lost: Sequence[str], talk: common.Talk) -> None:
    shown = lost if talk.verbose else lost[:_SHOWN]
    for loss in shown:
        talk.say(f"lost: {loss}")
    if len(lost) > len(shown):
        talk.say(f"lost: {len(lost) - len(shown)} more; -v shows them")


class Cut(Once["CutResult"]):
    """Write parts of logs to a new log."""

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments of the function: patterns and folders become logs."""
        return super().arguments(names) | {"log": common.expand(self.values["logs"], folders=True)}

    def show(self, done: CutResult, talk: common.Talk) -> None:
        """Print what was written, what is there from before the start, and what was lost."""
        since, until = (None if s is None else f"{s:.3f} s" for s in (done.start_s, done.end_s))
        span = "".join(f" {word} {s}" for word, s in (("from", since), ("to", until)) if s)
        held = f"{counted(done.messages, 'message')} in {counted(len(done.topics), 'topic')}"
        talk.say(f"{done.output}: {held}{span}; {counted(done.bytes, 'byte')}")
        if done.earlier:
            count = sum(done.earlier.values())
            talk.say(f"with {count:,} from before the start, in force there, of {list_names(sorted(done.earlier))}")
        _say_lost(done.lost, talk)

    def data(self, done: CutResult) -> dict[str, Any]:
        """Return the result as values of JSON."""
        return asdict(done) | {"logs": [str(path) for path in done.logs], "output": str(done.output)}

    def code(self, done: CutResult) -> int:
        """Return the exit code: 3 if anything was lost."""
        return common.LOST if done.lost else common.DONE


class Drop(EachLog["DropResult"]):
    """Remove channels from logs."""

    def logs(self) -> Sequence[NamedLog]:
        """Return the logs: the command takes one name, since those of channels follow."""
        from mcaptrack.fleet import find_logs

        log, files = self.values["logs"], [name for name in self.values["topics"] if Path(name).is_file()]
        if files and not (log.exists() or is_remote(parse(log))):
            refuse_usage(f"the log comes before the topics: {command('drop', Path(files[0]), str(log))}")
        return find_logs([log])

    def show(self, log: Location, done: DropResult, talk: common.Talk) -> None:
        """Print what was removed."""
        talk.say(f"{done.log}: {self.line(done)}")

    def line(self, done: DropResult) -> str:
        """Return what was removed in a line."""
        dropped = f"{', '.join(done.dropped)} with {counted(done.messages, 'message')} left out"
        return f"{dropped}; {counted(done.bytes_before, 'byte')} became {done.bytes:,}"

    def data(self, done: DropResult) -> dict[str, Any]:
        """Return the result as values of JSON."""
        return {"log": str(done.log), "dropped": list(done.dropped), "messages": done.messages, "bytes": done.bytes}


def _contents(log: CheckResult | LogRecovery) -> str:
    return f"{counted(log.messages, 'message')} in {counted(log.chunks, 'chunk')}"
