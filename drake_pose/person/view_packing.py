"""What one camera says as few bytes, for the way from one machine to another."""

from __future__ import annotations

import struct
import zlib
from functools import cached_property

import cv2
import numpy as np

from drake_pose.fit.evidence import EdgePoints
from drake_pose.person.silhouette_view import KeptEdge, Mask, SilhouetteView

# Height and width of the picture; the region's box: top, left, height, width; edge points; bytes
# of the region.
_HEADER = struct.Struct("<8I")
# The fastest of zlib's levels: a person's region is a few runs a row.
_LEVEL = 1


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


def unpack_view(data: bytes, kept: KeptEdge | None = None) -> SilhouetteView:
    """The view that was packed; region and edge are unpacked when they are looked at first.

    Args:
        data: of pack_view.
        kept: who else has the edge.
    """
    return _PackedView(data, kept)


class _PackedView(SilhouetteView):
    """A view that is unpacked no more than it must: who adds up sums needs no pictures."""

    _data: bytes

    def __init__(self, data: bytes, kept: KeptEdge | None) -> None:
        object.__setattr__(self, "_data", data)
        object.__setattr__(self, "kept", kept)

    @property
    def height(self) -> int:
        """Of the picture [pixel]."""
        return int(_HEADER.unpack_from(self._data)[0])

    @cached_property
    def edge_length(self) -> float:
        """Of the region's edge [pixel]."""
        *_, count, size = _HEADER.unpack_from(self._data)
        begin = _HEADER.size + size + 8 * 4 * count
        return float(np.frombuffer(self._data, "<f8", count, begin).sum())

    @cached_property
    def region(self) -> Mask:
        """(H, W) the person."""
        data = self._data
        rows, columns, top, left, height, width, _, size = _HEADER.unpack_from(data)
        packed = np.frombuffer(zlib.decompress(data[_HEADER.size : _HEADER.size + size]), np.uint8)
        bits = np.unpackbits(packed, count=height * width).view(np.bool_)
        region = np.zeros((rows, columns), dtype=np.bool_)
        region[top : top + height, left : left + width] = bits.reshape(height, width)
        return region

    @cached_property
    def edge(self) -> EdgePoints:
        """Points of the region's edge."""
        *_, count, size = _HEADER.unpack_from(self._data)
        numbers = np.frombuffer(self._data, "<f8", offset=_HEADER.size + size).astype(np.float64)
        uv, normals, lengths, middle = np.split(numbers, np.cumsum([2 * count, 2 * count, count]))
        return EdgePoints(uv.reshape(-1, 2), normals.reshape(-1, 2), lengths, middle)
