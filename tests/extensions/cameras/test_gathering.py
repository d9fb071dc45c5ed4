"""Boxes of several cameras brought to one time, beside a slow search; and which cameras are said to disagree."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from mcaptrack.extensions.cameras import fusing
from mcaptrack.extensions.cameras.feet import CameraView, FootFuser, Offset, Shared
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import collected
from mcaptrack.schema import DETECTIONS, Frame

S = 10**9
#: Of two cameras, the second at 2 cm to a pixel.
PLANES = tuple(GroundPlane((s, 0, 0, 0, s, 0, 0, 0, 1), 640, 480) for s in (0.01, 0.02))


def source(
    name: str, times_s: Sequence[float], late_s: float = 0.0, plane: GroundPlane = PLANES[0], seed: int = 0
) -> Any:
    """Detections at these times, some without a box in pixels."""
    rng = np.random.default_rng(seed)
    frames = []
    for number, t_s in enumerate(times_s):
        count = int(rng.integers(0, 4))
        px = rng.uniform(10, 300, (4, count))
        px[:, rng.random(count) < 0.2] = np.nan
        rows = DETECTIONS.rows(
            **dict(zip(("x_px", "y_px", "w_px", "h_px"), px, strict=True)), x_m=np.zeros(count), y_m=np.zeros(count),
            score=rng.random(count).round(3), class_id=rng.integers(1, 3, count),
        )  # fmt: skip
        frames.append(Frame(round(t_s * S), number + 50, rows))
    t_ns = np.array([frame.t_ns for frame in frames]) - round(late_s * S)
    return fusing.Source(f"/{name}", frames, t_ns, CameraView(name=name, planes=((0, plane),)))


@pytest.mark.parametrize(
    ("steps_s", "late_s", "within_s"),
    [((0.5, 0.2), 0.0, 0.25), ((0.5, 0.2), 0.13, 0.25), ((4.0, 0.7), 0.3, 0.5), ((1.0, 1.0), 1.6, 0.5)],
)
@pytest.mark.parametrize("together", [64, 3])
def test_boxes_of_all_cameras_are_at_the_times_of_the_slowest(steps_s, late_s, within_s, together, monkeypatch):
    monkeypatch.setattr(fusing, "_TOGETHER", together)
    sources = [
        source("fast", np.arange(0.0, 8.0, steps_s[1]) + 0.03, plane=PLANES[1], seed=1),
        source("slow", np.arange(0.0, 8.0, steps_s[0]), late_s, seed=2),
    ]
    fuser = FootFuser(noise=0.05, noise_m=0.2)
    found = fusing.Gathered(sources, fuser)
    slow = next(one for one in sources if len(one.frames) == min(len(each.frames) for each in sources))
    assert found.at.topic == slow.topic or steps_s[0] == steps_s[1]
    at = [(int(t_ns), frame.index) for t_ns, frame in zip(found.at.t_ns, found.at.frames, strict=True)]
    assert found.left_out == sum(t_ns < 0 for t_ns, _ in at)
    assert len(found) == len(at) - found.left_out
    frames = list(found)
    assert [(frame.t_ns, frame.index) for frame in frames] == [one for one in at if one[0] >= 0]
    for _ in range(2):  # what is kept of the first time is the same the second time
        joined = [frame for block in found.joined(fuser, keeps=True) for frame in block.frames]
        assert [(frame.t_ns, frame.index) for frame in joined] == [(frame.t_ns, frame.index) for frame in frames]
    assert found._within_ns == round(within_s * S)
    for frame in frames:
        wanted = []
        for camera, one in enumerate(sources):
            away, k = min((abs(int(t_ns) - frame.t_ns), k) for k, t_ns in enumerate(one.t_ns))
            if away > within_s * S:
                continue
            scale = one.view.planes[0][1].homography[0]
            for row, box in enumerate(one.frames[k].rows):
                if np.isfinite(box["x_px"]):
                    foot = np.array([box["x_px"] + box["w_px"] / 2, box["y_px"] + box["h_px"]]) * scale
                    # uncertain by the box, by the plane, and by how far people walk in between
                    spread = (0.05 * box["h_px"] * scale) ** 2 + 0.2**2 + (away / S) ** 2
                    wanted.append(
                        (camera, one.frames[k].t_ns, row, *foot, spread, 0, spread, box["score"], box["class_id"])
                    )
        names = (
            "camera", "picture_ns", "box_row", "x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2", "score", "class_id",
        )  # fmt: skip
        got = np.array([frame.rows[name].astype(float) for name in names]).T
        np.testing.assert_allclose(got, np.array(wanted, float).reshape(-1, len(names)), rtol=1e-6, atol=1e-9)


def test_of_single_frames_pictures_count_that_are_a_quarter_of_a_second_away():
    for apart_s, count in ((0.25, 2), (0.26, 1)):
        sources = [source("one", [3.0], seed=4), source("other", [3.0 + apart_s], seed=4)]
        found = fusing.Gathered(sources, FootFuser())
        assert len(found) == 1
        (frame,) = found
        assert len(np.unique(frame.rows["camera"])) == count


def offsets_of(*each: tuple[float, int]) -> tuple[Offset, ...]:
    return tuple(Offset(0.0, 0.0, late_s, compared) for late_s, compared in each)


@pytest.mark.parametrize(
    ("late", "given", "offset_s", "calls"),
    [
        # what is seen late in each round, by camera; the offsets in the end
        ([(0.119, -0.1)], {}, {"a": 0.0, "b": 0.0}, 1),
        ([(0.2, -0.5), (0.2, 0.0), (0.01, 0.0)], {}, {"a": 0.2, "b": -0.5}, 3),
        ([(0.3, np.nan), (0.12, np.nan), (0.12, np.nan)], {}, {"a": 0.54, "b": 0.0}, 3),
        ([(0.3, 0.2)], {"a": 0.1}, {"a": 0.1, "b": 0.0}, 1),  # the worst one is as the user says
        ([(0.1, 0.4), (0.1, 0.0)], {"a": 0.1}, {"a": 0.1, "b": 0.4}, 2),
        ([(np.nan, np.nan)], {}, {"a": 0.0, "b": 0.0}, 1),
    ],
)
def test_clocks_are_set_one_at_a_time_the_worst_first(late, given, offset_s, calls, monkeypatch):
    taken: list[list[int]] = []
    starts: list[list[int]] = []

    def compare(blocks, views, taken_ns):
        taken.append(list(taken_ns))
        starts.append([sum(len(block.frames) for block in blocks)])
        return views, offsets_of(*((one, 99) for one in late[len(taken) - 1])), Shared(9, 9)

    monkeypatch.setattr(fusing, "compare", compare)
    sources = [source("a", np.arange(2, 8, 0.5)), source("b", np.arange(2, 8, 0.5), plane=PLANES[1])]
    gathered, fuser, offsets, found, shared = fusing.compared_cameras(sources, FootFuser(), given)
    assert found == pytest.approx(offset_s)
    assert len(taken) == calls
    assert taken[0] == [round(given.get(name, 0.0) * S) for name in ("a", "b")]
    assert starts[0] == [12]
    assert [view.name for view in fuser.views] == ["a", "b"]
    assert (len(offsets), shared, len(gathered)) == (2, Shared(9, 9), 12)
    moved = {one.view.name: int(one.t_ns[0] - frame.t_ns) for one in gathered._sources for frame in one.frames[:1]}
    late_by = {name: -round((offset_s[name] - given.get(name, 0.0)) * S) for name in offset_s}
    if calls < 3:
        assert moved == pytest.approx(late_by)


def said(
    offset: Offset, taken_s: float = 0.0, given: dict[str, float] | None = None, others: int = 1
) -> list[tuple[str, str]]:
    views = [CameraView(name="a", planes=()), *[CameraView(name="b", planes=())] * others]
    with collected() as notices:
        fusing.warn_disagreeing(
            "a.mcap", views, [offset, *offsets_of((0.0, 60)) * others], {"a": taken_s, "b": 0.0}, given or {}
        )
    return [(notice.code, notice.message) for notice in notices]


class TestDisagreeing:
    @pytest.mark.parametrize(("x_m", "compared", "is_said"), [(0.25, 50, False), (0.26, 50, True), (9.0, 49, False)])
    def test_planes_that_are_off(self, x_m, compared, is_said):
        found = [message for code, message in said(Offset(0.0, x_m, 0.0, compared)) if code == "cameras-disagree"]
        assert len(found) == is_said
        if is_said:
            assert found[0].startswith("a: feet stand 0.26 m from where the other cameras see them (median of 50); ")

    @pytest.mark.parametrize(
        ("late_s", "word"), [(0.12, ""), (-0.12, ""), (0.125, "late"), (-0.5, "early"), (np.nan, "")]
    )
    def test_clocks_that_seem_off(self, late_s, word):
        found = said(Offset(0.0, 0.0, late_s, 60))
        assert [code for code, _ in found] == ["clock"] * bool(word)
        if word:
            assert found[0][1] == f"a: its times seem {abs(late_s):.2f} s {word}, as people who walk show"

    def test_clocks_that_were_set(self):
        for taken_s, word in ((0.25, "0.25 s late"), (-0.5, "0.50 s early")):
            ((code, message),) = said(Offset(0.0, 0.0, 0.5, 60), taken_s)
            assert (code, message.startswith(f"a: its times are {word}, as people who walk show; ")) == ("clock", True)
        ((_, message),) = said(Offset(0.0, 0.0, 0.5, 60), 0.25, {"a": 0.25})  # as the user says
        assert "seem 0.50 s late" in message

    @pytest.mark.parametrize(("compared", "others", "is_said"), [(50, 1, False), (49, 1, True), (0, 0, False)])
    def test_cameras_that_cannot_be_compared(self, compared, others, is_said):
        found = said(Offset(0.0, 0.0, 0.0, compared), others=others)
        assert [code for code, _ in found] == ["other"] * is_said
        if is_said:
            assert found[0][1].startswith("a: only 49 of its boxes are near people seen by two other cameras")
