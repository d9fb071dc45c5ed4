"""Logs: MCAP files. No other package knows their format.

with read(path) as log:                 channels, messages, frames
    with extend(log) as writer: ...     add channels to the same file, or drop some
with create(path) as writer: ...        a new one
check(path)                             find damage
recover(path, output)                   write what is intact to a new log
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from hashlib import sha256
from pathlib import Path

from mcap.opcode import Opcode

from mcaptrack.files import temporary_folder
from mcaptrack.location import Location, Url
from mcaptrack.log import records
from mcaptrack.log.check import CheckResult, Finding, check, clock_jumps, jumps_text
from mcaptrack.log.chunks import message_head, open_chunk
from mcaptrack.log.cut import Part, copy_messages, private_records
from mcaptrack.log.extend import extend, refuse_to_replace_recorded
from mcaptrack.log.messages import Message
from mcaptrack.log.reader import Channel, Log, find_topic, kept
from mcaptrack.log.recording_files import RESULTS_SUFFIX, listing_of, refuse_non_mcap, results_path, update_listing
from mcaptrack.log.records import MAGIC, Bytes, Record, walk
from mcaptrack.log.recover import recover
from mcaptrack.log.writer import LIBRARY, LogWriter, create
from mcaptrack.objects import AbsentError, store_of

# Opening logs, with their sidecars, and finding channels in them.


def read(path: Location, *, sidecar: bool | Callable[[Log], bool] | None = None) -> Log:
    """Open a log.

    Parameters
    ----------
    path : Path or Url
        An MCAP file, or an object that is one.
    sidecar : bool or callable, optional
        Whether to open the log with its sidecar, LOG.results.mcap: by default if it exists; True creates it, False
        ignores it. A callable gets the log alone and returns which.

    Returns
    -------
    Log
        Close it, or use it as a context manager.

    Raises
    ------
    McaptrackError
        If the file is missing, not an MCAP file, or damaged.
    """
    log = Log(path)
    try:
        if path.name.endswith(RESULTS_SUFFIX):
            return log
        if isinstance(path, Url):
            _attach_remote(log, results_path(path), sidecar(log) if callable(sidecar) else sidecar)
            return log
        results = results_path(path)
        if sidecar(log) if callable(sidecar) else sidecar or (sidecar is None and results.exists()):
            is_new = not results.exists()
            if is_new:
                with create(results):
                    pass
            log.attach_results(Log(results), is_new)
    except BaseException:
        log.__exit__()
        raise
    return log


def is_current(opened: Log, place: Location) -> bool:
    """Whether ``read`` would give the same log at this place: neither it nor its results were changed since.

    Raises McaptrackError if a store can't tell.
    """
    has_results = not place.name.endswith(RESULTS_SUFFIX)
    parts = [(place, opened), *([(results_path(place), opened.results)] if has_results else [])]
    return all(_is_at(where, part) for where, part in parts)


def _is_at(place: Location, part: Log | None) -> bool:
    """Whether a place still holds a part of a log as it was opened; None is nothing there."""
    if isinstance(place, Url):
        return store_of(place).find(place) == (part.version if part else None)
    return part.snapshot.is_at(place) if part else not place.exists()


def topics_with_schema(log: Log, names: Sequence[str]) -> list[Channel]:
    """The channels with one of these schemas, sorted by topic.

    ``names`` are those of the schemas, as in mcaptrack.Tracks, and ``log`` is open for reading.
    """
    return [channel for _, channel in sorted(log.channels.items()) if channel.schema_name in names]


def find_results(path: Location) -> Location | None:
    """The sidecar of a log, if there is one."""
    if path.name.endswith(RESULTS_SUFFIX):
        return None
    if isinstance(path, Url):
        url = results_path(path)
        return None if store_of(path).find(url) is None else url
    results = results_path(path)
    return results if results.exists() else None


def _attach_remote(log: Log, results: Url, sidecar: bool | None) -> None:
    """Attach the sidecar of a log in a store: the one that is there, or with ``sidecar`` a new one."""
    if sidecar is False:
        return
    try:
        existing = Log(results)
    except AbsentError:
        if not sidecar:
            return
        folder = temporary_folder()
        with create(Path(folder.name, results.name)):
            pass
        log.attach_results(Log(results, folder), is_new=True)
    else:
        log.attach_results(existing, is_new=False)


# All records of a log in file order, to copy them to another log.


def stream(log: Log) -> Iterator[tuple[int, Message]]:
    """All messages in file order, each with the id of its channel; one chunk in memory at a time.

    Raises McaptrackError where the log is damaged, and at the end if it was changed meanwhile.
    """
    source = log.snapshot.source.sequential()
    with log.snapshot.reporting_damage():
        for record in walk(source, len(MAGIC), log.index.data_end):
            if record.opcode == Opcode.MESSAGE:
                yield _message(source, record)
            elif record.opcode == Opcode.CHUNK:
                content = open_chunk(source, record)
                for inner in walk(content, 0, len(content)):
                    if inner.opcode == Opcode.MESSAGE:
                        yield _message(content, inner)
        log.snapshot.confirm_file_unchanged()


def _message(buffer: Bytes, record: Record) -> tuple[int, Message]:
    channel, sequence, t_ns, publish_ns = message_head(buffer, record)
    payload = bytes(buffer[record.body + records.MESSAGE_HEAD.size : record.end])
    return channel, Message(t_ns, sequence, publish_ns, payload)


def header(log: Log) -> tuple[str, str]:
    """The profile and the library in the header of a log."""
    with log.snapshot.reporting_damage():
        whole = log.snapshot.record(len(MAGIC))
        about = records.read_header(whole, records.record_at(whole, 0))
        return about.profile, about.library


def copy_attachments_and_metadata(
    log: Log, writer: LogWriter, *, without: Collection[str] = (), copied: set[bytes] | None = None
) -> None:
    """Copy the attachments of a log, and its metadata records except those named in ``without``.

    ``copied`` are digests of records that are there already, and are left out; those of new ones are added.

    ``writer`` writes them into another log.
    """
    copied = set() if copied is None else copied
    with log.snapshot.reporting_damage():
        for entries, copy in (
            (log.index.metadata, writer.copy_metadata),
            (log.index.attachments, writer.copy_attachment),
        ):
            before = frozenset(copied)
            for listed in entries:
                record = bytes(log.snapshot.record(listed.offset))
                digest = sha256(record).digest()
                if (entries is log.index.metadata and listed.name in without) or digest in before:
                    continue
                copied.add(digest)
                copy(record)
