"""Addresses that open logs in web viewers."""

from __future__ import annotations

from typing import Final
from urllib.parse import urlencode

LICHTBLICK: Final = "https://lichtblick-suite.github.io/lichtblick/"
FOXGLOVE: Final = "https://app.foxglove.dev/"


def viewer_links(logs: list[str], layout: str | None, lichtblick: str = LICHTBLICK) -> dict[str, str]:
    """Addresses that open logs in Lichtblick, with a layout, and in Foxglove, where layouts are imported by hand."""
    sources = [("ds", "remote-file"), *(("ds.url", address) for address in logs)]
    with_layout = [*sources, ("layoutUrl", layout)] if layout else sources
    return {
        "Lichtblick": f"{lichtblick.rstrip('/')}/?{urlencode(with_layout)}",
        "Foxglove": f"{FOXGLOVE}~/view?{urlencode(sources)}",
    }
