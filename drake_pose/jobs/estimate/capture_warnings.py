"""What went wrong in a capture, in words: who was in view or was not, which camera has moved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drake_pose.jobs.estimate.scene_checks import frame_ranges
from drake_pose.person.recordings.checked_capture import CheckedCapture, MovedCamera
from drake_pose.person.recordings.persons_in_view import ViewFaults
from drake_pose.person.recordings.rig_faults import RigFault

# Below this share of the contours the pose is hardly that of the person in the masks.
_FITS_BADLY = 0.6


def describe_faults(checked: CheckedCapture, frames: Sequence[str]) -> tuple[str, ...]:
    """All that was wrong with a recording whose frames have these names."""
    return (
        *describe_views(checked.views, frames),
        *describe_fit(checked.captured.shares.tolist(), frames),
        *describe_rig(checked.rig),
        *describe_cameras(checked.cameras, frames),
    )


def describe_views(views: ViewFaults, frames: Sequence[str]) -> tuple[str, ...]:
    """Warnings of who was in view or was not."""
    found = []
    if views.nobody:
        names = [frames[k] for k in views.nobody]
        found.append(
            f"frame {frame_ranges(names, frames)}: fewer than two cameras see the person; no pose"
        )
    for camera, indices in views.blind.items():
        names = [frames[k] for k in indices]
        found.append(
            f"camera '{camera}' sees nobody in frame {frame_ranges(names, frames)}, where others "
            "see the person: left out there"
        )
    found += _describe_others(views, frames)
    return tuple(found)


def _describe_others(views: ViewFaults, frames: Sequence[str]) -> list[str]:
    """One warning for all cameras: others walk through all views at once."""
    if not views.others:
        return []
    indices = sorted({k for own in views.others.values() for k in own})
    names = [frames[k] for k in indices]
    text = (
        f"frame {frame_ranges(names, frames)}: somebody else is in view of "
        f"{_cameras(list(views.others))}; the one who is seen longest and largest is followed"
    )
    if views.merged:
        merged = sorted({k for own in views.merged.values() for k in own})
        listed = frame_ranges([frames[k] for k in merged], frames)
        text += f"; in {_cameras(list(views.merged))} both are one silhouette (frame {listed})"
    return [text]


def describe_fit(shares: Sequence[float], frames: Sequence[str]) -> tuple[str, ...]:
    """A warning of a person of whose contours too little fits in the frames with a pose."""
    known = [share for share in shares if share > 0.0]
    usual = float(np.median(known)) if known else 1.0
    if usual > _FITS_BADLY:
        return ()
    text = (
        f"only {100.0 * usual:.0f} % of the contours fit in the median frame, where 90 % are "
        "usual: do the masks show one person, and are cameras.yaml and the folders' names right?"
    )
    return (text,)


def describe_rig(rig: RigFault | None) -> tuple[str, ...]:
    """Warnings of a calibration that the silhouettes contradict as a whole."""
    if rig is None:
        return ()
    worst = min(rig.filled, key=lambda name: rig.filled[name])
    unfit = f"no body fills all silhouettes ({100.0 * rig.filled[worst]:.0f} % of camera '{worst}')"
    if rig.exchanged:
        text = (
            f"{unfit} until the masks of {_cameras(rig.exchanged)} are exchanged: done for this "
            "result; correct the folders' names, or those in cameras.yaml"
        )
        return (text,)
    if rig.mirrored:
        text = (
            f"{unfit} until the masks of {_cameras(rig.mirrored)} are mirrored, left for right: "
            "done for this result, as cameras.yaml is taken for right; if the cameras were "
            "calibrated from mirrored pictures, left and right are exchanged in it: calibrate again"
        )
        return (text,)
    text = f"{unfit}: are cameras.yaml, the folders' names or the masks wrong?"
    return (text,)


def describe_cameras(cameras: Sequence[MovedCamera], frames: Sequence[str]) -> tuple[str, ...]:
    """Warnings of cameras that contradict the others."""
    return tuple(_describe_camera(one, frames) for one in cameras)


def _describe_camera(one: MovedCamera, frames: Sequence[str]) -> str:
    """What is said of a camera that contradicts the others."""
    fault, motion = one.fault, one.fault.motion
    since = "" if one.first == 0 else f" since frame {frames[one.first]}"
    action = f"left out{since}" if one.is_left_out else "used all the same"
    whose = _cameras([fault.name, *fault.rivals], "or")
    if fault.is_explained:
        right, down = motion.shift
        text = (
            f"{whose} has moved{since} after it was calibrated: what the others see lies "
            f"{motion.pixels:.1f} pixels off in its pictures ({abs(right):.1f} to the "
            f"{'right' if right > 0 else 'left'}, {abs(down):.1f} {'down' if down > 0 else 'up'}, "
            f"turned by {np.degrees(motion.turn):.1f} degrees), {100.0 * motion.metres:.0f} cm at "
            f"the person; {action}: calibrate it again"
        )
    else:
        text = (
            f"{whose} contradicts the others{since}: {100.0 * motion.share_before:.0f} % of its "
            f"contours fit what they see, {100.0 * fault.others_share:.0f} % of theirs do; "
            f"{action}. Are its masks poor, mirrored or another camera's, or has it moved far?"
        )
    return text


def _cameras(names: Sequence[str], word: str = "and") -> str:
    """Cameras as text."""
    quoted = [f"'{name}'" for name in names]
    if len(quoted) == 1:
        return f"camera {quoted[0]}"
    return f"{'camera' if word == 'or' else 'cameras'} {', '.join(quoted[:-1])} {word} {quoted[-1]}"
