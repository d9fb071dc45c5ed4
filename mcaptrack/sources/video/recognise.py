"""Recognise the pictures of a channel by their bytes: messages may call them otherwise, or nothing at all.

A still image says in its first bytes what it is. A video says it where it begins, with its parameter sets; what follows
is the same. NAL units with lengths before them, as in MP4 files, become NAL units with start codes (Annex B).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from mcaptrack.sources.video.codecs import CODECS, START_CODE, nal_starts, obus, vp9_size

#: The format of pictures that can't be read, whatever they are called: they are left out, and the cause is said.
UNREAD: Final = "unread"
#: The names of formats, for people.
WORDS: Final = {"h264": "H.264", "h265": "H.265", "vp9": "VP9", "av1": "AV1", "jpeg": "JPEG", "png": "PNG"} | {
    "webp": "WebP",
    "tiff": "TIFF",
    "bmp": "BMP",
    "avif": "AVIF",
}
_ALIASES: Final = {"jpg": "jpeg", "mjpeg": "jpeg", "mjpg": "jpeg", "tif": "tiff"}
#: The first bytes of still images, and where they stand.
_STILLS: Final = (
    (0, b"\xff\xd8\xff", "jpeg"),
    (0, b"\x89PNG\r\n\x1a\n", "png"),
    (8, b"WEBP", "webp"),
    (0, b"II*\0", "tiff"),
    (0, b"MM\0*", "tiff"),
    (4, b"ftypavif", "avif"),
    (4, b"ftypavis", "avif"),
    (4, b"ftypmif1", "avif"),
)
#: The sizes of the second header of a BMP image: its name alone is short.
_BMP_HEADS: Final = (12, 40, 52, 56, 64, 108, 124)
#: The first bytes of what is no picture, and where they stand.
_FILES: Final = (
    *((4, box, "pieces of an MP4 file") for box in (b"ftyp", b"styp", b"moof", b"moov", b"mdat", b"sidx")),
    (0, b"\x1aE\xdf\xa3", "pieces of a Matroska or WebM file"),
    (0, b"OggS", "pieces of an Ogg file"),
    (0, b"DKIF", "pieces of an IVF file"),
    (0, b"FLV\1", "pieces of a Flash file"),
    (8, b"AVI LIST", "pieces of an AVI file"),
    (0, b"\0\0\1\xba", "pieces of an MPEG program stream"),
    (0, b"\0\0\1\xb3", "MPEG-1 or MPEG-2 video"),
    (3, b"\x9d\x01\x2a", "VP8 video"),
)
_TRANSPORT_PACKET, _TRANSPORT_SYNC = 188, 0x47
#: Widths of the lengths before NAL units that are tried: the usual ones.
_LENGTHS: Final = (4, 2)
_SETS: Final = {"h264": "SPS, PPS", "h265": "VPS, SPS, PPS"}
#: Bytes before the arrays of parameter sets of H.265; those of H.264 have more, too. The bits of their number.
_LEAST_RECORD, _MOST_SETS = 23, 0x1F
_RECORDS: Final = {"h264": "avcC", "h265": "hvcC"}
_SHOWN: Final = 8


class Recognised(NamedTuple):
    """A format; ``length_bytes`` of the lengths before NAL units, 0 for start codes; parameter ``sets`` of a
    configuration record, which takes the first ``record_bytes`` of the data.
    """

    format: str
    length_bytes: int = 0
    sets: tuple[bytes, ...] = ()
    record_bytes: int = 0


class Recogniser:
    """Says what each picture of a channel is, and brings it to the form that decoders read.

    ``notes`` are facts to be said: names that are wrong, forms that are converted. ``cause`` is why no picture can be
    read, "" if one can or none was seen. ``is_settled``: what follows is like what was seen.
    """

    def __init__(self) -> None:
        self.notes: dict[str, None] = {}
        self.cause = ""
        self.is_settled = False
        self._stream: Recognised | None = None

    def take(self, called: str, data: bytes, is_video: bool) -> tuple[str, bytes]:
        """The format of a picture that a message calls ``called``, and its bytes; ``is_video``: messages say so."""
        if still := _still(data):
            self.cause, self.is_settled = "", True
            self._compare(called, still)
            return still, data
        if self._stream is None and (stream := _video(data)):
            self._stream, self.cause, self.is_settled = stream, "", True
            self._compare(called, stream.format)
            if stream.length_bytes:
                form = f"{WORDS[stream.format]} with lengths before its NAL units"
                self.notes[f"they are {form}, as in MP4 files; it is read as with start codes (Annex B)"] = None
        stream = self._stream
        if stream is not None:
            return stream.format, self._annex_b(stream, data) if stream.length_bytes else data
        self.cause = self.cause or _cause(called, data)
        is_named = called in CODECS
        return (UNREAD if _file(data) or (is_video and not is_named) else called), data

    def _compare(self, called: str, is_format: str) -> None:
        if _ALIASES.get(called, called) != is_format:
            said = f"are called {called[:40]!r}" if called else "have no format"
            self.notes[f"they {said} and are {WORDS[is_format]}"] = None

    def _annex_b(self, stream: Recognised, data: bytes) -> bytes:
        record = _record(data)
        sets, data = (record.sets, data[record.record_bytes :]) if record else ((), data)
        units = _with_lengths(data, stream.length_bytes)
        if units is None:
            return data  # it is cut off, or has start codes
        out = b"".join(START_CODE + unit for unit in (*sets, *units))
        codec = CODECS[stream.format]
        head = codec.read_head(out)
        if stream.sets and head.is_key and not head.has_parameter_sets:
            out = codec.with_parameter_sets(out, stream.sets)
        return out


def _still(data: bytes) -> str:
    """The format of a still image; "" for others."""
    if data[:2] == b"BM" and int.from_bytes(data[14:18], "little") in _BMP_HEADS:
        return "bmp"
    return next((name for at, magic, name in _STILLS if data.startswith(magic, at)), "")


def _file(data: bytes) -> str:
    """A name for data that hold no picture by themselves; "" for others."""
    if len(data) > _TRANSPORT_PACKET and data[0] == data[_TRANSPORT_PACKET] == _TRANSPORT_SYNC:
        return "packets of an MPEG transport stream"
    return next((name for at, magic, name in _FILES if data.startswith(magic, at)), "")


def _video(data: bytes) -> Recognised | None:
    """Recognise the beginning of a video; None for anything that isn't sure to be one."""
    if record := _record(data):
        return record
    starts = nal_starts(data) if data.startswith((START_CODE, START_CODE[1:])) else ()
    if name := _codec_of([data[at : at + 2] for at in starts if at < len(data)]):
        return Recognised(name)
    for length_bytes in _LENGTHS:
        units = _with_lengths(data, length_bytes)
        if units is not None and (name := _codec_of(units)):
            return Recognised(name, length_bytes)
    if vp9_size(data):
        return Recognised("vp9")
    units_of_av1 = list(obus(data))
    is_whole = bool(units_of_av1) and units_of_av1[0].kind in (1, 2) and units_of_av1[-1].end == len(data)
    return Recognised("av1") if is_whole and any(obu.kind == 1 for obu in units_of_av1) else None


def _codec_of(units: Sequence[bytes]) -> str:
    """The codec of NAL units with parameter sets, "" for others: no unit of H.265 looks like an SPS of H.264."""
    if any(unit[0] & 0x9F == 7 and unit[0] & 0x60 for unit in units):
        return "h264"
    return "h265" if any(unit[:2] in (b"\x40\x01", b"\x42\x01") for unit in units) else ""


def _with_lengths(data: bytes, length_bytes: int) -> list[bytes] | None:
    """The NAL units of data in which each has its length before it; None if lengths don't add up."""
    units, at = list[bytes](), 0
    while at < len(data):
        end = at + length_bytes + int.from_bytes(data[at : at + length_bytes], "big")
        if not at + length_bytes < end <= len(data):
            return None
        units.append(data[at + length_bytes : end])
        at = end
    return units


def _record(data: bytes) -> Recognised | None:
    """The configuration record of H.264 or H.265 at the beginning of data (ISO 14496-15, 5.3.3 and 8.3.3)."""
    if len(data) < _LEAST_RECORD or data[0] != 1:
        return None
    if data[4] & 0xFC == 0xFC and data[5] & 0xE0 == 0xE0:
        sets, end = _sets(data, 5, arrays=2, head_bytes=1)
        more = data[end : end + 4]  # of the high profiles: formats of colours, and no further sets
        if len(more) == 4 and more[0] & 0xFC == 0xFC and more[1] & 0xF8 == more[2] & 0xF8 == 0xF8:
            end += len(more)
        if _codec_of(sets) == "h264":
            return Recognised("h264", (data[4] & 3) + 1, sets, end)
    sets, end = _sets(data, _LEAST_RECORD, arrays=data[_LEAST_RECORD - 1], head_bytes=3)
    return Recognised("h265", (data[21] & 3) + 1, sets, end) if _codec_of(sets) == "h265" else None


def _sets(data: bytes, at: int, arrays: int, head_bytes: int) -> tuple[tuple[bytes, ...], int]:
    """The parameter sets in arrays with lengths of two bytes, and where they end; none if they don't fit."""
    sets = list[bytes]()
    for _ in range(arrays):
        count, at = data[at + head_bytes - 1 : at + head_bytes], at + head_bytes
        for _ in range(count[0] & _MOST_SETS if count else 0):
            end = at + 2 + int.from_bytes(data[at : at + 2], "big")
            if not at + 2 < end <= len(data):
                return (), at
            sets.append(data[at + 2 : end])
            at = end
    return tuple(sets), at


def _cause(called: str, data: bytes) -> str:
    """Why a picture can't be read, as far as its bytes and its name say; "" if one that follows may say more."""
    if name := _file(data):
        return f"they are {name}; `ingest` reads the whole file"
    if called in _SETS and not data.startswith((START_CODE, START_CODE[1:])):
        if any(_with_lengths(data, length_bytes) for length_bytes in _LENGTHS):
            return (
                f"they are {WORDS[called]} with lengths before its NAL units, and the parameter sets ({_SETS[called]}) "
                f"are missing, in the pictures as well as before them ({_RECORDS[called]})"
            )
        return f"they are called {WORDS[called]}, and begin with {data[:_SHOWN].hex(' ')}, as none of {_names()} does"
    if called not in CODECS:
        said = f"they are called {called[:40]!r}" if called else "they have no format"
        return f"{said}, and begin with {data[:_SHOWN].hex(' ')}, as none of {_names()} does"
    return ""


def _names() -> str:
    return ", ".join(WORDS.values())
