"""Cameras fitted once more together with the positions from which they were found.

Positions that were estimated are off, and so would the cameras be.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from drake_pose.jobs.estimate.person_choice import missing_for_person
from drake_pose.jobs.registration.inputs import RegistrationInputs
from drake_pose.jobs.registration.zeros import misfits_now
from drake_pose.person.shape import shape_parts, shape_values
from drake_pose.registration.bundle_adjustment import BundleAdjustment, CommonShape
from drake_pose.registration.per_frame_fit import SeenFrame
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import RegisteredCamera, RegistrationBody


def adjust_bundle(
    inputs: RegistrationInputs,
    body: RegistrationBody,
    registered: Mapping[str, RegisteredCamera],
) -> tuple[dict[str, RegisteredCamera], RegistrationInputs, RegistrationBody]:
    """The cameras, the frames' positions and the body, fitted together to what all cameras see.

    Args:
        inputs: with positions that were estimated.
        body: the body.
        registered: the cameras as they were found with these.
    """
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
