"""Recognise label files with 3D boxes, and read them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special
from mcaptrack.sources.ingest.labels.boxes_3d.argoverse import is_argoverse, read_argoverse
from mcaptrack.sources.ingest.labels.boxes_3d.kitti import read_kitti_3d
from mcaptrack.sources.ingest.labels.boxes_3d.nuscenes import read_nuscenes, tables_folder
from mcaptrack.sources.ingest.labels.boxes_3d.rows import BoxRows3D
from mcaptrack.sources.ingest.labels.boxes_3d.table import holds_boxes_3d, read_table
from mcaptrack.sources.ingest.labels.content import FORMATS_3D, Format
from mcaptrack.sources.ingest.labels.delimited import MAX_LINE
from mcaptrack.sources.ingest.labels.number_table import lines_of

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
        rows = read_kitti_3d(path) if label_format == "kitti-3d" else read_table(path, columns or {})
    rows.check(role)
    return rows
