"""The ways of capturing that Date's experiment compares, each going from frame to frame."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageRgba8U

from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.papers.date.stages import template_picture
from drake_pose.person.date.capture import CaptureSetup, PersonView
from drake_pose.person.date.faces import cut_face, face_direction
from drake_pose.person.date.features import Features
from drake_pose.person.date.skeleton import LIMBS
from drake_pose.person.pose_tracker import PersonPoseTracker, TrackState
from drake_pose.silhouette.segmentation.background import Background
from drake_pose.systems.colour_images import colour_image_to_picture, picture_to_colour_image
from drake_pose.systems.date.capture import PaperCapture, build_paper_capture
from drake_pose.systems.person.live_capture import SilhouetteCapture, build_silhouette_capture
from drake_pose.systems.staged_diagram import StagedDiagram

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

Images = Mapping[str, ImageRgba8U]

# An edge point every 8 pixels of 640 x 480 pictures.
_EDGE_POINTS = 60.0
# A power of two: the time from frame to frame is exactly the same, and so is the motion expected.
_PERIOD = 1.0 / 32.0


class FaceSeen(NamedTuple):
    """A face (130, 80, 3) as the face camera saw it, and the template nearest to it."""

    face: Picture
    template: Picture


class _Clock:
    """Processor time since the last lap, by name [ms]."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.process_time()

    def lap(self, name: str) -> None:
        """End a stage."""
        now = time.process_time()
        self.laps[name] = 1e3 * (now - self._last)
        self._last = now


def see(pictures: Mapping[str, Picture]) -> Images:
    """A frame's pictures (H, W, 3) as Drake's sensors would give them."""
    return {name: picture_to_colour_image(shot) for name, shot in pictures.items()}


class _Run:
    """A ready diagram that is run frame by frame, each stage by the clock."""

    def __init__(self, capture: StagedDiagram) -> None:
        self._capture = capture
        self._simulator = Simulator(capture.diagram)
        self._frames = 0

    @property
    def context(self) -> Context:
        """The diagram's."""
        return self._simulator.get_mutable_context()

    def begin_frame(self) -> None:
        """Goes to just before the next frame's update, which so sees the images that follow."""
        if self._frames:
            self._simulator.AdvanceTo(_PERIOD * self._frames)
        self._frames += 1

    def fix(self, images: Images) -> None:
        """Gives the frame's images."""
        for name, image in images.items():
            port = self._capture.diagram.GetInputPort(f"color_image_{name}")
            port.FixValue(self.context, AbstractValue.Make(image))

    def finish_frame(self, stages: Iterable[str]) -> Mapping[str, float]:
        """Processor time of these stages and of the pose [ms]."""
        clock = _Clock()
        for stage in stages:
            self._capture.evaluate(self.context, stage)
            clock.lap(stage)
        self._simulator.AdvancePendingEvents()
        clock.lap("pose")
        return clock.laps


class PaperTrack:
    """The paper's way, with its search for elbows and knees or without: its ready diagram.

    Attributes:
        milliseconds: processor time of each frame's stages, where the pose was not recognised.

    Args:
        capture: the diagram.
    """

    def __init__(self, capture: PaperCapture) -> None:
        self.milliseconds: list[Mapping[str, float]] = []
        self._capture, self._run = capture, _Run(capture)

    @staticmethod
    def build(setup: CaptureSetup) -> PaperTrack:
        """A track that knows nothing yet."""
        return PaperTrack(build_paper_capture(setup, period=_PERIOD))

    def step(self, images: Images) -> Array:
        """The positions (nq,) of one more frame.

        Raises:
            SettingsError: the registered pose was not recognised in the first frame.
        """
        self._run.begin_frame()
        self._run.fix(images)
        laps = self._run.finish_frame(self._capture.stages)
        diagram, context = self._capture.diagram, self._run.context
        q = np.array(diagram.GetOutputPort("estimated_positions").Eval(context))
        if not np.isfinite(q).all():
            raise SettingsError(
                "the registered pose was not recognised in the first frame: take more cameras, or "
                "larger pictures"
            )
        if not diagram.GetOutputPort("similarity").Eval(context)[0]:
            self.milliseconds.append(laps)
        return q

    def middle_joints(self) -> Array:
        """(4, 3) elbows and knees of the last frame as found, in the order of LIMBS [m].

        nan in a frame whose pose was recognised instead.
        """
        port = self._capture.diagram.GetOutputPort("limb_points")
        return np.array(port.Eval(self._run.context)).reshape(len(LIMBS), 3, 3)[:, 1]

    def seen(self) -> tuple[dict[str, PersonView], Features, FaceSeen | None]:
        """The last frame's person by camera on the circle, features, and face where one was seen.

        None of it changed what was estimated.
        """
        setup, diagram, context = self._capture.estimator.setup, self._capture.diagram, self.context
        ports = {name: diagram.GetOutputPort(f"person_view_{name}") for name in setup.cameras}
        views = {name: port.Eval(context) for name, port in ports.items()}
        finder = diagram.GetSubsystemByName("features")
        found = finder.GetOutputPort("found").Eval(finder.GetMyContextFromRoot(context))
        if setup.face_camera is None or setup.faces is None:
            return views, found, None
        name = setup.face_camera.name
        picture = colour_image_to_picture(diagram.GetInputPort(f"color_image_{name}").Eval(context))
        blobs = diagram.GetOutputPort(f"person_view_{name}").Eval(context).blobs
        face = cut_face(picture, blobs)
        if face is None:
            return views, found, None
        nearest = face_direction(face, setup.faces)
        if nearest.outside > setup.settings.farthest_face:
            return views, found, None
        return views, found, FaceSeen(face, template_picture(setup.faces, nearest.template))

    @property
    def context(self) -> Context:
        """The diagram's."""
        return self._run.context

    def destroyed(self, q: Array, _generator: np.random.Generator) -> PaperTrack:
        """A track that is turned around, its left and right exchanged; q (nq,) is where it was."""
        estimator = self._capture.estimator
        setup = estimator.setup
        wrong = np.array(q)
        wrong[setup.skeleton.head_angles[0]] += np.pi
        wrong = setup.skeleton.clip(wrong)
        track = PaperTrack(self._capture)
        context = estimator.GetMyMutableContextFromRoot(track._run.context)
        estimator.set_person(context, wrong, setup.skeleton.features(wrong)[[3, 4, 0, 2, 1]])
        return track


class SilhouetteTrack:
    """All silhouettes at once: the ready diagram of that.

    Attributes:
        milliseconds: processor time of each frame's stages.

    Args:
        capture: the diagram.
        tracker: what it follows with.
        shared: another track of the same diagram, whose silhouettes of each frame are used, too, as
            it stepped before; None: the images are looked at.
    """

    def __init__(
        self,
        capture: SilhouetteCapture,
        tracker: PersonPoseTracker,
        shared: SilhouetteTrack | None = None,
    ) -> None:
        self.milliseconds: list[Mapping[str, float]] = []
        self._capture, self._tracker, self._shared = capture, tracker, shared
        self._run = _Run(capture)

    @staticmethod
    def build(
        model: ArticulatedModel,
        cameras: Mapping[str, Camera],
        backgrounds: Mapping[str, Background],
    ) -> SilhouetteTrack:
        """A track that knows nothing yet."""
        tracker = PersonPoseTracker(ContourFit(model.pose_tree()))
        capture = build_silhouette_capture(tracker, cameras, backgrounds, _PERIOD, _EDGE_POINTS)
        return SilhouetteTrack(capture, tracker)

    def place(self, q: Array) -> None:
        """Has the person be known to be at q (nq,)."""
        self._set_state(self._tracker.start(self._tracker.values(q)))

    def step(self, images: Images) -> Array:
        """The positions (nq,) of one more frame, even where the person is lost.

        Raises:
            SettingsError: nobody was seen in the first frame.
        """
        self._run.begin_frame()
        if self._shared is None:
            self._run.fix(images)
            laps = self._run.finish_frame(self._capture.stages)
        else:
            self._borrow_silhouettes(self._shared, images)
            laps = self._run.finish_frame(())
        self.milliseconds.append(laps)
        return self._tracker.positions(self._state().values)

    def destroyed(self, _q: Array, generator: np.random.Generator) -> SilhouetteTrack:
        """A track in a random pose half a metre away, turned anyhow."""
        fit, state = self._tracker.fit, self._state()
        values, angles = state.values.copy(), fit.kinematics.is_angle
        lower = np.where(np.isinf(fit.lower), -np.pi, fit.lower)
        upper = np.where(np.isinf(fit.upper), np.pi, fit.upper)
        values[angles] = generator.uniform(lower, upper)[angles]
        direction = generator.uniform(0.0, 2.0 * np.pi)
        values[:2] += 0.5 * np.array([np.cos(direction), np.sin(direction)])
        track = SilhouetteTrack(self._capture, self._tracker, self)
        track._set_state(replace(state, values=values, step=np.zeros(len(values))))
        return track

    def _borrow_silhouettes(self, shared: SilhouetteTrack, names: Iterable[str]) -> None:
        """What a fixed input is given comes before what the diagram connects it to."""
        person = self._capture.person
        own = person.GetMyMutableContextFromRoot(self._run.context)
        other = person.GetMyContextFromRoot(shared._run.context)
        for name in names:
            port = person.GetInputPort(f"silhouette_{name}")
            port.FixValue(own, AbstractValue.Make(port.Eval(other)))

    def _state(self) -> TrackState:
        person = self._capture.person
        state = person.known_person(person.GetMyContextFromRoot(self._run.context))
        if state is None:
            raise SettingsError("fewer than two cameras saw a person in the first frame")
        return state

    def _set_state(self, state: TrackState) -> None:
        person = self._capture.person
        person.set_person(person.GetMyMutableContextFromRoot(self._run.context), state)
