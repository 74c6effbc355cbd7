"""The pose of a camera on a robot's link, from the gripper that it sees.

The gripper moves with the camera. A pose's score is how well the gripper's silhouettes separate the
kinds of pixels in the pictures (``fit.riding``). All rotations are searched, and the best poses are
fitted to the gripper's contours.
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
    """Settings of a fit to a gripper; chosen on simulated wrists of three arms."""

    pictures: int = 16  # Maximum number of pictures.
    # rounds, starts: `rounds` and `rotations` of ``PictureSearch.search``.
    rounds: tuple[tuple[int, int, int, float], ...] = (
        (64, 150, 24, 0.25),
        (64, 50, 30, 0.15),
        (80, 20, 50, 0.1),
        (160, 6, 80, 0.06),
    )
    starts: int = 1000
    fitted: int = 4  # Maximum number of poses that are fitted to contours.
    shown: float = 0.01  # Minimum fraction of the pictures' pixels that the gripper covers.
    # Minimum mean inlier ratio of its contours, without a guess and near the pose that the scene
    # gives. Grippers of other models reach 0.5 at most.
    least_ratio: tuple[float, float] = (0.7, 0.5)
    # Minimum explained fraction over the largest one that any pose reaches in the same pictures
    # shifted by half their size.
    least_gain: float = 1.3
    # Vuong statistic from which one pose explains significantly more than another, or more than
    # itself with the joint positions of other pictures.
    least_vuong: float = 2.6
    opening: float = 0.005  # Minimum motion of a finger that determines the time offset [m].
    # Maximum standard deviation of a time offset that counts as determined [s].
    clock_sd: float = 0.1
    max_sd: float = 0.04  # Maximum standard deviation of a pose along any axis [rad and m].


GRIPPER = GripperSettings()


class GripperFit(NamedTuple):
    """A camera's pose from its gripper."""

    X_LC: Array  # (4, 4) the camera's pose on the link.
    # (6, 6) of the pose's errors, rotation vector [rad] and translation [m] along the camera's
    # axes.
    covariance: Array
    ratio: float  # Mean inlier ratio of the contours.
    explained: float  # What the silhouettes tell about the pixels, over about the most possible.
    chance: float  # Largest `explained` of any pose in shifted pictures; nan: not tried.
    # Value and standard deviation of the time offset [s]; None: not determined.
    time_offset: tuple[float, float] | None
    silhouettes: dict[str, Mask]  # (H, W) of the gripper at this pose, by picture name.

    def prior(self, other: Array | None = None) -> PosePrior:
        """Return the pose as a prior of a fit, or for a comparison with another pose.

        other: (6 + k, 6 + k) covariance of the other pose's errors, then of k further unknowns; the
            first part is added. None: nothing is added.
        """
        covariance = self.covariance if other is None else self.covariance + other[:6, :6]
        return PosePrior(self.X_LC, covariance)


class GripperSearch:
    """Fits a camera's pose to the gripper in its pictures.

    Args:
        body: the gripper: the link and what it carries, in a pose tree that starts at the link.
        robot: the parts that stand still, in the same tree. Their poses on the link, and the
            fingers', tell which pictures are most dissimilar.
        camera: its intrinsics; its pose is not used.
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
        for part in (body, robot):
            origins = node_places(part, values[known])
            spread = float(np.linalg.norm(np.ptp(origins, axis=0), axis=1).max())
            self._moves |= part is body and spread > GRIPPER.opening
            places.append(origins / max(spread, GRIPPER.opening))
        features = np.concatenate(places, axis=1)
        self._rows = known[choose_frames(features, GRIPPER.pictures)].tolist()

    def near(self, X_LC: Array, offset: float) -> GripperFit | None:
        """Return the fit near a pose (4, 4) of the camera on the link; None: it is not accepted.

        offset: the known time offset [s].
        """
        search = self._search(offset)
        if not self._shown(X_LC, search):
            return None
        fit = search.fit(self._camera.with_pose(X_LC))
        return None if fit is None else self._accepted(fit, math.nan, search)

    def find(self) -> tuple[list[GripperFit], str]:
        """Search without a guess, and return the accepted fits, best first.

        Poses that explain significantly less than the best one are left out.

        Returns the fits, and the reason in words that applies if there are none.
        """
        if not self._moves:
            return [], "its fingers are not logged or do not move, and an outline may be anything's"
        search = self._search(0.0)
        constants = (TIME_OFFSET,) if self._recording.times is not None else ()
        fits = self._fits(search, search.search(GRIPPER.rounds, GRIPPER.starts), constants)
        if fits:
            # Many grippers look nearly the same after half a turn about an axis of their link.
            X_LC, turns = fits[0].camera.X_WC, 1.0 - 2.0 * (1.0 - np.eye(3))
            turned = [np.linalg.inv(np.diag([*turn, 1.0]) @ X_LC) for turn in turns]
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
        for candidate in fits:
            alike = vuong_statistic(gains, self._gains(search, candidate)) < GRIPPER.least_vuong
            if candidate is best or alike:
                fit = self._accepted(candidate, chance, search)
                if fit is not None:
                    accepted.append(fit)
        ratio = float(best.ratios.mean())
        why = "its outline leaves the camera's position open"
        if ratio < GRIPPER.least_ratio[0]:
            why = f"{ratio:.0%} of its contours fit ({GRIPPER.least_ratio[0]:.0%} at least)"
        return accepted, why

    def _search(self, offset: float) -> PictureSearch:
        """Return a search in the chosen pictures, with joint positions at a time offset [s]."""
        pictures = posed_pictures(self._recording, self._rows, offset)
        return PictureSearch(self._body, self._camera, pictures, riding=True)

    def _fits(
        self,
        search: PictureSearch,
        poses: Sequence[Array],
        constants: Sequence[str],
        known: Sequence[PictureFit] = (),
    ) -> list[PictureFit]:
        """Return distinct fits, the known ones among them, best first.

        Args:
            search: in the pictures that are fitted.
            poses: starts X_CW (4, 4), where the world is the link, best first.
            constants: further unknowns, as of ``PictureSearch.fit``.
            known: earlier fits.
        """
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
        return sorted(fits, key=lambda fit: -search.compared.score(fit.camera.X_CW))

    def _shown(self, X_LC: Array, search: PictureSearch) -> bool:
        """Return whether the gripper covers enough of the pictures of a camera at X_LC (4, 4)."""
        return float(self._masks(search, X_LC).mean()) > GRIPPER.shown

    def _masks(self, search: PictureSearch, X_LC: Array, shift: int = 0) -> Mask:
        """Return the gripper's silhouettes (f, h, w) at X_LC (4, 4) in the compared pictures.

        shift: as of ``PictureSearch.silhouettes``.
        """
        return search.silhouettes(search.compared.camera.with_pose(X_LC), shift)

    def _gains(self, search: PictureSearch, fit: PictureFit, shift: int = 0) -> Array:
        """Return the gains of a fit's silhouettes by tiles, see ``silhouette_gains``.

        shift: as of `_masks`.
        """
        masks = self._masks(search, fit.camera.X_WC, shift)
        return silhouette_gains(search.compared.backgrounds.sums, masks)

    def _accepted(self, fit: PictureFit, chance: float, search: PictureSearch) -> GripperFit | None:
        """Return the camera's pose from a fit; None: its contours fit badly, or it is not exact.

        chance: as of ``GripperFit``; nan for a fit near the pose that the scene gives.
        """
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
        names = (frame.name for frame in search.frames)
        silhouettes = dict(zip(names, search.silhouettes(fit.camera), strict=True))
        return GripperFit(X_LC, J.T @ pose @ J, ratio, fit.explained, chance, clock, silhouettes)
