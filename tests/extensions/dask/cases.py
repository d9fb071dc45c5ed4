"""Cases of Dask for the tests of the core."""

#: Modules of the core that aren't public, and why it needs them.
DEEP = {"dask": ("workers of a cluster process logs as those of this machine do", "fleet.worker")}
