"""Options from the command line, the environment and files: which source wins, and which is trusted.

Every law is tried on all options of all commands, as the commands declare them.
"""

from __future__ import annotations

import difflib
import os
import re
import shlex
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest

import mcaptrack
from mcaptrack import environment
from mcaptrack.cli.settings import MAX_BYTES, Setting, user_file
from tests.commands import GROUP, call, toml_value
from tests.tiers import one_in

COMMANDS = GROUP.commands
#: Arguments of commands, as far as they need any.
ARGUMENTS = {"drop": ["x.mcap", "/a"], "demo": [], "doctor": []}
EVERY_COMMAND, SOME_COMMANDS = (pytest.mark.parametrize("command", one_in(count, sorted(COMMANDS))) for count in (4, 9))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


def options_of(command: str) -> list[Setting]:
    return [*COMMANDS[command].settings.values()]


def parsed(command: str, *words: str, config: str = "") -> dict[str, Any]:
    group = GROUP.make_context("mcaptrack", [*(["--config", config] if config else []), command])
    given = [*words, *ARGUMENTS.get(command, ["x.mcap"])]
    return {
        name: as_text(value)
        for name, value in COMMANDS[command].make_context(command, given, parent=group).params.items()
    }


def as_text(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [as_text(member) for member in value]
    return str(value) if isinstance(value, Path) else value


def another(setting: Setting, default: Any) -> Any:
    if setting.kind is bool:
        return not default
    if get_origin(setting.kind) is Literal:
        one = next(name for name in get_args(setting.kind) if name != default)
    elif setting.name == "set":
        settable = COMMANDS[setting.command].settable
        one = f"{max(settable, key=lambda name: settable[name].tuning is True)}=1"  # if there is one that tunes
    elif setting.kind is str and isinstance(setting.declared.tuning, str):
        pattern = setting.declared.tuning
        one = next(word for word in ("cv", "25", "0.25", "min-iou", "car=40") if re.fullmatch(pattern, word))
    else:
        one = {int: 7, float: 0.125, str: "a name", Path: "a file"}[setting.kind]
    return [one, one] if setting.many else one


def words_for(setting: Setting, value: Any) -> list[str]:
    if setting.kind is bool:
        return [f"--{setting.name}" if value else f"--no-{setting.name}"]
    return [word for one in (value if setting.many else [value]) for word in (f"--{setting.name}", str(one))]


def text_for(setting: Setting, value: Any) -> str:
    return shlex.join(map(str, value)) if setting.many else str(value).lower() if setting.kind is bool else str(value)


def table_for(setting: Setting, value: Any) -> str:
    word = f"[{', '.join(map(toml_value, value))}]" if setting.many else toml_value(value)
    return f"[{setting.command}]\n{setting.name} = {word}\n"


def put(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@SOME_COMMANDS
def test_an_option_has_the_same_value_from_every_source(command, folder, monkeypatch):
    usual = parsed(command)
    for setting in options_of(command):
        value = another(setting, usual[setting.parameter])
        ways = {}
        ways["command line"] = parsed(command, *words_for(setting, value))
        with monkeypatch.context() as patch:
            patch.setenv(setting.variable, text_for(setting, value))
            ways["environment"] = parsed(command)
        ways["--config"] = parsed(command, config=str(put(folder.parent / "a.toml", table_for(setting, value))))
        put(user_file(), table_for(setting, value))
        ways["config folder"] = parsed(command)
        user_file().unlink()
        if setting.declared.tuning:
            put(folder / "mcaptrack.toml", table_for(setting, value))
            ways["working folder"] = parsed(command)
            (folder / "mcaptrack.toml").unlink()
        for way, params in ways.items():
            got = params[setting.parameter]
            assert got == value, (way, setting.name)
            rest = {name: was for name, was in usual.items() if name != setting.parameter}
            assert {name: params[name] for name in rest} == rest, (way, setting.name)


def test_the_strongest_source_wins(folder, monkeypatch):
    def value(*words: str, config: str = "") -> Any:
        return parsed("track", *words, config=config)["max_age_s"]

    assert value() is None
    put(user_file(), "[track]\nmax-age-s = 1\nmin-iou = 0.5\n")
    assert value() == 1
    put(folder / "mcaptrack.toml", "[track]\nmax-age-s = 2\n")
    assert value() == 2
    assert parsed("track")["min_iou"] == 0.5  # what the nearer file doesn't say
    named = str(put(folder.parent / "named.toml", "[track]\nmax-age-s = 3\n"))
    assert value(config=named) == 3
    assert parsed("track", config=named)["min_iou"] is None  # the file that is named is instead of both
    monkeypatch.setenv("MCAPTRACK_TRACK_MAX_AGE_S", "4")
    assert value(config=named) == 4
    assert value("--max-age-s", "5", config=named) == 5
    monkeypatch.setenv("MCAPTRACK_CONFIG", named)
    monkeypatch.delenv("MCAPTRACK_TRACK_MAX_AGE_S")
    assert value() == 3


def test_an_option_wins_over_the_set_of_a_weaker_source(finished, folder, monkeypatch):
    named = put(folder / "named.toml", '[track]\nset = ["min_iou=0.3"]\n')

    def min_iou(*words: str) -> float:
        made = folder / "made.mcap"
        call("track", finished, "-o", made, "--force", *words, "--config", named)
        (how,) = [each.parameters for each in mcaptrack.info(made).channels if each.topic == "/camera/tracks"]
        return how["min_iou"]

    assert min_iou() == 0.3
    assert min_iou("--min-iou", "0.5") == 0.5
    monkeypatch.setenv("MCAPTRACK_TRACK_MIN_IOU", "0.4")
    assert min_iou() == 0.4
    monkeypatch.setenv("MCAPTRACK_TRACK_SET", "min_iou=0.6")
    assert min_iou() == 0.6


def refused(*words: str) -> str:
    """Run a command that has to refuse its options with exit code 2, and return its one line of error."""
    outcome = call(*words)
    assert (outcome.code, outcome.out) == (2, ""), outcome
    assert outcome.err.startswith("mcaptrack: ")
    assert outcome.err.count("\n") == 1
    return outcome.err


#: Modules that read the environment: ``fleet`` passes it on to workers, ``objects`` finds credentials there, and
#: ``health`` shows numbers of threads.
READERS = (
    "environment.py",
    "cli/settings.py",
    "cli/stages.py",
    "fleet/worker.py",
    "extensions/stores/objects.py",
    "api/health.py",
)


class TestUnknownNames:
    @SOME_COMMANDS
    def test_an_unknown_name_from_any_source_is_refused_with_the_nearest_one(self, command, folder, monkeypatch):
        known = [setting.name for setting in options_of(command)]
        for place, name in enumerate(known):
            wrong = name[:-1] if name[:-1] not in known and len(name) > 3 else name + "x"
            nearest = difflib.get_close_matches(wrong, known, 1)
            assert nearest, name
            outcome = call(command, f"--{wrong}", "x")
            assert outcome.code == 2
            assert "no such option" in outcome.err
            assert f"--{nearest[0]}" in outcome.err
            if place % 4:  # files and variables are read in one way for all of them
                continue
            put(folder / "mcaptrack.toml", f"[{command}]\n{wrong} = 1\n")
            words = f"mcaptrack.toml: {command} has no option {wrong}; did you mean {nearest[0]}?"
            assert words in refused("info", "x.mcap")
            (folder / "mcaptrack.toml").unlink()
            variable = f"MCAPTRACK_{command}_{wrong}".upper().replace("-", "_")
            monkeypatch.setenv(variable, "1")
            assert f"the environment variable {variable} names no option; did you mean " in refused("info", "x.mcap")
            monkeypatch.delenv(variable)

    def test_a_variable_of_a_parameter_without_an_option_is_refused_with_the_way(self, monkeypatch):
        monkeypatch.setenv("MCAPTRACK_RETRACK_LINK_S", "2")
        assert "names no option; write MCAPTRACK_RETRACK_SET=link_s=VALUE" in refused("info", "x.mcap")

    def test_a_parameter_of_the_command_of_a_stage_alone_is_said_to_change_no_run(self, monkeypatch):
        monkeypatch.setenv("MCAPTRACK_RETRACK_SET", "mode=online link_s=2")
        words = "MCAPTRACK_RETRACK_SET: `mcaptrack retrack` alone has mode; run ignores it"
        for command in ("run", "track", "retrack"):
            assert (words in call(command, "x.mcap").err) == (command == "run")

    def test_a_variable_of_a_command_is_not_taken_for_that_of_another(self, monkeypatch):
        monkeypatch.setenv("MCAPTRACK_TRACK_LEDGER", "x")  # as retrack has, not track
        assert "MCAPTRACK_TRACK_LEDGER names no option; in Python " in refused("info", "x.mcap")

    def test_a_variable_without_its_unit_is_refused(self, monkeypatch):
        monkeypatch.setenv("MCAPTRACK_TRACK_MAX_AGE", "2")
        assert refused("run", "x.mcap").endswith("; did you mean MCAPTRACK_TRACK_MAX_AGE_S?\n")

    def test_variables_that_are_not_options_are_in_one_list(self, folder, monkeypatch):
        values = {"MCAPTRACK_CONFIG": str(put(folder.parent / "a.toml", "")), "MCAPTRACK_LOG_FORMAT": "text"}
        for name in environment.VARIABLES:
            monkeypatch.setenv(name, values.get(name, "1"))
        assert call("info", "x.mcap").code == 1
        package = Path(environment.__file__).parent
        for path in package.rglob("*.py"):
            if path.relative_to(package).as_posix() not in READERS:
                assert not re.search(r"environ\b|getenv", path.read_text()), path

    def test_a_limit_that_is_not_a_number_is_refused(self, tmp_path, monkeypatch):
        from tests.logs import SOME, write_log

        write_log(tmp_path / "a.mcap", SOME)
        for text in ("many", "-1", "0", "9" * 5000):
            monkeypatch.setenv("MCAPTRACK_MAX_CHUNK_MIB", text)
            outcome = call("check", tmp_path / "a.mcap")
            assert outcome.code == 1
            assert "MCAPTRACK_MAX_CHUNK_MIB needs a whole number" in outcome.out + outcome.err


#: Text that a file of the working folder must not set: paths, addresses, modules, commands.
HOSTILE = (
    "red:weights.safetensors",
    "onnx:a.onnx",
    "/etc/passwd",
    "a.txt",
    "https://example.org",
    "a:B",
    "../x",
    "*",
    "",
)


class TestTrust:
    @EVERY_COMMAND
    def test_an_option_that_does_not_tune_is_refused_with_other_ways_to_set_it(self, command, folder):
        usual = parsed(command)
        for setting in options_of(command):
            if setting.declared.tuning is not False:
                continue
            text = table_for(setting, another(setting, usual[setting.parameter]))
            path = put(folder / "mcaptrack.toml", text)
            words = refused("info", "x.mcap")  # whichever command is run
            for part in (f"[{command}] {setting.name}", f"--{setting.name}", setting.variable, str(user_file())):
                assert part in words
            assert [*folder.iterdir()] == [path]

    @EVERY_COMMAND
    def test_tuning_options_are_numbers_switches_choices_or_text_that_is_no_path(self, command, folder):
        for setting in options_of(command):
            if setting.declared.tuning is False:
                continue
            assert setting.kind in (bool, int, float, str) or get_origin(setting.kind) is Literal, setting.name
            assert setting.name not in ("output", "force", "config", "sidecar", "json", "quiet", "open"), setting.name
            if setting.kind is str:
                for text in HOSTILE:
                    value = [text] if setting.many else text
                    put(folder / "mcaptrack.toml", table_for(setting, value))
                    assert f"[{command}] {setting.name}" in refused(command, *ARGUMENTS.get(command, ["x.mcap"]))

    def test_the_working_folder_may_be_the_config_folder(self, monkeypatch):
        path = put(user_file(), '[cut]\noutput = "a.mcap"\n')
        monkeypatch.chdir(path.parent)
        assert parsed("cut")["output"] == "a.mcap"

    def test_set_may_set_there_what_options_may(self, folder):
        """The file of a network is none of it, nor a predictor with weights; a threshold and a speed are."""
        for command, text in (("detect", "file=evil.onnx"), ("retrack", "predictor=red:a.bin"), ("train", "classes=a")):
            put(folder / "mcaptrack.toml", f'[{command}]\nset = ["{text}"]\n')
            assert command not in COMMANDS or "may tune and nothing else" in refused(command, "x.mcap")
        tuned = [("detect", "least_visible=0.1"), ("track", "class_limits=car=40:1"), ("retrack", "mode=online")]
        if "input_size" in COMMANDS["detect"].settable:  # of an extension
            tuned.append(("detect", "input_size=640x640"))
        for command, text in tuned:
            put(folder / "mcaptrack.toml", f'[{command}]\nset = ["{text}"]\n')
            assert parsed(command)["set"] == [text]

    def test_a_link_to_a_file_is_not_trusted(self, folder):
        other = put(folder.parent / "other.toml", '[cut]\noutput = "a.mcap"\n')
        (folder / "mcaptrack.toml").symlink_to(other)
        assert "may tune and nothing else" in refused("info", "x.mcap")


class TestFiles:
    CASES = {
        b"[track]\nmax-age-s = " + b"[" * 5000 + b"]" * 5000: "is not valid TOML: it is nested too deeply",
        b"[track]\nmax-age-frames = " + b"9" * 5000: "is not valid TOML: Exceeds the limit",
        b"[track]\nmax-age-s = 1" + b"0" * 4000: "[track] max-age-s is too large a number for TOML",
        b"[track]\ncost = '\xff'": "is not valid TOML: 'utf-8' codec can't decode",
        b"[track\n": "is not valid TOML: Expected ']'",
        b"[trak]\nmin-iou = 1": "there is no command trak; did you mean track?",
        b"min-iou = 1": "there is no command min-iou",
        b"track = 1": "track is a command; write its options below [track]",
        b'[track]\n"a\\nb\\u001b[2J" = 1': r"track has no option a\nb\x1b[2J",
        b'[track]\ncost = "a\\nb\\u001b[2J"': r'track has no option cost; write set = ["cost=a\nb\x1b[2J"]',
        b"[track]\nmin_iou = 0\nmin-iou = 1": "[track] has min_iou and min-iou; give one of them",
        b"[track]\nviews = true": "track has no option views; in Python mcaptrack.track has it: views=True",
        b"[track]\nmax-age-s = [1, 2, 3, 4, 5, 6, 7]": "[track] max-age-s needs a number, not [1, 2, 3, 4, 5, 6, ...]",
        b"[track]\nmin-iou = true": "[track] min-iou needs a number, not True",
        b"\0" * 100: "is not valid TOML: Invalid statement",
    }

    @pytest.mark.parametrize("place", ["working folder", "config folder", "--config"])
    def test_a_file_that_is_not_toml_is_refused(self, place, folder):
        path = {"working folder": folder / "mcaptrack.toml", "config folder": user_file()}.get(place, folder / "a.toml")
        for data, said in self.CASES.items():
            put(path, "").write_bytes(data)
            words = refused("track", "x.mcap", *(["--config", str(path)] if place == "--config" else []))
            assert re.fullmatch(rf"mcaptrack: \S*{path.name}:? {re.escape(said)}.*\n", words)
            assert len(words) < 500

    def test_a_file_that_is_too_large_is_not_read(self, folder):
        path = folder / "mcaptrack.toml"
        with path.open("wb") as stream:
            stream.truncate(2**33)
        assert f"has {2**33} bytes; a file of options has at most {MAX_BYTES}" in refused("track", "x.mcap")

    @pytest.mark.parametrize("named", [False, True])
    def test_a_path_that_is_not_a_regular_file_is_refused(self, named, folder):
        path = folder / "mcaptrack.toml"
        words = ["track", "x.mcap", *(["--config", "mcaptrack.toml"] if named else [])]
        os.mkfifo(path)
        assert "is not a regular file" in refused(*words)
        path.unlink()
        path.mkdir()
        assert "is not a regular file" in refused(*words)
        path.rmdir()
        path.symlink_to("/dev/zero")
        assert "is not a regular file" in refused(*words)
        path.unlink()
        path.symlink_to(path)
        assert "can't be read" in refused(*words)

    def test_a_byte_order_mark_is_ignored(self, folder):
        (folder / "mcaptrack.toml").write_bytes(b"\xef\xbb\xbf[track]\nmax-age-s = 2")
        assert parsed("track")["max_age_s"] == 2

    def test_a_named_file_has_to_exist(self):
        assert "--config: none.toml does not exist" in refused("track", "x.mcap", "--config", "none.toml")

    @EVERY_COMMAND
    def test_a_variable_of_the_wrong_type_is_refused(self, command, monkeypatch):
        for setting in options_of(command):
            is_choice = get_origin(setting.kind) is Literal
            if setting.kind in (bool, int, float) or is_choice:
                monkeypatch.setenv(setting.variable, "much\x1b[2J")
                assert setting.variable in refused(command, *ARGUMENTS.get(command, ["x.mcap"]))
                monkeypatch.delenv(setting.variable)
