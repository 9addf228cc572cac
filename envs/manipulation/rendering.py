"""Pictures of the arm environments, through MuJoCo's offscreen renderer.

The predicted path of the grip site is drawn red where the expert would take over and green where
not; the expert's own is blue, as in driving. Shadows and reflections are off: they cost more than
all the rest.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from typing import Any, NamedTuple

import numpy as np

from envs.manipulation.drawn import drawn
from envs.manipulation.physics.mujoco_c import import_mujoco

DANGER, SAFE, EXPERT = (0.89, 0.14, 0.14, 1.0), (0.13, 0.63, 0.27, 1.0), (0.2, 0.47, 0.96, 1.0)
_WIDTH = 0.004  # m, of a drawn path


class ArmPaths(NamedTuple):
    """Predicted positions of the grip site to draw, [H, 3] each, or None.

    Attributes:
        novice: Path under the novice's held action.
        takeover: Whether the expert would take over.
        expert: Path with the expert at the controls.
    """

    novice: np.ndarray | None = None
    takeover: bool = False
    expert: np.ndarray | None = None


def _renderer(mujoco: Any, model: Any, height: int, width: int) -> Any:
    """An offscreen renderer: the backend that MUJOCO_GL names, else EGL, else OSMesa.

    Raises:
        RuntimeError: One line, where none works.
    """
    try:
        return mujoco.Renderer(model, height, width)
    except Exception as error:  # each backend fails in its own way
        tried = os.environ.get("MUJOCO_GL", "egl")
        raise RuntimeError(
            f"no offscreen OpenGL through {tried} ({type(error).__name__}): install EGL "
            "(Debian: libegl1 libgl1-mesa-dri) or OSMesa (libosmesa6, then MUJOCO_GL=osmesa)"
        ) from error


def choose_backend() -> None:
    """Set `MUJOCO_GL` where it is unset: EGL if it works here, else OSMesa.

    Tried in a process of its own, since a backend cannot be changed once loaded. MuJoCo picks one
    when it is imported, which a scene on MJX does before anything is drawn: it picks again.
    """
    if "MUJOCO_GL" in os.environ:
        return
    probe = "import mujoco; mujoco.GLContext(16, 16).make_current()"
    done = subprocess.run(
        [sys.executable, "-c", probe], env=os.environ | {"MUJOCO_GL": "egl"}, capture_output=True
    )
    os.environ["MUJOCO_GL"] = "egl" if done.returncode == 0 else "osmesa"
    picks = sys.modules.get("mujoco.rendering.classic.gl_context")
    if picks is not None:
        importlib.reload(picks)


class ArmScene:
    """An environment ready to be drawn again and again."""

    def __init__(self, env: Any, size: tuple[int, int] = (300, 400), smooth: bool = True):
        """Make the renderer, in the thread that is to draw.

        Args:
            env: The environment.
            size: Height and width, pixels.
            smooth: Edges without steps; half of the time goes there where no GPU draws.
        """
        choose_backend()
        self.mujoco = mujoco = import_mujoco()
        self.twin = drawn(env)
        self.model, self.data = self.twin.arm.model, self.twin.arm.data
        if not smooth:
            self.model.vis.quality.offsamples = 0
        self.renderer = _renderer(mujoco, self.model, *size)
        self.camera = mujoco.MjvCamera()
        for field, value in env.card.camera.items():
            setattr(self.camera, field, value)
        self.options = mujoco.MjvOption()
        self.options.geomgroup[3] = 0  # what is only felt

    def draw(self, state: Any, paths: ArmPaths | None = None) -> np.ndarray:
        """Picture of a state, [height, width, 3] of bytes."""
        self.twin.place(state)
        self.mujoco.mj_forward(self.model, self.data)
        self.renderer.update_scene(self.data, self.camera, self.options)
        scene = self.renderer.scene
        for flag in (self.mujoco.mjtRndFlag.mjRND_SHADOW, self.mujoco.mjtRndFlag.mjRND_REFLECTION):
            scene.flags[flag] = 0
        if paths is not None:
            site = np.array(self.data.site_xpos[self.twin.arm.site])
            self._path(scene, site, paths.expert, EXPERT)
            self._path(scene, site, paths.novice, DANGER if paths.takeover else SAFE)
        return self.renderer.render()

    def _path(
        self, scene: Any, start: np.ndarray, points: np.ndarray | None, colour: tuple[float, ...]
    ) -> None:
        if points is None:
            return
        mujoco, last = self.mujoco, start
        for point in np.asarray(points, float):
            if scene.ngeom >= scene.maxgeom or np.linalg.norm(point - last) < 1e-4:
                continue
            shape = scene.geoms[scene.ngeom]
            kind = mujoco.mjtGeom.mjGEOM_CAPSULE
            mujoco.mjv_initGeom(
                shape, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array(colour, np.float32)
            )
            mujoco.mjv_connector(shape, kind, _WIDTH, last, point)
            scene.ngeom += 1
            last = point
