"""Shapes: what a frame is, and what the rows of each channel are.

``schemas/*.proto`` are the single source. From one file follow the dtype of its rows, the Arrow schema of its table and
the schema record of its MCAP channel; no second description exists anywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
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

__all__ = [
    "COUNTS",
    "DETECTIONS",
    "EVENTS",
    "EVENT_KINDS",
    "FORECAST_ERRORS",
    "FORECAST_SCORES",
    "GROUND_PLANE",
    "PREDICTIONS",
    "SCHEMAS",
    "TRACKS",
    "VIDEO",
    "Column",
    "EventKind",
    "Frame",
    "Rows",
    "Schema",
]


class Frame(NamedTuple):
    """What one message says: ``rows`` at time ``t_ns``.

    ``t_ns`` is the log time in nanoseconds, ``index`` the frame number of the video (the message's sequence number).
    ``rows`` is a structured array; on the video channel it is the picture's brightness, (height, width) uint8. A frame
    without rows is data: looked, saw nothing.
    """

    t_ns: int
    index: int  # type: ignore[assignment]  # hides tuple.index, which nobody wants here
    rows: NDArray[Any]


def _folder() -> Path:
    """schemas/ lies inside the installed package, and beside it in a checkout."""
    package = Path(__file__).resolve().parent.parent
    inside = package / "schemas"
    return inside if inside.is_dir() else package.parent / "schemas"


class Schema:
    """The rows of one kind of channel, named as in MCAP: "mcaptrack.Tracks"."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __repr__(self) -> str:
        return f"Schema({self.name!r})"

    @cached_property
    def definition(self) -> Definition:
        """The schema file, read."""
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
        """The Arrow fields of the columns: unit and description as metadata, nullable where a number may be missing."""
        import pyarrow as pa

        def field(column: Column) -> pa.Field:
            words = {"unit": column.unit, "description": column.doc}
            return pa.field(
                column.name,
                pa.from_numpy_dtype(self.dtype[column.name]),
                nullable=column.optional,
                metadata={key: value for key, value in words.items() if value},
            )

        return pa.schema([field(column) for column in self.columns])

    def empty(self, count: int = 0) -> Rows:
        """``count`` rows of zeros, to be filled."""
        return np.zeros(count, self.dtype)

    def joined(self, parts: Sequence[Rows]) -> Rows:
        """Rows of this schema laid end to end; as bytes where they are laid out alike, since NumPy goes by fields."""
        if all(part.dtype == self.dtype for part in parts):
            return np.frombuffer(bytearray().join(part.tobytes() for part in parts), self.dtype)
        return np.concatenate([self.empty(), *parts])

    def rows(self, **columns: NDArray[Any] | Sequence[Any]) -> Rows:
        """Rows from columns, through the gate. Optional columns that are left out are missing (NaN).

        Raises ValueError, with the column and the schema, unless there are exactly the schema's columns, all of one
        length, whole numbers where whole numbers belong, and no required number missing.
        """
        known = {column.name: column for column in self.columns}
        for name in columns:
            if name not in known:
                raise ValueError(f"{self.name} has no column {name}; it has {', '.join(known)}")
        arrays = {name: np.asarray(values) for name, values in columns.items()}
        lengths = {name: array.shape for name, array in arrays.items()}
        if len(set(lengths.values())) > 1 or any(len(shape) != 1 for shape in lengths.values()):
            raise ValueError(f"{self.name} needs columns of one length, not {lengths}")
        count = len(next(iter(arrays.values()))) if arrays else 0
        out = self.empty(count)
        for name, column in known.items():
            if name in arrays:
                self._check_column(column, arrays[name])
                out[name] = arrays[name]
            elif column.optional:
                out[name] = np.nan
            else:
                raise ValueError(f"{self.name} needs the column {name}")
        return out

    def check(self, rows: NDArray[Any]) -> Rows:
        """The gate for rows that exist: exactly this schema's columns, and nothing required missing.

        Returns ``rows``; raises ValueError with the column and the schema otherwise.
        """
        names = rows.dtype.names
        wanted = tuple(column.name for column in self.columns)
        if rows.ndim != 1 or names is None:
            raise ValueError(f"{self.name} needs a structured array of rows, not {rows.dtype} of shape {rows.shape}")
        if set(names) != set(wanted):
            raise ValueError(f"{self.name} has the columns {', '.join(wanted)}; the rows have {', '.join(names)}")
        for column in self.columns:
            self._check_column(column, rows[column.name])
        return rows

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


DETECTIONS: Final = Schema("mcaptrack.Detections")
TRACKS: Final = Schema("mcaptrack.Tracks")
PREDICTIONS: Final = Schema("mcaptrack.Predictions")
GROUND_PLANE: Final = Schema("mcaptrack.GroundPlane")
EVENTS: Final = Schema("mcaptrack.Events")
COUNTS: Final = Schema("mcaptrack.Counts")
FORECAST_ERRORS: Final = Schema("mcaptrack.ForecastErrors")
FORECAST_SCORES: Final = Schema("mcaptrack.ForecastScores")
#: Row schemas by name.
SCHEMAS: Final = {
    schema.name: schema
    for schema in (
        DETECTIONS,
        TRACKS,
        PREDICTIONS,
        GROUND_PLANE,
        EVENTS,
        COUNTS,
        FORECAST_ERRORS,
        FORECAST_SCORES,
    )
}
#: Not rows but pictures: a transform that reads this gets the brightness of each frame.
VIDEO: Final = Schema("foxglove.CompressedVideo")


class EventKind(IntEnum):
    """The column ``kind`` of events."""

    MISS = 2
    FALSE_TRACK = 3
    SWITCH = 4
    BIRTH = 5
    END = 6
    JOINED = 7
    PARTED = 8


#: The words for them, as the schema has them.
EVENT_KINDS: Final = {
    EventKind.MISS: "miss",
    EventKind.FALSE_TRACK: "false track",
    EventKind.SWITCH: "identity switch",
    EventKind.BIRTH: "birth",
    EventKind.END: "end",
    EventKind.JOINED: "joined",
    EventKind.PARTED: "parted",
}
