"""Fit of a body's shape to a sequence of one uncalibrated camera.

Links that are missing in the first frame are left out. The modes of the first frame's pose are
tracked as alternative starts; then lengths, widths and the poses of all frames are fitted together.
The result is a model, its poses, and a start for the rest of the sequence.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from drake_pose.body import ArticulatedModel
from drake_pose.camera.models import ParallelCamera
from drake_pose.files.overlay import draw_shapes
from drake_pose.files.records import user_units
from drake_pose.files.settings import EstimateSettings
from drake_pose.files.writer import OnStage
from drake_pose.filtering.contour_observation import ContourObservation
from drake_pose.filtering.contour_tracker import Tracker, TrackingSettings
from drake_pose.filtering.sequence_fit import (
    SEQUENCE,
    TrackedStart,
    find_start,
    fit_sequence,
    pose_set,
)
from drake_pose.jobs.estimate.inputs import EstimateInputs, leave_out_links, make_placement_search
from drake_pose.search import TRACKED, PoseEstimate, RootPlacementSearch, View
from drake_pose.silhouette.outline import TreeSurfaces
from drake_pose.silhouette.pictures.scenes import USUAL_RATE_HZ
from drake_pose.silhouette.scoring import draw_mask

FittedBody = tuple[EstimateInputs, dict[str, Any], np.ndarray | None]
"""Inputs with the fitted model and a search that knows the pose of the last fitted frame; entries
for the summary; and a picture (h, w, 3) uint8 of the fitted shape over the file's (figure 18 of
Shimada et al.), or None."""


class _Fitted(NamedTuple):
    """A model, its search and observation, state x (n,) in the first frame, and estimates by index.

    ``known``: estimates by index of the frame, of the first frame or of all that were fitted.
    """

    model: ArticulatedModel
    search: RootPlacementSearch
    observation: ContourObservation
    x: np.ndarray
    known: dict[int, PoseEstimate]


class _StartedSearch(RootPlacementSearch):
    """A search whose first estimate is given: that of the frame from which the track continues."""

    first: PoseEstimate | None = None

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """Return the given estimate in the first call, then that of RootPlacementSearch.match."""
        known, self.first = self.first, None
        return super().match(views, root_position) if known is None else known


def fit_body(inputs: EstimateInputs, settings: EstimateSettings, on_stage: OnStage) -> FittedBody:
    """Fit the body to a tracked sequence of one uncalibrated camera.

    Other inputs are returned unchanged, with {} and None: those of a calibrated camera, of a single
    frame, without tracking, or of a body that cannot change its shape or turn freely.

    ``inputs``: the inputs. ``settings``: settings of the estimate. ``on_stage``: called when the
    fit begins. Raises DrakePoseError: as for an estimate.
    """
    search, tracking = inputs.search, inputs.tracking()
    if (
        tracking is None
        or not tracking.scale_unknown
        or not isinstance(search, RootPlacementSearch)
        or not (inputs.model.changes_shape and search.tree.turns_root_freely)
        or len(inputs.frames) < 2
    ):
        return inputs, {}, None
    on_stage("fitting the body to the sequence", 0, None)
    return _BodyFit(inputs, settings, tracking).run(search)


class _BodyFit:
    """Fit of a body's shape to the first masks of a sequence; ``tracking``: of the tracker used."""

    def __init__(
        self, inputs: EstimateInputs, settings: EstimateSettings, tracking: TrackingSettings
    ) -> None:
        self._inputs, self._settings, self._tracking = inputs, settings, tracking
        self._camera = next(iter(inputs.scene.cameras.values()))
        frames = inputs.frames[: SEQUENCE.start_frames]
        self._masks = [inputs.scene.read(self._camera.name, frame) for frame in frames]
        self._more: dict[str, Any] = {}
        self._period = 1.0 / (inputs.scene.frame_rate_hz or USUAL_RATE_HZ)

    def run(self, search: RootPlacementSearch) -> FittedBody:
        """Search the first frame, leave out hidden links, and fit the sequence.

        If no pose is found in the first frame, the inputs are returned with {} and None. The shape
        is fitted to three frames or more.

        ``search``: search for the pose in the first frame.
        """
        begin = time.perf_counter()
        first = search.match([View(self._camera, self._masks[0])])
        if not first.found:
            return self._inputs, {}, None
        search, first = self._without_hidden(search, first)
        tracker = self._tracker(search)
        own = tracker.observation
        starts = find_start(
            tracker, own.state(first.q, first.X_WB, first.scale), [[one] for one in self._masks]
        )
        known = {0: self._estimate_of(own, starts[0].x, 0)}
        body = _Fitted(self._inputs.model, search, own, starts[0].x, known)
        fitted = self._fit(tracker, starts) if len(self._masks) >= 3 else None
        shapes = None
        frames, warnings = self._inputs.frames, self._inputs.warnings
        if fitted is not None:
            outlines = []
            for one in (body, fitted):
                surfaces = TreeSurfaces(one.search.tree).at(one.observation.node_values(one.x))
                X_CN = self._camera.X_CW @ one.observation.node_poses(one.x)
                outlines.append(draw_mask(surfaces, X_CN, self._camera))
            title = f"frame {frames[0]}: the shape fitted to the sequence"
            shapes = draw_shapes(self._masks[0], outlines, ("the file's", "corrected"), title)
            # See tutorials/figures.md. Intervals do not include errors of the model's surface.
            text = (
                "the body's lengths and all poses were fitted to the sequence together; do not "
                "rely on the lengths: for four measured hands 90 to 100 % of the joints were "
                "inside these 95 % intervals, but lengths were off by a fifth to a quarter"
            )
            body, warnings = fitted, (*warnings, text)
        seconds = time.perf_counter() - begin
        self._more["body_fit_seconds"] = round(seconds, 3)
        seconds_per_frame = seconds / len(body.known)
        known = {k: replace(one, seconds=seconds_per_frame) for k, one in body.known.items()}
        started = _StartedSearch(body.search.tree, body.search.settings, body.search.scale_unknown)
        started.first = known[max(known)]
        inputs = replace(
            self._inputs, model=body.model, search=started, warnings=warnings,
            known={frames[k]: one for k, one in known.items()},
        )  # fmt: skip
        return inputs, self._more, shapes

    def _fit(self, tracker: Tracker, starts: Sequence[TrackedStart]) -> _Fitted | None:
        """Fit shape and poses to the sequence; return None if the mean E_total is not reduced.

        The result is the best fit; its estimates have the others as alternative poses.

        ``tracker``: tracker of the body with the file's shape. ``starts``: alternative tracks
        through all masks, best first.
        """
        explanations = fit_sequence(
            tracker, self._masks, [start.states for start in starts], self._period
        )
        model, tree = self._inputs.model, tracker.observation.tree
        units = user_units(model)
        held = {model.position_names[i]: units[i] * value for i, value in tree.held.items()}
        settings = replace(self._settings, hold=held)
        count = len(tracker.observation.parameters(starts[0].x))
        found = []
        for one in explanations:
            changed = one.body.applied_to(model, one.fitted.parameters[0])
            search = make_placement_search(changed, settings, None, True)
            own = self._tracker(search).observation
            path = [own.state_of(theta[:count]) for theta in one.fitted.parameters]
            known = {k: self._estimate_of(own, x, k) for k, x in enumerate(path)}
            found.append(_Fitted(changed, search, own, path[0], known))
        best = found[0]
        errors = [one.E_total for one in best.known.values()]
        if np.mean(errors) >= np.mean(starts[0].errors):
            return None
        for k, answer in best.known.items():
            poses = [(one.known[k].q, one.known[k].X_WB, one.known[k].J) for one in found]
            best.known[k] = replace(answer, pose_set=pose_set(explanations, poses, k))
        # Entries for the summary: the fitted shape, and the costs of alternatives.
        body, theta = explanations[0].body, explanations[0].fitted.parameters[0]
        nodes, X_WN = body.kinematics.tree.nodes, body.place(theta).X_WN
        apart = np.linalg.norm(X_WN[:, :3, 3] - X_WN[[n.parent for n in nodes], :3, 3], axis=1)
        lengths = (apart / np.linalg.norm(X_WN[0, :3, 0])).round(5).tolist()
        factors, places = body.factors(theta).round(4).tolist(), body.relative_joint_shifts(theta)
        costs = [one.fitted.cost / explanations[0].fitted.cost for one in explanations]
        self._more |= {
            "proportions": {node.name: row for node, row in zip(nodes, factors, strict=True)},
            "lengths": {n.name: k for n, k in zip(nodes, lengths, strict=True) if n.parent >= 0},
            "joint_places": {nodes[i].name: round(places[i], 4) for i in body.movable},
            "explanations": [round(cost, 4) for cost in costs],
        }
        return best

    def _without_hidden(
        self,
        search: RootPlacementSearch,
        first: PoseEstimate,
        shown: float = 0.1,
        better_by: float = 0.9,
    ) -> tuple[RootPlacementSearch, PoseEstimate]:
        """Return search and estimate without links that are missing in the first frame.

        They are the given ones if no link is missing. Inputs, settings and summary are updated.

        ``search``: search for all links. ``first``: its estimate in the first frame. ``shown``: a
        leaf at the root may be missing if a smaller fraction of its area is in the mask and outside
        of all other links. ``better_by``: links are left out if that reduces E_total below this
        multiple.
        """
        if self._settings.unseen:
            return search, first
        observation = self._tracker(search).observation
        x = observation.state(first.q, first.X_WB, first.scale)
        outlines = TreeSurfaces(search.tree).at(first.node_values)
        X_CN = self._camera.X_CW @ observation.node_poses(x)
        assert isinstance(self._camera, ParallelCamera)
        pixels, hidden = first.scale * self._camera.pixels_per_metre, []
        for i, node in enumerate(search.tree.nodes):
            if node.parent != 0 or node.children or i == 0:
                continue
            others = [k for k in range(len(outlines)) if k != i]
            own = draw_mask([outlines[i]], X_CN[[i]], self._camera)
            rest = draw_mask([outlines[k] for k in others], X_CN[others], self._camera)
            # The two longest sides of its bounding box approximate its area.
            _, *sides = np.sort(np.ptp(outlines[i].vertices, axis=0))
            if np.sum(own & ~rest & self._masks[0]) < shown * np.prod(sides) * pixels**2:
                hidden.append(node.name)
        if not hidden:
            return search, first
        settings = replace(self._settings, unseen=tuple(hidden))
        model, settings = leave_out_links(self._inputs.model, settings)
        other = make_placement_search(model, settings, None, True)
        better = other.match([View(self._camera, self._masks[0])])
        if not better.found or better.E_total >= better_by * first.E_total:
            return search, first
        warning = (
            f"{', '.join(hidden)}: seems to be missing in the pictures and is left out, its joints "
            f"held: E_total of frame '{self._inputs.frames[0]}' is {better.E_total:.1%} without "
            f"and {first.E_total:.1%} with it; if it is visible, name other links in unseen "
            "(--unseen)"
        )
        warnings = (*self._inputs.warnings, warning)
        self._inputs = replace(self._inputs, model=model, warnings=warnings)
        self._settings = settings
        self._more["unseen"] = hidden
        return other, better

    def _tracker(self, search: RootPlacementSearch) -> Tracker:
        """Return a tracker of the body of a search in the only camera."""
        return Tracker(search.tree, [self._camera], self._period, self._tracking)

    def _estimate_of(
        self, observation: ContourObservation, x: np.ndarray, frame: int
    ) -> PoseEstimate:
        """Return the state x (n,) of an observation, in the frame of this index, as an estimate."""
        q, X_WB = observation.positions(x)
        wrong, area = observation.difference(x, [(self._camera, self._masks[frame])])
        return PoseEstimate(
            True, q, X_WB, observation.node_values(x), float(wrong), float(max(area, 1)), TRACKED,
            root_position=observation.root_position(x), scale=observation.scale(x),
        )  # fmt: skip
