"""The motion of the ground tracker: a slow reference with one matrix for each track, from the textbook.

Position, velocity and acceleration along one axis; the acceleration is a first-order Markov process (R. A. Singer,
"Estimating Optimal Tracking Filter Performance for Manned Maneuvering Targets", IEEE T-AES 1970).
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

FADES_S = 2.0
NOISE_SHARE = 0.1


class Axis:
    """A Kalman filter along one axis: mean (3,) and covariance (3, 3)."""

    def __init__(self, at: float, noise: float, speed: float, drift: float, turns: bool) -> None:
        lasting = (1 - NOISE_SHARE) * drift * turns
        self.mean = np.array([at, 0.0, 0.0])
        self.cov = np.diag([noise**2, speed**2, lasting**2])
        self.noise, self.lasting = noise, lasting
        self.power = (drift - lasting) ** 2

    def predict(self, seconds: float) -> None:
        move = expm(seconds * np.array([[0, 1, 0], [0, 0, 1], [0, 0, -1 / FADES_S]]))
        drift = np.zeros((3, 3))
        drift[:2, :2] = self.power * np.array([[seconds**3 / 3, seconds**2 / 2], [seconds**2 / 2, seconds]])
        drift[2, 2] = self.lasting**2 * (1 - np.exp(-2 * seconds / FADES_S))
        self.mean, self.cov = move @ self.mean, move @ self.cov @ move.T + drift

    def correct(self, at: float) -> None:
        h = np.array([[1.0, 0, 0]])
        gain = self.cov @ h.T @ np.linalg.inv(h @ self.cov @ h.T + self.noise**2)
        self.mean = self.mean + (gain * (at - self.mean[0]))[:, 0]
        self.cov = (np.eye(3) - gain @ h) @ self.cov
