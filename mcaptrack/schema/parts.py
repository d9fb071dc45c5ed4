"""Parts of channels: digests of a log that was cut out of a longer one name the whole channels, and which part it is.

Parts of a channel are told from the whole, and can be joined again. What is up to date stays so, since the digests of
all channels get the same limits: DIGEST@START-END, from a time until before another, in ns.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from mcaptrack.geometry.clocks import parse_ns

#: From a time until before another, in ns.
Span = tuple[int, int]
NO_END: Final = 2**64
ALL: Final = (0, NO_END)


def span_of(start_ns: str, end_ns: str) -> Span:
    """The span with these limits as texts; "" for none."""
    return parse_ns(start_ns) or 0, parse_ns(end_ns) or NO_END


def limits_of(span: Span) -> tuple[str, str]:
    """The limits of a span as texts; "" for none."""
    return str(span[0] or ""), "" if span[1] == NO_END else str(span[1])


def within(span: Span, other: Span) -> Span:
    """The span that is in both."""
    return max(span[0], other[0]), min(span[1], other[1])


def joined(spans: Iterable[Span]) -> Span:
    """The span from the first start to the last end."""
    starts, ends = zip(*spans, strict=True)
    return min(starts), max(ends)


def read_digest(digest: str) -> tuple[str, Span]:
    """The digest of a whole channel, and which part of it a digest names."""
    whole, _, limits = digest.partition("@")
    start_ns, _, end_ns = limits.partition("-")
    return whole, span_of(start_ns, end_ns)


def part_digest(whole: str, span: Span) -> str:
    """The digest of a part of a channel; "" if that of the whole isn't known."""
    return f"{whole}@{'-'.join(limits_of(span))}" if whole and span != ALL else whole
