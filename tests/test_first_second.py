"""What a person sees first: links open a log where something happens, and plots have room for what they show."""

from __future__ import annotations

import json
import math
import re
from datetime import datetime
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.stats import chi2

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation.forecasts import radii_m
from mcaptrack.foxglove.views.layouts import limit_of
from mcaptrack.geometry.mixtures import normal_tails
from mcaptrack.viewing.links import utc_text
from tests.commands import call
from tests.logs import SOME, write_log
from tests.worlds import ns, write_eventful

#: The kinds of events that change identities, by their numbers in tables.
CHANGES = {4: "identity switch", 7: "joined", 8: "parted"}


def opened_at(link: str) -> float:
    (text,) = parse_qs(urlsplit(link).query)["time"]
    return datetime.fromisoformat(text).timestamp()


@pytest.fixture(scope="module")
def eventful(tmp_path_factory) -> Path:
    return write_eventful(tmp_path_factory.mktemp("eventful") / "walk.mcap")


@pytest.fixture(scope="module")
def served(eventful):
    with mcaptrack.view(eventful) as server:
        yield server


@pytest.fixture(scope="module")
def happened(eventful) -> list[tuple[int, str]]:
    """Time and kind of each switch and repair, as the table of events has them."""
    with mcaptrack.open(eventful) as opened:
        rows = opened.table("events").to_pylist()
    return sorted((row["t_ns"], CHANGES[row["kind"]]) for row in rows if row["kind"] in CHANGES)


def test_each_switch_and_repair_has_a_link_a_second_before_the_track_was_lost(served, happened):
    assert happened == [(ns(8), "identity switch"), (ns(8), "joined"), *[(ns(16), "identity switch")] * 2]
    assert sorted((one.t_ns, one.kind) for one in served.events) == happened
    assert [one.event for one in served.events] == list(range(1, len(happened) + 1))
    assert [one.t_ns for one in served.events] == [t_ns for t_ns, _ in happened]
    for one in served.events:
        assert opened_at(one.link) == pytest.approx(one.t_ns / 1e9 - 1 - one.unseen_s, abs=1e-6)
        assert f"at {one.t_ns / 1e9:.1f} s" in one.text
        (layout,) = parse_qs(urlsplit(one.link).query)["layoutUrl"]
        assert layout == served.layouts["comparing"]


def test_viewers_open_where_tracks_are_and_all_links_agree(served):
    first = next(one for one in served.events if one.topic == "/camera/retracks")
    assert served.at_s == pytest.approx(first.t_ns / 1e9 - 1)
    for link in (*served.links.values(), *served.lichtblick.values()):
        assert opened_at(link) == pytest.approx(served.at_s, abs=1e-6)
    assert (first.kind, served.at_s) == ("joined", 7.0)
    assert f"viewers open at {served.at_s:.1f} s, before event {first.event} ({first.text})" in served.notes


@pytest.mark.parametrize(("chosen", "wanted"), [({"at_s": 2.25}, 2.25), ({"at_s": 0}, None), ({"event": 2}, "event")])
def test_a_time_or_an_event_can_be_chosen(eventful, happened, chosen, wanted):
    with mcaptrack.view(eventful, **chosen) as server:
        if wanted is None:
            assert all("time=" not in link for link in server.links.values())
            return
        at_s = max(happened[1][0] / 1e9 - 1, 0) if wanted == "event" else wanted
        assert server.at_s == pytest.approx(at_s)
        assert opened_at(server.links["Foxglove"]) == pytest.approx(at_s, abs=1e-6)


def test_times_and_events_that_a_log_has_not_are_refused(eventful, happened):
    for chosen, words in (
        ({"at_s": 1e6}, "so viewers can't open it at 1e+06 s"),
        ({"event": len(happened) + 1}, f"has the events 1 to {len(happened)}, not event"),
        ({"at_s": 1, "event": 1}, "`at_s=` and `event=` both say where viewers open"),
    ):
        with pytest.raises(McaptrackError) as refused:
            mcaptrack.view(eventful, **chosen)
        assert words in str(refused.value)
    code, _, err = call("view", eventful, "--at", "1", "--event", "1")
    assert (code, "--at and --event both say" in err) == (1, True)


def test_without_tracks_it_opens_at_the_start_and_says_why(tmp_path):
    path = tmp_path / "a.mcap"
    write_log(path, SOME)
    with mcaptrack.view(path) as server:
        assert (server.at_s, server.events) == (0, ())
        assert "time=" not in server.links["Lichtblick"]
        assert any("its start: nothing is tracked in it yet" in note for note in server.notes)
    with pytest.raises(McaptrackError, match="no identity switches and repairs, not event 1"):
        mcaptrack.view(path, event=1)


def test_only_logs_with_a_video_codec_get_the_advice_about_pictures(finished, served):
    with mcaptrack.view(finished) as server:
        (advice,) = [note for note in server.notes if "image_format='jpeg'" in note]
        opens = server.notes[0]
    assert "/camera/video are H.264" in advice
    assert re.fullmatch(r"viewers open at [\d.]+ s, where there are [23] of at most 3 tracks", opens)
    assert not any("image_format" in note for note in served.notes)


def test_a_layout_from_a_file_is_served_alone(finished, tmp_path):
    mine = tmp_path / "mine.layout.json"
    mine.write_text('{"layout": "of mine"}')
    with mcaptrack.view(finished, layout=mine) as server:
        assert list(server.layouts) == ["mine"]
        (address,) = parse_qs(urlsplit(server.links["Lichtblick"]).query)["layoutUrl"]
        assert address == server.layouts["mine"]
    mine.write_text("{")
    for name, words in (
        (mine, "is not valid JSON"),
        (tmp_path / "none.json", "does not exist"),
        (
            "trackin",
            "has no layout trackin; did you mean tracking? it has tracking, comparing, predictions. A file of a layout ends",
        ),
    ):
        with pytest.raises(McaptrackError) as refused:
            mcaptrack.view(finished, layout=name)
        assert words in str(refused.value)


@given(st.integers(-(10**18), 10**19))
def test_times_in_links_are_exact_to_the_nanosecond(t_ns):
    text = utc_text(t_ns)
    if text is None:
        assert t_ns > 253_402_300_799 * 10**9 or t_ns < 0
        return
    whole, fraction = text.removesuffix("Z").split(".")
    seconds = datetime.fromisoformat(whole + "+00:00").timestamp()
    assert int(seconds) * 10**9 + int(fraction) == t_ns


# Layouts


def plots_of(path) -> list[dict]:
    with log.read(path) as opened:
        names = ("layout.json", "comparing.layout.json", "predictions.layout.json")
        files = [json.loads(opened.attachment(f"mcaptrack.{name}")) for name in names]
    return [config for file in files for name, config in file["configById"].items() if name.startswith("Plot!")]


def test_plots_have_room_for_every_value_and_legends_beside_them(finished):
    plots = plots_of(finished)
    assert len(plots) == 4
    limited = 0
    with mcaptrack.open(finished) as opened:
        for plot in plots:
            assert (plot["legendDisplay"], plot["sidebarDimension"]) == ("left", 170)
            values = []
            for one in plot["paths"]:
                topic, column = one["value"].split(".rows[:].")
                rows = opened.array("counts" if topic.endswith("/counts") else "forecast_scores", topic)
                values.append(rows[column][np.isfinite(rows[column].astype(float))].astype(float))
            if not len(np.concatenate(values)):  # viewers choose the limits where nothing is known yet
                assert "maxYValue" not in plot
                continue
            limited += 1
            most = float(np.concatenate(values).max())
            assert plot["minYValue"] == 0
            assert most < plot["maxYValue"] <= 1.25 * most + 1
    assert limited == 3


@given(st.floats(1e-6, 1e6), st.booleans())
def test_axes_end_a_little_above_the_highest_value(highest, is_count):
    limit = limit_of(highest, is_count)
    assert highest < limit <= max(1.25 * highest * (1 + 1e-5), highest + 1 if is_count else 0)
    assert limit_of(math.nan) is limit_of(0.0) is limit_of(None) is None


# The spread of forecasts


def test_the_spread_of_forecasts_in_the_log_is_that_of_their_ellipses(finished):
    """Half axes by an eigenvalue solver, percentiles by NumPy, the radius of a mixture by a root finder."""
    with mcaptrack.open(finished) as opened:
        rows = opened.array("predictions", "/camera/retracks/predictions")
        scores = opened.array("forecast_scores", "/camera/retracks/predictions/scores")
    ends = rows[rows["step"] == rows["step"].max()]
    cov = np.stack([ends[f"cov_{a}_m2"] for a in ("xx", "xy", "xy", "yy")], axis=-1).reshape(-1, 2, 2)
    squared = [
        brentq(lambda q, w=w, n=n, v=v: (1 - w) * chi2.cdf(q / n, 2) + w * chi2.cdf(q / v, 2) - 0.95, 1e-6, 1e3)
        for w, n, v in zip(
            *(ends[name].tolist() for name in ("wide_weight", "narrow_scale", "wide_scale")), strict=True
        )
    ]
    ends_ns, largest = ends["t_ns"], np.sqrt(np.linalg.eigvalsh(cov)[:, 1] * squared)
    seen = 0
    for one in scores:
        mine = largest[ends_ns == one["t_ns"]]
        assert np.isnan(one["spread_mean_m"]) == (not len(mine))
        if len(mine):
            seen += 1
            assert one["spread_mean_m"] == pytest.approx(mine.mean())
            assert one["spread_90_m"] == pytest.approx(np.percentile(mine, 90))
    assert seen > 5


@given(st.floats(0.01, 10), st.floats(0.01, 10), st.floats(0, 7))
def test_radii_are_the_longer_half_axes(long, short, turn):
    axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    cov = axes @ np.diag([long, short]) @ axes.T
    (found,) = radii_m(cov[None], normal_tails(1))
    assert found == pytest.approx(math.sqrt(max(long, short) * chi2.ppf(0.95, 2)), rel=1e-6)
    assert np.isnan(radii_m(np.full((1, 2, 2), np.nan), normal_tails(1)))
    assert np.isnan(radii_m(np.array([[[1.0, 2.0], [2.0, 1.0]]]), normal_tails(1)))  # its determinant is negative
    assert radii_m(np.zeros((1, 2, 2)), normal_tails(1)).tolist() == [0.0]  # certain
