"""The times of a camera's pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.geometry.arrays import Ints
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources import foreign
from mcaptrack.sources.cameras import VIDEO, camera_at


class PictureClock(NamedTuple):
    """The topic of a camera's pictures, None without any; their times, rising, and their stamps (M,) in ns."""

    topic: str | None
    t_ns: Ints
    stamp_ns: Ints


def picture_clock(opened: log.Log, prefix: str, stamps: Mapping[str, Sequence[int]]) -> PictureClock:
    """Return the times of a camera's pictures; ``stamps`` as for ``write``."""
    usual = f"{prefix}/{VIDEO}"
    video = usual if usual in opened.channels else next(iter(stamps), None) or camera_at(opened, prefix).pictures
    picture_ns = opened.times(video) if video else np.empty(0, np.int64)
    video = video if len(picture_ns) else None
    stamp_ns = _stamps(opened, video, stamps.get(video, ())) if video else picture_ns
    return PictureClock(video, picture_ns, stamp_ns)


def _stamps(opened: log.Log, topic: str, known: Sequence[int]) -> Ints:
    """Return the capture times of a channel's pictures in ns, (M,) for M pictures.

    ``known`` are times that were read before. Pictures that were ingested have their capture time as log time; in other
    recordings the messages contain it.
    """
    if Provenance.from_metadata(opened.channel(topic).metadata):
        return opened.times(topic)
    return np.array(known, np.int64) if known else foreign.stamps(opened, topic)
