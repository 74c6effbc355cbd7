"""Zeros of joints and focal lengths, asked for beside the cameras' poses."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.apps.registration.inputs import RegistrationInputs, RegistrationSettings
from drake_pose.body.files.urdf_shape import with_zeros
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.registration.joint_zeros import JointCalibration, calibrate_joints
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import FrameMisfit, RegisteredCamera, RegistrationBody
from drake_pose.registration.start_poses import E_total, areas, intersection_over_union

ALL = "all"


def find_zeros(
    inputs: RegistrationInputs,
    settings: RegistrationSettings,
    body: RegistrationBody,
    registered: Mapping[str, RegisteredCamera],
) -> tuple[dict[str, RegisteredCamera], RegistrationInputs, JointCalibration]:
    """The cameras, and the frames' positions, with the zeros that were found.

    Raises:
        UnknownNameError: there is no such joint.
        RegistrationError: fewer frames than zeros.
    """
    kinematics = body.kinematics
    moving = [kinematics.names[k] for k in np.flatnonzero(kinematics.lower < kinematics.upper)]
    names = moving if ALL in settings.zeros else list(settings.zeros)
    cameras = list(registered.values())
    frames = [inputs.frames[one.camera.name] for one in cameras]
    found = calibrate_joints(body, cameras, frames, names, settings.focal)
    offsets = np.zeros(len(kinematics.names))
    for zero in found.zeros:
        offsets[kinematics.names.index(zero.name)] = zero.value
    corrected = dict(inputs.frames)
    result = {}
    for camera, covariance, before in zip(found.cameras, found.covariances, cameras, strict=True):
        own = tuple(
            PosedFrame(one.name, one.values + offsets, one.mask)
            for one in inputs.frames[camera.name]
        )
        corrected[camera.name] = own
        again = _misfits(PosedFrames(kinematics, body.all, camera, own), before)
        result[camera.name] = replace(before, camera=camera, covariance=covariance, frames=again)
    return result, replace(inputs, frames=corrected), found


def _misfits(frames: PosedFrames, before: RegisteredCamera) -> tuple[FrameMisfit, ...]:
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


def say_zeros(found: JointCalibration) -> list[str]:
    """What a user should know of the zeros."""
    texts = []
    for zero in found.zeros:
        if not zero.determined:
            goes_with = f" it goes with {', '.join(zero.gauge)};" if zero.gauge else ""
            texts.append(
                f"joint '{zero.name}': its zero is not determined by these silhouettes and was "
                f"left as it is;{goes_with} frames in which the robot stands otherwise, or a part "
                "of it that does not move with this joint, would tell it"
            )
    return texts


def corrected_urdf(model: Path, found: JointCalibration, folder: Path) -> bytes:
    """The model's URDF with the zeros in its joints' origins; its meshes as seen from a folder."""
    zeros = {zero.name: zero.value for zero in found.zeros if zero.determined}
    root = ElementTree.fromstring(with_zeros(model.read_text(encoding="utf-8"), zeros))
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if "://" not in name:
            mesh.set("filename", os.path.relpath(model.parent / name, folder))
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
