"""Files of others: what can be taken is taken, the rest is one line and exit code 2."""

import io
import json
import re

import numpy as np
import pytest

import envs
from experiments.cli import main
from experiments.engine import recording
from experiments.engine.config_file import read_config
from experiments.engine.evaluate import read_evaluation
from experiments.engine.expert_settings import ExpertSettings, settings_for
from experiments.engine.policy_file import load_policy
from experiments.engine.runtime import UserError
from experiments.engine.settings import RunSettings, run_settings
from experiments.report import points
from experiments.ui.play import read_questions, resumed
from tests.helpers import ROOT, Probe


@pytest.fixture(autouse=True, scope="module")
def probe():
    if not envs.known("probe"):
        envs.register("probe", Probe)


def refused(capsys, *words):
    """The line that a command says before it stops with exit code 2."""
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    told = capsys.readouterr().err.strip().splitlines()
    assert stop.value.code == 2, told
    assert len(told) == 1, told
    assert told[0].startswith("error: ")
    return told[0].removeprefix("error: ")


# config.json


def run_folder(path, content):
    """A run folder of which the config alone matters."""
    path.mkdir(exist_ok=True)
    text = content if isinstance(content, str) else json.dumps(content)
    (path / "config.json").write_text(text)
    (path / "policy.npz").touch()
    return path


def config(settings=None, **changes):
    """The config.json of a run in driving, with fields changed, or left out where None."""
    content = run_settings("driving").as_json()
    content["settings"] |= settings or {}
    content |= changes
    content["settings"] = {k: v for k, v in content["settings"].items() if v is not None}
    return {k: v for k, v in content.items() if v is not None or k not in changes}


OBJECT = "'{}/config.json' must hold an object, got "


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("[]", OBJECT + "[]"),
        ("3", OBJECT + "3"),
        ("null", OBJECT + "None"),
        ("{}", "'{}/config.json' lacks 'env'"),
        ("", "'{}' is not a run folder: it has no readable config.json"),
        (config(env=5), "'{}/config.json': env must be text, got 5"),
        (config(seed="x"), "'{}/config.json': seed must be a whole number, got 'x'"),
        (config(seed=True), "'{}/config.json': seed must be a whole number, got True"),
        (config(scenarios=7), "'{}/config.json': scenarios must be text or null, got 7"),
        (config(settings=None) | {"settings": [1]}, "'{}/config.json': settings must be an object"),
        (config({"physics": 3}), "'{}/config.json': physics must be text, got 3"),
    ],
)
@pytest.mark.parametrize("command", [["evaluate"], ["export"], ["train", "--resume", "--out"]])
def test_a_broken_config_is_told_with_its_field(content, said, command, tmp_path, capsys):
    run = run_folder(tmp_path / "run", content)
    assert refused(capsys, *command, run).startswith(said.format(run))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"beta": "x"}, "beta must be a number, got 'x'"),
        ({"batch_size": 3.5}, "batch_size must be a whole number, got 3.5"),
        ({"adaptive_horizon": "no"}, "adaptive_horizon must be true or false, got 'no'"),
        ({"hidden": ["a"]}, "hidden must be a list, each of it a whole number, got"),
        ({"objective": "cop"}, "objective must be one of cpo, dpo"),
        ({"gate": 4}, "gate must be text, got 4"),
        ({"betta": 1}, "unknown setting 'betta': did you mean 'beta'?"),
        ({"total_steps": {}}, "total_steps must be a whole number, got {}"),
    ],
)
def test_a_setting_of_another_kind_is_told_on_resuming(settings, said, tmp_path, capsys):
    run = run_folder(tmp_path / "run", config(settings))
    told = refused(capsys, "train", "--resume", "--out", run)
    assert told.startswith(f"'{run}/config.json': {said}")


def test_what_a_config_lacks_and_has_a_default_is_that():
    held = RunSettings.from_json(config(scenarios=None, expert=None, evaluate_every=None))
    assert held == run_settings("driving")
    assert RunSettings.from_json(config({"objective_target": None})) == run_settings("driving")
    whole = config({"batch_size": 128.0, "randomise": 0}, seed=0.0)
    assert RunSettings.from_json(whole) == run_settings("driving")


def test_resuming_names_the_differing_field_alone(tmp_path, capsys):
    run = run_folder(tmp_path / "run", config({"objective_target": None}))
    assert refused(capsys, "train", "--resume", "--out", run) == (
        f"cannot resume '{run}': its config.json lacks objective_target, asked for 'pair'"
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"seed": None}, "lacks 'seed'"),
        ({"settings": None}, "lacks 'settings'"),
        ({"physics": 1}, ": physics must be text, got 1"),
        ({"settings": {"num_envs": "many"}}, ": num_envs must be a whole number, got 'many'"),
        ({"settings": {"nun_envs": 3}}, ": unknown settings of PPO-Lagrangian: nun_envs"),
    ],
)
def test_the_config_of_an_expert_likewise(change, said, tmp_path, capsys):
    static, traced, _ = settings_for("driving")
    content = ExpertSettings(env="driving", seed=0, config=static, hparams=traced).as_json()
    content = {k: v for k, v in (content | change).items() if v is not None}
    run = run_folder(tmp_path / "run", content)
    told = refused(capsys, "expert", "train", "--resume", "--out", run)
    assert told.removeprefix(f"'{run}/config.json'").strip().startswith(said.strip())
    assert refused(capsys, "expert", "card", run) == told


@pytest.mark.parametrize(
    ("session", "said"),
    [
        ([], "': session must be an object, got []"),
        ({"rate": "fast"}, "', session: rate must be a number, got 'fast'"),
        ({"speed": 3}, "', session: unknown setting 'speed'"),
        ({"questions": [{"name": "load"}]}, "', session, question 1 lacks 'text'"),
    ],
)
def test_the_config_of_a_session_likewise(session, said, tmp_path):
    run = run_folder(tmp_path / "run", config(expert="person", session=session))
    with pytest.raises(UserError) as refusal:
        resumed(run, {})
    assert str(refusal.value).startswith(f"'{run}/config.json{said}")


def test_a_session_without_some_settings_has_their_defaults(tmp_path):
    run = run_folder(tmp_path / "run", config(expert="person", session={"participant": "p1"}))
    _, session = resumed(run, {})
    assert (session.participant, session.rate, session.questions) == ("p1", 10, ())
    assert read_config(run)["session"] == {"participant": "p1"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[", "cannot be read: Expecting value"),
        ("{}", "must hold a list of objects"),
        ('["load"]', ", question 1 must hold an object, got 'load'"),
        ('[{"name": 3, "text": "How?"}]', ", question 1: name must be text, got 3"),
        ('[{"name": "a", "text": "b", "choices": "yes"}]', ", question 1: choices must be a list"),
        ('[{"name": "", "text": "b"}]', ": each needs a name of its own"),
    ],
)
def test_questions_of_another_form_are_refused(text, said, tmp_path):
    file = tmp_path / "questions.json"
    file.write_text(text)
    with pytest.raises(UserError) as refusal:
        read_questions(file)
    assert said in str(refusal.value)
    assert str(file) in str(refusal.value)


# recordings

STEPS, AHEAD = 60, 4


def demonstrations(steps=STEPS):
    """The probe's expert in episodes of 20 steps, as plain arrays with the world's states."""
    sign = np.where(np.arange(steps) // 20 % 2, -1.0, 1.0)
    zero = np.zeros(steps)
    return {
        "observation": np.stack([sign, zero, zero + 1], 1),
        "action": Probe.answer(sign)[:, None],
        "episode": np.arange(steps) // 20,
        "state/sign": sign.astype(np.float32),
        "state/error": zero.astype(np.float32),
        "state/time": (np.arange(steps) % 20).astype(np.int32),
    }


def plain():
    """The same without the states."""
    return {k: v for k, v in demonstrations().items() if not k.startswith("state/")}


def whole():
    """A recording with every column, as other tools might write them."""
    flags, zero = np.zeros(STEPS), np.zeros(STEPS)
    columns = plain() | {"expert_action": plain()["action"], "novice_action": zero[:, None]}
    columns |= dict.fromkeys(("takeover_start", "truncated", "success"), flags)
    columns |= {"is_intervention": flags + 1, "reward": zero, "cost": zero}
    columns |= {"terminated": np.tile(np.arange(20) == 19, 3), "next_observation": plain()[OBS]}
    columns |= {"predicted/observation": np.zeros((STEPS, AHEAD, 3))}
    for name in ("reward", "speed", "unsafe", "success", "terminated", "valid"):
        columns["predicted/" + name] = np.zeros((STEPS, AHEAD))
    return columns


OBS = "observation"


def saved(path, columns):
    np.savez(path, **columns)
    return path


def at(array, row, value):
    """A copy of an array with one value changed."""
    array = np.array(array, float)
    array[row] = value
    return array


def no(name):
    return {k: v for k, v in plain().items() if k != name}


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (no(OBS), " has no column 'observation'"),
        (no("action"), " has no column 'executed_action'"),
        (no("episode"), " does not say where episodes end: it has no episode, terminated, trunc"),
        (plain() | {"executed_action": np.zeros((60, 1))}, " has both columns 'action'"),
        (plain() | {OBS: np.zeros((0, 3))}, ": column 'observation' has no rows"),
        (
            plain() | {"reward": np.float32(0)},
            ": column 'reward' must have a row per step (60), go",
        ),
        (
            plain() | {"terminated": np.zeros(50)},
            ": column 'terminated' has 50 rows, 'observation' has 60",
        ),
        (
            plain() | {"action": np.zeros((60, 2, 2))},
            ": column 'executed_action' must be [T, A], g",
        ),
        (
            plain() | {"expert_action": np.zeros((60, 2))},
            ": column 'expert_action' must be [T, A] with A = 1 as in the columns before, got",
        ),
        (
            plain() | {"action": at(plain()["action"], (12, 0), -3)},
            ": column 'executed_action', row 12, index 0: must be in [-1, 1], got -3.0",
        ),
        (
            plain() | {OBS: at(plain()[OBS], (7, 2), np.nan)},
            ": column 'observation', row 7, index 2: must be a finite number, got nan",
        ),
        (
            plain() | {"reward": at(np.zeros(60), 3, 1e300)},
            ": column 'reward', row 3: must be a finite number, got 1e+300",
        ),
        (
            plain() | {"cost": at(np.zeros(60), 3, -1)},
            ": column 'cost', row 3: must be a finite number of 0 or more, got -1.0",
        ),
        (
            plain() | {"success": at(np.zeros(60), 5, 0.5)},
            ": column 'success', row 5: must be true or false, or 0 or 1, got 0.5",
        ),
        (
            plain() | {"success": np.array(["no"] * 60)},
            ": column 'success' must hold true or false, or 0 or 1, got <U2",
        ),
        (
            plain() | {"episode": np.arange(60) / 2},
            ": column 'episode', row 1: must be a whole number of 0 or more, got 0.5",
        ),
        (
            plain() | {"episode": np.arange(60) // 20 % 2},
            ": column 'episode', row 40: must be a number of its own, got 0 again",
        ),
        (
            plain() | {"terminated": np.arange(60) == 3},
            ": column 'terminated', row 3: must be 0 where episode 0 goes on in the next row",
        ),
        (
            plain() | {"is_interventon": np.zeros(60)},
            " has an unknown column 'is_interventon': did you mean 'is_intervention'?",
        ),
        (plain() | {"state/sign": np.array(["a"] * 60)}, ": column 'state/sign' must hold numbers"),
        (plain() | {"meta": np.str_("[1]")}, ", meta must hold an object, got [1]"),
        (plain() | {"meta": np.str_("{")}, ", meta must be a JSON object, got '{'"),
        (plain() | {"meta": np.str_('{"env": 3}')}, ", meta: env must be text, got 3"),
        (
            plain() | {"reward": np.array([None] * 60)},
            " cannot be read: array 'reward' holds P",
        ),
        (
            whole() | {"predicted/unsafe": np.zeros((60, 3))},
            ": column 'predicted/unsafe' must be [T, L] with L = 4 as in the columns before, got",
        ),
        (
            whole() | {"predicted/valid": at(np.zeros((60, 4)), (9, 2), 2)},
            ": column 'predicted/valid', row 9, index 2: must be true or false, or 0 or 1, got 2.0",
        ),
    ],
)
def test_a_recording_that_cannot_be_right_is_told_to_the_row(columns, said, tmp_path):
    path = tmp_path / "x.npz"
    np.savez(path, allow_pickle=True, **columns)
    with pytest.raises(UserError) as refusal:
        recording.load(path)
    assert str(refusal.value).startswith(f"recording '{path}'{said}")
    assert "\n" not in str(refusal.value)
    assert "pickle" not in str(refusal.value)


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda path: path.write_bytes(b""), "it is empty"),
        (lambda path: path.write_bytes(b"no zip"), "it is no .npz archive"),
        (lambda path: path.write_bytes(bytes_of(np.save, np.zeros(3))), "but a single .npy array"),
        (lambda path: None, "No such file"),
        (lambda path: path.write_bytes(TORN), "was cut off"),
    ],
)
@pytest.mark.parametrize("kind", ["recording", "policy"])
def test_a_file_that_is_no_archive_is_told(write, said, kind, tmp_path):
    path = tmp_path / "x.npz"
    write(path)
    with pytest.raises((UserError, ValueError)) as refusal:
        recording.load(path) if kind == "recording" else load_policy(path, 3, 1)
    assert str(path) in str(refusal.value)
    assert said in str(refusal.value)


def policy(**changes):
    """A policy file of the probe's size, with arrays changed, or left out where None."""
    arrays = {"w0": np.ones((3, 1)), "b0": np.zeros(1), "activation": "relu", "output": "tanh"}
    arrays |= {"version": 1, "meta": json.dumps({"env": "probe"})} | changes
    return {name: np.asarray(array) for name, array in arrays.items() if array is not None}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"version": "new"}, ": version must be a whole number, got 'new'"),
        ({"version": [1, 2]}, ": version must be a whole number, got '[1 2]'"),
        ({"w0": None}, " holds no layer w0, b0"),
        ({"b0": None}, " holds no array 'b0'"),
        ({"w2": np.ones((1, 1))}, " holds no array 'w1'"),
        ({"w0": np.ones((3, 0)), "b0": np.zeros(0)}, ": w0 (3, 0) and b0 (0,) do not fit"),
        ({"w0": 1.0}, ": w0 () and b0 (1,) do not fit"),
        ({"w0": np.full((3, 1), 1e300)}, ": w0 holds a NaN or infinite number at [0, 0]"),
        ({"b0": [np.nan]}, ": b0 holds a NaN or infinite number at [0]"),
        ({"b0": np.array([None])}, " cannot be read: array 'b0' holds Python objects"),
        ({"activation": ["relu"]}, ": activation must be relu or tanh"),
        ({"meta": None}, " holds no array 'meta'"),
        ({"meta": "{"}, ": meta must be a JSON object, got '{'"),
        ({"meta": "[1]"}, ": meta must be a JSON object, got '[1]'"),
        ({"meta": "{}"}, " cannot be read: its meta names no env"),
        ({"meta": '{"env": 3}'}, " cannot be read: its meta names no env"),
    ],
)
@pytest.mark.parametrize("command", ["evaluate", "export"])
def test_a_policy_that_cannot_be_right_is_one_line(changes, said, command, tmp_path, capsys):
    path = tmp_path / "policy.npz"
    np.savez(path, allow_pickle=True, **policy(**changes))
    words = [command, path, *(["--out", tmp_path / "x.npz"] if command == "export" else [])]
    assert refused(capsys, *words).startswith(f"policy file '{path}'{said}")


def test_whole_numbers_in_a_policy_are_taken(tmp_path):
    np.savez(tmp_path / "x.npz", **policy(w0=np.ones((3, 1), int)))
    assert load_policy(tmp_path / "x.npz", 3, 1).weights[0][0].sum() == 3


def bytes_of(save, *arrays):
    file = io.BytesIO()
    save(file, *arrays)
    return file.getvalue()


TORN = bytes_of(np.savez, np.zeros(300))[:800]


def test_other_kinds_of_the_same_numbers_are_taken(tmp_path):
    columns, config = recording.load(saved(tmp_path / "x.npz", whole()))
    assert config == {}
    for name in ("is_intervention", "success", "predicted/valid", "terminated"):
        assert columns[name].dtype == bool
    assert columns["is_intervention"].all()
    np.testing.assert_array_equal(columns["executed_action"], whole()["action"])
    changed = whole() | {OBS: np.ones((60, 3), int), "reward": np.zeros((60, 1))}
    changed |= {
        "action": whole()["action"][:, 0],
        "notes": np.zeros(3),
        "episode": np.repeat(1.0, 60),
    }
    changed |= {"terminated": np.zeros(60, np.uint8)}
    columns, _ = recording.load(saved(tmp_path / "y.npz", changed))
    assert columns[OBS].dtype == np.float32
    assert columns["reward"].shape == (60,)
    assert columns["executed_action"].shape == (60, 1)
    assert "notes" not in columns  # of a name that is not near any of ours


def test_what_follows_from_observations_actions_and_ends(tmp_path):
    given = plain() | {OBS: np.arange(180.0).reshape(60, 3)}
    columns, _ = recording.load(saved(tmp_path / "x.npz", given))
    for t in range(60):
        ends = t % 20 == 19
        after = given[OBS][t if ends else t + 1]
        np.testing.assert_array_equal(columns["next_observation"][t], after)
        assert columns["terminated"][t] == ends
        assert columns["takeover_start"][t] == (t % 20 == 0)
    assert not columns["truncated"].any()
    assert columns["is_intervention"].all()
    assert "novice_action" not in columns
    del given["episode"]
    given["truncated"] = columns["terminated"]
    flagged, _ = recording.load(saved(tmp_path / "y.npz", given))
    np.testing.assert_array_equal(flagged["episode"], columns["episode"])
    assert not flagged["terminated"].any()


def test_pieces_of_a_session_have_the_same_columns(tmp_path):
    run = run_folder(tmp_path / "run", config(env="probe"))
    (run / "recording").mkdir()
    first, second = (run / f"recording/{number:010d}.npz" for number in (60, 120))
    saved(first, plain())
    saved(second, plain() | {"episode": plain()["episode"] + 3})
    columns, _ = recording.load(run)
    assert len(columns[OBS]) == 120
    saved(second, whole())
    with pytest.raises(UserError, match=rf"'{first}' has no column '.*', which .*'{second}' has"):
        recording.load(run)
    saved(second, plain() | {"episode": plain()["episode"] + 3, OBS: np.zeros((60, 2))})
    with pytest.raises(UserError, match=r"'observation' has rows of \[2\], those of .* \[3\]"):
        recording.load(run)


def test_a_recording_of_another_world_is_one_line(tmp_path, capsys):
    train = ["train", "probe", "--out", tmp_path / "run", "--expert", "recorded"]
    named = plain() | {"meta": np.str_(json.dumps({"env": "driving"}))}
    path = saved(tmp_path / "x.npz", named)
    assert refused(capsys, *train, path) == f"recording '{path}' is of driving, not of probe"
    saved(path, plain() | {OBS: np.zeros((60, 2))})
    said = f"recording '{path}': column 'observation' is [60, 2], probe needs [T, 3]"
    assert refused(capsys, *train, path, "--algorithm", "bc") == said
    saved(path, demonstrations() | {OBS: np.zeros((60, 2))})
    assert refused(capsys, *train, path) == said
    saved(path, {k: v[:7] for k, v in plain().items()})
    said = f"recording '{path}' must have at least decision_interval (10) steps, got 7"
    assert refused(capsys, *train, path) == said
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({}, r"there are none, nor can they be predicted here \(it has no column 'state/sign'\)"),
        (
            demonstrations() | {"state/time": np.zeros((60, 2), np.int32)},
            r"\(its column 'state/time' has rows of \[2\] int32, not of \[\] int32\)",
        ),
    ],
)
def test_a_method_that_needs_predictions_says_what_is_missing(change, said, tmp_path, capsys):
    path = saved(tmp_path / "x.npz", plain() | {k: change[k] for k in change if "state" in k})
    told = refused(
        capsys, "train", "probe", "--out", tmp_path / "run", "--expert", "recorded", path
    )
    assert re.search(f"ppl needs 10 predicted states of each step, .*{said}", told)
    assert "give a method that needs none (bc, gail, hg_dagger, " in told
    saved(path, whole())
    told = refused(
        capsys, "train", "probe", "--out", tmp_path / "run", "--expert", "recorded", path
    )
    assert "there are 4, nor" in told
    assert "give --max-preference-horizon 4, or a method that needs none" in told


def test_states_of_another_scenario_are_not_predicted_from(tmp_path, capsys):
    other = demonstrations() | {"state/sign": -demonstrations()["state/sign"]}
    path = saved(tmp_path / "x.npz", other)
    told = refused(
        capsys, "train", "probe", "--out", tmp_path / "run", "--expert", "recorded", path
    )
    assert told.startswith(
        f"recording '{path}', row 0: its state is observed as -1 at index 0, recorded is 1: it is "
    )


# what demonstrations teach


def test_the_example_on_the_page_is_a_recording(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "pages" / "playing.md").read_text()
    exec(re.findall(r"```python\n(.*?)```", page, re.S)[0])
    columns, _ = recording.load(tmp_path / "demonstrations.npz")
    assert np.flatnonzero(columns["terminated"]).tolist() == [119, 214, 357]
    shapes = [columns[name].shape for name in (OBS, "executed_action")]
    assert shapes == [(358, 259), (358, 2)]


def taught(tmp_path, columns, algorithm, *words):
    """The summary of a tiny run on demonstrations alone."""
    path = saved(tmp_path / "x.npz", columns)
    words = ["--algorithm", algorithm, "--batch-size", "32", "--hidden", "32", *words]
    out = tmp_path / "run"
    main(["train", "probe", *words, "--expert", "recorded", str(path), "--out", str(out)])
    return json.loads((out / "summary.json").read_text())


REPEATED = 400  # steps


def test_plain_demonstrations_teach_cloning(tmp_path):
    columns = {k: v for k, v in demonstrations(REPEATED).items() if not k.startswith("state/")}
    summary = taught(tmp_path, columns, "bc", "--offline-updates", "500")
    assert summary["success_rate"] == 1.0
    assert summary["total_steps"] == summary["human_data_usage"] == REPEATED


def test_plain_demonstrations_teach_values_against_the_novices_own_actions(tmp_path):
    columns = {k: v for k, v in demonstrations(REPEATED).items() if not k.startswith("state/")}
    assert taught(tmp_path, columns, "pvp", "--learning-rate", "0.003")["success_rate"] == 1.0


def test_predictions_are_made_from_recorded_states(tmp_path):
    words = ["--learning-rate", "0.003", "--bc-weight", "0", "--max-preference-horizon", "4"]
    summary = taught(tmp_path, demonstrations(REPEATED), "ppl", *words)
    assert summary["success_rate"] == 1.0  # pairs alone taught it


def test_gail_takes_its_demonstrations_and_plays_by_itself(tmp_path, capsys):
    words = ["--rollout-steps", "50", "--evaluate-every", "50", "--offline-updates", "200"]
    columns = {k: v for k, v in demonstrations(REPEATED).items() if not k.startswith("state/")}
    more = ["--total-steps", "500", "--demonstrations", "400", "--learning-rate", "0.003"]
    summary = taught(tmp_path, columns, "gail", *words, *more)
    assert summary["human_data_usage"] == 400
    assert summary["total_steps"] == 500
    assert summary["training_episodes"] >= 20 + 100 // 20  # the recorded ones, and its own
    assert summary["success_rate"] == 1.0  # of the clone, which a few rounds do not spoil
    capsys.readouterr()
    path, run = tmp_path / "x.npz", tmp_path / "more"
    more = ["--demonstrations", "410", "--total-steps", "510", *words]
    told = refused(
        capsys,
        *("train", "probe", "--algorithm", "gail", *more),
        *("--expert", "recorded", path, "--out", run),
    )
    assert told == "demonstrations must not exceed the recording's 400, got 410"


@pytest.mark.parametrize(
    ("algorithm", "lengths"),
    [
        ("bc", {"total_steps": 60, "demonstrations": 60, "human_capacity": 10_000}),
        ("gail", {"total_steps": 1_000_060, "demonstrations": 60}),
        ("iwr", {"total_steps": 60, "demonstrations": 60}),
        ("hg_dagger", {"total_steps": 60, "demonstrations": 0}),
    ],
)
def test_a_run_is_as_long_as_its_recording(algorithm, lengths, tmp_path):
    path = saved(tmp_path / "x.npz", {k: v[:67] for k, v in demonstrations(70).items()})
    config = run_settings("probe", algorithm, expert=f"recorded {path}").config
    assert {name: getattr(config, name) for name in lengths} == lengths


# results

HEADER = "algorithm,seed,step,success,beta"
ROWS = [f"ppl,{seed},{step},0.{seed + 1},0.1" for seed in range(3) for step in (1000, 2000)]


def lines(*more, header=HEADER, rows=ROWS):
    return [header, *rows, *more]


def told(points):
    """What result rows say: label, step, seeds and success."""
    return [
        (p.label, p.step, p.seeds, p.measured["success"].round(6).tolist())
        for p in sorted(points, key=lambda p: p.step)
    ]


EXPECTED = [("ppl", step, [0, 1, 2], [0.1, 0.2, 0.3]) for step in (1000, 2000)]


def through_pandas(path):
    """As pandas writes them: an index, and whole numbers as 2000.0."""
    import pandas as pd

    frame = pd.read_csv(io.StringIO("\n".join(lines())))
    frame.astype({"seed": float, "step": float}).to_csv(path)


def text(joint="\n", encoding="utf-8", given=None, end="\n"):
    content = joint.join(lines() if given is None else given) + end
    return lambda path: path.write_bytes(content.encode(encoding))


@pytest.mark.parametrize(
    "write",
    [
        through_pandas,
        text(),
        text(end=""),
        text(end="\n\n\n,,,,\n"),
        text("\r\n"),
        text("\r"),
        text(encoding="utf-8-sig"),
        text(encoding="utf-16"),
        text(encoding="latin-1", given=[line + ",é" for line in lines()]),
        text(given=[line.replace(",", ";") for line in lines()]),
        text(given=[line.replace(",", "\t") for line in lines()]),
        text(given=['"' + line.replace(",", '","') + '"' for line in lines()]),
        text(given=[line.replace(",", " , ") for line in lines()]),
        text(given=[f"{i}," + line if i else "index," + line for i, line in enumerate(lines())]),
        text(
            given=[f"{i}," + line if i else "Unnamed: 0," + line for i, line in enumerate(lines())]
        ),
        text(given=lines(*ROWS)),  # all of them twice
        text(given=lines(*lines())),  # two files one behind the other
        text(given=lines("ppl,2.0,2e3,0.30,.1")),  # a row twice, otherwise written
    ],
)
def test_results_through_other_programs_are_the_same(write, tmp_path):
    path = tmp_path / "results.csv"
    write(path)
    assert told(points.read_points(path)) == EXPECTED


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("", " is empty: it has no header"),
        ("\n\n", " is empty: it has no header"),
        (HEADER, " holds no results of ppl"),
        ("a,b\n1,2\n", " holds no results of ppl"),
        (b"PK\x03\x04\x00\x00", " cannot be read: it is no text"),
        (
            lines("ppl,x,3000,0.5,0.1"),
            ", row 8: seed must be a whole number of 0 or more and at mo",
        ),
        (lines("ppl,-1,3000,0.5,0.1"), ", row 8: seed must be a whole number of 0 or more and at"),
        (lines("ppl,1e30,3000,0.5,0.1"), ", row 8: seed must be a whole number of 0 or more and"),
        (lines("ppl,0,30.5,0.5,0.1"), ", row 8: step must be a whole number of 0 or more and"),
        (lines("ppl,0,-5,0.5,0.1"), ", row 8: step must be a whole number of 0 or more and"),
        (lines("ppl,0,3000,1.5,0.1"), ", row 8: success must be a finite number from 0 to 1, got"),
        (lines("ppl,0,3000,nan,0.1"), ", row 8: success must be a finite number from 0 to 1, got"),
        (lines("ppl,0,3000,inf,0.1"), ", row 8: success must be a finite number from 0 to 1, got"),
        (lines("ppl,0,3000,,0.1"), ", row 8: success must be a finite number from 0 to 1, got ''"),
        (lines("ppl,0,3000,0.5"), ", row 8 has 4 cells, the header has 5"),
        (lines("ppl,0,3000,0.5,0.1,7"), ", row 8 has 6 cells, the header has 5"),
        (
            lines("algorithm,seed,step,success,gamma", "ppl,0,3000,0.5,0.1"),
            ", row 8 is a header of other columns: files whose columns differ",
        ),
        (
            lines("ppl,1,2000,0.25,0.1"),
            ", rows 5 and 8: the same run (ppl, seed 1, step 2000) has success 0.2 and 0.25",
        ),
        (lines(header="algorithm,seed,step,success,success"), " has the column 'success' twice"),
        (lines('ppl,0,3000,"0.5,0.1'), ", row 8: unexpected end of data"),
    ],
)
@pytest.mark.parametrize("command", ["table", "figure"])
def test_results_that_cannot_be_right_are_told_to_the_row(content, said, command, tmp_path, capsys):
    path = tmp_path / "results.csv"
    if isinstance(content, list):
        content = "\n".join(content) + "\n"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    words = [command, path, *(["--out", tmp_path / "x.png"] if command == "figure" else [])]
    assert refused(capsys, *words).startswith(f"'{path}'{said}")


def test_a_scenario_that_is_there_twice_counts_once(tmp_path):
    header, rows = "algorithm,seed,step,scenario,success", ["ppl,0,10,1,1", "ppl,0,10,2,0"]
    path = tmp_path / "episodes.csv"
    path.write_text("\n".join([header, *rows, rows[0]]))
    (point,) = points.read_points(path)
    assert point.measured["success"].tolist() == [0.5]
    assert point.scenarios == [1, 2]
    path.write_text("\n".join([header, *rows, "ppl,0,10,2,1"]))
    with pytest.raises(UserError, match=r"rows 3 and 4: the same run .* has success 0 and 1"):
        points.read_points(path)


EVALUATED = "step,scenario,success,episodic_return,progress,episodic_cost,length"


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (["10,1000,2,0,0,0,5"], ", row 2: success must be a whole number from 0 to 1, got '2'"),
        (["10,1000,1,nan,0,0,5"], ", row 2: episodic_return must be a finite number, got 'nan'"),
        (["10,1000,1,0,0,0"], ", row 2 has 6 cells, the header has 7"),
        (
            ["10,1000,1,0,0,0,5", "10,1000,0,0,0,0,5"],
            ", rows 2 and 3: step 10, scenario 1000 is there twice, with different results",
        ),
    ],
)
def test_an_evaluation_that_cannot_be_right_is_refused(rows, said, tmp_path):
    path = tmp_path / "evaluation.csv"
    path.write_text("\r\n".join([EVALUATED, *rows]))
    with pytest.raises(UserError) as refusal:
        read_evaluation(tmp_path)
    assert str(refusal.value) == f"'{path}'{said}"


def test_an_evaluation_is_read_with_its_rows_once(tmp_path):
    row = "10.0,1000,1,0.5,0,0,5"
    (tmp_path / "evaluation.csv").write_text("\n".join([EVALUATED, row, row]))
    (found,) = read_evaluation(tmp_path)
    assert (found.step, found.success, found.episodic_return) == (10, 1, 0.5)
    (tmp_path / "evaluation.csv").write_text("step\n1\n")
    with pytest.raises(UserError, match="has no column 'scenario'"):
        read_evaluation(tmp_path)


MEASURED = "seed,step,predicted_step,drift,coverage,gap,error"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([MEASURED, "0,10,1,x,0,0,0"], ", row 2: drift must be a finite number, got 'x'"),
        ([MEASURED, "0,10,1.5,0,0,0,0"], ", row 2: predicted_step must be a whole number"),
        ([MEASURED, "0,10,1,0,0,0,0", "0,10,1,0,0,0,1"], ", row 3: the same seed, step and"),
        (["predicted_step,seed", "1,0"], " has no column 'step'"),
        (["axis,value,cpu_ms,cpu_ms_per_step", "steps,1,?,2"], ", row 2: cpu_ms must be a finite"),
        (["value,cpu_ms_per_step", "1,2"], " has no column 'axis'"),
    ],
)
def test_measured_files_that_cannot_be_right_are_refused(content, said, tmp_path, capsys):
    path = tmp_path / "measured.csv"
    path.write_text("\n".join(content))
    told = refused(capsys, "figure", path, "--out", tmp_path / "x.png")
    assert told.startswith(f"'{path}'{said}")


@pytest.mark.parametrize(
    ("card", "curve", "said"),
    [
        ("{", "step", "/a.json' cannot be read: Expecting property name"),
        ("[]", "step", "/a.json' must hold an object, got []"),
        ('{"hparams": {}}', "step", "/a.json', hparams lacks 'cost_limit'"),
        (
            '{"hparams": {"cost_limit": "x"}}',
            "step",
            "/a.json', hparams: cost_limit must be a numb",
        ),
        ('{"hparams": {"cost_limit": 1}}', "steps\n1", "/a.csv' has no column 'step'"),
        ('{"hparams": {"cost_limit": 1}}', "step\nsoon", "/a.csv', row 2: step must be a whole nu"),
    ],
)
def test_cards_of_experts_that_cannot_be_right_are_refused(card, curve, said, tmp_path, capsys):
    (tmp_path / "a.json").write_text(card)
    (tmp_path / "a.csv").write_text(curve)
    told = refused(capsys, "figure", tmp_path, "--out", tmp_path / "x.png")
    assert told.startswith(f"'{tmp_path}{said}")
