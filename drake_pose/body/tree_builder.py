"""Construction of a PoseTree from a model's link graph.

Starting at the root, each link group with geometry becomes a node. Groups without geometry are
skipped, or kept as empty nodes where several branches meet. Joints that are traversed towards the
plant's world are inverted. Branches whose joints all follow another branch's are attached to it.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body.link_graph import (
    JointEdge,
    JointMap,
    LinkGraph,
    PlantKinematics,
    build_link_graph,
    chain_transforms,
)
from drake_pose.body.node_skin import find_skin, require_neighbours
from drake_pose.body.parsed_model import ParsedModel
from drake_pose.body.plant_source import Coupling
from drake_pose.body.pose_tree import NodePlacement, PoseTree, PoseTreeNode, place_node
from drake_pose.body.root import BasePose, RootRotation, base_of_chain
from drake_pose.errors import ModelError, SettingsError, UnknownNameError

Roots = dict[int, tuple[Array, RootRotation | None]]
"""X_WA (4, 4) and rotation of each root, by the index of its branch."""


@dataclass(frozen=True)
class Branch:
    """A node under construction."""

    group: int  # Index of the node's link group.
    parent: int  # Index of the parent branch; -1: the world.
    depth: int  # Number of edges to the root.
    steps: tuple[JointMap, ...] = ()  # The joints from the parent to the node, in traversal order.
    positions: tuple[int, ...] = ()  # Indices of their positions in q.
    # How the joints follow the parent's values; the branch then has no positions.
    follows: tuple[Coupling, ...] = ()


def build_pose_tree(
    model: ParsedModel,
    root: str | None = None,
    root_position: Sequence[float] | Array | None = None,
    root_rotation: RootRotation | None = None,
    held: Mapping[str, float] | None = None,
) -> PoseTree:
    """Build a pose tree of a model; see ``ArticulatedModel.pose_tree`` for the errors.

    Args:
        root: name of the root link; None: the link with geometry nearest to the plant's world.
        root_position: (3,) the root link's origin in the world [m]; None: as in the model file.
        root_rotation: rotations of the root link; None: those of the base joint.
        held: values [rad or m] of positions that are not searched, by name; None: none.
    """
    held, rounding = held or {}, 1e-6
    if root is not None and root not in model.link_names:
        raise UnknownNameError("link", root, model.link_names, str(model.path))
    held_values = {model.position_index(name): float(value) for name, value in held.items()}
    # Leaders and followers of held positions are held, too.
    for follower, leader, multiplier, offset in model.couplings:
        if follower in held_values:
            held_values.setdefault(leader, (held_values[follower] - offset) / multiplier)
    for follower, leader, multiplier, offset in model.couplings:
        if leader in held_values:
            implied = multiplier * held_values[leader] + offset
            if abs(held_values.setdefault(follower, implied) - implied) > rounding:
                first, second = (model.position_names[k] for k in (follower, leader))
                raise SettingsError(
                    f"joint '{first}' is held at {held_values[follower]:g}, but it follows joint "
                    f"'{second}' (<mimic>): {implied:g} [rad or m]; hold only one of them"
                )
    for name, value in held.items():
        if not np.isfinite(value):
            raise SettingsError(f"held joint '{name}' has the value {value}: give a finite number")
    for index, value in held_values.items():
        lower, upper = model.lower[index], model.upper[index]
        inside = lower - rounding <= value <= upper + rounding
        if not inside and not model.is_unlimited_angle[index]:
            raise SettingsError(
                f"joint '{model.position_names[index]}' is held at {value:g}, outside its limits, "
                f"{lower:g} to {upper:g} [rad or m]"
            )
    position = None if root_position is None else _checked_position(root_position)
    graph = build_link_graph(model, root)
    if root is not None and not graph.has_geometry(graph.group_of(root)):
        raise ModelError(
            f"{model.path}: link '{root}' has no visual geometry, nor have links welded to it, so "
            f"it cannot be the root; links with geometry: {', '.join(model.link_meshes)}"
        )
    start = _choose_root(model, graph, root, root_rotation)
    rotation = root_rotation or RootRotation.free()
    if start is not None and start[1] and root_rotation is None:
        # A floating base keeps its rotation at the default positions, unless one is given.
        X_WR = PlantKinematics(model).pose(graph.groups[start[0]].body)
        rotation = RootRotation.fixed(X_WR[:3, :3])

    def build(p_WR: Array | None) -> PoseTree:
        """Return the tree with the root's origin at p_WR (3,) [m], or as in the model file."""
        if start is None:
            tree = _plant_rooted(model, graph, p_WR, held_values)
        else:
            tree = _rerooted(model, graph, *start, p_WR, rotation, held_values)
        return replace(tree, _rebuild=lambda moved: build(_checked_position(moved)))

    return build(position)


def _checked_position(position: Sequence[float] | Array) -> Array:
    """Return a position as an array (3,); SettingsError unless it is finite."""
    array = np.array(position, dtype=np.float64)
    if array.shape != (3,) or not np.all(np.isfinite(array)):
        raise SettingsError(f"root position {position}: give three finite numbers [m]")
    return array


def _choose_root(
    model: ParsedModel, graph: LinkGraph, root: str | None, rotation: RootRotation | None
) -> tuple[int, bool] | None:
    """Return the group that a RootRotation places, and whether it is the plant's own root.

    None: the tree keeps the plant's own roots, which are attached to the plant's world. The plant's
    own root has a default position; other roots need one. ``root``, ``rotation``: the user's, if
    any.
    """
    # The group of the first node behind each floating joint that moves geometry.
    floating = []
    for edge in (edge for edge in graph.edges if edge.joint_map is None):
        if edge.inner != 0:
            raise ModelError(
                f"link '{graph.groups[edge.outer].name}' floats relative to "
                f"'{graph.groups[edge.inner].name}'; only the world may carry a floating joint"
            )
        branches = _branches(graph, edge.outer)
        if any(graph.has_geometry(branch.group) for branch in branches):
            # A group without geometry is a node only if it has several children.
            children = [branch.group for branch in branches if branch.parent == 0]
            only_carries = not graph.has_geometry(edge.outer) and len(children) == 1
            floating.append(children[0] if only_carries else edge.outer)
    if len(floating) > 1:
        names = [graph.groups[group].name for group in floating]
        raise ModelError(
            f"{model.path}: links {', '.join(names)} float freely and independently; a pose tree "
            "needs one object: weld the others to the world or leave them out"
        )
    asked = None if root is None else graph.group_of(root)
    if floating:
        return floating[0] if asked is None else asked, asked in (None, floating[0])
    tops = [0] if graph.has_geometry(0) else [b.group for b in _branches(graph, 0) if b.parent < 0]
    if asked is None or (rotation is None and tops == [asked]):
        if rotation is None:
            return None
        if len(tops) > 1:
            names = [graph.groups[group].name for group in tops]
            raise SettingsError(f"root_rotation needs a root: name one of {', '.join(names)}")
        return tops[0], True
    return asked, tops == [asked]


def _branches(graph: LinkGraph, start: int) -> list[Branch]:
    """Return the branches reached from the group ``start`` without crossing a floating joint.

    Groups without geometry are skipped unless several branches meet there, and chains that end
    without geometry are left out. Branches are sorted by depth, then by body; ``parent`` is an
    index in the result.
    """
    # Prune chains that end in a group without geometry.
    edges_at = {
        group: [edge for edge in graph.edges_at(group) if edge.joint_map is not None]
        for group in range(len(graph.groups))
    }
    pruned = True
    while pruned:
        pruned = False
        for group, edges in edges_at.items():
            if len(edges) == 1 and group != start and not graph.has_geometry(group):
                edge = edges.pop()
                edges_at[edge.other(group)].remove(edge)
                pruned = True
    found: list[Branch] = []
    queue: list[tuple[Branch, JointEdge | None]] = [(Branch(start, -1, 0), None)]
    for branch, last in queue:
        group = branch.group
        is_node = graph.has_geometry(group) or len(edges_at[group]) > 2 or group == start != 0
        if is_node:
            found.append(branch)
            after = Branch(group, len(found) - 1, branch.depth + 1)
        else:
            after = branch
        for edge in edges_at[group]:
            if edge is not last and edge.joint_map is not None:
                step = replace(edge.joint_map, inverted=edge.outer == group)
                walked = (*after.steps, step), (*after.positions, *edge.positions)
                queue.append((Branch(edge.other(group), after.parent, after.depth, *walked), edge))
    return _ordered(found, lambda one: (one.depth, graph.groups[one.group].body))


def _ordered(found: list[Branch], key: Callable[[Branch], tuple[int, int]]) -> list[Branch]:
    """Return the branches ``found`` sorted by a key, with updated parent indices."""
    order = sorted(range(len(found)), key=lambda i: key(found[i]))
    return [
        replace(found[i], parent=order.index(found[i].parent) if found[i].parent >= 0 else -1)
        for i in order
    ]


def _attach_followers(
    model: ParsedModel, graph: LinkGraph, branches: list[Branch], held: Collection[int]
) -> list[Branch]:
    """Reattach branches whose joints all follow one branch's positions as children of that branch.

    The pose of a node in its parent then depends on its own values only, or on its parent's values
    only. A branch stays where it is if other joints move it or a skin band is attached to it.

    ``held``: indices in q of positions that are not searched; they follow nothing. Returns all
    branches, sorted as by ``_branches``.
    """
    couplings, followers = _couplings_by_position(model), {one.follower for one in model.couplings}
    skinned = {graph.group_of(link) for band in model.skin for link in (band.parent, band.child)}
    leaders: dict[int, tuple[int, int]] = {}
    found: list[Branch] = []
    # A leader comes before its followers, wherever it stands in the model.
    branches = _ordered(branches, lambda one: (one.depth, not followers.isdisjoint(one.positions)))
    for i, branch in enumerate(branches):
        known = [couplings.get(p) if p not in held else None for p in branch.positions]
        candidates = {
            leaders[coupling.leader][0] if coupling and coupling.leader in leaders else -1
            for coupling in known
        }
        parent, leader = branch.parent, min(candidates, default=-1)
        parent_branch = found[parent] if parent >= 0 else branch
        is_sibling = leader >= 0 and parent == branches[leader].parent
        is_below = parent == leader or (parent_branch.parent == leader and parent_branch.follows)
        if (
            leader < 0
            or len(candidates) > 1
            or branch.group in skinned
            or not (is_sibling or is_below)
        ):
            for coupling, position in zip(known, branch.positions, strict=True):
                if coupling:
                    leaders.setdefault(coupling.leader, (i, position))
            found.append(replace(branch, depth=parent_branch.depth + (parent >= 0)))
            continue
        leading, steps, follows = found[leader], branch.steps, list[Coupling]()
        if is_sibling:
            last = len(leading.positions)
            for step in leading.steps[::-1]:
                last -= step.position_count
                own = leading.positions[last : last + step.position_count]
                follows += [Coupling(p, last + k, 1.0, 0.0) for k, p in enumerate(own)]
            steps = *(replace(s, inverted=not s.inverted) for s in leading.steps[::-1]), *steps
        elif parent != leader:
            steps, follows = parent_branch.steps + steps, list(parent_branch.follows)
        for coupling in (coupling for coupling in known if coupling):
            relation = _relative_coupling(couplings, coupling.follower, leaders[coupling.leader][1])
            follows.append(relation._replace(leader=leading.positions.index(relation.leader)))
        found.append(Branch(branch.group, leader, leading.depth + 1, steps, (), tuple(follows)))
    return _ordered(found, lambda one: (one.depth, graph.groups[one.group].body))


def _couplings_by_position(model: ParsedModel) -> dict[int, Coupling]:
    """Return the coupling of each follower and leader, by index in q; a leader follows itself."""
    leaders = {leader: Coupling(leader, leader, 1.0, 0.0) for _, leader, *_ in model.couplings}
    return leaders | {coupling.follower: coupling for coupling in model.couplings}


def _relative_coupling(couplings: Mapping[int, Coupling], follower: int, leader: int) -> Coupling:
    """Return how position ``follower`` follows position ``leader``; both have a common leader.

    ``couplings``: the coupling of each position, by its index in q.
    """
    first, second = couplings[follower], couplings[leader]
    multiplier = first.multiplier / second.multiplier
    return Coupling(follower, leader, multiplier, first.offset - multiplier * second.offset)


def _followers(
    model: ParsedModel, searched: Sequence[int], known: Collection[int]
) -> tuple[Coupling, ...]:
    """Return the couplings of positions that follow ``searched`` ones and are not in ``known``.

    Both hold indices in q. The leaders in the result are searched positions.
    """
    couplings, found = _couplings_by_position(model), []
    for follower, coupling in couplings.items():
        own = [p for p in searched if p in couplings and couplings[p].leader == coupling.leader]
        if own and follower not in known:
            found.append(_relative_coupling(couplings, follower, own[0]))
    return tuple(found)


def _plant_rooted(
    model: ParsedModel, graph: LinkGraph, position: Array | None, held: dict[int, float]
) -> PoseTree:
    """Return the tree with the plant's own roots, which are attached to the plant's world.

    ``position``: (3,) the root's origin in the world [m]; None: as in the model file. ``held``:
    values of held positions [rad or m], by index in q.
    """
    branches = _attach_followers(model, graph, _branches(graph, 0), held)
    # The world is a branch itself if it has geometry.
    on_world = 0 if branches and branches[0].group == 0 else -1
    objects = [branch.positions for branch in branches if branch.parent == on_world]
    # Slides without limits between the world and its only object place it, as a floating joint does
    # (planar robots in MJCF have two such slides). They are not searched; root_position moves the
    # object.
    placing = [slide for positions in objects for slide in _unlimited_slides(model, positions)]
    free = [slide for slide in placing if slide not in held]
    if len(objects) > 1 and free:
        raise ModelError(
            f"{_missing_limits(model, free)}; of {len(objects)} objects in the world none can keep "
            "its position"
        )
    held = {slide: float(model.default_positions[slide]) for slide in placing} | held
    solved: dict[int, float] = {}
    X_WB = np.eye(4)
    tops = [index for index, branch in enumerate(branches) if branch.parent < 0]
    if position is not None:
        if len(tops) > 1:
            raise SettingsError(
                "root_position needs a root: several links are attached to the world"
            )
        top = branches[tops[0]]
        slides = [model.position_kinds[index] == "length" for index in top.positions[:3]]
        if slides == [True] * 3 and all(s.position_count == 1 for s in top.steps[:3]):
            solved = _solve_translations(model, top, position)
        else:
            body = graph.groups[top.group].body
            X_WB[:3, 3] = position - PlantKinematics(model).pose(body)[:3, 3]
    X_WA = X_WB @ PlantKinematics(model).pose(graph.groups[0].body)
    roots: Roots = dict.fromkeys(tops, (X_WA, None))
    base = BasePose("constant", X_WB)
    assumed = tuple(slide for slide in free if slide not in solved)
    return _assemble(model, graph, branches, roots, base, held | solved, "world", assumed)


def _solve_translations(model: ParsedModel, top: Branch, p_WN: Array) -> dict[int, float]:
    """Return values [m], by index in q, of the first three positions of the root branch ``top``.

    The three are translations; they put the node's origin at p_WN (3,) [m]. Raises ModelError:
    later joints move the origin, or the translations do not span all directions.
    """
    values = model.default_positions[list(top.positions)].copy()
    values[:3] = 0.0
    turned = values.copy()
    turned[3:] += 0.5
    samples = np.vstack([values, turned, values + np.eye(len(values))[:3]])
    origin, moved, *ends = chain_transforms(top.steps, samples)[:, :3, 3]
    names = ", ".join(model.position_names[index] for index in top.positions[:3])
    if np.abs(moved - origin).max() > 1e-9:
        raise ModelError(
            f"{model.path}: the root link's origin moves when its joints turn, so the joints "
            f"{names} cannot hold it at root_position; hold them yourself instead"
        )
    matrix = (np.array(ends) - origin).T
    if np.linalg.matrix_rank(matrix) < 3:
        raise ModelError(f"{model.path}: joints {names} do not span all directions")
    solved = np.linalg.solve(matrix, p_WN - origin).tolist()
    return dict(zip(top.positions[:3], solved, strict=True))


def _rerooted(
    model: ParsedModel,
    graph: LinkGraph,
    start: int,
    is_own: bool,
    position: Array | None,
    rotation: RootRotation,
    held: dict[int, float],
) -> PoseTree:
    """Return the tree that starts at a link with its own pose in the world.

    ``start``: index of the root's group in ``graph``. ``is_own``: whether the root is the plant's
    own root. ``position``: (3,) the root's origin in the world [m]; None: its default position,
    which only the plant's own root has. ``rotation``: the root's rotation in the world. ``held``:
    values of held positions [rad or m], by index in q.

    Raises SettingsError: a position is missing, or a held position follows from the root's pose.
    """
    root = graph.groups[start]
    if position is None:
        if not is_own:
            raise SettingsError(
                f"root '{root.name}': give root_position, its origin's position in the world [m]"
            )
        position = PlantKinematics(model).pose(root.body)[:3, 3]
    branches = _attach_followers(model, graph, _branches(graph, start), held)
    X_WA = np.eye(4)
    X_WA[:3, 3] = position
    roots: Roots = {0: (X_WA, rotation)}
    groups = [branch.group for branch in branches]
    if 0 in groups:
        base = BasePose("placed", node=groups.index(0), body=graph.groups[0].body)
    else:
        # Find the edges from the world outwards to the nearest group of the tree.
        queue: list[tuple[int, list[JointEdge]]] = [(0, [])]
        for group, chain in queue:
            if group in groups:
                break
            queue += [(e.outer, [*chain, e]) for e in graph.edges if e.inner == group]
        base = base_of_chain(model, graph, chain, groups.index(chain[-1].outer), held)
        if any(edge.joint_map is None for edge in chain):
            # Geometry of the world beside a floating object makes further roots.
            X_WA = PlantKinematics(model).pose(graph.groups[0].body)
            for branch in _branches(graph, 0):
                if branch.parent < 0:
                    roots[len(branches)] = (X_WA, None)
                else:
                    branch = replace(branch, parent=branch.parent + len(groups))
                branches.append(branch)
    taken = [model.position_names[index] for index in base.positions if index in held]
    if taken:
        raise SettingsError(
            f"joints {', '.join(taken)} cannot be held: they follow from the pose of the root "
            f"'{root.name}'"
        )
    return _assemble(model, graph, branches, roots, base, held, root.name)


def _assemble(
    model: ParsedModel,
    graph: LinkGraph,
    branches: list[Branch],
    roots: Roots,
    base: BasePose,
    held: dict[int, float],
    root: str,
    assumed: Sequence[int] = (),
) -> PoseTree:
    """Return the pose tree with one node for each branch, in their order.

    ``branches``: branches of ``graph``, parents before children. ``roots``: pose and rotation of
    the branches without parents. ``base``: how the plant takes up the pose of the tree's root.
    ``held``: values of held positions [rad or m], by index in q. ``root``: name of the root node,
    for ``PoseTree.root``. ``assumed``: indices in q, for ``PoseTree.assumed``.

    Raises ModelError: a searched length has no limits, or the links of a skin band are no
    neighbours.
    """
    placements: list[NodePlacement] = []
    nodes: list[PoseTreeNode] = []
    for index, branch in enumerate(branches):
        X_PA, rotation = roots.get(index, (np.eye(4), None))
        positions, steps = branch.positions, branch.steps
        follows = branch.follows
        placements.append(place_node(model, positions, held, X_PA, rotation, steps, follows))
        names = tuple(model.position_names[position] for position in positions)
        inner = branches[branch.parent].group if branch.parent >= 0 else None
        nodes.append(
            PoseTreeNode(
                name=graph.groups[branch.group].name,
                parent=branch.parent,
                depth=branch.depth,
                children=tuple(i for i, other in enumerate(branches) if other.parent == index),
                positions=positions,
                position_names=names,
                value_names=names if rotation is None else rotation.value_names,
                mesh=graph.groups[branch.group].mesh,
                skin=None if inner is None else find_skin(model, graph, inner, branch.group, steps),
            )
        )
    searched = [position for node in nodes for position in node.positions]
    free = [position for position in _unlimited_slides(model, searched) if position not in held]
    if free:
        raise ModelError(_missing_limits(model, free))
    require_neighbours(
        model, graph, {(branches[b.parent].group, b.group) for b in branches if b.parent >= 0}
    )
    followers = _followers(model, searched, {*searched, *base.positions, *held})
    determined = {*searched, *base.positions, *(coupling.follower for coupling in followers)}
    return PoseTree(
        model=model,
        nodes=tuple(nodes),
        leaves=tuple(index for index, node in enumerate(nodes) if not node.children),
        held=held,
        unobserved_positions=tuple(
            name for index, name in enumerate(model.position_names) if index not in determined
        ),
        followers=followers,
        root=root,
        placements=tuple(placements),
        assumed=tuple(model.position_names[index] for index in assumed),
        _base=base,
    )


def _unlimited_slides(model: ParsedModel, positions: Sequence[int]) -> list[int]:
    """Return those of the positions (indices in q) that are lengths without finite limits."""
    limited = np.isfinite(model.lower) & np.isfinite(model.upper)
    return [i for i in positions if model.position_kinds[i] == "length" and not limited[i]]


def _missing_limits(model: ParsedModel, positions: Sequence[int]) -> str:
    """Return the message that the positions (indices in q) lack limits, with advice."""
    names = [model.position_names[position] for position in positions]
    many = len(names) > 1
    return (
        f"{model.path}: joint{'s' if many else ''} {', '.join(repr(name) for name in names)} "
        f"ha{'ve' if many else 's'} no limits, or limits too wide to be searched; give a lower and "
        f"an upper limit [m] in the model file (or to load_model: limits={{'{names[0]}': (low, "
        f"high)}}), so that values can be searched, or hold it (--hold {names[0]}=VALUE)"
    )
