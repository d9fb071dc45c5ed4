"""The demonstration: a synthetic scene with known ground truth, rendered to a video file."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from mcaptrack.files import make_folder, publish, writing
from mcaptrack.geometry.arrays import Floats, Image
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.notices import Progress
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


# Synthetic scenes with known ground truth: people who walk across a square, seen by a camera on a mast.
#
# They contain what makes tracking hard: people who cross paths, meet and separate, or are occluded; a swaying tree;
# a shaking camera. Used by the demonstration, by tests, and for footage without a licence.
#
# Letters: N people in a picture. Ground: x to the right, y away from the camera, in metres.


_PERSON_M: Final = 1.75
_STRIDE_HZ: Final = 1.8
#: People who are nearer to the plane of the camera, or behind it, are not drawn.
_NEAREST_M: Final = 0.5


@dataclass(frozen=True)
class Pedestrian:
    """A person who walks along ``route``, points of (seconds, x_m, y_m); visible only between its ends."""

    id: int
    route: tuple[tuple[float, float, float], ...]
    colour: tuple[int, int, int] = (90, 60, 40)

    def at(self, seconds: float) -> tuple[float, float] | None:
        """The position in metres; None before and after the route."""
        times, xs, ys = zip(*self.route, strict=True)
        if not times[0] <= seconds <= times[-1]:
            return None
        return float(np.interp(seconds, times, xs)), float(np.interp(seconds, times, ys))


class Block(NamedTuple):
    """An occluder on the ground: its centre, width and height in metres."""

    x_m: float
    y_m: float
    width_m: float
    height_m: float


class Pose(NamedTuple):
    """A camera's place on the ground, and the direction that it looks in, in degrees clockwise from the second axis."""

    x_m: float = 0.0
    y_m: float = 0.0
    bearing_deg: float = 0.0

    def seen(self, points_m: Floats) -> Floats:
        """Points (N, 2 or 3) as the camera sees them: to the right of it, ahead of it, and above the ground."""
        turn = np.deg2rad(self.bearing_deg)
        x, y = points_m[:, 0] - self.x_m, points_m[:, 1] - self.y_m
        right, ahead = x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)
        return np.column_stack([right, ahead, points_m[:, 2:]])

    def placed(self, points_m: Floats) -> Floats:
        """The inverse of ``seen`` for points (N, 2)."""
        turn = np.deg2rad(self.bearing_deg)
        right, ahead = points_m.T
        x, y = right * np.cos(turn) + ahead * np.sin(turn), -right * np.sin(turn) + ahead * np.cos(turn)
        return np.column_stack([x + self.x_m, y + self.y_m])


class SyntheticFrame(NamedTuple):
    """One picture, BGR (height, width, 3), and its people: ids, boxes (N, 4) in px, positions (N, 2) in m."""

    seconds: float
    image: Image
    ids: list[int]
    boxes: Floats
    places_m: Floats


@dataclass(frozen=True)
class SyntheticScene:
    """A square with people, seen from ``mast_m`` above the ground, looking down by ``tilt_deg``."""

    people: tuple[Pedestrian, ...]
    seconds: float
    fps: int = 25
    width_px: int = 960
    height_px: int = 540
    blocks: tuple[Block, ...] = ()
    tree_at_m: tuple[float, float] | None = None
    shake_px: float = 0.0
    noise: float = 2.0
    contrast: float = 1.0  # of the paving
    mast_m: float = 7.0
    tilt_deg: float = 27.0
    seed: int = 1
    pose: Pose | None = None  # of the camera; None: at the origin, looking along the second axis

    def _depth_m(self, x_m: float, y_m: float) -> float:
        """The distance of a point ahead of the camera."""
        return y_m if self.pose is None else float(self.pose.seen(np.array([[x_m, y_m]]))[0, 1])

    def _project(self, points_m: Floats) -> Floats:
        """Points (N, 3) in metres -> pixels (N, 2)."""
        points_m = points_m if self.pose is None else self.pose.seen(points_m)
        focal = 0.95 * self.width_px
        tilt = np.deg2rad(self.tilt_deg)
        right = points_m[:, 0]
        forward = points_m[:, 1] * np.cos(tilt) + (self.mast_m - points_m[:, 2]) * np.sin(tilt)
        down = (self.mast_m - points_m[:, 2]) * np.cos(tilt) - points_m[:, 1] * np.sin(tilt)
        return np.stack(
            [self.width_px / 2 + focal * right / forward, self.height_px / 2 + focal * down / forward], axis=-1
        )

    def ground_plane(self) -> GroundPlane:
        """The plane of the steady camera, from its geometry."""
        corners_m = np.array([[-5.0, 6.0, 0], [5.0, 6.0, 0], [5.0, 20.0, 0], [-5.0, 20.0, 0]])
        if self.pose is not None:
            corners_m[:, :2] = self.pose.placed(corners_m[:, :2])
        rows = []
        for (x, y), (u, v) in zip(corners_m[:, :2], self._project(corners_m), strict=True):
            rows.append([u, v, 1, 0, 0, 0, -x * u, -x * v, -x])
            rows.append([0, 0, 0, u, v, 1, -y * u, -y * v, -y])
        homography = np.linalg.svd(np.array(rows))[2][-1]
        return GroundPlane(tuple((homography / homography[-1]).tolist()), self.width_px, self.height_px)

    def shots(self, draw: bool = True) -> Iterator[SyntheticFrame]:
        """All pictures in order. The same scene gives the same pixels every time.

        Without ``draw`` the pictures are empty, with the same ground truth.
        """
        import cv2

        rng = np.random.default_rng(self.seed)
        ground = self._ground(rng)
        grain = rng.normal(0, self.noise, (self.height_px + 64, self.width_px + 64, 1)).astype(np.float32)
        leaves = rng.uniform(-1, 1, (60, 4))
        shake = np.zeros(3)
        for number in range(round(self.seconds * self.fps)):
            now = number / self.fps
            image = ground.copy() if draw else ground
            people = [(walker, walker.at(now)) for walker in self.people]
            near = [(walker, place) for walker, place in people if place and self._depth_m(*place) > _NEAREST_M]
            boxes = {walker.id: self._figure(image, walker, place, now, draw=False) for walker, place in near}
            # From far to near, so that nearer objects occlude those behind them.
            acts: list[tuple[float, Callable[[], object]]] = [
                (self._depth_m(*place), partial(self._figure, image, person, place, now, draw=True))
                for person, place in near
            ]
            acts += [(self._depth_m(block.x_m, block.y_m), partial(self._block, image, block)) for block in self.blocks]
            for _, act in sorted(acts, key=lambda pair: -pair[0]) if draw else ():
                act()
            if self.tree_at_m and draw:
                self._tree(image, leaves, now)
            shake = 0.8 * shake + 0.6 * rng.normal(size=3)  # one unit of spread
            moved = np.eye(2, 3)
            if self.shake_px:
                turn = np.deg2rad(0.02) * self.shake_px * shake[2]
                moved = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0]])
                middle = np.array([self.width_px / 2, self.height_px / 2])
                moved[:, 2] = middle - moved[:, :2] @ middle + self.shake_px * shake[:2]
                size = (self.width_px, self.height_px)
                if draw:
                    image = np.asarray(cv2.warpAffine(image, moved, size, borderMode=cv2.BORDER_REFLECT), np.uint8)
            x, y = rng.integers(0, 64, 2)
            if draw:
                noisy = image + grain[y : y + self.height_px, x : x + self.width_px]
                image = np.clip(noisy, 0, 255).astype(np.uint8)
            ids = [walker.id for walker, _ in near]
            xywh = np.array([boxes[person] for person in ids]).reshape(-1, 4)
            corners = xywh[:, :2] + xywh[:, 2:] / 2
            xywh[:, :2] = corners @ moved[:, :2].T + moved[:, 2] - xywh[:, 2:] / 2
            inside = (xywh[:, 0] > -0.3 * xywh[:, 2]) & (xywh[:, 0] + 0.7 * xywh[:, 2] < self.width_px)
            inside &= (xywh[:, 1] > -0.3 * xywh[:, 3]) & (xywh[:, 1] + 0.7 * xywh[:, 3] < self.height_px)
            places = np.array([place for _, place in near]).reshape(-1, 2)
            yield SyntheticFrame(
                now, image, [person for person, ok in zip(ids, inside, strict=True) if ok], xywh[inside], places[inside]
            )

    def _ground(self, rng: np.random.Generator) -> Image:
        """Paving seen at an angle, uneven in brightness."""
        import cv2

        coarse = rng.uniform(-1, 1, (self.height_px // 24 + 2, self.width_px // 24 + 2)).astype(np.float32)
        fine = rng.uniform(-1, 1, (self.height_px, self.width_px)).astype(np.float32)
        size = (self.width_px, self.height_px)
        rough = 14 * np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)) + 9 * fine
        shade = 150 + self.contrast * rough
        tinted = np.repeat(shade[:, :, None], 3, axis=2) + np.array([-6, 0, 4])
        image: Image = np.clip(tinted, 0, 255).astype(np.uint8)
        if self.pose is not None:
            self._lines(image, self.pose)
            return image
        lines = [((x, 2.0), (x, 40.0)) for x in np.arange(-20, 21, 2.0)] + [
            ((-20.0, y), (20.0, y)) for y in np.arange(2, 40, 2.0)
        ]
        for (x0, y0), (x1, y1) in lines:
            start, end = self._project(np.array([[x0, y0, 0.0], [x1, y1, 0.0]])).round().astype(int).tolist()
            cv2.line(image, start, end, (128, 134, 136), 1, cv2.LINE_AA)
        return image

    def _lines(self, image: Image, pose: Pose) -> None:
        """Draw the lines of the paving that are before a camera that stands anywhere."""
        import cv2

        along = np.arange(-40.0, 60.5, 0.5)
        for at in np.arange(-40, 61, 2.0).tolist():
            for line in (
                np.column_stack([along, np.full_like(along, at)]),
                np.column_stack([np.full_like(along, at), along]),
            ):
                points = np.column_stack([line, np.zeros(len(line))])
                pixels = self._project(points[pose.seen(points)[:, 1] > 2.0]).round().astype(np.int32)
                if len(pixels) > 1:
                    cv2.polylines(image, [pixels[:, None]], False, (128, 134, 136), 1, cv2.LINE_AA)

    def _figure(
        self, image: Image, walker: Pedestrian, place: tuple[float, float], now: float, draw: bool
    ) -> list[float]:
        """Draw a person, or only return the box."""
        import cv2

        foot, head = self._project(np.array([[*place, 0.0], [*place, _PERSON_M]]))
        tall = float(foot[1] - head[1])
        before, after = walker.at(now - 0.05) or place, walker.at(now + 0.05) or place
        speed = float(np.hypot(after[0] - before[0], after[1] - before[1])) / 0.1
        swing = np.sin(2 * np.pi * _STRIDE_HZ * now + walker.id) * 0.13 * tall * min(speed / 1.2, 1.0)
        x, y = float(foot[0]), float(foot[1])
        hip, shoulder, skull = y - 0.46 * tall, y - 0.80 * tall, 0.075 * tall
        half = 0.13 * tall
        if draw:
            light = [int(c * 0.75) for c in walker.colour]
            dark = [int(min(c, 80) * 0.5) for c in walker.colour]
            thick = max(2, round(0.10 * tall))
            for side in (-1, 1):
                knee = (round(x + side * swing * 0.5), round((hip + y) / 2))
                end = (round(x + side * swing), round(y - thick / 2))
                cv2.line(image, (round(x), round(hip)), knee, dark, thick, cv2.LINE_AA)
                cv2.line(image, knee, end, dark, thick, cv2.LINE_AA)
            middle = (round(x), round((hip + shoulder) / 2))
            cv2.ellipse(image, middle, (round(half), round(0.21 * tall)), 0, 0, 360, walker.colour, -1, cv2.LINE_AA)
            for stripe in (np.linspace(-0.12, 0.12, 4) * tall).tolist():
                wide, row = round(0.8 * half), middle[1] + round(stripe)
                cv2.line(image, (middle[0] - wide, row), (middle[0] + wide, row), light, max(1, round(0.015 * tall)))
            face = (round(x), round(y - tall + skull))
            cv2.circle(image, face, round(skull), (110, 150, 215), -1, cv2.LINE_AA)
            cv2.ellipse(image, face, (round(skull), round(skull)), 0, 160, 380, (25, 30, 38), -1, cv2.LINE_AA)
        reach = max(half, abs(float(swing)) + 0.05 * tall)
        return [x - reach, y - tall, 2 * reach, tall]

    def _block(self, image: Image, block: Block) -> None:
        import cv2

        half = block.width_m / 2
        corners = [[block.x_m - half, block.y_m, block.height_m], [block.x_m + half, block.y_m, 0.0]]
        (x0, y0), (x1, y1) = self._project(np.array(corners)).round().astype(int).tolist()
        cv2.rectangle(image, (x0, y0), (x1, y1), (96, 120, 150), -1)
        for row in range(y0 + 8, y1, 9):
            cv2.line(image, (x0, row), (x1, row), (84, 104, 132), 1)
        cv2.rectangle(image, (x0, y0), (x1, y1), (60, 72, 90), 2)

    def _tree(self, image: Image, leaves: Floats, now: float) -> None:
        import cv2

        assert self.tree_at_m is not None
        foot, crown = self._project(np.array([[*self.tree_at_m, 0.0], [*self.tree_at_m, 3.6]]))
        size = float(foot[1] - crown[1]) / 3.6
        gust = max(0.0, np.sin(0.7 * now) * np.sin(0.29 * now + 1)) ** 0.5  # gusts of wind, with calm between
        cv2.line(image, _point(foot), _point(crown), (40, 62, 88), max(3, round(0.22 * size)), cv2.LINE_AA)
        for dx, dy, phase, shade in leaves.tolist():
            sway = gust * 0.45 * size * np.sin(4.0 * now + 3 * phase)
            at = crown + np.array([1.1 * dx * size + sway, 0.9 * dy * size + 0.3 * sway])
            green = (50 + 20 * shade, 105 + 45 * shade, 60 + 25 * shade)
            cv2.circle(image, _point(at), max(3, round(0.24 * size)), green, -1, cv2.LINE_AA)


def _point(xy: Floats) -> Sequence[int]:
    return [round(float(xy[0])), round(float(xy[1]))]


def draw_place(
    cameras: Mapping[str, SyntheticScene], folder: Path, progress: Progress = lambda *_: None
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
    with writing(folder):
        _write_text(folder / POSITIONS, "\n".join(rows) + "\n")
    return footage, folder / POSITIONS


def draw(
    scene: SyntheticScene,
    folder: Path,
    progress: Progress = lambda *_: None,
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

    make_folder(folder)
    with writing(folder):
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


# The scenes of the demonstration: who walks where, and which cameras look at it.


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
    return _square(people, seed)


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
    scene = SyntheticScene(tuple(people), _PLACE_S, fps=10, width_px=640, height_px=360, mast_m=6.0, tilt_deg=24.0)
    return {name: replace(scene, seed=seed + n, pose=pose) for n, (name, pose) in enumerate(poses.items())}


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
