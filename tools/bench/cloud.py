"""A log of 1 GB in a store: requests and bytes for one channel, and a whole run beside it.

    .venv/bin/python -m tools.bench.cloud            # 1000 MB
    .venv/bin/python -m tools.bench.cloud --mb 100   # a smaller one

Starts an S3 server (moto) on this machine, writes a log of laser scans, boxes and tracks to it, and prints requests and
bytes of: opening the log, one channel of tracks, a query, `info`, and `run` on the recorded boxes. The results of `run`
are compared with those beside a file, to the byte. Once more with one request in five failing.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import numpy as np

import mcaptrack
from mcaptrack import log
from mcaptrack.schema import DETECTIONS, TRACKS

#: Bytes of a scan, frames per second, and people in each frame.
SCAN, FPS, PEOPLE = 2**18, 10, 8


def boxes(number: int) -> dict[str, np.ndarray]:
    """Boxes of people who walk in lines, in one frame."""
    x_px = 60.0 + 1.5 * number % 500 + 7 * np.arange(PEOPLE)
    return {
        "x_px": x_px,
        "y_px": 100.0 + 40 * np.arange(PEOPLE),
        "w_px": np.full(PEOPLE, 24.0),
        "h_px": np.full(PEOPLE, 60.0),
    }


def draw(path: Path, megabytes: int) -> None:
    """Write a log of scans, with recorded boxes and, of another program, tracks between them."""
    random = np.random.default_rng(1)
    with log.create(path) as writer:
        points = writer.add_channel("/lidar/points", ("", "", b""), "raw", {}, "media")
        channels = [
            writer.add_channel(topic, (schema.name, "protobuf", schema.descriptor), "protobuf", {}, "rows", topic)
            for schema, topic in ((DETECTIONS, "/boxes/detections"), (TRACKS, "/other/tracks"))
        ]
        for number in range(megabytes * 1_000_000 // SCAN):
            t_ns, found = number * 10**9 // FPS, boxes(number)
            writer.add_message(points, t_ns, number, random.bytes(SCAN))
            rows = DETECTIONS.rows(**found, score=np.full(PEOPLE, 0.9), class_id=np.ones(PEOPLE, int))
            writer.add_message(channels[0], t_ns, number, DETECTIONS.codec.encode(rows))
            ones = np.ones(PEOPLE, int)
            ids = {"track_id": np.arange(1, PEOPLE + 1), "source_id": 0 * ones, "class_id": ones}
            rows = TRACKS.rows(**found, **ids, score=np.full(PEOPLE, 0.9), observed=ones.astype(bool))
            writer.add_message(channels[1], t_ns, number, TRACKS.codec.encode(rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mb", type=int, default=1000)
    given = parser.parse_args()
    from tests.stores import Store

    store = Store()
    os.environ.update(store.environment)
    size = 0

    @contextmanager
    def measured(what: str) -> Iterator[None]:
        began = time.monotonic()
        with store.counted() as requests:
            yield
        read = sum(one.bytes for one in requests if one.method == "GET")
        kinds = ", ".join(
            f"{sum(one.method == kind for one in requests)} {kind}" for kind in sorted({one.method for one in requests})
        )
        seconds = time.monotonic() - began
        print(
            f"{what}: {len(requests)} requests ({kinds}), {read:,} bytes, {read / size:.3%}, {seconds:.1f} s",
            flush=True,
        )

    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)
        path = Path("drive.mcap")
        draw(path, given.mb)
        size = path.stat().st_size
        url = store.put("night/drive.mcap", path)
        print(f"a log of {size / 1e6:,.0f} MB")
        with measured("open"), mcaptrack.open(url) as opened:
            assert opened.topics
        with measured("one channel of tracks"), mcaptrack.open(url) as opened:
            rows = len(opened.array("tracks", "/other/tracks"))
        with mcaptrack.open(path) as opened:
            assert rows == len(opened.array("tracks", "/other/tracks")) > 0
        with measured("info"):
            mcaptrack.info(url)
        with measured("query: number of tracks"):
            mcaptrack.query(url, "select count(distinct track_id) from tracks where topic = '/other/tracks'")
        mcaptrack.run(path, topic="/boxes/detections", sidecar=True, tables=False)
        expected = Path("drive.results.mcap").read_bytes()
        for what, every in (("run", 0), ("run, one request in five failing", 5)):
            store.client.delete_object(Bucket="bucket", Key="night/drive.results.mcap")
            number = count(1)
            with (
                store.failing(
                    lambda _, every=every, number=number: "error" if every and not next(number) % every else ""
                ),  # type: ignore[misc]
                measured(what),
            ):
                mcaptrack.run(url, topic="/boxes/detections")
            same = store.get("night/drive.results.mcap") == expected
            print(f"  {'yes' if same else 'NO'}: the same results as beside a file, to the byte")
            if not same:
                sys.exit(1)
        os.chdir("/")
    store.stop()


if __name__ == "__main__":
    main()
