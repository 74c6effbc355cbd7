"""The wide search: many hypotheses at once, ranked by what the whole objective will be.

Like Kameda's search it places one node after another, each at the samples of its grid, and scores
what a node covers newly (5). Unlike it, it keeps many hypotheses instead of one with K
alternatives, and needs no threshold r: its first stages let nothing lie outside the silhouette and
end at J = 0, which certifies itself; later ones let more and more, weighed against what is covered.
"""

import time
from collections.abc import Sequence

import numpy as np

from drake_pose.body import PoseTree
from drake_pose.errors import SettingsError
from drake_pose.matching.result import MatchResult, View
from drake_pose.matching.scoring import Scoring
from drake_pose.matching.wide_beam import Beam
from drake_pose.matching.wide_body import WideBody
from drake_pose.matching.wide_poses import Pictures, PoseStore, coarsen
from drake_pose.matching.wide_refine import poses_at, search_limbs_again, turn_single_nodes
from drake_pose.matching.wide_settings import Stage, WideSearchSettings


class WideSearch:
    """Matches silhouettes with a pose tree by the wide search.

    Grids and tables are made once; :meth:`match` may then be called for any number of pictures.

    Args:
        tree: the pose tree.
        settings: the parameters.
    """

    def __init__(self, tree: PoseTree, settings: WideSearchSettings | None = None) -> None:
        self.tree = tree
        self.settings = settings or WideSearchSettings()
        self.body = WideBody(tree, self.settings)
        self.sampled = self.body.sampled

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> MatchResult:
        """Estimate the pose that the views show.

        Args:
            views: one or several silhouettes of the same instant.
            root_position: (3,), the root's known position in the world [m], where it is not the
                pose tree's own.

        Returns:
            The best pose found. ``stopped_by`` is "exact" if J = 0, "end" if all stages were run,
            or the limit that stopped the search: "time_limit" or "hypothesis_limit". ``runs``
            counts how often a node was placed.

        Raises:
            SettingsError: if there is no view.
        """
        if not views:
            raise SettingsError("a match needs at least one view, but none was given")
        start = time.perf_counter()
        body = self.body
        if root_position is not None:
            body = body.with_root_position(root_position)
        run = _Run(body, views, self.settings, start)
        run.search()
        return run.result(time.perf_counter() - start)


class _Run:
    """One match."""

    def __init__(
        self, body: WideBody, views: Sequence[View], settings: WideSearchSettings, start: float
    ) -> None:
        self.body = body
        self.views = views
        self.settings = settings
        self.deadline = np.inf if settings.time_limit is None else start + settings.time_limit
        self.scoring = Scoring(body.sampled, views)
        self.samples: np.ndarray | None = None
        self.J = np.inf
        self.first_J = np.nan
        self.runs = 0
        self.hypotheses = 0
        self.stopped_by = ""

    def search(self) -> None:
        """Run stage after stage until J = 0 or a limit is reached."""
        no_exact_pose = False
        pictures: dict[bool, Pictures] = {}
        stores: dict[float, PoseStore] = {}
        for stage in self.settings.stages:
            exact = stage.outside_share == 0.0
            if exact and no_exact_pose:
                continue
            if exact not in pictures:
                pictures[exact] = self._pictures(exact)
            if stage.outside_share not in stores:
                stores[stage.outside_share] = PoseStore(
                    self.body, pictures[exact], stage.outside_share
                )
            complete = self._run_stage(Beam(stores[stage.outside_share]), stage)
            no_exact_pose = no_exact_pose or (exact and complete and self.J > 0)
            if self.J == 0 or self.stopped_by:
                break
        if self.samples is None:
            self._answer_somehow()
        self.stopped_by = "exact" if self.J == 0 else self.stopped_by or "end"

    def _pictures(self, exact: bool) -> Pictures:
        """The silhouettes as bits: coarse ones with a band for stages that are not exact."""
        if exact:
            return Pictures(self.body, self.views, 0)
        views = [coarsen(view, self.settings.coarse_pixels) for view in self.views]
        return Pictures(self.body, views, self.settings.band)

    def proceed(self, made: int) -> bool:
        """Whether the limits allow to go on, after one more node with so many hypotheses."""
        self.runs += 1
        self.hypotheses += made
        limit = self.settings.hypothesis_limit
        if limit is not None and self.hypotheses >= limit:
            self.stopped_by = "hypothesis_limit"
        elif time.perf_counter() >= self.deadline:
            self.stopped_by = "time_limit"
        return not self.stopped_by

    def _run_stage(self, beam: Beam, stage: Stage) -> bool:
        """Returns whether the stage lost no hypothesis."""
        exact = stage.outside_share == 0.0
        order = self.body.limb_order if stage.whole_limbs else self.body.order
        last, complete = beam.run(
            beam.start(), order, stage.hypotheses, stage.outside_weight, exact, self.proceed
        )
        if last is None:
            return complete
        Js = beam.store.pictures.area - last.covered + last.outside
        best = int(np.argmin(Js))
        poses = last.poses[best]
        self._keep_if_better(beam.store.samples(poses))
        if self.J > 0 and self.settings.research_hypotheses:
            width = self.settings.research_hypotheses
            better = search_limbs_again(
                beam, order, poses, float(Js[best]), width, stage.outside_weight, self.proceed
            )
            self._keep_if_better(beam.store.samples(better))
            if self.samples is not None and not self.stopped_by:
                turned = turn_single_nodes(self.scoring, self.samples, lambda: self.proceed(0))
                self._keep_if_better(turned)
        return complete

    def _answer_somehow(self) -> None:
        """A pose whatever lies outside; found by one hypothesis alone if a limit was reached."""
        width = 1 if self.stopped_by else self.settings.stages[-1].hypotheses
        store = PoseStore(self.body, self._pictures(exact=False), np.inf)
        beam = Beam(store)
        last, _ = beam.run(beam.start(), self.body.order, width, 2, False, lambda made: True)
        if last is not None:
            Js = store.pictures.area - last.covered + last.outside
            self._keep_if_better(store.samples(last.poses[int(np.argmin(Js))]))

    def _keep_if_better(self, samples: np.ndarray) -> None:
        """Keep samples (nodes,) if their J is the smallest so far."""
        J = float(self.scoring.J(poses_at(self.scoring, samples[None]))[0])
        if self.samples is None:
            self.first_J = J
        if J < self.J:
            self.J, self.samples = J, samples

    def _values(self, samples: np.ndarray) -> list[np.ndarray]:
        return [values[t] for values, t in zip(self.body.sampled.values, samples, strict=True)]

    def result(self, seconds: float) -> MatchResult:
        """What the search found."""
        tree, area = self.body.sampled.tree, self.scoring.silhouette_area
        if self.samples is None:
            missing = np.full(len(tree.model.position_names), np.nan)
            nothing = float("nan")
            return MatchResult(
                False, missing, np.eye(4), (), nothing, nothing, nothing, self.runs, (), {},
                self.stopped_by, seconds,
            )  # fmt: skip
        values = self._values(self.samples)
        q, X_WB = tree.positions_from(values)
        return MatchResult(
            found=True,
            q=q,
            X_WB=X_WB,
            node_values=tuple(values),
            J=self.J,
            E_total=self.J / area,
            first_E_total=self.first_J / area,
            runs=self.runs,
            outside_limit=(),
            untried={},
            stopped_by=self.stopped_by,
            seconds=seconds,
        )
