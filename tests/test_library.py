"""The functions of the library do what the commands do; they return results, print nothing, and are documented."""

from __future__ import annotations

import ast
import collections.abc
import dataclasses
import doctest
import importlib
import inspect
import json
import math
import os
import re
import shutil
import types
import warnings
from pathlib import Path
from typing import Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import mcaptrack
from mcaptrack.cli.text import with_flags
from mcaptrack.errors import McaptrackError
from mcaptrack.errors import call as proposed
from mcaptrack.installed import missing_extension
from mcaptrack.sources import demo
from mcaptrack.transforms import ByteTrack
from tests.commands import GROUP, call, done
from tests.extension_cases import of_extensions
from tests.sources import PACKAGE, texts
from tests.worlds import small_scene

FUNCTIONS = [name for name in mcaptrack.__all__ if inspect.isfunction(getattr(mcaptrack, name))]
CLASSES = [name for name in mcaptrack.__all__ if inspect.isclass(getattr(mcaptrack, name))]
#: The public methods of classes of the package, by name, also those that they inherit.
METHODS = {
    f"{name}.{method}": value
    for name in CLASSES
    for method, value in inspect.getmembers(getattr(mcaptrack, name), inspect.isfunction)
    if value.__module__.startswith("mcaptrack.") and not method.startswith("_")
}
SECTIONS = ["Parameters", "Returns", "Raises", "Examples"]
#: Optional packages that examples need.
NEEDS = {"train": "torch", "Recording.supervision": "supervision"} | of_extensions("PACKAGES")


def sections_of(function) -> tuple[list[str], list[str]]:
    """The sections of a docstring, and the parameters that it names."""
    text = inspect.getdoc(function)
    block = re.findall(r"^Parameters\n-+\n(.*?)\n\n[A-Z]", text, re.M | re.S)
    named = [one for line in re.findall(r"^(\S.*?)(?: : .*)?$", "".join(block), re.M) for one in line.split(", ")]
    return re.findall(r"^(\w+)\n-+$", text, re.M), [one.lstrip("*") for one in named]


@pytest.fixture(scope="module")
def template(template, tmp_path_factory) -> Path:
    """A folder with a log that has all results, its video and its labels. Tests must not change it."""
    folder = Path(shutil.copytree(template.parent, tmp_path_factory.mktemp("made"), dirs_exist_ok=True))
    (folder / "a.mcap").rename(folder / "log.mcap")
    shutil.copy(folder / "clip.mp4", folder / "video.mp4")
    return folder


@pytest.fixture
def place(template, tmp_path, monkeypatch) -> Path:
    for path in template.iterdir():
        if path.is_file():
            shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class TestTheSameAsTheCommandLine:
    def test_track_with_options_gives_the_same_rows(self, place):
        mcaptrack.track("log.mcap", tracker="bytetrack", max_age_s=0.5, output="library.mcap")
        mcaptrack.track("log.mcap", tracker=ByteTrack(max_age_s=0.5), output=place / "object.mcap")
        done("track", "log.mcap", "--tracker", "bytetrack", "--max-age-s", "0.5", "-o", "command.mcap")
        bytes_of = {Path(f"{name}.mcap").read_bytes() for name in ("library", "object", "command")}
        assert len(bytes_of) == 1

    def test_ingest_and_run_give_the_same_bytes(self, place):
        ingested = mcaptrack.ingest("clip.mp4", "b.mcap", ground_plane="plane.txt", truth="truth.txt")
        assert ingested.messages["/camera/video"] == 30
        assert mcaptrack.run("b.mcap").stages == ("detect", "track", "sample", "predict", "retrack", "events", "views")
        assert Path("b.mcap").read_bytes() == Path("log.mcap").read_bytes()
        again = mcaptrack.run("b.mcap")
        assert (again.stages, again.written_to) == ((), None)

    def test_results_are_what_the_command_prints(self, place):
        said = json.loads(done("evaluate", "log.mcap", "--json").out)["results"]
        assert json.loads(json.dumps(mcaptrack.evaluate("log.mcap").rows())) == said
        assert [mcaptrack.info("log.mcap").to_json()] == json.loads(done("info", "log.mcap", "--json").out)["results"]


class TestResults:
    def test_nothing_is_printed_and_progress_is_called(self, place, capfd):
        told = []
        result = mcaptrack.track("log.mcap", tracker="ocsort", output="b.mcap", progress=lambda *now: told.append(now))
        assert told[-1] == ("track", 30, 30)
        assert capfd.readouterr() == ("", "")
        assert result.written_to == Path("b.mcap")
        assert result.tracks["/camera/tracks"] == len(
            np.unique(mcaptrack.open("b.mcap").array("tracks", "/camera/tracks")["track_id"])
        )

    def test_warnings_are_python_warnings_at_the_line_of_the_caller_and_in_the_result(self, place):
        done("ingest", "video.mp4", "-o", "plain.mcap")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            result = mcaptrack.run("plain.mcap", tables=False)
        assert "assumed-ground-plane" in [notice.code for notice in result.warnings]
        mine = [one for one in caught if issubclass(one.category, mcaptrack.McaptrackWarning)]
        assert len(mine) == len(result.warnings)
        assert {one.filename for one in mine} == {__file__}

    def test_progress_of_scores_is_by_channel(self, place):
        told, topics = [], ("/camera/tracks", "/camera/retracks")
        mcaptrack.evaluate("log.mcap", topic=topics, progress=lambda *now: told.append(now))
        assert told == [("evaluate", done, 2) for done in range(3)]

    def test_a_score_is_found_by_the_end_of_a_topic(self, place):
        scores = mcaptrack.evaluate("log.mcap", gate_m=1.0)
        (row,) = [r for r in scores.rows() if (r["tracks"], r["similarity"]) == ("/camera/retracks", "metres")]
        assert scores.score("IDF1", "retracks", "metres") == row["IDF1"]

    def test_scores_below_a_limit_are_listed(self, place):
        scores = mcaptrack.evaluate("log.mcap", similarity="metres", gate_m=1.0)
        assert scores.below({"IDF1": 0.0}) == []
        assert len(scores.below({"IDF1": 1.1})) == len(scores.rows())


class TestUnused:
    """Parameters without an effect are warnings of the result, in the sentence that the command prints.

    That every option without an effect is a warning is tested in ``test_effects``.
    """

    @pytest.mark.parametrize(
        ("name", "values", "parameter"),
        [
            ("evaluate", {"tracks": "log.mcap", "fps": 25}, "fps"),
            ("evaluate", {"tracks": "truth.txt", "truth": "truth.txt", "topic": "/x"}, "topic"),
            ("events", {"log": "log.mcap", "similarity": "iou", "gate_m": 3.0}, "gate_m"),
            ("ingest", {"source": "log.mcap", "output": "a.mcap", "camera": "x"}, "camera"),
            *of_extensions("UNUSED").values(),
        ],
    )
    def test_they_are_in_the_result_and_on_stderr(self, place, name, values, parameter):
        warned = [one for one in getattr(mcaptrack, name)(**values).warnings if one.code == "option-not-used"]
        assert [one.message.partition(":")[0] for one in warned] == [f"`{parameter}=` changes nothing here"]
        first, *others = values
        words = [name, str(values[first])]
        for other in others:
            words += [flag_of(name, other)] + ([] if values[other] is True else [str(values[other])])
        err = call(*words, "--force").err
        assert (
            f"warning: {flag_of(name, parameter)} changes nothing here: {warned[0].message.partition(': ')[2]}" in err
        )


def flag_of(name: str, parameter: str) -> str:
    (found,) = (one for one in GROUP.commands[name].params if one.name == parameter)
    return max(found.opts, key=len)


class TestRefused:
    @pytest.mark.parametrize(
        ("work", "words"),
        {
            "an option that is not there": (
                lambda: mcaptrack.track("log.mcap", max_ages_s=1.0),
                "tracker sort has no parameter max_ages_s; did you mean max_age_s? there are",
            ),
            "a tracker that is not there": (lambda: mcaptrack.track("log.mcap", tracker="dart"), "dart"),
            "a name that is no log's": (
                lambda: mcaptrack.ingest("video.mp4", "out.mp4"),
                "out.mp4 is not a name for a log: logs are MCAP files; give a name that ends with .mcap",
            ),
            "standard output": (lambda: mcaptrack.ingest("video.mp4", "-"), "- is not a file: pipes"),
            "two places": (
                lambda: mcaptrack.track("log.mcap", output="b.mcap", sidecar=True),
                "`sidecar=True` and `output=` are two places",
            ),
            "a URL": (lambda: mcaptrack.info("https://host/a.mcap"), "https://host/a.mcap is a URL"),
            "what exists": (lambda: mcaptrack.recover("log.mcap", "log.mcap"), "both input and output"),
            "frames per second": (lambda: mcaptrack.ingest("video.mp4", "b.mcap", fps=0), "`fps=` needs a number"),
            "a class": (
                lambda: mcaptrack.track("log.mcap", tracker=ByteTrack),
                "ByteTrack is a class; give an object of",
            ),
            "no transform": (lambda: mcaptrack.track("log.mcap", tracker=5), "5 is no transform"),
            "no transform of a stage": (
                lambda: mcaptrack.run("log.mcap", stages={"track": object()}),
                "is no transform: it is no dataclass",
            ),
            "no stage": (
                lambda: mcaptrack.run("log.mcap", stages={"trak": "sort"}),
                "there is no stage trak; `stages=",
            ),
            "no channels": (lambda: mcaptrack.drop("log.mcap", []), "name the channels to remove with `topics=`"),
            **{
                f"a folder to {name}": (
                    lambda name=name: getattr(mcaptrack, name)("."),
                    ". is a folder, not an MCAP file",
                )
                for name in ("check", "export", "recover")
            },
            "no choice": (
                lambda: mcaptrack.detections([[1, 2, 3, 4]], box_format="nonsense"),
                "`box_format=` can't be 'nonsense'; ",
            ),
            "no progress": (
                lambda: mcaptrack.track("log.mcap", progress=None),
                "`progress=` is called as progress(stage",
            ),
            "no gates": (lambda: mcaptrack.evaluate("log.mcap", gate_m=()), "`gate_m=` needs at least one number"),
            "a file for tables": (
                lambda: mcaptrack.export("log.mcap", "boxes.csv"),
                "boxes.csv has the name of a file, and tables are files in a folder",
            ),
            "an array to ingest": (
                lambda: mcaptrack.ingest(np.zeros((2, 2))),
                "`source=` is the name of a file or folder",
            ),
            "gates that are read once": (
                lambda: mcaptrack.evaluate("log.mcap", gate_m=iter((1, 2))),
                "`gate_m=` is a number from 0.001 to 1000000",
            ),
            "a name that is none": (
                lambda: mcaptrack.evaluate("log.mcap", topic=["tracks", None]),
                "`topic=` holds texts, and no other values, not [",
            ),
            "a wrong gate": (lambda: mcaptrack.evaluate("log.mcap", gate_m=(1, -1)), "from 0.001 to 1000000, not -1"),
            "a score of several": (
                lambda: mcaptrack.evaluate("log.mcap").score("IDF1", "retracks"),
                "4 results fit `tracks='retracks'`, `similarity=''` and `gate=None`; choose one of: /camera/retracks ",
            ),
            "a score of none": (
                lambda: mcaptrack.evaluate("log.mcap").score("IDF1", "retracks", "meters"),
                "no results fit `tracks='retracks'`, `similarity='meters'`",
            ),
            "no score": (
                lambda: mcaptrack.evaluate("log.mcap").score("sequence", "retracks", "metres", 1.0),
                "there is no score sequence; there are MOTA",
            ),
            "no limit": (
                lambda: mcaptrack.evaluate("log.mcap").below({"idf1": 1}),
                "there is no score idf1; did you mean IDF1? there are",
            ),
            "what is there": (lambda: mcaptrack.open("log.mcap", create=True), "open it without `create=True`"),
            **of_extensions("REFUSED"),
        }.values(),
    )
    def test_errors_are_one_line_that_names_parameters(self, place, work, words):
        before = {path: path.read_bytes() for path in place.iterdir() if path.is_file()}
        with pytest.raises(McaptrackError) as refused:
            work()
        assert words in str(refused.value)
        assert "\n" not in str(refused.value)
        assert {path: path.read_bytes() for path in place.iterdir() if path.is_file()} == before


class TestChecked:
    @staticmethod
    def words(name: str, parameter: str, value: object) -> str:
        with pytest.raises(McaptrackError) as refused:
            getattr(mcaptrack, name)("nowhere.mcap", **{parameter: value})
        return str(refused.value)

    @pytest.mark.parametrize("name", [name for name in FUNCTIONS if name in GROUP.commands])
    def test_ranges_and_choices_are_those_of_the_command_line(self, name):
        known = inspect.signature(getattr(mcaptrack, name)).parameters
        for setting in [one for one in GROUP.commands[name].settings.values() if one.parameter in known]:
            if get_origin(setting.kind) is Literal:
                said = self.words(name, setting.parameter, "nonsense")
                assert all(choice in said for choice in ("nonsense", *get_args(setting.kind)))
            least, most = setting.declared.least, setting.declared.most
            if not (math.isfinite(least) or math.isfinite(most)):
                continue
            beyond = [least - 1, most + 1] + ([least + 0.5] if setting.kind is int else [math.nan])
            for value in beyond:
                assert self.words(name, setting.parameter, value).startswith(f"`{setting.parameter}=` is a")
            for value in (least, most) if name != "demo" else ():  # demo needs no log
                assert f"`{setting.parameter}=` is a" not in self.words(
                    name, setting.parameter, int(value) if setting.kind is int else value
                )

    def test_what_numpy_computes_is_a_number(self, place):
        gates = mcaptrack.evaluate("log.mcap", similarity="metres", gate_m=np.array([1.0, 2.0])).rows()
        assert {row["gate"] for row in gates} == {1.0, 2.0}
        mcaptrack.track("log.mcap", max_age_s=np.float32(0.5), output="a.mcap")
        mcaptrack.track("log.mcap", max_age_s=0.5, output="b.mcap", stages={"detect": "knn"})
        assert Path("a.mcap").read_bytes() == Path("b.mcap").read_bytes()


class TestWordsOfTheCommandLine:
    """The library names parameters and functions; the command line shows options and commands."""

    def test_options_are_those_of_the_command_that_runs(self, place):
        err = call("ingest", "video.mp4", "-o", "log.mcap").err
        assert err == "mcaptrack: log.mcap exists; give another name with -o, or --force to replace it\n"
        assert "--as " in call("ingest", "video.mp4", "-o", "b.mcap", "--as", "truth").err

    @pytest.mark.parametrize("name", ["a.mcap", "a b.mcap", "it's.mcap", "-o.mcap", "b`c.mcap", 'say "a".mcap', "a\nb"])
    def test_calls_become_commands_whatever_the_file_is_called(self, name):
        import shlex

        line = with_flags(proposed("run", Path(name), topic="/a b", force=True))
        assert line.count("`") == (3 if "`" in name else 2)
        if name.isprintable():
            path = f"./{name}" if name.startswith("-") else name
            assert shlex.split(line[1:-1]) == ["mcaptrack", "run", path, "--topic", "/a b", "--force"]

    def test_a_proposed_call_is_valid_python(self, place):
        shutil.copy("log.mcap", "it's`.mcap")
        names = {"mcaptrack": mcaptrack}
        assert eval(proposed("info", Path("it's`.mcap")).strip("`"), names).messages > 0

    def test_the_library_names_no_option_of_the_command_line(self):
        """Checks all texts outside the command line except documentation, help and pages."""
        found, option = [], re.compile(r"(?<![\w-])(--[a-z]|-o\b)")
        for path in PACKAGE.rglob("*.py"):
            prints = {"cli", "viewing"} & set(path.relative_to(PACKAGE).parts) or path.name == "command.py"
            if prints or (path.parent / "templates").exists():
                continue
            if option.search(path.read_text("utf-8")):
                found += [(place, text) for place, text in texts(path) if option.search(text)]
        assert found == []


class TestDocumentation:
    def test_the_stub_names_what_the_package_gives(self):
        tree = ast.parse((PACKAGE / "__init__.pyi").read_text())
        named = {alias.asname for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
        gone = {name for name in named - {*mcaptrack.__all__} if missing_extension(name)}
        assert named - gone == set(mcaptrack.__all__)
        for node in tree.body:
            if isinstance(node, ast.ImportFrom):
                for alias in (alias for alias in node.names if alias.name not in gone):
                    assert getattr(importlib.import_module(node.module), alias.name) is getattr(mcaptrack, alias.name)

    def test_functions_and_methods_are_documented_as_numpydoc_has_it(self):
        for name in FUNCTIONS:
            sections, named = sections_of(getattr(mcaptrack, name))
            assert (sections, named) == (SECTIONS, list(inspect.signature(getattr(mcaptrack, name)).parameters)), name
        for name, method in METHODS.items():
            sections, named = sections_of(method)
            signature = inspect.signature(method)
            parameters = [one for one in signature.parameters if one != "self"]
            needed = {
                "Parameters": bool(parameters),
                "Returns": signature.return_annotation != "None",
                "Raises": "raise McaptrackError" in inspect.getsource(method),
            }
            assert {one for one, is_needed in needed.items() if is_needed} <= set(sections), name
            assert named == parameters, name
            assert sections == [one for one in SECTIONS if one in sections], name
            assert not (parameters or needed["Returns"]) or sections[-1] == "Examples", name

    @pytest.mark.parametrize("name", [name for name in FUNCTIONS if name in GROUP.commands])
    def test_values_of_another_type_are_refused_by_the_name_of_their_parameter(self, name):
        function = getattr(mcaptrack, name)
        parameters = inspect.signature(function).parameters.values()
        needed = {p.name: "a.mcap" for p in parameters if p.default is p.empty and p.kind is not p.VAR_KEYWORD}
        checked = {str, bool, os.PathLike, collections.abc.Sequence, collections.abc.Mapping, type(None)}
        hints = get_type_hints(function)
        union = (Union, types.UnionType)
        parts = {
            p: get_args(hint) if get_origin(hint) in union else (hint,) for p, hint in hints.items() if p != "return"
        }
        kinds = {p: {get_origin(kind) or kind for kind in of} for p, of in parts.items()}
        for parameter in (p for p, of in kinds.items() if of <= checked):
            with pytest.raises(McaptrackError, match=rf"^`{parameter}=` is .*, not 7$"):
                function(**{**needed, parameter: 7})
        assert [p for p in needed if kinds[p] <= checked] or not needed

    @pytest.mark.parametrize("name", CLASSES)
    def test_classes_document_their_attributes(self, name):
        cls = getattr(mcaptrack, name)
        text = inspect.getdoc(cls)
        assert text
        assert not text.startswith(f"{name}(")  # which a dataclass writes itself
        fields = (
            [f.name for f in dataclasses.fields(cls)]
            if dataclasses.is_dataclass(cls)
            else [*getattr(cls, "_fields", [])]
        )
        (block,) = re.findall(r"^Attributes\n-+\n(.*?)(?:\n\n|\Z)", text, re.M | re.S) or [""]
        named = [one for line in re.findall(r"^(\S.*?) : .*$", block, re.M) for one in line.split(", ")]
        if fields:
            assert sorted(named) == sorted(fields)
        for attribute, value in vars(cls).items():
            if isinstance(value, property) and not attribute.startswith("_"):
                assert inspect.getdoc(value), attribute

    @pytest.mark.parametrize("name", [*FUNCTIONS, *CLASSES, *sorted(METHODS)])
    def test_examples_run(self, name, place, monkeypatch):
        documented = METHODS.get(name) or getattr(mcaptrack, name)
        tests = doctest.DocTestFinder(recurse=False).find(documented, name, globs={})
        if not tests or not tests[0].examples:
            assert name not in FUNCTIONS
            return
        if name == "Recording.show" and not hasattr(mcaptrack, "Player"):
            pytest.skip("players are of an extension")
        if name in NEEDS:
            pytest.importorskip(NEEDS[name], reason=f"{name} needs {NEEDS[name]}")
        monkeypatch.setitem(demo.SCENES, "crowd", lambda seed: small_scene(3.0, seed=seed))  # a short one
        runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", mcaptrack.McaptrackWarning)
            assert all(runner.run(test).failed == 0 for test in tests)


class TestNothingIsSilent:
    """Nothing that changes results happens silently."""

    def test_an_unknown_camera_is_refused(self, place):
        before = Path("log.mcap").read_bytes()
        outcome = call("run", "log.mcap", "--camera", "camra")
        assert (outcome.code, outcome.err) == (
            1,
            "mcaptrack: log.mcap has no camera camra; did you mean camera? it has camera\n",
        )
        assert Path("log.mcap").read_bytes() == before

    def test_predictions_at_the_rate_of_the_video_are_a_warning(self, place):
        said = mcaptrack.predict("log.mcap", topic="/camera/tracks", to="/camera/p").warnings
        assert [(one.code, one.message.partition(",")[0]) for one in said] == [
            ("clock", "/camera/tracks has 10 frames a second")
        ]
        assert mcaptrack.predict("log.mcap", output="b.mcap").warnings == ()
