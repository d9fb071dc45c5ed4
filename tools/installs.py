"""Install mcaptrack as people do, on every Python that is here, and do the main job with each.

    python3 tools/installs.py [--pythons 3.11 3.12] [--only newest] [--minutes 10] [--tests] [--keep FOLDER]

Builds the source distribution, and the wheel from it, once. On each CPython from 3.11 on it installs the wheel into
empty environments, without constraints.txt: with the newest releases of everything it depends on (pip), and with the
lowest that pyproject.toml allows (uv). In each, tools/main_job.py goes from encoded videos to a report; with the newest
releases first without extras. Then the commands of README.md run as they are written (tools/readme.py), with the
interpreter that runs this. `--tests` runs the tests that look at dependencies, too, with the lowest releases on the
lowest Python.

Needs Python 3.11 or later with pip and venv, and a package registry that pip can reach; uv comes from there. Never
installs the extra `train` (torch). What can't be tried here is said in a line. Exits with 1 if anything failed.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shlex
import subprocess
import sys
import tarfile
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from shutil import rmtree
from time import monotonic
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LEAST = (3, 11)
EXTRAS = ("onnx", "sql", "tune")
#: The Pythons that pyproject.toml names: on others a dependency may have no wheels yet.
NAMED = {line.rpartition(" ")[2] for line in PROJECT["classifiers"] if re.search(r"Python :: 3\.\d", line)}
#: Where mcaptrack meets what it depends on: video, logs, tables, messages of others, networks.
EDGES = (
    "detect", "export", "flat", "foreign", "log", "networks", "passing", "pictures", "query", "schema",
    "sort", "tables", "video", "views",
)  # fmt: skip
TEST_TOOLS = ("grpcio-tools", "hypothesis", "mcap-protobuf-support", "pandas", "polars", "pytest", "pytest-xdist")
#: Old releases beside new ones of what they depend on warn of what will be removed.
OLD = ("-W", "ignore::DeprecationWarning", "-W", "ignore::PendingDeprecationWarning")
#: Longer than any of the commands takes on a slow line and a busy machine.
TOO_LONG_S = 600
BEGUN = monotonic()
NO_NETWORK = re.compile(
    r"NewConnectionError|ConnectTimeout|Max retries|name resolution|dns error|tcp connect error|Connection refused"
    r"|Failed to fetch|error sending request|Could not fetch URL|timed out"
    r"|No matching distribution found for (?:build|uv)\b",
    re.I,
)
NO_WHEELS = re.compile(
    r"has no (?:usable )?wheels|no wheels with a matching|No matching distribution|only-binary", re.I
)


class Failed(Exception):
    """A command that failed, with what it printed."""


class Skipped(Exception):
    """Something that can't be tried on this machine, and why."""


class Python(NamedTuple):
    """An interpreter: its version, such as (3, 12, 1), and where it is."""

    version: tuple[int, int, int]
    path: Path

    @property
    def minor(self) -> str:
        return f"{self.version[0]}.{self.version[1]}"


class Built(NamedTuple):
    """What was built, and the programs it was built with."""

    wheel: Path
    source: Path
    uv: Path


def run(*words: object, cwd: Path | None = None) -> str:
    """Run a command; what it prints. Raises Failed."""
    mine = ("PIP_CONSTRAINT", "UV_CONSTRAINT", "PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    env = {name: value for name, value in os.environ.items() if name not in mine}
    env |= {"PIP_DISABLE_PIP_VERSION_CHECK": "1", "UV_NO_PROGRESS": "1", "UV_LINK_MODE": "copy"}
    command = [str(word) for word in words]
    try:
        done = subprocess.run(
            command,
            check=False,
            cwd=cwd,
            env=env,
            capture_output=True,
            text=True,
            timeout=TOO_LONG_S,
        )
    except subprocess.TimeoutExpired as error:
        raise Failed(f"$ {' '.join(command)}\nnot done after {TOO_LONG_S} s") from error
    if done.returncode != 0:
        raise Failed(f"$ {' '.join(command)}\nexit {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def tools(folder: Path) -> Path:
    """An environment with `build` and uv in it; the folder of its programs."""
    run(sys.executable, "-m", "venv", folder / "tools")
    inside = folder / "tools" / "bin"
    run(inside / "python", "-m", "pip", "install", "--quiet", "build", "uv")
    as_pip(inside / "python")
    return inside


def as_pip(python: Path) -> None:
    """Let uv look for packages where pip is configured to, unless it is configured itself."""
    said = run(python, "-m", "pip", "config", "list")
    of_pip = dict(re.findall(r"^.*\.([\w-]+)='(.*)'$", said, re.M))
    for name, variable in {"index-url": "UV_DEFAULT_INDEX", "cert": "SSL_CERT_FILE"}.items():
        if name in of_pip:
            os.environ.setdefault(variable, of_pip[name])


def pythons(uv: Path | None = None) -> list[Python]:
    """The CPythons of this machine from 3.11 on, one of each minor version, lowest first.

    Looks for them in PATH, where pyenv and uv keep theirs, and in /opt/python. The one that runs this comes before
    others of its minor version, later releases before earlier ones.
    """
    asked = [Path(sys.executable)]
    for folder in os.get_exec_path():
        asked += sorted(path for path in Path(folder).glob("python3*") if re.fullmatch(r"python3(\.\d+)?", path.name))
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    asked += [found for root in (pyenv, Path("/opt/python")) for found in sorted(root.glob("*/bin/python3"))]
    if uv is not None:
        listed = run(uv, "python", "list", "--only-installed", "--output-format", "json")
        asked += [Path(each["path"]) for each in json.loads(listed)]
    words = (
        "import ensurepip, sys, sysconfig, venv; v = sys.version_info\n"
        "usable = sys.implementation.name == 'cpython' and v.releaselevel == 'final'\n"
        "print(*v[:3]) if usable and not sysconfig.get_config_var('Py_GIL_DISABLED') else sys.exit(1)"
    )
    found: dict[str, Python] = {}
    for path in dict.fromkeys(asked):
        try:
            said = subprocess.run([path, "-I", "-c", words], capture_output=True, text=True, timeout=60, check=True)
            major, minor, micro = map(int, said.stdout.split())
        except (
            OSError,
            ValueError,
            subprocess.SubprocessError,
        ):  # a shim of a version that isn't chosen, no venv, PyPy
            continue
        one = Python((major, minor, micro), path)
        known = found.get(one.minor)
        if (major, minor) >= LEAST and (known is None or (known.path != asked[0] and known.version < one.version)):
            found[one.minor] = one
    return sorted(found.values())


def build(folder: Path, programs: Path) -> Built:
    """The source distribution, unpacked, and the wheel that it gives."""
    run(programs / "python", "-m", "build", "--outdir", folder / "dist", ROOT)
    (wheel,), (archive,) = (list((folder / "dist").glob(pattern)) for pattern in ("*.whl", "*.tar.gz"))
    with tarfile.open(archive) as packed:
        packed.extractall(folder / "source", filter="data")
    (source,) = (folder / "source").iterdir()
    return Built(wheel, source, programs / "uv")


def newest(python: Python, built: Built, folder: Path) -> Iterator[str]:
    """As a person does: pip, the newest releases, first without extras."""
    folder.mkdir()
    run(python.path, "-m", "venv", folder / "env")
    inside = folder / "env" / "bin" / "python"
    with_wheels(python, inside, "-m", "pip", "install", "--quiet", built.wheel)
    yield main_job(inside, folder)
    with_wheels(python, inside, "-m", "pip", "install", "--quiet", f"{built.wheel}[{','.join(EXTRAS)}]")
    yield main_job(inside, folder, "--only-extras")


def lowest(python: Python, built: Built, folder: Path) -> Iterator[str]:
    """The lowest releases that pyproject.toml allows and that have wheels."""
    folder.mkdir()
    run(python.path, "-m", "venv", "--without-pip", folder / "env")
    inside = folder / "env" / "bin" / "python"
    wanted = [*PROJECT["dependencies"], *(each for extra in EXTRAS for each in PROJECT["optional-dependencies"][extra])]
    words = ("--quiet", "--python", inside, "--only-binary", ":all:", "--resolution", "lowest-direct")
    with_wheels(python, built.uv, "pip", "install", *words, *wanted, built.wheel)
    yield from higher(wanted, installed(built.uv, inside))
    yield main_job(inside, folder)


def with_wheels(python: Python, *words: object, cwd: Path | None = None) -> None:
    """Install something. Raises Skipped on Pythons that aren't promised where something has no wheels yet."""
    try:
        run(*words, cwd=cwd)
    except Failed as error:
        if NO_WHEELS.search(str(error)) and not NO_NETWORK.search(str(error)) and python.minor not in NAMED:
            raise Skipped(f"something has no wheels for Python {python.minor} yet: {last_line(error)}") from error
        raise


def installed(uv: Path, python: Path) -> dict[str, str]:
    """Versions by name, as `same` writes names."""
    listed = json.loads(run(uv, "pip", "list", "--python", python, "--format", "json"))
    return {same(each["name"]): each["version"] for each in listed}


def same(name: str) -> str:
    """A package's name as the registry compares it: ``ruamel.yaml`` is ``ruamel-yaml``."""
    return re.sub(r"[-_.]+", "-", name).lower()


def higher(wanted: Iterable[str], versions: dict[str, str]) -> Iterator[str]:
    """What is installed in a higher release than the lowest allowed, because that one has no wheels for this Python."""
    for each in wanted:
        name, least = re.fullmatch(r"([\w.-]+)>=([\d.]+).*", each).groups()
        has = versions[same(name)]
        if not f"{has}.".startswith(f"{least}."):
            yield f"{name} {least} has no wheel here, or something else needs a later one: tried with {has}"


def main_job(python: Path, folder: Path, *more: str) -> str:
    """Releases that it ran with."""
    said = run(python, "-I", ROOT / "tools" / "main_job.py", folder / "job", *more, cwd=folder).splitlines()
    return said[-2] if more else said[0]


def edges(low: Python, built: Built, folder: Path) -> Iterator[str]:
    """The tests of the source distribution that look at dependencies, on the installed wheel and the lowest releases.

    The source of the package is taken away, so that only the installed one can be tested.
    """
    inside, place = folder / f"{low.minor} lowest" / "env" / "bin" / "python", folder / "tests"
    place.mkdir()
    pins = "\n".join(f"{name}=={has}" for name, has in installed(built.uv, inside).items() if name != "mcaptrack")
    (place / "lowest.txt").write_text(pins)
    words = ("--quiet", "--python", inside, "--only-binary", ":all:", "-c", place / "lowest.txt")
    run(built.uv, "pip", "install", *words, *TEST_TOOLS)
    (built.source / "mcaptrack").rename(place / "mcaptrack")
    places = ("bags/test_bags.py", "render", "tuning")
    of_extensions = [f"tests/extensions/{place}" for place in places]
    files = [f"tests/test_{name}.py" for name in EDGES]
    files += [file for file in of_extensions if (built.source / file).exists()]
    said = run(inside, "-m", "pytest", *OLD, "--numprocesses", "auto", *files, cwd=built.source)
    yield said.splitlines()[-1]


def readme(python: Python, folder: Path) -> Iterator[str]:
    """The commands of README.md, in an environment that begins empty."""
    yield from run(python.path, ROOT / "tools" / "readme.py", folder).splitlines()


def image(found: Sequence[Python], built: Built, folder: Path) -> Iterator[str]:
    """What the Dockerfile installs, in an environment that begins empty, and the health check."""
    text = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    wanted = re.findall(r"^FROM python:(3\.\d+)-slim", text, re.M)[0]
    python = next((each for each in found if each.minor == wanted), None)
    if python is None:
        raise Skipped(f"there is no Python {wanted} on this machine")
    run(python.path, "-m", "venv", folder / "env")
    inside = folder / "env" / "bin"
    with_wheels(python, inside / "python", *shlex.split(pip_line(text)), cwd=built.source)
    for line in slimming(text):
        run("sh", "-c", line.replace("/opt/mcaptrack", shlex.quote(str(folder / "env"))))
    (words,) = re.findall(r"^HEALTHCHECK .*CMD (\[.*\])$", text, re.M)
    name, *more = json.loads(words)
    run(inside / name, *more, cwd=folder)
    size = sum(path.lstat().st_size for path in (folder / "env" / "lib").rglob("*"))
    yield f"{size / 1e6:.0f} MB of packages; {' '.join([name, *more])} finds no fault"


def pip_line(text: str) -> str:
    """What a Dockerfile lets Python do to install mcaptrack."""
    (line,) = re.findall(r"^RUN \S*/python (-m pip install .*)$", text, re.M)
    return str(line)


def slimming(text: str) -> list[str]:
    """What a Dockerfile removes of the installation again."""
    after = text.partition(" -m pip install ")[2]
    return re.findall(r"^RUN (.*/opt/mcaptrack.*)$", after, re.M)


def last_line(error: Exception) -> str:
    return next((line.strip() for line in reversed(str(error).splitlines()) if line.strip()), "")


class Attempts:
    """What was tried, and how it went."""

    def __init__(self) -> None:
        self.failed: list[str] = []

    def __call__(self, name: str, work: Callable[[], Iterable[str]]) -> None:
        begun = monotonic()
        try:
            said = [f"    {line}\n" for line in work()]
        except Skipped as why:
            print(f"skipped: {name}: {why}", flush=True)
        except Failed as error:
            self.failed.append(name)
            found = NO_NETWORK.search(str(error))
            why = f"the package registry can't be reached ({found[0]})" if found else last_line(error)
            print(f"\n{error}\nFAILED: {name}: {why}\n", flush=True)
        else:
            print(f"ok: {name} ({monotonic() - begun:.0f} s)\n{''.join(said)}", end="", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pythons", nargs="+", metavar="3.N", help="only these; all that are here")
    parser.add_argument("--only", choices=("newest", "lowest"), help="only these releases; both")
    parser.add_argument("--skip-readme", action="store_true", help="leave the commands of README.md out")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin nothing later than that; no limit")
    parser.add_argument("--tests", action="store_true", help="run tests with the lowest releases, too")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="leave everything here; a folder that goes away")
    options = parser.parse_args()
    if sys.version_info[:2] < LEAST:
        parser.error(f"this is Python {sys.version_info[0]}.{sys.version_info[1]}; 3.11 or later is needed")
    folder = options.keep.resolve() if options.keep else Path(tempfile.mkdtemp(prefix="mcaptrack-installs-"))
    folder.mkdir(parents=True, exist_ok=True)
    attempt = Attempts()
    try:
        try_all(options, folder, attempt)
    finally:
        if not options.keep:
            rmtree(folder, ignore_errors=True)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    took = f"{monotonic() - BEGUN:.0f} s, {used.ru_utime + used.ru_stime:.0f} s of them computing"
    print(
        f"installs: {'FAILED: ' + '; '.join(attempt.failed) if attempt.failed else 'all is well'} ({took})", flush=True
    )
    return 1 if attempt.failed else 0


def try_all(options: argparse.Namespace, folder: Path, attempt: Attempts) -> None:
    built: list[Built] = []
    found: list[Python] = []

    def prepare() -> Iterator[str]:
        programs = tools(folder)
        found.extend(each for each in pythons(programs / "uv") if each.minor in (options.pythons or [each.minor]))
        if not found:
            raise Failed("none of these Pythons is here")
        built.append(build(folder, programs))
        yield f"{built[0].wheel.name}, to be tried on " + ", ".join(f"{each.minor} ({each.path})" for each in found)

    attempt("build", prepare)
    if attempt.failed:
        return
    for minor in sorted(NAMED - {each.minor for each in found}):
        print(f"skipped: Python {minor}: {'not asked for' if options.pythons else 'there is none on this machine'}")
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        begun = [
            pool.submit(attempt, name, in_time(work, options.minutes))
            for name, work in works(options, found, built[0], folder)
        ]
    for each in begun:
        each.result()
    if options.tests and options.only != "newest" and not attempt.failed:
        attempt("tests with the lowest releases", lambda: edges(found[0], built[0], folder))


def in_time(work: Callable[[], Iterable[str]], minutes: float) -> Callable[[], Iterable[str]]:
    """Something that isn't begun when there is no time left for it."""

    def begin() -> Iterable[str]:
        if monotonic() > BEGUN + 60 * minutes:
            raise Skipped(f"the {minutes:g} minutes are over")
        return work()

    return begin


def works(
    options: argparse.Namespace, found: Sequence[Python], built: Built, folder: Path
) -> Iterator[tuple[str, Callable[[], Iterable[str]]]]:
    """What is tried, by name; what matters most first."""
    own = next((each for each in found if each.path == Path(sys.executable)), found[0])
    tried = [("newest", own), ("lowest", found[0]), ("README", own)]
    tried += [(name, each) for each in found for name in ("newest", "lowest")]
    for name, python in dict.fromkeys(tried):
        place = folder / f"{python.minor} {name}"
        if name == "README":
            if not options.skip_readme:
                yield (
                    f"Python {python.minor}, newest releases, the commands of README.md",
                    partial(readme, python, place),
                )
            if options.only is None:
                yield "the installation of the Dockerfile", partial(image, found, built, folder / "image")
        elif options.only in (None, name):
            install = {"newest": newest, "lowest": lowest}[name]
            yield f"Python {python.minor}, {name} releases", partial(install, python, built, place)


if __name__ == "__main__":
    sys.exit(main())
