"""The metadata.yaml of a rosbag2 folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path, PurePath, PurePosixPath
from typing import Any, Final, NamedTuple

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.bags.files import METADATA
from mcaptrack.files import follow_links, publish_bytes, read_beginning
from mcaptrack.notices import warn
from mcaptrack.schema.encodings import CDR
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.ingest import plain_yaml
from mcaptrack.sources.ingest.plain_yaml import UnsupportedYamlError, field

ROOT: Final = "rosbag2_bagfile_information"
_TOPIC: Final = "topic_metadata"


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
    return path.is_file() and ROOT.encode() in read_beginning(path, plain_yaml.MAX_BYTES + 1)


def names_file(path: Path, name: str) -> bool:
    """Whether a metadata.yaml names this file; true also if the metadata can't be parsed."""
    if not holds_metadata(path):
        return False
    try:
        return name in [PurePath(file).name for file in read_metadata(path)[1]]
    except McaptrackError:
        return True


def read_metadata(path: Path) -> tuple[Bag, list[str]]:
    """Read a metadata.yaml; returns it and the files that it names. Raises McaptrackError if it is invalid."""
    import yaml

    text = read_beginning(path, plain_yaml.MAX_BYTES + 1)
    try:
        fields = field(plain_yaml.load(text), ROOT, dict)
        mode, compression, distro = (
            field(fields, name, str, "") for name in ("compression_mode", "compression_format", "ros_distro")
        )
        entries = field(fields, "topics_with_message_count", list, [])
        counts = [field(entry, "message_count", int) for entry in entries]
        # Numbers as numbers, for profiles of quality of service.
        typed = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))[ROOT]  # noqa: S506  # a safe loader
        both = zip(entries, typed.get("topics_with_message_count") or (), counts, strict=False)
        topics = [(*_topic(field(entry, _TOPIC, dict), values[_TOPIC]), count) for entry, values, count in both]
        names = [_name(entry) for entry in field(fields, "relative_file_paths", list, [])]
        bag = Bag(text, distro, mode.lower() == "message", topics)
    except ValueError as error:
        raise McaptrackError(f"{path} is not the metadata of a rosbag2 bag ({str(error)[:200]})") from None
    twice = next((name for name, times in Counter(names).items() if times > 1), "")
    if twice:
        raise McaptrackError(f"{path} names {twice} twice; its messages would be there twice")
    if mode.lower() not in ("", "none") and compression.lower() != "zstd":
        raise McaptrackError(f"{path}: the bag is compressed with {compression!r}; zstd is read")
    return bag, names


def _topic(topic: Mapping[str, Any], typed: Mapping[str, Any]) -> tuple[str, str, str, str, str]:
    import yaml

    name, kind = field(topic, "name", str), field(topic, "type", str)
    encoding, digest = field(topic, "serialization_format", str, CDR), field(topic, "type_description_hash", str, "")
    qos = typed.get("offered_qos_profiles") or ""
    # Text before ROS 2 Jazzy; since then nested YAML.
    profiles = qos if isinstance(qos, str) else yaml.safe_dump(qos, sort_keys=False, width=10_000)
    return name, kind, encoding, profiles, digest


def _name(entry: Any) -> str:
    """The name of a file in the bag's folder, without the folder, which was included before ROS 2 Galactic."""
    if not isinstance(entry, str) or not PurePosixPath(entry).name:
        raise UnsupportedYamlError(f"relative_file_paths names {entry!r}, which is no file"[:120])
    path = PurePosixPath(entry)
    if path.is_absolute() or ".." in path.parts or "\0" in entry:
        raise UnsupportedYamlError(f"relative_file_paths names {entry!r}, which lies outside of the bag's folder"[:200])
    return path.name


# Keep metadata.yaml true where channels are written into a file of a recording of ROS 2, or removed from it.
#
# The file of messages is written first, so an interruption in between leaves a metadata.yaml that counts too few or
# too many; the next command that writes to the log brings it up to date. The counts of recorded topics stay as they
# are.


#: Files of one recording may be written at once, each by a process that counts all of them: the last one counts again.
_MOST_TRIES: Final = 5
#: The versions of metadata.yaml since which topics have profiles of quality of service, as text and as a list, and the
#: hash of their type.
_QOS_TEXT: Final = 4
_QOS_LIST: Final = 9
_HASH: Final = 7


class _Content(NamedTuple):
    """The topics of a file; for those with ROS messages also counts and types, and which of them hold results.

    The times are those of all messages.
    """

    topics: set[str]
    messages: Counter[str]
    kinds: dict[str, str]
    results: set[str]
    start_ns: int
    end_ns: int


def update_metadata(path: Path) -> None:
    """Bring metadata.yaml beside a log up to date, if it names the log; otherwise do nothing.

    A warning says if it can't be.
    """
    for file in dict.fromkeys((path, follow_links(path))):
        metadata = file.with_name(METADATA)
        if names_file(metadata, file.name):
            try:
                for _ in range(_MOST_TRIES):
                    if not _update(metadata):
                        break
            except McaptrackError as error:
                warn(f"{metadata} does not count the results in {file.name}: {error}", "left-out")


def _update(metadata: Path) -> bool:
    """Bring a metadata.yaml up to date; returns whether it was not."""
    from ruamel.yaml import YAML

    bag, names = read_metadata(metadata)
    files = {name: _read(metadata.with_name(name)) for name in names}
    yaml = YAML()  # which keeps what it doesn't change as it is written: quotes, comments, order
    yaml.preserve_quotes, yaml.width = True, 10_000
    whole = yaml.load(bag.text)
    before, info = _written(yaml, whole), whole[ROOT]
    old = [(name, count) for name, *_, count in bag.topics]
    totals = sum((file.messages for file in files.values()), Counter[str]())
    kinds = {topic: kind for file in files.values() for topic, kind in file.kinds.items()}
    results = {topic for file in files.values() for topic in file.results}
    entries = [
        entry | ({"message_count": totals[name]} if name in results else {})
        for entry, (name, count) in zip(info["topics_with_message_count"] or [], old, strict=True)
        if not count or any(name in file.topics for file in files.values())
    ]
    version = info.get("version")
    version = version if isinstance(version, int) else 0
    entries += [_entry(topic, kinds[topic], totals[topic], version) for topic in sorted(totals.keys() - dict(old))]
    info["topics_with_message_count"] = entries
    new = [(str(entry[_TOPIC]["name"]), int(entry["message_count"])) for entry in entries]
    if isinstance(info.get("message_count"), int):
        info["message_count"] += sum(n for _, n in new) - sum(n for _, n in old)
    _set_times(info, [file for file in files.values() if file.messages])
    for entry in info.get("files") or []:
        file = files.get(str(entry.get("path", ""))) if isinstance(entry, dict) else None
        if file and file.messages:
            entry["message_count"] = sum(file.messages.get(topic, 0) for topic in dict(new))
            _set_times(entry, [file])
    after = _written(yaml, whole)
    if after == before:
        return False
    publish_bytes(follow_links(metadata), after.encode())
    return True


def _written(yaml: Any, value: Any) -> str:
    stream = StringIO()
    yaml.dump(value, stream)
    return stream.getvalue()


def _read(path: Path) -> _Content:
    with log.read(path, sidecar=False) as opened:
        # ROS tools refuse a recording that names other encodings.
        recorded = [channel for channel in opened.recorded if channel.message_encoding == CDR and channel.messages]
        messages = Counter[str]()
        for channel in recorded:
            messages[channel.topic] += channel.messages
        kinds = {channel.topic: opened.record_name(channel) for channel in recorded}
        results = {channel.topic for channel in recorded if Provenance.from_metadata(channel.metadata)}
        topics = {channel.topic for channel in opened.recorded}
        return _Content(topics, messages, kinds, results, opened.start_ns, opened.end_ns)


def _entry(topic: str, kind: str, count: int, version: int) -> dict[str, Any]:
    """The entry of a new topic, as this version of metadata.yaml has it."""
    values: dict[str, Any] = {"name": topic, "type": kind, "serialization_format": CDR}
    if version >= _QOS_TEXT:
        values["offered_qos_profiles"] = [] if version >= _QOS_LIST else ""
    if version >= _HASH:
        values["type_description_hash"] = ""
    return {_TOPIC: values, "message_count": count}


def _set_times(entry: dict[str, Any], files: list[_Content]) -> None:
    """Set the begin and the duration of a bag or of a file, where it states them."""
    if not files:
        return
    start_ns, end_ns = min(file.start_ns for file in files), max(file.end_ns for file in files)
    for name, part, value in (
        ("starting_time", "nanoseconds_since_epoch", start_ns),
        ("duration", "nanoseconds", end_ns - start_ns),
    ):
        if isinstance(entry.get(name), dict) and part in entry[name]:
            entry[name][part] = value
