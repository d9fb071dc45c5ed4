"""Claims on logs in a store: small objects beside them, each written by one of several fleets only.

A store has no locks, and its clock is not that of any machine. A claim is therefore an object that is written if there
is none, and replaced if it is still the version that was read; the store lets one of several such writes succeed. A
sign of life is another version of it. Another fleet takes a claim over if it has seen the same version for a while, on
its own clock.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from time import monotonic
from typing import Any, Final
from uuid import uuid4

from mcaptrack import objects
from mcaptrack.errors import McaptrackError
from mcaptrack.location import Url
from mcaptrack.objects import AbsentError, Version

#: Seconds between signs of life: each is a request for each log that is being processed.
BEAT_S: Final = 30.0
#: The most that is read of a claim, in bytes.
_MOST: Final = 65536


@dataclass
class _Held:
    """A claim of this process: its object, the version that was written last, and when."""

    url: Url
    version: Version
    beaten: float


class ObjectClaims:
    """The claims of this process on logs in stores.

    ``me`` describes this process, and ``has_ended`` tells whether another one on this machine has ended (None: it is on
    another machine).
    """

    def __init__(
        self, me: Mapping[str, Any], has_ended: Callable[[Mapping[str, Any]], bool | None], stale_s: float
    ) -> None:
        self._me = {**me, "token": uuid4().hex}
        self._has_ended, self._stale_s = has_ended, stale_s
        self._mine: dict[str, _Held] = {}
        self._seen: dict[Url, tuple[Version, float]] = {}
        self._beats = 0

    def take(self, location: str, url: Url) -> tuple[bool, Mapping[str, Any] | None]:
        """Claim a log by an object. Returns whether that succeeded, and who had the claim before and has ended.

        Raises McaptrackError if the store can't be written.
        """
        before: Version | None = None
        owner: Mapping[str, Any] | None = None
        version = objects.put_if_unchanged(url, self._content(location), None)
        if version is None:
            try:
                before, data = objects.read_end(url, _MOST)
            except AbsentError:  # it was given up at this moment
                return False, None
            owner = _owner(data)
            if not self._is_left(url, before, owner):
                return False, None
            version = objects.put_if_unchanged(url, self._content(location), before)
            if version is None:  # another fleet was quicker
                return False, None
        self._mine[location] = _Held(url, version, monotonic())
        return True, owner

    def _is_left(self, url: Url, version: Version, owner: Mapping[str, Any]) -> bool:
        """Whether the fleet that has a claim has ended."""
        ended = self._has_ended(owner)
        if ended is not None:
            return ended
        seen, since = self._seen.get(url, (None, 0.0))
        if seen != version:
            self._seen[url] = version, monotonic()
            return False
        return monotonic() - since > self._stale_s

    def beat(self) -> None:
        """Give a sign of life where it is time. A claim that another fleet has taken over is forgotten."""
        for location, held in list(self._mine.items()):
            if monotonic() - held.beaten < BEAT_S:
                continue
            held.beaten = monotonic()
            with suppress(McaptrackError):  # the store doesn't answer now; the next sign may arrive
                version = objects.put_if_unchanged(held.url, self._content(location), held.version)
                if version is None:
                    del self._mine[location]
                else:
                    held.version = version

    def release(self, location: str) -> None:
        """Give a claim up, unless another fleet has taken it over."""
        held = self._mine.pop(location, None)
        if held is None:
            return
        with suppress(McaptrackError):
            if _owner(objects.read(held.url)).get("token") == self._me["token"]:
                objects.delete(held.url)

    def release_all(self) -> None:
        """Give all claims up."""
        for location in list(self._mine):
            self.release(location)

    def _content(self, location: str) -> bytes:
        """Return the text of a claim, which differs from all others that were written."""
        self._beats += 1
        return json.dumps({"location": location, **self._me, "beats": self._beats}).encode()


def _owner(data: bytes) -> dict[str, Any]:
    """Return who claims a log; nothing for an object that is no claim."""
    try:
        owner = json.loads(data)
    except ValueError:
        return {}
    return owner if isinstance(owner, dict) else {}
