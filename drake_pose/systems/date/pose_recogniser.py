"""The registered pose, recognised by its contours (Date et al., 3.1.1 and section 5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_pose.camera.models import Camera
from drake_pose.person.date.recognition import RegisteredPose, recognise
from drake_pose.person.date.skeleton import Skeleton
from drake_pose.systems.date.view_ports import ViewPorts


class PoseRecogniser(LeafSystem):
    """Recognises the registered pose in what all cameras see, whatever went before.

    .. pydrake_system::

        name: PoseRecogniser
        input_ports:
        - person_view_<camera>
        output_ports:
        - recognition
        - recognised_positions
        - similarity

    A camera that is unconnected or gives None is left out. Outputs: ``recognised_positions`` (nq)
    of the person in the registered pose [rad or m], nan where it is not recognised;
    ``similarity`` of the contours, 0 where not recognised; and both as ``recognition``, a
    ``person.date.recognition.Recognition`` or None.

    Args:
        skeleton: the person.
        registered: the registered pose, made for these cameras.
        cameras: the cameras on the circle, in the order of the input ports.
        threshold: similarity from which it is recognised.

    Raises:
        SettingsError: fewer than two cameras, or two of one name.
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
            "recognition", lambda: AbstractValue.Make(None), self._recognise, tickets
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
