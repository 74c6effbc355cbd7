"""Recognition of the registered pose, which mends a lost track (Date et al., section 5).

Each camera's contour is compared with templates from all sides; all must be of one heading.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.camera.models import Camera
from drake_pose.person.date.skeleton import Skeleton
from drake_pose.person.rays import triangulate

DIRECTIONS = 72
"""In how many directions a contour is measured."""


@dataclass(frozen=True, eq=False)
class Contour:
    """The outer contour of a person in one picture.

    Args:
        shape: (DIRECTIONS,) distance of the farthest contour point in each direction from the
            region's middle, counterclockwise from the right, over the square root of the area.
        middle: (2,) of the bounding box [pixel].
    """

    shape: Array
    middle: Array


def measure_contour(region: Mask) -> Contour | None:
    """The contour of a region (H, W); None where nobody is seen, or it touches the edge."""
    edges = (region[0], region[-1], region[:, 0], region[:, -1])
    if not region.any() or any(edge.any() for edge in edges):
        return None
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    corner = np.array([columns[0], rows[0]], dtype=np.float64)
    picture = region[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].astype(np.uint8)
    moments = cv2.moments(picture, binaryImage=True)
    area = moments["m00"]
    contours, _ = cv2.findContours(picture, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    points = np.concatenate([contour.reshape(-1, 2) for contour in contours]).astype(np.float64)
    off = points - [moments["m10"] / area, moments["m01"] / area]
    angle = np.arctan2(-off[:, 1], off[:, 0])
    place = np.floor(angle / (2.0 * np.pi) * DIRECTIONS).astype(np.int64) % DIRECTIONS
    reach = np.zeros(DIRECTIONS)
    np.maximum.at(reach, place, np.linalg.norm(off, axis=1))
    middle = corner + 0.5 * (points.min(axis=0) + points.max(axis=0))
    # A contour thinner than a direction leaves gaps.
    known = np.flatnonzero(reach)
    filled = np.interp(np.arange(DIRECTIONS), known, reach[known], period=DIRECTIONS)
    return Contour(filled / np.sqrt(area), middle)


def similarity(first: Array, second: Array) -> float:
    """How alike two contour shapes (DIRECTIONS,) are: 1 for equal ones, 0 for nothing in common."""
    return float(1.0 - np.abs(first - second).sum() / np.maximum(first, second).sum())


@dataclass(frozen=True, eq=False)
class RegisteredPose:
    """The pose that is recognised, as every camera sees it.

    Args:
        q: (nq,) positions of the registered pose where the person was for the templates.
        heading_position: where the head's turn about the vertical stands in q.
        headings: (n,) the headings of the templates [rad].
        shapes, middles: by camera: (n, DIRECTIONS) contour shapes, and (n, 2) middles of the
            bounding box [pixel]; nan where the camera saw none whole.
    """

    q: Array
    heading_position: int
    headings: Array
    shapes: Mapping[str, Array]
    middles: Mapping[str, Array]


@dataclass(frozen=True, eq=False)
class Recognition:
    """The registered pose, recognised: positions (nq,), mean similarity (0 to 1) of cameras."""

    q: Array
    similarity: float
    cameras: int


def registered_positions(skeleton: Skeleton, spread_deg: float = 80.0) -> Array:
    """Positions (nq,) of the paper's registered pose: upright, both arms spread by degrees."""
    q = np.zeros(len(skeleton.lower))
    for name, sign in (("left_arm", 1.0), ("right_arm", -1.0)):
        q[skeleton.limbs[name].positions[1]] = sign * math.radians(spread_deg)
    return skeleton.clip(q)


def stand_registered(
    skeleton: Skeleton, cameras: Sequence[Camera], middles: Sequence[Array]
) -> Array:
    """Positions (nq,) of the registered pose, below boxes' middles (2,) [pixel] in cameras."""
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
    """Makes the templates of a pose q (nq,), about where it is shown; `draw` gives masks."""
    index = int(skeleton.head_angles[0])
    turns = np.arange(heading_count) * 2.0 * np.pi / heading_count
    headings = np.array([math.remainder(turn, 2.0 * math.pi) for turn in turns])
    shapes = {one.name: np.full((heading_count, DIRECTIONS), np.nan) for one in cameras}
    middles = {one.name: np.full((heading_count, 2), np.nan) for one in cameras}
    for camera in cameras:
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
    """Whether the person stands in the registered pose now, and where; None: not so.

    Args:
        registered: from register_pose, for these cameras.
        contours: in each camera's picture; None where it is not seen whole; two are needed.
        threshold: mean similarity that is needed.
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
