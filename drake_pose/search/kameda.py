"""Estimate joint angles from a silhouette by Kameda's search (sections 5.1 and 5.2 of the paper).

Section 5.1 places node after node at the best of its sampled poses, with backtracking. Section 5.2
re-estimates the leaves together, and then single inner nodes. In several views all areas are
summed over the views, and condition (4), that a node's area outside the silhouette is at most the
threshold r, must hold in each view.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.errors import require_at_least
from drake_pose.search.estimates import PoseEstimate, View, require_views
from drake_pose.search.sampled_body import GridSettings, Regions, SampledTree, Scoring


@dataclass(frozen=True)
class PaperSearchSettings(GridSettings):
    """Parameters of Kameda's search (sections 5.1, 5.2 and 6.1 of the paper).

    ``outside_limit``: the threshold r of (4) [pixel]: greatest area of a segment outside the
    silhouette, in each view. None: start with 12.6 % of the mean projected area of a segment (200
    pixels for the paper's body) and double until a pose is found. ``candidate_limit``: K, the
    number of candidates kept for each node. ``run_limit``: greatest number of runs of step 3; the
    best pose found until then is returned.

    Raises SettingsError: if a value is out of its range.
    """

    outside_limit: float | None = None
    candidate_limit: int = 5
    run_limit: int = 10_000

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(0, outside_limit=self.outside_limit)
        require_at_least(1, candidate_limit=self.candidate_limit, run_limit=self.run_limit)


@dataclass(frozen=True)
class NodeList:
    """The candidate list of one node, best first: JAC_i(1), JAC_i(2), ..."""

    samples: np.ndarray  # (n,) the candidates: indices in the node's grid.
    X_WN: np.ndarray  # (n, 4, 4) the node's poses at these.
    adopted: int = 0  # u_i, index of the adopted candidate, from 0.

    @property
    def has_untried(self) -> bool:
        """Whether there is a candidate after the adopted one."""
        return self.adopted + 1 < len(self.samples)


class PaperSearch:
    """Estimates poses on a grid of joint values by the paper's search.

    ``tree``: the pose tree whose values are searched. ``settings``: the grid and the paper's
    parameters; None: the defaults.
    """

    def __init__(self, tree: PoseTree, settings: PaperSearchSettings | None = None) -> None:
        self.tree = tree
        self.settings = settings or PaperSearchSettings()
        self.sampled = SampledTree(tree, self.settings)

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose that the views show.

        ``views``: the silhouettes, one per camera. ``root_position``: (3,) the root's position in
        the world [m]; None: that of the tree. Returns the best pose found; ``stopped_by`` is "end"
        or "run_limit". Raises SettingsError: there is no view.
        """
        require_views(views)
        start = time.perf_counter()
        sampled, fixed = self.sampled, self.settings.outside_limit
        if root_position is not None:
            sampled = sampled.with_root_position(root_position)
        scoring = Scoring(sampled, views)
        if fixed is not None:
            limits = [float(fixed)] * len(views)
        else:
            X_WN = sampled.tree.node_poses([values[0] for values in sampled.values])
            # The paper's r = 200 pixels is 12.6 % of a node's mean projected area (section 6.1).
            limits = [max(1.0, 0.126 * area) for area in scoring.mean_node_areas(X_WN)]
        runs = 0
        while True:
            run = PaperRun(scoring, self.settings, limits, runs)
            run.search()
            runs = run.runs
            widest = all(r >= view.mask.size for r, view in zip(limits, views, strict=True))
            ended = run.best_J < np.inf or fixed is not None or widest
            if not ended and runs >= self.settings.run_limit:
                # Wider thresholds would have been tried.
                run.stopped_by, ended = "run_limit", True
            if ended:
                return replace(run.result(), seconds=time.perf_counter() - start)
            limits = [2.0 * r for r in limits]


class PaperRun:
    """One run of the search with a fixed threshold r.

    Args:
        scoring: the sampled tree and the views.
        settings: the paper's parameters; their own ``outside_limit`` is ignored.
        outside_limit: the threshold r in each view [pixel].
        runs: number of runs of step 3 before this run.

    Attributes:
        lists: candidate list of each node that is placed.
        best_J, best_samples: the best pose found, its objective [pixel] and samples (nodes,).
        first_J: objective of the first whole pose [pixel].
        stopped_by: "end" or "run_limit".
    """

    def __init__(
        self,
        scoring: Scoring,
        settings: PaperSearchSettings,
        outside_limit: Sequence[float],
        runs: int,
    ) -> None:
        self.nodes = scoring.sampled.tree.nodes
        self.scoring, self.settings = scoring, settings
        self.outside_limit = tuple(outside_limit)
        self.runs = runs
        self.lists: dict[int, NodeList] = {}
        self.best_J, self.first_J = np.inf, np.nan
        self.best_samples = np.zeros(0, dtype=np.int64)
        self.stopped_by = "end"

    # Section 5.1

    def search(self) -> None:
        """Run sections 5.1 and 5.2 to the end, or up to the limit of runs."""
        while self._complete():
            J = float(self.scoring.J(self._adopted()[0][None])[0])
            if self.best_J == np.inf:
                self.first_J = J
            self._keep_if_better(J)
            self._keep_if_better(J - self._combine_leaves())
            if not self._adopt_most_exposed():
                return

    def _complete(self) -> bool:
        """Run steps 1 to 6; return whether every node is placed before poses or runs end."""
        uncovered: Regions | None = None
        while len(self.lists) < len(self.nodes):
            # Step 1: of the nodes whose parent is placed, the one nearest to the root.
            waiting = (
                i
                for i, node in enumerate(self.nodes)
                if i not in self.lists and (node.parent < 0 or node.parent in self.lists)
            )
            node = min(waiting, key=lambda i: (self.nodes[i].depth, i))
            if self.runs >= self.settings.run_limit:
                self.stopped_by = "run_limit"
                return False
            if uncovered is None:
                uncovered = self.scoring.uncovered(sorted(self.lists), *self._adopted())
            self.runs += 1
            made = self.make_list(node, uncovered)
            if made is not None:
                self.lists[node] = made
                self.scoring.subtract(uncovered, [node], made.samples[:1], made.X_WN[:1])
                continue
            # Step 6: the nearest node towards the root with an untried candidate adopts it.
            ancestor, uncovered = self.nodes[node].parent, None
            while ancestor >= 0 and not self.lists[ancestor].has_untried:
                ancestor = self.nodes[ancestor].parent
            if ancestor < 0:
                return False
            self._adopt(ancestor, self.lists[ancestor].adopted + 1)
        return True

    def make_list(self, node: int, uncovered: Regions) -> NodeList | None:
        """Run steps 3 to 5 for a node, with its parent at the adopted pose.

        The node's poses with an area outside up to r in each view, condition (4), are sorted by the
        uncovered silhouette that they cover, score (5), and the best K are kept (all for a node
        without geometry).

        ``node``: index of the node. ``uncovered``: the part of the silhouette that no placed node
        covers. Returns the candidate list; None if no pose satisfies (4).
        """
        parent = self.nodes[node].parent
        sampled = self.scoring.sampled
        X_WP = np.eye(4) if parent < 0 else self._adopted()[1][parent]
        X_WN = X_WP @ sampled.X_PN[node]
        samples = np.arange(len(X_WN))
        if sampled.tree.source(node) != node:
            samples = self._adopted()[0][[parent]]
            X_WN = X_WN[samples]
        outside, covered = self.scoring.candidate_areas(node, samples, X_WN, uncovered)
        limits = np.array(self.outside_limit)[:, None]
        inside = np.flatnonzero((outside <= limits).all(axis=0))
        if len(inside) == 0:
            return None
        # The sort is stable: equal scores keep the grid's order, which starts nearest to zero.
        best = inside[np.argsort(-covered[inside], kind="stable")]
        if len(self.nodes[node].mesh.triangles):
            best = best[: self.settings.candidate_limit]
        return NodeList(samples[best], X_WN[best])

    def _adopt(self, node: int, candidate: int) -> None:
        """Adopt a candidate (index in the list) of a node, and remove its descendants' lists."""
        self.lists[node] = replace(self.lists[node], adopted=candidate)
        for below in self.scoring.sampled.tree.subtrees[node]:
            if below != node:
                self.lists.pop(below, None)

    # Section 5.2

    def _combine_leaves(self, combinations: int = 100_000, block: int = 4_000_000) -> float:
        """Adopt the best combination of the leaves' candidates; return the decrease of J [pixel].

        This is section 5.2.1.

        ``combinations``: if there are more combinations, the candidates of one leaf after another
        are tried, until J does not decrease any further. ``block``: greatest number of array
        entries (combinations times pixel patterns) that are processed at a time.
        """
        leaves = [i for i, node in enumerate(self.nodes) if not node.children]
        counts = [len(self.lists[leaf].samples) for leaf in leaves]
        if max(counts) == 1:
            return 0.0
        patterns, gains = self._patterns(leaves)
        columns = np.cumsum([0, *counts[:-1]])

        def gain(choices: np.ndarray) -> np.ndarray:
            """Return (n,) covered silhouette minus area outside [pixel] of choices (n, leaves)."""
            total = np.empty(len(choices))
            step = max(1, block // max(1, len(patterns)))
            for begin in range(0, len(choices), step):
                part = columns + choices[begin : begin + step]
                covered = np.logical_or.reduce([patterns[:, one].T for one in part.T])
                total[begin : begin + step] = covered @ gains
            return total

        current = np.array([self.lists[leaf].adopted for leaf in leaves])
        first = best = gain(current[None])[0]
        together = np.prod(counts, dtype=np.float64) <= combinations
        every = list(range(len(leaves)))
        groups = [every] if together else [[k] for k in every]
        unchanged = 0
        while unchanged < len(groups):
            # The candidates of one leaf after another while J decreases, or of all at once.
            group = groups.pop(0)
            groups.append(group)
            tried = np.indices([counts[k] for k in group]).reshape(len(group), -1).T
            choices = np.repeat(current[None], len(tried), axis=0)
            choices[:, group] = tried
            tried_gains = gain(choices)
            i = int(np.argmax(tried_gains))
            unchanged += 1
            if tried_gains[i] > best:
                best, current, unchanged = tried_gains[i], choices[i], 1
        for leaf, candidate in zip(leaves, current.tolist(), strict=True):
            self.lists[leaf] = replace(self.lists[leaf], adopted=candidate)
        return float(best - first)

    def _patterns(self, leaves: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Group the pixels that no inner node covers by the leaves' candidates that cover them.

        Returns (n, candidates) bool the distinct sets of candidates of each view, with a column for
        each candidate, leaf after leaf; and (n,) for each set the number of its pixels in the
        silhouette minus the number outside.
        """
        inner = [i for i, node in enumerate(self.nodes) if node.children]
        adopted = [array[inner] for array in self._adopted()]
        all_patterns, all_gains = [], []
        for v, view in enumerate(self.scoring.views):
            masks = [
                self.scoring.draw([leaf], samples[None], X_WN[None], v)
                for leaf in leaves
                for samples, X_WN in zip(
                    self.lists[leaf].samples, self.lists[leaf].X_WN, strict=True
                )
            ]
            base = self.scoring.draw(inner, adopted[0], adopted[1], v)
            rows, columns = np.nonzero(np.logical_or.reduce(masks) & ~base)
            membership = np.array([mask[rows, columns] for mask in masks]).T
            packed = np.packbits(membership, axis=1)
            _, first, inverse = np.unique(packed, axis=0, return_index=True, return_inverse=True)
            sign = np.where(view.mask[rows, columns], 1.0, -1.0)
            all_patterns.append(membership[first])
            all_gains.append(np.bincount(inverse.ravel(), weights=sign, minlength=len(first)))
        return np.concatenate(all_patterns), np.concatenate(all_gains)

    def _adopt_most_exposed(self) -> bool:
        """Adopt the most exposed inner node's better candidate (5.2.2); False: it has none."""
        covers = []
        samples, poses = self._adopted()
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
            # argmax returns the first maximum: the adopted candidate stays if none is better.
            best = int(np.argmax(cover))
            covers.append((cover[best], i, current.adopted + best))
        # Nodes are removed from A in the order of their cover, largest first, until one has a
        # better candidate than the adopted one.
        for _, i, candidate in sorted(covers, key=lambda entry: (-entry[0], entry[1])):
            if candidate > self.lists[i].adopted:
                self._adopt(i, candidate)
                return True
        return False

    # Poses and answers

    def _adopted(self) -> tuple[np.ndarray, np.ndarray]:
        """Return samples (nodes,) and X_WN (nodes, 4, 4), 0 and the identity where not placed."""
        samples = np.zeros(len(self.nodes), dtype=np.int64)
        poses = np.tile(np.eye(4), (len(self.nodes), 1, 1))
        for node, current in self.lists.items():
            samples[node] = current.samples[current.adopted]
            poses[node] = current.X_WN[current.adopted]
        return samples, poses

    def _keep_if_better(self, J: float) -> None:
        """Keep the adopted pose if its objective J [pixel] is the smallest so far."""
        if J < self.best_J:
            self.best_J, self.best_samples = J, self._adopted()[0]

    def result(self) -> PoseEstimate:
        """Return the best pose found."""
        sampled, more = self.scoring.sampled, dict[str, Any](stopped_by=self.stopped_by)
        more |= {"runs": self.runs, "first_J": self.first_J, "outside_limit": self.outside_limit}
        if self.best_J == np.inf:
            return PoseEstimate.nothing(sampled.tree, **more)
        values, area = sampled.values_at(self.best_samples), self.scoring.silhouette_area
        return PoseEstimate.of_values(sampled.tree, values, self.best_J, area, **more)
