"""Elements of HTML and SVG as strings. What is not markup already is escaped, wherever it comes from.

Names in logs may hold anything. They stand in texts and in quoted attributes only: never in a link, in a style, or as
the name of an element; ids in the page are made of numbers.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

_VOID: Final = frozenset({"meta", "link", "br"})
#: What stands where there is no number.
NONE: Final = "\N{EN DASH}"
_BLANKS: Final = "\n\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}"
_MOST_DIGITS: Final = 1e6


class Markup(str):
    """A string that is markup already."""

    __slots__ = ()


def escape(words: object) -> Markup:
    """Words as text or as the value of an attribute; what would steer a reader (controls, bidi marks) is replaced."""
    if isinstance(words, Markup):
        return words
    seen = "".join(c if c.isprintable() or c in _BLANKS else "\N{REPLACEMENT CHARACTER}" for c in str(words))
    return Markup(html.escape(seen, quote=True))


def tag(element: str, *children: object, **attributes: object) -> Markup:
    """An element. ``class_`` is class, ``stroke_width`` stroke-width; attributes that are None are left out."""
    given = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{escape(value)}"'
        for name, value in attributes.items()
        if value is not None
    )
    if element in _VOID:
        return Markup(f"<{element}{given}>")
    return Markup(f"<{element}{given}>{join(children)}</{element}>")


def join(parts: Iterable[object]) -> Markup:
    """Markup and words one after the other."""
    return Markup("".join(escape(part) for part in parts))


def name(words: object) -> Markup:
    """A name from a log: it can't change the direction of what stands around it."""
    return tag("bdi", tag("code", words))


def number(value: float | int | None, digits: int = 2, unit: str = "") -> str:
    """A number for people; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return NONE
    if isinstance(value, int):
        said = f"{value:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    else:
        said = f"{value:.{digits}f}" if abs(value) < _MOST_DIGITS else f"{value:.{digits}e}"
    return said + ("\N{NO-BREAK SPACE}" + unit if unit else "")


def percent(value: float | None, digits: int = 1) -> str:
    """A share, 0 to 1, in percent."""
    return number(None if value is None else 100 * value, digits, "%")


def times(count: int) -> str:
    """How often."""
    return {1: "once", 2: "twice"}.get(count, f"{number(count)} times")


def counted(count: int, one: str, many: str = "") -> str:
    """So many of something."""
    return f"{number(count)} {one if count == 1 else many or one + 's'}"


def lack(words: str) -> Markup:
    """What is missing, in its place."""
    return tag("p", sentence(words), class_="lack")


def sentence(words: str) -> Markup:
    """Words in which what stands between backquotes is to be typed."""
    return join(tag("code", part) if k % 2 else part for k, part in enumerate(words.split("`")))


def short(words: str) -> str:
    """What tracks are called where there is little room."""
    return words.removesuffix(", sampled")


def data_uri(jpeg: bytes) -> Markup:
    """A picture inside the page."""
    return Markup("data:image/jpeg;base64," + base64.b64encode(jpeg).decode())


def table(caption: object, columns: Sequence[str], rows: Iterable[Sequence[object]], words: int = 1) -> Markup:
    """A table whose first column heads its rows; the first ``words`` columns hold words, the others numbers."""

    def cell(at: int, content: object) -> Markup:
        if at == 0:
            return tag("th", content, scope="row")
        return tag("td", content, class_=None if at < words else "n")

    head = (tag("th", column, scope="col", class_=None if at < words else "n") for at, column in enumerate(columns))
    body = (tag("tr", *(cell(at, content) for at, content in enumerate(row))) for row in rows)
    whole = tag("table", tag("caption", caption), tag("thead", tag("tr", *head)), tag("tbody", *body))
    return tag("div", whole, class_="wide", tabindex="0", role="region", aria_label="table")


def plain(value: Any) -> Any:
    """A value that JSON knows: no NaN, and only names as keys."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, list | tuple) else value


def script_json(data: Mapping[str, Any], element_id: str) -> Markup:
    """Data for programs inside the page: nothing in it can end the element or be read as markup."""
    said = json.dumps(data, allow_nan=False, ensure_ascii=True, separators=(",", ":"))
    for mark in "<>&":
        said = said.replace(mark, f"\\u{ord(mark):04x}")
    return tag("script", Markup(said), type="application/json", id=element_id)
