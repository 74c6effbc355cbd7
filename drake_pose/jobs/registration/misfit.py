"""Whether a camera's pose explains its masks, and what would, where it does not."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from drake_pose.arrays import Array
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.files.options import percent
from drake_pose.files.summary import BADLY_EXPLAINED
from drake_pose.fit.parameters import POSE_NAMES
from drake_pose.registration.joint_zeros import calibrate_joints
from drake_pose.registration.online_registration import pose_difference
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import (
    SEARCH,
    CameraSearch,
    RegisteredCamera,
    RegistrationBody,
    spread,
)
from drake_pose.registration.shared_fit import SharedFit
from drake_pose.registration.standing_object import ObjectSearch

# Of the contours in the two frames that fit best, this share fits at least. A robot that is the
# masks' leaves 0.83 and more, with holes and tools; mirrored masks, another robot's or exchanged
# frames 0.6 at most.
_LEAST_INLIER_RATIO = 0.65
# Focal lengths that are tried where nothing fits, over the camera's.
_FOCALS = (0.5, 0.7, 1.4, 2.0)
# A focal length is wrong that differs from the one which the masks tell by so much, and by so many
# standard deviations; and it is too wrong for a calibration where it differs by more. Published
# focal lengths of recorded arms differ by 2 % at most.
_FOCAL_OFF, _FOCAL_DEVIATIONS, _FOCAL_WRONG = 0.03, 4.0, 0.06
# It need not be looked at closely that seems to differ by less than this share of that.
_SURELY = 0.6
# A camera on a link is not determined that is less sure [rad, m].
_UNTOLD = 0.04
# What else may be the case is tried roughly, in so many frames.
_ROUGH_FRAMES = 5
# So many frames tell whether a focal length may be off.
_FOCAL_FRAMES = 60
# Something else explains the masks better that leaves less than this share of what was left.
_MUCH_BETTER = 0.6


Search = CameraSearch | ObjectSearch
"""What finds a camera, and may find it again with other settings."""


def find_misfit(found: RegisteredCamera) -> str | None:
    """What is wrong with a pose that does not explain the masks; None where it does."""
    agreeing = [frame for frame in found.frames if frame.agrees]
    left = _left(found)
    ratio = float(np.mean(np.sort([frame.inlier_ratio for frame in found.frames])[-2:]))
    if len(found.frames) > 1 and len(agreeing) < 2:
        return (
            f"no two of its {len(found.frames)} frames agree on one; at best frame "
            f"'{agreeing[0].frame}' fits alone"
        )
    if left < BADLY_EXPLAINED and ratio >= _LEAST_INLIER_RATIO:
        return None
    return (
        f"body and silhouettes differ by {percent(left)} of the silhouettes' area at best, and of "
        f"the contours {percent(ratio)} fit"
    )


def require_explained(
    search: Search, found: RegisteredCamera, frames: Sequence[PosedFrame]
) -> None:
    """Refuses a pose that does not explain even those frames that agree best.

    Raises RegistrationError: says how much remains, what would fit, and what to look at.
    """
    misfit = find_misfit(found)
    if misfit is None:
        return
    search, better = search.rough(), []
    for text, camera, seen in _others(found.camera, frames):
        try:
            other = search.register(camera, seen)
        except RegistrationError:
            continue
        if find_misfit(other) is None and _left(other) < _MUCH_BETTER * _left(found):
            better.append(text)
    advice = "; ".join(better) or (
        "are these masks of this robot or object, are the joint positions those of these frames, "
        "in radians and with the signs and zeros of the model's file, are focal length and "
        "principal point the camera's, are the pictures free of distortion?"
    )
    raise RegistrationError(
        f"camera '{found.camera.name}': no pose explains its masks: {misfit}; {advice} "
        "Nothing was written"
    )


def require_determined(found: RegisteredCamera) -> None:
    """Refuses a pose on a link that its frames hardly tell.

    Raises RegistrationError: says how unsure it is.
    """
    turn, shift = (
        math.sqrt(float(np.linalg.eigvalsh(part)[-1]))
        for part in (found.covariance[:3, :3], found.covariance[3:, 3:])
    )
    if turn > _UNTOLD or shift > _UNTOLD:
        raise RegistrationError(
            f"camera '{found.camera.name}': its frames do not determine where it is on the link: "
            f"standard deviations of {math.degrees(turn):.1f} degrees and {1e3 * shift:.0f} mm "
            "along some axes; add frames between which the link turns by 20 degrees and more about "
            "at least two axes. Nothing was written"
        )


def check_focal_length(
    body: RegistrationBody, found: RegisteredCamera, frames: Sequence[PosedFrame]
) -> tuple[Array, list[str]]:
    """Compares a camera's focal length with that which the masks themselves tell.

    Returns:
        The camera's covariance, and a warning where it may be a little off: then it may as well
        stand where it would with the other one, and its covariance says so.

    Raises:
        RegistrationError: it is wrong, and with it the camera's distance.
    """
    counted = [frame for frame, fit in zip(frames, found.frames, strict=True) if fit.agrees]
    few = spread(counted, _FOCAL_FRAMES)
    if len(few) < 2 or abs(_focal_length_off(body, found, few)) < _SURELY * _FOCAL_OFF:
        return found.covariance, []
    told = calibrate_joints(body, [found], [counted], (), focal=True)
    camera, deviation = told.cameras[0], float(told.focal_deviations[0])
    off = math.log(camera.focal_x / found.camera.focal_x)
    if abs(off) < max(_FOCAL_OFF, _FOCAL_DEVIATIONS * deviation):
        return found.covariance, []
    text = (
        f"camera '{found.camera.name}': its pictures tell a focal length of {camera.focal_x:.0f} "
        f"pixels (standard deviation {deviation * camera.focal_x:.0f}), but it is given as "
        f"{found.camera.focal_x:.0f}; is it that of this camera, and of pictures of this size? "
        "With a wrong one the camera stands at a wrong distance; calibrate it"
    )
    if abs(off) > _FOCAL_WRONG:
        raise RegistrationError(f"{text}. Nothing was written")
    by = pose_difference(camera.X_WC, found.camera.X_WC)
    return told.covariances[0] + np.outer(by, by), [text]


def _focal_length_off(
    body: RegistrationBody, found: RegisteredCamera, frames: Sequence[PosedFrame]
) -> float:
    """By how much a focal length seems to be off, in a hurry: the logarithm of a factor."""
    seen = PosedFrames(body.kinematics, body.all, found.camera, frames)
    fit = SharedFit([seen], [found.camera.X_CW], looks=len(POSE_NAMES) + 1)
    camera = fit.cameras(fit.fit((*SEARCH.fine, *SEARCH.last)))[0]
    return math.log(camera.focal_x / found.camera.focal_x)


def _others(
    camera: PinholeCamera, frames: Sequence[PosedFrame]
) -> Iterator[tuple[str, PinholeCamera, list[PosedFrame]]]:
    """What else may be the case: a text, and the camera and frames as they would be then."""
    some = spread(frames, _ROUGH_FRAMES)
    turned = [
        PosedFrame(frame.name, frame.values, np.ascontiguousarray(frame.mask[:, ::-1]))
        for frame in some
    ]
    text = (
        "they fit when they are mirrored: turn the pictures back, or change the sign of all joint "
        "positions."
    )
    yield text, camera.mirrored(), turned
    if len(frames) > 2:
        pairs = list(pairwise(frames))[:_ROUGH_FRAMES]
        for which, moved in (
            ("next", [PosedFrame(a.name, b.values, a.mask) for a, b in pairs]),
            ("previous", [PosedFrame(b.name, a.values, b.mask) for a, b in pairs]),
        ):
            yield f"they fit with the joint positions of the {which} frame.", camera, moved
    for factor in _FOCALS:
        focal_x, focal_y = factor * camera.focal_x, factor * camera.focal_y
        text = (
            f"they fit with focal lengths near {focal_x:.0f}, {focal_y:.0f} pixels: calibrate it."
        )
        yield text, replace(camera, focal_x=focal_x, focal_y=focal_y), some


def _left(found: RegisteredCamera) -> float:
    """E_total in the median of the frames that agree."""
    return float(np.median([frame.E_total for frame in found.frames if frame.agrees]))
