"""All pictures of a camera that was found in some of them: their masks, and which contradict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.fit.background import Light
from drake_pose.fit.surfaces import hull_of_few
from drake_pose.registration.picture_registration import (
    PictureRegistration,
    posed_pictures,
)
from drake_pose.registration.picture_search import ABOUT, PosedPicture, see_picture
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.register import (
    FrameMisfit,
    RegisteredCamera,
    RegistrationBody,
    frame_misfits,
)
from drake_pose.registration.shared_fit import SharedFit, agreeing_share
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.workers import map_ordered

# At most so many pictures are judged, so many at once.
_MOST, _AT_ONCE = 300, 20
# A picture shows the body where it should cover this share of it.
_SHOWN = 0.01
# A frame contradicts the others whose contours fit less, and that overlaps less than so many times
# what those of the fit do: dark and blurred contours fit badly where the body is right, too.
_OVERLAPS = 0.9


@dataclass(frozen=True, eq=False)
class JudgedPictures:
    """What all pictures show of a body whose camera was found in some of them.

    Args:
        frames: those that show it, with masks.
        misfits: of these.
        lost: frames in which nothing is seen of a body that should be.
    """

    frames: tuple[PosedFrame, ...]
    misfits: tuple[FrameMisfit, ...]
    lost: tuple[str, ...]


def judge_pictures(
    body: RegistrationBody, one: PictureRegistration, found: RegisteredCamera
) -> JudgedPictures:
    """Which of a recording's pictures contradict the others; of many, some spread over all.

    Args:
        one: what was found in some of them.
        found: the camera, where it is known to be by now.
    """
    count = len(one.recording.names)
    rows = np.unique(np.linspace(0, count - 1, min(count, _MOST)).round().astype(int)).tolist()
    fitted = one.fit.fit
    overlaps = [frame.iou for frame in one.found.frames if frame.agrees]
    least = agreeing_share(fitted.inlier_ratios(one.fit.found)), _OVERLAPS * np.median(overlaps)
    frames, misfits, lost = list[PosedFrame](), list[FrameMisfit](), list[str]()
    for k in range(0, len(rows), _AT_ONCE):
        seen = list[PosedFrame]()
        for name, frame in _see(body, one, found, rows[k : k + _AT_ONCE]):
            if frame is None:
                lost.append(name)
            else:
                seen.append(frame)
        if seen:
            misfits += _misfits(body, found, seen, least)
            # Odds fill the memory.
            frames += [
                replace(frame, values=frame.values - one.zeros, odds=None, rates=None)
                for frame in seen
            ]
    return JudgedPictures(tuple(frames), tuple(misfits), tuple(lost))


def _see(
    body: RegistrationBody,
    one: PictureRegistration,
    found: RegisteredCamera,
    rows: Sequence[int],
) -> list[tuple[str, PosedFrame | None]]:
    """Pictures that should show the body, with masks; None: nothing is seen of it."""
    known, camera = one.fit.background, found.camera
    outlines = hull_of_few(body.very_few, ABOUT)
    offset = 0.0 if one.offset is None else one.offset.value

    def see(posed: PosedPicture) -> tuple[str, PosedFrame | None] | None:
        covered = draw_mask(outlines, camera.X_CW @ body.kinematics.poses(posed.values), camera)
        if covered.mean() < _SHOWN:
            return None
        light = Light.between(posed.picture, known.colours)
        return posed.name, see_picture(posed, known, light, covered)

    pictures = posed_pictures(one.recording.with_zeros(one.zeros), rows, offset)
    return [told for told in map_ordered(see, pictures) if told is not None]


def _misfits(
    body: RegistrationBody,
    found: RegisteredCamera,
    seen: Sequence[PosedFrame],
    least: tuple[float, float],
) -> list[FrameMisfit]:
    """How well frames fit; those agree that fit, or overlap, no less."""
    whole = PosedFrames(body.kinematics, body.all, found.camera, seen)
    fit = SharedFit([whole], [found.camera.X_CW], widths=False)
    ratios, X_CW = fit.inlier_ratios(fit.start), found.camera.X_CW
    told = frame_misfits(whole, X_CW, ratios, ratios >= least[0])
    return [replace(one, agrees=one.agrees or one.iou >= least[1]) for one in told]
