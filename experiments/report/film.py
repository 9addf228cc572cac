"""Film of one episode with the predictions the expert would see."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.driving.rendering import Paths, Scene, draw, save_frames
from envs.driving.scenario import tree_index
from experiments.engine.evaluate import make_env, named_expert, run_hparams, run_options
from experiments.engine.files import check_ending
from experiments.engine.runtime import UserError, need
from ppl_jax import algorithms
from ppl_jax.config import HParams, as_arrays, env_params
from ppl_jax.gates import gate
from ppl_jax.predictors import predict
from ppl_jax.types import DecisionPoint, Env, Expert

SUFFIXES = (".gif", ".mp4", ".png")

Draw = Callable[[Any, np.ndarray, bool, np.ndarray, str], np.ndarray]
"""`draw(state, novice's path, takeover, expert's path, caption) -> picture`."""


def render(
    run: str,
    number: int,
    out: Path,
    steps: int,
    *,
    env_name: str = "driving",
    physics: str | None = None,
) -> None:
    """Play a held-out scenario and write the film.

    Args:
        run: Run folder, policy file, "scripted" or "neural".
        number: Number of the scenario.
        out: .gif, .mp4 or .png (the last picture).
        steps: Most steps to draw.
        env_name: Environment, where `run` is "scripted" or "neural".
        physics: To play in; the run's own where None.

    Raises:
        UserError: If one of them cannot be used.
    """
    check_ending(out, SUFFIXES)
    if steps < 1:
        raise UserError(f"steps must be at least 1, got {steps}")
    need("PIL", "render", "ppl render")
    if out.suffix == ".mp4":
        need("av", "render", "ppl render to .mp4")
    named = run in ("scripted", "neural")
    name, options = (env_name, {}) if named else run_options(Path(run))
    if physics is not None:
        options["physics"] = physics
    env = make_env(name, options)
    played = None if named else run_hparams(Path(run))
    save_frames(out, episode(env, named_expert(run, env), number, steps, played))


def episode(
    env: Any, act: Expert, number: int, steps: int, played: HParams | None = None
) -> list[np.ndarray]:
    """Pictures of an episode, one per control step.

    Args:
        env: The environment.
        act: Who plays.
        number: Number of the scenario.
        steps: Most steps to draw.
        played: Settings of the run whose worlds, if they are randomised, are played in.

    Raises:
        UserError: If the environment has no scenario of that number, or cannot be drawn here.
    """
    params = env.held_out_params
    if played is not None:
        params = env_params(env, params, as_arrays(played))
    numbers = np.asarray(env.scenario_numbers(params)).tolist()
    if number not in numbers:
        raise UserError(f"scenario must be one of {numbers[0]} to {numbers[-1]}, got {number}")
    config, hparams = algorithms.settings("ppl", env.name)
    rule, key = gate(config.gate), jax.random.key(0)
    state = env.reset_to(jnp.int32(numbers.index(number)), key, params)
    if env.name == "driving":
        place, picture = _driving(env, state)
    else:
        place, picture = _arm(env)
    horizon = config.prediction_horizon

    ahead = functools.partial(predict, env, env.transition, key, observe=True, place=place)

    @jax.jit
    def step(state: Any):
        action = act(key, state, env.observe(state, params), params)
        novice = ahead(state, action=action, params=params, horizon=horizon)
        expert = ahead(
            state, action=action, params=params, horizon=horizon, expert=env.experts["scripted"]
        )
        after, outcome = env.transition(key, state, action, params)
        point = DecisionPoint(
            observation=env.observe(state, params),
            novice_action=action,
            expert_action=action,
            takeover=jnp.zeros((), bool),
            trajectory=novice,
            experts=expert,
            log_density=jnp.asarray(jnp.nan),
        )
        takeover = rule.decide(point, hparams.gate, env.spec.observation_scale)
        return after, outcome, novice.position, takeover, expert.position

    frames = []
    for t in range(steps):
        after, outcome, novice, takeover, expert = step(state)
        caption = f"scenario {number}   step {t}   speed {float(outcome.speed):.2f} m/s"
        frames.append(
            picture(state, np.asarray(novice), bool(takeover), np.asarray(expert), caption)
        )
        state = after
        if bool(outcome.terminated):
            break
    return frames


def _driving(env: Env, state: Any) -> tuple[Callable[[Any], jax.Array], Draw]:
    scene = Scene(tree_index(env.held_out_params.scenarios, state.scenario))

    def picture(state: Any, novice: np.ndarray, takeover: bool, expert: np.ndarray, caption: str):
        return draw(
            scene, state, Paths(novice=novice, takeover=takeover, expert=expert), caption=caption
        )

    return (lambda state: state.ego.pose[:2]), picture


def _arm(env: Any) -> tuple[Callable[[Any], jax.Array], Draw]:
    try:
        from envs.manipulation.rendering import ArmPaths, ArmScene

        scene = ArmScene(env)
    except (ImportError, RuntimeError) as error:
        raise UserError(str(error)) from error

    def picture(state: Any, novice: np.ndarray, takeover: bool, expert: np.ndarray, caption: str):
        del caption
        return scene.draw(state, ArmPaths(novice=novice, takeover=takeover, expert=expert))

    return env.grip_position, picture
