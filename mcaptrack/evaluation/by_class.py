"""Classes of ground truth and tracks, brought to common numbers, so that only objects of one class are matched.

Channels number their classes themselves, so classes are the same where their names are, or where data sets and drivers
name one kind of object differently: REGULAR_VEHICLE and car.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Ints
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.classes import PERSON, class_name, is_person, majority
from mcaptrack.transforms.motion_limits import UNKNOWN, limits_row

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
