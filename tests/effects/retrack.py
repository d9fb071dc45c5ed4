"""What each option of re-tracking does. Its outputs: offline, online, predictions. Two and a half ticks a second."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from mcaptrack.schema import Frame
from mcaptrack.transforms import PROFILES, Retrack, RetrackByConsistency
from tests.clothes import BLUE, RED, two_who_turn_back
from tests.effects import (
    Case,
    Outputs,
    change_of_forecasts,
    forecast_steps,
    last_forecast,
    line,
    noise,
    people,
    rows,
    shaky,
    spread_of_last,
)
from tests.worlds import places, tracks_at, walk

CASES: dict[tuple[str, str], Case] = {}


def case(option: str, *args: Any) -> None:
    own = {f.name for f in fields(RetrackByConsistency)} - {f.name for f in fields(Retrack)}
    CASES["consistency" if option in own else "retrack", option] = Case(*args)


def of_another_class(frames: list[Frame], first: int) -> list[Frame]:
    """Frames with rows of class 1, and of class 2 from a tick on."""
    for tick, frame in enumerate(frames):
        frame.rows["class_id"] = 1 + (tick >= first)
    return frames


def online_rows(outputs: Outputs) -> int:
    return sum(len(frame.rows) for frame in outputs[1])


def first_online(outputs: Outputs) -> int:
    """The first tick at which a person is shown online."""
    return next(tick for tick, frame in enumerate(outputs[1]) if len(frame.rows))


def first_step_x(outputs: Outputs) -> float:
    """The first predicted position of the last forecast, along x."""
    return round(float(last_forecast(outputs).rows["x_m"][0]), 9)


def roughness(outputs: Outputs) -> float:
    """The mean length of the second differences of a path, in metres."""
    path = np.array([[frame.rows["x_m"][0], frame.rows["y_m"][0]] for frame in outputs[0] if len(frame.rows)])
    return float(np.hypot(*np.diff(path, 2, axis=0).T).mean())


def same_at_both_ends(outputs: Outputs) -> bool:
    """Whether the two identities of the first frame have changed sides by the last frame, as the people did."""
    first, last = places(outputs[0][0]), places(outputs[0][-1])
    return all(first[who][0] * last[who][0] < 0 for who in first)


def hidden(unseen: range, ticks: int = 40, speed: float = 0.5, aside_m: float = 0.0, name: int = 8) -> list[Frame]:
    """One walks, is not seen for some ticks, and comes back under another id, perhaps somewhat aside."""

    def path(n: int):
        if n in unseen:
            return {}
        return {7: (speed * n, 0.0)} if n < unseen.start else {name: (speed * n, aside_m)}

    return walk(path, ticks)


def turning(speed: float, degrees: float, ticks: int = 40) -> list[Frame]:
    """One goes ``speed`` metres a tick and turns by so much every tick, under a new id each tick."""
    angle = np.radians(degrees) * np.arange(ticks)
    path = np.cumsum(speed * np.stack([np.cos(angle), np.sin(angle)], axis=-1), axis=0)
    return walk(lambda n: {n: tuple(path[n])}, ticks)


def one_box(together: range, ticks: int = 40) -> list[Frame]:
    """Two walk abreast, 1.2 m apart; for a while they are one detection between them, under the first one's id."""

    def path(n: int):
        if n in together:
            return {1: (0.4 * n, 0.0)}
        return {1: (0.4 * n, 0.6), 2 if n < together.start else 3: (0.4 * n, -0.6)}

    return walk(path, ticks)


def off_the_path(outputs: Outputs) -> float:
    """How far, on average, the offline path is from where a person was seen; the samples are those of CIRCLES."""
    off = [
        np.subtract(*(next(iter(places(f).values())) for f in both)) for both in zip(outputs[0], CIRCLES, strict=True)
    ]
    return float(np.hypot(*np.array(off).T).mean())


def turned_back(outputs: Outputs) -> int:
    """The number of tracks that have input ids 1 and 11, or 2 and 12."""
    rows = [row for frame in outputs[0] for row in frame.rows[["track_id", "source_id"]].tolist()]
    pairs = set(rows)
    return sum((one, source + 10) in pairs for one, source in pairs if source in (1, 2))


def stored_rows(outputs: Outputs) -> int:
    """The rows of the output beside offline tracks, online ones, predictions and decisions."""
    return sum(len(frame.rows) for output in outputs[4:] for frame in output)


CIRCLES = turning(0.8, 15.0)
LIKELY = replace(
    PROFILES["default"], link_s=0.0, resolve_swaps=False, smooth=False, track_confidence=0.0, adapt_online=False
)
PAPER = PROFILES["paper"]
#: The paper's method with nothing that hides short tracks.
BARE = replace(PAPER, min_hits=0, min_track_s=0.0)
#: The expected position compared with the seen one, which is what most cases can say in a few words.
NOW = replace(BARE, distance="now", min_history=2, noise_m=0.0)


def stands_then_jumps(to_m: float) -> list[Frame]:
    """A person stands for 12 ticks and then stands elsewhere."""
    return walk(lambda n: {7: (0.0 if n < 12 else to_m, 0.0)}, 24)


case(
    "predictor", "a person walks on, seen with noise", LIKELY, shaky(), change_of_forecasts,
    {"cv": "more", "kalman": "least"},
)  # fmt: skip
case(
    "adapt", "a person walks straight on, which is predicted better than most walks", LIKELY, line(0.5, 40, 40),
    spread_of_last, {True: "least", False: "more"},
)  # fmt: skip
case(
    "appearance",
    "two people in red and blue walk towards each other, are hidden, and turn back: by their motion they have passed",
    Retrack(descriptors=two_who_turn_back(RED, BLUE)[1]), list(two_who_turn_back(RED, BLUE)[0]), turned_back,
    {True: 2, False: 0},
)  # fmt: skip
case(
    "store_appearance",
    "what is seen of each of two people who turn back, as rows for the upper body and for the legs",
    Retrack(descriptors=two_who_turn_back(RED, BLUE)[1]), list(two_who_turn_back(RED, BLUE)[0]), stored_rows,
    {True: 4, False: 0},
)  # fmt: skip
case(
    "worlds", "two people, each a tracklet: a row for each world and tracklet", LIKELY,
    walk(lambda n: {1: (0.5 * n, 0.0), 2: (0.5 * n, 9.0)}, 20), stored_rows, {0: 0, 3: 6},
)  # fmt: skip
case("horizon_s", "2.5 steps a second", LIKELY, line(0.5, 20, 20), forecast_steps, {0.4: 1, 2.0: 5, 4.8: 12})
case(
    "distance",
    """A person stands, then walks off at 0.9 m a tick. At first forecasts are (0.9 + 0.3) / sqrt(3) = 0.69 apart, at the
    last shared step (0.9 + 11 * 0.3) / sqrt(23) = 0.88, on average 0.75; the place is 0.9 off.""",
    replace(BARE, max_distance=0.78, noise_m=0.0), walk(lambda n: {7: (0.9 * max(n - 11, 0), 0.0)}, 13), people,
    {"first": 1, "mean": 1, "now": 2, "max": 2},
)  # fmt: skip
case(
    "covariance", "a jump of 3.5 m: 3.5 of the paper's sigmas; the predictor's own uncertainty is smaller",
    replace(NOW, max_distance=4.0), stands_then_jumps(3.5), people, {"paper": 1, "predictor": 2},
)  # fmt: skip
case("sigma_m", "1 m aside after a step", NOW, stands_then_jumps(1.0), people, {1.0: 1, 0.34: 1, 0.33: 2})
case(
    "noise_m",
    "4 m aside after a step, 3 sigmas allowed: the variances of forecast and position add up to at least (4 / 3)^2 m^2",
    NOW, stands_then_jumps(4.0), people, {0.0: 2, 0.87: 2, 0.89: 1},
)  # fmt: skip
case(
    "speed_m_per_s", "a person runs, 2 m a tick, under a new id each tick", LIKELY, turning(2.0, 0.0), people,
    {0.1: 0, 0.5: 0, 2.0: 1},
)  # fmt: skip
case(
    "drift_m_per_s", "a person goes round in circles, 15 degrees a tick",
    replace(LIKELY, drift_ratio=0.0, smooth=True), CIRCLES, off_the_path, {0.3: "least", 0.1: "more", 0.02: "most"},
)  # fmt: skip
case(
    "drift_ratio", "a person goes round in circles, 15 degrees a tick",
    replace(LIKELY, drift_m_per_s=0.0, smooth=True), CIRCLES, off_the_path, {0.5: "least", 0.05: "more"},
)  # fmt: skip
case("max_distance", "1 m aside after a step: 1 sigma", NOW, stands_then_jumps(1.0), people, {0.99: 2, 1.0: 1})
case(
    "priority_distance",
    """Tracks 1 and 2 stand at 0 and 1 m, then 3 stands at 0.1 m and 4 at -0.9 m. To 1 they are 0.1 and 0.9, to 2 0.9 and
    1.9 far: crosswise makes 1.8, straight 2.0; only a certain pair keeps 3 with 1.""",
    replace(NOW, gate_m=None, max_distance=9.0),
    walk(lambda n: {1: (0.0, 0.0), 2: (1.0, 0.0)} if n < 10 else {3: (0.1, 0.0), 4: (-0.9, 0.0)}, 12),
    lambda outputs: next(int(r["track_id"]) for r in outputs[1][11].rows if r["source_id"] == 3),
    {0.0: 2, 0.2: 1},
)
case(
    "gate_m", "2 m aside after a step", replace(NOW, max_distance=9.0), stands_then_jumps(2.0), people,
    {1.99: 2, 2.0: 1, None: 1},
)  # fmt: skip
case(
    "same_id_bonus", "two stand 0.4 m apart and change places within a tick, each with its id", LIKELY,
    walk(lambda n: {1: (0.0, 0.0), 2: (0.4, 0.0)} if n < 10 else {1: (0.4, 0.0), 2: (0.0, 0.0)}, 30),
    lambda outputs: int(outputs[1][29].rows["source_id"][0]), {0.0: 2, 30.0: 1},
)  # fmt: skip
case(
    "max_age_s", "a person is not seen for 5 ticks: seen at tick 10 and again, 6 ticks or 2.4 s later, at tick 16",
    replace(LIKELY, noise_m=0.2), hidden(range(11, 16)), people, {0.8: 2, 2.0: 2, 2.4: 1, 2.8: 1},
)  # fmt: skip
case(
    "merge_distance_m", "two are one detection for 2 s, 0.6 m beside where both are expected", LIKELY,
    one_box(range(15, 20)), lambda outputs: len(outputs[1][19].rows), {0.0: 1, 0.5: 1, 0.7: 2},
)  # fmt: skip
case(
    "merge_timeout_s", "two are one detection for 10 ticks, 4 s; lost, a track is shown for 1.2 s more", LIKELY,
    one_box(range(15, 25)), lambda outputs: len(outputs[1][24].rows), {0.0: 1, 2.0: 1, 3.0: 2, 4.0: 2},
)  # fmt: skip
case(
    "confirm_s", "a person is seen from tick 0 on, every 0.4 s", LIKELY, line(0.5, 20, 20), first_online,
    {0.0: 0, 0.4: 1, 1.2: 3, 2.0: 5},
)  # fmt: skip
case(
    "coast_s", "a person is seen at ticks 0 to 9 and shown from tick 3 on", LIKELY, line(0.5, 10, 20), online_rows,
    {0.0: 7, 0.4: 8, 1.2: 10, 2.0: 12},
)  # fmt: skip
case(
    "adapt_online", "a person is seen from tick 0 on; no track was false yet", LIKELY, line(0.5, 20, 20),
    first_online, {False: 3, True: 0},
)  # fmt: skip
case(
    "alpha", "a last displacement of 2 m after some of 1 m: the smoothed one, and the mean of the last three",
    replace(BARE, beta=0.0), walk(lambda n: {7: (float(n) if n < 9 else 10.0, 0.0)}, 10), first_step_x,
    {1.0: 10 + 4 / 3, 0.5: 10 + 3.5 / 3},
)  # fmt: skip
case(
    "beta",
    "displacements of 1 m, then 2, then 2: levels 1.5 and 1.75 without a trend; with it, (2 + 1.5 + 0.25) / 2 = 1.875",
    replace(BARE, alpha=0.5), walk(lambda n: {7: (float(n) if n < 9 else 8.0 + 2 * (n - 8), 0.0)}, 11),
    first_step_x, {0.0: 12 + 4.25 / 3, 0.5: 12 + 4.375 / 3},
)  # fmt: skip
case(
    "birth", "displacements of 1, 0 and 2 m: raw, their mean; smoothed, that of 1, 0.5 and 1.125",
    replace(PAPER, min_hits=0), walk(lambda n: {7: ([0.0, 1.0, 1.0, 3.0][n], 0.0)}, 4), first_step_x,
    {"raw": 4.0, "smoothed": 3 + 2.625 / 3},
)  # fmt: skip
case(
    "min_history", "a person is seen from tick 0 on", BARE, line(0.5, 20, 20), first_online,
    {1: 0, 2: 1, 4: 3, 6: 5},
)  # fmt: skip
case(
    "min_hits", "a person is seen from tick 0 on; there is an observation from tick 3, a match from tick 4", BARE,
    line(0.5, 20, 20), first_online, {0: 3, 1: 4, 3: 6},
)  # fmt: skip
case(
    "trim_ends", "seen until tick 9, and for one match more, at tick 16; two in a row would have confirmed it",
    replace(PAPER, min_hits=2),
    walk(lambda n: {1: (0.5 * n, 0.0)} if n < 10 else {2: (0.5 * n, 0.0)} if 13 <= n < 17 else {}, 20), rows,
    {False: 17, True: 10},
)  # fmt: skip
case(
    "min_track_s", "a person is there for 8 ticks, which is 2.8 s from the first to the last", LIKELY,
    line(0.5, 8, 20), people, {2.0: 1, 2.8: 1, 3.2: 0},
)  # fmt: skip
case(
    "link_s",
    "a person walks on behind a wall, unseen from tick 20 to tick 34: 16 ticks or 6.4 s from one to the other",
    replace(LIKELY, min_track_s=0.4), hidden(range(20, 35), 60), people, {0.0: 2, 6.0: 2, 6.4: 1},
)  # fmt: skip
case(
    "across_classes", "the same, and behind the wall the detector's class changes",
    replace(LIKELY, min_track_s=0.4, link_s=20.0), of_another_class(hidden(range(20, 35), 60), 30), people,
    {False: 2, True: 1},
)  # fmt: skip
case(
    "side_view",
    "the same seen from the side, on a scale that was guessed: tracks without boxes are passed on as they are, unless that is asked for",
    replace(LIKELY, min_track_s=0.4, link_s=20.0, poor_scale=True), hidden(range(20, 35), 60), people,
    {False: 2, True: 1},
)  # fmt: skip
case(
    "link_confidence", "a person walks on behind a wall, 1 m aside", replace(LIKELY, link_s=20.0),
    hidden(range(20, 35), 60, aside_m=1.0), people, {0.05: 1, 0.99: 2},
)  # fmt: skip
case(
    "resolve_swaps", "two pass, unseen for a moment, the ids of the input change sides, and they are believed",
    replace(LIKELY, same_id_bonus=60.0),
    walk(
        lambda n: {} if 29 <= n <= 31 else {1 + (n > 30): (0.4 * (n - 30), 0.0), 2 - (n > 30): (0.4 * (30 - n), 0.5)},
        61,
    ),
    same_at_both_ends, {False: False, True: True},
)  # fmt: skip
case(
    "track_confidence", "a person walks for 24 s; something leaps about for 2.4 s", LIKELY,
    walk(lambda n: {1: (0.4 * n, 0.0)} | ({9: (*(noise(60, 0.5)[n] + [0, 20]),)} if 20 <= n < 27 else {}), 60),
    people, {0.0: 2, 0.5: 1, 1.0: 0},
)  # fmt: skip
case(
    "smooth", "a person walks on, seen with noise", LIKELY, shaky(), roughness, {False: "more", True: "least"},
)  # fmt: skip
case(
    "backfill",
    "a person comes at tick 6; with two positions there is an observation, at tick 7, and its past is tick 6",
    replace(NOW, min_history=2), walk(lambda n: {7: (0.5 * n, 0.0)} if n >= 6 else {}, 20), rows,
    {"none": 13, "unclaimed": 14, "all": 14},
)  # fmt: skip
case(
    "interpolated", "ten ticks, of which the tracker interpolated every other one",
    replace(LIKELY, min_track_s=0.0, confirm_s=0.0, coast_s=0.0),
    [
        frame._replace(rows=tracks_at({7: (0.5 * n, 0.0)}, observed=n % 2 == 0))
        for n, frame in enumerate(line(0.5, 10, 10))
    ],
    online_rows, {False: 5, True: 10},
)  # fmt: skip
