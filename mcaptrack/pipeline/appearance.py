"""Descriptors of tracks in the pictures of their camera, for transforms that compare what tracks look like.

They are held in memory during the run, and not written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
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


def with_descriptors(
    transform: Transform,
    opened: log.Log,
    prefix: str,
    frames: Sequence[Frame],
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Transform:
    """Return a transform of tracks that compares what these look like with descriptors of ``frames``, its input; any
    other transform as it is.

    Boxes are in pixels of the picture of their time. ``progress`` is called as by ``run``. Pictures that can't be
    decoded are a warning: appearance isn't used then.
    """
    if not getattr(transform, "appearance", False) or getattr(transform, "leaves_unchanged", False):
        return transform
    topic = camera_at(opened, prefix).pictures
    if not topic or not has_any(TRACKS, frames, lambda rows: rows["observed"] & np.isfinite(rows["x_px"])):
        return transform
    try:
        pictures = Pictures(opened, topic)
        nearest = _nearest(pictures.t_ns, frame_times(frames))
        parts = list(_described(pictures, frames, nearest, partial(progress, STAGE)))
    except McaptrackError as error:
        warn(f"colours of clothes are not compared (appearance): {error}", "option-not-used")
        return transform
    if not parts:
        return transform
    descriptors = Descriptors(*(np.concatenate(members) for members in zip(*parts, strict=True)))
    return replace(transform, descriptors=descriptors)


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
    pictures: Pictures, frames: Sequence[Frame], nearest: Ints, progress: Callable[[int, int], None]
) -> Iterator[Descriptors]:
    """For each frame with a picture what is seen in its samples."""
    shown = np.flatnonzero(nearest >= 0)  # in order of time, as pictures are
    wanted, of_picture = np.unique(nearest[shown], return_index=True)
    decoded = pictures.frames(wanted.tolist())
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
