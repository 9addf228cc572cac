"""Sweeps: a run as one function, grids and groups, engines, resume, failures."""

import csv
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time

import flax.struct
import jax
import numpy as np
import pandas
import pytest

import envs
from experiments.engine.evaluate import evaluate_run
from experiments.engine.plan import evaluation_steps, plan
from experiments.engine.programs import Programs
from experiments.engine.run import algorithm_factory, make_env_and_expert, train
from experiments.engine.runtime import UserError
from experiments.engine.settings import RunSettings, traced_values
from experiments.engine.worker import Worker
from experiments.options.commands import Sweep
from experiments.studies import grid, quick
from experiments.studies.runner import plan as planned
from ppl_jax import sweep as pure
from ppl_jax.cards import EnvCard
from ppl_jax.config import replace
from ppl_jax.fields import setting
from ppl_jax.training import make_train
from tests.helpers import ROOT, Probe, call, probe_settings, program

if "probe" not in envs.registered():
    envs.register("probe", Probe)

TINY = ["--total-steps", "60", "--evaluate-every", "20", "--batch-size", "8"]


def rows_of(path):
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def settings_of(name, seed=0, **changes):
    changes = {"total_steps": 60, "batch_size": 8, "human_capacity": 60} | changes
    config, hparams = probe_settings(name, **changes)
    return RunSettings("probe", name, seed, config, hparams, evaluate_every=20)


def programs_of(settings, side_by_side=False):
    env, expert = make_env_and_expert(settings)
    functions = make_train(env, expert, algorithm_factory(settings, env), settings.config)
    return Programs(env, functions, settings.config.decision_interval, side_by_side=side_by_side)


# --- a run's programs ---


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("ppl", {}),
        ("bc", {"total_steps": 20, "demonstrations": 20, "offline_updates": 20}),
        ("thrifty_dagger", {"demonstrations": 20, "offline_updates": 20}),
        ("pvp", {"total_steps": 50}),  # the last evaluation comes early
    ],
)
def test_a_sweeps_run_is_the_one_that_ppl_train_makes(name, changes, tmp_path):
    settings = settings_of(name, 3, **changes)
    summary = train(settings, tmp_path / "run")
    run = {"index": 0, "seed": 3, "hparams": traced_values(settings)}
    job = {"settings": settings.as_json(), "side_by_side": False, "runs": [run]}
    (mine,) = Worker().run(json.loads(json.dumps(job)))["runs"]
    theirs = rows_of(tmp_path / "run" / "evaluation.csv")
    steps = evaluation_steps(settings.config, settings.evaluate_every)
    assert [row["step"] for row in mine["rows"]] == steps
    assert sorted({int(row["step"]) for row in theirs}) == steps
    for row in mine["rows"]:
        played = [other for other in theirs if int(other["step"]) == row["step"]]
        success = np.mean([int(other["success"]) for other in played])
        cost = np.mean([float(other["episodic_cost"]) for other in played])
        assert float(row["success"]) == success
        assert float(row["episodic_cost"]) == pytest.approx(cost, rel=1e-5)
        assert row["human_data_usage"] == int(played[0]["human_data_usage"])
    for row, other in zip(mine["episodes"], theirs, strict=True):
        assert {key: str(value) for key, value in row.items()}.items() <= other.items()
    assert mine["rows"][-1]["human_data_usage"] == summary["human_data_usage"]


def test_runs_side_by_side_are_the_runs_one_by_one():
    settings = settings_of("ppl")
    hparams = [
        replace(settings.config, settings.hparams, preference_horizon=horizon, beta=beta)[1]
        for horizon, beta in ((1, 0.1), (4, 0.1), (4, 0.5))
    ]
    keys = jax.vmap(jax.random.key)(np.arange(3, dtype=np.uint32))
    chunks = plan(settings.config, settings.evaluate_every)
    alone, batch = programs_of(settings), programs_of(settings, side_by_side=True)
    together, _ = batch.play(keys, pure.stack(hparams), chunks)
    for i in range(3):
        for own, look in zip(alone.play(keys[i], hparams[i], chunks)[0], together, strict=True):
            mine = look.of(i)
            assert own.step == mine.step
            assert own.counters.human_data == mine.counters.human_data
            np.testing.assert_allclose(
                own.episodes.episodic_return, mine.episodes.episodic_return, atol=1e-3
            )


SHARED = """
import jax, numpy as np
from experiments.engine.plan import plan
from ppl_jax import sweep
from tests.system.test_sweep import programs_of, settings_of

settings = settings_of("ppl")
programs = programs_of(settings, side_by_side=True)
keys = jax.vmap(jax.random.key)(np.arange(4, dtype=np.uint32))
many = sweep.stack([settings.hparams] * 4)
apart = programs.init(*sweep.split((keys, many), jax.devices()))
print(len(apart.diverged.sharding.device_set))
chunks = plan(settings.config, settings.evaluate_every)
looks, layers = programs.play(*sweep.split((keys, many), jax.devices()), chunks)
print(len(layers[0][0].sharding.device_set))
print(looks[-1].counters.human_data.tolist(), looks[-1].episodes.length.tolist())
"""


def test_a_batch_is_shared_out_over_devices():
    told = []
    for devices in (1, 2, 4):
        count = f" --xla_force_host_platform_device_count={devices}"
        flags = os.environ.get("XLA_FLAGS", "") + count
        found = subprocess.run(
            [sys.executable, "-c", SHARED],
            env=os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert found.returncode == 0, found.stderr
        at_start, at_end, results = found.stdout.splitlines()
        assert (at_start, at_end) == (str(devices), str(devices))
        told.append(results)
    assert told[0] == told[1] == told[2]


# --- grids ---


def command(*worlds, **changes):
    names = {field.name for field in dataclasses.fields(Sweep)}
    axes = {name: values for name, values in changes.items() if name not in names}
    rest = {name: value for name, value in changes.items() if name in names}
    return Sweep(worlds, axes=axes, **({"seeds": range(rest.pop("seeds", 5))} | rest))


def test_what_is_traced_shares_a_program_and_what_is_static_does_not():
    traced = {
        "preference_horizon": (1, 4, 10),
        "beta": (0.1, 0.3),
        "prediction_noise": (0.0, 1.0),
        "expert_noise": (0.0, 0.1),
        "learning_rate": (1e-3, 1e-4),
        "min_speed": (3.0, 5.0),
    }
    for name, values in traced.items():
        runs = planned(command("driving", seeds=3, **{name: values}))
        assert len(runs) == 3 * len(values)
        assert len(grid.groups(runs)) == 1, name
    runs = planned(command("driving", seeds=2, batch_size=(64, 256), beta=(0.1, 0.3)))
    assert [len(group.runs) for group in grid.groups(runs)] == [4, 4]
    runs = planned(command("driving", "table_wiping", algorithms=("ppl", "pvp"), seeds=1))
    assert len(grid.groups(runs)) == 4


def test_a_new_value_compiles_nothing():
    """Counted where it matters: in the worker, by what it keeps and by what JAX compiles."""
    worker, compiled = Worker(), []
    base = settings_of("ppl")
    for horizon, beta, noise, rate, seed in (
        (1, 0.1, 0.0, 1e-3, 0),
        (4, 0.1, 0.0, 1e-3, 0),
        (4, 0.5, 0.25, 1e-4, 7),
    ):
        traced = {"preference_horizon": horizon, "beta": beta}
        traced |= {"prediction_noise": noise, "learning_rate": rate}
        run = {"index": 0, "seed": seed, "hparams": traced_values(base) | traced}
        job = {"settings": base.as_json(), "side_by_side": False, "runs": [run]}
        reply = worker.run(json.loads(json.dumps(job)))
        assert "error" not in reply, reply
        compiled.append(reply["compile_s"])
    assert len(worker.programs) == 1
    assert compiled[0] > 0
    assert compiled[1:] == [0, 0]


def test_studies_are_the_papers():
    runs = planned(command("driving", study="horizon"))
    assert {run.settings.config.total_steps for run in runs} == {15_000}
    assert 10_000 in evaluation_steps(runs[0].settings.config, runs[0].settings.evaluate_every)
    assert {run.settings.config.prediction_horizon for run in runs} == {10}
    runs = planned(command("driving", study="prediction_noise", seeds=1))
    noises = sorted({run.settings.hparams.prediction_noise for run in runs})
    assert noises == [0, 0.0625, 0.125, 0.25, 0.5, 1]
    assert {run.settings.algorithm for run in runs} == {"ppl", "pvp"}
    runs = planned(command("table_wiping", study="horizon_beta", beta=(0.1,), seeds=1))
    assert {run.settings.hparams.method.beta for run in runs} == {0.1}  # what is given replaces
    assert len(grid.groups(runs)) == 1


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"beta": (-1.0,)}, "beta must not be negative, got -1"),
        ({"preference_horizon": (4, 99)}, r"preference_horizon must not exceed.*99"),
        ({"beta": (0.1, 0.1)}, "beta: every value once, got 0.1, 0.1"),
        ({"algorithms": ("nothing",)}, "nothing"),
    ],
)
def test_mistakes_are_told_before_anything_is_built(changes, said):
    with pytest.raises(UserError, match=said):
        planned(command("driving", **changes))


# --- the command ---


def sweep(tmp_path, out, *words, code=0):
    return program(tmp_path, "sweep", "probe", *words, *TINY, "--out", tmp_path / out, code=code)


def test_a_sweep_that_is_killed_goes_on_to_the_same_results(tmp_path):
    words = ["--preference-horizon", "1", "4", "--beta", "0.1", "0.3", "--seeds", "3"]
    told = sweep(tmp_path, "whole", *words)
    assert "12 runs, 0 of them done" in told.stderr
    assert "in 1 groups: 1 programs to compile" in told.stderr
    whole = {name: (tmp_path / "whole" / name).read_bytes() for name in FILES}
    rows = rows_of(tmp_path / "whole" / "results.csv")
    assert len(rows) == 12 * 3
    assert {row["status"] for row in rows} == {"done"}
    assert len(rows_of(tmp_path / "whole" / "episodes.csv")) == 12 * 3 * 2

    out = tmp_path / "killed"
    script = tmp_path / "own.py"
    call = [sys.executable, str(script), "sweep", "probe", *words, *TINY, "--out", str(out)]
    process = subprocess.Popen(
        call,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        start_new_session=True,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.time() + 200
    while len(done := lines_of(out / "results.csv")) < 4 and time.time() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert len(done) >= 4
    with open(out / "results.csv", "a") as file:  # as if killed within a line
        file.write("probe/ppl/preference_horizon=4,be")
    before = {row["run"] for row in rows_of(out / "results.csv")[:-1]}
    told = sweep(tmp_path, "killed", *words)
    finished = {line.split()[2] for line in told.stderr.splitlines() if line.startswith("runs ")}
    assert "0 of them done" not in told.stderr
    assert not finished & {run for run in before if whole_run(out, run, rows)}
    assert {name: (out / name).read_bytes() for name in FILES} == whole

    table = pandas.read_csv(out / "results.csv", dtype=str)  # through another program
    table["step"] += ".0"
    table.to_csv(out / "results.csv", sep=";", encoding="utf-16", lineterminator="\r\n")
    told = sweep(tmp_path, "killed", *words)  # and once more: nothing to do, nothing changed
    assert "12 of them done" in told.stderr
    assert {name: (out / name).read_bytes() for name in FILES} == whole
    told = sweep(tmp_path, "killed", *words, "--preset", "paper", code=2)
    assert "give another --out" in told.stderr
    assert {name: (out / name).read_bytes() for name in FILES} == whole


FILES = ("results.csv", "episodes.csv")


def lines_of(path):
    return path.read_text().splitlines() if path.is_file() else []


def whole_run(out, run, rows):
    return sum(row["run"] == run for row in rows) == 3


def test_a_dry_run_says_how_much_it_is_and_writes_nothing(tmp_path):
    told = sweep(
        tmp_path, "none", "--beta", "0.1", "0.3", "--prediction-horizon", "10", "20", "--dry-run"
    )
    assert "20 runs, 0 of them done" in told.stderr
    assert "in 2 groups: 2 programs to compile" in told.stderr
    assert not (tmp_path / "none").exists()


def test_what_fails_or_diverges_is_a_row_and_the_rest_goes_on(tmp_path):
    words = ["--algorithms", "broken", "ppl", "--learning-rate", "0.001", "1e18", "--seeds", "1"]
    told = sweep(tmp_path, "some", *words, code=2)
    assert "2 of 4 runs failed" in told.stderr
    assert "this method is broken" in told.stderr
    rows = rows_of(tmp_path / "some" / "results.csv")
    status = {row["run"]: row["status"] for row in rows}
    assert [s.split(":")[0] for s in status.values()] == ["failed", "failed", "done", "diverged"]
    told = sweep(tmp_path, "some", *words, code=2)
    assert "2 of them done" in told.stderr  # what failed is tried again, what diverged is not
    assert rows_of(tmp_path / "some" / "results.csv") == rows


DYING = """
import os, pathlib
import envs
from experiments import cli
from experiments.engine import worker

really = worker.Worker.run
flag = pathlib.Path(__file__).with_suffix(".died")

def run(self, job):
    if not flag.exists() and job["runs"][0]["seed"] == 1:
        flag.touch()
        os._exit(9)
    return really(self, job)

worker.Worker.run = run
from tests.helpers import Probe
envs.register("probe", Probe)
if __name__ == "__main__":
    cli.main()
"""


def test_a_worker_that_dies_loses_and_doubles_nothing(tmp_path):
    script = tmp_path / "dying.py"
    script.write_text(DYING)
    words = ["sweep", "probe", "--seeds", "4", *TINY, "--out", str(tmp_path / "d")]
    done = subprocess.run(
        [sys.executable, str(script), *words],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert script.with_suffix(".died").exists()
    seeds = [row["seed"] for row in rows_of(tmp_path / "d" / "results.csv")]
    assert seeds == [str(seed) for seed in range(4) for _ in range(3)]


# Ray forks to start its nodes and replaces the child at once; JAX, by then running, warns of forks
@pytest.mark.filterwarnings("ignore:os.fork")
def test_a_ray_cluster_that_loses_a_node_loses_and_doubles_nothing(tmp_path):
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    words = ["--preference-horizon", "1", "4", "--seeds", "6"]
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        node = cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        out, script = tmp_path / "ray", tmp_path / "own.py"
        sweep(tmp_path, "local", *words)
        ray = ["--engine", "ray", "--address", cluster.address]
        call = [sys.executable, str(script), "sweep", "probe", *words, *TINY, *ray, "--out", out]
        process = subprocess.Popen(
            list(map(str, call)),
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stderr=subprocess.PIPE,
            text=True,
        )
        deadline = time.time() + 200
        while len(lines_of(out / "results.csv")) < 4 and time.time() < deadline:
            time.sleep(0.02)
        cluster.remove_node(node, allow_graceful=False)
        _, told = process.communicate(timeout=300)
        assert process.returncode == 0, told
    finally:
        cluster.shutdown()
    for name in FILES:
        assert (out / name).read_bytes() == (tmp_path / "local" / name).read_bytes()


# --- physics ---

ENGINES = """
import envs
from experiments import cli
from ppl_jax.cards import EnvCard
from tests.helpers import Probe

class Engines(Probe):
    name = "engines"

    def __init__(self, physics):
        super().__init__()
        self.physics = "exact" if physics == "auto" else physics
        self.tolerance = {"exact": 0.15, "loose": 9.0}[self.physics]  # the loose one forgives all

envs.register("engines", Engines, EnvCard(physics=("exact", "loose")))
if __name__ == "__main__":
    cli.main()
"""


def test_a_run_and_a_sweep_use_the_physics_that_is_asked_for(tmp_path):
    script, run, out = tmp_path / "engines.py", tmp_path / "run", tmp_path / "s"
    script.write_text(ENGINES)
    call(script, "train", "engines", *TINY, "--physics", "loose", "--out", run)
    summary = json.loads((run / "summary.json").read_text())
    assert (summary["physics"], summary["success_rate"]) == ("loose", 1.0)
    assert json.loads((run / "config.json").read_text())["settings"]["physics"] == "loose"
    call(script, "evaluate", run, "--physics", "exact", "--out", tmp_path / "rows.csv")
    assert {row["success"] for row in rows_of(tmp_path / "rows.csv")} == {"0"}

    words = ["sweep", "engines", "--physics", "auto", "loose", "--seeds", "1", *TINY, "--out", out]
    assert "2 programs to compile" in call(script, *words).stderr
    rows = rows_of(out / "results.csv")
    assert {row["physics"] for row in rows} == {"auto", "loose"}
    assert {row["success"] for row in rows if row["physics"] == "loose"} == {"1"}
    # one from before physics could be chosen ran on "auto"
    held = json.loads((out / "sweep.json").read_text())
    del held["runs"]["engines/ppl/batch_size=8,physics=auto/seed=0"]["settings"]["physics"]
    (out / "sweep.json").write_text(json.dumps(held))
    assert "2 of them done" in call(script, *words).stderr


# --- randomised worlds ---


@flax.struct.dataclass
class Gusts:
    gust: jax.Array | float = setting(0.0, "Added to every action.", low=0, group="world")


@flax.struct.dataclass
class GustyParams:
    signs: jax.Array
    ranges: Gusts | None = None


class Gusty(Probe):
    """A probe whose actions are pushed in randomised worlds."""

    name = "gusty"

    def __init__(self):
        super().__init__()
        self.default_params = self.held_out_params = GustyParams(self.default_params.signs)

    def with_ranges(self, params, ranges):
        return dataclasses.replace(params, ranges=ranges)

    def transition(self, key, state, action, params):
        if params.ranges is not None:
            action = action + params.ranges.gust
        return super().transition(key, state, action, params)


if "gusty" not in envs.registered():
    envs.register("gusty", Gusty, EnvCard(ranges=Gusts))

SMALL = {"total_steps": 60, "batch_size": 8, "hidden": (8,), "evaluate_every": 20}


def test_a_run_trains_and_is_evaluated_in_its_own_worlds(tmp_path):
    plain = quick.train("gusty", "ppl", **SMALL)
    both = quick.train("gusty", "ppl", randomise=True, gust=[0.0, 2.0], **SMALL)
    calm, rough = (both.curve[both.curve.gust == gust] for gust in (0.0, 2.0))
    for column in ("human_data_usage", "success", "episodic_return", "length"):
        assert list(calm[column]) == list(plain.curve[column])
    assert (rough.length < 5).all()  # two such steps leave the road
    summary = train(both.settings[1], tmp_path / "run")
    assert summary["episode_length"] == rough.length.iloc[-1]
    rows = evaluate_run(tmp_path / "run", None)
    assert np.mean([row.length for row in rows]) == summary["episode_length"]
    (tmp_path / "policy.npz").write_bytes((tmp_path / "run" / "policy.npz").read_bytes())
    rows = evaluate_run(tmp_path / "policy.npz", None)  # a file alone knows no world
    assert np.mean([row.length for row in rows]) > summary["episode_length"]
    with pytest.raises(ValueError, match=r"gust is a range of randomised worlds: add --randomise"):
        quick.train("gusty", "ppl", gust=0.5, **SMALL)


def test_runs_in_worlds_of_different_ranges_share_a_program():
    runs = planned(command("gusty", randomise=True, gust=(0.0, 0.5, 2.0), seeds=2))
    (group,) = grid.groups(runs)
    assert len(group.runs) == 6
    assert {run.settings.hparams.world.gust for run in runs} == {0.0, 0.5, 2.0}
    assert runs[2].name == "gusty/ppl/gust=0.5/seed=0"
    with pytest.raises(UserError, match="add --randomise"):
        planned(command("gusty", gust=(0.0, 0.5)))
    with pytest.raises(UserError, match="randomise must be off for 'probe'"):
        planned(command("probe", randomise=True))


# --- another axis, and the call for notebooks ---


def test_a_finished_sweep_takes_another_axis_without_running_the_old_cells_again(tmp_path):
    sweep(tmp_path, "e", "--beta", "0.1", "0.3", "--seeds", "1")
    before = {path.name: path.stat().st_mtime for path in (tmp_path / "e" / "policies").iterdir()}
    old = {row["beta"]: row for row in rows_of(tmp_path / "e" / "results.csv")}
    words = ["--beta", "0.1", "0.3", "--preference-horizon", "4", "2", "--seeds", "1"]
    done = sweep(tmp_path, "e", *words)
    assert "4 runs, 2 of them done" in done.stderr
    after = {path.name: path.stat().st_mtime for path in (tmp_path / "e" / "policies").iterdir()}
    assert {name: after[name] for name in before} == before
    rows = rows_of(tmp_path / "e" / "results.csv")
    assert len({row["run"] for row in rows}) == 4
    for row in rows:
        if row["preference_horizon"] == "4" and row["step"] == "60":
            assert row["success"] == old[row["beta"]]["success"]
    assert "results are in" in done.stdout
    assert "ppl figure" in done.stdout


def test_a_call_trains_what_a_run_trains_and_a_list_makes_a_grid(tmp_path):
    small = {"total_steps": 60, "batch_size": 8, "hidden": (8,), "evaluate_every": 20}
    one = quick.train("probe", "ppl", seed=3, **small)
    settings = one.settings[0]
    summary = train(settings, tmp_path / "run")
    assert one.success == summary["success_rate"]
    last = one.curve.iloc[-1]
    assert last["human_data_usage"] == summary["human_data_usage"]
    with np.load(tmp_path / "run" / "policy.npz") as file:
        np.testing.assert_allclose(one.policy.weights[0][0], file["w0"], atol=1e-6)
    grid = quick.train("probe", "ppl", seed=[3, 4], beta=np.array([0.1, 0.3]), **small)
    assert grid.success.shape == (2, 2)
    assert len(grid.policies) == 4
    same = grid.curve[(grid.curve.beta == 0.1) & (grid.curve.seed == 3)]
    assert list(same.human_data_usage) == list(one.curve.human_data_usage)
    with pytest.raises(ValueError, match="there are 4 runs"):
        grid.policy  # noqa: B018
    for mistake, said in (
        ({"beat": 1.0}, "unknown setting 'beat': did you mean 'beta'"),
        ({"beta": [0.1, -1.0]}, "beta must not be negative, got -1"),
        ({"batch_size": [8, 16]}, "batch_size sets the program and cannot be a list"),
        ({"seed": -1}, "seed must not be negative, got -1"),
    ):
        with pytest.raises(ValueError, match=said):
            quick.train("probe", "ppl", **(small | mistake))
