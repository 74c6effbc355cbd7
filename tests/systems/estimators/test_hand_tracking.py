"""The two-finger hand tracked in diagrams: camera, matcher, axes, truncated filter."""

import math

import numpy as np
import pytest
from pydrake.geometry import StartMeshcat
from pydrake.math import RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.sensors import ImageLabel16I
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.body.tree.root import RootRotation
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.filtering.axes import AxisObservation
from drake_pose.filtering.contour import ContourObservation
from drake_pose.filtering.contour_tracker import TrackingSettings
from drake_pose.filtering.couplings import model_inequalities
from drake_pose.filtering.hand_silhouette import HandSilhouette
from drake_pose.filtering.state import Belief
from drake_pose.papers.shimada import experiment_filter
from drake_pose.papers.shimada_motion import true_states
from drake_pose.search.estimates import PoseEstimate
from drake_pose.search.grid.beam_search import BeamSearch
from drake_pose.search.settings import BeamSearchSettings
from drake_pose.silhouette.pictures.label_images import EMPTY, mask_to_label_image
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.systems.estimators.hand_tracking import AxisSensor, HandSensor, build_hand_tracking
from drake_pose.systems.estimators.truncated_ekf import STATISTICS
from drake_pose.systems.ports import evaluate
from tests.filtering.tracking.test_match_and_track import CountingSearch
from tests.systems.bench import Bench

PERIOD = 1 / 30
FRAMES = 40
LENGTHS = {"1": 0.062, "2": 0.04, "3": 0.036}
SEGMENTS = {
    f"segment_{i}{j}": (np.zeros(3), np.array([LENGTHS[j], 0.0, 0.0])) for i in "12" for j in "123"
}
SHAPE = {"palm_width": 0.07, "palm_height": 0.08, "palm_thickness": 0.02}
SHAPE |= {f"base_height_{i}": 0.08 for i in "12"} | {f"base_side_{i}": 0.0175 for i in "12"}
SHAPE |= {f"length_{i}{j}": LENGTHS[j] for i in "12" for j in "123"}
ANGLES = tuple(name for i in "12" for name in (f"spread_{i}", *(f"flexion_{i}{j}" for j in "123")))


class KnownPose:
    """A search that answers with these positions, or with nothing, and counts how often."""

    def __init__(self, tree, q=None):
        self.tree, self.q, self.count = tree, q, 0

    def match(self, views, root_position=None):
        self.count += 1
        if self.q is None:
            return PoseEstimate.nothing(self.tree, stopped_by="end")
        values = self.tree.values_from_positions(self.q, np.eye(4))
        return PoseEstimate.of_values(self.tree, values, 0.0, 1.0, stopped_by="end")


@pytest.fixture(scope="module")
def hand():
    return load_model(bundled_model("two_finger_hand"), check=False)


@pytest.fixture(scope="module")
def camera():
    X_WC = np.eye(4)
    X_WC[2, 3] = -1.0
    return ParallelCamera("top", 320, 240, 800.0, 159.5, 119.5, X_WC)


@pytest.fixture(scope="module")
def tree(hand):
    rotation = RotationMatrix.MakeXRotation(math.radians(30)).matrix()
    return hand.pose_tree(
        root_position=(-0.12, -0.04, 0.0), root_rotation=RootRotation.fixed(rotation), held=SHAPE
    )


@pytest.fixture(scope="module")
def observation(tree, camera):
    return AxisObservation(ContourObservation(tree, [camera]), camera, SEGMENTS)


def true_angles(count=FRAMES):
    """(count, 8) angles inside Table 1, in the order of ANGLES [rad]."""
    t = np.arange(count)[:, None] * PERIOD
    rows = []
    for shift in (0.0, 0.6):
        swing = np.sin(2 * np.pi * 0.8 * t + shift)
        side = -1 if shift == 0.0 else 1
        rows += [side * (10 + 3 * swing), 35 + 15 * swing, 30 + 12 * swing, 28 + 12 * swing]
    return np.radians(np.hstack(rows))


def positions(tree, angles):
    """(count, nq) the plant's positions."""
    model = tree.model
    q, _ = tree.positions_from(tree.default_values())
    found = np.tile(q, (len(angles), 1))
    found[:, [model.position_index(name) for name in ANGLES]] = angles
    for name, value in SHAPE.items():
        found[:, model.position_index(name)] = value
    return found


@pytest.mark.slow
def test_a_moving_hand_is_matched_once_and_again_after_a_loss(hand, camera, tree):
    """Plant and Drake's camera, end to end; the hand is bent otherwise after some frames."""
    cut, angles = 30, true_angles()
    angles[cut:] = angles[:10] + np.radians([-4, 25, 20, 20, 4, 25, 20, 20])
    truth = positions(tree, angles)
    search = CountingSearch(BeamSearch(tree, BeamSearchSettings(interval=math.radians(10))))
    breaks = PERIOD * (np.arange(FRAMES + 1) - 0.3)
    trajectory = PiecewisePolynomial.ZeroOrderHold(breaks, np.vstack([truth, truth[-1:]]).T)
    diagram, parts = build_hand_tracking(search, camera, SEGMENTS, trajectory, PERIOD)
    simulator = Simulator(diagram)
    simulator.AdvanceTo((FRAMES + 0.5) * PERIOD)
    logs = (parts.positions_log, parts.deviations_log, parts.statistics_log)
    # A log samples just before the update of the same time; the restart is what that update sees.
    estimated, deviations, statistics = (
        log.FindLog(simulator.get_context()).data().T[1 : FRAMES + 1] for log in logs
    )
    restart = parts.restart_log.FindLog(simulator.get_context()).data()[0, :FRAMES]
    assert search.calls == 2
    first, second = np.flatnonzero(restart)
    assert first == 0
    assert cut <= second < cut + 5
    lost = statistics[:, STATISTICS.index("lost")]
    assert not lost[:cut].any()
    assert not lost[cut + 5 :].any()
    index = [hand.position_index(name) for name in ANGLES]
    errors = np.abs(estimated - truth)[:, index]
    # Axes beside a match some degrees off err by more than they say, for a frame or two.
    for frames in (slice(0, cut), slice(second + 3, None)):
        assert np.sqrt(np.mean(np.degrees(errors[frames]) ** 2)) < 2.5
        assert (errors[frames] < 2 * deviations[frames][:, index]).mean() > 0.85
    assert np.median(np.degrees(errors[:cut])) < 0.6
    # A deviation that is honest is not far too large, either.
    assert np.degrees(np.median(deviations[:, index])) < 2.0
    rows = model_inequalities(hand).only_of(ANGLES)
    assert rows.rows
    order = [hand.position_index(name) for name in rows.columns]
    assert (estimated[:, order] @ rows.phi.T <= rows.b + 1e-6).all()
    held = [hand.position_index(name) for name in SHAPE]
    np.testing.assert_allclose(estimated[:, held], truth[:, held])
    assert np.isnan(deviations[:, held]).all()


def test_meshcat_shows_both_hands(camera, tree):
    meshcat = StartMeshcat()
    truth = positions(tree, true_angles(1))[0]
    search = KnownPose(tree, truth)
    diagram, parts = build_hand_tracking(search, camera, SEGMENTS, truth, PERIOD, meshcat)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.5 * PERIOD)
    for name in ("true", "estimated"):
        assert meshcat.HasPath(f"/drake/visualizer/{name}/two_finger_hand/palm")
    found = evaluate(parts.sensor.GetOutputPort("estimated_positions"), simulator.get_context())
    np.testing.assert_allclose(found, truth, atol=math.radians(2.0))
    assert search.count == 1


def test_noise_grows_with_the_time_and_the_acceleration_that_a_step_has(camera, tree):
    """An angle changes by half the acceleration times the time squared."""
    noise = []
    for period, acceleration in ((PERIOD, 30.0), (2 * PERIOD, 30.0), (PERIOD, 60.0)):
        settings = TrackingSettings(angle_acceleration=acceleration)
        q = tree.model.default_positions
        made = (KnownPose(tree), camera, SEGMENTS, q, period, None, settings)
        belief_filter = build_hand_tracking(*made)[1].ekf.filter
        n = len(belief_filter.layout)
        noise.append(belief_filter.predicted(Belief(np.zeros(n), np.zeros((n, n)))).covariance)
    np.testing.assert_allclose(noise[1:], [2**4 * noise[0], 2**2 * noise[0]])
    turns = np.sqrt(np.diag(noise[0])[: len(ANGLES)])
    np.testing.assert_allclose(turns, 0.5 * 30.0 * PERIOD**2)


def test_the_axis_sensor_asks_the_search_where_its_filter_is_off(camera, tree, observation):
    """At first, when lost, and where a third of the silhouette is not as predicted."""
    truth, near, far = positions(tree, true_angles(1) + np.radians([[0.0], [2.0], [4.0]]))
    body, renderer = observation.body, LabelRenderer(tree.model, camera)
    mask = renderer.mask(truth)
    shares = [np.count_nonzero(mask ^ renderer.mask(q)) / mask.sum() for q in (near, far)]
    assert 0.2 < shares[0] < 0.28
    assert shares[1] > 0.32
    x_near, x_far = (body.state(q) for q in (near, far))
    identity, image = np.eye(len(body.layout)), mask_to_label_image(mask)
    covariance = np.diag(np.arange(1.0, len(identity) + 1.0))
    for step, lost, x, answer, asked in (
        (5.0, 0.0, x_near, truth, False),
        (0.0, 0.0, x_near, truth, True),
        (5.0, 1.0, x_near, truth, True),
        (5.0, 0.0, x_far, truth, True),
        (5.0, 0.0, x_far, None, True),
    ):
        search = KnownPose(tree, answer)
        sensor = Bench(AxisSensor(observation, identity, search, camera))
        sensor.give(estimated_state=x, covariance=covariance.ravel())
        sensor.give(statistics=[step, 1.0, 0.0, 0.0, lost], label_image=image)
        assert (sensor["restart"] == [1.0]) == asked == (search.count == 1)
        beside = body.state(truth) if asked and answer is not None else x
        y, noise = observation.measure(mask, beside)
        np.testing.assert_array_equal(sensor["measurement"], y)
        np.testing.assert_array_equal(sensor["measurement_covariance"], noise.ravel())
        np.testing.assert_array_equal(sensor["estimated_positions"], body.positions(x)[0])
        deviations = sensor["position_deviations"]
        known = [tree.model.position_index(name) for name in body.layout.moving]
        np.testing.assert_allclose(deviations[known] ** 2, np.diag(covariance)[: len(known)])
        assert np.isnan(np.delete(deviations, known)).all()


def test_bad_arguments_are_named(hand, camera, tree, observation):
    with pytest.raises(SettingsError, match="transition"):
        AxisSensor(observation, np.eye(3), KnownPose(tree), camera)
    other = KnownPose(hand.pose_tree(root_position=(0.0, 0.0, 0.0), held=SHAPE))
    with pytest.raises(SettingsError, match="one pose tree"):
        AxisSensor(observation, np.eye(len(observation.body.layout)), other, camera)


def test_without_a_hand_there_is_nothing_to_start_from(camera, tree, observation):
    n, search = len(observation.body.layout), KnownPose(tree)
    sensor = Bench(AxisSensor(observation, np.eye(n), search, camera))
    image = ImageLabel16I(camera.width, camera.height)
    image.mutable_data[:] = EMPTY
    for given in ({}, {"label_image": image}):
        sensor.give(**given)
        for name, size in (
            ("matched_state", n),
            ("measurement", 12),
            ("measurement_covariance", 144),
        ):
            np.testing.assert_array_equal(sensor[name], np.full(size, np.nan))
        assert sensor["restart"] == [0.0]
    assert search.count == 0


def test_the_hand_sensor_measures_the_silhouette_beside_the_prediction():
    belief_filter = experiment_filter()[0]
    truth = true_states(35.0, np.zeros(6))[24]
    silhouette = HandSilhouette(belief_filter, 480, 400, (239.5, 199.5))
    belief = Belief(truth, np.diag(np.full(len(truth), 1e-8)))
    sensor = Bench(HandSensor(silhouette))
    state = {"estimated_state": belief.mean, "covariance": belief.covariance.ravel()}
    for step, image in ((0.0, None), (3.0, silhouette.draw(truth) > 0)):
        sensor.give(statistics=[step, 1.0, 0.0, 0.0, 0.0], **state)
        if image is None:
            assert np.isnan(sensor["measurement"]).all()
            assert sensor["difference"] == 1.0
            continue
        sensor.give(label_image=mask_to_label_image(image))
        found = silhouette.measure(image, belief_filter.predicted(belief))
        np.testing.assert_array_equal(sensor["measurement"], found.y)
        np.testing.assert_array_equal(sensor["measurement_covariance"], found.covariance.ravel())
        np.testing.assert_array_equal(sensor["rough_state"], found.rough)
        assert np.count_nonzero(np.isfinite(found.y)) > 15
