"""Detectors, trackers and predictors are found by name: built-in ones, entry points, and ``module:Class``."""

from __future__ import annotations

import os
import signal
import sys
from importlib.metadata import entry_points, packages_distributions, version
from pathlib import Path

import pytest

from mcaptrack import notices, registry
from mcaptrack.errors import McaptrackError
from mcaptrack.registry import BUILT_IN, KINDS, blamed, entry_of, find, names
from mcaptrack.transforms import STAGES, ByteTrack, Sort
from tests.distributions import package

PLUGIN = """
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import ClassVar

from mcaptrack.schema import DETECTIONS, TRACKS, VIDEO
from mcaptrack.transforms.protocol import option


@dataclass(frozen=True, kw_only=True)
class Nearest:
    gain: float = option(2.0, "how much", least=0.0)

    reads: ClassVar = DETECTIONS
    writes: ClassVar = {"": TRACKS}
    latency_s: ClassVar = {"": 0.0}

    def __call__(self, frames):
        for frame in frames:
            yield (frame._replace(rows=TRACKS.empty()),)
"""


@pytest.fixture
def installed(tmp_path, monkeypatch) -> Path:
    folder = tmp_path / "site"
    (folder / "own_trackers").mkdir(parents=True)
    (folder / "own_trackers" / "__init__.py").write_text(PLUGIN)
    package(folder, "own-trackers", "1.5", {"mcaptrack.trackers": {"nearest": "own_trackers:Nearest"}})
    monkeypatch.syspath_prepend(str(folder))
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "own_trackers"]:
        del sys.modules[name]


@pytest.mark.parametrize("kind", KINDS)
def test_every_built_in_name_is_found_and_is_its_class_again(kind):
    assert names(kind)[: len(BUILT_IN[kind])] == tuple(BUILT_IN[kind])
    for name in BUILT_IN[kind]:
        entry = find(kind, name)
        assert (entry.name, entry.kind, entry.distribution, entry.is_built_in) == (name, kind, "mcaptrack", True)
        again = entry_of(kind, entry.cls)  # a function may have several names
        assert BUILT_IN[kind][again.name] == BUILT_IN[kind][name]
        assert again.cls is entry.cls


@pytest.mark.parametrize("stage", [stage for stage in STAGES.values() if stage.kind], ids=lambda stage: stage.name)
def test_the_default_of_a_stage_is_the_first_of_its_kind(stage):
    assert stage.built_in()[next(iter(BUILT_IN[stage.kind]))] is stage.default
    assert {cls.reads for cls in stage.built_in().values()} == {stage.default.reads}


def test_an_entry_point_is_found_and_listed_without_an_import(installed):
    assert names("tracker") == ("sort", "bytetrack", "ocsort", "ground", "nearest")
    assert "own_trackers" not in sys.modules
    entry = find("tracker", "nearest")
    assert (entry.name, entry.implementation) == ("nearest", "own_trackers:Nearest")
    assert (entry.distribution, entry.version, entry.is_built_in) == ("own-trackers", "1.5", False)
    assert str(entry) == "tracker nearest (own-trackers 1.5)"
    assert entry_of("tracker", entry.cls) == entry
    assert STAGES["track"].make("nearest", gain=3.0).gain == 3.0


def test_module_and_class_is_found_also_in_the_working_folder(tmp_path, monkeypatch):
    (tmp_path / "beside_it.py").write_text(PLUGIN)
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    entry = find("tracker", "beside_it:Nearest")
    assert sys.path == before
    assert (entry.implementation, entry.distribution, entry.version) == ("beside_it:Nearest", "", "")
    assert entry_of("tracker", entry.cls) == entry
    del sys.modules["beside_it"]


def test_installed_modules_are_searched_before_the_working_folder(installed, tmp_path, monkeypatch):
    (tmp_path / "own_trackers.py").write_text("class Nearest: ...")
    monkeypatch.chdir(tmp_path)
    entry = find("tracker", "own_trackers:Nearest")
    assert (entry.cls().gain, entry.distribution, entry.version) == (2.0, "own-trackers", "1.5")


def test_modules_of_installed_packages_are_of_what_importlib_says():
    wanted = {top: owners for top, owners in packages_distributions().items() if top.isidentifier()}
    some = sorted(wanted)[::40]
    assert {top: registry.distribution_of(f"{top}.part") for top in some} == {
        top: (wanted[top][0], version(wanted[top][0])) for top in some
    }
    assert registry.distribution_of(f"{some[0]}_of_nobody") == ("", "")


def test_a_class_that_inherits_from_a_built_in_one_is_another(monkeypatch):
    class Sort(ByteTrack):
        pass

    entry = entry_of("tracker", Sort)
    assert not entry.is_built_in
    assert entry.name.startswith(f"{__name__}:")


def test_built_in_names_cannot_be_taken(installed):
    package(installed, "thief", "1", {"mcaptrack.trackers": {"sort": "own_trackers:Nearest"}})
    assert names("tracker").count("sort") == 1
    assert find("tracker", "sort").cls is Sort
    (installed / "own_trackers" / "__init__.py").write_text("class Thief: ...")
    package(installed, "another", "1", {"mcaptrack.trackers": {"ocsort": "own_trackers:Thief"}})
    assert entry_of("tracker", find("tracker", "own_trackers:Thief").cls).name == "own_trackers:Thief"


def test_two_packages_of_one_name_are_refused_unless_one_of_them_is_named(installed):
    package(installed, "other", "2", {"mcaptrack.trackers": {"nearest": "elsewhere:Nearest"}})
    for distribution in ("", "third"):
        with pytest.raises(
            McaptrackError, match=r"several installed packages have a tracker nearest: elsewhere:Nearest"
        ):
            find("tracker", "nearest", distribution)
    assert find("tracker", "nearest", "own-trackers").implementation == "own_trackers:Nearest"
    assert STAGES["track"].find("nearest", "own-trackers").distribution == "own-trackers"


def test_of_a_package_that_is_installed_twice_the_first_counts(installed, tmp_path, monkeypatch):
    later = tmp_path / "later"
    later.mkdir()
    package(
        later, "Own.Trackers", "2.0", {"mcaptrack.trackers": {"nearest": "elsewhere:Nearest", "other": "elsewhere:O"}}
    )
    monkeypatch.setattr(sys, "path", [*sys.path, str(later)])
    assert names("tracker") == ("sort", "bytetrack", "ocsort", "ground", "nearest")
    assert find("tracker", "nearest").version == "1.5"
    declared = {(point.name, point.value) for point in entry_points(group="mcaptrack.trackers")}
    assert {(point.name, point.value) for point in registry.points("tracker")} == declared


GOOD = "Metadata-Version: 2.1\nName: broken\nVersion: 1\n"
POINT = b"[mcaptrack.trackers]\nodd = own_trackers:Nearest\n"


@pytest.mark.parametrize(
    ("metadata", "points"),
    [
        (GOOD, b"[mcaptrack.trackers]\nodd\n"),
        (GOOD, b"[mcaptrack.trackers]\nodd\xff = a:B\n"),
        (GOOD, b"no section"),
    ],
)
def test_damaged_entry_points_of_another_package_harm_nothing_and_are_named_where_a_name_is_missing(
    installed, metadata, points
):
    info = installed / "broken-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(metadata)
    (info / "entry_points.txt").write_bytes(points)
    assert names("tracker") == ("sort", "bytetrack", "ocsort", "ground", "nearest")
    entry = find("tracker", "nearest")
    assert entry_of("tracker", entry.cls) == entry
    with pytest.raises(McaptrackError, match="no tracker is called nosuch") as refused:
        find("tracker", "nosuch")
    assert "The entry points of broken can't be read" in str(refused.value) or points == b"no section"


@pytest.mark.parametrize(
    ("metadata", "of"),
    [
        (None, ("", "")),
        ("", ("", "")),
        ("Metadata-Version: 2.1\nName: broken\n", ("broken", "")),
        ("Metadata-Version: 2.1\nVersion: 1\n", ("", "1")),
    ],
)
def test_an_entry_point_of_a_package_without_name_or_version_is_found(installed, metadata, of):
    info = installed / "broken-1.dist-info"
    info.mkdir()
    if metadata is not None:
        (info / "METADATA").write_text(metadata)
    (info / "entry_points.txt").write_bytes(POINT)
    entry = find("tracker", "odd")
    assert (entry.distribution, entry.version) == of
    assert str(entry).startswith("tracker odd")
    assert find("tracker", "nearest").distribution == "own-trackers"


@pytest.mark.parametrize("code", [0, 1, 200, 255, "word", None])
def test_an_exit_in_the_code_of_a_package_is_no_signal(installed, code):
    (installed / "own_trackers" / "__init__.py").write_text(f"raise SystemExit({code!r})")
    with pytest.raises(McaptrackError, match=r"nearest \(own-trackers 1.5\) can't be imported: SystemExit"):
        find("tracker", "nearest")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_exit_by_a_signal_passes(installed, number):
    (installed / "own_trackers" / "__init__.py").write_text(f"raise SystemExit({128 + number})")
    with pytest.raises(SystemExit):
        find("tracker", "nearest")


def test_the_place_of_a_failure_is_named_also_below_a_folder_called_mcaptrack(tmp_path, monkeypatch):
    """As of an environment in a checkout of the repository."""
    folder = tmp_path / "mcaptrack" / "site"
    folder.mkdir(parents=True)
    (folder / "deep_tracker.py").write_text("def fail():\n    raise ValueError('deep')\n")
    monkeypatch.syspath_prepend(str(folder))
    entry = find("tracker", "deep_tracker:fail")
    with (
        pytest.raises(McaptrackError, match=r"failed: ValueError: deep \(deep_tracker.py, line 2\)"),
        blamed(entry, "failed"),
    ):
        entry.cls()
    del sys.modules["deep_tracker"]


KNOWN = "there are sort, bytetrack, ocsort, ground, nearest"
PARTIAL = "import functools\nNearest = functools.partial(int)"
#: The code of the package, the name that is given, and what is said of it.
WRONG_NAMES = [
    ("", "nosuch", f"no tracker is called nosuch; {KNOWN}; an installed package"),
    ("", "ocsrot", "no tracker is called ocsrot; did you mean ocsort\\? there are"),
    ("", "missing_module:A", "tracker missing_module:A can't be imported: ModuleNotFoundError: No module named"),
    ("raise SystemError('two\\nlines')", "own_trackers:A", "can't be imported: SystemError: two lines"),
    ("x = (", "nearest", r"tracker nearest \(own-trackers 1.5\) can't be imported: SyntaxError"),
    ("", "nearest", r"tracker nearest \(own-trackers 1.5\): own_trackers has no class Nearest"),
    ("Nearest = 3", "own_trackers:Nearest", "Nearest in own_trackers is no class but of type int"),
    (PARTIAL, "own_trackers:Nearest", "Nearest in own_trackers is no class but of type partial"),
    ("raise SystemExit(0)", "own_trackers:Nearest", "can't be imported: SystemExit: 0"),
    ("", "own_trackers:", "own_trackers: is not of the form module:Class"),
    ("", "a b:C", "a b:C is not of the form module:Class"),
]


@pytest.mark.parametrize(("text", "name", "said"), WRONG_NAMES)
def test_what_cannot_be_found_is_said_in_one_line(installed, text, name, said):
    (installed / "own_trackers" / "__init__.py").write_text(text)
    with pytest.raises(McaptrackError, match=said) as refused:
        find("tracker", name)
    assert "\n" not in str(refused.value)


#: A part of the plugin, what stands in its place, and what is said of that.
WRONG_CLASSES = [
    ("@dataclass(frozen=True, kw_only=True)", "", "is no dataclass"),
    ("reads: ClassVar = DETECTIONS", "", r"reads no schema \(the class attribute reads\); a tracker"),
    ('{"": TRACKS}', '{"": DETECTIONS}', "writes mcaptrack.Detections; a tracker writes mcaptrack.Tr"),
    ('{"": TRACKS}', "TRACKS", "writes nothing"),
    ("__call__", "call", "can't be called with frames"),
    ("gain: float", "gain: dict", "Nearest.gain is a dict; a parameter is a float"),
    ("    reads:", '    colour: ClassVar = "blue"\n    reads:', "has colour = 'blue'; it is 'bgr' or 'grey'"),
    ("    reads:", "    passes: ClassVar = 3\n    reads:", "has passes = 3; it is 1 or 2"),
    ("    reads:", '    space: ClassVar = "metres"\n    reads:', "has space = 'metres'; it is 'picture' or 'ground'"),
    ("    reads:", "    keeps_unseen: ClassVar = 1\n    reads:", "has keeps_unseen = 1; it is True or False"),
    ("gain: float", "tracker: float", "a parameter can't have the name of the option `tracker=`"),
    (' = option(2.0, "how much", least=0.0)', "", "Nearest.gain has no default"),
    ("option(2.0,", "option(-2.0,", "gain has to be from 0 to 1000000, not -2"),
    ('option(2.0, "how much", least=0.0)', 'option(float("inf"), "how much")', "gain has to be finite, which inf is not"),
    ('option(2.0, "how much", least=0.0)', 'option(float("nan"), "how much")', "gain has to be a number, not nan"),
    ('{"": TRACKS}', '{"": TRACKS, "debug": "x"}', "has writes with 'debug': 'x'; it maps ends of topics to schemas"),
    ('{"": TRACKS}', '{"": TRACKS, "debug": VIDEO}', r"has writes with 'debug': Schema\('foxglove.CompressedVideo'\)"),
    ('{"": TRACKS}', '{"": TRACKS, 3: TRACKS}', r"has writes with 3: Schema\('mcaptrack.Tracks'\)"),
    ('option(2.0, "how much", least=0.0)', "field(init=False, default=2.0)", r"Nearest.gain can't be given \(init=False\)"),
    ("    def __call__", "    def __post_init__(self): raise SystemExit(0)\n\n    def __call__", "could not be made: SystemExit: 0"),
]  # fmt: skip


@pytest.mark.parametrize(("part", "instead", "said"), WRONG_CLASSES)
def test_a_class_that_cannot_track_is_refused_in_one_line(installed, part, instead, said):
    (installed / "own_trackers" / "__init__.py").write_text(PLUGIN.replace(part, instead))
    with pytest.raises(McaptrackError, match=said) as refused:
        STAGES["track"].make("nearest")
    assert "\n" not in str(refused.value)
    assert "nearest (own-trackers 1.5)" in str(refused.value)


def test_parameters_that_there_are_not_are_said_with_those_that_there_are(installed):
    with pytest.raises(McaptrackError, match=r"has no parameter gian; did you mean gain\? there are gain"):
        STAGES["track"].make("nearest", gian=1.0)
    with pytest.raises(McaptrackError, match="sample has one transform only"):
        STAGES["sample"].find("nearest")


def test_an_exit_without_a_word_is_an_error_that_names_the_package(installed):
    """In the process itself; a child process may end so."""
    code = (
        "import os\nchild = os.fork()\nif child == 0: os._exit(0)\nassert os.waitpid(child, 0)[1] == 0\nos._exit(3)\n"
    )
    (installed / "own_trackers" / "__init__.py").write_text(code)
    leave = os._exit
    with pytest.raises(McaptrackError) as refused:
        find("tracker", "nearest")
    assert str(refused.value).endswith("can't be imported: RuntimeError: it called os._exit(3) (__init__.py, line 5)")
    assert os._exit is leave


def test_an_import_that_takes_long_is_named_meanwhile(installed, monkeypatch):
    monkeypatch.setattr(registry.guard, "_LONG_S", 0.05)
    code = (
        "import sys, time\nfrom mcaptrack.notices import warn\n"
        "while not sys.said_of_an_import: time.sleep(0.01)\nwarn('the import ends')\n"
    )
    (installed / "own_trackers" / "__init__.py").write_text(code + PLUGIN.replace("from __future__", "#"))
    said: list[notices.Notice] = []
    monkeypatch.setattr(sys, "said_of_an_import", said, raising=False)
    with notices.collected(), notices.listening(said.append):
        find("tracker", "nearest")
        find("tracker", "nearest")  # is imported already
    words = "the import of tracker nearest (own-trackers 1.5) has taken 0.05 s and goes on; Ctrl-C ends it"
    assert [notice.message for notice in said] == [words, "the import ends"]


def test_ctrl_c_ends_an_import_that_does_not_end(installed):
    code = "import signal, time\nsignal.raise_signal(signal.SIGINT)\ntime.sleep(60)\n"
    (installed / "own_trackers" / "__init__.py").write_text(code)
    with pytest.raises(KeyboardInterrupt):
        find("tracker", "nearest")
