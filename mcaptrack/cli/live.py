"""A table of the logs that workers are busy with, on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from mcaptrack.cli.text import printable

if TYPE_CHECKING:
    from mcaptrack.fleet import FleetStatus


class LiveTable:
    """The table; without a terminal it shows nothing."""

    def __init__(self, live: Any = None) -> None:
        self._live = live

    @classmethod
    @contextmanager
    def on_terminal(cls, hidden: bool) -> Iterator[LiveTable]:
        """Show a table within this block, if stderr is a terminal; lines that are printed appear above it."""
        if hidden or not sys.stderr.isatty():
            yield cls()
            return
        from rich.console import Console
        from rich.live import Live

        console = Console(stderr=True, markup=False, emoji=False, highlight=False)
        with Live(console=console, auto_refresh=False, transient=True, redirect_stdout=False) as live:
            yield cls(live)

    def show(self, status: FleetStatus) -> None:
        """Show how far the logs are."""
        if self._live is not None:
            self._live.update(table_of(status), refresh=True)


def table_of(status: FleetStatus) -> Any:
    """Return the table: a line for each log that runs, below the number of those that ended."""
    from rich.table import Table
    from rich.text import Text

    counts = ", ".join(f"{count} {state}" for state, count in sorted(status.ended.items()))
    title = f"{status.logs - status.left} of {status.logs} logs in {status.seconds:.0f} s" + (
        f": {counts}" if counts else ""
    )
    table = Table(box=None, pad_edge=False, title=Text(title), title_justify="left", title_style="bold")
    table.add_column("log", overflow="ellipsis", no_wrap=True, ratio=1)
    for name in ("stage", "done", "seconds", "MB"):
        table.add_column(name, justify="left" if name == "stage" else "right", no_wrap=True)
    for one in sorted(status.running, key=lambda running: -running.seconds):
        done = f"{one.done / one.total:.0%}" if one.total else ""
        cells = (printable(one.stage), done, f"{one.seconds:.0f}", f"{one.resident_bytes / 1e6:,.0f}")
        table.add_row(Text(printable(str(one.log))), *cells)
    return table
