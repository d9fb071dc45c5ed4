"""Detectors, trackers and predictors are found by name: built-in ones, entry points, and ``module:Class``."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
from importlib.metadata import entry_points, packages_distributions, version
from pathlib import Path

import numpy as np
import pytest

import mcaptrack
from mcaptrack import log, notices, registry
from mcaptrack.errors import McaptrackError
from mcaptrack.registry import BUILT_IN, KINDS, blamed, entry_of, find, names
from mcaptrack.schema import TRACKS
from mcaptrack.transforms import STAGES, ByteTrack, Sort
from tests.commands import call, done
from tests.distributions import package
from tests.logs import provenance_of
from tests.test_extensions import add, one_line, site  # noqa: F401  # a fixture
from tests.tiers import thorough

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
    ('latency_s: ClassVar = {"": 0.0}', "latency_s: ClassVar = 0.0", "has latency_s = 0.0; it maps outputs to seconds"),
    ("__call__", "call", "can't be called with frames"),
    ("gain: float", "gain: dict", "Nearest.gain has the type dict; a parameter is a float"),
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


# Stages of installed packages: the one of docs/extend.md, and what its class may declare


#: A stage that counts the marks and the tracks of the first frame.
COUNTS = """
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar
from mcaptrack import schema_of
from mcaptrack.schema import DETECTIONS, TRACKS
from mcaptrack.transforms.protocol import context
COUNT = schema_of("Count", [("visits", "i4")])
@dataclass(frozen=True, kw_only=True)
class Part:
    marks: Any = context(tuple, is_recorded=False)
    reads: ClassVar = TRACKS
    writes: ClassVar = {"": COUNT}
    latency_s: ClassVar = {"": float("inf")}
    input_topic: ClassVar = "tracks"
    output_topic: ClassVar = "tracks/visits"
    also_reads: ClassVar = {"marks": ("marks", DETECTIONS)}
    def __call__(self, frames):
        visits = sum(len(frame.rows) for frame in self.marks)
        for frame in frames:
            yield (frame._replace(rows=COUNT.rows(visits=[visits])),)
"""


def mark(path: Path, count: int) -> None:
    """Write so many marks into a log."""
    boxes = mcaptrack.detections([[10, 20, 30, 40]] * count, [0.9] * count, [1] * count, 10**9, box_format="xyxy")
    with mcaptrack.open(path) as recording:
        recording.write("/camera/marks", [boxes], replace=True)


@pytest.fixture
def path(finished, tmp_path) -> Path:
    return Path(shutil.copy(finished, tmp_path / "log.mcap"))


@pytest.mark.usefixtures("site")
def test_settings_of_a_stage_are_its_own_and_no_matter_for_other_commands(path):
    Path("mcaptrack.toml").write_text("[speed]\nmax-gap-s = 0.5\n")
    done("info", path)
    done("speed", path)
    assert provenance_of(path, "/camera/speed").parameters["max_gap_s"] == 0.5


@pytest.mark.usefixtures("site")
def test_the_speed_of_the_page_is_that_of_the_positions(path):
    line = "speed Speed and heading of each track, from its positions (my-trackers 1.0)."
    assert line in " ".join(done("--help").out.split())
    done("speed", path, "--max-gap-s", "0.5")
    with log.read(path) as opened:
        rows = np.concatenate([frame.rows for frame in opened.frames("/camera/retracks", TRACKS)])
        t_ns = np.repeat(*zip(*((f.t_ns, len(f.rows)) for f in opened.frames("/camera/retracks", TRACKS)), strict=True))
    wanted = []
    for track in np.unique(rows["track_id"]):
        its = rows["track_id"] == track
        t_s, xy = t_ns[its] / 1e9, np.stack([rows["x_m"][its], rows["y_m"][its]], axis=-1)
        step, away = np.diff(t_s), np.diff(xy, axis=0)
        fast = np.hypot(*away.T)[step <= 0.5] / step[step <= 0.5]
        wanted += zip([int(track)] * len(fast), fast.tolist(), strict=True)
    with mcaptrack.open(path) as recording:
        table = recording.table("/camera/speed").to_pylist()
    found = sorted((row["track_id"], row["speed_m_per_s"]) for row in table)
    assert len(found) > 30
    np.testing.assert_allclose(found, sorted(wanted), rtol=1e-5)
    assert provenance_of(path, "/camera/speed").plugins["transform"][:3] == ("speed", "speed:Speed", "my-trackers")


@thorough
def test_run_makes_its_channel_again_and_never_first(site, path, monkeypatch):  # noqa: F811
    assert "/camera/speed" not in mcaptrack.run(path, tables=False).channels
    mcaptrack.stage("speed", path, max_gap_s=0.5)
    assert mcaptrack.run(path, tables=False).is_up_to_date
    assert "/camera/speed" in mcaptrack.retrack(path, profile="paper").stale
    result = mcaptrack.run(path, tables=False, events=False)
    assert result.stages == ("speed", "views")
    assert provenance_of(path, "/camera/speed").parameters["max_gap_s"] == 0.5
    shutil.rmtree(site / "my_trackers-1.0.dist-info")
    for choice in ({"retracker": "likelihood"}, {}):  # the run that outdates it, and those after it
        said = [notice.message for notice in mcaptrack.run(path, tables=False, events=False, **choice).warnings]
        assert [line for line in said if "the stage speed made it, which is not installed; install my-trackers" in line]
    with pytest.raises(McaptrackError, match="no stage is called speed"):
        mcaptrack.stage("speed", path)


def test_a_stage_reads_channels_beside_its_input_and_is_outdated_by_them(site, path):  # noqa: F811
    add(site, "stage", "visits", COUNTS)
    done("visits", path)
    with mcaptrack.open(path) as recording:
        assert set(recording.array("/camera/tracks/visits")["visits"].tolist()) == {0}
    mark(path, 3)
    done("visits", path)
    with mcaptrack.open(path) as recording:
        assert set(recording.array("/camera/tracks/visits")["visits"].tolist()) == {3}
    assert [*provenance_of(path, "/camera/tracks/visits").references] == ["/camera/marks"]
    mark(path, 2)
    assert json.loads(done("info", path, "--json").out)
    assert "visits" in mcaptrack.run(path, tables=False).stages


@pytest.mark.parametrize(
    ("schema", "topic"), [("VIDEO", "video"), ("DETECTIONS", "detections"), ("PREDICTIONS", "predictions")]
)
def test_a_stage_reads_any_rows(site, path, schema, topic):  # noqa: F811
    code = COUNTS.replace("reads: ClassVar = TRACKS", f"reads: ClassVar = {schema}").replace('"tracks"', f'"{topic}"')
    add(site, "stage", "visits", code.replace("import DETECTIONS, TRACKS", f"import DETECTIONS, {schema}"))
    done("visits", path)
    with mcaptrack.open(path) as recording:
        assert len(recording.array("/camera/tracks/visits"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("@dataclass(frozen=True, kw_only=True)", ""), "is no dataclass"),
        (("reads: ClassVar = TRACKS", "reads: ClassVar = 'tracks'"), "needs the schemas that it reads and writes"),
        (('writes: ClassVar = {"": COUNT}', "writes: ClassVar = {'a': COUNT}"), "needs the schemas that it reads"),
        (('{"": COUNT}', '{"": COUNT, "view": COUNT}'), "has an output 'view', which is a name of what is made"),
        (('input_topic: ClassVar = "tracks"', "input_topic: ClassVar = 3"), "has input_topic = 3; it is a topic below"),
        (('"tracks/visits"', '"/camera/visits"'), "has output_topic = '/camera/visits'; it is a topic below"),
        (("    marks: ", "    mark: "), "has also_reads = marks without a field of that name"),
        (("    marks: ", "    force: bool = False\n    marks: "), "can't have a parameter force"),
        (('    output_topic: ClassVar = "tracks/visits"\n', ""), "has output_topic = None; it is a topic below"),
        (("    also_reads", "    before = ('shake',)\n    also_reads"), "has before = shake; there are memory, planes"),
        (("def __call__", "def call"), "can't be called with frames"),
        (("COUNT = ", "COUNT = 1 / 0 or "), "ZeroDivisionError: division by zero (another.py"),
        (
            ("        visits = sum", "        1 / 0\n        visits = sum"),
            "ZeroDivisionError: division by zero (another.py",
        ),
    ],
)
def test_a_broken_stage_is_said_in_one_line(site, path, change, said):  # noqa: F811
    assert change[0] in COUNTS
    add(site, "stage", "visits", COUNTS.replace(*change))
    before = path.read_bytes()
    line = one_line("visits", str(path))
    assert said in line
    assert "another 2.0" in line
    assert path.read_bytes() == before
    assert call("info", path).code == 0


def test_a_stage_has_no_name_of_ours(site, path):  # noqa: F811
    add(site, "stage", "track", COUNTS)
    done("track", path, "--to", "/camera/others")
    assert provenance_of(path, "/camera/others").parameters["tracker"] == "sort"
