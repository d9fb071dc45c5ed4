"""What every score is computed from: who was there, who was tracked, and how alike they are, frame by frame.

Letters: G true people, H tracks in one frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]


@dataclass(frozen=True)
class Matchup:
    """One sequence of true people against tracks.

    ``truth`` and ``tracks`` hold one array a frame: the people there, numbered densely from 0 to ``n_truth`` (and
    ``n_tracks``) - 1. ``similarity`` holds their likeness, (G, H) a frame, 1 for equal and 0 for unlike; pairs are
    comparable at ``threshold`` and above.
    """

    truth: tuple[Ints, ...]
    tracks: tuple[Ints, ...]
    similarity: tuple[Floats, ...]
    threshold: float
    n_truth: int
    n_tracks: int

    @property
    def truth_rows(self) -> int:
        """How many boxes or positions the truth has over all frames."""
        return sum(len(ids) for ids in self.truth)

    @property
    def track_rows(self) -> int:
        """How many boxes or positions the tracks have over all frames."""
        return sum(len(ids) for ids in self.tracks)


def metres_to_similarity(distance_m: Floats, gate_m: float) -> Floats:
    """Distances as a likeness: 1 at 0 m, 0.5 at the gate, 0 from twice the gate on (TrackEval's way)."""
    return np.clip(1 - distance_m / (2 * gate_m), 0, None)


def distances(a_m: Floats, b_m: Floats) -> Floats:
    """The distances (G, H) between positions (G, 2) and (H, 2)."""
    return np.hypot(a_m[:, None, 0] - b_m[None, :, 0], a_m[:, None, 1] - b_m[None, :, 1])
