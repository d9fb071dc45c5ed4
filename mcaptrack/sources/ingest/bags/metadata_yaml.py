"""The metadata.yaml of a rosbag2 folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath
from typing import Any, Final

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.ingest.bags import plain_yaml
from mcaptrack.sources.ingest.bags.plain_yaml import Fields, UnsupportedYamlError

METADATA: Final = "metadata.yaml"
ROOT: Final = "rosbag2_bagfile_information"


@dataclass
class Bag:
    """The content of a metadata.yaml."""

    text: bytes = b""
    distro: str = ""
    #: Whether messages are compressed one by one.
    packed: bool = False
    #: Topic, type, serialization, quality of service, type hash, and number of messages.
    topics: Sequence[tuple[str, str, str, str, str, int]] = ()


def holds_metadata(path: Path) -> bool:
    """Whether a file exists and looks like the metadata of a bag."""
    return path.is_file() and ROOT.encode() in _start(path)


def names_file(path: Path, name: str) -> bool:
    """Whether a metadata.yaml names this file; true also if the metadata can't be parsed."""
    if not holds_metadata(path):
        return False
    try:
        return name in [PurePath(one).name for one in read_metadata(path)[1]]
    except McaptrackError:
        return True


def is_packed(path: Path, name: str) -> bool:
    """Whether a metadata.yaml says that the messages of this file are compressed one by one."""
    if not holds_metadata(path):
        return False
    try:
        bag, names = read_metadata(path)
    except McaptrackError:
        return False
    return bag.packed and name in names


def _start(path: Path) -> bytes:
    """The first bytes up to the limit, and one more if there are more."""
    try:
        with path.open("rb") as stream:
            return stream.read(plain_yaml.MAX_BYTES + 1)
    except OSError as error:
        raise McaptrackError(f"{path} can't be read: {error.strerror}") from None


def read_metadata(path: Path) -> tuple[Bag, list[str]]:
    """Read a metadata.yaml; returns it and the files that it names. Raises McaptrackError if it is invalid."""
    text = _start(path)
    try:
        fields = Fields(plain_yaml.load(text), "it").map(ROOT)
        mode, compression = fields.text("compression_mode", ""), fields.text("compression_format", "")
        topics = [_topic(Fields(entry, "a topic")) for entry in fields.values("topics_with_message_count")]
        names = [_name(entry) for entry in fields.values("relative_file_paths")]
        bag = Bag(text, fields.text("ros_distro", ""), mode.lower() == "message", topics)
    except UnsupportedYamlError as error:
        raise McaptrackError(f"{path} is not the metadata of a rosbag2 bag ({str(error)[:200]})") from None
    twice = next((name for name, times in Counter(names).items() if times > 1), "")
    if twice:
        raise McaptrackError(f"{path} names {twice} twice; its messages would be there twice")
    if mode.lower() not in ("", "none") and compression.lower() != "zstd":
        raise McaptrackError(f"{path}: the bag is compressed with {compression!r}; zstd is read")
    return bag, names


def _topic(entry: Fields) -> tuple[str, str, str, str, str, int]:
    topic = entry.map("topic_metadata")
    name, kind, encoding = topic.text("name"), topic.text("type"), topic.text("serialization_format", "cdr")
    qos = topic.any("offered_qos_profiles")
    # Text before ROS 2 Jazzy; since then nested YAML.
    words = "" if qos is None else str(qos) if isinstance(qos, str) else plain_yaml.dump(qos)
    return name, kind, encoding, words, topic.text("type_description_hash", ""), entry.whole("message_count")


def _name(entry: Any) -> str:
    """The name of a file in the bag's folder, without the folder, which was included before ROS 2 Galactic."""
    if not isinstance(entry, str) or not PurePosixPath(entry).name:
        raise UnsupportedYamlError(f"relative_file_paths names {entry!r}, which is no file"[:120])
    path = PurePosixPath(entry)
    if path.is_absolute() or ".." in path.parts or "\0" in entry:
        raise UnsupportedYamlError(f"relative_file_paths names {entry!r}, which lies outside of the bag's folder"[:200])
    return path.name
