"""A model's skin in Drake's SceneGraph: deformable geometry that its VTK renderer draws.

Drake wants tetrahedra: each triangle of a band carries a flat one, its apex just inside the band.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import (
    GeometryConfigurationVector,
    GeometryId,
    GeometryInstance,
    InMemoryMesh,
    Mesh,
    PerceptionProperties,
    RenderLabel,
    Rgba,
    SceneGraph,
    SourceId,
)
from pydrake.math import RigidTransform

from drake_pose.body.surfaces.mesh import TriangleMesh
from drake_pose.body.tree.node_skin import ModelSkin

# The apex's depth as a share of a triangle's size (the root of twice its area): deep enough to be
# hidden, flat enough to stay inside thin bands.
_DEPTH = 0.05


class DeformableSkin:
    """A model's bands in a SceneGraph: a source whose configuration port is to be connected.

    ``labels``: the render label of each band's child link, by name; 0 for those left out.
    """

    def __init__(
        self,
        skin: ModelSkin,
        scene_graph: SceneGraph,
        labels: Mapping[str, int],
        name: str = "skin",
    ) -> None:
        self.skin = skin
        self.source: SourceId = scene_graph.RegisterSource(name)
        self._geometries: list[GeometryId] = []
        for band in skin.bands:
            properties = PerceptionProperties()
            properties.AddProperty("label", "id", RenderLabel(labels.get(band.child, 0)))
            properties.AddProperty("phong", "diffuse", Rgba(*band.colour, 1.0))
            geometry = GeometryInstance(
                RigidTransform(), _tetrahedra(band.mesh), f"{band.child}_skin"
            )
            geometry.set_perception_properties(properties)
            self._geometries.append(
                scene_graph.RegisterDeformableGeometry(
                    self.source, scene_graph.world_frame_id(), geometry, 1.0
                )
            )

    def configuration(self, vertices: Sequence[np.ndarray]) -> GeometryConfigurationVector:
        """What the source's configuration port takes, of each band's vertices (v, 3) [m]."""
        configuration = GeometryConfigurationVector()
        for geometry, band, p_W in zip(self._geometries, self.skin.bands, vertices, strict=True):
            points = np.vstack([p_W, _apexes(p_W, band.mesh.triangles)])
            configuration.set_value(geometry, points.reshape(-1))
        return configuration


def _apexes(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Returns a point (m, 3) just inside the middle of each triangle."""
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    sizes = np.sqrt(np.linalg.norm(normals, axis=1, keepdims=True))
    depths = _DEPTH * normals / np.maximum(sizes, 1e-12)
    return np.asarray((a + b + c) / 3.0 - depths)


def _tetrahedra(mesh: TriangleMesh) -> Mesh:
    """Returns a closed band as tetrahedra, in the text of a VTK file."""
    points = np.vstack([mesh.vertices, _apexes(mesh.vertices, mesh.triangles)])
    apexes = len(mesh.vertices) + np.arange(len(mesh.triangles))
    a, b, c = mesh.triangles.T
    lines = ["# vtk DataFile Version 3.0", "skin", "ASCII", "DATASET UNSTRUCTURED_GRID"]
    lines.append(f"POINTS {len(points)} double")
    lines += [f"{x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    lines.append(f"CELLS {len(apexes)} {5 * len(apexes)}")
    lines += [f"4 {i} {k} {j} {d}" for i, j, k, d in zip(a, b, c, apexes, strict=True)]
    lines.append(f"CELL_TYPES {len(apexes)}")
    lines += ["10"] * len(apexes)
    file = MemoryFile(contents="\n".join(lines) + "\n", extension=".vtk", filename_hint="skin")
    return Mesh(InMemoryMesh(mesh_file=file))
