"""Benchmark of registrations without an initial guess: success, errors and time.

Run as ``python -m tests.benchmarks.registration DATA [--cases N]``; DATA is a folder with the
scenes ``arm_two_views``, ``arm_one_view`` and ``franka_one_view``, N the number of simulated cases
per arm.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from drake_pose.arrays import Array
from drake_pose.body import load_model
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.files.settings import EstimateSettings, RegistrationSettings
from drake_pose.fit.parameters import carried_joints
from drake_pose.jobs.estimate.inputs import make_tree
from drake_pose.jobs.registration.inputs import read_inputs
from drake_pose.registration.joint_offsets import scalable_links
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import (
    CameraSearch,
    RegisteredCamera,
    RegistrationBody,
    overlap_areas,
)
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.benchmarks.tables import print_table
from tests.registration.arm_pictures import damaged

_SEED, _FRAMES = 13_000, 5
# Maximum errors of a camera that counts as found [mm, deg].
_FOUND = (20.0, 2.0)
_WIDTH, _HEIGHT, _FOCAL, _DISTANCE = 640, 480, 600.0, (1.0, 1.7)
_MIDDLE, _MIDDLE_SD = np.array([0.0, 0.0, 0.35]), 0.1
# Minimum size of a silhouette [pixel]; smaller ones are redrawn in another pose, and after this
# many of them with another camera.
_LEAST_PIXELS, _TRIES = 3000, 30
# Standard deviations of errors: joint offsets [rad], link scales, focal length, centre [pixel].
_ZERO_SD, _LENGTH_SD, _FOCAL_SD, _CENTER_SD = np.radians(0.3), 0.01, 0.01, 3.0
_LBR, _PANDA = "arm_two_views/med7/med7.urdf", "franka_one_view/panda/panda.urdf"
_ARMS = {"LBR Med 7": _LBR, "Franka Panda": _PANDA}
# Recorded scenes, their arm, the table of their joints, and the cameras whose poses are withheld.
_RECORDED = (
    ("arm_two_views", _LBR, "joint_angles", ("left", "right")),
    ("arm_one_view", _LBR, "joint_angles", ()),
    ("franka_one_view", _PANDA, "joint_angles", ()),
    ("franka_one_view", _PANDA, "joint_angles_fitted", ()),
)
# The arm of boxes: each joint's axis, its box's sides and length [m].
_BOXES = (
    ("0 0 1", 0.16, 0.11, 0.2),
    ("0 1 0", 0.11, 0.1, 0.35),
    ("0 0 1", 0.09, 0.13, 0.1),
    ("0 1 0", 0.08, 0.07, 0.3),
    ("0 1 0", 0.05, 0.1, 0.15),
)


class CameraError(NamedTuple):
    """Error of a registered camera."""

    millimetres: float = np.inf
    degrees: float = np.inf
    inside: int = 0  # Number of the pose's six coordinates inside their 95 % intervals.
    probable: float = 0.0  # Probability of a larger error, by the pose's covariance.
    sd: tuple[float, float] = (np.inf, np.inf)  # Of position and orientation, RMS [mm, deg].

    @classmethod
    def of(cls, found: RegisteredCamera, X_WC: Array) -> "CameraError":
        """Return the error of a camera whose true pose is X_WC (4, 4)."""
        error = pose_error(found.camera.X_WC, X_WC)
        inside = np.abs(error) < 1.96 * np.sqrt(np.diag(found.covariance))
        probable = chi2.sf(error @ np.linalg.solve(found.covariance, error), 6)
        degrees, metres = np.degrees(np.linalg.norm(error[:3])), np.linalg.norm(error[3:])
        sd = 1e3 * found.translation_sd, float(np.degrees(found.rotation_sd))
        return cls(1e3 * float(metres), float(degrees), int(inside.sum()), float(probable), sd)


class CameraOutcome(NamedTuple):
    """Result of one registration."""

    error: CameraError
    named: bool  # Whether exactly the wrong frames are reported as outliers.
    seconds: float  # CPU time.

    @property
    def found(self) -> bool:
        """Whether the true pose was found, and not another one with similar silhouettes."""
        return self.error.millimetres < _FOUND[0] and self.error.degrees < _FOUND[1]


def write_box_arm(path: Path) -> Path:
    """Write the model file of an arm of five boxes, and return its path."""
    parts, parent, height = ['<robot name="boxes"><link name="world"/>'], "world", 0.0
    for k, (axis, width, depth, length) in enumerate(_BOXES):
        parts.append(
            f'<link name="box{k}"><visual><origin xyz="0.01 0 {length / 2}"/><geometry>'
            f'<box size="{width} {depth} {length}"/></geometry></visual></link>'
            f'<joint name="joint{k}" type="revolute"><parent link="{parent}"/>'
            f'<child link="box{k}"/><origin xyz="0 0 {height}"/><axis xyz="{axis}"/>'
            '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>'
        )
        parent, height = f"box{k}", length
    path.write_text("".join(parts) + "</robot>")
    return path


def load_arm(path: Path) -> RegistrationBody:
    """Return an arm fixed in the world as in its model file."""
    return RegistrationBody(make_tree(load_model(path, check=False), EstimateSettings(), None))


def draw_arm(
    body: RegistrationBody, count: int, rng: np.random.Generator
) -> tuple[PinholeCamera, list[PosedFrame]]:
    """Render exact masks of an arm in random poses, for a random camera."""
    while True:
        camera = _random_camera(rng)
        renderer, frames = LabelRenderer(body.tree.model, camera), []
        for _ in range(count + _TRIES):
            values = random_values(body, rng)
            mask = renderer.mask(*body.tree.positions_from(body.kinematics.split(values)))
            if np.count_nonzero(mask) >= _LEAST_PIXELS:
                frames.append(PosedFrame(f"{len(frames):04d}", values, mask))
            if len(frames) == count:
                return camera, frames


def random_values(body: RegistrationBody, rng: np.random.Generator) -> Array:
    """Return positions (m,) inside the joints' limits, or a full turn without limits."""
    lower, upper = body.kinematics.lower, body.kinematics.upper
    return rng.uniform(
        np.where(np.isfinite(lower), lower, -np.pi), np.where(np.isfinite(upper), upper, np.pi)
    )


def _random_camera(rng: np.random.Generator) -> PinholeCamera:
    away = rng.normal(size=3)
    away /= np.linalg.norm(away)
    right = np.cross(rng.normal(size=3), -away)
    right /= np.linalg.norm(right)
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.column_stack([right, np.cross(-away, right), -away])
    X_WC[:3, 3] = _MIDDLE + rng.normal(0.0, _MIDDLE_SD, 3) + rng.uniform(*_DISTANCE) * away
    centre = (_WIDTH / 2 - 0.5, _HEIGHT / 2 - 0.5)
    return PinholeCamera("camera", _WIDTH, _HEIGHT, _FOCAL, _FOCAL, *centre, X_WC)


def measure_camera(
    body: RegistrationBody, seed: int, damaged_case: bool, model_errors: bool = False
) -> CameraOutcome:
    """Simulate an arm and find its camera.

    damaged_case: damage the masks, and make one frame's positions wrong. model_errors: give joints,
    link scales and lens small errors.
    """
    rng = np.random.default_rng(seed)
    true = _with_other_lengths(body, rng) if model_errors else body
    camera, frames = draw_arm(true, _FRAMES, rng)
    wrong: tuple[str, ...] = ()
    if model_errors:
        zeros = rng.normal(0.0, _ZERO_SD, len(body.kinematics.names)) * body.kinematics.is_angle
        frames = [replace(one, values=one.values + zeros) for one in frames]
        fit_slope, (x, y) = np.exp(rng.normal(0.0, _FOCAL_SD)), rng.normal(0.0, _CENTER_SD, 2)
        camera = replace(
            camera, focal_x=camera.focal_x * fit_slope, focal_y=camera.focal_y * fit_slope,
            center_x=camera.center_x + x, center_y=camera.center_y + y,
        )  # fmt: skip
    if damaged_case:
        frames = [replace(frame, mask=damaged(frame.mask, rng)) for frame in frames]
        k = int(rng.integers(len(frames)))
        wrong = (frames[k].name,)
        frames[k] = PosedFrame(frames[k].name, random_values(body, rng), frames[k].mask)
    start = time.process_time()
    try:
        found = CameraSearch(body).register(camera, frames)
    except RegistrationError:
        return CameraOutcome(CameraError(), False, time.process_time() - start)
    seconds = time.process_time() - start
    return CameraOutcome(CameraError.of(found, camera.X_WC), found.outliers == wrong, seconds)


def _with_other_lengths(body: RegistrationBody, rng: np.random.Generator) -> RegistrationBody:
    """Return the arm with slightly different link lengths."""
    tree, settings = body.tree, EstimateSettings()
    by = {link: rng.normal(0.0, _LENGTH_SD) for link in scalable_links(tree)}
    shifts = {one.joint: (by[one.link] * one.p_L).tolist() for one in carried_joints(tree)}
    return body.with_tree(make_tree(tree.model.reshaped(joint_shifts=shifts), settings, None))


def pose_error(X_WC: Array, true: Array) -> Array:
    """Return (6,) the rotation vector [rad] and translation [m] from a pose to the true one."""
    turn = Rotation.from_matrix(true[:3, :3] @ X_WC[:3, :3].T).as_rotvec()
    return np.concatenate([turn, true[:3, 3] - X_WC[:3, 3]])


def _camera_rows(arms: dict[str, RegistrationBody], cases: int) -> Iterator[list[str]]:
    """Yield results of simulated cameras, for each arm and all together."""
    for damaged_case, model_errors, masks in (
        (False, False, "exact"),
        (True, False, "damaged, one frame wrong"),
        (False, True, "exact, model and lens off"),
    ):
        own = {
            name: [
                measure_camera(body, _SEED + k, damaged_case, model_errors) for k in range(cases)
            ]
            for name, body in arms.items()
        }
        for name, outcomes in {**own, "all": [*chain(*own.values())]}.items():
            found = [one for one in outcomes if one.found]
            millimetres, degrees, inside = (
                np.array([one.error[:3] for one in found]).reshape(-1, 3).T
            )
            error = f"{np.median(millimetres):.2f} mm, {np.median(degrees):.3f} deg"
            yield [
                f"{name}, {masks}",
                f"{len(found)} of {len(outcomes)}",
                error if found else "",
                f"{np.mean(inside) / 6.0:.1%}" if found else "",
                f"{sum(one.named for one in outcomes)} of {len(outcomes)}",
                f"{np.median([one.seconds for one in outcomes]):.1f} s",
            ]


def _recorded_rows(data: Path) -> Iterator[list[str]]:
    """Yield results of recorded arms; the cameras' poses, if known, are withheld."""
    for name, arm, joints, cameras in _RECORDED:
        scene, model = data / name, data / arm
        settings = RegistrationSettings(cameras=cameras)
        inputs = read_inputs(scene, model, scene / f"{joints}.csv", None, settings)
        body = RegistrationBody(inputs.tree)
        for camera in inputs.searched_cameras:
            frames = inputs.of(camera.name)
            start = time.process_time()
            found = CameraSearch(body).register(camera, frames)
            seconds = time.process_time() - start
            iou, distance = f"{np.mean([one.iou for one in found.frames]):.3f}", ""
            if cameras:
                off = CameraError.of(found, camera.X_WC)
                distance = f"{off.millimetres:.1f} mm, {off.degrees:.2f} deg"
                posed = PosedFrames(body.kinematics, body.full, camera, frames)
                seen, mask, both = overlap_areas(posed, camera.X_CW[None], np.inf)[0].T
                iou += f" ({np.mean(both / (seen + mask - both)):.3f})"
            named = f"{', '.join(found.outliers) or 'none'} of {len(frames)}"
            yield [f"{name} ({joints}), {camera.name}", distance, iou, named, f"{seconds:.1f} s"]


def main() -> None:
    """Print success, errors and times of registrations."""
    parser = argparse.ArgumentParser(description="Where cameras stand: errors and times.")
    parser.add_argument("data", type=Path, help="a folder of recorded scenes")
    parser.add_argument("--cases", type=int, default=2, help="simulated cases for each arm")
    asked = parser.parse_args()
    headings = ("arm, masks", "found", "error, median", "95 % hold", "named", "CPU, median")
    title = f"Simulated arms, {_FRAMES} frames, no guess: where the camera is"
    arms = {name: load_arm(asked.data / file) for name, file in _ARMS.items()}
    print_table(title, headings, _camera_rows(arms, asked.cases))
    headings = ("scene, camera", "from the file's", "IoU (at the file's)", "named", "CPU")
    print_table("Recorded arms, no guess", headings, _recorded_rows(asked.data))


if __name__ == "__main__":
    main()
