"""Fit one pose to all silhouettes at once, by comparing the contours of body and silhouettes.

The cost of tree values theta is

    C(theta) = w sum_i l_i r_i^2 / (1 + (r_i / s)^2) + (theta - m)^T P (theta - m)

with r_i the distance of a contour point from the other contour, l_i the length of contour that the
point represents, s the scale of the annealing stage, w the weight per unit of contour length, and m
and P the mean and information matrix of the prior.
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
from drake_pose.fit.kernel import Sum, assemble_normal_equations, compare_contours
from drake_pose.fit.levenberg_marquardt import AnnealingStage, Equations, StepSettings, minimise
from drake_pose.fit.parameters import BodyParameters, Placement
from drake_pose.fit.surfaces import VERY_FEW, simplify_surfaces
from drake_pose.silhouette.outline import Outline, TreeSurfaces

FINEST_SCALE = 1.5
"""Minimum scale of the residuals [pixel]: the resolution of silhouettes."""


@dataclass(frozen=True)
class Noise:
    """Errors of silhouettes, which determine the weight per unit of contour length."""

    deviation: float = 0.006  # Standard deviation of the distance between the contours [m].
    # Length of contour over which errors are correlated [m], scalar or (cameras,).
    correlation: float | Array = 0.06

    @classmethod
    def per_pixel(cls, pixels: float | Array) -> "Noise":
        """Return noise that gives each pixel of contour the weight one.

        Args:
            pixels: unit of length of the fit [pixel], scalar or (cameras,), as of ``ContourFit``.
        """
        return cls(deviation=1.0, correlation=0.5 / pixels**3)


@dataclass(frozen=True, eq=False)
class Prior:
    """Independent normal priors: mean (m,) [rad or m] and inverse variances (m,), 0 for none."""

    mean: Array
    information: Array


class Views(NamedTuple):
    """Cameras and the edges of their silhouettes in one frame."""

    # X_CW (c, 4, 4) and kernel parameters (c, 8), see ``pack_cameras``.
    cameras: tuple[Array, Array]
    evidence: Evidence  # Edges of the c silhouettes, in the same order.


class Comparison(NamedTuple):
    """Quadratic costs x^T A x - 2 b^T x of each node's affine motion x (12,), per camera."""

    A: Array  # (cameras, nodes, 12, 12) lower triangles.
    b: Array  # (cameras, nodes, 12).
    # (cameras, nodes + 1, 6) by ``Sum`` of each node's contour, and of the silhouette's edge in the
    # last row.
    sums: Array
    # (cameras, nodes, 13) derivatives by the boundary bias, as of `compare_contours`; 0 if they
    # were not requested.
    bias_terms: Array
    placement: Placement  # The body at the pose that was compared.

    @property
    def inlier_ratio(self) -> float:
        """Fraction of both contours' length whose residual is below the scale."""
        return inlier_ratio_of(self.sums)


Compare = Callable[[Placement, AnnealingStage], Comparison]
"""Function that compares a placed body's contours with evidence, at the scale of a stage."""


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A fitted pose."""

    values: Array  # (m,) tree values [rad or m].
    # (nodes + 1, 6) as of ``Comparison``, over all cameras, at the last comparison, which may be
    # that of a rejected step or precede a single step.
    sums: Array
    cost: float  # Cost at the last accepted comparison, including the prior.
    evaluations: int  # Number of comparisons.

    @property
    def inlier_ratio(self) -> float:
        """Fraction of both contours' length whose residual is below the scale."""
        return inlier_ratio_of(self.sums)

    @property
    def closeness(self) -> float:
        """Score of a fit, 0 to 1: mean of 1 / (1 + (r / s)^2) along both contours."""
        total = self.sums.sum(axis=0)
        return float(total[Sum.CLOSE] / max(total[Sum.COMPARED], 1e-9))


def inlier_ratio_of(sums: Array) -> float:
    """Return the fraction of both contours' length whose residual is below the scale.

    Args:
        sums: (..., 6) by ``Sum``; the leading axes are summed.
    """
    total = sums.reshape(-1, sums.shape[-1]).sum(axis=0)
    return float(total[Sum.FITTING] / max(total[Sum.COMPARED], 1e-9))


def pack_views(cameras: Sequence[Camera], edges: Sequence[EdgePoints]) -> Views:
    """Return cameras and the edge of each one's silhouette, which may be empty, for kernels."""
    return Views(pack_cameras(cameras), pack_evidence(edges))


def pack_cameras(cameras: Sequence[Camera]) -> tuple[Array, Array]:
    """Return X_CW (c, 4, 4) and ``Camera.kernel_parameters`` (c, 8) of c cameras."""
    return (
        np.array([camera.X_CW for camera in cameras]).reshape(-1, 4, 4),
        np.array([camera.kernel_parameters() for camera in cameras]).reshape(-1, 8),
    )


class ContourFit:
    """Fits the values of a body's pose tree to the silhouettes of several cameras.

    Attributes:
        lower, upper: (m,) limits [rad or m]; infinite for angles without limits.

    Args:
        tree: the body's pose tree, or its kinematics.
        outlines: surface of each node, preferably with few triangles; None: simplified surfaces of
            the tree.
        noise: errors of the silhouettes; None: ``Noise()``.
        steps: settings of the optimiser's steps; None: ``StepSettings()``.
        pixels: unit of length of the stages and the noise [pixel], scalar or (c,); None: the size
            of a metre at the body's root.
        body: parameters of the body; None: the tree's values and ROOT_NAMES.
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
        evidence: Views | Compare,
        values: Array,
        stages: Sequence[AnnealingStage],
        prior: Prior | None = None,
        held: Mask | None = None,
    ) -> PoseFit:
        """Fit a pose.

        Args:
            evidence: the cameras and their silhouettes' edges, or a function that compares the
                contours.
            values: (m,) initial guess [rad or m]; those not fixed are moved into their limits.
            stages: annealing stages in order, coarse to fine [``pixels`` or m].
            prior: prior of the m values; None: none.
            held: (m,) which values are fixed; None: none.
        """
        index = np.flatnonzero(np.ones(len(values), bool) if held is None else ~held)
        current = np.array(values, dtype=np.float64)
        current[index] = np.clip(values, self.lower, self.upper)[index]
        sums = np.zeros((len(self.outlines) + 1, len(Sum)))

        def evaluate(own: Array, _: Array, stage: AnnealingStage) -> Equations:
            nonlocal sums
            theta = current.copy()
            theta[index] = own[0]
            if isinstance(evidence, Views):
                compared = self.compare(evidence, theta, stage)
            else:
                compared = evidence(self.body.place(theta), stage)
            H, g = normal_equations(compared, len(theta))
            sums = compared.sums.sum(axis=0)
            cost = float(sums[:, Sum.COST].sum())
            if prior is not None:
                deviation = theta - prior.mean
                H, g = H + np.diag(prior.information), g + prior.information * deviation
                cost += float(prior.information @ deviation**2)
            return Equations(H[np.ix_(index, index)][None], g[index][None], cost)

        limits = self.lower[index], self.upper[index]
        own, _, cost, evaluations = minimise(
            evaluate, current[index][None], np.zeros(0), limits, stages, self.steps
        )
        current[index] = own[0]
        return PoseFit(current, sums, cost, evaluations)

    def compare(self, views: Views, theta: Array, stage: AnnealingStage) -> Comparison:
        """Compare the contours with all cameras' edges at theta and the scale of a stage.

        ``theta``: (m,) tree values, or (n,) all parameters. ``stage``: in ``pixels`` or m.
        """
        placement = self.body.place(theta)
        return compare_views(views, placement, self.weights(views.cameras, placement, stage))

    def tile_costs(self, views: Views, theta: Array, stage: AnnealingStage, side: float) -> Array:
        """Return the cost (cameras, 64, 64) in image tiles at theta (m,) or (n,), without prior.

        ``stage``: in ``pixels`` or m. ``side``: of a tile [pixel]; indices are taken modulo 64.
        """
        placement = self.body.place(theta)
        weights = self.weights(views.cameras, placement, stage)
        placed = placement.packed, placement.X_WN
        return np.asarray(compare_contours(*placed, *views, weights, 64, side, False)[3])

    def weights(
        self, cameras: tuple[Array, Array], placement: Placement, stage: AnnealingStage
    ) -> Array:
        """Return (c, 4) weights of cameras by ``camera_weights``, with this fit's noise and unit.

        ``cameras``: X_CW (c, 4, 4) and kernel parameters (c, 8). ``stage``: in ``pixels`` or m.
        """
        return camera_weights(cameras, placement, stage, self.noise, self._pixels)


def compare_views(
    views: Views, placement: Placement, weights: Array, with_bias: bool = False
) -> Comparison:
    """Compare a placed body's contours with all cameras' edges.

    ``weights``: (c, 4), see ``camera_weights``. ``with_bias``: compute derivatives by the boundary
    bias; else they are 0.
    """
    placed = placement.packed, placement.X_WN
    A, b, sums, _, bias_terms = compare_contours(*placed, *views, weights, 0, 1.0, with_bias)
    return Comparison(A, b, sums, bias_terms, placement)


def camera_weights(
    cameras: tuple[Array, Array],
    placement: Placement,
    stage: AnnealingStage,
    noise: Noise,
    pixels: float | Array | None = None,
) -> Array:
    """Return (c, 4) weights of cameras, as `compare_contours` takes them.

    Columns: units of length per pixel; scale of the cost [pixel], at least FINEST_SCALE; spacing
    of the body's contour points [pixel], at least 1; and weight per pixel of length of either
    contour, half of that of the noise.

    Args:
        cameras: X_CW (c, 4, 4) and kernel parameters (c, 8).
        placement: the body, whose root gives the default unit of length.
        stage: scale and spacing [unit of length].
        noise: errors of the silhouettes [unit of length].
        pixels: unit of length [pixel], scalar or (c,); None: the size of a metre at the root.
    """
    size = pixels_per_metre(cameras, placement.X_WN[0, :3, 3]) if pixels is None else pixels
    weights = np.empty((len(cameras[0]), 4))
    weights[:, 0] = 1.0 / size
    weights[:, 1] = np.maximum(FINEST_SCALE, stage.scale * size)
    weights[:, 2] = np.maximum(1.0, stage.spacing * size)
    # Residuals are computed from both contours, so each gets half of the weight.
    weights[:, 3] = 0.5 / (size * noise.correlation * (size * noise.deviation) ** 2)
    return weights


def normal_equations(compared: Comparison, size: int) -> tuple[Array, Array]:
    """Return H (size, size), g (size,) of H dx = -g for the body's parameters, over cameras."""
    A, b = compared.A.sum(axis=0), compared.b.sum(axis=0)
    return assemble_normal_equations(A, b, *compared.placement[2:], size)


def symmetric(A: Array) -> Array:
    """Return symmetric matrices (..., n, n) with the lower triangles of A, ignoring the upper."""
    return np.asarray(np.tril(A) + np.swapaxes(np.tril(A, -1), -1, -2))


def pixels_per_metre(cameras: tuple[Array, Array], place: Array) -> Array:
    """Return (c,) the size of a metre in each image [pixel/m], at a point in the world.

    Args:
        cameras: X_CW (c, 4, 4) and kernel parameters (c, 8).
        place: (3,) the point [m]; depths below a camera's near plane count as the near plane.
    """
    X_CW, parameters = cameras
    kind, focal, near = parameters[:, 0], parameters[:, 1], parameters[:, 5]
    depth = np.maximum(X_CW[:, 2, :3] @ place + X_CW[:, 2, 3], near)
    return np.asarray(focal / np.where(kind == 0.0, depth, 1.0))
