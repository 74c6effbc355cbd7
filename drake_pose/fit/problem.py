"""A fit of several frames: unknowns of each frame, unknowns that all frames share, observations.

An unknown is added to one parameter of a frame. So a joint's position is an unknown of each frame
that is added to the joint's value; its offset is a shared unknown that is added to the same value,
where an encoder's readings are held; a segment's length is a shared unknown, added to a shape
joint's value.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.linalg import block_diag

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError, UnknownNameError
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
from drake_pose.fit.covariance import ComparedMask
from drake_pose.fit.evidence import Observation, widened
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

BOUNDARY_BIAS = "width"
"""Parameter of each camera: by how much its silhouettes are too wide on all sides [pixel]."""

TIME_OFFSET = "time_offset"
"""Parameter of a frame: by how much later than its positions its pictures were taken [s]."""


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Parameters of frames that are unknown.

    Args:
        names: of the u parameters, see ``parameter_names``.
        shared: whether they are the same in all frames.
        lower, upper: limits of all, or (u,) of each [rad, m, pixel or a logarithm].
        deviation: standard deviation of all, or (u,) of each, about what is expected.
    """

    names: Sequence[str]
    shared: bool = False
    lower: float | Array = -np.inf
    upper: float | Array = np.inf
    deviation: float | Array = np.inf


@dataclass(frozen=True, eq=False)
class Solution:
    """The unknowns of a problem that fit best.

    Attributes:
        own: (frames, p) each frame's own unknowns.
        shared: (q,) those of all frames.
        parameters: (frames, n) all parameters of the frames.
        cost: of all frames, priors included.
        ending: evaluates the normal equations and the inlier ratios at the end, when asked for.
        coupling: what was known of the frames' own unknowns together.
    """

    own: Array
    shared: Array
    parameters: Array
    cost: float
    ending: Callable[[], tuple[Equations, Array]]
    coupling: LinearPrior | None = None

    @property
    def equations(self) -> Equations:
        """The normal equations, priors included but for the coupling."""
        return self.ending()[0]

    @property
    def inlier_ratios(self) -> Array:
        """(frames, cameras) fraction of both contours' lengths that fits."""
        return self.ending()[1]

    def own_deviations(self) -> Array:
        """(frames, p) standard deviations of own unknowns, shared ones being unknown, too.

        They are 100 [of the unknown's unit] at most, where nothing is observed.
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
    widths = [f"{camera.name}.{BOUNDARY_BIAS}" for camera in cameras]
    return (*body.names, TIME_OFFSET, *looks, *widths)


class Problem:
    """Unknowns of frames of a body that the same cameras see.

    Attributes:
        body: the body.
        names: of the u unknowns: the p of each frame first, then the q shared ones.
        entries: (u,) the parameter of a frame that each is added to.
        own_count: p.
        information: (u,) one over the variance of each, without pictures.

    Args:
        body: the body.
        cameras: the cameras.
        unknowns: which parameters are unknown.
        pivot: (3,) or (cameras, 3) the point in the world about which cameras turn [m]; None: the
            root's place.
        noise: of contours; None: a pixel's, or ``Noise()`` where lengths are in metres.
        steps: how steps are made.
        pixels: the unit of length of rounds and noise [pixel], of all cameras or (cameras,); None:
            a metre at the root.

    Raises:
        UnknownNameError: an unknown that is no parameter.
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
    ) -> None:
        kinematics = body.kinematics
        if pivot is None:
            values = kinematics.flatten(kinematics.tree.default_values())
            pivot = kinematics.poses(values)[0, :3, 3]
        if noise is None and pixels is not None:
            noise = Noise.of_a_pixel(pixels)
        self.body, self._cameras = body, CameraParameters(cameras, pivot)
        every = list(parameter_names(body, cameras))
        unknowns = sorted(unknowns, key=lambda one: one.shared)
        self.names = tuple(name for one in unknowns for name in one.names)
        for name in self.names:
            if name not in every:
                raise UnknownNameError("parameter", name, every, "the fit")
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
        self._count, self._first_look = len(every), len(body.names) + 1
        self._first_width = len(every) - len(cameras)
        self._widths = np.flatnonzero(self.entries >= self._first_width)
        self._of_foreground = foreground_of_colours(len(body.outlines))
        self._fixed = not np.any(self.entries >= self._first_look)
        # A body is placed faster that neither grows nor is shifted.
        self._values = len(kinematics.names)
        places = (self.entries >= self._values) & (self.entries < len(body.names))
        self._stays = not places.any()
        # A body without unknowns stands still, and all its nodes move with the camera.
        self._stands = not np.any(self.entries <= len(body.names))
        self._placed: dict[bytes, Placement] = {}
        self._last_look: tuple[bytes, tuple[Array, Array, Array]] = (
            b"",
            self._cameras.place(np.zeros(len(self._cameras.names))),
        )

    def solve(
        self,
        observations: Sequence[Observation],
        rounds: Sequence[AnnealingStage],
        start: tuple[Array, Array] | None = None,
        *,
        expected: tuple[Array, Array] | None = None,
        shared_information: Array | None = None,
        coupling: LinearPrior | None = None,
    ) -> Solution:
        """The unknowns that fit best, near where they start.

        Args:
            observations: the frames.
            rounds: the parts of the fit.
            start: (frames, p) own and (q,) shared unknowns; None: all 0.
            expected: mean of the unknowns' prior; None: where the fit starts.
            shared_information: (q, q) further information about the shared unknowns.
            coupling: what is known of all frames' own unknowns together.

        Raises:
            SettingsError: shapes that do not fit each other.
        """
        frames, p, q = len(observations), self.own_count, len(self.names) - self.own_count
        own, shared = (np.zeros((frames, p)), np.zeros(q)) if start is None else start
        if own.shape != (frames, p) or shared.shape != (q,):
            raise SettingsError(
                f"{frames} frames with {p} own and {q} shared unknowns expected, got "
                f"{own.shape} and {shared.shape}"
            )
        about = (own.copy(), shared.copy()) if expected is None else expected

        def evaluate(own: Array, shared: Array, step: AnnealingStage) -> Equations:
            return self._equations(observations, (own, shared), about, step, shared_information)[0]

        limits = self._lower, self._upper
        own, shared, cost = minimise(
            evaluate, own, shared, limits, rounds, self._contours.steps, coupling
        )[:3]
        at, last = (own, shared), rounds[-1]
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
        step: AnnealingStage,
        expected: tuple[Array, Array] | None = None,
    ) -> Equations:
        """The normal equations at own and shared unknowns; arguments as of ``solve``."""
        return self._equations(observations, at, expected or at, step, None)[0]

    def parameters(self, observations: Sequence[Observation], own: Array, shared: Array) -> Array:
        """(frames, n) all parameters at own (frames, p) and shared (q,) unknowns."""
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
        step: AnnealingStage,
        shared_information: Array | None,
    ) -> tuple[Equations, Array]:
        """The equations, and the inlier ratios (frames, cameras)."""
        p, u, frames = self.own_count, len(self.names), len(observations)
        H, g, cost = np.zeros((frames, u, u)), np.zeros((frames, u)), 0.0
        ratios = []
        masks = zip(observations, self.parameters(observations, *at), strict=True)
        for k, (own_H, own_g, sums) in enumerate(
            map_ordered(lambda mask: self._frame(*mask, step), masks)
        ):
            H[k], g[k] = own_H, own_g
            cost += float(sums[:, :, Sum.COST].sum())
            lengths = np.maximum(sums[:, :, Sum.COMPARED].sum(axis=1), 1e-9)
            ratios.append(sums[:, :, Sum.FITTING].sum(axis=1) / lengths)
            off = at[0][k] - about[0][k]
            own_information = self.information[:p]
            H[k, range(p), range(p)] += own_information
            g[k, :p] += own_information * off
            cost += float(own_information @ off**2)
        information = np.diag(self.information[p:])
        if shared_information is not None:
            information = information + shared_information
        off = at[1] - about[1]
        # The prior of what is shared counts once: with the first frame.
        H[0, p:, p:] += information
        g[0, p:] += information @ off
        return Equations(H, g, cost + float(off @ information @ off)), np.array(ratios)

    def _frame(
        self, seen: Observation, theta: Array, step: AnnealingStage
    ) -> tuple[Array, Array, Array]:
        """A frame's equations of the unknowns, and its sums."""
        compared, (_, _, motions) = self.compare(seen, theta, step)
        if self._fixed:
            moves = self._moves(compared, motions, 0, seen.rates)
            told = [(moves, compared.A.sum(axis=0), compared.b.sum(axis=0))]
        else:
            told = [
                (self._moves(compared, motions, c, seen.rates), A, b)
                for c, (A, b) in enumerate(zip(compared.A, compared.b, strict=True))
            ]
        u = len(self.entries)
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
            c = self.entries[k] - self._first_width
            g[k] = -compared.wide[c, :, 12].sum()
            H[k] = H[:, k] = np.einsum(
                "nux,nx->u", told[0 if self._fixed else c][0], compared.wide[c, :, :12]
            )
            H[k, k] = compared.sums[c][:, Sum.WEIGHT].sum()
        return H, g, compared.sums

    def compare(
        self, seen: Observation, theta: Array, step: AnnealingStage
    ) -> tuple[Comparison, tuple[Array, Array, Array]]:
        """A frame's contours compared with its silhouettes at all parameters (n,).

        Returns:
            the comparison, and the cameras as of ``CameraParameters.place``.
        """
        places = self.place_cameras(theta)
        views = self._views(seen, theta)
        own = self._of_body(theta, seen.rates)
        # Where the body stands still in each frame it is placed once.
        placed = self._placed.get(key := own.tobytes()) or self.body.place(own)
        if self._stands:
            self._placed[key] = placed
        weights = self._contours.weights(views.cameras, placed, step)
        compared = compare_views(views, placed, weights, len(self._widths) > 0)
        for c, picture in enumerate(seen.foreground):
            if picture is not None:
                # Lines nearer than three pixels say the same; offsets are 0.4 scales apart.
                own = weights[c].copy()
                own[2] = max(own[2], 3.0)
                offset, width = max(1, round(own[1] * 0.4)), theta[self._first_width + c]
                compare_lines(
                    placed.packed, placed.X_WN, (places[0][c], places[1][c]), picture,
                    self._of_foreground, own, offset, compared.A[c], compared.b[c],
                    compared.sums[c], compared.wide[c], width,
                )  # fmt: skip
        return compared, places

    def tile_costs(
        self, seen: Observation, theta: Array, step: AnnealingStage, side: float
    ) -> Array:
        """(cameras, k, k) the costs at all parameters (n,) by squares of a side [pixel]."""
        views = self._views(seen, theta)
        return self._contours.tile_costs(views, self._of_body(theta, seen.rates), step, side)

    def _of_body(self, theta: Array, rates: Array | None) -> Array:
        """The body's parameters, the tree's values alone where all others are 0."""
        own = theta[: len(self.body.names)]
        if rates is not None:
            own = own.copy()
            own[: self._values] += rates * theta[len(own)]
        return own[: self._values] if self._stays and not own[self._values :].any() else own

    def _views(self, seen: Observation, theta: Array) -> Views:
        """The cameras, and their silhouettes as wide as they are."""
        widths = theta[self._first_width :]
        edges = widened(seen.edges, -widths) if widths.any() else seen.edges
        return Views(self.place_cameras(theta)[:2], edges)

    def place_cameras(self, theta: Array) -> tuple[Array, Array, Array]:
        """The cameras at all parameters (n,), as of ``CameraParameters.place``."""
        look = theta[self._first_look : self._first_width]
        # One frame after another mostly asks for the same.
        if look.tobytes() != self._last_look[0]:
            self._last_look = look.tobytes(), self._cameras.place(look)
        return self._last_look[1]

    def compared_masks(
        self, observations: Sequence[Observation], parameters: Array, step: AnnealingStage
    ) -> list[ComparedMask]:
        """What each silhouette says at all parameters (frames, n).

        Its values are the unknowns but widths: each frame's own, then the shared ones.
        """
        chosen, frames = self.entries < self._first_width, len(observations)
        p = int(np.count_nonzero(chosen[: self.own_count]))
        q = int(np.count_nonzero(chosen[self.own_count :]))
        found = []
        for k, (seen, theta) in enumerate(zip(observations, parameters, strict=True)):
            compared, (X_CW, kernel, motions) = self.compare(seen, theta, step)
            X_WN = compared.placement.X_WN
            sizes = 1.0 / pixels_per_metre((X_CW, kernel), X_WN[:, :3, 3].mean(axis=0))
            for c in np.flatnonzero(compared.A.any(axis=(1, 2, 3))).tolist():
                told = self._moves(compared, motions, c, seen.rates)[:, chosen]
                own, shared = np.split(told, [p], axis=1)
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
        """(nodes, u, 12) how the unknowns move the nodes before a camera; widths move none."""
        entries, placement = self.entries, compared.placement
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
