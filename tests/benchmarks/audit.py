"""Benchmark of audits: what is found of changes that show, and how often what is right is named.

Run as ``python -m tests.benchmarks.audit DATA [SCENES] [FIRST]``, DATA being a model's
file or a folder with the arms of ``arm_two_views`` and ``franka_one_view``. Robots stand in random
poses before a camera anywhere; their masks, drawn by Drake, are grown or worn by up to two pixels
and have holes of 3 %. Then two degrees are added to a joint, the base is moved by a centimetre, in
one frame or in all, or a frame is given another one's positions.

A change shows where the outline of the parts that it moves is two pixels from where it was, in the
mean of the nearest distances.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.ndimage import distance_transform_edt

from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.root import RootRotation
from drake_pose.camera.models import PinholeCamera
from drake_pose.registration.contradictions import Audit, audit_frames
from drake_pose.registration.per_frame_fit import FrameFit, PerFrameFit, SeenFrame
from drake_pose.registration.register import RegistrationBody
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ARMS = ("arm_two_views/med7/med7.urdf", "franka_one_view/panda/panda.urdf")
_FRAMES, _FEW_FRAMES = 20, 8
_WIDTH, _HEIGHT, _FOCAL = 640, 480, 600.0
_TURN, _SHIFT = np.radians(2.0), 0.01
# A change shows that moves outlines by so much [pixel], and a frame shows the robot with so many.
_SHOWS, _LEAST_AREA = 2.0, 3000
_GROWTH, _HOLES, _RADII = 2, 0.03, (3, 9)
_TRIES = 10


@dataclass
class Counts:
    """What was counted.

    Attributes:
        frames, alarms: frames that are right, and how many of them were named.
        scenes, common_alarms: scenes in which nothing is off in all frames, and those in which
            something was named.
        shown, found, named: by kind of change: how many showed, were found, and were named by their
            cause or one that explains the masks as well.
        seconds: of the processor, of all frames.
    """

    frames: int
    alarms: int
    scenes: int
    common_alarms: int
    shown: dict[str, int]
    found: dict[str, int]
    named: dict[str, int]
    seconds: float


class Scene:
    """A robot in random poses before a camera.

    Args:
        model: the robot.
        tree: its pose tree.
        body: its surfaces.
        seed: of all draws.
    """

    def __init__(
        self, model: ArticulatedModel, tree: PoseTree, body: RegistrationBody, seed: int
    ) -> None:
        self._model, self._tree, self._body = model, tree, body
        self._random = np.random.default_rng(seed)
        kinematics = body.kinematics
        self._lower = np.where(np.isfinite(kinematics.lower), kinematics.lower, -np.pi)
        self._upper = np.where(np.isfinite(kinematics.upper), kinematics.upper, np.pi)
        self.poses: list[Array] = []
        while len(self.poses) < _FRAMES:
            self._draw()
        self.segments = [self.look(self.camera, values) for values in self.poses]
        self.masks = [self._damaged(segments >= 0) for segments in self.segments]

    def _draw(self) -> None:
        """A camera that sees the robot in all poses."""
        random = self._random
        self.camera = _looking_camera(random)
        self.poses = []
        for _ in range(2 * _FRAMES):
            values = random.uniform(self._lower, self._upper)
            if np.count_nonzero(self.look(self.camera, values) >= 0) > _LEAST_AREA:
                self.poses.append(values)
            if len(self.poses) == _FRAMES:
                return

    def look(self, camera: PinholeCamera, values: Array) -> NDArray[np.int16]:
        """(H, W) segments of the robot, below 0 where it is not."""
        q, X_WB = self._tree.positions_from(self._body.kinematics.split(values))
        return np.asarray(LabelRenderer(self._model, camera).segments(q, X_WB))

    def frame(self, k: int, values: Array | None = None, mask: Mask | None = None) -> SeenFrame:
        """A frame, perhaps with other positions or another mask."""
        return SeenFrame(
            f"{k:04d}",
            self.poses[k] if values is None else values,
            {self.camera.name: self.masks[k] if mask is None else mask},
        )

    def fit(self, camera: PinholeCamera | None = None) -> PerFrameFit:
        """Frees its frames."""
        body = self._body
        frames = [self.frame(k) for k in range(len(self.poses))]
        return PerFrameFit(body.kinematics, (body.few, body.all), [camera or self.camera], frames)

    def turned(self, k: int, joint: int) -> Array:
        """A frame's positions, those of a joint off."""
        values = self.poses[k].copy()
        values[joint] += _TURN
        return values

    def moved_camera(self) -> PinholeCamera:
        """The camera as it sees a base that was moved."""
        by = self._random.normal(size=3)
        X_WC = self.camera.X_WC.copy()
        X_WC[:3, 3] += _SHIFT * by / np.linalg.norm(by)
        return self.camera.with_pose(X_WC)

    def pick(self, count: int) -> int:
        """A random number below a count."""
        return int(self._random.integers(count))

    def angle(self) -> int:
        """A random joint that turns."""
        return int(self._random.choice(np.flatnonzero(self._body.kinematics.is_angle)))

    def seen_damaged(self, camera: PinholeCamera, k: int) -> Mask:
        """A frame's mask from elsewhere."""
        return self._damaged(self.look(camera, self.poses[k]) >= 0)

    def _damaged(self, mask: Mask) -> Mask:
        """Grown or worn by some pixels, with holes."""
        by = int(self._random.integers(-_GROWTH, _GROWTH + 1))
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(by) + 1,) * 2)
        found = (cv2.dilate if by > 0 else cv2.erode)(mask.astype(np.uint8), kernel)
        v, u = np.nonzero(found)
        least = (1.0 - _HOLES) * len(v)
        while np.count_nonzero(found) > least:
            k, radius = self.pick(len(v)), int(self._random.integers(*_RADII))
            cv2.circle(found, (int(u[k]), int(v[k])), radius, 0, -1)
        return found > 0


def _looking_camera(random: np.random.Generator) -> PinholeCamera:
    """A camera anywhere that looks at a robot from a metre or more, turned in any way."""
    away = random.normal(size=3)
    z = -away / np.linalg.norm(away)
    x = np.cross(random.normal(size=3), z)
    x /= np.linalg.norm(x)
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    middle = np.array([0.0, 0.0, 0.35]) + 0.1 * random.normal(size=3)
    X_WC[:3, 3] = middle - random.uniform(1.0, 1.7) * z
    return PinholeCamera(
        "camera", _WIDTH, _HEIGHT, _FOCAL, _FOCAL, _WIDTH / 2 - 0.5, _HEIGHT / 2 - 0.5, X_WC
    )


def outline_shift(segments: NDArray[np.int16], mask: Mask) -> float:
    """How far the outline of the parts that differ is from a mask's, in the mean [pixel]."""
    own, other = _edge(segments >= 0), _edge(mask)
    if not own.any() or not other.any():
        return np.inf if own.any() != other.any() else 0.0
    distance = distance_transform_edt(~other)
    parts = [distance[own & (segments == label)] for label in np.unique(segments[own])]
    differing = [part for part in parts if part.mean() > 0.25]
    return float(np.concatenate(differing).mean()) if differing else 0.0


def _edge(mask: Mask) -> Mask:
    """The outermost pixels, but not at the picture's border."""
    inner = cv2.erode(
        mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE
    )
    return np.asarray(mask & (inner == 0))


class Benchmark:
    """Scenes of one robot, counted together."""

    def __init__(self, path: Path) -> None:
        self._model = load_model(path, check=False)
        free = "qw" in self._model.position_names[0]
        self._tree = (
            self._model.pose_tree(
                root_position=np.zeros(3), root_rotation=RootRotation.fixed(np.eye(3))
            )
            if free
            else self._model.pose_tree()
        )
        self._body = RegistrationBody(self._tree)
        self.counts = Counts(0, 0, 0, 0, {}, {}, {}, 0.0)

    def run(self, seed: int) -> None:
        """Adds a scene."""
        scene = Scene(self._model, self._tree, self._body, seed)
        fit = scene.fit()
        begin = time.process_time()
        fitted = [fit.fit(scene.frame(k)) for k in range(_FRAMES)]
        self._count(audit_frames(fit, fitted), None)
        self.counts.seconds += time.process_time() - begin
        for kind, cause, k, frame in self._changed(scene):
            others = [*fitted[:k], fit.fit(frame), *fitted[k + 1 :]]
            found = audit_frames(fit, others)
            finding = found.frames[k].finding
            names = [] if finding is None else [finding.name, *finding.rivals]
            self._note(kind, finding is not None, cause in ("", *names), str(finding))
            self._count(found, k)
        self._all_frames(scene, fit)

    def _changed(self, scene: Scene) -> Iterator[tuple[str, str, int, SeenFrame]]:
        """Changes of one frame that show: their kind, the cause's name, the frame, and it."""
        kinematics = self._body.kinematics
        for _ in range(_TRIES):
            k, joint = scene.pick(_FRAMES), scene.angle()
            values = scene.turned(k, joint)
            if self._shows(scene, k, scene.look(scene.camera, values) >= 0):
                yield "joint, one frame", kinematics.names[joint], k, scene.frame(k, values)
                break
        for _ in range(_TRIES):
            k, camera = scene.pick(_FRAMES), scene.moved_camera()
            if self._shows(scene, k, scene.look(camera, scene.poses[k]) >= 0):
                mask = scene.seen_damaged(camera, k)
                yield "base, one frame", "base", k, scene.frame(k, mask=mask)
                break
        k, other = scene.pick(_FRAMES), scene.pick(_FRAMES - 1)
        values = scene.poses[other + (other >= k)]
        if self._shows(scene, k, scene.look(scene.camera, values) >= 0):
            yield "exchanged frame", "", k, scene.frame(k, values)

    def _shows(self, scene: Scene, k: int, mask: Mask) -> bool:
        return outline_shift(scene.segments[k], mask) >= _SHOWS

    def _all_frames(self, scene: Scene, fit: PerFrameFit) -> None:
        """Changes that are the same in all frames, of which some are audited."""
        few = range(_FEW_FRAMES)
        joint, camera = scene.angle(), scene.moved_camera()
        turned = [scene.turned(k, joint) for k in few]
        off = [
            outline_shift(scene.segments[k], scene.look(scene.camera, turned[k]) >= 0) for k in few
        ]
        if np.mean(off) >= _SHOWS:
            frames = [scene.frame(k, turned[k]) for k in few]
            self._common(fit, frames, "joint, all frames", self._body.kinematics.names[joint])
        off = [
            outline_shift(scene.segments[k], scene.look(camera, scene.poses[k]) >= 0) for k in few
        ]
        if np.mean(off) >= _SHOWS:
            frames = [scene.frame(k) for k in few]
            self._common(scene.fit(camera), frames, "base, all frames", "base")

    def _common(self, fit: PerFrameFit, frames: Sequence[SeenFrame], kind: str, cause: str) -> None:
        fitted: list[FrameFit] = [fit.fit(frame) for frame in frames]
        found = audit_frames(fit, fitted)
        named = [name for one in found.common for name in (one.name, *one.rivals)]
        self._note(kind, bool(named), cause in named, str(found.common))
        self.counts.frames += len(found.frames)
        self.counts.alarms += len(found.contradicting)

    def _count(self, found: Audit, changed: int | None) -> None:
        """Counts what is named in frames that are right."""
        counts = self.counts
        right = [one for k, one in enumerate(found.frames) if k != changed]
        counts.frames += len(right)
        alarms = [one for one in right if one.finding is not None]
        counts.alarms += len(alarms)
        counts.scenes += 1
        counts.common_alarms += bool(found.common)
        for one in alarms:
            print("false alarm:", one, file=sys.stderr, flush=True)
        for cause in found.common:
            print("false alarm:", cause, file=sys.stderr, flush=True)

    def _note(self, kind: str, found: bool, named: bool, what: str) -> None:
        """Counts a change that shows."""
        counts = self.counts
        for counter, add in ((counts.shown, 1), (counts.found, found), (counts.named, named)):
            counter[kind] = counter.get(kind, 0) + add
        if not named:
            print(f"{kind}: found {found}, {what}", file=sys.stderr, flush=True)


def audits_table(paths: Sequence[Path], seeds: Sequence[int]) -> Table:
    """All figures.

    Args:
        paths: the robots' files.
        seeds: one for each scene.
    """
    table = Table(title=f"Audits: scenes of {_FRAMES} frames, damaged masks")
    for heading in ("robot", "what", "shown", "found", "cause named"):
        table.add_column(heading, justify="left" if heading in ("robot", "what") else "right")
    for path in paths:
        benchmark = Benchmark(path)
        for seed in seeds:
            benchmark.run(seed)
        counts = benchmark.counts
        for kind, shown in counts.shown.items():
            table.add_row(
                path.stem, kind, str(shown), str(counts.found[kind]), str(counts.named[kind])
            )
        table.add_row(path.stem, "frames that are right", str(counts.frames), str(counts.alarms))
        table.add_row(
            path.stem, "scenes that are right", str(counts.scenes), str(counts.common_alarms)
        )
        seconds = counts.seconds / (len(seeds) * _FRAMES)
        table.add_row(path.stem, "CPU seconds a frame", f"{seconds:.2f}")
    return table


def main() -> None:
    """Print what audits find here."""
    given = Path(sys.argv[1])
    scenes = int(sys.argv[2]) if len(sys.argv) > 2 else 5
    first = int(sys.argv[3]) if len(sys.argv) > 3 else 0
    paths = [given] if given.is_file() else [given / arm for arm in _ARMS]
    Console(width=100).print(audits_table(paths, range(first, first + scenes)))


if __name__ == "__main__":
    main()
