"""Serve a log to viewers in a browser."""

from __future__ import annotations

import json
import threading
import webbrowser
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Final, Self

from mcaptrack import log as logs
from mcaptrack.api.common import Notes, as_path, log_file
from mcaptrack.api.declared import Argument, Option, declared
from mcaptrack.api.options import PathLike
from mcaptrack.errors import McaptrackError, call
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.location import sibling
from mcaptrack.notices import Notice, collected, warn
from mcaptrack.pipeline import LAYOUTS, attachment_of, layout_path, with_views
from mcaptrack.viewing import links
from mcaptrack.viewing.links import LICHTBLICK, LinkedEvent, is_about, viewer_links, with_links
from mcaptrack.viewing.serving import Server

#: Headings in the help.
_OPENED: Final = "What is opened"
_VIEWER: Final = "Server and viewer"
#: The names of codecs of videos.


@dataclass(frozen=True)
class _Contents:
    """The contents of a log for viewers: its files, layouts by name (name of the file, content), events, and the time
    at which viewers open.
    """

    files: Mapping[str, Path | bytes]
    layouts: Mapping[str, tuple[str, Path | bytes]]
    events: Sequence[LinkedEvent]
    report: tuple[str, bytes] | None
    start_ns: int
    at_ns: int


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
    events : tuple of LinkedEvent
        Every identity switch and repair, in the order of time, with the address that opens it.
    report : str or None
        Address of the report on the log, if there is one beside it: its times are links that open the log there.
    at_s : float
        The time at which viewers open, in seconds since the start of the log.
    notes : tuple of str
        Where viewers open and why, which layouts were edited, and where a viewer may have trouble with the pictures.
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
        contents: _Contents,
        port: int,
        lichtblick: str,
        notes: tuple[str, ...],
        warnings: tuple[Notice, ...],
        views: ExitStack | None = None,
    ) -> None:
        self._server = Server(dict(contents.files) | dict(contents.layouts.values()), port)
        self._thread: threading.Thread | None = None
        self._views = views  # a temporary file with views that the log lacks
        self.logs = tuple(self._server.address(name) for name in contents.files)
        self.layouts = {name: self._server.address(file) for name, (file, _) in contents.layouts.items()}
        first = next(iter(self.layouts.values()), None)

        def links_to(layout: str | None, at_ns: int) -> dict[str, str]:
            return viewer_links(self.logs, layout, lichtblick, at_ns if at_ns > contents.start_ns else None)

        self.lichtblick = {
            name: links_to(address, contents.at_ns)["Lichtblick"] for name, address in self.layouts.items()
        }
        self.links = links_to(first, contents.at_ns)
        self.events = tuple(
            event._replace(link=links_to(first, links.before(event.t_ns, contents.start_ns))["Lichtblick"])
            for event in contents.events
        )
        self.report = None
        if contents.report is not None:
            name, page = contents.report
            lead = partial(links.before, start_ns=contents.start_ns)
            page = with_links(page, lambda t_ns: links_to(first, lead(t_ns))["Lichtblick"])
            self.report = self._server.add(name, page)
        self.at_s = (contents.at_ns - contents.start_ns) / NS_PER_S
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
        if self._views is not None:
            self._views.close()


@declared()
def view(
    log: Annotated[PathLike, Argument("path", "LOG", "The log.", help="The log.")],
    *,
    at_s: Annotated[float | None, Option(_OPENED, 0, 1e9, flag="at")] = None,
    event: Annotated[int | None, Option(_OPENED, 1, 1e9, shown="none")] = None,
    layout: Annotated[PathLike | None, Option(_OPENED, metavar="NAME or FILE", shown="all of the log")] = None,
    port: Annotated[int, Option(_VIEWER, 0, 65535, shown="any that is free")] = 0,
    lichtblick: Annotated[str, Option(_VIEWER)] = LICHTBLICK,
    browser: Annotated[bool, Option(_VIEWER, flag="open/no-open")] = False,
) -> LogServer:
    """Serve a log to this machine's browser, and print links that open it in Lichtblick and Foxglove.

    Links open the log where something happens, and there is a link for each identity switch and repair. Also serves
    its layouts (tracking, comparing, predictions): the links open Lichtblick with one; in Foxglove import the file
    (Layouts, Import from file). Layout files beside the log are served as they are, also while they are edited, and
    its report with a link at each time. Only these files are served, only to this machine, until Ctrl-C.

    Parameters
    ----------
    at_s : float, optional
        Open at this time of the log, in seconds; by default a second before the first identity switch or repair of the
        best tracks.

        Without any of these, where tracks are.
    event : int, optional
        Open a second before this event, by its number.

        Its place in ``LogServer.events``, from 1.
    layout : str or path, optional
        Print a link for this layout only: tracking, comparing or predictions, or the layout in this file.
    port : int, default 0
        Port to serve it at.
    lichtblick : str, optional
        Address of Lichtblick, if you have installed it yourself.
    browser : bool, default False
        Open Lichtblick in the browser.

    Returns
    -------
    LogServer
        The addresses; a context manager that serves the log.

    Raises
    ------
    McaptrackError
        If the log cannot be read, has no such layout, time or event, or if the port is taken.

    Examples
    --------
    On the command line:

        mcaptrack view log.mcap

        mcaptrack view log.mcap --event 3 --open

    >>> import mcaptrack
    >>> with mcaptrack.view("log.mcap", layout="tracking") as server:
    ...     server.links["Lichtblick"].startswith("https://lichtblick-suite.github.io/lichtblick/?ds=remote-file")
    True

    """
    if not lichtblick.startswith(("http://", "https://")):
        raise McaptrackError(f"`lichtblick=` needs an address such as http://localhost:8080, not {lichtblick!r}")
    if at_s is not None and event is not None:
        raise McaptrackError("`at_s=` and `event=` both say where viewers open; leave one out")
    path, notes = log_file(log), Notes()
    with ExitStack() as stack, collected() as warnings:
        opened = stack.enter_context(logs.read(path))
        if not opened.is_on_disk:
            raise McaptrackError(
                f"viewers can't open {path}: a change of it goes on or was interrupted. The next command that writes "
                f"to it mends it; {call('recover', path)} saves it to another file"
            )
        shown, made_layouts = stack.enter_context(with_views(opened))
        files = {part.path.name: Path(part.real_path) for part in shown.parts}
        if shown is not opened:
            notes.say(f"views that the log lacks are drawn in {[*files][-1]} for now; {call('run', path)} keeps them")
        layouts = _chosen_layouts(path, opened, layout, made_layouts, notes)
        events = links.find_moments(opened)
        at_ns, why = _opening(opened, events, at_s, event)
        if opened.start_ns or opened.end_ns:
            notes.say(f"viewers open at {links.seconds_of(opened, at_ns):.1f} s, {why}")
        _say_trouble(opened, notes)
        contents = _Contents(files, layouts, events, _report(path, opened, notes), opened.start_ns, at_ns)
        said = tuple(notes), tuple(dict.fromkeys(warnings))
        server = LogServer(contents, port, lichtblick, *said, stack.pop_all() if shown is not opened else None)
    if browser:
        webbrowser.open(server.links["Lichtblick"])
    return server


def _opening(opened: logs.Log, events: Sequence[LinkedEvent], at_s: float | None, event: int | None) -> tuple[int, str]:
    """Return the log time in ns at which viewers open, and why. Raises McaptrackError if the log has no such time."""
    if at_s is not None:
        length_s = links.seconds_of(opened, opened.end_ns)
        if at_s > length_s:
            raise McaptrackError(f"{opened.path} lasts {length_s:.1f} s, so viewers can't open it at {at_s:g} s")
        return opened.start_ns + round(at_s * NS_PER_S), "as asked"
    if event is not None:
        if event > len(events):
            what_there_is = f"the events 1 to {len(events)}" if events else "no identity switches and repairs"
            raise McaptrackError(f"{opened.path} has {what_there_is}, so viewers can't open at event {event}")
        chosen = events[event - 1]
        return links.before(chosen.t_ns, opened.start_ns), f"a second before event {event} ({chosen.text})"
    return links.opening_moment(opened, events)


def _report(path: Path, opened: logs.Log, notes: Notes) -> tuple[str, bytes] | None:
    """Return name and content of the report beside a log, if it is about the log as it is now."""
    file = sibling(path, ".report.html")
    try:
        page = file.read_bytes() if file.is_file() else None
    except OSError as error:
        warn(f"{file} can't be served: {error.strerror}", "left-out")
        return None
    if page is None:
        return None
    if not is_about(page, opened.fingerprint()):
        notes.say(f"{file} is not served: it is not about the log as it is now; {call('report', path, force=True)} is")
        return None
    return file.name, page


def _say_trouble(opened: logs.Log, notes: Notes) -> None:
    """Say where viewers may have trouble with the pictures of a log, and what helps."""
    from mcaptrack.sources.video import WORDS

    topics: dict[str, list[str]] = {}
    for topic, codec in links.video_formats(opened).items():
        topics.setdefault(codec, []).append(topic)
    again = call("ingest", Path("VIDEO"), image_format="jpeg")
    for codec, those in topics.items():
        trouble = f"pictures in {', '.join(those)} are {WORDS[codec]}"
        if codec == "h264":
            notes.say(
                f"{trouble}: on a slow machine Lichtblick may show none while it is paused, and late ones during play. "
                f"A log made by {again} doesn't have this, and is larger"
            )
        else:
            notes.say(f"{trouble}, which Lichtblick doesn't play; a log made by {again} can be seen everywhere")


def _chosen_layouts(
    path: Path, opened: logs.Log, chosen: PathLike | None, made_layouts: Mapping[str, bytes], notes: Notes
) -> dict[str, tuple[str, Path | bytes]]:
    """Return the layouts to serve by name: the name of each file, and its content or path."""
    if chosen is not None and str(chosen) not in LAYOUTS and _is_file_name(chosen):
        file = as_path(chosen)
        try:
            json.loads(file.read_bytes())
        except OSError as error:
            raise McaptrackError(f"the layout {file} can't be read: {error.strerror}") from None
        except (ValueError, RecursionError):
            raise McaptrackError(f"{file} is no layout: it is not JSON") from None
        return {file.stem.removesuffix(".layout"): (f"{file.stem}.json", file)}
    layouts = _layouts(path, opened, made_layouts, notes)
    if chosen is not None and str(chosen) not in layouts:
        text = ", ".join(layouts) or "none"
        raise McaptrackError(f"{path} has no layout {chosen}; it has {text}. A file of a layout ends with .json")
    return {
        name: (layout_path(path, name).name, content)
        for name, content in layouts.items()
        if chosen is None or name == str(chosen)
    }


def _is_file_name(chosen: PathLike) -> bool:
    """Return whether a layout is named by its file."""
    return Path(chosen).suffix.lower() == ".json" or len(Path(chosen).parts) > 1 or Path(chosen).is_file()


def _layouts(path: Path, opened: logs.Log, made_layouts: Mapping[str, bytes], notes: Notes) -> dict[str, Path | bytes]:
    """Return the layouts of a log: files beside it, otherwise those made now, or those that it keeps.

    Notes tell of files that were edited.
    """
    layouts: dict[str, Path | bytes] = {}
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
            layouts[name] = file
        elif kept is not None or name in made_layouts:
            layouts[name] = made_layouts.get(name, kept or b"")
        if content is not None and kept is not None and content != kept:
            notes.say(f"{file} differs from the layout in the log; the file is served")
    return layouts
