"""The person's pose the paper's way (Date et al., sections 4 and 5) as a Drake system."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import (
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from drake_pose.errors import SettingsError
from drake_pose.person.date.body_pose import estimate_pose
from drake_pose.person.date.capture import CaptureSetup
from drake_pose.person.date.faces import head_angles
from drake_pose.person.date.features import expect_features
from drake_pose.person.date.skeleton import FEATURES, LIMBS
from drake_pose.systems.date.stages import ViewPorts

Array = NDArray[np.float64]


class PaperPoseEstimator(LeafSystem):
    """Estimates the person's positions, and keeps all that one frame hands to the next.

    .. pydrake_system::

        name: PaperPoseEstimator
        input_ports: [person_view_<camera>, features, support, face_direction (optional),
          recognised_positions (optional), fresh (optional)]
        output_ports: [estimated_positions, last_features, last_support, limb_points,
          expected_features]

    Stepwise inverse kinematics of the upper body, waist and legs, and the search for elbows and
    knees. ``recognised_positions`` that are not nan overwrite all without a reset. A camera that is
    unconnected or gives None is left out. While ``fresh`` is 0 nothing is done.

    Outputs, all of them state, nan until the person is known: ``estimated_positions`` (nq) [rad or
    m]; ``last_features`` (15), where head, hands and feet were [m], and ``last_support`` (5), from
    how many 3-D points (``FeatureFinder`` needs them in the next frame); and ``limb_points`` (36),
    root, middle joint and end of left arm, right arm, left leg and right leg as found [m], nan
    where the pose was recognised: no limb was searched then; ``expected_features`` (15), where
    head, hands and feet are expected in the next frame [m], for ``FeatureFinder``, too. The time
    between two frames is ``period`` [s].

    Raises:
        SettingsError: a period that is not positive.
    """

    def __init__(self, setup: CaptureSetup, period: float) -> None:
        super().__init__()
        if not period > 0:
            raise SettingsError(f"the estimator's period must be positive, not {period}")
        self.setup = setup
        positions = len(setup.skeleton.lower)
        self._views = ViewPorts(self, list(setup.cameras.values()))
        sizes = {
            "features": 3 * len(FEATURES),
            "support": len(FEATURES),
            "face_direction": 2,
            "recognised_positions": positions,
            "fresh": 1,
        }
        self._ports = {
            name: self.DeclareVectorInputPort(name, size) for name, size in sizes.items()
        }
        unknown = {
            "estimated_positions": positions,
            "last_features": 3 * len(FEATURES),
            "last_support": len(FEATURES),
            "limb_points": 9 * len(LIMBS),
            "expected_features": 3 * len(FEATURES),
        }
        self._states = {
            name: self.DeclareDiscreteState(np.full(size, np.nan)) for name, size in unknown.items()
        }
        for name, state in self._states.items():
            self.DeclareStateOutputPort(name, state)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._estimate)

    def set_person(self, context: Context, q: Array, features: Array | None = None) -> None:
        """Say where the person is.

        Args:
            q: (nq,) positions [rad or m].
            features: (5, 3) head, hands and feet [m]; those at q where not given.

        Raises:
            SettingsError: another number of positions or features, or one that is not finite.
        """
        _require_finite(q, (len(self.setup.skeleton.lower),), "positions")
        if features is not None:
            _require_finite(features, (len(FEATURES), 3), "features")
        self._overwrite(context.get_mutable_discrete_state(), q, features)

    def _overwrite(self, state: DiscreteValues, q: Array, features: Array | None) -> None:
        places = self.setup.skeleton.features(q) if features is None else features
        limbs = np.full(9 * len(LIMBS), np.nan)
        self._write(state, q, places, np.zeros(len(FEATURES)), limbs, places)

    def _write(self, state: DiscreteValues, *values: Array) -> None:
        for index, value in zip(self._states.values(), values, strict=True):
            state.set_value(index, np.ravel(value))

    def _value(self, context: Context, name: str) -> Array | None:
        """The value of an input port; None: unconnected, or unknown (nan)."""
        port = self._ports[name]
        value = port.Eval(context) if port.HasValue(context) else None
        return value if value is not None and np.isfinite(value).all() else None

    def _estimate(self, context: Context, state: DiscreteValues) -> EventStatus:
        fresh = self._value(context, "fresh")
        if fresh is not None and not fresh[0]:
            return EventStatus.DidNothing()
        recognised = self._value(context, "recognised_positions")
        if recognised is not None:
            self._overwrite(state, recognised, None)
            return EventStatus.Succeeded()
        features = self._value(context, "features")
        last = context.get_discrete_state(self._states["estimated_positions"]).value()
        if features is None or not np.isfinite(last).all():
            return EventStatus.DidNothing()
        features = features.reshape(-1, 3)
        cameras, views = self._views.evaluate(context)
        pose = estimate_pose(
            self.setup.skeleton,
            last,
            features,
            self._head_angles(context, features[0]),
            cameras,
            [view.region for view in views],
            search=self.setup.settings.search,
            waist=self.setup.settings.waist,
        )
        support = self._ports["support"].Eval(context)
        limbs = np.array([pose.limbs[name] for name in LIMBS])
        before, support_before = (
            context.get_discrete_state(self._states[name]).value()
            for name in ("last_features", "last_support")
        )
        expected = expect_features(features, support, before.reshape(-1, 3), support_before)
        self._write(state, pose.q, features, support, limbs, expected)
        return EventStatus.Succeeded()

    def _head_angles(self, context: Context, head: Array) -> Array | None:
        """The head's angles in the world (2,) [rad] where the face is seen."""
        camera, direction = self.setup.face_camera, self._value(context, "face_direction")
        if camera is None or direction is None:
            return None
        return head_angles(direction, head, camera)


def _require_finite(values: Array, shape: tuple[int, ...], what: str) -> None:
    if np.shape(values) != shape or not np.isfinite(values).all():
        raise SettingsError(f"the person's {what} must be {shape} finite numbers, not {values}")
