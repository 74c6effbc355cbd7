"""The articulated model: what a file says about links, joints, limits and looks, read once."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ModelInstanceIndex

from drake_pose.body.files.parsing import ModelSource, limit_kinds
from drake_pose.body.files.safety import check_in_child
from drake_pose.body.limits import PositionKind, describe_positions
from drake_pose.body.surfaces.mesh import TriangleMesh
from drake_pose.body.surfaces.skin_file import SkinBand, load_skin
from drake_pose.body.surfaces.visual_geometry import body_mesh, make_drawable
from drake_pose.errors import ModelError, UnknownNameError

if TYPE_CHECKING:
    from drake_pose.body.tree.pose_tree import PoseTree
    from drake_pose.body.tree.root import RootRotation


@dataclass(frozen=True, eq=False)
class ArticulatedModel:
    """An articulated object as Drake understands it. Never changes.

    Attributes:
        path: the model file.
        name: the model's name (that of its first model instance).
        plant: a finalized MultibodyPlant, to make contexts from; do not change it.
        scene_graph: the SceneGraph the plant's geometry is registered with.
        position_names: one unique name a position, in the plant's order: the joint's name, or
            ``joint_suffix`` for joints of several positions.
        position_kinds: "angle" [rad], "length" [m] or "quaternion" for each position.
        lower, upper: (nq,) limits [rad or m], read-only; half a turn either side of the default
            position for a joint that turns freely; infinite for the pose of a floating body, and
            for slides without limits.
        default_positions: (nq,) Drake's default positions moved inside the limits, read-only.
        periodic: (nq,) bool, read-only: angles that look the same after a full turn.
        turns_freely: (nq,) bool, read-only: angles without limits, or with limits more than four
            turns apart, which mean none.
        link_meshes: the visual geometry of each link that has some, in the link's frame.
        skin: the bands of surface that bend with the joints, from the file beside the model's
            (``load_skin``); usually none.
        warnings: what is not read of the file or not enforced, which limits were not taken as they
            are written, and what Drake remarked.
    """

    path: Path
    name: str
    plant: MultibodyPlant
    scene_graph: SceneGraph
    position_names: tuple[str, ...]
    position_kinds: tuple[PositionKind, ...]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    default_positions: NDArray[np.float64]
    periodic: NDArray[np.bool_]
    turns_freely: NDArray[np.bool_]
    link_meshes: Mapping[str, TriangleMesh]
    skin: tuple[SkinBand, ...]
    warnings: tuple[str, ...]
    _source: ModelSource = field(repr=False)

    def add_to(
        self,
        plant: MultibodyPlant,
        scene_graph: SceneGraph | None = None,
        *,
        prefix: str = "",
    ) -> list[ModelInstanceIndex]:
        """Add the same model to another plant, for example one of a diagram.

        Mesh files that Drake would not draw are replaced as in this model. Add renderers to the
        SceneGraph after this call: Drake's VTK renderer rejects an OBJ file without normals at the
        moment it is parsed.

        Args:
            plant: a plant that is not finalized.
            scene_graph: the SceneGraph it is or shall be registered with; None for no geometry.
            prefix: put before the model's name, to tell several copies apart.

        Returns:
            The new model instances.

        Raises:
            ModelError: Drake refuses the model in that plant.
        """
        instances, _ = self._source.parse(plant, scene_graph, prefix)
        if plant.geometry_source_is_registered():
            make_drawable(plant, scene_graph, instances)
        return instances

    @property
    def link_names(self) -> tuple[str, ...]:
        """All links, seen or not, in the order of the plant's bodies; the first is the world."""
        return link_names(self.plant)

    def link_index(self, name: str) -> int:
        """The index of a link among the plant's bodies.

        Raises:
            UnknownNameError: no link has that name.
        """
        if name not in self.link_names:
            raise UnknownNameError("link", name, self.link_names, str(self.path))
        return self.link_names.index(name)

    def position_index(self, name: str) -> int:
        """Where a position stands in q.

        Raises:
            UnknownNameError: no position has that name.
        """
        if name not in self.position_names:
            raise UnknownNameError("joint", name, self.position_names, str(self.path))
        return self.position_names.index(name)

    def pose_tree(
        self,
        root: str | None = None,
        *,
        root_position: Sequence[float] | NDArray[np.float64] | None = None,
        root_rotation: "RootRotation | None" = None,
        held: Mapping[str, float] | None = None,
    ) -> "PoseTree":
        """The tree in which poses are searched; see ``drake_pose.body.tree.pose_tree.PoseTree``.

        Args:
            root: the link to start from; None for the one nearest to the plant's world.
            root_position: (3,) where the origin of that link's frame is in the world [m].
            root_rotation: how that link may be turned; None for the base joint's own limits, or
                free where the link floats or the tree is turned over.
            held: positions that are not searched, by name, with their value [rad or m].

        Raises:
            UnknownNameError: no such link or joint.
            ModelError: the link has no geometry, or the file's joints allow no pose tree.
            SettingsError: a position or value that is not finite, or that is missing.
        """
        from drake_pose.body.tree.tree_builder import build_pose_tree  # It imports this module.

        return build_pose_tree(self, root, root_position, root_rotation, held or {})


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
        limits: limits (lower, upper) [rad or m] by position name, instead of the file's: the only
            way to limit planar joints, whose limits Drake's parser does not read.
        check: first read the file in a child process, so that a file that crashes Drake, hangs it
            or eats all memory does not do so here. About a second, once for each file's content.

    Raises:
        ModelError: the file cannot be used; the message names the file and link or joint.
        UnknownNameError: ``limits`` names a position that does not exist.
    """
    given = {name: (float(low), float(high)) for name, (low, high) in (limits or {}).items()}
    packages = {key: str(folder) for key, folder in (package_paths or {}).items()}
    file = Path(path)
    source_file = file if not file.exists() else file.resolve()
    if check and source_file.is_file():
        check_in_child(source_file, packages, given)
    return read_model(source_file, packages, given)


def read_model(
    path: Path, packages: Mapping[str, str], limits: Mapping[str, tuple[float, float]]
) -> ArticulatedModel:
    """As load_model, in this process and without the check."""
    source = ModelSource.open(path, packages)
    plant = MultibodyPlant(time_step=0.0)
    scene_graph = SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    instances, warnings = source.parse(plant, scene_graph)
    if not instances:
        raise ModelError(f"{path} holds no model")
    try:
        make_drawable(plant, scene_graph, instances)
        plant.Finalize()
        positions = describe_positions(plant, {**source.limits, **limits}, str(path))
        meshes = {
            name: body_mesh(plant, scene_graph, plant.get_body(BodyIndex(index)))
            for index, name in enumerate(link_names(plant))
        }
    # Drake ends the process, which Python sees as SystemExit, at some values.
    except (ModelError, RuntimeError, SystemExit) as error:
        raise ModelError(f"{path}: {error}") from error
    meshes = {name: mesh for name, mesh in meshes.items() if not mesh.is_empty}
    if not meshes:
        raise ModelError(
            f"{path} has no visual geometry: nothing would be seen; give its links <visual> "
            "elements (MJCF: geoms of a group below 3)"
        )
    return ArticulatedModel(
        path=path,
        name=plant.GetModelInstanceName(instances[0]),
        plant=plant,
        scene_graph=scene_graph,
        position_names=positions.names,
        position_kinds=positions.kinds,
        lower=positions.lower,
        upper=positions.upper,
        default_positions=positions.defaults,
        periodic=positions.periodic,
        turns_freely=positions.turns_freely,
        link_meshes=MappingProxyType(meshes),
        skin=load_skin(path, link_names(plant)),
        warnings=tuple(limit_kinds([*warnings, *positions.warnings])),
        _source=source,
    )


def link_names(plant: MultibodyPlant) -> tuple[str, ...]:
    """A unique name for each body, in the plant's order: ``instance::link`` where links repeat."""
    bodies = [plant.get_body(BodyIndex(index)) for index in range(plant.num_bodies())]
    plain = [body.name() for body in bodies]
    return tuple(
        body.name() if plain.count(body.name()) == 1 else body.scoped_name().get_full()
        for body in bodies
    )
