"""Many short logs, some of which harm their worker: how many are done and named, and how quickly.

    .venv/bin/python tools/bench/fleet.py             # 200 logs, in processes and on a Dask LocalCluster
    .venv/bin/python tools/bench/fleet.py --logs 40   # fewer

Draws logs of boxes (3 people, 60 frames), and runs `mcaptrack run` on them: a log that kills its worker, one that
hangs, one that is cut and one of noise are among them, and a worker is killed from outside meanwhile. Then again; and
once more with the command killed at a random moment, and started again. Prints logs a second and processor time a log,
and the ratio of the latter to that of a shell loop over some of the logs. The harmful logs are harmful by their name
(see ``harmful_run``).
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mcaptrack
from mcaptrack import fleet
from mcaptrack.api.running import RunResult

FRAMES, PEOPLE, FPS = 60, 3, 10
HARMFUL = {"poison": "killed", "hangs": "timed-out", "cut": "failed", "noise": "failed"}
#: Seconds that a log may take: the shortest that a worker which shares its core can't miss by chance.
TIMEOUT_S = 10.0
#: Number of logs of which the shell loop is measured.
SAMPLE = 6


def harmful_run(log: Path, **given: Any) -> RunResult:
    """Run all stages on a log; a log of one of two names kills this process, or never ends."""
    if Path(log).stem == "poison":
        os.kill(os.getpid(), signal.SIGKILL)
    if Path(log).stem == "hangs":
        time.sleep(3600)
    return mcaptrack.run(log, **given)


def draw(folder: Path, count: int) -> None:
    """Write logs of boxes of people who walk in lines, and the harmful ones."""
    source = folder.with_name("boxes.txt")
    rng = random.Random(1)
    lines = []
    for _ in range(PEOPLE):
        x, y, step = rng.uniform(50, 500), rng.uniform(50, 300), rng.uniform(-3, 3)
        lines += [f"{n + 1},-1,{x + step * n:.1f},{y:.1f},24,60,1,-1,-1,-1\n" for n in range(FRAMES)]
    source.write_text("".join(lines))
    folder.mkdir()
    first = folder / "log000.mcap"
    words = ["--as", "detections", "--fps", str(FPS), "-q"]
    subprocess.run([sys.executable, "-m", "mcaptrack", "ingest", source, *words, "-o", first], check=True)
    for number in range(1, count - len(HARMFUL)):
        shutil.copyfile(first, folder / f"log{number:03}.mcap")
    for name in ("poison", "hangs"):
        shutil.copyfile(first, folder / f"{name}.mcap")
    (folder / "cut.mcap").write_bytes(first.read_bytes()[:900])
    (folder / "noise.mcap").write_bytes(random.Random(2).randbytes(20_000))


def good(folder: Path) -> dict[str, tuple[int, int]]:
    """Return time and size of each log that isn't harmful."""
    return {p.name: (p.stat().st_mtime_ns, p.stat().st_size) for p in folder.glob("log*.mcap")}


def left_over(folder: Path) -> list[str]:
    """Return files that only stand while logs are written."""
    found = [path.name for path in folder.rglob("*")]
    return [name for name in found if name.startswith(".") or name.endswith((".journal", ".part"))]


def cpu_s() -> float:
    """Return the processor time of all processes that this one waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def workers_of(process: int) -> list[int]:
    """Return the worker processes below a process (Linux)."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
            line = (entry.parent / "cmdline").read_bytes()
        except OSError:
            continue
        if int(fields[1]) == process and b"fleet.worker" in line:
            found.append(int(entry.parent.name))
    return found


def fleet_on(folder: Path, ledger: Path, scheduler: str | None, kill_one: bool = False) -> fleet.FleetResult[RunResult]:
    """Run on all logs; with ``kill_one`` kill a worker when a third of them is done."""
    killed: list[int] = []

    def watch(status: fleet.FleetStatus) -> None:
        if kill_one and not killed and status.logs - status.left > status.logs // 3:
            killed.extend(workers_of(os.getpid())[:1])
            for process in killed:
                os.kill(process, signal.SIGKILL)

    options = {"tables": False}
    where: dict[str, Any] = {"scheduler": scheduler} if scheduler else {"jobs": 2}
    return fleet.run(
        harmful_run, folder, options, name="run", ledger=ledger, timeout_s=TIMEOUT_S, on_status=watch, **where
    )


def report(title: str, done: fleet.FleetResult[RunResult], cpu: float | None = None) -> float:
    """Print a line about a run; returns its processor time a log."""
    logs = len(done.outcomes)
    waited = sum(one.seconds for one in done.outcomes if one.state == "timed-out") * 2
    a_log = (done.cpu_seconds if cpu is None else cpu) / logs
    named = sorted(f"{one.log.stem} {one.state}" for one in done.failed)
    print(
        f"{title}: {done.counts} in {done.seconds:.1f} s, {logs / done.seconds:.2f} logs/s, {a_log:.3f} s of processor "
        f"time a log, peak {done.peak_bytes / 1e6:.0f} MB; named: {', '.join(named) or 'none'}"
        + (f" (of the time, two cores waited {waited:.0f} s together for the log that hangs)" if waited else ""),
        flush=True,
    )
    return a_log


def check(title: str, is_so: bool) -> None:
    """Print whether something holds, and end if not."""
    print(f"  {'yes' if is_so else 'NO'}: {title}", flush=True)
    if not is_so:
        sys.exit(1)


def try_all(made: Path, work: Path, scheduler: str | None) -> float:
    """Run, run again, and run with a kill in between. Returns the processor time a log of the first run."""
    folder, ledger = work / "logs", work / "ledger.jsonl"
    shutil.copytree(made, folder)
    used = cpu_s()
    first = fleet_on(folder, ledger, scheduler, kill_one=scheduler is None)
    a_log = report("first", first, cpu_s() - used if scheduler is None else None)
    finished = sum(one.is_good for one in first.outcomes)  # one may be up to date: its worker was killed after it wrote
    check("all but the four harmful logs are done", finished == len(first.outcomes) - len(HARMFUL))
    check("the four are named", {one.log.stem: one.state for one in first.failed} == HARMFUL)
    check("nothing is left over", not left_over(folder))
    before = good(folder)
    report("again", fleet_on(folder, ledger, scheduler))
    check("no good log was touched", good(folder) == before)
    shutil.rmtree(folder)
    shutil.copytree(made, folder)
    (folder / "hangs.mcap").unlink()
    ledger.unlink()
    command = [sys.executable, __file__, "--only", str(folder), str(ledger), scheduler or ""]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        wanted = random.Random().uniform(0.2, 0.6) * len(before)
        while not ledger.exists() or len(ledger.read_bytes().splitlines()) < wanted:
            time.sleep(0.01)
        process.kill()
    time.sleep(1.0)  # the workers of a cluster end what they began
    lines = [json.loads(line) for line in ledger.read_text().splitlines()]
    there = {Path(line["location"]).name for line in lines if line["state"] == "done"}
    before = {name: stamp for name, stamp in good(folder).items() if name in there}
    report(f"killed after {len(before)} logs, and started again", fleet_on(folder, ledger, scheduler))
    after = good(folder)
    check("no log that was done was touched", {name: after[name] for name in before} == before)
    lines = [json.loads(line) for line in ledger.read_text().splitlines()]
    ended = {Path(line["location"]).name for line in lines if line["state"] in ("done", "up-to-date")}
    check("all good logs are done", ended == set(after))
    check("nothing is left over", not left_over(folder))
    return a_log


def loop(folder: Path) -> float:
    """Run a shell loop over some logs. Returns the processor time a log."""
    logs = sorted(folder.glob("log*.mcap"))[:SAMPLE]
    used, began = cpu_s(), time.monotonic()
    for log in logs:
        subprocess.run(
            [sys.executable, "-m", "mcaptrack", "run", log, "--no-tables", "-q"], check=True, stderr=subprocess.DEVNULL
        )
    seconds, cpu = time.monotonic() - began, (cpu_s() - used) / len(logs)
    print(f"shell loop: {len(logs) / seconds:.2f} logs/s, {cpu:.3f} s of processor time a log", flush=True)
    return cpu


def on_cluster(run: Callable[[str], float]) -> float:
    """Call a function with the address of a LocalCluster of two workers."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1") as cluster:
        return run(cluster.scheduler_address)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=200)
    parser.add_argument("--where", choices=("processes", "dask", "both"), default="both")
    parser.add_argument("--only", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    from tools.bench import fleet as module  # so that workers can import its function

    if given.only:
        module.fleet_on(Path(given.only[0]), Path(given.only[1]), given.only[2] or None)
        return
    with tempfile.TemporaryDirectory() as name:
        made = Path(name) / "made"
        draw(made, given.logs)
        shutil.copytree(made, Path(name) / "loop")
        single = loop(Path(name) / "loop")
        for where in ("processes", "dask"):
            if given.where in (where, "both"):
                print(where)
                work = Path(name) / where
                work.mkdir()
                a_log = (
                    module.try_all(made, work, None)
                    if where == "processes"
                    else on_cluster(
                        lambda address, work=work: module.try_all(made, work, address)  # type: ignore[misc]
                    )
                )
                print(f"  processor time a log: 1/{single / a_log:.1f} of that in the shell loop", flush=True)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent.parent.parent))
    main()
