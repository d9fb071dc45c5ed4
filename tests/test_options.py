"""Parameters of stages arrive in what they make.

The tests follow from what the code declares, so that an option that is added is tested, too.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, get_type_hints

import pytest

from mcaptrack.predictors import NAMES
from mcaptrack.transforms import PROFILES, TRACKERS, TRANSFORMS
from mcaptrack.transforms import STAGES as STAGES_OF_LOGS
from mcaptrack.transforms.protocol import bare_type, choices
from tests.commands import done, toml_value
from tests.logs import provenance_of
from tests.tiers import one_in


@pytest.fixture
def folder(template, tmp_path, monkeypatch) -> Path:
    shutil.copy(template, tmp_path / "a.mcap")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@dataclass(frozen=True)
class Stage:
    """The command of a stage with one of its transforms, which the options ``chosen`` select."""

    command: str
    transform: Any
    target: str
    chosen: tuple[tuple[str, str], ...] = ()

    def parameters(self) -> dict[str, Any]:
        options = [field.name for field in fields(self.transform) if not field.metadata.get("context")]
        return {name: getattr(self.transform, name) for name in options}

    def others(self) -> dict[str, Any]:
        hints = get_type_hints(type(self.transform))
        out = {}
        for field in fields(self.transform):
            if field.name in (default := self.parameters()):
                out[field.name] = _other(default[field.name], bare_type(hints[field.name]), field.metadata)
        return out

    def made(self, path: Path) -> dict[str, Any]:
        said = provenance_of(path, self.target).parameters
        return {name: value for name, value in said.items() if name in self.parameters()}


def _other(default: Any, kind: Any, declared: Any) -> Any:
    """Return an allowed value of a parameter that differs from its default."""
    if kind is bool:
        return not default
    if names := choices(kind):
        return next(name for name in names if name != default)
    if kind is str:
        if "NAME=SPEED" in declared["help"]:
            return "car=40"
        return next(name for name in NAMES if name != default)
    least, most = declared["least"], declared["most"]
    near = [default + 1, default / 2, default - 1] if default else [1, least, most]
    return next(kind(value) for value in near if least <= value <= most and kind(value) != default)


STAGES = [
    Stage("detect", TRANSFORMS["detect"](), "/camera/detections"),
    Stage("motion", TRANSFORMS["motion"](), "/camera/motion"),
    *(Stage("track", kind(), "/camera/tracks", (("tracker", name),)) for name, kind in TRACKERS.items()),
    Stage("sample", TRANSFORMS["sample"](), "/camera/samples"),
    Stage("predict", TRANSFORMS["predict"](), "/camera/predictions"),
    *(Stage("retrack", made, "/camera/retracks", (("profile", name),)) for name, made in PROFILES.items()),
]


def as_settings(values: dict[str, Any], transform: Any) -> dict[str, Any]:
    """Parameters as settings: those without an option of their own are texts of ``set``."""
    flagless = {field.name for field in fields(transform) if not field.metadata.get("flag", True)}
    texts = [f"{name}={str(value).lower()}" for name, value in values.items() if name in flagless]
    return {name: value for name, value in values.items() if name not in flagless} | ({"set": texts} if texts else {})


def flags(values: dict[str, Any]) -> list[str]:
    out = []
    for name, value in values.items():
        if name == "set":
            out += [word for text in value for word in ("--set", text)]
            continue
        flag = name.replace("_", "-")
        out += [f"--{flag}" if value else f"--no-{flag}"] if isinstance(value, bool) else [f"--{flag}", str(value)]
    return out


def toml(command: str, values: dict[str, Any]) -> str:
    lines = [f"{name.replace('_', '-')} = {toml_value(value)}" for name, value in values.items()]
    return "\n".join([f"[{command}]", *lines]) + "\n"


def named(stage: Stage) -> str:
    return "-".join([stage.command, *dict(stage.chosen).values()])


@pytest.mark.parametrize("stage", STAGES, ids=named)
def test_every_parameter_of_a_stage_arrives_in_the_provenance(stage, folder):
    """From the command line: tests/test_settings.py has it that a value is the same wherever it comes from."""
    values = flags(as_settings(stage.others(), stage.transform))
    done(stage.command, "a.mcap", "-o", "b.mcap", *flags(dict(stage.chosen)), *values)
    assert stage.made(folder / "b.mcap") == stage.others()
    assert len(stage.others()) == len(stage.parameters())


# Motion is made by run only where it is needed.
@pytest.mark.parametrize("stage", one_in(4, [stage for stage in STAGES if stage.command != "motion"]), ids=named)
def test_parameters_reach_the_stages_that_run_makes(stage, folder):
    """``run --force`` applies them where the channel exists; without it a warning says that they are not applied."""
    values = as_settings(stage.others(), stage.transform) | dict(stage.chosen)
    Path("mcaptrack.toml").write_text(toml(stage.command, values))
    before = (folder / "a.mcap").read_bytes()
    left = json.loads(done("run", "a.mcap", "--no-tables", "--json", "-q").out)
    assert (folder / "a.mcap").read_bytes() == before
    assert [(one["code"], stage.target in one["message"]) for one in left["warnings"]] == [("other-settings", True)]
    again = json.loads(done("run", "a.mcap", "--no-tables", "--force", "--json").out)
    made = [one for one in again["results"][0]["stages"] if one != "motion"]
    assert made == ["detect", "track", "sample", "predict", "retrack", "events", "views"]
    assert stage.made(folder / "a.mcap") == stage.others()
    after = json.loads(done("run", "a.mcap", "--no-tables", "--json").out)["warnings"]
    assert "other-settings" not in [one["code"] for one in after]


def test_a_parameter_has_an_option_in_all_transforms_of_a_stage_or_in_none():
    for command in STAGES_OF_LOGS.values():
        has_flag: dict[str, set[bool]] = {}
        for kind in command.built_in().values():
            for field in fields(kind):
                has_flag.setdefault(field.name, set()).add(field.metadata.get("flag", True))
        assert {name for name, values in has_flag.items() if len(values) > 1} == set()
