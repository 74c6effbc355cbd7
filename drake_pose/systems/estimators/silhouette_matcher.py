"""The matcher as a Drake system: label images in, estimated positions out."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State
from pydrake.systems.sensors import ImageLabel16I

from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.search.estimates import PoseEstimate, View
from drake_pose.search.scoring import PoseSearch
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.systems.shared_value import SharedValue

Array = NDArray[np.float64]

STATISTICS = ("found", "J", "E_total", "first_E_total", "runs", "outside_limit", "seconds")
"""What the elements of the output ``statistics`` are."""


def camera_port(kind: str, camera: Camera, cameras: Sequence[Camera]) -> str:
    """Name of the port that carries a camera's image of a kind, where there are ``cameras``."""
    return kind if len(cameras) == 1 else f"{kind}_{camera.name}"


@dataclass(frozen=True, eq=False)
class Matched(SharedValue):
    """What is known after an update.

    Args:
        q, X_WB: (nq,) the last pose that was found, and (4, 4) its base.
        estimate: this update's; None: there was nothing to see.
        memory: what a tracker hands to its next update.
    """

    q: Array
    X_WB: Array
    estimate: PoseEstimate | None
    memory: Any


class SilhouetteMatcher(LeafSystem):
    """Estimates the positions of an articulated body from label images.

    .. pydrake_system::

        name: SilhouetteMatcher
        input_ports: [label_image, root_position (optional)]
        output_ports: [estimated_positions, error, base_pose, body_poses, statistics,
          proved_optimal, determined, lower, upper, family_positions, pose_estimate]

    With several cameras the input ports are ``label_image_<camera>``; an unconnected one, or an
    image without any pixel of the body, is left out of the match. All pixels with a label other
    than Drake's reserved ones belong to the body, or those with the given labels.

    The match is made in a periodic update. Until the first one, and where no pose is found, the
    estimated positions are the last ones (at first the model's default), and the error is infinite.
    ``body_poses`` are the poses of all bodies in the scene's world, in the plant's order, as a
    plant's output of that name gives them. ``pose_estimate`` is the whole ``PoseEstimate`` of the
    last update, None where no camera saw the body.

    What the answer is worth: ``proved_optimal`` is 1 where it is proved that no pose of the grid
    that was searched fits better. ``determined`` is 1 for each position that the silhouettes
    determine, 0 for one that is free; ``lower`` and ``upper`` are the ends of its interval, or of
    the range seen. ``family_positions`` are the positions of the families that look the same, best
    first, one after another. All are NaN where the search does not say, as one without examination.

    Args:
        cameras: the calibrated cameras, in the order of the input ports.
        period, offset: time between two matches, and of the first one [s].
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
        self._search, self._cameras, self._family_limit = search, tuple(cameras), family_limit
        self._labels = None if labels is None else frozenset(labels)
        for camera in cameras:
            image = AbstractValue.Make(ImageLabel16I(camera.width, camera.height))
            self.DeclareAbstractInputPort(camera_port("label_image", camera, cameras), image)
        self._root_position = self.DeclareVectorInputPort("root_position", 3)
        first = Matched(search.tree.model.default_positions, np.eye(4), None, self._first_memory())
        self._state = self.DeclareAbstractState(AbstractValue.Make(first))
        self._declare_outputs(search.tree.model.plant.num_positions())
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, offset, self._match)
        self.DeclareForcedUnrestrictedUpdateEvent(self._match)

    def _declare_outputs(self, position_count: int) -> None:
        ticket = self._ticket = {self.abstract_state_ticket(self._state)}
        for name, size, calc in (
            ("estimated_positions", position_count, self._calc_positions),
            ("error", 1, self._calc_error),
            ("statistics", len(STATISTICS), self._calc_statistics),
        ):
            self.DeclareVectorOutputPort(name, size, calc, ticket)
        for name, initial, calc_value in (
            ("base_pose", RigidTransform(), self._calc_base_pose),
            ("body_poses", [RigidTransform()], self._calc_body_poses),
            ("pose_estimate", None, self._calc_estimate),
        ):
            value = AbstractValue.Make(initial)
            self.DeclareAbstractOutputPort(name, value.Clone, calc_value, ticket)
        for row, (name, count) in enumerate(
            (
                ("proved_optimal", 1),
                ("determined", position_count),
                ("lower", position_count),
                ("upper", position_count),
                ("family_positions", self._family_limit * position_count),
            )
        ):

            def calc_worth(context: Context, output: BasicVector, row: int = row) -> None:
                worth = self._worth(self._matched(context).estimate)
                output.SetFromVector(
                    np.full(output.size(), np.nan) if worth is None else worth[row]
                )

            self.DeclareVectorOutputPort(name, count, calc_worth, ticket)

    def _matched(self, context: Context) -> Matched:
        matched: Matched = context.get_abstract_state(int(self._state)).get_value()
        return matched

    def _views(self, context: Context) -> list[View]:
        views = []
        for index, camera in enumerate(self._cameras):
            port = self.get_input_port(index)
            if port.HasValue(context):
                mask = label_image_to_mask(port.Eval(context), self._labels)
                if mask.any():
                    views.append(View(camera, mask))
        return views

    def _match(self, context: Context, state: State) -> EventStatus:
        last, views = self._matched(context), self._views(context)
        q, X_WB, estimate, memory = last.q, last.X_WB, None, last.memory
        if self._is_seen(context, views):
            root_position = None
            if self._root_position.HasValue(context):
                root_position = self._root_position.Eval(context)
            estimate, memory = self._find(context, memory, views, root_position)
            if estimate.found:
                q, X_WB = estimate.q, estimate.X_WB
        known = Matched(q, X_WB, estimate, memory)
        state.get_mutable_abstract_state(int(self._state)).set_value(known)
        return EventStatus.Succeeded()

    def _first_memory(self) -> Any:
        """What the first update gets as its memory."""
        return None

    def _is_seen(self, context: Context, views: Sequence[View]) -> bool:
        """Whether there is anything to find a pose in."""
        return bool(views)

    def _find(
        self, context: Context, memory: Any, views: Sequence[View], root_position: Array | None
    ) -> tuple[PoseEstimate, Any]:
        """The pose that the views show, and what the next update gets as its memory."""
        return self._search.match(views, root_position), None

    def _worth(self, estimate: PoseEstimate | None) -> Sequence[Array] | None:
        """What an answer is worth, in the order of the ports; None: it is not said."""
        if estimate is None or not estimate.found or estimate.pose_set is None:
            return None
        names = self._search.tree.model.position_names
        families = np.full((self._family_limit, len(names)), np.nan)
        found = [family.q for family in estimate.pose_set.families[: self._family_limit]]
        families[: len(found)] = found
        proved = np.array([float(estimate.proved_optimal)])
        return proved, *estimate.pose_set.position_intervals(names), families.ravel()

    def _calc_positions(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._matched(context).q)

    def _statistics(self, context: Context) -> Array:
        values, estimate = np.zeros(len(STATISTICS)), self._matched(context).estimate
        values[1:4] = np.inf
        if estimate is not None:
            search = estimate.statistics
            values[4:] = search.runs, max(search.outside_limit, default=0.0), estimate.seconds
            if estimate.found:
                values[:4] = 1.0, estimate.J, estimate.E_total, estimate.first_E_total
        return values

    def _calc_error(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._statistics(context)[2:3])

    def _calc_statistics(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._statistics(context))

    def _calc_base_pose(self, context: Context, output: AbstractValue) -> None:
        output.set_value(RigidTransform(self._matched(context).X_WB))

    def _calc_body_poses(self, context: Context, output: AbstractValue) -> None:
        plant, matched = self._search.tree.model.plant, self._matched(context)
        plant_context = plant.CreateDefaultContext()
        plant.SetPositions(plant_context, matched.q)
        # The pose in the scene's world of the frame that the plant takes for its world.
        X_WB = RigidTransform(matched.X_WB)
        poses = plant.get_body_poses_output_port().Eval(plant_context)
        output.set_value([X_WB @ pose for pose in poses])

    def _calc_estimate(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._matched(context).estimate)
