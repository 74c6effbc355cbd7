"""Detection of faults of cameras: moved ones, mirrored or exchanged pictures, a wrong scale.

Each camera's silhouettes are compared with the pose that all other cameras determine. A camera has
moved where one rigid motion of it explains many frames; errors of poor masks vary between frames.

The visual hull of consistent cameras fills all silhouettes (silhouette coherence, Hernandez,
Schmitt and Cipolla 2007): pictures are mirrored or exchanged if undoing that makes the hull fill
them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.camera.models import Camera
from drake_pose.errors import CameraError, MaskError, SettingsError
from drake_pose.fit.contour_fit import ContourFit, Prior, pack_views
from drake_pose.fit.evidence import EdgePoints, Observation, pack_evidence
from drake_pose.fit.levenberg_marquardt import AnnealingStage, StepSettings
from drake_pose.fit.parameters import POSE_NAMES
from drake_pose.fit.problem import Problem, Unknowns
from drake_pose.person.figures import PersonRecording, find_figures, pixels_per_metre
from drake_pose.person.views import triangulate, viewing_rays


class FaultSettings(NamedTuple):
    """Thresholds for a camera to be at fault.

    Args:
        scales: at which a camera's motion is fitted [m].
        max_misfit: leaving the camera out must lower the others' misfit to this fraction.
        similar_misfit: cameras are suspected, too, whose misfit is at most this factor above the
            lowest.
        min_metres, min_pixels: least displacement at the person [m] and in the picture [pixel]: a
            surface is known to 2 cm, and an edge to a pixel.
        explained_ratio: a motion explains a camera's silhouettes if their inlier ratio exceeds
            this fraction of the others'.
    """

    scales: tuple[float, ...] = (0.4, 0.3, 0.2, 0.15, 0.1, 0.07, 0.05, 0.05)
    max_misfit: float = 0.8
    similar_misfit: float = 1.1
    min_metres: float = 0.035
    min_pixels: float = 2.0
    explained_ratio: float = 0.9


FAULT = FaultSettings()


@dataclass(frozen=True, eq=False)
class FrameEdges:
    """A frame: edge points of the regions by camera, and an approximate pose (m,) [rad, m]."""

    edges: Mapping[str, EdgePoints]
    values: Array


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Estimated motion of a camera since its calibration."""

    X_WC: Array  # (4, 4) pose of the camera that fits its silhouettes.
    shift: Array  # (2,) displacement of the person in its pictures, right and down [pixel].
    pixels: float  # RMS displacement of the person's joints in its pictures [pixel].
    metres: float  # The same at the person's distance [m].
    turn: float  # Rotation of the person in its pictures, clockwise [rad].
    # inlier_ratio_before, inlier_ratio_after: of the contours, with the calibration and after the
    # motion.
    inlier_ratio_before: float
    inlier_ratio_after: float


@dataclass(frozen=True, eq=False)
class CameraFault:
    """A camera whose silhouettes disagree with the others'."""

    name: str
    motion: CameraMotion  # How it has moved; turns about the camera itself may be undetermined.
    # Whether the motion explains the silhouettes. If not, the masks may be poor, mirrored, or
    # another camera's.
    is_explained: bool
    alternatives: tuple[str, ...]  # Cameras that may be at fault instead.
    others_inlier_ratio: float  # Inlier ratio of the other cameras' contours without this one.
    first: int = 0  # Index of the first frame in which it is at fault.
    is_left_out: bool = False  # Whether it was left out.


class CameraComparison:
    """Compares cameras with each other by a person that they see.

    Args:
        fit: the person's body with the noise of its contours.
        cameras: calibrated cameras by name.
        held: (m,) which values of the pose tree stay fixed; None: none.
    """

    def __init__(
        self, fit: ContourFit, cameras: Mapping[str, Camera], held: Mask | None = None
    ) -> None:
        self._fit, self._cameras, self._held = fit, cameras, held
        self._without: dict[tuple[FrameEdges, str], tuple[Array, float]] = {}

    def pose_without(self, frame: FrameEdges, left_out: str) -> tuple[Array, float]:
        """Return a frame's pose (m,) [rad, m] by all cameras but one, and their inlier ratio.

        `left_out` is the name of that camera; "": all cameras are used. Results are cached.
        """
        if (frame, left_out) in self._without:
            return self._without[frame, left_out]
        names = [name for name in frame.edges if name != left_out]
        views = pack_views(
            [self._cameras[name] for name in names], [frame.edges[name] for name in names]
        )
        # The start is known to half a radian and a quarter of a metre.
        is_angle = self._fit.kinematics.is_angle
        prior = Prior(frame.values, np.where(is_angle, 1.0, 4.0) / 0.5**2)
        scales = (0.15, 0.12, 0.10, 0.08, 0.06, 0.05, 0.04)
        stages = [AnnealingStage(scale, 0.05) for scale in scales]
        found = self._fit.fit(views, frame.values, stages, prior, self._held)
        self._without[frame, left_out] = found.values, found.inlier_ratio
        return found.values, found.inlier_ratio

    def inlier_ratio(self, camera: Camera, edge: EdgePoints, values: Array) -> float:
        """Return the fraction of a camera's edges and contours with a residual below 5 cm."""
        return self._fit.compare(
            pack_views([camera], [edge]), values, AnnealingStage(0.05, 0.05)
        ).inlier_ratio

    def motion(
        self,
        name: str,
        edges: Sequence[EdgePoints],
        poses: Sequence[Array],
        scales: Sequence[float] = FAULT.scales,
    ) -> CameraMotion:
        """Fit the motion of a camera since its calibration to its edge points, for known poses.

        Args:
            name: of the camera.
            edges: edge points of the camera's silhouette in each frame.
            poses: (m,) person's pose in each frame [rad, m], best found without this camera.
            scales: of the fit, coarse to fine [m].
        """
        camera, pairs = self._cameras[name], list(zip(edges, poses, strict=True))
        fit, places = self._fit, np.array([self._fit.kinematics.poses(q)[:, :3, 3] for q in poses])
        points = places.reshape(-1, 3)
        middle = points.mean(axis=0)
        # A pushed camera has turned by about 0.15 rad and moved by about 0.3 m. Motions are about
        # the person's place, so a turn of the camera displaces the person by 0.15 rad x distance.
        reach = float(np.linalg.norm(camera.X_WC[:3, 3] - middle))
        deviations = np.array([0.15] * 3 + [0.3 + 0.15 * reach] * 3)
        names = [f"{camera.name}.{one}" for one in POSE_NAMES]
        problem = Problem(
            fit.body, [camera], [Unknowns(names, True, deviation=deviations)], pivot=middle,
            noise=fit.noise, steps=StepSettings(max_step=2.0, damping=1e-6, uniform_damping=1e-9),
        )  # fmt: skip
        seen = [Observation(pack_evidence([edge]), values) for edge, values in pairs]
        stages = [AnnealingStage(scale, 0.05) for scale in scales]
        nothing, solutions = np.zeros((len(pairs), 0)), []
        for start in (np.zeros(3), _shift_to_regions(camera, edges, places)):
            shift = np.concatenate([np.zeros(3), camera.X_CW[:3, :3] @ start])
            solved = problem.solve(seen, stages, (nothing, shift), expected=(nothing, np.zeros(6)))
            X_CW = problem.place_cameras(solved.parameters[0])[0][0]
            moved = camera.with_pose(np.linalg.inv(X_CW))
            solutions.append(self._describe(camera, moved, pairs, points))
            # A large motion may end on the wrong side of the body: try the regions' middles, too.
            if solutions[0].inlier_ratio_after > FAULT.explained_ratio:
                break
        return max(solutions, key=lambda one: one.inlier_ratio_after)

    def _describe(
        self,
        camera: Camera,
        moved: Camera,
        pairs: Sequence[tuple[EdgePoints, Array]],
        points: Array,
    ) -> CameraMotion:
        """Describe a camera's motion by how it displaces points in the camera's pictures.

        Args:
            camera, moved: as calibrated, and after the motion.
            pairs: edge points and pose (m,) of each frame, for the inlier ratios.
            points: (n, 3) points on the person in all frames [m].
        """
        before, after = camera.project(points)[0], moved.project(points)[0]
        pixels = float(np.sqrt(((after - before) ** 2).sum(axis=1).mean()))
        offsets_before, offsets_after = before - before.mean(axis=0), after - after.mean(axis=0)
        sine = (
            offsets_before[:, 0] * offsets_after[:, 1] - offsets_before[:, 1] * offsets_after[:, 0]
        ).sum()
        ratios = [
            np.mean([self.inlier_ratio(one, *pair) for pair in pairs]) for one in (camera, moved)
        ]
        return CameraMotion(
            moved.X_WC,
            (after - before).mean(axis=0),
            pixels,
            pixels / pixels_per_metre(camera, points.mean(axis=0)),
            float(np.arctan2(sine, (offsets_before * offsets_after).sum())),
            float(ratios[0]),
            float(ratios[1]),
        )

    def find_fault(self, frames: Sequence[FrameEdges]) -> CameraFault | None:
        """Return the camera that disagrees most with the others; None if none does.

        A camera is at fault if its removal from the pose lowers the misfit, 1 - inlier ratio, to
        `max_misfit` of what it was, and its own motion exceeds `min_metres` and `min_pixels`. With
        three cameras twice `min_metres` is needed, and the fault is never explained. The result's
        `first` and `is_left_out` are not set here.

        Args:
            frames: those that fewer than three cameras see are ignored.
        """
        frames = [frame for frame in frames if len(frame.edges) >= 3]
        names = [name for name in self._cameras if any(name in frame.edges for frame in frames)]

        def is_off(name: str) -> bool:
            """Return whether a camera fits or lies badly by the pose found with all cameras."""
            # The pose follows a moved camera by 0.3 of the way with nine cameras, by half with
            # four. So at least a fifth of the motion shows beside the pose found with all cameras.
            own = [frame for frame in frames if name in frame.edges]
            poses, ratios = zip(*(self.pose_without(frame, "") for frame in own), strict=True)
            edges = [frame.edges[name] for frame in own]
            motion = self.motion(name, edges, poses, (0.1, 0.07, 0.05))
            fits = motion.inlier_ratio_before > FAULT.explained_ratio * float(np.mean(ratios))
            return not fits or motion.metres > 0.2 * FAULT.min_metres

        # With few cameras the pose follows each of them, and this quick test would miss faults.
        if len(names) > 3 and not any(is_off(name) for name in names):
            return None
        with_all = [self.pose_without(frame, "")[1] for frame in frames]
        misfits, found = {}, {}
        for name in names:
            own = [frame for frame in frames if name in frame.edges]
            ratios = [s for s, f in zip(with_all, frames, strict=True) if name in f.edges]
            without = [self.pose_without(frame, name) for frame in own]
            motion = self.motion(
                name, [frame.edges[name] for frame in own], [values for values, _ in without]
            )
            others_ratio = float(np.mean([others for _, others in without]))
            count = float(np.mean([len(frame.edges) for frame in own]))
            best = (
                (count - 1.0) * others_ratio
                + max(motion.inlier_ratio_after, motion.inlier_ratio_before)
            ) / count
            misfits[name] = (1.0 - best) / max(1.0 - float(np.mean(ratios)), 1e-3)
            found[name] = motion, others_ratio
        suspects = sorted(misfits, key=lambda one: misfits[one])
        if not suspects or misfits[suspects[0]] > FAULT.max_misfit:
            return None
        # With three cameras it is unknown which one disagrees with the others, and two of them
        # predict the third one's picture only half as well.
        has_few = len(names) <= 3
        metres = (2.0 if has_few else 1.0) * FAULT.min_metres
        # Of the cameras with about the lowest misfit, those that have not moved are not at fault.
        moved = [
            one
            for one in suspects
            if misfits[one] <= FAULT.similar_misfit * misfits[suspects[0]]
            and found[one][0].metres >= metres
            and found[one][0].pixels >= FAULT.min_pixels
        ]
        if not moved:
            return None
        worst, limit = moved[0], np.inf if has_few else FAULT.similar_misfit * misfits[moved[0]]
        motion, others_ratio = found[worst]
        alternatives = [
            one
            for one in suspects
            if one != worst and misfits[one] < limit and found[one][0].metres > FAULT.min_metres
        ]
        explained = not has_few and is_explained(motion, others_ratio)
        return CameraFault(worst, motion, explained, tuple(alternatives), others_ratio)


def _shift_to_regions(camera: Camera, edges: Sequence[EdgePoints], places: Array) -> Array:
    """Return the mean shift (3,) [m] from the body's middle to the ray of its region's middle.

    Args:
        edges: edge points of the camera's region in each frame; frames without any are skipped; if
            all are, the shift is 0.
        places: (frames, nodes, 3) origins of the body's nodes [m]; their mean is the middle.
    """
    shifts = [np.zeros(3)]
    for edge, own in zip(edges, places, strict=True):
        if len(edge.uv):
            origin, direction = viewing_rays(camera, edge.middle[None])
            across = origin[0] - own.mean(axis=0)
            shifts.append(across - (across @ direction[0]) * direction[0])
    return np.asarray(np.sum(shifts, axis=0) / max(len(shifts) - 1, 1))


def is_explained(motion: CameraMotion, others_inlier_ratio: float) -> bool:
    """Return whether a camera fits, after its motion, with over 0.9 of the others' inlier ratio."""
    return motion.inlier_ratio_after > FAULT.explained_ratio * others_inlier_ratio


def first_moved_frame(before: Sequence[float], after: Sequence[float]) -> int:
    """Return the index of the first frame after a camera's motion; n if there is none.

    ``before``, ``after``: (n,) inlier ratios with the camera as calibrated, and as moved.
    """
    gain = np.asarray(after) - np.asarray(before)
    # Sum of the gains from each frame on; the best frame also excludes the gains before it.
    later = np.concatenate([np.cumsum(gain[::-1])[::-1], [0.0]])
    return int(np.argmax(2.0 * later - later[0]))


def require_person(recording: PersonRecording, count: int) -> PersonRecording:
    """Return a recording of `count` frames if it shows a person; raise otherwise.

    A visible part of a person is 0.1 to 3 m tall, and fills the whole picture in at most half of
    the masks.

    Raises:
        SettingsError: two cameras see a person in no frame.
        MaskError: the masks show the background.
        CameraError: the person is smaller or taller than people are.
    """
    if not recording.seen:
        raise SettingsError(
            f"two cameras see no person in any of {count} frames: give masks that show one"
        )
    if recording.covering > 0.5:
        raise MaskError(
            f"in {100.0 * recording.covering:.0f} % of the masks the largest figure reaches all "
            "four sides of the picture: the person must be white before a black background"
        )
    if not 0.1 < recording.height < 3.0:
        raise CameraError(
            f"a person {recording.height:.3g} m tall by the cameras' calibration: X_WC must be in "
            "metres and the camera's pose in the world, not its inverse; focal lengths in pixels"
        )
    return recording


@dataclass(frozen=True)
class RigFault:
    """A disagreement of all silhouettes with the calibration.

    In a ring of four cameras, exchanging opposite ones is the same as mirroring all; the latter is
    reported.
    """

    mirrored: tuple[str, ...]  # Cameras whose pictures are mirrored, left for right.
    exchanged: tuple[str, ...]  # Two cameras whose pictures are exchanged.
    # Fraction of the silhouettes that a visual hull fills, by camera, before the change.
    filled: Mapping[str, float]

    @property
    def is_identified(self) -> bool:
        """Whether the fault was identified, so that `undo` mends it."""
        return bool(self.mirrored or self.exchanged)

    def undo(self, masks: Mapping[str, Mask]) -> dict[str, Mask]:
        """Return a frame's masks (H, W) by camera, mirrored and exchanged back."""
        partner = dict(zip(self.exchanged, reversed(self.exchanged), strict=True))
        found = {}
        for name, mask in masks.items():
            turned = np.ascontiguousarray(mask[:, ::-1]) if name in self.mirrored else mask
            found[partner.get(name, name)] = turned
        return found


def find_rig_fault(
    cameras: Mapping[str, Camera],
    frames: Sequence[Mapping[str, Mask]],
    *,
    sound_below: float = 0.01,
    remaining_below: float = 0.03,
    remaining_fraction: float = 0.35,
    faulty_above: float = 0.3,
) -> RigFault | None:
    """Find what is wrong with a rig as a whole, from one person's masks in some frames.

    The visual hull of a sound rig fills all silhouettes. If it does not, pictures are mirrored (all
    or one) or exchanged (two of equal size), and the change that leaves least unfilled is taken.

    Args:
        cameras: by name.
        frames: masks (H, W) of each frame by camera; frames with fewer than two are ignored.
        sound_below: the rig is sound if less than this fraction of the silhouettes is unfilled.
        remaining_below, remaining_fraction: a change is accepted if less than `remaining_below` of
            the silhouettes and less than `remaining_fraction` of the unfilled part stay unfilled.
        faulty_above: above this unfilled fraction a rig is at fault, even if no change helps.

    Returns the fault, without `mirrored` and `exchanged` if no change explains it; None if the rig
    is sound, or no change explains an unfilled fraction of at most `faulty_above`.
    """
    frames = [masks for masks in frames if len(masks) >= 2]
    if not frames:
        return None
    first: dict[tuple[str, tuple[int, ...]], Indices] = {}
    filled = _filled_fractions(cameras, frames, RigFault((), (), {}), first)
    unfilled = 1.0 - float(np.mean(list(filled.values())))
    if unfilled < sound_below:
        return None
    best, least = RigFault((), (), filled), unfilled
    sizes = {name: (cameras[name].width, cameras[name].height) for name in filled}
    pairs = [pair for pair in combinations(filled, 2) if sizes[pair[0]] == sizes[pair[1]]]
    mirrored = [tuple(filled), *((name,) for name in filled)]
    for guess in (
        *(RigFault(names, (), filled) for names in mirrored),
        *(RigFault((), pair, filled) for pair in pairs),
    ):
        filled_so = _filled_fractions(cameras, frames, guess, first)
        remains = 1.0 - float(np.mean(list(filled_so.values())))
        if remains < least:
            best, least = guess, remains
    if least < min(remaining_below, remaining_fraction * unfilled):
        return best
    return RigFault((), (), filled) if unfilled > faulty_above else None


def _filled_fractions(
    cameras: Mapping[str, Camera],
    frames: Sequence[Mapping[str, Mask]],
    guess: RigFault,
    first: dict[tuple[str, tuple[int, ...]], Indices],
    *,
    spacing: float = 0.04,
    side: float = 1.1,
    height: float = 1.3,
    lattice: float = 0.25,
) -> dict[str, float]:
    """Return the mean fraction of the silhouettes that a visual hull fills, by camera.

    Args:
        cameras, frames: as of `find_rig_fault`.
        guess: change that is undone first.
        first: cache of `_cell_indices` of each frame's first camera, by name and the grid's place
            in the lattice; added to.
        spacing: of the hull's grid of points [m].
        side, height: half the grid's horizontal and vertical extent [m].
        lattice: spacing of the places where grids are put, so that frames can share them [m].
    """
    shares: dict[str, list[float]] = {}
    for frame in frames:
        masks = {name: mask for name, mask in guess.undo(frame).items() if mask.any()}
        used = [cameras[name] for name in masks]
        middles = [find_figures(mask)[0].middle for mask in masks.values()]
        cell = tuple(int(k) for k in np.rint(triangulate(used, middles) / lattice))
        ends = (np.arange(-end, end, spacing) for end in (side, side, height))
        grid = np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3)
        points = grid + lattice * np.array(cell, dtype=np.float64)
        # Masks are reduced to cells as large as the grid's spacing at the person.
        middle = points.mean(axis=0)
        sizes = [max(1.0, spacing * pixels_per_metre(camera, middle)) for camera in used]
        touched: list[Mask] = []
        for mask, size in zip(masks.values(), sizes, strict=True):
            h, w = (int(np.ceil(side / size)) for side in mask.shape)
            padded = np.zeros((int(np.ceil(h * size)), int(np.ceil(w * size))), np.float32)
            padded[: mask.shape[0], : mask.shape[1]] = mask
            touched.append(cv2.resize(padded, (w, h), interpolation=cv2.INTER_AREA) > 0.25)
        # A grid point stays if it is seen in or beside a touched cell, or outside the picture. Each
        # camera examines only the points that the cameras before it left.
        cells: list[Indices] = []
        for camera, size, own in zip(used, sizes, touched, strict=True):
            key = camera.name, cell
            known = None if cells else first.get(key)
            seen = _cell_indices(camera, points, size, own.shape) if known is None else known
            if not cells:
                first[key] = seen
            inside = (seen < 0) | _dilated(own).ravel()[seen]
            points, cells = points[inside], [one[inside] for one in (*cells, seen)]
        for name, chosen, own in zip(masks, cells, touched, strict=True):
            hull = np.zeros(own.size, dtype=np.bool_)
            hull[chosen[chosen >= 0]] = True
            fills = _dilated(hull.reshape(own.shape)) & own
            shares.setdefault(name, []).append(fills.sum() / own.sum() if own.any() else 1.0)
    return {name: float(np.mean(own)) for name, own in shares.items()}


def _cell_indices(camera: Camera, points: Array, size: float, shape: tuple[int, ...]) -> Indices:
    """Return the index (n,) of the picture's cell that shows each point (n, 3); -1: outside.

    ``size``: side of a cell [pixel]. ``shape``: rows and columns of cells, counted by rows.
    """
    uv, depth = camera.project(points)
    with np.errstate(invalid="ignore"):
        column, row = np.floor((uv.T + 0.5) / size)
        seen = (depth > 0.0) & (column >= 0) & (column < shape[1])
        seen &= (row >= 0) & (row < shape[0])
    return np.where(seen, row * shape[1] + column, -1.0).astype(np.int64)


def _dilated(cells: Mask) -> Mask:
    """Return cells (rows, columns) grown by one to all eight sides."""
    return np.asarray(cv2.dilate(cells.view(np.uint8), np.ones((3, 3), np.uint8)) > 0)
