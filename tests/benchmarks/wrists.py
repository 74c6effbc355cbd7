"""Benchmark of cameras on a wrist, registered from pictures alone: what is accepted, how far off.

Run as ``python -m tests.benchmarks.wrists DATA [--first K] [--only TEXT]``, see
``tests.benchmarks.episodes``. Each arm has an episode of each kind, with its own seed from K on;
Drake renders what a camera beside the gripper sees. Every second episode's pictures are those of a
video (H.264), the others' are PNG files.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.body import ArticulatedModel, load_model
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.registration.register import register_scene
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.benchmarks.episodes import Outcome, write_episode
from tests.benchmarks.registration import CameraError
from tests.benchmarks.rooms import LOG_HZ, Room, SimulatedEpisode, texture_picture, write_texture
from tests.benchmarks.tables import print_table


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
GRIPPERS = {
    "panda": Gripper(
        "franka_one_view/panda/panda.urdf", "panda_hand", _PANDA, 0.0,
        {"panda_finger_joint1": (0.0, 0.04), "panda_finger_joint2": (0.0, 0.04)}, 0.11,
    ),
    "so101": Gripper(
        "so101/so101_new_calib.urdf", "gripper_link",
        {"shoulder_pan": 0.0, "shoulder_lift": -0.5, "elbow_flex": 0.4, "wrist_flex": 1.3,
         "wrist_roll": 0.0},
        -0.05, {"gripper": (-0.1, 1.0)}, 0.1, (0.05, 0.09), (0.0, 0.0, -1.0),
    ),
}  # fmt: skip


class WristRoom(Room):
    """A room with a table and things on it."""

    def __init__(
        self, model: ArticulatedModel, gripper: Gripper, folder: Path, seed: int, *,
        contrast: float, things: int,
    ) -> None:  # fmt: skip
        """Build the room; contrast, things: as of ``simulate_wrist``."""
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


def mount(
    rng: np.random.Generator, model: ArticulatedModel, one: Gripper, width: int, height: int
) -> PinholeCamera:
    """Return a camera beside the gripper that looks past its fingers, at X_LC.

    The gripper covers 6 to 45 % of its picture, and its fingers move in 1 % or more.
    """
    link, context = model.plant.GetBodyByName(one.link), model.plant.CreateDefaultContext()
    shown = np.tile(model.default_positions, (2, 1))
    shown[:, [model.position_index(joint) for joint in one.arm]] = [*one.arm.values()]
    for joint, (low, high) in one.fingers.items():
        shown[:, model.position_index(joint)] = low, low + 0.9 * (high - low)
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
    motion: str = "free",
) -> tuple[ArticulatedModel, SimulatedEpisode]:  # fmt: skip
    """Simulate an episode of 12 s, its clock 30 ms late, with a camera at X_LC on a gripper's link.

    contrast: of the table's texture. things: number of boxes on it. motion: "free", or "upright":
    the hand turns about the vertical only.
    """
    rng = np.random.default_rng([13, seed])
    model, (width, height) = load_model(data / one.file, check=False), (320, 240)
    camera = mount(rng, model, one, width, height)
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
        for joint, (low, high) in one.fingers.items():
            q[:, model.position_index(joint)] = low + part * (high - low)
        return q

    times = np.arange(60) / 5.0
    log_times = np.arange(-1.0, times[-1] + 1.0, 1.0 / LOG_HZ)
    room = WristRoom(model, one, folder, seed, contrast=contrast, things=things)
    context, pictures = model.plant.CreateDefaultContext(), []
    for q in at(times + 0.03):
        model.plant.SetPositions(context, q)
        X_WL = model.plant.GetBodyByName(one.link).EvalPoseInWorld(context).GetAsMatrix4()
        placed = camera.with_pose(X_WL @ camera.X_WC)
        picture = room.picture(q, np.array([3.0, 3.0, 0.0]), placed)
        noisy = picture + rng.normal(0.0, 3.0, picture.shape)
        pictures.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return model, SimulatedEpisode(np.array(pictures), times, log_times, at(log_times), camera)


@dataclass(frozen=True)
class Kind:
    """A kind of episode."""

    name: str
    room: dict[str, Any] = field(default_factory=dict)  # Arguments of ``simulate_wrist``.
    wrong: str = ""  # What is wrong: "joints" or "mirrored"; "": nothing.


FEW = {"contrast": 0.1, "things": 4}
KINDS = (
    Kind("textured table, 14 things"),
    Kind("textured table, hand turns about the vertical", {"motion": "upright"}),
    Kind("faint table, 4 things", FEW),
    Kind("textured table, joints of another episode", wrong="joints"),
    Kind("textured table, mirrored pictures", wrong="mirrored"),
)


def decide(data: Path, name: str, kind: Kind, seed: int, codec: str) -> Outcome:
    """Simulate an episode of an arm, spoil it as the kind says, and register its camera.

    data: folder of the models. name: of the arm, a key of GRIPPERS. codec: of ``write_episode``.
    """
    one = GRIPPERS[name]
    path = data / one.file
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        model, episode = simulate_wrist(data, folder, one, seed, **kind.room)
        if kind.wrong == "mirrored":
            episode = replace(episode, pictures=episode.pictures[:, :, ::-1])
        elif kind.wrong == "joints":
            _, other = simulate_wrist(data, folder, one, seed + 1000, **kind.room)
            episode = replace(episode, positions=other.positions)
        write_episode(folder / "scene", model, episode, LOG_HZ, {}, (0.0, 0.0), codec)
        settings = RegistrationSettings(on=one.link)
        start = time.process_time()
        try:
            found = register_scene(folder / "scene", path, settings=settings)
        except RegistrationError as error:
            return Outcome(str(error), time.process_time() - start)
        seconds = time.process_time() - start
    return Outcome("", seconds, CameraError.of(found.registered["wrist"], episode.camera.X_WC))


def _rows(data: Path, first: int, only: str) -> Iterator[list[str]]:
    """Yield a row for each kind, and print every episode's result."""
    for n, kind in enumerate(KINDS):
        if only not in kind.name:
            continue
        found = list[Outcome]()
        for m, name in enumerate(GRIPPERS):
            seed = first + len(GRIPPERS) * n + m
            found.append(decide(data, name, kind, seed, "libx264" if seed % 2 else ""))
            print(kind.name, name, seed, found[-1], flush=True)
        accepted = [one.error for one in found if not one.refusal]
        off = [
            f"{one.millimetres:.2g} ({one.sd[0]:.2g}), {one.degrees:.2g} ({one.sd[1]:.2g})"
            for one in accepted
        ]
        yield [
            kind.name,
            f"{len(accepted)} of {len(found)}",
            "; ".join(off) if off and not kind.wrong else "-",
            "-" if kind.wrong else f"{sum(k.inside for k in accepted)} of {6 * len(accepted)}",
            f"{np.median([one.seconds for one in found]):.0f}",
        ]


def main() -> None:
    """Print a row for each kind of episode."""
    parser = argparse.ArgumentParser(description="Cameras on a wrist, from pictures alone.")
    parser.add_argument("data", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="")
    given = parser.parse_args()
    headings = (
        "episodes of two arms", "accepted", "mm (sd), degrees (sd)", "inside 95 %", "CPU s",
    )  # fmt: skip
    print_table("Cameras on a wrist", headings, _rows(given.data, given.first, given.only))


if __name__ == "__main__":
    main()
