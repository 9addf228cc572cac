"""Makes the page `settings.md` from the settings classes, when the documentation is built."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from envs.registry import registered
from ppl_jax import algorithms
from ppl_jax.algorithms import AlgorithmSpec
from ppl_jax.cards import DEFAULT, card
from ppl_jax.config import (
    PRESETS,
    HParams,
    Setting,
    TrainConfig,
    catalogue,
    preset_values,
)
from ppl_jax.fields import About, about
from ppl_jax.gates import gate, registered_gates
from ppl_jax.ppo.config import PPOConfig, PPOHParams
from ppl_jax.predictors import predictor, registered_predictors

PAGE = "settings.md"
HEAD = """# Settings

Every setting of a run by its owner; the list is generated from the settings classes. A name is an
option of `ppl train` (`batch_size` is `--batch-size`), an axis of `ppl sweep`, a column of result
files, and an argument of `ppl_jax.train`. *Traced* settings compile nothing when they change.
Presets, environments and methods [start from other values](#what-changes-the-defaults);
`ppl train ENV --algorithm METHOD --help-all` shows those of one run.
"""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the page to the site (mkdocs calls this)."""
    files.append(File.generated(config, PAGE, content=settings_page()))
    return files


def settings_page() -> str:
    """The page, in Markdown."""
    parts = [HEAD, "## Every run\n", _table(catalogue(TrainConfig(), HParams()).values())]
    parts += _owners("Methods", {n: _of_method(algorithms.method(n)) for n in _methods()})
    parts += _owners("Gates", {n: _own(gate=gate(n).hparams()) for n in registered_gates()})
    predictors = {n: _own(predictor=predictor(n).hparams()) for n in registered_predictors()}
    parts += _owners("Predictors", predictors)
    parts += [
        "## Randomised worlds\n",
        "Settings of runs with `randomise`, in the environments that have such ranges.\n",
    ]
    ranges = {n: card(n).ranges for n in registered()}
    for make in dict.fromkeys(make for make in ranges.values() if make is not None):
        parts += [", ".join(f"`{n}`" for n in registered() if ranges[n] is make) + ":\n"]
        parts += [_table(_own(world=make()))]
    parts += ["## What changes the defaults\n", _changes()]
    parts += [
        "## Neural experts\n",
        "Settings of `ppl expert train`; the cards of the environments change some of them.\n",
        _table([*_fields(PPOConfig, traced=False), *_fields(PPOHParams, traced=True)]),
    ]
    return "\n".join(parts)


def _methods() -> list[str]:
    return algorithms.registered()


def _of_method(spec: AlgorithmSpec) -> list[Setting]:
    return _own(config=spec.config(), method=spec.hparams())


def _own(config: Any = None, **owned: Any) -> list[Setting]:
    """The settings that one method, gate or predictor adds to those of every run."""
    common = catalogue(TrainConfig(), HParams())
    static = TrainConfig() if config is None else TrainConfig(method=config)
    found = catalogue(static, HParams(**owned))
    return [one for name, one in found.items() if name not in common]


def _owners(title: str, owners: Mapping[str, list[Setting]]) -> list[str]:
    """A section with a table for each owner; those without settings are named in a line."""
    parts = [f"## {title}\n"]
    for name, settings in owners.items():
        if settings:
            parts += [f"### {name}\n", _table(settings)]
    without = [f"`{name}`" for name, settings in owners.items() if not settings]
    if without:
        parts.append(f"Without settings of their own: {', '.join(without)}.\n")
    return parts


def _table(settings: Iterable[Setting]) -> str:
    rows = ["| name | default | allowed | traced | what it is |", "| --- | --- | --- | --- | --- |"]
    for one in settings:
        cells = (
            f"`{one.name}`",
            f"`{shown(one.value)}`",
            allowed(one.about, one.value),
            "yes" if one.traced else "",
            one.about.help.replace("|", "\\|"),
        )
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def shown(value: Any) -> str:
    """A value as on the command line."""
    if isinstance(value, tuple):
        return " ".join(map(str, value))
    return f"{value:g}" if isinstance(value, float) else str(value)


def allowed(about: About, value: Any) -> str:
    """The range or the choices of a setting, in words."""
    if value in registered_gates():
        return "a [gate](#gates)"
    if value in registered_predictors():
        return "a [predictor](#predictors)"
    if about.choices is not None:
        names = ", ".join(f"`{name}`" for name in about.choices)
        return names if isinstance(value, str) else f"{names}, or {_range(about) or 'a number'}"
    if isinstance(value, bool):
        return "`True`, `False`"
    return _range(about)


def _range(about: About) -> str:
    # a bound at the least positive float stands for "above 0"
    low = None if about.low is None else "above 0" if 0 < about.low < 1e-30 else about.low
    if isinstance(low, str):
        return low if about.high is None else f"{low}, at most {about.high:g}"
    if low is not None and about.high is not None:
        return f"{low:g} to {about.high:g}"
    if low is not None:
        return f"at least {low:g}"
    return "" if about.high is None else f"at most {about.high:g}"


def _fields(cls: type, *, traced: bool) -> list[Setting]:
    return [
        Setting(name=f.name, kind=f.type, value=f.default, about=about(f), traced=traced)
        for f in dataclasses.fields(cls)
    ]


def _changes() -> str:
    """What presets, environments and methods set otherwise."""
    rows = ["| for | changes |", "| --- | --- |"]
    for preset in PRESETS:
        for env in registered():
            if preset not in card(env).missing_presets:
                rows.append(f"| preset `{preset}`, `{env}` | {_set(preset_values(preset, env))} |")
    for name in _methods():
        spec = algorithms.method(name)
        rows.append(f"| method `{name}` | {_set(spec.changes(DEFAULT))} |")
        if spec.tuned:
            rows.append(f"| method `{name}`, preset `default` alone | {_set(spec.tuned)} |")
    kept = [row for row in rows if not row.endswith("|  |")]
    return (
        (
            "The later rows win. Demonstrations and warm-up steps depend on the environment; "
            "the rows of methods are those of an environment without a card of its own.\n\n"
        )
        + "\n".join(kept)
        + "\n"
    )


def _set(changes: Mapping[str, Any]) -> str:
    return ", ".join(f"`{name}` {shown(value)}" for name, value in changes.items())
