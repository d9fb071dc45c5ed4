"""Decode and encode a tiny picture by each codec, to see whether the FFmpeg that is installed can."""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Mapping
from fractions import Fraction
from types import MappingProxyType
from typing import Final

import numpy as np

from mcaptrack.errors import in_one_line
from mcaptrack.geometry.arrays import Image
from mcaptrack.sources.video.codecs import CODECS

_SIZE_PX: Final = 64
#: Mean error of the brightness: that of video may run from 16 to 235, and compression changes it.
_MAX_ERROR: Final = 40.0
#: One picture of each codec, as `_picture` draws it: 64 x 64 px. The encoder, which is tested too, makes that of H.264.
_ENCODED: Final[Mapping[str, str]] = MappingProxyType(
    {
        "h265": "AAAAAUABDAH//wFgAAADAJAAAAMAAAMAHpWYCQAAAAFCAQEBYAAAAwCQAAADAAADAB6gIIEFllZpJMrmgIAAAAMAgAAADIQAAAAB"
        "RAHBcrQiQAAAASgBrx2A9wFb//JQqqg+DEnqcw==",
        "vp9": "gkmDQgAD8AP2ADgkHBhKAAAwYAAAZz///1ZFYwh//suGE7oA",
        "av1": "EgAKCgAAAAKv/41fMAgyGhAAugIIIEEBAAAItGZwzAUquVjPd3bb8FfH",
    }
)


def codec_faults() -> dict[str, str]:
    """Return why pictures can't be decoded, or encoded as H.264, by codec; "" where they can.

    The keys are those of ``CODECS`` and "h264 encoder".
    """
    faults = {}
    data, faults["h264 encoder"] = _encoded()
    for name in CODECS:
        data_of = data if name == "h264" else b64decode(_ENCODED[name])
        faults[name] = _decoding_fault(name, data_of) if data_of else "there is no picture to decode"
    return faults


def _picture() -> Image:
    """Draw a picture: its left half is black, its right half white."""
    image = np.zeros((_SIZE_PX, _SIZE_PX, 3), np.uint8)
    image[:, _SIZE_PX // 2 :] = 255
    return image


def _encoded() -> tuple[bytes, str]:
    """Return the picture as H.264, and why it can't be encoded."""
    from mcaptrack.sources.video.encode import H264Encoder

    try:
        return H264Encoder(_SIZE_PX, _SIZE_PX, Fraction(25)).encode(_picture(), 0), ""
    except Exception as error:  # whatever an incomplete FFmpeg raises
        return b"", in_one_line(error)


def _decoding_fault(name: str, data: bytes) -> str:
    """Return why a picture can't be decoded, or that it differs from the encoded one; "" otherwise."""
    from mcaptrack.sources.video.decode import EncodedPicture, decode_gray

    try:
        pictures = [frame.rows for frame in decode_gray([EncodedPicture(0, 0, name, data)])]
    except Exception as error:  # as above
        return in_one_line(error)
    wanted = _picture()[:, :, 0]
    if len(pictures) != 1 or pictures[0].shape != wanted.shape:
        return f"one picture became {len(pictures)}" if len(pictures) != 1 else "the picture has another size"
    error_mean = np.abs(pictures[0].astype(float) - wanted).mean()
    return "" if error_mean < _MAX_ERROR else f"the picture looks different (by {error_mean:.0f} of 255 on average)"
