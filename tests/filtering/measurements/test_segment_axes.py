import math

import numpy as np
import pytest

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import MaskError, SettingsError, UnknownNameError
from drake_pose.filtering.hand.observation import (
    FLEXIONS,
    HAND_STATE,
    MEASURED,
    HandObservation,
    plant_positions,
)
from drake_pose.filtering.measurements.axes import AxisObserver, AxisSettings
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


@pytest.fixture(scope="module")
def observer(hand, camera):
    return AxisObserver(hand, camera, SEGMENTS, (CENTRE, CENTRE))


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


def test_axes_from_a_rendered_label_image(hand, camera, observer):
    x, rough = state(TRUE), state(ROUGH)
    q, q_rough = (plant_positions(s, hand.position_names, 1000.0) for s in (x, rough))
    labels = LabelRenderer(hand, camera).segments(q)
    axes = observer.measure_labels(labels, q_rough)
    assert set(axes) == set(SEGMENTS)
    errors, distances = compare(axes, x)
    assert errors.max() < 1.0
    # Chi-squared with two degrees of freedom.
    assert distances.mean() < 3.0
    before, _ = compare(axes, rough)
    assert before.max(axis=0).min() > 4.0
    assert all(0.7 < axis.share < 1.4 for axis in axes.values())


def test_what_is_occluded_is_left_out(hand, camera, observer):
    x = state(TRUE)
    q = plant_positions(x, hand.position_names, 1000.0)
    labels = LabelRenderer(hand, camera).segments(q)
    link = hand.link_index("segment_12")
    v, u = np.nonzero(labels == link)
    assert "segment_12" in observer.measure_labels(labels, q)
    covered = labels.copy()
    covered[v[u > np.median(u)], u[u > np.median(u)]] = -1
    assert "segment_12" not in observer.measure_labels(covered, q)
    covered[labels == link] = -1
    assert "segment_12" not in observer.measure_labels(covered, q)


def test_at_the_rough_pose_the_axis_is_that_of_the_model(hand, camera, observer):
    x = state(TRUE)
    q = plant_positions(x, hand.position_names, 1000.0)
    errors, distances = compare(
        observer.measure_labels(LabelRenderer(hand, camera).segments(q), q), x
    )
    assert errors.max() < 1e-6
    assert distances.max() < 1e-6


def test_bad_arguments_are_named(hand, camera, observer):
    q = hand.default_positions
    with pytest.raises(MaskError, match="'top'"):
        observer.measure_labels(np.zeros((3, 3), dtype=np.int16), q)
    with pytest.raises(SettingsError, match="correlation"):
        AxisSettings(correlation=0.0)
    with pytest.raises(UnknownNameError, match="thumb"):
        AxisObserver(hand, camera, {"thumb": SEGMENTS["segment_11"]})
