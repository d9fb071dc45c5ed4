"""Logs for viewers in a browser: a few files by HTTP, to this machine alone.

Viewers read a log in ranges and from another origin, so ranges and CORS are what this is about. Addresses begin with a
word that nobody can guess, because any page that a browser has open could ask otherwise; and nothing is served but the
files that were named.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Mapping
from email.utils import formatdate
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Final
from urllib.parse import quote, urlsplit

from mcaptrack.errors import McaptrackError

LOOPBACK: Final = "127.0.0.1"
_RANGE: Final = re.compile(r"bytes=(\d*)-(\d*)")
_BLOCK: Final = 2**20


class Server(ThreadingHTTPServer):
    """Serves files and texts by the names that they are given. ``port`` 0 is any that is free.

    Raises McaptrackError if the port is taken.
    """

    daemon_threads = True

    def __init__(self, served: Mapping[str, Path | bytes], port: int = 0) -> None:
        self._word = secrets.token_urlsafe(12)
        self.served = {f"/{self._word}/{quote(name)}": content for name, content in served.items()}
        try:
            super().__init__((LOOPBACK, port), _Handler)
        except (OSError, OverflowError) as error:
            why = error.strerror if isinstance(error, OSError) else "there is no such port"
            raise McaptrackError(f"port {port} of this machine can't be used: {why}; choose another") from None

    def address(self, name: str) -> str:
        """Where a viewer finds what has that name."""
        return f"http://{LOOPBACK}:{self.server_port}/{self._word}/{quote(name)}"


class _Handler(BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "mcaptrack", ""

    def do_GET(self) -> None:
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        self._answer(with_body=False)

    def do_OPTIONS(self) -> None:
        self._head(HTTPStatus.NO_CONTENT, {"Content-Length": "0"})

    def log_message(self, format: str, *words: object) -> None:  # noqa: A002  # the name that the library gives it
        """Say nothing."""

    def _answer(self, with_body: bool) -> None:
        host = urlsplit(f"//{self.headers.get('Host', '')}").hostname
        content = self.server.served.get(urlsplit(self.path).path)
        if host not in (LOOPBACK, "localhost") or content is None:
            self._head(HTTPStatus.NOT_FOUND, {"Content-Length": "0"})
            return
        if isinstance(content, bytes):
            kind = {"Content-Type": "application/json", "Content-Length": str(len(content))}
            self._head(HTTPStatus.OK, kind)
            self.wfile.write(content if with_body else b"")
            return
        try:
            with content.open("rb") as stream:
                there = content.stat()
                span, status = self._span(there.st_size)
                headers = {
                    "Content-Type": "application/octet-stream",
                    "Content-Length": str(len(span)),
                    "ETag": f'"{there.st_size:x}-{there.st_mtime_ns:x}"',
                    "Last-Modified": formatdate(there.st_mtime, usegmt=True),
                }
                if status == HTTPStatus.PARTIAL_CONTENT:
                    headers["Content-Range"] = f"bytes {span.start}-{span.stop - 1}/{there.st_size}"
                elif status == HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
                    headers["Content-Range"] = f"bytes */{there.st_size}"
                self._head(status, headers)
                stream.seek(span.start)
                left = len(span) if with_body else 0
                while left and (block := stream.read(min(left, _BLOCK))):
                    self.wfile.write(block)
                    left -= len(block)
                self.close_connection |= bool(left)  # it became shorter: what was announced can't come any more
        except FileNotFoundError:
            self._head(HTTPStatus.NOT_FOUND, {"Content-Length": "0"})
        except (BrokenPipeError, ConnectionResetError):  # viewers stop reading when they have seen enough
            self.close_connection = True

    def _span(self, size: int) -> tuple[range, HTTPStatus]:
        """The bytes that are asked for; all of them for anything but one range."""
        asked = _RANGE.fullmatch(self.headers.get("Range", "").replace(" ", ""))
        if asked is None or not any(asked.groups()):
            return range(size), HTTPStatus.OK
        first, last = asked.groups()
        if not first:
            start, stop = max(0, size - int(last)), size
        else:
            start, stop = int(first), min(size, int(last) + 1) if last else size
        if start >= stop:
            wrong = bool(last) and bool(first) and int(last) < int(first)
            return (range(size), HTTPStatus.OK) if wrong else (range(0), HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
        return range(start, stop), HTTPStatus.PARTIAL_CONTENT

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
