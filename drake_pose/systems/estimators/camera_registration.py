"""Where a camera stands, as a Drake system: label images and measured positions in, X_WC out."""

from collections.abc import Collection

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageLabel16I

from drake_pose.arrays import Array
from drake_pose.camera.models import PinholeCamera
from drake_pose.registration.online_registration import (
    CameraStatus,
    OnlineRegistration,
    OnlineState,
)
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.register import RegisteredCamera
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.systems.ports import BeliefSystem, require_period

REGISTRATION = ("keyframes", "contradictions", "moves", "mean_iou")
"""What the elements of the output ``registration`` of CameraRegistration are."""


class CameraRegistration(BeliefSystem[OnlineState]):
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
        period: time between two updates [s].
        labels: the labels that belong to the body; None: all that are not reserved.

    Raises:
        SettingsError: a period that is not positive.
    """

    def __init__(
        self,
        registration: OnlineRegistration,
        period: float,
        labels: Collection[int] | None = None,
    ) -> None:
        super().__init__()
        require_period("registration", period)
        self._registration = registration
        self._tree, camera = registration.body.tree, registration.camera
        self._labels = None if labels is None else frozenset(labels)
        self.add_input("label_image", ImageLabel16I(camera.width, camera.height))
        self.add_input("measured_positions", len(self._tree.model.position_names))
        self.keep_belief(OnlineState(), period)
        self.show("X_WC", RigidTransform(), _X_WC)
        self.show("covariance", 36, self._covariance)
        self.show("status", 1, lambda known: [float(registration.status(known))])
        self.show("registration", len(REGISTRATION), _numbers)

    def registered_camera(self, context: Context) -> PinholeCamera | None:
        """The camera with its pose, for searches and estimators; None unless the status is 1."""
        believed = self._believed(self.belief(context))
        return None if believed is None else believed.camera

    def next_belief(self, context: Context, last: OnlineState) -> OnlineState:
        """What is known with one frame more."""
        image = self.given(context, "label_image")
        if image is None:
            return last
        q = np.array(self.GetInputPort("measured_positions").Eval(context))
        if not np.isfinite(q).all():
            return last
        values = np.concatenate(self._tree.values_from_positions(q))
        mask = label_image_to_mask(image, self._labels)
        return self._registration.next(last, PosedFrame(f"{context.get_time():g} s", values, mask))

    def _believed(self, known: OnlineState) -> RegisteredCamera | None:
        """The camera as it was found; None unless the status is 1."""
        is_believed = self._registration.status(known) is CameraStatus.REGISTERED
        return known.registered if is_believed else None

    def _covariance(self, known: OnlineState) -> Array:
        believed = self._believed(known)
        covariance = np.diag(np.full(6, np.inf)) if believed is None else believed.covariance
        return covariance.ravel()


def _X_WC(known: OnlineState) -> RigidTransform:
    """The camera's pose as it was last found."""
    if known.registered is None:
        return RigidTransform(np.full(3, np.nan))
    return RigidTransform(known.registered.camera.X_WC)


def _numbers(known: OnlineState) -> list[float]:
    """REGISTRATION."""
    iou = np.nan
    if known.registered is not None:
        iou = float(np.mean([frame.iou for frame in known.registered.frames]))
    return [len(known.keyframes), known.contradictions, known.moves, iou]
