"""The documentation of transforms: a summary, examples that run, and the paper of each tracker."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
from dataclasses import fields
from pathlib import Path

import pytest

import mcaptrack
from mcaptrack.registry import BUILT_IN
from mcaptrack.transforms import STAGES
from mcaptrack.transforms.protocol import Traits

BUILT_IN_TRANSFORMS = {name: cls for stage in STAGES.values() for name, cls in stage.built_in().items()}
PAPERS = {"sort": "Bewley", "bytetrack": "Zhang", "ocsort": "Cao", "knn": "Zivkovic"}


@pytest.mark.parametrize("name", BUILT_IN_TRANSFORMS)
def test_every_transform_has_a_summary_of_one_sentence_and_known_sections(name):
    text = inspect.getdoc(BUILT_IN_TRANSFORMS[name]) or ""
    assert re.fullmatch(r"[A-Z].*\.", text.partition("\n\n")[0].replace("\n", " "))
    sections = [name for name in re.findall(r"^([A-Z]\w+)\n-+$", text, re.MULTILINE) if name != "Parameters"]
    assert sections in (["Examples", "References"], ["Examples"], ["References"])
    assert PAPERS.get(name, "") in text.partition("References")[2]


@pytest.mark.parametrize("stage", STAGES.values(), ids=STAGES)
def test_the_examples_of_the_default_transform_run(stage):
    assert "Examples\n" in inspect.getdoc(stage.default)


@pytest.mark.parametrize("module", sorted({cls.__module__ for cls in BUILT_IN_TRANSFORMS.values()}))
def test_examples_run(module):
    assert doctest.testmod(importlib.import_module(module)).failed == 0


def test_every_paper_is_of_a_built_in_transform():
    assert set(PAPERS) <= {name for kind in BUILT_IN.values() for name in kind}


ROOT = Path(mcaptrack.__file__).parent


def test_traits_are_documented_with_their_defaults():
    page = (ROOT.parent / "docs" / "extend.md").read_text("utf-8")
    table = re.findall(r"^\| `(\w+)` \| `(.+?)` \|", page.partition("| class attribute | default |")[2], re.MULTILINE)
    defaults = Traits()
    assert {name: ast.literal_eval(default) for name, default in table} == {
        trait.name: getattr(defaults, trait.name) for trait in fields(Traits)
    }


def test_traits_are_read_in_one_place():
    """Code that asks a transform by getattr has a default of its own, which nothing declares."""
    names = "|".join(trait.name for trait in fields(Traits))
    asked = re.compile(rf"""(?:get|has)attr\([^()]*,\s*["'](?:{names})["']""")
    found = {path.name: asked.findall(path.read_text("utf-8")) for path in sorted(ROOT.rglob("*.py"))}
    assert {name: those for name, those in found.items() if those} == {}
