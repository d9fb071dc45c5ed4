"""The trackers against second, slow implementations, box by box, on random walks."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.transforms import TRACKERS
from tests.references.sort import Box, ReferenceByteTrack, ReferenceOcSort, ReferenceSort
from tests.worlds import ns

REFERENCES = {"sort": ReferenceSort, "bytetrack": ReferenceByteTrack, "ocsort": ReferenceOcSort}
PLANE = ((0, GroundPlane((0.05, 0, 0, 0, 0.05, 0, 0, 0, 1), 640, 480)),)
#: Options with a few values that change the course of each.
SHARED = {
    "max_age_frames": [None, None, 1, 4],
    "max_age_s": [0.15, 0.3, 1.0],
    "min_hits_frames": [None, None, 0, 2],
    "min_hits_s": [0.0, 0.1, 0.3],
    "cost": ["iou", "iou", "pixels", "metres"],
    "min_iou": [0.0, 0.2, 0.5],
    "max_distance_px": [15.0, 40.0],
    "max_distance_m": [0.5, 2.0],
    "min_score": [None, 0.3],
    "class_id": [None, None, 1],
    "across_classes": [False, True],
    "ground_planes": [PLANE],
}
OWN = {
    "sort": {},
    "bytetrack": {"high_score": [0.5, 0.7], "new_score": [0.4, 0.6], "low_min_iou": [0.1, 0.5]},
    "ocsort": {
        "inertia": [0.0, 0.2, 0.6],
        "direction_frames": [2, 3, 5],
        "recover": [False, True],
        "reupdate": [False, True],
    },
}


def walking(rng: np.random.Generator, count: int = 45) -> list[Frame]:
    """Boxes of people that cross, with missed detections, two classes, and irregular frame times; some shrink fast."""
    place, speed, size = rng.uniform(60, 160, (4, 2)), rng.normal(0, 5, (4, 2)), rng.uniform([15, 30], [25, 50], (4, 2))
    kind = rng.choice([1, 1, 1, 2], 4)
    grows = rng.choice([1.0, 1.0, 0.7, 1.04], (4, 1))  # at 0.7 the predicted area would become negative
    back, now, frames = np.zeros(4), 0.0, []
    period = 0.1
    for number in range(count):
        if rng.random() < 0.02:
            period = float(rng.choice([0.033, 0.1]))
        steps = int(rng.choice([1, 1, 1, 1, 1, 1, 3]))
        now += period * (steps + rng.uniform(-0.05, 0.05))
        speed = speed + rng.normal(0, 1, speed.shape)
        place = place + steps * speed
        size = np.maximum(size * grows**steps, 3.0)
        back = np.where((back <= number) & (rng.random(4) < 0.08), number + rng.integers(1, 7, 4), back)
        there = rng.permutation(np.flatnonzero(back <= number))
        wide, high = (size[there] * rng.uniform(0.9, 1.1, (len(there), 2))).T
        x, y = (place[there] + rng.normal(0, 1, (len(there), 2))).T
        rows = DETECTIONS.rows(
            x_px=x,
            y_px=y,
            w_px=wide,
            h_px=high,
            score=rng.choice([0.2, 0.45, 0.65, 0.9, np.nan], len(there)),
            class_id=kind[there],
        )
        frames.append(Frame(ns(now), number, rows))
    return frames


@pytest.mark.parametrize("name", TRACKERS)
@given(seed=st.integers(0, 2**32 - 1), data=st.data())
@settings(max_examples=15)
def test_tracks_equal_the_reference(name, seed, data):
    values = SHARED | OWN[name]
    options = TRACKERS[name](**data.draw(st.fixed_dictionaries({k: st.sampled_from(v) for k, v in values.items()})))
    frames = walking(np.random.default_rng(seed))
    boxes = [
        (
            frame.t_ns,
            [
                Box(
                    float(r["x_px"]),
                    float(r["y_px"]),
                    float(r["x_px"] + r["w_px"]),
                    float(r["y_px"] + r["h_px"]),
                    float(r["score"]),
                    int(r["class_id"]),
                )
                for r in frame.rows
            ],
        )
        for frame in frames
    ]
    wanted = REFERENCES[name](options).run(boxes)
    for (frame,), tracks in zip(options(frames), wanted, strict=True):
        rows = frame.rows
        assert rows["track_id"].tolist() == [who for who, _, _ in tracks]
        found = np.stack(
            [rows["x_px"], rows["y_px"], rows["x_px"] + rows["w_px"], rows["y_px"] + rows["h_px"]], axis=-1
        )
        theirs = np.array([(box.left, box.top, box.right, box.bottom) for _, box, _ in tracks]).reshape(-1, 4)
        np.testing.assert_allclose(found, theirs, rtol=1e-7, atol=1e-6)
        np.testing.assert_allclose(rows["score"], np.array([score for _, _, score in tracks]), rtol=1e-6)
        feet = np.stack([(theirs[:, 0] + theirs[:, 2]) / 2, theirs[:, 3]], axis=-1) * 0.05
        np.testing.assert_allclose(np.stack([rows["x_m"], rows["y_m"]], axis=-1), feet, atol=1e-6)
        assert rows["observed"].all()
        assert (rows["source_id"] == -1).all()


@pytest.mark.parametrize("name", TRACKERS)
def test_every_option_is_varied(name):
    moved = {"camera_motion", "camera_path"}  # test_camera_motion_tracking.py has scenes of these
    assert {option.name for option in fields(TRACKERS[name])} - moved == {*SHARED, *OWN[name]}
