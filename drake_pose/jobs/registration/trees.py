"""Pose trees of a registration, from the world or the cameras' link, and corrected models."""

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from drake_pose.body import (
    TARGET,
    ArticulatedModel,
    PoseTree,
    RootRotation,
    load_model,
    reshaped,
)
from drake_pose.errors import SettingsError
from drake_pose.files.settings import EstimateSettings
from drake_pose.fit.parameters import carried_joints
from drake_pose.jobs.estimate.inputs import make_tree
from drake_pose.jobs.registration.settings import RegistrationSettings
from drake_pose.registration.joint_offsets import KinematicParameter
from drake_pose.registration.standing_object import CalibrationTarget, fixed_link_error


def read_target(
    model: ArticulatedModel, settings: RegistrationSettings
) -> CalibrationTarget | None:
    """Return the calibration target that cameras on a link of the robot `model` see.

    None: the settings have no target, so the cameras see the robot.

    Raises SettingsError: the target is unusable, or no link carries the cameras.
    """
    if settings.target is None:
        return None
    if settings.on is None:
        raise SettingsError(
            f"{settings.target} and a camera that rides on no link both stand still, so masks of "
            "the target do not relate the camera to the robot: name the camera's link (--on LINK)"
        )
    other = load_model(settings.target, package_paths=settings.packages)
    held = make_tree(model, EstimateSettings(hold=settings.hold)).held
    named = {model.position_names[index]: value for index, value in held.items()}
    return CalibrationTarget(model, settings.on, named, make_tree(other, EstimateSettings()))


def make_registration_tree(
    model: ArticulatedModel, settings: RegistrationSettings, target: CalibrationTarget | None = None
) -> tuple[PoseTree, tuple[str, ...] | None]:
    """Return the pose tree, and the names of its nodes that masks show; None: all.

    With cameras on a link (``settings.on``) the tree starts at the link, and masks show the robot's
    static base or the target. Otherwise the tree starts in the world.

    target: the calibration target; None: the masks show the robot.

    Raises SettingsError: no part that masks show stands still, or no joint moves the link.
    """
    if target is not None:
        return target.tree(np.eye(4)), (TARGET,)
    tree = make_tree(model, EstimateSettings(hold=settings.hold))
    link = settings.on
    if link is None:
        return tree, None
    base = [node.name for node in tree.nodes if node.parent < 0 and not node.value_names]
    if not base:
        raise SettingsError(
            f"{model.path}: no visible link stands still, so the pose of a camera on link '{link}' "
            "is not observable; the robot's base needs visual geometry"
        )
    held = {model.position_names[index]: value for index, value in tree.held.items()}
    moved = model.pose_tree(
        link, root_position=np.zeros(3), root_rotation=RootRotation.fixed(), held=held
    )
    if not {node.name for node in moved.nodes[1:]} & set(base):
        raise fixed_link_error(model, link)
    return moved, tuple(base)


def corrected_urdf(
    model: ArticulatedModel,
    folder: Path | None,
    offsets: Mapping[str, float],
    shifts: Mapping[str, Sequence[float]],
) -> bytes | None:
    """Return the text of a model's URDF with corrected origins of joints.

    Args:
        model: the model.
        folder: the result folder, which mesh paths will be relative to.
        offsets: joint offsets by name [rad or m].
        shifts: by joint the shift (3,) of its origin in its parent link's frame [m].

    Returns the text; None if nothing is corrected, there is no folder, or the model is no URDF.
    """
    path = model.path
    if folder is None or not model.changes_shape or not (offsets or shifts):
        return None
    text = path.read_text(encoding="utf-8")
    root = ElementTree.fromstring(reshaped(text, joint_offsets=offsets, joint_shifts=shifts))
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if "://" not in name:
            mesh.set("filename", os.path.relpath(path.parent / name, folder))
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def joint_shifts(tree: PoseTree, scales: Sequence[KinematicParameter]) -> dict[str, list[float]]:
    """Return by joint the shift (3,) of its origin in its parent link's frame [m].

    scales: relative changes of links' lengths; joints carried by unchanged links have no entry.
    """
    longer = {scale.name: scale.value for scale in scales if scale.value}
    offsets = carried_joints(tree, longer)
    return {offset.joint: (longer[offset.link] * offset.p_L).tolist() for offset in offsets}
