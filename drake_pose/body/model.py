"""Articulated models: links, joints, limits and visual geometry of a file or a Drake plant."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    FixedOffsetFrame,
    Joint,
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    SpatialInertia,
)

from drake_pose.arrays import Array
from drake_pose.body.link_graph import PlantKinematics
from drake_pose.body.meshes import TriangleMesh, body_mesh, labelled_meshes, make_drawable
from drake_pose.body.parsed_model import (
    ParsedModel,
    SkinBand,
    describe_positions,
    link_names,
    load_skin,
)
from drake_pose.body.parsing import ModelSource, check_in_child, summarise_warnings
from drake_pose.body.plant_source import PlantSource
from drake_pose.body.pose_tree import PoseTree
from drake_pose.body.root import RootRotation
from drake_pose.body.tree_builder import build_pose_tree
from drake_pose.body.urdf_shape import Vectors, reshaped, with_base_joints
from drake_pose.errors import ModelError

TARGET = "target"
"""Name of the link that carries a calibration target."""

TARGET_POSITIONS = tuple(f"{TARGET}_{move}_{axis}" for move in ("shift", "turn") for axis in "xyz")
"""Names of the target's positions: translations [m] along x, y, z, then rotations [rad]."""


@dataclass(frozen=True, eq=False, repr=False)
class ArticulatedModel(ParsedModel):
    """An immutable object with the attributes of ``ParsedModel``, and methods that build trees."""

    def pose_tree(
        self,
        root: str | None = None,
        *,
        root_position: Sequence[float] | Array | None = None,
        root_rotation: RootRotation | None = None,
        held: Mapping[str, float] | None = None,
    ) -> PoseTree:
        """Return the tree in which poses are searched (``drake_pose.body.pose_tree.PoseTree``).

        Args:
            root: name of the root link; None: the link with geometry nearest to the plant's world.
            root_position: (3,) position of the root link's frame origin in the world [m]; None: as
                in the model file, which is possible for the plant's own root only.
            root_rotation: admissible rotations of the root link; None: those of the base joint. A
                floating base then keeps its rotation at the default positions, and a re-rooted tree
                rotates freely.
            held: values [rad or m] of positions that are not searched, by name.

        Raises:
            UnknownNameError: the root link or a held position does not exist.
            ModelError: the root has no visual geometry, or the model's joints allow no pose tree.
            SettingsError: a position or value is missing, not finite, or outside the joint limits.
        """
        return build_pose_tree(self, root, root_position, root_rotation, held)

    @classmethod
    def from_plant(
        cls,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        model_instances: Sequence[ModelInstanceIndex] | None = None,
    ) -> "ArticulatedModel":
        """Return the model of a finalized plant's bodies; its q is the plant's q.

        Joints, limits, default positions, visual geometry and render labels are the plant's. Bodies
        of other model instances and the geometry of the world body are not part of the model: they
        occlude nothing, and their positions keep their defaults.

        Args:
            plant: a finalized plant that is registered with ``scene_graph``; do not change it
                later.
            scene_graph: the SceneGraph that holds the plant's geometry.
            model_instances: the instances whose bodies are drawn; None: all.

        Raises ModelError: the plant is not finalized or not registered, no chosen body has visual
        geometry, or its joints or geometry cannot be used.
        """
        name = plant.get_name() or "the plant"
        if not isinstance(plant, MultibodyPlant) or not plant.is_finalized():
            raise ModelError(f"{name} is not finalized: call plant.Finalize() first")
        source_id = plant.get_source_id()
        if source_id is None or not scene_graph.model_inspector().SourceIsRegistered(source_id):
            raise ModelError(f"{name} is not registered with the given SceneGraph")
        all_instances = [ModelInstanceIndex(k) for k in range(1, plant.num_model_instances())]
        chosen = all_instances if model_instances is None else list(model_instances)
        bodies = [body for instance in chosen for body in plant.GetBodyIndices(instance)]
        path = Path(name)
        with _model_errors(path):
            positions, remarks = describe_positions(plant, {}, name)
        meshes = _visual_meshes(path, plant, scene_graph, bodies)
        labelled = [labelled_meshes(plant, scene_graph, plant.get_body(body)) for body in bodies]
        return cls(
            path=path,
            name=plant.GetModelInstanceName(chosen[-1]),
            plant=plant,
            scene_graph=scene_graph,
            **positions,
            link_meshes=MappingProxyType(meshes),
            skin=(),
            warnings=tuple(summarise_warnings(remarks)),
            _source=PlantSource(plant, scene_graph, bodies),
            labels=frozenset(label for meshes in labelled for label in meshes),
        )

    def without(self, links: Collection[str]) -> "ArticulatedModel":
        """Return the model without the visual geometry of some links and without their skin bands.

        The plant of a model that is no URDF still draws them; pose trees do not.

        Raises:
            UnknownNameError: a link does not exist.
            ModelError: no visual geometry is left.
        """
        if self.changes_shape:
            return self.reshaped(hidden=links)
        for name in links:
            self.link_index(name)
        left = {name: mesh for name, mesh in self.link_meshes.items() if name not in links}
        if not left:
            raise ModelError(f"{self.path}: no link with visual geometry is left")
        kept = [band for band in self.skin if not {band.parent, band.child} & set(links)]
        return replace(self, link_meshes=MappingProxyType(left), skin=tuple(kept))

    def reshaped(
        self,
        *,
        hidden: Collection[str] = (),
        link_scales: Vectors = MappingProxyType({}),
        link_shifts: Vectors = MappingProxyType({}),
        joint_shifts: Vectors = MappingProxyType({}),
    ) -> "ArticulatedModel":
        """Return the model with links scaled, shifted or hidden and joints shifted.

        The positions q keep their meaning.

        Args:
            hidden: links that lose their visual geometry and their skin bands.
            link_scales: (3,) scale factors along the axes of a link's frame, by link.
            link_shifts: (3,) shift [m] of a link's visual geometry and of the joints that it
                carries, in the link's frame, by link. Skin bands are not shifted.
            joint_shifts: (3,) shift [m] of a joint's origin in its parent link's frame, by joint.

        Raises:
            UnknownNameError: a link does not exist.
            ModelError: the model is no URDF, or no visual geometry is left.
        """
        for name in (*hidden, *link_scales, *link_shifts):
            self.link_index(name)
        text = reshaped(
            self._urdf().text,
            hidden=hidden,
            link_scales=link_scales,
            link_shifts=link_shifts,
            joint_shifts=joint_shifts,
        )
        kept = [band for band in self.skin if not {band.parent, band.child} & set(hidden)]
        # A band is given in its child link's frame, so it scales with that link.
        sizes = [link_scales.get(band.child, (1.0, 1.0, 1.0)) for band in kept]
        meshes = [
            TriangleMesh(band.mesh.vertices * size, band.mesh.triangles)
            for band, size in zip(kept, sizes, strict=True)
        ]
        skin = [replace(band, mesh=mesh) for band, mesh in zip(kept, meshes, strict=True)]
        return self._changed(text, skin)

    def with_base_joints(self, X_WB: Array) -> "ArticulatedModel":
        """Return the model mounted on the six ``BASE_JOINTS``.

        ``X_WB``: (4, 4) pose of the model's base in the world when these joints are zero.

        Raises ModelError: the model is no URDF.
        """
        from scipy.spatial.transform import Rotation  # Slow to import.

        rpy = Rotation.from_matrix(X_WB[:3, :3]).as_euler("xyz")
        text = with_base_joints(self._urdf().text, X_WB[:3, 3].tolist(), rpy.tolist())
        moved = self._changed(text, self.skin)
        positions, _ = describe_positions(moved.plant, self._source.limits, str(self.path))
        return replace(moved, **positions)

    def with_target(self, link: str, mesh: TriangleMesh, X_WO: Array) -> "ArticulatedModel":
        """Return the robot with a calibration target on six joints; only the target has geometry.

        The model serves a camera that is mounted on ``link``: the world and the link become tiny
        triangles, and links without a joint keep their pose at the default positions.

        Args:
            link: the link that carries the camera.
            mesh: the target's surface in its own frame O.
            X_WO: (4, 4) pose of the target in the world when all TARGET_POSITIONS are zero.

        Raises:
            UnknownNameError: the link does not exist.
            ModelError: Drake refuses the model in the new plant.
        """
        self.link_index(link)
        plant, scene_graph = MultibodyPlant(time_step=0.0), SceneGraph()
        plant.RegisterAsSourceForSceneGraph(scene_graph)
        # Only the target has visual geometry, so the robot's meshes are not read again.
        self._source.parse(plant, None)
        # A link without a joint is welded at its pose at the default positions.
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        carried = {int(joint.child_body().index()) for joint in joints}
        kinematics, world = PlantKinematics(self), plant.world_frame()
        for index in range(1, plant.num_bodies()):
            if index not in carried:
                base = plant.get_body(BodyIndex(index)).body_frame()
                plant.WeldFrames(world, base, RigidTransform(kinematics.pose(index)))
        # Six joints in series move the target by at most 10 m and 10 rad.
        frame = plant.AddFrame(FixedOffsetFrame(f"{TARGET}_start", world, RigidTransform(X_WO)))
        instance = plant.AddModelInstance(TARGET)
        for k, name in enumerate(TARGET_POSITIONS):
            last = TARGET if k == len(TARGET_POSITIONS) - 1 else f"{name}_end"
            body = plant.AddRigidBody(last, instance, SpatialInertia.Zero())
            kind, axis = PrismaticJoint if k < 3 else RevoluteJoint, np.eye(3)[k % 3]
            joint: Joint = kind(name, frame, body.body_frame(), axis, -10.0, 10.0)
            plant.AddJoint(joint)
            frame = body.body_frame()
        plant.Finalize()
        positions, _ = describe_positions(plant, self._source.limits, str(self.path))
        dot = TriangleMesh(1e-6 * np.eye(3), np.array([[0, 1, 2]]))
        return replace(
            self,
            plant=plant,
            scene_graph=scene_graph,
            **positions,
            link_meshes=MappingProxyType({self.link_names[0]: dot, link: dot, TARGET: mesh}),
            skin=(),
        )

    @property
    def changes_shape(self) -> bool:
        """Whether the model is a URDF, which ``reshaped`` and ``with_base_joints`` require."""
        return self._source.kind == "urdf"

    def _urdf(self) -> ModelSource:
        """Return the URDF source; ModelError for a model of another kind."""
        if not isinstance(self._source, ModelSource) or not self.changes_shape:
            raise ModelError(f"{self.path}: only the shape of a URDF model can be changed")
        return self._source

    def _changed(self, text: str, skin: Sequence[SkinBand]) -> "ArticulatedModel":
        """Return the model parsed again from another URDF text, with the bands ``skin``."""
        source = self._urdf().with_text(text)
        plant, scene_graph, _, _ = _parse(self.path, source)
        plant.Finalize()
        return replace(
            self,
            plant=plant,
            scene_graph=scene_graph,
            link_meshes=MappingProxyType(_visual_meshes(self.path, plant, scene_graph)),
            skin=tuple(skin),
            _source=source,
        )


def load_model(
    path: Path | str,
    *,
    package_paths: Mapping[str, Path | str] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    check: bool = True,
) -> ArticulatedModel:
    """Read a model from any file that Drake's Parser reads.

    Args:
        path: a URDF, SDFormat, MJCF (.xml) or model directives (.dmd.yaml) file.
        package_paths: folders of ``package://name/...`` by package name. Other packages are
            searched for in the folders above the file and in ROS_PACKAGE_PATH; ``drake_pose`` is
            always known.
        limits: (lower, upper) [rad or m] by position name, which replace the file's limits. Planar
            joints need them, because Drake's parser does not read their limits.
        check: read the file in a child process first, so that a file that crashes or hangs Drake or
            takes all memory cannot harm this process. The check is made once for each file content
            and takes as long as reading, and half a second more where this process has several
            threads and cannot be forked.

    Raises:
        ModelError: the file cannot be used; the message names the file and the link or joint.
        UnknownNameError: ``limits`` names a position that does not exist.
    """
    given = {name: (float(low), float(high)) for name, (low, high) in (limits or {}).items()}
    packages = {key: str(folder) for key, folder in (package_paths or {}).items()}
    file = Path(path)
    source_file = file if not file.exists() else file.resolve()
    if check and source_file.is_file():
        check_in_child(read_model, source_file, packages, given)
    return read_model(source_file, packages, given)


def read_model(
    path: Path, packages: Mapping[str, str], limits: Mapping[str, tuple[float, float]]
) -> ArticulatedModel:
    """Read a model as ``load_model`` does, in this process and without the check.

    ``packages``: folders by package name. ``limits``: (lower, upper) [rad or m] by position name.
    """
    source = ModelSource(path, packages)
    plant, scene_graph, instances, warnings = _parse(path, source)
    with _model_errors(path):
        plant.Finalize()
        positions, remarks = describe_positions(plant, {**source.limits, **limits}, str(path))
    meshes = _visual_meshes(path, plant, scene_graph)
    return ArticulatedModel(
        path=path,
        name=plant.GetModelInstanceName(instances[0]),
        plant=plant,
        scene_graph=scene_graph,
        **positions,
        link_meshes=MappingProxyType(meshes),
        skin=load_skin(path, link_names(plant)),
        warnings=tuple(summarise_warnings([*warnings, *remarks])),
        _source=source,
    )


@contextmanager
def _model_errors(path: Path) -> Iterator[None]:
    """Convert errors of Drake and ModelErrors inside the context to a ModelError with the path."""
    try:
        yield
    # Drake aborts on some invalid values, which Python sees as SystemExit.
    except (ModelError, RuntimeError, SystemExit) as error:
        raise ModelError(f"{path}: {error}") from error


def _parse(
    path: Path, source: ModelSource
) -> tuple[MultibodyPlant, SceneGraph, list[ModelInstanceIndex], list[str]]:
    """Parse a model into a new plant that is not finalized, with drawable mesh files.

    ``path`` names the model in messages.

    Returns the plant, its SceneGraph, the model instances, and warnings about the file.
    """
    plant = MultibodyPlant(time_step=0.0)
    scene_graph = SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    instances, warnings = source.parse(plant, scene_graph)
    if not instances:
        raise ModelError(f"{path} holds no model")
    with _model_errors(path):
        make_drawable(plant, scene_graph, instances)
    return plant, scene_graph, instances, warnings


def _visual_meshes(
    path: Path,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    bodies: Sequence[BodyIndex] | None = None,
) -> dict[str, TriangleMesh]:
    """Return the visual geometry of each link that has some, by link name.

    ``bodies``: the bodies to read; None: all. ``path`` names the model in messages.

    Raises ModelError: no body has visual geometry.
    """
    names = link_names(plant)
    chosen = [BodyIndex(k) for k in range(len(names))] if bodies is None else bodies
    with _model_errors(path):
        meshes = {
            names[int(body)]: body_mesh(plant, scene_graph, plant.get_body(body)) for body in chosen
        }
    meshes = {name: mesh for name, mesh in meshes.items() if not mesh.is_empty}
    if not meshes:
        raise ModelError(
            f"{path} has no visual geometry: nothing would be drawn; give its links <visual> "
            "elements (MJCF: geoms of a group below 3)"
        )
    return meshes
