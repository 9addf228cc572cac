"""Settings stand once: names, values, ranges, round trips, older files."""

import dataclasses
import subprocess
import sys

import flax.struct
import pytest

import ppl_jax
from experiments.cli import parse
from experiments.engine.evaluate import run_hparams, run_options
from experiments.engine.run import build_env, open_folder
from experiments.engine.run_folder import RunFolder
from experiments.engine.runtime import UserError
from experiments.engine.settings import (
    ADDED,
    RunSettings,
    check,
    flat,
    one_level,
    refuse_contradictions,
    run_settings,
    with_values,
)
from experiments.options.seeds import parse_seeds
from experiments.options.settings import settings_in
from experiments.studies import grid
from experiments.studies.compare import settings_of
from experiments.studies.results import Results
from experiments.studies.runner import plan
from ppl_jax import algorithms
from ppl_jax.config import (
    PRESETS,
    HParams,
    TrainConfig,
    catalogue,
    check_unique,
    env_params,
    replace,
    validate,
    values,
)
from ppl_jax.gates import gate, register_gate, registered_gates
from ppl_jax.predictors import predictor, registered_predictors
from tests.helpers import ROOT

ENVS = ("driving", "table_wiping", "nut_assembly", "an environment of one's own")


@pytest.mark.parametrize("env", ENVS)
@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", algorithms.registered())
def test_every_method_has_valid_settings_that_survive_a_file(name, preset, env):
    if preset == "reference" and env in ("table_wiping", "nut_assembly"):
        with pytest.raises(ValueError, match="preset 'reference' is not for"):
            algorithms.settings(name, env, preset)
        return
    config, hparams = algorithms.settings(name, env, preset)
    validate(config, hparams)
    again = with_values(env, name, flat(config, hparams))
    assert values(*again) == values(config, hparams)
    assert config == again[0]


def test_a_setting_has_one_owner_and_every_field_says_what_it_is():
    for name in algorithms.registered():
        for gate_name in registered_gates():
            for one in catalogue(*algorithms.settings(name, "driving", gate=gate_name)).values():
                assert one.about.help.endswith((".", "them.")), one.name
                assert one.about.group in (
                    "run", "world", "method", "gate", "predictor", "expert",
                )  # fmt: skip

    @flax.struct.dataclass
    class Again:
        beta: float = 1.0
        learning_rate: float = 1.0

    with pytest.raises(ValueError, match="setting 'learning_rate' of Again is one of HParams"):
        check_unique(Again)
    with pytest.raises(ValueError, match="'low_return' is registered already"):
        register_gate("low_return", lambda point, hparams, scale: True)


def test_values_are_replaced_by_their_flat_names_wherever_they_live():
    config, hparams = algorithms.settings("ppl", "driving")
    changed = {"beta": 0.7, "objective": "ipo", "hidden": (8,), "min_speed": 1.0}
    found = replace(config, hparams, **changed)
    assert {name: values(*found)[name] for name in changed} == changed
    rest = values(config, hparams)
    assert {k: v for k, v in values(*found).items() if k not in changed} == {
        k: v for k, v in rest.items() if k not in changed
    }


def test_what_somebody_asks_for_moves_what_depends_on_it():
    longest = algorithms.settings("ppl", "table_wiping", preference_horizon=7)[0].method
    assert longest.max_preference_horizon == 7
    short = algorithms.settings("ppl", "driving", prediction_horizon=6)[0].method
    assert short.max_preference_horizon == 6
    config, hparams = algorithms.settings("ppl", "driving", preference_horizon="auto")
    assert config.method.adaptive_horizon
    assert hparams.method.preference_horizon == 10


def old_config(name, env="driving", **changes):
    """A config.json as the first version wrote it: all settings of all methods, older names."""
    config, hparams = algorithms.settings(name, env)
    both = values(config, hparams)
    static = {k: v for k, v in both.items() if k in values(TrainConfig(), HParams())}
    static = {k: list(v) if isinstance(v, tuple) else v for k, v in static.items()}
    static = {k: v for k, v in static.items() if k not in ADDED}
    traced = {k: both.get(k, 0.5) for k in ("beta", "discount", "learning_rate", "min_speed")}
    static |= {"members": 5, "rollout_steps": 2000, "objective": "cpo"}
    content = {"env": env, "algorithm": name, "seed": 3, "expert": "scripted"}
    content |= dict.fromkeys(("reference_policy", "scenarios", "held_out_scenarios"))
    content |= {"evaluate_every": 100, "evaluate_on": "held_out"}
    traced |= {"max_doubt": 0.02, "target_rate": 0.01, "max_departure": 2.0}
    for name, value in changes.items():
        (static if name in static else traced)[name] = value
    return content | {"config": static, "hparams": traced}


def test_a_config_of_the_first_version_is_read_under_todays_names():
    found = RunSettings.from_json(old_config("ensemble_dagger", gate="departs"))
    assert found.seed == 3
    assert found.config.gate == "deviates_from_expert"
    assert found.hparams.method.max_ensemble_variance == 0.02
    assert found.hparams.gate.max_departure == 2.0
    assert RunSettings.from_json(old_config("pvp")).hparams.method.polyak_tau == 0.01
    now = one_level(RunSettings.from_json(old_config("ppl")).as_json())
    before = one_level(old_config("ppl"))
    shared = (now.keys() & before.keys()) - {"schema"}
    assert "beta" in shared
    assert {k: now[k] for k in shared} == {k: before[k] for k in shared}


def test_a_config_of_a_newer_version_or_with_unknown_settings_is_refused():
    content = RunSettings.from_json(old_config("ppl")).as_json()
    with pytest.raises(UserError, match="schema 6; this version reads up to 5"):
        RunSettings.from_json(content | {"schema": 6})
    content["settings"]["beat"] = 1.0
    with pytest.raises(UserError, match="unknown setting 'beat': did you mean 'beta'"):
        RunSettings.from_json(content)
    del content["settings"]
    with pytest.raises(UserError, match=r"config\.json lacks 'settings'"):
        RunSettings.from_json(content)


@pytest.mark.parametrize(
    ("words", "seeds"),
    [
        (["5"], (0, 1, 2, 3, 4)),
        (["3", "7", "11"], (3, 7, 11)),
        (["10-13"], (10, 11, 12, 13)),
        (["0-1", "5"], (0, 1, 5)),
    ],
)
def test_seeds_in_three_ways(words, seeds):
    assert parse_seeds(words) == seeds


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["0"], "seeds must be at least 1, got 0"),
        (["x"], "seeds must be a number of them"),
        (["3", "3"], "every seed once, got 3 3"),
        (["9-3"], "seeds must be at least one"),
    ],
)
def test_seeds_that_are_none(words, said):
    with pytest.raises(UserError, match=said):
        parse_seeds(words)


def test_options_show_what_a_run_of_that_environment_and_method_would_use():
    wiping = settings_in(["table_wiping", "--algorithm", "pvp"])
    assert wiping["total_steps"].value == 4000
    assert wiping["discount"].value == 0.9
    assert wiping["min_return"].value == pytest.approx(1.64)
    assert "beta" not in wiping
    reference = settings_in(["driving", "--preset", "reference"])
    assert reference["prediction_horizon"].value == 20
    assert "min_speed" in settings_in(["driving"])
    assert "max_departure" in settings_in(["driving", "--gate", "deviates_from_expert"])
    both = settings_in(["driving", "--algorithms", "ppl", "eil"], sweeping=True)
    assert {"beta", "margin"} <= set(both)
    with pytest.raises(UserError, match="max_doubt is called max_ensemble_variance now"):
        settings_in(["driving", "--max-doubt", "0.1"])
    with pytest.raises(UserError, match="gate 'departs' is called 'deviates_from_expert' now"):
        settings_in(["driving", "--gate", "departs"])


def test_unknown_names_are_refused_with_near_ones():
    with pytest.raises(UserError, match="unknown environment 'drivng'"):
        run_settings("drivng")
    for find, name, near in (
        (gate, "low_retrun", "low_return"),
        (predictor, "kinematik", "kinematic"),
        (algorithms.method, "hg_dager", "hg_dagger"),
    ):
        with pytest.raises(ValueError, match=f"did you mean '{near}'"):
            find(name)
    assert set(registered_predictors()) >= {"simulator", "kinematic"}


def test_the_public_surface_is_there_and_costs_no_import():
    for name in ppl_jax.__all__:
        assert getattr(ppl_jax, name) is not None
    assert len(ppl_jax.__all__) <= 32
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        ppl_jax.nothing  # noqa: B018
    code = "import sys, ppl_jax; print('jax' in sys.modules, 'envs' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.split() == ["False", "False"], done.stderr


def test_a_project_with_folders_of_these_names_has_both(tmp_path):
    for name in ("envs", "experiments"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("MINE = 7\n")
        (tmp_path / name / "own.py").write_text("VALUE = 3\n")
    program = tmp_path / "program.py"
    program.write_text(
        "import envs.own\n"
        "import ppl_jax\n"
        "spec = ppl_jax.make('table_wiping').spec\n"
        "import experiments.own\n"
        "print(spec.observation_size, envs.MINE, envs.own.VALUE, experiments.own.VALUE)\n"
        "print(ppl_jax.train.__name__, ppl_jax.main.__name__, ppl_jax.register.__name__)\n"
    )
    done = subprocess.run(
        [sys.executable, str(program)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
    )
    assert done.stdout.split() == ["34", "7", "3", "3", "train", "main", "register"], done.stderr


def test_settings_classes_are_frozen():
    config, hparams = algorithms.settings("ppl", "driving")
    for part in (config, config.method, hparams, hparams.method, hparams.gate):
        with pytest.raises(dataclasses.FrozenInstanceError):
            part.x = 1


@pytest.mark.parametrize(
    ("words", "setting", "value"),
    [
        (["--gate", "low_return"], "gate", "low_return"),
        (["--gate", "low_return", "--min-return", "3"], "min_return", 3.0),
        (["--gate=deviates_from_expert"], "gate", "deviates_from_expert"),
        (["--predictor", "kinematic"], "predictor", "kinematic"),
        (["--total-steps", "400"], "total_steps", 400),
        (["--hidden", "64", "64"], "hidden", (64, 64)),
        (["--algorithm", "thrifty_dagger", "--switch-rate", "0.2"], "switch_rate", 0.2),
    ],
)
def test_an_option_of_train_reaches_the_run(words, setting, value):
    settings = parse(["train", "driving", *words]).settings
    found = values(settings.config, settings.hparams)
    assert found[setting] == value
    untouched = parse(["train", "driving"]).settings
    assert values(untouched.config, untouched.hparams).get(setting) != value


def test_physics_is_an_option_of_every_command_that_trains(tmp_path):
    settings = parse(["train", "table_wiping", "--physics", "mjx"]).settings
    check(settings)
    assert settings.as_json()["settings"]["physics"] == "mjx"
    assert RunSettings.from_json(settings.as_json()).config.physics == "mjx"
    assert settings.where == "table_wiping on mjx"
    analytic = parse(["train", "table_wiping", "--physics", "analytic"]).settings
    assert build_env(analytic).physics == "analytic"
    for words in (["compare"], ["ablation"], ["tune"]):
        command = parse([*words, "nut_assembly", "--physics", "mujoco_c"])
        for method in ("ppl", "bc", "thrifty_dagger"):
            assert settings_of(command, method, 0, {}).config.physics == "mujoco_c"
    assert parse(["expert", "train", "lift", "--physics", "mjx"]).settings.physics == "mjx"
    assert parse(["play", "table_wiping", "--physics", "mjx"]).settings == {"physics": "mjx"}
    for words in (["evaluate", "x"], ["render", "x"], ["horizon", "lift"]):
        assert parse([*words, "--physics", "mjx"]).physics == "mjx"

    runs = plan(parse(["sweep", "table_wiping", "--physics", "analytic", "mjx", "--seeds", "2"]))
    assert [run.settings.config.physics for run in runs] == ["analytic"] * 2 + ["mjx"] * 2
    assert len(grid.groups(runs)) == 2  # each is a program of its own
    assert {"physics"} <= set(Results(tmp_path, runs).columns)


@pytest.mark.parametrize(
    ("env", "physics", "said"),
    [
        ("driving", "mjx", "physics must be auto for 'driving', got 'mjx'"),
        ("lift", "analytic", "physics must be auto or one of mjx for 'lift', got 'analytic'"),
        ("table_wiping", "bullet", "physics must be auto or one of analytic, mjx, mujoco_c for"),
    ],
)
def test_a_physics_that_an_environment_lacks_is_refused(env, physics, said):
    words = [env, "--physics", physics]
    with pytest.raises(UserError, match=said):
        check(parse(["train", *words]).settings)
    with pytest.raises(UserError, match=said):
        plan(parse(["sweep", *words]))
    with pytest.raises(UserError, match=said):
        settings_of(parse(["compare", *words]), "ppl", 0, {})
    with pytest.raises(UserError, match=said):
        parse(["expert", "train", *words])


def before_later_settings(content, schema):
    """A config.json without the settings that were added since."""
    content = dict(content)
    kept = {k: v for k, v in content.pop("settings").items() if k not in ADDED}
    if schema == 1:
        del content["schema"]
        return content | {"config": kept, "hparams": {}}
    return content | {"schema": schema, "settings": kept}


def test_a_run_from_before_schema_3_keeps_its_buffers():
    """They had no more rows than the run has steps: its checkpoints hold arrays of that size."""
    now = run_settings("driving", given={"total_steps": 400})
    assert now.config.human_rows == 10_000
    before = RunSettings.from_json(now.as_json() | {"schema": 2})
    assert before.config.human_rows == 400
    longest = RunSettings.from_json(
        run_settings("driving", given={"total_steps": 80_000}).as_json() | {"schema": 2}
    )
    assert longest.config.human_rows == longest.config.human_capacity == 50_000


def test_a_run_from_before_schema_4_has_no_pairs_at_the_present_state():
    now = run_settings("driving")
    assert now.config.method.pair_states == "predicted"
    old = now.as_json() | {"schema": 3}
    assert RunSettings.from_json(old).config.method.pair_states == "future"
    assert one_level(old)["pair_states"] == "future"
    reference = run_settings("driving", preset="reference").as_json() | {"schema": 3}
    assert RunSettings.from_json(reference).config.method.pair_states == "shifted"


@pytest.mark.parametrize("schema", [1, 2])
def test_a_config_from_before_physics_could_be_chosen_is_read_and_continued(schema, tmp_path):
    content = before_later_settings(run_settings("table_wiping").as_json(), schema)
    settings = RunSettings.from_json(content)
    assert settings.config.physics == "auto"
    folder = RunFolder(tmp_path / "run")
    folder.create(content)
    open_folder(folder, settings.as_json(), resume=True)
    assert run_options(folder.path) == ("table_wiping", {"physics": "auto"})
    resumed = ["train", "--resume", "--out", str(folder.path)]
    assert parse(resumed).settings == settings
    with pytest.raises(UserError, match="its physics is 'auto', asked for 'mjx'"):
        parse([*resumed, "--physics", "mjx"])
    held, asked = one_level(content), one_level(settings.as_json())
    with pytest.raises(UserError, match="its physics is 'auto', asked for 'mjx'"):
        refuse_contradictions(folder.path, held, asked | {"physics": "mjx"})


RANGES = ("friction_range", "mass_range", "damping_range", "gain_range", "start_noise")
RANGES += ("sensor_noise",)


@pytest.mark.parametrize("env", ["table_wiping", "nut_assembly", "lift"])
def test_a_randomised_run_owns_the_ranges_of_its_environment(env):
    assert not set(RANGES) & set(settings_in([env]))
    assert set(RANGES) < set(settings_in([env, "--randomise"]))
    words = ["train", env, "--randomise", "--friction-range", "0.5", "--start-noise", "0.02"]
    settings = parse(words).settings
    check(settings)
    world = settings.hparams.world
    assert (world.friction_range, world.start_noise, world.mass_range) == (0.5, 0.02, 0.0)
    content = settings.as_json()
    assert content["settings"]["randomise"] is True
    assert content["settings"]["friction_range"] == 0.5
    assert RunSettings.from_json(content) == settings
    with pytest.raises(UserError, match="mass_range must not be negative, got -1"):
        check(parse([*words, "--mass-range", "-1"]).settings)


def test_ranges_need_a_randomised_run_and_an_environment_that_has_them():
    for command in ("train", "sweep", "play"):
        with pytest.raises(
            UserError, match="friction_range is a range of randomised worlds: add --"
        ):
            parse([command, "table_wiping", "--friction-range", "0.5"])
    with pytest.raises(UserError, match="add --randomise"):
        run_settings("table_wiping", given={"friction_range": 0.5})
    for command in ("train", "sweep"):
        with pytest.raises(UserError, match="randomise must be off for 'driving'"):
            parse([command, "driving", "--randomise"])
    assert parse(["train", "driving", "--no-randomise"]).settings.config.randomise is False


def test_a_randomised_run_is_resumed_with_its_ranges(tmp_path):
    words = ["train", "lift", "--randomise", "--gain-range", "0.25"]
    settings, folder = parse(words).settings, RunFolder(tmp_path / "run")
    folder.create(settings.as_json())
    resumed = ["train", "--resume", "--out", str(folder.path)]
    assert parse(resumed).settings == settings
    assert run_hparams(folder.path) == settings.hparams
    for more, said in (
        (["--gain-range", "0.5"], "its gain_range is 0.25, asked for 0.5"),
        (["--no-randomise"], "its randomise is True, asked for False"),
    ):
        with pytest.raises(UserError, match=said):
            parse([*resumed, *more])


def test_a_world_that_is_not_randomised_keeps_its_very_parameters():
    hparams = algorithms.settings("ppl", "table_wiping")[1]
    params = object()
    assert env_params(None, params, hparams) is params


@pytest.mark.parametrize("study", ["friction", "mass", "damping", "gains", "start_noise"])
def test_a_range_is_traced_so_a_study_of_it_is_one_program_a_method(study):
    runs = plan(parse(["robustness", "table_wiping", "--study", study, "--seeds", "2"]))
    assert all(run.settings.config.randomise for run in runs)
    assert len(grid.groups(runs)) == 2  # ppl and pvp
    words = ["--randomise", "--friction-range", "0", "0.5", "--mass-range", "0", "1"]
    runs = plan(parse(["sweep", "table_wiping", *words, "--seeds", "1"]))
    assert len(runs) == 4
    assert len(grid.groups(runs)) == 1
    worlds = [
        (r.settings.hparams.world.friction_range, r.settings.hparams.world.mass_range) for r in runs
    ]
    assert worlds == [(0, 0), (0, 1), (0.5, 0), (0.5, 1)]
