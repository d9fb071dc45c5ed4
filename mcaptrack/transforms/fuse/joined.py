"""Boxes of several cameras joined to groups, many frames at once: for few boxes, calls take longer than computing.

Letters: F frames, N boxes, G groups, C cameras.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from mcaptrack.geometry.arrays import Bools, Floats, Ints
from mcaptrack.geometry.plane import runs_of_planes
from mcaptrack.geometry.ragged import group_index
from mcaptrack.schema import COVARIANCE_M2, SIGHTINGS, Frame, Rows
from mcaptrack.transforms.fuse.grouping import Places, group, means
from mcaptrack.transforms.fuse.view import CameraView, Views

#: The size of tables with a row for each frame and a column for each of its boxes: frames are joined in such blocks.
_BLOCK: Final = 8192


class Joined(NamedTuple):
    """Frames of sightings, and the groups that their boxes are joined to.

    ``rows`` (N,) are those of all frames, ordered by frame, camera and box; ``counts`` (F,) the number of each frame.
    ``of`` (N,) is the group of each box. Groups are ordered by frame, ``frame`` (G,), then by class; ``centre`` has
    their places, ``seen`` (G, C) the cameras that see them, and ``visible`` (G, C) the share of a person there that is
    visible to each camera with a view.
    """

    frames: Sequence[Frame]
    rows: Rows
    counts: Ints
    of: Ints
    frame: Ints
    centre: Places
    seen: Bools
    visible: Floats


def places_of(rows: Rows) -> Places:
    """The places of sightings (N,)."""
    xy_m = np.stack([rows["x_m"], rows["y_m"]], axis=-1)
    return Places(xy_m, np.stack([rows[name] for name in COVARIANCE_M2], axis=-1))


def joined(frames: Iterable[Frame], views: Views, max_sigma: float, max_distance_m: float) -> Iterator[Joined]:
    """Join the boxes of each frame, of those that are at most so far apart (see ``FootFuser``); block by block."""
    for block in _blocks(frames):
        counts = np.array([len(frame.rows) for frame in block], np.int64)
        rows, number = SIGHTINGS.joined([frame.rows for frame in block]), group_index(counts)
        order = np.lexsort((rows["box_row"], rows["camera"], number))
        rows = rows[order]
        # Objects of different frames or classes are never joined.
        classes, kind = np.unique(rows["class_id"], return_inverse=True)
        part = number * max(len(classes), 1) + kind
        places, camera = places_of(rows), rows["camera"].astype(np.int64)
        of = group(camera, places, max_sigma**2, max_distance_m, part)
        count = int(of.max(initial=-1)) + 1
        part_of = np.empty(count, np.int64)
        part_of[of] = part
        by_part = np.argsort(part_of, kind="stable")
        place = np.empty(count, np.int64)
        place[by_part] = np.arange(count)
        of, frame = place[of], part_of[by_part] // max(len(classes), 1)
        centre = means(places, of, count)
        seen = np.zeros((count, max(len(views), int(camera.max(initial=0)) + 1)), bool)
        seen[of, camera] = True
        visible = np.empty((count, len(views)))
        sizes, times = np.bincount(frame, minlength=len(block)), [one.t_ns for one in block]
        for column, view in enumerate(views):
            visible[:, column] = _visible(view, centre.xy_m, sizes, times)
        yield Joined(block, rows, counts, of, frame, centre, seen, visible)


def _blocks(frames: Iterable[Frame]) -> Iterator[list[Frame]]:
    """Frames in blocks, none of which has a much larger frame than others."""
    block: list[Frame] = []
    most = 0
    for frame in frames:
        most = max(most, len(frame.rows), 1)
        if block and (len(block) + 1) * most > _BLOCK:
            yield block
            block, most = [], max(len(frame.rows), 1)
        block.append(frame)
    if block:
        yield block


def _visible(view: CameraView, xy_m: Floats, sizes: Ints, times: Sequence[int]) -> Floats:
    """The share of a person at each place (G, 2) that a camera sees; places are of frames with ``sizes`` (F,)."""
    if len(view.planes) < 2:
        return view.visible(xy_m, times[0], sizes)
    ends = np.cumsum(sizes)
    out = np.empty(len(xy_m))
    for low, high in runs_of_planes(view.planes, times):
        part = slice(int(ends[low] - sizes[low]), int(ends[high - 1]))
        out[part] = view.visible(xy_m[part], times[low], sizes[low:high])
    return out
