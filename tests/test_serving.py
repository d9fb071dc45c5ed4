"""Logs are served to viewers in a browser: the requested bytes of these files only, on this machine only."""

from __future__ import annotations

import http.client
import json
import os
import random
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mcaptrack import log, notices
from mcaptrack.errors import McaptrackError
from mcaptrack.viewing.serving import Limits, Page, Server, requested_range
from tests.awaiting import until
from tests.commands import call
from tests.logs import SOME, write_log


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("served") / "a walk.mcap"
    write_log(path, SOME)
    return path


@pytest.fixture(scope="module")
def server(path) -> Iterator[Server]:
    with serving({path.name: path, "layout.json": b"{}"}) as server:
        yield server


def ask(address: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    where = urlsplit(address)
    connection = http.client.HTTPConnection(where.hostname, where.port, timeout=600)
    try:
        connection.request(method, where.path, headers=headers)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


@given(st.data())
def test_a_range_returns_that_part_of_the_file(server, path, data):
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


WHOLE, PART, NOWHERE = 200, 206, 416
N = 10  # bytes; each value of Range with the status and the bytes that RFC 9110, 14 gives it
RANGES = {
    "bytes=0-0": (PART, range(1)),
    "bytes=0-": (PART, range(N)),
    "BYTES=2-3": (PART, range(2, 4)),
    "bytes=9-9": (PART, range(9, N)),
    "bytes=-1": (PART, range(9, N)),
    "bytes=-99": (PART, range(N)),
    "bytes=5-99": (PART, range(5, N)),
    "bytes=0005-0006": (PART, range(5, 7)),
    "bytes=3-" + "9" * 5000: (PART, range(3, N)),
    "bytes=-" + "9" * 5000: (PART, range(N)),
    "bytes=" + "0" * 5000 + "-1": (PART, range(2)),
    "bytes=10-,2-4": (PART, range(2, 5)),
    "bytes=, ,1-2,": (PART, range(1, 3)),
}
OUTSIDE = ("bytes=" + "9" * 5000 + "-", "bytes=10-", "bytes=-0", "bytes=10-,20-30,-0")
#: Several ranges, and what is no range: it is ignored.
IGNORED = (
    *("bytes=0-1,4-5", "bytes=0-1 ,\t4-5", "bytes=5-2", "bytes=" + "9" * 5000 + "-2", "bytes=-", "bytes=", "bytes", ""),
    *("lines=1-2", "bytes=a-b", "bytes=1 - 2", "bytes =1-2", "bytes=+1-2", "bytes=-1-2", "bytes=0x1-2", "bytes=1_0-12"),
    *("bytes=\xb2-", "bytes=,"),
)
RANGES |= dict.fromkeys(OUTSIDE, (NOWHERE, range(0))) | dict.fromkeys(IGNORED, (WHOLE, range(N)))


def test_ranges_follow_the_standard():
    for text, (status, span) in RANGES.items():
        assert requested_range([text], N) == (span, status), text[:20]
    assert requested_range(["bytes=0-1", "bytes=2-3"], N) == (range(N), WHOLE)
    assert requested_range(["bytes=0-"], 0) == requested_range(["bytes=-5"], 0) == (range(0), NOWHERE)


def test_ranges_are_for_get_alone_and_for_the_file_that_if_range_names(server, path):
    address, size = server.address(path.name), path.stat().st_size
    status, headers, body = ask(address, "HEAD", Range="bytes=2-5")
    assert (status, headers["Content-Length"], body) == (200, str(size), b"")
    for tag, wanted in ((headers["ETag"], 206), ('"another"', 200), (f"W/{headers['ETag']}", 200)):
        assert ask(address, Range="bytes=2-5", **{"If-Range": tag})[0] == wanted
    assert ask(address, Range=f"bytes={size}-", **{"If-Range": '"another"'})[0] == 200


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


def test_only_the_given_files_are_served_and_only_to_this_machine(server, path):
    address = server.address(path.name)
    base, word = address.split("/")[2], address.split("/")[3]
    hidden = (f"{word}/", f"{word}/../{word}/layout", f"{word}/%2e%2e/%2e%2e/etc/passwd", "etc/passwd")
    for other in ("", "layout.json", *hidden):
        assert ask(f"http://{base}/{other}")[0] == 404, other
    assert ask(f"http://{base}/{word}/../etc/passwd")[0] == 404
    assert ask(address, Host="evil.example")[0] == 404  # DNS rebinding: the name resolves to this machine
    for method in ("POST", "PUT", "DELETE"):
        assert ask(address, method)[0] == 501
    assert server.server_address[0] == "127.0.0.1"


@contextmanager
def serving(files: Mapping[str, Path | bytes], index: Page | None = None, **limits: float) -> Iterator[Server]:
    """Start a server with limits that tests can reach."""
    with Server(files, index=index, limits=Limits(**limits)) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


def connect(server: Server) -> socket.socket:
    return socket.create_connection(server.server_address, timeout=600)


def rest(connection: socket.socket) -> bytes:
    """Read everything until the other side closes. Raises TimeoutError if it doesn't."""
    data = b""
    with suppress(ConnectionResetError):
        while block := connection.recv(2**20):
            data += block
    return data


def drips(connection: socket.socket) -> bytes | None:
    """Send one more byte, and return the answer: b"" if the other side has closed, None if there is none."""
    try:
        connection.sendall(b"a")
        return connection.recv(1)
    except TimeoutError:
        return None
    except (BrokenPipeError, ConnectionResetError):
        return b""


def test_a_connection_without_a_request_is_closed(path):
    with serving({path.name: path}, idle_s=0.05) as server, connect(server) as idle:
        assert rest(idle) == b""


def test_a_request_that_never_ends_is_closed_also_if_it_goes_on_byte_by_byte(path):
    with serving({path.name: path}, head_s=0.3) as server:
        with connect(server) as silent:
            silent.sendall(b"GET / HTTP/1.1\r\nHost: local")
            assert rest(silent) == b""
        with connect(server) as slow:
            slow.sendall(b"GET / HTTP/1.1\r\n")
            slow.settimeout(0.01)
            until(lambda: drips(slow) == b"")

        def is_answered() -> bool:
            with suppress(OSError, http.client.HTTPException):  # a busy machine may miss the limit, too
                return ask(server.address(path.name))[0] == 200
            return False

        until(is_answered)


@pytest.fixture
def large(tmp_path) -> Path:
    path = tmp_path / "large"
    with path.open("wb") as stream:
        stream.truncate(2**28)
    return path


def test_a_viewer_that_does_not_read_is_disconnected(large):
    with serving({"large": large}, stall_s=0.1) as server, connect(server) as greedy:
        where = urlsplit(server.address("large"))
        greedy.sendall(f"GET {where.path} HTTP/1.1\r\nHost: {where.netloc}\r\n\r\n".encode())
        assert greedy.recv(1) == b"H"  # otherwise it may not have been taken yet
        until(lambda: not connections(server))
        assert len(rest(greedy)) < 2**28 - 1


def test_connections_end_with_the_server(path):
    with ExitStack() as stack:
        with serving({path.name: path}) as server:
            held = [stack.enter_context(connect(server)) for _ in range(3)]
            held[0].sendall(b"GET / HT")
            until(lambda: connections(server) >= 3)
        assert [rest(connection) for connection in held] == [b""] * 3


def connections(server: Server) -> int:
    return len(server._idle_since)


def test_idle_connections_are_closed_for_new_ones(path):
    """Of 100 idle connections as many as the limit allows stay open, and a viewer gets its answer."""
    with serving({path.name: path}, connections=8) as server:
        idle = [connect(server) for _ in range(100)]
        assert ask(server.address(path.name))[2] == path.read_bytes()
        assert connections(server) <= 8
        ended = [connection for connection in idle[:90] if rest(connection) == b""]
        assert len(ended) == 90
        assert sum(thread.name.startswith("Thread") for thread in threading.enumerate()) < 30
        for connection in idle:
            connection.close()


def test_the_number_of_connections_is_limited(large):
    with serving({"large": large}, connections=2) as server:
        where = urlsplit(server.address("large"))
        request = f"GET {where.path} HTTP/1.1\r\nHost: {where.netloc}\r\n\r\n".encode()
        busy = [connect(server) for _ in range(2)]
        for connection in busy:
            connection.sendall(request)
            assert connection.recv(15) == b"HTTP/1.1 200 OK"
        assert ask(server.address("large"), "HEAD")[0] == 503
        for connection in busy:
            connection.close()
        until(lambda: not connections(server))
        assert ask(server.address("large"), "HEAD")[0] == 200


def exchange(server: Server, data: bytes) -> bytes:
    with connect(server) as connection:
        with suppress(OSError):  # it may be answered and closed before all is sent
            connection.sendall(data)
            connection.shutdown(socket.SHUT_WR)
        return rest(connection)


def test_content_of_a_request_is_never_taken_for_another_request(server):
    where = urlsplit(server.address("layout.json"))
    inner = f"GET {where.path} HTTP/1.1\r\nHost: {where.netloc}\r\n\r\n"
    for field in (f"Content-Length: {len(inner)}", "Transfer-Encoding: chunked"):
        answer = exchange(server, f"GET /x HTTP/1.1\r\nHost: {where.netloc}\r\n{field}\r\n\r\n{inner}".encode())
        assert answer.startswith(b"HTTP/1.1 413 ")
        assert answer.count(b"HTTP/1.1") == 1
    both = exchange(server, (inner + inner).encode())
    assert both.count(b"HTTP/1.1 200 OK") == 2  # requests that follow one another are answered in order


@pytest.mark.parametrize(
    "fields",
    ["no colon", "A B: 1", "A : 1", ": 1", " A: 1", "A: 1\r\n 2", "A: \x00", "A: \x7f", "\xc4: 1", "From me\r\nA: 1"],
)
def test_malformed_fields_make_a_bad_request(server, fields):
    path = urlsplit(server.address("layout.json")).path
    for head in (f"Host: localhost\r\n{fields}", f"{fields}\r\nHost: localhost"):
        answer = exchange(server, f"GET {path} HTTP/1.1\r\n{head}\r\n\r\n".encode("latin-1"))
        assert answer.startswith(b"HTTP/1.1 400 "), head


def test_viewers_that_disconnect_cause_no_output(path, capfd):
    with serving({path.name: path}) as server:
        for begun in (b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: local"):
            hasty = connect(server)
            hasty.sendall(begun)
            until(lambda: connections(server))
            hasty.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # a reset, not an end
            hasty.close()
            until(lambda: not connections(server))
    assert capfd.readouterr() == ("", "")


#: Values of Host by the status that they get; the last port is one that is forwarded here.
HOSTS = {
    400: (
        "", "[", "]", "[::1", "a b", "127.0.0.1:1:2", "127.0.0.1:port", "127.0.0.1/", "user@127.0.0.1", "a, b.example",
    ),
    404: ("[::1]", "evil.example", "127.0.0.1.evil.example", "localhost.evil.example:80", "2130706433"),
    200: ("LOCALHOST", "127.0.0.1", "localhost:8080"),
}  # fmt: skip


@pytest.mark.parametrize(("wanted", "host"), [(status, host) for status, hosts in HOSTS.items() for host in hosts])
def test_requests_for_other_hosts_are_refused(server, host, wanted):
    path = urlsplit(server.address("layout.json")).path
    for request in (
        f"GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n",
        f"GET http://{host}{path} HTTP/1.1\r\nHost: localhost\r\n\r\n",
    ):
        status = int(exchange(server, request.encode()).split()[1])
        assert status == wanted or (request.startswith("GET http") and {status, wanted} <= {400, 404})
    doubled = exchange(server, f"GET {path} HTTP/1.1\r\nHost: {host}\r\nHost: localhost\r\n\r\n".encode())
    assert doubled.startswith(b"HTTP/1.1 400 ")


def test_a_path_that_is_not_a_regular_file_is_not_found(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with serving({"pipe": tmp_path / "pipe", "folder": tmp_path, "none": tmp_path / "none"}) as server:
        for name in ("pipe", "folder", "none"):
            assert ask(server.address(name))[0] == 404


def test_a_name_in_any_encoding_is_found(tmp_path):
    name = os.fsdecode(b"w\xe4lk %2f ?#.mcap")
    (tmp_path / name).write_bytes(b"here")
    with serving({name: tmp_path / name}) as server:
        assert ask(server.address(name))[2] == b"here"


def test_warnings_of_a_page_go_to_the_listener_of_the_server():
    heard = list[notices.Notice]()

    def content() -> bytes:
        notices.warn("odd")
        return b""

    with notices.listening(heard.append), serving({}, Page(content)) as server:
        assert ask(server.root)[0] == 200
    assert [notice.message for notice in heard] == ["odd"]


def test_a_port_in_use_is_refused(server):
    with pytest.raises(McaptrackError, match=rf"port {server.server_port} of this machine can't be used: .*; choose"):
        Server({}, server.server_port)
    with pytest.raises(McaptrackError, match="port 99999"):
        Server({}, 99999)


#: What is said of a log without tracks.
OPENED = "viewers open at 0.0 s, its start: nothing is tracked in it yet"


def extended(path: Path) -> Path:
    """A log with two layouts of its own."""
    write_log(path, SOME)
    with log.read(path) as opened, log.extend(opened) as writer:
        writer.add_attachment("mcaptrack.layout.json", "application/json", b'{"layout": 1}')
        writer.add_attachment("mcaptrack.comparing.layout.json", "application/json", b'{"layout": 2}')
    return path


@contextmanager
def viewing(path: Path, *more: str) -> Iterator[tuple[subprocess.Popen[str], dict[str, Any]]]:
    """Start the command, wait until it serves, and yield it with the JSON it printed."""
    command = [sys.executable, "-m", "mcaptrack", "view", path, "--json", *more]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    usual = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    with subprocess.Popen(command, **pipes, env=usual) as process:
        lines: list[str] = []
        while not (lines and lines[-1] == "}\n"):
            lines.append(process.stdout.readline())
            assert lines[-1], process.stderr.read()
        try:
            yield process, json.loads("".join(lines))
        finally:
            process.kill()


def notes_of(said: Mapping[str, Any]) -> list[str]:
    """The notes, but for one that says that players are of an extension which was taken away."""
    return [note for note in said["notes"] if "is an extension that isn't installed" not in note]


def test_view_prints_working_links_and_serves_until_ctrl_c(tmp_path):
    path = extended(tmp_path / "a.mcap")
    with viewing(path, "--lichtblick", "http://localhost:8080/") as (process, said):
        link = urlsplit(said["links"]["Lichtblick"])
        asked = parse_qs(link.query)
        assert (link.netloc, asked["ds"]) == ("localhost:8080", ["remote-file"])
        assert ask(asked["ds.url"][0])[2] == path.read_bytes()
        assert ask(asked["layoutUrl"][0])[2] == b'{"layout": 1}'
        assert list(said["layouts"]) == list(said["lichtblick"]) == ["tracking", "comparing"]
        other = parse_qs(urlsplit(said["lichtblick"]["comparing"]).query)
        assert other["ds.url"] == asked["ds.url"]
        assert ask(other["layoutUrl"][0])[2] == ask(said["layouts"]["comparing"])[2] == b'{"layout": 2}'
        assert said["warnings"] == []
        where = urlsplit(said["log"])
        with ExitStack() as stack:  # Ctrl-C does not wait for viewers: some idle, one within a request
            held = [stack.enter_context(socket.create_connection((where.hostname, where.port), 600)) for _ in range(20)]
            held[0].sendall(b"GET / HT")
            process.send_signal(signal.SIGINT)
            _, err = process.communicate(timeout=600)
            assert all(rest(connection) == b"" for connection in held)
        assert process.returncode == 0
        assert (err, notes_of(said)) == ("", [OPENED])


def test_layout_files_are_served_as_they_were_edited(tmp_path):
    path = extended(tmp_path / "a.mcap")
    edited, broken, new = (tmp_path / f"a{end}.layout.json" for end in ("", ".comparing", ".predictions"))
    edited.write_text('{"layout": "mine"}')
    broken.write_text("{")
    new.write_text('{"layout": 3}')
    with viewing(path) as (process, said):
        served = {name: ask(address) for name, address in said["layouts"].items()}
        assert {name: body for name, (_, _, body) in served.items()} == {
            "tracking": b'{"layout": "mine"}',
            "comparing": b'{"layout": 2}',
            "predictions": b'{"layout": 3}',
        }
        assert {headers["Content-Type"] for _, headers, _ in served.values()} == {"application/json"}
        edited.write_text('{"layout": "once more"}')
        assert ask(said["layouts"]["tracking"])[2] == b'{"layout": "once more"}'
        unusable = f"{broken} can't be served (it is not JSON); the log's own layout is used"
        assert [warning["message"] for warning in said["warnings"]] == [unusable]
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=600)
        assert process.returncode == 128 + signal.SIGTERM
        assert err.splitlines() == [f"warning: {unusable}"]
        assert notes_of(said) == [f"{edited} differs from the layout in the log; the file is served", OPENED]


def test_errors_are_one_line(tmp_path):
    code, _, err = call("view", "none.mcap")
    assert (code, "does not exist" in err) == (1, True)
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    code, _, err = call("view", path, "--layout", "none")
    assert (code, f"{path} has no layout none; it has none" in err) == (1, True)
    code, _, err = call("view", __file__, "--lichtblick", "localhost")
    assert (code, "--lichtblick needs an address such as" in err) == (1, True)


class TestMutants:
    """Requests from a grammar, with a few random faults in each."""

    NUMBERS = ("0", "1", "-1", "9" * 5000, "0x10", "1e9", "", " ", "\u0663", "\x00", "18446744073709551616")
    TEXTS = (
        "", "[", "[::1", "%", "%zz", "%00", "\x00", "\x7f", "\xff", "a\rb", "a\nb", "\t", "://", "http://[", "*", "?", "#",
    )  # fmt: skip

    def request(self, rng: random.Random, path: str) -> bytes:
        """One request, with up to three faults."""
        number, text = partial(rng.choice, self.NUMBERS), partial(rng.choice, self.TEXTS)
        line, colon, end, body = ["GET", path, "HTTP/1.1"], ": ", "\r\n", ""
        fields = [["Host", "localhost"], ["Range", "bytes=0-9"]]
        for fault in rng.choices(range(18), k=rng.choice([0, 1, 1, 1, 2, 3])):
            match fault:
                case 0:
                    line[0] = rng.choice(["HEAD", "OPTIONS", "POST", "get", "G\x00T", text()])
                case 1:
                    line[1] = rng.choice(
                        [f"http://localhost{path}", f"http://{text()}{path}", path + text(), text() + path]
                    )
                case 2:
                    line[2] = rng.choice(["HTTP/1.0", "HTTP/2.0", f"HTTP/{number()}.{number()}", text(), "HTTP/1.1 x"])
                case 3:
                    fields[0][1] = rng.choice([text(), "evil.example", f"localhost:{number()}"])
                case 4 | 5 | 6:
                    spans = [f"{number()}-{number()}" for _ in range(rng.choice([1, 1, 1, 2, 50, 2000]))]
                    fields[1][1] = (
                        f"{rng.choice(['bytes'] * 6 + ['lines', text()])}={rng.choice([',', ' , ', ';']).join(spans)}"
                    )
                case 7:
                    fields.append(["Content-Length", number()])
                case 8:
                    fields.append(["Transfer-Encoding", "chunked"])
                case 9:
                    fields.append(["If-Range", text()])
                case 10:
                    fields.append(
                        rng.choice([["Expect", "100-continue"], ["Connection", text()], ["Range", "bytes=1-2"]])
                    )
                case 11:
                    fields.append([text(), text()])
                case 12:
                    fields.append(["X" * rng.choice([1, 70_000]), "1"])
                case 13:
                    fields.append(["Host", rng.choice(["localhost", text()])])
                case 14:
                    fields += [["A", "1\r\n folded"]] * rng.choice([1, 200])
                case 15:
                    colon = rng.choice([":", " :", ""])
                case 16:
                    end = rng.choice(["\n", "\r", ""])
                case 17:
                    body = rng.choice(["GET / HTTP/1.1\r\n\r\n", "x" * 3000])
        rng.shuffle(fields)
        head = [" ".join(line), *(name + colon + value for name, value in fields), "", ""]
        data = bytearray((end.join(head) + body).encode("utf-8"))
        for _ in range(rng.choice([0, 0, 0, 1, 5])):
            at = rng.randrange(len(data))
            data[at : at + rng.choice([0, 1, 7])] = rng.randbytes(rng.choice([0, 1, 3]))
        return bytes(data[: rng.randrange(len(data))] if rng.random() < 0.1 else data)

    def test_mutated_requests_get_no_traceback_no_other_file_and_an_answer_in_time(self, path, capfd):
        secret = path.read_bytes()
        statuses: Counter[int] = Counter()
        with serving({path.name: path}) as server:
            where = urlsplit(server.address(path.name))
            for seed in range(300):
                data = self.request(random.Random(seed), where.path)
                answer = exchange(server, data)  # fails where nothing comes for 10 s
                if where.path.split("/")[1].encode() not in data:
                    assert secret[:8] not in answer, data
                if answer:
                    status = re.match(rb"HTTP/1\.1 (\d{3}) ", answer)
                    assert status, (data, answer)
                    statuses[int(status[1])] += 1
            assert ask(server.address(path.name))[2] == secret
            assert connections(server) <= 1
        assert capfd.readouterr() == ("", "")
        assert {200, 206, 400, 404, 413, 416, 431, 501, 505} <= set(statuses)
        assert not {500, 503} & set(statuses)
