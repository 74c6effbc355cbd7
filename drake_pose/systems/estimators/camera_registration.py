"""Where a camera stands, as a Drake system: label images and measured positions in, X_WC out."""

from collections.abc import Collection

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State
from pydrake.systems.sensors import ImageLabel16I

from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import SettingsError
from drake_pose.registration.online_registration import (
    CameraStatus,
    OnlineRegistration,
    OnlineState,
)
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.register import RegisteredCamera
from drake_pose.silhouette.pictures.label_images import label_image_to_mask

REGISTRATION = ("keyframes", "contradictions", "moves", "mean_iou")
"""What the elements of the output ``registration`` of CameraRegistration are."""


class CameraRegistration(LeafSystem):
    """Finds where a camera stands from a body at measured positions, and whether it was moved.

    .. pydrake_system::

        name: CameraRegistration
        input_ports: [label_image, measured_positions]
        output_ports: [X_WC, covariance, status, registration]

    No guess of the pose is needed. A periodic update keeps frames in which the body stands
    differently, and searches when there are enough of them; from then on the pose is fitted anew
    whenever another one is kept, the oldest are forgotten, and a camera that was moved is found
    again. All pixels with a label other than Drake's reserved ones belong to the body, or those
    with the given labels. An image that is not connected or shows nothing of the body says nothing,
    nor do positions that are not finite. Image and positions must be of the same moment.

    - ``X_WC``: a RigidTransform, the camera's pose in the world of the body's plant. Until it is
      found its translation is nan; later it is the last one found.
    - ``covariance`` (6 x 6, row by row): of the pose's error, a rotation vector [rad] and a shift
      [m] along the world's axes, in this order. Infinite unless the status is 1.
    - ``status``: 0 while the camera is not found yet; 1 while the pose holds; 2 while the last
      frames contradict it, because the camera has been moved, or the body is hidden: then X_WC must
      not be used. It is 1 again as soon as a frame agrees, or the camera is found elsewhere.
    - ``registration``: see ``REGISTRATION``. How many frames are kept; how many frames in a row
      contradict the pose; how often the camera was found elsewhere; and intersection over union of
      body and mask, the mean over the kept frames, nan until the camera is found.

    All that is known is state of the context; copies share it.

    Args:
        period, offset: time between two updates, and of the first one [s].
        labels: the labels that belong to the body; None: all that are not reserved.

    Raises:
        SettingsError: a period that is not positive.
    """

    def __init__(
        self,
        registration: OnlineRegistration,
        period: float,
        offset: float = 0.0,
        labels: Collection[int] | None = None,
    ) -> None:
        super().__init__()
        if not period > 0:
            raise SettingsError(f"the registration's period must be positive, not {period}")
        self._registration = registration
        self._tree, camera = registration.body.tree, registration.camera
        self._labels = None if labels is None else frozenset(labels)
        image = ImageLabel16I(camera.width, camera.height)
        self._image = self.DeclareAbstractInputPort("label_image", AbstractValue.Make(image))
        self._positions = self.DeclareVectorInputPort(
            "measured_positions", len(self._tree.model.position_names)
        )
        self._state = self.DeclareAbstractState(AbstractValue.Make(OnlineState()))
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareAbstractOutputPort(
            "X_WC", lambda: AbstractValue.Make(RigidTransform()), self._calc_X_WC, ticket
        )
        self.DeclareVectorOutputPort("covariance", 36, self._calc_covariance, ticket)
        self.DeclareVectorOutputPort("status", 1, self._calc_status, ticket)
        self.DeclareVectorOutputPort(
            "registration", len(REGISTRATION), self._calc_registration, ticket
        )
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, offset, self._update)

    def online_state(self, context: Context) -> OnlineState:
        """What is known in a context."""
        state: OnlineState = context.get_abstract_state(int(self._state)).get_value()
        return state

    def registered_camera(self, context: Context) -> PinholeCamera | None:
        """The camera with its pose, for searches and estimators; None unless the status is 1."""
        believed = self._believed(context)
        return None if believed is None else believed.camera

    def _believed(self, context: Context) -> RegisteredCamera | None:
        """The camera as it was found; None unless the status is 1."""
        state = self.online_state(context)
        is_believed = self._registration.status(state) is CameraStatus.REGISTERED
        return state.registered if is_believed else None

    def _update(self, context: Context, state: State) -> EventStatus:
        if not self._image.HasValue(context):
            return EventStatus.DidNothing()
        q = np.array(self._positions.Eval(context))
        if not np.isfinite(q).all():
            return EventStatus.DidNothing()
        values = np.concatenate(self._tree.values_from_positions(q))
        mask = label_image_to_mask(self._image.Eval(context), self._labels)
        frame = PosedFrame(f"{context.get_time():g} s", values, mask)
        known = self._registration.next(self.online_state(context), frame)
        state.get_mutable_abstract_state(int(self._state)).set_value(known)
        return EventStatus.Succeeded()

    def _calc_X_WC(self, context: Context, output: AbstractValue) -> None:
        registered = self.online_state(context).registered
        if registered is None:
            output.set_value(RigidTransform(np.full(3, np.nan)))
        else:
            output.set_value(RigidTransform(registered.camera.X_WC))

    def _calc_covariance(self, context: Context, output: BasicVector) -> None:
        believed = self._believed(context)
        covariance = np.diag(np.full(6, np.inf)) if believed is None else believed.covariance
        output.SetFromVector(covariance.ravel())

    def _calc_status(self, context: Context, output: BasicVector) -> None:
        status = self._registration.status(self.online_state(context))
        output.SetFromVector(np.array([float(status)]))

    def _calc_registration(self, context: Context, output: BasicVector) -> None:
        state = self.online_state(context)
        iou = np.nan
        if state.registered is not None:
            iou = float(np.mean([frame.iou for frame in state.registered.frames]))
        counts = [len(state.keyframes), state.contradictions, state.moves]
        output.SetFromVector(np.array([*counts, iou], dtype=float))
