"""Compare tracks that people have corrected with the channel that was corrected.

Letters: N rows of one side, P pairs.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from mcaptrack import log
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.assignment import assign_by_gain
from mcaptrack.geometry.boxes import columns_to_boxes, iou
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.classes import class_name, class_names, is_person
from mcaptrack.sources.corrections import CORRECTED, CORRECTED_FROM

#: Boxes are the same object from this overlap on.
_SAME_IOU: Final = 0.3
#: Boxes were moved if a corner is farther away than this: annotation tools interpolate between keyframes.
MOVED_PX: Final = 2.0
#: A track is joined or split if each part has at least so many boxes; fewer may be boxes that were matched by chance.
_LEAST_BOXES: Final = 2
_SHOWN: Final = 5


@dataclass(frozen=True)
class Changes:
    """Corrections compared with the channel ``of``, in the ``frames`` that both have.

    ``same``, ``moved``, ``added`` and ``removed`` are numbers of boxes. ``joined`` are corrected ids with the ids that
    they are of, ``split`` ids with the corrected ids that they became; ``new_tracks`` and ``removed_tracks`` are ids.
    ``relabelled`` are corrected ids with the names of the class that their boxes had, and of the one that they have.
    """

    of: str
    frames: int
    same: int
    moved: int
    added: int
    removed: int
    joined: dict[int, list[int]]
    split: dict[int, list[int]]
    new_tracks: list[int]
    removed_tracks: list[int]
    relabelled: dict[int, tuple[str, str]]

    @property
    def words(self) -> str:
        """All in one line."""
        parts = [f"{self.same} boxes as they were"]
        parts += [f"{n} {what}" for n, what in ((self.moved, "moved"), (self.added, "added")) if n]
        parts += [f"{self.removed} removed"] if self.removed else []
        parts += [f"tracks {_listed(ids)} joined to {track}" for track, ids in list(self.joined.items())[:_SHOWN]]
        parts += [f"track {track} split into {_listed(ids)}" for track, ids in list(self.split.items())[:_SHOWN]]
        more = max(len(self.joined) - _SHOWN, 0) + max(len(self.split) - _SHOWN, 0)
        parts += [f"{more} more joined or split"] if more else []
        changed: dict[tuple[str, str], list[int]] = {}
        for track, classes in self.relabelled.items():
            changed.setdefault(classes, []).append(track)
        shown = list(changed.items())
        parts += [
            f"track{'s' * (len(ids) > 1)} {_listed(ids)} from {was} to {now}" for (was, now), ids in shown[:_SHOWN]
        ]
        parts += [f"{len(shown) - _SHOWN} more changes of class"] if len(shown) > _SHOWN else []
        parts += [f"new tracks {_listed(self.new_tracks)}"] if self.new_tracks else []
        parts += [f"tracks {_listed(self.removed_tracks)} removed"] if self.removed_tracks else []
        return f"of {self.of}, in {self.frames} frames: {', '.join(parts)}"

    def to_json(self) -> dict[str, Any]:
        """All values, as JSON has them."""
        return asdict(self)


def _listed(ids: Sequence[int]) -> str:
    return ", ".join(map(str, ids[:_SHOWN])) + (f" and {len(ids) - _SHOWN} more" if len(ids) > _SHOWN else "")


def changes_in(opened: log.Log, topic: str) -> Changes | None:
    """Compare the corrections at ``topic`` with their tracks; None if the log has no tracks that they could be of.

    They are of the re-tracked boxes of their camera, or of its tracks if the ids fit those better.
    """
    prefix = topic.removesuffix(f"/{CORRECTED}")
    present = [name for below in CORRECTED_FROM if opened.holds(name := f"{prefix}/{below}", TRACKS)]
    corrected = opened.frame_columns(topic, TRACKS)
    classes = {name: class_names(opened.channel(name).metadata) for name in (*present, topic)}
    compared = [
        compare(source, opened.frame_columns(source, TRACKS), corrected, classes[source], classes[topic])
        for source in present
    ]
    return max(compared, key=lambda result: result[1])[0] if compared else None


def compare(
    of: str,
    before: Sequence[Frame],
    after: Sequence[Frame],
    classes: Mapping[int, str] = {},
    corrected_classes: Mapping[int, str] = {},
) -> tuple[Changes, int]:
    """Compare tracks with their corrections, frame by frame; also return the number of boxes with the id they had.

    ``classes`` and ``corrected_classes`` are the names of classes of both.
    """
    counts = np.zeros(4, np.int64)  # same, moved, added, removed
    kept, frames = 0, 0
    parts: dict[tuple[int, int], int] = defaultdict(int)
    labels: dict[int, Counter[tuple[str, str]]] = defaultdict(Counter)
    ids: tuple[set[int], set[int]] = set(), set()
    for old, new in _pairs(before, after):
        frames += 1
        i, j = _matched(old, new)
        corners = [columns_to_boxes(rows) for rows in (old[i], new[j])]
        for boxes in corners:
            boxes[:, 2:] += boxes[:, :2]
        is_moved = (np.abs(corners[0] - corners[1]) > MOVED_PX).any(axis=1)
        counts += (int((~is_moved).sum()), int(is_moved.sum()), len(new) - len(j), len(old) - len(i))
        for pair in zip(old["track_id"][i].tolist(), new["track_id"][j].tolist(), strict=True):
            parts[pair] += 1
        kinds = zip(new["track_id"][j].tolist(), old["class_id"][i].tolist(), new["class_id"][j].tolist(), strict=True)
        for track, was, now in kinds:
            labels[track][_class(was, classes), _class(now, corrected_classes)] += 1
        kept += int((old["track_id"][i] == new["track_id"][j]).sum())
        ids[0].update(old["track_id"].tolist())
        ids[1].update(new["track_id"].tolist())
    became: dict[int, list[int]] = defaultdict(list)
    made_of: dict[int, list[int]] = defaultdict(list)
    for (track, other), count in sorted(parts.items()):
        if count >= _LEAST_BOXES:
            became[track].append(other)
            made_of[other].append(track)
    same, moved, added, removed = counts.tolist()
    usual_labels = ((track, of_track.most_common(1)[0][0]) for track, of_track in sorted(labels.items()))
    changes = Changes(
        of, frames, same, moved, added, removed,
        {track: parts_of for track, parts_of in sorted(made_of.items()) if len(parts_of) > 1},
        {track: parts_of for track, parts_of in sorted(became.items()) if len(parts_of) > 1},
        sorted(ids[1] - {other for _, other in parts}), sorted(ids[0] - {track for track, _ in parts}),
        {track: usual for track, usual in usual_labels if len(set(usual)) > 1},
    )  # fmt: skip
    return changes, kept


def _class(number: int, names: Mapping[int, str]) -> str:
    """The name of a class; "person" for every name of people."""
    name = class_name(number, names)
    return "person" if is_person(name) else name


def _pairs(before: Sequence[Frame], after: Sequence[Frame]) -> Iterator[tuple[Rows, Rows]]:
    """The boxes of both sides in each frame that both have, in order of time."""
    rest = iter(after)
    new = next(rest, None)
    for old in before:
        while new is not None and new.t_ns < old.t_ns:
            new = next(rest, None)
        if new is not None and new.t_ns == old.t_ns:
            yield _with_boxes(old.rows), _with_boxes(new.rows)


def _with_boxes(rows: Rows) -> Rows:
    out: Rows = rows[np.isfinite(columns_to_boxes(rows)).all(axis=1)]
    return out


def _matched(old: Rows, new: Rows) -> tuple[Ints, Ints]:
    """The rows (P,) of both sides that are the same object: by overlap, with some preference for the same id.

    Boxes with the same id that are left over are the same object, too, however far a person has moved them.
    """
    if not len(old) or not len(new):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    overlap = iou(columns_to_boxes(old), columns_to_boxes(new))
    gain = np.where(overlap >= _SAME_IOU, overlap + 0.1 * (old["track_id"][:, None] == new["track_id"][None]), -1.0)
    i, j = assign_by_gain(gain)
    good = gain[i, j] > 0
    i, j = i[good], j[good]
    _, left, moved = np.intersect1d(np.delete(old["track_id"], i), np.delete(new["track_id"], j), return_indices=True)
    others = np.delete(np.arange(len(old)), i)[left], np.delete(np.arange(len(new)), j)[moved]
    return np.concatenate([i, others[0]]), np.concatenate([j, others[1]])
