"""What classes of other packages may leave out, and what they may not change: the contract of docs/extend.md."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from mcaptrack import log
from mcaptrack.notices import collected
from mcaptrack.pipeline.write import ATTACHMENTS
from mcaptrack.registry import Entry, find, names
from mcaptrack.registry.guard import Guard
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.testing import LawError, check_predictor, check_transform, sample_frames
from mcaptrack.transforms.guarded import guarded
from mcaptrack.transforms.stages import FULL, RESERVED
from tests.commands import call, done, made_log
from tests.logs import provenance_of
from tests.test_plugins import MODULE
from tests.tiers import one_in

KINDS = (
    MODULE
    + """
class CornerAndMore(Corner):
    writes: ClassVar = {"": DETECTIONS, "debug": DETECTIONS}


class SingleAndMore(Single):
    writes: ClassVar = {"": TRACKS, "debug": TRACKS}


class Nothing(Single):
    def __call__(self, frames):
        for frame in frames:
            yield (frame._replace(rows=TRACKS.empty()),)


@dataclass(frozen=True, kw_only=True)
class Same:
    reads: ClassVar = TRACKS
    writes: ClassVar = {"": TRACKS}
    latency_s: ClassVar = {"": 0.0}

    def __call__(self, frames):
        for frame in frames:
            yield (frame,) * len(self.writes)


class SameAndMore(Same):
    writes: ClassVar = {"": TRACKS, "debug": TRACKS}


class Full(Same):
    writes: ClassVar = {"": TRACKS, "full": TRACKS}


class Wrong(Same):
    writes: ClassVar = {"": TRACKS, "online": DETECTIONS}
"""
)
COMMANDS = {
    "detector": ("detect", "detections", "median"),
    "tracker": ("track", "tracks", "sort"),
    "retracker": ("retrack", "retracks", "likelihood"),
    "predictor": ("predict", "predictions", "red"),
}


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> dict[str, Path]:
    """A log without results, and one with all results of the built-in classes."""
    folder = tmp_path_factory.mktemp("logs")
    full = made_log(folder, 20)
    labels = ("--truth", folder / "truth.txt", "--ground-plane", folder / "plane.txt")
    done("ingest", folder / "clip.mp4", *labels, "-o", folder / "fresh.mcap")
    return {"fresh": folder / "fresh.mcap", "full": full}


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "kinds_of_a_test.py").write_text(KINDS)
    yield tmp_path
    sys.modules.pop("kinds_of_a_test", None)


def topics() -> set[str]:
    with log.read(Path("a.mcap")) as opened:
        return {topic.removeprefix("/camera/") for topic in opened.channels}


def is_current() -> bool:
    """Whether another run has nothing to do, and no channel is out of date."""
    found = json.loads(done("run", "a.mcap", "--no-tables", "--json", "-q").out)
    return not found["results"][0]["stages"] and "out of date" not in done("info", "a.mcap").out


#: What a class replaces: nothing, or results of the built-in one; by default in turns.
REPLACED = [
    (begin, *one)
    for number, one in enumerate(
        [
            *(("detector", "CornerAndMore"), ("tracker", "SingleAndMore"), ("tracker", "Nothing")),
            *(("retracker", "Same"), ("retracker", "SameAndMore"), ("predictor", "Standing")),
        ]
    )
    for begin in (("fresh", "full"), ("full", "fresh"))[number % 2]
]


@pytest.mark.parametrize(("begin", "kind", "name"), one_in(12, REPLACED))
def test_outputs_may_be_missing_or_more_and_go_with_their_class(logs, place, begin, kind, name):
    """Each command takes the log, a second run has nothing to do, and the built-in class gives the usual log again."""
    command, main, built_in = COMMANDS[kind]
    shutil.copy(logs[begin], "a.mcap")
    choice = f"--{kind}", f"kinds_of_a_test:{name}"
    if begin == "fresh":  # else `run` replaces the results
        done(command, "a.mcap", *choice, "-q")
    said = done("run", "a.mcap", *choice, "-q").err
    assert kind != "retracker" or "retracks/online:" not in said  # nor what was odd about it
    assert is_current()
    now = topics()
    assert f"{main}/debug" in now or not name.endswith("More")
    if kind == "retracker":  # nothing is left of outputs that the former one had, nor what was made of them
        assert not [topic for topic in now if topic.startswith(("retracks/online", "retracks/predictions"))]
        for words in (["check"], ["evaluate"], ["info"], ["export", "-o", "t"]):
            done(words[0], "a.mcap", *words[1:], "-q")
        with log.read(Path("a.mcap")) as opened:
            assert not any(b"retracks/online" in (opened.attachment(layout) or b"") for layout in ATTACHMENTS)
    done("run", "a.mcap", "--no-tables", f"--{kind}", built_in, "-q")
    assert is_current()
    shutil.copy(logs["full"], "b.mcap")
    with log.read(Path("b.mcap")) as opened:
        usual = {topic.removeprefix("/camera/") for topic in opened.channels}
    assert {topic for topic in topics() if "motion" not in topic} == usual


@pytest.mark.parametrize(
    ("kind", "name", "options", "said"),
    [
        ("retracker", "Full", (), "has an output 'full', which is a name of what is made of results"),
        ("retracker", "Wrong", (), "has an output 'online' of mcaptrack.Detections; that of a retracker has mcaptrack.Tr"),
        ("retracker", "Same", ("--set", "mode=online"), "has no output online or predictions, so it can't run in this --set mode"),
    ],
)  # fmt: skip
def test_outputs_that_can_not_be_are_refused_in_one_line(logs, place, kind, name, options, said):
    shutil.copy(logs["full"], "a.mcap")
    before = Path("a.mcap").read_bytes()
    refused = call(COMMANDS[kind][0], "a.mcap", f"--{kind}", f"kinds_of_a_test:{name}", *options)
    assert (refused.code, refused.err.count("\n")) == (1, 1), refused.err
    assert said in refused.err
    assert Path("a.mcap").read_bytes() == before


def test_a_result_of_an_output_that_goes_is_kept_and_said(logs, place):
    shutil.copy(logs["full"], "a.mcap")
    done("predict", "a.mcap", "--topic", "/camera/retracks/online", "--to", "/camera/mine", "-q")
    for _ in range(2):
        said = done("run", "a.mcap", "--no-tables", "--force", "--retracker", "kinds_of_a_test:Same").err
        assert "/camera/mine stays as it is: /camera/retracks/online, which it was made from, is gone" in said
        assert "mine" in topics()


def test_reserved_names_are_those_of_what_is_made_of_results(logs):
    with log.read(logs["full"]) as opened:
        made = {topic.removeprefix("/camera/").split("/")[1] for topic in opened.channels if topic.count("/") > 2}
    own = {"online", "predictions", "decisions", "appearance", "worlds", "tf"}
    assert made - own - {"image", "scene"} <= RESERVED | {*names("finisher")}
    assert FULL.strip("/") in RESERVED


#: What code may do to the process, and the name of that in the warning.
CHANGES: dict[str, Callable[[], Any]] = {
    "the working folder": lambda: os.chdir("/"),
    "the handling of SIGTERM": lambda: signal.signal(signal.SIGTERM, signal.SIG_IGN),
    "the handling of SIGINT": lambda: signal.signal(signal.SIGINT, lambda *_: None),
    "NumPy's handling of errors": lambda: np.seterr(all="raise"),
    "the recursion limit": lambda: sys.setrecursionlimit(sys.getrecursionlimit() + 100),
    "the filters of warnings": lambda: warnings.simplefilter("ignore"),
    "sys.path": lambda: sys.path.__delitem__(slice(None)),
    "the random state of Python": lambda: random.seed(3),
    "the random state of NumPy": lambda: np.random.seed(3),  # noqa: NPY002
}


def state() -> tuple[Any, ...]:
    handlers = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    return (
        os.getcwd(),
        handlers,
        np.geterr(),
        sys.getrecursionlimit(),
        [*warnings.filters],
        [*sys.path],
        random.getstate(),
        np.random.get_state()[1].tolist(),  # noqa: NPY002
    )


@dataclass(frozen=True)
class Changing:
    change: str = ""
    reads: ClassVar = DETECTIONS
    writes: ClassVar = {"": TRACKS}
    latency_s: ClassVar = {"": 0.0}

    def __call__(self, frames: Iterable[Any]) -> Iterator[Any]:
        for number, frame in enumerate(frames):
            if number == 2:
                CHANGES[self.change]()
            yield (frame._replace(rows=TRACKS.empty()),)


@pytest.mark.parametrize("change", CHANGES)
def test_what_code_of_others_changes_is_undone_at_once_and_named_once(change):
    """At each frame, and for each part of our code: the input, too, sees the process as it was."""
    before, seen = state(), []

    def source() -> Iterator[Any]:
        for frame in sample_frames(DETECTIONS):
            seen.append(state()[:6])
            yield frame

    cls = Changing
    with collected() as said:
        for _ in guarded(Entry("mine", "tracker", cls, __name__, "", ""), cls(change), source()):
            assert state()[:6] == before[:6]
    assert state() == before
    assert all(one == before[:6] for one in seen)
    assert [notice.message for notice in said] == [f"tracker mine changed {change}; this was undone"]
    with pytest.raises(LawError, match=f"process: it changes {change} of the process"):
        check_transform(cls(change))
    assert state() == before


def test_random_numbers_that_an_import_draws_are_undone_without_a_word(place):
    (place / "draws.py").write_text("import random\nrandom.seed(3)\nclass Part: pass\n")
    before = random.getstate()
    with collected() as said:
        find("tracker", "draws:Part")
    assert (random.getstate(), said) == (before, [])


@pytest.mark.parametrize("change", CHANGES)
def test_a_predictor_that_changes_the_process_breaks_a_law(change):
    @dataclass(frozen=True)
    class Predictor:
        steps: int = 3
        step_s: float = 0.4
        past: int = 1

        def predict(self, xy_m: Any, valid: Any) -> Any:
            CHANGES[change]()
            return np.repeat(xy_m[:, -1:], 3, axis=1), np.tile(np.eye(2), (len(xy_m), 3, 1, 1))

    before = state()
    with pytest.raises(LawError, match=f"process: it changes {change} of the process"):
        check_predictor(Predictor())
    assert state() == before


def test_a_state_that_code_sets_around_its_loop_is_its_own():
    """``numpy.errstate`` around the loop of a generator holds in it, and nowhere else."""
    guard = Guard("mine")

    def loop() -> Iterator[str]:
        with np.errstate(divide="raise"):
            for _ in range(3):
                yield np.geterr()["divide"]

    steps, held = loop(), []
    for _ in range(3):
        with guard.step():
            held.append(next(steps))
        assert np.geterr()["divide"] == "warn"
    assert held == ["raise"] * 3


def test_filters_that_name_a_module_or_a_text_stay():
    """Packages silence their own dependencies when they are imported."""
    guard = Guard("mine")
    with warnings.catch_warnings():
        with guard.step():
            warnings.filterwarnings("ignore", message="of a dependency")
        assert any(entry[1] and entry[1].pattern == "of a dependency" for entry in warnings.filters)
    assert not guard.changed


@pytest.mark.parametrize(("kind", "name"), [("predictor", "Standing"), ("retracker", "Same"), ("detector", "Corner")])
def test_a_run_says_what_a_class_has_changed(logs, place, kind, name):
    """Also of imports, once each, and the log keeps it."""
    shutil.copy(logs["full"], "a.mcap")
    text = KINDS.replace("            yield (frame", "            np.seterr(all='raise')\n            yield (frame")
    text = text.replace("valid):\n", "valid):\n        np.seterr(all='raise')\n")
    Path("kinds_of_a_test.py").write_text("import os\nos.chdir('/')\n" + text)
    said = done(COMMANDS[kind][0], "a.mcap", f"--{kind}", f"kinds_of_a_test:{name}").err
    what = f"{kind} kinds_of_a_test:{name} changed"
    assert said.count(f"the import of {what} the working folder; this was undone") == 1
    assert said.count(f"{what} NumPy's handling of errors; this was undone") == 1
    assert said.count("this was undone") == 2
    how = provenance_of("a.mcap", f"/camera/{COMMANDS[kind][1]}")
    assert [code for code, text in how.warnings if "NumPy" in text] == ["other"]  # later runs say it again
