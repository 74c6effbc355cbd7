"""Joint fit of a recorded sequence: link scales and all poses at once, with standard deviations.

A smoother: the motion between poses, the shared proportions and the joints' prior are fitted
together by Levenberg-Marquardt. One parallel view is ambiguous, because it looks the same mirrored
in depth. Therefore several starts are tracked and fitted, and fits whose cost is close to the best
are kept.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.filtering.contour_observation import ContourObservation
from drake_pose.filtering.contour_tracker import Track, Tracker
from drake_pose.fit.contour_fit import Noise
from drake_pose.fit.evidence import find_edge_points
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.problem import Solution
from drake_pose.fit.proportions import ProportionedBody, fit_proportions, sequence_prior
from drake_pose.fit.surfaces import simplify_rigid_parts
from drake_pose.search import JointEstimate, PoseMode, PoseSet, joint_estimates
from drake_pose.silhouette.outline import TreeSurfaces


@dataclass(frozen=True)
class SequenceSettings:
    """Settings of the fit of a recorded sequence; chosen on ``hand_sequences``."""

    # Two fits are the same if the root mean square difference of each angle over all frames is
    # below this [rad].
    same_fit: float = 0.1
    triangles: int = 160  # Number of triangles of each rigid part.
    spacing: float = 2.0  # Distance between two edge points of a silhouette [pixel].
    # Annealing stages of a fit.
    rounds: tuple[AnnealingStage, ...] = (
        AnnealingStage(15.0, 3.0, 6),
        AnnealingStage(6.0, 3.0, 8),
        AnnealingStage(3.0, 3.0, 20),
    )
    # Correlation time of the frames' errors; frames in this time count as one [s].
    memory: float = 0.15
    # deviation, correlation: standard deviation of the body's contour about a mask's edge, and
    # contour length over which errors are correlated [pixel]; the model's flesh differs from the
    # person's along a whole finger bone.
    deviation: float = 2.0
    correlation: float = 75.0
    start_frames: int = 90  # Number of frames through which starts are tracked.
    tilt: float = 0.7  # Starts are tilted by plus and minus this angle about both image axes [rad].
    settling_iterations: int = 4  # Number of comparisons of a start with the first frame.
    start_distance: float = 0.2  # Starts closer than this in all elements are the same [rad].
    # Starts whose E_total in the first frame exceeds the best by more are dropped.
    worse_start: float = 0.03
    tracked_starts: int = 6  # Largest number of starts that are tracked, and then fitted.
    # E_total equivalent of one squared standard deviation of a joint from its prior.
    prior_weight: float = 0.0003
    # Fits with a cost above this multiple of the best are dropped. With a hand of other proportions
    # of flesh, the better of two fits may be the wrong one.
    worse_fit: float = 1.3
    # Factor on the standard deviations of intervals, because flesh errors are the same in all
    # frames. Without it 80 to 99 % of the joints were in their 95 % intervals, in ``grasp`` 68 %.
    interval_factor: float = 1.6


SEQUENCE = SequenceSettings()


@dataclass(frozen=True, eq=False)
class TrackedStart:
    """A start and its track through the following frames."""

    states: tuple[Array, ...]  # State (n,) in each frame.
    track: Track  # The track after the last frame.
    errors: tuple[float, ...]  # E_total in each frame.
    prior_distances: tuple[float, ...]  # ``ContourObservation.prior_distance`` in each frame.

    @property
    def x(self) -> Array:
        """(n,) the state in the first frame."""
        return self.states[0]

    @property
    def cost(self) -> float:
        """The mean E_total plus the weighted prior: lower is better."""
        return float(np.mean(self.errors)) + SEQUENCE.prior_weight * float(
            np.mean(self.prior_distances)
        )


def tilted(observation: ContourObservation, x: Array, tilt: Sequence[float]) -> Array:
    """Return a state x (n,) with its root rotated about the x and y axes of the first camera.

    ``tilt``: x and y of the rotation vector [rad]. SettingsError: the root does not turn freely.
    """
    R_WC = observation.cameras[0].X_WC[:3, :3]
    turn = Rotation.from_rotvec(R_WC @ np.array([tilt[0], tilt[1], 0.0])).as_matrix()
    return observation.turned(x, turn)


def find_start(
    tracker: Tracker, x: Array, masks: Sequence[Sequence[Mask | None]]
) -> list[TrackedStart]:
    """Return tracked starts for a sequence fit, sorted by cost, ascending.

    Nine tilted starts are fitted to the first frame. The best different ones are tracked through
    the following frames.

    ``tracker``: tracker of the body, and its cameras. ``x``: (n,) state in the first frame about
    which starts are tilted. ``masks``: for each frame, for each camera the mask (H, W) or None.
    """
    observation = tracker.observation
    steps = (0.0, SEQUENCE.tilt, -SEQUENCE.tilt)
    candidates = []
    for tilt in [(a, b) for a in steps for b in steps]:
        track = tracker.start(tilted(observation, x, tilt))
        for _ in range(SEQUENCE.settling_iterations):
            track = tracker.follow(tracker.start(track.state.best.mean), masks[0], first=True)
        candidates.append(_evaluated(observation, track, masks[0]))
    candidates.sort(key=lambda one: one.cost)
    kept: list[TrackedStart] = []
    for one in candidates:
        if (
            one.errors[0] > candidates[0].errors[0] + SEQUENCE.worse_start
            or len(kept) >= SEQUENCE.tracked_starts
        ):
            continue
        moving = len(observation.layout.moving)
        if all(np.abs(one.x - other.x)[:moving].max() > SEQUENCE.start_distance for other in kept):
            kept.append(one)
    for frame in masks[1 : SEQUENCE.start_frames]:
        kept = [
            _evaluated(observation, tracker.follow(one.track, frame), frame, one) for one in kept
        ]
    return sorted(kept, key=lambda one: one.cost)


def _evaluated(
    observation: ContourObservation,
    track: Track,
    masks: Sequence[Mask | None],
    before: TrackedStart | None = None,
) -> TrackedStart:
    """Return a start extended by one frame, evaluated on its masks.

    ``track``: the track after the frame. ``masks``: the frame's mask (H, W) or None for each
    camera. ``before``: the start up to the frame before; None: this is the first frame.
    """
    x = track.state.best.mean
    pairs = zip(observation.cameras, masks, strict=True)
    visible = [(camera, mask) for camera, mask in pairs if mask is not None]
    wrong, area = observation.difference(x, visible)
    error, prior = wrong / max(area, 1), observation.prior_distance(x)
    if before is None:
        return TrackedStart((x,), track, (error,), (prior,))
    return TrackedStart(
        (*before.states, x), track, (*before.errors, error), (*before.prior_distances, prior)
    )


@dataclass(frozen=True, eq=False)
class FittedSequence:
    """One explanation of a sequence: proportions and all poses."""

    body: ProportionedBody  # The body whose parameters were fitted.
    fitted: Solution  # The fit; ``parameters`` (frames, n) are those of ``body``.
    deviations: Array  # (frames, k) standard deviations of the tree's values and ROOT_NAMES.

    def estimates(self, frame: int) -> tuple[JointEstimate, ...]:
        """Return each value's estimate in a frame: 95 % intervals in limits, at most one turn."""
        kinematics = self.body.kinematics
        count, around = len(kinematics.names), kinematics.covers_full_turn
        values = self.fitted.parameters[frame, :count]
        half = 1.96 * SEQUENCE.interval_factor * self.deviations[frame, :count]
        half = np.where(around, np.minimum(half, np.pi), half)
        low = np.where(around, values - half, np.maximum(values - half, kinematics.lower))
        high = np.where(around, values + half, np.minimum(values + half, kinematics.upper))
        return joint_estimates(kinematics, low, high, _are_determined(kinematics, low, high))


def fit_sequence(
    tracker: Tracker, masks: Sequence[Mask], starts: Sequence[Sequence[Array]], period: float
) -> list[FittedSequence]:
    """Return the explanations of one camera's masks, sorted by cost, ascending.

    All starts are fitted to frames about ``SEQUENCE.memory`` apart. Fits
    that differ and cost at most ``SEQUENCE.worse_fit`` times the lowest are then fitted to all.

    Args:
        tracker: the body, its first camera, which took the masks, and settings of the motion.
        masks: (H, W) of each frame, three frames or more.
        starts: for each start the states (n,) in all frames, best start first.
        period: time between two frames [s].
    """
    observation = tracker.observation
    surfaces = simplify_rigid_parts(TreeSurfaces(observation.tree), SEQUENCE.triangles)
    body = ProportionedBody(TreeKinematics(observation.tree), surfaces)
    edges = [find_edge_points(mask, SEQUENCE.spacing) for mask in masks]
    step = max(1, min(int(SEQUENCE.memory / period + 1e-9), (len(masks) - 1) // 2))
    picked = np.arange(0, len(masks), step, dtype=np.intp)
    camera = observation.cameras[0]

    def fit(frames: Indices, begin: Array, last: bool) -> FittedSequence:
        """Fit the frames from parameters (frames, k); ``last``: by the last stage only."""
        time_step = period * float(frames[1] - frames[0])
        weight = min(1.0, time_step / SEQUENCE.memory)
        noise = Noise(SEQUENCE.deviation, SEQUENCE.correlation / weight)
        rounds = SEQUENCE.rounds[-1:] if last else SEQUENCE.rounds
        joints, rest_time = observation.prior, tracker.settings.rest_time
        information = (0.0 if rest_time is None else time_step / rest_time) / joints.deviation**2
        accelerations = tracker.accelerations * time_step**2
        prior = sequence_prior(len(frames), (joints.phi, joints.mean, information), accelerations)
        used = [edges[k] for k in frames.tolist()]
        limits = _limits(observation)
        found = fit_proportions(body, camera, used, begin, rounds, noise, limits, prior)
        return FittedSequence(body, *found)

    coarse = []
    for states in starts:
        begin = np.array([observation.parameters(states[k]) for k in picked.tolist()])
        coarse.append(fit(picked, begin, False))
    coarse.sort(key=lambda one: one.fitted.cost)
    kept: list[FittedSequence] = []
    for one in coarse:
        near = one.fitted.cost <= SEQUENCE.worse_fit * coarse[0].fitted.cost
        if near and not any(_are_same(one, other) for other in kept):
            kept.append(one)
    if step == 1:
        return kept
    every, refined = np.arange(len(masks), dtype=np.intp), []
    for one in kept:
        # The picked frames' parameters, interpolated at every frame and constant beyond them.
        columns = one.fitted.parameters[:, : len(body.names)].T
        begin = np.column_stack([np.interp(every, picked, column) for column in columns])
        refined.append(fit(every, begin, True))
    return refined


def pose_set(
    explanations: Sequence[FittedSequence], poses: Sequence[tuple[Array, Array, float]], frame: int
) -> PoseSet:
    """Return the pose set of a frame: one mode per explanation, and joint intervals.

    ``explanations``: the result of ``fit_sequence``, best first. ``poses``: for each explanation q
    (nq,), X_WB (4, 4) and the objective (1) J [pixel] in this frame. ``frame``: index of the frame.
    """
    modes = []
    for one, (q, X_WB, J) in zip(explanations, poses, strict=True):
        kinematics = one.body.kinematics
        values = kinematics.split(one.fitted.parameters[frame, : len(kinematics.names)])
        modes.append(PoseMode(q, X_WB, values, J, one.estimates(frame), 1.0))
    kinematics = explanations[0].body.kinematics
    low, high = (
        extreme([[getattr(joint, end) for joint in one.joints] for one in modes], axis=0)
        for end, extreme in (("low", np.min), ("high", np.max))
    )
    joints = joint_estimates(kinematics, low, high, _are_determined(kinematics, low, high))
    return PoseSet(tuple(modes), joints, 0.0, False, len(modes))


def _are_same(one: FittedSequence, other: FittedSequence) -> bool:
    """Return whether two fits of the same frames are the same; see ``SequenceSettings.same_fit``.

    Angles a full turn apart are equal; lengths are not compared.
    """
    kinematics = one.body.kinematics
    count = len(kinematics.names)
    values, others = one.fitted.parameters[:, :count], other.fitted.parameters[:, :count]
    off = (kinematics.nearest_turns(values, others) - others)[:, kinematics.is_angle]
    return bool(np.sqrt(np.square(off).mean(axis=0)).max(initial=0.0) < SEQUENCE.same_fit)


def _are_determined(kinematics: TreeKinematics, low: Array, high: Array) -> Array:
    """Return (k,) bool, whether the interval from ``low`` to ``high`` (k,) determines its value.

    It does if it is shorter than half of the value's limits, or of a full turn if they are wider.
    """
    ranges = np.minimum(kinematics.upper - kinematics.lower, 2.0 * np.pi)
    return np.asarray(high - low < 0.5 * ranges)


def _limits(observation: ContourObservation) -> tuple[Array, Array]:
    """Return lower and upper limits (p,) [rad or m] of the p moving elements of the state."""
    names, limits = list(observation.layout.moving), observation.inequalities()
    lower, upper = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    for phi, b in zip(limits.for_columns(names).phi, limits.b, strict=True):
        if np.count_nonzero(phi) == 1:
            k = int(np.flatnonzero(phi)[0])
            if phi[k] > 0:
                upper[k] = min(upper[k], b / phi[k])
            else:
                lower[k] = max(lower[k], b / phi[k])
    return lower, upper
