"""A session without a browser: the person is a function, the page a socket."""

import dataclasses
import json
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import envs
from experiments.engine import recording
from experiments.engine.evaluate import read_evaluation
from experiments.engine.policy_file import load_policy
from experiments.engine.recorded import length_of, recorded_functions
from experiments.engine.run import RunSettings, open_folder, train
from experiments.engine.run_folder import RunFolder
from experiments.engine.runtime import UserError
from experiments.options.commands import Play
from experiments.ui import views
from experiments.ui.config import Question, SessionConfig
from experiments.ui.options import named_options
from experiments.ui.play import new_session, play, read_consent, read_questions, resumed
from experiments.ui.protocol import (
    BURST,
    LONGEST,
    ORDERS,
    Allowance,
    Answers,
    Consent,
    Input,
    Malformed,
    Order,
    Seek,
    parse,
)
from experiments.ui.session import ANSWERS, CONSENT, Session
from experiments.ui.trainer import LOG, InteractiveTrainer
from ppl_jax import algorithms, checkpoint
from tests.helpers import Probe, plain_settings

CONFIG, HP = plain_settings(
    "ppl",
    learning_rate=3e-3,
    total_steps=300,
    batch_size=16,
    hidden=(16,),
    prediction_horizon=6,
    decision_interval=5,
    max_preference_horizon=6,
    human_capacity=300,
    preference_capacity=1000,
)
SETTINGS = RunSettings("probe", "ppl", 0, CONFIG, HP, expert="person")
PROBE = Probe()


class ProbeView:
    """Shows what the observation shows."""

    drawing, azimuth = "", None

    def __init__(self):
        self.pictures = 0

    def place(self, state):
        return state.error[None]

    def scene(self, state):
        return {"number": int(state.sign)}

    def frame(self, state, shown):
        return {"sign": float(state.sign), "fails": shown.fails, "mine": shown.mine is not None}

    def picture(self, number, state, shown):
        self.pictures += 1

    def close(self):
        pass


def trainer(folder, resume=False, settings=SETTINGS, **more):
    run = RunFolder(folder)
    open_folder(run, settings.as_json(), resume)
    made = InteractiveTrainer(settings, run, PROBE, ProbeView().place, **more)
    made.prepare(lambda line: None)
    return made


class Person:
    """Takes over where the page says that it is predicted to fail, and knows the answer."""

    def __init__(self, folder, session_config=None, settings=SETTINGS, resume=False, **more):
        run = RunFolder(folder)
        open_folder(run, settings.as_json(), resume)
        made = InteractiveTrainer(settings, run, PROBE, ProbeView().place, **more)
        self.frames, self.stages, self.told = [], [], []
        self.session = Session(
            made,
            ProbeView(),
            session_config or SessionConfig(rate=1000.0),
            self.see,
            tell=self.told.append,
        )
        self.always = False

    def see(self, message):
        if message["kind"] == "status":
            if not self.stages or self.stages[-1] != message["stage"]:
                self.stages.append(message["stage"])
            self.answer(message)
        elif message["kind"] == "frame":
            self.frames.append(message)
            takeover = self.always or message["fails"]
            hands = Input(message["number"], takeover, (0.6 * message["sign"],))
            self.session.receive(hands)

    def answer(self, message):
        if message["stage"] in ("ready", "paused"):
            self.session.receive(Order("start"))
        if message["stage"] == "consent":
            self.session.receive(Consent(True))
        if message["stage"] == "questions":
            names = [question["name"] for question in message["questions"]]
            self.session.receive(Answers(dict.fromkeys(names, "well")))


def equal(one, other):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


def test_a_person_teaches_the_probe_world(tmp_path):
    person = Person(tmp_path / "run")
    person.session.run()
    assert person.stages == ["preparing", "ready", "running", "finished"]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["total_steps"] == 300
    assert summary["success_rate"] == 1.0
    assert 0 < summary["human_data_usage"] < 250  # needed less and less
    assert {row.step for row in read_evaluation(tmp_path / "run")} == {300}
    lines = [json.loads(line) for line in (tmp_path / "run" / LOG).read_text().splitlines()]
    assert len(lines) == 300
    assert sum(line["takeover"] for line in lines) == summary["human_data_usage"]
    assert all(line["age_ms"] >= 0 for line in lines if "age_ms" in line)
    columns, config = recording.load(tmp_path / "run")
    assert config["algorithm"] == "ppl"
    assert columns["is_intervention"].tolist() == [line["takeover"] for line in lines]
    np.testing.assert_allclose(columns["state/sign"], columns["observation"][:, 0])
    person_at = columns["is_intervention"]
    np.testing.assert_array_equal(
        columns["executed_action"][person_at], columns["expert_action"][person_at]
    )


def test_consent_familiarisation_manual_episodes_and_questions(tmp_path):
    session_config = SessionConfig(
        rate=1000.0,
        participant="p-01",
        consent="We record what you do.",
        familiarisation=2,
        questions=(Question("load", "How hard was it?", ("easy", "hard")),),
    )
    person = Person(tmp_path / "run", session_config, manual_episodes=1)
    person.session.run()
    assert person.stages[:7] == [
        "preparing",
        "consent",
        "practice",
        "paused",
        "running",
        "questions",
        "running",
    ]
    consent = json.loads((tmp_path / "run" / CONSENT).read_text())
    assert consent["agreed"]
    assert consent["participant"] == "p-01"
    columns, _ = recording.load(tmp_path / "run")
    first = columns["episode"] == 0
    assert columns["is_intervention"][first].all()  # the first episode is the person's
    assert not columns["is_intervention"].all()
    assert len(columns["episode"]) == 300  # what was practised is not among it
    answers = (tmp_path / "run" / ANSWERS).read_text().splitlines()
    ends = (columns["terminated"] | columns["truncated"])[:-1].sum()
    assert len(answers) == ends
    assert json.loads(answers[0])["answers"] == {"load": "well"}


def test_who_does_not_agree_is_not_recorded(tmp_path):
    person = Person(tmp_path / "run", SessionConfig(rate=1000.0, consent="text"))
    person.answer = lambda message: (
        person.session.receive(Consent(False)) if message["stage"] == "consent" else None
    )
    person.session.run()
    assert person.stages[-1] == "stopped"
    assert not (tmp_path / "run" / LOG).read_text()


def drive(made, steps, first=0):
    """The same hands at the same steps, whatever happened before."""
    for t in range(first, first + steps):
        if t in (31, 97):
            made.restart()
        made.step(t % 7 < 4, np.array([np.sin(t)], np.float32), {"late": False})
        made.learn()


@pytest.mark.parametrize("saved", [48, 97])  # within a prediction; right before a restart
def test_a_killed_session_goes_on_as_if_it_had_never_stopped(saved, tmp_path):
    whole = trainer(tmp_path / "whole")
    drive(whole, 120)
    broken = trainer(tmp_path / "broken")
    drive(broken, saved)
    broken.save(wait=True)
    drive(broken, 105 - saved, saved)
    broken._file.close()
    # killed: what is in memory is gone, the line being written is cut short
    with open(tmp_path / "broken" / LOG, "a") as file:
        file.write('{"do": "step", "takeo')
    again = trainer(tmp_path / "broken", resume=True)
    assert again.steps == 105
    drive(again, 15, 105)
    equal(again.learner, whole.learner)
    whole.close()
    again.close()
    one, other = (recording.load(tmp_path / name)[0] for name in ("whole", "broken"))
    for name in one:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)
    assert one["episode"].max() >= 2


def test_a_log_with_a_line_that_is_none_is_left_as_it_is(tmp_path):
    made = trainer(tmp_path / "run")
    drive(made, 10)
    made._file.close()
    path = tmp_path / "run" / LOG
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*lines[:4], "[]\n", *lines[4:]]))
    before = path.read_bytes()
    with pytest.raises(UserError, match="line 5 is no line of a session"):
        trainer(tmp_path / "run", resume=True)
    assert path.read_bytes() == before


def test_a_session_whose_first_checkpoint_never_came_goes_on(tmp_path):
    broken = trainer(tmp_path / "run")
    drive(broken, 40)
    broken._file.close()
    again = trainer(tmp_path / "run", resume=True)
    assert again.steps == 40
    equal(again.learner, broken.learner)
    again.close()


def test_a_complete_session_is_not_played_again(tmp_path):
    person = Person(tmp_path / "run")
    person.session.run()
    more = Person(tmp_path / "run", resume=True)
    more.session.run()
    assert more.stages == ["preparing", "finished"]
    assert len((tmp_path / "run" / LOG).read_text().splitlines()) == 300


def test_a_page_that_leaves_pauses_and_stale_hands_are_off(tmp_path):
    person = Person(tmp_path / "run", SessionConfig(rate=50.0))
    started = threading.Event()

    def answer(message):
        if message["stage"] == "ready" or (message["stage"] == "paused" and started.is_set()):
            person.session.receive(Order("start"))

    person.answer, person.always = answer, True
    thread = threading.Thread(target=person.session.run)
    thread.start()
    wait_for(lambda: len(person.frames) > 10)
    person.session.left()
    wait_for(lambda: person.session.stage == "paused")
    steps = person.session.trainer.steps
    time.sleep(0.2)
    assert person.session.trainer.steps == steps  # the clock stands
    person.session.receive = lambda message: None  # a page that says nothing more
    Session.receive(person.session, Order("start"))
    wait_for(lambda: person.session.trainer.steps > steps + 40)
    assert not person.frames[-1]["takeover"]
    assert person.session.late > 20
    Session.receive(person.session, Order("quit"))
    thread.join(30)
    assert person.stages[-1] == "stopped"
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["late_inputs"] > 20


def wait_for(what, seconds=60):
    end = time.time() + seconds
    while not what():
        assert time.time() < end, "waited too long"
        time.sleep(0.01)


def test_a_method_that_starts_with_demonstrations(tmp_path):
    config = dataclasses.replace(CONFIG, demonstrations=60, offline_updates=40)
    settings = dataclasses.replace(SETTINGS, algorithm="iwr", config=config)
    person = Person(tmp_path / "run", settings=settings)
    person.session.run()
    assert person.stages == ["preparing", "ready", "running", "preparing", "running", "finished"]
    columns, _ = recording.load(tmp_path / "run")
    assert columns["is_intervention"][:60].all()  # whatever the person's hands say
    assert not columns["is_intervention"][60:].all()
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["success_rate"] == 1.0


def test_a_full_disk_ends_the_session_and_loses_nothing(tmp_path, monkeypatch):
    made = trainer(tmp_path / "run")
    drive(made, 30)

    def full(*_):
        raise OSError("no space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "save", full)
        with pytest.raises(OSError, match="no space left"):
            made.close()
    again = trainer(tmp_path / "run", resume=True)
    equal(again.learner, made.learner)
    again.close()


def test_methods_that_ask_nobody_are_refused(tmp_path):
    settings = dataclasses.replace(SETTINGS, algorithm="bc")
    with pytest.raises(ValueError, match="asks nobody when to take over"):
        trainer(tmp_path / "run", settings=settings)


# the recording


def test_an_exported_session_is_the_session(tmp_path):
    made = trainer(tmp_path / "run")
    drive(made, 60)
    made.close()
    assert recording.export(tmp_path / "run", tmp_path / "session.npz") == 60
    one, config = recording.load(tmp_path / "run")
    other, same = recording.load(tmp_path / "session.npz")
    assert config == same
    assert set(one) == set(other)
    for name in one:
        np.testing.assert_array_equal(one[name], other[name])
    states = recording.states(one, made.learner.env_state)
    assert states.sign.shape == (60,)


def test_bad_recordings_are_told_in_a_line(tmp_path):
    with pytest.raises(UserError, match="not a run folder"):
        recording.load(tmp_path)
    junk = tmp_path / "junk.npz"
    junk.write_bytes(b"no zip")
    with pytest.raises(UserError, match="cannot be read"):
        recording.load(junk)
    made = trainer(tmp_path / "run")
    with pytest.raises(UserError, match="has no recording"):
        recording.load(tmp_path / "run")
    drive(made, 20)
    made.close()
    columns, _ = recording.load(tmp_path / "run")
    with pytest.raises(UserError, match="has 6 predicted states of each step, not 7"):
        recording.interactions(columns, PROBE, 7)
    cut = columns | {"observation": columns["observation"][:, :2]}
    with pytest.raises(UserError, match=r"column 'observation' is \[20, 2\], probe needs \[T, 3\]"):
        recording.interactions(cut, PROBE, 4)
    pickled = tmp_path / "pickled.npz"
    np.savez(pickled, observation=np.array([{}], object))
    with pytest.raises(UserError, match="array 'observation' holds Python objects"):
        recording.load(pickled)


# what a page may say


@given(st.text() | st.binary(max_size=200))
def test_no_text_breaks_the_parser(text):
    try:
        parse(text, 2)
    except Malformed:
        pass
    else:
        raise AssertionError("random text is no message")


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=6,
)
KINDS = st.sampled_from(["input", "order", "consent", "answers", "seek"])


@given(
    KINDS,
    st.dictionaries(st.sampled_from(["seen", "takeover", "action", "order", "agreed"]), VALUES),
)
def test_no_object_breaks_the_parser(kind, fields):
    try:
        message = parse(json.dumps({"kind": kind} | fields), 2)
    except Malformed:
        return
    if isinstance(message, Input):
        assert all(-1.0 <= part <= 1.0 for part in message.action)
        assert len(message.action) == 2
    if isinstance(message, Order):
        assert message.order in ORDERS


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"kind": "input", "seen": 3, "takeover": True, "action": [0.5, -7]},
            Input(3, True, (0.5, -1.0)),
        ),
        ({"kind": "order", "order": "pause"}, Order("pause")),
        ({"kind": "consent", "agreed": True}, Consent(True)),
        ({"kind": "answers", "answers": {"load": "hard"}}, Answers({"load": "hard"})),
        ({"kind": "seek", "step": 12}, Seek(12)),
    ],
)
def test_messages_are_understood(content, message):
    assert parse(json.dumps(content), 2) == message


@pytest.mark.parametrize(
    "text",
    [
        "{" * 1000,
        "[" * (LONGEST - 1),
        " " * (LONGEST + 1),
        '{"kind": "input", "seen": 1, "takeover": true, "action": [NaN, 0]}',
        '{"kind": "input", "seen": 1, "takeover": true, "action": [1e999, 0]}',
        '{"kind": "input", "seen": 1, "takeover": true, "action": [0]}',
        '{"kind": "input", "seen": -1, "takeover": true, "action": [0, 0]}',
        '{"kind": "input", "seen": 1, "takeover": 1, "action": [0, 0]}',
        '{"kind": "input", "seen": 1, "takeover": true, "action": [0, 0], "more": 1}',
        '{"kind": "order", "order": "rm"}',
        '{"kind": "order", "order": ["pause"]}',
        '{"kind": "answers", "answers": {"a": [1]}}',
    ],
)
def test_malformed_messages_are_refused(text):
    with pytest.raises(Malformed) as refusal:
        parse(text, 2)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("{", "not JSON"),
        ('{"kind": "order", "order": "rm"}', "order must be one of start, pause"),
        ('{"kind": "seek", "step": -1}', "step must be the number of a step"),
        ('{"kind": "consent", "agreed": 1}', "agreed must be true or false"),
        ('{"kind": "dance"}', "kind must be input, order, consent, answers or seek"),
        ('{"kind": "consent", "agreed": true, "more": 1}', "unknown field `more`"),
        ('{"kind": "consent"}', "required field `agreed`"),
        ('{"kind": "input", "seen": 1, "takeover": true, "action": [0]}', "action must be 2"),
    ],
)
def test_a_refusal_names_the_field_and_what_is_allowed(text, line):
    with pytest.raises(Malformed, match=line):
        parse(text, 2)


def test_an_allowance_runs_out_and_comes_back():
    allowance = Allowance(0.0)
    assert sum(allowance.take(0.0) for _ in range(2 * BURST)) == BURST
    assert not allowance.take(0.001)
    assert allowance.take(0.02)


# learning from a recording


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    if not envs.known("probe"):
        envs.register("probe", lambda **options: PROBE)
    run = tmp_path_factory.mktemp("session") / "run"
    Person(run).session.run()
    return run


def test_a_recording_teaches_what_the_session_taught(session, tmp_path):
    settings = dataclasses.replace(SETTINGS, expert=f"recorded {session}", evaluate_every=100)
    summary = train(settings, tmp_path / "run")
    assert summary["success_rate"] == 1.0
    first = json.loads((session / "summary.json").read_text())
    assert summary["human_data_usage"] == first["human_data_usage"]
    one, other = (load_policy(path / "policy.npz", 3, 1) for path in (session, tmp_path / "run"))
    for (w, b), (v, c) in zip(one.weights, other.weights, strict=True):
        np.testing.assert_allclose(w, v, atol=1e-4)
        np.testing.assert_allclose(b, c, atol=1e-4)


def test_a_recording_teaches_other_methods(session, tmp_path):
    config = dataclasses.replace(CONFIG, demonstrations=300, offline_updates=500)
    settings = dataclasses.replace(
        SETTINGS, algorithm="bc", config=config, expert=f"recorded {session}"
    )
    assert train(settings, tmp_path / "bc")["success_rate"] == 1.0


def test_a_recording_as_one_pure_function(session):
    make = algorithms.method("ppl").make
    fns = recorded_functions(PROBE, make, CONFIG, session)
    learner, metrics = jax.jit(fns.train)(jax.random.key(0), SETTINGS.hparams)
    assert int(learner.counters.steps) == 300
    assert metrics["train/human_data_usage"].shape == (1,)
    policy = load_policy(session / "policy.npz", 3, 1)
    np.testing.assert_allclose(
        fns.algorithm.policy(learner.algorithm)[0][0], policy.weights[0][0], atol=1e-4
    )


def test_a_session_as_a_minari_data_set(session, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    steps = recording.export_minari(session, "probe/person-v0")
    columns, _ = recording.load(session)
    found = list(minari.load_dataset("probe/person-v0").iterate_episodes())
    assert sum(len(episode.actions) for episode in found) == steps == len(columns["reward"])
    kept = np.concatenate([episode.infos["is_intervention"][:-1] for episode in found])
    np.testing.assert_array_equal(kept, columns["is_intervention"])
    actions = np.concatenate([episode.actions for episode in found])
    np.testing.assert_array_equal(actions, columns["executed_action"])
    assert all(len(e.observations) == len(e.actions) + 1 for e in found)
    with pytest.raises(UserError, match="minari"):
        recording.export_minari(session, "probe/person-v0")


def test_recordings_that_cannot_teach_are_refused(session, tmp_path):
    settings = dataclasses.replace(SETTINGS, expert=f"recorded {session}")
    longer = dataclasses.replace(CONFIG, total_steps=400)
    with pytest.raises(UserError, match="total_steps must not exceed the recording's 300, got 400"):
        train(dataclasses.replace(settings, config=longer), tmp_path / "run")
    with pytest.raises(UserError, match=r"is of probe, not of driving"):
        length_of(session, "driving")
    assert not (tmp_path / "run").exists()


# the command


@pytest.mark.parametrize(
    ("changes", "session", "more", "line"),
    [
        ({"env": "moon"}, {}, {}, "unknown environment 'moon'"),
        ({"algorithm": "ppo"}, {}, {}, "unknown algorithm 'ppo'"),
        ({"seed": -1}, {}, {}, "seed must not be negative, got -1"),
        ({}, {"participant": "a b"}, {}, "participant must be at most 32 letters"),
        ({}, {"familiarisation": -1}, {}, "familiarisation must not be negative, got -1"),
        ({}, {"manual_episodes": -2}, {}, "manual_episodes must not be negative, got -2"),
        ({}, {"rate": 0.0}, {}, "rate must lie between 0.1 and 1000, got 0.0"),
        ({}, {}, {"host": "0.0.0.0"}, "host must be one of 127.0.0.1"),
        ({}, {}, {"port": 70000}, "port: cannot listen on 127.0.0.1:70000"),
    ],
)
def test_bad_input_is_told_in_a_line_before_anything_is_built(
    tmp_path, changes, session, more, line
):
    settings = dataclasses.replace(SETTINGS, **({"env": "driving"} | changes))
    with pytest.raises(UserError, match=line):
        play(settings, tmp_path / "run", SessionConfig(**{"rate": 10.0} | session), **more)
    assert not (tmp_path / "run").exists()


def test_consent_and_questions_are_read_and_checked(tmp_path):
    file = tmp_path / "file"
    with pytest.raises(UserError, match="consent: cannot read"):
        read_consent(file)
    file.write_text("")
    with pytest.raises(UserError, match="consent must have 1 to 20000 letters, got 0"):
        read_consent(file)
    file.write_text(" We record.\n")
    assert read_consent(file) == "We record."
    with pytest.raises(UserError, match="cannot be read: Expecting value"):
        read_questions(file)
    file.write_text('[{"name": "load", "text": "How?", "choices": ["a", 2]}]')
    assert read_questions(file) == (Question("load", "How?", ("a", "2")),)
    file.write_text('[{"name": "load", "text": "How?"}, {"name": "load", "text": "Why?"}]')
    with pytest.raises(UserError, match="a name of its own"):
        read_questions(file)


# settings that come from the folder


def test_a_session_resumes_with_the_settings_of_its_folder(tmp_path):
    settings = dataclasses.replace(SETTINGS, env="driving")
    questions = (Question(name="load", text="How?", choices=("a", "b")),)
    given = {"participant": "p1", "rate": 5.0, "questions": questions, "seed": 0}
    made = new_session("driving", given | {"beta": 0.1})
    assert made == SessionConfig(rate=5.0, participant="p1", questions=questions)
    open_folder(RunFolder(tmp_path), settings.as_json() | made.as_json(), False)
    assert resumed(tmp_path, {}) == (settings, made)
    assert resumed(tmp_path, given | {"env": "driving", "learning_rate": 3e-3}) == (settings, made)
    with pytest.raises(UserError) as refusal:
        resumed(tmp_path, {"participant": "p2", "seed": 3, "total_steps": 300})
    assert str(refusal.value) == (
        f"cannot resume {str(tmp_path)!r}: its participant is 'p1', asked for 'p2'; its seed is 0, "
        "asked for 3"
    )


def test_only_options_that_are_named_are_compared():
    command = Play(env=None, participant="p1", seed=0, evaluate=False, out=Path("run"), port=0)
    assert named_options(command, ["play", "--resume", "--out", "run"]) == {}
    words = ["play", "--participant=p1", "--seed", "0", "--no-evaluate", "--port", "0"]
    expected = {"participant": "p1", "seed": 0, "evaluate": False}
    assert named_options(command, words) == expected
    assert named_options(Play(env="driving"), ["play", "driving"]) == {"env": "driving"}


def test_sessions_of_older_versions_resume(tmp_path):
    settings = dataclasses.replace(SETTINGS, env="driving")
    before = settings.as_json() | {"participant": "p1", "manual_episodes": 2}
    open_folder(RunFolder(tmp_path), before, False)
    expected = SessionConfig(rate=10.0, participant="p1", manual_episodes=2)
    assert resumed(tmp_path, {}) == (settings, expected)


def test_a_folder_without_a_session_is_not_resumed(tmp_path):
    with pytest.raises(UserError, match="not a run folder"):
        resumed(tmp_path, {})
    open_folder(
        RunFolder(tmp_path), dataclasses.replace(SETTINGS, expert="scripted").as_json(), False
    )
    with pytest.raises(UserError, match="its expert is 'scripted'; use ppl train --resume"):
        resumed(tmp_path, {})


# how an environment is shown


def test_an_environment_without_a_drawing_is_one_line():
    with pytest.raises(UserError, match="env: probe has no drawing") as refusal:
        views.display_of("probe")
    assert "\n" not in str(refusal.value)


def test_a_missing_package_is_one_line_with_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(UserError) as refusal:
        views.display_of("table_wiping")
    assert str(refusal.value) == ("showing table_wiping needs PIL: pip install 'ppl-jax[ui]'")


def test_a_session_left_right_after_a_restart_counts_its_episodes_on(tmp_path):
    whole, left = trainer(tmp_path / "whole"), trainer(tmp_path / "left")
    for made in (whole, left):
        drive(made, 30)
        made.save(wait=True)
        made.restart()
    left.close()
    again = trainer(tmp_path / "left", resume=True)
    for made in (whole, again):
        drive(made, 5, 40)
        made.close()
    one, other = (recording.load(tmp_path / name)[0] for name in ("whole", "left"))
    for name in one:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)
