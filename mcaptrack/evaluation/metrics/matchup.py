"""What every score is computed from: who was there, who was tracked, and how alike they are, frame by frame.

Letters: G true people, H tracks in one frame; R true rows, C tracks' rows, P pairs in all frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Indices


class Pairs(NamedTuple):
    """Pairs of one true and one tracked row of a frame, in the order of the frames: arrays (P,).

    ``row`` and ``column`` count the rows of truth and tracks through all frames; ``who`` and ``by`` are the person and
    the track of these.
    """

    frame: Indices
    row: Indices
    column: Indices
    who: Indices
    by: Indices
    similarity: Floats

    def where(self, kept: NDArray[np.bool_] | Indices) -> Pairs:
        """Some of the pairs."""
        frame, row, column, who, by, similarity = self
        return Pairs(frame[kept], row[kept], column[kept], who[kept], by[kept], similarity[kept])

    def contested(self) -> NDArray[np.bool_]:
        """Whether a pair (P,) shares its row or its column with another."""
        contested: NDArray[np.bool_] = (np.bincount(self.row)[self.row] > 1) | (
            np.bincount(self.column)[self.column] > 1
        )
        return contested


SolveFrame = Callable[[int, Pairs, int, int], tuple[Indices, Indices]]


@dataclass(frozen=True)
class Matchup:
    """One sequence of true people against tracks.

    ``truth`` and ``tracks`` hold one array a frame: the people there, numbered densely from 0 to ``n_truth`` (and
    ``n_tracks``) - 1. ``similarity`` holds their likeness, (G, H) a frame, 1 for equal and 0 for unlike; pairs are
    comparable at ``threshold`` and above. Nobody is twice in a frame.
    """

    truth: tuple[Indices, ...]
    tracks: tuple[Indices, ...]
    similarity: tuple[Floats, ...]
    threshold: float
    n_truth: int
    n_tracks: int

    @property
    def truth_rows(self) -> int:
        """How many boxes or positions the truth has over all frames."""
        return len(self.all_truth)

    @property
    def track_rows(self) -> int:
        """How many boxes or positions the tracks have over all frames."""
        return len(self.all_tracks)

    @cached_property
    def all_truth(self) -> Indices:
        """The people of all frames, one after the other (R,)."""
        return _joined(self.truth)

    @cached_property
    def all_tracks(self) -> Indices:
        """The tracks of all frames, one after the other (C,)."""
        return _joined(self.tracks)

    @cached_property
    def truth_counts(self) -> Indices:
        """How many people there are in each frame."""
        return np.array([len(ids) for ids in self.truth], np.intp)

    @cached_property
    def track_counts(self) -> Indices:
        """How many tracks there are in each frame."""
        return np.array([len(ids) for ids in self.tracks], np.intp)

    @cached_property
    def pairs(self) -> Pairs:
        """The pairs that are alike at all."""
        people, tracks = self.truth_counts, self.track_counts
        size = people * tracks
        similarity = self._all_similarity
        at = similarity.nonzero()[0]
        frame = np.repeat(np.arange(len(size)), size)[at]
        within = at - (np.cumsum(size) - size)[frame]
        local = within // tracks[frame]
        row = (np.cumsum(people) - people)[frame] + local
        column = (np.cumsum(tracks) - tracks)[frame] + within - local * tracks[frame]
        return Pairs(frame, row, column, self.all_truth[row], self.all_tracks[column], similarity[at])

    def solved(self, candidates: Pairs, solve_frame: SolveFrame) -> Pairs:
        """One assignment a frame among the candidates, in no particular order.

        Where no candidate competes with another, all are taken. For every other frame ``solve_frame`` is asked, in
        order: it gets the number of the frame, the pairs that are taken without asking, and which of these lie between
        the last frame that it was asked about and this one; it returns the rows and columns of the frame's table that
        go together.
        """
        hard = np.zeros(len(self.truth), bool)
        hard[candidates.frame[candidates.contested()]] = True
        easy, numbers = candidates.where(~hard[candidates.frame]), hard.nonzero()[0]
        ends = np.searchsorted(easy.frame, numbers)
        found: list[tuple[Indices, Indices]] = []
        low = 0
        for number, high in zip(numbers.tolist(), ends.tolist(), strict=True):
            found.append(solve_frame(number, easy, low, high))
            low = high
        if not found:
            return easy
        frame = np.repeat(numbers, [len(rows) for rows, _ in found])
        rows, columns = (np.concatenate(parts) for parts in zip(*found, strict=True))
        people, tracks = self.truth_counts, self.track_counts
        row = (np.cumsum(people) - people)[frame] + rows
        column = (np.cumsum(tracks) - tracks)[frame] + columns
        size = people * tracks
        similarity = self._all_similarity[(np.cumsum(size) - size)[frame] + rows * tracks[frame] + columns]
        solved = Pairs(frame, row, column, self.all_truth[row], self.all_tracks[column], similarity)
        return Pairs(*(np.concatenate(both) for both in zip(easy, solved, strict=True)))

    @cached_property
    def _all_similarity(self) -> Floats:
        return np.concatenate([np.empty(0), *(part.ravel() for part in self.similarity)])


def _joined(ids: Sequence[Indices]) -> Indices:
    return np.concatenate([np.empty(0, np.intp), *ids])


def metres_to_similarity(distance_m: Floats, gate_m: float) -> Floats:
    """Distances as a likeness: 1 at 0 m, 0.5 at the gate, 0 from twice the gate on (TrackEval's way)."""
    return np.clip(1 - distance_m / (2 * gate_m), 0, None)


def distances(a_m: Floats, b_m: Floats) -> Floats:
    """The distances (G, H) between positions (G, 2) and (H, 2)."""
    return np.hypot(a_m[:, None, 0] - b_m[None, :, 0], a_m[:, None, 1] - b_m[None, :, 1])
