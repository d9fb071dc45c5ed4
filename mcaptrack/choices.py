"""Names and ranges that options and parameters accept. This module imports nothing of the package, so that
declaring a command costs nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final, Literal, TypeAlias

__all__ = ["Role", "Similarity"]

#: How pictures are stored.
ImageFormat = Literal["auto", "h264", "h265", "jpeg", "png"]
#: Units of lengths in a calibration.
LengthUnit = Literal["auto", "m", "cm", "mm"]
#: Which point of a box touches the ground.
Point = Literal["foot", "center"]
#: What a label file holds, and what an input that is a text file can hold.
Role = Literal["detections", "tracks", "truth", "corrections"]
InputRole: TypeAlias = Role | Literal["motion", "calibration"]
#: How ground truth and tracks are matched.
Similarity = Literal["iou", "metres", "bev-iou", "3d-iou"]
#: Which tracks re-tracking writes.
Mode = Literal["both", "offline", "online"]
#: Whether tracks are compensated for the motion of the camera.
CameraMotionUse = Literal["auto", "on", "off"]
#: Formats of tables, and of files with the boxes of one channel; the registry has more of these.
TableFormat = Literal["parquet", "arrow", "csv", "jsonl"]
BoxFormat = Literal["mot"]
#: The layouts of a log for viewers, and the end of the name of each file; the first one is the default.
LAYOUTS: Final[Mapping[str, str]] = {
    "tracking": ".layout.json",
    "comparing": ".comparing.layout.json",
    "predictions": ".predictions.layout.json",
}


def limits(least: float, most: float) -> str:
    """The text of a range, as in "from 0 to 1"; "" if it has no ends."""
    if most == math.inf:
        return "" if least == -math.inf else f"at least {_number(least)}"
    return f"at most {_number(most)}" if least == -math.inf else f"from {_number(least)} to {_number(most)}"


def _number(value: float) -> str:
    return f"{value:.15g}"
