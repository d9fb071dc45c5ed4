"""Calibrated forecasts of vehicles that a tracker follows in metres.

Predictors know how people move; vehicles keep their velocity better than people do, until they brake or turn: their
errors are small or large. So the distribution of a forecast is a mixture of a narrow and a wide normal
distribution, by predictor, class, time ahead, and whether the vehicle stands or moves. The tables were fitted on
drawn traffic (``tools/fit_vehicle_tails.py``), and on no recording.

Letters: N forecasts, T future steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats
from mcaptrack.geometry.mixtures import Tails, normal_tails
from mcaptrack.predictors.forecast import Forecast
from mcaptrack.predictors.tail_calibration import tables_in

TABLES: Final = Path(__file__).parent / "trained" / "vehicle_tails.json"
#: The table of each class of vehicles, by its name among the limits of motion.
TABLE_OF: Final[Mapping[str, str]] = {
    "bicycle": "bicycle", "motorcycle": "bicycle", "car": "car",
    "bus": "truck", "truck": "truck", "trailer": "truck", "train": "truck",
}  # fmt: skip
#: Vehicles that are slower than so many m/s stand.
STANDING_M_PER_S: Final = 0.5


def calibrated(
    predictor: str, forecast: Forecast, step_s: float, names: Sequence[str], speed_m_per_s: Floats
) -> tuple[Forecast, Tails | None]:
    """Forecasts of which those of vehicles are mixtures.

    Parameters
    ----------
    predictor : str
        Name of the predictor. Only built-in ones have tables.
    forecast : Forecast
        N forecasts of T steps of ``step_s`` seconds, in metres.
    names : sequence of N str
        The class of each, as among the limits of motion; those of others stay as they are.
    speed_m_per_s : (N,) of float
        NaN where it isn't known; these forecasts stay as they are, too.

    Returns
    -------
    Forecast, Tails
        With the covariances of the mixtures, and their shapes (N, T), NaN for normal distributions; None if there is no
        table.
    """
    tables = tables_in(TABLES).get(predictor)
    if tables is None:
        return forecast, None
    count, steps = forecast.mean.shape[:2]
    ahead_s = step_s * np.arange(1.0, steps + 1)
    cov, out = forecast.cov.copy(), normal_tails((count, steps))
    kinds = np.array([TABLE_OF.get(name, "") for name in names])
    for kind in set(kinds.tolist()) - {""}:
        for state, is_in in (
            ("standing", speed_m_per_s < STANDING_M_PER_S),
            ("moving", speed_m_per_s >= STANDING_M_PER_S),
        ):
            here = (kinds == kind) & is_in
            if here.any():
                weight, narrow, wide = _at(tables[kind][state], ahead_s)
                whole = (1 - weight) * narrow + weight * wide
                cov[here] *= whole[:, None, None]
                for part, values in zip(out, (weight, narrow / whole, wide / whole), strict=True):
                    part[here] = values
    return Forecast(forecast.mean, cov), out


def _at(table: Mapping[str, Sequence[float]], ahead_s: Floats) -> tuple[Floats, Floats, Floats]:
    """Weight and scales of a table at times ahead, interpolated; beyond its ends as at the ends."""
    weight = np.interp(ahead_s, table["ahead_s"], table["wide_weight"])
    narrow, wide = (
        np.exp(np.interp(ahead_s, table["ahead_s"], np.log(table[name]))) for name in ("narrow_scale", "wide_scale")
    )
    return weight, narrow, wide
