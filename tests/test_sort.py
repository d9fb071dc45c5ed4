"""The trackers on small scenes, and SORT against the output of the original program."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.transforms import TRACKERS
from mcaptrack.transforms.sort import Sort
from mcaptrack.transforms.sort.tracker import distance_pairs
from tests.references.sort import Box, ReferenceByteTrack, ReferenceOcSort, ReferenceSort
from tests.worlds import boxes_at, ids, ns

FRAMES = {"max_age_frames": 2, "min_hits_frames": 2, "min_iou": 0.3}


@pytest.mark.parametrize("kind", TRACKERS.values(), ids=TRACKERS)
def test_filters_that_no_detection_passes_are_a_warning(kind):
    rows = boxes_at([(50, 50), (90, 50)], score=0.5)
    rows["class_id"] = [3, 1]
    frames = [Frame(ns(n / 10), n, rows if n % 2 else rows[:0]) for n in range(200)]

    def said(**options) -> list[str]:
        with notices.collected() as found, notices.listening(found.append):
            assert sum(len(frame.rows) for frame in run(frames, kind, **options)) == 0 or not found
        return [notice.message for notice in found]

    assert said(class_id=7) == ["no detection has class 7, so there are no tracks; the classes are 1, 3"]
    assert said(min_score=0.6) == [
        "no detection has a score of 0.6 or more, so there are no tracks; the highest is 0.5"
    ]
    assert said(class_id=3) == said(min_score=0.5) == said() == []
    frames = frames[:1]
    assert said(class_id=7) == []  # where nothing was detected at all


def run(frames, kind=Sort, **options):
    return [frame for (frame,) in kind(**(FRAMES | options))(frames)]


def test_degenerate_boxes_are_ignored():
    rows = boxes_at([(50, 50), (90, 50), (130, 50)])
    rows["w_px"][1], rows["h_px"][2] = 0.0, -3.0
    out = run([Frame(ns(n / 10), n, rows) for n in range(6)])
    assert ids(out[-1]) == [1]
    assert np.isfinite(out[-1].rows["x_px"]).all()


def test_a_score_at_the_limit_and_the_largest_class_pass():
    rows = boxes_at([(50, 50), (120, 50)])
    rows["score"], rows["class_id"] = [0.5, np.nextafter(np.float32(0.5), np.float32(0))], [2**31 - 1, 1]
    frames = [Frame(ns(n / 10), n, rows) for n in range(6)]
    assert ids(run(frames, min_score=0.5)[-1]) == [1]
    assert ids(run(frames, class_id=2**31 - 1)[-1]) == [1]
    with pytest.raises(McaptrackError, match=r"^class_id has to be from 0 to 2147483647, not 2147483648$"):
        Sort(class_id=2**31)


def test_a_pair_at_the_gate_is_beyond_it():
    """Boxes whose centres are 3 and 4 pixels apart along the axes; and two others far away."""
    boxes = np.array([(0.0, 0, 10, 10), (1000, 0, 1010, 10)]).T
    predicted = np.array([(3.0, 4, 13, 14), (0, 500, 10, 510)]).T
    assert len(distance_pairs(boxes, predicted, 5.0, None).detection) == 0
    pairs = distance_pairs(boxes, predicted, 8.0, None)
    assert (pairs.detection.tolist(), pairs.track.tolist(), pairs.similarity.tolist()) == ([0], [0], [0.375])
    assert pairs.shape == (2, 2)
    assert distance_pairs(boxes[:, :1], predicted, 1.0, None).shape == (1, 2)


@pytest.mark.parametrize(
    "sequence", ["ADL-Rundle-6", "ETH-Sunnyday", "KITTI-17", "PETS09-S2L1", "TUD-Campus", "TUD-Stadtmitte"]
)
def test_boxes_are_those_of_the_original_program(data, sequence):
    found = np.loadtxt(data / "mot15" / sequence / "det" / "det.txt", delimiter=",")
    wanted = np.loadtxt(data / "mot15" / sequence / "reference" / "sort.txt", delimiter=",")[:, :6]
    frames = []
    for number in range(1, int(found[:, 0].max()) + 1):
        x, y, w, h, score = found[found[:, 0] == number][:, 2:7].T
        rows = DETECTIONS.rows(x_px=x, y_px=y, w_px=w, h_px=h, score=score, class_id=np.ones(len(x), int))
        frames.append(Frame(ns(number / 30), number, rows))
    ours = np.array(
        [
            (frame.index, row["track_id"], row["x_px"], row["y_px"], row["w_px"], row["h_px"])
            for frame in run(frames, max_age_frames=1, min_hits_frames=3)
            for row in frame.rows
        ]
    )
    ours, wanted = (rows[np.lexsort((rows[:, 3].round(2), rows[:, 2].round(2), rows[:, 0]))] for rows in (ours, wanted))
    assert ours.shape == wanted.shape
    np.testing.assert_allclose(ours[:, [0, 2, 3, 4, 5]], wanted[:, [0, 2, 3, 4, 5]], atol=0.00501)
    pairs = {(int(a), int(b)) for a, b in zip(ours[:, 1], wanted[:, 1], strict=True)}
    assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})


# The trackers against second, slow implementations, box by box, on random walks


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
        "inertia": [0.0, 0.2, 0.6], "direction_frames": [2, 3, 5], "recover": [False, True], "reupdate": [False, True],
    },
}  # fmt: skip


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
        steps = int(rng.choice([1, 1, 1, 1, 1, 2, 3]))
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


def box_of(row: np.void) -> Box:
    left, top, width, height, score = (float(row[name]) for name in ("x_px", "y_px", "w_px", "h_px", "score"))
    return Box(left, top, left + width, top + height, score, int(row["class_id"]))


@pytest.mark.parametrize("name", TRACKERS)
@given(seed=st.integers(0, 2**32 - 1), data=st.data())
@settings(max_examples=15)
def test_tracks_equal_the_reference(name, seed, data):
    values = SHARED | OWN[name]
    options = TRACKERS[name](**data.draw(st.fixed_dictionaries({k: st.sampled_from(v) for k, v in values.items()})))
    frames = walking(np.random.default_rng(seed))
    boxes = [(frame.t_ns, [box_of(row) for row in frame.rows]) for frame in frames]
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
