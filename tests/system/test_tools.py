"""`ppl doctor`, and that XLA's own log stays off the terminal."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.report.figures import figure
from experiments.tools import bench, doctor
from experiments.tools.bench_growth import bench_growth
from tests.helpers import Probe

ROOT = Path(__file__).parent.parent.parent
LOG = "TF_CPP_MIN_LOG_LEVEL"
PROBE = """
import os, sys
import importlib.abc

class Watch(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == "jax" and not seen:
            seen.append(os.environ.get("TF_CPP_MIN_LOG_LEVEL"))

seen = []
sys.meta_path.insert(0, Watch())
"""
START = """
from experiments.engine.runtime import start_jax
start_jax()
"""
DOCTOR = """
from experiments.cli import main
main(["doctor"])
"""
WORKER = """
from experiments.cli import main
main(["sweep-worker"])
"""


def level_before_jax(code, given=None):
    """TF_CPP_MIN_LOG_LEVEL as it stands when JAX is imported first."""
    env = {name: value for name, value in os.environ.items() if name != LOG}
    env |= {"PYTHONPATH": str(ROOT)} | ({} if given is None else {LOG: given})
    # the last line of standard error: a worker answers jobs on what was standard output
    code = f"{PROBE}{code}\nprint(seen, file=sys.stderr)"
    run = subprocess.run(
        [sys.executable, "-c", code], env=env, input="", capture_output=True, text=True, check=True
    )
    return run.stderr.splitlines()[-1]


@pytest.mark.parametrize("code", [START, DOCTOR, WORKER], ids=["start_jax", "command", "worker"])
def test_the_log_of_xla_is_hidden_before_jax_is_imported(code):
    assert level_before_jax(code) == "['3']"


def test_a_level_that_the_user_set_is_kept():
    assert level_before_jax(START, "0") == "['0']"


def test_doctor_lists_every_extra_and_how_to_install_it(monkeypatch, capsys):
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(doctor.shutil, "which", lambda name: None)
    doctor.doctor()
    lines = capsys.readouterr().out.partition("\nExtras\n")[2].splitlines()
    found = {line.split()[0]: line for line in lines}
    assert list(found) == [
        *("render", "plot", "brax", "ray", "ui", "minari", "onnx", "warp", "docs", "dev"),
        "chromium",
    ]
    for name, line in found.items():
        command = "apt-get install -y chromium" if name == "chromium" else f"'ppl-jax[{name}]'"
        assert "missing" in line
        assert line.endswith(command)


def test_the_extras_that_doctor_knows_are_those_that_can_be_installed():
    import tomllib

    content = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = content["project"]["optional-dependencies"]
    assert {piece.name for piece in doctor.PIECES} - {"chromium"} == set(extras)


def test_a_piece_that_is_there_is_ready():
    assert doctor.Piece("x", "reading JSON", ("json",)).line().endswith("reading JSON: ready")


def test_growth_is_measured_and_drawn(tmp_path):
    probe = Probe()
    probe.name = "driving"  # whose settings it takes
    sizes = {"steps": (10, 200), "prediction_horizon": (20,)}
    path = tmp_path / "growth.csv"
    rows = bench_growth(repeats=1, out=path, sizes=sizes, env=probe)
    assert [(row["axis"], row["value"]) for row in rows] == [
        (axis, value) for axis, values in sizes.items() for value in values
    ]
    assert rows[1]["cpu_ms"] > 4 * rows[0]["cpu_ms"]
    assert [row["updates"] for row in rows] == [True, True, False]
    figure(path, out=tmp_path / "growth.png")
    assert (tmp_path / "growth.png").stat().st_size > 5000


def test_the_bench_measures_an_arm():
    figures = bench.arm_figures("table_wiping", 1, batches=(1,))
    assert figures.keys() == {
        "table_wiping_compile_s_1",
        "table_wiping_steps_per_s_1",
        "table_wiping_lookahead_10_ms",
    }
    assert all(value > 0 for value in figures.values())
