"""The laws that hold for every store of objects."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final
from uuid import uuid4

from mcaptrack.errors import McaptrackError
from mcaptrack.location import Url, parse
from mcaptrack.objects import AbsentError, Store, StoreCheck, Version
from mcaptrack.registry import blamed
from mcaptrack.testing.functions import function_entry
from mcaptrack.testing.transforms import LawError, law, same_process

_FIRST, _SECOND = b"0123456789", b"9876543210"
#: Ranges of an object, of which some meet and overlap.
_RANGES: Final = ((0, 3), (3, 4), (2, 10), (9, 10))


def check_store(store: Callable[[Url], Store], url: str) -> None:
    """Check a store of objects against the laws that hold for every one, with a few small objects.

    The laws: an object that isn't there is absent; one that was written is listed, below prefixes of whole parts, and
    read as it was written; each version is another one; what was replaced is not read, and nothing is replaced that
    another process has written; ``check`` gives a ``StoreCheck`` without faults, and leaves nothing; what can't be done
    is a McaptrackError in one line; it leaves the process that it runs in as it was.

    Parameters
    ----------
    store : callable
        The class of the store.
    url : str
        The URL of a bucket or prefix in it, where objects may be written.

    Raises
    ------
    LawError
        If it breaks a law; the message names the law.
    """
    entry = function_entry("store", store)
    prefix = parse(url)
    if not isinstance(prefix, Url):
        raise McaptrackError(f"{url:.200} is no URL of a store")
    place = prefix / f".mcaptrack-check-{uuid4().hex}"
    at, beside = place / "a", place.with_name(f"{place.name}s") / "a"
    with same_process(entry.name), TemporaryDirectory() as folder, law("conforms"):
        files = [Path(folder, name) for name in "ab"]
        for file, content in zip(files, (_FIRST, _SECOND), strict=True):
            file.write_bytes(content)
        with blamed(entry, f"could not be made with {prefix}"):
            made = store(prefix)

        def call(name: str, *arguments: Any) -> Any:
            try:
                return getattr(made, name)(*arguments)
            except McaptrackError as error:
                if "\n" in str(error) or str(arguments[0]) not in str(error):
                    raise LawError(
                        f"conforms: {name} says {str(error)!r:.200}, and not in a line what {at} is"
                    ) from None
                raise
            except Exception as error:
                raise LawError(
                    f"conforms: {name} raises {type(error).__name__}: {error}; raise McaptrackError"
                ) from None

        def holds(said: str, is_so: object) -> None:
            if not is_so:
                raise LawError(said)

        holds("absent: `find` finds an object that isn't there", call("find", at) is None)
        holds("absent: `why_absent` gives no reason", call("why_absent", at))
        with _refused("absent: `read_end` reads an object that isn't there", AbsentError):
            call("read_end", at, 5)
        try:
            first: Version = call("replace", at, files[0], None)
            call("replace", beside, files[0], None)
            holds("conforms: `find` finds another version than was written", call("find", at) == first)
            holds("conforms: the size of a version is not that of the file", first.size == len(_FIRST))
            for size in (5, 99):
                wanted = (first, _FIRST[-size:])
                holds(f"conforms: `read_end` of {size} bytes gives others", call("read_end", at, size) == wanted)
            ranges = [_FIRST[start:end] for start, end in _RANGES]
            holds("conforms: `read_ranges` gives other bytes", [*call("read_ranges", at, first, _RANGES)] == ranges)
            holds("conforms: `list_objects` gives others", [*call("list_objects", place)] == [(at, first)])
            second: Version = call("replace", at, files[1], first)
            holds("versions: another content of this size has the same version", second != first)
            with _refused("versions: `read_ranges` reads a version that was replaced"):
                call("read_ranges", at, first, _RANGES)
            for before in (first, None):
                with _refused(f"versions: `replace` overwrites another version than {before}"):
                    call("replace", at, files[0], before)
            holds("versions: what was refused is written", call("read_end", at, 99) == (second, _SECOND))
            checked = call("check", place)
            holds(f"conforms: `check` says {checked!r:.200}", isinstance(checked, StoreCheck) and not checked.faults)
            holds("conforms: `check` leaves an object", [*call("list_objects", place)] == [(at, second)])
        finally:
            for each in (at, beside):
                call("delete", each)
        call("delete", at)
        holds("conforms: `delete` leaves the object", call("find", at) is None)


@contextmanager
def _refused(said: str, kind: type[McaptrackError] = McaptrackError) -> Iterator[None]:
    with suppress(kind):
        yield
        raise LawError(said)
