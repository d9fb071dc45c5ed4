"""What the documents say is so."""

from __future__ import annotations

import re
import tomllib
import zipfile
from pathlib import Path

import pytest
from typer.main import get_command

from mcaptrack import __version__
from mcaptrack.cli import app

ROOT = Path(__file__).parent.parent
README, ARCHITECTURE = (ROOT / name for name in ("README.md", "ARCHITECTURE.md"))
COMMANDS = get_command(app).commands


def written_commands() -> list[list[str]]:
    """The mcaptrack commands in the shell blocks and in the running text of the README."""
    text = README.read_text()
    blocks = re.findall(r"```sh\n(.*?)```", text, re.S)
    lines = [line for block in blocks for line in block.splitlines()]
    lines += re.findall(r"`(mcaptrack [^`]+)`", text)
    return [line.split() for line in lines if line.startswith("mcaptrack ")]


@pytest.mark.parametrize("words", written_commands(), ids=" ".join)
def test_commands_in_the_readme_exist_with_their_options(words):
    command = COMMANDS[words[1]]
    known = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)} | {"--help"}
    for word in words[2:]:
        if word.startswith("-"):
            assert word in known, words


def test_every_command_is_in_the_readme():
    documented = {words[1] for words in written_commands()} | set(re.findall(r"^make (\w+)$", README.read_text(), re.M))
    assert set(COMMANDS) <= documented


def test_the_two_commands_of_the_readme_are_those_of_the_makefile_and_of_ci():
    assert re.findall(r"```sh\n(make \w+)\n```", README.read_text()) == ["make demo", "make test"]
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.M))
    assert {"demo", "test"} <= targets
    assert "exec make test" in (ROOT / ".ci" / "run").read_text()


def test_the_example_configuration_names_options_that_exist():
    (block,) = re.findall(r"```toml\n(.*?)```", README.read_text(), re.S)
    for name, values in tomllib.loads(block).items():
        known = {parameter.name for parameter in COMMANDS[name].params}
        assert {key.replace("-", "_") for key in values} <= known


def test_files_and_folders_that_the_map_names_exist():
    named = re.findall(
        r"`([a-z_]+/[a-z_]*(?:\.py|/)|[a-z_]+\.(?:py|toml)|tools/[a-z_/]+\.py)`", ARCHITECTURE.read_text()
    )
    assert len(named) > 5
    for name in named:
        assert (ROOT / name).exists() or (ROOT / "mcaptrack" / name).exists(), name


def test_the_floors_on_the_map_are_those_that_are_held():
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = {name.strip().rpartition(".")[2] for layer in contracts[0]["layers"] for name in layer.split("|")}
    modules = {
        path.stem for path in (ROOT / "mcaptrack").iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()
    }
    assert layers == {name for name in modules if not name.startswith("__")}
    text = ARCHITECTURE.read_text()
    assert all(re.search(rf"\b{name}\b", text) for name in layers)


def test_every_dependency_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [
        *project["dependencies"],
        *(d for extra in project["optional-dependencies"].values() for d in extra),
        "hatchling",
    ]
    pinned = {
        re.split("==", line)[0].lower() for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line
    }
    assert {re.split(r"[<>=\[ ]", dependency)[0].lower() for dependency in wanted} <= pinned


def test_the_changelog_knows_this_version():
    version, _, dev = __version__.partition(".dev")
    heading = f"## {version} (unreleased)\n" if dev else f"## {version}"
    assert heading in (ROOT / "CHANGELOG.md").read_text()


def test_the_wheel_carries_the_schemas(tmp_path):
    from hatchling.builders.wheel import WheelBuilder

    (artifact,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    names = set(zipfile.ZipFile(artifact).namelist())
    assert {f"mcaptrack/schemas/{path.name}" for path in (ROOT / "schemas").glob("*.proto")} <= names
    assert {"mcaptrack/predictors/trained/red.safetensors", "mcaptrack/predictors/trained/lstm.safetensors"} <= names
    assert "mcaptrack/py.typed" in names
    assert not any(name.startswith(("tests/", "tools/")) for name in names)
