"""Addresses that open logs in web viewers."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Final
from urllib.parse import urlencode

from mcaptrack.geometry.clocks import NS_PER_S

LICHTBLICK: Final = "https://lichtblick-suite.github.io/lichtblick/"
FOXGLOVE: Final = "https://app.foxglove.dev/"


def viewer_links(
    logs: Sequence[str], layout: str | None, lichtblick: str = LICHTBLICK, at_ns: int | None = None
) -> dict[str, str]:
    """Addresses that open logs in Lichtblick, with a layout, and in Foxglove, where layouts are imported by hand.

    Viewers seek to the log time ``at_ns``, if it is given and a calendar has it.
    """
    sources = [("ds", "remote-file"), *(("ds.url", address) for address in logs)]
    when = utc_text(at_ns) if at_ns is not None else None
    time = [("time", when)] if when else []
    with_layout = [*sources, ("layoutUrl", layout)] if layout else sources
    return {
        "Lichtblick": f"{lichtblick.rstrip('/')}/?{urlencode([*with_layout, *time])}",
        "Foxglove": f"{FOXGLOVE}~/view?{urlencode([*sources, *time])}",
    }


def utc_text(t_ns: int) -> str | None:
    """A time in ns since 1970 as RFC 3339 has it; None for years beyond 9999.

    Examples
    --------
    >>> utc_text(34_000_000_001)
    '1970-01-01T00:00:34.000000001Z'
    """
    seconds, rest = divmod(t_ns, NS_PER_S)
    try:
        whole = datetime.fromtimestamp(seconds, UTC)
    except (OverflowError, OSError, ValueError):
        return None
    return f"{whole:%Y-%m-%dT%H:%M:%S}.{rest:09d}Z"
