"""Keep metadata.yaml true where channels are written into a file of a recording of ROS 2, or removed from it.

The file of messages is written first, so an interruption in between leaves a metadata.yaml that counts too few or too
many; the next command that writes to the log brings it up to date. The counts of recorded topics stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.files import follow_links, publish_bytes
from mcaptrack.notices import warn
from mcaptrack.schema.encodings import CDR
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.ingest.bags import plain_yaml
from mcaptrack.sources.ingest.bags.metadata_yaml import METADATA, ROOT, names_file, read_metadata
from mcaptrack.sources.ingest.bags.plain_yaml import Scalar

#: Files of one recording may be written at once, each by a process that counts all of them: the last one counts again.
_MOST_TRIES: Final = 5
Counts = dict[str, int]
#: The versions of metadata.yaml since which topics have profiles of quality of service, as text and as a list, and the
#: hash of their type.
_QOS_TEXT: Final = 4
_QOS_LIST: Final = 9
_HASH: Final = 7


class _Content(NamedTuple):
    """All topics of a file, and of those with ROS messages their messages and types, and which hold results.

    The times are those of all messages.
    """

    topics: set[str]
    messages: Counts
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
    bag, names = read_metadata(metadata)
    files = {name: _read(metadata.with_name(name)) for name in names}
    whole = plain_yaml.load(bag.text)
    before, info = plain_yaml.dump(whole), whole[ROOT]
    old = [(name, count) for name, *_, count in bag.topics]
    there = _totals(files.values())
    kinds = {topic: kind for file in files.values() for topic, kind in file.kinds.items()}
    results = {topic for file in files.values() for topic in file.results}
    entries = [
        entry | ({"message_count": _number(there[name])} if name in results else {})
        for entry, (name, count) in zip(info["topics_with_message_count"] or [], old, strict=True)
        if not count or any(name in file.topics for file in files.values())
    ]
    version = info.get("version", "")
    version = int(version) if str(version).isdecimal() else 0
    entries += [_entry(topic, kinds[topic], there[topic], version) for topic in sorted(there.keys() - dict(old))]
    info["topics_with_message_count"] = entries
    new = [(str(entry["topic_metadata"]["name"]), int(entry["message_count"])) for entry in entries]
    if "message_count" in info and str(info["message_count"]).isdecimal():
        info["message_count"] = _number(int(info["message_count"]) + _sum(new) - _sum(old))
    _set_times(info, [file for file in files.values() if file.messages])
    for entry in info.get("files") or []:
        file = files.get(str(entry.get("path", ""))) if isinstance(entry, dict) else None
        if file and file.messages:
            entry["message_count"] = _number(sum(file.messages.get(topic, 0) for topic in dict(new)))
            _set_times(entry, [file])
    after = plain_yaml.dump(whole)
    if after == before:
        return False
    publish_bytes(follow_links(metadata), after.encode())
    return True


def _read(path: Path) -> _Content:
    with log.read(path, sidecar=False) as opened:
        # ROS tools refuse a recording that names other encodings.
        known = [one for one in opened.recorded if one.message_encoding == CDR and one.messages]
        messages: Counts = {}
        for channel in known:
            messages[channel.topic] = messages.get(channel.topic, 0) + channel.messages
        kinds = {channel.topic: opened.record_name(channel) for channel in known}
        results = {channel.topic for channel in known if Provenance.from_metadata(channel.metadata)}
        topics = {channel.topic for channel in opened.recorded}
        return _Content(topics, messages, kinds, results, opened.start_ns, opened.end_ns)


def _sum(topics: Iterable[tuple[str, int]]) -> int:
    return sum(count for _, count in topics)


def _totals(files: Iterable[_Content]) -> Counts:
    out: Counts = {}
    for file in files:
        for topic, count in file.messages.items():
            out[topic] = out.get(topic, 0) + count
    return out


def _entry(topic: str, kind: str, count: int, version: int) -> dict[str, Any]:
    """The entry of a new topic, as this version of metadata.yaml has it."""
    values: dict[str, Any] = {"name": _text(topic), "type": _text(kind), "serialization_format": _text(CDR)}
    if version >= _QOS_TEXT:
        values["offered_qos_profiles"] = [] if version >= _QOS_LIST else _text("")
    if version >= _HASH:
        values["type_description_hash"] = _text("")
    return {"topic_metadata": values, "message_count": _number(count)}


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
            entry[name][part] = _number(value)


def _number(value: int) -> Scalar:
    return Scalar.of(str(value), is_plain=True)


def _text(value: str) -> Scalar:
    return Scalar.of(value, is_plain=False)
