"""Training experts from the host: run folder, resume, policy files, and the shipped experts."""

import csv
import dataclasses
import json

import numpy as np
import pytest

import envs
from envs import pretrained
from experiments.cli import ExpertTrain, main
from experiments.engine import expert
from experiments.engine.evaluate import make_world, named_expert, named_policy, summarise_episodes
from experiments.engine.policy_file import load_policy, save_policy
from experiments.engine.runtime import UserError
from experiments.report import card, figures
from ppl_jax.experts import SavedPolicy
from ppl_jax.ppo.config import PPOConfig, PPOHParams
from tests.helpers import Probe, outcome

if "probe" not in envs.registered():
    envs.register("probe", Probe)
WORDS = [
    "--total-steps",
    "1024",
    "--num-envs",
    "8",
    "--rollout-steps",
    "32",
    "--num-minibatches",
    "2",
]
WORDS += ["--hidden", "8", "--demonstrations", "64", "--cloning-updates", "20"]
SHIPPED = ("driving", "table_wiping", "nut_assembly")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("experts") / "a"
    main(["expert", "train", "probe", *WORDS, "--out", str(out)])
    return out


def test_a_run_leaves_what_is_needed_to_go_on_and_to_make_it_again(run, capsys):
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [0, 256, 512, 768, 1024]
    for name in ("episodic_return", "episodic_cost", "multiplier", "success_rate", "divergence"):
        assert all(f"train/{name}" in row for row in rows[1:])
    assert "eval/success_rate" in rows[-1]
    config = json.loads((run / "config.json").read_text())
    assert card.command_of(config).startswith(
        "ppl expert train probe --total-steps 1024 --worlds 8"
    )
    summary = json.loads((run / "summary.json").read_text())
    assert summary["total_steps"] == 1024
    assert summary["steps_per_s"] > 0
    main(["evaluate", str(run)])
    main(["expert", "evaluate", "probe", "--kind", str(run)])
    main(["expert", "evaluate", "probe", "--kind", str(run / "policy.npz")])
    assert capsys.readouterr().out.count("2 scenarios, each once") == 3


def test_a_card_and_a_curve(run, tmp_path):
    main(["expert", "card", str(run), "--out", str(tmp_path)])
    made = json.loads((tmp_path / "probe.json").read_text())
    assert made["command"].startswith("ppl expert train probe")
    assert made["held_out"]["episodes"] == 2
    rows = card.read_curve(tmp_path / "probe.csv")
    assert [row["step"] for row in rows] == [0, 256, 512, 768, 1024]
    assert "train_multiplier" not in rows[0]
    assert rows[-1]["held_out_success_rate"] == made["held_out"]["success_rate"]
    assert (tmp_path / "probe.npz").read_bytes() == (run / "policy.npz").read_bytes()
    figures.expert_curves(tmp_path, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 5000


def test_a_run_that_was_stopped_goes_on_as_if_never(run, tmp_path, monkeypatch):
    out = tmp_path / "stopped"
    save, calls = expert._Run._save, []

    def save_and_stop(self, learner, step):
        save(self, learner, step)
        calls.append(step)
        if len(calls) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(expert._Run, "_save", save_and_stop)
    with pytest.raises(SystemExit):
        main(["expert", "train", "probe", *WORDS, "--out", str(out)])
    assert not (out / "summary.json").exists()
    main(["expert", "train", "probe", *WORDS, "--out", str(out), "--resume"])
    assert calls == [256, 512, 768, 1024]
    assert outcome(out) == outcome(run)
    main(["expert", "train", "probe", *WORDS, "--out", str(out), "--resume"])  # complete already
    assert outcome(out) == outcome(run)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train", "flying"], "unknown environment 'flying': choose one of driving"),
        (["train", "brax:tightrope"], "unknown brax environment 'tightrope'"),
        (["train", "probe", "--seed", "-1"], "seed must be at least 0, got -1"),
        (["train", "probe", "--num-envs", "0"], "num_envs must be at least 1, got 0"),
        (
            ["train", "probe", "--num-minibatches", "7"],
            "num_minibatches must divide num_envs x rollout",
        ),
        (["train", "probe", "--cost-limit", "-1"], "cost_limit must be a number of 0 or more"),
        (["train", "probe", "--evaluate-every", "0"], "evaluate_every must be at least 1, got 0"),
        (["train", "probe", "--resume"], "--resume needs --out"),
        (["train", "driving", "--scenarios", "no/folder"], "'no/folder' does not exist"),
        (["evaluate", "probe"], "no neural expert is shipped for 'probe'"),
        (["evaluate", "probe", "--kind", "no.npz"], "policy file 'no.npz' cannot be read"),
        (["card", "no/run"], "'no/run' is not a run folder"),
    ],
)
def test_a_mistake_is_one_clear_line(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as error:
        main(["expert", *words])
    assert error.value.code == 2
    told = capsys.readouterr().err.strip()
    assert message in told
    assert len(told.splitlines()) == 1


def test_every_setting_has_its_option():
    options = {field.name for field in dataclasses.fields(ExpertTrain)}
    for record in (PPOConfig, PPOHParams):
        assert {field.name for field in dataclasses.fields(record)} <= options


def test_other_settings_are_refused(run):
    with pytest.raises(UserError, match="its hparams is"):
        expert.train_expert(
            expert.ExpertSettings("probe", 0, *_settings(run)[:1], PPOHParams(clip=0.3)), run, True
        )


def _settings(run):
    config = json.loads((run / "config.json").read_text())["config"]
    return PPOConfig(**(config | {"hidden": tuple(config["hidden"])})), PPOHParams()


# --- policy files ---


@pytest.fixture
def files(tmp_path):
    rng = np.random.default_rng(0)
    weights = [(rng.normal(size=(3, 4)), np.zeros(4)), (rng.normal(size=(4, 2)), np.zeros(2))]
    policy = SavedPolicy(weights, "relu", "tanh", np.zeros(3), np.ones(3), np.array([-1.0, 0.5]))
    path = tmp_path / "policy.npz"
    save_policy(path, policy, {"env": "probe"})
    with np.load(path) as archive:
        return path, dict(archive)


def test_a_policy_keeps_its_standard_deviation(files):
    path, _ = files
    np.testing.assert_allclose(load_policy(path, 3, 2).log_std, [-1.0, 0.5])


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"version": np.array(2)}, "has version 2; this program reads up to 1"),
        ({"log_std": np.array([0.0, np.inf])}, "log_std holds a NaN or infinite number"),
        ({"log_std": np.zeros(3)}, "log_std has shape \\(3,\\), expected \\(2,\\)"),
        ({"obs_mean": np.zeros(4)}, "obs_mean has shape \\(4,\\), expected \\(3,\\)"),
        ({"obs_scale": np.zeros(3)}, "obs_scale must be positive"),
        ({"b0": np.zeros(5)}, "w0 \\(3, 4\\) and b0 \\(5,\\) do not fit"),
        ({"w1": np.zeros((5, 2))}, "w1 \\(5, 2\\) and b1 \\(2,\\) do not fit"),
        ({"w0": np.array([["a"]])}, "do not fit"),
        ({"b1": np.array(["a", "b"])}, "b1 holds <U1, expected real numbers"),
        ({"w0": np.array([[object()]])}, "cannot be read"),
        ({"activation": np.array("sigmoid")}, "activation must be relu or tanh"),
    ],
)
def test_a_policy_that_cannot_be_right_is_refused(files, tmp_path, change, line):
    _, arrays = files
    np.savez(tmp_path / "bad.npz", allow_pickle=True, **(arrays | change))
    with pytest.raises(ValueError, match=line):
        load_policy(tmp_path / "bad.npz", 3, 2)


def test_a_torn_policy_file_is_refused(files, tmp_path):
    path, _ = files
    for size in (0, 10, path.stat().st_size // 2):
        (tmp_path / "torn.npz").write_bytes(path.read_bytes()[:size])
        with pytest.raises(ValueError, match="cannot be read"):
            load_policy(tmp_path / "torn.npz", 3, 2)


# --- the shipped experts ---


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_expert_is_small_and_has_its_card(name):
    path = pretrained.policy_path(name)
    assert path.stat().st_size < 1_000_000
    told = json.loads(path.with_suffix(".json").read_text())
    assert told["command"].startswith(f"ppl expert train {name}")
    assert {"date", "seed", "steps", "held_out", "device", "versions"} <= set(told)
    with open(path.with_suffix(".csv"), newline="") as file:
        last = list(csv.DictReader(file))[-1]
    assert int(last["step"]) == told["steps"]
    assert float(last["held_out_success_rate"]) == pytest.approx(told["held_out"]["success_rate"])


@pytest.mark.parametrize(
    ("name", "least", "cost"),
    [
        ("driving", 0.9, 1.0),
        ("table_wiping", 0.9, 1.0),
        pytest.param("nut_assembly", 0.6, 1.0, marks=pytest.mark.slow),
    ],
)
def test_a_shipped_expert_does_what_its_card_says(name, least, cost):
    env = make_world(name, {})
    scores = summarise_episodes(expert.evaluate_expert(env, "neural"))
    told = json.loads(pretrained.policy_path(name).with_suffix(".json").read_text())["held_out"]
    assert scores["success_rate"] == pytest.approx(told["success_rate"], abs=0.021)  # one episode
    assert scores["success_rate"] >= least
    assert scores["episodic_cost"] <= cost
    assert named_policy("neural", env).log_std.shape == (env.spec.action_size,)
    assert callable(named_expert("neural", env))
