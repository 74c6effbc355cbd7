"""A body's poses in all frames and the cameras that nobody measured, fitted together.

Cameras that are found from estimated joint positions are off with them. So all are fitted to all
silhouettes at once (bundle adjustment), lengths and girths that all frames share among them;
cameras whose places are known hold the whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.contour_fit import Noise
from drake_pose.fit.covariance import distances_in_pictures, estimate_sizes, values_covariance
from drake_pose.fit.frames_fit import FittedFrames, FramesFit, parameter_names
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import CAMERA_NAMES, GIRTH_PREFIX, BodyParameters
from drake_pose.fit.unknowns import Unknowns, choose, join
from drake_pose.registration.posed_frames import SeenFrame, common_size, middle_of
from drake_pose.registration.shared_fit import (
    POSE_NAMES,
    PRIOR_DEVIATION,
    STEPS,
    pose_covariance,
)
from drake_pose.silhouette.areas.outline import Outline

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FIRST = (AnnealingStage(0.08, 0.02), AnnealingStage(0.06, 0.02, 3))
# Then as fine as the model is like the body: the finest at which so much of the contours fits.
_SCALES, _FITS = (0.04, 0.03, 0.02, 0.01, 0.005), 0.7
_SPACING, _ITERATIONS = 0.015, 6
# From one point of a silhouette's edge to the next [root of the silhouettes' area].
_EDGE_SPACING = 1.0 / 150.0
# Known beforehand: estimated angles [rad], places and lengths [m], logarithms of girths.
_ANGLE, _PLACE, _LENGTH, _GIRTH = 0.5, 0.5, 0.03, 0.15
# Against contours that err by about so much along about so much [pixel].
_POINT_ERROR, _ERROR_LENGTH = 4.0, 100.0
# The covariance is that of so many frames, and so many distances in them, several an unknown: a
# surface that is not the body's is so in all frames. How far it is off shows at a scale at which
# nothing is left out because it is off.
_TELLING_FRAMES, _MOST_DISTANCES, _UNCUT = 4, 1000, AnnealingStage(0.08, 0.015)


@dataclass(frozen=True, eq=False)
class CommonShape:
    """What of a body is unknown, but the same in all frames.

    Args:
        lengths: (m,) which of the pose tree's values are lengths of its parts.
        parts: names of the parts that have a girth: how wide they are across their y axes.
        groups: (nodes,) which of these each node belongs to, or -1.
    """

    lengths: Mask
    parts: Sequence[str] = ()
    groups: Sequence[int] = field(default_factory=tuple)


@dataclass(frozen=True, eq=False)
class AdjustedBundle:
    """What was fitted together.

    Args:
        cameras: those that were unknown, with their poses.
        covariances: (c, 6, 6) of these poses' errors, as of ``RegisteredCamera``.
        values: (frames, m) the body's, lengths among them [rad or m].
        girths: (nodes,) how many times as wide the nodes are across their y axes.
    """

    cameras: tuple[PinholeCamera, ...]
    covariances: Array
    values: Array
    girths: Array


class BundleAdjustment:
    """Fits poses and cameras together.

    Args:
        cameras: all cameras, those that are unknown near where they stand.
        frames: what they see, and about which values of the body.

    Raises:
        MaskError: a mask of another size than its camera's picture, or no mask shows the body.
    """

    def __init__(
        self,
        kinematics: TreeKinematics,
        outlines: Sequence[Outline],
        cameras: Sequence[PinholeCamera],
        unknown: Sequence[str],
        frames: Sequence[SeenFrame],
        shape: CommonShape,
    ) -> None:
        self._kinematics, self._cameras = kinematics, tuple(cameras)
        self._start = np.array([frame.values for frame in frames])
        self._size = common_size(cameras, frames)
        groups = shape.groups or [-1] * len(outlines)
        self._body = BodyParameters(kinematics, outlines, groups, shape.parts)
        self._unknown = [k for k, camera in enumerate(cameras) if camera.name in unknown]
        self._own = np.flatnonzero((kinematics.lower < kinematics.upper) & ~shape.lengths)
        self._shape = shape
        self._fit = FramesFit(
            self._body, cameras, self._unknowns(), pivot=middle_of(kinematics, frames),
            noise=Noise.of_a_pixel(self._size), steps=STEPS, pixels=self._size,
        )  # fmt: skip
        self._evidence = [frame.edges(cameras, _EDGE_SPACING * self._size) for frame in frames]

    def fit(self) -> AdjustedBundle:
        """Fits all, in the end as finely as the model is like the body."""
        found = self._fitted([*_FIRST, AnnealingStage(_SCALES[0], _SPACING, _ITERATIONS)], None)
        for scale in _SCALES[1:]:
            tried = self._fitted([AnnealingStage(scale, _SPACING, _ITERATIONS)], found)
            if tried.inlier_ratios[tried.inlier_ratios > 0.0].mean() < _FITS:
                break
            found = tried
        X_CW, _, _ = self._fit.places(found.parameters[0])
        cameras = tuple(
            replace(self._cameras[k], X_WC=np.linalg.inv(X_CW[k])) for k in self._unknown
        )
        girths = np.append(found.shared[self._girths()], 0.0)
        groups = np.array(self._body.groups)
        values = found.parameters[:, : len(self._kinematics.names)]
        covariances = self._covariances(found)
        return AdjustedBundle(cameras, covariances, values, np.exp(girths[groups]))

    def _unknowns(self) -> Unknowns:
        """Each frame's pose; and lengths, girths and cameras of all frames."""
        body, kinematics = self._body, self._kinematics
        worth = _POINT_ERROR * np.sqrt(_ERROR_LENGTH)
        names = np.array(kinematics.names)
        free = np.where(kinematics.is_angle, _ANGLE, _PLACE) / worth
        girths = [name for name in body.names if name.startswith(GIRTH_PREFIX)]
        lengths = np.flatnonzero(self._shape.lengths)
        all_names = parameter_names(body, self._cameras)

        def values(which: NDArray[np.intp], deviation: Array | float, shared: bool) -> Unknowns:
            return choose(
                all_names, names[which].tolist(), shared=shared, lower=kinematics.lower[which],
                upper=kinematics.upper[which], deviation=deviation,
            )  # fmt: skip

        cameras = [f"{self._cameras[k].name}.{name}" for k in self._unknown for name in POSE_NAMES]
        return join(
            values(self._own, free[self._own], shared=False),
            values(lengths, _LENGTH / worth, shared=True),
            choose(all_names, girths, shared=True, deviation=_GIRTH / worth),
            choose(all_names, cameras, shared=True),
        )

    def _girths(self) -> slice:
        """Where among the shared unknowns the girths are."""
        first = int(np.count_nonzero(self._shape.lengths))
        return slice(first, first + len(self._shape.parts))

    def _fitted(self, rounds: Sequence[AnnealingStage], found: FittedFrames | None) -> FittedFrames:
        """Fitted from where an earlier fit ended, or from the start."""
        held, lengths = self._start.copy(), np.flatnonzero(self._shape.lengths)
        held[:, self._own] = held[:, lengths] = 0.0
        shared = np.zeros(len(self._fit.unknowns.names) - len(self._own))
        shared[: len(lengths)] = self._start[0, lengths]
        start = self._start[:, self._own], shared
        own, now = start if found is None else (found.own, found.shared)
        return self._fit.fit(self._evidence, held, own, now, rounds, expected=start)

    def _covariances(self, found: FittedFrames) -> Array:
        """(c, 6, 6) of the unknown cameras' poses."""
        frames = np.unique(
            np.linspace(0, len(self._start) - 1, _TELLING_FRAMES).round().astype(int)
        )
        pictures = self._fit.pictures(
            [self._evidence[k] for k in frames], found.parameters[frames], _UNCUT
        )
        seen = distances_in_pictures(self._body.outlines, pictures, _MOST_DISTANCES)
        own = self._kinematics.is_angle[self._own]
        shared = [name.split(".")[-1] in CAMERA_NAMES[:3] for name in self._fit.unknowns.names]
        is_angle = np.concatenate([np.tile(own, len(frames)), shared[len(own) :]])
        sizes = estimate_sizes(seen, is_angle, prior_deviation=PRIOR_DEVIATION)
        whole = values_covariance(seen, sizes, np.arange(len(is_angle)), is_angle)
        X_CW, _, motions = self._fit.places(found.parameters[0])
        first = len(whole) - len(POSE_NAMES) * len(self._unknown)
        return np.array(
            [
                pose_covariance(X_CW[k], motions[k, :6], whole[at : at + 6, at : at + 6])
                for at, k in zip(range(first, len(whole), 6), self._unknown, strict=True)
            ]
        )
