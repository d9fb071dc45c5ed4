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
from mcaptrack.sources.synthetic import Block, Pedestrian, Pose, SyntheticScene
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
    cameras: Mapping[str, SyntheticScene], folder: Path, progress: Callable[[str, int, int], None] = lambda *_: None
) -> tuple[dict[str, Footage], Path]:
    """Write a scene that several cameras see to a folder: the footage of each camera, and where people truly are.

    Returns the footage by camera, and a table of positions in metres.
    """
    footage = {name: draw(scene, folder / name, progress) for name, scene in cameras.items()}
    rows = ["t,id,class,x_m,y_m"]
    seen = {name: iter(scene.shots(draw=False)) for name, scene in cameras.items()}
    for shots in zip(*seen.values(), strict=True):
        places = {walker: at for shot in shots for walker, at in zip(shot.ids, shot.places_m.tolist(), strict=True)}
        rows += [f"{shots[0].seconds:.6f},{walker},person,{x:.4f},{y:.4f}" for walker, (x, y) in sorted(places.items())]
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


# The scenes of the demonstration (painted by ``synthetic``): who walks where, and which cameras look at it.


#: The objects on the square.
_KIOSK: Final = (Block(1.6, 14.9, 1.7, 2.3),)
_TREE_AT_M: Final = (-6.8, 16.0)


def demo_scene(seed: int = 2) -> SyntheticScene:
    """The scene of the demonstration: the four ways in which tracking fails in the paper, within 40 seconds.

    Two people cross; two meet, walk side by side and separate; one is occluded by a kiosk for a second; a tree sways;
    the camera shakes a little; others just walk. ``seed`` changes the noise and the shaking, but not the routes.
    """
    people = (
        # two who cross
        Pedestrian(1, ((0, -8.0, 9.0), (11, 7.5, 15.0)), (40, 30, 130)),
        Pedestrian(2, ((0, 7.5, 9.5), (11, -8.0, 15.0)), (140, 55, 20)),
        # two who meet, walk side by side for a while and separate
        Pedestrian(3, ((8, -8.0, 7.6), (14, -0.5, 12.1), (15.2, 0.5, 12.6), (21, 8.0, 17.0)), (25, 70, 25)),
        Pedestrian(4, ((8, -8.0, 17.0), (14, -0.3, 12.5), (15.2, 0.5, 12.1), (21, 8.0, 7.6)), (90, 25, 85)),
        # one who is occluded by the kiosk
        Pedestrian(5, ((16, 9.5, 17.0), (31, -9.5, 16.0)), (30, 30, 30)),
        # two who walk towards each other and pass
        Pedestrian(6, ((23, -7.5, 9.0), (35, 8.0, 9.6)), (235, 235, 240)),
        Pedestrian(7, ((23, 8.0, 9.3), (35, -7.5, 9.3)), (60, 50, 20)),
        # others
        Pedestrian(8, ((26, -8.5, 12.0), (40, 8.5, 13.0)), (45, 45, 95)),
        Pedestrian(9, ((27, -8.5, 16.0), (40, 8.0, 15.0)), (70, 25, 35)),
        Pedestrian(10, ((0, 3.0, 20.0), (9, 2.5, 12.5), (17, 8.0, 8.0)), (225, 240, 235)),
        Pedestrian(11, ((28, 8.5, 14.5), (40, -5.0, 10.0)), (35, 20, 60)),
    )
    return SyntheticScene(people, 40.0, blocks=_KIOSK, tree_at_m=_TREE_AT_M, shake_px=0.8, seed=seed)


def walkers_scene(seed: int = 1) -> SyntheticScene:
    """Ten people cross the square on random routes."""
    rng = np.random.default_rng([seed, 1])
    return _square(tuple(_random_walker(rng, number) for number in range(1, 11)), seed)


def crowd_scene(seed: int = 1) -> SyntheticScene:
    """Twenty people cross the square on random routes, most of them at the same time."""
    rng = np.random.default_rng([seed, 2])
    return _square(tuple(_random_walker(rng, number, latest_s=20.0) for number in range(1, 21)), seed)


def pairs_scene(seed: int = 1) -> SyntheticScene:
    """Three pairs of people walk side by side the whole way, 0.7 m apart."""
    rng = np.random.default_rng([seed, 3])
    people: list[Pedestrian] = []
    for pair in range(3):
        first = _random_walker(rng, 2 * pair + 1)
        # Beside the first one: across the picture, or in depth where they walk across it.
        (_, x0, y0), (_, x1, y1) = first.route
        along = np.array([x1 - x0, y1 - y0]) / np.hypot(x1 - x0, y1 - y0)
        x, y = 0.7 * np.array([-along[1], along[0]])
        beside = tuple((seconds, float(px + x), float(py + y)) for seconds, px, py in first.route)
        people += [first, Pedestrian(2 * pair + 2, beside, _random_colour(rng))]
    return _square(tuple(people), seed)


def standing_scene(seed: int = 1) -> SyntheticScene:
    """Six people come, stand still for 8 to 15 seconds, two of them together, and go on."""
    rng = np.random.default_rng([seed, 4])
    people: list[Pedestrian] = []
    for number in range(1, 7):
        walker = _random_walker(rng, number, latest_s=8.0)
        (start, x0, y0), (end, x1, y1) = walker.route
        share, stay = float(rng.uniform(0.3, 0.7)), float(rng.uniform(8.0, 15.0))
        x, y = x0 + share * (x1 - x0), y0 + share * (y1 - y0)
        if number == 2:  # joins the first one
            _, x, y = people[0].route[1]
            x, y = x + 0.9, y + 0.2
        arrival = start + share * (end - start)
        route = ((start, x0, y0), (arrival, x, y), (arrival + stay, x, y), (end + stay, x1, y1))
        people.append(Pedestrian(number, route, walker.colour))
    return _square(tuple(people), seed)


def _square(people: tuple[Pedestrian, ...], seed: int) -> SyntheticScene:
    """These people on the square of the demonstration."""
    return SyntheticScene(people, 40.0, blocks=_KIOSK, tree_at_m=_TREE_AT_M, shake_px=0.8, seed=seed)


def _random_walker(rng: np.random.Generator, number: int, latest_s: float = 26.0) -> Pedestrian:
    """A person who crosses the square on a straight line at 0.9 to 1.6 m/s, from one side to the other."""
    side = float(rng.choice([-1.0, 1.0]))
    start = np.array([side * 8.5, rng.uniform(8.0, 17.0)])
    end = np.array([-side * 8.5, rng.uniform(8.0, 17.0)])
    seconds = float(np.hypot(*(end - start)) / rng.uniform(0.9, 1.6))
    begin = float(rng.uniform(0.0, latest_s))
    route = ((begin, float(start[0]), float(start[1])), (begin + seconds, float(end[0]), float(end[1])))
    return Pedestrian(number, route, _random_colour(rng))


def _random_colour(rng: np.random.Generator) -> tuple[int, int, int]:
    """A colour of clothes: dark or bright, unlike the paving."""
    low, high = (15, 100) if rng.random() < 0.75 else (200, 245)
    b, g, r = rng.integers(low, high, 3).tolist()
    return b, g, r


#: The duration of a scene that several cameras see.
_PLACE_S: Final = 36.0


def three_cameras(seed: int = 1) -> dict[str, SyntheticScene]:
    """Eight people cross a square that three cameras look at from three sides: the scene of each camera, by its name.

    Each camera sees a part of the square, so that people go out of one picture and come into the next.
    """
    rng = np.random.default_rng([seed, 5])
    people = []
    for number in range(1, 9):
        side = 1.0 if number % 2 else -1.0
        start, end = (side * 13.0, rng.uniform(8.0, 18.0)), (-side * 13.0, rng.uniform(8.0, 18.0))
        seconds = float(np.hypot(end[0] - start[0], end[1] - start[1]) / rng.uniform(1.1, 1.7))
        begin = float(rng.uniform(0.0, _PLACE_S - seconds))
        route = ((begin, start[0], float(start[1])), (begin + seconds, end[0], float(end[1])))
        people.append(Pedestrian(number, route, _random_colour(rng)))
    poses = {"left": Pose(-12.0, 2.0, 30.0), "right": Pose(12.0, 2.0, -30.0), "back": Pose(0.0, 25.0, 180.0)}
    return {
        name: SyntheticScene(
            tuple(people),
            _PLACE_S,
            fps=10,
            width_px=640,
            height_px=360,
            mast_m=6.0,
            tilt_deg=24.0,
            seed=seed + n,
            pose=pose,
        )
        for n, (name, pose) in enumerate(poses.items())
    }


#: The scenes that several cameras see, by name: for each a function of a seed that gives the scene of each camera.
PLACES: Final[Mapping[str, Callable[[int], dict[str, SyntheticScene]]]] = {"three-cameras": three_cameras}
#: The scenes of the demonstration by name: the default one and others, most of them harder. Each takes a seed.
SCENES: Final[Mapping[str, Callable[[int], SyntheticScene]]] = {
    "square": demo_scene,
    "walkers": walkers_scene,
    "crowd": crowd_scene,
    "side-by-side": pairs_scene,
    "standing": standing_scene,
}
