"""Tests of mcaptrack; each file is about one part or one law."""

import os

# Before numpy is loaded. Workers share the cores: threads of linear algebra, which wait in a loop, would only take time
# from each other.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
