"""Re-tracking of each class by itself: what is split comes together again, and ids of classes never meet."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.schema import DECISIONS, PREDICTIONS, TRACKS, Frame, framing
from mcaptrack.schema.frame_columns import collect
from mcaptrack.transforms import Retrack
from mcaptrack.transforms.retrack.assignments import PEOPLE, Movers, join_classes, movers_of, split_classes, usual_score
from mcaptrack.transforms.retrack.methods import KeptIds
from tests.worlds import assert_same_rows, ns


def rows_of(ids: list[int], classes: list[int], **columns: object) -> np.ndarray:
    count = len(ids)
    known = {"x_m": np.arange(count) + 0.5, "y_m": np.array(ids) * 2.0, "observed": [True] * count}
    return TRACKS.rows(track_id=ids, class_id=classes, source_id=[-1] * count, **(known | columns))


def random_frames(seed: int) -> list[Frame]:
    """Tracks of which some change their class, in any order."""
    rng = np.random.default_rng(seed)
    out = []
    for n in range(12):
        ids = rng.permutation([3, 5, 8, 11, 20])[: rng.integers(0, 6)] if n else np.empty(0, int)
        kinds = [int(rng.integers(1, 4)) if rng.random() < 0.3 else one % 3 + 1 for one in ids.tolist()]
        out.append(Frame(ns(n / 2.5), n + 7, rows_of(ids.tolist(), kinds)))
    return out


@pytest.mark.parametrize("part_rows", [1 << 16, 4])
@pytest.mark.parametrize("seed", range(5))
def test_frames_of_each_class_hold_its_tracks_whole(seed, part_rows, monkeypatch):
    monkeypatch.setattr(framing, "PART_ROWS", part_rows)
    frames = random_frames(seed)
    first: dict[int, int] = {}
    begun: dict[int, tuple[int, int]] = {}  # where each class begins, with its lowest id there
    for n, frame in enumerate(frames):
        for one, kind in zip(frame.rows["track_id"].tolist(), frame.rows["class_id"].tolist(), strict=True):
            first.setdefault(one, kind)
            began, lowest = begun.get(first[one], (n, one))
            begun[first[one]] = (began, min(lowest, one) if began == n else lowest)
    parts = split_classes(collect(TRACKS, frames))
    assert len(parts) == len(begun)
    for kind, part in zip(sorted(begun, key=lambda kind: begun[kind]), parts, strict=True):
        assert [(frame.t_ns, frame.index) for frame in part] == [(frame.t_ns, frame.index) for frame in frames]
        for own, frame in zip(part, frames, strict=True):
            is_own = [first[one] == kind for one in frame.rows["track_id"].tolist()]
            assert_same_rows(own.rows, frame.rows[np.array(is_own, bool)])


def test_one_class_is_not_split():
    frames = collect(TRACKS, [Frame(0, 0, rows_of([1, 2], [3, 3]))])
    assert split_classes(frames) == [frames]


def test_decisions_about_tracks_that_were_left_out_have_no_id_in_any_class():
    def run(ids: list[int]):
        rows = DECISIONS.empty(len(ids))
        rows["track_id"] = ids
        return [collect(DECISIONS, [Frame(0, 0, rows)])]

    ((found,),) = join_classes([run([1, -1, 3]), run([2, -1])])
    assert found.rows["track_id"].tolist() == [1, -1, 3, 5, -1]


@pytest.mark.parametrize("part_rows", [1 << 16, 1])
def test_ids_of_a_class_follow_those_of_the_class_before(part_rows, monkeypatch):
    monkeypatch.setattr(framing, "PART_ROWS", part_rows)

    def predicted(some: list[int]):
        steps = PREDICTIONS.empty(len(some))
        steps["track_id"] = some
        return steps

    def run(ids: list[list[int]]):
        tracks = [Frame(n, n, rows_of(some, [1] * len(some))) for n, some in enumerate(ids)]
        return collect(TRACKS, tracks), collect(PREDICTIONS, [Frame(n, n, predicted(one)) for n, one in enumerate(ids)])

    runs = [run([[1, 4], [2]]), run([[], []]), run([[3], [1, 2]]), run([[1], []])]
    found = list(join_classes(runs))
    assert [tuple(frame.rows["track_id"].tolist() for frame in frames) for frames in found] == [
        ([1, 4, 7, 8], [1, 4, 7, 8]),
        ([2, 5, 6], [2, 5, 6]),
    ]
    assert [(frames[0].t_ns, frames[1].index) for frames in found] == [(0, 0), (1, 1)]


@pytest.mark.parametrize(
    ("scores", "observed", "usual"),
    [
        ([0.2, 0.4, 0.9], [True] * 3, 0.4),
        ([0.2, 0.4, 0.9], [True, True, False], 0.3),
        ([np.nan, 0.5], [True, True], 0.5),
        ([np.nan], [True], 1.0),
        ([0.5], [False], 1.0),
        ([0.0, 0.0], [True, True], 1e-6),
    ],
)
def test_the_usual_score_is_the_median_of_what_was_observed(scores, observed, usual):
    rows = rows_of([*range(len(scores))], [1] * len(scores), score=scores, observed=observed)
    assert usual_score([Frame(0, 0, rows[:1]), Frame(1, 1, rows[1:])]) == pytest.approx(usual)


@pytest.mark.parametrize(
    ("kind", "moves", "step", "movers"),
    [
        (1, False, 1, Movers(1.0, False, 0.7, None)),  # a person in pictures
        (1, True, 1, Movers(1.0, False, 0.7, None)),  # in metres, but at no higher rate than samples
        (1, True, 4, Movers(1.0, True, 0.7, 0.8)),
        (2, True, 1, Movers(4.0, True, 0.7, 3.0)),  # a car
        (2, False, 4, Movers(4.0, False, 0.7, None)),
        (3, True, 4, Movers(1.0, True, 0.7, 2.0)),  # of no row of the table
    ],
)
def test_each_class_has_its_unit_and_its_kind(kind, moves, step, movers):
    speeds = {"vx_m_per_s": [1.0], "vy_m_per_s": [0.0]} if moves else {}
    frames = [Frame(ns(n / 2.5), n * step, rows_of([1], [kind], **speeds)) for n in range(3)]
    empty = Frame(0, 0, frames[0].rows[:0])
    names = ((1, "pedestrian"), (2, "car"), (3, "blob"))
    assert movers_of([empty, *frames], names, 0.7) == movers
    assert movers_of([empty], names, 0.7) == PEOPLE == Movers(1.0, False, 1.0, None)
    assert movers_of([], names, 0.7) == PEOPLE


@pytest.mark.parametrize("part_rows", [1 << 16, 1])
def test_tracks_in_metres_keep_what_they_are_under_numbers_of_their_own(part_rows, monkeypatch):
    """Samples at 2.5 Hz, one missing, with ids in any order; steps follow the clock."""
    monkeypatch.setattr(framing, "PART_ROWS", part_rows)
    steps, seen = [0, 1, 3, 4], ([9, 4], [4, 9], [7], [9, 7])
    frames = [Frame(ns(n / 2.5) + 3, n, rows_of(ids, [1] * len(ids))) for n, ids in zip(steps, seen, strict=True)]
    kept = KeptIds(Retrack(predictor="cv", noise_m=0.5), Movers(unit_m=2.0), collect(TRACKS, frames))
    assert kept.noise_m == 0.25
    assert kept.steps == steps
    out = [(online.rows["source_id"].tolist(), online.rows["track_id"].tolist()) for online, _ in kept.outputs()]
    assert out == [([4, 9], [1, 2]), ([4, 9], [1, 2]), ([7], [3]), ([7, 9], [3, 2])]
    step, track, source, row = kept.assignments.of(kept.samples, kept.steps)
    assert step.tolist() == [0, 0, 1, 1, 3, 4, 4]
    assert track.tolist() == [1, 2, 1, 2, 3, 3, 2]
    assert source.tolist() == [4, 9, 4, 9, 7, 7, 9]
    assert row.tolist() == [*range(7)]
    assert kept.samples.column("track_id").tolist() == source.tolist()
