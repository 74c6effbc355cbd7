"""The beam: hypotheses that grow node by node, and single limbs of a pose searched again."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drake_pose.search.grid.node_poses import Pictures, PoseStore
from drake_pose.search.grid.pair_kernel import (
    grow_hypotheses,
    hash_mask,
    order_best,
    random_keys,
    score_pairs,
    unite_masks,
)
from drake_pose.search.scoring import Scoring

# How many times the width are looked at until enough are found that are not alike.
_SPARE = 4


@dataclass(frozen=True)
class Hypotheses:
    """Partial poses, best first.

    Attributes:
        masks: (B, W) uint64 the pixels covered.
        poses: (B, nodes) int32 the pose of each node in the PoseStore; -1: not placed.
        hashes: (B,) uint64 of the masks.
        covered: (B,) int64 the silhouettes' area covered [pixel].
        outside: (B,) int64 the area outside [pixel]; beyond the bands a sum over the nodes.
    """

    masks: np.ndarray
    poses: np.ndarray
    hashes: np.ndarray
    covered: np.ndarray
    outside: np.ndarray

    def __len__(self) -> int:
        return len(self.poses)

    def chosen(self, kept: np.ndarray) -> "Hypotheses":
        """Some of them, by their indices."""
        return Hypotheses(*(array[kept] for array in vars(self).values()))


class Beam:
    """Grows hypotheses node by node."""

    def __init__(self, store: PoseStore) -> None:
        self.store = store
        self.nodes = store.body.sampled.tree.nodes
        self._keys = random_keys(int(store.pictures.part_starts[-1]))

    def start(self) -> Hypotheses:
        """The one hypothesis that has placed nothing."""
        words = int(self.store.pictures.part_starts[-1])
        return Hypotheses(
            np.zeros((1, words), dtype=np.uint64),
            np.full((1, len(self.nodes)), -1, dtype=np.int32),
            np.zeros(1, dtype=np.uint64),
            np.zeros(1, dtype=np.int64),
            np.zeros(1, dtype=np.int64),
        )

    def without(self, poses: np.ndarray, nodes: Sequence[int]) -> Hypotheses:
        """A hypothesis with poses (nodes,) but of some nodes, given with all their descendants."""
        start = self.start()
        far = 0
        start.poses[0] = poses
        start.poses[0, list(nodes)] = -1
        for node in np.flatnonzero(start.poses[0] >= 0):
            stored, pose = self.store.nodes[node], int(start.poses[0, node])
            unite_masks(start.masks, stored.runs[pose : pose + 1], stored.words)
            far += int(stored.areas[pose, 2])
        silhouettes = int(self.store.pictures.part_starts[len(self.store.pictures.views)])
        ones = np.bitwise_count(start.masks[0])
        start.covered[0] = ones[:silhouettes].sum()
        start.outside[0] = ones[silhouettes:].sum() + far
        start.hashes[0] = hash_mask(start.masks[0], self._keys)
        return start

    def grow(
        self, hypotheses: Hypotheses, node: int, width: int, outside_weight: int, exact: bool
    ) -> tuple[Hypotheses | None, bool]:
        """Place one more node in every hypothesis and keep the best.

        Args:
            outside_weight: what a pixel outside counts; one newly covered counts one.
            exact: drop what cannot cover the whole silhouettes any more.

        Returns:
            The new hypotheses, None where no pose stays inside the limit; and whether some were
            lost because there were too many.
        """
        store, pictures = self.store, self.store.pictures
        groups = self._groups(hypotheses, node)
        stored = store.nodes[node]
        pairs, gains, losses = score_pairs(
            hypotheses.masks,
            groups[:, 0],
            groups[:, 1],
            stored.runs,
            stored.words,
            len(pictures.views),
            not self.nodes[node].children,
        )
        if len(pairs) == 0:
            return None, False
        covered = hypotheses.covered[pairs[:, 0]] + gains
        outside = hypotheses.outside[pairs[:, 0]] + losses + stored.areas[pairs[:, 1], 2]
        ordered = order_best(outside_weight * outside - covered, _SPARE * width)
        # What is out of reach is known after growing only: grow more and rank again.
        grown = width if exact else 2 * width
        masks, poses, hashes, chosen, left, seen = grow_hypotheses(
            hypotheses.masks,
            hypotheses.poses,
            hypotheses.hashes,
            ordered,
            pairs,
            stored.runs,
            stored.words,
            node,
            store.open_nodes(hypotheses.poses, node),
            self._keys,
            grown,
            pictures.everything,
            store.reaches(hypotheses.poses, node, pairs[ordered, 1]),
            exact,
        )
        lost = seen < len(pairs)
        if len(poses) == 0:
            return None, lost
        made = Hypotheses(masks, poses, hashes, covered[chosen], outside[chosen])
        if exact:
            return made, lost
        costs = outside_weight * (made.outside + left) - made.covered
        kept = np.argsort(costs, kind="stable")[:width]
        return made.chosen(kept), lost or len(kept) < len(poses)

    def _groups(self, hypotheses: Hypotheses, node: int) -> np.ndarray:
        """Where the poses of a node begin and end (B, 2) that each hypothesis may take."""
        store = self.store
        parents = store.parents(hypotheses.poses, node)
        hidden = np.zeros(len(hypotheses), dtype=np.bool_)
        if not self.nodes[node].children and not store.pictures.has_bands:
            rows = store.reach_rows(node, parents)[parents]
            runs, words = store.reach_runs, store.reach_words
            hidden = score_pairs(
                hypotheses.masks, rows, rows + 1, runs, words, runs.shape[1], False
            )[1] == 0  # fmt: skip
        return store.groups(node, parents, hidden)

    def run(
        self,
        start: Hypotheses,
        order: Sequence[int],
        width: int,
        outside_weight: int,
        exact: bool,
        proceed: Callable[[int], bool],
    ) -> tuple[Hypotheses | None, bool]:
        """Place nodes one after another.

        Args:
            proceed: asked after each node, with the number of hypotheses made, whether to go on.

        Returns:
            The last hypotheses (None: none was left, or told to stop), and whether all possible
            ones were kept throughout.
        """
        hypotheses: Hypotheses | None = start
        complete = True
        for node in order:
            if hypotheses is None:
                break
            hypotheses, lost = self.grow(hypotheses, node, width, outside_weight, exact)
            complete = complete and not lost
            if hypotheses is not None and not proceed(len(hypotheses)):
                return None, False
        return hypotheses, complete


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
        poses: (nodes,) the pose of each node in the PoseStore.
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
        pictures: with bands.
        proceed: asked before each node whether to go on.

    Returns:
        Samples (nodes,) that no single change improves in the pictures, as far as it got.
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
