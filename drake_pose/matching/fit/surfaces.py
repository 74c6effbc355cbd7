"""Surfaces of few triangles: what a fit needs of a body shows with them."""

from __future__ import annotations

import fast_simplification
import numpy as np

from drake_pose.body import TriangleMesh
from drake_pose.silhouette import Outline, TreeSurfaces, outline_from_mesh

MANY, FEW, VERY_FEW = 2500, 400, 80
"""Triangles a node: where a pixel counts, for a still, and for a person in real time."""


def few_rigid_triangles(surfaces: TreeSurfaces, count: int) -> TreeSurfaces:
    """The surfaces with few triangles in each rigid part; bands of skin stay and bend."""
    return surfaces.with_rigid([_simplified(rigid, count) for rigid in surfaces.rigid])


def few_triangles(surfaces: TreeSurfaces, count: int = FEW) -> tuple[Outline, ...]:
    """The nodes' surfaces, skin at rest, with few triangles (Garland and Heckbert's metric)."""
    outlines = []
    for node, rigid in enumerate(surfaces.rigid):
        bending = surfaces.bending[node]
        outlines.append(_simplified(rigid if bending is None else bending.rest, count))
    return tuple(outlines)


def _simplified(outline: Outline, count: int) -> Outline:
    """A surface with at most about so many triangles."""
    if len(outline.triangles) <= count:
        return outline
    points, triangles = fast_simplification.simplify(
        outline.vertices, outline.triangles, target_count=count
    )
    return outline_from_mesh(TriangleMesh(np.asarray(points, dtype=np.float64), triangles))
