"""Small scenes for tests, as rows and as videos."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

import mcaptrack
from mcaptrack import log, tables
from mcaptrack.geometry.clocks import NS_PER_S
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, PREDICTIONS, TRACKS, Frame, Schema
from mcaptrack.schema.framing import split_rows
from mcaptrack.schema.provenance import Provenance, digest
from mcaptrack.sources.demo import Block, Pedestrian, SyntheticScene
from mcaptrack.sources.video import VideoOptions, open_video

Positions = Mapping[int, tuple[float, float]]


def ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)


@contextmanager
def _own_priority() -> Iterator[None]:
    """Keep the scheduling of this process: SVT-AV1 makes a superuser's process real-time, for good."""
    if not hasattr(os, "sched_getscheduler"):
        yield
        return
    policy, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, priority)


def assert_same_rows(found: np.ndarray, wanted: np.ndarray) -> None:
    """Compare rows column by column: missing values are equal, which they are not in a comparison of whole rows."""
    assert found.dtype.names == wanted.dtype.names
    for name in wanted.dtype.names:
        np.testing.assert_array_equal(found[name], wanted[name])


def boxes_at(centres: Sequence[tuple[float, float]], size: tuple[float, float] = (20.0, 40.0), score: float = 1.0):
    """Rows of detections around centres, in pixels."""
    xy = np.array(centres, float).reshape(-1, 2)
    w, h = size
    return DETECTIONS.rows(
        x_px=xy[:, 0] - w / 2,
        y_px=xy[:, 1] - h / 2,
        w_px=np.full(len(xy), w),
        h_px=np.full(len(xy), h),
        score=np.full(len(xy), score),
        class_id=np.ones(len(xy), np.uint32),
    )


def detections(path: Callable[[int], Sequence[tuple[float, float]]], frames: int, fps: float = 10.0) -> list[Frame]:
    """Frames of boxes; ``path`` gives their centres for every frame number."""
    return [Frame(ns(number / fps), number, boxes_at(path(number))) for number in range(frames)]


def tracks_at(people: Positions, observed: bool = True):
    """Rows of tracks at positions in metres, by id."""
    xy = np.array(list(people.values()), float).reshape(-1, 2)
    return TRACKS.rows(
        track_id=np.array(list(people), np.int64),
        x_m=xy[:, 0],
        y_m=xy[:, 1],
        observed=np.full(len(xy), observed),
        source_id=np.full(len(xy), -1),
    )


def walk(path: Callable[[int], Positions], ticks: int, rate_hz: float = 2.5) -> list[Frame]:
    """Frames of tracks at a fixed rate; ``path`` gives the position of each id at every tick."""
    return [Frame(ns(tick / rate_hz), tick, tracks_at(path(tick))) for tick in range(ticks)]


def ids(frame: Frame) -> list[int]:
    return frame.rows["track_id"].tolist()


def places(frame: Frame) -> dict[int, tuple[float, float]]:
    """The position of each id, rounded to a millimetre."""
    return {int(row["track_id"]): (round(float(row["x_m"]), 3), round(float(row["y_m"]), 3)) for row in frame.rows}


def small_scene(seconds: float = 6.0, **changes) -> SyntheticScene:
    """Three people on a small picture, one of them occluded for a while."""
    people = (
        Pedestrian(1, ((0.0, -5.0, 9.0), (seconds, 4.0, 12.0)), (30, 30, 30)),
        Pedestrian(2, ((0.0, 5.0, 13.0), (seconds, -4.0, 10.0)), (120, 40, 20)),
        Pedestrian(3, ((seconds / 3, 6.0, 15.5), (seconds, -1.0, 15.0)), (20, 60, 20)),
    )
    options = {"fps": 10, "width_px": 320, "height_px": 180, "noise": 1.5, "blocks": (Block(2.5, 14.0, 1.2, 2.2),)}
    return SyntheticScene(people, seconds, **(options | changes))


def write_clip(
    path: Path,
    frames: int = 20,
    *,
    size: tuple[int, int] = (64, 48),
    fps: int | Fraction = 10,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    options: Mapping[str, str] | None = None,
    times_ms: Sequence[int] | None = None,
) -> list[np.ndarray]:
    """Encode a clip with FFmpeg: a bright quarter and a spot that moves one pixel per frame. Returns the pictures."""
    width, height = size
    images = []
    with _own_priority(), av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=fps, options=dict(options or {}))
        stream.width, stream.height, stream.pix_fmt = width, height, pixels
        if times_ms:
            stream.codec_context.time_base = Fraction(1, 1000)
        for number in range(frames):
            image = np.full((height, width, 3), 40, np.uint8)
            image[: height // 2, : width // 2] = 220
            image[height // 2 : height // 2 + 8, number : number + 8] = (20, 20, 230)
            images.append(image)
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            if times_ms:
                frame.pts, frame.time_base = times_ms[number], Fraction(1, 1000)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)
    return images


def upright(path: Path, **options: Any) -> list[np.ndarray]:
    """The pictures of a video or folder as they come into a log, without losses."""
    pictures = open_video(path, VideoOptions(image_format="png", **options)).pictures()
    return [cv2.imdecode(np.frombuffer(picture.data, np.uint8), cv2.IMREAD_COLOR) for picture in pictures]


def tracked(rng: np.random.Generator, names: np.ndarray, seen: np.ndarray):
    """Rows of tracks at positions (N, 2) in metres, with boxes at 20 px per metre; some are interpolated."""
    count = len(names)
    return TRACKS.rows(
        track_id=names.astype(np.int64),
        x_px=seen[:, 0] * 20 + 300,
        y_px=seen[:, 1] * 20 + 200,
        w_px=rng.uniform(8, 12, count),
        h_px=rng.uniform(25, 35, count),
        x_m=seen[:, 0],
        y_m=seen[:, 1],
        score=rng.random(count),
        observed=rng.random(count) > 0.1,
        source_id=np.full(count, -1),
    )


def noisy_tracks(
    rng: np.random.Generator, people: int = 4, ticks: int = 30, rate_hz: float = 2.5, hidden: float = 0.0
) -> list[Frame]:
    """Tracks of random walkers: noise, missed detections, interpolated rows, new and swapped ids, gaps of the log.

    Two people near each other may be merged into one detection. ``hidden`` is the probability at each tick that a person
    is occluded, for up to eight seconds.
    """
    place, speed = rng.uniform(-4, 4, (people, 2)), rng.normal(0, 0.5, (people, 2)) * rng.integers(0, 2, (people, 1))
    names = rng.permutation(50)[:people]
    noise_m = rng.choice([0.02, 0.1, 0.3])
    frames, now, free = [], 0.0, 50
    back = np.zeros(people)
    for tick in range(ticks):
        steps = int(rng.choice([1, 1, 1, 1, 1, 1, 1, 1, 1, 3]))
        now += steps / rate_hz + rng.uniform(-0.02, 0.02)
        speed += rng.normal(0, 0.05, speed.shape)
        place = place + steps * speed
        for who in range(people):
            if rng.random() < 0.06:
                names[who], free = free, free + 1
        if people > 1 and rng.random() < 0.06:
            a, b = rng.permutation(people)[:2]
            names[[a, b]] = names[[b, a]]
        back = np.where((back <= tick) & (rng.random(people) < hidden), tick + rng.integers(3, 20, people), back)
        there = rng.permutation(np.flatnonzero((rng.random(people) > 0.15) & (back <= tick)))
        seen = place[there] + rng.normal(0, noise_m, (len(there), 2))
        for one in range(len(there)):
            apart = np.hypot(*(seen - seen[one]).T)
            other = int(np.argsort(apart, kind="stable")[1]) if len(there) > 1 else one
            if other != one and apart[other] < 0.8 and rng.random() < 0.7:
                seen[one] = (seen[one] + seen[other]) / 2
                there, seen = np.delete(there, other), np.delete(seen, other, axis=0)
                break
        frames.append(Frame(ns(max(now, 0.0)), tick, tracked(rng, names[there], seen)))
    return frames


def crossing_tracks(rng: np.random.Generator, ticks: int = 50, rate_hz: float = 2.5) -> list[Frame]:
    """Two pairs of people cross: when near, they are occluded, merged or detected; afterwards ids may be swapped."""
    way = rng.uniform(0.15, 0.4, 2)
    beside = rng.uniform(0.1, 0.9, 2)
    middle = rng.integers(20, 30, 2)
    how, swaps = rng.integers(0, 3, 2), rng.random(2) < 0.6
    noise_m = rng.choice([0.02, 0.1, 0.2])
    names = rng.permutation(20)[:4].reshape(2, 2)
    frames = []
    for tick in range(ticks):
        who, seen = [], []
        for pair in range(2):
            if tick == middle[pair] and swaps[pair]:
                names[pair] = names[pair][::-1] if rng.random() < 0.7 else [names[pair][0], 90 + pair]
            ahead = way[pair] * (tick - middle[pair])
            both = np.array([[ahead, 0], [-ahead, beside[pair]]]) + [0, 3.0 * pair] + rng.normal(0, noise_m, (2, 2))
            near = abs(tick - middle[pair]) <= 2
            if near and how[pair] == 1:
                who, seen = [*who, names[pair][0]], [*seen, both.mean(axis=0)]
            elif not near or how[pair] == 2:
                kept = rng.random(2) > 0.05
                who, seen = [*who, *names[pair][kept]], [*seen, *both[kept]]
        rows = tracked(rng, np.array(who, int), np.array(seen).reshape(-1, 2))
        frames.append(Frame(ns(tick / rate_hz), tick, rows))
    return frames


def boxed(people, observed: bool = True):
    """Rows of tracks from {id: (left, top)}: boxes of 10 x 20 px, without positions in metres."""
    xy = np.array(list(people.values()), float).reshape(-1, 2)
    return TRACKS.rows(
        track_id=np.array(list(people), np.int64),
        x_px=xy[:, 0],
        y_px=xy[:, 1],
        w_px=np.full(len(xy), 10.0),
        h_px=np.full(len(xy), 20.0),
        observed=np.full(len(xy), observed),
        source_id=np.full(len(xy), -1),
    )


X265 = {"x265-params": "keyint=10:min-keyint=10:bframes=0:log-level=none"}


SVT = {"g": "10", "preset": "12"}


PLANE = [(0, GroundPlane((0.1, 0, 0, 0, 0.1, 0, 0, 0, 1), 640, 480))]


PICTURES = np.array([ns(n / 7) for n in range(20)])


FORECAST = PREDICTIONS.rows(
    track_id=[3, 3],
    step=[1, 2],
    ahead_s=[0.4, 0.8],
    x_m=[1.0, 2.0],
    y_m=[3.0, 4.0],
    cov_xx_m2=[1.0, 1],
    cov_xy_m2=[0.0, 0],
    cov_yy_m2=[1.0, 1],
)


def _two_walkers(name_of_first: Callable[[int], tuple[int, int]]) -> list[Frame]:
    """Two people who walk beside each other for 24 s; ``name_of_first`` names the first by tick: track and source."""
    frames = []
    for tick in range(60):
        track, source = name_of_first(tick)
        rows = tracks_at({track: (0.4 * tick, 0.0), 90: (0.4 * tick, 8.0)})
        rows["source_id"] = [source, 90]
        frames.append(Frame(ns(tick / 2.5), tick, rows))
    return frames


def write_eventful(path: Path) -> Path:
    """A log with events: the tracker switches at 8 and at 16 s; re-tracking joins the first two of its tracks."""
    joined = {0: (1, 1), 1: (1, 2), 2: (3, 3)}
    channels = {
        "truth": _two_walkers(lambda _: (50, 50)),
        "tracks": _two_walkers(lambda tick: (1 + tick // 20, -1)),
        "retracks": _two_walkers(lambda tick: joined[tick // 20]),
    }
    with log.create(path) as writer:
        for name, frames in channels.items():
            messages = [(frame.t_ns, frame.index, TRACKS.codec.encode(frame.rows)) for frame in frames]
            made = Provenance("retrack" if name == "retracks" else "ingest", {"of": name}, digest=digest(messages))
            record = (TRACKS.name, "protobuf", TRACKS.descriptor)
            number = writer.add_channel(f"/camera/{name}", record, "protobuf", made.to_metadata())
            for message in messages:
                writer.add_message(number, *message)
    mcaptrack.events(path)
    return path


def _add_messages(writer: log.LogWriter, topic: str, frames: Sequence[Frame], made_by: str) -> None:
    schema = PREDICTIONS if topic.endswith("/predictions") else TRACKS
    messages = [(frame.t_ns, frame.index, schema.codec.encode(frame.rows)) for frame in frames]
    how = Provenance(made_by, {"of": topic}, digest=digest(messages)).to_metadata() if made_by else {}
    number = writer.add_channel(topic, (schema.name, "protobuf", schema.descriptor), "protobuf", how)
    for message in messages:
        writer.add_message(number, *message)


def write_channels(path: Path, made_by: str = "ingest", **channels: Sequence[Frame]) -> Path:
    """A log without pictures: tracks and predictions of /camera, made by a stage; without provenance if that is empty."""
    with log.create(path) as writer:
        for name, frames in channels.items():
            _add_messages(writer, "/camera/" + name.replace("_", "/"), frames, made_by)
    return path


def replace_channel(path: Path, topic: str, frames: Sequence[Frame], made_by: str = "ingest") -> None:
    with log.read(path) as opened, log.extend(opened, drop=[topic]) as writer:
        _add_messages(writer, topic, frames, made_by)


def table_to_frames(schema: Schema, rows: Any, frames: Any, topic: str) -> list[Frame]:
    """The frames of one channel, also empty ones, from its table of rows and the table of frames."""
    rows, frames = tables.rows_of_topic(rows, topic), tables.rows_of_topic(frames, topic)
    order = np.argsort(rows.column("row").to_numpy(), kind="stable")
    columns = {}
    for column in schema.columns:
        if column.since and column.name not in rows.column_names:  # an older table
            continue
        values = rows.column(column.name).combine_chunks()
        values = values.fill_null(column.missing) if column.optional else values
        columns[column.name] = values.to_numpy(zero_copy_only=False)[order]
    members = schema.rows(**columns)
    times, numbers, counts = (frames.column(name).to_pylist() for name in ("t_ns", "frame", "rows"))
    return split_rows(times, numbers, members, np.cumsum(counts))
