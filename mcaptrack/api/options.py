"""Parameters that many functions share, declared once."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Annotated, Final

from mcaptrack.api.declared import OneOfMany, Option, PythonOnly

PathLike = str | os.PathLike[str]
#: Called with the name of a stage, the amount that is done, and the total (None if it is not known).
Progress = Callable[[str, float, float | None], None]

#: Headings of options in the help.
FILES: Final = "Input and output"
LABELS: Final = "Label files"

_LOGS: Final = "Logs, folders of logs, patterns, or - for a list of logs on stdin."
EachLog = Annotated[PathLike, OneOfMany("logs", "LOG", _LOGS, help="The log.")]
Camera = Annotated[str | None, Option(FILES, help="Which camera, if the log has several.")]
Topic = Annotated[str | None, Option(FILES, help="Read this channel instead of the usual one.")]
To = Annotated[str | None, Option(FILES, help="Write to this channel instead of the usual one.")]
Frame = Annotated[
    str | None,
    Option(
        FILES,
        help="Bring boxes in space (3D) to this frame, such as map; by default to the root of the tree of frames.",
    ),
]
Sidecar = Annotated[
    bool | None,
    Option(
        FILES,
        flag="sidecar/in-place",
        help="Write into LOG.results.mcap beside the log (True) or into the log (False). By default beside recordings "
        "that ROS tools read, otherwise into the log.",
    ),
]
Force = Annotated[bool, Option(FILES, help="Overwrite the output file if it exists.")]
Reports = Annotated[Progress, PythonOnly("Called as ``progress(stage, done, total)``.")]
#: The value of a transform's option.
Value = float | int | bool | str | None


def output(shown: str | bool = False) -> Option:
    """The option of an output; ``shown`` is its default in the help."""
    return Option(FILES, short="o", shown=shown, help="Write to this file; the log stays unchanged.")


Output = Annotated[PathLike | None, output()]


def no_progress(stage: str, done: float, total: float | None) -> None:
    """Ignore the progress."""
