"""Register a camera from silhouettes of a body at known joint positions.

No initial guess is needed. For each of many rotations R_CW, the position p_CW follows from the
silhouettes' bounds. The best hypotheses are fitted to the contours by graduated non-convexity:
first to all contour points within reach, finally to inliers only. Tools missing from the model,
occluded parts and wrong frames therefore do not bias the pose. Each frame is then an inlier or an
outlier of the final pose.

With five frames or more, the search runs on two halves of the frames, and the pose found in each
half is judged by the frames of the other (``fit.judge``).
"""

import copy
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import factorial
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from drake_pose.arrays import Array
from drake_pose.body import PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.fit.covariance import vuong_statistic
from drake_pose.fit.judge import LEVEL, PairedEvidence, depth_twin, opposite_side, paired_evidence
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import FEW, VERY_FEW, simplify_surfaces, with_radius_scales
from drake_pose.registration.posed_frames import LAST_SPACING, PosedFrame, PosedFrames
from drake_pose.registration.shared_fit import SharedFit, SharedValues, fit_pose
from drake_pose.silhouette.outline import EMPTY_OUTLINE, Outline, TreeSurfaces
from drake_pose.silhouette.scoring import score_bodies
from drake_pose.workers import map_ordered


class CameraSearchSettings(NamedTuple):
    """Stages and thresholds of the camera search.

    Args:
        coarse, fine, last: stages of three successive fits; scales and spacings are over the square
            root of the silhouettes' area.
        coarse_spacing, fine_spacing: spacing of the silhouettes' edge points in the first two fits
            [square root of the silhouettes' area].
        start_side, refined_side: square root of the silhouettes' area in the downscaled pictures in
            which starts, and coarsely fitted poses, are ranked [pixel].
        significance: poses fit equally well if their costs differ by at most this many standard
            deviations of the difference.
        tile_side: side of the image tiles whose costs are compared [square root of the area], about
            the size of parts that masks or model lack.
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
    start_side: float = 40.0
    refined_side: float = 100.0
    significance: float = 1.96
    tile_side: float = 0.2


SEARCH = CameraSearchSettings()

T = TypeVar("T")


class RegistrationBody:
    """A body's surfaces at three levels of detail.

    Attributes:
        tree, kinematics: the body's pose tree, with m values.
        coarse, medium, full: one surface for each node of the tree, with few, more, and all
            triangles.

    Args:
        tree: the body's pose tree.
        visible_nodes: names of the nodes that the silhouettes show; None: all.
        coarse_triangles: number of triangles of each node at the coarse level.
        radius_scales: (nodes,) factors of the nodes' widths across their y axes; None: 1.
    """

    def __init__(
        self,
        tree: PoseTree,
        visible_nodes: Collection[str] | None = None,
        coarse_triangles: int = VERY_FEW,
        radius_scales: Array | None = None,
    ) -> None:
        self.tree, self.kinematics = tree, TreeKinematics(tree)
        surfaces = TreeSurfaces(tree)
        if radius_scales is not None:
            surfaces = surfaces.with_rigid(with_radius_scales(surfaces.rigid, radius_scales))
        if visible_nodes is not None:
            own = zip(tree.nodes, surfaces.rigid, strict=True)
            surfaces = surfaces.with_rigid(
                [surface if node.name in visible_nodes else EMPTY_OUTLINE for node, surface in own]
            )
        self._surfaces, self._coarse_triangles = surfaces, coarse_triangles
        self.medium = simplify_surfaces(surfaces, FEW)
        self.full = simplify_surfaces(surfaces, np.iinfo(np.int64).max)

    @cached_property
    def coarse(self) -> tuple[Outline, ...]:
        """Surfaces for searches, made when they are first used: fits do not need them."""
        return simplify_surfaces(self._surfaces, self._coarse_triangles)

    def with_tree(self, tree: PoseTree) -> "RegistrationBody":
        """Return a copy with the same surfaces on another tree with the same nodes."""
        other = copy.copy(self)
        other.tree, other.kinematics = tree, TreeKinematics(tree)
        return other


@dataclass(frozen=True, eq=False)
class FrameMisfit:
    """How well one frame fits a camera's pose."""

    frame: str  # The frame's name.
    E_total: float  # Area in body or silhouette alone, over the silhouette's area.
    iou: float  # Intersection over union of body and silhouette.
    inlier_ratio: float  # Fraction of both contours' lengths that fits.
    is_inlier: bool  # Whether the frame agrees with the others; outliers did not count in the fit.


class _UncertainPose:
    """A pose with the (6, 6) covariance of its error."""

    covariance: Array

    @property
    def rotation_sd(self) -> float:
        """Standard deviation of the rotation, root mean square over the axes [rad]."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3]) / 3.0))

    @property
    def translation_sd(self) -> float:
        """Standard deviation of the position, root mean square over the axes [m]."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:]) / 3.0))


@dataclass(frozen=True, eq=False)
class TargetPose(_UncertainPose):
    """The pose of a calibration target seen by a camera on a robot's link."""

    X_WT: Array  # (4, 4) pose of the target's frame T in the robot's world.
    # (6, 6) covariance of the pose's error: rotation vector [rad] and translation [m], both along
    # the world's axes.
    covariance: Array
    alternatives: Array  # (n, 4, 4) other poses X_WT at which the target looks the same.
    # (k, 3) axes in frame T, through the target's middle, about which the target is round: its
    # rotation about them is not observable.
    symmetry_axes: Array


@dataclass(frozen=True, eq=False)
class RegisteredCamera(_UncertainPose):
    """A camera's estimated pose."""

    camera: PinholeCamera  # The camera at its estimated pose X_WC.
    # (6, 6) covariance of the pose's error: rotation vector [rad] and translation [m], both along
    # the world's axes.
    covariance: Array
    frames: tuple[FrameMisfit, ...]  # How well each frame fits.
    # (n, 4, 4) other poses X_WC that fit equally well.
    alternatives: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    target: TargetPose | None = None  # The pose of the calibration target, where it was estimated.
    # (6, 6) part of the covariance that is the same for all frames, and that no residual shows: the
    # camera is known relative to the zeros of joints such as the first one.
    common: Array = field(default_factory=lambda: np.zeros((6, 6)))
    # Whether the joint positions belong to the frames, judged by frames to which the pose was not
    # fitted; None: not tested, as in a refinement, or with too few frames.
    evidence: PairedEvidence | None = None
    agrees: bool = True  # Whether no half of the frames is as likely at another pose of its own.
    # (frames, k, k) cost of each frame's contours in square image tiles.
    costs: Array = field(default_factory=lambda: np.zeros((0, 0, 0)))

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of the outlier frames."""
        return tuple(frame.frame for frame in self.frames if not frame.is_inlier)


class CameraSearch:
    """Finds a camera's pose without an initial guess.

    Args:
        body: the surfaces.
        rotations: number of rotations from which the search starts.
        fitted: number of the best starts that are fitted.
    """

    def __init__(self, body: RegistrationBody, rotations: int = 3000, fitted: int = 30) -> None:
        self._body, self._fitted_count = body, fitted
        self._R_CW = uniform_rotations(rotations)

    @property
    def kinematics(self) -> TreeKinematics:
        """Kinematics of the body's pose tree."""
        return self._body.kinematics

    def rough(self) -> "CameraSearch":
        """Return a faster, less reliable search."""
        return CameraSearch(self._body, rotations=2000, fitted=15)

    def register(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> RegisteredCamera:
        """Return the camera at its estimated pose; its current pose is not used.

        Raises MaskError: a mask is empty, or its size differs from the camera's; RegistrationError:
        there are no frames.
        """
        if not frames:
            raise RegistrationError(
                f"camera '{camera.name}': no frame shows the body; give masks and joint positions "
                "of one or more frames"
            )
        some, starts = evenly_spaced(frames, 24), list[Array]()
        if factorial(len(some)) * LEVEL < 1.0:
            return self._fitted(camera, frames, self.search(camera, some))
        posed = PosedFrames(self._body.kinematics, self._body.coarse, camera, some)
        gains, own = np.zeros((len(some), len(some))), list[Array]()
        for k in range(2):
            starts += (found := self.search(camera, some[k::2], 4))
            own.append(found[0])
            gains[1 - k :: 2] = pairing_gains(posed, own[k])[1 - k :: 2]
        evidence = paired_evidence(gains, posed.X_WN[:, :, :3, 3].reshape(len(some), -1))
        fitted = self._fitted(camera, frames, starts)
        agrees = all(self._agrees(fitted, some[k::2], own[k]) for k in range(2))
        return replace(fitted, evidence=evidence, agrees=agrees)

    def _agrees(self, found: RegisteredCamera, frames: Sequence[PosedFrame], X_CW: Array) -> bool:
        """Return whether at most 8 of some frames tell the found pose from a pose X_CW (4, 4).

        A pose of a wrong body, or at wrong joint positions, is a compromise: to half of the frames,
        the pose X_CW that was searched in them alone is as likely.
        """
        some = evenly_spaced(frames)
        view = self._fine(found.camera, some)
        (known, here), (other, there) = (_fine_costs(view, X) for X in (found.camera.X_CW, X_CW))
        poses = [known, *map(np.linalg.inv, found.alternatives)]
        apart = len(distinct_poses(view, [*poses, other])) > len(distinct_poses(view, poses))
        return not apart or fits_better(here, there)

    def refine(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> RegisteredCamera:
        """Return the camera with its current pose refined, without alternatives.

        The body as drawn at the current pose must be within some pixels of the silhouettes.

        Raises MaskError: a mask is empty, or its size differs from the camera's.
        """
        return self._fitted(camera, frames, [camera.X_CW])

    def mirrored_costs(
        self, found: RegisteredCamera, frames: Sequence[PosedFrame]
    ) -> tuple[Array, Array]:
        """Return the costs (n, k, k) of at most 8 frames, as given and mirrored, in image tiles.

        The mirror image of a silhouette is nearly the silhouette from the opposite side of the
        found pose, from which the camera of the mirrored frames is fitted.
        """
        body, some, X_CW = self._body, evenly_spaced(frames), found.camera.X_CW
        middle = PosedFrames(body.kinematics, body.coarse, found.camera, some).middle
        there = found.camera.mirrored()
        mirrored = [one.mirrored() for one in some]
        coarse = PosedFrames(body.kinematics, body.coarse, there, mirrored, SEARCH.coarse_spacing)
        opposite = fit_pose(coarse, opposite_side(X_CW, middle), SEARCH.coarse)
        costs = _fine_costs(self._fine(there, mirrored), opposite)[1]
        return _fine_costs(self._fine(found.camera, some), X_CW)[1], costs[..., ::-1]

    def _fine(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> PosedFrames:
        """Return frames prepared for fits at the fine level."""
        body = self._body
        return PosedFrames(body.kinematics, body.medium, camera, frames, SEARCH.fine_spacing)

    def _fitted(
        self, camera: PinholeCamera, frames: Sequence[PosedFrame], starts: Sequence[Array]
    ) -> RegisteredCamera:
        """Return the camera at the best pose fitted from starts X_CW (4, 4), see `select_best`.

        At most 24 frames narrow the starts down; all frames enter the final fit.
        """
        kinematics, some = self._body.kinematics, evenly_spaced(frames, 24)
        fine = self._fine(camera, some)
        last = PosedFrames(kinematics, self._body.full, camera, some, LAST_SPACING)
        halfway, costs = zip(*map_ordered(partial(_fine_costs, fine), starts), strict=True)
        order = np.argsort([one.sum() for one in costs], kind="stable")
        # Poses far worse than the best are dropped half-way.
        likely = [halfway[k] for k in order if vuong_statistic(costs[k], costs[order[0]]) <= 6.0]
        likely = distinct_poses(fine, likely)
        fitted = distinct_poses(
            last, map_ordered(partial(fit_pose, last, rounds=SEARCH.last), likely)
        )
        if len(some) < len(frames):
            last = PosedFrames(kinematics, self._body.full, camera, frames, LAST_SPACING)
        fits = [SharedFit([last], [X_CW]) for X_CW in fitted]
        return select_best([*zip(fits, map_ordered(fit_to_inliers, fits), strict=True)])[0]

    def search(
        self, camera: PinholeCamera, frames: Sequence[PosedFrame], most: int = 8, kept: int = 6
    ) -> list[Array]:
        """Return up to `kept` coarsely fitted pose hypotheses X_CW (4, 4), best first.

        At most `most` frames, evenly spaced, are used, and not the camera's current pose. The best
        hypothesis brings its twin reversed in depth, see ``depth_twin``.
        """
        body = self._body
        posed = PosedFrames(
            body.kinematics, body.coarse, camera, evenly_spaced(frames, most), SEARCH.coarse_spacing
        )

        def best_first(X_CW: Sequence[Array] | Array, side: float) -> list[Array]:
            """Return poses (4, 4) in the order of mean E_total; side: as of `overlap_areas`."""
            # The error of a frame is clipped at 1.
            off = np.minimum(E_total(overlap_areas(posed, np.asarray(X_CW), side)), 1.0)
            return [X_CW[k] for k in np.argsort(off.mean(axis=1), kind="stable")]

        starts = np.tile(np.eye(4), (len(self._R_CW), 1, 1))
        starts[:, :3, :3] = self._R_CW
        starts[:, :3, 3] = positions_from_bounds(posed, self._R_CW)
        hypotheses = best_first(starts, SEARCH.start_side)[: self._fitted_count]
        for part, count in ((SEARCH.coarse[:3], 12), (SEARCH.coarse[3:], kept)):
            found = map_ordered(partial(fit_pose, posed, rounds=part), hypotheses)
            hypotheses = distinct_poses(posed, best_first(found, SEARCH.refined_side))[:count]
        twin = depth_twin(hypotheses[0], posed.some_points)
        twin = fit_pose(posed, twin, SEARCH.coarse)
        return distinct_poses(posed, best_first([*hypotheses, twin], SEARCH.refined_side))


def _fine_costs(view: PosedFrames, X_CW: Array) -> tuple[Array, Array]:
    """Return X_CW (4, 4) fitted at the fine level, and the frames' costs in image tiles there."""
    fit = SharedFit([view], [fit_pose(view, X_CW, SEARCH.fine)], fit_biases=False)
    costs = fit.tile_costs(fit.start, max(1.0, SEARCH.tile_side * view.size))
    return fit.cameras(fit.start)[0].X_CW, costs


def select_best(
    fitted: Sequence[tuple[SharedFit, SharedValues]],
) -> tuple[RegisteredCamera, Array, list[int]]:
    """Select the best of one or more fits of a camera's pose to the same frames.

    ``fitted``: the fits, each of this camera only, with their fitted values. Returns the camera,
    with distinct poses that fit equally well as alternatives; the (u, u) covariance of the best
    fit's shared unknowns; and the indices in `fitted` of all equally good fits, best first.
    """
    side = max(1.0, SEARCH.tile_side * fitted[0][0].views[0].size)
    costs = [fit.tile_costs(found, side) for fit, found in fitted]
    order = np.argsort([one.sum() for one in costs], kind="stable")
    fit, best = fitted[order[0]]
    (posed,), (camera,) = fit.views, fit.cameras(best)
    ratios = fit.inlier_ratios(best)
    inliers = fit.inliers(ratios)
    misfits = frame_misfits(posed, camera.X_CW, ratios, inliers)
    # An outlier frame fits no pose, so it does not discriminate between poses.
    counted = [one[inliers] for one in costs]
    worse = [vuong_statistic(one, counted[order[0]]) for one in counted]
    as_good = [int(k) for k in order if worse[k] <= SEARCH.significance]
    # Fits from different starts may have converged to the same pose.
    poses = [fitted[k][0].cameras(fitted[k][1])[0].X_CW for k in as_good]
    alike = distinct_poses(posed, poses)
    parts = fit.covariances(best, inliers)
    covariance = np.sum(parts, axis=0)
    registered = RegisteredCamera(
        camera,
        fit.camera_covariances(best, covariance)[0],
        misfits,
        np.array([np.linalg.inv(X) for X in alike[1:]]).reshape(-1, 4, 4),
        common=fit.camera_covariances(best, parts[-1])[0],
        costs=costs[order[0]],
    )
    return registered, covariance, as_good


def frame_misfits(
    posed: PosedFrames, X_CW: Array, ratios: Array, inliers: NDArray[np.bool_]
) -> tuple[FrameMisfit, ...]:
    """Return how well each frame fits X_CW (4, 4), by inlier ratios and inliers (frames,)."""
    found = overlap_areas(posed, X_CW[None], np.inf)[0]
    columns = (E_total(found), intersection_over_union(found), ratios, inliers)
    rows = zip(posed.frames, *(one.tolist() for one in columns), strict=True)
    return tuple(FrameMisfit(frame.name, *row) for frame, *row in rows)


def fits_better(costs: Array, others: Array) -> bool:
    """Return whether costs of image tiles are significantly below others of the same tiles."""
    return vuong_statistic(others, costs) > ndtri(1.0 - LEVEL)


def evenly_spaced(frames: Sequence[T], most: int = 8) -> list[T]:
    """Return at most `most` items, evenly spaced from the first to the last."""
    count = min(len(frames), most)
    return [frames[k] for k in np.linspace(0, len(frames) - 1, count).round().astype(int)]


def distinct_poses(frames: PosedFrames, X_CW: Sequence[Array], apart: float = 0.03) -> list[Array]:
    """Return the poses X_CW (4, 4) that place the body apart from every pose kept before.

    ``frames``: frames of the camera, in which the body's points are compared. ``X_CW``: the poses,
    the preferred ones first. ``apart``: minimum root mean square distance of the body's points in
    the picture [square root of the silhouettes' area].
    """
    points = frames.some_points
    uv = [frames.camera.with_pose(np.linalg.inv(X)).project(points)[0] for X in X_CW]

    def differ(i: int, j: int) -> bool:
        # A point behind one of the cameras counts as apart by one silhouette size.
        off = np.nan_to_num(uv[i] - uv[j], nan=frames.size)
        return bool(np.sqrt((off**2).sum(axis=1).mean()) > apart * frames.size)

    return [X_CW[k] for k in keep_distinct(range(len(X_CW)), differ)]


def fit_to_inliers(fit: SharedFit, most: int = 5, settled: float = 1e-4) -> SharedValues:
    """Fit camera and boundary biases to the inlier frames, reselecting them after each fit.

    ``fit``: the fit, whose unknowns start from 0. ``most``: maximum number of fits. ``settled``:
    fits end once the inliers stay the same and no shared unknown changes by more [rad, m].
    """
    inliers, found = fit.inliers(fit.inlier_ratios(fit.start)), fit.start
    for k in range(most):
        before, used = found, inliers
        found = fit.fit(SEARCH.last if k == 0 else SEARCH.last[-1:], found, inliers)
        inliers = fit.inliers(fit.inlier_ratios(found))
        moved = np.abs(found.shared - before.shared).max()
        if k > 0 and np.array_equal(inliers, used) and moved < settled:
            break
    return found


def keep_distinct(items: Iterable[T], differ: Callable[[T, T], bool]) -> list[T]:
    """Return the items that `differ` from every item kept before them; the first is kept."""
    kept: list[T] = []
    for item in items:
        if all(differ(item, one) for one in kept):
            kept.append(item)
    return kept


def uniform_rotations(count: int) -> Array:
    """Return (count, 3, 3) evenly spread rotations (super-Fibonacci spirals, Alexa, CVPR 2022)."""
    s = np.arange(count) + 0.5
    t = s / count
    d = 2.0 * np.pi * s
    r, R = np.sqrt(t), np.sqrt(1.0 - t)
    # Psi = 1.5337... is the positive root of x^4 = x + 4.
    a, b = d / np.sqrt(2.0), d / 1.533751168755204288118041
    q = np.stack([r * np.sin(a), r * np.cos(a), R * np.sin(b), R * np.cos(b)], axis=-1)
    return Rotation.from_quat(q).as_matrix()


def positions_from_bounds(frames: PosedFrames, R_CW: Array) -> Array:
    """Return positions p_CW (n, 3) at which the body's bounds match the silhouettes' bounds.

    The distances of the bounds in all frames are minimised by Gauss-Newton steps, the last ones
    with Geman and McClure's weights. Sides at the picture's border are ignored.

    R_CW: (n, 3, 3) the world's rotations in the camera.
    """
    bodies = [np.einsum("nij,pj->npi", R_CW, points) for points in frames.points]
    bounds, shown = [], []  # Least u, v, then greatest u, v of each mask; which are off the border.
    for frame in frames.frames:
        height, width = frame.mask.shape
        v, u = np.flatnonzero(frame.mask.any(axis=1)), np.flatnonzero(frame.mask.any(axis=0))
        bounds.append(np.array([[u[0] - 0.5, v[0] - 0.5], [u[-1] + 0.5, v[-1] + 0.5]]))
        shown.append(np.array([[u[0] > 1, v[0] > 1], [u[-1] < width - 2, v[-1] < height - 2]]))
    middles = R_CW @ frames.middle
    # Initial guess as if all of the body were at the same depth.
    f, c = frames.intrinsics
    spans = np.mean([np.ptp(body[:, :, :2], axis=1) for body in bodies], axis=0)
    size = np.mean([bound[1] - bound[0] for bound in bounds], axis=0)
    depth = np.linalg.norm(spans * f, axis=1) / max(float(np.linalg.norm(size)), 1.0)
    middle = np.mean([bound.mean(axis=0) for bound in bounds], axis=0)
    p_CW = np.column_stack([(middle - c) / f * depth[:, None], depth]) - middles
    # Gauss-Newton steps; the last three are robust.
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
    """Add one frame's normal equations of n positions p_CW, from the bounds' distances.

    Args:
        frames: the camera's frames, for its intrinsics and the body's size.
        p_C: (n, points, 3) the body's points in the camera at each position [m].
        bound: the silhouette's least u, v, then greatest u, v (2, 2), and which of them count.
        robust: whether large distances are down-weighted.
        H, g: (n, 3, 3) and (n, 3) sums over frames, which the equations are added to.
    """
    f, c = frames.intrinsics
    rows = np.arange(len(p_C))
    # A minimum depth keeps the projection finite.
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
            # A distance of half the silhouettes' size has a quarter of its full weight.
            weight = (1.0 + (off / (0.5 * frames.size)) ** 2) ** -2
        H += weight[:, None, None] * J[:, :, None] * J[:, None, :]
        g += (weight * off)[:, None] * J


def overlap_areas(frames: PosedFrames, X_CW: Array, side: float) -> Array:
    """Return the areas of body, silhouette and their intersection at n poses in all frames.

    Args:
        frames: the camera's frames; its own pose is not used.
        X_CW: (n, 4, 4) poses of the world in the camera.
        side: square root of the silhouettes' area in the downscaled pictures that are compared
            [pixel]; pictures are never enlarged.

    Returns (n, frames, 3) [pixel of the downscaled pictures].
    """
    camera = frames.downscaled(side)
    found = np.empty((len(X_CW), len(frames.frames), 3))

    def score(k: int) -> None:
        X_CN, sums = X_CW[:, None] @ frames.X_WN[k][None], frames.sums(k, camera)
        found[:, k, [0, 2]] = score_bodies(frames.outlines, X_CN, camera, sums[None])
        found[:, k, 1] = sums[:, -1].sum()

    map_ordered(score, range(len(frames.frames)))
    return found


def pairing_gains(frames: PosedFrames, X_CW: Array) -> Array:
    """Return the gains (n, n) of n frames with the rows of all, see ``paired_evidence``.

    The gain is the intersection over union of mask and body at a pose X_CW (4, 4).
    """
    camera = frames.downscaled(SEARCH.refined_side)

    def gains(k: int) -> Array:
        sums = frames.sums(k, camera)
        body, both = score_bodies(frames.outlines, X_CW @ frames.X_WN, camera, sums[None]).T
        mask = np.full(len(body), sums[:, -1].sum())
        return intersection_over_union(np.stack([body, mask, both], axis=-1))

    return np.array(map_ordered(gains, range(len(frames.frames))))


def E_total(found: Array) -> Array:
    """Return the area (...) in body or mask alone over the mask's.

    found: (..., 3) areas of body, mask and their intersection, see `overlap_areas`.
    """
    body, mask, both = np.moveaxis(found, -1, 0)
    return np.asarray((body + mask - 2.0 * both) / np.maximum(mask, 1.0))


def intersection_over_union(found: Array) -> Array:
    """Return the intersection over union (...) of body and mask; found: as of `E_total`."""
    body, mask, both = np.moveaxis(found, -1, 0)
    return np.asarray(both / np.maximum(body + mask - both, 1.0))
