"""Serve a log to viewers in a browser."""

from __future__ import annotations

import json
import threading
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from mcaptrack import log as logs
from mcaptrack.api.checked import checked
from mcaptrack.api.common import Notes, PathLike, log_file
from mcaptrack.errors import McaptrackError, call
from mcaptrack.notices import Notice, collected, warn
from mcaptrack.pipeline import LAYOUTS, attachment_of, layout_path
from mcaptrack.viewing.links import LICHTBLICK, viewer_links
from mcaptrack.viewing.serving import Server


class LogServer:
    """A log that is served to the browser of this machine; made by ``mcaptrack.view``. A context manager.

    It is served within a ``with`` block, from ``start`` to ``close``, or by ``serve_forever``.

    Attributes
    ----------
    logs : tuple of str
        Addresses of the files of the log, its results included.
    layouts : dict of str to str
        Addresses of its layouts, by name.
    links : dict of str to str
        Addresses that open the log in "Lichtblick", with the first layout, and in "Foxglove".
    lichtblick : dict of str to str
        Addresses that open the log in Lichtblick, by layout.
    notes : tuple of str
        Which layouts were edited.
    warnings : tuple of mcaptrack.Notice
        Which layouts could not be read.

    Examples
    --------
    >>> import mcaptrack
    >>> with mcaptrack.view("log.mcap") as server:
    ...     sorted(server.links)
    ['Foxglove', 'Lichtblick']

    """

    def __init__(
        self,
        files: Mapping[str, Path | bytes],
        layouts: Mapping[str, tuple[str, Path | bytes]],
        port: int,
        lichtblick: str,
        notes: tuple[str, ...],
        warnings: tuple[Notice, ...],
    ) -> None:
        self._server = Server(dict(files) | dict(layouts.values()), port)
        self._thread: threading.Thread | None = None
        self.logs = tuple(self._server.address(name) for name in files)
        self.layouts = {name: self._server.address(file) for name, (file, _) in layouts.items()}
        links = {name: viewer_links([*self.logs], address, lichtblick) for name, address in self.layouts.items()}
        self.lichtblick = {name: link["Lichtblick"] for name, link in links.items()}
        self.links = next(iter(links.values())) if links else viewer_links([*self.logs], None, lichtblick)
        self.notes = notes
        self.warnings = warnings

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> Self:
        """Serve the log from another thread until ``close``.

        Returns
        -------
        LogServer
            The server itself.

        Examples
        --------
        >>> import mcaptrack
        >>> server = mcaptrack.view("log.mcap").start()
        >>> server.close()

        """
        self._thread = threading.Thread(target=self.serve_forever, daemon=True)
        self._thread.start()
        return self

    def serve_forever(self) -> None:
        """Serve the log until Ctrl-C."""
        self._server.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """Stop serving."""
        if self._thread is not None:
            self._server.shutdown()
            self._thread.join()
            self._thread = None
        self._server.server_close()


@checked(port=(0, 65535))
def view(
    log: PathLike,
    *,
    port: int = 0,
    lichtblick: str = LICHTBLICK,
    layout: str | None = None,
    browser: bool = False,
) -> LogServer:
    """Serve a log and its layouts to the browser of this machine, with links that open it in Lichtblick and Foxglove.

    Layout files beside the log are served as they are, also while they are edited. Only these files are served, only
    to this machine.

    Parameters
    ----------
    log : path
        The log.
    port : int, default 0
        Port to serve it at; 0 is any that is free.
    lichtblick : str, optional
        Address of Lichtblick, if you have installed it yourself.
    layout : str, optional
        Serve only this layout: "tracking", "comparing" or "predictions".
    browser : bool, default False
        Open Lichtblick in the browser.

    Returns
    -------
    LogServer
        The addresses; a context manager that serves the log.

    Raises
    ------
    McaptrackError
        If the log cannot be read, has no such layout, or if the port is taken.

    Examples
    --------
    >>> import mcaptrack
    >>> with mcaptrack.view("log.mcap", layout="tracking") as server:
    ...     server.links["Lichtblick"].startswith("https://lichtblick-suite.github.io/lichtblick/?ds=remote-file")
    True

    """
    if not lichtblick.startswith(("http://", "https://")):
        raise McaptrackError(f"`lichtblick=` needs an address such as http://localhost:8080, not {lichtblick!r}")
    path, notes = log_file(log), Notes()
    with collected() as warnings, logs.read(path) as opened:
        if not opened.is_on_disk:
            raise McaptrackError(
                f"viewers can't open {path}: a change of it goes on or was interrupted. The next command that writes "
                f"to it mends it; {call('recover', path)} saves it to another file"
            )
        files = {part.path.name: Path(part.real_path) for part in opened.parts}
        layouts = _layouts(path, opened, notes)
    if layout is not None and layout not in layouts:
        raise McaptrackError(f"{path} has no layout {layout}; it has {', '.join(layouts) or 'none'}")
    chosen = {name: (layout_path(path, name).name, content) for name, content in layouts.items()}
    chosen = {name: file for name, file in chosen.items() if layout in (None, name)}
    server = LogServer(files, chosen, port, lichtblick, tuple(notes), tuple(dict.fromkeys(warnings)))
    if browser:
        webbrowser.open(server.links["Lichtblick"])
    return server


def _layouts(path: Path, opened: logs.Log, notes: Notes) -> dict[str, Path | bytes]:
    """Return the layouts of a log: files beside it, otherwise what it keeps. Notes tell of files that were edited."""
    found: dict[str, Path | bytes] = {}
    for name in LAYOUTS:
        kept, file = opened.attachment(attachment_of(name)), layout_path(path, name)
        try:
            content = file.read_bytes() if file.is_file() else None
            if content is not None:
                json.loads(content)
        except (OSError, ValueError, RecursionError) as error:
            content = None
            why = error.strerror if isinstance(error, OSError) else "it is not JSON"
            warn(f"{file} can't be served ({why}); the log's own layout is used", "left-out")
        if content is not None:
            found[name] = file
        elif kept is not None:
            found[name] = kept
        if content is not None and kept is not None and content != kept:
            notes.say(f"{file} differs from the layout in the log; the file is served")
    return found
