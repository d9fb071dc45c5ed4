"""Parameters that many functions share, declared once."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Annotated, Final

from mcaptrack.api.declared import PYTHON_ONLY, OneOfMany, Option

PathLike = str | os.PathLike[str]
#: Called with the name of a stage, the amount that is done, and the total (None if it is not known).
Progress = Callable[[str, float, float | None], None]

#: Headings of options in the help.
FILES: Final = "Input and output"
LABELS: Final = "Label files"

_LOGS: Final = "Logs, folders of logs, patterns, or - for a list of logs on stdin."
EachLog = Annotated[PathLike, OneOfMany("logs", "LOG", _LOGS)]
Camera = Annotated[str | None, Option(FILES)]
Topic = Annotated[str | None, Option(FILES)]
To = Annotated[str | None, Option(FILES)]
Frame = Annotated[str | None, Option(FILES)]
Sidecar = Annotated[
    bool | None,
    Option(FILES, flag="sidecar/in-place"),
]
Force = Annotated[bool, Option(FILES)]
Reports = Annotated[Progress, PYTHON_ONLY]
#: The value of a transform's option.
Value = float | int | bool | str | None


def output(shown: str | bool = False) -> Option:
    """The option of an output; ``shown`` is its default in the help."""
    return Option(FILES, short="o", shown=shown)


Output = Annotated[PathLike | None, output()]


def no_progress(stage: str, done: float, total: float | None) -> None:
    """Ignore the progress."""
