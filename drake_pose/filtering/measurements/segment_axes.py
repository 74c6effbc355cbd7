"""The axes of segments from label images: (11) and (12) of Shimada et al."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.parsed_model import ParsedModel
from drake_pose.camera.models import Camera
from drake_pose.errors import MaskError, SettingsError
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

Array = NDArray[np.float64]
Labels = NDArray[np.int16]
Ends = tuple[Array, Array]

_FEWEST_PIXELS = 12


@dataclass(frozen=True)
class AxisSettings:
    """How axes are measured.

    Args:
        edge_deviation: how far a segment's edge in the image is from where it belongs [pixel].
        correlation: how much of an edge [pixel] errs together.
        smallest_share: a segment of whose area less than this is seen, in the picture or at the
            rough pose, is occluded: it is left out.

    Raises:
        SettingsError: a number that is not positive.
    """

    edge_deviation: float = 0.7
    correlation: float = 3.0
    smallest_share: float = 0.7

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 < value < math.inf:
                raise SettingsError(f"{name} must be positive, not {value}")


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


class AxisObserver:
    """Measures the axes of a body's segments beside a rough pose of it, such as a matcher's.

    The principal axis of a segment's pixels is not its axis where a neighbour covers one end of it
    obliquely. The rough pose is drawn, and measured in the same way: how much the picture differs
    from the drawing corrects the axis of the rough pose.

    Args:
        axes: start and end of each segment's axis (3,), (3,) in the frame of its link, by the
            link's name [m].
        origin: (2,) where the image's origin is for rho [pixel].

    Raises:
        UnknownNameError: there is no link of such a name.
    """

    def __init__(
        self,
        model: ParsedModel,
        camera: Camera,
        axes: Mapping[str, Ends],
        origin: tuple[float, float] = (0.0, 0.0),
        settings: AxisSettings | None = None,
    ) -> None:
        self._renderer, self._camera = LabelRenderer(model, camera), camera
        self._links = {name: model.link_index(name) for name in axes}
        self._axes, self._origin = dict(axes), np.array(origin, dtype=np.float64)
        self._settings = settings or AxisSettings()

    def measure_labels(self, labels: Labels, q: Array) -> dict[str, Axis]:
        """Axes in a label image (H, W): the link at each pixel, -1 where none is.

        Args:
            labels: see ``LabelRenderer.segments``.
            q: (nq,) the rough pose, within some degrees.

        Returns:
            The axis of each segment that is seen well enough.

        Raises:
            MaskError: an image that is not of the camera's size.
        """
        self._check_size(labels)
        return self._measure(labels, self._renderer.segments(q), q)

    def _check_size(self, image: NDArray[np.generic]) -> None:
        expected = (self._camera.height, self._camera.width)
        if image.shape != expected:
            raise MaskError(
                f"camera '{self._camera.name}': an image of {image.shape[::-1]} pixels, "
                f"{expected[::-1]} expected"
            )

    def _measure(self, labels: Labels, rough: Labels, q: Array) -> dict[str, Axis]:
        poses = self._renderer.link_poses(q)
        found = {}
        for name, link in self._links.items():
            X, ends = poses[link], np.array(self._axes[name])
            uv = self._camera.project(ends @ X[:3, :3].T + X[:3, 3])[0] - self._origin
            seen, drawn = (self._fit(image == link) for image in (labels, rough))
            if seen is None or drawn is None:
                continue
            share = seen.count / drawn.count
            if not self._settings.smallest_share < share < 1 / self._settings.smallest_share:
                continue
            # A segment that another covers at the rough pose is much shorter than its axis.
            if drawn.length < self._settings.smallest_share * float(np.linalg.norm(uv[1] - uv[0])):
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
        settings = self._settings
        sideways = 0.5 * settings.edge_deviation**2 * settings.correlation / length
        return _Fit(centre, vectors[:, 1], length, 12 * sideways / length**2, sideways, len(u))


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
