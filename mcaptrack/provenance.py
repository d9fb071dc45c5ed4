"""How a channel was made: kept in its metadata, so that a log explains itself.

No wall clock and no path goes in: the same input and command give the same bytes.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Self

from mcaptrack import __version__

_PREFIX: Final = "mcaptrack."
#: The metadata record that says when the clock of a log's cameras begins, as ``start_ns``.
CLOCK: Final = "mcaptrack.clock"


@dataclass(frozen=True)
class Provenance:
    """What made a channel, from what, and how. ``digest`` is of its own messages, ``input_digest`` of its input's.

    ``reference`` is what the input was compared with; its digest is empty where there was nothing of that name.
    """

    transform: str
    parameters: Mapping[str, Any]
    input: str = ""
    input_digest: str = ""
    digest: str = ""
    weights_sha256: str = ""
    reference: str = ""
    reference_digest: str = ""
    version: str = __version__

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
            "reference": self.reference,
            "reference_digest": self.reference_digest,
        }
        return {_PREFIX + key: value for key, value in values.items() if value}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self | None:
        """The way back; None for a channel that mcaptrack did not make."""
        values = {key.removeprefix(_PREFIX): value for key, value in metadata.items() if key.startswith(_PREFIX)}
        if "transform" not in values:
            return None
        try:
            parameters = json.loads(values.pop("parameters", "{}"))
        except ValueError:
            parameters = {}
        known = {key: value for key, value in values.items() if key in cls.__dataclass_fields__}
        return cls(parameters=parameters if isinstance(parameters, dict) else {}, **known)


def digest(messages: Iterable[tuple[int, int, bytes]]) -> str:
    """SHA-256 of messages: time, frame and payload of each."""
    total = hashlib.sha256()
    for t_ns, index, payload in messages:
        total.update(t_ns.to_bytes(8, "little") + index.to_bytes(8, "little") + len(payload).to_bytes(8, "little"))
        total.update(payload)
    return total.hexdigest()
