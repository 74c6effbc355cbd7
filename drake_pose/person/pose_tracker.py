"""Tracking of a person by all silhouettes at once, with a search for lost limbs or persons.

Every frame is fitted from the pose that the last frames predict. Where noise does not explain the
contours, limbs are searched again where silhouettes are unexplained, then the person in all
headings; poses are compared by likelihood.

`pose_uncertainty` estimates two variance components by restricted maximum likelihood (Patterson and
Thompson 1971): the noise of the contours' distances, and the error of each part's surface. Values
that the silhouettes do not determine have the variance of a uniform distribution between limits.

A person's shape is lengths (shape joints) and radius scales (of parts, across their y axis).
`fit_shape` fits one shape to the silhouettes of several frames, together with each frame's pose.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.body import PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.errors import ModelError
from drake_pose.fit.contour_fit import (
    Comparison,
    ContourFit,
    Noise,
    PoseFit,
    Prior,
    pack_views,
    symmetric,
)
from drake_pose.fit.covariance import surface_deformations
from drake_pose.fit.evidence import NO_EDGE, EdgePoints, Observation, pack_evidence
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import RADIUS_SCALE_PREFIX, BodyParameters
from drake_pose.fit.problem import Problem, Unknowns
from drake_pose.fit.surfaces import with_radius_scales
from drake_pose.person.search import (
    EXACT,
    LENIENT,
    SIGNIFICANT,
    BodyPlan,
    PersonSearch,
    PersonSettings,
)
from drake_pose.person.views import FrameViews
from drake_pose.silhouette.outline import Outline


def pose_uncertainty(
    fit: ContourFit,
    compared: Comparison,
    held: Mask | None = None,
    held_covariance: Array | None = None,
    *,
    extent: float = 10.0,
) -> tuple[Array, Array, float]:
    """Return the uncertainty of a fitted pose, given the pictures and the limits alone.

    Args:
        fit: the fit that the pose is from.
        compared: comparison of the pose with all cameras at the scale of the last step.
        held: (m,) which values were held, for instance lengths; None: none.
        held_covariance: (h, h) covariance of the held values; None: they are exact.
        extent: of the region in which the person is [m].

    Returns:
        The covariance (m, m) of the pose tree's values [rad, m]; the information (m, m) of all
        values, held ones included, from the silhouettes alone; and the standard deviation of the
        parts' surfaces from the model's [m].
    """
    size = len(fit.lower)
    held = np.zeros(size, dtype=np.bool_) if held is None else held
    free = np.flatnonzero(~held)
    A, X_WN = symmetric(compared.A), compared.placement.X_WN
    A_sum, b = A.sum(axis=0), compared.b.sum(axis=0)
    # (nodes, m, 12): affine motion of each node per unit of each value.
    jacobians = compared.placement.dense(size)
    # A uniform distribution between two limits has the variance (upper - lower)^2 / 12.
    span = np.minimum(fit.upper - fit.lower, np.where(fit.kinematics.is_angle, 2.0 * np.pi, extent))
    prior_information = 12.0 / np.maximum(span, 1e-6) ** 2
    # Candidate standard deviations of the parts' surfaces [m].
    surface_deviations = 0.0005 * np.sqrt(2.0) ** np.arange(13)
    # Each part by itself, free to shift, turn and stretch, along independent directions
    # (nodes, 12, 12), each a motion of the surface by about a metre.
    K = surface_deformations(fit.outlines, X_WN)
    information, turns = np.linalg.eigh(np.swapaxes(K, 1, 2) @ A_sum @ K)
    information, K = np.maximum(information, 0.0), K @ turns
    part_covariance = (K / (information + surface_deviations[-1] ** -2)[:, None]) @ np.swapaxes(
        K, 1, 2
    )
    residual = compared.b - (A @ (part_covariance @ b[..., None]))[..., 0]
    part_noise = _noise(A, residual, part_covariance)

    def with_surfaces(variance: float, surface_deviations: Array) -> tuple[Array, Array]:
        """Return log-likelihoods (k,) and informations (k, m, m), for k deviations of surfaces.

        ``variance``: of the contours' distances, relative to the fit's noise.
        ``surface_deviations``: (k,) standard deviations of the parts' surfaces [m].

        Returns restricted log-likelihoods of the deviations, and the values' information at each.
        """
        H = (jacobians @ A_sum @ np.swapaxes(jacobians, 1, 2)).sum(axis=0) / variance
        # (m, k): information that couples each value with each direction of the parts.
        coupling = np.swapaxes(jacobians @ A_sum @ K, 0, 1) / variance
        coupling = coupling.reshape(size, -1)
        pulls = (np.einsum("nij,ni->nj", K, b) / variance).ravel()
        observed = information.ravel() / variance
        shrinkage = 1.0 / (observed + surface_deviations[:, None] ** -2)
        H = H - (coupling * shrinkage[:, None]) @ coupling.T
        g = np.einsum("njk,nk->j", jacobians, b) / variance
        g = (g - (shrinkage * pulls) @ coupling.T)[:, free]
        H_free = H[:, free[:, None], free] + np.diag(prior_information[free])
        explained = (shrinkage * pulls**2).sum(axis=1)
        explained += (g * np.linalg.solve(H_free, g[..., None])[..., 0]).sum(axis=1)
        freedom = np.log1p(surface_deviations[:, None] ** 2 * observed).sum(axis=1)
        return 0.5 * (explained - freedom - np.linalg.slogdet(H_free)[1]), H

    best = int(np.argmax(with_surfaces(part_noise, surface_deviations)[0]))
    surface = surface_deviations[best : best + 1]
    # Nearest points of two contours are nearer than corresponding points. So the larger of two
    # estimates is used: the second is over the whole body and includes the surface's error.
    H_free = (jacobians @ A_sum @ np.swapaxes(jacobians, 1, 2)).sum(axis=0)[np.ix_(free, free)]
    V = np.linalg.inv(H_free + np.diag(prior_information[free]))
    Q = np.swapaxes(jacobians[:, free], 1, 2) @ V @ jacobians[:, free]
    noise = max(part_noise, _noise(A, compared.b, Q))
    H = with_surfaces(noise, surface)[1][0]
    covariance = np.zeros((size, size))
    V_free = np.linalg.inv(H[np.ix_(free, free)] + np.diag(prior_information[free]))
    covariance[np.ix_(free, free)] = V_free
    if held_covariance is not None and held.any():
        follow = np.eye(size)[:, held]
        follow[free] = -V_free @ H[np.ix_(free, held)]
        covariance += follow @ held_covariance @ follow.T
    return covariance, H, float(surface[0])


def _noise(A: Array, b: Array, Q: Array, assumed: float = 4.0) -> float:
    """Estimate the variance of contour distances, relative to the fit's noise.

    ``A``, ``b``: (cameras, nodes, 12, 12) symmetric and (cameras, nodes, 12), as of `Comparison`.
    ``Q``: (nodes, 12, 12) covariance of each node's fitted affine motion. ``assumed``: weight of
    the fit's own noise in the estimate [number of distances].
    """
    gain = Q @ A
    # Expected value of `pulls` at unit variance, less the part that the fit has absorbed.
    freedom = np.einsum("cnii->", gain) - np.einsum("cnij,cnji->", gain, gain)
    pulls = np.einsum("cni,nij,cnj->", b, Q, b)
    return float((pulls + assumed) / (max(freedom, 0.0) + assumed))


@dataclass(frozen=True, eq=False)
class PersonBelief:
    """What is known of a person after a frame."""

    # values, step: (m,) values of the pose tree, and their change in a frame [rad, m].
    values: Array
    step: Array
    inlier_ratio: float = 1.0  # Inlier ratio of the contours, 0 to 1.
    misfit: float = 1.0  # Cost over what noise gives.
    usual_misfit: float = 1.0  # The lowest so far, or a running mean if that is higher.
    # Number of successive frames that are explained worse than usual by more than noise.
    troubled_frames: int = 0
    # Sum of the pose's advantages over the next best one [standard deviations], and their number;
    # 0: nothing speaks for another pose.
    evidence: float = 0.0
    judged: int = 0
    ahead: float = 0.0  # Time for which the values are predicted [frames].

    @property
    def is_lost(self) -> bool:
        """Whether another pose explains the frames as well, at the judge's LEVEL."""
        return self.judged > 0 and self.evidence <= SIGNIFICANT * math.sqrt(self.judged)


Shaped = Callable[[Array], "tuple[PoseFit, PersonPoseTracker]"]
"""Fits a shape and pose from values (m,); returns the fit, and the tracker of the shape."""


class PersonPoseTracker:
    """Tracks a person from frame to frame.

    Args:
        fit: the person's body with the noise of its contours.
        settings: EXACT, or LENIENT where the model only resembles the person.
        held: (m,) values that stay fixed, for instance lengths; None: none.
        rest: (m,) values of the person at rest, held values included; None: the tree's defaults.
        plan: limbs of the same kinematics, if they exist already.

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

    def start(self, values: Array, is_known: bool = False) -> PersonBelief:
        """Return the belief in a motionless person at values (m,), to be judged unless known."""
        values = np.array(values, dtype=np.float64)
        return PersonBelief(values, np.zeros(len(values)), judged=int(not is_known))

    def with_held(self, values: Array) -> Array:
        """Return values (m,) with the held ones replaced by the tracker's."""
        return np.where(self._held, self._rest, values)

    def positions(self, values: Array) -> Array:
        """Return the plant's q (nq,) at values (m,); free angles are in -pi..pi."""
        free = np.isinf(self.fit.upper)
        turned = np.where(free, np.remainder(values + np.pi, 2.0 * np.pi) - np.pi, values)
        q = np.array(self.fit.tree.model.default_positions)
        q[self._order] = turned
        return q

    def values(self, q: Array) -> Array:
        """Return the pose tree's values (m,) at positions q (nq,)."""
        return np.array(q, dtype=np.float64)[self._order]

    def trunk_middle(self, values: Array) -> Array:
        """Return the middle of the trunk (3,) in the world at values (m,) [m]."""
        return self.plan.trunk_middle(self.fit.kinematics.poses(values))

    def deviations(
        self, values: Array, seen: FrameViews, held_covariance: Array | None = None
    ) -> Array:
        """Return standard deviations (nq,) of the plant's positions [rad, m], by one frame alone.

        ``values``: (m,) of a frame's state; the plant's other positions get 0. ``seen``:
        silhouettes that the frame was fitted to. ``held_covariance``: (h, h) covariance of the held
        values; None: they are exact.
        """
        placement = self.fit.body.place(values)
        compared = seen.compare(self.fit, placement, self.settings.follow[-1])
        covariance, *_ = pose_uncertainty(self.fit, compared, self._held, held_covariance)
        deviations = np.zeros(len(self.fit.tree.model.position_names))
        deviations[self._order] = np.sqrt(np.diag(covariance))
        return deviations

    def predict(self, belief: PersonBelief, frames: float = 1.0) -> PersonBelief:
        """Return the belief some frames later; motion fades away."""
        ahead = belief.ahead + frames
        moved = self._persisting(ahead) - self._persisting(belief.ahead)
        return replace(belief, values=belief.values + moved * belief.step, ahead=ahead)

    def _persisting(self, ahead: float) -> float:
        """Return the number of a frame's steps in `ahead` frames."""
        return -self.settings.persistence * math.expm1(-ahead / self.settings.persistence)

    def update(self, belief: PersonBelief | None, frame: FrameViews) -> PersonBelief | None:
        """Return the belief after a frame of silhouettes.

        The frame is fitted from the predicted pose. Where it is explained worse than usual, or than
        noise does, at the judge's LEVEL, doubtful limbs are searched again, and then the person in
        all headings: at first, and ever more rarely while that does not help. The pose with the
        highest likelihood is taken. It is lost if a distinct one is not worse by more than noise.

        ``belief``: predicted for the frame; None: the person is searched. Returns None if `belief`
        is None and fewer than two cameras see a person.
        """
        settings, search = self.settings, self.search
        if belief is None:
            found = [fit for fit, _ in self.find_explanations(frame)]
            if not found:
                return None
            best, *others = found
            misfit = float(search.misfit(best.sums.sum(axis=0))[0])
            return replace(
                self.start(best.values),
                inlier_ratio=best.inlier_ratio,
                misfit=misfit,
                usual_misfit=min(misfit, 1.0),
                evidence=self._evidence(best, others, frame, None),
            )
        compare, prior = partial(frame.compare, self.fit), Prior(belief.values, self._information)
        fitted = self.fit.fit(compare, belief.values, settings.follow, prior, self._held)
        before = belief.values - self._persisting(belief.ahead) * belief.step
        ahead = belief.ahead
        step = (fitted.values - before) / (ahead or np.inf)
        belief = replace(belief, step=step, ahead=0.0)
        excess, change = self._excess(fitted, belief)
        # What is seen has changed: searches begin anew. At first only limbs are searched, but not
        # after a gap.
        first = min(round(ahead), 2)
        troubled = first if abs(change) > SIGNIFICANT else belief.troubled_frames + 1
        if excess <= SIGNIFICANT and not belief.is_lost:
            troubled = 0
        elif troubled & (troubled - 1) == 0 or troubled % 8 == 0:
            belief, fitted = self._search_again(
                replace(belief, troubled_frames=troubled), fitted, frame
            )
            excess, _ = self._excess(fitted, belief)
            if excess <= SIGNIFICANT and not belief.is_lost:
                troubled = 0
        misfit = float(search.misfit(fitted.sums.sum(axis=0))[0])
        usual = belief.usual_misfit + (misfit - belief.usual_misfit) / settings.memory
        return replace(
            belief,
            values=fitted.values,
            inlier_ratio=fitted.inlier_ratio,
            misfit=misfit,
            usual_misfit=min(misfit, usual, 1.0),
            troubled_frames=troubled,
        )

    def _excess(self, fitted: PoseFit, belief: PersonBelief) -> tuple[float, float]:
        """Return by how many standard deviations a misfit exceeds the usual and the last one."""
        misfit, deviation = self.search.misfit(fitted.sums.sum(axis=0))
        return (
            float((misfit - belief.usual_misfit) / deviation),
            float((misfit - belief.misfit) / deviation),
        )

    def _search_again(
        self, belief: PersonBelief, fitted: PoseFit, frame: FrameViews
    ) -> tuple[PersonBelief, PoseFit]:
        """Search limbs and then the person again; return the belief, judged anew, and the fit."""
        expected = None if belief.is_lost else belief.values
        fits = [self.search.improve_limbs(fitted, frame)]
        is_limb = self._excess(fits[0], belief)[0] <= SIGNIFICANT or belief.troubled_frames == 1
        if belief.is_lost or not is_limb:
            fits += [fit for fit, _ in self.find_explanations(frame, belief.values)]
        best = max(fits, key=lambda one: one.closeness)
        if self.search.advantage(best, fitted, frame, expected) > SIGNIFICANT:
            belief = replace(belief, step=np.zeros(len(belief.step)), evidence=0.0, judged=0)
        else:
            best = fitted
        if len(fits) > 1:
            found = belief.evidence + self._evidence(best, [fitted, *fits], frame, expected)
            belief = replace(belief, evidence=found, judged=belief.judged + 1)
            if not belief.is_lost:
                belief = replace(belief, evidence=0.0, judged=0)
        return belief, best

    def _evidence(
        self, best: PoseFit, others: Sequence[PoseFit], frame: FrameViews, expected: Array | None
    ) -> float:
        """Return the smallest advantage of a fit over distinct others; large if there are none."""
        rivals = [one for one in others if len(self.search.distinct([best, one])) > 1]
        advantages = [self.search.advantage(best, one, frame, expected) for one in rivals]
        return min(advantages, default=2.0 * SIGNIFICANT)

    def find_explanations(
        self, frame: FrameViews, known: Array | None = None, shaped: Shaped | None = None
    ) -> "list[tuple[PoseFit, PersonPoseTracker]]":
        """Return distinct poses that explain a frame, with trackers of their shapes, best first.

        The list is empty if fewer than two cameras see a person.

        Args:
            frame: silhouettes.
            known: (m,) values from which held ones are taken; None: the person's at rest.
            shaped: returns a better fit from values (m,), and the tracker of the shape it has; in
                a body of other proportions a wrong pose may fit better than the right one. None:
                the shape is known.
        """

        def improve(values: Array) -> tuple[PoseFit, PersonPoseTracker]:
            return self.search.improve_limbs(self.search.refine(values, frame), frame), self

        shaped = shaped or improve
        starts = self.search.find_starts(frame, known)
        found, best = [shaped(one.values) for one in starts[:3]], None
        while found and best is not (leading := max(found, key=lambda one: one[0].closeness)):
            best, (fit, own) = leading, leading
            similar = [
                own.search.refine(one, frame) for one in own.search.similar_poses(fit.values)
            ]
            similar.sort(key=lambda one: -one.closeness)
            found += [shaped(one.values) for one in similar]
        if best is not None:
            found.append((best[1].search.improve_limbs(best[0], frame, every=True), best[1]))
        ranked = {id(one[0]): one for one in found}
        return [ranked[id(fit)] for fit in self.search.distinct(fit for fit, _ in found)]


Frames = Sequence[tuple[Sequence[Camera], Sequence[EdgePoints]]]
"""Of each frame: the cameras, and the edge points of their regions."""

# Prior standard deviations: of lengths from the model's [m], of left from right lengths [m], of
# log radius scales, and of angles from the start [rad]; and the largest log radius scale.
_LENGTH_DEVIATION, _SIDE_DEVIATION, _SCALE_DEVIATION = 0.03, 0.005, 0.15
_ANGLE_DEVIATION, _MAX_LOG_SCALE = 0.5, 0.5
_STAGES = tuple(
    AnnealingStage(scale, 0.04) for scale in (0.10, 0.08, 0.06, 0.05, 0.04, 0.04, 0.03, 0.03)
)
NOISE = Noise(deviation=0.02, correlation=0.15)
"""Noise of contour points where the model only resembles the person."""


@dataclass(frozen=True, eq=False)
class PersonShape:
    """A person's fitted shape."""

    lengths: Mapping[str, float]  # By shape joint [m].
    radius_scales: Mapping[str, float]  # By part.
    values: Array  # (m,) values of the pose tree: fitted shape joints [m], others 0.
    covariance: Array  # (h, h) covariance of the shape joints [m^2].
    poses: Array  # (frames, m) values in the fitted frames [rad, m].
    outlines: tuple[Outline, ...]  # The model's simplified surfaces with these radius scales.


def shape_values(tree: PoseTree) -> Mask:
    """Return whether each of a tree's values is a shape joint (m,): a length not of the root."""
    root = set(tree.nodes[0].value_names)
    kinds = tree.model.position_kinds
    return np.array(
        [
            name not in root and kinds[tree.model.position_index(name)] == "length"
            for node in tree.nodes
            for name in node.value_names
        ],
        dtype=np.bool_,
    )


def shape_parts(tree: PoseTree) -> tuple[list[str], list[int]]:
    """Return the names of parts with a radius scale, both sides one, and each node's part."""
    names = [
        node.name.removeprefix("left_").removeprefix("right_").removesuffix("_end")
        for node in tree.nodes
    ]
    parts = list(dict.fromkeys(names))
    return parts, [parts.index(name) for name in names]


def tracker_of_person(
    tree: PoseTree | TreeKinematics, shape: PersonShape | None, plan: BodyPlan | None = None
) -> PersonPoseTracker:
    """Return a tracker of a person of known shape, whose lengths are held.

    ``shape``: None: the model's own. ``plan``: limbs of the tree, if they exist already. Raises
    ModelError: the model has no landmarks of trunk, arms and legs.
    """
    outlines, rest = (None, None) if shape is None else (shape.outlines, shape.values)
    fit = ContourFit(tree, outlines, NOISE)
    return PersonPoseTracker(fit, LENIENT, shape_values(fit.tree), rest, plan)


def fit_shape(fit: ContourFit, frames: Frames, poses: Array) -> PersonShape:
    """Fit lengths, radius scales and the poses of all frames.

    ``fit``: the model's body, without radius scales, and the noise of its contours. ``frames``:
    cameras and edge points of each frame. ``poses``: (frames, m) initial values [rad, m]. Raises
    ModelError: the model has no shape joints, unlike urdf/person/person_shape.urdf.
    """
    is_shape = shape_values(fit.tree)
    if not is_shape.any():
        raise ModelError(f"{fit.tree.model.path}: a person's shape needs a model with shape joints")
    parts, groups = shape_parts(fit.tree)
    body = BodyParameters(fit.kinematics, fit.outlines, groups, parts)
    count = int(is_shape.sum())
    names = [name for name, wanted in zip(body.names, is_shape, strict=False) if wanted]
    cameras = {camera.name: camera for own_cameras, _ in frames for camera in own_cameras}
    observations = []
    for own_cameras, edges in frames:
        seen = {camera.name: edge for camera, edge in zip(own_cameras, edges, strict=True)}
        packed = pack_evidence([seen.get(name, NO_EDGE) for name in cameras])
        observations.append(Observation(packed))
    poses = np.array(poses, dtype=np.float64)
    pose, shape = (
        Unknowns(
            np.array(body.names[: len(chosen)])[chosen].tolist(), shared, fit.lower[chosen],
            fit.upper[chosen], deviation,
        )
        for chosen, shared, deviation in (
            (~is_shape, False, _ANGLE_DEVIATION), (is_shape, True, _LENGTH_DEVIATION)
        )
    )  # fmt: skip
    radius_scales = [name for name in body.names if name.startswith(RADIUS_SCALE_PREFIX)]
    radius_scale = Unknowns(radius_scales, True, -_MAX_LOG_SCALE, _MAX_LOG_SCALE, _SCALE_DEVIATION)
    problem = Problem(body, list(cameras.values()), [pose, shape, radius_scale], noise=fit.noise)
    found = problem.solve(
        observations,
        _STAGES,
        (poses[:, ~is_shape], np.zeros(count + len(parts))),
        shared_information=_sides_information(names, len(parts)),
    )
    lengths, scales = found.shared[:count], np.exp(found.shared[count:])
    shaped = ContourFit(fit.kinematics, with_radius_scales(fit.outlines, scales[groups]), fit.noise)
    values = np.zeros(len(is_shape))
    values[is_shape] = poses[:, is_shape] = lengths
    poses[:, ~is_shape] = found.own
    prior = np.eye(count) / _LENGTH_DEVIATION**2 + _sides_information(names, 0)
    # The information of all frames is averaged, not added: a surface's error is the same in all.
    own, total = np.flatnonzero(~is_shape), np.zeros((count, count))
    for (own_cameras, edges), values_then in zip(frames, poses, strict=True):
        compared = shaped.compare(pack_views(own_cameras, edges), values_then, _STAGES[-1])
        _, H, _ = pose_uncertainty(shaped, compared)
        cross = H[np.ix_(own, is_shape)]
        follow = np.linalg.solve(
            H[np.ix_(own, own)] + np.eye(len(own)) / _ANGLE_DEVIATION**2, cross
        )
        total += (H[np.ix_(is_shape, is_shape)] - cross.T @ follow) / len(frames)
    covariance = np.linalg.inv(prior + total)
    return PersonShape(
        dict(zip(names, lengths.tolist(), strict=True)),
        dict(zip(parts, scales.tolist(), strict=True)),
        values,
        np.asarray(covariance),
        poses,
        shaped.outlines,
    )


def _sides_information(names: Sequence[str], scale_count: int) -> Array:
    """Return the prior information (n, n) that left and right lengths are alike.

    ``names``: shape joints, the first of the n parameters. ``scale_count``: number of radius
    scales, which follow and get no information.
    """
    information = np.zeros((len(names) + scale_count, len(names) + scale_count))
    for k, name in enumerate(names):
        other = name.replace("left_", "right_", 1)
        if name.startswith("left_") and other in names:
            row = np.zeros(len(information))
            row[k], row[list(names).index(other)] = 1.0, -1.0
            information += np.outer(row, row) / _SIDE_DEVIATION**2
    return information
