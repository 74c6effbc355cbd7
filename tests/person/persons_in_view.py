"""A stepping person as calibrated cameras see him, drawn by Drake's renderer."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.models import Camera
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer


def stepping(
    person: ArticulatedModel, phase: float, x: float = 0.0, y: float = 0.0, knees: float = 30.0
) -> np.ndarray:
    """Positions (nq,) of a person at a phase of a step, standing at (x, y), knees bent [deg]."""
    swing = np.sin(phase)
    degrees = {
        "left_thigh_x": -35 * swing,
        "right_thigh_x": 35 * swing,
        "left_shin_x": knees + 20 * swing,
        "right_shin_x": knees - 20 * swing,
        "left_upper_arm_z": 40,
        "right_upper_arm_z": -40,
        "left_upper_arm_x": 30 * swing,
        "right_upper_arm_x": -30 * swing,
        "left_forearm_x": -60 + 30 * swing,
        "right_forearm_x": -60 - 30 * swing,
    }
    q = np.zeros(len(person.position_names))
    for name, angle in degrees.items():
        q[person.position_index(name)] = np.radians(angle)
    for axis, value in zip("xyz", (x, y, 1.5), strict=True):
        q[person.position_index(f"position_{axis}")] = value
    return q


def see(
    person: ArticulatedModel, cameras: Mapping[str, Camera], poses: np.ndarray
) -> list[dict[str, np.ndarray]]:
    """The masks of each pose (n, nq), by camera."""
    renderers = {name: LabelRenderer(person, camera) for name, camera in cameras.items()}
    return [{name: one.mask(q) for name, one in renderers.items()} for q in poses]
