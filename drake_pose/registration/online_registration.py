"""Register a camera frame by frame while the body moves, and detect that the camera was moved.

A bounded number of keyframes is kept, the newest ones in which the body's pose differs, and the
camera's pose is fitted to them. A pose found without an initial guess is judged by keyframes that
it was not fitted to. Two events show that the camera was moved: outlier frames that
agree with each other, or a significant difference between the pose from the newest keyframes and
that from all. Differences observed while the camera rests set the scale, since wrong joint offsets
or link scales cause differences, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import fdtri

from drake_pose.arrays import Array
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError, SettingsError
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames, placed_points
from drake_pose.registration.register import (
    CameraSearch,
    E_total,
    RegisteredCamera,
    RegistrationBody,
    fits_better,
    overlap_areas,
)
from drake_pose.registration.shared_fit import SHARED


class CameraStatus(IntEnum):
    """Status of a camera: no pose yet; a pose; a pose that the last frames contradict."""

    NOT_REGISTERED = 0
    REGISTERED = 1
    CONTRADICTED = 2


@dataclass(frozen=True)
class OnlineSettings:
    """Which frames are kept, and when a camera counts as moved.

    Raises:
        SettingsError: not 2 <= newest <= least_frames <= most_frames.
    """

    least_frames: int = 5  # Minimum number of keyframes for a search.
    most_frames: int = 12  # Maximum number of keyframes; the newest are kept.
    # Number of newest keyframes, or of outlier frames, that show a motion of the camera.
    newest: int = 3
    # Degrees of freedom of the prior of the covariance's scale. Successive poses are fitted to
    # overlapping newest keyframes, so each adds fewer than the pose's six.
    trust: float = 4.0
    # A frame is a keyframe if the body's points are this far from every keyframe's, root mean
    # square [extent of the body].
    novelty: float = 0.15
    # A frame in the pose of a keyframe is fitted, and replaces it, only if its E_total is larger by
    # more than this [the mask's area].
    tolerance: float = 0.04
    false_alarm: float = 1e-6  # P-value of a difference that counts as a moved camera.

    def __post_init__(self) -> None:
        if not 2 <= self.newest <= self.least_frames <= self.most_frames:
            raise SettingsError(
                "2 <= newest <= least_frames <= most_frames is expected, not "
                f"{self.newest}, {self.least_frames}, {self.most_frames}"
            )


@dataclass(frozen=True, eq=False)
class OnlineState:
    """Immutable state of a registration."""

    # keyframes, outlier_frames: the kept frames, and the latest consecutive outlier frames, the
    # oldest first; the body's pose differs in all of them.
    keyframes: tuple[PosedFrame, ...] = ()
    outlier_frames: tuple[PosedFrame, ...] = ()
    registered: RegisteredCamera | None = None  # The camera's estimated pose; None: not yet known.
    outlier_count: int = 0  # Number of consecutive outlier frames.
    moves: int = 0  # Number of detected motions of the camera.
    # Squared Mahalanobis distances between the poses from the newest and from all keyframes, the
    # latest last.
    distances: tuple[float, ...] = ()

    def __deepcopy__(self, memo: dict[int, Any]) -> "OnlineState":
        # Drake copies abstract state at every update; the masks would be megabytes.
        return self


class OnlineRegistration:
    """Registers a camera while frames come in.

    Args:
        body: the robot's surfaces.
        camera: the camera; its pose is not used.
        settings: thresholds.
        search: finds the camera without an initial guess.
    """

    def __init__(
        self,
        body: RegistrationBody,
        camera: PinholeCamera,
        settings: OnlineSettings | None = None,
        search: CameraSearch | None = None,
    ) -> None:
        self.body, self.camera = body, camera
        self.settings = settings or OnlineSettings()
        self._search = search or CameraSearch(body)

    def status(self, state: OnlineState) -> CameraStatus:
        """Return the status of the camera's pose: CONTRADICTED after `newest` outliers in a row."""
        if state.registered is None:
            return CameraStatus.NOT_REGISTERED
        if state.outlier_count >= self.settings.newest:
            return CameraStatus.CONTRADICTED
        return CameraStatus.REGISTERED

    def next(self, state: OnlineState, frame: PosedFrame) -> OnlineState:
        """Return the state after one more frame, which must not be modified afterwards.

        The initial state is ``OnlineState()``. A frame with an empty mask changes nothing.

        Raises MaskError: the mask's size differs from the camera's.
        """
        if not frame.mask.any():
            return state
        near = self._nearest(frame, state.keyframes)
        if state.registered is not None:
            return self._follow(state, state.registered, frame, near)
        if near is not None:
            return state
        keyframes = self._kept(state.keyframes, frame)
        enough = len(keyframes) >= self.settings.least_frames
        found = self._find(keyframes, 0.0) if enough else None
        if found is None:
            return replace(state, keyframes=keyframes)
        return _registered(state, found, keyframes)

    def _follow(
        self, state: OnlineState, registered: RegisteredCamera, frame: PosedFrame, near: int | None
    ) -> OnlineState:
        """Return the state after one more frame, where the camera's pose is known.

        Args:
            registered: the state's known pose.
            frame: the new frame.
            near: index of the keyframe with the same pose of the body, see `_nearest`, or None.
        """
        if near is not None:
            posed = PosedFrames(self.body.kinematics, self.body.medium, registered.camera, [frame])
            left = E_total(overlap_areas(posed, registered.camera.X_CW[None], np.inf))[0, 0]
            if left <= registered.frames[near].E_total + self.settings.tolerance:
                return replace(state, outlier_frames=(), outlier_count=0)
        keyframes = self._kept(state.keyframes, frame, near)
        again = self._search.refine(registered.camera, keyframes)
        newest = again.frames[-1]
        if not (newest.is_inlier and newest.inlier_ratio >= self._least_inlier_ratio(registered)):
            return self._add_outlier(state, registered, frame)
        # Use the pose from the newest keyframes alone if it differs significantly.
        state = _registered(state, again, keyframes)
        last = state.keyframes[-self.settings.newest :]
        if len(state.keyframes) <= len(last):
            return state
        alone = self._search.refine(again.camera, last)
        if alone.outliers:
            return state
        if self._is_elsewhere(state, alone, again):
            return _registered(state, alone, last, moved=True)
        distances = (*state.distances, _distance(alone, again))
        return replace(state, distances=distances[-2 * self.settings.most_frames :])

    def _add_outlier(
        self, state: OnlineState, registered: RegisteredCamera, frame: PosedFrame
    ) -> OnlineState:
        """Return the state with one more outlier frame.

        If the outlier frames agree with each other, the camera gets the pose that fits them, and
        counts as moved if this differs significantly from the known pose.

        Args:
            registered: the state's known pose, which the frame contradicts.
            frame: the outlier frame.
        """
        near, settings = self._nearest(frame, state.outlier_frames), self.settings
        frames = self._kept(state.outlier_frames, frame, near)
        state = replace(state, outlier_frames=frames, outlier_count=state.outlier_count + 1)
        if near is not None or len(frames) < settings.newest:
            return state
        least = self._least_inlier_ratio(registered)
        # A local fit finds the camera again after a bump, but not after larger motions.
        found: RegisteredCamera | None = self._search.refine(registered.camera, frames)
        assert found is not None
        if not self._is_found(found, settings.newest, least):
            enough = len(frames) >= settings.least_frames
            found = self._find(frames, least) if enough else None
        if found is None:
            return state
        if self._is_elsewhere(state, found, registered):
            return _registered(state, found, frames, moved=True)
        # The difference is within the uncertainty: the pose is corrected with all frames.
        frames = (*state.keyframes, *frames)[-settings.most_frames :]
        return _registered(state, self._search.refine(found.camera, frames), frames)

    def _is_elsewhere(
        self, state: OnlineState, found: RegisteredCamera, registered: RegisteredCamera
    ) -> bool:
        """Return whether pose `found` differs significantly from `registered`.

        Their squared Mahalanobis distance is tested at `false_alarm`, by an F distribution with a
        scale of at least 1 from the state's `distances` without the last `newest` - 1.
        """
        newest, trust = self.settings.newest, self.settings.trust
        # The last distances may contain frames from after the motion.
        usual = state.distances[: max(0, len(state.distances) - newest + 1)]
        freedom = 6.0 / newest * len(usual)
        scale = (trust + freedom / 6.0 * sum(usual) / max(1, len(usual))) / (trust + freedom)
        limit = 6.0 * float(fdtri(6.0, trust + freedom, 1.0 - self.settings.false_alarm))
        return _distance(found, registered) > limit * max(1.0, scale)

    def _find(self, frames: Sequence[PosedFrame], least: float) -> RegisteredCamera | None:
        """Search the camera's pose in frames without an initial guess; None: not determined.

        Frames must agree better with their own joint positions than with those of other frames
        (``fit.judge``), and must not fit better when they are mirrored.

        least: minimum median inlier ratio.
        """
        try:
            found = self._search.register(self.camera, frames)
        except RegistrationError:
            return None
        if not (found.agrees and found.evidence and found.evidence.holds):
            return None
        given, mirrored = self._search.mirrored_costs(found, frames)
        if fits_better(mirrored, given):
            return None
        return found if self._is_found(found, self.settings.least_frames, least) else None

    def _is_found(self, found: RegisteredCamera, count: int, least: float) -> bool:
        """Return whether at least `count` frames, and over half, are inliers of a unique pose.

        Their median inlier ratio must be at least `least`.
        """
        inliers = [frame for frame in found.frames if frame.is_inlier]
        return (
            not len(found.alternatives)
            and len(inliers) >= max(count, len(found.frames) // 2 + 1)
            and float(np.median([frame.inlier_ratio for frame in inliers])) >= least
        )

    def _least_inlier_ratio(self, registered: RegisteredCamera) -> float:
        """Return the minimum inlier ratio of an inlier frame, given the known pose's keyframes.

        It is the same fraction of their median as of a camera's best frames in a fit.
        """
        ratios = [frame.inlier_ratio for frame in registered.frames]
        return SHARED.min_inlier_ratio * float(np.median(ratios))

    def _kept(
        self, frames: Sequence[PosedFrame], frame: PosedFrame, instead_of: int | None = None
    ) -> tuple[PosedFrame, ...]:
        """Return frames with a new one at the end, for `instead_of`; at most `most_frames`."""
        others = [one for k, one in enumerate(frames) if k != instead_of]
        return (*others, frame)[-self.settings.most_frames :]

    def _nearest(self, frame: PosedFrame, frames: Sequence[PosedFrame]) -> int | None:
        """Return the index of the last of `frames` posed within `novelty` of a frame, or None."""
        here = self._points(frame)
        extent = float(np.sqrt(((here - here.mean(axis=0)) ** 2).sum(axis=1).mean()))
        for k in reversed(range(len(frames))):
            off = np.sqrt(((self._points(frames[k]) - here) ** 2).sum(axis=1).mean())
            if off < self.settings.novelty * extent:
                return k
        return None

    def _points(self, frame: PosedFrame) -> Array:
        """Return points (n, 3) of the body's surface in a frame, in the world [m]."""
        return placed_points(self.body.coarse, self.body.kinematics.poses(frame.values))


def pose_difference(X_WC: Array, from_X_WC: Array) -> Array:
    """Return rotation [rad] and shift of the centre [m] (6,), in the world, to X_WC (4, 4)."""
    R = X_WC[:3, :3] @ from_X_WC[:3, :3].T
    turn = Rotation.from_matrix(R).as_rotvec()
    return np.concatenate([turn, X_WC[:3, 3] - from_X_WC[:3, 3]])


def squared_distance(off: Array, covariance: Array) -> float:
    """Return the squared Mahalanobis distance of a difference off (6,) with covariance (6, 6)."""
    return float(off @ np.linalg.solve(covariance, off))


def _registered(
    state: OnlineState, found: RegisteredCamera, frames: Sequence[PosedFrame], moved: bool = False
) -> OnlineState:
    """Return the state with a newly found pose and its inlier frames as keyframes.

    Args:
        state: the previous state; its outlier frames are dropped.
        found: the pose.
        frames: those that it was fitted to, in the order of ``found.frames``.
        moved: whether the camera was moved, which increases `moves`.
    """
    pairs = [
        (one, frame) for one, frame in zip(frames, found.frames, strict=True) if frame.is_inlier
    ]
    kept = replace(found, frames=tuple(frame for _, frame in pairs))
    keyframes = tuple(one for one, _ in pairs)
    return OnlineState(keyframes, (), kept, 0, state.moves + moved, state.distances)


def _distance(found: RegisteredCamera, registered: RegisteredCamera) -> float:
    """Return the squared Mahalanobis distance of two poses, by the first one's own errors."""
    off = pose_difference(found.camera.X_WC, registered.camera.X_WC)
    return squared_distance(off, found.covariance - found.common)
