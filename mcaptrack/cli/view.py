"""``mcaptrack view``: what it prints while it serves a log to the browser."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from mcaptrack.api.declared import Option
from mcaptrack.cli import common
from mcaptrack.cli.declared import Once
from mcaptrack.cli.text import show

if TYPE_CHECKING:
    from mcaptrack import LogServer


class ViewCommand(Once["LogServer"]):
    """Serve a log to the browser."""

    class More:
        """Options that the function has no use for."""

        links: Annotated[
            bool, Option("What is opened", help="Print links that open the log, and each event, in other viewers.")
        ] = False

    def print_result(self, done: LogServer, talk: common.Talk) -> None:
        """Print the address, and serve the log until Ctrl-C."""
        try:
            super().print_result(done, talk)
            done.serve_forever()
        except KeyboardInterrupt:
            talk.detail("done")
        finally:
            done.close()

    def data(self, done: LogServer) -> dict[str, Any]:
        """Return the addresses as values of JSON."""
        return {
            "address": done.address,
            "log": done.logs[0],
            "logs": list(done.logs),
            "layout": next(iter(done.layouts.values()), None),
            "layouts": done.layouts,
            "links": done.links,
            "lichtblick": done.lichtblick,
            "at_s": done.at_s,
            "events": [event._asdict() for event in done.events],
            "notes": list(done.notes),
        }

    def show(self, done: LogServer, talk: common.Talk) -> None:
        """Print the address of the page, and with ``--links`` those that other viewers open."""
        show(f"Open {done.address}")
        for note in done.notes:
            (talk.say if self.values["links"] else talk.detail)(note)
        if not self.values["links"]:
            return
        lines = [(f"Lichtblick, {name}", link) for name, link in done.lichtblick.items()]
        lines = [*(lines or [("Lichtblick", done.links["Lichtblick"])]), ("Foxglove", done.links["Foxglove"])]
        lines += [("log", "  ".join(done.logs))]
        lines += [(f"layout, {name}", address) for name, address in done.layouts.items()]
        width = max(len(name) for name, _ in lines) + 2
        show("", *(f"{name:<{width}}{what}" for name, what in lines))
        for event in done.events:
            show("", f"event {event.event}, {event.topic}: {event.text}", f"  {event.link}")
