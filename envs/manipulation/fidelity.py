"""How close these environments are to robosuite 1.4.1: `python -m envs.manipulation.fidelity DIR`.

`--physics` chooses the engine (analytic, mjx, mujoco_c). Prints one JSON object for a folder of
recordings (`wipe_*`, `nut_*`, `free_wipe_*`, `free_nut_*`, `osc_steps`, `press`, `lookahead`, each
`.npz`); a figure whose files are missing is null:

- `free_motion_error_1s_max`: m, largest distance of the grip site from the recorded one in 20
  replayed steps, from every twentieth recorded state of the free motions;
- `step_response_error`: largest relative error of the way (or angle) made under a constant command
  of 15 steps, runs that touch the arm left out;
- `press_force_error`: largest relative error of the force over the last ten steps of a press;
- `obs_max_abs_error`: of any value of the observation, given the recorded state;
- `wipe_reward_agreement`: share of steps whose reward agrees within 0.02, replaying whole episodes;
- `nut_reward_agreement`: within 0.05, in windows of 10 steps from restored states;
- `nut_position_error_median`: m, of the ring in those windows;
- `lookahead_return_error`: median relative error of the recorded lookaheads' returns (returns
  below 0.1 count as 0.1).
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.compiler import set_xla_flags
from envs.manipulation.make import make_nut_assembly, make_table_wiping
from envs.manipulation.physics.analytic import unrolled_linalg
from envs.manipulation.physics.analytic.arm import frames
from envs.manipulation.physics.analytic.quaternion import rotation_matrix
from envs.manipulation.scenes.model import GRIPPER, NUT_BASE, TIMESTEP, WIPER, WIPING_BASE
from envs.manipulation.tasks import nut, wiping

FREE_STEPS, WINDOW = 20, 10
_LANES, _PART = 32, 5  # windows side by side, and steps, of the one program that replays
_KEY = jax.random.key(0)


class Worlds(NamedTuple):
    """The two environments on one physics."""

    wiping: wiping.TableWiping
    nut: nut.NutAssembly


@functools.cache
def worlds(physics: str) -> Worlds:
    """Both environments with one start each.

    Raises:
        ValueError: If the physics is unknown.
    """
    return Worlds(
        make_table_wiping(range(1), range(1), physics=physics),
        make_nut_assembly(range(1), range(1), physics=physics),
    )


def wiping_state(record: Any, row: int | tuple[int, ...]) -> wiping.WipingState:
    """The recorded state `row` (an index, or a tuple of them) of an episode."""
    at = (row,) if isinstance(row, int) else row
    before = (*at[:-1], max(at[-1] - 1, 0))
    markers = record["marker_pos"]
    if markers.ndim == 3:
        markers = markers[at[0]]
    return _wiping_state(
        {name: record[name][at] for name in ("qpos", "qvel", "goal_ori", "ee_force", "force_bias",
                                              "wiped", "qacc_warmstart", "obs", "timestep")}
        | {"marker_pos": markers, "shown": record["wiped"][before]}
    )  # fmt: skip


def _wiping_state(values: dict[str, np.ndarray]) -> wiping.WipingState:
    env = worlds("analytic").wiping
    start = env.reset_to(jnp.int32(0), _KEY, env.default_params)
    return dataclasses.replace(
        start,
        joints=jnp.float32(values["qpos"]),
        speeds=jnp.float32(values["qvel"]),
        acceleration=jnp.float32(values["qacc_warmstart"]),
        goal_rotation=jnp.float32(values["goal_ori"].T),
        force=jnp.float32(values["ee_force"]),
        force_bias=jnp.float32(values["force_bias"]),
        contact=jnp.asarray(bool(values["obs"][33])),
        markers=jnp.float32(values["marker_pos"][:, :2]),
        wiped=jnp.asarray(values["wiped"]),
        shown=jnp.asarray(values["shown"]),
        time=jnp.int32(values["timestep"]),
    )


def nut_state(record: Any, row: Any, prefix: str = "") -> nut.NutState:
    """The recorded state `row` of an episode (or of `lookahead.npz`, with its prefix)."""
    values = {name: record[prefix + name][row] for name in ("qpos", "qvel", "goal_ori", "timestep")}
    env = worlds("analytic").nut
    start = env.reset_to(jnp.int32(0), _KEY, env.default_params)
    qpos, qvel = values["qpos"], values["qvel"]
    quaternion = jnp.float32(qpos[22:26])
    turn = np.asarray(rotation_matrix(quaternion))
    touching = record[prefix + "pads_touch"][row] if prefix + "pads_touch" in record else False
    return dataclasses.replace(
        start,
        joints=jnp.float32(qpos[:6]),
        speeds=jnp.float32(qvel[:6]),
        goal_rotation=jnp.float32(values["goal_ori"].T),
        fingers=jnp.float32(qpos[6:12]),
        finger_speeds=jnp.float32(qvel[6:12]),
        command=jnp.float32(record[prefix + "grip_action"][row]),
        touching=jnp.asarray(bool(touching)),
        position=jnp.float32(qpos[19:22]),
        quaternion=quaternion,
        velocity=jnp.float32(qvel[18:21]),
        spin=jnp.float32(turn @ qvel[21:24]),
        time=jnp.int32(values["timestep"]),
    )


@functools.partial(jax.jit, static_argnums=0)
def _replay(env: Any, states: Any, actions: jax.Array) -> tuple[Any, tuple[Any, Any, Any]]:
    """Last states, and states, rewards and observations after each action; ends are ignored."""

    def step(state: Any, action: jax.Array) -> Any:
        state, outcome = env.transition(_KEY, state, action, env.default_params)
        return state, (state, outcome.reward, env.observe(state, env.default_params))

    return jax.vmap(lambda state, mine: jax.lax.scan(step, state, mine))(states, actions)


def _windows(env: Any, states: list[Any], actions: Any) -> Any:
    """States, rewards and observations of windows of one length, [W, T] each.

    `_LANES` windows side by side and `_PART` steps at a time, so that all share a program.
    """
    results, done = [], None
    for first in range(0, len(states), _LANES):
        some, acts = states[first : first + _LANES], actions[first : first + _LANES]
        missing = _LANES - len(some)
        now = jax.tree.map(lambda *x: jnp.stack(x), *some, *[some[-1]] * missing)
        acts = np.asarray([*acts, *[acts[-1]] * missing], np.float32)
        steps = acts.shape[1]
        acts = np.pad(acts, ((0, 0), (0, -steps % _PART), (0, 0)))
        parts = []
        for at in range(0, acts.shape[1], _PART):
            now, done = _replay(env, now, acts[:, at : at + _PART])
            parts.append([np.asarray(x)[: len(some)] for x in jax.tree.leaves(done)])
        results.append([np.concatenate(x, 1)[:, :steps] for x in zip(*parts, strict=True)])
    leaves = [np.concatenate(parts) for parts in zip(*results, strict=True)]
    return jax.tree.unflatten(jax.tree.structure(done), leaves)


def _load(folder: Path, pattern: str) -> list[dict[str, np.ndarray]]:
    found = []
    for path in sorted(folder.glob(pattern)):
        with np.load(path) as archive:
            found.append({name: archive[name] for name in archive.files})
    return found


def _free(folder: Path, on: Worlds) -> float | None:
    worst = []
    for env, name, at in ((on.wiping, "free_wipe_*.npz", 26), (on.nut, "free_nut_*.npz", 32)):
        states, actions, wanted = [], [], []
        for record in _load(folder, name):
            for row in range(0, len(record["action"]) - FREE_STEPS + 1, FREE_STEPS):
                make = wiping_state if isinstance(env, wiping.TableWiping) else nut_state
                states.append(make(record, row))
                actions.append(record["action"][row : row + FREE_STEPS])
                wanted.append(record["eef_pos"][row + 1 : row + 1 + FREE_STEPS])
        if states:
            seen = _windows(env, states, actions)[2][:, :, at : at + 3]
            worst.append(float(np.linalg.norm(seen - np.array(wanted), axis=-1).max()))
    return max(worst) if worst else None


def _grip_site(env: Any, states: Any) -> tuple[np.ndarray, np.ndarray]:
    """Positions and rotations (columns) of the grip site for states' lagged joints, [K]."""
    tool, base = (
        (WIPER, WIPING_BASE) if isinstance(env, wiping.TableWiping) else (GRIPPER, NUT_BASE)
    )

    def one(joints: jax.Array, speeds: jax.Array) -> tuple[jax.Array, jax.Array]:
        at = frames(list(joints - TIMESTEP * speeds), tool)
        place = jnp.stack(at.position) + jnp.array(base, jnp.float32)
        return place, unrolled_linalg.array(at.rotation).T

    places, turns = jax.jit(jax.vmap(one))(states.joints, states.speeds)
    return np.asarray(places), np.asarray(turns)


def _steps(folder: Path, on: Worlds) -> float | None:
    found = _load(folder, "osc_steps.npz")
    if not found:
        return None
    record, errors = found[0], []
    for env, prefix in ((on.wiping, "wipe_"), (on.nut, "nut_")):
        states = []
        for run in range(len(record[prefix + "qpos"])):
            qpos, qvel = record[prefix + "qpos"][run, 0], record[prefix + "qvel"][run, 0]
            start = env.reset_to(jnp.int32(0), _KEY, env.default_params)
            turn = record[prefix + "site_mat"][run, 0].T
            start = dataclasses.replace(
                start,
                joints=jnp.float32(qpos[:6]),
                speeds=jnp.float32(qvel[:6]),
                goal_rotation=jnp.float32(turn),
            )
            states.append(start)
        after = _windows(env, states, list(record[prefix + "action"]))[0]
        last = jax.tree.map(lambda x: jnp.asarray(x[:, -1]), after)
        places, turns = _grip_site(env, last)
        for run in range(len(states)):
            if record[prefix + "arm_contact"][run].any():
                continue
            axis = int(np.argmax(np.abs(record[prefix + "action"][run, 0, :6])))
            if axis < 3:
                start, end = record[prefix + "eef_pos"][run, [0, -1]]
                error, way = np.linalg.norm(places[run] - end), np.linalg.norm(end - start)
            else:
                start, end = record[prefix + "site_mat"][run, [0, -1]]
                error, way = _angle(turns[run], end), _angle(start, end)
            errors.append(error / way)
    return float(max(errors))


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(2 * np.arcsin(min(np.linalg.norm(a - b) / 8**0.5, 1.0)))


@jax.jit
@jax.vmap
def _push_up(state: wiping.WipingState) -> jax.Array:
    """The table's push on the wiper, N: the wrist's sensor, turned up, and the wiper's weight."""
    turn = unrolled_linalg.array(wiping.lagged_frames(state, WIPER).rotation)
    return (-turn.T @ state.force)[2] + 9.81 * WIPER.mass


def _press(folder: Path, on: Worlds) -> float | None:
    found = _load(folder, "press.npz")
    if not found:
        return None
    record, errors = found[0], []
    states = [wiping_state(record, (run, 0)) for run in range(len(record["action"]))]
    after = _windows(on.wiping, states, record["action"])[0]
    for run in range(len(states)):
        mine = jax.tree.map(lambda x, run=run: jnp.asarray(x[run, -10:]), after)
        push = np.asarray(_push_up(mine)).mean()
        wanted = record["contact_force"][run, -10:, 2].mean()
        errors.append(abs(push - wanted) / wanted)
    return float(max(errors))


def _observations(folder: Path, on: Worlds) -> float | None:
    errors = []
    for env, name in ((on.wiping, "wipe_*.npz"), (on.nut, "nut_*.npz")):
        observe = jax.jit(lambda state, env=env: env.observe(state, env.default_params))
        make = wiping_state if isinstance(env, wiping.TableWiping) else nut_state
        for record in _load(folder, name):
            for row in range(0, len(record["obs"]), 3):
                seen = np.asarray(observe(make(record, row)))
                errors.append(float(np.abs(seen - record["obs"][row]).max()))
    return max(errors) if errors else None


def _wipe_rewards(folder: Path, on: Worlds) -> float | None:
    records = _load(folder, "wipe_*.npz")
    if not records:
        return None
    longest = max(len(record["action"]) for record in records)
    actions = np.zeros((len(records), longest, 6), np.float32)
    for mine, record in zip(actions, records, strict=True):
        mine[: len(record["action"])] = record["action"]
    rewards = _windows(on.wiping, [wiping_state(record, 0) for record in records], actions)[1]
    agree = [
        np.abs(mine[: len(record["reward"])] - record["reward"]) < 0.02
        for mine, record in zip(rewards, records, strict=True)
    ]
    return float(np.concatenate(agree).mean())


def _nut_windows(folder: Path, on: Worlds) -> tuple[float | None, float | None]:
    states, actions, rewards, rings = [], [], [], []
    for record in _load(folder, "nut_*.npz"):
        for row in range(0, len(record["action"]) - WINDOW + 1, WINDOW):
            states.append(nut_state(record, row))
            actions.append(record["action"][row : row + WINDOW])
            rewards.append(record["reward"][row : row + WINDOW])
            rings.append(record["nut_pos"][row + 1 : row + 1 + WINDOW])
    if not states:
        return None, None
    _, reward, observation = _windows(on.nut, states, actions)
    agree = np.abs(reward - np.array(rewards)) < 0.05
    off = np.linalg.norm(observation[:, :, :3] - np.array(rings), axis=-1)
    return float(agree.mean()), float(np.median(off))


def _lookaheads(folder: Path, on: Worlds) -> float | None:
    found = _load(folder, "lookahead.npz")
    if not found:
        return None
    record, errors = found[0], []
    for env, prefix in ((on.wiping, "wipe_"), (on.nut, "nut_")):
        states = []
        for run, row in enumerate(record[prefix + "state"]):
            if isinstance(env, nut.NutAssembly):
                states.append(nut_state(record, int(row), "nut_state_"))
                continue
            names = ("qpos", "qvel", "goal_ori", "force_bias", "wiped", "qacc_warmstart", "obs",
                     "timestep", "marker_pos")  # fmt: skip
            values = {name: record[f"wipe_state_{name}"][row] for name in names}
            # the first step's reward is paid for the force at its start
            force = record["wipe_reward_force"][run, 0]
            states.append(_wiping_state(values | {"ee_force": force, "shown": values["wiped"]}))
        held = [np.repeat(action[None], WINDOW, 0) for action in record[prefix + "action"]]
        returns = _windows(env, states, held)[1].sum(-1)
        wanted = record[prefix + "reward"].sum(-1)
        errors.append(np.abs(returns - wanted) / np.maximum(np.abs(wanted), 0.1))
    return float(np.median(np.concatenate(errors)))


def fidelity(folder: str | Path, physics: str = "auto") -> dict[str, float | None]:
    """The figures above for a folder of recordings.

    Args:
        folder: Folder.
        physics: See `envs.manipulation.make.make_backend`.

    Raises:
        ValueError: If there is no such folder, or no recording in it, or the physics is unknown.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ValueError(f"no folder of recordings at {str(folder)!r}")
    on = worlds(physics)
    nut_agreement, nut_position = _nut_windows(folder, on)
    figures = {
        "free_motion_error_1s_max": _free(folder, on),
        "step_response_error": _steps(folder, on),
        "press_force_error": _press(folder, on),
        "obs_max_abs_error": _observations(folder, on),
        "wipe_reward_agreement": _wipe_rewards(folder, on),
        "nut_reward_agreement": nut_agreement,
        "nut_position_error_median": nut_position,
        "lookahead_return_error": _lookaheads(folder, on),
    }
    if all(value is None for value in figures.values()):
        raise ValueError(f"no recording (wipe_*.npz, nut_*.npz, ...) in {str(folder)!r}")
    return figures


def main() -> None:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(prog="python -m envs.manipulation.fidelity")
    parser.add_argument("folder", help="folder of recordings")
    parser.add_argument("--physics", default="auto", help="auto, analytic, mjx or mujoco_c")
    given = parser.parse_args()
    set_xla_flags()
    try:
        print(json.dumps(fidelity(given.folder, given.physics), indent=2))
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
