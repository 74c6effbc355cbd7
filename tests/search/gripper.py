"""A gripper on an arm, whose fingers follow each other or are free, in Drake's pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.search.estimates import View
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

from .arms import arm_cameras

# Each: parent, name, type, origin, axis, limits, the box's origin and sides.
_PARTS = (
    ("world", "mast", "revolute", "0 0 0", "1 0 0", (-1.2, 1.2), "0 0 .15", ".05 .05 .3"),
    ("mast", "hand", "revolute", "0 0 .3", "1 0 0", (-1.5, 1.5), "0 0 .03", ".06 .24 .06"),
    ("hand", "left", "prismatic", "0 0 .06", "0 1 0", (0.0, 0.08), "0 .01 .05", ".03 .02 .1"),
    ("hand", "right", "prismatic", "0 0 .06", "0 -1 0", (0.0, 0.08), "0 -.01 .05", ".03 .02 .1"),
)


def gripper(folder: Path, *, follows: bool) -> ArticulatedModel:
    """The gripper; right follows left by its <mimic>, or both are free."""
    text = '<robot name="gripper"><link name="world"/>'
    for parent, name, kind, at, axis, (low, high), middle, size in _PARTS:
        mimic = '<mimic joint="left_joint"/>' if follows and name == "right" else ""
        text += (
            f'<link name="{name}"><visual><origin xyz="{middle}"/><geometry><box size="{size}"/>'
            f'</geometry></visual></link><joint name="{name}_joint" type="{kind}"><parent '
            f'link="{parent}"/><child link="{name}"/><origin xyz="{at}"/><axis xyz="{axis}"/>'
            f'<limit lower="{low}" upper="{high}" effort="1" velocity="1"/>{mimic}</joint>'
        )
    path = folder / f"gripper_{follows}.urdf"
    path.write_text(text + "</robot>")
    return load_model(path, check=False)


def gripper_views(model: ArticulatedModel, q: np.ndarray) -> list[View]:
    """What two cameras see of it, drawn by Drake."""
    return [View(camera, LabelRenderer(model, camera).mask(q)) for camera in arm_cameras()]
