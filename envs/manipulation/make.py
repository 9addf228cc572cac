"""How the arm environments are built: their starts, and the experts handed to them."""

from __future__ import annotations

from envs.manipulation.experts import nut as nut_experts
from envs.manipulation.experts import wiping as wiping_experts
from envs.manipulation.tasks import nut, wiping

TRAINING_SCENARIOS = range(1000)
HELD_OUT_SCENARIOS = range(1000, 1050)


def make_table_wiping(
    training: range = TRAINING_SCENARIOS, held_out: range = HELD_OUT_SCENARIOS
) -> wiping.TableWiping:
    """Build table wiping.

    Args:
        training, held_out: Numbers of the scenarios to train and to evaluate on.
    """
    experts = {"scripted": wiping_experts.scripted_expert}
    return wiping.TableWiping(wiping.make_params(training), wiping.make_params(held_out), experts)


def make_nut_assembly(
    training: range = TRAINING_SCENARIOS, held_out: range = HELD_OUT_SCENARIOS
) -> nut.NutAssembly:
    """Build nut assembly.

    Args:
        training, held_out: Numbers of the scenarios to train and to evaluate on.
    """
    experts = {"scripted": nut_experts.scripted_expert}
    return nut.NutAssembly(nut.make_params(training), nut.make_params(held_out), experts)
