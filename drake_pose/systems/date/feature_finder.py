"""The places of head, hands and feet from all cameras' skin (Date et al., 3.1.2)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_pose.camera.models import Camera
from drake_pose.person.date.features import FeatureSettings, find_features
from drake_pose.person.date.skeleton import FEATURES
from drake_pose.systems.date.view_ports import ViewPorts


class FeatureFinder(LeafSystem):
    """Finds head, hands and feet in space where the rays of skin-coloured blobs meet.

    .. pydrake_system::

        name: FeatureFinder
        input_ports:
        - person_view_<camera>
        - last_features
        - expected_features (optional)
        output_ports:
        - found
        - features
        - support

    The first part of the paper's 3-D module. A camera that is unconnected or gives None is left
    out. ``last_features`` (15) are the last frame's: head, left hand, right hand, left foot, right
    foot [m]; while they are nan nothing is found. ``expected_features`` (15) are where they are
    expected in this frame [m]; the last frame's places where unconnected. Outputs: ``features``
    (15), the last frame's where nothing was measured [m]; ``support`` (5), from how many 3-D points
    each was taken, 0: not measured; and both with all 3-D points as ``found``, a
    ``person.date.features.Features`` or None.

    Args:
        cameras: the cameras on the circle, in the order of the input ports.
        settings: how features are found.

    Raises:
        SettingsError: fewer than two cameras, or two of one name.
    """

    def __init__(self, cameras: Sequence[Camera], settings: FeatureSettings | None = None) -> None:
        super().__init__()
        self._settings = settings or FeatureSettings()
        self._views = ViewPorts(self, cameras)
        self._last = self.DeclareVectorInputPort("last_features", 3 * len(FEATURES))
        self._expected = self.DeclareVectorInputPort("expected_features", 3 * len(FEATURES))
        tickets = {*self._views.tickets, self._last.ticket(), self._expected.ticket()}
        self._found = self.DeclareAbstractOutputPort(
            "found", lambda: AbstractValue.Make(None), self._find, tickets
        )
        self.DeclareVectorOutputPort("features", 3 * len(FEATURES), self._calc_features, tickets)
        self.DeclareVectorOutputPort("support", len(FEATURES), self._calc_support, tickets)

    def _find(self, context: Context, output: AbstractValue) -> None:
        last = self._last.Eval(context).reshape(-1, 3)
        if not np.isfinite(last).all():
            output.set_value(None)
            return
        cameras, views = self._views.evaluate(context)
        centroids = [view.blobs.centroids for view in views]
        regions = [view.region for view in views]
        is_given = self._expected.HasValue(context)
        expected = self._expected.Eval(context).reshape(-1, 3) if is_given else None
        output.set_value(find_features(cameras, centroids, regions, last, self._settings, expected))

    def _calc_features(self, context: Context, output: BasicVector) -> None:
        found = self._found.Eval(context)
        places = np.full(output.size(), np.nan) if found is None else found.places.ravel()
        output.SetFromVector(places)

    def _calc_support(self, context: Context, output: BasicVector) -> None:
        found = self._found.Eval(context)
        output.SetFromVector(np.zeros(output.size()) if found is None else found.support)
