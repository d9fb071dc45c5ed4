"""The input of all tracking scores: ground truth, tracks, and their similarity in each frame.

Letters: G people of the ground truth, H tracks in one frame; R rows of ground truth, C rows of tracks, P pairs in all
frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Indices
from mcaptrack.geometry.ragged import cross_pairs


class RowPairs(NamedTuple):
    """Pairs of a row of ground truth and a row of tracks in the same frame, ordered by frame: arrays (P,).

    ``row`` and ``column`` number the rows of ground truth and of tracks over all frames; ``person`` and ``track`` are
    their dense ids.
    """

    frame: Indices
    row: Indices
    column: Indices
    person: Indices
    track: Indices
    similarity: Floats

    def where(self, kept: NDArray[np.bool_] | Indices) -> RowPairs:
        """A selection of the pairs."""
        frame, row, column, person, track, similarity = self
        return RowPairs(frame[kept], row[kept], column[kept], person[kept], track[kept], similarity[kept])

    def contested(self) -> NDArray[np.bool_]:
        """Whether a pair (P,) shares its row or its column with another pair."""
        contested: NDArray[np.bool_] = (np.bincount(self.row)[self.row] > 1) | (
            np.bincount(self.column)[self.column] > 1
        )
        return contested


SolveFrame = Callable[[int, RowPairs, int, int], tuple[Indices, Indices]]


@dataclass(frozen=True)
class Matchup:
    """Ground truth and tracks of one sequence.

    Parameters
    ----------
    ground_truth, tracks : tuple of int arrays (G,) and (H,)
        For each frame the ids that are present, numbered densely from 0. No id occurs twice in a frame.
    similarity : tuple of arrays (G, H)
        For each frame the similarity of people and tracks, from 0 (unlike) to 1 (equal).
    threshold : float
        Pairs at least this similar can be matched.
    n_ground_truth, n_tracks : int
        The number of different ids.

    Examples
    --------
    Two frames of one person; the track is 0.2 m away in the first frame and 1.2 m in the second:

    >>> import numpy as np
    >>> one = np.array([0])
    >>> similarity = tuple(metres_to_similarity(np.array([[away]]), gate_m=1.0) for away in (0.2, 1.2))
    >>> matchup = Matchup((one, one), (one, one), similarity, 0.5, n_ground_truth=1, n_tracks=1)
    >>> matchup.pairs.similarity.tolist()
    [0.9, 0.4]
    """

    ground_truth: tuple[Indices, ...]
    tracks: tuple[Indices, ...]
    similarity: tuple[Floats, ...]
    threshold: float
    n_ground_truth: int
    n_tracks: int

    @property
    def ground_truth_rows(self) -> int:
        """The number of boxes or positions of the ground truth over all frames."""
        return len(self.all_ground_truth)

    @property
    def track_rows(self) -> int:
        """The number of boxes or positions of the tracks over all frames."""
        return len(self.all_tracks)

    @cached_property
    def all_ground_truth(self) -> Indices:
        """The ids of people in all frames, concatenated (R,)."""
        return _joined(self.ground_truth)

    @cached_property
    def all_tracks(self) -> Indices:
        """The ids of tracks in all frames, concatenated (C,)."""
        return _joined(self.tracks)

    @cached_property
    def ground_truth_counts(self) -> Indices:
        """The number of people in each frame."""
        return np.array([len(ids) for ids in self.ground_truth], np.intp)

    @cached_property
    def track_counts(self) -> Indices:
        """The number of tracks in each frame."""
        return np.array([len(ids) for ids in self.tracks], np.intp)

    @cached_property
    def pairs(self) -> RowPairs:
        """The pairs with a similarity above 0."""
        similarity = self._all_similarity
        at = similarity.nonzero()[0]
        frame, row, column = (part[at] for part in cross_pairs(self.ground_truth_counts, self.track_counts))
        return RowPairs(frame, row, column, self.all_ground_truth[row], self.all_tracks[column], similarity[at])

    def assigned(self, candidates: RowPairs, solve_frame: SolveFrame) -> RowPairs:
        """Assign rows to columns in each frame, among the candidates; pairs come in no particular order.

        Candidates without a competitor are taken. For each other frame ``solve_frame`` is called, in order of frames,
        with the number of the frame, the pairs taken without a call, and the range of those that lie between the
        previous call and this one; it returns the matched rows and columns of the frame's table.
        """
        hard = np.zeros(len(self.ground_truth), bool)
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
        people, tracks = self.ground_truth_counts, self.track_counts
        row = (np.cumsum(people) - people)[frame] + rows
        column = (np.cumsum(tracks) - tracks)[frame] + columns
        size = people * tracks
        similarity = self._all_similarity[(np.cumsum(size) - size)[frame] + rows * tracks[frame] + columns]
        assigned = RowPairs(frame, row, column, self.all_ground_truth[row], self.all_tracks[column], similarity)
        return RowPairs(*(np.concatenate(both) for both in zip(easy, assigned, strict=True)))

    @cached_property
    def _all_similarity(self) -> Floats:
        return np.concatenate([np.empty(0), *(part.ravel() for part in self.similarity)])


def _joined(ids: Sequence[Indices]) -> Indices:
    return np.concatenate([np.empty(0, np.intp), *ids])


def metres_to_similarity(distance_m: Floats, gate_m: float) -> Floats:
    """Turn distances into similarities: 1 at 0 m, 0.5 at the gate, 0 from twice the gate on, as TrackEval does.

    Parameters
    ----------
    distance_m : array, m
        Distances of any shape.
    gate_m : float, m
        The largest distance of a match.

    Returns
    -------
    array
        Similarities between 0 and 1, of the same shape.

    Examples
    --------
    >>> import numpy as np
    >>> metres_to_similarity(np.array([0.0, 1.0, 3.0]), gate_m=1.0).tolist()
    [1.0, 0.5, 0.0]
    """
    return np.clip(1 - distance_m / (2 * gate_m), 0, None)


def distances(a_m: Floats, b_m: Floats) -> Floats:
    """The distances between two sets of positions.

    Parameters
    ----------
    a_m : array (G, 2), m
    b_m : array (H, 2), m

    Returns
    -------
    array (G, H), m

    Examples
    --------
    >>> import numpy as np
    >>> distances(np.zeros((1, 2)), np.array([[3.0, 4.0]])).tolist()
    [[5.0]]
    """
    return np.hypot(a_m[:, None, 0] - b_m[None, :, 0], a_m[:, None, 1] - b_m[None, :, 1])
