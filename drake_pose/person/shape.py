"""A person's own lengths and girths, from the silhouettes of several frames at once.

Lengths are the model's shape joints, girths how wide its parts are across their y axis. All frames
share them, each frame has its own pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.camera.models import Camera
from drake_pose.errors import ModelError
from drake_pose.fit.contour_fit import ContourFit, Noise
from drake_pose.fit.evidence import NO_EDGE, EdgePoints, Evidence, pack_evidence
from drake_pose.fit.frames_fit import FramesFit
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import GIRTH_PREFIX, BodyParameters
from drake_pose.fit.surfaces import with_girths
from drake_pose.fit.unknowns import Unknowns, choose, join
from drake_pose.person.pose_uncertainty import pose_uncertainty
from drake_pose.silhouette.areas.outline import Outline

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The logarithm of a girth is no farther from the model's.
_WIDEST = 0.5


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

    rounds: tuple[AnnealingStage, ...] = (
        AnnealingStage(0.10, 0.04),
        AnnealingStage(0.08, 0.04),
        AnnealingStage(0.06, 0.04),
        AnnealingStage(0.05, 0.04),
        AnnealingStage(0.04, 0.04),
        AnnealingStage(0.04, 0.04),
        AnnealingStage(0.03, 0.04),
        AnnealingStage(0.03, 0.04),
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
    fit: ContourFit,
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
    body = BodyParameters(fit.kinematics, fit.outlines, groups, parts)
    poses = np.array(poses, dtype=np.float64)
    own = poses[:, ~is_shape]
    unknowns = _unknowns(fit, body, is_shape, settings)
    shape_count = int(is_shape.sum())
    names = [name for name, wanted in zip(body.names, is_shape, strict=False) if wanted]
    cameras, evidence = _of_all_cameras(frames)
    found = FramesFit(body, cameras, unknowns, noise=fit.noise).fit(
        evidence,
        np.zeros((len(frames), 0)),
        own,
        np.zeros(shape_count + len(parts)),
        settings.rounds,
        shared_information=_sides_information(names, len(parts), settings),
    )
    shape, girths = found.shared[:shape_count], found.shared[shape_count:]
    worn = ContourFit(fit.tree, with_girths(fit.outlines, np.exp(girths)[groups]), fit.noise)
    values = np.zeros(len(is_shape))
    values[is_shape] = shape
    poses[:, is_shape] = shape
    poses[:, ~is_shape] = found.own
    widths = {part: float(np.exp(girth)) for part, girth in zip(parts, girths, strict=True)}
    prior = np.eye(shape_count) / settings.length_deviation**2
    prior += _sides_information(names, 0, settings)
    information = prior + _told(worn, frames, poses, is_shape, settings)
    covariance = np.asarray(np.linalg.inv(information))
    return PersonShape(values, covariance, is_shape, widths, poses, worn.outlines)


def _unknowns(
    fit: ContourFit, body: BodyParameters, is_shape: Mask, settings: ShapeSettings
) -> Unknowns:
    """Each frame's pose, and the lengths and girths of all frames."""
    of_values = np.array(body.names[: len(is_shape)])
    return join(
        choose(
            body.names,
            of_values[~is_shape].tolist(),
            lower=fit.lower[~is_shape],
            upper=fit.upper[~is_shape],
            deviation=settings.pose_deviation,
        ),
        choose(
            body.names,
            of_values[is_shape].tolist(),
            shared=True,
            lower=fit.lower[is_shape],
            upper=fit.upper[is_shape],
            deviation=settings.length_deviation,
        ),
        choose(
            body.names,
            [name for name in body.names if name.startswith(GIRTH_PREFIX)],
            shared=True,
            lower=-_WIDEST,
            upper=_WIDEST,
            deviation=settings.girth_deviation,
        ),
    )


def _of_all_cameras(
    frames: Sequence[tuple[Sequence[Camera], Sequence[EdgePoints]]],
) -> tuple[list[Camera], list[Evidence]]:
    """All cameras that have a picture in some frame, and what each frame's say."""
    known = {camera.name: camera for cameras, _ in frames for camera in cameras}
    evidence = []
    for cameras, edges in frames:
        seen = {camera.name: edge for camera, edge in zip(cameras, edges, strict=True)}
        evidence.append(pack_evidence([seen.get(name, NO_EDGE) for name in known]))
    return list(known.values()), evidence


def _sides_information(names: Sequence[str], girths: int, settings: ShapeSettings) -> Array:
    """The information about lengths, and after them girths: left and right are alike."""
    information = np.zeros((len(names) + girths, len(names) + girths))
    for k, name in enumerate(names):
        other = name.replace("left_", "right_", 1)
        if name.startswith("left_") and other in names:
            row = np.zeros(len(information))
            row[k], row[list(names).index(other)] = 1.0, -1.0
            information += np.outer(row, row) / settings.side_deviation**2
    return information


def _told(
    fit: ContourFit,
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
        compared = fit.compare(cameras, edges, pose, settings.rounds[-1])
        H = pose_uncertainty(fit, compared).information
        cross = H[np.ix_(own, is_shape)]
        follow = np.linalg.solve(H[np.ix_(own, own)] + apriori, cross)
        told += (H[np.ix_(is_shape, is_shape)] - cross.T @ follow) / len(frames)
    return told


def shape_parts(tree: PoseTree) -> tuple[list[str], list[int]]:
    """The parts that have a girth, and which of them each node belongs to."""
    names = [
        node.name.removeprefix("left_").removeprefix("right_").removesuffix("_end")
        for node in tree.nodes
    ]
    parts = list(dict.fromkeys(names))
    return parts, [parts.index(name) for name in names]


def shape_noise() -> Noise:
    """What a point of contour is worth where the model is only like the person."""
    return Noise(deviation=0.02, correlation=0.15)
