"""Film of one episode with the predictions the expert would see."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from envs.driving.env import Driving, DrivingState
from envs.driving.scenario import take
from envs.rendering import Paths, Scene, draw, save_frames
from experiments.evaluate import make_world, policy_path, read_policy, run_options
from experiments.runtime import UserError
from ppl_jax.config import default
from ppl_jax.experts import neural_expert
from ppl_jax.intervention import unsafe_or_slow
from ppl_jax.predictor import predict

SUFFIXES = (".gif", ".mp4", ".png")


def render(run: str, number: int, out: Path, steps: int) -> None:
    """Play a held-out scenario and write the film.

    Args:
        run: Run folder, policy file, or "scripted".
        number: Of the scenario.
        out: .gif, .mp4 or .png (the last picture).
        steps: At most so many.

    Raises:
        UserError: If one of them cannot be used.
    """
    if out.suffix not in SUFFIXES:
        raise UserError(f"out must end in {', '.join(SUFFIXES)}, got {str(out)!r}")
    if steps < 1:
        raise UserError(f"steps must be at least 1, got {steps}")
    scripted = run == "scripted"
    name, options = ("driving", {}) if scripted else run_options(Path(run))
    env = make_world(name, options)
    if scripted:
        act = env.scripted_expert
    else:
        act = neural_expert(read_policy(policy_path(Path(run)), env.spec))
    save_frames(out, episode(env, act, number, steps))


def episode(env: Driving, act, number: int, steps: int) -> list[np.ndarray]:
    """Pictures of an episode, one per control step.

    Raises:
        UserError: If the world has no scenario of that number.
    """
    params = env.held_out_params
    numbers = np.asarray(env.scenario_numbers(params)).tolist()
    if number not in numbers:
        raise UserError(f"scenario must be one of {numbers[0]} to {numbers[-1]}, got {number}")
    config, hparams = default()
    horizon, key = config.prediction_horizon, jax.random.key(0)

    def positions(state: DrivingState, policy, held: bool) -> jax.Array:
        first = policy(key, state, env.observe(state, params), params)

        def roll(state: DrivingState, _: None):
            action = first if held else policy(key, state, env.observe(state, params), params)
            state, _ = env.transition(key, state, action, params)
            return state, state.ego.pose[:2]

        return jax.lax.scan(roll, state, None, length=horizon)[1]

    @jax.jit
    def step(state: DrivingState):
        action = act(key, state, env.observe(state, params), params)
        trajectory = predict(env, env.transition, key, state, action, params, horizon)
        after, outcome = env.transition(key, state, action, params)
        novice = positions(state, act, held=True)
        expert = positions(state, env.scripted_expert, held=False)
        return after, outcome, novice, unsafe_or_slow(trajectory, hparams), expert

    state = env.reset_to(jnp.int32(numbers.index(number)), key, params)
    scene = Scene(take(params.scenarios, state.scenario))
    frames = []
    for t in range(steps):
        after, outcome, novice, takeover, expert = step(state)
        paths = Paths(np.asarray(novice), bool(takeover), np.asarray(expert))
        caption = f"scenario {number}   {t / 10:.1f} s   {float(outcome.speed) * 3.6:.0f} km/h"
        frames.append(draw(scene, state, paths, caption=caption))
        state = after
        if bool(outcome.terminated):
            break
    return frames
