"""Simulated episodes of arms in rooms, rendered by Drake."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    GeometryInstance,
    LightParameter,
    MakeRenderEngineVtk,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    RenderLabel,
    Rgba,
    SceneGraph,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PlanarJoint, SpatialInertia
from pydrake.systems.sensors import CameraInfo

from drake_pose.arrays import Array
from drake_pose.body import ArticulatedModel
from drake_pose.camera.models import PinholeCamera

LOG_HZ = 50.0
"""Rows of a joint log per second."""

_PICTURES, _RATE_HZ = 60, 10.0
_WIDTH, _HEIGHT, _FOCAL = 640, 480, 600.0
_NOISE = 4.0


@dataclass(frozen=True, eq=False)
class SimulatedEpisode:
    """Images of an arm, and a joint log."""

    pictures: NDArray[np.uint8]  # (f, H, W, 3)
    times: Array  # (f,) of the images [s].
    log_times: Array  # (n,) of the joint log [s].
    positions: Array  # (n, nq) [rad or m].
    camera: PinholeCamera  # The true one.


class Room:
    """An arm in a room with textured walls, and a moving box of a person's size."""

    def __init__(
        self,
        model: ArticulatedModel,
        folder: Path,
        seed: int,
        grey: bool,
        behind: float,
        near: float = 0.05,
        colour: tuple[float, float, float] | None = None,
    ) -> None:
        """Build the room.

        near: minimum distance from the camera at which things are drawn [m]. colour: of links
        whose file gives none; None: the renderer's.
        """
        self._near = near
        rng = np.random.default_rng([8, seed])
        self.model, self._rng = model, rng
        self._scene_graph = SceneGraph()
        self._plant = MultibodyPlant(time_step=0.0)
        source = self._plant.RegisterAsSourceForSceneGraph(self._scene_graph)
        model.add_to(self._plant, self._scene_graph)
        self._robot = ModelInstanceIndex(self._plant.num_model_instances() - 1)
        # Floor, ceiling and four walls.
        for k, (place, size) in enumerate(
            [((0, 0, -0.06), (8, 8, 0.1)), ((0, 0, 3.0), (8, 8, 0.1)), ((4, 0, 1.5), (0.1, 8, 3)),
             ((-4, 0, 1.5), (0.1, 8, 3)), ((0, 4, 1.5), (8, 0.1, 3)), ((0, -4, 1.5), (8, 0.1, 3))]
        ):  # fmt: skip
            texture = folder / f"wall{seed}_{k}.png"
            write_texture(texture, texture_picture(rng, grey))
            self._wall(source, place, size, texture)
        for _ in range(5):
            angle = behind + rng.uniform(-1.8, 1.8)
            place = rng.uniform(0.8, 2.2) * np.array([np.cos(angle), np.sin(angle), 0.0])
            place[2] = rng.uniform(0.1, 0.8)
            paint = np.full(3, rng.uniform(0.2, 0.9)) if grey else rng.uniform(0, 1, 3)
            self._wall(source, place, rng.uniform(0.15, 0.6, 3), None, paint)
        self._person = own = self._plant.AddModelInstance("person")
        inertia = SpatialInertia.SolidCubeWithDensity(1.0, 1.0)
        person = self._plant.AddRigidBody("person", own, inertia)
        self._plant.AddJoint(
            PlanarJoint("walks", self._plant.world_frame(), person.body_frame(), [0, 0, 0])
        )
        own_colour = [0.5, 0.5, 0.55] if grey else rng.uniform(0, 1, 3).tolist()
        self._plant.RegisterVisualGeometry(
            person, RigidTransform([0, 0, 0.85]), Box(0.4, 0.3, 1.7), "person", [*own_colour, 1.0]
        )
        engine = _lights(rng)
        if colour is not None:
            engine.default_diffuse = np.array([*colour, 1.0])
        self._scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(engine))
        self._plant.Finalize()
        self._source = source
        self._context = self._plant.CreateDefaultContext()
        self._scene_context = self._scene_graph.CreateDefaultContext()

    def _wall(self, source, place, size, texture, colour=(1.0, 1.0, 1.0)) -> None:
        properties = PerceptionProperties()
        properties.AddProperty("label", "id", RenderLabel(30000))
        properties.AddProperty("phong", "diffuse", Rgba(*colour, 1.0))
        if texture is not None:
            properties.AddProperty("phong", "diffuse_map", str(texture))
        name = f"thing{self._rng.integers(1 << 40)}"
        geometry = GeometryInstance(RigidTransform(np.asarray(place, float)), Box(*size), name)
        geometry.set_perception_properties(properties)
        self._scene_graph.RegisterAnchoredGeometry(source, geometry)

    def picture(self, q: Array, person: Array, camera: PinholeCamera) -> NDArray[np.uint8]:
        """Return an image (H, W, 3) of the arm at q, and the box at (x, y, angle)."""
        plant, context = self._plant, self._context
        plant.SetPositions(context, self._robot, q)
        plant.SetPositions(context, self._person, person)
        poses = plant.get_geometry_pose_output_port().Eval(context)
        port = self._scene_graph.get_source_pose_port(plant.get_source_id())
        port.FixValue(self._scene_context, poses)
        info = CameraInfo(
            camera.width, camera.height, camera.focal_x, camera.focal_y,
            camera.center_x + 0.5, camera.center_y + 0.5,
        )  # fmt: skip
        core = RenderCameraCore("vtk", info, ClippingRange(self._near, 20.0), RigidTransform())
        query = self._scene_graph.get_query_output_port().Eval(self._scene_context)
        image = query.RenderColorImage(
            ColorRenderCamera(core, False), self._scene_graph.world_frame_id(),
            RigidTransform(camera.X_WC),
        )  # fmt: skip
        return np.array(image.data[..., :3])


def texture_picture(rng: np.random.Generator, grey: bool) -> NDArray[np.uint8]:
    """Return a random texture of patches and stripes."""
    picture = np.zeros((512, 512, 3), np.float32)
    for cells, weight in ((4, 0.5), (16, 0.3), (64, 0.2)):
        patches = rng.uniform(0, 255, (cells, cells, 3)).astype(np.float32)
        picture += weight * cv2.resize(patches, (512, 512), interpolation=cv2.INTER_LINEAR)
    for _ in range(12):
        a, b = rng.integers(0, 512, (2, 2)).tolist()
        cv2.rectangle(picture, a, b, rng.uniform(0, 255, 3).tolist(), int(rng.integers(2, 12)))
    if grey:
        picture = picture.mean(axis=-1, keepdims=True).repeat(3, axis=-1)
        picture = 90.0 + 0.4 * (picture - picture.mean()) + 60.0
    return np.clip(picture, 0, 255).astype(np.uint8)


def write_texture(path: Path, picture: NDArray[np.uint8] | Array) -> None:
    """Write a texture (H, W, 3) of values from 0 to 255."""
    cv2.imwrite(str(path), np.clip(picture, 0, 255).astype(np.uint8))


def _lights(rng: np.random.Generator) -> RenderEngineVtkParams:
    """Return lights from above and from the sides."""
    lights = [
        LightParameter(type="directional", direction=direction, frame="world", intensity=strength)
        for direction, strength in (
            (0.6 * _around(rng, -1.7), 0.9), (_around(rng, -0.3), 0.5), (_around(rng, 0.3), 0.4),
            (np.array([0.0, 0.0, 1.0]), 0.4),
        )
    ]  # fmt: skip
    return RenderEngineVtkParams(lights=lights)


def _around(rng: np.random.Generator, height: float) -> Array:
    """Return a random point on the unit circle at a height."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle), np.sin(angle), height])


def simulate(
    model: ArticulatedModel,
    folder: Path,
    seed: int,
    grey: bool = False,
    late: float = 0.0,
    distance: tuple[float, float] = (1.1, 1.7),
    middle: tuple[float, float, float] = (0.0, 0.0, 0.4),
    small: bool = False,
) -> SimulatedEpisode:
    """Simulate an arm that swings, seen by a camera on any side.

    Args:
        late: how late the pictures are [s].
        distance: bounds of the camera's distance from the point that it looks at [m].
        middle: this point (x, y, z) in the world [m], half as high as the arm is.
        small: whether the arm is about 50 pixels tall, in pictures of a quarter of the size.
    """
    width, height, focal = (320, 240, 150.0) if small else (_WIDTH, _HEIGHT, _FOCAL)
    rng = np.random.default_rng([9, seed])
    moving = np.isfinite(model.lower) & (model.upper - model.lower > 0.1)
    lower, upper = model.lower[moving], model.upper[moving]
    centre = 0.5 * (lower + upper) + 0.2 * (upper - lower) * rng.uniform(-1, 1, len(lower))
    amplitude = 0.25 * (upper - lower) * rng.uniform(0.5, 1.0, len(lower))
    rate, phase = rng.uniform(0.5, 1.6, (2, len(lower)))

    def at(times: Array) -> Array:
        q = np.tile(model.default_positions, (len(times), 1))
        q[:, moving] = centre + amplitude * np.sin(phase * 4.0 + rate * times[:, None])
        # Drake does not enforce <mimic> on positions that are set.
        for follower, leader, multiplier, offset in model.couplings:
            q[:, follower] = multiplier * q[:, leader] + offset
        return q

    length = focal * 2.0 * middle[2] / 50.0 if small else rng.uniform(*distance)
    away = length * _around(rng, rng.uniform(-0.1, 0.8))
    X_WC = np.eye(4)
    forward = -away / np.linalg.norm(away)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    X_WC[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    tilt = RollPitchYaw(rng.normal(0, 0.1), rng.normal(0, 0.1), rng.normal(0, 0.15))
    X_WC[:3, :3] = X_WC[:3, :3] @ tilt.ToRotationMatrix().matrix()
    X_WC[:3, 3] = np.array(middle) + away
    camera = PinholeCamera(
        "camera", width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5, X_WC
    )
    times = np.arange(_PICTURES) / _RATE_HZ
    log_times = np.arange(-1.0, times[-1] + 1.0, 1.0 / LOG_HZ)
    behind = float(np.arctan2(-away[1], -away[0]))
    room, angles = Room(model, folder, seed, grey, behind), behind + rng.uniform(-1.6, 1.6, 3)
    walk = rng.uniform(1.0, 2.2, (3, 1)) * np.column_stack([np.cos(angles), np.sin(angles)])
    pictures = []
    for t, q in zip(times, at(times + late), strict=True):
        progress = t / times[-1] * 2.0
        k = min(int(progress), 1)
        place = walk[k] + (progress - k) * (walk[k + 1] - walk[k])
        picture = room.picture(q, [place[0], place[1], progress], camera)
        noisy = picture + rng.normal(0.0, _NOISE, picture.shape)
        pictures.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return SimulatedEpisode(np.array(pictures), times, log_times, at(log_times), camera)
