"""A camera as a Drake system that gives label images without a renderer."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Role, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageLabel16I

from drake_pose.body import labelled_meshes
from drake_pose.camera.models import Camera
from drake_pose.errors import ModelError
from drake_pose.silhouette.areas.label_kernel import paint_labels
from drake_pose.silhouette.areas.outline import outline_from_mesh, pack
from drake_pose.silhouette.pictures.label_images import EMPTY
from drake_pose.systems.ports import PortedSystem


class SilhouetteCamera(PortedSystem):
    """Gives label images of a plant's bodies, as an RgbdSensor does, without VTK, GL or a display.

    .. pydrake_system::

        name: SilhouetteCamera
        input_ports: [body_poses]
        output_ports: [label_image, body_pose_in_world, image_time]

    - ``body_poses``: the plant's output port of that name.
    - ``label_image``: in each pixel the render label of the body that is nearest at the pixel's
      centre, RenderLabel.kEmpty where there is none. Links hide each other.
    - ``body_pose_in_world``: the camera's pose X_WC; ``image_time`` (1): the context's time [s].
      Both are named as RgbdSensor's.

    Surfaces are the plant's visual geometry (perception role) at full detail, as it is when the
    camera is made. What is not the plant's is not seen, nor are half spaces (ground planes); a
    camera has a near plane and no far one. Unlike RgbdSensor it may have parallel rays. A pose that
    is not finite is an error: an image without that link would look like a right one.

    Args:
        plant: the bodies; finalized, and registered with the SceneGraph.
        camera: its X_WC is the pose in the parent's frame.
        parent: the body that carries the camera; None: the world.

    Raises:
        ModelError: the plant is not finalized, is not registered with a SceneGraph, or has nothing
            to be seen; a link has geometry that cannot be drawn; geometry is deformable. On
            evaluation: a body's pose is not finite.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        camera: Camera,
        parent: RigidBody | None = None,
    ) -> None:
        super().__init__()
        _require_drawable(plant, scene_graph)
        bodies = [plant.get_body(BodyIndex(index)) for index in range(plant.num_bodies())]
        found = [
            (index, label, outline_from_mesh(mesh))
            for index, body in enumerate(bodies)
            for label, mesh in labelled_meshes(plant, scene_graph, body).items()
            if not mesh.is_empty and label != EMPTY
        ]
        if not found:
            raise ModelError("the plant has no visual geometry: the camera would see nothing")
        self.camera = camera
        self._names = [body.name() for body in bodies]
        self._parent = 0 if parent is None else int(parent.index())
        self._drawn = np.array([index for index, _, _ in found])
        self._labels = np.array([label for _, label, _ in found], dtype=np.int16)
        self._closed = np.array([outline.is_closed for _, _, outline in found])
        self._packed = pack(tuple(outline for _, _, outline in found))
        self._parameters, self._X_CP = camera.kernel_parameters(), camera.X_CW
        bodies_posed = self.add_input("body_poses", [RigidTransform()] * len(bodies))
        self.DeclareAbstractOutputPort(
            "label_image",
            AbstractValue.Make(ImageLabel16I(camera.width, camera.height)).Clone,
            self._calc_image,
            {bodies_posed.ticket()},
        )
        self.add_output(
            "body_pose_in_world",
            RigidTransform(),
            lambda context: bodies_posed.Eval(context)[self._parent] @ RigidTransform(camera.X_WC),
        )
        time = {self.time_ticket()}
        self.add_output("image_time", 1, lambda context: [context.get_time()], time)

    def _poses(self, context: Context) -> np.ndarray:
        """The poses (n, 4, 4) of all bodies in the world, all of them finite."""
        listed = self.GetInputPort("body_poses").Eval(context)
        if len(listed) != len(self._names):
            raise ModelError(
                f"{self.get_name()}: body_poses holds {len(listed)} poses, but the plant has "
                f"{len(self._names)} bodies"
            )
        X_WB = np.array([pose.GetAsMatrix4() for pose in listed])
        if not np.isfinite(X_WB).all():
            wrong = [
                name for name, X in zip(self._names, X_WB, strict=True) if not np.isfinite(X).all()
            ]
            raise ModelError(f"{self.get_name()}: the pose of link '{wrong[0]}' is not finite")
        return X_WB

    def _calc_image(self, context: Context, output: AbstractValue) -> None:
        X_WB = self._poses(context)
        X_CW = self._X_CP
        if self._parent:
            X_CW = X_CW @ np.linalg.inv(X_WB[self._parent])
        X_CB = np.ascontiguousarray((X_CW @ X_WB[self._drawn])[:, :3])
        labels = output.get_mutable_value().mutable_data[:, :, 0]
        paint_labels(
            self._packed, self._labels, self._closed, X_CB, self._parameters, EMPTY, labels
        )


def _require_drawable(plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Refuse a plant whose geometry a SilhouetteCamera would not, or not wholly, draw."""
    if not plant.is_finalized():
        raise ModelError("a SilhouetteCamera needs a plant that is finalized")
    inspector = scene_graph.model_inspector()
    source = plant.get_source_id()
    if source is None or not inspector.SourceIsRegistered(source):
        raise ModelError("the plant is not registered with the SceneGraph that was given")
    deformable = [
        inspector.GetName(geometry)
        for geometry in inspector.GetAllDeformableGeometryIds()
        if inspector.GetProperties(geometry, Role.kPerception) is not None
    ]
    if deformable:
        raise ModelError(
            f"geometry '{deformable[0]}' is deformable, which a SilhouetteCamera does not draw; "
            "use an RgbdSensor"
        )
