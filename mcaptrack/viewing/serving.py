"""Serve logs to viewers in a browser: a few files by HTTP, on this machine unless another address is given.

Viewers read ranges of a log from another origin, so files have ranges and CORS, and addresses with a secret word,
because any page in a browser could send requests. Our own pages have neither CORS nor secrets that other origins could
read: the first one, at ``/``, has an address that anyone can remember. Only what is given is served.

Requests follow RFC 9110 and RFC 9112: malformed ones get 400, and their connection is closed.
"""

from __future__ import annotations

import io
import ipaddress
import os
import re
import secrets
import socket
import stat
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from contextvars import copy_context
from dataclasses import dataclass
from email.utils import formatdate
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socketserver import TCPServer
from time import monotonic
from typing import Any, BinaryIO, Final, NamedTuple
from urllib.parse import quote, unquote_to_bytes

from mcaptrack.errors import McaptrackError
from mcaptrack.installed import missing_extension
from mcaptrack.log import Log
from mcaptrack.registry import Entry, find, names

__all__ = ["AS_MANY_AS_FIT", "LOOPBACK", "Choice", "LogPage", "Page", "Server", "WebViewer"]

LOOPBACK: Final = "127.0.0.1"
_LOCAL: Final = (LOOPBACK, "localhost")
#: The hosts that stand for all addresses of this machine.
_ANY: Final = ("", "0.0.0.0", "::")  # noqa: S104  # named, not used unless it is asked for
_TOKEN: Final = re.compile(r"[!#$%&'*+.^_`|~0-9A-Za-z-]+")
_VALUE: Final = re.compile(r"[\t\x20-\x7e\x80-\xff]*")
_AUTHORITY: Final = re.compile(r"([0-9A-Za-z._~!$&'()*+,;=%-]+|\[[0-9A-Fa-f:.]+\])(?::[0-9]{0,5})?")
_ABSOLUTE: Final = re.compile(r"http://([^/?#]*)(/[^#]*)?", re.IGNORECASE)
_RANGES: Final = re.compile(r"bytes=(.*)", re.IGNORECASE)
_RANGE: Final = re.compile(r"([0-9]*)-([0-9]*)")
#: What no other origin may do with our pages: read, load or frame them, or learn their address.
_OURS: Final = {
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}
#: What any origin may read if it knows the address.
_SHARED: Final = {
    "Accept-Ranges": "bytes",
    "Access-Control-Allow-Origin": "*",
    "Access-Control-Allow-Methods": "GET, HEAD, OPTIONS",
    "Access-Control-Allow-Headers": "Range, If-Range",
    "Access-Control-Allow-Private-Network": "true",
    "Access-Control-Expose-Headers": "Accept-Ranges, Content-Length, Content-Range, ETag",
}
_TEXT: Final = "text/plain; charset=utf-8"
#: More digits than the size of any file has.
_MANY_DIGITS: Final = 20


@dataclass(frozen=True)
class Limits:
    """Limits of connections; times are in seconds.

    ``connections`` is the largest number at once; a further one replaces the one that is idle for the longest time.
    ``head_s`` is the time for all lines of a request, ``idle_s`` the time until the next request of a connection,
    ``stall_s`` the time in which a viewer must take a part of an answer.
    """

    connections: int = 64
    head_s: float = 10.0
    idle_s: float = 60.0
    stall_s: float = 60.0


@dataclass(frozen=True)
class Page:
    """A page of ours or a file to download: ``content`` makes it when it is asked for, ``policy`` says what it may load
    and run (a Content-Security-Policy). ``is_shared``: other origins may read it, as they may read files.
    ``is_action``: ``content`` changes something, so only POST does it: no link does, and no preview of one.

    ``kind`` is the type of the content, as in text/html.
    """

    content: Callable[[], bytes | None]
    policy: str = "default-src 'none'"
    kind: str = "text/html; charset=utf-8"
    is_shared: bool = False
    is_action: bool = False


class LogPage(NamedTuple):
    """A page about a log that `mcaptrack view` shows: what makes it of an open log, and its ``policy`` as of a page."""

    make: Callable[[Log], bytes]
    policy: str


class WebViewer(NamedTuple):
    """A viewer on the web that `mcaptrack view` links. It opens a file with a name that ends with ``end``.

    ``make`` makes the file of an open log, ``link`` is the address that opens the file at an address. ``why_not`` says
    why there is no file of a log; "" if there is one.
    """

    end: str
    make: Callable[[Log], bytes]
    link: Callable[[str], str]
    why_not: Callable[[Log], str]


class Choice(NamedTuple):
    """Which pictures: from ``start_s`` to ``end_s`` (None: the end) every ``every``-th (None: as many as fit).

    ``width_px`` is their width in pixels; None stands for a usual one.
    """

    start_s: float = 0.0
    end_s: float | None = None
    every: int | None = None
    width_px: int | None = None


AS_MANY_AS_FIT: Final = Choice()


def log_player() -> tuple[Entry, Any]:
    """The maker of players of logs, that of the first entry point. Raises McaptrackError if there is none."""
    if not names("player"):
        raise McaptrackError(missing_extension("Player"))
    entry = find("player", names("player")[0])
    return entry, entry.made("show", "page")


#: What is served: a file, the content of one, or a page.
Served = Path | bytes | Page


class Server(ThreadingHTTPServer):
    """Serves files, bytes and pages under their names, and ``index`` at ``/``. ``port`` 0 is any free port.

    Raises McaptrackError if the port is taken, or if the machine has no such address as ``host``.
    """

    daemon_threads = True
    request_queue_size = 128

    def __init__(
        self,
        served: Mapping[str, Served],
        port: int = 0,
        limits: Limits = Limits(),
        host: str = LOOPBACK,
        index: Page | None = None,
    ) -> None:
        self._word = secrets.token_urlsafe(12)
        #: Pages are made as the server was: their warnings go to its listener, and commands are spelled alike.
        self._context = copy_context()
        self.limits, self.host = limits, host
        self.served: dict[bytes, Served] = {self.path(name): content for name, content in served.items()}
        self.served |= {b"/": index} if index else {}
        self._lock = threading.Lock()
        #: The open connections, and the time since which each is idle; None while a request is answered.
        self._idle_since: dict[socket.socket, float | None] = {}
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            super().__init__((host, port), _Handler)
        except socket.gaierror as error:
            raise McaptrackError(f"this machine has no address {host}: {error.strerror}") from None
        except (OSError, OverflowError) as error:
            why = error.strerror if isinstance(error, OSError) else "there is no such port"
            raise McaptrackError(f"port {port} of this machine can't be used: {why}; choose another") from None

    def server_bind(self) -> None:
        """Bind the socket; the library would also ask for the name of the host, which may take long."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = self.host, self.server_address[1]

    @property
    def root(self) -> str:
        """The address of the first page, as this machine opens it."""
        shown = LOOPBACK if self.host in _ANY else f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{shown}:{self.server_port}/"

    def path(self, name: str) -> bytes:
        """The path of a file, with the secret word."""
        return f"/{self._word}/".encode() + os.fsencode(name)

    def address(self, name: str) -> str:
        """The address of a file."""
        return f"{self.root}{self._word}/{quote(os.fsencode(name))}"

    def is_host(self, name: str) -> bool:
        """Return whether a request may name its host so.

        A page from a name that resolves to this machine (DNS rebinding) sends that name, and never a number.
        """
        if name in _LOCAL:
            return True
        if self.host == LOOPBACK:
            return False
        try:
            return bool(ipaddress.ip_address(name.strip("[]")))
        except ValueError:
            return name in (self.host.lower(), socket.gethostname().lower())

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread, unless all connections are in use."""
        with self._lock:
            if len(self._idle_since) >= self.limits.connections and not self._end_one():
                _refuse(request)
                return
            self._idle_since[request] = monotonic()
        super().process_request(request, client_address)

    def _end_one(self) -> bool:
        """Close the connection that is idle for the longest time; False if none is idle."""
        waiting = {connection: since for connection, since in self._idle_since.items() if since is not None}
        if not waiting:
            return False
        longest = min(waiting, key=waiting.__getitem__)
        del self._idle_since[longest]
        _end(longest)
        return True

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer in this thread, in the context of the server."""
        self._context.copy().run(super().process_request_thread, request, client_address)

    def waits(self, connection: socket.socket, is_idle: bool) -> None:
        """Note whether a connection is idle."""
        with self._lock:
            if connection in self._idle_since:
                self._idle_since[connection] = monotonic() if is_idle else None

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._idle_since.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report errors, except those of connections that viewers or other threads closed."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)

    def server_close(self) -> None:
        """Stop listening, and close all connections."""
        super().server_close()
        with self._lock:
            for connection in self._idle_since:
                _end(connection)


def _kind_of(name: str) -> str:
    """The kind of a file: nothing that a browser would show or run."""
    return "application/json" if name.endswith(".json") else "application/octet-stream"


def _end(connection: socket.socket) -> None:
    """Wake the thread that reads from a connection or writes to it; the thread closes it."""
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


def _refuse(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.settimeout(0)
        connection.send(b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nContent-Length: 0\r\n\r\n")
    _end(connection)
    connection.close()


class _Incoming(io.RawIOBase):
    """The bytes of a connection until a deadline; then TimeoutError, also if bytes arrive one by one."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._until = 0.0

    def within(self, seconds: float) -> None:
        self._until = monotonic() + seconds

    def readable(self) -> bool:
        return True

    def readinto(self, room: Any) -> int:
        left = self._until - monotonic()
        if left <= 0:
            raise TimeoutError
        self._connection.settimeout(left)
        return self._connection.recv_into(room)


class _Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "mcaptrack", ""

    def setup(self) -> None:
        super().setup()
        self.rfile.close()
        self._incoming = _Incoming(self.connection)
        self._requests = io.BufferedReader(self._incoming)
        self.rfile = self._requests

    def handle_one_request(self) -> None:
        self.server.waits(self.connection, is_idle=True)
        self._incoming.within(self.server.limits.idle_s)
        if not self._requests.peek(1):
            self.close_connection = True
            return
        self.server.waits(self.connection, is_idle=False)
        self._incoming.within(self.server.limits.head_s)
        super().handle_one_request()

    def parse_request(self) -> bool:
        if not super().parse_request():
            return False
        status = self._objection()
        self.connection.settimeout(self.server.limits.stall_s)
        if status is not None:
            self.send_error(status)
        return status is None

    def handle_expect_100(self) -> bool:
        return True  # the final status follows at once: no content is taken

    def _objection(self) -> HTTPStatus | None:
        """The status with which a request is refused, if it is. Requests with content are: none of ours have any."""
        if not self.request_version.startswith("HTTP/1."):
            return HTTPStatus.HTTP_VERSION_NOT_SUPPORTED
        fields = self.headers.items()
        # The parser is made for mail, and takes a first line "From ..." for an envelope.
        if self.headers.defects or self.headers.get_unixfrom():
            return HTTPStatus.BAD_REQUEST
        if not all(_TOKEN.fullmatch(name) and _VALUE.fullmatch(value) for name, value in fields):
            return HTTPStatus.BAD_REQUEST
        hosts = [value.strip(" \t") for name, value in fields if name.lower() == "host"]
        if len(hosts) > 1 or (not hosts and self.request_version != "HTTP/1.0"):
            return HTTPStatus.BAD_REQUEST
        absolute = _ABSOLUTE.fullmatch(self.path)
        if absolute:
            hosts, self.path = [*hosts, absolute[1]], absolute[2] or "/"
        named = [_AUTHORITY.fullmatch(host) for host in hosts]
        if any(name is None for name in named) or not (self.path.startswith("/") or self.path == "*"):
            return HTTPStatus.BAD_REQUEST
        lengths = [value.strip(" \t") for name, value in fields if name.lower() == "content-length"]
        if "Transfer-Encoding" in self.headers or any(not re.fullmatch("0+", length) for length in lengths):
            return HTTPStatus(413)
        is_ours = named and all(name is not None and self.server.is_host(name[1].lower()) for name in named)
        return None if is_ours else HTTPStatus.NOT_FOUND

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def do_POST(self) -> None:
        self._answer(with_body=True)

    def do_OPTIONS(self) -> None:
        self._head(HTTPStatus.NO_CONTENT, {})

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer with a status, and close the connection."""
        self.request_version = "HTTP/1.1"  # in 0.9 there would be no status
        self._head(HTTPStatus(code), {"Content-Length": "0", "Connection": "close"})

    def log_message(self, format: str, *values: object) -> None:  # noqa: A002  # the name that the library gives it
        """Print nothing."""

    def _answer(self, with_body: bool) -> None:
        name = self.path.partition("?")[0]
        content = self.server.served.get(unquote_to_bytes(name.encode("latin-1")))
        is_action = isinstance(content, Page) and content.is_action
        if self.command == "POST" and not is_action:
            self.send_error(HTTPStatus.NOT_IMPLEMENTED)
        elif is_action and self.command != "POST":
            self._head(HTTPStatus.METHOD_NOT_ALLOWED, {"Allow": "POST", "Content-Length": "0"}, _OURS)
        elif content is None:
            self._head(HTTPStatus.NOT_FOUND, {"Content-Length": "0"})
        elif isinstance(content, Page):
            status, kind = HTTPStatus.OK, content.kind
            try:
                body = content.content() or b""
            except McaptrackError as error:
                status, kind, body = HTTPStatus.INTERNAL_SERVER_ERROR, _TEXT, str(error).encode()
            policy = f"{content.policy}; frame-ancestors 'self'"
            about = {"Content-Type": kind, "Content-Security-Policy": policy, "Content-Length": str(len(body))}
            self._head(status, about, _SHARED if content.is_shared else _OURS)
            self.wfile.write(body if with_body else b"")
        elif isinstance(content, bytes):
            self._head(HTTPStatus.OK, {"Content-Type": _kind_of(name), "Content-Length": str(len(content))})
            self.wfile.write(content if with_body else b"")
        else:
            try:
                stream = _regular(content)
            except OSError as error:
                is_there = not isinstance(error, FileNotFoundError)
                status = HTTPStatus.INTERNAL_SERVER_ERROR if is_there else HTTPStatus.NOT_FOUND
                self._head(status, {"Content-Length": "0"})
                return
            with stream:
                self._send(stream, content, with_body)

    def _send(self, stream: BinaryIO, path: Path, with_body: bool) -> None:
        status_of_file = os.fstat(stream.fileno())
        tag = f'"{status_of_file.st_size:x}-{status_of_file.st_mtime_ns:x}"'
        span, status = range(status_of_file.st_size), HTTPStatus.OK
        if with_body and self.headers.get("If-Range", tag).strip(" \t") == tag:  # only GET has ranges
            span, status = requested_range(self.headers.get_all("Range", []), status_of_file.st_size)
        headers = {
            "Content-Type": _kind_of(path.name),
            "Content-Length": str(len(span)),
            "ETag": tag,
            "Last-Modified": formatdate(status_of_file.st_mtime, usegmt=True),
        }
        if status == HTTPStatus.PARTIAL_CONTENT:
            headers["Content-Range"] = f"bytes {span.start}-{span.stop - 1}/{status_of_file.st_size}"
        elif status == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            headers["Content-Range"] = f"bytes */{status_of_file.st_size}"
        self._head(status, headers)
        if with_body and span:
            try:
                sent = self.connection.sendfile(stream, span.start, len(span))
            except OSError:  # the disk or the viewer failed: the announced bytes can't follow
                sent = 0
            self.close_connection |= sent < len(span)  # the file became shorter

    def _head(self, status: HTTPStatus, headers: Mapping[str, str], origins: Mapping[str, str] = _SHARED) -> None:
        self.send_response(status)
        always = {"Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
        for name, value in {**origins, **always, **headers}.items():
            self.send_header(name, value)
        self.end_headers()


def _regular(path: Path) -> BinaryIO:
    """Open a regular file. Raises OSError for anything else: opening a pipe would wait for a writer."""
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise FileNotFoundError(path)
    return os.fdopen(descriptor, "rb")


def requested_range(fields: list[str], size: int) -> tuple[range, HTTPStatus]:
    """The bytes of a file of ``size`` that the values of a Range field ask for, and the status, by RFC 9110, 14.

    The whole file with 200 for no field, a malformed one, another unit, and several satisfiable ranges (which a server
    may ignore); nothing with 416 if no range begins within the file.
    """
    whole = range(size), HTTPStatus.OK
    asked = _RANGES.fullmatch(fields[0].strip(" \t")) if len(fields) == 1 else None
    if asked is None:
        return whole
    spans = []
    for text in filter(None, (text.strip(" \t") for text in asked[1].split(","))):
        spec = _RANGE.fullmatch(text)
        if spec is None or not any(spec.groups()):
            return whole
        first, last = (_number(digits) if digits else None for digits in spec.groups())
        if first is None:
            spans.append(range(max(0, size - (last or 0)), size))
        elif last is not None and last < first:
            return whole
        else:
            spans.append(range(first, size if last is None else min(size, last + 1)))
    satisfiable = [span for span in spans if len(span)]
    if not spans:
        return whole
    if not satisfiable:
        return range(0), HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE
    return (satisfiable[0], HTTPStatus.PARTIAL_CONTENT) if len(satisfiable) == 1 else whole


def _number(digits: str) -> int:
    """A decimal number of any length; numbers with too many digits become larger than any size."""
    digits = digits.lstrip("0") or "0"
    return int(digits) if len(digits) < _MANY_DIGITS else 10**_MANY_DIGITS
