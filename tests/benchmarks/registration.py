"""Benchmark of registrations: whether cameras are found without a guess, how well, and how fast.

Run as ``python -m tests.benchmarks.registration [DATA] [--cases N]``; DATA is a folder
with the scenes ``arm_two_views``, ``arm_one_view`` and ``franka_one_view``. The arms of these and,
where it is installed, the xArm7 of example-robot-data are drawn before cameras that stand anywhere;
without any of them an arm of boxes is. N is the number of simulated cases for each arm.
``--zeros N`` is that of calibrations of joints' zeros, which take some 15 s each.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from drake_pose.errors import RegistrationError
from drake_pose.jobs.registration.inputs import read_inputs
from drake_pose.jobs.registration.settings import RegistrationSettings
from drake_pose.registration.joint_zeros import calibrate_joints
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import CameraSearch, RegistrationBody
from drake_pose.registration.start_poses import areas
from tests.benchmarks.simulated_arms import (
    arm_files,
    damage,
    draw_arm,
    load_arm,
    random_values,
)

_SEED = 13_000
_FRAMES, _ZERO_FRAMES = 5, 10
_MOVED, _ZERO = 3, np.radians(2.0)
# A camera is found that is off by less [mm, deg].
_FOUND = (20.0, 2.0)
_INSIDE = 1.96


@dataclass(frozen=True)
class CameraOutcome:
    """How one simulated registration ended.

    Args:
        millimetres, degrees: how far the camera is off; infinite where none was answered.
        inside: of the six coordinates of its pose, how many 95 % intervals hold the truth.
        named: whether just the frame was named that is wrong, or none where none is.
        seconds: of the processor.
    """

    millimetres: float
    degrees: float
    inside: int
    named: bool
    seconds: float

    @property
    def found(self) -> bool:
        """Whether it is the camera's pose and no other that looks alike."""
        return self.millimetres < _FOUND[0] and self.degrees < _FOUND[1]


@dataclass(frozen=True)
class ZeroOutcome:
    """How one simulated calibration of joints' zeros ended.

    Args:
        off: (n,) errors of the determined zeros of the joints that were moved [deg].
        undetermined: how many of the joints that were moved are said to be undetermined.
        false: how many right zeros are called significant.
        right: how many zeros are right.
        inside: (m,) whether the 95 % intervals of determined zeros hold the truth.
        seconds: of the processor, the registration's among them.
    """

    off: NDArray[np.float64]
    undetermined: int
    false: int
    right: int
    inside: NDArray[np.bool_]
    seconds: float


def measure_camera(body: RegistrationBody, seed: int, damaged: bool) -> CameraOutcome:
    """Draws an arm and finds its camera.

    Args:
        body: the arm.
        seed: of the camera, the poses and the damage.
        damaged: whether masks are damaged, and one frame's positions are those of another pose.
    """
    rng = np.random.default_rng(seed)
    camera, frames = draw_arm(body, _FRAMES, rng)
    wrong: tuple[str, ...] = ()
    if damaged:
        frames = damage(frames, rng)
        k = int(rng.integers(len(frames)))
        wrong = (frames[k].name,)
        frames[k] = PosedFrame(frames[k].name, random_values(body, rng), frames[k].mask)
    start = time.process_time()
    try:
        found = CameraSearch(body).register(camera, frames)
    except RegistrationError:
        return CameraOutcome(np.inf, np.inf, 0, False, time.process_time() - start)
    seconds = time.process_time() - start
    error = pose_error(found.camera.X_WC, camera.X_WC)
    inside = np.abs(error) < _INSIDE * np.sqrt(np.diag(found.covariance))
    return CameraOutcome(
        *_sizes(error), int(np.count_nonzero(inside)), found.contradictions == wrong, seconds
    )


def measure_zeros(body: RegistrationBody, seed: int, damaged: bool) -> ZeroOutcome:
    """Draws an arm, three of whose encoders are off by 2 degrees, and finds its joints' zeros.

    Args:
        body: the arm.
        seed: as in measure_camera.
        damaged: whether masks are damaged.
    """
    rng = np.random.default_rng(seed)
    camera, frames = draw_arm(body, _ZERO_FRAMES, rng)
    if damaged:
        frames = damage(frames, rng)
    angles = np.flatnonzero(body.kinematics.is_angle)
    moved = rng.choice(angles, _MOVED, replace=False)
    true = np.zeros(len(body.kinematics.names))
    true[moved] = _ZERO * rng.choice([-1.0, 1.0], _MOVED)
    read = [PosedFrame(frame.name, frame.values - true, frame.mask) for frame in frames]
    start = time.process_time()
    registered = CameraSearch(body).register(camera, read)
    names = [body.kinematics.names[k] for k in angles]
    zeros = calibrate_joints(body, [registered], [read], names).zeros
    seconds = time.process_time() - start
    pairs = list(zip(zeros, true[angles], strict=True))
    told = [(one, value) for one, value in pairs if one.determined]
    return ZeroOutcome(
        np.degrees([abs(one.value - value) for one, value in told if value != 0.0]),
        sum(value != 0.0 and not one.determined for one, value in pairs),
        sum(value == 0.0 and one.significant for one, value in pairs),
        sum(value == 0.0 for _, value in pairs),
        np.array([one.low <= value <= one.high for one, value in told], dtype=np.bool_),
        seconds,
    )


def pose_error(X_WC: NDArray[np.float64], true: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6,) by what rotation vector [rad] and shift [m] in the world a pose (4, 4) is off."""
    turn = Rotation.from_matrix(true[:3, :3] @ X_WC[:3, :3].T).as_rotvec()
    return np.concatenate([turn, true[:3, 3] - X_WC[:3, 3]])


def _sizes(error: NDArray[np.float64]) -> tuple[float, float]:
    """How long a pose error (6,) is [mm, deg]."""
    return 1e3 * float(np.linalg.norm(error[3:])), float(np.degrees(np.linalg.norm(error[:3])))


def camera_table(arms: dict[str, RegistrationBody], cases: int) -> Table:
    """Simulated cameras, for each arm and all together.

    Args:
        arms: by name.
        cases: how many for each.
    """
    table = Table(title=f"Simulated arms, {_FRAMES} frames, no guess: where the camera is")
    for heading in ("arm, masks", "found", "error, median", "95 % hold", "named", "CPU, median"):
        table.add_column(heading, justify="left" if heading == "arm, masks" else "right")
    for damaged, masks in ((False, "exact"), (True, "damaged, one frame wrong")):
        every: list[CameraOutcome] = []
        for name, body in arms.items():
            own = [measure_camera(body, _SEED + k, damaged) for k in range(cases)]
            table.add_row(f"{name}, {masks}", *_camera_cells(own))
            every += own
        table.add_row(f"all, {masks}", *_camera_cells(every), end_section=True)
    return table


def _camera_cells(outcomes: Sequence[CameraOutcome]) -> list[str]:
    found = [one for one in outcomes if one.found]
    millimetres, degrees = (
        [getattr(one, key) for one in found] for key in ("millimetres", "degrees")
    )
    return [
        f"{len(found)} of {len(outcomes)}",
        f"{np.median(millimetres):.2f} mm, {np.median(degrees):.3f} deg" if found else "",
        f"{np.mean([one.inside for one in found]) / 6.0:.1%}" if found else "",
        f"{sum(one.named for one in outcomes)} of {len(outcomes)}",
        f"{np.median([one.seconds for one in outcomes]):.1f} s",
    ]


def zero_table(arms: dict[str, RegistrationBody], cases: int) -> Table:
    """Zeros of joints, three of which are off.

    Args:
        arms: by name.
        cases: how many for each.
    """
    table = Table(title=f"{_MOVED} encoders off by 2 degrees, {_ZERO_FRAMES} frames")
    for heading in ("masks", "runs", "error, median", "undetermined", "95 % hold", "false", "CPU"):
        table.add_column(heading, justify="left" if heading == "masks" else "right")
    for damaged, masks in ((False, "exact"), (True, "damaged")):
        runs = [
            measure_zeros(body, _SEED + k, damaged) for body in arms.values() for k in range(cases)
        ]
        off = np.concatenate([one.off for one in runs])
        table.add_row(
            masks,
            str(len(runs)),
            f"{np.median(off):.3f} deg" if len(off) else "",
            f"{sum(one.undetermined for one in runs)} of {_MOVED * len(runs)}",
            f"{np.mean(np.concatenate([one.inside for one in runs])):.1%}",
            f"{sum(one.false for one in runs)} of {sum(one.right for one in runs)}",
            f"{np.median([one.seconds for one in runs]):.1f} s",
        )
    return table


def recorded_table(data: Path) -> Table:
    """Recorded arms: all cameras' poses are withheld.

    Args:
        data: the folder of scenes; those that are not there are left out.
    """
    table = Table(title="Recorded arms, no guess")
    for heading in ("scene, camera", "from the file's", "IoU (at the file's)", "named", "CPU"):
        table.add_column(heading, justify="left" if heading == "scene, camera" else "right")
    for scene, model, joints, cameras in _recorded(data):
        inputs = read_inputs(scene, model, joints, RegistrationSettings(cameras=cameras))
        body = RegistrationBody(inputs.tree)
        for camera in inputs.searched:
            frames = inputs.frames[camera.name]
            start = time.process_time()
            found = CameraSearch(body).register(camera, frames)
            seconds = time.process_time() - start
            iou, distance = f"{np.mean([one.iou for one in found.frames]):.3f}", ""
            if cameras:
                off = _sizes(pose_error(found.camera.X_WC, camera.X_WC))
                distance = f"{off[0]:.1f} mm, {off[1]:.2f} deg"
                posed = PosedFrames(body.kinematics, body.all, camera, frames)
                seen, mask, both = areas(posed, camera.X_CW[None], np.inf)[0].T
                iou += f" ({np.mean(both / (seen + mask - both)):.3f})"
            named = ", ".join(found.contradictions) or "none"
            table.add_row(
                f"{scene.name} ({joints.stem}), {camera.name}",
                distance,
                iou,
                f"{named} of {len(frames)}",
                f"{seconds:.1f} s",
            )
    return table


def _recorded(data: Path) -> Iterator[tuple[Path, Path, Path, tuple[str, ...]]]:
    """Scene, model, joint positions and, where their X_WC is in the file, cameras."""
    lbr = data / "arm_two_views" / "med7" / "med7.urdf"
    panda = data / "franka_one_view" / "panda" / "panda.urdf"
    every = (
        ("arm_two_views", lbr, "joint_angles", ("left", "right")),
        ("arm_one_view", lbr, "joint_angles", ()),
        ("franka_one_view", panda, "joint_angles", ()),
        ("franka_one_view", panda, "joint_angles_fitted", ()),
    )
    for name, model, joints, cameras in every:
        scene = data / name
        if scene.is_dir() and model.is_file():
            yield scene, model, scene / f"{joints}.csv", cameras


def main() -> None:
    """Print whether cameras are found here, how well and how fast."""
    parser = argparse.ArgumentParser(description="Where cameras stand: errors and times.")
    parser.add_argument("data", nargs="?", type=Path, help="a folder of recorded scenes")
    parser.add_argument("--cases", type=int, default=2, help="simulated cases for each arm")
    parser.add_argument(
        "--zeros", type=int, default=1, help="calibrations of zeros for each arm; 0: none"
    )
    asked = parser.parse_args()
    console = Console(width=120)
    with tempfile.TemporaryDirectory() as folder:
        files = arm_files(asked.data, Path(folder))
        arms = {name: load_arm(path) for name, path in files.items()}
    console.print(camera_table(arms, asked.cases))
    if asked.zeros > 0:
        console.print(zero_table(arms, asked.zeros))
    if asked.data is not None:
        console.print(recorded_table(asked.data))


if __name__ == "__main__":
    main()
