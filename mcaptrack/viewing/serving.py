"""Serve logs to viewers in a browser: a few files by HTTP, only on this machine.

Viewers read ranges of a log from another origin, so the server supports ranges and CORS. Addresses begin with a secret
word, because any page in a browser could send requests. Only the given files are served.

Requests follow RFC 9110 and RFC 9112: malformed ones get 400, and their connection is closed.
"""

from __future__ import annotations

import io
import os
import re
import secrets
import socket
import stat
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from email.utils import formatdate
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from time import monotonic
from typing import Any, BinaryIO, Final
from urllib.parse import quote, unquote_to_bytes

from mcaptrack.errors import McaptrackError

LOOPBACK: Final = "127.0.0.1"
_LOCAL: Final = (LOOPBACK, "localhost")
_TOKEN: Final = re.compile(r"[!#$%&'*+.^_`|~0-9A-Za-z-]+")
_VALUE: Final = re.compile(r"[\t\x20-\x7e\x80-\xff]*")
_AUTHORITY: Final = re.compile(r"([0-9A-Za-z._~!$&'()*+,;=%-]+|\[[0-9A-Fa-f:.]+\])(?::[0-9]{0,5})?")
_ABSOLUTE: Final = re.compile(r"http://([^/?#]*)(/[^#]*)?", re.IGNORECASE)
_RANGES: Final = re.compile(r"bytes=(.*)", re.IGNORECASE)
_RANGE: Final = re.compile(r"([0-9]*)-([0-9]*)")
_POLICY: Final = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
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


class Server(ThreadingHTTPServer):
    """Serves files and bytes under their names. ``port`` 0 is any free port.

    Raises McaptrackError if the port is taken.
    """

    daemon_threads = True
    request_queue_size = 128

    def __init__(self, served: Mapping[str, Path | bytes], port: int = 0, limits: Limits = Limits()) -> None:
        self._word = secrets.token_urlsafe(12)
        self.limits = limits
        self.served = {f"/{self._word}/".encode() + os.fsencode(name): content for name, content in served.items()}
        self._lock = threading.Lock()
        #: The open connections, and the time since which each is idle; None while a request is answered.
        self._idle_since: dict[socket.socket, float | None] = {}
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except (OSError, OverflowError) as error:
            why = error.strerror if isinstance(error, OSError) else "there is no such port"
            raise McaptrackError(f"port {port} of this machine can't be used: {why}; choose another") from None

    def address(self, name: str) -> str:
        """The address of a file."""
        return f"http://{LOOPBACK}:{self.server_port}/{self._word}/{quote(os.fsencode(name))}"

    def add(self, name: str, content: bytes) -> str:
        """Serve one more file; returns its address."""
        self.served[f"/{self._word}/".encode() + os.fsencode(name)] = content
        return self.address(name)

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


def _kind_of(name: str) -> dict[str, str]:
    """The fields that say what a file is. Pages may load and run nothing, whoever made them."""
    if name.endswith(".html"):
        return {"Content-Type": "text/html; charset=utf-8", "Content-Security-Policy": _POLICY}
    return {"Content-Type": "application/json" if name.endswith(".json") else "application/octet-stream"}


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
        # A page from a name that resolves to this machine (DNS rebinding) sends that name.
        is_local = named and all(name is not None and name[1].lower() in _LOCAL for name in named)
        return None if is_local else HTTPStatus.NOT_FOUND

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def do_OPTIONS(self) -> None:
        self._head(HTTPStatus.NO_CONTENT, {})

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer with a status, and close the connection."""
        self.request_version = "HTTP/1.1"  # in 0.9 there would be no status
        self._head(HTTPStatus(code), {"Content-Length": "0", "Connection": "close"})

    def log_message(self, format: str, *values: object) -> None:  # noqa: A002  # the name that the library gives it
        """Print nothing."""

    def _answer(self, with_body: bool) -> None:
        content = self.server.served.get(unquote_to_bytes(self.path.partition("?")[0].encode("latin-1")))
        if content is None:
            self._head(HTTPStatus.NOT_FOUND, {"Content-Length": "0"})
        elif isinstance(content, bytes):
            name = self.path.partition("?")[0]
            self._head(HTTPStatus.OK, {**_kind_of(name), "Content-Length": str(len(content))})
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
            **_kind_of(path.name if path.suffix == ".json" else ""),
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

    def _head(self, status: HTTPStatus, headers: Mapping[str, str]) -> None:
        self.send_response(status)
        shared = {
            "Accept-Ranges": "bytes",
            "Access-Control-Allow-Origin": "*",
            "Access-Control-Allow-Methods": "GET, HEAD, OPTIONS",
            "Access-Control-Allow-Headers": "Range, If-Range",
            "Access-Control-Allow-Private-Network": "true",
            "Access-Control-Expose-Headers": "Accept-Ranges, Content-Length, Content-Range, ETag",
            "Cache-Control": "no-store",
        }
        for name, value in {**shared, **headers}.items():
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
