"""Tests of mcaptrack; each file is about one part or one law."""

import os
import sys

# Before numpy and hypothesis are loaded.
if "PYTEST_XDIST_WORKER" in os.environ:
    # Workers share the cores: threads of linear algebra, which wait in a loop, would only take time from each other.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Where no bytecode is kept, as in many containers, each worker would rewrite and compile hypothesis again, and each process
    # that a test starts the package. With one process tests may run on changed copies of the package (tools/mutants.py), of
    # which none must be kept.
    if os.environ.pop("PYTHONDONTWRITEBYTECODE", ""):
        sys.dont_write_bytecode = False
