"""Robust refinement: the body's contour drawn to the silhouettes' edges, whatever is damaged.

Levenberg and Marquardt's method on the saturating costs of ``robust_kernel``, with limits. The
scale of the costs shrinks from pass to pass (graduated non-convexity, Blake and Zisserman 1987):
first everything within reach pulls, in the end only what fits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import fast_simplification
import numpy as np

from drake_pose.body import TriangleMesh
from drake_pose.body.limits import nearest_turn
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera import Camera
from drake_pose.errors import SettingsError
from drake_pose.matching.fit.pose_jacobian import image_jacobian
from drake_pose.matching.fit.robust_kernel import add_body_contour, add_silhouette_edge
from drake_pose.matching.result import View
from drake_pose.silhouette import Outline, TreeSurfaces, outline_from_mesh
from drake_pose.silhouette.contours.contour_points import find_contour_points
from drake_pose.silhouette.pictures.signed_distances import signed_distances

# What refinement needs of a surface shows with so few triangles.
_TRIANGLES = 400
# A step changes no value by more [rad or m].
_LONGEST_STEP = 0.3
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-2, 1e-4, 1e2
# A share of the mean of the diagonal, which keeps what does not show where it is.
_EVEN_DAMPING = 1e-3
# Steps that gain a smaller share end a pass.
_STANDSTILL = 1e-3
# Finer than this [pixel] masks cannot tell.
_FINEST_SCALE, _FINEST_SPACING = 1.5, 1.0


@dataclass(frozen=True)
class RobustPass:
    """One part of a refinement; lengths are shares of the root of the silhouettes' mean area.

    Args:
        scales: one after another, the distance at which half the cost's limit is reached.
        iterations: at most so many steps at each scale.
        spacing: from one point of the body's contour to the next.
    """

    scales: tuple[float, ...]
    iterations: int
    spacing: float

    def __post_init__(self) -> None:
        if not self.scales or not min(self.scales) > 0.0:
            raise SettingsError(f"scales must be positive, not {self.scales}")
        if self.iterations < 1:
            raise SettingsError(f"iterations must be 1 or more, not {self.iterations}")
        if not self.spacing > 0.0:
            raise SettingsError(f"spacing must be positive, not {self.spacing}")


@dataclass(frozen=True)
class RobustPose:
    """A refined pose.

    Args:
        values: (m,) all values of the pose tree [rad or m].
        cost: what does not fit [pixel of contour]; comparable at one scale and spacing only.
    """

    values: np.ndarray
    cost: float


@dataclass(frozen=True, eq=False)
class _Edge:
    """A silhouette's edge.

    camera: the camera; X_CW: (4, 4); distances: (H, W) signed distances [pixel]; points: (n, 2)
    [pixel]; normals: (n, 2) outwards; length: what a point stands for [pixel].
    """

    camera: Camera
    X_CW: np.ndarray
    distances: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    length: float


class RobustFit:
    """One body and the silhouettes of one instant.

    Attributes:
        kinematics: the pose tree's.
        size: the root of the silhouettes' mean area [pixel].
        edge_length: the length of the silhouettes' edges [pixel].
        evaluations: how often the costs were computed.

    Args:
        kinematics: the pose tree's kinematics.
        outlines: a surface for each node; few triangles will do, see ``few_triangles``.
        views: the silhouettes.
    """

    def __init__(
        self, kinematics: TreeKinematics, outlines: tuple[Outline, ...], views: Sequence[View]
    ) -> None:
        self.kinematics = kinematics
        self.size = math.sqrt(float(np.mean([np.count_nonzero(view.mask) for view in views])))
        self._outlines = outlines
        step = max(1, round(self.size / 40.0))
        self._edges = [_find_edge(view, step) for view in views]
        self.edge_length = max(1.0, sum(len(edge.points) * edge.length for edge in self._edges))
        self.evaluations = 0

    def cost(self, values: np.ndarray, scale: float, spacing: float) -> float:
        """What does not fit at values (m,) [pixel]; scale and spacing as in RobustPass."""
        return self._equations(values, scale, spacing)[0]

    def curvature(self, values: np.ndarray, scale: float, spacing: float) -> np.ndarray:
        """(m, m) second derivatives of the cost where all that is near fits [pixel/rad^2]."""
        H = self._equations(values, scale, spacing)[1]
        return 2.0 * H / self._pixels(scale, _FINEST_SCALE) ** 2

    def refine(self, values: np.ndarray, part: RobustPass, held: Sequence[int] = ()) -> RobustPose:
        """Refine values (m,), but for some that are held, by indices."""
        kinematics = self.kinematics
        free = kinematics.upper > kinematics.lower
        free[list(held)] = False
        current = np.where(free, np.clip(values, kinematics.lower, kinematics.upper), values)
        damping, cost = _FIRST_DAMPING, np.inf
        for scale in part.scales:
            cost, H, g = self._equations(current, scale, part.spacing)
            for _ in range(part.iterations):
                trial = self._stepped(current, H, g, free, damping)
                trial_cost, trial_H, trial_g = self._equations(trial, scale, part.spacing)
                if trial_cost < cost:
                    gain = 1.0 - trial_cost / cost
                    current, cost, H, g = trial, trial_cost, trial_H, trial_g
                    damping = max(0.2 * damping, _LEAST_DAMPING)
                    if gain < _STANDSTILL:
                        break
                else:
                    damping *= 10.0
                    if damping > _MOST_DAMPING:
                        break
            damping = min(damping, 0.1)
        return RobustPose(current, cost)

    def _stepped(
        self, values: np.ndarray, H: np.ndarray, g: np.ndarray, free: np.ndarray, damping: float
    ) -> np.ndarray:
        """Values after a damped step that stays inside the limits."""
        lower, upper = self.kinematics.lower, self.kinematics.upper
        leaving = ((values <= lower) & (g > 0.0)) | ((values >= upper) & (g < 0.0))
        index = np.flatnonzero(free & ~leaving)
        if len(index) == 0:
            return values
        diagonal = np.diag(H)[index]
        added = damping * diagonal + _EVEN_DAMPING * diagonal.mean() + 1e-9
        step = np.linalg.solve(H[np.ix_(index, index)] + np.diag(added), -g[index])
        step *= min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-300))
        stepped = values.copy()
        stepped[index] = np.clip(values[index] + step, lower[index], upper[index])
        return stepped

    def _pixels(self, share: float, finest: float) -> float:
        return max(finest, share * self.size)

    def _equations(
        self, values: np.ndarray, scale: float, spacing: float
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """The cost, and H and g of its normal equations."""
        self.evaluations += 1
        scale, spacing = self._pixels(scale, _FINEST_SCALE), self._pixels(spacing, _FINEST_SPACING)
        motions = self.kinematics.motions(values)
        H, g = np.zeros((len(values), len(values))), np.zeros(len(values))
        cost = 0.0
        for edge in self._edges:
            points = find_contour_points(
                self._outlines, edge.X_CW @ motions.X_WN, edge.camera, spacing
            )
            moving = image_jacobian(points.p_N, points.nodes, motions, edge.camera)
            uv, normals = points.uv, points.normals
            cost += add_body_contour(
                edge.distances, uv, normals, points.lengths, moving, scale, H, g
            )
            cost += add_silhouette_edge(
                edge.points, edge.normals, edge.length, uv, normals, moving, scale, H, g
            )
        return cost, H + np.tril(H, -1).T, g


def refine_best(
    fit: RobustFit,
    starts: Sequence[np.ndarray],
    parts: Sequence[tuple[RobustPass, int]],
    proceed: Callable[[], bool],
) -> list[RobustPose]:
    """Refine many poses, after each pass only the best of those that still differ.

    Args:
        fit: the body and the silhouettes.
        starts: each (m,), best first.
        parts: passes, and how many poses are kept after each.
        proceed: asked before each refinement whether to go on.

    Returns:
        The poses kept after the last pass, best first; at least one.
    """
    values = list(starts)
    kept: list[RobustPose] = []
    for part, count in parts:
        refined: list[RobustPose] = []
        for start in values:
            if refined and not proceed():
                break
            refined.append(fit.refine(start, part))
        kept = unlike(refined, count, fit.kinematics.turns_around)
        values = [pose.values for pose in kept]
    return kept


def unlike(
    poses: Sequence[RobustPose],
    count: int,
    turns_around: np.ndarray | bool = False,
    apart: float = 0.05,
) -> list[RobustPose]:
    """The best poses some value of which differs by more than so much [rad or m] from better ones.

    Args:
        poses: in any order.
        count: at most so many.
        turns_around: (m,) the values that are the same after a full turn.
        apart: the difference.
    """
    chosen: list[RobustPose] = []
    for pose in sorted(poses, key=lambda one: one.cost):
        gaps = (
            nearest_turn(pose.values, other.values, turns_around) - other.values for other in chosen
        )
        if all(np.abs(gap).max(initial=0.0) > apart for gap in gaps):
            chosen.append(pose)
        if len(chosen) >= count:
            break
    return chosen


def few_triangles(surfaces: TreeSurfaces, count: int = _TRIANGLES) -> tuple[Outline, ...]:
    """The nodes' surfaces, skin at rest, with few triangles (Garland and Heckbert's metric)."""
    outlines = []
    for node, rigid in enumerate(surfaces.rigid):
        bending = surfaces.bending[node]
        whole = rigid if bending is None else bending.rest
        if len(whole.triangles) > count:
            points, triangles = fast_simplification.simplify(
                whole.vertices, whole.triangles, target_count=count
            )
            mesh = TriangleMesh(np.asarray(points, dtype=np.float64), triangles)
            whole = outline_from_mesh(mesh)
        outlines.append(whole)
    return tuple(outlines)


def _find_edge(view: View, step: int) -> _Edge:
    """A silhouette's edge, a point every so many pixels along it."""
    distances = signed_distances(view.mask)
    height, width = view.mask.shape
    smooth = cv2.GaussianBlur(distances, (0, 0), 1.5)
    slopes = [cv2.Sobel(smooth, cv2.CV_32F, 1 - k, k, scale=0.125) for k in range(2)]
    contours, _ = cv2.findContours(view.mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    pixels = np.vstack([contour[::step, 0] for contour in contours])
    # The picture's border is no edge.
    inner = (pixels > 0).all(axis=1) & (pixels < np.array([width - 1, height - 1])).all(axis=1)
    column, row = pixels[inner].T
    normals = np.column_stack([slope[row, column] for slope in slopes]).astype(np.float64)
    sizes = np.linalg.norm(normals, axis=1)
    clear = sizes > 0.3
    normals = normals[clear] / sizes[clear, None]
    places = np.column_stack([column, row])[clear] - distances[row, column][clear, None] * normals
    # A chain of pixels is longer than its number by about a tenth, on the mean of all directions.
    return _Edge(
        view.camera,
        np.ascontiguousarray(view.camera.X_CW),
        distances,
        np.ascontiguousarray(places, dtype=np.float64),
        normals,
        1.1 * step,
    )
