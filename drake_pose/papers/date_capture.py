"""Simulated studio of Date's experiment, and the tracks of the methods that are compared in it."""

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageRgba8U

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.camera.models import FACE_CAMERA, PinholeCamera, circle_of_cameras
from drake_pose.errors import SettingsError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.date.skeleton import LIMBS, Skeleton, load_skeleton
from drake_pose.person.pose_tracker import PersonPoseTracker, TrackState
from drake_pose.silhouette.segmentation import Background, learn_background
from drake_pose.systems.cameras import CameraRig, build_camera_rig
from drake_pose.systems.date import (
    CaptureSetup,
    PaperPoseEstimator,
    build_paper_capture,
    prepare_paper_capture,
)
from drake_pose.systems.person import PersonTracker, build_silhouette_capture
from drake_pose.systems.ports import StagedDiagram

# A power of two, so that frame times and the predicted motion are exact.
PERIOD = 1.0 / 32.0
"""Time between frames [s]."""


Images = Mapping[str, ImageRgba8U]


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


class _StagedRun:
    """A diagram run frame by frame.

    Attributes:
        milliseconds: processor times of each frame by stage [ms].
    """

    def __init__(self, staged: StagedDiagram[Any]) -> None:
        self.milliseconds: list[Mapping[str, float]] = []
        self._staged = staged
        self._simulator = Simulator(staged.diagram)
        self._frames = 0

    @property
    def context(self) -> Context:
        """The diagram's context."""
        return self._simulator.get_mutable_context()

    def _begin_frame(self) -> None:
        """Advance to just before the next frame's update, which reads the images fixed next."""
        if self._frames:
            self._simulator.AdvanceTo(PERIOD * self._frames)
        self._frames += 1

    def _fix(self, images: Images) -> None:
        """Fix the diagram's colour images, by camera."""
        for name, image in images.items():
            port = self._staged.diagram.GetInputPort(f"color_image_{name}")
            port.FixValue(self.context, AbstractValue.Make(image))

    def _finish_frame(self, stages: Iterable[str]) -> None:
        """Evaluate the stages with these names and "pose", and store their processor times."""
        laps, last = {}, time.process_time()
        for stage in (*stages, "pose"):
            if stage == "pose":
                self._simulator.AdvancePendingEvents()
            else:
                self._staged.evaluate(self.context, stage)
            now = time.process_time()
            laps[stage], last = 1e3 * (now - last), now
        self.milliseconds.append(laps)


class PaperTrack(_StagedRun):
    """Track of the paper's method; frames that recognise the registered pose store no times."""

    def __init__(self, capture: StagedDiagram[PaperPoseEstimator]) -> None:
        super().__init__(capture)
        self._capture = capture

    @staticmethod
    def build(setup: CaptureSetup) -> "PaperTrack":
        """Return a track without a pose, of a prepared method."""
        return PaperTrack(build_paper_capture(setup, period=PERIOD))

    def step(self, images: Images) -> Array:
        """Process a frame's images, by camera; return its positions (nq,) [rad, m].

        Raises SettingsError: the registered pose was not recognised in the first frame.
        """
        self._begin_frame()
        self._fix(images)
        self._finish_frame(self._capture.stages)
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


class SilhouetteTrack(_StagedRun):
    """Track of all silhouettes at once.

    Args:
        capture: diagram of the silhouettes and the tracker.
        tracker: fits the person.
    """

    def __init__(self, capture: StagedDiagram[PersonTracker], tracker: PersonPoseTracker) -> None:
        super().__init__(capture)
        self._capture, self._tracker = capture, tracker

    @staticmethod
    def build(studio: Studio) -> "SilhouetteTrack":
        """Return a track without a pose; edge points are 8 rows of a 480-row picture apart."""
        tracker, views = PersonPoseTracker(ContourFit(studio.model.pose_tree())), studio.cameras
        capture = build_silhouette_capture(tracker, views, studio.backgrounds, PERIOD, 60.0)
        return SilhouetteTrack(capture, tracker)

    def step(self, images: Images) -> Array:
        """Process a frame's images, by camera; return its positions (nq,), even if lost.

        Raises SettingsError: fewer than two cameras saw the person in the first frame.
        """
        self._begin_frame()
        self._fix(images)
        self._finish_frame(self._capture.stages)
        return self._tracker.positions(self._state().values)

    def place(self, q: Array) -> None:
        """Set the person's positions to q (nq,)."""
        person, state = self._capture.estimator, self._tracker.start(self._tracker.values(q))
        person.set_person(person.GetMyMutableContextFromRoot(self.context), state)

    def _state(self) -> TrackState:
        """Return the tracker's state after the last frame."""
        person = self._capture.estimator
        state = person.known_person(person.GetMyContextFromRoot(self.context))
        if state is None:
            raise SettingsError("fewer than two cameras saw a person in the first frame")
        return state
