"""What is said of inputs and kept of them: remarks, warnings, counts, names of classes, and which pictures are taken."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mcaptrack import log
from mcaptrack.errors import McaptrackError
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, GROUND_PLANE, TRACKS
from mcaptrack.schema.as_rows import plane_to_rows, rows_to_plane
from mcaptrack.schema.provenance import CLOCK
from mcaptrack.sources.ingest import IngestOptions, IngestReport, RecordingJob, decompression, ingest, plain_yaml
from mcaptrack.sources.ingest.job import FOR_VIDEOS
from mcaptrack.sources.ingest.labels.timeline import CameraTopics, camera_prefix, choose_camera
from mcaptrack.sources.ingest.plain_yaml import UnsupportedYamlError
from tests.logs import provenance_of, recorder
from tests.worlds import ns

SDD = "".join(
    f'{number} 10 20 14 28 {frame} 0 0 0 "{name}"\n'
    for number, (frame, name) in enumerate([(0, "Biker"), (0, "Pedestrian"), (1, "Biker"), (1, "Misc")])
)


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def made(source: Path, into: Path | None = None, **options: Any) -> tuple[IngestReport, Path]:
    """The report of ingesting a file, and the log."""
    given = IngestOptions(**options)
    out = into or source.with_name("out.mcap")
    if into is None:
        return ingest(source, out, given), out
    with log.read(into) as opened:
        return ingest(source, out, given, into=opened), out


def said(report: IngestReport) -> list[tuple[str, str]]:
    return [(one.message, one.code) for one in report.warnings]


def parameters_of(path: Path, topic: str) -> dict[str, Any]:
    return dict(provenance_of(path, topic).parameters)


# Labels


def test_classes_of_detections_are_listed_and_their_names_kept(tmp_path):
    found = write(tmp_path / "found.txt", SDD)
    report, path = made(found, role="detections", fps=Fraction(10))
    assert report.remarks[0] == f"{found} has several classes; class_id is 1 Pedestrian (1), 2 Biker (2), 7 Misc (1)"
    with log.read(path) as opened:
        metadata = opened.channel("/camera/detections").metadata
        assert json.loads(metadata["mcaptrack.classes"]) == {"1": "Pedestrian", "2": "Biker", "7": "Misc"}
        rows = opened.rows("/camera/detections", DETECTIONS).rows
    assert rows["class_id"].tolist() == [2, 1, 2, 7]
    assert [rows[name][0] for name in ("x_px", "y_px", "w_px", "h_px")] == [10, 20, 4, 8]
    assert (report.messages, report.has_labels, report.uses_camera) == ({"/camera/detections": 2}, True, True)


@pytest.mark.parametrize(
    ("text", "rate", "of"),
    [
        ('1 1 1 5 5 0 0 0 0 "Pedestrian"\n1 1 1 5 5 29 0 0 0 "Pedestrian"\n', 30, "Stanford Drone"),
        ("0 1 1 1\n10 1 1 1\n20 2 1 1\n", 25, "trajnet, a label every 0.4 s"),
        ("0 1 1 0 1 0 0 0\n6 1 1 0 1 0 0 0\n", 15, "obsmat, a label every 0.4 s"),
    ],
)
def test_rates_that_formats_imply_are_warned_of_and_others_are_remarks(tmp_path, text, rate, of):
    labels = write(tmp_path / "a.txt", text)
    report, path = made(labels)
    last = int(text.splitlines()[-1].split()[5 if rate == 30 else 0])
    words = f"{labels}: {last + 1} frames (by the last label) from 0 on, "
    assert said(report)[-1] == (f"{words}{rate} a second (by {of}); `fps=` sets another rate", "clock")
    assert not [remark for remark in report.remarks if "a second" in remark]
    report, _ = made(labels, fps=Fraction(rate))
    assert report.remarks[-1] == f"{words}{rate} a second (by `fps=`)"
    assert not [message for message, _ in said(report) if "second" in message]
    report, _ = made(labels, fps=Fraction(12))
    assert said(report)[-1] == (f"{labels}: {rate} frames a second by {of}, and 12 by `fps=`, which is used", "clock")
    with log.read(path) as opened:
        assert opened.metadata(CLOCK) == {"start_ns": "0"}


def test_rates_that_differ_are_refused(tmp_path):
    first, other = write(tmp_path / "a.txt", "0 1 1 1\n10 1 1 1\n"), write(tmp_path / "b.txt", "0 1 1 1\n12 1 1 1\n")
    with pytest.raises(McaptrackError) as error:
        made(first, role="tracks", labels={"truth": other})
    of = "trajnet, a label every 0.4 s"
    assert str(error.value) == f"{first}: 25 by {of} and 30 by {of}: give the frames per second with `fps=`"


def test_the_number_of_frames_is_the_largest_of_all_counts(tmp_path):
    (tmp_path / "seq").mkdir()
    write(tmp_path / "seq" / "seqinfo.ini", "frameRate=10\nseqLength=9\n")
    truth = write(tmp_path / "seq" / "gt.txt", "1,1,1,1,2,2\n4,1,1,1,2,2\n")
    report, _ = made(truth, role="truth")
    assert report.remarks == [f"{truth}: 9 frames (by seqinfo.ini) from 1 on, 10 a second (by seqinfo.ini)"]
    tracks = write(tmp_path / "t.txt", "1,1,1,1,2,2\n6,1,1,1,2,2\n")
    report, out = made(tracks, fps=Fraction(5))
    assert report.messages == {"/camera/tracks": 6}
    report, _ = made(write(tmp_path / "u.txt", "1,1,1,1,2,2\n"), out, role="truth")
    assert report.messages == {"/camera/truth": 1}
    assert report.remarks[-1].endswith("u.txt: 6 frames (by the last label) from 1 on, 5 a second (by /camera/tracks)")
    with pytest.raises(McaptrackError, match="/camera/tracks has 5 frames a second, not 7, and labels of one camera"):
        made(write(tmp_path / "v.txt", "1,-1,1,1,2,2\n"), out, fps=Fraction(7))


@pytest.mark.parametrize(
    ("frames", "is_taken"), [(0, False), (1, True), (10_000_000, None), (10_000_001, False), (-1, False)]
)
def test_a_number_of_frames_has_bounds(tmp_path, frames, is_taken):
    labels = write(tmp_path / "a.txt", "1,1,1,1,2,2\n")
    if is_taken:
        assert made(labels, fps=Fraction(1), frames=frames)[0].messages == {"/camera/tracks": frames}
    elif is_taken is False:
        with pytest.raises(McaptrackError) as error:
            made(labels, fps=Fraction(1), frames=frames)
        assert str(error.value) == f"`frames=` is a number from 1 to 10000000, not {frames}"


def test_options_of_videos_and_roles_are_refused_by_name(tmp_path):
    labels = write(tmp_path / "a.txt", "1,1,1,1,2,2\n")
    given = {"image_format": "h264", "quality": 3, "keyframe_interval_s": 2.0}
    for at, (name, value) in enumerate(given.items()):
        with pytest.raises(McaptrackError) as error:
            made(labels, fps=Fraction(1), **{name: value})
        assert str(error.value) == f"{labels} is a label file; `{name}=` is for videos"
        assert IngestOptions(**dict([*given.items()][at:])).given(*FOR_VIDEOS) == f"`{name}=`"
    assert IngestOptions(fps=Fraction(1)).given(*FOR_VIDEOS) == ""
    other = write(tmp_path / "b.txt", "1,1,1,1,2,2\n")
    with pytest.raises(McaptrackError) as error:
        made(labels, fps=Fraction(1), labels={"tracks": other})
    assert str(error.value) == f"{labels} and {other} are both tracks; give the role of {labels} with `role=`"


def test_a_plane_of_labels_alone_is_as_large_as_their_boxes(tmp_path):
    plane = write(tmp_path / "h.txt", "0.1,0,0\n0,0.2,0\n0,0,1\n")
    labels = write(tmp_path / "a.txt", "1,1,10,20,30.2,5,1\n2,1,5,2,3,40.5,1\n")
    for point, y in (("foot", 0.2 * 25), ("center", 0.2 * 22.5)):
        report, path = made(labels, fps=Fraction(1), ground_plane=plane, point=point, start_ns=77)
        with log.read(path) as opened:
            (frame,) = opened.frames("/camera/ground_plane", GROUND_PLANE)
            rows = opened.rows("/camera/tracks", TRACKS).rows
            assert opened.metadata(CLOCK) == {"start_ns": "77"}
        found = rows_to_plane(frame.rows)
        assert (found.width_px, found.height_px, found.assumed, frame.t_ns) == (41, 43, False, 77)
        assert (rows["x_m"][0], rows["y_m"][0]) == pytest.approx((0.1 * 25.1, y))
        assert (rows["observed"].tolist(), rows["source_id"].tolist()) == ([True, True], [-1, -1])
        assert parameters_of(path, "/camera/ground_plane") == {"file": "h.txt", "point": point}
        assert (report.messages, report.uses_camera) == ({"/camera/ground_plane": 1, "/camera/tracks": 2}, True)
    where, path = made(write(tmp_path / "b.txt", "0 1 1 1\n10 1 2 2\n"), ground_plane=plane)
    with log.read(path) as opened:
        found = rows_to_plane(opened.frames("/camera/ground_plane", GROUND_PLANE)[0].rows)
        assert opened.rows("/camera/tracks", TRACKS).rows["x_m"].tolist() == [1, 2]
    assert (found.width_px, found.height_px, where.messages["/camera/tracks"]) == (0, 0, 2)


def test_labels_beside_others_of_a_log_share_its_time(tmp_path):
    out = tmp_path / "out.mcap"
    ingest(
        write(tmp_path / "a.txt", "1,1,1,1,2,2\n11,1,1,1,2,2\n"), out, IngestOptions(fps=Fraction(10), start_ns=ns(5))
    )
    later = write(tmp_path / "b.txt", "1,1,1,1,2,2\n2,1,1,1,2,2\n")
    for start_ns, fits in (
        (ns(6), True),
        (ns(6) + 1, False),
        (ns(5) - ns(0.1), True),
        (ns(5) - ns(0.1) - 1, False),
        (None, True),
    ):
        options = IngestOptions(fps=Fraction(10), start_ns=start_ns, camera="other", role="truth", frames=2)
        copy = tmp_path / "copy.mcap"
        copy.write_bytes(out.read_bytes())
        with log.read(copy) as opened:
            if fits:
                ingest(later, copy, options, into=opened)
                continue
            with pytest.raises(McaptrackError) as error:
                ingest(later, copy, options, into=opened)
            first = start_ns / 1e9
            assert str(error.value) == (
                f"{copy} is from 5.000 s to 6.000 s, the labels would be from {first:.3f} s to {first + 0.1:.3f} s, and "
                "/other has no pictures to take times from; say when frame 1 was with `start_time=`"
            )
    with log.read(copy) as opened:
        assert opened.times("/other/truth").tolist() == [ns(5), ns(5.1)]


def test_a_free_name_is_proposed_for_topics_that_are_there(tmp_path):
    out = tmp_path / "out.mcap"
    number = write(tmp_path / "a.txt", "1,1,1,1,2,2\n")
    ingest(number, out, IngestOptions(fps=Fraction(10)))
    with log.read(out) as opened, pytest.raises(McaptrackError) as error:
        ingest(number, out, IngestOptions(fps=Fraction(10)), into=opened)
    assert str(error.value) == f"{out} has /camera/tracks already; `force=True` replaces them"
    for there, free in (((), "camera/labels"), (("",), "camera/labels2"), (("", "2"), "camera/labels3")):
        with log.create(out) as writer:
            for name in ("/camera", *(f"/camera/labels{end}" for end in there)):
                writer.add_message(
                    writer.add_channel(f"{name}/tracks", ("a/B", "jsonschema", b"{}"), "json", {}), 0, 0, b"{}"
                )
        with log.read(out) as opened, pytest.raises(McaptrackError, match=f"`camera='{free}'` puts these beside them"):
            ingest(number, out, IngestOptions(fps=Fraction(10)), into=opened, force=True)


# Which camera

BOTH, LEFT, RIGHT = ["/left/image", "/right/image"], ["/left/image"], ["/rig/right/raw", "/rig/right/video"]
#: The name of the camera, the topics of pictures, and what is chosen: the prefix and the topic.
CHOSEN = [
    ("camera", [], ("/camera", "")),
    ("camera", LEFT, ("/left", "/left/image")),
    ("left", BOTH, ("/left", "/left/image")),
    ("/left/", BOTH, ("/left", "/left/image")),
    ("left/image", BOTH, ("/left", "/left/image")),
    ("left/labels", BOTH, ("/left/labels", "/left/image")),
    ("left/image/labels", BOTH, ("/left/image/labels", "/left/image")),
    ("left/a/b", BOTH, ("/left/a/b", "/left/image")),
    ("rig/right", RIGHT, ("/rig/right", "/rig/right/video")),
    ("rig/right/raw", RIGHT, ("/rig/right", "/rig/right/raw")),
    ("top", BOTH, ("/top", "")),
    ("camera", ["/image"], ("/camera", "/image")),
    ("camera", ["/camera/a"], ("/camera", "/camera/a")),
]


@pytest.mark.parametrize(("name", "topics", "wanted"), CHOSEN)
def test_the_camera_that_a_name_means(name, topics, wanted):
    assert choose_camera("it", name, topics) == CameraTopics(*wanted)


NOT_CHOSEN = [
    ("camera", BOTH, "it has pictures of several cameras, /left/image, /right/image; labels and ground planes belong to those of one: choose with `camera='left'`"),
    ("camera", ["/left/b", "/left/a", "/right/a"], "it has pictures of several cameras, /left/a, /left/b, /right/a; labels and ground planes belong to those of one: choose with `camera='left/a'`"),
    ("left", ["/left/b", "/left/a"], "it: /left has several topics of pictures, /left/a, /left/b; name one with `camera='left/a'`"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "topics", "words"), NOT_CHOSEN)
def test_of_several_cameras_one_has_to_be_named(name, topics, words):
    with pytest.raises(McaptrackError) as error:
        choose_camera("it", name, topics)
    assert str(error.value) == words


def test_the_camera_of_a_topic_is_the_part_before_its_last_slash():
    given = {"/left/image": "/left", "/a/b/c": "/a/b", "/image": "/camera", "image": "/camera", "a/b/": "/a"}
    assert {topic: camera_prefix(topic) for topic in given} == given


# Recordings and videos


def recording(path: Path, *counts: int) -> Path:
    """A log of messages of as many bytes as there are; a channel of one topic for each count."""
    with recorder(path, "ros1") as writer:
        for count in counts:
            channel = writer.add_channel("/talk", ("t/T", "ros1msg", b"uint8[] a"), "ros1", count=str(count))
            for number in range(count):
                writer.add_message(channel, number, bytes(count), number)
        writer.add_channel("/silent", ("t/T", "ros1msg", b"uint8[] a"), "ros1")
    return path


def test_messages_are_counted_by_topic_and_progress_is_told(tmp_path):
    told: list[tuple[str, int, int]] = []
    for counts in ((3, 6), (520,)):
        with log.create(tmp_path / "a.mcap"):
            pass
        source = recording(tmp_path / "source.mcap", *counts)
        with log.read(tmp_path / "a.mcap") as opened:
            report = ingest(source, opened.path, IngestOptions(), into=opened, progress=lambda *some: told.append(some))
        assert report.messages == {"/talk": sum(counts), "/silent": 0}  # of two publishers
        assert (report.has_labels, report.uses_camera, report.lost) == (False, False, [])
    assert told == [("ingest", 9, 9), *(("ingest", number, 520) for number in (256, 512, 520))]


@pytest.mark.parametrize(
    ("given", "name"),
    [
        ({"fps": Fraction(10)}, "`fps=`"),
        ({"start_ns": 0}, "`start_time=`"),
        ({"image_format": "jpeg"}, "`image_format=`"),
        ({"role": "truth"}, "`role=`"),
        ({"frames": 0}, "`frames=`"),
    ],
)
def test_options_that_would_change_a_recording_are_refused(tmp_path, given, name):
    with pytest.raises(McaptrackError) as error:
        made(recording(tmp_path / "a.mcap", 1), **given)
    assert str(error.value) == (
        f"{tmp_path / 'a.mcap'} is a log: its messages stay as they are, and so do their times; leave {name} out"
    )


def test_a_message_that_no_log_should_hold_is_refused(tmp_path, monkeypatch):
    source = recording(tmp_path / "a.mcap", 3)
    module = __import__(RecordingJob.__module__, fromlist=["_"])
    for most, is_taken in ((3, True), (2, False)):
        with log.create(tmp_path / "into.mcap"):
            pass
        monkeypatch.setattr(module, "_MAX_MESSAGE_BYTES", most)
        if is_taken:
            made(source, tmp_path / "into.mcap")
            continue
        with pytest.raises(McaptrackError, match="a message of 3 bytes; at most 2 go into a log"):
            made(source, tmp_path / "into.mcap")


def images(folder: Path, numbers: Iterable[int], suffix: str = ".jpg") -> Path:
    folder.mkdir()
    for number in numbers:
        cv2.imwrite(str(folder / f"{number:03}{suffix}"), np.full((48, 64, 3), 3 * number % 256, np.uint8))
    return folder


def test_a_folder_of_images_is_kept_with_how_it_was_made(tmp_path):
    told: list[tuple[str, int, int]] = []
    folder = images(tmp_path / "images", range(1, 4), ".png")
    options = IngestOptions(fps=Fraction(25, 2), image_format="jpeg", quality=70, camera="gate")
    report = ingest(folder, tmp_path / "a.mcap", options, progress=lambda *some: told.append(some))
    assert parameters_of(tmp_path / "a.mcap", "/gate/video") == {
        "file": "images", "image_format": "jpeg", "fps": "25/2", "quality": 70,
    }  # fmt: skip
    assert told == [("ingest", number, 3) for number in (1, 2, 3)]
    assert (report.messages, report.has_labels, report.uses_camera, said(report)) == (
        {"/gate/video": 3}, False, True, [],
    )  # fmt: skip
    with log.read(tmp_path / "a.mcap") as opened:
        assert [(m.t_ns, m.sequence) for m in opened.messages("/gate/video")] == [
            (0, 0),
            (80_000_000, 1),
            (160_000_000, 2),
        ]
        assert opened.metadata(CLOCK) == {"start_ns": "0"}
    for given, words in (
        ({}, f"{folder}: a folder of images has no clock; give the frames per second with `fps=`"),
        ({"frames": 3}, f"{folder} is not a label file; `frames=` applies to labels without pictures"),
        ({"first_frame": 3, "fps": Fraction(1)}, f"{folder}: `first_frame=` is about label files, and none is given"),
    ):
        with pytest.raises(McaptrackError) as error:
            ingest(folder, tmp_path / "b.mcap", IngestOptions(**given))
        assert str(error.value) == words


def test_times_in_the_names_of_images_are_read(tmp_path):
    at_s = [1_700_000_000, 1_700_000_001, 1_700_000_003]
    for digits, unit in ((0, "seconds"), (3, "milliseconds"), (6, "microseconds"), (9, "nanoseconds")):
        folder = images(tmp_path / unit, [10**digits * at for at in at_s], ".png")
        report = ingest(folder, tmp_path / f"{unit}.mcap", IngestOptions())
        with log.read(tmp_path / f"{unit}.mcap") as opened:
            assert opened.times("/camera/video").tolist() == [10**9 * at for at in at_s]
        name = f"{at_s[0] * 10**digits}.png"
        assert f"{folder}: the names of its images are read as times, {unit} since 1970, as {name}" in report.remarks
        ingest(folder, tmp_path / f"{unit}.mcap", IngestOptions(fps=Fraction(10)), force=True)
        with log.read(tmp_path / f"{unit}.mcap") as opened:  # what a user says counts
            assert opened.times("/camera/video")[0] == 0
    (tmp_path / "seconds" / "1700000002500.png").write_bytes((tmp_path / "seconds" / "1700000001.png").read_bytes())
    with pytest.raises(McaptrackError, match="has no clock"):  # of two units
        ingest(tmp_path / "seconds", tmp_path / "b.mcap", IngestOptions())


# Untrusted bytes


def test_decompression_ends_at_its_limit():
    import zstandard

    data = bytes(range(256)) * 20
    for packed in (zstandard.compress(data), zstandard.ZstdCompressor(write_content_size=False).compress(data)):
        assert decompression.unzstd(packed, len(data)) == data
        with pytest.raises(decompression.NotUnpackedError, match="MiB when decompressed"):
            decompression.unzstd(packed, len(data) - 1)
    with pytest.raises(decompression.NotUnpackedError, match="it is cut off"):
        decompression.unzstd(packed[:-3], len(data))


def test_yaml_has_limits(monkeypatch):
    plain_yaml.load(b"[" * 31 + b"]" * 31)
    with pytest.raises(UnsupportedYamlError, match="line 2: it is nested more than 32 deep"):
        plain_yaml.load(b"\n" + b"[" * 32 + b"]" * 32)
    with pytest.raises(UnsupportedYamlError, match="it holds 0 documents, not one"):
        plain_yaml.load(b"")
    monkeypatch.setattr(plain_yaml, "MAX_BYTES", 4)
    assert plain_yaml.load(b"abcd") == "abcd"
    with pytest.raises(UnsupportedYamlError, match="it has 5 bytes; at most 4 are read"):
        plain_yaml.load(b"abcde")
    with pytest.raises(UnsupportedYamlError, match="byte 1 is no UTF-8"):
        plain_yaml.load(b"a\xff")
    monkeypatch.setattr(plain_yaml, "MAX_BYTES", 400)
    monkeypatch.setattr(plain_yaml, "_MAX_VALUES", 8)
    assert plain_yaml.load(b"[a, b, c]") == ["a", "b", "c"]  # four more events begin and end it
    with pytest.raises(UnsupportedYamlError, match="line 2: it has more than 8 values"):
        plain_yaml.load(b"[a, b, c, d]")


def test_labels_take_the_plane_of_their_camera_if_it_was_measured_and_stays(tmp_path):
    scale = GroundPlane((0.5, 0, 0, 0, 0.5, 0, 0, 0, 1), 64, 48)
    labels = write(tmp_path / "a.txt", "1,1,10,20,4,8,1\n2,1,10,20,4,8,1\n")
    for planes, is_taken in (
        ([scale], True),
        ([scale, scale], False),
        ([replace(scale, assumed=True)], False),
        ([], False),
    ):
        out = tmp_path / "out.mcap"
        with log.create(out) as writer:
            record = (GROUND_PLANE.name, "protobuf", GROUND_PLANE.descriptor)
            number = writer.add_channel("/camera/ground_plane", record, "protobuf", {})
            for t_ns, plane in enumerate(planes):
                writer.add_message(number, t_ns, t_ns, GROUND_PLANE.codec.encode(plane_to_rows(plane)))
        made(labels, out, fps=Fraction(10))
        with log.read(out) as opened:
            rows = opened.rows("/camera/tracks", TRACKS).rows
        wanted = [(6.0, 14.0)] * 2 if is_taken else [(np.nan, np.nan)] * 2  # the foot of the box, halved
        assert np.array_equal(np.stack([rows["x_m"], rows["y_m"]], axis=1), wanted, equal_nan=True)
