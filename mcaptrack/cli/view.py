"""``mcaptrack view``: logs for viewers in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mcaptrack.cli import common
from mcaptrack.errors import McaptrackError
from mcaptrack.links import LICHTBLICK, viewer_links


@common.one_line
def view(
    path: Annotated[Path, typer.Argument(metavar="LOG", help="The log.", show_default=False)],
    port: Annotated[int, common.option("--port", help="Port to serve it at.", show_default="any that is free")] = 0,
    lichtblick: Annotated[
        str, common.option("--lichtblick", help="Where Lichtblick is, if you have it installed yourself.")
    ] = LICHTBLICK,
    browser: Annotated[bool, common.option("--open/--no-open", help="Open Lichtblick in the browser.")] = False,
    json: common.Json = False,
    quiet: common.Quiet = False,
    verbose: common.Verbose = False,
    config: common.Config = None,
) -> None:
    """Serve a log to this machine's browser, and print links that open it in Lichtblick and Foxglove.

    With the log goes its layout, which Lichtblick takes by itself and Foxglove imports (Layouts, Import from file).
    Nothing but these files is served, to nobody but this machine, until Ctrl-C.

    Example: mcaptrack view log.mcap
    """
    import webbrowser

    from mcaptrack import log
    from mcaptrack.pipeline import LAYOUT
    from mcaptrack.serving import Server

    if not lichtblick.startswith(("http://", "https://")):
        raise McaptrackError(f"--lichtblick needs an address such as http://localhost:8080, not {lichtblick!r}")
    with log.read(path) as opened:
        served: dict[str, Path | bytes] = {part.path.name: part.real_path for part in opened.parts}
        layout = opened.attachment(LAYOUT)
    layout_name = path.with_suffix(".layout.json").name
    if layout is not None:
        served[layout_name] = layout
    with common.Talk(quiet, verbose).open() as talk, Server(served, port) as server:
        logs = [server.address(name) for name in served if name != layout_name or layout is None]
        layout_address = server.address(layout_name) if layout is not None else None
        links = viewer_links(logs, layout_address, lichtblick)
        if json:
            common.print_json({"log": logs[0], "logs": logs, "layout": layout_address, "links": links})
        else:
            for name, link in links.items():
                print(f"{name:<11}{link}")
            print(f"{'log':<11}{'  '.join(logs)}")
            print(f"{'layout':<11}{layout_address or 'none yet: `mcaptrack run` makes one'}", flush=True)
        talk.say("serving until Ctrl-C ...")
        if browser:
            webbrowser.open(links["Lichtblick"])
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            talk.say("done")
