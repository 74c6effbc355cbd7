"""The body in a sequence of one unknown camera: which of its parts, how long, how tilted.

Nobody has measured such a body, and one parallel silhouette tells neither which way it is tilted
nor whether a part that should be there is hidden or cut off. The sequence tells: parts without
which the first frame is explained better are left out, poses of the first frame that look alike are
followed through the sequence, and lengths and widths are fitted to frames all over it. What comes
out is a model as others are, and a pose from which it is tracked.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from drake_pose.apps.estimate.inputs import Inputs, leave_out_links, make_placement_search
from drake_pose.apps.estimate.result import OnStage
from drake_pose.apps.estimate.sequence import sequence_tracking
from drake_pose.apps.results.overlay import draw_shapes
from drake_pose.apps.settings import EstimateSettings
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.tracking.contour_tracker import ContourTracker, TrackingSettings
from drake_pose.filtering.tracking.match_and_track import make_tracker
from drake_pose.filtering.tracking.start_poses import StartSettings, find_start, follow_start
from drake_pose.matching import PlacedMatch, View
from drake_pose.matching.continuous.root_placement_search import RootPlacementSearch
from drake_pose.matching.fit.evidence import find_edge_points
from drake_pose.matching.fit.proportions import ProportionedBody, fit_proportions
from drake_pose.matching.fit.surfaces import few_rigid_triangles
from drake_pose.silhouette import TreeSurfaces, draw_mask
from drake_pose.systems.estimators.mask_player import DEFAULT_FRAME_RATE_HZ

# A part that shows by itself with less than this share of its own area may not be there.
_HIDDEN = 0.1
# It is left out where E_total without it is less than so many times what it was.
_BETTER = 0.9
# Proportions are fitted to so many frames, to triangles of each rigid part.
_FRAMES, _TRIANGLES = 10, 160
# Distance of the silhouettes' points [pixel].
_SPACING = 2.0


class FittedBody(NamedTuple):
    """What is found out about a body.

    Attributes:
        inputs: with the fitted model, and a search that knows the first frame's pose.
        summary: what the summary says of it.
        shapes: (h, w, 3) uint8, red, green, blue: the corrected shape drawn over the file's in the
            first frame (Shimada's figure 18); None where the shape was left as it is.
    """

    inputs: Inputs
    summary: dict[str, Any]
    shapes: np.ndarray | None


class _StartedSearch(RootPlacementSearch):
    """A search whose answer for one silhouette is known."""

    def start_with(self, mask: np.ndarray, answer: PlacedMatch) -> None:
        """Remember an answer."""
        self._known = mask, answer

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PlacedMatch:
        """As RootPlacementSearch."""
        mask, answer = self._known
        if len(views) == 1 and np.array_equal(views[0].mask, mask):
            return answer
        return super().match(views, root_position)


def fit_body(inputs: Inputs, settings: EstimateSettings, on_stage: OnStage | None) -> FittedBody:
    """Find out about the body, where it is followed through a sequence of an unknown camera.

    Args:
        inputs: what is estimated.
        settings: the estimate's.
        on_stage: hears that it is done.

    Raises:
        DrakePoseError: as for an estimate.
    """
    scene, search = inputs.scene, inputs.search
    tracking = None if search is None else sequence_tracking(scene, search, settings.track)
    if (
        tracking is None
        or not tracking.scale_unknown
        or not isinstance(search, RootPlacementSearch)
        or not inputs.model.changes_shape
        or not search.tree.turns_root_freely
        or len(inputs.frames) < 2
    ):
        return FittedBody(inputs, {}, None)
    if on_stage is not None:
        on_stage("fitting the body to the sequence", 0, None)
    return _BodyFit(inputs, settings, tracking).run(search)


class _BodyFit:
    """One fit of a body."""

    def __init__(
        self, inputs: Inputs, settings: EstimateSettings, tracking: TrackingSettings
    ) -> None:
        self._inputs, self._settings, self._tracking = inputs, settings, tracking
        self._camera = inputs.cameras[0]
        frames = inputs.frames[: StartSettings().frames]
        self._masks = [inputs.scene.read(self._camera.name, frame) for frame in frames]
        self._more: dict[str, Any] = {}
        self._period = 1.0 / (inputs.scene.frame_rate_hz or DEFAULT_FRAME_RATE_HZ)

    def run(self, search: RootPlacementSearch) -> FittedBody:
        """All of it."""
        begin = time.perf_counter()
        first = search.match([View(self._camera, self._masks[0])])
        if not first.found:
            return FittedBody(self._inputs, {}, None)
        shapes = None
        search, first = self._without_hidden(search, first)
        tracker = self._tracker(search)
        frames = [[mask] for mask in self._masks]
        best = find_start(
            tracker, tracker.observation.state(first.q, first.X_WB, first.scale), frames
        )[0]
        factors, start = self._fit_proportions(tracker, best.states)
        by_link = {
            node.name: tuple(row)
            for node, row in zip(search.tree.nodes, factors.tolist(), strict=True)
        }
        model = self._inputs.model.stretched(by_link)
        stretched = make_placement_search(model, self._settings, None, True)
        other = self._tracker(stretched)
        followed = follow_start(other, start, frames)
        if np.mean(followed.errors) < np.mean(best.errors):
            shapes = self._draw_shapes((tracker, best.x), (other, followed.x))
            self._inputs = replace(self._inputs, model=model)
            search, tracker, best = stretched, other, followed
            self._more["proportions"] = {
                name: [round(one, 4) for one in row] for name, row in by_link.items()
            }
        seconds = time.perf_counter() - begin
        started = _StartedSearch(search.tree, search.settings, search.placement)
        answer = self._answer(tracker.observation, best.x, best.errors[0], seconds)
        started.start_with(self._masks[0], answer)
        self._more["body_fit_seconds"] = round(seconds, 3)
        return FittedBody(replace(self._inputs, search=started), self._more, shapes)

    def _draw_shapes(self, *bodies: tuple[ContourTracker, np.ndarray]) -> np.ndarray:
        """The file's body and the corrected one, each where it is in the first frame."""
        shapes = []
        for tracker, x in bodies:
            observation = tracker.observation
            outlines = TreeSurfaces(observation.tree).at(observation.node_values(x))
            X_CN = self._camera.X_CW @ observation.node_poses(x)
            shapes.append(draw_mask(outlines, X_CN, self._camera))
        title = f"frame {self._inputs.frames[0]}: the shape that explains the sequence"
        return draw_shapes(self._masks[0], shapes, ("the file's", "corrected"), [title])

    def _without_hidden(
        self, search: RootPlacementSearch, first: PlacedMatch
    ) -> tuple[RootPlacementSearch, PlacedMatch]:
        """The search and its answer, without parts that are not there where that is better."""
        hidden = () if self._settings.unseen else self._hidden_parts(search, first)
        if not hidden:
            return search, first
        settings = replace(self._settings, unseen=hidden)
        model, settings = leave_out_links(self._inputs.model, settings)
        other = make_placement_search(model, settings, None, True)
        better = other.match([View(self._camera, self._masks[0])])
        if not better.found or better.E_total >= _BETTER * first.E_total:
            return search, first
        warning = (
            f"{', '.join(hidden)}: not in the pictures, it seems, and left out, its joints held: "
            f"E_total of frame '{self._inputs.frames[0]}' is {better.E_total:.1%} without and "
            f"{first.E_total:.1%} with it; unseen (--unseen) names links that are not seen"
        )
        warnings = (*self._inputs.warnings, warning)
        self._inputs = replace(self._inputs, model=model, warnings=warnings)
        self._settings = settings
        self._more["unseen"] = list(hidden)
        return other, better

    def _tracker(self, search: RootPlacementSearch) -> ContourTracker:
        return make_tracker(search.tree, [self._camera], self._period, self._tracking)

    def _hidden_parts(self, search: RootPlacementSearch, match: PlacedMatch) -> tuple[str, ...]:
        """Parts that end at the root, and of which next to nothing shows."""
        observation = self._tracker(search).observation
        x = observation.state(match.q, match.X_WB, match.scale)
        outlines = TreeSurfaces(search.tree).at(match.node_values)
        X_CN = self._camera.X_CW @ observation.node_poses(x)
        hidden = []
        for i, node in enumerate(search.tree.nodes):
            if node.parent != 0 or node.children or i == 0:
                continue
            others = [k for k in range(len(outlines)) if k != i]
            own = draw_mask([outlines[i]], X_CN[[i]], self._camera)
            rest = draw_mask([outlines[k] for k in others], X_CN[others], self._camera)
            shows = np.count_nonzero(own & ~rest & self._masks[0])
            # As large as it is, turned to the viewer, it has this area at least.
            whole = _area(outlines[i].vertices) * match.scale**2 * self._pixels_per_metre**2
            if shows < _HIDDEN * whole:
                hidden.append(node.name)
        return tuple(hidden)

    @property
    def _pixels_per_metre(self) -> float:
        return float(getattr(self._camera, "pixels_per_metre", 1.0))

    def _fit_proportions(
        self, tracker: ContourTracker, states: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """How much longer and wider parts are, and the state in the first frame."""
        observation = tracker.observation
        tree = observation.tree
        body = ProportionedBody(
            TreeKinematics(tree), few_rigid_triangles(TreeSurfaces(tree), _TRIANGLES)
        )
        picked = np.unique(np.linspace(0, len(states) - 1, _FRAMES).round().astype(int))
        starts = np.array([observation.parameters(states[k]) for k in picked])
        edges = [find_edge_points(self._masks[k], _SPACING) for k in picked]
        fitted = fit_proportions(body, self._camera, edges, starts)
        return fitted.factors, observation.state_of(fitted.parameters[0])

    def _answer(
        self, observation: ContourObservation, x: np.ndarray, E_total: float, seconds: float
    ) -> PlacedMatch:
        """A state as a search would give it."""
        q, X_WB = observation.positions(x)
        return PlacedMatch(
            found=True,
            q=q,
            X_WB=X_WB,
            node_values=observation.node_values(x),
            J=E_total * float(np.count_nonzero(self._masks[0])),
            E_total=E_total,
            first_E_total=E_total,
            runs=0,
            outside_limit=(),
            untried={},
            stopped_by="end",
            seconds=seconds,
            root_position=observation.root_position(x),
            scale=observation.scale(x),
        )


def _area(points: np.ndarray) -> float:
    """Area of the box about points (n, 3) across its shortest side."""
    size = np.sort(np.ptp(points, axis=0))
    return float(size[1] * size[2])
