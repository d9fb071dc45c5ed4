"""CPU time of a network in a process of its own, as one of a stranger runs, against the same in this process.

.venv/bin/python -m tools.bench.networks yolox_nano.onnx [--size 960x736]
"""

from __future__ import annotations

import argparse
import resource
from pathlib import Path

import numpy as np

import tools.missing_extension  # noqa: F401
from mcaptrack.extensions.networks.network import NetworkFile, NetworkLimits, OnnxNetwork, read_file
from mcaptrack.geometry.boxes import parse_size


def used_s() -> float:
    """The processor time of this process, and of those that have ended."""
    each = [resource.getrusage(which) for which in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in each)


def measure(
    file: NetworkFile, limits: NetworkLimits, size: tuple[int, int], count: int, is_trusted: bool
) -> tuple[float, str]:
    """Seconds to open a network, run it on so many pictures and end it; and the sum of all that it gives."""
    began = used_s()
    network = OnnxNetwork(file, limits, is_trusted=is_trusted)
    (name, _, _), *_ = network.facts["inputs"]
    own = network.facts["sizes"][name]
    if own != size and None not in own:
        network.open((name, own, size))  # type: ignore[arg-type]
    pixels = np.random.default_rng(0).uniform(0, 255, (1, 3, size[1], size[0])).astype(np.float32)
    total = sum(float(array.sum(dtype=np.float64)) for _ in range(count) for array in network.run({name: pixels}))
    network.close()
    return used_s() - began, repr(total)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--size", default="416x416")
    parser.add_argument("--pictures", type=int, default=60)
    options = parser.parse_args()
    size = parse_size(options.size)
    if size is None:
        parser.error("--size takes width x height")
    limits = NetworkLimits.of_environment()
    file = read_file(options.file, limits)
    measure(file, limits, size, 1, True)  # what is loaded once
    rows = {}
    for is_trusted in (True, False):
        start, _ = min(measure(file, limits, size, 1, is_trusted) for _ in range(3))
        whole, total = min(measure(file, limits, size, 1 + options.pictures, is_trusted) for _ in range(3))
        rows[is_trusted] = (start, (whole - start) / options.pictures, total)
    assert rows[True][2] == rows[False][2], "the outputs differ"
    for is_trusted, (start, each, _) in rows.items():
        where = "in this process" if is_trusted else "in one of its own"
        print(f"{where:<20}{1000 * start:8.0f} ms to start, with the first picture{1000 * each:8.2f} ms a picture")
    print(f"a picture costs {rows[False][1] / rows[True][1]:.3f} times as much")


if __name__ == "__main__":
    main()
