"""What one camera says as few bytes, for the way from one machine to another."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np

from drake_pose.matching.fit.evidence import EdgePoints
from drake_pose.multiview.person.silhouette_tracker import SilhouetteView

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


def unpack_view(data: bytes) -> SilhouetteView:
    """The view that was packed."""
    rows, columns, top, left, height, width, count, size = _HEADER.unpack_from(data)
    packed = np.frombuffer(zlib.decompress(data[_HEADER.size : _HEADER.size + size]), np.uint8)
    bits = np.unpackbits(packed, count=height * width).view(np.bool_)
    region = np.zeros((rows, columns), dtype=np.bool_)
    region[top : top + height, left : left + width] = bits.reshape(height, width)
    numbers = np.frombuffer(data, "<f8", offset=_HEADER.size + size).astype(np.float64)
    uv, normals, lengths, middle = np.split(numbers, np.cumsum([2 * count, 2 * count, count]))
    edge = EdgePoints(uv.reshape(-1, 2), normals.reshape(-1, 2), lengths, middle)
    return SilhouetteView(region, edge)
