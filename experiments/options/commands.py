"""Options of the commands beside the settings of a run."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from tyro.conf import Fixed, OmitSubcommandPrefixes, Positional, Suppress, arg, subcommand

from experiments.options.hints import hide_unset
from experiments.options.seeds import Seeds


@hide_unset
@dataclasses.dataclass
class Evaluate:
    """Play every held-out scenario once with a trained policy."""

    run: Positional[Path]
    """Run folder, or an exported policy file."""
    scenarios: str | None = None
    """Folder of recorded scenarios to play instead of the run's own held-out ones."""
    physics: str | None = None
    """Physics engine of the environment (default: the run's own); `ppl list` names them."""
    out: Path | None = None
    """Write one row per scenario to this CSV file."""


@hide_unset
@dataclasses.dataclass
class Compare:
    """Train all methods with the same seeds; one table."""

    env: Positional[str]
    """Environment; `ppl list` names them."""
    algorithms: tuple[str, ...] = ()
    """Methods (default: all)."""
    seeds: Seeds = tuple(range(5))
    """How many (5), which (3 7 11) or a range (10-19); each method the same."""
    total_steps: int | None = None
    """Environment steps of each run (bc and gail keep their own)."""
    evaluate_every: int | None = None
    """Steps between evaluations (default: a tenth of the run)."""
    evaluate_on: str = "held_out"
    """Scenarios that are played: held_out, training, or a set that `ppl list` names."""
    gate: str | None = None
    """Rule by which the expert takes over (default: the paper's rule for the environment)."""
    min_return: float | None = None
    """Gate low_return: predicted return at or below which the expert takes over."""
    max_departure: float | None = None
    """Gate deviates_from_expert: how far from the expert's own path, in the environment's units."""
    min_log_density: float | None = None
    """Gate action_probability: log-density under a neural expert below which it takes over."""
    batch_size: int | None = None
    """Samples per loss and update."""
    physics: str | None = None
    """Physics engine of the environment (default: auto); `ppl list` names them."""
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


@hide_unset
@dataclasses.dataclass
class Ablation:
    """Train the ten rows of the paper's ablation with the same seeds; one table."""

    env: Positional[str]
    """Environment; `ppl list` names them."""
    seeds: Seeds = tuple(range(5))
    """How many (5), which (3 7 11) or a range (10-19); each row the same."""
    total_steps: int | None = None
    """Environment steps of each run."""
    reference_steps: int = 10_000
    """Expert steps that the reference policy of DPO and IPO clones."""
    evaluate_every: int | None = None
    """Steps between evaluations (default: a tenth of the run)."""
    evaluate_on: str = "held_out"
    """Scenarios that are played: held_out, training, or a set that `ppl list` names."""
    batch_size: int | None = None
    """Samples per loss and update."""
    physics: str | None = None
    """Physics engine of the environment (default: auto); `ppl list` names them."""
    preset: Literal["default", "paper", "reference"] = "default"
    """Settings to start from."""
    expert: str | None = None
    """scripted (the default), neural (the shipped one), or a policy file or run folder."""
    processes: int = 2
    """Runs at the same time; as many as there are cores get one each."""
    out: Path = Path("ablation")
    """Folder of the runs and result files; finished runs in it are kept."""


@hide_unset
@dataclasses.dataclass
class Tune:
    """Search settings for every method alike, in two rounds, on tuning scenarios; one table.

    It resumes.
    """

    env: Positional[str]
    """Environment; `ppl list` names them."""
    algorithms: tuple[str, ...] = ()
    """Methods (default: all)."""
    seeds: Seeds = (0, 1)
    """Of the first round: how many (5), which (3 7 11) or a range (10-19)."""
    final_seeds: Seeds = (2, 3, 4, 5)
    """Of the second round, fresh ones."""
    total_steps: int | None = None
    """Environment steps of each run (bc and gail keep their own)."""
    evaluate_every: int | None = None
    """Steps between evaluations (default: a fifth of the run)."""
    gail_steps: int = 120_000
    """Environment steps of gail."""
    batch_size: int | None = None
    """Samples per loss and update."""
    physics: str | None = None
    """Physics engine of the environment (default: auto); `ppl list` names them."""
    expert: str | None = None
    """scripted (the default), neural (the shipped one), or a policy file or run folder."""
    processes: int = os.cpu_count() or 1
    """Runs at the same time; as many as there are cores get one each."""
    out: Path = Path("tune")
    """Folder of the runs and of tuning.csv; finished runs in it are kept."""


@hide_unset
@dataclasses.dataclass
class ExpertTrain:
    """Train a neural expert by PPO-Lagrangian: progress, then its evaluation; a run folder."""

    # its options are generated when it is asked for: see `experiments.options.expert`


@hide_unset
@dataclasses.dataclass
class ExpertEvaluate:
    """Play every held-out scenario once with an expert."""

    env: Positional[str]
    """Environment (`ppl list` names them), or brax:NAME."""
    kind: str = "neural"
    """neural (the shipped one), scripted, or a policy file or run folder."""
    scenarios: str | None = None
    """Folder of recorded scenarios to play instead of the held-out ones."""
    physics: str | None = None
    """Physics engine of the environment (default: auto); `ppl list` names them."""
    out: Path | None = None
    """Write one row per scenario to this CSV file."""


@hide_unset
@dataclasses.dataclass
class ExpertCard:
    """Write a trained expert's policy, its curve and a card that says how it was made."""

    run: Positional[Path]
    """Run folder of `ppl expert train`."""
    out: Path = Path("expert_card")
    """Folder to write to; never the package's own `envs/pretrained`."""
    force: bool = False
    """Replace the files of an earlier card in --out."""


@hide_unset
@dataclasses.dataclass(frozen=True)
class Sweep:
    """Train every combination of settings with every seed; resumes.

    Give several values of any setting, or a study that names them.
    """

    envs: Positional[tuple[str, ...]]
    """Environments; `ppl list` names them."""
    study: str | None = None
    """A grid of the paper's: L, L x beta, noise of predicted states or of the expert, predictors.
    Values given replace the study's."""
    algorithms: tuple[str, ...] = ()
    """Methods (default: ppl, or the study's)."""
    seeds: Seeds = tuple(range(5))
    """How many (5), which (3 7 11) or a range (10-19); the same everywhere."""
    preset: Literal["default", "paper", "reference"] = "default"
    """Settings to start from."""
    total_steps: int | None = None
    """Environment steps of each run."""
    randomise: bool = False
    """Draw each scenario's dynamics within the environment's ranges, which are axes then."""
    evaluate_every: int | None = None
    """Steps between evaluations (default: a tenth of the run)."""
    evaluate_on: str = "held_out"
    """Scenarios that are played: held_out, training, or a set that `ppl list` names."""
    expert: str = "scripted"
    """scripted, neural (the shipped one), or a policy file or run folder."""
    scenarios: str | None = None
    """Folder of recorded scenarios to train on."""
    held_out_scenarios: str | None = None
    """Folder of recorded scenarios to evaluate on."""
    axes: Suppress[Fixed[dict[str, tuple[Any, ...]]]] = dataclasses.field(default_factory=dict)
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


@hide_unset
@dataclasses.dataclass(frozen=True)
class Robustness(Sweep):
    """Train under noise on predicted states, on the expert's actions, or in randomised worlds.

    It resumes.
    """

    study: Literal[
        "prediction_noise",
        "expert_noise",
        "friction",
        "mass",
        "damping",
        "gains",
        "start_noise",
        "sensor_noise",
    ] = "prediction_noise"
    """Whose noise, or what each scenario draws within ever wider ranges."""
    out: Path = Path("robustness")
    """Folder of the result files; finished runs in it are kept."""


def expert_command(train: type) -> type:
    """The class of `ppl expert`.

    Args:
        train: Class of its `train`.
    """
    parts: tuple[Any, ...] = (
        Annotated[train, subcommand("train")],
        Annotated[ExpertEvaluate, subcommand("evaluate")],
        Annotated[ExpertCard, subcommand("card")],
    )
    command = parts[0] | parts[1] | parts[2]
    made = dataclasses.make_dataclass(
        "Expert", [("command", Annotated[OmitSubcommandPrefixes[command], arg(name="")])]
    )
    made.__doc__ = "Train, evaluate or describe an expert."
    return made


Expert = expert_command(ExpertTrain)


@hide_unset
@dataclasses.dataclass
class Horizon:
    """Measure along runs of ppl what a longer preference horizon buys and costs."""

    env: Positional[str]
    """Environment; `ppl list` names them."""
    seeds: Seeds = tuple(range(3))
    """How many (5), which (3 7 11) or a range (10-19); one run each."""
    total_steps: int | None = None
    """Environment steps of each run."""
    measure_every: int | None = None
    """Steps between measurements (default: a fifth of the run)."""
    batch_size: int | None = None
    """Samples per loss and update."""
    physics: str | None = None
    """Physics engine of the environment (default: auto); `ppl list` names them."""
    expert: str = "scripted"
    """scripted, neural (the shipped one), or a policy file or run folder."""
    out: Path = Path("horizon.csv")
    """File to write."""


@hide_unset
@dataclasses.dataclass
class Table:
    """Print results as a table: Markdown, LaTeX or plain."""

    results: Positional[Path]
    """Run folder; folder of ppl sweep, compare, ablation or tune; or its results.csv."""
    step: int | None = None
    """Environment steps (default: the end of each run; all of a single run)."""
    format: Literal["text", "markdown", "latex"] = "text"
    """Format of the table."""
    against: str | None = None
    """Row that the others are compared with, such as "ppl beta=0.1" (default: the default settings
    where they are there, else the first row)."""
    paper: bool = False
    """Show the paper's own figures beside ours."""
    env: str | None = None
    """Environment of results that do not name theirs (those of ppl compare)."""


@hide_unset
@dataclasses.dataclass
class Figure:
    """Draw results."""

    results: Positional[Path]
    """Run folder; folder of ppl sweep, compare, ablation or tune, or its results.csv; a folder of
    experts' cards; or (kind steering) a policy file."""
    other: Positional[tuple[Path, ...]] = ()
    """Kind steering: more of them; kind horizon: results over L, to show beside."""
    kind: (
        Literal["curves", "axis", "heatmap", "training", "experts", "steering", "horizon", "growth"]
        | None
    ) = None
    """Learning curves; success over one setting, or two; takeovers and cost in training; training
    of experts; steering on one map; what L buys and costs; what each size of a run costs (default:
    what the results have)."""
    column: Literal["success", "progress", "episodic_return", "episodic_cost"] = "success"
    """Column to draw."""
    steps: tuple[int, ...] = ()
    """Kind axis: steps to draw (default: the end of each run)."""
    scenario: int = 1000
    """Kind steering: number of a held-out scenario."""
    out: Path = Path("figure.png")
    """File to write; its ending decides how."""


@hide_unset
@dataclasses.dataclass
class Export:
    """Write a run's policy as one file: .npz, which plain NumPy can run, or .onnx."""

    run: Positional[Path]
    """Run folder."""
    out: Path = Path("policy.npz")
    """File to write; its ending says which kind."""


@hide_unset
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
    """Most steps to draw."""
    env: str = "driving"
    """Environment of "scripted" and "neural"."""
    physics: str | None = None
    """Physics engine of the environment (default: the run's own or auto); `ppl list` names them."""


@hide_unset
@dataclasses.dataclass
class Play:
    """Train a policy yourself: watch it in a browser and take over when it is about to fail."""

    env: Positional[str | None] = None
    """Environment (`ppl list` names them); with --resume that of the folder."""
    algorithm: str = "ppl"
    """Method that learns from you: ppl, pvp, hg_dagger, iwr, eil or haco."""
    seed: int = 0
    """Random seed."""
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
    words: Suppress[Fixed[tuple[str, ...]]] = ()
    """The command line."""
    settings: Suppress[Fixed[dict[str, Any]]] = dataclasses.field(default_factory=dict)
    """Settings of the run that it names."""


@hide_unset
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


@hide_unset
@dataclasses.dataclass
class Recording:
    """Write a session of `ppl play` as one file that NumPy (or Minari) can read."""

    run: Positional[Path]
    """Run folder."""
    out: Path = Path("session.npz")
    """File to write."""
    minari: str | None = None
    """Write a Minari data set of this name instead, such as driving/person-v0."""


BenchPart = Literal["envs", "training", "experts", "methods", "seeds", "sweep", "physics", "growth"]


@hide_unset
@dataclasses.dataclass
class Bench:
    """Measure speed, as ratios within one run."""

    repeats: int = 5
    """Repeats of each figure; medians are reported."""
    parts: tuple[BenchPart, ...] = ("envs", "training", "experts", "methods")
    """Parts to measure; seeds (methods, and five seeds of each in one program) and sweep (64 runs
    against single ones) take long; physics is a table of the arms on each engine, growth one of
    what each size of a run costs."""
    out: Path | None = None
    """Also write the figures to this JSON file, tables to NAME_physics.csv and NAME_growth.csv."""


@hide_unset
@dataclasses.dataclass
class Doctor:
    """Say what this machine has, and what to do about what is missing."""


@hide_unset
@dataclasses.dataclass
class List:
    """Name the environments, methods, gates, predictors, objectives, studies, presets, experts."""
