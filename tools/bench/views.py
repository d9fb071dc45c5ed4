"""What views cost: the time to make them, beside the generated protobuf classes, and their bytes in a log.

    python tools/bench/views.py [LOG]

The time is for so many people on pictures at 30 per second, all kinds of views together; the peer builds the same
messages (held to be equal) with the generated classes, field by field. With a log the bytes of its views are compared
with those of the pictures they are drawn on: compressed, chunk by chunk, the bytes of a chunk shared out by what each
channel's messages take when compressed alone.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from mcaptrack import foxglove, log
from mcaptrack.foxglove import views
from mcaptrack.geometry.plane import GroundPlane
from mcaptrack.schema import DETECTIONS, PREDICTIONS, TRACKS, Frame

PEOPLE, PICTURES, FPS, STEPS = 20, 600, 30, 12
PLANES = [(0, GroundPlane((0.02, 0.001, -9.0, 0.0, -0.03, 12.0, 0.0, -0.0006, 1.0), 1280, 720))]


def walkers() -> dict[str, tuple]:
    """Channels of a log: people who walk in circles, and turn up and go."""
    t = np.arange(PICTURES) / FPS
    who = np.arange(PEOPLE)
    angle = 0.3 * t[:, None] + 0.7 * who
    x = 600 + 20 * who + 150 * np.cos(angle)
    y = 350 + 10 * who + 60 * np.sin(angle)
    box = [x, y, np.full_like(x, 40.0), np.full_like(x, 100.0)]
    tracks, detections, predictions = [], [], []
    for n in range(PICTURES):
        t_ns = round(n * 1e9 / FPS)
        xywh = np.stack([part[n] for part in box], axis=-1)
        metres = PLANES[0][1].boxes_to_metres(xywh)
        names = ("x_px", "y_px", "w_px", "h_px")
        columns = dict(zip(names, xywh.T, strict=True))
        tracks.append(
            Frame(t_ns, n, TRACKS.rows(track_id=who + 1, **columns, x_m=metres[:, 0], y_m=metres[:, 1],
                                       observed=(who + n // 20) % 5 > 0, source_id=who))
        )  # fmt: skip
        detections.append(Frame(t_ns, n, DETECTIONS.rows(**columns, class_id=np.ones(PEOPLE, np.uint32))))
        if n % (FPS * 2 // 5) == 0:
            step = np.tile(np.arange(1, STEPS + 1), PEOPLE)
            grown = 0.1 * step**2
            predictions.append(
                Frame(t_ns, n, PREDICTIONS.rows(
                    track_id=np.repeat(who + 1, STEPS), step=step, ahead_s=step * 0.4,
                    x_m=np.repeat(metres[:, 0], STEPS) + 0.3 * step, y_m=np.repeat(metres[:, 1], STEPS) + 0.2 * step,
                    cov_xx_m2=grown, cov_xy_m2=grown * 0.2, cov_yy_m2=grown * 0.7))
            )  # fmt: skip
    return {
        "/camera/detections": (DETECTIONS, detections),
        "/camera/tracks": (TRACKS, tracks),
        "/camera/truth": (TRACKS, tracks),
        "/camera/predictions": (PREDICTIONS, predictions),
        "/camera/retracks/full": (TRACKS, tracks),
        "/camera/retracks/predictions": (PREDICTIONS, predictions),
    }


def all_views(channels: dict[str, tuple]) -> dict[str, list[tuple[int, int, bytes]]]:
    """Every view of a default run."""
    at = np.array([round(n * 1e9 / FPS) for n in range(PICTURES)], np.int64)
    made = {}
    for topic, (schema, frames) in channels.items():
        drawing = views.Drawing(topic, schema, frames, PLANES)
        made[topic + views.SUFFIX] = list(drawing.on_pictures(at, at))
        if schema is not DETECTIONS:
            made[topic + views.SCENE_SUFFIX] = list(drawing.on_ground(at, "camera/ground"))
    return made


def steps_to(message: object, path: tuple = ()) -> list[tuple]:
    """What has to be said to build a message: where, and which value; None for a part that begins."""
    steps: list[tuple] = []
    for field, value in message.ListFields():
        if field.message_type is None:
            steps.append((path, field.name, value))
        else:
            parts = list(value) if field.is_repeated else [value]
            for part in parts:
                steps.append((path, field.name, "add" if field.is_repeated else None))
                steps.append((None, None, steps_to(part)))
    return steps


def build(target: object, steps: list[tuple]) -> None:
    """A message built with the generated classes."""
    part = target
    for _, name, value in steps:
        if name is None:
            build(part, value)
        elif value is None:
            part = getattr(target, name)
            part.SetInParent()
        elif value == "add":
            part = getattr(target, name).add()
        else:
            setattr(target, name, value)


def peer_ms(made: dict[str, list[tuple[int, int, bytes]]]) -> float:
    """Milliseconds a picture to build and pack the same messages by the generated classes; a tenth of them is built."""
    spent = 0.0
    for topic, messages in made.items():
        kind = foxglove.message_class(foxglove.SCENE if topic.endswith("scene") else foxglove.ANNOTATIONS)
        for _, _, payload in messages[::10]:
            wanted = kind.FromString(payload)
            steps = steps_to(wanted)
            start = time.process_time()
            again = kind()
            build(again, steps)
            packed = again.SerializeToString()
            spent += time.process_time() - start
            assert kind.FromString(packed) == wanted
    return spent / len(range(0, PICTURES, 10)) * 1e3


def written_ms(made: dict[str, list[tuple[int, int, bytes]]]) -> float:
    """Milliseconds a picture to put messages that are there into a log, compression included."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        with log.create(Path(folder) / "a.mcap") as writer:
            numbers = {
                topic: writer.add_channel(
                    topic, foxglove.schema_record(foxglove.SCENE), "protobuf", {}, "views", topic.split("/")[2]
                )
                for topic in made
            }
            for picture in range(PICTURES):
                for topic, messages in made.items():
                    t_ns, sequence, payload = messages[picture]
                    writer.add_message(numbers[topic], t_ns, sequence, payload)
        return (time.process_time() - start) / PICTURES * 1e3


def bytes_of(path: Path) -> Counter[str]:
    """How many bytes of a log's chunks each topic takes."""
    import zstandard

    topics: dict[int, str] = {}
    taken: Counter[str] = Counter()
    with path.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if not isinstance(record, Chunk):
                continue
            content = defaultdict(list)
            for inner in breakup_chunk(record):
                if isinstance(inner, Channel):
                    topics[inner.id] = inner.topic
                elif isinstance(inner, Message):
                    content[inner.channel_id].append(inner.data)
            alone = {k: len(zstandard.ZstdCompressor(6).compress(b"".join(v))) for k, v in content.items()}
            for channel, size in alone.items():
                taken[topics[channel]] += round(len(record.data) * size / sum(alone.values()))
    return taken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path, nargs="?")
    options = parser.parse_args()
    channels = walkers()
    all_views({topic: (schema, frames[:50]) for topic, (schema, frames) in channels.items()})  # templates are made once
    best, made = 1e9, {}
    for _ in range(3):
        start = time.process_time()
        made = all_views(channels)
        best = min(best, (time.process_time() - start) / PICTURES * 1e3)
    raw = sum(len(payload) for messages in made.values() for _, _, payload in messages) / PICTURES
    peer = peer_ms(made)
    print(f"{PEOPLE} people, {len(made)} views: {raw / 1e3:.0f} kB a picture before compression")
    print(f"made in {best:.3f} ms a picture; by the generated classes {peer:.2f} ms, {peer / best:.0f} times as much")
    print(f"put into a log, compressed, in {written_ms(made):.3f} ms a picture")
    if options.log:
        taken = bytes_of(options.log)
        with log.read(options.log) as opened:
            pictures = [c.topic for c in opened.channels.values() if c.schema_name in foxglove.PICTURES]
        shown = sum(size for topic, size in taken.items() if "/view/" in topic)
        for topic in sorted(taken):
            if "/view/" in topic or topic in pictures:
                print(f"{topic:<44}{taken[topic]:>10} bytes")
        print(f"views take {100 * shown / sum(taken[topic] for topic in pictures):.1f} % of the bytes of the pictures")


if __name__ == "__main__":
    main()
