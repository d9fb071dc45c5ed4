"""Synthetic scenes with known ground truth: people who walk across a square, seen by a camera on a mast.

They contain what makes tracking hard: people who cross paths, meet and separate, or are occluded; a swaying tree; a
shaking camera. Used by the demonstration, by tests, and for footage without a licence.

Letters: N people in a picture. Ground: x to the right, y away from the camera, in metres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Floats, Image
from mcaptrack.geometry.plane import GroundPlane

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
