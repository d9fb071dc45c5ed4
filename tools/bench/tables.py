"""Ten million rows of tracks as Parquet, against what pyarrow does by default.

Boxes of people who walk are tracked by SORT; its tracks, moved about and with other ids, are repeated up to the
number of rows. Twice: as a hundred logs, a file each, as `mcaptrack export` leaves them, and as one log. Prints CPU
seconds and megabytes, as ratios to `pq.write_table(table, path)` and to the same with `compression="zstd"`, written in
turn in one process, the best of three each: writing alone, and with what stands between a table and a file that can be
trusted (adding up the content, reading back, comparing). Then how long DuckDB takes for the rows of one track, in one
thread.

    .venv/bin/python tools/bench/tables.py [ROWS]

One log of ten million rows takes 4 GB of memory.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pyarrow.parquet as pq

from mcaptrack import tables
from mcaptrack.schema import DETECTIONS, TRACKS, Frame
from mcaptrack.tables import Part, files
from mcaptrack.transforms import TRANSFORMS

FPS, PEOPLE, SECONDS, ROUNDS = 25, 30, 600, 3


def tracked(rng: np.random.Generator) -> list[Frame]:
    """SORT's tracks of people who walk about, seen as whole pixels, as motion detectors see them."""
    count = FPS * SECONDS
    places = rng.uniform([0, 0], [1920, 1080], (PEOPLE, 2))
    speed = rng.normal(0, 60 / FPS, (PEOPLE, 2))
    height = rng.uniform(60, 160, PEOPLE)
    frames = []
    for number in range(count):
        speed += rng.normal(0, 4 / FPS, (PEOPLE, 2)) - 0.01 * speed
        places = (places + speed) % [1920, 1080]
        seen = rng.random(PEOPLE) < 0.95
        w, h = height * 0.4 + rng.normal(0, 1, PEOPLE), height + rng.normal(0, 2, PEOPLE)
        box = np.round(np.stack([places[:, 0] - w / 2, places[:, 1] - h, w, h])[:, seen])
        rows = DETECTIONS.rows(
            **dict(zip(("x_px", "y_px", "w_px", "h_px"), box, strict=True)),
            score=rng.uniform(0.4, 1, seen.sum()).astype(np.float32),
            class_id=np.ones(seen.sum(), np.uint32),
        )
        frames.append(Frame(number * 1_000_000_000 // FPS, number, rows))
    track = TRANSFORMS["track"]()
    return [out[0] for out in track(frames)]


def cut(frames: list[Frame], rows: int) -> list[Frame]:
    """The first frames, up to about this many rows."""
    ends = np.cumsum([len(frame.rows) for frame in frames])
    return frames[: int(np.searchsorted(ends, rows)) + 1]


def repeated(frames: list[Frame], rows: int, rng: np.random.Generator, first: int = 0) -> Part:
    """The same tracks again and again, each time later, elsewhere and with other ids, with places in metres."""
    one = tables.build.frames_to_part(TRACKS, frames)
    times = max(1, round(rows / len(one.rows)))
    out = np.concatenate([one.rows] * times)
    step = len(one.rows)
    for number in range(times):
        part = out[number * step : (number + 1) * step]
        part["track_id"] += (first + number) * (int(one.rows["track_id"].max()) + 1)
        for name in ("x_px", "y_px"):
            part[name] += rng.normal(0, 10)
        depth = 4000 / (part["y_px"] + part["h_px"] + 200)
        part["x_m"], part["y_m"] = (part["x_px"] + part["w_px"] / 2 - 960) * depth / 1000, depth
    later = np.repeat(np.arange(times), len(one.t_ns))
    t_ns = 1_700_000_000_000_000_000 + np.tile(one.t_ns, times) + later * SECONDS * 1_000_000_000
    frame = np.tile(one.frame, times) + later * len(one.t_ns)
    return Part(out, t_ns, frame, np.tile(one.counts, times))


def timed(calls: dict[str, Callable[[], object]]) -> dict[str, float]:
    """The least CPU seconds of each, in turns; what else the machine does hardly counts."""
    best = dict.fromkeys(calls, float("inf"))
    for _ in range(ROUNDS):
        for name, call in calls.items():
            begun = time.process_time()
            call()
            best[name] = min(best[name], time.process_time() - begun)
    return best


def write_all(folder: Path, parts: Iterable[Part]) -> None:
    """Write logs in all ways, and print what that took."""
    order = tables.TABLES["tracks"].order
    took: dict[str, float] = {}
    size: dict[str, int] = {}
    rows = 0
    for number, part in enumerate(parts):
        by_track = tables.rows_in_pieces(TRACKS, {"/camera/tracks": part}).table().combine_chunks()
        by_time = by_track.take(np.argsort(by_track.column("row").to_numpy())).combine_chunks()
        rows += by_track.num_rows
        paths = {
            key: folder / key / f"recording={number}" / "part-0.parquet" for key in ("ours", "alone", "snappy", "zstd")
        }
        for path in paths.values():
            path.parent.mkdir(parents=True)

        def ours(path: Path = paths["ours"], table: Any = by_track) -> None:
            path.unlink(missing_ok=True)
            tables.write(path, table, {}, order)

        def alone(path: Path = paths["alone"], table: Any = by_track) -> None:
            path.unlink(missing_ok=True)
            files._write_parquet(path, table, {}, order)

        calls = {
            "alone": alone,
            "ours": ours,
            "snappy": lambda path=paths["snappy"], table=by_time: pq.write_table(table, path),
            "zstd": lambda path=paths["zstd"], table=by_time: pq.write_table(table, path, compression="zstd"),
            "put in order": lambda part=part: tables.rows_in_pieces(TRACKS, {"/camera/tracks": part}).table(),
        }
        for key, seconds in timed(calls).items():
            took[key] = took.get(key, 0.0) + seconds
        for key, path in paths.items():
            size[key] = size.get(key, 0) + path.stat().st_size
    print(f"{rows:,} rows in {number + 1} files; CPU seconds")
    print(f"ours: {took['alone']:.2f} s, {size['ours'] / 1e6:.0f} MB")
    for peer in ("snappy", "zstd"):
        print(
            f"pyarrow, {peer}: {took[peer]:.2f} s, {size[peer] / 1e6:.0f} MB; ours is "
            f"{took[peer] / took['alone']:.2f} times as fast and {size[peer] / size['ours']:.2f} times as small"
        )
    print(f"ours with digest, reading back and comparing: {took['ours']:.2f} s")
    print(f"before that, rows of the log -> table in its order: {took['put in order']:.2f} s")
    who = int(part.rows["track_id"][len(part.rows) // 2])
    with duckdb.connect() as connection:
        connection.sql("set threads = 1")
        for key in ("ours", "zstd"):
            for where in (f"track_id = {who}", f"recording = {number} and track_id = {who}"):
                query = f"select * from '{folder}/{key}/*/*.parquet' where {where}"
                found = connection.sql(query).to_arrow_table().num_rows
                best = min(timed({"": lambda q=query: connection.sql(q).to_arrow_table()})[""] for _ in range(4))
                print(f"DuckDB, warm, {key}: {found} rows where {where}: {1e3 * best:.1f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", type=int, nargs="?", default=10_000_000)
    wanted = parser.parse_args().rows
    rng = np.random.default_rng(1)
    frames = tracked(rng)
    with tempfile.TemporaryDirectory() as name:
        size = wanted // 100
        log = cut(frames, size)
        write_all(Path(name) / "many", (repeated(log, size, rng, number) for number in range(100)))
    print()
    with tempfile.TemporaryDirectory() as name:
        write_all(Path(name) / "one", [repeated(frames, wanted, rng)])


if __name__ == "__main__":
    main()
