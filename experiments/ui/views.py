"""How an environment is shown: roads as shapes that the page draws, arms as rendered pictures.

A view's `scene(state)` is sent when an episode starts, `frame(state, shown)` in every step; both
are JSON. A picture, where the view makes them, follows as JPEG when it is ready.
"""

from __future__ import annotations

import io
import multiprocessing
import threading
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from envs.registry import registered
from experiments.engine.runtime import UserError, need
from ppl_jax.cards import EnvCard, card
from ppl_jax.types import Env

PICTURE = (480, 640)  # height and width


_NEEDS = {"arm": (("PIL", "ui"),)}  # view -> (module, extra)


def display_of(env_name: str) -> EnvCard:
    """The card of an environment that can be shown; checked without building it.

    Raises:
        UserError: If it has no drawing, or a package for it is missing.
    """
    found = card(env_name)
    if found.view is None:
        drawn = ", ".join(name for name in registered() if card(name).view is not None)
        raise UserError(
            f"env: {env_name} has no drawing, so that it cannot be shown in a browser; those with "
            f"one are {drawn}"
        )
    for module, extra in _NEEDS.get(found.view, ()):
        need(module, extra, f"showing {env_name}")
    return found


class Shown(NamedTuple):
    """Predicted paths to show, [H, P], or None.

    Attributes:
        novice: Path of the novice's held action, from the state where it was predicted.
        fails: It is predicted to fail.
        mine: Path of the person's held action, from the present state.
    """

    novice: np.ndarray | None = None
    fails: bool = False
    mine: np.ndarray | None = None


class View(Protocol):
    """Turns states of an environment into messages and pictures.

    Attributes:
        drawing: How the page draws it, a key of `VIEWS`.
        azimuth: Direction of view in the plane of the table, degrees from x to y: "away" in the
            picture. None where the first two actions are no such plane.
    """

    @property
    def drawing(self) -> str: ...  # noqa: D102 - above

    @property
    def azimuth(self) -> float | None: ...  # noqa: D102 - above

    def place(self, state: Any) -> jax.Array:
        """Position of a state, for predicted paths; pure."""
        ...

    def scene(self, state: Any) -> dict[str, Any]:
        """The parts that stay for an episode."""
        ...

    def frame(self, state: Any, shown: Shown) -> dict[str, Any]:
        """The parts that change in every step."""
        ...

    def picture(self, number: int, state: Any, shown: Shown) -> None:
        """Order a picture, where the view makes any."""
        ...

    def close(self) -> None:
        """Stop the process that makes pictures, if any."""
        ...


Picture = Callable[[int, bytes], None]
"""`picture(number of the frame, JPEG)`."""


def make_view(env: Env, picture: Picture) -> View:
    """The view of an environment.

    Raises:
        UserError: If it has none.
    """
    return VIEWS[display_of(env.name).view or ""](env, picture)


def _rounded(values: Any, digits: int = 2) -> list[Any]:
    return np.round(np.asarray(values, np.float64), digits).tolist()


class RoadView:
    """The road from above."""

    drawing, azimuth = "road", None

    def __init__(self, env: Any, picture: Picture):
        del picture  # the page draws
        self.env = env

    def place(self, state: Any) -> jax.Array:
        """Centre of the ego, m."""
        return state.ego.pose[:2]

    def scene(self, state: Any) -> dict[str, Any]:
        """Road surfaces, the route's among them, lines and standing objects."""
        from envs.driving.rendering import CENTER_LINE, Scene
        from envs.driving.scenario import tree_index

        self.scenario = tree_index(self.env.default_params.scenarios, jnp.asarray(state.scenario))
        scene = Scene(self.scenario)
        scenario = scene.scenario
        lanes, objects = scenario.lanes, scenario.objects
        there = np.flatnonzero(lanes.width > 0)
        final = scene.surfaces[int(np.flatnonzero(there == int(scenario.final_lane))[0])]
        near = np.abs(objects.circle[:, :2]).max(-1) < 1e5
        return {
            "number": int(scenario.number),
            "roads": [_rounded(surface) for surface in scene.surfaces],
            "route": [int(lanes.route[lane]) for lane in there],
            "goal": _rounded(_end_of(final)),
            "lines": [_rounded(np.ravel(line)) for line, color in scene.lines],
            "middle": [int(color == CENTER_LINE) for _, color in scene.lines],
            "cones": _rounded(objects.circle[near]),
            "boxes": _rounded(objects.box_half),
            "wrecks": np.asarray(objects.box_is_vehicle).astype(int).tolist(),
            "cars": _rounded(scenario.traffic.half),
        }

    def frame(self, state: Any, shown: Shown) -> dict[str, Any]:
        """Poses of everything that moves."""
        from envs.driving import traffic as traffic_model
        from envs.driving.rendering import traffic_poses

        ego, speed = np.asarray(state.ego.pose), float(np.hypot(*np.asarray(state.ego.velocity)))
        cars = np.asarray(traffic_poses(self.scenario, state.traffic))
        status = np.asarray(state.traffic.status)
        return {
            "ego": _rounded(ego, 3),
            "cars": [
                None
                if kind == traffic_model.REMOVED
                else [*_rounded(pose), int(kind == traffic_model.PARKED)]
                for pose, kind in zip(cars, status, strict=True)
            ],
            "boxes": _rounded(state.box_pose),
            "novice": None if shown.novice is None else _rounded(shown.novice),
            "fails": shown.fails,
            "mine": None if shown.mine is None else _rounded(shown.mine),
            "more": [["speed", f"{3.6 * speed:.0f} km/h"]],
        }

    def picture(self, number: int, state: Any, shown: Shown) -> None:
        """None is made: the page draws."""

    def close(self) -> None:
        """Nothing runs."""


def _end_of(surface: np.ndarray) -> np.ndarray:
    """Far end of a lane's outline: its two corners, [2, 2]."""
    half = len(surface) // 2
    return surface[[half - 1, half]]


class ArmView:
    """The arm, rendered in a process of its own, which draws the newest state when it can."""

    drawing = "arm"

    def __init__(self, env: Any, picture: Picture):
        self.env, self._picture = env, picture
        self.azimuth = env.card.camera["azimuth"]
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_paint, args=(theirs, env.name), daemon=True)
        self._process.start()
        theirs.close()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def place(self, state: Any) -> jax.Array:
        """The grip site, m."""
        return self.env.grip_position(state)

    def scene(self, state: Any) -> dict[str, Any]:
        """The frames show everything."""
        return {"number": int(state.scenario)}

    def frame(self, state: Any, shown: Shown) -> dict[str, Any]:
        """A few figures beside the picture."""
        more = [list(reading) for reading in self.env.readings(state)]
        return {"fails": shown.fails, "more": more}

    def picture(self, number: int, state: Any, shown: Shown) -> None:
        """Hand the state over; the picture comes when it is ready."""
        try:
            self._pipe.send((number, jax.tree.map(np.array, state), shown))
        except (BrokenPipeError, OSError):
            return

    def _read(self) -> None:
        while True:
            try:
                number, jpeg = self._pipe.recv()
            except (EOFError, OSError):
                return
            self._picture(number, jpeg)

    def close(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.join(timeout=5)
        self._pipe.close()


VIEWS: dict[str, Callable[[Any, Picture], View]] = {"road": RoadView, "arm": ArmView}


def _paint(pipe: Any, name: str) -> None:
    """Draw the newest state, again and again, until the other end is closed."""
    import signal

    from PIL import Image

    from envs.manipulation.rendering import ArmPaths, ArmScene
    from envs.registry import make

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    scene = ArmScene(make(name), PICTURE, smooth=False)
    while True:
        try:
            number, state, shown = pipe.recv()
            while pipe.poll():
                number, state, shown = pipe.recv()
            pixels = scene.draw(
                state, ArmPaths(novice=shown.novice, takeover=shown.fails, expert=shown.mine)
            )
            out = io.BytesIO()
            Image.fromarray(pixels).save(out, "JPEG", quality=80)
            pipe.send((number, out.getvalue()))
        except (EOFError, OSError):
            return
