"""The tracker of mcaptrack.transforms.ground against a slow one, a track and a detection at a time: the same rows."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.notices import collected
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.transforms import GroundTracker
from mcaptrack.transforms import ground as tracker
from mcaptrack.transforms.motion_limits import LIMITS
from tests.references import ground

COLUMNS = {
    "x": "x_m", "y": "y_m", "z": "z_m", "length": "length_m", "width": "width_m", "height": "height_m",
    "heading": "heading_rad", "vx": "vx_m_per_s", "vy": "vy_m_per_s", "score": "score", "class": "class_id",
    "source": "source_id",
}  # fmt: skip
NAMES = ((1, "person"), (2, "car"), (3, "truck"))
KINDS = {number: LIMITS[name] for number, name in NAMES}


def drawn(seed: int, count: int, has_speeds: bool = False) -> list[tuple[int, list[dict[str, float]]]]:
    """Objects on lines and arcs that cross, with what detectors do: gaps, clutter, half turns, other classes, outliers
    of size, columns that are missing, frames at one time, and one long pause."""
    rng = np.random.default_rng(seed)
    steps = rng.choice([0.1, 0.1, 0.1, 0.15, 0.3], count)
    steps[0], steps[count // 3], steps[count // 2] = 0, 0, 0.8
    times = np.cumsum(np.round(1e9 * steps).astype(int))
    objects = []
    for number in range(7):
        kind = 1 + number % 3
        speed, turn = rng.uniform(0.5, 2 if kind == 1 else 9), rng.uniform(-0.6, 0.6) * (kind > 1)
        objects.append((kind, speed, turn, rng.uniform(-3, 3), rng.uniform(-12, 12, 2), rng.uniform(0, 1.5)))
    frames = []
    for t_ns in times.tolist():
        t = t_ns / 1e9
        found = []
        for number, (kind, speed, turn, heading, start, born) in enumerate(objects):
            if t < born or rng.random() < 0.2:
                continue
            now = heading + turn * t
            way = np.array([np.sin(now) - np.sin(heading), np.cos(heading) - np.cos(now)]) / turn if turn else t
            place = start + speed * (way if turn else t * np.array([np.cos(heading), np.sin(heading)]))
            size = np.array([0.6, 0.6, 1.7]) if kind == 1 else np.array([4.5, 2.0, 1.6]) * kind / 2
            size = size * rng.uniform(0.9, 1.1, 3) * (2.5 if rng.random() < 0.1 else 1)
            one = dict(zip(("x", "y"), place + rng.normal(0, 0.1, 2), strict=True))
            one |= dict(zip(("length", "width", "height"), size, strict=True))
            one |= {"z": 1 + rng.normal(0, 0.1), "heading": ground.wrapped(now + np.pi * (rng.random() < 0.15))}
            one |= {"score": rng.uniform(0.1, 0.9), "class": kind, "source": number}
            one |= {
                "vx": speed * np.cos(now) if has_speeds else np.nan,
                "vy": speed * np.sin(now) if has_speeds else np.nan,
            }
            if rng.random() < 0.1:
                one["class"] = 1 + kind % 3
            for name in ("z", "heading", "score", "vx"):
                if rng.random() < 0.1:
                    one[name] = np.nan
            if rng.random() < 0.1:
                one |= dict.fromkeys(("length", "width", "height"), np.nan)
            found.append(one)
        for _ in range(rng.poisson(0.5)):
            clutter = dict.fromkeys(COLUMNS, np.nan)
            found.append(
                clutter | {"x": rng.uniform(-15, 15), "y": rng.uniform(-15, 15), "score": rng.uniform(0, 1)}
                | {"class": int(rng.integers(1, 4)), "source": -1}
            )  # fmt: skip
        frames.append((t_ns, found))
    return frames


CASES = [
    {},
    {"delay_s": 0.0},
    {"delay_s": 0.5, "max_age_s": 0.5},
    {"across_classes": True, "confirm_score": 2.0},
    {"least_iou": 0.1, "birth_score": 0.5},
    {"has_speeds": True, "confirm_score": 0.0},
]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("case", CASES, ids=str)
def test_tracks_equal_the_reference(case, seed, monkeypatch):
    """But for second detections beyond the gate, which test_ground has."""
    nothing = np.empty(0, np.intp)
    monkeypatch.setattr(tracker, "fast_starts", lambda *_: (nothing, nothing))
    options = {key: value for key, value in case.items() if key != "has_speeds"}
    drawing = drawn(seed, 36, "has_speeds" in case)
    frames = [
        Frame(t, number, DETECTIONS.rows(**{name: [one[key] for one in found] for key, name in COLUMNS.items()}))
        if found else Frame(t, number, DETECTIONS.empty())
        for number, (t, found) in enumerate(drawing)
    ]  # fmt: skip
    wanted = ground.ground_tracks(drawing, KINDS, **options)
    if "least_iou" in options:
        options |= {"cost": "iou", "min_iou": options.pop("least_iou")}
    options = {"max_age_s": 2.0, "link_s": 0.0} | options  # the reference continues no lost tracks
    with collected() as warnings:
        made = [frame for (frame,) in GroundTracker(class_names=NAMES, **options)(frames)]
    assert not warnings
    assert [(frame.t_ns, frame.index) for frame in made] == [(frame.t_ns, frame.index) for frame in frames]
    for number, (frame, rows) in enumerate(zip(made, wanted, strict=True)):
        names = {"id": "track_id", "observed": "observed"} | COLUMNS
        for key, name in names.items():
            found, right = frame.rows[name].astype(float), np.array([one[key] for one in rows], float)
            if key == "heading" and len(found) == len(right):  # the same angle at the end of the circle
                found = right + np.remainder(found - right + np.pi, 2 * np.pi) - np.pi
            np.testing.assert_allclose(found, right, atol=1e-5, err_msg=f"frame {number}: {name}")
    count = sum(map(len, wanted))
    assert count > 50
    assert any(not one["observed"] for rows in wanted for one in rows) == (case.get("delay_s") != 0.0)
