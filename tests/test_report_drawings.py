"""Charts and maps of the report: where each thing stands, by hand."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from mcaptrack.evaluation.people import Interval, Intervals
from mcaptrack.viewing.report import charts
from mcaptrack.viewing.report.charts import Axis, Bars, Line
from mcaptrack.viewing.report.headline import rules_text
from mcaptrack.viewing.report.scene_map import SceneBackground, TrackPath, ground_map, heat_map, picture_map
from mcaptrack.viewing.report.summary import change_text, verdict
from tests.worlds import walk

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
