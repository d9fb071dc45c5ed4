"""``mcaptrack view``: what it prints while it serves a log to viewers in a browser."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from mcaptrack.api.declared import Option
from mcaptrack.cli import common
from mcaptrack.cli.declared import Once
from mcaptrack.cli.text import show
from mcaptrack.errors import command

if TYPE_CHECKING:
    from mcaptrack import LogServer


class ViewCommand(Once["LogServer"]):
    """Serve a log to viewers in a browser."""

    class More:
        """Options that the function has no use for."""

        links: Annotated[
            int, Option("What is opened", 0, 1_000_000, help="Print the links of at most so many events.")
        ] = 8

    def print_result(self, done: LogServer, talk: common.Talk) -> None:
        """Print the links, and serve the log until Ctrl-C."""
        try:
            super().print_result(done, talk)
            talk.say("serving until Ctrl-C ...")
            done.serve_forever()
        except KeyboardInterrupt:
            talk.say("done")
        finally:
            done.close()

    def data(self, done: LogServer) -> dict[str, Any]:
        """Return the addresses as values of JSON."""
        return {
            "log": done.logs[0],
            "logs": list(done.logs),
            "layout": next(iter(done.layouts.values()), None),
            "layouts": done.layouts,
            "links": done.links,
            "lichtblick": done.lichtblick,
            "report": done.report,
            "at_s": done.at_s,
            "events": [event._asdict() for event in done.events],
            "notes": list(done.notes),
        }

    def show(self, done: LogServer, talk: common.Talk) -> None:
        """Print the addresses, and those of the first events."""
        lines = [(f"Lichtblick, {name}", link) for name, link in done.lichtblick.items()]
        lines = [*(lines or [("Lichtblick", done.links["Lichtblick"])]), ("Foxglove", done.links["Foxglove"])]
        lines += [("log", "  ".join(done.logs))]
        lines += [("report", done.report)] if done.report else []
        lines += [(f"layout, {name}", address) for name, address in done.layouts.items()]
        lines += [] if done.layouts else [("layout", f"none yet: {command('run', self.values['path'])} makes one")]
        width = max(len(name) for name, _ in lines) + 2
        show(*(f"{name:<{width}}{what}" for name, what in lines))
        most = self.values["links"]
        for event in done.events[:most]:
            show("", f"event {event.event}, {event.topic}: {event.text}", f"  {event.link}")
        rest = len(done.events) - min(most, len(done.events))
        if rest:
            text = f"and {rest} more" if most else f"{rest} events"
            show("", f"{text}: --links {len(done.events)} prints their links, --event N opens one, --json has all")
