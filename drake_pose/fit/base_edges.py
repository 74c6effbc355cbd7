"""Turn a camera about a robot's first joint to where the base fits its edges in pictures.

The first joint's offset turns all moving parts about an axis that is fixed in the world. Moving
parts alone therefore do not separate that offset from a rotation of the camera about the axis; a
static base does. No picture shows the background behind a base, so foreground log-odds hardly
locate it. Its edges do: those of its outline, and those inside, where its surface bends.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera, pose_matrix
from drake_pose.compiled import compiled
from drake_pose.silhouette.outline import EMPTY_OUTLINE, Outline
from drake_pose.silhouette.scoring import draw_mask


class BaseSettings(NamedTuple):
    """Parameters of a search of the base; chosen on 15 simulated rooms with three arms."""

    # within, step: bound and step of the angles at which the base is drawn [rad].
    within: float = 0.45
    step: float = 0.0436
    fine_step: float = 0.00291  # Step of the angles that are compared [rad].
    # Maximum side of the picture's part around the base; a larger part is reduced [pixel].
    most_pixels: int = 240
    # A pixel counts if moving parts cover it in at most this fraction of pictures.
    most_covered: float = 0.7
    # Minimum number of visible edge points; points are a third of a pixel apart.
    least_points: int = 120
    noise: float = 2.0  # Gradient of an edge that is as likely noise [of 255 per pixel].
    # Number of tiles along each side of the picture's part around the base. The tiles' errors are
    # taken as independent.
    tiles: int = 8
    resamples: int = 200  # Number of bootstrap samples of the tiles.
    # Tried errors of the base's place in the picture, along u and along v [pixel].
    shifts: tuple[float, ...] = (-0.6, -0.3, 0.0, 0.3, 0.6)
    # Is added in quadrature to the bootstrap's standard deviation [rad]. Errors in 15 rooms with
    # three arms are then 0.9 standard deviations at most.
    floor: float = 0.0035
    max_deviation: float = 0.1  # An angle with a larger standard deviation is not determined [rad].
    min_turn: float = 0.0175  # A camera is not turned by smaller angles [rad].


BASE = BaseSettings()


class _Edges(NamedTuple):
    """Points on edges of a drawn base.

    points: (n, 2) places (u, v) [pixel]. normals: (n, 2) unit vectors across the edges. motions:
    (n,) derivative of the edge's place along its normal by the base's rotation [pixel/rad]. smooth:
    (h, w) pixels on the base and off its edges.
    """

    points: Array
    normals: Array
    motions: Array
    smooth: Mask


class _Slopes(NamedTuple):
    """Gradients of a base's picture.

    across, along: (h, w, 3) along u and along v [of 255 per pixel]. seen: (h, w) pixels that moving
    parts leave visible in enough pictures. tiles: (h, w) index of each pixel's tile.
    """

    across: Floats
    along: Floats
    seen: Mask
    tiles: Array


def joint_rotation(kinematics: TreeKinematics, values: Array, joint: int, angle: float) -> Array:
    """Return the transform (4, 4) of the world that turns by an angle [rad] about a joint's axis.

    values: (m,) of the pose tree. joint: index of the joint's value.
    """
    twist = kinematics.motions(values).twists[joint]
    omega = twist[:3] / np.linalg.norm(twist[:3])
    place = np.cross(omega, twist[3:6])
    R = Rotation.from_rotvec(angle * omega).as_matrix()
    return pose_matrix(R, place - R @ place)


def locate_base(
    kinematics: TreeKinematics,
    outlines: Sequence[Outline],
    camera: PinholeCamera,
    pictures: Sequence[Picture],
    values: Array,
    joint: int,
) -> tuple[float, float]:
    """Return the angle about a joint's axis by which the base is turned against the camera's pose.

    Edges of the drawn base are compared with edges of the pictures' median, without pixels that
    moving parts cover. A bootstrap of tiles of the picture gives the standard deviation. It
    includes other angles at which the base fits about as well.

    Args:
        kinematics: of the body's pose tree.
        outlines: a surface for each node.
        camera: the camera at its pose.
        pictures: f pictures (H, W, 3).
        values: (f, m) the tree's values in the pictures.
        joint: index of the first joint's value.

    Returns the angle by which the world turns in the camera, see ``joint_rotation``, and its
    standard deviation [rad]; 0 and infinity where too little of the base is visible.
    """
    motions = kinematics.motions(values[0])
    moves, twist = motions.moves[:, joint], motions.twists[joint]
    nodes = list(zip(outlines, moves, strict=True))
    base = [EMPTY_OUTLINE if is_moved else outline for outline, is_moved in nodes]
    moving = [outline if is_moved else EMPTY_OUTLINE for outline, is_moved in nodes]
    X_WN = kinematics.poses(values[0])

    def turned(angle: float) -> Array:
        """Return the pose (4, 4) of the turned world in the camera."""
        return np.asarray(camera.X_CW @ joint_rotation(kinematics, values[0], joint, angle))

    angles = np.arange(-BASE.within, BASE.within, BASE.step)
    bounds = angles[0], 0.0, angles[-1]
    cropped = _cropped(base, [turned(angle) @ X_WN for angle in bounds], camera, pictures)
    if cropped is None:
        return 0.0, np.inf
    camera, shown = cropped
    slopes = _median_slopes(kinematics, moving, camera, shown, values)

    def drawn(angle: float) -> _Edges:
        """Return the base's edges at an angle."""
        return _drawn_edges(base, turned(angle) @ X_WN, camera, turned(angle), twist)

    # The score is the mean log gradient on the base's edges over that on its smooth surface.
    steepest = np.hypot(slopes.across, slopes.along).max(axis=2)
    logs, count = np.log1p(steepest / BASE.noise), BASE.tiles**2
    steps = np.arange(-0.5 * BASE.step, 0.5 * BASE.step, 3.0 * BASE.fine_step)
    candidates = (angles[:, None] + steps).ravel()
    totals = np.zeros((4, len(angles), len(steps), count))
    for k, drawn_at in enumerate(angles.tolist()):
        edges = drawn(drawn_at)
        smooth = edges.smooth & slopes.seen
        totals[0, k], totals[1, k] = _strengths(edges, slopes, steps)
        totals[2, k] = np.bincount(slopes.tiles[smooth], logs[smooth], count)
        totals[3, k] = np.bincount(slopes.tiles[smooth], minlength=count)
    sums = totals.reshape(4, -1, count)
    points = sums[1].sum(axis=1)
    enough = points > max(BASE.least_points, 0.3 * points.max())
    if not enough.any():
        return 0.0, np.inf
    resampled = np.random.default_rng(0).multinomial(
        count, np.full(count, 1.0 / count), BASE.resamples
    )
    weights = np.vstack([np.ones(count), resampled]).T
    edge, edge_count, inner, inner_count = sums[:, enough] @ weights
    scores = edge / np.maximum(edge_count, 1.0) - inner / np.maximum(inner_count, 1.0)
    angle, *likely = candidates[enough][np.argmax(scores, axis=0)].tolist()
    # Half the width of the interval that holds 95 % of the samples, if others are among them.
    wide = float(np.quantile(np.abs(np.array(likely) - angle), 0.95))
    variance = (wide / 1.96) ** 2 if wide > 2.0 * BASE.step else 0.0
    # Angles near the best are compared more exactly, with the base shifted a little.
    steps = np.arange(-1.5 * BASE.step, 1.5 * BASE.step, BASE.fine_step)
    shifts = np.array([[a, b] for a in BASE.shifts for b in BASE.shifts])
    for _ in range(2):
        edges = drawn(angle)
        shifted = (edges._replace(points=edges.points + shift) for shift in shifts)
        fine_scores = [_strengths(drawing, slopes, steps)[0] @ weights for drawing in shifted]
        best = steps[np.argmax(np.max(fine_scores, axis=0), axis=0)]
        angle += float(best[0])
    variance += float(np.var(best[1:])) + BASE.floor**2
    return angle, float(np.sqrt(variance))


def _cropped(
    outlines: Sequence[Outline],
    poses: Sequence[Array],
    camera: PinholeCamera,
    pictures: Sequence[Picture],
    margin: int = 8,
) -> tuple[PinholeCamera, Floats] | None:
    """Return the camera of the pictures' part around surfaces, and the f parts (f, h, w, 3).

    h and w are reduced to `BASE.most_pixels` at most. None: the surfaces are hardly visible.

    Args:
        outlines: a surface for each node.
        poses: several times the nodes' poses (nodes, 4, 4) in the camera; the part shows all.
        camera: its intrinsics; its pose stays.
        pictures: f pictures (H, W, 3).
        margin: around the surfaces [pixel].
    """
    points = np.concatenate(
        [
            outline.vertices @ X[:3, :3].T + X[:3, 3]
            for X_CN in poses
            for outline, X in zip(outlines, X_CN, strict=True)
        ]
    )
    uv, depth = camera.with_pose(np.eye(4)).project(points)
    uv, size = uv[depth > camera.near], np.array([camera.width, camera.height])
    if not len(uv):
        return None
    left, top = np.clip(np.floor(uv.min(axis=0)) - margin, 0, size).astype(int).tolist()
    right, bottom = np.clip(np.ceil(uv.max(axis=0)) + margin, 0, size).astype(int).tolist()
    width, height = right - left, bottom - top
    if min(width, height) <= 2 * margin:
        return None
    center = {"center_x": camera.center_x - left, "center_y": camera.center_y - top}
    scale = min(1.0, BASE.most_pixels / max(width, height))
    reduced = max(1, round(scale * width)), max(1, round(scale * height))
    small = replace(camera, width=width, height=height, **center).resized(*reduced)
    parts = (np.asarray(one[top:bottom, left:right], np.float32) for one in pictures)
    return small, np.array([cv2.resize(p, reduced, interpolation=cv2.INTER_AREA) for p in parts])


def _median_slopes(
    kinematics: TreeKinematics,
    moving: Sequence[Outline],
    camera: PinholeCamera,
    pictures: Floats,
    values: Array,
) -> _Slopes:
    """Return the gradients of the median picture.

    The arguments are those of `locate_base`. moving: surfaces of the nodes that the joint moves,
    empty for others. pictures: (f, h, w, 3) of the camera's size.
    """
    kernel = np.ones((9, 9), np.uint8)
    masks = (draw_mask(moving, camera.X_CW @ kinematics.poses(row), camera) for row in values)
    dilated = [cv2.dilate(mask.astype(np.uint8), kernel) for mask in masks]
    covered = np.array(dilated).astype(np.bool_)
    # A pixel that is covered too often does not count: its median may have any value.
    seen, shown = covered.mean(axis=0) <= BASE.most_covered, pictures.copy()
    shown[covered & seen] = np.nan
    median = cv2.GaussianBlur(np.nanmedian(shown, axis=0), (0, 0), 0.7)
    across, along = (
        np.asarray(cv2.Sobel(median, cv2.CV_32F, *orders, scale=0.125), np.float32)
        for orders in ((1, 0), (0, 1))
    )
    rows, columns = np.mgrid[: camera.height, : camera.width]
    tiles = rows * BASE.tiles // camera.height * BASE.tiles + columns * BASE.tiles // camera.width
    return _Slopes(across, along, seen, tiles)


@compiled
def draw_normals(corners: Array, nearness: Array, normals: Array, picture: Floats) -> None:
    """Draw triangles' normals, nearer ones in front of others.

    Args:
        corners: (n, 3, 2) corners of the triangles [pixel].
        nearness: (n, 3) the corners' inverse depths [1/m].
        normals: (n, 3) unit normals.
        picture: (h, w, 4) output: normals, and inverse depths [1/m]; 0 where nothing is drawn.
    """
    height, width = picture.shape[:2]
    for k in range(len(corners)):
        (ua, va), (ub, vb), (uc, vc) = corners[k, 0], corners[k, 1], corners[k, 2]
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
        if area == 0.0:
            continue
        first, last = max(0, math.ceil(min(ua, ub, uc))), min(width - 1, int(max(ua, ub, uc)))
        for v in range(
            max(0, math.ceil(min(va, vb, vc))), min(height - 1, int(max(va, vb, vc))) + 1
        ):
            for u in range(first, last + 1):
                b = ((u - ua) * (vc - va) - (uc - ua) * (v - va)) / area
                c = ((ub - ua) * (v - va) - (u - ua) * (vb - va)) / area
                if b < 0.0 or c < 0.0 or b + c > 1.0:
                    continue
                near = nearness[k, 0] * (1.0 - b - c) + nearness[k, 1] * b + nearness[k, 2] * c
                if near > picture[v, u, 3]:
                    picture[v, u, 3] = near
                    picture[v, u, 0] = normals[k, 0]
                    picture[v, u, 1] = normals[k, 1]
                    picture[v, u, 2] = normals[k, 2]


def _drawn_edges(
    outlines: Sequence[Outline],
    X_CN: Array,
    camera: PinholeCamera,
    X_CW: Array,
    twist: Array,
    scale: int = 3,
) -> _Edges:
    """Return edges where the normals of drawn surfaces change.

    Args:
        outlines: a surface for each node.
        X_CN: (nodes, 4, 4) the nodes' poses in the camera.
        camera: its intrinsics; its pose is not used.
        X_CW: (4, 4) the world's pose in the camera.
        twist: (6,) rotation vector and translation [m] of the world for 1 rad about the joint.
        scale: size of the drawing over that of the picture.
    """
    surfaces = zip(outlines, X_CN, strict=True)
    corners = np.concatenate(
        [(surface.vertices @ X[:3, :3].T + X[:3, 3])[surface.triangles] for surface, X in surfaces]
    )
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    drawn = (lengths > 0.0) & (corners[..., 2] > camera.near).all(axis=1)
    corners, normals = corners[drawn], normals[drawn] / lengths[drawn, None]
    normals *= -np.sign((normals * corners.mean(axis=1)).sum(axis=1))[:, None]
    focal = np.array([camera.focal_x, camera.focal_y])
    centre = np.array([camera.center_x, camera.center_y])
    uv = corners[..., :2] / corners[..., 2:] * focal + centre
    picture = np.zeros((scale * camera.height, scale * camera.width, 4), np.float32)
    draw_normals((uv + 0.5) * scale - 0.5, 1.0 / corners[..., 2], normals, picture)
    blurred = cv2.GaussianBlur(picture[..., :3], (0, 0), 0.7 * scale)
    gu, gv = (cv2.Sobel(blurred, cv2.CV_32F, *orders) for orders in ((1, 0), (0, 1)))
    a, b, c = (product.sum(axis=2) for product in (gu * gu, gu * gv, gv * gv))
    strength = np.sqrt(0.5 * (a + c) + np.sqrt(0.25 * (a - c) ** 2 + b * b))
    angle = 0.5 * np.arctan2(2.0 * b, a - c)
    across = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)
    rows, columns = np.mgrid[: strength.shape[0], : strength.shape[1]].astype(np.float32)
    before, after = (
        cv2.remap(
            strength,
            columns + step * across[..., 0],
            rows + step * across[..., 1],
            cv2.INTER_LINEAR,
        )
        for step in (-1.0, 1.0)
    )
    strong = strength[strength > 1e-3]
    least = 0.25 * float(np.percentile(strong, 95.0)) if len(strong) else np.inf
    rough = ((strength > 0.5 * least) | (picture[..., 3] == 0.0)).astype(np.float32)
    smooth = cv2.resize(rough, (camera.width, camera.height), interpolation=cv2.INTER_AREA) < 0.01
    v, u = np.nonzero((strength >= after) & (strength > before) & (strength > least))
    bend = before[v, u] - 2.0 * strength[v, u] + after[v, u]
    peak = np.clip(0.5 * (before[v, u] - after[v, u]) / np.minimum(bend, -1e-9), -1.0, 1.0)
    # An edge belongs to the nearer of two surfaces.
    nearness = cv2.dilate(picture[..., 3], np.ones((3, 3), np.uint8))[v, u].astype(float)
    known = nearness > 0.0
    z, edge_normals = 1.0 / nearness[known], across[v, u][known].astype(float)
    points = np.column_stack([u, v])[known] + peak[known, None] * edge_normals
    points = (points + 0.5) / scale - 0.5
    p_C = np.column_stack([(points - centre) / focal, np.ones(len(z))]) * z[:, None]
    p_W = (p_C - X_CW[:3, 3]) @ X_CW[:3, :3]
    speed = (np.cross(twist[:3], p_W) + twist[3:6]) @ X_CW[:3, :3].T
    motions = (speed[:, :2] - p_C[:, :2] * (speed[:, 2] / z)[:, None]) * focal / z[:, None]
    return _Edges(points, edge_normals, (motions * edge_normals).sum(axis=1), smooth)


def _strengths(
    edges: _Edges, slopes: _Slopes, beside: Array, reach: float = 4.0
) -> tuple[Array, Array]:
    """Return log gradients of a picture at points on a base's edges, summed over tiles.

    Args:
        edges: the drawn edges.
        slopes: the picture's gradients.
        beside: (n,) angles from that of the drawing to those that are compared [rad].
        reach: maximum motion of a point along its normal [pixel].

    Returns the sums (n, tiles), and the numbers of visible points (tiles,).
    """
    size = np.array(slopes.seen.shape[::-1])
    inside = ((edges.points > reach + 2.0) & (edges.points < size - reach - 3.0)).all(axis=1)
    if not inside.any():
        return np.zeros((len(beside), BASE.tiles**2)), np.zeros(BASE.tiles**2)
    points, normals, motions = edges.points[inside], edges.normals[inside], edges.motions[inside]
    offsets = np.arange(-reach, reach + 0.01, 0.25)
    u, v = (
        (points[:, k, None] + offsets * normals[:, k, None]).astype(np.float32) for k in range(2)
    )
    seen = cv2.remap(slopes.seen.astype(np.float32), u, v, cv2.INTER_LINEAR)
    across, along = (
        cv2.remap(slope, u, v, cv2.INTER_LINEAR) * np.float32(normals[:, None, k, None])
        for k, slope in enumerate((slopes.across, slopes.along))
    )
    counted = (seen > 0.9).all(axis=1)
    logs = np.log1p(np.abs(across + along).max(axis=2)[counted] / BASE.noise)
    index = np.clip((motions[counted, None] * beside + reach) / 0.25, 0.0, len(offsets) - 1.001)
    k, rows = index.astype(int), np.arange(len(index))[:, None]
    at_angles = logs[rows, k] + (index - k) * (logs[rows, k + 1] - logs[rows, k])
    column, row = (points[counted] + 0.5).astype(int).T
    in_tile = np.eye(BASE.tiles**2)[slopes.tiles[row, column]]
    return at_angles.T @ in_tile, in_tile.sum(axis=0)
