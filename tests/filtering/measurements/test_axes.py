"""Axes of segments in label images, and as an observation of a pose."""

import math

import numpy as np
import pytest

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.body.tree.root import RootRotation
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import MaskError, SettingsError, UnknownNameError
from drake_pose.filtering.hand import (
    FLEXIONS,
    HAND_STATE,
    MEASURED,
    HandObservation,
    plant_positions,
)
from drake_pose.filtering.kalman.update import make_evidence, update
from drake_pose.filtering.measurements.axes import (
    Axis,
    AxisObservation,
    _independent,
)
from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.state import Belief
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

SIDE = 400
CENTRE = 199.5
LENGTHS = {"1": 0.062, "2": 0.04, "3": 0.036}
SEGMENTS = {
    f"segment_{i}{j}": (np.zeros(3), np.array([LENGTHS[j], 0.0, 0.0])) for i in "12" for j in "123"
}


@pytest.fixture(scope="module")
def hand():
    return load_model(bundled_model("two_finger_hand"), check=False)


@pytest.fixture(scope="module")
def camera():
    X_WC = np.eye(4)
    X_WC[2, 3] = -1.0
    return ParallelCamera("top", SIDE, SIDE, 1000.0, CENTRE, CENTRE, X_WC)


def state(flexions_deg, roll_deg=25.0):
    """A hand whose fingers bend mostly in the image's plane; lengths as they are drawn."""
    x = np.zeros(len(HAND_STATE))
    x[:2] = (-120.0, -40.0)
    half = math.radians(roll_deg) / 2
    x[2:6] = (math.cos(half), math.sin(half), 0.0, 0.0)
    x[6:8] = np.radians([-12.0, 12.0])
    x[HAND_STATE.indices(FLEXIONS)] = np.radians(flexions_deg)
    x[28:34] = [LENGTHS[j] for _ in "12" for j in "123"]
    x[34:] = (0.07, 0.08, 0.02)
    return x


def expected(x):
    """alpha and rho of each segment, from the analytic hand."""
    h, _ = HandObservation().predict(x)
    return {
        name: np.array([h[MEASURED.index(f"{kind}_{name[-2:]}")] for kind in ("alpha", "rho")])
        for name in SEGMENTS
    }


def compare(axes, x):
    """(k, 2) errors of alpha [deg] and rho [pixel], and (k,) their squared distances."""
    truth = expected(x)
    errors, distances = [], []
    for name, axis in axes.items():
        error = np.array([axis.alpha, axis.rho]) - truth[name]
        error[0] = math.remainder(error[0], 2 * math.pi)
        distances.append(error @ np.linalg.solve(axis.covariance, error))
        errors.append([math.degrees(error[0]), error[1]])
    return np.abs(np.array(errors)), np.array(distances)


TRUE = [30, 20, 15, 55, 10, 8]
ROUGH = [35, 15, 20, 50, 14, 3]


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


def test_what_is_occluded_is_left_out(hand, camera, observation):
    x = state(TRUE)
    q = plant_positions(x, hand.position_names, 1000.0)
    labels = LabelRenderer(hand, camera).segments(q)
    link = hand.link_index("segment_12")
    v, u = np.nonzero(labels == link)
    assert "segment_12" in observation.measure_labels(labels, q)
    covered = labels.copy()
    covered[v[u > np.median(u)], u[u > np.median(u)]] = -1
    assert "segment_12" not in observation.measure_labels(covered, q)
    covered[labels == link] = -1
    assert "segment_12" not in observation.measure_labels(covered, q)


def test_at_the_rough_pose_the_axis_is_that_of_the_model(hand, camera, observation):
    x = state(TRUE)
    q = plant_positions(x, hand.position_names, 1000.0)
    errors, distances = compare(
        observation.measure_labels(LabelRenderer(hand, camera).segments(q), q), x
    )
    assert errors.max() < 1e-6
    assert distances.max() < 1e-6


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
    updated = update(prediction, make_evidence(observation, y, variances), 10)
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


def test_bad_arguments_are_named(hand, camera, observation):
    q = hand.default_positions
    with pytest.raises(MaskError, match="'top'"):
        observation.measure_labels(np.zeros((3, 3), dtype=np.int16), q)
    body = observation.body
    with pytest.raises(SettingsError, match="one segment or more"):
        AxisObservation(body, camera, {})
    with pytest.raises(UnknownNameError, match="thumb"):
        AxisObservation(body, camera, {"thumb": SEGMENTS["segment_11"]})
    y = np.zeros(len(observation.names))
    with pytest.raises(SettingsError, match="alpha_segment_11"):
        make_evidence(observation, y, -np.ones(len(y)))
    with pytest.raises(SettingsError, match="shape"):
        make_evidence(observation, y, np.ones(3))
