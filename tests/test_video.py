"""Video in and out, with real clips made by FFmpeg."""

from __future__ import annotations

import json
import random
import struct
import subprocess
import sys
from fractions import Fraction
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.sources import foreign
from mcaptrack.sources.video import (
    EncodedPicture,
    H264Encoder,
    VideoOptions,
    decode_bgr,
    decode_gray,
    encode_image,
    open_video,
    write_mp4,
)
from mcaptrack.sources.video.passthrough import Holes, transport_faults
from mcaptrack.sources.video.reader import Clock, orientation_of
from tests.commands import done
from tests.logs import recorder
from tests.tiers import one_in, thorough
from tests.worlds import upright, write_clip

NO_B = {"bf": "0", "g": "10"}


def pictures(path, image_format="auto", start_ns=0, **keep):
    return list(open_video(path, VideoOptions(image_format=image_format, **keep)).pictures(start_ns))


def decoded(path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]


def through_the_log(made, image_format="h264") -> list[np.ndarray]:
    return [frame.rows for frame in decode_gray(EncodedPicture(p.t_ns, p.index, image_format, p.data) for p in made)]


@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.mkv", "a.avi"])
def test_a_stream_that_viewers_can_play_is_passed_on_with_the_same_pictures(tmp_path, name):
    path = tmp_path / name
    write_clip(path, options=NO_B)
    video = open_video(path)
    assert video.why_transcode == ""
    made = pictures(path)
    with av.open(str(path)) as container:
        sizes = [packet.size for packet in container.demux(video=0) if packet.size]
    assert len(made) == 20
    assert all(abs(len(p.data) - size) < 100 for p, size in zip(made, sizes, strict=True))
    own = through_the_log(made)
    with av.open(str(path)) as container:
        theirs = [np.asarray(f.to_ndarray(format="yuv420p")[: f.height]) for f in container.decode(video=0)]
    full = np.clip(np.rint((np.arange(256) - 16) * (255 / 219)), 0, 255).astype(np.uint8)
    for ours, luma in zip(own, theirs, strict=True):
        np.testing.assert_array_equal(ours, full[luma])


def test_frames_per_second_override_the_container(tmp_path):
    path = tmp_path / "a.mp4"
    write_clip(path, options=NO_B)
    assert [p.t_ns for p in pictures(path, fps=Fraction(7))][:3] == [0, 142_857_143, 285_714_286]


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_a_turned_video_is_put_upright_as_opencv_does(tmp_path, quarter_turns):
    path = tmp_path / "a.mp4"
    write_clip(path, options=NO_B)
    one = 0x10000
    turns = {1: (0, one, -one, 0), 2: (-one, 0, 0, -one), 3: (0, -one, one, 0)}
    a, b, c, d = turns[quarter_turns]
    raw = bytearray(path.read_bytes())
    at = raw.find(struct.pack(">9i", one, 0, 0, 0, one, 0, 0, 0, 0x40000000), raw.find(b"tkhd"))
    raw[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 0x40000000)
    path.write_bytes(raw)
    capture = cv2.VideoCapture(str(path))
    _, wanted = capture.read()
    video = open_video(path)
    ours = upright(path)[0]
    assert "turned by" in video.why_transcode
    assert (video.height_px, video.width_px) == ours.shape[:2] == wanted.shape[:2]
    np.testing.assert_array_equal(ours, wanted)


def test_a_folder_of_images_is_a_video_in_the_order_of_its_numbers(tmp_path):
    folder = tmp_path / "seq" / "img1"
    folder.mkdir(parents=True)
    for number in range(1, 12):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((20, 30, 3), number * 10, np.uint8))
    (folder.parent / "seqinfo.ini").write_text("[Sequence]\nframeRate=14\n")
    video = open_video(folder)
    assert (video.frames, video.fps, video.why_transcode) == (11, 14, "it is a folder of images")
    assert [int(image[0, 0, 0]) for image in upright(folder)] == [10 * n for n in range(1, 12)]
    (folder / "5.png").write_bytes(b"no image")
    list(video.pictures())
    assert "5.png can't be read as an image; it is left out" in video.lost[0]


def _audio_only(path):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 8000
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            container.mux(packet)


def _renamed_codec(path):
    write_clip(path, options=NO_B)
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzz1"))


BAD = {
    "no video": (lambda p: p.write_text("I am text"), "can't be read as a video"),
    "nothing": (lambda p: p.write_bytes(b""), "is empty, and no video"),
    "cut off": (
        lambda p: (write_clip(p, options=NO_B), p.write_bytes(p.read_bytes()[: p.stat().st_size // 2])),
        "can't be read as a video",
    ),
    "sound alone": (_audio_only, "holds no video, only audio"),
    "unknown codec": (_renamed_codec, "in an unknown codec"),
    "no images": (lambda p: p.mkdir(), "holds no images"),
}


@pytest.mark.parametrize(("make", "words"), BAD.values(), ids=BAD)
def test_what_is_no_video_is_refused(tmp_path, make, words):
    path = tmp_path / "a.mp4"
    make(path)
    with pytest.raises(McaptrackError, match=words):
        open_video(path)


@pytest.mark.parametrize("name", ["2026-05-01T12:30:00.mp4", "http:a.mp4", "pipe:0.mp4"])
def test_a_name_with_a_colon_is_a_file_and_no_protocol(tmp_path, monkeypatch, name):
    write_clip(tmp_path / "a.mp4", frames=3)
    (tmp_path / "a.mp4").rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert len(pictures(Path(name))) == 3
    assert write_mp4(Path("12:30.mp4"), iter([np.zeros((16, 16, 3), np.uint8)] * 2), 10) == 2
    assert len(pictures(Path("12:30.mp4"))) == 2


def test_metadata_that_is_not_utf8_does_not_keep_a_video_from_being_read(tmp_path):
    path = tmp_path / "a.mp4"
    write_clip(path, options=NO_B)
    wanted = [picture.data for picture in pictures(path)]
    raw = path.read_bytes()
    encoder = b"Lavf"
    assert encoder in raw
    path.write_bytes(raw.replace(encoder, b"L\xe4vf"))
    assert [picture.data for picture in pictures(path)] == wanted


def test_pictures_that_are_too_large_for_h264_are_refused_with_their_size(tmp_path):
    (tmp_path / "frames").mkdir()
    cv2.imwrite(str(tmp_path / "frames" / "1.png"), np.zeros((16, 17000, 3), np.uint8))
    with pytest.raises(McaptrackError, match=r"pictures of 17000 x 16 can't be encoded as H\.264"):
        pictures(tmp_path / "frames", fps=Fraction(10))
    assert len(pictures(tmp_path / "frames", "png", fps=Fraction(10))) == 1
    with pytest.raises(McaptrackError, match=r"pictures of 17000 x 16 can't be encoded as H\.264"):
        write_mp4(tmp_path / "a.mp4", iter([np.zeros((16, 17000, 3), np.uint8)]), 10)


def test_files_are_opened_with_pyav_in_one_place():
    root = Path(mcaptrack.__file__).parent
    opening = {path.relative_to(root).as_posix() for path in root.rglob("*.py") if "av.open(" in path.read_text()}
    assert opening == {"sources/video/container.py"}


def test_a_video_without_frames_is_refused(tmp_path):
    path = tmp_path / "a.mkv"
    write_clip(path, frames=1, options=NO_B)
    with av.open(str(path)) as source, av.open(str(tmp_path / "b.mkv"), "w") as target:
        target.add_stream_from_template(source.streams.video[0])
        target.start_encoding()
    with pytest.raises(McaptrackError, match="is a video without frames"):
        open_video(tmp_path / "b.mkv")


def test_the_same_pictures_give_the_same_bytes(tmp_path):
    images = write_clip(tmp_path / "a.mp4")
    one, two = (H264Encoder(64, 48, Fraction(10)) for _ in range(2))
    assert [one.encode(image) for image in images] == [two.encode(image) for image in images]
    assert write_mp4(tmp_path / "b.mp4", images, 10) == write_mp4(tmp_path / "c.mp4", images, 10) == 20
    assert (tmp_path / "b.mp4").read_bytes() == (tmp_path / "c.mp4").read_bytes()
    assert open_video(tmp_path / "b.mp4").why_transcode == ""


def test_brightness_is_full_range_whatever_it_came_from():
    for level in (0, 128, 255):
        image = np.full((48, 64, 3), level, np.uint8)
        for image_format, data in (
            ("jpeg", encode_image(image, "jpeg")),
            ("h264", H264Encoder(64, 48, Fraction(10)).encode(image)),
        ):
            (seen,) = through_the_log([type("P", (), {"t_ns": 0, "index": 0, "data": data})], image_format)
            assert np.abs(seen.astype(int) - level).max() <= 2, (level, image_format)


def test_pictures_that_are_broken_say_which():
    with pytest.raises(McaptrackError, match="frame 7 can't be decoded as jpeg"):
        list(decode_gray([EncodedPicture(0, 7, "jpeg", b"\xff\xd8 no picture")]))


@thorough
def test_a_decoder_that_is_let_go_while_its_threads_work_does_not_wait_for_ever(tmp_path):
    """FFmpeg's threads give packets back; memory of Python's would need Python, which waits for these threads."""
    code = (
        "import sys, numpy as np\n"
        "from fractions import Fraction\n"
        "from mcaptrack.sources.video import EncodedPicture, H264Encoder, decode_gray\n"
        "encoder = H264Encoder(640, 480, Fraction(10))\n"
        "noise = np.random.default_rng(1).integers(0, 255, (480, 640, 3), np.uint8)\n"
        "pictures = [EncodedPicture(n, n, 'h264', encoder.encode(np.roll(noise, n, axis=1))) for n in range(12)]\n"
        "for turn in range(60):\n"
        "    frames = decode_gray(iter(pictures))\n"
        "    for _ in range(1 + turn % 6): next(frames)\n"
        "    frames.close()\n"
        "    del frames\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=600)


# Videos with damaged pictures: FFmpeg makes up what it can't read, so that a stage has to say so


DAMAGED = (5, 6, 25)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log with a video of 40 pictures, and one where bytes within some of them are others."""
    folder = tmp_path_factory.mktemp("damaged")
    write_clip(folder / "a.mp4", 40, size=(320, 240))
    done("ingest", folder / "a.mp4", "-o", folder / "whole.mcap", "-q")
    rng = random.Random(1)
    damaged = recorder(folder / "damaged.mcap", "ros2")
    with (folder / "whole.mcap").open("rb") as source, damaged as writer:
        topic = 0
        messages = make_reader(source).iter_messages(topics=["/camera/video"])
        for number, (schema, channel, message) in enumerate(messages):
            record = (schema.name, schema.encoding, schema.data)
            topic = topic or writer.add_channel(channel.topic, record, "protobuf")
            data = bytearray(message.data)
            for at in [rng.randrange(len(data) // 2, len(data) - 10) for _ in range(6 * (number in DAMAGED))]:
                data[at] ^= 0xFF
            writer.add_message(topic, message.log_time, bytes(data), message.publish_time, number)
    return folder


@pytest.mark.parametrize("decode", [decode_gray, decode_bgr])
def test_damaged_pictures_are_those_with_other_pixels(folder, decode):
    def pictures(name: str, damaged: list[int]) -> list[np.ndarray]:
        with log.read(folder / name) as opened:
            encoded = [
                EncodedPicture(message.t_ns, n, picture.format, picture.data, picture.layout)
                for n, (message, picture) in enumerate(foreign.pictures(opened, "/camera/video"))
            ]
        return [frame.rows for frame in decode(encoded, damaged=damaged)]

    whole, found = list[int](), list[int]()
    before, after = pictures("whole.mcap", whole), pictures("damaged.mcap", found)
    assert whole == []
    assert found
    assert set(found) <= set(DAMAGED)
    assert all(not np.array_equal(before[number], after[number]) for number in found)


@pytest.mark.parametrize("detector", ["knn", "median"])  # median reads them twice
def test_a_stage_says_that_pictures_are_damaged_and_once(folder, tmp_path, detector):
    for name, count in (("whole.mcap", 0), ("damaged.mcap", 1)):
        words = ("detect", folder / name, "--detector", detector, "-o", tmp_path / name, "--json", "-q")
        said = [one for one in json.loads(done(*words).out)["warnings"] if one["code"] == "lost"]
        assert len(said) == count
        assert all(" of 40 pictures are damaged, number 5 first; " in one["message"] for one in said)


# Videos that are damaged, cut, edited, mirrored or irregular: what ``ingest`` says of them without decoding all


ONE = 0x10000


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    """The same pictures in three containers: 30 of noise, so that a key picture takes 20 kB, and 12 small ones."""
    odd = tmp_path_factory.mktemp("odd")
    image = np.random.default_rng(0).integers(0, 60, (240, 320, 3), np.uint8)
    for name in ("a.mp4", "a.ts"):
        with av.open(str(odd / name), "w") as container:
            stream = container.add_stream("libx264", rate=10, options=NO_B)
            stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
            for number in range(30):
                image[100:140, 8 * number : 8 * number + 20] += 100
                for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")):
                    container.mux(packet)
            for packet in stream.encode(None):
                container.mux(packet)
    write_clip(odd / "a.avi", 12, options=NO_B)
    return odd


def samples(path: Path) -> list[tuple[int, int]]:
    """Where the packets of a video are: offset and size."""
    with av.open(str(path)) as opened:
        return [(packet.pos, packet.size) for packet in opened.demux(video=0) if packet.size]


def changed(path: Path, name: str, change) -> Path:
    """A copy of a file after ``change``, a function of its bytes that returns others."""
    other = path.with_name(name)
    other.write_bytes(bytes(change(bytearray(path.read_bytes()))))
    return other


def read(path: Path, **options):
    """The pictures of a video, and the video with what it says."""
    video = open_video(path, VideoOptions(**options))
    return list(video.pictures()), video


def zeros(start: int, size: int):
    def change(data: bytearray) -> bytearray:
        data[start : start + size] = bytes(size)
        return data

    return change


def test_a_hole_within_a_picture_makes_all_be_decoded_and_counted(odd):
    at, size = samples(odd / "a.mp4")[20]
    path = changed(odd / "a.mp4", "hole.mp4", zeros(at + size // 2, 700))
    pictures, video = read(path)
    assert video.why_transcode == "some of its packets are damaged"
    assert len(pictures) == 30
    assert video.lost == [f"{path}: 1 of 30 frames are damaged; they are kept as far as they decode"]


def test_holes_are_zeros_where_none_can_be():
    unit, start = b"\x41" + b"\x9a\x17" * 50, b"\x00\x00\x00\x01"

    def count(*pictures: bytes) -> int:
        holes = Holes()
        for data in pictures:
            holes.add(data)
        return holes.count

    whole = [start + unit] * 30
    assert count(*whole) == 0
    assert count(*whole, start + unit[:40] + bytes(64) + unit[40:]) == 1
    assert count(*whole, start + unit[:40] + bytes(63) + unit[40:]) == 0
    assert count(*whole, start + unit + bytes(200) + start + unit) == 0  # padding before a start code
    assert count(*whole, start + unit + bytes(200)) == 1  # the rest of a picture is missing
    assert count(*[start + unit + bytes(200)] * 30) == 0  # all are padded
    two = start + unit + bytes(100) + start + unit + bytes(64) + b"\x05"
    assert count(*whole, two) == 1


def test_pictures_that_are_missing_are_known_by_the_numbers_of_the_others(odd):
    def without(*left_out: int) -> list[str]:
        path = odd / "without.mp4"
        with av.open(str(odd / "a.mp4")) as source, av.open(str(path), "w") as target:
            stream = target.add_stream_from_template(source.streams.video[0])
            for number, packet in enumerate(source.demux(video=0)):
                if packet.size and number not in left_out:
                    packet.stream = stream
                    target.mux(packet)
        pictures, video = read(path)
        assert len(pictures) == 30 - len(left_out)
        assert video.why_transcode == ""
        return [words.removeprefix(f"{path}: ") for words in video.lost]

    assert without(19, 29) == []  # the last of their groups: nothing depends on them
    (one,) = without(4, 5)
    assert one.startswith("pictures are missing at 1 place, before picture 4 first; ")
    (two,) = without(12, 15, 16)
    assert two.startswith("pictures are missing at 2 places, before picture 12 first; ")


@pytest.mark.parametrize("size", [188, 192, 204])
def test_faults_of_transport_streams_are_counted(odd, tmp_path, size):
    whole = np.frombuffer((odd / "a.ts").read_bytes(), np.uint8).reshape(-1, 188)
    rows = np.zeros((len(whole), size), np.uint8)
    at = 4 if size == 192 else 0
    rows[:, at : at + 188] = whole
    mine = np.flatnonzero((whole[:, 1] & 0x1F == 1) & (whole[:, 2] == 0) & (whole[:, 3] & 0x10 > 0))
    path = tmp_path / "b.ts"

    def faults(data: bytes) -> int:
        path.write_bytes(data)
        return transport_faults(path, 256)

    assert len(mine) > 30
    assert faults(rows.tobytes()) == 0
    assert faults(np.delete(rows, mine[9], axis=0).tobytes()) == 1
    assert faults(np.delete(rows, mine[[9, 10, 20]], axis=0).tobytes()) == 2
    assert faults(np.insert(rows, mine[9], rows[mine[9]], axis=0).tobytes()) == 0  # packets may come twice
    damaged = rows.copy()
    damaged[mine[9]] = 0
    assert faults(damaged.tobytes()) == 1
    others = rows.tobytes()
    assert faults(others[: size * 20] + b"\x00" * 55 + others[size * 20 :]) == 1
    assert transport_faults(odd / "a.mp4", 256) == 0


def test_packets_that_a_transport_stream_lost_make_all_be_decoded(odd):
    path = changed(odd / "a.ts", "lost.ts", lambda data: data[: 188 * 60] + data[188 * 64 :])
    _, video = read(path)
    assert video.why_transcode == "some of its packets are damaged"
    assert video.lost[-1] == f"{path}: 1 of 30 frames are damaged; they are kept as far as they decode"


def test_the_last_picture_of_a_stream_without_sizes_is_decoded(odd):
    path = changed(odd / "a.ts", "cut.ts", lambda data: data[: len(data) * 2 // 3 // 188 * 188])
    with av.open(str(path)) as opened:
        is_damaged = [frame.is_corrupt for frame in opened.decode(video=0)][-1]
    pictures, video = read(path)
    assert len(pictures) < 30
    words = f"{path} is cut off or damaged in its last picture, which is kept as far as it decodes"
    assert video.lost == [words] * is_damaged == [words]


def test_packets_that_give_no_picture_are_counted(odd):
    at, size = samples(odd / "a.avi")[-1]
    path = changed(odd / "a.avi", "last.avi", zeros(at, size))
    pictures, video = read(path)
    assert len(pictures) == 11
    assert video.lost == [f"{path}: 1 of 12 packets can't be decoded"]


@pytest.mark.parametrize(("start", "left"), [(10, 20), (15, 15)])  # at a key picture, and between two
def test_what_an_edit_list_hides_is_not_lost(odd, start, left):
    def edited(data: bytearray) -> bytearray:
        at = data.find(b"elst")
        ticks, rate = 10_240, 10
        assert struct.unpack(">i", data[at + 16 : at + 20]) == (0,)
        data[at + 16 : at + 20] = struct.pack(">i", start * ticks // rate)
        return data

    path = changed(odd / "a.mp4", "edited.mp4", edited)
    pictures, video = read(path)
    assert len(pictures) == left
    assert video.lost == []
    assert video.notes == [f"{path}: an edit list hides 10 of its 30 frames"]


def test_a_video_of_which_all_is_hidden_says_so(odd):
    def hidden(data: bytearray) -> bytearray:
        at = data.find(b"elst")
        data[at + 16 : at + 20] = struct.pack(">i", -1)
        return data

    with pytest.raises(McaptrackError, match="is a video without frames: its edit list hides all 30 of them"):
        open_video(changed(odd / "a.mp4", "hidden.mp4", hidden))


def test_a_recording_without_its_index_says_what_to_do(odd):
    path = changed(odd / "a.mp4", "noindex.mp4", lambda data: data[: data.find(b"moov") - 4])
    with pytest.raises(McaptrackError, match=r"no index \(moov\), .*; copy it again, or repair it"):
        open_video(path)
    with pytest.raises(McaptrackError, match="give a complete mp4"):
        open_video(changed(odd / "a.mp4", "zeros.mp4", lambda data: bytes(len(data))))
    with pytest.raises(McaptrackError, match=r"no index \(moov\)"):
        open_video(changed(odd / "a.mp4", "half.mp4", lambda data: data[: data.find(b"moov") + 60]))


@pytest.mark.parametrize(
    ("a", "b", "c", "d"),
    [
        turn
        for turn in product((-1, 0, 1), repeat=4)
        if abs(turn[0] * turn[3] - turn[1] * turn[2]) == 1 and sum(map(abs, turn)) == 2
    ],
)
def test_pictures_stand_where_the_matrix_puts_their_pixels(a, b, c, d):
    image = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    side = struct.pack("=9i", a * ONE, b * ONE, 0, c * ONE, d * ONE, 0, 7 * ONE, 0, 1 << 30)
    frame = SimpleNamespace(
        rotation=0,
        side_data={"DISPLAYMATRIX": side},
        to_ndarray=lambda **_: image,
    )
    placed = {(a * x + c * y, b * x + d * y): image[y, x].tolist() for x in range(3) for y in range(2)}
    left, top = (min(one[axis] for one in placed) for axis in (0, 1))
    orientation = orientation_of(frame)
    upright = orientation.of(frame)
    assert len(placed) == upright.shape[0] * upright.shape[1] == 6
    assert all(upright[y - top, x - left].tolist() == pixel for (x, y), pixel in placed.items())
    assert bool(orientation.description) == ((a, b, c, d) != (1, 0, 0, 1))
    assert (orientation.is_transposed, orientation.oblique) == (a == 0, 0)


def test_what_is_kept_as_stored_is_said(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10, options=NO_B)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(4, 3)
        stream.codec_context.color_trc = 16
        for packet in [*stream.encode(av.VideoFrame(64, 48, "yuv420p")), *stream.encode(None)]:
            container.mux(packet)
    raw = bytearray(path.read_bytes())
    at = raw.find(b"tkhd") + 4 + 40
    raw[at : at + 20] = struct.pack(">5i", 46341, 46341, 0, -46341, 46341)
    path.write_bytes(raw)
    video = open_video(path)
    assert video.notes == [
        f"{path} should be turned by 45.0 degrees; only quarter turns are done",
        f"{path} has pixels that are 1.333 times as wide as high; pictures stay as they are stored",
        f"{path} is HDR (PQ); its brightness stays as stored, which may not suit detectors",
    ]
    assert (video.width_px, video.height_px, video.why_transcode) == (64, 48, "")
    thermal = tmp_path / "thermal.mkv"
    with av.open(str(thermal), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "gray16le"
        picture = av.VideoFrame.from_ndarray(np.full((48, 64), 4095, np.uint16), format="gray16le")
        for packet in [*stream.encode(picture), *stream.encode(None)]:
            container.mux(packet)
    (note,) = open_video(thermal).notes
    assert "grey values of 16 bits, of which the highest 8 are kept; its first picture reaches 6% of white" in note


def said_of(times_ms: list[int], fps: Fraction | None = None) -> list[str]:
    with collected() as warnings:
        clock = Clock(Path("a.mp4"), 0, fps)
        for index, ms in enumerate(times_ms):
            clock.time(index, Fraction(ms, 1000))
        clock.warn()
    assert {one.code for one in warnings} <= {"clock"}
    return [str(one.message) for one in warnings]


def test_gaps_between_regular_pictures_are_said():
    regular = list(range(0, 4000, 40))
    assert said_of(regular) == said_of([ms + ms % 3 for ms in regular]) == []
    assert said_of(regular[:20] + regular[21:]) == []  # one picture alone
    (one,) = said_of(regular[:20] + regular[25:])
    assert (
        "has 1 gap between pictures that otherwise come every 40 ms, the first after 0.76 s, the longest of 0.24" in one
    )
    assert "about 5 pictures" in one
    (two,) = said_of(regular[:20] + regular[22:50] + regular[60:])
    assert "2 gaps" in two
    assert "about 12 pictures" in two
    assert said_of(regular[:20] + regular[25:], Fraction(25)) == []  # the times are others then
    rng = np.random.default_rng(1)
    assert said_of(np.cumsum(1 + rng.exponential(100, 200)).astype(int).tolist()) == []  # no clock, no gap


def test_times_that_do_not_increase_are_said():
    (one,) = said_of([0, 40, 40, 80, 120, 110, 160])
    assert one.startswith("a.mp4: 2 of 7 pictures are not later than the one before, number 2 first; ")


# Which picture is shown when


def grey(number: int) -> av.VideoFrame:
    """A picture with its number as its brightness: 6 for each."""
    return av.VideoFrame.from_ndarray(np.full((48, 64, 3), 6 * number + 10, np.uint8), format="bgr24")


def numbers(path: Path, **options) -> list[tuple[int, float]]:
    """The number of each picture of a video, and its time in a log in seconds after the first."""
    video = open_video(path, VideoOptions(**options))
    times = [picture.t_ns for picture in video.pictures()]
    shown = [round((float(image.mean()) - 8.6) / 6) for image in upright(path)]
    return [(number, round((t_ns - times[0]) / 1e9, 3)) for number, t_ns in zip(shown, times, strict=True)]


def encoded(codec: str, count: int = 40, pixels: str = "yuv420p", **options: str) -> list[bytes]:
    """Pictures at 25 frames a second as packets."""
    stream = av.CodecContext.create(codec, "w")
    stream.width, stream.height, stream.pix_fmt, stream.time_base = 64, 48, pixels, Fraction(1, 25)
    stream.framerate, stream.options = Fraction(25), options
    packets = []
    for number in range(count):
        frame = grey(number)
        frame.pts = number
        packets += stream.encode(frame)
    return [bytes(packet) for packet in [*packets, *stream.encode(None)]]


def avi(path: Path, fourcc: bytes, chunks: list[bytes]) -> Path:
    """An AVI with these chunks, in one slot of 40 ms each."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return name + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)

    count = len(chunks)
    head = chunk(b"avih", struct.pack("<14I", 40_000, 0, 0, 16, count, 0, 1, 0, 64, 48, 0, 0, 0, 0))
    stream = struct.pack("<IHHIIIIIIII4h", 0, 0, 0, 0, 1, 25, 0, count, 0, 2**32 - 1, 0, 0, 0, 64, 48)
    pixels = struct.pack("<IiiHH4sIiiII", 40, 64, 48, 1, 24, fourcc, 64 * 48 * 3, 0, 0, 0, 0)
    lists = chunk(b"LIST", b"strl" + chunk(b"strh", b"vids" + fourcc + stream) + chunk(b"strf", pixels))
    movie = b"".join(chunk(b"00dc", data) for data in chunks)
    starts = np.cumsum([4, *(8 + len(data) + len(data) % 2 for data in chunks)]).tolist()
    index = b"".join(b"00dc" + struct.pack("<III", 16, at, len(data)) for at, data in zip(starts, chunks, strict=False))
    body = chunk(b"LIST", b"hdrl" + head + lists) + chunk(b"LIST", b"movi" + movie) + chunk(b"idx1", index)
    path.write_bytes(chunk(b"RIFF", b"AVI " + body))
    return path


EMPTY, ONE_BYTE = b"", b"\x7f"
NOT_CODED = b"\x00\x00\x01\xb6\x50\x4f"  # a picture of MPEG-4 that repeats the one before
AVIS = {
    "mjpeg": ("mjpeg", b"MJPG", {"pixels": "yuvj420p"}, (EMPTY, ONE_BYTE)),
    "H.264": ("libx264", b"H264", {"bf": "0", "g": "10"}, (EMPTY,)),
    "MPEG-4": ("mpeg4", b"XVID", {"bf": "0", "qmin": "1", "qmax": "2"}, (EMPTY, ONE_BYTE, NOT_CODED)),
}


@pytest.mark.parametrize(("codec", "fourcc", "options", "placeholders"), one_in(2, AVIS.values()), ids=AVIS)
def test_a_slot_without_a_picture_is_time_without_a_picture(tmp_path, codec, fourcc, options, placeholders):
    """AVI has numbered slots; the time of a picture is that of its slot, whatever stands in those before."""
    packets = encoded(codec, **options)
    for placeholder, before in product(placeholders, (1, 20)):
        chunks = [*packets[:before], placeholder, placeholder, *packets[before:]]
        slots = [at for at, data in enumerate(chunks) if data is not placeholder]
        path = avi(tmp_path / "a.avi", fourcc, chunks)
        assert numbers(path) == [(number, slot / 25) for number, slot in enumerate(slots)], (placeholder, before)
        assert open_video(path).lost == []
        assert numbers(path, image_format="png") == numbers(path)


@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
@pytest.mark.parametrize("between", [0, 1, 2, 3])
def test_a_gap_in_an_avi_is_before_the_picture_that_came_after_it(tmp_path, codec, between):
    """Packets stand in the order of decoding; the gap is among them one or two later than it was among pictures."""
    path = tmp_path / "a.avi"
    shown_at = [number if number < 24 else number + 50 for number in range(40)]
    with av.open(str(path), "w") as container:
        fixed = {"x264-params": "scenecut=0:b-adapt=0"} if codec == "libx264" else {"qmin": "1", "qmax": "2"}
        stream = container.add_stream(codec, rate=25, options={"bf": str(between), "g": "250", **fixed})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for number, slot in enumerate(shown_at):
            frame = grey(number)
            frame.pts, frame.time_base = slot, Fraction(1, 25)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    assert numbers(path) == [(number, slot / 25) for number, slot in enumerate(shown_at)]


def test_a_clock_that_wraps_goes_on(odd, tmp_path):
    """The clock of a transport stream has 33 bits, which last for 26.5 hours."""
    whole, path = (odd / "a.ts").read_bytes(), tmp_path / "a.ts"
    data = bytearray(whole)
    later = 2**33 - round((1.4 + 1.5) * 90_000)  # FFmpeg begins 1.4 s after 0

    def moved(at: int) -> None:
        parts = data[at] >> 1 & 7, data[at + 1], data[at + 2] >> 1, data[at + 3], data[at + 4] >> 1
        ticks = parts[0] << 30 | parts[1] << 22 | parts[2] << 15 | parts[3] << 7 | parts[4]
        ticks = (ticks + later) % 2**33
        data[at] = data[at] & 0xF1 | ticks >> 30 << 1
        data[at + 1 : at + 5] = bytes(
            (ticks >> 22 & 0xFF, (ticks >> 15 & 0x7F) << 1 | 1, ticks >> 7 & 0xFF, (ticks & 0x7F) << 1 | 1)
        )

    for at in range(0, len(data), 188):
        start = at + 4 + (data[at + 4] + 1 if data[at + 3] & 0x20 else 0)
        if data[at + 1] & 0x40 and data[start : start + 4] == b"\0\0\1\xe0":
            stamps = data[start + 7] >> 6
            moved(start + 9)
            if stamps == 3:
                moved(start + 14)
    path.write_bytes(data)
    with collected() as warnings:
        pictures, video = read(path)
    assert [p.t_ns for p in pictures] == [p.t_ns for p in read(odd / "a.ts")[0]]
    assert (video.lost, list(warnings)) == ([], [])


def test_a_stream_that_ends_before_its_file_says_so_whenever_it_began(odd, tmp_path):
    """Only the last second of 3 s is missing: by the clock of the file it began after 1.4 s."""
    path = tmp_path / "a.mkv"
    with av.open(str(odd / "a.mp4")) as source, av.open(str(path), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(video=0):
            if packet.size:
                packet.stream, packet.pts, packet.dts = stream, packet.pts + 50_000, packet.dts + 50_000
                target.mux(packet)
    _, video = read(path)
    assert video.lost == []
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    _, video = read(path)
    assert any("lacks the last" in text or "cut off" in text for text in video.lost)


def test_a_clock_that_goes_back_begins_again_one_interval_later():
    def times(*times_ms: int) -> list[int]:
        with collected():
            clock = Clock(Path("a.ts"), 0, None)
            return [clock.time(index, Fraction(ms, 1000)) // 1_000_000 for index, ms in enumerate(times_ms)]

    part = range(0, 4000, 40)
    assert times(*part, *part) == list(range(0, 8000, 40))
    assert times(*part, *part, *range(9000, 10_000, 40))[200:] == list(range(4000 + 9000, 4000 + 10_000, 40))
    assert times(*part, 0, *range(4040, 5000, 40)) == list(range(0, 5000, 40))  # one wrong stamp
    (text,) = said_of([*part, *part])
    assert text.startswith("a.mp4: the clock goes back once, first before picture 100, as where files were joined; ")
    (text,) = said_of([*part, *part, *part])
    assert "goes back 2 times" in text


def test_pictures_that_cant_be_decoded_at_the_beginning_are_left_out(tmp_path):
    packets = encoded("mjpeg", 8, pixels="yuvj420p")
    path = avi(tmp_path / "a.avi", b"MJPG", [b"broken" * 40, *packets[1:]])
    assert numbers(path) == [(number, (number - 1) / 25) for number in range(1, 8)]
    avi(path, b"MJPG", [b"broken" * 40] * 8)
    with pytest.raises(McaptrackError, match="can't be read as a video"):
        open_video(path)
