"""The examples of an environment and of an arm scene of one's own, run from outside the package."""

import csv
import json
import os
import re
import shutil
import subprocess
import sys

import pytest

from tests.helpers import ROOT

EXAMPLES = ROOT / "experiments" / "examples"
SHORT = ["--total-steps", "20", "--evaluate-every", "20", "--batch-size", "8"]


def run(folder, *words):
    done = subprocess.run(
        [sys.executable, *words],
        capture_output=True,
        text=True,
        timeout=560,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_own_world_trains_from_outside(tmp_path):
    shutil.copy(EXAMPLES / "own_world.py", tmp_path)
    assert len((tmp_path / "own_world.py").read_text().splitlines()) < 70
    run(tmp_path, "own_world.py", "train", "windy", *SHORT, "--out", "w")
    config = json.loads((tmp_path / "w" / "config.json").read_text())
    assert config["env"] == "windy"
    rows = (tmp_path / "w" / "evaluation.csv").read_text().splitlines()
    assert len(rows) == 1 + 10


PAGE = (ROOT / "docs" / "pages" / "bring_your_own_scene.md").read_text()


def follow(folder):
    """What the page says to write: each named file with the text that the page includes."""
    (folder / "own_mjx_scene").mkdir()
    (folder / "own_mjx_scene" / "__init__.py").touch()
    files = re.findall(r"^`(own_mjx_scene/\w+\.py)`.*?--8<--\n(\S+)\n--8<--", PAGE, re.M | re.S)
    assert len(files) == 3
    for name, source in files:
        assert source == f"experiments/examples/{name}"
        shutil.copy(ROOT / source, folder / name)
    (code,) = [text for text in re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
               if "--8<--" not in text]  # fmt: skip
    return code, re.findall(r"^python (-m own_mjx_scene.*)$", PAGE, re.M)


def test_the_page_about_a_scene_of_ones_own_works_line_by_line(tmp_path):
    code, commands = follow(tmp_path)
    assert run(tmp_path, "-c", code).split() == ["12", "6"]
    assert [words.split()[2] for words in commands] == ["expert", "train", "render"]


@pytest.mark.slow  # compiles for minutes
@pytest.mark.timeout(1200)
def test_the_commands_of_the_page_work(tmp_path):
    _, (evaluate, train, render) = follow(tmp_path)
    told = run(tmp_path, *evaluate.split())
    assert "success" in told
    assert "1.00" in told
    run(tmp_path, *train.split(), *SHORT)
    run(tmp_path, *render.split(), "--steps", "4")
    assert (tmp_path / "push.gif").stat().st_size > 0


PROBE = """
import ppl_jax
from tests.helpers import Probe
ppl_jax.register("probe", Probe)
if __name__ == "__main__":"""


def script(folder, name):
    """An example's copy that knows the probe environment, which compiles in a moment."""
    text = (EXAMPLES / name).read_text()
    (folder / name).write_text(text.replace('\nif __name__ == "__main__":', PROBE))
    return name


@pytest.mark.parametrize(
    ("name", "option", "setting"),
    [
        ("own_gate.py", ["--gate", "brakes_late"], ("max_speed_near", 8.0, 3.0)),
        ("own_predictor.py", ["--predictor", "sluggish"], ("lag", 0.3, 0.6)),
    ],
)
def test_own_gate_and_predictor_own_a_setting(tmp_path, name, option, setting):
    program = script(tmp_path, name)
    field, default, other = setting
    flag = f"--{field.replace('_', '-')}"
    told = run(tmp_path, program, "train", "probe", *option, "--help")
    assert flag in told
    run(tmp_path, program, "train", "probe", *option, flag, str(other), *SHORT, "--out", "r")
    config = json.loads((tmp_path / "r" / "config.json").read_text())
    assert config["settings"][field] == other
    swept = [flag, str(default), str(other), "--seeds", "1", *SHORT, "--out", "s"]
    run(tmp_path, program, "sweep", "probe", *option, *swept)
    rows = (tmp_path / "s" / "results.csv").read_text().splitlines()
    assert field in rows[0].split(",")
    assert len(rows) == 1 + 2


def test_own_study_is_a_sweep(tmp_path):
    program = script(tmp_path, "own_study.py")
    words = ["sweep", "probe", "--study", "interval", "--seeds", "1", "--total-steps", "40"]
    run(tmp_path, program, *words, "--batch-size", "8", "--out", "s")
    with open(tmp_path / "s" / "results.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["algorithm"] for row in rows} == {"ppl", "hg_dagger"}
    assert {row["decision_interval"] for row in rows} == {"5", "10", "20"}
