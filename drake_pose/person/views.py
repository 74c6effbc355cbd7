"""Several cameras' observations of a person in one frame, and the rays of their pixels.

`FrameViews` compares a body's contours with the edges of silhouettes.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.compiled import compiled
from drake_pose.fit.contour_fit import (
    Comparison,
    ContourFit,
    Views,
    compare_views,
    pack_views,
    pixels_per_metre,
)
from drake_pose.fit.evidence import EdgePoints, find_edge_points
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import Placement

EDGE_POINTS = 120.0
"""Number of edge points per picture height by default."""


@dataclass(frozen=True, eq=False)
class SilhouetteView:
    """A camera's region of the person (H, W), and points of the region's edge."""

    region: Mask
    edge: EdgePoints


def see_silhouette(region: Mask, spacing: float) -> SilhouetteView:
    """Return the view of a person's region (H, W), its edge points `spacing` pixels apart."""
    return SilhouetteView(region, find_edge_points(region, spacing))


def edge_spacing(camera: Camera, edge_points: float = EDGE_POINTS) -> float:
    """Return the spacing of edge points for a camera [pixel]: height / `edge_points`, 2 or more."""
    return max(2.0, camera.height / edge_points)


def shows_somebody(view: SilhouetteView | None, least: float = 0.15) -> bool:
    """Return whether a view shows more than a speck: searching a person in specks takes seconds.

    The silhouette's edge must be at least as long as the fraction `least` of the picture's height.
    None, a camera without a view, shows no person.
    """
    return view is not None and float(view.edge.lengths.sum()) >= least * len(view.region)


@dataclass(frozen=True, eq=False)
class FrameViews:
    """The cameras that have a picture in a frame, and the silhouette seen by each of them."""

    cameras: Sequence[Camera]
    views: Sequence[SilhouetteView]

    @property
    def pairs(self) -> list[tuple[Camera, SilhouetteView]]:
        """(camera, view) of all cameras."""
        return list(zip(self.cameras, self.views, strict=True))

    @property
    def showing(self) -> list[str]:
        """Names of the cameras whose silhouette is more than a speck."""
        return [camera.name for camera, view in self.pairs if shows_somebody(view)]

    def without(self, names: Collection[str]) -> "FrameViews":
        """Return the views of all cameras but those named."""
        pairs = [pair for pair in self.pairs if pair[0].name not in names]
        return FrameViews([camera for camera, _ in pairs], [view for _, view in pairs])

    def compare(self, fit: ContourFit, placement: Placement, step: AnnealingStage) -> Comparison:
        """Compare a body's contours with the silhouettes' edges in all cameras.

        `fit` weighs them by its noise, at the scale and spacing of `step`.
        """
        weights = fit.weights(self._packed.cameras, placement, step)
        return compare_views(self._packed, placement, weights)

    def tile_costs(self, fit: ContourFit, values: Array, step: AnnealingStage) -> Array:
        """Return the cost (cameras, 64, 64) of a pose (m,) in image tiles without prior.

        A tile's side is twice the length over which the errors of silhouettes are correlated.
        """
        place = fit.body.place(values).X_WN[0, :3, 3]
        size = float(pixels_per_metre(self._packed.cameras, place).mean())
        side = max(1.0, 2.0 * float(np.mean(fit.noise.correlation)) * size)
        return fit.tile_costs(self._packed, values, step, side)

    @cached_property
    def _packed(self) -> Views:
        return pack_views(self.cameras, [view.edge for view in self.views])

    @cached_property
    def nonempty(self) -> list[int]:
        """Indices of the cameras whose silhouette is not empty."""
        return [k for k, view in enumerate(self.views) if len(view.edge.uv)]

    @cached_property
    def scoring(self) -> list[int]:
        """Indices of at most five cameras, spread over `nonempty`, that score coarse guesses."""
        count = min(5, len(self.nonempty))
        chosen = np.linspace(0, len(self.nonempty), count, endpoint=False).astype(int)
        return [self.nonempty[k] for k in chosen]

    @cached_property
    def scoring_regions(self) -> tuple[list[Camera], list[Mask]]:
        """The scoring cameras and their regions, subsampled to about 120 rows of pixels."""
        strides = {k: max(1, len(self.views[k].region) // 120) for k in self.scoring}
        return (
            [_coarser(self.cameras[k], n) for k, n in strides.items()],
            [self.views[k].region[::n, ::n] for k, n in strides.items()],
        )

    @cached_property
    def scoring_edges(self) -> Views:
        """The scoring cameras and every other point of their edges."""
        edges = [self.views[k].edge for k in self.scoring]
        return pack_views(
            [self.cameras[k] for k in self.scoring],
            [
                EdgePoints(edge.uv[::2], edge.normals[::2], 2.0 * edge.lengths[::2], edge.middle)
                for edge in edges
            ],
        )

    def middle(self) -> Array | None:
        """Return where the person is (3,) [m]; None: fewer than two silhouettes are not empty."""
        if len(self.nonempty) < 2:
            return None
        return triangulate(
            [self.cameras[k] for k in self.nonempty],
            [self.views[k].edge.middle for k in self.nonempty],
        )


def _coarser(camera: Camera, stride: int) -> Camera:
    """Return a camera whose pictures are reduced to every stride-th row and column."""
    smaller = replace(
        camera,
        width=-(-camera.width // stride),
        height=-(-camera.height // stride),
        center_x=camera.center_x / stride,
        center_y=camera.center_y / stride,
    )
    if isinstance(smaller, ParallelCamera):
        return replace(smaller, pixels_per_metre=smaller.pixels_per_metre / stride)
    return replace(smaller, focal_x=smaller.focal_x / stride, focal_y=smaller.focal_y / stride)


def viewing_rays(camera: Camera, uv: Array) -> tuple[Array, Array]:
    """Return origins (n, 3) [m] and unit directions (n, 3), in the world, of pixels uv (n, 2)."""
    pixels = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
    R, p = camera.X_WC[:3, :3], camera.X_WC[:3, 3]
    off = pixels - [camera.center_x, camera.center_y]
    if isinstance(camera, ParallelCamera):
        origins = p + (off / camera.pixels_per_metre) @ R[:, :2].T
        return origins, np.tile(R[:, 2], (len(pixels), 1))
    local = np.column_stack([off / [camera.focal_x, camera.focal_y], np.ones(len(pixels))])
    directions = local @ R.T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.tile(p, (len(pixels), 1)), directions


def meeting_points(
    cameras: Sequence[Camera],
    pixels: Sequence[Array],
    threshold: float,
    free: Sequence[Mask] | None = None,
) -> Array:
    """Return the points (m, 3) [m] half-way between rays of two views that nearly meet.

    All pairs of pixels of all pairs of views are tried. Points lie in front of both cameras.

    Args:
        cameras: of the views.
        pixels: (n_k, 2) pixels in each camera's picture.
        threshold: largest distance of two rays [m].
        free: (n_k,) which pixels of each camera may form a pair; the other one of the pair may be
            any. None: all may.
    """
    rays = [viewing_rays(camera, uv) for camera, uv in zip(cameras, pixels, strict=True)]
    sides: list[list[Array]] = [[], [], [], []]
    for a, b in combinations(range(len(rays)), 2):
        i, j = np.indices((len(rays[a][0]), len(rays[b][0]))).reshape(2, -1)
        if free is not None:
            wanted = free[a][i] | free[b][j]
            i, j = i[wanted], j[wanted]
        ends = rays[a][0][i], rays[a][1][i], rays[b][0][j], rays[b][1][j]
        for side, end in zip(sides, ends, strict=True):
            side.append(end)
    if not sides[0]:
        return np.empty((0, 3))
    p_a, u_a, p_b, u_b = (np.concatenate(side) for side in sides)
    across = p_b - p_a
    cosine = np.einsum("ij,ij->i", u_a, u_b)
    along_a = np.einsum("ij,ij->i", u_a, across)
    along_b = np.einsum("ij,ij->i", u_b, across)
    sine_squared = 1.0 - cosine**2
    usable = sine_squared > 1e-6
    divisor = np.where(usable, sine_squared, 1.0)
    t_a = (along_a - cosine * along_b) / divisor
    t_b = (cosine * along_a - along_b) / divisor
    p_a, p_b = p_a + t_a[:, None] * u_a, p_b + t_b[:, None] * u_b
    # Both points must lie in front of their cameras, and the rays must not be parallel.
    usable &= (t_a > 0.0) & (t_b > 0.0) & (np.linalg.norm(p_a - p_b, axis=1) <= threshold)
    return np.asarray(0.5 * (p_a + p_b))[usable]


def triangulate(cameras: Sequence[Camera], pixels: Sequence[Array]) -> Array:
    """Return the point (3,) [m] nearest to the rays of a pixel (2,) in two or more cameras."""
    seen = [k for k, uv in enumerate(pixels) if not np.isnan(uv).any()]
    rays = [viewing_rays(cameras[k], pixels[k]) for k in seen]
    origins, directions = np.array(rays).reshape(-1, 2, 3).transpose(1, 0, 2)
    # A ray determines the point across its direction only.
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    p = (across @ origins[..., None])[..., 0]
    return np.asarray(np.linalg.lstsq(across.sum(axis=0), p.sum(axis=0), rcond=None)[0])


def sum_at_points(
    camera: Camera, picture: NDArray[np.int8], points: Array, weights: Array
) -> tuple[Array, Array]:
    """Sum a picture's values at projected points.

    ``picture``: (H, W) values of the camera's pixels. ``points``: (n, m, 3) n sets of m points in
    the world [m]. ``weights``: (n, m) weights of the points. Returns (n,) weighted sums of the
    picture's values, and (n,) summed weights of the points inside the picture.
    """
    X_CW = np.ascontiguousarray(camera.X_CW)
    total: tuple[Array, Array] = _sum_at_points(
        camera.kernel_parameters(), X_CW, picture, points, weights
    )
    return total


@compiled
def _sum_at_points(
    camera: Array, X_CW: Array, picture: NDArray[np.int8], points: Array, weights: Array
) -> tuple[Array, Array]:
    """`sum_at_points` for a camera with kernel parameters (8,) and pose X_CW (4, 4)."""
    height, width = picture.shape
    sums, seen, P = np.zeros(points.shape[0]), np.zeros(points.shape[0]), np.empty((3, 4))
    # P maps a point to (column, row, 1) times its depth: lens and camera pose in one matrix.
    parallel = camera[0] != 0.0
    for c in range(4):
        P[2, c] = X_CW[2, c] if not parallel else 1.0 * (c == 3)
        for r in range(2):
            P[r, c] = camera[1 + r] * X_CW[r, c] + (camera[3 + r] + 0.5) * P[2, c]
    p00, p01, p02, p03 = P[0, 0], P[0, 1], P[0, 2], P[0, 3]
    p10, p11, p12, p13 = P[1, 0], P[1, 1], P[1, 2], P[1, 3]
    p20, p21, p22, p23 = P[2, 0], P[2, 1], P[2, 2], P[2, 3]
    nearest = 0.0 if parallel else max(camera[5], 1e-300)
    for n in range(points.shape[0]):
        total = within = 0.0
        for m in range(points.shape[1]):
            x, y, z = points[n, m, 0], points[n, m, 1], points[n, m, 2]
            depth = p20 * x + p21 * y + p22 * z + p23
            share = 1.0 / depth if depth >= nearest else -1.0
            u = (p00 * x + p01 * y + p02 * z + p03) * share
            v = (p10 * x + p11 * y + p12 * z + p13) * share
            if share > 0.0 and 0.0 <= u < width and 0.0 <= v < height:
                total += weights[n, m] * picture[int(v), int(u)]
                within += weights[n, m]
        sums[n], seen[n] = total, within
    return sums, seen
