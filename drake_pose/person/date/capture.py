"""What the paper's capture must know beforehand, and one camera's share of it (Date, figure 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from drake_pose.arrays import Mask, Picture
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.person.date.body_pose import Waist
from drake_pose.person.date.faces import FaceTemplates
from drake_pose.person.date.features import Blobs, SkinColour, skin_blobs
from drake_pose.person.date.limb_search import Search
from drake_pose.person.date.recognition import Contour, RegisteredPose, measure_contour
from drake_pose.person.date.skeleton import Skeleton
from drake_pose.silhouette.segmentation.background import Background


@dataclass(frozen=True)
class CaptureSettings:
    """How the paper's system captures.

    Args:
        search: how elbows and knees are searched on their circles; see estimate_pose.
        recognition: similarity from which the registered pose overwrites the state.
        farthest_face: how far from the eigenspace a face may be [grey levels].
    """

    skin: SkinColour = field(default_factory=SkinColour)
    search: Search = "surfaces"
    recognition: float = 0.93
    waist: Waist = field(default_factory=Waist)
    farthest_face: float = 30.0


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
