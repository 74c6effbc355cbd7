"""Several poses from which a track may begin, and which of them a sequence bears out.

One parallel silhouette looks the same mirrored in depth. Poses that explain the first frame are
followed for some frames, and the one that explains these best is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_pose.filtering.body_state import Mask
from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.tracking.contour_tracker import ContourTracker, Track

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StartSettings:
    """How a track's start is chosen.

    Args:
        tilt: the body is tilted by so much about both axes of the picture, either way [rad].
        settling: so often the first frame is compared with each.
        apart: tracks closer than this are one [rad].
        worse: starts whose E_total in the first frame is larger than the best one's by more are
            given up.
        cap: so many are followed at most.
        frames: through so many frames.
    """

    tilt: float = 0.7
    settling: int = 4
    apart: float = 0.2
    worse: float = 0.03
    cap: int = 6
    frames: int = 90


@dataclass(frozen=True, eq=False)
class FollowedStart:
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
        return float(np.mean(self.errors)) + _PRIOR_WEIGHT * float(np.mean(self.prior_distances))


# A joint at its limits (three deviations squared) counts as so much E_total.
_PRIOR_WEIGHT = 0.0003


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
    settings: StartSettings | None = None,
) -> list[FollowedStart]:
    """The poses to be followed in frames of all cameras' masks, best first, from a state (n,)."""
    settings = settings or StartSettings()
    observation = tracker.observation
    steps = (0.0, settings.tilt, -settings.tilt)
    candidates = []
    for tilt in [(a, b) for a in steps for b in steps]:
        track = tracker.start(tilted(observation, x, tilt))
        for _ in range(settings.settling):
            track = tracker.follow(tracker.start(track.state.best.mean), masks[0], first=True)
        candidates.append(_judged(observation, track, masks[0]))
    candidates.sort(key=lambda one: one.cost)
    kept: list[FollowedStart] = []
    for one in candidates:
        if one.errors[0] > candidates[0].errors[0] + settings.worse or len(kept) >= settings.cap:
            continue
        moving = len(observation.layout.moving)
        if all(np.abs(one.x - other.x)[:moving].max() > settings.apart for other in kept):
            kept.append(one)
    for frame in masks[1 : settings.frames]:
        kept = [_judged(observation, tracker.follow(one.track, frame), frame, one) for one in kept]
    return sorted(kept, key=lambda one: one.cost)


def _judged(
    observation: ContourObservation,
    track: Track,
    masks: Sequence[Mask | None],
    before: FollowedStart | None = None,
) -> FollowedStart:
    """A start and what it has explained, one frame more."""
    x = track.state.best.mean
    pairs = zip(observation.cameras, masks, strict=True)
    seen = [(camera, mask) for camera, mask in pairs if mask is not None]
    wrong, area = observation.difference(x, seen)
    error, prior = wrong / max(area, 1), observation.prior_distance(x)
    if before is None:
        return FollowedStart((x,), track, (error,), (prior,))
    return FollowedStart(
        (*before.states, x), track, (*before.errors, error), (*before.prior_distances, prior)
    )
