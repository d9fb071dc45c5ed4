"""Recognise label files with 3D boxes, and read them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special
from mcaptrack.sources.ingest.labels.boxes_3d.argoverse import is_argoverse, read_argoverse
from mcaptrack.sources.ingest.labels.boxes_3d.nuscenes import read_nuscenes, tables_folder
from mcaptrack.sources.ingest.labels.content import FORMATS_3D, NO_ID, BoxRows3D, Format
from mcaptrack.sources.ingest.labels.delimited import MAX_LINE, holds_boxes_3d, read_table_3d
from mcaptrack.sources.ingest.labels.formats import ClassNames
from mcaptrack.sources.ingest.labels.number_table import FRAME, MAX_FRAME, NumberTable, lines_of

_BEGIN_BYTES: Final = 4096


def is_3d(path: Path, label_format: Format = "auto", columns: Mapping[str, str] | None = None) -> bool:
    """Whether a label file holds 3D boxes, by the format that is given, or by its content."""
    if label_format in FORMATS_3D:
        return True
    if label_format not in ("auto", "csv") or not path.exists():
        return False
    if path.is_dir():
        return tables_folder(path) is not None or is_argoverse(path)
    if is_argoverse(path):
        return True
    return path.is_file() and not _is_binary(path) and holds_boxes_3d(path, _first_line(path), columns or {})


def _is_binary(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return b"\0" in stream.read(_BEGIN_BYTES)
    except OSError:
        return True  # the reader of other labels says why


def _first_line(path: Path) -> str:
    try:
        return next(lines_of(path, MAX_LINE), (0, ""))[1]
    except McaptrackError:
        return ""


# Read 3D boxes of KITTI tracking labels. Letters: N rows.


_REGION: Final = "dontcare"
_COLUMNS: Final = (
    "frame id type truncated occluded alpha left top right bottom height width length x y z rotation score"
)
#: The frame of reference: of the camera, with z up.
CAMERA_FRAME: Final = "camera_link"


def read_kitti_3d(path: Path) -> BoxRows3D:
    """Read a file of one sequence.

    In the file, x is right, y down and z forward, the position is the centre of the box's bottom, and the rotation
    about y is 0 for an object that faces right. Here x is forward, y left and z up.
    """
    names = ClassNames()

    def parse(parts: list[str]) -> list[float]:
        if len(parts) not in (17, 18):
            raise ValueError(f"{len(parts)} columns")
        score = float(parts[17]) if len(parts) == 18 else np.nan
        return [float(parts[0]), float(parts[1]), names.number(parts[2]), *map(float, parts[10:17]), score]

    table = NumberTable(path, lines_of(path), f"KITTI tracking ({_COLUMNS})", 11, parse)
    frame = table.whole(table.values[:, 0], FRAME, 0, MAX_FRAME)
    track_id = table.whole(table.values[:, 1], "the id", NO_ID)
    kind = table.values[:, 2].astype(np.int64)
    is_region = np.array([name.lower() == _REGION for name in names.names], bool)[kind] if len(kind) else kind == -2
    has_no_box = ~is_region & (table.values[:, 3:6] <= 0).any(axis=1)  # results of detectors in pictures
    kept = np.flatnonzero(~is_region & ~has_no_box)
    if not len(kept):
        raise McaptrackError(f"{path} holds no 3D boxes")
    height, width, length, x, y, z, rotation = table.values[kept, 3:10].T
    heading = -rotation - np.pi / 2
    left = [f"{int(is_region.sum())} regions (DontCare)"] if is_region.any() else []
    left += [f"{int(has_no_box.sum())} rows without a 3D box"] if has_no_box.any() else []
    axes = "x is forward, y left, z up (in the file x is right, y down, z forward); positions are centres of boxes"
    boxes, score = np.full((len(frame), 7), np.nan), table.values[:, 10]
    boxes[kept] = np.stack([z, -x, -y + height / 2, length, width, height, heading], axis=-1)
    rows = BoxRows3D(path, "kitti-3d", table.at, frame, track_id, boxes, score, kind, frame_id=CAMERA_FRAME)
    rows.names, rows.left_out, rows.labelled = names.names, " and ".join(left), np.unique(frame)
    rows.remark(f": {axes}")
    return rows.take(kept)


def read_boxes_3d(
    path: Path,
    role: Role,
    label_format: Format = "auto",
    columns: Mapping[str, str] | None = None,
    scene: str | None = None,
) -> BoxRows3D:
    """Read a label file with 3D boxes.

    Parameters
    ----------
    path : Path
        A text file, a table in Feather format, or the folder of a data set.
    role : str
        "detections", "tracks" or "truth" (ground truth).
    label_format : str
        "auto" detects it from the content.
    columns : dict, optional
        Names of the columns of a table with a header, by what they hold.
    scene : str, optional
        Name of the scene, in nuScenes.

    Returns
    -------
    BoxRows3D

    Raises
    ------
    McaptrackError
        With the place in the file, if it doesn't have this format, or if it can't be boxes in metres with z up.
    """
    refuse_special(path)
    if label_format == "auto" and path.is_dir():
        label_format = "argoverse" if is_argoverse(path) else "nuscenes"
    elif label_format == "auto":
        label_format = "argoverse" if is_argoverse(path) else "csv"
    if columns and label_format != "csv":
        raise McaptrackError(f"{path}: `columns=` is for tables with a header, not for {label_format}")
    if scene is not None and label_format != "nuscenes":
        raise McaptrackError(f"{path}: `scene=` is for nuScenes, not for {label_format}")
    if path.is_dir() and label_format in ("csv", "kitti-3d"):
        raise McaptrackError(f"{path} is a folder, and {label_format} labels are a file")
    if label_format == "nuscenes":
        rows = read_nuscenes(path, scene)
    elif label_format == "argoverse":
        rows = read_argoverse(path)
    else:
        rows = read_kitti_3d(path) if label_format == "kitti-3d" else read_table_3d(path, columns or {})
    rows.check(role)
    return rows
