"""Benchmark of audits: what is found of changes that show, and how often what is right is named.

Run as ``python -m tests.benchmarks.audit DATA [SCENES] [FIRST]``, DATA being a model's file or a
folder with the arms of ``arm_two_views`` and ``franka_one_view``. Of robots whose masks are damaged
two degrees are added to a joint, the base is moved by a centimetre, in one frame or in all, or a
frame is given another one's positions. A change shows where the outline of the parts that it moves
is two pixels from where it was, in the mean of the nearest distances.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from drake_pose.body.model import load_model
from drake_pose.body.tree.root import RootRotation
from drake_pose.camera.models import PinholeCamera
from drake_pose.registration.contradictions import Audit, audit_frames
from drake_pose.registration.per_frame_fit import PerFrameFit
from drake_pose.registration.posed_frames import SeenFrame
from drake_pose.registration.register import RegistrationBody
from tests.benchmarks.scenes import Array, Mask, damaged, draw_arm, print_table, segments

_ARMS = ("arm_two_views/med7/med7.urdf", "franka_one_view/panda/panda.urdf")
_FRAMES, _FEW_FRAMES = 20, 8
_TURN, _SHIFT = np.radians(2.0), 0.01
# A change shows that moves outlines by so much [pixel].
_SHOWS = 2.0
_TRIES = 10


class Scene:
    """A robot in random poses before a camera, and what is changed of it."""

    def __init__(self, body: RegistrationBody, seed: int) -> None:
        self.body, self.rng = body, np.random.default_rng(seed)
        self.camera, frames = draw_arm(body, _FRAMES, self.rng)
        self.poses = [frame.values for frame in frames]
        self.segments = [segments(body, self.camera, values) for values in self.poses]
        self.masks = [damaged(frame.mask, self.rng) for frame in frames]

    def frame(self, k: int, values: Array | None = None, mask: Mask | None = None) -> SeenFrame:
        """A frame, perhaps with other positions or another mask."""
        seen = self.masks[k] if mask is None else mask
        values = self.poses[k] if values is None else values
        return SeenFrame(f"{k:04d}", values, {self.camera.name: seen})

    def fit(self, camera: PinholeCamera) -> PerFrameFit:
        """What fits each of its frames."""
        frames, body = [self.frame(k) for k in range(_FRAMES)], self.body
        return PerFrameFit(body.kinematics, (body.few, body.all), [camera], frames)

    def shown(self, k: int, values: Array, camera: PinholeCamera | None = None) -> float:
        """How far the outline of a frame's segments is off another pose or camera's [pixel]."""
        seen = segments(self.body, camera or self.camera, values) >= 0
        return outline_shift(self.segments[k], seen)

    def turned(self, k: int, joint: int) -> Array:
        """A frame's positions, those of a joint off."""
        values = self.poses[k].copy()
        values[joint] += _TURN
        return values

    def moved_camera(self) -> PinholeCamera:
        """The camera as it sees a base that was moved."""
        by = self.rng.normal(size=3)
        X_WC = self.camera.X_WC.copy()
        X_WC[:3, 3] += _SHIFT * by / np.linalg.norm(by)
        return self.camera.with_pose(X_WC)

    def angle(self) -> int:
        """A random joint that turns."""
        return int(self.rng.choice(np.flatnonzero(self.body.kinematics.is_angle)))

    def changes(self) -> Iterator[tuple[str, str, int, SeenFrame]]:
        """Changes of one frame that show: their kind, the cause's name, the frame, and it."""
        for _ in range(_TRIES):
            k, joint = int(self.rng.integers(_FRAMES)), self.angle()
            values = self.turned(k, joint)
            if self.shown(k, values) >= _SHOWS:
                name = self.body.kinematics.names[joint]
                yield "joint, one frame", name, k, self.frame(k, values)
                break
        for _ in range(_TRIES):
            k, camera = int(self.rng.integers(_FRAMES)), self.moved_camera()
            if self.shown(k, self.poses[k], camera) >= _SHOWS:
                seen = segments(self.body, camera, self.poses[k]) >= 0
                yield "base, one frame", "base", k, self.frame(k, mask=damaged(seen, self.rng))
                break
        k, other = int(self.rng.integers(_FRAMES)), int(self.rng.integers(_FRAMES - 1))
        values = self.poses[other + (other >= k)]
        if self.shown(k, values) >= _SHOWS:
            yield "exchanged frame", "", k, self.frame(k, values)

    def changes_of_all(self) -> Iterator[tuple[str, str, PerFrameFit, list[SeenFrame]]]:
        """Changes that are the same in all frames, of which some are audited."""
        few = range(_FEW_FRAMES)
        joint, camera = self.angle(), self.moved_camera()
        turned = [self.turned(k, joint) for k in few]
        if np.mean([self.shown(k, turned[k]) for k in few]) >= _SHOWS:
            name, frames = (
                self.body.kinematics.names[joint],
                [self.frame(k, turned[k]) for k in few],
            )
            yield "joint, all frames", name, self.fit(self.camera), frames
        if np.mean([self.shown(k, self.poses[k], camera) for k in few]) >= _SHOWS:
            frames = [self.frame(k) for k in few]
            yield "base, all frames", "base", self.fit(camera), frames


def outline_shift(own_segments: NDArray[np.int16], mask: Mask) -> float:
    """How far the outline of the parts that differ is from a mask's, in the mean [pixel]."""
    own, other = _edge(own_segments >= 0), _edge(mask)
    if not own.any() or not other.any():
        return np.inf if own.any() != other.any() else 0.0
    distance = distance_transform_edt(~other)
    parts = [distance[own & (own_segments == label)] for label in np.unique(own_segments[own])]
    differing = [part for part in parts if part.mean() > 0.25]
    return float(np.concatenate(differing).mean()) if differing else 0.0


def _edge(mask: Mask) -> Mask:
    """The outermost pixels, but not at the picture's border."""
    inner = cv2.erode(
        mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE
    )
    return np.asarray(mask & (inner == 0))


def count_scene(scene: Scene, counts: Counter[tuple[str, str]]) -> float:
    """Audits a scene and its changes; returns the processor's seconds for the former.

    Counts, for each kind of change and for frames and scenes that are right, what was shown, found
    and named by its cause or one that explains the masks as well.
    """

    def note(kind: str, found: bool, named: bool, what: object) -> None:
        for column, holds in (("shown", True), ("found", found), ("named", named)):
            counts[kind, column] += holds
        if not named:
            print(f"{kind}: found {found}, {what}", file=sys.stderr, flush=True)

    def note_right(audit: Audit, changed: int | None) -> None:
        right = [one.finding for k, one in enumerate(audit.frames) if k != changed]
        counts["frames that are right", "shown"] += len(right)
        counts["frames that are right", "found"] += sum(one is not None for one in right)
        counts["scenes that are right", "shown"] += 1
        counts["scenes that are right", "found"] += bool(audit.common)
        for alarm in (*filter(None, right), *audit.common):
            print("false alarm:", alarm, file=sys.stderr, flush=True)

    begin = time.process_time()
    fit = scene.fit(scene.camera)
    fitted = [fit.fit(scene.frame(k)) for k in range(_FRAMES)]
    note_right(audit_frames(fit, fitted), None)
    seconds = time.process_time() - begin
    for kind, cause, k, frame in scene.changes():
        audit = audit_frames(fit, [*fitted[:k], fit.fit(frame), *fitted[k + 1 :]])
        finding = audit.frames[k].finding
        names = [] if finding is None else [finding.name, *finding.rivals]
        note(kind, finding is not None, cause in ("", *names), finding)
        note_right(audit, k)
    for kind, cause, moved, frames in scene.changes_of_all():
        audit = audit_frames(moved, [moved.fit(frame) for frame in frames])
        names = [name for one in audit.common for name in (one.name, *one.rivals)]
        note(kind, bool(names), cause in names, audit.common)
        counts["frames that are right", "shown"] += len(audit.frames)
        counts["frames that are right", "found"] += len(audit.contradicting)
    return seconds


def load_robot(path: Path) -> RegistrationBody:
    """A robot whose base, if it is free, stands at the world's origin."""
    model = load_model(path, check=False)
    if "qw" not in model.position_names[0]:
        return RegistrationBody(model.pose_tree())
    upright = RootRotation.fixed(np.eye(3))
    return RegistrationBody(model.pose_tree(root_position=np.zeros(3), root_rotation=upright))


def main() -> None:
    """Print what audits find here."""
    given = Path(sys.argv[1])
    scenes, first = (int(word) for word in (*sys.argv[2:4], "5", "0")[:2])
    rows = []
    for path in [given] if given.is_file() else [given / arm for arm in _ARMS]:
        body, counts = load_robot(path), Counter[tuple[str, str]]()
        spent = [count_scene(Scene(body, first + k), counts) for k in range(scenes)]
        for kind in dict.fromkeys(kind for kind, _ in counts):
            cells = [str(counts[kind, column]) for column in ("shown", "found", "named")]
            rows.append([f"{path.stem}, {kind}", *cells[: 2 if "right" in kind else 3]])
        rows.append([f"{path.stem}, CPU seconds a frame", f"{np.mean(spent) / _FRAMES:.2f}"])
    title = f"Audits: scenes of {_FRAMES} frames, damaged masks"
    print_table(title, ("robot, what", "shown", "found", "cause named"), rows)


if __name__ == "__main__":
    main()
