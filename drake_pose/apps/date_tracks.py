"""The ways of capturing that Date's experiment compares, each going from frame to frame."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from drake_pose.body import ArticulatedModel
from drake_pose.camera import Camera
from drake_pose.errors import SettingsError
from drake_pose.multiview.capture import (
    CaptureSetup,
    CaptureState,
    PersonView,
    capture_frame,
    see_person,
    start_state,
)
from drake_pose.multiview.regions import Background, person_region
from drake_pose.multiview.silhouette_fit import SilhouetteFit
from drake_pose.multiview.silhouette_tracker import (
    SilhouetteTracker,
    SilhouetteView,
    TrackState,
    see_silhouette,
)

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

_EDGE_SPACING = 8.0


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
    """What the stages before the pose found in a frame.

    Args:
        paper: by camera on the circle, as the paper needs it.
        face: the face camera's picture and what is in it.
        silhouettes: of all cameras; empty where only the paper's method runs.
        paper_ms, silhouette_ms: processor time of each stage, all cameras together.
    """

    paper: Mapping[str, PersonView]
    face: tuple[Picture, PersonView]
    silhouettes: Mapping[str, SilhouetteView]
    paper_ms: Mapping[str, float]
    silhouette_ms: Mapping[str, float]


def see(
    pictures: Mapping[str, Picture],
    backgrounds: Mapping[str, Background],
    setup: CaptureSetup,
    face_camera: str,
    silhouettes: bool,
) -> Sight:
    """Processes a frame's pictures (H, W, 3), camera by camera."""
    clock = Clock()
    regions = {name: person_region(shot, backgrounds[name]) for name, shot in pictures.items()}
    clock.lap("region")
    seen = {}
    if silhouettes:
        seen = {name: see_silhouette(region, _EDGE_SPACING) for name, region in regions.items()}
    clock.lap("edge")
    paper = {
        name: see_person(shot, setup.settings, regions[name]) for name, shot in pictures.items()
    }
    clock.lap("skin")
    laps = clock.laps
    return Sight(
        paper,
        (pictures[face_camera], paper.pop(face_camera)),
        seen,
        {"region": laps["region"], "skin": laps["skin"]},
        {"region": laps["region"], "edge": laps["edge"]},
    )


@dataclass(eq=False)
class PaperTrack:
    """The paper's way, with its search for elbows and knees or without."""

    setup: CaptureSetup
    state: CaptureState | None = None
    milliseconds: list[Mapping[str, float]] = field(default_factory=list)

    def step(self, sight: Sight) -> Array:
        """The positions (nq,) of one more frame.

        Raises:
            SettingsError: the registered pose was not recognised in the first frame.
        """
        frame = capture_frame(self.setup, self.state, sight.paper, sight.face)
        if frame is None:
            raise SettingsError(
                "the registered pose was not recognised in the first frame: take more cameras, or "
                "larger pictures"
            )
        self.state = frame.state
        if frame.pose is not None:
            self.milliseconds.append({**sight.paper_ms, **frame.milliseconds})
        return frame.state.q

    def destroyed(self, q: Array, _generator: np.random.Generator) -> PaperTrack:
        """A track that is turned around, its left and right exchanged; q (nq,) is where it was."""
        skeleton = self.setup.skeleton
        wrong = np.array(q)
        wrong[skeleton.head_angles[0]] += np.pi
        state = start_state(skeleton, skeleton.clip(wrong))
        return PaperTrack(self.setup, CaptureState(state.q, state.features[[3, 4, 0, 2, 1]]))


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
