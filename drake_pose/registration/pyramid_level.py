"""Scores of camera poses in a camera's pictures of a body, all of one size, and simplex searches.

A search goes from small pictures to larger ones, and each size is a level of an image pyramid.
"""

import copy
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.camera.models import PinholeCamera
from drake_pose.compiled import compiled
from drake_pose.fit.background import Backgrounds
from drake_pose.fit.explain_kernel import (
    Explained,
    PixelSums,
    Words,
    explain_pose,
    explain_poses,
    make_words,
)
from drake_pose.fit.judge import depth_twin, opposite_side
from drake_pose.registration.posed_frames import placed_points
from drake_pose.registration.register import uniform_rotations
from drake_pose.registration.shared_fit import SHARED
from drake_pose.silhouette.outline import Outline, PackedOutlines, pack
from drake_pose.workers import map_ordered


class ScoredPictures(NamedTuple):
    """Pictures of one size in which poses are scored.

    Attributes:
        packed, X_WN, is_static, camera, sums: as for ``explain_poses``.
        middle: (3,) the body's middle in the world [m].
        scales: (3,) numbers a [nat], b [pixel] and c of the score: gain / a + c * contours'
            strength / (outlines' length + b).
    """

    packed: PackedOutlines
    X_WN: Array
    is_static: Mask
    camera: Array
    sums: PixelSums
    middle: Array
    scales: Array

    def explain(self, X_CW: Array, side: float = 1.0, squares: int = 0) -> tuple[Array, Array]:
        """Return ``explain_poses`` of poses X_CW (n, 3, 4), with tiles (squares, squares)."""
        sums, tiles = explain_poses(
            self.packed, X_CW, self.X_WN, self.is_static, self.camera, self.sums, side, squares
        )
        return np.asarray(sums), np.asarray(tiles)


@compiled
def move_pose(X_CW: Array, middle: Array, x: Array, moved: Array) -> None:
    """Move a body in the camera's frame.

    Args:
        X_CW: (3, 4) the pose.
        middle: (3,) the body's middle in the world [m].
        x: (6,) rotation vector about the middle [rad], shift of the middle in the picture along u
            and v [focal lengths], and change of the logarithm of the middle's depth.
        moved: (3, 4) output, the moved pose X_CW.
    """
    angle = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    turn = np.eye(3)
    if angle > 0.0:
        a, b, c = x[0] / angle, x[1] / angle, x[2] / angle
        s, d = np.sin(angle), 1.0 - np.cos(angle)
        turn[0, 0], turn[0, 1], turn[0, 2] = (
            1.0 - d * (b * b + c * c),
            d * a * b - s * c,
            d * a * c + s * b,
        )
        turn[1, 0], turn[1, 1], turn[1, 2] = (
            d * a * b + s * c,
            1.0 - d * (a * a + c * c),
            d * b * c - s * a,
        )
        turn[2, 0], turn[2, 1], turn[2, 2] = (
            d * a * c - s * b,
            d * b * c + s * a,
            1.0 - d * (a * a + b * b),
        )
    p = X_CW[:, 3].copy()
    for i in range(3):
        for k in range(3):
            p[i] += X_CW[i, k] * middle[k]
            moved[i, k] = 0.0
            for j in range(3):
                moved[i, k] += turn[i, j] * X_CW[j, k]
    depth = p[2] * np.exp(x[5])
    place = (depth * (p[0] / p[2] + x[3]), depth * (p[1] / p[2] + x[4]), depth)
    for i in range(3):
        moved[i, 3] = place[i]
        for k in range(3):
            moved[i, 3] -= moved[i, k] * middle[k]


@compiled
def _cost(
    pictures: ScoredPictures,
    X_CW: Array,
    x: Array,
    moved: Array,
    X_CN: Array,
    totals: Array,
    scratch: Words,
    crossings: np.ndarray,
) -> tuple[float, np.ndarray]:
    """Return the negative score of a moved pose, and `crossings`, which may be reallocated.

    X_CW, x, moved: as for ``move_pose``. X_CN, totals, scratch, crossings: as for ``explain_pose``.
    """
    move_pose(X_CW, pictures.middle, x, moved)
    crossings = explain_pose(
        pictures.packed, moved, pictures.X_WN, pictures.is_static, pictures.camera, pictures.sums,
        X_CN, totals, np.zeros((0, 0)), 1.0, scratch, crossings,
    )  # fmt: skip
    scales = pictures.scales
    contour = totals[Explained.CONTOUR] / (totals[Explained.OUTLINE] + scales[1])
    return -(totals[Explained.GAIN] / scales[0] + scales[2] * contour), crossings


@compiled
def search_simplexes(
    pictures: ScoredPictures, X_CW: Array, corners: Array, costs: Array, evaluations: int
) -> None:
    """Search the best scores near n poses.

    The steps are Nelder and Mead's (1965), as in ``scipy.optimize.minimize``: reflection, expansion
    by 2, contraction and shrinkage by a half.

    Args:
        pictures: in which poses are scored.
        X_CW: (n, 3, 4) poses from which the coordinates `x` of ``move_pose`` are counted.
        corners: (n, 7, 6) corners of each search's first simplex; output: of its last simplex, best
            first.
        costs: (n, 7) output: the corners' negative scores, ascending.
        evaluations: maximum number of scores for each pose, at least 7.
    """
    scratch, crossings = make_words(pictures.packed, pictures.camera)
    X_CN, totals, moved = np.empty_like(pictures.X_WN), np.zeros(4), np.empty((3, 4))
    centre, tried = np.empty(6), np.empty(6)
    for n in range(X_CW.shape[0]):
        start, corner, cost_of = X_CW[n], corners[n], costs[n]
        for k in range(7):
            cost_of[k], crossings = _cost(
                pictures, start, corner[k], moved, X_CN, totals, scratch, crossings
            )
        count = 7
        while True:
            # Sort the corners by their costs, stably.
            for i in range(1, 7):
                k = i
                while k > 0 and cost_of[k] < cost_of[k - 1]:
                    cost_of[k], cost_of[k - 1] = cost_of[k - 1], cost_of[k]
                    for j in range(6):
                        corner[k, j], corner[k - 1, j] = corner[k - 1, j], corner[k, j]
                    k -= 1
            if count >= evaluations:
                break
            for i in range(6):
                centre[i] = 0.0
                for k in range(6):
                    centre[i] += corner[k, i]
                centre[i] /= 6.0
                tried[i] = 2.0 * centre[i] - corner[6, i]
            cost, crossings = _cost(pictures, start, tried, moved, X_CN, totals, scratch, crossings)
            count += 1
            # Expand, keep the reflected corner, or contract outside or inside of the simplex.
            factor = 2.0 if cost < cost_of[0] else 0.0 if cost < cost_of[5] else 0.5
            factor = factor if cost < cost_of[6] else -0.5
            limit = min(cost, cost_of[6])
            if factor == 0.0 or (factor == 2.0 and count < evaluations):
                corner[6], cost_of[6] = tried, cost
            if factor != 0.0 and count < evaluations:
                for i in range(6):
                    tried[i] = centre[i] + factor * (tried[i] - centre[i])
                cost, crossings = _cost(
                    pictures, start, tried, moved, X_CN, totals, scratch, crossings
                )
                count += 1
                if cost < limit or (cost == limit and factor == 0.5):
                    corner[6], cost_of[6] = tried, cost
                elif factor != 2.0:
                    for k in range(1, min(7, 1 + evaluations - count)):
                        for i in range(6):
                            corner[k, i] = corner[0, i] + 0.5 * (corner[k, i] - corner[0, i])
                        cost_of[k], crossings = _cost(
                            pictures, start, corner[k], moved, X_CN, totals, scratch, crossings
                        )
                        count += 1


class PictureSettings(NamedTuple):
    """Parameters of a search in pictures."""

    search_frames: int = 12  # Number of frames in a search.
    # Maximum number of triangles of a node's surface in pyramid levels up to 64 pixels wide, up to
    # 120, and in wider ones.
    triangles: tuple[int, int, int] = (12, 40, 100)
    # compare_width, background_width: width of the pictures in which poses are compared, and of
    # those in which backgrounds are estimated [pixel].
    compare_width: int = 160
    background_width: int = 320
    # First simplex of a local search in rotation, shift [focal lengths] and logarithm of the depth,
    # over its size in rotation.
    simplex: tuple[float, ...] = (1.0, 1.0, 1.0, 0.4, 0.4, 0.6)
    fitted: int = 3  # Maximum number of a search's pose hypotheses that are fitted to contours.
    contour_weight: float = 4.0  # Weight of edges along the contours beside the explained fraction.
    # Half the interval of the differences that estimate joint velocities [s].
    rate_step: float = 0.05


PICTURES = PictureSettings()


def evidence(explained: float, contour: float) -> float:
    """Return the score of a pose from `explained` and `contour` of a ``PictureFit``.

    The mean over the contours is used: a sum would favour poses with longer contours.
    """
    return explained + PICTURES.contour_weight * contour


class PyramidLevel:
    """Pictures of one size, and scores of poses in them.

    Attributes:
        camera: the camera of these pictures.
        backgrounds: estimates of the background from all pictures.

    Args:
        outlines: a surface for each node.
        camera: intrinsics of the given pictures; its pose is not used.
        pictures: f pictures (H, W, 3).
        X_WN: (f, nodes, 4, 4) the nodes' poses.
        width: width of this level's pictures [pixel]; at most that of the given ones.
    """

    def __init__(
        self,
        outlines: Sequence[Outline],
        camera: PinholeCamera,
        pictures: Sequence[Picture],
        X_WN: Array,
        width: int,
    ) -> None:
        width = min(width, camera.width)
        height = max(8, round(camera.height * width / camera.width))
        self.camera, self._X_WN = camera.resized(width, height), X_WN
        small = [cv2.resize(p, (width, height), interpolation=cv2.INTER_AREA) for p in pictures]
        self._packed = pack(tuple(outlines))
        self._parameters = self.camera.kernel_parameters()
        points = np.array([placed_points(outlines, X) for X in X_WN])
        size = float(np.sqrt(((points - points.mean(axis=(0, 1))) ** 2).sum(axis=2).mean()))
        self.backgrounds = Backgrounds.estimate(np.array(small))
        moves = np.linalg.norm(np.ptp(points, axis=0), axis=1)
        counts = [len(outline.vertices) for outline in outlines]
        owners = np.repeat(np.arange(len(outlines)), counts)
        most = np.zeros(len(outlines))
        np.maximum.at(most, owners, moves)
        # A node is static if its points move by less than 0.06 of the body's size.
        self._static = most < 0.06 * size
        moving = points[:, ~self._static[owners]]
        self.points = (moving if moving.size else points).reshape(-1, 3)
        self.middle = self.points.mean(axis=0)
        off = self.points - self.middle
        self._size = float(np.sqrt((off**2).sum(axis=1).mean()))

    def with_camera(self, camera: PinholeCamera) -> "PyramidLevel":
        """Return the level with the intrinsics of another camera, which may have any size."""
        other = copy.copy(self)
        other.camera = camera.resized(self.camera.width, self.camera.height)
        other._parameters = other.camera.kernel_parameters()
        return other

    def mirrored(self) -> "PyramidLevel":
        """Return the level of the mirrored pictures."""
        other = self.with_camera(self.camera.mirrored())
        other.backgrounds = self.backgrounds.mirrored()
        return other

    def with_poses(self, X_WN: Array) -> "PyramidLevel":
        """Return the level of the same pictures with other node poses X_WN (f, nodes, 4, 4)."""
        other = copy.copy(self)
        other._X_WN = X_WN
        return other

    def statistics(self, X_CW: Array, X_WN: Array | None = None) -> Array:
        """Return the sums (4,) over all pictures at a pose (4, 4), see ``Explained``.

        X_WN: (f, nodes, 4, 4) poses of the nodes; None: those of the level.
        """
        placed = np.ascontiguousarray((self._X_WN if X_WN is None else X_WN)[:, :, :3])
        (totals,), _ = self._scored()._replace(X_WN=placed).explain(X_CW[None, :3])
        return np.asarray(totals)

    def explained(self, X_CW: Array) -> tuple[float, float]:
        """Return a pose's `explained` fraction and mean `contour`, as of ``PictureFit``."""
        sums = self.statistics(X_CW)
        fraction = float(sums[Explained.GAIN]) / max(self.backgrounds.max_gain, 1e-9)
        return fraction, float(sums[Explained.CONTOUR]) / max(float(sums[Explained.OUTLINE]), 1.0)

    def score(self, X_CW: Array, frames: int | None = None) -> float:
        """Return the score of a pose (4, 4), see `scores`."""
        return float(self.scores([X_CW], frames)[0])

    def scores(self, X_CW: Sequence[Array] | Array, frames: int | None = None) -> Array:
        """Return scores (n,), see `evidence`, of poses (4, 4) in the first `frames`, or all."""
        pictures, poses = self._scored(frames), np.ascontiguousarray(np.asarray(X_CW)[:, :3])

        def sums(chunk: Array) -> Array:
            return pictures.explain(chunk)[0]

        totals = np.concatenate(
            map_ordered(sums, (poses[k : k + 100] for k in range(0, len(poses), 100)))
        )
        outline = totals[:, Explained.OUTLINE] + pictures.scales[1]
        contour = pictures.scales[2] * totals[:, Explained.CONTOUR] / outline
        return np.asarray(totals[:, Explained.GAIN] / pictures.scales[0] + contour)

    def _scored(self, frames: int | None = None) -> ScoredPictures:
        """Return the first `frames` pictures (None: all), prepared for scores."""
        X_WN = np.ascontiguousarray(self._X_WN[:frames, :, :3])
        possible = self.backgrounds.max_gain * len(X_WN) / len(self._X_WN)
        # The added length limits the score of short outlines, whose edges are strong by chance.
        outline = 0.3 * len(X_WN) * self.camera.width
        return ScoredPictures(
            self._packed, X_WN, self._static, self._parameters, self.backgrounds.sums,
            self.middle, np.array([max(possible, 1e-9), outline, PICTURES.contour_weight]),
        )  # fmt: skip

    def best(self, X_CW: Sequence[Array], frames: int, fraction: float) -> list[Array]:
        """Return the fraction of poses (4, 4) with the best scores in the first `frames`."""
        order = np.argsort(-self.scores(X_CW, frames), kind="stable")
        return [X_CW[k] for k in order[: math.ceil(fraction * len(order))]]

    def tile_gains(self, X_CW: Array, squares: int = 16) -> Array:
        """Return a pose's log-likelihood gain [nat] by square image tiles (squares, squares)."""
        side = max(self.camera.width, self.camera.height) / squares
        return self._scored().explain(X_CW[None, :3], side, squares)[1]

    def starts(self, rotations: int) -> list[Array]:
        """Return poses X_CW (4, 4) from which a search starts.

        They show the body where pictures change. Each rotation is combined with three depths, near
        that at which the body is as large as the changing part, and with two places in the picture:
        the centre of the changes, and a random one.

        rotations: number of rotations over the whole sphere, and of further ones near upright.
        """
        changes = self.backgrounds.changed_frames()
        v, u = np.mgrid[: changes.shape[0], : changes.shape[1]]
        total = max(float(changes.sum()), 1e-9)
        middle = np.array([float((changes * axis).sum()) / total for axis in (u, v)])
        squares = (u - middle[0]) ** 2 + (v - middle[1]) ** 2
        spread = max(float(np.sqrt((changes * squares).sum() / total)), 2.0)
        R_CW = np.concatenate([uniform_rotations(rotations), upright_rotations(rotations)])
        points = self.points[:: max(1, len(self.points) // 200)] - self.middle
        p_C = np.einsum("nij,pj->npi", R_CW, points)
        sizes = np.sqrt((p_C[..., :2] ** 2).sum(axis=2).mean(axis=1))
        nearest = 0.05 * self._size - 0.7 * p_C[..., 2].min(axis=1)
        rng = np.random.default_rng(0)
        focal, centre = self._parameters[1:3], self._parameters[3:5]
        starts = []
        for factor in (0.7, 1.0, 1.5):
            depth = np.maximum(focal[0] * sizes / spread * factor, nearest)
            for aside in (np.zeros((len(R_CW), 2)), rng.normal(0.0, 0.5, (len(R_CW), 2))):
                X = np.tile(np.eye(4), (len(R_CW), 1, 1))
                X[:, :3, :3] = R_CW
                directions = (middle + spread * aside - centre) / focal
                p_CM = np.column_stack([directions, np.ones(len(R_CW))]) * depth[:, None]
                X[:, :3, 3] = p_CM - R_CW @ self.middle
                starts += list(X)
        return starts

    def improve(
        self, X_CW: Sequence[Array], evaluations: int, turn: float
    ) -> tuple[Array, list[Array]]:
        """Improve poses by Nelder and Mead's simplex search.

        Args:
            X_CW: n poses (4, 4).
            evaluations: maximum number of scores for each pose, at least 7.
            turn: size of the first simplex in rotation [rad], see PICTURES.simplex.

        Returns the scores (n,), highest first, and the improved poses.
        """
        count = len(X_CW)
        signs = [np.random.default_rng(k).choice([-1.0, 1.0], 6) for k in range(count)]
        steps = turn * np.array(signs) * np.array(PICTURES.simplex)
        corners = np.zeros((count, 7, 6))
        corners[:, np.arange(1, 7), np.arange(6)] = steps
        starts, costs = np.asarray(X_CW)[:, :3], np.zeros((count, 7))
        pictures, step = self._scored(), max(1, min(5, count // 8))

        def search(k: int) -> None:
            part = slice(k, k + step)
            search_simplexes(pictures, starts[part], corners[part], costs[part], evaluations)

        map_ordered(search, range(0, count, step))
        order = np.argsort(costs[:, 0], kind="stable")
        return -costs[order, 0], [self.moved(X_CW[k], corners[k, 0]) for k in order]

    def opposite(self, X_CW: Array) -> Array:
        """Return X_CW (4, 4) of an opposite camera, as far away, which sees mirror images."""
        return opposite_side(X_CW, self.middle)

    def depth_twin(self, X_CW: Array) -> Array:
        """Return X_CW (4, 4) reversed in depth, see ``judge.depth_twin``."""
        return depth_twin(X_CW, self.points)

    def distinct(self, X_CW: Sequence[Array], most: int | None = None) -> list[Array]:
        """Return at most `most` poses (4, 4), those unlike all earlier ones; None: no maximum."""
        points = self.points[:: max(1, len(self.points) // 50)]
        kept, places = list[Array](), np.zeros((0, *points.shape))
        for X in X_CW:
            p_C = points @ X[:3, :3].T + X[:3, 3]
            apart = np.linalg.norm(places - p_C, axis=2).mean(axis=1)
            if (apart > 0.08 * self._size).all():
                kept.append(X)
                places = np.concatenate([places, p_C[None]])
            if len(kept) == most:
                break
        return kept

    def moved(self, X_CW: Array, x: Array) -> Array:
        """Return a pose (4, 4) moved by x (6,) in the camera's frame, see ``move_pose``."""
        moved = X_CW.copy()
        move_pose(X_CW[:3], self.middle, x, moved[:3])
        return moved


def upright_rotations(count: int) -> Array:
    """Return rotations R_CW (count, 3, 3) of nearly upright cameras in a world with z up.

    They look up by 30 degrees and down by 79 at most, with a roll of 0.15 rad standard deviation.
    """
    k = np.arange(count) + 0.5
    rng = np.random.default_rng(1)
    heading = 2.0 * np.pi * k * (0.5 * (np.sqrt(5.0) - 1.0))
    pitch = np.arcsin(np.linspace(-0.98, 0.5, count))
    roll = rng.normal(0.0, 0.15, count)
    forward = np.column_stack(
        [np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), np.sin(pitch)]
    )
    right = np.column_stack([np.sin(heading), -np.cos(heading), np.zeros(count)])
    down = np.cross(forward, right)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([c * right + s * down, -s * right + c * down, forward], axis=1)


def search_offsets(
    level: PyramidLevel,
    poses: Callable[[Array], Array],
    X_CW: Array,
    start: Array,
    joints: Sequence[int],
    sweeps: int,
    *,
    within: float = 0.45,
    steps: int = 11,
    evaluations: int = 300,
    first_step: float = 0.1,
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
        weight: by how much the score falls at an offset of SHARED.constant_deviation. A joint that
            hardly shows stays near 0.

    Returns the pose X_CW (4, 4), and the offsets (m,).
    """
    from scipy.optimize import minimize  # Slow to import, and seldom needed.

    offsets = start.copy()

    def score(X: Array, tried: Array) -> float:
        prior = weight * float(((tried / SHARED.constant_deviation) ** 2).sum())
        return level.with_poses(poses(tried)).score(X) - prior

    def improve(free: Sequence[int], most: int, size: float) -> float:
        """Improve the pose and some offsets from a first simplex, and return their score."""
        nonlocal X_CW, offsets
        about, at = X_CW, offsets
        columns = size * np.array([*PICTURES.simplex, *np.ones(len(free))])

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
