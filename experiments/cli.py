"""The `ppl` command."""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from pathlib import Path
from typing import Annotated, Literal, Union, get_args, get_type_hints

import tyro
from tyro.conf import OmitArgPrefixes, OmitSubcommandPrefixes, Positional, subcommand

from envs.compiler import set_xla_flags
from experiments.engine.runtime import UserError
from experiments.engine.schedulers import SERVE


@dataclasses.dataclass
class Train:
    """Train one policy: progress, then the evaluation table; a run folder."""

    env: Positional[str]
    """World: driving, table_wiping or nut_assembly."""
    algorithm: str = "ppl"
    """Method: ppl, bc, gail, hg_dagger, ensemble_dagger, thrifty_dagger, iwr, eil, haco, pvp; or
    a port: haco_port, pvp4real."""
    seed: int = 0
    """Random seed."""
    preset: Literal["default", "paper", "reference"] = "default"
    """Settings to start from: ours, the paper's to the letter, or the released code's."""
    total_steps: int | None = None
    """Environment steps, demonstrations included."""
    demonstrations: int | None = None
    """Steps at the start that the expert makes all by itself."""
    offline_updates: int | None = None
    """Updates on them before the novice makes its first step."""
    preference_horizon: int | Literal["auto"] | None = None
    """L: predicted states that get a preference pair; auto chooses it while training."""
    prediction_horizon: int | None = None
    """H: steps of the lookahead the expert sees."""
    beta: float | None = None
    """Temperature of the preference loss."""
    bc_weight: float | None = None
    """Weight of the behaviour-cloning loss."""
    preference_weight: float | None = None
    """Weight of the preference loss."""
    preference_bias: float | None = None
    """Factor on the rejected action's likelihood: 1 in the paper, 0.5 by default."""
    likelihood: Literal["gaussian", "laplace"] | None = None
    """Which log pi the losses mean."""
    objective: Literal["cpo", "dpo", "ipo", "slic_hf", "imitation"] | None = None
    """What is minimised on preference pairs."""
    objective_target: Literal["pair", "library"] | None = None
    """Margin of ipo and slic_hf: one that bounded actions can reach, or the libraries' constant."""
    preferred: Literal["expert", "random"] | None = None
    """Preferred actions of the pairs."""
    rejected: Literal["novice", "random"] | None = None
    """Rejected actions of the pairs."""
    reference_policy: str | None = None
    """Policy file (.npz): the reference of dpo and ipo."""
    prediction_noise: float | None = None
    """epsilon: noise of norm epsilon |s| on predicted states."""
    expert_noise: float | None = None
    """Standard deviation of noise on the expert's actions."""
    learning_rate: float | None = None
    """Of Adam."""
    min_speed: float | None = None
    """Gate: predicted mean speed below which the expert takes over, m/s."""
    gate: (
        Literal["unsafe_or_slow", "low_return", "deviates_from_expert", "action_probability"] | None
    ) = None
    """What makes the expert take over (default: the paper's rule for the world)."""
    min_return: float | None = None
    """Gate low_return: predicted return at or below which the expert takes over."""
    max_departure: float | None = None
    """Gate deviates_from_expert: how far from the expert's own path, in the world's units."""
    min_log_density: float | None = None
    """Gate action_probability: log-density under a neural expert below which it takes over."""
    discount: float | None = None
    """gamma, of methods with action values."""
    polyak_tau: float | None = None
    """tau of target networks."""
    margin: float | None = None
    """EIL: hinge margins."""
    conservative_weight: float | None = None
    """HACO: weight of raising the expert's values over the novice's."""
    max_ensemble_variance: float | None = None
    """Ensemble-DAgger: variance of the members above which the expert acts."""
    max_discrepancy: float | None = None
    """Ensemble-DAgger: squared distance from the expert's action above which the expert acts."""
    switch_rate: float | None = None
    """Thrifty-DAgger: share of the novice's states that each test is to hand to the expert."""
    discriminator_rate: float | None = None
    """GAIL: learning rate of the discriminator."""
    survival_correction: float | None = None
    """GAIL: 1 for the reward log D - log(1 - D), 0 for -log(1 - D)."""
    members: int | None = None
    """Policies of an ensemble."""
    rollout_steps: int | None = None
    """GAIL: steps between updates."""
    batch_size: int | None = None
    """Samples per loss and update."""
    predictor: Literal["simulator", "kinematic"] | None = None
    """The world's own transition, or the rule-based bicycle with traffic frozen."""
    expert: tuple[Literal["recorded"], str] | str = "scripted"
    """scripted, neural (the shipped one), a policy file or run folder; or recorded PATH, a session
    of `ppl play`."""
    scenarios: str | None = None
    """Folder of recorded scenarios to train on."""
    held_out_scenarios: str | None = None
    """Folder of recorded scenarios to evaluate on (default: those of --scenarios)."""
    evaluate_every: int | None = None
    """Steps between evaluations and checkpoints (default: a tenth of the run)."""
    evaluate_on: Literal["held_out", "training"] = "held_out"
    """Scenarios that are evaluated on; choose settings by the training ones."""
    out: Path | None = None
    """Run folder (default: runs/ENV-ALGORITHM-SEED-TIME)."""
    resume: bool = False
    """Go on with the run in --out."""


@dataclasses.dataclass
class Evaluate:
    """Play every held-out scenario once with a trained policy."""

    run: Positional[Path]
    """Run folder, or an exported policy file."""
    scenarios: str | None = None
    """Folder of recorded scenarios to play instead of the run's own held-out ones."""
    out: Path | None = None
    """Write one row per scenario to this CSV file."""


@dataclasses.dataclass
class Compare:
    """Train all methods with the same seeds; one table."""

    env: Positional[str]
    """World: driving, table_wiping or nut_assembly."""
    algorithms: tuple[str, ...] = ()
    """Methods (default: all)."""
    seeds: int = 5
    """Seeds 0, 1, ..., each method the same."""
    total_steps: int | None = None
    """Environment steps of each run (bc and gail keep their own)."""
    evaluate_every: int | None = None
    """Steps between evaluations (default: a tenth of the run)."""
    gate: (
        Literal["unsafe_or_slow", "low_return", "deviates_from_expert", "action_probability"] | None
    ) = None
    """What makes the expert take over (default: the paper's rule for the world)."""
    min_return: float | None = None
    """Gate low_return: predicted return at or below which the expert takes over."""
    max_departure: float | None = None
    """Gate deviates_from_expert: how far from the expert's own path, in the world's units."""
    min_log_density: float | None = None
    """Gate action_probability: log-density under a neural expert below which it takes over."""
    batch_size: int | None = None
    """Samples per loss and update."""
    preset: Literal["default", "paper", "reference"] = "default"
    """Settings to start from."""
    scenarios: str | None = None
    """Folder of recorded scenarios to train on."""
    held_out_scenarios: str | None = None
    """Folder of recorded scenarios to evaluate on."""
    expert: str | None = None
    """scripted (the default), neural (the shipped one), or a policy file or run folder."""
    processes: int = 2
    """Runs at the same time; as many as there are cores get one each."""
    out: Path = Path("compare")
    """Folder of the runs and result files; finished runs in it are kept."""


@dataclasses.dataclass
class Ablation:
    """Train the ten rows of the paper's ablation with the same seeds; one table."""

    env: Positional[str]
    """World: driving, table_wiping or nut_assembly."""
    seeds: int = 5
    """Seeds 0, 1, ..., each row the same."""
    total_steps: int | None = None
    """Environment steps of each run."""
    reference_steps: int = 10_000
    """Expert steps that the reference policy of DPO and IPO clones."""
    evaluate_every: int | None = None
    """Steps between evaluations (default: a tenth of the run)."""
    batch_size: int | None = None
    """Samples per loss and update."""
    preset: Literal["default", "paper", "reference"] = "default"
    """Settings to start from."""
    expert: str | None = None
    """scripted (the default), neural (the shipped one), or a policy file or run folder."""
    processes: int = 2
    """Runs at the same time; as many as there are cores get one each."""
    out: Path = Path("ablation")
    """Folder of the runs and result files; finished runs in it are kept."""


@dataclasses.dataclass
class Tune:
    """Try the declared grid of every method, on training scenarios; one table."""

    env: Positional[str]
    """World: driving, table_wiping or nut_assembly."""
    algorithms: tuple[str, ...] = ()
    """Methods (default: all)."""
    seeds: int = 2
    """Seeds 0, 1, ..."""
    total_steps: int = 3000
    """Environment steps of each run (bc keeps its own)."""
    evaluate_every: int = 1000
    """Steps between evaluations."""
    gail_steps: int = 120_000
    """Environment steps of gail."""
    batch_size: int | None = None
    """Samples per loss and update."""
    expert: str | None = None
    """scripted (the default), neural (the shipped one), or a policy file or run folder."""
    processes: int = 2
    """Runs at the same time; as many as there are cores get one each."""
    out: Path = Path("tune")
    """Folder of the runs and of tuning.csv; finished runs in it are kept."""


@dataclasses.dataclass
class ExpertTrain:
    """Train a neural expert by PPO-Lagrangian: progress, then the evaluation table; a run folder.

    Defaults are those of the world's shipped expert.
    """

    env: Positional[str]
    """World: driving, table_wiping, nut_assembly, or brax:NAME."""
    seed: int = 0
    """Random seed."""
    total_steps: int | None = None
    """Environment steps."""
    num_envs: int | None = None
    """Worlds stepped side by side."""
    rollout_steps: int | None = None
    """Steps of each world per batch."""
    epochs: int | None = None
    """Passes over a batch."""
    num_minibatches: int | None = None
    """Updates per pass."""
    hidden: tuple[int, ...] | None = None
    """Widths of the hidden layers of policy and critics."""
    scaling: Literal["running", "world"] | None = None
    """Inputs are scaled by running statistics, or by the world's constants."""
    demonstrations: int | None = None
    """Steps that the scripted expert labels, under noise, and that the policy clones first."""
    demonstration_stride: int | None = None
    """Of these every so many are kept."""
    demonstration_rounds: int | None = None
    """Rounds of these: the expert plays the first, the clone the others."""
    cloning: Literal["laplace", "gaussian"] | None = None
    """Likelihood that is cloned: for the median or the mean of what the expert does."""
    cloning_updates: int | None = None
    """Updates of that."""
    demonstration_noise: float | None = None
    """Standard deviation of that noise."""
    guided: bool | None = None
    """The expert also says at every step of the training what it would do."""
    guidance_weight: float | None = None
    """Of the distance from that."""
    critic_batches: int | None = None
    """Batches at the start in which only the critics learn."""
    learning_rate: float | None = None
    """Of Adam; falls linearly to 0."""
    discount: float | None = None
    """gamma of the reward."""
    cost_discount: float | None = None
    """gamma of the cost."""
    gae_lambda: float | None = None
    """lambda of the generalised advantages."""
    clip: float | None = None
    """PPO's bound on the ratio."""
    target_kl: float | None = None
    """KL at which a batch's policy updates stop."""
    max_grad_norm: float | None = None
    """Norm to which gradients are clipped."""
    entropy_coef: float | None = None
    """Weight of the policy's entropy."""
    cost_limit: float | None = None
    """Mean cost per episode that is allowed."""
    terminate_on_cost: float | None = None
    """1 where nothing is worth anything after a step that costs, 0 otherwise."""
    initial_multiplier: float | None = None
    """Of the cost, at the start."""
    lagrangian_lr: float | None = None
    """Adam's rate for the multiplier."""
    initial_std: float | None = None
    """Standard deviation of the actions at the start."""
    min_std: float | None = None
    """Standard deviation of the actions at least."""
    final_std: float | None = None
    """Bound on it at the end."""
    success_bonus: float | None = None
    """Reward for solving the task, while training."""
    training_scenarios: int | None = None
    """Generated scenarios to train on, numbered from 10,000; 0 for the novice's."""
    scenarios: str | None = None
    """Folder of recorded scenarios to train on."""
    held_out_scenarios: str | None = None
    """Folder of recorded scenarios to evaluate on (default: those of --scenarios)."""
    evaluate_every: int | None = None
    """Batches between evaluations and checkpoints (default: a fortieth of the run)."""
    out: Path | None = None
    """Run folder (default: runs/ENV-expert-SEED-TIME)."""
    resume: bool = False
    """Go on with the run in --out."""


@dataclasses.dataclass
class ExpertEvaluate:
    """Play every held-out scenario once with an expert."""

    env: Positional[str]
    """World: driving, table_wiping, nut_assembly, or brax:NAME."""
    kind: str = "neural"
    """neural (the shipped one), scripted, or a policy file or run folder."""
    scenarios: str | None = None
    """Folder of recorded scenarios to play instead of the held-out ones."""
    out: Path | None = None
    """Write one row per scenario to this CSV file."""


@dataclasses.dataclass
class ExpertCard:
    """Write a trained expert's policy, its curve and a card that says how it was made."""

    run: Positional[Path]
    """Run folder of `ppl expert train`."""
    out: Path = Path("envs/pretrained")
    """Folder to write to."""


_NO_AXES = (
    "env",
    "algorithm",
    "seed",
    "preset",
    "total_steps",
    "evaluate_every",
    "evaluate_on",
    "expert",
    "reference_policy",
    "scenarios",
    "held_out_scenarios",
    "out",
    "resume",
)


def _axes() -> type:
    """A dataclass with several values of every setting of `Train` that a sweep may vary."""
    hints = get_type_hints(Train)
    fields = []
    for field in dataclasses.fields(Train):
        if field.name not in _NO_AXES:
            kinds = tuple(part for part in get_args(hints[field.name]) if part is not type(None))
            kind = Union[kinds]  # noqa: UP007
            told = tyro.conf.arg(help=f"Values of {field.name}; see `ppl train --help`.")
            fields.append((field.name, Annotated[tuple[kind, ...], told], ()))
    return dataclasses.make_dataclass("Axes", fields)


Axes = _axes()


@dataclasses.dataclass
class Sweep:
    """Train every combination of settings with every seed; resumes.

    Give several values of any setting, or a study that names them.
    """

    envs: Positional[tuple[str, ...]]
    """Worlds: driving, table_wiping, nut_assembly."""
    study: (
        Literal["horizon", "horizon_beta", "prediction_noise", "expert_noise", "predictor"] | None
    ) = None
    """A grid of the paper's: L, L x beta, noise of predicted states or of the expert, predictors.
    Values given replace the study's."""
    algorithms: tuple[str, ...] = ()
    """Methods (default: ppl, or the study's)."""
    seeds: int = 5
    """Seeds 0, 1, ..., the same everywhere."""
    preset: Literal["default", "paper", "reference"] = "default"
    """Settings to start from."""
    total_steps: int | None = None
    """Environment steps of each run."""
    evaluate_every: int | None = None
    """Steps between evaluations (default: a tenth of the run)."""
    expert: str = "scripted"
    """scripted, neural (the shipped one), or a policy file or run folder."""
    scenarios: str | None = None
    """Folder of recorded scenarios to train on."""
    held_out_scenarios: str | None = None
    """Folder of recorded scenarios to evaluate on."""
    axes: OmitArgPrefixes[Axes] = dataclasses.field(default_factory=Axes)
    """Values of the settings."""
    engine: Literal["local", "ray"] = "local"
    """Processes of this machine, or tasks of a Ray cluster."""
    address: str | None = None
    """Engine ray: of a running cluster (default: one on this machine)."""
    processes: int = 2
    """Engine local, on a CPU: runs at the same time; as many as there are cores get one each."""
    batch: int | None = None
    """Runs per program (default: one on a CPU, on accelerators what memory holds)."""
    dry_run: bool = False
    """Say how much work it is, and stop."""
    out: Path = Path("sweep")
    """Folder of the result files; finished runs in it are kept."""


@dataclasses.dataclass
class Robustness(Sweep):
    """Train under noise on predicted states (or on the expert's actions); resumes."""

    study: Literal["prediction_noise", "expert_noise"] = "prediction_noise"
    """Whose noise."""
    out: Path = Path("robustness")
    """Folder of the result files; finished runs in it are kept."""


@dataclasses.dataclass
class Expert:
    """Train, evaluate or describe an expert."""

    command: OmitSubcommandPrefixes[
        Annotated[ExpertTrain, subcommand("train")]
        | Annotated[ExpertEvaluate, subcommand("evaluate")]
        | Annotated[ExpertCard, subcommand("card")]
    ]
    """What to do."""


@dataclasses.dataclass
class Horizon:
    """Measure along runs of ppl what a longer preference horizon buys and costs."""

    env: Positional[str]
    """World: driving, table_wiping or nut_assembly."""
    seeds: int = 3
    """Seeds 0, 1, ..., one run each."""
    total_steps: int | None = None
    """Environment steps of each run."""
    measure_every: int | None = None
    """Steps between measurements (default: a fifth of the run)."""
    batch_size: int | None = None
    """Samples per loss and update."""
    expert: str = "scripted"
    """scripted, neural (the shipped one), or a policy file or run folder."""
    out: Path = Path("horizon.csv")
    """File to write."""


@dataclasses.dataclass
class Table:
    """Print results as a table: Markdown, LaTeX or plain."""

    results: Positional[Path]
    """Folder of ppl sweep, compare or ablation, or its results.csv."""
    step: int | None = None
    """Environment steps (default: the end of each run)."""
    format: Literal["text", "markdown", "latex"] = "text"
    """How to write it."""
    against: str | None = None
    """Row that the others are compared with (default: the first)."""
    paper: bool = False
    """Show the paper's own figures beside ours."""
    env: str | None = None
    """World of results that do not name theirs (those of ppl compare)."""


@dataclasses.dataclass
class Figure:
    """Draw results."""

    results: Positional[Path]
    """Folder of ppl sweep, compare or ablation, its results.csv, a folder of experts' cards, or
    (kind steering) a run folder or policy file."""
    other: Positional[tuple[Path, ...]] = ()
    """Kind steering: more of them; kind horizon: results over L, to show beside."""
    kind: (
        Literal["curves", "axis", "heatmap", "training", "experts", "steering", "horizon"] | None
    ) = None
    """Learning curves; success over one setting, or two; takeovers and cost in training; training
    of experts; steering on one map; what L buys and costs (default: what the results have)."""
    column: Literal["success", "progress", "episodic_return", "episodic_cost"] = "success"
    """What is drawn."""
    steps: tuple[int, ...] = ()
    """Kind axis: steps to draw (default: the end of each run)."""
    scenario: int = 1000
    """Kind steering: number of a held-out scenario."""
    out: Path = Path("figure.png")
    """File to write; its ending decides how."""


@dataclasses.dataclass
class Export:
    """Write a run's policy as one file that plain NumPy can run."""

    run: Positional[Path]
    """Run folder."""
    out: Path = Path("policy.npz")
    """File to write."""


@dataclasses.dataclass
class Render:
    """Draw one episode of a policy as GIF, MP4 or PNG (the file's ending decides)."""

    run: Positional[str]
    """Run folder, policy file, "scripted" or "neural"."""
    scenario: int = 1000
    """Number of a held-out scenario."""
    out: Path = Path("episode.gif")
    """File to write."""
    steps: int = 600
    """At most so many steps."""
    env: str = "driving"
    """World of "scripted" and "neural": driving, table_wiping or nut_assembly."""


@dataclasses.dataclass
class Play:
    """Train a policy yourself: watch it in a browser and take over when it is about to fail."""

    env: Positional[str | None] = None
    """Environment: driving, table_wiping or nut_assembly; with --resume that of the folder."""
    algorithm: str = "ppl"
    """Method that learns from you: ppl, pvp, hg_dagger, iwr, eil or haco."""
    seed: int = 0
    """Random seed."""
    total_steps: int | None = None
    """Steps of the session."""
    preference_horizon: int | Literal["auto"] | None = None
    """L: predicted states that get a preference pair."""
    beta: float | None = None
    """Temperature of the preference loss."""
    learning_rate: float | None = None
    """Of Adam."""
    manual_episodes: int = 0
    """Number of episodes at the start in which you make every step."""
    participant: str = ""
    """Your name in a study: at most 32 letters, digits, - and _."""
    consent: Path | None = None
    """Text file to agree to before anything starts."""
    familiarisation: int = 0
    """Successes in a row, driving alone, before steps count (the paper: 10)."""
    questions: Path | None = None
    """JSON file of questions asked after every episode."""
    rate: float | None = None
    """Steps per second (default: the environment's own, 10 in driving and 20 for the arm)."""
    scenarios: str | None = None
    """Folder of recorded scenarios to train on."""
    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = 8765
    """Port to listen on; 0 takes a free one."""
    expose: bool = False
    """Allow a host that others on the network can reach."""
    evaluate: bool = True
    """Play the held-out scenarios at the end."""
    out: Path | None = None
    """Run folder (default: runs/ENV-ALGORITHM-SEED-TIME)."""
    resume: bool = False
    """Continue the session in --out; its settings come from there."""
    words: tyro.conf.Suppress[tuple[str, ...]] = ()


@dataclasses.dataclass
class Replay:
    """Watch a recorded session in a browser."""

    recording: Positional[Path]
    """Run folder of `ppl play`, or an exported session."""
    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = 8765
    """Port to listen on; 0 takes a free one."""
    expose: bool = False
    """Allow a host that others on the network can reach."""


@dataclasses.dataclass
class Recording:
    """Write a session of `ppl play` as one file that NumPy (or Minari) can read."""

    run: Positional[Path]
    """Run folder."""
    out: Path = Path("session.npz")
    """File to write."""
    minari: str | None = None
    """Write a Minari data set of this name instead, such as driving/person-v0."""


@dataclasses.dataclass
class Bench:
    """Measure speed, as ratios within one run."""

    repeats: int = 5
    """Repeats of each figure; medians are reported."""
    parts: tuple[Literal["worlds", "training", "experts", "methods", "seeds", "sweep"], ...] = (
        "worlds",
        "training",
        "experts",
        "methods",
    )
    """What to measure; seeds (methods, and five seeds of each in one program) and sweep (64 runs
    against single ones) take long."""
    out: Path | None = None
    """Also write the figures to this JSON file."""


@dataclasses.dataclass
class Doctor:
    """Say what this machine has, and what to do about what is missing."""


Command = (
    Annotated[Train, subcommand("train")]
    | Annotated[Evaluate, subcommand("evaluate")]
    | Annotated[Compare, subcommand("compare")]
    | Annotated[Ablation, subcommand("ablation")]
    | Annotated[Tune, subcommand("tune")]
    | Annotated[Sweep, subcommand("sweep")]
    | Annotated[Robustness, subcommand("robustness")]
    | Annotated[Horizon, subcommand("horizon")]
    | Annotated[Table, subcommand("table")]
    | Annotated[Figure, subcommand("figure")]
    | Annotated[Expert, subcommand("expert")]
    | Annotated[Export, subcommand("export")]
    | Annotated[Render, subcommand("render")]
    | Annotated[Play, subcommand("play")]
    | Annotated[Replay, subcommand("replay")]
    | Annotated[Recording, subcommand("recording")]
    | Annotated[Bench, subcommand("bench")]
    | Annotated[Doctor, subcommand("doctor")]
)


MOST_PAIRS = 10  # that preference_horizon "auto" may choose


def run_settings(command: Train):
    """Turn the command line into settings of a run."""
    from experiments.engine.recorded import length_of, recording_of
    from experiments.engine.run import RunSettings
    from ppl_jax.algorithms import settings

    try:
        config, hparams = settings(command.algorithm, command.env, command.preset)
    except ValueError as error:
        raise UserError(str(error)) from error
    given = {
        name: value for name, value in dataclasses.asdict(command).items() if value is not None
    }
    static = {f.name: given[f.name] for f in dataclasses.fields(config) if f.name in given}
    if given.get("preference_horizon") == "auto":
        static["adaptive_horizon"] = True
        longest = static.get("prediction_horizon", config.prediction_horizon)
        given["preference_horizon"] = max(1, min(MOST_PAIRS, longest))
    expert = command.expert if isinstance(command.expert, str) else " ".join(command.expert)
    if expert == "recorded":
        raise UserError("expert recorded needs the session: --expert recorded PATH")
    if (path := recording_of(expert)) is not None:
        whole = length_of(path, command.env) // config.decision_interval
        static.setdefault("total_steps", whole * config.decision_interval)
    if "total_steps" in static and "demonstrations" not in static:
        static["demonstrations"] = min(config.demonstrations, max(static["total_steps"], 0))
        if not static["demonstrations"]:
            static.setdefault("offline_updates", 0)
    if "prediction_horizon" in static:
        static["max_preference_horizon"] = max(
            1, min(config.max_preference_horizon, static["prediction_horizon"])
        )
    traced = {f.name: given[f.name] for f in dataclasses.fields(hparams) if f.name in given}
    horizon = traced.get("preference_horizon", 0)
    final = dataclasses.replace(config, **static)
    if horizon <= final.prediction_horizon:
        wider = max(final.max_preference_horizon, horizon)
        final = dataclasses.replace(final, max_preference_horizon=wider)
    return RunSettings(
        env=command.env,
        algorithm=command.algorithm,
        seed=command.seed,
        config=final,
        hparams=hparams.replace(**traced),
        expert=expert,
        reference_policy=command.reference_policy,
        scenarios=command.scenarios,
        held_out_scenarios=command.held_out_scenarios,
        evaluate_on=command.evaluate_on,
        evaluate_every=(
            default_interval(final) if command.evaluate_every is None else command.evaluate_every
        ),
    )


def default_interval(config) -> int:
    """A tenth of what follows the demonstrations, in whole decisions."""
    steps = config.total_steps - config.demonstrations
    return max(steps // 10 // config.decision_interval, 1) * config.decision_interval


def _train(command: Train) -> None:
    from experiments.engine.run import check, train
    from experiments.engine.runtime import start_jax
    from experiments.report.tables import print_run

    settings = run_settings(command)
    every = min(settings.evaluate_every, max(settings.config.total_steps, 1))
    settings = dataclasses.replace(settings, evaluate_every=every)
    check(settings)
    if command.resume and command.out is None:
        raise UserError("--resume needs --out, the run folder to go on with")
    out = command.out or _new_folder(command)
    start_jax()
    train(settings, out, command.resume)
    print_run(out)


def _evaluate(command: Evaluate) -> None:
    from experiments.engine.evaluate import evaluate_run
    from experiments.engine.runtime import start_jax
    from experiments.report.tables import print_evaluation

    start_jax()
    rows = evaluate_run(command.run, command.scenarios)
    if command.out is not None:
        from experiments.report.tables import write_rows

        write_rows(command.out, [row._asdict() for row in rows])
    print_evaluation(str(command.run), rows)


def _compare(command: Compare) -> None:
    from experiments.report import paper
    from experiments.report.tables import EPISODES, print_comparison
    from experiments.studies.compare import compare

    try:
        compare(command)
    finally:
        print_comparison(command.out / EPISODES, paper.METHODS.get(command.env, {}))


def _ablation(command: Ablation) -> None:
    from experiments.report import paper
    from experiments.report.tables import EPISODES, print_comparison
    from experiments.studies.ablation import ablation

    try:
        ablation(command)
    finally:
        print_comparison(command.out / EPISODES, paper.ABLATION)


def _tune(command: Tune) -> None:
    from experiments.studies.tune import tune

    tune(command)


def _sweep(command: Sweep) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.studies.runner import sweep

    start_jax()
    sweep(command)


def _horizon(command: Horizon) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.studies.horizon import measure_horizon

    start_jax()
    measure_horizon(command)
    print(f"wrote {command.out}")


def _table(command: Table) -> None:
    from experiments.report.points import table

    table(command)


def _figure(command: Figure) -> None:
    from experiments.report.figures import figure

    figure(command)
    print(f"wrote {command.out}")


def _expert(command: Expert) -> None:
    if isinstance(command.command, ExpertTrain):
        _expert_train(command.command)
    elif isinstance(command.command, ExpertEvaluate):
        _expert_evaluate(command.command)
    else:
        from experiments.report.card import write_card

        write_card(command.command.run, command.command.out)


def _expert_train(command: ExpertTrain) -> None:
    from experiments.engine.expert import (
        EVALUATIONS,
        ExpertSettings,
        check,
        settings_for,
        train_expert,
    )
    from experiments.engine.runtime import start_jax
    from experiments.report.tables import print_run

    config, hparams, training = settings_for(command.env)
    given = {name: value for name, value in vars(command).items() if value is not None}
    static = {f.name: given[f.name] for f in dataclasses.fields(config) if f.name in given}
    traced = {f.name: given[f.name] for f in dataclasses.fields(hparams) if f.name in given}
    config = dataclasses.replace(config, **static)
    settings = ExpertSettings(
        env=command.env,
        seed=command.seed,
        config=config,
        hparams=dataclasses.replace(hparams, **traced),
        scenarios=command.scenarios,
        held_out_scenarios=command.held_out_scenarios,
        training_scenarios=given.get(
            "training_scenarios", training if command.scenarios is None else 0
        ),
        evaluate_every=given.get("evaluate_every", 1),
    )
    check(settings)
    if command.evaluate_every is None:
        every = max(config.batches // EVALUATIONS, 1)
        settings = dataclasses.replace(settings, evaluate_every=every)
    if command.resume and command.out is None:
        raise UserError("--resume needs --out, the run folder to go on with")
    name = f"{command.env.replace(':', '-')}-expert-{command.seed}"
    out = command.out or Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
    start_jax()
    train_expert(settings, out, command.resume)
    print_run(out)


def _expert_evaluate(command: ExpertEvaluate) -> None:
    from experiments.engine.evaluate import make_world
    from experiments.engine.expert import evaluate_expert
    from experiments.engine.runtime import start_jax
    from experiments.report.tables import print_evaluation, write_rows

    start_jax()
    options = {} if command.scenarios is None else {"held_out_scenarios": command.scenarios}
    rows = evaluate_expert(make_world(command.env, options), command.kind)
    if command.out is not None:
        write_rows(command.out, [row._asdict() for row in rows])
    print_evaluation(f"{command.kind} expert", rows)


def _export(command: Export) -> None:
    import shutil

    from experiments.engine.evaluate import policy_path, read_policy, run_spec

    source = policy_path(command.run)
    read_policy(source, run_spec(command.run))
    shutil.copyfile(source, command.out)
    print(f"wrote {command.out}")


def _render(command: Render) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.report.film import render

    start_jax()
    render(command.run, command.scenario, command.out, command.steps, command.env)
    print(f"wrote {command.out}")


def _play(command: Play) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.ui.options import named_options
    from experiments.ui.play import new_session, play, read_consent, read_questions, resumed

    given = named_options(command, command.words)
    if command.consent is not None:
        given["consent"] = read_consent(command.consent)
    if command.questions is not None:
        given["questions"] = read_questions(command.questions)
    if command.resume:
        if command.out is None:
            raise UserError("--resume needs --out, the run folder to continue")
        out = command.out
        settings, session_config = resumed(out, given)
    else:
        if command.env is None:
            raise UserError("env: name the environment, such as driving")
        shared = {f.name for f in dataclasses.fields(Train)}
        asked = {name: value for name, value in given.items() if name in shared}
        train = Train(**asked, expert="person")
        settings, session_config = run_settings(train), new_session(command.env, given)
        out = command.out or _new_folder(train)
    start_jax()
    play(
        settings,
        out,
        session_config,
        resume=command.resume,
        host=command.host,
        port=command.port,
        exposed=command.expose,
    )


def _new_folder(command: Train) -> Path:
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return Path("runs") / f"{command.env}-{command.algorithm}-{command.seed}-{stamp}"


def _replay(command: Replay) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.ui.replay import replay

    start_jax()
    replay(command.recording, command.host, command.port, command.expose)


def _recording(command: Recording) -> None:
    from experiments.engine.recording import export, export_minari

    if command.minari is not None:
        steps = export_minari(command.run, command.minari)
        print(f"wrote {steps} steps to the Minari data set {command.minari}")
        return
    steps = export(command.run, command.out)
    print(f"wrote {steps} steps to {command.out}")


def _bench(command: Bench) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.tools.bench import bench

    start_jax()
    bench(command.repeats, command.parts, command.out)


def _doctor(command: Doctor) -> None:
    from experiments.tools.doctor import doctor

    doctor()


_ACTIONS = {
    Train: _train,
    Evaluate: _evaluate,
    Compare: _compare,
    Ablation: _ablation,
    Tune: _tune,
    Sweep: _sweep,
    Robustness: _sweep,
    Horizon: _horizon,
    Table: _table,
    Figure: _figure,
    Expert: _expert,
    Export: _export,
    Render: _render,
    Play: _play,
    Replay: _replay,
    Recording: _recording,
    Bench: _bench,
    Doctor: _doctor,
}


def main(argv: list[str] | None = None) -> None:
    """Entry point; exits with 0, 1 (the run broke) or 2 (a mistake in what was asked for)."""
    set_xla_flags()  # first of all: XLA reads them once, when JAX is first used
    words = sys.argv[1:] if argv is None else argv
    if words == [SERVE]:
        from experiments.engine.worker import serve

        return serve()
    command = tyro.cli(Command, prog="ppl", args=words, description=__doc__)
    if isinstance(command, Play):
        command.words = tuple(words)
    try:
        _ACTIONS[type(command)](command)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:  # whoever read the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except KeyboardInterrupt:
        print("interrupted; what was saved is kept", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
