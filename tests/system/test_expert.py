"""Training experts from the host: run folder, resume, policy files, and the shipped experts."""

import csv
import dataclasses
import json
import shutil

import jax
import numpy as np
import pytest

import envs
from envs import pretrained
from experiments.cli import main, parse
from experiments.engine import expert, expert_settings
from experiments.engine.evaluate import make_env, named_expert, named_policy, summarise_episodes
from experiments.engine.expert_settings import ExpertSettings, read_settings, settings_for
from experiments.engine.policy_file import load_policy, save_policy
from experiments.engine.run import record_of
from experiments.engine.run_folder import RunFolder
from experiments.engine.runtime import UserError
from experiments.options.expert import command_of, new_settings
from experiments.report import card, figures
from ppl_jax import cards, checkpoint
from ppl_jax.cards import EnvCard, ExpertCard
from ppl_jax.experts import SavedPolicy
from ppl_jax.ppo.config import OLD_NAMES, PPOConfig, PPOHParams, catalogue, read
from ppl_jax.ppo.loop import make_ppo_lagrangian
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
    assert command_of(read_settings(RunFolder(run))).startswith(
        "ppl expert train probe --total-steps 1024 --num-envs 8"
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


def test_a_card_replaces_nothing(run, tmp_path, capsys):
    shipped = pretrained.policy_path("driving").parent
    main(["expert", "card", str(run), "--out", str(tmp_path)])
    before = (tmp_path / "probe.json").read_bytes()
    for words, message in (
        (["--out", str(tmp_path)], "exists: give another --out"),
        (["--out", str(shipped), "--force"], "holds the shipped experts"),
    ):
        with pytest.raises(SystemExit) as error:
            main(["expert", "card", str(run), *words])
        assert error.value.code == 2
        assert message in capsys.readouterr().err
    assert (tmp_path / "probe.json").read_bytes() == before
    assert not (shipped / "probe.json").exists()
    main(["expert", "card", str(run), "--out", str(tmp_path), "--force"])


def test_settings_of_shipped_cards_are_read_under_their_old_names():
    for name in SHIPPED:
        told = json.loads(pretrained.policy_path(name).with_suffix(".json").read_text())
        assert read(told["config"] | told["hparams"]) == settings_for(name)[:2]
    with pytest.raises(ValueError, match="unknown settings of PPO-Lagrangian: speed"):
        read({"speed": 1})


def test_a_run_that_was_stopped_goes_on_as_if_never(run, tmp_path, monkeypatch, capsys):
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
    assert f"continue with: ppl expert train --resume --out {out}\n" in capsys.readouterr().err
    assert not (out / "summary.json").exists()
    main(["expert", "train", "--resume", "--out", str(out)])  # its settings are in the folder
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
        (["train", "probe", "--seed", "4294967296"], "seed must be at most 4294967295"),
        (["train", "probe", "--clip", "inf"], "clip must be positive, got inf"),
        (["train"], "env: name the environment, one of driving"),
        (["train", "--out", "driving", "probe"], "env: name 'probe' before the options"),
        (["train", "probe", "--resume"], "--resume needs --out"),
        (["train", "--resume", "--out", "no/run"], "'no/run' is not a run folder"),
        *(
            (["train", "probe", f"--{old.replace('_', '-')}", "1"], f"{old} is called {new} now")
            for old, new in OLD_NAMES.items()
        ),
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


def of_schema_1(run, out):
    """A copy of a run folder as versions before config.json had a schema wrote it."""
    shutil.copytree(run, out)
    (out / "summary.json").unlink()
    content = json.loads((out / "config.json").read_text())
    old_names = {new: old for old, new in OLD_NAMES.items()}
    parts = {"config": {}, "hparams": {}}
    for name, one in catalogue(PPOConfig(), PPOHParams()).items():
        part = parts["hparams" if one.traced else "config"]
        part[old_names.get(name, name)] = content["settings"][name]
    content = {k: v for k, v in content.items() if k not in ("schema", "settings")} | parts
    (out / "config.json").write_text(json.dumps(content))
    return list(parts["hparams"])


def test_a_run_of_an_earlier_version_is_read_and_continued(run, tmp_path, monkeypatch, capsys):
    out = tmp_path / "old"
    names = of_schema_1(run, out)
    assert read_settings(RunFolder(out)) == read_settings(RunFolder(run))
    shutil.rmtree(out / "checkpoints" / "step_1024")
    env, settings = make_env("probe", {}), read_settings(RunFolder(out))
    functions = make_ppo_lagrangian(env, settings.config, expert=env.experts["scripted"])
    like = jax.jit(functions.init)(jax.random.key(0), settings.hparams)
    found = checkpoint.restore(out / "checkpoints", like, print)
    assert found is not None
    done, learner = found
    held = record_of(dict(zip(names, jax.tree.leaves(learner.hparams), strict=True)))
    checkpoint.save(out / "checkpoints", done, dataclasses.replace(learner, hparams=held))
    main(["expert", "train", "--resume", "--out", str(out)])
    assert "damaged" not in capsys.readouterr().err
    assert outcome(out) == outcome(run)
    with pytest.raises(SystemExit):
        main(["expert", "train", "--resume", "--out", str(out), "--gae-lambda", "0.5"])
    assert "its gae_lambda is 0.95, asked for 0.5" in capsys.readouterr().err


def test_a_record_keeps_the_order_of_its_fields():
    leaves = jax.tree.leaves(record_of({"rate": np.zeros(1), "clip": np.ones(1)}))
    assert [float(leaf[0]) for leaf in leaves] == [0.0, 1.0]


# --- the command line ---


def words_of(settings):
    return command_of(settings).split()[1:]


def test_every_setting_has_its_option():
    changed = ExpertSettings(
        env="driving",
        seed=3,
        config=PPOConfig(
            total_steps=1000,
            num_envs=4,
            rollout_steps=8,
            epochs=2,
            num_minibatches=2,
            hidden=(64, 64),
            scaling="world",
            demonstrations=7,
            demonstration_stride=2,
            demonstration_rounds=3,
            cloning="gaussian",
            cloning_updates=9,
            guided=False,
            critic_batches=4,
        ),
        hparams=PPOHParams(
            **{field.name: 0.375 for field in dataclasses.fields(PPOHParams)},
        ),
        training_scenarios=5,
        held_out_scenarios="a/folder",
        evaluate_every=6,
    )
    words = words_of(changed)
    for name in catalogue(changed.config, changed.hparams):
        option = name.replace("_", "-")
        assert f"--{option}" in words or f"--no-{option}" in words
    assert parse(words).settings == changed


@pytest.mark.parametrize("name", [*SHIPPED, "probe"])
def test_a_run_has_the_settings_of_its_environments_card(name):
    asked = parse(["expert", "train", name]).settings
    config, hparams, scenarios = settings_for(name)
    assert asked == new_settings(name)
    assert (asked.config, asked.hparams, asked.training_scenarios) == (config, hparams, scenarios)
    assert command_of(asked) == f"ppl expert train {name}"
    told = cards.card(name).expert
    for field, value in {**told.config, **told.hparams}.items():
        assert catalogue(config, hparams)[field].value == value


def test_defaults_that_depend_on_what_is_given():
    asked = parse(["expert", "train", "driving", "--scenarios", "a", "--total-steps", "5000000"])
    assert asked.settings.training_scenarios == 0
    assert asked.settings.evaluate_every == 306 // 40
    assert words_of(asked.settings)[2:] == words_of(parse(words_of(asked.settings)).settings)[2:]
    asked = parse(["expert", "train", "driving", "--total-steps", "5000000", "--evaluate-every=1"])
    assert asked.settings.evaluate_every == 1


def test_a_card_that_names_no_setting_is_refused(monkeypatch):
    wrong = EnvCard(expert=ExpertCard(hparams={"cost_limits": 1.0}))
    monkeypatch.setattr(expert_settings, "card", lambda name: wrong)
    with pytest.raises(UserError, match=r"the card of probe: unknown settings .*: cost_limits"):
        settings_for("probe")


def help_of(capsys, *words):
    with pytest.raises(SystemExit) as error:
        main(["expert", "train", *words])
    assert error.value.code == 0
    return capsys.readouterr().out


def test_help_shows_what_a_run_would_use(capsys, run):
    common = help_of(capsys, "driving", "--help")
    assert len(common.splitlines()) <= 85
    for shown in ("288 288 288", "(default: 14400000)", "(default: 8000)", "(default: True)"):
        assert shown in common
    assert "command." not in common
    assert "--demonstration-rounds" not in common
    everything = help_of(capsys, "driving", "--help-all")
    for name in catalogue(PPOConfig(), PPOHParams()):
        assert f"--{name.replace('_', '-')}" in everything
    assert "(default: 24)" in everything
    assert "(default: 10000000)" in help_of(capsys, "table_wiping", "--help")
    assert "(default: 1024)" in help_of(capsys, "--resume", "--out", str(run), "--help")


def test_a_wrong_option_names_the_nearest(capsys):
    with pytest.raises(SystemExit) as error:
        main(["expert", "train", "probe", "--cliip", "0.1"])
    assert error.value.code == 2
    told = capsys.readouterr()
    assert "--clip" in told.out + told.err


def test_other_settings_are_refused_one_by_one(run, capsys):
    settings = read_settings(RunFolder(run))
    other = dataclasses.replace(settings, hparams=PPOHParams(clip=0.3))
    with pytest.raises(UserError, match=r"its clip is 0\.2, asked for 0\.3$"):
        expert.train_expert(other, run, True)
    for words, message in (
        (
            ["--hidden", "4", "4", "--clip", "0.3"],
            ": its clip is 0.2, asked for 0.3; its hidden is (8,), asked for (4, 4)\n",
        ),
        (["driving"], ": its env is 'probe', asked for 'driving'\n"),
        (["--evaluate-every", "2"], ": its evaluate_every is 1, asked for 2\n"),
    ):
        with pytest.raises(SystemExit) as error:
            main(["expert", "train", "--resume", "--out", str(run), *words])
        assert error.value.code == 2
        assert message in capsys.readouterr().err


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
    env = make_env(name, {})
    episodes = expert.evaluate_expert(env, "neural")
    scores = summarise_episodes(episodes)
    told = json.loads(pretrained.policy_path(name).with_suffix(".json").read_text())["held_out"]
    assert scores["success_rate"] == pytest.approx(told["success_rate"], abs=0.021)  # one episode
    assert scores["success_rate"] >= least
    # that one episode may be a car stuck at a barrier, a cost of one in each of its last steps
    others = np.sort([row.episodic_cost for row in episodes])[:-1]
    assert others.mean() <= cost
    assert named_policy("neural", env).log_std.shape == (env.spec.action_size,)
    assert callable(named_expert("neural", env))
