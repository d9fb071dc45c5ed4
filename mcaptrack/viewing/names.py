"""Names of trackers, in reports and videos."""

from __future__ import annotations

from typing import Final

from mcaptrack.schema import DETECTIONS
from mcaptrack.schema.provenance import Provenance
from mcaptrack.transforms import STAGES

#: How trackers are called; channels of earlier versions that name none were made by the first.
_TRACKERS: Final = {"sort": "SORT", "bytetrack": "ByteTrack", "ocsort": "OC-SORT"}
_FIRST_TRACKER: Final = next(iter(_TRACKERS))


def tracker_name(made: Provenance | None) -> str:
    """Return the name of the tracker of a channel, by how it was made."""
    stage = STAGES.get(made.transform) if made else None
    if made is None or stage is None or stage.default.reads is not DETECTIONS:
        return "tracks as given"
    return _TRACKERS.get(str(made.parameters.get(stage.option, _FIRST_TRACKER)), "tracker")
