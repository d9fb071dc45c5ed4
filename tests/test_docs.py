"""What the documentation says is so: its blocks run, its commands exist, its site is built without a warning."""

from __future__ import annotations

import ast
import importlib.util
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager, redirect_stdout
from itertools import pairwise
from pathlib import Path
from time import sleep
from typing import Any

import duckdb
import nbformat
import pytest

from mcaptrack import __version__
from mcaptrack.installed import missing_extension
from tests.commands import GROUP, call, done
from tests.extension_cases import is_gone
from tests.tiers import thorough
from tools import pages, readme
from tools.pages import NOT_RUN, ROOT, Block

README, ARCHITECTURE = (ROOT / name for name in ("README.md", "ARCHITECTURE.md"))
PAGES = pages.pages()
EVERY_PAGE = pytest.mark.parametrize("page", PAGES, ids=[path.relative_to(ROOT).as_posix() for path in PAGES])
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
COMMANDS = GROUP.commands
#: Pages that take long, and whose commands other tests run; those of README.md tools/readme.py runs in an environment of
#: its own.
LONG = {
    "README.md", "camera-motion.md", "corrections.md", "demo.md", "extend.md", "fleet.md", "python.md", "results.md",
    "robots.md", "stages.md", "troubleshooting.md", "tutorial.md",
}  # fmt: skip
#: What a page finds where it names it: a copy of a prepared file or folder.
PREPARED = {
    "log.mcap": "log.mcap",
    "log.tables": "log.tables",
    "tables/": "log.tables",
    "demo.tables": "log.tables",
    "mcaptrack-demo/demo.mp4": "video.mp4",
    "mcaptrack-demo/truth.txt": "gt.txt",
    "mcaptrack-demo/ground_plane.txt": "homography.txt",
}


@pytest.fixture(scope="session")
def prepared(tmp_path_factory) -> Path:
    """A folder with the files that pages name, made once for all processes that run these tests."""
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if worker else base) / "prepared"
    try:
        folder.with_suffix(".lock").mkdir()
    except FileExistsError:
        while not folder.exists():
            assert not folder.with_suffix(".failed").exists(), "another process couldn't make these files"
            sleep(0.1)
        return folder
    making = folder.with_suffix(".making")
    making.mkdir()
    try:
        prepare(making)
    except BaseException:
        folder.with_suffix(".failed").mkdir()
        raise
    return making.rename(folder)


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(path, marks=thorough) if path.name in LONG or path.parent.name == "extensions" else path
        for path in PAGES
    ],
    ids=[path.relative_to(ROOT).as_posix() for path in PAGES],
)
def test_every_block_of_a_page_runs_and_prints_what_stands_below_it(page, prepared, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_page(pages.blocks(page), prepared)


@EVERY_PAGE
def test_commands_in_the_text_of_a_page_exist_with_their_options(page):
    text = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.S | re.M)
    for line in re.findall(r"(?<!`)`(mcaptrack [^`]+)`(?!`)", text):
        if not re.search(r"\b[A-Z]{3,}\b|\.\.\.", line):  # forms, such as `mcaptrack COMMAND --help`
            assert_exists(line)


def test_blocks_have_known_languages_and_reasons():
    found = [block for page in PAGES for block in pages.blocks(page)]
    assert {block.language for block in found} <= set(pages.LANGUAGES)
    assert {block.marks["not run"] for block in found if "not run" in block.marks} <= set(NOT_RUN)
    kept = [block for block in found if "not run" not in block.marks and block.language != "text"]
    assert len(kept) > 4 * sum("not run" in block.marks for block in found)


def test_every_command_is_shown_on_a_page():
    lines = [
        line
        for page in PAGES
        for block in pages.blocks(page)
        if block.language == "sh"
        for line in block.text.splitlines()
    ]
    assert {line.split()[1] for line in lines if line.startswith("mcaptrack ")} >= set(COMMANDS)


@thorough
@pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="mkdocs isn't installed")
def test_the_site_is_built_without_a_warning_and_has_every_page(tmp_path):
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    outcome = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stderr
    for page in (path.relative_to(ROOT / "docs") for path in PAGES if path != README):
        name = page.with_suffix("") if page.stem != "index" else page.parent
        html = (tmp_path / name / "index.html").read_text()
        assert "<h1" in html
        assert not re.search(r"<!-- (generated|not run|file|exit)", html)
        assert not re.search(
            r"(?:src|href)=\"(?:https?:)?//(?!github\.com|foxglove\.dev)[^\"]*\.(?:js|css|woff2?)", html
        )


@thorough
def test_pictures_and_numbers_are_those_that_are_made_now():
    words = [sys.executable, "tools/readme.py", "--check"]
    outcome = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr


def test_the_readme_is_one_page():
    assert len(README.read_text().splitlines()) <= 150


def test_the_two_commands_of_the_readme_are_those_of_the_makefile_and_of_ci():
    assert re.findall(r"`(make \w+)`", README.read_text()) == ["make demo", "make test"]
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.M))
    assert {"demo", "test"} <= targets
    assert "exec make test" in (ROOT / ".ci" / "run").read_text()


def test_files_and_folders_that_the_map_names_exist():
    named = re.findall(
        r"`([a-z_]+/[a-z_]*(?:\.py|/)|[a-z_]+\.(?:py|toml)|tools/[a-z_/]+\.py)`", ARCHITECTURE.read_text()
    )
    assert len(named) > 5
    for name in named:
        assert (ROOT / name).exists() or (ROOT / "mcaptrack" / name).exists() or is_gone(name), name


def test_every_guarantee_of_the_map_names_test_files_that_exist():
    listed = ARCHITECTURE.read_text().partition("## What holds for a log\n")[2].partition("\n## ")[0]
    guarantees = re.split(r"^- ", listed, flags=re.M)[1:]
    assert len(guarantees) > 10
    for guarantee in guarantees:
        files = [ROOT / "tests" / f"{name}.py" for name in re.findall(r"`([\w/]*test_\w+)`", guarantee)]
        assert files, guarantee
        of_missing = [path for path in files if path.parents[1].name == "extensions" and not path.parent.exists()]
        assert all(path.exists() for path in files if path not in of_missing), guarantee


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
    wanted = [
        *PROJECT["dependencies"],
        *(d for extra in PROJECT["optional-dependencies"].values() for d in extra),
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


# How the blocks of a page are run


def prepare(folder: Path) -> None:
    """One small recording, through all stages: what pages call log.mcap."""
    with chdir(folder):
        for name in ("video.mp4", "homography.txt", "gt.txt"):
            readme.FILES[name](Path(name))
        done("ingest", "video.mp4", "--ground-plane", "homography.txt", "--truth", "gt.txt", "-o", "log.mcap")
        done("run", "log.mcap")


def run_page(found: list[Block], prepared: Path) -> None:
    """Run all blocks of a page in order, in the working folder."""
    said: str | None = None
    names: dict[str, object] = {"__name__": "__page__"}
    with duckdb.connect() as connection:
        for block in found:
            try:
                if "file" in block.marks:
                    Path(block.marks["file"]).write_text(block.text)
                elif block.language == "text":
                    if said is not None:
                        assert_same_words(block.text, said)
                    said = None
                elif "not run" in block.marks:
                    parse(block)
                    said = None
                else:
                    said = run(block, prepared, connection, names)
            except BaseException as error:
                if is_of_a_missing_extension(str(error)):
                    said = None
                    continue
                error.add_note(f"in the block at {block.place}")
                raise


def is_of_a_missing_extension(message: str) -> bool:
    """Whether a block says no more than that an extension was taken away."""
    return "is an extension that isn't installed" in message


def run(block: Block, prepared: Path, connection: duckdb.DuckDBPyConnection, names: dict[str, object]) -> str:
    """Run a block and give back what it prints."""
    provide(block.text, prepared)
    match block.language:
        case "sh":
            return "".join(run_line(line, int(block.marks.get("exit", 0))) for line in lines_of(block))
        case "python":
            printed = io.StringIO()
            with redirect_stdout(printed), importable():
                exec(compile(block.text, block.place, "exec", dont_inherit=True), names)
            return printed.getvalue()
        case "sql":
            connection.execute(block.text)
            return ""
        case "toml":
            provide("log.mcap", prepared)
            use_settings(block.text)
            return ""
        case "json":
            json.loads(block.text)
            return ""
    raise AssertionError(f"{block.language} can't be run; mark the block as `text` if it is output")


def lines_of(block: Block) -> list[str]:
    """The command lines of a block of sh."""
    joined = block.text.replace("\\\n", " ")
    return [line for line in joined.splitlines() if line.strip() and not line.startswith("#")]


def run_line(line: str, code: int = 0) -> str:
    """Run a command of mcaptrack; give back what it prints on stderr, then what it prints."""
    words = shlex.split(line, comments=True)
    assert words[0] == "mcaptrack", f"only commands of mcaptrack are run; mark the block ({', '.join(NOT_RUN)}): {line}"
    for before, word in pairwise(words):
        if before != "-o" and word in readme.FILES and not any(Path().glob(word.rstrip("/"))):
            readme.FILES[word](Path(word))
    with importable():
        outcome = call(*words[1:])
    assert outcome.code == code, f"{line}: exit {outcome.code}, {outcome.err}"
    return outcome.err + outcome.out


@contextmanager
def importable() -> Iterator[None]:
    """Modules of the working folder can be imported, and are forgotten afterwards."""
    before, here = set(sys.modules), os.getcwd()
    sys.path.insert(0, here)
    try:
        yield
    finally:
        sys.path.remove(here)
        for name in set(sys.modules) - before:
            if (getattr(sys.modules[name], "__file__", None) or "").startswith(here):
                del sys.modules[name]


def provide(text: str, prepared: Path) -> None:
    """Put prepared files where a text names them, unless they are there, or the text makes them."""
    for name, source in PREPARED.items():
        target = Path(name)
        if target.exists() or not re.search(rf"(?<![\w.-]){re.escape(name)}", text) or f"-o {name}" in text:
            continue
        target.parent.mkdir(exist_ok=True)
        whole = prepared / source
        shutil.copytree(whole, target) if whole.is_dir() else shutil.copy2(whole, target)


def use_settings(text: str) -> None:
    """Settings of commands are read by these commands; other TOML only has to be TOML."""
    tables = tomllib.loads(text)
    if not tables.keys() <= COMMANDS.keys():
        assert not tables.keys() & COMMANDS.keys(), f"there is no command {tables.keys() - COMMANDS.keys()}"
        return
    Path("page.toml").write_text(text)
    for name in tables:
        done(name, "log.mcap", "--config", "page.toml", *(("-o", f"{name}-settings.mcap") if name != "info" else ()))


def parse(block: Block) -> None:
    """What is checked of a block that isn't run."""
    assert block.marks["not run"] in NOT_RUN, block.place
    PARSERS[block.language](block.text)


def assert_exists(line: str) -> None:
    """A command line names a command and options that exist; of others, targets of make and extras are checked."""
    words = shlex.split(line, comments=True)
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.M), line
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for named in re.findall(r"(?:\.|mcaptrack)\[([\w,]+)\]", line):
        assert set(named.split(",")) <= extras.keys(), line
    if words[0] != "mcaptrack" or len(words) == 1:
        return
    if words[1].startswith("-"):
        assert words[1] in ("--help", "--version"), line
        return
    if missing_extension(words[1], "command"):
        return
    command = COMMANDS[words[1]]
    known = {name for one in command.params for name in (*one.opts, *one.secondary_opts)} | {"--help", "--help-all"}
    for word in words[2:]:
        if word.startswith("-") and not re.fullmatch(r"-\d.*", word):
            assert word.partition("=")[0] in known, line


PARSERS: dict[str, Callable[[str], object]] = {
    "sh": lambda text: [assert_exists(line) for line in text.replace("\\\n", " ").splitlines() if line.strip()],
    "python": ast.parse,
    "sql": duckdb.extract_statements,
    "toml": tomllib.loads,
    "json": json.loads,
}


def assert_same_words(shown: str, said: str) -> None:
    """A page shows what was printed, up to numbers and blanks; ``...`` stands for anything."""

    def bare(text: str) -> str:
        return re.sub(r"[\s─]+", " ", re.sub(r"(?<![A-Za-z])\d[\d,.]*|(?<!\S)-(?!\S)", "0", text)).strip()

    pattern = ".*".join(re.escape(part) for part in bare(shown).split("..."))
    assert re.fullmatch(pattern, bare(said), re.S), f"the page shows\n{shown}\nprinted was\n{said}"


# The notebooks in examples/: they run as they are, and print what stands in them.


NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))


def printed(notebook: Any) -> list[str]:
    out = []
    for cell in (cell for cell in notebook.cells if cell["cell_type"] == "code"):
        texts = []
        for output in cell["outputs"]:
            assert output["output_type"] in ("stream", "execute_result", "display_data"), output
            assert output.get("name") != "stderr", output
            texts.append(output.get("text") or "".join([*sorted(output["data"]), output["data"].get("text/plain", "")]))
        out.append("".join(texts))
    return out


@pytest.fixture
def own_jupyter(tmp_path, monkeypatch):
    """Jupyter and IPython keep their files in a folder of the test."""
    for name in ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@thorough
def test_a_notebook_prints_what_stands_in_it(path, tmp_path, own_jupyter):
    notebook = nbformat.read(path, as_version=4)
    kept = printed(notebook)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Jupyter's own parts; mcaptrack runs in the kernel
        from nbclient import NotebookClient

        resources = {"metadata": {"path": str(tmp_path)}}
        NotebookClient(notebook, timeout=240, kernel_name="python3", resources=resources).execute()
    found = printed(notebook)
    if path.stem == "video_to_tracks":  # what is found in a video depends on the versions of its coder and of OpenCV
        kept, found = ([re.sub(r"\d+(\.\d+)?", "N", text) for text in texts] for texts in (kept, found))
    assert found == kept


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_small_name_no_machine_and_begin_with_words(path):
    text = path.read_text()
    nbformat.validate(nbformat.reads(text, as_version=4))
    cells = nbformat.reads(text, as_version=4).cells
    assert cells[0]["cell_type"] == "markdown"
    assert cells[0]["source"].startswith("# ")
    assert len(text) < 150_000
    assert not re.search(r"/(?:home|root|tmp|Users|work)/", "".join(cell["source"] for cell in cells))
    assert not re.search(r"/(?:home|root|Users|work)/", "".join(printed(nbformat.reads(text, as_version=4))))
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(cell["execution_count"] == number for number, cell in enumerate(code, 1)), "run all cells, in order"


def test_the_list_of_examples_is_complete():
    named = re.findall(r"\]\((\w+\.ipynb)\)", (ROOT / "examples" / "README.md").read_text())
    assert named == sorted(named, key=named.index)
    assert set(named) == {path.name for path in NOTEBOOKS}
