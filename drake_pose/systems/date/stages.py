"""The paper's stages before the pose, as Drake systems (Date et al., sections 3 and 5)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageRgba8U

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera
from drake_pose.person.date.faces import FaceTemplates, find_face
from drake_pose.person.date.features import Features, SkinColour, find_features
from drake_pose.person.date.recognition import Recognition, RegisteredPose, recognise
from drake_pose.person.date.skeleton import FEATURES, Skeleton
from drake_pose.silhouette.segmentation.background import Background
from drake_pose.systems.date.preparation import PersonView, see_person
from drake_pose.systems.images import colour_image_to_picture
from drake_pose.systems.pictures.person_region import PersonRegion
from drake_pose.systems.ports import PortedSystem, require_different

Seen = Callable[[Context], tuple[list[Camera], list[PersonView]]]
"""The cameras that go, and what they saw; unconnected ones and None are left out."""


def add_views(system: PortedSystem, cameras: Sequence[Camera]) -> Seen:
    """The input ports ``person_view_<camera>`` of a system, and what comes in.

    Raises SettingsError for fewer than two cameras, or two of one name.
    """
    require_different(cameras, 2, "two or more different cameras are needed, not")
    given = system.add_camera_inputs({one.name: f"person_view_{one.name}" for one in cameras})

    def seen(context: Context) -> tuple[list[Camera], list[PersonView]]:
        views = given(context)
        return [one for one in cameras if one.name in views], list(views.values())

    return seen


class HorizontalImage(PersonRegion):
    """Finds the person in one camera's picture: region, skin-coloured blobs in it, contour.

    .. pydrake_system::

        name: HorizontalImage
        input_ports: [color_image, label_image (optional)]
        output_ports: [region, person_view]

    The paper's horizontal image processing module (3.1.1). Outputs: ``region``, see PersonRegion,
    and ``person_view``, a ``systems.date.preparation.PersonView``, None where either image is lost.
    """

    def __init__(
        self, camera: Camera, background: Background | None = None, skin: SkinColour | None = None
    ) -> None:
        super().__init__(camera, background)
        self.wanted = ("color_image",) if background is not None else ("color_image", "label_image")

        def see(context: Context) -> PersonView | None:
            picture, region = self.picture.Eval(context), self.region.Eval(context)
            if picture is None or region is None:
                return None
            return see_person(picture, region, skin or SkinColour())

        self.add_output("person_view", None, see)


class FeatureFinder(PortedSystem):
    """Finds head, hands and feet in space where the rays of skin-coloured blobs meet.

    .. pydrake_system::

        name: FeatureFinder
        input_ports: [person_view_<camera>, last_features, expected_features (optional)]
        output_ports: [found, features, support]

    The first part of the paper's 3-D module (3.1.2). A camera that is unconnected or gives None is
    left out. ``last_features`` (15) are the last frame's: head, left hand, right hand, left foot,
    right foot [m]; while they are nan nothing is found. ``expected_features`` (15) are where they
    are expected in this frame [m]; where unconnected, or feet are not tracked, as in the paper, the
    last frame's places count. Outputs: ``features``
    (15), the last frame's where nothing was measured [m]; ``support`` (5), from how many 3-D points
    each was taken, 0: not measured; and both with all 3-D points as ``found``, a
    ``person.date.features.Features`` or None. Cameras are in the order of the input ports.

    Raises:
        SettingsError: fewer than two cameras, or two of one name.
    """

    def __init__(self, cameras: Sequence[Camera], track_feet: bool = True) -> None:
        super().__init__()
        self._track_feet, size = track_feet, 3 * len(FEATURES)
        self._seen = add_views(self, cameras)
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
        cameras, views = self._seen(context)
        expected = self.given(context, "expected_features") if self._track_feet else None
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
        seen_by = add_views(self, cameras)

        def see(context: Context) -> Recognition | None:
            going, seen = seen_by(context)
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
