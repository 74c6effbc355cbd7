"""Multi-start search: from silhouettes, also damaged or ill fitting, to continuous positions.

Poses that are roughly right are found by places (``coarse_search``), drawn to the silhouettes'
edges by saturating costs (``fit``), and about the best of them other explanations are sought: a
limb searched again, joints that turn against each other (``self_motions``). Where a piece as thick
as a limb is left unexplained, a beam search by areas gives other starts.
"""

from __future__ import annotations

import copy
import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial

import cv2
import numpy as np

from drake_pose.body import PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import SettingsError
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import few_triangles, rough_outlines
from drake_pose.search.beam_search import BeamSearch
from drake_pose.search.coarse_search import (
    HYPOTHESES,
    INTERVAL,
    LENGTH_INTERVAL,
    CoarsePoses,
    CoarseSearch,
)
from drake_pose.search.estimates import PoseEstimate, SearchStatistics, View
from drake_pose.search.partial_poses import coarsen
from drake_pose.search.sampled_body import SampledBody
from drake_pose.search.self_motions import counter_turns, flips
from drake_pose.search.settings import TOLERANT_STAGES, BeamSearchSettings
from drake_pose.search.views_fit import (
    FittedPose,
    RobustFamilies,
    ViewsFit,
    distinct,
    refine_best,
)
from drake_pose.silhouette.areas.outline import Outline
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.workers import map_ordered

# Connected pixels, or holes, no larger than this are specks [pixel].
_SPECK = 6
# Masks are left alone whose specks have a smaller share of the silhouette's area.
_SPECKLED = 0.02
_WINDOW = 5

COARSE = (AnnealingStage(0.1, 0.04, 3), AnnealingStage(0.05, 0.04, 3))
MEDIUM = (AnnealingStage(0.05, 0.026, 4), AnnealingStage(0.025, 0.026, 4))
FINAL = (AnnealingStage(0.0125, 0.0125, 6),)
# How many coarse poses are fitted, and how many are fitted to the end.
_STARTS, _FINALISTS = 40, 4
# How many go on after which stages, in one view and in several; and in several of what is sought
# about a pose. In these what is wrong costs more from the first stage on, in one view it may be the
# last that tells: there none ends after a first stage.
_PASSES = (
    ((COARSE, 12), (MEDIUM, 12)),
    ((COARSE[:1], 20), (COARSE[1:], 12), (MEDIUM[:1], 6), (MEDIUM[1:], 6)),
)
_FOLLOWING = ((MEDIUM[:1], 4), (MEDIUM[1:], 4))
# Coarse poses differ where some part of the body is seen so far away, as a share of the root of the
# silhouettes' mean area.
_APART = 0.13
# About how many of the best poses others are sought; of each so many are fitted, and so many more
# that are made by flips of its joints.
_SOUGHT_ABOUT, _TRIED, _FLIPPED = 3, 6, 3
# How often other explanations are sought about the best poses; of several views about no more of
# them where one leads to nothing that costs less by this factor.
_ROUNDS, _BETTER = 2, 0.98
# A disc of this radius, as a share of the root of the silhouettes' mean area, is as thick as a
# limb that one view shows in part, or one of several in full: where one fits into what is wrong, so
# many starts of the beam search below are fitted, too, by the masks of so many views at most, each
# looked at with about so many pixels. One of its orders of nodes finds what the other misses.
_LIMBS, _BEAM_STARTS, _BEAM_VIEWS, _BEAM_PIXELS = (0.03, 0.04), 10, 2, 3000
_BEAM = BeamSearchSettings(
    interval=math.radians(20.0),
    length_interval=LENGTH_INTERVAL,
    stages=TOLERANT_STAGES,
)


class MultiStartSearch:
    """Matches silhouettes with a pose tree at continuous values, for so long a time [s] at most."""

    def __init__(self, tree: PoseTree, time_limit: float | None = None) -> None:
        self.tree = tree
        self._time_limit, self._alternatives = time_limit, True
        coarse = BeamSearchSettings(interval=INTERVAL, length_interval=LENGTH_INTERVAL)
        self._body = SampledBody(tree, coarse)
        self.sampled = self._body.sampled
        self._outlines = few_triangles(self.sampled.surfaces)
        self._kinematics = TreeKinematics(tree)

    @cached_property
    def _rough(self) -> tuple[Outline, ...]:
        return rough_outlines(self._outlines)

    @cached_property
    def _beam(self) -> BeamSearch:
        return BeamSearch(self.tree, _BEAM)

    def without_alternatives(self) -> MultiStartSearch:
        """The same search where only E_total is wanted: one round, and no set of poses."""
        other = copy.copy(self)
        other._alternatives = False
        return other

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose that the views show; see ``PoseSearch``.

        Returns:
            The best pose found. ``stopped_by`` is "end" if all was tried, or "time_limit".

        Raises:
            SettingsError: if there is no view.
        """
        if not views:
            raise SettingsError("a match needs at least one view, but none was given")
        start = time.perf_counter()
        body, fit, clean = self._fit(views, root_position)
        deadline = np.inf if self._time_limit is None else start + self._time_limit
        beam_starts = partial(self._beam_starts, root_position, deadline)
        run = _Run(body, fit, clean, views, deadline, beam_starts)
        result = run.search(_ROUNDS if self._alternatives else 0, self._alternatives)
        return replace(result, seconds=time.perf_counter() - start)

    def with_intervals(
        self,
        tracked: PoseEstimate,
        views: Sequence[View],
        root_position: np.ndarray | None = None,
        begun: PoseEstimate | None = None,
    ) -> PoseEstimate:
        """A pose that was tracked, with what its silhouettes say of each joint; no other is sought.

        As sure as if each instant stood alone: what masks and cameras err by stays from one to the
        next, so that many of them tell little more.

        Args:
            begun: the answer that the track began with. Where it had several families, they move
                along: a joint that it left open stays open.
        """
        _, fit, _ = self._fit(views, root_position)
        values = self._kinematics.flatten(tracked.node_values)
        found = RobustFamilies(fit, lambda: True).around(values, tracked.J)
        return replace(tracked, pose_set=found).widened(begun)

    def _beam_starts(
        self, root_position: np.ndarray | None, deadline: float, views: Sequence[View]
    ) -> list[np.ndarray]:
        """Values (m,) of other starts, by areas."""
        limit = max(0.0, deadline - time.perf_counter())
        views = [coarsen(view, _BEAM_PIXELS) for view in views]
        found = self._beam.best_poses(views, root_position, _BEAM_STARTS, time_limit=limit)
        return [self._kinematics.flatten(values) for values in found]

    def _fit(
        self, views: Sequence[View], root_position: np.ndarray | None
    ) -> tuple[SampledBody, ViewsFit, list[View]]:
        """The body with its root where it is, its fit, and the views without specks."""
        clean = [View(view.camera, without_specks(view.mask)) for view in views]
        body, kinematics = self._body, self._kinematics
        if root_position is not None:
            body = body.with_root_position(root_position)
            kinematics = TreeKinematics(body.sampled.tree)
        # In one view women and men are fitted worse with them.
        rough = self._rough if len(clean) > 1 else None
        return body, ViewsFit(kinematics, self._outlines, clean, rough), clean


class _Run:
    """One match of a body, sampled roughly, with clean silhouettes, until a deadline.

    Answers are judged by the silhouettes as they were given.
    """

    def __init__(
        self,
        body: SampledBody,
        fit: ViewsFit,
        clean: Sequence[View],
        views: Sequence[View],
        deadline: float,
        beam_starts: Callable[[Sequence[View]], list[np.ndarray]],
    ) -> None:
        self._body, self._fit, self._kinematics = body, fit, fit.kinematics
        self._views, self._deadline, self._stopped_by = views, deadline, "end"
        self._clean, self._beam_starts = clean, beam_starts
        self._several = len(clean) > 1
        self._passes = _PASSES[self._several]
        self._survivors = self._passes[-1][1]
        self._done: list[np.ndarray] = []
        self._coarse = CoarseSearch(body, clean, HYPOTHESES if self._proceed() else 1)

    def search(self, rounds: int, as_set: bool) -> PoseEstimate:
        """Find coarse poses, refine them, seek other explanations, and refine to the end."""
        starts = self._coarse.choose_distinct(self._coarse.find(), _STARTS, _APART)
        pool = refine_best(self._fit, self._values(starts), self._passes, self._proceed)
        first_J = self._J(pool[0].values)
        pool = self._explore(pool, rounds)
        refined = self._finish(pool)
        contradicting = self._contradicting(refined[0].values)
        if contradicting and self._proceed():
            by_areas = self._beam_starts(contradicting[:_BEAM_VIEWS])
            others = refine_best(self._fit, by_areas, self._passes, self._proceed)
            pool = distinct([*pool, *others], self._survivors, self._kinematics.turns_around)
            refined += self._finish(self._explore(pool, min(1, rounds)))
            refined = distinct(refined, _FINALISTS, self._kinematics.turns_around)
        poses = [
            replace(pose, values=self._kinematics.nearest_turns(pose.values)) for pose in refined
        ]
        # Before the families, whose evaluations are not the search's.
        statistics, pose_set = SearchStatistics(self._fit.evaluations, first_J), None
        if as_set:
            pose_set = RobustFamilies(self._fit, self._proceed).find(poses, self._J)
        return PoseEstimate.of_values(
            self._kinematics.tree,
            self._kinematics.split(poses[0].values),
            self._J(poses[0].values),
            float(sum(np.count_nonzero(view.mask) for view in self._views)),
            stopped_by=self._stopped_by,
            statistics=statistics,
            pose_set=pose_set,
        )

    def _explore(self, pool: list[FittedPose], rounds: int) -> list[FittedPose]:
        """The best poses, with other explanations sought about them in some rounds."""
        for _ in range(rounds):
            found = []
            for pose in pool[:_SOUGHT_ABOUT]:
                if any(pose.values is values for values in self._done) or not self._proceed():
                    continue
                self._done.append(pose.values)
                others = self._others(pose.values)
                found += others
                least = min((one.cost for one in others), default=math.inf)
                if self._several and least > _BETTER * pool[0].cost:
                    break
            pool = distinct([*pool, *found], self._survivors, self._kinematics.turns_around)
        return pool

    def _finish(self, pool: Sequence[FittedPose]) -> list[FittedPose]:
        """The best poses, refined to the end."""
        values = [pose.values for pose in pool[:_FINALISTS]]
        return refine_best(self._fit, values, [(FINAL, _FINALISTS)], self._proceed)

    def _contradicting(self, values: np.ndarray) -> list[View]:
        """The views, worst first, where a disc as thick as a limb fits into what is wrong at (m,).

        Of several views half at least show where a limb is and should not be, and half where it is
        not; in a single one other parts may hide either. What masks lack, or have besides, is not
        mended by another start: then there is none.
        """
        share = _LIMBS[self._several]
        radius, thick, wrongs = max(1.0, share * self._fit.size), np.zeros(2, dtype=np.int64), []
        for mask, view in self._drawn(values, self._clean):
            for side, wrong in enumerate((mask & ~view.mask, view.mask & ~mask)):
                distances = cv2.distanceTransform(wrong.astype(np.uint8), cv2.DIST_L2, 5)
                thick[side] += distances.max() > radius
            wrongs.append(np.count_nonzero(mask != view.mask))
        half = 2 * thick >= len(self._clean)
        is_wrong = half.all() if self._several else thick.any()
        return [self._clean[k] for k in np.argsort(wrongs)[::-1]] if is_wrong else []

    def _proceed(self) -> bool:
        if time.perf_counter() < self._deadline:
            return True
        self._stopped_by = "time_limit"
        return False

    def _others(self, values: np.ndarray) -> list[FittedPose]:
        """Other explanations near a pose, refined."""
        kinematics = self._kinematics
        flipped = [flip.values for flip in flips(kinematics, values)]
        tried = counter_turns(kinematics, values, INTERVAL)
        X_WN = kinematics.poses(values)
        # The subtrees of no more than half of the nodes, which follow no node before them.
        tree = kinematics.tree
        below = [one for one in tree.subtrees if tree.source(one[0]) == one[0]]

        def search_again(nodes: tuple[int, ...]) -> list[np.ndarray]:
            again = self._coarse.find_again(X_WN, nodes)
            return self._values(self._coarse.choose_distinct(again, _TRIED, _APART), values)

        limbs = [one for one in below if 2 * len(one) <= len(X_WN)]
        tried += itertools.chain.from_iterable(map_ordered(search_again, limbs))
        look = AnnealingStage(MEDIUM[0].scale, COARSE[0].spacing)
        best_looks = []
        for group, count in ((flipped, _FLIPPED), (tried, _TRIED)):
            costs = map_ordered(lambda one: self._fit.cost(one, look), group)
            looks = [FittedPose(*pair) for pair in zip(group, costs, strict=True)]
            best_looks += distinct(looks, count, kinematics.turns_around, 0.5 * INTERVAL)
        if not self._several:
            refined = map_ordered(self._follow, best_looks)
            return [one for one in refined if one is not None]
        followed = [one.values for one in best_looks]
        return refine_best(self._fit, followed, _FOLLOWING, self._proceed)

    def _follow(self, look: FittedPose) -> FittedPose | None:
        return self._fit.refine(look.values, MEDIUM) if self._proceed() else None

    def _values(self, coarse: CoarsePoses, values: np.ndarray | None = None) -> list[np.ndarray]:
        """All values (m,) of coarse poses; those of nodes not searched are taken from values."""
        grids = self._body.sampled.values
        base = np.zeros(len(self._kinematics.names)) if values is None else values
        found = []
        for samples in coarse.samples:
            parts = list(self._kinematics.split(base.copy()))
            for node, sample in enumerate(samples):
                if sample >= 0:
                    parts[node] = grids[node][sample]
            found.append(self._kinematics.flatten(parts))
        return found

    def _J(self, values: np.ndarray) -> float:
        """The objective (1) at values (m,), skin included [pixel]."""
        return float(
            sum(
                np.count_nonzero(mask != view.mask)
                for mask, view in self._drawn(values, self._views)
            )
        )

    def _drawn(
        self, values: np.ndarray, views: Sequence[View]
    ) -> Iterator[tuple[np.ndarray, View]]:
        """The body's masks (H, W), skin included, at values (m,), each with its view."""
        outlines = self._body.sampled.surfaces.at(self._kinematics.split(values))
        X_WN = self._kinematics.poses(values)
        for view in views:
            yield draw_mask(outlines, view.camera.X_CW @ X_WN, view.camera), view


def without_specks(mask: np.ndarray) -> np.ndarray:
    """A mask (H, W) without salt and pepper noise, not emptied; with few specks it stays as it is.

    A median over 5 x 5 pixels takes specks away, but also what is thinner than three pixels, so it
    is only used where specks are many.
    """
    inside = mask.astype(np.uint8)
    left, top, width, height = cv2.boundingRect(inside)
    # Around this window, which is wider than a speck, there are none.
    window = inside[max(0, top - _SPECK - 1) : top + height + _SPECK + 1]
    window = window[:, max(0, left - _SPECK - 1) : left + width + _SPECK + 1]
    specks = sum(_speck_area(side) for side in (window, 1 - window))
    if specks <= _SPECKLED * np.count_nonzero(mask):
        return mask
    cleaned = cv2.medianBlur(inside, _WINDOW) > 0
    return cleaned if cleaned.any() else mask


def _speck_area(inside: np.ndarray) -> int:
    """The area of all small connected parts of a mask [pixel]."""
    _, _, statistics, _ = cv2.connectedComponentsWithStats(inside, connectivity=4)
    areas = statistics[1:, cv2.CC_STAT_AREA]
    return int(areas[areas <= _SPECK].sum())
