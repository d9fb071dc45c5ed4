"""Logs for viewers in a browser: a few files by HTTP, to this machine alone.

Viewers read a log in ranges and from another origin, so ranges and CORS are what this is about. Addresses begin with a
secret word, because any page that a browser has open could ask otherwise. Only the files that were named are served.

Requests are taken as RFC 9110 and RFC 9112 define them: what is malformed gets 400, and its connection is closed.
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
#: More digits than any size of a file has.
_MANY_DIGITS: Final = 20


@dataclass(frozen=True)
class Limits:
    """How long and how many. Times are in seconds.

    ``connections`` at once; one more takes the place of the one that has waited longest for its next request.
    ``head_s`` for all lines of a request, ``idle_s`` for the next request of a connection, ``stall_s`` for a viewer to
    take some of an answer.
    """

    connections: int = 64
    head_s: float = 10.0
    idle_s: float = 60.0
    stall_s: float = 60.0


class Server(ThreadingHTTPServer):
    """Serves files and texts by the names that they are given. ``port`` 0 is any that is free.

    Raises McaptrackError if the port is taken.
    """

    daemon_threads = True
    request_queue_size = 128

    def __init__(self, served: Mapping[str, Path | bytes], port: int = 0, limits: Limits = Limits()) -> None:
        self._word = secrets.token_urlsafe(12)
        self.limits = limits
        self.served = {f"/{self._word}/".encode() + os.fsencode(name): content for name, content in served.items()}
        self._lock = threading.Lock()
        #: The open connections, and since when each waits for a request; None while it is answered.
        self._idle_since: dict[socket.socket, float | None] = {}
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except (OSError, OverflowError) as error:
            why = error.strerror if isinstance(error, OSError) else "there is no such port"
            raise McaptrackError(f"port {port} of this machine can't be used: {why}; choose another") from None

    def address(self, name: str) -> str:
        """Where a viewer finds what has that name."""
        return f"http://{LOOPBACK}:{self.server_port}/{self._word}/{quote(os.fsencode(name))}"

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread, unless too many connections are being answered."""
        with self._lock:
            if len(self._idle_since) >= self.limits.connections and not self._end_one():
                _refuse(request)
                return
            self._idle_since[request] = monotonic()
        super().process_request(request, client_address)

    def _end_one(self) -> bool:
        """End the connection that has waited longest for its next request; False if all are being answered."""
        waiting = {connection: since for connection, since in self._idle_since.items() if since is not None}
        if not waiting:
            return False
        longest = min(waiting, key=waiting.__getitem__)
        del self._idle_since[longest]
        _end(longest)
        return True

    def waits(self, connection: socket.socket, is_idle: bool) -> None:
        """Note whether a connection waits for a request or is answered."""
        with self._lock:
            if connection in self._idle_since:
                self._idle_since[connection] = monotonic() if is_idle else None

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._lock:
            self._idle_since.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Viewers hang up when they have seen enough, and other threads end connections; that is no fault."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)

    def server_close(self) -> None:
        """Stop listening, and end all connections."""
        super().server_close()
        with self._lock:
            for connection in self._idle_since:
                _end(connection)


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
    """What a connection sends until a moment; TimeoutError after it, also if bytes come one by one."""

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
        """Why a request isn't answered, as a status. A request with content isn't: what follows may be anything."""
        if not self.request_version.startswith("HTTP/1."):
            return HTTPStatus.HTTP_VERSION_NOT_SUPPORTED
        fields = self.headers.items()
        # The parser is one of mail, which takes a first line for an envelope.
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
        # A page whose name was made to point to this machine sends that name.
        is_local = named and all(name is not None and name[1].lower() in _LOCAL for name in named)
        return None if is_local else HTTPStatus.NOT_FOUND

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def do_OPTIONS(self) -> None:
        self._head(HTTPStatus.NO_CONTENT, {})

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer with a status alone, and close the connection."""
        self.request_version = "HTTP/1.1"  # 0.9 would get no status
        self._head(HTTPStatus(code), {"Content-Length": "0", "Connection": "close"})

    def log_message(self, format: str, *words: object) -> None:  # noqa: A002  # the name that the library gives it
        """Say nothing."""

    def _answer(self, with_body: bool) -> None:
        content = self.server.served.get(unquote_to_bytes(self.path.partition("?")[0].encode("latin-1")))
        if content is None:
            self._head(HTTPStatus.NOT_FOUND, {"Content-Length": "0"})
        elif isinstance(content, bytes):
            self._head(HTTPStatus.OK, {"Content-Type": "application/json", "Content-Length": str(len(content))})
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
        there = os.fstat(stream.fileno())
        tag = f'"{there.st_size:x}-{there.st_mtime_ns:x}"'
        span, status = range(there.st_size), HTTPStatus.OK
        if with_body and self.headers.get("If-Range", tag).strip(" \t") == tag:  # ranges are for GET alone
            span, status = requested_range(self.headers.get_all("Range", []), there.st_size)
        headers = {
            "Content-Type": "application/json" if path.suffix == ".json" else "application/octet-stream",
            "Content-Length": str(len(span)),
            "ETag": tag,
            "Last-Modified": formatdate(there.st_mtime, usegmt=True),
        }
        if status == HTTPStatus.PARTIAL_CONTENT:
            headers["Content-Range"] = f"bytes {span.start}-{span.stop - 1}/{there.st_size}"
        elif status == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            headers["Content-Range"] = f"bytes */{there.st_size}"
        self._head(status, headers)
        if with_body and span:
            try:
                sent = self.connection.sendfile(stream, span.start, len(span))
            except OSError:  # the disk's or the viewer's: what was announced can't come any more
                sent = 0
            self.close_connection |= sent < len(span)  # it became shorter

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
    """A file, open. Raises OSError for anything else: to open a pipe would wait for who writes to it."""
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise FileNotFoundError(path)
    return os.fdopen(descriptor, "rb")


def requested_range(fields: list[str], size: int) -> tuple[range, HTTPStatus]:
    """Which bytes of ``size`` the values of a Range field ask for, and the status of the answer, by RFC 9110, 14.

    The whole with 200 for no field, a malformed one, another unit, and several satisfiable ranges (which a server may
    ignore); nothing with 416 where no range begins within the file.
    """
    whole = range(size), HTTPStatus.OK
    asked = _RANGES.fullmatch(fields[0].strip(" \t")) if len(fields) == 1 else None
    if asked is None:
        return whole
    found = []
    for text in filter(None, (text.strip(" \t") for text in asked[1].split(","))):
        spec = _RANGE.fullmatch(text)
        if spec is None or not any(spec.groups()):
            return whole
        first, last = (_number(digits) if digits else None for digits in spec.groups())
        if first is None:
            found.append(range(max(0, size - (last or 0)), size))
        elif last is not None and last < first:
            return whole
        else:
            found.append(range(first, size if last is None else min(size, last + 1)))
    satisfiable = [span for span in found if len(span)]
    if not found:
        return whole
    if not satisfiable:
        return range(0), HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE
    return (satisfiable[0], HTTPStatus.PARTIAL_CONTENT) if len(satisfiable) == 1 else whole


def _number(digits: str) -> int:
    """A decimal number of any length; above all sizes for one that is too long to be one."""
    digits = digits.lstrip("0") or "0"
    return int(digits) if len(digits) < _MANY_DIGITS else 10**_MANY_DIGITS
