"""Decide where the results of a log are written: into the log itself, or into a sidecar, LOG.results.mcap.

ROS tools expect that all channels of a recording hold ROS messages, and that metadata.yaml counts all of them. A
recording that ROS tools read is therefore not changed, unless ``sidecar`` is False. What is then written into a
recording of ROS 2 are ROS messages, too.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Final

from mcap.well_known import Profile

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.location import Location, Url
from mcaptrack.notices import warn
from mcaptrack.schema.encodings import CDR, PROTOBUF, Encoding, is_ros_topic
from mcaptrack.schema.provenance import Provenance

#: The profiles of the MCAP registry that ROS tools read, and their names in messages.
_PROFILES: Final = {Profile.ROS1: "ROS 1", Profile.ROS2: "ROS 2"}


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
        self.why = ""
        if isinstance(opened.path, Url):
            if self.wanted is False:
                raise McaptrackError(
                    f"{opened.path} can't be changed in place: objects in a store are only replaced as a whole; leave "
                    "`sidecar=False` out, and results go beside it"
                )
            self.why = "objects in a store are only replaced as a whole, so that the log stays as it is"
            return True
        results = log.results_path(opened.path)
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
            self.why = f"`sidecar=False` was given; {_for_ros_tools(opened, recording)}" if recording else ""
            return False
        if results.exists():
            self.why = "earlier results are there"
            _warn_twice(opened, results)
            return True
        if not recording:
            return False
        if _ours(opened):
            self.why = f"earlier results are in it; {_for_ros_tools(opened, recording)}"
            return False
        self.why = (
            f"{opened.path.name} is {recording}, which ROS tools read; `sidecar=False` writes into it all the same"
        )
        return True

    def words(self, written_to: Location) -> str:
        """A line that says where results were written, and why."""
        return f"results are in {written_to}: {self.why}"


def _ours(opened: log.Log) -> list[log.Channel]:
    """The channels of a log itself that hold results."""
    return [channel for channel in opened.recorded if Provenance.from_metadata(channel.metadata)]


def _warn_twice(opened: log.Log, results: Path) -> None:
    """Warn of results that stand in a log and beside it."""
    ours = {channel.topic for channel in _ours(opened)}
    with log.read(results) as beside:
        twice = sorted(ours & beside.channels.keys())
    if twice:
        those = twice[0] if len(twice) == 1 else f"{len(twice)} channels, such as {twice[0]},"
        verb = "stands" if len(twice) == 1 else "stand"
        warn(
            f"{those} {verb} in {opened.path} and in {results.name}; the second is read and replaced "
            "until it is removed",
            "other",
        )


def _for_ros_tools(opened: log.Log, recording: str) -> str:
    """Say whether ROS tools can read the results in a recording, as text."""
    if encoding_for(opened) == CDR and all(channel.message_encoding == CDR for channel in _ours(opened)):
        return f"they are ROS messages, for it is {recording}"
    return f"ROS tools may stumble over them, for it is {recording}"


def encoding_for(opened: log.Log) -> Encoding:
    """The encoding of results in a log, or in a copy of it: CDR in a recording of ROS 2 itself, otherwise protobuf.

    Raises McaptrackError for a recording with messages that are compressed one by one: results are not.
    """
    if opened.results is not None or not recording_of(opened):
        return PROTOBUF
    if holds_packed(opened):
        raise McaptrackError(
            f"messages of {opened.path} are compressed one by one; results in {opened.path.name} would not be, "
            "and ROS tools could not read them; use `sidecar=True`, and neither `sidecar=False` nor `output=`"
        )
    profile, library = log.header(opened)
    is_ros1 = profile == Profile.ROS1 and not library.startswith(log.LIBRARY)
    return PROTOBUF if is_ros1 else CDR


def holds_packed(opened: log.Log) -> bool:
    """Whether messages of a recording are compressed one by one, as rosbag2 does with all of a bag or none."""
    from mcaptrack.sources.foreign.definitions import is_packed

    for channel in opened.recorded:
        if channel.message_encoding == CDR and channel.messages:
            with suppress(McaptrackError):  # of messages that can't be read, which those who need them say
                return any(is_packed(message.payload) for message in islice(opened.messages(channel.topic), 1))
    return False


def check_topics(topics: Iterable[str], encoding: Encoding) -> None:
    """Warn of topics with results in a recording of ROS 2 that have no name of a topic there."""
    odd = sorted(topic for topic in topics if not is_ros_topic(topic)) if encoding == CDR else ()
    if odd:
        warn(
            f"ROS 2 accepts no topic like {', '.join(odd)}: its tools read these messages, but don't play them; a part "
            "of a topic has letters, digits and _, and begins with no digit",
            "other",
        )


def recording_of(opened: log.Log) -> str:
    """The name of a log for ROS tools: "a ROS 2 recording"; "" if they don't read it."""
    for path in (opened.path, opened.real_path):
        if isinstance(path, Url):
            continue
        listing = log.listing_of(path)
        if listing is not None:
            return f"named in {listing}"
    profile, library = log.header(opened)
    if profile in _PROFILES and not library.startswith(log.LIBRARY):
        return f"a {_PROFILES[profile]} recording"
    return ""
