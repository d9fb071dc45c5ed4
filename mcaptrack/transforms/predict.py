"""Tracks on a regular clock -> where everybody will be.

Letters: N people at one time, T future steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from mcaptrack.clock import NS_PER_S
from mcaptrack.history import Histories
from mcaptrack.predictors import NAMES, PredictorName, check, make
from mcaptrack.schema import PREDICTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.predictions import forecast_to_rows
from mcaptrack.transforms.protocol import check_options, context, option


@dataclass(frozen=True, kw_only=True)
class Predict:
    """Predict where tracked people go.

    Reads samples, writes predictions: one row per track and future step, for tracks with enough past positions.
    """

    predictor: PredictorName = option(
        "red",
        "predictor: cv, holt-cv, kalman, lstm, red; or with weights of your own, red:FILE, lstm:FILE, onnx:FILE",
        names=NAMES,
    )
    horizon_s: float = option(4.8, "how far ahead to predict, in seconds", least=0.1, most=60.0)
    min_history: int = option(
        4, "number of positions, the current one included, that a prediction needs", least=1, most=100
    )
    rate_hz: float = context(lambda: 2.5)

    reads: ClassVar[Schema] = TRACKS
    writes: ClassVar[Mapping[str, Schema]] = MappingProxyType({"": PREDICTIONS})
    latency_s: ClassVar[Mapping[str, float]] = MappingProxyType({"": 0.0})

    def __post_init__(self) -> None:
        check_options(self)
        check(self.predictor)

    def __call__(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, ...]]:
        predictor = make(self.predictor, max(1, round(self.horizon_s * self.rate_hz)), 1 / self.rate_hz)
        histories = Histories(max(predictor.past, self.min_history))
        last_ns = None
        for frame in frames:
            steps = 1 if last_ns is None else max(1, round((frame.t_ns - last_ns) * self.rate_hz / NS_PER_S))
            last_ns = frame.t_ns
            ids = frame.rows["track_id"]
            past, known = histories.push(ids, np.stack([frame.rows["x_m"], frame.rows["y_m"]], axis=-1), steps)
            # A row inside a hole was filled in with what came after it; nothing may be foretold from there.
            ready = known[:, -self.min_history :].all(axis=1) & frame.rows["observed"]
            forecast = predictor.predict(past[ready], known[ready])
            yield (Frame(frame.t_ns, frame.index, forecast_to_rows(ids[ready], forecast, predictor.step_s)),)
