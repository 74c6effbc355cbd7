"""The paper's system, frame by frame: all cameras' pictures in, a pose out (Date et al., figure 1).

`see_person` is one camera's share: a function of its picture alone, so it can run elsewhere.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera import Camera
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.multiview.contours import Contour, measure_contour
from drake_pose.multiview.faces import FaceTemplates, cut_face, face_direction, head_angles
from drake_pose.multiview.features import Features, FeatureSettings, find_features
from drake_pose.multiview.paper_pose import PaperPose, Waist, estimate_pose
from drake_pose.multiview.recognition import Recognition, RegisteredPose, recognise
from drake_pose.multiview.regions import Background, person_region
from drake_pose.multiview.skeleton import Skeleton
from drake_pose.multiview.skin_blobs import Blobs, SkinColour, skin_blobs

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class CaptureSettings:
    """How the paper's system captures.

    Args:
        skin: which colours are skin.
        features: how 3-D points become features.
        search: whether elbows and knees are searched on their circles.
        recognition: similarity from which the registered pose overwrites the state.
        waist: the constants of the waist formula.
        farthest_face: how far from the eigenspace a face may be [grey levels].
    """

    skin: SkinColour = field(default_factory=SkinColour)
    features: FeatureSettings = field(default_factory=FeatureSettings)
    search: bool = True
    recognition: float = 0.93
    waist: Waist = field(default_factory=Waist)
    farthest_face: float = 30.0


@dataclass(frozen=True, eq=False)
class PersonView:
    """What one camera's picture says (the paper's horizontal image processing module).

    Args:
        region: (H, W) the person.
        blobs: the skin in it.
        contour: None where the person is not seen whole.
    """

    region: Mask
    blobs: Blobs
    contour: Contour | None


@dataclass(frozen=True, eq=False)
class CaptureSetup:
    """What stays the same from frame to frame.

    Args:
        skeleton: the person.
        cameras: the cameras on the circle, by name.
        face_camera: the face camera, where there is one.
        faces: the templates of the face's direction, where there are some.
        registered: the registered pose, where it is to be recognised.
        settings: how to capture.

    Raises:
        SettingsError: fewer than two cameras.
    """

    skeleton: Skeleton
    cameras: Mapping[str, Camera]
    face_camera: Camera | None = None
    faces: FaceTemplates | None = None
    registered: RegisteredPose | None = None
    settings: CaptureSettings = field(default_factory=CaptureSettings)

    def __post_init__(self) -> None:
        if len(self.cameras) < 2:
            raise SettingsError("3-D points need two cameras or more besides the face camera")


@dataclass(frozen=True, eq=False)
class CaptureState:
    """What the next frame is told of this one.

    Args:
        q: (nq,) positions.
        features: (5, 3) head, hands and feet [m].
    """

    q: Array
    features: Array


@dataclass(frozen=True, eq=False)
class CapturedFrame:
    """The estimate of a frame.

    Args:
        state: for the next frame.
        pose: None where the registered pose was recognised: it overwrites the estimate.
        features: the measured ones; None likewise.
        recognition: the registered pose, where it was recognised.
        milliseconds: by stage.
    """

    state: CaptureState
    pose: PaperPose | None
    features: Features | None
    recognition: Recognition | None
    milliseconds: Mapping[str, float]


def start_state(skeleton: Skeleton, q: Array) -> CaptureState:
    """The state of a person known to be at positions q (nq,)."""
    return CaptureState(np.array(q, dtype=np.float64), skeleton.features(q))


def see_person(
    picture: Picture, settings: CaptureSettings, region: Mask | None = None,
    background: Background | None = None,
) -> PersonView:  # fmt: skip
    """One camera's share: the person's region, the skin in it, its contour.

    Args:
        picture: (H, W, 3) red, green, blue.
        settings: which colours are skin.
        region: (H, W) the person, where it is known.
        background: the camera's, where the region is to be found by it.

    Raises:
        SettingsError: neither region nor background, or a region of another size.
    """
    if region is None:
        if background is None:
            raise SettingsError("a person is found by a given region or a background; give one")
        region = person_region(picture, background)
    if region.shape != picture.shape[:2]:
        raise SettingsError(f"the region is {region.shape}, but the picture {picture.shape}")
    return PersonView(region, skin_blobs(picture, region, settings.skin), measure_contour(region))


def capture_frame(
    setup: CaptureSetup,
    last: CaptureState | None,
    views: Mapping[str, PersonView],
    face: tuple[Picture, PersonView] | None = None,
) -> CapturedFrame | None:
    """Estimates a frame's pose from what the cameras saw.

    Args:
        setup: what stays the same.
        last: the last frame's state; None where the person is not known yet: then the registered
            pose must be shown first.
        views: by camera, from see_person; a camera that stopped may be missing.
        face: the face camera's picture and what see_person found in it.

    Returns:
        None where there is no last state and the registered pose is not recognised.

    Raises:
        UnknownNameError: a view of a camera that is not there.
    """
    for name in views:
        if name not in setup.cameras:
            raise UnknownNameError("camera", name, setup.cameras, "the capture")
    clock = _Clock()
    names = [name for name in setup.cameras if name in views]
    cameras = [setup.cameras[name] for name in names]
    seen = [views[name] for name in names]
    recognition = None
    if setup.registered is not None:
        contours = [view.contour for view in seen]
        recognition = recognise(
            setup.skeleton, setup.registered, cameras, contours, setup.settings.recognition
        )
        clock.lap("recognition")
    if recognition is not None:
        state = start_state(setup.skeleton, recognition.q)
        return CapturedFrame(state, None, None, recognition, clock.laps)
    if last is None:
        return None
    regions = [view.region for view in seen]
    features = find_features(
        cameras,
        [view.blobs.centroids for view in seen],
        regions,
        last.features,
        setup.settings.features,
    )
    clock.lap("features")
    angles = None if face is None else _face_angles(setup, features.places[0], face)
    clock.lap("face")
    pose = estimate_pose(
        setup.skeleton,
        last.q,
        features.places,
        angles,
        cameras,
        regions,
        search=setup.settings.search,
        waist=setup.settings.waist,
    )
    clock.lap("pose")
    return CapturedFrame(CaptureState(pose.q, features.places), pose, features, None, clock.laps)


def _face_angles(
    setup: CaptureSetup, head: Array, face: tuple[Picture, PersonView]
) -> Array | None:
    """The angles (2,) [rad] of a head at (3,) where the face camera sees the face, else None."""
    if setup.faces is None or setup.face_camera is None:
        return None
    cut = cut_face(face[0], face[1].blobs)
    if cut is None:
        return None
    found = face_direction(cut, setup.faces)
    if found.outside > setup.settings.farthest_face:
        return None
    return head_angles(found.direction, head, setup.face_camera)


class _Clock:
    """Milliseconds since the last lap, by name."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, name: str) -> None:
        """End a stage."""
        now = time.perf_counter()
        self.laps[name] = 1e3 * (now - self._last)
        self._last = now
