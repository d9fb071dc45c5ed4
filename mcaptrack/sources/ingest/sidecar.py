"""Decide where the results of a log are written: into the log itself, or into a sidecar, LOG.results.mcap.

ROS tools expect that all channels of a recording hold ROS messages, and that metadata.yaml counts all of them. A
recording that ROS tools read is therefore not changed, unless ``sidecar`` is False.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Final

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.ingest.bags.metadata_yaml import METADATA, holds_metadata, read_metadata

#: The profiles of the MCAP registry that ROS tools read, and their names in messages.
_PROFILES: Final = {"ros1": "ROS 1", "ros2": "ROS 2"}


@dataclass
class SidecarChoice:
    """Decides whether results go to a sidecar: ``log.read(path, sidecar=SidecarChoice(wanted))`` applies it.

    ``wanted`` is True for a sidecar, False for the log itself, None to decide by the log. ``why`` is the reason, "" if
    it needs no mention.
    """

    wanted: bool | None = None
    why: str = field(default="", init=False)

    def __call__(self, opened: log.Log) -> bool:
        """Whether to use a sidecar. Raises McaptrackError if there is one, but results must go into the log itself."""
        results = log.results_path(opened.path)
        self.why = ""
        if self.wanted is False and results.exists():
            raise McaptrackError(
                f"{results} holds results of {opened.path}; `sidecar=False` would leave them there and make others: "
                f"remove {results.name} first, or leave `sidecar=False` out"
            )
        if self.wanted:
            self.why = "`sidecar=True` was given"
            return True
        recording = recording_of(opened)
        if self.wanted is False:
            self.why = (
                f"`sidecar=False` was given; ROS tools may stumble over them, for it is {recording}"
                if recording
                else ""
            )
            return False
        if results.exists():
            self.why = "earlier results are there"
            return True
        if not recording:
            return False
        if any(Provenance.from_metadata(channel.metadata) for channel in opened.recorded):
            self.why = f"earlier results are in it; ROS tools may stumble over them, for it is {recording}"
            return False
        self.why = (
            f"{opened.path.name} is {recording}, which ROS tools read; `sidecar=False` writes into it all the same"
        )
        return True

    def words(self, written_to: Path) -> str:
        """A line that says where results were written, and why."""
        return f"results are in {written_to}: {self.why}"


def recording_of(opened: log.Log) -> str:
    """The name of a log for ROS tools: "a ROS 2 recording"; "" if they don't read it."""
    for path in (opened.path, opened.real_path):
        metadata = path.with_name(METADATA)
        if _is_named(metadata, path.name):
            return f"named in {metadata}"
    profile, library = log.header(opened)
    if profile in _PROFILES and not library.startswith(log.LIBRARY):
        return f"a {_PROFILES[profile]} recording"
    return ""


def _is_named(metadata: Path, name: str) -> bool:
    """Whether a metadata.yaml names this file; true also if the metadata can't be parsed."""
    if not holds_metadata(metadata):
        return False
    try:
        return name in [PurePath(one).name for one in read_metadata(metadata)[1]]
    except McaptrackError:
        return True
