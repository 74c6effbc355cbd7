"""The beam search: partial poses grow node by node, ranked by what the objective will be.

Its first stages let the tolerance lie outside the silhouette and end at a J within it, which
certifies itself; where they fail, a branch and bound looks for all such poses. Later stages let
more and more lie outside, weighed against what is covered newly (5). Last, limbs of the best pose
are searched again.
"""

import copy
import itertools
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.search.branch_and_bound import PosesWithin, branch_and_bound
from drake_pose.search.estimates import PoseEstimate, View, require_views
from drake_pose.search.partial_poses import (
    PartialPoses,
    Pictures,
    PoseStore,
    coarsen,
)
from drake_pose.search.pose_modes import ExaminationSettings, examine, renderer_tolerance
from drake_pose.search.sampled_body import SampledBody, Scoring
from drake_pose.search.settings import BeamSearchSettings, BoundLimits, Stage


def grow(
    store: PoseStore,
    partial: PartialPoses,
    node: int,
    width: int,
    outside_weight: int,
    limit: float = np.inf,
    spare: int = 4,
) -> tuple[PartialPoses | None, bool]:
    """Place one more node in every partial pose and keep the best.

    Args:
        outside_weight: what a pixel outside counts; one newly covered counts one.
        limit: drop what cannot come to so small an objective any more [pixel].
        spare: how many times the width are looked at until enough are found that are not alike.

    Returns:
        The new ones, best first, None where none stays inside the limit; and whether some were
            lost.
    """
    pairs = store.pairs(partial, node)
    areas, added = store.score(partial, node, pairs)
    if not store.tree_nodes[node].children:
        # Of those that add nothing at all, the first of each partial pose is enough.
        nothing = np.flatnonzero(~areas.any(axis=1))
        if len(nothing) > 1:
            more = nothing[1:][np.diff(pairs[nothing, 0]) == 0]
            pairs, areas, added = (np.delete(one, more, axis=0) for one in (pairs, areas, added))
    if len(pairs) == 0:
        return None, False
    beyond = store.nodes[node].areas[pairs[:, 1], 2]
    outside = partial.outside[pairs[:, 0]] + areas[:, 1] + beyond
    costs = outside_weight * outside - partial.covered[pairs[:, 0]] - areas[:, 0]
    # The smallest costs, equals in their order.
    most, lost = spare * width, False
    ordered = np.arange(len(costs))
    if len(costs) > most:
        ordered, lost = np.flatnonzero(costs <= np.partition(costs, most - 1)[most - 1]), True
    ordered = ordered[np.argsort(costs[ordered], kind="stable")[:most]]
    made = store.make(partial, node, pairs[ordered], (areas[ordered], added[ordered]))
    pairs = pairs[ordered]
    # What is out of reach is known after growing only: grow more and rank again.
    grown = width if limit < np.inf else 2 * width
    chosen, made, looked_at = store.choose(partial, made, node, pairs, grown, limit)
    lost = lost or len(looked_at) < len(pairs)
    if limit == np.inf:
        best = np.argsort(made.costs(outside_weight), kind="stable")[:width]
        lost = lost or len(best) < len(made)
        chosen, made = chosen[best], made.chosen(best)
    if len(made) == 0:
        return None, lost
    return store.with_masks(partial, made, node, pairs[chosen]), lost


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
        run = _BeamRun(self.body, views, self.settings, root_position, all_within=examined)
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

    def with_stages(self, *stages: Stage) -> "BeamSearch":
        """The same grid searched in other stages, and no limb searched again."""
        other = copy.copy(self)
        other.settings = replace(self.settings, stages=stages, research_hypotheses=0)
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
            alike: two poses look alike if each node's pictures have this fraction of their union in
                common in all views, or it is hidden in both, covering nothing that other nodes
                do not cover. Above 1: all poses of the grid differ.
            time_limit: after this time [s], or the settings', no more poses are looked for.

        Raises:
            SettingsError: if there is no view.
        """
        limits = [one for one in (time_limit, self.settings.time_limit) if one is not None]
        settings = replace(self.settings, time_limit=min(limits))
        run = _BeamRun(self.body, views, settings, root_position, gathers=True)
        run.search()
        return [run.scoring.sampled.values_at(one) for one in run.distinct(count, alike)]


class _BeamRun:
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
        require_views(views)
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
        self._stores: dict[float, PoseStore] = {}
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
            store = self._store(np.inf)
            start, order = store.start(), self._body.order
            last, _ = self._grow_all(store, start, order, width, 2, limited=False)
            if last is not None:
                best = int(np.argmin(self._gather(store, last)))
                self._keep_if_better(store.samples(last.poses[best]))
        elif self._settings.research_hypotheses and not (self._stopped_by or self._is_matched):
            self._turn_single_nodes(self._samples)
        self._stopped_by = "exact" if self._is_matched else self._stopped_by or "end"

    @property
    def _is_matched(self) -> bool:
        """Whether the best pose counts as exact."""
        return self._J <= self._tolerance

    def _search_within(self) -> bool:
        """Look for all poses within the tolerance, and keep the best; whether there is one."""
        left = self._deadline - time.perf_counter()
        limits = BoundLimits(time_limit=max(left, 0.0) if left < np.inf else None)
        found = branch_and_bound(self._body, self._views, self._tolerance, limits)
        if not found.graph.size:
            return False
        if self._all:
            self.within = found
        self._keep_if_better(found.graph.central())
        return True

    def _pictures_of(self, exact: bool, coarse_pixels: int = 6000) -> Pictures:
        """The silhouettes as bits: coarse ones with a band for stages that are not exact.

        ``coarse_pixels``: approximate area of a coarse silhouette; the best pose is scored in full.
        """
        if exact not in self._pictures:
            if exact:
                views, band = self._views, int(self._tolerance)
                self._pictures[exact] = Pictures(self._body, views, band, in_full=True)
            else:
                views = tuple(coarsen(view, coarse_pixels) for view in self._views)
                self._pictures[exact] = Pictures(self._body, views)
        return self._pictures[exact]

    def _store(self, outside_share: float) -> PoseStore:
        if outside_share not in self._stores:
            exact = outside_share == 0.0
            limit = self._tolerance if exact else None
            pictures = self._pictures_of(exact)
            self._stores[outside_share] = PoseStore(self._body, pictures, outside_share, limit)
        return self._stores[outside_share]

    def _proceed(self) -> bool:
        """Whether the time allows to go on, after one more node."""
        self._runs += 1
        if time.perf_counter() >= self._deadline:
            self._stopped_by = "time_limit"
        return not self._stopped_by

    def _grow_all(
        self,
        store: PoseStore,
        partial: PartialPoses,
        order: Sequence[int],
        width: int,
        outside_weight: int,
        limited: bool = True,
        limit: float = np.inf,
    ) -> tuple[PartialPoses | None, bool]:
        """Place nodes one after another; ``limited``: while the time allows.

        Returns:
            The last ones (None: none was left, or the time is up), and whether none was lost.
        """
        complete = True
        for node in order:
            grown, lost = grow(store, partial, node, width, outside_weight, limit)
            complete = complete and not lost
            if grown is None:
                return None, complete
            if limited and not self._proceed():
                return None, False
            partial = grown
        return partial, complete

    def _run_stage(self, stage: Stage) -> bool:
        """Returns whether the stage lost no hypothesis."""
        exact = stage.outside_share == 0.0
        store = self._store(stage.outside_share)
        order = self._body.limb_order if stage.limb_by_limb else self._body.order
        last, complete = self._grow_all(
            store, store.start(), order, stage.hypotheses, stage.outside_weight,
            limit=self._tolerance if exact else np.inf,
        )  # fmt: skip
        if last is None:
            return complete
        Js = self._gather(store, last)
        best = int(np.argmin(Js))
        self._keep_if_better(store.samples(last.poses[best]))
        width = self._settings.research_hypotheses
        if width and (not self._is_matched or (self._gathers and not exact)):
            better = self._search_limbs_again(store, order, last.poses[best], float(Js[best]))
            self._keep_if_better(store.samples(better))
        return complete

    def _search_limbs_again(
        self, store: PoseStore, order: Sequence[int], poses: np.ndarray, J: float
    ) -> np.ndarray:
        """Better poses (nodes,) in the store, limbs searched again by one and two.

        Limbs are the largest subtrees without a fork but the whole tree; of a chain, its outer
        half.
        """
        nodes, subtrees = store.tree_nodes, self._body.sampled.tree.subtrees
        limbs = [
            frozenset(subtrees[i])
            for i, node in enumerate(nodes)
            if not self._body.forked[i] and node.parent >= 0 and self._body.forked[node.parent]
        ]
        limbs = limbs or [frozenset(one) for one in subtrees if 2 * len(one) <= len(nodes)][:1]
        choices = [*((limb,) for limb in limbs), *itertools.combinations(limbs, 2)]
        unchanged, width = 0, self._settings.research_hypotheses
        for choice in itertools.cycle(choices):
            again = frozenset().union(*choice)
            part = [node for node in order if node in again]
            # What is placed last need not spare the silhouette for what comes after it.
            start = store.without(poses, again)
            last, _ = self._grow_all(store, start, part, width, 2)
            if last is None:
                break
            Js = self._gather(store, last)
            best = int(np.argmin(Js))
            unchanged += 1
            if Js[best] < J:
                J, poses, unchanged = float(Js[best]), last.poses[best], 1
            if unchanged >= len(choices):
                break
        return poses

    def _turn_single_nodes(self, current: np.ndarray, judged: int = 4) -> None:
        """Improve samples (nodes,) by turning single nodes, all that hangs on each moving along.

        ``judged``: how many of a node's samples, the best by pictures with bands, are judged in
        full.
        """
        scoring, pictures = self.scoring, self._pictures_of(exact=False)
        sampled, words = scoring.sampled, int(pictures.part_starts[-1])
        silhouettes = int(pictures.part_starts[len(pictures.views)])
        J, unchanged = float(scoring.J(current[None])[0]), 0
        sources = np.array([sampled.tree.source(i) for i in range(len(current))])
        nodes = np.flatnonzero(sources == np.arange(len(current))).tolist()
        for node in itertools.cycle(nodes):
            if not self._proceed():
                break
            tried = np.repeat(current[None], len(sampled.values[node]), axis=0)
            tried[:, sources == node] = np.arange(len(tried))[:, None]
            X_WN, moving = sampled.poses(tried), sampled.tree.subtrees[node]
            far = np.zeros(len(tried), dtype=np.int64)
            still = np.zeros((1, words), dtype=np.uint64)
            for i in set(range(len(current))).difference(moving):
                far += pictures.draw_node(i, tried[:1, i], X_WN[:1, i], still)[0, 2]
            masks = np.repeat(still, len(tried), axis=0)
            for i in moving:
                far += pictures.draw_node(i, tried[:, i], X_WN[:, i], masks)[:, 2]
            ones = np.bitwise_count(masks).astype(np.int64)
            outside, covered = ones[:, silhouettes:].sum(axis=1), ones[:, :silhouettes].sum(axis=1)
            order = np.argsort(pictures.area - covered + outside + far, kind="stable")
            tried = tried[order[:judged]]
            Js = scoring.J(tried)
            best = int(np.argmin(Js))
            unchanged += 1
            if Js[best] < J:
                J, current, unchanged = float(Js[best]), tried[best], 1
            if unchanged >= len(nodes):
                break
        self._keep_if_better(current)

    def _gather(self, store: PoseStore, whole: PartialPoses) -> np.ndarray:
        """What J is (n,) as the pictures show it; poses are gathered if that is wanted."""
        Js = store.objectives(whole)
        if self._gathers:
            area = store.pictures.area
            self._gathered.append((store.samples(whole.poses), Js / area))
        return Js

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
        sampled, told = self._body.sampled, dict[str, Any](stopped_by=self._stopped_by)
        told |= {"runs": self._runs, "first_J": self._first_J}
        if self._samples is None:
            return PoseEstimate.nothing(sampled.tree, **told)
        values, area = sampled.values_at(self._samples), self.scoring.silhouette_area
        return PoseEstimate.of_values(sampled.tree, values, self._J, area, **told)

    def distinct(self, count: int, alike: float) -> np.ndarray:
        """The best poses (m, nodes) gathered of which no two look alike, best first."""
        if not self._gathered:
            return np.empty((0, len(self._body.sampled.values)), dtype=np.int32)
        samples, errors = (np.concatenate(both) for both in zip(*self._gathered, strict=True))
        samples = samples[np.argsort(errors, kind="stable")]
        samples = samples[np.sort(np.unique(samples, axis=0, return_index=True)[1])]
        # Poses compared in one go, and poses scored in full.
        chunk, most = 8 * count, 2 * count
        chosen = samples[:0]
        looks = self._draw(chosen)
        for begin in range(0, len(samples), chunk):
            more = samples[begin : begin + chunk]
            masks, areas, hidden = (
                np.concatenate(both) for both in zip(looks, self._draw(more), strict=True)
            )
            kept = list(range(len(chosen)))
            for i in range(len(chosen), len(masks)):
                if len(kept) == most:
                    break
                common = np.bitwise_count(masks[i] & masks[kept]).sum(axis=2, dtype=np.int64)
                union = areas[i] + areas[kept] - common
                same = (common >= alike * union) | (hidden[i] & hidden[kept])
                if not same.all(axis=1).any():
                    kept.append(i)
            chosen = np.concatenate([chosen, more])[kept]
            looks = masks[kept], areas[kept], hidden[kept]
            if len(chosen) >= most:
                break
        return np.asarray(chosen[np.argsort(self.scoring.J(chosen), kind="stable")[:count]])

    def _draw(self, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What nodes look like at samples (n, nodes), in pictures with bands.

        Returns:
            Masks (n, nodes, W) uint64, areas (n, nodes) [pixel], and (n, nodes) bool whether a
            node adds nothing to what the others of its pose cover.
        """
        pictures, X_WN = self._pictures_of(exact=False), self.scoring.sampled.poses(samples)
        poses, nodes = samples.shape
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
