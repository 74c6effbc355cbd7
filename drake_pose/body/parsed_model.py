"""What a model file says of links, joints, limits and looks, as plain values and Drake's plant."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ModelInstanceIndex

from drake_pose.body.formats.parsing import ModelSource
from drake_pose.body.limits import Positions
from drake_pose.body.surfaces.meshes import TriangleMesh
from drake_pose.body.surfaces.skin_file import SkinBand
from drake_pose.body.surfaces.visual_geometry import make_drawable
from drake_pose.errors import UnknownNameError


@dataclass(frozen=True, eq=False)
class ParsedModel(Positions):
    """What a model file says, as Drake understands it. Never changes.

    Attributes:
        plant: a finalized MultibodyPlant, to make contexts from; do not change it.
        link_meshes: the visual geometry of each link that has some, in the link's frame.
        skin: the bands of surface that bend with the joints (``load_skin``); usually none.
        warnings: what is not read of the file or not enforced, which limits were not taken as they
            are written, and what Drake remarked.
    """

    path: Path
    name: str
    plant: MultibodyPlant
    scene_graph: SceneGraph
    link_meshes: Mapping[str, TriangleMesh]
    skin: tuple[SkinBand, ...]
    warnings: tuple[str, ...]
    _source: ModelSource = field(repr=False)

    def add_to(
        self, plant: MultibodyPlant, scene_graph: SceneGraph | None = None, *, prefix: str = ""
    ) -> list[ModelInstanceIndex]:
        """Add the same model to another plant, for example one of a diagram; its new instances.

        Mesh files that Drake would not draw are replaced as in this model. Add renderers to the
        SceneGraph after this call: Drake's VTK renderer rejects an OBJ file without normals at the
        moment it is parsed.

        Args:
            plant: a plant that is not finalized.
            scene_graph: the SceneGraph it is or shall be registered with; None for no geometry.
            prefix: put before the model's name, to tell several copies apart.

        Raises ModelError: Drake refuses the model in that plant.
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
        """The index of a link among the plant's bodies; UnknownNameError where there is none."""
        if name not in self.link_names:
            raise UnknownNameError("link", name, self.link_names, str(self.path))
        return self.link_names.index(name)

    def position_index(self, name: str) -> int:
        """Where a position stands in q; UnknownNameError where none has that name."""
        if name not in self.position_names:
            raise UnknownNameError("joint", name, self.position_names, str(self.path))
        return self.position_names.index(name)


def link_names(plant: MultibodyPlant) -> tuple[str, ...]:
    """A unique name for each body, in the plant's order: ``instance::link`` where links repeat."""
    bodies = [plant.get_body(BodyIndex(index)) for index in range(plant.num_bodies())]
    plain = [body.name() for body in bodies]
    return tuple(
        body.name() if plain.count(body.name()) == 1 else body.scoped_name().get_full()
        for body in bodies
    )
