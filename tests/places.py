"""A place that several pinhole cameras see, where it is known who walks where; and logs of their boxes."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import mcaptrack
from mcaptrack.notices import collected
from mcaptrack.schema import Frame

PEOPLE, SECONDS = 5, 16
WIDTH, HEIGHT, FOCAL = 960, 540, 600.0
NS = 1_000_000_000


def walk(t_s: float) -> np.ndarray:
    """Where people are (PEOPLE, 2): each walks 1.2 m/s on a circle of its own, at least 1.6 m from the others."""
    angle = 1.2 / 2.0 * t_s + np.arange(PEOPLE) * 2 * np.pi / PEOPLE
    return np.stack([6 + 2 * np.cos(angle), 5 + 2 * np.sin(angle)], axis=-1)


@dataclass(frozen=True)
class Drawn:
    """A camera at ``eye``, which looks at the middle of the scene."""

    name: str
    eye: tuple[float, float, float]

    @property
    def matrix(self) -> np.ndarray:
        ahead = np.array([6.0, 5.0, 0.8]) - self.eye
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        turn = np.stack([right, np.cross(ahead, right), ahead])
        lens = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
        return lens @ np.column_stack([turn, -turn @ self.eye])

    def boxes(self, at: np.ndarray) -> np.ndarray:
        """Boxes (N, 4) around people of 1.7 m at (N, 2)."""
        ends = []
        for z in (0.0, 1.7):
            x, y, w = self.matrix @ np.stack([*at.T, np.full(len(at), z), np.ones(len(at))])
            ends.append(np.stack([x / w, y / w], axis=-1))
        foot, head = ends
        high = foot[:, 1] - head[:, 1]
        return np.column_stack([foot[:, 0] - 0.2 * high, foot[:, 1] - high, 0.4 * high, high])

    def homography(self) -> np.ndarray:
        """From pixels to metres on the ground."""
        found = np.linalg.inv(self.matrix[:, [0, 1, 3]])
        return found / found[2, 2]


CAMERAS = (
    Drawn("north", (6.0, 16.0, 3.0)),
    Drawn("east", (17.0, 4.0, 3.2)),
    Drawn("south", (5.0, -6.0, 2.8)),
    Drawn("west", (-5.0, 6.0, 3.1)),
)


def write_log(
    path: Path,
    cameras: Sequence[Drawn] = CAMERAS,
    *,
    rate_hz: Mapping[str, float] = {},
    late_s: Mapping[str, float] = {},
    moved_m: Mapping[str, float] = {},
    noise: float = 0.02,
    people: float = 1.0,
) -> Path:
    """A log with the detections of cameras. ``people`` is the share of them that is detected.

    ``late_s``: how late times are; ``moved_m``: how far its homography is off along the first axis.
    """
    rng = np.random.default_rng(7)
    for camera in cameras:
        shift = np.array([[1, 0, moved_m.get(camera.name, 0.0)], [0, 1, 0], [0, 0, 1]])
        plane, boxes = path.with_suffix(f".{camera.name}.plane.txt"), path.with_suffix(f".{camera.name}.txt")
        np.savetxt(plane, shift @ camera.homography(), delimiter=",")
        boxes.write_text(f"1,-1,{WIDTH - 20},{HEIGHT - 50},20,50,0.9,-1,-1,-1\n")  # for the size; replaced below
        where = {"into": path} if path.exists() else {"output": path}
        mcaptrack.ingest(boxes, fps=2, role="detections", camera=camera.name, ground_plane=plane, **where)
    with mcaptrack.open(path) as log:
        for camera in cameras:
            frames = []
            for number in range(round(SECONDS * rate_hz.get(camera.name, 2.0))):
                t_s = number / rate_hz.get(camera.name, 2.0)
                boxes = camera.boxes(walk(t_s))
                boxes = (boxes + rng.normal(0, noise, boxes.shape) * boxes[:, 3:])[rng.random(PEOPLE) < people]
                t_ns = round((t_s + late_s.get(camera.name, 0.0) + 1) * NS)
                frames.append(
                    mcaptrack.detections(boxes, [0.9] * len(boxes), [1] * len(boxes), t_ns, box_format="xywh")
                )
            log.write(f"/{camera.name}/detections", frames, replace=True)
    return path


def write_parts(folder: Path) -> list[Path]:
    """Two recordings of three cameras, one after the other, made of one."""
    whole = write_log(folder / "whole.mcap", CAMERAS[:3])
    paths = []
    for number, (begin_s, end_s) in enumerate([(0.0, 9.2), (9.2, 99.0)]):
        paths.append(Path(shutil.copy(whole, folder / f"{number}.mcap")))
        with mcaptrack.open(paths[-1]) as opened:
            for camera in CAMERAS[:3]:
                topic = f"/{camera.name}/detections"
                rows = opened.array("detections", topic)
                times = [t_ns for t_ns in np.unique(rows["t_ns"]) if begin_s <= t_ns / NS < end_s]
                opened.write(topic, [_boxes_of(rows[rows["t_ns"] == t_ns], int(t_ns)) for t_ns in times], replace=True)
    return paths


def _boxes_of(rows: np.ndarray, t_ns: int) -> Frame:
    boxes = np.stack([rows[name] for name in ("x_px", "y_px", "w_px", "h_px")], axis=-1)
    return mcaptrack.detections(boxes, rows["score"], rows["class_id"], t_ns, box_format="xywh")


def fused(path: Path, topic: str = "/world/detections") -> dict[int, np.ndarray]:
    with mcaptrack.open(path) as log:
        rows = log.array("sightings" if topic.endswith("sightings") else "detections", topic)
    return {int(t_ns): rows[rows["t_ns"] == t_ns] for t_ns in np.unique(rows["t_ns"])}


def errors(found: Mapping[int, np.ndarray]) -> tuple[np.ndarray, int, int]:
    """Distances of detections to the nearest person in m, the number of detections, and that of people there were."""
    away = []
    for t_ns, rows in found.items():
        at = walk(t_ns / NS - 1)
        xy = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
        away.append(np.linalg.norm(xy[:, None] - at, axis=-1).min(axis=1))
    return np.concatenate(away), sum(map(len, found.values())), PEOPLE * len(found)


def said(result: mcaptrack.RunResult, code: str) -> list[str]:
    return [notice.message for notice in result.warnings if notice.code == code]


def topics(path: Path) -> set[str]:
    return {channel.topic for channel in mcaptrack.info(path).channels}


def ran_copy(boxes: Path) -> tuple[Path, mcaptrack.RunResult]:
    """A copy of a log after a run, and its result."""
    path = Path(shutil.copy(boxes, boxes.with_name("ran.mcap")))
    with collected():
        return path, mcaptrack.run(path, tables=False)
