"""Search the pose of minimum objective J on a grid by a beam search over partial poses.

J is the area in which projected body and silhouette differ, summed over the views [pixel].

Nodes are placed one after another, and after each the hypotheses with the least expected objective
are kept. Branch and bounds, the first ones with few hypotheses, search poses with J within the
tolerance, which are exact. If there are none, beam searches weight area outside the silhouette
against newly covered area (5), and search the limbs of the best pose again.
"""

import copy
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.errors import SettingsError, require_at_least
from drake_pose.search.branch_and_bound import PosesWithin, branch_and_bound
from drake_pose.search.estimates import PoseEstimate, View, require_views
from drake_pose.search.partial_poses import (
    BoundLimits,
    PartialPoses,
    PoseStore,
    SilhouetteBits,
    coarsen,
)
from drake_pose.search.pose_modes import ExaminationSettings, examine, renderer_tolerance
from drake_pose.search.sampled_body import GridSettings, SampledBody, Scoring


@dataclass(frozen=True)
class Stage:
    """One pass of the beam search over all nodes.

    Args:
        hypotheses: beam width: number of hypotheses kept after each node.
        outside_fraction: greatest area of a node outside the silhouette, as a fraction of the
            node's mean projected area, both summed over the views; infinite: no limit.
        outside_weight: cost of a pixel outside the silhouette, relative to the gain of a newly
            covered pixel.
        limb_by_limb: True: place one limb after another; False: place the ends of all limbs last.
    """

    hypotheses: int
    outside_fraction: float
    outside_weight: int
    limb_by_limb: bool = False

    def __post_init__(self) -> None:
        require_at_least(1, hypotheses=self.hypotheses, outside_weight=self.outside_weight)
        require_at_least(0, outside_fraction=self.outside_fraction)


@dataclass(frozen=True)
class BeamSearchSettings(GridSettings):
    """Parameters of the beam search.

    Args:
        tolerance: a pose with J up to this counts as exact [pixel]; None: the difference between
            two renderers (``renderer_tolerance``).
        stages: the passes, run one after another until J is within the tolerance.
        research_hypotheses: beam width when limbs of the best pose are searched again; 0: limbs are
            not searched again.
        time_limit: time after which the best pose found is returned [s]; None: no limit.

    Raises:
        SettingsError: if a value is out of its range.
    """

    tolerance: float | None = None
    stages: tuple[Stage, ...] = (Stage(80, 0.3, 5), Stage(300, 1.0, 2))
    research_hypotheses: int = 30
    time_limit: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.stages:
            raise SettingsError("stages must hold at least one stage")
        hypotheses = self.research_hypotheses
        require_at_least(0, research_hypotheses=hypotheses, time_limit=self.time_limit)


def grow(
    store: PoseStore, partial: PartialPoses, node: int, width: int, outside_weight: int
) -> PartialPoses | None:
    """Place one more node in every partial pose and keep the best results.

    Args:
        store: the poses of nodes within its limit of the area outside. All the node's poses at its
            parent's pose in a partial pose are tried; those not yet in the store are drawn.
        partial: the partial poses that are extended.
        node: index of the node that is placed.
        width: beam width: greatest number of partial poses that are kept.
        outside_weight: cost of a pixel outside, relative to the gain of a newly covered one.

    Returns the new partial poses, best first; None if there is none.
    """
    pairs = store.pairs(partial, node)
    areas, added = store.score(partial, node, pairs)
    if not store.tree_nodes[node].children:
        # All poses of a leaf that cover no new pixel are equivalent: keep one per partial pose.
        nothing = np.flatnonzero(~areas.any(axis=1))
        if len(nothing) > 1:
            more = nothing[1:][np.diff(pairs[nothing, 0]) == 0]
            pairs, areas, added = (np.delete(one, more, axis=0) for one in (pairs, areas, added))
    if len(pairs) == 0:
        return None
    outside = partial.outside[pairs[:, 0]] + areas[:, 1] + store.nodes[node].areas[pairs[:, 1], 2]
    costs = outside_weight * outside - partial.covered[pairs[:, 0]] - areas[:, 0]
    # The smallest costs, from which distinct ones are chosen; equal costs keep their order.
    most = min(4 * width, len(costs))
    best = np.flatnonzero(costs <= np.partition(costs, most - 1)[most - 1])
    best = best[np.argsort(costs[best], kind="stable")[:most]]
    pairs, scores = pairs[best], (areas[best], added[best])
    # The unreachable area is known only after placing the node: place more, and rank again.
    chosen, made, _ = store.place(partial, node, pairs, scores, 2 * width)
    best = np.argsort(made.costs(outside_weight), kind="stable")[:width]
    return store.with_masks(partial, made.chosen(best), node, pairs[chosen[best]])


class BeamSearch:
    """Estimates poses on a grid of joint values by a beam search.

    ``tree``: the pose tree whose values are searched. ``settings``: the grid and the stages of the
    search; None: the defaults. ``examination``: parameters of the proof of optimality and of the
    search for poses as good; None: the best pose alone is returned.
    """

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
        """Estimate the pose that the views show.

        ``views``: the silhouettes, one per camera. ``root_position``: (3,) the root's position in
        the world [m]; None: that of the tree.

        Returns the best pose found; ``stopped_by`` is "exact" (J is within the tolerance), "end" or
        "time_limit".

        Raises SettingsError: if there is no view.
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
        """Return the same search without proof of optimality and without a pose set."""
        other = copy.copy(self)
        other.examination = None
        return other

    def with_stages(self, *stages: Stage) -> "BeamSearch":
        """Return a search of the same grid in other stages, without searching limbs again."""
        other = copy.copy(self)
        other.settings = replace(self.settings, stages=stages, research_hypotheses=0)
        return other

    def best_poses(
        self,
        views: Sequence[View],
        root_position: np.ndarray | None = None,
        count: int = 4,
        overlap: float = 0.5,
        time_limit: float = np.inf,
    ) -> list[list[np.ndarray]]:
        """Return the best whole poses that differ visibly, best first.

        This is slower than :meth:`match`: after an exact pose is found, the first stage is still
        run.

        Args:
            views: the silhouettes, one per camera.
            root_position: (3,) the root's position [m]; None: that of the tree.
            count: greatest number of poses.
            overlap: two poses are alike if for every node the intersection over union of its
                projections, areas summed over the views, is at least this, or the node is hidden in
                both poses (the other nodes cover all of its projection). Above 1: all poses differ.
            time_limit: time after which the search stops [s]; the settings' limit applies, too.

        Returns:
            For each pose the values (k,) of each node [rad or m].

        Raises SettingsError: if there is no view.
        """
        limits = [one for one in (time_limit, self.settings.time_limit) if one is not None]
        settings = replace(self.settings, time_limit=min(limits))
        run = _BeamRun(self.body, views, settings, root_position, collect=True)
        run.search()
        return [run.scoring.sampled.values_at(one) for one in run.distinct(count, overlap)]


class _BeamRun:
    """One run of the beam search.

    Args:
        body: the sampled body.
        views: the silhouettes, one per camera.
        settings: parameters of the search.
        root_position: (3,) the root's position [m]; None: that of the tree.
        collect: whether all whole poses met are collected, for ``distinct``.
        all_within: whether all poses within the tolerance are enumerated first.

    Attributes:
        within: all poses within the tolerance; None: not enumerated (all_within is False), or none
            was found.
    """

    def __init__(
        self,
        body: SampledBody,
        views: Sequence[View],
        settings: BeamSearchSettings,
        root_position: np.ndarray | None,
        collect: bool = False,
        all_within: bool = False,
    ) -> None:
        require_views(views)
        limit = settings.time_limit
        self._deadline = np.inf if limit is None else time.perf_counter() + limit
        self._body = body if root_position is None else body.with_root_position(root_position)
        self._views, self._settings, self._collect = views, settings, collect
        self._all = all_within
        given = settings.tolerance
        self._tolerance = renderer_tolerance(views) if given is None else given
        self.scoring = Scoring(self._body.sampled, views)
        self._collected: list[tuple[np.ndarray, np.ndarray]] = []
        self._samples: np.ndarray | None = None
        self._J, self._first_J = np.inf, np.nan
        self._runs, self._stopped_by = 0, ""
        self.within: PosesWithin | None = None

    def search(self) -> None:
        """Run the stages until J is within the tolerance or time is up, and improve the result."""
        if not self._collect:
            self._search_within()
        for k, stage in enumerate(self._settings.stages):
            if self._stopped_by or (self._is_matched and not (self._collect and k == 0)):
                break
            self._run_stage(stage)
        if self._samples is None:
            # No stage found a pose: search one without a limit on the area outside, with a single
            # hypothesis if the time is up.
            width = 1 if self._stopped_by else self._settings.stages[-1].hypotheses
            self._run_stage(Stage(width, np.inf, 2), limited=False)
        self._stopped_by = "exact" if self._is_matched else self._stopped_by or "end"

    @property
    def _is_matched(self) -> bool:
        """Whether the best pose counts as exact."""
        return self._J <= self._tolerance

    def _search_within(self) -> None:
        """Enumerate poses within the tolerance, all if need be, and keep the best."""
        everything = BoundLimits().states
        for states in (everything,) if self._all else (20, 160, everything):
            left = self._deadline - time.perf_counter()
            limits = BoundLimits(
                states=states, time_limit=max(left, 0.0) if left < np.inf else None
            )
            found = branch_and_bound(self._body, self._views, self._tolerance, limits)
            self._runs += len(self._body.order)
            if found.graph.size:
                self.within = found if self._all else None
                self._keep_if_better(found.graph.central())
            if time.perf_counter() >= self._deadline:
                self._stopped_by = "time_limit"
            if found.graph.size or found.complete or self._stopped_by:
                return

    @cached_property
    def _bits(self, coarse_pixels: int = 6000) -> SilhouetteBits:
        """The silhouettes as bit masks of ``coarse_pixels``.

        The best pose of a stage is scored at full resolution.
        """
        views = tuple(coarsen(view, coarse_pixels) for view in self._views)
        return SilhouetteBits(self._body, views)

    def _grow_all(
        self,
        store: PoseStore,
        partial: PartialPoses,
        order: Sequence[int],
        stage: Stage,
        limited: bool = True,
    ) -> PartialPoses | None:
        """Place the nodes of ``order`` one after another.

        ``store``: the poses of nodes. ``partial``: the partial poses that are extended. ``stage``:
        whose beam width and weight hold. ``limited``: whether the time limit ends the search.

        Returns the partial poses with all nodes placed; None: none was left, or the time is up.
        """
        for node in order:
            grown = grow(store, partial, node, stage.hypotheses, stage.outside_weight)
            self._runs += 1
            if limited and time.perf_counter() >= self._deadline:
                self._stopped_by = "time_limit"
                return None
            if grown is None:
                return None
            partial = grown
        return partial

    def _run_stage(self, stage: Stage, limited: bool = True) -> None:
        """Run one stage and keep its best pose; ``limited``: whether the time limit ends it."""
        store = PoseStore(self._body, self._bits, stage.outside_fraction)
        order = self._body.limb_order if stage.limb_by_limb else self._body.order
        whole = self._grow_all(store, store.start(), order, stage, limited)
        if whole is None:
            return
        Js = self._score(store, whole)
        best = int(np.argmin(Js))
        self._keep_if_better(store.samples(whole.poses[best]))
        again = limited and self._settings.research_hypotheses
        if again and (self._collect or not self._is_matched):
            better = self._search_limbs_again(store, order, whole.poses[best], float(Js[best]))
            self._keep_if_better(store.samples(better))

    def _search_limbs_again(
        self, store: PoseStore, order: Sequence[int], poses: np.ndarray, J: float
    ) -> np.ndarray:
        """Search single limbs and pairs of limbs again until J does not decrease or time is up.

        Limbs are the largest subtrees without a fork that are not the whole tree; for a chain, its
        outer half.

        ``store``: the poses of nodes. ``order``: the nodes, in the order in which they are placed.
        ``poses``: (nodes,) index of each node's pose in the store. ``J``: the objective of these
        poses at the store's resolution [pixel].

        Returns (nodes,) index in the store of each node's pose of least J found.
        """
        nodes, subtrees = store.tree_nodes, self._body.sampled.tree.subtrees
        limbs = [
            frozenset(subtrees[i])
            for i, node in enumerate(nodes)
            if not self._body.forked[i] and node.parent >= 0 and self._body.forked[node.parent]
        ]
        limbs = limbs or [frozenset(one) for one in subtrees if 2 * len(one) <= len(nodes)][:1]
        choices = [*((limb,) for limb in limbs), *itertools.combinations(limbs, 2)]
        unchanged, stage = 0, Stage(self._settings.research_hypotheses, np.inf, 2)
        for choice in itertools.cycle(choices):
            again = frozenset().union(*choice)
            part = [node for node in order if node in again]
            # A limb placed last may cover silhouette that it had left to later nodes before.
            start = store.without(poses, again)
            last = self._grow_all(store, start, part, stage)
            if last is None:
                break
            Js = self._score(store, last)
            best = int(np.argmin(Js))
            unchanged += 1
            if Js[best] < J:
                J, poses, unchanged = float(Js[best]), last.poses[best], 1
            if unchanged >= len(choices):
                break
        return poses

    def _score(self, store: PoseStore, whole: PartialPoses) -> np.ndarray:
        """Return J (n,) of whole poses at the store's resolution [pixel].

        The poses are added to the collected ones if the run collects.
        """
        Js = store.objectives(whole)
        if self._collect:
            area = store.bits.area
            self._collected.append((store.samples(whole.poses), Js / area))
        return Js

    def _keep_if_better(self, samples: np.ndarray) -> None:
        """Keep samples (nodes,) if their J at full resolution is the smallest so far."""
        J = float(self.scoring.J(samples[None])[0])
        if self._samples is None:
            self._first_J = J
        if J < self._J:
            self._J, self._samples = J, samples
            self._collected.append((samples[None], np.array([J / self.scoring.silhouette_area])))

    def result(self) -> PoseEstimate:
        """Return the best pose found."""
        sampled, statistics = self._body.sampled, dict[str, Any](stopped_by=self._stopped_by)
        statistics |= {"runs": self._runs, "first_J": self._first_J}
        if self._samples is None:
            return PoseEstimate.nothing(sampled.tree, **statistics)
        values, area = sampled.values_at(self._samples), self.scoring.silhouette_area
        return PoseEstimate.of_values(sampled.tree, values, self._J, area, **statistics)

    def distinct(self, count: int, overlap: float) -> np.ndarray:
        """Return samples (m, nodes) of the best different poses, see ``BeamSearch.best_poses``."""
        if not self._collected:
            return np.empty((0, len(self._body.sampled.values)), dtype=np.int32)
        samples, errors = (np.concatenate(both) for both in zip(*self._collected, strict=True))
        samples = samples[np.argsort(errors, kind="stable")]
        samples = samples[np.sort(np.unique(samples, axis=0, return_index=True)[1])]
        # Number of poses compared at a time, and of poses scored at full resolution.
        chunk, most = 8 * count, 2 * count
        chosen = samples[:0]
        drawn = self._draw(chosen)
        for begin in range(0, len(samples), chunk):
            more = samples[begin : begin + chunk]
            masks, areas, hidden = (
                np.concatenate(both) for both in zip(drawn, self._draw(more), strict=True)
            )
            kept = list(range(len(chosen)))
            for i in range(len(chosen), len(masks)):
                if len(kept) == most:
                    break
                common = np.bitwise_count(masks[i] & masks[kept]).sum(axis=2, dtype=np.int64)
                union = areas[i] + areas[kept] - common
                same = (common >= overlap * union) | (hidden[i] & hidden[kept])
                if not same.all(axis=1).any():
                    kept.append(i)
            chosen = np.concatenate([chosen, more])[kept]
            drawn = masks[kept], areas[kept], hidden[kept]
            if len(chosen) >= most:
                break
        return np.asarray(chosen[np.argsort(self.scoring.J(chosen), kind="stable")[:count]])

    def _draw(self, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw each node of poses with samples (n, nodes), at coarse resolution.

        Returns (n, nodes, W) uint64 bit masks of the nodes, (n, nodes) their areas [pixel], and (n,
        nodes) bool whether the other nodes of the pose cover all of a node's projection.
        """
        bits, X_WN = self._bits, self.scoring.sampled.poses(samples)
        poses, nodes = samples.shape
        by_node = np.zeros((nodes, poses, int(bits.part_starts[-1])), dtype=np.uint64)
        drawn = [
            bits.draw_node(node, samples[:, node], X_WN[:, node], by_node[node])
            for node in range(nodes)
        ]
        masks, areas = by_node.swapaxes(0, 1), np.stack(drawn, axis=1)
        # A pixel is covered by a node alone if the node covers it and it is not covered twice.
        once, twice = np.zeros_like(masks[:, 0]), np.zeros_like(masks[:, 0])
        for node in range(nodes):
            twice |= once & masks[:, node]
            once |= masks[:, node]
        hidden = (areas[:, :, 2] == 0) & ~np.any(masks & ~twice[:, None], axis=2)
        return masks, areas.sum(axis=2), hidden
