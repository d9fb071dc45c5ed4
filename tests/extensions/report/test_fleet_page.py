"""The page about many logs: its numbers follow from the table of all logs, and names in it are only text."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import mcaptrack
from mcaptrack import tables
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.report import fleet
from mcaptrack.extensions.report.page import ELEMENT, fleet_data, fleet_page
from mcaptrack.tables import catalogue
from tests.commands import call, done
from tests.extensions.report.test_report import _ELEMENTS, _NASTY
from tests.logs import some_log
from tests.reader import Reader
from tests.tiers import thorough

#: 2026-11-01, midnight.
FIRST_S = 1_793_491_200


def row(name: str, **more) -> dict:
    """A row of `recordings`; without more, of a good log of one minute."""
    whole = dict.fromkeys(tables.TABLES["recordings"].arrow.names) | {
        "recording": name,
        "location": f"/logs/{name}.mcap",
        "start_t_ns": FIRST_S * 10**9,
        "duration_s": 60.0,
        "messages": 600,
        "size_bytes": 6_000_000,
        "tracks": 5,
        "IDF1": 0.9,
        "IDSW": 1,
        "warnings": 0,
        "versions": "0.3.0",
    }
    assert whole.keys() >= more.keys()
    return whole | more


def page_of(rows, link=lambda _: "") -> tuple[Reader, str, dict]:
    data = fleet_data(rows)
    text = fleet_page(rows, "lake", ELEMENT, data, link)
    return Reader(text), text, data


def test_totals_by_hand():
    rows = [
        row("a", IDF1=0.8, IDSW=4),
        row("b", IDF1=0.6, IDSW=0, warnings=2),
        row("c", IDF1=None, IDSW=None, tracks=None, messages=0, duration_s=0.0, versions=None),
    ]
    found = fleet.summary(rows)
    assert found.pop("hours") == pytest.approx(2 / 60)
    assert found.pop("median_IDF1") == pytest.approx(0.7)
    assert found == {
        "logs": 3, "bytes": 18_000_000, "tracks": 10, "scored": 2, "IDSW": 4, "with_warnings": 1, "without_tracks": 1,
        "empty": 1, "versions": {"": 1, "0.3.0": 2},
    }  # fmt: skip


def test_the_worst_logs_come_first_and_those_without_a_value_not_at_all():
    rows = [
        row("low", IDF1=0.2, IDSW=0),
        row("none", IDF1=None, IDSW=None, warnings=None),
        row("often", IDSW=9, warnings=1),
        row("long", IDSW=10, duration_s=3600.0, warnings=3),
        row("no time", IDSW=10, duration_s=0.0),
    ]
    found = {name: [one["recording"] for one in some] for name, some in fleet.worst(rows).items()}
    assert found["IDF1"] == ["low", "long", "no time", "often"]
    assert found["IDSW"] == ["often", "long"]
    assert found["warnings"] == ["long", "often"]
    assert len(fleet.worst([row(f"{n}") for n in range(99)])["IDF1"]) == 20


def test_a_log_far_from_the_others_is_an_outlier():
    usual = [row(f"log{n}", tracks=5 + n % 3) for n in range(12)]
    assert fleet.outliers(usual) == []
    found = fleet.outliers([*usual, row("many", tracks=500)])
    assert [(one["row"]["recording"], one["measure"]) for one in found] == [("many", "tracks by time")]
    assert (found[0]["value"], found[0]["median"]) == (pytest.approx(500 * 60), pytest.approx(6 * 60))
    assert {one["measure"] for one in fleet.outliers([*usual, row("short", duration_s=0.6)])} >= {"duration"}
    assert fleet.outliers([*usual[:6], row("many", tracks=500)]) == [], "fewer than eight say nothing"


def test_trends_are_those_of_days_and_logs_without_a_date_are_left_out():
    day = 86_400 * 10**9
    rows = [
        row(f"{n}-{k}", start_t_ns=FIRST_S * 10**9 + n * day + k * 3600 * 10**9, IDF1=(9 - n) / 10, IDSW=60 * n)
        for n in range(4)
        for k in range(3)
    ]
    found = fleet.trends([*rows, row("clock from 0", start_t_ns=5 * 10**9), row("none", start_t_ns=None)])
    assert found["first"] == "2026-11-01"
    assert (found["bin"], found["logs"]) == ("day", [3, 3, 3, 3])
    assert found["days"] == [0.5, 1.5, 2.5, 3.5]
    assert found["IDF1"]["median"] == pytest.approx([0.9, 0.8, 0.7, 0.6])
    assert found["IDSW"]["median"] == pytest.approx([0, 3600, 7200, 10_800])
    assert fleet.trends(rows[:6]) is None or fleet.trends(rows[:6])["bin"] == "hour"
    years = fleet.trends([row(f"{n}", start_t_ns=n * 365 * day) for n in range(40, 70)])
    assert len(years["days"]) == 30
    assert fleet.trends([row("a"), row("b")]) is None


def test_warnings_are_counted_by_code():
    said = json.dumps([{"code": "clock", "message": "late"}, {"code": "clock", "message": "later"}])
    other = json.dumps([{"code": "held-back", "message": "x"}, {"code": "clock", "message": "y"}])
    found = fleet.warnings_by_code(
        [row("a", warning_texts=said), row("b", warning_texts=other), row("c"), row("d", warning_texts="no json")]
    )
    assert [(one["code"], one["logs"], one["message"]) for one in found] == [
        ("clock", 2, "late"),
        ("held-back", 1, "x"),
    ]


def test_names_are_only_text_and_links_only_lead_to_files():
    rows = [
        row(
            _NASTY,
            location=_NASTY,
            versions=_NASTY,
            warnings=1,
            warning_texts=json.dumps([{"code": _NASTY, "message": _NASTY}]),
        ),
        *(row(f"log{n}", start_t_ns=(FIRST_S + 86_400 * n) * 10**9) for n in range(9)),
        row("far", tracks=9999),
    ]
    reader, text, data = page_of(
        rows, lambda one: "javascript:alert(1)" if one["recording"] == _NASTY else "a b/x.html"
    )
    assert {element for element, _ in reader.elements} <= _ELEMENTS | {"a", "br"}
    assert reader.of("script") == [{"type": "application/json", "id": ELEMENT}, {}]
    assert {one["href"] for one in reader.of("a")} == {"./javascript%3Aalert%281%29", "./a%20b/x.html"}
    for _, attributes in reader.elements:
        assert not any(key.startswith("on") or key in ("src", "style") for key in attributes)
    assert not [c for c in text if not (c.isprintable() or c in "\n\u00a0\u202f")]
    assert json.loads(reader.scripts[0]) == json.loads(json.dumps(data))
    assert len(reader.of("svg")) == 5
    assert not reader.open


def test_an_empty_page_says_so():
    reader, _, _ = page_of([])
    words = "".join(reader.text)
    assert "0 logs, 0.0 hours." in words
    assert "There is no trend" in words


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two logs, and their tables in one folder. Not to be changed."""
    place = tmp_path_factory.mktemp("two")
    some_log(place / "a.mcap")
    shutil.copy(place / "a.mcap", place / "b.mcap")
    (place / "b.report.html").write_text("")
    done("export", place / "a.mcap", place / "b.mcap", "-o", place / "tables")
    return place


@thorough
def test_the_page_about_tables_links_to_pages_beside_logs(folder, tmp_path):
    said = done("report", folder / "tables", "-o", tmp_path / "fleet.html", "--json")
    assert json.loads(said.out)["summary"]["logs"] == 2
    (link,) = Reader((tmp_path / "fleet.html").read_text()).of("a")[:1]
    assert (tmp_path / link["href"]).resolve() == folder / "b.report.html"
    numbers = mcaptrack.report(folder / "tables", tmp_path / "again.html").data
    assert [one["recording"] for one in numbers["worst"]["IDF1"]] == ["a", "b"]


def test_what_a_page_about_tables_cannot_do_is_one_line(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, said in (
        ([folder / "tables"], "all logs of the tables needs a name"),
        ([folder / "a.mcap", folder / "b.mcap"], "2 logs needs a name"),
        ([folder / "tables", folder / "a.mcap", "-o", "x.html"], "one folder of tables"),
    ):
        outcome = call("report", *words)
        assert (outcome.code, said in outcome.err, len(outcome.err.splitlines())) == (1, True, 1), outcome.err
    assert "--camera changes nothing here" in done("report", folder / "tables", "-o", "x.html", "--camera", "front").err
    with pytest.raises(McaptrackError, match=r"x.html exists"):
        mcaptrack.report(folder / "tables", "x.html")


def test_the_file_with_all_logs_is_that_of_the_folder_and_follows_it(folder, tmp_path):
    """It is written by an export of many, and what it says is not believed where files have changed since."""
    tables_of = Path(shutil.copytree(folder / "tables", tmp_path / "tables"))
    found = pq.read_table(tables_of / catalogue.FILE)
    assert found["recording"].to_pylist() == ["a", "b"]
    assert found["IDF1"].to_pylist() == [1.0, 1.0]
    members = sorted((tables_of / "recordings").iterdir())
    catalogue.refresh(tables_of)
    assert catalogue.refresh(tables_of) is False
    shutil.rmtree(members[0])
    assert [one["recording"] for one in catalogue.read_catalogue(tables_of)] == ["b"]
    third = tables_of / "recordings" / "recording=c"
    shutil.copytree(members[1], third)
    assert [one["recording"] for one in catalogue.read_catalogue(tables_of)] == ["b", "c"]
    (third / "part-0.parquet").write_bytes(b"noise")
    os.utime(third / "part-0.parquet", (1, 1))
    with pytest.raises(McaptrackError, match=r"recording=c/part-0.parquet can't be read as Parquet"):
        catalogue.read_catalogue(tables_of)
    shutil.rmtree(third)
    (tables_of / catalogue.FILE).write_bytes(b"noise")
    assert [one["recording"] for one in catalogue.read_catalogue(tables_of)] == ["b"]
    assert catalogue.refresh(tables_of) is True
