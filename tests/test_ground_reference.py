"""The tracker of mcaptrack.transforms.ground against a slow one, a track and a detection at a time: the same rows."""

from __future__ import annotations

import numpy as np
import pytest

from mcaptrack.geometry.neighbours import Pairing
from mcaptrack.notices import collected
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.transforms import GroundTracker
from mcaptrack.transforms import ground as state
from mcaptrack.transforms import ground as tracker
from mcaptrack.transforms.ground import Waiting, _Apart, associate
from mcaptrack.transforms.motion_limits import LIMITS
from tests.references import ground
from tests.worlds import ns

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


# Parts of the tracker against plain algebra: association, and output


def tables(rng: np.random.Generator, tracks: int, found: int) -> tuple[np.ndarray, np.ndarray]:
    """Tracks, and detections; one score isn't known."""
    table, rows = np.zeros((len(state.no_tracks()), tracks)), np.zeros((state.DETECTION_ROWS, found))
    table[state.PLACE], rows[state.PLACE] = rng.uniform(0, 4, (2, tracks)), rng.uniform(0, 4, (2, found))
    table[state.NOISE], table[state.GATE_M] = rng.uniform(0.1, 0.4, tracks), rng.uniform(1.5, 4, tracks)
    table[state.MISSED_S] = rng.uniform(0, 1, tracks)
    rows[state.SCORE] = rng.choice([0.0, 0.3, 0.9, 1.0, np.nan], found)
    return table, rows


class TestAssociation:
    def test_both_axes_have_the_variance_of_the_track(self):
        rng = np.random.default_rng(7)
        table, rows = tables(rng, 3, 4)
        table[state.PLACE], rows[state.PLACE] = 0.0, np.arange(8).reshape(2, 4) / 4
        spread = state.variance(table)
        np.testing.assert_allclose(spread, table[state._PP] + table[state.NOISE] ** 2)
        reach = np.array([1.2, 0.7, 9.0])
        apart = _Apart(table, rows, Pairing(table[state.PLACE], rows[state.PLACE], reach))
        for i, j in np.ndindex(3, 4):
            squared = (rows[state.PLACE, j] ** 2).sum()
            assert apart.within(9.0, reach)[i, j] == (squared <= 9.0 * spread[i] and squared <= reach[i] ** 2)
            which = np.zeros((3, 4), bool)
            which[i, j] = True
            (gain,) = apart.gain(which, np.array([i]))
            assert gain == pytest.approx(30 - squared / spread[i] - 2 * np.log(spread[i]))


#: Noise, velocity's variance, the gate, time without a detection, hits, class of the detection (the track's is 2), its x
#: in metres; whether they are associated.
GATES = [
    (0.1, 0, 2, 0, 9, 2, 0.39, True),  # 4 standard deviations of 0.1 m
    (0.1, 0, 2, 0, 9, 2, 0.41, False),
    (0.1, 0, 2, 0, 2, 3, 0.29, True),  # 3 between classes
    (0.1, 0, 2, 0, 9, 3, 0.31, False),
    (0.1, 0, 2, 0, 1, 3, 0.29, False),  # too new to be another class
    (0.3, 4, 5, 0, 5, 3, 1.99, True),  # two fifths of the gate in metres between classes
    (0.3, 4, 5, 0, 5, 3, 2.01, False),
    (0.3, 4, 5, 1, 5, 3, 3.99, True),
    (0.3, 4, 5, 1, 5, 3, 4.01, False),
    (0.3, 4, 1, 0, 5, 3, 0.89, True),  # but three times the noise
    (0.3, 4, 1, 0, 5, 3, 0.91, False),
    (5, 0, 1, 0, 5, 2, 0.99, True),
    (5, 0, 1, 0, 5, 2, 1.01, False),
    (5, 0, 1, 1, 5, 2, 1.99, True),  # it grows with the time without a detection
    (5, 0, 1, 1, 5, 2, 2.01, False),
]


def test_gates_at_their_ends():
    for case in GATES:
        noise, variance, gate_m, missed_s, hits, kind, x, is_near = case
        table, rows = np.zeros((len(state.no_tracks()), 1)), np.zeros((state.DETECTION_ROWS, 1))
        table[state.NOISE], table[state._PP], table[state.GATE_M] = noise, variance, gate_m
        table[state.MISSED_S], table[state.HITS], table[state.CLASS] = missed_s, hits, 2
        rows[state.X], rows[state.CLASS] = x, kind
        found = associate(table, rows, "metres", 0.1, across_classes=False)
        wanted = [(0, 0, kind == 2)] * is_near
        assert [*zip(*(part.tolist() for part in found), strict=True)] == wanted, case
        if variance == 0 and noise == 0.1:
            assert associate(table, rows, "metres", 0.1, across_classes=True)[2].tolist() == [True] * (x < 0.4), case


def tracks(**columns: list[float]) -> np.ndarray:
    table = np.zeros((len(state.no_tracks()), len(next(iter(columns.values())))))
    for name, values in columns.items():
        table[getattr(state, name.upper())] = values
    return table


@pytest.mark.parametrize("is_written_at_once", [True, False])
def test_gaps_are_interpolated_in_frames_that_wait(is_written_at_once):
    """Lost after the first frame, found in the fourth, 2 s later; the first of the two between is written already."""
    waiting = Waiting()
    times_s = (0.0, 0.5, 1.5, 2.0)
    for number, t_s in enumerate(times_s[:3]):
        waiting.add(Frame(ns(t_s), number, np.empty(0)), tracks(id=[1, 256] if number == 0 else [256]))
    before = tracks(id=[1, 256], last_frame=[0, 2], missed_s=[2.0, 0.5], vx=[2.0, 0.0], vy=[0.0, 1.0])
    after = tracks(id=[1, 256], x=[8.0, 0.0], heading=[-3.0, 0.0], length=[5.0, 0.0], vx=[4.0, 0.0], vy=[-1.0, 1.0])
    before[state.LAST.start + state.HEADING, 0] = 3.0  # by less than half a turn, over the back
    before[state.LAST.start + state.LENGTH, 0] = 3.0
    waiting.confirm(np.array([1.0, 256.0]), np.array([1.0, 2.0]))
    waiting.release(ns(0.5))
    written = waiting.written() if is_written_at_once else []
    waiting.close_gaps(before, after, 3, ns(2.0))
    waiting.add(Frame(ns(2.0), 3, np.empty(0)), after)
    waiting.release(np.inf)
    frames = [*written, *waiting.written()]
    assert [frame.rows["track_id"].tolist() for frame in frames] == [[1, 2], [2], [1, 2], [1, 2]]
    row = frames[2].rows[0]  # three quarters of the way
    assert (row["observed"], row["source_id"], row["x_m"], row["length_m"]) == (False, -1, 6.0, 4.5)
    assert np.isnan(row["score"])
    assert row["heading_rad"] == pytest.approx(-3.0 - (2 * np.pi - 6) / 4)
    assert (row["vx_m_per_s"], row["vy_m_per_s"]) == (3.5, -0.75)
    assert frames[2].rows["observed"].tolist() == [False, True]
