"""Schemas: what a frame is, and which columns the rows of each channel have.

``schemas/*.proto`` are the single source. The dtype of rows, the Arrow schema of the table and the schema record of the
MCAP channel are all derived from one file; there is no second definition.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaptrack.schema.codec import RowCodec, Rows
from mcaptrack.schema.proto import Column, Definition, parse

if TYPE_CHECKING:
    import pyarrow as pa


class Frame(NamedTuple):
    """The content of one message: ``rows`` at time ``t_ns``.

    Parameters
    ----------
    t_ns : int
        Log time in nanoseconds.
    index : int
        Frame number in the video (the sequence number of the message).
    rows : (N,) structured array
        On the video channel the picture: its brightness, (height, width) uint8, or blue, green and red,
        (height, width, 3), for a transform that asks for colour. A frame without rows is data, too: nothing was
        detected.
    """

    t_ns: int
    index: int  # type: ignore[assignment]  # hides tuple.index, which is not needed here
    rows: NDArray[Any]


def _folder() -> Path:
    """The folder schemas/: inside the installed package, beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "schemas"
    return inside if inside.is_dir() else package.parent / "schemas"


class Schema:
    """The schema of a row channel, with its name in MCAP: "mcaptrack.Tracks".

    ``alternatives`` are groups of optional columns: each row has all columns of at least one group, and none in part.
    """

    def __init__(self, name: str, *alternatives: tuple[str, ...], definition: Definition | None = None) -> None:
        self.name = name
        self.alternatives = alternatives
        self._own = definition

    def __repr__(self) -> str:
        return f"Schema({self.name!r})"

    @property
    def is_own(self) -> bool:
        """Whether a user has defined it, as ``mcaptrack.schema_of`` does."""
        return self._own is not None

    @cached_property
    def definition(self) -> Definition:
        """The parsed schema file, or what a user has defined."""
        if self._own is not None:
            return self._own
        path = _folder() / f"{self.name.rpartition('.')[2]}.proto"
        return parse(path.read_text(encoding="utf-8"), path.name)

    @property
    def columns(self) -> tuple[Column, ...]:
        """The columns in order, with units and descriptions."""
        return self.definition.columns

    @cached_property
    def codec(self) -> RowCodec:
        """Rows <-> payload bytes."""
        return RowCodec(self.definition)

    @property
    def dtype(self) -> np.dtype[np.void]:
        """The dtype of the rows."""
        return self.codec.dtype

    @cached_property
    def descriptor(self) -> bytes:
        """The data of the MCAP schema record (encoding "protobuf"): a serialised FileDescriptorSet."""
        return self.definition.file_descriptor_set().SerializeToString(deterministic=True)

    @cached_property
    def arrow(self) -> pa.Schema:
        """The Arrow schema: unit and description of columns as metadata, optional columns nullable."""
        import pyarrow as pa

        def field(column: Column) -> pa.Field:
            facts = {"unit": column.unit, "description": column.doc}
            return pa.field(
                column.name,
                pa.from_numpy_dtype(self.dtype[column.name]),
                nullable=column.is_nullable,
                metadata={key: value for key, value in facts.items() if value},
            )

        return pa.schema([field(column) for column in self.columns])

    def empty(self, count: int = 0) -> Rows:
        """``count`` rows in which all optional columns are missing; the others are 0."""
        return self.codec.blank(count)

    def joined(self, parts: Sequence[Rows]) -> Rows:
        """Concatenate rows of this schema; as bytes if their layouts are equal, because NumPy copies field by field."""
        if all(part.dtype == self.dtype for part in parts):
            return np.frombuffer(bytearray().join(part.tobytes() for part in parts), self.dtype)
        return np.concatenate([self.empty(), *parts])

    def rows(self, **columns: NDArray[Any] | Sequence[Any]) -> Rows:
        """Make rows from columns, and validate them.

        Parameters
        ----------
        **columns : (N,) array or sequence
            By name of the column. Optional columns may be left out; they are NaN, or -1 if they hold whole numbers.
            Columns that were added to the schema later may be left out, too; they are 0.

        Returns
        -------
        (N,) structured array

        Raises
        ------
        ValueError
            With column and schema, if a column is unknown or missing, has another length, other than whole numbers in
            an integer column, or NaN in a required one; or if a row of detections has neither a box nor a position.

        Examples
        --------
        >>> DETECTIONS.rows(x_px=[1], y_px=[2], w_px=[3], h_px=[4], score=[0.5], class_id=[1])["w_px"].tolist()
        [3.0]
        """
        by_name = {column.name: column for column in self.columns}
        for name in columns:
            if name not in by_name:
                raise ValueError(f"{self.name} has no column {name}; it has {', '.join(by_name)}")
        arrays = {name: np.asarray(values) for name, values in columns.items()}
        lengths = {name: array.shape for name, array in arrays.items()}
        if len(set(lengths.values())) > 1 or any(len(shape) != 1 for shape in lengths.values()):
            raise ValueError(f"{self.name} needs columns of one length, not {lengths}")
        count = len(next(iter(arrays.values()))) if arrays else 0
        out = self.empty(count)
        for name, column in by_name.items():
            if name in arrays:
                self._check_column(column, arrays[name])
                out[name] = arrays[name]
            elif not column.optional and not column.since:
                raise ValueError(f"{self.name} needs the column {name}")
        self._check_alternatives(out)
        return out

    def check(self, rows: NDArray[Any]) -> Rows:
        """Validate rows: exactly this schema's columns, and no NaN in required ones.

        Columns that were added to the schema later may be missing. Returns ``rows`` with all columns. Raises
        ValueError, with column and schema, otherwise.
        """
        names = rows.dtype.names
        wanted = tuple(column.name for column in self.columns)
        if rows.ndim != 1 or names is None:
            kind = "without columns" if names is None else "with columns"
            raise ValueError(f"{self.name} needs a structured array (N,), not an array of shape {rows.shape} {kind}")
        if not self.has_columns(names):
            raise ValueError(f"{self.name} has the columns {', '.join(wanted)}; the rows have {', '.join(names)}")
        if len(names) < len(wanted):
            return self.rows(**{name: rows[name] for name in names})
        for column in self.columns:
            self._check_column(column, rows[column.name])
        self._check_alternatives(rows)
        return rows

    def has_columns(self, names: Iterable[str] | None) -> bool:
        """Whether rows with these columns are of this schema: all of its columns; those added later may be missing."""
        first = {column.name for column in self.columns if not column.since}
        return first <= set(names or ()) <= {column.name for column in self.columns}

    def _check_alternatives(self, rows: Rows) -> None:
        """Raise ValueError if a row has no whole group of columns of which it needs one, or a part of one."""
        if not self.alternatives or not len(rows):
            return
        is_whole = np.zeros(len(rows), bool)
        for group in self.alternatives:
            missing = np.isnan([rows[name] for name in group])
            partly = missing.any(axis=0) & ~missing.all(axis=0)
            if partly.any():
                where = f"in {partly.sum()} rows, first in row {partly.argmax()}"
                raise ValueError(f"{self.name} has only a part of {', '.join(group)} {where}")
            is_whole |= ~missing[0]
        if not is_whole.all():
            wanted = " or ".join(", ".join(group) for group in self.alternatives)
            where = f"missing in {(~is_whole).sum()} rows, first in row {is_whole.argmin()}"
            raise ValueError(f"{self.name} needs {wanted}; all of these are {where}")

    def _check_column(self, column: Column, values: NDArray[Any]) -> None:
        where, kind, target = f"{self.name}.{column.name}", values.dtype.kind, self.dtype[column.name]
        if len(values) == 0:
            return
        if target.kind == "f":
            if kind not in "fiu":
                raise ValueError(f"{where} needs numbers, not {values.dtype}")
            missing = np.isnan(values) if kind == "f" else np.zeros(len(values), bool)
            if not column.optional and missing.any():
                raise ValueError(
                    f"{where} is required and missing in {missing.sum()} rows, first in row {missing.argmax()}"
                )
        elif target.kind == "b":
            if kind != "b":
                raise ValueError(f"{where} needs true or false, not {values.dtype}")
        else:
            if kind not in "iu":
                raise ValueError(f"{where} needs whole numbers, not {values.dtype}")
            limits = np.iinfo(target)
            low, high = int(values.min()), int(values.max())
            if low < limits.min or high > limits.max:
                raise ValueError(f"{where} holds {limits.min} to {limits.max}, not {low if low < limits.min else high}")


#: The columns of a box in a picture, and of a position in space.
BOX_PX: Final = ("x_px", "y_px", "w_px", "h_px")
PLACE_M: Final = ("x_m", "y_m")
#: The covariance of a position on the ground in columns of Detections.
COVARIANCE_M2: Final = ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2")
#: The columns of sizes of boxes, which are not below 0.
SIZES: Final = ("w_px", "h_px", "length_m", "width_m", "height_m")
DETECTIONS: Final = Schema("mcaptrack.Detections", BOX_PX, PLACE_M)
TRACKS: Final = Schema("mcaptrack.Tracks")
#: What a warning of other scores ends with.
SCORES_MAPPED: Final = "likelihoods are from 0 to 1, and tracking maps others to them"
PREDICTIONS: Final = Schema("mcaptrack.Predictions")
GROUND_PLANE: Final = Schema("mcaptrack.GroundPlane")
CAMERA_MOTION: Final = Schema("mcaptrack.CameraMotion")
EVENTS: Final = Schema("mcaptrack.Events")
COUNTS: Final = Schema("mcaptrack.Counts")
SIGHTINGS: Final = Schema("mcaptrack.Sightings")
FORECAST_ERRORS: Final = Schema("mcaptrack.ForecastErrors")
FORECAST_SCORES: Final = Schema("mcaptrack.ForecastScores")
ZONE_VISITS: Final = Schema("mcaptrack.ZoneVisits")
ZONE_CROSSINGS: Final = Schema("mcaptrack.ZoneCrossings")
ZONE_COUNTS: Final = Schema("mcaptrack.ZoneCounts")
DECISIONS: Final = Schema("mcaptrack.Decisions")
APPEARANCE: Final = Schema("mcaptrack.Appearance")
WORLDS: Final = Schema("mcaptrack.Worlds")
#: Row schemas by name.
SCHEMAS: Final = {
    schema.name: schema
    for schema in (
        DETECTIONS,
        TRACKS,
        PREDICTIONS,
        GROUND_PLANE,
        CAMERA_MOTION,
        EVENTS,
        COUNTS,
        FORECAST_ERRORS,
        FORECAST_SCORES,
        SIGHTINGS,
        ZONE_VISITS,
        ZONE_CROSSINGS,
        ZONE_COUNTS,
        DECISIONS,
        APPEARANCE,
        WORLDS,
    )
}
#: Pictures instead of rows: a transform that reads this schema gets their brightness, or their colours if it asks for
#: them.
VIDEO: Final = Schema("foxglove.CompressedVideo")


class BodyPart(IntEnum):
    """The values of the column ``body_part`` of appearance."""

    UPPER_BODY = 1
    LEGS = 2


class DecisionKind(IntEnum):
    """The values of the column ``kind`` of decisions."""

    JOINED = 1
    KEPT = 2
    LEFT_OUT = 3


class EventKind(IntEnum):
    """The values of the column ``kind`` of events."""

    MISS = 2
    FALSE_TRACK = 3
    SWITCH = 4
    BIRTH = 5
    END = 6
    JOINED = 7
    PARTED = 8


#: Their names, as in the comments of the schema.
EVENT_KINDS: Final = {kind: kind.name.lower().replace("_", " ") for kind in EventKind} | {
    EventKind.SWITCH: "identity switch"
}
