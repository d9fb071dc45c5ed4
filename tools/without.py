"""Run the tests of the core in a copy of the repository without an extension, and the demonstration.

.venv/bin/python tools/without.py NAME [WORD ...]      WORDs are for pytest, by default all tests
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent


def copy_without(extension: str, folder: Path) -> None:
    """Copy the files of the repository; leave out an extension: its folder, its tests, its entry points."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    gone = (Path("mcaptrack/extensions", extension), Path("tests/extensions", extension))
    for name in listed.splitlines():
        path = Path(name)
        if (ROOT / path).is_file() and not set(gone) & set(path.parents):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / path, folder / path)
    project = folder / "pyproject.toml"
    text, count = re.subn(rf'^.* = "mcaptrack\.extensions\.{extension}\..*"\n', "", project.read_text(), flags=re.M)
    assert count, f"pyproject.toml has no entry points of {extension}"
    project.write_text(text)


def install(folder: Path) -> None:
    """Leave what pip leaves of the copy: entry points in folders that are searched before installed packages."""
    import tomllib

    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    info = folder / "mcaptrack-0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mcaptrack\nVersion: 0\n")
    groups = {"console_scripts": project["scripts"], **project["entry-points"]}
    lines = [line for name, own in groups.items() for line in (f"[{name}]", *(f"{k} = {v}" for k, v in own.items()))]
    (info / "entry_points.txt").write_text("\n".join(lines))


def main() -> int:
    extension, *words = sys.argv[1:]
    with tempfile.TemporaryDirectory(prefix=f"without-{extension}-") as name:
        folder = Path(name)
        copy_without(extension, folder)
        install(folder)
        environment = {"PYTHONPATH": str(folder), "PATH": str(Path(sys.executable).parent) + ":/usr/bin:/bin"}
        for command in (["mcaptrack", "--help"], ["mcaptrack", "demo", "-o", "demo"], ["pytest", *words]):
            done = subprocess.run([sys.executable, "-m", *command], cwd=folder, env=environment, check=False)
            if done.returncode:
                return done.returncode
    return 0


if __name__ == "__main__":
    sys.exit(main())
