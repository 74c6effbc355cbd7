"""Label images: of masks, and of Drake's render engine as reference silhouettes, skin included.

Drake's deformable geometry consists of tetrahedra. Each triangle of a band becomes the base of a
flat tetrahedron whose apex lies just inside the band.
"""

from __future__ import annotations

import threading
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import (
    GeometryConfigurationVector,
    GeometryId,
    GeometryInstance,
    InMemoryMesh,
    MakeRenderEngineVtk,
    Mesh,
    PerceptionProperties,
    RenderEngineVtkParams,
    RenderLabel,
    Rgba,
    SceneGraph,
    SourceId,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.sensors import ImageLabel16I

from drake_pose.body import ModelSkin, TriangleMesh, link_names
from drake_pose.camera.exchange import camera_to_drake
from drake_pose.camera.models import Camera, ParallelCamera

if TYPE_CHECKING:
    from drake_pose.body import ParsedModel


EMPTY = int(RenderLabel.kEmpty)
"""Label of a pixel without an object."""

OBJECT = 1
"""The label that mask_to_label_image gives the object."""


def mask_to_label_image(mask: np.ndarray) -> ImageLabel16I:
    """Return a mask (H, W) as a label image: OBJECT on the object, EMPTY elsewhere."""
    height, width = mask.shape
    image = ImageLabel16I(width, height)
    fill_label_image(image, mask)
    return image


def fill_label_image(image: ImageLabel16I, mask: np.ndarray) -> None:
    """Write a mask (H, W) into an existing label image, which is resized."""
    height, width = mask.shape
    image.resize(width, height)
    labels = image.mutable_data[:, :, 0]
    # Ten times as fast as numpy.where.
    np.multiply(mask, np.int16(OBJECT - EMPTY), out=labels, dtype=np.int16)
    labels += np.int16(EMPTY)


def label_image_to_mask(
    image: ImageLabel16I | np.ndarray, labels: Collection[int] | None = None
) -> np.ndarray:
    """Return the mask (H, W) of a label image or of its data (H, W) or (H, W, 1).

    ``labels``: the labels of the object; None: all labels that Drake does not reserve (kEmpty,
    kDontCare, kDoNotRender and kUnspecified).
    """
    data = label_data(image)
    if labels is None:
        return data <= int(RenderLabel.kMaxUnreserved)
    return np.isin(data, list(labels))


def label_data(image: ImageLabel16I | np.ndarray) -> np.ndarray:
    """Return the labels (H, W) int16 of a label image or of its data, without a copy."""
    data = image.data if isinstance(image, ImageLabel16I) else np.asarray(image)
    return data[:, :, 0] if data.ndim == 3 else data


class DeformableSkin:
    """A model's skin bands as a source of a SceneGraph, whose configuration port must be connected.

    Args:
        skin: the model's bands.
        scene_graph: the SceneGraph to register with.
        labels: render label of each band's child link, by name; bands of other links get 0.
        name: name of the source.
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
            given = self.source, scene_graph.world_frame_id(), geometry, 1.0
            self._geometries.append(scene_graph.RegisterDeformableGeometry(*given))

    def configuration(self, vertices: Sequence[np.ndarray]) -> GeometryConfigurationVector:
        """Return the source's port value, given each band's vertices (v, 3) in the world [m]."""
        configuration = GeometryConfigurationVector()
        for geometry, band, p_W in zip(self._geometries, self.skin.bands, vertices, strict=True):
            points = np.vstack([p_W, _apexes(p_W, band.mesh.triangles)])
            configuration.set_value(geometry, points.reshape(-1))
        return configuration


def _apexes(vertices: np.ndarray, triangles: np.ndarray, depth: float = 0.05) -> np.ndarray:
    """Return a point (m, 3) [m] just inside the middle of each triangle.

    ``vertices``: (v, 3) the surface's vertices [m]. ``triangles``: (m, 3) vertex indices,
    counter-clockwise from outside. ``depth``: depth of the point as a fraction of sqrt(2 area):
    large enough to be hidden, small enough to stay inside thin bands.
    """
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    sizes = np.sqrt(np.linalg.norm(normals, axis=1, keepdims=True))
    depths = depth * normals / np.maximum(sizes, 1e-12)
    return np.asarray((a + b + c) / 3.0 - depths)


def _tetrahedra(mesh: TriangleMesh) -> Mesh:
    """Return a closed band as tetrahedra in an in-memory VTK file."""
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


class LabelRenderer:
    """Renders label images of a model by RenderEngineVtk, without a display or a diagram.

    Raises:
        CameraError: on rendering, when Drake cannot render for the camera.
        RuntimeError: on rendering in another thread than the one that made the renderer, where
            images would be wrong.
    """

    def __init__(self, model: ParsedModel, camera: Camera) -> None:
        self.camera = camera
        self._thread = threading.get_ident()
        self._scene_graph = SceneGraph()
        self._plant = MultibodyPlant(time_step=0.0)
        self._source = self._plant.RegisterAsSourceForSceneGraph(self._scene_graph)
        model.add_to(self._plant, self._scene_graph)
        labels = {name: label for label, name in enumerate(link_names(self._plant))}
        self._skin = DeformableSkin(ModelSkin(model), self._scene_graph, labels)
        self._scene_graph.AddRenderer("silhouette", MakeRenderEngineVtk(RenderEngineVtkParams()))
        self._plant.Finalize()
        self._plant_context = self._plant.CreateDefaultContext()
        self._context = self._scene_graph.CreateDefaultContext()
        meshes = model.link_meshes.items()
        self._vertices = [(labels[name], mesh.vertices) for name, mesh in meshes]
        self._world = self._scene_graph.world_frame_id()

    @property
    def link_names(self) -> dict[int, str]:
        """The link of each label; a label is Drake's body index."""
        return dict(enumerate(link_names(self._plant)))

    def label_image(self, q: np.ndarray, X_WB: np.ndarray | None = None) -> np.ndarray:
        """Return labels (H, W) int16 of the model at q (nq,); EMPTY where there is no body.

        ``X_WB``: (4, 4) pose of the plant's world frame B in the world; None: the identity.
        """
        if threading.get_ident() != self._thread:
            raise RuntimeError("a LabelRenderer must be used in the thread that made it")
        self._set_positions(q)
        poses = self._plant.get_geometry_pose_output_port().Eval(self._plant_context)
        X_BW = RigidTransform()
        if X_WB is not None:
            rotation = RotationMatrix.ProjectToRotationMatrix(np.asarray(X_WB)[:3, :3])
            X_BW = RigidTransform(rotation, np.asarray(X_WB)[:3, 3]).inverse()
        self._scene_graph.get_source_pose_port(self._source).FixValue(self._context, poses)
        p_B = self._skin.skin.vertices(np.asarray(q, dtype=np.float64))
        port = self._scene_graph.get_source_configuration_port(self._skin.source)
        port.FixValue(self._context, self._skin.configuration(p_B))
        depths = None
        if isinstance(self.camera, ParallelCamera):
            # The depths of the body in the camera [m], with a margin.
            X_CB, X_BL = self.camera.X_CW @ X_BW.inverse().GetAsMatrix4(), self.link_poses(q)
            placed = [(X_CB @ X_BL[label], p_L) for label, p_L in self._vertices]
            placed += [(X_CB, p) for p in p_B]
            found = np.concatenate(
                [p @ X[2, :3] + X[2, 3] for X, p in placed] or [np.array([-1.0, 1.0])]
            )
            depths = float(found.min()) - 0.01, float(found.max()) + 0.01
        color, _, X_WC = camera_to_drake(
            self.camera, renderer_name="silhouette", depth_range=depths
        )
        query = self._scene_graph.get_query_output_port().Eval(self._context)
        image = query.RenderLabelImage(color, self._world, X_BW @ X_WC)
        return label_data(image).copy()

    def mask(self, q: np.ndarray, X_WB: np.ndarray | None = None) -> np.ndarray:
        """Return the model's mask (H, W) bool at q (nq,).

        ``X_WB``: (4, 4) pose of the plant's world frame B in the world; None: the identity.
        """
        return self.label_image(q, X_WB) != EMPTY

    def segments(self, q: np.ndarray, X_WB: np.ndarray | None = None) -> np.ndarray:
        """Return (H, W) int16 the label (see ``link_names``) of each pixel at q (nq,); -1 if none.

        ``X_WB``: (4, 4) pose of the plant's world frame B in the world; None: the identity.
        """
        labels = self.label_image(q, X_WB)
        return np.where(labels == EMPTY, np.int16(-1), labels)

    def link_poses(self, q: np.ndarray) -> np.ndarray:
        """Return (bodies, 4, 4) poses of the links in the plant's world, by body index."""
        self._set_positions(q)
        count = self._plant.num_bodies()
        bodies = [self._plant.get_body(BodyIndex(i)) for i in range(count)]
        poses = [self._plant.EvalBodyPoseInWorld(self._plant_context, one) for one in bodies]
        return np.array([pose.GetAsMatrix4() for pose in poses])

    def _set_positions(self, q: np.ndarray) -> None:
        """Set the plant's positions q (nq,); ValueError unless they are finite."""
        positions = np.asarray(q, dtype=np.float64)
        if positions.shape != (self._plant.num_positions(),) or not np.isfinite(positions).all():
            # Drake would abort the whole process.
            raise ValueError(f"q must be ({self._plant.num_positions()},) finite numbers")
        self._plant.SetPositions(self._plant_context, positions)
