"""Search a camera's pose in its pictures alone, without masks and without an initial guess.

The camera is static and the body's joint positions are known in each picture. A hypothesis X_CW
therefore implies in which frames the body covers each pixel, and the pixels' colours score it
(``fit.background``). Starts are rotations over the whole sphere, and more near upright, with the
body where pictures change. The best are improved coarse-to-fine on an image pyramid, and finally
fitted on search lines across the contour in the pixels' foreground log-odds.
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
from drake_pose.registration.offset_search import joints_like_cameras, search_offsets
from drake_pose.registration.posed_frames import PosedFrame, PosedFrames
from drake_pose.registration.pyramid_level import PICTURES, PyramidLevel, evidence
from drake_pose.registration.register import RegistrationBody
from drake_pose.registration.shared_fit import SharedFit, SharedValues
from drake_pose.silhouette.outline import EMPTY_OUTLINE, Outline
from drake_pose.silhouette.scoring import draw_mask
from drake_pose.workers import map_ordered


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """One picture of a body at known joint positions.

    Args:
        name: of the frame.
        values: (m,) values of the body's pose tree [rad or m].
        picture: (H, W, 3) uint8 red, green, blue.
        rates: (m,) velocities of the values [rad/s or m/s]; None: unknown.
    """

    name: str
    values: Array
    picture: Picture
    rates: Array | None = None


@dataclass(frozen=True, eq=False)
class PictureFit:
    """A camera fitted to pictures.

    Args:
        fit: the fit of frames with foreground log-odds, and masks derived from these.
        found: the fitted values of its u shared unknowns.
        background: the estimated background, which segments further pictures.
        explained: explained fraction of the log-likelihood gain that is possible at most.
        contour: mean strength of edges along the outlines, beyond that of random lines.
    """

    fit: SharedFit
    found: SharedValues
    background: KnownBackground
    explained: float
    contour: float

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
        """Covariance (u, u) of the shared unknowns."""
        return np.asarray(np.sum(self.fit.covariances(self.found, self.inliers), axis=0))


class RoughPose(NamedTuple):
    """A camera fitted roughly to pictures.

    Attributes:
        search: the search in these pictures.
        camera: at its pose, with the pictures' original size.
        explained, contour: as of ``PictureFit``.
        ratios: inlier ratios by frame.
    """

    search: "PictureSearch"
    camera: PinholeCamera
    explained: float
    contour: float
    ratios: Mapping[str, float]


def ratio_margin(
    ratios: Mapping[str, float], others: Mapping[str, float], floor: float = 0.02
) -> float:
    """Return by how much more of the contours fits at one pose than at another [sd].

    The scatter of the differences in the same frames gives the standard deviation of their mean.

    Args:
        ratios, others: inlier ratios by frame, at the one pose and at the other.
        floor: added to this deviation, as fits to one pose from different starts differ by as much.
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
    shown = [k for k, one in enumerate(body.coarse) if len(one.vertices)]
    X_WN = np.array([body.kinematics.poses(one)[shown] for one in values])
    middles = np.array([body.coarse[k].ball[:3] for k in shown])
    return np.asarray(np.einsum("fnij,nj->fni", X_WN[..., :3, :3], middles) + X_WN[..., :3, 3])


def choose_frames(places: Array, count: int) -> list[int]:
    """Return the indices of the most dissimilar frames, by farthest point sampling.

    The frame farthest from the mean comes first.

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
        camera: the camera; its pose is not used.
        frames: f pictures, the most dissimilar first.
        riding: whether the body rides along with the camera, which moves; the "world" is then the
            body's root, and its colours are repeated while those around it change.
    """

    def __init__(
        self,
        body: RegistrationBody,
        camera: PinholeCamera,
        frames: Sequence[PosedPicture],
        riding: bool = False,
    ) -> None:
        self._body, self.camera, self.frames = body, camera, tuple(frames)
        self._riding = riding
        coarse, *finer = (simplify_or_hull(body.coarse, count) for count in PICTURES.triangles)
        # Small parts are invisible at the coarsest level.
        least = 0.25 * max(one.ball[3] for one in coarse)
        coarse = tuple(one if one.ball[3] >= least else EMPTY_OUTLINE for one in coarse)
        # A body that rides along is near: its shape shows in small pictures, too.
        self._outlines = (body.medium,) * 3 if riding else (coarse, *finer)
        self._X_WN = self.nodes_at(np.array([one.values for one in frames]))
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
                hypotheses, the number of evaluations for each, and the first step's rotation [rad].
            rotations: number of rotations over the sphere, and again near upright.
            least_width: minimum width of the pictures in all rounds [pixel].
            others: number of hypotheses after the first round, rotated from the best by `apart` or
                more [rad], that are improved again; two of these are the last ones returned.
            apart: as above.
        """
        level = self._level(max(rounds[0][0], least_width))
        found = level.starts(rotations)
        # The most dissimilar frames select some of the starts.
        first = ((2, 0.12), (4, 0.3)) if self._riding else ((4, 0.25),)
        for frames, fraction in (*first, (len(self.frames), 1.0)):
            found = level.best(found, frames, fraction)
        after = (*(kept for _, kept, _, _ in rounds[1:]), rounds[-1][1])
        every = list[list[Array]]()
        for (width, kept, evaluations, turn), most in zip(rounds, after, strict=True):
            level = self._level(max(width, least_width))
            every.append(level.improve(found[:kept], evaluations, turn)[1])
            found = level.distinct(every[-1], most)
        far = [one for one in every[0] if rotation_between(one, found[0]) >= apart][:others]
        for width, _, evaluations, turn in rounds[-2:] if far else ():
            level = self._level(max(width, least_width))
            far = level.distinct(level.improve(far, evaluations, turn)[1], 2)
        return [*found, *far]

    def with_offsets(self, joint_offsets: Array) -> "PictureSearch":
        """Return the same search with offsets (m,) [rad or m] added to all frames' values."""
        frames = tuple(replace(one, values=one.values + joint_offsets) for one in self.frames)
        other = self.with_frames(frames)
        other.joint_offsets = self.joint_offsets + joint_offsets
        return other

    def with_camera(self, camera: PinholeCamera) -> "PictureSearch":
        """Return the same search with another lens of the camera; its backgrounds stay."""
        return self._copy(lambda level: level.with_camera(camera), camera=camera)

    def mirrored(self) -> "PictureSearch":
        """Return the search in the mirrored pictures, whose backgrounds are mirrored, too."""
        frames = tuple(
            replace(one, picture=np.ascontiguousarray(one.picture[:, ::-1])) for one in self.frames
        )
        return self._copy(PyramidLevel.mirrored, camera=self.camera.mirrored(), frames=frames)

    def with_frames(self, frames: Sequence[PosedPicture]) -> "PictureSearch":
        """Return the same search in other frames, with values without offsets.

        If they are the same pictures with other values, their backgrounds stay.
        """
        X_WN = self.nodes_at(np.array([one.values for one in frames]))
        other = self._copy(
            lambda level: level.with_poses(X_WN[: len(level.backgrounds.pictures)]),
            frames=tuple(frames),
            _X_WN=X_WN,
            joint_offsets=np.zeros_like(self.joint_offsets),
        )
        if [one.name for one in frames] != [one.name for one in self.frames]:
            other._levels = {}
        return other

    def silhouettes(self, camera: PinholeCamera, shift: int = 0) -> Mask:
        """Return the body's silhouettes (f, H, W) in all frames, in pictures of a camera's size.

        Args:
            camera: at its pose.
            shift: each frame gets the values of the one this number of places ahead.
        """
        poses = camera.X_CW @ np.roll(self._X_WN, -shift, axis=0)
        return np.array(map_ordered(lambda X: draw_mask(self._outlines[-1], X, camera), poses))

    def nodes_at(self, values: Array) -> Array:
        """Return the nodes' poses X_WN (f, nodes, 4, 4) at values (f, m) of the pose tree."""
        return np.array([self._body.kinematics.poses(one) for one in values])

    def _copy(
        self, level: Callable[[PyramidLevel], PyramidLevel], **changes: Any
    ) -> "PictureSearch":
        """Return the search with other attributes, and with other levels made from its own."""
        other = copy.copy(self)
        other.__dict__.pop("_small", None)
        other.__dict__.update(changes)
        other._levels = {width: level(one) for width, one in self._levels.items()}
        return other

    def with_shifted_pictures(self) -> "PictureSearch":
        """Return a search in the same pictures, shifted by half their size with wrap-around."""
        height, width = self.camera.height // 2, self.camera.width // 2
        frames = [
            replace(one, picture=np.roll(one.picture, (height, width), axis=(0, 1)))
            for one in self.frames
        ]
        return PictureSearch(self._body, self.camera, frames, self._riding)

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
            joints: names of the joints with an offset. Those whose offset looks like a rotation of
                the camera, and those that slide, keep 0.
            X_CW: (4, 4) pose from which the search starts.
            widths: of the pictures in which scores are compared [pixel], one search after another.
            scales: of the fit's stages [pixel of a picture 320 wide]. Frames are segmented again
                before each sequence.

        Returns:
            the same search with the offsets added to its frames' values, and the pose (4, 4).
        """
        kinematics = self._body.kinematics
        values = np.array([one.values for one in self.frames])
        shown = np.array([len(one.vertices) > 0 for one in self._body.coarse])
        held = joints_like_cameras(kinematics, values, shown)
        rows = [
            k
            for k, name in enumerate(kinematics.names)
            if name in joints and name not in held and kinematics.is_angle[k]
        ]
        sought = [kinematics.names[k] for k in rows]
        offsets = np.zeros(len(kinematics.names))

        def poses(count: int, by: Array) -> Array:
            return np.array([kinematics.poses(one + by) for one in values[:count]])

        for k, width in enumerate(widths):
            level = self._level(width)
            some = partial(poses, len(level.backgrounds.pictures))
            X_CW, offsets = search_offsets(
                level, some, X_CW, offsets, rows, sweeps=2 if k == 0 else 0
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
            found = fit.fit(_stages(sequence, posed))
            offsets = offsets.copy()
            offsets[rows] += found.shared[fit.per_camera :]
            tried = self.with_offsets(offsets), fit.cameras(found)[0].X_CW
            if evidence(*tried[0].compared.explained(tried[1])) <= evidence(
                *best[0].compared.explained(best[1])
            ):
                break
            best = tried
        return best

    def coarse_fit(self, X_CW: Array) -> "RoughPose | None":
        """Fit a camera roughly from a pose X_CW (4, 4); None: the body leaves the pictures."""
        frames, small = self._small
        stages = ((*(12.0,) * 4, *(8.0,) * 4, *(5.0,) * 4), (*(6.0,) * 3, *(4.0,) * 3))
        for scales in stages:
            camera = small.with_pose(np.linalg.inv(X_CW))
            known, covered = self._learn(camera, frames)
            posed = self._segment(camera, frames, known, covered, self._outlines[-1])
            if posed is None:
                return None
            fit = SharedFit([posed], [X_CW], fit_biases=False)
            found = fit.fit(_stages(scales, posed))
            X_CW = fit.cameras(found)[0].X_CW
        assert posed is not None
        ratios = zip(posed.frames, fit.inlier_ratios(found).tolist(), strict=True)
        return RoughPose(
            self, self.camera.with_pose(np.linalg.inv(X_CW)), *self.compared.explained(X_CW),
            {frame.name: ratio for frame, ratio in ratios},
        )  # fmt: skip

    def fit(
        self, camera: PinholeCamera, constants: Sequence[str] = (), focal: float = 0.0
    ) -> PictureFit | None:
        """Fit a camera from near its pose, on search lines across the contours.

        Args:
            camera: at the start's pose, with the pictures' original size.
            constants: names of further unknowns shared by all frames, such as joints with an
                offset, or TIME_OFFSET; see ``SharedFit``.
            focal: prior standard deviation of the focal length's logarithm; 0: it is not fitted.

        Returns:
            the fit; None if the body leaves the pictures.
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
        """Prior means of offsets that are added to the frames' values, by name [rad or m]."""
        return dict(zip(self._body.kinematics.names, -self.joint_offsets, strict=True))

    @cached_property
    def _small(self) -> tuple[list[PosedPicture], PinholeCamera]:
        """The frames at the size in which backgrounds are estimated, and a camera of that size."""
        camera = self._level(PICTURES.background_width).camera
        size = camera.width, camera.height
        return [
            replace(
                one,
                picture=np.asarray(
                    cv2.resize(one.picture, size, interpolation=cv2.INTER_AREA), np.uint8
                ),
            )
            for one in self.frames
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
        pictures = [one.picture for one in frames]
        known = level.backgrounds.known(
            pictures, covered, covered if same else self.silhouettes(small)
        )
        return known, covered

    def _segment(
        self,
        camera: PinholeCamera,
        frames: Sequence[PosedPicture],
        known: KnownBackground,
        covered: Mask,
        outlines: Sequence[Outline],
    ) -> PosedFrames | None:
        """Return the frames that show the body with masks; None if these are fewer than two.

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

        posed = [one for one in map_ordered(segment, range(len(frames))) if one is not None]
        if len(posed) < 2:
            return None
        return PosedFrames(self._body.kinematics, outlines, camera, posed)

    def _level(self, width: int) -> PyramidLevel:
        """Return the pyramid level of a width [pixel], made when it is first used."""
        if width not in self._levels:
            k = (width > 64) + (width > 120)
            count = PICTURES.search_frames if width < PICTURES.compare_width else len(self.frames)
            pictures = [one.picture for one in self.frames[:count]]
            self._levels[width] = PyramidLevel(
                self._outlines[k],
                self.camera,
                pictures,
                self._X_WN[:count],
                width,
                self._riding,
            )
        return self._levels[width]


def _stages(scales: Sequence[float], posed: PosedFrames) -> list[AnnealingStage]:
    """Return stages of single steps at scales [pixel of a picture 320 wide].

    posed: the frames that are fitted, whose size converts the scales.

    Search lines are half a scale apart. Their costs are not comparable between poses, so each step
    is taken untried.
    """
    sizes = np.array(scales) * posed.camera.width / 320.0 / posed.size
    return [AnnealingStage(one, 0.5 * one) for one in sizes.tolist()]


def segment_picture(
    one: PosedPicture,
    known: KnownBackground,
    gain: Floats,
    covered: Mask,
    around: float | None = None,
) -> PosedFrame | None:
    """Return the frame of a picture with log-odds and a mask; None where no body is visible.

    Args:
        one: the picture, with values and rates that the frame takes over.
        known: the background.
        gain: (3, 4) slopes and offset that map the picture's colours to the background's.
        covered: (H, W) the pixels that the body covers approximately.
        around: log-odds farther from the body are 0 [square root of its area]; None: none are.
    """
    if not covered.any():
        return None
    part = slice(None), slice(None)
    if around is not None:
        part = window_around(covered, round(around * float(np.sqrt(np.count_nonzero(covered)))))
    foreground, mask = np.zeros(covered.shape, np.float32), np.zeros(covered.shape, np.bool_)
    # The mask is smoothed over a few pixels.
    window = window_around(covered[part], mask_reach(covered) + 8)
    as_is, tolerant = known.part(part).foreground(one.picture[part], gain, window)
    foreground[part] = tolerant
    mask[part][window] = mask_of_foreground(as_is, covered[part][window], tolerant[window])
    if not mask.any():
        return None
    return PosedFrame(one.name, one.values, mask, foreground_picture(foreground), one.rates)
