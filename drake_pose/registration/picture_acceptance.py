"""Accept a camera that was fitted to pictures, and evaluate all its pictures."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.fit.background import MODEL, estimate_gain
from drake_pose.fit.judge import PairedEvidence, paired_evidence, paired_gains
from drake_pose.fit.parameters import POSE_NAMES
from drake_pose.fit.problem import TIME_OFFSET
from drake_pose.fit.surfaces import simplify_or_hull
from drake_pose.registration.picture_search import (
    PictureFit,
    PictureSearch,
    PosedPicture,
    RoughPose,
    node_places,
    segment_picture,
)
from drake_pose.registration.posed_frames import (
    PosedFrame,
    PosedFrames,
    downscaled,
    joints_like_cameras,
)
from drake_pose.registration.pyramid_level import PICTURES
from drake_pose.registration.recording import (
    NO_CLOCK,
    Recording,
    TimeOffset,
    left_out,
    posed_pictures,
)
from drake_pose.registration.register import (
    FrameMisfit,
    RegisteredCamera,
    RegistrationBody,
    evenly_spaced,
    frame_misfits,
)
from drake_pose.registration.shared_fit import SHARED, SharedFit, inlier_threshold
from drake_pose.silhouette.scoring import draw_mask
from drake_pose.workers import map_ordered


@dataclass(frozen=True, eq=False)
class PictureRegistration:
    """A camera registered from its pictures."""

    found: RegisteredCamera  # The camera.
    # Its frames, with masks and foreground log-odds, at the logged joint values.
    frames: tuple[PosedFrame, ...]
    pictures: dict[str, Picture]  # The pictures of these frames, by name.
    fit: PictureFit  # The final fit.
    time_offset: TimeOffset | None  # Of the camera's clock; None: the log has no times.
    focal_deviation: float  # Relative standard deviation of the focal length; 0: it was not fitted.
    recording: Recording  # The recording, with the drift of its clock removed.
    joint_offsets: Array  # (m,) added to the frames' values for their masks and log-odds.
    evidence: PairedEvidence  # Of pictures that were not fitted.
    runner_up: tuple[Array, float] | None  # As of ``PictureStart``.

    @property
    def ratios(self) -> dict[str, float]:
        """Inlier ratios by frame of the fit."""
        (posed,) = self.fit.fit.views
        names = [frame.name for frame in posed.frames]
        return dict(zip(names, self.fit.ratios.tolist(), strict=True))


class PictureStart(NamedTuple):
    """Result of a search.

    camera: at its approximate pose. rows: indices of the recording's pictures to fit. clock: the
    time offset. alternatives: other poses X_CW (4, 4) that explain the pictures about as well.
    joint_offsets: (m,) approximate ones [rad or m]; None: 0. search: a search in the pictures to
    fit, whose backgrounds are used again; None: they are estimated. runner_up: X_CW (4, 4) of the
    best pose found elsewhere, and by how much less of the contours fits there (``ratio_margin``
    [sd]); None: there is none. evidence: of an earlier fit; None: the fit is judged.
    """

    camera: PinholeCamera
    rows: Sequence[int]
    clock: TimeOffset
    alternatives: Sequence[Array]
    joint_offsets: Array | None = None
    search: PictureSearch | None = None
    runner_up: tuple[Array, float] | None = None
    evidence: PairedEvidence | None = None

    @classmethod
    def of(cls, one: PictureRegistration) -> "PictureStart":
        """Return a start from an earlier registration."""
        rows = [one.recording.names.index(frame.name) for frame in one.frames]
        others = [np.linalg.inv(X) for X in one.found.alternatives]
        clock = one.time_offset or NO_CLOCK
        return cls(one.found.camera, rows, clock, others, one.joint_offsets, evidence=one.evidence)


def coarse_fits(searches: Sequence[PictureSearch], X_CW: Sequence[Array]) -> list[RoughPose]:
    """Return cameras roughly fitted from poses (4, 4), best first.

    Poses at which the body leaves the pictures are left out.
    """
    fitted = map_ordered(lambda one: one[0].coarse_fit(one[1]), zip(searches, X_CW, strict=True))
    return best_first([one for one in fitted if one is not None])


def best_first(poses: Sequence[RoughPose]) -> list[RoughPose]:
    """Return poses sorted by their agreement with the pictures, see ``RoughPose``."""
    return sorted(poses, key=lambda one: -one.agreement)


def opposite_pose(
    best: RoughPose, *, evaluations: int = 250, turn: float = 0.25, starts: int = 6
) -> RoughPose | None:
    """Return the best pose on the opposite side of the body, in the mirrored pictures.

    From behind, a distant body has the mirror image of its silhouette. So mirrored pictures are
    explained by a camera on the opposite side of the body, though less well, as near parts are
    shown larger. Fewer of the contours fit then; what both poses explain differs too little.

    ``best``: the pose in the pictures as they are. ``evaluations``, ``turn``: of each local search,
    see ``PyramidLevel.improve``. ``starts``: number of local searches. Returns the pose; None: the
    body leaves the pictures.
    """
    mirrored = best.search.mirrored()
    X_CW = best.search.compared.opposite(best.camera.X_CW)
    _, improved = mirrored.compared.improve([X_CW] * starts, evaluations, turn)
    return mirrored.coarse_fit(improved[0])


def depth_reversed(best: RoughPose) -> RoughPose | None:
    """Return the best pose near the depth twin of a pose; None: the body leaves the pictures."""
    level = best.search.compared
    _, improved = level.improve([level.depth_twin(best.camera.X_CW)] * 4, 80, 0.2)
    return best.search.coarse_fit(improved[0])


class AcceptanceSettings(NamedTuple):
    """What a fit must reach to be accepted.

    Args:
        min_ratio: minimum mean inlier ratio of all frames. Where joint positions of other episodes
            or models of other robots explain much, it is 0.4 at most.
        max_clock_sd: a time offset with a larger standard deviation is not determined [s].
        guessed_lens_error: relative error of focal lengths that pictures alone determine, which
            enlarges the covariance. Simulated ones err by 1 %, real ones by 2 to 50 %.
        rows: maximum number of rows whose pairing with pictures is tested.
    """

    min_ratio: float = 0.4
    max_clock_sd: float = 0.1
    guessed_lens_error: float = 0.25
    rows: int = 90


ACCEPTANCE = AcceptanceSettings()


def picture_evidence(
    body: RegistrationBody,
    best: PictureFit,
    recording: Recording,
    start: PictureStart,
    joint_offsets: Array,
) -> PairedEvidence:
    """Test whether pictures that were not fitted belong to their joint positions.

    Args:
        body: the robot's surfaces.
        best: the camera's fit.
        recording: with the drift of its clock removed.
        start: with the fitted time offset.
        joint_offsets: (m,) added to the recording's values [rad or m].
    """
    values = recording.values_at(start.clock.value) + joint_offsets
    fitted = [recording.names.index(frame.name) for frame in best.fit.views[0].frames]
    judging = np.setdiff1d(left_out(body, recording), fitted)
    # Rows of all pictures are exchanged.
    known = np.isfinite(values).all(axis=1)
    tested = evenly_spaced(np.flatnonzero(known).tolist(), ACCEPTANCE.rows)
    camera = downscaled(best.camera, min(1.0, PICTURES.background_width / best.camera.width))
    background = best.background.resized(camera.width, camera.height)
    outlines = simplify_or_hull(body.coarse, PICTURES.triangles[-1])
    poses = [camera.X_CW @ body.kinematics.poses(values[k]) for k in tested]
    covered = np.array(map_ordered(lambda X_CN: draw_mask(outlines, X_CN, camera), poses))
    # The background is unknown where the body covers it in all frames.
    covered &= ~covered.all(axis=0)
    log_odds, size = np.zeros(covered.shape, np.float32), (camera.width, camera.height)
    for k, row in enumerate(tested):
        if row in judging:
            resized = cv2.resize(recording.read(row), size, interpolation=cv2.INTER_AREA)
            picture = np.asarray(resized, np.uint8)
            gain = estimate_gain(picture, background.colours)
            found = background.foreground(picture, gain, (slice(0), slice(0)))[1]
            log_odds[k] = np.clip(found, -MODEL.max_log_odds, MODEL.max_log_odds)
    places = node_places(body, values[tested]).reshape(len(tested), -1)
    return paired_evidence(paired_gains(covered, log_odds), places)


def accept_fit(
    body: RegistrationBody,
    best: PictureFit,
    recording: Recording,
    start: PictureStart,
    joint_offsets: Array,
    focal: float,
) -> PictureRegistration:
    """Return the registration of a fit, if it explains the pictures.

    The arguments after the robot's surfaces are what `_fit_until_stable` returns.

    ``focal``: prior standard deviation of the focal length's logarithm; 0: it was not fitted.
    Raises RegistrationError: the joint positions of other pictures explain the pictures as well; no
    more than half of the fitted frames agree; or the pose is not determined.
    """
    fit, (posed,) = best.fit, best.fit.views
    evidence = start.evidence or picture_evidence(body, best, recording, start, joint_offsets)
    agreeing, count = int(np.count_nonzero(best.inliers)), len(posed.frames)
    if not evidence.holds:
        raise unexplained_error(
            start.camera, f"{evidence}. Are the joint positions those of another time or episode?"
        )
    ratio = float(best.ratios.mean())
    if 2 * agreeing <= count or ratio < ACCEPTANCE.min_ratio:
        raise unexplained_error(
            start.camera,
            f"its pictures change as the joints move ({evidence}), but {ratio:.0%} of the contours "
            f"fit, in {agreeing} of {count} frames: is it the model of another robot, or has a "
            "joint the other sign?",
        )
    deviations = np.sqrt(np.diag(best.covariance))
    pose = fit.camera_covariances(best.found, best.covariance)[0]
    found = RegisteredCamera(
        best.camera, pose, frame_misfits(posed, best.camera.X_CW, best.ratios, best.inliers),
        np.array([np.linalg.inv(X) for X in start.alternatives]).reshape(-1, 4, 4),
    )  # fmt: skip
    distance = float(np.linalg.norm(best.camera.X_WC[:3, 3] - posed.middle))
    # An offset that turns the camera about the robot may be unknown: relative to the parts that
    # move, the pose is known.
    values = np.array([one.values for one in posed.frames])
    shown = np.array([len(one.vertices) > 0 for one in posed.outlines])
    turning = joints_like_cameras(posed.kinematics, values, shown)
    rows, C = [fit.names.index(k) for k in turning if k in fit.names], best.covariance
    held = C - C[:, rows] @ np.linalg.inv(C[np.ix_(rows, rows)]) @ C[rows]
    one = replace(found, covariance=fit.camera_covariances(best.found, held)[0])
    if max(one.translation_sd / distance, one.rotation_sd) > SHARED.constant_deviation:
        raise unexplained_error(
            start.camera,
            f"the best, {distance:.1f} m away, has a standard deviation of "
            f"{1e3 * one.translation_sd:.0f} mm and {np.degrees(one.rotation_sd):.1f} degrees.",
        )
    focal_index = len(POSE_NAMES)
    if focal > SHARED.focal_deviation:
        by = best.covariance[:, focal_index] / best.covariance[focal_index, focal_index]
        covariance = best.covariance + ACCEPTANCE.guessed_lens_error**2 * np.outer(by, by)
        pose = fit.camera_covariances(best.found, covariance)[0]
        found, deviations = replace(found, covariance=pose), np.sqrt(np.diag(covariance))
    clock = None
    if TIME_OFFSET in fit.names:
        deviation = float(deviations[fit.names.index(TIME_OFFSET)])
        clock = replace(
            start.clock, deviation=deviation if deviation < ACCEPTANCE.max_clock_sd else np.inf
        )
    return PictureRegistration(
        found,
        tuple(replace(frame, values=frame.values - joint_offsets) for frame in posed.frames),
        {one.name: recording.picture(one.name) for one in posed.frames},
        best,
        clock,
        float(deviations[focal_index]) if focal else 0.0,
        recording,
        joint_offsets,
        evidence,
        start.runner_up,
    )


def unexplained_error(camera: PinholeCamera, why: str) -> RegistrationError:
    """Return the error for pictures that no pose explains; why: words in its message."""
    return RegistrationError(
        f"camera '{camera.name}': no pose explains its pictures: {why} Does the camera stand "
        "still, does the robot move much in its view, are the joint positions those at the "
        "pictures' times (no picture dropped or repeated), in the model's zeros and signs, and is "
        "the focal length about right? Nothing was written"
    )


def evaluate_pictures(
    body: RegistrationBody,
    one: PictureRegistration,
    found: RegisteredCamera,
    *,
    most: int = 300,
    at_once: int = 20,
    shown: float = 0.1,
    min_overlap: float = 0.9,
    around: float = 0.3,
) -> tuple[tuple[PosedFrame, ...], tuple[FrameMisfit, ...], tuple[str, ...]]:
    """Evaluate all pictures of a recording with a registered camera.

    Args:
        body: the robot's surfaces.
        one: the registration from some of them.
        found: the camera at its final pose.
        most, at_once: maximum number of pictures, evenly spaced, and of those in memory together.
        shown: minimum area of the body, as a fraction of the median of the fitted frames' masks;
            other pictures are skipped.
        min_overlap: a frame is an inlier, too, if its intersection over union is at least this
            fraction of the fit's median: dark and blurred contours fit badly even in correct poses.
        around: pictures are segmented up to this distance from the body [square root of its area].

    Returns the frames that show the body, with masks and logged values; the misfit of each; and the
    names of frames in which the body is not visible although it covers enough of the picture.
    """
    count = len(one.recording.names)
    rows = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
    least_area = shown * float(np.median([np.count_nonzero(k.mask) for k in one.frames]))
    overlaps = [frame.iou for frame in one.found.frames if frame.is_inlier]
    min_iou = min_overlap * float(np.median(overlaps))
    least = inlier_threshold(one.fit.ratios)
    known, camera = one.fit.background, found.camera
    outlines = simplify_or_hull(body.coarse, PICTURES.triangles[-1])
    offset = 0.0 if one.time_offset is None else one.time_offset.value

    def segment(posed: PosedPicture) -> tuple[str, PosedFrame | None] | None:
        covered = draw_mask(outlines, camera.X_CW @ body.kinematics.poses(posed.values), camera)
        if np.count_nonzero(covered) < least_area:
            return None
        gain = estimate_gain(posed.picture, known.colours)
        return posed.name, segment_picture(posed, known, gain, covered, around)

    frames, misfits, lost = list[PosedFrame](), list[FrameMisfit](), list[str]()
    for k in range(0, len(rows), at_once):
        pictures = posed_pictures(
            one.recording.with_offsets(one.joint_offsets), rows[k : k + at_once], offset
        )
        named = [each for each in map_ordered(segment, pictures) if each is not None]
        lost += [name for name, frame in named if frame is None]
        posed_frames = [frame for _, frame in named if frame is not None]
        if posed_frames:
            full = PosedFrames(body.kinematics, body.full, camera, posed_frames)
            fit = SharedFit([full], [camera.X_CW], fit_biases=False)
            ratios = fit.inlier_ratios(fit.start)
            misfits += [
                replace(each, is_inlier=each.is_inlier or each.iou >= min_iou)
                for each in frame_misfits(full, camera.X_CW, ratios, ratios >= least)
            ]
            # Log-odds are dropped to save memory.
            frames += [
                replace(frame, values=frame.values - one.joint_offsets, foreground=None, rates=None)
                for frame in posed_frames
            ]
    return tuple(frames), tuple(misfits), tuple(lost)
