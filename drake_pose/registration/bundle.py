"""Bundle adjustment: fit cameras, estimated positions and the body's shape to all silhouettes."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.covariance import distances_in_masks, estimate_sizes, values_covariance
from drake_pose.fit.evidence import Observation
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import CAMERA_NAMES, POSE_NAMES, RADIUS_SCALE_PREFIX, BodyParameters
from drake_pose.fit.problem import Problem, Unknowns
from drake_pose.registration.posed_frames import MultiViewFrame, common_size, middle_of
from drake_pose.registration.shared_fit import SHARED, pose_covariance
from drake_pose.silhouette.outline import Outline


def adjust_bundle(
    kinematics: TreeKinematics,
    outlines: Sequence[Outline],
    cameras: Sequence[PinholeCamera],
    unknown: Collection[str],
    frames: Sequence[MultiViewFrame],
    is_length: Mask,
    parts: Sequence[str] = (),
    groups: Sequence[int] | None = None,
    covariance_frames: int = 4,
) -> tuple[list[PinholeCamera], Array, Array, Array]:
    """Fit unknown cameras, all poses and the body's shape to all silhouettes (bundle adjustment).

    Cameras registered with estimated joint positions inherit their errors. So cameras, positions,
    lengths and radius scales are fitted together; cameras with known poses fix the world frame.

    Args:
        kinematics: of the body's pose tree, with m values. Values with equal limits stay fixed.
        outlines: a surface for each node of the tree.
        cameras: all cameras; the unknown ones near their poses.
        unknown: names of the c cameras whose poses are fitted.
        frames: the masks, with approximate values of the tree: start and mean of the prior.
        is_length: (m,) which of the tree's values are lengths, the same in all frames. They start
            from the first frame's.
        parts: names of the parts that have a radius scale, a factor of the width across y.
        groups: (nodes,) index in `parts` of each node's part, or -1; None: no parts.
        covariance_frames: number of frames from which covariances are estimated.

    Returns the unknown cameras at their fitted poses, in the order of `cameras`; their (c, 6, 6)
    covariances, see ``RegisteredCamera``; the tree's fitted values (frames, m) [rad or m]; and the
    radius scales (nodes,), 1 for nodes without a part.

    Raises MaskError: a mask's size differs from its camera's, or no mask shows the body.
    """
    values, size = np.array([frame.values for frame in frames]), common_size(cameras, frames)
    body = BodyParameters(kinematics, outlines, groups, parts)
    free = (kinematics.lower < kinematics.upper) & ~is_length
    searched = [k for k, camera in enumerate(cameras) if camera.name in unknown]
    # Prior standard deviations: angles [rad], places and lengths [m], log radius scales.
    error = SHARED.point_error * np.sqrt(SHARED.error_length)
    deviations = np.where(is_length, 0.03, 0.5) / error
    pose, lengths = (
        Unknowns(
            np.array(kinematics.names)[chosen].tolist(), shared, kinematics.lower[chosen],
            kinematics.upper[chosen], deviations[chosen],
        )
        for chosen, shared in ((free, False), (is_length, True))
    )  # fmt: skip
    radius_scales = [name for name in body.names if name.startswith(RADIUS_SCALE_PREFIX)]
    poses = [f"{cameras[k].name}.{name}" for k in searched for name in POSE_NAMES]
    unknowns = [
        pose,
        lengths,
        Unknowns(radius_scales, True, deviation=0.15 / error),
        Unknowns(poses, True),
    ]
    fit = Problem(
        body, cameras, unknowns, pivot=middle_of(kinematics, frames), steps=SHARED.steps,
        pixels=size,
    )  # fmt: skip
    held = np.where(free | is_length, 0.0, values)
    observations = [
        Observation(frame.edges(cameras, size / 150.0), row)
        for frame, row in zip(frames, held, strict=True)
    ]
    count = len(lengths.names)
    shared = np.zeros(len(fit.names) - fit.own_count)
    shared[:count] = values[0, is_length]
    start = now = values[:, free], shared
    found, rounds = None, [AnnealingStage(0.08, 0.02), AnnealingStage(0.06, 0.02, 3)]
    # The finest scale at which 0.7 of the contours fit: the model's surface is no more exact.
    for scale in (0.04, 0.03, 0.02, 0.01, 0.005):
        rounds.append(AnnealingStage(scale, 0.015, 6))
        tried = fit.solve(observations, rounds, now, expected=start)
        if found and tried.inlier_ratios[tried.inlier_ratios > 0.0].mean() < 0.7:
            break
        found, now, rounds = tried, (tried.own, tried.shared), []
    assert found is not None
    # Covariances use a few frames and at most 1000 distances: errors of the surface are the same in
    # all frames. They are measured at a scale at which none of the contours are outliers.
    some = np.unique(np.linspace(0, len(observations) - 1, covariance_frames).round().astype(int))
    coarse = AnnealingStage(0.08, 0.015)
    masks = fit.compared_masks([observations[k] for k in some], found.parameters[some], coarse)
    distances = distances_in_masks(body.outlines, masks, 1000)
    turns = [name.split(".")[-1] in CAMERA_NAMES[:3] for name in fit.names[fit.own_count :]]
    is_angle = np.concatenate([np.tile(kinematics.is_angle[free], len(some)), turns])
    sizes = estimate_sizes(distances, is_angle, prior_deviation=SHARED.prior_deviation)
    whole = values_covariance(distances, sizes, np.arange(len(is_angle)), is_angle)
    X_CW, _, motions = fit.place_cameras(found.parameters[0])
    own = np.arange(len(whole) - len(poses), len(whole)).reshape(len(searched), 6)
    found_cameras = [replace(cameras[k], X_WC=np.linalg.inv(X_CW[k])) for k in searched]
    covariances = [
        pose_covariance(X_CW[k], motions[k, :6], whole[np.ix_(at, at)])
        for k, at in zip(searched, own, strict=True)
    ]
    factors = np.exp(np.append(found.shared[count : count + len(parts)], 0.0)[body.groups])
    values = found.parameters[:, : values.shape[1]]
    return found_cameras, np.array(covariances), values, factors
