"""Positions, limits and skin of a model file, as Drake reads them.

The skin consists of bands: closed surfaces between two links that deform with the joints between
them (Kameda, Minoh, Ikeda, section 2). A band is given at rest, with all joints at zero. Each
vertex has a weight, from 0 at the parent link's end to 1 at the child link's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Joint, ModelInstanceIndex

from drake_pose.arrays import Array
from drake_pose.body.meshes import TriangleMesh, is_watertight, make_drawable, read_mesh_file
from drake_pose.body.parsing import ModelSource
from drake_pose.body.plant_source import Coupling, PlantSource, read_couplings
from drake_pose.errors import ModelError, UnknownNameError, require_known
from drake_pose.input_files import read_yaml, typed_entry


@dataclass(frozen=True, eq=False)
class SkinBand:
    """A band of surface between two links; the parent link is nearer to the world."""

    parent: str  # Name of the link that vertices of weight 0 move with.
    child: str  # Name of the link that vertices of weight 1 move with.
    # The closed surface [m] at rest (all joints at zero), in the child link's frame.
    mesh: TriangleMesh
    weights: Array  # (n,) weight of each vertex in [0, 1], read-only.
    colour: tuple[float, float, float] = (0.8, 0.8, 0.8)  # (r, g, b) in [0, 1].

    def __post_init__(self) -> None:
        """Store a read-only copy of the weights, rounded to six digits."""
        weights = np.asarray(self.weights, dtype=np.float64).round(6)
        weights.setflags(write=False)
        object.__setattr__(self, "weights", weights)


def skin_file(model_path: Path) -> Path:
    """Return the path of a model's skin file: ``woman.skin.yaml`` beside ``woman.urdf``."""
    return model_path.with_suffix(".skin.yaml")


@dataclass
class BandEntry:
    """An entry of ``bands`` in a skin file; ``load_skin`` describes its fields."""

    parent: str = ""
    child: str = ""
    mesh: str = ""
    axis: np.ndarray = field(default_factory=lambda: np.zeros(3))
    begin: float = 0.0
    end: float = 0.0
    colour: np.ndarray = field(default_factory=lambda: np.full(3, 0.8))


def load_skin(model_path: Path, link_names: Sequence[str]) -> tuple[SkinBand, ...]:
    """Read the skin file beside a model file; return () where there is none.

    ``link_names``: the names of the model's links. Each entry of ``bands`` has these fields:

    - ``parent``, ``child``: names of the two links.
    - ``mesh``: a closed mesh file in the child link's frame at rest, relative to the skin file.
    - ``axis``: (3,) a direction in the child link's frame.
    - ``begin``, ``end``: distances [m] from the child link's origin along the axis. The weight of a
      vertex rises smoothly from 0 at ``begin`` to 1 at ``end``.
    - ``colour``: (r, g, b), optional.

    Raises ModelError: the file or a mesh cannot be used; UnknownNameError: a band names a link that
    does not exist.
    """
    path = skin_file(model_path)
    if not path.is_file():
        return ()
    content = read_yaml(path, ModelError)
    entries = content.get("bands") if isinstance(content, dict) and len(content) == 1 else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ModelError(f"{path}: not a skin file (a list 'bands')")
    if not entries:
        raise ModelError(f"{path}: declares no band; add one under 'bands' or remove the file")
    bands = list[SkinBand]()
    for entry in entries:
        where = f"{path}: band '{entry.get('parent')}' - '{entry.get('child')}'"
        given = typed_entry(entry, BandEntry, where, ModelError)
        require_known("link", (given.parent, given.child), link_names, str(path))
        if given.parent == given.child:
            raise ModelError(f"{where}: parent and child must be two links")
        axis, begin, end, colour = given.axis, given.begin, given.end, given.colour
        if axis.shape != (3,) or not np.all(np.isfinite(axis)) or not axis.any():
            raise ModelError(f"{where}: axis must be three finite numbers, not all zero")
        if not -np.inf < begin < end < np.inf:
            raise ModelError(f"{where}: give begin and end along the axis [m], begin below end")
        if colour.shape != (3,) or not np.all((colour >= 0.0) & (colour <= 1.0)):
            raise ModelError(f"{where}: colour must be three numbers from 0 to 1")
        if not given.mesh:
            raise ModelError(f"{where}: name its mesh")
        mesh = read_mesh_file(path.parent / given.mesh)
        if not is_watertight(mesh):
            raise ModelError(f"{where}: {given.mesh} is not closed; close the band's ends")
        along = mesh.vertices @ (axis / np.linalg.norm(axis))
        # The weight of a vertex is the smoothstep of the fraction of the way from begin to end.
        fraction = np.clip((along - begin) / (end - begin), 0.0, 1.0)
        red, green, blue = colour.tolist()
        weights = fraction**2 * (3.0 - 2.0 * fraction)
        if any((given.parent, given.child) == (one.parent, one.child) for one in bands):
            raise ModelError(
                f"{path}: two bands between '{given.parent}' and '{given.child}'; join them"
            )
        bands.append(SkinBand(given.parent, given.child, mesh, weights, (red, green, blue)))
    return tuple(bands)


PositionKind = Literal["angle", "length", "quaternion"]

_KINDS: dict[str, tuple[PositionKind, ...]] = {
    "weld": (),
    "revolute": ("angle",),
    "prismatic": ("length",),
    "screw": ("angle",),
    "universal": ("angle", "angle"),
    "ball_rpy": ("angle", "angle", "angle"),
    "planar": ("length", "length", "angle"),
    "rpy_floating": ("angle", "angle", "angle", "length", "length", "length"),
    "quaternion_floating": (
        "quaternion", "quaternion", "quaternion", "quaternion", "length", "length", "length",
    ),
}  # fmt: skip
FLOATING_TYPES = ("rpy_floating", "quaternion_floating")

_FULL_TURN = 2.0 * np.pi
# Limits of a full turn, written with ten digits, must pass [rad].
_ROUNDING = 1e-9


def covers_full_turn(lower: Array, upper: Array, periodic: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (k,) bool: the position is periodic (k,) and its limits span a full turn or more.

    ``lower``, ``upper``: (k,) limits [rad or m].
    """
    return np.asarray(periodic & (upper - lower >= _FULL_TURN - _ROUNDING))


def one_turn(lower: Any, upper: Any, near: Any) -> tuple[Any, Any]:
    """Return lower and upper limits (k,), (k,) [rad] that span at most one turn.

    Where ``lower`` and ``upper`` (k,) are farther apart, they are narrowed to the full turn between
    them whose middle is nearest to ``near`` (k,). All arguments may be scalars.
    """
    low = np.clip(near - np.pi, lower, np.maximum(upper - _FULL_TURN, lower))
    return low, np.minimum(low + _FULL_TURN, upper)


def nearest_turn(values: Array, near: Array, periodic: NDArray[np.bool_] | bool) -> Array:
    """Return values (k,) [rad], periodic ones moved by full turns to the turn nearest to ``near``.

    ``near``: (k,) [rad]. ``periodic``: (k,) bool, or one for all. A result is within half a turn of
    ``near``; a value exactly half a turn away stays on its side.
    """
    turns = np.round((values - near) / _FULL_TURN)
    return np.asarray(np.where(periodic, values - _FULL_TURN * turns, values))


def describe_positions(
    plant: MultibodyPlant, given: Mapping[str, tuple[float, float]], where: str
) -> tuple[dict[str, Any], list[str]]:
    """Return names, kinds, limits and couplings of a finalized plant's positions, and warnings.

    ``given``: limits (lower, upper) [rad or m] by position name that replace the plant's limits.
    ``where``: the model file, for messages.

    Returns the attributes of ``ParsedModel`` that describe positions, by name, and the warnings.

    Raises UnknownNameError: ``given`` names a position that does not exist; ModelError: a joint has
    an unknown type, or limits that cannot be searched.
    """
    names = plant.GetPositionNames(add_model_instance_prefix=False, always_add_suffix=False)
    scoped = plant.GetPositionNames(add_model_instance_prefix=True, always_add_suffix=False)
    names = [a if names.count(a) == 1 else b for a, b in zip(names, scoped, strict=True)]
    require_known("joint", given, names, where)
    count = plant.num_positions()
    kinds: list[PositionKind] = ["angle"] * count
    lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
    periodic, free = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
    defaults = np.array(plant.GetDefaultPositions(), dtype=np.float64)
    warnings: list[str] = []
    for joint in (plant.get_joint(index) for index in plant.GetJointIndices()):
        kind = joint.type_name()
        if kind not in _KINDS:
            raise ModelError(
                f"joint '{joint.name()}' is of type '{kind}', which cannot be searched; use one of "
                f"{', '.join(_KINDS)}"
            )
        first = joint.position_start()
        for i in range(first, first + joint.num_positions()):
            kinds[i] = _KINDS[kind][i - first]
            periodic[i] = kinds[i] == "angle" and kind != "screw"
            if kind not in FLOATING_TYPES:
                default, limits = float(defaults[i]), given.get(names[i])
                found = _search_limits(joint, i - first, names[i], default, limits)
                lower[i], upper[i], free[i], remark = found
                warnings += [remark] * bool(remark)
    couplings = _resolve_chains(read_couplings(plant), names)
    warnings += _intersect_limits(couplings, names, (lower, upper, periodic, free))
    free &= periodic
    defaults = np.clip(defaults, lower, upper)
    for follower, leader, multiplier, offset in couplings:
        defaults[follower] = multiplier * defaults[leader] + offset
    for array in (lower, upper, defaults, periodic, free):
        array.setflags(write=False)
    attributes: dict[str, Any] = {
        "position_names": tuple(names),
        "position_kinds": tuple(kinds),
        "lower": lower,
        "upper": upper,
        "default_positions": defaults,
        "periodic": periodic,
        "is_unlimited_angle": free,
        "couplings": couplings,
    }
    return attributes, warnings


def _resolve_chains(found: Sequence[Coupling], names: Sequence[str]) -> tuple[Coupling, ...]:
    """Return the couplings ``found`` in a plant, rewritten so that no leader follows a position.

    ``names``: the position names, for messages. Raises ModelError: two positions are coupled in two
    ways.
    """
    of = {k: Coupling(k, k, 1.0, 0.0) for coupling in found for k in coupling[:2]}
    for i, j, multiplier, offset in found:
        follower, leader = of[i], of[j]
        scale = multiplier * leader.multiplier / follower.multiplier
        shift = (multiplier * leader.offset + offset - follower.offset) / follower.multiplier
        if follower.leader == leader.leader:
            raise ModelError(
                f"joints '{names[i]}' and '{names[j]}' are coupled in two ways (<mimic>): remove "
                "one of them"
            )
        for k, known in of.items():
            if known.leader == follower.leader:
                m = known.multiplier
                of[k] = Coupling(k, leader.leader, m * scale, m * shift + known.offset)
    return tuple(coupling for k, coupling in sorted(of.items()) if coupling.leader != k)


def _intersect_limits(
    couplings: Sequence[Coupling],
    names: Sequence[str],
    arrays: tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]],
) -> list[str]:
    """Intersect the limits of coupled positions in place; return warnings.

    A leader keeps the values at which it and its followers are within their limits; followers get
    the limits that follow from it. A follower whose limits leave its leader a single value loses
    these limits (PR2's have the wrong sign). A leader stays periodic if all its followers'
    multipliers are whole numbers.

    ``couplings``: couplings whose leaders follow no other position. ``names``: the position names,
    for messages. ``arrays``: lower, upper, periodic and is_unlimited_angle of ``ParsedModel``,
    changed in place. Raises ModelError: the limits of a leader and a follower exclude each other.
    """
    lower, upper, periodic, free = arrays
    warnings = []
    for follower, leader, multiplier, offset in couplings:
        periodic[leader] &= multiplier.is_integer()
        if free[follower]:
            continue
        ends = np.sort((np.array([lower[follower], upper[follower]]) - offset) / multiplier)
        leader_range = [-np.inf, np.inf] if free[leader] else [lower[leader], upper[leader]]
        low, high = max(ends[0], leader_range[0]), min(ends[1], leader_range[1])
        conflict = f"joint '{names[follower]}' follows joint '{names[leader]}' (<mimic>: "
        conflict += f"{multiplier:g} x {offset:+g}), but their limits leave "
        if low > high + _ROUNDING:
            raise ModelError(f"{conflict}no value for both; widen them")
        if high - low <= _ROUNDING < leader_range[1] - leader_range[0]:
            warnings.append(
                f"{conflict}only {low:g}: the follower's limits are ignored; correct them"
            )
            continue
        lower[leader], upper[leader], free[leader] = low, max(low, high), False
    for follower, leader, multiplier, offset in couplings:
        ends = multiplier * np.array([lower[leader], upper[leader]]) + offset
        lower[follower], upper[follower] = ends.min(), ends.max()
        free[follower] &= free[leader]
    return warnings


def mimic_warnings(
    names: Sequence[str], followers: Sequence[Coupling], q: Array, spans: Array, slack: float = 0.1
) -> list[str]:
    """Return a warning for each position in q that does not follow its leader (<mimic>).

    ``names``: the position names. ``q``: (nq,) or (n, nq) positions [rad or m]; nan: unknown.
    ``spans``: (nq,) upper minus lower limits [rad or m]. ``slack``: tolerance, the smaller of this
    [rad or m] and this fraction of the span.
    """
    warnings = list[str]()
    for follower, leader, multiplier, offset in followers:
        off = np.abs(q[..., follower] - multiplier * q[..., leader] - offset)
        worst = float(np.fmax.reduce(off, axis=None, initial=0.0))
        if worst > slack * min(1.0, spans[follower]):
            warnings.append(
                f"joint '{names[follower]}' is written to follow joint '{names[leader]}' (<mimic>: "
                f"{multiplier:g} x {offset:+g}), but the positions given differ from that by up to "
                f"{worst:.3g} [rad or m]: the body is posed by the <mimic>; correct the positions, "
                "or the <mimic>"
            )
    return warnings


def _search_limits(
    joint: Joint, index: int, name: str, default: float, given: tuple[float, float] | None
) -> tuple[float, float, bool, str]:
    """Return the limits of one position for the search.

    Limits more than four turns apart (a hundred turns for a screw, a kilometre for a slide) count
    as no limits. An angle without limits is searched over one turn about its default.

    ``index``: index of the position in the joint. ``name``: the position's name, for messages.
    ``default``: the default position [rad or m]. ``given``: limits (lower, upper) [rad or m] that
    replace the joint's; None: the joint's.

    Returns the lower and the upper limit [rad or m], whether the position counts as unlimited, and
    a warning ("": none). An unlimited length has infinite limits.

    Raises ModelError: limits are NaN or crossed, an angle's are one-sided, or a screw's too wide.
    """
    kind = joint.type_name()
    is_length, is_screw = _KINDS[kind][index] == "length", kind == "screw"
    several = f" (its {joint.position_suffix(index)})" if joint.num_positions() > 1 else ""
    title = f"joint '{joint.name()}'{several}"
    low, high = given or (
        float(joint.position_lower_limits()[index]),
        float(joint.position_upper_limits()[index]),
    )
    if np.isnan(low) or np.isnan(high):
        raise ModelError(f"{title}: a limit is NaN; give numbers, lower first")
    if low > high:
        raise ModelError(f"{title}: lower limit {low:g} is above upper limit {high:g}")
    turns = 100.0 if is_screw else 4.0
    widest = 1e3 if is_length else turns * _FULL_TURN
    if high - low <= widest * (1.0 + _ROUNDING):
        return low, high, False, ""
    unlimited, one_sided = low == -high == -np.inf, np.isinf(low) != np.isinf(high)
    if is_length:  # Such slides may place the object in the world: see tree_builder.
        remark = f"{title} has limits of {low:g} and {high:g} m, more than {widest:g} m apart: "
        remark = "" if unlimited or one_sided else f"{remark}they are ignored; correct them"
        return -np.inf, np.inf, True, remark
    advice = (
        "give it a lower and an upper limit in the model file (or to load_model: "
        f"limits={{'{name}': (low, high)}})"
    )
    if one_sided or (is_screw and not unlimited):
        lacks = "limits" if one_sided else "limits that can be searched"
        raise ModelError(
            f"{title} has no {lacks}: lower {low:g}, upper {high:g} [rad]; {advice}, so that its "
            "values can be searched"
        )
    start, end = one_turn(low, high, default)
    searched = f"{np.degrees(start):.6g} to {np.degrees(start + _FULL_TURN):.6g} degrees"
    remark = ""
    if is_screw:
        remark = f"{title} is a screw without limits: searched from {searched}; {advice}"
    elif not unlimited:
        remark = (
            f"{title} has limits of {low:g} and {high:g} rad, more than {turns:g} turns apart: it "
            f"is taken to turn freely, and its angle is reported from {searched}; correct the "
            "limits if it does not"
        )
    return float(start), float(end), True, remark


@dataclass(frozen=True, eq=False, repr=False)
class ParsedModel:
    """What a model file says, as Drake reads it. Immutable.

    Arrays about positions have shape (nq,), are in the order of the plant's q, and are read-only.

    Attributes:
        position_names: each position's joint, or ``joint_suffix`` for joints of several positions.
        position_kinds: "angle" [rad], "length" [m] or "quaternion".
        lower, upper: limits [rad or m]. A joint that turns freely has half a turn either side of
            its default position; a floating body's pose and slides without limits have infinite
            ones.
        default_positions: Drake's default positions, moved inside the limits.
        periodic: whether the position is an angle with the same pose after a full turn, which all
            angles but those of screws are.
        is_unlimited_angle: whether the position is an angle without limits, or with limits so wide
            that they are ignored.
        couplings: positions that follow others; no leader follows another position.
        path: the model file, or the name of the plant.
        name: the model's name in its file.
        plant: a finalized MultibodyPlant, from which contexts are made; do not change it.
        scene_graph: the SceneGraph with the plant's geometry.
        link_meshes: the visual geometry of each link that has some, in the link's frame.
        skin: the bands of surface that deform with the joints (``load_skin``).
        warnings: parts of the file that are not read or not enforced, limits that are ignored, and
            Drake's own warnings.
        labels: the render labels of the bodies of a model from ``from_plant``; else None.
        _source: what is parsed to copy the model into other plants.
    """

    position_names: tuple[str, ...]
    position_kinds: tuple[PositionKind, ...]
    lower: Array
    upper: Array
    default_positions: Array
    periodic: NDArray[np.bool_]
    is_unlimited_angle: NDArray[np.bool_]
    couplings: tuple[Coupling, ...]
    path: Path
    name: str
    plant: MultibodyPlant
    scene_graph: SceneGraph
    link_meshes: Mapping[str, TriangleMesh]
    skin: tuple[SkinBand, ...]
    warnings: tuple[str, ...]
    _source: ModelSource | PlantSource = field(repr=False)
    labels: frozenset[int] | None = None

    def __repr__(self) -> str:
        """Return one line with the model's name, file, number of positions and number of links."""
        return (
            f"<{type(self).__name__} '{self.name}' of {self.path}: "
            f"{len(self.position_names)} positions, {len(self.link_meshes)} links with a surface>"
        )

    def add_to(
        self, plant: MultibodyPlant, scene_graph: SceneGraph | None = None, *, prefix: str = ""
    ) -> list[ModelInstanceIndex]:
        """Add the model to another plant, for example a diagram's, and return its model instances.

        Mesh files that Drake would not draw are replaced as in this model. Add renderers to the
        SceneGraph after this call, because Drake's VTK renderer rejects an OBJ file without normals
        as soon as it is parsed.

        ``plant``: a plant that is not finalized. ``scene_graph``: the SceneGraph to register the
        plant with; None: add no geometry. ``prefix``: put before the model's name, so that several
        copies have different names. Raises ModelError: Drake refuses the model in that plant.
        """
        instances, _ = self._source.parse(plant, scene_graph, prefix)
        if plant.geometry_source_is_registered():
            make_drawable(plant, scene_graph, instances)
        return instances

    @cached_property
    def link_names(self) -> tuple[str, ...]:
        """All links, with or without geometry, in the order of the plant's bodies."""
        return link_names(self.plant)

    def link_index(self, name: str) -> int:
        """Return a link's index among the plant's bodies; UnknownNameError if it does not exist."""
        if name not in self.link_names:
            raise UnknownNameError("link", name, self.link_names, str(self.path))
        return self.link_names.index(name)

    def carried_by(self, link: str) -> tuple[str, ...]:
        """Return a link and all that it carries, base first; UnknownNameError: no such link."""
        plant, names = self.plant, self.link_names
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        pairs = [(int(j.parent_body().index()), int(j.child_body().index())) for j in joints]
        found = [self.link_index(link)]
        for parent in found:
            found += [child for own, child in pairs if own == parent and child not in found]
        return tuple(names[k] for k in found)

    def position_index(self, name: str) -> int:
        """Return a position's index in q; UnknownNameError if it does not exist."""
        if name not in self.position_names:
            raise UnknownNameError("joint", name, self.position_names, str(self.path))
        return self.position_names.index(name)


def link_names(plant: MultibodyPlant) -> tuple[str, ...]:
    """Return a unique name for each body, ``instance::link`` where a link's name repeats."""
    bodies = [plant.get_body(BodyIndex(index)) for index in range(plant.num_bodies())]
    plain = [body.name() for body in bodies]
    return tuple(
        body.name() if plain.count(body.name()) == 1 else body.scoped_name().get_full()
        for body in bodies
    )
