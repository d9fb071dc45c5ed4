"""How soon Ctrl-C and SIGTERM end each command on a long log, wherever it is, and whether files stay whole.

python -m tools.bench.signals [--frames 3000] [--times 3] [COMMAND ...]
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.commands import GROUP, done, made_log
from tests.effects.commands import line_of

#: Seconds from a signal to the end of the process that are soon.
SOON_S = 2
#: What a command that ends at once is given to do, so that there is a middle.
LONGER = {
    "query": "query a.mcap 'select count(*) from tracks a, tracks b, tracks c where a.x_px + b.x_px < c.x_px'",
    "tune": "tune a.mcap --trials 50 --search min-iou --search max-age -o b.toml",
}
#: What never ends by itself, or takes longer than is worth waiting for, is ended within these seconds.
MOST_S = 40.0


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def start(line: str, folder: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "mcaptrack", *shlex.split(line)],
        cwd=folder,
        env={name: value for name, value in os.environ.items() if not name.startswith("MCAPTRACK_")},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def whole(line: str, folder: Path) -> tuple[float, dict[str, bytes]]:
    """How long a command takes, and what it leaves."""
    process, began = start(line, folder), time.monotonic()
    try:
        process.communicate(timeout=MOST_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return MOST_S, {}
    return time.monotonic() - began, contents(folder)


def ended(line: str, folder: Path, after_s: float, sent: int) -> tuple[float, float, int, str]:
    """Seconds that a command takes to end after a signal, those it computes, its exit code, and what it says."""
    process = start(line, folder)
    time.sleep(after_s)
    taken_s = cpu_s(process.pid)
    os.kill(process.pid, sent)  # not by the Popen, which would ask how it ended
    began = time.monotonic()
    err = process.stderr.read() if process.stderr else ""
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds = time.monotonic() - began
    return seconds, used.ru_utime + used.ru_stime - taken_s, process.returncode, err


def cpu_s(process: int) -> float:
    """Processor time that a process, or what is left of it, has taken."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("commands", nargs="*", default=sorted(set(GROUP.commands) - {"train"}))
    parser.add_argument("--frames", type=int, default=3000)
    parser.add_argument("--times", type=int, default=3)
    given = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background of a shell it would be ignored
    with tempfile.TemporaryDirectory() as name:
        template, folder = Path(name) / "template", Path(name) / "work"
        template.mkdir()
        made_log(template, given.frames)
        done("ingest", template / "clip.mp4", "--truth", template / "truth.txt", "-o", template / "fresh.mcap")
        before = contents(template)
        print("| command | takes | ends within | of that computing | exit codes | what is odd |")
        print("|---|---|---|---|---|---|")
        for command in given.commands:
            line, odd, codes, took = LONGER.get(command) or line_of(command), set(), set(), []
            shutil.copytree(template, folder)
            whole_s, after = whole(line, folder)
            for number in range(given.times):
                for sent in (signal.SIGINT, signal.SIGTERM):
                    shutil.rmtree(folder)
                    shutil.copytree(template, folder)
                    seconds, processor_s, code, err = ended(line, folder, whole_s * (number + 0.5) / given.times, sent)
                    took.append((seconds, processor_s))
                    codes.add(code)
                    if code not in (0, 128 + sent, -sent):
                        odd.add(f"exit {code}")
                    if "Traceback" in err and code != -sent:  # that is Python's own, before it comes to our first line
                        odd.add("a traceback")
                    for path, data in contents(folder).items():
                        if data not in (before.get(path), after.get(path)) and after:
                            odd.add(f"{path} is neither old nor new")
            shutil.rmtree(folder)
            clock_s, processor_s = map(max, zip(*took, strict=True))
            odd |= {"too late"} if clock_s > SOON_S else set()
            row = (command, f"{whole_s:.1f} s", f"{clock_s:.2f} s", f"{processor_s:.2f} s", sorted(codes), *sorted(odd))
            print("|", " | ".join(map(str, row)), "|", flush=True)


if __name__ == "__main__":
    main()
