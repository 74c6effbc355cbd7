"""Multi-start search: from silhouettes, also damaged or ill fitting, to continuous positions.

Poses that are roughly right are found by places (``coarse_search``), drawn to the silhouettes'
edges by saturating costs (``fit``), and about the best of them other explanations are sought: a
limb searched again, joints that turn against each other (``self_motions``).
"""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.errors import SettingsError
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import few_triangles
from drake_pose.search.continuous.equivalent_poses import RobustFamilies, RobustFamilySettings
from drake_pose.search.continuous.views_fit import (
    FittedPose,
    ViewsFit,
    distinct,
    refine_best,
)
from drake_pose.search.estimates import PoseEstimate, SearchStatistics, View
from drake_pose.search.grid.sampled_body import SampledBody
from drake_pose.search.settings import BeamSearchSettings
from drake_pose.search.starts.coarse_search import (
    HYPOTHESES,
    INTERVAL,
    LENGTH_INTERVAL,
    CoarsePoses,
    CoarseSearch,
)
from drake_pose.search.starts.self_motions import counter_turns, flips
from drake_pose.silhouette.areas.scoring import draw_mask

# Connected pixels, or holes, no larger than this are specks [pixel].
_SPECK = 6
# Masks are left alone whose specks have a smaller share of the silhouette's area.
_SPECKLED = 0.02
_WINDOW = 5

COARSE = (AnnealingStage(0.1, 0.04, 3), AnnealingStage(0.05, 0.04, 3))
MEDIUM = (AnnealingStage(0.05, 0.026, 4), AnnealingStage(0.025, 0.026, 4))
FINAL = (AnnealingStage(0.0125, 0.0125, 6),)


# How many coarse poses are fitted, how many go on, and how many are fitted to the end.
_STARTS, _SURVIVORS, _FINALISTS = 40, 12, 4
# Coarse poses differ where some part of the body is seen so far away, as a share of the root of the
# silhouettes' mean area.
_APART = 0.13
# About how many of the best poses others are sought; of each so many are fitted, and so many more
# that are made by flips of its joints.
_SOUGHT_ABOUT, _TRIED, _FLIPPED = 3, 6, 3


@dataclass(frozen=True)
class MultiStartSettings:
    """Parameters of the multi-start search.

    Args:
        beam: of these, the coarse search heeds the time limit alone.
        rounds: how often other explanations are sought about the best poses.
        families: of the answer as a set; None: only the best pose is wanted.

    Raises:
        SettingsError: if a value is out of its range.
    """

    beam: BeamSearchSettings = field(default_factory=BeamSearchSettings)
    rounds: int = 2
    families: RobustFamilySettings | None = field(default_factory=RobustFamilySettings)

    def __post_init__(self) -> None:
        if self.rounds < 0:
            raise SettingsError(f"rounds must be 0 or more, not {self.rounds}")


class MultiStartSearch:
    """Matches silhouettes with a pose tree at continuous values.

    Args:
        tree: the pose tree.
        settings: the parameters.
    """

    def __init__(self, tree: PoseTree, settings: MultiStartSettings | None = None) -> None:
        self.tree = tree
        self.settings = settings or MultiStartSettings()
        beam = self.settings.beam
        coarse = replace(beam, interval=INTERVAL, length_interval=LENGTH_INTERVAL, intervals={})
        self._body = SampledBody(tree, coarse)
        self.sampled = self._body.sampled
        self._outlines = few_triangles(self.sampled.surfaces)
        self._kinematics = TreeKinematics(tree)

    def without_alternatives(self) -> MultiStartSearch:
        """The same search where only E_total is wanted: one round, and no set of poses."""
        other = copy.copy(self)
        other.settings = replace(self.settings, rounds=0, families=None)
        return other

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Estimate the pose that the views show.

        Args:
            views: one or several silhouettes of the same instant.
            root_position: (3,), the root's known position in the world [m], where it is not the
                pose tree's own.

        Returns:
            The best pose found. ``stopped_by`` is "end" if all was tried, or "time_limit".

        Raises:
            SettingsError: if there is no view.
        """
        if not views:
            raise SettingsError("a match needs at least one view, but none was given")
        start = time.perf_counter()
        clean = [View(view.camera, without_specks(view.mask)) for view in views]
        result = self._run(clean, root_position, start).result(views)
        return replace(result, seconds=time.perf_counter() - start)

    def _run(
        self, views: Sequence[View], root_position: np.ndarray | None, start: float
    ) -> _MultiStartRun:
        body, kinematics = self._body, self._kinematics
        if root_position is not None:
            body = body.with_root_position(root_position)
            kinematics = TreeKinematics(body.sampled.tree)
        limit = self.settings.beam.time_limit
        deadline = np.inf if limit is None else start + limit
        fit = ViewsFit(kinematics, self._outlines, views)
        run = _MultiStartRun(body, kinematics, fit, views, deadline)
        run.search(self.settings)
        return run


class _MultiStartRun:
    """One match of a body, sampled roughly, with silhouettes, until a deadline."""

    def __init__(
        self,
        body: SampledBody,
        kinematics: TreeKinematics,
        fit: ViewsFit,
        views: Sequence[View],
        deadline: float,
    ) -> None:
        self.body = body
        self.kinematics = kinematics
        self.fit = fit
        self.poses: list[FittedPose] = []
        self.first = FittedPose(np.zeros(0), np.inf)
        self.stopped_by = "end"
        self._views = views
        self._deadline = deadline
        self._families: RobustFamilies | None = None

    def search(self, settings: MultiStartSettings) -> None:
        """Find coarse poses, refine them, seek other explanations, and refine to the end."""
        search = CoarseSearch(self.body, self._views, HYPOTHESES if self._proceed() else 1)
        starts = search.choose_distinct(search.find(), _STARTS, _APART)
        pool = refine_best(
            self.fit,
            self._values(starts),
            [(COARSE, _SURVIVORS), (MEDIUM, _SURVIVORS)],
            self._proceed,
        )
        self.first = pool[0]
        done: list[np.ndarray] = []
        for _ in range(settings.rounds):
            found = []
            for pose in pool[:_SOUGHT_ABOUT]:
                if any(pose.values is values for values in done) or not self._proceed():
                    continue
                done.append(pose.values)
                found += self._others(search, pose.values)
            pool = distinct([*pool, *found], _SURVIVORS, self.kinematics.turns_around)
        refined = refine_best(
            self.fit,
            [pose.values for pose in pool[:_FINALISTS]],
            [(FINAL, _FINALISTS)],
            self._proceed,
        )
        turned = [self.kinematics.nearest_turns(pose.values) for pose in refined]
        self.poses = [
            replace(pose, values=values) for pose, values in zip(refined, turned, strict=True)
        ]
        if settings.families is not None:
            self._families = RobustFamilies(self.fit, settings.families, self._proceed)

    def _proceed(self) -> bool:
        if time.perf_counter() < self._deadline:
            return True
        self.stopped_by = "time_limit"
        return False

    def _others(self, search: CoarseSearch, values: np.ndarray) -> list[FittedPose]:
        """Other explanations near a pose, refined."""
        kinematics = self.kinematics
        flipped = [flip.values for flip in flips(kinematics, values)]
        tried = counter_turns(kinematics, values, INTERVAL)
        X_WN = kinematics.poses(values)
        for nodes in self._limbs():
            found = search.find_again(X_WN, nodes)
            best = search.choose_distinct(found, _TRIED, _APART)
            tried += self._values(best, values)
        look = AnnealingStage(MEDIUM[0].scale, COARSE[0].spacing)
        best_looks = []
        for group, count in ((flipped, _FLIPPED), (tried, _TRIED)):
            looks = [FittedPose(one, self.fit.cost(one, look)) for one in group]
            best_looks += distinct(looks, count, kinematics.turns_around, 0.5 * INTERVAL)
        return [self.fit.refine(look.values, MEDIUM) for look in best_looks if self._proceed()]

    def _limbs(self) -> list[list[int]]:
        """The subtrees of no more than half of the nodes."""
        nodes = self.body.sampled.tree.nodes
        subtrees: list[list[int]] = [[] for _ in nodes]
        for i in reversed(range(len(nodes))):
            subtrees[i] = [i, *(j for child in nodes[i].children for j in subtrees[child])]
        return [tree for tree in subtrees if 2 * len(tree) <= len(nodes)]

    def _values(self, coarse: CoarsePoses, values: np.ndarray | None = None) -> list[np.ndarray]:
        """All values (m,) of coarse poses; those of nodes not searched are taken from values."""
        grids = self.body.sampled.values
        base = np.zeros(len(self.kinematics.names)) if values is None else values
        found = []
        for samples in coarse.samples:
            parts = list(self.kinematics.split(base.copy()))
            for node, sample in enumerate(samples):
                if sample >= 0:
                    parts[node] = grids[node][sample]
            found.append(self.kinematics.flatten(parts))
        return found

    def _J(self, views: Sequence[View], values: np.ndarray) -> float:
        """The objective (1) at values (m,), skin included [pixel]."""
        outlines = self.body.sampled.surfaces.at(self.kinematics.split(values))
        X_WN = self.kinematics.poses(values)
        drawn = (draw_mask(outlines, view.camera.X_CW @ X_WN, view.camera) for view in views)
        return float(sum(np.count_nonzero(d != v.mask) for d, v in zip(drawn, views, strict=True)))

    def result(self, views: Sequence[View]) -> PoseEstimate:
        """What the search found, judged by silhouettes as they were given."""
        best = self.poses[0]
        J = self._J(views, best.values)
        # Before the families, whose evaluations are not the search's.
        statistics = SearchStatistics(self.fit.evaluations, self._J(views, self.first.values))
        pose_set = None
        if self._families is not None:
            pose_set = self._families.find(self.poses, lambda values: self._J(views, values))
        return PoseEstimate.of_values(
            self.body.sampled.tree,
            self.kinematics.split(best.values),
            J,
            float(sum(np.count_nonzero(view.mask) for view in views)),
            stopped_by=self.stopped_by,
            statistics=statistics,
            pose_set=pose_set,
        )


def without_specks(mask: np.ndarray) -> np.ndarray:
    """A mask without salt and pepper noise; one with few specks stays as it is.

    A median over 5 x 5 pixels takes specks away, but also what is thinner than three pixels, so it
    is only used where specks are many.

    Args:
        mask: (H, W) bool.

    Returns:
        (H, W) bool, not empty if the mask is not.
    """
    inside = mask.astype(np.uint8)
    specks = sum(_speck_area(side) for side in (inside, 1 - inside))
    if specks <= _SPECKLED * np.count_nonzero(mask):
        return mask
    cleaned = cv2.medianBlur(inside, _WINDOW) > 0
    return cleaned if cleaned.any() else mask


def _speck_area(inside: np.ndarray) -> int:
    """The area of all small connected parts of a mask [pixel]."""
    _, _, statistics, _ = cv2.connectedComponentsWithStats(inside, connectivity=4)
    areas = statistics[1:, cv2.CC_STAT_AREA]
    return int(areas[areas <= _SPECK].sum())
