"""The documentation of metrics: numpydoc sections, references, and examples that run."""

from __future__ import annotations

import doctest
import importlib
import inspect
import pkgutil
import re

import pytest

from mcaptrack.evaluation import metrics

MODULES = [importlib.import_module(f"{metrics.__name__}.{one.name}") for one in pkgutil.iter_modules(metrics.__path__)]
#: The scores that come from papers, and the first author of each.
PAPERS = {
    "clear": "Bernardin",
    "identity": "Ristani",
    "hota": "Luiten",
    "displacement": "Yu",
    "forecast_scores": "Pellegrini",
    "average_over_recalls": "Weng",
}


def public_functions():
    for module in [metrics, *MODULES]:
        for name, found in vars(module).items():
            is_own = inspect.isfunction(found) and found.__module__ == module.__name__
            if is_own and (name in metrics.__all__ or name in PAPERS):
                yield name, found


FUNCTIONS = dict(public_functions())


def test_every_paper_has_its_function():
    assert set(PAPERS) <= set(FUNCTIONS)
    assert {name for name in metrics.__all__ if name not in ("Matchup", "Rules", "Score", "ScoredMatchup")} <= set(
        FUNCTIONS
    )


@pytest.mark.parametrize("name", FUNCTIONS)
def test_sections(name):
    function = FUNCTIONS[name]
    text = inspect.getdoc(function) or ""
    sections = re.findall(r"^([A-Z]\w+)\n-+$", text, re.MULTILINE)
    wanted = ["Parameters", "Returns", *(["References"] if name in PAPERS else []), "Examples"]
    assert sections == wanted
    described = re.findall(r"^([a-z]\w*(?:, \w+)*) : ", text.partition("Parameters")[2].partition("Returns")[0], re.M)
    assert [one for names in described for one in names.split(", ")] == list(inspect.signature(function).parameters)
    assert PAPERS.get(name, "") in text


@pytest.mark.parametrize("module", [metrics, *MODULES], ids=lambda module: module.__name__.rpartition(".")[2])
def test_examples_run(module):
    failed, tried = doctest.testmod(module)
    assert failed == 0
    assert tried > 0
