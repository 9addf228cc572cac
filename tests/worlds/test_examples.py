"""The examples of an environment and of an arm scene of one's own, run from outside the package."""

import csv
import json
import os
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


def test_own_scene_is_solved_by_its_expert_from_outside(tmp_path):
    shutil.copytree(EXAMPLES / "own_scene", tmp_path / "own_scene")
    told = run(
        tmp_path, "-m", "own_scene.expert", "expert", "evaluate", "hover", "--kind", "scripted"
    )
    assert "success" in told
    assert "1.00" in told


def test_own_scene_is_drawn(tmp_path):
    pytest.importorskip("mujoco")
    shutil.copytree(EXAMPLES / "own_scene", tmp_path / "own_scene")
    code = (
        "import own_scene.expert, envs, jax, numpy as np\n"
        "from envs.manipulation.twins import make_twin\n"
        "env = envs.make('hover')\n"
        "state = env.reset_to(0, jax.random.key(0), env.default_params)\n"
        "twin = make_twin(env)\n"
        "twin.place(state)\n"
        "twin.arm.mujoco.mj_kinematics(twin.arm.model, twin.arm.data)\n"
        "site = twin.arm.data.site_xpos[twin.arm.site]\n"
        "assert np.abs(site - np.asarray(env.grip_position(state))).max() < 1e-4\n"
        "np.testing.assert_allclose(twin.arm.data.mocap_pos[0], state.goal, atol=1e-6)\n"
    )
    run(tmp_path, "-c", code)


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
