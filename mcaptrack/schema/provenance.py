"""The provenance of a channel, stored in its metadata: what made it, from which input, and how.

It contains no wall clock time and no path, so that the same input and command give the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, Self, TypeVar

from mcaptrack import __version__
from mcaptrack.notices import known_code, warn

__all__ = ["FUSE", "REFINE", "VIEW", "Provenance", "frame_id_of", "input_of"]

#: Halves of characters (surrogates).
_HALVES: Final = re.compile("[\ud800-\udfff]")
T = TypeVar("T", dict[str, Any], list[Any])
_PREFIX: Final = "mcaptrack."
#: ``transform`` of channels that were ingested, of views, of scenes, and of corrected ground planes.
INGEST, VIEW, FUSE, REFINE = "ingest", "view", "fuse", "calibrate"
#: Ends of the topics of views: on pictures, and on the ground.
VIEW_SUFFIX: Final = "/view/image"
SCENE_SUFFIX: Final = "/view/scene"
#: The parameter of channels that a user wrote, and may replace: the program that did.
WRITTEN_BY: Final = "written_by"
#: The metadata record with the start time of a log's cameras, ``start_ns``.
CLOCK: Final = "mcaptrack.clock"
#: Beginnings of older versions: their results are read, but not made again with the same parameters.
_OLDER: Final = ("0.1.", "0.2.")


class Plugin(NamedTuple):
    """A class of another package: the name that selects it (an entry point, or ``module:Class``), its definition
    (``module:Class``), and the installed distribution with its version, "" if it is not known.
    """

    name: str
    implementation: str
    distribution: str = ""
    version: str = ""


@dataclass(frozen=True)
class Provenance:
    """The making of a channel. ``digest`` is of its own messages, ``input_digest`` of the messages of its input.

    ``references`` are the topics that the input was compared with, and their digests; empty for missing topics.
    ``plugins`` are the classes of other packages that were used: the ``transform`` itself if it is not built in, and
    its ``predictor``. ``classes`` are the names of the classes in its rows by ``class_id``; ``class_id`` is the class
    of all rows, where these state none (see ``schema.classes``). ``frame_id`` is the frame of its metres, where the log
    has frames. ``zones`` are the names of the zones in its rows by ``zone_id``. ``model`` is what its network turned
    out to be. ``warnings`` are the warnings when it was made, with code and message. ``continued`` says from which
    channel of the log before its ids go on (``after``, a digest), and the largest id so far (``last_id``).
    ``output`` is the end of the topic of an output that only the class of another package has, below its main output.
    ``columns`` are those of a schema of a user's own (see ``schema.own``). ``scores`` say what scores of its input were
    taken for where these are no likelihoods: by the name of a class, SCORE:LIKELIHOOD of points with straight lines
    between them. ``boxes`` say how boxes of other software in its input were read: their clock, classes, scale and
    fields, and what a user chose. In a log that was cut out of a longer one, digests name parts (see
    ``pipeline.cutting``).

    ``parameters`` are those of the transform, and ``weights_sha256`` is the digest of the weights of its network, ""
    without one. ``version`` is that of mcaptrack.
    """

    transform: str
    parameters: Mapping[str, Any]
    input: str = ""
    input_digest: str = ""
    digest: str = ""
    weights_sha256: str = ""
    references: Mapping[str, str] = field(default_factory=dict)
    plugins: Mapping[str, Plugin] = field(default_factory=dict)
    classes: Mapping[str, str] = field(default_factory=dict)
    class_id: str = ""
    frame_id: str = ""
    model: Mapping[str, str] = field(default_factory=dict)
    warnings: Sequence[Sequence[str]] = ()
    version: str = __version__
    zones: Mapping[str, str] = field(default_factory=dict)
    continued: Mapping[str, str] = field(default_factory=dict)
    output: str = ""
    columns: str = ""
    boxes: Mapping[str, str] = field(default_factory=dict)
    scores: Mapping[str, str] = field(default_factory=dict)

    @property
    def written_by(self) -> str:
        """The program of a user that wrote the channel with ``Recording.write``; "" for others."""
        return str(self.parameters.get(WRITTEN_BY, "")) if self.transform == INGEST else ""

    @property
    def held_back(self) -> str:
        """The treatment of tracks that weren't re-tracked, since the camera looks along the ground; "" for others."""
        if not self.parameters.get("poor_scale") or self.parameters.get("side_view"):
            return ""
        by_likelihood = self.parameters.get("retracker", "likelihood") == "likelihood"
        is_linked = by_likelihood and self.parameters.get("link_s") != 0
        return "only linked over gaps, by their boxes in the picture" if is_linked else "not re-tracked but passed on"

    @property
    def is_of_older_version(self) -> bool:
        """Whether it was made by a version with other parameters than this one."""
        return self.version.startswith(_OLDER)

    def warn_again(self) -> None:
        """Repeat the warnings when it was made."""
        for code, message in self.warnings:
            warn(message, known_code(code))

    def made_from(self) -> dict[str, str]:
        """The topics that it was made from and compared with, and their digests."""
        return {self.input: self.input_digest, **self.references}

    def to_metadata(self) -> dict[str, str]:
        """The provenance as metadata of an MCAP channel."""
        values = {
            "transform": self.transform,
            "version": self.version,
            "parameters": json.dumps(self.parameters, sort_keys=True, separators=(",", ":")),
            "input": self.input,
            "input_digest": self.input_digest,
            "digest": self.digest,
            "output": self.output,
            "weights_sha256": self.weights_sha256,
            "references": _text(self.references, sort_keys=True, separators=(",", ":")),
            "plugins": _text({key: plugin._asdict() for key, plugin in self.plugins.items()}, sort_keys=True),
            "classes": _text(self.classes, ensure_ascii=False),
            "class_id": self.class_id,
            "frame_id": self.frame_id,
            "zones": _text(self.zones, ensure_ascii=False),
            "columns": self.columns,
            "model": _text(self.model, sort_keys=True),
            "warnings": json.dumps(self.warnings, separators=(",", ":")) if self.warnings else "",
            "continued": _text(self.continued, sort_keys=True),
            "scores": _text(self.scores, ensure_ascii=False),
            "boxes": _text(self.boxes, sort_keys=True),
        }
        return {_PREFIX + key: value for key, value in values.items() if value}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self | None:
        """Parse the metadata of a channel; None if mcaptrack did not make the channel."""
        values = {key.removeprefix(_PREFIX): value for key, value in metadata.items() if key.startswith(_PREFIX)}
        if "transform" not in values:
            return None
        parameters, references = (_read(values.pop(key, ""), dict) for key in ("parameters", "references"))
        names = ("classes", "zones", "model", "continued", "scores", "boxes")
        texts = {key: read_texts(values.pop(key, "")) for key in names}
        plugins = _plugins(values)
        warnings = [warning for warning in _read(values.pop("warnings", ""), list) if _is_warning(warning)]
        fields: dict[str, Any] = {key: value for key, value in values.items() if key in cls.__dataclass_fields__}
        fields |= {"references": references, "warnings": warnings, "plugins": plugins, **texts}
        return cls(parameters=parameters, **fields)


def _text(values: Mapping[str, Any], **form: Any) -> str:
    """Values as a JSON object; "" if there are none."""
    return json.dumps(dict(values), **form) if values else ""


def input_of(metadata: Mapping[str, str]) -> str:
    """Return the topic that a channel was made from, by its metadata; "" if mcaptrack did not make it of one."""
    return metadata.get(f"{_PREFIX}input", "") if f"{_PREFIX}transform" in metadata else ""


def frame_id_of(metadata: Mapping[str, str]) -> str:
    """Return the frame that the metres of a channel are in, by its metadata; "" where it names none."""
    return metadata.get(f"{_PREFIX}frame_id", "")


def boxes_of(metadata: Mapping[str, str]) -> dict[str, str]:
    """Return how boxes of other software that a channel was made from were read, by its metadata; empty for others."""
    return read_texts(metadata.get(f"{_PREFIX}boxes", ""))


def _read(text: str, kind: type[T]) -> T:
    """Parse a JSON object or array; an empty one for anything else."""
    if not text:
        return kind()
    try:
        value = json.loads(text)
        if "\\ud" in text.lower():  # half a character, which no table can hold, stays as it is written
            whole = json.dumps(value, ensure_ascii=False)
            value = json.loads(_HALVES.sub(lambda half: f"\\\\u{ord(half[0]):x}", whole))
    except (ValueError, RecursionError):
        return kind()
    return value if isinstance(value, kind) else kind()


def read_texts(text: str) -> dict[str, str]:
    """Parse a JSON object of texts; others are left out."""
    return {key: value for key, value in _read(text, dict).items() if isinstance(value, str)}


def _is_warning(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(isinstance(part, str) for part in value)


def _plugins(values: dict[str, str]) -> dict[str, Plugin]:
    """Take the classes of other packages out of the metadata ``values``."""
    plugins = _read(values.pop("plugins", ""), dict)
    return {
        key: Plugin(**{name: str(facts.get(name, "")) for name in Plugin._fields})
        for key, facts in plugins.items()
        if isinstance(facts, dict)
    }


def digest(messages: Iterable[tuple[int, int, bytes]], beside: str = "") -> str:
    """SHA-256 of messages: of time, frame number and payload of each; and of what is said ``beside`` them."""
    total = hashlib.sha256(beside.encode("utf-8", "backslashreplace"))
    for t_ns, index, payload in messages:
        total.update(t_ns.to_bytes(8, "little") + index.to_bytes(8, "little") + len(payload).to_bytes(8, "little"))
        total.update(payload)
    return total.hexdigest()
