"""Many short logs as Delta tables: four writers at once, one log replaced, one query over all; against deltalake alone.

    .venv/bin/python tools/bench/lake.py              # 500 logs
    .venv/bin/python tools/bench/lake.py --logs 100   # fewer

Draws a log of boxes (3 people, 60 frames), runs all stages on it, and exports it under so many names. Four processes
add them to Delta tables at once, each with a quarter of the logs and with one log that all four add; what stands there
then is counted log by log. Then one log is replaced, and DuckDB and `mcaptrack query` count tracks of all logs. Peers,
in the same call: deltalake alone with one transaction a log for the table `tracks` (written by hand, one writer),
replacing one log in this table by a condition, and DuckDB on the Parquet files of single logs. Seconds are those of
the clock and of the processor; other work on the machine lengthens the former.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import deltalake
import duckdb
import pyarrow.parquet as pq
from fleet import draw

import mcaptrack
from mcaptrack.tables import TABLES
from mcaptrack.tables.delta import ExportedLog, commit, compact

ROUNDS, WRITERS = 7, 4
WRITE = """
import sys
from pathlib import Path
from mcaptrack.api.delta import DeltaBatches
batches = DeltaBatches(Path(sys.argv[1]))
for name in sys.argv[3:]:
    batches.add(Path(name), Path(sys.argv[2]))
done = batches.finish()
assert not done.failed, done.failed
print(len(done.added), len(done.replaced), len(done.unchanged), done.transactions, done.conflicts)
"""


def cpu_s(who: int = resource.RUSAGE_SELF) -> float:
    """Return the processor time of this process with all its threads, or of those that it waited for."""
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


def timed(work: Callable[[], object], rounds: int = ROUNDS) -> str:
    """Return the median seconds of some work, by the clock and of the processor."""
    clock, cpu = [], []
    for _ in range(rounds):
        begun, used = time.perf_counter(), cpu_s()
        work()
        clock.append(time.perf_counter() - begun)
        cpu.append(cpu_s() - used)
    return f"{statistics.median(clock):.3f} s ({statistics.median(cpu):.3f} s of processor)"


def make_logs(folder: Path, count: int) -> list[Path]:
    """Export one log under many names."""
    draw(folder / "drawn", 5)
    first = folder / "drawn" / "log000.mcap"
    mcaptrack.run(first, tables=False)
    logs = [folder / f"night{number:04}.mcap" for number in range(count)]
    for path in logs:
        shutil.copyfile(first, path)
        mcaptrack.export(path, folder / "tables")
    return logs


def write_at_once(folder: Path, logs: list[Path]) -> None:
    """Let several processes add logs, and count what stands there then."""
    lake = folder / "lake"
    begun, used = time.perf_counter(), cpu_s(resource.RUSAGE_CHILDREN)
    running = []
    for number in range(WRITERS):
        mine = [*logs[number::WRITERS], logs[0]]
        words = [sys.executable, "-c", WRITE, lake, folder / "tables", *dict.fromkeys(mine)]
        running.append(subprocess.Popen(list(map(str, words)), stdout=subprocess.PIPE, text=True))
    totals = [tuple(map(int, one.communicate()[0].split())) for one in running]
    assert not any(one.returncode for one in running)
    clock, cpu = time.perf_counter() - begun, cpu_s(resource.RUSAGE_CHILDREN) - used
    added, replaced, unchanged, transactions, conflicts = map(sum, zip(*totals, strict=True))
    print(
        f"{len(logs)} logs by {WRITERS} writers: {clock:.1f} s, {cpu:.1f} s of processor "
        f"({1e3 * cpu / len(logs):.0f} ms a log)"
    )
    print(
        f"  {added} added, {replaced} replaced, {unchanged} unchanged; "
        f"{transactions} transactions, {conflicts} repeated"
    )
    lost = doubled = 0
    for name in TABLES:
        found = Counter(
            deltalake.DeltaTable(lake / name).to_pyarrow_dataset().to_table(["recording"])["recording"].to_pylist()
        )
        rows = pq.read_metadata(ExportedLog(logs[0], folder / "tables").file(name)).num_rows
        lost += sum(found[path.stem] < rows for path in logs)
        doubled += sum(found[path.stem] > rows for path in logs)
    print(f"  logs that lack rows: {lost}; logs with rows twice: {doubled}; in all {len(TABLES)} tables")


def by_hand(folder: Path, logs: list[Path]) -> None:
    """What one writes with deltalake alone, for one of the tables."""
    target, used, begun = folder / "hand", cpu_s(), time.perf_counter()
    for path in logs:
        table = pq.read_table(ExportedLog(path, folder / "tables").file("tracks"), partitioning=None)
        deltalake.write_deltalake(
            target, table.append_column("recording", [[path.stem] * table.num_rows]), mode="append"
        )
    clock, cpu = time.perf_counter() - begun, cpu_s() - used
    print(f"deltalake alone, one writer, a transaction a log, only `tracks`: {clock:.1f} s, {cpu:.1f} s of processor")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=500)
    count = parser.parse_args().logs
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        os.chdir(folder)
        logs = make_logs(folder, count)
        lake = folder / "lake"
        write_at_once(folder, logs)
        by_hand(folder, logs)
        one = logs[count // 2]

        def replace_by_hand() -> None:
            table = pq.read_table(ExportedLog(one, folder / "tables").file("tracks"), partitioning=None)
            table = table.append_column("recording", [[one.stem] * table.num_rows])
            deltalake.write_deltalake(folder / "hand", table, mode="overwrite", predicate=f"recording = '{one.stem}'")

        def replace(force: bool) -> Callable[[], object]:
            return lambda: commit(lake, [ExportedLog(one, folder / "tables")], force=force)

        query = "select recording, count(distinct track_id), max(x_m) from {} group by recording"
        single = folder / "tables"
        hive = f"'{folder}/tables/tracks/*/*.parquet'"
        for state in ("as written", "compacted"):
            if state == "compacted":
                print(f"compacting: {timed(lambda: compact(lake), 1)}")
                deltalake.DeltaTable(folder / "hand").optimize.compact()
            print(f"{state}:")
            print(f"  one log replaced, all its tables: {timed(replace(True))}")
            print(f"  a log that is unchanged: {timed(replace(False))}")
            print(f"  deltalake alone, only `tracks`: {timed(replace_by_hand)}")
            print(f"  query over all, mcaptrack: {timed(lambda: mcaptrack.query(lake, query.format('tracks')))}")

            def by_duckdb() -> None:
                rows = deltalake.DeltaTable(lake / "tracks").to_pyarrow_dataset()  # noqa: F841  # DuckDB finds it
                assert len(duckdb.sql(query.format("rows")).fetchall()) == count

            print(f"  query over all, DuckDB on the Delta table: {timed(by_duckdb)}")
        print(f"DuckDB on {count} Parquet files: {timed(lambda: duckdb.sql(query.format(hive)).fetchall())}")
        ours = timed(lambda: mcaptrack.query(single, query.format("tracks")), 3)
        print(f"mcaptrack query on {count} Parquet files: {ours}")
        print(f"page about all logs: {timed(lambda: mcaptrack.report(lake, 'x.html', force=True), 3)}")


if __name__ == "__main__":
    main()
