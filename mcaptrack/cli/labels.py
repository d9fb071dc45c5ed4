"""Options of commands that read label files, or compare tracks with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, Literal

from mcaptrack.cli import common

#: Headings of options in the help: label files, and how tracks are matched with ground truth.
LABELS: Final = "Label files"
SCORES: Final = "Scores"

SimilarityName = Literal["iou", "metres", "bev-iou", "3d-iou"]
GroundPlane = Annotated[
    Path | None,
    common.option(
        "--ground-plane",
        panel=LABELS,
        help="File with a 3x3 homography from pixels to metres on the ground.",
    ),
]
Point = Annotated[
    Literal["center", "foot"],
    common.option("--point", panel=LABELS, tuning=True, help="Which point of a box touches the ground."),
]
FPS_PATTERN: Final = r"[0-9]+([.][0-9]+)?(/[0-9]+)?"
LabelFps = Annotated[
    str | None,
    common.option(
        "--fps",
        panel=LABELS,
        tuning=FPS_PATTERN,
        help="Frames per second of label files.",
        show_default="as seqinfo.ini beside them says",
    ),
]


def similarity(shown: str) -> Any:
    """Return the option --similarity; ``shown`` is its default in the help."""
    text = (
        "How ground truth and tracks are matched: by overlap of boxes in pictures (iou), distance on the ground "
        "(metres), or overlap of 3D boxes, seen from above (bev-iou) or in space (3d-iou)."
    )
    return common.option("--similarity", panel=SCORES, tuning=True, help=text, show_default=shown)


def gate_m(shown: str | bool = True, tuning: str | bool = True) -> Any:
    """Return the option --gate-m."""
    text = "Gate: largest distance in metres at which ground truth and a track match."
    ends: dict[str, Any] = {} if isinstance(tuning, str) else {"least": 0.001, "most": 1e6}  # text is several numbers
    return common.option("--gate-m", panel=SCORES, tuning=tuning, help=text, show_default=shown, **ends)


def min_iou() -> Any:
    """Return the option --min-iou."""
    text = "Least overlap (IoU) at which ground truth and a track match."
    return common.option("--min-iou", panel=SCORES, tuning=True, help=text, show_default="0.5", least=0.001, most=1)
