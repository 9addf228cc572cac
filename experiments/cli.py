"""The `ppl` command: parses and dispatches."""

from __future__ import annotations

import dataclasses
import os
import shlex
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import subcommand

from envs.compiler import set_xla_flags
from experiments.engine.preparation import SERVE, stop_if_preparing
from experiments.engine.runtime import UserError, hide_compiler_logs
from experiments.options.commands import (
    Ablation,
    Bench,
    Compare,
    Doctor,
    Evaluate,
    Expert,
    ExpertCard,
    ExpertEvaluate,
    Export,
    Figure,
    Horizon,
    List,
    Play,
    Recording,
    Render,
    Replay,
    Robustness,
    Sweep,
    Table,
    Tune,
    expert_command,
)
from ppl_jax import __version__, plugins

HELP_ALL = "--help-all"
_ABOUT = (
    "Predictive preference learning from human interventions: train, compare, sweep, draw, take "
    "over. `ppl COMMAND --help` explains a command, `ppl list` names what they take, "
    "`ppl --version` says the version; `--import MODULE` anywhere first imports a module of yours "
    "that registers environments or methods."
)
_PLAIN = {
    "evaluate": Evaluate,
    "compare": Compare,
    "ablation": Ablation,
    "tune": Tune,
    "sweep": Sweep,
    "robustness": Robustness,
    "horizon": Horizon,
    "table": Table,
    "figure": Figure,
    "expert": Expert,
    "export": Export,
    "render": Render,
    "play": Play,
    "replay": Replay,
    "recording": Recording,
    "list": List,
    "bench": Bench,
    "doctor": Doctor,
}


@dataclasses.dataclass
class Train:
    """Train one policy: progress, then the evaluation table; a run folder."""


def parse(argv: Sequence[str]) -> Any:
    """The command that a command line asks for, as a record.

    Settings are generated for what it names, so that help shows the values a run would have. The
    modules that know them need JAX, and are imported for those commands alone.
    """
    named = next((word for word in argv if not word.startswith("-")), None)
    classes: dict[str, Any] = {"train": Train, **_PLAIN}
    finish = lambda parsed: parsed  # noqa: E731
    if named == "train":
        from experiments.options.train import train_options, train_request

        classes["train"], defaults = train_options(argv[argv.index(named) + 1 :])
        finish = lambda parsed: train_request(parsed, defaults, argv)  # noqa: E731
    elif named == "expert" and "train" in argv:
        from experiments.options.expert import expert_options, expert_request

        words = argv[argv.index("train") + 1 :]
        options = expert_options(words)
        classes["expert"] = expert_command(options.cls)
        finish = lambda parsed: expert_request(parsed.command, options, words)  # noqa: E731
    elif named == "play":
        from experiments.options.play import play_options

        classes["play"], finish = play_options(argv[argv.index(named) + 1 :])
    elif named in ("sweep", "robustness"):
        classes[named], finish = _with_axes(classes[named], argv)
    words = ["--help" if word == HELP_ALL else word for word in argv]
    kinds = tuple(Annotated[cls, subcommand(name)] for name, cls in classes.items())
    union: Any = kinds[0]
    for kind in kinds[1:]:
        union = union | kind
    parsed = tyro.cli(union, prog="ppl", args=words, description=_ABOUT)
    return finish(parsed)


def _with_axes(cls: type, argv: Sequence[str]) -> tuple[type, Any]:
    """A sweep's class with an axis for every setting, and what turns its record into a request."""
    from experiments.options.settings import (
        axis_fields,
        axis_values,
        settings_in,
        shows_everything,
    )
    from experiments.studies.grid import STUDIES

    study = next((word for word in argv if word in STUDIES), None)
    words = list(argv)
    if "--algorithms" not in argv and study is not None:
        words += ["--algorithms", *STUDIES[study].algorithms]
    if study is not None and STUDIES[study].randomise:
        words += ["--randomise"]
    settings = settings_in(words, sweeping=True)
    axes = dataclasses.make_dataclass(
        "axes", axis_fields(settings, everything=shows_everything(argv))
    )
    member = ("axes", tyro.conf.OmitArgPrefixes[axes], dataclasses.field(default_factory=axes))
    made = dataclasses.make_dataclass(cls.__name__, [member], bases=(cls,), frozen=True)
    made.__doc__ = cls.__doc__

    def finish(parsed: Any) -> Any:
        return dataclasses.replace(parsed, axes=axis_values(settings, parsed.axes))

    return made, finish


def _train(request: Any) -> None:
    from experiments.engine.run import train
    from experiments.engine.runtime import start_jax
    from experiments.engine.settings import check
    from experiments.report.tables import print_run

    settings = request.settings
    every = min(settings.evaluate_every, max(settings.config.total_steps, 1))
    settings = dataclasses.replace(settings, evaluate_every=every)
    check(settings)
    out = request.out or new_folder(settings.env, settings.algorithm, settings.seed)
    start_jax()
    with _continued_by("ppl", "train", "--resume", "--out", str(out)):
        train(settings, out, request.resume)
    print_run(out)


class _continued_by:
    """Prints the command that continues where the work inside is interrupted."""

    def __init__(self, *words: str):
        self.words = words

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if kind is not None and issubclass(kind, KeyboardInterrupt):
            print(f"interrupted; continue with: {shlex.join(self.words)}", file=sys.stderr)
            sys.exit(130)


def new_folder(env: str, algorithm: str, seed: int) -> Path:
    """A run folder of its own, named after what is trained and the time."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return Path("runs") / f"{env.replace(':', '-')}-{algorithm}-{seed}-{stamp}"


def _evaluate(command: Evaluate) -> None:
    from experiments.engine.evaluate import evaluate_run
    from experiments.engine.runtime import start_jax
    from experiments.report.tables import print_evaluation

    start_jax()
    rows = evaluate_run(command.run, command.scenarios, command.physics)
    if command.out is not None:
        from experiments.report.tables import write_rows

        write_rows(command.out, [row._asdict() for row in rows])
    print_evaluation(str(command.run), rows)


def _compare(command: Compare) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.report import paper
    from experiments.report.tables import EPISODES, print_comparison
    from experiments.studies.compare import compare

    start_jax()
    try:
        compare(command)
    finally:
        print_comparison(command.out / EPISODES, paper.METHODS.get(command.env, {}))


def _ablation(command: Ablation) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.report import paper
    from experiments.report.tables import EPISODES, print_comparison
    from experiments.studies.ablation import ablation

    start_jax()
    try:
        ablation(command)
    finally:
        print_comparison(command.out / EPISODES, paper.ABLATION)


def _tune(command: Tune) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.studies.tune import tune

    start_jax()
    tune(command)


def _sweep(command: Sweep) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.studies.runner import sweep

    start_jax()
    with _continued_by("ppl", *sys.argv[1:]):
        sweep(command)
    if not command.dry_run:
        _show_results(command.out)


def _show_results(out: Path) -> None:
    """The table of a finished folder of runs, and what to do next with it."""
    from experiments.report.tables import table

    table(out)
    print(f"\nresults are in {out}; next: ppl figure {out}, or ppl table {out} --format latex")


def _horizon(command: Horizon) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.studies.horizon import measure_horizon

    start_jax()
    measure_horizon(command)
    print(f"wrote {command.out}")


def _table(command: Table) -> None:
    from experiments.report.tables import table

    table(**vars(command))


def _figure(command: Figure) -> None:
    from experiments.report.figures import figure

    figure(**vars(command))
    print(f"wrote {command.out}")


def _expert(command: Any) -> None:
    part: ExpertEvaluate | ExpertCard = command.command
    if isinstance(part, ExpertEvaluate):
        _expert_evaluate(part)
        return
    from experiments.report.card import write_card

    write_card(part.run, part.out, force=part.force)


def _expert_train(request: Any) -> None:
    from experiments.engine.expert import train_expert
    from experiments.engine.runtime import start_jax
    from experiments.report.tables import print_run

    settings = request.settings
    out = request.out or new_folder(settings.env, "expert", settings.seed)
    start_jax()
    with _continued_by("ppl", "expert", "train", "--resume", "--out", str(out)):
        train_expert(settings, out, request.resume)
    print_run(out)


def _expert_evaluate(command: ExpertEvaluate) -> None:
    from experiments.engine.evaluate import make_env
    from experiments.engine.expert import evaluate_expert
    from experiments.engine.runtime import start_jax
    from experiments.report.tables import print_evaluation, write_rows

    start_jax()
    given = {"held_out_scenarios": command.scenarios, "physics": command.physics}
    options = {name: value for name, value in given.items() if value is not None}
    rows = evaluate_expert(make_env(command.env, options), command.kind)
    if command.out is not None:
        write_rows(command.out, [row._asdict() for row in rows])
    print_evaluation(f"{command.kind} expert", rows)


def _export(command: Export) -> None:
    from experiments.engine.export import export

    export(command.run, command.out)
    print(f"wrote {command.out}")


def _render(command: Render) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.report.film import render

    start_jax()
    render(
        command.run,
        command.scenario,
        command.out,
        command.steps,
        env_name=command.env,
        physics=command.physics,
    )
    print(f"wrote {command.out}")


def _play(command: Play) -> None:
    from experiments.engine.runtime import start_jax
    from experiments.engine.settings import run_settings
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
        settings = run_settings(
            command.env,
            command.algorithm,
            command.seed,
            expert="person",
            scenarios=command.scenarios,
            given=command.settings,
        )
        session_config = new_session(command.env, given)
        out = command.out or new_folder(command.env, command.algorithm, command.seed)
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


def _list(command: List) -> None:
    from experiments.tools.listing import listing

    print(listing())


def _import_named(words: list[str]) -> list[str]:
    """Import the modules that `--import` and `PPL_JAX_IMPORT` name; returns the other words.

    Raises:
        UserError: If one cannot be imported.
    """
    names = list(plugins.named())
    while "--import" in words:
        at = words.index("--import")
        if at + 1 == len(words):
            raise UserError("--import: name a module that registers environments or methods")
        names.append(words[at + 1])
        words = words[:at] + words[at + 2 :]
    try:
        plugins.import_modules(names)
    except ValueError as error:
        raise UserError(str(error)) from error
    return words


def _run(command: Any) -> None:
    """Run a command, if the file that it writes can be; a generated class has its base's name."""
    asked = getattr(command, "command", command)  # `ppl expert` has commands of its own
    if isinstance(asked, _WRITES_A_FILE) and asked.out is not None:
        from experiments.engine.files import check_out_file

        check_out_file(asked.out)
    _ACTIONS[type(command).__name__](command)


_WRITES_A_FILE = (Bench, Evaluate, ExpertEvaluate, Export, Figure, Horizon, Recording, Render)


_ACTIONS = {
    "TrainRequest": _train,
    "Evaluate": _evaluate,
    "Compare": _compare,
    "Ablation": _ablation,
    "Tune": _tune,
    "Sweep": _sweep,
    "Robustness": _sweep,
    "Horizon": _horizon,
    "Table": _table,
    "Figure": _figure,
    "Expert": _expert,
    "ExpertTrainRequest": _expert_train,
    "Export": _export,
    "Render": _render,
    "Play": _play,
    "Replay": _replay,
    "Recording": _recording,
    "List": _list,
    "Bench": _bench,
    "Doctor": _doctor,
}


def main(argv: list[str] | None = None) -> None:
    """Entry point; exits with 0, 1 (the run broke) or 2 (a mistake in what was asked for)."""
    stop_if_preparing()
    set_xla_flags()  # first of all: XLA reads them once, when JAX is first used
    hide_compiler_logs()
    words = sys.argv[1:] if argv is None else argv
    if words == [SERVE]:
        from experiments.engine.worker import serve

        return serve()
    if words == ["--version"]:
        print(f"ppl-jax {__version__}")
        return
    try:
        _run(parse(_import_named(words)))
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
