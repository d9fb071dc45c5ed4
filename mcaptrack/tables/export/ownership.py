"""Which log the tables in a folder are of, so that those of another log are never replaced unasked.

The table ``recordings`` says it: the place of its log, and digests of what was recorded, which stay the same whatever
stages add to the log and wherever it is moved.
"""

from __future__ import annotations

import csv
import fcntl
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcaptrack import log, tables
from mcaptrack.choices import TableFormat
from mcaptrack.errors import McaptrackError
from mcaptrack.files import place_of
from mcaptrack.location import Location, Url, is_remote, local_name, parse
from mcaptrack.schema.provenance import INGEST, Provenance
from mcaptrack.sources import foreign
from mcaptrack.tables.export.contents import file_name, location_of, recording_key, recording_name
from mcaptrack.tables.files import FORMATS

#: The table that says which log the tables are of.
_TABLE: Final = "recordings"
_PREFIX: Final = "recording="
#: Digests of so many recorded channels are kept: channels with pictures first, then by their number of messages.
_MOST_CHANNELS: Final = 16
#: The parameter of channels that a user has written and may replace.
_REPLACEABLE: Final = "written_with"


class _Owner(NamedTuple):
    """The log that tables are of: the name of its file, its place (also as seen from the folder), what was recorded."""

    file: str
    location: str
    below: str
    recorded: Mapping[str, str]


def owner_words(opened: log.Log, folder: Path) -> dict[str, str]:
    """The metadata of ``recordings`` that say which log the tables in a folder are of."""
    return {
        "location": location_of(opened.path),
        "log_from_here": _seen_from(folder, opened.path),
        "recorded": json.dumps(_recorded(opened), sort_keys=False, separators=(",", ":")),
    }


def refuse_tables_of_another(opened: log.Log, path: Location, folder: Path) -> None:
    """Raise McaptrackError if a folder has tables of another log than ``opened``, which is or will be at ``path``."""
    name = recording_name(path)
    try:
        recordings = [entry.removeprefix(_PREFIX) for entry in os.listdir(folder / _TABLE) if entry.startswith(_PREFIX)]
    except OSError:
        return
    for taken in sorted(recordings):
        if recording_key(taken) != recording_key(name):
            continue
        for form in FORMATS:
            file = folder / _TABLE / f"{_PREFIX}{taken}" / f"part-0.{form}"
            owner = _owner(file, form) if file.is_file() else None
            if owner is None or (taken == name and _is_of(owner, opened, path, folder)):
                continue
            kept = owner.location or owner.file or "another log"
            why = (
                "" if owner.recorded else f"; {form} doesn't say what was recorded, by which a log that moved is known"
            )
            same = f"both are {name}" if taken == name else f"{taken} and {name} are one name on some file systems"
            raise McaptrackError(
                f"{folder} holds the tables of {kept}, not of {path}: {same}{why}. Give another folder with `output=`, "
                "or `force=True` to replace them"
            )


@contextmanager
def claimed(folder: Path, name: str) -> Iterator[None]:
    """Let no other process write tables of this recording in a folder: one that tries waits."""
    place = folder / _TABLE / f"{_PREFIX}{name}"
    try:
        place.mkdir(parents=True, exist_ok=True)
        handle = os.open(place, os.O_RDONLY)
    except OSError as error:
        raise McaptrackError(f"{place} can't be written: {error.strerror or error}") from error
    try:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _is_of(owner: _Owner, opened: log.Log, path: Location, folder: Path) -> bool:
    """Whether tables are of this log.

    They are of the log at their place, whatever it holds now. Elsewhere it has to hold what was recorded, and to have
    moved: if there still is a log at the place of the tables', this is a copy, which may have other results.
    """
    if owner.location == location_of(path):
        return True
    own = None if is_remote(path) else local_name(path, ".tables")
    if own is not None and place_of(folder) == place_of(own) and owner.file == file_name(path):
        return True  # the folder beside the log, copied along with it
    if not _is_same(owner.recorded, _recorded(opened)):
        return False
    if owner.below and owner.below == _seen_from(folder, path):
        return True
    before = parse(owner.location) if owner.location else None
    return isinstance(before, Path) and not before.exists()


def _is_same(before: Mapping[str, str], now: Mapping[str, str]) -> bool:
    """Whether two logs are of the same recording, by the first channel (in the order of ``before``) that both have."""
    topic = next((topic for topic in before if topic in now), None)
    return topic is not None and before[topic] == now[topic]


def _recorded(opened: log.Log) -> dict[str, str]:
    """Digests of what was recorded, by topic."""
    channels = []
    for channel in opened.channels.values():
        how = Provenance.from_metadata(channel.metadata)
        if channel.messages and (how is None or (how.transform == INGEST and _REPLACEABLE not in how.parameters)):
            channels.append((not foreign.holds_pictures(channel), -channel.messages, channel.topic, how))
    channels.sort(key=lambda row: row[:3])
    return {
        topic: ((how.digest if how else "") or opened.fingerprint(topic))[:32]
        for _, _, topic, how in channels[:_MOST_CHANNELS]
    }


def _seen_from(folder: Path, path: Location) -> str:
    """The path of a log as seen from a folder; "" for an object."""
    place = place_of(path)
    if isinstance(place, Url):
        return ""
    return os.fsencode(os.path.relpath(place, place_of(folder))).decode("utf-8", "backslashreplace")


def _owner(file: Path, form: TableFormat) -> _Owner | None:
    """The log that ``recordings`` names; None if it names none."""
    about = tables.file_metadata(file, form)
    if about:
        recorded = json.loads(about.get("recorded", "{}"))
        return _Owner(about.get("recording", ""), about.get("location", ""), about.get("log_from_here", ""), recorded)
    row = _first_row(file, form)
    return _Owner(str(row.get("file", "")), str(row.get("location", "")), "", {}) if row else None


def _first_row(file: Path, form: TableFormat) -> Mapping[str, Any]:
    try:
        with file.open(encoding="utf-8", newline="") as stream:
            rows: Sequence[Mapping[str, Any]]
            if form == "csv":
                rows = [row for row, _ in zip(csv.DictReader(stream), range(1), strict=False)]
            else:
                rows = [json.loads(line) for line, _ in zip(stream, range(1), strict=False)]
    except (OSError, ValueError, csv.Error):
        return {}
    return rows[0] if rows and isinstance(rows[0], dict) else {}
