"""Several frames fitted together: each one's own unknowns, and those that all frames share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.fit.camera_sums import Views
from drake_pose.fit.contour_fit import Noise, compare_views, project
from drake_pose.fit.evidence import Evidence
from drake_pose.fit.kernel import COMPARED, COST, FITTING
from drake_pose.fit.levenberg_marquardt import (
    AnnealingStage,
    Coupling,
    Equations,
    StepSettings,
    minimise,
)
from drake_pose.fit.parameters import CAMERA_NAMES, BodyParameters, CameraParameters
from drake_pose.fit.unknowns import Unknowns

Array = NDArray[np.float64]


# Of an unknown of which nothing is told: one over the variance.
_LEAST_INFORMATION = 1e-4


@dataclass(frozen=True, eq=False)
class FittedFrames:
    """What frames were fitted by.

    Attributes:
        own: (frames, p) each frame's own unknowns.
        shared: (q,) those of all frames.
        parameters: (frames, n) all parameters of the frames.
        costs: (frames, cameras) what does not fit.
        inlier_ratios: (frames, cameras) of both contours' lengths, what fits.
        cost: of all frames at the end, with what is known without pictures.
        equations: the normal equations at the end, priors included but for the coupling.
        coupling: what was known of the frames' own unknowns together.
    """

    own: Array
    shared: Array
    parameters: Array
    costs: Array
    inlier_ratios: Array
    cost: float
    equations: Equations
    coupling: Coupling | None = None

    @property
    def shared_covariance(self) -> Array:
        """(q, q) of the shared unknowns, if the noise is what the fit was told."""
        p = self.own.shape[1]
        return np.asarray(np.linalg.inv(_reduced(self.equations, p)[0]))

    def frame_covariance(self, frame: int) -> Array:
        """(p, p) of a frame's own unknowns, the shared ones' uncertainty included."""
        p = self.own.shape[1]
        S, gains = _reduced(self.equations, p)
        own = np.asarray(np.linalg.inv(self.equations.H[frame, :p, :p]))
        if not len(S):
            return own
        return np.asarray(own + gains[frame] @ np.linalg.inv(S) @ gains[frame].T)

    def own_deviations(self) -> Array:
        """(frames, p) standard deviations, with the coupling and what shared unknowns may be.

        With a coupling they are 100 [of the unknown's unit] at most, where nothing tells.
        """
        frames, p = self.own.shape
        if self.coupling is None:
            variances = [np.diag(self.frame_covariance(k)) for k in range(frames)]
            return np.sqrt(np.array(variances))
        H = self.equations.H
        whole = self.coupling.curvature().toarray() + _LEAST_INFORMATION * np.eye(frames * p)
        for k in range(frames):
            whole[k * p : (k + 1) * p, k * p : (k + 1) * p] += H[k, :p, :p]
        covariance = np.linalg.inv(whole)
        mixed = H[:, :p, p:].reshape(frames * p, -1)
        gains = covariance @ mixed
        S = H[:, p:, p:].sum(axis=0) - mixed.T @ gains
        variances = np.diag(covariance) + np.einsum("ij,ji->i", gains, np.linalg.solve(S, gains.T))
        return np.sqrt(np.maximum(variances, 0.0)).reshape(frames, p)


class FramesFit:
    """Fits unknowns of several frames that the same cameras see.

    Attributes:
        names: of all parameters of a frame: the body's, then the cameras'.

    Args:
        body: the body.
        cameras: the cameras.
        unknowns: which parameters are unknown.
        pivot: (3,) the point in the world about which cameras turn [m]; None: the root's place.
        noise: what a point of contour is worth.
        steps: how steps are made.
        pixels: of the unit of length of rounds and noise; None: the metre's at the root.
    """

    def __init__(
        self,
        body: BodyParameters,
        cameras: Sequence[Camera],
        unknowns: Unknowns,
        *,
        pivot: Array | None = None,
        noise: Noise | None = None,
        steps: StepSettings | None = None,
        pixels: float | None = None,
    ) -> None:
        kinematics = body.kinematics
        values = kinematics.flatten(kinematics.tree.default_values())
        where = kinematics.poses(values)[0, :3, 3] if pivot is None else pivot
        self._body, self._cameras = body, CameraParameters(cameras, where)
        self.names = (*body.names, *self._cameras.names)
        self.unknowns, self._noise = unknowns, noise or Noise()
        self._steps, self._pixels = steps, pixels
        self._fixed = not np.any(unknowns.entries >= len(body.names))

    def fit(
        self,
        frames: Sequence[Evidence],
        held: Array,
        own: Array,
        shared: Array,
        rounds: Sequence[AnnealingStage],
        *,
        expected: tuple[Array, Array] | None = None,
        shared_information: Array | None = None,
        coupling: Coupling | None = None,
    ) -> FittedFrames:
        """Fits the unknowns.

        Args:
            frames: the edges that the cameras see in each.
            held: (frames, n) each frame's parameters where all unknowns are 0, such as an encoder's
                readings; or with fewer columns, those of the body's first parameters.
            own, shared: (frames, p) and (q,) where to start.
            rounds: the parts of the fit.
            expected: own and shared unknowns that what is known without pictures is about; None:
                where the fit starts.
            shared_information: (q, q) what else is known of the shared unknowns.
            coupling: what is known of all frames' own unknowns together.

        Raises:
            SettingsError: shapes that do not fit each other.
        """
        p, q = self.unknowns.own_count, len(self.unknowns.names) - self.unknowns.own_count
        base = np.zeros((len(frames), len(self.names)))
        if own.shape != (len(frames), p) or shared.shape != (q,) or len(held) != len(frames):
            raise SettingsError(
                f"{len(frames)} frames with {p} own and {q} shared unknowns expected, got "
                f"{own.shape}, {shared.shape} and {len(held)} frames that are held"
            )
        base[:, : held.shape[1]] = held
        about = (own.copy(), shared.copy()) if expected is None else expected

        def evaluate(own: Array, shared: Array, step: AnnealingStage) -> Equations:
            return self._equations(frames, base, (own, shared), about, step, shared_information)[0]

        limits = self.unknowns.lower, self.unknowns.upper
        found = minimise(evaluate, own, shared, limits, rounds, self._steps, coupling)
        equations, costs, shares = self._equations(
            frames, base, (found.own, found.shared), about, rounds[-1], shared_information
        )
        parameters = [
            self.unknowns.parameters(one, x, found.shared)
            for one, x in zip(base, found.own, strict=True)
        ]
        return FittedFrames(
            found.own,
            found.shared,
            np.array(parameters),
            costs,
            shares,
            found.cost,
            equations,
            coupling,
        )

    def equations(
        self,
        frames: Sequence[Evidence],
        held: Array,
        own: Array,
        shared: Array,
        step: AnnealingStage,
    ) -> Equations:
        """The normal equations at some unknowns; arguments as in fit."""
        base = np.zeros((len(frames), len(self.names)))
        base[:, : held.shape[1]] = held
        return self._equations(frames, base, (own, shared), (own, shared), step, None)[0]

    def _equations(
        self,
        frames: Sequence[Evidence],
        base: Array,
        at: tuple[Array, Array],
        about: tuple[Array, Array],
        step: AnnealingStage,
        shared_information: Array | None,
    ) -> tuple[Equations, Array, Array]:
        unknowns = self.unknowns
        p, u = unknowns.own_count, len(unknowns.names)
        H, g, cost = np.zeros((len(frames), u, u)), np.zeros((len(frames), u)), 0.0
        costs, shares = [], []
        for k, evidence in enumerate(frames):
            theta = unknowns.parameters(base[k], at[0][k], at[1])
            own_H, own_g, sums = self._frame(evidence, theta, step)
            H[k] = own_H[np.ix_(unknowns.entries, unknowns.entries)]
            g[k] = own_g[unknowns.entries]
            cost += float(sums[:, :, COST].sum())
            costs.append(sums[:, :, COST].sum(axis=1))
            lengths = np.maximum(sums[:, :, COMPARED].sum(axis=1), 1e-9)
            shares.append(sums[:, :, FITTING].sum(axis=1) / lengths)
            off = at[0][k] - about[0][k]
            own_information = unknowns.information[:p]
            H[k, range(p), range(p)] += own_information
            g[k, :p] += own_information * off
            cost += float(own_information @ off**2)
        information = np.diag(unknowns.information[p:])
        if shared_information is not None:
            information = information + shared_information
        off = at[1] - about[1]
        # The prior of what is shared counts once: with the first frame.
        H[0, p:, p:] += information
        g[0, p:] += information @ off
        return (
            Equations(H, g, cost + float(off @ information @ off)),
            np.array(costs),
            np.array(shares),
        )

    def _frame(
        self, evidence: Evidence, theta: Array, step: AnnealingStage
    ) -> tuple[Array, Array, Array]:
        """A frame's equations of all its parameters, and its sums."""
        size = len(self._body.names)
        X_CW, kernel, motions = self._cameras.place(theta[size:])
        views = Views((X_CW, kernel), evidence)
        compared = compare_views(self._body, views, theta[:size], step, self._noise, self._pixels)
        H, g = project(compared, size, None if self._fixed else motions)
        if self._fixed:
            more = len(motions) * len(CAMERA_NAMES)
            H, g = np.pad(H, (0, more)), np.pad(g, (0, more))
        return H, g, compared.sums


def _reduced(equations: Equations, p: int) -> tuple[Array, list[Array]]:
    """What all frames together tell of the shared unknowns, and how each frame follows them."""
    S = equations.H[:, p:, p:].sum(axis=0)
    gains = []
    for H in equations.H:
        gain = np.linalg.solve(H[:p, :p], H[:p, p:]) if p else np.zeros((0, len(S)))
        S = S - H[p:, :p] @ gain
        gains.append(gain)
    return S, gains
