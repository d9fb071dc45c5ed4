"""The paper's protocol on WILDTRACK, from a folder: each view by itself, and all of them fused.

    .venv/bin/python tools/reproduce.py WILDTRACK -o OUT

The folder has ``viewN.det.txt`` (MOTChallenge rows in pixels), ``homography/viewN.txt`` (foot pixel to metres) and
``truth.txt`` (frame id x_m y_m). SORT runs on each view at the rate of the annotation, 2 Hz; predictions are of 9 steps
from 3. A view is scored on the people who stand in its picture, the scene on all of them. The scene is tracked in
metres, by the tracker ``ground`` in the place of SORT.

The paper's numbers can't be had from this: its SORT saw 10 frames a second, its detector was Mask R-CNN, and its gate,
its split of frames and its code for WILDTRACK are not published.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import mcaptrack
from mcaptrack import log
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.sources.ingest.labels.reading import read_homography
from mcaptrack.transforms import TRANSFORMS, Sample

RATE_HZ, HISTORY, STEPS = 2.0, 3, 9
PROTOCOL = {"rate_hz": RATE_HZ, "horizon_s": STEPS / RATE_HZ, "min_history": HISTORY}
WIDTH, HEIGHT = 1920, 1080
FUSED = "fused"
NOTE = (
    "not as in the paper: boxes and frames are those of the folder at 2 Hz, where the paper had Mask R-CNN, and SORT "
    "at 10 frames a second; its gate and its split are not published"
)

Member = tuple[str, list[Frame], list[Frame]]


def is_wildtrack(folder: Path) -> bool:
    """Whether a folder has views of WILDTRACK."""
    return (folder / "truth.txt").is_file() and any(folder.glob("view*.det.txt"))


def groups(folder: Path) -> dict[str, list[Member]]:
    """Name, truth and samples of each view, and of the scene, by what is scored together."""
    rows = np.loadtxt(folder / "truth.txt", ndmin=2)
    views = sorted(folder.glob("view*.det.txt"))
    alone = [_view(folder, path, rows) for path in views]
    return {"views": alone, "scene": [(FUSED, _truth(rows), list(_fused(folder, views)))]}


def _view(folder: Path, path: Path, rows: np.ndarray) -> Member:
    """A view by itself, on the people whose feet are in its picture."""
    name = path.name.removesuffix(".det.txt")
    plane = GroundPlane(read_homography(folder / "homography" / f"{name}.txt"), WIDTH, HEIGHT)
    x, y = plane.metres_to_pixels(rows[:, 2:4]).T
    inside = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)  # False where it is behind the camera
    tracks = [frame for (frame,) in TRANSFORMS["track"](ground_planes=((0, plane),))(_boxes(path, rows))]
    samples = Sample(rate_hz=RATE_HZ, start_ns=0, ground_planes=((0, plane),))(tracks)
    return name, _truth(rows, inside), [frame for (frame,) in samples]


def _numbers(rows: np.ndarray) -> np.ndarray:
    return np.arange(1, int(rows[:, 0].max()) + 1)


def _time_ns(frame: int) -> int:
    return round((frame - 1) / RATE_HZ * 1e9)


def _boxes(path: Path, truth: np.ndarray) -> Iterator[Frame]:
    rows = np.loadtxt(path, delimiter=",", ndmin=2)
    for frame in _numbers(truth).tolist():
        x, y, w, h, score = rows[rows[:, 0] == frame, 2:7].T
        kinds = np.ones(len(x), np.uint32)
        content = DETECTIONS.rows(x_px=x, y_px=y, w_px=w, h_px=h, score=score, class_id=kinds)
        yield Frame(_time_ns(frame), frame - 1, content)


def _truth(rows: np.ndarray, kept: np.ndarray | None = None) -> list[Frame]:
    out = []
    for frame in _numbers(rows).tolist():
        now = rows[(rows[:, 0] == frame) & (True if kept is None else kept)]
        sure, none = np.ones(len(now), bool), np.full(len(now), -1)
        content = TRACKS.rows(
            track_id=now[:, 1].astype(int), x_m=now[:, 2], y_m=now[:, 3], observed=sure, source_id=none
        )
        out.append(Frame(_time_ns(frame), frame - 1, content))
    return out


def _fused(folder: Path, views: list[Path]) -> Iterator[Frame]:
    """The samples of the scene, tracked in metres."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "scene.mcap"
        for number, view in enumerate(views, start=1):
            homography = folder / "homography" / view.name.replace(".det.txt", ".txt")
            given = {"fps": RATE_HZ, "camera": f"view{number}", "ground_plane": homography, "role": "detections"}
            mcaptrack.ingest(view, None if path.exists() else path, into=path if path.exists() else None, **given)
        mcaptrack.fuse(path)
        mcaptrack.run(path, camera="world", tables=False, events=False)
        with log.read(path) as opened:
            tracks = opened.frames("/world/tracks", TRACKS)
        yield from (frame for (frame,) in Sample(rate_hz=RATE_HZ, start_ns=0)(tracks))
