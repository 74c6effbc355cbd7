"""Fit the poses of frames: each frame by itself, or all together with cameras and shape.

For an audit (``PerFrameFit``), small corrections of all joints and cameras are the unknowns of each
frame. The given values are the start and the mean of the prior, and the residual distances are
returned as linear functions of the corrections. ``adjust_bundle`` has no given positions.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.body.tree_kinematics import LinkVector, TreeKinematics
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.fit.contour_fit import Comparison, inlier_ratio_of
from drake_pose.fit.covariance import (
    ComparedMask,
    distances_in_masks,
    estimate_sizes,
    values_covariance,
)
from drake_pose.fit.evidence import Observation
from drake_pose.fit.kernel import Sum
from drake_pose.fit.levenberg_marquardt import AnnealingStage, StepSettings
from drake_pose.fit.parameters import (
    CAMERA_NAMES,
    POSE_NAMES,
    RADIUS_SCALE_PREFIX,
    BodyParameters,
    CameraParameters,
    carried_joints,
    link_scale_name,
)
from drake_pose.fit.problem import Problem, Unknowns
from drake_pose.registration.posed_frames import MultiViewFrame, common_size, middle_of
from drake_pose.registration.shared_fit import SHARED, pose_covariance
from drake_pose.silhouette.outline import Outline


@dataclass(frozen=True, eq=False)
class FrameFit:
    """A frame with fitted joints and cameras."""

    name: str  # The frame's name.
    # The comparison of the contours with each mask, linearised at the end of the fit. Distances are
    # measured from the given values; the unknowns are the corrections of the joints and of the
    # POSE_NAMES of each camera.
    compared_masks: tuple[ComparedMask, ...]
    # Two mappings by name of each camera with a mask: the fraction of both contours that fits, at
    # given and at fitted values.
    inlier_ratios: tuple[Mapping[str, float], Mapping[str, float]]
    outline_lengths: Array  # (nodes,) weighted length of each node's contours [pixel].
    # (nodes, 2) length of each node's contours that was compared with masks, and the part of it
    # that fits [pixel].
    matched_lengths: Array


class PerFrameFit:
    """Fits frames, each by itself, with joints and cameras as unknowns.

    Attributes:
        outlines: the full surface of each node.
        cameras, camera_names: the c cameras at their given poses, and their names.
        joints: names of the tree's values that are not fixed.
        size: square root of the silhouettes' median area [pixel].
        links: names of the links that a joint moves and that carry another joint.
        names: names of the p corrections: of the joints, CAMERA_NAMES of each camera, and the
            logarithms of the links' lengths.
        posed: (p,) which of them each frame determines for itself: joints and cameras' poses. The
            others are the same in all frames.
        is_angle: (p,) which corrections are angles.
        deviations: (p,) their prior standard deviations [rad, m, logarithm or pixel].

    Args:
        kinematics: of the body's pose tree.
        outlines: two surfaces for each node: all simplified ones, for the fit, and all full ones,
            for the final comparison.
        cameras: the cameras at their given poses.
        frames: a sample of frames, for the silhouettes' size and the body's position.

    Raises:
        MaskError: a mask's size differs from its camera's, or no mask shows the body.
    """

    def __init__(
        self,
        kinematics: TreeKinematics,
        outlines: tuple[Sequence[Outline], Sequence[Outline]],
        cameras: Sequence[Camera],
        frames: Sequence[MultiViewFrame],
    ) -> None:
        self.cameras, self.outlines = tuple(cameras), outlines[1]
        self.size = common_size(cameras, frames)
        self._values = joints = np.flatnonzero(kinematics.lower < kinematics.upper)
        self.camera_names = tuple(camera.name for camera in cameras)
        self.joints = tuple(kinematics.names[k] for k in joints)
        offsets = moved_links(kinematics)
        self.links = tuple(dict.fromkeys(one.link for one in offsets))
        of_cameras = [f"{camera.name}.{name}" for camera in cameras for name in CAMERA_NAMES]
        self.names = (*self.joints, *of_cameras, *map(link_scale_name, self.links))
        # Prior standard deviations of joints, of cameras about the body [rad, m], of the logarithms
        # of focal lengths and lengths, and of principal points [pixel].
        of_joints = np.where(kinematics.is_angle[joints], 0.1, 0.02)
        of_camera = [0.05] * (len(POSE_NAMES) + 1) + [0.05 * self.size] * 2
        lengths = np.full(len(self.links), 0.05)
        self.deviations = np.concatenate([of_joints, *[of_camera] * len(cameras), lengths])
        kinds = [name.startswith("turn") for name in CAMERA_NAMES]
        self.is_angle = np.concatenate(
            [kinematics.is_angle[joints], *[kinds] * len(cameras), lengths < 0.0]
        ).astype(bool)
        poses = np.tile(np.arange(len(CAMERA_NAMES)) < len(POSE_NAMES), len(cameras))
        self.posed = np.concatenate([joints >= 0, poses, lengths < 0.0])
        error = SHARED.point_error * np.sqrt(SHARED.error_length)
        self.middle = middle_of(kinematics, frames)
        self.problem, self._full = (
            Problem(
                BodyParameters(kinematics, one, offsets=offsets), cameras,
                [Unknowns([*compress(self.names, own)], deviation=self.deviations[own] / error)],
                pivot=self.middle, pixels=self.size,
                steps=StepSettings(max_step=0.2, damping=1e-3, uniform_damping=1e-6),
            )
            for one, own in zip(outlines, (self.posed, self.posed | True), strict=True)
        )  # fmt: skip

    def fit(
        self,
        frame: MultiViewFrame,
        at: Array | None = None,
        scales: Sequence[float] = (0.12, 0.09, 0.07, 0.05, 0.04, 0.03, 0.025),
        already: float = 1.3,
    ) -> FrameFit:
        """Fit one frame.

        Args:
            frame: the frame.
            at: (p,) corrections, over their `deviations`, which are the start and the mean of the
                prior; None: 0.
            scales: scales of the annealing stages [square root of the silhouettes' area].
            already: if the cost at `at` is at most this multiple of the fitted cost, distances are
                linearised there: weakly observable unknowns may have moved far without effect on
                the cost.

        Raises MaskError: a mask's size differs from its camera's.
        """
        edges, count = frame.edges(self.cameras, 0.01 * self.size), len(self.cameras)
        change = np.zeros(len(self.names)) if at is None else at * self.deviations
        given, nothing = Observation(edges, frame.values), np.zeros(0)
        held = self._full.parameters([given], change[None], nothing)[0]
        base, own = given._replace(values=held), np.zeros((1, np.count_nonzero(self.posed)))
        rounds, start = [AnnealingStage(scale, 0.02) for scale in scales], (own, nothing)
        # Corrections that were found before are near.
        for part in (rounds[-3 if change.any() else 0 :], rounds[-2:]):
            found = self.problem.solve([base], part, (own, nothing), expected=start)
            own = found.own
            theta = self.with_boundary_biases(base, found.parameters[0])
            base = given._replace(values=np.append(held[:-count], theta[-count:]))
        held = self.with_boundary_biases(given, held)
        before, after = (
            self._full.compare(given, one, SHARED.inlier_stage)[0] for one in (held, theta)
        )
        compared = after
        costs = [float(one.sums[:, :, Sum.COST].sum()) for one in (before, after)]
        if costs[0] <= already * costs[1]:
            theta, compared = held, before
        else:
            change[self.posed] += own[0]
        weights = compared.sums[:, :, Sum.WEIGHT].sum(axis=0)
        return FrameFit(
            frame.name,
            tuple(
                one._replace(b=one.b + np.einsum("nkl,npl,p->nk", one.A, one.moves, change))
                for one in self._full.compared_masks([given], theta[None], SHARED.inlier_stage)
            ),
            (self._inlier_ratios(before, frame), self._inlier_ratios(after, frame)),
            # The last row, of the mask's edges, is distributed among the nodes.
            weights[:-1] * weights.sum() / max(float(weights[:-1].sum()), 1e-9),
            compared.sums[:, :-1, [Sum.COMPARED, Sum.FITTING]].sum(axis=0),
        )

    def _inlier_ratios(self, compared: Comparison, frame: MultiViewFrame) -> dict[str, float]:
        """Return the inlier ratio of a compared frame, by name of each camera with a mask."""
        sums = zip(self.camera_names, compared.sums, strict=True)
        return {name: inlier_ratio_of(one) for name, one in sums if name in frame.masks}

    def with_boundary_biases(self, observation: Observation, theta: Array) -> Array:
        """Return theta (n,) with the boundary bias of least cost for each camera's mask.

        The cost is evaluated at biases from -3 to 3 pixels and interpolated by a parabola.

        Args:
            observation: evidence of one frame.
            theta: (n,) all parameters of the ``Problem``; the last c are the biases [pixel].
        """
        biases, count = np.linspace(-3.0, 3.0, 5), len(self.cameras)
        found, costs = theta.copy(), np.full((len(biases), count), np.inf)
        # The outermost biases are evaluated only where the cost falls towards them.
        for k, beside in ((1, None), (2, None), (3, None), (0, 1), (4, 3)):
            if beside is None or (np.argmin(costs, axis=0) == beside).any():
                found[-count:] = biases[k]
                compared, _ = self.problem.compare(observation, found, SHARED.inlier_stage)
                costs[k] = compared.sums[:, :, Sum.COST].sum(axis=1)
        best = np.clip(np.argmin(costs, axis=0), 1, len(biases) - 2)
        low, middle, high = (np.choose(best + k, costs) for k in (-1, 0, 1))
        bend = low - 2.0 * middle + high
        step = np.where(bend > 0.0, 0.5 * (low - high) / np.where(bend > 0.0, bend, 1.0), 0.0)
        found[-count:] = biases[best] + np.clip(step, -1.0, 1.0) * (biases[1] - biases[0])
        return found

    def values_at(self, values: Array, at: Array) -> Array:
        """Return values (m,) of the tree with corrections `at` (p,) added."""
        found = values.copy()
        found[self._values] += (at * self.deviations)[: len(self.joints)]
        return found

    def cameras_at(self, at: Array) -> tuple[Camera, ...]:
        """Return the cameras with corrections `at` (p,)."""
        first, kinds = len(self.joints), len(CAMERA_NAMES)
        change = (at * self.deviations)[first : first + kinds * len(self.cameras)]
        if not change.any():
            return self.cameras
        X_CW, kernel, _ = CameraParameters(self.cameras, self.middle).place(change)
        placed = list[Camera]()
        for one, X, (_, *lens) in zip(self.cameras, X_CW, kernel.tolist(), strict=True):
            moved = one.with_pose(np.linalg.inv(X))
            if isinstance(moved, PinholeCamera):
                x, y, center_x, center_y = lens[:4]
                moved = replace(moved, focal_x=x, focal_y=y, center_x=center_x, center_y=center_y)
            placed.append(moved)
        return tuple(placed)

    def rows(self, names: Collection[str], cameras: Collection[str]) -> list[int]:
        """Return the indices of the corrections of some CAMERA_NAMES of some cameras."""
        return [self.names.index(f"{camera}.{name}") for camera in cameras for name in names]

    def base_jacobian(self) -> Array:
        """Return the derivative (p, 6) of the corrections by a motion of the robot's base.

        The motion is a rotation vector [rad] and a translation [m] in the world, about the body's
        middle, and is seen by every camera. Rows are divided by the corrections' `deviations`.
        """
        moves = np.zeros((len(self.names), 6))
        for camera in self.cameras:
            rows = np.array(self.rows(POSE_NAMES, [camera.name]))
            moves[rows[:3], :3] = moves[rows[3:], 3:] = camera.X_CW[:3, :3]
        return np.asarray(moves / self.deviations[:, None])

    def camera_jacobian(self, camera: str) -> Array:
        """Return the derivative (3, 6) of a camera's centre by its POSE_NAMES, along its axes [m].

        POSE_NAMES turn and shift the body about its middle, in the camera's frame.
        """
        X_CW = self.cameras[self.camera_names.index(camera)].X_CW
        middle = X_CW[:3, :3] @ self.middle + X_CW[:3, 3]
        return np.hstack([np.cross(np.eye(3), middle).T, -np.eye(3)])


def explained_frames(
    ratios: Sequence[Mapping[str, float]], of_best: float = 0.75, least: float = 0.5
) -> Mask:
    """Return which frames (frames,) the fit explains in all their pictures.

    Args:
        ratios: for each frame the fitted inlier ratios by camera.
        of_best, least: minimum, relative to the mean of the camera's best quarter, and absolute.
    """
    limits = {}
    for name in {name for one in ratios for name in one}:
        own = sorted(one[name] for one in ratios if name in one)
        best = float(np.mean(own[-max(2, len(own) // 4) :]))
        limits[name] = max(of_best * best, least)
    return np.array([all(ratio >= limits[name] for name, ratio in one.items()) for one in ratios])


def likeliest_inliers(
    explained: Mask,
    evaluate: Callable[[Mask], tuple[Mask, Array]],
    usual_deviation: float,
    *,
    outlier_cost: float = 3.0,
    max_iterations: int = 10,
) -> Mask:
    """Return the most likely set of inlier frames (frames,), by fixed-point iterations.

    Iterations start from no frames, all frames, and single frames. Each computes the common errors
    of a set, and makes the frames without a significant residual the next set.

    Args:
        explained: (frames,) which frames may be inliers.
        evaluate: returns, for a set (frames,), which frames' residuals (frames,) are insignificant,
            and the common errors x (p,) of the set.
        usual_deviation: prior standard deviation of each element of x.
        outlier_cost: negative log-likelihood of each outlier.
        max_iterations: maximum number of iterations from a start, and of single frames as starts.
    """
    best, least = explained & False, np.inf
    starts = [np.zeros(len(explained), bool), explained]
    order = np.flatnonzero(explained)
    count = min(len(order), max_iterations)
    for k in order[np.linspace(0, len(order) - 1, count).astype(int)]:
        starts.append(np.arange(len(explained)) == k)
    for kept in starts:
        for _ in range(max_iterations):
            fits, x = evaluate(kept)
            now = explained & fits
            if (now == kept).all():
                break
            kept = now
        else:
            x = evaluate(kept)[1]
        # One cause may be far off: a Cauchy distribution.
        off = float(np.log1p((x / usual_deviation) ** 2).sum())
        unlikely = outlier_cost * np.count_nonzero(~kept) + off
        if unlikely < least:
            best, least = kept, unlikely
    return best


def moved_links(kinematics: TreeKinematics) -> list[LinkVector]:
    """Return the vectors of ``carried_joints`` on links that a joint moves.

    Other links' lengths look like the base's place.
    """
    tree = kinematics.tree
    moved = np.any(kinematics.motions(kinematics.flatten(tree.default_values())).moves, axis=1)
    return [
        one
        for one in carried_joints(tree)
        if one.step > 0 or moved[max(0, tree.nodes[one.node].parent)]
    ]


def adjust_bundle(
    kinematics: TreeKinematics,
    outlines: Sequence[Outline],
    cameras: Sequence[PinholeCamera],
    unknown: Collection[str],
    frames: Sequence[MultiViewFrame],
    is_length: Mask,
    parts: Sequence[str] = (),
    groups: Sequence[int] | None = None,
) -> tuple[list[PinholeCamera], Array, Array, Array]:
    """Fit unknown cameras, all poses and the body's shape to all silhouettes (bundle adjustment).

    Cameras registered with estimated joint positions inherit their errors. So cameras, positions,
    lengths and radius scales are fitted together; cameras with known poses fix the world frame.

    Args:
        kinematics: of the body's pose tree, with m values. Values with equal limits stay fixed.
        outlines: a surface for each node of the tree.
        cameras: all cameras; the unknown ones near their poses.
        unknown: names of the c cameras whose poses are fitted.
        frames: the masks, with approximate values of the tree: start and mean of the prior.
        is_length: (m,) which of the tree's values are lengths, the same in all frames. They start
            from the first frame's.
        parts: names of the parts that have a radius scale, a factor of the width across y.
        groups: (nodes,) index in `parts` of each node's part, or -1; None: no parts.

    Returns the unknown cameras at their fitted poses, in the order of `cameras`; their (c, 6, 6)
    covariances, see ``RegisteredCamera``; the tree's fitted values (frames, m) [rad or m]; and the
    radius scales (nodes,), 1 for nodes without a part.

    Raises MaskError: a mask's size differs from its camera's, or no mask shows the body.
    """
    values, size = np.array([frame.values for frame in frames]), common_size(cameras, frames)
    body = BodyParameters(kinematics, outlines, groups, parts)
    free = (kinematics.lower < kinematics.upper) & ~is_length
    searched = [k for k, camera in enumerate(cameras) if camera.name in unknown]
    # Prior standard deviations: angles [rad], places and lengths [m], log radius scales.
    error = SHARED.point_error * np.sqrt(SHARED.error_length)
    deviations = np.where(is_length, 0.03, 0.5) / error
    pose, lengths = (
        Unknowns(
            np.array(kinematics.names)[chosen].tolist(), shared, kinematics.lower[chosen],
            kinematics.upper[chosen], deviations[chosen],
        )
        for chosen, shared in ((free, False), (is_length, True))
    )  # fmt: skip
    radius_scales = [name for name in body.names if name.startswith(RADIUS_SCALE_PREFIX)]
    poses = [f"{cameras[k].name}.{name}" for k in searched for name in POSE_NAMES]
    unknowns = [
        pose,
        lengths,
        Unknowns(radius_scales, True, deviation=0.15 / error),
        Unknowns(poses, True),
    ]
    fit = Problem(
        body, cameras, unknowns, pivot=middle_of(kinematics, frames), steps=SHARED.steps,
        pixels=size,
    )  # fmt: skip
    held = np.where(free | is_length, 0.0, values)
    observations = [
        Observation(frame.edges(cameras, size / 150.0), row)
        for frame, row in zip(frames, held, strict=True)
    ]
    count = len(lengths.names)
    shared = np.zeros(len(fit.names) - fit.own_count)
    shared[:count] = values[0, is_length]
    start = now = values[:, free], shared
    found, rounds = None, [AnnealingStage(0.08, 0.02), AnnealingStage(0.06, 0.02, 3)]
    # The finest scale at which 0.7 of the contours fit: the model's surface is no more exact.
    for scale in (0.04, 0.03, 0.02, 0.01, 0.005):
        rounds.append(AnnealingStage(scale, 0.015, 6))
        tried = fit.solve(observations, rounds, now, expected=start)
        if found and tried.inlier_ratios[tried.inlier_ratios > 0.0].mean() < 0.7:
            break
        found, now, rounds = tried, (tried.own, tried.shared), []
    assert found is not None
    # Covariances use up to four frames and at most 1000 distances: errors of the surface are the
    # same in all frames. They are measured at a scale at which no contours are outliers.
    some = np.unique(np.linspace(0, len(observations) - 1, 4).round().astype(int))
    coarse = AnnealingStage(0.08, 0.015)
    masks = fit.compared_masks([observations[k] for k in some], found.parameters[some], coarse)
    distances = distances_in_masks(body.outlines, masks, 1000)
    turns = [name.split(".")[-1] in CAMERA_NAMES[:3] for name in fit.names[fit.own_count :]]
    is_angle = np.concatenate([np.tile(kinematics.is_angle[free], len(some)), turns])
    sizes = estimate_sizes(distances, is_angle, prior_deviation=SHARED.prior_deviation)
    whole = values_covariance(distances, sizes, np.arange(len(is_angle)), is_angle)
    X_CW, _, motions = fit.place_cameras(found.parameters[0])
    own = np.arange(len(whole) - len(poses), len(whole)).reshape(len(searched), 6)
    found_cameras = [replace(cameras[k], X_WC=np.linalg.inv(X_CW[k])) for k in searched]
    covariances = [
        pose_covariance(X_CW[k], motions[k, :6], whole[np.ix_(at, at)])
        for k, at in zip(searched, own, strict=True)
    ]
    factors = np.exp(np.append(found.shared[count : count + len(parts)], 0.0)[body.groups])
    values = found.parameters[:, : values.shape[1]]
    return found_cameras, np.array(covariances), values, factors
