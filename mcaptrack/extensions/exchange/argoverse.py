"""Read the 3D boxes of a log of Argoverse 2: annotations.feather, and the poses of the vehicle beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from mcaptrack.errors import McaptrackError
from mcaptrack.files import reading
from mcaptrack.geometry.arrays import Floats, Ints
from mcaptrack.sources.ingest.labels.format import Format, LabelFile
from mcaptrack.sources.ingest.labels.table import NO_CLASS, Asked, BoxTable, LabelFacts
from mcaptrack.sources.ingest.labels.text import ClassNames, headings, numbered

BOXES: Final = "annotations.feather"
POSES: Final = "city_SE3_egovehicle.feather"
#: The column of ids, which the beginning of a table names.
_TRACKS: Final = b"track_uuid"
_TIME: Final = "timestamp_ns"
_QUATERNION: Final = ("qw", "qx", "qy", "qz")
_PLACE: Final = ("tx_m", "ty_m", "tz_m")
_SIZE: Final = ("length_m", "width_m", "height_m")
#: The frames of reference of the boxes with and without the poses.
CITY, VEHICLE = "map", "base_link"


class Argoverse(Format):
    """A table of boxes, or the folder of a log with it."""

    title = "Argoverse 2"
    row = "`annotations.feather`, or a folder with it"
    rank = 2
    in_space = True
    reads_folders = True

    def recognises(self, file: LabelFile) -> bool:
        """Whether it is a table of boxes, or the folder of a log, with or without one."""
        path = file.path
        is_table = path.suffix == ".feather" and (path.name == BOXES or _TRACKS in file.head)
        return is_table or (file.is_folder and any((path / name).is_file() for name in (BOXES, POSES)))

    def read(self, file: LabelFile, asked: Asked) -> BoxTable:
        """The boxes of a log, in the city's frame if the poses are there."""
        return _read(file.path)


def _read(path: Path) -> BoxTable:
    if path.is_dir() and not (path / BOXES).is_file():
        raise McaptrackError(f"{path} has no {BOXES}: it is a log of Argoverse 2 without labels")
    path = path / BOXES if path.is_dir() else path
    table = _Table(path, (_TIME, "track_uuid", "category", *_SIZE, *_QUATERNION, *_PLACE))
    tracks, kinds = table.columns["track_uuid"], table.columns["category"]

    def at(row: int) -> str:
        return f"{path}: row {row + 1}"

    t_ns, place, quaternions = table.times(), table.floats(_PLACE), table.floats(_QUATERNION)
    headings(quaternions, path, at)  # boxes that don't stand upright are refused
    poses, frame_id = path.with_name(POSES), VEHICLE
    remarks = [f"{path}: there is no {POSES} beside it; boxes stay in the vehicle's frame"]
    if poses.is_file():
        place, quaternions = _in_city(poses, t_ns, place, quaternions)
        frame_id, remarks = CITY, [f"{path}: boxes are in the city's frame, by {POSES}"]
    heading = headings(quaternions, path, at)[0]
    if None in tracks:
        raise McaptrackError(f"{at(tracks.index(None))} has no track_uuid")
    names = ClassNames()
    try:
        kind = np.array([NO_CLASS if name is None else names.number(str(name)) for name in kinds], np.int64)
    except ValueError as error:
        raise McaptrackError(f"{path}: {error}") from None
    remarks.append(f"{path}: tracks are numbered from 1 on, a number for each track_uuid")
    facts = LabelFacts(path, is_timed=True, frame_id=frame_id)
    facts.name(names.names)
    return BoxTable(
        facts=facts, at=at, frame=t_ns, id=numbered([f"#{track}" for track in tracks]), class_id=kind, remarks=remarks,
        boxes_m=np.column_stack([place, table.floats(_SIZE), heading]), score=np.full(len(tracks), np.nan),
    )  # fmt: skip


def _in_city(path: Path, t_ns: Ints, place: Floats, quaternions: Floats) -> tuple[Floats, Floats]:
    """Boxes of the vehicle's frame in the city's: positions (N, 3) and quaternions (N, 4), by the pose at each time."""
    table = _Table(path, (_TIME, *_QUATERNION, *_PLACE))
    pose_ns, first = np.unique(table.times(), return_index=True)
    which = np.minimum(np.searchsorted(pose_ns, t_ns), max(len(pose_ns) - 1, 0))
    without = pose_ns[which] != t_ns if len(pose_ns) else np.ones(len(t_ns), bool)
    if without.any():
        times = len(np.unique(t_ns[without]))
        raise McaptrackError(f"{path} has no pose at {times} times of boxes, the first {t_ns[without.argmax()]} ns")
    turn = table.floats(_QUATERNION)[first][which]
    turn = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    return _rotated(turn, place) + table.floats(_PLACE)[first][which], _product(turn, quaternions)


def _rotated(quaternions: Floats, points: Floats) -> Floats:
    """Points (N, 3) rotated by unit quaternions (N, 4)."""
    axis, w = quaternions[:, 1:], quaternions[:, :1]
    across = 2 * np.cross(axis, points)
    return np.asarray(points + w * across + np.cross(axis, across))


def _product(a: Floats, b: Floats) -> Floats:
    """The products (N, 4) of quaternions: the rotation by ``b``, then by ``a``."""
    (aw, av), (bw, bv) = ((quaternion[:, :1], quaternion[:, 1:]) for quaternion in (a, b))
    return np.column_stack([aw * bw - (av * bv).sum(axis=1, keepdims=True), aw * bv + bw * av + np.cross(av, bv)])


class _Table:
    """Columns of a table in Feather format. Raises McaptrackError if it is none, or lacks one of them."""

    def __init__(self, path: Path, names: tuple[str, ...]) -> None:
        import pyarrow as pa
        from pyarrow import feather

        self.path = path
        try:
            with reading(path) as stream:
                table = feather.read_table(stream)
        except (pa.ArrowException, ValueError) as error:
            raise McaptrackError(f"{path} is no table in Feather format: {str(error).splitlines()[0][:80]}") from None
        if missing := [name for name in names if name not in table.column_names]:
            listed = ", ".join(table.column_names)[:200]
            raise McaptrackError(f"{path} has no column {missing[0]}, as Argoverse 2 has; its columns are {listed}")
        try:
            table.validate(full=True)
            self.columns: dict[str, Any] = table.select(names).to_pydict()
        except (UnicodeDecodeError, pa.ArrowException, ValueError) as error:
            raise McaptrackError(f"{path} is damaged: {str(error).splitlines()[0][:80]}") from None

    def floats(self, names: tuple[str, ...]) -> Floats:
        """Columns (N, K) of numbers."""
        try:
            return np.array([self.columns[name] for name in names], float).T.reshape(-1, len(names))
        except (TypeError, ValueError):
            raise McaptrackError(f"{self.path}: {', '.join(names)} have to be numbers") from None

    def times(self) -> Ints:
        """The column (N,) of times, ns."""
        values = np.array(self.columns[_TIME])
        if values.dtype.kind not in "iu" and len(values):
            raise McaptrackError(f"{self.path}: {_TIME} has to be whole numbers")
        return values.astype(np.int64)
