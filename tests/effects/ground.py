"""What each option of tracking in metres does, at ten frames a second, and ``class_limits`` in the stages after it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.transforms import GroundTracker, Predict, Retrack
from tests.effects import Case, Outputs, last_forecast, people, rows
from tests.worlds import ns

NAMES = ((1, "pedestrian"), (3, "car"))
CASES: dict[tuple[str, str], Case] = {}
#: x, y in metres, and other columns where they are not those of a car.
Box = tuple[float, float] | tuple[float, float, dict[str, float]]


def case(option: str, *args) -> None:
    CASES["ground", option] = Case(*args)


def boxes(found: Callable[[int], Sequence[Box]], count: int) -> list[Frame]:
    """Frames of cars of 4 m by 2 m, with a score of 0.8."""
    usual = {"length_m": 4.0, "width_m": 2.0, "height_m": 1.5, "z_m": 1.0, "heading_rad": 0.0}
    usual |= {"score": 0.8, "class_id": 3}
    out = []
    for n in range(count):
        made = [usual | {"x_m": x, "y_m": y, **(more[0] if more else {})} for x, y, *more in found(n)]
        columns = {name: [one[name] for one in made] for name in (made[0] if made else ())}
        out.append(Frame(ns(n / 10), n, DETECTIONS.rows(**columns) if made else DETECTIONS.empty()))
    return out


def missed(unseen: range, count: int) -> list[Frame]:
    """A car stands and is not detected in some frames."""
    return boxes(lambda n: [] if n in unseen else [(5.0, 5.0)], count)


def scored(*scores: float) -> list[Frame]:
    """Two cars that stand apart, with these scores."""
    return boxes(lambda n: [(20.0 * k, 0.0, {"score": score}) for k, score in enumerate(scores)], 10)


case(
    "max_age_s", "a car is not detected for 2.1 s", GroundTracker(class_names=NAMES, link_s=0.0),
    missed(range(10, 30), 40), people, {1.0: 2, 2.0: 2, 2.5: 1},
)  # fmt: skip
case(
    "link_s", "a car is not detected for 5 s; two detections confirm it, 0.1 s later",
    GroundTracker(class_names=NAMES), missed(range(10, 59), 70), people, {0.0: 2, 5.0: 2, 5.2: 1},
)  # fmt: skip
case(
    "delay_s", "two detections confirm a track; then a car is not detected in three frames",
    GroundTracker(class_names=NAMES), missed(range(9, 12), 20), rows, {0.0: 16, 0.1: 18, 1.0: 20},
)  # fmt: skip
case(
    "confirm_score", "three detections of 0.4", GroundTracker(class_names=NAMES),
    boxes(lambda n: [(5.0, 5.0, {"score": 0.4})] if n < 3 else [], 10), rows, {0.3: 3, 1.1: 3, 1.3: 0},
)  # fmt: skip
case(
    "birth_score", "detections of 0.3 beside those of 0.9", GroundTracker(class_names=NAMES), scored(0.9, 0.3),
    people, {0.2: 2, 0.4: 1, 1.0: 0},
)  # fmt: skip
case(
    "cost", "a car is 2.2 m aside in its second frame, which is more than its width",
    GroundTracker(class_names=NAMES), boxes(lambda n: [(0.0, 2.2 * (n > 0))], 10), rows, {"metres": 10, "iou": 9},
)  # fmt: skip
case(
    "min_iou", "a car goes 2 m a frame: a third of both boxes together is in common",
    GroundTracker(class_names=NAMES, cost="iou"), boxes(lambda n: [(2.0 * n, 0.0)], 2), rows,
    {0.05: 2, 0.3: 2, 0.35: 0},
)  # fmt: skip
case(
    "min_score", "cars of scores 0.9 and 0.7", GroundTracker(class_names=NAMES), scored(0.9, 0.7), people,
    {None: 2, 0.6: 2, 0.8: 1, 0.95: 0},
)  # fmt: skip
case(
    "class_id", "a car, and a pedestrian", GroundTracker(class_names=NAMES),
    boxes(lambda n: [(0.0, 0.0), (20.0, 0.0, {"class_id": 1})], 10), people, {None: 2, 1: 1, 3: 1, 4: 0},
)  # fmt: skip
case(
    "across_classes",
    "a car is a pedestrian from its second frame on; a track of one detection doesn't continue with another class",
    GroundTracker(class_names=NAMES), boxes(lambda n: [(0.0, 0.0, {"class_id": 1 if n else 3})], 10), rows,
    {False: 9, True: 10},
)  # fmt: skip
case(
    "class_limits", "a car jumps by 1 m", GroundTracker(class_names=NAMES, link_s=0.0),
    boxes(lambda n: [(1.0 * (n >= 10), 0.0)], 20), people,
    {"": 1, "car=60:3:0.25:0.8": 2, "pedestrian=6:0.8:0.2:0.8": 1},
)  # fmt: skip


def driven(xs_m: Sequence[float | None]) -> list[Frame]:
    """Samples of a car along x under another id after each gap, with the velocities that a tracker in metres gives."""
    out, name = [], 1
    for tick, x_m in enumerate(xs_m):
        name += tick > 0 and x_m is not None and xs_m[tick - 1] is None
        rows = TRACKS.rows(
            track_id=[name], x_m=[x_m or 0.0], y_m=[0.0], vx_m_per_s=[0.0], vy_m_per_s=[0.0], score=[0.8],
            class_id=[3], observed=[True], source_id=[name],
        )  # fmt: skip
        out.append(Frame(ns(tick / 2.5), tick, rows if x_m is not None else TRACKS.empty()))
    return out


def width(outputs: Outputs) -> float:
    """The standard deviation of the last step of the last forecast, along x."""
    return float(np.sqrt(last_forecast(outputs).rows["cov_xx_m2"][-1]))


CASES["retrack", "class_limits"] = Case(
    "a car stands, and after 4 s stands 1.5 m further on", Retrack(class_names=NAMES),
    driven([0.0] * 20 + [None] * 9 + [1.5] * 20), people, {"": 1, "car=1": 2, "pedestrian=1": 1},
)  # fmt: skip
CASES["predict", "class_limits"] = Case(
    "a car goes 5 m/s", Predict(predictor="kalman", class_names=NAMES), driven([2.0 * n for n in range(12)]), width,
    {"": "most", "car=4": "more", "car=2": "least"},
)  # fmt: skip
