"""A recorded sequence fitted as a whole: proportions and all poses at once, with how sure they are.

Poses that follow one another smoothly, the proportions that they share and what is usual are fitted
together by Levenberg and Marquardt's method (a smoother). Of several starts, those that explain the
sequence about as well as the best are kept: one parallel view cannot tell them apart, as it looks
the same mirrored in depth. These starts are poses that explain the first frame, followed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.filtering.contour_tracker import ContourObservation, ContourTracker, Track
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
    """How a recorded sequence is fitted; chosen on ``hand_sequences``.

    Args:
        same: fits are one whose angles differ by less, root mean square over all frames [rad].
        triangles: of each rigid part.
        spacing: distance between two points of a silhouette's edge [pixel].
        rounds: the parts of a fit [pixel].
        memory: pictures closer in time say the same; together they count as one [s].
        deviation, correlation: standard deviation of the body's contour about a mask's edge, and
            the length of contour whose errors are alike [pixel]: flesh is not that of who is seen,
            along a finger's bone.
        start_frames: frames through which starts are followed.
        tilt: starts are tilted by this about both axes of the picture, either way [rad].
        settling: comparisons of a start with the first frame.
        apart: starts that are closer are one [rad].
        worse_start: starts whose E_total in the first frame exceeds the best by more are dropped.
        followed_starts, fitted_starts: starts that are followed, and fitted, at most.
        prior_weight: E_total that a squared deviation of a joint from its usual angle counts as.
        worse_fit: fits whose cost is more than this multiple of the best one's are dropped: with
            flesh that is not the hand's the better of two fits may be the wrong one.
        interval_factor: of the standard deviations of intervals. Errors of flesh are alike in all
            frames: without it 80 to 99 % of the joints lay in 95 % intervals, 68 % in ``grasp``.
    """

    same: float = 0.1
    triangles: int = 160
    spacing: float = 2.0
    rounds: tuple[AnnealingStage, ...] = (
        AnnealingStage(15.0, 3.0, 6),
        AnnealingStage(6.0, 3.0, 8),
        AnnealingStage(3.0, 3.0, 20),
    )
    memory: float = 0.15
    deviation: float = 2.0
    correlation: float = 75.0
    start_frames: int = 90
    tilt: float = 0.7
    settling: int = 4
    apart: float = 0.2
    worse_start: float = 0.03
    followed_starts: int = 6
    prior_weight: float = 0.0003
    fitted_starts: int = 6
    worse_fit: float = 1.3
    interval_factor: float = 1.6


SEQUENCE = SequenceSettings()


@dataclass(frozen=True, eq=False)
class TrackedStart:
    """A start and how well the frames after it are explained.

    Args:
        states: (n,) the state in each frame.
        track: in the last frame followed.
        errors: E_total of each frame.
        prior_distances: of each frame, see ``ContourObservation.prior_distance``.
    """

    states: tuple[Array, ...]
    track: Track
    errors: tuple[float, ...]
    prior_distances: tuple[float, ...]

    @property
    def x(self) -> Array:
        """(n,) the state in the first frame."""
        return self.states[0]

    @property
    def cost(self) -> float:
        """What tells the better of two."""
        return float(np.mean(self.errors)) + SEQUENCE.prior_weight * float(
            np.mean(self.prior_distances)
        )


def tilted(observation: ContourObservation, x: Array, tilt: Sequence[float]) -> Array:
    """(n,) a state whose root is turned about the axes x, y of the first camera's picture [rad].

    Raises:
        SettingsError: the tree's root does not turn freely.
    """
    R_WC = observation.cameras[0].X_WC[:3, :3]
    turn = Rotation.from_rotvec(R_WC @ np.array([tilt[0], tilt[1], 0.0])).as_matrix()
    return observation.turned(x, turn)


def find_start(
    tracker: ContourTracker,
    x: Array,
    masks: Sequence[Sequence[Mask | None]],
) -> list[TrackedStart]:
    """The poses to be followed in frames of all cameras' masks, best first, from a state (n,)."""
    observation = tracker.observation
    steps = (0.0, SEQUENCE.tilt, -SEQUENCE.tilt)
    candidates = []
    for tilt in [(a, b) for a in steps for b in steps]:
        track = tracker.start(tilted(observation, x, tilt))
        for _ in range(SEQUENCE.settling):
            track = tracker.follow(tracker.start(track.state.best.mean), masks[0], first=True)
        candidates.append(_judged(observation, track, masks[0]))
    candidates.sort(key=lambda one: one.cost)
    kept: list[TrackedStart] = []
    for one in candidates:
        if (
            one.errors[0] > candidates[0].errors[0] + SEQUENCE.worse_start
            or len(kept) >= SEQUENCE.followed_starts
        ):
            continue
        moving = len(observation.layout.moving)
        if all(np.abs(one.x - other.x)[:moving].max() > SEQUENCE.apart for other in kept):
            kept.append(one)
    for frame in masks[1 : SEQUENCE.start_frames]:
        kept = [_judged(observation, tracker.follow(one.track, frame), frame, one) for one in kept]
    return sorted(kept, key=lambda one: one.cost)


def _judged(
    observation: ContourObservation,
    track: Track,
    masks: Sequence[Mask | None],
    before: TrackedStart | None = None,
) -> TrackedStart:
    """A start and what it has explained, one frame more."""
    x = track.state.best.mean
    pairs = zip(observation.cameras, masks, strict=True)
    seen = [(camera, mask) for camera, mask in pairs if mask is not None]
    wrong, area = observation.difference(x, seen)
    error, prior = wrong / max(area, 1), observation.prior_distance(x)
    if before is None:
        return TrackedStart((x,), track, (error,), (prior,))
    return TrackedStart(
        (*before.states, x), track, (*before.errors, error), (*before.prior_distances, prior)
    )


@dataclass(frozen=True, eq=False)
class FittedSequence:
    """One explanation of a sequence: its proportions, and its pose in every frame.

    deviations: (frames, k) of the tree's values and ROOT_NAMES.
    """

    body: ProportionedBody
    fitted: Solution
    deviations: Array

    def estimates(self, frame: int) -> tuple[JointEstimate, ...]:
        """What is known of each of the tree's values in a frame."""
        kinematics = self.body.kinematics
        count, around = len(kinematics.names), kinematics.turns_around
        values = self.fitted.parameters[frame, :count]
        half = 1.96 * SEQUENCE.interval_factor * self.deviations[frame, :count]
        half = np.where(around, np.minimum(half, np.pi), half)
        low = np.where(around, values - half, np.maximum(values - half, kinematics.lower))
        high = np.where(around, values + half, np.minimum(values + half, kinematics.upper))
        return joint_estimates(kinematics, low, high, _are_determined(kinematics, low, high))


def fit_sequence(
    tracker: ContourTracker,
    masks: Sequence[Mask],
    starts: Sequence[Sequence[Array]],
    period: float,
) -> list[FittedSequence]:
    """The explanations of a sequence of one camera's masks, best first.

    Args:
        masks: of the frames, three or more.
        starts: for each start the states (n,) in all frames.
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
        apart = period * float(frames[1] - frames[0])
        worth = min(1.0, apart / SEQUENCE.memory)
        noise = Noise(SEQUENCE.deviation, SEQUENCE.correlation / worth)
        rounds = SEQUENCE.rounds[-1:] if last else SEQUENCE.rounds
        usual, rest_time = observation.usual, tracker.settings.rest_time
        information = (0.0 if rest_time is None else apart / rest_time) / usual.deviation**2
        names = observation.layout.moving
        accelerations = np.array([tracker.acceleration(name) for name in names]) * apart**2
        prior = sequence_prior(len(frames), (usual.phi, usual.mean, information), accelerations)
        seen = [edges[k] for k in frames.tolist()]
        limits = _limits(observation)
        found = fit_proportions(body, camera, seen, begin, rounds, noise, limits, prior)
        return FittedSequence(body, *found)

    coarse = []
    for states in starts[: SEQUENCE.fitted_starts]:
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
    every = np.arange(len(masks), dtype=np.intp)
    return [
        fit(every, _interpolated(every, picked, one.fitted.parameters[:, : len(body.names)]), True)
        for one in kept
    ]


def pose_set(
    explanations: Sequence[FittedSequence],
    poses: Sequence[tuple[Array, Array, float]],
    frame: int,
) -> PoseSet:
    """What all explanations of a sequence say of a frame.

    Args:
        explanations: best first.
        poses: q (nq,), X_WB (4, 4) and the objective (1) J [pixel] of each in the frame.
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
    """Whether two fits are the same explanation: no value is far off in all frames together."""
    kinematics = one.body.kinematics
    count = len(kinematics.names)
    values, others = one.fitted.parameters[:, :count], other.fitted.parameters[:, :count]
    off = (kinematics.nearest_turns(values, others) - others)[:, kinematics.is_angle]
    return bool(np.sqrt(np.square(off).mean(axis=0)).max(initial=0.0) < SEQUENCE.same)


def _are_determined(kinematics: TreeKinematics, low: Array, high: Array) -> Array:
    """Which intervals are shorter than half a value's range, that of an angle a turn at most."""
    ranges = np.minimum(kinematics.upper - kinematics.lower, 2.0 * np.pi)
    return np.asarray(high - low < 0.5 * ranges)


def _limits(observation: ContourObservation) -> tuple[Array, Array]:
    """(p,) lower and upper limits of what moves."""
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


def _interpolated(every: Indices, picked: Indices, parameters: Array) -> Array:
    """(frames, n) parameters between those of some frames, and beyond as in the last of them."""
    return np.column_stack([np.interp(every, picked, column) for column in parameters.T])
