"""How the arm environments are built: their starts, physics, and the experts handed to them."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import jax

from envs.manipulation.experts import lift as lift_experts
from envs.manipulation.experts import nut as nut_experts
from envs.manipulation.experts import wiping as wiping_experts
from envs.manipulation.tasks import lift, nut, wiping
from envs.manipulation.tasks.base import HELD_OUT_SCENARIOS, TRAINING_SCENARIOS, Backend

# imported when they are built: MuJoCo and MJX take seconds
_BACKENDS = {
    "table_wiping": {
        "analytic": ("wiping_analytic", "WipingAnalytic"),
        "mjx": ("wiping_mjx", "WipingMjx"),
        "mujoco_c": ("wiping_mujoco_c", "WipingMujocoC"),
    },
    "nut_assembly": {
        "analytic": ("nut_analytic", "NutAnalytic"),
        "mjx": ("nut_mjx", "NutMjx"),
        "mujoco_c": ("nut_mujoco_c", "NutMujocoC"),
    },
}


def make_backend(name: str, physics: str = "auto", **options: Any) -> Backend:
    """The physics of an arm environment.

    Args:
        name: Of the environment.
        physics: "analytic", "mjx", "mujoco_c", or "auto": the fastest that meets the bounds of
            fidelity, which is "analytic" on a CPU and "mjx" on an accelerator.
        **options: Of the back end.

    Raises:
        ValueError: If `physics` is unknown.
        ImportError: Without MuJoCo (or its XLA), where it needs it.
    """
    choices = _BACKENDS[name]
    if physics == "auto":
        physics = "analytic" if jax.default_backend() == "cpu" else "mjx"
    if physics not in choices:
        raise ValueError(f"physics must be auto or one of {', '.join(choices)}, got {physics!r}")
    module, cls = choices[physics]
    return getattr(importlib.import_module(f"envs.manipulation.backends.{module}"), cls)(**options)


def make_table_wiping(
    training: Sequence[int] = TRAINING_SCENARIOS,
    held_out: Sequence[int] = HELD_OUT_SCENARIOS,
    *,
    physics: str = "auto",
) -> wiping.TableWiping:
    """Build table wiping.

    Args:
        training, held_out: Numbers of the scenarios to train and to evaluate on.
        physics: See `make_backend`.
    """
    experts = {"scripted": wiping_experts.scripted_expert}
    backend = make_backend("table_wiping", physics)
    return wiping.TableWiping(
        wiping.make_params(training), wiping.make_params(held_out), experts, backend
    )


def make_nut_assembly(
    training: Sequence[int] = TRAINING_SCENARIOS,
    held_out: Sequence[int] = HELD_OUT_SCENARIOS,
    *,
    physics: str = "auto",
) -> nut.NutAssembly:
    """Build nut assembly.

    Args:
        training, held_out: Numbers of the scenarios to train and to evaluate on.
        physics: See `make_backend`.
    """
    experts = {"scripted": nut_experts.scripted_expert}
    backend = make_backend("nut_assembly", physics)
    return nut.NutAssembly(nut.make_params(training), nut.make_params(held_out), experts, backend)


def make_lift(
    training: Sequence[int] = TRAINING_SCENARIOS,
    held_out: Sequence[int] = HELD_OUT_SCENARIOS,
    *,
    physics: str = "auto",
) -> lift.Lift:
    """Build lift.

    Args:
        training, held_out: Numbers of the scenarios to train and to evaluate on.
        physics: "auto" or "mjx", which is all it has.

    Raises:
        ValueError: If `physics` is another.
        ImportError: Without MuJoCo XLA.
    """
    if physics not in ("auto", "mjx"):
        raise ValueError(f"physics must be auto or mjx, got {physics!r}")
    return lift.Lift(training, held_out, experts={"scripted": lift_experts.scripted_expert})
