"""The video codecs that messages carry, one beside the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from mcaptrack.video import av1, h264, h265, vp9
from mcaptrack.video.units import Unit


class Codec(NamedTuple):
    """What is done with the bytes of one codec. ``name`` is FFmpeg's, ``decoder`` that of what decodes it there.

    ``annex_b`` is the filter that makes messages of a container's packets, "" where these are the same. ``entry`` says
    of a message whether it holds a key picture and whether it holds the parameter sets, from its first bytes alone.
    """

    name: str
    decoder: str
    annex_b: str
    inspect: Callable[[bytes], Unit]
    entry: Callable[[bytes], tuple[bool, bool]]
    with_sets: Callable[[bytes, tuple[bytes, ...]], bytes]


#: By the format that messages name.
CODECS: Final[Mapping[str, Codec]] = {
    "h264": Codec("h264", "h264", "h264_mp4toannexb", h264.inspect, h264.entry, h264.with_sets),
    "h265": Codec("hevc", "hevc", "hevc_mp4toannexb", h265.inspect, h265.entry, h265.with_sets),
    "vp9": Codec("vp9", "vp9", "", vp9.inspect, vp9.entry, lambda data, _: data),
    "av1": Codec("av1", "libdav1d", "", av1.inspect, av1.entry, av1.with_sets),
}


def entry(image_format: str, data: bytes) -> tuple[bool, bool]:
    """Whether decoding can begin at a message, and whether the parameter sets for that are in it; stills always do."""
    codec = CODECS.get(image_format)
    return codec.entry(data) if codec else (True, True)
