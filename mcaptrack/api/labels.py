"""Options of label files, which mean the same in every command that takes such files."""

from __future__ import annotations

import json
from collections.abc import Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, Annotated, Final

from mcaptrack import notices
from mcaptrack.api.declared import Option
from mcaptrack.api.options import PLUGIN, PathLike, named
from mcaptrack.choices import Point
from mcaptrack.errors import McaptrackError

if TYPE_CHECKING:
    from mcaptrack.sources.ingest import IngestOptions

__all__ = ["Classes", "Format", "LabelFps", "label_options", "warn_of_unused"]

#: The heading in the help.
READING: Final = "Reading of label files"
#: What a file in the working folder may give for frames per second.
FPS_PATTERN: Final = r"[0-9]+([.][0-9]+)?(/[0-9]+)?"

Format = Annotated[
    str,
    named(
        "label_format", ("auto",), READING, "format", PLUGIN,
        "Format of label files, one of an installed package, or module:Class. auto: as the content tells; csv: any "
        "table with a header.\n\nThose of 3D boxes are csv, kitti-3d, nuscenes and argoverse.",
    ),
]  # fmt: skip
Columns = Annotated[
    str | Mapping[str, str] | None,
    Option(
        READING,
        help="Columns of label files with a header: x=left,y=top,w=width,h=height,frame=n. Also x2, y2, cx, cy, t "
        "(seconds), score, class, name (of the class), id; 3D boxes: x_m, y_m, z_m, length_m, width_m, height_m, "
        "heading_rad, heading_deg, qw to qz; by default guessed from the header.\n\n"
        'A dict has what they hold as keys: ``{"x": "left", "frame": "n"}``.',
    ),
]
Classes = Annotated[
    str | None,
    Option(
        READING,
        help="Classes of tracks and ground truth in label files, by name or number, as in person,car; all for every "
        "one; by default person, of 3D boxes all.\n\nDetections keep all.",
    ),
]
ClassNames = Annotated[
    str | Mapping[str, str] | None,
    Option(
        READING,
        metavar="MAP",
        help="Names of the classes of label files: 0=person,2=car, coco for the 80 of COCO from 0, or a file with a "
        "name in each line; by default as the file, or one beside it, says.",
    ),
]
FirstFrame = Annotated[
    int | str | Mapping[str, int] | None,
    Option(
        READING,
        tuning=r"[0-9]+|(detections|tracks|truth|corrections)=[0-9]+(,(detections|tracks|truth|corrections)=[0-9]+)*",
        metavar="N",
        help="Number of the first picture in label files, also of each kind as in tracks=0,truth=1; by default 1 in "
        "MOTChallenge, otherwise 0.",
    ),
]
LabelledFrames = Annotated[
    int | str | None,
    Option(
        READING,
        tuning=r"[0-9:,]+",
        metavar="N|FIRST:END",
        help="Which frames the ground truth describes, by its own numbers: 100:110 are frames 100 to 109 (the end is "
        "not one of them), 100: all from 100 on, : all. Others count in no score. Or how many frames there are, if "
        "there are no pictures; by default as the file or seqinfo.ini says, otherwise up to the last label.\n\n"
        "Several ranges have commas between them: 0:10,50:60.",
    ),
]
LabelFps = Annotated[
    float | str | Fraction | None,
    Option(
        READING,
        tuning=FPS_PATTERN,
        help="Frames per second of label files, such as 25 or 30000/1001; by default as seqinfo.ini beside them says.",
    ),
]
Size = Annotated[
    str | tuple[int, int] | None,
    Option(
        READING,
        shown=False,
        help="Width and height of the pictures, like 1920x1080, if there are only labels in shares of them.",
    ),
]


#: The options of label files in every command, by the names of ``IngestOptions``, for warnings.
_NAMES: Final = (
    "ground_plane", "point", "fps", "label_format", "columns", "classes", "class_map", "first_frame", "frames",
    "frame_ranges", "size",
)  # fmt: skip


def label_options(
    *,
    label_format: str = "auto",
    columns: str | Mapping[str, str] | None = None,
    classes: str | None = None,
    class_map: str | Mapping[str, str] | None = None,
    first_frame: int | str | Mapping[str, int] | None = None,
    frames: int | str | None = None,
    fps: float | str | Fraction | None = None,
    size: str | tuple[int, int] | None = None,
    ground_plane: PathLike | None = None,
    point: Point = "foot",
) -> IngestOptions:
    """Return options as values. Raises McaptrackError for texts that say none.

    The parameters are those of ``mcaptrack.ingest``, which explains them.
    """
    from mcaptrack.api.common import optional_path
    from mcaptrack.schema.classes import ClassMap
    from mcaptrack.sources.ingest import IngestOptions
    from mcaptrack.sources.ingest.labels.delimited import parse_columns
    from mcaptrack.sources.ingest.labels.frames import Frames, parse_first_frames
    from mcaptrack.sources.ingest.labels.roles import WantedClasses

    count, ranges = Frames.parse(frames)
    pairs = (
        json.dumps({str(own): name for own, name in class_map.items()}) if isinstance(class_map, Mapping) else class_map
    )
    return IngestOptions(
        label_format=label_format,
        columns=parse_columns(columns) if columns else None,
        classes=None if classes is None else WantedClasses(classes),
        class_map=None if pairs is None else ClassMap.parse(pairs),
        first_frame=parse_first_frames(first_frame),
        frames=count,
        frame_ranges=ranges,
        fps=parse_fps(fps),
        size=parse_size(size),
        ground_plane=optional_path(ground_plane),
        point=point,
    )


def warn_of_unused(options: IngestOptions, reason: str, *but: str) -> None:
    """Warn of options of label files that were given and change nothing, apart from some; ``reason`` says why.

    ``but`` are the names of those that do change something.
    """
    for given in [options.given(name) for name in _NAMES if name not in but]:
        if given:
            notices.warn(f"{given} changes nothing here: {reason}", "option-not-used")


def parse_fps(fps: float | str | Fraction | None) -> Fraction | None:
    """Return frames per second as a fraction, from 25, "29.97" or "30000/1001"."""
    from mcaptrack.geometry import clocks

    try:
        return None if fps is None else clocks.parse_fps(str(fps))
    except ValueError:
        raise McaptrackError(
            f"`fps=` needs a number like 25, 29.97 or 30000/1001, from one frame a day to 10000 a second, not {fps!r}"
        ) from None


def parse_size(size: str | tuple[int, int] | None) -> tuple[int, int] | None:
    """Return width and height from "1920x1080" or two numbers."""
    from mcaptrack.geometry import boxes

    if size is None:
        return None
    parsed = boxes.parse_size(size if isinstance(size, str) else "x".join(map(str, size)))
    if parsed is None:
        raise McaptrackError(f"`size=` is the width and height of pictures in pixels, like 1920x1080, not {size!r:.40}")
    return parsed
