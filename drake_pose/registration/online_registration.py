"""A camera that is registered while the body moves, and registered again after it was moved.

Frames come one after another. A bounded number of keyframes is kept, in which the body stands
differently, the newest ones; the camera's pose is fitted to them. That the camera was moved shows
in one of two ways: frames contradict the pose and agree with one another, or the pose by the newest
keyframes alone differs significantly from that by all. How much it differs while nothing moves says
what is significant: wrong joint zeros or lengths of links make it differ, too.
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
    overlap_areas,
)


class CameraStatus(IntEnum):
    """What is known of a camera's pose: nothing; the pose; that the last frames contradict it."""

    NOT_REGISTERED = 0
    REGISTERED = 1
    CONTRADICTED = 2


@dataclass(frozen=True)
class OnlineSettings:
    """Which frames are kept, and when the camera has been moved.

    Args:
        least_frames: minimum number of keyframes for a search.
        most_frames: maximum number of keyframes; the newest are kept.
        newest: number of keyframes, or of frames that contradict the pose, that show a move.
        min_inlier_ratio: a frame contradicts the pose if its inlier ratio is below this fraction of
            the keyframes' median.
        bump: a bump turns the camera by no more [rad], and shifts it by no more [its distance from
            the body]: from there a fit leads to the same view. Farther away all poses are searched.
        trust: before anything differed, the covariance is trusted as if this many numbers had borne
            it out; sets of the newest keyframes overlap, so that each new one adds fewer numbers
            than a pose has.
        novelty: a frame is a keyframe where the body's points are this far from where they are in
            all keyframes, root mean square [the body's own extent]; or where
        tolerance: body and mask differ by this more than in the keyframe [the mask's area].
        min_iou: mean intersection over union, below which no camera is believed to be found.
        false_alarm: p-value of a difference that counts as a moved camera.

    Raises:
        SettingsError: not 2 <= newest <= least_frames <= most_frames.
    """

    least_frames: int = 5
    most_frames: int = 12
    newest: int = 3
    min_inlier_ratio: float = 0.7
    bump: float = 0.2
    trust: float = 4.0
    novelty: float = 0.15
    tolerance: float = 0.04
    min_iou: float = 0.5
    false_alarm: float = 1e-6

    def __post_init__(self) -> None:
        if not 2 <= self.newest <= self.least_frames <= self.most_frames:
            raise SettingsError(
                "2 <= newest <= least_frames <= most_frames is expected, not "
                f"{self.newest}, {self.least_frames}, {self.most_frames}"
            )


@dataclass(frozen=True, eq=False)
class OnlineState:
    """What is known of a camera; never changed, so that copies share it.

    Args:
        keyframes, outlier_frames: the frames kept, and the last ones that contradict the pose, the
            oldest first; the body stands differently in all of them.
        registered: the camera as it was found; None: not yet.
        contradictions: how many frames without a gap have contradicted the pose.
        moves: how often the camera was found elsewhere.
        distances: squared Mahalanobis distances of the pose by the newest keyframes alone from that
            by all, the latest last.
    """

    keyframes: tuple[PosedFrame, ...] = ()
    outlier_frames: tuple[PosedFrame, ...] = ()
    registered: RegisteredCamera | None = None
    outlier_count: int = 0
    moves: int = 0
    distances: tuple[float, ...] = ()

    def __deepcopy__(self, memo: dict[int, Any]) -> "OnlineState":
        # Drake copies abstract state, which would be megabytes of masks at every update.
        return self


class OnlineRegistration:
    """Registers a camera while frames come in.

    Args:
        camera: the camera's intrinsics; its pose is not used.
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
        """What is known of the camera's pose."""
        if state.registered is None:
            return CameraStatus.NOT_REGISTERED
        if state.outlier_count >= self.settings.newest:
            return CameraStatus.CONTRADICTED
        return CameraStatus.REGISTERED

    def next(self, state: OnlineState, frame: PosedFrame) -> OnlineState:
        """What is known after another frame, which must not be changed any more.

        One without any pixel of the body says nothing; at first a state is ``OnlineState()``.

        Raises MaskError: a mask of another size than the camera's picture.
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
        found = self._find(keyframes) if enough else None
        if found is None:
            return replace(state, keyframes=keyframes)
        return _registered(state, found, keyframes)

    def _follow(
        self, state: OnlineState, registered: RegisteredCamera, frame: PosedFrame, near: int | None
    ) -> OnlineState:
        """After the camera was found; near: the keyframe in which the body stands alike."""
        if near is not None:
            posed = PosedFrames(self.body.kinematics, self.body.medium, registered.camera, [frame])
            left = E_total(overlap_areas(posed, registered.camera.X_CW[None], np.inf))[0, 0]
            if left <= registered.frames[near].E_total + self.settings.tolerance:
                return replace(state, outlier_frames=(), outlier_count=0)
        keyframes = self._kept(state.keyframes, frame, near)
        again = self._search.refine(registered.camera, keyframes)
        newest = again.frames[-1]
        if not (newest.is_inlier and newest.inlier_ratio >= self._least_inlier_ratio(registered)):
            return self._contradict(state, registered, frame)
        # The pose, or that of the newest keyframes alone where they say otherwise.
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

    def _contradict(
        self, state: OnlineState, registered: RegisteredCamera, frame: PosedFrame
    ) -> OnlineState:
        """Another frame contradicts; the camera elsewhere, where they agree with one another."""
        near, settings = self._nearest(frame, state.outlier_frames), self.settings
        frames = self._kept(state.outlier_frames, frame, near)
        state = replace(state, outlier_frames=frames, outlier_count=state.outlier_count + 1)
        if near is not None or len(frames) < settings.newest:
            return state
        least, X_WC = self._least_inlier_ratio(registered), registered.camera.X_WC
        found: RegisteredCamera | None = self._search.refine(registered.camera, frames)
        assert found is not None
        off = pose_difference(found.camera.X_WC, X_WC)
        distance = np.linalg.norm(X_WC[:3, 3] - self._points(frame).mean(axis=0))
        turn, shift = np.linalg.norm(off[:3]), np.linalg.norm(off[3:]) / distance
        is_bump = max(turn, shift) <= settings.bump
        if not (is_bump and self._is_found(found, settings.newest, least)):
            enough = len(frames) >= settings.least_frames
            found = self._find(frames, least) if enough else None
        if found is None:
            return state
        if self._is_elsewhere(state, found, registered):
            return _registered(state, found, frames, moved=True)
        # What is known of the pose was not worth as much as it seemed.
        frames = (*state.keyframes, *frames)[-settings.most_frames :]
        return _registered(state, self._search.refine(found.camera, frames), frames)

    def _is_elsewhere(
        self, state: OnlineState, found: RegisteredCamera, registered: RegisteredCamera
    ) -> bool:
        """Whether a pose differs from that of before by more than such poses differ by chance."""
        newest, trust = self.settings.newest, self.settings.trust
        # In the last ones there may be frames of the new pose already.
        usual = state.distances[: max(0, len(state.distances) - newest + 1)]
        told = 6.0 / newest * len(usual)
        scale = (trust + told / 6.0 * sum(usual) / max(1, len(usual))) / (trust + told)
        limit = 6.0 * float(fdtri(6.0, trust + told, 1.0 - self.settings.false_alarm))
        return _distance(found, registered) > limit * max(1.0, scale)

    def _find(self, frames: Sequence[PosedFrame], least: float = 0.0) -> RegisteredCamera | None:
        """The camera without a guess; None where it is not determined."""
        try:
            found = self._search.register(self.camera, frames)
        except RegistrationError:
            return None
        return found if self._is_found(found, self.settings.least_frames, least) else None

    def _is_found(self, found: RegisteredCamera, count: int, least: float) -> bool:
        """Whether `count` frames, and more than half, agree, with inlier ratios of `least`."""
        agreeing = [frame for frame in found.frames if frame.is_inlier]
        return (
            not len(found.alternatives)
            and len(agreeing) >= max(count, len(found.frames) // 2 + 1)
            and float(np.mean([frame.iou for frame in agreeing])) >= self.settings.min_iou
            and float(np.median([frame.inlier_ratio for frame in agreeing])) >= least
        )

    def _least_inlier_ratio(self, registered: RegisteredCamera) -> float:
        """Of both contours' lengths, what fits at least in a frame that does not contradict."""
        ratios = [frame.inlier_ratio for frame in registered.frames]
        return self.settings.min_inlier_ratio * float(np.median(ratios))

    def _kept(
        self, frames: Sequence[PosedFrame], frame: PosedFrame, instead_of: int | None = None
    ) -> tuple[PosedFrame, ...]:
        """The newest of some frames and another one, which may stand for one of them."""
        others = [one for k, one in enumerate(frames) if k != instead_of]
        return (*others, frame)[-self.settings.most_frames :]

    def _nearest(self, frame: PosedFrame, frames: Sequence[PosedFrame]) -> int | None:
        """The last of the frames in which the body stands as in another one; None: none does."""
        here = self._points(frame)
        extent = float(np.sqrt(((here - here.mean(axis=0)) ** 2).sum(axis=1).mean()))
        for k in reversed(range(len(frames))):
            off = np.sqrt(((self._points(frames[k]) - here) ** 2).sum(axis=1).mean())
            if off < self.settings.novelty * extent:
                return k
        return None

    def _points(self, frame: PosedFrame) -> Array:
        """(n, 3) of the body in the world."""
        return placed_points(self.body.coarse, self.body.kinematics.poses(frame.values))


def pose_difference(X_WC: Array, from_X_WC: Array) -> Array:
    """(6,) rotation vector and shift along the world's axes from one pose (4, 4) to another."""
    R = X_WC[:3, :3] @ from_X_WC[:3, :3].T
    turn = Rotation.from_matrix(R).as_rotvec()
    return np.concatenate([turn, X_WC[:3, 3] - from_X_WC[:3, 3]])


def squared_distance(off: Array, covariance: Array) -> float:
    """Squared Mahalanobis distance of a difference (6,) from 0, by its covariance (6, 6)."""
    return float(off @ np.linalg.solve(covariance, off))


def _registered(
    state: OnlineState, found: RegisteredCamera, frames: Sequence[PosedFrame], moved: bool = False
) -> OnlineState:
    """The state in which the frames that agree are kept; moved: the camera is elsewhere."""
    pairs = [
        (one, frame) for one, frame in zip(frames, found.frames, strict=True) if frame.is_inlier
    ]
    kept = replace(found, frames=tuple(frame for _, frame in pairs))
    keyframes = tuple(one for one, _ in pairs)
    return OnlineState(keyframes, (), kept, 0, state.moves + moved, state.distances)


def _distance(found: RegisteredCamera, registered: RegisteredCamera) -> float:
    """Squared Mahalanobis distance of a pose from another, by its own covariance."""
    off = pose_difference(found.camera.X_WC, registered.camera.X_WC)
    return squared_distance(off, found.covariance)
