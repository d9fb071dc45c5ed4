"""Parameters that many functions share, declared once."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Final

from mcaptrack.api.declared import OneOfMany, Option, PythonOnly
from mcaptrack.choices import Point
from mcaptrack.notices import Progress

if TYPE_CHECKING:
    from mcaptrack.registry import Kind

__all__ = [
    "FILES", "LABELS", "LOGS", "SCORES", "Camera", "EachLog", "Force", "GroundPlane", "MinIou", "Output",
    "PathLike", "Progress", "Reports", "Sidecar", "Topic", "Views", "chooser", "gate_m", "no_progress", "output",
    "similarity",
]  # fmt: skip

PathLike = str | os.PathLike[str]

#: Headings of options in the help.
FILES: Final = "Input and output"
LABELS: Final = "Label files"
SCORES: Final = "Scores"

#: Help of an argument that names logs.
LOGS: Final = "Logs, folders of logs, patterns, or - for a list of logs on stdin."
EachLog = Annotated[PathLike, OneOfMany("logs", "LOG", LOGS, help="The log.")]
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
FieldMap = Annotated[
    str | None,
    Option(
        FILES,
        metavar="KEY=PATH,...",
        help="Which fields of the messages of `topic=` are what: x=people[].pose.position.x,y=... Keys are position, "
        "x, y, z, velocity, vx, vy, size, length, width, height, heading, id, class and score of boxes in space; left, "
        "top, right, bottom, w, h, class and score of boxes in pictures; picture=1280x720 is the size of these.",
    ),
]
ClassNames = Annotated[
    str | None,
    Option(
        FILES,
        metavar="MAP",
        help="Names of the classes of recorded boxes: 0=person,2=car, or coco, or a file with a name in each line.",
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
Definitions = Annotated[
    PathLike | Sequence[PathLike] | None,
    Option(
        FILES,
        metavar="FOLDER",
        shown=False,
        help="Folder with definitions (.msg or .idl, as in ROS packages) of messages that the log does not define; or "
        "the distribution of ROS that they are from, such as humble.",
    ),
]
Views = Annotated[bool, Option(FILES, help="Draw the results for viewers, too; `mcaptrack run` does so at its end.")]
Force = Annotated[bool, Option(FILES, help="Overwrite the output file if it exists.")]
Reports = Annotated[Progress, PythonOnly("Called as ``progress(stage, done, total)``.")]
GroundPlane = Annotated[
    PathLike | None, Option(LABELS, help="File with a 3x3 homography from pixels to metres on the ground.")
]
PointOfBox = Annotated[Point, Option(LABELS, tuning=True, help="Which point of a box touches the ground.")]
#: What files in the working folder may give for a detector, tracker or so on: built-in or installed ones.
PLUGIN: Final = r"[A-Za-z0-9_-]+"
#: The value of a transform's option.
Value = float | int | bool | str | None


def output(shown: str | None = None) -> Option:
    """The option of an output; ``shown`` is its default in the help."""
    return Option(
        FILES, short="o", shown=shown, help="Write to this file, of several logs to this folder; logs stay unchanged."
    )


def similarity(shown: str) -> Option:
    """The option of how ground truth and tracks are matched; ``shown`` is its default in the help."""
    text = (
        "How ground truth and tracks are matched: by overlap of boxes in pictures (iou), distance on the ground "
        "(metres), or overlap of 3D boxes, seen from above (bev-iou) or in space (3d-iou)."
    )
    return Option(SCORES, tuning=True, shown=shown, help=text)


def gate_m(shown: str | None = None) -> Option:
    """The option of the largest distance of a match; ``shown`` is its default in the help."""
    text = "Gate: largest distance in metres at which ground truth and a track match."
    return Option(SCORES, 0.001, 1e6, tuning=True, shown=shown, help=text)


def min_iou(shown: str | None = None) -> Option:
    """The option of the least overlap of a match; ``shown`` is its default in the help."""
    text = "Least overlap (IoU) at which ground truth and a track match."
    return Option(SCORES, 0.001, 1, tuning=True, shown=shown, help=text)


def chooser(kind: Kind, intro: str = "The {kind} to use", panel: str = "", shown: str | None = None) -> Option:
    """The option that chooses a detector, tracker or so on of the registry by name; ``shown`` is its default.

    ``kind`` is that of the registry; ``intro`` is the beginning of its help, with {kind} in the place of the kind, and
    ``panel`` the heading in the help above it.
    """
    from mcaptrack.registry import names, own

    text = (
        f"{intro.format(kind=kind)}: {', '.join(own(kind))}, one of an installed package, or module:Class.\n\n"
        "Or a transform."
    )
    return Option(panel, tuning=PLUGIN, metavar="NAME", shown=shown, names=lambda: names(kind), help=text)


def named(kind: Kind, built_in: Sequence[str], panel: str, flag: str, tuning: str = "", text: str = "") -> Option:
    """The option that chooses a format by name: one of ``built_in``, or one of the registry."""

    def every() -> Sequence[str]:
        from mcaptrack.registry import names

        return (*built_in, *names(kind))

    return Option(panel, flag=flag, tuning=tuning or False, metavar="FORMAT", names=every, help=text)


Output = Annotated[PathLike | None, output()]
MinIou = Annotated[float, min_iou()]


def no_progress(stage: str, done: int, total: int) -> None:
    """Ignore the progress.

    ``stage`` is what is done, ``done`` and ``total`` are numbers of its steps.
    """
