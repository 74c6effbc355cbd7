"""Zeros of joints, lengths of links and focal lengths, asked for beside the cameras' poses."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.body.files.urdf_shape import with_shifted_joints, with_zeros
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.jobs.registration.inputs import (
    RegistrationInputs,
    make_registration_tree,
)
from drake_pose.jobs.registration.settings import RegistrationSettings
from drake_pose.registration.joint_zeros import (
    JointCalibration,
    calibrate_joints,
    lengthened_joints,
)
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import FrameMisfit, RegisteredCamera, RegistrationBody
from drake_pose.registration.start_poses import E_total, areas, intersection_over_union


def find_zeros(
    inputs: RegistrationInputs,
    settings: RegistrationSettings,
    body: RegistrationBody,
    registered: Mapping[str, RegisteredCamera],
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
        model = model.with_shifted_joints(shifts)
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


def describe_zeros(found: JointCalibration, kinematics: TreeKinematics) -> dict[str, Any]:
    """The zeros by name, angles in degrees and lengths in mm; None where it is not determined."""
    described = {}
    for zero in found.zeros:
        angle = bool(kinematics.is_angle[kinematics.names.index(zero.name)])
        unit, factor = ("deg", np.degrees(1.0)) if angle else ("mm", 1e3)
        numbers = {"value": zero.value, "sd": zero.deviation, "low": zero.low, "high": zero.high}
        described[zero.name] = {
            "determined": zero.determined,
            "significant": zero.significant,
            **{
                f"{key}_{unit}": float(factor * value) if zero.determined else None
                for key, value in numbers.items()
            },
            "gauge": list(zero.gauge),
        }
    return described


def describe_lengths(found: JointCalibration) -> dict[str, Any]:
    """By how much links are longer, by name; None where it is not determined."""
    described = {}
    for one in found.lengths:
        numbers = {"value": one.value, "sd": one.deviation, "low": one.low, "high": one.high}
        described[one.name] = {
            "determined": one.determined,
            "significant": one.significant,
            **{
                f"{key}_percent": 1e2 * value if one.determined else None
                for key, value in numbers.items()
            },
            "gauge": list(one.gauge),
        }
    return described


def say_zeros(found: JointCalibration) -> list[str]:
    """What a user should know of zeros and lengths."""
    asked = [(f"joint '{one.name}': its zero", one) for one in found.zeros]
    asked += [(f"link '{one.name}': its length", one) for one in found.lengths]
    texts = []
    for what, one in asked:
        if not one.determined:
            goes_with = f" it goes with {', '.join(one.gauge)};" if one.gauge else ""
            texts.append(
                f"{what} is not determined by these silhouettes and was left as it is;{goes_with} "
                "frames in which the robot stands otherwise, or a part of it that does not move "
                "with this one, would tell it"
            )
    return texts


def corrected_urdf(
    inputs: RegistrationInputs, found: JointCalibration, folder: Path | None
) -> bytes | None:
    """The URDF with zeros and lengths in its joints' origins; its meshes as seen from a folder.

    Args:
        inputs: with the model as it was read.
        found: zeros and lengths.
        folder: where it is to be written; None: nowhere.

    Returns:
        None where it is not asked for, or the model is no URDF.
    """
    model, tree = inputs.model.path, inputs.tree
    if folder is None or not inputs.model.changes_shape or not (found.zeros or found.lengths):
        return None
    zeros = {zero.name: zero.value for zero in found.zeros if zero.determined}
    text = with_zeros(model.read_text(encoding="utf-8"), zeros)
    root = ElementTree.fromstring(with_shifted_joints(text, joint_shifts(tree, found)))
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if "://" not in name:
            mesh.set("filename", os.path.relpath(model.parent / name, folder))
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
