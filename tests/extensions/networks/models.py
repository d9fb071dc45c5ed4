"""A catalogue with one small network, and a server that has its file."""

from __future__ import annotations

import contextlib
import gzip
import hashlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from time import sleep
from types import MappingProxyType
from typing import Any

from mcaptrack.extensions.networks import catalogue
from mcaptrack.extensions.networks.catalogue import Model
from tests.extensions.networks.onnx_graphs import detector

DATA = detector("yolox")
NAME = "yolox-nano"


class Handler(BaseHTTPRequestHandler):
    """Gives the network, or what is wrong, by the name of the file."""

    def do_GET(self) -> None:  # the name that the server calls
        if self.path in ("/slow.onnx", "/endless.onnx", "/packed.onnx"):
            self.give(self.path)
            return
        status, data, length = {
            "/network.onnx": (200, DATA, len(DATA)), "/other.onnx": (200, DATA[:-1] + b"x", len(DATA)),
            "/short.onnx": (200, DATA[:100], 100), "/broken.onnx": (200, DATA[:100], len(DATA)),
            "/long.onnx": (200, DATA + bytes(10**6), len(DATA) + 10**6), "/moved.onnx": (302, b"", 0),
            "/page.onnx": (200, b"<html>", 6), "/many.onnx": (200, gzip.compress(DATA[:4096]), None),
        }.get(self.path, (404, b"no such file", 12))  # fmt: skip
        self.send_response(status)
        if length is None:
            self.send_header("Content-Encoding", "gzip")
        self.send_header("Content-Length", str(len(data) if length is None else length))
        if data.startswith(b"<"):
            self.send_header("Content-Type", "text/html; charset=utf-8")
        if status == 302:
            self.send_header("Location", "/network.onnx")
        self.end_headers()
        self.wfile.write(data)

    def give(self, path: str) -> None:
        """The network slowly, without saying how long it is, or compressed."""
        self.send_response(200)
        if path == "/packed.onnx":
            self.send_header("Content-Encoding", "gzip")
        self.end_headers()
        if path == "/slow.onnx":
            self.wfile.write(DATA[:4096])
            self.wfile.flush()
            sleep(0.12)
            with contextlib.suppress(OSError):
                self.wfile.write(DATA[4096:8192])
            return
        self.wfile.write(gzip.compress(DATA, 1) if path == "/packed.onnx" else DATA)

    def log_message(self, *_: Any) -> None:
        pass


def serve() -> tuple[ThreadingHTTPServer, str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    return server, f"http://127.0.0.1:{server.server_port}"


def stocked(monkeypatch: Any, folder: Path, *urls: str) -> Model:
    """Put the small network into the catalogue, its file into ``folder`` as known.onnx; an own folder for models."""
    if not urls:
        server, address = serve()
        monkeypatch.callback = server.shutdown
        urls = (f"{address}/network.onnx",)
    model = Model(
        name=NAME, urls=urls, sha256=hashlib.sha256(DATA).hexdigest(), size_bytes=len(DATA), licence="Apache-2.0",
        source="https://example.org", trained_on="blue blocks", good_for="tests",
    )  # fmt: skip
    (folder / "known.onnx").write_bytes(DATA)
    monkeypatch.setattr(catalogue, "CATALOGUE", MappingProxyType({NAME: model}))
    monkeypatch.setenv("MCAPTRACK_MODELS", str(folder / "models"))
    return model
