"""A body's poses in all frames and the cameras that nobody measured, fitted together.

Cameras that are found from estimated joint positions are off with them. So all are fitted to all
silhouettes at once (bundle adjustment), lengths and girths that all frames share among them;
cameras whose places are known hold the whole.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.contour_fit import Noise
from drake_pose.fit.covariance import distances_in_masks, estimate_sizes, values_covariance
from drake_pose.fit.evidence import Evidence
from drake_pose.fit.frames_fit import FramesFit, parameter_names
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import CAMERA_NAMES, GIRTH_PREFIX, POSE_NAMES, BodyParameters
from drake_pose.fit.unknowns import Unknowns, choose, join
from drake_pose.registration.posed_frames import SeenFrame, common_size, middle_of
from drake_pose.registration.shared_fit import (
    PRIOR_DEVIATION,
    STEPS,
    pose_covariance,
)
from drake_pose.silhouette.areas.outline import Outline

_FIRST = (AnnealingStage(0.08, 0.02), AnnealingStage(0.06, 0.02, 3))
# Then as fine as the model is like the body: the finest at which so much of the contours fits.
_SCALES, _FITS = (0.04, 0.03, 0.02, 0.01, 0.005), 0.7
_SPACING, _ITERATIONS = 0.015, 6
# From one point of a silhouette's edge to the next [root of the silhouettes' area].
_EDGE_SPACING = 1.0 / 150.0
# Known beforehand: estimated angles [rad], places and lengths [m], logarithms of girths.
_ANGLE, _PLACE, _LENGTH, _GIRTH = 0.5, 0.5, 0.03, 0.15
# Against contours that err by about so much along about so much [pixel].
_POINT_ERROR, _ERROR_LENGTH = 4.0, 100.0
# The covariance is that of so many frames, and so many distances in them, several an unknown: a
# surface that is not the body's is so in all frames. How far it is off shows at a scale at which
# nothing is left out because it is off.
_TELLING_FRAMES, _MOST_DISTANCES, _UNCUT = 4, 1000, AnnealingStage(0.08, 0.015)


@dataclass(frozen=True, eq=False)
class AdjustedBundle:
    """What was fitted together.

    Args:
        cameras: those that were unknown, with their poses.
        covariances: (c, 6, 6) of these poses' errors, as of ``RegisteredCamera``.
        values: (frames, m) the body's, lengths among them [rad or m].
        girths: (nodes,) how many times as wide the nodes are across their y axes.
    """

    cameras: tuple[PinholeCamera, ...]
    covariances: Array
    values: Array
    girths: Array


def adjust_bundle(
    kinematics: TreeKinematics,
    outlines: Sequence[Outline],
    cameras: Sequence[PinholeCamera],
    unknown: Collection[str],
    frames: Sequence[SeenFrame],
    is_length: Mask,
    parts: Sequence[str] = (),
    groups: Sequence[int] | None = None,
) -> AdjustedBundle:
    """Fits poses and cameras together, in the end as finely as the model is like the body.

    Args:
        cameras: all cameras, those that are unknown near where they stand.
        frames: what they see, and about which values of the body.
        is_length: (m,) which of the pose tree's values are lengths, the same in all frames.
        parts: names of the parts that have a girth: how wide they are across their y axes.
        groups: (nodes,) which of these each node belongs to, or -1; None: none.

    Raises:
        MaskError: a mask of another size than its camera's picture, or no mask shows the body.
    """
    values, size = np.array([frame.values for frame in frames]), common_size(cameras, frames)
    body = BodyParameters(kinematics, outlines, groups, parts)
    free = (kinematics.lower < kinematics.upper) & ~is_length
    looks = [k for k, camera in enumerate(cameras) if camera.name in unknown]
    unknowns = _unknowns(body, free, is_length, cameras, looks)
    fit = FramesFit(
        body, cameras, unknowns, pivot=middle_of(kinematics, frames),
        noise=Noise.of_a_pixel(size), steps=STEPS, pixels=size,
    )  # fmt: skip
    edges = [frame.edges(cameras, _EDGE_SPACING * size) for frame in frames]
    lengths = values[0, is_length]
    shared = np.zeros(len(unknowns.names) - unknowns.own_count)
    shared[: len(lengths)] = lengths
    start = own, now = values[:, free], shared
    held = np.where(free | is_length, 0.0, values)
    found, rounds = None, list(_FIRST)
    for scale in _SCALES:
        rounds.append(AnnealingStage(scale, _SPACING, _ITERATIONS))
        tried = fit.fit(edges, held, own, now, rounds, expected=start)
        if found and tried.inlier_ratios[tried.inlier_ratios > 0.0].mean() < _FITS:
            break
        found, own, now, rounds = tried, tried.own, tried.shared, []
    assert found is not None
    girths = np.append(found.shared[len(lengths) : len(lengths) + len(parts)], 0.0)
    X_CW, _, _ = fit.places(found.parameters[0])
    return AdjustedBundle(
        tuple(replace(cameras[k], X_WC=np.linalg.inv(X_CW[k])) for k in looks),
        _covariances(fit, edges, found.parameters, kinematics.is_angle[free], looks),
        found.parameters[:, : values.shape[1]],
        np.exp(girths[body.groups]),
    )


def _unknowns(
    body: BodyParameters,
    free: Mask,
    lengths: Mask,
    cameras: Sequence[PinholeCamera],
    looks: Sequence[int],
) -> Unknowns:
    """Each frame's pose; and lengths, girths and cameras of all frames."""
    kinematics, worth = body.kinematics, _POINT_ERROR * np.sqrt(_ERROR_LENGTH)
    deviations = np.where(lengths, _LENGTH, np.where(kinematics.is_angle, _ANGLE, _PLACE))
    girths = [name for name in body.names if name.startswith(GIRTH_PREFIX)]
    names = [f"{cameras[k].name}.{name}" for k in looks for name in POSE_NAMES]
    every = parameter_names(body, cameras)
    own, shared = (
        choose(
            every, np.array(kinematics.names)[which].tolist(), shared=is_shared,
            lower=kinematics.lower[which], upper=kinematics.upper[which],
            deviation=deviations[which] / worth,
        )
        for which, is_shared in ((free, False), (lengths, True))
    )  # fmt: skip
    return join(
        own, shared, choose(every, girths, shared=True, deviation=_GIRTH / worth),
        choose(every, names, shared=True),
    )  # fmt: skip


def _covariances(
    fit: FramesFit, edges: Sequence[Evidence], parameters: Array, own: Mask, looks: Sequence[int]
) -> Array:
    """(c, 6, 6) of the unknown cameras' poses; own: (p,) which own unknowns are angles."""
    count = len(edges)
    frames = np.unique(np.linspace(0, count - 1, _TELLING_FRAMES).round().astype(int))
    pictures = fit.pictures([edges[k] for k in frames], parameters[frames], _UNCUT)
    seen = distances_in_masks(fit.body.outlines, pictures, _MOST_DISTANCES)
    shared = [name.split(".")[-1] in CAMERA_NAMES[:3] for name in fit.unknowns.names[len(own) :]]
    is_angle = np.concatenate([np.tile(own, len(frames)), shared])
    sizes = estimate_sizes(seen, is_angle, prior_deviation=PRIOR_DEVIATION)
    whole = values_covariance(seen, sizes, np.arange(len(is_angle)), is_angle)
    X_CW, _, motions = fit.places(parameters[0])
    first = len(whole) - 6 * len(looks)
    parts = [(k, slice(first + 6 * j, first + 6 * j + 6)) for j, k in enumerate(looks)]
    return np.array([pose_covariance(X_CW[k], motions[k, :6], whole[at, at]) for k, at in parts])
