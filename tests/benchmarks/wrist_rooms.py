"""Simulated episodes of a camera on an arm's hand that sees its gripper, rendered by Drake."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.body import ArticulatedModel, load_model
from drake_pose.camera.models import PinholeCamera
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.benchmarks.rooms import LOG_HZ, Room, SimulatedEpisode, texture_picture, write_texture


@dataclass(frozen=True)
class Gripper:
    """An arm with a gripper."""

    file: str  # The model's, in the folder of data.
    link: str  # That carries the camera.
    arm: dict[str, float]  # Joint positions at which the hand looks down on a table.
    height: float  # Of the table in the robot's base frame [m].
    fingers: dict[str, tuple[float, float]]  # By joint its position closed and open [rad or m].
    reach: float  # Distance from the link's origin to the tips of the fingers [m].
    aside: tuple[float, float] = (0.06, 0.1)  # Bounds of the camera's from the fingers' axis [m].
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)  # Of the fingers in the link's frame.


_PANDA = dict(zip((f"panda_joint{k}" for k in range(1, 8)),
    (0.0, -0.1, 0.0, -2.3, 0.0, 2.2, 0.78), strict=True))  # fmt: skip
_SIGNS = {
    "finger_joint": 1.0, "left_inner_knuckle_joint": 1.0, "left_inner_finger_joint": -1.0,
    "right_inner_knuckle_joint": -1.0, "right_inner_finger_joint": 1.0,
    "right_outer_knuckle_joint": -1.0,
}  # fmt: skip
GRIPPERS = {
    "panda": Gripper(
        "franka_one_view/panda/panda.urdf", "panda_hand", _PANDA, 0.0,
        {"panda_finger_joint1": (0.0, 0.04), "panda_finger_joint2": (0.0, 0.04)}, 0.11,
    ),
    "robotiq": Gripper(
        "droid_episodes/robot/panda_robotiq.urdf", "panda_link8", _PANDA, 0.0,
        {name: (0.7 * sign, 0.0) for name, sign in _SIGNS.items()}, 0.2, (0.08, 0.13),
    ),
    "so101": Gripper(
        "so101/so101_new_calib.urdf", "gripper_link",
        {"shoulder_pan": 0.0, "shoulder_lift": -0.5, "elbow_flex": 0.4, "wrist_flex": 1.3,
         "wrist_roll": 0.0},
        -0.05, {"gripper": (-0.1, 1.0)}, 0.1, (0.05, 0.09), (0.0, 0.0, -1.0),
    ),
}  # fmt: skip


class WristRoom(Room):
    """A room with a table and things on it, and a thing that the hand may hold."""

    def __init__(
        self, model: ArticulatedModel, gripper: Gripper, folder: Path, seed: int, *,
        held: bool, contrast: float, things: int,
    ) -> None:  # fmt: skip
        """Build the room; held, contrast, things: as of ``simulate_wrist``."""
        self._gripper, self._held = gripper, held
        grey = np.random.default_rng([14, seed]).choice([0.1, 0.3, 0.6, 0.9])
        colour = (grey, grey, grey)
        super().__init__(model, folder, seed, colour=colour, grey=False, behind=0.0, near=0.01)

        rng, source = np.random.default_rng([12, seed]), self._source
        table = folder / f"table{seed}.png"
        picture = texture_picture(rng, grey=False)
        picture = 205.0 + contrast * (picture.astype(float) - 128.0)
        write_texture(table, picture)
        height = gripper.height
        self._wall(source, (0.5, 0.0, height - 0.02), (1.4, 1.6, 0.04), table)
        for _ in range(things):
            place = rng.uniform((0.05, -0.45, 0.0), (0.75, 0.45, 0.0))
            size = rng.uniform(0.02, 0.08, 3)
            place[2] = height + 0.5 * size[2]
            self._wall(source, place, size, None, rng.uniform(0, 1, 3))
        self._scene_context = self._scene_graph.CreateDefaultContext()

    def _furnish(self) -> None:
        """Put a thing between the fingers."""
        if self._held:
            one, link = self._gripper, self._plant.GetBodyByName(self._gripper.link)
            colour = [*self._rng.uniform(0, 1, 3), 1.0]
            place = RigidTransform(one.reach * np.array(one.axis))
            self._plant.RegisterVisualGeometry(link, place, Box(0.015, 0.03, 0.05), "held", colour)


def mount(
    rng: np.random.Generator, model: ArticulatedModel, one: Gripper, width: int, height: int
) -> PinholeCamera:
    """Return a camera beside the gripper that looks past its fingers, at X_LC.

    The gripper covers 6 to 45 % of its picture, and its fingers move in 1 % or more.
    """
    link = model.plant.GetBodyByName(one.link)
    context, shown = model.plant.CreateDefaultContext(), []
    for part in (0.0, 0.9):
        q = model.default_positions.copy()
        for joint, value in one.arm.items():
            q[model.position_index(joint)] = value
        for joint, (low, high) in one.fingers.items():
            q[model.position_index(joint)] = low + part * (high - low)
        shown.append(q)
    model.plant.SetPositions(context, shown[0])
    X_WL = link.EvalPoseInWorld(context).GetAsMatrix4()
    while True:
        camera = _random_mount(rng, one, width, height)
        renderer = LabelRenderer(model, camera.with_pose(X_WL @ camera.X_WC))
        closed, opened = (renderer.mask(q) for q in shown)
        moves = (closed != opened).mean() > 0.01
        if moves and 0.06 < closed.mean() < 0.45 and 0.06 < opened.mean() < 0.45:
            return camera


def _random_mount(rng: np.random.Generator, one: Gripper, width: int, height: int) -> PinholeCamera:
    """Return a camera at a random X_LC beside the gripper."""
    axis = np.array(one.axis)
    side = np.cross(axis, rng.normal(size=3))
    side /= np.linalg.norm(side)
    place = one.reach * rng.uniform(-0.35, 0.25) * axis + rng.uniform(*one.aside) * side
    aim = one.reach * rng.uniform(1.0, 2.2) * axis + rng.uniform(0.0, 0.4) * place
    z = (aim - place) / np.linalg.norm(aim - place)
    x = np.cross(z, side)
    x /= np.linalg.norm(x)
    R = np.column_stack([x, np.cross(z, x), z])
    X_LC = np.eye(4)
    roll = rng.choice([0.0, 90.0, 180.0, 270.0]) + rng.normal(0.0, 5.0)
    X_LC[:3, :3] = R @ Rotation.from_euler("z", roll, degrees=True).as_matrix()
    X_LC[:3, 3] = place
    focal = 0.5 * width / np.tan(np.radians(0.5 * rng.uniform(60.0, 90.0)))
    return PinholeCamera(
        "wrist", width, height, focal, focal, 0.5 * width - 0.5, 0.5 * height - 0.5, X_LC
    )


def simulate_wrist(
    data: Path, folder: Path, one: Gripper, seed: int, *, contrast: float = 0.6, things: int = 14,
    held: bool = False, motion: str = "free", late: float = 0.03, count: int = 60,
    away: bool = False, stands: bool = False,
) -> tuple[ArticulatedModel, SimulatedEpisode]:  # fmt: skip
    """Simulate an episode; its camera has the pose X_LC on the gripper's link.

    Args:
        data: folder of the models.
        one: the arm and its gripper.
        contrast: of the table's texture; 0.02: a faint grain. things: number of boxes on it.
        held: whether the hand holds a thing.
        motion: "free": all joints swing; "upright": the hand turns about the vertical only.
        late: how late the pictures are [s]. count: of pictures, five a second.
        away: whether the camera looks away from the gripper.
        stands: whether the camera stands half a metre behind the place where it would begin.
    """
    rng = np.random.default_rng([13, seed])
    model, (width, height) = load_model(data / one.file, check=False), (320, 240)
    camera = mount(rng, model, one, width, height)
    if away:
        turned = camera.X_WC.copy()
        turned[:3, :3] = turned[:3, :3] @ Rotation.from_euler("y", 100, degrees=True).as_matrix()
        camera = camera.with_pose(turned)
    arm = [model.position_index(k) for k in one.arm]
    middle = np.array([*one.arm.values()]) + rng.uniform(-0.1, 0.1, len(arm))
    amplitude = rng.uniform(0.12, 0.3, len(arm))
    if motion == "upright":
        amplitude[1:-1] = 0.0
        amplitude[[0, -1]] = 0.4, 0.5
    rate, phase = rng.uniform(0.4, 1.3, len(arm)), rng.uniform(0, 6, len(arm))
    closing = rng.uniform(0.5, 1.0), rng.uniform(0, 6)

    def at(times: Array) -> Array:
        q = np.tile(model.default_positions, (len(times), 1))
        q[:, arm] = middle + amplitude * np.sin(phase + rate * times[:, None])
        part = 0.5 + 0.5 * np.sin(closing[0] * times + closing[1])
        if held:
            part = 0.35 + 0.0 * part
        for joint, (low, high) in one.fingers.items():
            q[:, model.position_index(joint)] = low + part * (high - low)
        return q

    times = np.arange(count) / 5.0
    log_times = np.arange(-1.0, times[-1] + 1.0, 1.0 / LOG_HZ)
    room = WristRoom(model, one, folder, seed, held=held, contrast=contrast, things=things)
    context, pictures, first = model.plant.CreateDefaultContext(), [], None
    for q in at(times + late):
        model.plant.SetPositions(context, q)
        X_WL = model.plant.GetBodyByName(one.link).EvalPoseInWorld(context).GetAsMatrix4()
        placed = camera.with_pose(X_WL @ camera.X_WC)
        if stands:
            back = np.eye(4)
            back[2, 3] = -0.5
            first = first or placed.with_pose(placed.X_WC @ back)
            placed = first
        picture = room.picture(q, np.array([3.0, 3.0, 0.0]), placed)
        noisy = picture + rng.normal(0.0, 3.0, picture.shape)
        pictures.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return model, SimulatedEpisode(np.array(pictures), times, log_times, at(log_times), camera)
