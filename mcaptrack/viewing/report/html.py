"""The templates of the page. They escape every value that they print.

Names in logs may hold anything. Templates print them in text and in quoted attributes only: never in a style or as the
name of an element, and in a link only quoted and after "./", as the path of a file. Ids in the page are made of
numbers. Control characters and marks that change the direction of writing are replaced.
"""

from __future__ import annotations

import base64
from functools import cache
from typing import Any, Final
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from mcaptrack.viewing.report.formatting import counted, number, percent

_BLANKS: Final = "\n\N{NO-BREAK SPACE}\N{NARROW NO-BREAK SPACE}"


@cache
def environment() -> Environment:
    """The environment of the templates in ``templates/``: escaping is on, and a missing value is an error."""
    out = Environment(
        loader=PackageLoader(__package__ or ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_printable,
    )
    out.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    out.filters |= {"number": number, "percent": percent, "counted": counted, "base64": _base64, "address": quote}
    return out


def render(template: str, **values: Any) -> Markup:
    """A template filled with values."""
    return Markup(environment().get_template(template).render(values))  # noqa: S704 - templates escape


def _printable(value: Any) -> Any:
    if value is None:
        raise ValueError("a template prints a value that is None")
    if isinstance(value, str) and not isinstance(value, Markup):
        return "".join(c if c.isprintable() or c in _BLANKS else "\N{REPLACEMENT CHARACTER}" for c in value)
    return value


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()
