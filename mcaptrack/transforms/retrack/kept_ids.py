"""Online re-tracking of tracks in metres: input ids are kept.

A tracker of 3D boxes associates in metres and at the boxes' own rate, which is more than samples can add. What is left
is done offline: to link tracks over long gaps, to leave out false ones, and to smooth. Letters: R rows, K tracks.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.schema import Frame
from mcaptrack.transforms.forecasts import Forecaster
from mcaptrack.transforms.retrack.assignments import Assignments
from mcaptrack.transforms.retrack.by_class import Movers
from mcaptrack.transforms.retrack.motion_model import DEFAULT_NOISE_M
from mcaptrack.transforms.retrack.options import RetrackOptions
from mcaptrack.transforms.retrack.samples import LogSamples, OnlineOutputs


class KeptIds:
    """Tracks as their input has them: ``step`` for each frame, then ``outputs``."""

    def __init__(self, options: RetrackOptions, movers: Movers) -> None:
        self._options = options
        self.noise_m = (DEFAULT_NOISE_M if options.noise_m is None else options.noise_m) / movers.unit_m
        self.assignments = Assignments()
        self.samples = LogSamples()
        self.steps: list[int] = []
        self._last_ns = 0
        self._number: dict[int, int] = {}
        self._outputs = OnlineOutputs()
        self._forecaster = Forecaster(
            options.predictor,
            options.horizon_s,
            options.min_history,
            options.rate_hz,
            options.class_names,
            options.class_limits,
        )

    def step(self, frame: Frame) -> None:
        """One step: samples go to the track of their input id."""
        passed = 1
        if self.steps:
            passed = max(1, round((frame.t_ns - self._last_ns) * self._options.rate_hz / NS_PER_S))
        self.steps.append(self.steps[-1] + passed if self.steps else 0)
        self._last_ns = frame.t_ns
        order = np.argsort(frame.rows["track_id"], kind="stable")
        rows = frame.rows[order]
        self.samples.add(frame._replace(rows=rows))
        own = [self._number.setdefault(one, len(self._number) + 1) for one in rows["track_id"].tolist()]
        self.assignments.add(self.steps[-1], np.array(own, np.int64), rows["track_id"])
        online = frame._replace(rows=rows.copy())
        online.rows["source_id"], online.rows["track_id"] = rows["track_id"], own
        self._outputs.add(online, frame._replace(rows=self._forecaster.predict(online)))

    def outputs(self) -> Iterator[tuple[Frame, Frame]]:
        """For each step the online tracks and their predictions, from the past alone."""
        return iter(self._outputs)
