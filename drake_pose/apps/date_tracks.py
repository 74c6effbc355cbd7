"""The ways of capturing that Date's experiment compares, each going from frame to frame."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.sensors import ImageRgba8U

from drake_pose.body import ArticulatedModel
from drake_pose.camera import Camera
from drake_pose.errors import SettingsError
from drake_pose.multiview.capture import CaptureSetup
from drake_pose.multiview.regions import Background, person_region
from drake_pose.multiview.silhouette_fit import SilhouetteFit
from drake_pose.multiview.silhouette_tracker import (
    SilhouetteTracker,
    SilhouetteView,
    TrackState,
    see_silhouette,
)
from drake_pose.systems.colour_images import picture_to_colour_image
from drake_pose.systems.paper_capture import PaperCapture, build_paper_capture

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

_EDGE_SPACING = 8.0
_PERIOD = 1.0 / 30.0


class Clock:
    """Processor time since the last lap, by name [ms]."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.process_time()

    def lap(self, name: str) -> None:
        """End a stage."""
        now = time.process_time()
        self.laps[name] = 1e3 * (now - self._last)
        self._last = now


@dataclass(frozen=True, eq=False)
class Sight:
    """What all ways of capturing are given of a frame.

    Args:
        images: by camera, as a Drake sensor would give them.
        silhouettes: of all cameras; empty where only the paper's method runs.
        silhouette_ms: processor time of each stage of these, all cameras together.
    """

    images: Mapping[str, ImageRgba8U]
    silhouettes: Mapping[str, SilhouetteView]
    silhouette_ms: Mapping[str, float]


def see(
    pictures: Mapping[str, Picture], backgrounds: Mapping[str, Background], silhouettes: bool
) -> Sight:
    """Takes a frame's pictures (H, W, 3), and finds the silhouettes in them where wanted."""
    images = {name: picture_to_colour_image(shot) for name, shot in pictures.items()}
    if not silhouettes:
        return Sight(images, {}, {})
    clock = Clock()
    regions = {name: person_region(shot, backgrounds[name]) for name, shot in pictures.items()}
    clock.lap("region")
    seen = {name: see_silhouette(region, _EDGE_SPACING) for name, region in regions.items()}
    clock.lap("edge")
    return Sight(images, seen, clock.laps)


@dataclass(eq=False)
class PaperTrack:
    """The paper's way, with its search for elbows and knees or without: its ready diagram."""

    capture: PaperCapture
    simulator: Simulator
    milliseconds: list[Mapping[str, float]] = field(default_factory=list)
    frames: int = 0

    @staticmethod
    def build(setup: CaptureSetup) -> PaperTrack:
        """A track that knows nothing yet."""
        capture = build_paper_capture(setup, period=_PERIOD)
        return PaperTrack(capture, Simulator(capture.diagram))

    def step(self, sight: Sight) -> Array:
        """The positions (nq,) of one more frame.

        Raises:
            SettingsError: the registered pose was not recognised in the first frame.
        """
        diagram, context = self.capture.diagram, self.simulator.get_mutable_context()
        if self.frames:
            # Stops just before this frame's update, which so sees the images that follow.
            self.simulator.AdvanceTo(_PERIOD * self.frames)
        self.frames += 1
        for name, image in sight.images.items():
            diagram.GetInputPort(f"color_image_{name}").FixValue(context, AbstractValue.Make(image))
        clock = Clock()
        for stage in self.capture.stages:
            self.capture.evaluate(context, stage)
            clock.lap(stage)
        self.simulator.AdvancePendingEvents()
        clock.lap("pose")
        q = np.array(diagram.GetOutputPort("estimated_positions").Eval(context))
        if not np.isfinite(q).all():
            raise SettingsError(
                "the registered pose was not recognised in the first frame: take more cameras, or "
                "larger pictures"
            )
        if not diagram.GetOutputPort("similarity").Eval(context)[0]:
            self.milliseconds.append(clock.laps)
        return q

    def destroyed(self, q: Array, _generator: np.random.Generator) -> PaperTrack:
        """A track that is turned around, its left and right exchanged; q (nq,) is where it was."""
        setup = self.capture.estimator.setup
        wrong = np.array(q)
        wrong[setup.skeleton.head_angles[0]] += np.pi
        wrong = setup.skeleton.clip(wrong)
        track = PaperTrack(self.capture, Simulator(self.capture.diagram))
        estimator = track.capture.estimator
        context = estimator.GetMyMutableContextFromRoot(track.simulator.get_mutable_context())
        estimator.set_person(context, wrong, setup.skeleton.features(wrong)[[3, 4, 0, 2, 1]])
        return track


@dataclass(eq=False)
class SilhouetteTrack:
    """All silhouettes at once."""

    tracker: SilhouetteTracker
    cameras: Mapping[str, Camera]
    state: TrackState | None = None
    milliseconds: list[Mapping[str, float]] = field(default_factory=list)

    @staticmethod
    def build(model: ArticulatedModel, cameras: Mapping[str, Camera]) -> SilhouetteTrack:
        """A track that knows nothing yet."""
        return SilhouetteTrack(SilhouetteTracker(SilhouetteFit(model.pose_tree())), cameras)

    def step(self, sight: Sight) -> Array:
        """The positions (nq,) of one more frame.

        Raises:
            SettingsError: nobody was seen in the first frame.
        """
        clock = Clock()
        self.state = self.tracker.follow(
            self.state,
            [self.cameras[name] for name in sight.silhouettes],
            list(sight.silhouettes.values()),
        )
        clock.lap("pose")
        if self.state is None:
            raise SettingsError("fewer than two cameras saw a person in the first frame")
        self.milliseconds.append({**sight.silhouette_ms, **clock.laps})
        return self.tracker.positions(self.state.values)

    def destroyed(self, _q: Array, generator: np.random.Generator) -> SilhouetteTrack:
        """A track in a random pose half a metre away, turned anyhow."""
        fit = self.tracker.fit
        if self.state is None:
            raise SettingsError("a track that was never right cannot be destroyed")
        values, angles = self.state.values.copy(), fit.kinematics.is_angle
        lower = np.where(np.isinf(fit.lower), -np.pi, fit.lower)
        upper = np.where(np.isinf(fit.upper), np.pi, fit.upper)
        values[angles] = generator.uniform(lower, upper)[angles]
        direction = generator.uniform(0.0, 2.0 * np.pi)
        values[:2] += 0.5 * np.array([np.cos(direction), np.sin(direction)])
        state = replace(self.state, values=values, step=np.zeros(len(values)))
        return SilhouetteTrack(self.tracker, self.cameras, state)
