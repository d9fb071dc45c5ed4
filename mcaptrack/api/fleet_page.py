"""The page about all logs in a folder of tables."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from mcaptrack.location import local_name, parse
from mcaptrack.tables.catalogue import read_catalogue
from mcaptrack.viewing import report as pages


def page_about(where: Path, folder: Path) -> tuple[bytes, dict[str, Any]]:
    """Return the page about all logs in a folder of tables, and its numbers; it links to pages from ``folder``."""
    rows = read_catalogue(where)
    data = pages.fleet_data(rows)
    text = pages.fleet_page(rows, str(where), pages.ELEMENT, data, partial(_page_beside, folder))
    return text.encode("utf-8"), data


def _page_beside(folder: Path, row: Mapping[str, Any]) -> str:
    """Return the page of a log if it stands beside the log, as seen from a folder; "" if it doesn't."""
    location = parse(row.get("location") or "")
    if not isinstance(location, Path) or not location.is_absolute():
        return ""
    page = local_name(location, ".report.html")
    return os.path.relpath(page, folder.absolute()) if page.is_file() else ""
