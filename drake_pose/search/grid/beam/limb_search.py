"""Single limbs and pairs of limbs of a pose searched again, and single nodes turned."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np

from drake_pose.search.grid.beam.hypotheses import Beam, Hypotheses
from drake_pose.search.grid.node_poses import Pictures
from drake_pose.search.scoring import Scoring

# What is placed last need not spare the silhouette for what comes after it.
_OUTSIDE_WEIGHT = 2
# How many of a node's samples are judged in full.
_JUDGED = 4


def search_limbs_again(
    beam: Beam,
    order: Sequence[int],
    poses: np.ndarray,
    J: float,
    width: int,
    proceed: Callable[[int], bool],
    found: Callable[[Hypotheses], object],
) -> np.ndarray:
    """Search limbs again, one or two at a time, until that improves nothing any more.

    Args:
        order: the nodes in the order in which they are placed.
        poses: (nodes,) the pose of each node in the PoseStore.
        J: its objective as the beam counts it [pixel].
        width: how many hypotheses are kept.
        proceed: as in Beam.run.
        found: told of the last hypotheses of every search.

    Returns:
        (nodes,) the better poses, or the same.
    """
    limbs = find_limbs(beam)
    choices = [*((limb,) for limb in limbs), *itertools.combinations(limbs, 2)]
    area = beam.store.pictures.area
    unchanged = 0
    for choice in itertools.cycle(choices):
        nodes = set().union(*choice)
        start = beam.without(poses, sorted(nodes))
        part = [node for node in order if node in nodes]
        last, _ = beam.run(start, part, width, _OUTSIDE_WEIGHT, False, proceed)
        if last is None:
            return poses
        found(last)
        Js = area - last.covered + last.outside
        best = int(np.argmin(Js))
        unchanged += 1
        if Js[best] < J:
            J, poses, unchanged = float(Js[best]), last.poses[best], 1
        if unchanged >= len(choices):
            return poses
    return poses


def find_limbs(beam: Beam) -> list[frozenset[int]]:
    """The largest subtrees without a fork but the whole tree; of a chain, its outer half."""
    nodes = beam.nodes
    subtrees: list[frozenset[int]] = [frozenset()] * len(nodes)
    forked = [len(node.children) > 1 for node in nodes]
    for i in reversed(range(len(nodes))):
        below = [subtrees[child] for child in nodes[i].children]
        subtrees[i] = frozenset({i}).union(*below)
        forked[i] = forked[i] or any(forked[child] for child in nodes[i].children)
    limbs = [
        subtrees[i]
        for i, node in enumerate(nodes)
        if not forked[i] and node.parent >= 0 and forked[node.parent]
    ]
    if limbs:
        return limbs
    return [subtree for subtree in subtrees if 2 * len(subtree) <= len(nodes)][:1]


def turn_single_nodes(
    scoring: Scoring, pictures: Pictures, samples: np.ndarray, proceed: Callable[[], bool]
) -> np.ndarray:
    """Try all samples of one node after another, all that hangs on it moving along.

    Args:
        pictures: with bands; in them the samples are compared.
        samples: (nodes,) the sample of each node.
        proceed: asked before each node whether to go on.

    Returns:
        (nodes,) samples no single one of which can be changed for the better, as far as the
        pictures show it, or as far as it got.
    """
    current = samples.copy()
    J = float(scoring.J(scoring.sampled.poses(current[None]), current[None])[0])
    unchanged = 0
    for node in itertools.cycle(range(len(current))):
        if not proceed():
            break
        tried = np.repeat(current[None], len(scoring.sampled.values[node]), axis=0)
        tried[:, node] = np.arange(len(tried))
        approximate = _J_by_bits(scoring, pictures, tried, node)
        tried = tried[np.argsort(approximate, kind="stable")[:_JUDGED]]
        Js = scoring.J(scoring.sampled.poses(tried), tried)
        best = int(np.argmin(Js))
        unchanged += 1
        if Js[best] < J:
            J, current, unchanged = float(Js[best]), tried[best], 1
        if unchanged >= len(current):
            break
    return current


def _J_by_bits(scoring: Scoring, pictures: Pictures, samples: np.ndarray, node: int) -> np.ndarray:
    """J (n,) as the pictures show it of samples (n, nodes) that differ in one node's alone."""
    X_WN = scoring.sampled.poses(samples)
    silhouettes = int(pictures.part_starts[len(pictures.views)])
    moving = {node}
    still = np.zeros((1, int(pictures.part_starts[-1])), dtype=np.uint64)
    far = np.zeros(len(samples), dtype=np.int64)
    for i, other in enumerate(scoring.sampled.tree.nodes):
        if i in moving or other.parent in moving:
            moving.add(i)
        else:
            far += pictures.draw_node(i, samples[:1, i], X_WN[:1, i], still)[0, 2]
    masks = np.repeat(still, len(samples), axis=0)
    for i in sorted(moving):
        far += pictures.draw_node(i, samples[:, i], X_WN[:, i], masks)[:, 2]
    covered = np.bitwise_count(masks[:, :silhouettes]).sum(axis=1, dtype=np.int64)
    outside = np.bitwise_count(masks[:, silhouettes:]).sum(axis=1, dtype=np.int64)
    return np.asarray(pictures.area - covered + outside + far)
