"""Kameda's search: one silhouette to joint angles, node by node (sections 5.1 and 5.2).

With several views every area is summed over the views, and (4) holds in each view.
"""

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.errors import SettingsError
from drake_pose.search.estimates import Candidates, PoseEstimate, SearchStatistics, View
from drake_pose.search.scoring import Regions, SampledTree, Scoring
from drake_pose.search.settings import PaperSearchSettings

# The paper's r = 200 pixels is 12.6 % of a node's mean projected area (section 6.1).
_OUTSIDE_SHARE = 0.126
# Combinations times pixel patterns that are looked at in one piece of arrays.
_BLOCK = 4_000_000

_Placed = tuple[np.ndarray, np.ndarray]  # Samples of nodes, and the poses there.


@dataclass(frozen=True)
class NodeList:
    """The candidate list of one node.

    Args:
        samples: (n,) indices into the node's sampling grid, best first: JAC_i(1), JAC_i(2), ...
        scores: (n,) their scores e_i(t) when the list was made [pixel].
        X_WN: (n, 4, 4) their poses.
        adopted: u_i, the one in use.
    """

    samples: np.ndarray
    scores: np.ndarray
    X_WN: np.ndarray
    adopted: int = 0

    @property
    def has_untried(self) -> bool:
        """Whether a candidate after the adopted one is left."""
        return self.adopted + 1 < len(self.samples)


@dataclass(frozen=True)
class _Best:
    J: float
    lists: dict[int, NodeList]


class PaperSearch:
    """Matches silhouettes with a pose tree by the paper's search; grids are made once."""

    def __init__(self, tree: PoseTree, settings: PaperSearchSettings | None = None) -> None:
        self.tree = tree
        self.settings = settings or PaperSearchSettings()
        self.sampled = SampledTree(tree, self.settings)

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose that the views show; see ``PoseSearch``.

        Raises:
            SettingsError: there is no view.
        """
        if not views:
            raise SettingsError("a match needs at least one view, but none was given")
        start = time.perf_counter()
        sampled = self.sampled
        if root_position is not None:
            sampled = sampled.with_root_position(root_position)
        scoring = Scoring(sampled, views)
        if self.settings.outside_limit is not None:
            limits = [float(self.settings.outside_limit)] * len(views)
            run = _Run(scoring, self.settings, limits)
            run.search()
            return run.result(time.perf_counter() - start)
        X_WN = sampled.tree.node_poses([values[0] for values in sampled.values])
        limits = [max(1.0, _OUTSIDE_SHARE * area) for area in scoring.mean_node_areas(X_WN)]
        picture_areas = [view.camera.width * view.camera.height for view in views]
        runs = 0
        while True:
            run = _Run(scoring, self.settings, limits, runs)
            run.search()
            runs = run.runs
            exhausted = all(r >= area for r, area in zip(limits, picture_areas, strict=True))
            if run.best is not None or exhausted or runs >= self.settings.run_limit:
                return run.result(time.perf_counter() - start)
            limits = [2.0 * r for r in limits]


class _Run:
    """One run of the search with a given threshold r."""

    def __init__(
        self,
        scoring: Scoring,
        settings: PaperSearchSettings,
        outside_limit: Sequence[float],
        runs: int = 0,
    ) -> None:
        self.tree = scoring.sampled.tree
        self.nodes = self.tree.nodes
        self.scoring = scoring
        self.settings = settings
        self.outside_limit = tuple(outside_limit)
        self.runs = runs
        self.lists: dict[int, NodeList] = {}
        self.best: _Best | None = None
        self.first_J = float("nan")
        self.stopped_by = "end"

    # Section 5.1

    def search(self) -> None:
        """Run sections 5.1 and 5.2 to their end, or to the run limit."""
        while self._complete():
            J = self._whole_pose_J()
            if self.best is None:
                self.first_J = J
            self._keep_if_better(J)
            self._combine_leaves(J)
            if not self._adopt_most_exposed():
                return

    def _complete(self) -> bool:
        """Steps 1 to 6 until every node has its angles; False if no pose is left (or allowed)."""
        uncovered: Regions | None = None
        while (node := self._next_node()) is not None:
            if self.runs >= self.settings.run_limit:
                self.stopped_by = "run_limit"
                return False
            if uncovered is None:
                done = sorted(self.lists)
                uncovered = self.scoring.uncovered(
                    done, self._adopted_samples(), self._adopted_poses()
                )
            self.runs += 1
            made = self.make_list(node, uncovered)
            if made is not None:
                self.lists[node] = made
                uncovered.subtract([node], made.samples[:1], made.X_WN[:1])
            elif self._backtrack(node):
                uncovered = None
            else:
                return False
        return True

    def _next_node(self) -> int | None:
        """Step 1: the node whose parent is done that is the fewest steps from the root."""
        waiting = [
            i
            for i, node in enumerate(self.nodes)
            if i not in self.lists and (node.parent < 0 or node.parent in self.lists)
        ]
        return min(waiting, key=lambda i: (self.nodes[i].depth, i), default=None)

    def make_list(self, node: int, uncovered: Regions) -> NodeList | None:
        """Steps 3 to 5: sample, keep what stays inside (4), score (5), sort, keep the best K."""
        parent = self.nodes[node].parent
        X_WP = np.eye(4) if parent < 0 else self._adopted_pose(parent)
        X_WN = self.scoring.candidate_poses(node, X_WP)
        everything = np.arange(len(X_WN))
        outside, covered = self.scoring.candidate_areas(node, everything, X_WN, uncovered)
        limits = np.array(self.outside_limit)[:, None]
        inside = np.flatnonzero((outside <= limits).all(axis=0))
        if len(inside) == 0:
            return None
        scores = covered[inside]
        # A stable sort: equal scores keep the grid's order, which begins nearest to zero.
        worth = scores - self.settings.outside_weight * outside[:, inside].sum(axis=0)
        order = np.argsort(-worth, kind="stable")
        if len(self.nodes[node].mesh.triangles):
            order = order[: self.settings.candidate_limit]
        samples = inside[order]
        return NodeList(samples, scores[order], X_WN[samples])

    def _backtrack(self, node: int) -> bool:
        """Step 6: the nearest node towards the root with an untried candidate adopts it."""
        ancestor = self.nodes[node].parent
        while ancestor >= 0:
            current = self.lists[ancestor]
            if current.has_untried:
                self._adopt(ancestor, current.adopted + 1)
                return True
            ancestor = self.nodes[ancestor].parent
        return False

    def _adopt(self, node: int, candidate: int) -> None:
        """Adopt a candidate of an inner node and give up all that hangs on the node."""
        self.lists[node] = replace(self.lists[node], adopted=candidate)
        waiting = list(self.nodes[node].children)
        while waiting:
            child = waiting.pop()
            self.lists.pop(child, None)
            waiting.extend(self.nodes[child].children)

    # Section 5.2

    def _combine_leaves(self, J: float) -> None:
        """Section 5.2.1: the best combination of the leaves' candidates is adopted."""
        leaves = [i for i in range(len(self.nodes)) if not self.nodes[i].children]
        inner = [i for i in range(len(self.nodes)) if self.nodes[i].children]
        if all(len(self.lists[leaf].samples) == 1 for leaf in leaves):
            return
        choice, gain = best_leaf_combination(
            self.scoring,
            inner,
            (self._adopted_samples()[inner], self._adopted_poses()[inner]),
            leaves,
            [(self.lists[leaf].samples, self.lists[leaf].X_WN) for leaf in leaves],
            [self.lists[leaf].adopted for leaf in leaves],
            self.settings.leaf_combination_limit,
        )
        for leaf, candidate in zip(leaves, choice, strict=True):
            self.lists[leaf] = replace(self.lists[leaf], adopted=candidate)
        self._keep_if_better(J - gain)

    def _adopt_most_exposed(self) -> bool:
        """Section 5.2.2: adopt the most exposed node's candidate; False if A becomes empty."""
        covers = []
        samples, poses = self._adopted_samples(), self._adopted_poses()
        for i, node in enumerate(self.nodes):
            current = self.lists[i]
            if not node.children or not current.has_untried:
                continue
            others = [k for k in range(len(self.nodes)) if k != i]
            exposed = self.scoring.uncovered(others, samples, poses)
            rest = slice(current.adopted, None)
            _, cover = self.scoring.candidate_areas(
                i, current.samples[rest], current.X_WN[rest], exposed
            )
            # argmax takes the first of equals: the adopted candidate stays unless one is better.
            best = int(np.argmax(cover))
            covers.append((cover[best], i, current.adopted + best))
        # Nodes whose best candidate is the adopted one leave A one after another, largest cover
        # first, until one is met that has a better candidate.
        for _, i, candidate in sorted(covers, key=lambda entry: (-entry[0], entry[1])):
            if candidate > self.lists[i].adopted:
                self._adopt(i, candidate)
                return True
        return False

    # Poses and answers

    def _adopted_pose(self, node: int) -> np.ndarray:
        current = self.lists[node]
        return current.X_WN[current.adopted]

    def _adopted_poses(self) -> np.ndarray:
        """(nodes, 4, 4), the identity for nodes that are not done."""
        poses = np.tile(np.eye(4), (len(self.nodes), 1, 1))
        for node in self.lists:
            poses[node] = self._adopted_pose(node)
        return poses

    def _adopted_samples(self) -> np.ndarray:
        """(nodes,) int, 0 for nodes that are not done."""
        samples = np.zeros(len(self.nodes), dtype=np.int64)
        for node, current in self.lists.items():
            samples[node] = current.samples[current.adopted]
        return samples

    def _whole_pose_J(self) -> float:
        samples = self._adopted_samples()[None]
        return float(self.scoring.J(self._adopted_poses()[None], samples)[0])

    def _keep_if_better(self, J: float) -> None:
        if self.best is None or J < self.best.J:
            self.best = _Best(J, dict(self.lists))

    def result(self, seconds: float) -> PoseEstimate:
        """What the search found, as plain arrays."""
        statistics = SearchStatistics(self.runs, self.first_J, self.outside_limit)
        if self.best is None:
            return PoseEstimate.nothing(
                self.tree, stopped_by=self.stopped_by, seconds=seconds, statistics=statistics
            )
        values = []
        untried = {}
        for i, node in enumerate(self.nodes):
            current = self.best.lists[i]
            grid = self.scoring.sampled.values[i]
            values.append(grid[current.samples[current.adopted]])
            first = current.adopted + 1 if node.children else 0
            rest = [t for t in range(first, len(current.samples)) if t != current.adopted]
            untried[node.name] = Candidates(
                node.value_names, grid[current.samples[rest]], current.scores[rest]
            )
        return PoseEstimate.of_values(
            self.tree,
            values,
            self.best.J,
            self.scoring.silhouette_area,
            stopped_by=self.stopped_by,
            seconds=seconds,
            statistics=replace(statistics, untried=untried),
        )


# Section 5.2.1


def best_leaf_combination(
    scoring: Scoring,
    inner: Sequence[int],
    inner_poses: _Placed,
    leaves: Sequence[int],
    candidates: Sequence[_Placed],
    adopted: Sequence[int],
    limit: int,
) -> tuple[tuple[int, ...], float]:
    """Find the combination of the leaves' candidates with the smallest J.

    Pixels that no inner node covers are counted by their pattern: which candidates cover them.

    Args:
        inner_poses: their samples (len(inner),) and poses (len(inner), 4, 4).
        candidates: for each leaf the samples (n,) and poses (n, 4, 4).
        limit: up to so many combinations are all tried; beyond, one leaf after another.

    Returns:
        The candidate of each leaf, and by how much J is below that of ``adopted`` [pixel].
    """
    counts = [len(samples) for samples, _ in candidates]
    patterns, gains = _patterns(scoring, inner, inner_poses, leaves, candidates)
    first_columns = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)

    def worth(choices: np.ndarray) -> np.ndarray:
        """Silhouette covered less outside covered [pixel], (n,), of choices (n, leaves)."""
        total = np.empty(len(choices))
        block = max(1, _BLOCK // max(1, len(patterns)))
        for begin in range(0, len(choices), block):
            part = choices[begin : begin + block]
            covered = np.zeros((len(part), len(patterns)), dtype=bool)
            for leaf, column in enumerate(first_columns):
                covered |= patterns[:, column + part[:, leaf]].T
            total[begin : begin + block] = covered @ gains
        return total

    start = np.array([adopted])
    start_worth = worth(start)[0]
    if np.prod(np.array(counts, dtype=float)) <= limit:
        choices = np.array(list(itertools.product(*(range(count) for count in counts))))
        worths = worth(choices)
        best = int(np.argmax(worths))
        if worths[best] > start_worth:
            return tuple(int(t) for t in choices[best]), float(worths[best] - start_worth)
        return tuple(adopted), 0.0
    return _one_leaf_at_a_time(worth, start, start_worth, counts)


def _one_leaf_at_a_time(
    worth: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    start_worth: float,
    counts: Sequence[int],
) -> tuple[tuple[int, ...], float]:
    """Change one leaf after another while that is an improvement; ``start`` is (1, leaves)."""
    current, current_worth = start.copy(), start_worth
    improved = True
    while improved:
        improved = False
        for leaf, count in enumerate(counts):
            choices = np.repeat(current, count, axis=0)
            choices[:, leaf] = np.arange(count)
            worths = worth(choices)
            best = int(np.argmax(worths))
            if worths[best] > current_worth:
                current, current_worth = choices[best : best + 1], worths[best]
                improved = True
    return tuple(int(t) for t in current[0]), float(current_worth - start_worth)


def _patterns(
    scoring: Scoring,
    inner: Sequence[int],
    inner_poses: _Placed,
    leaves: Sequence[int],
    candidates: Sequence[_Placed],
) -> tuple[np.ndarray, np.ndarray]:
    """The distinct patterns (n, candidates of all leaves) bool, and what covering each is worth."""
    all_patterns, all_gains = [], []
    for v, view in enumerate(scoring.views):
        base = scoring.draw(inner, *inner_poses, v)
        masks = [
            scoring.draw([leaf], samples[t : t + 1], poses[t : t + 1], v)
            for leaf, (samples, poses) in zip(leaves, candidates, strict=True)
            for t in range(len(poses))
        ]
        open_pixels = np.logical_or.reduce(masks) & ~base
        rows, columns = np.nonzero(open_pixels)
        membership = np.array([mask[rows, columns] for mask in masks]).T
        packed = np.packbits(membership, axis=1)
        _, first, inverse = np.unique(packed, axis=0, return_index=True, return_inverse=True)
        sign = np.where(view.mask[rows, columns], 1.0, -1.0)
        all_patterns.append(membership[first])
        all_gains.append(np.bincount(inverse.ravel(), weights=sign, minlength=len(first)))
    return np.concatenate(all_patterns), np.concatenate(all_gains)
