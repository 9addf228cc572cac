"""Top-down pictures of the driving environment and films of an episode (needs the `render` extra).

Road grey, ego blue, traffic orange, wrecks and objects red; the predicted path is red when the
expert would take over and green when not, the expert's own is blue.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from envs.driving import traffic as traffic_model
from envs.driving.env import DrivingState
from envs.driving.geometry import lane_coordinates
from envs.driving.scenario import Scenario
from envs.driving.vehicle import HALF_SIZE

GRASS, ROAD, LINE = (214, 226, 208), (90, 92, 96), (235, 235, 235)
CENTER_LINE, EGO = (230, 200, 90), (36, 99, 235)
TRAFFIC, PARKED, WRECK, OBJECT = (232, 140, 36), (196, 176, 140), (150, 40, 40), (220, 60, 30)
DANGER, SAFE, EXPERT = (226, 36, 36), (32, 160, 70), (52, 120, 246)


class Paths(NamedTuple):
    """Predicted positions to draw, [H, 2] each, or None.

    Attributes:
        novice: Path under the novice's held action.
        takeover: Whether the expert would take over.
        expert: Path with the expert driving.
    """

    novice: np.ndarray | None = None
    takeover: bool = False
    expert: np.ndarray | None = None


class Camera:
    """Maps world metres to pixels, north up, centred on a point."""

    def __init__(self, center: np.ndarray, span: float, size: int):
        self.center, self.scale, self.size = np.asarray(center, float), size / span, size

    def __call__(self, points: np.ndarray) -> list[tuple[float, float]]:
        """World points [N, 2] to pixel pairs."""
        shifted = (np.atleast_2d(points) - self.center) * self.scale
        return [(self.size / 2 + x, self.size / 2 - y) for x, y in shifted]


def _rectangle(pose: np.ndarray, half: np.ndarray) -> np.ndarray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * half
    return corners @ np.array([[c, s], [-s, c]]) + pose[:2]


def _lane_outline(lanes: Any, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Left and right edge of lane i, [N, 2] each."""
    long = np.linspace(0.0, lanes.length[i], max(2, int(lanes.length[i] / 2) + 2))
    edges = []
    for side in (-0.5, 0.5):
        lateral = side * lanes.width[i]
        if lanes.turn[i] == 0:
            ahead = lanes.forward[i]
            right = np.array([ahead[1], -ahead[0]])
            edges.append(lanes.start[i] + long[:, None] * ahead + lateral * right)
        else:
            phi = lanes.turn[i] * long / lanes.radius[i] + lanes.phase[i]
            circle = np.stack([np.cos(phi), np.sin(phi)], -1)
            edges.append(lanes.center[i] + (lanes.radius[i] + lateral * lanes.turn[i]) * circle)
    return edges[0], edges[1]


class Scene:
    """A scenario ready to be drawn again and again: its road surface and the lines that show."""

    def __init__(self, scenario: Scenario):
        self.scenario = jax.tree.map(np.asarray, scenario)
        lanes = self.scenario.lanes
        self.surfaces: list[np.ndarray] = []
        pieces, owners, colors = [], [], []

        def add(points: np.ndarray, lane: int, color: tuple[int, int, int], every: int) -> None:
            found = np.stack([points[:-1], points[1:]], 1)[::every]
            pieces.append(found)
            owners.extend([lane] * len(found))
            colors.extend([color] * len(found))

        for i in np.flatnonzero(lanes.width > 0).tolist():
            left, right = _lane_outline(lanes, i)
            self.surfaces.append(np.concatenate([left, right[::-1]]))
            inner, last = lanes.number[i] > 0, lanes.number[i] == lanes.road_size[i] - 1
            add(left, i, LINE if inner else CENTER_LINE, every=3 if inner else 1)  # dashed
            if last:
                add(right, i, LINE, every=1)
        lines = np.concatenate(pieces)
        shown = np.flatnonzero(~self._covered(lines.mean(1), np.array(owners)))
        self.lines = [(lines[k], colors[k]) for k in shown]

    def _covered(self, points: np.ndarray, owners: np.ndarray) -> np.ndarray:
        """Whether points [N, 2] on lines of lanes [N] lie on another road (as in a junction)."""
        lanes = self.scenario.lanes
        first = (owners - lanes.number[owners])[:, None]
        index = np.arange(len(lanes.width))
        same_road = (index >= first) & (index < first + lanes.road_size[owners][:, None])
        padded = np.zeros((-(-len(points) // _ROWS) * _ROWS, 1, 2), np.float32)
        padded[: len(points), 0] = points
        found = _coordinates(lanes, padded)
        long, lateral = (np.asarray(x)[: len(points)] for x in found)
        on = (np.abs(lateral) < lanes.width / 2 - 0.2) & (long > 0.2) & (long < lanes.length - 0.2)
        return ((lanes.width > 0) & ~same_road & on).any(-1)


_ROWS = 1024  # points are looked up so many at a time: few programs
_coordinates = jax.jit(lane_coordinates)


def draw(
    scene: Scene,
    state: DrivingState,
    paths: Paths | None = None,
    *,
    size: int = 480,
    span: float = 80.0,
    caption: str = "",
) -> np.ndarray:
    """A top-down picture centred on the ego, RGB [size, size, 3] uint8.

    Args:
        scene: The scene of the state's scenario.
        state: State of the environment.
        paths: Predictions to draw.
        size: Pixels along an edge.
        span: Metres along an edge.
        caption: Text in the corner.
    """
    from PIL import Image, ImageDraw

    scenario, state = scene.scenario, jax.tree.map(np.asarray, state)
    ego = np.asarray(state.ego.pose)
    zoom = 2  # drawn twice as large, then halved: smooth edges
    camera = Camera(ego[:2], span, size * zoom)
    image = Image.new("RGB", (size * zoom, size * zoom), GRASS)
    pen = ImageDraw.Draw(image)
    for surface in scene.surfaces:
        pen.polygon(camera(surface), fill=ROAD)
    for points, color in scene.lines:
        pen.line(camera(points), fill=color, width=zoom)
    for pose, half, is_vehicle in zip(
        state.box_pose, scenario.objects.box_half, scenario.objects.box_is_vehicle, strict=True
    ):
        pen.polygon(camera(_rectangle(pose, half)), fill=WRECK if is_vehicle else OBJECT)
    for x, y, radius in scenario.objects.circle:
        px, py = camera(np.array([x, y]))[0]
        r = max(radius * camera.scale, 2.0 * zoom)
        pen.ellipse((px - r, py - r, px + r, py + r), fill=OBJECT)
    vehicles = np.asarray(traffic_poses(scenario, state.traffic))
    for pose, half, status in zip(
        vehicles, scenario.traffic.half, state.traffic.status, strict=True
    ):
        if status != traffic_model.REMOVED:
            color = PARKED if status == traffic_model.PARKED else TRAFFIC
            pen.polygon(camera(_rectangle(pose, half)), fill=color)
    pen.polygon(camera(_rectangle(ego, np.array(HALF_SIZE))), fill=EGO)
    if paths is not None:
        if paths.expert is not None:
            _path(pen, camera, ego[:2], paths.expert, color=EXPERT, zoom=zoom)
        if paths.novice is not None:
            color = DANGER if paths.takeover else SAFE
            _path(pen, camera, ego[:2], paths.novice, color=color, zoom=zoom)
    if caption:
        pen.text((8 * zoom, 8 * zoom), caption, fill=(20, 20, 20), font_size=13 * zoom)
    return np.asarray(image.resize((size, size), Image.Resampling.LANCZOS))


traffic_poses = jax.jit(traffic_model.poses)


def _path(
    pen: Any,
    camera: Camera,
    start: np.ndarray,
    path: np.ndarray,
    *,
    color: tuple[int, int, int],
    zoom: int,
) -> None:
    points = camera(np.concatenate([start[None], path]))
    pen.line(points, fill=color, width=3 * zoom)
    for x, y in points[1:]:
        pen.ellipse((x - 2.5 * zoom, y - 2.5 * zoom, x + 2.5 * zoom, y + 2.5 * zoom), fill=color)


def save_frames(path: str | Path, frames: list[np.ndarray], rate: float = 10.0) -> None:
    """Write frames as .gif or .mp4, or the last one as .png.

    Raises:
        ValueError: If the ending is none of these.
    """
    path = Path(path)
    if path.suffix == ".png":
        from PIL import Image

        Image.fromarray(frames[-1]).save(path)
    elif path.suffix == ".gif":
        from PIL import Image

        images = [Image.fromarray(frame).quantize(64) for frame in frames]
        images[0].save(
            path, save_all=True, append_images=images[1:], duration=int(1000 / rate), loop=0
        )
    elif path.suffix == ".mp4":
        _save_mp4(path, frames, rate)
    else:
        raise ValueError(f"out must end in .gif, .mp4 or .png, got {str(path)!r}")


def _save_mp4(path: Path, frames: list[np.ndarray], rate: float) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=round(rate))
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
