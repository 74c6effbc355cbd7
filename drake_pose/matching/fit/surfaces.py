"""Surfaces of few triangles: what a fit needs of a body shows with them."""

from __future__ import annotations

import fast_simplification
import numpy as np

from drake_pose.body import TriangleMesh
from drake_pose.silhouette import Outline, TreeSurfaces, outline_from_mesh

MANY, FEW, VERY_FEW = 2500, 400, 80
"""Triangles a node: where a pixel counts, for a still, and for a person in real time."""


def few_triangles(surfaces: TreeSurfaces, count: int = FEW) -> tuple[Outline, ...]:
    """The nodes' surfaces, skin at rest, with few triangles (Garland and Heckbert's metric)."""
    outlines = []
    for node, rigid in enumerate(surfaces.rigid):
        bending = surfaces.bending[node]
        whole = rigid if bending is None else bending.rest
        if len(whole.triangles) > count:
            points, triangles = fast_simplification.simplify(
                whole.vertices, whole.triangles, target_count=count
            )
            mesh = TriangleMesh(np.asarray(points, dtype=np.float64), triangles)
            whole = outline_from_mesh(mesh)
        outlines.append(whole)
    return tuple(outlines)
