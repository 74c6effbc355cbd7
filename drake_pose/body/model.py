"""The articulated model: what a file says about links, joints, limits and looks, read once."""

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
from drake_pose.body.parsing import ModelSource, check_in_child, limit_kinds
from drake_pose.body.plant_source import PlantSource
from drake_pose.body.pose_tree import PoseTree
from drake_pose.body.root import RootRotation
from drake_pose.body.tree_builder import build_pose_tree
from drake_pose.body.urdf_shape import Vectors, reshaped, with_base_joints
from drake_pose.errors import ModelError

OBJECT = "target"
"""The link of an object that stands in the world beside a robot."""

OBJECT_POSITIONS = tuple(f"{OBJECT}_{move}_{axis}" for move in ("shift", "turn") for axis in "xyz")
"""The positions that move it: shifts along its axes [m], then turns about them [rad]."""


@dataclass(frozen=True, eq=False, repr=False)
class ArticulatedModel(ParsedModel):
    """An articulated object, from which pose trees are made (``ParsedModel``); never changes."""

    def pose_tree(
        self,
        root: str | None = None,
        *,
        root_position: Sequence[float] | Array | None = None,
        root_rotation: RootRotation | None = None,
        held: Mapping[str, float] | None = None,
    ) -> PoseTree:
        """The tree in which poses are searched (``drake_pose.body.pose_tree.PoseTree``).

        Args:
            root: the link to start from; None for the one nearest to the plant's world.
            root_position: (3,) where the origin of that link's frame is in the world [m].
            root_rotation: how that link may be turned; None for the base joint's own limits, as it
                stands at the default positions where it floats, or free where the tree is turned
                over.
            held: positions that are not searched, by name, with their value [rad or m].

        Raises:
            UnknownNameError: no such link or joint.
            ModelError: the link has no geometry, or the file's joints allow no pose tree.
            SettingsError: a position or value that is not finite or missing; or held beyond limits.
        """
        return build_pose_tree(self, root, root_position, root_rotation, held)

    @classmethod
    def from_plant(
        cls,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        model_instances: Sequence[ModelInstanceIndex] | None = None,
    ) -> "ArticulatedModel":
        """The model of bodies in a finalized plant, as of a diagram: q is the plant's own.

        Joints, limits, default positions, looks and render labels are the plant's. The bodies of
        other model instances, and what stands in the world, are not the model's: they hide nothing,
        and their positions stay at their defaults.

        Args:
            plant: finalized, and registered with the SceneGraph; do not change it afterwards.
            model_instances: whose bodies are seen; None: all.

        Raises ModelError: the plant is not finalized or not registered, an instance has no bodies
        with visual geometry, or as for a file.
        """
        name = plant.get_name() or "the plant"
        if not isinstance(plant, MultibodyPlant) or not plant.is_finalized():
            raise ModelError(f"{name} is not finalized: call plant.Finalize() first")
        source_id = plant.get_source_id()
        if source_id is None or not scene_graph.model_inspector().SourceIsRegistered(source_id):
            raise ModelError(f"{name} is not registered with the SceneGraph that was given")
        every = [ModelInstanceIndex(k) for k in range(1, plant.num_model_instances())]
        chosen = every if model_instances is None else list(model_instances)
        seen = [body for instance in chosen for body in plant.GetBodyIndices(instance)]
        path = Path(name)
        with _naming(path):
            positions, remarks = describe_positions(plant, {}, name)
        meshes = _seen_meshes(path, plant, scene_graph, seen)
        looks = [labelled_meshes(plant, scene_graph, plant.get_body(body)) for body in seen]
        return cls(
            path=path,
            name=plant.GetModelInstanceName(chosen[-1]),
            plant=plant,
            scene_graph=scene_graph,
            **positions,
            link_meshes=MappingProxyType(meshes),
            skin=(),
            warnings=tuple(limit_kinds(remarks)),
            _source=PlantSource(plant, scene_graph, seen),
            labels=frozenset(label for meshes in looks for label in meshes),
        )

    def without(self, links: Collection[str]) -> "ArticulatedModel":
        """The same without the looks of some links, and the skin between them and others.

        Raises UnknownNameError for an unknown link, ModelError for no URDF or nothing seen.
        """
        return self.reshaped(hidden=links)

    def reshaped(
        self,
        *,
        hidden: Collection[str] = (),
        factors: Vectors = MappingProxyType({}),
        moves: Vectors = MappingProxyType({}),
        shifts: Vectors = MappingProxyType({}),
    ) -> "ArticulatedModel":
        """The same with links and joints otherwise; positions mean what they did.

        Args:
            hidden: links without looks, and without skin between them and others.
            factors: (3,) by link: so many times its size along its frame's axes.
            moves: (3,) by link: how far its looks and joints lie elsewhere on it [m]; bands stay.
            shifts: (3,) by joint: how far it stands elsewhere on its parent link [m].

        Raises:
            UnknownNameError: no such link.
            ModelError: no URDF, or nothing is seen any more.
        """
        for name in (*hidden, *factors, *moves):
            self.link_index(name)
        text = reshaped(
            self._urdf().text, hidden=hidden, factors=factors, moves=moves, shifts=shifts
        )
        kept = [band for band in self.skin if not {band.parent, band.child} & set(hidden)]
        # A band grows with the link in whose frame it is.
        sizes = [factors.get(band.child, (1.0, 1.0, 1.0)) for band in kept]
        meshes = [
            TriangleMesh(band.mesh.vertices * size, band.mesh.triangles)
            for band, size in zip(kept, sizes, strict=True)
        ]
        skin = [replace(band, mesh=mesh) for band, mesh in zip(kept, meshes, strict=True)]
        return self._changed(text, skin)

    def with_base_joints(self, X_WB: Array) -> "ArticulatedModel":
        """The same on BASE_JOINTS, which are 0 at X_WB (4, 4); ModelError for no URDF."""
        from scipy.spatial.transform import Rotation  # Slow to import; reading needs none.

        rpy = Rotation.from_matrix(X_WB[:3, :3]).as_euler("xyz")
        text = with_base_joints(self._urdf().text, X_WB[:3, 3].tolist(), rpy.tolist())
        moved = self._changed(text, self.skin)
        positions, _ = describe_positions(moved.plant, self._source.limits, str(self.path))
        return replace(moved, **positions)

    def before_object(self, link: str, mesh: TriangleMesh, X_WO: Array) -> "ArticulatedModel":
        """The joints between the world and a link, and a rigid object that stands in the world.

        What matters to a camera on the link: only the object has looks, the world and the link are
        dots. The robot's base stays where its default positions put it.

        Args:
            mesh: the object's surface in its frame O.
            X_WO: (4, 4) where it stands at OBJECT_POSITIONS of zero.

        Raises UnknownNameError, ModelError: no such link; the file is refused in another plant.
        """
        self.link_index(link)
        plant, scene_graph = MultibodyPlant(time_step=0.0), SceneGraph()
        plant.RegisterAsSourceForSceneGraph(scene_graph)
        # Nothing of the robot is seen, so its meshes are not read again.
        self._source.parse(plant, None)
        # What no joint holds is welded where it stands at the default positions.
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        carried = {int(joint.child_body().index()) for joint in joints}
        kinematics, world = PlantKinematics(self), plant.world_frame()
        for index in range(1, plant.num_bodies()):
            if index not in carried:
                base = plant.get_body(BodyIndex(index)).body_frame()
                plant.WeldFrames(world, base, RigidTransform(kinematics.pose(index)))
        # Six joints, one after another, move the object by at most 10 m or 10 rad.
        frame = plant.AddFrame(FixedOffsetFrame(f"{OBJECT}_start", world, RigidTransform(X_WO)))
        instance = plant.AddModelInstance(OBJECT)
        for k, name in enumerate(OBJECT_POSITIONS):
            last = OBJECT if k == len(OBJECT_POSITIONS) - 1 else f"{name}_end"
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
            link_meshes=MappingProxyType({self.link_names[0]: dot, link: dot, OBJECT: mesh}),
            skin=(),
        )

    @property
    def changes_shape(self) -> bool:
        """Whether the methods above can be called, which a URDF allows."""
        return self._source.kind == "urdf"

    def _urdf(self) -> ModelSource:
        """What Drake reads in the file's place."""
        if not isinstance(self._source, ModelSource) or not self.changes_shape:
            raise ModelError(f"{self.path}: only the shape of a URDF model can be changed")
        return self._source

    def _changed(self, text: str, skin: Sequence[SkinBand]) -> "ArticulatedModel":
        """The same read from another text."""
        source = self._urdf().with_text(text)
        plant, scene_graph, _, _ = _parse(self.path, source)
        plant.Finalize()
        return replace(
            self,
            plant=plant,
            scene_graph=scene_graph,
            link_meshes=MappingProxyType(_seen_meshes(self.path, plant, scene_graph)),
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
        package_paths: folders for ``package://name/...``, by name. Others are looked for on the way
            up from the file and in ROS_PACKAGE_PATH; ``drake_pose`` is known already.
        limits: (lower, upper) [rad or m] by position name instead of the file's; the only way to
            limit planar joints, whose limits Drake's parser does not read.
        check: first read the file in a child process, so that a file that crashes or hangs Drake or
            eats all memory does not do so here. Once for each file's content; it takes as long as
            reading, and half a second more in a process of several threads, which cannot be forked.

    Raises:
        ModelError: the file cannot be used; the message names the file and link or joint.
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
    """As load_model, in this process and without the check."""
    source = ModelSource(path, packages)
    plant, scene_graph, instances, warnings = _parse(path, source)
    with _naming(path):
        plant.Finalize()
        positions, remarks = describe_positions(plant, {**source.limits, **limits}, str(path))
    meshes = _seen_meshes(path, plant, scene_graph)
    return ArticulatedModel(
        path=path,
        name=plant.GetModelInstanceName(instances[0]),
        plant=plant,
        scene_graph=scene_graph,
        **positions,
        link_meshes=MappingProxyType(meshes),
        skin=load_skin(path, link_names(plant)),
        warnings=tuple(limit_kinds([*warnings, *remarks])),
        _source=source,
    )


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Let what Drake and this package refuse be a ModelError that names the file."""
    try:
        yield
    # Drake ends the process, which Python sees as SystemExit, at some values.
    except (ModelError, RuntimeError, SystemExit) as error:
        raise ModelError(f"{path}: {error}") from error


def _parse(
    path: Path, source: ModelSource
) -> tuple[MultibodyPlant, SceneGraph, list[ModelInstanceIndex], list[str]]:
    """A plant of a model that is not finalized, its SceneGraph, instances, and warnings."""
    plant = MultibodyPlant(time_step=0.0)
    scene_graph = SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    instances, warnings = source.parse(plant, scene_graph)
    if not instances:
        raise ModelError(f"{path} holds no model")
    with _naming(path):
        make_drawable(plant, scene_graph, instances)
    return plant, scene_graph, instances, warnings


def _seen_meshes(
    path: Path,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    bodies: Sequence[BodyIndex] | None = None,
) -> dict[str, TriangleMesh]:
    """The visual geometry of each link that has some; bodies: of these alone."""
    names = link_names(plant)
    chosen = [BodyIndex(k) for k in range(len(names))] if bodies is None else bodies
    with _naming(path):
        meshes = {
            names[int(body)]: body_mesh(plant, scene_graph, plant.get_body(body)) for body in chosen
        }
    meshes = {name: mesh for name, mesh in meshes.items() if not mesh.is_empty}
    if not meshes:
        raise ModelError(
            f"{path} has no visual geometry: nothing would be seen; give its links <visual> "
            "elements (MJCF: geoms of a group below 3)"
        )
    return meshes
