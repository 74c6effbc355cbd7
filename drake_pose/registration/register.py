"""Where a camera stands, told by silhouettes of a body whose joint positions are known.

No guess is needed: all rotations are tried, each with the body where the silhouettes are; the best
are fitted, first to everything within reach and in the end only to what fits (graduated
non-convexity), so that tools which the model lacks, hidden parts and wrong frames pull no more. A
frame then agrees with the others or contradicts them.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drake_pose.body import PoseTree, TriangleMesh
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera import PinholeCamera
from drake_pose.errors import RegistrationError, SettingsError
from drake_pose.matching.fit.levenberg_marquardt import Round
from drake_pose.matching.fit.significance import excess
from drake_pose.matching.fit.surfaces import FEW, VERY_FEW, few_triangles
from drake_pose.registration.agreement import TOLD_APART, agreeing, frame_shares
from drake_pose.registration.calibration_fit import (
    Calibration,
    CalibrationFit,
    start_calibration,
)
from drake_pose.registration.camera_fit import CameraFit
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.start_poses import (
    E_total,
    areas,
    intersection_over_union,
    place_by_bounds,
    spread_rotations,
)
from drake_pose.registration.uncertainty import calibration_uncertainty, pose_covariance
from drake_pose.silhouette import Outline, TreeSurfaces, outline_from_mesh

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_COARSE = tuple(Round(s, 0.05) for s in (0.25, 0.2, 0.15, 0.12, 0.09, 0.07, 0.05, 0.04))
_FINE = (Round(0.05, 0.02), Round(0.03, 0.015), Round(0.02, 0.0125), Round(0.01, 0.0125, 4))
_LAST = (Round(0.02, 0.01), Round(0.01, 0.005), Round(0.005, 0.005, 6))
# Spacing of silhouettes' edge points in each of these [root of the silhouettes' area].
_COARSE_SPACING, _FINE_SPACING, _LAST_SPACING = 1.0 / 40.0, 1.0 / 80.0, 1.0 / 300.0
# Sides of silhouettes in the pictures in which poses are compared [pixel].
_FIRST_SIDE, _SECOND_SIDE = 40.0, 100.0
# Poses that show the bodies nearer to each other than this are one [root of the area].
_APART = 0.03
# So many poses are fitted finely.
_KEPT = 6
# So often frames that agree are fitted again.
_AGAIN = 2
# What is missing or too much is about as large [root of the area].
_PIECE = 0.2
# A pose is worse whose cost is larger by more standard deviations of the difference.
_SIGNIFICANCE = 1.96


@dataclass(frozen=True)
class RegistrationSettings:
    """Parameters of the search for a camera's pose.

    Args:
        rotations: so many are tried.
        fitted: so many of them are fitted.
        searched_frames: at most so many frames are searched in; all are fitted.

    Raises:
        SettingsError: a number below 1.
    """

    rotations: int = 3000
    fitted: int = 30
    searched_frames: int = 8

    def __post_init__(self) -> None:
        for name in ("rotations", "fitted", "searched_frames"):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} must be 1 or more, not {getattr(self, name)}")


class RegistrationBody:
    """A body's surfaces, as fine as searching and fitting a camera need them.

    Attributes:
        tree: the pose tree.
        kinematics: its kinematics.
        very_few, few, all: a surface for each node.

    Args:
        tree: the pose tree.
        seen: the nodes that silhouettes show; all where None.
    """

    def __init__(self, tree: PoseTree, seen: Collection[str] | None = None) -> None:
        self.tree, self.kinematics = tree, TreeKinematics(tree)
        surfaces = TreeSurfaces(tree)
        if seen is not None:
            nothing = outline_from_mesh(TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64)))
            surfaces = surfaces.with_rigid(
                [
                    surface if node.name in seen else nothing
                    for node, surface in zip(tree.nodes, surfaces.rigid, strict=True)
                ]
            )
        self.very_few = few_triangles(surfaces, VERY_FEW)
        self.few = few_triangles(surfaces, FEW)
        self.all = few_triangles(surfaces, np.iinfo(np.int64).max)


@dataclass(frozen=True, eq=False)
class FrameMisfit:
    """How well one frame fits a camera's pose.

    Args:
        frame: its name.
        E_total: the area in which body and silhouette differ, over the silhouette's.
        iou: intersection over union of both.
        share: of both contours' lengths, what fits.
        agrees: whether the frame agrees with the others; else it contradicts them, and did not
            count.
    """

    frame: str
    E_total: float
    iou: float
    share: float
    agrees: bool


@dataclass(frozen=True, eq=False)
class RegisteredCamera:
    """Where a camera stands.

    Args:
        camera: with its pose X_WC.
        covariance: (6, 6) of the pose's error: a rotation vector [rad] by which the camera is
            turned, and a shift [m], both along the world's axes.
        frames: how well each frame fits.
        alternatives: (n, 4, 4) other poses X_WC that fit no worse, as far as can be told.
    """

    camera: PinholeCamera
    covariance: Array
    frames: tuple[FrameMisfit, ...]
    alternatives: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))

    @property
    def rotation_sd(self) -> float:
        """Standard deviation of the rotation, root mean square over the axes [rad]."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3]) / 3.0))

    @property
    def translation_sd(self) -> float:
        """Standard deviation of the place, root mean square over the axes [m]."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:]) / 3.0))

    @property
    def contradictions(self) -> tuple[str, ...]:
        """The frames that contradict the others."""
        return tuple(frame.frame for frame in self.frames if not frame.agrees)


class CameraSearch:
    """Finds where a camera stands.

    Args:
        body: the body.
        settings: of the search.
    """

    def __init__(
        self, body: RegistrationBody, settings: RegistrationSettings | None = None
    ) -> None:
        self._body, self._settings = body, settings or RegistrationSettings()
        self._R_CW = spread_rotations(self._settings.rotations)

    def register(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> RegisteredCamera:
        """Finds the camera's pose; that which it has is not used.

        Args:
            camera: its intrinsics.
            frames: what it sees.

        Raises:
            MaskError: a mask of another size than the camera's picture, or an empty one.
            RegistrationError: no frames, or no pose explains them.
        """
        if not frames:
            raise RegistrationError(
                f"camera '{camera.name}': no frame shows the body; give masks and joint positions "
                "of one or more frames"
            )
        return self._fitted(camera, frames, self._search(camera, frames))

    def refine(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> RegisteredCamera:
        """Finds the camera's pose near that which it has; alternatives are not looked for.

        Args:
            camera: with a pose within some pixels of the right one.
            frames: what it sees, one or more.

        Raises:
            MaskError: a mask of another size than the camera's picture, or an empty one.
        """
        return self._fitted(camera, frames, [camera.X_CW])

    def _fitted(
        self, camera: PinholeCamera, frames: Sequence[PosedFrame], looks: Sequence[Array]
    ) -> RegisteredCamera:
        """The best of the poses that are fitted from some X_CW (4, 4), and those as good."""
        fine = CameraFit(self._posed(self._body.few, camera, frames), _FINE_SPACING)
        last = CameraFit(self._posed(self._body.all, camera, frames), _LAST_SPACING)
        fitted = [last.fit(fine.fit(X_CW, _FINE), _LAST) for X_CW in looks]
        return self._describe(last, _distinct(last.frames, fitted))

    def _posed(
        self, outlines: Sequence[Outline], camera: PinholeCamera, frames: Sequence[PosedFrame]
    ) -> PosedFrames:
        return PosedFrames(self._body.kinematics, outlines, camera, frames)

    def _search(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> list[Array]:
        """Poses X_CW (4, 4) near which the best one may be, best first."""
        count = min(len(frames), self._settings.searched_frames)
        some = [frames[k] for k in np.linspace(0, len(frames) - 1, count).round().astype(int)]
        posed = self._posed(self._body.very_few, camera, some)
        starts = np.tile(np.eye(4), (len(self._R_CW), 1, 1))
        starts[:, :3, :3] = self._R_CW
        starts[:, :3, 3] = place_by_bounds(posed, self._R_CW)
        order = np.argsort(_mean_misfit(posed, starts, _FIRST_SIDE), kind="stable")
        fit = CameraFit(posed, _COARSE_SPACING)
        found = [fit.fit(starts[k], _COARSE) for k in order[: self._settings.fitted]]
        off = _mean_misfit(posed, np.array(found), _SECOND_SIDE)
        return _distinct(posed, [found[k] for k in np.argsort(off, kind="stable")])[:_KEPT]

    def _describe(self, fit: CameraFit, looks: Sequence[Array]) -> RegisteredCamera:
        """The best of the poses X_CW (4, 4), and those that fit no worse."""
        fitted = [_with_widths(fit, X_CW) for X_CW in looks]
        side = max(1.0, _PIECE * fit.frames.size)
        pieces = [fit.piece_costs(one.X_CW[0], one.widths[0], TOLD_APART, side) for one in fitted]
        order = np.argsort([one.sum() for one in pieces], kind="stable")
        best = fitted[order[0]]
        X_CW = best.X_CW[0]
        shares = frame_shares(CalibrationFit([fit], []), best)
        agree = agreeing(shares)
        found = areas(fit.frames, best.X_CW, np.inf)[0]
        iou = intersection_over_union(found)
        rows = zip(fit.frames.frames, E_total(found), iou, shares, agree, strict=True)
        misfits = [
            FrameMisfit(frame.name, float(off), float(one), float(share), bool(agrees))
            for frame, off, one, share, agrees in rows
        ]
        # A frame that contradicts fits no pose, so it tells none from another.
        counted = [one[agree] for one in pieces]
        as_good = [k for k in order if excess(counted[k], counted[order[0]]) <= _SIGNIFICANCE]
        # Fits that began apart may have ended in one pose.
        alike = _distinct(fit.frames, [fitted[k].X_CW[0] for k in as_good])
        own = CalibrationFit([fit], [np.flatnonzero(agree)])
        return RegisteredCamera(
            fit.frames.camera.with_pose(np.linalg.inv(X_CW)),
            pose_covariance(fit, X_CW, calibration_uncertainty(own, best).covariance),
            tuple(misfits),
            np.array([np.linalg.inv(X) for X in alike[1:]]).reshape(-1, 4, 4),
        )


def _mean_misfit(frames: PosedFrames, X_CW: Array, side: float) -> Array:
    """(n,) E_total of poses (n, 4, 4) in the mean; a frame counts one at most."""
    return np.asarray(np.minimum(E_total(areas(frames, X_CW, side)), 1.0).mean(axis=1))


def _distinct(frames: PosedFrames, X_CW: Sequence[Array]) -> list[Array]:
    """Those of some poses (4, 4) that show the bodies elsewhere than all before them."""
    points = np.concatenate(frames.points)
    kept: list[Array] = []
    pictures: list[Array] = []
    for X in X_CW:
        uv, _ = frames.camera.with_pose(np.linalg.inv(X)).project(points)
        # A point behind the camera is nowhere.
        off = [np.nan_to_num(uv - one, nan=frames.size) for one in pictures]
        if all(np.sqrt((one**2).sum(axis=1).mean()) > _APART * frames.size for one in off):
            kept.append(X)
            pictures.append(uv)
    return kept


def _with_widths(fit: CameraFit, X_CW: Array) -> Calibration:
    """A pose (4, 4) fitted to the frames that agree, and the widths of their silhouettes."""
    found, every = start_calibration([fit], [X_CW]), CalibrationFit([fit], [])
    for _ in range(_AGAIN):
        which = np.flatnonzero(agreeing(frame_shares(every, found)))
        found = CalibrationFit([fit], [which]).fit(found, _LAST)
    return found
