"""The notebooks run from top to bottom, at tiny sizes; `ppl_jax.train`, which they call."""

import ast
import os
import re

import numpy as np
import pytest

import ppl_jax
from tests.helpers import ROOT, Probe

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


def test_every_public_name_is_there():
    assert all(hasattr(ppl_jax, name) for name in ppl_jax.__all__)
    assert set(ppl_jax.__all__) <= set(dir(ppl_jax))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"seed": []}, r"seed must be one value or a flat list of values, got \[\]"),
        ({"seed": 1.5}, "seed must be a whole number or several, got 1.5"),
        ({"beta": []}, r"beta must be one value or a flat list of values, got \[\]"),
        ({"beta": [[0.1]]}, "beta must be one value or a flat list of values"),
        ({"beta": "warm"}, "beta must be a number, got 'warm'"),
        ({"beta": None}, "beta must be a number, got None"),
        ({"beta": [0.1, -1.0]}, "beta must not be negative, got -1.0"),
        ({"preference_horizon": ["auto", 4]}, "preference_horizon must be numbers where it is"),
        ({"total_steps": 20.0}, "total_steps must be a whole number, got 20.0"),
        ({"batch_size": [8, 16]}, "batch_size sets the program and cannot be a list here"),
        ({"betaa": [0.1, 0.2]}, "unknown setting 'betaa': did you mean 'beta'"),
    ],
)
def test_train_refuses_what_is_no_value_in_one_line(given, told):
    with pytest.raises(ValueError, match=told) as caught:
        ppl_jax.train("driving", "ppl", **given)
    assert "\n" not in str(caught.value)


def test_a_grid_is_its_single_runs():
    if "probe" not in ppl_jax.registered():
        ppl_jax.register("probe", Probe)
    size = {"total_steps": 40, "evaluate_every": 20, "batch_size": 8, "hidden": [16, 16]}
    grid = ppl_jax.train("probe", "ppl", seed=range(2), beta=(0.05, 0.5), **size)
    assert grid.success.shape == (2, 2)  # [beta, seed]
    assert grid.axes == {"beta": (0.05, 0.5), "seed": (0, 1)}
    alone = ppl_jax.train("probe", "ppl", seed=np.int64(1), beta=np.float64(0.5), **size)
    columns = ["step", "human_data_usage", "episodic_return"]
    last = grid.curve[grid.curve["run"] == 3][columns].to_numpy()
    np.testing.assert_allclose(last, alone.curve[columns].to_numpy(), rtol=1e-5)
    observation = np.zeros((5, alone.policy.weights[0][0].shape[0]))
    assert alone.policy(observation).shape == (5, alone.policy.weights[-1][1].shape[0])
