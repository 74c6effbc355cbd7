"""The axes of any body's segments as an observation of its pose: (11) and (12)."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.measurements.segment_axes import Axis, AxisObserver, AxisSettings, Ends
from drake_pose.filtering.state import Belief

Array = NDArray[np.float64]

# A segment that points at the camera shows no axis [pixel].
_SHORTEST = 5.0
_STEP = 1e-5


class AxisObservation:
    """What a camera sees of segments' axes: alpha [rad] and rho [pixel] of each.

    Args:
        body: turns a state into a pose; its tree's root stays where the tree holds it.
        axes: start and end of each segment's axis (3,), (3,) in its link's frame, by name [m].
        origin: (2,) where the image's origin is for rho [pixel]; the nearer to the segments, the
            more rho tells.
        settings: how axes are measured, and how well.

    Attributes:
        observer: measures the axes in a label image.
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
        settings: AxisSettings | None = None,
    ) -> None:
        if not axes:
            raise SettingsError("an observation of axes needs one segment or more")
        tree = body.tree
        _, X_WB = tree.positions_from(tree.default_values())
        if not np.allclose(X_WB, np.eye(4), atol=1e-9):
            raise SettingsError(f"{tree.model.path}: the root moves beside the plant's positions")
        self.body, self.observer = body, AxisObserver(tree.model, camera, axes, origin, settings)
        self._camera, self._origin = camera, np.array(origin, dtype=np.float64)
        self._kinematics = TreeKinematics(tree)
        self._nodes = [tree.node_index(name) for name in axes]
        self._ends = np.array([axes[name] for name in axes], dtype=np.float64)
        self._links = tuple(axes)
        self.names = tuple(f"{kind}_{name}" for name in axes for kind in ("alpha", "rho"))
        self.variances = np.tile([math.radians(2.0) ** 2, 2.0**2], len(axes))
        self.wraps = np.tile([True, False], len(axes))

    @property
    def links(self) -> tuple[str, ...]:
        """The segments, in the order of their measurements."""
        return self._links

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Axes (m,) at a state (n,), NaN for a segment too short in the image; and their Jacobian.

        The Jacobian (m, n) is by central differences.
        """
        h = self._axes_at(x)
        H = np.zeros((len(h), len(x)))
        layout = self.body.layout
        for name in (*layout.moving, *layout.constant):
            step = np.zeros_like(x)
            step[layout.index(name)] = _STEP
            change = self._axes_at(x + step) - self._axes_at(x - step)
            change[self.wraps] = np.remainder(change[self.wraps] + np.pi, 2 * np.pi) - np.pi
            H[:, layout.index(name)] = change / (2 * _STEP)
        return h, H

    def mirrors(self, belief: Belief) -> list[Array]:
        """None."""
        return []

    def measure(self, labels: NDArray[np.int16], x: Array) -> tuple[Array, Array]:
        """Measure the axes in a label image (H, W) beside a rough state (n,).

        An axis' alpha and rho err together. Their variances are given out so large that two
        independent errors of these sizes cover the joint one.

        Returns:
            The measurement (m,) and its variances (m,); NaN where a segment is occluded.

        Raises:
            MaskError: an image that is not of the camera's size.
        """
        y = np.full((len(self._links), 2), np.nan)
        variances = y.copy()
        found = self.observer.measure_labels(labels, self.body.positions(x)[0])
        for k, name in enumerate(self._links):
            if name in found:
                y[k] = found[name].alpha, found[name].rho
                variances[k] = _independent(found[name])
        return y.ravel(), variances.ravel()

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
