"""Drawn people on coloured ground, for the median detector: pictures in which every box is known."""

from __future__ import annotations

import numpy as np

from mcaptrack.schema import Frame
from tests.worlds import ns

HEIGHT, WIDTH = 160, 240


def ground(seed: int = 0) -> np.ndarray:
    """A coloured picture with a little texture."""
    rng = np.random.default_rng(seed)
    return (np.array([120, 140, 130]) + rng.normal(0, 3, (HEIGHT, WIDTH, 1))).clip(0, 255).astype(np.uint8)


def figure(image: np.ndarray, x: float, foot: float, colour=(30, 30, 160), tall: float = 40.0) -> tuple[float, ...]:
    """Draw a person whose feet stand at (x, foot): a head, a body, two legs. Returns the box."""
    half = tall * 0.16
    for low, high, wide in ((0.0, 0.18, 0.5), (0.18, 0.6, 1.0), (0.6, 1.0, 0.7)):
        top, bottom = foot - tall * (1 - low), foot - tall * (1 - high)
        left, right = x - half * wide, x + half * wide
        image[max(round(top), 0) : max(round(bottom), 0), max(round(left), 0) : max(round(right), 0)] = colour
    return x - half, foot - tall, 2 * half, tall


def film(paint, count: int = 60, step_s: float = 0.5, seed: int = 0) -> list[Frame]:
    """Pictures of a scene: ``paint(image, number)`` draws on the ground."""
    frames, still, rng = [], ground(seed), np.random.default_rng(seed + 1)
    for number in range(count):
        image = still.copy()
        paint(image, number)
        noisy = image + rng.normal(0, 1.5, image.shape)
        frames.append(Frame(ns(step_s * number), number, noisy.clip(0, 255).astype(np.uint8)))
    return frames


def walk(image: np.ndarray, number: int) -> None:
    """One person walks through again and again, so that there is something to learn a shape from."""
    figure(image, 20 + 7.5 * (number % 28), 150)
