"""One pose from all silhouettes at once: the contours of body and regions drawn to each other.

Gauss and Newton's method on the distances of `silhouette_kernel`, summed over all cameras, inside
the joint limits. The cost's scale shrinks from round to round, so first everything within reach
pulls and in the end only what fits (graduated non-convexity, Blake and Zisserman 1987).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.body import PoseTree
from drake_pose.body.tree.tree_kinematics import Motions, TreeKinematics
from drake_pose.camera import Camera
from drake_pose.matching.fit.robust_fit import few_triangles
from drake_pose.multiview.person.silhouette_edges import EdgePoints
from drake_pose.multiview.person.silhouette_kernel import collect, compare_contours
from drake_pose.silhouette import Outline, TreeSurfaces
from drake_pose.silhouette.areas.outline import pack

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]

# A step changes no value by more [rad or m].
_LONGEST_STEP = 0.35
# Finer than this [pixel] regions cannot tell.
_FINEST_SCALE = 1.5
# Distances beyond so many scales do not correspond.
_REACH = 4.0
_TRIANGLES = 80


@dataclass(frozen=True)
class Round:
    """One step of a fit.

    Args:
        scale: the distance at which a point of a contour loses three quarters of its pull [m].
        spacing: of the points of the contours [m].
    """

    scale: float
    spacing: float


@dataclass(frozen=True)
class Noise:
    """How far regions are off the body's silhouette: what a point of contour is worth.

    Args:
        deviation: of the distance of the contours [m].
        correlation: so much of a contour errs together [m].
    """

    deviation: float = 0.006
    correlation: float = 0.06


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of the values without pictures.

    Args:
        mean: (m,) [rad or m].
        information: (m,) one over the variance; 0: nothing is known.
    """

    mean: Array
    information: Array


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A fitted pose.

    Args:
        values: (m,) of the pose tree [rad or m].
        agreement: (nodes + 1, 3) before the last step: the length of each node's contour, and of
            all edges in the last row, how much of it fits to within the last scale, and how well:
            one minus the cost in scales, summed along it [m].
    """

    values: Array
    agreement: Array

    @property
    def share(self) -> float:
        """Of both contours' lengths, what fits, 0 to 1."""
        compared, fitting, _ = self.agreement.sum(axis=0)
        return float(fitting / max(compared, 1e-9))

    @property
    def closeness(self) -> float:
        """How well both contours fit, 0 to 1; it tells the better one of two fits."""
        compared, _, close = self.agreement.sum(axis=0)
        return float(close / max(compared, 1e-9))


class _Sight(NamedTuple):
    """What all cameras say, as the kernel takes it.

    cameras: X_CW (c, 4, 4) and kernel parameters (c, 8); edges: uv, normals and lengths of all edge
    points, camera after camera, and where each begins.
    """

    cameras: tuple[Array, Array]
    edges: tuple[Array, Array, Array, Indices]


class Comparison(NamedTuple):
    """What each camera says of each node's affine motion x (12,): x^T A x - 2 b^T x.

    A: (cameras, nodes, 12, 12), lower triangles; b: (cameras, nodes, 12); motions: of the nodes at
    the values; agreement: as in PoseFit.
    """

    A: Array
    b: Array
    motions: Motions
    agreement: Array


class Equations(NamedTuple):
    """The normal equations H dx = -g at some values.

    H: (m, m); g: (m,); agreement: as in PoseFit.
    """

    H: Array
    g: Array
    agreement: Array


class SilhouetteFit:
    """Fits the values of a body's pose tree to the regions of several cameras.

    Attributes:
        tree: the pose tree.
        kinematics: its kinematics; `names` are the values'.
        lower, upper: (m,) limits; infinite for angles that turn freely.

    Args:
        tree: the body's pose tree.
        outlines: a surface for each node; few triangles will do. The tree's own where not given.
        noise: what a point of contour is worth.
    """

    def __init__(
        self,
        tree: PoseTree,
        outlines: Sequence[Outline] | None = None,
        noise: Noise | None = None,
    ) -> None:
        self.tree = tree
        self.kinematics = TreeKinematics(tree)
        if outlines is None:
            outlines = few_triangles(TreeSurfaces(tree), _TRIANGLES)
        self.outlines = tuple(outlines)
        self.noise = noise or Noise()
        self._packed = pack(self.outlines)
        kinematics = self.kinematics
        turns = kinematics.upper - kinematics.lower >= 2.0 * np.pi - 1e-9
        free = kinematics.is_angle & turns
        self.lower = np.where(free, -np.inf, kinematics.lower)
        self.upper = np.where(free, np.inf, kinematics.upper)
        moves = kinematics.motions(kinematics.flatten(tree.default_values())).moves
        self._moving = np.concatenate([np.flatnonzero(row) for row in moves])
        self._starts = np.cumsum([0, *moves.sum(axis=1)])

    def fit(
        self,
        cameras: Sequence[Camera],
        edges: Sequence[EdgePoints],
        values: Array,
        rounds: Sequence[Round],
        prior: Prior | None = None,
        held: Mask | None = None,
    ) -> PoseFit:
        """Fits a pose.

        Args:
            cameras: the cameras.
            edges: of each camera's region; without points where nobody is seen.
            values: (m,) where to start.
            rounds: the steps.
            prior: what else is known.
            held: (m,) which values stay.
        """
        index = np.flatnonzero(np.ones(len(values), bool) if held is None else ~held)
        current = np.clip(values, self.lower, self.upper)
        agreement = np.zeros((len(self.outlines) + 1, 3))
        sight = _pack(cameras, edges)
        for step in rounds:
            A, b, motions, agreement = self._compare(sight, current, step)
            affine = affine_motions(motions.twists)
            A, b = A.sum(axis=0), b.sum(axis=0)
            H, g = collect(A, b, affine, self._starts, self._moving, self._moving, len(values))
            if prior is not None:
                g = g + prior.information * (current - prior.mean)
                H = H + np.diag(prior.information)
            current = self._stepped(current, H, g, index)
        return PoseFit(current, agreement)

    def equations(
        self,
        cameras: Sequence[Camera],
        edges: Sequence[EdgePoints],
        values: Array,
        step: Round,
        groups: Sequence[int],
    ) -> Equations:
        """The normal equations at values (m,); arguments as in fit.

        Args:
            cameras, edges, values: as in fit.
            step: how.
            groups: (nodes,) for each node which girth it shares with others, or -1; the equations
                have the logarithms of these girths after the values.
        """
        A, b, motions, agreement = self.compare(cameras, edges, values, step)
        A, b = A.sum(axis=0), b.sum(axis=0)
        owners, parameters, starts = self._with_girths(groups)
        affine = np.vstack([affine_motions(motions.twists), [_widening(X) for X in motions.X_WN]])
        size = len(values) + max(groups, default=-1) + 1
        H, g = collect(A, b, affine, starts, owners, parameters, size)
        return Equations(H, g, agreement)

    def compare(
        self, cameras: Sequence[Camera], edges: Sequence[EdgePoints], values: Array, step: Round
    ) -> Comparison:
        """The contours at values (m,) compared with all cameras' edges; arguments as in fit."""
        return self._compare(_pack(cameras, edges), values, step)

    def _compare(self, sight: _Sight, values: Array, step: Round) -> Comparison:
        motions = self.kinematics.motions(values)
        pixels = _pixels_per_metre(sight.cameras, motions.X_WN[0, :3, 3])
        nodes, noise = len(self.outlines), self.noise
        weights = np.column_stack(
            [
                1.0 / pixels,
                np.maximum(_FINEST_SCALE, step.scale * pixels),
                np.maximum(1.0, step.spacing * pixels),
                # Both contours say the same: together they count as one.
                0.5 / (pixels * noise.correlation * (pixels * noise.deviation) ** 2),
            ]
        )
        A, b = np.zeros((len(pixels), nodes, 12, 12)), np.zeros((len(pixels), nodes, 12))
        agreement = np.zeros((nodes + 1, 3))
        compare_contours(
            self._packed,
            motions.X_WN,
            sight.cameras,
            sight.edges,
            weights,
            _REACH,
            A,
            b,
            agreement,
        )
        return Comparison(A, b, motions, agreement)

    def _with_girths(self, groups: Sequence[int]) -> tuple[Indices, Indices, Indices]:
        """The owners, parameters and starts of `collect` with a widening after each node's own."""
        count = len(self.kinematics.names)
        owners, parameters, starts = [], [], [0]
        for node, group in enumerate(groups):
            own = self._moving[self._starts[node] : self._starts[node + 1]]
            more = [] if group < 0 else [group]
            owners += [*own, *(count + node for _ in more)]
            parameters += [*own, *(count + k for k in more)]
            starts.append(len(owners))
        return np.array(owners), np.array(parameters), np.array(starts)

    def _stepped(self, values: Array, H: Array, g: Array, index: NDArray[np.intp]) -> Array:
        """Values after a step that stays inside the limits."""
        leaving = ((values <= self.lower) & (g > 0.0)) | ((values >= self.upper) & (g < 0.0))
        index = index[~leaving[index]]
        if not len(index):
            return values
        diagonal = np.diag(H)[index]
        damping = 1e-3 * diagonal + 1e-4 * diagonal.mean() + 1e-9
        change = np.linalg.solve(H[np.ix_(index, index)] + np.diag(damping), -g[index])
        change *= min(1.0, _LONGEST_STEP / max(float(np.abs(change).max()), 1e-12))
        stepped = values.copy()
        stepped[index] = np.clip(values[index] + change, self.lower[index], self.upper[index])
        return stepped


def _pack(cameras: Sequence[Camera], edges: Sequence[EdgePoints]) -> _Sight:
    return _Sight(
        (
            np.array([camera.X_CW for camera in cameras]),
            np.array([camera.kernel_parameters() for camera in cameras]),
        ),
        (
            np.concatenate([edge.uv for edge in edges]),
            np.concatenate([edge.normals for edge in edges]),
            np.concatenate([edge.lengths for edge in edges]),
            np.cumsum([0, *(len(edge.uv) for edge in edges)]),
        ),
    )


def _pixels_per_metre(cameras: tuple[Array, Array], place: Array) -> Array:
    """(c,) how large a metre at a place (3,) is in each picture [pixel/m]."""
    X_CW, parameters = cameras
    kind, focal, near = parameters[:, 0], parameters[:, 1], parameters[:, 5]
    depth = np.maximum(X_CW[:, 2, :3] @ place + X_CW[:, 2, 3], near)
    return np.asarray(np.where(kind == 0.0, focal / depth, focal))


def affine_motions(twists: Array) -> Array:
    """Twists (m, 7) as affine motions (m, 12), the rows of dp/dx = M p + v one after another."""
    affine = np.zeros((len(twists), 3, 4))
    affine[:, 2, 1], affine[:, 0, 2], affine[:, 1, 0] = twists[:, :3].T
    affine[:, 1, 2], affine[:, 2, 0], affine[:, 0, 1] = -twists[:, :3].T
    affine[:, :, 3] = twists[:, 3:6]
    for k in range(3):
        affine[:, k, k] = twists[:, 6]
    return affine.reshape(-1, 12)


def _widening(X_WN: Array) -> Array:
    """The affine motion (12,) of a part that grows across its y axis, per relative growth."""
    M = np.zeros((3, 4))
    across = X_WN[:3, [0, 2]]
    M[:, :3] = across @ across.T
    M[:, 3] = -M[:, :3] @ X_WN[:3, 3]
    return M.reshape(-1)
