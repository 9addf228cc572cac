"""Files of others: what can be taken is taken, the rest is one line and exit code 2."""

import json

import pytest

import envs
from experiments.cli import main
from experiments.engine.expert_settings import ExpertSettings, settings_for
from experiments.engine.runtime import UserError
from experiments.engine.settings import RunSettings, read_config, run_settings
from experiments.ui.play import read_questions, resumed
from tests.helpers import Probe


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
