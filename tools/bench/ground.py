"""The ground tracker and re-tracking against a plain tracker: a Kalman filter object for each track.

Prints frames a second of CPU time on drawn boxes, and the ratio; the best of several rounds in turn.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from scipy.optimize import linear_sum_assignment

from mcaptrack.schema import DETECTIONS, Frame
from mcaptrack.transforms import GroundTracker, Retrack, Sample
from mcaptrack.transforms.to_video_rate import to_video_rate

NAMES = ((1, "pedestrian"), (2, "bicycle"), (3, "car"), (4, "truck"))


def traffic(objects: int, count: int, seed: int = 3) -> list[Frame]:
    """Frames of boxes at 10 Hz: objects of four classes that go straight on; a tenth is missed."""
    rng = np.random.default_rng(seed)
    class_id = rng.integers(1, 5, objects)
    place, speed = rng.uniform(-60, 60, (objects, 2)), rng.normal(0, 1, (objects, 2)) * np.minimum(class_id, 3)[:, None]
    frames = []
    for number in range(count):
        place = (place + speed / 10 + 60) % 120 - 60
        seen = rng.random(objects) > 0.1
        x_m, y_m = (place[seen] + rng.normal(0, 0.15, (int(seen.sum()), 2))).T
        boxes = {"z_m": 1.0, "length_m": 4.0, "width_m": 1.8, "height_m": 1.6, "heading_rad": 0.3, "score": 0.7}
        columns = {name: np.full(len(x_m), value) for name, value in boxes.items()}
        rows = DETECTIONS.rows(x_m=x_m, y_m=y_m, class_id=class_id[seen], **columns)
        frames.append(Frame(number * 100_000_000, number, rows))
    return frames


def ours(frames: list[Frame]) -> dict[str, float]:
    """Seconds of CPU time of each stage."""
    out: dict[str, float] = {}

    def stage(name: str, make: Callable[[], list]) -> list:
        start = time.process_time()
        made = make()
        out[name] = time.process_time() - start
        return made

    tracks = stage("track", lambda: [frame for (frame,) in GroundTracker(class_names=NAMES)(frames)])
    samples = stage("sample", lambda: [frame for (frame,) in Sample()(tracks)])
    offline = stage("retrack", lambda: [outputs[0] for outputs in Retrack(class_names=NAMES)(samples)])
    stage("full", lambda: list(to_video_rate(tracks, offline, ())))
    return out


def plain(frames: list[Frame]) -> None:
    """Constant velocity, 4 x 4 matrices, a class at a time."""
    move, noise = np.eye(4), np.diag([0.05, 0.05, 1.5, 1.5]) / 10
    move[0, 2] = move[1, 3] = 0.1
    h = np.eye(2, 4)
    tracks: list[dict] = []
    for number, frame in enumerate(frames):
        for track in tracks:
            track["x"], track["p"] = move @ track["x"], move @ track["p"] @ move.T + noise
        for one in np.unique(frame.rows["class_id"]).tolist():
            z = np.stack([frame.rows["x_m"], frame.rows["y_m"]], axis=-1)[frame.rows["class_id"] == one]
            own = [track for track in tracks if track["class"] == one]
            cost = np.array([[np.hypot(*(track["x"][:2] - at)) for at in z] for track in own]).reshape(len(own), len(z))
            pairs = [(i, j) for i, j in zip(*linear_sum_assignment(cost), strict=True) if cost[i, j] < 2.5]
            for i, j in pairs:
                p = own[i]["p"]
                gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + 0.06 * np.eye(2))
                own[i]["x"] = own[i]["x"] + gain @ (z[j] - own[i]["x"][:2])
                own[i]["p"], own[i]["seen"] = (np.eye(4) - gain @ h) @ p, number
            for j in set(range(len(z))) - {j for _, j in pairs}:
                start = {"x": np.r_[z[j], 0, 0], "p": np.diag([0.1, 0.1, 9, 9]), "class": one, "seen": number}
                tracks.append(start)
        tracks = [track for track in tracks if number - track["seen"] <= 8]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--objects", type=int, default=60)
    parser.add_argument("--rounds", type=int, default=1)
    options = parser.parse_args()
    frames = traffic(options.objects, options.frames)
    few = frames[: max(50, options.frames // 20)]
    ours(few)
    best: dict[str, float] = {}
    for _ in range(options.rounds):
        seconds = {name: one / len(frames) for name, one in ours(frames).items()}
        start = time.process_time()
        plain(few)
        seconds["plain"] = (time.process_time() - start) / len(few)
        best = {name: min(one, best.get(name, one)) for name, one in seconds.items()}
    slow = best.pop("plain")
    print("ms a frame: " + ", ".join(f"{name} {1000 * one:.3f}" for name, one in best.items()))
    fast, both = sum(best.values()), best["track"] + best["retrack"]
    print(f"track and retrack: {1 / both:.0f} frames/s; track to full: {1 / fast:.0f} frames/s")
    print(f"plain tracker alone: {1 / slow:.0f} frames/s; all of ours is {slow / fast:.1f} times as fast")


if __name__ == "__main__":
    main()
