"""Builds a PoseTree: chooses the root, cuts what is not seen, turns joints over where needed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.parsed_model import ParsedModel
from drake_pose.body.tree.base_pose import BasePose, base_of_chain
from drake_pose.body.tree.joint_map import ChainStep, chain_transforms
from drake_pose.body.tree.link_graph import JointEdge, LinkGraph, PlantKinematics, build_link_graph
from drake_pose.body.tree.node_skin import find_skin, require_placed
from drake_pose.body.tree.pose_tree import NodePlacement, PoseTree, PoseTreeNode
from drake_pose.body.tree.root import RootRotation
from drake_pose.body.tree.unlimited_slides import placing_slides, refuse_unlimited_slides
from drake_pose.errors import ModelError, SettingsError, UnknownNameError

Chain = tuple[JointEdge, ...]


@dataclass(frozen=True)
class Branch:
    """One node to be: its group, the index of its parent's branch, the joints between."""

    group: int
    parent: int
    chain: Chain


def build_pose_tree(
    model: ParsedModel,
    root: str | None = None,
    root_position: Sequence[float] | NDArray[np.float64] | None = None,
    root_rotation: RootRotation | None = None,
    held: Mapping[str, float] | None = None,
) -> PoseTree:
    """See ArticulatedModel.pose_tree."""
    held = held or {}
    if root is not None and root not in model.link_names:
        raise UnknownNameError("link", root, model.link_names, str(model.path))
    held_values = {model.position_index(name): float(value) for name, value in held.items()}
    for name, value in held.items():
        if not np.isfinite(value):
            raise SettingsError(f"held joint '{name}' has the value {value}: give a finite number")
    position = None if root_position is None else _checked_position(root_position)
    graph = build_link_graph(model, root)
    if root is not None and not _seen(graph, graph.group_of(root)):
        raise ModelError(
            f"{model.path}: link '{root}' has no visual geometry, nor has what is welded to it, so "
            f"it cannot be the root; links with geometry: {', '.join(model.link_meshes)}"
        )
    plan = _choose_root(model, graph, root, root_rotation)
    rotation = root_rotation or RootRotation.free()

    def build(p_WR: NDArray[np.float64] | None) -> PoseTree:
        if plan.turned:
            tree = _turned_over(model, graph, plan, p_WR, rotation, held_values)
        else:
            tree = _plant_rooted(model, graph, p_WR, held_values)
        return replace(tree, _rebuild=lambda moved: build(_checked_position(moved)))

    return build(position)


@dataclass(frozen=True)
class RootPlan:
    """The group where the tree starts (0: the world's), and whether a RootRotation places it.

    ``own``: whether the group is the plant's own root, so that its position has a default.
    """

    start: int
    turned: bool
    own: bool


def _checked_position(position: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Three finite numbers."""
    array = np.array(position, dtype=np.float64)
    if array.shape != (3,) or not np.all(np.isfinite(array)):
        raise SettingsError(f"root position {position}: give three finite numbers [m]")
    return array


def _choose_root(
    model: ParsedModel, graph: LinkGraph, root: str | None, rotation: RootRotation | None
) -> RootPlan:
    """Decide which group the tree starts from and whether it is turned by a RootRotation."""
    floating = _floating_tops(graph)
    if len(floating) > 1:
        names = [graph.groups[group].name for group in floating]
        raise ModelError(
            f"{model.path}: links {', '.join(names)} float freely, each for itself; a pose tree "
            "needs one object: weld the others to the world or leave them out"
        )
    asked = None if root is None else graph.group_of(root)
    if floating:
        top = floating[0]
        return RootPlan(top if asked is None else asked, True, asked in (None, top))
    tops = [b.group for b in _branches(graph, 0) if b.parent == (0 if _seen(graph, 0) else -1)]
    tops = [0] if _seen(graph, 0) else tops
    if asked is None or (rotation is None and tops == [asked]):
        if rotation is None:
            return RootPlan(0, False, True)
        if len(tops) > 1:
            names = [graph.groups[group].name for group in tops]
            raise SettingsError(f"root_rotation needs a root: name one of {', '.join(names)}")
        return RootPlan(tops[0], True, True)
    return RootPlan(asked, True, tops == [asked])


def _seen(graph: LinkGraph, group: int) -> bool:
    """Whether a group has geometry."""
    return not graph.groups[group].mesh.is_empty


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
            if any(_seen(graph, branch.group) for branch in branches):
                first = branches[0].group
                while not _seen(graph, first) and len(_children(branches, first)) == 1:
                    first = _children(branches, first)[0]
                tops.append(first)
    return tops


def _children(branches: list[Branch], group: int) -> list[int]:
    """The groups whose parent branch is that of the given group."""
    groups = [branch.group for branch in branches]
    return [b.group for b in branches if b.parent >= 0 and groups[b.parent] == group]


def _branches(graph: LinkGraph, start: int) -> list[Branch]:
    """The nodes reached from a group without crossing a floating joint, breadth first."""
    # Groups without geometry vanish where they end a chain (with it) or merely continue one.
    edges_at = {
        group: [edge for edge in graph.edges_at(group) if edge.joint_map is not None]
        for group in range(len(graph.groups))
    }
    pruned = True
    while pruned:
        pruned = False
        for group, edges in edges_at.items():
            if len(edges) == 1 and group != start and not _seen(graph, group):
                edge = edges.pop()
                other = edge.inner if edge.outer == group else edge.outer
                edges_at[other].remove(edge)
                pruned = True
    branches: list[Branch] = []
    queue: list[tuple[int, int, Chain]] = [(start, -1, ())]
    for group, parent, chain in queue:
        is_node = _seen(graph, group) or len(edges_at[group]) > 2 or group == start
        if group == 0 and start == 0 and not _seen(graph, 0):
            is_node = False
        here = parent
        if is_node:
            branches.append(Branch(group, parent, chain))
            here = len(branches) - 1
        onward = [edge for edge in edges_at[group] if not chain or edge is not chain[-1]]
        for edge in onward:
            other = edge.inner if edge.outer == group else edge.outer
            queue.append((other, here, (edge,) if is_node else (*chain, edge)))
    return _by_depth(graph, branches)


def _by_depth(graph: LinkGraph, branches: list[Branch]) -> list[Branch]:
    """The branches by steps to the root, those of equal depth in the model's order of links."""
    depth: list[int] = []
    for branch in branches:
        depth.append(0 if branch.parent < 0 else depth[branch.parent] + 1)
    order = sorted(
        range(len(branches)), key=lambda i: (depth[i], graph.groups[branches[i].group].body)
    )
    place = {old: new for new, old in enumerate(order)}
    return [
        Branch(branches[i].group, place.get(branches[i].parent, -1), branches[i].chain)
        for i in order
    ]


def _plant_rooted(
    model: ParsedModel,
    graph: LinkGraph,
    position: NDArray[np.float64] | None,
    held: dict[int, float],
) -> PoseTree:
    """The tree that hangs on the plant's world as the file says."""
    branches = _branches(graph, 0)
    objects = [branches[index] for index in _outermost(branches)]
    chains = [[i for edge in branch.chain for i in edge.positions] for branch in objects]
    held = {**placing_slides(model, chains, held), **held}
    X_WB = np.eye(4)
    if position is not None:
        tops = [branch for branch in branches if branch.parent < 0]
        if len(tops) > 1:
            raise SettingsError("root_position needs a root: several links hang on the world")
        translations = _leading_translations(model, tops[0].chain)
        if translations:
            held = {**held, **_solve_translations(model, tops[0].chain, translations, position)}
        else:
            body = graph.groups[tops[0].group].body
            X_WB[:3, 3] = position - PlantKinematics(model).pose(body)[:3, 3]
    X_WA = X_WB @ PlantKinematics(model).pose(graph.groups[0].body)
    roots = {
        index: NodePlacement(X_WA, None, ())
        for index, branch in enumerate(branches)
        if branch.parent < 0
    }
    name = graph.groups[0].name
    return _assemble(model, graph, branches, roots, BasePose("constant", X_WB), held, name)


def _outermost(branches: list[Branch]) -> list[int]:
    """The branches that hang on the world, whether it is seen, and so a branch itself, or not."""
    if branches and branches[0].group == 0:
        return [index for index, branch in enumerate(branches) if branch.parent == 0]
    return [index for index, branch in enumerate(branches) if branch.parent < 0]


def _leading_translations(model: ParsedModel, chain: Chain) -> tuple[int, ...]:
    """The positions of three prismatic joints that begin a chain, or none."""
    leading = []
    for edge in chain[:3]:
        if [model.position_kinds[index] for index in edge.positions] == ["length"]:
            leading.append(edge.positions[0])
    return tuple(leading) if len(leading) == 3 else ()


def _solve_translations(
    model: ParsedModel, chain: Chain, translations: tuple[int, ...], p_WN: NDArray[np.float64]
) -> dict[int, float]:
    """Values of the leading translations that put the chain's end at p_WN for any rotation."""
    steps = [ChainStep(e.joint_map, inverted=False) for e in chain if e.joint_map is not None]
    positions = [position for edge in chain for position in edge.positions]
    values = model.default_positions[positions].copy()
    values[:3] = 0.0
    units = np.eye(len(values))[:3]
    origin = chain_transforms(steps, values[None])[0, :3, 3]
    matrix = (chain_transforms(steps, values + units)[:, :3, 3] - origin).T
    names = [model.position_names[index] for index in translations]
    turned = values.copy()
    turned[3:] += 0.5
    if np.abs(chain_transforms(steps, turned[None])[0, :3, 3] - origin).max() > 1e-9:
        raise ModelError(
            f"{model.path}: the root link's origin moves when its joints turn, so the joints "
            f"{', '.join(names)} cannot hold it at root_position; hold them yourself instead"
        )
    if np.linalg.matrix_rank(matrix) < 3:
        raise ModelError(f"{model.path}: joints {', '.join(names)} do not span all directions")
    return dict(zip(translations, np.linalg.solve(matrix, p_WN - origin).tolist(), strict=True))


def _turned_over(
    model: ParsedModel,
    graph: LinkGraph,
    plan: RootPlan,
    position: NDArray[np.float64] | None,
    rotation: RootRotation,
    held: dict[int, float],
) -> PoseTree:
    """The tree that starts at a link which is placed in the world by itself."""
    root = graph.groups[plan.start]
    if position is None:
        if not plan.own:
            raise SettingsError(
                f"root '{root.name}': give root_position, where its origin is in the world [m]"
            )
        position = PlantKinematics(model).pose(root.body)[:3, 3]
    branches = _branches(graph, plan.start)
    X_WA = np.eye(4)
    X_WA[:3, 3] = position
    roots = {0: NodePlacement(X_WA, rotation, ())}
    groups = [branch.group for branch in branches]
    if 0 in groups:
        base = BasePose("world_node", node=groups.index(0), body=graph.groups[0].body)
    else:
        chain = _chain_from_world(graph, set(groups))
        base = base_of_chain(model, graph, chain, groups.index(chain[-1].outer), held)
        if any(edge.joint_map is None for edge in chain):
            branches, roots = _with_world(model, graph, branches, roots)
    taken = [model.position_names[index] for index in base.positions if index in held]
    if taken:
        raise SettingsError(
            f"joints {', '.join(taken)} cannot be held: they follow from the pose of the root "
            f"'{root.name}'"
        )
    return _assemble(model, graph, branches, roots, base, held, root.name)


def _chain_from_world(graph: LinkGraph, groups: set[int]) -> list[JointEdge]:
    """The edges from the world outwards to the first of the given groups."""
    queue: list[tuple[int, list[JointEdge]]] = [(0, [])]
    for group, chain in queue:
        if group in groups:
            return chain
        queue += [(edge.outer, [*chain, edge]) for edge in graph.edges if edge.inner == group]
    raise ModelError("the root is not connected to the world")


def _with_world(
    model: ParsedModel,
    graph: LinkGraph,
    branches: list[Branch],
    roots: dict[int, NodePlacement],
) -> tuple[list[Branch], dict[int, NodePlacement]]:
    """Add what is seen in the world beside a floating object, as further roots."""
    offset = len(branches)
    joined, placements = list(branches), dict(roots)
    X_WA = PlantKinematics(model).pose(graph.groups[0].body)
    for branch in _branches(graph, 0):
        if branch.parent < 0:
            placements[len(joined)] = NodePlacement(X_WA, None, ())
        parent = branch.parent if branch.parent < 0 else branch.parent + offset
        joined.append(Branch(branch.group, parent, branch.chain))
    return joined, placements


def _assemble(
    model: ParsedModel,
    graph: LinkGraph,
    branches: list[Branch],
    roots: dict[int, NodePlacement],
    base: BasePose,
    held: dict[int, float],
    root: str,
) -> PoseTree:
    """Make the nodes."""
    placements: list[NodePlacement] = []
    nodes: list[PoseTreeNode] = []
    for index, branch in enumerate(branches):
        start = roots.get(index, NodePlacement(np.eye(4), None, ()))
        steps, positions = _walk(graph, branches, branch)
        placements.append(NodePlacement(start.X_PA, start.rotation, steps))
        names = tuple(model.position_names[position] for position in positions)
        inner = branches[branch.parent].group if branch.parent >= 0 else None
        nodes.append(
            PoseTreeNode(
                name=graph.groups[branch.group].name,
                parent=branch.parent,
                depth=0 if branch.parent < 0 else nodes[branch.parent].depth + 1,
                children=tuple(i for i, other in enumerate(branches) if other.parent == index),
                positions=positions,
                position_names=names,
                value_names=names if start.rotation is None else start.rotation.value_names,
                mesh=graph.groups[branch.group].mesh,
                skin=None if inner is None else find_skin(model, graph, inner, branch.group, steps),
            )
        )
    refuse_unlimited_slides(model, [i for node in nodes for i in node.positions], held)
    require_placed(
        model, graph, {(branches[b.parent].group, b.group) for b in branches if b.parent >= 0}
    )
    moved = {position for node in nodes for position in node.positions} | set(base.positions)
    return PoseTree(
        model=model,
        nodes=tuple(nodes),
        leaves=tuple(index for index, node in enumerate(nodes) if not node.children),
        held=held,
        unobserved_positions=tuple(
            name for index, name in enumerate(model.position_names) if index not in moved
        ),
        root=root,
        placements=tuple(placements),
        _base=base,
    )


def _walk(
    graph: LinkGraph, branches: list[Branch], branch: Branch
) -> tuple[tuple[ChainStep, ...], tuple[int, ...]]:
    """The joints from a branch's parent to it, and their positions, in the order walked."""
    group = branches[branch.parent].group if branch.parent >= 0 else 0
    steps: list[ChainStep] = []
    positions: list[int] = []
    for edge in branch.chain:
        inverted = edge.outer == group
        group = edge.inner if inverted else edge.outer
        if edge.joint_map is not None:
            steps.append(ChainStep(edge.joint_map, inverted))
            positions += edge.positions
    return tuple(steps), tuple(positions)
