"""Resample tracks: from the times of the video to a fixed rate, and from pixels to metres on the ground.

Sample times start at the first frame of the log, and again at the first one after a jump of its clock. Later stages
depend neither on the frame rate nor on pixels.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.boxes import columns_to_boxes
from mcaptrack.geometry.clocks import NS_PER_S, RegularClock, seconds_to_ns
from mcaptrack.geometry.plane import Planes, plane_at
from mcaptrack.notices import warn
from mcaptrack.schema import TRACKS, Frame, Rows, Schema
from mcaptrack.schema.frame_columns import FrameCollector
from mcaptrack.schema.framing import frame_numbers, frame_times, split_rows
from mcaptrack.schema.resampling import resample_parts
from mcaptrack.transforms.protocol import context, option, parameters


@dataclass(frozen=True, kw_only=True)
@parameters
class Sample:
    """Resample tracks to a fixed rate, in metres on the ground.

    Reads tracks, writes tracks: one row per person and sample time; ``observed`` is false where a gap was interpolated.

    Parameters
    ----------
    rate_hz : float
        Samples per second.
    max_gap_s : float
        Gaps in a track of up to this many seconds are interpolated.

    Examples
    --------
    A person walks 1 m/s at 10 frames a second; a gap of 1 s is interpolated:

    >>> from mcaptrack.schema import TRACKS, Frame
    >>> def row(t):
    ...     return TRACKS.rows(track_id=[1], x_m=[t / 10], y_m=[0.0], observed=[True], source_id=[-1])
    >>> frames = [Frame(t * 100_000_000, t, row(t) if not 5 < t < 15 else TRACKS.empty()) for t in range(21)]
    >>> samples = [frame.rows for (frame,) in Sample(rate_hz=2.5)(frames)]
    >>> [round(float(rows["x_m"][0]), 3) for rows in samples]
    [0.0, 0.4, 0.8, 1.2, 1.6, 2.0]
    >>> [bool(rows["observed"][0]) for rows in samples]
    [True, True, False, False, True, True]
    """

    rate_hz: float = option(2.5, least=0.1, most=1000.0)
    max_gap_s: float = option(2.0, least=0.0)
    start_ns: int | None = context(lambda: None)
    ground_planes: Planes = context(tuple)

    reads: ClassVar[Schema] = TRACKS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": TRACKS})

    @property
    def latency_s(self) -> MappingProxyType[str, float]:
        """A sample is final once no later detection can close a gap around it."""
        return MappingProxyType({"": max(self.max_gap_s, 2 / self.rate_hz)})

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        kept, left_out = FrameCollector(TRACKS), 0
        for frame in frames:
            rows = _in_metres(frame, self.ground_planes)
            kept.append(frame._replace(rows=rows))
            left_out += len(frame.rows) - len(rows)
        if left_out:
            warn(f"{left_out:,} rows of tracks are above the horizon of the ground plane, and are left out", "left-out")
        in_metres = kept.done()
        if not len(in_metres):
            return
        frame_ns, indices = frame_times(in_metres), frame_numbers(in_metres)
        start_ns, step_ns = int(frame_ns[0]) if self.start_ns is None else self.start_ns, NS_PER_S / self.rate_hz
        limit_ns = max(seconds_to_ns(self.max_gap_s), round(2 * step_ns))  # longer gaps have no ticks
        tick_ns = RegularClock.of(frame_ns, start_ns, step_ns, limit_ns / NS_PER_S).ticks(frame_ns, limit_ns)
        picture = indices[np.searchsorted(frame_ns, tick_ns, "right") - 1]  # the last one at each sample time
        for first, last, rows, at in resample_parts(in_metres, tick_ns, seconds_to_ns(self.max_gap_s)):
            rows["source_id"] = rows["track_id"]
            ends = np.searchsorted(at, np.arange(first, last), "right")
            sampled = split_rows(tick_ns[first:last].tolist(), picture[first:last].tolist(), rows, ends)
            yield from ((frame,) for frame in sampled)

    def why_empty(self, given: Sequence[Frame], made: Sequence[Frame]) -> str:
        """Why there are no samples, for a warning."""
        return "no track lasts for two sample times, or none stands on the ground plane"


def _in_metres(frame: Frame, planes: Planes) -> Rows:
    """The rows with missing x_m, y_m computed from their boxes; rows above the horizon are left out.

    Raises McaptrackError if rows have no positions in metres and there is no ground plane.
    """
    rows = frame.rows
    missing = np.isnan(rows["x_m"])
    if not missing.any():
        return rows
    plane = plane_at(planes, frame.t_ns)
    if plane is None:
        raise McaptrackError("tracks are in pixels, and there is no ground plane to convert them to metres")
    rows = rows.copy()
    xy_m = plane.boxes_to_metres(columns_to_boxes(rows[missing]))
    rows["x_m"][missing], rows["y_m"][missing] = xy_m.T
    on_ground: Rows = rows[np.isfinite(rows["x_m"])]
    return on_ground
