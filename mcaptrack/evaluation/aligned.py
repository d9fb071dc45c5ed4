"""Ground truth and tracks at the same times, and their similarity: the input of scores and of events.

Letters: N rows, T times, G people of the ground truth, H tracks in one frame.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.choices import Similarity
from mcaptrack.errors import McaptrackError
from mcaptrack.evaluation import metrics
from mcaptrack.evaluation.metrics import Matchup
from mcaptrack.evaluation.metrics.matchup import SparseTables
from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.boxes import (
    bev_iou_of_pairs,
    columns_to_boxes,
    columns_to_oriented_boxes,
    iou_3d_of_pairs,
    iou_of_pairs,
)
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.geometry.neighbours import touching_pairs
from mcaptrack.geometry.ragged import cross_pairs, group_index
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.classes import PERSON, class_name, is_person, majority
from mcaptrack.schema.framing import frame_times, join_frames, split_rows
from mcaptrack.schema.resampling import is_observed_at, resample
from mcaptrack.transforms.motion_limits import UNKNOWN, limits_row

#: The default gates: least overlap of boxes, and largest distance on the ground.
IOU_THRESHOLD: Final = 0.5
GATE_M: Final = 1.0
#: The default distance for 3D boxes, as nuScenes has it.
GATE_3D_M: Final = 2.0
#: The ground truth is interpolated over gaps of at most this length.
MAX_GAP_S: Final = 2.0
#: Sizes that differ by more than this factor, without a single match, are taken to be in different units.
_OTHER_UNIT: Final = 8.0
#: The gate for the test whether tracks are anywhere near the ground truth; twice this distance has similarity 0.
_FAR_M: Final = 5.0
#: Positions that are nearer to their middle than this are of people who stand, which tells nothing about their unit.
_STANDING_M: Final = 0.5
_OVERLAPS: Final = {"iou": iou_of_pairs, "bev-iou": bev_iou_of_pairs, "3d-iou": iou_3d_of_pairs}
#: The number of pairs of boxes compared at once, to limit memory.
_PAIRS_AT_ONCE: Final = 250_000
#: The columns that each similarity needs, and what they are in messages.
_NEEDED: Final[dict[Similarity, tuple[str, ...]]] = {
    "iou": ("x_px",),
    "metres": ("x_m",),
    "bev-iou": ("x_m", "length_m", "width_m", "heading_rad"),
    "3d-iou": ("x_m", "z_m", "length_m", "width_m", "height_m", "heading_rad"),
}
_UNITS: Final[dict[Similarity, str]] = {
    "iou": "boxes in pictures",
    "metres": "positions in metres",
    "bev-iou": "boxes in metres with a heading",
    "3d-iou": "3D boxes (with z_m, height_m and a heading)",
}


def have_same_times(ground_truth_ns: Ints, tracks_ns: Ints) -> bool:
    """Whether tracks are compared at the times of the ground truth: they have most of these."""
    return 2 * int(np.isin(ground_truth_ns, tracks_ns).sum()) >= len(ground_truth_ns)


def align(
    name: str, tracks_name: str, ground_truth: Sequence[Frame], tracks: Sequence[Frame]
) -> tuple[list[Frame], list[Frame]]:
    """Bring ground truth and tracks to the same times. Raises McaptrackError, with the names, if they never overlap."""
    ground_truth_ns, tracks_ns = frame_times(ground_truth), frame_times(tracks)
    by_time = {frame.t_ns: frame for frame in tracks}
    if have_same_times(ground_truth_ns, tracks_ns):
        empty = TRACKS.empty()
        return list(ground_truth), [by_time.get(f.t_ns, Frame(f.t_ns, f.index, empty)) for f in ground_truth]
    kept = is_observed_at(ground_truth_ns, tracks_ns, seconds_to_ns(MAX_GAP_S))
    if not kept.any():
        spans = f"the ground truth ({_span(ground_truth_ns)}) and {tracks_name} ({_span(tracks_ns)})"
        raise McaptrackError(f"{name}: {spans} never overlap in time")
    at_ns = np.unique(tracks_ns[kept])
    return resample_frames(ground_truth, at_ns), [by_time[t_ns] for t_ns in at_ns.tolist()]


def _span(t_ns: Ints) -> str:
    return f"{t_ns[0] / NS_PER_S:.3f} to {t_ns[-1] / NS_PER_S:.3f} s" if len(t_ns) else "no frames"


def resample_frames(frames: Sequence[Frame], at_ns: Ints) -> list[Frame]:
    """Tracks at rising times (T,), one frame for each time."""
    out, at = resample(frames, at_ns, seconds_to_ns(MAX_GAP_S))
    return split_rows(at_ns, range(len(at_ns)), out, np.searchsorted(at, np.arange(len(at_ns)), "right"))


def on_ground(rows: Rows) -> Floats:
    """The positions of rows on the ground plane, (N, 2) m."""
    return np.stack([rows["x_m"], rows["y_m"]], axis=-1)


def sides_without(sides: Mapping[str, Sequence[Frame]], similarity: Similarity) -> list[str]:
    """The names of sides that have rows, but none with the columns that a similarity compares."""
    return [
        name
        for name, frames in sides.items()
        if any(len(frame.rows) for frame in frames) and not has_positions(frames, similarity)
    ]


def has_positions(frames: Sequence[Frame], similarity: Similarity) -> bool:
    """Whether any row has the columns that a similarity compares: a box, or a position in metres."""
    return any(_have_positions(frame.rows, similarity).any() for frame in frames)


def _have_positions(rows: Rows, similarity: Similarity) -> Bools:
    return np.asarray(np.isfinite([rows[name] for name in _NEEDED[similarity]]).all(axis=0), bool)


def refuse_sides_without(name: str, sides: Mapping[str, Sequence[Frame]], similarity: Similarity) -> None:
    """Raise McaptrackError if one of the sides has rows, but none with the columns that a similarity compares."""
    if missing := sides_without(sides, similarity):
        has = "have" if len(missing) > 1 else "has"
        raise McaptrackError(f"{name}{' and '.join(missing)} {has} no {_UNITS[similarity]}")


def are_3d(ground_truth: Sequence[Frame], tracks: Sequence[Frame]) -> bool:
    """Whether both have boxes in metres, so that scores of 3D tracking are usual for them."""
    return all(has_positions(frames, "bev-iou") for frames in (ground_truth, tracks))


def explain_no_match(
    name: str, tracks_name: str, ground_truth: Sequence[Frame], tracks: Sequence[Frame], similarity: Similarity
) -> list[str]:
    """A note about tracks that never match the ground truth. Raises McaptrackError if their units seem to differ."""
    both = {f"the ground truth of {name}": ground_truth, tracks_name: tracks}
    if not all(any(len(frame.rows) for frame in frames) for frames in both.values()):
        return []
    if similarity == "iou":
        alike = make_matchup(ground_truth, tracks, "iou", IOU_THRESHOLD)
        sizes = [float(np.nanmedian(np.concatenate([f.rows["h_px"] for f in frames]))) for frames in both.values()]
        what, unit = "boxes", "px high"
    else:
        alike = make_matchup(ground_truth, tracks, "metres", _FAR_M)
        spans = [np.concatenate([on_ground(f.rows) for f in frames]) for frames in both.values()]
        sizes = [float(np.nanmedian(np.hypot(*(xy - np.nanmedian(xy, axis=0)).T))) for xy in spans]
        what, unit = "positions", "m from their middle"
    if len(alike.pairs.frame):
        return []
    small, large = sorted(sizes)
    if large > _OTHER_UNIT * small and (similarity == "iou" or small > _STANDING_M):
        (a, b), (m, n) = both, sizes
        raise McaptrackError(
            f"{what} of {a} are {m:.3g} {unit}, those of {b} {n:.3g}, and none ever meet: they are not in the same unit"
        )
    return [f"{name}: {tracks_name} and the ground truth never come near each other"]


class LocatedRows(NamedTuple):
    """The rows of all frames that have a box or a position (N,), in the order of frames.

    ``track`` is the index of each row's id in ``ids``; the rows of frame f are ``ends[f]`` to ``ends[f + 1]``.
    """

    rows: Rows
    track: Ints
    ids: Ints
    ends: Ints


class RowComparison(NamedTuple):
    """A matchup of ground truth and tracks, and the rows to which its indices refer."""

    matchup: Matchup
    ground_truth: LocatedRows
    tracks: LocatedRows


def make_matchup(
    ground_truth: Sequence[Frame], tracks: Sequence[Frame], similarity: Similarity, gate: float
) -> Matchup:
    """Compare ground truth and tracks at the same times: boxes by overlap, or positions by distance."""
    return compare_rows(ground_truth, tracks, similarity, gate).matchup


def compare_rows(
    ground_truth: Sequence[Frame], tracks: Sequence[Frame], similarity: Similarity, gate: float, by_class: bool = False
) -> RowComparison:
    """Like `make_matchup`, with the rows that were compared; ``by_class``: rows of different classes are not alike."""
    people, theirs = (_locate(part, similarity) for part in (ground_truth, tracks))
    a, b = (_places(part.rows, similarity) for part in (people, theirs))
    classes = (people.rows["class_id"], theirs.rows["class_id"]) if by_class else None
    none = np.empty(0, np.intp)
    parts = [(none, none, none, np.empty(0))]
    step = max(1, round(_PAIRS_AT_ONCE / max(1.0, len(a) * len(b) / max(1, len(ground_truth)) ** 2)))
    for first in range(0, len(ground_truth), step):
        ends = (people.ends[first : first + step + 1], theirs.ends[first : first + step + 1])
        frame, row, column, alike = _similarities(a, b, *ends, similarity, gate, classes)
        parts.append((frame + first, row, column, alike))
    frame, row, column, alike = (np.concatenate(part) for part in zip(*parts, strict=True))
    matched = Matchup(
        tuple(np.split(people.track, people.ends[1:-1])),
        tuple(np.split(theirs.track, theirs.ends[1:-1])),
        SparseTables(frame, row, column, alike, people.ends, theirs.ends),
        0.5 if similarity == "metres" else gate,
        len(people.ids),
        len(theirs.ids),
    )
    return RowComparison(matched, people, theirs)


def _places(rows: Rows, similarity: Similarity) -> Floats:
    """The boxes or positions of rows that a similarity compares."""
    if similarity == "metres":
        return on_ground(rows)
    return columns_to_boxes(rows) if similarity == "iou" else columns_to_oriented_boxes(rows)


def _locate(frames: Sequence[Frame], similarity: Similarity) -> LocatedRows:
    joined = join_frames(TRACKS, frames)
    rows, ends = joined.rows, joined.ends
    usable = _have_positions(rows, similarity)
    if not usable.all():
        ends, rows = np.concatenate([[0], usable.cumsum()])[ends], rows[usable]
    ids, track = np.unique(rows["track_id"], return_inverse=True)
    return LocatedRows(rows, track, ids, ends)


def _similarities(
    a: Floats,
    b: Floats,
    a_ends: Ints,
    b_ends: Ints,
    similarity: Similarity,
    gate: float,
    classes: tuple[Ints, Ints] | None,
) -> tuple[Ints, Ints, Ints, Floats]:
    """The pairs of boxes or positions ``a`` and ``b`` in some frames that are alike: their frames, counted from the
    first of these, their numbers in ``a`` and ``b``, and their similarities above 0.

    Pairs of different ``classes`` have none.
    """
    a_counts, b_counts = np.diff(a_ends), np.diff(b_ends)
    if a_counts.dot(b_counts) > _PAIRS_AT_ONCE:
        of = group_index(a_counts), group_index(b_counts)
        a_reach, b_reach = (
            _reach(part[ends[0] : ends[-1]], similarity, gate) for part, ends in ((a, a_ends), (b, b_ends))
        )
        row, column = touching_pairs(a_reach, b_reach, *of)
        frame = of[0][row]
    else:
        frame, row, column = cross_pairs(a_counts, b_counts)
    row, column = row + a_ends[0], column + b_ends[0]
    if similarity != "metres":
        alike = _OVERLAPS[similarity](a[row], b[column])
    else:
        apart = a[row] - b[column]
        alike = metrics.metres_to_similarity(np.hypot(apart[:, 0], apart[:, 1]), gate)
    if classes is not None:
        alike = np.where(classes[0][row] == classes[1][column], alike, 0.0)
    at = alike.nonzero()[0]
    return frame[at], row[at], column[at], alike[at]


def _reach(places: Floats, similarity: Similarity, gate: float) -> Floats:
    """Rectangles (N, 4) around boxes or positions, which touch for any two that are similar."""
    if similarity == "iou":
        return np.concatenate([places[:, :2], places[:, :2] + places[:, 2:]], axis=1)
    around = np.full(len(places), gate) if similarity == "metres" else np.hypot(places[:, 3], places[:, 4]) / 2
    around = (around * (1 + 1e-9))[:, None]
    return np.concatenate([places[:, :2] - around, places[:, :2] + around], axis=1)


# Classes of ground truth and tracks, brought to common numbers, so that only objects of one class are matched.
#
# Channels number their classes themselves, so classes are the same where their names are, or where data sets and
# drivers name one kind of object differently: REGULAR_VEHICLE and car.


_SHOWN: Final = 8


class SharedClasses(NamedTuple):
    """Ground truth and tracks with the same numbers of classes: those of the ground truth.

    ``names`` are the classes of the ground truth by number; it is empty if classes are not told apart, because there is
    only one or because one side has none. ``notes`` say what is not compared.
    """

    ground_truth: list[Frame]
    tracks: list[Frame]
    names: Mapping[int, str]
    notes: tuple[str, ...]


def share_classes(
    name: str,
    tracks_name: str,
    ground_truth: Sequence[Frame],
    tracks: Sequence[Frame],
    ground_truth_names: Mapping[int, str],
    track_names: Mapping[int, str],
) -> SharedClasses:
    """Bring the classes of ground truth and tracks together.

    Parameters
    ----------
    name, tracks_name : str
        Names of the sequence and of the tracks, for the note.
    ground_truth, tracks : sequence of Frame
        Rows of Tracks.
    ground_truth_names, track_names : mapping of int to str
        Names of the classes of each by number.

    Returns
    -------
    SharedClasses
        Tracks of classes that the ground truth doesn't have are left out. Where one side states no classes at all, rows
        are as they were.
    """
    true_numbers, numbers = (_numbers(frames) for frames in (ground_truth, tracks))
    if not any(true_numbers) or not any(numbers):
        notes = []
        if true_numbers and numbers and max(len(true_numbers), len(numbers)) > 1:
            side = tracks_name if any(true_numbers) else "the ground truth"
            notes.append(f"{name}: {side} states no classes; objects of all classes are compared with one another")
        return SharedClasses(list(ground_truth), list(tracks), {}, tuple(notes))
    first: dict[str | int, int] = {}
    for number in true_numbers:
        first.setdefault(_key(number, ground_truth_names), number)  # two numbers with one name are one class
    places = {number: first[_key(number, ground_truth_names)] for number in true_numbers}
    keys = {number: _key(number, track_names) for number in numbers}
    alike = _same_kind(first.keys(), keys.values())
    places_of_tracks = {number: first.get(alike.get(key, key)) for number, key in keys.items()}
    names = {number: class_name(number, ground_truth_names) for number in first.values()}
    beyond = [number for number, place in places_of_tracks.items() if place is None]
    notes = []
    if alike:
        listed = ", ".join(f"{class_name(first[true_class], names)} with {here}" for here, true_class in alike.items())
        notes.append(f"{name}: classes of one kind of object are compared, whatever their names: {listed}")
    if beyond:
        listed = _counted(tracks, beyond, track_names)
        notes.append(
            f"{name}: rows of {tracks_name} of classes that the ground truth doesn't have are not compared: {listed}"
        )
    if missed := [number for number in true_numbers if places[number] not in places_of_tracks.values()]:
        listed = _counted(ground_truth, missed, ground_truth_names)
        notes.append(
            f"{name}: {tracks_name} has no tracks of classes that the ground truth has; all are misses: {listed}"
        )
    return SharedClasses(
        _renumbered(ground_truth, places),
        _renumbered(tracks, places_of_tracks),
        names if len(names) > 1 else {},
        tuple(notes),
    )


def _same_kind(ground_truth: Collection[str | int], tracks: Collection[str | int]) -> dict[str | int, str | int]:
    """Match classes of different names by kind of object: the ground truth's key by each key of the tracks.

    Only kinds that each side has one class of count: a van is no taxi where there are cars, too.
    """

    def by_kind(keys: Collection[str | int]) -> dict[str, set[str]]:
        kinds: dict[str, set[str]] = {}
        for key in keys:
            if isinstance(key, str) and (kind := limits_row(key)) != UNKNOWN:
                kinds.setdefault(kind, set()).add(key)
        return kinds

    true_kinds, here = by_kind(ground_truth), by_kind(tracks)
    single = [kind for kind in sorted(true_kinds.keys() & here.keys()) if len(true_kinds[kind]) == len(here[kind]) == 1]
    pairs = ((next(iter(here[kind])), next(iter(true_kinds[kind]))) for kind in single)
    return {key: other for key, other in pairs if key != other}


def _counted(frames: Sequence[Frame], numbers: Sequence[int], names: Mapping[int, str]) -> str:
    """The rows of some classes in words, the most frequent class first."""
    counts = {kind: sum(int((frame.rows["class_id"] == kind).sum()) for frame in frames) for kind in numbers}
    counted = [f"{counts[kind]} of {class_name(kind, names)}" for kind in sorted(numbers, key=lambda n: -counts[n])]
    return ", ".join(counted[:_SHOWN]) + (f" and {len(counted) - _SHOWN} more classes" if len(counted) > _SHOWN else "")


def of_class(frames: Sequence[Frame], number: int) -> list[Frame]:
    """The rows of a class; frames without any stay, empty."""
    return [frame._replace(rows=frame.rows[frame.rows["class_id"] == number]) for frame in frames]


def ids_of_class(frames: Sequence[Frame], number: int) -> Ints:
    """The ids of the tracks that have a class in most of their rows."""
    rows = TRACKS.joined([frame.rows for frame in frames])
    ids, track = np.unique(rows["track_id"].astype(np.int64), return_inverse=True)
    return np.asarray(ids[majority(track, rows["class_id"], len(ids)) == number], np.int64)


def with_ids(frames: Sequence[Frame], ids: Ints) -> list[Frame]:
    """The rows of tracks with these ids; frames without any stay, empty."""
    return [frame._replace(rows=frame.rows[np.isin(frame.rows["track_id"], ids)]) for frame in frames]


def _numbers(frames: Sequence[Frame]) -> list[int]:
    parts = [np.unique(frame.rows["class_id"]) for frame in frames if len(frame.rows)]
    return [int(number) for number in np.unique(np.concatenate([np.empty(0, np.uint32), *parts]))]


def _key(number: int, names: Mapping[int, str]) -> str | int:
    """The key of a class, the same in all channels: its name, or its number if it has none."""
    name = names.get(number, "").strip().casefold()
    return "person" if is_person(name) or (number == PERSON and not name) else name or number


def _renumbered(frames: Sequence[Frame], places: Mapping[int, int | None]) -> list[Frame]:
    """Frames with other numbers of classes; rows of classes without a place are left out."""
    if all(number == place for number, place in places.items()):
        return list(frames)
    out = []
    for frame in frames:
        new = np.array(
            [-1 if (to := places[number]) is None else to for number in frame.rows["class_id"].tolist()], np.int64
        )
        rows = frame.rows[new >= 0].copy()
        rows["class_id"] = new[new >= 0]
        out.append(frame._replace(rows=rows))
    return out
