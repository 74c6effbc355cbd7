"""Cameras, and what all frames share beside them, fitted together with the masks' widths.

A mask that is too wide on all sides makes its body seem nearer. Each mask's width is unknown, too:
thin links and their distances from one another tell the two apart.

Covariances: contours do not err point by point. There are the noise of points, the surface of a
part in all frames alike, its edge in one mask, and each frame as a whole (``fit.covariance``). The
residuals at the scale of the fit tell the sizes of these errors; frames scatter as these say, or by
a factor more. What is off alike in all frames and is not fitted, offsets, link scales and lenses,
moves what is fitted: its size is estimated, too.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.body import TARGET_POSITIONS
from drake_pose.body.tree_kinematics import LinkVector, TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.covariance import (
    Distances,
    ErrorSizes,
    distances_covariance,
    distances_in_masks,
    estimate_sizes,
    nuisance_covariance,
    score_nuisances,
    values_covariance,
)
from drake_pose.fit.evidence import Observation
from drake_pose.fit.levenberg_marquardt import AnnealingStage, Equations, StepSettings
from drake_pose.fit.parameters import (
    CAMERA_NAMES,
    POSE_NAMES,
    RADIUS_SCALE_PREFIX,
    BodyParameters,
    carried_joints,
    link_scale_name,
)
from drake_pose.fit.problem import TIME_OFFSET, Problem, Unknowns, parameter_names
from drake_pose.registration.posed_frames import PosedFrames, SeenFrame, common_size, middle_of
from drake_pose.silhouette.outline import Outline
from drake_pose.workers import map_ordered


class SharedFitSettings(NamedTuple):
    """Numbers of fits of cameras and of what all frames share.

    Args:
        rounds_with_constants: the parts of a fit that has constants to find beside cameras. The
            last one comes again and again: what hardly shows, such as an offset that turns with the
            camera, gains so little in a step that a round ends before it is there.
        told_apart: the scale at which frames that agree are told from outliers.
        fitted: the scale at which cameras were fitted in the end.
        steps: how steps are made.
        constant_deviation: prior standard deviation of joint offsets [rad or m] and of the
            logarithms of link scales.
        largest_constant: largest joint offset [rad or m] or logarithm of a link scale: without it a
            gripper that hardly shows turned by 130 degrees.
        focal_deviation: the prior standard deviation of the logarithms of focal lengths.
        known_beforehand: the scale of frames' errors is known beforehand as well as this number of
            distances tells it.
        prior_deviation: standard deviation of the logarithms of errors' sizes: a factor of twenty.
        min_inlier_ratio: a mask agrees if its inlier ratio is at least this fraction of the mean of
            the camera's two best.
        point_error, error_length: contours err by this along this length [pixel]: weight of
            contours against priors of single frames.
    """

    stages_with_constants: tuple[AnnealingStage, ...] = (
        AnnealingStage(0.12, 0.02),
        AnnealingStage(0.09, 0.02),
        AnnealingStage(0.07, 0.02),
        AnnealingStage(0.05, 0.02),
        AnnealingStage(0.03, 0.02),
        AnnealingStage(0.02, 0.02),
        AnnealingStage(0.01, 0.01),
        *(5 * (AnnealingStage(0.005, 0.005, 6),)),
    )
    inlier_stage: AnnealingStage = AnnealingStage(0.025, 0.01)
    final_stage: AnnealingStage = AnnealingStage(0.005, 0.005)
    steps: StepSettings = StepSettings(longest=0.3, damping=1e-2, even_damping=1e-6)
    constant_deviation: float = 0.2
    max_constant: float = 0.6
    focal_deviation: float = 0.1
    prior_freedom: int = 20
    prior_deviation: float = 3.0
    min_inlier_ratio: float = 0.7
    point_error: float = 4.0
    error_length: float = 100.0


SHARED = SharedFitSettings()


def inlier_threshold(ratios: Array) -> float:
    """The least inlier ratio of a mask that agrees with the others of its camera, (n,) ratios."""
    return float(SHARED.min_inlier_ratio * np.sort(ratios)[-2:].mean())


class SharedValues(NamedTuple):
    """What was found.

    shared: (u,) by the names of a fit; widths: (rows,) of masks [pixel], 0 where they do not count.
    """

    shared: Array
    biases: Array


class SharedFit:
    """Fits what the frames of several cameras share.

    Attributes:
        seen: what each camera sees.
        problem: all frames' unknowns.
        rows: (rows,) index of each mask's camera, ascending.
        names: of the u shared unknowns: those of each camera, then the constants.
        per_camera: number of unknowns of each camera.
        constants: names of the body's parameters to which an unknown constant is added in all
            frames: values of the pose tree, and lengths.

    Args:
        X_CW: (4, 4) for each camera, where a fit begins.
        offsets: joints whose places on their links are unknown.
        looks: number of CAMERA_NAMES, the first ones, that are unknown of each camera.
        widths: whether the masks' are.
    """

    def __init__(
        self,
        seen: Sequence[PosedFrames],
        X_CW: Sequence[Array],
        constants: Sequence[str] = (),
        *,
        offsets: Sequence[LinkVector] = (),
        camera_unknowns: int = len(POSE_NAMES),
        fit_biases: bool = True,
    ) -> None:
        self.views, self.constants, self._X_CW = tuple(seen), tuple(constants), tuple(X_CW)
        self._options: dict[str, Any] = {
            "offsets": offsets,
            "camera_unknowns": camera_unknowns,
            "fit_biases": fit_biases,
        }
        first, body = seen[0], seen[0].body
        if offsets:
            body = BodyParameters(first.kinematics, first.outlines, offsets=offsets)
        self.rows = np.repeat(np.arange(len(seen)), [len(one.frames) for one in seen])
        self._observations = [
            frame for c, one in enumerate(seen) for frame in one.observations(c, len(seen))
        ]
        cameras = [
            one.camera.with_pose(np.linalg.inv(X)) for one, X in zip(seen, X_CW, strict=True)
        ]
        self.per_camera = camera_unknowns
        names = [
            f"{camera.name}.{name}" for camera in cameras for name in CAMERA_NAMES[:camera_unknowns]
        ]
        self.names = (*names, *constants)
        deviations = dict.fromkeys(constants, SHARED.constant_deviation)
        # Of where an object stands, once it was found [m, rad].
        deviations |= dict.fromkeys(TARGET_POSITIONS, 1.0)
        deviations |= {f"{one.name}.{CAMERA_NAMES[6]}": SHARED.focal_deviation for one in cameras}
        known = np.array([deviations.get(name, np.inf) for name in self.names])
        bounded = set(constants) - {*TARGET_POSITIONS, TIME_OFFSET}
        most = np.array([SHARED.max_constant if k in bounded else np.inf for k in self.names])
        unknowns = [Unknowns(self.names, True, -most, most, known)]
        if fit_biases:
            # Masks are wider or narrower by at most six pixels.
            every = parameter_names(body, cameras)
            unknowns.append(Unknowns(every[-len(cameras) :], lower=-6.0, upper=6.0))
        self.problem = Problem(
            body, cameras, unknowns, pivot=np.array([one.middle for one in seen]),
            steps=SHARED.steps, pixels=np.array([one.size for one in seen]),
        )  # fmt: skip

    @property
    def start(self) -> SharedValues:
        """All as it is given."""
        return SharedValues(np.zeros(len(self.names)), np.zeros(len(self.rows)))

    def fit(
        self,
        rounds: Sequence[AnnealingStage],
        start: SharedValues | None = None,
        included: Mask | None = None,
    ) -> SharedValues:
        """Fits all from where it starts to those of the masks (rows,) that count."""
        seen, at, expected, included = self._at(start or self.start, included)
        found = self.problem.solve(seen, rounds, at, expected=expected)
        widths = np.zeros(len(self.rows))
        widths[included] = found.own.sum(axis=1)
        return SharedValues(found.shared, widths)

    def from_found(self, found: SharedValues) -> tuple["SharedFit", SharedValues]:
        """The same fit, whose cameras' unknowns count from where they were found."""
        X_CW = [camera.X_CW for camera in self.cameras(found)]
        count = self.per_camera * len(X_CW)
        shared = found.shared.copy()
        shared[:count].reshape(len(X_CW), -1)[:, : len(POSE_NAMES)] = 0.0
        fit = SharedFit(self.views, X_CW, self.constants, **self._options)
        return fit, SharedValues(shared, found.biases)

    def equations(
        self, at: SharedValues, step: AnnealingStage, included: Mask | None = None
    ) -> Equations:
        """The normal equations of the masks (rows,) that count, own unknowns first."""
        seen, unknowns, expected, _ = self._at(at, included)
        return self.problem.equations(seen, unknowns, step, expected)

    def cost_curvature(
        self, found: SharedValues, by: Array, step: AnnealingStage, included: Mask | None = None
    ) -> tuple[float, float]:
        """How much the cost bends upwards as what is shared moves by (u,), by slopes and by H."""
        p = self.problem.own_count
        less, here, more = (
            self.equations(SharedValues(found.shared + sign * by, found.biases), step, included)
            for sign in (-1.0, 0.0, 1.0)
        )
        known = float(self.problem.information[p:] @ by**2)
        slopes = (more.g - less.g).sum(axis=0)[p:]
        said = float(by @ here.H.sum(axis=0)[p:, p:] @ by)
        return 0.5 * float(by @ slopes) - known, said - known

    def inlier_ratios(self, found: SharedValues) -> Array:
        """(rows,) of both contours' lengths, what fits."""

        def ratio(mask: tuple[Observation, Array]) -> float:
            return self.problem.compare(*mask, SHARED.inlier_stage)[0].inlier_ratio

        masks = zip(self._observations, self._parameters(found), strict=True)
        return np.array(map_ordered(ratio, masks))

    def inliers(self, ratios: Array) -> Mask:
        """(rows,) which masks fit nearly as well as the two of their camera that fit best."""
        own = [ratios[self.rows == c] for c in range(len(self.views))]
        return np.concatenate([one >= inlier_threshold(one) for one in own])

    def tile_costs(self, found: SharedValues, side: float) -> Array:
        """(rows, k, k) costs by squares of the pictures of a side [pixel]."""

        def costs(mask: tuple[Observation, Array, int]) -> Array:
            return self.problem.tile_costs(*mask[:2], SHARED.inlier_stage, side)[mask[2]]

        masks = zip(self._observations, self._parameters(found), self.rows.tolist(), strict=True)
        return np.array(map_ordered(costs, masks))

    def cameras(self, found: SharedValues) -> list[PinholeCamera]:
        """The cameras as they were found."""
        X_CW, kernel, _ = self.problem.place_cameras(self._parameters(found)[0])
        return [
            replace(one.camera, X_WC=np.linalg.inv(X), focal_x=float(k[1]), focal_y=float(k[2]))
            for one, X, k in zip(self.views, X_CW, kernel, strict=True)
        ]

    def covariances(self, found: SharedValues, included: Mask | None = None) -> tuple[Array, Array]:
        """(u, u) each: of the errors of what is shared, told by the masks (rows,) that count.

        Of contours that err, and what is off alike in all frames adds.
        """
        seen = self._distances_with_nuisances(found, SHARED.final_stage, included)
        is_angle = np.zeros(seen.X.shape[1], bool)
        sizes = estimate_sizes(seen, is_angle, 0.0, SHARED.prior_deviation)
        doubted, seen = nuisance_covariance(seen, sizes, is_angle)
        covariance = values_covariance(seen, sizes, np.arange(len(is_angle)), is_angle)
        covariance *= scatter_factor(seen, sizes, len(self.names))
        # Wrong intrinsics err alike in all frames: the pose follows, and nothing is left of it. So
        # where parts are seen to err, a calibration is trusted to a pixel at best. What comes again
        # where a part stands still may be the part's surface: none of it counts as noise here.
        seen = self._distances_with_nuisances(found, SHARED.inlier_stage, included)
        seen = seen._replace(effects=seen.effects[[0, 0, 2, 3, 4]])
        sizes = estimate_sizes(seen, np.zeros(seen.X.shape[1], bool), 0.0, SHARED.prior_deviation)
        pixels = min(1.0, (sizes.surface**2 + sizes.mask**2) / 0.2**2)
        for c, (one, camera) in enumerate(zip(self.views, self.cameras(found), strict=True)):
            depth = float(camera.X_CW[2, :3] @ one.middle + camera.X_CW[2, 3])
            size = pixels * depth / one.camera.focal_x
            turn = size / one.extent
            off = np.array([turn, turn, turn, size, size, size * depth / one.extent, turn])
            at = np.arange(self.per_camera) + c * self.per_camera
            doubted[at, at] += off[: self.per_camera] ** 2
        own = slice(len(self.names))
        return covariance[own, own], doubted[own, own]

    def likely_offsets(
        self, found: SharedValues, included: Mask, min_score: float = 6.0, smallest: float = 2.0
    ) -> dict[str, tuple[float, float]]:
        """Joint offsets, each by itself, that explain what all frames that count have in common.

        An offset of three degrees comes out as 2 to 3, at scores of 30 to 140. With links 1 %
        longer, offsets of .3 degrees and a focal length 1 % off they are .7 degrees at most.

        Args:
            min_score: smallest value over its standard deviation.
            smallest: smallest value [half a degree or two millimetres].

        Returns:
            value and standard deviation by joint [rad or m], the likeliest one first.
        """
        seen = self._distances_with_nuisances(found, SHARED.inlier_stage, included)
        angles = np.zeros(seen.X.shape[1], bool)
        sizes = estimate_sizes(seen, angles, 0.0, SHARED.prior_deviation)
        values, deviations = score_nuisances(seen, sizes)
        units = self._offset_units
        # As they stand among the nuisances: what is fitted and an object's place are none.
        known = {*self.names, *TARGET_POSITIONS}
        names = [one for one in self._nuisance_fit.names if one in units and one not in known]
        if not seen.nuisances or seen.nuisances[0].shape[1] != len(names):
            return {}
        scored = zip(names, values, deviations, strict=False)
        told = {
            name: (float(value * units[name]), float(deviation * units[name]))
            for name, value, deviation in scored
            if abs(value) > max(smallest, min_score * deviation)
        }
        return dict(sorted(told.items(), key=lambda one: -abs(one[1][0]) / one[1][1]))

    def fit_slope(
        self, found: SharedValues, name: str, weights: Array, included: Mask, covariance: Array
    ) -> tuple[float, float]:
        """How a constant grows with what the masks that count weigh, were it to grow.

        One Gauss-Newton step of a further unknown, whose derivatives are in each mask the
        constant's times the mask's weight, beside all others; and its standard deviation.

        Args:
            weights: of the masks that count.
            covariance: (u, u) of what is shared.
        """
        p, at = self.problem.own_count, self.names.index(name)
        equations = self.equations(found, SHARED.final_stage, included)
        H, g = equations.H, equations.g
        more = np.einsum("f,fi->fi", weights, H[:, p + at])
        own = weights**2 * H[:, p + at, p + at]
        H = np.block([[H, more[:, :, None]], [more[:, None, :], own[:, None, None]]])
        g = np.column_stack([g, weights * g[:, p + at]])
        gains = np.linalg.solve(H[:, :p, :p] + 1e-9 * np.eye(p), H[:, :p, p:])
        S = (H[:, p:, p:] - np.einsum("fpi,fpj->fij", H[:, :p, p:], gains)).sum(axis=0)
        S += 1e-9 * np.eye(len(S))
        left = (g[:, p:] - np.einsum("fpi,fp->fi", gains, g[:, :p])).sum(axis=0)
        inverse = np.linalg.inv(S)
        said = np.linalg.inv(S[:-1, :-1])[at, at]
        scale = covariance[at, at] / said
        return -float(inverse[-1] @ left), float(np.sqrt(scale * inverse[-1, -1]))

    def camera_covariances(self, found: SharedValues, covariance: Array) -> Array:
        """(cameras, 6, 6) of the poses' errors in the world, covariance being of what is shared."""
        X_CW, _, motions = self.problem.place_cameras(self._parameters(found)[0])
        own = [slice(k, k + 6) for k in self.per_camera * np.arange(len(X_CW))]
        several = zip(X_CW, motions, own, strict=True)
        return np.array([pose_covariance(X, J[:6], covariance[k, k]) for X, J, k in several])

    def _at(
        self, at: SharedValues, included: Mask | None
    ) -> tuple[list[Observation], tuple[Array, Array], tuple[Array, Array], Mask]:
        """Masks that count; their own and shared unknowns; what these are expected to be.

        Then which masks (rows,) those are.
        """
        included = np.ones(len(self.rows), bool) if included is None else included
        own, seen = (
            self._own(at)[included],
            [self._observations[k] for k in np.flatnonzero(included)],
        )
        return seen, (own, at.shared), (np.zeros_like(own), np.zeros(len(self.names))), included

    def _own(self, at: SharedValues) -> Array:
        """(rows, own unknowns): of each mask the width of its camera's."""
        own = np.zeros((len(self.rows), self.problem.own_count))
        if own.size:
            own[np.arange(len(own)), self.rows] = at.biases
        return own

    def _parameters(self, at: SharedValues) -> Array:
        """(rows, n) all parameters."""
        return self.problem.parameters(self._observations, self._own(at), at.shared)

    def distances(
        self, at: SharedValues, step: AnnealingStage, included: Mask | None = None
    ) -> Distances:
        """The distances in all masks that count; values are what is shared, then the widths."""
        seen, _, _, included = self._at(at, included)
        pictures = self.problem.compared_masks(seen, self._parameters(at)[included], step)
        return distances_in_masks(self.problem.body.outlines, pictures, with_bias=True)

    def _distances_with_nuisances(
        self, found: SharedValues, step: AnnealingStage, included: Mask | None
    ) -> Distances:
        """The distances in all masks that count; values are what is shared, then the widths.

        What may be off alike in all frames, and is not shared, is doubted: joints' offsets [half a
        degree or two millimetres], link scales, each and all alike [1 %], and lenses [1 % of the
        focal length; half a percent of it where the principal point lies].
        """
        whole = self._nuisance_fit
        names, kinematics, units = whole.names, self.views[0].kinematics, dict(self._offset_units)
        groups: dict[str, list[str]] = {"offsets": [], "scales": [], "lenses": []}
        groups["offsets"] = [name for name in kinematics.names if name not in TARGET_POSITIONS]
        for camera in (one.camera for one in self.views):
            lens = [f"{camera.name}.{name}" for name in CAMERA_NAMES[len(POSE_NAMES) :]]
            units |= zip(lens, (0.01, *[0.005 * camera.focal_x] * 2), strict=True)
            groups["lenses"] += lens
        looks = [f"{one.camera.name}.{name}" for one in self.views for name in POSE_NAMES]
        groups["scales"] = [name for name in names if name not in units and name not in looks]
        shared = np.zeros(len(names))
        own = [names.index(name) for name in self.names]
        shared[own] = found.shared
        distances = whole.distances(SharedValues(shared, found.biases), step, included)
        nuisances = []
        for kind, members in groups.items():
            doubted = [k for k, name in enumerate(names) if k not in own and name in members]
            Z = distances.X[:, doubted] * [units.get(names[k], 0.01) for k in doubted]
            nuisances.append(np.column_stack([Z, Z.sum(axis=1)]) if kind == "scales" else Z)
        values = np.array([*own, *range(len(names), distances.X.shape[1])])
        return distances._replace(
            X=distances.X[:, values],
            information=distances.information[np.ix_(values, values)],
            nuisances=tuple(Z for Z in nuisances if Z.any()),
        )

    @property
    def _offset_units(self) -> dict[str, float]:
        """By what joints' offsets are doubted: half a degree or two millimetres [rad or m]."""
        kinematics = self.views[0].kinematics
        units = np.where(kinematics.is_angle, np.radians(0.5), 0.002)
        return dict(zip(kinematics.names, units.tolist(), strict=True))

    @cached_property
    def _nuisance_fit(self) -> "SharedFit":
        """The same fit, all unknown that is doubted."""
        kinematics = self.views[0].kinematics
        offsets = carried_joints(kinematics.tree)
        free = np.flatnonzero(kinematics.lower < kinematics.upper)
        zeros = [name for name in (kinematics.names[k] for k in free) if name not in self.constants]
        lengths = dict.fromkeys(link_scale_name(one.link) for one in offsets)
        names = [*self.constants, *zeros, *(one for one in lengths if one not in self.constants)]
        options = self._options | {"offsets": offsets, "camera_unknowns": len(CAMERA_NAMES)}
        return SharedFit(self.views, self._X_CW, names, **options)


def fit_pose(seen: PosedFrames, X_CW: Array, rounds: Sequence[AnnealingStage]) -> Array:
    """X_CW (4, 4) fitted to all frames from where it starts; silhouettes keep their widths."""
    fit = SharedFit([seen], [X_CW], fit_biases=False)
    return fit.cameras(fit.fit(rounds))[0].X_CW


def pose_covariance(X_CW: Array, motions: Array, covariance: Array) -> Array:
    """(6, 6) of a camera's error in the world: a rotation vector [rad], a shift [m].

    Args:
        X_CW: (4, 4) of the camera.
        motions: (6, 12) of all that it sees, as of ``CameraParameters.place``.
        covariance: (6, 6) of these.
    """
    # Where all that it sees moves one way, it moves the other way.
    by = -motions.reshape(6, 3, 4)
    p_WC = -X_CW[:3, :3].T @ X_CW[:3, 3]
    turns = np.stack([by[:, 2, 1], by[:, 0, 2], by[:, 1, 0]])
    J = np.vstack([turns, (by[:, :, :3] @ p_WC + by[:, :, 3]).T])
    return np.asarray(J @ covariance @ J.T)


def scatter_factor(seen: Distances, sizes: ErrorSizes, shared: int) -> float:
    """By what factor frames disagree more about what they share than errors say: of variances.

    Each frame's distances along what it tells of the shared values, its width put right, are
    normal with a known covariance about what these values make of them.
    """
    V = distances_covariance(seen, sizes)
    designs, lefts = [], []
    for picture in np.unique(seen.pictures):
        rows = np.flatnonzero(seen.pictures == picture)
        X, widths = np.split(seen.X[rows], [shared], axis=1)
        X = X - widths @ np.linalg.pinv(widths) @ X
        U, told, _ = np.linalg.svd(X, full_matrices=False)
        U = U[:, told > 1e-3 * told.max()]
        L = np.linalg.cholesky(U.T @ V[np.ix_(rows, rows)] @ U)
        designs.append(np.linalg.solve(L, U.T @ X))
        lefts.append(np.linalg.solve(L, U.T @ seen.y[rows]))
    if not designs:
        return 1.0
    design, left = np.concatenate(designs), np.concatenate(lefts)
    by, _, rank, _ = np.linalg.lstsq(design, left)
    off = left - design @ by
    scale = (SHARED.prior_freedom + float(off @ off)) / (SHARED.prior_freedom + len(off) - rank)
    # Frames that agree by chance are no surer.
    return max(scale, 1.0)


def adjust_bundle(
    kinematics: TreeKinematics,
    outlines: Sequence[Outline],
    cameras: Sequence[PinholeCamera],
    unknown: Collection[str],
    frames: Sequence[SeenFrame],
    is_length: Mask,
    parts: Sequence[str] = (),
    groups: Sequence[int] | None = None,
    covariance_frames: int = 4,
) -> tuple[list[PinholeCamera], Array, Array, Array]:
    """Fits poses and cameras together, in the end as finely as the model is like the body.

    Cameras that are found from estimated joint positions are off with them. So all are fitted to
    all silhouettes at once (bundle adjustment), with lengths and radius scales that all frames
    share; cameras whose places are known hold the whole.

    Args:
        cameras: all cameras, those that are unknown near where they stand.
        unknown: names of the cameras whose poses are unknown.
        frames: what they see, with approximate values of the body.
        is_length: (m,) which of the pose tree's values are lengths, the same in all frames.
        parts: names of the parts that have a radius_scale: how wide they are across their y axes.
        groups: (nodes,) which of these each node belongs to, or -1; None: none.
        telling_frames: number of frames from which covariances are estimated.

    Returns:
        the c unknown cameras with their poses; (c, 6, 6) covariances of these, as of
        ``RegisteredCamera``; (frames, m) values, lengths among them [rad or m]; and (nodes,)
        radius scales over the model's.

    Raises:
        MaskError: a mask of another size than its camera's picture, or no mask shows the body.
    """
    values, size = np.array([frame.values for frame in frames]), common_size(cameras, frames)
    body = BodyParameters(kinematics, outlines, groups, parts)
    free = (kinematics.lower < kinematics.upper) & ~is_length
    looks = [k for k, camera in enumerate(cameras) if camera.name in unknown]
    # Known beforehand: estimated angles [rad], places and lengths [m], logarithms of radius scales.
    worth = SHARED.point_error * np.sqrt(SHARED.error_length)
    deviations = np.where(is_length, 0.03, 0.5) / worth
    pose, lengths = (
        Unknowns(
            np.array(kinematics.names)[included].tolist(), shared, kinematics.lower[included],
            kinematics.upper[included], deviations[included],
        )
        for included, shared in ((free, False), (is_length, True))
    )  # fmt: skip
    radius_scales = [name for name in body.names if name.startswith(RADIUS_SCALE_PREFIX)]
    poses = [f"{cameras[k].name}.{name}" for k in looks for name in POSE_NAMES]
    unknowns = [
        pose,
        lengths,
        Unknowns(radius_scales, True, deviation=0.15 / worth),
        Unknowns(poses, True),
    ]
    fit = Problem(
        body, cameras, unknowns, pivot=middle_of(kinematics, frames), steps=SHARED.steps,
        pixels=size,
    )  # fmt: skip
    held = np.where(free | is_length, 0.0, values)
    seen = [
        Observation(frame.edges(cameras, size / 150.0), row)
        for frame, row in zip(frames, held, strict=True)
    ]
    count = len(lengths.names)
    shared = np.zeros(len(fit.names) - fit.own_count)
    shared[:count] = values[0, is_length]
    start = now = values[:, free], shared
    found, rounds = None, [AnnealingStage(0.08, 0.02), AnnealingStage(0.06, 0.02, 3)]
    # Then as fine as the model is like the body: the finest scale at which 0.7 of contours fit.
    for scale in (0.04, 0.03, 0.02, 0.01, 0.005):
        rounds.append(AnnealingStage(scale, 0.015, 6))
        tried = fit.solve(seen, rounds, now, expected=start)
        if found and tried.inlier_ratios[tried.inlier_ratios > 0.0].mean() < 0.7:
            break
        found, now, rounds = tried, (tried.own, tried.shared), []
    assert found is not None
    # The covariance is that of some frames, and of some distances in them, several an unknown: a
    # surface that is not the body's is so in all frames. How far it is off shows at a scale at
    # which nothing is left out because it is off.
    some = np.unique(np.linspace(0, len(seen) - 1, covariance_frames).round().astype(int))
    uncut = AnnealingStage(0.08, 0.015)
    pictures = fit.compared_masks([seen[k] for k in some], found.parameters[some], uncut)
    distances = distances_in_masks(body.outlines, pictures, 1000)
    turns = [name.split(".")[-1] in CAMERA_NAMES[:3] for name in fit.names[fit.own_count :]]
    is_angle = np.concatenate([np.tile(kinematics.is_angle[free], len(some)), turns])
    sizes = estimate_sizes(distances, is_angle, prior_deviation=SHARED.prior_deviation)
    whole = values_covariance(distances, sizes, np.arange(len(is_angle)), is_angle)
    X_CW, _, motions = fit.place_cameras(found.parameters[0])
    own = np.arange(len(whole) - len(poses), len(whole)).reshape(len(looks), 6)
    found_cameras = [replace(cameras[k], X_WC=np.linalg.inv(X_CW[k])) for k in looks]
    covariances = [
        pose_covariance(X_CW[k], motions[k, :6], whole[np.ix_(at, at)])
        for k, at in zip(looks, own, strict=True)
    ]
    widths = np.exp(np.append(found.shared[count : count + len(parts)], 0.0)[body.groups])
    values = found.parameters[:, : values.shape[1]]
    return found_cameras, np.array(covariances), values, widths
