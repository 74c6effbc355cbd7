"""The paper's stages before the pose, as Drake systems (Date et al., sections 3 and 5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.camera.models import Camera
from drake_pose.errors import CameraError, SettingsError
from drake_pose.person.date.capture import PersonView, see_person
from drake_pose.person.date.faces import FaceTemplates, find_face
from drake_pose.person.date.features import Features, SkinColour, find_features
from drake_pose.person.date.recognition import Recognition, RegisteredPose, recognise
from drake_pose.person.date.skeleton import FEATURES, Skeleton
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.segmentation.background import Background, person_region
from drake_pose.systems.colour_images import colour_image_to_picture
from drake_pose.systems.ports import PortedSystem


class ViewPorts:
    """The input ports ``person_view_<camera>`` of a system.

    Raises SettingsError for fewer than two cameras, or two of one name.
    """

    def __init__(self, system: PortedSystem, cameras: Sequence[Camera]) -> None:
        names = [camera.name for camera in cameras]
        if len(names) < 2 or len(set(names)) != len(names):
            raise SettingsError(f"two or more different cameras are needed, not: {names}")
        self._system, self._cameras = system, tuple(cameras)
        for name in names:
            system.add_input(f"person_view_{name}", None)

    def evaluate(self, context: Context) -> tuple[list[Camera], list[PersonView]]:
        """The cameras that go, and what they saw; unconnected ones and None are left out."""
        views = [self._system.given(context, f"person_view_{one.name}") for one in self._cameras]
        cameras = [one for one, view in zip(self._cameras, views, strict=True) if view is not None]
        return cameras, [view for view in views if view is not None]


class HorizontalImage(PortedSystem):
    """Finds the person in one camera's picture: region, skin-coloured blobs in it, contour.

    .. pydrake_system::

        name: HorizontalImage
        input_ports: [color_image, label_image (optional)]
        output_ports: [region, person_view]

    The paper's horizontal image processing module (3.1.1). The region is that of ``label_image``,
    where not connected that of the background model. Outputs: ``region``, a mask (H, W), and
    ``person_view``, a ``person.date.capture.PersonView``; both are None while the camera is lost:
    ``color_image`` is unconnected, or an image of no pixels.

    Args:
        background: what it sees when nobody is there; None where ``label_image`` is connected.

    Raises:
        SettingsError: the background's size is not the camera's. When evaluated: there is neither a
            background nor a label image.
        CameraError: when evaluated: an image has another size than the camera's.
    """

    def __init__(
        self, camera: Camera, background: Background | None = None, skin: SkinColour | None = None
    ) -> None:
        super().__init__()
        size = camera.width, camera.height
        if background is not None and background.mean.shape[1::-1] != size:
            width, height = background.mean.shape[1::-1]
            raise SettingsError(
                f"camera '{camera.name}' has {size[0]} x {size[1]} pixels (width x height), but "
                f"its background {width} x {height}"
            )
        self._camera, self._background, skin = camera, background, skin or SkinColour()
        self.add_input("color_image", ImageRgba8U(*size))
        self.add_input("label_image", ImageLabel16I(*size))
        shown = self.add_cache("picture", self._picture)

        def see(context: Context) -> PersonView | None:
            picture, mask = shown.Eval(context), region.Eval(context)
            return None if picture is None else see_person(picture, mask, skin)

        region = self.add_output(
            "region", None, lambda context: self._region(context, shown.Eval(context))
        )
        self.add_output("person_view", None, see)

    def _picture(self, context: Context) -> Picture | None:
        """The picture (H, W, 3); None while the camera has stopped."""
        image = self.given(context, "color_image")
        if image is None or not image.size():
            return None
        picture = colour_image_to_picture(image)
        self._require_size(picture, "color image")
        return picture

    def _region(self, context: Context, picture: Picture | None) -> Mask | None:
        """Where the person is (H, W); None while the camera has stopped."""
        if picture is None:
            return None
        image = self.given(context, "label_image")
        if image is not None:
            mask = label_image_to_mask(image)
            self._require_size(mask, "label image")
            return mask
        if self._background is not None:
            return person_region(picture, self._background)
        raise SettingsError(
            f"camera '{self._camera.name}': nothing tells the person from what is behind; give "
            "a background model or connect label_image"
        )

    def _require_size(self, image: NDArray[np.generic], kind: str) -> None:
        camera = self._camera
        if image.shape[:2] != (camera.height, camera.width):
            raise CameraError(
                f"camera '{camera.name}': its {kind} has {image.shape[1]} x {image.shape[0]} "
                f"pixels (width x height), but it was calibrated with {camera.width} x "
                f"{camera.height}"
            )


class FeatureFinder(PortedSystem):
    """Finds head, hands and feet in space where the rays of skin-coloured blobs meet.

    .. pydrake_system::

        name: FeatureFinder
        input_ports: [person_view_<camera>, last_features, expected_features (optional)]
        output_ports: [found, features, support]

    The first part of the paper's 3-D module (3.1.2). A camera that is unconnected or gives None is
    left out. ``last_features`` (15) are the last frame's: head, left hand, right hand, left foot,
    right foot [m]; while they are nan nothing is found. ``expected_features`` (15) are where they
    are expected in this frame [m]; the last frame's places where unconnected. Outputs: ``features``
    (15), the last frame's where nothing was measured [m]; ``support`` (5), from how many 3-D points
    each was taken, 0: not measured; and both with all 3-D points as ``found``, a
    ``person.date.features.Features`` or None. Cameras are in the order of the input ports.

    Raises:
        SettingsError: fewer than two cameras, or two of one name.
    """

    def __init__(self, cameras: Sequence[Camera]) -> None:
        super().__init__()
        size = 3 * len(FEATURES)
        self._views = ViewPorts(self, cameras)
        self.add_input("last_features", size)
        self.add_input("expected_features", size)
        found = self.add_output("found", None, self._find)

        def places(context: Context) -> Array:
            what = found.Eval(context)
            return np.full(size, np.nan) if what is None else what.places.ravel()

        def support(context: Context) -> Array:
            what = found.Eval(context)
            return np.zeros(len(FEATURES)) if what is None else what.support

        self.add_output("features", size, places)
        self.add_output("support", len(FEATURES), support)

    def _find(self, context: Context) -> Features | None:
        last = self.GetInputPort("last_features").Eval(context).reshape(-1, 3)
        if not np.isfinite(last).all():
            return None
        cameras, views = self._views.evaluate(context)
        expected = self.given(context, "expected_features")
        return find_features(
            cameras,
            [view.blobs.centroids for view in views],
            [view.region for view in views],
            last,
            None if expected is None else expected.reshape(-1, 3),
        )


class FaceDirectionFinder(PortedSystem):
    """Finds the direction of the face in the face camera's picture by eigenspace templates.

    .. pydrake_system::

        name: FaceDirectionFinder
        input_ports: [color_image, person_view]
        output_ports: [face_direction]

    The paper's face processing module (3.2). ``person_view`` is ``HorizontalImage``'s of the same
    picture. ``face_direction`` (2) is turn to the person's left and nod downwards, away from facing
    the camera [rad]; nan where no face is seen, or the camera has stopped. No face is farther from
    the eigenspace than ``farthest`` [grey levels].
    """

    def __init__(self, camera: Camera, templates: FaceTemplates, farthest: float = 30.0) -> None:
        super().__init__()
        self.camera = camera.name
        self.add_input("color_image", ImageRgba8U(camera.width, camera.height))
        self.add_input("person_view", None)

        def find(context: Context) -> Array:
            image, view = self.given(context, "color_image"), self.given(context, "person_view")
            if image is None or not image.size() or view is None:
                return np.full(2, np.nan)
            return find_face(colour_image_to_picture(image), view.blobs, templates, farthest)

        self.add_output("face_direction", 2, find)


class PoseRecogniser(PortedSystem):
    """Recognises the registered pose in what all cameras see, whatever went before (section 5).

    .. pydrake_system::

        name: PoseRecogniser
        input_ports: [person_view_<camera>]
        output_ports: [recognition, recognised_positions, similarity]

    A camera that is unconnected or gives None is left out. Outputs: ``recognised_positions`` (nq)
    of the person in the registered pose [rad or m], nan where it is not recognised;
    ``similarity`` of the contours, 0 where not recognised; and both as ``recognition``, a
    ``person.date.recognition.Recognition`` or None. It is recognised from a similarity of
    ``threshold`` on. Cameras are in the order of the input ports, as of the registered pose.
    """

    def __init__(
        self,
        skeleton: Skeleton,
        registered: RegisteredPose,
        cameras: Sequence[Camera],
        threshold: float = 0.93,
    ) -> None:
        super().__init__()
        views = ViewPorts(self, cameras)

        def see(context: Context) -> Recognition | None:
            going, seen = views.evaluate(context)
            contours = [view.contour for view in seen]
            return recognise(skeleton, registered, going, contours, threshold)

        def positions(context: Context) -> Array:
            found = recognition.Eval(context)
            return np.full(len(registered.q), np.nan) if found is None else found.q

        def similarity(context: Context) -> list[float]:
            found = recognition.Eval(context)
            return [0.0 if found is None else found.similarity]

        recognition = self.add_output("recognition", None, see)
        self.add_output("recognised_positions", len(registered.q), positions)
        self.add_output("similarity", 1, similarity)
