"""Pixel formats, one law for each line of the table: pictures that FFmpeg converted look as FFmpeg shows them."""

from __future__ import annotations

import re
from itertools import product

import av
import cv2
import numpy as np
import pytest

from mcaptrack.errors import McaptrackError
from mcaptrack.sources.video import PIXEL_FORMATS, PixelLayout, pixel_format
from mcaptrack.sources.video.pixels import raw_bgr, raw_gray, raw_with

#: FFmpeg's names of the formats; packed 4:4:4 and V before Y are written by hand below.
FFMPEG = {
    "gray": "mono8 y8 y800 grey gray gray8 l8 8uc1",
    "rgb24": "rgb8 rgb rgb24 rgb3 rgb888",
    "bgr24": "bgr8 bgr bgr24 bgr3 bgr888 8uc3",
    "rgba": "rgba8 rgba rgb0 rgbx",
    "bgra": "bgra8 bgra bgr0 bgrx 8uc4",
    "gray16le": "mono16 y16 gray16le 16uc1",
    "rgb48le": "rgb16 rgb48le",
    "bgr48le": "bgr16 bgr48le 16uc3",
    "rgba64le": "rgba16 rgba64le",
    "bgra64le": "bgra16 bgra64le 16uc4",
    "uyvy422": "yuv422 uyvy uyvy422 y422",
    "yuyv422": "yuv422_yuy2 yuyv yuyv422 yuy2",
    "yvyu422": "yvyu yvyu422",
    "nv12": "nv12",
    "nv21": "nv21",
    "nv16": "nv16",
    "nv24": "nv24",
    "nv42": "nv42",
    "yuv420p": "i420 iyuv yu12 yuv420 yuv420p",
    "yuv422p": "i422 yuv422p 422p",
    "yuv444p": "i444 yuv444 yuv444p 444p",
    # Planes or bytes in another order than FFmpeg has: what they are made of.
    "nv16 swapped": "nv61",
    "yuv420p swapped": "yv12 yvu420",
    "yuyv422 swapped": "vyuy",
    "yuv444p packed": "yuv24 yuv3 yuv444_packed",
}
NAMES = {name: made for made, names in FFMPEG.items() for name in names.split()}
#: The colours of a mosaic's first two rows, by what the names of ROS, GenICam, V4L2 and fourcc say.
TILES = {"rggb": "bayerrg rggb", "bggr": "bayerbg ba81", "gbrg": "bayergb gbrg", "grbg": "bayergr grbg"}
SIZES = [(64, 48), (63, 47)]


def pattern(width: int, height: int) -> np.ndarray:
    """Patches of strong colours that are larger than any that share a sample, over a ramp; BGR."""
    rng = np.random.default_rng(5)
    patches = rng.integers(0, 256, (height // 12 + 1, width // 12 + 1, 3)).astype(np.uint8)
    return np.ascontiguousarray(np.kron(patches, np.ones((12, 12, 1), np.uint8))[:height, :width])


def planes(frame: av.VideoFrame) -> list[np.ndarray]:
    out = []
    for number, plane in enumerate(frame.planes):
        rows = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: plane.height]
        bits = {"nv12": 8, "nv21": 8, "nv16": 8, "nv24": 8, "nv42": 8}.get(frame.format.name)
        size = 2 if bits and number else 1 if frame.format.is_planar else frame.format.bits_per_pixel // 8
        width = plane.width
        if frame.format.name in ("yuyv422", "uyvy422", "yvyu422"):
            width += width % 2
        out.append(rows[:, : width * size].copy())
    return out


def written(made: str, frame: av.VideoFrame) -> list[np.ndarray]:
    """The planes of a format that FFmpeg doesn't have, of those that it has."""
    rows = planes(frame)
    if made.endswith("packed"):
        return [np.stack(rows, axis=-1).reshape(frame.height, -1)]
    if made == "nv16 swapped":
        return [rows[0], rows[1].reshape(frame.height, -1, 2)[..., ::-1].reshape(frame.height, -1)]
    if made == "yuyv422 swapped":
        return [rows[0].reshape(frame.height, -1, 4)[..., ::-1].reshape(frame.height, -1)]
    return [rows[0], rows[2], rows[1]] if made.endswith("swapped") else rows


def padded(rows: list[np.ndarray], step: int, luma: int) -> bytes:
    """Planes with the distance of rows that a message states: planes of fewer bytes have as much less."""
    out = []
    for plane in rows:
        halves = round(2 * plane.shape[1] / luma)  # of the bytes of a row of luma
        wide = np.full((len(plane), max(plane.shape[1], -(-step * halves // 2))), 77, np.uint8)
        wide[:, : plane.shape[1]] = plane
        out.append(wide.tobytes())
    return b"".join(out)


def test_every_name_has_an_oracle():
    mosaics = {name for name, form in PIXEL_FORMATS.items() if form.tile}
    others = {name for name in PIXEL_FORMATS if re.fullmatch(r"(8s|16s|32s|64f)c\d|32fc\d|(mono|y)1[024]", name)}
    assert {*NAMES} == {*PIXEL_FORMATS} - mosaics - others


@pytest.mark.parametrize("name", NAMES)
def test_pictures_look_as_ffmpeg_shows_them(name):
    for size, padding in product(SIZES, (0, 8)):
        made, (width, height) = NAMES[name], size
        image = pattern(width, height)
        frame = av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format=made.split()[0])
        shown = frame.reformat(format="bgr24").to_ndarray().astype(int)
        rows = written(made, frame)
        luma = rows[0].shape[1]
        step = luma + padding if padding else 0
        data, layout = padded(rows, step, luma), PixelLayout(width, height, step)
        found = raw_bgr(name, data, layout).astype(int)
        assert found.shape == (height, width, 3)
        grey = raw_gray(name, data, layout).astype(int)
        # FFmpeg mixes colours of neighbours; within a patch there is one colour.
        inner = np.zeros((height, width), bool)
        for y in range(0, height - 11, 12):
            for x in range(0, width - 11, 12):
                inner[y + 3 : y + 9, x + 3 : x + 9] = True
        assert np.abs(found - shown)[inner].max() <= 2
        assert np.abs(grey - cv2.cvtColor(shown.astype(np.uint8), cv2.COLOR_BGR2GRAY).astype(int))[inner].max() <= 4


@pytest.mark.parametrize("tile", TILES)
def test_mosaics_have_the_colours_that_their_names_say(tile):
    value = {"r": 200, "g": 120, "b": 40}
    mosaic = np.tile(np.array([value[letter] for letter in tile], np.uint8).reshape(2, 2), (6, 8))
    prefix, fourcc = TILES[tile].split()
    for name in (f"bayer_{tile}8", f"{prefix}8", f"s{tile}8", fourcc):
        found = raw_bgr(name, mosaic.tobytes(), PixelLayout(16, 12))
        assert (found == (40, 120, 200)).all(), name
    for depth in (10, 12, 14, 16):
        wide = (mosaic.astype("<u2") * (2**depth // 256)).tobytes()
        for name in (f"bayer_{tile}{depth}", f"{prefix}{depth}", f"s{tile}{depth}"):
            found = raw_bgr(name, wide, PixelLayout(16, 12), (0.0, 255 * (2**depth // 256)))
            assert (found == (40, 120, 200)).all(), name


@pytest.mark.parametrize("name", [name for name, form in PIXEL_FORMATS.items() if form.is_wide])
def test_samples_of_more_than_8_bits_are_scaled_by_the_values_of_black_and_white(name):
    for is_bigendian in (False, True):
        form = PIXEL_FORMATS[name]
        low, high = (
            (-20.0, 107.0) if form.sample == "i1" else (-300.0, 700.0) if form.sample[0] == "i" else (100.0, 1120.0)
        )
        kind = np.dtype(form.sample).newbyteorder(">" if is_bigendian else "<")
        levels = np.linspace(low - 50 if form.sample != "i1" else low, high + 20, 12 * 16)
        values = np.repeat(levels.reshape(12, 16, 1), len(form.planes[0]), axis=2).astype(kind)
        layout = PixelLayout(16, 12, 0, is_bigendian)
        wanted = np.clip((values[..., 0].astype(float) - low) * 255 / (high - low), 0, 255)
        found = raw_bgr(name, values.tobytes(), layout, (low, high)).astype(float)
        at = np.s_[:] if not form.tile else np.s_[2:-2, 2:-2]  # mosaics are mixed from their neighbours
        assert np.abs(found.mean(axis=-1) - wanted)[at].max() <= (0.51 if not form.tile else 20)


@pytest.mark.parametrize("name", {form: name for name, form in PIXEL_FORMATS.items()}.values())
def test_what_is_written_into_a_picture_is_read_from_it_and_all_other_bytes_stay(name):
    for size, padding in product(SIZES, (0, 8)):
        (width, height), form = size, PIXEL_FORMATS[name]
        samples = np.dtype(form.sample).itemsize * len(form.planes[0]) // max(map(form.planes[0].count, form.planes[0]))
        step = (width + width % 2) * samples + padding
        rng = np.random.default_rng(1)
        data = rng.integers(30, 220, 6 * step * height).astype(np.uint8).tobytes()
        span = (0.0, 1000.0) if form.is_wide else None
        if form.is_wide:
            data = (
                rng.integers(0, 120, 6 * step * height // np.dtype(form.sample).itemsize).astype(form.sample).tobytes()
            )
            span = (0.0, 120.0)
        layout = PixelLayout(width, height, step)
        mask = np.zeros((height, width), bool)
        mask[8:24, 10:30] = True
        colour = np.full((height, width, 3), (180, 90, 60), np.uint8)
        out = raw_with(name, data, layout, colour, mask, span)
        assert len(out) == len(data)
        before, after = (raw_bgr(name, part, layout, span).astype(int) for part in (data, out))
        is_grey = form.planes[0] == "y" and not form.is_yuv
        wanted = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY)[0, 0] if is_grey else (180, 90, 60)
        # A byte has steps of 1/120 of the range here.
        assert np.abs(after[10:22, 12:28] - wanted).max() <= (3 if form.is_wide else 2)
        outside = np.ones_like(mask)
        outside[6:26, 8:32] = False
        assert (after[outside] == before[outside]).all()
        changed = np.frombuffer(out, np.uint8) != np.frombuffer(data, np.uint8)
        assert 0 < changed.sum() <= 4 * 24 * 20 * np.dtype(form.sample).itemsize
        assert raw_with(name, data, layout, colour, np.zeros_like(mask), span) == data


def test_three_planes_or_one_of_yuv444_by_the_bytes_of_a_row():
    assert pixel_format("yuv444", PixelLayout(64, 48, 64)).planes == ("y", "u", "v")
    assert pixel_format("YUV444", PixelLayout(64, 48, 192)).planes == ("yuv",)


@pytest.mark.parametrize("step", [128, 96])
def test_a_distance_of_rows_that_contradicts_the_data_is_not_taken_where_planes_have_several(step):
    image = pattern(64, 48)
    rows = planes(av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format="nv21"))
    data = b"".join(plane.tobytes() for plane in rows)  # cv_bridge states two bytes a pixel
    np.testing.assert_array_equal(
        raw_bgr("nv21", data, PixelLayout(64, 48, step)), raw_bgr("nv21", data, PixelLayout(64, 48, 64))
    )


@pytest.mark.parametrize("name", ["", "mono12p", "bayer_rggb12p", "8UC2", "nv99"])
def test_formats_that_are_not_read_are_named_with_those_that_are(name):
    with pytest.raises(McaptrackError, match=r"encoding '.*' are not read; mono8, .*, bayer_rggb8 and \d+ others are"):
        raw_bgr(name, bytes(1000), PixelLayout(8, 8))
