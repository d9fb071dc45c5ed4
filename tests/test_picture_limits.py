"""Pictures: how large they may be, which number each has, and what is lost of them and what isn't."""

from __future__ import annotations

import json
import os
import re
import socket
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Mapping
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.files import refuse_special
from mcaptrack.notices import collected
from mcaptrack.schema import TRACKS
from mcaptrack.sources.foreign import PICTURES_READ, is_compressed
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.sources.video import EncodedPicture, PixelLayout, VideoOptions, decode_bgr, decode_gray, open_video
from mcaptrack.sources.video.codecs import CODECS
from mcaptrack.sources.video.image_folder import find_images
from mcaptrack.sources.video.limits import ENVIRONMENT, still_size
from tests.commands import call, start
from tests.extension_cases import needs
from tests.logs import provenance_of, recorder
from tests.ros_messages import pixels, ros_writer
from tests.tiers import one_in, thorough
from tests.worlds import ids, ns, small_scene, upright, write_clip

SUFFIXES = ("png", "jpg", "bmp", "webp", "tif", "avif")


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("shape", [(31, 17, 3), (48, 64), (5, 300, 4), (1, 1, 3)])
def test_the_size_of_a_still_is_that_of_its_pixels(suffix, shape):
    image = np.random.default_rng(1).integers(0, 255, shape, np.uint8)
    for options in ([], [cv2.IMWRITE_WEBP_QUALITY, 40], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]):
        ok, data = cv2.imencode(f".{suffix}", image, options)
        assert ok
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert still_size(data.tobytes())[:2] == (decoded.shape[1], decoded.shape[0]) == (shape[1], shape[0])


def test_pixels_of_many_bytes_are_counted():
    _, data = cv2.imencode(".tif", np.zeros((4, 6, 3), np.uint16))
    assert still_size(data.tobytes()) == (6, 4, 6)


HEADS = [
    b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0", b"BM", b"RIFF0000WEBPVP8 ", b"II*\0\x08\0\0\0", b"0000ftypavif", b"",
]  # fmt: skip


@given(st.sampled_from(HEADS), st.binary(max_size=60))
def test_bytes_of_strangers_have_a_size_or_none(head, rest):
    size = still_size(head + rest)
    assert size is None or min(size) >= 0


def png(width: int, height: int) -> bytes:
    """A black picture of one bit a pixel, written by hand: a few bytes, however large it is."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    pack = zlib.compressobj(9)
    rows = b"".join(pack.compress(bytes(1 + (width + 7) // 8)) for _ in range(height)) + pack.flush()
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="what a process needed stands there")
def test_a_picture_that_says_that_it_is_huge_costs_nothing(tmp_path):
    (tmp_path / "images").mkdir()
    bomb = png(16_000, 16_000)
    (tmp_path / "images" / "0.png").write_bytes(bomb)
    assert len(bomb) < 100_000
    code = (
        "import sys\n"
        "from mcaptrack.cli import app\n"
        "try: app(sys.argv[1:])\n"
        "except SystemExit as end: print(end.code, *(line for line in open('/proc/self/status') if 'VmHWM' in line))\n"
    )
    words = ["ingest", "images", "--fps", "1"]
    done = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stderr == (
        "mcaptrack: images/0.png has 16000 x 16000 pixels; at most 100 megapixels are read "
        f"({ENVIRONMENT} sets another limit)\n"
    )
    exit_code, _, kibibytes, _ = done.stdout.split()
    assert exit_code == "1"
    assert int(kibibytes) < 200 * 1024
    with pytest.raises(McaptrackError, match="16000 x 16000 pixels; at most 100 megapixels"):
        list(decode_gray([EncodedPicture(0, 7, "png", bomb)]))


SIZE = (1100, 1000)
CODEC_OF = {"h264": "libx264", "h265": "libx265", "vp9": "libvpx-vp9", "av1": "libsvtav1"}


def encoded(codec: str) -> bytes:
    context = av.CodecContext.create(codec, "w")
    context.width, context.height = SIZE
    context.pix_fmt, context.time_base, context.framerate = "yuv420p", Fraction(1, 10), 10
    options = {"libx265": {"x265-params": "log-level=none:pools=1"}, "libx264": {"tune": "zerolatency"}}
    context.options = options.get(codec, {}) | {"g": "1"}
    frame = av.VideoFrame.from_ndarray(np.full((SIZE[1], SIZE[0], 3), 50, np.uint8), format="bgr24")
    return bytes(next(iter([*context.encode(frame), *context.encode(None)])))


def stills() -> dict[str, bytes]:
    image = np.full((SIZE[1], SIZE[0]), 50, np.uint8)
    return {suffix: cv2.imencode(f".{suffix}", image)[1].tobytes() for suffix in SUFFIXES}


@pytest.mark.parametrize("pixels", [decode_gray, decode_bgr])
@pytest.mark.parametrize("name", [*CODECS, *SUFFIXES, "raw"])
def test_pictures_of_messages_are_bounded(monkeypatch, name, pixels):
    if name == "raw":
        picture = EncodedPicture(0, 0, "mono8", bytes(SIZE[0] * SIZE[1]), PixelLayout(*SIZE))
    else:
        picture = EncodedPicture(0, 0, name, encoded(CODEC_OF[name]) if name in CODECS else stills()[name])
    monkeypatch.setenv(ENVIRONMENT, "2")
    assert [frame.rows.shape[:2] for frame in pixels([picture])] == [SIZE[::-1]]
    monkeypatch.setenv(ENVIRONMENT, "1")
    with pytest.raises(McaptrackError, match=r"^frame 0[^\n]*at most 1 megapixels are read \(MCAPTRACK_MAX_MEGAPIXELS"):
        list(pixels([picture]))


def test_every_kind_of_message_with_pictures_is_among_them():
    """Compressed ones hold stills or a video, the others pixels: see above."""
    assert {is_compressed(name) for name in PICTURES_READ} == {True, False}


@pytest.mark.parametrize("name", ["a.mp4", "a.avi", "a.mkv", "a.webm", "folder"])
def test_pictures_of_files_are_bounded(tmp_path, monkeypatch, name):
    path = tmp_path / name
    if name == "folder":
        path.mkdir()
        (path / "1.png").write_bytes(stills()["png"])
    else:
        codec = {"a.avi": "mpeg4", "a.webm": "libvpx-vp9"}.get(name, "libx264")
        write_clip(path, frames=2, size=SIZE, codec=codec)
    options = IngestOptions(fps=Fraction(10))
    monkeypatch.setenv(ENVIRONMENT, "1")
    with pytest.raises(McaptrackError, match=r"at most 1 megapixels are read \(MCAPTRACK_MAX_MEGAPIXELS"):
        ingest(path, tmp_path / "a.mcap", options)
    monkeypatch.setenv(ENVIRONMENT, "2")
    assert ingest(path, tmp_path / "a.mcap", options).lost == []


def test_videos_that_are_too_large_for_h264_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("mcaptrack.sources.video.limits._H264_PIXELS", 3_000)
    write_clip(tmp_path / "a.avi", frames=2, codec="mpeg4")
    with pytest.raises(
        McaptrackError, match=r"a\.avi has pictures of 64 x 48 pixels, and those of H\.264 have at most"
    ):
        ingest(tmp_path / "a.avi", tmp_path / "a.mcap", IngestOptions())


@pytest.mark.parametrize("given", ["x", "0", "-1", "1e3", "9" * 20])
def test_a_limit_that_is_no_number_is_refused(monkeypatch, given):
    monkeypatch.setenv(ENVIRONMENT, given)
    with pytest.raises(McaptrackError, match=f"{ENVIRONMENT} needs a whole number"):
        list(decode_gray([EncodedPicture(0, 0, "png", png(8, 8))]))


# What is no file


def special(path: Path, kind: str) -> Path:
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(str(path))
    else:
        path.symlink_to("/dev/zero")
    return path


@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
def test_pipes_devices_and_sockets_are_no_files(tmp_path, monkeypatch, kind):
    monkeypatch.chdir(tmp_path)  # names of sockets are short
    with pytest.raises(McaptrackError, match=f"x is a {kind}, not a file"):
        refuse_special(special(Path("x"), kind))
    refuse_special(Path("none"))
    refuse_special(tmp_path)
    Path("link").symlink_to(__file__)
    refuse_special(Path("link"))


# Which number a picture has


def images(folder: Path, *names: str) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.full((48, 64, 3), 50, np.uint8))
    return folder


NUMBERED = {
    "without a gap": (["8.png", "9.png", "10.png"], [0, 1, 2], ""),
    "with a gap": ([f"{n:04}.jpg" for n in (3, 4, 6, 8)], [0, 1, 3, 5], r"2 of 6 numbered images (5, 7) are missing"),
    "with many": (["a1.png", "a3.png", "a4.png", "a8.png"], [0, 2, 3, 7], "4 of 8 numbered images (2, 5, 6, ...)"),
    "every twelfth": (["0.png", "12.png", "24.png", "48.png"], [0, 1, 2, 4], "1 of 5 numbered images (36)"),
    "times rather than counts": (["1.png", "90.png", "91.png"], [0, 1, 2], ""),
    "without numbers": (["a.png", "b.png"], [0, 1], ""),
    "of two series": (["a1.png", "a3.png", "b4.png"], [0, 1, 2], ""),
    "of two kinds": (["1.PNG", "3.jpg", "4.png"], [0, 2, 3], "1 of 4 numbered images (2) are missing"),
    "of one series after another": (["cam1_1.png", "cam1_2.png", "cam2_3.png", "cam2_4.png"], [0, 1, 2, 3], ""),
    "with a number of the camera": (
        ["cam1_1.png", "cam1_2.png", "cam1_4.png"],
        [0, 1, 3],
        "1 of 4 numbered images (3)",
    ),
    "numbered as cameras": ([f"cam{n}.png" for n in (8, 9, 11)], [0, 1, 3], "1 of 4 numbered images (10) are missing"),
    "times of day": ([f"12-0{n // 2}-{30 * (n % 2):02}.png" for n in range(4)], [0, 1, 2, 3], ""),
}


@pytest.mark.parametrize(("names", "places", "words"), NUMBERED.values(), ids=NUMBERED)
def test_images_that_are_missing_leave_their_time_empty(tmp_path, names, places, words):
    found = images(tmp_path / "images", *names)
    report = ingest(found, tmp_path / "a.mcap", IngestOptions(fps=Fraction(10)))
    with log.read(tmp_path / "a.mcap") as opened:
        there = [(message.t_ns, message.sequence) for message in opened.messages("/camera/video")]
    assert there == [(ns(place / 10), place) for place in places]
    assert [words in notice.message for notice in report.warnings] == ([True] if words else [])
    assert report.lost == []
    are_counted = places != list(range(len(places))) or names[0] == "8.png"
    assert any("don't count pictures; they follow one another" in text for text in report.remarks) != are_counted


SERIES = {
    "by number": [f"cam{c}_{n:06}.jpg" for c in (0, 1) for n in range(4)],
    "by number at the end": [f"{n:06}_c{c}.jpg" for c in (1, 2, 3) for n in range(4)],
    "by name": [f"{side}{n}.png" for side in ("left", "right") for n in range(4)],
    "at other times": [f"camera-{c}_16239430{n}{c}.jpg" for c in (0, 1) for n in range(4)],
    "masks": [f"{n}{end}.png" for end in ("", "_mask") for n in range(4)],
    "upper and lower case": [f"{name}_{n}.jpg" for name in ("CAM1", "cam2") for n in range(4)],
}


@pytest.mark.parametrize("names", SERIES.values(), ids=SERIES)
def test_images_of_several_cameras_are_no_video(tmp_path, names):
    with pytest.raises(McaptrackError, match=r"series of images of the same numbers, such as .* a folder of its own"):
        find_images(images(tmp_path / "images", *names))


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes on Linux")
def test_names_of_images_need_not_be_text(tmp_path):
    folder = images(tmp_path / "images", "1.png", "2.png")
    folder = folder.rename(tmp_path / "\udcff")
    (folder / "1.png").rename(folder / "1\udcff.png")
    (folder / "2.png").rename(folder / "2\udcff.png")
    assert len(upright(folder, fps=Fraction(10))) == 2


def test_two_images_of_one_number_are_refused(tmp_path):
    with pytest.raises(McaptrackError, match=r"holds two images of one number, 1\.jpg and 1\.png; keep one"):
        find_images(images(tmp_path / "images", "0.png", "1.png", "1.jpg"))


def test_what_is_no_picture_in_a_folder_is_passed_over_and_said(tmp_path):
    folder = images(tmp_path / "images", "1.png", "2.JPG", "3.png")
    for name in ("._1.png", "._2.JPG", ".DS_Store", "Thumbs.db", "desktop.ini"):
        (folder / name).write_bytes(b"\0\5\x16\7")
    with collected() as warnings:
        chosen = find_images(folder)
        assert [path.name for path in chosen.paths] == ["1.png", "2.JPG", "3.png"]
        assert chosen.notes == (f"{folder}: 2 hidden files are passed over (._1.png, ._2.JPG)",)
        assert list(warnings) == []
        (folder / "4.heic").write_bytes(b"x")
        find_images(folder)
    (warning,) = warnings
    assert warning == (f"{folder}: 1 images of kinds that are not read are left out (4.heic)", "left-out", None)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("cam0/1.png", "; its folders do: give one, such as cam0"),
        ("1.heic", "; convert those it holds, such as 1.heic"),
        ("1.tga", "; convert those it holds, such as 1.tga"),
        ("walk.mp4", "; give files it holds by name, such as walk.mp4"),
    ],
)
def test_a_folder_without_images_says_what_it_has(tmp_path, name, hint):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(McaptrackError, match=f"holds no images .*{hint}"):
        find_images(tmp_path)


@pytest.mark.parametrize(("kind", "end", "most"), [(np.uint16, ".png", 3000), (np.float32, ".tif", 0.5)])
def test_images_of_more_than_8_bits_are_shown_by_the_range_measured_in_their_folder(tmp_path, kind, end, most):
    """Of 12 bits in 16, and of floats: the darkest is black, the brightest white, in all pictures alike."""
    shares = np.linspace(0.2, 1, 64)[None].repeat(48, axis=0)
    for number, gain in enumerate((1, 0.5)):
        cv2.imwrite(str(tmp_path / f"{number}{end}"), cv2.merge([(shares * most * gain).astype(kind)] * 3))
    video = open_video(tmp_path, VideoOptions(fps=Fraction(10)))
    low, high = 0.1 * most, most
    for gain, image in zip((1, 0.5), upright(tmp_path, fps=Fraction(10)), strict=True):
        wanted = (shares * most * gain - low) * 255 / (high - low)
        assert np.abs(image[..., 0] - wanted).max() < 2
    assert video.notes == [
        f"{tmp_path}: values from {low:g} to {high:g}, as measured in it, are shown as black to white"
    ]


def test_a_first_image_that_is_broken_is_left_out_as_another_would_be(tmp_path):
    folder = images(tmp_path / "images", "1.png", "2.png", "3.png")
    (folder / "1.png").write_bytes(b"no image")
    report = ingest(folder, tmp_path / "a.mcap", IngestOptions(fps=Fraction(10)))
    assert report.messages == {"/camera/video": 2}
    assert report.lost == [f"{folder}/1.png can't be read as an image; it is left out"]


def labelled(path: Path, *frames: int) -> Path:
    path.write_text("".join(f"{n},{n + 1},1,1,2,2\n" for n in frames))
    return path


def tracks(path: Path) -> dict[int, list[int]]:
    with log.read(path) as opened:
        return {f.t_ns: ids(f) for f in opened.frames("/camera/truth", TRACKS)}


@pytest.mark.parametrize("how", ["beside", "into"])
def test_labels_of_images_that_are_missing_or_damaged_are_lost_and_the_others_stay(tmp_path, how):
    """Image 3 is not there, image 5 is no image: the labels of 4 and 6 are those of 4 and 6."""
    found, out = images(tmp_path / "images", "1.png", "2.png", "4.png", "5.png", "6.png"), tmp_path / "a.mcap"
    (found / "5.png").write_bytes(b"no image")
    truth = labelled(tmp_path / "gt.txt", 1, 2, 3, 4, 5, 6)
    if how == "beside":
        report = ingest(found, out, IngestOptions(fps=Fraction(10), labels={"truth": truth}))
        assert "5.png can't be read as an image" in report.lost[0]
    else:
        ingest(found, out, IngestOptions(fps=Fraction(10)))
        with log.read(out) as opened:
            report = ingest(truth, out, IngestOptions(role="truth"), into=opened)
    assert report.lost[-1] == f"{truth}: 2 labels are of frames with missing pictures"
    assert tracks(out) == {0: [2], ns(0.1): [3], ns(0.3): [5], ns(0.5): [7]}


@pytest.mark.parametrize("how", ["beside", "into"])
def test_labels_may_count_as_the_names_of_images_do(tmp_path, how):
    found, out = images(tmp_path / "images", *(f"{12 * n}.png" for n in range(5))), tmp_path / "a.mcap"
    truth = tmp_path / "gt.txt"
    truth.write_text("".join(f"{n} {n + 1} 1.0 2.0\n" for n in (0, 12, 36)))
    if how == "beside":
        report = ingest(found, out, IngestOptions(fps=Fraction(10), labels={"truth": truth}))
    else:
        ingest(found, out, IngestOptions(fps=Fraction(10)))
        with log.read(out) as opened:
            report = ingest(truth, out, IngestOptions(role="truth"), into=opened)
    assert tracks(out) == {0: [1], ns(0.1): [13], ns(0.2): [], ns(0.3): [37]}
    assert any("counts frames as the names of the pictures of" in warning.message for warning in report.warnings)
    by_place = labelled(tmp_path / "gt2.txt", 1, 2, 4)
    ingest(found, out, IngestOptions(fps=Fraction(10), labels={"truth": by_place}))
    assert {t: who for t, who in tracks(out).items() if who} == {0: [2], ns(0.1): [3], ns(0.3): [5]}


def test_a_picture_that_can_not_be_decoded_keeps_its_number_and_its_time(tmp_path):
    """Motion JPEG, every picture alone: number 4 is overwritten."""
    path = tmp_path / "a.avi"
    write_clip(path, frames=8, codec="mjpeg", pixels="yuvj420p")
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    path.write_bytes(path.read_bytes().replace(packets[4], bytes(len(packets[4]))))
    for keep, options in (({}, {}), ({"fps": Fraction(10)}, {"fps": Fraction(10)})):
        video = open_video(path, VideoOptions(**keep))
        there = [(picture.index, picture.t_ns) for picture in video.pictures()]
        assert there == [(n, ns(n / 10)) for n in range(8) if n != 4]
        assert len(video.lost) == 1
        truth = labelled(tmp_path / "gt.txt", *range(1, 9))
        report = ingest(path, tmp_path / "a.mcap", IngestOptions(labels={"truth": truth}, **options))
        assert tracks(tmp_path / "a.mcap") == {ns(n / 10): [n + 2] for n in range(8) if n != 4}
        assert report.lost[-1] == f"{truth}: 1 labels are of frames with missing pictures"


# What is lost, and what is only empty


def ivf(path: Path, packets: list[bytes]) -> None:
    head = struct.pack("<4sHH4sHHIIII", b"DKIF", 0, 32, b"VP90", 64, 48, 10, 1, len(packets), 0)
    path.write_bytes(head + b"".join(struct.pack("<IQ", len(data), n) + data for n, data in enumerate(packets)))


def every_second(path: Path) -> int:
    """A clip in which every second place for a picture is empty, the last too; returns how many pictures it has."""
    count = 12
    write_clip(path.with_suffix(".webm"), frames=count, codec="libvpx-vp9", options={"g": "10"})
    with av.open(str(path.with_suffix(".webm"))) as container:
        vp9 = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    if path.suffix == ".ivf":
        ivf(path, [data for packet in vp9 for data in (packet, b"")])
    elif path.suffix == ".avi":
        with av.open(str(path), "w") as container:
            stream = container.add_stream("mpeg4", rate=10)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
            for n in [*range(count), None]:
                frame = None
                if n is not None:
                    frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 10 * n, np.uint8), format="bgr24")
                    frame.pts, frame.time_base = 2 * n, Fraction(1, 10)
                for packet in stream.encode(frame):
                    container.mux(packet)
        raw = bytearray(path.read_bytes())  # one place more at the end: in the header, in the list, and in its length
        at = raw.index(b"idx1")
        length = raw.index(b"LIST", raw.index(b"movi") - 8) + 4
        raw[at:at] = b"00dc\0\0\0\0"
        for where in (4, length):
            raw[where : where + 4] = struct.pack("<I", struct.unpack_from("<I", raw, where)[0] + 8)
        frames = raw.index(b"strh") + 8 + 32
        for where in (frames, raw.index(b"avih") + 8 + 16):
            raw[where : where + 4] = struct.pack("<I", 2 * count)
        path.write_bytes(raw)
    else:  # the list of an MP4 says that the last pictures have no bytes
        write_clip(path, frames=2 * count, options={"bf": "0", "g": "4"})
        raw = bytearray(path.read_bytes())
        sizes = raw.index(b"stsz") + 16
        raw[sizes + 4 * count : sizes + 8 * count] = bytes(4 * count)
        path.write_bytes(raw)
    return count


@pytest.mark.parametrize("keep", one_in(2, [{}, {"image_format": "jpeg"}]), ids=["auto", "jpeg"])
@pytest.mark.parametrize("suffix", one_in(3, [".mp4", ".avi", ".ivf"]))
def test_places_that_are_empty_are_no_loss(tmp_path, suffix, keep):
    path = tmp_path / f"a{suffix}"
    count = every_second(path)
    with av.open(str(path)) as container:
        assert container.streams.video[0].frames == 2 * count
    video = open_video(path, VideoOptions(**keep))
    made = list(video.pictures())
    assert (len(made), video.lost) == (count, [])
    assert [picture.index for picture in made] == list(range(count))
    process = start("ingest", path, "-o", tmp_path / "a.mcap")
    assert (process.communicate(timeout=600)[1].count("lost"), process.returncode) == (0, 0)


@pytest.mark.parametrize("suffix", [".avi", ".ivf"])
def test_places_that_were_cut_off_are_lost(tmp_path, suffix):
    """Of the second half of the file, the list of an AVI too, nothing is there."""
    path = tmp_path / f"a{suffix}"
    count = every_second(path)
    raw = path.read_bytes()
    end = raw.index(b"idx1") if suffix == ".avi" else len(raw)
    first = raw.index(b"movi") if suffix == ".avi" else 32
    path.write_bytes(raw[: (first + end) // 2])
    video = open_video(path)
    read = len(list(video.pictures()))
    assert 0 < read < count
    assert any(f"claims {2 * count} frames; {read} could be read" in words for words in video.lost), video.lost


# Pictures of more than 8 bits, mosaics and depths: people are found as in usual pictures, or not looked for


TOPIC = "/cam/image_raw"
Draw = Callable[[np.ndarray], np.ndarray]


def grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def wide(image: np.ndarray) -> np.ndarray:
    return grey(image).astype("<u2")


def mosaic(image: np.ndarray) -> np.ndarray:
    """What a sensor with the pattern RGGB sees."""
    out = np.empty(image.shape[:2], np.uint8)
    for number, letter in enumerate("rggb"):
        part = np.s_[number // 2 :: 2, number % 2 :: 2]
        out[part] = image[(*part, "bgr".index(letter))]
    return out


def with_dead_pixels(values: np.ndarray) -> np.ndarray:
    """Every 997th pixel is always as bright as can be."""
    out = values.copy()
    out.reshape(-1)[::997] = 16383
    return out


class Channel:
    """A channel of pictures in a recording of ROS 2: ``encoding`` of raw pictures, or the format of compressed ones."""

    def __init__(self, draw: Draw, encoding: str, suffix: str = "", frame_id: str = "eye", head: bytes = b"") -> None:
        self.draw, self.encoding, self.suffix, self.frame_id, self.head = draw, encoding, suffix, frame_id, head

    def message(self, image: np.ndarray, t_ns: int):
        values = np.ascontiguousarray(self.draw(image))
        name = "sensor_msgs/CompressedImage" if self.suffix else "sensor_msgs/Image"
        ros = ros_writer(name)
        header = ros.header(t_ns)
        header.frame_id = self.frame_id
        if self.suffix in ("zlib", "zstd"):
            pack = zlib.compress if self.suffix == "zlib" else zstandard.ZstdCompressor().compress
            (height, width), encoding = values.shape[:2], self.encoding.encode()
            head = struct.pack("<IIBII", height, width, 0, values.strides[0], len(encoding)) + encoding
            values_in = (header, "zstd", pixels(head + pack(values.tobytes())))
        elif self.suffix:
            data = self.head + cv2.imencode(self.suffix, values)[1].tobytes()
            values_in = (header, self.encoding, pixels(data))
        else:
            size = (*values.shape[:2], self.encoding, 0, values.strides[0])
            values_in = (header, *size, pixels(values.tobytes()))
        return ros.kind, ros.pack(ros.new(name, *values_in))


def written(path: Path, channels: Mapping[str, Channel], seconds: float = 4.0) -> Path:
    ids: dict[str, int] = {}
    with recorder(path) as writer:
        for number, shot in enumerate(small_scene(seconds).shots()):
            for topic, channel in channels.items():
                t_ns = 10**18 + number * 10**8
                kind, content = channel.message(shot.image, t_ns)
                if topic not in ids:
                    ids[topic] = writer.add_channel(topic, (kind.name, "ros2msg", kind.schema), "cdr")
                writer.add_message(ids[topic], t_ns, content, t_ns)
    return path


USUAL = Channel(lambda image: image, "bgr8")
SAME = {
    "all 16 bits": (Channel(lambda image: wide(image) * 257, "mono16"), "4.36"),
    "12 of 16 bits": (Channel(lambda image: wide(image) * 16, "mono16"), "27"),
    "thermal of 14 bits": (Channel(lambda image: 7000 + wide(image) * 3, "16UC1"), "70.. to 75"),
    "dead pixels": (Channel(lambda image: with_dead_pixels(7000 + wide(image) * 3), "16UC1"), "70.. to 75"),
    "big numbers with signs": (Channel(lambda image: grey(image).astype("<i4") * 9 - 70_000, "32SC1"), "to -6"),
    "floats from 0 to 1": (Channel(lambda image: (grey(image) / 255).astype("<f4"), "32FC1"), "to 0.6"),
    "floats from 0 to 255": (Channel(lambda image: grey(image).astype("<f4"), "32FC1"), "to 1[67]"),
    "colours of 12 bits": (Channel(lambda image: image[..., ::-1].astype("<u2") * 16, "rgb16"), "to 27"),
    "a mosaic": (Channel(mosaic, "bayer_rggb8"), ""),
    "a mosaic of 12 bits": (Channel(lambda image: mosaic(image).astype("<u2") * 16, "bayer_rggb16"), "to 2[67]"),
    "a mosaic in png": (Channel(mosaic, "bayer_rggb8; png compressed ", ".png"), ""),
    "a mosaic in jpeg": (Channel(mosaic, "bayer_rggb8; jpeg compressed ", ".jpg"), ""),
    "a mosaic of 16 bits in png": (
        Channel(lambda image: mosaic(image).astype(np.uint16) * 16, "bayer_rggb16; png compressed ", ".png"),
        "to 2[67]",
    ),
    "png of 16 bits": (Channel(lambda image: wide(image) * 16, "mono16; png compressed mono16", ".png"), "to 27"),
    "tiff of floats": (Channel(lambda image: (grey(image) / 255).astype(np.float32), "tiff", ".tiff"), "to 0.6"),
    "raw in zstd, of its first versions": (Channel(lambda image: image, "bgr8", "zlib"), ""),
    "raw in zstd": (Channel(lambda image: image, "bgr8", "zstd"), ""),
}


@pytest.fixture(scope="module")
def boxes(tmp_path_factory) -> int:
    """The number of boxes in usual pictures."""
    path = written(tmp_path_factory.mktemp("usual") / "a.mcap", {TOPIC: USUAL})
    return mcaptrack.detect(path).rows["/cam/detections"]


@pytest.mark.parametrize(("channel", "span"), one_in(6, SAME.values()), ids=SAME)
def test_the_same_people_are_found_and_the_range_is_said_and_kept(tmp_path, boxes, channel, span):
    path = written(tmp_path / "a.mcap", {TOPIC: channel})
    result = mcaptrack.detect(path)
    assert boxes > 50
    assert abs(result.rows["/cam/detections"] - boxes) <= 0.03 * boxes
    notices = [notice.message for notice in result.warnings if notice.code == "pictures"]
    assert len(notices) == bool(span)
    if span:
        assert re.search(f"{TOPIC}: values from .*{span}.* are shown as black to white", notices[0])
    how = provenance_of(path, "/cam/detections")
    assert [text for code, text in how.warnings if code == "pictures"] == notices


def test_mosaics_in_still_images_have_colours(tmp_path):
    def tinted(image: np.ndarray) -> np.ndarray:
        out = np.full_like(image, 120)
        out[:, :160] = (40, 120, 200)
        return out

    for name in ("a mosaic in png", "a mosaic in jpeg", "a mosaic of 16 bits in png"):
        kind = SAME[name][0]
        channel = Channel(lambda image, kind=kind: kind.draw(tinted(image)), kind.encoding, kind.suffix)
        with mcaptrack.open(written(tmp_path / "a.mcap", {TOPIC: channel}, 0.5)) as opened:
            colours = next(opened.frames()).rows[20:-20, 20:140].reshape(-1, 3).mean(axis=0)
        wanted = np.array((40, 120, 200) if "16" not in name else (0, 127.5, 255))  # by the range that was measured
        assert np.abs(colours - wanted).max() < 4, name


def test_one_bright_picture_and_values_that_stand_for_none_do_not_set_the_range(tmp_path):
    shades = iter(range(10**6))

    def draw(image: np.ndarray) -> np.ndarray:
        values = 7000 + wide(image) * 3
        values[:20] = 0  # the border of a rectified picture
        values[20:25] = 65535
        if next(shades) == 7:
            values[100:101] = 14_000
        return values

    path = written(tmp_path / "a.mcap", {TOPIC: Channel(draw, "mono16")}, 3.0)
    (text,) = [notice.message for notice in mcaptrack.detect(path).warnings if notice.code == "pictures"]
    low, high = map(float, re.findall(r"values from (\S+) to (\S+),", text)[0])
    assert 6999 < low < 7100
    assert 7400 < high < 7600


DEPTHS = {
    "mm": (Channel(lambda image: wide(image) * 20, "16UC1"), "/cam/depth/image_rect_raw"),
    "m": (Channel(lambda image: (grey(image) / 20).astype("<f4"), "32FC1"), "/cam/aligned_depth_to_color/image_raw"),
    "mono16": (Channel(lambda image: wide(image) * 20, "mono16"), "/zed/depth/depth_registered"),
    "by its frame": (Channel(lambda image: wide(image) * 20, "16UC1", "", "cam_depth_optical_frame"), "/cam/tof/image"),
    "png": (
        Channel(lambda image: wide(image) * 20, "16UC1; png compressed ", ".png"),
        "/cam/depth/image_raw/compressed",
    ),
    "compressedDepth": (
        Channel(lambda image: wide(image) * 20, "16UC1; compressedDepth png", ".png", "eye", bytes(12)),
        "/cam/aligned/image_raw/compressedDepth",
    ),
}


@pytest.mark.parametrize(("depth", "topic"), one_in(6, DEPTHS.values()), ids=DEPTHS)
def test_people_are_not_looked_for_in_depths(tmp_path, depth, topic):
    alone = written(tmp_path / "alone.mcap", {topic: depth}, 2.0)
    for name in ("run", "detect"):
        done = call(name, alone)
        assert done.code == 1
        assert f"{topic} has depths (" in done.err
        assert "in which people are not detected; --topic looks for them there all the same" in done.err
    assert mcaptrack.detect(alone, topic=topic, to="/found").stages == ("detect",)
    both = written(tmp_path / "both.mcap", {"/cam/color/image_raw": USUAL, topic: depth}, 2.0)
    result = mcaptrack.run(both, tables=False)
    assert {name for name in result.channels if name.endswith("/detections")} == {"/cam/color/detections"}
    assert [f"has depths in {topic} (" in why for why in result.left_out.values()] == [True]
    with mcaptrack.open(both) as opened:
        assert next(opened.frames()).rows.shape == (180, 320, 3)  # the only camera


FORMS = {
    "compressed and ffmpeg": ("/cam/image_raw/compressed", "/cam/image_raw/zstd"),
    "raw and rectified": ("/cam/image_raw", "/cam/image_rect_color"),
    "both compressed": ("/cam/image_raw/compressed", "/cam/image_rect_color/compressed"),
    "rectified and its compressed form": ("/cam/image_rect", "/cam/image_rect/compressed"),
    "other names": ("/cam/left", "/cam/left/compressed"),
    "all": ("/cam/image_raw", "/cam/image_raw/compressed", "/cam/image_color", "/cam/image_mono/compressed"),
}


@pytest.mark.parametrize("form", one_in(3, FORMS))
def test_forms_of_the_same_pictures_are_one_camera(tmp_path, form):
    topics = FORMS[form]
    kinds = {"compressed": Channel(lambda image: image, "jpeg", ".jpg"), "zstd": SAME["raw in zstd"][0]}
    channels = {topic: kinds.get(topic.rpartition("/")[2], USUAL) for topic in topics[::-1]}
    result = mcaptrack.run(written(tmp_path / "a.mcap", channels, 2.0), tables=False)
    made = [name for name in result.channels if name.endswith("/detections")]
    assert len(made) == 1
    assert provenance_of(tmp_path / "a.mcap", made[0]).input == topics[0]


@needs("fuse")
@thorough
def test_the_eyes_of_a_stereo_camera_are_two_cameras(tmp_path):
    path = written(tmp_path / "a.mcap", {"/stereo/left/image_raw": USUAL, "/stereo/right/image_raw": USUAL}, 2.0)
    assert set(mcaptrack.run(path, tables=False, fuse=False).cameras) == {"stereo/left", "stereo/right"}


def test_pictures_that_are_not_read_are_named(tmp_path):
    path = tmp_path / "a.mcap"
    with recorder(path) as writer:
        channel = writer.add_channel(
            "/cam/image_raw/theora", ("theora_image_transport/msg/Packet", "ros2msg", b"uint8[] data"), "cdr"
        )
        writer.add_message(channel, 5, b"\0\1\0\0", 5)
    done = call("run", path)
    assert done.code == 1
    assert "/cam/image_raw/theora is Theora video, which is not read" in done.err


def test_a_camera_whose_pictures_can_not_be_read_is_left_out_with_exit_code_3(tmp_path):
    broken = Channel(lambda image: image, "jpeg", ".png", head=b"no picture")
    path = written(tmp_path / "a.mcap", {"/a/image_raw": USUAL, "/b/image_raw/compressed": broken}, 2.0)
    done = call("run", path, "--no-tables", "--json")
    assert done.code == 3
    said = [text["message"] for text in json.loads(done.out)["warnings"] if text["code"] == "no-pictures"]
    assert ["the camera b/image_raw is left out: it has pictures that can't be read" in text for text in said] == [True]
