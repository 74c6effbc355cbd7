"""Benchmark of registrations: whether cameras are found without a guess, how well, and how fast.

Run as ``python -m tests.benchmarks.registration [DATA] [--cases N] [--zeros N]``; DATA is a folder
with the scenes ``arm_two_views``, ``arm_one_view`` and ``franka_one_view``, N the number of
simulated cases for each arm (scenes.arm_files), and of calibrations of joints' zeros.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.errors import RegistrationError
from drake_pose.jobs.registration.inputs import read_inputs
from drake_pose.jobs.registration.settings import RegistrationSettings
from drake_pose.registration.joint_zeros import calibrate_joints
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import CameraSearch, RegistrationBody
from drake_pose.registration.start_poses import areas
from tests.benchmarks.scenes import (
    Array,
    arm_files,
    damaged,
    draw_arm,
    load_arm,
    print_table,
    random_values,
)

_SEED = 13_000
_FRAMES, _ZERO_FRAMES = 5, 10
_MOVED, _ZERO = 3, np.radians(2.0)
# A camera is found that is off by less [mm, deg].
_FOUND = (20.0, 2.0)


class CameraOutcome(NamedTuple):
    """Of one registration: how far off [mm, deg], how many of the six 95 % intervals hold the
    truth, whether just the wrong frames were named, and the processor's seconds.
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


class ZeroOutcome(NamedTuple):
    """Of one calibration of zeros: errors [deg] of those determined of the joints that were moved,
    how many of these are undetermined, how many of the right zeros are called significant, whether
    determined intervals hold the truth, and the processor's seconds, the registration's among them.
    """

    off: Array
    undetermined: int
    false: int
    right: int
    inside: list[bool]
    seconds: float


def measure_camera(body: RegistrationBody, seed: int, worn: bool) -> CameraOutcome:
    """Draws an arm and finds its camera; worn: masks are damaged, one frame's positions wrong."""
    rng = np.random.default_rng(seed)
    camera, frames = draw_arm(body, _FRAMES, rng)
    wrong: tuple[str, ...] = ()
    if worn:
        frames = [replace(frame, mask=damaged(frame.mask, rng)) for frame in frames]
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
    inside = np.abs(error) < 1.96 * np.sqrt(np.diag(found.covariance))
    named = found.contradictions == wrong
    return CameraOutcome(*_sizes(error), int(np.count_nonzero(inside)), named, seconds)


def measure_zeros(body: RegistrationBody, seed: int, worn: bool) -> ZeroOutcome:
    """Draws an arm, three of whose encoders are off by 2 degrees, and finds its joints' zeros."""
    rng = np.random.default_rng(seed)
    camera, frames = draw_arm(body, _ZERO_FRAMES, rng)
    if worn:
        frames = [replace(frame, mask=damaged(frame.mask, rng)) for frame in frames]
    angles = np.flatnonzero(body.kinematics.is_angle)
    moved = rng.choice(angles, _MOVED, replace=False)
    true = np.zeros(len(body.kinematics.names))
    true[moved] = _ZERO * rng.choice([-1.0, 1.0], _MOVED)
    read = [replace(frame, values=frame.values - true) for frame in frames]
    start = time.process_time()
    registered = CameraSearch(body).register(camera, read)
    names = [body.kinematics.names[k] for k in angles]
    zeros = calibrate_joints(body, [registered], [read], names).zeros
    seconds = time.process_time() - start
    pairs = list(zip(zeros, true[angles], strict=True))
    known = [(one, value) for one, value in pairs if one.determined]
    return ZeroOutcome(
        np.degrees([abs(one.value - value) for one, value in known if value != 0.0]),
        sum(value != 0.0 and not one.determined for one, value in pairs),
        sum(value == 0.0 and one.significant for one, value in pairs),
        sum(value == 0.0 for _, value in pairs),
        [one.low <= value <= one.high for one, value in known],
        seconds,
    )


def pose_error(X_WC: Array, true: Array) -> Array:
    """(6,) by what rotation vector [rad] and shift [m] in the world a pose (4, 4) is off."""
    turn = Rotation.from_matrix(true[:3, :3] @ X_WC[:3, :3].T).as_rotvec()
    return np.concatenate([turn, true[:3, 3] - X_WC[:3, 3]])


def _sizes(error: Array) -> tuple[float, float]:
    """How long a pose error (6,) is [mm, deg]."""
    return 1e3 * float(np.linalg.norm(error[3:])), float(np.degrees(np.linalg.norm(error[:3])))


def _camera_rows(arms: Mapping[str, RegistrationBody], cases: int) -> Iterator[list[str]]:
    """Simulated cameras, for each arm and all together."""
    for worn, masks in ((False, "exact"), (True, "damaged, one frame wrong")):
        own = {
            name: [measure_camera(body, _SEED + k, worn) for k in range(cases)]
            for name, body in arms.items()
        }
        for name, outcomes in {**own, "all": list(chain(*own.values()))}.items():
            found = [one for one in outcomes if one.found]
            millimetres, degrees, inside = np.array([one[:3] for one in found]).reshape(-1, 3).T
            error = f"{np.median(millimetres):.2f} mm, {np.median(degrees):.3f} deg"
            yield [
                f"{name}, {masks}",
                f"{len(found)} of {len(outcomes)}",
                error if found else "",
                f"{np.mean(inside) / 6.0:.1%}" if found else "",
                f"{sum(one.named for one in outcomes)} of {len(outcomes)}",
                f"{np.median([one.seconds for one in outcomes]):.1f} s",
            ]


def _zero_rows(arms: Mapping[str, RegistrationBody], cases: int) -> Iterator[list[str]]:
    """Zeros of joints, three of which are off."""
    for worn in (False, True):
        runs = [
            measure_zeros(body, _SEED + k, worn) for body in arms.values() for k in range(cases)
        ]
        off = np.concatenate([one.off for one in runs])
        yield [
            "damaged" if worn else "exact",
            str(len(runs)),
            f"{np.median(off):.3f} deg" if len(off) else "",
            f"{sum(one.undetermined for one in runs)} of {_MOVED * len(runs)}",
            f"{np.mean(list(chain(*(one.inside for one in runs)))):.1%}",
            f"{sum(one.false for one in runs)} of {sum(one.right for one in runs)}",
            f"{np.median([one.seconds for one in runs]):.1f} s",
        ]


def _recorded_rows(data: Path) -> Iterator[list[str]]:
    """Recorded arms that are there: all cameras' poses are withheld; some are in the file."""
    lbr = data / "arm_two_views" / "med7" / "med7.urdf"
    panda = data / "franka_one_view" / "panda" / "panda.urdf"
    every: Sequence[tuple[str, Path, str, tuple[str, ...]]] = (
        ("arm_two_views", lbr, "joint_angles", ("left", "right")),
        ("arm_one_view", lbr, "joint_angles", ()),
        ("franka_one_view", panda, "joint_angles", ()),
        ("franka_one_view", panda, "joint_angles_fitted", ()),
    )
    for name, model, joints, cameras in every:
        scene = data / name
        if not (scene.is_dir() and model.is_file()):
            continue
        settings = RegistrationSettings(cameras=cameras)
        inputs = read_inputs(scene, model, scene / f"{joints}.csv", settings)
        body = RegistrationBody(inputs.tree)
        for camera in inputs.searched:
            frames = inputs.of(camera.name)
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
            named = f"{', '.join(found.contradictions) or 'none'} of {len(frames)}"
            yield [f"{name} ({joints}), {camera.name}", distance, iou, named, f"{seconds:.1f} s"]


def main() -> None:
    """Print whether cameras are found here, how well and how fast."""
    parser = argparse.ArgumentParser(description="Where cameras stand: errors and times.")
    parser.add_argument("data", nargs="?", type=Path, help="a folder of recorded scenes")
    parser.add_argument("--cases", type=int, default=2, help="simulated cases for each arm")
    parser.add_argument("--zeros", type=int, default=1, help="calibrations of zeros for each arm")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        files = arm_files(asked.data, Path(folder))
        arms = {name: load_arm(path) for name, path in files.items()}
    headings = ("arm, masks", "found", "error, median", "95 % hold", "named", "CPU, median")
    title = f"Simulated arms, {_FRAMES} frames, no guess: where the camera is"
    print_table(title, headings, _camera_rows(arms, asked.cases))
    if asked.zeros > 0:
        title = f"{_MOVED} encoders off by 2 degrees, {_ZERO_FRAMES} frames"
        headings = ("masks", "runs", "error, median", "undetermined", "95 % hold", "false", "CPU")
        print_table(title, headings, _zero_rows(arms, asked.zeros))
    if asked.data is not None:
        headings = ("scene, camera", "from the file's", "IoU (at the file's)", "named", "CPU")
        print_table("Recorded arms, no guess", headings, _recorded_rows(asked.data))


if __name__ == "__main__":
    main()
