"""Estimate continuous joint positions from silhouettes by a multi-start search.

1. ``coarse_search`` finds approximate poses on a grid, and the robust fit (``views_fit``) refines
   the best of them. Masks may be damaged, and the model may fit only approximately.
2. If the border of the best pose coincides with most of the masks' border, the masks may be exact:
   ``exact_search`` refines poses by pixels. A pose that leaves hardly a pixel wrong is the answer.
   Where masks are known to be exact, this comes first.
3. Otherwise alternative poses around the best ones are tried: limbs searched again, and
   ``self_motions``. If a wrong region as thick as a limb remains, the poses of a beam search are
   further starts.
4. Modes and intervals of the joints are computed (``RobustModes``, or ``find_intervals`` for exact
   masks).
"""

import copy
import functools
import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from drake_pose.body import PoseTree, bundled_model, load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import ParallelCamera
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import simplify_outlines, simplify_surfaces
from drake_pose.search.beam_search import BeamSearch, BeamSearchSettings
from drake_pose.search.coarse_search import CoarsePoses, CoarseSearch
from drake_pose.search.estimates import PoseEstimate, View, require_views
from drake_pose.search.exact_search import ExactPose, ExactSearch
from drake_pose.search.partial_poses import coarsen
from drake_pose.search.refinement import RefinementProblem
from drake_pose.search.sampled_body import SampledBody
from drake_pose.search.self_motions import counter_turns, flips
from drake_pose.search.views_fit import FittedPose, RobustModes, ViewsFit, distinct, refine_best
from drake_pose.silhouette.outline import Outline
from drake_pose.workers import map_ordered

COARSE_STAGES = (AnnealingStage(0.1, 0.04, 3), AnnealingStage(0.05, 0.04, 3))
MEDIUM_STAGES = (AnnealingStage(0.05, 0.026, 4), AnnealingStage(0.025, 0.026, 4))


@dataclass(frozen=True)
class MultiStartSettings:
    """Parameters of the search in damaged masks.

    Lengths are fractions of the size: the square root of the silhouettes' mean area.
    In several views the cost of a wrong pose is higher from the first stage on, so starts are
    dropped early. In a single view the last stage may decide.
    """

    interval: float = math.radians(15.0)  # Sampling interval of angles in the coarse search [rad].
    final: tuple[AnnealingStage, ...] = (AnnealingStage(0.0125, 0.0125, 6),)
    starts: int = 40  # Number of coarse poses that are fitted.
    finalists: int = 4  # Number of poses that are fitted to the end.
    # Stages, and the number of poses kept after them: in one view, and in several.
    passes: tuple[tuple[tuple[tuple[AnnealingStage, ...], int], ...], ...] = (
        ((COARSE_STAGES, 12), (MEDIUM_STAGES, 12)),
        (
            (COARSE_STAGES[:1], 20),
            (COARSE_STAGES[1:], 12),
            (MEDIUM_STAGES[:1], 6),
            (MEDIUM_STAGES[1:], 6),
        ),
    )
    # Stages of alternative poses in several views, and the number kept after them.
    alternative_passes: tuple[tuple[tuple[AnnealingStage, ...], int], ...] = (
        (MEDIUM_STAGES[:1], 4),
        (MEDIUM_STAGES[1:], 4),
    )
    # Coarse poses differ if some node's image is at least this far away.
    separation: float = 0.13
    rounds: int = 2  # Rounds of the search for alternative poses,
    explored: int = 3  # number of poses around which alternatives are searched in a round,
    alternatives: int = 6  # and number of flipped and of other alternatives that are fitted.
    # Radius of a disc as thick as a limb, in one and in several views.
    limb_radii: tuple[float, float] = (0.03, 0.04)
    beam_starts: int = 10  # If a wrong region holds such a disc: number of poses of a beam search,
    beam_views: int = 2  # number of views that it uses,
    beam_pixels: int = 3000  # and area of their silhouettes [pixel].


class MultiStartSearch:
    """Estimates poses with continuous values by a multi-start search.

    ``tree``: the pose tree whose values are searched. ``time_limit``: greatest time of a match [s];
    None: no limit. ``exact_masks``: whether masks are known to be exact, like Drake's label images.
    If not, this is decided by a fitted pose; if that pose is wrong, exact masks may be taken for
    damaged ones.
    """

    def __init__(
        self, tree: PoseTree, time_limit: float | None = None, *, exact_masks: bool = False
    ) -> None:
        self.tree, self.exact_masks = tree, exact_masks
        self.settings = MultiStartSettings()
        self._time_limit, self._alternatives = time_limit, True
        self._grid = BeamSearch(tree, BeamSearchSettings(interval=self.settings.interval))
        self._body = self._grid.body
        self.sampled = self._body.sampled
        self._outlines = simplify_surfaces(self.sampled.surfaces)
        self._kinematics = TreeKinematics(tree)

    @cached_property
    def _rough(self) -> tuple[Outline, ...]:
        """The surface of each node with few triangles, for stages of large spacing."""
        return simplify_outlines(self._outlines)

    @cached_property
    def beam(self) -> BeamSearch:
        """The beam search that gives further starts."""
        return BeamSearch(self.tree)

    @cached_property
    def exact(self) -> ExactSearch:
        """The search in exact masks."""
        return ExactSearch((self.beam, self._grid))

    def without_alternatives(self) -> "MultiStartSearch":
        """Return the same search without alternative poses and without a pose set."""
        other = copy.copy(self)
        other._alternatives = False
        return other

    def with_time_limit(self, seconds: float) -> "MultiStartSearch":
        """Return the same search with a time limit of a match [s]; a shorter own limit is kept."""
        other = copy.copy(self)
        limits = [one for one in (seconds, self._time_limit) if one is not None]
        other._time_limit = min(limits)
        return other

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose that the views show.

        ``views``: the silhouettes, one per camera. ``root_position``: (3,) the root's position in
        the world [m]; None: that of the tree.

        Returns the best pose found; ``stopped_by`` is "end" or "time_limit".

        Raises SettingsError: if there is no view.
        """
        require_views(views)
        if self._time_limit is not None:
            warm_up()
        start = time.perf_counter()
        deadline = np.inf if self._time_limit is None else start + self._time_limit
        result = self._search(views, root_position, deadline)
        cut, misfit = [one.cut() for one in views], self.exact.settings.misfit
        # A pose that ends where a mask is cut is one of several, unless all pixels agree with it.
        if result.stopped_by == "end" and cut != list(views):
            whole, seen = (RefinementProblem(self.exact.body, some) for some in (views, cut))
            if result.J > misfit * whole.border_length:
                values = self._kinematics.flatten(result.node_values)
                other = self._search(cut, root_position, deadline, [values])
                J = float(seen.J(self.exact.body.parameters(result.node_values, root_position)))
                noise = misfit * seen.border_length
                is_better = other.J <= max(noise, J - noise)
                result = other if is_better else result.united(other)
        return replace(result, seconds=time.perf_counter() - start)

    def _search(
        self,
        views: Sequence[View],
        root_position: np.ndarray | None,
        deadline: float,
        known: Sequence[np.ndarray] = (),
    ) -> PoseEstimate:
        """Return the best pose found until ``deadline`` (perf_counter); as ``match``.

        ``known``: values (m,) of further starts.
        """
        body, fit, clean = self._fit(views, root_position)
        run = _MultiStartRun(self, body, fit, clean, views, root_position, deadline, known)
        return run.search(self.settings.rounds if self._alternatives else 0, self._alternatives)

    def with_intervals(
        self,
        tracked: PoseEstimate,
        views: Sequence[View],
        root_position: np.ndarray | None = None,
        first: PoseEstimate | None = None,
    ) -> PoseEstimate:
        """Return a tracked pose with the intervals of its joints; no alternative is searched.

        The intervals are those of a single frame: the errors of masks and cameras are similar in
        successive frames, so further frames add little information.

        Args:
            tracked: the pose.
            views: the silhouettes of its frame, one per camera.
            root_position: (3,) the root's position [m]; None: that of the tree.
            first: the pose with which the track began. If it has several modes, joints that are
                ambiguous in it stay ambiguous. None: the intervals are those of this frame alone.
        """
        _, fit, _ = self._fit(views, root_position)
        values = self._kinematics.flatten(tracked.node_values)
        found = RobustModes(fit, lambda: True).around(values, tracked.J)
        return replace(tracked, pose_set=found).widened(first)

    def _fit(
        self, views: Sequence[View], root_position: np.ndarray | None
    ) -> tuple[SampledBody, ViewsFit, list[View]]:
        """Return the body with its root in place, the fit, and the views without specks.

        ``root_position``: (3,) the root's position [m]; None: that of the tree.
        """
        clean = [View(view.camera, without_specks(view.mask)) for view in views]
        body, kinematics = self._body, self._kinematics
        if root_position is not None:
            body = body.with_root_position(root_position)
            kinematics = TreeKinematics(body.sampled.tree)
        # In a single view, poses of people are fitted worse with rough surfaces.
        rough = self._rough if len(clean) > 1 else None
        return body, ViewsFit(kinematics, self._outlines, clean, rough), clean


class _MultiStartRun:
    """One match.

    ``search``: the search, with its settings. ``body``: the sampled body with its root in place.
    ``fit``: the robust fit to the clean views. ``clean``: the views without specks. ``views``: the
    views as they were given; J is computed from these. ``root_position``: (3,) the root's position
    [m]; None: that of the tree. ``deadline``: time.perf_counter() at which the search ends [s].
    ``known``: values (m,) of further starts.
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
        known: Sequence[np.ndarray],
    ) -> None:
        self._known = known
        self._search, self._body, self._fit, self._kinematics = search, body, fit, fit.kinematics
        self._root_position, self._deadline, self._stopped_by = root_position, deadline, "end"
        self._problem = self._clean = RefinementProblem(search.exact.body, views)
        if any(one.mask is not view.mask for one, view in zip(clean, views, strict=True)):
            self._clean = RefinementProblem(search.exact.body, clean)
        self._several = len(clean) > 1
        settings = self._settings = search.settings
        self._passes = settings.passes[self._several]
        self._survivors = self._passes[-1][1]
        self._done: list[np.ndarray] = []

    def search(self, rounds: int, with_set: bool) -> PoseEstimate:
        """Search the pose, by pixels if the masks are exact, else by the robust fit.

        ``rounds``: number of rounds of the search for alternative poses. ``with_set``: whether the
        pose set is computed.
        """
        tree, exact = self._kinematics.tree, self._search.exact
        problem, first_J = self._problem, None
        pool, poses = list[FittedPose](), list[FittedPose]()
        exactly = exact.settings.exact * problem.border_length

        def find_exactly() -> ExactPose | None:
            return exact.find(problem, self._root_position, self._deadline)

        searched = self._search.exact_masks and self._clean is problem and self._proceed()
        found = find_exactly() if searched else None
        if found is None or found.J > exactly:
            pool = self._start()
            first_J = self._J(pool[0].values)
            if not searched and self._looks_exact(pool[0].values):
                searched, found = True, find_exactly()
        if found is None or found.J > exactly:
            poses = self._search_robustly(pool, rounds)
            looks_exact = self._looks_exact(poses[0].values)
            if looks_exact and not searched:
                found = find_exactly()
            if looks_exact and (found is None or found.J > exactly):
                # The pose by pixels must explain the masks better than the robust one as it is.
                start, J = poses[0].values, self._J(poses[0].values)
                if self._proceed():
                    other = exact.refine(problem, self._parameters(start), self._deadline)
                    found = min((one for one in (found, other) if one), key=lambda one: one.J)
                most = min(J, exact.settings.plausible * problem.border_length)
                found = found if found is not None and found.J < most else None
        begin, pose_set = time.perf_counter(), None
        # Evaluations for the pose set, which come later, are not counted.
        steps = self._fit.evaluations
        if found is not None and found.J <= exactly:
            if with_set:
                found, pose_set = exact.modes(problem, found, tree)
            values = found.parameters[:-4]
            steps += found.steps
            fits = found.J <= exact.settings.misfit * problem.border_length
            if with_set and not (fits or self._search.exact_masks):
                known = [FittedPose(values), *(pool or self._start())]
                pose_set = RobustModes(self._fit, self._proceed).find(known, self._J)
        else:
            if found is not None:
                by_pixels = self._kinematics.nearest_turns(found.parameters[:-4])
                poses = distinct([FittedPose(by_pixels, -math.inf), *poses], len(poses))
            values = poses[0].values
            if with_set:
                pose_set = RobustModes(self._fit, self._proceed).find(poses, self._J)
        seconds = time.perf_counter() - begin
        return PoseEstimate.of_values(
            tree, self._kinematics.split(values), self._J(values), problem.area,
            stopped_by=self._stopped_by, runs=steps, first_J=first_J, interval_seconds=seconds,
            pose_set=pose_set,
        )  # fmt: skip

    def _start(self) -> list[FittedPose]:
        """Return poses of the coarse search, refined by all stages but the final, best first."""
        settings, width = self._settings, None if self._proceed() else 1
        # The coarse search is kept for ``_alternatives_to``.
        self._coarse = CoarseSearch(self._body, self._clean.views, width)
        coarse = self._coarse.find()
        starts = self._coarse.choose_distinct(coarse, settings.starts, settings.separation)
        values = [*self._values(starts), *self._known]
        return refine_best(self._fit, values, self._passes, self._proceed)

    def _looks_exact(self, values: np.ndarray) -> bool:
        """Return whether masks may be exact: their border is the body's at ``values`` (m,)."""
        # Masks with many specks are not exact.
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
        return met >= self._search.exact.settings.coinciding * length

    def _search_robustly(self, pool: list[FittedPose], rounds: int) -> list[FittedPose]:
        """Return the best poses by robust costs, refined to the end, best first.

        ``pool``: poses refined by all stages but the final, best first. ``rounds``: number of
        rounds of the search for alternative poses.
        """
        settings, turns = self._settings, self._kinematics.covers_full_turn
        pool = self._explore(pool, rounds)
        refined = self._finish(pool)
        unexplained = self._unexplained_views(refined[0].values)
        if unexplained and self._proceed():
            left = max(0.0, self._deadline - time.perf_counter())
            views = [
                coarsen(view, settings.beam_pixels) for view in unexplained[: settings.beam_views]
            ]
            by_areas = self._search.beam.best_poses(
                views, self._root_position, settings.beam_starts, overlap=0.7, time_limit=left
            )
            values = [self._kinematics.flatten(one) for one in by_areas]
            others = refine_best(self._fit, values, self._passes, self._proceed)
            pool = distinct([*pool, *others], self._survivors, turns)
            refined += self._finish(self._explore(pool, min(1, rounds)))
            refined = distinct(refined, settings.finalists, turns)
        return [
            pose._replace(values=self._kinematics.nearest_turns(pose.values)) for pose in refined
        ]

    def _explore(self, pool: list[FittedPose], rounds: int) -> list[FittedPose]:
        """Return the best poses after ``rounds`` rounds of the search for alternatives to them.

        ``pool``: refined poses, best first. Poses whose alternatives have been searched before are
        skipped.
        """
        settings = self._settings
        for _ in range(rounds):
            found = []
            for pose in pool[: settings.explored]:
                if any(pose.values is values for values in self._done) or not self._proceed():
                    continue
                self._done.append(pose.values)
                others = self._alternatives_to(pose.values)
                found += others
                least = min((one.cost for one in others), default=math.inf)
                if self._several and least >= pool[0].cost:
                    break
            pool = distinct([*pool, *found], self._survivors, self._kinematics.covers_full_turn)
        return pool

    def _finish(self, pool: Sequence[FittedPose]) -> list[FittedPose]:
        """Return the best poses of ``pool``, refined by the final stage, best first."""
        settings = self._settings
        values = [pose.values for pose in pool[: settings.finalists]]
        return refine_best(self._fit, values, [(settings.final, settings.finalists)], self._proceed)

    def _unexplained_views(self, values: np.ndarray) -> list[View]:
        """Return all views, worst first, if a limb seems misplaced at values (m,), else none.

        A limb is misplaced if a disc as thick as a limb fits into the mismatch: in several views,
        outside the masks in at least half of them and inside in at least half. A defect of the
        masks has only one of these, and another start would not help. In a single view either
        suffices, since other parts may hide the second.
        """
        radius = max(1.0, self._settings.limb_radii[self._several] * self._fit.size)
        thick, areas = np.zeros(2, dtype=np.int64), []
        views = self._clean.views
        for wrong, view in zip(self._clean.mismatch(self._parameters(values)), views, strict=True):
            for side, one in enumerate((wrong & ~view.mask, wrong & view.mask)):
                distances = cv2.distanceTransform(one.astype(np.uint8), cv2.DIST_L2, 5)
                thick[side] += distances.max() > radius
            areas.append(np.count_nonzero(wrong))
        half = 2 * thick >= len(views)
        is_wrong = half.all() if self._several else thick.any()
        return [views[k] for k in np.argsort(areas)[::-1]] if is_wrong else []

    def _proceed(self) -> bool:
        """Return whether there is time left."""
        if time.perf_counter() < self._deadline:
            return True
        self._stopped_by = "time_limit"
        return False

    def _alternatives_to(self, values: np.ndarray) -> list[FittedPose]:
        """Return refined alternatives to values (m,): flips, counter-turns, limbs placed anew."""
        kinematics, settings = self._kinematics, self._settings
        flipped = [flip.values for flip in flips(kinematics, values)]
        tried = counter_turns(kinematics, values, settings.interval)
        X_WN = kinematics.poses(values)
        # Limbs are subtrees of at most half of the nodes whose joint does not mimic another.
        tree = kinematics.tree
        below = [one for one in tree.subtrees if tree.source(one[0]) == one[0]]

        def search_again(nodes: tuple[int, ...]) -> list[np.ndarray]:
            again = self._coarse.find_again(X_WN, nodes)
            most, apart = settings.alternatives, settings.separation
            return self._values(self._coarse.choose_distinct(again, most, apart), values)

        limbs = [one for one in below if 2 * len(one) <= len(X_WN)]
        tried += itertools.chain.from_iterable(map_ordered(search_again, limbs))
        stage = COARSE_STAGES[-1]
        best: list[FittedPose] = []
        for group in (flipped, tried):
            costs = map_ordered(lambda one: self._fit.cost(one, stage), group)
            scored = [FittedPose(*pair) for pair in zip(group, costs, strict=True)]
            best += distinct(
                scored, settings.alternatives, kinematics.covers_full_turn, 0.5 * settings.interval
            )
        starts = [one.values for one in best]
        if self._several:
            return refine_best(self._fit, starts, settings.alternative_passes, self._proceed)

        def refine(one: np.ndarray) -> FittedPose | None:
            return self._fit.refine(one, MEDIUM_STAGES) if self._proceed() else None

        return [one for one in map_ordered(refine, starts) if one is not None]

    def _values(self, coarse: CoarsePoses, values: np.ndarray | None = None) -> list[np.ndarray]:
        """Return the values (m,) of each coarse pose [rad or m].

        ``values``: (m,) of the whole tree, replaced for nodes that were searched; None: zeros.
        """
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
        """Return the parameters (m + 4,), as in ``RefinementBody``, at the tree's values (m,)."""
        own = self._kinematics.split(values)
        return self._search.exact.body.parameters(own, self._root_position)

    def _J(self, values: np.ndarray) -> float:
        """Return the objective J at the tree's values (m,), skin included [pixel]."""
        return float(self._problem.J(self._parameters(values)))


def small_match() -> tuple[PoseTree, View]:
    """Return a small body and a view, with which all kernels are compiled quickly."""
    tree = load_model(bundled_model("two_finger_hand"), check=False).pose_tree()
    half = 32
    mask = cv2.circle(np.zeros((2 * half, 2 * half), np.uint8), (half, half), half // 2, 1, -1) > 0
    camera = ParallelCamera("warm-up", 2 * half, 2 * half, 300.0, half, half, np.eye(4))
    return tree, View(camera, mask)


@functools.cache
def warm_up() -> None:
    """Compile or load the kernels of a search, so that a match with a time limit does not."""
    tree, view = small_match()
    MultiStartSearch(tree).match([view])


def without_specks(mask: np.ndarray, largest: int = 6, least: float = 0.02) -> np.ndarray:
    """Remove salt-and-pepper noise from a mask by a median filter.

    The median over 5 x 5 pixels also removes structures thinner than three pixels, so masks with
    few specks are returned unchanged. So is a mask that the filter would empty.

    ``mask``: (H, W) bool; a filtered mask is a copy. ``largest``: greatest area of a speck: a
    4-connected component or hole [pixel]. ``least``: least area of all specks for the mask to be
    filtered, as a fraction of the mask's.
    """
    inside = mask.astype(np.uint8)
    left, top, width, height = cv2.boundingRect(inside)
    # Outside the mask's bounding box, enlarged by the size of a speck, there are no specks.
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
