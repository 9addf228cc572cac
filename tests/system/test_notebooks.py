"""The notebooks run from top to bottom, at tiny sizes."""

import os
from pathlib import Path

import pytest

NOTEBOOKS = sorted(
    (Path(__file__).parent.parent.parent / "experiments" / "notebooks").glob("*.ipynb")
)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient")
    nbformat = pytest.importorskip("nbformat")
    monkeypatch.setenv("PPL_JAX_TINY", "1")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", os.environ["PPL_JAX_CACHE"])
    notebook = nbformat.read(path, as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells)  # committed without
    resources = {"metadata": {"path": str(tmp_path)}}
    client = nbclient.NotebookClient(notebook, timeout=300, resources=resources)
    client.execute()
    assert any(cell.get("outputs") for cell in notebook.cells[-2:])
