"""Fixtures of all tests."""

from __future__ import annotations

import gc
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

import mcaptrack
from mcaptrack import log
from mcaptrack.registry import names
from mcaptrack.schema.provenance import Provenance
from mcaptrack.sources import demo
from tests import bounded
from tests.commands import done, made_log
from tests.worlds import noisy_tracks, small_scene, write_channels

# The same examples each time, so that a failure comes from a change; `--hypothesis-profile search` tries many new ones.
settings.register_profile(
    "same", max_examples=20, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)
settings.register_profile("search", settings.get_profile("same"), derandomize=False, print_blob=True, max_examples=3000)
settings.load_profile("same")

# A shell that starts the tests in the background lets them, and all processes that they start, ignore Ctrl-C.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """Spare what was loaded and collected: it stays until the end, and searching it for cycles again takes long."""
    gc.freeze()
    gc.set_threshold(100_000, 20, 50)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    """Let reports hold UTF-8 only, as they have to between processes: names of files in captured output may not be."""
    report = yield
    report.sections = [
        tuple(text.encode("utf-8", "backslashreplace").decode() for text in part) for part in report.sections
    ]
    return report


def pytest_unconfigure() -> None:
    gc.unfreeze()


@pytest.fixture(scope="session", autouse=True)
def no_settings(tmp_path_factory) -> Iterator[None]:
    """Hide the settings of the user who runs the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CONFIG_HOME", str(tmp_path_factory.mktemp("config")))
        yield


@pytest.fixture(scope="session", autouse=True)
def no_wait_for_disks() -> Iterator[None]:
    """Let ``os.fsync`` check its argument only: no test cuts the power, and disks are slow."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: os.fstat(handle) and None)
        yield


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of reference data that MCAPTRACK_DATA names; tests are skipped without it."""
    folder = os.environ.get("MCAPTRACK_DATA", "")
    if not folder:
        pytest.skip("MCAPTRACK_DATA names no folder with reference data")
    return Path(folder)


@pytest.fixture(scope="session")
def footage(tmp_path_factory) -> demo.Footage:
    """A video of three people, with labels and the ground plane."""
    return demo.draw(small_scene(), tmp_path_factory.mktemp("footage"))


@pytest.fixture(scope="session")
def _ingested(footage, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("ingested") / "walk.mcap"
    done(
        "ingest", footage.video, "--ground-plane", footage.ground_plane, "--truth", footage.ground_truth, "-o", path,
        "-q",
    )  # fmt: skip
    return path


@pytest.fixture(scope="session")
def _finished(_ingested, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("finished") / "walk.mcap"
    shutil.copyfile(_ingested, path)
    done("run", path)
    return path


@pytest.fixture(scope="module")
def finished(_finished, tmp_path_factory) -> Path:
    """A log after all stages, with the files beside it. Not to be changed."""
    folder = tmp_path_factory.mktemp("finished")
    shutil.copytree(_finished.parent, folder, dirs_exist_ok=True)
    return folder / _finished.name


@pytest.fixture(scope="session")
def template(tmp_path_factory) -> Path:
    """A small log of two people after all stages, beside the files it was made from. Not to be changed."""
    return made_log(tmp_path_factory.mktemp("made"))


@pytest.fixture(scope="session")
def commands() -> Iterator[bounded.Commands]:
    """A process that runs each command in a child of its own, with bounds on time and memory."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # what a shell runs in the background ignores it
    with bounded.commands() as running:
        signal.signal(signal.SIGINT, before)
        yield running


@pytest.fixture
def fresh(_ingested, tmp_path) -> Path:
    """A log with pictures, labels and the ground plane, before the first stage."""
    return Path(shutil.copyfile(_ingested, tmp_path / "walk.mcap"))


@pytest.fixture
def never_waits() -> Iterator[None]:
    """Fail a test that waits for longer than ten minutes."""

    def late(*_: object) -> None:
        raise TimeoutError("it waits")

    signal.signal(signal.SIGALRM, late)
    signal.alarm(600)
    yield
    signal.alarm(0)


@pytest.fixture(scope="session")
def server() -> Iterator[Any]:
    """A server of objects at s3://bucket."""
    if "s3" not in names("store"):
        pytest.skip("what reads stores is an extension that is gone")
    from tests.stores import Store

    made = Store()
    yield made
    made.stop()


@pytest.fixture
def store(server, monkeypatch, tmp_path) -> Any:
    """The server, empty and without faults, and a working folder that is empty."""
    from tests.stores import only_in

    only_in(monkeypatch, server)
    server.clear()
    monkeypatch.chdir(tmp_path)
    return server


@pytest.fixture(scope="session")
def bare(template, tmp_path_factory) -> Path:
    """A log before the first stage."""
    path = tmp_path_factory.mktemp("bare") / "bare.mcap"
    with log.read(template) as opened:
        ways = {name: Provenance.from_metadata(channel.metadata) for name, channel in opened.channels.items()}
    made = [name for name, how in ways.items() if how is not None and how.transform != "ingest"]
    mcaptrack.drop(template, made, output=path)
    return path


@pytest.fixture(scope="session")
def with_worlds(tmp_path_factory) -> Path:
    """A log of walkers with nine worlds. Tests must not change it."""
    path = tmp_path_factory.mktemp("worlds") / "log.mcap"
    write_channels(path, samples=noisy_tracks(np.random.default_rng(7), people=24, ticks=80, hidden=0.03))
    done("retrack", path, "--worlds", "9", "-q")
    return path
