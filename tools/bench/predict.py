"""Forecasts per second in batches, and how many times as fast as the same networks in torch (if it is installed).

.venv/bin/python -m tools.bench.predict
"""

from __future__ import annotations

import argparse
import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # a batch is too little to share out

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import tools.missing_extension  # noqa: F401
from mcaptrack.extensions.training.windows import Windows
from mcaptrack.predictors import NAMES, make


def seconds(run: Callable[[], object]) -> float:
    """The best of many."""
    best = float("inf")
    for _ in range(30):
        began = time.perf_counter()
        for _ in range(20):
            run()
        best = min(best, (time.perf_counter() - began) / 20)
    return best


def in_torch(name: str, past: np.ndarray, known: np.ndarray) -> Callable[[], object] | None:
    """One forward pass of the network in torch, inputs prepared."""
    try:
        import torch

        from mcaptrack.extensions.training.network import LstmNetwork, RedNetwork
    except ImportError:
        return None
    torch.set_num_threads(1)
    network: Any = {"red": lambda: RedNetwork(12, 0.4), "lstm": lambda: LstmNetwork(12)}[name]()
    length = 8 if name == "red" else 4
    given = network.prepare(Windows(past[:, -length:], known[:, -length:], np.zeros((len(past), 12, 2)), known[:, 0]))

    def run() -> object:
        with torch.inference_mode():
            return network(given if name == "red" else given["past"])

    return run


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    rng = np.random.default_rng(0)
    print(f"{'predictor':<10}{'batch':>6}{'us a batch':>12}{'a second':>12}{'against torch':>15}")
    for name in NAMES:
        predictor = make(name, 12, 0.4)
        for batch in (1, 8, 64, 512):
            past, known = np.cumsum(rng.normal(0.3, 0.2, (batch, 8, 2)), axis=1), np.ones((batch, 8), bool)
            ours = seconds(lambda p=predictor, a=past, k=known: p.predict(a, k))
            peer = in_torch(name, past, known) if name in ("red", "lstm") else None
            ratio = f"{seconds(peer) / ours:.1f} x" if peer else "-"
            print(f"{name:<10}{batch:>6}{1e6 * ours:>12.1f}{batch / ours:>12.0f}{ratio:>15}")


if __name__ == "__main__":
    main()
