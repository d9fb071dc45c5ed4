"""The report: its numbers are those of `evaluate`, and names in a log can't run or load anything."""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import os
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jinja2 import UndefinedError

import mcaptrack
from mcaptrack import foxglove, log
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import Candidate, EvaluateOptions, EvaluationInput, evaluate
from mcaptrack.evaluation.events import MatchRule, find_events
from mcaptrack.evaluation.people import LEAST_PEOPLE, Interval, Intervals, PersonScores, intervals, person_scores
from mcaptrack.extensions.report import statistics
from mcaptrack.extensions.report.figures import counts_over_time, identity_timeline, mean_numbers, pieces
from mcaptrack.extensions.report.headline import rules_text
from mcaptrack.extensions.report.identity_events import (
    SIDE_PX,
    Doubt,
    IdentityEvent,
    add_thumbnails,
    find_doubtful_tracks,
    find_doubts,
    most_important,
    summarize_events,
)
from mcaptrack.extensions.report.page import ELEMENT, LogReport, change_text, data, gather, page, verdict
from mcaptrack.extensions.report.scene_map import (
    SceneBackground,
    TrackPath,
    ground_map,
    heat_map,
    picture_map,
    simplified,
)
from mcaptrack.schema import DECISIONS, PREDICTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import Predict
from mcaptrack.viewing import charts
from mcaptrack.viewing.charts import Axis, Bars, Line
from mcaptrack.viewing.formatting import environment, plain
from tests import robots
from tests.commands import call, done, printed
from tests.logs import add_rows, write_channels
from tests.reader import Reader
from tests.test_extensions import add, one_line, site  # noqa: F401  # a fixture
from tests.tiers import thorough
from tests.worlds import crossing_tracks, ns, tracks_at, walk, write_eventful

PACKAGE = "mcaptrack.extensions.report"


def report_on(*paths: Path) -> tuple[str, dict, Reader]:
    reports = []
    for path in paths:
        with log.read(path) as opened:
            reports.append(gather(opened, None))
    text = page(reports)
    return text, data(reports), Reader(text)


def numbers_in(reader: Reader) -> dict:
    return json.loads(reader.scripts[0])


INGESTED = Provenance("ingest", {})


def write(path: Path, channels: dict[str, list[Frame]], made: Provenance = INGESTED, schema=TRACKS) -> Path:
    return write_channels(path, {topic: (schema, made, frames) for topic, frames in channels.items()})


# Numbers


def without_curves(results):
    for result in results:
        result["displacement"] = {k: v for k, v in result.get("displacement", {}).items() if "curve" not in k}
    return results


def test_its_scores_are_those_of_evaluate_and_json_prints_what_the_page_holds(finished, tmp_path):
    target = tmp_path / "report.html"
    shown = json.loads(printed("report", finished, "-o", target, "--json")[0])
    (scored,) = [json.loads(printed("evaluate", finished, "--json")[0])["results"]]
    assert len(scored) > 8
    assert without_curves(shown["results"]) == without_curves(scored)
    inside = numbers_in(Reader(target.read_text()))
    inside["results"] = without_curves(inside["results"])
    assert inside == {key: value for key, value in shown.items() if key not in ("failed", "warnings")}


def test_several_logs_are_combined_as_evaluate_combines_them(finished, tmp_path):
    other = tmp_path / "other.mcap"
    other.write_bytes(finished.read_bytes())
    _, numbers, reader = report_on(finished, other)
    scored = json.loads(printed("evaluate", finished, other, "--json")[0])["results"]
    assert without_curves(numbers["results"]) == without_curves(scored)
    assert any(result["sequence"] == "COMBINED" for result in scored)
    assert len([one for one in reader.of("details") if one.get("class") == "log"]) == 2
    assert "both logs together" in "".join(reader.text)
    code, _, err = call("report", finished, other)
    assert (code, "-o" in err) == (1, True)  # it would stand beside neither


@pytest.fixture(scope="module")
def predicted(tmp_path_factory) -> Path:
    """Four people who turn, tracked with noise and predicted, and their ground truth."""
    noise = np.random.default_rng(5).normal(0, 0.1, (60, 5, 2))

    def path(tick, seen):
        turned = {who: 0.1 * who * max(tick - 12 * who, 0) for who in range(1, 5)}
        xy = {who: (0.4 * tick + noise[tick, who, 0] * seen, 3 * who + y) for who, y in turned.items()}
        return {who: (x, y + noise[tick, who, 1] * seen) for who, (x, y) in xy.items()}

    samples = walk(lambda tick: path(tick, 1), 60)
    tracks = {"/camera/truth": walk(lambda tick: path(tick, 0), 60), "/camera/samples": samples}
    ahead = [f for (f,) in Predict(predictor="kalman")(samples)]
    channels = {topic: (TRACKS, INGESTED, frames) for topic, frames in tracks.items()}
    channels |= {"/camera/predictions": (PREDICTIONS, INGESTED, ahead)}
    return write_channels(tmp_path_factory.mktemp("predicted") / "predicted.mcap", channels)


def test_the_curve_and_the_errors_by_horizon_are_those_of_the_scores(predicted):
    _, numbers, _ = report_on(predicted)
    scored = json.loads(printed("evaluate", predicted, "--json")[0])["results"]
    whole = next(r["displacement"] for r in scored if r["similarity"] == "metres")
    (one,) = numbers["logs"][0]["forecasts"]
    assert one["by_horizon"]["n"] > 50
    assert one["by_horizon"]["mean_m"][-1] == pytest.approx(whole["FDE_m"])
    assert np.mean(one["by_horizon"]["mean_m"]) == pytest.approx(whole["ADE_m"])
    points = list(zip(one["curve_recall"], one["curve_ADE_m"], strict=True))
    assert points[-1] == (whole["curve_recall"][-1], whole["curve_ADE_m"][-1])
    assert set(points) <= set(zip(whole["curve_recall"], whole["curve_ADE_m"], strict=True))
    assert [(part["nominal"], part["held"]) for part in one["calibration"]] == [
        (part["level"], part["held"]) for part in whole["reliability"]
    ]
    assert one["NLL"] == whole["NLL"]


def test_constant_velocity_is_right_for_straight_walks_and_wrong_for_turns():
    def path(tick):
        return {1: (0.4 * tick, 0.0), 2: (0.4 * min(tick, 12), 5.0 + 0.4 * max(tick - 12, 0))}

    truth = walk(path, 40)

    def error(frames, who):
        members = [Frame(f.t_ns, f.index, f.rows[f.rows["track_id"] == who]) for f in frames]
        wrong = [f for (f,) in Predict(predictor="kalman")(members)]
        sequence = EvaluationInput("s", members, [Candidate("t", None, members, wrong, "p")])
        results = evaluate([sequence], EvaluateOptions()).results
        (found,) = statistics.forecast_statistics(sequence, results)
        return found["constant_velocity"]

    straight, turning = error(truth, 1), error(truth, 2)
    assert straight["n"] == 40 - 12 - 3
    assert straight["mean_m"] == pytest.approx([0.0] * 12, abs=1e-9)
    assert straight["ahead_s"] == pytest.approx(np.arange(1, 13) * 0.4)
    assert turning["mean_m"][-1] > 1.0


def test_speeds_and_durations_by_hand():
    frames = walk(lambda tick: {7: (0.5 * tick, 0.0)} if tick != 3 else {}, 6, rate_hz=2.0)
    frames[0] = Frame(0, 0, tracks_at({7: (0.0, 0.0), 9: (4.0, 4.0)}))
    # 7 is there from 0 to 2.5 s with a hole at 1.5 s, over which its speed is not known; 9 for one frame.
    assert statistics.speeds_m_per_s(frames).tolist() == pytest.approx([1.0, 1.0, 1.0])
    assert statistics.durations_s(frames).tolist() == pytest.approx([3.0, 0.5])
    said = statistics.track_statistics(frames)
    assert (said["tracks"], said["rows"], said["longest_s"], said["observed_share"]) == (2, 6, 3.0, 1.0)


def test_tracks_in_numbers_by_hand():
    frames = walk(lambda tick: {7: (3.0 * tick, 4.0 * tick)} if tick != 2 else {}, 5, rate_hz=2.0)
    frames[4].rows["observed"] = False
    frames[1] = Frame(frames[1].t_ns, 1, np.concatenate([frames[1].rows, boxes({9: (0, 0)})]))
    first, second = statistics.list_tracks(frames, -ns(1))
    assert first == {"id": 7, "from_s": 1.0, "to_s": 3.0, "seconds": 2.0, "metres": 20.0, "observed": 0.75}
    assert (second["id"], second["seconds"]) == (9, 0.0)
    assert np.isnan(second["metres"])
    assert statistics.list_tracks([], 0) == []


@given(st.dictionaries(st.text(max_size=3), st.lists(st.floats(0, 1e6), max_size=60), max_size=3))
def test_histograms_count_every_value(values):
    found = statistics.histograms({topic: np.array(part) for topic, part in values.items()})
    if not any(values.values()):
        assert found is None
        return
    edges = np.array(found["edges"])
    assert edges[0] == 0
    assert (np.diff(edges) > 0).all()
    for part in found["series"]:
        assert sum(part["counts"]) + part["above"] == part["n"] == len(values[part["topic"]])


@given(st.floats(1e-9, 1e9))
def test_steps_of_axes_are_round_and_not_too_small(least):
    step = charts.round_step(least)
    assert least * (1 - 1e-9) <= step <= 2.5 * least
    assert any(abs(step / 10**k / lead - 1) < 1e-9 for k in range(-10, 11) for lead in (1, 2, 2.5, 5))


@given(st.integers(0, 10**7))
def test_axes_of_counts_have_whole_ticks_up_to_their_end(most):
    end = charts.round_most([np.array([float(most)])], whole=True)
    ticks = [value for value, _ in Axis("people", end, whole=True).ticks()]
    assert all(value == int(value) for value in ticks)
    assert max(most, 1) <= end >= ticks[-1]
    assert 2 <= len(ticks) <= 8


@given(st.lists(st.tuples(st.integers(0, 500), st.integers(0, 500)), min_size=2, max_size=40))
def test_simplified_lines_keep_their_ends_and_stay_near(points):
    path = np.array(points, float)
    (line,) = simplified([path], 1.0)
    assert line[0].tolist() == path[0].tolist()
    assert line[-1].tolist() == path[-1].tolist()
    for point in path:
        gaps = []
        for a, b in itertools.pairwise(line):
            along = np.clip((point - a) @ (b - a) / max((b - a) @ (b - a), 1e-9), 0, 1)
            gaps.append(np.hypot(*(point - a - along * (b - a))))
        assert min(gaps, default=0.0) <= 1.0 + 1e-3


# Moments


def boxes(people):
    """Rows of tracks whose boxes of 20 by 40 pixels stand at these left upper corners, by id."""
    rows = tracks_at({who: (float("nan"), float("nan")) for who in people})
    for row, (x, y) in zip(rows, people.values(), strict=True):
        row["x_px"], row["y_px"], row["w_px"], row["h_px"] = x, y, 20, 40
    return rows


def switching(tick):
    """Person 1 is track 1, then for two frames 9, then 1 again, and from frame 60 on track 5."""
    return 9 if tick in (20, 21) else 5 if tick >= 60 else 1


@pytest.fixture(scope="module")
def story():
    truth = [Frame(ns(t / 10), t, boxes({1: (40 + t, 60)})) for t in range(100)]
    tracks = [Frame(ns(t / 10), t, boxes({switching(t): (40 + t, 60)})) for t in range(100)]
    found = find_events(tracks, truth)
    assert found.rule == MatchRule("iou", 0.5)
    return summarize_events("/camera/tracks", found.events, found.rule, tracks, truth, (0, ns(9.9))), tracks


def test_lasting_events_weigh_more_than_short_ones(story):
    told, _ = story
    assert [moment.t_ns for moment in told.events] == [ns(2.0), ns(2.2), ns(6.0)]
    assert [moment.weight_s for moment in told.events] == pytest.approx([0.2, 0.2, 3.8], abs=0.11)
    ((most,),) = most_important([told], 1)
    assert "track 1 became track 5 at 6.0 s" in most.text
    both = most_important([told, told], 4)
    assert [len(part) for part in both] == [2, 2]
    assert [len(part) for part in most_important([told], 12)] == [3]


class Film:
    """Pictures in which what moves is white."""

    def __init__(self):
        self.t_ns = np.array([ns(t / 10) for t in range(100)])
        self.decoded = []

    def readable(self, numbers):
        for number in sorted(set(numbers)):
            self.decoded.append(number)
            image = np.full((240, 320, 3), 20, np.uint8)
            image[60:100, 40 + number : 60 + number] = 255
            yield Frame(int(self.t_ns[number]), number, image)


def test_thumbnails_show_the_tracks_before_and_after(story):
    told, tracks = story
    film = Film()
    add_thumbnails(told.events, tracks, film, 0)
    assert film.decoded == [19, 20, 21, 22, 59, 60]
    last = told.events[-1]
    assert (last.before.at_s, last.after.at_s) == pytest.approx((5.9, 6.0))
    assert [(shot.box.identity, shot.box.label) for shot in (last.before, last.after)] == [(1, 1), (5, 5)]
    for moment in told.events:
        for shot in (moment.before, moment.after):
            seen = cv2.imdecode(np.frombuffer(shot.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
            assert seen.shape == (SIDE_PX, SIDE_PX)
            x, y, w, h = shot.box.xywh
            inside = np.zeros(seen.shape, bool)
            inside[round(y) + 3 : round(y + h) - 3, round(x) + 3 : round(x + w) - 3] = True
            around = np.ones(seen.shape, bool)
            around[round(y) - 3 : round(y + h) + 3, round(x) - 3 : round(x + w) + 3] = False
            assert seen[inside].mean() > 230
            assert seen[around].mean() < 60


# Statistics that are not known


def test_an_empty_log_says_so_in_every_section(tmp_path):
    path = write(tmp_path / "empty.mcap", {})
    _, numbers, reader = report_on(path)
    words = "".join(reader.text)
    for said in ("no messages at all", "no ground truth", "no tracks to draw", "no channels", "forecasts", "no motion"):
        assert said in words
    assert numbers["results"] == []
    assert not reader.of("svg")


def test_without_metres_it_says_that_speeds_are_not_known(tmp_path):
    frames = [Frame(ns(t / 10), t, boxes({1: (40 + t, 60)})) for t in range(30)]
    _, numbers, reader = report_on(write(tmp_path / "pixels.mcap", {"/camera/tracks": frames}))
    words = "".join(reader.text)
    assert "Speeds are not known" in words
    assert "Tracks can't be drawn" in words
    assert numbers["logs"][0]["speed_m_per_s"] is None
    assert numbers["logs"][0]["dwell_s"]["series"][0]["median"] == pytest.approx(3.0)


def test_ground_truth_of_another_time_is_reported_and_the_rest_shown(tmp_path):
    frames = walk(lambda tick: {1: (tick * 0.4, 0.0)}, 20)
    later = [Frame(f.t_ns + ns(1000), f.index, f.rows) for f in frames]
    path = write(tmp_path / "apart.mcap", {"/camera/tracks": frames, "/camera/truth": later})
    _, numbers, reader = report_on(path)
    assert "never overlap in time" in "".join(reader.text)
    assert numbers["results"] == []
    assert str(tmp_path) not in "".join(reader.text)


def test_damaged_pictures_are_reported_and_the_ground_is_shown(tmp_path):
    path = tmp_path / "torn.mcap"
    frames = walk(lambda tick: {1: (tick * 0.4, 0.0)}, 20)
    with log.create(path) as writer:
        add_rows(writer, "/camera/tracks", TRACKS, frames, made=INGESTED)
        number = writer.add_channel("/camera/video", foxglove.schema_record(foxglove.IMAGE), "protobuf", {})
        writer.add_message(number, 0, 0, foxglove.pack_picture(foxglove.IMAGE, 0, "camera", "jpeg", b"no picture"))
    _, _, reader = report_on(path)
    words = "".join(reader.text)
    assert "The pictures can't be shown: torn.mcap: /camera/video" in words
    assert "here is the ground instead" in words
    assert len(reader.of("svg")) > 1


def test_channels_of_another_schema_are_left_out_and_named(tmp_path):
    path = write(tmp_path / "odd.mcap", {"/camera/tracks": [Frame(0, 0, PREDICTIONS.empty())]}, schema=PREDICTIONS)
    _, _, reader = report_on(path)
    assert "/camera/tracks holds mcaptrack.Predictions, not tracks" in "".join(reader.text)


# Nothing gets out

_NASTY = "/<script>alert(1)</script>\"'><img src=x onerror=alert(2)>javascript:alert(3)\u202egnp.\u0007\u2066&lt;]]>"
_ELEMENTS = {
    "html", "head", "meta", "link", "title", "style", "body", "main", "script", "section", "div", "p", "ul", "ol", "li",
    "h1", "h2", "h3", "h4", "b", "bdi", "code", "small", "span", "dl", "dt", "dd", "details", "summary", "figure",
    "figcaption", "table", "caption", "thead", "tbody", "tr", "th", "td", "svg", "g", "line", "rect", "path", "text",
    "polyline", "polygon", "circle", "image", "use", "nav", "a", "wbr",
}  # fmt: skip


@pytest.fixture(scope="module")
def nasty(tmp_path_factory) -> Path:
    frames = walk(lambda tick: {1: (tick * 0.4, 0.0), 2: (0.0, tick * 0.4)}, 30)
    swapped = walk(lambda tick: {1 + tick // 15: (tick * 0.4, 0.0)}, 30)
    made = Provenance(
        "ingest", {"file": _NASTY, "</script>": ["</ScRiPt x", float("nan")]}, input=_NASTY, version=_NASTY
    )
    file = "<img src=x onerror=alert(4)>\"'\u202e{x}.mcap"
    channels = {_NASTY + "/tracks": swapped, _NASTY + "/truth": frames, _NASTY: frames}
    return write(tmp_path_factory.mktemp("nasty") / file, channels, made)


def holds(reader: Reader) -> None:
    """Only our elements; data, and one script that runs; nothing that loads, or leads out of the page."""
    assert {element for element, _ in reader.elements} <= _ELEMENTS
    assert reader.of("script") == [{"type": "application/json", "id": ELEMENT}, {}]
    for element, attributes in reader.elements:
        for key, value in attributes.items():
            assert not key.startswith("on")
            assert key not in ("src", "srcset", "style", "action", "formaction", "xlink:href")
            if key == "href":
                assert re.fullmatch(r"data:(image/(jpeg|png);base64,[\w+/=]+|,)|#[a-z]+-\d+", value), element
            if key == "id":
                assert re.fullmatch(rf"[a-z]+-\d+|hint|{ELEMENT}", value)
            if key == "data-t":
                assert re.fullmatch(r"((tracks|online|offline|truth)--?\d+ ?)+", value)
            if key == "class":
                assert re.fullmatch(r"[\w -]+", value)
    (policy,) = [one["content"] for one in reader.of("meta") if one.get("http-equiv")]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    own = base64.b64encode(hashlib.sha256(reader.scripts[1].encode()).digest()).decode()
    assert (rules["default-src"], rules["script-src"], rules["img-src"]) == ("'none'", f"'sha256-{own}'", "data:")
    assert not reader.open


def test_names_from_logs_are_only_text(nasty):
    text, _, reader = report_on(nasty)
    holds(reader)
    assert not [c for c in text if not (c.isprintable() or c in "\n\u00a0\u202f")]
    words = "".join(reader.text)
    assert "<img src=x onerror=alert(2)>javascript:alert(3)" in words
    assert numbers_in(reader)["logs"][0]["channels"][0]["topic"] == _NASTY


def test_a_page_on_a_whole_log_loads_and_runs_nothing(fresh):
    done("run", fresh, "--detector", "knn", "--no-tables", "-q")  # its tracks break, and repairs have pictures
    text, _, reader = report_on(fresh)
    holds(reader)
    assert not re.search(r"https?://|@import|url\(", text)
    assert len(reader.of("image")) > 1
    assert len(text) < 3e6


def rendered(source: str, **values) -> str:
    return environment(PACKAGE).from_string(source).render(values)


@given(st.text() | st.text(alphabet="<>&\"'/!-=script javasonloadx\u202e\0\n"))
def test_what_templates_print_is_read_back_as_text(text):
    reader = Reader(rendered('<p title="{{ text }}">{{ text }}</p>', text=text))
    shown = "".join(c if c.isprintable() or c in "\n\u00a0\u202f" else "\ufffd" for c in text)
    assert [element for element, _ in reader.elements] == ["p"]
    assert "".join(reader.text) == shown
    assert reader.elements[0][1] == {"title": shown}


_LEAVES = st.none() | st.booleans() | st.floats() | st.text() | st.sampled_from(["</script>", "<!--<script>", "]]>"])
_VALUES = st.deferred(lambda: _LEAVES | st.lists(_VALUES, max_size=3) | st.dictionaries(st.text(), _VALUES, max_size=3))


@given(_VALUES)
def test_data_in_the_page_are_read_back_as_they_were(value):
    said = plain({"value": value})
    element = rendered("<script>{{ value | tojson }}</script>", value=said)
    assert element.count("<") == element.count(">") == 2
    assert json.loads(element[element.index(">") + 1 : element.rindex("<")]) == said


def test_missing_values_are_errors_not_text():
    for source in ("{{ unknown }}", "{{ values.unknown }}", "{{ values.none }}"):
        with pytest.raises((UndefinedError, ValueError)):
            rendered(source, values={"none": None})


@pytest.mark.parametrize(
    "name", sorted(name for name in environment(PACKAGE).list_templates() if name.endswith(".html"))
)
def test_templates_print_in_text_and_quoted_attributes_only(name):
    """Whatever a log holds: no value stands in a link, a style or a handler, or gets past the escaping."""
    source = environment(PACKAGE).loader.get_source(environment(PACKAGE), name)[0]
    assert not re.search(r"\|\s*safe|autoescape|Markup|xmlattr", source)
    assert not re.search(r"=\s*\{\{|\son\w+=", source), "a value outside of quotes, or a handler"
    # A notebook has no sheet of styles: what stands there has its own, with no value but a number or a side.
    known = re.sub(r'\{\{ "right" if [\w.\[\]]+ else "left" \}\}|\{\{ width \}\}', "0", source)
    own = re.findall(r"""\sstyle=("[^"]*"|'[^']*'|\S+)""", known)
    assert not own or name in ("in_notebook.html", "framed.html", "table.html"), "a style"
    assert not any("{{" in one for one in own), "a value in a style"
    for element in re.findall(r"</?\w*\{\{.*?\}\}", source):
        assert re.fullmatch(r"</?h\{\{ level( \+ 1)? \}\}", element)
    for link in re.findall(r'(?:href|src)="([^"]*)"', source):
        assert link in ("data:,", "#{{ id }}", "#{{ place }}-{{ number }}", "{{ viewer.address }}") or re.fullmatch(
            r"data:image/(?:jpeg|png);base64,\{\{ [\w.]+ \| base64 \}\}|\./\{\{ [\w.]+ \| address \}\}", link
        )
    styles = re.findall(r"<style>(.*?)</style>", source)
    assert re.findall(r"\{\{ (.*?) \}\}", "".join(styles)) in ([], ["loop.index0", "colour"] * 2)


# Files


def test_the_page_stands_beside_the_log_which_it_never_replaces(finished, tmp_path):
    path = tmp_path / "walk.mcap"
    path.write_bytes(finished.read_bytes())
    before = path.read_bytes()
    printed("report", path, "-q")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["walk.mcap", "walk.report.html"]
    code, _, err = call("report", path, "-o", path, "--force")
    assert code == 1
    assert "is a log" in err
    code, _, err = call("report", path, "-o", tmp_path / "walk.pdf")
    assert (code, "walk.pdf: the page is written as HTML" in err) == (1, True)
    assert path.read_bytes() == before


# Charts and maps of the report: where each thing stands, by hand


#: The corners of a chart of lines, in px.
LEFT, RIGHT, TOP, BOTTOM = 46.0, 334.0, 26.0, 230.0


def places(points: str) -> np.ndarray:
    return np.array([[float(part) for part in one.split(",")] for one in points.split()])


def test_lines_stand_at_their_values_and_end_at_the_border():
    x, y = np.array([0.0, 5.0, 10.0, 10.0, 2.0]), np.array([0.0, 4.0, 8.0, 16.0, np.nan])
    band = np.array([0.0, 2.0, 4.0, 6.0, 0.0]), np.array([2.0, 6.0, 8.0, 20.0, 0.0])
    line = Line("one", "tracks", x, y, *band, dot=(5.0, 4.0))
    chart = charts.line_chart("t", [line], Axis("s", 10.0), Axis("m", 8.0))
    wanted = [(LEFT, BOTTOM), ((LEFT + RIGHT) / 2, (TOP + BOTTOM) / 2), (RIGHT, TOP), (RIGHT, TOP)]
    assert places(chart["lines"][0]["points"]) == pytest.approx(np.array(wanted), abs=0.06)
    around = places(chart["bands"][0]["points"])
    assert len(around) == 8
    assert around[:, 0] == pytest.approx([LEFT, 190.0, RIGHT, RIGHT, RIGHT, RIGHT, 190.0, LEFT], abs=0.06)
    assert around[:4, 1] == pytest.approx([BOTTOM, 179.0, 128.0, 77.0], abs=0.06)
    assert around[4:, 1] == pytest.approx([TOP, TOP, 77.0, 179.0], abs=0.06)
    ((dot_x, dot_y, role),) = chart["dots"]
    assert (float(dot_x), float(dot_y), role) == (190.0, 128.0, "tracks")
    assert [(float(at), text) for at, text in chart["y_ticks"]] == [
        (230.0, "0"), (179.0, "2"), (128.0, "4"), (77.0, "6"), (26.0, "8")
    ]  # fmt: skip


def test_names_of_lines_that_end_together_stand_one_below_the_other_in_the_chart():
    for end in (0.0, 4.0, 8.0):
        lines = [Line(f"name {n}", "tracks", np.array([0.0, 10.0]), np.array([0.0, end])) for n in range(4)]
        chart = charts.line_chart("t", lines, Axis("s", 10.0), Axis("m", 8.0))
        at = np.array([float(place) for place, _, _ in chart["names"]])
        assert (np.diff(at) >= 14 - 0.11).all()
        assert at[0] >= TOP - 1
        assert at[-1] <= BOTTOM + 5
        assert [name for _, name, _ in chart["names"]] == [f"name {n}" for n in range(4)]


def test_bars_are_as_high_as_their_share_and_the_median_stands_at_its_value():
    rows = [
        Bars("a", "tracks", np.array([0.5, 0.25, 0.0]), 1.0, ""),
        Bars("b", "truth", np.array([0.0, 0.1, 0.5]), 3.0, ""),
    ]
    chart = charts.histogram_chart("t", rows, np.array([0.0, 1.0, 2.0, 4.0]), "s")
    left, right = chart["left"], chart["right"]
    for number, (row, shares) in enumerate(zip(chart["rows"], ((0.5, 0.25), (0.1, 0.5)), strict=True), 1):
        tall = [float(bar[3]) for bar in row["bars"]]
        assert tall == pytest.approx([60 * share / 0.5 for share in shares], abs=0.06)
        assert [float(bar[1]) + float(bar[3]) for bar in row["bars"]] == pytest.approx([74 * number] * 2, abs=0.11)
    assert float(chart["rows"][0]["median"]) == pytest.approx(left + (right - left) / 4, abs=0.06)
    assert float(chart["rows"][1]["bars"][1][0]) == pytest.approx(left + (right - left) / 2, abs=0.06)
    assert float(chart["rows"][1]["bars"][1][2]) == pytest.approx((right - left) / 2 - 1, abs=0.06)


def test_values_before_and_after_and_their_intervals_stand_on_one_scale():
    sides = ((0.5, 0.25, 0.75), (1.0, 0.9, 1.0))
    chart = charts.ranges_chart("t", [("log", sides), ("x" * 60, sides)], Axis("%", 1.0, percent=True), ("a", "b"))
    ticks = {text: float(at) for at, text in chart["x_ticks"]}
    row = chart["rows"][0]
    middle = (ticks["0"] + ticks["100"]) / 2
    assert (float(row["before"]), float(row["after"])) == pytest.approx((middle, ticks["100"]), abs=0.11)
    (low, high, role, y), (_, _, other, below) = row["bars"]
    span = ticks["100"] - ticks["0"]
    assert (float(low), float(high)) == pytest.approx((ticks["0"] + span / 4, ticks["0"] + 3 * span / 4), abs=0.11)
    assert (role, other, below - y) == ("tracks", "offline", 6)
    assert len(chart["rows"][1]["name"]) == 48


@pytest.mark.parametrize("span_s", [0.4, 7.0, 59.0, 61.0, 3600.0, 90000.0, 1e7])
def test_ticks_of_time_are_few_and_even(span_s):
    found = charts.time_ticks(span_s)
    assert 2 <= len(found) <= 8
    assert found[0] == 0
    assert found[-1] <= span_s * (1 + 1e-9)
    assert np.diff(found) == pytest.approx(found[1])
    assert found[-1] + found[1] > span_s


def path(points) -> TrackPath:
    return TrackPath(7, np.array(points, float), 10.0, 12.5)


def way_of(text: str) -> np.ndarray:
    """The points of the data of an SVG path: a start, and steps."""
    start, *steps = re.findall(r"(-?\d+) (-?\d+)", text)
    return np.cumsum(np.array([start, *steps], int), axis=0)


def test_north_is_up_on_the_plan_and_both_axes_have_one_scale():
    span = np.array([0.0, 0.0]), np.array([10.0, 10.0])
    found = ground_map([path([(0, 0), (10, 0), (10, 5)])], span, 8.0)
    at = way_of(found["tracks"][0]["way"])
    east, north = at[1] - at[0], at[2] - at[1]
    assert east[0] > 100
    assert east[1] == north[0] == 0
    assert north[1] == pytest.approx(-east[0] / 2, abs=1)
    assert at[0][1] == pytest.approx(found["height"] - found["left"], abs=1)
    bar_px = float(found["bar_end"]) - found["left"]
    assert bar_px * 10 / float(found["bar_label"].split()[0]) == pytest.approx(east[0], abs=1)
    assert found["tracks"][0]["title"] == "7: 2.0 to 4.5\N{NO-BREAK SPACE}s"


def test_what_leaves_the_plan_is_counted_and_its_scale_says_where_a_point_is():
    span = np.array([-5.0, 100.0]), np.array([5.0, 110.0])
    found = ground_map([path([(-5, 100), (5, 110)]), path([(0, 105), (1e7, 105)])], span, 0.0)
    assert found["outside"] == 1
    x0, y0, step = map(float, found["scale"].split())
    x, y = way_of(found["tracks"][0]["way"])[1]
    assert (x0 + x * step, y0 + (found["height"] - y) * step) == pytest.approx((5, 110), abs=0.05)
    assert float(found["bar_end"]) < found["width"]


def test_paths_on_the_picture_are_in_its_pixels():
    behind = SceneBackground(b"", 320, 240, 0.5)
    found = picture_map([path([(100, 100), (300, 100), (300, 400)])], behind, 0.0)
    assert way_of(found["tracks"][0]["way"]).tolist() == [[50, 50], [150, 50], [150, 200]]


def test_the_heat_map_has_north_at_its_top():
    """Ten seconds in the south-west, then a walk to the north-east."""
    frames = walk(lambda tick: {1: (0.25, 0.25) if tick < 25 else (0.25 + (tick - 25), 0.25 + 2 * (tick - 25))}, 30)
    found = heat_map(frames)
    opacity = cv2.imdecode(np.frombuffer(found["png"], np.uint8), cv2.IMREAD_UNCHANGED)[..., 3]
    high, wide = opacity.shape
    assert high > wide > 1
    assert np.unravel_index(opacity.argmax(), opacity.shape) == (high - 1, 0)
    assert opacity[0, -1] > 0
    assert opacity[0, 0] == 0
    heights = [float(at) for at, text in found["y_ticks"]]
    assert heights == sorted(heights, reverse=True)


@pytest.mark.parametrize(
    ("change", "word", "text"),
    [
        ((0.05, 0.01, 0.09), "better", "+5.0 (+1.0 to +9.0)"),
        ((-0.05, -0.09, -0.01), "worse", "-5.0 (-9.0 to -1.0)"),
        ((0.05, -0.01, 0.11), "not sure", "+5.0 (-1.0 to +11.0)"),
        ((0.05, np.nan, np.nan), "unknown: 3 people", "+5.0"),
    ],
)
def test_better_is_said_only_if_the_whole_interval_says_so(change, word, text):
    one = Interval(*change)
    found = Intervals(3, (one, one), one, one)
    assert (verdict(found), change_text(found)) == (word, text)
    assert (verdict(None), change_text(None)) == ("\N{EN DASH}", "\N{EN DASH}")


def test_rules_that_differ_in_their_limit_are_said_together():
    rules = [("iou", 0.5), ("metres", 0.5), ("metres", 1.0), ("metres", 2.0)]
    assert rules_text(rules) == "by overlap of boxes of at least 0.5; within 0.5, 1 or 2 m on the ground"
    assert rules_text([]) == ""


def test_a_result_is_shown_in_a_line():
    page = mcaptrack.ReportResult(Path("page.html"), 12, {"many": [0] * 1000}, ())
    assert repr(page) == f"ReportResult({str(page.page)!r}, 12 bytes)"


@thorough
def test_a_recording_with_boxes_of_other_software_has_tracks_on_its_page(tmp_path):
    path = tmp_path / "boxes.mcap"
    robots.write_log(path, "/front/image_raw", boxes="/front/detections")
    done("run", path, "--topic", "/front/detections", "--no-tables", "-q")
    done("report", path, "-o", tmp_path / "r.html", "-q")
    assert "There are no tracks here" not in (tmp_path / "r.html").read_text()


def test_the_page_of_a_log_in_a_store_is_written_here(store, template):
    done("report", store.put("night/a.mcap", template))
    assert (os.listdir(), store.names()) == (["a.report.html"], ["night/a.mcap"])


def test_a_log_by_two_names_is_named_twice(finished, tmp_path):
    link = tmp_path / "link.mcap"
    link.symlink_to(finished)
    with pytest.raises(McaptrackError, match=r"walk\.mcap is named twice; name it once"):
        mcaptrack.report([finished, link], tmp_path / "a.html")


def test_the_page_has_scores_of_classes(tmp_path):
    rows = "".join(f"{n},{who},{n},{5 * who},{kind}\n" for n in range(30) for who, kind in ((1, "person"), (2, "cart")))
    (tmp_path / "a.csv").write_text(f"frame,id,x_m,y_m,class\n{rows}")
    for role, place in (("tracks", "output"), ("truth", "into")):
        mcaptrack.ingest(tmp_path / "a.csv", role=role, fps=10, **{place: tmp_path / "a.mcap"})
    mcaptrack.report(tmp_path / "a.mcap", tmp_path / "a.html")
    text = (tmp_path / "a.html").read_text()
    assert "within 1 m on the ground, cart" in text
    assert ("Objects over time" in text, "People over time" in text) == (True, False)


# The report about people: identities over time, numbers that agree, doubts and intervals


@pytest.fixture(scope="module")
def eventful(tmp_path_factory) -> Path:
    return write_eventful(tmp_path_factory.mktemp("eventful") / "walk.mcap")


@pytest.fixture(scope="module")
def told(eventful) -> LogReport:
    with log.read(eventful) as opened:
        return gather(opened, None)


@pytest.fixture(scope="module")
def text(eventful) -> str:
    with log.read(eventful) as opened:
        return page([gather(opened, None)])


# Scores of people


def swapped(rng: np.random.Generator) -> tuple[list[Frame], list[Frame]]:
    """Ground truth of random walkers, and tracks of it with noise, misses, false rows and new ids."""
    truth = crossing_tracks(rng, ticks=30)
    tracks = []
    offset = 0
    for frame in truth:
        offset += int(rng.random() < 0.1)
        kept = rng.random(len(frame.rows)) < 0.9
        people = {
            int(row["track_id"]) + 10 * offset: (row["x_m"] + rng.normal(0, 0.3), row["y_m"] + rng.normal(0, 0.3))
            for row in frame.rows[kept]
        }
        if rng.random() < 0.2:
            people[999] = (50.0, 50.0)
        tracks.append(Frame(frame.t_ns, frame.index, tracks_at(people)))
    return truth, tracks


@pytest.mark.parametrize("seed", range(3))
def test_sums_over_people_are_the_scores(seed):
    truth, tracks = swapped(np.random.default_rng(seed))
    found = person_scores(truth, tracks, MatchRule("metres", 1.0))
    (scored,) = mcaptrack.evaluation.evaluate(
        [mcaptrack.evaluation.EvaluationInput("a", truth, [mcaptrack.evaluation.Candidate("tracks", None, tracks)])],
        mcaptrack.evaluation.EvaluateOptions(similarities=("metres",), gates_m=(1.0,)),
    ).results
    counts = scored.score.counts
    assert found.switches.sum() == counts["IDSW"] > 0
    assert found.hits.sum() == counts["IDTP"]
    assert found.matched.sum() == counts["TP"]
    assert (found.rows.sum(), found.false_rows) == (counts["TP"] + counts["FN"], counts["FP"])
    assert found.idf1() == pytest.approx(2 * counts["IDTP"] / (2 * counts["IDTP"] + counts["IDFP"] + counts["IDFN"]))


def people(rows, matched, hits, switches, false_rows=0) -> PersonScores:
    none = np.empty(0, np.int64)
    columns = (np.array(column) for column in (rows, matched, hits, switches))
    return PersonScores(np.arange(len(rows)), *columns, false_rows, none, none, none, none)


def test_a_change_of_all_people_is_sure_and_that_of_one_is_not():
    rows = [100] * 12
    before = people(rows, rows, [60] * 12, [2] * 12)
    all_better = people(rows, rows, [80] * 12, [1] * 12)
    one_better = people(rows, rows, [100, *[60] * 11], [0, *[2] * 11])
    assert (intervals([before], [all_better]).idf1_change.sign, intervals([all_better], [before]).idf1_change.sign) == (
        1,
        -1,
    )
    assert intervals([before], [all_better]).idf1_change.low == pytest.approx(0.2)
    assert intervals([before], [one_better]).idf1_change.sign == 0
    assert intervals([before], [all_better]).switches_change == pytest.approx((-1, -1, -1))


def test_too_few_people_and_other_people_give_no_interval():
    few = people([9] * (LEAST_PEOPLE - 1), *[[9] * (LEAST_PEOPLE - 1)] * 2, [0] * (LEAST_PEOPLE - 1))
    found = intervals([few], [few])
    assert (found.idf1_change.is_known, found.idf1_change.sign, found.idf1[0].value) == (False, 0, 1.0)
    assert intervals([few], [few, few]) is None
    assert intervals([few], [few._replace(ids=few.ids + 1)]) is None


# One number for one thing


def test_the_page_has_one_number_of_switches_for_each_kind_of_tracks(told, text):
    (before,) = {int(number) for number in re.findall(r"tracks as given: (\d+) identity switch", text)}
    (after,) = {int(number) for number in re.findall(r"re-tracked: (\d+) identity switch", text)}
    assert (before, after) == (2, 1)
    values = told.headline.values("IDSW")
    assert values == [before, after]
    assert [int(one.switches.sum()) for one in told.people.values()] == values
    assert f"<dd>{before}\N{NO-BREAK SPACE}→ {after}" in text
    assert all(len(one.events) == count for one, count in zip(told.channel_events, values, strict=True))
    described = [one.to_json() for one in told.channel_events]
    assert [len(one["births"]) * one["bin_s"] for one in described] == pytest.approx([59 * 0.4] * len(described))


# Identities over time


def bars(values) -> dict[str, list[list[tuple[str, float, float]]]]:
    """Ids with their seconds of each lane, by the name of the row."""
    found = {}
    for row in values["rows"]:
        lanes = []
        for lane in row["lanes"]:
            titles = [piece["title"].replace("\N{NO-BREAK SPACE}s", "") for piece in lane["pieces"]]
            lanes.append([re.fullmatch(r"(\d+): ([\d.]+) to ([\d.]+)", title).groups() for title in titles])
        found[row["name"]] = lanes
    return found


def test_each_person_has_a_lane_for_the_tracker_above_one_for_the_re_tracked(told):
    found = bars(identity_timeline(told))
    assert list(found) == ["50", "90"]
    assert found["50"] == [
        [("50", "0.0", "24.0")],
        [("1", "0.0", "8.0"), ("2", "8.0", "16.0"), ("3", "16.0", "24.0")],
        [("1", "0.0", "16.0"), ("3", "16.0", "24.0")],
    ]
    assert found["90"] == [[("90", "0.0", "24.0")]] * 3


@given(st.lists(st.integers(0, 2), max_size=40), st.lists(st.integers(1, 4), min_size=40, max_size=40))
def test_pieces_cover_their_rows_and_nothing_twice(identity, steps):
    t_ns = np.cumsum(np.array(steps[: len(identity)], np.int64)) * 10**9
    found = pieces(np.array(identity, np.int64), t_ns, 0, 1e9)
    seconds = (t_ns / 1e9).tolist()
    for at, one in zip(seconds, identity, strict=True):
        assert [piece.identity for piece in found if piece.first_s <= at < piece.last_s] == [one]
    assert all(a.last_s <= b.first_s for a, b in itertools.pairwise(found))
    assert sum(piece.last_s - piece.first_s for piece in found) <= len(identity) + 1e-9


@given(st.lists(st.integers(0, 5), min_size=1, max_size=400))
def test_people_over_time_keep_their_mean(counts):
    frames = [Frame(ns(t), t, tracks_at(dict.fromkeys(range(count), (0.0, 0.0)))) for t, count in enumerate(counts)]
    at_s, found = counts_over_time(frames, 0, max(len(counts) - 1, 1))
    assert (np.diff(at_s) > 0).all()
    assert 0 <= found.min() <= found.max() <= max(counts)
    if len(counts) <= 160:
        assert found.tolist() == counts


@pytest.mark.parametrize(
    ("first", "last", "words"),
    [
        (0, 9, "On average: tracker 4.0, ground truth 8.0."),
        (
            5,
            9,
            "On average, from 5.0 to 9.0 seconds: tracker 8.0, ground truth 8.0.",
        ),  # nobody is counted as missing before
        (0, 4, "On average, from 0.0 to 4.0 seconds: tracker 0.0, ground truth 8.0."),
        (20, 30, "On average, each while it is there: tracker 4.0, ground truth 8.0."),
    ],
)
def test_mean_numbers_are_of_the_time_that_both_have(first, last, words):
    tracker = Line("tracker", "tracks", np.arange(10.0), np.repeat([0.0, 8.0], 5))
    truth = Line("ground truth", "truth", np.arange(first, last + 1.0), np.full(last + 1 - first, 8.0))
    assert mean_numbers([tracker, truth], "seconds") == words


# Maps and doubts


def joined(jump_m: float, other: bool) -> tuple[list[Frame], list[Frame]]:
    """Tracks that join the tracker's 1 and 2 over a gap of 2 s, a ``jump_m`` away; and the ground truth, another
    person after the gap if ``other``.
    """
    tracks, truth = [], []
    for tick in range(40):
        x_m = 0.4 * tick + (jump_m if tick >= 20 else 0.0)
        if not 15 <= tick < 20:
            rows = tracks_at({7: (x_m, 0.0)})
            rows["source_id"] = 1 if tick < 15 else 2
        else:
            rows = tracks_at({})
        tracks.append(Frame(ns(tick / 2.5), tick, rows))
        truth.append(Frame(ns(tick / 2.5), tick, tracks_at({4 if other and tick >= 18 else 3: (x_m, 0.0)})))
    return tracks, truth


@pytest.mark.parametrize(
    ("other", "verdict"), [(False, "agrees: both are person 3"), (True, "person 3 before, person 4")]
)
def test_doubts_say_how_far_a_repair_is_from_the_expected_place(other, verdict):
    tracks, truth = joined(2.5, other)
    found = mcaptrack.evaluation.events.find_events(tracks, truth)
    told = summarize_events("/a", found.events, None, tracks, truth, (0, ns(16)))
    scores = person_scores(truth, tracks, MatchRule("metres", 1.0))
    (doubt,) = find_doubts(told, tracks, scores)
    assert doubt.away_m == pytest.approx(2.5)
    assert (doubt.is_right, verdict in doubt.text(), "2.5\N{NO-BREAK SPACE}m from" in doubt.text()) == (
        not other,
        True,
        True,
    )
    (alone,) = find_doubts(told, tracks, None)
    assert (alone.is_right, alone.verdict) == (None, "")
    nothing, _ = joined(0.0, False)
    assert find_doubts(told, nothing, None) == []


def test_the_farthest_repair_is_the_first_whenever_it_happened():
    near, far = joined(1.5, False)[0], joined(2.5, False)[0]
    both = []
    for one, other in zip(near, far, strict=True):
        rows = other.rows.copy()
        rows["track_id"] = 8
        rows["source_id"] += 10
        rows["y_m"] += 20
        both.append(Frame(one.t_ns, one.index, np.concatenate([one.rows, rows]).astype(one.rows.dtype)))
    found = mcaptrack.evaluation.events.find_events(both, None)
    told = summarize_events("/a", found.events, None, both, None, (0, ns(16)))
    doubts = find_doubts(told, both, None)
    assert [(int(one.event.row["track_id"]), round(one.away_m, 1)) for one in doubts] == [(8, 2.5), (7, 1.5)]


# What a report says of uncertain decisions and of corrected tracks


def test_the_least_likely_tracks_come_first_and_sure_ones_not_at_all():
    rows = DECISIONS.rows(
        kind=[1, 2, 2, 3, 3], track_id=[1, 1, 2, -1, -1], previous_id=[5, -1, -1, -1, -1], source_id=[6, 5, 6, 7, 8],
        probability=[0.1, 0.95, 0.6, 0.55, 0.9], alternative_id=[-1] * 5, duration_s=[0.4, 9.0, 8.0, 7.0, 6.0],
        frames=[0, 20, 19, 18, 17],
    )  # fmt: skip
    found = find_doubtful_tracks([Frame(0, 0, rows)])
    assert [one.text("a person").replace("\N{NO-BREAK SPACE}", " ") for one in found] == [
        "the tracker's 7 is left out, seen for 7.0 s: the probability of being a person is 45 %",
        "track 2 is kept, seen for 8.0 s: the probability of being a person is 60 %",
    ]


def test_what_would_be_otherwise_is_said_of_the_track_before():
    event = IdentityEvent(0, {"previous_id": 606}, 1.0, "track 3 joins the tracker's 606 and 605")
    for other, said in ((8, "606 goes on as 8"), (606, "606 goes on as it did"), (-1, "606 ended, and another came")):
        assert Doubt(event, 0.0, "", None, 0.02, other).text().endswith(f"; otherwise {said}.")


def test_tracks_that_people_corrected_are_named_so(template, tmp_path):
    path = Path(shutil.copy(template, tmp_path / "a.mcap"))
    boxes = mcaptrack.export(path, tmp_path / "a.txt", form="mot").folder
    mcaptrack.ingest(boxes, role="corrections", into=path)
    mcaptrack.run(path)
    with log.read(path) as opened:
        names = {role: tracks.name for role, tracks in gather(opened, None).track_sets.items()}
    assert (names["samples"], names["tracks"]) == ("SORT, corrected", "SORT, every picture")


# Sections of the report that installed packages add: the one of docs/extend.md


@pytest.mark.usefixtures("site")
def test_a_section_of_a_package_stands_in_the_page_and_its_data_in_the_json(finished, tmp_path):
    said = done("report", finished, "-o", tmp_path / "a.html", "--json").out
    page = (tmp_path / "a.html").read_text()
    assert page.count("Frames with tracks.") == 1
    assert 'href="#lengths-0">Lengths</a>' in page
    assert '"lengths"' not in said  # it has no data


@pytest.mark.parametrize(
    ("section", "why"),
    [
        ("1 / 0", "failed: ZeroDivisionError: division by zero (another.py, line 3)"),
        ("'html'", "gave a str; its function has to give a ReportSection"),
        ("ReportSection('a', None)", "gave what is no ReportSection: TypeError: None is no text"),
        ("ReportSection('a', 'b', [('c',)])", "gave what is no ReportSection: ValueError"),
        (
            "ReportSection('a', 'b', [('c', ['d'], [('e', [('tracks', 'f', '/g', [1])])])])",
            "gave what is no ReportSect",
        ),
        ("ReportSection('a', 'b', figures=[3])", "gave what is no ReportSection: TypeError"),
        ("ReportSection('a', 'b', data=object())", "gave what is no ReportSection: TypeError"),
    ],
)
def test_a_section_that_fails_or_is_none_is_one_line(site, finished, tmp_path, section, why):  # noqa: F811
    code = f"from mcaptrack.contracts import ReportSection\ndef Part(*_):\n    return {section}\n"
    add(site, "report_section", "odd", code)
    said = one_line("report", str(finished), "-o", str(tmp_path / "a.html"))
    assert f"report section odd (another 2.0) {why}" in said
    assert not (tmp_path / "a.html").exists()
