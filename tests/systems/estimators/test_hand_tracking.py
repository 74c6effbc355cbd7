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
from drake_pose.filtering.measurements.axes import AxisObservation
from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.measurements.hand_silhouette import HandSilhouette
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncation.couplings import model_inequalities
from drake_pose.papers.shimada import experiment_filter
from drake_pose.papers.shimada_motion import true_states
from drake_pose.search.grid.beam_search import BeamSearch
from drake_pose.search.settings import BeamSearchSettings
from drake_pose.silhouette.pictures.label_images import EMPTY, mask_to_label_image
from drake_pose.systems.estimators.hand_tracking import AxisSensor, HandSensor, build_hand_tracking
from drake_pose.systems.estimators.truncated_ekf import STATISTICS
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


class CountingSearch:
    """A search that counts how often it is asked."""

    def __init__(self, search):
        self.search, self.tree, self.count = search, search.tree, 0

    def match(self, views, root_position=None):
        self.count += 1
        return self.search.match(views, root_position)


@pytest.fixture(scope="module")
def hand():
    return load_model(bundled_model("two_finger_hand"), check=False)


@pytest.fixture(scope="module")
def camera():
    X_WC = np.eye(4)
    X_WC[2, 3] = -1.0
    return ParallelCamera("top", 320, 240, 800.0, 159.5, 119.5, X_WC)


@pytest.fixture
def search(hand):
    rotation = RotationMatrix.MakeXRotation(math.radians(30)).matrix()
    tree = hand.pose_tree(
        root_position=(-0.12, -0.04, 0.0), root_rotation=RootRotation.fixed(rotation), held=SHAPE
    )
    return CountingSearch(BeamSearch(tree, BeamSearchSettings(interval=math.radians(10))))


def true_angles(count=FRAMES):
    """(count, 8) angles inside Table 1, in the order of ANGLES [rad]."""
    t = np.arange(count)[:, None] * PERIOD
    rows = []
    for shift in (0.0, 0.6):
        swing = np.sin(2 * np.pi * 0.8 * t + shift)
        side = -1 if shift == 0.0 else 1
        rows += [side * (10 + 3 * swing), 35 + 15 * swing, 30 + 12 * swing, 28 + 12 * swing]
    return np.radians(np.hstack(rows))


def positions(search, angles):
    """(count, nq) the plant's positions."""
    tree = search.tree
    model = tree.model
    q, _ = tree.positions_from(tree.default_values())
    found = np.tile(q, (len(angles), 1))
    found[:, [model.position_index(name) for name in ANGLES]] = angles
    for name, value in SHAPE.items():
        found[:, model.position_index(name)] = value
    return found


@pytest.mark.slow
def test_a_moving_hand_is_matched_once_and_again_after_a_loss(hand, camera, search):
    """Plant and Drake's camera, end to end; the hand is bent otherwise after some frames."""
    cut, angles = 30, true_angles()
    angles[cut:] = angles[:10] + np.radians([-4, 25, 20, 20, 4, 25, 20, 20])
    truth = positions(search, angles)
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
    assert search.count == 2
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


def test_meshcat_shows_both_hands(camera, search):
    meshcat = StartMeshcat()
    truth = positions(search, true_angles(1))[0]
    diagram, _ = build_hand_tracking(search, camera, SEGMENTS, truth, PERIOD, meshcat)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.5 * PERIOD)
    for name in ("true", "estimated"):
        assert meshcat.HasPath(f"/drake/visualizer/{name}/two_finger_hand/palm")


def test_bad_arguments_are_named(hand, camera, search):
    observation = AxisObservation(ContourObservation(search.tree, [camera]), camera, SEGMENTS)
    with pytest.raises(SettingsError, match="transition"):
        AxisSensor(observation, np.eye(3), search, camera)
    other = BeamSearch(hand.pose_tree(root_position=(0.0, 0.0, 0.0), held=SHAPE))
    with pytest.raises(SettingsError, match="one pose tree"):
        AxisSensor(observation, np.eye(len(observation.body.layout)), other, camera)


def test_without_a_hand_there_is_nothing_to_start_from(camera, search):
    body = ContourObservation(search.tree, [camera])
    observation = AxisObservation(body, camera, SEGMENTS)
    sensor = Bench(AxisSensor(observation, np.eye(len(body.layout)), search, camera))
    assert np.isnan(sensor["matched_state"]).all()
    image = ImageLabel16I(camera.width, camera.height)
    image.mutable_data[:] = EMPTY
    assert np.isnan(sensor.give(label_image=image)["matched_state"]).all()
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
        np.testing.assert_array_equal(sensor["rough_state"], found.rough)
        assert np.count_nonzero(np.isfinite(found.y)) > 15
