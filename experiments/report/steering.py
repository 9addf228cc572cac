"""Steering of several policies on one map (the paper's Fig. 6)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.driving.scenario import tree_index
from experiments.engine.evaluate import arrays_of, make_env, policy_path, read_policy, run_options
from experiments.engine.policy_file import load_meta
from experiments.engine.runtime import UserError, need
from ppl_jax import experts

EVERY = 5  # steps between arrows
ARROW = 6.0  # m
STEEPEST = 40.0  # degrees, of the front wheels at |steering| = 1
ROAD, OBJECT = "#d9dbde", "#c8321e"


def steering(paths: Sequence[Path], number: int, out: Path) -> None:
    """Play one held-out map with each policy and draw path, steering and speed.

    Args:
        paths: Run folders or policy files of the driving environment.
        number: Number of the scenario.
        out: Picture to write.

    Raises:
        UserError: If a path has no driving policy or there is no such scenario.
    """
    need("matplotlib", "plot", "a figure").use("Agg")
    options = [run_options(path) for path in paths]
    for path, (name, _) in zip(paths, options, strict=True):
        if name != "driving":
            raise UserError(f"kind steering is for driving, {str(path)!r} is of {name}")
    env = make_env("driving", options[0][1])
    numbers = np.asarray(env.scenario_numbers(env.held_out_params)).tolist()
    if number not in numbers:
        raise UserError(f"scenario must be one of {numbers[0]} to {numbers[-1]}, got {number}")
    at = numbers.index(number)
    _draw(env, at, [episode(env, path, at) for path in paths], number, out=out)


def _draw(env: Any, at: int, played: Sequence[dict[str, Any]], number: int, *, out: Path) -> None:
    """A column per policy: the road with its path above, steering over distance below."""
    from matplotlib import pyplot

    from envs.driving.rendering import Scene

    scene = Scene(tree_index(env.held_out_params.scenarios, jnp.int32(at)))
    picture, panels = pyplot.subplots(
        2,
        len(played),
        figsize=(5.4 * len(played), 7.2),
        height_ratios=(3, 1.4),
        squeeze=False,
        sharey="row",
        layout="constrained",
    )
    reach = np.concatenate([run["position"] for run in played])
    low, high = reach.min(0) - 15, reach.max(0) + 15
    drawn: Any = None
    for (road, line), run in zip(panels.T, played, strict=True):
        drawn = _draw_road(road, scene, run)
        road.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        line.plot(run["travelled"], run["steer"], color="black", linewidth=0.9)
        line.set(xlabel="distance driven (m)", ylim=(-1.05, 1.05))
        line.grid(alpha=0.25)
        line.spines[["top", "right"]].set_visible(False)
    panels[1][0].set_ylabel("steering in [-1, 1]")
    picture.colorbar(drawn, ax=panels[0], label="speed (km/h)")
    caption = (
        f"Held-out scenario {number}, without the expert; arrows every {EVERY} steps (0.5 s) show "
        "where the front wheels point; squares and triangles are obstacles."
    )
    picture.supxlabel(caption, fontsize=8, x=0.02, ha="left")
    picture.savefig(out, dpi=130)
    pyplot.close(picture)


def _draw_road(road: Any, scene: Any, run: dict[str, Any]) -> Any:
    """The road, its obstacles and one episode; returns the arrows, for the colour bar."""
    from matplotlib.patches import Polygon

    objects = scene.scenario.objects
    for surface in scene.surfaces:
        road.add_patch(Polygon(surface, color=ROAD, linewidth=0))
    road.plot(objects.box_pose[:, 0], objects.box_pose[:, 1], "s", color=OBJECT, markersize=5)
    road.plot(objects.circle[:, 0], objects.circle[:, 1], "^", color=OBJECT, markersize=3)
    position, angle = run["position"], run["heading"] + np.radians(STEEPEST) * run["steer"]
    road.plot(*position.T, "-", color="black", linewidth=0.6)
    road.set_xticks([])
    road.set_yticks([])
    jerk = np.abs(np.diff(run["steer"])).mean()
    title = f"{run['label']}: {run['end']}\nmean |change of steering| per step {jerk:.3f}"
    road.set_title(title, fontsize=10)
    return road.quiver(
        *position[::EVERY].T,
        ARROW * np.cos(angle[::EVERY]),
        ARROW * np.sin(angle[::EVERY]),
        3.6 * run["speed"][::EVERY],
        angles="xy",
        scale_units="xy",
        scale=1,
        cmap="viridis",
        clim=(0, 80),
        width=0.005,
    )


def episode(env: Any, path: Path, at: int) -> dict[str, Any]:
    """One policy's episode: positions [T, 2], heading, steering, speed and how it ended."""
    policy = arrays_of(read_policy(policy_path(path), env.spec))
    params, key = env.held_out_params, jax.random.key(0)

    def step(carry: Any, _: None) -> Any:
        state, alive = carry
        action = experts.act(policy, env.observe(state, params))
        after, outcome = env.transition(key, state, action, params)
        row = (state.ego.pose, action[0], outcome.speed, alive, outcome.success, outcome.cost)
        return (after, alive & ~(outcome.terminated | outcome.truncated)), row

    start = (env.reset_to(jnp.int32(at), key, params), jnp.array(True))
    scan = jax.jit(lambda carry: jax.lax.scan(step, carry, None, length=env.max_episode_steps)[1])
    pose, steer, speed, alive, success, cost = (np.asarray(x) for x in scan(start))
    n = int(alive.sum())
    position = pose[:n, :2]
    moved = np.hypot(*np.diff(position, axis=0, prepend=position[:1]).T)
    meta = load_meta(policy_path(path))
    total = float((alive * cost).sum())
    ended = "arrived" if (alive & success).any() else "failed"
    return {
        "label": f"{meta.get('algorithm', path.name)} at {meta.get('step', '?')} steps",
        "position": position,
        "heading": pose[:n, 2],
        "steer": steer[:n],
        "speed": speed[:n],
        "travelled": np.cumsum(moved),
        "end": f"{ended}, cost {total:.0f}",
    }
