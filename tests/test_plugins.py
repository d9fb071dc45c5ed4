"""A detector, a tracker and a predictor of another package: chosen by entry points, seen in the log, removed again."""

from __future__ import annotations

import json
import shlex
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib import invalidate_caches
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

import mcaptrack
from mcaptrack import log
from mcaptrack.pipeline.rebuild import MissingPluginError, rebuild
from mcaptrack.schema import SCHEMAS
from mcaptrack.schema.provenance import Plugin, Provenance
from mcaptrack.transforms import STAGES
from tests.commands import call, done, made_log
from tests.distributions import package
from tests.extension_cases import needs
from tests.logs import provenance_of
from tests.tiers import thorough

MODULE = """
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from mcaptrack.schema import DETECTIONS, TRACKS, VIDEO
from mcaptrack.transforms.protocol import option


@dataclass(frozen=True, kw_only=True)
class Corner:
    "One box in every picture."
    size_px: float = option(8.0, "how large the box is, in pixels", least=1.0)
    reads: ClassVar = VIDEO
    writes: ClassVar = {"": DETECTIONS}
    latency_s: ClassVar = {"": 0.0}

    def __call__(self, frames):
        for frame in frames:
            x = [20.0 + frame.index]
            rows = DETECTIONS.rows(x_px=x, y_px=x, w_px=[self.size_px], h_px=[self.size_px], class_id=[1])
            yield (frame._replace(rows=rows),) * len(self.writes)


@dataclass(frozen=True, kw_only=True)
class Single:
    "All boxes are one track."
    track_id: int = option(7, "the id", least=0)
    scales: tuple[float, ...] = option((1.0,), "factors for the width")
    name: Literal["a", "b"] = option("a", "a name")
    reads: ClassVar = DETECTIONS
    writes: ClassVar = {"": TRACKS}
    latency_s: ClassVar = {"": 0.0}

    def __call__(self, frames):
        for frame in frames:
            first = frame.rows[:1]
            boxes = {name: first[name] for name in ("x_px", "y_px", "h_px")} | {"w_px": first["w_px"] * self.scales[-1]}
            count = len(first)
            rows = TRACKS.rows(
                track_id=[self.track_id] * count, observed=[True] * count, source_id=[-1] * count, **boxes
            )
            yield (frame._replace(rows=rows),) * len(self.writes)


@dataclass(frozen=True)
class Standing:
    steps: int
    step_s: float
    past: int = 1

    def predict(self, xy_m, valid):
        mean = np.repeat(xy_m[:, -1:], self.steps, axis=1)
        return mean, np.tile(np.eye(2), (len(xy_m), self.steps, 1, 1))


@dataclass(frozen=True)
class Spread(Standing):
    sigma_m: float = option(1.0, "the error, in metres", least=0.1)
    shift: Literal["none", "east"] = "none"
    weights: dict = None

    def predict(self, xy_m, valid):
        mean, cov = super().predict(xy_m, valid)
        return mean + [float(self.shift == "east"), 0.0], cov * self.sigma_m**2


def spread(steps, step_s, *, sigma_m=2.0, **others):
    return Spread(steps, step_s, sigma_m=sigma_m)
"""
ENTRIES = {
    "detectors": {"corner": "own:Corner"},
    "trackers": {"single": "own:Single"},
    "predictors": {"standing": "own:Standing", "spread": "own:Spread", "spread-function": "own:spread"},
}


@pytest.fixture(scope="module")
def template(tmp_path_factory) -> Path:
    return made_log(tmp_path_factory.mktemp("made"), 20)


@pytest.fixture
def place(template, tmp_path, monkeypatch) -> Iterator[Path]:
    """The working folder, with a log; ``site`` in it stands for the installed packages."""
    shutil.copy(template, tmp_path / "a.mcap")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    install()
    yield tmp_path
    sys.modules.pop("own", None)


def install(version: str = "1.5", text: str = MODULE) -> None:
    shutil.rmtree("site", ignore_errors=True)
    Path("site").mkdir()
    Path("site/own.py").write_text(text)
    package(Path("site"), "own", version, {f"mcaptrack.{kind}": entries for kind, entries in ENTRIES.items()})
    uncached()


def uncached() -> None:
    sys.modules.pop("own", None)
    shutil.rmtree("site/__pycache__", ignore_errors=True)
    invalidate_caches()


def made(topic: str) -> Provenance:
    return provenance_of("a.mcap", topic)


def codes(*words: str) -> list[str]:
    return [one["code"] for one in json.loads(done(*words, "--json", "-q").out)["warnings"]]


def rows(topic: str) -> Any:
    with log.read(Path("a.mcap")) as opened:
        return opened.rows(topic, SCHEMAS[opened.channels[topic].schema_name]).rows


def test_they_are_used_seen_made_again_and_refused_when_they_are_gone(place):
    done("detect", "a.mcap", "--detector", "corner", "--size-px", "9", "-q")
    done(*shlex.split("track a.mcap --tracker single --track-id 5 --scales 2 --scales 3 --name b -q"))
    done("predict", "a.mcap", "--predictor", "standing", "-q")
    assert made("/camera/detections").plugins == {"transform": Plugin("corner", "own:Corner", "own", "1.5")}
    tracks = made("/camera/tracks")
    assert tracks.plugins == {"transform": Plugin("single", "own:Single", "own", "1.5")}
    assert tracks.parameters == {"tracker": "single", "track_id": 5, "scales": [2.0, 3.0], "name": "b"}
    assert made("/camera/predictions").plugins == {"predictor": Plugin("standing", "own:Standing", "own", "1.5")}
    assert set(rows("/camera/tracks")["track_id"]) == {5}
    assert set(rows("/camera/tracks")["w_px"]) == {27.0}
    assert rows("/camera/predictions")["cov_xx_m2"].tolist() == [1.0] * len(rows("/camera/predictions"))
    said = done("info", "a.mcap").out
    assert "/camera/tracks  track  single (own 1.5)" in said
    (channel,) = [
        one
        for one in json.loads(done("info", "a.mcap", "--json").out)["results"][0]["channels"]
        if one["topic"] == "/camera/tracks"
    ]
    assert channel["plugins"]["transform"] == {
        "name": "single", "implementation": "own:Single", "distribution": "own", "version": "1.5"
    }  # fmt: skip
    with mcaptrack.open("a.mcap") as opened:
        table = {row["topic"]: row["plugins"] for row in opened.table("channels").to_pylist()}
    assert json.loads(table["/camera/tracks"]) == channel["plugins"]
    assert json.loads(table["/camera/predictions"])["predictor"]["version"] == "1.5"
    assert table["/camera/video"] is None
    done("export", "a.mcap", "-o", "tables", "-q")
    (file,) = Path("tables/tracks").glob("*/*.parquet")
    lineage = json.loads(pq.read_metadata(file).metadata[b"mcaptrack.lineage"])
    assert lineage["/camera/tracks"]["plugins"] == channel["plugins"]

    before = {topic: made(topic).digest for topic in ("/camera/detections", "/camera/tracks", "/camera/predictions")}
    assert "other-version" not in codes("run", "a.mcap", "--no-tables", "--force")
    assert {topic: made(topic).digest for topic in before} == before  # the same classes and parameters
    assert made("/camera/tracks") == tracks

    install("2.0")
    assert codes("run", "a.mcap", "--no-tables", "--force").count("other-version") == 3

    shutil.rmtree("site")
    uncached()
    kept = Path("a.mcap").read_bytes()
    refused = call("run", "a.mcap", "--no-tables", "--force")
    assert refused.code == 1
    assert refused.err == (
        "mcaptrack: a.mcap: /camera/detections can't be made from /camera/video: detector corner (own 2.0) made it, which "
        "is not installed; install own 2.0, or replace it with another --detector\n"
    )
    assert "tracker single (own 2.0)" in call("run", "a.mcap", "--no-tables", "--force", "--detector", "knn").err
    assert Path("a.mcap").read_bytes() == kept
    done("run", "a.mcap", "--no-tables")  # nothing is to be made again
    done("run", "a.mcap", "--no-tables", "-q", "--detector", "knn", "--tracker", "sort", "--predictor", "cv")
    assert made("/camera/tracks").parameters["tracker"] == "sort"
    assert made("/camera/predictions").plugins == {}


def test_an_entry_point_that_another_package_has_now_is_not_the_same(place):
    done("track", "a.mcap", "--tracker", "single", "-q")
    shutil.rmtree("site/own-1.5.dist-info")
    package(Path("site"), "thief", "1.5", {"mcaptrack.trackers": {"single": "own:Single"}})
    uncached()
    refused = call("run", "a.mcap", "--no-tables", "--force")
    assert refused.code == 1
    assert "tracker single (own 1.5) made it; the tracker of that name is now that of thief" in refused.err


@thorough
def test_of_two_packages_with_one_name_a_run_takes_the_one_that_made_the_channel(place):
    done("track", "a.mcap", "--tracker", "single", "-q")
    before = made("/camera/tracks")
    package(Path("site"), "other", "3", {"mcaptrack.trackers": {"single": "elsewhere:Single"}})
    uncached()
    assert not {"other-version", "left-out", "out-of-date"} & set(codes("run", "a.mcap", "--no-tables", "--force"))
    assert made("/camera/tracks") == before
    refused = call("run", "a.mcap", "--no-tables", "--tracker", "single")
    assert refused.code == 1
    assert "several installed packages have a tracker single: elsewhere:Single (other 3) and own:Single (own 1.5)" in (
        refused.err
    )


@pytest.mark.parametrize("kind", ["tracker", "predictor"])
def test_a_class_that_is_broken_now_is_refused_like_one_that_is_missing(place, kind):
    """Nothing is left as it was beside results that were made again."""
    command, name, topic = {
        "tracker": ("track", "single", "/camera/tracks"),
        "predictor": ("predict", "standing", "/camera/predictions"),
    }[kind]
    done(command, "a.mcap", f"--{kind}", name, "-q")
    install(text="import no_such_module")
    before = Path("a.mcap").read_bytes()
    refused = call("run", "a.mcap", "--no-tables", "--force")
    assert (refused.code, refused.err.count("\n")) == (1, 1), refused.err
    assert f"{topic} can't be made from" in refused.err
    assert f"{kind} {name} (own 1.5) made it; {kind} {name} (own 1.5) can't be imported: ModuleNotFound" in refused.err
    assert f"Or replace it with another --{kind}" in refused.err
    assert Path("a.mcap").read_bytes() == before
    done("info", "a.mcap")


def test_a_parameter_that_a_package_no_longer_has_is_named_with_the_package(place):
    done("track", "a.mcap", "--tracker", "single", "-q")
    install("2.0", MODULE.replace("track_id: int", "number: int").replace("self.track_id", "self.number"))
    said = done("run", "a.mcap", "--no-tables", "--force").err
    assert "it was made with track_id, which tracker single (own 2.0) does not have" in said


def test_all_classes_that_have_to_be_named_are_named_at_once(place):
    """Whichever of them the user names, the proposal names all, and works."""
    (place / "beside_the_log.py").write_text(MODULE)
    names = {"detector": "Corner", "tracker": "Single", "predictor": "Standing"}
    given = {kind: f"beside_the_log:{name}" for kind, name in names.items()}
    words = {kind: [f"--{kind}", name] for kind, name in given.items()}
    for command, kind in (("detect", "detector"), ("track", "tracker"), ("predict", "predictor")):
        done(command, "a.mcap", *words[kind], "-q")
    before = {topic: made(topic) for topic in ("/camera/detections", "/camera/tracks", "/camera/predictions")}
    for kinds in ([], ["tracker"], ["predictor", "detector"]):
        sys.modules.pop("beside_the_log", None)
        named = [word for kind in kinds for word in words[kind]]
        refused = call("run", "a.mcap", "--no-tables", "--force", *named)
        assert (refused.code, refused.err.count("\n")) == (1, 1)
        why, proposal, _ = refused.err.split("`")
        proposed = shlex.split(proposal)
        assert proposed[:4] == ["mcaptrack", "run", "a.mcap", "--force"]
        assert dict(zip(proposed[4::2], proposed[5::2], strict=True)) == {f"--{k}": n for k, n in given.items()}
        assert [f"{kind} {name}" in why for kind, name in given.items()] == [kind not in kinds for kind in given]
        assert "beside_the_log" not in sys.modules or kinds  # a log can't have a module imported
    done(*proposed[1:], "--no-tables", "-q")
    assert {topic: made(topic) for topic in before} == before
    del sys.modules["beside_the_log"]


@pytest.mark.parametrize("name", ["__main__:Single", "own:maker.<locals>.Single"])
def test_a_class_that_cannot_be_imported_is_not_proposed_by_name(name):
    plugin = Plugin(name, name, "", "")
    with pytest.raises(
        MissingPluginError, match=r"can't be imported; run it again from Python with that class"
    ) as told:
        rebuild(STAGES["track"], Provenance("track", {"tracker": name}, plugins={"transform": plugin}), {})
    assert not told.value.options


@pytest.mark.parametrize(
    ("stage", "parameters", "plugins", "said"),
    [
        ("track", {"tracker": "deepsort"}, {}, "tracker deepsort made it, which this version does not have"),
        ("sample", {}, {"transform": Plugin("own:A", "own:A", "own", "1")}, r"sample own:A \(own 1\) made it; run it again"),
        ("predict", {"predictor": "own:Standing"}, {}, "own:Standing made it, and a class without an entry point"),
    ],
)  # fmt: skip
def test_a_channel_of_an_unknown_class_is_not_made_again(place, stage, parameters, plugins, said):
    with pytest.raises(mcaptrack.McaptrackError, match=said):
        rebuild(STAGES[stage], Provenance(stage, parameters, plugins=plugins), {})


def test_a_package_that_is_not_named_is_not_imported(place):
    install(text="raise RuntimeError('broken')")
    done("track", "a.mcap", "-q")
    done("info", "a.mcap")
    assert call("--help").code == call("run", "--help").code == 0
    assert "own" not in sys.modules


def test_help_reads_no_file_of_settings(place):
    (place / "mcaptrack.toml").write_text("[track")
    assert call("track", "a.mcap").code == 2
    assert call("track", "--help").code == 0
    assert call("track", "--tracker", "single", "--help").code == 0


@needs("tune")
def test_tune_names_a_tracker_that_fails(place):
    """In a run, when it is made with values to try, and at the ends of a range."""
    (place / "gt.txt").write_text("".join(f"{n},1,10,10,5,5,1,-1,-1,-1\n" for n in range(1, 9)))
    words = ("tune", "gt.txt", "--truth", "gt.txt", "--set", "fps=10", "--tracker", "single", "--trials", "2", "-q")
    text = MODULE.replace('"the id", least=0', '"the id", least=0, search=(0, 9)')
    install(text=text)
    done(*words)
    fails = "    def __post_init__(self):\n        if self.track_id != 7: raise RuntimeError('seven only')\n\n    def __call__"
    start = text.index("class Single")
    for old, new, said, more in (
        ("count = len(first)", "count = 1 / 0", "failed at frame 0 (0 ns): ZeroDivisionError", ()),
        ("yield (frame._replace(rows=rows),) * len(self.writes)", "yield rows", "gave a ndarray at frame 0 (0 ns)", ()),
        ("    def __call__", fails, "could not be made with {'track_id': ", ()),
        ("    def __call__", fails, "could not be made with the ends of --search: RuntimeError", ("--search", "track-id=1:2")),
    ):  # fmt: skip
        install(text=text[:start] + text[start:].replace(old, new, 1))
        refused = call(*words, "--force", *more)
        assert (refused.code, refused.err.count("\n")) == (1, 1), refused.err
        assert f"tracker single (own 1.5) {said}" in refused.err


class TestOptionsOfPredictors:
    def variances(self) -> set[float]:
        return set(rows("/camera/predictions")["cov_xx_m2"])

    @pytest.fixture(autouse=True)
    def one_track(self, place):
        done("detect", "a.mcap", "--detector", "corner", "-q")
        done("track", "a.mcap", "--tracker", "single", "-q")

    def test_they_are_used_kept_in_the_log_and_used_again(self, place):
        done("predict", "a.mcap", "--predictor", "spread", "--sigma-m", "3", "--horizon-s", "2", "-q")
        first = made("/camera/predictions")
        assert (first.parameters["sigma_m"], first.parameters["shift"]) == (3.0, "none")
        assert "weights" not in first.parameters
        assert first.plugins == {"predictor": Plugin("spread", "own:Spread", "own", "1.5")}
        assert self.variances() == {9.0}
        done("run", "a.mcap", "--no-tables", "--force", "-q")
        assert made("/camera/predictions") == first
        done("run", "a.mcap", "--no-tables", "-q", "--predictor", "cv")
        assert "sigma_m" not in made("/camera/predictions").parameters

    def test_a_parameter_of_predict_is_refused(self, place):
        install(text=MODULE.replace("sigma_m", "horizon_s"))
        refused = call("predict", "a.mcap", "--predictor", "spread")
        assert refused.code == 1
        assert "predictor spread (own 1.5) can't have a parameter horizon_s: that is one of predict" in refused.err

    @thorough
    def test_a_log_that_hides_its_predictor_has_no_module_imported(self, place):
        (place / "beside_the_log.py").write_text(MODULE)
        done("predict", "a.mcap", "--predictor", "beside_the_log:Spread", "-q")
        del sys.modules["beside_the_log"]
        known = made("/camera/predictions")
        with pytest.raises(MissingPluginError, match="imported only if you name it"):
            rebuild(STAGES["predict"], replace(known, plugins={}), {})
        assert "beside_the_log" not in sys.modules


def test_files_and_environment_choose_them_and_set_their_options(place, monkeypatch):
    (place / "mcaptrack.toml").write_text('[track]\ntracker = "single"\ntrack-id = 3\nscales = [2]\n')
    done("track", "a.mcap", "-q")
    assert made("/camera/tracks").parameters == {"tracker": "single", "track_id": 3, "scales": [2.0], "name": "a"}
    done("track", "a.mcap", "-q", "--tracker", "sort")  # the options of the other one are left out
    assert made("/camera/tracks").parameters["tracker"] == "sort"
    done("info", "a.mcap", "-q")
    (place / "mcaptrack.toml").write_text("[track]\ntrack-id = 4\n")
    done("track", "a.mcap", "-q", "--tracker=single")
    assert made("/camera/tracks").parameters["track_id"] == 4
    (place / "mcaptrack.toml").unlink()
    monkeypatch.setenv("MCAPTRACK_TRACK_TRACKER", "single")
    done("track", "a.mcap", "-q", "--track-id", "5")
    assert made("/camera/tracks").parameters["track_id"] == 5
    monkeypatch.setenv("MCAPTRACK_TRACK_TRACK_ID", "6")
    done("run", "a.mcap", "-q", "--no-tables", "--force")
    assert made("/camera/tracks").parameters["track_id"] == 6


def test_a_file_in_the_working_folder_names_no_module(place):
    (place / "mcaptrack.toml").write_text('[track]\ntracker = "own:Single"\n')
    refused = call("track", "a.mcap")
    assert (refused.code, refused.err.count("\n"), "own" in sys.modules) == (2, 1, False)
    assert "may tune and nothing else; give --tracker" in refused.err
    done("track", "a.mcap", "--config", "mcaptrack.toml", "-q")
    assert made("/camera/tracks").parameters["tracker"] == "single"  # the entry point of the same class


def test_the_help_lists_the_options_of_the_one_that_is_named(place, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    for command, words, own, others in (
        ("track", ["--tracker", "single"], ["single: All boxes are one track.", "--track-id"], []),
        ("predict", ["--predictor", "spread"], ["The error, in metres.", "--sigma-m"], ["--weights", "--past"]),
    ):
        assert own[1] not in call(command, "--help-all").out
        said = call(command, *words, "--help-all").out
        assert f"Options of {words[1]} alone" in said
        assert [part for part in own if part not in said] == [part for part in others if part in said] == []


@pytest.mark.parametrize(
    ("line", "code", "said"),
    [
        ("track --tracker single --track-id -1", 1, "--track-id has to be from 0 to 1000000, not -1"),
        ("track --tracker single --track-id x", 2, "'x' is not a whole number"),
        ("track --tracker single --name c", 2, "invalid value for '--name'"),
        ("track --tracker sort --track-id 1", 2, "no such option: --track-id"),
        ("track --tracker corner", 1, "no tracker is called corner"),
        ("track --tracker own:Corner", 1, "tracker own:Corner (own 1.5) reads foxglove.CompressedVideo; a tracker reads"),
        ("track --tracker single --min-iou 0.1", 1, "--min-iou is an option of sort, bytetrack, ocsort and ground, not"),
        ("predict --predictor spread --sigma-m 0", 1, "--sigma-m has to be from 0.1 to 1000000, not 0"),
        ("predict --predictor spread --shift west", 2, "invalid value for '--shift'"),
        ("predict --predictor cv --sigma-m 1", 2, "no such option: --sigma-m"),
        ("predict --predictor spread --predictor cv", 2, "--predictor is given as spread and as cv; give one"),
        ("predict --predictor nearest", 1, "no predictor is called nearest"),
    ],
)  # fmt: skip
def test_wrong_options_are_refused_in_one_line(place, line, code, said):
    command, *words = line.split()
    refused = call(command, "a.mcap", *words)
    assert (refused.code, refused.err.count("\n")) == (code, 1)
    assert said in refused.err


def test_a_detector_with_a_field_for_a_file_takes_it_after_its_name(place):
    refused = call("detect", "a.mcap", "--detector", "corner:own.txt")
    assert refused.err == "mcaptrack: detector corner (own 1.5) takes no file, so corner:own.txt names nothing\n"
    install(text=MODULE.replace("    size_px: float", '    file: str = option("", "what")\n    size_px: float'))
    done("detect", "a.mcap", "--detector", "corner:own.txt", "--force")
    assert provenance_of("a.mcap", "/camera/detections").parameters["file"] == "own.txt"
    assert "running detect again" not in done("run", "a.mcap", "--detector", "corner:own.txt", "--no-tables").err
    assert "running detect again" in done("run", "a.mcap", "--detector", "corner:other.txt", "--no-tables").err


@pytest.mark.parametrize("name", ["topic", "force", "help", "logs", "in_place", "no_name"])
def test_a_parameter_with_the_name_of_an_option_is_refused_by_name(place, name):
    """Also of the other form of a switch, as in --sidecar/--in-place, or of --name/--no-name of the class itself."""
    old = 'name: Literal["a", "b"] = option("a", "a name")'
    install(text=MODULE.replace(old, f"name: bool = True\n    {name}: bool = True"))
    for command in ("track", "run"):
        refused = call(command, "a.mcap", "--tracker", "single")
        assert (refused.code, refused.err.count("\n")) == (1, 1), refused.err
        assert f"single can't have a parameter {name}: that is the name of an option of track" in refused.err


def test_what_plugins_and_their_programs_print_is_kept_apart_from_results(place, capfd):
    """Libraries in C and child processes write to the file descriptor."""
    text = "import os\nprint('loaded')\nos.write(1, b'loaded ')\n" + MODULE.replace(
        "count = len(first)", "print('called'); os.system('echo called'); count = len(first)"
    )
    install(text=text.replace("    def __call__", "    def __post_init__(self): print('made')\n\n    def __call__"))
    found = done("track", "a.mcap", "--tracker", "single", "--json", "-q")
    assert json.loads(found.out)["results"][0]["stages"] == ["track"]
    assert {"loaded", "made", "called"} <= set(found.err.split())
    out, err = capfd.readouterr()
    assert out == ""
    assert {"loaded", "called"} <= set(err.split())
