"""The notebooks run from top to bottom, at tiny sizes."""

import ast
import os
import re

import pytest

import ppl_jax
from tests.helpers import ROOT

NOTEBOOKS = sorted((ROOT / "experiments" / "notebooks").glob("*.ipynb"))
each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path):
    nbformat = pytest.importorskip("nbformat")
    return nbformat.read(path, as_version=4)


def printed(notebook):
    """What its cells print."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return "".join(output.get("text", "") for output in outputs)


@each
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient")
    monkeypatch.setenv("PPL_JAX_TINY", "1")
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", os.environ["PPL_JAX_CACHE"])
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # this tree, whatever is installed
    notebook = read(path)
    assert all(not cell.get("outputs") for cell in notebook.cells)  # committed without
    resources = {"metadata": {"path": str(tmp_path)}}
    client = nbclient.NotebookClient(notebook, timeout=300, resources=resources)
    client.execute()
    assert any(cell.get("outputs") for cell in notebook.cells[-2:])
    told = printed(notebook)
    assert re.search(r"success .*\d\.\d", told)
    if path.stem.startswith("4_"):
        assert "gate deviates_from_expert" in told  # the method left the decision to the gate
        assert "gate low_return" in told


@each
def test_a_notebook_uses_the_public_surface(path):
    cells = [cell.source for cell in read(path).cells if cell.cell_type == "code"]
    code = "\n".join(cells)
    assert "ppl_jax.train(" in code
    for node in ast.walk(ast.parse(code)):
        modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        assert not {name.split(".")[0] for name in modules} & {"envs", "experiments"}
        if isinstance(node, ast.ImportFrom):
            assert not {alias.name for alias in node.names} & set(ppl_jax.__all__)
