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
from pydrake.trajectories import Trajectory

from drake_pose.body import ArticulatedModel
from drake_pose.camera import Camera, PinholeCamera
from drake_pose.errors import SettingsError
from drake_pose.multiview.silhouette_fit import SilhouetteFit
from drake_pose.multiview.silhouette_tracker import SilhouetteTracker, TrackState
from drake_pose.systems.camera_rig import build_camera_rig
from drake_pose.systems.posed_geometry import add_avatar
from drake_pose.systems.silhouette_eye import SilhouetteEye, shows_somebody

# Before the values in the state: whether the person is known, the share that fits, the usual share,
# troubled frames, whether lost, the frame's time stamp, and the time since the frame before.
_SCALARS = 7
# After a pause a motion is expected to go on for no more than so many frames.
_LONGEST_PAUSE = 3.0


class PersonTracker(LeafSystem):
    """Follows a person from what several cameras' pictures say.

    .. pydrake_system::

        name: PersonTracker
        input_ports:
        - silhouette_<camera>
        - time
        output_ports:
        - estimated_positions
        - last_positions
        - share
        - time
        - seen

    ``silhouette_<camera>`` is a SilhouetteView, as SilhouetteEye gives it, or None: then the
    others go on without the camera, as they do where the port is not connected. ``time`` is the
    pictures' time stamp [s]: while it stays the same, or is nan, there is nothing new; where it is
    not connected, every period brings new pictures.

    The estimated positions are nan until the person is found and while the person is lost or seen
    by fewer than two cameras; the last ones known, at first the model's default, are another
    output, which an avatar can always show. Further outputs: the share of the contours that fits,
    0 where nobody was seen; the time stamp of the last pictures used; and for each camera whether
    it saw the person in them, 1 or 0.

    Args:
        tracker: made for the person's pose tree.
        cameras: the calibrated cameras, in the order of the input ports.
        period: time between two looks at the inputs [s].

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
        self._silhouettes = [
            self.DeclareAbstractInputPort(f"silhouette_{name}", AbstractValue.Make(None))
            for name in names
        ]
        self._time = self.DeclareVectorInputPort("time", 1)
        default = tracker.fit.tree.model.default_positions
        size = len(tracker.fit.lower)
        start = np.concatenate([np.zeros(_SCALARS), tracker.values(default), np.zeros(size)])
        start[_SCALARS - 2] = np.nan
        self._state = self.DeclareDiscreteState(start)
        self._seen = self.DeclareDiscreteState(len(names))
        self._last = self.DeclareDiscreteState(tracker.positions(tracker.values(default)))
        ticket = {self.discrete_state_ticket(self._state)}
        self.DeclareVectorOutputPort(
            "estimated_positions", len(default), self._calc_positions, ticket
        )
        self.DeclareStateOutputPort("last_positions", self._last)
        self.DeclareVectorOutputPort("share", 1, self._calc_share, ticket)
        self.DeclareVectorOutputPort("time", 1, self._calc_time, ticket)
        self.DeclareStateOutputPort("seen", self._seen)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._follow)

    def _follow(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        vector = context.get_discrete_state(self._state).value()
        before = float(vector[_SCALARS - 2])
        time = context.get_time()
        if self._time.HasValue(context):
            time = float(self._time.Eval(context)[0])
            if np.isnan(time) or time == before:
                return EventStatus.Succeeded()
        cameras, views, seen = [], [], np.zeros(len(self._cameras))
        for index, port in enumerate(self._silhouettes):
            view = port.Eval(context) if port.HasValue(context) else None
            if view is not None:
                cameras.append(self._cameras[index])
                views.append(view)
                seen[index] = float(shows_somebody(view))
        elapsed = 0.0 if np.isnan(before) else time - before
        last = _unpack(vector, elapsed)
        found = self._tracker.follow(last, cameras, views) if seen.sum() >= 2 else None
        if found is None and last is not None:
            found = TrackState(last.values, np.zeros(len(last.step)), 0.0, last.usual)
        discrete_state.set_value(self._seen, seen)
        if found is None:
            discrete_state.get_mutable_value(self._state)[_SCALARS - 2] = time
            return EventStatus.Succeeded()
        lost = found.share < self._tracker.settings.lost_below * found.usual
        discrete_state.set_value(self._state, _pack(found, lost, time, elapsed))
        if not lost:
            discrete_state.set_value(self._last, self._tracker.positions(found.values))
        return EventStatus.Succeeded()

    def _calc_positions(self, context: Context, output: BasicVector) -> None:
        vector = context.get_discrete_state(self._state).value()
        positions = self._tracker.positions(np.split(vector[_SCALARS:], 2)[0])
        known, lost = vector[0], vector[4]
        output.SetFromVector(positions if known and not lost else np.full(len(positions), np.nan))

    def _calc_share(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._state).value()[1:2])

    def _calc_time(self, context: Context, output: BasicVector) -> None:
        vector = context.get_discrete_state(self._state).value()
        output.SetFromVector(vector[_SCALARS - 2 : _SCALARS - 1])


def _pack(state: TrackState, lost: bool, time: float, elapsed: float) -> np.ndarray:
    scalars = [1.0, state.share, state.usual, state.troubled, lost, time, elapsed]
    return np.concatenate([scalars, state.values, state.step])


def _unpack(vector: np.ndarray, elapsed: float) -> TrackState | None:
    """The last frame's state after a time [s]; None where the person is not known yet."""
    known, share, usual, troubled, _, _, usually = vector[:_SCALARS]
    if not known:
        return None
    values, step = np.split(vector[_SCALARS:], 2)
    # Where frames were skipped, the motion has gone on for longer than from frame to frame.
    frames = min(elapsed / usually, _LONGEST_PAUSE) if usually > 0 and elapsed > 0 else 1.0
    return TrackState(values.copy(), frames * step, float(share), float(usual), int(troubled))


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
    for name, camera in cameras.items():
        eye = builder.AddNamedSystem(f"eye_{name}", SilhouetteEye(camera))
        builder.Connect(rig.GetOutputPort(f"label_image_{name}"), eye.get_input_port())
        builder.Connect(eye.get_output_port(), system.GetInputPort(f"silhouette_{name}"))
    for name in ("estimated_positions", "share"):
        builder.ExportOutput(system.GetOutputPort(name), name)
    if meshcat is not None:
        positions = system.GetOutputPort("last_positions")
        add_avatar(builder, model, positions, meshcat, "avatar", period)
    return builder.Build()
