"""Rows of people who are outside of the picture: interpolated and coasting boxes that the camera can't see."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from mcaptrack import log
from mcaptrack.geometry.boxes import columns_to_boxes, share_inside
from mcaptrack.notices import collected
from mcaptrack.pipeline.planes import without_unseen
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame
from tests.commands import done
from tests.tiers import thorough
from tests.worlds import write_clip

SIZE = (320, 240)
#: Left edges and tops in the first picture of people who stand, 20 px wide and 60 px high.
PEOPLE = [(60.0, 60.0), (150.0, 150.0)]


def rows(*people: tuple) -> np.ndarray:
    """Rows of (id, left, top, width, height, is observed)."""
    columns = zip(*people, strict=True)
    names = ("track_id", "x_px", "y_px", "w_px", "h_px", "observed")
    given = dict(zip(names, (list(column) for column in columns), strict=True))
    nothing = {"x_m": [0.0] * len(people), "y_m": [0.0] * len(people), "source_id": [-1] * len(people)}
    return TRACKS.rows(**nothing, **given)


def ids(channels: dict, topic: str) -> list[list[int]]:
    return [frame.rows["track_id"].tolist() for frame in channels[topic][1]]


def test_share_of_a_box_inside_by_hand():
    boxes = np.array([[0, 0, 10, 10], [-5, 0, 10, 10], [-5, 235, 10, 10], [400, 0, 10, 10], [0, 0, 0, 5]], float)
    boxes = np.concatenate([boxes, np.full((1, 4), np.nan)])
    found = share_inside(boxes, *SIZE)
    assert found[:4].tolist() == [1.0, 0.5, 0.25, 0.0]
    assert np.isnan(found[4:]).all()


def test_rows_outside_of_the_picture_are_left_out_unless_observed():
    seen = [(1, 10, 10, 20, 60, True), (2, 100, 100, 20, 60, True)]
    # half inside; a little less; outside; outside but observed; no box
    odd = [(3, -10, 0, 20, 60, False), (4, -11, 0, 20, 60, False), (5, 500, 0, 20, 60, False)]
    odd += [(6, -15, 0, 20, 60, True), (7, np.nan, np.nan, np.nan, np.nan, False)]
    frames = [Frame(k, k, rows(*seen)) for k in range(20)] + [Frame(20, 20, rows(*seen, *odd))]
    with collected() as warnings:
        found = without_unseen({"/a/retracks": (TRACKS, frames)}, lambda: SIZE)
    assert [(notice.code, notice.message) for notice in warnings] == [
        ("left-out", "/a/retracks: left out 2 predicted rows outside of the picture, where nothing can be detected")
    ]
    assert ids(found, "/a/retracks") == [[1, 2]] * 20 + [[1, 2, 3, 6, 7]]
    assert [(frame.t_ns, frame.index) for frame in found["/a/retracks"][1]] == [(k, k) for k in range(21)]


@pytest.mark.parametrize("size", [None, (160, 120)], ids=["no pictures", "smaller pictures than those of the boxes"])
def test_rows_are_kept_where_the_size_of_pictures_says_nothing(size):
    frames = [Frame(0, 0, rows((1, 200, 130, 20, 60, True), (2, 10, 10, 20, 60, True), (3, 500, 10, 20, 60, False)))]
    assert ids(without_unseen({"/a/retracks": (TRACKS, frames)}, lambda: size), "/a/retracks") == [[1, 2, 3]]


def test_pictures_are_not_asked_for_where_all_is_observed():
    frames = [Frame(0, 0, rows((1, 500, 130, 20, 60, True)))]
    without_unseen({"/a/tracks": (TRACKS, frames), "/a/predictions": (PREDICTIONS, [])}, lambda: pytest.fail("asked"))


def test_predictions_go_with_their_rows_of_online_tracks():
    both = rows((1, 10, 10, 20, 60, True), (2, 500, 100, 20, 60, False))
    steps = PREDICTIONS.empty(4)
    steps["track_id"], steps["step"] = [1, 1, 2, 2], [1, 2, 1, 2]
    for name in ("x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2"):
        steps[name] = 0.0
    back = rows((1, 10, 10, 20, 60, True), (2, 200, 100, 20, 60, False))
    given = {
        "/a/retracks": (TRACKS, [Frame(0, 0, both[:1]), Frame(1, 1, both[:1])]),
        "/a/retracks/online": (TRACKS, [Frame(0, 0, both), Frame(1, 1, back)]),
        "/a/retracks/predictions": (PREDICTIONS, [Frame(0, 0, steps), Frame(1, 1, steps)]),
    }
    found = without_unseen(given, lambda: SIZE)
    assert ids(found, "/a/retracks/online") == [[1], [1, 2]]
    assert ids(found, "/a/retracks/predictions") == [[1, 1], [1, 1, 2, 2]]
    assert ids(found, "/a/retracks") == [[1], [1]]


def sway(frame: int) -> float:
    """By how much the scene has moved to the left in a frame, in pixels."""
    return 70 * float(1 - np.cos(2 * np.pi * frame / 30))


@thorough
def test_who_leaves_a_picture_that_sways_has_no_row_until_he_is_back(tmp_path: Path, monkeypatch):
    """The first person leaves the picture again and again, the second one is missed for a while inside of it."""
    monkeypatch.chdir(tmp_path)
    write_clip(Path("a.mp4"), 90, size=SIZE)
    lines, motions = [], []
    for n in range(90):
        seen = [(x - sway(n), y) for k, (x, y) in enumerate(PEOPLE) if k == 0 or n not in range(40, 47)]
        lines += [f"{n + 1},-1,{x:.3f},{y},20,60,1,-1,-1,-1" for x, y in seen if x >= -2]
        motions.append(f"{n} 1 0 {sway(n - 1) - sway(n) if n else 0:.6f} 0 1 0")
    Path("det.txt").write_text("\n".join(lines) + "\n")
    Path("motion.txt").write_text("\n".join(motions) + "\n")
    Path("plane.txt").write_text("0.02 0.004 -9\n0 0.03 -8\n0 0.0004 1\n")
    done("ingest", "a.mp4", "--ground-plane", "plane.txt", "-o", "a.mcap", "-q")
    done("ingest", "det.txt", "--as", "detections", "--into", "a.mcap", "-q")
    done("ingest", "motion.txt", "--as", "motion", "--into", "a.mcap", "-q")
    made = done("run", "a.mcap", "--no-tables", "--json")
    warnings = [one["message"] for one in json.loads(made.out)["warnings"] if one["code"] == "left-out"]
    assert [line for line in made.err.splitlines() if "outside of the picture" in line]
    assert {words.partition(":")[0] for words in warnings if "outside of the picture" in words} >= {"/camera/retracks"}
    with log.read(tmp_path / "a.mcap") as opened:
        names = ("samples", "retracks", "retracks/online", "retracks/full")
        found = {name: opened.frames(f"/camera/{name}", TRACKS) for name in names}
    for name, frames in found.items():
        every = np.concatenate([frame.rows for frame in frames])
        assert (share_inside(columns_to_boxes(every), *SIZE)[~every["observed"]] >= 0.5).all(), name
    full = found["retracks/full"]
    by_height = [{round(float(row["y_px"]), -1): bool(row["observed"]) for row in frame.rows} for frame in full]
    assert [60 in by_height[n] for n in (5, 15, 25, 45, 55, 75)] == [True, False, True, False, True, False]
    assert [by_height[n].get(150) for n in range(41, 46)] == [False] * 5  # missed, but in the picture
    assert len({int(row["track_id"]) for frame in full for row in frame.rows}) == len(PEOPLE)
    module = sys.modules["mcaptrack.pipeline.steps"]
    monkeypatch.setattr(module, "without_unseen", lambda channels, _: pytest.fail("rows are left out"))
    done("retrack", "a.mcap", "--profile", "authors", "-q")  # a track goes on outside, as in the paper
    with pytest.raises(pytest.fail.Exception):
        done("retrack", "a.mcap", "-q")
