"""How CPU time and peak memory of each command grow with one size of a log, all others being small.

    .venv/bin/python tools/bench/growth.py [--only NAME ...] [--sizes N ...] [--steps 3] [--limit-s 120]

Each kind of log is large in one dimension: boxes in a frame, tracks, channels, chunks, and so on (`KINDS`). It is
drawn at n, 2n and 4n; each command runs in a process of its own. Printed are CPU seconds and peak of resident memory
in MB at each size, and by which power of n both grow between the last two, less what the command needs for an empty
log: 1 is linear, 2 is the square. A command that takes longer than the limit is ended, and its larger sizes are left
out. The longest dimension, time, is here too: minutes of boxes (`minutes`) and of pictures (`video`).
"""

from __future__ import annotations

import argparse
import math
import os
import resource
import shlex
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.log import records
from mcaptrack.schema import TRACKS
from mcaptrack.schema.encodings import PROTOBUF, record_of

START = "import sys; from mcaptrack.cli import app; sys.argv[0] = 'mcaptrack'; app()"
READ = (
    "info a.mcap --json",
    "check a.mcap",
    "recover a.mcap -o again.mcap",
    "drop a.mcap /drop/* -o less.mcap",
    "run a.mcap",
    "export a.mcap -o tables",
    "query a.mcap 'select 1'",
)
SCORED = (
    "run a.mcap",
    "evaluate a.mcap",
    "events a.mcap --force",
    "export a.mcap -o tables",
    "report a.mcap -o a.html",
    "drop a.mcap /camera/tracks -o less.mcap",
)


# Boxes and tracks


def boxes(folder: Path, count: int, frames: int = 1) -> list[str]:
    """Boxes in a frame, and as many true ones, as dense at each size."""
    rng = np.random.default_rng(1)
    side = math.ceil(math.sqrt(count))
    centre = 30.0 * np.stack(np.divmod(np.arange(count), side)[::-1], axis=1) + 20
    for name, noise in (("gt", 0.0), ("det", 1.5)):
        with (folder / f"{name}.txt").open("w") as stream:
            for frame in range(1, frames + 1):
                at = centre + [1.5 * frame, 0] + rng.normal(0, 1, centre.shape) * noise
                stream.writelines(
                    f"{frame},{number if name == 'gt' else -1},{x:.1f},{y:.1f},16,36,0.9,-1,-1,-1\n"
                    for number, (x, y) in enumerate(at.tolist(), 1)
                )
    (folder / "plane.txt").write_text("0.05 0 0\n0 0.05 0\n0 0 1\n")
    take = "ingest det.txt --as detections --truth gt.txt --format mot --fps 10 --ground-plane plane.txt -o a.mcap"
    return [take, *SCORED]


def crowd(folder: Path, count: int) -> list[str]:
    """People who walk side by side through nine frames."""
    return boxes(folder, count, 9)


def boxes_3d(folder: Path, count: int) -> list[str]:
    """Boxes in space in each of five frames, and as many true ones."""
    rng = np.random.default_rng(1)
    side = math.ceil(math.sqrt(count))
    centre = 4.0 * np.stack(np.divmod(np.arange(count), side), axis=1)
    for name, noise in (("gt", 0.0), ("det", 0.1)):
        with (folder / f"{name}.csv").open("w") as stream:
            stream.write("t,id,name,x_m,y_m,z_m,length_m,width_m,height_m,heading_rad,score\n")
            for frame in range(5):
                at = centre + [0.4 * frame, 0] + rng.normal(0, 1, centre.shape) * noise
                stream.writelines(
                    f"{frame / 10},{number if name == 'gt' else ''},pedestrian,{x:.2f},{y:.2f},0.9,.7,.7,1.8,0,0.9\n"
                    for number, (x, y) in enumerate(at.tolist(), 1)
                )
    return ["ingest det.csv --as detections --truth gt.csv -o a.mcap", *SCORED]


def tracks(folder: Path, count: int) -> list[str]:
    """Short tracks that follow one another, ten at a time, and as many true ones."""
    rng = np.random.default_rng(1)
    for name in ("gt", "tracks"):
        with (folder / f"{name}.txt").open("w") as stream:
            for frame in range(1, 8 * count // 10 + 1):
                batch, step = divmod(frame - 1, 8)
                stream.writelines(
                    f"{frame},{10 * batch + number + 1},{x:.1f},{90 * number:.1f},16,36,0.9,-1,-1,-1\n"
                    for number, x in enumerate((rng.random(10) + 20 + 8 * step + 300 * (batch % 2)).tolist())
                )
    (folder / "plane.txt").write_text("0.05 0 0\n0 0.05 0\n0 0 1\n")
    return [
        "ingest tracks.txt --as tracks --truth gt.txt --format mot --fps 5 --ground-plane plane.txt -o a.mcap",
        *SCORED,
    ]


def classes(folder: Path, count: int) -> list[str]:
    """Classes of objects, each with a box in each of five frames."""
    rng = np.random.default_rng(1)
    side = math.ceil(math.sqrt(count))
    for name in ("gt", "det"):
        with (folder / f"{name}.csv").open("w") as stream:
            stream.write("t,id,name,x,y,w,h,score\n")
            for frame in range(5):
                stream.writelines(
                    f"{frame / 10},{n + 1 if name == 'gt' else ''},kind{n},"
                    f"{40 * (n % side) + r:.2f},{60 * (n // side)},16,36,.9\n"
                    for n, r in enumerate(rng.random(count).tolist())
                )
    return ["ingest det.csv --as detections --truth gt.csv -o a.mcap", *SCORED]


def minutes(folder: Path, count: int) -> list[str]:
    """Minutes of 50 people at 10 Hz."""
    rng = np.random.default_rng(1)
    place, speed = rng.uniform([100, 100], [1800, 900], (50, 2)), rng.normal(0, 4, (50, 2))
    with (folder / "a.txt").open("w") as stream:
        for frame in range(1, count * 600 + 1):
            speed = np.clip(speed + rng.normal(0, 0.4, speed.shape), -8, 8)
            place += speed
            speed[(place < [50, 50]) | (place > [1850, 950])] *= -1
            seen = np.flatnonzero(rng.random(50) < 0.95)
            at = place[seen] + rng.normal(0, 1, (len(seen), 2))
            stream.writelines(f"{frame},-1,{x:.1f},{y:.1f},40,100,0.9,-1,-1,-1\n" for x, y in at.tolist())
    return ["ingest a.txt --as detections --format mot --fps 10 -o a.mcap", "run a.mcap", "export a.mcap -o tables"]


def video(folder: Path, count: int) -> list[str]:
    """Quarters of a minute of 7 people on a textured floor, 25 pictures a second."""
    import av

    rng = np.random.default_rng(1)
    floor = np.clip(rng.normal(110, 12, (240, 320)), 0, 255).astype(np.uint8)
    place, speed = rng.uniform([10, 60], [300, 180], (7, 2)), rng.normal(0, 1.2, (7, 2))
    with av.open(str(folder / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"preset": "ultrafast", "g": "50"})
        stream.width, stream.height, stream.pix_fmt = 320, 240, "gray"
        for _ in range(count * 375):
            speed = np.clip(speed + rng.normal(0, 0.1, speed.shape), -2, 2)
            place += speed
            speed[(place < [5, 50]) | (place > [300, 190])] *= -1
            place = np.clip(place, [5, 50], [300, 190])
            picture = floor.copy()
            for number, (x, y) in enumerate(place.astype(int).tolist()):
                picture[y : y + 40, x : x + 14] = 20 + 30 * number
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "gray")))
        container.mux(stream.encode(None))
    return ["ingest a.mp4 -o a.mcap", "run a.mcap", "export a.mcap -o tables"]


# What a log consists of


def chunks(folder: Path, count: int) -> list[str]:
    """Chunks, of one message of tracks each."""
    with log.create(folder / "a.mcap") as writer:
        channel = writer.add_channel("/camera/tracks", record_of(TRACKS, PROTOBUF), PROTOBUF, {})
        gone = writer.add_channel("/drop/a", ("", "", b""), "raw", {})
        writer.write_description(channel)
        writer.write_description(gone)
        for number in range(count):
            rows = TRACKS.rows(
                track_id=[number // 500], x_m=[number % 500 / 10], y_m=[1.0], observed=[True], source_id=[-1]
            )
            of, payload = (channel, TRACKS.codec.encode(rows)) if number % 8 else (gone, b"")
            t_ns = number * 100_000_000
            head = records.RECORD_MESSAGE_HEAD.pack(records.Opcode.MESSAGE, len(payload) + 22, of, number, t_ns, t_ns)
            writer.write_kept_records("rows", [(of, t_ns, memoryview(head + payload))])
    return list(READ)


def channels(folder: Path, count: int) -> list[str]:
    """Channels of other software with two messages each; a quarter of them are dropped."""
    return _other_software(folder, count, schemas=1, messages=2)


def schemas(folder: Path, count: int) -> list[str]:
    """Schemas, each of one channel."""
    return _other_software(folder, count, schemas=count, messages=2)


def groups(folder: Path, count: int) -> list[str]:
    """Channels that have chunks of their own."""
    return _other_software(folder, count, schemas=1, messages=2, is_grouped=True)


def attachments(folder: Path, count: int) -> list[str]:
    """Attachments of few bytes."""
    return _other_software(folder, 4, attachments=count)


def metadata(folder: Path, count: int) -> list[str]:
    """Metadata records."""
    return _other_software(folder, 4, metadata=count)


def same_time(folder: Path, count: int) -> list[str]:
    """Messages of the same time."""
    return _other_software(folder, 4, messages=count // 4, step_ns=0)


def topic_length(folder: Path, count: int) -> list[str]:
    """Characters of the topics of eight channels."""
    return _other_software(folder, 8, path="x" * count)


def cameras(folder: Path, count: int) -> list[str]:
    """Cameras with boxes of tracks of their own, in three frames each."""
    rows = TRACKS.rows(track_id=[1, 2], x_m=[1.0, 5.0], y_m=[1.0, 2.0], observed=[True] * 2, source_id=[-1] * 2)
    with log.create(folder / "a.mcap") as writer:
        for number in range(count):
            one = writer.add_channel(f"/cam{number}/tracks", record_of(TRACKS, PROTOBUF), PROTOBUF, {})
            for frame in range(3):
                writer.add_message(one, frame * 400_000_000, frame, TRACKS.codec.encode(rows))
        for frame in range(3):
            one = writer.add_channel(f"/drop/{frame}", ("", "", b""), "raw", {})
            writer.add_message(one, frame, 0, b"")
    return list(READ)


def _other_software(
    folder: Path,
    count: int,
    *,
    schemas: int = 0,
    messages: int = 1,
    attachments: int = 0,
    metadata: int = 0,
    step_ns: int = 1_000_000_000,
    path: str = "sensor",
    is_grouped: bool = False,
) -> list[str]:
    rows = TRACKS.rows(track_id=[1, 2], x_m=[1.0, 5.0], y_m=[1.0, 2.0], observed=[True] * 2, source_id=[-1] * 2)
    with log.create(folder / "a.mcap") as writer:
        tracked = writer.add_channel("/camera/tracks", record_of(TRACKS, PROTOBUF), PROTOBUF, {})
        for number in range(9):
            writer.add_message(tracked, number * 200_000_000, number, TRACKS.codec.encode(rows))
        ids = [
            writer.add_channel(
                f"/{path if number % 4 else 'drop'}/{number}",
                (f"pkg/S{number % schemas}", "jsonschema", b"{}") if schemas else ("", "", b""),
                "json",
                {},
                group=str(number) if is_grouped else "",
            )
            for number in range(count)
        ]
        for number in range(messages):
            for one in ids:
                writer.add_message(one, number * step_ns + 1, number, struct.pack("<d", number))
        for number in range(attachments):
            writer.add_attachment(f"notes {number}", "text/plain", b"note")
        for number in range(metadata):
            writer.add_metadata(f"notes {number}", {"a": "b"})
    return list(READ)


class Kind(NamedTuple):
    """What draws a log and returns the commands to run, and the smallest size."""

    draw: Callable[[Path, int], list[str]]
    size: int


KINDS = {
    "boxes": Kind(boxes, 5_000),
    "crowd": Kind(crowd, 500),
    "boxes-3d": Kind(boxes_3d, 1_000),
    "tracks": Kind(tracks, 1_000),
    "classes": Kind(classes, 250),
    "minutes": Kind(minutes, 1),
    "video": Kind(video, 1),
    "chunks": Kind(chunks, 10_000),
    "channels": Kind(channels, 4_000),
    "schemas": Kind(schemas, 4_000),
    "groups": Kind(groups, 4_000),
    "cameras": Kind(cameras, 50),
    "attachments": Kind(attachments, 10_000),
    "metadata": Kind(metadata, 10_000),
    "same-time": Kind(same_time, 20_000),
    "topic-length": Kind(topic_length, 4_000),
}


class Cost(NamedTuple):
    """What a command took: its exit code, CPU seconds, and peak of resident memory in MB."""

    code: int
    seconds: float
    megabytes: float


def measured(line: str, folder: Path, limit_s: int) -> Cost:
    """Run a command in a child, at most so many CPU seconds."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("MCAPTRACK_")}

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))
        resource.setrlimit(resource.RLIMIT_AS, (20 * 2**30, 20 * 2**30))

    with (folder / "said.txt").open("wb") as said:
        process = subprocess.Popen(
            [sys.executable, "-c", START, *shlex.split(line)],
            cwd=folder,
            env=environment,
            stdout=said,
            stderr=said,
            preexec_fn=limited,  # noqa: PLW1509 - this process has one thread
        )
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    peak = usage.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
    return Cost(process.returncode, usage.ru_utime + usage.ru_stime, peak)


def power(costs: list[float], rest: float) -> str:
    """By which power of the size the last cost grew, less the ``rest`` that any log costs; - if that is more."""
    if len(costs) < 2:
        return "-"
    before, last = (cost - rest for cost in costs[-2:])
    return f"{math.log2(last / before):.1f}" if before > 0.2 * rest and last > 0 else "-"


def measurements(wanted: list[str], sizes: list[int] | None, steps: int, limit_s: int) -> Iterator[str]:
    """A line of the table for each command on each kind of log."""
    with tempfile.TemporaryDirectory() as name:
        rest = measured("docs", Path(name), limit_s)
    for kind in wanted:
        costs: dict[str, list[Cost]] = {}
        those = sizes or [KINDS[kind].size * 2**step for step in range(steps)]
        for size in those:
            with tempfile.TemporaryDirectory() as name:
                for line in KINDS[kind].draw(Path(name), size):
                    if costs.get(line) and costs[line][-1].code < 0:
                        continue
                    cost = measured(line, Path(name), limit_s)
                    costs.setdefault(line, []).append(cost)
                    if cost.code:
                        said = (Path(name) / "said.txt").read_text(errors="replace").strip().splitlines()
                        why = said[-1][:110] if said and cost.code > 0 else "ended"
                        print(f"  {kind} {size}: {line}: {cost.code}: {why}", file=sys.stderr)
        for line, those_costs in costs.items():
            seconds = [cost.seconds for cost in those_costs]
            megabytes = [cost.megabytes for cost in those_costs]
            failed = any(cost.code for cost in those_costs)
            yield (
                f"{kind:14}{line.split()[0]:10}{' '.join(f'{s:7.1f}' for s in seconds):24}"
                f"{power(seconds, rest.seconds):>5}  {' '.join(f'{m:7.0f}' for m in megabytes):24}"
                f"{power(megabytes, rest.megabytes):>5}{'  fails' if failed else ''}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--sizes", nargs="+", type=int, help="instead of n, 2n, 4n")
    parser.add_argument("--steps", type=int, default=3, help="how often the size is doubled, and once")
    parser.add_argument("--limit-s", type=int, default=120, help="CPU seconds after which a command is ended")
    asked = parser.parse_args()
    print(f"{'log':14}{'command':10}{'CPU s at n, 2n, 4n':24}{'power':>5}  {'MB':24}{'power':>5}")
    for line in measurements(asked.only, asked.sizes, asked.steps, asked.limit_s):
        print(line, flush=True)


if __name__ == "__main__":
    main()
