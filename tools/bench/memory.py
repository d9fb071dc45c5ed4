"""Peak memory and time of commands on long logs: whether either grows faster than the log.

    .venv/bin/python tools/bench/memory.py [--full] [--only NAME ...]

Each command runs in a process of its own, whose peak of resident memory is printed, with seconds of the processor,
in all and a minute of the log (those of the clock grow with other work on the machine):

- `video`: 7 people, 25 pictures a second; `ingest`, `run` and `export`;
- `boxes`: rows of 50 people at 10 Hz, from a label file; `ingest`, `run`, `export`, `check` and `recover`;
- `chunks` and `channels`: a log with many chunks, and one with many channels; every command that reads any log.

By default 1 minute of video, 2 and 10 minutes of boxes, 20,000 chunks and 2,000 channels; with `--full` 1, 10 and 60
minutes of video, 10 minutes, 1 hour and 10 hours of boxes, 200,000 chunks and 10,000 channels, which takes hours.
"""

from __future__ import annotations

import argparse
import os
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mcaptrack import log
from mcaptrack.log import records
from mcaptrack.schema import TRACKS
from mcaptrack.schema.encodings import PROTOBUF, record_of

PEOPLE, FPS = 7, 25
BOXES, BOX_HZ = 50, 10
RUN = ("run {0}", "export {0} -o tables")
READ = ("info {0}", "check {0}", "recover {0} -o again.mcap", "run {0}", "export {0} -o tables", "query {0} 'select 1'")


class Sizes(NamedTuple):
    """What is measured: minutes of video, minutes of boxes, chunks and channels."""

    video: tuple[float, ...]
    boxes: tuple[float, ...]
    chunks: tuple[int, ...]
    channels: tuple[int, ...]


SHORT = Sizes((1,), (2, 10), (20_000,), (2_000,))
FULL = Sizes((1, 10, 60), (10, 60, 600), (200_000,), (10_000,))


def video(folder: Path, minutes: float) -> list[str]:
    """A video of people who walk about on a textured floor; returns the commands to run."""
    import av

    rng = np.random.default_rng(1)
    floor = np.clip(rng.normal(110, 12, (240, 320)), 0, 255).astype(np.uint8)
    place, speed = rng.uniform([10, 60], [300, 180], (PEOPLE, 2)), rng.normal(0, 1.2, (PEOPLE, 2))
    with av.open(str(folder / "a.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"preset": "ultrafast", "g": "50"})
        stream.width, stream.height, stream.pix_fmt = 320, 240, "gray"
        for _ in range(round(minutes * 60 * FPS)):
            speed = np.clip(speed + rng.normal(0, 0.1, speed.shape), -2, 2)
            place += speed
            speed[(place < [5, 50]) | (place > [300, 190])] *= -1
            place = np.clip(place, [5, 50], [300, 190])
            picture = floor.copy()
            for number, (x, y) in enumerate(place.astype(int).tolist()):
                picture[y : y + 40, x : x + 14] = 20 + 30 * number
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "gray")))
        container.mux(stream.encode(None))
    return ["ingest a.mp4 -o a.mcap", *(line.format("a.mcap") for line in RUN)]


def boxes(folder: Path, minutes: float) -> list[str]:
    """A label file of boxes of people who walk about; returns the commands to run."""
    rng = np.random.default_rng(1)
    place, speed = rng.uniform([100, 100], [1800, 900], (BOXES, 2)), rng.normal(0, 4, (BOXES, 2))
    with (folder / "a.txt").open("w") as stream:
        for frame in range(1, round(minutes * 60 * BOX_HZ) + 1):
            speed = np.clip(speed + rng.normal(0, 0.4, speed.shape), -8, 8)
            place += speed
            speed[(place < [50, 50]) | (place > [1850, 950])] *= -1
            seen = np.flatnonzero(rng.random(BOXES) < 0.95)
            noise = rng.normal(0, 1, (len(seen), 2))
            stream.writelines(
                f"{frame},-1,{x:.1f},{y:.1f},40,100,{0.9:.1f},-1,-1,-1\n" for x, y in (place[seen] + noise).tolist()
            )
    return [
        f"ingest a.txt --as detections --format mot --fps {BOX_HZ} -o a.mcap",
        *(line.format("a.mcap") for line in RUN),
        "check a.mcap",
        "recover a.mcap -o again.mcap",
    ]


def chunks(folder: Path, count: int) -> list[str]:
    """A log of tracks with a chunk for each message; returns the commands to run."""
    with log.create(folder / "a.mcap") as writer:
        channel = writer.add_channel("/camera/tracks", record_of(TRACKS, PROTOBUF), PROTOBUF, {})
        writer.write_description(channel)
        for number in range(count):
            rows = TRACKS.rows(
                track_id=[number // 500], x_m=[number % 500 / 10], y_m=[1.0], observed=[True], source_id=[-1]
            )
            t_ns, payload = number * 100_000_000, TRACKS.codec.encode(rows)
            head = records.RECORD_MESSAGE_HEAD.pack(
                records.Opcode.MESSAGE, len(payload) + 22, channel, number, t_ns, t_ns
            )
            writer.write_kept_records("rows", [(channel, t_ns, memoryview(head + payload))])
    return [line.format("a.mcap") for line in READ]


def channels(folder: Path, count: int) -> list[str]:
    """A log with channels of other software, 20 messages each; returns the commands to run."""
    with log.create(folder / "a.mcap") as writer:
        ids = [writer.add_channel(f"/sensor/{number}", ("", "", b""), "raw", {}) for number in range(count)]
        for number in range(20):
            for one in ids:
                writer.add_message(one, number * 1_000_000_000 + one, number, struct.pack("<d", number))
    return [line.format("a.mcap") for line in READ]


KINDS = {"video": video, "boxes": boxes, "chunks": chunks, "channels": channels}


def measured(line: str, folder: Path) -> tuple[int, float, float]:
    """Exit code, seconds of the processor and peak of resident memory in MB of a command."""
    import shlex

    environment = {name: value for name, value in os.environ.items() if not name.startswith("MCAPTRACK_")}
    with (folder / "said.txt").open("wb") as said:
        process = subprocess.Popen(
            [sys.executable, "-m", "mcaptrack", *shlex.split(line)],
            cwd=folder,
            env=environment,
            stdout=said,
            stderr=said,
        )
        _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return (
        process.returncode,
        usage.ru_utime + usage.ru_stime,
        usage.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3),
    )


def measurements(sizes: Sizes, wanted: list[str]) -> Iterator[str]:
    """A line of the table for each command on each log."""
    for kind in wanted:
        for size in getattr(sizes, kind):
            with tempfile.TemporaryDirectory() as name:
                folder = Path(name)
                is_time = kind in ("video", "boxes")
                label = f"{size:g} min of {kind}" if is_time else f"{size:,} {kind}"
                for line in KINDS[kind](folder, size):
                    code, seconds, megabytes = measured(line, folder)
                    ended = "" if code in (0, 1) else f"  exit {code}"
                    rate = f"{seconds / size:>9.2f}" if is_time else f"{'':>9}"
                    yield f"{label:22}{line.split()[0]:10}{megabytes:>8.0f}{seconds:>9.1f}{rate}{ended}"
                    if code == 1:
                        yield f"{'':22}{(folder / 'said.txt').read_text().splitlines()[-1][:96]}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--full", action="store_true", help="the long logs, which take hours")
    parser.add_argument("--only", nargs="+", choices=list(KINDS), default=list(KINDS))
    given = parser.parse_args()
    print(f"{'log':22}{'command':10}{'MB':>8}{'s':>9}{'s/min':>9}")
    for line in measurements(FULL if given.full else SHORT, given.only):
        print(line, flush=True)


if __name__ == "__main__":
    main()
