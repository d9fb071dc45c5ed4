"""What each option of detection, sampling and prediction does."""

from __future__ import annotations

from typing import Any

import numpy as np

from mcaptrack.schema import Frame
from mcaptrack.transforms import EstimateMotion, KnnDetector, MedianDetector, Predict, Sample
from tests import drawn
from tests.effects import Case, Outputs, change_of_forecasts, forecast_steps, line, rows, shaky, spread_of_last
from tests.worlds import ns, tracks_at

CASES: dict[tuple[str, str], Case] = {}


def case(kind: str, option: str, *args: Any) -> None:
    CASES[kind, option] = Case(*args)


def first_forecast(outputs: Outputs) -> int:
    return next(tick for tick, frame in enumerate(outputs[0]) if len(frame.rows))


case(
    "predict", "predictor", "a person walks on, seen with noise", Predict(), shaky(), change_of_forecasts,
    {"cv": "more", "kalman": "least"},
)  # fmt: skip
case(
    "predict", "horizon_s", "2.5 steps a second", Predict(predictor="cv"), line(0.5, 9, 9), forecast_steps,
    {0.4: 1, 2.0: 5, 4.8: 12},
)  # fmt: skip
case(
    "predict", "min_history", "a person is seen from tick 0 on", Predict(predictor="cv"), line(0.5, 9, 9),
    first_forecast, {1: 0, 2: 1, 4: 3},
)  # fmt: skip
case(
    "predict", "adapt", "a person walks straight on, which is predicted better than most walks",
    Predict(predictor="cv"), line(0.5, 40, 40), spread_of_last, {True: "least", False: "more"},
)  # fmt: skip


def tenths(seen: list[int]) -> list[Frame]:
    """Frames of ten a second; a person is there in some of them."""
    return [Frame(ns(n / 10), n, tracks_at({7: (0.1 * n, 0.0)} if n in seen else {})) for n in range(31)]


case(
    "sample", "rate_hz", "three seconds, both ends included", Sample(), tenths(list(range(31))), rows,
    {1.0: 4, 2.5: 8, 5.0: 16},
)  # fmt: skip
case(
    "sample", "max_gap_s",
    "a person is seen until 0.5 s and from 2 s on: ticks at 0.8, 1.2 and 1.6 s are in the hole of 1.5 s", Sample(),
    tenths([n for n in range(31) if n <= 5 or n >= 20]), rows, {0.0: 5, 1.4: 5, 1.5: 8, 3.0: 8},
)  # fmt: skip


def film(draw, count: int = 30) -> list[Frame]:
    """A grey floor on which something is drawn, ten pictures a second."""
    frames = []
    for number in range(count):
        image = np.full((120, 160), 90, np.uint8)
        draw(image, number)
        frames.append(Frame(ns(number / 10), number, image))
    return frames


def stops(image: np.ndarray, number: int) -> None:
    """A person comes in and stops in picture 40, for good."""
    if number >= 30:
        left = 11 + 4 * min(number - 30, 10)
        image[41:81, left : left + 12] = 200


def pale(image: np.ndarray, number: int) -> None:
    """A person hardly brighter than the floor walks over it."""
    image[41:81, 11 + 4 * number : 23 + 4 * number] = 104


def last_boxes(outputs: Outputs) -> int:
    return len(outputs[0][-1].rows)


def all_boxes(outputs: Outputs) -> int:
    return sum(len(frame.rows) for frame in outputs[0][5:])


def shaken() -> list[Frame]:
    """A patterned floor and no people on it, filmed by a shaking camera."""
    rng = np.random.default_rng(1)
    floor = np.kron(rng.integers(40, 200, (16, 20)), np.ones((8, 8))).astype(np.uint8)
    shifts = rng.integers(-3, 4, (25, 2))
    return [Frame(ns(n / 10), n, np.roll(floor, tuple(s), axis=(0, 1))) for n, s in enumerate(shifts)]


STEADY = KnnDetector(stabilise=False)
STOPS = film(stops, 60)
case(
    "detect", "threshold", pale.__doc__, KnnDetector(stabilise=False), film(pale), last_boxes, {100.0: 1, 800.0: 0},
)  # fmt: skip
case("detect", "history_s", stops.__doc__, STEADY, STOPS, all_boxes, {0.5: "least", 2.0: "more", 60.0: "most"})
case(
    "detect", "max_pixels", stops.__doc__, STEADY, STOPS, lambda o: float(o[0][-1].rows["x_px"][0]),
    {1_000_000: 51.0, 10_000: 50.0},
)  # fmt: skip
case("detect", "stabilise", shaken.__doc__, KnnDetector(), shaken(), all_boxes, {False: "more", True: "least"})


def walks_in_the_sun(image: np.ndarray, number: int) -> None:
    """A person walks through again and again, with a shadow."""
    x = 20 + 7.5 * (number % 28)
    image[146:152, round(x) : round(x) + 30] = image[146:152, round(x) : round(x) + 30] * 0.7
    drawn.walk(image, number)


def stand_abreast(image: np.ndarray, number: int) -> None:
    """Three stand side by side for a while, and one walks by."""
    drawn.walk(image, number)
    if number % 3 == 0:
        for x in (100, 110, 120):
            drawn.figure(image, x, 80)


def stand_behind(image: np.ndarray, number: int) -> None:
    """One stands half behind another for a while, and one walks by."""
    drawn.walk(image, number)
    if number % 3 == 0:
        drawn.figure(image, 150, 70)
        drawn.figure(image, 153, 92)


def widest(outputs: Outputs) -> float:
    return float(max(frame.rows["w_px"].max(initial=0) for frame in outputs[0]))


MEDIAN = MedianDetector(stabilise=False)
for option, scene, measure, wanted in (
    ("remove_shadows", walks_in_the_sun, widest, {True: "least", False: "more"}),
    ("separate", stand_abreast, all_boxes, {False: "least", True: "more"}),
    ("least_visible", stand_behind, all_boxes, {0.95: "least", 0.5: "more"}),
):
    case("detect", option, scene.__doc__, MEDIAN, drawn.film(scene), measure, wanted)


def lorry() -> list[Frame]:
    """A lorry that fills most of the picture drives past a street of less contrast; the camera is still."""
    import cv2

    rng = np.random.default_rng(2)
    street, load = (
        cv2.resize(rng.integers(0, 255, (30, 60)).astype(np.uint8), (480, 240), interpolation=cv2.INTER_CUBIC)
        for _ in range(2)
    )
    frames = []
    for number in range(8):
        image = street[:, :320] // 4 + 90
        image[20:220, 30:290] = load[20:220, 30 - 4 * number + 80 : 290 - 4 * number + 80]
        frames.append(Frame(ns(number / 10), number, image))
    return frames


def motion(outputs: Outputs) -> float:
    return sum(abs(float(frame.rows["m02_px"][0])) for frame in outputs[0])


LORRY = lorry()
BOXES = {frame.t_ns: np.array([[28.0, 18.0, 264.0, 204.0]]) for frame in LORRY}
case(
    "motion", "mask_boxes", lorry.__doc__, EstimateMotion(known_boxes=BOXES), LORRY, motion,
    {True: "least", False: "more"},
)  # fmt: skip
