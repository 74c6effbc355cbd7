"""Benchmark of tracking by colour: an arm that moves before rooms, beside tracking by exact masks.

Run as ``python -m tests.benchmarks.colour MODEL [--seed N] [--frames N] [--size W H]
[--easy]``; MODEL is the file of an arm, such as the LBR Med 7's. Drake's renderer draws it before
textured walls, in two cameras; each row of the table is one run of one motion. The seed is of the
motion and of the room.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Cylinder,
    GeometryId,
    LightParameter,
    MakeRenderEngineVtk,
    PerceptionProperties,
    QueryObject,
    RenderEngineVtkParams,
    RenderLabel,
    Rgba,
    Role,
    Shape,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import RigidBody, SpatialInertia
from pydrake.systems.framework import Diagram, DiagramBuilder
from rich.console import Console
from rich.table import Table

from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.camera.drake import camera_to_drake
from drake_pose.camera.models import PinholeCamera
from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.tracking.contour_tracker import ContourTracker
from drake_pose.jobs.estimate.inputs import make_tree
from drake_pose.results.settings import EstimateSettings

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]

_SIZE, _RATE = (640, 480), 30.0
# The focal length of pictures, over their height.
_FOCAL = 1.25
_EYES = ((2.1, -1.4, 1.1), (1.9, 1.7, 1.2))
_RENDERER = "colour"
_OTHERS = RenderLabel(2000)
# Sides of walls and where they stand [m].
_WALLS = (
    ((8.0, 8.0, 0.1), (0.0, 0.0, -0.06)),
    ((0.1, 8.0, 6.0), (-3.0, 0.0, 2.0)),
    ((0.1, 8.0, 6.0), (3.0, 0.0, 2.0)),
    ((8.0, 0.1, 6.0), (0.0, 3.0, 2.0)),
    ((8.0, 0.1, 6.0), (0.0, -3.0, 2.0)),
)
_LIGHTS = (((-0.4, 0.5, -1.0), 0.8), ((0.5, -0.6, -0.3), 0.5))
_ORANGE, _BRIGHT = (0.95, 0.45, 0.1), (0.85, 0.85, 0.83)
_COLOURS = (
    _BRIGHT, _ORANGE, _BRIGHT, _ORANGE, (0.8, 0.8, 0.8), _ORANGE, (0.3, 0.3, 0.32),
    (0.6, 0.6, 0.62),
)  # fmt: skip
_GREYS = ((0.8,) * 3, (0.65,) * 3, (0.7,) * 3, (0.55,) * 3)
_SPEED, _FASTEST = 2.8, 4.0
_BOXES = 6
# A frame is wrong where a joint is off by more [degrees].
_WRONG = 10.0


@dataclass(frozen=True)
class Room:
    """What stands about an arm.

    Args:
        name: of the table's row.
        grey: whether arm and room are.
        noise: of every pixel, of 255.
        boxes: how many move about behind the arm.
        post: whether one moves between the arm and the cameras.
    """

    name: str
    grey: bool = False
    noise: float = 0.0
    boxes: int = 0
    post: bool = False


ROOMS = (
    Room("orange and grey arm, room of many colours"),
    Room("boxes move about behind the arm", boxes=_BOXES),
    Room("a post moves between the arm and the cameras", post=True),
    Room("noise of 12 of 255 on every pixel", noise=12.0),
    Room("grey arm before a grey room", grey=True),
)


@dataclass(frozen=True, eq=False)
class Frame:
    """What is shown of a moment.

    Args:
        q: (nq,) the truth.
        pictures: of each camera.
        masks: exact, of each camera.
    """

    q: Array
    pictures: list[Picture]
    masks: list[Mask]


@dataclass(frozen=True, eq=False)
class ColourOutcome:
    """How one sequence was followed.

    Args:
        errors: (frames, joints) [degrees].
        deviations: (frames, joints) as the tracker says [degrees].
        lost: (frames,) whether the track was said to be.
        milliseconds: of the processor, for a frame.
    """

    errors: Array
    deviations: Array
    lost: Mask
    milliseconds: float

    @property
    def inside(self) -> float:
        """The share of truths within two standard deviations."""
        return float(np.mean(self.errors < 2.0 * self.deviations))

    @property
    def wrong(self) -> Mask:
        """(frames,) where a joint is far off."""
        return self.errors.max(axis=1) > _WRONG


class ColourScene:
    """An arm that moves before a room, drawn by Drake.

    Attributes:
        cameras: what is seen by.
        rng: what room and motion are drawn from.

    Args:
        model: the arm.
        room: what stands about it.
        seed: of the room and the motion.
        folder: where walls' textures are written.
        size: of the pictures, width and height [pixel].
    """

    def __init__(
        self,
        model: ArticulatedModel,
        room: Room,
        seed: int,
        folder: Path,
        size: tuple[int, int] = _SIZE,
    ) -> None:
        self.rng, self._room, self._folder = np.random.default_rng(seed), room, folder
        self.cameras: tuple[PinholeCamera, ...] = tuple(
            _camera(f"camera{k}", eye, size) for k, eye in enumerate(_EYES)
        )
        self._joints, self._default = len(model.position_names), model.default_positions
        builder = DiagramBuilder()
        self._plant, self._scene = AddMultibodyPlantSceneGraph(builder, 0.0)
        model.add_to(self._plant, self._scene)
        self._paint(model)
        self._add_walls()
        self._boxes = [self._add_box(k) for k in range(room.boxes)]
        self._post = self._add_post() if room.post else None
        lights = [
            LightParameter(
                type="directional", frame="world", direction=list(direction), intensity=strength
            )
            for direction, strength in _LIGHTS
        ]
        self._scene.AddRenderer(
            _RENDERER, MakeRenderEngineVtk(RenderEngineVtkParams(lights=lights))
        )
        self._plant.Finalize()
        # An arm that stands on a floating base stays there.
        bases = [self._plant.get_body(k) for k in self._plant.GetFloatingBaseBodies()]
        starts = [base.floating_positions_start() for base in bases]
        self._held = [k for start in starts for k in range(start, start + 7) if k < self._joints]
        self._diagram: Diagram = builder.Build()

    def frames(self, count: int) -> Iterator[Frame]:
        """The frames of the motion, drawn one by one."""
        swing, paths = self.draw_swing(), self._draw_paths()
        context = self._diagram.CreateDefaultContext()
        own = self._plant.GetMyMutableContextFromRoot(context)
        query = self._scene.get_query_output_port()
        for k in range(count):
            moment = k / _RATE
            middle, amplitude, speed, phase = swing
            q = middle + amplitude * np.sin(speed * moment + phase)
            q[self._held] = self._default[self._held]
            positions = self._plant.GetPositions(own).copy()
            positions[: self._joints] = q
            self._plant.SetPositions(own, positions)
            for body, path in zip(self._boxes, paths, strict=True):
                self._plant.SetFreeBodyPose(own, body, RigidTransform(_behind(path, moment)))
            if self._post is not None:
                across = [0.8, -1.0 + 1.6 * k / count, 0.6]
                self._plant.SetFreeBodyPose(own, self._post, RigidTransform(across))
            yield self._draw(q, query.Eval(self._scene.GetMyContextFromRoot(context)))

    def _draw(self, q: Array, query: QueryObject) -> Frame:
        """What the cameras see."""
        pictures, masks, world = [], [], self._scene.world_frame_id()
        for camera in self.cameras:
            color, _, X_WC = camera_to_drake(camera, renderer_name=_RENDERER)
            picture = query.RenderColorImage(color, world, X_WC).data[..., :3].copy()
            labels = query.RenderLabelImage(color, world, X_WC).data[..., 0]
            if self._room.noise:
                noisy = picture + self.rng.normal(0.0, self._room.noise, picture.shape)
                picture = noisy.clip(0, 255).astype(np.uint8)
            pictures.append(picture)
            masks.append((labels < int(_OTHERS) // 2) & (labels >= 0))
        return Frame(q, pictures, masks)

    def draw_swing(self) -> tuple[Array, Array, Array, Array]:
        """Middles and amplitudes [rad], speeds [rad/s] and phases [rad] of the joints' swings."""
        rng, n = self.rng, self._joints
        low = np.maximum(self._plant.GetPositionLowerLimits()[:n], -2.9)
        high = np.minimum(self._plant.GetPositionUpperLimits()[:n], 2.9)
        amplitude = rng.uniform(0.5, 0.9, n) * np.minimum(0.45 * (high - low), 1.2)
        middle = (low + high) / 2 + rng.uniform(-0.2, 0.2, n)
        speed = np.minimum(rng.uniform(0.5, 1.0, n) * _SPEED / amplitude, _FASTEST)
        return middle, amplitude, speed, rng.uniform(0.0, 2.0 * np.pi, n)

    def _draw_paths(self) -> list[tuple[Array, Array, Array, Array]]:
        """Of each box: the middle and the amplitude [m], speed [rad/s] and phase [rad]."""
        rng = self.rng
        return [
            (
                rng.uniform(-2.5, 2.5, 3) + np.array([0.0, 0.0, 1.0]),
                rng.uniform(0.5, 1.5, 3),
                rng.uniform(1.0, 2.5, 3),
                rng.uniform(0.0, 6.0, 3),
            )
            for _ in self._boxes
        ]

    def _paint(self, model: ArticulatedModel) -> None:
        """Gives the arm's links colours in turn."""
        inspector = self._scene.model_inspector()
        order = {name: k for k, name in enumerate(model.link_meshes)}
        colours = _GREYS if self._room.grey else _COLOURS
        for geometry in inspector.GetAllGeometryIds(Role.kPerception):
            link = inspector.GetName(inspector.GetFrameId(geometry)).split("::")[-1]
            if link in order:
                seen = PerceptionProperties(inspector.GetPerceptionProperties(geometry))
                colour = colours[order[link] % len(colours)]
                seen.UpdateProperty("phong", "diffuse", Rgba(*colour, 1.0))
                self._assign(geometry, seen)

    def _assign(self, geometry: GeometryId, seen: PerceptionProperties) -> None:
        source = self._plant.get_source_id()
        self._scene.RemoveRole(source, geometry, Role.kPerception)
        self._scene.AssignRole(source, geometry, seen)

    def _show(self, body: RigidBody, X: RigidTransform, shape: Shape, colour: Sequence[float],
              texture: Path | None = None) -> None:  # fmt: skip
        """Something that is no part of the arm."""
        name = f"shape{len(self._scene.model_inspector().GetAllGeometryIds())}"
        geometry = self._plant.RegisterVisualGeometry(body, X, shape, name, np.ones(4))
        seen = PerceptionProperties()
        seen.AddProperty("label", "id", _OTHERS)
        seen.AddProperty("phong", "diffuse", Rgba(*colour, 1.0))
        if texture is not None:
            seen.AddProperty("phong", "diffuse_map", str(texture))
        self._assign(geometry, seen)

    def _add_walls(self) -> None:
        for k, (sides, place) in enumerate(_WALLS):
            path = self._folder / f"wall{k}.png"
            _write_texture(path, self.rng, self._room.grey)
            self._show(
                self._plant.world_body(), RigidTransform(place), Box(*sides), (1.0,) * 3, path
            )

    def _add_body(self, name: str) -> RigidBody:
        inertia = SpatialInertia.SolidBoxWithDensity(1.0, 0.1, 0.1, 0.1)
        return self._plant.AddRigidBody(name, self._plant.AddModelInstance(name), inertia)

    def _add_box(self, number: int) -> RigidBody:
        body = self._add_body(f"box{number}")
        shape = Box(*self.rng.uniform(0.3, 0.9, 3))
        colour = self.rng.random(3)
        self._show(body, RigidTransform(), shape, tuple(colour))
        return body

    def _add_post(self) -> RigidBody:
        body = self._add_body("post")
        self._show(body, RigidTransform(), Cylinder(0.05, 1.5), (0.2, 0.5, 0.25))
        return body


def _camera(name: str, eye: Sequence[float], size: tuple[int, int]) -> PinholeCamera:
    """A camera that looks at the arm's middle."""
    ahead = np.array([0.0, 0.0, 0.5]) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    X_WC[:3, 3] = eye
    (width, height), focal = size, _FOCAL * size[1]
    centre = (width / 2 - 0.5, height / 2 - 0.5)
    return PinholeCamera(name, width, height, focal, focal, *centre, X_WC)


def _behind(path: tuple[Array, Array, Array, Array], moment: float) -> Array:
    """(3,) where a box is at a moment [s]: on the far side of the arm [m]."""
    middle, amplitude, speed, phase = path
    p_W = middle + amplitude * np.sin(speed * moment + phase)
    angle = np.pi + 0.8 * (np.arctan2(p_W[1], p_W[0]) % np.pi - np.pi / 2)
    return np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), p_W[2]])


def _write_texture(path: Path, rng: np.random.Generator, grey: bool) -> None:
    """Clouds of all sizes with sixty rectangles before them."""
    side, picture = 1024, np.zeros((1024, 1024, 3))
    for k in (4, 16, 64, 256):
        clouds = cv2.resize(rng.random((k, k, 3)), (side, side), interpolation=cv2.INTER_CUBIC)
        picture += clouds / (1.0 + np.log2(k) / 4.0)
    picture = (picture - picture.min()) / (picture.max() - picture.min())
    for _ in range(60):
        corner = rng.integers(0, side, 2)
        other = corner + rng.integers(20, 200, 2)
        colour = tuple(rng.random(3).tolist())
        cv2.rectangle(picture, tuple(corner.tolist()), tuple(other.tolist()), colour, -1)
    if grey:
        picture = np.repeat(picture.mean(axis=2, keepdims=True), 3, axis=2) * 0.35 + 0.45
    cv2.imwrite(str(path), (picture * 255.0).clip(0, 255).astype(np.uint8))


def follow(
    observation: ContourObservation, frames: Sequence[Frame], by_colour: bool
) -> ColourOutcome:
    """Follows an arm that is known in the first frame, by its colours or by exact masks.

    The last joint is left out: the flange is round.
    """
    tracker = ContourTracker(observation, 1.0 / _RATE)
    track = tracker.start(observation.state(frames[0].q))
    # A base stays where it is.
    joints = np.flatnonzero(np.ptp([frame.q for frame in frames], axis=0) > 0.0)[:-1]
    errors, deviations, lost, seconds = [], [], [], []
    for k, frame in enumerate(frames):
        masks = [None] * len(frame.masks) if by_colour else frame.masks
        start = time.process_time()
        track = tracker.follow(track, masks, k == 0, pictures=frame.pictures if by_colour else None)
        seconds.append(time.process_time() - start)
        belief = track.state.best
        errors.append(np.abs(observation.positions(belief.mean)[0] - frame.q)[joints])
        deviations.append(belief.deviations()[: len(joints)])
        lost.append(track.lost)
    return ColourOutcome(
        np.degrees(errors[1:]),
        np.degrees(deviations[1:]),
        np.array(lost[1:]),
        1e3 * float(np.median(seconds[1:])),
    )


def measure_room(
    model: ArticulatedModel,
    room: Room,
    seed: int,
    count: int,
    size: tuple[int, int] = _SIZE,
) -> tuple[ColourOutcome, ...]:
    """Follows an arm before one room by exact masks and by colour.

    Args:
        model: the arm.
        room: what stands about it.
        seed: of the room and the motion.
        count: how many frames.
        size: of the pictures, width and height [pixel].
    """
    with tempfile.TemporaryDirectory() as folder:
        scene = ColourScene(model, room, seed, Path(folder), size)
        frames = list(scene.frames(count))
    observation = ContourObservation(make_tree(model, EstimateSettings(), None), scene.cameras)
    follow(observation, frames[:2], True)
    return follow(observation, frames, False), follow(observation, frames, True)


def colour_table(
    model: ArticulatedModel,
    seed: int,
    count: int,
    size: tuple[int, int] = _SIZE,
    rooms: Sequence[Room] = ROOMS,
) -> Table:
    """Errors of each room's run; arguments as of measure_room."""
    table = Table(title=f"{count - 1} frames, seed {seed}; errors in degrees, median / p95")
    for heading in ("", "masks", "colour", "ratio", "within 2 sd", "not lost", "lost", "wrong",
                    "not said", "CPU ms, masks", "colour"):  # fmt: skip
        table.add_column(heading, justify="right" if heading else "left")
    for room in rooms:
        masks, colour = measure_room(model, room, seed, count, size)
        medians = [float(np.median(one.errors)) for one in (masks, colour)]
        kept = ~colour.lost
        held = np.mean(colour.errors[kept] < 2.0 * colour.deviations[kept]) if kept.any() else 0.0
        table.add_row(
            room.name,
            *(f"{np.median(one.errors):.2f} / {np.percentile(one.errors, 95):.1f}"
              for one in (masks, colour)),
            f"{medians[1] / medians[0]:.1f}",
            f"{colour.inside:.2f}",
            f"{held:.2f}",
            str(np.count_nonzero(colour.lost)),
            str(np.count_nonzero(colour.wrong)),
            str(np.count_nonzero(colour.wrong & kept)),
            f"{masks.milliseconds:.0f}",
            f"{colour.milliseconds:.0f}",
        )  # fmt: skip
    return table


def main() -> None:
    """Print how well an arm is followed by colour alone, and when the track is said to be lost."""
    parser = argparse.ArgumentParser(description="Tracking by colour: errors and times.")
    parser.add_argument("model", type=Path, help="the model file of an arm")
    parser.add_argument("--seed", type=int, default=0, help="of the rooms and the motion")
    parser.add_argument("--frames", type=int, default=90, help="of each run")
    parser.add_argument(
        "--size", type=int, nargs=2, default=_SIZE, metavar=("WIDTH", "HEIGHT"),
        help="of the pictures [pixel]",
    )  # fmt: skip
    parser.add_argument("--easy", action="store_true", help="the first room alone")
    asked = parser.parse_args()
    model = load_model(asked.model, check=False)
    rooms = ROOMS[:1] if asked.easy else ROOMS
    Console(width=160).print(
        colour_table(model, asked.seed, asked.frames, tuple(asked.size), rooms)
    )


if __name__ == "__main__":
    main()
