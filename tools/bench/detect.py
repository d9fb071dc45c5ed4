"""How long each motion detector takes for its dearest picture, in times of the median picture, over drawn scenes.

    .venv/bin/python tools/bench/detect.py [--detector NAME] [--scene NAME]

Work per picture is bounded by its pixels, whatever moves. Times are processor time of one thread. `learn` is what
`median` takes between its two passes, once in ten minutes of video; it is no picture's.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import cv2
import numpy as np

from mcaptrack.schema import Frame
from mcaptrack.transforms import KnnDetector, MedianDetector

Paint = Callable[[Any, int, Any], None]
PICTURES = 120
FPS = 25


def person(image: Any, x: float, foot: float, tall: float, colour: tuple[int, int, int] = (40, 60, 150)) -> None:
    """Draw a body and a head."""
    wide = 0.32 * tall
    body = (round(x - wide / 2), round(foot - 0.85 * tall)), (round(x + wide / 2), round(foot) - 1)
    cv2.rectangle(image, *body, colour, -1)
    cv2.circle(image, (round(x), round(foot - 0.89 * tall)), max(round(0.11 * tall), 1), colour, -1)


def walkers(image: Any, number: int, tall: float, count: int = 10, top: float = 0.45) -> None:
    """People of one height on their ways."""
    height, width = image.shape[:2]
    for k in range(count):
        x = (k * 0.618 * width + (0.04 + 0.01 * (k % 4)) * tall * number * (-1) ** k) % width
        person(image, x, height * (top + 0.5 * k / count * (1 - top)), tall, (20 + 20 * k, 60, 200 - 15 * k))


def of_height(share: float) -> Paint:
    def paint(image: Any, number: int, rng: Any) -> None:
        walkers(image, number, share * image.shape[0], 12 if share < 0.2 else 3, max(share, 0.45))

    return paint


def close(image: Any, number: int, rng: Any) -> None:
    """People far away, and from a third of the time on a close person, legs out of the picture."""
    height, width = image.shape[:2]
    walkers(image, number, height / 18)
    if number > PICTURES // 3:
        person(image, (number - PICTURES / 3) / PICTURES * 1.5 * width, 1.3 * height, height, (70, 50, 60))


def close_pair(image: Any, number: int, rng: Any) -> None:
    height, width = image.shape[:2]
    close(image, number, rng)
    if number > PICTURES // 3:
        person(image, (number - PICTURES / 4) / PICTURES * 1.5 * width, 1.2 * height, height, (50, 80, 50))


def cars(image: Any, number: int, rng: Any) -> None:
    height, width = image.shape[:2]
    walkers(image, number, height / 18)
    for k, (tall, wide) in enumerate(((0.07, 0.2), (0.2, 0.5), (0.08, 0.2))):
        x, y = ((number * (7 + 3 * k)) % (2 * width)) - width // 2, height * (0.6 + 0.15 * k)
        corner = round(x + wide * width), round(y)
        cv2.rectangle(image, (round(x), round(y - tall * height)), corner, (60 * k, 30, 90), -1)


def door(image: Any, number: int, rng: Any) -> None:
    height, width = image.shape[:2]
    walkers(image, number, height / 12)
    if 40 < number < 80:
        image[height // 4 : round(0.8 * height), width // 3 : width // 3 + width // 4] //= 3


def rain(image: Any, number: int, rng: Any) -> None:
    height, width = image.shape[:2]
    walkers(image, number, height / 18)
    for x, y in rng.integers(0, (width, height), (height * width // 700, 2)).tolist():
        cv2.line(image, (x, y), (x + 2, y + height // 30), (200, 200, 200), 2)


def shower(image: Any, number: int, rng: Any) -> None:
    """Rain in a part of the time."""
    (rain if 50 < number < 70 else of_height(1 / 18))(image, number, rng)


def lamp(image: Any, number: int, rng: Any) -> None:
    height, width = image.shape[:2]
    walkers(image, number, height / 18)
    if number % 30 > 24:
        glow = image[: height // 2, : round(0.8 * width)]
        np.copyto(glow, np.minimum(glow.astype(np.uint16) + 70, 255).astype(np.uint8))


def flag(image: Any, number: int, rng: Any) -> None:
    height, width = image.shape[:2]
    walkers(image, number, height / 15)
    x = np.arange(width // 3)
    wave = np.sin(x / (0.03 * width) + number) * 0.03 * height
    for stripe in range(8):
        y = height * (0.1 + 0.03 * stripe) + wave
        points = np.column_stack([x + width // 2, y]).astype(np.int32)
        cv2.polylines(image, [points], False, (255 * (stripe % 2), 30, 200), round(0.03 * height))


def crowd(image: Any, number: int, rng: Any) -> None:
    """People alone, and a column of sixty who walk through."""
    height, width = image.shape[:2]
    walkers(image, number, height / 15)
    for k in range(60):
        column, row = divmod(k, 5)
        x = width * (number / 60 - 0.6) + column * height / 36 + 3 * np.sin(k + number / 5)
        person(image, x, height * (0.6 + 0.025 * row), height / 15, (10 * row, 100, 4 * k))


#: Width and height, and who moves.
SCENES: dict[str, tuple[int, int, Paint]] = {
    "people of 15 px": (960, 540, of_height(15 / 540)),
    "people of 40 px": (960, 540, of_height(40 / 540)),
    "people of 150 px": (960, 540, of_height(150 / 540)),
    "people of 300 px": (960, 540, of_height(300 / 540)),
    "people of 520 px": (960, 540, of_height(520 / 540)),
    "far and close": (960, 540, close),
    "far and two close": (960, 540, close_pair),
    "cars": (960, 540, cars),
    "door": (960, 540, door),
    "rain": (960, 540, rain),
    "a shower": (960, 540, shower),
    "lamp": (960, 540, lamp),
    "flag": (960, 540, flag),
    "crowd": (960, 540, crowd),
    "small picture": (320, 240, close),
    "4K": (3840, 2160, close),
}


def scene(name: str, is_grey: bool, pictures: int = PICTURES) -> list[Frame]:
    """The pictures of a scene, with noise of the sensor."""
    width, height, paint = SCENES[name]
    rng = np.random.default_rng(3)
    coarse = rng.normal(120, 8, (height // 12, width // 12, 3)).clip(0, 255).astype(np.uint8)
    ground = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST)
    noise = rng.integers(0, 6, ground.shape, np.uint8)
    frames = []
    for number in range(pictures):
        image = ground.copy()
        paint(image, number, rng)
        image = cv2.add(image, np.roll(noise, 37 * number))
        rows = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if is_grey else image
        frames.append(Frame(number * 1_000_000_000 // FPS, number, rows))
    return frames


class Timed(list[Frame]):
    """Pictures that note the time when each is taken."""

    def __init__(self, frames: Iterable[Frame]) -> None:
        super().__init__(frames)
        self.taken_s: list[float] = []

    def __iter__(self) -> Iterator[Frame]:
        for frame in super().__iter__():
            self.taken_s.append(time.process_time())
            yield frame
        self.taken_s.append(time.process_time())


def measured(name: str, detector: Any) -> tuple[Any, float, float]:
    """Milliseconds of each picture (passes, pictures), of learning, and boxes a picture."""
    frames = Timed(scene(name, detector.colour == "grey"))
    boxes = [len(frame.rows) for (frame,) in detector(frames)]
    if len(frames.taken_s) % (len(frames) + 1):
        frames.taken_s.append(time.process_time())  # the last pass doesn't look for the end
    passes = np.array(frames.taken_s).reshape(-1, len(frames) + 1)
    learn = float(passes[1, 0] - passes[0, -1]) if len(passes) > 1 else 0.0
    return np.diff(passes, axis=1) * 1e3, learn * 1e3, float(np.mean(boxes))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--detector", choices=["median", "knn"])
    parser.add_argument("--scene", choices=list(SCENES))
    chosen = parser.parse_args()
    cv2.setNumThreads(1)
    detectors = {
        "median": MedianDetector(),
        "median, one region one box": MedianDetector(separate=False),
        "knn": KnnDetector(),
    }
    print(f"{'scene':20}{'detector':28}{'median ms':>10}{'worst ms':>10}{'ratio':>7}{'learn ms':>10}{'boxes':>7}")
    for name in SCENES:
        for label, detector in detectors.items():
            if name == (chosen.scene or name) and label.startswith(chosen.detector or ""):
                each, learn, boxes = measured(name, detector)
                each = each.sum(axis=0)[1:]  # the first one loads and allocates
                middle, worst = np.median(each), each.max()
                row = f"{middle:>10.1f}{worst:>10.1f}{worst / middle:>7.1f}{learn:>10.0f}{boxes:>7.1f}"
                print(f"{name:20}{label:28}{row}", flush=True)


if __name__ == "__main__":
    main()
