"""The matcher and the tracker as Drake systems: label images in, estimated positions out."""

import zlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.camera.models import Camera, camera_tuple
from drake_pose.errors import SettingsError, require_at_least, require_known
from drake_pose.filtering.contour_tracker import Tracker, TrackerState, TrackingSettings
from drake_pose.fit.judge import LEVEL
from drake_pose.search import TRACKED, PoseEstimate, PoseSearch, PoseSet, RobustSettings, View
from drake_pose.silhouette.pictures.label_renderer import label_image_to_mask
from drake_pose.systems.bodies import body_poses
from drake_pose.systems.ports import (
    BeliefSystem,
    ImmutableValue,
    require_distinct_cameras,
    require_period,
    require_time_forward,
)

STATISTICS = (
    "found", "J", "E_total", "first_E_total", "runs", "outside_limit", "seconds", "stale",
)  # fmt: skip
"""Names of the elements of the output port ``statistics``."""

MODE_LIMIT = 4
"""Largest number of modes in ``mode_positions``."""


class _Shown(NamedTuple):
    """What is known of a camera's pictures."""

    checksum: int  # Of the last picture.
    age: int = 0  # Number of updates since it changed; negative: of changes in a row.
    # Largest age at which another camera's picture changed; 0 again after many changes in a row.
    held: int = 0


@dataclass(frozen=True, eq=False)
class MatcherState(ImmutableValue):
    """The state of a SilhouetteMatcher."""

    q: Array  # (nq,) positions of the last pose found or predicted.
    X_WB: Array  # (4, 4) pose of its base.
    estimate: PoseEstimate | None = None  # Of the last update; None: no camera saw the body.
    memory: Any = None  # A subclass's own state; None: it has none.
    shown: Mapping[str, _Shown] = field(default_factory=dict)  # By name of the camera.
    stale: Collection[str] = ()  # Names of the cameras whose picture was not used.

    @property
    def was_tracked(self) -> bool:
        """Whether the pose was tracked without a search."""
        return isinstance(self.memory, _Memory) and bool(self.memory.track[0])


class SilhouetteMatcher(BeliefSystem[MatcherState]):
    """Estimates the positions of an articulated body from label images.

    .. pydrake_system::

        name: SilhouetteMatcher
        input_ports: [label_image, root_position (optional)]
        output_ports: [estimated_positions, covariance, last_positions, E_total, error, base_pose,
          body_poses, statistics, proved_optimal, determined, lower, upper, mode_positions,
          pose_estimate]

    A periodic update searches for the pose; output ports read the result. ``estimated_positions``
    and ``covariance`` are a measurement, as a ``TruncatedEkf`` takes it: NaN for what the pictures
    of the last update do not show. To draw a body, use ``last_positions`` or ``body_poses``.

    A picture that stays the same while another camera's changes is stale: it is not used until it
    changes, nor for as long as it was held before while no picture changes. A camera that held a
    picture has an unknown delay of up to a period: its new pictures are used only without newer
    ones.

    Input ports:
        label_image (ImageLabel16I): ``label_image_<camera>`` with several cameras. A camera whose
            port is not connected, or whose image shows no pixel of the body, is ignored.
        root_position (3): known position of the root in the world [m].

    Output ports:
        estimated_positions (nq): in the plant's order [rad or m]; NaN if no pose was found, and for
            positions that are not determined.
        covariance (nq x nq, row by row): of the estimated positions; NaN where they are, and if the
            search does not examine its result. It is diagonal, from ``lower`` and ``upper``.
        last_positions (nq): all positions of the last pose found, initially the model's default.
        E_total (1): the differing area as a fraction of the masks' area; infinite without a pose.
        error (1): the same; diagrams of earlier versions connect it under this name.
        base_pose (RigidTransform): pose X_WB of the plant's world.
        body_poses: poses of all bodies in the scene's world, as a plant's port of that name.
        statistics (8): see ``STATISTICS``; ``stale`` is the number of stale pictures.
        proved_optimal (1): 1 if it is proved that no pose of the searched grid fits better.
        determined (nq): 1 for a position that the silhouettes determine, else 0.
        lower, upper (nq): ends of each position's interval, or of the range found [rad or m].
        mode_positions (mode_limit x nq, row by row): positions of the modes that look the same,
            best first.
        pose_estimate: the ``PoseEstimate`` of the last update; None if no camera saw the body.

    The ports from ``proved_optimal`` to ``mode_positions`` are NaN if the search does not examine
    its result.

    Args:
        search: the search for the poses of a body.
        cameras: calibrated, in the order of the input ports, or by name.
        period: time between two updates [s].
        labels: render labels of the body; None: those of its model if made of a plant
            (``ArticulatedModel.from_plant``), else all but Drake's reserved ones. They are abstract
            parameter 0 of the context (a frozenset or None).
        mode_limit: largest number of modes in ``mode_positions``.

    Raises:
        SettingsError: there is no search or no camera, two cameras share a name, the period is not
            positive, or the mode limit is below 1.
    """

    _first_memory: Any = None
    """Initial value of ``MatcherState.memory``."""

    _follows = False
    """Whether the motion of the body is known, so that late pictures can be used."""

    def __init__(
        self,
        search: PoseSearch,
        cameras: Sequence[Camera] | Mapping[str, Camera],
        period: float,
        labels: Collection[int] | None = None,
        mode_limit: int = MODE_LIMIT,
    ) -> None:
        super().__init__()
        if not hasattr(search, "match"):
            raise SettingsError(
                f"a matcher needs a search, as MultiStartSearch(tree): {type(search).__name__}"
            )
        cameras = camera_tuple(cameras)
        require_distinct_cameras(
            cameras, 1, "a matcher needs one or more cameras of different names"
        )
        require_period("matcher", period)
        require_at_least(1, mode_limit=mode_limit)
        self._search, self._cameras, self._mode_limit = search, cameras, mode_limit
        labels = search.tree.model.labels if labels is None else labels
        self._labels = self.add_parameter(None if labels is None else frozenset(labels))
        self._images = self.add_images("label_image", ImageLabel16I, cameras)
        self.add_input("root_position", 3)
        q = search.tree.model.default_positions
        plant, nq = search.tree.model.plant, len(q)
        self.declare_belief(
            MatcherState(q, np.eye(4), memory=self._first_memory),
            period,
            estimated_positions=(nq, lambda known: np.where(self._shows(known), known.q, np.nan)),
            covariance=(nq * nq, self._shown_covariance),
            last_positions=(nq, lambda known: known.q),
            E_total=(1, lambda known: _statistics(known)[2:3]),
            error=(1, lambda known: _statistics(known)[2:3]),
            statistics=(len(STATISTICS), _statistics),
            base_pose=(RigidTransform(), lambda known: RigidTransform(known.X_WB)),
            body_poses=([RigidTransform()], lambda known: body_poses(plant, known.q, known.X_WB)),
            pose_estimate=(None, lambda known: known.estimate),
            proved_optimal=(1, _proved_optimal),
            determined=(nq, lambda known: self._intervals(known)[0]),
            lower=(nq, lambda known: self._intervals(known)[1]),
            upper=(nq, lambda known: self._intervals(known)[2]),
            mode_positions=(mode_limit * nq, self._mode_positions),
        )

    def next_belief(self, context: Context, last: MatcherState) -> MatcherState:
        """Return the state after matching the context's images, given the last state."""
        images, labels = self._images(context), self._labels(context)
        masks = {name: label_image_to_mask(image, labels) for name, image in images.items()}
        masks = {name: mask for name, mask in masks.items() if mask.any()}
        pictures = self._pictures(context)
        shown, stale, late = _compare(pictures | masks, last.shown)
        if not self._follows and late < {*pictures, *masks} - stale:
            stale |= late
        names = [one for one in self._cameras if one.name in masks and one.name not in stale]
        views = [View(one, masks[one.name]) for one in names]
        pictures = {name: one for name, one in pictures.items() if name not in stale}
        estimate, memory, is_shown = self._find(context, views, pictures, late, last.memory)
        pose = estimate if estimate is not None and is_shown else last
        return MatcherState(pose.q, pose.X_WB, estimate, memory, shown, stale)

    def with_intervals(self, context: Context) -> PoseEstimate:
        """Return the pose of the last update with intervals, at the cost of an update if tracked.

        There must be one.
        """
        estimate = self.belief(context).estimate
        assert estimate is not None, "nothing was matched"
        return estimate

    def _pictures(self, context: Context) -> dict[str, Picture]:
        """Return the pictures (H, W, 4) in a context, by name of the camera."""
        return {}

    def _find(
        self, context: Context, views: Sequence[View], pictures: Mapping[str, Picture],
        late: Collection[str], memory: Any,
    ) -> tuple[PoseEstimate | None, Any, bool]:  # fmt: skip
        """Return the pose that is seen, None without evidence; next memory; whether to show it.

        ``views``: the cameras that see the body. ``pictures``: (H, W, 4) by name of the camera.
        ``late``: names of the cameras whose picture may be late by up to a period. ``memory``:
        ``MatcherState.memory`` of the last update.
        """
        if not views:
            return None, memory, False
        found = self._search.match(views, self.eval_input(context, "root_position"))
        return found, memory, found.found

    def _shows(self, known: MatcherState) -> Mask:
        """Return whether the last update's pictures determine each position (nq,)."""
        if _pose_set(known) is not None:
            return np.asarray(self._intervals(known)[0] == 1.0)
        return np.full(len(known.q), known.estimate is not None and known.estimate.found)

    def _shown_covariance(self, known: MatcherState) -> Array:
        """Return the output ``covariance``, NaN where no position is estimated."""
        shown = self._shows(known)
        covariance = np.where(shown & shown[:, None], self._covariance(known), np.nan)
        return covariance.ravel()

    def _covariance(self, known: MatcherState) -> Array:
        """Return the covariance (nq, nq) of the positions, NaN if unknown."""
        widths = np.abs(self._intervals(known)[1:] - known.q).max(axis=0)
        return np.diag(np.square(widths / RobustSettings().significance))

    def _intervals(self, known: MatcherState) -> Array:
        """Return the outputs ``determined``, ``lower`` and ``upper`` (3, nq)."""
        found = _pose_set(known)
        if found is None:
            return np.full((3, len(known.q)), np.nan)
        return found.position_intervals(self._search.tree)

    def _mode_positions(self, known: MatcherState) -> Array:
        """Return the output ``mode_positions``."""
        found, modes = _pose_set(known), np.full((self._mode_limit, len(known.q)), np.nan)
        for k, mode in enumerate(found.modes[: self._mode_limit] if found else ()):
            modes[k] = mode.q
        return modes.ravel()


def _pose_set(known: MatcherState) -> PoseSet | None:
    """Return the pose set of the last update; None: no pose was found, or not examined."""
    estimate = known.estimate
    return estimate.pose_set if estimate is not None and estimate.found else None


def _proved_optimal(known: MatcherState) -> list[float]:
    """Return the output ``proved_optimal`` (1,)."""
    one = known.estimate
    return [np.nan if one is None or _pose_set(known) is None else float(one.proved_optimal)]


def _compare(
    evidence: Mapping[str, Picture | Mask], last: Mapping[str, _Shown]
) -> tuple[dict[str, _Shown], set[str], set[str]]:
    """Return what is known of the pictures ``evidence``, and the names of stale and of late ones.

    The mappings are by name of the camera; ``last``: what was known before this update. A picture
    is late if it is new, but was held before: its time is unknown.
    """
    now = {name: _Shown(zlib.crc32(one.tobytes())) for name, one in evidence.items()}
    same = {k for k, one in now.items() if k in last and last[k].checksum == one.checksum}
    is_moving, stale, late = len(same) < len(now), set[str](), set[str]()
    for name, one in now.items():
        _, age, held = last.get(name, one)
        age = max(age, 0) + 1 if name in same else min(age, 0) - 1
        held = max(held, age) if is_moving else held
        if age > 0 and (is_moving or age <= held):
            stale.add(name)
        elif age < 0 < held:
            late.add(name)
        now[name] = one._replace(age=age, held=held if -age * LEVEL < 1.0 else 0)
    return {**last, **now}, stale, late


def _statistics(known: MatcherState) -> Array:
    """Return the elements of STATISTICS (8,): differences are infinite without a pose."""
    values, estimate = np.zeros(len(STATISTICS)), known.estimate
    values[1:4] = np.inf
    if estimate is not None:
        limit = max(estimate.outside_limit, default=0.0)
        values[4:7] = estimate.runs, limit, estimate.seconds
        if estimate.found:
            values[:4] = 1.0, estimate.J, estimate.E_total, estimate.first_E_total
    values[-1] = len(known.stale)
    return values


TRACK = ("tracked", "matches", "distance")
"""Names of the elements of the output port ``track``."""


class _Memory(NamedTuple):
    """The state of a SilhouetteTracker."""

    tracker_state: TrackerState  # State of the ``Tracker``.
    track: tuple[float, float, float]  # Elements of TRACK.
    time: float  # Time of the last update [s].


class SilhouetteTracker(SilhouetteMatcher):
    """Estimates the positions of a moving body: matched at first and after a loss, else tracked.

    .. pydrake_system::

        name: SilhouetteTracker
        input_ports: [label_image, root_position (optional), measured_positions (optional),
          first_positions (optional), color_image (of color_cameras)]
        output_ports: [estimated_positions, covariance, last_positions, E_total, error, base_pose,
          body_poses, statistics, proved_optimal, determined, lower, upper, mode_positions,
          pose_estimate, position_deviations, estimated_state, track]

    A periodic update tracks or searches for the pose; output ports read the result. Ports and
    arguments are those of ``SilhouetteMatcher``, which it can replace in a diagram, and those
    below. All state is in the context. Delays of up to a period widen the track along its motion.

    Input ports:
        color_image (ImageRgba8U): ``color_image_<camera>`` with several cameras; for the cameras in
            ``color_cameras``. The colours along the body's contour are used if there is no label
            image, or none with a pixel of the body. One label image of the first frame is enough,
            or none if measured positions say where the body is at first.
        measured_positions (nq): approximate positions now, for example of encoders; NaN if unknown.
            The track starts from them, also after a loss. The search is used only if the masks do
            not fit them, and replaces them only by a pose that explains the masks.
        first_positions (nq): approximate positions in the first image; ignored later.

    Output ports:
        estimated_positions (nq): NaN while the pose is only predicted, and for positions that the
            pictures of the last update alone do not determine (hidden links).
        covariance (nq x nq, row by row): the track's; NaN where the estimated positions are.
        last_positions (nq): found or predicted, never NaN.
        position_deviations (nq): standard deviation of each of the last positions [rad or m]; NaN
            for positions that are not tracked (fixed, or solved from the root's pose). Positions of
            parts that are not seen are predicted, and their deviations grow. Joints that a search
            did not determine in masks with defects have the deviations of their limits, until masks
            come that noise of their edges explains; the body is then searched again.
        estimated_state (nq + nv): the last positions, then the plant's velocities [rad/s or m/s];
            velocities are NaN without a track and where ``position_deviations`` are. The filter's
            rates decay with the time constant ``tracking.memory``: in steady motion at 30 Hz they
            are a fifth too small with the default of 0.15 s, and right with 5 s.
        track (3): see ``TRACK``. ``tracked`` is 1 if the last pose was tracked, 0 if it was
            searched or only predicted (``E_total`` is infinite then). ``matches`` is the number of
            searches. ``distance`` is the robust root mean square distance of the body's contour
            from the edges [pixel].

    ``tracking``: settings of the tracker; None: TrackingSettings(). ``color_cameras``: names of the
    cameras that have a port for a colour image. ``search_time``: time limit of a
    ``MultiStartSearch`` [s]; a search that reaches it is repeated in the next updates. None: no
    limit.

    Raises SettingsError: as for ``SilhouetteMatcher``; in a simulation: time runs backwards.
    UnknownNameError: a name in ``color_cameras`` is no camera's.
    """

    _first_memory = _Memory(TrackerState(), (0.0, 0.0, 0.0), -np.inf)
    _follows = True

    def __init__(
        self,
        search: PoseSearch,
        cameras: Sequence[Camera] | Mapping[str, Camera],
        period: float,
        labels: Collection[int] | None = None,
        tracking: TrackingSettings | None = None,
        color_cameras: Collection[str] = (),
        search_time: float | None = 5.0,
        mode_limit: int = MODE_LIMIT,
    ) -> None:
        super().__init__(search, cameras, period, labels, mode_limit)
        cameras, self._period = camera_tuple(cameras), period
        self._follower = Tracker(search.tree, cameras, period, tracking, search, search_time)
        model, moving = search.tree.model, self._follower.observation.layout.moving
        nq = len(model.position_names)
        # (nq, m) positions by the moving elements of the filter's state; the root's move none.
        self._moves = np.array([[float(a == b) for b in moving] for a in model.position_names])
        for coupled, leader, multiplier, _ in search.tree.followers:
            self._moves[coupled] = multiplier * self._moves[leader]
        # (m,) half of the limits' span, or of a turn; 1 m for the root's elements.
        spans = dict(zip(model.position_names, 0.5 * (model.upper - model.lower), strict=True))
        self._widest = np.array([spans.get(name, 1.0) for name in moving])
        self.add_input("measured_positions", nq)
        self.add_input("first_positions", nq)
        require_known("camera", color_cameras, [one.name for one in cameras], "color_cameras")
        self._colours = self.add_images("color_image", ImageRgba8U, cameras, color_cameras)
        self.add_belief_output(
            "position_deviations", nq, lambda known: np.sqrt(np.diag(self._covariance(known)))
        )
        self.add_belief_output("estimated_state", model.plant.num_multibody_states(), self._state)
        self.add_belief_output("track", len(TRACK), lambda known: known.memory.track)

    def _pictures(self, context: Context) -> dict[str, Picture]:
        """Return the pictures (H, W, 4) in a context, by name of the camera."""
        # Views of the images' writable data, as compiled kernels require.
        images = self._colours(context)
        return {name: one.mutable_data for name, one in images.items() if one.size()}

    def _find(
        self, context: Context, views: Sequence[View], pictures: Mapping[str, Picture],
        late: Collection[str], memory: _Memory,
    ) -> tuple[PoseEstimate | None, _Memory, bool]:  # fmt: skip
        """Return the tracked or searched pose, None before any evidence; next memory; as above.

        A track predicts a pose that is not found.
        """
        last, root_position = memory.tracker_state, self.eval_input(context, "root_position")
        if not views and not pictures and last.track is None:
            return None, memory, False
        require_time_forward(self, context, memory.time)
        ports = ["measured_positions", *(["first_positions"] if last.track is None else [])]
        starts = (self.eval_input(context, port) for port in ports)
        start = next((q for q in starts if q is not None and np.isfinite(q).all()), None)
        now, result = self._follower.update(last, views, root_position, pictures, start)
        if late and now.track is not None:
            now = replace(now, track=self._follower.delayed(now.track))
        is_tracked = result.stopped_by == TRACKED and now.matches == last.matches
        measurement = None if now.track is None else now.track.measurement
        distance = np.nan if measurement is None else measurement.distance
        track = float(result.found and is_tracked), float(now.matches), distance
        is_shown = result.found or now.track is not None
        return result, _Memory(now, track, context.get_time()), is_shown

    def with_intervals(self, context: Context) -> PoseEstimate:
        """Return the pose of the last update with intervals, at the cost of an update."""
        state = self.belief(context).memory.tracker_state
        return self._follower.with_intervals(state, super().with_intervals(context))

    def _shows(self, known: MatcherState) -> Mask:
        """Return whether the last update's pictures determine each position (nq,)."""
        shows, state = super()._shows(known), known.memory.tracker_state
        track = state.track
        if track is None or track.measurement is None or not known.was_tracked:
            return shows
        # Their information alone, in place of the prediction beside limits.
        slopes = track.measurement.H[:, : self._moves.shape[1]]
        alone = np.linalg.inv(slopes.T @ slopes + np.diag(1.0 / self._widest**2))
        spread = 0.0 if state.spread is None else state.spread[: len(alone)]
        width = 2.0 * RobustSettings().significance * np.sqrt(np.diag(alone) + spread**2)
        undetermined = self._moves[:, width > self._widest].any(axis=1)
        return np.asarray(shows & self._moves.any(axis=1) & ~undetermined)

    def _covariance(self, known: MatcherState) -> Array:
        """Return the covariance (nq, nq) of the last positions, NaN if they are not tracked."""
        moves, belief = self._moves, known.memory.tracker_state.belief
        if belief is None:
            return np.full((len(moves), len(moves)), np.nan)
        own = np.arange(moves.shape[1])
        covariance = moves @ belief.covariance[np.ix_(own, own)] @ moves.T
        covariance[~moves.any(axis=1)] = np.nan
        return covariance

    def _state(self, known: MatcherState) -> Array:
        """Return the output ``estimated_state`` (nq + nv,): q, then velocities."""
        plant, track = self._search.tree.model.plant, known.memory.tracker_state.track
        qdot, count = np.full(len(known.q), np.nan), self._moves.shape[1]
        if track is not None:
            rates = self._moves @ track.state.best.mean[count : 2 * count] / self._period
            qdot = np.where(self._moves.any(axis=1), rates, np.nan)
        plant_context = plant.CreateDefaultContext()
        plant.SetPositions(plant_context, known.q)
        return np.concatenate([known.q, plant.MapQDotToVelocity(plant_context, qdot)])
