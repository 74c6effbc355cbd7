"""One pose from all silhouettes at once: the contours of body and silhouettes drawn together.

The cost of a pose theta, with r_i the distance of a point of either contour from the other, l_i the
length that it stands for, s the scale of a stage and w the weight of a unit of contour:
C(theta) = w sum_i l_i r_i^2 / (1 + (r_i / s)^2) + (theta - m)^T P (theta - m).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.body import PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.fit.evidence import EdgePoints, Evidence, pack_evidence
from drake_pose.fit.kernel import Sum, collect, compare_contours
from drake_pose.fit.levenberg_marquardt import AnnealingStage, Equations, StepSettings, minimise
from drake_pose.fit.parameters import BodyParameters, Placement
from drake_pose.fit.surfaces import VERY_FEW, simplify_surfaces
from drake_pose.silhouette.outline import Outline, TreeSurfaces

FINEST_SCALE = 1.5
"""Silhouettes resolve no smaller distances [pixel]."""


@dataclass(frozen=True)
class Noise:
    """Errors of silhouettes, from which contours get their weights.

    Args:
        deviation: standard deviation of the distance of the contours [m].
        correlation: length of contour that errs together [m], of all cameras or (cameras,).
    """

    deviation: float = 0.006
    correlation: float | Array = 0.06

    @classmethod
    def of_a_pixel(cls, pixels: float | Array) -> "Noise":
        """With which a pixel of contour has the weight one; pixels: of the unit of length."""
        return cls(deviation=1.0, correlation=0.5 / pixels**3)


@dataclass(frozen=True, eq=False)
class Prior:
    """Independent normal priors of the values: mean (m,) [rad or m], information (m,)."""

    mean: Array
    information: Array


class Views(NamedTuple):
    """Cameras, X_CW (c, 4, 4) and kernel parameters (c, 8), and their silhouettes' edges."""

    cameras: tuple[Array, Array]
    evidence: Evidence


class Comparison(NamedTuple):
    """Costs x^T A x - 2 b^T x of each node's affine motion x (12,), by camera.

    A: (cameras, nodes, 12, 12), lower triangles; b: (cameras, nodes, 12); sums: (cameras,
    nodes + 1, 6) and wide: (cameras, nodes, 13) as of `compare_contours`; placement: of the body.
    """

    A: Array
    b: Array
    sums: Array
    wide: Array
    placement: Placement

    @property
    def inlier_ratio(self) -> float:
        """Of both contours' lengths, what fits, 0 to 1."""
        return inlier_ratio_of(self.sums)


Compare = Callable[[Placement, AnnealingStage], Comparison]
"""Compares a body's contours with what some cameras see, at the scale of a stage."""


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A fitted pose.

    Args:
        values: (m,) of the pose tree [rad or m].
        sums: (nodes + 1, 6) before the last step, of all cameras, as of `compare_contours`.
        cost: of the last comparison, prior included.
        evaluations: number of comparisons.
    """

    values: Array
    sums: Array
    cost: float
    evaluations: int

    @property
    def inlier_ratio(self) -> float:
        """Fraction of both contours' lengths that fits."""
        return inlier_ratio_of(self.sums)

    @property
    def closeness(self) -> float:
        """How well both contours fit, 0 to 1: the score of a fit among others."""
        total = self.sums.sum(axis=0)
        return float(total[Sum.CLOSE] / max(total[Sum.COMPARED], 1e-9))


def inlier_ratio_of(sums: Array) -> float:
    """Fraction of both contours' lengths that fits; sums (..., 6) of `compare_contours`."""
    total = sums.reshape(-1, sums.shape[-1]).sum(axis=0)
    return float(total[Sum.FITTING] / max(total[Sum.COMPARED], 1e-9))


def pack_views(cameras: Sequence[Camera], edges: Sequence[EdgePoints]) -> Views:
    """Cameras and the edges of their silhouettes; without points where nothing is seen."""
    return Views(pack_cameras(cameras), pack_evidence(edges))


def pack_cameras(cameras: Sequence[Camera]) -> tuple[Array, Array]:
    """X_CW (c, 4, 4) and kernel parameters (c, 8) of cameras."""
    return (
        np.array([camera.X_CW for camera in cameras]).reshape(-1, 4, 4),
        np.array([camera.kernel_parameters() for camera in cameras]).reshape(-1, 8),
    )


class ContourFit:
    """Fits the values of a body's pose tree to the silhouettes of several cameras.

    Attributes:
        lower, upper: (m,) limits; infinite for angles that turn freely.

    Args:
        tree: the body's pose tree, or its kinematics.
        outlines: a surface for each node; few triangles will do. The tree's own where not given.
        noise: of the silhouettes.
        steps: how steps are made.
        pixels: the unit of length of rounds and noise [pixel], of all cameras or (c,); None: a
            metre at the body's root.
        body: its parameters; None: the tree's values and ROOT_NAMES.
    """

    def __init__(
        self,
        tree: PoseTree | TreeKinematics,
        outlines: Sequence[Outline] | None = None,
        noise: Noise | None = None,
        steps: StepSettings | None = None,
        pixels: float | Array | None = None,
        body: BodyParameters | None = None,
    ) -> None:
        self.kinematics = tree if isinstance(tree, TreeKinematics) else TreeKinematics(tree)
        self.tree = self.kinematics.tree
        self.outlines = tuple(
            simplify_surfaces(TreeSurfaces(self.tree), VERY_FEW) if outlines is None else outlines
        )
        self.noise, self.steps = noise or Noise(), steps or StepSettings()
        self.body = body or BodyParameters(self.kinematics, self.outlines)
        self.lower, self.upper = self.kinematics.lower, self.kinematics.upper
        self._pixels = pixels

    def fit(
        self,
        seen: Views | Compare,
        values: Array,
        rounds: Sequence[AnnealingStage],
        prior: Prior | None = None,
        held: Mask | None = None,
    ) -> PoseFit:
        """Fits a pose.

        Args:
            seen: the cameras and their silhouettes' edges, or what compares contours otherwise.
            values: (m,) where to start.
            rounds: the parts of the fit.
            prior: of the values.
            held: (m,) which values stay.
        """
        index = np.flatnonzero(np.ones(len(values), bool) if held is None else ~held)
        current = np.array(values, dtype=np.float64)
        current[index] = np.clip(values, self.lower, self.upper)[index]
        sums = np.zeros((len(self.outlines) + 1, len(Sum)))

        def evaluate(own: Array, _: Array, step: AnnealingStage) -> Equations:
            nonlocal sums
            theta = current.copy()
            theta[index] = own[0]
            if isinstance(seen, Views):
                compared = self.compare(seen, theta, step)
            else:
                compared = seen(self.body.place(theta), step)
            H, g = normal_equations(compared, len(theta))
            sums = compared.sums.sum(axis=0)
            cost = float(sums[:, Sum.COST].sum())
            if prior is not None:
                off = theta - prior.mean
                H, g = H + np.diag(prior.information), g + prior.information * off
                cost += float(prior.information @ off**2)
            return Equations(H[np.ix_(index, index)][None], g[index][None], cost)

        limits = self.lower[index], self.upper[index]
        own, _, cost, evaluations = minimise(
            evaluate, current[index][None], np.zeros(0), limits, rounds, self.steps
        )
        current[index] = own[0]
        return PoseFit(current, sums, cost, evaluations)

    def compare(self, views: Views, theta: Array, step: AnnealingStage) -> Comparison:
        """The contours at values (m,), or at all parameters, compared with all cameras' edges."""
        placement = self.body.place(theta)
        return compare_views(views, placement, self.weights(views.cameras, placement, step))

    def tile_costs(self, views: Views, theta: Array, step: AnnealingStage, side: float) -> Array:
        """(cameras, k, k) the cost at values (m,) by squares of the pictures of a side [pixel]."""
        placement = self.body.place(theta)
        weights = self.weights(views.cameras, placement, step)
        placed = placement.packed, placement.X_WN
        # Beyond 64 squares of a picture's rows and columns they are counted from 0 again.
        return np.asarray(compare_contours(*placed, *views, weights, 64, side, False)[3])

    def weights(
        self, cameras: tuple[Array, Array], placement: Placement, step: AnnealingStage
    ) -> Array:
        """(c, 4) of cameras, as `compare_contours` takes them."""
        return camera_weights(cameras, placement, step, self.noise, self._pixels)


def compare_views(
    views: Views, placement: Placement, weights: Array, widths: bool = False
) -> Comparison:
    """A body's contours, where it stands, compared with all cameras' edges.

    widths: whether derivatives by the silhouettes' widths are wanted.
    """
    placed = placement.packed, placement.X_WN
    A, b, sums, _, wide = compare_contours(*placed, *views, weights, 0, 1.0, widths)
    return Comparison(A, b, sums, wide, placement)


def camera_weights(
    cameras: tuple[Array, Array],
    placement: Placement,
    step: AnnealingStage,
    noise: Noise,
    pixels: float | Array | None = None,
) -> Array:
    """(c, 4) of cameras, as `compare_contours` takes them.

    ``pixels``: of the unit of length, of all cameras or (c,); None: the metre's at the root.
    """
    size = pixels_per_metre(cameras, placement.X_WN[0, :3, 3]) if pixels is None else pixels
    weights = np.empty((len(cameras[0]), 4))
    weights[:, 0] = 1.0 / size
    weights[:, 1] = np.maximum(FINEST_SCALE, step.scale * size)
    weights[:, 2] = np.maximum(1.0, step.spacing * size)
    # Both contours say the same: together they count as one.
    weights[:, 3] = 0.5 / (size * noise.correlation * (size * noise.deviation) ** 2)
    return weights


def normal_equations(compared: Comparison, size: int) -> tuple[Array, Array]:
    """The normal equations H dx = -g of a number of body parameters, of all cameras."""
    A, b = compared.A.sum(axis=0), compared.b.sum(axis=0)
    return collect(A, b, *compared.placement[2:], size)


def symmetric(A: Array) -> Array:
    """The symmetric matrices (..., n, n) of which the lower triangles are given."""
    return np.asarray(np.tril(A) + np.swapaxes(np.tril(A, -1), -1, -2))


def pixels_per_metre(cameras: tuple[Array, Array], place: Array) -> Array:
    """(c,) how large a metre at a place (3,) is in each picture [pixel/m]."""
    X_CW, parameters = cameras
    kind, focal, near = parameters[:, 0], parameters[:, 1], parameters[:, 5]
    depth = np.maximum(X_CW[:, 2, :3] @ place + X_CW[:, 2, 3], near)
    return np.asarray(focal / np.where(kind == 0.0, depth, 1.0))
