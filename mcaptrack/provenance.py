"""How a channel was made: kept in its metadata, so that a log explains itself.

No wall clock and no path goes in: the same input and command give the same bytes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Self

from mcaptrack import __version__

_PREFIX: Final = "mcaptrack."
#: The metadata record that says when the clock of a log's cameras begins, as ``start_ns``.
CLOCK: Final = "mcaptrack.clock"


@dataclass(frozen=True)
class Provenance:
    """What made a channel, from what, and how. ``digest`` is of its own messages, ``input_digest`` of its input's.

    ``references`` are the topics that the input was compared with, and the digest of each: empty where there was
    nothing of that name.
    """

    transform: str
    parameters: Mapping[str, Any]
    input: str = ""
    input_digest: str = ""
    digest: str = ""
    weights_sha256: str = ""
    references: Mapping[str, str] = field(default_factory=dict)
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
        }
        if not self.references:
            del values["references"]
        return {_PREFIX + key: value for key, value in values.items() if value}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self | None:
        """The way back; None for a channel that mcaptrack did not make."""
        values = {key.removeprefix(_PREFIX): value for key, value in metadata.items() if key.startswith(_PREFIX)}
        if "transform" not in values:
            return None
        parameters, references = (_object(values.pop(key, "{}")) for key in ("parameters", "references"))
        known = {key: value for key, value in values.items() if key in cls.__dataclass_fields__}
        return cls(parameters=parameters, references=references, **known)


def _object(text: str) -> dict[str, Any]:
    """A JSON object; an empty one for anything else."""
    try:
        value = json.loads(text)
    except ValueError:
        return {}
    return value if isinstance(value, dict) else {}


def digest(messages: Iterable[tuple[int, int, bytes]]) -> str:
    """SHA-256 of messages: time, frame and payload of each."""
    total = hashlib.sha256()
    for t_ns, index, payload in messages:
        total.update(t_ns.to_bytes(8, "little") + index.to_bytes(8, "little") + len(payload).to_bytes(8, "little"))
        total.update(payload)
    return total.hexdigest()
