"""Curves of displacement error over recall, as an SVG that stands alone: the figures of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from mcaptrack.evaluation.metrics.displacement import TAU_M2, Displacement
from mcaptrack.viewing.report.charts import WIDTH, Axis, Line, line_chart, round_most, thinned
from mcaptrack.viewing.report.html import render

#: Roles of the lines: their colours are in the template.
COLOURS: Final = 8
#: Up to this recall the mean is one of a few forecasts, and not drawn.
_LEAST_RECALL: Final = 0.02


def curves_svg(forecasts: Mapping[str, Displacement]) -> str:
    """The ADE over recall of several sets of forecasts, by name: in metres, and squared as the paper has it.

    A dot is where the pasts of tracks and people differ by 2 m², the threshold of the scores.

    Parameters
    ----------
    forecasts : mapping of str to Displacement

    Returns
    -------
    str
        An SVG document.
    """
    charts = [
        _chart(forecasts, squared=False, title="ADE over recall"),
        _chart(forecasts, squared=True, title="Squared ADE over recall (the paper's)"),
    ]
    return str(render("curves.svg", charts=charts, width=WIDTH + 100))


def _chart(forecasts: Mapping[str, Displacement], squared: bool, title: str) -> dict[str, object]:
    lines = []
    for number, (name, one) in enumerate(forecasts.items()):
        recall, error = one.curve(squared)
        shown = recall > _LEAST_RECALL
        x, y = thinned(recall[shown], error[shown])
        count = int((one.d_obs_m2 < TAU_M2).sum())
        dot = (float(recall[count - 1]), float(error[count - 1])) if count else None
        lines.append(Line(name, f"c{number % COLOURS}", x, y, dot=dot))
    # The wrong pairs at the end of a curve have errors without bound: the axis ends where all lines can be told apart.
    most = round_most(np.quantile(line.y, [0.9]) if len(line.y) else line.y for line in lines)
    unit = "m²" if squared else "m"
    return line_chart(title, lines, Axis("recall: share of people with a forecast", 1.0), Axis(f"ADE, {unit}", most))
