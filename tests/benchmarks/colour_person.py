"""Benchmark of following a person by colour: rooms and all, beside following by exact masks.

Run as ``python -m tests.benchmarks.colour_person [--seed N] [--frames N]``. The rooms are
those of the benchmark of an arm. Four cameras of 640 x 480 stand around the bundled person, whose
parts have colours of their own; the person walks about, turns, and swings arms and legs.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.landmarks import landmark_positions, load_landmarks
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.camera.models import Camera
from drake_pose.camera.rigs import circle_of_cameras
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.colour_views import ColourViews, KnownColours
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.views import FrameViews, edge_spacing, see_silhouette
from tests.benchmarks.colour import ROOMS, ColourScene, Frame, Room

Array = NDArray[np.float64]

# How far the person walks [m], stands at rest [m], turns and swings [rad].
_WALK, _RISE, _HEIGHT, _TURN, _NOD, _SWING = 0.25, 0.05, 1.55, 0.8, 0.15, 0.9
# A frame is wrong where a joint centre is off by more [mm].
_WRONG = 150.0


class PersonColourScene(ColourScene):
    """A person who moves before a room; arguments as of ColourScene."""

    def __init__(self, model: ArticulatedModel, room: Room, seed: int, folder: Path) -> None:
        super().__init__(model, room, seed, folder)
        around = circle_of_cameras(4, radius=2.6, field_of_view=np.radians(50.0), face_camera=False)
        self.cameras = tuple(around.values())
        self._model = model

    def draw_swing(self) -> tuple[Array, Array, Array, Array]:
        """Middles and amplitudes [rad or m], speeds [rad/s] and phases [rad] of the swings."""
        model, rng = self._model, self.rng
        names, n = model.position_names, len(model.position_names)
        low, high = np.maximum(model.lower, -2.9), np.minimum(model.upper, 2.9)
        middle, amplitude, speed = np.zeros((3, n))
        for k, name in enumerate(names):
            if name.startswith("position_"):
                amplitude[k] = _RISE if name == "position_z" else _WALK
                middle[k] = _HEIGHT if name == "position_z" else 0.0
                speed[k] = rng.uniform(0.8, 1.6)
            elif name.startswith(("head_", "neck_")):
                turns = name == "head_y"
                amplitude[k], speed[k] = (_TURN, 1.0) if turns else (_NOD, 1.5)
                middle[k] = rng.uniform(-3.0, 3.0) if turns else 0.0
            else:
                reach = min(0.35 * (high[k] - low[k]), _SWING)
                amplitude[k] = rng.uniform(0.4, 1.0) * reach
                ends = low[k] + amplitude[k], high[k] - amplitude[k]
                middle[k] = np.clip(0.25 * (low[k] + high[k]), *ends)
                speed[k] = rng.uniform(1.5, 3.0)
        return middle, amplitude, speed, rng.uniform(0.0, 2.0 * np.pi, n)


@dataclass(frozen=True, eq=False)
class PersonOutcome:
    """How one sequence was followed.

    Args:
        errors: (frames, joints) of joint centres [mm].
        lost: (frames,) whether the person was said to be.
        milliseconds: of the processor, for a frame.
    """

    errors: Array
    lost: NDArray[np.bool_]
    milliseconds: float

    @property
    def wrong(self) -> NDArray[np.bool_]:
        """(frames,) where a joint centre is far off."""
        return self.errors.max(axis=1) > _WRONG


def follow_person(
    model: ArticulatedModel, cameras: Sequence[Camera], frames: Sequence[Frame], by_colour: bool
) -> PersonOutcome:
    """Follows a person who is known in the first frame, by colours or by exact masks.

    The first frame's masks are given in both cases.
    """
    tracker, landmarks = (
        PersonPoseTracker(ContourFit(model.pose_tree())),
        load_landmarks(model.path),
    )
    state = tracker.start(tracker.values(frames[0].q))
    known: KnownColours = {}
    errors, lost, seconds = [], [], []
    for k, frame in enumerate(frames):
        start = time.process_time()
        if by_colour:
            views = ColourViews(cameras, frame.pictures, known)
            regions = None
            if k > 0:
                state = tracker.follow_by_colour(state, views)
            else:
                pairs = zip(cameras, frame.masks, strict=True)
                regions = {camera.name: mask for camera, mask in pairs}
            if not state.is_lost:
                known = views.learned(tracker.fit, state.values, regions)
        else:
            seen = [
                see_silhouette(mask, edge_spacing(camera))
                for camera, mask in zip(cameras, frame.masks, strict=True)
            ]
            state = tracker.follow(state, FrameViews(cameras, seen)) or state
        seconds.append(time.process_time() - start)
        places = [
            np.array(landmark_positions(model, landmarks, q))
            for q in (tracker.positions(state.values), frame.q)
        ]
        errors.append(1e3 * np.linalg.norm(places[0] - places[1], axis=1))
        lost.append(state.is_lost)
    milliseconds = 1e3 * float(np.median(seconds[1:]))
    return PersonOutcome(np.array(errors[1:]), np.array(lost[1:]), milliseconds)


def measure_room(
    model: ArticulatedModel, room: Room, seed: int, count: int
) -> tuple[PersonOutcome, PersonOutcome]:
    """Follows a person before one room by exact masks and by colour.

    Args:
        model: the person.
        room: what stands about the person.
        seed: of the room and the motion.
        count: how many frames.
    """
    with tempfile.TemporaryDirectory() as folder:
        scene = PersonColourScene(model, room, seed, Path(folder))
        frames = list(scene.frames(count))
    masks = follow_person(model, scene.cameras, frames, False)
    return masks, follow_person(model, scene.cameras, frames, True)


def person_table(seed: int, count: int) -> Table:
    """Errors of each room's run; arguments as of measure_room."""
    model = load_model(bundled_model("person"), check=False)
    table = Table(
        title=f"{count - 1} frames, seed {seed}; joint centres off by mm, mean / 95th percentile"
    )
    for heading in ("", "masks", "colour", "ratio", "lost", "wrong", "not said",
                    "CPU ms, masks", "colour"):  # fmt: skip
        table.add_column(heading, justify="right" if heading else "left")
    for room in ROOMS:
        masks, colour = measure_room(model, room, seed, count)
        table.add_row(
            room.name.replace("arm", "person"),
            *(f"{one.errors.mean():.1f} / {np.percentile(one.errors, 95):.1f}"
              for one in (masks, colour)),
            f"{colour.errors.mean() / masks.errors.mean():.1f}",
            str(np.count_nonzero(colour.lost)),
            str(np.count_nonzero(colour.wrong)),
            str(np.count_nonzero(colour.wrong & ~colour.lost)),
            f"{masks.milliseconds:.0f}",
            f"{colour.milliseconds:.0f}",
        )  # fmt: skip
    return table


def main() -> None:
    """Print how well a person is followed by colour alone."""
    parser = argparse.ArgumentParser(description="A person by colour: errors and times.")
    parser.add_argument("--seed", type=int, default=0, help="of the rooms and the motion")
    parser.add_argument("--frames", type=int, default=60, help="of each run")
    asked = parser.parse_args()
    Console(width=160).print(person_table(asked.seed, asked.frames))


if __name__ == "__main__":
    main()
