"""Charts as SVG: lines with bands, histograms above each other, and pairs on a scale.

Colours, and what of them changes in the dark, are classes of the page's style. A chart is about as wide as a phone, so
that its words can be read there; where there is room the page puts several beside each other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from mcaptrack.geometry.arrays import Floats
from mcaptrack.viewing.report.markup import Markup, join, number, tag

WIDTH: Final = 460
HEIGHT: Final = 270
_LEFT, _RIGHT, _TOP, _BOTTOM = 46, 126, 26, 40
#: Words beside each other need so much room.
_LINE: Final = 14.0
_MOST_LETTERS: Final = 48
#: A line has no more points than this.
POINTS: Final = 160


@dataclass(frozen=True)
class Line:
    """A line through x and y (P,), with a band from ``low`` to ``high`` where they are given.

    ``role`` chooses the colour, ``name`` stands at its end.
    """

    name: str
    role: str
    x: Floats
    y: Floats
    low: Floats | None = None
    high: Floats | None = None
    dashed: bool = False


@dataclass(frozen=True)
class Axis:
    """What an axis says, and from 0 to where it goes; ``percent`` says shares in percent."""

    label: str
    most: float
    percent: bool = False

    def ticks(self) -> Floats:
        """About five round numbers."""
        step = round_step(self.most / 4.5)
        return np.arange(0, self.most + step * 1e-6, step)

    def say(self, value: float) -> str:
        """A tick in words."""
        return f"{100 * value:.0f}" if self.percent else f"{value:g}"


def round_step(least: float) -> float:
    """The smallest of 1, 2, 2.5 and 5 times a power of ten that is not below ``least``."""
    power = 10.0 ** math.floor(math.log10(least)) if least > 0 and math.isfinite(least) else 1.0
    return next((k * power for k in (1, 2, 2.5, 5) if k * power >= least * (1 - 1e-9)), 10 * power)


def round_most(values: Sequence[Floats], least: float = 0.0) -> float:
    """Where an axis ends that shows these values."""
    top = max([least, *(float(np.nanmax(part)) for part in values if np.isfinite(part).any())])
    step = round_step(top / 4.5) if top > 0 else 1.0
    return max(math.ceil(top / step - 1e-9), 1) * step


def line_chart(title: str, lines: Sequence[Line], x: Axis, y: Axis, diagonal: str = "") -> Markup:
    """A chart of lines; ``diagonal`` names the line on which both axes are equal, where that means something."""
    width, height = WIDTH - _LEFT - _RIGHT, HEIGHT - _TOP - _BOTTOM

    def place(values_x: Floats, values_y: Floats) -> str:
        across = _LEFT + np.clip(values_x / x.most, 0, 1) * width
        up = _TOP + height - np.clip(values_y / y.most, 0, 1) * height
        return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across.tolist(), up.tolist(), strict=True))

    parts = list(_axes(x, y, width, height))
    if diagonal:
        top = min(x.most, y.most)
        parts.append(tag("polyline", points=place(np.array([0, top]), np.array([0, top])), class_="l s-truth dash"))
    ends: list[tuple[float, str, str]] = []
    for line in lines:
        at_x, at_y = line.x, line.y
        kept = np.isfinite(at_x) & np.isfinite(at_y)
        if line.low is not None and line.high is not None and kept.any():
            around = np.concatenate([at_x[kept], at_x[kept][::-1]])
            band = np.concatenate([line.low[kept], line.high[kept][::-1]])
            parts.append(tag("polygon", points=place(around, band), class_=f"band s-{line.role}"))
        if not kept.any():
            continue
        dash = " dash" if line.dashed else ""
        parts.append(tag("polyline", points=place(at_x[kept], at_y[kept]), class_=f"l s-{line.role}{dash}"))
        ends.append((_TOP + height - min(float(at_y[kept][-1]) / y.most, 1) * height, line.name, line.role))
    if diagonal:
        ends.append((_TOP + height - min(x.most, y.most) / y.most * height, diagonal, "truth"))
    parts += _labels(ends, _LEFT + width + 6, height)
    return chart(title, WIDTH, HEIGHT, parts)


def chart(title: str, width: int, height: int, parts: Sequence[Markup]) -> Markup:
    """An SVG of that size that says what it shows to those who don't see it."""
    return tag("svg", tag("title", title), *parts, viewBox=f"0 0 {width} {height}", role="img", class_="chart")


def _axes(x: Axis, y: Axis, width: float, height: float) -> Iterator[Markup]:
    bottom = _TOP + height
    for tick in y.ticks().tolist():
        at = bottom - tick / y.most * height
        yield tag("line", x1=_LEFT, x2=_LEFT + width, y1=f"{at:.1f}", y2=f"{at:.1f}", class_="rule")
        yield tag("text", y.say(tick), x=_LEFT - 6, y=f"{at + 4:.1f}", class_="end")
    for tick in x.ticks().tolist():
        at = _LEFT + tick / x.most * width
        yield tag("line", x1=f"{at:.1f}", x2=f"{at:.1f}", y1=bottom, y2=bottom + 4, class_="axis")
        yield tag("text", x.say(tick), x=f"{at:.1f}", y=bottom + 17, class_="mid")
    yield tag("line", x1=_LEFT, x2=_LEFT + width, y1=bottom, y2=bottom, class_="axis")
    yield tag("text", y.label, x=4, y=13, class_="what")
    yield tag("text", x.label, x=_LEFT + width / 2, y=HEIGHT - 5, class_="mid what")


def _labels(ends: list[tuple[float, str, str]], x: float, height: float) -> Iterator[Markup]:
    """Names at the ends of lines, pushed apart where they would lie on each other."""
    if not ends:
        return
    ends = sorted(ends)
    at = np.array([end[0] for end in ends])
    for k in range(1, len(at)):
        at[k] = max(at[k], at[k - 1] + _LINE)
    over = at[-1] - (_TOP + height)
    if over > 0:
        at[-1] -= over
        for k in range(len(at) - 2, -1, -1):
            at[k] = min(at[k], at[k + 1] - _LINE)
    for y, (_, words, role) in zip(at.tolist(), ends, strict=True):
        yield tag("text", words, x=x, y=f"{y + 4:.1f}", class_=f"name s-{role}")


@dataclass(frozen=True)
class Bars:
    """One histogram: the shares (B,) of what lies in each bin, and where the middle is."""

    name: str
    role: str
    shares: Floats
    median: float
    words: str


def histogram_chart(title: str, rows: Sequence[Bars], edges: Floats, label: str) -> Markup:
    """Histograms above each other in the same bins with ``edges`` (B + 1,), all of one scale."""
    x = Axis(label, float(edges[-1]))
    width, row = WIDTH - _RIGHT - 12, 74
    top = max([1e-9, *(float(one.shares.max(initial=0)) for one in rows)])
    bottom = row * len(rows) + 6

    def at(value: float) -> float:
        return 12 + min(max(value / x.most, 0), 1) * width

    parts: list[Markup] = []
    for k, one in enumerate(rows):
        floor = row * (k + 1)
        for low, high, share in zip(edges[:-1].tolist(), edges[1:].tolist(), one.shares.tolist(), strict=True):
            tall = share / top * (row - 14)
            if tall > 0:
                wide = max(at(high) - at(low) - 1, 0.5)
                size = {"width": f"{wide:.1f}", "height": f"{tall:.1f}"}
                said = tag("title", f"{low:g} to {high:g}: {100 * share:.1f} %")
                parts.append(
                    tag("rect", said, x=f"{at(low):.1f}", y=f"{floor - tall:.1f}", **size, class_=f"bar s-{one.role}")
                )
        parts.append(tag("line", x1=12, x2=12 + width, y1=floor, y2=floor, class_="axis"))
        middle = f"{at(one.median):.1f}"
        parts.append(tag("line", x1=middle, x2=middle, y1=floor - row + 14, y2=floor, class_="middle"))
        parts.append(tag("text", one.name, x=width + 20, y=floor - 30, class_=f"name s-{one.role}"))
        parts.append(tag("text", one.words, x=width + 20, y=floor - 14))
    for tick in x.ticks().tolist():
        parts.append(
            tag("line", x1=f"{at(tick):.1f}", x2=f"{at(tick):.1f}", y1=bottom - 6, y2=bottom - 2, class_="axis")
        )
        parts.append(tag("text", x.say(tick), x=f"{at(tick):.1f}", y=bottom + 11, class_="mid"))
    parts.append(tag("text", label, x=12 + width / 2, y=bottom + 28, class_="mid what"))
    return chart(title, WIDTH, bottom + 34, parts)


def pairs_chart(title: str, rows: Sequence[tuple[str, float, float]], axis: Axis, names: tuple[str, str]) -> Markup:
    """From one value to another for each of several names, a row each; ``names`` say whose values these are."""
    width, row = WIDTH - _LEFT - 24, 34
    left, height = _LEFT - 26, 40 + row * len(rows) + _BOTTOM
    bottom = height - _BOTTOM

    def at(value: float) -> float:
        return left + min(max(value / axis.most, 0), 1) * (width + 26)

    parts = []
    for tick in axis.ticks().tolist():
        parts.append(tag("line", x1=f"{at(tick):.1f}", x2=f"{at(tick):.1f}", y1=28, y2=bottom, class_="rule"))
        parts.append(tag("text", axis.say(tick), x=f"{at(tick):.1f}", y=bottom + 17, class_="mid"))
    for number_of, (words, before, after) in enumerate(rows):
        y = 54 + row * number_of
        shown = words if len(words) <= _MOST_LETTERS else words[: _MOST_LETTERS - 1] + "…"
        parts.append(tag("text", shown, x=left, y=y - 9, class_="what"))
        parts.append(tag("line", x1=f"{at(before):.1f}", x2=f"{at(after):.1f}", y1=y, y2=y, class_="between"))
        for value, role in ((before, "tracks"), (after, "offline")):
            parts.append(tag("circle", cx=f"{at(value):.1f}", cy=y, r=5, class_=f"dot s-{role}"))
    parts.append(tag("text", "● " + names[0], x=left, y=15, class_="name s-tracks"))
    parts.append(tag("text", "● " + names[1], x=left + 150, y=15, class_="name s-offline"))
    parts.append(tag("text", axis.label, x=WIDTH / 2, y=height - 5, class_="mid what"))
    return chart(title, WIDTH, height, parts)


def thinned(*columns: Floats) -> tuple[Floats, ...]:
    """No more points than a chart can show, the first and the last among them."""
    count = len(columns[0])
    kept = np.unique(np.linspace(0, max(count - 1, 0), min(count, POINTS)).round().astype(int))
    return tuple(column[kept] for column in columns)


def figure(content: object, *caption: object, class_: str | None = None) -> Markup:
    """A figure with what there is to say about it."""
    return tag("figure", content, tag("figcaption", *caption), class_=class_)


def beside(figures: Sequence[Markup], class_: str = "grid") -> Markup:
    """Figures beside each other where there is room; scenes need less than charts with words."""
    return tag("div", join(figures), class_=class_) if figures else Markup("")


#: What lies between the marks of a timeline, in seconds.
_MARKS_S: Final = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 43200, 86400)


def time_ticks(span_s: float) -> Floats:
    """About six round times from 0 on."""
    step = next((mark for mark in _MARKS_S if span_s / mark <= 6.5), round_step(span_s / 6))
    return np.arange(0, span_s + step * 1e-6, step)


def clock(seconds: float, span_s: float = 0.0) -> str:
    """Seconds from the beginning, for people, all alike within a span."""
    if max(seconds, span_s) < 60:
        return number(seconds, 0 if seconds == round(seconds) else 1, "s")
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
