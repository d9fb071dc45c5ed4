"""A headless Chromium for tests of pages, driven over pipes (DevTools protocol); without one, tests are skipped."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
needs_browser = pytest.mark.skipif(PROGRAM is None, reason="there is no Chromium")
_FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run", "--disable-extensions"),
    *("--disable-background-networking", "--disable-features=IsolateSandboxedIframes", "--disable-dev-shm-usage"),
    *("--remote-debugging-pipe", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"),
)

#: Runs the browser with the pipes where it expects them: it reads from descriptor 3, and writes to descriptor 4.
_WRAPPER = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(one), fcntl.F_DUPFD, 10) for one in sys.argv[1:3]]
for end, at in zip(ends, (3, 4)):
    os.dup2(end, at)
os.execv(sys.argv[3], sys.argv[3:])
"""


class Tab:
    """A page in the browser. ``requested`` are the addresses that it asked for, ``said`` what it wrote to its console.

    ``run`` evaluates an expression in the page, or in the frame whose address ends with ``frame``.
    """

    def __init__(self, send: Any, receive: Any) -> None:
        self._send, self._receive, self._number, self._rest = send, receive, 0, b""
        self.requested: list[str] = []
        self.said: list[str] = []
        self._contexts: dict[int, str] = {}
        self._frames: dict[str, str] = {}
        self._loaded = False
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    _session: str | None = None

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        message |= {"sessionId": self._session} if self._session else {}
        self._send.write(json.dumps(message).encode() + b"\0")
        self._send.flush()
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer["error"]
                return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            data = os.read(self._receive, 2**20)
            assert data, "the browser has ended"
            self._rest += data
        text, _, self._rest = self._rest.partition(b"\0")
        message = json.loads(text)
        about = message.get("params", {})
        match message.get("method"):
            case "Network.requestWillBeSent":
                self.requested.append(about["request"]["url"])
            case "Page.loadEventFired":
                self._loaded = True
            case "Page.frameNavigated":
                self._frames[about["frame"]["id"]] = about["frame"]["url"]
            case "Runtime.executionContextCreated":
                self._contexts[about["context"]["id"]] = about["context"]["auxData"]["frameId"]
            case "Runtime.executionContextDestroyed":
                self._contexts.pop(about["executionContextId"], None)
            case "Runtime.exceptionThrown":
                self.said.append(about["exceptionDetails"]["exception"]["description"])
            case "Log.entryAdded":
                self.said.append(about["entry"]["text"])
        return message

    def open(self, address: str) -> None:
        self._loaded = False
        self._contexts.clear()
        self.call("Page.navigate", url=address)
        while not self._loaded:
            self._next()

    def run(self, expression: str, frame: str = "") -> Any:
        """Return the value of an expression."""
        where = {}
        if frame:
            (where["contextId"],) = (n for n, of in self._contexts.items() if self._frames.get(of, "").endswith(frame))
        done = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True, **where)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def wait(self, condition: str, frame: str = "") -> None:
        """Wait until an expression holds, as long as the whole test may last."""
        while not (self._has(frame) and self.run(f"Boolean({condition})", frame)):
            self.call("Runtime.evaluate", expression="new Promise(go => setTimeout(go, 30))", awaitPromise=True)

    def _has(self, frame: str) -> bool:
        return not frame or any(self._frames.get(of, "").endswith(frame) for of in self._contexts.values())

    def picture(self, path: Path, width: int, height: int, **media: str) -> None:
        """Save a picture of the page in a window of this size; ``media`` are features such as prefers_color_scheme."""
        features = [{"name": name.replace("_", "-"), "value": value} for name, value in media.items()]
        self.call("Emulation.setEmulatedMedia", features=features)
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 500
        )
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot")["data"]))

    def pdf(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.printToPDF", printBackground=False)["data"]))


@contextmanager
def browser() -> Iterator[Tab]:
    """Start a browser with one page."""
    to_browser, from_browser = os.pipe(), os.pipe()
    wrapped = [sys.executable, "-c", _WRAPPER, str(to_browser[0]), str(from_browser[1])]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        assert PROGRAM
        command = [*wrapped, PROGRAM, *_FLAGS, f"--user-data-dir={folder}"]
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with subprocess.Popen(command, **silent, pass_fds=(to_browser[0], from_browser[1])) as process:
            os.close(to_browser[0])
            os.close(from_browser[1])
            try:
                with os.fdopen(to_browser[1], "wb") as send:
                    yield Tab(send, from_browser[0])
            finally:
                process.kill()
                os.close(from_browser[0])
