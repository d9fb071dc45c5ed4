"""Try a bucket or a prefix in a store with a small hidden object, which is removed again."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Final
from uuid import uuid4

from mcaptrack.errors import McaptrackError
from mcaptrack.location import SCHEMES, Url, hide_secrets, parse
from mcaptrack.objects import (
    Version,
    delete,
    described,
    find,
    library,
    list_objects,
    put_if_unchanged,
    read_end,
    read_ranges,
)

#: The operations, and the consequence of one that fails.
_TRIED: Final = {
    "list": "objects can't be listed",
    "write": "objects can't be written",
    "read": "objects can't be read",
    "put-if-absent": "two commands at once may both write the first results of a log",
    "replace": "results of two commands at once may replace each other",
    "delete": "objects can't be removed",
}
_REASON: Final = re.compile(r"^.*? can't be (?:read|written|removed): ")


@dataclass(frozen=True)
class StoreCheck:
    """The operations that a bucket or a prefix allows.

    Attributes
    ----------
    url : str
        The bucket or prefix.
    server, region : str
        The address of the server, or the name of the service; and its region ("" where there are none).
    credentials : str
        Where they come from.
    access : dict of str to str
        Why each of "list", "write", "read", "put-if-absent" (write an object only if it is absent), "replace" (only if
        it is unchanged) and "delete" fails; "" where it works. What could not be tried is not there.

    """

    url: str
    server: str
    region: str
    credentials: str
    access: dict[str, str]

    @property
    def faults(self) -> tuple[str, ...]:
        """One line for each reason."""
        reasons: dict[str, list[str]] = {}
        for name, why in self.access.items():
            if why:
                reasons.setdefault(why, []).append(_TRIED[name])
        return tuple(f"{self.url}: {' and '.join(tried)}: {why}" for why, tried in reasons.items())


def url_of_store(store: str) -> Url:
    """Return the URL of a bucket or prefix; that of a log stands for the prefix with it.

    Raises McaptrackError for anything else, and if what reads the store is not installed.
    """
    url = parse(store)
    if not isinstance(url, Url):
        examples = ", ".join(f"{scheme}://" for scheme in SCHEMES)
        name = hide_secrets(store) if "://" in store else store
        raise McaptrackError(f"{name:.200} is no bucket or prefix in a store; give a URL with {examples}")
    library(url)
    return url.parent if url.suffix.lower() == ".mcap" else url


def check_store(url: Url) -> StoreCheck:
    """Try the operations of a run on a store."""
    server, region, credentials = described(url)
    access = dict(_tries(url))
    return StoreCheck(str(url), server, region, credentials, {name: access[name] for name in _TRIED if name in access})


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
