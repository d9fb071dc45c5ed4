"""Our trackers against those of Roboflow's `trackers` package, on walkers in crowds of several sizes.

Needs `pip install trackers` (Apache-2.0) in the environment. Both get the same boxes in the form each of them reads and
give tracks in the form each of them writes, with the same age, hits and overlap. Prints frames per second and ratios,
the best of several rounds in turn.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence

import numpy as np

from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.transforms import ByteTrack, OcSort, Sort

# This file's folder is where Python looks first, and this file is named like the peer.
sys.path.pop(0)

FPS, HITS, MIN_IOU = 30, 3, 0.3


def crowd(people: int, frames: int, seed: int = 7) -> list[np.ndarray]:
    """Boxes (N, 5) of every frame: left, top, width, height, score. A tenth is missed and a tenth is of nobody."""
    rng = np.random.default_rng(seed)
    side = 250.0 * np.sqrt(people)
    place, speed = rng.uniform(0, side, (people, 2)), rng.normal(0, 2.0, (people, 2))
    size = rng.uniform(30, 50, people)
    out = []
    for _ in range(frames):
        place += speed
        speed = np.where((place < 0) | (place > side), -speed, speed)
        seen = rng.random(people) > 0.1
        centre = np.concatenate([place[seen], rng.uniform(0, side, (rng.binomial(people, 0.1), 2))])
        width = np.resize(size[seen], len(centre)) if seen.any() else np.full(len(centre), 40.0)
        box = np.stack([width, 2.2 * width], axis=-1) * rng.normal(1, 0.03, (len(centre), 2))
        left = centre - box / 2 + rng.normal(0, 1.0, centre.shape)
        out.append(np.concatenate([left, box, rng.uniform(0.3, 1.0, (len(centre), 1))], axis=1))
    return out


def ours(boxes: Sequence[np.ndarray], make: Callable[[], object]) -> Callable[[], int]:
    frames = []
    for number, part in enumerate(boxes):
        x, y, w, h, score = part.T
        rows = DETECTIONS.rows(x_px=x, y_px=y, w_px=w, h_px=h, score=score, class_id=np.ones(len(x), np.uint32))
        frames.append(Frame(round(number / FPS * NS_PER_S), number, rows))

    def run() -> int:
        return sum(len(frame.rows) for (frame,) in make()(frames))

    return run


def theirs(boxes: Sequence[np.ndarray], make: Callable[[], object]) -> Callable[[], int]:
    import supervision

    frames = [
        supervision.Detections(
            xyxy=np.concatenate([part[:, :2], part[:, :2] + part[:, 2:4]], axis=1),
            confidence=part[:, 4],
            class_id=np.zeros(len(part), int),
        )
        for part in boxes
    ]

    def run() -> int:
        tracker = make()
        return sum(int((tracker.update(detections).tracker_id >= 0).sum()) for detections in frames)

    return run


def timed(call: Callable[[], int]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def pairs(age: int) -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    import trackers

    mine = {"max_age_frames": age, "min_hits_frames": HITS, "min_iou": MIN_IOU}
    ocsort = {"lost_track_buffer": age, "minimum_consecutive_frames": HITS}
    peer = ocsort | {"minimum_iou_threshold": MIN_IOU}
    return {
        "sort": (lambda: Sort(**mine), lambda: trackers.SORTTracker(**peer)),
        "bytetrack": (lambda: ByteTrack(**mine), lambda: trackers.ByteTrackTracker(**peer)),
        "ocsort": (lambda: OcSort(**mine), lambda: trackers.OCSORTTracker(**ocsort)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--people", type=int, nargs="+", default=[6, 20, 50, 100])
    parser.add_argument("--age", type=int, default=1, help="frames until a track is dropped; SORT's own is 1")
    parser.add_argument("--trackers", nargs="+", default=["sort", "bytetrack", "ocsort"])
    options = parser.parse_args()
    for name, (mine, peer) in pairs(options.age).items():
        if name not in options.trackers:
            continue
        for people in options.people:
            boxes = crowd(people, max(60, 4000 // people))
            a, b = ours(boxes, mine), theirs(boxes, peer)
            rows = a(), b()  # both warm
            times = [(timed(a), timed(b)) for _ in range(options.rounds)]
            fast, slow = min(t for t, _ in times), min(t for _, t in times)
            print(
                f"{name:>10} {people:4d} people: {len(boxes) / fast:8.0f} frames/s, "
                f"trackers {len(boxes) / slow:7.0f}, {slow / fast:5.1f} times as fast (rows {rows[0]}, {rows[1]})"
            )


if __name__ == "__main__":
    main()
