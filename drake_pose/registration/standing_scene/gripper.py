"""The pose of a camera on a robot's link, from the gripper that it sees.

The gripper rides along: what its silhouettes tell about the pictures scores a pose
(``fit.riding``). All rotations are searched, and the best poses are fitted to its contours.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.covariance import vuong_statistic
from drake_pose.fit.problem import TIME_OFFSET
from drake_pose.fit.riding import silhouette_gains
from drake_pose.registration.picture_search import (
    PictureFit,
    PictureSearch,
    choose_frames,
    node_places,
)
from drake_pose.registration.recording import Recording, posed_pictures
from drake_pose.registration.register import RegistrationBody
from drake_pose.registration.standing_scene.hand_eye_tracks import PosePrior, poses_differ


class GripperSettings(NamedTuple):
    """Settings of a fit to a gripper; chosen on simulated wrists of three arms.

    Args:
        pictures: maximum number of pictures.
        rounds: of the search, see ``PictureSearch.search``.
        starts: number of rotations, see there.
        fitted: maximum number of poses that are fitted to contours.
        shown: minimum fraction of the pictures that the gripper covers.
        least_ratio: minimum mean inlier ratio of its contours, and where the scene gives about the
            same pose. Grippers of other models have 0.5 at most.
        least_gain: a pose explains at least this many times what the best one explains in pictures
            that are shifted by half their size.
        least_vuong: minimum Vuong statistic of a pose that explains significantly more than others,
            and than with the joint positions of other pictures.
        opening: minimum motion of a finger that tells the clock [m].
        max_sd: maximum standard deviation of a pose along any axis [rad, m].
        clock_sd: maximum standard deviation of a time offset that is determined [s].
    """

    pictures: int = 16
    rounds: tuple[tuple[int, int, int, float], ...] = (
        (64, 150, 24, 0.25),
        (64, 50, 30, 0.15),
        (80, 20, 50, 0.1),
        (160, 6, 80, 0.06),
    )
    starts: int = 1000
    fitted: int = 4
    shown: float = 0.01
    least_ratio: tuple[float, float] = (0.7, 0.5)
    least_gain: float = 1.3
    least_vuong: float = 2.6
    opening: float = 0.005
    clock_sd: float = 0.1
    max_sd: float = 0.04


GRIPPER = GripperSettings()


class GripperFit(NamedTuple):
    """A camera's pose from its gripper.

    Args:
        X_LC: (4, 4).
        covariance: (6, 6) of its errors, rotation vector [rad] and translation [m] along the
            camera's axes.
        ratio: mean inlier ratio of the contours.
        explained, chance: what the silhouettes tell about the pictures (1: about all), and at most
            in shifted pictures (nan: not tried).
        time_offset: value and standard deviation of the clock's offset [s]; None: not determined.
        silhouettes: of the gripper (H, W) at this pose, by the pictures' names.
    """

    X_LC: Array
    covariance: Array
    ratio: float
    explained: float
    chance: float
    time_offset: tuple[float, float] | None
    silhouettes: dict[str, Mask]

    def prior(self, other: Array | None = None) -> PosePrior:
        """Return the pose as a prior of a fit.

        other: covariance of another pose, with which it is to be compared; its first six unknowns
            are the pose's. None: there is none.
        """
        covariance = self.covariance if other is None else self.covariance + other[:6, :6]
        return PosePrior(self.X_LC, covariance)


class GripperSearch:
    """Fits a camera's pose to the gripper in its pictures.

    Args:
        body: the gripper: the link and what it carries, in a pose tree that starts at the link.
        robot: the parts that stand still, in the same tree; the pictures are chosen by how the link
            moves between them.
        camera: its pose is not used.
        recording: the camera's pictures and the joint log.
    """

    def __init__(
        self,
        body: RegistrationBody,
        robot: RegistrationBody,
        camera: PinholeCamera,
        recording: Recording,
    ) -> None:
        self._body, self._camera, self._recording = body, camera, recording
        values = recording.values_at(0.0)
        known = np.flatnonzero(np.isfinite(values).all(axis=1))
        places, self._moves = [], False
        for one in (body, robot):
            own = node_places(one, values[known])
            spread = float(np.linalg.norm(np.ptp(own, axis=0), axis=1).max())
            self._moves |= one is body and spread > GRIPPER.opening
            places.append(own / max(spread, GRIPPER.opening))
        both = np.concatenate(places, axis=1)
        self._rows = known[choose_frames(both, GRIPPER.pictures)].tolist()

    def near(self, X_LC: Array, offset: float) -> GripperFit | None:
        """Return the fit near a pose (4, 4) at a known time offset [s]; None: none is accepted."""
        search = self._search(offset)
        if not self._shown(X_LC, search):
            return None
        found = search.fit(self._camera.with_pose(X_LC))
        return None if found is None else self._accepted(found, math.nan, search)

    def find(self) -> tuple[list[GripperFit], str]:
        """Return the poses that explain the pictures, best first, without a guess.

        Poses are left out that explain significantly less than the best one.

        Returns:
            the fits; and, if there are none, why.
        """
        if not self._moves:
            return [], "its fingers are not logged or do not move, and an outline may be anything's"
        search = self._search(0.0)
        constants = (TIME_OFFSET,) if self._recording.times is not None else ()
        fits = self._fits(search, search.search(GRIPPER.rounds, GRIPPER.starts), constants)
        if fits:
            # Many grippers look nearly the same after half a turn about an axis of their link.
            X_LC, turns = fits[0].camera.X_WC, 1.0 - 2.0 * (1.0 - np.eye(3))
            turned = [np.linalg.inv(np.diag([*one, 1.0]) @ X_LC) for one in turns]
            fits = self._fits(search, turned, constants, fits)
        if not fits:
            return [], "no pose of it explains the pictures"
        best = fits[0]
        shifted = search.with_shifted_pictures()
        others = shifted.search(GRIPPER.rounds[1:], GRIPPER.starts // 2)
        chance = max((shifted.compared.explained(X)[0] for X in others), default=0.0)
        if best.explained < GRIPPER.least_gain * chance:
            return [], (
                f"its silhouettes tell {best.explained:.0%} about the pictures, and "
                f"{chance:.0%} about shifted ones"
            )
        gains, count = self._gains(search, best), len(search.frames)
        exchanged = [
            vuong_statistic(gains, self._gains(search, best, shift))
            for shift in {max(1, round(part * count)) for part in (0.25, 0.5, 0.75)}
        ]
        if min(exchanged) < GRIPPER.least_vuong:
            return [], "its silhouettes fit as well with openings of other moments"
        accepted = list[GripperFit]()
        for one in fits:
            alike = vuong_statistic(gains, self._gains(search, one)) < GRIPPER.least_vuong
            if one is best or alike:
                fit = self._accepted(one, chance, search)
                if fit is not None:
                    accepted.append(fit)
        ratio = float(best.ratios.mean())
        why = "its outline leaves the camera's position open"
        if ratio < GRIPPER.least_ratio[0]:
            why = f"{ratio:.0%} of its contours fit ({GRIPPER.least_ratio[0]:.0%} at least)"
        return accepted, why

    def _search(self, offset: float) -> PictureSearch:
        pictures = posed_pictures(self._recording, self._rows, offset)
        return PictureSearch(self._body, self._camera, pictures, riding=True)

    def _fits(
        self,
        search: PictureSearch,
        poses: Sequence[Array],
        constants: Sequence[str],
        known: Sequence[PictureFit] = (),
    ) -> list[PictureFit]:
        """Return distinct fits from poses X_CW (4, 4), and those that are known, best first."""
        fits = list(known)
        for X in poses[: GRIPPER.fitted]:
            coarse = search.coarse_fit(X)
            fit = None if coarse is None else search.fit(coarse.camera, constants)
            if (
                fit is not None
                and self._shown(fit.camera.X_WC, search)
                and all(poses_differ(fit.camera.X_WC, k.camera.X_WC) for k in fits)
            ):
                fits.append(fit)
        return sorted(fits, key=lambda one: -search.compared.score(one.camera.X_CW))

    def _shown(self, X_LC: Array, search: PictureSearch) -> bool:
        """Return whether a camera at X_LC (4, 4) sees enough of the gripper."""
        return float(self._masks(search, X_LC).mean()) > GRIPPER.shown

    def _masks(self, search: PictureSearch, X_LC: Array, shift: int = 0) -> Mask:
        """Return the gripper's silhouettes (f, h, w) at X_LC (4, 4) in the compared pictures.

        shift: as of ``PictureSearch.silhouettes``.
        """
        return search.silhouettes(search.compared.camera.with_pose(X_LC), shift)

    def _gains(self, search: PictureSearch, fit: PictureFit, shift: int = 0) -> Array:
        """Return what a fit's silhouettes tell by tiles; shift: as of `_masks`."""
        masks = self._masks(search, fit.camera.X_WC, shift)
        return silhouette_gains(search.compared.backgrounds.sums, masks)

    def _accepted(self, fit: PictureFit, chance: float, search: PictureSearch) -> GripperFit | None:
        """Return a fit whose contours fit; None for others."""
        ratio = float(fit.ratios.mean())
        if ratio < GRIPPER.least_ratio[1 if math.isnan(chance) else 0]:
            return None
        try:
            covariance = fit.covariance
        except (ValueError, np.linalg.LinAlgError):  # Too little of the contours fits.
            return None
        pose, clock = fit.fit.camera_covariances(fit.found, covariance)[0], None
        if not np.linalg.eigvalsh(pose).max() < GRIPPER.max_sd**2:
            return None
        if TIME_OFFSET in fit.fit.names:
            k = fit.fit.names.index(TIME_OFFSET)
            deviation = math.sqrt(max(covariance[k, k], 0.0))
            if deviation < GRIPPER.clock_sd:
                clock = float(fit.found.shared[k]), deviation
        X_LC = fit.camera.X_WC
        J = np.kron(np.eye(2), X_LC[:3, :3])
        names = (one.name for one in search.frames)
        drawn = dict(zip(names, search.silhouettes(fit.camera), strict=True))
        return GripperFit(X_LC, J.T @ pose @ J, ratio, fit.explained, chance, clock, drawn)
