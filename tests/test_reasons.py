"""What is said where nothing comes of an input, or not what was wanted: reasons by hand, at their bounds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from mcaptrack.geometry.affine import IDENTITY
from mcaptrack.geometry.camera_path import CameraPose, Verdict
from mcaptrack.notices import collected
from mcaptrack.pipeline.rebuild import differing
from mcaptrack.schema import Frame
from mcaptrack.transforms import (
    KnnDetector,
    MedianDetector,
    OcSort,
    OnnxDetector,
    Predict,
    Retrack,
    Sample,
    Sort,
    motion,
)
from mcaptrack.transforms.ground import GroundTracker
from mcaptrack.transforms.motion import EstimateMotion
from mcaptrack.transforms.predict import own_options
from mcaptrack.transforms.protocol import option
from mcaptrack.transforms.retrack.options import longest_track_s
from tests.worlds import ns, walk


def rows(count: int) -> np.ndarray:
    return np.zeros(count)


@pytest.mark.parametrize(
    ("transform", "reason"),
    [
        (Sample(), "no track lasts for two sample times, or none stands on the ground plane"),
        (GroundTracker(), "no track of 7 detections is confirmed (confirm_score)"),
        (Sort(), "no track of 7 detections is confirmed (min_hits_s): too few pictures a second, perhaps"),
        (MedianDetector(), "nothing in its 2 pictures differs from their median by more than the threshold"),
        (KnnDetector(), "no motion in its 2 pictures exceeds the threshold"),
        (OnnxDetector(min_score=0.25), "the network finds no person with a score of at least 0.25"),
        (OnnxDetector(classes="ALL"), "the network finds nothing with a score of at least 0.1"),
        (Predict(), "no track has the 1.2 s without a gap that a prediction needs (min_history)"),
        (
            Predict(rate_hz=10.0, min_history=3),
            "no track has the 0.2 s without a gap that a prediction needs (min_history)",
        ),
        (EstimateMotion(), "it has no pictures that can be decoded"),
    ],
)
def test_why_nothing_came_of_it(transform: Any, reason: str):
    given = [Frame(0, 0, rows(3)), Frame(1, 1, rows(0)), Frame(2, 2, rows(4))]
    assert transform.why_empty(given, given[:2]) == reason


@pytest.mark.parametrize(
    ("least_s", "confidence", "reason"),
    [
        (2.0, 0.0, "no track is likely enough to be a person (track_confidence)"),
        (2.5, 0.0, "the longest track lasts 2 s; those under 2.5 s are left out (min_track_s)"),
        (2.5, 0.5, "no track is likely enough to be a person (track_confidence)"),
    ],
)
def test_why_no_track_is_left(least_s: float, confidence: float, reason: str):
    """The second of three tracks, whose rows lie between those of others, lasts from 0.4 to 2.4 s."""
    frames = walk(lambda n: {4: (0, 0)} | ({7: (1, 0)} if 1 <= n <= 6 else {}) | ({9: (2, 0)} if n == 3 else {}), 7)
    for frame in frames:
        frame.rows["track_id"][frame.rows["track_id"] == 4] = 4 + 100 * frame.index  # each of one row
    assert longest_track_s(frames) == 2.0
    retrack = Retrack(min_track_s=least_s, track_confidence=confidence)
    assert retrack.why_empty(frames, []) == reason  # a third of 2.4 s is enough where how likely tracks are counts


class _Poses:
    """Poses of which these are cut or lost."""

    def __init__(self, cut: set[int], lost: set[int]) -> None:
        self._number, self._cut, self._lost = 0, cut, lost

    def step(self, image: object, boxes: object) -> CameraPose:
        number, self._number = self._number, self._number + 1
        verdict = Verdict.CUT if number in self._cut else Verdict.LOST if number in self._lost else Verdict.STILL
        return CameraPose(IDENTITY, IDENTITY, 0, 9.0, verdict)


@pytest.mark.parametrize(
    ("count", "cut", "lost", "said"),
    [
        (10, set(), set(), []),
        (10, {4}, set(), ["there is a cut at 2.0 s: another scene begins there, and tracks end"]),
        (10, {7, 9}, set(), ["there is 2 cuts, the first at 3.5 s: another scene begins there, and tracks end"]),
        (50, set(), {3}, ["the motion of the camera is not known in 2% of the pictures; it is taken as none"]),
        (51, set(), {3}, []),
        (4, {1}, {2, 3}, ["there is a cut at 0.5 s: ", "not known in 50% of the pictures"]),
        (0, set(), set(), []),
    ],
)
def test_cuts_and_pictures_without_a_motion_are_said(count, cut, lost, said, monkeypatch):
    monkeypatch.setattr(motion, "MotionEstimator", lambda: _Poses(cut, lost))
    picture = np.zeros((48, 64), np.uint8)
    with collected() as notices:
        found = [one for (one,) in EstimateMotion()([Frame(ns(7 + n / 2), n + 5, picture) for n in range(count)])]
    assert [(frame.t_ns, frame.index) for frame in found] == [(ns(7 + n / 2), n + 5) for n in range(count)]
    assert {(int(row["width_px"]), int(row["height_px"])) for frame in found for row in frame.rows} <= {(64, 48)}
    assert [notice.code for notice in notices] == ["view-lost"] * len(said)
    for notice, words in zip(notices, said, strict=True):
        assert words in notice.message


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        (Sort(), ""),
        (Sort(max_age_s=2.0), "max_age_s 2.0, not 1.4"),
        (
            Sort(max_age_s=2.0, min_iou=0.5, min_hits_s=1.0),
            "max_age_s 2.0, not 1.4; min_iou 0.5, not 0.2; min_hits_s 1.0, not ",
        ),
        (OcSort(), "OcSort, not Sort"),
    ],
)
def test_what_differs_of_two_transforms(wanted: Any, words: str):
    found = differing(Sort(max_age_s=1.4, min_iou=0.2), wanted)
    assert (
        sorted(part.split()[0] for part in found.split("; ")) == sorted(part.split()[0] for part in words.split("; "))
        if words
        else not found
    )
    for part in words.split("; "):
        assert part in found


def test_of_many_that_differ_three_are_named():
    one = Sort()
    other = Sort(max_age_s=9.0, min_iou=0.9, min_hits_s=9.0, cost="metres")
    assert differing(one, other).count(", not ") == 3
    assert differing(one, other).endswith("; and 1 more")


def test_own_options_are_those_with_a_default_that_the_interface_does_not_have():
    def plain(steps, step_s=0.4, *rest, gain=2.0, name="x", depth: int | None = 3, unset=None, **more):
        raise NotImplementedError

    assert [(one.name, one.annotation, one.default, one.metadata) for one in own_options(plain)] == [
        ("gain", float, 2.0, {}),
        ("depth", int | None, 3, {}),
        ("unset", type(None) | None, None, {}),
    ]

    class Plain:
        past = 4

        def __init__(self, steps: int, step_s: float, needed, size: int = 4, *, mode: str = None):  # noqa: RUF013
            raise NotImplementedError

    assert [(one.name, one.annotation, one.default) for one in own_options(Plain)] == [
        ("size", int, 4),
        ("mode", str | None, None),
    ]

    @dataclass
    class Declared:
        steps: int
        step_s: float = 0.4
        width: float = option(1.5, "how wide", least=0.5)
        names: tuple[str, ...] = field(default_factory=lambda: ("a", "b"))

    width, names = own_options(Declared)
    assert (width.name, width.annotation, width.default, width.metadata["least"]) == ("width", float, 1.5, 0.5)
    assert (names.name, names.default) == ("names", ("a", "b"))
    assert own_options(len) == []  # nothing is known of its arguments' defaults
