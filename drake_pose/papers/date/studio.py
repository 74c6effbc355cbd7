"""A simulated person before simulated cameras, for Date's experiment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.landmarks import Landmark, load_landmarks
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.camera.models import PinholeCamera
from drake_pose.camera.rigs import FACE_CAMERA, circle_of_cameras
from drake_pose.person.date.capture import CaptureSetup, see_person
from drake_pose.person.date.faces import cut_face
from drake_pose.person.date.skeleton import Skeleton, load_skeleton
from drake_pose.person.date.skin_blobs import SkinColour
from drake_pose.silhouette.segmentation.background import Background, learn_background
from drake_pose.systems.date.preparation import prepare_paper_capture
from drake_pose.systems.pictures.camera_rig import CameraRig, build_camera_rig

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

_NOISE = 3.0
_EMPTY_PICTURES = 5
_FAR_AWAY = -9.0


@dataclass(frozen=True, eq=False)
class Studio:
    """The simulated person, cameras and noise.

    Args:
        model: the person.
        skeleton: the person's.
        landmarks: the joint centres that are compared.
        cameras: all, the face camera among them.
        rig: what renders their pictures.
        context: the rig's.
        backgrounds: what each camera sees of the empty room.
        generator: draws the pictures' noise.
    """

    model: ArticulatedModel
    skeleton: Skeleton
    landmarks: Mapping[str, Landmark]
    cameras: Mapping[str, PinholeCamera]
    rig: CameraRig
    context: Context
    backgrounds: Mapping[str, Background]
    generator: np.random.Generator

    @staticmethod
    def build(cameras: int, size: tuple[int, int], generator: np.random.Generator) -> Studio:
        """A studio of this many cameras, face camera included, pictures of one size [pixel]."""
        model = load_model(bundled_model("person"), check=False)
        placed = circle_of_cameras(cameras - 1, size=size)
        rig = build_camera_rig(model, placed)
        context = rig.diagram.CreateDefaultContext()
        away = np.array(model.default_positions)
        away[model.position_index("position_z")] = _FAR_AWAY
        rig.set_positions(context, away)
        backgrounds = {}
        for name in placed:
            empty = rig.picture(context, name)
            shots = [noisy(empty, generator) for _ in range(_EMPTY_PICTURES)]
            backgrounds[name] = learn_background(shots)
        landmarks = {n: p for n, p in load_landmarks(model.path).items() if n != "head_top"}
        return Studio(
            model,
            load_skeleton(model),
            landmarks,
            placed,
            rig,
            context,
            backgrounds,
            generator,
        )

    def pictures(self, q: Array) -> dict[str, Picture]:
        """What all cameras see of a person at q (nq,), noise included."""
        self.rig.set_positions(self.context, q)
        return {
            name: noisy(self.rig.picture(self.context, name), self.generator)
            for name in self.cameras
        }

    def prepare(self, q: Array) -> CaptureSetup:
        """What must be known before the capture: faces, registered pose, where the skin is.

        Args:
            q: (nq,) the registered pose, which the person shows once for it.
        """
        return prepare_paper_capture(
            self.model, self.cameras, FACE_CAMERA, q, self.pictures(q), self.backgrounds
        )

    def side_by_side(self, q: Array, estimates: Sequence[Array], name: str) -> Picture:
        """The person as a camera sees it, and as estimated, side by side (H, n W, 3)."""
        shown = []
        for positions in (q, *estimates):
            self.rig.set_positions(self.context, positions)
            shown.append(self.rig.picture(self.context, name))
        return np.hstack(shown)

    def face_at(self, q: Array) -> Picture | None:
        """The face (130, 80, 3) of a person at q as the face camera sees it; None: no skin."""
        self.rig.set_positions(self.context, q)
        picture = self.rig.picture(self.context, FACE_CAMERA)
        mask = self.rig.mask(self.context, FACE_CAMERA)
        return cut_face(picture, see_person(picture, mask, SkinColour()).blobs)


def noisy(picture: Picture, generator: np.random.Generator) -> Picture:
    """A picture with a camera's noise: 3 grey levels."""
    # One byte a channel is enough for noise, and four times as fast as a double.
    noise = np.empty(picture.shape, dtype=np.int16)
    cv2.setRNGSeed(int(generator.integers(1 << 31)))
    cv2.randn(noise, np.zeros(3), np.full(3, _NOISE))
    return np.clip(picture + noise, 0, 255).astype(np.uint8)
