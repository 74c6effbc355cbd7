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

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.fit.colours import check_picture, compare_lines, learn_colours, no_colours
from drake_pose.fit.contour_fit import (
    AddUp,
    CameraSum,
    Comparison,
    ContourFit,
    Views,
    add_cameras,
    compare_placed,
    pack_cameras,
    pack_views,
    pixels_per_metre,
)
from drake_pose.fit.evidence import EdgePoints, find_edge_points
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import Placement
from drake_pose.person.rays import triangulate

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

    def add_up(self, fit: ContourFit) -> AddUp:
        """What compares a body with all pictures and adds up."""

        def total(placement: Placement, step: AnnealingStage) -> CameraSum:
            return self.compare(fit, placement, step).total

        return total

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

    def add_up(self, fit: ContourFit) -> AddUp:
        """What compares a body's contours with all cameras, as `fit` weighs them, and adds up."""

        def total(placement: Placement, step: AnnealingStage) -> CameraSum:
            views = self._packed
            weights = fit.weights(views.cameras, placement, step)
            return add_cameras(*compare_placed(placement.packed, placement.X_WN, views, weights))

        return total

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
