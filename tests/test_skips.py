"""Tests are skipped for want of a package only where `make test` doesn't install it."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
INSTALLED = {
    re.split(r"[^\w-]", wanted)[0] for wanted in PROJECT["dependencies"] + PROJECT["optional-dependencies"]["test"]
}


@pytest.mark.parametrize("path", sorted((ROOT / "tests").rglob("*.py")), ids=lambda path: path.name)
def test_no_test_is_skipped_for_want_of_a_package_that_is_installed(path):
    skipped = re.findall(r"importorskip\(\"([\w-]+)", path.read_text())
    assert not {name for name in skipped if name in INSTALLED}
