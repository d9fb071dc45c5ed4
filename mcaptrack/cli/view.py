"""``mcaptrack view``: logs for viewers in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from mcaptrack.cli import common
from mcaptrack.cli.text import show
from mcaptrack.errors import McaptrackError, command
from mcaptrack.viewing.links import LICHTBLICK, viewer_links

if TYPE_CHECKING:
    from mcaptrack.log import Log

_VIEWER: Final = "Server and viewer"


@common.one_line
def view(
    path: Annotated[Path, typer.Argument(metavar="LOG", help="The log.", show_default=False)],
    port: Annotated[
        int,
        common.option(
            "--port", panel=_VIEWER, least=0, most=65535, help="Port to serve it at.", show_default="any that is free"
        ),
    ] = 0,
    lichtblick: Annotated[
        str,
        common.option("--lichtblick", panel=_VIEWER, help="Where Lichtblick is, if you have it installed yourself."),
    ] = LICHTBLICK,
    layout: Annotated[
        str | None,
        common.option(
            "--layout",
            panel=_VIEWER,
            help="The layout to print a link for.",
            metavar="NAME",
            show_default="all there are",
        ),
    ] = None,
    browser: Annotated[
        bool, common.option("--open/--no-open", panel=_VIEWER, help="Open Lichtblick in the browser.")
    ] = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Serve a log to this machine's browser, and print links that open it in Lichtblick and Foxglove.

    With the log go its layouts (tracking, comparing, predictions), which Lichtblick takes by itself and Foxglove
    imports (Layouts, Import from file). Layout files beside the log are served as they are, also while they are edited.
    Only these files are served, only to this machine, until Ctrl-C.

    Example: mcaptrack view log.mcap
    """
    import webbrowser

    from mcaptrack import log
    from mcaptrack.pipeline import layout_path
    from mcaptrack.viewing.serving import Server

    if not lichtblick.startswith(("http://", "https://")):
        raise McaptrackError(f"--lichtblick needs an address such as http://localhost:8080, not {lichtblick!r}")
    with log.read(path) as opened:
        if not opened.is_on_disk:
            raise McaptrackError(
                f"viewers can't open {path}: a change of it goes on or was interrupted. The next command that writes "
                f"to it mends it; {command('recover', path)} saves it to another file"
            )
        files: dict[str, Path | bytes] = {part.path.name: part.real_path for part in opened.parts}
        layouts, notes = _layouts(path, opened)
    if layout is not None and layout not in layouts:
        raise McaptrackError(f"{path} has no layout {layout}; it has {', '.join(layouts) or 'none'}")
    layouts = {name: content for name, content in layouts.items() if layout in (None, name)}
    with (
        common.Talk(quiet, verbose).open() as talk,
        Server(files | {layout_path(path, name).name: content for name, content in layouts.items()}, port) as server,
    ):
        for words in notes:
            talk.say(words)
        logs = [server.address(name) for name in files]
        addresses = {name: server.address(layout_path(path, name).name) for name in layouts}
        ways = {name: viewer_links(logs, address, lichtblick) for name, address in addresses.items()}
        first = next(iter(ways.values()), None) or viewer_links(logs, None, lichtblick)
        if json:
            one = next(iter(addresses.values()), None)
            each = {name: links["Lichtblick"] for name, links in ways.items()}
            said = {
                "log": logs[0],
                "logs": logs,
                "layout": one,
                "layouts": addresses,
                "links": first,
                "lichtblick": each,
            }
            common.print_json(said)
        else:
            lines = [(f"Lichtblick, {name}", links["Lichtblick"]) for name, links in ways.items()]
            lines = [*(lines or [("Lichtblick", first["Lichtblick"])]), ("Foxglove", first["Foxglove"])]
            lines += [("log", "  ".join(logs))] + [(f"layout, {name}", address) for name, address in addresses.items()]
            lines += [] if addresses else [("layout", f"none yet: {command('run', path)} makes one")]
            width = max(len(name) for name, _ in lines) + 2
            show(*(f"{name:<{width}}{what}" for name, what in lines))
        talk.say("serving until Ctrl-C ...")
        if browser:
            webbrowser.open(first["Lichtblick"])
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            talk.say("done")


def _layouts(path: Path, opened: Log) -> tuple[dict[str, Path | bytes], list[str]]:
    """The layouts of a log: files beside it, otherwise what it keeps; and notes about files that were edited."""
    from json import loads

    from mcaptrack.notices import warn
    from mcaptrack.pipeline import LAYOUTS, attachment_of, layout_path

    found: dict[str, Path | bytes] = {}
    notes = []
    for name in LAYOUTS:
        kept, file = opened.attachment(attachment_of(name)), layout_path(path, name)
        try:
            content = file.read_bytes() if file.is_file() else None
            if content is not None:
                loads(content)
        except (OSError, ValueError, RecursionError) as error:
            content = None
            why = error.strerror if isinstance(error, OSError) else "it is not JSON"
            warn(f"{file} can't be served ({why}); the log's own layout is used", "left-out")
        if content is not None:
            found[name] = file
        elif kept is not None:
            found[name] = kept
        if content is not None and kept is not None and content != kept:
            notes.append(f"{file} differs from the layout in the log; the file is served")
    return found, notes
