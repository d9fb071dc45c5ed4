"""The notebooks in examples/: they run as they are, and print what stands in them."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import nbformat
import pytest

from tests.tiers import thorough

ROOT = Path(__file__).parent.parent
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
