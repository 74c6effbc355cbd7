"""The beam search: partial poses grow node by node, ranked by what the objective will be.

Its first stages let the tolerance lie outside the silhouette and end at a J within it, which
certifies itself; where they fail, a branch and bound looks for all such poses. Later stages let
more and more lie outside, weighed against what is covered newly (5). Last, limbs of the best pose
are searched again.
"""

import copy
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.errors import SettingsError
from drake_pose.search.branch_and_bound import PosesWithin, branch_and_bound
from drake_pose.search.estimates import PoseEstimate, SearchStatistics, View
from drake_pose.search.partial_poses import (
    BAND,
    Expansion,
    PartialPoses,
    Pictures,
    PoseStore,
    all_pairs,
    coarsen,
)
from drake_pose.search.pose_families import ExaminationSettings, examine, renderer_tolerance
from drake_pose.search.sampled_body import SampledBody, Scoring
from drake_pose.search.settings import BeamSearchSettings, BoundLimits, Stage

# How many times the width are looked at until enough are found that are not alike.
_SPARE = 4
# What is placed last need not spare the silhouette for what comes after it.
_OUTSIDE_WEIGHT = 2
# How many of a node's samples are judged in full.
_JUDGED = 4


def grow(
    expansion: Expansion,
    partial: PartialPoses,
    node: int,
    width: int,
    outside_weight: int,
    limit: float,
) -> tuple[PartialPoses | None, bool]:
    """Place one more node in every partial pose and keep the best.

    Args:
        outside_weight: what a pixel outside counts; one newly covered counts one.
        limit: drop what cannot come to so small an objective any more [pixel].

    Returns:
        The new ones, best first, None where none stays inside the limit; and whether some were
            lost.
    """
    pairs = all_pairs(expansion.groups(partial, node))
    areas, added = expansion.score(partial, node, pairs)
    if not expansion.nodes[node].children:
        # Of those that add nothing at all, the first of each partial pose is enough.
        nothing = np.flatnonzero(~areas.any(axis=1))
        if len(nothing) > 1:
            more = nothing[1:][np.diff(pairs[nothing, 0]) == 0]
            pairs, areas, added = (np.delete(one, more, axis=0) for one in (pairs, areas, added))
    if len(pairs) == 0:
        return None, False
    beyond = expansion.store.nodes[node].areas[pairs[:, 1], 2]
    outside = partial.outside[pairs[:, 0]] + areas[:, 1] + beyond
    covered = partial.covered[pairs[:, 0]] + areas[:, 0]
    ordered = order_best(outside_weight * outside - covered, _SPARE * width)
    made = expansion.make(partial, node, pairs[ordered], (areas[ordered], added[ordered]))
    pairs, lost = pairs[ordered], len(ordered) < len(pairs)
    # What is out of reach is known after growing only: grow more and rank again.
    grown = width if limit < np.inf else 2 * width
    chosen, made, looked_at = expansion.choose(partial, made, node, pairs, grown, limit)
    lost = lost or len(looked_at) < len(pairs)
    if limit == np.inf:
        best = np.argsort(made.costs(outside_weight), kind="stable")[:width]
        lost = lost or len(best) < len(made)
        chosen, made = chosen[best], made.chosen(best)
    if len(made) == 0:
        return None, lost
    return expansion.with_masks(partial, made, node, pairs[chosen]), lost


def order_best(costs: np.ndarray, count: int) -> np.ndarray:
    """The indices of the ``count`` smallest costs (n,), smallest first, equals in their order."""
    if len(costs) <= count:
        return np.argsort(costs, kind="stable")
    near = np.flatnonzero(costs <= np.partition(costs, count - 1)[count - 1])
    return np.asarray(near[np.argsort(costs[near], kind="stable")[:count]])


def run_stage(
    expansion: Expansion,
    start: PartialPoses,
    order: Sequence[int],
    width: int,
    outside_weight: int,
    limit: float,
    proceed: Callable[[], bool],
) -> tuple[PartialPoses | None, bool]:
    """Place nodes one after another, asking after each whether to go on.

    Returns:
        The last ones (None: none was left, or told to stop), and whether none was lost.
    """
    partial, complete = start, True
    for node in order:
        grown, lost = grow(expansion, partial, node, width, outside_weight, limit)
        complete = complete and not lost
        if grown is None:
            return None, complete
        if not proceed():
            return None, False
        partial = grown
    return partial, complete


def search_limbs_again(
    expansion: Expansion,
    order: Sequence[int],
    poses: np.ndarray,
    J: float,
    width: int,
    proceed: Callable[[], bool],
    found: Callable[[PartialPoses], np.ndarray],
) -> np.ndarray:
    """Better poses (nodes,) in the store, limbs searched again by one and two while that improves.

    ``found`` gives the objectives (n,) of the last partial poses of every search.
    """
    limbs = find_limbs(expansion)
    choices = [*((limb,) for limb in limbs), *itertools.combinations(limbs, 2)]
    unchanged = 0
    for choice in itertools.cycle(choices):
        nodes = frozenset().union(*choice)
        start = expansion.without(poses, nodes)
        part = [node for node in order if node in nodes]
        last, _ = run_stage(expansion, start, part, width, _OUTSIDE_WEIGHT, np.inf, proceed)
        if last is None:
            return poses
        Js = found(last)
        best = int(np.argmin(Js))
        unchanged += 1
        if Js[best] < J:
            J, poses, unchanged = float(Js[best]), last.poses[best], 1
        if unchanged >= len(choices):
            return poses
    return poses


def find_limbs(expansion: Expansion) -> list[frozenset[int]]:
    """The largest subtrees without a fork but the whole tree; of a chain, its outer half."""
    nodes = expansion.nodes
    body = expansion.store.body
    subtrees, forked = body.sampled.tree.subtrees, body.forked
    limbs = [
        frozenset(subtrees[i])
        for i, node in enumerate(nodes)
        if not forked[i] and node.parent >= 0 and forked[node.parent]
    ]
    return limbs or [frozenset(one) for one in subtrees if 2 * len(one) <= len(nodes)][:1]


def turn_single_nodes(
    scoring: Scoring, pictures: Pictures, samples: np.ndarray, proceed: Callable[[], bool]
) -> np.ndarray:
    """Samples (nodes,) that turning no single node, all that hangs on it moving along, improves.

    As far as pictures with bands tell, and as it got before it was told not to proceed.
    """
    current = samples.copy()
    J = float(scoring.J(current[None])[0])
    unchanged = 0
    tree = scoring.sampled.tree
    nodes = [i for i in range(len(current)) if tree.source(i) == i]
    for node in itertools.cycle(nodes):
        if not proceed():
            break
        tried = np.repeat(current[None], len(scoring.sampled.values[node]), axis=0)
        together = [i for i in range(len(current)) if tree.source(i) == node]
        tried[:, together] = np.arange(len(tried))[:, None]
        approximate = _J_by_bits(scoring, pictures, tried, node)
        tried = tried[np.argsort(approximate, kind="stable")[:_JUDGED]]
        Js = scoring.J(tried)
        best = int(np.argmin(Js))
        unchanged += 1
        if Js[best] < J:
            J, current, unchanged = float(Js[best]), tried[best], 1
        if unchanged >= len(nodes):
            break
    return current


def _J_by_bits(scoring: Scoring, pictures: Pictures, samples: np.ndarray, node: int) -> np.ndarray:
    """J (n,) as the pictures show it of samples (n, nodes) that differ in one node's alone."""
    X_WN, words = scoring.sampled.poses(samples), int(pictures.part_starts[-1])
    moving, far = scoring.sampled.tree.subtrees[node], np.zeros(len(samples), dtype=np.int64)
    still = np.zeros((1, words), dtype=np.uint64)
    for i in set(range(samples.shape[1])).difference(moving):
        far += pictures.draw_node(i, samples[:1, i], X_WN[:1, i], still)[0, 2]
    masks = np.repeat(still, len(samples), axis=0)
    for i in moving:
        far += pictures.draw_node(i, samples[:, i], X_WN[:, i], masks)[:, 2]
    ones = np.bitwise_count(masks).astype(np.int64)
    silhouettes = int(pictures.part_starts[len(pictures.views)])
    outside, covered = ones[:, silhouettes:].sum(axis=1), ones[:, :silhouettes].sum(axis=1)
    return np.asarray(pictures.area - covered + outside + far)


# Stages that let something lie outside see the silhouettes no finer than with about so many pixels;
# the best pose is then judged in full.
_COARSE_PIXELS = 6000
# The search for all poses within the tolerance ends after drawing so many poses of nodes.
_POSES = 1_000_000


class BeamSearch:
    """Matches silhouettes by the beam search; every answer is examined, or not (None)."""

    def __init__(
        self,
        tree: PoseTree,
        settings: BeamSearchSettings | None = None,
        examination: ExaminationSettings | None = None,
    ) -> None:
        self.tree = tree
        self.settings = settings or BeamSearchSettings()
        self.examination = examination
        self.body = SampledBody(tree, self.settings)
        self.sampled = self.body.sampled

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose that the views show; see ``PoseSearch``.

        Returns:
            The best pose found; ``stopped_by`` is "exact" (J is within the tolerance), "end" or
            "time_limit".

        Raises:
            SettingsError: if there is no view.
        """
        start = time.perf_counter()
        examined = self.examination is not None
        run = _Run(self.body, views, self.settings, root_position, all_within=examined)
        run.search()
        result = run.result()
        if self.examination is not None:
            result = examine(self.body, views, result, self.examination, root_position, run.within)
        return replace(result, seconds=time.perf_counter() - start)

    def without_alternatives(self) -> "BeamSearch":
        """The same search where only E_total is wanted: no examination."""
        other = copy.copy(self)
        other.examination = None
        return other

    def best_poses(
        self,
        views: Sequence[View],
        root_position: np.ndarray | None = None,
        count: int = 30,
        alike: float = 0.7,
        time_limit: float = np.inf,
    ) -> list[list[np.ndarray]]:
        """Each node's values in the best whole poses met that do not look alike, best first.

        Slower than :meth:`match`: the search does not end at J = 0 before it has also looked at
        poses that leave the silhouette a little.

        Args:
            count: at most this many.
            alike: two poses look alike if each node's pictures in both have so much of their union
                in common in all views, or it is hidden in both, covering nothing that other nodes
                do not cover. Above 1: all poses of the grid differ.
            time_limit: after this time [s], or the settings', no more poses are looked for.

        Raises:
            SettingsError: if there is no view.
        """
        limits = [one for one in (time_limit, self.settings.time_limit) if one is not None]
        settings = replace(self.settings, time_limit=min(limits))
        run = _Run(self.body, views, settings, root_position, gathers=True)
        run.search()
        chosen = choose_distinct(
            run.scoring, run.pictures(exact=False), run.gathered(), count, alike
        )
        return [run.scoring.sampled.values_at(samples) for samples in chosen]


class _Run:
    """One match; it may gather all whole poses that it comes by, or all within the tolerance."""

    def __init__(
        self,
        body: SampledBody,
        views: Sequence[View],
        settings: BeamSearchSettings,
        root_position: np.ndarray | None,
        gathers: bool = False,
        all_within: bool = False,
    ) -> None:
        if not views:
            raise SettingsError("a match needs at least one view, but none was given")
        limit = settings.time_limit
        self._deadline = np.inf if limit is None else time.perf_counter() + limit
        self._body = body if root_position is None else body.with_root_position(root_position)
        self._views, self._settings, self._gathers = views, settings, gathers
        self._all = all_within
        given = settings.tolerance
        self._tolerance = renderer_tolerance(views) if given is None else given
        self.scoring = Scoring(self._body.sampled, views)
        self._gathered: list[tuple[np.ndarray, np.ndarray]] = []
        self._pictures: dict[bool, Pictures] = {}
        self._expansions: dict[float, Expansion] = {}
        self._samples: np.ndarray | None = None
        self._J, self._first_J = np.inf, np.nan
        self._runs, self._stopped_by = 0, ""
        # All poses within the tolerance, where they are asked for and there are any.
        self.within: PosesWithin | None = None

    def search(self) -> None:
        """Run stage after stage until J is within the tolerance or time is up; then polish it."""
        if self._all and self._search_within():
            self._stopped_by = "exact"
            return
        exact, tolerant = (
            [stage for stage in self._settings.stages if (stage.outside_share == 0.0) == is_exact]
            for is_exact in (True, False)
        )
        for stage in exact:
            if self._run_stage(stage) or self._stopped_by or self._is_matched:
                break
        if not (self._all or self._gathers or self._stopped_by or self._is_matched):
            self._search_within()
        for k, stage in enumerate(tolerant):
            enough = self._is_matched and not (self._gathers and k == 0)
            if self._stopped_by or enough:
                break
            self._run_stage(stage)
        if self._samples is None:
            # A pose whatever lies outside; found by one hypothesis alone if a limit was reached.
            width = 1 if self._stopped_by else self._settings.stages[-1].hypotheses
            expansion = self._expansion(np.inf)
            last, _ = run_stage(
                expansion, expansion.start(), self._body.order, width, 2, np.inf, lambda: True
            )
            if last is not None:
                best = int(np.argmin(self._gather(expansion, last)))
                self._keep_if_better(expansion.store.samples(last.poses[best]))
        elif self._settings.research_hypotheses and not (self._stopped_by or self._is_matched):
            pictures = self.pictures(exact=False)
            self._keep_if_better(
                turn_single_nodes(self.scoring, pictures, self._samples, self._proceed)
            )
        self._stopped_by = "exact" if self._is_matched else self._stopped_by or "end"

    @property
    def _is_matched(self) -> bool:
        """Whether the best pose counts as exact."""
        return self._J <= self._tolerance

    def _search_within(self) -> bool:
        """Look for all poses within the tolerance, and keep the best; whether there is one."""
        left = self._deadline - time.perf_counter()
        limits = BoundLimits(poses=_POSES, time_limit=max(left, 0.0) if left < np.inf else None)
        found = branch_and_bound(self._body, self._views, self._tolerance, limits)
        if not found.graph.size:
            return False
        if self._all:
            self.within = found
        self._keep_if_better(found.graph.central())
        return True

    def pictures(self, exact: bool) -> Pictures:
        """The silhouettes as bits: coarse ones with a band for stages that are not exact."""
        if exact not in self._pictures:
            views, band = self._views, int(self._tolerance)
            if not exact:
                views = tuple(coarsen(view, _COARSE_PIXELS) for view in views)
                band = BAND
            self._pictures[exact] = Pictures(self._body, views, band, in_full=exact)
        return self._pictures[exact]

    def _expansion(self, outside_share: float) -> Expansion:
        if outside_share not in self._expansions:
            exact = outside_share == 0.0
            limit = self._tolerance if exact else None
            store = PoseStore(self._body, self.pictures(exact), outside_share, limit)
            self._expansions[outside_share] = Expansion(store)
        return self._expansions[outside_share]

    def _proceed(self) -> bool:
        """Whether the time allows to go on, after one more node."""
        self._runs += 1
        if time.perf_counter() >= self._deadline:
            self._stopped_by = "time_limit"
        return not self._stopped_by

    def _run_stage(self, stage: Stage) -> bool:
        """Returns whether the stage lost no hypothesis."""
        exact = stage.outside_share == 0.0
        expansion = self._expansion(stage.outside_share)
        order = self._body.limb_order if stage.limb_by_limb else self._body.order
        last, complete = run_stage(
            expansion, expansion.start(), order, stage.hypotheses, stage.outside_weight,
            self._tolerance if exact else np.inf, self._proceed,
        )  # fmt: skip
        if last is None:
            return complete
        Js = self._gather(expansion, last)
        best = int(np.argmin(Js))
        self._keep_if_better(expansion.store.samples(last.poses[best]))
        width = self._settings.research_hypotheses
        if width and (not self._is_matched or (self._gathers and not exact)):
            better = search_limbs_again(
                expansion,
                order,
                last.poses[best],
                float(Js[best]),
                width,
                self._proceed,
                lambda whole: self._gather(expansion, whole),
            )
            self._keep_if_better(expansion.store.samples(better))
        return complete

    def _gather(self, expansion: Expansion, whole: PartialPoses) -> np.ndarray:
        """What J is (n,) as the pictures show it; poses are gathered if that is wanted."""
        Js = expansion.objectives(whole)
        if self._gathers:
            area = expansion.store.pictures.area
            self._gathered.append((expansion.store.samples(whole.poses), Js / area))
        return Js

    def gathered(self) -> np.ndarray:
        """All poses (n, nodes) gathered, each once, the smallest errors first."""
        if not self._gathered:
            return np.empty((0, len(self._body.sampled.values)), dtype=np.int32)
        samples, errors = (np.concatenate(both) for both in zip(*self._gathered, strict=True))
        samples = samples[np.argsort(errors, kind="stable")]
        first = np.unique(samples, axis=0, return_index=True)[1]
        return np.asarray(samples[np.sort(first)])

    def _keep_if_better(self, samples: np.ndarray) -> None:
        """Keep samples (nodes,) if their J is the smallest so far."""
        J = float(self.scoring.J(samples[None])[0])
        if self._samples is None:
            self._first_J = J
        if J < self._J:
            self._J, self._samples = J, samples
            self._gathered.append((samples[None], np.array([J / self.scoring.silhouette_area])))

    def result(self) -> PoseEstimate:
        """What the search found."""
        sampled, statistics = self._body.sampled, SearchStatistics(self._runs, self._first_J)
        told: dict[str, Any] = {"stopped_by": self._stopped_by, "statistics": statistics}
        if self._samples is None:
            return PoseEstimate.nothing(sampled.tree, **told)
        values, area = sampled.values_at(self._samples), self.scoring.silhouette_area
        return PoseEstimate.of_values(sampled.tree, values, self._J, area, **told)


# How many times the poses asked for are looked at in one go, and scored in full.
_LOOKED_AT = 8
_SCORED = 2
# Of nodes: masks (n, nodes, W) uint64, areas (n, nodes), and what adds nothing (n, nodes) bool.
_Looks = tuple[np.ndarray, np.ndarray, np.ndarray]


def choose_distinct(
    scoring: Scoring, pictures: Pictures, samples: np.ndarray, count: int, alike: float
) -> np.ndarray:
    """The best poses (m, nodes), best first, of some (n, nodes), about the best first.

    No two look alike in pictures with bands: in each node so much of their union in common.
    """
    chosen = samples[:0]
    looks = _draw(pictures, chosen, scoring.sampled.poses(chosen))
    chunk, most = _LOOKED_AT * count, _SCORED * count
    for begin in range(0, len(samples), chunk):
        more = samples[begin : begin + chunk]
        drawn = _draw(pictures, more, scoring.sampled.poses(more))
        masks, areas, hidden = (np.concatenate(both) for both in zip(looks, drawn, strict=True))
        kept = _find_different((masks, areas, hidden), len(chosen), most, alike)
        chosen = np.concatenate([chosen, more])[kept]
        looks = masks[kept], areas[kept], hidden[kept]
        if len(chosen) >= most:
            break
    J = scoring.J(chosen)
    return np.asarray(chosen[np.argsort(J, kind="stable")[:count]])


def _draw(pictures: Pictures, samples: np.ndarray, X_WN: np.ndarray) -> _Looks:
    """What all nodes look like at samples (n, nodes) and poses (n, nodes, 4, 4)."""
    poses, nodes = X_WN.shape[:2]
    by_node = np.zeros((nodes, poses, int(pictures.part_starts[-1])), dtype=np.uint64)
    drawn = [
        pictures.draw_node(node, samples[:, node], X_WN[:, node], by_node[node])
        for node in range(nodes)
    ]
    masks, areas = by_node.swapaxes(0, 1), np.stack(drawn, axis=1)
    # What the others of its pose cover twice and once tells what a node alone adds.
    once, twice = np.zeros_like(masks[:, 0]), np.zeros_like(masks[:, 0])
    for node in range(nodes):
        twice |= once & masks[:, node]
        once |= masks[:, node]
    hidden = (areas[:, :, 2] == 0) & ~np.any(masks & ~twice[:, None], axis=2)
    return masks, areas.sum(axis=2), hidden


def _find_different(looks: _Looks, known: int, count: int, alike: float) -> np.ndarray:
    """The first poses that do not look like one before, (m,) int64, at most ``count``."""
    masks, areas, hidden = looks
    chosen = list(range(known))
    for i in range(known, len(masks)):
        if len(chosen) == count:
            break
        common = np.bitwise_count(masks[i] & masks[chosen]).sum(axis=2, dtype=np.int64)
        union = areas[i] + areas[chosen] - common
        same = (common >= alike * union) | (hidden[i] & hidden[chosen])
        if not same.all(axis=1).any():
            chosen.append(i)
    return np.array(chosen, dtype=np.int64)
