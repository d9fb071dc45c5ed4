"""Any picture of a log: the right one, and for the decoding of one group of pictures at most."""

from __future__ import annotations

import json
from fractions import Fraction

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.pipeline.pictures import KeptPictures
from mcaptrack.schema import Frame
from mcaptrack.sources.ingest import IngestOptions, ingest
from mcaptrack.sources.pictures import Pictures
from mcaptrack.sources.video import EncodedPicture, H264Encoder, VideoOptions, decode_gray, open_video
from tests.commands import printed
from tests.worlds import SVT, X265, write_clip

TOPIC = "/camera/video"
COUNT, GROUP = 60, 10
X264 = {"bf": "0", "g": "10", "x264-params": "scenecut=0"}
KINDS = {
    "h264": ({"options": X264}, {}),
    "h265": ({"codec": "libx265", "options": X265}, {"image_format": "h265"}),
    "vp9": ({"codec": "libvpx-vp9", "options": {"g": "10"}}, {}),
    "av1": ({"codec": "libsvtav1", "options": SVT, "size": (96, 80)}, {}),
    "jpeg": ({"options": X264}, {"image_format": "jpeg"}),
    "png": ({"options": X264}, {"image_format": "png"}),
}


@pytest.fixture(scope="module", params=KINDS)
def made(request, tmp_path_factory):
    """A log of 60 pictures in groups of 10, the pictures as FFmpeg decodes the clip, and how many one may cost."""
    folder = tmp_path_factory.mktemp(request.param)
    clip, options = KINDS[request.param]
    path = folder / ("a.webm" if request.param == "vp9" else "a.mkv")
    write_clip(path, frames=COUNT, **clip)
    ingest(path, folder / "a.mcap", IngestOptions(**options))
    with av.open(str(path)) as container:
        images = [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]
    return (
        folder / "a.mcap",
        images,
        1 if "image_format" in options and request.param != "h265" else GROUP,
        request.param,
    )


def is_same(frame, images, name):
    difference = np.abs(frame.rows.astype(int) - images[frame.index])
    return difference.mean() < 3 if name == "jpeg" else not difference.any()


def test_every_picture_alone_is_that_of_the_clip_for_one_group_at_most(made):
    path, images, most, name = made
    with log.read(path) as opened:
        for number in [0, 1, 9, 10, 11, 25, 39, 59]:
            pictures = Pictures(opened, TOPIC)
            (frame,) = pictures.frames([number])
            assert (frame.index, frame.t_ns) == (number, number * 100_000_000)
            assert is_same(frame, images, name)
            assert pictures.decoded == (number % GROUP + 1 if most > 1 else 1)


@settings(max_examples=15)
@given(numbers=st.sets(st.integers(0, COUNT - 1), max_size=12))
def test_any_pictures_are_those_of_the_clip_in_order_for_less_than_all_before_them(made, numbers):
    path, images, most, name = made
    with log.read(path) as opened:
        pictures = Pictures(opened, TOPIC)
        found = list(pictures.frames(numbers))
        assert [frame.index for frame in found] == sorted(numbers)
        assert all(is_same(frame, images, name) for frame in found)
        groups: dict[int, int] = {}
        for number in sorted(numbers):
            groups[number // most] = number % most + 1
        assert pictures.decoded == sum(groups.values())


def test_what_is_seen_at_a_time_is_the_last_picture_until_then(made):
    path, _, most, _ = made
    with log.read(path) as opened:
        pictures = Pictures(opened, TOPIC)
        found = pictures.at([250_000_000, 0, 299_999_999, 10**15, 3_000_000_000])
        assert [frame.index for frame in found] == [0, 2, 30, 59]
        assert pictures.decoded <= 4 * most
        assert [frame.index for frame in pictures.at([0], decode_gray)] == [0]
        (grey,) = pictures.frames([3], decode_gray)
        assert grey.rows.ndim == 2
        assert list(pictures.at([])) == []
        with pytest.raises(McaptrackError, match="/camera/video has 60 pictures, not 60"):
            list(pictures.frames([60]))


def foreign_log(path, topic, messages, image_format="h264"):
    """A log of others: messages are log time and data."""
    with log.create(path) as writer:
        schema = ("foxglove.CompressedVideo", "jsonschema", b"{}")
        channel = writer.add_channel(topic, schema, "json", {}, kind="media")
        for number, (t_ns, data) in enumerate(messages):
            stamp = {"sec": t_ns // 10**9, "nsec": t_ns % 10**9}
            words = {"timestamp": stamp, "frame_id": "a", "format": image_format, "data": list(data)}
            writer.add_message(channel, t_ns, number, json.dumps(words).encode())


def encoded(count=40, group=10):
    encoder = H264Encoder(64, 48, Fraction(10), key_every_s=group / 10)
    images = [np.full((48, 64, 3), 4 * (number % 40) + 30, np.uint8) for number in range(count)]
    return [encoder.encode(image) for image in images]


def shade(frame):
    return round((float(frame.rows.mean()) - 27.5) / 4)  # conversion to YUV and back takes a little


def test_parameter_sets_in_messages_of_their_own_are_found(tmp_path):
    """Some robots send them apart, just before the key picture, at its time."""
    messages = []
    for number, data in enumerate(encoded()):
        at = data.find(b"\x00\x00\x01\x65") if number % 10 == 0 else 0
        messages += [(number * 10**8, part) for part in (data[:at], data[at:]) if part]
    foreign_log(tmp_path / "a.mcap", "/v", messages)
    numbers = [at for at, (_, data) in enumerate(messages) if data[:5].find(b"\x67") < 0]
    with log.read(tmp_path / "a.mcap") as opened:
        for shown in (0, 9, 10, 25, 39):
            pictures = Pictures(opened, "/v")
            (frame,) = pictures.frames([numbers[shown]])
            assert shade(frame) == shown
            assert pictures.decoded <= 11


@pytest.mark.parametrize("is_open", [False, True])
@pytest.mark.parametrize("image_format", ["h264", "h265"])
def test_streams_with_b_frames_and_open_groups_that_others_recorded_are_read_too(tmp_path, image_format, is_open):
    """Against the rules of Foxglove, and found in logs: messages stand in the order of decoding."""
    options = {"bf": "2", "g": "10", "x264-params": f"scenecut=0:open-gop={int(is_open)}"}
    x265 = f"keyint=10:min-keyint=10:bframes=3:scenecut=0:open-gop={int(is_open)}:log-level=none"
    codec = "libx264" if image_format == "h264" else "libx265"
    write_clip(
        tmp_path / "a.ts", frames=40, codec=codec, options=options if image_format == "h264" else {"x265-params": x265}
    )
    with av.open(str(tmp_path / "a.ts")) as container:
        images = {frame.pts: frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)}
    with av.open(str(tmp_path / "a.ts")) as container:
        packets = [(packet.pts, bytes(packet)) for packet in container.demux(video=0) if packet.size]
    messages = [(number * 10**8, data) for number, (_, data) in enumerate(packets)]
    foreign_log(tmp_path / "a.mcap", "/v", messages, image_format)
    with log.read(tmp_path / "a.mcap") as opened:
        for number in (0, 1, 9, 10, 11, 12, 13, 25, 39):
            (frame,) = Pictures(opened, "/v").frames([number])
            np.testing.assert_array_equal(frame.rows, images[packets[number][0]])
        assert sorted(frame.index for frame in Pictures(opened, "/v").frames(range(40))) == list(range(40))


def test_messages_that_share_a_time_are_told_apart(tmp_path):
    foreign_log(tmp_path / "a.mcap", "/v", [(number // 2 * 10**8, data) for number, data in enumerate(encoded())])
    with log.read(tmp_path / "a.mcap") as opened:
        found = list(Pictures(opened, "/v").frames([3, 4, 18, 19, 20, 21]))
        assert [shade(frame) for frame in found] == [3, 4, 18, 19, 20, 21]


def test_a_stream_without_a_second_key_picture_is_decoded_from_the_first(tmp_path):
    foreign_log(tmp_path / "a.mcap", "/v", [(number * 10**8, data) for number, data in enumerate(encoded(700, 9000))])
    with log.read(tmp_path / "a.mcap") as opened:
        pictures = Pictures(opened, "/v")
        assert [f.index for f in pictures.frames([1, 699])] == [1, 699]
        assert pictures.decoded <= 702


@pytest.mark.parametrize("name", ["h264", "h265", "vp9", "av1"])
def test_a_recording_that_begins_within_a_group_is_shown_from_its_first_key_picture_on(tmp_path, name):
    clip, options = KINDS[name]
    path = tmp_path / ("a.webm" if name == "vp9" else "a.mkv")
    write_clip(path, frames=30, **clip)
    data = [picture.data for picture in open_video(path, VideoOptions(**options)).pictures()]
    with av.open(str(path)) as container:
        images = [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]
    foreign_log(tmp_path / "a.mcap", "/v", [(n * 10**8, part) for n, part in enumerate(data[7:])], name)
    with log.read(tmp_path / "a.mcap") as opened:
        found = list(Pictures(opened, "/v").frames(range(23)))
        assert [frame.index for frame in found] == list(range(3, 23))
        for frame in found:
            np.testing.assert_array_equal(frame.rows, images[7 + frame.index])
        assert list(Pictures(opened, "/v").frames([1])) == []
    seen = decode_gray(EncodedPicture(number, number, name, part) for number, part in enumerate(data[7:]))
    assert [frame.index for frame in seen] == list(range(3, 23))
    _, err = printed("detect", tmp_path / "a.mcap", "--topic", "/v", "--to", "/boxes")
    assert "/v: 3 of 23 messages were left out: a video has to begin with a key picture" in err
    with log.read(tmp_path / "a.mcap") as opened:
        assert opened.times("/boxes").tolist() == [number * 10**8 for number in range(3, 23)]


def test_a_picture_that_is_damaged_is_said(tmp_path):
    messages = [(number * 10**8, data) for number, data in enumerate(encoded())]
    messages[15] = (messages[15][0], messages[15][1][:5] + b"\xff" * 40)
    foreign_log(tmp_path / "a.mcap", "/v", messages)
    with log.read(tmp_path / "a.mcap") as opened, pytest.raises(McaptrackError, match=r"a\.mcap: /v at \d+ ns"):
        list(Pictures(opened, "/v").frames([15]))


# Pictures that are read twice: the same both times, decoded once if there is room for them, in a thread


def pictures() -> list[Frame]:
    """Noise that partly stays, in colour and in grey, of two sizes, with lines that lie apart in memory."""
    rng = np.random.default_rng(0)
    still = rng.integers(0, 256, (40, 64, 3)).astype(np.uint8)
    changed = [still.copy() for _ in range(4)]
    for n, image in enumerate(changed):
        image[10 : 10 + 5 * n, 20:40] = rng.integers(0, 256, (5 * n, 20, 3))
    rows = [still, *changed, still[:, ::2], still[..., 0], still]
    return [Frame(100 * n + 7, 2 * n, one) for n, one in enumerate(rows)]


class Decoder:
    """Decodes anew each time it is called; ``begun`` counts that."""

    def __init__(self) -> None:
        self.begun = 0

    def __call__(self):
        self.begun += 1
        for frame in pictures():
            yield frame._replace(rows=frame.rows.copy())


def check(found: list[Frame]) -> None:
    assert [frame[:2] for frame in found] == [frame[:2] for frame in pictures()]
    for frame, wanted in zip(found, pictures(), strict=True):
        np.testing.assert_array_equal(frame.rows, wanted.rows)


def test_pictures_are_decoded_once_and_the_same_each_time():
    decoder = Decoder()
    kept = KeptPictures(decoder)
    for _ in range(3):
        check(list(kept))
    assert decoder.begun == 1


def test_drawing_into_a_picture_changes_no_other():
    decoder = Decoder()
    kept = KeptPictures(decoder)
    for _ in range(2):
        for frame in kept:
            frame.rows[:] = 0
    check(list(kept))


@pytest.mark.parametrize(("max_bytes", "begun"), [(0, 2), (9_000, 2), (60_000, 1)])
def test_what_takes_too_much_memory_is_decoded_again(max_bytes, begun):
    """The first picture alone is 7,680 bytes of noise, all together are less than 60,000."""
    decoder = Decoder()
    kept = KeptPictures(decoder, max_bytes)
    check(list(kept))
    check(list(kept))
    assert decoder.begun == begun
    assert sum(one.difference.stored for one in kept._kept) <= max_bytes


def test_a_reading_that_was_left_is_begun_again():
    decoder = Decoder()
    kept = KeptPictures(decoder)
    next(iter(kept))
    check(list(kept))
    check(list(kept))
    assert decoder.begun == 2
