"""Serve a log to a browser: our own page on it, and the files that other viewers read."""

from __future__ import annotations

import json
import re
import threading
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Self

from mcaptrack import log as logs
from mcaptrack import pipeline, tables
from mcaptrack.api.arrow_tables import arrow_html
from mcaptrack.api.common import as_path, log_file
from mcaptrack.api.declared import Argument, Option, declared
from mcaptrack.api.options import PathLike
from mcaptrack.errors import McaptrackError, call, offer
from mcaptrack.files import read_json
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.installed import missing_extension
from mcaptrack.notices import Notice, collected, warn
from mcaptrack.pipeline import LAYOUTS, attachment_of, layout_path, with_views
from mcaptrack.registry import BUILT_IN, Kind, answer_of, blamed, find, names, of_type, others
from mcaptrack.sources.cameras import cameras
from mcaptrack.tables import export
from mcaptrack.viewing import links
from mcaptrack.viewing.formatting import policy, render
from mcaptrack.viewing.links import LICHTBLICK, LinkedEvent, viewer_links
from mcaptrack.viewing.serving import LOOPBACK, LogPage, Page, Server, WebViewer, log_player

#: Headings in the help.
_OPENED: Final = "What is opened"
_VIEWER: Final = "Server and viewer"
#: The port where a log is served, unless another is given or this one is taken.
PORT: Final = 8765
#: Our pages and scripts, below the secret word; files of the log have no folder.
_FOLDER: Final = "page"
#: What the functions of a page and of a viewer give.
_GIVEN: Final[Mapping[str, type[Any]]] = {"make": bytes, "link": str, "why_not": str}
#: The time in the text of an event.
_WHEN: Final = re.compile(r",? at [0-9]+\.[0-9] s\b")
#: A larger file is no layout.
_MOST_BYTES: Final = 2**26


@dataclass(frozen=True)
class _Contents:
    """The contents of a log for viewers: its files, layouts by name (name of the file, content), events, and the time
    at which viewers open. ``views`` are what players show: a name, the camera, and whether it is seen from above.
    ``pages`` stand beside them. ``viewers`` are other viewers on the web, each with why it can't open the log, or "".
    """

    path: Path
    files: Mapping[str, Path | bytes]
    layouts: Mapping[str, tuple[str, Path | bytes]]
    events: Sequence[LinkedEvent]
    views: Sequence[tuple[str, str, bool]]
    pages: Mapping[str, LogPage]
    viewers: Mapping[str, tuple[WebViewer, str]]
    start_ns: int
    at_ns: int
    notes: tuple[str, ...] = ()
    warnings: tuple[Notice, ...] = ()

    def seconds(self, t_ns: int) -> float:
        """A log time in seconds since the start of the log."""
        return (t_ns - self.start_ns) / NS_PER_S


@dataclass
class _FromLog:
    """Content that is made of a log when it is asked for, and again when the log has changed."""

    path: Path
    make: Callable[[logs.Log], bytes]
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _made: tuple[logs.Log, bytes] | None = None

    def __call__(self) -> bytes:
        """Return the content; a page that says why there is none."""
        with self._lock:
            try:
                if self._made is None or not logs.is_current(self._made[0], self.path):
                    with collected(), logs.read(self.path) as opened:
                        self._made = opened, self.make(opened)
                return self._made[1]
            except McaptrackError as error:
                return render("nothing.html", text=str(error)).encode()


def _parts(kind: Kind) -> dict[str, Any]:
    """The pages, or viewers, by name: those of entry points, and our own. One that can't be made is left out."""
    parts: dict[str, Any] = {}
    for name in (*others(kind), *BUILT_IN[kind]):
        try:
            entry = find(kind, name)
            with blamed(entry, "could not be made"):
                gave = entry.cls()
            part: Any = of_type(entry, gave, LogPage if kind == "page" else WebViewer, "its function")
            parts[name] = part._replace(
                **{
                    each: partial(answer_of, entry, _GIVEN[each], each, getattr(part, each))
                    for each in _GIVEN
                    if hasattr(part, each)
                }
            )
        except McaptrackError as error:
            warn(str(error), "left-out")
    return {name: part for name, part in parts.items() if re.fullmatch(r"\w[\w-]*", name)}


def _why_not(viewer: WebViewer, opened: logs.Log) -> str:
    try:
        return viewer.why_not(opened)
    except McaptrackError as error:
        return str(error)


def tables_page() -> LogPage:
    """The page with the tables of a log."""
    return LogPage(partial(_tables, "{}.csv".format), policy())


def _tables(address: Callable[[str], str], opened: logs.Log) -> bytes:
    contents = export.LogTables(opened)
    names = sorted(tables.TABLES, key=lambda name: name not in ("track_summary", "tracks"))
    filled = [(name, table) for name in names if (table := contents.table(name)).num_rows]
    shown = [{"name": name, "html": arrow_html(table), "csv": address(name)} for name, table in filled]
    return render("tables.html", tables=shown, log=opened.path.name).encode()


def _csv(name: str, opened: logs.Log) -> bytes:
    return b"".join(tables.pieces(export.LogTables(opened).table(name), "csv"))


class LogServer:
    """A log that is served to the browser of this machine; made by ``mcaptrack.view``. A context manager.

    It is served within a ``with`` block, from ``start`` to ``close``, or by ``serve_forever``.

    Attributes
    ----------
    address : str
        The page on the log: a player, the report, tables, and buttons that open other viewers.
    logs : tuple of str
        Addresses of the files of the log, its results included.
    layouts : dict of str to str
        Addresses of its layouts, by name.
    links : dict of str to str
        Addresses that open the log in "Lichtblick", with the first layout, and in "Foxglove".
    lichtblick : dict of str to str
        Addresses that open the log in Lichtblick, by layout.
    events : tuple of LinkedEvent
        Every identity switch and repair, in the order of time, with the address that opens it in Lichtblick.
    at_s : float
        The time at which viewers open, in seconds since the start of the log.
    notes : tuple of str
        Where viewers open and why, which layouts were edited, and where a viewer may have trouble with the pictures.
    warnings : tuple of mcaptrack.Notice
        What is assumed, and which layouts could not be read.

    Examples
    --------
    >>> import mcaptrack
    >>> with mcaptrack.view("log.mcap") as server:
    ...     sorted(server.links)
    ['Foxglove', 'Lichtblick']

    """

    def __init__(
        self, contents: _Contents, port: int | None, host: str, lichtblick: str, views: ExitStack | None = None
    ) -> None:
        files = dict(contents.files) | dict(contents.layouts.values()) | self._pages(contents)
        index = Page(partial(self._index, contents), policy("index.js", "frame-src 'self'"))
        try:
            self._server = Server(files, PORT if port is None else port, host=host, index=index)
        except McaptrackError:
            if port is not None:
                raise
            self._server = Server(files, 0, host=host, index=index)
        self._thread: threading.Thread | None = None
        self._views = views  # a temporary file with views that the log lacks
        self.address: str = self._server.root
        self.logs: tuple[str, ...] = tuple(self._server.address(name) for name in contents.files)
        self.layouts: dict[str, str] = {
            name: self._server.address(file) for name, (file, _) in contents.layouts.items()
        }
        first = next(iter(self.layouts.values()), None)

        def links_to(layout: str | None, at_ns: int) -> dict[str, str]:
            return viewer_links(self.logs, layout, lichtblick, at_ns if at_ns > contents.start_ns else None)

        self.lichtblick: dict[str, str] = {
            name: links_to(address, contents.at_ns)["Lichtblick"] for name, address in self.layouts.items()
        }
        self.links: dict[str, str] = links_to(first, contents.at_ns)
        of_events = self.layouts.get(links.EVENT_LAYOUT, first)
        self.events: tuple[LinkedEvent, ...] = tuple(
            event._replace(link=links_to(of_events, event.opens_ns(contents.start_ns))["Lichtblick"])
            for event in contents.events
        )
        self.at_s: float = contents.seconds(contents.at_ns)
        self.notes: tuple[str, ...] = contents.notes
        self.warnings: tuple[Notice, ...] = contents.warnings

    def _pages(self, contents: _Contents) -> dict[str, Page]:
        """Return our pages on a log, by name."""
        made = partial(_FromLog, contents.path)
        pages = {}
        for number, (_, camera, is_above) in enumerate(contents.views):
            entry, maker = log_player()
            player = answer_of(entry, LogPage, "page", maker.page, camera, is_above)
            pages[f"{_FOLDER}/player-{number}.html"] = Page(
                made(partial(answer_of, entry, _GIVEN["make"], "make", player.make)), player.policy
            )
        for name, page in contents.pages.items():
            pages[f"{_FOLDER}/{name}.html"] = Page(made(page.make), page.policy)
        for name in tables.TABLES:
            pages[f"{_FOLDER}/{name}.csv"] = Page(made(partial(_csv, name)), kind="text/csv; charset=utf-8")
        for viewer, why_not in contents.viewers.values():
            if not why_not:
                file = Page(made(viewer.make), kind="application/octet-stream", is_shared=True)
                pages[contents.path.stem + viewer.end] = file
        return pages

    def _index(self, contents: _Contents) -> bytes:
        """Return the first page."""
        offline = "needs a connection to the internet, and gets the log from this machine"
        linked = [
            (name, "" if why_not else viewer.link(self._server.address(contents.path.stem + viewer.end)), why_not)
            for name, (viewer, why_not) in contents.viewers.items()
        ]
        viewers = [
            {"name": name, "address": address, "about": about or f"{name} {offline}"}
            for name, address, about in (*((name, address, "") for name, address in self.links.items()), *linked)
        ]
        place = f"{self._server.path(_FOLDER).decode()}/"
        data = {
            "root": self._server.root,
            "start_ns": str(contents.start_ns),
            "at_s": self.at_s,
            "views": [
                {"name": name, "address": f"{place}player-{number}.html"}
                for number, (name, *_) in enumerate(contents.views)
            ],
            "pages": {name: f"{place}{name}.html" for name in contents.pages},
            "best": links.best_tracks(contents.events),
            "events": [
                {"at_s": contents.seconds(event.t_ns), "topic": event.topic, "text": _WHEN.sub("", event.text, count=1)}
                for event in contents.events
            ],
        }
        notes = [*contents.notes, *(notice.message for notice in contents.warnings)]
        page = render("index.html", title=contents.path.name, viewers=viewers, data=data, notes=notes)
        return page.encode()

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


@declared(heading="Start here", printed_by="mcaptrack.cli.show:ViewCommand")
def view(
    log: Annotated[PathLike, Argument("path", "LOG", "The log.", help="The log.")],
    *,
    at_s: Annotated[float | None, Option(_OPENED, 0, 1e9, flag="at")] = None,
    event: Annotated[int | None, Option(_OPENED, 1, 1e9, shown="none")] = None,
    layout: Annotated[PathLike | None, Option(_OPENED, metavar="NAME or FILE", shown="all of the log")] = None,
    port: Annotated[int | None, Option(_VIEWER, 0, 65535, shown=f"{PORT}, or any that is free")] = None,
    host: Annotated[str, Option(_VIEWER)] = LOOPBACK,
    lichtblick: Annotated[str, Option(_VIEWER)] = LICHTBLICK,
    browser: Annotated[bool, Option(_VIEWER, flag="open/no-open")] = False,
) -> LogServer:
    """Look at a log in the browser, with its tracks and events.

    The page has pictures, the ground from above, the report and the tables. Serves one page until Ctrl-C; it needs no
    connection. Three buttons open the log where it is shown in Lichtblick, Foxglove or Rerun, which read it from this
    machine. Layout files beside the log are served as they are, also while they are edited; in Foxglove import them
    (Layouts, Import from file). Only the log and what is made of it is served, and only to this machine; whoever works
    on it can open the page.

    Parameters
    ----------
    at_s : float, optional
        Open at this time of the log, in seconds; by default before the first identity switch or repair of the best
        tracks.

        Without any of these, where tracks are.
    event : int, optional
        Open before this event, by its number.

        Its place in ``LogServer.events``, from 1.
    layout : str or path, optional
        Open Lichtblick with this layout: tracking, comparing or predictions, or the layout in this file.
    port : int, optional
        Port to serve it at.
    host : str, default "127.0.0.1"
        Address to serve it at; 0.0.0.0 lets every machine of the network read the log.
    lichtblick : str, optional
        Address of Lichtblick, if you have installed it yourself.
    browser : bool, default False
        Open the page in the browser.

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
    path, notes = log_file(log), list[str]()
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
            notes.append(
                f"views that the log lacks are drawn in {[*files][-1]} for now; {call('run', path)} keeps them"
            )
        layouts = _chosen_layouts(path, opened, layout, made_layouts, notes)
        if not layouts:
            notes.append(f"viewers have no layout yet: {call('run', path)} makes one")
        events = links.find_moments(opened)
        at_ns, why = _opening(opened, events, at_s, event)
        if opened.start_ns or opened.end_ns:
            notes.append(f"viewers open at {links.seconds_of(opened, at_ns):.1f} s, {why}")
        _note_trouble(opened, notes)
        if not names("player"):
            notes.append(missing_extension("Player"))
        if host != LOOPBACK:
            warn(
                f"{path}: whoever reaches this machine at {host} can read the log and all that is made of it", "shared"
            )
        contents = _Contents(
            path, files, layouts, events, _views(shown), _parts("page"),
            {name: (viewer, _why_not(viewer, opened)) for name, viewer in _parts("viewer").items()},
            opened.start_ns, at_ns,
            tuple(notes), tuple(dict.fromkeys(warnings)),
        )  # fmt: skip
        server = LogServer(contents, port, host, lichtblick, stack.pop_all() if shown is not opened else None)
    if browser:
        webbrowser.open(server.address)
    return server


def _views(opened: logs.Log) -> list[tuple[str, str, bool]]:
    """Return what players show, the best first: a name, the camera, and whether it is seen from above."""
    of_cameras = cameras(opened) if names("player") else []
    pictures = [(camera.prefix, False) for camera in of_cameras if camera.pictures]
    above = [(camera.prefix, True) for camera in of_cameras if pipeline.views_from_above(opened, camera.prefix)]
    what_there_is = [*pictures, *above] or [(camera.prefix, False) for camera in of_cameras[:1]]
    sights = {False: "pictures", True: "from above"}
    return [
        (sights[is_above] if len(of_cameras) == 1 else f"{prefix.lstrip('/')}, {sights[is_above]}", prefix, is_above)
        for prefix, is_above in what_there_is
    ]


def _opening(opened: logs.Log, events: Sequence[LinkedEvent], at_s: float | None, event: int | None) -> tuple[int, str]:
    """Return the log time in ns at which viewers open, and why. Raises McaptrackError if the log has no such time."""
    if at_s is not None:
        length_s = links.seconds_of(opened, opened.end_ns)
        if at_s > length_s:
            raise McaptrackError(f"{opened.path} lasts {length_s:.1f} s, so viewers can't open it at {at_s:g} s")
        return opened.start_ns + round(at_s * NS_PER_S), "as asked"
    if event is not None:
        chosen = links.event_of(opened, events, event)
        return chosen.opens_ns(opened.start_ns), f"before event {event} ({chosen.text})"
    return links.opening_moment(opened, events)


def _note_trouble(opened: logs.Log, notes: list[str]) -> None:
    """Say where viewers may have trouble with the pictures of a log, and what helps."""
    from mcaptrack.sources.video import WORDS

    topics: dict[str, list[str]] = {}
    for topic, codec in links.video_formats(opened).items():
        topics.setdefault(codec, []).append(topic)
    again = call("ingest", Path("VIDEO"), image_format="jpeg")
    for codec, those in topics.items():
        trouble = f"pictures in {', '.join(those)} are {WORDS[codec]}"
        if codec == "h264":
            notes.append(
                f"{trouble}: on a slow machine Lichtblick may show none while it is paused, and late ones during play. "
                f"A log made by {again} doesn't have this, and is larger"
            )
        else:
            notes.append(f"{trouble}, which Lichtblick doesn't play; a log made by {again} can be seen everywhere")


def _chosen_layouts(
    path: Path, opened: logs.Log, chosen: PathLike | None, made_layouts: Mapping[str, bytes], notes: list[str]
) -> dict[str, tuple[str, Path | bytes]]:
    """Return the layouts to serve by name: the name of each file, and its content or path."""
    if chosen is not None and str(chosen) not in LAYOUTS and _is_file_name(chosen):
        file = as_path(chosen)
        read_json(file, "a layout", _MOST_BYTES)
        return {file.stem.removesuffix(".layout"): (f"{file.stem}.json", file)}
    layouts = _layouts(path, opened, made_layouts, notes)
    if chosen is not None and str(chosen) not in layouts:
        every = offer(str(chosen), layouts)
        raise McaptrackError(f"{path} has no layout {chosen}; {every}. A file of a layout ends with .json")
    return {
        name: (layout_path(path, name).name, content)
        for name, content in layouts.items()
        if chosen is None or name == str(chosen)
    }


def _is_file_name(chosen: PathLike) -> bool:
    """Return whether a layout is named by its file."""
    return Path(chosen).suffix.lower() == ".json" or len(Path(chosen).parts) > 1 or Path(chosen).is_file()


def _layouts(
    path: Path, opened: logs.Log, made_layouts: Mapping[str, bytes], notes: list[str]
) -> dict[str, Path | bytes]:
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
            notes.append(f"{file} differs from the layout in the log; the file is served")
    return layouts
