"""A person's shape: lengths (shape joints) and radius scales (of parts, across their y axis).

`fit_shape` fits one shape to the silhouettes of several frames, together with each frame's pose.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.body import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.errors import ModelError, UnknownNameError
from drake_pose.fit.contour_fit import ContourFit, Noise, pack_views
from drake_pose.fit.evidence import NO_EDGE, EdgePoints, Observation, pack_evidence
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import RADIUS_SCALE_PREFIX, BodyParameters
from drake_pose.fit.problem import Problem, Unknowns
from drake_pose.fit.surfaces import with_radius_scales
from drake_pose.person.pose_tracker import PersonPoseTracker, pose_uncertainty
from drake_pose.person.search import LENIENT
from drake_pose.silhouette.outline import Outline

Frames = Sequence[tuple[Sequence[Camera], Sequence[EdgePoints]]]
"""Of each frame: the cameras, and the edge points of their regions."""

# Prior standard deviations: of lengths from the model's [m], of left from right lengths [m], of
# log radius scales, and of angles from the start [rad]; and the largest log radius scale.
_LENGTH_DEVIATION, _SIDE_DEVIATION, _SCALE_DEVIATION = 0.03, 0.005, 0.15
_ANGLE_DEVIATION, _MAX_LOG_SCALE = 0.5, 0.5
_STAGES = tuple(
    AnnealingStage(scale, 0.04) for scale in (0.10, 0.08, 0.06, 0.05, 0.04, 0.04, 0.03, 0.03)
)
NOISE = Noise(deviation=0.02, correlation=0.15)
"""Noise of contour points where the model only resembles the person."""


@dataclass(frozen=True, eq=False)
class KnownShape:
    """A person's lengths by shape joint [m], else the model's; radius scales by part, else 1."""

    lengths: Mapping[str, float]
    radius_scales: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class PersonShape:
    """A person's fitted shape."""

    known: KnownShape
    values: Array  # (m,) values of the pose tree: fitted shape joints [m], others 0.
    covariance: Array  # (h, h) covariance of the shape joints [m^2].
    poses: Array  # (frames, m) values in the fitted frames [rad, m].
    outlines: tuple[Outline, ...]  # The model's simplified surfaces with these radius scales.


def shape_values(tree: PoseTree) -> Mask:
    """Return whether each of a tree's values is a shape joint (m,): a length not of the root."""
    root = set(tree.nodes[0].value_names)
    kinds = tree.model.position_kinds
    return np.array(
        [
            name not in root and kinds[tree.model.position_index(name)] == "length"
            for node in tree.nodes
            for name in node.value_names
        ],
        dtype=np.bool_,
    )


def shape_parts(tree: PoseTree) -> tuple[list[str], list[int]]:
    """Return the names of parts with a radius scale, both sides one, and each node's part."""
    names = [
        node.name.removeprefix("left_").removeprefix("right_").removesuffix("_end")
        for node in tree.nodes
    ]
    parts = list(dict.fromkeys(names))
    return parts, [parts.index(name) for name in names]


def tracker_of_person(tree: PoseTree, shape: KnownShape | None) -> PersonPoseTracker:
    """Return a tracker of a person of known shape; its lengths are held.

    `shape` None: the model's own shape.

    Raises ModelError: the model has no landmarks of trunk, arms and legs; UnknownNameError: the
    shape names a length or a part that the model lacks.
    """
    shape = shape or KnownShape({}, {})
    fit, held = ContourFit(tree, noise=NOISE), shape_values(tree)
    rest = fit.kinematics.flatten(tree.default_values())
    names = list(fit.kinematics.names)
    lengths = [name for name, wanted in zip(names, held, strict=True) if wanted]
    for name, length in shape.lengths.items():
        if name not in lengths:
            raise UnknownNameError("length", name, lengths, str(tree.model.path))
        rest[names.index(name)] = length
    parts, groups = shape_parts(tree)
    for part in shape.radius_scales:
        if part not in parts:
            raise UnknownNameError("part", part, parts, str(tree.model.path))
    if shape.radius_scales:
        scales = np.array([shape.radius_scales.get(part, 1.0) for part in parts])
        fit = ContourFit(fit.kinematics, with_radius_scales(fit.outlines, scales[groups]), NOISE)
    return PersonPoseTracker(fit, LENIENT, held, rest)


def fit_shape(fit: ContourFit, frames: Frames, poses: Array) -> PersonShape:
    """Fit lengths, radius scales and the poses of all frames.

    ``fit``: the model's body, without radius scales, and the noise of its contours. ``frames``:
    cameras and edge points of each frame. ``poses``: (frames, m) initial values [rad, m]. Raises
    ModelError: the model has no shape joints, unlike urdf/person/person_shape.urdf.
    """
    is_shape = shape_values(fit.tree)
    if not is_shape.any():
        raise ModelError(f"{fit.tree.model.path}: a person's shape needs a model with shape joints")
    parts, groups = shape_parts(fit.tree)
    body = BodyParameters(fit.kinematics, fit.outlines, groups, parts)
    count = int(is_shape.sum())
    names = [name for name, wanted in zip(body.names, is_shape, strict=False) if wanted]
    cameras = {camera.name: camera for own_cameras, _ in frames for camera in own_cameras}
    observations = []
    for own_cameras, edges in frames:
        seen = {camera.name: edge for camera, edge in zip(own_cameras, edges, strict=True)}
        packed = pack_evidence([seen.get(name, NO_EDGE) for name in cameras])
        observations.append(Observation(packed))
    poses = np.array(poses, dtype=np.float64)
    pose, shape = (
        Unknowns(
            np.array(body.names[: len(chosen)])[chosen].tolist(), shared, fit.lower[chosen],
            fit.upper[chosen], deviation,
        )
        for chosen, shared, deviation in (
            (~is_shape, False, _ANGLE_DEVIATION), (is_shape, True, _LENGTH_DEVIATION)
        )
    )  # fmt: skip
    radius_scales = [name for name in body.names if name.startswith(RADIUS_SCALE_PREFIX)]
    radius_scale = Unknowns(radius_scales, True, -_MAX_LOG_SCALE, _MAX_LOG_SCALE, _SCALE_DEVIATION)
    problem = Problem(body, list(cameras.values()), [pose, shape, radius_scale], noise=fit.noise)
    found = problem.solve(
        observations,
        _STAGES,
        (poses[:, ~is_shape], np.zeros(count + len(parts))),
        shared_information=_sides_information(names, len(parts)),
    )
    lengths, scales = found.shared[:count], np.exp(found.shared[count:])
    shaped = ContourFit(fit.kinematics, with_radius_scales(fit.outlines, scales[groups]), fit.noise)
    values = np.zeros(len(is_shape))
    values[is_shape] = poses[:, is_shape] = lengths
    poses[:, ~is_shape] = found.own
    prior = np.eye(count) / _LENGTH_DEVIATION**2 + _sides_information(names, 0)
    # The information of all frames is averaged, not added: a surface's error is the same in all.
    own, total = np.flatnonzero(~is_shape), np.zeros((count, count))
    for (own_cameras, edges), values_then in zip(frames, poses, strict=True):
        compared = shaped.compare(pack_views(own_cameras, edges), values_then, _STAGES[-1])
        _, H, _ = pose_uncertainty(shaped, compared)
        cross = H[np.ix_(own, is_shape)]
        follow = np.linalg.solve(
            H[np.ix_(own, own)] + np.eye(len(own)) / _ANGLE_DEVIATION**2, cross
        )
        total += (H[np.ix_(is_shape, is_shape)] - cross.T @ follow) / len(frames)
    covariance = np.linalg.inv(prior + total)
    known = KnownShape(
        dict(zip(names, lengths.tolist(), strict=True)),
        dict(zip(parts, scales.tolist(), strict=True)),
    )
    return PersonShape(known, values, np.asarray(covariance), poses, shaped.outlines)


def _sides_information(names: Sequence[str], scale_count: int) -> Array:
    """Return the prior information (n, n) that left and right lengths are alike.

    Args:
        names: shape joints, the first of the n parameters.
        scale_count: number of radius scales, which follow and get no information.
    """
    information = np.zeros((len(names) + scale_count, len(names) + scale_count))
    for k, name in enumerate(names):
        other = name.replace("left_", "right_", 1)
        if name.startswith("left_") and other in names:
            row = np.zeros(len(information))
            row[k], row[list(names).index(other)] = 1.0, -1.0
            information += np.outer(row, row) / _SIDE_DEVIATION**2
    return information
