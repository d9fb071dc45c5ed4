"""What a log costs, beside copying the file and beside the stock MCAP library in the same run.

python tools/bench/log.py [--gigabytes 2] [--folder DIR]

Adding 10 000 messages to a large log in place against copying the file cold, with the bytes that were written and the
memory that it took; reading and writing 200 000 messages of 250 bytes against the stock reader and writer, also with
its types; and rows as columns against the stock reader with protobuf decoding.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

import mcaptrack
from mcaptrack import log
from mcaptrack.schema import TRACKS

SCHEMA = ("test.Thing", "jsonschema", b"{}")


def seconds(work: Callable[[], object], times: int = 3) -> float:
    """The best of some runs."""
    best = float("inf")
    for _ in range(times):
        started = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - started)
    return best


def write_large(path: Path, gigabytes: float) -> None:
    picture = random.Random(1).randbytes(130_000)
    with log.create(path) as writer:
        number = writer.add_channel("/video", SCHEMA, "json", {}, "media")
        for n in range(int(gigabytes * 1e9 / len(picture))):
            writer.add_message(number, n * 10**7, n, picture)


def add_rows(path: Path) -> None:
    rows = TRACKS.empty(40)
    payload = TRACKS.codec.encode(rows)
    with log.read(path) as opened, log.extend(opened, drop=["/rows"]) as writer:
        number = writer.add_channel("/rows", (TRACKS.name, "protobuf", TRACKS.descriptor), "protobuf", {})
        for n in range(10_000):
            writer.add_message(number, n * 10**7, n, payload)


def drop_from_cache(path: Path) -> None:
    with path.open("rb") as stream:
        os.fsync(stream.fileno())
        os.posix_fadvise(stream.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def written_bytes() -> int:
    words = Path("/proc/self/io").read_text(encoding="ascii").split()
    return int(words[words.index("wchar:") + 1])


def bench_extension(folder: Path, gigabytes: float) -> None:
    path = folder / "large.mcap"
    write_large(path, gigabytes)
    size = path.stat().st_size
    drop_from_cache(path)
    copy = seconds(lambda: shutil.copyfile(path, folder / "copy.mcap"), 1)
    (folder / "copy.mcap").unlink()
    drop_from_cache(path)
    alone = [sys.executable, __file__, "--measure", str(path)]
    said = subprocess.run(alone, check=True, capture_output=True, text=True).stdout.split()
    took, wrote, memory = float(said[0]), int(said[1]), int(said[2])
    added = path.stat().st_size - size
    print(
        f"adding 10 000 messages to {size / 1e9:.2f} GB: {took:.3f} s, {took / copy:.1%} of a cold copy ({copy:.2f} s)"
    )
    print(f"  wrote {wrote / 1e6:.2f} MB, of which the log grew {added / 1e6:.2f} MB; {memory / 1e3:.0f} MB of memory")


def measure(path: str) -> None:
    """In a process of its own: time, bytes written, and memory after reading everything too."""
    before, started = written_bytes(), time.perf_counter()
    add_rows(Path(path))
    took, wrote = time.perf_counter() - started, written_bytes() - before
    with log.read(Path(path)) as opened:
        for topic in opened.channels:
            for _ in opened.messages(topic):
                pass
    print(took, wrote, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def bench_messages(folder: Path) -> None:
    payload = random.Random(2).randbytes(125).hex().encode()
    ours, theirs = folder / "ours.mcap", folder / "theirs.mcap"

    def write_ours() -> None:
        with log.create(ours) as writer:
            number = writer.add_channel("/a", SCHEMA, "json", {})
            for n in range(200_000):
                writer.add_message(number, n, n, payload)

    def write_theirs() -> None:
        with theirs.open("wb") as stream:
            writer = Writer(stream)
            writer.start()
            channel = writer.register_channel("/a", "json", writer.register_schema(*SCHEMA))
            for n in range(200_000):
                writer.add_message(channel, n, payload, n, n)
            writer.finish()

    def read_ours() -> None:
        with log.read(theirs) as opened:
            assert sum(1 for _ in opened.messages("/a")) == 200_000

    def read_theirs() -> None:
        with theirs.open("rb") as stream:
            assert sum(1 for _ in make_reader(stream).iter_messages()) == 200_000

    def read_records() -> None:
        with mcaptrack.open(theirs) as opened:
            assert sum(1 for _ in opened.messages(decode=False)) == 200_000

    print(f"writing raw messages: {seconds(write_theirs) / seconds(write_ours):.1f} times the stock writer's speed")
    stock = seconds(read_theirs)
    print(f"reading raw messages: {stock / seconds(read_ours):.1f} times the stock reader's speed")
    print(f"  with the stock reader's types: {stock / seconds(read_records):.1f} times")


def bench_columns(folder: Path) -> None:
    path = folder / "rows.mcap"
    with log.create(path):
        pass
    add_rows(path)

    def theirs() -> None:
        with path.open("rb") as stream:
            decoded = make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
            rows = [row for *_, message in decoded for row in message.rows]
            columns = {name: np.array([getattr(row, name) for row in rows]) for name in TRACKS.dtype.names or ()}
            assert len(columns["x_m"]) == 400_000

    def ours() -> None:
        with log.read(path) as opened:
            rows = opened.rows("/rows", TRACKS).rows
            columns = {name: np.ascontiguousarray(rows[name]) for name in TRACKS.dtype.names or ()}
            assert len(columns["x_m"]) == 400_000

    print(f"rows as columns: {seconds(theirs, 1) / seconds(ours):.1f} times the stock reader with protobuf")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gigabytes", type=float, default=2.0, help="size of the large log")
    parser.add_argument("--folder", type=Path, default=None, help="where to write (needs twice that room)")
    parser.add_argument("--measure", default=None, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.measure:
        measure(given.measure)
        return
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        bench_messages(Path(name))
        bench_columns(Path(name))
        bench_extension(Path(name), given.gigabytes)


if __name__ == "__main__":
    main()
