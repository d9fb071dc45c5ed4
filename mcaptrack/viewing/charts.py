"""Charts as coordinates, which ``templates/charts.html`` draws as SVG: lines with bands, histograms, pairs on a scale.

Colours are classes of the page's style, so that light, dark and paper are one drawing. A chart is about as wide as a
phone, so that its text can be read there; on wider screens the page shows several side by side.

Letters: P points, B bins.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
#: The values of a chart by name, for the macro ``draw`` of the template.
Chart = dict[str, Any]

WIDTH: Final = 460
HEIGHT: Final = 270
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 126, 26, 40
#: The height of a line of text.
_LINE: Final = 14.0
_MAX_NAME: Final = 48
#: A line has at most this many points.
POINTS: Final = 160


@dataclass(frozen=True)
class Line:
    """A line through ``x`` and ``y`` (P,), with a band from ``low`` to ``high`` (P,) if they are given.

    ``role`` chooses the colour, ``name`` is printed at the end of the line. ``dot`` is a point to mark.
    """

    name: str
    role: str
    x: Floats
    y: Floats
    low: Floats | None = None
    high: Floats | None = None
    dashed: bool = False
    dot: tuple[float, float] | None = None


@dataclass(frozen=True)
class Axis:
    """An axis from 0 to ``most`` with its label; ``percent`` prints shares in percent, ``whole`` counts."""

    label: str
    most: float
    percent: bool = False
    whole: bool = False

    def ticks(self) -> list[tuple[float, str]]:
        """About five round numbers with their texts."""
        step = _step(self.most, self.whole)
        values = np.arange(0, self.most + step * 1e-6, step).tolist()
        return [(value, f"{100 * value:.0f}" if self.percent else f"{value:g}") for value in values]


@dataclass(frozen=True)
class Bars:
    """A histogram: the share of values in each bin (B,), their median, and a text beside it."""

    name: str
    role: str
    shares: Floats
    median: float
    text: str


def round_step(least: float) -> float:
    """The smallest of 1, 2, 2.5 and 5 times a power of ten that is at least ``least``."""
    power = 10.0 ** math.floor(math.log10(least)) if least > 0 and math.isfinite(least) else 1.0
    return next((k * power for k in (1, 2, 2.5, 5) if k * power >= least * (1 - 1e-9)), 10 * power)


def _step(most: float, whole: bool) -> float:
    """The distance between about five ticks."""
    step = round_step(most / 4.5) if most > 0 else 1.0
    if not whole:
        return step
    return max(1.0, step if step.is_integer() else round_step(step * 1.1))


def round_most(values: Iterable[Floats], least: float = 0.0, whole: bool = False) -> float:
    """The round number at which an axis for these values ends; ``whole`` for counts."""
    top = max([least, *(float(np.nanmax(part)) for part in values if np.isfinite(part).any())])
    step = _step(top, whole)
    return max(math.ceil(top / step - 1e-9), 1) * step


def line_chart(title: str, lines: Sequence[Line], x: Axis, y: Axis, diagonal: str = "") -> Chart:
    """A chart of lines; ``diagonal`` names the line on which both axes are equal, if that has a meaning."""
    width, height = WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM
    bottom = _TOP + height

    def points(values_x: Floats, values_y: Floats) -> str:
        across = _LEFT + np.clip(values_x / x.most, 0, 1) * width
        up = bottom - np.clip(values_y / y.most, 0, 1) * height
        return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across.tolist(), up.tolist(), strict=True))

    bands, drawn, dots, ends = [], [], [], []
    if diagonal:
        top = min(x.most, y.most)
        way = points(np.array([0, top]), np.array([0, top]))
        drawn.append({"points": way, "role": "truth", "dashed": True, "name": ""})
        ends.append((bottom - top / y.most * height, diagonal, "truth"))
    for line in lines:
        kept = np.isfinite(line.x) & np.isfinite(line.y)
        if not kept.any():
            continue
        if line.low is not None and line.high is not None:
            around = np.concatenate([line.x[kept], line.x[kept][::-1]])
            band = np.concatenate([line.low[kept], line.high[kept][::-1]])
            bands.append({"points": points(around, band), "role": line.role})
        way = points(line.x[kept], line.y[kept])
        drawn.append({"points": way, "role": line.role, "dashed": line.dashed, "name": line.name})
        if line.dot is not None:
            at = points(*(np.array([value]) for value in line.dot)).split(",")
            dots.append((*at, line.role))
        ends.append((bottom - min(float(line.y[kept][-1]) / y.most, 1) * height, line.name, line.role))
    return {
        "kind": "lines", "title": title, "width": WIDTH, "height": HEIGHT, "scale": _scale(x, y),
        "box": f"{_LEFT} {_TOP} {_LEFT + width} {bottom}",
        "left": _LEFT, "right": _LEFT + width, "bottom": bottom,
        "x_ticks": [(_fixed(_LEFT + value / x.most * width), text) for value, text in x.ticks()],
        "y_ticks": [(_fixed(bottom - value / y.most * height), text) for value, text in y.ticks()],
        "x_label": x.label, "y_label": y.label, "x_middle": _LEFT + width / 2,
        "bands": bands, "lines": drawn, "dots": dots, "names": _names(ends, height), "names_x": _LEFT + width + 6,
    }  # fmt: skip


def _scale(x: Axis, y: Axis) -> str:
    """Where both axes end, as texts show values: shares in percent."""
    return " ".join(f"{axis.most * (100 if axis.percent else 1):.9g}" for axis in (x, y))


def timeline_chart(title: str, lines: Sequence[Line], x: Axis, y: Axis, ticks: Sequence[Any]) -> Chart:
    """A chart of lines as wide as its page, without text but for the ``ticks`` of its axis of time.

    Lines are in thousandths of its width and hundredths of its height, which a page stretches.
    """

    def points(line: Line) -> str:
        across, up = 1000 * np.clip(line.x / x.most, 0, 1), 100 - 100 * np.clip(line.y / y.most, 0, 1)
        return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across.tolist(), up.tolist(), strict=True))

    drawn = [{"points": points(line), "role": line.role, "dashed": line.dashed, "name": line.name} for line in lines]
    return {
        "title": title, "scale": _scale(x, y), "box": "0 0 1000 100", "x_ticks": ticks, "y_label": y.label,
        "lines": drawn,
        "y_ticks": [(f"{100 - 100 * value / y.most:.1f}%", text) for value, text in y.ticks()],
    }  # fmt: skip


def _names(ends: Sequence[tuple[float, str, str]], height: float) -> list[tuple[str, str, str]]:
    """Height, text and role of the names at the ends of lines, moved apart where they would overlap."""
    if not ends:
        return []
    ends = sorted(ends)
    at = np.array([end[0] for end in ends])
    for k in range(1, len(at)):
        at[k] = max(at[k], at[k - 1] + _LINE)
    over = at[-1] - (_TOP + height)
    if over > 0:
        at[-1] -= over
        for k in range(len(at) - 2, -1, -1):
            at[k] = min(at[k], at[k + 1] - _LINE)
    return [(_fixed(y + 4), name, role) for y, (_, name, role) in zip(at.tolist(), ends, strict=True)]


def histogram_chart(title: str, rows: Sequence[Bars], edges: Floats, label: str) -> Chart:
    """Histograms one above the other, in the same bins with ``edges`` (B + 1,) and on the same scale."""
    x = Axis(label, float(edges[-1]))
    left, width, row = 12, WIDTH - _RIGHT - 12, 74
    top = max([1e-9, *(float(bars.shares.max(initial=0)) for bars in rows)])
    bottom = row * len(rows) + 6

    def at(value: float) -> float:
        return left + min(max(value / x.most, 0), 1) * width

    drawn = []
    for k, part in enumerate(rows, start=1):
        bars = []
        for low, high, share in zip(edges[:-1].tolist(), edges[1:].tolist(), part.shares.tolist(), strict=True):
            tall = share / top * (row - 14)
            if tall > 0:
                place = (at(low), row * k - tall, max(at(high) - at(low) - 1, 0.5), tall)
                bars.append((*map(_fixed, place), f"{low:g} to {high:g}: {100 * share:.1f} %"))
        median = _fixed(at(part.median))
        drawn.append(
            {"bars": bars, "floor": row * k, "median": median, "name": part.name, "role": part.role, "text": part.text}
        )
    return {
        "kind": "histogram", "title": title, "width": WIDTH, "height": bottom + 34,
        "left": left, "right": left + width, "bottom": bottom, "row": row, "rows": drawn, "names_x": width + 20,
        "x_ticks": [(_fixed(at(value)), text) for value, text in x.ticks()],
        "x_label": label, "x_middle": left + width / 2,
    }  # fmt: skip


def pairs_chart(title: str, rows: Sequence[tuple[str, float, float]], axis: Axis, names: tuple[str, str]) -> Chart:
    """For each of several names a value before and one after, a row each; ``names`` name the two values."""
    left, row = _LEFT - 26, 34
    width, height = WIDTH - _LEFT + 2, 40 + row * len(rows) + _BOTTOM

    def at(value: float) -> str:
        return _fixed(left + min(max(value / axis.most, 0), 1) * width)

    return {
        "kind": "pairs", "title": title, "width": WIDTH, "height": height,
        "left": left, "bottom": height - _BOTTOM, "names": names,
        "x_ticks": [(at(value), text) for value, text in axis.ticks()], "x_label": axis.label,
        "rows": [
            {
                "y": 54 + row * k,
                "name": name if len(name) <= _MAX_NAME else name[: _MAX_NAME - 1] + "…",
                "before": at(before),
                "after": at(after),
                "texts": [f"{100 * value:.1f} %" if axis.percent else f"{value:g}" for value in (before, after)],
            }
            for k, (name, before, after) in enumerate(rows)
        ],
    }  # fmt: skip


def ranges_chart(
    title: str,
    rows: Sequence[tuple[str, tuple[tuple[float, float, float], tuple[float, float, float]]]],
    axis: Axis,
    names: tuple[str, str],
) -> Chart:
    """For each of several names two values with their intervals (value, low, high), a row each; ``names`` name them."""
    chart = pairs_chart(title, [(name, before[0], after[0]) for name, (before, after) in rows], axis, names)
    left, width = chart["left"], WIDTH - _LEFT + 2
    for row, (_, sides) in zip(chart["rows"], rows, strict=True):
        row["bars"] = [
            (*(_fixed(left + min(max(end / axis.most, 0), 1) * width) for end in side[1:]), role, row["y"] + shift)
            for side, role, shift in zip(sides, ("tracks", "offline"), (-3, 3), strict=True)
        ]
    return chart | {"kind": "ranges"}


def _fixed(value: float) -> str:
    return f"{value:.1f}"


def thinned(*columns: Floats) -> tuple[Floats, ...]:
    """At most ``POINTS`` points of equally long columns (P,), the first and the last among them."""
    count = len(columns[0])
    kept = np.unique(np.linspace(0, max(count - 1, 0), min(count, POINTS)).round().astype(int))
    return tuple(column[kept] for column in columns)


#: Possible distances between the ticks of a timeline, in seconds.
_TICKS_S: Final = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 43200, 86400)


def figure(chart: Chart, title: str, caption: str) -> dict[str, Any]:
    """A chart with the text below it."""
    return {"chart": chart, "title": title, "caption": caption}


def time_ticks(span_s: float) -> Floats:
    """About six round times from 0 to ``span_s``."""
    step = next((tick for tick in _TICKS_S if span_s / tick <= 6.5), round_step(span_s / 6))
    return np.arange(0, span_s + step * 1e-6, step)
