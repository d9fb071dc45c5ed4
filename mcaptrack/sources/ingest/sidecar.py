"""Where results of a log are written: into the log itself, or into LOG.results.mcap beside it.

ROS tools expect that all channels of a recording hold ROS messages, and that its metadata.yaml counts all of them. So a
recording that ROS tools read stays as it is, unless ``sidecar`` is False.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Final

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.ingest.bags.metadata_yaml import METADATA, holds_metadata, read_metadata

#: The profiles of MCAP's registry that ROS tools read, and what a recording with one is called.
_PROFILES: Final = {"ros1": "ROS 1", "ros2": "ROS 2"}


@dataclass
class SidecarChoice:
    """Decides where results of a log go: ``log.read(path, sidecar=SidecarChoice(wanted))`` opens the log accordingly.

    ``wanted`` is True for a file beside the log, False for the log itself, None for what suits the log. ``why`` is the
    reason in words, "" where nothing needs to be said.
    """

    wanted: bool | None = None
    why: str = field(default="", init=False)

    def __call__(self, opened: log.Log) -> bool:
        """Whether results go beside this log. Raises McaptrackError if they are beside it and must go into it."""
        beside = log.results_path(opened.path)
        self.why = ""
        if self.wanted is False and beside.exists():
            raise McaptrackError(
                f"{beside} holds results of {opened.path}; `sidecar=False` would leave them there and make others: "
                f"remove {beside.name} first, or leave `sidecar=False` out"
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
        if beside.exists():
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
        """Where results went, and why."""
        return f"results are in {written_to}: {self.why}"


def recording_of(opened: log.Log) -> str:
    """What ROS tools take a log for: "a ROS 2 recording"; "" if it is none of theirs."""
    for path in (opened.path, opened.real_path):
        metadata = path.with_name(METADATA)
        if _is_named(metadata, path.name):
            return f"named in {metadata}"
    profile, library = log.header(opened)
    if profile in _PROFILES and not library.startswith(log.LIBRARY):
        return f"a {_PROFILES[profile]} recording"
    return ""


def _is_named(metadata: Path, name: str) -> bool:
    """Whether a metadata.yaml names this file, or can't be understood, so that it may."""
    if not holds_metadata(metadata):
        return False
    try:
        return name in [PurePath(one).name for one in read_metadata(metadata)[1]]
    except McaptrackError:
        return True
