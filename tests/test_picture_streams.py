"""What pictures are is seen from their bytes: however a stream is packed and called, its pictures are the same."""

from __future__ import annotations

import io
import json
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import mcaptrack
from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import EncodedPicture, Recogniser, decode_gray
from tests.commands import call
from tests.logs import recorder
from tests.ros_messages import pixels, ros_writer
from tests.worlds import _own_priority

ENCODERS = {"h264": "libx264", "h265": "libx265", "vp9": "libvpx-vp9", "av1": "libsvtav1"}
COUNT, TOPIC = 24, "/cam/image_raw/ffmpeg"
PACKET = """std_msgs/Header header
int32 width
int32 height
string encoding
uint64 pts
uint8 flags
bool is_bigendian
uint8[] data
"""


def images() -> list[np.ndarray]:
    """Two people, red and blue, walk over a ground that is as bright as they are."""
    rng = np.random.default_rng(2)
    ground = np.clip(rng.normal((90, 140, 90), 3, (96, 128, 3)), 0, 255)
    out = []
    for number in range(COUNT):
        image = ground.copy()
        image[30:62, 10 + 4 * number : 22 + 4 * number] = (30, 30, 220)
        image[50:82, 110 - 4 * number : 122 - 4 * number] = (220, 60, 60)
        out.append(image.astype(np.uint8))
    return out


def encoded(name: str) -> list[bytes]:
    """Packets of a stream with start codes, and key pictures every second."""
    options = {
        "h264": {"tune": "zerolatency", "preset": "ultrafast", "x264-params": "repeat-headers=1:annexb=1"},
        "h265": {"preset": "ultrafast", "x265-params": "log-level=none:bframes=0:pools=1:repeat-headers=1:annexb=1"},
        "vp9": {"deadline": "realtime", "lag-in-frames": "0"},
        "av1": {"preset": "12", "svtav1-params": "pred-struct=1:lp=1"},
    }
    with _own_priority():
        context = av.CodecContext.create(ENCODERS[name], "w")
        context.width, context.height, context.pix_fmt = 128, 96, "yuv420p"
        context.time_base, context.framerate = Fraction(1, 10), Fraction(10)
        context.options = options[name] | {"g": "10"}
        packets = []
        for number, image in enumerate(images()):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts = number
            packets += [bytes(packet) for packet in context.encode(frame)]
        packets += [bytes(packet) for packet in context.encode(None)]
    assert len(packets) == COUNT
    return packets


def units(data: bytes) -> list[bytes]:
    return [part for part in data.replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1") if part]


def is_set(name: str, unit: bytes) -> bool:
    return unit[0] & 31 in (7, 8) if name == "h264" else unit[0] >> 1 & 63 in (32, 33, 34)


def with_lengths(data: bytes, size: int = 4) -> bytes:
    return b"".join(len(unit).to_bytes(size, "big") + unit for unit in units(data))


def without_sets(name: str, data: bytes) -> bytes:
    return b"".join(len(unit).to_bytes(4, "big") + unit for unit in units(data) if not is_set(name, unit))


def record(name: str, data: bytes) -> bytes:
    """The configuration record that FFmpeg writes into an MP4 file for this stream."""
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream(ENCODERS[name], rate=10)
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        options = {"h264": {}, "h265": {"x265-params": "log-level=none:pools=1"}}
        stream.codec_context.options = options[name]
        container.mux(stream.encode(av.VideoFrame.from_ndarray(images()[0], format="bgr24")))
        container.mux(stream.encode(None))
    whole = file.getvalue()
    at = whole.index(b"avcC" if name == "h264" else b"hvcC")
    size = int.from_bytes(whole[at - 4 : at], "big")
    found = bytearray(whole[at + 4 : at - 4 + size])
    own = [unit for unit in units(data) if is_set(name, unit)]
    # Its own parameter sets instead of those of the file.
    if name == "h264":
        sps, pps = own[:1], own[1:2]
        head = bytes([1, sps[0][1], sps[0][2], sps[0][3], 0xFF, 0xE1])
        return head + len(sps[0]).to_bytes(2, "big") + sps[0] + b"\1" + len(pps[0]).to_bytes(2, "big") + pps[0]
    arrays = b"".join(
        bytes([0x80 | unit[0] >> 1 & 63]) + b"\0\1" + len(unit).to_bytes(2, "big") + unit for unit in own[:3]
    )
    return bytes(found[:22]) + bytes([3]) + arrays


def written(path: Path, kind: str, called: str, payloads: list[bytes], topic: str = TOPIC) -> Path:
    """A recording of ROS 2 with these payloads: FFMPEGPacket, CompressedImage or CompressedVideo."""
    name = {"packet": "ffmpeg_image_transport_msgs/FFMPEGPacket", "image": "sensor_msgs/CompressedImage"}.get(kind)
    if kind == "packet":
        from tests.ros_messages import BAR

        more = BAR + "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
        more += BAR + "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
        ros = ros_writer(name, PACKET + more)
    with recorder(path) as writer:
        channel = None
        for number, data in enumerate(payloads):
            t_ns = 10**18 + number * 10**8
            if kind == "packet":
                values = (ros.header(t_ns), 128, 96, called, number, 0, False, pixels(data))
                content, encoding, schema = ros.pack(ros.new(name, *values)), "cdr", ros.kind
            elif kind == "image":
                ros = ros_writer(name)
                content = ros.pack(ros.new(name, ros.header(t_ns), called, pixels(data)))
                encoding, schema = "cdr", ros.kind
            else:
                fields = {"timestamp": {"sec": t_ns // 10**9, "nsec": t_ns % 10**9}, "format": called}
                content = json.dumps(fields | {"frame_id": "", "data": list(data)}).encode()
                encoding, schema = "json", None
            if channel is None:
                about = (schema.name, "ros2msg", schema.schema) if schema else None
                about = about or ("foxglove.CompressedVideo", "jsonschema", b"{}")
                channel = writer.add_channel(topic, about, encoding)
            writer.add_message(channel, t_ns, content, t_ns)
    return path


def frames(path: Path, topic: str = TOPIC) -> list[np.ndarray]:
    with log.read(path) as opened:
        found = list(Pictures(opened, topic).frames(range(opened.channel(topic).messages)))
        (last,) = Pictures(opened, topic).frames([found[-1].index])  # by itself, from a key picture before it
        np.testing.assert_array_equal(last.rows, found[-1].rows)
    return [frame.rows for frame in found]


#: What a record has of high profiles besides (ISO 14496-15, 5.3.3.1.2): 4:2:0, 9 bits, and no further sets.
HIGH = {"h264": b"\xfd\xf9\xf9\0", "h265": b""}
PACKED = {
    "start codes": lambda name, parts: parts,
    "lengths": lambda name, parts: [with_lengths(part) for part in parts],
    "lengths of two bytes": lambda name, parts: [with_lengths(part, 2) for part in parts],
    "a record, then lengths": lambda name, parts: [
        record(name, parts[0]) + HIGH[name] + without_sets(name, parts[0]),
        *[without_sets(name, part) for part in parts[1:]],
    ],
    "sets, then lengths": lambda name, parts: [with_lengths(parts[0]), *[without_sets(name, p) for p in parts[1:]]],
}


@pytest.mark.parametrize("packing", PACKED)
@pytest.mark.parametrize("name", ["h264", "h265"])
def test_nal_units_are_read_however_they_are_packed_and_called(tmp_path, name, packing):
    parts = encoded(name)
    wanted = frames(written(tmp_path / "plain.mcap", "video", name, parts))
    assert len(wanted) == COUNT
    packed = PACKED[packing](name, parts)
    others = {
        "packet": f"{ENCODERS[name]};yuv420p;bgr8;bgr8",
        "video": "h265" if name == "h264" else "h264",
        "image": "",
    }
    for kind, called in others.items():
        found = frames(written(tmp_path / f"{kind}.mcap", kind, called, packed))
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("called", ["", "h264", "jpeg", "libfoo"])
@pytest.mark.parametrize("name", ["vp9", "av1"])
def test_other_codecs_are_recognised_without_a_hint(tmp_path, name, called):
    parts = encoded(name)
    wanted = frames(written(tmp_path / "plain.mcap", "video", name, parts))
    np.testing.assert_array_equal(frames(written(tmp_path / "a.mcap", "packet", called, parts)), wanted)
    shown = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(int) for image in images()]
    assert max(np.abs(found.mean(-1) - image).mean() for found, image in zip(wanted, shown, strict=True)) < 30


def test_a_record_may_have_a_message_of_its_own(tmp_path):
    parts = encoded("h264")
    packed = [record("h264", parts[0]), *[without_sets("h264", part) for part in parts]]
    wanted = frames(written(tmp_path / "plain.mcap", "video", "h264", parts))
    path = written(tmp_path / "a.mcap", "video", "h264", packed)
    np.testing.assert_array_equal(frames(path), wanted)
    with log.read(path) as opened:
        pictures = Pictures(opened, TOPIC)
        assert len(list(pictures.frames([COUNT]))) == 1
        assert pictures.decoded <= 4  # from the last key picture on, not from the record


@pytest.mark.parametrize("called", ["h264", "mjpeg", "png", ""])
def test_still_images_are_recognised_whatever_they_are_called(tmp_path, called):
    parts = [cv2.imencode(".jpg", image)[1].tobytes() for image in images()]
    wanted = [cv2.imdecode(np.frombuffer(part, np.uint8), cv2.IMREAD_COLOR) for part in parts]
    for kind in ("packet", "video", "image"):
        np.testing.assert_array_equal(frames(written(tmp_path / f"{kind}.mcap", kind, called, parts)), wanted)


def test_wrong_names_and_other_packings_are_said_and_kept(tmp_path):
    path = written(tmp_path / "a.mcap", "packet", "hevc_nvenc", [with_lengths(part) for part in encoded("h264")])
    result = mcaptrack.detect(path)
    said = [notice.message for notice in result.warnings if notice.code == "pictures"]
    assert [text.removeprefix(f"{TOPIC}: pictures: ") for text in said] == [
        "they are called 'h265' and are H.264",
        "they are H.264 with lengths before its NAL units, as in MP4 files; it is read as with start codes (Annex B)",
    ]
    assert mcaptrack.info(path) is not None
    again = mcaptrack.run(path, tables=False)
    assert [notice.message for notice in again.warnings if notice.code == "pictures"] == said


def mp4_pieces() -> list[bytes]:
    """An MP4 file in fragments, cut before each."""
    file = io.BytesIO()
    with av.open(file, "w", format="mp4", options={"movflags": "frag_every_frame+empty_moov"}) as container:
        stream = container.add_stream("libx264", rate=10, options={"tune": "zerolatency"})
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        for image in images():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="bgr24")))
        container.mux(stream.encode(None))
    whole = file.getvalue()
    starts = [at - 4 for at in range(len(whole)) if whole.startswith(b"moof", at)]
    return [whole[: starts[0]], *[whole[a:b] for a, b in zip(starts, [*starts[1:], None], strict=True)]]


UNREAD = {
    "no parameter sets": (
        lambda: [without_sets("h264", part) for part in encoded("h264")],
        "with lengths before its NAL units, and the parameter sets (SPS, PPS) are missing",
    ),
    "pieces of a file": (mp4_pieces, "they are pieces of an MP4 file; `ingest` reads the whole file"),
    "a transport stream": (lambda: [b"\x47" + bytes(187) + b"\x47" + bytes(187)] * 8, "MPEG transport stream"),
    "no codec": (lambda: [b"\x13\x37" * 50] * 8, "begin with 13 37 13 37 13 37 13 37, as none of H.264, H.265, VP9"),
    "no key picture": (lambda: encoded("h264")[1:9], "a video has to begin with a key picture that has its parameter"),
}


@pytest.mark.parametrize("kind", ["packet", "video"])
@pytest.mark.parametrize(("payloads", "cause"), UNREAD.values(), ids=UNREAD)
def test_pictures_that_can_not_be_read_are_named_with_their_cause_and_exit_code_3(tmp_path, kind, payloads, cause):
    path = written(tmp_path / "a.mcap", kind, "h264", payloads())
    for _ in range(2):
        done = call("run", path, "--no-tables", "--json")
        assert done.code == 3, done.err
        (found,) = [text for text in json.loads(done.out)["warnings"] if text["code"] == "no-pictures"]
        assert f"{TOPIC}: no picture in its " in found["message"]
        assert cause.replace("`ingest`", "`mcaptrack ingest`") in found["message"] or cause in found["message"]
    if cause.startswith("a video has"):
        return
    with mcaptrack.open(path) as opened, pytest.raises(McaptrackError, match=f"{TOPIC}: no picture can be decoded: "):
        next(opened.frames(TOPIC))


@pytest.mark.parametrize("kind", ["image", "video"])
def test_a_message_without_data_costs_only_its_own_picture(tmp_path, kind):
    """Drivers publish empty messages where a frame was lost."""
    payloads = encoded("h264") if kind == "video" else [cv2.imencode(".png", image)[1].tobytes() for image in images()]
    at = 13
    path = written(
        tmp_path / "a.mcap", kind, "h264" if kind == "video" else "png", [*payloads[:at], b"", *payloads[at:]]
    )
    result = mcaptrack.detect(path, detector="knn")
    (said,) = [notice.message for notice in result.warnings if notice.code == "lost"]
    assert f"1 of {COUNT + 1} pictures can't be decoded and are left out" in said
    assert f"{TOPIC} at {10**18 + at * 10**8} ns: frame {at}: " in said
    with mcaptrack.open(path) as opened:
        t_ns = [picture.t_ns for picture in opened.frames(TOPIC, times=[10**18 + (at + 5) * 10**8])]
        assert t_ns == [10**18 + (at + 5) * 10**8]
        seen = [frame.t_ns for frame in opened.frames("detections")]
    assert sorted({10**18 + number * 10**8 for number in range(COUNT + 1)} - {*seen}) == [10**18 + at * 10**8]


BEGINNINGS = [b"", b"\0\0\1\x67", b"\0\0\0\1\x40\x01", b"\0\0\0\x02\x67", b"\1\x64\0\x0a\xff\xe1\0\2\x67\x64\1\0\1\x68"]
BEGINNINGS += [
    b"\xff\xd8\xff",
    b"\x89PNG\r\n\x1a\n",
    b"BM" + bytes(12) + b"\x28\0\0\0",
    b"\x12\0\x0a",
    b"\x82\x49\x83\x42",
]
BEGINNINGS += [b"\1" + bytes(20) + b"\7\1\x20\0\1\0\2\x40\x01", b"\0\0\0\x18ftypavif"]


@given(
    st.lists(st.tuples(st.sampled_from(BEGINNINGS), st.binary(max_size=40)), min_size=1, max_size=4),
    st.sampled_from(["h264", "h265", "av1", "vp9", "jpeg", "", "zstd", "x" * 100]),
    st.booleans(),
)
def test_whatever_bytes_are_they_are_recognised_or_their_cause_is_named(payloads, called, is_video):
    recogniser = Recogniser()
    for beginning, rest in payloads:
        name, data = recogniser.take(called, beginning + rest, is_video)
        assert isinstance(data, bytes)
        assert name in (called, "unread", "jpeg", "png", "bmp", "avif", *ENCODERS)
        picture = EncodedPicture(0, 0, name, data)
        try:
            list(decode_gray([picture]))
        except McaptrackError as error:
            assert "\n" not in str(error)
    assert all("\n" not in text for text in (recogniser.cause, *recogniser.notes))
