"""People hidden in pictures: all of them, also while they are missed, and nothing else is changed."""

from __future__ import annotations

import base64
import json
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

import mcaptrack
from mcaptrack import foxglove, log
from mcaptrack.extensions.render.blur.people import hide
from mcaptrack.extensions.render.blur.recording import picture_replacer
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.sources.foreign import MessageType, picture_decoder
from mcaptrack.sources.foreign.flatten import message_type_of
from mcaptrack.sources.pictures import Pictures
from tests.commands import call, printed
from tests.logs import add_rows
from tests.robots import write_log
from tests.ros_messages import pixels, ros_writer
from tests.worlds import ns

SIZE = (160, 120)


def noise(seed: int = 0, width: int = SIZE[0], height: int = SIZE[1]) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


boxes = st.lists(
    st.tuples(st.floats(-60, 170), st.floats(-60, 130), st.floats(0, 200), st.floats(0, 200)), min_size=0, max_size=5
)


@given(boxes)
@settings(max_examples=25, deadline=None)
def test_all_pixels_of_boxes_are_hidden_and_no_other_and_cells_are_large(given_boxes):
    image, found = noise(), np.array(given_boxes, float).reshape(-1, 4)
    out, mask = hide(image, found)
    wanted = np.zeros(mask.shape, bool)
    for x, y, w, h in found.tolist():
        left, right = (int(np.clip(v, 0, SIZE[0])) for v in (np.floor(x), np.ceil(x + w)))
        top, bottom = (int(np.clip(v, 0, SIZE[1])) for v in (np.floor(y), np.ceil(y + h)))
        wanted[top:bottom, left:right] = True
    assert (mask == wanted).all()
    assert (out[~mask] == image[~mask]).all()
    assert (out[mask] % 32 == 16).all()
    least = min((max(8, max(w, h) / 4) for _, _, w, h in given_boxes), default=8)
    assert len(np.unique(out[mask], axis=0)) <= (SIZE[0] / least + 1) * (SIZE[1] / least + 1) * (len(found) + 1)


def test_a_person_is_a_handful_of_colours():
    """A person of 120 px is at most 4 x 2 cells of 32 px or so, and each is the mean of its pixels, rounded."""
    image = noise(3, 320, 256)
    out, _ = hide(image, np.array([[64.0, 64.0, 60.0, 120.0]]))
    inside = out[64:184, 64:124]
    for row in range(0, 120, 32):
        for column in range(0, 60, 32):
            cell = inside[row : row + 32, column : column + 32].reshape(-1, 3)
            assert (cell == cell[0]).all()
    mean = image[64:96, 64:96].reshape(-1, 3).mean(axis=0)
    assert abs(inside[0, 0] - mean).max() <= 17


def walk_log(
    path: Path, watched: int = 50, damaged: tuple[int, ...] = ()
) -> dict[int, tuple[float, float, float, float]]:
    """A log of 5 s: somebody tracked with a hole of 2.7 s, found 1 s late and lost 1 s early, a car and a detection.

    Only the first pictures, ``watched``, have frames of tracks and detections. Of ``damaged`` ones the end is missing.

    Returns the true box of the person in each picture.
    """
    true = {n: (10.0 + 2 * n, 40.0, 12.0, 30.0) for n in range(50)}
    tracked = [n for n in range(10, 40) if not 12 <= n < 38]
    kind = foxglove.schema_record("foxglove.RawImage")
    with log.create(path) as writer:
        video = writer.add_channel("/camera/video", kind, "protobuf", {"mine": "kept"}, "media")
        imu = writer.add_channel("/imu", ("robot/Imu", "jsonschema", b"{}"), "json", {})
        depth = writer.add_channel("/lidar/points", ("foxglove.PointCloud", "", b""), "json", {})
        for n in range(50):
            message = RawImage(
                frame_id="eye",
                width=160,
                height=120,
                encoding="rgb8",
                step=480,
                data=noise(n).tobytes()[: 99 if n in damaged else None],
            )
            message.timestamp.FromNanoseconds(ns(n / 10))
            writer.add_message(video, ns(n / 10), 7 * n, message.SerializeToString(), ns(n / 10) + 5)
            writer.add_message(imu, ns(n / 10) + 3, n, b'{"n":1}')
            writer.add_message(depth, ns(n / 10) + 4, n, b"{}")
        writer.add_attachment("notes.txt", "text/plain", b"secret")

        def frame(n: int, *rows: tuple[int, int, tuple[float, ...]]) -> Frame:
            names = ("x_px", "y_px", "w_px", "h_px")
            place = dict(zip(names, np.array([box for _, _, box in rows]).reshape(-1, 4).T, strict=True))
            which = {"track_id": [one for one, _, _ in rows], "class_id": np.array([c for _, c, _ in rows], np.uint32)}
            made = TRACKS.rows(**which, **place, observed=np.ones(len(rows), bool), source_id=[-1] * len(rows))
            return Frame(ns(n / 10), n, made)

        car = (5, 3, (100.0, 5.0, 40.0, 20.0))
        frames = [frame(n, *([(1, 1, true[n])] if n in tracked else []), car) for n in range(watched)]
        add_rows(writer, "/camera/tracks", TRACKS, frames, "track", "/camera/video")
        found = DETECTIONS.rows(x_px=[30.0], y_px=[80.0], w_px=[10.0], h_px=[20.0], score=[0.5], class_id=[1])
        seen = [Frame(ns(n / 10), n, found if n == 20 else found[:0]) for n in range(watched)]
        add_rows(writer, "/camera/detections", DETECTIONS, seen, "detect", "/camera/video")
    return true


def messages(path: Path) -> dict[str, list[tuple]]:
    out: dict[str, list[tuple]] = {}
    with path.open("rb") as stream:
        for _, channel, m in make_reader(stream).iter_messages(log_time_order=True):
            out.setdefault(channel.topic, []).append((m.log_time, m.publish_time, m.sequence, m.data))
    return out


def test_a_person_stays_hidden_in_gaps_and_around_the_track_and_all_else_is_kept(tmp_path):
    true = walk_log(tmp_path / "a.mcap")
    done = mcaptrack.render(tmp_path / "a.mcap", tmp_path / "b.mcap", blur="people")
    assert (done.pictures, done.blurred) == (50, ("/camera/video",))
    said = [str(one) for one in done.warnings if one.code == "not-blurred"]
    assert len(said) == 2
    assert "/lidar/points" in said[0]
    assert "notes.txt" in said[1]
    before, after = messages(tmp_path / "a.mcap"), messages(tmp_path / "b.mcap")
    assert before.keys() == after.keys()
    pictures = zip(before.pop("/camera/video"), after.pop("/camera/video"), strict=True)
    assert before == after
    hidden = []
    for n, (old, new) in enumerate(pictures):
        assert old[:3] == new[:3]
        shown, was = RawImage.FromString(new[3]), RawImage.FromString(old[3])
        image = np.frombuffer(shown.data, np.uint8).reshape(120, 160, 3)
        mask = (image != noise(n)).any(axis=2)
        x, y, w, h = map(round, true[n])
        hidden.append(mask[y : y + h, x : x + w].mean())
        assert not mask[5:25, 110:140].any()  # the car
        assert mask[85:95, 32:38].any() == (18 <= n <= 22)  # detected once, and hidden just before and after
        was.data = shown.data
        assert was == shown
    assert min(hidden) > 0.98
    with log.read(tmp_path / "b.mcap") as opened:
        how = opened.channel("/camera/video").metadata
        assert how["mine"] == "kept"
        assert json.loads(how["mcaptrack.blurred"])["boxes"] == ["/camera/detections", "/camera/tracks"]
        assert opened.attachment("notes.txt") == b"secret"


def test_pictures_that_cannot_be_decoded_are_left_out_with_a_warning(tmp_path):
    """As nobody can tell whom they show; all others are those of the undamaged log."""
    walk_log(tmp_path / "a.mcap")
    walk_log(tmp_path / "damaged.mcap", damaged=(0, 7, 8, 49))
    wanted, done = (
        mcaptrack.render(tmp_path / f"{name}.mcap", tmp_path / f"{name}.out.mcap", blur="people")
        for name in ("a", "damaged")
    )
    assert (wanted.pictures, done.pictures) == (50, 46)
    (said,) = (one.message for one in done.warnings if one.code in ("left-out", "lost"))
    assert "4 messages of /camera/video without a picture that can be decoded are left out, the first: " in said
    whole, kept = (messages(tmp_path / f"{name}.out.mcap")["/camera/video"] for name in ("a", "damaged"))
    assert kept == [one for n, one in enumerate(whole) if n not in (0, 7, 8, 49)]


def test_pictures_that_no_detector_saw_are_counted_in_a_warning(tmp_path):
    """Frames end at 1.9 s; the pictures from 3 s on are more than a second later."""
    walk_log(tmp_path / "a.mcap", watched=20)
    done = mcaptrack.render(tmp_path / "a.mcap", tmp_path / "b.mp4", blur="people", end_s=0.1)
    said = [one.message for one in done.warnings if one.code == "not-blurred"]
    assert [("no detector saw 20 of the 50 pictures of /camera/video" in one) for one in said] == [True]


@pytest.mark.parametrize("codec", ["libx265", "libvpx-vp9"])
def test_videos_that_few_viewers_play_become_h264_and_are_hidden(tmp_path, codec):
    """A recorded video of a robot: a message for each packet, with a box in the middle of all pictures."""
    name = {"libx265": "h265", "libvpx-vp9": "vp9"}[codec]
    options = {"x265-params": "log-level=none:bframes=0:keyint=4"} if name == "h265" else {"lag-in-frames": "0"}
    image = noise(2)
    context = av.CodecContext.create(codec, "w")
    context.width, context.height, context.pix_fmt = *SIZE, "yuv420p"
    context.time_base, context.framerate, context.options = Fraction(1, 10), Fraction(10), options
    packets = []
    for n in range(6):
        frame = av.VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts = n
        packets += [bytes(packet) for packet in context.encode(frame)]
    packets += [bytes(packet) for packet in context.encode(None)]
    assert len(packets) == 6
    with log.create(tmp_path / "a.mcap") as writer:
        video = writer.add_channel("/front/video", foxglove.schema_record(foxglove.VIDEO), "protobuf", {}, "media")
        for n, data in enumerate(packets):
            message = foxglove.pack_picture(foxglove.VIDEO, ns(n / 10), "eye", name, data)
            writer.add_message(video, ns(n / 10), n, message)
        box = DETECTIONS.rows(x_px=[60.0], y_px=[30.0], w_px=[30.0], h_px=[60.0], score=[0.9], class_id=[1])
        found = [Frame(ns(n / 10), n, box) for n in range(6)]
        add_rows(writer, "/front/detections", DETECTIONS, found, "detect", "/front/video")
    done = mcaptrack.render(tmp_path / "a.mcap", tmp_path / "b.mcap", blur="people")
    assert [one.message for one in done.warnings] == [f"/front/video: pictures in {name} become h264"]
    with log.read(tmp_path / "b.mcap") as opened:
        decode = picture_decoder(message_type_of(opened, "/front/video"))
        kept = [decode(one.payload) for one in opened.messages("/front/video")]
        assert [(one.format, one.stamp_ns) for one in kept] == [("h264", ns(n / 10)) for n in range(6)]
        for frame in Pictures(opened, "/front/video").frames(range(6)):
            detail = np.abs(np.diff(frame.rows.astype(int), axis=0))
            assert detail[32:88, 62:88].mean() < 0.3 * detail[:, :40].mean()
    drawn = mcaptrack.render(tmp_path / "a.mcap", tmp_path / "b.mp4", blur="people")
    assert drawn.pictures == 6


def test_pictures_of_a_robot_keep_their_messages_and_cameras_without_boxes_are_named(tmp_path):
    path = tmp_path / "robot.mcap"
    shots = write_log(path, "/front/image", "/rear/image", boxes="/front/boxes")
    tracks = mcaptrack.track(path, topic="/front/boxes", sidecar=True)
    code, out, err = call("render", path, "--blur", "people", "-o", tmp_path / "out.mcap", "--json")
    assert code == 0, err
    assert json.loads(out)["results"][0]["blurred"] == ["/front/image"]
    assert "/rear/image are kept as recorded and may show people" in err
    before, after = messages(path), messages(tmp_path / "out.mcap")
    for topic in ("/rear/image", "/front/boxes"):
        assert before[topic] == after[topic]
    assert messages(tracks.written_to)["/front/tracks"] == after["/front/tracks"]
    with (tmp_path / "out.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        found = [m for _, _, _, m in reader.iter_decoded_messages(topics=["/front/image"])]
    assert len(found) == len(shots)
    for message, shot in zip(found, shots, strict=True):
        assert (message.header.frame_id, message.format) == ("eye", "jpeg")
        image = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
        for x, y, w, h in shot.boxes.round().astype(int).tolist():
            part = np.s_[max(y, 0) : y + h, max(x, 0) : x + w]
            if image[part].size:
                now, before = (np.abs(np.diff(one[part].astype(int), axis=0)).mean() for one in (image, shot.image))
                assert now < 0.8 * before + 2


def test_only_the_picture_of_a_message_changes_in_every_encoding():
    cases = []
    for ros1 in (True, False):
        ros = ros_writer("sensor_msgs/CompressedImage", "", ros1)
        message = ros.new("sensor_msgs/CompressedImage", ros.header(), "rgb8; jpeg", pixels(b"ab"))
        cases.append((ros.kind, ros.pack(message)))
    fields = {"timestamp": {"sec": 5, "nsec": 6}, "frame_id": "eye", "format": "jpeg", "more": [1, None]}
    kind = MessageType("foxglove.CompressedImage", "jsonschema", b"{}", "json")
    cases.append((kind, json.dumps(fields | {"data": base64.b64encode(b"ab").decode()}).encode()))
    cases.append((kind, json.dumps(fields | {"data": [97, 98]}).encode()))
    name = "foxglove.CompressedImage"
    packed = foxglove.pack_picture(name, 5, "eye", "jpeg", b"ab") + b"\xa2\x06\x03abc"  # a field of a later version
    cases.append((MessageType(name, "protobuf", foxglove.schema_record(name)[2], "protobuf"), packed))
    for kind, payload in cases:
        decode, replace = picture_decoder(kind), picture_replacer(kind)
        once = replace(payload, b"other bytes", "")
        assert decode(once) == decode(payload)._replace(data=b"other bytes")
        assert decode(replace(payload, b"x", "png")) == decode(payload)._replace(data=b"x", format="png")
        again = replace(once, b"ab", "")
        assert again == payload or json.loads(again) == json.loads(payload)


def test_mistakes_are_said_in_a_line(finished, footage, tmp_path):
    printed("ingest", footage.video, "-o", tmp_path / "bare.mcap")
    for words, said in {
        (tmp_path / "bare.mcap", "--blur", "people", "-o", "b.mcap"): "and no boxes of people in them to hide",
        (finished, "-o", "b.mcap"): "a log is written only with --blur",
        (finished, "--blur", "people", "-o", finished, "--force"): "is the log itself",
        (finished, "--blur", "people", "-o", "b.avi"): "a video is rendered to .mp4 or .gif",
    }.items():
        code, _, err = call("render", *words, folder=tmp_path)
        assert (code, said in err) == (1, True), err
        assert err.count("\n") == 1
    assert [one.name for one in tmp_path.iterdir()] == ["bare.mcap"]
    _, err = printed("render", finished, "--blur", "people", "-o", tmp_path / "b.mcap", "--width", "64")
    assert "--width changes nothing here: the whole log is written" in err
