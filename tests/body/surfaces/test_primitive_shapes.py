import numpy as np
import pytest
from pydrake.geometry import (
    Box,
    Capsule,
    ClippingRange,
    ColorRenderCamera,
    Cylinder,
    Ellipsoid,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    MakeRenderEngineVtk,
    PerceptionProperties,
    RenderCameraCore,
    RenderEngineVtkParams,
    RenderLabel,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drake_pose.body.surfaces.visual_geometry import shape_mesh

SIZE, FOCAL = 600, 480.0


def rendered(shape, X_WG: RigidTransform) -> np.ndarray:
    """The mask that Drake's VTK renderer draws; the camera stands at the world's origin."""
    scene_graph = SceneGraph()
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams()))
    source = scene_graph.RegisterSource("s")
    frame = scene_graph.RegisterFrame(source, GeometryFrame("f"))
    instance = GeometryInstance(RigidTransform(), shape, "g")
    properties = PerceptionProperties()
    properties.AddProperty("label", "id", RenderLabel(1))
    instance.set_perception_properties(properties)
    scene_graph.RegisterGeometry(source, frame, instance)
    builder = DiagramBuilder()
    builder.AddSystem(scene_graph)
    diagram = builder.Build()
    root_context = diagram.CreateDefaultContext()
    context = scene_graph.GetMyContextFromRoot(root_context)
    poses = FramePoseVector()
    poses.set_value(frame, X_WG)
    scene_graph.get_source_pose_port(source).FixValue(context, poses)
    core = RenderCameraCore(
        "vtk",
        CameraInfo(SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2),
        ClippingRange(0.1, 10.0),
        RigidTransform(),
    )
    query = scene_graph.get_query_output_port().Eval(context)
    camera = ColorRenderCamera(core, False)
    image = query.RenderLabelImage(camera, scene_graph.world_frame_id(), RigidTransform())
    return image.data[..., 0] == 1


@pytest.mark.parametrize(
    "shape",
    [Box(1, 0.6, 0.4), Sphere(0.5), Cylinder(0.3, 1), Capsule(0.3, 0.6), Ellipsoid(0.5, 0.3, 0.2)],
    ids=lambda shape: type(shape).__name__,
)
def test_primitives_have_the_renderers_own_silhouette(shape):
    """All of them are convex, so the silhouette is the convex hull of the projected vertices."""
    mesh = shape_mesh(shape)
    columns, rows = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    differing = total = 0
    for seed in range(3):
        R_WG = RotationMatrix(Rotation.random(random_state=seed).as_matrix())
        X_WG = RigidTransform(R_WG, [0.0, 0.0, 1.6])
        image = rendered(shape, X_WG)
        p_WV = mesh.vertices @ R_WG.matrix().T + X_WG.translation()
        hull = ConvexHull(FOCAL * p_WV[:, :2] / p_WV[:, 2:] + SIZE / 2 - 0.5)
        inside = np.all(pixels @ hull.equations[:, :2].T + hull.equations[:, 2] <= 0.0, axis=1)
        differing += np.count_nonzero(image != inside.reshape(SIZE, SIZE))
        total += np.count_nonzero(image)
    assert differing < 1e-4 * total
