"""Several frames fitted together: each one's own unknowns, and those that all frames share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import block_diag

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.fit.background import odds_of_colours
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
from drake_pose.fit.covariance import ComparedMask
from drake_pose.fit.evidence import Evidence, FrameEvidence, widened
from drake_pose.fit.kernel import Sum
from drake_pose.fit.levenberg_marquardt import (
    AnnealingStage,
    Coupling,
    Equations,
    StepSettings,
    minimise,
)
from drake_pose.fit.parameters import (
    CAMERA_NAMES,
    BodyParameters,
    CameraParameters,
    Placement,
)
from drake_pose.fit.unknowns import Unknowns
from drake_pose.workers import map_ordered

WIDTH = "width"
"""By how much a silhouette is too wide on all sides [pixel]: a parameter of each camera."""

TIME_OFFSET = "time_offset"
"""By how much later than their positions pictures were taken [s]: a parameter of the frame."""


@dataclass(frozen=True, eq=False)
class FittedFrames:
    """What frames were fitted by.

    Attributes:
        own: (frames, p) each frame's own unknowns.
        shared: (q,) those of all frames.
        parameters: (frames, n) all parameters of the frames.
        cost: of all frames at the end, with what is known without pictures.
        ending: tells the equations, and what fits, at the end; asked where that is asked for.
        coupling: what was known of the frames' own unknowns together.
    """

    own: Array
    shared: Array
    parameters: Array
    cost: float
    ending: Callable[[], tuple[Equations, Array]]
    coupling: Coupling | None = None

    @property
    def equations(self) -> Equations:
        """The normal equations at the end, priors included but for the coupling."""
        return self.ending()[0]

    @property
    def inlier_ratios(self) -> Array:
        """(frames, cameras) of both contours' lengths, what fits."""
        return self.ending()[1]

    def own_deviations(self) -> Array:
        """(frames, p) standard deviations, with the coupling and what shared unknowns may be.

        They are 100 [of the unknown's unit] at most, where nothing tells.
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
    """All parameters of a frame: the body's, TIME_OFFSET, CAMERA_NAMES of each camera, WIDTHs."""
    looks = [f"{camera.name}.{name}" for camera in cameras for name in CAMERA_NAMES]
    widths = [f"{camera.name}.{WIDTH}" for camera in cameras]
    return (*body.names, TIME_OFFSET, *looks, *widths)


class FramesFit:
    """Fits unknowns of several frames that the same cameras see.

    Attributes:
        body: the body.
        names: of all parameters of a frame, parameter_names.

    Args:
        body: the body.
        cameras: the cameras.
        unknowns: which parameters are unknown.
        pivot: (3,) or (cameras, 3), about which in the world cameras turn [m]; None: the root's
            place.
        noise: what a point of contour is worth.
        steps: how steps are made.
        pixels: of the unit of length of rounds and noise, of all cameras or (cameras,); None: the
            metre's at the root.
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
        pixels: float | Array | None = None,
    ) -> None:
        kinematics = body.kinematics
        values = kinematics.flatten(kinematics.tree.default_values())
        where = kinematics.poses(values)[0, :3, 3] if pivot is None else pivot
        self.body, self._cameras = body, CameraParameters(cameras, where)
        self.names = parameter_names(body, cameras)
        self.unknowns = unknowns
        self._contours = ContourFit(kinematics, body.outlines, noise, steps, pixels, body)
        self._first_look = len(body.names) + 1
        self._first_width = len(self.names) - len(cameras)
        self._widths = np.flatnonzero(unknowns.entries >= self._first_width)
        self._of_odds = odds_of_colours(len(body.outlines))
        self._fixed = not np.any(unknowns.entries >= self._first_look)
        # A body is placed faster that neither grows nor is shifted.
        self._values = len(kinematics.names)
        places = (unknowns.entries >= self._values) & (unknowns.entries < len(body.names))
        self._stays = not places.any()
        # A body of which nothing is unknown stands still, and all its nodes move with the camera.
        self._stands = not np.any(unknowns.entries <= len(body.names))
        self._placed: dict[bytes, Placement] = {}
        self._last_look: tuple[bytes, tuple[Array, Array, Array]] = (
            b"",
            self._cameras.place(np.zeros(len(self._cameras.names))),
        )

    def fit(
        self,
        frames: Sequence[Evidence | FrameEvidence],
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
            frames: what the cameras see in each.
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
        found = minimise(evaluate, own, shared, limits, rounds, self._contours.steps, coupling)
        at = found.own, found.shared
        parameters = [
            self.unknowns.parameters(one, x, found.shared)
            for one, x in zip(base, found.own, strict=True)
        ]
        return FittedFrames(
            found.own,
            found.shared,
            np.array(parameters),
            found.cost,
            cache(lambda: self._equations(frames, base, at, about, rounds[-1], shared_information)),
            coupling,
        )

    def equations(
        self,
        frames: Sequence[Evidence | FrameEvidence],
        held: Array,
        own: Array,
        shared: Array,
        step: AnnealingStage,
        expected: tuple[Array, Array] | None = None,
    ) -> Equations:
        """The normal equations at some unknowns; arguments as in fit."""
        base = np.zeros((len(frames), len(self.names)))
        base[:, : held.shape[1]] = held
        about = (own, shared) if expected is None else expected
        return self._equations(frames, base, (own, shared), about, step, None)[0]

    def _equations(
        self,
        frames: Sequence[Evidence | FrameEvidence],
        base: Array,
        at: tuple[Array, Array],
        about: tuple[Array, Array],
        step: AnnealingStage,
        shared_information: Array | None,
    ) -> tuple[Equations, Array]:
        """The equations, and of both contours' lengths what fits (frames, cameras)."""
        unknowns = self.unknowns
        p, u = unknowns.own_count, len(unknowns.names)
        H, g, cost = np.zeros((len(frames), u, u)), np.zeros((len(frames), u)), 0.0
        shares = []

        def told(k: int) -> tuple[Array, Array, Array]:
            theta = unknowns.parameters(base[k], at[0][k], at[1])
            return self._frame(frames[k], theta, step)

        for k, (own_H, own_g, sums) in enumerate(map_ordered(told, range(len(frames)))):
            H[k], g[k] = own_H, own_g
            cost += float(sums[:, :, Sum.COST].sum())
            lengths = np.maximum(sums[:, :, Sum.COMPARED].sum(axis=1), 1e-9)
            shares.append(sums[:, :, Sum.FITTING].sum(axis=1) / lengths)
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
        return Equations(H, g, cost + float(off @ information @ off)), np.array(shares)

    def _frame(
        self, evidence: Evidence | FrameEvidence, theta: Array, step: AnnealingStage
    ) -> tuple[Array, Array, Array]:
        """A frame's equations of the unknowns, and its sums."""
        compared, (_, _, motions) = self.compare(evidence, theta, step)
        rates = evidence.rates if isinstance(evidence, FrameEvidence) else None
        if self._fixed:
            moves = self._moves(compared, motions, 0, rates)
            told = [(moves, compared.total.A, compared.total.b)]
        else:
            told = [
                (self._moves(compared, motions, c, rates), A, b)
                for c, (A, b) in enumerate(zip(compared.A, compared.b, strict=True))
            ]
        u = len(self.unknowns.entries)
        H, g = np.zeros((u, u)), np.zeros(u)
        for moves, A, b in told:
            if self._stands:
                moves, A, b = moves[:1], A.sum(axis=0)[None], b.sum(axis=0)[None]
            rows, pulled = (
                np.swapaxes(one, 0, 1).reshape(u, -1) for one in (moves, moves @ symmetric(A))
            )
            H += rows @ pulled.T
            g -= rows @ b.ravel()
        for k in self._widths:
            # Of a silhouette that is wider all distances are less.
            c = self.unknowns.entries[k] - self._first_width
            g[k] = -compared.wide[c, :, 12].sum()
            H[k] = H[:, k] = np.einsum(
                "nux,nx->u", told[0 if self._fixed else c][0], compared.wide[c, :, :12]
            )
            H[k, k] = compared.sums[c][:, Sum.WEIGHT].sum()
        return H, g, compared.sums

    def compare(
        self, evidence: Evidence | FrameEvidence, theta: Array, step: AnnealingStage
    ) -> tuple[Comparison, tuple[Array, Array, Array]]:
        """A frame's contours compared with its silhouettes at all parameters (n,).

        Returns:
            the comparison, and the cameras as of ``CameraParameters.place``.
        """
        places, seen = self.places(theta), _whole(evidence)
        views = self._views(seen.edges, theta, places)
        placed = self._placement(self._of_body(theta, seen.rates))
        weights = self._contours.weights(views.cameras, placed, step)
        compared = compare_views(views, placed, weights, len(self._widths) > 0)
        for c, picture in enumerate(seen.odds):
            if picture is not None:
                # Lines nearer than three pixels say the same; offsets are 0.4 scales apart.
                own = weights[c].copy()
                own[2] = max(own[2], 3.0)
                offset, width = max(1, round(own[1] * 0.4)), theta[self._first_width + c]
                compare_lines(
                    placed.packed, placed.X_WN, (places[0][c], places[1][c]), picture,
                    self._of_odds, own, offset, compared.A[c], compared.b[c],
                    compared.sums[c], compared.wide[c], width,
                )  # fmt: skip
        return compared, places

    def piece_costs(
        self, evidence: Evidence | FrameEvidence, theta: Array, step: AnnealingStage, side: float
    ) -> Array:
        """(cameras, k, k) the costs at all parameters (n,) by squares of a side [pixel]."""
        seen = _whole(evidence)
        views = self._views(seen.edges, theta, self.places(theta))
        return self._contours.piece_costs(views, self._of_body(theta, seen.rates), step, side)

    def _placement(self, own: Array) -> Placement:
        """The body at its parameters; where it stands still in each frame, found once."""
        if not self._stands:
            return self.body.place(own)
        key = own.tobytes()
        if key not in self._placed:
            self._placed[key] = self.body.place(own)
        return self._placed[key]

    def _of_body(self, theta: Array, rates: Array | None) -> Array:
        """The body's parameters, the tree's values alone where all others are 0."""
        own = theta[: len(self.body.names)]
        if rates is not None:
            own = own.copy()
            own[: self._values] += rates * theta[len(own)]
        return own[: self._values] if self._stays and not own[self._values :].any() else own

    def _views(self, evidence: Evidence, theta: Array, places: tuple[Array, Array, Array]) -> Views:
        """The cameras, and their silhouettes as wide as they are."""
        widths = theta[self._first_width :]
        return Views(places[:2], widened(evidence, -widths) if widths.any() else evidence)

    def places(self, theta: Array) -> tuple[Array, Array, Array]:
        """The cameras at all parameters (n,), as of ``CameraParameters.place``."""
        look = theta[self._first_look : self._first_width]
        # One frame after another mostly asks for the same.
        if look.tobytes() != self._last_look[0]:
            self._last_look = look.tobytes(), self._cameras.place(look)
        return self._last_look[1]

    def pictures(
        self, frames: Sequence[Evidence | FrameEvidence], parameters: Array, step: AnnealingStage
    ) -> list[ComparedMask]:
        """What each silhouette says at all parameters (frames, n).

        Its values are the unknowns but widths: each frame's own, then the shared ones.
        """
        chosen = self.unknowns.entries < self._first_width
        p = int(np.count_nonzero(chosen & ~self.unknowns.shared))
        q = int(np.count_nonzero(chosen & self.unknowns.shared))
        found = []
        for k, (evidence, theta) in enumerate(zip(frames, parameters, strict=True)):
            compared, (X_CW, kernel, motions) = self.compare(evidence, theta, step)
            X_WN = compared.placement.X_WN
            sizes = 1.0 / pixels_per_metre((X_CW, kernel), X_WN[:, :3, 3].mean(axis=0))
            for c in np.flatnonzero(compared.A.any(axis=(1, 2, 3))).tolist():
                rates = evidence.rates if isinstance(evidence, FrameEvidence) else None
                told = self._moves(compared, motions, c, rates)[:, chosen]
                own, shared = np.split(told, [p], axis=1)
                moves = np.zeros((len(X_WN), len(frames) * p + q, 12))
                moves[:, k * p : (k + 1) * p], moves[:, len(frames) * p :] = own, shared
                A = symmetric(compared.A[c])
                found.append(
                    ComparedMask(A, compared.b[c], X_WN, X_CW[c], moves, float(sizes[c]), c)
                )
        return found

    def _moves(
        self, compared: Comparison, motions: Array, camera: int, rates: Array | None
    ) -> Array:
        """(nodes, u, 12) how the unknowns move the nodes before a camera; widths move none."""
        entries, placement = self.unknowns.entries, compared.placement
        moves = np.zeros((len(placement.X_WN), len(entries), 12))
        own, late = entries < len(self.body.names), entries == len(self.body.names)
        if own.any() or late.any():
            dense = placement.dense(len(self.body.names))
            moves[:, own] = dense[:, entries[own]]
            if late.any() and rates is not None:
                moves[:, late] = np.einsum("nmk,m->nk", dense[:, : len(rates)], rates)[:, None]
        look = entries - self._first_look - camera * len(CAMERA_NAMES)
        turned = (look >= 0) & (look < len(CAMERA_NAMES)) & (entries < self._first_width)
        moves[:, turned] = motions[camera, look[turned]]
        return moves


def _whole(evidence: Evidence | FrameEvidence) -> FrameEvidence:
    """A frame's edges; of one that has no more it is not known how the body moves."""
    return evidence if isinstance(evidence, FrameEvidence) else FrameEvidence(evidence)
