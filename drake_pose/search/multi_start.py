"""Multi-start search: from silhouettes, also damaged or ill fitting, to continuous positions.

Poses that are roughly right are found by places (``coarse_search``) and drawn to the silhouettes'
edges by saturating costs (``fit``). Where the best of them meets most of the masks' border to the
pixel, masks are exact and searched by pixels (``exact_search``): a pose that leaves hardly a pixel
wrong ends the search. Otherwise other explanations are sought about the best poses: a limb searched
again, joints that turn against each other (``self_motions``). Where a piece as thick as a limb is
left unexplained, a beam search by areas gives other starts.
"""

import copy
import functools
import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np

from drake_pose.body import PoseTree, bundled_model, load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import ParallelCamera
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import simplify_outlines, simplify_surfaces
from drake_pose.search.beam_search import BeamSearch
from drake_pose.search.coarse_search import CoarsePoses, CoarseSearch
from drake_pose.search.estimates import PoseEstimate, View, require_views
from drake_pose.search.exact_search import ExactPose, ExactSearch
from drake_pose.search.partial_poses import coarsen
from drake_pose.search.refinement import RefinementProblem
from drake_pose.search.sampled_body import SampledBody
from drake_pose.search.self_motions import counter_turns, flips
from drake_pose.search.settings import (
    TOLERANT_STAGES,
    BeamSearchSettings,
    ExactSearchSettings,
    MultiStartSettings,
)
from drake_pose.search.views_fit import FittedPose, RobustModes, ViewsFit, distinct, refine_best
from drake_pose.silhouette.outline import Outline
from drake_pose.workers import map_ordered


class MultiStartSearch:
    """Matches silhouettes with a pose tree at continuous values.

    Args:
        time_limit: of a match [s]; None: none.
        exact_masks: whether masks are known to be exact, as Drake's label images are. Else a fitted
            pose tells; where it is far off, exact masks may be taken for damaged ones.
    """

    def __init__(
        self, tree: PoseTree, time_limit: float | None = None, *, exact_masks: bool = False
    ) -> None:
        self.tree, self.exact_masks = tree, exact_masks
        self.settings, self.exact_settings = MultiStartSettings(), ExactSearchSettings()
        self._time_limit, self._alternatives = time_limit, True
        self._grid = BeamSearch(tree, BeamSearchSettings(interval=self.settings.interval))
        self._body = self._grid.body
        self.sampled = self._body.sampled
        self._outlines = simplify_surfaces(self.sampled.surfaces)
        self._kinematics = TreeKinematics(tree)

    @cached_property
    def _rough(self) -> tuple[Outline, ...]:
        return simplify_outlines(self._outlines)

    @cached_property
    def beam(self) -> BeamSearch:
        """The search by areas that gives other starts."""
        return BeamSearch(self.tree, BeamSearchSettings(stages=TOLERANT_STAGES))

    @cached_property
    def exact(self) -> ExactSearch:
        """The search where masks are exact."""
        return ExactSearch((self.beam, self._grid), self.exact_settings)

    def without_alternatives(self) -> "MultiStartSearch":
        """The same search where only E_total is wanted: one round, and no set of poses."""
        other = copy.copy(self)
        other._alternatives = False
        return other

    def with_time_limit(self, seconds: float) -> "MultiStartSearch":
        """The same search with a limit on the time of a match [s], or with its own if shorter."""
        other = copy.copy(self)
        other._time_limit = min(
            seconds, math.inf if other._time_limit is None else other._time_limit
        )
        return other

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose that the views show; see ``PoseSearch``.

        Returns:
            The best pose found. ``stopped_by`` is "end" if all was tried, or "time_limit".

        Raises:
            SettingsError: if there is no view.
        """
        require_views(views)
        if self._time_limit is not None:
            warm_up()
        start = time.perf_counter()
        body, fit, clean = self._fit(views, root_position)
        deadline = np.inf if self._time_limit is None else start + self._time_limit
        run = _MultiStartRun(self, body, fit, clean, views, root_position, deadline)
        result = run.search(self.settings.rounds if self._alternatives else 0, self._alternatives)
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
            begun: the answer that the track began with. Where it had several modes, they move
                along: a joint that it left open stays open.
        """
        _, fit, _ = self._fit(views, root_position)
        values = self._kinematics.flatten(tracked.node_values)
        found = RobustModes(fit, lambda: True).around(values, tracked.J)
        return replace(tracked, pose_set=found).widened(begun)

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


class _MultiStartRun:
    """One match of a body, sampled roughly, with clean silhouettes, until a deadline.

    Answers are judged by the silhouettes as they were given.
    """

    def __init__(
        self,
        search: MultiStartSearch,
        body: SampledBody,
        fit: ViewsFit,
        clean: Sequence[View],
        views: Sequence[View],
        root_position: np.ndarray | None,
        deadline: float,
    ) -> None:
        self._search, self._body, self._fit, self._kinematics = search, body, fit, fit.kinematics
        self._root_position, self._deadline, self._stopped_by = root_position, deadline, "end"
        self._problem = self._clean = RefinementProblem(search.exact.body, views)
        if any(one.mask is not view.mask for one, view in zip(clean, views, strict=True)):
            self._clean = RefinementProblem(search.exact.body, clean)
        self._several = len(clean) > 1
        own = self._settings = search.settings
        self._passes = own.passes[self._several]
        self._survivors = self._passes[-1][1]
        self._done: list[np.ndarray] = []

    def search(self, rounds: int, as_set: bool) -> PoseEstimate:
        """Look for a pose by pixels, else for a robust one, and for all that are as good."""
        tree, exact, own = self._kinematics.tree, self._search.exact, self._search.exact_settings
        problem, found, poses = self._problem, None, list[FittedPose]()
        exactly = own.exact * problem.border_length
        pool = self._begin()
        first_J = self._J(pool[0].values)
        searched = self._looks_exact(pool[0].values)
        if searched:
            found = exact.find(problem, self._root_position, self._deadline)
        if found is None or found.J > exactly:
            poses = self._search_robustly(pool, rounds)
            looks_exact = self._looks_exact(poses[0].values)
            if looks_exact and not searched:
                found = exact.find(problem, self._root_position, self._deadline)
            if looks_exact and (found is None or found.J > exactly):
                found = self._refine_by_pixels(found, poses[0].values)
        begin, pose_set = time.perf_counter(), None
        # Before the modes, whose evaluations are not the search's.
        steps = self._fit.evaluations
        if found is not None and found.J <= exactly:
            if as_set:
                found, pose_set = exact.modes(problem, found, tree)
            values = found.parameters[:-4]
            steps += found.steps
        else:
            if found is not None:
                by_pixels = self._kinematics.nearest_turns(found.parameters[:-4])
                poses = distinct([FittedPose(by_pixels, -math.inf), *poses], len(poses))
            values = poses[0].values
            if as_set:
                pose_set = RobustModes(self._fit, self._proceed).find(poses, self._J)
        seconds = time.perf_counter() - begin
        return PoseEstimate.of_values(
            tree,
            self._kinematics.split(values),
            self._J(values),
            problem.area,
            stopped_by=self._stopped_by,
            runs=steps,
            first_J=first_J,
            interval_seconds=seconds,
            pose_set=pose_set,
        )

    def _refine_by_pixels(self, found: ExactPose | None, values: np.ndarray) -> ExactPose | None:
        """The better of a pose and values (m,) improved by pixels, if it explains the masks.

        None where neither does, or the values fit better as they are.
        """
        exact, own, J = self._search.exact, self._search.exact_settings, self._J(values)
        length = self._problem.border_length
        if self._proceed():
            other = exact.refine(self._problem, self._parameters(values), self._deadline)
            found = min((one for one in (found, other) if one), key=lambda one: one.J)
        explained = found is not None and found.J < min(J, own.plausible * length)
        return found if explained else None

    def _begin(self) -> list[FittedPose]:
        """The coarse search's poses, refined but not to the end, best first."""
        own = self._settings
        self._coarse = CoarseSearch(self._body, self._clean.views, None if self._proceed() else 1)
        starts = self._coarse.choose_distinct(self._coarse.find(), own.starts, own.separation)
        return refine_best(self._fit, self._values(starts), self._passes, self._proceed)

    def _looks_exact(self, values: np.ndarray) -> bool:
        """Whether masks may be exact: much of their border is that of the body at values (m,)."""
        # What specks hide is not exact.
        if self._clean is not self._problem or not self._proceed():
            return False
        if self._search.exact_masks:
            return True
        wrong, kernel = self._problem.mismatch(self._parameters(values)), np.ones((3, 3), np.uint8)
        met = length = 0
        for off, view in zip(wrong, self._problem.views, strict=True):
            borders = []
            for area in (view.mask, view.mask ^ off):
                inside = area.astype(np.uint8)
                borders.append((inside > 0) & (cv2.erode(inside, kernel) == 0))
            met += int(np.count_nonzero(borders[0] & borders[1]))
            length += int(np.count_nonzero(borders[0]))
        return met >= self._search.exact_settings.coinciding * length

    def _search_robustly(self, pool: list[FittedPose], rounds: int) -> list[FittedPose]:
        """The best poses by robust costs, from some that are not refined to the end."""
        own, turns = self._settings, self._kinematics.turns_around
        pool = self._explore(pool, rounds)
        refined = self._finish(pool)
        contradicting = self._contradicting(refined[0].values)
        if contradicting and self._proceed():
            left = max(0.0, self._deadline - time.perf_counter())
            views = [coarsen(view, own.beam_pixels) for view in contradicting[: own.beam_views]]
            by_areas = self._search.beam.best_poses(
                views, self._root_position, own.beam_starts, time_limit=left
            )
            values = [self._kinematics.flatten(one) for one in by_areas]
            others = refine_best(self._fit, values, self._passes, self._proceed)
            pool = distinct([*pool, *others], self._survivors, turns)
            refined += self._finish(self._explore(pool, min(1, rounds)))
            refined = distinct(refined, own.finalists, turns)
        return [
            pose._replace(values=self._kinematics.nearest_turns(pose.values)) for pose in refined
        ]

    def _explore(self, pool: list[FittedPose], rounds: int) -> list[FittedPose]:
        """The best poses, with other explanations sought about them in some rounds."""
        own = self._settings
        for _ in range(rounds):
            found = []
            for pose in pool[: own.explored]:
                if any(pose.values is values for values in self._done) or not self._proceed():
                    continue
                self._done.append(pose.values)
                others = self._others(pose.values)
                found += others
                least = min((one.cost for one in others), default=math.inf)
                if self._several and least > own.improvement * pool[0].cost:
                    break
            pool = distinct([*pool, *found], self._survivors, self._kinematics.turns_around)
        return pool

    def _finish(self, pool: Sequence[FittedPose]) -> list[FittedPose]:
        """The best poses, refined to the end."""
        own = self._settings
        values = [pose.values for pose in pool[: own.finalists]]
        return refine_best(self._fit, values, [(own.final, own.finalists)], self._proceed)

    def _contradicting(self, values: np.ndarray) -> list[View]:
        """The views, worst first, where a disc as thick as a limb fits into what is wrong at (m,).

        Of several views half at least show where a limb is and should not be, and half where it is
        not; in a single one other parts may hide either. What masks lack, or have besides, is not
        mended by another start: then there is none.
        """
        share = self._settings.limb_radii[self._several]
        radius, thick, wrongs = max(1.0, share * self._fit.size), np.zeros(2, dtype=np.int64), []
        views = self._clean.views
        for wrong, view in zip(self._clean.mismatch(self._parameters(values)), views, strict=True):
            for side, one in enumerate((wrong & ~view.mask, wrong & view.mask)):
                distances = cv2.distanceTransform(one.astype(np.uint8), cv2.DIST_L2, 5)
                thick[side] += distances.max() > radius
            wrongs.append(np.count_nonzero(wrong))
        half = 2 * thick >= len(views)
        is_wrong = half.all() if self._several else thick.any()
        return [views[k] for k in np.argsort(wrongs)[::-1]] if is_wrong else []

    def _proceed(self) -> bool:
        if time.perf_counter() < self._deadline:
            return True
        self._stopped_by = "time_limit"
        return False

    def _others(self, values: np.ndarray) -> list[FittedPose]:
        """Other explanations near a pose, refined."""
        kinematics, own = self._kinematics, self._settings
        flipped = [flip.values for flip in flips(kinematics, values)]
        tried = counter_turns(kinematics, values, own.interval)
        X_WN = kinematics.poses(values)
        # The subtrees of no more than half of the nodes, which follow no node before them.
        tree = kinematics.tree
        below = [one for one in tree.subtrees if tree.source(one[0]) == one[0]]

        def search_again(nodes: tuple[int, ...]) -> list[np.ndarray]:
            again = self._coarse.find_again(X_WN, nodes)
            return self._values(
                self._coarse.choose_distinct(again, own.alternatives, own.separation), values
            )

        limbs = [one for one in below if 2 * len(one) <= len(X_WN)]
        tried += itertools.chain.from_iterable(map_ordered(search_again, limbs))
        look = AnnealingStage(own.medium[0].scale, own.coarse[0].spacing)
        best_looks = []
        for group, count in ((flipped, own.flipped), (tried, own.alternatives)):
            costs = map_ordered(lambda one: self._fit.cost(one, look), group)
            looks = [FittedPose(*pair) for pair in zip(group, costs, strict=True)]
            best_looks += distinct(looks, count, kinematics.turns_around, 0.5 * own.interval)
        followed = [one.values for one in best_looks]
        if self._several:
            return refine_best(self._fit, followed, own.alternative_passes, self._proceed)

        def follow(one: np.ndarray) -> FittedPose | None:
            return self._fit.refine(one, own.medium) if self._proceed() else None

        return [one for one in map_ordered(follow, followed) if one is not None]

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

    def _parameters(self, values: np.ndarray) -> np.ndarray:
        """The parameters (m + 4,) of a refinement by pixels at values (m,)."""
        own = self._kinematics.split(values)
        return self._search.exact.body.parameters(own, self._root_position)

    def _J(self, values: np.ndarray) -> float:
        """The objective (1) at values (m,), skin included [pixel]."""
        return float(self._problem.J(self._parameters(values)))


def small_match() -> tuple[PoseTree, View]:
    """A small body and picture, by which kernels are compiled."""
    tree = load_model(bundled_model("two_finger_hand"), check=False).pose_tree()
    camera = ParallelCamera("warm-up", 64, 64, 300.0, 32.0, 32.0, np.eye(4))
    return tree, View(camera, cv2.circle(np.zeros((64, 64), np.uint8), (32, 32), 16, 1, -1) > 0)


@functools.cache
def warm_up() -> None:
    """Compile or load a search's kernels, by a match of a small body: not in a match's time."""
    tree, view = small_match()
    MultiStartSearch(tree).match([view])


def without_specks(mask: np.ndarray, largest: int = 6, least: float = 0.02) -> np.ndarray:
    """A mask (H, W) without salt and pepper noise, not emptied; with few specks it stays as it is.

    A median over 5 x 5 pixels takes specks away, but also what is thinner than three pixels, so it
    is only used where specks are many.

    Args:
        largest: connected pixels, or holes, no larger than this are specks [pixel].
        least: masks are left alone whose specks have a smaller share of the silhouette's area.
    """
    inside = mask.astype(np.uint8)
    left, top, width, height = cv2.boundingRect(inside)
    # Around this window, which is wider than a speck, there are none.
    window = inside[max(0, top - largest - 1) : top + height + largest + 1]
    window = window[:, max(0, left - largest - 1) : left + width + largest + 1]
    specks = 0
    for side in (window, 1 - window):
        _, _, statistics, _ = cv2.connectedComponentsWithStats(side, connectivity=4)
        areas = statistics[1:, cv2.CC_STAT_AREA]
        specks += int(areas[areas <= largest].sum())
    if specks <= least * np.count_nonzero(mask):
        return mask
    cleaned = cv2.medianBlur(inside, 5) > 0
    return cleaned if cleaned.any() else mask
