"""Objects in stores, such as Amazon S3: read by ranges, and replaced as a whole. Extensions know the stores.

An object is never changed, only replaced, and each version of it has another entity tag (etag). Parts of two versions
are never mixed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol, cast

from mcaptrack.errors import McaptrackError
from mcaptrack.installed import missing_extension
from mcaptrack.location import SCHEMES, Url
from mcaptrack.registry import Entry, blamed, find, names

__all__ = ["AbsentError", "Store", "StoreCheck", "Version", "replaced", "store_of"]

#: What is tried in a store, and the consequence if it fails.
_TRIED: Final = {
    "list": "objects can't be listed",
    "write": "objects can't be written",
    "read": "objects can't be read",
    "put-if-absent": "two commands at once may both write the first results of a log",
    "replace": "results of two commands at once may replace each other",
    "delete": "objects can't be removed",
}


class Version(NamedTuple):
    """A version of an object: its ``size`` in bytes, and its entity tag ``etag`` if the store gives one."""

    size: int
    etag: str | None


class AbsentError(McaptrackError):
    """There is no such object."""


def replaced(url: Url) -> McaptrackError:
    """The error for an object ``url`` that has another version now than when it was opened."""
    return McaptrackError(f"{url} was replaced by another version while it was being read; try again")


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


class Store(Protocol):
    """A store: a class that is made with the URL of an object in it, or of a prefix of such.

    What can't be done is a McaptrackError that names the URL, without secrets; AbsentError where nothing is to be read.
    """

    def find(self, url: Url) -> Version | None:
        """The present version of an object; None if there is none."""
        ...

    def read_end(self, url: Url, size: int) -> tuple[Version, bytes]:
        """The present version of an object, and its last ``size`` bytes."""
        ...

    def read_ranges(self, url: Url, version: Version, ranges: Sequence[tuple[int, int]]) -> list[bytes]:
        """Bytes from start to end of a version of an object, for each range; ``replaced`` if it is there no more."""
        ...

    def replace(self, url: Url, file: Path, before: Version | None) -> Version:
        """Write a file as an object, in place of the version ``before``, and of no other; None for a new object."""
        ...

    def delete(self, url: Url) -> None:
        """Remove an object; one that isn't there is no fault."""
        ...

    def list_objects(self, prefix: Url) -> Sequence[tuple[Url, Version]]:
        """The objects below a prefix of whole parts."""
        ...

    def why_absent(self, url: Url) -> str:
        """The reason that there is no object of this name: it may be a prefix of others."""
        ...

    def check(self, url: Url) -> StoreCheck:
        """Try what may be done at a bucket or prefix, with a small hidden object, which is removed again."""
        ...


def store_of(url: Url) -> Store:
    """The store of an object or prefix ``url``. Raises McaptrackError if it can't be used."""
    if url.scheme not in names("store"):
        what = f"{url} is in {SCHEMES[url.scheme]}, and what reads it"
        raise McaptrackError(missing_extension(url.scheme, "store", what))
    entry = find("store", url.scheme)
    with blamed(entry, "could not be made"):
        store: Store = entry.cls(url)
    return store if entry.is_built_in else cast("Store", _OfPackage(entry, store))


class _OfPackage:
    """The store of another package: whatever it raises names it."""

    def __init__(self, entry: Entry, store: Any) -> None:
        self._entry, self._store = entry, store

    def __getattr__(self, name: str) -> Callable[..., Any]:
        return partial(self._call, name)

    def _call(self, name: str, *arguments: Any) -> Any:
        with blamed(self._entry, f"failed at {arguments[0]}"):
            try:
                return getattr(self._store, name)(*arguments)
            except AbsentError as error:
                absent = error
        raise absent
