"""The tables: columns with units and descriptions, keys, and the order of rows.

Columns are only ever added, and added columns may be missing, so that old files and new ones can be read together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from hashlib import sha256
from typing import TYPE_CHECKING, Any, Final

from mcaptrack.geometry.camera_path import Verdict
from mcaptrack.schema import (
    APPEARANCE,
    CAMERA_MOTION,
    DECISIONS,
    EVENT_KINDS,
    EVENTS,
    SCHEMAS,
    SIGHTINGS,
    ZONE_COUNTS,
    ZONE_CROSSINGS,
    ZONE_VISITS,
    BodyPart,
    DecisionKind,
    Schema,
)
from mcaptrack.schema.classes import has_classes

if TYPE_CHECKING:
    import pyarrow as pa

#: Grows when values of columns mean something else.
_MEANING: Final = 2

#: The unit of counts and ids.
_NONE: Final = "1"
#: The kinds of columns.
_TEXT, _NAME, _INT, _FLOAT, _TIME, _FLAG = "text", "name", "int64", "float64", "time", "flag"


@dataclass(frozen=True)
class Field:
    """A column. ``kind`` is text, name (text that repeats), int64, float64, time or flag."""

    name: str
    kind: str
    description: str
    unit: str = ""
    nullable: bool = False

    @cached_property
    def arrow(self) -> pa.Field:
        """The column in Arrow, with unit and description as metadata."""
        import pyarrow as pa

        kinds = {
            _TEXT: pa.string(),
            _NAME: pa.dictionary(pa.int32(), pa.string()),
            _INT: pa.int64(),
            _FLOAT: pa.float64(),
            _TIME: pa.timestamp("ns", tz="UTC"),
            _FLAG: pa.bool_(),
        }
        unit = self.unit or (_NONE if self.kind in (_INT, _FLOAT) else "")
        metadata = {"unit": unit, "description": self.description}
        return pa.field(self.name, kinds[self.kind], nullable=self.nullable, metadata=metadata)


@dataclass(frozen=True)
class Table:
    """A table: the meaning of a row, the key columns within a recording, and the order of rows.

    ``rows_of`` is the schema of its rows, None for tables about a log.
    """

    name: str
    doc: str
    key: tuple[str, ...]
    order: tuple[str, ...]
    fields: tuple[Field, ...] = ()
    rows_of: Schema | None = None

    @cached_property
    def arrow(self) -> pa.Schema:
        """The Arrow schema of the table, without ``recording``, which is in the name of the folder."""
        import pyarrow as pa

        fields = [field.arrow for field in self.fields]
        if self.rows_of is not None:
            fields += [_with_unit(field) for field in self.rows_of.arrow]
            fields += [CLASS.arrow] if has_classes(self.rows_of) else []
            fields += [TRACK_CLASS.arrow] if self.is_of_tracks() else []
            fields += [self.code.beside.arrow] if self.code else []
            fields += [TRACK_TOPIC.arrow] if self.is_of_tracks() else []
        return pa.schema(fields)

    @property
    def code(self) -> Code | None:
        """The column of its rows, besides the class, with numbers instead of names."""
        return None if self.rows_of is None else CODES.get(self.rows_of.name)

    def is_of_tracks(self) -> bool:
        """Whether its rows name tracks by their ids, and so have the classes of these."""
        if self.rows_of is None or self.rows_of.name not in SCHEMAS:
            return False
        names = {column.name for column in self.rows_of.columns}
        return "track_id" in names and "class_id" not in names


def _with_unit(field: Any) -> Any:
    """A field of a row schema, with a unit if it has none."""
    import pyarrow as pa

    metadata = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
    unit = "" if pa.types.is_boolean(field.type) else _NONE
    return field.with_metadata({"unit": unit, "description": ""} | metadata)


_TOPIC: Final = Field("topic", _NAME, "channel of the log that the row comes from")
_FRAME: Final = Field("frame", _INT, "number of the frame: of the picture in the video, from 0")
_T: Final = Field("t", _TIME, "log time", "ns")
_T_NS: Final = Field("t_ns", _INT, "log time as a whole number since 1970, exact in all readers", "ns")
#: The first columns of each table of rows.
TIMES: Final = (_TOPIC, _FRAME, _T, _T_NS)
_ROW: Final = Field("row", _INT, "number of the row in its channel, in the order of the log, from 0")
#: The last column of each table of rows with a ``class_id``.
CLASS: Final = Field("class", _NAME, "name of its class in this channel; null if it has none", nullable=True)

#: The last column of each table of rows that name tracks of another channel.
TRACK_CLASS: Final = Field(
    CLASS.name,
    _NAME,
    "name of the class of its track, or of the object that is missed; null if it has none",
    nullable=True,
)

#: The column, in the same tables, with the channel of these tracks.
TRACK_TOPIC: Final = Field(
    "track_topic", _NAME, "channel of the tracks that track_id names; null if the log has none", nullable=True
)


@dataclass(frozen=True)
class Code:
    """A column with numbers instead of names.

    The column ``beside`` it has the ``names``; these are empty if each channel has its own.
    """

    column: str
    beside: Field
    names: Iterable[tuple[int, str]] = ()

    @classmethod
    def of_kinds(cls, column: str, names: Mapping[int, str]) -> Code:
        """The code of a column that means the same in each channel."""
        beside = Field(f"{column}_name", _NAME, f"what {column} stands for", nullable=True)
        return cls(column, beside, tuple(names.items()))


def _in_words(codes: Iterable[BodyPart | DecisionKind | Verdict]) -> dict[int, str]:
    return {int(code): code.name.lower().replace("_", " ") for code in codes}


_ZONE: Final = Code("zone_id", Field("zone", _NAME, "name of the zone or line; null if it has none", nullable=True))
#: The codes in the rows of schemas, by name of the schema.
CODES: Final[Mapping[str, Code]] = {
    EVENTS.name: Code.of_kinds("kind", {int(kind): name for kind, name in EVENT_KINDS.items()}),
    DECISIONS.name: Code.of_kinds("kind", _in_words(DecisionKind)),
    APPEARANCE.name: Code.of_kinds("body_part", _in_words(BodyPart)),
    CAMERA_MOTION.name: Code.of_kinds("verdict", _in_words(Verdict)),
    SIGHTINGS.name: Code("camera", Field("camera_name", _NAME, "name of the camera", nullable=True)),
    ZONE_VISITS.name: _ZONE,
    ZONE_CROSSINGS.name: _ZONE,
    ZONE_COUNTS.name: _ZONE,
}

#: The column with the name of the log; in files it is in the name of the folder.
RECORDING: Final = Field("recording", _NAME, "the log, by name; the same in all tables")

_FRAMES: Final = Table(
    "frames",
    "One row a message of a channel of rows or pictures: its place in the log, and its number of rows. With it a frame "
    "without people can be told from a time at which no frame was processed.",
    ("topic", "t_ns", "message_offset", "chunk_offset"),
    ("topic", "t_ns"),
    (
        *TIMES,
        Field("rows", _INT, "rows of the message; null for a picture", nullable=True),
        Field("file", _NAME, "name of the log file that holds the message", nullable=True),
        Field("chunk_offset", _INT, "where its chunk begins in that file; null outside of chunks", "byte", True),
        Field(
            "message_offset",
            _INT,
            "where its record begins in the uncompressed chunk; in the file, outside of chunks",
            "byte",
            True,
        ),
    ),
)

_SUMMARY: Final = Table(
    "track_summary",
    "One row a track of a channel of tracks.",
    ("topic", "track_id"),
    ("topic", "track_id"),
    (
        _TOPIC,
        Field("track_id", _INT, "identity, constant over time within one channel"),
        Field("first_t", _TIME, "log time of the first row", "ns"),
        Field("last_t", _TIME, "log time of the last row", "ns"),
        Field("first_t_ns", _INT, "log time of the first row, exact", "ns"),
        Field("last_t_ns", _INT, "log time of the last row, exact", "ns"),
        Field("first_frame", _INT, "frame of the first row"),
        Field("last_frame", _INT, "frame of the last row"),
        Field("duration_s", _FLOAT, "from the first row to the last", "s"),
        Field("rows", _INT, "how many rows it has"),
        Field("observed_share", _FLOAT, "share of rows with a detection, between 0 and 1"),
        Field("path_m", _FLOAT, "length of the path over all known positions, straight over gaps", "m", True),
        Field("mean_speed_m_s", _FLOAT, "path by the time between the first and the last known position", "m/s", True),
        Field("max_speed_m_s", _FLOAT, "largest distance by time from one known position to the next", "m/s", True),
        Field("first_x_m", _FLOAT, "first known position on the ground plane, first axis", "m", True),
        Field("first_y_m", _FLOAT, "first known position on the ground plane, second axis", "m", True),
        Field("last_x_m", _FLOAT, "last known position on the ground plane, first axis", "m", True),
        Field("last_y_m", _FLOAT, "last known position on the ground plane, second axis", "m", True),
        Field("first_x_px", _FLOAT, "left edge of the first known box", "px", True),
        Field("first_y_px", _FLOAT, "top edge of the first known box", "px", True),
        Field("last_x_px", _FLOAT, "left edge of the last known box", "px", True),
        Field("last_y_px", _FLOAT, "top edge of the last known box", "px", True),
        Field("class_id", _INT, "class of most of its rows: 0 unknown, 1 person, others by number"),
        CLASS,
    ),
)

#: The metrics that ``recordings`` has, too.
SCORES: Final = ("MOTA", "IDF1", "HOTA", "IDSW")
_METRICS: Final = Table(
    "metrics",
    "One row a channel of tracks, similarity and gate: its scores against the ground truth of its camera, the numbers "
    "of evaluate. Where there are several classes, also a row for each. No rows where the log has no ground truth.",
    ("topic", "similarity", "gate", "class"),
    ("topic", "similarity", "gate"),
    (
        Field("topic", _NAME, "the tracks that are scored"),
        Field("truth", _NAME, "the channel that they are scored against"),
        Field("mode", _TEXT, "online or offline for re-tracked tracks; null for others", nullable=True),
        Field(
            "similarity",
            _TEXT,
            "iou: overlap of boxes; metres: distance on the ground; bev-iou, 3d-iou: overlap of 3D boxes",
        ),
        Field("gate", _FLOAT, "least overlap, or largest distance in metres, of a match"),
        Field("rules", _TEXT, "rules for identity switches and fragmentations"),
        Field("MOTA", _FLOAT, "CLEAR: 1 less misses, false positives and switches by rows of the ground truth"),
        Field("IDF1", _FLOAT, "identity: F1 of rows under the best assignment of tracks to people"),
        Field("IDP", _FLOAT, "identity: precision"),
        Field("IDR", _FLOAT, "identity: recall"),
        Field("HOTA", _FLOAT, "higher order tracking accuracy, mean over thresholds"),
        Field("DetA", _FLOAT, "HOTA: accuracy of detection"),
        Field("AssA", _FLOAT, "HOTA: accuracy of association"),
        Field("LocA", _FLOAT, "HOTA: accuracy of localisation"),
        Field("IDSW", _INT, "identity switches"),
        Field("FP", _INT, "false positives"),
        Field("FN", _INT, "misses"),
        Field("Frag", _INT, "fragments"),
        Field("MT", _INT, "people tracked for at least 80 % of their time"),
        Field("PT", _INT, "people tracked for a part of their time"),
        Field("ML", _INT, "people tracked for less than 20 % of their time"),
        Field("GT", _INT, "people of the ground truth"),
        Field("ADE_m", _FLOAT, "forecasts: mean distance from the ground truth", "m", True),
        Field("FDE_m", _FLOAT, "forecasts: mean distance from the ground truth at the last step", "m", True),
        Field("ADE_squared_m2", _FLOAT, "forecasts: mean squared distance, as in the paper", "m^2", True),
        Field("recall", _FLOAT, "forecasts: share of people that have one", nullable=True),
        Field("AADE_m", _FLOAT, "forecasts: ADE averaged over recalls", "m", True),
        Field("false_forecasts_per_frame", _FLOAT, "forecasts without a person, by frames", nullable=True),
        Field("consistency_m", _FLOAT, "forecasts: distance from the previous one of the same track", "m", True),
        Field("NLL", _FLOAT, "forecasts: mean negative log-likelihood of a step, in nats", nullable=True),
        Field("coverage_50", _FLOAT, "share of true futures in the 50 % ellipses", nullable=True),
        Field("coverage_90", _FLOAT, "share of true futures in the 90 % ellipses", nullable=True),
        Field("coverage_95", _FLOAT, "share of true futures in the 95 % ellipses", nullable=True),
        Field("class", _NAME, "class that is scored; null for all together, with sums of counts", nullable=True),
        Field("class_mean_MOTA", _FLOAT, "of all together: mean of MOTA over classes", nullable=True),
        Field("class_mean_IDF1", _FLOAT, "of all together: mean of IDF1 over classes", nullable=True),
        Field("class_mean_HOTA", _FLOAT, "of all together: mean of HOTA over classes", nullable=True),
        Field("AMOTA", _FLOAT, "3D tracks: MOTA averaged over recalls, as nuScenes has it", nullable=True),
        Field("AMOTP_m", _FLOAT, "3D tracks: distance of matches averaged over recalls, as nuScenes has it", "m", True),
        Field("sAMOTA", _FLOAT, "3D tracks: scaled MOTA averaged over recalls, as AB3DMOT has it", nullable=True),
        Field("AMOTA_unscaled", _FLOAT, "3D tracks: MOTA averaged over recalls, as AB3DMOT has it", nullable=True),
    ),
)

_CHANNELS: Final = Table(
    "channels",
    "One row a channel of the log, and how it was made.",
    ("topic",),
    ("topic",),
    (
        Field("topic", _TEXT, "name of the channel"),
        Field("schema", _TEXT, "name of its schema", nullable=True),
        Field("messages", _INT, "how many messages it holds"),
        Field("transform", _TEXT, "what made it; null if it was recorded", nullable=True),
        Field("input", _TEXT, "topic it was made from", nullable=True),
        Field("version", _TEXT, "version of mcaptrack that made it", nullable=True),
        Field("parameters", _TEXT, "parameters it was made with, as JSON", nullable=True),
        Field(
            "compared_with",
            _TEXT,
            "topics that its input was compared with, and the digest of each, as JSON",
            nullable=True,
        ),
        Field("digest", _TEXT, "SHA-256 of its messages", nullable=True),
        Field("input_digest", _TEXT, "SHA-256 of the messages it was made from", nullable=True),
        Field("encoding", _TEXT, "encoding of its messages", nullable=True),
        Field("weights_sha256", _TEXT, "SHA-256 of the weights it was made with", nullable=True),
        Field("frame_id", _TEXT, "frame of reference of its metres, where the log has frames", nullable=True),
        Field("camera", _TEXT, "name of the camera that it belongs to; null if it belongs to none", nullable=True),
        Field(
            "plugins",
            _TEXT,
            "classes of other packages that made it, each with its package and version, as JSON; null without",
            nullable=True,
        ),
    ),
)

_WARNINGS: Final = Table(
    "warnings",
    "One row a warning about results in the log: what was assumed, left out or looks odd. Of several channels with the "
    "same warning it names the first.",
    ("camera", "code", "message"),
    ("topic", "code", "message"),
    (
        Field("topic", _TEXT, "channel that it is about"),
        Field("camera", _TEXT, "name of the camera of that channel; null if it belongs to none", nullable=True),
        Field("code", _NAME, "what happened, for programs"),
        Field("message", _TEXT, "what happened, for people"),
    ),
)

_RECORDINGS: Final = Table(
    "recordings",
    "One row a log: when and how long it is, where it is, and how it turned out. Scores are those of metrics, within 1 "
    "m (2 m for 3D boxes) or else by overlap; null without ground truth.",
    ("recording",),
    (),
    (
        Field("file", _TEXT, "name of the log file"),
        Field("start_t", _TIME, "log time of the first message", "ns", True),
        Field("end_t", _TIME, "log time of the last message", "ns", True),
        Field("start_t_ns", _INT, "log time of the first message, exact", "ns", True),
        Field("end_t_ns", _INT, "log time of the last message, exact", "ns", True),
        Field("duration_s", _FLOAT, "from the first message to the last", "s"),
        Field("messages", _INT, "messages of all channels"),
        Field("size_bytes", _INT, "size of the log file, and of its results beside it", "byte"),
        Field(
            "digest",
            _TEXT,
            "SHA-256 of the contents of the log: channels, chunks with times, counts and checksums, attachments; it "
            "changes when anything in the log changes",
        ),
        Field(
            "results_file", _TEXT, "name of the log beside it that holds its results, if there is one", nullable=True
        ),
        Field(
            "ground_plane",
            _TEXT,
            "given: measured; estimated: from boxes of people; assumed: a scale from the size of people; mixed: some "
            "of each; null: none",
            nullable=True,
        ),
        Field(
            "source", _TEXT, "what the log was made from: for each ingested channel its file, as JSON", nullable=True
        ),
        Field("mcaptrack_version", _TEXT, "version of mcaptrack that exported it"),
        Field("location", _TEXT, "where the log was then: its path without links, or its URL", nullable=True),
        Field("cameras", _INT, "number of cameras", nullable=True),
        Field(
            "tracks",
            _INT,
            "number of tracks of all cameras, re-tracked where they are; null where nothing was tracked",
            nullable=True,
        ),
        Field("scored", _NAME, "the tracks that the scores are of: those of the camera with the lowest IDF1", "", True),
        Field("similarity", _NAME, "what they were scored by, as in metrics", nullable=True),
        *(replace(field, nullable=True) for field in _METRICS.fields if field.name in ("gate", *SCORES)),
        Field("warnings", _INT, "number of warnings about its results", nullable=True),
        Field("warning_texts", _TEXT, "these warnings as JSON, with code and message; null without", nullable=True),
        Field("versions", _TEXT, "versions of mcaptrack that made its channels, with commas", nullable=True),
    ),
)

#: Tables in which the rows of a track stand together; the others are ordered by time.
_BY_TRACK: Final = ("tracks", "predictions", "forecast_errors")


def _plural(schema: Schema) -> str:
    """GroundPlane -> ground_planes, Tracks -> tracks."""
    name = "".join(f"_{c.lower()}" if c.isupper() else c for c in schema.name.rpartition(".")[2]).lstrip("_")
    return name if name.endswith("s") else name + "s"


def of_rows(schema: Schema) -> Table:
    """The table of rows of a schema."""
    name = _plural(schema)
    is_by_track = schema.name in SCHEMAS and name in _BY_TRACK
    order = ("topic", "track_id", "t_ns") if is_by_track else ("topic", "t_ns")
    return Table(name, schema.definition.doc, ("topic", "row"), order, (*TIMES, _ROW), schema)


def _all_tables() -> Iterator[Table]:
    yield from (_FRAMES, *(of_rows(schema) for schema in SCHEMAS.values()), _SUMMARY, _METRICS, _CHANNELS, _WARNINGS)
    yield _RECORDINGS  # last: its digest says that the others are complete


#: All tables of a log by name, in the order in which they are written.
TABLES: Final = {table.name: table for table in _all_tables()}


@cache
def table_version() -> str:
    """The version of tables, which changes with any column: tables of another version are written again."""
    columns = [(f.name, str(f.type), f.nullable, f.metadata) for table in TABLES.values() for f in table.arrow]
    return f"{_MEANING}.{sha256(repr(columns).encode()).hexdigest()[:8]}"
