"""Search a camera's pose in its pictures alone, without masks and without an initial guess.

The camera is static and the body's joint positions are known in each picture. A pose hypothesis
X_CW therefore implies in which frames the body covers each pixel, and the pixels' colours score the
hypothesis (``fit.background``). A search starts from rotations over the whole sphere, and from more
near upright, with the body where pictures change. The best poses are improved coarse-to-fine on an
image pyramid, and finally fitted on search lines across the contour in the foreground log-odds.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import cv2
import numpy as np

from drake_pose.arrays import Array, Floats, Mask, Picture
from drake_pose.camera.models import PinholeCamera
from drake_pose.fit.background import (
    KnownBackground,
    foreground_picture,
    mask_of_foreground,
    mask_reach,
    window_around,
)
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import POSE_NAMES
from drake_pose.fit.surfaces import simplify_or_hull
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames, joints_like_cameras
from drake_pose.registration.pyramid_level import PICTURES, PyramidLevel, evidence, search_offsets
from drake_pose.registration.register import RegistrationBody
from drake_pose.registration.shared_fit import SharedFit, SharedValues
from drake_pose.silhouette.outline import EMPTY_OUTLINE, Outline
from drake_pose.silhouette.scoring import draw_mask
from drake_pose.workers import map_ordered


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """One picture of a body at known joint positions."""

    name: str  # Of the frame.
    values: Array  # (m,) values of the body's pose tree [rad or m].
    picture: Picture  # (H, W, 3) uint8 RGB.
    rates: Array | None = None  # (m,) velocities of the values [rad/s or m/s]; None: unknown.


@dataclass(frozen=True, eq=False)
class PictureFit:
    """A camera fitted to pictures."""

    fit: SharedFit  # The fit of frames with foreground log-odds, and masks derived from these.
    found: SharedValues  # The fitted values of the fit's u shared unknowns.
    background: KnownBackground  # The estimated background, which segments further pictures.
    explained: float  # Log-likelihood gain of the pose over the largest possible gain.
    contour: float  # Mean strength of edges along the outlines, minus that along random lines.

    @property
    def camera(self) -> PinholeCamera:
        """The camera at its fitted pose."""
        return self.fit.cameras(self.found)[0]

    @cached_property
    def ratios(self) -> Array:
        """Inlier ratios (frames,)."""
        return self.fit.inlier_ratios(self.found)

    @cached_property
    def inliers(self) -> Mask:
        """Which frames (frames,) are inliers."""
        return self.fit.inliers(self.ratios)

    @cached_property
    def covariance(self) -> Array:
        """Covariance (u, u) of the shared unknowns, see ``SharedFit``."""
        return np.asarray(np.sum(self.fit.covariances(self.found, self.inliers), axis=0))


class RoughPose(NamedTuple):
    """A camera fitted roughly to pictures."""

    search: "PictureSearch"  # The search in the pictures.
    camera: PinholeCamera  # At its pose, with the pictures' original size.
    explained: float  # As of ``PictureFit``.
    ratios: Mapping[str, float]  # Inlier ratios by frame name.

    @property
    def agreement(self) -> float:
        """The explained fraction plus the mean inlier ratio.

        A wrong pose may explain more than the right one, or lie along stronger edges; then fewer of
        its contours fit. In 20 drawn rooms and DROID's episodes the agreement of right poses was
        0.85 to 1.4, and that of wrong ones beside them lower by 0.14 to 1.
        """
        return self.explained + float(np.mean([*self.ratios.values()]))


def ratio_margin(
    ratios: Mapping[str, float], others: Mapping[str, float], floor: float = 0.02
) -> float:
    """Return how much larger the inlier ratios are at one pose than at another [sd].

    The mean of the differences is divided by its standard deviation, estimated from their scatter
    over frames. With fewer than two common frames the result is 0.

    Args:
        ratios, others: inlier ratios by frame name, at the first pose and at the other.
        floor: added in quadrature to the standard deviation; fits to one pose from different starts
            differ by as much.
    """
    more = np.array([ratios[name] - others[name] for name in ratios if name in others])
    if len(more) < 2:
        return 0.0
    return float(more.mean() / np.hypot(more.std(ddof=1) / np.sqrt(len(more)), floor))


def rotation_between(X_CW: Array, other: Array) -> float:
    """Return the angle between the rotations of two poses (4, 4) [rad]."""
    cosine = 0.5 * (np.einsum("ij,ij", X_CW[:3, :3], other[:3, :3]) - 1.0)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def node_places(body: RegistrationBody, values: Array) -> Array:
    """Return the centres (f, n, 3) of the body's n visible nodes in the world [m].

    values: (f, m) values of the body's pose tree in f frames.
    """
    shown = [k for k, outline in enumerate(body.coarse) if len(outline.vertices)]
    X_WN = np.array([body.kinematics.poses(row)[shown] for row in values])
    middles = np.array([body.coarse[k].ball[:3] for k in shown])
    return np.asarray(np.einsum("fnij,nj->fni", X_WN[..., :3, :3], middles) + X_WN[..., :3, 3])


def choose_frames(places: Array, count: int) -> list[int]:
    """Return the indices of dissimilar frames, by farthest point sampling from the mean.

    places: (f, n, 3), see ``node_places``. count: maximum number of frames.
    """

    def off(other: Array) -> Array:
        """Return the mean distance (f,) of each frame's nodes from other places (n, 3) [m]."""
        return np.asarray(np.linalg.norm(places - other, axis=2).mean(axis=1))

    chosen = [int(np.argmax(off(places.mean(axis=0))))]
    nearest = off(places[chosen[0]])
    while len(chosen) < min(count, len(places)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, off(places[chosen[-1]]))
    return chosen


class PictureSearch:
    """Searches a camera's pose in some of its pictures.

    Attributes:
        joint_offsets: (m,) offsets that the frames' values include [rad or m], see `with_offsets`.

    Args:
        body: the robot's surfaces.
        camera: its intrinsics; its pose is not used.
        frames: f pictures, the most dissimilar first.
    """

    def __init__(
        self, body: RegistrationBody, camera: PinholeCamera, frames: Sequence[PosedPicture]
    ) -> None:
        self._body, self.camera, self.frames = body, camera, tuple(frames)
        coarse, *finer = (simplify_or_hull(body.coarse, count) for count in PICTURES.triangles)
        # Small parts are invisible at the coarsest level.
        least = 0.25 * max(node.ball[3] for node in coarse)
        coarse = tuple(node if node.ball[3] >= least else EMPTY_OUTLINE for node in coarse)
        self._outlines = (coarse, *finer)
        self._X_WN = self.nodes_at(np.array([frame.values for frame in frames]))
        self._levels = dict[int, PyramidLevel]()
        self.joint_offsets = np.zeros(len(body.kinematics.names))

    @property
    def compared(self) -> PyramidLevel:
        """The pyramid level in which poses are compared."""
        return self._level(PICTURES.compare_width)

    def search(
        self,
        rounds: Sequence[tuple[int, int, int, float]] = (
            (64, 250, 24, 0.25),
            (64, 80, 30, 0.15),
            (80, 30, 50, 0.1),
            (160, 10, 80, 0.06),
        ),
        rotations: int = 1200,
        least_width: int = 0,
        others: int = 8,
        apart: float = 1.0,
    ) -> list[Array]:
        """Return pose hypotheses X_CW (4, 4), best first.

        Args:
            rounds: for each round of local search the width of the pictures [pixel], the number of
                hypotheses, the number of scores for each, and the first simplex's size [rad].
            rotations: as of ``PyramidLevel.starts``.
            least_width: minimum width of the pictures in all rounds [pixel].
            others: maximum number of hypotheses of the first round, far from the best, that are
                improved separately. The best two far ones are returned last.
            apart: minimum rotation between these and the best hypothesis [rad].
        """
        level = self._level(max(rounds[0][0], least_width))
        poses = level.starts(rotations)
        # A few frames, the most dissimilar, select starts for the scores in all frames.
        for frames, fraction in ((4, 0.25), (len(self.frames), 1.0)):
            poses = level.best(poses, frames, fraction)
        after = (*(kept for _, kept, _, _ in rounds[1:]), rounds[-1][1])
        improved = list[list[Array]]()
        for (width, kept, evaluations, turn), most in zip(rounds, after, strict=True):
            level = self._level(max(width, least_width))
            improved.append(level.improve(poses[:kept], evaluations, turn)[1])
            poses = level.distinct(improved[-1], most)
        far = [X for X in improved[0] if rotation_between(X, poses[0]) >= apart][:others]
        for width, _, evaluations, turn in rounds[-2:] if far else ():
            level = self._level(max(width, least_width))
            far = level.distinct(level.improve(far, evaluations, turn)[1], 2)
        return [*poses, *far]

    def with_offsets(self, joint_offsets: Array) -> "PictureSearch":
        """Return the same search with offsets (m,) [rad or m] added to all frames' values."""
        frames = tuple(replace(k, values=k.values + joint_offsets) for k in self.frames)
        other = self.with_frames(frames)
        other.joint_offsets = self.joint_offsets + joint_offsets
        return other

    def with_camera(self, camera: PinholeCamera) -> "PictureSearch":
        """Return the same search, backgrounds included, with the intrinsics of `camera`."""
        return self._copy(lambda level: level.with_camera(camera), camera=camera)

    def mirrored(self) -> "PictureSearch":
        """Return the search in the mirrored pictures, with mirrored backgrounds."""
        frames = tuple(
            replace(k, picture=np.ascontiguousarray(k.picture[:, ::-1])) for k in self.frames
        )
        return self._copy(PyramidLevel.mirrored, camera=self.camera.mirrored(), frames=frames)

    def with_frames(self, frames: Sequence[PosedPicture]) -> "PictureSearch":
        """Return the same search in other frames, and with `joint_offsets` of 0.

        Frames of the same names are the same pictures with other values: backgrounds are kept.
        """
        X_WN = self.nodes_at(np.array([frame.values for frame in frames]))
        other = self._copy(
            lambda level: level.with_poses(X_WN[: len(level.backgrounds.pictures)]),
            frames=tuple(frames),
            _X_WN=X_WN,
            joint_offsets=np.zeros_like(self.joint_offsets),
        )
        if [frame.name for frame in frames] != [frame.name for frame in self.frames]:
            other._levels = {}
        return other

    def silhouettes(self, camera: PinholeCamera) -> Mask:
        """Return the body's silhouettes (f, H, W) in all frames.

        camera: at its pose, with pictures of H x W pixels.
        """
        poses = camera.X_CW @ self._X_WN
        return np.array(map_ordered(lambda X: draw_mask(self._outlines[-1], X, camera), poses))

    def nodes_at(self, values: Array) -> Array:
        """Return the nodes' poses X_WN (f, nodes, 4, 4) at values (f, m) of the pose tree."""
        return np.array([self._body.kinematics.poses(row) for row in values])

    def _copy(
        self, level: Callable[[PyramidLevel], PyramidLevel], **changes: Any
    ) -> "PictureSearch":
        """Return a copy with changed attributes; `level` converts each of the known levels."""
        other = copy.copy(self)
        other.__dict__.pop("_small", None)
        other.__dict__.update(changes)
        other._levels = {width: level(known) for width, known in self._levels.items()}
        return other

    def fit_offsets(
        self,
        joints: Sequence[str],
        X_CW: Array,
        *,
        widths: Sequence[int] = (80, 160),
        scales: Sequence[Sequence[float]] = (
            (*(12.0,) * 3, *(8.0,) * 4, *(5.0,) * 4),
            (*(8.0,) * 3, *(5.0,) * 4, *(3.0,) * 3),
        ),
    ) -> tuple["PictureSearch", Array]:
        """Find joint offsets together with a camera's pose, roughly.

        The offsets are searched by their scores (``search_offsets``), then fitted to contours.

        Args:
            joints: names of the joints with an offset. Sliding joints, and joints whose offset
                looks like a rotation of the camera, keep an offset of 0.
            X_CW: (4, 4) pose from which the search starts.
            widths: width of the pictures in each successive search [pixel].
            scales: for each successive fit the scales of its stages [pixel of a picture 320 wide].
                Frames are segmented again before each fit.

        Returns the search with the offsets added to its frames' values, and the pose X_CW (4, 4).
        """
        kinematics = self._body.kinematics
        values = np.array([frame.values for frame in self.frames])
        shown = np.array([len(outline.vertices) > 0 for outline in self._body.coarse])
        held = joints_like_cameras(kinematics, values, shown)
        rows = [
            k
            for k, name in enumerate(kinematics.names)
            if name in joints and name not in held and kinematics.is_angle[k]
        ]
        sought = [kinematics.names[k] for k in rows]
        offsets = np.zeros(len(kinematics.names))

        def poses(count: int, added: Array) -> Array:
            return np.array([kinematics.poses(row + added) for row in values[:count]])

        for k, width in enumerate(widths):
            level = self._level(width)
            nodes = partial(poses, len(level.backgrounds.pictures))
            X_CW, offsets = search_offsets(
                level, nodes, X_CW, offsets, rows, sweeps=2 if k == 0 else 0
            )
        best = self.with_offsets(offsets), X_CW
        for sequence in scales:
            search, X = best[0], best[1]
            frames, small = search._small
            camera = small.with_pose(np.linalg.inv(X))
            posed = search._segment(
                camera, frames, *search._learn(camera, frames), self._outlines[-1]
            )
            if posed is None:
                break
            fit = SharedFit([posed], [X], sought, fit_biases=False, expected=search._expected)
            fitted = fit.fit(_stages(sequence, posed))
            offsets = offsets.copy()
            offsets[rows] += fitted.shared[fit.per_camera :]
            tried = self.with_offsets(offsets), fit.cameras(fitted)[0].X_CW
            if evidence(*tried[0].compared.explained(tried[1])) <= evidence(
                *best[0].compared.explained(best[1])
            ):
                break
            best = tried
        return best

    def coarse_fit(self, X_CW: Array) -> "RoughPose | None":
        """Fit a camera roughly from X_CW (4, 4); None: fewer than two frames show the body."""
        frames, small = self._small
        stages = ((*(12.0,) * 4, *(8.0,) * 4, *(5.0,) * 4), (*(6.0,) * 3, *(4.0,) * 3))
        for scales in stages:
            camera = small.with_pose(np.linalg.inv(X_CW))
            known, covered = self._learn(camera, frames)
            posed = self._segment(camera, frames, known, covered, self._outlines[-1])
            if posed is None:
                return None
            fit = SharedFit([posed], [X_CW], fit_biases=False)
            fitted = fit.fit(_stages(scales, posed))
            X_CW = fit.cameras(fitted)[0].X_CW
        assert posed is not None
        ratios = zip(posed.frames, fit.inlier_ratios(fitted).tolist(), strict=True)
        camera, explained = (
            self.camera.with_pose(np.linalg.inv(X_CW)),
            self.compared.explained(X_CW),
        )
        return RoughPose(self, camera, explained[0], {frame.name: ratio for frame, ratio in ratios})

    def fit(
        self, camera: PinholeCamera, constants: Sequence[str], focal: float
    ) -> PictureFit | None:
        """Fit a camera from near its pose, on search lines across the contours.

        Args:
            camera: at the start's pose, with the pictures' original size.
            constants: names of further unknowns shared by all frames, such as joints with an
                offset, or TIME_OFFSET; see ``SharedFit``.
            focal: prior standard deviation of the focal length's logarithm; 0: it is not fitted.

        Returns the fit; None if fewer than two frames show the body.
        """
        lens: dict[str, Any] = {}
        if focal:
            lens = {"camera_unknowns": len(POSE_NAMES) + 1, "focal_deviation": focal}
        posed = None
        # The background is estimated again before each sequence of stages.
        for scales, outlines in (
            ((*(5.0,) * 4, *(3.0,) * 4), self._outlines[-1]),
            ((*(3.0,) * 2, *(2.0,) * 3, *(1.0,) * 3), self._body.medium),
        ):
            known, covered = self._learn(camera, self.frames)
            posed = self._segment(camera, self.frames, known, covered, outlines)
            if posed is None:
                return None
            fit = SharedFit(
                [posed], [camera.X_CW], constants, fit_biases=False, expected=self._expected, **lens
            )
            included = fit.inliers(fit.inlier_ratios(fit.start))
            found = fit.fit(_stages(scales, posed), included=included)
            camera = fit.cameras(found)[0]
        assert posed is not None
        full = PosedFrames(self._body.kinematics, self._body.full, camera, posed.frames)
        fit = SharedFit([full], [camera.X_CW], constants, expected=self._expected, **lens)
        # The new fit starts at the camera's fitted pose; only the constants keep their values.
        constant = np.arange(len(fit.names)) >= fit.per_camera
        found = fit.start._replace(shared=np.where(constant, found.shared, 0.0))
        included = fit.inliers(fit.inlier_ratios(found))
        found = fit.fit(_stages((0.75,) * 7, full), found, included)
        camera = fit.cameras(found)[0]
        return PictureFit(fit, found, known, *self.compared.explained(camera.X_CW))

    @property
    def _expected(self) -> dict[str, float]:
        """Prior means of further joint offsets, by name; they undo `joint_offsets` [rad or m]."""
        return dict(zip(self._body.kinematics.names, -self.joint_offsets, strict=True))

    @cached_property
    def _small(self) -> tuple[list[PosedPicture], PinholeCamera]:
        """The frames in the size in which backgrounds are estimated, and a camera of this size."""
        camera = self._level(PICTURES.background_width).camera
        size = camera.width, camera.height
        small = [cv2.resize(k.picture, size, interpolation=cv2.INTER_AREA) for k in self.frames]
        return [
            replace(frame, picture=np.asarray(picture, np.uint8))
            for frame, picture in zip(self.frames, small, strict=True)
        ], camera

    def _learn(
        self, camera: PinholeCamera, frames: Sequence[PosedPicture]
    ) -> tuple[KnownBackground, Mask]:
        """Return the background behind the body, and the pixels (f, H, W) that the body covers.

        Args:
            camera: at the pose from which the covered pixels follow.
            frames: all frames, in pictures of the camera's size H x W.
        """
        level = self._level(PICTURES.background_width)
        small = camera.resized(level.camera.width, level.camera.height)
        covered = self.silhouettes(camera)
        same = small.width == camera.width
        showing = level.backgrounds.shows_background(covered if same else self.silhouettes(small))
        pictures = [frame.picture for frame in frames]
        known = KnownBackground.estimate(pictures, level.backgrounds.gains, showing, covered)
        return known, covered

    def _segment(
        self,
        camera: PinholeCamera,
        frames: Sequence[PosedPicture],
        known: KnownBackground,
        covered: Mask,
        outlines: Sequence[Outline],
    ) -> PosedFrames | None:
        """Segment all frames, and return those that show the body; None: fewer than two do.

        Args:
            camera: the camera, with pictures of the frames' size H x W.
            frames: all frames.
            known: the background.
            covered: (f, H, W) the pixels that the body covers approximately.
            outlines: a surface for each node, for later fits.
        """
        gains = self._level(PICTURES.background_width).backgrounds.gains

        def segment(k: int) -> PosedFrame | None:
            return segment_picture(frames[k], known, gains[k], covered[k])

        segmented = map_ordered(segment, range(len(frames)))
        posed = [frame for frame in segmented if frame is not None]
        if len(posed) < 2:
            return None
        return PosedFrames(self._body.kinematics, outlines, camera, posed)

    def _level(self, width: int) -> PyramidLevel:
        """Return the pyramid level of a width [pixel], made when it is first used."""
        if width not in self._levels:
            k = (width > 64) + (width > 120)
            count = PICTURES.search_frames if width < PICTURES.compare_width else len(self.frames)
            pictures = [frame.picture for frame in self.frames[:count]]
            self._levels[width] = PyramidLevel(
                self._outlines[k], self.camera, pictures, self._X_WN[:count], width,
            )  # fmt: skip
        return self._levels[width]


def _stages(scales: Sequence[float], posed: PosedFrames) -> list[AnnealingStage]:
    """Return stages of one step each, with search lines half a scale apart.

    The search lines' costs are not comparable between poses: each step is taken without a test.

    scales: [pixel of a picture 320 wide]. posed: the frames that are fitted.
    """
    sizes = np.array(scales) * posed.camera.width / 320.0 / posed.size
    return [AnnealingStage(scale, 0.5 * scale) for scale in sizes.tolist()]


def segment_picture(
    one: PosedPicture,
    known: KnownBackground,
    gain: Floats,
    covered: Mask,
    around: float | None = None,
) -> PosedFrame | None:
    """Segment a picture into log-odds and a mask; None: no body is visible in it.

    Args:
        one: the picture; the returned frame has its name, values and rates.
        known: the background.
        gain: (3, 4) slopes and offset that map the picture's colours to the background's.
        covered: (H, W) the pixels that the body covers approximately.
        around: log-odds farther than this from `covered` are 0 [square root of its area]; None: all
            log-odds are computed.
    """
    if not covered.any():
        return None
    part = slice(None), slice(None)
    if around is not None:
        part = window_around(covered, round(around * float(np.sqrt(np.count_nonzero(covered)))))
    foreground, mask = np.zeros(covered.shape, np.float32), np.zeros(covered.shape, np.bool_)
    # The window is wider than the mask's reach by the pixels over which the mask is smoothed.
    window = window_around(covered[part], mask_reach(covered) + 8)
    as_is, tolerant = known.part(part).foreground(one.picture[part], gain, window)
    foreground[part] = tolerant
    mask[part][window] = mask_of_foreground(as_is, covered[part][window], tolerant[window])
    if not mask.any():
        return None
    return PosedFrame(one.name, one.values, mask, foreground_picture(foreground), one.rates)
