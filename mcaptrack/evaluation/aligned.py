"""Truth and tracks brought to the same times, and how alike they are then: what scores and events both start from.

Letters: N rows, T times, G true people, H tracks in one frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import metrics
from mcaptrack.evaluation.metrics import Matchup
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.geometry.boxes import columns_to_boxes, iou_of_pairs
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.resampling import looked_at, resample

Similarity = Literal["iou", "metres"]

#: Boxes that overlap so much are alike, and people so near on the ground, where a command line asks for nothing else.
IOU_THRESHOLD: Final = 0.5
GATE_M: Final = 1.0
#: The truth is interpolated over no longer hole than this.
MAX_HOLE_S: Final = 2.0
#: Sizes that differ by more than this factor, where nothing ever meets, are in different units.
_OTHER_UNIT: Final = 8.0
#: Positions further apart than twice this have nothing to do with each other.
_FAR_M: Final = 5.0
#: How many pairs of boxes are compared in one go, to bound the memory that takes.
_PAIRS_AT_ONCE: Final = 1_000_000
_COLUMN: Final[dict[Similarity, str]] = {"iou": "x_px", "metres": "x_m"}


def frame_times(frames: Sequence[Frame]) -> Ints:
    """The times of frames (T,)."""
    return np.fromiter((frame.t_ns for frame in frames), np.int64, len(frames))


def share_times(truth_ns: Ints, tracks_ns: Ints) -> bool:
    """Whether tracks are compared at the truth's own times: they have most of these."""
    return 2 * int(np.isin(truth_ns, tracks_ns).sum()) >= len(truth_ns)


def align(
    name: str, tracks_name: str, truth: Sequence[Frame], tracks: Sequence[Frame]
) -> tuple[list[Frame], list[Frame]]:
    """Truth and tracks at the same times. Raises McaptrackError, with the names, if they never overlap."""
    truth_ns, tracks_ns = frame_times(truth), frame_times(tracks)
    by_time = {frame.t_ns: frame for frame in tracks}
    if share_times(truth_ns, tracks_ns):
        empty = TRACKS.empty()
        return list(truth), [by_time.get(f.t_ns, Frame(f.t_ns, f.index, empty)) for f in truth]
    kept = looked_at(truth_ns, tracks_ns, seconds_to_ns(MAX_HOLE_S))
    if not kept.any():
        raise McaptrackError(
            f"{name}: the truth ({_span(truth_ns)}) and {tracks_name} ({_span(tracks_ns)}) never overlap in time"
        )
    at_ns = np.unique(tracks_ns[kept])
    return resampled(truth, at_ns), [by_time[t_ns] for t_ns in at_ns.tolist()]


def _span(t_ns: Ints) -> str:
    return f"{t_ns[0] / NS_PER_S:.3f} to {t_ns[-1] / NS_PER_S:.3f} s" if len(t_ns) else "no frames"


def resampled(frames: Sequence[Frame], at_ns: Ints) -> list[Frame]:
    """Tracks at these rising times (T,), a frame a time."""
    out, at = resample(frames, at_ns, seconds_to_ns(MAX_HOLE_S))
    ends = np.searchsorted(at, np.arange(len(at_ns)), "right").tolist()
    spans = zip(at_ns.tolist(), [0, *ends][:-1], ends, strict=True)
    return [Frame(t_ns, index, out[low:high]) for index, (t_ns, low, high) in enumerate(spans)]


def on_ground(rows: Rows) -> Floats:
    """Where rows stand on the ground, (N, 2) m."""
    return np.stack([rows["x_m"], rows["y_m"]], axis=-1)


def without(sides: dict[str, Sequence[Frame]], similarity: Similarity) -> list[str]:
    """The names of those that hold rows and none with what the similarity compares."""
    return [
        name
        for name, frames in sides.items()
        if any(len(frame.rows) for frame in frames) and not has(frames, similarity)
    ]


def has(frames: Sequence[Frame], similarity: Similarity) -> bool:
    """Whether there is a row with what the similarity compares: a box, or a place on the ground."""
    return any(np.isfinite(frame.rows[_COLUMN[similarity]]).any() for frame in frames)


def strangers(
    name: str, tracks_name: str, truth: Sequence[Frame], tracks: Sequence[Frame], similarity: Similarity
) -> list[str]:
    """Words on tracks that never come near anybody. Raises McaptrackError if that is because units differ."""
    both = {f"the truth of {name}": truth, tracks_name: tracks}
    if not all(any(len(frame.rows) for frame in frames) for frames in both.values()):
        return []
    if similarity == "iou":
        alike = matchup(truth, tracks, "iou", IOU_THRESHOLD)
        sizes = [float(np.nanmedian(np.concatenate([f.rows["h_px"] for f in frames]))) for frames in both.values()]
        what, unit = "boxes", "px high"
    else:
        alike = matchup(truth, tracks, "metres", _FAR_M)
        spans = [np.concatenate([on_ground(f.rows) for f in frames]) for frames in both.values()]
        sizes = [float(np.nanmedian(np.abs(xy - np.nanmedian(xy, axis=0)))) for xy in spans]
        what, unit = "positions", "m from their middle"
    if len(alike.pairs.frame):
        return []
    small, large = sorted(sizes)
    if large > _OTHER_UNIT * max(small, 1e-9):
        (a, b), (m, n) = both, sizes
        raise McaptrackError(
            f"{what} of {a} are {m:.3g} {unit}, those of {b} {n:.3g}, and none ever meet: they are not in the same unit"
        )
    return [f"{name}: {tracks_name} and the truth never come near each other"]


class Placed(NamedTuple):
    """The rows of all frames that have a place (N,), in the order of frames.

    ``who`` is the dense number of each row's id in ``names``; rows of frame f are ``ends[f]`` to ``ends[f + 1]``.
    """

    rows: Rows
    who: Ints
    names: Ints
    ends: Ints


class Compared(NamedTuple):
    """Truth and tracks as a matchup, and the rows that its numbers stand for."""

    matchup: Matchup
    truth: Placed
    tracks: Placed


def matchup(truth: Sequence[Frame], tracks: Sequence[Frame], similarity: Similarity, gate: float) -> Matchup:
    """Truth and tracks at the same times as a matchup: boxes by overlap, or positions by distance."""
    return compare(truth, tracks, similarity, gate).matchup


def compare(truth: Sequence[Frame], tracks: Sequence[Frame], similarity: Similarity, gate: float) -> Compared:
    """The same, with the rows that were compared."""
    people, found = (_placed(part, _COLUMN[similarity]) for part in (truth, tracks))
    places = columns_to_boxes if similarity == "iou" else on_ground
    a, b = places(people.rows), places(found.rows)
    alike: list[Floats] = []
    step = max(1, round(_PAIRS_AT_ONCE / max(1.0, len(a) * len(b) / max(1, len(truth)) ** 2)))
    for first in range(0, len(truth), step):
        alike += _similarities(a, b, people.ends[first : first + step + 1], found.ends[first : first + step + 1], gate)
    matched = Matchup(
        tuple(np.split(people.who, people.ends[1:-1])),
        tuple(np.split(found.who, found.ends[1:-1])),
        tuple(alike),
        gate if similarity == "iou" else 0.5,
        len(people.names),
        len(found.names),
    )
    return Compared(matched, people, found)


def join_rows(frames: Sequence[Frame]) -> tuple[Rows, Ints]:
    """The rows of all frames (N,), and where those of each frame begin and the last ones end."""
    ends = np.cumsum([0] + [len(frame.rows) for frame in frames])
    rows = TRACKS.empty(int(ends[-1]))
    for low, frame in zip(ends.tolist(), frames, strict=False):
        rows[low : low + len(frame.rows)] = frame.rows
    return rows, ends


def _placed(frames: Sequence[Frame], column: str) -> Placed:
    rows, ends = join_rows(frames)
    usable = np.isfinite(rows[column])
    if not usable.all():
        ends, rows = np.concatenate([[0], usable.cumsum()])[ends], rows[usable]
    names, who = np.unique(rows["track_id"], return_inverse=True)
    return Placed(rows, who, names, ends)


def _similarities(a: Floats, b: Floats, a_ends: Ints, b_ends: Ints, gate: float) -> list[Floats]:
    """How alike are the boxes or places in ``a`` and ``b`` of some frames, (G, H) a frame; all pairs in one go."""
    people, found = np.diff(a_ends), np.diff(b_ends)
    size = people * found
    ends = np.cumsum(size)
    frame = np.repeat(np.arange(len(size)), size)
    within = np.arange(len(frame)) - (ends - size)[frame]
    row = a_ends[frame] + within // found[frame]
    column = b_ends[frame] + within % found[frame]
    if a.shape[1] == 4:
        alike = iou_of_pairs(a[row], b[column])
    else:
        apart = a[row] - b[column]
        alike = metrics.metres_to_similarity(np.hypot(apart[:, 0], apart[:, 1]), gate)
    spans = zip((ends - size).tolist(), ends.tolist(), people.tolist(), found.tolist(), strict=True)
    return [alike[low:high].reshape(g, h) for low, high, g, h in spans]
