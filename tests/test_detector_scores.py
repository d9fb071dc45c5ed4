"""Scores of detectors that are no probabilities: what the log tells of them, against what is known of a drawn scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import isotonic_regression

import mcaptrack
from mcaptrack import log
from mcaptrack.evaluation.metrics import Matchup, clear, distances, metres_to_similarity
from mcaptrack.pipeline.scores import DOUBTFUL, score_map, score_range, without_doubtful
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import GroundTracker
from tests.commands import done
from tests.tiers import one_in

NAMES = ((1, "pedestrian"), (3, "car"))
FRAMES, STEP_NS = 200, 100_000_000
#: The lowest score that the detector gives.
LEAST = -0.85
#: By class: how many real objects and false places, speed and noise in m, m/s, scores of real ones: mean, spread.
KINDS = {1: (10, 8, 1.3, 0.08, 3.5, 1.0), 3: (12, 8, 9.0, 0.15, 7.0, 2.0)}
#: Detectors give scores on many scales: all of these rise with the logit.
SCALES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "logit": lambda logit: logit,
    "exp": np.exp,
    "times 1000": lambda logit: 1000 * logit,
    "a byte": lambda logit: 255 / (1 + np.exp(-logit)),
    "shifted": lambda logit: logit + 20,
}


class Scene(NamedTuple):
    """Detections (N,) of a scene: frame, place (N, 2), logit, class, whether they are real; and true places by frame."""

    frame: np.ndarray
    place: np.ndarray
    logit: np.ndarray
    class_id: np.ndarray
    is_real: np.ndarray
    truth: dict[int, list[list[tuple[int, float, float]]]]

    def frames(self, score: np.ndarray) -> list[Frame]:
        def rows(which: np.ndarray):
            x, y = self.place[which].T
            return DETECTIONS.rows(x_m=x, y_m=y, score=score[which], class_id=self.class_id[which])

        return [Frame(10**9 + n * STEP_NS, n, rows(self.frame == n)) for n in range(FRAMES)]


def drawn(seed: int) -> Scene:
    """Objects move, or stand, and false places stand; all have a strength that wanders, and are seen if it is enough."""
    rng = np.random.default_rng(seed)
    rows: list[tuple[float, ...]] = []
    truth = {kind: [[] for _ in range(FRAMES)] for kind in KINDS}
    for kind, (objects, places, speed, noise, mean, spread) in KINDS.items():
        for number in range(objects):
            angle, start = rng.uniform(0, 2 * np.pi), rng.uniform(-30, 30, 2)
            way = speed * rng.uniform(0.3, 1.0) * np.array([np.cos(angle), np.sin(angle)]) * (rng.random() > 0.3)
            first, own, wander = int(rng.integers(0, FRAMES // 2)), rng.normal(mean, spread), 0.0
            for n in range(first, min(FRAMES, first + int(rng.integers(50, 150)))):
                at, wander = start + way * (n - first) / 10, 0.7 * wander + rng.normal(0, 0.9)
                truth[kind][n].append((number, *at))
                rows.append((n, *(at + rng.normal(0, noise, 2)), own + wander, kind, 1))
        for _ in range(places):
            at, own, wander = rng.uniform(-40, 40, 2), rng.normal(-2.2, 1.2), 0.0
            for n in range(FRAMES):
                wander = 0.6 * wander + rng.normal(0, 1.1)
                rows.append((n, *(at + rng.normal(0, 0.3, 2)), own + wander, kind, 0))
        for n in range(FRAMES):
            rows += [
                (n, *rng.uniform(-40, 40, 2), LEAST + rng.exponential(1.0), kind, 0) for _ in range(rng.poisson(0.15))
            ]
    table = np.array([row for row in rows if row[3] > LEAST])
    ints = table[:, [0, 4, 5]].astype(int).T
    return Scene(ints[0], table[:, 1:3], table[:, 3], ints[1], ints[2] == 1, truth)


def likelihoods(scene: Scene, score: np.ndarray) -> np.ndarray:
    frames = scene.frames(score)
    span = score_range(frames)
    assert span is not None
    mapped = score_map(frames, span, NAMES).mapped(frames)
    out = np.empty(len(score))
    for n, frame in enumerate(mapped):
        out[scene.frame == n] = frame.rows["score"]
    return out


def mota(scene: Scene, score: np.ndarray, kind: int) -> float:
    """MOTA of a class, in percent, of tracks of detections that are likely enough."""
    frames = without_doubtful(scene.frames(score))
    tracks = [frame.rows[frame.rows["class_id"] == kind] for (frame,) in GroundTracker(class_names=NAMES)(frames)]
    numbers: dict[int, int] = {}
    own = tuple(np.array([numbers.setdefault(n, len(numbers)) for n in t["track_id"].tolist()], int) for t in tracks)
    true = tuple(np.array([number for number, *_ in people], int) for people in scene.truth[kind])
    places = [np.array([place for _, *place in people]).reshape(-1, 2) for people in scene.truth[kind]]
    others = [np.stack([t["x_m"], t["y_m"]], axis=1).astype(float) for t in tracks]
    similar = tuple(metres_to_similarity(distances(a, b), 2.0) for a, b in zip(places, others, strict=True))
    counts = clear(Matchup(true, own, similar, 0.5, 1 + max(map(max, filter(len, true))), max(len(numbers), 1)))
    return 100 * (1 - (counts["FP"] + counts["FN"] + counts["IDSW"]) / sum(map(len, true)))


@pytest.mark.parametrize("scale", one_in(5, SCALES))
def test_what_scores_mean_is_found_without_truth(scale):
    """In every class: the order stays, likelihoods are shares of real detections, tracks as good as with true ones."""
    off, worse = [], []
    for seed in (1, 2):
        scene = drawn(seed)
        found = likelihoods(scene, SCALES[scale](scene.logit))
        for kind in KINDS:
            mine = scene.class_id == kind
            order = np.argsort(scene.logit[mine])
            likelihood, is_real = found[mine][order], scene.is_real[mine][order]
            assert (np.diff(likelihood) >= 0).all()
            assert 0 <= likelihood[0] < 0.3 < 0.9 < likelihood[-1] <= 1
            for part in range(5):
                of_part = (likelihood >= part / 5) & (likelihood <= part / 5 + 0.2)
                if of_part.sum() >= 20:
                    off.append((of_part.sum(), abs(likelihood[of_part].mean() - is_real[of_part].mean())))
            true = np.zeros(len(found))
            true[np.flatnonzero(mine)[order]] = isotonic_regression(is_real.astype(float)).x
            worse.append(mota(scene, true, kind) - mota(scene, found, kind))
            raw = mota(scene, SCALES[scale](scene.logit), kind)
            assert scale != "logit" or mota(scene, found, kind) > raw + 5
    count, error = np.array(off).T
    assert np.average(error, weights=count) < 0.1
    assert np.mean(worse) < 2


def test_scores_from_0_to_1_are_probabilities_and_left_alone():
    scene = drawn(1)
    assert score_range(scene.frames(1 / (1 + np.exp(-scene.logit)))) is None
    assert score_range(scene.frames(np.ones(len(scene.logit)))) is None
    assert score_range(scene.frames(np.full(len(scene.logit), np.nan))) is None
    assert score_range(scene.frames(np.full(len(scene.logit), 1.0002))) is None  # rounding


@pytest.mark.parametrize(
    ("score", "how", "expected"),
    [
        (lambda n: np.linspace(0, 100, n), "percentages", lambda n: np.linspace(0, 1, n)),
        (lambda n: np.append(np.full(n - 2, 0.4), [-3, 7]), "0 or 1", lambda n: np.append(np.full(n - 2, 0.4), [0, 1])),
        (lambda n: np.full(n, -1.0), "say nothing", lambda n: np.full(n, np.nan)),
        (lambda n: np.full(n, 255.0), "say nothing", lambda n: np.full(n, np.nan)),
    ],
)
def test_scales_that_are_known_are_named(score, how, expected):
    scene = drawn(1)
    values = score(len(scene.logit))
    frames = scene.frames(values)
    found = score_map(frames, score_range(frames), NAMES)
    assert how in found.basis
    assert not found.is_fitted
    assert likelihoods(scene, values) == pytest.approx(expected(len(values)), abs=1e-6, nan_ok=True)


def test_few_detections_keep_their_order_and_none_is_left_out():
    rows = DETECTIONS.rows(x_m=[0.0, 9.0], y_m=[0.0, 0.0], score=[-2.0, 3.0], class_id=[3, 3])
    frames = [Frame(n * STEP_NS, n, rows) for n in range(4)]
    found = score_map(frames, score_range(frames), NAMES)
    assert not found.is_fitted
    assert "too few" in found.basis
    assert found.mapped(frames)[0].rows["score"] == pytest.approx(1 / (1 + np.exp([2.0, -3.0])), abs=0.01)


def test_boxes_that_are_all_real_are_all_kept():
    """Clear people with two sizes of scores: those with lower ones go on as steadily, so that they are real, too."""
    rng, frames = np.random.default_rng(4), []
    same = {name: np.full(8, value) for name, value in (("y_px", 50), ("w_px", 30), ("h_px", 80), ("class_id", 1))}
    for n in range(100):
        x = 100.0 * np.arange(8) + 3 * n + rng.normal(0, 0.5, 8)
        score = np.where(np.arange(8) < 4, 9.2, rng.normal(1.0, 0.8, 8))
        frames.append(Frame(n * STEP_NS, n, DETECTIONS.rows(x_px=x, score=score, **same)))
    found = score_map(frames, score_range(frames), ((1, "person"),))
    assert min(frame.rows["score"].min() for frame in found.mapped(frames)) > DOUBTFUL


@pytest.mark.parametrize("shape", [(0, 5), (1, 400), (1, 3000), (40, 1), (40, 60)])
@pytest.mark.parametrize(
    "values", [[-4.0, 0.5, 3.0], [-np.inf, -1e30, 0.5, 3.0, 1e38, np.nan], [1e-30, 1e30], [2.0, 3.0]]
)
def test_odd_scores_and_numbers_of_detections_become_likelihoods(shape, values):
    rng, (frames_count, count) = np.random.default_rng(0), shape

    def rows():
        columns = {"x_m": rng.uniform(0, 9, count), "y_m": np.zeros(count), "score": rng.choice(values, count)}
        return DETECTIONS.rows(class_id=rng.integers(0, 9, count), **columns)

    frames = [Frame(0, n, rows()) for n in range(frames_count)]
    span = score_range(frames)
    if span is None:
        assert not any(np.isfinite(frame.rows["score"]).any() for frame in frames)
        return
    for frame, given in zip(score_map(frames, span, NAMES).mapped(frames), frames, strict=True):
        score, has_score = frame.rows["score"], np.isfinite(given.rows["score"])
        assert (np.isnan(score) == ~has_score).all()
        assert ((score[has_score] >= 0) & (score[has_score] <= 1)).all()


@pytest.fixture
def recorded(tmp_path):
    """A log of 3D boxes with logits, and its detections."""
    scene, names = drawn(1), dict(NAMES)
    lines = ["frame,x_m,y_m,z_m,length_m,width_m,height_m,heading_rad,score,class"]
    for n, (x, y), score, kind in zip(scene.frame, scene.place, scene.logit, scene.class_id, strict=True):
        lines.append(f"{n},{x:.3f},{y:.3f},0,1,1,1,0,{score:.3f},{names[kind]}")
    (tmp_path / "det.csv").write_text("\n".join(lines) + "\n")
    path = tmp_path / "log.mcap"
    mcaptrack.ingest(tmp_path / "det.csv", path, role="detections", fps=10, frame="map")
    return path


def track(path, *words: str):
    warnings = json.loads(done("track", path, "--json", "-q", *words).out)["warnings"]
    said = [note["message"] for note in warnings if note["code"] == "scores"]
    said = [text for text in said if text.startswith("/camera/detections")]  # without those of ingested labels
    with log.read(path) as opened:
        channel = opened.channels["/camera/tracks"]
        rows = TRACKS.joined([frame.rows for frame in opened.frames("/camera/tracks", TRACKS)])
    return said, Provenance.from_metadata(channel.metadata), rows


def test_tracking_maps_scores_says_so_and_leaves_the_recording_as_it_is(recorded):
    with log.read(recorded) as opened:
        before = opened.channels["/camera/detections"].metadata
    (said,), how, rows = track(recorded)
    assert said.startswith("/camera/detections: scores are from -0.8")
    assert "less likely than 0.6" in said
    assert "car " in said
    assert "--min-score" in said
    assert {*how.scores} == {"car", "pedestrian"}
    points = np.array([point.split(":") for point in how.scores["car"].split()], float)
    assert (np.diff(points, axis=0) > 0).all()
    assert points[0, 0] == pytest.approx(-0.85, abs=0.01)
    assert how.parameters["min_score"] is None
    assert 0.5 < np.nanmin(rows["score"]) <= np.nanmax(rows["score"]) <= 1
    with log.read(recorded) as opened:
        assert opened.channels["/camera/detections"].metadata == before
    again = [note.message for note in mcaptrack.run(recorded, tables=False).warnings if note.code == "scores"]
    assert [text for text in again if text.startswith("/camera/detections")] == [
        said.replace("--min-score", "`min_score=`")
    ]


def test_a_limit_of_the_user_counts_in_its_own_scale(recorded):
    _, _, by_itself = track(recorded)
    said, _, all_of_them = track(recorded, "--min-score", "0", "--force")
    assert len(all_of_them) > len(by_itself)
    assert "left out" not in said[0]
    said, how, rows = track(recorded, "--min-score", "3", "--force")
    assert "--min-score 3" in said[0] or "min_score=3" in said[0]
    assert not how.scores
    assert np.nanmax(rows["score"]) > 5
