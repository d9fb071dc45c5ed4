"""The headings of options in the help, and the options that come first: those that most people need.

The other options of a command stand below their themes, then input and output, many logs, and those of all commands.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

#: The first heading, that of options without a theme below it, and the last ones.
FIRST_PANEL: Final = "Most used"
MORE_PANEL: Final = "More options"
LAST_PANELS: Final = ("Input and output", "Many logs", "Options of all commands")

#: The options of a command that come first, in order, by the names of its parameters. Commands with few have none.
MOST_USED: Final[Mapping[str, tuple[str, ...]]] = {
    "run": ("output", "topic", "camera", "detector", "tracker", "retracker", "predictor", "zones", "force"),
    "events": ("topic", "similarity", "gate_m", "output", "force"),
    "fuse": ("to", "cameras", "clock_offset_s", "min_score", "output", "force"),
    "calibrate": ("reference", "cameras", "dry_run", "clock_offset_s", "output", "force"),
    "zones": ("zones", "topic", "camera", "output", "force"),
    "evaluate": ("truth", "topic", "similarity", "gate_m", "rules", "fail_under", "csv", "output", "force"),
    "export": ("form", "topic", "output", "force"),
    "query": ("file", "form", "rows", "tables", "output", "force"),
    "tune": ("truth", "stage", "tracker", "metric", "trials", "search", "topic", "output", "force"),
    "train": ("recipe", "epochs", "device", "validate", "topic", "output", "force"),
}
#: The heading of a theme that not all detectors, trackers or predictors have: the names of those that have it.
_THOSE: Final = re.compile(r"\((.+)\)$|^Options of (.+)$")


def arrange(first: Sequence[str], parameters: list[Any]) -> None:
    """Put the parameters of a command into the order of its help, below its headings; ``first`` come first."""
    for one in parameters:
        if one.param_type_name != "option":
            continue
        if one.name in first:
            those = _THOSE.search(one.rich_help_panel or "")
            if those:
                one.help = f"{one.help.rstrip('.')} ({those[1] or those[2]})."
            one.rich_help_panel = FIRST_PANEL
        elif first and not one.rich_help_panel:
            one.rich_help_panel = MORE_PANEL

    def place(one: Any) -> tuple[int, int]:
        panel = getattr(one, "rich_help_panel", None)
        if panel == FIRST_PANEL:
            return -1, first.index(one.name)
        return (1 + LAST_PANELS.index(panel), 0) if panel in LAST_PANELS else (0, 0)

    parameters.sort(key=place)
