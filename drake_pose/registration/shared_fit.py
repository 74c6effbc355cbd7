"""Fit cameras and other unknowns shared by all frames, together with the masks' boundary biases.

A mask that is too wide on all sides makes its body seem nearer. The boundary bias of each mask is
therefore unknown, too; thin links and the distances between links separate it from the depth.

Covariances: contour errors are correlated. They have a component for each point, for a part's
surface in all frames, for a part's edge in one mask, and for each frame (``fit.covariance``). Their
sizes are estimated from the residuals, and a variance factor from the scatter between frames. Joint
offsets, link scales and lens errors that are not fitted are nuisance parameters: their estimated
sizes enlarge the covariance.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.body import TARGET_POSITIONS
from drake_pose.body.tree_kinematics import LinkVector
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.contour_fit import Comparison
from drake_pose.fit.covariance import (
    Distances,
    ErrorSizes,
    distances_covariance,
    distances_in_masks,
    estimate_sizes,
    nuisance_covariance,
    round_parts,
    score_nuisances,
    values_covariance,
)
from drake_pose.fit.evidence import Observation
from drake_pose.fit.kernel import Sum
from drake_pose.fit.levenberg_marquardt import AnnealingStage, Equations, StepSettings
from drake_pose.fit.parameters import (
    CAMERA_NAMES,
    POSE_NAMES,
    BodyParameters,
    carried_joints,
    link_scale_name,
)
from drake_pose.fit.problem import TIME_OFFSET, Problem, Unknowns, parameter_names
from drake_pose.registration.posed_frames import PosedFrames
from drake_pose.workers import map_ordered


class SharedFitSettings(NamedTuple):
    """Stages, priors and thresholds of fits of shared unknowns.

    Args:
        stages_with_constants: stages of a fit of cameras and constants; scales and spacings of all
            stages are over the square root of the silhouettes' area. The last one is repeated:
            weakly observable constants, such as an offset correlated with the camera, converge
            slowly, and a stage ends when the cost hardly falls.
        last_stages: number of these, from the last one on, for cameras and constants that were
            fitted together before.
        inlier_stage: stage at which inliers and outliers are classified.
        final_stage: last stage of the fit of cameras.
        steps: limits and damping of a step.
        last_steps: of the steps that end a fit of cameras and constants: what static parts tell of
            a first joint is a millionth of what moving parts tell of its sum with the camera.
        constant_deviation: prior standard deviation of joint offsets [rad or m] and of the
            logarithms of link scales.
        determined: maximum standard deviation of a determined constant, over the prior's.
        level: probability that any of a registration's constants is significant by chance.
        max_constant: largest joint offset [rad or m] or logarithm of a link scale; without it, the
            offset of a hardly visible gripper became 130 degrees.
        focal_deviation, guessed_focal_deviation: prior standard deviation of the logarithms of
            given focal lengths, and of guessed ones.
        prior_freedom: degrees of freedom of the prior of the frames' variance factor.
        prior_deviation: prior standard deviation of the logarithms of error sizes: a factor of 20.
        min_inlier_ratio: a mask is an inlier if its inlier ratio is at least this fraction of the
            mean of its camera's two best.
        point_error, error_length: contours err by `point_error` along `error_length` [pixel]; this
            weights contours against the priors of single frames.
    """

    stages_with_constants: tuple[AnnealingStage, ...] = (
        AnnealingStage(0.12, 0.02), AnnealingStage(0.09, 0.02), AnnealingStage(0.07, 0.02),
        AnnealingStage(0.05, 0.02), AnnealingStage(0.03, 0.02), AnnealingStage(0.02, 0.02),
        AnnealingStage(0.01, 0.01), *(5 * (AnnealingStage(0.005, 0.005, 6),)),
    )  # fmt: skip
    last_stages: int = 7
    inlier_stage: AnnealingStage = AnnealingStage(0.025, 0.01)
    final_stage: AnnealingStage = AnnealingStage(0.005, 0.005)
    steps: StepSettings = StepSettings(max_step=0.3, damping=1e-2, uniform_damping=1e-6)
    last_steps: StepSettings = StepSettings(0.3, 1e-7, 1e-10, 1e-9, min_decrease=1e-6)
    constant_deviation: float = 0.2
    determined: float = 0.2
    level: float = 0.05
    max_constant: float = 0.6
    focal_deviation: float = 0.1
    guessed_focal_deviation: float = 0.5
    prior_freedom: int = 20
    prior_deviation: float = 3.0
    min_inlier_ratio: float = 0.7
    point_error: float = 4.0
    error_length: float = 100.0


SHARED = SharedFitSettings()

OFFSET_UNITS = np.radians(0.5), 0.002
"""Units of joint offsets that are not fitted: half a degree [rad], or 2 mm [m]."""


def inlier_threshold(ratios: Array) -> float:
    """Return the minimum inlier ratio of an inlier; ratios (n,) of one camera's masks."""
    return float(SHARED.min_inlier_ratio * np.sort(ratios)[-2:].mean())


class SharedValues(NamedTuple):
    """Values of a fit's unknowns.

    shared: (u,) values in the order of ``SharedFit.names``. biases: (rows,) boundary biases of the
    masks [pixel], 0 for excluded masks.
    """

    shared: Array
    biases: Array


class SharedFit:
    """Fits unknowns that the frames of one or several cameras share.

    Attributes:
        views: for each camera its frames.
        problem: the least-squares problem of all masks.
        rows: (rows,) index of each mask's camera, ascending; a row is one mask.
        names: of the u shared unknowns: those of each camera, then the constants.
        per_camera: number of unknowns of each camera.
        constants: names of the body's parameters to which an unknown constant is added in all
            frames: values of the pose tree, and link scales.

    Args:
        views: for each camera its frames, all with the same pose tree and outlines.
        X_CW: for each camera the pose (4, 4) of the world in it at which its unknowns are 0.
        constants: see the attribute.
        offsets: vectors from links' joints to the joints that they carry, for link scales; empty:
            links cannot be scaled.
        camera_unknowns: number of unknowns of each camera, the first ones of CAMERA_NAMES.
        fit_biases: whether the masks' boundary biases are unknown.
        expected: prior means of constants by name, about which they are bounded; None, and for
            other names: 0.
        focal_deviation: prior standard deviation of the logarithms of focal lengths, if fitted.
        turned: joints about whose axes static parts may be turned: masks of these do not show it.
        held: whether the constants are held at `expected`.
        steps: limits and damping of a step.
    """

    def __init__(
        self,
        views: Sequence[PosedFrames],
        X_CW: Sequence[Array],
        constants: Sequence[str] = (),
        *,
        offsets: Sequence[LinkVector] = (),
        camera_unknowns: int = len(POSE_NAMES),
        fit_biases: bool = True,
        expected: Mapping[str, float] | None = None,
        focal_deviation: float = SHARED.focal_deviation,
        turned: Collection[str] = (),
        held: bool = False,
        steps: StepSettings = SHARED.steps,
    ) -> None:
        self.views, self.constants = tuple(views), tuple(constants)
        self._changed = partial(
            SharedFit, views, X_CW=X_CW, constants=constants, offsets=offsets,
            camera_unknowns=camera_unknowns, fit_biases=fit_biases, expected=expected,
            focal_deviation=focal_deviation, turned=turned,
        )  # fmt: skip
        first, body = views[0], views[0].body
        if offsets:
            body = BodyParameters(first.kinematics, first.outlines, offsets=offsets)
        self.rows = np.repeat(np.arange(len(views)), [len(one.frames) for one in views])
        self._observations = [
            frame for c, one in enumerate(views) for frame in one.observations(c, len(views))
        ]
        cameras = [
            one.camera.with_pose(np.linalg.inv(X)) for one, X in zip(views, X_CW, strict=True)
        ]
        self.per_camera, own = camera_unknowns, CAMERA_NAMES[:camera_unknowns]
        names = [f"{camera.name}.{name}" for camera in cameras for name in own]
        self.names = (*names, *constants)
        deviations = dict.fromkeys(constants, SHARED.constant_deviation)
        # The calibration target's pose is found before and hardly constrained here [m, rad].
        deviations |= dict.fromkeys(TARGET_POSITIONS, 1.0)
        deviations |= {f"{one.name}.{CAMERA_NAMES[6]}": focal_deviation for one in cameras}
        known = np.array([deviations.get(name, np.inf) for name in self.names])
        bounded = set(constants) - {*TARGET_POSITIONS, TIME_OFFSET}
        largest = 0.0 if held else SHARED.max_constant
        most = np.array([largest if k in bounded else np.inf for k in self.names])
        self._expected = np.array([(expected or {}).get(name, 0.0) for name in self.names])
        lower, upper = self._expected - most, self._expected + most
        unknowns = [Unknowns(self.names, True, lower, upper, known)]
        if fit_biases:
            # Boundary biases are at most six pixels.
            every = parameter_names(body, cameras)
            unknowns.append(Unknowns(every[-len(cameras) :], lower=-6.0, upper=6.0))
        self.problem = Problem(
            body, cameras, unknowns, pivot=np.array([one.middle for one in views]),
            steps=steps, pixels=np.array([one.size for one in views]),
            unseen=round_parts(first.kinematics, first.outlines, frozenset(turned)),
        )  # fmt: skip

    @property
    def start(self) -> SharedValues:
        """All unknowns at 0."""
        return SharedValues(np.zeros(len(self.names)), np.zeros(len(self.rows)))

    def fit(
        self,
        rounds: Sequence[AnnealingStage],
        start: SharedValues | None = None,
        included: Mask | None = None,
    ) -> SharedValues:
        """Return all unknowns fitted to the included masks (rows,); biases of others are 0.

        ``start``: None: all unknowns start from 0. ``included``: None: all.
        """
        observations, at, expected, included = self._at(start or self.start, included)
        found = self.problem.solve(observations, rounds, at, expected=expected)
        biases = np.zeros(len(self.rows))
        biases[included] = found.own.sum(axis=1)
        return SharedValues(found.shared, biases)

    def from_found(self, found: SharedValues) -> tuple["SharedFit", SharedValues]:
        """Return the same fit with the cameras' unknowns counted from their found poses.

        Returns the fit; and the found values with 0 for each camera's POSE_NAMES.
        """
        X_CW = [camera.X_CW for camera in self.cameras(found)]
        count = self.per_camera * len(X_CW)
        shared = found.shared.copy()
        shared[:count].reshape(len(X_CW), -1)[:, : len(POSE_NAMES)] = 0.0
        return self._changed(X_CW=X_CW), SharedValues(shared, found.biases)

    def fitted_cameras(self, at: SharedValues, included: Mask) -> SharedValues:
        """Return given values with cameras and biases fitted again, and the constants held.

        ``included``: (rows,) which masks enter.
        """
        held = dict(zip(self.names, at.shared.tolist(), strict=True))
        fit = self._changed(expected=held, held=True)
        return fit.fit([SHARED.inlier_stage, SHARED.final_stage], at, included)

    def equations(
        self, at: SharedValues, step: AnnealingStage, included: Mask | None = None
    ) -> Equations:
        """Return the normal equations at given values, boundary biases first.

        ``step``: its scale weights the residuals. ``included``: (rows,) masks; None: all.
        """
        observations, unknowns, expected, _ = self._at(at, included)
        return self.problem.equations(observations, unknowns, step, expected)

    def fit_to_end(self, start: SharedValues, included: Mask) -> SharedValues:
        """Return a fit of the included masks (rows,), with all unknowns fitted to the end."""
        fit = self._changed(steps=SHARED.last_steps)
        return fit.fit([replace(SHARED.final_stage, iterations=40)], start, included)

    def inlier_ratios(self, found: SharedValues) -> Array:
        """Return the inlier ratio (rows,) of each mask: the fraction of both contours that fits."""
        return np.array([one.inlier_ratio for one in self._compared(found, SHARED.inlier_stage)])

    def matched_lengths(self, found: SharedValues) -> Array:
        """Return (nodes, 2) the length of contours in all masks, and how much fits [pixel]."""
        sums = [one.sums for one in self._compared(found, SHARED.inlier_stage)]
        return np.sum(
            [own[:, :-1, [Sum.COMPARED, Sum.FITTING]].sum(axis=0) for own in sums], axis=0
        )

    def _compared(self, found: SharedValues, stage: AnnealingStage) -> list[Comparison]:
        """Return the comparison of each mask's contours with the body's at a stage."""
        masks = zip(self._observations, self._parameters(found), strict=True)
        return map_ordered(lambda mask: self.problem.compare(*mask, stage)[0], masks)

    def inliers(self, ratios: Array) -> Mask:
        """Return which masks (rows,) reach their camera's `inlier_threshold`, by inlier ratio."""
        own = [ratios[self.rows == c] for c in range(len(self.views))]
        return np.concatenate([one >= inlier_threshold(one) for one in own])

    def tile_costs(self, found: SharedValues, side: float) -> Array:
        """Return the costs (rows, k, k) of each mask by square image tiles of a side [pixel]."""

        def costs(mask: tuple[Observation, Array, int]) -> Array:
            return self.problem.tile_costs(*mask[:2], SHARED.inlier_stage, side)[mask[2]]

        masks = zip(self._observations, self._parameters(found), self.rows.tolist(), strict=True)
        return np.array(map_ordered(costs, masks))

    def cameras(self, found: SharedValues) -> list[PinholeCamera]:
        """Return the cameras at their found poses and focal lengths."""
        X_CW, kernel, _ = self.problem.place_cameras(self._parameters(found)[0])
        return [
            replace(one.camera, X_WC=np.linalg.inv(X), focal_x=float(k[1]), focal_y=float(k[2]))
            for one, X, k in zip(self.views, X_CW, kernel, strict=True)
        ]

    def covariances(
        self, found: SharedValues, included: Mask | None = None
    ) -> tuple[Array, Array, Array]:
        """Estimate the covariance of the shared unknowns from the included masks (rows,).

        included: None: all masks.

        Returns three (u, u) parts, whose sum is the covariance: from contour errors, from nuisance
        parameters and errors of the cameras' intrinsics, and from nuisance parameters that no
        residual shows, such as the first joint's offset without a base.
        """
        distances = self.distances_with_nuisances(found, SHARED.final_stage, included)
        is_angle = np.zeros(distances.X.shape[1], bool)
        sizes = estimate_sizes(distances, is_angle, 0.0, SHARED.prior_deviation)
        nuisance, unseen, distances = nuisance_covariance(distances, sizes, is_angle)
        scatter = np.sqrt(scatter_factor(distances, sizes, len(self.names)))
        sizes = ErrorSizes(*(scatter * np.array(sizes[:5])))
        covariance = values_covariance(distances, sizes, np.arange(len(is_angle)), is_angle)
        # Wrong intrinsics are the same in all frames, and the pose absorbs them without residuals.
        # So a calibration is trusted to a pixel at best where surfaces are seen to err. Repeated
        # noise of a static part may be an error of its surface: none of it counts as noise here.
        distances = self.distances_with_nuisances(found, SHARED.inlier_stage, included)
        distances = distances._replace(effects=distances.effects[[0, 0, 2, 3, 4]])
        sizes = estimate_sizes(
            distances, np.zeros(distances.X.shape[1], bool), 0.0, SHARED.prior_deviation
        )
        pixels = min(1.0, (sizes.surface**2 + sizes.mask**2) / 0.2**2)
        for c, (one, camera) in enumerate(zip(self.views, self.cameras(found), strict=True)):
            depth = float(camera.X_CW[2, :3] @ one.middle + camera.X_CW[2, 3])
            size = pixels * depth / one.camera.focal_x
            turn = size / one.extent
            off = np.array([turn, turn, turn, size, size, size * depth / one.extent, turn])
            at = np.arange(self.per_camera) + c * self.per_camera
            nuisance[at, at] += off[: self.per_camera] ** 2
        own = slice(len(self.names))
        return covariance[own, own], nuisance[own, own], unseen[own, own]

    def likely_offsets(
        self, found: SharedValues, included: Mask, min_score: float = 6.0, smallest: float = 2.0
    ) -> dict[str, tuple[float, float]]:
        """Find joint offsets, each by itself, that explain the residuals common to all frames.

        A true offset of 3 degrees is estimated as 2 to 3, with scores of 30 to 140. Links 1 %
        longer, offsets of 0.3 degrees and a focal length 1 % off give 0.7 degrees at most.

        Args:
            found: the fitted values; joints with a fitted offset are not tested.
            included: (rows,) masks that entered the fit.
            min_score: minimum ratio of a value to its standard deviation.
            smallest: minimum value [half a degree or two millimetres].

        Returns value and standard deviation by joint [rad or m], highest score first; {}: none.
        """
        distances = self.distances_with_nuisances(found, SHARED.inlier_stage, included)
        angles = np.zeros(distances.X.shape[1], bool)
        sizes = estimate_sizes(distances, angles, 0.0, SHARED.prior_deviation)
        values, deviations = score_nuisances(distances, sizes)
        units = self._offset_units
        # In the order of the first group of nuisances.
        known = {*self.names, *TARGET_POSITIONS}
        names = [one for one in self._nuisance_fit.names if one in units and one not in known]
        if not distances.nuisances or distances.nuisances[0].shape[1] != len(names):
            return {}
        scored = zip(names, values, deviations, strict=False)
        likely = {
            name: (float(value * units[name]), float(deviation * units[name]))
            for name, value, deviation in scored
            if abs(value) > max(smallest, min_score * deviation)
        }
        return dict(sorted(likely.items(), key=lambda one: -abs(one[1][0]) / one[1][1]))

    def fit_slope(
        self, found: SharedValues, name: str, weights: Array, included: Mask, covariance: Array
    ) -> tuple[float, float]:
        """Estimate the slope of a constant that varies linearly with a weight of each mask.

        With constant + slope * weight in place of the constant, one Gauss-Newton step from slope 0
        is made in all unknowns.

        Args:
            found: the fitted values.
            name: of the constant, such as the time offset, whose slope over time is the drift.
            weights: (n,) of the n included masks, such as their times.
            included: (rows,) masks that entered the fit.
            covariance: (u, u) of the shared unknowns, which scales the standard deviation.

        Returns:
            the slope and its standard deviation [unit of the constant over that of the weights].
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
        predicted = np.linalg.inv(S[:-1, :-1])[at, at]
        scale = covariance[at, at] / predicted
        return -float(inverse[-1] @ left), float(np.sqrt(scale * inverse[-1, -1]))

    def camera_covariances(self, found: SharedValues, covariance: Array) -> Array:
        """Return the covariance of each camera's pose X_WC (cameras, 6, 6), see `pose_covariance`.

        covariance: (u, u) of the shared unknowns, whose values are `found`.
        """
        X_CW, _, motions = self.problem.place_cameras(self._parameters(found)[0])
        own = [slice(k, k + 6) for k in self.per_camera * np.arange(len(X_CW))]
        several = zip(X_CW, motions, own, strict=True)
        return np.array([pose_covariance(X, J[:6], covariance[k, k]) for X, J, k in several])

    def _at(
        self, at: SharedValues, included: Mask | None
    ) -> tuple[list[Observation], tuple[Array, Array], tuple[Array, Array], Mask]:
        """Return the arguments of ``Problem.solve`` for values and included masks.

        Returns the n included observations; their own unknowns (n, cameras) and the shared ones
        (u,) at the values; the prior means of both; and which masks (rows,) are included.
        """
        included = np.ones(len(self.rows), bool) if included is None else included
        own = self._own(at)[included]
        observations = [self._observations[k] for k in np.flatnonzero(included)]
        return (observations, (own, at.shared), (np.zeros_like(own), self._expected), included)

    def _own(self, at: SharedValues) -> Array:
        """Return the own unknowns (rows, cameras): each mask's bias in its camera's column.

        Without fitted biases they are (rows, 0).
        """
        own = np.zeros((len(self.rows), self.problem.own_count))
        if own.size:
            own[np.arange(len(own)), self.rows] = at.biases
        return own

    def _parameters(self, at: SharedValues) -> Array:
        """Return all parameters (rows, n) of the problem for each mask, at given values."""
        return self.problem.parameters(self._observations, self._own(at), at.shared)

    def distances(
        self, at: SharedValues, step: AnnealingStage, included: Mask | None = None
    ) -> Distances:
        """Return the contours' distances in the included masks, linearised at given values.

        Their derivatives are by the shared unknowns, then by the included masks' boundary biases.
        The arguments are those of `equations`.
        """
        observations, _, _, included = self._at(at, included)
        masks = self.problem.compared_masks(observations, self._parameters(at)[included], step)
        return distances_in_masks(self.problem.body.outlines, masks, with_bias=True)

    def distances_with_nuisances(
        self, found: SharedValues, step: AnnealingStage, included: Mask | None
    ) -> Distances:
        """Return `distances`, with derivatives by up to three groups of nuisance parameters.

        Nuisances may be off in all frames alike and are not fitted: joint offsets [half a degree or
        2 mm], link scales, each and all together [1 %], focal lengths [1 %] and principal points
        [half a percent of the focal length].
        """
        full = self._nuisance_fit
        names, kinematics, units = full.names, self.views[0].kinematics, dict(self._offset_units)
        groups: dict[str, list[str]] = {"offsets": [], "scales": [], "lenses": []}
        groups["offsets"] = [name for name in kinematics.names if name not in TARGET_POSITIONS]
        for camera in (one.camera for one in self.views):
            lens = [f"{camera.name}.{name}" for name in CAMERA_NAMES[len(POSE_NAMES) :]]
            units |= zip(lens, (0.01, *[0.005 * camera.focal_x] * 2), strict=True)
            groups["lenses"] += lens
        poses = [f"{one.camera.name}.{name}" for one in self.views for name in POSE_NAMES]
        groups["scales"] = [name for name in names if name not in units and name not in poses]
        shared = np.zeros(len(names))
        own = [names.index(name) for name in self.names]
        shared[own] = found.shared
        distances = full.distances(SharedValues(shared, found.biases), step, included)
        nuisances = []
        for kind, members in groups.items():
            members_free = [k for k, name in enumerate(names) if k not in own and name in members]
            Z = distances.X[:, members_free] * [units.get(names[k], 0.01) for k in members_free]
            nuisances.append(np.column_stack([Z, Z.sum(axis=1)]) if kind == "scales" else Z)
        values = np.array([*own, *range(len(names), distances.X.shape[1])])
        known = np.zeros(len(values))
        known[: len(own)] = self.problem.information[self.problem.own_count :]
        return distances._replace(
            known=known,
            X=distances.X[:, values],
            information=distances.information[np.ix_(values, values)],
            nuisances=tuple(Z for Z in nuisances if Z.any()),
        )

    @property
    def _offset_units(self) -> dict[str, float]:
        """Units of nuisance joint offsets by joint: half a degree or 2 mm [rad or m]."""
        kinematics = self.views[0].kinematics
        units = np.where(kinematics.is_angle, *OFFSET_UNITS)
        return dict(zip(kinematics.names, units.tolist(), strict=True))

    @cached_property
    def _nuisance_fit(self) -> "SharedFit":
        """The same fit with all nuisances among its unknowns."""
        kinematics = self.views[0].kinematics
        offsets = carried_joints(kinematics.tree)
        free = np.flatnonzero(kinematics.lower < kinematics.upper)
        joints = [kinematics.names[k] for k in free if kinematics.names[k] not in self.constants]
        scales = dict.fromkeys(link_scale_name(one.link) for one in offsets)
        names = [*self.constants, *joints, *(one for one in scales if one not in self.constants)]
        return self._changed(constants=names, offsets=offsets, camera_unknowns=len(CAMERA_NAMES))


def fit_pose(view: PosedFrames, X_CW: Array, rounds: Sequence[AnnealingStage]) -> Array:
    """Return X_CW (4, 4) fitted from a start to all frames in `rounds`, without boundary biases."""
    fit = SharedFit([view], [X_CW], fit_biases=False)
    return fit.cameras(fit.fit(rounds))[0].X_CW


def pose_covariance(X_CW: Array, motions: Array, covariance: Array) -> Array:
    """Return the (6, 6) covariance of a camera's pose X_WC in the world [rad, m].

    It is that of the linearised pose, and of the second-order term 0.5 w x v of a rotation w and
    shift v: a camera that turns about a robot moves on an arc.

    ``X_CW``: (4, 4) the world's pose in the camera. ``motions``: (6, 12) affine motions of the
    scene for each unknown of the pose, see ``CameraParameters.place``. ``covariance``: (6, 6) of
    these unknowns.
    """
    # The camera moves opposite to the scene.
    by = -motions.reshape(6, 3, 4)
    p_WC = -X_CW[:3, :3].T @ X_CW[:3, 3]
    turns = np.stack([by[:, 2, 1], by[:, 0, 2], by[:, 1, 0]])
    J = np.vstack([turns, (by[:, :, :3] @ p_WC + by[:, :, 3]).T])
    C = J @ covariance @ J.T
    # Fourth moments of a normal distribution (Isserlis 1918).
    cross = np.cross(np.eye(3)[:, None], np.eye(3))
    (ww, wv), (vw, vv) = (np.split(rows, 2, axis=1) for rows in np.split(C, 2))
    moments = (
        np.einsum("ab,cd->abcd", wv, wv) + np.einsum("ac,bd->abcd", ww, vv)
        + np.einsum("ad,bc->abcd", wv, vw)
    )  # fmt: skip
    C[3:, 3:] += 0.25 * np.einsum("abi,cdj,abcd->ij", cross, cross, moments)
    return np.asarray(C)


def scatter_factor(distances: Distances, sizes: ErrorSizes, shared: int) -> float:
    """Return the factor, at least 1, by which frames scatter more than the error sizes predict.

    Each mask's distances are projected onto the directions that inform about the shared values,
    after removal of its boundary bias. There their covariance is known, and the weighted sum of
    squared residuals over the degrees of freedom estimates the factor of the variances.

    Args:
        distances: of the masks, with derivatives by the shared values, then by boundary biases.
        sizes: the estimated error sizes.
        shared: number of shared values, the first columns of ``distances.X``.
    """
    V = distances_covariance(distances, sizes)
    designs, targets = [], []
    for picture in np.unique(distances.pictures):
        rows = np.flatnonzero(distances.pictures == picture)
        X, biases = np.split(distances.X[rows], [shared], axis=1)
        X = X - biases @ np.linalg.pinv(biases) @ X
        U, singular, _ = np.linalg.svd(X, full_matrices=False)
        U = U[:, singular > 1e-3 * singular.max()]
        L = np.linalg.cholesky(U.T @ V[np.ix_(rows, rows)] @ U)
        designs.append(np.linalg.solve(L, U.T @ X))
        targets.append(np.linalg.solve(L, U.T @ distances.y[rows]))
    if not designs:
        return 1.0
    design, target = np.concatenate(designs), np.concatenate(targets)
    by, _, rank, _ = np.linalg.lstsq(design, target)
    off = target - design @ by
    scale = (SHARED.prior_freedom + float(off @ off)) / (SHARED.prior_freedom + len(off) - rank)
    # A scatter below the prediction is chance and does not reduce the variances.
    return max(scale, 1.0)
