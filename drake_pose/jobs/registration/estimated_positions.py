"""Joint positions of a body that has no encoders, estimated from cameras whose place is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.model import ArticulatedModel
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.errors import SceneError
from drake_pose.jobs.estimate.measurements import TrueAngles
from drake_pose.jobs.estimate.person_choice import missing_for_person
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.jobs.registration.known_positions import KnownPositions
from drake_pose.person.shape import shape_parts
from drake_pose.results.options import frame_number
from drake_pose.results.settings import EstimateSettings

Array = NDArray[np.float64]


def estimate_positions(
    scene_path: Path,
    model: ArticulatedModel,
    kinematics: TreeKinematics,
    known: Sequence[Camera],
    settings: EstimateSettings,
) -> KnownPositions:
    """Joint positions of the frames in which they can be estimated.

    Args:
        scene_path: the scene's folder.
        model: the body.
        kinematics: of its pose tree.
        known: the cameras whose place is known.
        settings: of the estimate.

    Raises:
        SceneError: there are too few such cameras, or they see the body in no frame.
        DrakePoseError: as for an estimate.
    """
    names = tuple(camera.name for camera in known)
    _require_enough(scene_path, model, names)
    found = estimate_scene(scene_path, model.path, None, replace(settings, cameras=names))
    values: dict[int | str, Array] = {}
    for row in found.rows:
        if row.found:
            number = frame_number(row.frame)
            values[row.frame if number is None else number] = row.q
    if not values:
        raise SceneError(
            f"{scene_path}: camera {', '.join(names)}, whose X_WC is known, sees the body in no "
            "frame well enough to tell its pose, so nothing tells where the others are: give its "
            "joint positions (--joints), or cameras with X_WC that see it"
        )
    index = [found.position_names.index(name) for name in kinematics.names]
    table = TrueAngles(scene_path, found.position_names, values)
    return KnownPositions(
        scene_path,
        kinematics,
        table,
        np.array(index, dtype=np.intp),
        kinematics.lower,
        found.warnings,
        is_estimate=True,
        girths=_girths(kinematics.tree, found.summary.get("girths", {})),
    )


def _require_enough(path: Path, model: ArticulatedModel, names: Sequence[str]) -> None:
    """Refuses to begin where known cameras are too few for the body.

    Raises:
        SceneError: says which cameras are known, and what is needed.
    """
    if not names:
        raise SceneError(
            f"{path}: neither a camera's place nor the body's joint positions are known: give X_WC "
            "of one camera or more (of two for a person), or joint positions (--joints)"
        )
    if len(names) < 2 and not missing_for_person(model):
        raise SceneError(
            f"{path}: {names[0]} is the only camera that has an X_WC, and one camera does not tell "
            "where a person is: give X_WC of two cameras or more, or the person's joint positions "
            "(--joints)"
        )


def _girths(tree: PoseTree, of_parts: Mapping[str, float]) -> Array | None:
    """(nodes,) of the girths by part; None where there are none."""
    if not of_parts:
        return None
    parts, groups = shape_parts(tree)
    return np.array([of_parts.get(parts[group], 1.0) for group in groups])
