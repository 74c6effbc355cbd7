"""The axes of segments from label images, and as an observation of a pose: (11) and (12)."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.errors import MaskError, SettingsError
from drake_pose.filtering.kalman.update import difference
from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.state import Belief
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

Array = NDArray[np.float64]
Labels = NDArray[np.int16]
Ends = tuple[Array, Array]

_FEWEST_PIXELS = 12
# How far a segment's edge in the image is from where it belongs, and how much of an edge errs
# together [pixel]. A segment of whose area less than the last share is seen, in the picture or at
# the rough pose, is occluded: it is left out.
_EDGE_DEVIATION, _CORRELATION, _SMALLEST_SHARE = 0.7, 3.0, 0.7
# A segment that points at the camera shows no axis [pixel].
_SHORTEST = 5.0
_STEP = 1e-5


@dataclass(frozen=True, eq=False)
class Axis:
    """A segment's axis in the image: points with rho = v cos(alpha) - u sin(alpha).

    Attributes:
        alpha: angle of the axis from the u axis towards v, from its start to its end [rad].
        rho: distance from the origin, signed [pixel].
        covariance: (2, 2) of alpha and rho.
        share: how much of the segment's area was seen.
    """

    alpha: float
    rho: float
    covariance: Array
    share: float


@dataclass(frozen=True, eq=False)
class _Fit:
    """The principal axis of a region: its centre, direction, length and how sure these are."""

    centre: Array
    direction: Array
    length: float
    angle_variance: float
    sideways_variance: float
    count: int


def _correct(uv: Array, seen: _Fit, drawn: _Fit) -> Axis:
    """The axis of the rough pose, from uv[0] to uv[1], moved as the region moved."""
    along = uv[1] - uv[0]
    alpha = math.atan2(along[1], along[0])
    turn = math.atan2(seen.direction[1], seen.direction[0]) - math.atan2(
        drawn.direction[1], drawn.direction[0]
    )
    # The direction of a region has no sign.
    turn = math.remainder(turn, math.pi)
    shift = seen.centre - drawn.centre
    # The axis' point beside the region's centre moves with the region.
    unit = along / float(np.linalg.norm(along))
    foot = uv[0] + unit * float(unit @ (drawn.centre - uv[0])) + shift
    alpha = math.remainder(alpha + turn, 2 * math.pi)
    c, s = math.cos(alpha), math.sin(alpha)
    rho = c * foot[1] - s * foot[0]
    # rho changes with alpha by minus the distance along the axis.
    reach = -(c * foot[0] + s * foot[1])
    a, b = seen.angle_variance, seen.sideways_variance
    covariance = np.array([[a, reach * a], [reach * a, b + reach**2 * a]])
    return Axis(alpha, float(rho), covariance, seen.count / drawn.count)


class AxisObservation:
    """What a camera sees of segments' axes: alpha [rad] and rho [pixel] of each.

    Args:
        body: turns a state into a pose; its tree's root stays where the tree holds it.
        axes: start and end of each segment's axis (3,), (3,) in its link's frame, by name [m].
        origin: (2,) where the image's origin is for rho [pixel]; the nearer to the segments, the
            more rho tells.

    Attributes:
        names: (m) ``alpha_<link>`` and ``rho_<link>`` of each segment.
        variances: (m,) of the noise, where a frame does not say its own.
        wraps: (m,) true for alpha.

    Raises:
        SettingsError: no axis; or the root moves beside the plant's own positions.
        UnknownNameError: there is no segment of such a name.
    """

    def __init__(
        self,
        body: ContourObservation,
        camera: Camera,
        axes: Mapping[str, Ends],
        origin: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        if not axes:
            raise SettingsError("an observation of axes needs one segment or more")
        tree = body.tree
        _, X_WB = tree.positions_from(tree.default_values())
        if not np.allclose(X_WB, np.eye(4), atol=1e-9):
            raise SettingsError(f"{tree.model.path}: the root moves beside the plant's positions")
        self.body, self._renderer = body, LabelRenderer(tree.model, camera)
        self._camera, self._origin = camera, np.array(origin, dtype=np.float64)
        self._kinematics = TreeKinematics(tree)
        self._nodes = [tree.node_index(name) for name in axes]
        self._ends = np.array([axes[name] for name in axes], dtype=np.float64)
        self.links = tuple(axes)
        self.names = tuple(f"{kind}_{name}" for name in axes for kind in ("alpha", "rho"))
        self.variances = np.tile([math.radians(2.0) ** 2, 2.0**2], len(axes))
        self.wraps = np.tile([True, False], len(axes))

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Axes (m,) at a state (n,), NaN where too short; Jacobian by central differences."""
        h = self._axes_at(x)
        H = np.zeros((len(h), len(x)))
        for k, step in enumerate(_STEP * np.eye(len(x))[: len(self.body.layout.moving)]):
            change = difference(self._axes_at(x + step), self._axes_at(x - step), self.wraps)
            H[:, k] = change / (2 * _STEP)
        return h, H

    def mirrors(self, belief: Belief) -> list[Array]:
        """None."""
        return []

    def measure(self, labels: Labels, x: Array) -> tuple[Array, Array]:
        """Measure the axes in a label image (H, W) beside a rough state (n,).

        An axis' alpha and rho err together. Their variances are given out so large that two
        independent errors of these sizes cover the joint one.

        Returns:
            The measurement (m,) and its variances (m,); NaN where a segment is occluded.

        Raises:
            MaskError: an image that is not of the camera's size.
        """
        y = np.full((len(self.links), 2), np.nan)
        variances = y.copy()
        found = self.measure_labels(labels, self.body.positions(x)[0])
        for k, name in enumerate(self.links):
            if name in found:
                y[k] = found[name].alpha, found[name].rho
                variances[k] = _independent(found[name])
        return y.ravel(), variances.ravel()

    def measure_labels(self, labels: Labels, q: Array) -> dict[str, Axis]:
        """Axes of segments seen well enough in a label image (H, W) of links, -1 for none.

        The principal axis of a segment's pixels is not its axis where a neighbour covers one end
        of it obliquely. So a rough pose q (nq,), within some degrees, is drawn and measured in the
        same way: how much the picture differs from the drawing corrects the axis of that pose.

        Raises:
            MaskError: an image that is not of the camera's size.
        """
        size = (self._camera.height, self._camera.width)
        if labels.shape != size:
            raise MaskError(
                f"camera '{self._camera.name}': an image of {labels.shape[::-1]} pixels, "
                f"{size[::-1]} expected"
            )
        rough, poses = self._renderer.segments(q), self._renderer.link_poses(q)
        found = {}
        for name, ends in zip(self.links, self._ends, strict=True):
            link = self.body.tree.model.link_index(name)
            X = poses[link]
            uv = self._camera.project(ends @ X[:3, :3].T + X[:3, 3])[0] - self._origin
            seen, drawn = (self._fit(image == link) for image in (labels, rough))
            if seen is None or drawn is None:
                continue
            share = seen.count / drawn.count
            if not _SMALLEST_SHARE < share < 1 / _SMALLEST_SHARE:
                continue
            # A segment that another covers at the rough pose is much shorter than its axis.
            if drawn.length < _SMALLEST_SHARE * float(np.linalg.norm(uv[1] - uv[0])):
                continue
            found[name] = _correct(uv, seen, drawn)
        return found

    def _fit(self, pixels: NDArray[np.bool_]) -> "_Fit | None":
        v, u = np.nonzero(pixels)
        if len(u) < _FEWEST_PIXELS:
            return None
        points = np.column_stack([u, v]) - self._origin
        centre = points.mean(axis=0)
        values, vectors = np.linalg.eigh(np.cov(points.T))
        # A rectangle's standard deviation is its length over the root of 12.
        length, width = math.sqrt(12 * values[1]), math.sqrt(12 * max(values[0], 1e-12))
        if length < 1.3 * width:
            return None
        # The middle between two edges, at length / correlation independent places.
        sideways = 0.5 * _EDGE_DEVIATION**2 * _CORRELATION / length
        return _Fit(centre, vectors[:, 1], length, 12 * sideways / length**2, sideways, len(u))

    def _axes_at(self, x: Array) -> Array:
        values = self._kinematics.flatten(self.body.node_values(x))
        X_WN = self._kinematics.poses(values)[self._nodes]
        p_W = np.einsum("kij,kej->kei", X_WN[:, :3, :3], self._ends) + X_WN[:, None, :3, 3]
        uv = self._camera.project(p_W.reshape(-1, 3))[0].reshape(-1, 2, 2) - self._origin
        along = uv[:, 1] - uv[:, 0]
        alpha = np.arctan2(along[:, 1], along[:, 0])
        rho = np.cos(alpha) * uv[:, 0, 1] - np.sin(alpha) * uv[:, 0, 0]
        h = np.column_stack([alpha, rho])
        h[np.linalg.norm(along, axis=1) < _SHORTEST] = np.nan
        return h.ravel()


def _independent(axis: Axis) -> Array:
    """(2,) variances whose diagonal matrix is no smaller than the axis' covariance."""
    a, c, d = axis.covariance[0, 0], axis.covariance[0, 1], axis.covariance[1, 1]
    return np.array([2 * a, d + c**2 / a])
