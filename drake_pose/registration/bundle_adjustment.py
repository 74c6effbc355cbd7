"""A body's poses in all frames and the cameras that nobody measured, fitted together.

Cameras that are found from estimated joint positions are off with them. So all are fitted to all
silhouettes at once (bundle adjustment), lengths and girths that all frames share among them;
cameras whose places are known hold the whole.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.camera_sums import Views
from drake_pose.fit.contour_fit import Noise, compare_views, pixels_per_metre
from drake_pose.fit.covariance import (
    Picture,
    distances_in_pictures,
    estimate_sizes,
    values_covariance,
)
from drake_pose.fit.evidence import NO_EDGE, Evidence, find_edge_points, pack_evidence
from drake_pose.fit.frames_fit import FittedFrames, FramesFit
from drake_pose.fit.levenberg_marquardt import AnnealingStage, StepSettings
from drake_pose.fit.parameters import (
    CAMERA_NAMES,
    GIRTH_PREFIX,
    BodyParameters,
    CameraParameters,
)
from drake_pose.fit.unknowns import Unknowns, choose, join
from drake_pose.registration.camera_fit import POSE_NAMES
from drake_pose.registration.per_frame_fit import SeenFrame, common_size
from drake_pose.registration.uncertainty import pose_covariance
from drake_pose.silhouette.areas.outline import Outline

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FIRST = (AnnealingStage(0.08, 0.02), AnnealingStage(0.06, 0.02, 3))
# Then as fine as the model is like the body: the finest at which so much of the contours fits.
_SCALES, _FITS = (0.04, 0.03, 0.02, 0.01, 0.005), 0.7
_SPACING, _ITERATIONS = 0.015, 6
_STEPS = StepSettings(longest=0.3, damping=1e-2, even_damping=1e-6)
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
# Sizes of errors are known beforehand to a factor of twenty; the contours tell them.
_PRIOR_DEVIATION = 3.0


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
        places = [kinematics.poses(values)[:, :3, 3].mean(axis=0) for values in self._start]
        self._pivot = np.mean(places, axis=0)
        self._places = CameraParameters(cameras, self._pivot)
        self._unknown = [k for k, camera in enumerate(cameras) if camera.name in unknown]
        self._own = np.flatnonzero((kinematics.lower < kinematics.upper) & ~shape.lengths)
        self._shape = shape
        self._noise = Noise(deviation=1.0, correlation=0.5 / self._size**3)
        self._fit = FramesFit(
            self._body, cameras, self._unknowns(), pivot=self._pivot, noise=self._noise,
            steps=_STEPS, pixels=self._size,
        )  # fmt: skip
        self._evidence = [self._see(frame) for frame in frames]

    def fit(self) -> AdjustedBundle:
        """Fits all, in the end as finely as the model is like the body."""
        found = self._fitted([*_FIRST, AnnealingStage(_SCALES[0], _SPACING, _ITERATIONS)], None)
        for scale in _SCALES[1:]:
            tried = self._fitted([AnnealingStage(scale, _SPACING, _ITERATIONS)], found)
            if tried.inlier_ratios[tried.inlier_ratios > 0.0].mean() < _FITS:
                break
            found = tried
        count = len(self._body.names)
        X_CW = self._places.place(found.parameters[0][count:])[0]
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
        all_names = [*body.names, *self._places.names]

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

    def _see(self, frame: SeenFrame) -> Evidence:
        spacing = max(1.0, round(_EDGE_SPACING * self._size))
        masks = [frame.masks.get(camera.name) for camera in self._cameras]
        return pack_evidence(
            [NO_EDGE if mask is None else find_edge_points(mask, spacing) for mask in masks]
        )

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
        outlines = self._body.outlines
        seen = distances_in_pictures(
            outlines,
            [
                picture
                for place, frame in enumerate(frames)
                for picture in self._pictures(found, int(frame), (place, len(frames)))
            ],
            _MOST_DISTANCES,
        )
        own = self._kinematics.is_angle[self._own]
        shared = [name.split(".")[-1] in CAMERA_NAMES[:3] for name in self._fit.unknowns.names]
        is_angle = np.concatenate([np.tile(own, len(frames)), shared[len(own) :]])
        sizes = estimate_sizes(seen, is_angle, prior_deviation=_PRIOR_DEVIATION)
        whole = values_covariance(seen, sizes, np.arange(len(is_angle)), is_angle)
        cameras = found.parameters[0][len(self._body.names) :]
        covariances = []
        for c, k in enumerate(self._unknown):
            first = len(whole) - len(POSE_NAMES) * (len(self._unknown) - c)
            at = slice(first, first + len(POSE_NAMES))
            covariances.append(pose_covariance(self._moved(cameras, k), whole[at, at]))
        return np.array(covariances)

    def _moved(self, theta: Array, camera: int) -> Callable[[Array], Array]:
        """X_CW (4, 4) of a camera after a change of its pose (6,); theta: of all cameras."""
        first = len(CAMERA_NAMES) * camera

        def moved(by: Array) -> Array:
            changed = theta.copy()
            changed[first : first + len(by)] += by
            return np.asarray(self._places.place(changed)[0][camera])

        return moved

    def _pictures(self, found: FittedFrames, frame: int, among: tuple[int, int]) -> list[Picture]:
        """A frame's comparison with each camera's silhouette; among: the how manieth of how many.

        Their values are the unknowns: those of each such frame, then the shared ones.
        """
        unknowns, count = self._fit.unknowns, len(self._body.names)
        theta, own = found.parameters[frame], len(self._own)
        X_CW, kernel, motions = self._places.place(theta[count:])
        views = Views((X_CW, kernel), self._evidence[frame])
        compared = compare_views(self._body, views, theta[:count], _UNCUT, self._noise, self._size)
        X_WN = compared.placement.X_WN
        metres = 1.0 / pixels_per_metre((X_CW, kernel), X_WN[:, :3, 3].mean(axis=0))
        moves = np.zeros((len(X_WN), len(theta), 12))
        moves[:, :count] = compared.placement.dense(count)
        pictures = []
        for c in np.flatnonzero(compared.A.any(axis=(1, 2, 3))):
            seen = moves.copy()
            first = count + c * len(CAMERA_NAMES)
            seen[:, first : first + len(CAMERA_NAMES)] = motions[c]
            seen = seen[:, unknowns.entries]
            of_all = np.zeros((len(X_WN), among[1] * own + len(unknowns.names) - own, 12))
            of_all[:, among[0] * own : (among[0] + 1) * own] = seen[:, :own]
            of_all[:, among[1] * own :] = seen[:, own:]
            size = float(metres[c])
            pictures.append(Picture(compared.A[c], compared.b[c], X_WN, X_CW[c], of_all, size))
        return pictures
