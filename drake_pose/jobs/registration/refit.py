"""Cameras fitted once more, together with what is unknown of the body beside them.

Positions that were estimated are off, and so would the cameras be; zeros of joints, lengths of
links and focal lengths are the same in all frames.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.formats.urdf_shape import reshaped
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.jobs.estimate.inputs import missing_for_person
from drake_pose.jobs.registration.inputs import Inputs, make_registration_tree
from drake_pose.jobs.registration.settings import RegistrationSettings
from drake_pose.person.shape import shape_parts, shape_values
from drake_pose.registration.bundle_adjustment import adjust_bundle
from drake_pose.registration.joint_zeros import (
    JointCalibration,
    calibrate_joints,
    lengthened_joints,
)
from drake_pose.registration.posed_frames import PosedFrames
from drake_pose.registration.register import RegisteredCamera, RegistrationBody
from drake_pose.registration.start_poses import E_total, areas, intersection_over_union

Registered = Mapping[str, RegisteredCamera]


def refit_poses(
    inputs: Inputs, body: RegistrationBody, registered: Registered
) -> tuple[dict[str, RegisteredCamera], Inputs, RegistrationBody]:
    """The cameras, the frames' estimated positions and the body, fitted to what all cameras see."""
    wrong = {name: found.contradictions for name, found in registered.items()}
    frames = [
        replace(one, masks={c: m for c, m in one.masks.items() if one.name not in wrong.get(c, ())})
        for one in inputs.frames
    ]
    cameras = [*inputs.held, *(found.camera for found in registered.values())]
    shape: tuple[Any, ...] = (np.zeros(len(body.kinematics.names), np.bool_),)
    if not missing_for_person(inputs.model):
        shape = (shape_values(inputs.tree), *shape_parts(inputs.tree))
    fitted = adjust_bundle(body.kinematics, body.few, cameras, registered, frames, *shape)
    values = {one.name: own for one, own in zip(frames, fitted.values, strict=True)}
    inputs = replace(inputs, frames=inputs.moved(values))
    known = inputs.positions.girths
    girths = fitted.girths * (1.0 if known is None else known)
    worn = RegistrationBody(inputs.tree, inputs.seen, girths=girths)
    result = {}
    for camera, covariance in zip(fitted.cameras, fitted.covariances, strict=True):
        before = registered[camera.name]
        result[camera.name] = _now(inputs, worn, worn.kinematics, camera, covariance, before)
    return result, inputs, worn


def find_zeros(
    inputs: Inputs, settings: RegistrationSettings, body: RegistrationBody, registered: Registered
) -> tuple[dict[str, RegisteredCamera], Inputs, JointCalibration]:
    """The cameras, and the robot and the frames' positions, with what was found.

    Raises:
        RegistrationError: fewer frames than zeros and lengths.
    """
    names, cameras = body.kinematics.names, list(registered.values())
    frames = [inputs.of(name) for name in registered]
    found = calibrate_joints(
        body, cameras, frames, inputs.zeros, settings.focal, lengths=inputs.lengths
    )
    offsets = np.zeros(len(names))
    for zero in found.zeros:
        offsets[names.index(zero.name)] = zero.value
    model, tree, standing = inputs.model, inputs.tree, inputs.standing
    seen = cameras[0].seen_object
    shifts = joint_shifts(tree, found)
    if shifts:
        model = model.reshaped(shifts=shifts)
    if standing is not None and seen is not None:
        standing = standing.before(model)
        seen = standing.moved_pose(seen, found.object_values, found.object_covariance)
        tree = standing.tree(seen.X_WT)
    elif shifts:
        tree, _ = make_registration_tree(model, settings)
    values = {one.name: one.values + offsets for one in inputs.frames}
    inputs = replace(inputs, model=model, tree=tree, frames=inputs.moved(values))
    kinematics, result = TreeKinematics(tree), {}
    for camera, covariance, before in zip(found.cameras, found.covariances, cameras, strict=True):
        again = _now(inputs, body, kinematics, camera, covariance, before)
        result[camera.name] = replace(again, seen_object=seen)
    return result, inputs, found


def _now(
    inputs: Inputs,
    body: RegistrationBody,
    kinematics: TreeKinematics,
    camera: PinholeCamera,
    covariance: NDArray[np.float64],
    before: RegisteredCamera,
) -> RegisteredCamera:
    """A camera where it was found now, and its frames' misfits; which agree is as it was."""
    frames = PosedFrames(kinematics, body.all, camera, inputs.of(camera.name))
    found = areas(frames, camera.X_CW[None], np.inf)[0]
    misfits = zip(before.frames, E_total(found), intersection_over_union(found), strict=True)
    again = [replace(one, E_total=float(off), iou=float(iou)) for one, off, iou in misfits]
    return replace(before, camera=camera, covariance=covariance, frames=tuple(again))


def joint_shifts(tree: PoseTree, found: JointCalibration) -> dict[str, list[float]]:
    """By how much joints stand elsewhere on their links (3,), by name [m]; empty: none does."""
    longer = {one.name: one.value for one in found.lengths if one.determined}
    offsets = lengthened_joints(tree, longer)
    return {one.joint: (longer[one.link] * one.p_L).tolist() for one in offsets}


def corrected_urdf(inputs: Inputs, found: JointCalibration, folder: Path | None) -> bytes | None:
    """The URDF with zeros and lengths in its joints' origins; its meshes as seen from a folder.

    None where there is no folder, nothing was asked for, or the model is no URDF.
    """
    model, tree = inputs.model.path, inputs.tree
    if folder is None or not inputs.model.changes_shape or not (found.zeros or found.lengths):
        return None
    zeros = {zero.name: zero.value for zero in found.zeros if zero.determined}
    text = model.read_text(encoding="utf-8")
    shifts = joint_shifts(tree, found)
    root = ElementTree.fromstring(reshaped(text, zeros=zeros, shifts=shifts))
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if "://" not in name:
            mesh.set("filename", os.path.relpath(model.parent / name, folder))
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
