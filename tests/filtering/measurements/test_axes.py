"""Axes of segments in silhouettes, and as an observation of a pose."""

import math

import numpy as np
import pytest

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.body.tree.root import RootRotation
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import MaskError, ModelError, SettingsError, UnknownNameError
from drake_pose.filtering.axes import AxisObservation, _half_width
from drake_pose.filtering.contour import ContourObservation
from drake_pose.filtering.hand import (
    FLEXIONS,
    HAND_STATE,
    MEASURED,
    HandObservation,
    plant_positions,
)
from drake_pose.filtering.state import Belief
from drake_pose.filtering.update import make_evidence, update
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.body.models import joint, link, urdf, write

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


def mask_of(hand, camera, x):
    """What Drake's renderer shows: one label."""
    return LabelRenderer(hand, camera).mask(plant_positions(x, hand.position_names, 1000.0))


def compare(observation, y, R, x):
    """(k, 2) errors of alpha [deg] and rho [pixel], and (k,) their squared distances."""
    truth = np.concatenate([expected(x)[name] for name in observation.links])
    errors = y - truth
    errors[::2] = np.remainder(errors[::2] + np.pi, 2 * np.pi) - np.pi
    pairs = [slice(k, k + 2) for k in range(0, len(y), 2)]
    distances = [errors[k] @ np.linalg.solve(R[k, k], errors[k]) for k in pairs]
    return np.abs(errors.reshape(-1, 2)) * (180 / np.pi, 1), np.array(distances)


TRUE = [30, 20, 15, 55, 10, 8]
ROUGH = [35, 15, 20, 50, 14, 3]


def observe(hand, camera, q, rotation):
    """All segments' axes of a hand turned so, whose angles alone are free."""
    held = {
        name: value
        for name, value in zip(hand.position_names, q, strict=True)
        if name.startswith(("length", "base", "palm_width", "palm_height", "palm_thickness"))
    }
    tree = hand.pose_tree(
        root_position=(-0.12, -0.04, 0.0), root_rotation=RootRotation.fixed(rotation), held=held
    )
    return AxisObservation(ContourObservation(tree, [camera]), camera, SEGMENTS, (CENTRE, CENTRE))


@pytest.fixture(scope="module")
def observation(hand, camera):
    q = plant_positions(state(TRUE), hand.position_names, 1000.0)
    turn = math.radians(25.0)
    c, s = math.cos(turn), math.sin(turn)
    return observe(hand, camera, q, np.array([[1, 0, 0], [0, c, -s], [0, s, c]]))


def test_a_side_that_is_hidden_is_not_used_and_a_covered_segment_left_out(
    hand, camera, observation
):
    x = state(TRUE)
    mask = mask_of(hand, camera, x)
    rough = small_state(observation, hand, TRUE)
    k = observation.names.index("alpha_segment_12")
    assert np.isfinite(observation.measure(mask, rough)[0]).all()
    alpha, rho = expected(x)["segment_12"]
    v, u = np.mgrid[:SIDE, :SIDE] - CENTRE
    across = np.cos(alpha) * v - np.sin(alpha) * u - rho
    along = np.cos(alpha) * u + np.sin(alpha) * v
    start, end = HandObservation().drawing(x)[1:3] @ (np.cos(alpha), np.sin(alpha))
    beside = (along > start) & (along < end) & (np.abs(across) < 40)
    one_side, both_sides = mask | (beside & (across > 0)), mask | beside
    y, R = observation.measure(one_side, rough)
    assert y[k : k + 2] == pytest.approx([alpha, rho], abs=0.5)
    assert R[k, k] > observation.measure(mask, rough)[1][k, k]
    assert np.isnan(observation.measure(both_sides, rough)[0][k])


@pytest.mark.parametrize("rough", [TRUE, ROUGH])
def test_the_axes_are_those_of_the_hand_that_was_rendered(hand, camera, observation, rough):
    x = state(TRUE)
    beside = small_state(observation, hand, rough)
    y, R = observation.measure(mask_of(hand, camera, x), beside)
    errors, distances = compare(observation, y, R, x)
    assert np.isfinite(y).all()
    assert errors[:, 0].max() < 1.5
    assert np.median(distances) < 2.0
    assert distances.max() < 12.0


def test_a_mirrored_prediction_looks_the_same(hand, camera):
    """Seen with the plane of flexion on edge: bent towards the camera or away from it."""
    x, roll = state([10, 5, 5, 12, 4, 4], 90.0), math.radians(90.0)
    q = plant_positions(x, hand.position_names, 1000.0)
    c, s = math.cos(roll), math.sin(roll)
    rotation = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    observation = observe(hand, camera, q, rotation)
    small = observation.body.state(q)
    n = len(small)
    unsure = Belief(small, np.diag(np.full(n, 1.0)))
    found = observation.mirrors(unsure)
    assert found
    for other in found:
        (changed,) = np.flatnonzero(other != small)
        row = observation.names.index("alpha_" + observation.body.layout.names[changed].replace(
            "flexion", "segment"))  # fmt: skip
        before, after = (observation.predict(one)[0][row] for one in (small, other))
        assert math.remainder(after - before, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
        analytic = HandObservation(mirror_slope=0.35).mirrors(
            Belief(x, np.diag(np.full(len(x), 1.0)))
        )
        index = HAND_STATE.index(observation.body.layout.names[changed])
        assert any(one[index] == pytest.approx(other[changed], abs=1e-6) for one in analytic)
    assert not observation.mirrors(Belief(small, np.diag(np.full(n, 1e-6))))


def test_a_segment_oblique_to_its_joint_is_mirrored_at_the_image_plane(tmp_path, camera):
    """Turned out of the image about an axis in it, it looks as turned into it as far."""
    arm = '<visual><origin xyz="0.1 0 0"/><geometry><box size="0.2 0.02 0.02"/></geometry></visual>'
    turn = joint("turn", "revolute", "base", "arm", axis="0.6 0.8 0", origin="")
    weld = joint("weld", "fixed", "world", "base", origin="", limits=None)
    text = urdf(link("base"), link("arm", arm), weld, turn)
    tree = load_model(write(tmp_path, text), check=False).pose_tree()
    ends = {"arm": (np.zeros(3), np.array([0.2, 0.0, 0.0]))}
    observation = AxisObservation(ContourObservation(tree, [camera]), camera, ends)
    x = observation.body.state(np.array([0.2]))
    (mirrored,) = observation.mirrors(Belief(x, np.eye(len(x))))
    np.testing.assert_allclose(mirrored, -x, atol=1e-9)
    seen = [observation.predict(one)[0] for one in (x, mirrored)]
    np.testing.assert_allclose(seen[1], seen[0], atol=1e-9)


def test_a_segment_is_as_wide_as_what_lies_between_its_ends():
    shaft = np.array([[x, 0.01 * np.cos(a), 0.01 * np.sin(a)] for x in (0, 0.1) for a in range(6)])
    head = np.array([[0.13, 0.05, 0.0], [-0.02, 0.0, 0.04]])
    start, end = np.zeros(3), np.array([0.1, 0.0, 0.0])
    assert _half_width(np.vstack([shaft, head]), start, end) == pytest.approx(0.01)


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
    y, variances = observation.measure(LabelRenderer(hand, camera).mask(q), rough)
    n = len(x)
    prediction = Belief(rough, np.diag(np.full(n, 0.15**2)))
    updated = update(prediction, make_evidence(observation, y, variances), 10)
    error, before = updated.belief.mean - x, rough - x
    assert np.degrees(np.abs(error[: n // 2])).max() < 0.5 * np.degrees(np.abs(before)).max()
    assert (np.abs(error) < 3 * updated.belief.deviations())[: n // 2].all()


def test_bad_arguments_are_named(hand, camera, observation):
    body = observation.body
    with pytest.raises(MaskError, match="'top'"):
        observation.measure(np.zeros((3, 3), dtype=np.bool_), np.zeros(len(body.layout)))
    beyond = (np.array([1.0, 0.0, 0.0]), np.array([2.0, 0.0, 0.0]))
    with pytest.raises(ModelError, match="'segment_11' shows nothing"):
        AxisObservation(body, camera, {"segment_11": beyond})
    with pytest.raises(SettingsError, match="one segment or more"):
        AxisObservation(body, camera, {})
    with pytest.raises(UnknownNameError, match="thumb"):
        AxisObservation(body, camera, {"thumb": SEGMENTS["segment_11"]})
    y = np.zeros(len(observation.names))
    with pytest.raises(SettingsError, match="alpha_segment_11"):
        make_evidence(observation, y, -np.ones(len(y)))
    with pytest.raises(SettingsError, match="shape"):
        make_evidence(observation, y, np.ones(3))
