"""``mcaptrack view``: serve a log to viewers in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from mcaptrack.cli import common
from mcaptrack.cli.text import show
from mcaptrack.errors import command
from mcaptrack.viewing.links import LICHTBLICK

if TYPE_CHECKING:
    from mcaptrack import LogServer

_VIEWER: Final = "Server and viewer"
_OPENED: Final = "What is opened"


@common.one_line
def view(
    path: Annotated[Path, typer.Argument(metavar="LOG", help="The log.", show_default=False)],
    at_s: Annotated[
        float | None,
        common.option(
            "--at",
            panel=_OPENED,
            least=0,
            most=1e9,
            help="Open at this time of the log, in seconds.",
            show_default="a second before the first identity switch or repair of the best tracks",
        ),
    ] = None,
    event: Annotated[
        int | None,
        common.option(
            "--event",
            panel=_OPENED,
            least=1,
            most=1e9,
            help="Open a second before this event, by its number.",
            show_default="none",
        ),
    ] = None,
    layout: Annotated[
        str | None,
        common.option(
            "--layout",
            panel=_OPENED,
            help="Print a link for this layout only: tracking, comparing or predictions, or the layout in this file.",
            metavar="NAME or FILE",
            show_default="all of the log",
        ),
    ] = None,
    links: Annotated[
        int,
        common.option(
            "--links", panel=_OPENED, least=0, most=1_000_000, help="Print the links of at most so many events."
        ),
    ] = 8,
    port: Annotated[
        int,
        common.option(
            "--port", panel=_VIEWER, least=0, most=65535, help="Port to serve it at.", show_default="any that is free"
        ),
    ] = 0,
    lichtblick: Annotated[
        str,
        common.option("--lichtblick", panel=_VIEWER, help="Address of Lichtblick, if you have installed it yourself."),
    ] = LICHTBLICK,
    browser: Annotated[
        bool, common.option("--open/--no-open", panel=_VIEWER, help="Open Lichtblick in the browser.")
    ] = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Serve a log to this machine's browser, and print links that open it in Lichtblick and Foxglove.

    Links open the log where something happens, and there is a link for each identity switch and repair. Also serves
    its layouts (tracking, comparing, predictions): the links open Lichtblick with one; in Foxglove import the file
    (Layouts, Import from file). Layout files beside the log are served as they are, also while they are edited, and
    its report with a link at each time. Only these files are served, only to this machine, until Ctrl-C.

    Example: mcaptrack view log.mcap

    Example: mcaptrack view log.mcap --event 3 --open
    """
    import mcaptrack

    with common.Talk(quiet, verbose).open() as talk:
        server = mcaptrack.view(
            path, at_s=at_s, event=event, port=port, lichtblick=lichtblick, layout=layout, browser=browser
        )
        try:
            if json:
                common.print_json(_as_json(server))
            else:
                _print(server, path, links)
            talk.say("serving until Ctrl-C ...")
            server.serve_forever()
        except KeyboardInterrupt:
            talk.say("done")
        finally:
            server.close()


def _as_json(server: LogServer) -> dict[str, Any]:
    return {
        "log": server.logs[0],
        "logs": list(server.logs),
        "layout": next(iter(server.layouts.values()), None),
        "layouts": server.layouts,
        "links": server.links,
        "lichtblick": server.lichtblick,
        "report": server.report,
        "at_s": server.at_s,
        "events": [event._asdict() for event in server.events],
        "notes": list(server.notes),
    }


def _print(server: LogServer, path: Path, most: int) -> None:
    lines = [(f"Lichtblick, {name}", link) for name, link in server.lichtblick.items()]
    lines = [*(lines or [("Lichtblick", server.links["Lichtblick"])]), ("Foxglove", server.links["Foxglove"])]
    lines += [("log", "  ".join(server.logs))]
    lines += [("report", server.report)] if server.report else []
    lines += [(f"layout, {name}", address) for name, address in server.layouts.items()]
    lines += [] if server.layouts else [("layout", f"none yet: {command('run', path)} makes one")]
    width = max(len(name) for name, _ in lines) + 2
    show(*(f"{name:<{width}}{what}" for name, what in lines))
    for event in server.events[:most]:
        show("", f"event {event.event}, {event.topic}: {event.text}", f"  {event.link}")
    rest = len(server.events) - min(most, len(server.events))
    if rest:
        text = f"and {rest} more" if most else f"{rest} events"
        show("", f"{text}: --links {len(server.events)} prints their links, --event N opens one, --json has all")
