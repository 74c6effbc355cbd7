"""What cameras see of a person at a moment: silhouettes, here or elsewhere, or else colours.

A silhouette is as few bytes for the way as it can be. Where there is none, colours along lines say
where the edge is; lines are as wide as the fit's scale, and colours count on both sides.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.compiled import compiled
from drake_pose.fit.colours import check_picture, compare_lines, learn_colours, no_colours
from drake_pose.fit.contour_fit import (
    Comparison,
    ContourFit,
    Views,
    compare_views,
    pack_cameras,
    pack_views,
    pixels_per_metre,
)
from drake_pose.fit.evidence import EdgePoints, find_edge_points
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import Placement

# By camera (nodes, 3, COLOURS): what is known of the colours on a body's parts and beside them.
KnownColours = Mapping[str, NDArray[np.float32]]

# Lengths [m] are those seen at the body's root. Of lines along the contour; colours are counted so
# far inside of the edge, and outside of it, from offset to offset.
_SPACING, _WIDTHS, _COUNTED = 0.015, (0.05, 0.10), 0.006
# Lines on which the edge seems to be further from the contour than this teach nothing.
_AGREEING = 0.03
# The share of a frame's colours in what is known after it.
_RATE = 0.1
# From offset to offset of a line, as a share of the fit's scale: the window is as wide as that.
_STEP = 0.2
# In small pictures colours are counted so far inside and outside all the same, and edges that are
# so far off are believed [pixel].
_LEAST_WIDTHS, _LEAST_AGREEING = (6.0, 12.0), 2.5


class ColourViews:
    """Pictures (H, W, 3 or 4) of a moment, to be compared with a person of whom colours are known.

    Args:
        cameras, pictures: by name; only cameras that have a picture are kept.
        known: a camera that is not in it says nothing.

    Raises:
        SettingsError: pictures that do not fit the cameras.
    """

    def __init__(
        self, cameras: Sequence[Camera], pictures: Sequence[Picture], known: KnownColours
    ) -> None:
        self.cameras = tuple(cameras)
        self.pictures = [
            check_picture(camera, picture)
            for camera, picture in zip(cameras, pictures, strict=True)
        ]
        self.known = known
        self._packed = pack_cameras(cameras)

    def compare(self, fit: ContourFit, placement: Placement, step: AnnealingStage) -> Comparison:
        """What each camera says of a body where it stands."""
        count, nodes = len(self.cameras), len(placement.X_WN)
        weights = fit.weights(self._packed, placement, replace(step, spacing=_SPACING))
        A, b = np.zeros((count, nodes, 12, 12)), np.zeros((count, nodes, 12))
        sums, wide = np.zeros((count, nodes + 1, 6)), np.zeros((count, nodes, 13))
        for c, camera in enumerate(self.cameras):
            if camera.name in self.known:
                compare_lines(
                    placement.packed, placement.X_WN, self._camera(c), self.pictures[c],
                    self.known[camera.name], weights[c], max(1, round(_STEP * weights[c, 1])),
                    A[c], b[c], sums[c], wide[c],
                )  # fmt: skip
        return Comparison(A, b, sums, wide, placement)

    def learned(
        self, fit: ContourFit, values: Array, regions: Mapping[str, Mask] | None = None
    ) -> KnownColours:
        """What is known of the colours after this moment, of the pose tree's values (m,).

        Args:
            regions: (H, W) the person by camera, where known; other cameras of which nothing is
                known yet learn on both sides of the contour.
        """
        placement = fit.body.place(values)
        scales = pixels_per_metre(self._packed, placement.X_WN[0, :3, 3])
        learned = dict(self.known)
        for c, camera in enumerate(self.cameras):
            region = (regions or {}).get(camera.name)
            known = learned.get(camera.name)
            size = float(scales[c])
            surely = known is None or region is not None
            nodes = len(placement.X_WN)
            histograms = no_colours(1, nodes)[0] if known is None else known.copy()
            learn_colours(
                placement.packed, placement.X_WN, self._camera(c), self.pictures[c], histograms,
                max(2.0, _SPACING * size),
                np.maximum(np.multiply(_WIDTHS, size), _LEAST_WIDTHS),
                1.0 if surely else _RATE,
                math.inf if surely else max(_AGREEING * size, _LEAST_AGREEING),
                max(1, round(_COUNTED * size)),
                np.zeros((0, 0), np.bool_) if region is None else np.ascontiguousarray(region),
            )  # fmt: skip
            learned[camera.name] = histograms
        return learned

    def _camera(self, c: int) -> tuple[Array, Array]:
        return self._packed[0][c], self._packed[1][c]


EDGE_POINTS = 120.0
"""A picture's height over the usual spacing of its region's edge points."""
# The edge of a person's region is longer than this share of the picture's height.
_LEAST_EDGE = 0.15

# Guesses are judged by this many cameras, in pictures with about this many rows.
_JUDGES = 5
_ROWS = 120

# Height and width of the picture; the region's box: top, left, height, width; edge points; bytes
# of the region.
_HEADER = struct.Struct("<8I")
# The fastest of zlib's levels: a person's region is a few runs a row.
_LEVEL = 1


@dataclass(frozen=True, eq=False)
class SilhouetteView:
    """A camera's region (H, W) and points of its edge."""

    region: Mask
    edge: EdgePoints

    @property
    def height(self) -> int:
        """Of the picture [pixel]."""
        return len(self.region)

    @property
    def edge_length(self) -> float:
        """Of the region's edge [pixel]."""
        return float(self.edge.lengths.sum())


def see_silhouette(region: Mask, spacing: float) -> SilhouetteView:
    """The view of a person's region (H, W), its edge points this many pixels apart."""
    return SilhouetteView(region, find_edge_points(region, spacing))


def edge_spacing(camera: Camera, edge_points: float = EDGE_POINTS) -> float:
    """From edge point to edge point in a camera's pictures [pixel]."""
    return max(2.0, camera.height / edge_points)


def shows_somebody(view: SilhouetteView | None) -> bool:
    """Whether a view shows more than a speck: to search a person in specks takes seconds."""
    return view is not None and view.edge_length >= _LEAST_EDGE * view.height


def pack_view(view: SilhouetteView) -> bytes:
    """Packs a view without loss: the region's box as bits, and the edge points."""
    region, edge = view.region, view.edge
    left, top, width, height = cv2.boundingRect(np.ascontiguousarray(region).view(np.uint8))
    box = region[top : top + height, left : left + width]
    bits = zlib.compress(np.packbits(box).tobytes(), _LEVEL)
    count = len(edge.uv)
    header = _HEADER.pack(*region.shape, top, left, height, width, count, len(bits))
    numbers = np.concatenate([edge.uv.ravel(), edge.normals.ravel(), edge.lengths, edge.middle])
    return header + bits + numbers.astype("<f8").tobytes()


def unpack_view(data: bytes) -> SilhouetteView:
    """The view that was packed; region and edge are unpacked when they are looked at first."""
    return _PackedView(data)


class _PackedView(SilhouetteView):
    """A view whose region and edge are unpacked when they are looked at first."""

    _data: bytes

    def __init__(self, data: bytes) -> None:
        object.__setattr__(self, "_data", data)

    @property
    def height(self) -> int:
        return int(_HEADER.unpack_from(self._data)[0])

    @cached_property
    def edge_length(self) -> float:
        *_, count, size = _HEADER.unpack_from(self._data)
        begin = _HEADER.size + size + 8 * 4 * count
        return float(np.frombuffer(self._data, "<f8", count, begin).sum())

    @cached_property
    def region(self) -> Mask:
        data = self._data
        rows, columns, top, left, height, width, _, size = _HEADER.unpack_from(data)
        packed = np.frombuffer(zlib.decompress(data[_HEADER.size : _HEADER.size + size]), np.uint8)
        bits = np.unpackbits(packed, count=height * width).view(np.bool_)
        region = np.zeros((rows, columns), dtype=np.bool_)
        region[top : top + height, left : left + width] = bits.reshape(height, width)
        return region

    @cached_property
    def edge(self) -> EdgePoints:
        *_, count, size = _HEADER.unpack_from(self._data)
        numbers = np.frombuffer(self._data, "<f8", offset=_HEADER.size + size).astype(np.float64)
        uv, normals, lengths, middle = np.split(numbers, np.cumsum([2 * count, 2 * count, count]))
        return EdgePoints(uv.reshape(-1, 2), normals.reshape(-1, 2), lengths, middle)


@dataclass(frozen=True, eq=False)
class FrameViews:
    """The cameras that have a picture in a frame, and what each of them sees."""

    cameras: Sequence[Camera]
    views: Sequence[SilhouetteView]

    @property
    def pairs(self) -> list[tuple[Camera, SilhouetteView]]:
        """Cameras and their views."""
        return list(zip(self.cameras, self.views, strict=True))

    @property
    def showing(self) -> list[str]:
        """The names of the cameras that see somebody."""
        return [camera.name for camera, view in self.pairs if shows_somebody(view)]

    def without(self, names: Collection[str]) -> FrameViews:
        """What the cameras see that are not named."""
        pairs = [pair for pair in self.pairs if pair[0].name not in names]
        return FrameViews([camera for camera, _ in pairs], [view for _, view in pairs])

    def compare(self, fit: ContourFit, placement: Placement, step: AnnealingStage) -> Comparison:
        """A body's contours compared with all cameras' edges, as `fit` weighs them."""
        weights = fit.weights(self._packed.cameras, placement, step)
        return compare_views(self._packed, placement, weights)

    @cached_property
    def _packed(self) -> Views:
        return pack_views(self.cameras, [view.edge for view in self.views])

    @cached_property
    def seers(self) -> list[int]:
        """Which cameras see somebody."""
        return [k for k, view in enumerate(self.views) if len(view.edge.uv)]

    @cached_property
    def judges(self) -> list[int]:
        """Which of them judge guesses; a few, as far as possible all around."""
        count = min(_JUDGES, len(self.seers))
        chosen = np.linspace(0, len(self.seers), count, endpoint=False).astype(int)
        return [self.seers[k] for k in chosen]

    @cached_property
    def small(self) -> tuple[list[Camera], list[Mask]]:
        """The judges' cameras and regions with fewer pixels."""
        strides = {k: max(1, self.views[k].height // _ROWS) for k in self.judges}
        return (
            [_coarser(self.cameras[k], n) for k, n in strides.items()],
            [self.views[k].region[::n, ::n] for k, n in strides.items()],
        )

    @cached_property
    def coarse(self) -> Views:
        """The judges' cameras and every other point of their edges."""
        edges = [self.views[k].edge for k in self.judges]
        return pack_views(
            [self.cameras[k] for k in self.judges],
            [
                EdgePoints(edge.uv[::2], edge.normals[::2], 2.0 * edge.lengths[::2], edge.middle)
                for edge in edges
            ],
        )

    def middle(self) -> Array | None:
        """(3,) where somebody is [m]; None where fewer than two cameras see one."""
        if len(self.seers) < 2:
            return None
        return triangulate(
            [self.cameras[k] for k in self.seers], [self.views[k].edge.middle for k in self.seers]
        )


def _coarser(camera: Camera, stride: int) -> Camera:
    """The camera of every stride-th pixel of every stride-th row."""
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
    """Origins (n, 3) [m] and unit directions (n, 3) in the world of the rays of pixels (n, 2)."""
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


def nearest_points(
    origins_a: Array, directions_a: Array, origins_b: Array, directions_b: Array
) -> tuple[Array, Array, Mask]:
    """Middles (n, 3) where pairs of rays come nearest, distances (n,) [m], and whether they meet.

    Rays (n,) meet where both points lie in front of their origins and they are not parallel.
    """
    across = origins_b - origins_a
    cosine = np.einsum("ij,ij->i", directions_a, directions_b)
    along_a = np.einsum("ij,ij->i", directions_a, across)
    along_b = np.einsum("ij,ij->i", directions_b, across)
    sine_squared = 1.0 - cosine**2
    usable = sine_squared > 1e-6
    divisor = np.where(usable, sine_squared, 1.0)
    t_a = (along_a - cosine * along_b) / divisor
    t_b = (cosine * along_a - along_b) / divisor
    p_a = origins_a + t_a[:, None] * directions_a
    p_b = origins_b + t_b[:, None] * directions_b
    distance = np.linalg.norm(p_a - p_b, axis=1)
    return 0.5 * (p_a + p_b), distance, usable & (t_a > 0.0) & (t_b > 0.0)


def meeting_points(
    cameras: Sequence[Camera],
    pixels: Sequence[Array],
    threshold: float,
    free: Sequence[Mask] | None = None,
) -> Array:
    """The points (m, 3) [m] where rays of two views pass each other by less than a threshold [m].

    Args:
        pixels: (n_k, 2) in each camera's view; all pairs of pixels of all pairs are tried.
        free: (n_k,) pairs of which neither pixel is free are left out; None: all are.
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
    points, distance, usable = nearest_points(*(np.concatenate(side) for side in sides))
    return points[usable & (distance <= threshold)]


def triangulate(cameras: Sequence[Camera], pixels: Sequence[Array]) -> Array:
    """(3,) the point nearest to the rays of one pixel (2,) in each camera [m]; nan has no say."""
    seen = [k for k, uv in enumerate(pixels) if not np.isnan(uv).any()]
    rays = [viewing_rays(cameras[k], pixels[k]) for k in seen]
    origins, directions = np.array(rays).reshape(-1, 2, 3).transpose(1, 0, 2)
    # Each ray tells where the point is across it.
    across = np.eye(3) - directions[:, :, None] * directions[:, None]
    told = (across @ origins[..., None])[..., 0]
    return np.asarray(np.linalg.lstsq(across.sum(axis=0), told.sum(axis=0), rcond=None)[0])


def sum_at_points(
    camera: Camera, picture: NDArray[np.int8], points: Array, weights: Array
) -> tuple[Array, Array]:
    """(n,) sums of a picture (H, W) at points (n, m, 3) [m], weighted (n, m), and weights in it."""
    X_CW = np.ascontiguousarray(camera.X_CW)
    total: tuple[Array, Array] = _sum_at_points(
        camera.kernel_parameters(), X_CW, picture, points, weights
    )
    return total


@compiled
def _sum_at_points(
    camera: Array, X_CW: Array, picture: NDArray[np.int8], points: Array, weights: Array
) -> tuple[Array, Array]:
    height, width = picture.shape
    sums, seen, P = np.zeros(points.shape[0]), np.zeros(points.shape[0]), np.empty((3, 4))
    # Row and column of a point, times its depth: lens and pose in one matrix.
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
