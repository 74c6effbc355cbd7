"""Motions of cameras or of the base between two frames of a scene."""

from collections.abc import Collection, Mapping

import numpy as np

from drake_pose.camera.models import Camera
from drake_pose.jobs.registration.diagnosis import last_before_change
from drake_pose.registration.findings import Diagnosis, Finding
from drake_pose.registration.online_registration import pose_difference
from drake_pose.registration.register import RegisteredCamera


def changed_after(found: Diagnosis, cameras: Collection[str], least: int) -> tuple[list[int], str]:
    """Return the outlier frames on one side of a change, and the last frame before the change.

    Args:
        found: the diagnosis.
        cameras: names; only frames with masks of exactly these cameras are used.
        least: minimum number of frames on each side of a change.

    Returns:
        the outliers' indices in ``found.frames``, and the last frame's name. ([], ""): no change.
    """
    rows = [k for k, frame in enumerate(found.frames) if {*frame.given_ratios} == {*cameras}]
    wrong = [found.frames[k].finding is not None for k in rows]
    last = last_before_change(wrong, least)
    if last is None:
        return [], ""
    return [rows[k] for k in np.flatnonzero(wrong)], found.frames[rows[last]].frame


def base_motion(
    given: Mapping[str, Camera], placed: Mapping[str, RegisteredCamera], sds: float = 4.0
) -> Finding | None:
    """Return the base's motion that explains the motions of all cameras; None: none does.

    One camera alone does not tell a motion of the base from its own. The finding's shift is that
    of the world's origin; its pixels and p-value are 0.

    ``given``: cameras at their given poses, by name. ``placed``: registered cameras, by name; each
    is in `given`. ``sds``: maximum difference between the cameras' motions [standard deviations],
    to which 0.25 degrees and 3 mm are added.
    """
    motions = [given[name].X_WC @ camera.camera.X_CW for name, camera in placed.items()]
    rotation_sd = max((camera.rotation_sd for camera in placed.values()), default=0.0)
    shift_sd = max((camera.translation_sd for camera in placed.values()), default=0.0)
    differences = [pose_difference(motion, motions[0]) for motion in motions[1:]]
    most = sds * rotation_sd + np.radians(0.25), sds * shift_sd + 0.003
    if not differences or any(
        np.linalg.norm(difference[:3]) > most[0] or np.linalg.norm(difference[3:]) > most[1]
        for difference in differences
    ):
        return None
    motion = pose_difference(motions[0], np.eye(4))
    size = float(np.linalg.norm(motion[:3])), float(np.linalg.norm(motion[3:]))
    return Finding("base", "base", *size, rotation_sd, shift_sd, 0.0, 0.0)
