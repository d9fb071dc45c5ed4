"""Kill an extension of a large log at random instants: all of the old must be there, and all or none of the new.

python tools/bench/kill.py [--gigabytes 1] [--times 50]
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
import zlib
from pathlib import Path

from mcaptrack import log

NEW = 100_000
EXTEND = f"""
import sys
from pathlib import Path
from mcaptrack import log
print("go", flush=True)
with log.read(Path(sys.argv[1])) as opened, log.extend(opened, drop=["/new"]) as writer:
    number = writer.add_channel("/new", ("s", "jsonschema", b"{{}}"), "json", {{}})
    for count in range({NEW}):
        writer.add_message(number, count, int(sys.argv[2]), b"%064d" % (count * 2654435761 % 2**32) * 4)
"""


def make(path: Path, size: int) -> None:
    block = random.Random(1).randbytes(1_000_000)
    with log.create(path) as writer:
        number = writer.add_channel("/camera", ("s", "jsonschema", b"{}"), "json", {}, kind="media")
        for count in range(size // len(block)):
            writer.add_message(number, count, count, block)


def old_part(path: Path, size: int) -> int:
    """A checksum of the bytes that must never change."""
    crc = 0
    with path.open("rb") as stream:
        while size and (block := stream.read(min(size, 2**24))):
            crc = zlib.crc32(block, crc)
            size -= len(block)
    return crc


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--gigabytes", type=float, default=1)
    parser.add_argument("--times", type=int, default=50)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.mcap"
        make(path, int(given.gigabytes * 1e9))
        with log.read(path) as opened:
            end, total = opened.index.data_end, opened.channel("/camera").messages
        crc = old_part(path, end)
        chance = random.Random(0)
        started = time.monotonic()
        subprocess.run([sys.executable, "-c", EXTEND, path, "0"], check=True, stdout=subprocess.PIPE)
        span = time.monotonic() - started
        seen = {"old": 0, "new": 0, "in the middle": 0}
        sequence = 0
        for turn in range(1, given.times + 1):
            process = subprocess.Popen([sys.executable, "-c", EXTEND, path, str(turn)], stdout=subprocess.PIPE)
            assert process.stdout
            process.stdout.readline()
            time.sleep(chance.uniform(0, span))
            process.send_signal(signal.SIGKILL)
            process.communicate()
            seen["in the middle"] += path.with_name("large.mcap.journal").exists()
            with log.read(path) as opened:
                found = {message.sequence for message in opened.messages("/new")}
                assert opened.channel("/camera").messages == total
                assert opened.channel("/new").messages == NEW
            assert found <= {sequence, turn}, (found, sequence, turn)
            assert len(found) == 1, found
            seen["new" if found == {turn} else "old"] += 1
            sequence = found.pop()
            assert old_part(path, end) == crc
        assert log.check(path).is_sound
        print(f"killed {given.times} times within {span:.2f} s: {seen}; nothing lost, nothing half")


if __name__ == "__main__":
    main()
