"""SORT in worded scenes; and against the outputs of the original program."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.transforms.sort import Sort
from tests.worlds import boxes_at, detections, ids, ns

FRAMES = {"max_age_frames": 2, "min_hits_frames": 2, "min_iou": 0.3}


def run(frames, **options):
    return [frame for (frame,) in Sort(**(FRAMES | options))(frames)]


def test_one_who_walks_keeps_one_id():
    out = run(detections(lambda n: [(50 + 3 * n, 50)], 30))
    assert {tuple(ids(frame)) for frame in out} == {(1,)}


def test_two_side_by_side_keep_theirs():
    out = run(detections(lambda n: [(50 + 3 * n, 50), (50 + 3 * n, 120)], 30))
    assert {tuple(ids(frame)) for frame in out} == {(1, 2)}
    assert all(frame.rows["y_px"][0] < frame.rows["y_px"][1] for frame in out)


def test_one_who_comes_later_is_shown_after_enough_hits():
    out = run(detections(lambda n: [(50, 50)] + ([(200, 50)] if n >= 10 else []), 20))
    shown = [n for n, frame in enumerate(out) if 2 in ids(frame)]
    assert shown == list(range(12, 20))  # born at 10, hit at 11 and 12


def test_one_who_is_missed_for_less_than_the_age_comes_back_as_the_same():
    out = run(detections(lambda n: [] if n in (10, 11) else [(50 + n, 50)], 20))
    assert [ids(frame) for frame in out[9:12]] == [[1], [], []]
    assert [ids(frame) for frame in out[12:]] == [[], *[[1]] * 7]  # a streak begins anew


def test_one_who_is_missed_for_longer_comes_back_as_another():
    out = run(detections(lambda n: [] if 10 <= n <= 12 else [(50, 50)], 20))
    assert ids(out[9]) == [1]
    assert ids(out[19]) == [2]


def test_a_box_that_jumps_is_somebody_else():
    out = run(detections(lambda n: [(50, 50) if n < 10 else (150, 50)], 20))
    assert ids(out[9]) == [1]
    assert ids(out[19]) == [2]


def test_seconds_are_frames_of_the_actual_rate():
    """The same walk at 10 and at 30 frames a second, hidden for 0.7 s."""
    for fps in (10, 30):

        def path(n, fps=fps):
            return [] if 1.0 <= n / fps < 1.7 else [(50 + 20 * n / fps, 50)]

        for age, back in ((1.0, 1), (0.3, 2)):
            out = [f for (f,) in Sort(max_age_s=age, min_hits_s=0.2)(detections(path, 4 * fps, fps))]
            assert ids(out[-1]) == [back], (fps, age)


def test_frames_that_nobody_saw_still_move_people():
    """A walker crosses a gap of half a second in the log; without counting its frames the boxes would not meet."""
    frames = detections(lambda n: [(50 + 6 * n, 50)], 40)
    gap = [frame for frame in frames if not 20 <= frame.index < 25]
    out = [f for (f,) in Sort(max_age_s=1.0, min_hits_s=0.1)(gap)]
    assert {tuple(ids(frame)) for frame in out} == {(1,)}


def test_a_jitter_of_the_clock_changes_no_box():
    rng = np.random.default_rng(3)
    frames = detections(lambda n: [(50 + 5 * n, 60 + 2 * n), (300 - 4 * n, 90)], 40)
    shaken = [frame._replace(t_ns=frame.t_ns + int(rng.integers(-20_000_000, 20_000_000))) for frame in frames]
    for a, b in zip(run(frames), run(shaken), strict=True):
        np.testing.assert_array_equal(a.rows["x_px"], b.rows["x_px"])


def test_boxes_that_are_none_are_passed_over():
    rows = boxes_at([(50, 50), (90, 50), (130, 50)])
    rows["w_px"][1], rows["h_px"][2] = 0.0, -3.0
    out = run([Frame(ns(n / 10), n, rows) for n in range(6)])
    assert ids(out[-1]) == [1]
    assert np.isfinite(out[-1].rows["x_px"]).all()


def test_scores_and_metres_go_along():
    plane = GroundPlane((0.1, 0, 0, 0, 0.1, 0, 0, 0, 1), 640, 480)
    frames = [Frame(ns(n / 10), n, boxes_at([(50, 50)], (20, 40), score=0.25)) for n in range(5)]
    (frame,) = list(Sort(ground_planes=((0, plane),))(frames))[-1]
    assert frame.rows["score"].tolist() == [0.25]
    np.testing.assert_allclose([frame.rows["x_m"][0], frame.rows["y_m"][0]], [5.0, 7.0], atol=1e-6)
    (plain,) = list(Sort()(frames))[-1]
    assert np.isnan(plain.rows["x_m"]).all()


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
