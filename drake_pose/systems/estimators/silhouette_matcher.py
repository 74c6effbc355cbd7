"""The matcher as a Drake system: label images in, estimated positions out."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context
from pydrake.systems.sensors import ImageLabel16I

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.search.estimates import PoseEstimate, View
from drake_pose.search.scoring import PoseSearch
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.systems.bodies.posed_geometry import body_poses
from drake_pose.systems.ports import BeliefSystem, SharedValue, require_different, require_period

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


class SilhouetteMatcher(BeliefSystem[Matched]):
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
        require_different(cameras, 1, "a matcher needs one or more cameras of different names")
        require_period("matcher", period)
        if family_limit < 1:
            raise SettingsError(f"the family limit must be 1 or more, not {family_limit}")
        self._search, self._cameras, self._family_limit = search, tuple(cameras), family_limit
        self._labels = None if labels is None else frozenset(labels)
        known = {camera.name: camera for camera in cameras}
        self._images = self.add_camera_inputs(
            {one.name: camera_port("label_image", one, cameras) for one in cameras},
            lambda name: ImageLabel16I(known[name].width, known[name].height),
        )
        self.add_input("root_position", 3)
        q = search.tree.model.default_positions
        self.keep_belief(Matched(q, np.eye(4), None, self._first_memory()), period, offset)
        self._declare_outputs(search.tree.model.plant)

    def _declare_outputs(self, plant: MultibodyPlant) -> None:
        nq = plant.num_positions()
        self.show("estimated_positions", nq, lambda known: known.q)
        self.show("error", 1, lambda known: _statistics(known.estimate)[2:3])
        self.show("statistics", len(STATISTICS), lambda known: _statistics(known.estimate))
        self.show("base_pose", RigidTransform(), lambda known: RigidTransform(known.X_WB))
        self.show(
            "body_poses", [RigidTransform()], lambda known: body_poses(plant, known.q, known.X_WB)
        )
        self.show("pose_estimate", None, lambda known: known.estimate)
        sizes = {"proved_optimal": 1, "determined": nq, "lower": nq, "upper": nq}
        for name, size in (sizes | {"family_positions": self._family_limit * nq}).items():

            def worth(known: Matched, name: str = name, size: int = size) -> Array:
                return self._worth(known.estimate).get(name, np.full(size, np.nan))

            self.show(name, size, worth)

    def next_belief(self, context: Context, last: Matched) -> Matched:
        """The match of what the cameras see now."""
        images = self._images(context)
        masks = {name: label_image_to_mask(image, self._labels) for name, image in images.items()}
        views = [
            View(camera, masks[camera.name])
            for camera in self._cameras
            if camera.name in masks and masks[camera.name].any()
        ]
        estimate, memory = self._find(context, last.memory, views)
        if estimate is None or not estimate.found:
            return Matched(last.q, last.X_WB, estimate, memory)
        return Matched(estimate.q, estimate.X_WB, estimate, memory)

    def _first_memory(self) -> Any:
        """What the first update gets as its memory."""
        return None

    def _find(
        self, context: Context, memory: Any, views: Sequence[View]
    ) -> tuple[PoseEstimate | None, Any]:
        """The pose that the views show, if any, and what the next update gets as its memory."""
        if not views:
            return None, memory
        return self._search.match(views, self.given(context, "root_position")), memory

    def _worth(self, estimate: PoseEstimate | None) -> dict[str, Array]:
        """What an answer is worth, by port; nothing where it is not said."""
        if estimate is None or not estimate.found or estimate.pose_set is None:
            return {}
        names = self._search.tree.model.position_names
        families = np.full((self._family_limit, len(names)), np.nan)
        found = [family.q for family in estimate.pose_set.families[: self._family_limit]]
        families[: len(found)] = found
        determined, lower, upper = estimate.pose_set.position_intervals(names)
        return {
            "proved_optimal": np.array([float(estimate.proved_optimal)]),
            "determined": determined,
            "lower": lower,
            "upper": upper,
            "family_positions": families.ravel(),
        }


def _statistics(estimate: PoseEstimate | None) -> Array:
    """An update's STATISTICS."""
    values = np.zeros(len(STATISTICS))
    values[1:4] = np.inf
    if estimate is not None:
        search = estimate.statistics
        values[4:] = search.runs, max(search.outside_limit, default=0.0), estimate.seconds
        if estimate.found:
            values[:4] = 1.0, estimate.J, estimate.E_total, estimate.first_E_total
    return values
