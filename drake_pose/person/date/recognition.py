"""Recognition of the registered pose, which mends a lost track (Date et al., section 5).

Every camera compares its contour with templates of the registered pose as seen from all sides. The
person may face anywhere, but the cameras must agree on where: their templates are of one heading.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.person.date.recognition import DIRECTIONS, Contour, measure_contour, similarity
from drake_pose.person.date.skeleton import Skeleton
from drake_pose.person.rays import triangulate

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class RegisteredPose:
    """The pose that is recognised, as every camera sees it.

    Args:
        q: (nq,) positions of the registered pose where the person was for the templates.
        heading_position: where the head's turn about the vertical stands in q.
        headings: (n,) the headings of the templates [rad].
        shapes: by camera: (n, DIRECTIONS) contour shapes; nan where the camera saw none whole.
        middles: by camera: (n, 2) middle of the person's bounding box [pixel]; nan likewise.
    """

    q: Array
    heading_position: int
    headings: Array
    shapes: Mapping[str, Array]
    middles: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class Recognition:
    """The registered pose, recognised.

    Args:
        q: (nq,) the person's positions.
        similarity: mean over the cameras, 0 to 1.
        cameras: how many had a say.
    """

    q: Array
    similarity: float
    cameras: int


def registered_positions(skeleton: Skeleton, spread_deg: float = 80.0) -> Array:
    """Positions (nq,) of the paper's registered pose: upright, both arms spread.

    Args:
        skeleton: the person.
        spread_deg: how far the arms are raised sideways from hanging [deg].
    """
    q = np.zeros(len(skeleton.lower))
    for name, sign in (("left_arm", 1.0), ("right_arm", -1.0)):
        q[skeleton.limbs[name].positions[1]] = sign * math.radians(spread_deg)
    return skeleton.clip(q)


def stand_registered(
    skeleton: Skeleton, cameras: Sequence[Camera], middles: Sequence[Array]
) -> Array:
    """Positions (nq,) of the registered pose, about where the cameras see somebody.

    Args:
        skeleton: the person.
        cameras: two or more.
        middles: (2,) middle of the person's bounding box in each camera's picture [pixel].
    """
    q = registered_positions(skeleton)
    head, _, _, left_foot, right_foot = skeleton.features(q)
    middle = 0.5 * head + 0.25 * (left_foot + right_foot)
    q[skeleton.head_positions] += triangulate(cameras, middles) - middle
    return q


def register_pose(
    skeleton: Skeleton,
    q: Array,
    cameras: Sequence[Camera],
    draw: Callable[[Camera, Array], Mask],
    heading_count: int = 36,
) -> RegisteredPose:
    """Makes the templates of a pose.

    Args:
        skeleton: the person.
        q: (nq,) the pose, standing where it will be shown (roughly: only shapes are compared).
        cameras: the cameras.
        draw: the mask (H, W) that a camera sees at given positions.
        heading_count: how many headings there are templates of.
    """
    index = int(skeleton.head_angles[0])
    headings = np.arange(heading_count) * 2.0 * np.pi / heading_count
    headings = np.array([math.remainder(heading, 2.0 * math.pi) for heading in headings])
    shapes, middles = {}, {}
    for camera in cameras:
        shapes[camera.name] = np.full((heading_count, DIRECTIONS), np.nan)
        middles[camera.name] = np.full((heading_count, 2), np.nan)
        for k, heading in enumerate(headings):
            turned = np.array(q)
            turned[index] = heading
            contour = measure_contour(draw(camera, turned))
            if contour is not None:
                shapes[camera.name][k] = contour.shape
                middles[camera.name][k] = contour.middle
    return RegisteredPose(np.array(q), index, headings, shapes, middles)


def recognise(
    skeleton: Skeleton,
    registered: RegisteredPose,
    cameras: Sequence[Camera],
    contours: Sequence[Contour | None],
    threshold: float = 0.9,
) -> Recognition | None:
    """Whether the person stands in the registered pose now, and where.

    Args:
        skeleton: the person.
        registered: from register_pose, for these cameras.
        cameras: the cameras.
        contours: the person's in each camera's picture; None where it is not seen whole.
        threshold: mean similarity that is needed.

    Returns:
        The positions; None where the contours differ too much or fewer than two cameras see the
        person whole.
    """
    scores, seers, middles = [], [], []
    for camera, contour in zip(cameras, contours, strict=True):
        if contour is not None and camera.name in registered.shapes:
            templates = registered.shapes[camera.name]
            scores.append([similarity(contour.shape, template) for template in templates])
            seers.append(camera)
            middles.append(contour.middle)
    if len(seers) < 2:
        return None
    means = np.nan_to_num(np.array(scores)).mean(axis=0)
    best = int(np.argmax(means))
    if means[best] < threshold:
        return None
    q = np.array(registered.q)
    q[registered.heading_position] = _refined_heading(registered.headings, means, best)
    templates_middles = [registered.middles[camera.name][best] for camera in seers]
    q[skeleton.head_positions] += triangulate(seers, middles) - triangulate(
        seers, templates_middles
    )
    return Recognition(skeleton.clip(q), float(means[best]), len(seers))


def _refined_heading(headings: Array, scores: Array, best: int) -> float:
    """The heading at the top of the parabola through the best template and its neighbours."""
    before, here, after = scores[best - 1], scores[best], scores[(best + 1) % len(scores)]
    bend = before - 2.0 * here + after
    shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    step = 2.0 * np.pi / len(headings)
    return math.remainder(headings[best] + shift * step, 2.0 * math.pi)
