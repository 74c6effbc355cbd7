"""The beam search: many hypotheses at once, ranked by what the whole objective will be.

Its first stages let nothing lie outside the silhouette and end at J = 0, which certifies itself;
later ones let more and more, weighed against what is covered newly (5).
"""

import copy
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.errors import SettingsError
from drake_pose.search.estimates import PoseEstimate, SearchStatistics, View
from drake_pose.search.grid.beam_stages import run_stage, search_limbs_again, turn_single_nodes
from drake_pose.search.grid.distinct_poses import Gathering, GridPoses, check_choice
from drake_pose.search.grid.examination import ExaminationSettings, examine
from drake_pose.search.grid.node_poses import BAND, Pictures, PoseStore, coarsen
from drake_pose.search.grid.partial_poses import Expansion, PartialPoses
from drake_pose.search.grid.sampled_body import SampledBody
from drake_pose.search.scoring import Scoring
from drake_pose.search.settings import BeamSearchSettings, Stage

# Stages that let something lie outside see the silhouettes no finer than with about so many pixels;
# the best pose is then judged in full.
_COARSE_PIXELS = 6000


class BeamSearch:
    """Matches silhouettes with a pose tree by the beam search; tables are made once.

    Args:
        examination: how every answer is examined; None: it is not.
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
        """Estimate the pose that the views show; see ``PoseSearch``.

        Returns:
            The best pose found; ``stopped_by`` is "exact" (J = 0), "end" or "time_limit".

        Raises:
            SettingsError: if there is no view.
        """
        start = time.perf_counter()
        run = self._prepare(views, root_position)
        run.search()
        result = run.result(time.perf_counter() - start)
        if self.examination is not None:
            result = examine(self.body, views, result, self.examination, root_position)
            result = replace(result, seconds=time.perf_counter() - start)
        return result

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
    ) -> GridPoses:
        """The best whole poses that the search came by and that do not look alike.

        Slower than :meth:`match`: the search does not end at J = 0 before it has also looked at
        poses that leave the silhouette a little.

        Args:
            count: at most this many.
            alike: two poses look alike if each node's pictures in both have so much of their union
                in common in all views, or it is hidden in both, covering nothing that other nodes
                do not cover. Above 1: all poses of the grid differ.

        Returns:
            The poses, the smallest J first; an empty list if a limit of the settings left none.

        Raises:
            SettingsError: if there is no view, count is below 1 or alike is not positive.
        """
        check_choice(count, alike)
        gathering = Gathering()
        run = self._prepare(views, root_position, gathering)
        run.search()
        return gathering.choose(run.scoring, run.pictures(exact=False), count, alike)

    def _prepare(
        self,
        views: Sequence[View],
        root_position: np.ndarray | None,
        gathering: Gathering | None = None,
    ) -> "_Run":
        if not views:
            raise SettingsError("a match needs at least one view, but none was given")
        body = self.body
        if root_position is not None:
            body = body.with_root_position(root_position)
        return _Run(body, views, self.settings, gathering)


class _Run:
    """One match."""

    def __init__(
        self,
        body: SampledBody,
        views: Sequence[View],
        settings: BeamSearchSettings,
        gathering: Gathering | None,
    ) -> None:
        limit = settings.time_limit
        self.deadline = np.inf if limit is None else time.perf_counter() + limit
        self.gathering = gathering
        self.body = body
        self.views = views
        self.settings = settings
        self.scoring = Scoring(body.sampled, views)
        self.samples: np.ndarray | None = None
        self._pictures: dict[bool, Pictures] = {}
        self.J = np.inf
        self.first_J = np.nan
        self.runs = 0
        self.stopped_by = ""
        self._expansions: dict[float, Expansion] = {}

    def search(self) -> None:
        """Run stage after stage until J = 0 or a limit is reached; then polish the answer."""
        skip_exact = False
        for stage in self.settings.stages:
            exact = stage.outside_share == 0.0
            if exact and skip_exact:
                continue
            if stage.outside_share not in self._expansions:
                store = PoseStore(self.body, self.pictures(exact), stage.outside_share)
                self._expansions[stage.outside_share] = Expansion(store)
            complete = self._run_stage(self._expansions[stage.outside_share], stage)
            if self.stopped_by or (self.J == 0 and (self.gathering is None or not exact)):
                break
            skip_exact = skip_exact or complete or self.J == 0
        if self.samples is None:
            self._answer_somehow()
        elif self.J > 0 and self.settings.research_hypotheses and not self.stopped_by:
            turned = turn_single_nodes(
                self.scoring, self.pictures(exact=False), self.samples, self.proceed
            )
            self._keep_if_better(turned)
        self.stopped_by = "exact" if self.J == 0 else self.stopped_by or "end"

    def pictures(self, exact: bool) -> Pictures:
        """The silhouettes as bits: coarse ones with a band for stages that are not exact."""
        if exact not in self._pictures:
            views, band = self.views, 0
            if not exact:
                views = tuple(coarsen(view, _COARSE_PIXELS) for view in views)
                band = BAND
            self._pictures[exact] = Pictures(self.body, views, band)
        return self._pictures[exact]

    def proceed(self) -> bool:
        """Whether the time allows to go on, after one more node."""
        self.runs += 1
        if time.perf_counter() >= self.deadline:
            self.stopped_by = "time_limit"
        return not self.stopped_by

    def _run_stage(self, expansion: Expansion, stage: Stage) -> bool:
        """Returns whether the stage lost no hypothesis."""
        exact = stage.outside_share == 0.0
        order = self.body.limb_order if stage.limb_by_limb else self.body.order
        last, complete = run_stage(
            expansion, expansion.start(), order, stage.hypotheses, stage.outside_weight, exact,
            self.proceed,
        )  # fmt: skip
        if last is None:
            return complete
        Js = self._gather(expansion, last)
        best = int(np.argmin(Js))
        poses = last.poses[best]
        self._keep_if_better(expansion.store.samples(poses))
        if self.settings.research_hypotheses and (self.J > 0 or (self.gathering and not exact)):
            better = search_limbs_again(
                expansion,
                order,
                poses,
                float(Js[best]),
                self.settings.research_hypotheses,
                self.proceed,
                lambda whole: self._gather(expansion, whole),
            )
            self._keep_if_better(expansion.store.samples(better))
        return complete

    def _answer_somehow(self) -> None:
        """A pose whatever lies outside; found by one hypothesis alone if a limit was reached."""
        width = 1 if self.stopped_by else self.settings.stages[-1].hypotheses
        expansion = Expansion(PoseStore(self.body, self.pictures(exact=False)))
        last, _ = run_stage(
            expansion, expansion.start(), self.body.order, width, 2, False, lambda: True
        )
        if last is not None:
            best = int(np.argmin(self._gather(expansion, last)))
            self._keep_if_better(expansion.store.samples(last.poses[best]))

    def _gather(self, expansion: Expansion, whole: PartialPoses) -> np.ndarray:
        """What J is (n,) as the pictures show it; poses are gathered if that is wanted."""
        Js = expansion.objectives(whole)
        if self.gathering is not None:
            area = expansion.store.pictures.area
            self.gathering.add(expansion.store.samples(whole.poses), Js / area)
        return Js

    def _keep_if_better(self, samples: np.ndarray) -> None:
        """Keep samples (nodes,) if their J is the smallest so far."""
        X_WN = self.scoring.sampled.poses(samples[None])
        J = float(self.scoring.J(X_WN, samples[None])[0])
        if self.samples is None:
            self.first_J = J
        if J < self.J:
            self.J, self.samples = J, samples
            if self.gathering is not None:
                self.gathering.add(samples[None], np.array([J / self.scoring.silhouette_area]))

    def result(self, seconds: float) -> PoseEstimate:
        """What the search found."""
        tree = self.body.sampled.tree
        told: dict[str, Any] = {
            "stopped_by": self.stopped_by,
            "seconds": seconds,
            "statistics": SearchStatistics(self.runs, self.first_J),
        }
        if self.samples is None:
            return PoseEstimate.nothing(tree, **told)
        values = self.body.sampled.values_at(self.samples)
        return PoseEstimate.of_values(tree, values, self.J, self.scoring.silhouette_area, **told)
