"""A log for a viewer in a browser: the bytes that it asks for, and nothing else to anybody else."""

from __future__ import annotations

import http.client
import io
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.serving import Server
from tests.test_cli import call
from tests.test_log import SOME, stock_messages, write_log


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("served") / "a walk.mcap"
    write_log(path, SOME)
    return path


@pytest.fixture(scope="module")
def server(path) -> Iterator[Server]:
    with Server({path.name: path, "layout.json": b"{}"}) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def ask(address: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    where = urlsplit(address)
    connection = http.client.HTTPConnection(where.hostname, where.port, timeout=10)
    try:
        connection.request(method, where.path, headers=headers)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


class OverHttp(io.RawIOBase):
    """What a viewer does: a file that is read in ranges."""

    def __init__(self, address: str) -> None:
        self._address, self._at = address, 0
        self._size = int(ask(address, "HEAD")[1]["Content-Length"])

    def seek(self, offset: int, whence: int = 0) -> int:
        self._at = offset + (0, self._at, self._size)[whence]
        return self._at

    def tell(self) -> int:
        return self._at

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def readinto(self, room: memoryview) -> int:
        end = min(self._size, self._at + len(room))
        if end <= self._at:
            return 0
        status, _, data = ask(self._address, Range=f"bytes={self._at}-{end - 1}")
        assert status == 206
        room[: len(data)] = data
        self._at = end
        return len(data)


def test_the_stock_reader_reads_the_log_in_ranges(server, path):
    reader = make_reader(io.BufferedReader(OverHttp(server.address(path.name))))
    found = [(c.topic, m.log_time, m.sequence, m.data) for _, c, m in reader.iter_messages()]
    assert found == stock_messages(path)


@given(st.data())
def test_a_range_is_that_part_of_the_file(server, path, data):
    whole = path.read_bytes()
    first = data.draw(st.none() | st.integers(0, len(whole) + 10))
    last = data.draw(st.integers(0 if first is None else first, len(whole) + 10) | st.none())
    if first is None and last is None:
        return
    text = f"bytes={'' if first is None else first}-{'' if last is None else last}"
    wanted = whole[-last or len(whole) :] if first is None else whole[first : None if last is None else last + 1]
    status, headers, body = ask(server.address(path.name), Range=text)
    if not wanted:
        assert (status, body, headers["Content-Range"]) == (416, b"", f"bytes */{len(whole)}")
        return
    assert (status, body) == (206, wanted)
    start = len(whole) - len(wanted) if first is None else first
    assert headers["Content-Range"] == f"bytes {start}-{start + len(wanted) - 1}/{len(whole)}"
    assert headers["Content-Length"] == str(len(wanted))


@pytest.mark.parametrize("text", ["bytes=5-2", "bytes=-", "bytes=0-1,4-5", "lines=1-2", "bytes=a-b"])
def test_what_is_no_single_range_gets_the_whole(server, path, text):
    status, _, body = ask(server.address(path.name), Range=text)
    assert (status, body) == (200, path.read_bytes())


def test_pages_of_any_origin_may_read_it_if_they_know_the_address(server, path):
    for method in ("GET", "HEAD", "OPTIONS"):
        status, headers, _ = ask(server.address(path.name), method, Origin="https://viewer.example")
        assert status in (200, 204)
        assert headers["Access-Control-Allow-Origin"] == "*"
        assert "Range" in headers["Access-Control-Allow-Headers"]
        assert {"Accept-Ranges", "Content-Range", "Content-Length"} <= set(
            headers["Access-Control-Expose-Headers"].split(", ")
        )
        assert headers["Accept-Ranges"] == "bytes"
    assert ask(server.address("layout.json"))[2] == b"{}"


def test_nothing_else_is_served_and_to_nobody_else(server, path):
    address = server.address(path.name)
    base, word = address.split("/")[2], address.split("/")[3]
    for other in (
        "",
        "layout.json",
        f"{word}/",
        f"{word}/../{word}/layout",
        f"{word}/%2e%2e/%2e%2e/etc/passwd",
        "etc/passwd",
    ):
        assert ask(f"http://{base}/{other}")[0] == 404, other
    assert ask(f"http://{base}/{word}/../etc/passwd")[0] == 404
    assert ask(address, Host="evil.example")[0] == 404  # a name that somebody made point to this machine
    for method in ("POST", "PUT", "DELETE"):
        assert ask(address, method)[0] == 501
    assert server.server_address[0] == "127.0.0.1"


def test_a_port_that_is_taken_is_said(server):
    with pytest.raises(McaptrackError, match=rf"port {server.server_port} of this machine can't be used: .*; choose"):
        Server({}, server.server_port)
    with pytest.raises(McaptrackError, match="port 99999"):
        Server({}, 99999)


def test_a_log_that_went_away_is_not_found(tmp_path):
    path = tmp_path / "b.mcap"
    write_log(path, SOME)
    with Server({"b.mcap": path}) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        path.unlink()
        assert ask(server.address("b.mcap"))[0] == 404
        server.shutdown()
        thread.join()


def test_the_command_prints_links_that_lead_to_the_log_and_its_layout_until_it_is_stopped(tmp_path):
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    with log.read(path) as opened, log.extend(opened) as writer:
        writer.add_attachment("mcaptrack.layout.json", "application/json", b'{"layout": 1}')
        writer.add_attachment("mcaptrack.comparing.layout.json", "application/json", b'{"layout": 2}')
    command = [sys.executable, "-m", "mcaptrack", "view", path, "--json", "--lichtblick", "http://localhost:8080/"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    usual = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with subprocess.Popen(command, **pipes, env=usual) as process:
        lines = []
        while not (lines and lines[-1] == "}\n"):
            lines.append(process.stdout.readline())
            assert lines[-1], process.stderr.read()
        said = json.loads("".join(lines))
        link = urlsplit(said["links"]["Lichtblick"])
        asked = parse_qs(link.query)
        assert (link.netloc, asked["ds"]) == ("localhost:8080", ["remote-file"])
        assert ask(asked["ds.url"][0])[2] == path.read_bytes()
        assert ask(asked["layoutUrl"][0])[2] == b'{"layout": 1}'
        assert list(said["layouts"]) == list(said["lichtblick"]) == ["tracking", "comparing"]
        other = parse_qs(urlsplit(said["lichtblick"]["comparing"]).query)
        assert other["ds.url"] == asked["ds.url"]
        assert ask(other["layoutUrl"][0])[2] == ask(said["layouts"]["comparing"])[2] == b'{"layout": 2}'
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
        assert process.returncode == 0
        assert err == "serving until Ctrl-C ...\ndone\n"


def test_mistakes_are_said(tmp_path):
    code, _, err = call("view", "none.mcap")
    assert (code, "can't be opened: No such file" in err) == (1, True)
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    code, _, err = call("view", path, "--layout", "none")
    assert (code, f"{path} has no layout none; it has none" in err) == (1, True)
    code, _, err = call("view", __file__, "--lichtblick", "localhost")
    assert (code, "--lichtblick needs an address such as" in err) == (1, True)
