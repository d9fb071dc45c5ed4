"""The page of ``mcaptrack view``: what it has, that it asks for nothing elsewhere, and what a click shows."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
import zlib
from base64 import b64decode
from pathlib import Path
from urllib.parse import urlsplit

import pytest

import mcaptrack
from mcaptrack.errors import McaptrackError
from tests.browser import browser, needs_browser
from tests.commands import done
from tests.extension_cases import needs
from tests.reader import Reader
from tests.test_serving import ask
from tests.tiers import thorough
from tests.worlds import ns, write_eventful

pytestmark = needs("report", "Player")  # the pages that it shows


@pytest.fixture(scope="module")
def eventful(tmp_path_factory) -> Path:
    """A log with switches and repairs, seen from above."""
    return write_eventful(tmp_path_factory.mktemp("viewed") / "walk.mcap")


@pytest.fixture
def pictures(finished, tmp_path) -> Path:
    """A log with pictures, and views of tracks on them."""
    return Path(shutil.copy(finished, tmp_path / "pictures.mcap"))


def index_of(server: mcaptrack.LogServer) -> dict:
    status, _, body = ask(server.address)
    assert status == 200
    reader = Reader(body.decode())
    return json.loads(reader.scripts[0])


def inside(server: mcaptrack.LogServer, address: str) -> Reader:
    return Reader(ask(server.address.rstrip("/") + address)[2].decode())


def test_the_first_page_leads_to_all_others_and_no_other_origin_may_read_them(eventful):
    with mcaptrack.view(eventful, port=0) as server:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", server.address)
        data = index_of(server)
        pages = [*data["pages"].values(), *(view["address"] for view in data["views"])]
        for address in ("/", *pages):
            status, headers, body = ask(server.address.rstrip("/") + address)
            assert (status, headers["Content-Type"]) == (200, "text/html; charset=utf-8")
            assert "Access-Control-Allow-Origin" not in headers
            assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
            policy = headers["Content-Security-Policy"]
            assert policy.startswith("default-src 'none'; img-src data:;")
            assert policy.endswith("frame-ancestors 'self'")
            for element, attributes in Reader(body.decode()).elements:
                assert "src" not in attributes or attributes["src"].startswith("data:"), element
        assert [event["at_s"] for event in data["events"]] == [(e.t_ns - ns(0)) / 1e9 for e in server.events]
        assert {event["topic"] for event in data["events"]} == {event.topic for event in server.events}


@thorough
def test_the_report_is_about_the_log_as_it_is_now(pictures):
    def digest() -> str:
        reader = inside(server, data["pages"]["report"])
        return json.loads(reader.scripts[0])["logs"][0]["digest"]

    with mcaptrack.view(pictures, port=0) as server:
        data = index_of(server)
        before = digest()
        assert before == digest()
        done("drop", pictures, "/camera/truth", "-q")
        assert digest() != before


def test_a_player_has_all_tracks_and_those_that_are_not_shown_at_first_are_off(pictures):
    with mcaptrack.view(pictures, port=0) as server:
        (view,) = (view for view in index_of(server)["views"] if view["name"] == "pictures")
        page = inside(server, view["address"])
    texts = {one.get("id"): text for one, text in zip(page.of("script"), page.scripts, strict=True)}
    data = json.loads(zlib.decompress(b64decode(texts["data"])))
    off = {data["layers"][k] for k in data["hidden"]}
    assert {f"/camera/{name}/view/image" for name in ("tracks", "truth")} == off
    assert data["tracks"]["/camera/retracks"] == data["layers"].index("/camera/retracks/full/view/image")


def test_tables_are_those_of_the_log_and_their_csv_has_all_rows(pictures):
    with mcaptrack.view(pictures, port=0) as server, mcaptrack.open(pictures) as log:
        folder = index_of(server)["pages"]["tables"].rpartition("/")[0]
        page = inside(server, f"{folder}/tables.html")
        links = [one["href"] for one in page.of("a")]
        filled = {name for name in log.tables if log.table(name).num_rows}
        assert {link.removeprefix("./").removesuffix(".csv") for link in links} == filled
        body = ask(f"{server.address.rstrip('/')}{folder}/tracks.csv")[2].decode()
        rows = list(csv.DictReader(io.StringIO(body)))
        assert [int(row["track_id"]) for row in rows] == log.table("tracks")["track_id"].to_pylist()


def test_a_log_with_nothing_to_see_says_so(tmp_path):
    path = tmp_path / "empty.mcap"
    mcaptrack.open(path, create=True).close()
    with mcaptrack.view(path, port=0) as server:
        data = index_of(server)
        assert (data["views"], data["events"]) == ([], [])
        assert [one["href"] for one in inside(server, data["pages"]["tables"]).of("a")] == ["./recordings.csv"]
        assert "no messages at all" in "".join(inside(server, data["pages"]["report"]).text)


def test_names_in_the_first_page_are_text(eventful, tmp_path):
    name = "<img src=x onerror=alert(1)>\"'</script>.mcap".replace("/", "_")
    path = Path(shutil.copy(eventful, tmp_path / name))
    with mcaptrack.view(path, port=0) as server:
        reader = Reader(ask(server.address)[2].decode())
        assert not [one for element, one in reader.elements if element == "img" or "onerror" in one]
        assert len(reader.of("script")) == 2
        assert "<img src=x onerror=alert(1)>" in "".join(reader.text)
        assert inside(server, index_of(server)["pages"]["report"]).of("h1")


def test_other_addresses_are_served_with_a_warning_and_never_to_names_of_others(eventful):
    with pytest.warns(mcaptrack.McaptrackWarning, match=r"whoever reaches this machine at 0\.0\.0\.0 can read"):
        served = mcaptrack.view(eventful, port=0, host="0.0.0.0")
    with served as server:
        assert [notice.code for notice in server.warnings] == ["shared"]
        for host, status in {"192.168.1.7:80": 200, "[fe80::1]": 200, "localhost": 200, "evil.example": 404}.items():
            assert ask(server.address, Host=host)[0] == status
    with pytest.raises(McaptrackError, match=r"this machine has no address nowhere\.invalid"):
        mcaptrack.view(eventful, host="nowhere.invalid")


def test_a_port_that_is_taken_is_left_alone_unless_it_was_asked_for(eventful, monkeypatch):
    with mcaptrack.view(eventful, port=0) as first:
        taken = urlsplit(first.address).port
        monkeypatch.setattr("mcaptrack.api.viewing.PORT", taken)
        with mcaptrack.view(eventful) as second:
            assert urlsplit(second.address).port != taken
        with pytest.raises(McaptrackError, match=f"port {taken} of this machine can't be used"):
            mcaptrack.view(eventful, port=taken)


@needs_browser
def test_a_click_on_an_event_shows_its_frame_and_nothing_is_asked_for_elsewhere(pictures):
    with mcaptrack.open(pictures) as log:
        start_ns = log.array("frames")["t_ns"].min()
    with mcaptrack.view(pictures, port=0) as server, browser() as tab:
        events = [event for event in server.events if event.topic == "/camera/tracks"]
        tab.open(server.address)
        tab.wait("document.documentElement.classList.contains('ready')", "player-0.html")
        tab.call("Emulation.setDeviceMetricsOverride", width=900, height=1600, deviceScaleFactor=1, mobile=False)
        tab.wait(  # no gap between the picture and what it is controlled with, however high the window is
            "(([w, h], {clientWidth: wide, clientHeight: high}) => innerHeight > 900 && Math.abs(high - wide * h / w) < 2)"
            "(data.sizes[0], by('stage'))",
            "player-0.html",
        )
        tab.run("document.querySelector('aside').hidden = true")
        assert tab.run(
            "[...document.querySelectorAll('[hidden]')].every(one => getComputedStyle(one).display === 'none')"
        )
        tab.run("document.querySelector('aside').hidden = false")
        for event in events[:2]:
            at_s = (event.t_ns - start_ns) / 1e9
            tab.run("by('which').value = '/camera/tracks'; list()")
            tab.run(f"[...by('events').querySelectorAll('button')].find(one => one.at_s === {at_s}).click()")
            tab.wait(f"document.getElementById('event').textContent === {json.dumps(event.text)}", "player-0.html")
            shown = tab.run("data.seconds[now]", "player-0.html")
            assert at_s - 0.001 <= shown <= at_s + 0.101
            assert not tab.run("hidden.has('/camera/tracks/view/image')", "player-0.html")
            tab.wait(f"Math.abs(at_s - {shown}) < 0.001")
        tab.run("document.querySelectorAll('[role=tab]')[1].click()")
        tab.wait("document.querySelector('button.at')", "report.html")
        tab.run("document.querySelector('button.at').click()", "report.html")
        tab.wait("!by('player').hidden")
        assert tab.said == []
        asked = {address for address in tab.requested if not address.startswith(("data:", "blob:"))}
        assert {urlsplit(address).netloc for address in asked} == {urlsplit(server.address).netloc}


@needs_browser
def test_the_report_sorts_its_tracks_lights_one_everywhere_and_shows_values(finished, tmp_path):
    page = tmp_path / "report.html"
    numbers = mcaptrack.report(finished, page).data["logs"][0]["track_list"]
    ((role, tracks),) = numbers.items()
    with browser() as tab:
        tab.open(page.as_uri())
        column = "[...document.querySelectorAll('.sortable tbody tr')].map(row => Number(row.cells[4].dataset.v))"
        tab.run("document.querySelectorAll('.sortable th[scope=col]')[4].click()")
        assert tab.run(column) == sorted(track["metres"] for track in tracks)
        tab.run("document.querySelectorAll('.sortable th[scope=col]')[4].click()")
        assert tab.run(column) == sorted((track["metres"] for track in tracks), reverse=True)
        key = f"{role}-{tracks[0]['id']}"
        tab.run(f"document.querySelector('tr[data-t=\"{key}\"]').click()")
        lit = tab.run("[...document.querySelectorAll('.lit')].map(one => [one.tagName, one.dataset.t])")
        assert {"rect", "path", "TR"} <= {name for name, _ in lit}
        assert all(key in keys.split(" ") for _, keys in lit)
        left, top, wide = tab.run(
            "(() => { const at = document.querySelector('.strip').getBoundingClientRect();"
            " scrollTo(0, at.top); const now = document.querySelector('.strip').getBoundingClientRect();"
            " return [now.left, now.top, now.width]; })()"
        )
        tab.call("Input.dispatchMouseEvent", type="mouseMoved", x=left + wide / 2, y=top + 40)
        tab.wait("!hint.hidden")
        assert tab.run("hint.textContent").startswith("2.9")  # the middle of 5.9 s
        assert tab.said == []
