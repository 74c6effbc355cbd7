"""Search joint offsets together with a camera's pose, on one level of an image pyramid.

With joints off by 20 degrees no pose alone explains the pictures. Offsets are therefore searched
from base to tip: the base and the first links determine the pose roughly, and each further link its
own joint. Scores need no derivatives and no masks, so large errors do no harm.

The first joint's offset turns all moving parts about an axis that is fixed in the world. Moving
parts alone therefore do not separate it from a rotation of the camera about that axis; a static
base does. Fits on foreground log-odds converge to it from ten degrees or less, since masks of
static parts follow the assumed pose. A scan of the base's outline has no such limit.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.registration.pyramid_level import PyramidLevel
from drake_pose.silhouette.outline import EMPTY_OUTLINE, Outline
from drake_pose.silhouette.scoring import draw_mask


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


def scan_base(
    kinematics: TreeKinematics,
    outlines: Sequence[Outline],
    camera: PinholeCamera,
    pictures: Sequence[Picture],
    values: Array,
    joint: int,
    angles: Array,
    *,
    least_length: float = 40.0,
    most_covered: float = 0.7,
) -> Array:
    """Return how strong edges are along the outline of the base at rotations of the camera.

    The edges are those of the pictures' median, without pixels that moving parts cover.

    Args:
        kinematics: of the body's pose tree.
        outlines: a surface for each node.
        camera: the camera at its pose.
        pictures: f pictures (H, W, 3).
        values: (f, m) the tree's values in these.
        joint: index of the first joint's value.
        angles: (n,) by which the world turns about the joint's axis in the camera [rad].
        least_length: minimum length of the outline that is visible [pixel].
        most_covered: a pixel counts if moving parts cover it in at most this fraction of pictures.

    Returns:
        (n,) mean logarithms of the edges' strengths; NaN where too little of the base is visible.
    """
    moves = kinematics.motions(values[0]).moves[:, joint]
    base, moving = (
        [one if own else EMPTY_OUTLINE for one, own in zip(outlines, chosen, strict=True)]
        for chosen in (~moves, moves)
    )
    X_WN, scores = kinematics.poses(values[0]), np.full(len(angles), np.nan)
    lines = [
        _outline_points(base, camera, X_WN, joint_rotation(kinematics, values[0], joint, angle))
        for angle in angles.tolist()
    ]
    every = np.concatenate(lines)
    if not len(every):
        return scores
    # Only the part of the picture around the base is needed.
    low = np.maximum(every[:, :2].min(axis=0).astype(int) - 6, 0)
    high = np.minimum(every[:, :2].max(axis=0).astype(int) + 8, [camera.width, camera.height])
    part = slice(low[1], high[1]), slice(low[0], high[0])
    shown = np.array([one[part] for one in pictures], np.float32)
    near = np.ones((9, 9), np.uint8)
    covered = np.array(
        [
            cv2.dilate(
                draw_mask(moving, camera.X_CW @ kinematics.poses(one), camera)[part].astype(
                    np.uint8
                ),
                near,
            )
            for one in values
        ]
    ).astype(np.bool_)
    # Where all pictures are covered any of them will do: the pixel does not count.
    seen = covered.mean(axis=0) <= most_covered
    shown[covered & seen] = np.nan
    median = cv2.GaussianBlur(np.nanmedian(shown, axis=0), (0, 0), 1.0)
    slopes = [cv2.Sobel(median, cv2.CV_32F, *by, scale=0.125) for by in ((1, 0), (0, 1))]
    for k, line in enumerate(lines):
        u, v = (line[None, :, :2] - low).astype(np.float32).transpose(2, 0, 1)
        across, along = (cv2.remap(one, u, v, cv2.INTER_LINEAR)[0] for one in slopes)
        counted = cv2.remap(seen.astype(np.float32), u, v, cv2.INTER_LINEAR)[0] > 0.9
        # Points are half a pixel apart.
        if np.count_nonzero(counted) > 2.0 * least_length:
            strength = np.abs(across * line[:, 2:3] + along * line[:, 3:4]).max(axis=1)
            scores[k] = float(np.log1p(0.5 * strength[counted]).mean())
    return scores


def find_base_rotation(
    angles: Array, scores: Array, *, near: float = np.radians(3.0), much_better: float = 1.05
) -> float:
    """Return the angle [rad] at which a base's outline fits best; 0 unless it fits clearly better.

    Args:
        angles, scores: (n,) as of `scan_base`.
        near: angles within this of 0 are taken as 0: fits converge from there [rad].
        much_better: minimum ratio of the best score to the best one near 0.
    """
    known = np.isfinite(scores)
    close = known & (np.abs(angles) <= near)
    if not close.any():
        return 0.0
    k = int(np.nanargmax(scores))
    return float(angles[k]) if scores[k] > much_better * scores[close].max() else 0.0


def _outline_points(
    outlines: Sequence[Outline], camera: PinholeCamera, X_WN: Array, X_WW: Array, across: int = 5
) -> Array:
    """Return points (n, 2) of a drawn outline [pixel] and its normals (n, 2), half a pixel apart.

    Args:
        outlines: a surface for each node.
        camera: the camera at its pose.
        X_WN: (nodes, 4, 4) the nodes' poses.
        X_WW: (4, 4) transform of the world before the camera.
        across: normals are those of chords over twice as many points.
    """
    large = camera.resized(2 * camera.width, 2 * camera.height)
    mask = draw_mask(outlines, camera.X_CW @ X_WW @ X_WN, large).astype(np.uint8)
    found = [np.zeros((0, 4))]
    for contour in cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        points = contour[:, 0].astype(np.float64)
        if len(points) < 8 * across:
            continue
        chord = np.roll(points, -across, axis=0) - np.roll(points, across, axis=0)
        normals = np.column_stack([chord[:, 1], -chord[:, 0]])
        normals /= np.maximum(np.linalg.norm(chord, axis=1), 1.0)[:, None]
        smooth = np.mean([np.roll(points, by, axis=0) for by in range(-2, 3)], axis=0)
        found.append(np.hstack([(smooth + 0.5) / 2.0 - 0.5, normals]))
    every = np.concatenate(found)
    # The picture's border is no outline.
    size = np.array([camera.width, camera.height])
    return every[((every[:, :2] > 3.0) & (every[:, :2] < size - 4.0)).all(axis=1)]
