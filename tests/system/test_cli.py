"""The command line end to end, in a process of its own."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from ppl_jax import checkpoint
from tests.helpers import ROOT, call, program

TINY = ["--total-steps", "60", "--batch-size", "16", "--evaluate-every", "20"]


def command(*words):
    return [
        sys.executable,
        "-W",
        "error::DeprecationWarning",
        "-m",
        "experiments.cli",
        *map(str, words),
    ]


def ppl(*words, code=0):
    done = subprocess.run(command(*words), capture_output=True, text=True, cwd=ROOT, timeout=560)
    assert done.returncode == code, done.stdout + done.stderr
    return done


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A finished tiny run."""
    out = tmp_path_factory.mktemp("runs") / "a"
    done = ppl("train", "driving", *TINY, "--out", out)
    return out, done


@pytest.fixture(scope="module")
def probe_run(tmp_path_factory):
    """The program that knows the probe, where saving and resuming cost little, and its run."""
    folder = tmp_path_factory.mktemp("probe")
    program(folder, "train", "probe", *TINY, "--out", folder / "run")
    return folder / "own.py", folder / "run"


def test_a_run_prints_its_table_and_leaves_a_run_folder(run):
    out, done = run
    assert "success" in done.stdout
    assert "50 held-out scenarios" in done.stdout
    assert "train driving 60/60" in done.stderr
    summary = json.loads((out / "summary.json").read_text())
    for name in (
        "env",
        "algorithm",
        "seed",
        "total_steps",
        "human_data_usage",
        "intervention_rate",
        "success_rate",
        "episodic_return",
        "route_completion",
        "episodic_cost",
        "episodes",
        "wall_s",
        "compile_s",
        "steps_per_s",
    ):
        assert name in summary
    assert summary["episodes"] == 50
    config = json.loads((out / "config.json").read_text())
    assert {"schema", "settings", "versions", "device", "revision"} <= set(config)
    steps = [json.loads(line)["step"] for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert steps == [20, 40, 60]
    lines = (out / "evaluation.csv").read_text().splitlines()
    assert len(lines) == 1 + 3 * 50
    assert len({line.split(",")[1] for line in lines[1:]}) == 50  # every scenario


def test_an_exported_policy_runs_in_plain_numpy_and_drives_the_same(run, tmp_path):
    out, _ = run
    ppl("export", out, "--out", tmp_path / "policy.npz")
    with np.load(tmp_path / "policy.npz", allow_pickle=False) as z:
        files = {name: z[name] for name in z.files}
    assert json.loads(str(files["meta"]))["env"] == "driving"

    def act(obs):
        x = (obs - files["obs_mean"]) / files["obs_scale"]
        x = np.maximum(x @ files["w0"] + files["b0"], 0)
        x = np.maximum(x @ files["w1"] + files["b1"], 0)
        return np.tanh(x @ files["w2"] + files["b2"])

    from experiments.engine.policy_file import load_policy
    from ppl_jax import experts

    policy = load_policy(tmp_path / "policy.npz", 259, 2)
    obs = np.random.default_rng(0).uniform(0, 1, (5, 259)).astype(np.float32)
    np.testing.assert_allclose(experts.act(policy, obs), act(obs), atol=1e-5)
    done = ppl("evaluate", tmp_path / "policy.npz", "--out", tmp_path / "rows.csv")
    assert "50 scenarios" in done.stdout
    rows = (tmp_path / "rows.csv").read_text().splitlines()[1:]
    last = [
        line.split(",")[1:7]
        for line in (out / "evaluation.csv").read_text().splitlines()
        if line.startswith("60,")
    ]
    assert [row.split(",")[1:7] for row in rows] == last


def test_a_saved_policy_can_be_the_expert(probe_run, tmp_path):
    script, out = probe_run
    words = ["--expert", out / "policy.npz", "--expert-noise", "0.1", "--out", tmp_path / "b"]
    call(script, "train", "probe", "--total-steps", "20", "--batch-size", "16", *words)


def files_of(out):
    learner = {}
    newest = out / "checkpoints" / f"step_{checkpoint.steps(out / 'checkpoints')[-1]}"
    learner["crc32"] = json.loads((newest / "checksum.json").read_text())["crc32"]
    for name in ("evaluation.csv", "policy.npz"):
        learner[name] = (out / name).read_bytes()
    for name in ("metrics.jsonl", "summary.json"):  # but for what a clock says
        text = (out / name).read_bytes()
        learner[name] = re.sub(rb'"(time/\w+|wall_s|compile_s|steps_per_s)": [0-9.]+', b"", text)
    return learner


@pytest.mark.parametrize("moment", ["before the first checkpoint", "while saving", "between"])
def test_a_killed_run_resumes_bit_for_bit(probe_run, tmp_path, moment):
    script, whole = probe_run
    out = tmp_path / "killed"
    folder = out / "checkpoints"
    seen = {
        "before the first checkpoint": lambda: (out / "config.json").exists(),
        "while saving": lambda: (folder / "step_40.part").exists(),
        "between": lambda: (folder / "step_20" / "checksum.json").exists(),
    }[moment]
    process = subprocess.Popen(
        [sys.executable, script, "train", "probe", *TINY, "--out", out],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.time() + 300
    while not seen() and process.poll() is None and time.time() < deadline:
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (out / "summary.json").exists()
    call(script, "train", "probe", *TINY, "--out", out, "--resume")
    assert files_of(out) == files_of(whole)


def test_a_damaged_checkpoint_is_named_and_the_one_before_is_used(probe_run, tmp_path):
    script, whole = probe_run
    out = tmp_path / "damaged"
    shutil.copytree(whole, out)
    newest = out / "checkpoints" / "step_60"
    victim = max((p for p in newest.rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    data = bytearray(victim.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(64 * [85])
    victim.write_bytes(bytes(data))
    only = tmp_path / "only"  # the same where there is none before
    shutil.copytree(out, only)
    shutil.rmtree(only / "checkpoints" / "step_40")
    done = call(script, "train", "probe", *TINY, "--out", out, "--resume")
    assert "step_60 is damaged" in done.stderr
    assert files_of(out) == files_of(whole)

    before = {path: path.read_bytes() for path in only.rglob("*") if path.is_file()}
    done = call(script, "train", "probe", *TINY, "--out", only, "--resume", code=2)
    assert {path: path.read_bytes() for path in only.rglob("*") if path.is_file()} == before
    command = done.stderr.splitlines()[-1].partition("start afresh with: ")[2]
    command = command.replace("ppl ", f"{sys.executable} {script} ")
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    subprocess.run(command, shell=True, check=True, env=env, capture_output=True)
    assert files_of(tmp_path / "only-again") == files_of(whole)
    shutil.rmtree(only / "checkpoints")  # thrown away to save room: the log stays too
    done = call(script, "train", "probe", *TINY, "--out", only, "--resume", code=2)
    assert "it has no checkpoint that can be read" in done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train", "flying"], "unknown environment 'flying': choose one of driving"),
        (["train", "driving", "--algorithm", "magic"], "unknown algorithm 'magic': choose one of"),
        (["train", "driving", "--objective", "dpo"], "objective 'dpo' needs a reference policy"),
        (["train", "driving", "--reference-policy", "x.npz"], "reference_policy is for ppl with"),
        (["train", "driving", "--demonstrations", "20000"], "demonstrations must not exceed"),
        (
            ["train", "driving", "--algorithm", "gail", "--evaluate-every", "30"],
            "evaluate_every must be a multiple of rollout_steps (2000) for gail, got 30",
        ),
        (["compare", "driving", "--algorithms", "magic"], "unknown algorithm 'magic'"),
        (["tune", "driving", "--algorithms", "pvp4real"], "no grid for 'pvp4real'"),
        (["ablation", "driving", "--seeds", "0"], "seeds must be at least 1, got 0"),
        (["train", "driving", "--preference-horizon", "11"], "preference_horizon must not exceed"),
        (["train", "driving", "--preference-horizon", "0"], "preference_horizon must be at least"),
        (["train", "driving", "--physics", "mjx"], "physics must be auto for 'driving', got 'mjx'"),
        (["sweep", "driving", "--physics", "auto", "mjx"], "physics must be auto for 'driving'"),
        (["compare", "lift", "--physics", "analytic"], "physics must be auto or one of mjx"),
        (["render", "scripted", "--physics", "mjx"], "physics must be auto for 'driving'"),
        (["train", "driving", "--beta", "-1"], "beta must not be negative, got -1"),
        (["train", "driving", "--prediction-noise", "-0.5"], "prediction_noise must not be"),
        (["train", "driving", "--total-steps", "0"], "total_steps must be at least 1, got 0"),
        (["train", "driving", "--total-steps", "15"], "total_steps must be a multiple of"),
        (["train", "driving", "--resume", "--out", "no/such/run"], "is not a run folder"),
        (["train", "driving", "--scenarios", "no/folder"], "'no/folder' does not exist"),
        (["train", "driving", "--expert", "no.npz"], "policy file 'no.npz' cannot be read"),
        (["evaluate", "no/such/run"], "neither a run folder"),
        (["render", "scripted", "--scenario", "7"], "scenario must be one of 1000 to 1049, got 7"),
        (["render", "scripted", "--out", "film.avi"], "out must end in .gif, .mp4, .png"),
    ],
)
def test_a_mistake_is_one_clear_line_and_exit_code_2(words, message, tmp_path):
    if words[0] == "train" and "--out" not in words:
        words = [*words, "--out", tmp_path / "x"]
    done = ppl(*words, code=2)
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "x" / "checkpoints").exists()


def test_bad_policies_are_refused(run, tmp_path):
    out, _ = run
    with np.load(out / "policy.npz") as z:
        files = dict(z)
    sick = dict(files)
    sick["w1"] = sick["w1"].copy()
    sick["w1"][3, 4] = np.nan
    np.savez(tmp_path / "nan.npz", **sick)
    done = ppl("evaluate", tmp_path / "nan.npz", code=2)
    assert "w1 holds a NaN" in done.stderr
    np.savez(tmp_path / "small.npz", **(files | {"w0": files["w0"][:100]}))
    done = ppl("evaluate", tmp_path / "small.npz", code=2)
    assert "maps 100 observations to 2 actions; this environment has 259 and 2" in done.stderr


def test_another_config_or_an_occupied_folder_is_refused(probe_run):
    script, out = probe_run
    before = files_of(out)
    done = call(script, "train", "probe", *TINY, "--out", out, code=2)
    assert "already holds a run" in done.stderr
    done = call(script, "train", "probe", *TINY, "--seed", "9", "--out", out, "--resume", code=2)
    assert "its seed is 0, asked for 9" in done.stderr
    assert files_of(out) == before


def test_a_full_disk_is_one_line_and_the_last_checkpoint_stays(probe_run, tmp_path):
    script, _ = probe_run
    small = tmp_path / "small"
    small.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1500k", "tmpfs", str(small)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("a small disk cannot be mounted here (needs root)")
    try:
        done = call(script, "train", "probe", *TINY, "--out", small / "run", code=1)
        errors = [
            line
            for line in done.stderr.splitlines()
            if not line.startswith(("train ", "compiling "))
        ]
        assert len(errors) == 1
        assert "no space left on device" in errors[0]
        assert "continue from it with --resume" in errors[0]
        assert checkpoint.steps(small / "run" / "checkpoints")
        subprocess.run(["mount", "-o", "remount,size=64m", str(small)], check=True)
        call(script, "train", "probe", *TINY, "--out", small / "run", "--resume")
    finally:
        subprocess.run(["umount", str(small)], check=True)


def test_help_is_quick():
    began = time.time()
    assert "train" in ppl("--help").stdout
    assert time.time() - began < 5


def test_importing_the_package_does_not_load_the_heavy_libraries():
    code = (
        "import sys, ppl_jax, envs, experiments.cli;"
        "print([m for m in ('jax', 'brax', 'mujoco', 'orbax') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert done.stdout.strip() == "[]"


def test_importing_anything_does_not_start_jax():
    """XLA reads its flags once: a module that makes an array while imported loses them."""
    code = """
import importlib, pkgutil
import jax._src.xla_bridge as bridge
import envs, experiments, ppl_jax
for package in (envs, experiments, ppl_jax):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if module.name.endswith("fidelity"):
            continue  # programs of their own
        importlib.import_module(module.name)
        assert not bridge.backends_are_initialized(), module.name
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.slow
def test_a_run_on_mjx(tmp_path):
    words = ["--physics", "mjx", "--total-steps", "20", "--batch-size", "16", "--hidden", "16"]
    ppl("train", "table_wiping", *words, "--out", tmp_path / "a")
    assert json.loads((tmp_path / "a" / "config.json").read_text())["settings"]["physics"] == "mjx"
    assert json.loads((tmp_path / "a" / "summary.json").read_text())["physics"] == "mjx"
