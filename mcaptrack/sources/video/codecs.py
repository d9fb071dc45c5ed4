"""The video codecs of messages, with one parser for each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from mcaptrack.sources.video import av1, h264, h265, vp9
from mcaptrack.sources.video.bitstream import AccessUnit, PictureHead


class Codec(NamedTuple):
    """The functions for the bytes of a codec. ``name`` and ``decoder`` are FFmpeg's names of it and of its decoder.

    ``annex_b`` is FFmpeg's bitstream filter from packets of a container to messages, "" where they are the same.
    ``read_head`` reads only the first bytes of a message.
    """

    name: str
    decoder: str
    annex_b: str
    inspect: Callable[[bytes], AccessUnit]
    read_head: Callable[[bytes], PictureHead]
    with_parameter_sets: Callable[[bytes, tuple[bytes, ...]], bytes]


#: By the format name in messages.
CODECS: Final[Mapping[str, Codec]] = {
    "h264": Codec("h264", "h264", "h264_mp4toannexb", h264.inspect, h264.read_head, h264.with_parameter_sets),
    "h265": Codec("hevc", "hevc", "hevc_mp4toannexb", h265.inspect, h265.read_head, h265.with_parameter_sets),
    "vp9": Codec("vp9", "vp9", "", vp9.inspect, vp9.read_head, lambda data, _: data),
    "av1": Codec("av1", "libdav1d", "", av1.inspect, av1.read_head, av1.with_parameter_sets),
}


def read_head(image_format: str, data: bytes) -> PictureHead:
    """Parse the first bytes of a message; decoding can begin at every still image."""
    codec = CODECS.get(image_format)
    return codec.read_head(data) if codec else PictureHead(True, True, True)


def is_video_codec(image_format: str) -> bool:
    """Whether pictures of this format may depend on earlier pictures."""
    return image_format in CODECS
