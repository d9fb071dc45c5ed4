"""A report that is served beside its log: its times become links that open a viewer there."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Callable
from typing import Any, Final

#: The numbers in a page, and the times in it that become links: ns since 1970, and the text.
_DATA: Final = re.compile(rb'<script type="application/json" id="mcaptrack-report">(.*?)</script>', re.DOTALL)
_TIME: Final = re.compile(rb'<span class="at" data-ns="(-?[0-9]{1,19})">([^<>]{1,40})</span>')


def is_about(page: bytes, fingerprint: str) -> bool:
    """Return whether a page is a report on one log with this fingerprint, in its current state."""
    found = _DATA.search(page)
    try:
        data: Any = json.loads(found[1]) if found else None
        logs = data["logs"]
        return bool(len(logs) == 1 and logs[0]["digest"] == fingerprint)
    except (ValueError, TypeError, KeyError, RecursionError):
        return False


def with_links(page: bytes, link_to: Callable[[int], str]) -> bytes:
    """Return a report with a link at each of its times; ``link_to`` returns the address for a log time in ns.

    Examples
    --------
    >>> with_links(b'<span class="at" data-ns="5">0:01</span>', lambda t_ns: f"http://a/?t={t_ns}&b").decode()
    '<a class="at" href="http://a/?t=5&amp;b">0:01</a>'
    """

    def linked(found: re.Match[bytes]) -> bytes:
        address = html.escape(link_to(int(found[1])), quote=True).encode()
        return b'<a class="at" href="' + address + b'">' + found[2] + b"</a>"

    return _TIME.sub(linked, page)
