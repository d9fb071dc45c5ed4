"""How files of logs are named."""

from __future__ import annotations

from pathlib import Path
from typing import Final

#: How the name of a log ends that holds the results of another.
RESULTS_SUFFIX: Final = ".results.mcap"


def results_path(path: Path) -> Path:
    """Where the results of a log stand if they are not in it."""
    return path.with_name(path.name.removesuffix(".mcap") + RESULTS_SUFFIX)
