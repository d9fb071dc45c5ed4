"""Run the tests of the core in a copy of the repository without some extensions, and the demonstration.

.venv/bin/python tools/without.py NAME[,NAME ...] [WORD ...]      WORDs are for pytest, by default all tests
.venv/bin/python tools/without.py all                             without all extensions
.venv/bin/python tools/without.py --list                          print the names, as JSON
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Collection
from pathlib import Path

ROOT = Path(__file__).parent.parent
EXTENSIONS = sorted(path.parent.name for path in (ROOT / "mcaptrack" / "extensions").glob("*/__init__.py"))


def copy_without(extensions: Collection[str], folder: Path) -> None:
    """Copy the files of the repository; leave out extensions: folders, tests, pages, entry points."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    places = ("mcaptrack/extensions/{}", "tests/extensions/{}", "docs/extensions/{}.md")
    gone = {Path(place.format(name)) for place in places for name in extensions}
    for name in listed.splitlines():
        path = Path(name)
        if (ROOT / path).is_file() and not gone & {path, *path.parents}:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / path, folder / path)
    project = folder / "pyproject.toml"
    lines = rf'^.* = "mcaptrack\.extensions\.({"|".join(extensions)})\..*"\n'
    text, count = re.subn(lines, "", project.read_text(), flags=re.M)
    assert count, f"pyproject.toml has no entry points of {', '.join(extensions)}"
    project.write_text(text)


def install(folder: Path) -> None:
    """Leave what pip leaves of the copy: entry points in folders that are searched before installed packages."""
    import tomllib

    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    info = folder / "mcaptrack-0.dist-info"
    info.mkdir()
    needs = [f"Requires-Dist: {package}\n" for package in project["dependencies"]]
    for extra, packages in project["optional-dependencies"].items():
        needs += [f"Provides-Extra: {extra}\n", *(f"Requires-Dist: {one}; extra == '{extra}'\n" for one in packages)]
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: mcaptrack\nVersion: 0\n{''.join(needs)}")
    groups = {"console_scripts": project["scripts"], **project["entry-points"]}
    lines = [line for name, own in groups.items() for line in (f"[{name}]", *(f"{k} = {v}" for k, v in own.items()))]
    (info / "entry_points.txt").write_text("\n".join(lines))


def main() -> int:
    names, *words = sys.argv[1:]
    if names == "--list":
        print(json.dumps([*EXTENSIONS, "all"]))
        return 0
    extensions = EXTENSIONS if names == "all" else names.split(",")
    if unknown := {*extensions} - {*EXTENSIONS}:
        sys.exit(f"there is no extension {', '.join(sorted(unknown))}; there are {', '.join(EXTENSIONS)}, or all")
    with tempfile.TemporaryDirectory(prefix="without-") as name:
        folder = Path(name)
        copy_without(extensions, folder)
        install(folder)
        environment = {"PYTHONPATH": str(folder), "PATH": str(Path(sys.executable).parent) + ":/usr/bin:/bin"}
        for command in (["mcaptrack", "--help"], ["mcaptrack", "demo", "-o", "demo"], ["pytest", *words]):
            done = subprocess.run([sys.executable, "-m", *command], cwd=folder, env=environment, check=False)
            if done.returncode:
                return done.returncode
    return 0


if __name__ == "__main__":
    sys.exit(main())
