"""``mcaptrack ingest``: what it prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mcaptrack.api.ingesting import default_log
from mcaptrack.cli import common
from mcaptrack.cli.common import expand, only_one_output
from mcaptrack.cli.many import EachLog
from mcaptrack.cli.text import with_flags
from mcaptrack.location import Location

if TYPE_CHECKING:
    from mcaptrack import IngestResult
    from mcaptrack.fleet import NamedLog


class Ingest(EachLog["IngestResult"]):
    """Make logs of videos, images, recordings and label files."""

    def __init__(self, name: str, values: Mapping[str, Any]) -> None:
        super().__init__(name, values)
        self.names_output = not values["into"]

    def logs(self) -> Sequence[NamedLog]:
        """Return the inputs, each once, with the names of their logs."""
        from mcaptrack.fleet import NamedLog

        sources = expand(self.values["inputs"], each=True)
        only_one_output(sources, self.values["into"])
        return [NamedLog(source, default_log(Path(source))) for source in dict.fromkeys(sources)]

    def show(self, log: Location, done: IngestResult, talk: common.Talk) -> None:
        """Print what was written."""
        for line in done.notes:
            talk.say(line)
        for line in done.details:
            talk.detail(line)
        talk.say(f"{done.log}: {_counts(done)}")

    def line(self, done: IngestResult) -> str:
        """Return the result for one of many inputs in one line."""
        return "; ".join([f"{done.log} {_counts(done)}", *done.notes])

    def data(self, done: IngestResult) -> dict[str, Any]:
        """Return the result for one input as values of JSON."""
        return {
            "log": str(done.log),
            "messages": done.messages,
            "notes": [with_flags(note) for note in (*done.notes, *done.details)],
            "lost": [with_flags(loss) for loss in done.lost],
            **({"labels": done.labels} if done.labels else {}),
            **({"changes": done.changes} if done.changes is not None else {}),
        }

    def code(self, results: Sequence[IngestResult]) -> int:
        """Return the exit code: 3 if anything was lost."""
        return common.LOST if any(done.lost for done in results) else common.DONE


def _counts(done: IngestResult) -> str:
    return ", ".join(f"{topic} {count}" for topic, count in done.messages.items()) or "no channels, so no messages"
