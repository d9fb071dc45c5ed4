"""The location of a log: a file, or an object in a store (Amazon S3, Google Cloud Storage, Azure). Only names; no I/O.

    parse("log.mcap")                     Path("log.mcap")
    parse("s3://bucket/night/a.mcap")     Url("s3://bucket/night/a.mcap")

A path and a URL have the same parts: ``name``, ``stem``, ``suffix``, ``parent``, ``parts``, ``with_name``,
``with_suffix``, and ``/`` adds a name. Only a path can be asked what is there, so that the type checker finds code that
takes an object for a file.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Final, Self, TypeGuard, TypeVar

from mcaptrack.errors import McaptrackError

__all__ = [
    "SCHEMES", "Location", "Url", "distinct_names", "hide_secrets", "is_remote", "local_name", "parse",
    "shortened", "sibling",
]  # fmt: skip

#: The schemes of URLs of objects, and what they stand for.
SCHEMES: Final = {"s3": "Amazon S3", "gs": "Google Cloud Storage", "az": "Azure Blob Storage"}
#: The longest name of a file in bytes.
_LONGEST: Final = 255
_DIGEST: Final = 16
#: A URL, also one that has become a path: "s3://bucket/a" is "s3:/bucket/a" then.
_URL: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):(?:/+(.*))?", re.DOTALL)


class Url(str):
    """The URL of an object in a store, or of a prefix of such: "s3://BUCKET/NAME". Made by ``parse``."""

    __slots__ = ()

    @property
    def scheme(self) -> str:
        """The kind of store: one of ``SCHEMES``."""
        return self.partition("://")[0]

    @property
    def bucket(self) -> str:
        """The bucket; a container in Azure."""
        return self.partition("://")[2].partition("/")[0]

    @property
    def key(self) -> str:
        """The name of the object in its bucket; "" for the bucket itself."""
        return self.partition("://")[2].partition("/")[2]

    @property
    def parts(self) -> tuple[str, ...]:
        """The scheme with the bucket, and the parts of the key."""
        return (f"{self.scheme}://{self.bucket}", *filter(None, self.key.split("/")))

    @property
    def name(self) -> str:
        """The last part of the key; "" for a bucket."""
        return self.key.rstrip("/").rpartition("/")[2]

    @property
    def stem(self) -> str:
        """The name without its suffix."""
        return PurePosixPath(self.name).stem

    @property
    def suffix(self) -> str:
        """The suffix of the name, with its dot."""
        return PurePosixPath(self.name).suffix

    @property
    def parent(self) -> Self:
        """The URL without its last part; that of a bucket is itself."""
        first, *more = self.parts
        return type(self)("/".join([first, *more[:-1]]))

    def with_name(self, name: str) -> Self:
        """The URL with another last part."""
        return self.parent / name

    def with_suffix(self, suffix: str) -> Self:
        """The URL with another suffix of its name."""
        return self.with_name(str(PurePosixPath(self.name).with_suffix(suffix)))

    def __truediv__(self, name: str) -> Self:
        return type(self)(f"{self.rstrip('/')}/{name}")


Location = Path | Url


def is_remote(location: object) -> TypeGuard[Url]:
    """Whether a location is an object in a store."""
    return isinstance(location, Url)


def parse(text: str | os.PathLike[str]) -> Location:
    """The location that a text or a path names.

    Raises McaptrackError for an empty name, and for a URL that can't be the name of an object. URLs of other schemes
    become paths, which ``files.refuse_url`` refuses.

    Examples
    --------
    >>> parse(Path("s3://bucket/night/a.mcap"))
    's3://bucket/night/a.mcap'
    >>> parse("s3://bucket/night/a.mcap").with_suffix(".results.mcap").key
    'night/a.results.mcap'
    """
    if isinstance(text, Url):
        return text
    if not os.fspath(text):
        raise McaptrackError("an empty name is no file or folder; give its name, or . for the working folder")
    match = _URL.fullmatch(os.fspath(text))
    if match is None or match[1].lower() not in SCHEMES:
        return Path(text)
    scheme, rest = match[1].lower(), match[2] or ""
    url = Url(f"{scheme}://{rest}")
    if "@" in url.bucket or ":" in url.bucket:
        raise McaptrackError(
            f"{hide_secrets(url)}: credentials don't belong in a URL; put them into the environment or a profile, "
            f"where programs for {SCHEMES[scheme]} look for them"
        )
    if not url.bucket:
        raise McaptrackError(f"{scheme}:// names no bucket; give {scheme}://BUCKET/NAME")
    if not url.isprintable():
        raise McaptrackError(f"{str(url)!a} is no URL: it has characters that can't be printed")
    parts = url.key.rstrip("/").split("/") if url.key else []
    if wrong := [part for part in parts if part in ("", ".", "..")]:
        raise McaptrackError(f"{url} can't be read: a part of its name is {wrong[0]!r}; give the name of an object")
    return url


P = TypeVar("P", Path, Url, Location)


def sibling(location: P, end: str, *, of: str | None = None) -> P:
    """The location beside another with the name ``of`` (by default the name without its suffix) and the suffix ``end``.

    A name that would be too long for file systems is shortened.

    Examples
    --------
    >>> sibling(Path("runs/a.mcap"), ".report.html")
    PosixPath('runs/a.report.html')
    >>> len(sibling(Path("a" * 250 + ".mcap"), ".report.html").name)
    255
    """
    stem = location.stem if of is None else of
    is_long = len(_raw(stem + end)) > _LONGEST
    return location.with_name((shortened(stem, _LONGEST - _DIGEST - 1 - len(_raw(end))) if is_long else stem) + end)


def shortened(name: str, most_bytes: int) -> str:
    """A name, of which no more than this is kept if it is longer, with a digest of the whole name after it.

    ``most_bytes`` is the largest length in UTF-8.
    """
    raw = _raw(name)
    if len(raw) <= most_bytes:
        return name
    return raw[:most_bytes].decode("utf-8", "ignore") + "-" + hashlib.sha256(raw).hexdigest()[:_DIGEST]


def _raw(name: str) -> bytes:
    return name.encode("utf-8", "surrogatepass")


def local_name(location: Location, suffix: str) -> Path:
    """The default path of a file that is made of a log: beside a file, or for an object in the working folder.

    ``location`` is the log, and ``suffix`` takes the place of its .mcap.
    """
    return sibling(Path(location.name) if isinstance(location, Url) else location, suffix)


def distinct_names(names: Sequence[str], places: Sequence[Location]) -> list[str]:
    """The names of logs that are used together; equal ones get as many of their folders as make them differ.

    ``places`` are the locations of the logs, without links. Raises McaptrackError if one is there twice, so
    that it would count twice, or if two have the same name even so: their rows would be taken for those of one log.

    Examples
    --------
    >>> distinct_names(["walk", "walk", "run"], [Path("/a/walk.mcap"), Path("/b/walk.mcap"), Path("/a/run.mcap")])
    ['a/walk', 'b/walk', 'run']
    """
    twice = next((place for place, count in Counter(places).items() if count > 1), None)
    if twice is not None:
        raise McaptrackError(f"{twice} is named twice; name it once")
    distinct = list(names)
    for depth in range(1, 1 + max((len(place.parts) for place in places), default=0)):
        again = {name for name, count in Counter(distinct).items() if count > 1}
        if not again:
            break
        distinct = [
            "/".join([*place.parts[:-1][-depth:], name]) if current in again else current
            for name, current, place in zip(names, distinct, places, strict=True)
        ]
    first: dict[str, Location] = {}
    for name, place in zip(distinct, places, strict=True):
        if name in first:
            raise McaptrackError(
                f"{first[name]} and {place} would both be {name.rpartition('/')[2]}, and their rows those of one log; "
                "rename one of them, or take them one by one"
            )
        first[name] = place
    return distinct


def hide_secrets(url: str) -> str:
    """A URL without a user's name and password, and without what follows a question mark, for messages."""
    scheme, _, rest = url.partition("://")
    host, slash, path = rest.partition("/")
    if scheme.lower() not in SCHEMES:
        path = path.partition("?")[0] + ("?..." if "?" in path else "")
    return f"{scheme}://{host.rpartition('@')[2]}{slash}{path}"
