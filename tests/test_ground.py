"""Tracks in metres: the ground tracker, and the stages after it.

That its rows are those of a slow tracker, whatever detectors do, is tested in ``test_ground_reference``.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.testing import check_transform
from mcaptrack.transforms import GroundTracker, Predict, Retrack, RetrackByConsistency, Sample
from mcaptrack.transforms.fixed_lag import _log_density, _States
from mcaptrack.transforms.ground import GroundTracks, X, Y
from mcaptrack.transforms.motion_limits import LIMITS, limits_of, limits_row, read_limits
from mcaptrack.transforms.to_video_rate import to_video_rate
from tests.commands import call
from tests.tiers import one_in
from tools.traffic import CLASSES, draw_traffic

NAMES = tuple(CLASSES.items())
PEDESTRIAN, CAR = 1, 3
BOX = ("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad", "score", "class_id")


def scene(seed: int, **how: object) -> tuple[dict[str, np.ndarray], list[Frame]]:
    """The true objects of drawn traffic, and frames of what a detector finds."""
    drawn = draw_traffic(seed, **how)
    at = drawn.boxes["frame"]
    return drawn.truth, [
        Frame(int(t_ns), number, DETECTIONS.rows(**{name: drawn.boxes[name][at == number] for name in BOX}))
        for number, t_ns in enumerate(drawn.t_ns)
    ]


def frames_of(*tracks: dict[int, dict[str, float]], count: int = 0, rate_hz: float = 10.0) -> list[Frame]:
    """Frames of detections from tracks: columns of each by frame. Scores are 0.8, the class is car."""
    last = max(max(track) for track in tracks)
    out = []
    for number in range(max(count, last + 1)):
        found = [{"score": 0.8, "class_id": CAR, **track[number]} for track in tracks if number in track]
        columns = {name: [one[name] for one in found] for name in (found[0] if found else ())}
        rows = DETECTIONS.rows(**columns) if found else DETECTIONS.empty()
        out.append(Frame(round(number / rate_hz * 1e9), number, rows))
    return out


def tracked(frames: list[Frame], **options: object) -> list[Frame]:
    return [frame for (frame,) in GroundTracker(class_names=NAMES, **options)(frames)]


def ids(frames: list[Frame]) -> list[list[int]]:
    return [frame.rows["track_id"].tolist() for frame in frames]


@pytest.mark.parametrize(
    "options", one_in(2, [{}, {"delay_s": 0.0}, {"cost": "iou"}, {"across_classes": True}]), ids=str
)
def test_the_laws_of_transforms_hold(options: dict[str, object]):
    _, frames = scene(3, seconds=4.0, density=0.5)
    frames[20:20] = [frames[20]._replace(rows=DETECTIONS.empty(), t_ns=frames[20].t_ns - 1)]
    check_transform(GroundTracker(class_names=NAMES, **options), frames)


def test_the_laws_hold_with_covariances_of_some_detections():
    _, frames = scene(3, seconds=2.0, density=0.5)
    for number, frame in enumerate(frames):
        frame.rows["cov_xx_m2"], frame.rows["cov_xy_m2"], frame.rows["cov_yy_m2"] = 0.3, 0.1, 0.2
        frame.rows["cov_xx_m2"][frame.rows["x_m"] > 0 if number > 3 else slice(None)] = np.nan
    check_transform(GroundTracker(class_names=NAMES), frames)


def seen(places: list[tuple[float, float, float]], cov: tuple[float, float, float] | None) -> Frame:
    """People (x_m, y_m, score), all with the same covariance, half a second after others."""
    x, y, score = zip(*places, strict=True)
    given = dict(zip(("cov_xx_m2", "cov_xy_m2", "cov_yy_m2"), np.tile(cov, (len(x), 1)).T, strict=True)) if cov else {}
    return Frame(
        500_000_000,
        1,
        DETECTIONS.rows(x_m=x, y_m=y, score=score, class_id=[1] * len(x), source_id=range(len(x)), **given),
    )


@pytest.mark.parametrize("cov", [(-1.0, 0.0, 1.0), (1.0, 2.0, 1.0), (0.0, 0.0, 0.0), (np.inf, 0.0, 1.0)])
def test_covariances_that_are_none_count_as_missing(cov: tuple[float, float, float]):
    first = [(0.0, 0.0, 0.9), (0.75, 0.6, 0.9)]
    frames = [seen(first, None)._replace(t_ns=0, index=0), seen([(0.7, 0.1, 0.9)], None)]
    odd = [frames[0], seen([(0.7, 0.1, 0.9)], cov)]
    options = {"confirm_score": 0.0, "link_s": 0.0}
    for (one,), (other,) in zip(GroundTracker(**options)(odd), GroundTracker(**options)(frames), strict=True):
        assert one.rows.tobytes() == other.rows.tobytes()


CAR_BOX = {"z_m": 0.8, "length_m": 4.5, "width_m": 1.9, "height_m": 1.6, "heading_rad": 0.0}


@pytest.mark.parametrize(("speed", "rate_hz"), [(36.0, 10.0), (55.0, 10.0), (12.0, 2.0), (33.0, 2.0), (20.0, 1.0)])
@pytest.mark.parametrize("box", [CAR_BOX, {}], ids=["box", "point"])
def test_cars_of_any_speed_have_tracks(speed: float, rate_hz: float, box: dict[str, float]):
    found = {t: {"x_m": speed * t / rate_hz, "y_m": 0.0, **box} for t in range(12)}
    frames = tracked(frames_of(found, rate_hz=rate_hz))
    assert ids(frames)[1:] == [[1]] * 11
    assert frames[-1].rows["vx_m_per_s"] == pytest.approx(speed, rel=0.02)


def test_a_detection_belongs_rather_to_the_car_behind_it_than_to_the_nearer_one_ahead():
    behind = {t: {**CAR_BOX, "x_m": 7.5 * t, "y_m": 0.0} for t in range(8)}
    ahead = {t: {**CAR_BOX, "x_m": 14.0 + 7.5 * t, "y_m": 0.0} for t in range(8) if t != 1}
    found = tracked(frames_of(behind, ahead, rate_hz=2.0))
    assert [frame.rows["x_m"].min() for frame in found] == pytest.approx([7.5 * t for t in range(8)], abs=0.1)
    assert found[-1].rows["vx_m_per_s"] == pytest.approx(15.0, rel=0.02)


@pytest.mark.parametrize(
    ("second", "third", "count"),
    [
        ({"x_m": 5.0}, {"x_m": 10.0}, 3),
        ({"x_m": 5.0}, None, 0),  # two false boxes
        ({"x_m": 5.0}, {"x_m": 5.0}, 0),  # the third one is behind
        ({"y_m": 5.0}, {"y_m": 10.0}, 0),  # sideways
        ({"x_m": 5.0, "heading_rad": 0.6}, {"x_m": 10.0}, 0),
        ({"x_m": 5.0, "length_m": 12.0}, {"x_m": 10.0}, 0),
        ({"x_m": 8.0}, {"x_m": 16.0}, 0),  # 80 m/s
        ({"x_m": 5.0, "class_id": PEDESTRIAN}, {"x_m": 10.0}, 0),
    ],
)
def test_fast_tracks_need_a_third_detection_where_the_velocity_says(second, third, count):
    base = {**CAR_BOX, "x_m": 0.0, "y_m": 0.0}
    track = {0: base, 1: base | second} | ({2: base | third} if third else {})
    assert sum(len(frame.rows) for frame in tracked(frames_of(track, count=8))) == count


def test_any_speed_is_a_wider_filter_from_the_beginning():
    """Widening later is the same as having begun with a wider distribution of velocities."""
    tables = []
    for is_late in (True, False):
        limits = LIMITS["car"]
        wide = float(np.hypot(limits.speed_m_per_s, limits.max_speed_m_per_s))
        tracks = GroundTracks()
        found = np.full((12, 1), np.nan)
        found[[X, Y]], found[9:12, 0] = 1.0, (0.5, CAR, -1)
        limits = limits if is_late else limits._replace(speed_m_per_s=wide)
        tracks.initiate(1, found, {CAR: limits}, 0)
        for _ in range(3):
            tracks.predict(0.2)
        if is_late:
            tracks.allow_speed(np.array([0]))
        tables.append(tracks.table[14:20, 0])
    assert tables[0] == pytest.approx(tables[1])


def test_detections_without_a_position_are_left_out_aloud():
    from mcaptrack.notices import collected

    box = DETECTIONS.rows(x_px=[1.0], y_px=[1.0], w_px=[5.0], h_px=[9.0], class_id=[1])
    with collected() as notices:
        assert ids(tracked([Frame(0, 0, box)])) == [[]]
    assert ["1 detections have no position in metres" in str(notice) for notice in notices] == [True]


def test_the_documentation_has_the_table_of_limits():
    rows = [line for line in call("docs", "robots").out.splitlines() if line.count("|") == 9][2:]
    assert [row.split(" ")[1] for row in rows] == list(LIMITS)
    assert "| bicycle | 3.5 | 15 | 1.5 | 0.2 | 2 | yes | 1.8, 0.6, 1.7 |" in rows


@pytest.mark.parametrize(
    ("name", "row"),
    {
        "vehicle.bus.rigid": "bus", "human.pedestrian.adult": "person", "REGULAR_VEHICLE": "car",
        "LARGE_VEHICLE": "truck", "MOTORCYCLIST": "motorcycle", "Cyclist": "bicycle", "traffic_cone": "object",
        "Person_sitting": "person", "TYPE_VEHICLE": "car", "BoxTruck": "truck", "": "unknown", "carpet": "unknown",
    }.items(),
)  # fmt: skip
def test_names_of_data_sets_have_a_row(name: str, row: str):
    assert limits_row(name) == row


def test_limits_of_users_replace_those_of_the_table():
    own = read_limits("car=40,pedestrian=4::0.1")
    assert limits_of("car", own) == LIMITS["car"]._replace(max_speed_m_per_s=40.0)
    assert limits_of("pedestrian", own) == LIMITS["person"]._replace(max_speed_m_per_s=4.0, noise_m=0.1)
    assert limits_of("bus", own) == LIMITS["bus"]
    all_four = read_limits(" Car = 5 : 0 : 0.3 : 2 ,, bus=::0.4:, forklift=:1::3")
    assert all_four["car"] == LIMITS["car"]._replace(
        max_speed_m_per_s=5.0, speed_m_per_s=5.0, drift_m_per_s=0.0, noise_m=0.3, gate_m=2.0
    )
    assert all_four["bus"] == LIMITS["bus"]._replace(noise_m=0.4)
    assert all_four["forklift"] == LIMITS["unknown"]._replace(name="forklift", drift_m_per_s=1.0, gate_m=3.0)
    assert limits_of("Forklift", all_four).gate_m == 3.0
    assert (read_limits(""), read_limits("car=999999")["car"].max_speed_m_per_s) == ({}, 999999.0)
    for zero in ("car=0", "car=1::0", "car=1:::0"):
        with pytest.raises(McaptrackError, match="have to be more than 0"):
            read_limits(zero)
    with pytest.raises(McaptrackError, match="names car twice"):
        read_limits("car=1,CAR=2")
    for wrong in ("car", "car=", "=4", "car=fast", "car=1:2:3:4:5", "car=-1", "car=1e6", "car=nan", "car=:::"):
        with pytest.raises(McaptrackError, match="NAME=SPEED"):
            GroundTracker(class_limits=wrong)
    zeros = (("car=0", "SPEED, NOISE"), ("car=::0", "NOISE and GATE"), ("car=:::0", "GATE have to be more than 0"))
    for wrong, why in (("car=40, Car=50", "names car twice"), *zeros):
        for make in (GroundTracker, Retrack, RetrackByConsistency, Predict):
            with pytest.raises(McaptrackError, match=why):
                make(class_limits=wrong)


def compared(truth: dict[str, np.ndarray], frames: list[Frame]) -> tuple[int, float, float]:
    """Identity switches; the share of true objects found within 2 m; the share of rows at no object of their class."""
    switches, found, rows_found, rows = 0, 0, 0, 0
    last: dict[int, int] = {}
    for number, frame in enumerate(frames):
        at = np.flatnonzero(truth["frame"] == number)
        away = np.hypot(truth["x_m"][at][:, None] - frame.rows["x_m"], truth["y_m"][at][:, None] - frame.rows["y_m"])
        away[truth["class_id"][at][:, None] != frame.rows["class_id"]] = np.inf
        rows += len(frame.rows)
        if not away.size:
            continue
        best = away.argmin(axis=1)
        near = away[np.arange(len(at)), best] < 2.0
        found += int(near.sum())
        rows_found += int((away.min(axis=0) < 2.0).sum())
        for one, track in zip(truth["id"][at[near]].tolist(), frame.rows["track_id"][best[near]].tolist(), strict=True):
            switches += last.get(one, track) != track
            last[one] = track
    return switches, found / len(truth["frame"]), 1 - rows_found / max(rows, 1)


def test_drawn_traffic_is_tracked_and_repaired():
    truth, frames = scene(11, seconds=12.0, density=0.7)
    tracks = tracked(frames)
    switches, found, wrong = compared(truth, tracks)
    assert found > 0.88
    assert wrong < 0.12
    samples = [frame for (frame,) in Sample()(tracks)]
    offline = [one[0] for one in Retrack(class_names=NAMES)(samples)]
    full = to_video_rate(tracks, offline, ())
    full_switches, full_found, full_wrong = compared(truth, full)
    assert full_switches <= switches
    assert full_found > 0.88
    assert full_wrong < min(0.06, wrong)
    rows = np.concatenate([frame.rows for frame in full])
    for name in ("z_m", "length_m", "width_m", "height_m", "heading_rad", "vx_m_per_s", "vy_m_per_s"):
        assert np.isfinite(rows[name]).all(), name
    assert np.abs(rows["heading_rad"]).max() <= np.pi
    per_track = Counter(
        (one, kind) for one, kind in {*zip(rows["track_id"].tolist(), rows["class_id"].tolist(), strict=True)}
    )
    assert len(per_track) == len(set(rows["track_id"].tolist()))  # one class each


@pytest.mark.parametrize(("pictures", "is_repaired"), [(1, True), (4, False)])
def test_people_that_were_detected_as_seldom_as_samples_are_associated_again(pictures: int, is_repaired: bool):
    """Two people cross at a right angle and swap ids; a tracker that saw more than the samples is believed."""
    frames = []
    for t in range(40):
        way = 0.4 * (t - 20)
        ids = [1, 2] if t < 21 else [2, 1]
        rows = TRACKS.rows(track_id=ids, x_m=[way, 0.1], y_m=[0.0, way + 0.3], observed=[True] * 2, class_id=[1] * 2,
                           score=[0.9] * 2, source_id=ids, vx_m_per_s=[1.0, 0.0], vy_m_per_s=[0.0, 1.0])  # fmt: skip
        frames.append(Frame(t * 400_000_000, t * pictures, rows))
    ends = [offline.rows for offline, *_ in Retrack(class_names=NAMES)(frames)]
    first, last = (
        dict(zip(np.rint(rows["x_m"]).tolist(), rows["track_id"].tolist(), strict=True)) for rows in (ends[5], ends[35])
    )
    assert (first[0.0] == last[0.0]) == is_repaired


def test_headings_are_interpolated_around_the_circle():
    def row(heading: float) -> np.ndarray:
        return TRACKS.rows(track_id=[1], x_m=[0.0], y_m=[0.0], heading_rad=[heading], observed=[True], source_id=[-1])

    frames = [Frame(0, 0, row(3.0)), Frame(800_000_000, 1, row(-3.0))]
    (middle,) = [frame.rows["heading_rad"][0] for (frame,) in Sample(rate_hz=2.5)(frames)][1:2]
    assert abs(middle) == pytest.approx(np.pi)


def test_cars_are_predicted_in_their_own_unit():
    def forecast(name: str, factor: float) -> np.ndarray:
        rows = [
            TRACKS.rows(
                track_id=[1], x_m=[factor * 0.5 * t], y_m=[0.0], observed=[True], source_id=[-1], class_id=[CAR]
            )
            for t in range(8)
        ]
        frames = [Frame(t * 400_000_000, t, one) for t, one in enumerate(rows)]
        *_, (last,) = Predict(class_names=((CAR, name),))(frames)
        return last.rows["x_m"]

    assert forecast("car", 4.0) == pytest.approx(4 * forecast("pedestrian", 1.0))


def test_forecasts_of_retracked_cars_are_those_of_predict():
    """In the unit of cars, mean and covariance: online tracks that are samples have the forecasts of samples."""
    names = ((CAR, "car"),)
    frames = [
        Frame(
            t * 400_000_000,
            t,
            TRACKS.rows(
                track_id=[1, 2],
                x_m=[2.0 * t, 40 - 1.5 * t],
                y_m=[0.2 * t, 30.0],
                observed=[True] * 2,
                source_id=[-1] * 2,
                class_id=[CAR] * 2,
            ),
        )
        for t in range(12)
    ]
    retrack = Retrack(class_names=names)
    outputs = dict(zip(retrack.writes, list(retrack(frames))[-1], strict=True))
    (topic,) = [name for name in outputs if "predictions" in name]
    *_, (wanted,) = Predict(class_names=names, predictor=retrack.predictor)(frames)
    own = outputs[topic].rows
    assert len(own) == len(wanted.rows) > 0
    for name in ("x_m", "y_m"):
        np.testing.assert_allclose(own[name], wanted.rows[name], rtol=1e-6, err_msg=name)
    for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2"):  # online tracks begin later, so they were compared less often
        np.testing.assert_allclose(own[name], wanted.rows[name], rtol=1e-2, err_msg=name)


#: Mean length, width and height in metres of boxes of the public data set nuScenes (its training split).
MEAN_SIZES = {
    "car": (4.63, 1.97, 1.74), "truck": (6.93, 2.51, 2.84), "bus": (11.1, 2.95, 3.47), "trailer": (12.3, 2.90, 3.87),
    "motorcycle": (2.11, 0.77, 1.47), "bicycle": (1.70, 0.60, 1.28), "person": (0.73, 0.67, 1.77),
}  # fmt: skip


@pytest.mark.parametrize("name", MEAN_SIZES)
def test_usual_sizes_are_near_the_mean_of_recorded_ones(name: str):
    assert LIMITS[name].size_m == pytest.approx(MEAN_SIZES[name], rel=0.34)


# Tracks of detections with covariances, whose associations wait for what comes after them.


PEOPLE = ((1, "person"),)
NS = 1_000_000_000


def joint(t_s: np.ndarray, noise: np.ndarray, drift: float, speed: float) -> np.ndarray:
    """The covariance (2T, 2T) of positions at rising times (T,) of who begins at 0 with a normal velocity, measured with
    noise (T, 2, 2): of a velocity that is a random walk, by its integral.
    """
    passed = t_s - t_s[0]
    low, high = np.minimum(passed, passed[:, None]), np.maximum(passed, passed[:, None])
    moved = speed**2 * passed * passed[:, None] + drift**2 * (low**2 * high / 2 - low**3 / 6)
    out = np.kron(moved, np.eye(2))
    for number, part in enumerate(noise):
        out[2 * number : 2 * number + 2, 2 * number : 2 * number + 2] += part
    return out


def likely(t_s: np.ndarray, xy_m: np.ndarray, noise: np.ndarray, drift: float, speed: float) -> float:
    """The log likelihood of places (T, 2), of which the first may be anywhere."""
    cov = joint(t_s, noise, drift, speed) + 1e4 * np.kron(np.ones((len(t_s), len(t_s))), np.eye(2))
    return float(_log_density(xy_m.reshape(1, -1), cov[None])[0])


def filtered(t_s: np.ndarray, xy_m: np.ndarray, noise: np.ndarray, drift: float, speed: float) -> _States:
    states = _States.of(xy_m[:1], noise[:1], np.array([speed]))
    for number in range(1, len(t_s)):
        after = states.after(np.array([0]), np.diff(t_s)[number - 1 : number], np.array([drift]))
        states, _ = after.corrected(xy_m[number : number + 1], noise[number : number + 1])
    return states


@pytest.mark.parametrize("seed", range(4))
def test_how_well_a_past_fits_a_future_is_the_likelihood_of_both_as_one_track(seed: int):
    """By how much one past is better than another, against normal distributions of all places of a track at once."""
    rng = np.random.default_rng(seed)
    drift, speed = 0.4, 1.5
    t_s = np.cumsum(rng.uniform(0.2, 0.7, 8))
    half = rng.normal(0, 0.1, (8, 2, 2))
    noise = half @ np.swapaxes(half, 1, 2) + 0.02 * np.eye(2)
    future = rng.normal(0, 0.5, (4, 2))
    found, expected = [], []
    behind = filtered(t_s[:3:-1], future[::-1], noise[:3:-1], drift, 1e3)
    for _ in range(2):
        past = rng.normal(0, 0.5, (4, 2))
        ahead = filtered(t_s[:4], past, noise[:4], drift, speed).after(
            np.array([0]), t_s[4:5] - t_s[3:4], np.array([drift])
        )
        found.append(float(_log_density(ahead.mean - behind.mean, ahead.cov + behind.cov)[0]))
        both = likely(t_s, np.concatenate([past, future]), noise, drift, speed)
        expected.append(both - likely(t_s[:4], past, noise[:4], drift, speed))
    assert found[1] - found[0] == pytest.approx(expected[1] - expected[0], abs=0.01)


def crossing(seed: int) -> tuple[list[Frame], np.ndarray]:
    """Two people who walk through each other at a small angle, missed now and then; their places (T, 2, 2)."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(24) / 2
    side = rng.uniform(0.15, 0.3)
    walk = np.stack([np.stack([1.2 * t_s, sign * side * (t_s - 6)], axis=-1) for sign in (1, -1)], axis=1)
    frames = []
    for number, now in enumerate(walk):
        at = (now + rng.normal(0, 0.12, (2, 2)))[rng.random(2) > 0.15]
        cov = {"cov_xx_m2": 0.02, "cov_xy_m2": 0.0, "cov_yy_m2": 0.02, "score": 0.95, "class_id": 1}
        columns = {name: np.full(len(at), value) for name, value in cov.items()}
        rows = DETECTIONS.rows(x_m=at[:, 0], y_m=at[:, 1], **columns) if len(at) else DETECTIONS.empty()
        frames.append(Frame(number * NS // 2, number, rows))
    return frames, walk


def exchanged(seed: int, delay_s: float) -> bool:
    """Whether the two have not the same ids after they met as before."""
    frames, walk = crossing(seed)
    tracker = GroundTracker(class_names=PEOPLE, delay_s=delay_s, class_limits="person=:0.4::1.2", confirm_score=1.0)
    rows = [frame.rows for (frame,) in tracker(frames)]
    ids = []
    for number in (5, 20):
        for place in walk[number]:
            away = np.hypot(rows[number]["x_m"] - place[0], rows[number]["y_m"] - place[1])
            ids.append(rows[number]["track_id"][away.argmin()] if len(away) and away.min() < 0.8 else -1)
    return ids[:2] != ids[2:]


def test_people_who_meet_are_told_apart_by_where_they_go_then():
    late, at_once = (sum(exchanged(seed, delay_s) for seed in range(12)) for delay_s in (4.0, 0.0))
    assert late <= 2
    assert late < at_once / 2
