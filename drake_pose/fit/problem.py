"""Fit several frames at once, with unknowns of each frame and unknowns shared by all frames.

Each unknown is added to one parameter of a frame. A joint position, for example, is an unknown of
each frame added to the joint's value; a joint offset is a shared unknown added to the same value,
which holds the encoder reading; a segment's length is a shared unknown added to the value of a
shape joint.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import block_diag

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError, require_known
from drake_pose.fit.background import foreground_of_colours
from drake_pose.fit.colours import compare_lines
from drake_pose.fit.contour_fit import (
    Comparison,
    ContourFit,
    Noise,
    Views,
    compare_views,
    pixels_per_metre,
    symmetric,
)
from drake_pose.fit.covariance import ComparedMask, RoundPart, without_rotations
from drake_pose.fit.evidence import Observation, offset_edges
from drake_pose.fit.kernel import Sum
from drake_pose.fit.levenberg_marquardt import (
    AnnealingStage,
    Equations,
    LinearPrior,
    StepSettings,
    minimise,
)
from drake_pose.fit.parameters import CAMERA_NAMES, BodyParameters, CameraParameters, Placement
from drake_pose.workers import map_ordered

BOUNDARY_BIAS = "boundary_bias"
"""Parameter of each camera: excess width of its silhouettes on all sides [pixel]."""

TIME_OFFSET = "time_offset"
"""Parameter of a frame: delay of its images relative to its joint positions [s]."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Unknown parameters of frames."""

    names: Sequence[str]  # (u,) names of the parameters, see ``parameter_names``.
    shared: bool = False  # Whether all frames share one value of each; else each frame has its own.
    # lower, upper: limits, scalar or (u,) [rad, m, s, pixel or a logarithm].
    lower: float | Array = -np.inf
    upper: float | Array = np.inf
    # Standard deviation of the prior [same unit], scalar or (u,); infinite: no prior. Its mean is
    # given to ``Problem.solve``.
    deviation: float | Array = np.inf


@dataclass(frozen=True, eq=False)
class Solution:
    """The best fit of a problem."""

    own: Array  # (frames, p) each frame's own unknowns, in the order of ``Problem.names``.
    shared: Array  # (q,) shared unknowns, likewise.
    # (frames, n) all parameters of the frames, in the order of ``parameter_names``.
    parameters: Array
    cost: float  # Cost of all frames, including priors.
    # Returns ``equations`` and ``inlier_ratios``, evaluated on the first call.
    ending: Callable[[], tuple[Equations, Array]]
    coupling: LinearPrior | None = None  # Prior that couples the frames' own unknowns; None: none.

    @property
    def equations(self) -> Equations:
        """Normal equations at the solution and the last stage, with priors but not the coupling."""
        return self.ending()[0]

    @property
    def inlier_ratios(self) -> Array:
        """(frames, cameras) fraction of both contours' length whose residual is below the scale."""
        return self.ending()[1]

    def own_deviations(self) -> Array:
        """Return (frames, p) standard deviations of own unknowns, marginalised over shared ones.

        The coupling is included. They are at most 100 [in the unknown's unit], reached if nothing
        is observed.
        """
        frames, p = self.own.shape
        H = self.equations.H
        whole = block_diag(*H[:, :p, :p]) + 1e-4 * np.eye(frames * p)
        if self.coupling is not None:
            whole += self.coupling.curvature().toarray()
        covariance = np.linalg.inv(whole)
        mixed = H[:, :p, p:].reshape(frames * p, -1)
        gains = covariance @ mixed
        S = H[:, p:, p:].sum(axis=0) - mixed.T @ gains
        variances = np.diag(covariance) + np.einsum("ij,ji->i", gains, np.linalg.solve(S, gains.T))
        return np.sqrt(np.maximum(variances, 0.0)).reshape(frames, p)


def parameter_names(body: BodyParameters, cameras: Sequence[Camera]) -> tuple[str, ...]:
    """Return the names of the n parameters of a frame, in order.

    They are the body's parameters, TIME_OFFSET, CAMERA_NAMES of each camera, and BOUNDARY_BIAS of
    each camera.
    """
    camera_names = [f"{camera.name}.{name}" for camera in cameras for name in CAMERA_NAMES]
    biases = [f"{camera.name}.{BOUNDARY_BIAS}" for camera in cameras]
    return (*body.names, TIME_OFFSET, *camera_names, *biases)


class Problem:
    """Unknowns of several frames of a body seen by the same cameras.

    Attributes:
        names: names of the u unknowns: the p own ones of each frame, then the q shared ones.
        entries: (u,) index, in ``parameter_names``, of the parameter to which each unknown is
            added.
        own_count: p.
        information: (u,) inverse variances of the unknowns' priors; 0: no prior.

    Args:
        body: parameters of the body.
        cameras: the cameras when their parameters are 0.
        unknowns: groups of unknowns; all other parameters are known.
        pivot: (3,) or (cameras, 3) point in the world about which cameras rotate [m]; None: the
            root's position.
        noise: noise of contours; None: a weight of one per pixel, or ``Noise()`` if lengths are in
            metres.
        steps: settings of the optimiser's steps; None: ``StepSettings()``.
        pixels: unit of length of stages and noise [pixel], scalar or (cameras,); None: the size of
            a metre at the root.
        unseen: parts about whose rotations silhouettes say nothing.

    Raises:
        UnknownNameError: an unknown is not a parameter.
    """

    def __init__(
        self,
        body: BodyParameters,
        cameras: Sequence[Camera],
        unknowns: Sequence[Unknowns],
        *,
        pivot: Array | None = None,
        noise: Noise | None = None,
        steps: StepSettings | None = None,
        pixels: float | Array | None = None,
        unseen: Sequence[RoundPart] = (),
    ) -> None:
        kinematics = body.kinematics
        if pivot is None:
            values = kinematics.flatten(kinematics.tree.default_values())
            pivot = kinematics.poses(values)[0, :3, 3]
        if noise is None and pixels is not None:
            noise = Noise.per_pixel(pixels)
        self.body, self._cameras = body, CameraParameters(cameras, pivot)
        self._unseen = unseen
        every = list(parameter_names(body, cameras))
        unknowns = sorted(unknowns, key=lambda one: one.shared)
        self.names = tuple(name for one in unknowns for name in one.names)
        require_known("parameter", self.names, every, "the fit")
        self.entries = np.array([every.index(name) for name in self.names], dtype=np.intp)
        self.own_count = sum(len(one.names) for one in unknowns if not one.shared)
        self._lower, self._upper, self.information = (
            np.concatenate(
                [np.broadcast_to(value, len(one.names)) for one, value in given] or [np.zeros(0)]
            )
            for given in (
                [(one, one.lower) for one in unknowns],
                [(one, one.upper) for one in unknowns],
                [(one, 1.0 / np.square(one.deviation)) for one in unknowns],
            )
        )
        self._contours = ContourFit(kinematics, body.outlines, noise, steps, pixels, body)
        self._count, self._first_camera = len(every), len(body.names) + 1
        self._first_bias = len(every) - len(cameras)
        self._biases = np.flatnonzero(self.entries >= self._first_bias)
        self._foreground_tables = foreground_of_colours(len(body.outlines))
        self._cameras_fixed = not np.any(self.entries >= self._first_camera)
        # Placing a body is faster without shift, scale or radius unknowns.
        self._values = len(kinematics.names)
        places = (self.entries >= self._values) & (self.entries < len(body.names))
        self._values_only = not places.any()
        # Without unknowns of the body all nodes share the camera's motion.
        self._is_static = not np.any(self.entries <= len(body.names))
        self._placements: dict[bytes, Placement] = {}
        self._last_cameras: tuple[bytes, tuple[Array, Array, Array]] = (
            b"",
            self._cameras.place(np.zeros(len(self._cameras.names))),
        )

    def solve(
        self,
        observations: Sequence[Observation],
        stages: Sequence[AnnealingStage],
        start: tuple[Array, Array] | None = None,
        *,
        expected: tuple[Array, Array] | None = None,
        shared_information: Array | None = None,
        coupling: LinearPrior | None = None,
    ) -> Solution:
        """Return the best fit near an initial guess.

        Args:
            observations: evidence and known values of each frame.
            stages: annealing stages in order, coarse to fine [``pixels`` or m].
            start: initial guess of own (frames, p) and shared (q,) unknowns; None: 0.
            expected: mean of the prior of own (frames, p) and shared (q,) unknowns; None: the
                initial guess.
            shared_information: (q, q) information matrix of a further prior of the shared
                unknowns, with the same mean; None: none.
            coupling: prior that couples all frames' own unknowns; None: none.

        Raises SettingsError: shapes do not match.
        """
        frames, p, q = len(observations), self.own_count, len(self.names) - self.own_count
        own, shared = (np.zeros((frames, p)), np.zeros(q)) if start is None else start
        if own.shape != (frames, p) or shared.shape != (q,):
            raise SettingsError(
                f"{frames} frames with {p} own and {q} shared unknowns expected, got "
                f"{own.shape} and {shared.shape}"
            )
        about = (own.copy(), shared.copy()) if expected is None else expected

        def evaluate(own: Array, shared: Array, stage: AnnealingStage) -> Equations:
            return self._equations(observations, (own, shared), about, stage, shared_information)[0]

        limits = self._lower, self._upper
        own, shared, cost = minimise(
            evaluate, own, shared, limits, stages, self._contours.steps, coupling
        )[:3]
        at, last = (own, shared), stages[-1]
        return Solution(
            own,
            shared,
            self.parameters(observations, own, shared),
            cost,
            cache(lambda: self._equations(observations, at, about, last, shared_information)),
            coupling,
        )

    def equations(
        self,
        observations: Sequence[Observation],
        at: tuple[Array, Array],
        stage: AnnealingStage,
        expected: tuple[Array, Array] | None = None,
    ) -> Equations:
        """Return the normal equations at given unknowns.

        Args:
            observations: evidence and known values of each frame.
            at: own (frames, p) and shared (q,) unknowns.
            stage: scale of the residuals.
            expected: mean of the prior, of the same shapes; None: ``at``.
        """
        return self._equations(observations, at, expected or at, stage, None)[0]

    def parameters(self, observations: Sequence[Observation], own: Array, shared: Array) -> Array:
        """Return (frames, n) known values plus unknowns, own (frames, p) and shared (q,)."""
        theta = np.zeros((len(observations), self._count))
        for row, one in zip(theta, observations, strict=True):
            row[: len(one.values)] = one.values
        for entry, unknown in zip(self.entries.tolist(), (*own.T, *shared), strict=True):
            theta[:, entry] += unknown
        return theta

    def _equations(
        self,
        observations: Sequence[Observation],
        at: tuple[Array, Array],
        about: tuple[Array, Array],
        stage: AnnealingStage,
        shared_information: Array | None,
    ) -> tuple[Equations, Array]:
        """Return the equations with priors, and the inlier ratios (frames, cameras).

        Args:
            observations: evidence and known values of each frame.
            at: own (frames, p) and shared (q,) unknowns.
            about: mean of their prior, of the same shapes.
            stage: scale of the residuals.
            shared_information: (q, q) information matrix of a further prior of the shared unknowns;
                None: none.
        """
        p, u, frames = self.own_count, len(self.names), len(observations)
        H, g, cost = np.zeros((frames, u, u)), np.zeros((frames, u)), 0.0
        ratios = []
        masks = zip(observations, self.parameters(observations, *at), strict=True)
        for k, (own_H, own_g, sums) in enumerate(
            map_ordered(lambda mask: self._frame(*mask, stage), masks)
        ):
            H[k], g[k] = own_H, own_g
            cost += float(sums[:, :, Sum.COST].sum())
            lengths = np.maximum(sums[:, :, Sum.COMPARED].sum(axis=1), 1e-9)
            ratios.append(sums[:, :, Sum.FITTING].sum(axis=1) / lengths)
            deviation = at[0][k] - about[0][k]
            own_information = self.information[:p]
            H[k, range(p), range(p)] += own_information
            g[k, :p] += own_information * deviation
            cost += float(own_information @ deviation**2)
        information = np.diag(self.information[p:])
        if shared_information is not None:
            information = information + shared_information
        deviation = at[1] - about[1]
        # The prior of the shared unknowns is added once, to the first frame.
        H[0, p:, p:] += information
        g[0, p:] += information @ deviation
        return Equations(H, g, cost + float(deviation @ information @ deviation)), np.array(ratios)

    def _frame(
        self, frame: Observation, theta: Array, stage: AnnealingStage
    ) -> tuple[Array, Array, Array]:
        """Return a frame's contribution to the normal equations H dx = -g of the u unknowns.

        The results are H (u, u) and g (u,), without priors, and sums (cameras, nodes + 1, 6) by
        ``Sum`` of each node's contour and, last, the silhouette's edge.

        ``frame``: evidence of the frame. ``theta``: (n,) all parameters of the frame. ``stage``:
        scale of the residuals.
        """
        compared, (_, _, motions) = self.compare(frame, theta, stage)
        if self._cameras_fixed:
            moves = self._moves(compared, motions, 0, frame.rates)
            terms = [(moves, compared.A.sum(axis=0), compared.b.sum(axis=0))]
        else:
            terms = [
                (self._moves(compared, motions, c, frame.rates), A, b)
                for c, (A, b) in enumerate(zip(compared.A, compared.b, strict=True))
            ]
        u = len(self.entries)
        H, g = np.zeros((u, u)), np.zeros(u)
        for moves, A, b in terms:
            if self._is_static:
                moves, A, b = moves[:1], A.sum(axis=0)[None], b.sum(axis=0)[None]
            rows, pulled = (
                np.swapaxes(one, 0, 1).reshape(u, -1) for one in (moves, moves @ symmetric(A))
            )
            H += rows @ pulled.T
            g -= rows @ b.ravel()
        for k in self._biases:
            # Every residual decreases as the silhouette becomes wider.
            c = self.entries[k] - self._first_bias
            g[k] = -compared.bias_terms[c, :, 12].sum()
            H[k] = H[:, k] = np.einsum(
                "nux,nx->u",
                terms[0 if self._cameras_fixed else c][0],
                compared.bias_terms[c, :, :12],
            )
            H[k, k] = compared.sums[c][:, Sum.WEIGHT].sum()
        return H, g, compared.sums

    def compare(
        self, frame: Observation, theta: Array, stage: AnnealingStage
    ) -> tuple[Comparison, tuple[Array, Array, Array]]:
        """Compare the body's contours with a frame's silhouettes and foreground images.

        Args:
            frame: evidence of the frame.
            theta: (n,) all parameters of the frame.
            stage: scale of the residuals.

        Returns the comparison with both, and the cameras: X_CW (c, 4, 4), kernel parameters (c, 8),
        and affine motions (c, 9, 12) of all nodes caused by each camera parameter.
        """
        packed_cameras = self.place_cameras(theta)
        views = self._views(frame, theta)
        values = self._body_parameters(theta, frame.rates)
        # A body without unknowns is placed once per distinct set of values.
        placement = self._placements.get(key := values.tobytes()) or self.body.place(values)
        if self._is_static:
            self._placements[key] = placement
        weights = self._contours.weights(views.cameras, placement, stage)
        compared = compare_views(views, placement, weights, len(self._biases) > 0)
        for c, picture in enumerate(frame.foreground):
            if picture is not None:
                # Lines closer than three pixels are redundant; offsets are 0.4 scales apart.
                line_weights = weights[c].copy()
                line_weights[2] = max(line_weights[2], 3.0)
                offset = max(1, round(line_weights[1] * 0.4))
                camera = packed_cameras[0][c], packed_cameras[1][c]
                compare_lines(
                    placement.packed, placement.X_WN, camera, picture, self._foreground_tables,
                    line_weights, offset, compared.A[c], compared.b[c], compared.sums[c],
                    compared.bias_terms[c], theta[self._first_bias + c],
                )  # fmt: skip
        return without_rotations(compared, self._unseen), packed_cameras

    def tile_costs(
        self, frame: Observation, theta: Array, stage: AnnealingStage, side: float
    ) -> Array:
        """Return costs (cameras, 64, 64) of a frame's silhouettes in image tiles at theta (n,).

        They are without priors and foreground images. ``side``: of a tile [pixel]; indices are
        taken modulo 64.
        """
        views = self._views(frame, theta)
        return self._contours.tile_costs(
            views, self._body_parameters(theta, frame.rates), stage, side
        )

    def _body_parameters(self, theta: Array, rates: Array | None) -> Array:
        """Return the body's parameters (k,), the tree's values moved on by the time offset.

        ``theta``: (n,) all parameters. ``rates``: (m,) velocities; None: no motion. If all but the
        tree's values (m,) are known and 0, only these are returned.
        """
        own = theta[: len(self.body.names)]
        if rates is not None:
            own = own.copy()
            own[: self._values] += rates * theta[len(own)]
        return own[: self._values] if self._values_only and not own[self._values :].any() else own

    def _views(self, frame: Observation, theta: Array) -> Views:
        """Return cameras at theta (n,), and a frame's edges moved inwards by boundary biases."""
        biases = theta[self._first_bias :]
        edges = offset_edges(frame.edges, -biases) if biases.any() else frame.edges
        return Views(self.place_cameras(theta)[:2], edges)

    def place_cameras(self, theta: Array) -> tuple[Array, Array, Array]:
        """Return the cameras at all parameters theta (n,) of a frame.

        They are X_CW (c, 4, 4), kernel parameters (c, 8), and affine motions (c, 9, 12) of all
        nodes caused by each camera parameter.
        """
        camera_part = theta[self._first_camera : self._first_bias]
        # Successive frames mostly have the same camera parameters.
        if camera_part.tobytes() != self._last_cameras[0]:
            self._last_cameras = camera_part.tobytes(), self._cameras.place(camera_part)
        return self._last_cameras[1]

    def compared_masks(
        self, observations: Sequence[Observation], parameters: Array, stage: AnnealingStage
    ) -> list[ComparedMask]:
        """Return the comparison with each silhouette that has a contour to compare.

        The values of a ``ComparedMask`` are here the unknowns except boundary biases: the own ones
        of all frames, frame by frame, then the shared ones. The unit of errors is a pixel.

        ``observations``: the frames. ``parameters``: (frames, n) all parameters of each. ``stage``:
        scale of the residuals.
        """
        chosen, frames = self.entries < self._first_bias, len(observations)
        p = int(np.count_nonzero(chosen[: self.own_count]))
        q = int(np.count_nonzero(chosen[self.own_count :]))
        found, given = [], [*zip(observations, parameters, strict=True)]
        several = map_ordered(lambda one: self.compare(*one, stage), given)
        for k, (compared, (X_CW, kernel, motions)) in enumerate(several):
            X_WN = compared.placement.X_WN
            sizes = 1.0 / pixels_per_metre((X_CW, kernel), X_WN[:, :3, 3].mean(axis=0))
            for c in np.flatnonzero(compared.A.any(axis=(1, 2, 3))).tolist():
                terms = self._moves(compared, motions, c, observations[k].rates)[:, chosen]
                own, shared = np.split(terms, [p], axis=1)
                moves = np.zeros((len(X_WN), frames * p + q, 12))
                moves[:, k * p : (k + 1) * p], moves[:, frames * p :] = own, shared
                A = symmetric(compared.A[c])
                found.append(
                    ComparedMask(A, compared.b[c], X_WN, X_CW[c], moves, float(sizes[c]), c)
                )
        return found

    def _moves(
        self, compared: Comparison, motions: Array, camera: int, rates: Array | None
    ) -> Array:
        """Return (nodes, u, 12) motions of the nodes, as seen by a camera, caused by the unknowns.

        Boundary biases move no node. ``motions``: (cameras, 9, 12) of all nodes by camera
        parameters. ``rates``: (m,) velocities of the tree's values; None: the time offset moves no
        node.
        """
        entries, placement = self.entries, compared.placement
        moves = np.zeros((len(placement.X_WN), len(entries), 12))
        own, late = entries < len(self.body.names), entries == len(self.body.names)
        if own.any() or late.any():
            dense = placement.dense(len(self.body.names))
            moves[:, own] = dense[:, entries[own]]
            if late.any() and rates is not None:
                moves[:, late] = np.einsum("nmk,m->nk", dense[:, : len(rates)], rates)[:, None]
        camera_part = entries - self._first_camera - camera * len(CAMERA_NAMES)
        turned = (
            (camera_part >= 0) & (camera_part < len(CAMERA_NAMES)) & (entries < self._first_bias)
        )
        moves[:, turned] = motions[camera, camera_part[turned]]
        return moves
