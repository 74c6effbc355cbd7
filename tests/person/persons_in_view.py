"""A stepping person as calibrated cameras see him, drawn by Drake's renderer."""

from collections.abc import Mapping

import numpy as np

from drake_pose.body import ArticulatedModel
from drake_pose.camera.models import Camera
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

SIDES = ("left", "right")


def posed(
    person: ArticulatedModel, x: float = 0.0, y: float = 0.0, z: float = 1.55, **degrees: float
) -> np.ndarray:
    """Positions (nq,) of a person whose head is at (x, y, z) [m], joints by name [deg]."""
    q = np.zeros(len(person.position_names))
    for name, angle in degrees.items():
        q[person.position_index(name)] = np.radians(angle)
    for axis, value in zip("xyz", (x, y, z), strict=True):
        q[person.position_index(f"position_{axis}")] = value
    return q


def stepping(
    person: ArticulatedModel, phase: float, x: float = 0.0, y: float = 0.0, knees: float = 30.0
) -> np.ndarray:
    """Positions (nq,) of a person at a phase of a step, standing at (x, y), knees bent [deg]."""
    swing = np.sin(phase)
    pairs = {
        "thigh_x": (-35 * swing, 35 * swing),
        "shin_x": (knees + 20 * swing, knees - 20 * swing),
        "upper_arm_z": (40, -40),
        "upper_arm_x": (30 * swing, -30 * swing),
        "forearm_x": (-60 + 30 * swing, -60 - 30 * swing),
    }
    degrees = {f"{side}_{k}": a[n] for k, a in pairs.items() for n, side in enumerate(SIDES)}
    return posed(person, x, y, 1.5, **degrees)


def see(
    person: ArticulatedModel, cameras: Mapping[str, Camera], poses: np.ndarray
) -> list[dict[str, np.ndarray]]:
    """The masks of each pose (n, nq), by camera."""
    renderers = {name: LabelRenderer(person, camera) for name, camera in cameras.items()}
    return [{name: one.mask(q) for name, one in renderers.items()} for q in poses]
