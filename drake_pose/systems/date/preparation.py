"""What the paper's capture must know of a person beforehand, from pictures that Drake renders."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.models import Camera, PinholeCamera, circle_of_cameras
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.person.date.body_pose import Waist
from drake_pose.person.date.faces import FaceTemplates, cut_face, learn_faces
from drake_pose.person.date.features import Blobs, SkinColour, find_features, skin_blobs
from drake_pose.person.date.limb_search import Search
from drake_pose.person.date.recognition import (
    Contour,
    RegisteredPose,
    measure_contour,
    register_pose,
)
from drake_pose.person.date.skeleton import Skeleton, load_skeleton
from drake_pose.silhouette.segmentation.background import Background, person_region
from drake_pose.systems.pictures.camera_rig import build_camera_rig


@dataclass(frozen=True)
class CaptureSettings:
    """How the paper's system captures.

    Args:
        search: how elbows and knees are searched on their circles; see estimate_pose.
        waist: constants of the waist formula; None: this person's, lowered into the legs' reach.
        track_feet: whether feet are expected a step on, and never crossed; else they are looked for
            where they were in the last frame.
        recognition: similarity from which the registered pose overwrites the state.
        farthest_face: how far from the eigenspace a face may be [grey levels].
    """

    skin: SkinColour = field(default_factory=SkinColour)
    search: Search = "surfaces"
    waist: Waist | None = None
    track_feet: bool = True
    recognition: float = 0.93
    farthest_face: float = 30.0


CAPTURE_METHODS: Mapping[str, CaptureSettings] = {
    "stages": CaptureSettings(),
    "paper": CaptureSettings(search="rectangles", waist=Waist(), track_feet=False),
}
"""By name: the paper's stages with our search, waist and feet; and all as the paper prints it."""


@dataclass(frozen=True, eq=False)
class PersonView:
    """What one camera sees: region (H, W), skin in it, and the contour of a person seen whole."""

    region: Mask
    blobs: Blobs
    contour: Contour | None


@dataclass(frozen=True, eq=False)
class CaptureSetup:
    """What stays the same from frame to frame.

    Args:
        cameras: on the circle, by name.
        backgrounds: by camera, the face camera's among them; a camera without one needs masks.

    Raises:
        SettingsError: fewer than two cameras, or the face camera has the name of another.
    """

    skeleton: Skeleton
    cameras: Mapping[str, Camera]
    face_camera: Camera | None = None
    faces: FaceTemplates | None = None
    registered: RegisteredPose | None = None
    backgrounds: Mapping[str, Background] = field(default_factory=dict)
    settings: CaptureSettings = field(default_factory=CaptureSettings)

    def __post_init__(self) -> None:
        if len(self.cameras) < 2:
            raise SettingsError("3-D points need two cameras or more besides the face camera")
        if self.face_camera is not None and self.face_camera.name in self.cameras:
            raise SettingsError(
                f"the face camera '{self.face_camera.name}' is also one of the cameras on the "
                "circle; it must be another one"
            )


def see_person(picture: Picture, region: Mask, skin: SkinColour) -> PersonView:
    """One camera's share: skin in the person's region (H, W) of a picture (H, W, 3), and contour.

    Raises SettingsError for a region of another size than the picture's.
    """
    if region.shape != picture.shape[:2]:
        raise SettingsError(f"the region is {region.shape}, but the picture {picture.shape}")
    return PersonView(region, skin_blobs(picture, region, skin), measure_contour(region))


_TURNS_DEG = np.linspace(-80.0, 80.0, 20)
_NODS_DEG = np.linspace(-35.0, 50.0, 15)
_FACE_SIZE = (200, 200)
_FACE_VIEW = math.radians(11.0)
_ONLY_CAMERA = "camera_0"


def prepare_paper_capture(
    model: ArticulatedModel,
    cameras: Mapping[str, PinholeCamera],
    face_camera: str | None,
    q: Array,
    pictures: Mapping[str, Picture],
    backgrounds: Mapping[str, Background],
    settings: CaptureSettings | None = None,
    faces: FaceTemplates | None = None,
) -> CaptureSetup:
    """Makes the setup of a capture while the person shows the registered pose.

    The pictures say where the person's skin is seen; the pose's templates are rendered.

    Args:
        cameras: all of them, by name.
        face_camera: which of them is the face camera; None: there is none.
        q: (nq,) where the person stands, in the registered pose [rad or m].
        pictures: (H, W, 3) that the cameras on the circle take of it, red, green, blue.
        backgrounds: by camera.
        settings: how to capture.
        faces: templates of the person's face; rendered ones where not given.

    Raises:
        UnknownNameError: there is no such face camera.
        SettingsError: fewer than two other cameras.
        ModelError: the model is not made like the bundled person.
    """
    if face_camera is not None and face_camera not in cameras:
        raise UnknownNameError("camera", face_camera, cameras, "the rig")
    settings = settings or CaptureSettings()
    ring = {name: camera for name, camera in cameras.items() if name != face_camera}
    own = load_skeleton(model)
    skeleton = own.with_features(q, _features_of(own, q, ring, pictures, backgrounds, settings))
    registered = render_registered_pose(skeleton, q, ring)
    if face_camera is not None and faces is None:
        faces = learn_rendered_faces(model, own, q, settings.skin)
    return CaptureSetup(
        skeleton,
        ring,
        None if face_camera is None else cameras[face_camera],
        faces,
        registered,
        backgrounds,
        settings,
    )


def render_registered_pose(
    skeleton: Skeleton, q: Array, cameras: Mapping[str, PinholeCamera]
) -> RegisteredPose:
    """The registered pose at q (nq,) [rad or m] as Drake renders it; raises as register_pose."""
    rig = build_camera_rig(skeleton.model, cameras)
    context = rig.diagram.CreateDefaultContext()

    def draw(camera: Camera, positions: Array) -> Mask:
        rig.set_positions(context, positions)
        return rig.mask(context, camera.name)

    return register_pose(skeleton, q, list(cameras.values()), draw)


def _features_of(
    skeleton: Skeleton,
    q: Array,
    cameras: Mapping[str, Camera],
    pictures: Mapping[str, Picture],
    backgrounds: Mapping[str, Background],
    settings: CaptureSettings,
) -> Array:
    """(5, 3) where the cameras see the skin of a person at q (nq,) [m]; nan where they do not."""
    views = [
        see_person(pictures[n], person_region(pictures[n], backgrounds[n]), settings.skin)
        for n in cameras
    ]
    seen = find_features(
        list(cameras.values()),
        [view.blobs.centroids for view in views],
        [view.region for view in views],
        skeleton.features(q),
    )
    return np.where(seen.support[:, None] > 0, seen.places, np.nan)


def learn_rendered_faces(
    model: ArticulatedModel, skeleton: Skeleton, q: Array, skin: SkinColour
) -> FaceTemplates:
    """Templates of a model's face: 300 rendered pictures, 20 turns times 15 nods, at q (nq,)."""
    head = skeleton.features(q)[0]
    camera = circle_of_cameras(
        1, height=float(head[2]), target=head, field_of_view=_FACE_VIEW, size=_FACE_SIZE
    )[_ONLY_CAMERA]
    azimuth = math.atan2(camera.X_WC[1, 3] - head[1], camera.X_WC[0, 3] - head[0])
    rig = build_camera_rig(model, {_ONLY_CAMERA: camera})
    context = rig.diagram.CreateDefaultContext()
    faces, directions = [], []
    for turn in np.radians(_TURNS_DEG):
        for nod in np.radians(_NODS_DEG):
            posed = np.array(q)
            posed[skeleton.head_angles] = azimuth + turn, nod
            posed[skeleton.head_positions] += head - skeleton.features(posed)[0]
            rig.set_positions(context, posed)
            picture = rig.picture(context, _ONLY_CAMERA)
            view = see_person(picture, rig.mask(context, _ONLY_CAMERA), skin)
            face = cut_face(picture, view.blobs)
            if face is not None:
                faces.append(face)
                directions.append((turn, nod))
    return learn_faces(faces, np.array(directions))
