"""What of a body may be mirrored in depth without a silhouette telling."""

from __future__ import annotations

from dataclasses import dataclass

from drake_pose.body.tree.pose_tree import PoseTree


@dataclass(frozen=True)
class Reflection:
    """Nodes that are mirrored in depth together, limbs in pairs taken for each other.

    The mirror image of a body is a body again if its left and its right are exchanged.

    Attributes:
        nodes: parents before children; the first one's joint stays.
        sources: for each the node whose mirror image it becomes.
        held: nodes that hang on these but stay as they are.
    """

    nodes: tuple[int, ...]
    sources: tuple[int, ...]
    held: tuple[int, ...]


def find_reflections(tree: PoseTree) -> tuple[Reflection, ...]:
    """What may be mirrored: all that hangs on a node with pairs of limbs, and these limbs alone."""
    partners = dict(enumerate(range(len(tree.nodes))))
    limbs: dict[tuple[int, int], list[int]] = {}
    owners: set[int] = set()
    for leaf in tree.leaves:
        limb = [leaf]
        while (parent := tree.nodes[limb[0]].parent) >= 0 and len(tree.nodes[parent].children) == 1:
            limb.insert(0, parent)
        other = limbs.pop((parent, len(limb)), None)
        if other is None:
            limbs[parent, len(limb)] = limb
        elif parent >= 0:
            owners.add(parent)
            partners |= dict(zip(limb, other, strict=True)) | dict(zip(other, limb, strict=True))
    below: list[list[int]] = [[i] for i in range(len(tree.nodes))]
    for i in range(len(tree.nodes) - 1, -1, -1):
        below[i] += [j for child in tree.nodes[i].children for j in below[child]]
    reflections: list[tuple[list[int], tuple[int, ...]]] = []
    for i in range(len(tree.nodes)):
        if owners & set(below[i]):
            reflections.append((sorted(below[i]), ()))
        if i in owners:
            held = tuple(child for child in tree.nodes[i].children if partners[child] == child)
            left = set(below[i]).difference(*(below[child] for child in held))
            if held:
                reflections.append((sorted(left), held))
    return tuple(
        Reflection(tuple(nodes), tuple(partners[j] for j in nodes), held)
        for nodes, held in reflections
    )
