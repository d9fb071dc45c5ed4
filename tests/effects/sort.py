"""What each option of SORT and its relatives does, at ten frames a second."""

from __future__ import annotations

import numpy as np

from mcaptrack.geometry.camera_path import CameraPath, poses_of
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import Frame
from mcaptrack.transforms import ByteTrack, OcSort, Sort
from tests.effects import Case, Outputs, people, rows
from tests.worlds import boxes_at, detections, ns

PLANE = ((0, GroundPlane((0.05, 0, 0, 0, 0.05, 0, 0, 0, 1), 640, 480)),)
CASES: dict[tuple[str, str], Case] = {}


def case(kind: str, option: str, *args) -> None:
    CASES[kind, option] = Case(*args)


FRAMES = {"max_age_frames": 3, "min_hits_frames": 0}


def missed(unseen: range, count: int = 30) -> list[Frame]:
    """A person stands and is not seen for some frames."""
    return detections(lambda n: [] if n in unseen else [(50, 50)], count)


def jump(pixels: float, count: int = 20, size: tuple[float, float] = (20, 40)) -> list[Frame]:
    """A box stands, and from the tenth frame on stands to the right of there."""
    return [Frame(ns(n / 10), n, boxes_at([(100 + (pixels if n >= 10 else 0), 50)], size)) for n in range(count)]


def said(**columns: list[float]) -> list[Frame]:
    """Two boxes that stand apart, with these columns."""
    frames = detections(lambda n: [(50, 50), (150, 50)], 10)
    for frame in frames:
        for name, values in columns.items():
            frame.rows[name] = values
    return frames


def second_scores(scores: list[float]) -> list[Frame]:
    """A person with a high score stands still; beside it a box with these scores, one a frame."""
    frames = detections(lambda n: [(50, 50), (150 + 2 * n, 50)], len(scores))
    for frame, score in zip(frames, scores, strict=True):
        frame.rows["score"] = [0.9, score]
    return frames


def panned(by: float, count: int = 30) -> tuple[list[Frame], CameraPath]:
    """A person stands; the camera pans by so many pixels from every fifth picture to the next, and back after ten."""
    steps = [by * (-1) ** (n // 5) if n % 5 == 0 and n else 0.0 for n in range(count)]
    frames = detections(lambda n: [(150 + sum(steps[: n + 1]), 50)], count)
    motions = np.array([[[1.0, 0.0, step], [0.0, 1.0, 0.0]] for step in steps])
    return frames, CameraPath(np.array([frame.t_ns for frame in frames]), poses_of(motions, 320, 240))


def shared(kind: str, tracker: type[Sort]) -> None:
    base = tracker(**FRAMES)
    frames, path = panned(-45.0)  # a tenth of the diagonal is 40 px
    moved = tracker(max_age_frames=3, min_hits_frames=0, camera_path=path)
    case(kind, "camera_motion", panned.__doc__, moved, frames, people, {"off": 6, "auto": 1, "on": 1})
    case(
        kind, "max_age_s", "missed in 4 frames: in the last of them the last box is 0.4 s ago",
        tracker(min_hits_s=0.0), missed(range(10, 14)), people, {0.3: 2, 0.4: 1, 1.0: 1},
    )  # fmt: skip
    case(
        kind, "max_age_frames", "missed in 4 frames", base, missed(range(10, 14)), people, {3: 2, 4: 1, 6: 1},
    )  # fmt: skip
    case(
        kind, "min_hits_s", "a person comes into a running log at 1 s", tracker(),
        detections(lambda n: [(50, 50)] if n >= 10 else [], 30), lambda o: 30 - rows(o),
        {0.0: 10, 0.3: 13, 0.5: 15},
    )  # fmt: skip
    case(
        kind, "min_hits_frames", "a person comes into a running log in frame 10", base,
        detections(lambda n: [(50, 50)] if n >= 10 else [], 30), lambda o: 30 - rows(o), {0: 10, 3: 13, 5: 15},
    )  # fmt: skip
    case(
        kind, "cost", "small boxes that move by more than their size, 1 m, a frame",
        tracker(**FRAMES, ground_planes=PLANE, max_distance_m=0.9),
        [Frame(ns(n / 10), n, boxes_at([(20 + 20 * n, 50)], (8, 8))) for n in range(10)], people,
        {"iou": 10, "pixels": 1, "metres": 10},
    )  # fmt: skip
    case(
        kind, "min_iou", "a jump by half the width: a third of both boxes together is in common", base, jump(10.0),
        people, {0.2: 1, 0.32: 1, 0.34: 2},
    )  # fmt: skip
    case(
        kind, "max_distance_px", "a jump by 30 px", tracker(**FRAMES, cost="pixels"), jump(30.0), people,
        {29.0: 2, 31.0: 1},
    )  # fmt: skip
    case(
        kind, "max_distance_m", "a jump by 30 px, which are 1.5 m",
        tracker(**FRAMES, cost="metres", ground_planes=PLANE), jump(30.0), people, {1.4: 2, 1.6: 1},
    )  # fmt: skip
    case(
        kind, "min_score", "boxes of scores 0.9 and 0.7", base, said(score=[0.9, 0.7]), people,
        {None: 2, 0.7: 2, 0.8: 1, 0.95: 0},
    )  # fmt: skip
    case(kind, "class_id", "boxes of classes 1 and 2", base, said(class_id=[1, 2]), people, {None: 2, 2: 1, 3: 0})
    changing = jump(0.0)
    for frame in changing[10:]:
        frame.rows["class_id"] = 2
    case(kind, "across_classes", "a box changes its class", base, changing, people, {False: 2, True: 1})


shared("track", Sort)
shared("sort", Sort)
shared("bytetrack", ByteTrack)
shared("ocsort", OcSort)

case(
    "bytetrack", "high_score", "a box scores 0.9 and then 0.4, and overlaps its track by a third as it jumps",
    ByteTrack(**FRAMES, low_min_iou=0.5),
    [
        f._replace(rows=boxes_at([(100 + 10 * (n >= 10), 50)], score=0.9 if n < 10 else 0.4))
        for n, f in enumerate(jump(0.0))
    ],
    rows, {0.3: 20, 0.5: 10},
)  # fmt: skip
case(
    "bytetrack", "new_score", "beside a person with a high score, a box that always scores 0.55",
    ByteTrack(**FRAMES), second_scores([0.55] * 10), people, {0.5: 2, 0.6: 1},
)  # fmt: skip
case(
    "bytetrack", "low_min_iou", "a box scores 0.9 and then 0.4, and overlaps its track by a third as it jumps",
    ByteTrack(**FRAMES),
    [
        f._replace(rows=boxes_at([(100 + 10 * (n >= 10), 50)], score=0.9 if n < 10 else 0.4))
        for n, f in enumerate(jump(0.0))
    ],
    rows, {0.2: 20, 0.5: 10},
)  # fmt: skip


def fork() -> list[Frame]:
    """A person goes right; then one box lies ahead of the expected place, and one, which overlaps more, below."""
    frames = detections(lambda n: [(100 + 8 * n, 100)], 12)
    return [*frames, Frame(ns(1.2), 12, boxes_at([(207, 100), (196, 118)]))]


case(
    "ocsort", "inertia", fork.__doc__, OcSort(**FRAMES, direction_frames=2), fork(),
    lambda o: float(o[0][12].rows["y_px"][0]) < 85, {0.0: False, 1.0: True},
)  # fmt: skip


def bend() -> list[Frame]:
    """A person goes right for long and down for two frames; then one box lies to the right and one below."""
    places = [(100 + 8 * n, 100) for n in range(12)] + [(188, 108), (188, 116)]
    frames = detections(lambda n: [places[n]], 14)
    return [*frames, Frame(ns(1.4), 14, boxes_at([(196, 118), (188, 126)]))]


case(
    "ocsort", "direction_frames", bend.__doc__, OcSort(**FRAMES, inertia=9.0), bend(),
    lambda o: float(o[0][14].rows["x_px"][o[0][14].rows["track_id"] == 1][0]) > 182, {2: False, 12: True},
)  # fmt: skip


def behind() -> list[Frame]:
    """A person walks behind something, stops there, and comes back to the last observed place."""
    return detections(lambda n: [] if 20 <= n < 32 else [(50 + 6 * min(n, 20), 50)], 50)


case(
    "ocsort", "recover", behind.__doc__, OcSort(**FRAMES | {"max_age_frames": 30}), behind(), people,
    {False: 2, True: 1},
)  # fmt: skip


def off_the_line(outputs: Outputs) -> float:
    """How far the width of the box is from that of the one that is seen, where a person is found again."""
    return float(abs(outputs[0][-1].rows["w_px"][0] - 20))


def grown() -> list[Frame]:
    """A box grows, is missed for long, and is found again in the size that it had at first."""
    sizes = [20 + n for n in range(15)]
    frames = [Frame(ns(n / 10), n, boxes_at([(200, 200)], (size, 2 * size))) for n, size in enumerate(sizes)]
    return [
        *frames,
        *(Frame(ns(n / 10), n, boxes_at([(200, 200)] if n == 24 else [], (20, 40))) for n in range(15, 25)),
    ]


case(
    "ocsort", "reupdate", grown.__doc__, OcSort(**FRAMES | {"max_age_frames": 30}, min_iou=0.05), grown(),
    off_the_line, {False: "more", True: "least"},
)  # fmt: skip
