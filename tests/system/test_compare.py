"""Host loop and comparisons, on the probe world: phases, resume, failures, tables."""

import csv
import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest

import envs
from experiments.engine.run import RunSettings, record_of, train
from experiments.engine.settings import ADDED
from experiments.report import paper, tables
from experiments.report.points import read_points
from experiments.studies.ablation import LIBRARY, ROWS
from experiments.studies.tune import choose, finalists, points
from ppl_jax import algorithms, checkpoint
from ppl_jax.training import make_train
from tests.helpers import ROOT, Probe, call, outcome, probe_settings, program

if "probe" not in envs.registered():
    envs.register("probe", Probe)


def run_settings(name):
    changes = {"total_steps": 60, "rollout_steps": 20, "batch_size": 8, "human_capacity": 60}
    phased = name in ("bc", "gail", "thrifty_dagger")
    changes |= {"demonstrations": 20, "offline_updates": 20} if phased else {}
    if name == "bc":
        changes["total_steps"] = 20
    config, hparams = probe_settings(name, **changes)
    return RunSettings("probe", name, 0, config, hparams, evaluate_every=20)


@pytest.mark.parametrize("name", ["bc", "gail", "thrifty_dagger", "haco"])
def test_a_run_stopped_in_any_phase_goes_on_bit_for_bit(name, tmp_path, monkeypatch):
    settings = run_settings(name)
    summary = train(settings, tmp_path / "whole")
    whole = outcome(tmp_path / "whole")
    saves = len(whole["metrics"])
    assert saves == {"bc": 2, "gail": 4, "thrifty_dagger": 4, "haco": 3}[name]
    steps = [row["step"] for row in whole["metrics"]]
    assert steps == {"bc": [20, 20], "haco": [20, 40, 60]}.get(name, [20, 20, 40, 60])
    # demonstrations alone are not evaluated; what they taught is
    rows = list(csv.DictReader(whole["evaluation"].splitlines()))
    assert sorted({int(row["step"]) for row in rows}) == sorted(set(steps))
    assert len(rows) == 2 * len(set(steps))  # every held-out scenario once
    assert summary["human_data_usage"] >= settings.config.demonstrations
    really = checkpoint.save
    for stop in range(1, saves + 1):
        made = []

        def save(*args, made=made, stop=stop):
            if len(made) + 1 == stop:  # killed after logging, before this checkpoint is there
                raise KeyboardInterrupt
            made.append(really(*args))

        out = tmp_path / f"stopped-{stop}"
        monkeypatch.setattr(checkpoint, "save", save)
        with pytest.raises(KeyboardInterrupt):
            train(settings, out)
        monkeypatch.setattr(checkpoint, "save", really)
        train(settings, out, resume=True)
        assert outcome(out) == whole


SMALL = ["--seeds", "2", "--total-steps", "40", "--evaluate-every", "20", "--batch-size", "8"]


def test_one_broken_method_does_not_stop_the_rest_and_the_comparison_resumes(tmp_path):
    out = tmp_path / "c"
    words = ["compare", "probe", "--algorithms", "hg_dagger", "broken", "pvp", *SMALL, "--out", out]
    done = program(tmp_path, *words, code=2)
    assert "probe/broken/-/seed=0" in done.stderr
    assert "this method is broken" in done.stderr
    assert "2 of 6 runs failed" in done.stderr
    assert "6/6" in done.stderr  # progress
    assert "hg_dagger" in done.stdout
    assert "pvp" in done.stdout
    with open(out / "results.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    failed = [row for row in rows if row["status"].startswith("failed")]
    assert {row["algorithm"] for row in failed} == {"broken"}
    rows = [row for row in rows if row["status"] == "done"]
    assert len(rows) == 2 * 2 * 2  # methods x seeds x evaluations
    with open(out / "episodes.csv", newline="") as file:
        episodes = list(csv.DictReader(file))
    assert len(episodes) == 2 * 2 * 2 * 2  # methods x seeds x evaluations x scenarios
    for row in rows:
        keys = ("run", "step", "human_data_usage")
        mine = [e for e in episodes if all(e[key] == row[key] for key in keys)]
        assert float(row["success"]) == np.mean([float(e["success"]) for e in mine])
        if row["algorithm"] == "pvp":
            assert row["discount"] == "0.9"  # every hyper-parameter is a column
    before = {path: path.stat().st_mtime for path in (out / "policies").iterdir()}
    assert len(before) == 4
    again = program(tmp_path, *words, code=2)
    assert {path: path.stat().st_mtime for path in (out / "policies").iterdir()} == before
    assert again.stdout == done.stdout
    other = program(tmp_path, *words[:-2], "--gate", "deviates_from_expert", "--out", out, code=2)
    assert (
        "with gate 'unsafe_or_slow', asked for 'deviates_from_expert': give another --out"
        in other.stderr
    )
    (out / "sweep.json").unlink()
    unknown = program(tmp_path, *words, code=2)
    assert "holds something else: give another --out" in unknown.stderr


@pytest.mark.slow
def test_every_row_of_the_ablation_runs(tmp_path):
    out = tmp_path / "a"
    words = ["ablation", "probe", *SMALL, "--reference-steps", "40", "--out", out]
    done = program(tmp_path, *words)
    for label in (ROWS | LIBRARY).keys() - {"rule-based f"}:
        assert label in done.stdout
    assert "from another simulator" in done.stdout


def test_the_paper_s_figures_stand_beside_ours_and_are_marked(tmp_path, capsys):
    columns = ["algorithm", "seed", "total_steps", "training_cost", "scenario", "success"]
    columns += ["progress", "episodic_return", "episodic_cost", "length", "human_data_usage"]
    rows = []
    for algorithm, total, good in (("ppl", 100, 1), ("bc", 50, 0), ("focused", 100, 1)):
        for seed in range(2):
            for scenario in range(3):
                values = [algorithm, seed, total, 3, scenario, good, 0.5, 7, 1, 9, 30]
                rows.append(dict(zip(columns, values, strict=True)))
    tables.write_rows(tmp_path / "episodes.csv", rows)
    tables.print_comparison(tmp_path / "episodes.csv", paper.METHODS["driving"])
    ppl, bc, own = capsys.readouterr().out.splitlines()[2:5]
    assert "30 (0.30)" in ppl
    assert "0.80±0.04, 329.9±13.4, 0.92±0.03" in ppl
    assert "30 (0.60)" in bc
    assert "0.12±0.04" in bc
    assert own.rstrip().endswith("-")


def test_all_methods_have_a_grid_of_the_same_size_and_the_paper_s_row():
    names = algorithms.registered(variants=False)
    assert len(names) == 10
    assert (
        {name for name in algorithms.registered() if algorithms.method(name).grid}
        == set(names)
        == set(paper.METHODS["driving"])
    )
    assert {len(points(name)) for name in names} == {4}
    assert set(ROWS) == set(paper.ABLATION)
    assert len(ROWS) == 10


BEFORE_SCHEMA_5 = {  # what a learner held, in this order
    "hparams": ("learning_rate", "expert_noise", "prediction_noise", "method", "gate", "predictor",
                "world"),
    "gate": ("min_speed",),
    "counters": ("steps", "human_data", "takeovers", "episodes", "successes", "cost",
                 "physics_diverged"),
    "learner": ("algorithm", "env_state", "takeover", "key", "hparams", "counters", "diverged"),
}  # fmt: skip


def test_a_run_of_before_schema_5_is_continued(tmp_path, capsys):
    settings = run_settings("haco")
    narrow = settings.hparams.replace(laplace_scale=0.1, laplace_core=0.1)  # as it was
    settings = dataclasses.replace(settings, hparams=narrow)
    train(settings, tmp_path / "now")
    whole = outcome(tmp_path / "now")
    out = tmp_path / "old"
    shutil.copytree(tmp_path / "now", out)
    (out / "summary.json").unlink()
    shutil.rmtree(out / "checkpoints" / "step_60")
    config = json.loads((out / "config.json").read_text())
    kept = {name: value for name, value in config["settings"].items() if name not in ADDED}
    kept |= {"physics": "auto", "randomise": False}  # these were there
    (out / "config.json").write_text(json.dumps(config | {"schema": 4, "settings": kept}))
    make = algorithms.method("haco").make
    functions = make_train(Probe(), Probe.scripted_expert, make, settings.config)
    like = jax.jit(functions.init)(jax.random.key(0), settings.hparams)
    done, learner = checkpoint.restore(out / "checkpoints", like, print)
    assert done == 40

    def only(part, what):
        return record_of({name: getattr(part, name) for name in BEFORE_SCHEMA_5[what]})

    hparams = learner.hparams.replace(gate=only(learner.hparams.gate, "gate"))
    old = learner.replace(
        hparams=only(hparams, "hparams"), counters=only(learner.counters, "counters")
    )
    checkpoint.save(out / "checkpoints", done, only(old, "learner"))
    train(RunSettings.from_json(json.loads((out / "config.json").read_text())), out, resume=True)
    assert "damaged" not in capsys.readouterr().err
    assert outcome(out) == whole


def test_a_search_keeps_the_published_setting_unless_it_is_clearly_beaten():
    published, close, best = {"beta": 0.1}, {"beta": 0.2}, {"beta": 0.3}
    tried = [(published, [0.2, 0.3]), (close, [0.5, 0.7]), (best, [0.7, 0.8])]
    assert finalists(tried) == [published, best]
    assert finalists(tried[:1]) == [published]
    scores = [0.6, 0.7, 0.65, 0.75]  # standard error of the mean 0.032
    higher = [x + 0.08 for x in scores]  # by 1.8 standard errors of the difference, then by 2.2
    assert choose([(published, scores), (best, higher)]) == published
    assert choose([(published, scores), (best, [x + 0.1 for x in scores])]) == best
    assert choose([(published, scores)]) == published


def test_a_search_has_two_rounds_of_fresh_seeds_and_resumes(tmp_path):
    out = tmp_path / "tune"
    words = ["tune", "probe", "--algorithms", "hg_dagger", "--seeds", "0", "1"]
    words += ["--final-seeds", "2", "3", "--total-steps", "200", "--batch-size", "8", "--out", out]
    program(tmp_path, *words)
    rows = list(csv.DictReader((out / "tuning.csv").read_text().splitlines()))
    assert [row["round"] for row in rows] == ["1"] * 4 + ["2"] * 2
    assert [row["seeds"] for row in rows] == ["2"] * 6
    assert rows[4]["setting"] == rows[0]["setting"]  # the published one is always in the final
    assert sorted(row["chosen"] for row in rows[4:]) == ["False", "True"]
    played = list(csv.DictReader((out / "results.csv").read_text().splitlines()))
    assert len(played) == (4 * 2 + 2 * 2) * 5
    for row in rows:
        fields = [part.split(" ") for part in row["setting"].split(", ")]
        name = ",".join("=".join(field) for field in fields)
        seeds = ("0", "1") if row["round"] == "1" else ("2", "3")
        mine = [float(p["success"]) for p in played if name in p["run"] and p["seed"] in seeds
                and int(p["step"]) >= 120]  # fmt: skip
        assert float(row["success"]) == pytest.approx(np.mean(mine), abs=1e-4)
    (out / "tuning.csv").unlink()
    told = program(tmp_path, *words).stderr
    assert "12 of them done" in told
    assert list(csv.DictReader((out / "tuning.csv").read_text().splitlines())) == rows
    done = program(tmp_path, *words, "--final-seeds", "1", "2", code=2)
    assert "final_seeds must be fresh, got 1 of seeds again" in done.stderr


def test_a_method_is_registered_once_and_with_known_fields():
    with pytest.raises(ValueError, match="'ppl' is registered already"):
        algorithms.register("ppl", algorithms.method("ppl").make)
    with pytest.raises(ValueError, match="changes unknown fields: learning_speed"):
        algorithms.register("x", algorithms.method("ppl").make, {"learning_speed": 1.0})
    with pytest.raises(ValueError, match="unknown algorithm 'magic': choose one of ppl, bc"):
        algorithms.method("magic")


def test_the_example_of_an_own_method_runs_from_outside(tmp_path):
    example = ROOT / "experiments" / "examples" / "own_method.py"
    assert len(example.read_text().splitlines()) <= 80
    script = tmp_path / "own_method.py"
    script.write_text(
        example.read_text().replace(
            'if __name__ == "__main__":',
            "import envs\nfrom tests.helpers import Probe\nenvs.register('probe', Probe)\n"
            'if __name__ == "__main__":',
        )
    )
    words = ["compare", "probe", "--algorithms", "ppl", "focused", "--seeds", "1"]
    words += ["--total-steps", "400", "--batch-size", "32", "--out", tmp_path / "c"]
    call(script, *words)
    found = {point.algorithm: point for point in read_points(tmp_path / "c")}
    assert found["focused"].interval("success").mean > 0.4
