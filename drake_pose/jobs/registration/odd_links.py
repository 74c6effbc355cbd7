"""Warn of links that look otherwise than in the model, such as another gripper."""

from collections.abc import Collection, Sequence

import numpy as np
from pydrake.multibody.tree import BodyIndex

from drake_pose.files.settings import percent
from drake_pose.registration.posed_frames import LAST_SPACING, PosedFrame, PosedFrames
from drake_pose.registration.register import RegisteredCamera, RegistrationBody, evenly_spaced
from drake_pose.registration.shared_fit import SharedFit


def odd_link_warnings(
    body: RegistrationBody,
    found: RegisteredCamera,
    frames: Sequence[PosedFrame],
    without: Collection[str] = (),
    *,
    max_ratio: float = 0.75,
    min_fraction: float = 0.04,
    min_elsewhere: float = 0.5,
    most: int = 24,
) -> list[str]:
    """Return a warning of each link whose contour hardly fits while those of other links do.

    Args:
        body: the robot's surfaces.
        found: the registered camera.
        frames: its frames; at most `most` inlier frames are used.
        without: names of links that were left out; links welded to their parents are not judged.
        max_ratio: maximum fitting fraction of a named link's contour, over the links' median. In
            masks by Drake's renderer links as modelled have 0.93 or more, a link with another
            gripper 0.61 at most, with a box of its own size 0.64 at most.
        min_fraction: minimum length of a judged link's contour [length of all contours].
        min_elsewhere: minimum fitting fraction of the other links' contours. Where these do not fit
            either, as with masks that are too wide everywhere, no link is odd.
        most: maximum number of frames.
    """
    names = {frame.frame for frame in found.frames if frame.is_inlier}
    sample = evenly_spaced([frame for frame in frames if frame.name in names], most)
    if not sample:
        return []
    posed = PosedFrames(body.kinematics, body.full, found.camera, sample, LAST_SPACING)
    fit = SharedFit([posed], [found.camera.X_CW])
    lengths, fitting = fit.matched_lengths(fit.start).T
    ratios = fitting / np.maximum(lengths, 1e-9)
    shown = lengths >= min_fraction * max(float(lengths.sum()), 1e-9)
    is_odd = shown & (ratios < max_ratio * np.median(ratios[shown]))
    if not is_odd.any():
        return []
    others = shown & ~is_odd
    ratio = float(fitting[others].sum() / lengths[others].sum())
    if ratio < min_elsewhere:
        return []
    elsewhere = percent(ratio)
    texts, model = [], body.tree.model
    joints = [model.plant.get_joint(index) for index in model.plant.GetJointIndices()]
    cut = [joint.parent_body() for joint in joints if joint.child_body().name() in without]
    for k in np.flatnonzero(is_odd):
        node = body.tree.nodes[k].name
        # The gripper is welded to the last link, as a rule.
        group = model.plant.GetBodiesWeldedTo(
            model.plant.get_body(BodyIndex(model.link_index(node)))
        )
        if any(body.index() == other.index() for body in group for other in cut):
            continue
        fixed = [model.link_names[int(body.index())] for body in group]
        welded = [name for name in fixed if name in model.link_meshes]
        outermost = min(welded, key=lambda name: len(model.carried_by(name)), default=node)
        more = "" if outermost == node else f" (with {outermost})"
        texts.append(
            f"camera '{found.camera.name}': {percent(float(ratios[k]))} of the contour of link "
            f"'{node}'{more} fits, elsewhere {elsewhere}: is another gripper or tool mounted, a "
            "camera or a cable, is a joint before it misread (drake-pose audit tells), or are the "
            f"pictures distorted? --without {outermost} leaves it out, with what it carries"
        )
    return texts
