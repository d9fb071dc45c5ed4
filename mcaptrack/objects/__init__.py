"""Objects in stores (Amazon S3, Google Cloud Storage, Azure): read by ranges, replaced as a whole. Only here: obstore.

Credentials, regions and endpoints are found as the programs of these services find them: in the environment, in the
profiles of AWS, on the machine itself. Requests that fail are sent again, with growing pauses. What can't be mended by
that is a McaptrackError that names the URL; no message contains a secret.

An object is never changed, only replaced, and each version of it has another entity tag (etag). Every request for a
part of an object asks for the version that was opened, so that parts of two versions are never mixed.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final, NamedTuple

from mcaptrack.errors import McaptrackError
from mcaptrack.location import Url
from mcaptrack.objects.stores import (
    AbsentError,
    breaks_off,
    library,
    meaning_of,
    overtaken,
    replaced,
    reporting_faults,
    store_of,
)

__all__ = [
    "AbsentError",
    "Version",
    "delete",
    "find",
    "library",
    "list_objects",
    "put_if_unchanged",
    "read",
    "read_end",
    "read_ranges",
    "replace",
]

#: Requests at the same time, and the most bytes of one.
_AT_ONCE: Final = 8
_MAX_BYTES: Final = 8 * 2**20
#: Larger objects are written in parts of this size, each with its checksum.
_PART_BYTES: Final = 16 * 2**20
#: An answer that breaks off is asked for so often.
_TRIES: Final = 3


class Version(NamedTuple):
    """A version of an object: its size in bytes, and its entity tag if the store gives one."""

    size: int
    etag: str | None


def read_end(url: Url, size: int) -> tuple[Version, bytes]:
    """The present version of an object, and its last ``size`` bytes; in one request where the store can.

    Raises McaptrackError if there is no such object, or if it can't be read.
    """
    obstore = library(url)
    with reporting_faults(url):
        try:
            return _get(obstore, url, {"range": {"suffix": size}})
        except obstore.exceptions.BaseError as error:
            # Azure knows no ranges of this kind, and an empty object has none.
            is_range = any(fault in str(error) for fault in ("416", "non-partial"))
            if not is_range and not isinstance(error, obstore.exceptions.NotSupportedError):
                raise
            version = _version(obstore.head(store_of(url), url.key))
    start = max(version.size - size, 0)
    return version, read_ranges(url, version, [(start, version.size)])[0] if version.size else b""


def read_ranges(url: Url, version: Version, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
    """Bytes from start to end of a version of an object, for each range; long ranges in several requests at once.

    Raises McaptrackError if the object has been replaced, or can't be read.
    """
    pieces = [(at, min(at + _MAX_BYTES, end)) for start, end in ranges for at in range(start, end, _MAX_BYTES)]
    if len(pieces) <= 1:
        parts = [_read(url, version, *piece) for piece in pieces]
    else:
        with ThreadPoolExecutor(min(_AT_ONCE, len(pieces))) as threads:
            parts = list(threads.map(lambda piece: _read(url, version, *piece), pieces))
    waiting = iter(parts)
    return [b"".join(next(waiting) for _ in range(start, end, _MAX_BYTES)) for start, end in ranges]


def _read(url: Url, version: Version, start: int, end: int) -> bytes:
    obstore = library(url)
    options: dict[str, Any] = {"range": (start, end)} | ({"if_match": version.etag} if version.etag else {})
    with reporting_faults(url):
        present, data = _get(obstore, url, options)
    if present != version:
        raise replaced(url)
    if len(data) != end - start:
        raise McaptrackError(f"{url} can't be read: the store gives {len(data)} bytes of {end - start}")
    return data


def _get(obstore: Any, url: Url, options: Mapping[str, Any]) -> tuple[Version, bytes]:
    """The version of an object, and a part of it. An answer that breaks off is asked for again."""
    for left in reversed(range(_TRIES)):
        try:
            response = obstore.get(store_of(url), url.key, options=options)
            return _version(response.meta), bytes(response.bytes())
        except obstore.exceptions.GenericError as error:
            if not left or not breaks_off(error):
                raise
    raise AssertionError("the last attempt gives an answer or fails")


def find(url: Url) -> Version | None:
    """The present version of an object; None if there is none.

    Raises McaptrackError if the store can't tell.
    """
    obstore = library(url)
    with reporting_faults(url):
        try:
            return _version(obstore.head(store_of(url), url.key))
        except FileNotFoundError as error:
            if meaning_of(url, error):
                raise
            return None


def read(url: Url) -> bytes:
    """A small object. Raises McaptrackError if there is none, or if it can't be read."""
    obstore = library(url)
    with reporting_faults(url):
        return _get(obstore, url, {})[1]


def replace(url: Url, file: Path, before: Version | None) -> Version:
    """Write a file as an object, in place of the version ``before``; None for a new object.

    The object is complete when it appears. A large one is sent in parts. Afterwards it is read back and compared.

    Raises McaptrackError if there is another version by now, or if the object can't be written.
    """
    obstore = library(url)
    size = file.stat().st_size
    with reporting_faults(url, "written"):
        try:
            if size <= _PART_BYTES:
                mode: Any = {"e_tag": before.etag} if before else "create"
                answer = obstore.put(store_of(url), url.key, file.read_bytes(), mode=mode, use_multipart=False)
            else:
                if find(url) != before:
                    raise overtaken(url)
                answer = obstore.put(store_of(url), url.key, file, chunk_size=_PART_BYTES, max_concurrency=4)
            version = Version(size, answer["e_tag"])
        except (obstore.exceptions.PreconditionError, obstore.exceptions.AlreadyExistsError):
            present = find(url)  # it may be this one, if the answer to the first attempt was lost
            if present is None or present.size != size or not _holds(url, present, file):
                raise overtaken(url) from None
            return present
    if not _holds(url, version, file):
        raise McaptrackError(f"{url} does not hold what was written to it; the results are not safe there")
    return version


def _holds(url: Url, version: Version, file: Path) -> bool:
    """Whether an object has the bytes of a file."""
    theirs = ours = 0
    with file.open("rb") as stream:
        for start in range(0, version.size, 4 * _MAX_BYTES):
            data = read_ranges(url, version, [(start, min(start + 4 * _MAX_BYTES, version.size))])[0]
            theirs, ours = zlib.crc32(data, theirs), zlib.crc32(stream.read(len(data)), ours)
        return theirs == ours and not stream.read(1)


def put_if_unchanged(url: Url, data: bytes, before: Version | None) -> Version | None:
    """Write a small object if the store still has the version ``before``; None stands for no object.

    Returns the version that was written; None if there is another one. Of two processes, one succeeds. ``data`` has to
    differ between processes: if the store has it, it is taken for what was written here, because the answer to a
    request may be lost.
    """
    obstore = library(url)
    mode: Any = {"e_tag": before.etag} if before else "create"
    with reporting_faults(url, "written"):
        try:
            answer = obstore.put(store_of(url), url.key, data, mode=mode, use_multipart=False)
            return Version(len(data), answer["e_tag"])
        except (
            obstore.exceptions.AlreadyExistsError,
            obstore.exceptions.PreconditionError,
            FileNotFoundError,
        ) as error:
            if isinstance(error, FileNotFoundError) and meaning_of(url, error):
                raise
    try:
        present, content = read_end(url, max(len(data), 1) + 1)
    except AbsentError:
        return None
    return present if content == data else None


def delete(url: Url) -> None:
    """Remove an object; one that isn't there is no fault."""
    obstore = library(url)
    with reporting_faults(url, "removed"):
        try:
            obstore.delete(store_of(url), url.key)
        except FileNotFoundError as error:
            if meaning_of(url, error):
                raise


def list_objects(prefix: Url) -> Iterator[tuple[Url, Version]]:
    """The objects below a prefix of whole parts ("s3://bucket/night": those in it, not "s3://bucket/nights/a").

    They come in the order of the store, which is alphabetical in most.
    """
    obstore = library(prefix)
    with reporting_faults(prefix):
        root = Url(f"{prefix.scheme}://{prefix.bucket}")
        for page in obstore.list(store_of(prefix), prefix=prefix.key.strip("/") or None):
            yield from ((root / listed["path"], _version(listed)) for listed in page)


def _version(meta: Any) -> Version:
    return Version(meta["size"], meta["e_tag"])


def why_absent(url: Url) -> str:
    """The reason that there is no object of this name: it may be a bucket, or a prefix of others."""
    if not url.key.strip("/"):
        return f"it is a bucket; name the logs in it, as in {url.rstrip('/')}/*.mcap"
    try:
        inside = next(list_objects(url), None)
    except McaptrackError:
        inside = None
    if inside:
        return (
            f"it is no object but a prefix, of {inside[0]} and maybe others; name logs, as in {url.rstrip('/')}/*.mcap"
        )
    return "there is no such object"
