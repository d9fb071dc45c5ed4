"""The demonstration: a synthetic scene with known ground truth, rendered to a video file."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator, Sequence
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

    try:
        folder.mkdir(parents=True, exist_ok=True)
        if video:
            write_mp4(footage.video, images(), scene.fps)
        else:
            deque(images(), maxlen=0)
        _write_text(footage.ground_truth, "\n".join(lines) + "\n")
        rows = np.array(scene.ground_plane().homography).reshape(3, 3).tolist()
        _write_text(footage.ground_plane, "\n".join(",".join(f"{value:.17g}" for value in row) for row in rows) + "\n")
    except OSError as error:
        raise McaptrackError(f"{folder} can't be written to: {error.strerror or error}") from error
    return footage


def _write_text(path: Path, text: str) -> None:
    with publish(path) as part:
        part.write_text(text, encoding="utf-8")
