"""Where the face looks (Date et al., 3.2) as a Drake system."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, LeafSystem
from pydrake.systems.sensors import ImageRgba8U

from drake_pose.camera.models import Camera
from drake_pose.person.date.faces import FaceTemplates, find_face
from drake_pose.systems.colour_images import colour_image_to_picture


class FaceDirectionFinder(LeafSystem):
    """Finds the direction of the face in the face camera's picture by eigenspace templates.

    .. pydrake_system::

        name: FaceDirectionFinder
        input_ports:
        - color_image
        - person_view
        output_ports:
        - face_direction

    The paper's face processing module. ``person_view`` is ``HorizontalImage``'s of the same
    picture. ``face_direction`` (2) is turn to the person's left and nod downwards, away from facing
    the camera [rad]; nan where no face is seen, or the camera has stopped.

    Args:
        camera: the face camera.
        templates: faces of known directions.
        farthest: how far from the eigenspace a face may be [grey levels].
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
