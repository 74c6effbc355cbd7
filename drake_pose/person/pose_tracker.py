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

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.fit.colours import PartColours
from drake_pose.fit.contour_fit import Comparison, ContourFit, PoseFit, Prior, symmetric
from drake_pose.fit.covariance import surface_deformations
from drake_pose.fit.kernel import Sum
from drake_pose.person.search import EXACT, BodyPlan, PersonSearch, PersonSettings
from drake_pose.person.views import ColourViews, FrameViews


class PoseUncertainty(NamedTuple):
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
    *,
    place: float = 10.0,
) -> PoseUncertainty:
    """The uncertainty of a fitted pose by the pictures and the limits, without the last frame.

    Args:
        compared: what the cameras say of the pose at the scale of the last step.
        held: (m,) values that were held, such as lengths.
        held_covariance: (h, h) of these; None: they are exact.
        place: a person is somewhere in a place as large [m].
    """
    size = len(fit.lower)
    held = np.zeros(size, dtype=np.bool_) if held is None else held
    free = np.flatnonzero(~held)
    A, X_WN = symmetric(compared.A), compared.placement.X_WN
    whole, b = A.sum(axis=0), compared.b.sum(axis=0)
    # (nodes, m, 12): what each value does to each node.
    moves = compared.placement.dense(size)
    # Limits tell as much as an even distribution between them has variance.
    span = np.minimum(fit.upper - fit.lower, np.where(fit.kinematics.is_angle, 2.0 * np.pi, place))
    apriori = 12.0 / np.maximum(span, 1e-6) ** 2
    # How far parts' surfaces may be off the model's [m].
    surfaces = 0.0005 * np.sqrt(2.0) ** np.arange(13)
    # What all cameras say of each part by itself, free to shift, turn and stretch, along
    # independent directions (nodes, 12, 12), each a motion of the surface by about a metre.
    K = surface_deformations(fit.outlines, X_WN)
    information, turns = np.linalg.eigh(np.swapaxes(K, 1, 2) @ whole @ K)
    information, K = np.maximum(information, 0.0), K @ turns
    alone = (K / (information + surfaces[-1] ** -2)[:, None]) @ np.swapaxes(K, 1, 2)
    left = compared.b - (A @ (alone @ b[..., None]))[..., 0]
    between = _noise(A, left, alone)

    def with_surfaces(variance: float, surfaces: Array) -> tuple[Array, Array]:
        """Likelihoods (k,) and informations (k, m, m) of surfaces as far off (k,) [m].

        All at once, as each alone is little work; the distances have this variance.
        """
        H = (moves @ whole @ np.swapaxes(moves, 1, 2)).sum(axis=0) / variance
        # What each value does along the parts' directions, as far as it was seen: (m, k).
        along = np.swapaxes(moves @ whole @ K, 0, 1) / variance
        along = along.reshape(size, -1)
        pulls = (np.einsum("nij,ni->nj", K, b) / variance).ravel()
        seen = information.ravel() / variance
        share = 1.0 / (seen + surfaces[:, None] ** -2)
        H = H - (along * share[:, None]) @ along.T
        g = np.einsum("njk,nk->j", moves, b) / variance
        g = (g - (share * pulls) @ along.T)[:, free]
        own = H[:, free[:, None], free] + np.diag(apriori[free])
        explained = (share * pulls**2).sum(axis=1)
        explained += (g * np.linalg.solve(own, g[..., None])[..., 0]).sum(axis=1)
        freedom = np.log1p(surfaces[:, None] ** 2 * seen).sum(axis=1)
        return 0.5 * (explained - freedom - np.linalg.slogdet(own)[1]), H

    likeliest = int(np.argmax(with_surfaces(between, surfaces)[0]))
    surface = surfaces[likeliest : likeliest + 1]
    # The nearest points of two contours are nearer than those that belong together. So the noise
    # that counts is the larger one: of the whole body's distances, the surface's share included.
    own = (moves @ whole @ np.swapaxes(moves, 1, 2)).sum(axis=0)[np.ix_(free, free)]
    V = np.linalg.inv(own + np.diag(apriori[free]))
    Q = np.swapaxes(moves[:, free], 1, 2) @ V @ moves[:, free]
    noise = max(between, _noise(A, compared.b, Q))
    H = with_surfaces(noise, surface)[1][0]
    covariance = np.zeros((size, size))
    own = np.linalg.inv(H[np.ix_(free, free)] + np.diag(apriori[free]))
    covariance[np.ix_(free, free)] = own
    if held_covariance is not None and held.any():
        follow = np.eye(size)[:, held]
        follow[free] = -own @ H[np.ix_(free, held)]
        covariance += follow @ held_covariance @ follow.T
    return PoseUncertainty(covariance, H, noise, float(surface[0]))


def _noise(A: Array, b: Array, Q: Array, assumed: float = 4.0) -> float:
    """The variance of distances (A, b of a comparison); Q (nodes, 12, 12): motions' covariance.

    The fit's own noise counts as much as `assumed` distances.
    """
    shares = Q @ A
    # What was fitted follows the distances: they are as much smaller as it has freedom.
    freedom = np.einsum("cnii->", shares) - np.einsum("cnij,cnji->", shares, shares)
    pulls = np.einsum("cni,nij,cnj->", b, Q, b)
    return float((pulls + assumed) / (max(freedom, 0.0) + assumed))


@dataclass(frozen=True, eq=False)
class TrackState:
    """What is known of a person after a frame.

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
        return (
            self.share < PersonSettings.lost_below * self.usual
            or self.worst < PersonSettings.part_lost_below
        )


class PersonPoseTracker:
    """Follows a person.

    Args:
        fit: made for the person's pose tree.
        settings: EXACT, or LENIENT where the model is only like the person.
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
        settings: PersonSettings = EXACT,
        held: Mask | None = None,
        rest: Array | None = None,
        plan: BodyPlan | None = None,
    ) -> None:
        self.fit, self.settings = fit, settings
        self.plan = plan or BodyPlan(fit.kinematics)
        is_angle = fit.kinematics.is_angle
        self._held = np.zeros(len(is_angle), dtype=np.bool_) if held is None else held
        deviations = np.where(is_angle, settings.angle_deviation, settings.length_deviation)
        self._information = deviations**-2.0
        model = fit.tree.model
        self._order: Indices = np.array([model.position_index(n) for n in fit.kinematics.names])
        if rest is None:
            rest = fit.kinematics.flatten(fit.tree.default_values())
        self._rest = rest
        self.search = PersonSearch(fit, self.plan, settings, self._information, self._held, rest)

    def start(self, values: Array, share: float = 1.0) -> TrackState:
        """A state at rest at values (m,) of the pose tree, of which a share of contours fits."""
        still = np.zeros(len(values))
        return TrackState(np.array(values, dtype=np.float64), still, share, self.settings.usual)

    def worn(self, values: Array) -> Array:
        """Values (m,) with the tracker's own held ones."""
        return np.where(self._held, self._rest, values)

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
        placement = self.fit.body.place(values)
        compared = seen.compare(self.fit, placement, self.settings.follow[-1])
        sure = pose_uncertainty(self.fit, compared, self._held, held_covariance)
        deviations = np.zeros(len(self.fit.tree.model.position_names))
        deviations[self._order] = np.sqrt(np.diag(sure.covariance))
        return deviations

    def follow(self, last: TrackState | None, frame: FrameViews) -> TrackState | None:
        """The next state; None where nothing is known yet and not two cameras see a person."""
        settings = self.settings
        if last is None:
            found = self.search.found(frame, range(settings.headings))
            return None if found is None else self.start(found.values, found.inlier_ratio)
        fitted = self._fitted(last, frame)
        enough = last.usual - settings.retry_below
        lost = fitted.inlier_ratio < settings.lost_below * last.usual
        # Limbs are searched again in the first troubled frames, then in every eighth.
        is_due = 0 <= last.troubled < 4 or last.troubled % 8 == 0
        due = fitted.inlier_ratio < enough and is_due
        if due and not lost:
            first, limbs = last.troubled * settings.limbs_a_frame, settings.limbs_a_frame
            fitted = self.search.mended(fitted, frame, enough, first, limbs)
        share, doubted = fitted.inlier_ratio, last.troubled < 0
        state = TrackState(
            fitted.values,
            fitted.values - last.values if last.troubled == 0 else np.zeros(len(last.values)),
            share,
            max(share, last.usual + (share - last.usual) / settings.memory),
            last.troubled + 1 if doubted or share < enough else 0,
        )
        hopeless = due and share < enough and last.troubled > 0
        if not (lost or doubted or hopeless):
            return state
        # The person found anew where that fits better, all headings in turn.
        headings = settings.headings_of(last.troubled)
        found = self.search.found(frame, headings, last.values, last.usual)
        if found is None or found.inlier_ratio <= share:
            return state
        left = last.troubled + 1 if doubted else 1 - settings.cycle
        return replace(
            self.start(found.values, found.inlier_ratio), usual=state.usual, troubled=left
        )

    def follow_by_colour(
        self, last: TrackState, colours: ColourViews, own: PartColours | None = None
    ) -> TrackState:
        """The next frame, where pictures say where the person's edge is.

        A limb that does not show its own colours is searched again; if it does not then, either,
        the person is lost.
        """
        fitted, shown = self._fitted(last, colours), 1.0
        if own is not None:

            def shows(values: Array) -> Array:
                seen = zip(colours.cameras, colours.pictures, strict=True)
                return own.shown(self.fit.outlines, self.fit.kinematics.poses(values), seen)

            enough, shares = self.settings.part_lost_below, shows(fitted.values)
            for limb in self.plan.limbs.values():
                worst = float(np.nanmin([*shares[limb.nodes], 1.0]))
                if worst < enough:
                    placed = self.search.placed_by_colour(fitted.values, limb, colours, own.known)
                    told = [(one, np.nan_to_num(shows(one.values))) for one in placed]
                    right = [one for one in told if one[1][limb.nodes].min() >= enough]
                    if right:
                        fitted, shares = max(right, key=lambda one: one[0].closeness)
                        worst = 1.0
                shown = min(shown, worst)
        step = fitted.values - last.values
        lengths, fitting = fitted.sums[:-1, [Sum.COMPARED, Sum.FITTING]].T
        seen_enough = lengths >= self.settings.telling
        least = np.min(fitting / np.maximum(lengths, 1e-9), where=seen_enough, initial=shown)
        return TrackState(fitted.values, step, fitted.inlier_ratio, last.usual, worst=float(least))

    def distance_by_colour(self, values: Array, colours: ColourViews) -> float:
        """RMS distance [pixel] of the contour at values (m,) to the colours'; nan: none is seen."""
        placement = self.fit.body.place(values)
        sums = colours.compare(self.fit, placement, self.settings.follow[-1]).sums
        squares, weight = sums[:, :, [Sum.SQUARES, Sum.WEIGHT]].sum(axis=(0, 1))
        return float(np.sqrt(squares / weight)) if weight > 0.0 else float("nan")

    def _fitted(self, last: TrackState, seen: FrameViews | ColourViews) -> PoseFit:
        """The frame fitted from where the last ones point to."""
        expected = last.values + self.settings.carry * last.step
        prior = Prior(expected, self._information)
        compare = partial(seen.compare, self.fit)
        return self.fit.fit(compare, expected, self.settings.follow, prior, self._held)
