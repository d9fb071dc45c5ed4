"""How a channel was made: kept in its metadata, so that a log explains itself.

No wall clock and no path goes in: the same input and command give the same bytes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, Self, TypeVar

from mcaptrack import __version__

T = TypeVar("T", dict[str, Any], list[Any])
_PREFIX: Final = "mcaptrack."
#: The transforms of channels that no stage made: what came in, and what shows others.
INGEST, VIEW = "ingest", "view"
#: The metadata record that says when the clock of a log's cameras begins, as ``start_ns``.
CLOCK: Final = "mcaptrack.clock"


class Plugin(NamedTuple):
    """A class of another package: the name it was chosen by (of an entry point, or ``module:Class``), where it is
    defined (``module:Class``), and the installed package that it came from, "" where that wasn't known.
    """

    name: str
    implementation: str
    distribution: str = ""
    version: str = ""


@dataclass(frozen=True)
class Provenance:
    """What made a channel, from what, and how. ``digest`` is of its own messages, ``input_digest`` of its input's.

    ``references`` are the topics that the input was compared with, and the digest of each: empty where there was
    nothing of that name. ``plugins`` are the classes of other packages that it consists of: the ``transform`` itself if
    it is not built in, and the ``predictor`` in it. ``warnings`` are what was odd about it when it was made: code and
    message of each.
    """

    transform: str
    parameters: Mapping[str, Any]
    input: str = ""
    input_digest: str = ""
    digest: str = ""
    weights_sha256: str = ""
    references: Mapping[str, str] = field(default_factory=dict)
    plugins: Mapping[str, Plugin] = field(default_factory=dict)
    warnings: Sequence[Sequence[str]] = ()
    version: str = __version__

    def made_from(self) -> dict[str, str]:
        """All that it was made from and compared with, with their digests."""
        return {self.input: self.input_digest, **self.references}

    def to_metadata(self) -> dict[str, str]:
        """As the metadata of an MCAP channel."""
        values = {
            "transform": self.transform,
            "version": self.version,
            "parameters": json.dumps(self.parameters, sort_keys=True, separators=(",", ":")),
            "input": self.input,
            "input_digest": self.input_digest,
            "digest": self.digest,
            "weights_sha256": self.weights_sha256,
            "references": json.dumps(dict(self.references), sort_keys=True, separators=(",", ":")),
            "plugins": json.dumps({key: one._asdict() for key, one in self.plugins.items()}, sort_keys=True),
            "warnings": json.dumps(self.warnings, separators=(",", ":")),
        }
        if not self.warnings:
            del values["warnings"]
        if not self.references:
            del values["references"]
        if not self.plugins:
            del values["plugins"]
        return {_PREFIX + key: value for key, value in values.items() if value}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self | None:
        """The way back; None for a channel that mcaptrack did not make."""
        values = {key.removeprefix(_PREFIX): value for key, value in metadata.items() if key.startswith(_PREFIX)}
        if "transform" not in values:
            return None
        parameters, references = (_read(values.pop(key, ""), dict) for key in ("parameters", "references"))
        plugins = _plugins(values)
        warnings = [one for one in _read(values.pop("warnings", ""), list) if _is_warning(one)]
        known = {key: value for key, value in values.items() if key in cls.__dataclass_fields__}
        return cls(parameters=parameters, references=references, warnings=warnings, plugins=plugins, **known)


def _read(text: str, kind: type[T]) -> T:
    """A JSON object or array; an empty one for anything else."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return kind()
    return value if isinstance(value, kind) else kind()


def _is_warning(value: object) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(isinstance(part, str) for part in value)


def _plugins(values: dict[str, str]) -> dict[str, Plugin]:
    """What metadata say of classes of other packages; takes it out of ``values``.

    Version 0.1 had ``implementation`` ("module:Class") and ``distribution`` ("name 1.2").
    """
    found = _read(values.pop("plugins", ""), dict)
    before, package = values.pop("implementation", ""), values.pop("distribution", "")
    if before:
        name, _, version = package.rpartition(" ")
        found.setdefault("transform", Plugin(before, before, name, version)._asdict())
    return {
        key: Plugin(**{name: str(one.get(name, "")) for name in Plugin._fields})
        for key, one in found.items()
        if isinstance(one, dict)
    }


def digest(messages: Iterable[tuple[int, int, bytes]]) -> str:
    """SHA-256 of messages: time, frame and payload of each."""
    total = hashlib.sha256()
    for t_ns, index, payload in messages:
        total.update(t_ns.to_bytes(8, "little") + index.to_bytes(8, "little") + len(payload).to_bytes(8, "little"))
        total.update(payload)
    return total.hexdigest()
