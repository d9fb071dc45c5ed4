"""Numbers and counts as a report prints them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

#: Printed in place of a number that is missing.
NONE: Final = "\N{EN DASH}"
_MAX_FIXED: Final = 1e6


def number(value: float | int | None, digits: int = 2, unit: str = "") -> str:
    """A number with ``digits`` decimals (none for an int) and its unit; a dash if it is missing or not finite."""
    if value is None or not math.isfinite(value):
        return NONE
    if isinstance(value, int):
        text = f"{value:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    else:
        text = f"{value:.{digits}f}" if abs(value) < _MAX_FIXED else f"{value:.{digits}e}"
    return text + ("\N{NO-BREAK SPACE}" + unit if unit else "")


def percent(value: float | None, digits: int = 1) -> str:
    """A share between 0 and 1, in percent."""
    return number(None if value is None else 100 * value, digits, "%")


def times(count: int) -> str:
    """A number of times: once, twice, 3 times."""
    return {1: "once", 2: "twice"}.get(count, f"{number(count)} times")


def counted(count: int, one: str, many: str = "") -> str:
    """A count with its noun: 1 track, 2 tracks."""
    return f"{number(count)} {one if count == 1 else many or one + 's'}"


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


def plain(value: Any) -> Any:
    """A value as JSON can hold it: NaN and infinity become None, keys become strings."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, list | tuple) else value
