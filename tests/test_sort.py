"""The trackers on small scenes, and SORT against the output of the original program."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack import notices
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.transforms import TRACKERS
from mcaptrack.transforms.sort import ByteTrack, OcSort, Sort
from mcaptrack.transforms.sort.state import distance_pairs
from tests.worlds import boxes_at, detections, ids, ns

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


def test_a_walking_person_keeps_one_id():
    out = run(detections(lambda n: [(50 + 3 * n, 50)], 30))
    assert {tuple(ids(frame)) for frame in out} == {(1,)}


def test_two_people_side_by_side_keep_their_ids():
    out = run(detections(lambda n: [(50 + 3 * n, 50), (50 + 3 * n, 120)], 30))
    assert {tuple(ids(frame)) for frame in out} == {(1, 2)}
    assert all(frame.rows["y_px"][0] < frame.rows["y_px"][1] for frame in out)


def test_a_new_track_is_written_after_min_hits():
    out = run(detections(lambda n: [(50, 50)] + ([(200, 50)] if n >= 10 else []), 20))
    shown = [n for n, frame in enumerate(out) if 2 in ids(frame)]
    assert shown == list(range(12, 20))  # birth at 10, detected again at 11 and 12


def test_a_track_survives_missed_detections_up_to_its_maximum_age():
    out = run(detections(lambda n: [] if n in (10, 11) else [(50 + n, 50)], 20))
    assert [ids(frame) for frame in out[9:12]] == [[1], [], []]
    assert [ids(frame) for frame in out[12:]] == [[], *[[1]] * 7]  # the hit streak starts again


def test_a_track_at_its_maximum_age_outlives_one_beyond_it():
    away = {0: (9, 10, 11), 1: (10, 11)}
    frames = detections(lambda n: [(50, 50 + 100 * who) for who in away if n not in away[who]], 20)
    assert [ids(run(frames)[n]) for n in (8, 19)] == [[1, 2], [2, 3]]


def test_a_track_terminates_after_its_maximum_age():
    out = run(detections(lambda n: [] if 10 <= n <= 12 else [(50, 50)], 20))
    assert ids(out[9]) == [1]
    assert ids(out[19]) == [2]


def test_a_detection_beyond_the_gate_starts_another_track():
    out = run(detections(lambda n: [(50, 50) if n < 10 else (150, 50)], 20))
    assert ids(out[9]) == [1]
    assert ids(out[19]) == [2]


def test_seconds_are_frames_of_the_actual_rate():
    """The same walk at 10 and at 30 frames a second, occluded for 0.7 s."""
    for fps in (10, 30):

        def path(n, fps=fps):
            return [] if 1.0 <= n / fps < 1.7 else [(50 + 20 * n / fps, 50)]

        for age, back in ((1.0, 1), (0.3, 2)):
            out = [f for (f,) in Sort(max_age_s=age, min_hits_s=0.2)(detections(path, 4 * fps, fps))]
            assert ids(out[-1]) == [back], (fps, age)


def test_tracks_are_predicted_through_missing_frames():
    """A person walks through a gap of half a second in the log; a prediction of one frame would not overlap."""
    frames = detections(lambda n: [(50 + 6 * n, 50)], 40)
    gap = [frame for frame in frames if not 20 <= frame.index < 25]
    out = [f for (f,) in Sort(max_age_s=1.0, min_hits_s=0.1)(gap)]
    assert {tuple(ids(frame)) for frame in out} == {(1,)}


def test_jitter_of_timestamps_changes_no_box():
    rng = np.random.default_rng(3)
    frames = detections(lambda n: [(50 + 5 * n, 60 + 2 * n), (300 - 4 * n, 90)], 40)
    shaken = [frame._replace(t_ns=frame.t_ns + int(rng.integers(-20_000_000, 20_000_000))) for frame in frames]
    for a, b in zip(run(frames), run(shaken), strict=True):
        np.testing.assert_array_equal(a.rows["x_px"], b.rows["x_px"])


def test_degenerate_boxes_are_ignored():
    rows = boxes_at([(50, 50), (90, 50), (130, 50)])
    rows["w_px"][1], rows["h_px"][2] = 0.0, -3.0
    out = run([Frame(ns(n / 10), n, rows) for n in range(6)])
    assert ids(out[-1]) == [1]
    assert np.isfinite(out[-1].rows["x_px"]).all()


def test_tracks_have_the_score_and_the_position_on_the_ground():
    plane = GroundPlane((0.1, 0, 0, 0, 0.1, 0, 0, 0, 1), 640, 480)
    frames = [Frame(ns(n / 10), n, boxes_at([(50, 50)], (20, 40), score=0.25)) for n in range(5)]
    (frame,) = list(Sort(ground_planes=((0, plane),))(frames))[-1]
    assert frame.rows["score"].tolist() == [0.25]
    np.testing.assert_allclose([frame.rows["x_m"][0], frame.rows["y_m"][0]], [5.0, 7.0], atol=1e-6)
    (plain,) = list(Sort()(frames))[-1]
    assert np.isnan(plain.rows["x_m"]).all()


def test_jitter_of_timestamps_changes_no_age():
    """Ages and hit streaks in seconds are rounded to the nearest frame."""
    rng = np.random.default_rng(4)
    frames = detections(lambda n: [] if 10 <= n < 19 else [(50, 60)], 40)
    for age in (0.8, 0.9, 1.0):
        wanted = [ids(frame) for (frame,) in Sort(max_age_s=age, min_hits_s=0.3)(frames)]
        for _ in range(10):
            shaken = [frame._replace(t_ns=frame.t_ns + int(rng.integers(-4_000_000, 4_000_000))) for frame in frames]
            assert [ids(frame) for (frame,) in Sort(max_age_s=age, min_hits_s=0.3)(shaken)] == wanted
    assert wanted[-1] == [1]


@pytest.mark.parametrize(("least_s", "hits"), [(0.24, 2), (0.26, 3)])
def test_the_time_to_a_confirmed_track_is_rounded_to_the_nearest_frame(least_s, hits):
    frames = detections(lambda n: [(50, 60)] if n >= 20 else [(200, 60)], 40)
    out = [ids(frame) for (frame,) in Sort(max_age_s=0.5, min_hits_s=least_s)(frames)]
    assert next(n for n, found in enumerate(out) if found == [2]) == 20 + hits


def test_ages_are_in_seconds_where_the_frame_rate_changes():
    """A person is missed for 0.9 s: at 10 frames a second, and after the rate has risen to 30."""
    times = [n / 10 for n in range(40)] + [4 + n / 30 for n in range(120)]
    away = [(2.0, 2.9), (6.0, 6.9)]
    frames = [
        Frame(ns(t), n, boxes_at([] if any(a <= t < b for a, b in away) else [(50, 60)])) for n, t in enumerate(times)
    ]
    assert ids([f for (f,) in Sort(max_age_s=1.2, min_hits_s=0.1)(frames)][-1]) == [1]
    assert ids([f for (f,) in Sort(max_age_s=0.6, min_hits_s=0.1)(frames)][-1]) == [3]


def test_tracks_terminate_in_a_gap_of_an_hour():
    frames = detections(lambda n: [(50, 60)], 40)
    late = [f._replace(t_ns=f.t_ns + (ns(3600) if f.index >= 20 else 0)) for f in frames]
    out = [f for (f,) in Sort(max_age_s=1.0, min_hits_s=0.1)(late)]
    assert (ids(out[19]), ids(out[-1])) == ([1], [2])


def test_small_fast_boxes_are_associated_by_distance():
    """Boxes of 8 px that move by 12 px a frame never overlap; their centres are within the gate."""
    frames = [Frame(ns(n / 10), n, boxes_at([(20 + 12 * n, 50), (20 + 12 * n, 130)], (8, 8))) for n in range(30)]
    assert len({track_id for frame in run(frames) for track_id in ids(frame)}) > 2
    out = run(frames, cost="pixels", max_distance_px=20.0)
    assert {tuple(ids(frame)) for frame in out} == {(1, 2)}


def test_distance_on_the_ground_is_not_distance_in_the_picture():
    """Far away a metre is 2 px high: a jump of 12 px is a jump of 6 m there, and nothing near by."""
    plane = GroundPlane((0.01, 0, 0, 0, 0.5, 0, 0, 0, 1), 640, 480)
    frames = detections(lambda n: [(50, 50 if n < 10 else 62), (200 if n < 10 else 240, 300)], 20)
    out = run(frames, cost="metres", max_distance_m=2.0, ground_planes=((0, plane),))
    assert ids(out[9]) == [1, 2]
    assert ids(out[-1]) == [2, 3]
    with pytest.raises(McaptrackError, match="cost metres needs a ground plane"):
        run(frames, cost="metres")


def test_filters_of_class_and_score():
    rows = boxes_at([(50, 50), (120, 50), (190, 50)])
    rows["score"], rows["class_id"] = [0.9, 0.3, np.nan], [1, 1, 2]
    frames = [Frame(ns(n / 10), n, rows) for n in range(6)]
    assert ids(run(frames)[-1]) == [1, 2, 3]
    assert ids(run(frames, min_score=0.5)[-1]) == [1, 2]  # a detection without a score passes
    assert ids(run(frames, class_id=2)[-1]) == [1]
    assert run(frames, class_id=2)[-1].rows["x_px"][0] == pytest.approx(180)


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


def test_a_track_continues_with_detections_of_its_class_only():
    frames = detections(lambda n: [(50, 50)], 20)
    for frame in frames[10:]:
        frame.rows["class_id"] = 3
    assert ids(run(frames)[-1]) == [2]
    assert ids(run(frames, across_classes=True)[-1]) == [1]


def test_bytetrack_continues_tracks_with_low_scores_and_starts_none():
    """A person scores low behind a hedge; a false positive beside scores low always."""
    frames = detections(lambda n: [(50 + 4 * n, 50), (300, 50)], 40)
    for frame in frames:
        frame.rows["score"] = [0.2 if 10 <= frame.index < 30 else 0.9, 0.3]
    out = run(frames, kind=ByteTrack)
    assert {tuple(ids(frame)) for frame in out} == {(1,)}
    high = run(frames, min_score=0.5)
    assert ids(high[-1]) == [2]
    assert [ids(frame) for frame in high[15:25]] == [[]] * 10


def test_bytetrack_gives_low_scores_to_tracks_of_the_previous_frame_only():
    frames = detections(lambda n: [] if 10 <= n < 12 else [(50, 50)], 20)
    for frame in frames[12:]:
        frame.rows["score"] = 0.3
    assert [ids(frame) for frame in run(frames, kind=ByteTrack)[12:]] == [[]] * 8


def test_ocsort_recovers_a_person_who_stopped_while_occluded():
    """The filter coasts on, away from the person; the last detection does not."""

    def path(n):
        return [] if 20 <= n < 32 else [(50 + 6 * min(n, 20), 50)]

    options = {"max_age_frames": 30, "min_iou": 0.3}
    assert ids(run(detections(path, 50), **options)[-1]) == [2]
    assert ids(run(detections(path, 50), kind=OcSort, **options)[-1]) == [1]
    assert ids(run(detections(path, 50), kind=OcSort, recover=False, **options)[-1]) == [2]


def test_ocsort_recomputes_the_filter_over_the_gap():
    """After the gap the track is as if it had been detected on the straight line throughout."""

    def path(n):
        return (50 + 3 * n, 100) if n <= 19 else (107 - (n - 19), 100 + 0.5 * (n - 19))

    options = {"max_age_frames": 30, "min_hits_frames": 0, "min_iou": 0.05, "kind": OcSort}
    seen = run(detections(lambda n: [path(n)], 34), **options)
    hidden = run(detections(lambda n: [] if 20 <= n < 29 else [path(n)], 34), **options)
    coasted = run(detections(lambda n: [] if 20 <= n < 29 else [path(n)], 34), reupdate=False, **options)
    for n in range(29, 34):
        for name in ("x_px", "y_px", "w_px", "h_px"):
            np.testing.assert_allclose(hidden[n].rows[name], seen[n].rows[name], atol=1e-9)
    assert abs(coasted[30].rows["x_px"] - seen[30].rows["x_px"]) > 0.01


def test_the_trackers_agree_without_low_scores_and_missed_detections():
    frames = detections(lambda n: [(50 + 3 * n, 50), (300 - 3 * n, 150)], 30)
    outs = [run(frames, kind=kind) for kind in TRACKERS.values()]
    for out in outs[1:]:
        for a, b in zip(outs[0], out, strict=True):
            np.testing.assert_allclose(a.rows["x_px"], b.rows["x_px"])


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
