"""A simulated person before simulated cameras, for Date's experiment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.body.landmarks import Landmark, load_landmarks
from drake_pose.camera import Camera, PinholeCamera
from drake_pose.camera.rigs import FACE_CAMERA, circle_of_cameras
from drake_pose.multiview.capture import CaptureSettings, CaptureSetup, see_person
from drake_pose.multiview.faces import FaceTemplates, cut_face, learn_faces
from drake_pose.multiview.features import find_features
from drake_pose.multiview.paper_pose import waist_of
from drake_pose.multiview.recognition import register_pose
from drake_pose.multiview.regions import Background, learn_background
from drake_pose.multiview.skeleton import Skeleton, load_skeleton
from drake_pose.systems.camera_rig import CameraRig, build_camera_rig

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]

_NOISE = 3.0
_EMPTY_PICTURES = 5
_TURNS_DEG = np.linspace(-80.0, 80.0, 20)
_NODS_DEG = np.linspace(-35.0, 50.0, 15)
_FACE_SIZE = (200, 200)
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
        """A studio of so many cameras, the face camera among them, pictures of one size [pixel]."""
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

    @property
    def ring(self) -> dict[str, PinholeCamera]:
        """The cameras on the circle."""
        return {name: camera for name, camera in self.cameras.items() if name != FACE_CAMERA}

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

        def draw(camera: Camera, positions: Array) -> Mask:
            self.rig.set_positions(self.context, positions)
            return self.rig.mask(self.context, camera.name)

        ring = self.ring
        pictures = self.pictures(q)
        views = {
            name: see_person(pictures[name], _SETTINGS, background=self.backgrounds[name])
            for name in ring
        }
        seen = find_features(
            list(ring.values()),
            [view.blobs.centroids for view in views.values()],
            [view.region for view in views.values()],
            self.skeleton.features(q),
        )
        places = np.where(seen.support[:, None] > 0, seen.places, np.nan)
        skeleton = self.skeleton.with_features(q, places)
        registered = register_pose(skeleton, q, list(ring.values()), draw)
        faces = learn_rendered_faces(self.model, q, self.skeleton, _SETTINGS)
        settings = replace(_SETTINGS, waist=waist_of(skeleton))
        return CaptureSetup(skeleton, ring, self.cameras[FACE_CAMERA], faces, registered, settings)

    def side_by_side(self, q: Array, estimates: Sequence[Array], name: str) -> Picture:
        """The person as a camera sees it, and as estimated, side by side (H, n W, 3)."""
        shown = []
        for positions in (q, *estimates):
            self.rig.set_positions(self.context, positions)
            shown.append(self.rig.picture(self.context, name))
        return np.hstack(shown)


_SETTINGS = CaptureSettings()


def noisy(picture: Picture, generator: np.random.Generator) -> Picture:
    """A picture with a camera's noise: 3 grey levels."""
    # One byte a channel is enough for noise, and four times as fast as a double.
    noise = np.empty(picture.shape, dtype=np.int16)
    cv2.setRNGSeed(int(generator.integers(1 << 31)))
    cv2.randn(noise, np.zeros(3), np.full(3, _NOISE))
    return np.clip(picture + noise, 0, 255).astype(np.uint8)


def learn_rendered_faces(
    model: ArticulatedModel, q: Array, skeleton: Skeleton, settings: CaptureSettings
) -> FaceTemplates:
    """Templates of a model's face: 300 rendered pictures, 20 turns times 15 nods.

    Args:
        model: the person.
        q: (nq,) positions of the rest of the body.
        skeleton: the person's.
        settings: which colours are skin.
    """
    head = skeleton.features(q)[0]
    camera = circle_of_cameras(
        1, height=float(head[2]), target=head, field_of_view=math.radians(11.0), size=_FACE_SIZE
    )["camera_0"]
    azimuth = math.atan2(camera.X_WC[1, 3] - head[1], camera.X_WC[0, 3] - head[0])
    rig = build_camera_rig(model, {"camera_0": camera})
    context = rig.diagram.CreateDefaultContext()
    faces, directions = [], []
    for turn in np.radians(_TURNS_DEG):
        for nod in np.radians(_NODS_DEG):
            posed = np.array(q)
            posed[skeleton.head_angles] = azimuth + turn, nod
            posed[skeleton.head_positions] += head - skeleton.features(posed)[0]
            rig.set_positions(context, posed)
            picture = rig.picture(context, "camera_0")
            view = see_person(picture, settings, rig.mask(context, "camera_0"))
            face = cut_face(picture, view.blobs)
            if face is not None:
                faces.append(face)
                directions.append((turn, nod))
    return learn_faces(faces, np.array(directions))
