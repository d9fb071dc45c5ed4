"""Video in and out, with real clips made by FFmpeg."""

from __future__ import annotations

import json
import random
import struct
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
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
from tests.commands import done
from tests.logs import recorder
from tests.tiers import thorough
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
