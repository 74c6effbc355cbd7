"""A person followed by all silhouettes at once; a lost limb or track is searched again.

Every frame is fitted from where the last ones point to. Limbs that do not fit are placed anew
where regions are unexplained; if all is lost, the whole person, turned to all sides in turn.

How sure a pose is: distances of the frame's contours give the noise, of one part in one camera
together, and how far each part's surface is off the model's: variance components by restricted
maximum likelihood (Patterson and Thompson 1971). What silhouettes do not tell is as unsure as the
limits let it.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask
from drake_pose.fit.colours import OwnColours
from drake_pose.fit.contour_fit import (
    Comparison,
    ContourFit,
    PoseFit,
    Prior,
    pack_views,
    symmetric,
)
from drake_pose.fit.covariance import surface_deformations
from drake_pose.fit.kernel import Sum
from drake_pose.person.body_plan import BodyPlan
from drake_pose.person.search import (
    CYCLE,
    EXACT,
    HEADINGS,
    LIMBS_A_FRAME,
    AnnealingSchedule,
    PersonSearch,
    headings_of,
)
from drake_pose.person.views import ColourViews, FrameViews

# How far parts' surfaces may be off the model's [m].
_SURFACES = 0.0005 * np.sqrt(2.0) ** np.arange(13)
# The fit's own noise counts as much as this many distances.
_ASSUMED = 4.0
# A person is somewhere in a place as large [m].
_PLACE = 10.0


@dataclass(frozen=True, eq=False)
class PoseUncertainty:
    """How sure a pose is.

    Args:
        covariance: (m, m) of the pose tree's values [rad, m].
        information: (m, m) by the silhouettes alone, of all values, held ones included.
        noise: the variance of the contours' distances, 1 as the fit's noise says.
        surface: how far the parts' surfaces are off the model's [m].
    """

    covariance: Array
    information: Array
    noise: float
    surface: float


def pose_uncertainty(
    fit: ContourFit,
    compared: Comparison,
    held: Mask | None = None,
    held_covariance: Array | None = None,
) -> PoseUncertainty:
    """The uncertainty of a fitted pose by the pictures and the limits, without the last frame.

    Args:
        compared: what the cameras say of the pose at the scale of the last step.
        held: (m,) values that were held, such as lengths.
        held_covariance: (h, h) of these; None: they are exact.
    """
    size = len(fit.lower)
    held = np.zeros(size, dtype=np.bool_) if held is None else held
    free = np.flatnonzero(~held)
    A = symmetric(compared.A)
    # (nodes, m, 12): what each value does to each node.
    moves = compared.placement.dense(size)
    apriori = _limits_information(fit)
    parts = _parts(fit, compared, A)
    between = _noise(A, parts.left, parts.alone)
    distances = _Distances.of(parts, between, moves)
    likeliest = int(np.argmax(distances.with_surfaces(_SURFACES, free, apriori)[0]))
    surface = _SURFACES[likeliest : likeliest + 1]
    # The nearest points of two contours are nearer than those that belong together. So the noise
    # that counts is the larger one: of the whole body's distances, the surface's share included.
    own = (moves @ A.sum(axis=0) @ np.swapaxes(moves, 1, 2)).sum(axis=0)[np.ix_(free, free)]
    V = np.linalg.inv(own + np.diag(apriori[free]))
    Q = np.swapaxes(moves[:, free], 1, 2) @ V @ moves[:, free]
    noise = max(between, _noise(A, compared.b, Q))
    H = _Distances.of(parts, noise, moves).with_surfaces(surface, free, apriori)[1][0]
    covariance = np.zeros((size, size))
    own = np.linalg.inv(H[np.ix_(free, free)] + np.diag(apriori[free]))
    covariance[np.ix_(free, free)] = own
    if held_covariance is not None and held.any():
        follow = np.eye(size)[:, held]
        follow[free] = -own @ H[np.ix_(free, held)]
        covariance += follow @ held_covariance @ follow.T
    return PoseUncertainty(covariance, H, noise, float(surface[0]))


def _limits_information(fit: ContourFit) -> Array:
    """(m,) what limits tell: as much as an even distribution between them has variance."""
    widest = np.where(fit.kinematics.is_angle, 2.0 * np.pi, _PLACE)
    span = np.minimum(fit.upper - fit.lower, widest)
    return np.asarray(12.0 / np.maximum(span, 1e-6) ** 2)


def _noise(A: Array, b: Array, Q: Array) -> float:
    """The variance of distances (A, b of a comparison); Q (nodes, 12, 12): motions' covariance."""
    shares = Q @ A
    # What was fitted follows the distances: they are as much smaller as it has freedom.
    freedom = np.einsum("cnii->", shares) - np.einsum("cnij,cnji->", shares, shares)
    pulls = np.einsum("cni,nij,cnj->", b, Q, b)
    return float((pulls + _ASSUMED) / (max(freedom, 0.0) + _ASSUMED))


class _Parts(NamedTuple):
    """What all cameras together say of each part by itself, along independent directions.

    A: (nodes, 12, 12); b: (nodes, 12); directions: (nodes, 12, 12) in columns, each a motion of the
    surface by about a metre; information: (nodes, 12) about each; alone: (nodes, 12, 12) covariance
    of each part's affine motion; left: (cameras, nodes, 12) b where each part fits best by itself.
    """

    A: Array
    b: Array
    directions: Array
    information: Array
    alone: Array
    left: Array


def _parts(fit: ContourFit, compared: Comparison, A: Array) -> _Parts:
    """All parts, each free to shift, turn and stretch; A: (cameras, nodes, 12, 12), symmetric."""
    K = surface_deformations(fit.outlines, compared.placement.X_WN)
    whole, b = A.sum(axis=0), compared.b.sum(axis=0)
    information, turns = np.linalg.eigh(np.swapaxes(K, 1, 2) @ whole @ K)
    information, K = np.maximum(information, 0.0), K @ turns
    alone = (K / (information + _SURFACES[-1] ** -2)[:, None]) @ np.swapaxes(K, 1, 2)
    left = compared.b - (A @ (alone @ b[..., None]))[..., 0]
    return _Parts(whole, b, K, information, alone, left)


class _Distances(NamedTuple):
    """What the contours' distances of one variance say of the values where surfaces are exact.

    H: (m, m) and g: (m,) the normal equations; moves: (m, k) what each value does along the parts'
    directions, as far as it was seen; information, pulls: (k,) of the surfaces along them.
    """

    H: Array
    g: Array
    moves: Array
    information: Array
    pulls: Array

    @staticmethod
    def of(parts: _Parts, noise: float, moves: Array) -> "_Distances":
        """What parts say where distances have this variance; moves: (nodes, m, 12)."""
        H = (moves @ parts.A @ np.swapaxes(moves, 1, 2)).sum(axis=0) / noise
        along = np.swapaxes(moves @ parts.A @ parts.directions, 0, 1) / noise
        pulls = np.einsum("nij,ni->nj", parts.directions, parts.b) / noise
        g = np.einsum("njk,nk->j", moves, parts.b) / noise
        information = parts.information.ravel() / noise
        return _Distances(H, g, along.reshape(len(H), -1), information, pulls.ravel())

    def with_surfaces(
        self, surfaces: Array, free: NDArray[np.intp], apriori: Array
    ) -> tuple[Array, Array]:
        """The likelihoods (k,) where surfaces are so far off (k,) [m], and informations (k, m, m).

        All at once, as each alone is little work.
        """
        share = 1.0 / (self.information + surfaces[:, None] ** -2)
        H = self.H - (self.moves * share[:, None]) @ self.moves.T
        g = (self.g - (share * self.pulls) @ self.moves.T)[:, free]
        own = H[:, free[:, None], free] + np.diag(apriori[free])
        explained = (share * self.pulls**2).sum(axis=1)
        explained += (g * np.linalg.solve(own, g[..., None])[..., 0]).sum(axis=1)
        freedom = np.log1p(surfaces[:, None] ** 2 * self.information).sum(axis=1)
        return 0.5 * (explained - freedom - np.linalg.slogdet(own)[1]), H


# The share of the last frame's step that is expected again, and how far that is off [rad, m].
_CARRY, _ANGLE_DEVIATION, _LENGTH_DEVIATION = 0.7, 0.3, 0.15
# Where so much less of the contours fits than usual, limbs are searched again; where less than this
# share of the usual, the whole person; who is followed by colour is lost where less of a part fits.
_RETRY_BELOW, _LOST_BELOW, _PART_LOST_BELOW = 0.03, 0.75, 0.4
# For how many frames the usual share is remembered, and what it is until it is known better.
_MEMORY, _USUAL = 60.0, 0.95
# Parts of which less contour is seen, in all cameras together [m], do not say that they are off.
_TELLING = 0.3


@dataclass(frozen=True, eq=False)
class TrackState:
    """What the next frame is told of this one.

    Args:
        values, step: (m,) of the pose tree, and their change from the last frame [rad or m].
        share, usual: of the contours, what fits, and what can be expected to.
        troubled: for how many frames too little has fitted; below 0: the person was found anew, and
            in this many frames all directions will have been tried.
        worst: of the contour of the part that fits worst, what fits, where colours say so.
    """

    values: Array
    step: Array
    share: float
    usual: float
    troubled: int = 0
    worst: float = 1.0

    @property
    def is_lost(self) -> bool:
        """Whether too little of the contours fits for the pose to be believed."""
        return self.share < _LOST_BELOW * self.usual or self.worst < _PART_LOST_BELOW


class PersonPoseTracker:
    """Follows a person.

    Args:
        fit: made for the person's pose tree.
        schedule: EXACT, or LENIENT where the model is only like the person.
        held: (m,) values that stay, such as lengths; None: none.
        rest: (m,) values of a person at rest, with the held ones; None: the tree's.
        plan: of the same kinematics, where it is made already.

    Raises:
        ModelError: the model has no landmarks of trunk, arms and legs.
        UnknownNameError: a value of the pose tree is no position of the plant.
    """

    def __init__(
        self,
        fit: ContourFit,
        schedule: AnnealingSchedule = EXACT,
        held: Mask | None = None,
        rest: Array | None = None,
        plan: BodyPlan | None = None,
    ) -> None:
        self.fit, self.schedule = fit, schedule
        self.plan = plan or BodyPlan(fit.kinematics)
        is_angle = fit.kinematics.is_angle
        self._held = np.zeros(len(is_angle), dtype=np.bool_) if held is None else held
        self._information = np.where(is_angle, _ANGLE_DEVIATION, _LENGTH_DEVIATION) ** -2.0
        model = fit.tree.model
        self._order = np.array([model.position_index(name) for name in fit.kinematics.names])
        if rest is None:
            rest = fit.kinematics.flatten(fit.tree.default_values())
        self._search = PersonSearch(
            fit, self.plan, schedule.search, self._information, self._held, rest
        )

    def start(self, values: Array) -> TrackState:
        """A state at rest at values (m,) of the pose tree."""
        return TrackState(np.array(values, dtype=np.float64), np.zeros(len(values)), 1.0, _USUAL)

    def positions(self, values: Array) -> Array:
        """The plant's q (nq,) of values (m,), free angles within half a turn."""
        free = np.isinf(self.fit.upper)
        turned = np.where(free, np.remainder(values + np.pi, 2.0 * np.pi) - np.pi, values)
        q = np.array(self.fit.tree.model.default_positions)
        q[self._order] = turned
        return q

    def values(self, q: Array) -> Array:
        """The pose tree's values (m,) of positions q (nq,)."""
        return np.array(q, dtype=np.float64)[self._order]

    def place(self, values: Array) -> Array:
        """(3,) where a person is who has values (m,): the trunk's middle [m]."""
        return self.plan.trunk_middle(self.fit.kinematics.poses(values))

    def deviations(
        self, values: Array, seen: FrameViews | ColourViews, held_covariance: Array | None = None
    ) -> Array:
        """(nq,) standard deviations of the plant's positions [rad or m] by the pictures alone.

        Args:
            values: (m,) of a frame's state; positions that are none of them deviate by 0.
            seen: the silhouettes or colours that the frame was followed by.
            held_covariance: (h, h) of the held values; None: they are exact.
        """
        last = self.schedule.follow[-1]
        if isinstance(seen, ColourViews):
            compared = seen.compare(self.fit, self.fit.body.place(values), last)
        else:
            views = pack_views(seen.cameras, [view.edge for view in seen.views])
            compared = self.fit.compare(views, values, last)
        sure = pose_uncertainty(self.fit, compared, self._held, held_covariance)
        deviations = np.zeros(len(self.fit.tree.model.position_names))
        deviations[self._order] = np.sqrt(np.diag(sure.covariance))
        return deviations

    def follow(self, last: TrackState | None, frame: FrameViews) -> TrackState | None:
        """The next state; None where nothing is known yet and not two cameras see a person."""
        if last is None:
            found = self._search.found(frame, range(HEADINGS))
            still = np.zeros(len(self._held))
            return (
                None
                if found is None
                else TrackState(found.values, still, found.inlier_ratio, _USUAL)
            )
        fitted = self._fitted(last, frame)
        enough = last.usual - _RETRY_BELOW
        lost = fitted.inlier_ratio < _LOST_BELOW * last.usual
        due = fitted.inlier_ratio < enough and _is_due(last.troubled)
        if due and not lost:
            first = last.troubled * LIMBS_A_FRAME
            fitted = self._search.mended(fitted, frame, enough, first, LIMBS_A_FRAME)
        doubted = last.troubled < 0
        state = TrackState(
            fitted.values,
            fitted.values - last.values if last.troubled == 0 else np.zeros(len(last.values)),
            fitted.inlier_ratio,
            max(fitted.inlier_ratio, last.usual + (fitted.inlier_ratio - last.usual) / _MEMORY),
            last.troubled + 1 if doubted or fitted.inlier_ratio < enough else 0,
        )
        hopeless = due and fitted.inlier_ratio < enough and last.troubled > 0
        return self._restarted(state, last, frame) if lost or doubted or hopeless else state

    def follow_by_colour(
        self, last: TrackState, colours: ColourViews, own: OwnColours | None = None
    ) -> TrackState:
        """The next frame, where pictures say where the person's edge is.

        A limb that does not show its own colours is searched again; if it does not then, either,
        the person is lost.
        """
        fitted, shown = self._fitted(last, colours), 1.0
        if own is not None:
            fitted, shown = self._recoloured(fitted, colours, own)
        step = fitted.values - last.values
        lengths, fitting = fitted.sums[:-1, [Sum.COMPARED, Sum.FITTING]].T
        worst = np.min(
            fitting / np.maximum(lengths, 1e-9), where=lengths >= _TELLING, initial=shown
        )
        return TrackState(fitted.values, step, fitted.inlier_ratio, last.usual, worst=float(worst))

    def _recoloured(
        self, fitted: PoseFit, colours: ColourViews, own: OwnColours
    ) -> tuple[PoseFit, float]:
        """A fit whose limbs show their own colours, where that is found; what the worst shows."""

        def shown(values: Array) -> Array:
            seen = zip(colours.cameras, colours.pictures, strict=True)
            return own.shown(self.fit.outlines, self.fit.kinematics.poses(values), seen)

        shares, least = shown(fitted.values), 1.0
        for limb in self.plan.limbs.values():
            worst = float(np.nanmin([*shares[limb.nodes], 1.0]))
            if worst < _PART_LOST_BELOW:
                placed = self._search.placed_by_colour(fitted.values, limb, colours, own.known)
                told = [(one, np.nan_to_num(shown(one.values))) for one in placed]
                right = [one for one in told if one[1][limb.nodes].min() >= _PART_LOST_BELOW]
                if right:
                    fitted, shares = max(right, key=lambda one: one[0].closeness)
                    worst = 1.0
            least = min(least, worst)
        return fitted, least

    def distance_by_colour(self, values: Array, colours: ColourViews) -> float:
        """RMS distance [pixel] of the contour at values (m,) to the colours'; nan: none is seen."""
        placement = self.fit.body.place(values)
        sums = colours.compare(self.fit, placement, self.schedule.follow[-1]).sums
        squares, weight = sums[:, :, [Sum.SQUARES, Sum.WEIGHT]].sum(axis=(0, 1))
        return float(np.sqrt(squares / weight)) if weight > 0.0 else float("nan")

    def _restarted(self, state: TrackState, last: TrackState, frame: FrameViews) -> TrackState:
        """A state, or the person found anew where that fits better, all headings in turn."""
        headings = headings_of(last.troubled)
        found = self._search.found(frame, headings, last.values, last.usual)
        if found is None or found.inlier_ratio <= state.share:
            return state
        left = last.troubled + 1 if last.troubled < 0 else 1 - CYCLE
        still = np.zeros(len(found.values))
        return replace(
            state, values=found.values, step=still, share=found.inlier_ratio, troubled=left
        )

    def _fitted(self, last: TrackState, seen: FrameViews | ColourViews) -> PoseFit:
        """The frame fitted from where the last ones point to."""
        expected = last.values + _CARRY * last.step
        prior = Prior(expected, self._information)
        compare = partial(seen.compare, self.fit)
        return self.fit.fit(compare, expected, self.schedule.follow, prior, self._held)


def _is_due(troubled: int) -> bool:
    """Whether to search again after this many troubled frames: 0 to 3, then every eighth time."""
    return 0 <= troubled < 4 or troubled % 8 == 0
