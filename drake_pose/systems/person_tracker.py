"""A person followed by all silhouettes at once, as a Drake system and in a ready diagram."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat
from pydrake.systems.framework import (
    BasicVector,
    Context,
    Diagram,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)
from pydrake.systems.sensors import ImageLabel16I
from pydrake.trajectories import Trajectory

from drake_pose.body import ArticulatedModel
from drake_pose.camera import Camera, PinholeCamera
from drake_pose.errors import SettingsError
from drake_pose.multiview.silhouette_fit import SilhouetteFit
from drake_pose.multiview.silhouette_tracker import SilhouetteTracker, TrackState, see_silhouette
from drake_pose.silhouette import label_image_to_mask
from drake_pose.systems.camera_rig import build_camera_rig
from drake_pose.systems.posed_geometry import add_avatar

# A picture's height over the spacing of its region's edge points.
_EDGE_POINTS = 80.0
_SCALARS = 4


class PersonTracker(LeafSystem):
    """Follows a person from label images of several cameras.

    .. pydrake_system::

        name: PersonTracker
        input_ports:
        - label_image_<camera>
        output_ports:
        - estimated_positions
        - share

    An unconnected camera is left out: the others go on. Until the person is found the estimated
    positions are the model's default, and the share of the contours that fits is 0.

    Args:
        tracker: made for the person's pose tree.
        cameras: the calibrated cameras, in the order of the input ports.
        period: time between two frames [s].

    Raises:
        SettingsError: fewer than two cameras, two of one name, or a period that is not positive.
    """

    def __init__(
        self, tracker: SilhouetteTracker, cameras: Sequence[Camera], period: float
    ) -> None:
        super().__init__()
        names = [camera.name for camera in cameras]
        if len(names) < 2 or len(set(names)) != len(names):
            raise SettingsError(f"a person is tracked by two or more different cameras: {names}")
        if not period > 0:
            raise SettingsError(f"the tracker's period must be positive, not {period}")
        self._tracker, self._cameras = tracker, tuple(cameras)
        for camera in cameras:
            image = ImageLabel16I(camera.width, camera.height)
            self.DeclareAbstractInputPort(f"label_image_{camera.name}", AbstractValue.Make(image))
        default = tracker.fit.tree.model.default_positions
        size = len(tracker.fit.lower)
        # Known, share, usual share, troubled frames; values; their last step.
        start = np.concatenate([np.zeros(_SCALARS), tracker.values(default), np.zeros(size)])
        self._state = self.DeclareDiscreteState(start)
        ticket = {self.discrete_state_ticket(self._state)}
        self.DeclareVectorOutputPort(
            "estimated_positions", len(default), self._calc_positions, ticket
        )
        self.DeclareVectorOutputPort("share", 1, self._calc_share, ticket)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._follow)

    def _follow(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        cameras, views = [], []
        for index, camera in enumerate(self._cameras):
            port = self.get_input_port(index)
            if port.HasValue(context):
                mask = label_image_to_mask(port.Eval(context))
                cameras.append(camera)
                views.append(see_silhouette(mask, max(2.0, camera.height / _EDGE_POINTS)))
        vector = context.get_discrete_state(self._state).value()
        found = self._tracker.follow(_unpack(vector), cameras, views) if cameras else None
        if found is not None:
            discrete_state.set_value(self._state, _pack(found))
        return EventStatus.Succeeded()

    def _calc_positions(self, context: Context, output: BasicVector) -> None:
        vector = context.get_discrete_state(self._state).value()
        values = np.split(vector[_SCALARS:], 2)[0]
        output.SetFromVector(self._tracker.positions(values))

    def _calc_share(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._state).value()[1:2])


def _pack(state: TrackState) -> np.ndarray:
    scalars = [1.0, state.share, state.usual, float(state.troubled)]
    return np.concatenate([scalars, state.values, state.step])


def _unpack(vector: np.ndarray) -> TrackState | None:
    """None where the person is not known yet."""
    known, share, usual, troubled = vector[:_SCALARS]
    if not known:
        return None
    values, step = np.split(vector[_SCALARS:], 2)
    return TrackState(values.copy(), step.copy(), float(share), float(usual), int(troubled))


def build_person_capture(
    model: ArticulatedModel,
    cameras: Mapping[str, PinholeCamera],
    true_positions: Trajectory,
    period: float = 1.0 / 30.0,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """A simulated person, the cameras around it, what follows it, and the avatar in the browser.

    The diagram's outputs are ``estimated_positions`` and ``share``.

    Args:
        model: the person, with landmarks.yaml beside its file.
        cameras: two or more.
        true_positions: the person's positions (nq,) over time.
        period: time between two frames [s].
        meshcat: where the avatar is shown; None: nowhere.

    Raises:
        SettingsError: fewer than two cameras, or a period that is not positive.
        ModelError: the model has no landmarks of trunk, arms and legs.
    """
    builder = DiagramBuilder()
    tracker = SilhouetteTracker(SilhouetteFit(model.pose_tree()))
    system = builder.AddNamedSystem(
        "person_tracker", PersonTracker(tracker, list(cameras.values()), period)
    )
    rig = builder.AddNamedSystem(
        "camera_rig", build_camera_rig(model, cameras, true_positions).diagram
    )
    for name in cameras:
        port = f"label_image_{name}"
        builder.Connect(rig.GetOutputPort(port), system.GetInputPort(port))
    for name in ("estimated_positions", "share"):
        builder.ExportOutput(system.GetOutputPort(name), name)
    if meshcat is not None:
        positions = system.GetOutputPort("estimated_positions")
        add_avatar(builder, model, positions, meshcat, "avatar", period)
    return builder.Build()
