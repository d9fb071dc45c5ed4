"""A Dask cluster in a process of its own, for tests: prints the address of its scheduler, and runs until it is killed."""

from __future__ import annotations

import sys
import time


def main() -> None:
    """Start a scheduler with two workers."""
    from distributed import LocalCluster

    options = {
        "n_workers": 2,
        "threads_per_worker": 1,
        "processes": False,
        "dashboard_address": None,
        "protocol": "tcp",
    }
    with LocalCluster(host="127.0.0.1", **options) as cluster:
        print(cluster.scheduler_address, flush=True)
        while sys.stdin.readline():
            time.sleep(0.1)


if __name__ == "__main__":
    main()
