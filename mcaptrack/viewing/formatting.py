"""Numbers and counts as our pages print them, and the templates of pages."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from functools import cache, partial
from hashlib import sha256
from typing import Any, Final
from urllib.parse import quote

import numpy as np
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from mcaptrack import log
from mcaptrack.contracts import ReportSection
from mcaptrack.evaluation.metrics.displacement import TAU_M2, Displacement
from mcaptrack.registry import Entry, blamed, of_type
from mcaptrack.schema import DETECTIONS
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import STAGES
from mcaptrack.viewing.charts import WIDTH, Axis, Line, line_chart, round_most, thinned, time_ticks

__all__ = [
    "NONE", "clock", "counted", "number", "percent", "plain", "policy", "render", "section_of", "short",
    "tick_marks", "times", "tracker_name",
]  # fmt: skip

#: Printed in place of a number that is missing.
NONE: Final = "\N{EN DASH}"
_MAX_FIXED: Final = 1e6


#: How trackers are called; channels of earlier versions that name none were made by the first.
_TRACKERS: Final = {"sort": "SORT", "bytetrack": "ByteTrack", "ocsort": "OC-SORT"}
_FIRST_TRACKER: Final = next(iter(_TRACKERS))


def tracker_name(provenance: Provenance | None) -> str:
    """Return the name of the tracker of a channel, by how it was made."""
    stage = STAGES.get(provenance.transform) if provenance else None
    if provenance is None or stage is None or stage.reads is not DETECTIONS:
        return "tracks as given"
    return _TRACKERS.get(str(provenance.parameters.get(stage.option, _FIRST_TRACKER)), "tracker")


def number(value: float | int | None, digits: int = 2, unit: str = "") -> str:
    """A number with ``digits`` decimals (none for an int) and its unit; a dash if it is missing or not finite.

    ``value`` is that number.
    """
    if value is None or not math.isfinite(value):
        return NONE
    if isinstance(value, int):
        text = f"{value:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    else:
        text = f"{value:.{digits}f}" if abs(value) < _MAX_FIXED else f"{value:.{digits}e}"
    return text + ("\N{NO-BREAK SPACE}" + unit if unit else "")


def percent(value: float | None, digits: int = 1) -> str:
    """A share between 0 and 1, in percent.

    ``value`` is the share, None if it isn't known; ``digits`` is the number of decimals.
    """
    return number(None if value is None else 100 * value, digits, "%")


def times(count: int) -> str:
    """A number of times: once, twice, 3 times.

    ``count`` is that number.
    """
    return {1: "once", 2: "twice"}.get(count, f"{number(count)} times")


def counted(count: int, singular: str, many: str = "") -> str:
    """A count with its noun: 1 track, 2 tracks.

    ``singular`` is the noun for one, and ``many`` that for several, by default with an s.
    """
    return f"{number(count)} {singular if count == 1 else many or singular + 's'}"


def short(name: str) -> str:
    """The name of tracks where there is little room."""
    return name.removesuffix(", every picture")


def clock(seconds: float, span_s: float = 0.0) -> str:
    """Seconds since the start of the log, in one format for all values within ``span_s``."""
    if max(seconds, span_s) < 60:
        return number(seconds, 0 if seconds == round(seconds) else 1, "s")
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def tick_marks(span_s: float) -> list[tuple[str, str, str]]:
    """The ticks of an axis of time: where each is, its text, and how the text is aligned.

    ``span_s`` is how long the axis is, in seconds.
    """
    return [
        (f"{100 * tick / span_s:.2f}%", clock(tick, span_s), "end" if tick > 0.97 * span_s else "mid" if tick else "")
        for tick in time_ticks(span_s).tolist()
    ]


def plain(value: Any) -> Any:
    """A value as JSON can hold it: NaN and infinity become None, keys become strings."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, list | tuple) else value


# The templates of the page. They escape every value that they print.
#
# Names in logs may hold anything. Templates print them in text and in quoted attributes only: never in a style or
# as the name of an element, and in a link only quoted and after "./", as the path of a file. Ids in the page are
# made of numbers. Control characters and marks that change the direction of writing are replaced.


_BLANKS: Final = "\n\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}"


@cache
def environment(package: str = "") -> Environment:
    """The environment of the templates in ``templates/`` of a package, and of those here for all.

    Escaping is on, and a missing value is an error.
    """
    out = Environment(
        loader=ChoiceLoader([PackageLoader(name) for name in (package, __package__) if name]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_printable,
    )
    out.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    out.globals["policy"] = partial(policy, package=package)
    out.filters |= {"number": number, "percent": percent, "counted": counted, "base64": _base64, "address": quote}
    return out


def render(template: str, package: str = "", /, **values: Any) -> Markup:
    """A template, of a package or of those here, filled with values."""
    return Markup(environment(package).get_template(template).render(values))  # noqa: S704 - templates escape


@cache
def policy(script: str = "", more: str = "", package: str = "") -> str:
    """The Content-Security-Policy of a page: it loads nothing, and of all scripts only this template's text runs.

    ``script`` is the template, of ``package``; ``more`` is what it may do besides, in the words of a policy.
    """
    parts = [
        "default-src 'none'",
        "img-src data:",
        "style-src 'unsafe-inline'",
        "base-uri 'none'",
        "form-action 'none'",
    ]
    if script:
        parts.append(f"script-src 'sha256-{_base64(sha256(render(script, package).encode()).digest())}'")
    return "; ".join([*parts, *([more] if more else [])])


def _printable(value: Any) -> Any:
    if value is None:
        raise ValueError("a template prints a value that is None")
    if isinstance(value, str) and not isinstance(value, Markup) and not value.isprintable():
        return "".join(c if c.isprintable() or c in _BLANKS else "\N{REPLACEMENT CHARACTER}" for c in value)
    return value


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


# Curves of displacement error over recall, as an SVG that stands alone: the figures of the paper.


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
    for number, (name, displacement) in enumerate(forecasts.items()):
        recall, error = displacement.curve(squared)
        shown = recall > _LEAST_RECALL
        x, y = thinned(recall[shown], error[shown])
        count = int((displacement.d_obs_m2 < TAU_M2).sum())
        dot = (float(recall[count - 1]), float(error[count - 1])) if count else None
        lines.append(Line(name, f"c{number % COLOURS}", x, y, dot=dot))
    # The wrong pairs at the end of a curve have errors without bound: the axis ends where all lines can be told apart.
    most = round_most(np.quantile(line.y, [0.9]) if len(line.y) else line.y for line in lines)
    unit = "m²" if squared else "m"
    return line_chart(title, lines, Axis("recall: share of people with a forecast", 1.0), Axis(f"ADE, {unit}", most))


def section_of(entry: Entry, opened: log.Log, prefix: str, names: Mapping[str, str]) -> ReportSection | None:
    """Return what the function of a section gives of a camera; None if it has nothing to say.

    Raises McaptrackError, with the entry, if it fails, or gives what can't stand in a page or in its data.

    ``prefix`` is the camera, and ``names`` are those of tracks for people, by their role.
    """
    with blamed(entry, "failed"):
        given = entry.cls(opened, prefix, names)
    if given is None:
        return None
    section = of_type(entry, given, ReportSection, "its function")
    with blamed(entry, "gave what is no ReportSection"):
        _check(section)
    return section


def _check(section: ReportSection) -> None:
    """Raise an error for a section that can't stand in a page, or in its data."""
    texts = [section.short, section.title, section.note]
    for caption, columns, groups in section.tables:
        texts += [caption, *columns]
        for heading, rows in groups:
            texts += [heading, *(text for role, name, topic, cells in rows for text in (role, name, topic, *cells))]
    for figure in section.figures:
        texts += [figure["title"], figure["caption"], figure["chart"]["kind"]]
    json.dumps(plain(section.data))
    if wrong := [text for text in texts if not isinstance(text, str)]:
        raise TypeError(f"{wrong[0]!r:.40} is no text")
