"""Try a bucket or a prefix in a store with a small hidden object, which is removed again."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import islice
from typing import Final
from uuid import uuid4

from mcaptrack.errors import McaptrackError
from mcaptrack.extensions.stores.objects import (
    delete,
    described,
    find,
    list_objects,
    put_if_unchanged,
    read_end,
    read_ranges,
)
from mcaptrack.location import Url
from mcaptrack.objects import StoreCheck, Version

_REASON: Final = re.compile(r"^.*? can't be (?:read|written|removed): ")


def check_store(url: Url) -> StoreCheck:
    """Try the operations of a run on a store."""
    server, region, credentials = described(url)
    return StoreCheck(str(url), server, region, credentials, dict(_tries(url)))


def _tries(url: Url) -> Iterator[tuple[str, str]]:
    """Yield each operation, and why it failed; "" if it didn't."""
    listed: list[Url] = []
    yield "list", _why(lambda: listed.extend(member for member, _ in islice(list_objects(url), 1)))
    probe = url / f".mcaptrack-doctor-{uuid4().hex}"
    texts = [f"{number} {uuid4().hex}".encode() for number in range(4)]
    versions: list[Version | None] = []
    why = _why(lambda: versions.append(put_if_unchanged(probe, texts[0], None)))
    yield "write", why
    if why or versions[0] is None:
        if listed:
            yield "read", _why(lambda: read_end(listed[0], 1))
        return
    first = versions[0]
    try:
        yield "read", _why(lambda: _compare(probe, first, texts[0]))
        yield "put-if-absent", _why(lambda: _refuse(put_if_unchanged(probe, texts[1], None)))
        yield "replace", _why(lambda: _replace(probe, first, texts))
    finally:
        why = _why(lambda: delete(probe))
    yield "delete", why


def _why(attempt: Callable[[], object]) -> str:
    """Do something, and return why it failed; "" if it didn't."""
    try:
        attempt()
    except McaptrackError as error:
        return _REASON.sub("", str(error))
    return ""


def _compare(url: Url, version: Version, text: bytes) -> None:
    if read_ranges(url, version, [(0, len(text))]) != [text]:
        raise McaptrackError("the store gives other bytes than were written")


def _refuse(written: Version | None) -> None:
    if written is not None:
        raise McaptrackError("the store overwrites an object although it was asked not to")


def _replace(url: Url, first: Version, texts: list[bytes]) -> None:
    with suppress(McaptrackError):  # a store that overwrote it has another version now
        first = find(url) or first
    second = put_if_unchanged(url, texts[2], first)
    if second is None:
        raise McaptrackError("the store does not replace an object that is unchanged")
    _refuse(put_if_unchanged(url, texts[3], first))
