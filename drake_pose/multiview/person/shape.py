"""A person's own lengths and girths, from the silhouettes of several frames at once.

Lengths are the model's shape joints, girths how wide its parts are across their y axis. All frames
share them, each frame has its own pose: the poses are eliminated from the normal equations (Schur's
complement), so that a frame costs the same however many there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.body import PoseTree, TriangleMesh
from drake_pose.camera import Camera
from drake_pose.errors import ModelError
from drake_pose.multiview.person.pose_uncertainty import pose_uncertainty
from drake_pose.multiview.person.silhouette_edges import EdgePoints
from drake_pose.multiview.person.silhouette_fit import Noise, Round, SilhouetteFit
from drake_pose.silhouette import Outline, outline_from_mesh

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ShapeSettings:
    """How a person's shape is fitted.

    Args:
        rounds: the steps.
        length_deviation: how far lengths are off the model's [m].
        side_deviation: how far left and right differ [m].
        girth_deviation: how far girths are off the model's, as a share.
        pose_deviation: how far a frame's angles are off where they were [rad].
    """

    rounds: tuple[Round, ...] = (
        Round(0.10, 0.04),
        Round(0.08, 0.04),
        Round(0.06, 0.04),
        Round(0.05, 0.04),
        Round(0.04, 0.04),
        Round(0.04, 0.04),
        Round(0.03, 0.04),
        Round(0.03, 0.04),
    )
    length_deviation: float = 0.03
    side_deviation: float = 0.005
    girth_deviation: float = 0.15
    pose_deviation: float = 0.5


@dataclass(frozen=True, eq=False)
class PersonShape:
    """A person's shape.

    Args:
        values: (m,) of the pose tree; the shape joints' are the person's, others 0.
        covariance: (h, h) of the shape joints' [m].
        is_shape: (m,) which values are shape joints.
        girths: by part, sides alike: how wide, 1 as the model.
        poses: (frames, m) values in the frames that it was fitted to.
        outlines: the model's simplified surfaces with these girths.
    """

    values: Array
    covariance: Array
    is_shape: Mask
    girths: dict[str, float]
    poses: Array
    outlines: tuple[Outline, ...]


def shape_values(tree: PoseTree) -> Mask:
    """(m,) which of a tree's values are shape joints: lengths that do not move the whole body."""
    fit_names = [name for node in tree.nodes for name in node.value_names]
    root = set(tree.nodes[0].value_names)
    kinds = tree.model.position_kinds
    return np.array(
        [
            name not in root and kinds[tree.model.position_index(name)] == "length"
            for name in fit_names
        ],
        dtype=np.bool_,
    )


def fit_shape(
    fit: SilhouetteFit,
    frames: Sequence[tuple[Sequence[Camera], Sequence[EdgePoints]]],
    poses: Array,
    settings: ShapeSettings | None = None,
) -> PersonShape:
    """Fits lengths, girths and all frames' poses.

    Args:
        fit: made for a model with shape joints, such as urdf/person/person_shape.urdf.
        frames: the cameras of each and their regions' edges.
        poses: (frames, m) values to start from.
        settings: how.

    Raises:
        ModelError: the model has no shape joints.
    """
    settings = settings or ShapeSettings()
    is_shape = shape_values(fit.tree)
    if not is_shape.any():
        raise ModelError(f"{fit.tree.model.path}: a person's shape needs a model with shape joints")
    parts, groups = shape_parts(fit.tree)
    girths = np.zeros(len(parts))
    shape = np.zeros(int(is_shape.sum()))
    prior = _shape_prior(fit, is_shape, len(parts), settings)
    poses, start = np.array(poses, dtype=np.float64), np.array(poses, dtype=np.float64)
    worn = fit
    for step in settings.rounds:
        S, s = prior.copy(), prior @ np.concatenate([shape, girths])
        backs = []
        for k, (cameras, edges) in enumerate(frames):
            poses[k, is_shape] = shape
            H, g, _ = worn.equations(cameras, edges, poses[k], step, groups)
            part, change, back = _eliminate(fit, H, g, poses[k], start[k], is_shape, settings)
            S, s = S + part, s + change
            backs.append(back)
        x = np.linalg.solve(S, -s)
        x *= min(1.0, 0.1 / float(np.abs(x).max()))
        shape = np.clip(shape + x[: len(shape)], fit.lower[is_shape], fit.upper[is_shape])
        girths = np.clip(girths + x[len(shape) :], -0.5, 0.5)
        for k, (index, gain, offset) in enumerate(backs):
            change = np.clip(offset - gain @ x, -0.35, 0.35)
            poses[k, index] = np.clip(poses[k, index] + change, fit.lower[index], fit.upper[index])
        outlines = widened(fit, np.exp(girths)[groups])
        worn = SilhouetteFit(fit.tree, outlines, fit.noise)
    values = np.zeros(len(is_shape))
    values[is_shape] = shape
    poses[:, is_shape] = shape
    widths = {part: float(np.exp(girth)) for part, girth in zip(parts, girths, strict=True)}
    information = prior[: len(shape), : len(shape)] + _told(worn, frames, poses, is_shape, settings)
    covariance = np.asarray(np.linalg.inv(information))
    return PersonShape(values, covariance, is_shape, widths, poses, worn.outlines)


def _told(
    fit: SilhouetteFit,
    frames: Sequence[tuple[Sequence[Camera], Sequence[EdgePoints]]],
    poses: Array,
    is_shape: Mask,
    settings: ShapeSettings,
) -> Array:
    """(h, h) information about the lengths, that of a frame, the mean.

    Where a person's surface is not the model's it is so in all frames: more of them do not help.
    """
    own = np.flatnonzero(~is_shape)
    apriori = np.eye(len(own)) / settings.pose_deviation**2
    told = np.zeros((int(is_shape.sum()), int(is_shape.sum())))
    for (cameras, edges), pose in zip(frames, poses, strict=True):
        H = pose_uncertainty(fit, cameras, edges, pose, settings.rounds[-1]).information
        cross = H[np.ix_(own, is_shape)]
        follow = np.linalg.solve(H[np.ix_(own, own)] + apriori, cross)
        told += (H[np.ix_(is_shape, is_shape)] - cross.T @ follow) / len(frames)
    return told


def widened(fit: SilhouetteFit, girths: Array) -> tuple[Outline, ...]:
    """The fit's surfaces, each node's as wide across its y axis as girths (nodes,) say."""
    wider = []
    for outline, girth in zip(fit.outlines, girths, strict=True):
        vertices = outline.vertices * [girth, 1.0, girth]
        wider.append(outline_from_mesh(TriangleMesh(vertices, outline.triangles)))
    return tuple(wider)


def shape_parts(tree: PoseTree) -> tuple[list[str], list[int]]:
    """The parts that have a girth, and which of them each node belongs to."""
    names = [
        node.name.removeprefix("left_").removeprefix("right_").removesuffix("_end")
        for node in tree.nodes
    ]
    parts = list(dict.fromkeys(names))
    return parts, [parts.index(name) for name in names]


def _shape_prior(fit: SilhouetteFit, is_shape: Mask, girths: int, settings: ShapeSettings) -> Array:
    """The information about lengths and girths before any picture."""
    names = [name for name, wanted in zip(fit.kinematics.names, is_shape, strict=True) if wanted]
    count = len(names)
    prior = np.zeros((count + girths, count + girths))
    prior[range(count), range(count)] = 1.0 / settings.length_deviation**2
    for k in range(count, count + girths):
        prior[k, k] = 1.0 / settings.girth_deviation**2
    for k, name in enumerate(names):
        other = name.replace("left_", "right_", 1)
        if name.startswith("left_") and other in names:
            row = np.zeros(len(prior))
            row[k], row[names.index(other)] = 1.0, -1.0
            prior += np.outer(row, row) / settings.side_deviation**2
    return prior


def _eliminate(
    fit: SilhouetteFit,
    H: Array,
    g: Array,
    pose: Array,
    start: Array,
    is_shape: Mask,
    settings: ShapeSettings,
) -> tuple[Array, Array, tuple[NDArray[np.intp], Array, Array]]:
    """A frame's share of the shape's equations, and how its pose follows the shape."""
    own = np.flatnonzero(~is_shape)
    stuck = ((pose <= fit.lower) & (g[: len(pose)] > 0)) | (
        (pose >= fit.upper) & (g[: len(pose)] < 0)
    )
    own = own[~stuck[own]]
    shared = np.concatenate([np.flatnonzero(is_shape), np.arange(len(pose), len(H))])
    information = 1.0 / settings.pose_deviation**2
    pull = g[own] + information * (pose - start)[own]
    block = H[np.ix_(own, own)] + information * np.eye(len(own))
    gain = np.asarray(np.linalg.solve(block, H[np.ix_(own, shared)]))
    offset = np.asarray(np.linalg.solve(block, -pull))
    cross = H[np.ix_(shared, own)]
    part = np.asarray(H[np.ix_(shared, shared)] - cross @ gain)
    return part, np.asarray(g[shared] + cross @ offset), (own, gain, offset)


def shape_noise() -> Noise:
    """What a point of contour is worth where the model is only like the person."""
    return Noise(deviation=0.02, correlation=0.15)
