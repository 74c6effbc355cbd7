"""Builds a PoseTree: chooses the root, cuts what is not seen, turns joints over where needed."""

from collections.abc import Collection, Mapping, Sequence
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
from drake_pose.body.node_skin import find_skin, require_placed
from drake_pose.body.parsed_model import ParsedModel
from drake_pose.body.plant_source import Coupling
from drake_pose.body.pose_tree import NodePlacement, PoseTree, PoseTreeNode, place_node
from drake_pose.body.root import BasePose, RootRotation, base_of_chain
from drake_pose.errors import ModelError, SettingsError, UnknownNameError

Roots = dict[int, tuple[Array, RootRotation | None]]
"""By branch that hangs on the world: X_WA (4, 4), and how it is turned there."""


@dataclass(frozen=True)
class Branch:
    """One node to be: its group, its parent's branch (-1: the world), and the joints between.

    ``depth``: steps to the root; ``steps`` and ``positions``: the joints in the order walked, and
    their indices into q; ``follows``: what they follow of the parent's values, without positions.
    """

    group: int
    parent: int
    depth: int
    steps: tuple[JointMap, ...] = ()
    positions: tuple[int, ...] = ()
    follows: tuple[Coupling, ...] = ()


def build_pose_tree(
    model: ParsedModel,
    root: str | None = None,
    root_position: Sequence[float] | Array | None = None,
    root_rotation: RootRotation | None = None,
    held: Mapping[str, float] | None = None,
) -> PoseTree:
    """See ArticulatedModel.pose_tree."""
    held, rounding = held or {}, 1e-6
    if root is not None and root not in model.link_names:
        raise UnknownNameError("link", root, model.link_names, str(model.path))
    held_values = {model.position_index(name): float(value) for name, value in held.items()}
    # What follows, or is followed by, what is held is held, too.
    for follower, leader, multiplier, offset in model.couplings:
        if follower in held_values:
            held_values.setdefault(leader, (held_values[follower] - offset) / multiplier)
    for follower, leader, multiplier, offset in model.couplings:
        if leader in held_values:
            wanted = multiplier * held_values[leader] + offset
            if abs(held_values.setdefault(follower, wanted) - wanted) > rounding:
                one, other = (model.position_names[k] for k in (follower, leader))
                raise SettingsError(
                    f"joint '{one}' is held at {held_values[follower]:g}, but it follows joint "
                    f"'{other}' (<mimic>): {wanted:g} [rad or m]; hold one of them alone"
                )
    for name, value in held.items():
        if not np.isfinite(value):
            raise SettingsError(f"held joint '{name}' has the value {value}: give a finite number")
    for index, value in held_values.items():
        lower, upper = model.lower[index], model.upper[index]
        inside = lower - rounding <= value <= upper + rounding
        if not inside and not model.turns_freely[index]:
            raise SettingsError(
                f"joint '{model.position_names[index]}' is held at {value:g}, outside its limits, "
                f"{lower:g} to {upper:g} [rad or m]"
            )
    position = None if root_position is None else _checked_position(root_position)
    graph = build_link_graph(model, root)
    if root is not None and not graph.seen(graph.group_of(root)):
        raise ModelError(
            f"{model.path}: link '{root}' has no visual geometry, nor has what is welded to it, so "
            f"it cannot be the root; links with geometry: {', '.join(model.link_meshes)}"
        )
    start = _choose_root(model, graph, root, root_rotation)
    rotation = root_rotation or RootRotation.free()
    if start is not None and start[1] and root_rotation is None:
        # What no joint holds stands as the file has it, unless its turns are asked for.
        X_WR = PlantKinematics(model).pose(graph.groups[start[0]].body)
        rotation = RootRotation.fixed(X_WR[:3, :3])

    def build(p_WR: Array | None) -> PoseTree:
        if start is None:
            tree = _plant_rooted(model, graph, p_WR, held_values)
        else:
            tree = _turned_over(model, graph, *start, p_WR, rotation, held_values)
        return replace(tree, _rebuild=lambda moved: build(_checked_position(moved)))

    return build(position)


def _checked_position(position: Sequence[float] | Array) -> Array:
    """Three finite numbers."""
    array = np.array(position, dtype=np.float64)
    if array.shape != (3,) or not np.all(np.isfinite(array)):
        raise SettingsError(f"root position {position}: give three finite numbers [m]")
    return array


def _choose_root(
    model: ParsedModel, graph: LinkGraph, root: str | None, rotation: RootRotation | None
) -> tuple[int, bool] | None:
    """The group that a RootRotation places, and whether it is the plant's own root.

    The position of the plant's own root has a default. None: the tree hangs on the plant's world.
    """
    floating = _floating_tops(graph)
    if len(floating) > 1:
        names = [graph.groups[group].name for group in floating]
        raise ModelError(
            f"{model.path}: links {', '.join(names)} float freely, each for itself; a pose tree "
            "needs one object: weld the others to the world or leave them out"
        )
    asked = None if root is None else graph.group_of(root)
    if floating:
        return floating[0] if asked is None else asked, asked in (None, floating[0])
    tops = [0] if graph.seen(0) else [b.group for b in _branches(graph, 0) if b.parent < 0]
    if asked is None or (rotation is None and tops == [asked]):
        if rotation is None:
            return None
        if len(tops) > 1:
            names = [graph.groups[group].name for group in tops]
            raise SettingsError(f"root_rotation needs a root: name one of {', '.join(names)}")
        return tops[0], True
    return asked, tops == [asked]


def _floating_tops(graph: LinkGraph) -> list[int]:
    """For each floating joint that moves something seen, the first group to be a node."""
    tops = []
    for edge in graph.edges:
        if edge.joint_map is None:
            if edge.inner != 0:
                raise ModelError(
                    f"link '{graph.groups[edge.outer].name}' floats relative to "
                    f"'{graph.groups[edge.inner].name}'; only the world may carry a floating joint"
                )
            branches = _branches(graph, edge.outer)
            if any(graph.seen(branch.group) for branch in branches):
                # Other groups that are not seen have several children.
                behind = [branch.group for branch in branches if branch.parent == 0]
                only_carries = not graph.seen(edge.outer) and len(behind) == 1
                tops.append(behind[0] if only_carries else edge.outer)
    return tops


def _branches(graph: LinkGraph, start: int) -> list[Branch]:
    """The nodes reached from a group without crossing a floating joint, by depth, then by body."""
    # Groups without geometry vanish where they end a chain (with it) or merely continue one.
    edges_at = {
        group: [edge for edge in graph.edges_at(group) if edge.joint_map is not None]
        for group in range(len(graph.groups))
    }
    pruned = True
    while pruned:
        pruned = False
        for group, edges in edges_at.items():
            if len(edges) == 1 and group != start and not graph.seen(group):
                edge = edges.pop()
                edges_at[edge.other(group)].remove(edge)
                pruned = True
    found: list[Branch] = []
    queue: list[tuple[Branch, JointEdge | None]] = [(Branch(start, -1, 0), None)]
    for branch, last in queue:
        group = branch.group
        is_node = graph.seen(group) or len(edges_at[group]) > 2 or group == start != 0
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
    return _ordered(graph, found)


def _ordered(graph: LinkGraph, found: list[Branch]) -> list[Branch]:
    """Branches, parents before children, by depth, then by body."""
    bodies = [graph.groups[branch.group].body for branch in found]
    order = sorted(range(len(found)), key=lambda i: (found[i].depth, bodies[i]))
    return [
        replace(found[i], parent=order.index(found[i].parent) if found[i].parent >= 0 else -1)
        for i in order
    ]


def _let_follow(
    model: ParsedModel, graph: LinkGraph, branches: list[Branch], held: Collection[int]
) -> list[Branch]:
    """Hang branches on the one whose values all their joints follow, where nothing else moves them.

    So the pose of a node in its parent is told by its own values, or by its parent's.
    """
    alike = _alike(model)
    bent = {graph.group_of(link) for band in model.skin for link in (band.parent, band.child)}
    leaders: dict[int, tuple[int, int]] = {}
    found: list[Branch] = []
    for i, branch in enumerate(branches):
        known = [alike.get(p) if p not in held else None for p in branch.positions]
        leads = {leaders[one.leader][0] if one and one.leader in leaders else -1 for one in known}
        above, lead = branch.parent, min(leads, default=-1)
        hangs_on = found[above] if above >= 0 else branch
        beside = lead >= 0 and above == branches[lead].parent
        below = above == lead or (hangs_on.parent == lead and hangs_on.follows)
        if lead < 0 or len(leads) > 1 or branch.group in bent or not (beside or below):
            for one, position in zip(known, branch.positions, strict=True):
                if one:
                    leaders.setdefault(one.leader, (i, position))
            found.append(replace(branch, depth=hangs_on.depth + (above >= 0)))
            continue
        first, steps, follows = found[lead], branch.steps, list[Coupling]()
        if beside:
            last = len(first.positions)
            for step in first.steps[::-1]:
                last -= step.position_count
                own = first.positions[last : last + step.position_count]
                follows += [Coupling(p, last + k, 1.0, 0.0) for k, p in enumerate(own)]
            steps = *(replace(s, inverted=not s.inverted) for s in first.steps[::-1]), *steps
        elif above != lead:
            steps, follows = hangs_on.steps + steps, list(hangs_on.follows)
        for one in (one for one in known if one):
            told = _relation(alike, one.follower, leaders[one.leader][1])
            follows.append(told._replace(leader=first.positions.index(told.leader)))
        found.append(Branch(branch.group, lead, first.depth + 1, steps, (), tuple(follows)))
    return _ordered(graph, found)


def _alike(model: ParsedModel) -> dict[int, Coupling]:
    """All positions that follow others or are followed, leaders by themselves."""
    own = {one.leader: Coupling(one.leader, one.leader, 1.0, 0.0) for one in model.couplings}
    return own | {one.follower: one for one in model.couplings}


def _relation(alike: Mapping[int, Coupling], follower: int, leader: int) -> Coupling:
    """How one of two positions that follow the same one follows the other."""
    one, other = alike[follower], alike[leader]
    multiplier = one.multiplier / other.multiplier
    return Coupling(follower, leader, multiplier, one.offset - multiplier * other.offset)


def _followers(
    model: ParsedModel, searched: Sequence[int], known: Collection[int]
) -> tuple[Coupling, ...]:
    """Which positions, that are not known, follow those that are searched."""
    alike, found = _alike(model), []
    for follower, one in alike.items():
        own = [p for p in searched if p in alike and alike[p].leader == one.leader]
        if own and follower not in known:
            found.append(_relation(alike, follower, own[0]))
    return tuple(found)


def _plant_rooted(
    model: ParsedModel, graph: LinkGraph, position: Array | None, held: dict[int, float]
) -> PoseTree:
    """The tree that hangs on the plant's world as the file says."""
    branches = _let_follow(model, graph, _branches(graph, 0), held)
    # The world is a branch itself where it is seen.
    on_world = 0 if branches and branches[0].group == 0 else -1
    objects = [branch.positions for branch in branches if branch.parent == on_world]
    # Slides without limits between the world and its only object say where it stands, as the
    # position of a floating joint does (planar robots in MJCF have two of them): they are not
    # searched, and root_position moves the object.
    placing = [slide for positions in objects for slide in _unlimited_slides(model, positions)]
    free = [slide for slide in placing if slide not in held]
    if len(objects) > 1 and free:
        raise ModelError(
            f"{_lack_of_limits(model, free)}; of {len(objects)} objects in the world none can be "
            "left where it stands"
        )
    held = {slide: float(model.default_positions[slide]) for slide in placing} | held
    X_WB = np.eye(4)
    tops = [index for index, branch in enumerate(branches) if branch.parent < 0]
    if position is not None:
        if len(tops) > 1:
            raise SettingsError("root_position needs a root: several links hang on the world")
        top = branches[tops[0]]
        slides = [model.position_kinds[index] == "length" for index in top.positions[:3]]
        if slides == [True] * 3 and all(s.position_count == 1 for s in top.steps[:3]):
            held = {**held, **_solve_translations(model, top, position)}
        else:
            body = graph.groups[top.group].body
            X_WB[:3, 3] = position - PlantKinematics(model).pose(body)[:3, 3]
    X_WA = X_WB @ PlantKinematics(model).pose(graph.groups[0].body)
    roots: Roots = dict.fromkeys(tops, (X_WA, None))
    name = graph.groups[0].name
    return _assemble(model, graph, branches, roots, BasePose("constant", X_WB), held, name)


def _solve_translations(model: ParsedModel, top: Branch, p_WN: Array) -> dict[int, float]:
    """Values of the three translations that lead to a node and put it at p_WN when it turns."""
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


def _turned_over(
    model: ParsedModel,
    graph: LinkGraph,
    start: int,
    is_own: bool,
    position: Array | None,
    rotation: RootRotation,
    held: dict[int, float],
) -> PoseTree:
    """The tree that starts at a link which is placed in the world by itself."""
    root = graph.groups[start]
    if position is None:
        if not is_own:
            raise SettingsError(
                f"root '{root.name}': give root_position, where its origin is in the world [m]"
            )
        position = PlantKinematics(model).pose(root.body)[:3, 3]
    branches = _let_follow(model, graph, _branches(graph, start), held)
    X_WA = np.eye(4)
    X_WA[:3, 3] = position
    roots: Roots = {0: (X_WA, rotation)}
    groups = [branch.group for branch in branches]
    if 0 in groups:
        base = BasePose("placed", node=groups.index(0), body=graph.groups[0].body)
    else:
        # The edges from the world outwards to the first of the groups.
        queue: list[tuple[int, list[JointEdge]]] = [(0, [])]
        for group, chain in queue:
            if group in groups:
                break
            queue += [(e.outer, [*chain, e]) for e in graph.edges if e.inner == group]
        base = base_of_chain(model, graph, chain, groups.index(chain[-1].outer), held)
        if any(edge.joint_map is None for edge in chain):
            # What is seen in the world beside a floating object makes further roots.
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
) -> PoseTree:
    """Make the nodes."""
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
        raise ModelError(_lack_of_limits(model, free))
    require_placed(
        model, graph, {(branches[b.parent].group, b.group) for b in branches if b.parent >= 0}
    )
    followers = _followers(model, searched, {*searched, *base.positions, *held})
    moved = {*searched, *base.positions, *(one.follower for one in followers)}
    return PoseTree(
        model=model,
        nodes=tuple(nodes),
        leaves=tuple(index for index, node in enumerate(nodes) if not node.children),
        held=held,
        unobserved_positions=tuple(
            name for index, name in enumerate(model.position_names) if index not in moved
        ),
        followers=followers,
        root=root,
        placements=tuple(placements),
        _base=base,
    )


def _unlimited_slides(model: ParsedModel, positions: Sequence[int]) -> list[int]:
    """Those that are lengths without a lower or without an upper limit."""
    limited = np.isfinite(model.lower) & np.isfinite(model.upper)
    return [i for i in positions if model.position_kinds[i] == "length" and not limited[i]]


def _lack_of_limits(model: ParsedModel, positions: Sequence[int]) -> str:
    """Which joints lack limits, and what to do."""
    names = [model.position_names[position] for position in positions]
    many = len(names) > 1
    return (
        f"{model.path}: joint{'s' if many else ''} {', '.join(repr(name) for name in names)} "
        f"ha{'ve' if many else 's'} no limits, or limits too wide to be searched; give a lower and "
        f"an upper limit [m] in the model file (or to load_model: limits={{'{names[0]}': (low, "
        f"high)}}), so that values can be searched, or hold it (--hold {names[0]}=VALUE)"
    )
