"""Benchmark of tracking by colour: an arm or a person that moves before rooms, beside exact masks.

Run as ``python -m tests.benchmarks.colour [MODEL] [--seed N] [--frames N] [--size W H] [--easy]``;
MODEL is the file of an arm, such as the LBR Med 7's, which two cameras see; without it the bundled
person walks about, turns and swings arms and legs before four. Drake's renderer draws them before
textured walls; each row of the table is one run of one motion, the seed is of motion and room.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Cylinder,
    GeometryId,
    LightParameter,
    MakeRenderEngineVtk,
    PerceptionProperties,
    QueryObject,
    RenderEngineVtkParams,
    RenderLabel,
    Rgba,
    Role,
    Shape,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import RigidBody, SpatialInertia
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.landmarks import landmark_positions, load_landmarks
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.camera.drake import camera_to_drake
from drake_pose.camera.models import PinholeCamera
from drake_pose.camera.rigs import circle_of_cameras, look_at
from drake_pose.files.settings import EstimateSettings
from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.tracking.contour_tracker import ContourTracker
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.jobs.estimate.searches import make_tree
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.views import (
    ColourViews,
    FrameViews,
    KnownColours,
    edge_spacing,
    see_silhouette,
)
from tests.benchmarks.scenes import print_table

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Swing = tuple[Array, Array, Array, Array]
"""Middles and amplitudes [rad or m], speeds [rad/s] and phases [rad]."""

_SIZE, _RATE = (640, 480), 30.0
# The focal length of pictures, over their height.
_FOCAL = 1.25
_EYES = ((2.1, -1.4, 1.1), (1.9, 1.7, 1.2))
_RENDERER = "colour"
_OTHERS = RenderLabel(2000)
# Sides of walls and where they stand [m].
_WALLS = (
    ((8.0, 8.0, 0.1), (0.0, 0.0, -0.06)),
    ((0.1, 8.0, 6.0), (-3.0, 0.0, 2.0)),
    ((0.1, 8.0, 6.0), (3.0, 0.0, 2.0)),
    ((8.0, 0.1, 6.0), (0.0, 3.0, 2.0)),
    ((8.0, 0.1, 6.0), (0.0, -3.0, 2.0)),
)
_LIGHTS = (((-0.4, 0.5, -1.0), 0.8), ((0.5, -0.6, -0.3), 0.5))
_ORANGE, _BRIGHT = (0.95, 0.45, 0.1), (0.85, 0.85, 0.83)
_COLOURS = (
    _BRIGHT, _ORANGE, _BRIGHT, _ORANGE, (0.8, 0.8, 0.8), _ORANGE, (0.3, 0.3, 0.32),
    (0.6, 0.6, 0.62),
)  # fmt: skip
_GREYS = ((0.8,) * 3, (0.65,) * 3, (0.7,) * 3, (0.55,) * 3)
_SPEED, _FASTEST = 2.8, 4.0
_BOXES = 6
# How far a person walks [m], stands at rest [m], turns and swings [rad].
_WALK, _RISE, _HEIGHT, _TURN, _NOD, _SWING = 0.25, 0.05, 1.55, 0.8, 0.15, 0.9
# A frame is wrong where a joint is off by more [degrees], or a person's joint centre [mm].
_WRONG_JOINT, _WRONG_CENTRE = 10.0, 150.0


@dataclass(frozen=True)
class Room:
    """What stands about a body: grey or coloured, a pixel's noise (of 255), how many boxes move
    about behind it, and whether a post moves between it and the cameras.
    """

    name: str
    grey: bool = False
    noise: float = 0.0
    boxes: int = 0
    post: bool = False


ROOMS = (
    Room("orange and grey arm, room of many colours"),
    Room("boxes move about behind the arm", boxes=_BOXES),
    Room("a post moves between the arm and the cameras", post=True),
    Room("noise of 12 of 255 on every pixel", noise=12.0),
    Room("grey arm before a grey room", grey=True),
)


class Frame(NamedTuple):
    """The truth (nq,), and each camera's picture and exact mask of a moment."""

    q: Array
    pictures: list[Picture]
    masks: list[Mask]


class Outcome(NamedTuple):
    """How one sequence was followed.

    errors: (frames, joints) of joints [degrees], or of a person's joint centres [mm]; deviations:
    the same as the tracker says, nan of a person; lost: (frames,) whether the track was said to be;
    milliseconds: of the processor, a frame; limit: what is wrong is off by more.
    """

    errors: Array
    deviations: Array
    lost: Mask
    milliseconds: float
    limit: float

    @property
    def inside(self) -> tuple[float, float]:
        """The ratio of truths within two standard deviations; that in frames not said lost."""
        held = self.errors < 2.0 * self.deviations
        kept = held[~self.lost]
        return float(held.mean()), float(kept.mean()) if kept.size else 0.0

    @property
    def wrong(self) -> Mask:
        """(frames,) where a joint is far off."""
        return np.asarray(self.errors.max(axis=1) > self.limit)


def arm_swing(model: ArticulatedModel, rng: np.random.Generator) -> Swing:
    """Of all joints, as fast as may be."""
    n = len(model.position_names)
    low, high = np.maximum(model.lower, -2.9), np.minimum(model.upper, 2.9)
    amplitude = rng.uniform(0.5, 0.9, n) * np.minimum(0.45 * (high - low), 1.2)
    middle = (low + high) / 2 + rng.uniform(-0.2, 0.2, n)
    speed = np.minimum(rng.uniform(0.5, 1.0, n) * _SPEED / amplitude, _FASTEST)
    return middle, amplitude, speed, rng.uniform(0.0, 2.0 * np.pi, n)


def person_swing(model: ArticulatedModel, rng: np.random.Generator) -> Swing:
    """Who walks about, turns, and swings arms and legs."""
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
            amplitude[k] = rng.uniform(0.4, 1.0) * min(0.35 * (high[k] - low[k]), _SWING)
            ends = low[k] + amplitude[k], high[k] - amplitude[k]
            middle[k] = np.clip(0.25 * (low[k] + high[k]), *ends)
            speed[k] = rng.uniform(1.5, 3.0)
    return middle, amplitude, speed, rng.uniform(0.0, 2.0 * np.pi, n)


class ColourScene:
    """A person or an arm that moves before a room, drawn by Drake; textures lie in a folder."""

    def __init__(
        self,
        model: ArticulatedModel,
        room: Room,
        seed: int,
        folder: Path,
        size: tuple[int, int] = _SIZE,
    ) -> None:
        self._model, self._rng, self._room = model, np.random.default_rng(seed), room
        self._folder = folder
        self._joints, self._default = len(model.position_names), model.default_positions
        self.cameras: Mapping[str, PinholeCamera]
        if is_person(model):
            field = np.radians(50.0)
            self.cameras = circle_of_cameras(
                4, radius=2.6, field_of_view=field, face_camera=False, size=size
            )
        else:
            lens = (_FOCAL * size[1],) * 2 + (size[0] / 2 - 0.5, size[1] / 2 - 0.5)
            poses = {f"camera{k}": look_at(eye, (0.0, 0.0, 0.5)) for k, eye in enumerate(_EYES)}
            self.cameras = {n: PinholeCamera(n, *size, *lens, X) for n, X in poses.items()}
        builder = DiagramBuilder()
        self._plant, self._scene = AddMultibodyPlantSceneGraph(builder, 0.0)
        model.add_to(self._plant, self._scene)
        self._paint(model)
        self._add_walls()
        self._boxes = []
        for k in range(room.boxes):
            shape, colour = Box(*self._rng.uniform(0.3, 0.9, 3)), self._rng.random(3)
            self._boxes.append(self._add_body(f"box{k}", shape, colour))
        self._post = None
        if room.post:
            self._post = self._add_body("post", Cylinder(0.05, 1.5), (0.2, 0.5, 0.25))
        lights = [
            LightParameter(type="directional", frame="world", direction=list(way), intensity=much)
            for way, much in _LIGHTS
        ]
        engine = MakeRenderEngineVtk(RenderEngineVtkParams(lights=lights))
        self._scene.AddRenderer(_RENDERER, engine)
        self._plant.Finalize()
        # An arm that stands on a floating base stays there.
        bases = [self._plant.get_body(k) for k in self._plant.GetFloatingBaseBodies()]
        starts = [base.floating_positions_start() for base in bases]
        self._held = [k for start in starts for k in range(start, start + 7) if k < self._joints]
        self._diagram: Diagram = builder.Build()

    def frames(self, count: int) -> Iterator[Frame]:
        """The frames of the motion, drawn one by one."""
        draw_swing = person_swing if is_person(self._model) else arm_swing
        middle, amplitude, speed, phase = draw_swing(self._model, self._rng)
        # Of each box: the middle and the amplitude [m], speed [rad/s] and phase [rad].
        ends = ((-2.5, 2.5), (0.5, 1.5), (1.0, 2.5), (0.0, 6.0))
        paths = [[self._rng.uniform(*end, 3) for end in ends] for _ in self._boxes]
        context = self._diagram.CreateDefaultContext()
        own = self._plant.GetMyMutableContextFromRoot(context)
        query = self._scene.get_query_output_port()
        for k in range(count):
            moment = k / _RATE
            q = middle + amplitude * np.sin(speed * moment + phase)
            q[self._held] = self._default[self._held]
            positions = self._plant.GetPositions(own).copy()
            positions[: self._joints] = q
            self._plant.SetPositions(own, positions)
            for body, path in zip(self._boxes, paths, strict=True):
                self._plant.SetFreeBodyPose(own, body, RigidTransform(_behind(path, moment)))
            if self._post is not None:
                across = [0.8, -1.0 + 1.6 * k / count, 0.6]
                self._plant.SetFreeBodyPose(own, self._post, RigidTransform(across))
            yield self._draw(q, query.Eval(self._scene.GetMyContextFromRoot(context)))

    def _draw(self, q: Array, query: QueryObject) -> Frame:
        """What the cameras see."""
        pictures, masks, world = [], [], self._scene.world_frame_id()
        for camera in self.cameras.values():
            color, _, X_WC = camera_to_drake(camera, renderer_name=_RENDERER)
            picture = query.RenderColorImage(color, world, X_WC).data[..., :3].copy()
            labels = query.RenderLabelImage(color, world, X_WC).data[..., 0]
            if self._room.noise:
                noisy = picture + self._rng.normal(0.0, self._room.noise, picture.shape)
                picture = noisy.clip(0, 255).astype(np.uint8)
            pictures.append(picture)
            masks.append((labels < int(_OTHERS) // 2) & (labels >= 0))
        return Frame(q, pictures, masks)

    def _paint(self, model: ArticulatedModel) -> None:
        """Gives the arm's links colours in turn."""
        inspector = self._scene.model_inspector()
        order = {name: k for k, name in enumerate(model.link_meshes)}
        colours = _GREYS if self._room.grey else _COLOURS
        for geometry in inspector.GetAllGeometryIds(Role.kPerception):
            link = inspector.GetName(inspector.GetFrameId(geometry)).split("::")[-1]
            if link in order:
                seen = PerceptionProperties(inspector.GetPerceptionProperties(geometry))
                colour = colours[order[link] % len(colours)]
                seen.UpdateProperty("phong", "diffuse", Rgba(*colour, 1.0))
                self._assign(geometry, seen)

    def _assign(self, geometry: GeometryId, seen: PerceptionProperties) -> None:
        source = self._plant.get_source_id()
        self._scene.RemoveRole(source, geometry, Role.kPerception)
        self._scene.AssignRole(source, geometry, seen)

    def _show(self, body: RigidBody, X: RigidTransform, shape: Shape, colour: Sequence[float],
              texture: Path | None = None) -> None:  # fmt: skip
        """Something that is no part of the arm."""
        name = f"shape{len(self._scene.model_inspector().GetAllGeometryIds())}"
        geometry = self._plant.RegisterVisualGeometry(body, X, shape, name, np.ones(4))
        seen = PerceptionProperties()
        seen.AddProperty("label", "id", _OTHERS)
        seen.AddProperty("phong", "diffuse", Rgba(*colour, 1.0))
        if texture is not None:
            seen.AddProperty("phong", "diffuse_map", str(texture))
        self._assign(geometry, seen)

    def _add_walls(self) -> None:
        for k, (sides, place) in enumerate(_WALLS):
            path = self._folder / f"wall{k}.png"
            _write_texture(path, self._rng, self._room.grey)
            world = self._plant.world_body()
            self._show(world, RigidTransform(place), Box(*sides), (1.0,) * 3, path)

    def _add_body(self, name: str, shape: Shape, colour: Sequence[float]) -> RigidBody:
        inertia = SpatialInertia.SolidBoxWithDensity(1.0, 0.1, 0.1, 0.1)
        body = self._plant.AddRigidBody(name, self._plant.AddModelInstance(name), inertia)
        self._show(body, RigidTransform(), shape, colour)
        return body


def _behind(path: Sequence[Array], moment: float) -> Array:
    """(3,) where a box is at a moment [s]: on the far side of the arm [m]."""
    middle, amplitude, speed, phase = path
    p_W = middle + [0.0, 0.0, 1.0] + amplitude * np.sin(speed * moment + phase)
    angle = np.pi + 0.8 * (np.arctan2(p_W[1], p_W[0]) % np.pi - np.pi / 2)
    return np.array([2.2 * np.cos(angle), 2.2 * np.sin(angle), p_W[2]])


def _write_texture(path: Path, rng: np.random.Generator, grey: bool) -> None:
    """Clouds of all sizes with sixty rectangles before them."""
    side, picture = 1024, np.zeros((1024, 1024, 3))
    for k in (4, 16, 64, 256):
        clouds = cv2.resize(rng.random((k, k, 3)), (side, side), interpolation=cv2.INTER_CUBIC)
        picture += clouds / (1.0 + np.log2(k) / 4.0)
    picture = (picture - picture.min()) / (picture.max() - picture.min())
    for _ in range(60):
        corner = rng.integers(0, side, 2)
        other = corner + rng.integers(20, 200, 2)
        colour = tuple(rng.random(3).tolist())
        cv2.rectangle(picture, tuple(corner.tolist()), tuple(other.tolist()), colour, -1)
    if grey:
        picture = np.repeat(picture.mean(axis=2, keepdims=True), 3, axis=2) * 0.35 + 0.45
    cv2.imwrite(str(path), (picture * 255.0).clip(0, 255).astype(np.uint8))


def is_person(model: ArticulatedModel) -> bool:
    """Whether it is the bundled person, who is followed as one."""
    return model.path == bundled_model("person")


def follow_arm(
    observation: ContourObservation, frames: Sequence[Frame], by_colour: bool
) -> Outcome:
    """Follows an arm that is known in the first frame, by its colours or by exact masks.

    The last joint is left out: the flange is round.
    """
    tracker = ContourTracker(observation, 1.0 / _RATE)
    track = tracker.start(observation.state(frames[0].q))
    # A base stays where it is.
    joints = np.flatnonzero(np.ptp([frame.q for frame in frames], axis=0) > 0.0)[:-1]
    errors, deviations, lost, seconds = [], [], [], []
    for k, frame in enumerate(frames):
        masks = [None] * len(frame.masks) if by_colour else frame.masks
        start = time.process_time()
        track = tracker.follow(track, masks, k == 0, pictures=frame.pictures if by_colour else None)
        seconds.append(time.process_time() - start)
        belief = track.state.best
        errors.append(np.abs(observation.positions(belief.mean)[0] - frame.q)[joints])
        deviations.append(belief.deviations()[: len(joints)])
        lost.append(track.lost)
    every = np.degrees(errors[1:]), np.degrees(deviations[1:]), np.array(lost[1:])
    return Outcome(*every, 1e3 * float(np.median(seconds[1:])), _WRONG_JOINT)


def follow_person(
    model: ArticulatedModel,
    cameras: Sequence[PinholeCamera],
    frames: Sequence[Frame],
    by_colour: bool,
) -> Outcome:
    """Follows a person who is known in the first frame, whose masks are given in both cases."""
    tracker = PersonPoseTracker(ContourFit(model.pose_tree()))
    landmarks = load_landmarks(model.path)
    state = tracker.start(tracker.values(frames[0].q))
    known: KnownColours = {}
    errors, lost, seconds = [], [], []
    for k, frame in enumerate(frames):
        start = time.process_time()
        pairs = list(zip(cameras, frame.masks, strict=True))
        if by_colour:
            views = ColourViews(cameras, frame.pictures, known)
            if k > 0:
                state = tracker.follow_by_colour(state, views)
            regions = None if k else {camera.name: mask for camera, mask in pairs}
            if not state.is_lost:
                known = views.learned(tracker.fit, state.values, regions)
        else:
            seen = [see_silhouette(mask, edge_spacing(camera)) for camera, mask in pairs]
            state = tracker.follow(state, FrameViews(cameras, seen)) or state
        seconds.append(time.process_time() - start)
        places = [
            np.array(landmark_positions(model, landmarks, q))
            for q in (tracker.positions(state.values), frame.q)
        ]
        errors.append(1e3 * np.linalg.norm(places[0] - places[1], axis=1))
        lost.append(state.is_lost)
    off = np.array(errors[1:])
    spent = 1e3 * float(np.median(seconds[1:]))
    return Outcome(off, np.full(off.shape, np.nan), np.array(lost[1:]), spent, _WRONG_CENTRE)


def measure_room(
    model: ArticulatedModel, room: Room, seed: int, count: int, size: tuple[int, int] = _SIZE
) -> tuple[Outcome, Outcome]:
    """Follows an arm or a person before one room, by exact masks and by colour."""
    with tempfile.TemporaryDirectory() as folder:
        scene = ColourScene(model, room, seed, Path(folder), size)
        frames = list(scene.frames(count))
    cameras = tuple(scene.cameras.values())
    if is_person(model):
        masks = follow_person(model, cameras, frames, False)
        return masks, follow_person(model, cameras, frames, True)
    observation = ContourObservation(make_tree(model, EstimateSettings(), None), cameras)
    follow_arm(observation, frames[:2], True)
    return follow_arm(observation, frames, False), follow_arm(observation, frames, True)


def _row(name: str, masks: Outcome, colour: Outcome) -> tuple[str, ...]:
    both = (masks, colour)
    errors = [(np.mean(x.errors), np.median(x.errors), np.percentile(x.errors, 95)) for x in both]
    return (
        name,
        *(f"{mean:.1f}, {median:.2f}, {p95:.1f}" for mean, median, p95 in errors),
        *(f"{ratio:.2f}" for ratio in colour.inside),
        str(np.count_nonzero(colour.lost)),
        str(np.count_nonzero(colour.wrong)),
        str(np.count_nonzero(colour.wrong & ~colour.lost)),
        *(f"{one.milliseconds:.0f}" for one in both),
    )


def main() -> None:
    """Print how well an arm or a person is followed by colour alone, and when it is said lost."""
    parser = argparse.ArgumentParser(description="Tracking by colour: errors and times.")
    parser.add_argument("model", type=Path, nargs="?", help="the model file of an arm")
    parser.add_argument("--seed", type=int, default=0, help="of the rooms and the motion")
    parser.add_argument("--frames", type=int, help="of each run")
    parser.add_argument("--size", type=int, nargs=2, default=_SIZE, help="of the pictures [pixel]")
    parser.add_argument("--easy", action="store_true", help="the first room alone")
    asked = parser.parse_args()
    model = load_model(asked.model or bundled_model("person"), check=False)
    frames = asked.frames or (90 if asked.model else 60)
    rows = [
        _row(room.name, *measure_room(model, room, asked.seed, frames, tuple(asked.size)))
        for room in (ROOMS[:1] if asked.easy else ROOMS)
    ]
    unit = "degrees" if asked.model else "mm"
    print_table(
        f"{frames - 1} frames, seed {asked.seed}; errors in {unit}: mean, median, p95",
        ("", "masks", "colour", "within 2 sd", "not lost", "lost", "wrong", "not said",
         "CPU ms, masks", "colour"),
        rows,
    )  # fmt: skip


if __name__ == "__main__":
    main()
