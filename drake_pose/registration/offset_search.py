"""Search joint offsets together with a camera's pose, on one level of an image pyramid.

With joints off by 20 degrees no pose alone explains the pictures. Offsets are therefore searched
from base to tip: the base and the first links determine the pose roughly, and each further link its
own joint. Scores need no derivatives and no masks, so large errors do no harm.

The first joint's offset turns all moving parts about an axis that is fixed in the world. Moving
parts alone therefore do not separate it from a rotation of the camera about that axis; a static
base does. No picture shows what is behind a base, so foreground log-odds hardly locate it. Its
edges do: those of its outline, and those inside, where its surface bends.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.compiled import compiled
from drake_pose.registration.pyramid_level import PyramidLevel
from drake_pose.silhouette.outline import EMPTY_OUTLINE, Outline
from drake_pose.silhouette.scoring import draw_mask


class BaseSettings(NamedTuple):
    """Parameters of a search of the base.

    Args:
        within, step: bound and step of the angles at which the base is drawn [rad].
        fine_step: step of the angles that are compared [rad].
        most_pixels: maximum side of the base's part of the pictures; larger ones are reduced
            [pixel].
        most_covered: a pixel counts if moving parts cover it in at most this fraction of pictures.
        least_points: minimum number of visible points of edges; they are a third of a pixel apart.
        noise: strength of an edge that is as likely noise [of 255 per pixel].
        tiles: the base's part of the pictures is divided into tiles, this many along a side. Their
            errors are taken as independent.
        resamples: number of bootstrap samples of the tiles.
        shifts: by which the base may be off in the picture, along u and along v [pixel].
        factor, floor: factor of the bootstrap's standard deviation, and what is added in
            quadrature [rad]; errors were 0.9 standard deviations at most in 15 rooms with three
            arms.
        max_deviation: an angle with a larger standard deviation is not determined [rad].
        min_turn: a camera is not turned by smaller angles [rad].
    """

    within: float = 0.45
    step: float = 0.0436
    fine_step: float = 0.00291
    most_pixels: int = 240
    most_covered: float = 0.7
    least_points: int = 120
    noise: float = 2.0
    tiles: int = 8
    resamples: int = 200
    shifts: tuple[float, ...] = (-0.6, -0.3, 0.0, 0.3, 0.6)
    factor: float = 1.0
    floor: float = 0.0035
    max_deviation: float = 0.1
    min_turn: float = 0.0175


BASE = BaseSettings()


class _Edges(NamedTuple):
    """Points on edges of a drawn base.

    points: (n, 2) [pixel]. normals: (n, 2) across the edges. motions: (n,) by which the base's
    rotation moves the edge along its normal [pixel/rad]. smooth: (h, w) pixels of the box on the
    base and off its edges.
    """

    points: Array
    normals: Array
    motions: Array
    smooth: Mask


def search_offsets(
    level: PyramidLevel,
    poses: Callable[[Array], Array],
    X_CW: Array,
    start: Array,
    joints: Sequence[int],
    *,
    sweeps: int = 2,
    within: float = 0.45,
    steps: int = 11,
    evaluations: int = 300,
    first_step: float = 0.1,
    deviation: float = 0.2,
    weight: float = 0.002,
) -> tuple[Array, Array]:
    """Improve a camera's pose and joint offsets by their score.

    Each sweep scans each joint's offset, from base to tip, and then improves all unknowns together
    by Nelder and Mead's simplex search; the first sweep does so after each joint.

    Args:
        level: the pictures.
        poses: returns the nodes' poses (f, nodes, 4, 4) in the level's f pictures from offsets
            (m,) [rad or m].
        X_CW: (4, 4) the pose from which the search starts.
        start: (m,) the offsets from which it starts [rad or m].
        joints: indices of the offsets that are searched, from base to tip; all are angles.
        sweeps: number of sweeps; 0: one simplex search alone.
        within, steps: bound and number of the scanned offsets [rad].
        evaluations: maximum number of scores of a simplex search of all unknowns.
        first_step: size of the first simplex in rotation and offsets [rad].
        deviation, weight: standard deviation of an offset [rad], and by how much the score
            falls at that offset. A joint that hardly shows stays near 0.

    Returns:
        the pose X_CW (4, 4), and the offsets (m,).
    """
    offsets = start.copy()

    def score(X: Array, tried: Array) -> float:
        prior = weight * float(((tried / deviation) ** 2).sum())
        return level.with_poses(poses(tried)).score(X) - prior

    def improve(free: Sequence[int], most: int, size: float) -> float:
        """Improve the pose and some offsets from a first simplex, and return their score."""
        nonlocal X_CW, offsets
        about, at = X_CW, offsets
        columns = size * np.array([1.0, 1.0, 1.0, 0.4, 0.4, 0.6, *np.ones(len(free))])

        def place(x: Array) -> tuple[Array, Array]:
            turned = at.copy()
            turned[list(free)] += x[6:]
            return level.moved(about, x[:6]), np.clip(turned, -within, within)

        simplex = np.vstack([0.0 * columns, np.diag(columns)])
        options = {"maxfev": most, "initial_simplex": simplex, "xatol": 0.0, "fatol": 0.0}
        found = minimize(
            lambda x: -score(*place(x)), np.zeros(len(columns)), method="Nelder-Mead",
            options=options | {"adaptive": True},
        )  # fmt: skip
        X_CW, offsets = place(found.x)
        return -float(found.fun)

    best = score(X_CW, offsets)
    for sweep in range(sweeps):
        for k, joint in enumerate(joints):
            for value in np.linspace(-within, within, steps):
                tried = offsets.copy()
                tried[joint] = value
                if (found := score(X_CW, tried)) > best:
                    best, offsets = found, tried
            if sweep == 0:
                best = improve(joints[: k + 1], evaluations // 3, first_step)
        best = improve(joints, evaluations, first_step)
    improve(joints, evaluations, -0.5 * first_step)
    return X_CW, offsets


def joints_like_cameras(kinematics: TreeKinematics, values: Array, shown: Mask) -> tuple[str, ...]:
    """Return names of joints whose offset looks like a rotation of the camera about the robot.

    Such a joint, usually the first, moves all parts that move at all, about an axis that is fixed
    in the world. Only static parts then separate its offset from the camera's pose.

    Args:
        kinematics: of the body's pose tree.
        values: (f, m) values in f frames [rad or m].
        shown: (nodes,) which nodes are visible.
    """
    motions = [kinematics.motions(one) for one in values]
    count = len(kinematics.names)
    twists = np.array([one.twists[:count] for one in motions])
    still = np.ptp(twists, axis=0).max(axis=1) < 1e-6
    moves = motions[0].moves[shown][:, :count]
    # Nodes that no value moves between the frames are static.
    changing = np.ptp(values, axis=0) > 1e-3
    moving = moves[:, changing].any(axis=1)
    return tuple(
        name
        for k, name in enumerate(kinematics.names)
        if still[k] and moving.any() and moves[moving, k].all()
    )


def joint_rotation(kinematics: TreeKinematics, values: Array, joint: int, angle: float) -> Array:
    """Return the transform (4, 4) of the world that turns by an angle [rad] about a joint's axis.

    values: (m,) of the pose tree. joint: index of the joint's value.
    """
    twist = kinematics.motions(values).twists[joint]
    omega = twist[:3] / np.linalg.norm(twist[:3])
    place = np.cross(omega, twist[3:6])
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec(angle * omega).as_matrix()
    X[:3, 3] = place - X[:3, :3] @ place
    return X


def locate_base(
    kinematics: TreeKinematics,
    outlines: Sequence[Outline],
    camera: PinholeCamera,
    pictures: Sequence[Picture],
    values: Array,
    joint: int,
) -> tuple[float, float]:
    """Return by how much the world is turned about a joint's axis where the base fits its edges.

    The edges are those of the pictures' median, without pixels that moving parts cover. A bootstrap
    of tiles of the picture tells how certain the angle is; it includes other angles at which the
    base fits about as well.

    Args:
        kinematics: of the body's pose tree.
        outlines: a surface for each node.
        camera: the camera at its pose.
        pictures: f pictures (H, W, 3).
        values: (f, m) the tree's values in these.
        joint: index of the first joint's value.

    Returns:
        the angle by which the world turns in the camera, and its standard deviation [rad]; 0 and
        infinite where too little of the base is visible.
    """
    moves = kinematics.motions(values[0]).moves[:, joint]
    base = [EMPTY_OUTLINE if own else one for one, own in zip(outlines, moves, strict=True)]
    moving = [one if own else EMPTY_OUTLINE for one, own in zip(outlines, moves, strict=True)]
    X_WN = kinematics.poses(values[0])

    def placed(angle: float) -> Array:
        """Return the nodes' poses (nodes, 4, 4) in the camera at an angle."""
        return np.asarray(camera.X_CW @ joint_rotation(kinematics, values[0], joint, angle) @ X_WN)

    angles = np.arange(-BASE.within, BASE.within, BASE.step)
    box = _box(base, [placed(one) for one in (angles[0], 0.0, angles[-1])], camera)
    if box is None:
        return 0.0, np.inf
    camera, box, parts = _reduced(camera, box, pictures)
    slopes, seen = _median_slopes(kinematics, moving, camera, parts, values, box)
    twist = kinematics.motions(values[0]).twists[joint]
    axis = twist[:3] / np.linalg.norm(twist[:3])
    about = np.cross(axis, twist[3:6])

    def drawn(angle: float) -> _Edges:
        """Return the base's edges at an angle."""
        X_CW = camera.X_CW @ joint_rotation(kinematics, values[0], joint, angle)
        turn = X_CW[:3, :3] @ axis, X_CW[:3, :3] @ about + X_CW[:3, 3]
        return _drawn_edges(base, placed(angle), camera, box, *turn)

    # Edges count by how much stronger they are than the picture is on the base beside them.
    logs = np.log1p(np.sqrt((slopes[0] ** 2 + slopes[1] ** 2).max(axis=2)) / BASE.noise)
    rows, columns = np.mgrid[: box[3], : box[2]]
    tiles = rows * BASE.tiles // box[3] * BASE.tiles + columns * BASE.tiles // box[2]
    beside = np.arange(-0.5 * BASE.step, 0.5 * BASE.step, 3.0 * BASE.fine_step)
    every = (angles[:, None] + beside).ravel()
    sums = np.zeros((4, len(every), BASE.tiles**2))
    for k, one in enumerate(angles.tolist()):
        edges, own = drawn(one), slice(k * len(beside), (k + 1) * len(beside))
        smooth = edges.smooth & seen
        sums[:2, own] = _strengths(edges, slopes, seen, box, beside)
        sums[2, own] = np.bincount(tiles[smooth], logs[smooth], BASE.tiles**2)
        sums[3, own] = np.bincount(tiles[smooth], minlength=BASE.tiles**2)
    counts = sums[1].sum(axis=1)
    enough = counts > max(BASE.least_points, 0.3 * counts.max())
    if not enough.any():
        return 0.0, np.inf
    every, sums = every[enough], sums[:, enough]
    count = BASE.tiles**2
    weights = np.random.default_rng(0).multinomial(
        count, np.full(count, 1.0 / count), BASE.resamples
    )
    weights = np.vstack([np.ones(count), weights]).T
    edge, edge_count, inner, inner_count = sums @ weights
    scores = edge / np.maximum(edge_count, 1.0) - inner / np.maximum(inner_count, 1.0)
    angle, *likely = every[np.argmax(scores, axis=0)].tolist()
    off = np.array(likely) - angle
    variance = float(np.mean(off**2 * (np.abs(off) > 2.0 * BASE.step)))
    # Angles near the best are compared more exactly, with the base shifted a little.
    beside = np.arange(-1.5 * BASE.step, 1.5 * BASE.step, BASE.fine_step)
    shifts = np.array([[a, b] for a in BASE.shifts for b in BASE.shifts])
    for _ in range(2):
        edges = drawn(angle)
        shifted = (edges._replace(points=edges.points + by) for by in shifts)
        found = [_strengths(one, slopes, seen, box, beside)[0] @ weights for one in shifted]
        best = beside[np.argmax(np.max(found, axis=0), axis=0)]
        angle += float(best[0])
    variance += BASE.factor**2 * float(np.var(best[1:])) + BASE.floor**2
    return angle, float(np.sqrt(variance))


def _box(
    outlines: Sequence[Outline], poses: Sequence[Array], camera: PinholeCamera, margin: int = 8
) -> tuple[int, int, int, int] | None:
    """Return first column and row, width and height of the part of the picture around surfaces.

    poses: (nodes, 4, 4) of the nodes in the camera, several times. None: they are not visible.
    """
    points = np.concatenate(
        [
            one.vertices @ X[:3, :3].T + X[:3, 3]
            for X_CN in poses
            for one, X in zip(outlines, X_CN, strict=True)
        ]
    )
    points = points[points[:, 2] > 0.05]
    if not len(points):
        return None
    size = np.array([camera.width, camera.height])
    uv = points[:, :2] / points[:, 2:] * [camera.focal_x, camera.focal_y]
    uv += [camera.center_x, camera.center_y]
    low = np.clip(np.floor(uv.min(axis=0)) - margin, 0, size).astype(int)
    high = np.clip(np.ceil(uv.max(axis=0)) + margin, 0, size).astype(int)
    width, height = (high - low).tolist()
    return (*low.tolist(), width, height) if min(width, height) > 2 * margin else None


def _reduced(
    camera: PinholeCamera, box: tuple[int, int, int, int], pictures: Sequence[Picture]
) -> tuple[PinholeCamera, tuple[int, int, int, int], list[Floats]]:
    """Return a camera of smaller pictures, its box, and the box's part of the pictures."""
    scale = min(1.0, BASE.most_pixels / max(box[2:]))
    small = (
        camera
        if scale == 1.0
        else camera.resized(round(scale * camera.width), round(scale * camera.height))
    )
    u, v, far_u, far_v = (int(scale * one) for one in (*box[:2], box[0] + box[2], box[1] + box[3]))
    width, height = min(far_u, small.width) - u, min(far_v, small.height) - v
    parts = []
    for one in pictures:
        size = small.width, small.height
        own = cv2.resize(one, size, interpolation=cv2.INTER_AREA) if scale < 1.0 else one
        parts.append(own[v : v + height, u : u + width].astype(np.float32))
    return small, (u, v, width, height), parts


def _median_slopes(
    kinematics: TreeKinematics,
    moving: Sequence[Outline],
    camera: PinholeCamera,
    pictures: Sequence[Floats],
    values: Array,
    box: tuple[int, int, int, int],
) -> tuple[tuple[Floats, Floats], Mask]:
    """Return the median picture's gradients along u and v, and the pixels (h, w) that count.

    The arguments are those of `locate_base`; pictures: the parts (h, w, 3) in the box.
    """
    u, v, width, height = box
    near = np.ones((9, 9), np.uint8)
    masks = (draw_mask(moving, camera.X_CW @ kinematics.poses(one), camera) for one in values)
    parts = (one[v : v + height, u : u + width].astype(np.uint8) for one in masks)
    covered = np.array([cv2.dilate(one, near) for one in parts]).astype(np.bool_)
    # Where all pictures are covered any of them will do: the pixel does not count.
    seen, shown = covered.mean(axis=0) <= BASE.most_covered, np.array(pictures)
    shown[covered & seen] = np.nan
    median = cv2.GaussianBlur(np.nanmedian(shown, axis=0), (0, 0), 0.7)
    across, along = (
        np.asarray(cv2.Sobel(median, cv2.CV_32F, *by, scale=0.125), np.float32)
        for by in ((1, 0), (0, 1))
    )
    return (across, along), seen


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
    box: tuple[int, int, int, int],
    axis: Array,
    about: Array,
    scale: int = 3,
) -> _Edges:
    """Return the edges of surfaces' drawn normals.

    Args:
        outlines: a surface for each node.
        X_CN: (nodes, 4, 4) the nodes' poses in the camera.
        camera: the camera.
        box: part of the picture that is drawn.
        axis, about: (3,) direction and a point of the rotation's axis in the camera.
        scale: the drawing has this many times the picture's size.
    """
    both = zip(outlines, X_CN, strict=True)
    corners = np.concatenate(
        [(one.vertices @ X[:3, :3].T + X[:3, 3])[one.triangles] for one, X in both]
    )
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    drawn = (lengths > 0.0) & (corners[..., 2] > 0.05).all(axis=1)
    corners, normals = corners[drawn], normals[drawn] / lengths[drawn, None]
    normals *= -np.sign((normals * corners.mean(axis=1)).sum(axis=1))[:, None]
    focal, centre = (
        np.array([camera.focal_x, camera.focal_y]), np.array([camera.center_x, camera.center_y])
    )  # fmt: skip
    uv = corners[..., :2] / corners[..., 2:] * focal + centre - box[:2]
    picture = np.zeros((scale * box[3], scale * box[2], 4), np.float32)
    draw_normals((uv + 0.5) * scale - 0.5, 1.0 / corners[..., 2], normals, picture)
    picture[..., 3] = np.where(picture[..., 3] > 0.0, 1.0 / np.maximum(picture[..., 3], 1e-9), 0.0)
    blurred = cv2.GaussianBlur(picture[..., :3], (0, 0), 0.7 * scale)
    gu, gv = (cv2.Sobel(blurred, cv2.CV_32F, *by) for by in ((1, 0), (0, 1)))
    a, b, c = (one.sum(axis=2) for one in (gu * gu, gu * gv, gv * gv))
    strength = np.sqrt(0.5 * (a + c) + np.sqrt(0.25 * (a - c) ** 2 + b * b))
    angle = 0.5 * np.arctan2(2.0 * b, a - c)
    across = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)
    rows, columns = np.mgrid[: strength.shape[0], : strength.shape[1]].astype(np.float32)
    before, after = (
        cv2.remap(
            strength, columns + by * across[..., 0], rows + by * across[..., 1], cv2.INTER_LINEAR
        )
        for by in (-1.0, 1.0)
    )
    strong = strength[strength > 1e-3]
    least = 0.25 * float(np.percentile(strong, 95.0)) if len(strong) else np.inf
    near = (strength > 0.5 * least) | (picture[..., 3] == 0.0)
    smooth = cv2.resize(near.astype(np.float32), box[2:], interpolation=cv2.INTER_AREA) < 0.01
    v, u = np.nonzero((strength >= after) & (strength > before) & (strength > least))
    bend = before[v, u] - 2.0 * strength[v, u] + after[v, u]
    by = np.clip(0.5 * (before[v, u] - after[v, u]) / np.minimum(bend, -1e-9), -1.0, 1.0)
    points = np.column_stack([u, v]) + by[:, None] * across[v, u]
    points = (points + 0.5) / scale - 0.5 + np.array(box[:2])
    # At an edge the nearer surface counts.
    depth = np.where(picture[..., 3] > 0.0, picture[..., 3], np.float32(np.inf))
    z = cv2.erode(depth.astype(np.float32), np.ones((3, 3), np.uint8))[v, u]
    known = np.isfinite(z)
    points, edge_normals, z = points[known], across[v, u][known].astype(float), z[known]
    p_C = np.column_stack([(points - centre) / focal, np.ones(len(z))]) * z[:, None]
    speed = np.cross(axis, p_C - about)
    moved = (speed[:, :2] - p_C[:, :2] * (speed[:, 2] / z)[:, None]) * focal / z[:, None]
    return _Edges(points, edge_normals, (moved * edge_normals).sum(axis=1), smooth)


def _strengths(
    edges: _Edges,
    slopes: tuple[Floats, Floats],
    seen: Mask,
    box: tuple[int, int, int, int],
    beside: Array,
    reach: float = 4.0,
) -> tuple[Array, Array]:
    """Return log strengths (n, tiles) of a picture's edges where a base's are, summed over tiles.

    Args:
        edges: the drawn edges.
        slopes: gradients along u and v in the box, each (h, w, 3).
        seen: (h, w) the pixels that count.
        box: part of the picture.
        beside: (n,) angles by which the edges turn further [rad].
        reach: they move by at most this along their normals [pixel].

    Returns:
        the sums, and the numbers of points (n, tiles).
    """
    shape = np.array([box[3], box[2]])
    at = edges.points - box[:2]
    inside = ((at > reach + 2.0) & (at < shape[::-1] - reach - 3.0)).all(axis=1)
    at, normals, motions = (one[inside] for one in (at, edges.normals, edges.motions))
    offsets = np.arange(-reach, reach + 0.01, 0.25)
    u, v = ((at[:, k, None] + offsets * normals[:, k, None]).astype(np.float32) for k in range(2))
    counted = (cv2.remap(seen.astype(np.float32), u, v, cv2.INTER_LINEAR) > 0.9).all(axis=1)
    across, along = (cv2.remap(one, u, v, cv2.INTER_LINEAR) for one in slopes)
    strength = np.abs(
        across * normals[:, None, :1].astype(np.float32)
        + along * normals[:, None, 1:].astype(np.float32)
    ).max(axis=2)
    logs = np.log1p(strength / np.float32(BASE.noise))[counted]
    place = np.clip((motions[counted, None] * beside + reach) / 0.25, 0.0, len(offsets) - 1.001)
    k, rows = place.astype(int), np.arange(len(place))[:, None]
    own = logs[rows, k] + (place - k) * (logs[rows, k + 1] - logs[rows, k])
    tile = (at[counted] * BASE.tiles / shape[::-1]).astype(int)
    number = tile[:, 1] * BASE.tiles + tile[:, 0]
    order = np.argsort(number, kind="stable")
    first = np.flatnonzero(np.diff(number[order], prepend=-1))
    sums = np.zeros((len(beside), BASE.tiles**2))
    if len(first):
        sums[:, number[order][first]] = np.add.reduceat(own[order], first, axis=0).T
    counts = np.bincount(number, minlength=BASE.tiles**2).astype(float)
    return sums, np.tile(counts, (len(beside), 1))
