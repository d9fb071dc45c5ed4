"""The input of all tracking scores: ground truth, tracks, and their similarity in each frame.

Letters: G people of the ground truth, H tracks in one frame; R rows of ground truth, C rows of tracks, P pairs in all
frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from mcaptrack.geometry.arrays import Floats, Indices, joined, taken
from mcaptrack.geometry.assignment import LARGE_TABLE, assign_pairs_by_gain, solve
from mcaptrack.geometry.ragged import cross_pairs, find_rows


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

    def contested(self) -> NDArray[np.bool_]:
        """Whether a pair (P,) shares its row or its column with another pair."""
        contested: NDArray[np.bool_] = (np.bincount(self.row)[self.row] > 1) | (
            np.bincount(self.column)[self.column] > 1
        )
        return contested


class SparseTables(Sequence[Floats]):
    """The similarities of all frames, of which only those above 0 are stored: 32 bytes a pair.

    As a sequence it has the table (G, H) of each frame.

    Parameters
    ----------
    frame, row, column : int arrays (P,)
        Pairs ordered by frame, row and column; rows and columns are numbered over all frames.
    similarity : array (P,)
        Their similarities, above 0.
    row_ends, column_ends : int arrays (F + 1,)
        Where the rows and the columns of each of F frames begin, and the last ones end.
    """

    def __init__(
        self, frame: Indices, row: Indices, column: Indices, similarity: Floats, row_ends: Indices, column_ends: Indices
    ) -> None:
        self.frame, self.row, self.column, self.similarity = frame, row, column, similarity
        self._row_ends, self._column_ends = row_ends, column_ends
        self._ends = np.searchsorted(frame, np.arange(len(row_ends)))
        self._last = -1
        self._table = np.empty((0, 0))

    def __len__(self) -> int:
        return len(self._row_ends) - 1

    @overload
    def __getitem__(self, number: int, /) -> Floats: ...

    @overload
    def __getitem__(self, number: slice, /) -> list[Floats]: ...

    def __getitem__(self, number: int | slice, /) -> Floats | list[Floats]:
        if isinstance(number, slice):
            return [self[frame] for frame in range(len(self))[number]]
        number = range(len(self))[number]
        if number != self._last:
            (top, bottom), (left, right) = self._row_ends[number : number + 2], self._column_ends[number : number + 2]
            here = slice(*self._ends[number : number + 2])
            self._table = np.zeros((bottom - top, right - left))
            self._table[self.row[here] - top, self.column[here] - left] = self.similarity[here]
            self._last = number
        return self._table

    def is_large(self, number: int) -> bool:
        """Whether the table of a frame is better not made."""
        (top, bottom), (left, right) = self._row_ends[number : number + 2], self._column_ends[number : number + 2]
        return bool((bottom - top) * (right - left) > LARGE_TABLE)

    def pairs_of(self, number: int) -> tuple[Indices, Indices, Floats]:
        """The rows, columns and similarities above 0 of the table of a frame."""
        here = slice(*self._ends[number : number + 2])
        return (
            self.row[here] - self._row_ends[number],
            self.column[here] - self._column_ends[number],
            self.similarity[here],
        )

    def best(self, number: int, gain: Floats | None = None) -> tuple[Indices, Indices]:
        """The assignment of rows and columns of a frame with the largest total similarity, or ``gain`` of its pairs.

        Of a small table, pairs without a similarity may be among them.
        """
        if gain is None and not self.is_large(number):
            return solve(-self[number])
        rows, columns, similarity = self.pairs_of(number)
        gain = similarity if gain is None else gain
        shape = tuple(int(ends[number + 1] - ends[number]) for ends in (self._row_ends, self._column_ends))
        return assign_pairs_by_gain((rows[gain > 0], columns[gain > 0]), gain[gain > 0], (shape[0], shape[1]))[0]

    def at(self, number: int, rows: Indices, columns: Indices) -> Floats:
        """The similarities of some pairs of a frame."""
        if not self.is_large(number):
            return self[number][rows, columns]
        known_rows, known_columns, similarity = self.pairs_of(number)
        return np.append(similarity, 0.0)[find_rows((known_rows, known_columns), (rows, columns))]

    def of_columns(self, kept: NDArray[np.bool_]) -> SparseTables:
        """The tables with some of the columns of all frames (C,)."""
        before = np.concatenate([[0], np.cumsum(kept)])
        pair = kept[self.column]
        return SparseTables(
            self.frame[pair],
            self.row[pair],
            before[self.column[pair]],
            self.similarity[pair],
            self._row_ends,
            before[self._column_ends],
        )


SolveFrame = Callable[[int, RowPairs, int, int], tuple[Indices, Indices]]


@dataclass(frozen=True)
class Matchup:
    """Ground truth and tracks of one sequence.

    Parameters
    ----------
    ground_truth, tracks : tuple of int arrays (G,) and (H,)
        For each frame the ids that are present, numbered densely from 0. No id occurs twice in a frame.
    similarity : tuple of arrays (G, H), or SparseTables
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
    similarity: Sequence[Floats]
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
    def tables(self) -> SparseTables:
        """The similarities above 0 of all frames."""
        if isinstance(self.similarity, SparseTables):
            return self.similarity
        of_all = np.concatenate([np.empty(0), *(part.ravel() for part in self.similarity)])
        at = of_all.nonzero()[0]
        frame, row, column = (part[at] for part in cross_pairs(self.ground_truth_counts, self.track_counts))
        people, tracks = (np.append(0, np.cumsum(counts)) for counts in (self.ground_truth_counts, self.track_counts))
        return SparseTables(frame, row, column, of_all[at], people, tracks)

    @cached_property
    def pairs(self) -> RowPairs:
        """The pairs with a similarity above 0."""
        tables = self.tables
        people, tracks = self.all_ground_truth[tables.row], self.all_tracks[tables.column]
        return RowPairs(tables.frame, tables.row, tables.column, people, tracks, tables.similarity)

    def assigned(self, candidates: RowPairs, solve_frame: SolveFrame) -> RowPairs:
        """Assign rows to columns in each frame, among the candidates; pairs come in no particular order.

        Candidates without a competitor are taken. For each other frame ``solve_frame`` is called, in order of frames,
        with the number of the frame, the pairs taken without a call, and the range of those that lie between the
        previous call and this one; it returns the matched rows and columns of the frame's table.
        """
        hard = np.zeros(len(self.ground_truth), bool)
        hard[candidates.frame[candidates.contested()]] = True
        easy, numbers = taken(candidates, ~hard[candidates.frame]), hard.nonzero()[0]
        ends = np.searchsorted(easy.frame, numbers)
        by_frame: list[tuple[Indices, Indices, Floats]] = []
        low = 0
        for number, high in zip(numbers.tolist(), ends.tolist(), strict=True):
            rows, columns = solve_frame(number, easy, low, high)
            by_frame.append((rows, columns, self.tables.at(number, rows, columns)))
            low = high
        if not by_frame:
            return easy
        frame = np.repeat(numbers, [len(rows) for rows, *_ in by_frame])
        rows, columns, similarity = (np.concatenate(parts) for parts in zip(*by_frame, strict=True))
        people, tracks = self.ground_truth_counts, self.track_counts
        row = (np.cumsum(people) - people)[frame] + rows
        column = (np.cumsum(tracks) - tracks)[frame] + columns
        assigned = RowPairs(frame, row, column, self.all_ground_truth[row], self.all_tracks[column], similarity)
        return joined([easy, assigned])


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
