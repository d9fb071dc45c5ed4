"""The largest values that the plots of a layout show, so that their axes have room for all of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import numpy as np

from mcaptrack.foxglove.views.layouts import ERRORS, PEOPLE, SPREAD
from mcaptrack.schema import COUNTS, FORECAST_SCORES, Frame, Schema
from mcaptrack.schema.framing import joined_parts

#: The channels of each plot below the prefix of a camera, and the columns of each that it may show. Of forecasts, one
#: channel is shown: the first with such values.
_PLOTS: Final[Mapping[str, tuple[Schema, tuple[str, ...], tuple[str, ...]]]] = {
    PEOPLE: (COUNTS, ("tracks/counts", "retracks/counts", "retracks/full/counts"), ("tracked", "people")),
    ERRORS: (
        FORECAST_SCORES,
        ("predictions/scores", "retracks/predictions/scores"),
        ("ade_m", "fde_m", "later_ade_m", "later_fde_m"),
    ),
    SPREAD: (FORECAST_SCORES, ("retracks/predictions/scores", "predictions/scores"), ("spread_mean_m", "spread_90_m")),
}


def highest_values(prefix: str, frames_of: Callable[[str, Schema], Sequence[Frame]]) -> dict[str, float]:
    """Return the largest value of each plot, as far as it is known.

    ``frames_of`` returns the frames of a topic with rows of a schema; empty if there are none.
    """
    out: dict[str, float] = {}
    for plot, (schema, names, columns) in _PLOTS.items():
        for name in names:
            if plot == SPREAD and plot in out:
                break
            for _, _, joined in joined_parts(schema, frames_of(f"{prefix}/{name}", schema)):
                for column in columns:
                    values = np.asarray(joined.rows[column], np.float64)
                    known = values[np.isfinite(values)]
                    if len(known):
                        out[plot] = max(out.get(plot, 0.0), float(known.max()))
    return out
