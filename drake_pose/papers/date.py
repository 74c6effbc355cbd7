"""Experiments of Date et al.: a simulated person with known motion, many cameras.

Section 6.1 compares the paper's inverse kinematics alone, with the search, and one fit to all
silhouettes. Section 6.2 (figure 8) is a walk through a virtual place by gestures.
"""

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import RenderEngineVtkParams
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, TrajectorySource
from pydrake.systems.sensors import ImageRgba8U
from rich.table import Table

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import (
    ArticulatedModel,
    bundled_model,
    landmarks_of_nodes,
    load_landmarks,
    load_model,
)
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import FACE_CAMERA, PinholeCamera, circle_of_cameras, look_at
from drake_pose.errors import SettingsError, require_choice
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.papers.tables import Count, figure_table, uncounted
from drake_pose.person.date.skeleton import LIMBS, Skeleton, load_skeleton
from drake_pose.person.date.walking import (
    COMMANDS,
    REGISTERED,
    UPRIGHT,
    Motion,
    make_gestures,
    make_motion,
)
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.silhouette.segmentation import Background, learn_background
from drake_pose.systems.bodies import add_posed_plant, held_positions
from drake_pose.systems.cameras import (
    CameraRig,
    add_sensors,
    build_camera_rig,
    colour_image_to_picture,
    picture_to_colour_image,
)
from drake_pose.systems.date import CaptureSetup, build_paper_capture, prepare_paper_capture
from drake_pose.systems.person import (
    PersonTracker,
    Walker,
    add_garden,
    build_silhouette_capture,
    view_from_behind,
    walker_transform,
)
from drake_pose.systems.ports import StagedDiagram

# A power of two, so that frame times and the predicted motion are exact.
PERIOD = 1.0 / 32.0
"""Time between frames [s]."""

Images = Mapping[str, ImageRgba8U]

SHOWN_CAMERA = "camera_0"
TITLES = {
    "ik_only": "the paper's IK alone",
    "paper": "the paper's search",
    "silhouette": "all silhouettes",
}
"""Names of the methods in tables."""


@contextmanager
def one_core() -> Iterator[None]:
    """Limit OpenCV to one thread, as all other measured code."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


@dataclass(frozen=True, eq=False)
class Studio:
    """Simulated person before cameras."""

    # model, skeleton: of the person.
    model: ArticulatedModel
    skeleton: Skeleton
    cameras: Mapping[str, PinholeCamera]  # By name, the face camera included.
    # rig, context: diagram that renders the cameras' pictures, and its context.
    rig: CameraRig
    context: Context
    # Learnt from noisy pictures without the person, by camera.
    backgrounds: Mapping[str, Background]
    generator: np.random.Generator  # Of the pictures' noise.

    @staticmethod
    def build(cameras: int, size: tuple[int, int], generator: np.random.Generator) -> "Studio":
        """Build a studio.

        ``cameras``: number of cameras, including the face camera. ``size``: width and height of the
        pictures [pixel]. ``generator``: of the pictures' noise. Raises SettingsError: there are
        fewer than three cameras.
        """
        if cameras < 3:
            raise SettingsError(f"cameras must be 3 or more, not {cameras}")
        model = load_model(bundled_model("person"), check=False)
        placed = circle_of_cameras(cameras - 1, size=size)
        rig = build_camera_rig(model, placed)
        context = rig.diagram.CreateDefaultContext()
        absent = np.array(model.default_positions)
        absent[model.position_index("position_z")] = -9.0
        rig.set_positions(context, absent)
        empty = {name: rig.picture(context, name) for name in placed}
        backgrounds = {
            name: learn_background([noisy(picture, generator) for _ in range(5)])
            for name, picture in empty.items()
        }
        skeleton = load_skeleton(model)
        return Studio(model, skeleton, placed, rig, context, backgrounds, generator)

    def pictures(self, q: Array) -> dict[str, Picture]:
        """Return the noisy pictures (H, W, 3) by camera of a person at q (nq,) [rad, m]."""
        self.rig.set_positions(self.context, q)
        pictures = {name: self.rig.picture(self.context, name) for name in self.cameras}
        return {name: noisy(shot, self.generator) for name, shot in pictures.items()}

    def prepare(self, q: Array) -> CaptureSetup:
        """Prepare the paper's method: register a person in the registered pose q (nq,)."""
        pictures = self.pictures(q)
        return prepare_paper_capture(
            self.model, self.cameras, FACE_CAMERA, q, pictures, self.backgrounds
        )

    def mask_at(self, q: Array, camera: str) -> Mask:
        """Return the named camera's silhouette (H, W) of a person at q (nq,)."""
        self.rig.set_positions(self.context, q)
        return self.rig.mask(self.context, camera)


def noisy(picture: Picture, generator: np.random.Generator, deviation: float = 3.0) -> Picture:
    """Add Gaussian noise of standard deviation `deviation` [grey levels] to a picture (H, W, 3)."""
    # OpenCV's 16-bit noise is precise enough, and four times as fast as doubles.
    noise = np.empty(picture.shape, dtype=np.int16)
    cv2.setRNGSeed(int(generator.integers(1 << 31)))
    cv2.randn(noise, np.zeros(3), np.full(3, deviation))
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


class _Track:
    """A method's diagram run frame by frame.

    Attributes:
        milliseconds: processor times of each frame by stage [ms].
    """

    def __init__(self, capture: StagedDiagram[Any]) -> None:
        self.milliseconds: list[Mapping[str, float]] = []
        self._capture = capture
        self._simulator = Simulator(capture.diagram)
        self._frames = 0

    @property
    def context(self) -> Context:
        """The diagram's context."""
        return self._simulator.get_mutable_context()

    def _process(self, images: Images) -> None:
        """Evaluate all stages for a frame's images, by camera, and store their processor times."""
        # Advance to just before the frame's update, which reads the images fixed then.
        if self._frames:
            self._simulator.AdvanceTo(PERIOD * self._frames)
        self._frames += 1
        for name, image in images.items():
            port = self._capture.diagram.GetInputPort(f"color_image_{name}")
            port.FixValue(self.context, AbstractValue.Make(image))
        laps, last = {}, time.process_time()
        for stage in (*self._capture.stages, "pose"):
            if stage == "pose":
                self._simulator.AdvancePendingEvents()
            else:
                self._capture.evaluate(self.context, stage)
            now = time.process_time()
            laps[stage], last = 1e3 * (now - last), now
        self.milliseconds.append(laps)


class PaperTrack(_Track):
    """Track of the paper's method; frames that recognise the registered pose store no times."""

    def __init__(self, setup: CaptureSetup) -> None:
        super().__init__(build_paper_capture(setup, period=PERIOD))

    def step(self, images: Images) -> Array:
        """Process a frame's images, by camera; return its positions (nq,) [rad, m].

        Raises SettingsError: the registered pose was not recognised in the first frame.
        """
        self._process(images)
        diagram = self._capture.diagram
        q = np.array(diagram.GetOutputPort("estimated_positions").Eval(self.context))
        if not np.isfinite(q).all():
            raise SettingsError(
                "the registered pose was not recognised in the first frame: take more cameras, or "
                "larger pictures"
            )
        if diagram.GetOutputPort("similarity").Eval(self.context)[0]:
            self.milliseconds.pop()
        return q

    def middle_joints(self) -> Array:
        """Return elbows and knees (4, 3) [m] of the last frame, as LIMBS; nan: registered pose."""
        port = self._capture.diagram.GetOutputPort("limb_points")
        return np.array(port.Eval(self.context)).reshape(len(LIMBS), 3, 3)[:, 1]


class SilhouetteTrack(_Track):
    """Track of all silhouettes at once; edge points are 8 rows of a 480-row picture apart."""

    def __init__(self, studio: Studio) -> None:
        tracker = PersonPoseTracker(ContourFit(studio.model.pose_tree()))
        cameras, backgrounds = studio.cameras, studio.backgrounds
        super().__init__(
            build_silhouette_capture(tracker, cameras, backgrounds, PERIOD, edge_points=60.0)
        )
        self._tracker = tracker

    def step(self, images: Images) -> Array:
        """Process a frame's images, by camera; return its positions (nq,), even if lost.

        Raises SettingsError: fewer than two cameras saw the person in the first frame.
        """
        self._process(images)
        person: PersonTracker = self._capture.estimator
        state = person.known_person(person.GetMyContextFromRoot(self.context))
        if state is None:
            raise SettingsError("fewer than two cameras saw a person in the first frame")
        return self._tracker.positions(state.values)

    def place(self, q: Array) -> None:
        """Set the person's positions to q (nq,)."""
        person: PersonTracker = self._capture.estimator
        state = self._tracker.start(self._tracker.values(q), is_known=True)
        person.set_person(person.GetMyMutableContextFromRoot(self.context), state)


MotionSample = tuple[Picture, Array, Mapping[str, tuple[Array, Mask]]]
"""The middle frame of a motion in the shown camera, for pictures: the picture (H, W, 3); (4, 3, 2)
true root, middle joint and end of LIMBS [pixel]; and by method, the same of the estimate, and its
silhouette (H, W)."""


class DateResult:
    """Measurements of the experiment, frame by frame; see run_experiment.

    Args:
        studio: simulated person and cameras.
        motion: true positions and motion of each frame.
        method: leading method, "paper" or "silhouette".

    Attributes:
        names: (n,) motion of each frame.
        errors: by method: (k,) errors of the joint centres in each frame [mm].
        found_errors: by paper's method: (4,) errors of elbows and knees in each frame, in the order
            of LIMBS, before the model with its rigid trunk is fitted to them [mm]; nan where the
            registered pose was recognised instead.
        face_errors: angle between true and estimated direction of the head in each frame [deg].
        samples: by motion, the frame for pictures.
    """

    def __init__(self, studio: Studio, motion: Motion, method: str) -> None:
        self.studio, self.names = studio, motion.names
        self._motion, self._method = motion, method
        places = [np.flatnonzero(np.array(self.names) == name) for name in self.motions]
        self._middles = {int(one[len(one) // 2]) for one in places}
        setup = studio.prepare(motion.q[0])
        alone = replace(setup, search=False)
        self._tracks: dict[str, PaperTrack | SilhouetteTrack] = {
            "ik_only": PaperTrack(alone),
            "paper": PaperTrack(setup),
        }
        if method == "silhouette":
            self._tracks[method] = SilhouetteTrack(studio)
        landmarks, tree = load_landmarks(studio.model.path), studio.model.pose_tree()
        del landmarks["head_top"]
        self._kinematics = TreeKinematics(tree)
        self._landmarks = landmarks_of_nodes(tree, landmarks)
        self.errors: dict[str, list[Array]] = {method: [] for method in self._tracks}
        self.found_errors: dict[str, list[Array]] = {"ik_only": [], "paper": []}
        self.face_errors: list[float] = []
        self.samples: dict[str, MotionSample] = {}

    def step(self, k: int) -> None:
        """Process frame k of the motion; frames must come in order."""
        studio, q = self.studio, self._motion.q[k]
        pictures = studio.pictures(q)
        images = {name: picture_to_colour_image(shot) for name, shot in pictures.items()}
        estimates = {}
        for method, track in self._tracks.items():
            estimates[method] = track.step(images)
            places = [
                self._landmarks.positions(self._kinematics.poses(one[studio.skeleton.order]))
                for one in (estimates[method], q)
            ]
            self.errors[method].append(1e3 * np.linalg.norm(places[0] - places[1], axis=1))
            if isinstance(track, PaperTrack):
                true = [studio.skeleton.limb_points(q, name)[1] for name in LIMBS]
                error = 1e3 * np.linalg.norm(track.middle_joints() - true, axis=1)
                self.found_errors[method].append(error)
        heads = [studio.skeleton.head_rotation(one)[:, 2] for one in (estimates[self._method], q)]
        cosine = float(np.clip(heads[0] @ heads[1], -1.0, 1.0))
        self.face_errors.append(math.degrees(math.acos(cosine)))
        if k in self._middles:
            captured = {
                method: (self._limbs_seen(one), studio.mask_at(one, SHOWN_CAMERA))
                for method, one in estimates.items()
            }
            picture, limbs = pictures[SHOWN_CAMERA], self._limbs_seen(q)
            self.samples[self.names[k]] = picture, limbs, captured

    def _limbs_seen(self, q: Array) -> Array:
        """Return MotionSample's limbs (4, 3, 2) [pixel] of a person at q (nq,)."""
        camera, skeleton = self.studio.cameras[SHOWN_CAMERA], self.studio.skeleton
        return np.array([camera.project(skeleton.limb_points(q, name))[0] for name in LIMBS])

    @property
    def motions(self) -> tuple[str, ...]:
        """Motions that were shown."""
        return tuple(name for name in dict.fromkeys(self.names) if name != REGISTERED)

    def milliseconds(self, method: str) -> dict[str, float]:
        """Return a frame's median processor times [ms], of all cameras, by stage and as "all"."""
        laps = self._tracks[method].milliseconds
        names = dict.fromkeys(name for lap in laps for name in lap)
        stages = {name: float(np.median([lap.get(name, 0.0) for lap in laps])) for name in names}
        return {**stages, "all": sum(stages.values())}

    def as_json(self) -> dict[str, object]:
        """Return the figures by key, over all frames but those of the registered pose."""
        leading = np.array(self.errors[self._method])[np.isin(self.names, self.motions)]
        all_motions = self._of_motions(self.motions)
        return {
            "joint_error_mm": _mean(leading),
            "joint_error_p95_mm": float(np.percentile(leading, 95)),
            "ik_only_mm": all_motions["ik_only_mm"],
            "paper_mm": all_motions["paper_mm"],
            "elbows": self._of_joints("elbow"),
            "knees": self._of_joints("knee"),
            **self._as_found(UPRIGHT),
            "as_found": {motion: self._as_found((motion,)) for motion in self.motions},
            "face_error_deg": all_motions["face_error_deg"],
            "ms_per_frame": self.milliseconds(self._method),
            "motions": {motion: self._of_motions((motion,)) for motion in self.motions},
            "frames": len(self.names),
            "cameras": len(self.studio.cameras),
            "method": self._method,
        }

    def _as_found(self, motions: Sequence[str]) -> dict[str, float]:
        """Return mean errors [mm] of elbows and knees as found, in the frames of some motions.

        Keys are elbow_mm and knee_mm with the search, elbow_ik_mm and knee_ik_mm without; or nan.
        """
        chosen = np.isin(self.names, motions)
        figures = {}
        for method, ending in (("ik_only", "ik_mm"), ("paper", "mm")):
            errors = np.array(self.found_errors[method])[chosen]
            errors = errors[np.isfinite(errors).all(axis=1)]
            for joint, limbs in (("elbow", errors[:, :2]), ("knee", errors[:, 2:])):
                figures[f"{joint}_{ending}"] = _mean(limbs) if len(limbs) else math.nan
        return figures

    def _of_motions(self, motions: Sequence[str]) -> dict[str, float]:
        """Return mean errors in some motions' frames: by method [mm], and the face's [deg]."""
        chosen = np.isin(self.names, motions)
        errors = {
            f"{method}_mm": _mean(np.array(one)[chosen]) for method, one in self.errors.items()
        }
        return {**errors, "face_error_deg": _mean(np.array(self.face_errors)[chosen])}

    def _of_joints(self, ending: str) -> dict[str, float]:
        """Return mean errors [mm] by method, in all motions, of joints with this ending."""
        moving = np.isin(self.names, self.motions)
        chosen = [i for i, name in enumerate(self._landmarks.names) if name.endswith(ending)]
        return {
            f"{method}_mm": _mean(np.array(one)[moving][:, chosen])
            for method, one in self.errors.items()
        }

    def tables(self) -> tuple[Table, Table]:
        """Tabulate each motion's mean errors by method, and those of elbows and knees as found."""
        rows = {motion: self._of_motions((motion,)) for motion in self.motions}
        found = {motion: self._as_found((motion,)) for motion in self.motions}
        headings = {f"{method}_mm": f"{TITLES[method]} [mm]" for method in self.errors}
        found_headings = {
            f"{joint}_{ending}": f"{joint}s, {how}"
            for joint in ("elbow", "knee")
            for ending, how in (("ik_mm", "IK alone"), ("mm", "search"))
        }
        return (
            _table_of_motions(
                f"Date: {len(self.studio.cameras)} cameras, {len(self.names)} frames",
                {**rows, "all": self._of_motions(self.motions)},
                {**headings, "face_error_deg": "face [deg]"},
                "{:.1f}",
            ),
            _table_of_motions(
                "Elbows and knees as found, in mm",
                {**found, "upright": self._as_found(UPRIGHT)},
                found_headings,
                "{:.0f}",
            ),
        )

    def costs(self) -> str:
        """Describe in words the times of a frame [ms]."""
        *stages, (_, whole) = self.milliseconds(self._method).items()
        parts = ", ".join(f"{name} {spent:.1f}" for name, spent in stages)
        return (
            f"One core, {TITLES[self._method]}: {whole:.1f} ms a frame ({parts}), "
            f"{1e3 / whole:.0f} frames a second."
        )


def run_experiment(
    cameras: int,
    frames: int,
    seed: int,
    method: str = "silhouette",
    count: Count = uncounted,
    size: tuple[int, int] = (640, 480),
) -> DateResult:
    """Capture a simulated person on one core.

    Args:
        cameras: number of cameras, including the face camera.
        frames: number of frames, 40 or more.
        seed: of the motions and the noise.
        method: "paper": the paper's methods only; "silhouette": the fit to all silhouettes, too,
            whose figures lead.
        count: reports progress.
        size: width and height of the pictures [pixel].

    Raises SettingsError: an argument is out of range.
    """
    require_choice("method", method, ("silhouette", "paper"))
    with one_core():
        studio = Studio.build(cameras, size, np.random.default_rng([seed, 1]))
        motion = make_motion(studio.skeleton, frames, seed)
        result = DateResult(studio, motion, method)
        advance = count("frames", frames)
        for k in range(len(motion.q)):
            result.step(k)
            advance(k + 1)
    return result


def _table_of_motions(
    title: str, rows: Mapping[str, Mapping[str, float]], headings: Mapping[str, str], form: str
) -> Table:
    """Tabulate figures: a row per motion, a column per figure with its heading, in a ``form``."""
    columns = {
        heading: {motion: figures[key] for motion, figures in rows.items()}
        for key, heading in headings.items()
    }
    return figure_table(title, {motion: (motion, form) for motion in rows}, columns, "motion")


def _mean(values: Array | Sequence[Array]) -> float:
    return float(np.mean(values))


def walk_table(figures: Mapping[str, Any]) -> Table:
    """Tabulate the time for which each command of a walk was active."""
    columns = {
        key: {name: one[f"{key}_s"] for name, one in figures["commands"].items()}
        for key in ("true", "captured", "wrongly")
    }
    end = "{same_command:.1%} of frames equal, final error {place_error_m:.2f} m"
    title = f"Walking through [s]: {end.format(**figures)}"
    return figure_table(title, {k: (k, "{:.2f}") for k in COMMANDS}, columns, "command")


def run_walk_through(
    cameras: int, seed: int, count: Count = uncounted, size: tuple[int, int] = (640, 480)
) -> tuple[dict[str, Any], dict[str, tuple[Picture, Picture]]]:
    """Capture table 1's gestures by the paper's method, and walk by them.

    Args:
        cameras: number of cameras, including the face camera.
        seed: of the pictures' noise.
        count: reports progress.
        size: width and height of the pictures [pixel].
    """
    with one_core():
        studio = Studio.build(cameras, size, np.random.default_rng([seed, 1]))
        motion = make_gestures(studio.skeleton)
        names, model = np.array(motion.names), studio.model
        track = PaperTrack(studio.prepare(motion.q[0]))
        advance, q, pictures_shown = count("frames", len(names)), np.empty_like(motion.q), []
        for k, true_q in enumerate(motion.q):
            seen = studio.pictures(true_q)
            q[k] = track.step({name: picture_to_colour_image(one) for name, one in seen.items()})
            pictures_shown.append(seen[SHOWN_CAMERA])
            advance(k + 1)
    commands, poses, _ = walk_by(model, motion.q)
    found_commands, found_poses, rests = walk_by(model, q)
    error = found_poses[-1] - poses[-1]
    figures = {
        "same_command": float((commands == found_commands).all(axis=1).mean()),
        "commands": command_seconds(commands, found_commands),
        "place_error_m": float(np.linalg.norm(error[:2])),
        "heading_error_deg": abs(math.degrees(math.remainder(error[2], 2.0 * math.pi))),
        "frames": len(names), "cameras": cameras, "seed": seed, "method": "paper",
    }  # fmt: skip
    middles = {name: int(np.median(np.flatnonzero(names == name))) for name in COMMANDS}
    pictures = {
        name: (pictures_shown[k], draw_walk(model, q[k], found_poses[k], rests[k]))
        for name, k in middles.items()
    }
    return figures, pictures


def command_seconds(commands: Array, found: Array) -> dict[str, dict[str, float]]:
    """Return by name of COMMANDS the seconds in which it was active: truly, as found, and wrongly.

    ``commands``, ``found``: (n, 2) true commands and found ones, as of `recognise_command`.
    """
    pairs = zip(active_frames(commands).items(), active_frames(found).values(), strict=True)
    frames = {name: (true, captured, captured & ~true) for (name, true), captured in pairs}
    keys = "true_s", "captured_s", "wrongly_s"
    return {
        name: {key: PERIOD * np.count_nonzero(own) for key, own in zip(keys, three, strict=True)}
        for name, three in frames.items()
    }


def active_frames(commands: Array) -> dict[str, Mask]:
    """Return by name of COMMANDS in which rows (n, 2) of `recognise_command` it is active."""
    turn, walk = commands.T
    return dict(zip(COMMANDS, (turn > 0, turn < 0, walk > 0, walk < 0), strict=True))


def walk_by(model: ArticulatedModel, q: Array) -> tuple[Array, Array, Array]:
    """Simulate a Walker on positions q (n, nq), one frame per PERIOD, walking on the spot.

    Returns (n, 2) commands, as of `recognise_command`; (n, 3) the walker's poses, x, y [m] and
    heading [rad]; and (n, 5) rest stances, as of `stance_of`.
    """
    builder = DiagramBuilder()
    source = builder.AddSystem(TrajectorySource(held_positions(q, PERIOD)))
    walker = builder.AddSystem(Walker(model, PERIOD, on_spot=True))
    builder.Connect(source.get_output_port(), walker.GetInputPort("positions"))
    ports = [walker.GetOutputPort(name) for name in ("command", "walker_pose", "rest")]
    logs = [LogVectorOutput(port, builder, PERIOD) for port in ports]
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(PERIOD * len(q))
    # A value logged at a time is the one before the update at that time.
    commands, poses, rests = (log.FindLog(simulator.get_context()).data()[:, 1:].T for log in logs)
    return commands, poses, rests


def draw_walk(model: ArticulatedModel, q: Array, pose: Array, rest: Array) -> Picture:
    """Render the virtual place from behind the avatar; return the picture (360, 480, 3).

    ``model``: of the avatar. ``q``: (nq,) its positions [rad, m]. ``pose``, ``rest``: (3,) pose of
    the walker and (5,) rest stance, as of `walk_by`.
    """
    X_RP = walker_transform(pose, rest).inverse()
    builder = DiagramBuilder()
    scene_graph = add_garden(builder, X_RP)
    positions = builder.AddSystem(ConstantVectorSource(q)).get_output_port()
    add_posed_plant(builder, scene_graph, model, positions)
    X_RC = X_RP.GetAsMatrix4() @ look_at(*view_from_behind(pose))
    camera = PinholeCamera("view", 480, 360, 384.0, 384.0, 240.0, 180.0, X_RC)
    sky = RenderEngineVtkParams(default_clear_color=np.array([0.65, 0.78, 0.94]))
    sensor = add_sensors(builder, scene_graph, {"view": camera}, {"view": (0.1, 60.0)}, sky)["view"]
    context = builder.Build().CreateDefaultContext()
    image = sensor.color_image_output_port().Eval(sensor.GetMyContextFromRoot(context))
    return colour_image_to_picture(image)
