"""Streams that are passed on, read back by the stock MCAP library and FFmpeg; and those that may not be."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.bitstream import BitStreamFilterContext
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from mcaptrack.errors import McaptrackError
from mcaptrack.notices import collected
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.sources.video import VideoOptions, open_video
from mcaptrack.sources.video.codecs import CODECS
from tests.commands import call
from tests.tiers import one_in
from tests.worlds import SVT, X265, write_clip

X264 = {"bf": "0", "g": "10"}
DECODERS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}

PASSED = {
    "h264 in mp4": ("a.mp4", "h264", {"options": X264}),
    "h264 in mkv": ("a.mkv", "h264", {"options": X264}),
    "h264 in avi": ("a.avi", "h264", {"options": X264}),
    "h264 in ts": ("a.ts", "h264", {"options": X264}),
    "h265 in mp4": ("a.mp4", "h265", {"codec": "libx265", "options": X265}),
    "h265 in mkv": ("a.mkv", "h265", {"codec": "libx265", "options": X265}),
    "h265 in ts": ("a.ts", "h265", {"codec": "libx265", "options": X265}),
    "vp9 in webm": ("a.webm", "vp9", {"codec": "libvpx-vp9", "options": {"g": "10"}}),
    "vp9 in mp4 of odd size": ("a.mp4", "vp9", {"codec": "libvpx-vp9", "options": {"g": "10"}, "size": (67, 51)}),
    "av1 in mp4": ("a.mp4", "av1", {"codec": "libsvtav1", "options": SVT, "size": (96, 80)}),
    "av1 in mkv": ("a.mkv", "av1", {"codec": "libsvtav1", "options": SVT, "size": (96, 80)}),
}


def by_ffmpeg(path):
    """The pictures of a clip, which of its packets are key pictures, and their sizes."""
    with av.open(str(path)) as container:
        images = [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]
    with av.open(str(path)) as container:
        packets = [(packet.is_keyframe, packet.size) for packet in container.demux(video=0) if packet.size]
    return images, packets


def by_the_stock_library(path):
    """The messages of the video in a log: log time, and what was packed."""
    with path.open("rb") as stream:
        found = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages("/camera/video")
        return [(message.log_time, video) for _, _, message, video in found]


def decoder(name):
    context = av.CodecContext.create(DECODERS[name], "r")
    context.thread_count = 1  # so that nothing waits: one message in, one picture out
    return context


def shown(context, data):
    return [frame.to_ndarray(format="bgr24") for frame in context.decode(av.Packet(data) if data else None)]


@pytest.mark.parametrize(("name", "codec", "clip"), one_in(2, PASSED.values()), ids=PASSED)
def test_another_client_sees_every_picture_of_the_clip_in_a_message_of_its_own(tmp_path, name, codec, clip):
    path, output = tmp_path / name, tmp_path / "a.mcap"
    write_clip(path, frames=30, **clip)
    image_format = "h265" if codec == "h265" else "auto"
    report = ingest(path, output, IngestOptions(image_format=image_format, start_ns=7))
    assert report.lost == []
    if codec in ("vp9", "av1"):
        assert "which Foxglove plays and Lichtblick does not (`image_format='h264'` is for both)" in report.remarks[0]
    else:
        assert report.remarks == []
    images, packets = by_ffmpeg(path)
    messages = by_the_stock_library(output)
    assert {video.format for _, video in messages} == {codec}
    assert [t for t, _ in messages] == [7 + n * 100_000_000 for n in range(30)]
    assert [video.timestamp.ToNanoseconds() for _, video in messages] == [t for t, _ in messages]
    sizes = [(len(video.data), size) for (_, video), (_, size) in zip(messages, packets, strict=True)]
    assert all(size - 8 <= ours <= size + 3000 for ours, size in sizes)
    one = decoder(codec)
    for number, (_, video) in enumerate(messages):
        (image,) = shown(one, video.data)
        np.testing.assert_array_equal(image, images[number])
    keys = [number for number, (is_key, _) in enumerate(packets) if is_key]
    assert len(keys) >= 3
    for number in keys:
        alone = decoder(codec)
        (image,) = shown(alone, messages[number][1].data) + shown(alone, None)
        np.testing.assert_array_equal(image, images[number])


def cut(source: Path, target: Path, first: int, *, into: str = "", **options) -> Path:
    """The packets of a clip from the one with this number on, not encoded again, in another file."""
    with av.open(str(source)) as read, av.open(str(target), "w", **options) as container:
        stream = container.add_stream_from_template(read.streams.video[0])
        step = None
        for number, packet in enumerate(read.demux(video=0)):
            step = step or packet.duration
            if packet.size and (into == "edit list" or number >= first):
                packet.pts -= first * step
                packet.dts -= first * step
                packet.stream = stream
                container.mux(packet)
    return target


def edit_list(folder):
    write_clip(folder / "whole.mp4", frames=40, options=X264)
    return cut(folder / "whole.mp4", folder / "a.mp4", 7, into="edit list")


def no_key_first(folder):
    write_clip(folder / "whole.mkv", frames=40, options=X264)
    return cut(folder / "whole.mkv", folder / "a.mkv", 3)


def another_size(folder):
    parts = []
    for name, size in (("one.h264", (64, 48)), ("two.h264", (96, 64))):
        write_clip(folder / name, size=size, options=X264)
        parts.append((folder / name).read_bytes())
    (folder / "a.h264").write_bytes(b"".join(parts))
    return folder / "a.h264"


def made(name, **clip):
    def make(folder):
        write_clip(folder / name, **clip)
        return folder / name

    return make


TRAPS = {
    "an edit list": (edit_list, "an edit list hides some of its frames", 33),
    "no key frame first": (no_key_first, "it does not begin with a key frame", None),
    "another size on the way": (another_size, "it changes its size or its parameters on the way", 40),
    "interlaced": (made("a.mp4", options=X264 | {"x264-params": "interlaced=1"}), "it is interlaced", 20),
    "4:2:2": (made("a.mkv", options=X264, pixels="yuv422p"), "its pixels are yuv422p, not 8-bit 4:2:0", 20),
    "10 bit": (made("a.mkv", options=X264, pixels="yuv420p10le"), "its pixels are yuv420p10le", 20),
    "motion jpeg": (made("a.avi", codec="mjpeg", pixels="yuvj420p"), "it is mjpeg, which viewers don't play", 20),
    "vp9 of 4:4:4": (made("a.webm", codec="libvpx-vp9", options={"g": "10"}, pixels="yuv444p"), "its pixels are yuv444p", 20),
    "av1 of 10 bit": (made("a.mkv", codec="libsvtav1", options=SVT, size=(96, 80), pixels="yuv420p10le"), "its pixels are yuv420p10le", 20),
    "vp9 with key frames far apart": (made("a.webm", codec="libvpx-vp9", options={"g": "99"}, frames=30), "its key frames are more than 2 s apart", 30),
    "open groups": (made("a.mp4", options=X264 | {"x264-params": "open-gop=1:intra-refresh=1"}, frames=40), "open groups of pictures", 40),
    "open groups with B-frames": (made("a.mp4", options={"bf": "2", "g": "10", "x264-params": "open-gop=1"}, frames=30), "it has B-frames", 30),
    "B-frames in avi, which has no times": (made("a.avi", options={"bf": "2", "g": "10"}), "it has B-frames", 20),
    "h265": (made("a.mp4", codec="libx265", options=X265), "it is H.265, which viewers play only where", 20),
    "h265 with B-frames": (made("a.mp4", codec="libx265", options={"x265-params": "keyint=10:bframes=2:log-level=none"}), "it has B-frames", 20),
}  # fmt: skip


@pytest.mark.parametrize(("make", "words", "count"), one_in(2, TRAPS.values()), ids=TRAPS)
def test_what_viewers_would_show_wrongly_is_encoded_again_and_shows_what_players_show(tmp_path, make, words, count):
    path, output = make(tmp_path), tmp_path / "a.mcap"
    fps = Fraction(10) if path.suffix == ".h264" else None
    report = ingest(path, output, IngestOptions(fps=fps))
    assert words in report.remarks[0]
    images, _ = by_ffmpeg(path)
    messages = by_the_stock_library(output)
    assert len(messages) == len(images) == (count or len(images))
    assert [t for t, _ in messages] == [n * 100_000_000 for n in range(len(messages))]
    one = decoder("h264")
    for (_, video), wanted in zip(messages, images, strict=True):
        (image,) = shown(one, video.data)
        if image.shape == wanted.shape:
            assert np.abs(image.astype(int) - wanted).mean() < 6
    with output.open("rb") as stream:
        (channel,) = make_reader(stream).get_summary().channels.values()
    assert words in json.loads(channel.metadata["mcaptrack.parameters"])["encoded_again_because"]


def test_h265_with_b_frames_is_encoded_again_though_h265_is_asked_for(tmp_path):
    path = TRAPS["h265 with B-frames"][0](tmp_path)
    video = open_video(path, VideoOptions(image_format="h265"))
    assert (video.format, video.why_transcode) == ("h264", "it has B-frames")


def test_h264_alone_is_h264_alone(tmp_path):
    path = made("a.webm", codec="libvpx-vp9", options={"g": "10"}, size=(67, 51))(tmp_path)
    video = open_video(path, VideoOptions(image_format="h264"))
    assert (video.format, video.why_transcode) == ("h264", "it is VP9, not H.264")
    assert (video.width_px, video.height_px) == (68, 52)
    still = open_video(path, VideoOptions(image_format="png"))
    assert (still.width_px, still.height_px, still.why_transcode) == (67, 51, "")


def test_a_stream_without_times_needs_a_rate_and_is_passed_on_with_one(tmp_path):
    path = made("a.h264", options=X264)(tmp_path)
    with pytest.raises(
        McaptrackError, match=r"a\.h264 has no times of its own; give the frames per second with `fps=`"
    ):
        ingest(path, tmp_path / "a.mcap", IngestOptions())
    report = ingest(path, tmp_path / "a.mcap", IngestOptions(fps=Fraction(10)))
    assert report.remarks == []
    assert len(by_the_stock_library(tmp_path / "a.mcap")) == 20


def test_parameter_sets_that_stand_at_the_beginning_alone_are_put_before_every_key_picture(tmp_path):
    path = made("whole.h264", options=X264)(tmp_path)
    units = path.read_bytes().split(b"\x00\x00\x01")
    kept = [unit for number, unit in enumerate(units) if number < 4 or (unit[:1] and unit[0] & 31 not in (7, 8))]
    assert len(kept) < len(units)
    (tmp_path / "a.h264").write_bytes(b"\x00\x00\x01".join(kept))
    report = ingest(tmp_path / "a.h264", tmp_path / "a.mcap", IngestOptions(fps=Fraction(10)))
    assert report.remarks == []
    images, _ = by_ffmpeg(path)
    messages = by_the_stock_library(tmp_path / "a.mcap")
    for number in (0, 10):
        alone = decoder("h264")
        (image,) = shown(alone, messages[number][1].data) + shown(alone, None)
        np.testing.assert_array_equal(image, images[number])


@pytest.mark.parametrize(
    ("codec", "options", "pixels"),
    [
        ("libx264", X264, "yuv420p"),
        ("libx264", {"bf": "2", "g": "10"}, "yuv420p"),
        ("mjpeg", {}, "yuvj420p"),
        ("mpeg4", {"bf": "2"}, "yuv420p"),
    ],
)
def test_avi_slots_that_are_empty_take_their_time_and_are_no_loss(tmp_path, codec, options, pixels):
    path = tmp_path / "a.avi"
    slots = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 13, 14, 15, 16, 17, 18, 19, 20]
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 48, pixels
        for slot in [*slots, None]:
            frame = None
            if slot is not None:
                frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 10 * slot, np.uint8), format="bgr24")
                frame.pts, frame.time_base = slot, Fraction(1, 10)
            for packet in stream.encode(frame):
                container.mux(packet)
    video = open_video(path)
    times = [picture.t_ns // 100_000_000 for picture in video.pictures()]
    assert video.lost == []
    assert len(times) == len(slots)
    late = int(options.get("bf", 0))  # so many pictures are decoded before those that are shown before them
    assert sum(a != b for a, b in zip(times, slots, strict=True)) <= late


CUT = {
    "mkv": ("a.mkv", {}, {"options": X264}),
    "webm": ("a.webm", {}, {"codec": "libvpx-vp9", "options": {"g": "10"}}),
    "mp4 with its index first": ("a.mp4", {"movflags": "faststart"}, {"options": X264}),
    "fragmented mp4": ("a.mp4", {"movflags": "frag_keyframe+empty_moov"}, {"options": X264}),
}


@pytest.mark.parametrize("image_format", one_in(2, ["auto", "jpeg"]))
@pytest.mark.parametrize(("name", "flags", "clip"), CUT.values(), ids=CUT)
def test_of_a_file_that_was_cut_off_what_is_whole_is_kept_and_the_rest_is_said_to_be_lost(
    tmp_path, name, flags, clip, image_format
):
    whole, path = tmp_path / ("whole" + name[1:]), tmp_path / name
    write_clip(whole, frames=60, size=(160, 120), **clip)
    cut(whole, path, 0, options=flags)
    images, _ = by_ffmpeg(whole)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.58)])
    code, _, err = call("ingest", path, "-o", tmp_path / "a.mcap", "--image-format", image_format)
    assert code == 3
    assert "lost: " in err
    messages = by_the_stock_library(tmp_path / "a.mcap")
    assert 5 < len(messages) < 60
    if image_format == "auto":
        one = decoder("vp9" if name.endswith("webm") else "h264")
        for (_, video), wanted in zip(messages, images, strict=False):
            (image,) = shown(one, video.data)
            np.testing.assert_array_equal(image, wanted)


@pytest.mark.parametrize("image_format", ["h264", "jpeg"])
def test_quality_is_a_trade_for_size(tmp_path, image_format):
    path = made("a.mp4", options={"bf": "2"}, size=(160, 120))(tmp_path)
    steps = (1, 20, 51) if image_format == "h264" else (100, 60, 5)
    sizes = [
        sum(len(p.data) for p in open_video(path, VideoOptions(image_format=image_format, quality=q)).pictures())
        for q in steps
    ]
    assert sizes[0] > sizes[1] > sizes[2]


def test_a_quality_that_is_asked_for_is_given_though_the_stream_could_be_passed_on(tmp_path):
    video = open_video(made("a.mp4", options=X264)(tmp_path), VideoOptions(quality=30))
    assert video.why_transcode == "a quality was asked for"


@pytest.mark.parametrize("interval_s", [0.3, 1.0, 2.5])
def test_key_pictures_are_as_close_as_asked_whatever_the_times(tmp_path, interval_s):
    path = tmp_path / "a.mkv"
    times = np.cumsum([0] + [40, 40, 40, 400, 40, 900, 40] * 12).tolist()
    write_clip(path, frames=len(times), options={"bf": "2"}, times_ms=times)
    found = list(open_video(path, VideoOptions(keyframe_interval_s=interval_s)).pictures())
    assert [picture.t_ns for picture in found] == [ms * 1_000_000 for ms in times]
    keys = [p.t_ns / 1e9 for p in found if CODECS["h264"].inspect(p.data).is_key]
    before = {p.t_ns / 1e9: q.t_ns / 1e9 for p, q in zip(found[1:], found, strict=False)}
    # The picture before each key picture, and the last one, are closer to the last key picture than the interval.
    ends = [*(before[key] for key in keys[1:]), found[-1].t_ns / 1e9]
    assert all(end - key < interval_s + 1e-9 for key, end in zip(keys, ends, strict=True))
    assert len(keys) > 2


def test_a_longer_interval_lets_a_stream_with_few_key_pictures_pass(tmp_path):
    path = made("a.mp4", options={"bf": "0", "g": "60"}, frames=40)(tmp_path)
    assert open_video(path).why_transcode == "its key frames are more than 2 s apart"
    assert open_video(path, VideoOptions(keyframe_interval_s=5)).why_transcode == ""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not let a process choose its cores")
def test_one_core_or_all_the_bytes_are_the_same(tmp_path):
    path = made("a.mp4", options={"bf": "2"}, size=(320, 240))(tmp_path)
    code = (
        "import os, sys, hashlib\nfrom pathlib import Path\n"
        "if sys.argv[2] == 'one': os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "from mcaptrack.sources.video import open_video\n"
        "total = hashlib.sha256()\n"
        "for picture in open_video(Path(sys.argv[1])).pictures(): total.update(picture.data)\n"
        "print(total.hexdigest())\n"
    )
    run = [
        subprocess.run([sys.executable, "-c", code, path, n], check=True, capture_output=True) for n in ("one", "all")
    ]
    assert run[0].stdout == run[1].stdout
    assert len(run[0].stdout.strip()) == len(hashlib.sha256().hexdigest())


def vp9_header(bits):
    text = bits.replace(" ", "")
    return int(text.ljust(8 * -(-len(text) // 8), "0"), 2).to_bytes(-(-len(text) // 8), "big")


@pytest.mark.parametrize(
    ("matrix", "is_full", "pixels"),
    [
        (1, False, "yuv420p"), (5, False, "yuv420p"), (1, True, "yuvj420p"), (9, False, "yuv420p10le"),
        (1, False, "yuv444p"),
    ],
)  # fmt: skip
def test_colours_stay_what_they_are_whatever_the_numbers_mean(tmp_path, matrix, is_full, pixels):
    """BT.709, BT.601 and BT.2020, limited and full range."""
    path, colours = tmp_path / "a.mp4", ((30, 60, 200), (200, 160, 40))
    image = np.repeat(np.array(colours, np.uint8), 64, axis=0)[None].repeat(96, axis=0)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10, options={"bf": "2"})
        stream.width, stream.height, stream.pix_fmt = 128, 96, pixels
        stream.codec_context.colorspace, stream.codec_context.color_range = matrix, 2 if is_full else 1
        for _ in range(3):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            ranges = {"dst_colorspace": matrix, "dst_color_range": 2 if is_full else 1}
            container.mux(stream.encode(frame.reformat(format=pixels, **ranges)))
        container.mux(stream.encode(None))
    video = open_video(path)
    assert video.why_transcode != ""
    one = decoder("h264")
    (seen,) = shown(one, next(video.pictures()).data)
    for at, colour in zip((32, 96), colours, strict=True):
        assert np.abs(seen[48, at].astype(int) - colour).max() <= 6


def several(path, *counts, cover=False):
    """A file with videos of these numbers of pictures; ``cover``: the first is an attached cover picture."""
    with av.open(str(path), "w") as container:
        streams = []
        for count in counts:
            is_still = count == 1
            stream = container.add_stream("mjpeg" if is_still else "libx264", rate=10, options={} if is_still else X264)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p" if is_still else "yuv420p"
            streams.append(stream)
        if cover:
            streams[0].disposition = av.stream.Disposition.attached_pic.value  # PyAV 17 takes nothing but a number
        for stream, count in zip(streams, counts, strict=True):
            for number in range(count):
                frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 9 * number, np.uint8), format="bgr24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
    return path


H264, STILL = "(h264, 64x48)", "(mjpeg, 64x48, a still picture)"
#: Numbers of pictures, the stream that is asked for, the pictures that are read, and what is said of the choice.
STREAMS = {
    "both move": ((12, 9), None, 12, f"0 {H264}, 1 {H264}; 0 is taken; `stream=1` takes the other"),
    "the second is wanted": ((12, 9), 1, 9, f"0 {H264}, 1 {H264}; 1 is taken"),
    "the first is a still": ((1, 9), None, 9, f"0 {STILL}, 1 {H264}; 1 is taken"),
    "the last is a still": ((9, 1), None, 9, f"0 {H264}, 1 {STILL}; 0 is taken"),
    "a still is wanted": ((1, 9), 0, 1, f"0 {STILL}, 1 {H264}; 0 is taken"),
    "only stills": ((1, 1), None, 1, f"0 {STILL}, 1 {STILL}; 0 is taken"),
}


@pytest.mark.parametrize("end", [".mkv", ".mp4"])
@pytest.mark.parametrize(("counts", "stream", "pictures", "choice"), STREAMS.values(), ids=STREAMS)
def test_of_several_videos_the_first_that_moves_is_taken(tmp_path, end, counts, stream, pictures, choice):
    path = several(tmp_path / f"a{end}", *counts)
    report = ingest(path, tmp_path / "a.mcap", IngestOptions(stream=stream))
    assert report.messages == {"/camera/video": pictures}
    text = f"{path} holds 2 videos, {choice}"
    warned = [text] if "takes the other" in choice else []  # something that moves is left out, and nobody chose
    assert [notice.message for notice in report.warnings] == warned
    assert warned or text in report.remarks


def test_a_stream_that_is_not_there_is_refused_and_of_a_folder_changes_nothing(tmp_path):
    with pytest.raises(McaptrackError, match=r"has no video stream 2 \(`stream=`\); there is 0 to 1"):
        ingest(several(tmp_path / "a.mkv", 12, 9), tmp_path / "a.mcap", IngestOptions(stream=2))
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images/1.png"), np.zeros((48, 64, 3), np.uint8))
    with collected() as warnings:
        ingest(tmp_path / "images", tmp_path / "b.mcap", IngestOptions(stream=0, fps=Fraction(10)))
    assert [notice.code for notice in warnings] == ["option-not-used"]


def test_a_cover_picture_is_no_video(tmp_path):
    report = ingest(several(tmp_path / "a.mp4", 1, 9, cover=True), tmp_path / "a.mcap", IngestOptions())
    assert (report.messages, report.remarks) == ({"/camera/video": 9}, [])


def test_vp9_headers_by_hand():
    """Frame marker, profile 0, nothing from before, inter or not, shown, resilient; then as in 6.2 and 7.2 of VP9."""
    inspect = CODECS["vp9"].inspect
    size = f"{640 - 1:016b} {360 - 1:016b}"
    key = inspect(vp9_header(f"10 00 0 0 1 0 {0x498342:024b} 001 0 {size}"))
    assert (key.pictures, key.is_key, key.size) == (1, True, (640, 360))
    references = "11111111 0000 0010 0100"
    same = inspect(vp9_header(f"10 00 0 1 1 0 00 {references} 1 {size}"))
    assert (same.pictures, same.is_key, same.size) == (1, False, None)
    other = inspect(vp9_header(f"10 00 0 1 1 1 {references} 000 {size}"))
    assert (other.pictures, other.is_key, other.size) == (1, False, (640, 360))
    hidden = inspect(vp9_header(f"10 00 0 1 0 0 1 00 {0x498342:024b} 11111111 {size}"))
    assert (hidden.pictures, hidden.is_key, hidden.size) == (0, False, (640, 360))
    again = inspect(vp9_header("10 00 1 000"))
    assert (again.pictures, again.is_key) == (1, False)


def test_vp9_superframes_are_taken_apart_as_ffmpeg_does(tmp_path):
    with av.open(str(made("a.webm", codec="libvpx-vp9", options={"g": "10"})(tmp_path))) as container:
        stream = container.streams.video[0]
        one, two = [bytes(packet) for packet in container.demux(stream) if packet.size][:2]
        marker = bytes([0b110_01_001])  # two frames, their sizes in two bytes each
        index = marker + len(one).to_bytes(2, "little") + len(two).to_bytes(2, "little") + marker
        split = BitStreamFilterContext("vp9_superframe_split", stream).filter(av.Packet(one + two + index))
        assert [bytes(part) for part in split] == [one, two]
    unit = CODECS["vp9"].inspect(one + two + index)
    assert (unit.pictures, unit.is_key, unit.size) == (2, True, (64, 48))
    assert CODECS["vp9"].inspect(two + two + index).is_key is False


@pytest.mark.parametrize("name", ["a.mp4", "a.webm", "a.avi"])
def test_a_file_with_bytes_that_changed_is_read_or_refused_in_a_line(tmp_path, name):
    path = tmp_path / name
    write_clip(path, **({"codec": "libvpx-vp9", "options": {"g": "10"}} if name == "a.webm" else {"options": X264}))
    whole, rng = path.read_bytes(), np.random.default_rng(3)
    outcomes = set()
    for _ in range(25):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 5).tolist():
            data[at] = int(rng.integers(0, 256))
        path.write_bytes(data)
        try:
            outcomes.add(len(list(open_video(path).pictures())) <= 40)
        except McaptrackError as error:
            outcomes.add(str(error).count("\n") == 0)
    assert outcomes == {True}


@given(
    st.sampled_from(sorted(CODECS)), st.binary(max_size=60), st.sampled_from([b"", b"\0\0\1", b"\0\0\1\x67", b"\x0a"])
)
def test_bytes_of_strangers_are_no_key_picture_or_one_but_never_an_accident(name, data, start):
    codec = CODECS[name]
    for payload in (start + data, data + start, data + start + data):
        head = codec.read_head(payload)
        unit = codec.inspect(payload)
        assert unit.pictures >= 0
        assert head.has_picture or not head.is_key
        codec.with_parameter_sets(payload, unit.sets)
