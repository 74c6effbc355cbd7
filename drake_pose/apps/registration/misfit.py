"""Whether a camera's pose explains its masks, and what would, where it does not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.apps.estimate.fit_checks import BADLY_EXPLAINED
from drake_pose.apps.texts import percent
from drake_pose.camera import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.register import CameraSearch, RegisteredCamera

# Of the contours in the two frames that fit best, this share fits at least. A robot that is the
# masks' leaves 0.83 and more, with holes and tools; mirrored masks, another robot's or exchanged
# frames 0.6 at most.
_LEAST_SHARE = 0.65
# Focal lengths that are tried where nothing fits, over the camera's.
_FOCALS = (0.5, 0.7, 1.4, 2.0)
# Something else explains the masks better that leaves less than this share of what was left.
_MUCH_BETTER = 0.6


@dataclass(frozen=True)
class Misfit:
    """What a camera's pose leaves, where it explains too little.

    Args:
        E_total: in the median of the frames that agree.
        reason: what is too little.
    """

    E_total: float
    reason: str


def find_misfit(found: RegisteredCamera) -> Misfit | None:
    """What is wrong with a pose that does not explain the masks; None where it does."""
    agreeing = [frame for frame in found.frames if frame.agrees]
    left = _left(found)
    share = float(np.mean(np.sort([frame.share for frame in found.frames])[-2:]))
    if len(found.frames) > 1 and len(agreeing) < 2:
        return Misfit(
            left,
            f"no two of its {len(found.frames)} frames agree on one; at best frame "
            f"'{agreeing[0].frame}' fits alone",
        )
    if left < BADLY_EXPLAINED and share >= _LEAST_SHARE:
        return None
    return Misfit(
        left,
        f"body and silhouettes differ by {percent(left)} of the silhouettes' area at best, and of "
        f"the contours {percent(share)} fit",
    )


def require_explained(
    search: CameraSearch, found: RegisteredCamera, frames: Sequence[PosedFrame]
) -> None:
    """Refuses a pose that does not explain even those frames that agree best.

    Raises:
        RegistrationError: says how much remains, what would fit, and what to look at.
    """
    misfit = find_misfit(found)
    if misfit is None:
        return
    better = [
        text
        for text, other, seen in _others(found.camera, frames)
        if _explains(search.register(other, seen), misfit.E_total)
    ]
    advice = "; ".join(better) or (
        "are these masks of this robot, are the joint positions those of these frames, in radians "
        "and with the signs and zeros of the model's file, are focal length and principal point "
        "the camera's, are the pictures free of distortion?"
    )
    raise RegistrationError(
        f"camera '{found.camera.name}': no pose explains its masks: {misfit.reason}; {advice} "
        "Nothing was written"
    )


def _others(
    camera: PinholeCamera, frames: Sequence[PosedFrame]
) -> Iterator[tuple[str, PinholeCamera, list[PosedFrame]]]:
    """What else may be the case: a text, and the camera and frames as they would be then."""
    turned = [
        PosedFrame(frame.name, frame.values, np.ascontiguousarray(frame.mask[:, ::-1]))
        for frame in frames
    ]
    text = (
        "they fit when they are mirrored: turn the pictures back, or change the sign of all joint "
        "positions."
    )
    yield text, replace(camera, center_x=camera.width - 1 - camera.center_x), turned
    for factor in _FOCALS:
        focal_x, focal_y = factor * camera.focal_x, factor * camera.focal_y
        text = (
            f"they fit with focal lengths near {focal_x:.0f}, {focal_y:.0f} pixels: calibrate it."
        )
        yield text, replace(camera, focal_x=focal_x, focal_y=focal_y), list(frames)


def _explains(found: RegisteredCamera, left: float) -> bool:
    return find_misfit(found) is None and _left(found) < _MUCH_BETTER * left


def _left(found: RegisteredCamera) -> float:
    """E_total in the median of the frames that agree."""
    return float(np.median([frame.E_total for frame in found.frames if frame.agrees]))
