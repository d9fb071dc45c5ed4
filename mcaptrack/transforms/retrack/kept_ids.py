"""Online re-tracking of tracks in metres: input ids are kept.

A tracker of 3D boxes associates in metres and at the boxes' own rate, which is more than samples can add. What is left
is done offline: to link tracks over long gaps, to leave out false ones, and to smooth. Letters: R rows, K tracks.
"""

from __future__ import annotations

import numpy as np

from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import TRACKS, Frame, Rows
from mcaptrack.schema.framing import join_frames, split_rows
from mcaptrack.transforms.forecasts import Forecaster
from mcaptrack.transforms.retrack.assignments import Assignments
from mcaptrack.transforms.retrack.by_class import Movers
from mcaptrack.transforms.retrack.motion_model import DEFAULT_NOISE_M
from mcaptrack.transforms.retrack.options import RetrackOptions


class KeptIds:
    """Tracks as their input has them: ``step`` for each frame, then ``outputs``."""

    def __init__(self, options: RetrackOptions, movers: Movers) -> None:
        self._options = options
        self.noise_m = (DEFAULT_NOISE_M if options.noise_m is None else options.noise_m) / movers.unit_m
        self.assignments = Assignments()
        self.samples: list[Rows] = []
        self.steps: list[int] = []
        self._frames: list[Frame] = []
        self._number: dict[int, int] = {}

    def step(self, frame: Frame) -> None:
        """One step: samples go to the track of their input id."""
        passed = 1
        if self._frames:
            passed = max(1, round((frame.t_ns - self._frames[-1].t_ns) * self._options.rate_hz / NS_PER_S))
        self.steps.append(self.steps[-1] + passed if self.steps else 0)
        order = np.argsort(frame.rows["track_id"], kind="stable")
        rows = frame.rows[order]
        own = [self._number.setdefault(one, len(self._number) + 1) for one in rows["track_id"].tolist()]
        self.assignments.add(self.steps[-1], np.array(own, np.int64), rows["track_id"])
        self.samples.append(rows)
        self._frames.append(frame)

    def outputs(self) -> list[tuple[Frame, Frame]]:
        """For each step the online tracks and their predictions, from the past alone."""
        options = self._options
        forecaster = Forecaster(
            options.predictor,
            options.horizon_s,
            options.min_history,
            options.rate_hz,
            options.class_names,
            options.class_limits,
        )
        frames = [frame._replace(rows=rows) for frame, rows in zip(self._frames, self.samples, strict=True)]
        joined = join_frames(TRACKS, frames)
        rows = joined.rows.copy()
        rows["source_id"] = rows["track_id"]
        rows["track_id"] = [self._number[one] for one in rows["track_id"].tolist()]
        online = split_rows(joined.t_ns, [frame.index for frame in frames], rows, joined.ends[1:])
        return [(frame, frame._replace(rows=forecaster.predict(frame))) for frame in online]
