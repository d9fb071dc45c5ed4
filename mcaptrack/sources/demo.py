"""The demonstration: a synthetic scene with known ground truth, rendered to a video file."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.files import publish
from mcaptrack.geometry.arrays import Image
from mcaptrack.sources.synthetic import SyntheticScene
from mcaptrack.sources.video import write_mp4

#: The files that the demonstration writes.
VIDEO: Final = "demo.mp4"
TRUTH: Final = "truth.txt"
PLANE: Final = "ground_plane.txt"
#: The file with the true positions of people in a scene that several cameras see.
POSITIONS: Final = "positions.csv"


#: Scores of every scene and seed, written by tools/bench/demo.py.
SCORES: Final = "demo_scores.json"


def read_scores() -> dict[str, Any]:
    """Scores of SORT and of re-tracking for each scene and seed, matched within 1 m at the sampling rate.

    ``{"version": ..., "seeds": [...], "scenes": {scene: {"SORT" | "re-tracked": {score: [a value a seed]}}}}``
    """
    scores: dict[str, Any] = json.loads(resources.files("mcaptrack.sources").joinpath(SCORES).read_text("utf-8"))
    return scores


def mean_and_range(values: Sequence[float], scale: float = 1.0, digits: int = 1) -> str:
    """The mean of values times ``scale``, and the lowest and highest in brackets."""
    low, mean, high = (scale * value for value in (min(values), sum(values) / len(values), max(values)))
    return f"{mean:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


@dataclass(frozen=True)
class Footage:
    """A synthetic scene on disk: the video, its ground truth boxes (MOTChallenge) and its ground plane (3x3)."""

    video: Path
    ground_truth: Path
    ground_plane: Path


def draw_place(
    cameras: Mapping[str, SyntheticScene],
    folder: Path,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> tuple[dict[str, Footage], Path]:
    """Write a scene that several cameras see to a folder: the footage of each camera, and where people truly are.

    Returns the footage by camera, and a table of positions in metres.
    """
    footage = {name: draw(scene, folder / name, progress) for name, scene in cameras.items()}
    rows = ["t,id,class,x_m,y_m"]
    seen = {name: iter(scene.shots(draw=False)) for name, scene in cameras.items()}
    for shots in zip(*seen.values(), strict=True):
        found = {one: at for shot in shots for one, at in zip(shot.ids, shot.places_m.tolist(), strict=True)}
        rows += [f"{shots[0].seconds:.6f},{one},person,{x:.4f},{y:.4f}" for one, (x, y) in sorted(found.items())]
    with writing_to(folder):
        _write_text(folder / POSITIONS, "\n".join(rows) + "\n")
    return footage, folder / POSITIONS


@contextmanager
def writing_to(folder: Path) -> Iterator[None]:
    """Report errors of writing to a folder. Raises McaptrackError."""
    try:
        yield
    except OSError as error:
        raise McaptrackError(f"{folder} can't be written to: {error.strerror or error}") from error


def draw(
    scene: SyntheticScene,
    folder: Path,
    progress: Callable[[str, int, int], None] = lambda *_: None,
    *,
    video: bool = True,
) -> Footage:
    """Write a synthetic scene to a folder: video, ground truth and ground plane.

    Without ``video`` only ground truth and ground plane are written.
    """
    footage = Footage(folder / VIDEO, folder / TRUTH, folder / PLANE)
    lines: list[str] = []
    total = round(scene.seconds * scene.fps)

    def images() -> Iterator[Image]:
        for number, shot in enumerate(scene.shots(video), start=1):
            for track_id, box in zip(shot.ids, shot.boxes.tolist(), strict=True):
                lines.append(",".join([str(number), str(track_id), *(f"{value:.2f}" for value in box), "1,1,1"]))
            progress("draw", number, total)
            yield shot.image

    with writing_to(folder):
        folder.mkdir(parents=True, exist_ok=True)
        if video:
            write_mp4(footage.video, images(), scene.fps)
        else:
            deque(images(), maxlen=0)
        _write_text(footage.ground_truth, "\n".join(lines) + "\n")
        rows = np.array(scene.ground_plane().homography).reshape(3, 3).tolist()
        _write_text(footage.ground_plane, "\n".join(",".join(f"{value:.17g}" for value in row) for row in rows) + "\n")
    return footage


def _write_text(path: Path, text: str) -> None:
    with publish(path) as part:
        part.write_text(text, encoding="utf-8")
