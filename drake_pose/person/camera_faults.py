"""Cameras that have moved since they were calibrated, found by their residual.

Each camera in turn is predicted by the others' pose. It has moved where one rigid motion of it
explains many frames; poor masks are off in another way each time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.camera.models import Camera
from drake_pose.fit.contour_fit import ContourFit, Prior, pack_views
from drake_pose.fit.evidence import EdgePoints, Observation, pack_evidence
from drake_pose.fit.levenberg_marquardt import AnnealingStage, StepSettings
from drake_pose.fit.parameters import POSE_NAMES
from drake_pose.fit.problem import Problem, Unknowns
from drake_pose.person.figures import pixels_per_metre
from drake_pose.person.views import viewing_rays


class FaultSettings(NamedTuple):
    """From when on a camera is at fault.

    rounds: scales at which a camera's motion is fitted. lowered: a camera is at fault where leaving
    it out lowers the others' misfit to this fraction; alike: those that lower it to no more than so
    many times the least are rivals. min_metres, min_pixels: a surface is known to 2 cm, and an edge
    to a pixel: what is off by more is off. explained: one motion explains a camera's silhouettes
    where they fit this fraction of what the others' do.
    """

    rounds: tuple[float, ...] = (0.4, 0.3, 0.2, 0.15, 0.1, 0.07, 0.05, 0.05)
    lowered: float = 0.8
    alike: float = 1.1
    min_metres: float = 0.035
    min_pixels: float = 2.0
    explained: float = 0.9


FAULT = FaultSettings()


@dataclass(frozen=True, eq=False)
class FrameView:
    """A frame: edges of the regions by camera that sees the person, and about the pose (m,)."""

    edges: Mapping[str, EdgePoints]
    values: Array


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """How a camera seems to have moved.

    Args:
        X_WC: (4, 4) where it would have to be.
        shift: (2,) by how much the person is off in its pictures [pixel], right and down.
        pixels: how far the person's joints are off in its pictures, root mean square [pixel].
        metres: the same at the person's place [m].
        turn: by how much the pictures are turned, clockwise [rad].
        share_before, share_after: of the contours, what fits as calibrated and as moved.
    """

    X_WC: Array
    shift: Array
    pixels: float
    metres: float
    turn: float
    share_before: float
    share_after: float


@dataclass(frozen=True, eq=False)
class CameraFault:
    """A camera that contradicts the others.

    Args:
        motion: how it has moved; it may also have turned further than can be told.
        is_explained: whether its having moved explains all: else its masks may be poor, mirrored,
            or another camera's.
        rivals: cameras that may be at fault in its stead: who it is, cannot be told.
        others_share: of the other cameras' contours, what fits without it.
        first, is_left_out: since which frame (from 0) it is at fault; whether it was left out.
    """

    name: str
    motion: CameraMotion
    is_explained: bool
    rivals: tuple[str, ...]
    others_share: float
    first: int = 0
    is_left_out: bool = False


class CameraJudge:
    """Compares cameras with each other by a person whom they see.

    Args:
        fit: of the person.
        held: (m,) values that stay.
    """

    def __init__(
        self, fit: ContourFit, cameras: Mapping[str, Camera], held: Mask | None = None
    ) -> None:
        self._fit, self._cameras, self._held = fit, cameras, held
        self._without: dict[tuple[FrameView, str], tuple[Array, float]] = {}

    def pose_without(self, frame: FrameView, left_out: str) -> tuple[Array, float]:
        """A frame's pose (m,) by all cameras but one, and what share of their contours fits."""
        if (frame, left_out) in self._without:
            return self._without[frame, left_out]
        names = [name for name in frame.edges if name != left_out]
        views = pack_views(
            [self._cameras[name] for name in names], [frame.edges[name] for name in names]
        )
        # Angles are known to half a radian, lengths twice as well.
        is_angle = self._fit.kinematics.is_angle
        prior = Prior(frame.values, np.where(is_angle, 1.0, 4.0) / 0.5**2)
        scales = (0.15, 0.12, 0.10, 0.08, 0.06, 0.05, 0.04)
        rounds = [AnnealingStage(scale, 0.05) for scale in scales]
        found = self._fit.fit(views, frame.values, rounds, prior, self._held)
        self._without[frame, left_out] = found.values, found.inlier_ratio
        return found.values, found.inlier_ratio

    def share(self, camera: Camera, edge: EdgePoints, values: Array) -> float:
        """What share of the contours' lengths fits in one picture."""
        return self._fit.compare(
            pack_views([camera], [edge]), values, AnnealingStage(0.05, 0.05)
        ).inlier_ratio

    def motion(
        self,
        name: str,
        edges: Sequence[EdgePoints],
        poses: Sequence[Array],
        scales: Sequence[float] = FAULT.rounds,
    ) -> CameraMotion:
        """The motion of a camera that explains its edges best, by poses (m,) found without it."""
        camera, pairs = self._cameras[name], list(zip(edges, poses, strict=True))
        fit, places = self._fit, np.array([self._fit.kinematics.poses(q)[:, :3, 3] for q in poses])
        points = places.reshape(-1, 3)
        middle = points.mean(axis=0)
        # A camera that was pushed has turned and shifted by about 0.15 rad and 0.3 m. What the
        # pictures see of a turn about the camera is the person's way about it.
        reach = float(np.linalg.norm(camera.X_WC[:3, 3] - middle))
        deviations = np.array([0.15] * 3 + [0.3 + 0.15 * reach] * 3)
        names = [f"{camera.name}.{one}" for one in POSE_NAMES]
        problem = Problem(
            fit.body, [camera], [Unknowns(names, True, deviation=deviations)], pivot=middle,
            noise=fit.noise, steps=StepSettings(longest=2.0, damping=1e-6, even_damping=1e-9),
        )  # fmt: skip
        seen = [Observation(pack_evidence([edge]), values) for edge, values in pairs]
        rounds = [AnnealingStage(scale, 0.05) for scale in scales]
        nothing, found = np.zeros((len(pairs), 0)), []
        for start in (np.zeros(3), _way_to_regions(camera, edges, places)):
            shift = np.concatenate([np.zeros(3), camera.X_CW[:3, :3] @ start])
            solved = problem.solve(seen, rounds, (nothing, shift), expected=(nothing, np.zeros(6)))
            X_CW = problem.place_cameras(solved.parameters[0])[0][0]
            moved = camera.with_pose(np.linalg.inv(X_CW))
            found.append(self._describe(camera, moved, pairs, points))
            # What is far off may be drawn to the wrong side of the body; else one start is enough.
            if found[0].share_after > FAULT.explained:
                break
        return max(found, key=lambda one: one.share_after)

    def _describe(
        self,
        camera: Camera,
        moved: Camera,
        pairs: Sequence[tuple[EdgePoints, Array]],
        points: Array,
    ) -> CameraMotion:
        """What a camera's motion does to its pictures, and to points (n, 3) in them [m]."""
        before, after = camera.project(points)[0], moved.project(points)[0]
        pixels = float(np.sqrt(((after - before) ** 2).sum(axis=1).mean()))
        arms, ends = before - before.mean(axis=0), after - after.mean(axis=0)
        sine = (arms[:, 0] * ends[:, 1] - arms[:, 1] * ends[:, 0]).sum()
        shares = [np.mean([self.share(one, *pair) for pair in pairs]) for one in (camera, moved)]
        return CameraMotion(
            moved.X_WC,
            (after - before).mean(axis=0),
            pixels,
            pixels / pixels_per_metre(camera, points.mean(axis=0)),
            float(np.arctan2(sine, (arms * ends).sum())),
            float(shares[0]),
            float(shares[1]),
        )

    def find_fault(self, frames: Sequence[FrameView]) -> CameraFault | None:
        """The camera that contradicts the others most, if one does.

        Of the frames those count that three cameras see or more.
        """
        frames = [frame for frame in frames if len(frame.edges) >= 3]
        names = [name for name in self._cameras if any(name in frame.edges for frame in frames)]

        def is_off(name: str) -> bool:
            # Of a camera that has moved a fifth at least shows beside the pose that it helped to
            # find: that pose goes along by 0.3 of the way with nine cameras, by half with four.
            own = [frame for frame in frames if name in frame.edges]
            poses, shares = zip(*(self.pose_without(frame, "") for frame in own), strict=True)
            edges = [frame.edges[name] for frame in own]
            motion = self.motion(name, edges, poses, (0.1, 0.07, 0.05))
            fits = motion.share_before > FAULT.explained * float(np.mean(shares))
            return not fits or motion.metres > 0.2 * FAULT.min_metres

        # What few cameras say, their pose follows.
        if len(names) > 3 and not any(is_off(name) for name in names):
            return None
        with_all = [self.pose_without(frame, "")[1] for frame in frames]
        misfits, found = {}, {}
        for name in names:
            own = [frame for frame in frames if name in frame.edges]
            shares = [s for s, f in zip(with_all, frames, strict=True) if name in f.edges]
            without = [self.pose_without(frame, name) for frame in own]
            motion = self.motion(
                name, [frame.edges[name] for frame in own], [values for values, _ in without]
            )
            share = float(np.mean([others for _, others in without]))
            count = float(np.mean([len(frame.edges) for frame in own]))
            best = ((count - 1.0) * share + max(motion.share_after, motion.share_before)) / count
            misfits[name] = (1.0 - best) / max(1.0 - float(np.mean(shares)), 1e-3)
            found[name] = motion, share
        suspects = sorted(misfits, key=lambda one: misfits[one])
        if not suspects or misfits[suspects[0]] > FAULT.lowered:
            return None
        # Any two cameras agree more or less: two alone predict a third one's picture half as well,
        # and of three it is unknown which one contradicts the others.
        few = len(names) <= 3
        metres = (2.0 if few else 1.0) * FAULT.min_metres
        # Of those that lower the misfit alike, one that has not moved is not at fault.
        moved = [
            one
            for one in suspects
            if misfits[one] <= FAULT.alike * misfits[suspects[0]]
            and found[one][0].metres >= metres
            and found[one][0].pixels >= FAULT.min_pixels
        ]
        if not moved:
            return None
        first, alike = moved[0], np.inf if few else FAULT.alike * misfits[moved[0]]
        motion, share = found[first]
        rivals = [
            one
            for one in suspects
            if one != first and misfits[one] < alike and found[one][0].metres > FAULT.min_metres
        ]
        explained = not few and is_explained(motion, share)
        return CameraFault(first, motion, explained, tuple(rivals), share)


def _way_to_regions(camera: Camera, edges: Sequence[EdgePoints], places: Array) -> Array:
    """The mean way (3,) from the bodies' middles to the rays of their regions' middles [m]."""
    ways = [np.zeros(3)]
    for edge, own in zip(edges, places, strict=True):
        if len(edge.uv):
            origin, direction = viewing_rays(camera, edge.middle[None])
            across = origin[0] - own.mean(axis=0)
            ways.append(across - (across @ direction[0]) * direction[0])
    return np.asarray(np.sum(ways, axis=0) / max(len(ways) - 1, 1))


def is_explained(motion: CameraMotion, others_share: float) -> bool:
    """Whether a camera's motion explains its silhouettes nearly as well as the others' fit."""
    return motion.share_after > FAULT.explained * others_share


def moved_since(before: Sequence[float], after: Sequence[float]) -> int:
    """The frame of a camera's motion, by shares that fit before and after it; or their count."""
    gain = np.asarray(after) - np.asarray(before)
    # What speaks for the motion from each frame on, less what speaks for it before that.
    later = np.concatenate([np.cumsum(gain[::-1])[::-1], [0.0]])
    return int(np.argmax(2.0 * later - later[0]))
