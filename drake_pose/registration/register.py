"""Where a camera stands, told by silhouettes of a body whose joint positions are known.

No guess is needed: all rotations are tried, each with the body where the silhouettes are; the best
are fitted, first to everything within reach and in the end only to what fits (graduated
non-convexity), so that tools which the model lacks, hidden parts and wrong frames pull no more. A
frame then agrees with the others or contradicts them.
"""

import copy
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import combinations
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.body import PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.fit.covariance import vuong_statistic
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import FEW, VERY_FEW, simplify_surfaces, with_radius_scales
from drake_pose.registration.posed_frames import (
    LAST_SPACING,
    PosedFrame,
    PosedFrames,
    placed_points,
)
from drake_pose.registration.shared_fit import Shared, SharedFit, fit_pose
from drake_pose.silhouette.outline import EMPTY_OUTLINE, Outline, TreeSurfaces
from drake_pose.silhouette.scoring import draw_mask, score_bodies
from drake_pose.workers import map_ordered


class CameraSearchSettings(NamedTuple):
    """How cameras are searched for and fitted.

    coarse, fine, last: parts of fits, one after the other. coarse_spacing, fine_spacing: of
    silhouettes' edge points in the first two [root of the silhouettes' area]. first_side,
    second_side: sides of silhouettes in the pictures in which starts, and coarse fits, are compared
    [pixel]. significance: poses are as good whose cost is larger by no more standard deviations of
    the difference. piece: side of the squares whose costs are compared [root of the area]: what is
    missing or too much is about as large.
    """

    coarse: tuple[AnnealingStage, ...] = tuple(
        map(AnnealingStage, (0.25, 0.2, 0.15, 0.12, 0.09, 0.07, 0.05, 0.04), 8 * (0.05,))
    )
    fine: tuple[AnnealingStage, ...] = (
        AnnealingStage(0.05, 0.02),
        AnnealingStage(0.03, 0.015),
        AnnealingStage(0.02, 0.0125),
        AnnealingStage(0.01, 0.0125, 4),
    )
    last: tuple[AnnealingStage, ...] = (
        AnnealingStage(0.02, 0.01),
        AnnealingStage(0.01, 0.005),
        AnnealingStage(0.005, 0.005, 6),
    )
    coarse_spacing: float = 1.0 / 40.0
    fine_spacing: float = 1.0 / 80.0
    first_side: float = 40.0
    second_side: float = 100.0
    significance: float = 1.96
    piece: float = 0.2


SEARCH = CameraSearchSettings()

T = TypeVar("T")
Corner = tuple[float, float, float]
Box = tuple[Corner, Corner]
"""The least and the largest corner along the world's axes [m]."""


class RegistrationBody:
    """A body's surfaces, as fine as searching and fitting a camera need them.

    Attributes:
        very_few, few, all: a surface for each node.

    Args:
        seen: the nodes that silhouettes show; all where None.
        fewest: number of triangles of a node where it has very few.
        radius_scales: (nodes,) how many times as wide nodes are across their y axes as the
            model's; 1 where None.
    """

    def __init__(
        self,
        tree: PoseTree,
        seen: Collection[str] | None = None,
        fewest: int = VERY_FEW,
        radius_scales: Array | None = None,
    ) -> None:
        self.tree, self.kinematics = tree, TreeKinematics(tree)
        surfaces = TreeSurfaces(tree)
        if radius_scales is not None:
            surfaces = surfaces.with_rigid(with_radius_scales(surfaces.rigid, radius_scales))
        if seen is not None:
            own = zip(tree.nodes, surfaces.rigid, strict=True)
            surfaces = surfaces.with_rigid(
                [surface if node.name in seen else EMPTY_OUTLINE for node, surface in own]
            )
        self._surfaces, self._fewest = surfaces, fewest
        self.few = simplify_surfaces(surfaces, FEW)
        self.all = simplify_surfaces(surfaces, np.iinfo(np.int64).max)

    @cached_property
    def very_few(self) -> tuple[Outline, ...]:
        """Surfaces for searches: what only fits does without them."""
        return simplify_surfaces(self._surfaces, self._fewest)

    def with_tree(self, tree: PoseTree) -> "RegistrationBody":
        """The same surfaces on another tree with the same nodes."""
        other = copy.copy(self)
        other.tree, other.kinematics = tree, TreeKinematics(tree)
        return other


@dataclass(frozen=True, eq=False)
class FrameMisfit:
    """How well one frame fits a camera's pose; one that does not agree did not count."""

    frame: str
    E_total: float
    iou: float
    inlier_ratio: float
    agrees: bool


class _UncertainPose:
    """A pose whose errors' covariance is known: deviations are root mean squares over the axes."""

    covariance: Array

    @property
    def rotation_sd(self) -> float:
        """Standard deviation of the rotation [rad]."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3]) / 3.0))

    @property
    def translation_sd(self) -> float:
        """Standard deviation of the place [m]."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:]) / 3.0))


@dataclass(frozen=True, eq=False)
class ObjectPose(_UncertainPose):
    """Where an object stands that a camera on a robot's link has seen.

    Args:
        X_WT: (4, 4) the pose of its frame T in the robot's world.
        covariance: (6, 6) of the pose's error: a rotation vector [rad] and a shift [m], both along
            the world's axes.
        alternatives: (n, 4, 4) other poses X_WT at which it looks alike.
        round_about: (k, 3) axes through its middle, in its frame T, about which it looks alike at
            every angle, so that no picture tells how it is turned about them.
    """

    X_WT: Array
    covariance: Array
    alternatives: Array
    round_about: Array


@dataclass(frozen=True, eq=False)
class RegisteredCamera(_UncertainPose):
    """Where a camera stands.

    Args:
        camera: with its pose X_WC.
        covariance: (6, 6) of the pose's error: a rotation vector [rad] and a shift [m], both along
            the world's axes.
        alternatives: (n, 4, 4) other poses X_WC that fit no worse, as far as can be told.
        seen_object: where the object stands that was seen, if its place was not known.
    """

    camera: PinholeCamera
    covariance: Array
    frames: tuple[FrameMisfit, ...]
    alternatives: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    seen_object: ObjectPose | None = None

    @property
    def contradictions(self) -> tuple[str, ...]:
        """The frames that contradict the others."""
        return tuple(frame.frame for frame in self.frames if not frame.agrees)


class CameraSearch:
    """Finds where a camera stands: numbers of rotations that are tried, and that are fitted."""

    def __init__(self, body: RegistrationBody, rotations: int = 3000, fitted: int = 30) -> None:
        self._body, self._fitted_count = body, fitted
        self._R_CW = spread_rotations(rotations)

    def rough(self) -> "CameraSearch":
        """A search that is faster, and less sure."""
        return CameraSearch(self._body, rotations=2000, fitted=15)

    def register(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> RegisteredCamera:
        """Finds the camera's pose; that which it has is not used.

        Raises:
            MaskError: a mask of another size than the camera's picture, or an empty one.
            RegistrationError: no frames, or no pose explains them.
        """
        if not frames:
            raise RegistrationError(
                f"camera '{camera.name}': no frame shows the body; give masks and joint positions "
                "of one or more frames"
            )
        return self._fitted(camera, frames, self.search(camera, frames))

    def refine(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> RegisteredCamera:
        """Finds the camera's pose within some pixels of that which it has, without alternatives.

        Raises MaskError: a mask of another size than the camera's picture, or an empty one.
        """
        return self._fitted(camera, frames, [camera.X_CW])

    def _fitted(
        self, camera: PinholeCamera, frames: Sequence[PosedFrame], looks: Sequence[Array]
    ) -> RegisteredCamera:
        """The best of the poses that are fitted from some X_CW (4, 4), and those as good.

        Some of many frames tell near what poses all of them are fitted.
        """
        kinematics, some = self._body.kinematics, spread(frames, 24)
        fine = PosedFrames(kinematics, self._body.few, camera, some, SEARCH.fine_spacing)
        last = PosedFrames(kinematics, self._body.all, camera, some, LAST_SPACING)
        halfway = map_ordered(partial(fit_pose, fine, rounds=SEARCH.fine), looks)
        begun = [SharedFit([fine], [X], widths=False) for X in halfway]
        side = max(1.0, SEARCH.piece * fine.size)
        pieces = [fit.tile_costs(fit.start, side) for fit in begun]
        order = np.argsort([one.sum() for one in pieces], kind="stable")
        # Those that are far worse than the best now are not fitted to the end.
        likely = [halfway[k] for k in order if vuong_statistic(pieces[k], pieces[order[0]]) <= 6.0]
        likely = distinct(fine, likely)
        fitted = distinct(last, map_ordered(partial(fit_pose, last, rounds=SEARCH.last), likely))
        if len(some) < len(frames):
            last = PosedFrames(kinematics, self._body.all, camera, frames, LAST_SPACING)
        fits = [SharedFit([last], [X_CW]) for X_CW in fitted]
        return describe_fitted([*zip(fits, map_ordered(with_widths, fits), strict=True)])[0]

    def search(
        self, camera: PinholeCamera, frames: Sequence[PosedFrame], kept: int = 6
    ) -> list[Array]:
        """Poses X_CW (4, 4) near which the best one may be, best first; `kept` at most."""
        body = self._body
        posed = PosedFrames(
            body.kinematics, body.very_few, camera, spread(frames), SEARCH.coarse_spacing
        )

        def best_first(X_CW: Sequence[Array] | Array, side: float) -> list[Array]:
            # A frame counts one at most.
            off = np.minimum(E_total(areas(posed, np.asarray(X_CW), side)), 1.0).mean(axis=1)
            return [X_CW[k] for k in np.argsort(off, kind="stable")]

        starts = np.tile(np.eye(4), (len(self._R_CW), 1, 1))
        starts[:, :3, :3] = self._R_CW
        starts[:, :3, 3] = place_by_bounds(posed, self._R_CW)
        looks = best_first(starts, SEARCH.first_side)[: self._fitted_count]
        for part, count in ((SEARCH.coarse[:3], 12), (SEARCH.coarse[3:], kept)):
            found = map_ordered(partial(fit_pose, posed, rounds=part), looks)
            looks = distinct(posed, best_first(found, SEARCH.second_side))[:count]
        return looks


def describe_fitted(
    fitted: Sequence[tuple[SharedFit, Shared]],
) -> tuple[RegisteredCamera, Array, list[int]]:
    """The best of some fitted poses of a camera; which fit no worse, best first.

    Between these, the covariance (u, u) of what is shared in the best one.
    """
    side = max(1.0, SEARCH.piece * fitted[0][0].seen[0].size)
    pieces = [fit.tile_costs(found, side) for fit, found in fitted]
    order = np.argsort([one.sum() for one in pieces], kind="stable")
    fit, best = fitted[order[0]]
    (seen,), (camera,) = fit.seen, fit.cameras(best)
    ratios = fit.inlier_ratios(best)
    agree = fit.agreeing(ratios)
    misfits = frame_misfits(seen, camera.X_CW, ratios, agree)
    # A frame that contradicts fits no pose, so it tells none from another.
    counted = [one[agree] for one in pieces]
    worse = [vuong_statistic(one, counted[order[0]]) for one in counted]
    as_good = [int(k) for k in order if worse[k] <= SEARCH.significance]
    # Fits that began apart may have ended in one pose.
    looks = [fitted[k][0].cameras(fitted[k][1])[0].X_CW for k in as_good]
    alike = distinct(seen, looks)
    covariance = sum(fit.covariances(best, agree))
    registered = RegisteredCamera(
        camera,
        fit.camera_covariances(best, covariance)[0],
        misfits,
        np.array([np.linalg.inv(X) for X in alike[1:]]).reshape(-1, 4, 4),
    )
    return registered, covariance, as_good


def frame_misfits(
    seen: PosedFrames, X_CW: Array, ratios: Array, agrees: NDArray[np.bool_]
) -> tuple[FrameMisfit, ...]:
    """How well frames fit a camera's pose (4, 4); inlier ratios and which agree (frames,)."""
    found = areas(seen, X_CW[None], np.inf)[0]
    told = (E_total(found), intersection_over_union(found), ratios, agrees)
    rows = zip(seen.frames, *(one.tolist() for one in told), strict=True)
    return tuple(FrameMisfit(frame.name, *row) for frame, *row in rows)


def spread(frames: Sequence[T], most: int = 8) -> list[T]:
    """Some of many frames, from the first to the last."""
    count = min(len(frames), most)
    return [frames[k] for k in np.linspace(0, len(frames) - 1, count).round().astype(int)]


def distinct(frames: PosedFrames, X_CW: Sequence[Array], apart: float = 0.03) -> list[Array]:
    """Those of some poses (4, 4) that show the bodies elsewhere than all before them.

    apart: the distance of bodies that are elsewhere [root of the area].
    """
    points = frames.some_points
    uv = [frames.camera.with_pose(np.linalg.inv(X)).project(points)[0] for X in X_CW]

    def differ(i: int, j: int) -> bool:
        # A point behind the camera is nowhere.
        off = np.nan_to_num(uv[i] - uv[j], nan=frames.size)
        return bool(np.sqrt((off**2).sum(axis=1).mean()) > apart * frames.size)

    return [X_CW[k] for k in apart_from_before(range(len(X_CW)), differ)]


def with_widths(fit: SharedFit, most: int = 5, settled: float = 1e-4) -> Shared:
    """What was fitted to the frames that agree, the widths of their silhouettes among it.

    It is fitted again, at most so many times, where frames have come to agree or not, or the camera
    has moved by more than ``settled`` [rad, m].
    """
    agree, found = fit.agreeing(fit.inlier_ratios(fit.start)), fit.start
    for k in range(most):
        before, used = found, agree
        found = fit.fit(SEARCH.last if k == 0 else SEARCH.last[-1:], found, agree)
        agree = fit.agreeing(fit.inlier_ratios(found))
        moved = np.abs(found.shared - before.shared).max()
        if k > 0 and np.array_equal(agree, used) and moved < settled:
            break
    return found


def suggest_pose(
    body: RegistrationBody,
    camera: PinholeCamera,
    X_WC: Sequence[Array],
    keep_out: Sequence[Box] = (),
    *,
    tried: int = 300,
    seed: int = 0,
    width: int = 160,
) -> tuple[Array, float] | None:
    """The pose, of random ones inside the limits, whose silhouettes differ most.

    A joint without limits is taken to turn once around.

    Args:
        X_WC: the camera's poses that are to be told apart, (4, 4) each, two or more.
        keep_out: what the body must not touch; points of its surfaces are asked.
        width: of the pictures in which silhouettes are compared, about [pixel].

    Returns:
        its values (m,) of the pose tree [rad or m], and of the two camera poses that it tells apart
        least the area in which their silhouettes differ, over the mean area of both; None where no
        pose was found that is seen from all camera poses and touches nothing.
    """
    generator, kinematics = np.random.default_rng(seed), body.kinematics
    lower = np.where(np.isfinite(kinematics.lower), kinematics.lower, -np.pi)
    upper = np.where(np.isfinite(kinematics.upper), kinematics.upper, np.pi)
    share = min(1.0, width / camera.width)
    size = (max(1, round(share * camera.width)), max(1, round(share * camera.height)))
    cameras = [camera.with_pose(one).resized(*size) for one in X_WC]
    best: tuple[Array, float] | None = None
    for _ in range(tried):
        values = generator.uniform(lower, upper)
        X_WN = kinematics.poses(values)
        points = placed_points(body.very_few, X_WN)
        if any(np.all((points >= low) & (points <= high), axis=1).any() for low, high in keep_out):
            continue
        masks = [draw_mask(body.very_few, one.X_CW @ X_WN, one) for one in cameras]
        if not all(mask.any() for mask in masks):
            continue
        difference = min(
            2.0 * np.count_nonzero(a != b) / (np.count_nonzero(a) + np.count_nonzero(b))
            for a, b in combinations(masks, 2)
        )
        if best is None or difference > best[1]:
            best = values, float(difference)
    return best


def apart_from_before(items: Iterable[T], differ: Callable[[T, T], bool]) -> list[T]:
    """Those of some items that differ from all that were kept before them."""
    kept: list[T] = []
    for item in items:
        if all(differ(item, one) for one in kept):
            kept.append(item)
    return kept


def spread_rotations(count: int) -> Array:
    """(count, 3, 3) rotations spread evenly (super-Fibonacci spirals, Alexa, CVPR 2022)."""
    s = np.arange(count) + 0.5
    t = s / count
    d = 2.0 * np.pi * s
    r, R = np.sqrt(t), np.sqrt(1.0 - t)
    # Psi is the positive root of x^4 = x + 4.
    a, b = d / np.sqrt(2.0), d / 1.533751168755204288118041
    q = np.stack([r * np.sin(a), r * np.cos(a), R * np.sin(b), R * np.cos(b)], axis=-1)
    return Rotation.from_quat(q).as_matrix()


def place_by_bounds(frames: PosedFrames, R_CW: Array) -> Array:
    """(n, 3) p_CW at which the body's bounds in the pictures are those of the silhouettes.

    A side of a silhouette that the picture's border cuts off says nothing, and sides that are far
    off say little (Geman and McClure's weights).

    Args:
        R_CW: (n, 3, 3) the camera's rotations.
    """
    bodies = [np.einsum("nij,pj->npi", R_CW, points) for points in frames.points]
    bounds, shown = zip(*[_bounds(frame.mask) for frame in frames.frames], strict=True)
    middles = R_CW @ frames.middle
    # As if all of the bodies were equally far.
    f, c = frames.intrinsics
    spans = np.mean([np.ptp(body[:, :, :2], axis=1) for body in bodies], axis=0)
    size = np.mean([bound[1] - bound[0] for bound in bounds], axis=0)
    depth = np.linalg.norm(spans * f, axis=1) / max(float(np.linalg.norm(size)), 1.0)
    middle = np.mean([bound.mean(axis=0) for bound in bounds], axis=0)
    p_CW = np.column_stack([(middle - c) / f * depth[:, None], depth]) - middles
    # Steps of Gauss and Newton's method, the last ones robust ones.
    for k in range(5):
        H, g = np.zeros((len(R_CW), 3, 3)), np.zeros((len(R_CW), 3))
        for body, bound, sides in zip(bodies, bounds, shown, strict=True):
            add_bound_equations(frames, body + p_CW[:, None], (bound, sides), k >= 2, H, g)
        H += 1e-3 / 3.0 * np.einsum("nii->n", H)[:, None, None] * np.eye(3) + 1e-9 * np.eye(3)
        step = -np.linalg.solve(H, g[..., None])[..., 0]
        length = np.maximum(np.linalg.norm(step, axis=1), 1e-12)
        depth = np.maximum((p_CW + middles)[:, 2], 0.05 * frames.extent)
        p_CW += step * np.minimum(1.0, 0.5 * depth / length)[:, None]
        p_CW[:, 2] = np.maximum(p_CW[:, 2], 0.5 * frames.extent - middles[:, 2])
    return p_CW


def add_bound_equations(
    frames: PosedFrames,
    p_C: Array,
    bound: tuple[Array, NDArray[np.bool_]],
    robust: bool,
    H: Array,
    g: Array,
) -> None:
    """Adds the normal equations of a frame's bounds to H (n, 3, 3) and g (n, 3).

    Args:
        p_C: (n, points, 3) the body in the camera.
        bound: the silhouette's bounds, and which of them count.
        robust: whether what is far off says little.
    """
    f, c = frames.intrinsics
    rows = np.arange(len(p_C))
    # Points are no nearer to the camera than a share of the bodies' extent.
    z = np.maximum(p_C[..., 2], 0.05 * frames.extent)
    uv = p_C[..., :2] / z[..., None] * f + c
    for side, axis in np.argwhere(bound[1]):
        i = (uv[..., axis].argmax if side else uv[..., axis].argmin)(axis=1)
        off = uv[rows, i, axis] - bound[0][side, axis]
        J = np.zeros((len(p_C), 3))
        J[:, axis] = f[axis] / z[rows, i]
        J[:, 2] = -(uv[rows, i, axis] - c[axis]) / z[rows, i]
        weight = np.ones(len(p_C))
        if robust:
            # What is off by half the silhouettes' size says a quarter of what it would.
            weight = (1.0 + (off / (0.5 * frames.size)) ** 2) ** -2
        H += weight[:, None, None] * J[:, :, None] * J[:, None, :]
        g += (weight * off)[:, None] * J


def _bounds(mask: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
    """(2, 2) least and largest u, v of a silhouette's edge, and which of them the border leaves."""
    v, u = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    bounds = np.array([[u[0] - 0.5, v[0] - 0.5], [u[-1] + 0.5, v[-1] + 0.5]])
    height, width = mask.shape
    seen = np.array([[u[0] > 1, v[0] > 1], [u[-1] < width - 2, v[-1] < height - 2]])
    return bounds, seen


def areas(frames: PosedFrames, X_CW: Array, side: float) -> Array:
    """The areas of body, silhouette and what both share, in frames seen from some poses.

    Args:
        X_CW: (n, 4, 4) the world's poses in the camera.
        side: the root of the silhouettes' area in the pictures that are compared [pixel], if the
            camera's are not smaller.

    Returns:
        (n, frames, 3) [pixel].
    """
    camera = frames.smaller(side)
    found = np.empty((len(X_CW), len(frames.frames), 3))

    def score(k: int) -> None:
        X_CN, sums = X_CW[:, None] @ frames.X_WN[k][None], frames.sums(k, camera)
        found[:, k, [0, 2]] = score_bodies(frames.outlines, X_CN, camera, sums[None])
        found[:, k, 1] = sums[:, -1].sum()

    map_ordered(score, range(len(frames.frames)))
    return found


def E_total(found: Array) -> Array:
    """(...) the area that is in body or silhouette alone, over the silhouette's; found (..., 3)."""
    body, mask, both = np.moveaxis(found, -1, 0)
    return np.asarray((body + mask - 2.0 * both) / np.maximum(mask, 1.0))


def intersection_over_union(found: Array) -> Array:
    """(...) of body and silhouette; found (..., 3) of areas."""
    body, mask, both = np.moveaxis(found, -1, 0)
    return np.asarray(both / np.maximum(body + mask - both, 1.0))
