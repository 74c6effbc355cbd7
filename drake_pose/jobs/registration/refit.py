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

import numpy as np

from drake_pose.body.files.urdf_shape import reshaped
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.jobs.estimate.person_choice import missing_for_person
from drake_pose.jobs.registration.inputs import RegistrationInputs, make_registration_tree
from drake_pose.jobs.registration.settings import RegistrationSettings
from drake_pose.person.shape import shape_parts, shape_values
from drake_pose.registration.bundle_adjustment import BundleAdjustment, CommonShape
from drake_pose.registration.joint_zeros import (
    JointCalibration,
    calibrate_joints,
    lengthened_joints,
)
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames, SeenFrame
from drake_pose.registration.register import FrameMisfit, RegisteredCamera, RegistrationBody
from drake_pose.registration.start_poses import E_total, areas, intersection_over_union

Registered = Mapping[str, RegisteredCamera]


def adjust_bundle(
    inputs: RegistrationInputs,
    body: RegistrationBody,
    registered: Registered,
) -> tuple[dict[str, RegisteredCamera], RegistrationInputs, RegistrationBody]:
    """The cameras, the frames' estimated positions and the body, fitted to what all cameras see."""
    frames = _seen_frames(inputs, registered)
    cameras = [*inputs.held, *(found.camera for found in registered.values())]
    shape = CommonShape(np.zeros(len(body.kinematics.names), np.bool_))
    if not missing_for_person(inputs.model):
        shape = CommonShape(shape_values(inputs.tree), *shape_parts(inputs.tree))
    fitted = BundleAdjustment(
        body.kinematics, body.few, cameras, tuple(registered), frames, shape
    ).fit()
    values = {frame.name: values for frame, values in zip(frames, fitted.values, strict=True)}
    moved = {
        name: tuple(PosedFrame(one.name, values[one.name], one.mask) for one in own)
        for name, own in inputs.frames.items()
    }
    girths = fitted.girths * (1.0 if inputs.girths is None else inputs.girths)
    worn = RegistrationBody(inputs.tree, inputs.seen, girths=girths)
    result = {}
    for camera, covariance in zip(fitted.cameras, fitted.covariances, strict=True):
        before = registered[camera.name]
        misfits = misfits_now(
            PosedFrames(worn.kinematics, worn.all, camera, moved[camera.name]), before
        )
        result[camera.name] = replace(before, camera=camera, covariance=covariance, frames=misfits)
    return result, replace(inputs, frames=moved), worn


def _seen_frames(
    inputs: RegistrationInputs, registered: Mapping[str, RegisteredCamera]
) -> list[SeenFrame]:
    """What all cameras see, but for pictures that contradict the positions."""
    frames: dict[str, SeenFrame] = {}
    for name in (*(camera.name for camera in inputs.held), *registered):
        wrong = registered[name].contradictions if name in registered else ()
        for one in inputs.frames[name]:
            before = frames.get(one.name)
            masks = {} if before is None else dict(before.masks)
            if one.name not in wrong:
                masks[name] = one.mask
            frames[one.name] = SeenFrame(one.name, one.values, masks)
    return list(frames.values())


def find_zeros(
    inputs: RegistrationInputs,
    settings: RegistrationSettings,
    body: RegistrationBody,
    registered: Registered,
) -> tuple[dict[str, RegisteredCamera], RegistrationInputs, JointCalibration]:
    """The cameras, and the robot and the frames' positions, with what was found.

    Raises:
        RegistrationError: fewer frames than zeros and lengths.
    """
    names = body.kinematics.names
    cameras = list(registered.values())
    frames = [inputs.frames[one.camera.name] for one in cameras]
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
    kinematics = TreeKinematics(tree)
    corrected = dict(inputs.frames)
    result = {}
    for camera, covariance, before in zip(found.cameras, found.covariances, cameras, strict=True):
        own = tuple(
            PosedFrame(one.name, one.values + offsets, one.mask)
            for one in inputs.frames[camera.name]
        )
        corrected[camera.name] = own
        again = misfits_now(PosedFrames(kinematics, body.all, camera, own), before)
        result[camera.name] = replace(
            before, camera=camera, covariance=covariance, frames=again, seen_object=seen
        )
    return result, replace(inputs, model=model, tree=tree, frames=corrected), found


def joint_shifts(tree: PoseTree, found: JointCalibration) -> dict[str, list[float]]:
    """By how much joints stand elsewhere on their links (3,), by name [m]; empty: none does."""
    longer = {one.name: one.value for one in found.lengths if one.determined}
    offsets = lengthened_joints(tree, longer)
    return {one.joint: (longer[one.link] * one.p_L).tolist() for one in offsets}


def misfits_now(frames: PosedFrames, before: RegisteredCamera) -> tuple[FrameMisfit, ...]:
    """How well the frames fit now; which of them agree is as it was found."""
    found = areas(frames, frames.camera.X_CW[None], np.inf)[0]
    iou = intersection_over_union(found)
    return tuple(
        replace(one, E_total=float(off), iou=float(share))
        for one, off, share in zip(before.frames, E_total(found), iou, strict=True)
    )


def corrected_urdf(
    inputs: RegistrationInputs, found: JointCalibration, folder: Path | None
) -> bytes | None:
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
