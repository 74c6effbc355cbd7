"""Articulated models: links, joints, limits and visual geometry of a file or a Drake plant.

The shape of a URDF model is changed in its text: links are hidden, scaled and shifted.
"""

import copy
import warnings
import xml.etree.ElementTree as ElementTree
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
from drake_pose.body.meshes import TriangleMesh, join_meshes, labelled_meshes, make_drawable
from drake_pose.body.model_files import number_text, xml_element, xml_text
from drake_pose.body.parsed_model import (
    ParsedModel,
    SkinBand,
    describe_positions,
    link_names,
    load_skin,
    mimic_warnings,
)
from drake_pose.body.parsing import ModelSource, check_in_child, summarise_warnings
from drake_pose.body.plant_source import PlantSource
from drake_pose.body.pose_tree import PoseTree
from drake_pose.body.root import RootRotation
from drake_pose.body.tree_builder import build_pose_tree
from drake_pose.errors import ModelError

TARGET = "target"
"""Name of the link that carries a calibration target."""

TARGET_POSITIONS = tuple(f"{TARGET}_{move}_{axis}" for move in ("shift", "turn") for axis in "xyz")
"""Names of the target's positions: translations [m] along x, y, z, then rotations [rad]."""


BASE_JOINTS = ("free_x", "free_y", "free_z", "free_turn_z", "free_turn_y", "free_turn_x")
"""Joints that move a whole model: along x, y, z of the world, then about z, y, x."""

Vectors = Mapping[str, Sequence[float]]
"""Vectors (3,) by the name of a link or joint."""


def require_registered(plant: MultibodyPlant, scene_graph: SceneGraph) -> str:
    """Return the plant's name; ModelError unless it is finalized and has the SceneGraph."""
    name = plant.get_name() or "the plant"
    if not plant.is_finalized():
        raise ModelError(f"{name} is not finalized: call plant.Finalize() first")
    source_id = plant.get_source_id()
    if source_id is None or not scene_graph.model_inspector().SourceIsRegistered(source_id):
        raise ModelError(f"{name} is not registered with the given SceneGraph")
    return name


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

        Warns (UserWarning) of slides without limits, which keep their default values, and of
        joints whose limits leave one value.

        Raises:
            UnknownNameError: the root link or a held position does not exist.
            ModelError: the root has no visual geometry, or the model's joints allow no pose tree.
            SettingsError: a position or value is missing, not finite, or outside the joint limits.
        """
        tree = build_pose_tree(self, root, root_position, root_rotation, held)
        for text in tree.warnings:
            warnings.warn(f"{self.path}: {text}", stacklevel=2)
        return tree

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

        ``plant``: a finalized plant that is registered with ``scene_graph``; do not change it
        later. ``scene_graph``: the SceneGraph that holds the plant's geometry. ``model_instances``:
        the instances whose bodies are drawn; None: all.

        Warns (UserWarning) of limits that are not as they are written, and of default positions
        that do not follow others as mimics say; ``pose_tree`` warns of slides without limits.

        Raises ModelError: the plant is not finalized or not registered, no chosen body has visual
        geometry, or its joints or geometry cannot be used.
        """
        name = require_registered(plant, scene_graph)
        all_instances = [ModelInstanceIndex(k) for k in range(1, plant.num_model_instances())]
        chosen = all_instances if model_instances is None else list(model_instances)
        bodies = [body for instance in chosen for body in plant.GetBodyIndices(instance)]
        path = Path(name)
        with _model_errors(path):
            positions, remarks = describe_positions(plant, {}, name)
            q, spans = plant.GetDefaultPositions(), positions["upper"] - positions["lower"]
            names, couplings = positions["position_names"], positions["couplings"]
            remarks += mimic_warnings(names, couplings, q, spans)
        meshes = _visual_meshes(path, plant, scene_graph, bodies)
        labelled = [labelled_meshes(plant, scene_graph, plant.get_body(body)) for body in bodies]
        for remark in summarise_warnings(remarks):
            warnings.warn(f"{name}: {remark}", stacklevel=2)
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
        skin = []
        for band in self.skin:
            if not {band.parent, band.child} & set(hidden):
                # A band is given in its child link's frame, so it scales with that link.
                vertices = band.mesh.vertices * link_scales.get(band.child, (1.0, 1.0, 1.0))
                skin.append(replace(band, mesh=TriangleMesh(vertices, band.mesh.triangles)))
        return self._changed(text, skin)

    def with_base_joints(self, X_WB: Array) -> "ArticulatedModel":
        """Return the model mounted on the six ``BASE_JOINTS``.

        ``X_WB``: (4, 4) pose of the model's base in the world when these joints are zero.

        Raises ModelError: the model is no URDF.
        """
        from scipy.spatial.transform import Rotation  # Slow to import.

        rpy = Rotation.from_matrix(X_WB[:3, :3]).as_euler("xyz")
        root = xml_element(self._urdf().text)
        for element in root.iter():
            for key in ("name", "link"):
                if element.tag in ("link", "parent", "child") and element.get(key) == "world":
                    element.set(key, "free_base")
        carried = {child.get("link") for child in root.iterfind("joint/child")}
        names = [link.get("name") for link in root.iterfind("link")]
        bases = [name for name in names if name not in carried]
        ElementTree.SubElement(root, "link", name="world")
        parent = "world"
        for k, name in enumerate(BASE_JOINTS):
            ElementTree.SubElement(root, "link", name=f"{name}_link")
            is_prismatic = k < 3
            joint = ElementTree.SubElement(
                root, "joint", name=name, type="prismatic" if is_prismatic else "continuous"
            )
            ElementTree.SubElement(joint, "parent", link=parent)
            ElementTree.SubElement(joint, "child", link=f"{name}_link")
            ElementTree.SubElement(
                joint, "axis", xyz=number_text(np.eye(3)[k if is_prismatic else 5 - k])
            )
            limit = {"lower": "-100", "upper": "100"} if is_prismatic else {}
            ElementTree.SubElement(joint, "limit", {**limit, "effort": "1", "velocity": "1"})
            parent = f"{name}_link"
        # The translation axes are the world's; the model's own rotation follows the joints.
        ElementTree.SubElement(root.findall("joint")[-6], "origin", xyz=number_text(X_WB[:3, 3]))
        for base in bases:
            joint = ElementTree.SubElement(root, "joint", name=f"free_{base}", type="fixed")
            ElementTree.SubElement(joint, "parent", link=parent)
            ElementTree.SubElement(joint, "child", link=str(base))
            ElementTree.SubElement(joint, "origin", rpy=number_text(rpy))
        moved = self._changed(xml_text(root), self.skin)
        positions, _ = describe_positions(moved.plant, self._source.limits, str(self.path))
        return replace(moved, **positions)

    def with_target(self, link: str, mesh: TriangleMesh, X_WO: Array) -> "ArticulatedModel":
        """Return the robot with a calibration target on six joints; only the target has geometry.

        The model serves a camera that is mounted on ``link``: the world and the link become tiny
        triangles, and links without a joint keep their pose at the default positions.

        ``link``: the link that carries the camera. ``mesh``: the target's surface in its own frame
        O. ``X_WO``: (4, 4) pose of the target in the world when all TARGET_POSITIONS are zero.

        Raises UnknownNameError: the link does not exist; ModelError: Drake refuses the model in the
        new plant.
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
        source = copy.copy(self._urdf())
        source.text = text
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
        found = {int(k): labelled_meshes(plant, scene_graph, plant.get_body(k)) for k in chosen}
        meshes = {names[k]: join_meshes([*own.values()]) for k, own in found.items()}
    meshes = {name: mesh for name, mesh in meshes.items() if not mesh.is_empty}
    if not meshes:
        raise ModelError(
            f"{path} has no visual geometry: nothing would be drawn; give its links <visual> "
            "elements (MJCF: geoms of a group below 3)"
        )
    return meshes


def reshaped(
    text: str,
    *,
    hidden: Collection[str] = (),
    link_scales: Vectors = MappingProxyType({}),
    link_shifts: Vectors = MappingProxyType({}),
    joint_shifts: Vectors = MappingProxyType({}),
    joint_offsets: Mapping[str, float] | None = None,
) -> str:
    """Return a URDF text with links and joints changed.

    Args:
        text: the URDF text.
        hidden: links that lose their visual geometry.
        link_scales: by link, (3,) scale factors of its visual geometry, and of the origins of the
            joints that it carries, along the axes of its frame. Shapes other than meshes are scaled
            as their type allows: spheres and capsule radii by the geometric mean.
        link_shifts: by link, (3,) shift [m] of its visual geometry and of the joints that it
            carries, in its frame.
        joint_shifts: by joint, (3,) shift [m] of its origin in its parent link's frame.
        joint_offsets: by joint, offset [rad or m] added to its position: its origin is rotated
            about its axis or shifted along it, and its limits are moved so that they stay in place.
            None: none.
    """
    root = xml_element(text)
    for link in root.iterfind("link"):
        name = link.get("name", "")
        for visual in link.findall("visual"):
            if name in hidden:
                link.remove(visual)
                continue
            if name in link_scales:
                _scale_shapes(visual, np.array(link_scales[name]))
            _move_origin(visual, link_scales.get(name), link_shifts.get(name))
    for joint in root.iterfind("joint"):
        parent = joint.find("parent")
        name, link_name = joint.get("name", ""), "" if parent is None else parent.get("link", "")
        _move_origin(
            joint, link_scales.get(link_name), joint_shifts.get(name), link_shifts.get(link_name)
        )
        if joint_offsets and joint_offsets.get(name):
            _offset_joint(joint, joint_offsets[name])
    return xml_text(root)


def _move_origin(
    element: ElementTree.Element,
    scale: Sequence[float] | None,
    *shifts: Sequence[float] | Array | None,
) -> None:
    """Scale the <origin> of an element by factors (3,), then add shifts (3,) [m]; None: neither."""
    vectors = [np.array(shift) for shift in shifts if shift is not None]
    if scale is None and not vectors:
        return
    position = np.array(_numbers(_origin(element).get("xyz", "0 0 0")))
    position = position if scale is None else position * scale
    _origin(element).set("xyz", number_text(sum(vectors, start=position)))


def _offset_joint(joint: ElementTree.Element, offset: float) -> None:
    """Add ``offset`` [rad or m] to a joint's position by moving its origin and its limits."""
    from scipy.spatial.transform import Rotation  # Slow to import.

    axis_element = joint.find("axis")
    axis = np.array(_numbers("1 0 0" if axis_element is None else axis_element.get("xyz", "")))
    axis /= np.linalg.norm(axis)
    R = Rotation.from_euler("xyz", _numbers(_origin(joint).get("rpy", "0 0 0")))
    if joint.get("type") == "prismatic":
        _move_origin(joint, None, R.apply(offset * axis))
    else:
        _origin(joint).set(
            "rpy", number_text((R * Rotation.from_rotvec(offset * axis)).as_euler("xyz"))
        )
    limit = joint.find("limit")
    for end in ("lower", "upper"):
        if limit is not None and joint.get("type") != "continuous" and end in limit.attrib:
            limit.set(end, number_text([float(limit.get(end, "0")) - offset]))


def _origin(element: ElementTree.Element) -> ElementTree.Element:
    """Return an element's <origin>, which is added where it is missing."""
    origin = element.find("origin")
    return ElementTree.SubElement(element, "origin") if origin is None else origin


def _scale_shapes(visual: ElementTree.Element, scale: Array) -> None:
    """Scale a visual's shapes by (3,) factors; by their geometric mean if it is rotated."""
    mean = [float(np.prod(scale)) ** (1.0 / 3.0)]
    if any(_numbers(_origin(visual).get("rpy", "0 0 0"))):
        scale = np.array(mean * 3)
    for shape in visual.iterfind("geometry/*"):
        if shape.tag.removeprefix("drake:") == "mesh":
            shape.attrib.setdefault("scale", "1 1 1")
        for name, factor in (
            ("scale", scale), ("size", scale), ("a", scale[:1]), ("b", scale[1:2]),
            ("c", scale[2:]), ("radius", mean), ("length", scale[2:]),
        ):  # fmt: skip
            if name in shape.attrib:
                shape.set(name, number_text(np.array(_numbers(shape.get(name, ""))) * factor))


def _numbers(text: str) -> list[float]:
    """Return the numbers in an attribute's text."""
    return [float(number) for number in text.split()]
