"""Messages that others recorded: written by rosbags, protobuf and json, with pixels that are known."""

from __future__ import annotations

import base64
import json
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given
from hypothesis import strategies as st

from mcaptrack import foxglove
from mcaptrack.errors import McaptrackError
from mcaptrack.sources.foreign import MessageType, picture_decoder
from mcaptrack.sources.video import PIXEL_FORMATS, EncodedPicture, PixelLayout, decode_gray
from tests.box_reading import boxes_of
from tests.ros_messages import BAR, STAMP_NS, VISION, pixels, ros_writer, vision

SEC, NSEC = divmod(STAMP_NS, 10**9)

# foxglove/schemas, ros1 and ros2: the same but for the name of the time.
FOXGLOVE = {
    "CompressedImage": "{time} timestamp\nstring frame_id\nuint8[] data\nstring format\n",
    "CompressedVideo": "{time} timestamp\nstring frame_id\nuint8[] data\nstring format\n",
    "RawImage": "{time} timestamp\nstring frame_id\nuint32 width\nuint32 height\nstring encoding\nuint32 step\nuint8[] data\n",
}


def gradient(height: int = 24, width: int = 32) -> np.ndarray:
    """A picture (H, W, 3) whose colours differ everywhere, blue green red."""
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 7 % 256, y * 9 % 256, (x * 3 + y * 5) % 256], axis=-1).astype(np.uint8)


def blue() -> np.ndarray:
    return gradient()[..., 0].copy()


def grey(image: np.ndarray) -> np.ndarray:
    """By ITU-R BT.601, which cameras and OpenCV keep to."""
    return image @ np.array([0.114, 0.587, 0.299])


PNG = cv2.imencode(".png", gradient())[1].tobytes()


def ros_compressed(data: bytes, words: str, ros1: bool) -> tuple[MessageType, bytes]:
    ros = ros_writer("sensor_msgs/CompressedImage", ros1=ros1)
    message = ros.new("sensor_msgs/CompressedImage", ros.header(), words, pixels(data))
    return ros.kind, ros.pack(message)


def ros_raw(image: np.ndarray, encoding: str, ros1: bool, step: int | None = None, big: int = 0, size=None):
    ros = ros_writer("sensor_msgs/Image", ros1=ros1)
    height, width = size or image.shape[:2]
    step = image.strides[0] if step is None else step
    message = ros.new("sensor_msgs/Image", ros.header(), height, width, encoding, big, step, pixels(image.tobytes()))
    return ros.kind, ros.pack(message)


def ros_foxglove(name: str, ros1: bool, *values) -> tuple[MessageType, bytes]:
    definition = FOXGLOVE[name].format(time="time" if ros1 else "builtin_interfaces/Time")
    if not ros1:
        definition += BAR + "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    ros = ros_writer(f"foxglove_msgs/{name}", definition, ros1)
    message = ros.new(f"foxglove_msgs/{name}", ros.new("builtin_interfaces/Time", SEC, NSEC), "eye", *values)
    return ros.kind, ros.pack(message)


def proto(message, name: str) -> tuple[MessageType, bytes]:
    message.timestamp.seconds, message.timestamp.nanos = SEC, NSEC
    return MessageType(*foxglove.schema_record(name), "protobuf"), message.SerializeToString()


def as_json(name: str, **fields) -> tuple[MessageType, bytes]:
    return MessageType(name, "jsonschema", b"{}", "json"), json.dumps(fields).encode()


B64 = base64.b64encode(PNG).decode()
JSON_STAMPS = {
    "sec nsec": {"sec": SEC, "nsec": NSEC},
    "secs nsecs": {"secs": SEC, "nsecs": NSEC},
    "sec nanosec": {"sec": SEC, "nanosec": NSEC},
    "floats": {"sec": float(SEC), "nsec": float(NSEC)},
    "text": "2023-11-14T22:13:20.123456789Z",
    "text with a zone": "2023-11-14T23:43:20.123456789+01:30",
}
COMPRESSED = {
    "protobuf": lambda: proto(CompressedImage(format="png", data=PNG), foxglove.IMAGE),
    "foxglove ros1": lambda: ros_foxglove("CompressedImage", True, pixels(PNG), "png"),
    "foxglove ros2": lambda: ros_foxglove("CompressedImage", False, pixels(PNG), "png"),
    "ros1": lambda: ros_compressed(PNG, "png", True),
    "ros2": lambda: ros_compressed(PNG, "bgr8; png compressed bgr8", False),
    "ros2 in json": lambda: as_json(
        "sensor_msgs/CompressedImage",
        header={"stamp": {"sec": SEC, "nanosec": NSEC}, "frame_id": "eye"},
        format="png",
        data=list(PNG),
    ),
} | {
    f"json, {words}": lambda stamp=stamp: as_json("foxglove.CompressedImage", timestamp=stamp, data=B64, format="png")
    for words, stamp in JSON_STAMPS.items()
}


def bright(kind: MessageType, payload: bytes) -> np.ndarray:
    picture = picture_decoder(kind)(payload)
    (frame,) = decode_gray([EncodedPicture(5, 0, picture.format, picture.data, picture.layout)])
    assert (frame.t_ns, frame.index) == (5, 0)
    return frame.rows


class TestCompressed:
    @pytest.mark.parametrize("write", COMPRESSED.values(), ids=COMPRESSED)
    def test_stamp_and_pixels_arrive(self, write):
        kind, payload = write()
        picture = picture_decoder(kind)(payload)
        assert (picture.stamp_ns, picture.format, picture.data) == (STAMP_NS, "png", PNG)
        assert np.abs(bright(kind, payload) - grey(gradient())).max() < 2  # decoders of PNG cut fractions off

    FORMATS = {
        "jpeg": "jpeg",
        "rgb8; jpeg compressed bgr8": "jpeg",
        "mono16; png compressed": "png",
        "webp": "webp",
        "h264": "h264",
        "H.264": "h264",
        "h264_nvenc": "h264",
        "libx264;yuv420p;bgr8;bgr8": "h264",
        "avc1.64001f": "h264",
        "hevc": "h265",
        "h265_vaapi": "h265",
        "hvc1": "h265",
        "libx265;yuv420p": "h265",
        "libvpx-vp9": "vp9",
        "vp09.00.10.08": "vp9",
        "libsvtav1": "av1",
        "av01.0.04M.08": "av1",
        "": "",
    }

    @pytest.mark.parametrize(("words", "meant"), FORMATS.items())
    def test_names_of_formats_in_the_wild(self, words, meant):
        kind, payload = ros_compressed(b"\0\0\1\x65 a part", words, ros1=False)
        assert picture_decoder(kind)(payload).format == meant

    def test_video_of_all_kinds(self):
        for kind, payload in (
            proto(CompressedVideo(format="h264", data=b"\0\0\0\1"), foxglove.VIDEO),
            ros_foxglove("CompressedVideo", True, pixels(b"\0\0\0\1"), "h264"),
            ros_foxglove("CompressedVideo", False, pixels(b"\0\0\0\1"), "h264"),
            as_json("foxglove.CompressedVideo", timestamp=JSON_STAMPS["text"], data="AAAAAQ==", format="h264"),
        ):
            picture = picture_decoder(kind)(payload)
            assert (picture.stamp_ns, picture.format, picture.data) == (STAMP_NS, "h264", b"\0\0\0\1")

    def test_a_definition_that_leaves_out_a_standard_type_has_that_of_ros(self):
        kind, payload = ros_compressed(PNG, "png", False)
        with pytest.raises(McaptrackError, match="no definition of it that fits"):
            picture_decoder(kind._replace(schema=b""))
        short = kind._replace(
            name="sensor_msgs/CompressedImage", schema=b"std_msgs/Header header\nstring format\nuint8[] data\n"
        )
        assert picture_decoder(short)(payload).data == PNG  # the definition leaves out what a header is

    def test_what_is_refused_at_once(self):
        with pytest.raises(
            McaptrackError, match=r"it holds std_msgs/msg/String, not pictures; foxglove\.CompressedVideo, .* are read"
        ):
            picture_decoder(MessageType("std_msgs/msg/String", "ros2msg", b"string data", "cdr"))
        with pytest.raises(
            McaptrackError, match="in the encoding 'flatbuffer' is not read; protobuf, json, ros1, cdr are"
        ):
            picture_decoder(MessageType("foxglove.RawImage", "flatbuffer", b"", "flatbuffer"))
        with pytest.raises(McaptrackError, match="the log has no definition of it"):
            picture_decoder(MessageType("foxglove_msgs/msg/RawImage", "ros2msg", b"", "cdr"))
        with pytest.raises(McaptrackError, match="definition of it can't be understood"):
            picture_decoder(MessageType("sensor_msgs/msg/Image", "ros2msg", b"for while 3", "cdr"))
        with pytest.raises(McaptrackError, match="depth in the format"):
            kind, payload = ros_compressed(bytes(40), "16UC1; compressedDepth rvl", False)
            picture_decoder(kind)(payload)


RAW = {
    "rgb8": (lambda: np.flip(gradient(), axis=2), lambda: grey(gradient())),
    "BGR8": (gradient, lambda: grey(gradient())),
    "mono16": (lambda: gradient()[..., 0].astype("<u2") * 257, lambda: gradient()[..., 0]),
}


class TestRaw:
    @pytest.mark.parametrize(("encoding", "image", "wanted"), [(e, *both) for e, both in RAW.items()], ids=RAW)
    def test_every_encoding_by_every_writer(self, encoding, image, wanted):
        image, wanted = np.ascontiguousarray(image()), wanted()
        height, width = image.shape[:2]
        step, data = image.strides[0], image.tobytes()
        fields = {"width": width, "height": height, "encoding": encoding, "step": step}
        written = [
            ros_raw(image, encoding, ros1=True),
            ros_raw(image, encoding, ros1=False),
            proto(RawImage(**fields, data=data), "foxglove.RawImage"),
            as_json("foxglove.RawImage", timestamp=JSON_STAMPS["text"], data=base64.b64encode(data).decode(), **fields),
            ros_foxglove("RawImage", False, width, height, encoding, step, pixels(data)),
            ros_foxglove("RawImage", True, width, height, encoding, step, pixels(data)),
        ]
        for kind, payload in written:
            assert picture_decoder(kind)(payload).stamp_ns == STAMP_NS
            rows = bright(kind, payload)
            assert rows.shape == wanted.shape
            assert np.abs(rows.astype(float) - wanted).max() <= 1, kind

    def test_rows_may_be_filled_up_but_for_the_last(self):
        image = gradient()
        padded = np.zeros((24, 40, 3), np.uint8)
        padded[:, :32] = image
        kind, payload = ros_raw(padded, "bgr8", False, size=(24, 32))
        assert np.abs(bright(kind, payload) - grey(image)).max() <= 1
        cut = padded.tobytes()[: -8 * 3]
        kind, payload = proto(RawImage(width=32, height=24, encoding="bgr8", step=120, data=cut), "foxglove.RawImage")
        assert np.abs(bright(kind, payload) - grey(image)).max() <= 1

    def test_numbers_of_two_bytes_keep_their_order(self):
        image = (gradient()[..., 0].astype(np.uint16) * 257).astype(">u2")
        kind, payload = ros_raw(image, "mono16", False, big=1)
        np.testing.assert_array_equal(bright(kind, payload), gradient()[..., 0])

    def test_distances_that_are_not_known_are_dark(self):
        kind, payload = ros_raw(np.array([[np.nan, np.inf, -np.inf, 0.5]], "<f4"), "32FC1", False)
        assert bright(kind, payload).tolist() == [[0, 255, 0, 128]]

    LIES = {
        "wider": (2**32 - 1, 24, 96),
        "higher": (32, 2**32 - 1, 96),
        "both": (2**32 - 1, 2**32 - 1, 0),
        "a step of forever": (32, 24, 2**32 - 1),
        "a step under a row": (32, 24, 95),
        "nothing": (0, 24, 96),
        "one row more": (32, 25, 96),
    }

    @pytest.mark.parametrize("size", LIES.values(), ids=LIES)
    @pytest.mark.parametrize("encoding", ["bgr8", "nv12"])
    def test_sizes_that_lie_are_said(self, size, encoding):
        width, height, step = size
        message = RawImage(width=width, height=height, encoding=encoding, step=step, data=gradient().tobytes())
        if encoding == "nv12":  # of one byte a pixel: there is room for more of them
            message.data = message.data[:1000]
            message.step = 31 if step == 95 else step
        kind, payload = proto(message, "foxglove.RawImage")
        with pytest.raises(McaptrackError, match=r"frame 0: \d+ bytes don't hold \d+ x \d+ pixels"):
            bright(kind, payload)

    def test_encodings_that_are_not_read_are_said(self):
        kind, payload = ros_raw(gradient(), "bayer_rggb12p", False)
        with pytest.raises(
            McaptrackError, match=r"frame 0: pixels of the encoding 'bayer_rggb12p' are not read; mono8, .* are"
        ):
            bright(kind, payload)

    @given(
        st.sampled_from([*PIXEL_FORMATS]) | st.text(max_size=8),
        st.binary(max_size=200),
        st.tuples(*[st.integers(0, 9) | st.integers(-(2**63), 2**63 - 1)] * 3),
        st.booleans(),
    )
    def test_whatever_pixels_are_they_are_shown_or_refused(self, encoding, data, size, big):
        try:
            (frame,) = decode_gray([EncodedPicture(0, 0, encoding, data, PixelLayout(*size, big))])
        except McaptrackError as error:
            assert "\n" not in str(error)
        else:
            assert frame.rows.shape == (size[1], size[0])
            assert frame.rows.dtype == np.uint8


class TestBoxes:
    @pytest.mark.parametrize("layout", VISION)
    def test_boxes_by_hand(self, layout):
        boxes = [
            (100.0, 50.0, 20.0, 40.0, 0.0, [(3, 0.25), (7, 0.75)]),
            (10.0, 10.0, 4.0, 8.0, 0.0, []),
            (10.0, 10.0, 4.0, 8.0, np.pi / 2, [(2, 0.5)]),
        ]
        kind, payload = vision(layout, boxes)
        found = boxes_of(kind, payload)
        np.testing.assert_allclose([box[:4] for box in found], [[90, 30, 20, 40], [8, 6, 4, 8], [6, 8, 8, 4]])
        np.testing.assert_array_equal([box.score for box in found], [0.75, np.nan, 0.5])
        assert [box.class_name for box in found] == ["7", "", "2"]

    def test_a_message_without_boxes_is_a_frame_without_rows(self):
        kind, payload = vision("v4", [])
        assert len(boxes_of(kind, payload)) == 0

    @pytest.mark.parametrize("box", [(np.nan, 0.0, 1.0, 1.0), (0.0, np.inf, 1.0, 1.0), (0.0, 0.0, -1.0, 1.0)])
    def test_boxes_that_can_not_be_are_said(self, box):
        kind, payload = vision("v4", [(*box, 0.0, [])])
        with pytest.raises(McaptrackError, match="a box can't be"):
            boxes_of(kind, payload)

    def test_other_channels_are_refused(self):
        with pytest.raises(
            McaptrackError, match=r"/t holds x, not detections; vision_msgs/Detection2DArray, .* are read"
        ):
            boxes_of(MessageType("x", "jsonschema", b"{}", "json"), b"{}")


def reader_of_boxes(kind: MessageType):
    return partial(boxes_of, kind)


def kinds() -> dict[str, tuple]:
    """A decoder of every kind, with a payload that is well formed."""
    made = {name: (picture_decoder, *write()) for name, write in COMPRESSED.items() if "json," not in name}
    made["json"] = (picture_decoder, *COMPRESSED["json, text"]())
    made["raw protobuf"] = (
        picture_decoder,
        *proto(RawImage(width=1, height=1, encoding="mono8", data=b"1"), "foxglove.RawImage"),
    )
    made["raw ros1"] = (picture_decoder, *ros_raw(gradient(2, 2), "bgr8", True))
    made["raw ros2"] = (picture_decoder, *ros_raw(gradient(2, 2), "bgr8", False))
    for layout in VISION:
        made[f"boxes {layout}"] = (reader_of_boxes, *vision(layout, [(1.0, 1.0, 1.0, 1.0, 0.0, [(1, 0.5)])]))
    made["boxes json"] = (reader_of_boxes, *as_json("vision_msgs/msg/Detection2DArray", detections=[]))
    return {name: (make(kind), payload) for name, (make, kind, payload) in made.items()}


DECODERS = kinds()
JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(
        st.sampled_from(["timestamp", "data", "format", "sec", "nsec", "header", "stamp", "detections", "bbox", "center", "x", "y", "results", "width", "height", "step", "encoding"]), inner, max_size=6
    ),
    max_leaves=20,
).map(lambda value: json.dumps(value).encode())  # fmt: skip


class TestStrangers:
    """No bytes whatever make a decoder fail otherwise than by saying so in one line."""

    def holds(self, decode, payload: bytes) -> None:
        try:
            decode(payload)
        except McaptrackError as error:
            assert "\n" not in str(error)
            assert len(str(error)) < 400

    @pytest.mark.parametrize("name", DECODERS)
    @given(payload=st.binary(max_size=120))
    def test_random_bytes(self, name, payload):
        self.holds(DECODERS[name][0], payload)

    @pytest.mark.parametrize("name", DECODERS)
    @given(data=st.data())
    def test_good_messages_with_bytes_changed_or_cut(self, name, data):
        decode, payload = DECODERS[name]
        changed = bytearray(payload)
        for _ in range(data.draw(st.integers(1, 3))):
            changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
        self.holds(decode, bytes(changed[: data.draw(st.integers(0, len(changed)))]))

    @pytest.mark.parametrize("name", ["json", "ros2 in json", "boxes json"])
    @given(payload=JSON_VALUES)
    def test_json_of_other_shapes(self, name, payload):
        self.holds(DECODERS[name][0], payload)

    @given(
        definition=st.text(max_size=60)
        | st.lists(
            st.sampled_from(["uint8", "data", "[]", "\n", "=" * 80, "MSG: a/B", "3", "string", "="]), max_size=12
        ).map(" ".join),
        payload=st.binary(max_size=20),
    )
    def test_definitions_of_strangers(self, definition, payload):
        for encoding in (("ros2msg", "cdr"), ("ros1msg", "ros1"), ("ros2idl", "cdr")):
            try:
                decode = picture_decoder(
                    MessageType(
                        "foxglove_msgs/msg/RawImage", encoding[0], definition.encode("utf-8", "replace"), encoding[1]
                    )
                )
            except McaptrackError as error:
                assert "\n" not in str(error)
            else:
                self.holds(decode, payload)


def test_the_pictures_of_a_real_log_are_read(data):
    from mcaptrack import log
    from mcaptrack.sources import foreign

    with log.read(Path(data) / "mcap/images/custom-camera-model.mcap") as opened:
        found = list(foreign.pictures(opened, "/image/compressed"))
    assert len(found) == 10
    for message, picture in found:
        assert cv2.imdecode(pixels(picture.data), cv2.IMREAD_COLOR).shape[2] == 3
        said = json.loads(message.payload)["timestamp"]
        assert picture.stamp_ns == said["sec"] * 10**9 + said["nsec"]
