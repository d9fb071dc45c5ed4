"""The video codecs that messages carry, one beside the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from mcaptrack.sources.video import av1, h264, h265, vp9
from mcaptrack.sources.video.units import Entry, Unit


class Codec(NamedTuple):
    """What is done with the bytes of one codec. ``name`` is FFmpeg's, ``decoder`` that of what decodes it there.

    ``annex_b`` is the filter that makes messages of a container's packets, "" where these are the same. ``entry`` looks
    at the first bytes of a message alone.
    """

    name: str
    decoder: str
    annex_b: str
    inspect: Callable[[bytes], Unit]
    entry: Callable[[bytes], Entry]
    with_sets: Callable[[bytes, tuple[bytes, ...]], bytes]


#: By the format that messages name.
CODECS: Final[Mapping[str, Codec]] = {
    "h264": Codec("h264", "h264", "h264_mp4toannexb", h264.inspect, h264.entry, h264.with_sets),
    "h265": Codec("hevc", "hevc", "hevc_mp4toannexb", h265.inspect, h265.entry, h265.with_sets),
    "vp9": Codec("vp9", "vp9", "", vp9.inspect, vp9.entry, lambda data, _: data),
    "av1": Codec("av1", "libdav1d", "", av1.inspect, av1.entry, av1.with_sets),
}


def entry(image_format: str, data: bytes) -> Entry:
    """What a message of this format begins with; decoding can begin at every still."""
    codec = CODECS.get(image_format)
    return codec.entry(data) if codec else Entry(True, True, True)


def is_video(image_format: str) -> bool:
    """Whether pictures of this format may need pictures before them."""
    return image_format in CODECS
