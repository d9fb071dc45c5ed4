"""Online re-tracking of tracks in metres: input ids are kept.

A tracker of 3D boxes associates in metres and at the boxes' own rate, which is more than samples can add. What is left
is done offline: to link tracks over long gaps, to leave out false ones, and to smooth. Letters: R rows, K tracks.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mcaptrack.geometry.arrays import Ints
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import TRACKS, Frame
from mcaptrack.schema.frame_columns import FrameCollector, FrameColumns
from mcaptrack.schema.framing import joined_parts
from mcaptrack.transforms.forecasts import Forecaster
from mcaptrack.transforms.retrack.assignments import Assignments
from mcaptrack.transforms.retrack.by_class import Movers
from mcaptrack.transforms.retrack.motion_model import DEFAULT_NOISE_M
from mcaptrack.transforms.retrack.options import RetrackOptions
from mcaptrack.transforms.retrack.samples import LogSamples


class KeptIds:
    """Tracks as their input has them.

    Parameters
    ----------
    options : RetrackOptions
    movers : Movers
    frames : FrameColumns
        Samples of tracks; each goes to the track of its input id.
    """

    def __init__(self, options: RetrackOptions, movers: Movers, frames: FrameColumns) -> None:
        self._options = options
        self.noise_m = (DEFAULT_NOISE_M if options.noise_m is None else options.noise_m) / movers.unit_m
        self.assignments = Assignments()
        self.samples = LogSamples()
        self.steps: list[int] = []
        self._number: dict[int, int] = {}
        self._forecaster = Forecaster(
            options.predictor,
            options.horizon_s,
            options.min_history,
            options.rate_hz,
            options.class_names,
            options.class_limits,
            adapt=options.follows_log,
        )
        self.online = self._read(frames)

    def _read(self, frames: FrameColumns) -> FrameColumns:
        """The online tracks: frames with the samples under numbers of their own."""
        out = FrameCollector(TRACKS)
        last_ns: int | None = None
        for low, high, joined in joined_parts(TRACKS, frames):
            for t_ns in joined.t_ns.tolist():
                passed = 1 if last_ns is None else round((t_ns - last_ns) * self._options.rate_hz / NS_PER_S)
                self.steps.append(self.steps[-1] + max(1, passed) if self.steps else 0)
                last_ns = t_ns
            rows = joined.rows.take(np.lexsort((joined.rows["track_id"], joined.frame)))
            numbers = frames.numbers[low:high]
            self.samples.extend(joined.t_ns, numbers, joined.ends, rows)
            source = rows["track_id"].copy()
            own = self._numbers(source)
            self.assignments.add(np.array(self.steps[low:high], np.int64)[joined.frame], own, source)
            online = rows.copy()
            online["source_id"], online["track_id"] = source, own
            out.extend(joined.t_ns, numbers, joined.ends, online)
        return out.done()

    def _numbers(self, source: Ints) -> Ints:
        """The number of the track of each input id (R,): from 1 on in the order in which they come."""
        ids, first, which = np.unique(source, return_index=True, return_inverse=True)
        for one in ids[np.argsort(first)].tolist():
            self._number.setdefault(one, len(self._number) + 1)
        return np.array([self._number[one] for one in ids.tolist()], np.int64)[which]

    def predictions(self) -> FrameColumns:
        """The predictions of the online tracks, from the past alone."""
        return self._forecaster.predict_all(self.online)

    def outputs(self) -> Iterator[tuple[Frame, Frame]]:
        """For each step the online tracks and their predictions."""
        return zip(self.online, self.predictions(), strict=True)
