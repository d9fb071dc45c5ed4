"""``mcaptrack report``: what it prints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from mcaptrack.cli import common
from mcaptrack.cli.common import expand
from mcaptrack.cli.declared import Once

if TYPE_CHECKING:
    from mcaptrack import ReportResult


class ReportCommand(Once["ReportResult"]):
    """Write one HTML page about logs."""

    def arguments(self, names: Mapping[str, str]) -> dict[str, Any]:
        """Return the arguments of the function: patterns and folders become logs."""
        return super().arguments(names) | {"log": expand(self.values["logs"], folders=True)}

    def data(self, done: ReportResult) -> dict[str, Any]:
        """Return the numbers of the page."""
        return dict(done.data)

    def print_result(self, done: ReportResult, talk: common.Talk) -> None:
        """Print where the page is, and with ``--json`` its numbers."""
        count = done.data["summary"]["logs"] if "summary" in done.data else len(done.data["logs"])
        talk.say(f"{done.page}: {count} log{'s' if count > 1 else ''}, {done.size / 1e6:.2f} MB")
        if self.values["json"]:
            common.print_json(self.data(done))
