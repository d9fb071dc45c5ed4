"""Docstrings of metrics, transforms and geometry: sections of numpydoc, papers, and examples that run."""

from __future__ import annotations

import ast
import doctest
import importlib
import inspect
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest

import mcaptrack
from mcaptrack.evaluation import metrics
from mcaptrack.registry import BUILT_IN
from mcaptrack.transforms import STAGES
from mcaptrack.transforms.protocol import Traits

ROOT = Path(mcaptrack.__file__).parent
TRANSFORMS = {name: cls for stage in STAGES.values() for name, cls in stage.built_in().items()}
#: The trackers, detectors and scores that come from papers, and the first author of each.
PAPERS = {"sort": "Bewley", "bytetrack": "Zhang", "ocsort": "Cao", "knn": "Zivkovic"}
PAPERS_OF_SCORES = {
    "clear": "Bernardin", "identity": "Ristani", "hota": "Luiten", "displacement": "Yu", "forecast_scores": "Pellegrini",
    "average_over_recalls": "Weng",
}  # fmt: skip
#: Modules of which all examples run without files; those of the library are tried in test_library.
MODULES = [
    ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")
    for folder in ("evaluation", "geometry", "predictors", "schema", "transforms")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if ">>> " in path.read_text("utf-8")
]


def test_scores_have_the_sections_of_numpydoc_and_their_paper():
    modules = [importlib.import_module(name) for name in MODULES if name.startswith(metrics.__name__)]
    found = {}
    for name, function in {name: value for module in modules for name, value in vars(module).items()}.items():
        if not inspect.isfunction(function) or not (name in metrics.__all__ or name in PAPERS_OF_SCORES):
            continue
        found[name] = text = inspect.getdoc(function) or ""
        references = ["References"] if name in PAPERS_OF_SCORES else []
        sections = re.findall(r"^([A-Z]\w+)\n-+$", text, re.MULTILINE)
        assert sections == ["Parameters", "Returns", *references, "Examples"], name
        described = text.partition("Parameters")[2].partition("Returns")[0]
        names = re.findall(r"^([a-z]\w*(?:, \w+)*) : ", described, re.MULTILINE)
        assert ", ".join(names).split(", ") == list(inspect.signature(function).parameters), name
        assert PAPERS_OF_SCORES.get(name, "") in text
    functions = {name for name in metrics.__all__ if inspect.isfunction(getattr(metrics, name))}
    assert functions | PAPERS_OF_SCORES.keys() == found.keys()


def test_transforms_have_a_summary_of_one_sentence_known_sections_and_their_paper():
    for name, cls in TRANSFORMS.items():
        text = inspect.getdoc(cls) or ""
        assert re.fullmatch(r"[A-Z].*\.", text.partition("\n\n")[0].replace("\n", " ")), name
        sections = [title for title in re.findall(r"^([A-Z]\w+)\n-+$", text, re.MULTILINE) if title != "Parameters"]
        assert sections in (["Examples", "References"], ["Examples"], ["References"]), name
        assert PAPERS.get(name, "") in text.partition("References")[2]
    assert all("Examples\n" in inspect.getdoc(stage.default) for stage in STAGES.values())
    assert set(PAPERS) <= {name for kind in BUILT_IN.values() for name in kind}


#: Rooms that offer what they import; other public modules have ``__all__``.
ROOMS = ("foxglove", "log", "pipeline", "schema", "tables")
#: Words for what a parameter or a field holds, in the place of its name.
SAID = {
    "path": "file|log|folder|place|recording|store", "opened": "log|camera|channel|scene", "log": "log", "prefix": "camera|scene",
    "topic": "channel", "t": "time", "xy": "position|track", "sha256": "digest", "px": "pixel", "schema name": "schema", "url": "URL",
    "table": "answer|table|rows", "resident bytes": "memory", "provenance": "made", "image": "picture", "width": "width|size",
    "scene": "SceneUpdate", "sight": "ground|picture|annotations", "payload": "message", "doc": "description",
}  # fmt: skip
#: Units at the end of names, and plural forms.
UNIT = re.compile(r"(_(ns|s|px|m|rad|m2|bytes))?$")


def public() -> dict[str, Any]:
    """The functions and classes that public modules offer, by where they are defined."""
    modules = [path for path in sorted(ROOT.rglob("*.py")) if re.search("^__all__\\b", path.read_text("utf-8"), re.M)]
    modules += [ROOT / room / "__init__.py" for room in ROOMS]
    out = {}
    for path in modules:
        module = importlib.import_module(
            ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")
        )
        for name in getattr(module, "__all__", vars(module)):
            value = inspect.unwrap(getattr(module, name))
            is_own = getattr(value, "__module__", "").startswith("mcaptrack") and not name.startswith("_")
            if is_own and (inspect.isfunction(value) or inspect.isclass(value)):
                out[f"{value.__module__}.{value.__qualname__}"] = value
    return out


def undocumented(value: Any) -> list[str]:
    """The parameters, or the fields, of which the docstring says neither the name nor what they hold."""
    if inspect.isclass(value):
        text = "\n".join(
            inspect.getdoc(base) or "" for base in value.__mro__ if base.__module__.startswith("mcaptrack")
        )
        own = fields(value) if is_dataclass(value) else ()
        names = [f.name for f in own if "help" not in f.metadata and "context" not in f.metadata] or getattr(
            value, "_fields", ()
        )
    else:
        text, names = inspect.getdoc(value) or "", inspect.signature(value).parameters
    for name in re.findall(r"``mcaptrack\.(\w+)``, which explains them", text):
        text += inspect.getdoc(getattr(mcaptrack, name)) or ""
    return [name for name in names if not name.startswith("_") and not is_said(name, text)]


def is_said(name: str, text: str) -> bool:
    stem = UNIT.sub("", name).replace("_", " ")
    words = [SAID.get(stem, "")] if stem in SAID else [SAID.get(word, word.removesuffix("s")) for word in stem.split()]
    return bool(re.search(rf"\b{name}\b", text)) or all(re.search(rf"\b(?:{word})", text, re.I) for word in words)


def raises_silently(value: Any) -> bool:
    """Whether a function raises what its docstring doesn't say."""
    source = inspect.getsource(value) if inspect.isfunction(value) else ""
    return bool(re.search(r"^\s+raise [A-Z]", source, re.M)) and "raise" not in (inspect.getdoc(value) or "").lower()


def test_public_names_say_what_their_parameters_and_fields_hold_and_what_they_raise():
    names = public()
    assert len(names) > 350
    wrong = {name: undocumented(value) for name, value in names.items()}
    assert {name: silent for name, silent in wrong.items() if silent} == {}
    assert [name for name, value in names.items() if raises_silently(value)] == []


@pytest.mark.parametrize("module", MODULES)
def test_examples_run(module):
    failed, tried = doctest.testmod(importlib.import_module(module))
    assert (failed, tried > 0) == (0, True)


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
