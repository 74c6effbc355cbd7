"""The paper's stages before the pose, as Drake systems (Date et al., sections 3 and 5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, LeafSystem, ValueProducer
from pydrake.systems.sensors import ImageLabel16I, ImageRgba8U

from drake_pose.camera.models import Camera
from drake_pose.errors import CameraError, SettingsError
from drake_pose.person.date.capture import PersonView, see_person
from drake_pose.person.date.faces import FaceTemplates, find_face
from drake_pose.person.date.features import FeatureSettings, find_features
from drake_pose.person.date.recognition import RegisteredPose, recognise
from drake_pose.person.date.skeleton import FEATURES, Skeleton
from drake_pose.person.date.skin_blobs import SkinColour
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.segmentation.background import Background, person_region
from drake_pose.systems.colour_images import colour_image_to_picture


def _allocate() -> AbstractValue:
    return AbstractValue.Make(None)


class ViewPorts:
    """The input ports ``person_view_<camera>`` of a system; tickets: of all of them.

    Raises SettingsError for fewer than two cameras, or two of one name.
    """

    def __init__(self, system: LeafSystem, cameras: Sequence[Camera]) -> None:
        names = [camera.name for camera in cameras]
        if len(names) < 2 or len(set(names)) != len(names):
            raise SettingsError(f"two or more different cameras are needed, not: {names}")
        self._cameras = tuple(cameras)
        self._ports = [
            system.DeclareAbstractInputPort(f"person_view_{name}", AbstractValue.Make(None))
            for name in names
        ]
        self.tickets = {port.ticket() for port in self._ports}

    def evaluate(self, context: Context) -> tuple[list[Camera], list[PersonView]]:
        """The cameras that go, and what they saw; unconnected ones and None are left out."""
        pairs = [
            (camera, port.Eval(context))
            for camera, port in zip(self._cameras, self._ports, strict=True)
            if port.HasValue(context)
        ]
        seen = [(camera, view) for camera, view in pairs if view is not None]
        return [camera for camera, _ in seen], [view for _, view in seen]


class HorizontalImage(LeafSystem):
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
        self._camera, self._background, self._skin = camera, background, skin or SkinColour()
        self._color = self.DeclareAbstractInputPort(
            "color_image", AbstractValue.Make(ImageRgba8U(*size))
        )
        self._label = self.DeclareAbstractInputPort(
            "label_image", AbstractValue.Make(ImageLabel16I(*size))
        )
        color, label = self._color.ticket(), self._label.ticket()
        self._picture = self.DeclareCacheEntry(
            "picture", ValueProducer(_allocate, self._calc_picture), {color}
        )
        self._region = self.DeclareAbstractOutputPort(
            "region", _allocate, self._calc_region, {color, label}
        )
        self.DeclareAbstractOutputPort("person_view", _allocate, self._calc_view, {color, label})

    def _calc_picture(self, context: Context, output: AbstractValue) -> None:
        """The picture (H, W, 3); None while the camera has stopped."""
        output.set_value(None)
        if self._color.HasValue(context):
            picture = colour_image_to_picture(self._color.Eval(context))
            if picture.size:
                self._require_size(picture, "color image")
                output.set_value(picture)

    def _calc_region(self, context: Context, output: AbstractValue) -> None:
        picture = self._picture.Eval(context)
        if picture is None:
            output.set_value(None)
        elif self._label.HasValue(context):
            mask = label_image_to_mask(self._label.Eval(context))
            self._require_size(mask, "label image")
            output.set_value(mask)
        elif self._background is not None:
            output.set_value(person_region(picture, self._background))
        else:
            raise SettingsError(
                f"camera '{self._camera.name}': nothing tells the person from what is behind; give "
                "a background model or connect label_image"
            )

    def _calc_view(self, context: Context, output: AbstractValue) -> None:
        picture, region = self._picture.Eval(context), self._region.Eval(context)
        seen = None if picture is None else see_person(picture, region, self._skin)
        output.set_value(seen)

    def _require_size(self, image: NDArray[np.generic], kind: str) -> None:
        camera = self._camera
        if image.shape[:2] != (camera.height, camera.width):
            raise CameraError(
                f"camera '{camera.name}': its {kind} has {image.shape[1]} x {image.shape[0]} "
                f"pixels (width x height), but it was calibrated with {camera.width} x "
                f"{camera.height}"
            )


class FeatureFinder(LeafSystem):
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

    def __init__(self, cameras: Sequence[Camera], settings: FeatureSettings | None = None) -> None:
        super().__init__()
        self._settings = settings or FeatureSettings()
        self._views = ViewPorts(self, cameras)
        self._last = self.DeclareVectorInputPort("last_features", 3 * len(FEATURES))
        self._expected = self.DeclareVectorInputPort("expected_features", 3 * len(FEATURES))
        tickets = {*self._views.tickets, self._last.ticket(), self._expected.ticket()}
        self._found = self.DeclareAbstractOutputPort("found", _allocate, self._find, tickets)
        self.DeclareVectorOutputPort("features", 3 * len(FEATURES), self._calc_features, tickets)
        self.DeclareVectorOutputPort("support", len(FEATURES), self._calc_support, tickets)

    def _find(self, context: Context, output: AbstractValue) -> None:
        last = self._last.Eval(context).reshape(-1, 3)
        if not np.isfinite(last).all():
            output.set_value(None)
            return
        cameras, views = self._views.evaluate(context)
        centroids = [view.blobs.centroids for view in views]
        regions = [view.region for view in views]
        is_given = self._expected.HasValue(context)
        expected = self._expected.Eval(context).reshape(-1, 3) if is_given else None
        output.set_value(find_features(cameras, centroids, regions, last, self._settings, expected))

    def _calc_features(self, context: Context, output: BasicVector) -> None:
        found = self._found.Eval(context)
        places = np.full(output.size(), np.nan) if found is None else found.places.ravel()
        output.SetFromVector(places)

    def _calc_support(self, context: Context, output: BasicVector) -> None:
        found = self._found.Eval(context)
        output.SetFromVector(np.zeros(output.size()) if found is None else found.support)


class FaceDirectionFinder(LeafSystem):
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
        self._templates, self._farthest = templates, farthest
        self._color = self.DeclareAbstractInputPort(
            "color_image", AbstractValue.Make(ImageRgba8U(camera.width, camera.height))
        )
        self._view = self.DeclareAbstractInputPort("person_view", AbstractValue.Make(None))
        tickets = {port.ticket() for port in (self._color, self._view)}
        self.DeclareVectorOutputPort("face_direction", 2, self._calc_direction, tickets)

    def _calc_direction(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(np.full(2, np.nan))
        if not (self._color.HasValue(context) and self._view.HasValue(context)):
            return
        picture = colour_image_to_picture(self._color.Eval(context))
        view = self._view.Eval(context)
        if picture.size and view is not None:
            found = find_face(picture, view.blobs, self._templates, self._farthest)
            output.SetFromVector(found)


class PoseRecogniser(LeafSystem):
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
        self._skeleton, self._registered, self._threshold = skeleton, registered, threshold
        self._views = ViewPorts(self, cameras)
        tickets = self._views.tickets
        self._recognition = self.DeclareAbstractOutputPort(
            "recognition", _allocate, self._recognise, tickets
        )
        self.DeclareVectorOutputPort(
            "recognised_positions", len(registered.q), self._calc_positions, tickets
        )
        self.DeclareVectorOutputPort("similarity", 1, self._calc_similarity, tickets)

    def _recognise(self, context: Context, output: AbstractValue) -> None:
        cameras, views = self._views.evaluate(context)
        contours = [view.contour for view in views]
        output.set_value(
            recognise(self._skeleton, self._registered, cameras, contours, self._threshold)
        )

    def _calc_positions(self, context: Context, output: BasicVector) -> None:
        found = self._recognition.Eval(context)
        output.SetFromVector(np.full(output.size(), np.nan) if found is None else found.q)

    def _calc_similarity(self, context: Context, output: BasicVector) -> None:
        found = self._recognition.Eval(context)
        output.SetFromVector([0.0 if found is None else found.similarity])
