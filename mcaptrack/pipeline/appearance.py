"""Descriptors of tracks in the pictures of their camera, for transforms that compare what tracks look like.

They are held in memory during the run. What is written, on request, are the means of each track.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.colour_histograms import LENGTH, at_border, describe, is_clear
from mcaptrack.notices import warn
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.framing import frame_times, has_any
from mcaptrack.sources.cameras import camera_at
from mcaptrack.sources.pictures import Pictures
from mcaptrack.transforms import Transform
from mcaptrack.transforms.retrack.appearance import Descriptors

#: The name under which progress is reported.
STAGE: Final = "appearance"
#: The picture that shows a sample is at most this far away: people have hardly moved.
_NEAR_NS: Final = NS_PER_S // 10
#: After so many pictures in a row that can't be decoded, it is taken that none can be.
_MOST_IN_A_ROW: Final = 20


def with_descriptors(
    transform: Transform,
    opened: log.Log,
    prefix: str,
    frames: Sequence[Frame],
    progress: Callable[[str, int, int], None] = lambda *_: None,
    keep: Collection[str] | None = None,
) -> Transform:
    """Return a transform of tracks that compares what these look like, or writes it, with descriptors of ``frames``,
    its input; any other transform as it is.

    Boxes are in pixels of the picture of their time. ``progress`` is called as by ``run``; ``keep`` are the outputs
    that are written, None for all. Pictures that can't be decoded are left out, with a warning; so is what the user
    asked for and the log doesn't allow.
    """
    compares, stores = getattr(transform, "appearance", False), getattr(transform, "store_appearance", False)
    if compares is False and not stores:
        return transform
    topic, found = camera_at(opened, prefix).pictures, None
    why = _why_not(transform, frames, keep) if topic else f"the log has no pictures of {prefix}"
    if topic and not why:
        found, why = _descriptors(opened, topic, frames, progress)
    if compares and why:
        warn(f"`appearance=` changes nothing here: {why}", "option-not-used")
    if stores and why:
        warn(f"`store_appearance=` finds nothing to write: {why}", "option-not-used")
    return transform if found is None else replace(transform, descriptors=found)


def _why_not(transform: Transform, frames: Sequence[Frame], keep: Collection[str] | None) -> str:
    """Return why pictures are of no use; "" if they are."""
    if keep is not None and all(transform.latency_s.get(one) != float("inf") for one in keep):
        return "tracks that use the past alone (online) don't look at pictures"
    if getattr(transform, "leaves_unchanged", False) and not getattr(transform, "links_in_picture", False):
        return "tracks are left as they are"
    if not has_any(TRACKS, frames, lambda rows: rows["observed"] & np.isfinite(rows["x_px"])):
        return "the tracks have no boxes in pictures"
    return ""


def _descriptors(
    opened: log.Log, topic: str, frames: Sequence[Frame], progress: Callable[[str, int, int], None]
) -> tuple[Descriptors | None, str]:
    """Return what is seen of ``frames`` in the pictures of a channel; or None, and why not."""
    damaged: list[McaptrackError] = []
    try:
        pictures = Pictures(opened, topic)
        nearest = _nearest(pictures.t_ns, frame_times(frames))
        parts = list(_described(pictures, frames, nearest, partial(progress, STAGE), damaged))
        if damaged and not parts:
            raise damaged[0]
    except McaptrackError as error:
        warn(f"colours of clothes are not compared (appearance): {error}", "option-not-used")
        return None, "pictures can't be decoded"
    if damaged:
        count = f"{len(damaged)} of {len(np.unique(nearest[nearest >= 0]))} pictures"
        warn(f"colours of clothes are compared without {count} that can't be decoded, the first: {damaged[0]}", "lost")
    if not parts:
        return None, f"no picture of {topic} is within {_NEAR_NS / NS_PER_S:g} s of a sample"
    return Descriptors(*(np.concatenate(members) for members in zip(*parts, strict=True))), ""


def _nearest(picture_ns: Ints, sample_ns: Ints) -> Ints:
    """The number of the picture that shows each sample time, or -1."""
    if len(picture_ns) == 0:
        return np.full(len(sample_ns), -1)
    after = np.clip(np.searchsorted(picture_ns, sample_ns), 1, max(len(picture_ns) - 1, 1))
    pair = np.stack([after - 1, np.minimum(after, len(picture_ns) - 1)])
    off = np.abs(picture_ns[pair] - sample_ns)
    best = off.argmin(axis=0)
    columns = np.arange(len(sample_ns))
    return np.where(off[best, columns] <= _NEAR_NS, pair[best, columns], -1)


def _described(
    pictures: Pictures,
    frames: Sequence[Frame],
    nearest: Ints,
    progress: Callable[[int, int], None],
    damaged: list[McaptrackError],
) -> Iterator[Descriptors]:
    """For each frame with a picture what is seen in its samples; pictures that can't be decoded add to ``damaged``."""
    shown = np.flatnonzero(nearest >= 0)  # in order of time, as pictures are
    wanted, of_picture = np.unique(nearest[shown], return_index=True)
    decoded = _decodable(pictures, wanted.tolist(), damaged)
    place = dict(zip(wanted.tolist(), shown[of_picture].tolist(), strict=True))
    for done, picture in enumerate(decoded):
        progress(done + 1, len(wanted))
        at = place[picture.index]
        while at < len(frames) and nearest[at] == picture.index:
            frame = frames[at]
            boxes = columns_to_boxes(frame.rows)
            height, width = picture.rows.shape[:2]
            places = np.flatnonzero(frame.rows["observed"] & np.isfinite(boxes).all(axis=1))
            places = places[np.argsort(frame.rows["track_id"][places], kind="stable")]
            boxes, ids = boxes[places], frame.rows["track_id"][places].astype(np.int64)
            clear = is_clear(boxes, width, height)
            values = np.zeros((len(ids), LENGTH), np.uint8)
            values[clear] = describe(picture.rows, boxes[clear])
            yield Descriptors(np.full(len(ids), frame.t_ns), ids, values, clear, at_border(boxes, width, height))
            at += 1


def _decodable(pictures: Pictures, wanted: list[int], damaged: list[McaptrackError]) -> Iterator[Frame]:
    """Those of the ``wanted`` pictures that can be decoded; the errors of the others are added to ``damaged``.

    Raises McaptrackError if many in a row can't be.
    """
    done, in_a_row = 0, 0
    while done < len(wanted):
        try:
            for picture in pictures.frames(wanted[done:]):
                done, in_a_row = bisect_right(wanted, picture.index), 0
                yield picture
            return
        except McaptrackError as error:
            if in_a_row == _MOST_IN_A_ROW:
                raise
            damaged.append(error)
            done, in_a_row = done + 1, in_a_row + 1
