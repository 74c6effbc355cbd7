import math

import numpy as np
import pytest

from drake_pose.body.tree.root import RootRotation
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.filtering.hand.observation import (
    HAND_STATE,
    MEASURED,
    HandObservation,
    plant_positions,
)
from drake_pose.filtering.kalman.update import update, with_variances
from drake_pose.filtering.measurements.axes import Axis, AxisObservation, _independent
from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.state import Belief
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.filtering.measurements.test_segment_axes import (
    CENTRE,
    ROUGH,
    SEGMENTS,
    TRUE,
    camera,
    expected,
    hand,
    state,
)

__all__ = ["camera", "hand"]


@pytest.fixture(scope="module")
def observation(hand, camera):
    x = state(TRUE)
    q = plant_positions(x, hand.position_names, 1000.0)
    turn = math.radians(25.0)
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    held = {
        name: value
        for name, value in zip(hand.position_names, q, strict=True)
        if name.startswith(("length", "base", "palm_width", "palm_height", "palm_thickness"))
    }
    tree = hand.pose_tree(
        root_position=(-0.12, -0.04, 0.0), root_rotation=RootRotation.fixed(rotation), held=held
    )
    body = ContourObservation(tree, [camera])
    return AxisObservation(body, camera, SEGMENTS, (CENTRE, CENTRE))


def small_state(observation, hand, flexions):
    """The observation's own state of the hand."""
    q = plant_positions(state(flexions), hand.position_names, 1000.0)
    return observation.body.state(q)


def test_axes_and_slopes_are_those_of_the_analytic_hand(observation, hand):
    x, whole = small_state(observation, hand, TRUE), state(TRUE)
    h, H = observation.predict(x)
    wanted = np.concatenate([expected(whole)[name] for name in observation.links])
    np.testing.assert_allclose(h, wanted, atol=1e-9)
    rows = [MEASURED.index(name.replace("segment_", "")) for name in observation.names]
    _, analytic = HandObservation().predict(whole)
    layout = observation.body.layout
    columns = HAND_STATE.indices(layout.moving)
    np.testing.assert_allclose(
        H[:, layout.indices(layout.moving)], analytic[np.ix_(rows, columns)], rtol=1e-5, atol=1e-5
    )
    assert not H[:, len(layout.moving) :].any()


def test_one_picture_corrects_a_rough_pose(observation, hand, camera):
    x, rough = (small_state(observation, hand, f) for f in (TRUE, ROUGH))
    q = observation.body.positions(x)[0]
    y, variances = observation.measure(LabelRenderer(hand, camera).segments(q), rough)
    assert np.isfinite(y).all()
    n = len(x)
    prediction = Belief(rough, np.diag(np.full(n, 0.15**2)))
    updated = update(prediction, y, with_variances(observation, y, variances), 10)
    error, before = updated.belief.mean - x, rough - x
    assert np.degrees(np.abs(error[: n // 2])).max() < 0.5 * np.degrees(np.abs(before)).max()
    assert (np.abs(error) < 3 * updated.belief.deviations())[: n // 2].all()


def test_independent_errors_cover_the_joint_one():
    generator = np.random.default_rng(0)
    for _ in range(20):
        a, b = generator.uniform(0.1, 2.0, 2)
        reach = generator.normal(scale=30.0)
        covariance = np.array([[a, reach * a], [reach * a, b + reach**2 * a]])
        bound = np.diag(_independent(Axis(0.0, 0.0, covariance, 1.0)))
        assert np.linalg.eigvalsh(bound - covariance).min() > -1e-9
        assert bound[1, 1] <= b + 2 * reach**2 * a + 1e-9


def test_bad_arguments_are_named(observation, camera):
    body = observation.body
    with pytest.raises(SettingsError, match="one segment or more"):
        AxisObservation(body, camera, {})
    with pytest.raises(UnknownNameError, match="thumb"):
        AxisObservation(body, camera, {"thumb": SEGMENTS["segment_11"]})
    y = np.zeros(len(observation.names))
    with pytest.raises(SettingsError, match="alpha_segment_11"):
        with_variances(observation, y, -np.ones(len(y)))
    with pytest.raises(SettingsError, match="shape"):
        with_variances(observation, y, np.ones(3))
