"""Tracks at the video's rate -> tracks on the regular clock of prediction, in metres.

The clock starts at the log's first frame and ticks at a fixed rate. After this stage nothing knows of pixels per metre
or frames per second.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S, seconds_to_ns
from mcaptrack.geometry.plane import Planes, plane_at
from mcaptrack.geometry.ragged import ragged_range
from mcaptrack.schema import TRACKS, Frame, Rows, Schema
from mcaptrack.schema.framing import frame_times
from mcaptrack.schema.resampling import resample
from mcaptrack.transforms.protocol import check_options, context, option


@dataclass(frozen=True, kw_only=True)
class Sample:
    """Resample tracks to a fixed rate, in metres on the ground.

    Reads tracks, writes tracks: one row per person and sample time; ``observed`` is false where a gap was interpolated.
    """

    rate_hz: float = option(2.5, "samples per second", least=0.1, most=1000.0)
    max_hole_s: float = option(2.0, "gaps in a track of up to this many seconds are interpolated", least=0.0)
    start_ns: int | None = context(lambda: None)
    ground_planes: Planes = context(tuple)

    reads: ClassVar[Schema] = TRACKS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": TRACKS})

    def __post_init__(self) -> None:
        check_options(self)

    @property
    def latency_s(self) -> MappingProxyType[str, float]:
        """A tick is certain once nothing can close a hole around it any more."""
        return MappingProxyType({"": max(self.max_hole_s, 2 / self.rate_hz)})

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        members = [frame._replace(rows=_in_metres(frame, self.ground_planes)) for frame in frames]
        if not members:
            return
        frame_ns = frame_times(members)
        indices = np.array([frame.index for frame in members])
        tick_ns = self._ticks(frame_ns, int(frame_ns[0]) if self.start_ns is None else self.start_ns)
        rows, at = resample(members, tick_ns, seconds_to_ns(self.max_hole_s))
        rows["source_id"] = rows["track_id"]
        shown = indices[np.searchsorted(frame_ns, tick_ns, "right") - 1]  # the picture on screen at each tick
        first, last = (np.searchsorted(at, np.arange(len(tick_ns)), side) for side in ("left", "right"))
        for index, t_ns, low, high in zip(*(a.tolist() for a in (shown, tick_ns, first, last)), strict=True):
            yield (Frame(t_ns, index, rows[low:high]),)

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why no rows came of frames, for a warning."""
        return "no track is there at two ticks, or none stands on the ground plane"

    def _ticks(self, frame_ns: Ints, start: int) -> Ints:
        """The ticks between consecutive frames that are at most ``max_hole_s`` apart.

        Tick k is at start + k / rate, to the nanosecond; a log that jumps over a year has no ticks in between.
        """
        period = NS_PER_S / self.rate_hz
        limit = max(seconds_to_ns(self.max_hole_s), round(2 * period))
        ends = np.append(frame_ns[1:], frame_ns[-1])
        ends = np.where(ends - frame_ns <= limit, ends, frame_ns)
        low = np.maximum(np.ceil((frame_ns - start) / period - 0.5).astype(np.int64), 0)
        high = np.maximum(np.floor((ends - start) / period + 0.5).astype(np.int64), -1)
        count = np.maximum(high - low + 1, 0)  # a tick too many at either end goes below
        ticks = ragged_range(low, count)
        tick_ns = start + np.rint(ticks * period).astype(np.int64)
        inside = (tick_ns >= np.repeat(frame_ns, count)) & (tick_ns <= np.repeat(ends, count))
        return np.unique(tick_ns[inside])


def _in_metres(frame: Frame, planes: Planes) -> Rows:
    """The rows with x_m, y_m filled in from the boxes where they are missing; rows off the ground plane left out.

    Raises McaptrackError if there are boxes without metres and no plane to bring them there.
    """
    rows = frame.rows
    missing = np.isnan(rows["x_m"])
    if not missing.any():
        return rows
    plane = plane_at(planes, frame.t_ns)
    if plane is None:
        raise McaptrackError("tracks are in pixels and there is no ground plane to bring them to metres")
    rows = rows.copy()
    xy_m = plane.boxes_to_metres(columns_to_boxes(rows[missing]))
    rows["x_m"][missing], rows["y_m"][missing] = xy_m.T
    on_ground: Rows = rows[np.isfinite(rows["x_m"])]
    return on_ground
