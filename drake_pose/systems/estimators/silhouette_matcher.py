"""The matcher as a Drake system: label images in, estimated positions out."""

from collections.abc import Collection, Sequence

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteStateIndex,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)
from pydrake.systems.sensors import ImageLabel16I

from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.search.estimates import PoseEstimate, View
from drake_pose.search.scoring import PoseSearch
from drake_pose.silhouette.pictures.label_images import label_image_to_mask

STATISTICS = ("found", "J", "E_total", "first_E_total", "runs", "outside_limit", "seconds")
"""What the elements of the output ``statistics`` are."""


def label_image_port(camera: Camera, cameras: Sequence[Camera]) -> str:
    """Name of the port that carries a camera's label image, where there are ``cameras``."""
    return "label_image" if len(cameras) == 1 else f"label_image_{camera.name}"


class SilhouetteMatcher(LeafSystem):
    """Estimates the positions of an articulated body from label images.

    .. pydrake_system::

        name: SilhouetteMatcher
        input_ports:
        - label_image
        - root_position (optional)
        output_ports:
        - estimated_positions
        - error
        - base_pose
        - body_poses
        - statistics
        - proved_optimal
        - determined
        - lower
        - upper
        - family_positions

    With several cameras the input ports are ``label_image_<camera>``; an unconnected one, or an
    image without any pixel of the body, is left out of the match. All pixels with a label other
    than Drake's reserved ones belong to the body, or those with the given labels.

    The match is made in a periodic update. Until the first one, and where no pose is found, the
    estimated positions are the last ones (at first the model's default), and the error is infinite.
    ``body_poses`` are the poses of all bodies in the scene's world, in the plant's order, as a
    plant's output of that name gives them: a SilhouetteCamera draws what is estimated.

    What the answer is worth: ``proved_optimal`` is 1 where it is proved that no pose of the grid
    that was searched fits better. ``determined`` is 1 for each position that the silhouettes
    determine, 0 for one that is free; ``lower`` and ``upper`` are the ends of its interval, or of
    the range seen. ``family_positions`` are the positions of the families that look the same, best
    first, one after another. All are NaN where the search does not say, as one without examination.

    Args:
        search: the search, made for the body's pose tree.
        cameras: the calibrated cameras, in the order of the input ports.
        period: time between two matches [s].
        offset: time of the first match [s].
        labels: the labels that belong to the body; None: all that are not reserved.
        family_limit: how many families are given out at most.

    Raises:
        SettingsError: if there is no camera, two cameras share a name, the period is not positive,
            or the family limit is below 1.
    """

    def __init__(
        self,
        search: PoseSearch,
        cameras: Sequence[Camera],
        period: float,
        offset: float = 0.0,
        labels: Collection[int] | None = None,
        family_limit: int = 4,
    ) -> None:
        super().__init__()
        names = [camera.name for camera in cameras]
        if not cameras or len(set(names)) != len(names):
            raise SettingsError(f"a matcher needs one or more cameras of different names: {names}")
        if not period > 0:
            raise SettingsError(f"the matcher's period must be positive, not {period}")
        if family_limit < 1:
            raise SettingsError(f"the family limit must be 1 or more, not {family_limit}")
        self._search = search
        self._cameras = tuple(cameras)
        self._labels = None if labels is None else frozenset(labels)
        model = search.tree.model
        position_count = model.plant.num_positions()
        for camera in cameras:
            image = ImageLabel16I(camera.width, camera.height)
            self.DeclareAbstractInputPort(
                label_image_port(camera, cameras), AbstractValue.Make(image)
            )
        self._root_position = self.DeclareVectorInputPort("root_position", 3)
        no_match = np.zeros(len(STATISTICS))
        no_match[[1, 2, 3]] = np.inf
        self._positions = self.DeclareDiscreteState(model.default_positions)
        self._base_pose = self.DeclareDiscreteState(np.eye(4)[:3].ravel())
        self._statistics = self.DeclareDiscreteState(no_match)
        self._declare_estimates(position_count)
        self._worth = [
            self._declare_nan_output(name, size)
            for name, size in (
                ("proved_optimal", 1),
                ("determined", position_count),
                ("lower", position_count),
                ("upper", position_count),
                ("family_positions", family_limit * position_count),
            )
        ]
        self.DeclarePeriodicDiscreteUpdateEvent(period, offset, self._match)
        self.last_result: PoseEstimate | None = None

    def _declare_estimates(self, position_count: int) -> None:
        """The outputs of what is estimated, which only read the state."""
        states = {self.discrete_state_ticket(self._positions)}
        self.DeclareVectorOutputPort(
            "estimated_positions", position_count, self._calc_positions, states
        )
        statistics_ticket = {self.discrete_state_ticket(self._statistics)}
        self.DeclareVectorOutputPort("error", 1, self._calc_error, statistics_ticket)
        self.DeclareAbstractOutputPort(
            "base_pose",
            lambda: AbstractValue.Make(RigidTransform()),
            self._calc_base_pose,
            {self.discrete_state_ticket(self._base_pose)},
        )
        self.DeclareAbstractOutputPort(
            "body_poses",
            lambda: AbstractValue.Make([RigidTransform()]),
            self._calc_body_poses,
            {*states, self.discrete_state_ticket(self._base_pose)},
        )
        self.DeclareVectorOutputPort(
            "statistics", len(STATISTICS), self._calc_statistics, statistics_ticket
        )

    def _declare_nan_output(self, name: str, size: int) -> DiscreteStateIndex:
        """A state, NaN at first, and the output that gives it out."""
        state = self.DeclareDiscreteState(np.full(size, np.nan))

        def calculate(context: Context, output: BasicVector) -> None:
            output.SetFromVector(context.get_discrete_state(state).value())

        self.DeclareVectorOutputPort(name, size, calculate, {self.discrete_state_ticket(state)})
        return state

    def _views(self, context: Context) -> list[View]:
        views = []
        for index, camera in enumerate(self._cameras):
            port = self.get_input_port(index)
            if not port.HasValue(context):
                continue
            mask = label_image_to_mask(port.Eval(context), self._labels)
            if mask.any():
                views.append(View(camera, mask))
        return views

    def _match(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        views = self._views(context)
        statistics = np.zeros(len(STATISTICS))
        statistics[[1, 2, 3]] = np.inf
        self.last_result = None
        for state in self._worth:
            discrete_state.set_value(state, np.full(discrete_state.value(state).size, np.nan))
        if self._is_seen(context, views):
            root_position = None
            if self._root_position.HasValue(context):
                root_position = self._root_position.Eval(context)
            result = self._find(context, discrete_state, views, root_position)
            self.last_result = result
            search = result.statistics
            statistics[4:] = search.runs, max(search.outside_limit, default=0.0), result.seconds
            if result.found:
                statistics[:4] = 1.0, result.J, result.E_total, result.first_E_total
                discrete_state.set_value(self._positions, result.q)
                discrete_state.set_value(self._base_pose, result.X_WB[:3].ravel())
                self._set_worth(result, discrete_state)
        discrete_state.set_value(self._statistics, statistics)
        return EventStatus.Succeeded()

    def _is_seen(self, context: Context, views: Sequence[View]) -> bool:
        """Whether there is anything to find a pose in."""
        return bool(views)

    def _find(
        self,
        context: Context,
        discrete_state: DiscreteValues,
        views: Sequence[View],
        root_position: np.ndarray | None,
    ) -> PoseEstimate:
        """The pose that the views show."""
        return self._search.match(views, root_position)

    def _set_worth(self, result: PoseEstimate, discrete_state: DiscreteValues) -> None:
        """Put what the answer is worth into the state."""
        proved, determined, lower, upper, families = self._worth
        answer = result.pose_set
        if answer is None:
            return
        names = self._search.tree.model.position_names
        positions = np.full((discrete_state.value(families).size // len(names), len(names)), np.nan)
        found = [family.q for family in answer.families[: len(positions)]]
        positions[: len(found)] = found
        discrete_state.set_value(proved, np.array([float(result.proved_optimal)]))
        intervals = answer.position_intervals(names)
        for state, values in zip((determined, lower, upper), intervals, strict=True):
            discrete_state.set_value(state, values)
        discrete_state.set_value(families, positions.ravel())

    def _calc_positions(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._positions).value())

    def _calc_error(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._statistics).value()[2:3])

    def _calc_statistics(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._statistics).value())

    def _X_WB(self, context: Context) -> RigidTransform:
        """The pose in the scene's world of the frame that the plant takes for its world."""
        X_WB = np.eye(4)
        X_WB[:3] = context.get_discrete_state(self._base_pose).value().reshape(3, 4)
        return RigidTransform(X_WB)

    def _calc_base_pose(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._X_WB(context))

    def _calc_body_poses(self, context: Context, output: AbstractValue) -> None:
        plant = self._search.tree.model.plant
        plant_context = plant.CreateDefaultContext()
        plant.SetPositions(plant_context, context.get_discrete_state(self._positions).value())
        X_WB = self._X_WB(context)
        poses = plant.get_body_poses_output_port().Eval(plant_context)
        output.set_value([X_WB @ pose for pose in poses])
