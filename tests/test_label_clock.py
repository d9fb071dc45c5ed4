"""Frame k of labels is picture k of the camera that they belong to, whichever way they come in."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import get_args

import av
import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from mcap.reader import make_reader

from mcaptrack import foxglove, log
from mcaptrack.choices import Role
from mcaptrack.errors import McaptrackError
from mcaptrack.registry import own
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources.ingest import IngestOptions, ingest, label_frames
from mcaptrack.sources.ingest.labels.timeline import timeline_of
from mcaptrack.sources.video import H264Encoder
from mcaptrack.sources.video.codecs import CODECS
from mcaptrack.tables.compared import compare_files, detections_and_ground_truth
from tests.logs import recorder
from tests.robots import FPS, PICTURES, ROBOT_NS, lines, robot_log
from tests.tiers import one_in
from tests.worlds import ns, write_clip

#: Corrections belong to tracks of a log: see test_corrections.
ROLES: tuple[Role, ...] = tuple(role for role in get_args(Role) if role != "corrections")
#: By hand: the pictures that are labelled, and by which files. The first ones and the last ones are empty.
SEEN = {k: [1, 2] if k % 2 else [1] for k in (3, 4, 5, 7, 15)}
#: For formats that are labelled every so many frames by custom.
STEP = 4
SPARSE = {k: [1] for k in (4, 12, 16)}

WRITERS: dict[str, Callable[[int, int, bool], str]] = {
    "mot": lambda k, who, anonymous: f"{k + 1},{-1 if anonymous else who},{10 * who},20,4,8,1,-1,-1,-1",
    "kitti": lambda k, who, _: f"{k} {who} Pedestrian 0 0 0.1 {10 * who} 20 {10 * who + 4} 28 1.7 0.5 0.5 1 1 1 0.0",
    "sdd": lambda k, who, _: f'{who} {10 * who} 20 {10 * who + 4} 28 {k} 0 0 0 "Pedestrian"',
    "trajnet": lambda k, who, _: f"{k} {who} {who}.5 2.5",
    "obsmat": lambda k, who, _: f"{k} {who} {who}.5 0 2.5 0 0 0",
}
POSITIONS = ("trajnet", "obsmat")
DATA_SETS = [name for name in WRITERS if name in own("label_format")]
#: What labels hold makes no difference to their clock, so one format is enough for kinds other than ground truth.
KINDS = [(f, r) for f, r in itertools.product(DATA_SETS, ROLES) if r == "truth" or f == "mot"]
NAMES = ["-".join(kind) for kind in KINDS]


@dataclass
class World:
    """A file of labels, and everything that it may belong to. Pictures are ``FPS`` a second in all of them."""

    folder: Path
    name: str = "mot"
    role: Role = "truth"
    start_ns: int = 0
    times: list[int] = field(default_factory=list)

    @property
    def seen(self) -> dict[int, list[int]]:
        return SPARSE if self.name in POSITIONS else SEEN

    def labels(self, path: Path, role: Role) -> Path:
        rows = [WRITERS[self.name](k, who, role == "detections") for k, people in self.seen.items() for who in people]
        path.write_text("\n".join(rows) + "\n")
        return path

    def expected(self, times: list[int]) -> list[tuple[int, int, int]]:
        """Time, number and how many people, of each labelled picture; those of the sparse formats are every fourth.

        Ground truth that isn't of a whole sequence is taken to begin with its first label and to end with its last.
        """
        step, first, last = STEP if self.name in POSITIONS else 1, 0, len(times) - 1
        if self.role == "truth" and not (self.folder / "seqinfo.ini").exists():
            first, last = min(self.seen), max(self.seen)
        return [(times[k], k, len(self.seen.get(k, []))) for k in range(first, last + 1, step)]


def by_ffmpeg(path: Path) -> list[int]:
    with av.open(str(path)) as container:
        times = [frame.pts * Fraction(frame.time_base) for frame in container.decode(video=0)]
    return [round((t - times[0]) * 10**9) for t in times]


def by_the_stock_library(path: Path, topic: str) -> list[int]:
    with path.open("rb") as stream:
        return [message.log_time for _, _, message in make_reader(stream).iter_messages([topic])]


def add(source: Path, path: Path, **options) -> None:
    with log.read(path) as opened:
        ingest(source, path, IngestOptions(**options), into=opened)


@pytest.fixture(scope="module")
def stock(tmp_path_factory) -> Path:
    """Everything that labels can belong to, made once. Not to be changed."""
    folder = tmp_path_factory.mktemp("stock")
    write_clip(folder / "clip.mp4", PICTURES, fps=FPS, options={"bf": "0", "g": "10"})
    write_clip(folder / "b.mkv", PICTURES, fps=FPS, options={"bf": "2"})
    jumps = [40 * n + 13 * (n % 3) + (500 if n > 9 else 0) for n in range(PICTURES)]
    write_clip(folder / "jumps.mkv", PICTURES, options={"bf": "0", "g": "10"}, times_ms=jumps)
    (folder / "images").mkdir()
    for k in range(PICTURES):
        cv2.imwrite(str(folder / "images" / f"{k + 1}.png"), np.full((48, 64, 3), 5 * k, np.uint8))
    ingest(folder / "clip.mp4", folder / "clip.mcap", IngestOptions())
    ingest(folder / "clip.mp4", folder / "late.mcap", IngestOptions(start_ns=ns(77), camera="gate/east"))
    ingest(folder / "jumps.mkv", folder / "jumps.mcap", IngestOptions())
    robot_log(folder / "robot.mcap", "/front/image_raw")
    robot_log(folder / "raw.mcap", "/front/image_raw", "/front/image_raw/compressed")
    shutil.copy(folder / "robot.mcap", folder / "beside.mcap")
    with log.read(folder / "beside.mcap", sidecar=True) as opened:
        ingest(folder / "clip.mp4", folder / "beside.mcap", IngestOptions(start_ns=ROBOT_NS), into=opened)
    return folder


Way = Callable[[World, Path], tuple[Path, str, list[int]]]
CLIP_NS = [ns(k / FPS) for k in range(PICTURES)]


def beside(name: str, **options) -> Way:
    """Labels that come along with pictures."""

    def way(world: World, stock: Path) -> tuple[Path, str, list[int]]:
        source, out = stock / name, world.folder / "out.mcap"
        found = world.labels(world.folder / "labels.txt", world.role)
        ingest(source, out, IngestOptions(labels={world.role: found}, **options))
        times = CLIP_NS
        prefix = "/camera"
        if source.suffix in (".mp4", ".mkv") and "fps" not in options:
            times = by_ffmpeg(source)
        if source.suffix == ".mcap":
            prefix, topic = "/front", "/front/image_raw"
            times = by_the_stock_library(out, topic)
        start = options.get("start_ns", 0)
        return out, prefix, [start + t for t in times]

    return way


def into(name: str, topic: str, prefix: str, **options) -> Way:
    """Labels that are added to a log with pictures."""

    def way(world: World, stock: Path) -> tuple[Path, str, list[int]]:
        for path in stock.glob(f"{name}.*mcap"):
            shutil.copy(path, world.folder / path.name)
        out = world.folder / f"{name}.mcap"
        times = [t for path in world.folder.glob("*.mcap") for t in by_the_stock_library(path, topic)]
        add(world.labels(world.folder / "labels.txt", world.role), out, role=world.role, **options)
        return out, prefix, times

    return way


def alone(world: World, stock: Path) -> tuple[Path, str, list[int]]:
    out = world.folder / "out.mcap"
    found = world.labels(world.folder / "labels.txt", world.role)
    ingest(found, out, IngestOptions(role=world.role, fps=Fraction(FPS), frames=PICTURES, start_ns=ns(3)))
    return out, "/camera", [ns(3) + t for t in CLIP_NS]


def alone_with_seqinfo(world: World, stock: Path) -> tuple[Path, str, list[int]]:
    if world.name not in ("mot", "kitti"):
        pytest.skip("the format says at which rate it is")
    (world.folder / "gt").mkdir()
    (world.folder / "seqinfo.ini").write_text(f"[Sequence]\nframeRate={FPS}\nseqLength={PICTURES}\n")
    out = world.folder / "out.mcap"
    ingest(world.labels(world.folder / "gt" / "gt.txt", world.role), out, IngestOptions(role=world.role))
    return out, "/camera", CLIP_NS


def beside_other_labels(world: World, stock: Path) -> tuple[Path, str, list[int]]:
    """Two label files, of which one tells how many frames there are."""
    other: Role = "tracks" if world.role != "tracks" else "truth"
    long = world.folder / "other.txt"
    long.write_text("".join(f"{k + 1},9,1,1,2,2\n" for k in range(PICTURES)))
    files = {"labels": {other: long}, "fps": Fraction(FPS)}
    out = world.folder / "out.mcap"
    ingest(world.labels(world.folder / "labels.txt", world.role), out, IngestOptions(role=world.role, **files))
    return out, "/camera", CLIP_NS


def into_other_labels(world: World, stock: Path) -> tuple[Path, str, list[int]]:
    """Added to a log of labels alone, whose clock they take."""
    other: Role = "tracks" if world.role != "tracks" else "truth"
    long, out = world.folder / "other.txt", world.folder / "out.mcap"
    long.write_text("".join(f"{k + 1},9,1,1,2,2\n" for k in range(PICTURES)))
    ingest(long, out, IngestOptions(role=other, fps=Fraction(FPS), start_ns=ns(5)))
    given = {"fps": Fraction(FPS)} if world.name not in ("mot", "kitti") else {}  # other formats know one of their own
    add(world.labels(world.folder / "labels.txt", world.role), out, role=world.role, **given)
    return out, "/camera", [ns(5) + t for t in CLIP_NS]


def into_what_is_left_of_pictures(world: World, stock: Path) -> tuple[Path, str, list[int]]:
    """The pictures were dropped from the log; what was detected in each of them is there."""
    if world.role == "detections":
        pytest.skip("these are there")
    out = world.folder / "out.mcap"
    with log.create(out) as writer:
        made = Provenance("detect", {}, "/camera/video").to_metadata()
        channel = writer.add_channel(
            "/camera/detections", (DETECTIONS.name, "protobuf", DETECTIONS.descriptor), "protobuf", made
        )
        for k in range(PICTURES):
            writer.add_message(channel, ns(9) + 7 * k * k, k, b"")
    add(world.labels(world.folder / "labels.txt", world.role), out, role=world.role)
    return out, "/camera", [ns(9) + 7 * k * k for k in range(PICTURES)]


WAYS: dict[str, Way] = {
    "beside a video": beside("clip.mp4"),
    "beside a video, later": beside("clip.mp4", start_ns=ns(100)),
    "beside a video that is encoded again": beside("b.mkv"),
    "beside a video of a variable rate": beside("jumps.mkv"),
    "beside a video, evenly spaced": beside("jumps.mkv", fps=Fraction(FPS)),
    "beside images": beside("images", fps=Fraction(FPS)),
    "beside a robot's log": beside("robot.mcap"),
    "beside a robot's log, by name": beside("robot.mcap", camera="front"),
    "beside a robot's log, by topic": beside("robot.mcap", camera="front/image_raw"),
    "beside one of two topics": beside("raw.mcap", camera="front"),
    "into a log": into("clip", "/camera/video", "/camera"),
    "into a log, with the same rate": into("clip", "/camera/video", "/camera", fps=Fraction(FPS)),
    "into a log of another camera and clock": into("late", "/gate/east/video", "/gate/east", camera="/gate/east/"),
    "into a log of another camera, unnamed": into("late", "/gate/east/video", "/gate/east"),
    "into a log of a variable rate": into("jumps", "/camera/video", "/camera"),
    "into a robot's log": into("robot", "/front/image_raw", "/front"),
    "into a robot's log, by name": into("robot", "/front/image_raw", "/front", camera="front"),
    "into a robot's log, by topic": into("robot", "/front/image_raw", "/front", camera="/front/image_raw"),
    "into a robot's log, beside": into("robot", "/front/image_raw", "/front/people", camera="front/people"),
    "into one of two topics": into("raw", "/front/image_raw", "/front", camera="front"),
    "into a log whose pictures stand in its results": into("beside", "/camera/video", "/camera"),
    "alone": alone,
    "alone, beside seqinfo.ini": alone_with_seqinfo,
    "alone, beside other labels": beside_other_labels,
    "into a log of other labels": into_other_labels,
    "into a log whose pictures were dropped": into_what_is_left_of_pictures,
}


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
@pytest.mark.parametrize(("name", "role"), one_in(2, KINDS), ids=NAMES)
def test_frame_k_of_labels_is_picture_k(tmp_path, stock, way, name, role):
    world = World(tmp_path, name, role)
    path, prefix, times = way(world, stock)
    schema = DETECTIONS if role == "detections" else TRACKS
    with log.read(path) as opened:
        frames = opened.frames(f"{prefix}/{role}", schema)
    assert len(times) == PICTURES
    assert [(f.t_ns, f.index, len(f.rows)) for f in frames] == world.expected(times)


@pytest.mark.parametrize(("name", "role"), KINDS, ids=NAMES)
def test_files_that_are_compared_or_tuned_have_the_same_frames(tmp_path, name, role):
    """Against MOTChallenge's rows of every picture, by what they say at each of their frames."""
    world = World(tmp_path, name, role)
    found = world.labels(tmp_path / "labels.txt", role)
    every = tmp_path / "every.txt"
    every.write_text("".join(f"{k + 1},9,{k},1,2,2\n" for k in range(PICTURES)))
    wanted = {k: len(people) for k, people in world.seen.items()}
    if role == "tracks":
        both = compare_files(found, every, IngestOptions(fps=Fraction(FPS)))
        assert {f.index: len(f.rows) for f in both.tracks if len(f.rows)} == wanted
        assert {f.index: f.rows["x_px"].tolist() for f in both.ground_truth} | {
            f.index: [f.index] for f in both.tracks
        } == {f.index: [f.index] for f in both.ground_truth}
    elif role == "detections":
        detections, truth, _ = detections_and_ground_truth(found, every, IngestOptions(fps=Fraction(FPS)))
        assert [(f.t_ns, f.index) for f in truth] == [(t, k) for k, t in enumerate(CLIP_NS)]
        assert [(f.t_ns, f.index, len(f.rows)) for f in detections] == world.expected(CLIP_NS)
    else:
        frames = label_frames({"truth": found, "tracks": every}, IngestOptions(fps=Fraction(FPS)))["truth"]
        assert [(f.t_ns, f.index, len(f.rows)) for f in frames] == world.expected(CLIP_NS)


INTO_REFUSED = {
    "another rate": (
        "clip",
        {"fps": Fraction(7)},
        "the pictures of /camera/video are 10 a second, not 7; .* leave `fps=",
    ),
    "nearly the same rate": ("clip", {"fps": Fraction(995, 100)}, None),
    "a rate of pictures that have none": ("jumps", {"fps": Fraction(24)}, "a second, not 24; labels take the times"),
    "another start": (
        "clip",
        {"start_ns": 5},
        "take the times of the pictures of /camera/video; leave `start_time=` out",
    ),
    "a number of frames": ("clip", {"frames": 5}, "leave `frames=` out"),
    "too many": ("clip", {}, "all labels are of frames after the last picture"),
    "one of two cameras": ("two", {}, "has pictures of several cameras, /left/image, /right/image; .*`camera='left'`"),
    "a camera that isn't there": ("robot", {"camera": "rear"}, "no clock of its own.*`camera='front/image_raw'`"),
    "a camera that isn't there, at a time that isn't": (
        "robot",
        {"camera": "rear", "fps": Fraction(10)},
        r"is from 1700000000.000 s to 1700000002.302 s, the labels would be from 0.000 s to .*`start_time=`",
    ),
}


@pytest.mark.parametrize(("name", "given", "words"), INTO_REFUSED.values(), ids=INTO_REFUSED)
def test_labels_that_are_not_of_a_logs_pictures_are_refused(tmp_path, stock, name, given, words):
    path = tmp_path / f"{name}.mcap"
    if name == "two":
        robot_log(path, "/left/image", "/right/image")
    else:
        shutil.copy(stock / f"{name}.mcap", path)
    before = path.read_bytes()
    found = lines(tmp_path / "gt.txt", *((900, 901) if words and "after the last" in words else (1, 2)))
    if words is None:  # within half a frame of each picture
        add(found, path, role="truth", **given)
        return
    with pytest.raises(McaptrackError, match=words):
        add(found, path, role="truth", **given)
    assert path.read_bytes() == before


def test_a_camera_without_pictures_has_a_clock_where_the_log_has_something(tmp_path, stock):
    path = Path(shutil.copy(stock / "robot.mcap", tmp_path / "a.mcap"))
    add(lines(tmp_path / "gt.txt", 1, 2, 3), path, role="truth", camera="rear", fps=Fraction(10), start_ns=ROBOT_NS + 5)
    with log.read(path) as opened:
        times = [f.t_ns for f in opened.frames("/rear/truth", TRACKS)]
    assert times == [ROBOT_NS + 5 + t for t in CLIP_NS[:3]]


def test_pictures_that_are_added_to_labels_have_their_times(tmp_path, stock):
    path = tmp_path / "a.mcap"
    ingest(lines(tmp_path / "gt.txt", 4), path, IngestOptions(role="truth", fps=Fraction(7)))
    with pytest.raises(
        McaptrackError, match=r"/camera/truth has labels at other times than .*clip.mp4; give `fps='7'`"
    ):
        add(stock / "clip.mp4", path)
    add(stock / "clip.mp4", path, fps=Fraction(7))
    with log.read(path) as opened:
        assert set(opened.times("/camera/truth").tolist()) <= set(opened.times("/camera/video").tolist())
        assert opened.channel("/camera/video").messages == PICTURES


def test_parameter_sets_that_stand_alone_in_a_message_are_no_pictures(tmp_path):
    """Some robots log them by themselves: labels count pictures."""
    encoder, times, path = H264Encoder(64, 48, Fraction(FPS)), [], tmp_path / "a.mcap"
    with recorder(path) as writer:
        name, encoding, data = foxglove.schema_record(foxglove.VIDEO)
        channel = writer.add_channel("/front/h264", (name, encoding, data), "protobuf")
        for k in range(6):
            unit = encoder.encode(np.full((48, 64, 3), 20 * k, np.uint8))
            alone = b"".join(b"\0\0\0\1" + nal for nal in CODECS["h264"].inspect(unit).sets)
            parts = [alone, unit] if k in (0, 3) else [unit]
            assert (k == 0) == bool(alone)
            for number, part in enumerate(parts):
                message = CompressedVideo(data=part or b"\0\0\0\1\x06", format="h264")
                writer.add_message(channel, 1000 * k + number, message.SerializeToString(), 1000 * k)
            times.append(1000 * k + number)
    add(lines(tmp_path / "gt.txt", *range(1, 7)), path, role="truth")
    ingest(path, tmp_path / "b.mcap", IngestOptions(labels={"detections": lines(tmp_path / "det.txt", 1, 6)}))
    for made, role, schema in ((path, "truth", TRACKS), (tmp_path / "b.mcap", "detections", DETECTIONS)):
        with log.read(made) as opened:
            assert [f.t_ns for f in opened.frames(f"/front/{role}", schema)] == times


@pytest.mark.parametrize("numbers", [(0, 1, 2, 3), (0, 1, 3), (1, 2, 3), (0, 3)])
def test_pictures_keep_their_numbers_where_some_could_not_be_read(tmp_path, numbers):
    path = tmp_path / "a.mcap"
    with log.create(path) as writer:
        made = Provenance("ingest", {"every": 2}).to_metadata()
        channel = writer.add_channel("/camera/video", foxglove.schema_record(foxglove.VIDEO), "protobuf", made)
        for number in numbers:
            writer.add_message(channel, ns(number), number, b"")
    with log.read(path) as opened:
        line = timeline_of(opened, "/camera/video")
    assert (line.index.tolist(), line.t_ns.tolist()) == (list(numbers), [ns(number) for number in numbers])
    assert (line.is_complete, line.every) == (len(numbers) == 4, 2)
