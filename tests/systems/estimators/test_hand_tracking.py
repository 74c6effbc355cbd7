"""The two-finger hand tracked in diagrams: camera, matcher, axes, truncated filter."""

import math

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.geometry import StartMeshcat
from pydrake.math import RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.sensors import ImageLabel16I
from pydrake.trajectories import PiecewisePolynomial

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.body.tree.root import RootRotation
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.filtering.measurements.axes import AxisObservation
from drake_pose.filtering.measurements.contour import ContourObservation
from drake_pose.filtering.truncation.couplings import model_inequalities
from drake_pose.search.grid.beam_search import BeamSearch
from drake_pose.search.settings import BeamSearchSettings
from drake_pose.silhouette.pictures.label_images import EMPTY
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.systems.estimators.hand_tracking import (
    AxisSensor,
    add_hand_tracking,
    build_hand_tracking,
)
from drake_pose.systems.estimators.truncated_ekf import STATISTICS

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
        root_position=(-0.12, -0.04, 0.0),
        root_rotation=RootRotation.fixed(rotation),
        held=SHAPE,
    )
    return CountingSearch(BeamSearch(tree, BeamSearchSettings(interval=math.radians(10))))


def true_angles(count=FRAMES, phase=0.0):
    """(count, 8) angles inside Table 1, in the order of ANGLES [rad]."""
    t = np.arange(count)[:, None] * PERIOD
    rows = []
    for shift in (0.0, 0.6):
        swing = np.sin(2 * np.pi * 0.8 * t + phase + shift)
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


class LabelPlayer(LeafSystem):
    """Plays label images (k, H, W), one a period."""

    def __init__(self, images):
        super().__init__()
        self._images = []
        for labels in images:
            image = ImageLabel16I(labels.shape[1], labels.shape[0])
            image.mutable_data[:, :, 0] = labels
            self._images.append(image)
        self.DeclareAbstractOutputPort(
            "label_image", lambda: AbstractValue.Make(self._images[0]), self._calc
        )

    def _calc(self, context, output):
        index = min(int(context.get_time() / PERIOD + 0.5), len(self._images) - 1)
        output.set_value(self._images[index])


@pytest.fixture(scope="module")
def renderer(hand, camera):
    return LabelRenderer(hand, camera)


def play(images, search, camera):
    """The tracking diagram before recorded images, followed to their end."""
    builder = DiagramBuilder()
    player = builder.AddSystem(LabelPlayer(images))
    parts = add_hand_tracking(builder, search, camera, SEGMENTS, player.get_output_port(), PERIOD)
    return follow(builder.Build(), parts, len(images))


def follow(diagram, parts, count):
    """After each frame: positions, deviations, statistics; restart in it: each (count, size)."""
    simulator = Simulator(diagram)
    simulator.AdvanceTo((count + 0.5) * PERIOD)
    logs = (parts.positions_log, parts.deviations_log, parts.statistics_log)
    # A log samples just before the update of the same time; the restart is what that update sees.
    after = [log.FindLog(simulator.get_context()).data().T[1 : count + 1] for log in logs]
    restart = parts.restart_log.FindLog(simulator.get_context()).data()[0, :count]
    return (*after, restart)


def compare(hand, estimated, deviations, truth):
    """(count, 8) errors [deg], and which are inside 2 sigma."""
    index = [hand.position_index(name) for name in ANGLES]
    errors = (estimated - truth)[:, index]
    return np.degrees(np.abs(errors)), np.abs(errors) < 2 * deviations[:, index]


@pytest.mark.slow
def test_a_moving_hand_is_matched_once_and_tracked(hand, camera, search):
    """Plant and Drake's camera, end to end."""
    truth = positions(search, true_angles())
    breaks = PERIOD * (np.arange(FRAMES + 1) - 0.3)
    trajectory = PiecewisePolynomial.ZeroOrderHold(breaks, np.vstack([truth, truth[-1:]]).T)
    diagram, parts = build_hand_tracking(search, camera, SEGMENTS, trajectory, PERIOD)
    estimated, deviations, statistics, restart = follow(diagram, parts, FRAMES)
    assert search.count == 1
    np.testing.assert_array_equal(restart, np.arange(FRAMES) == 0)
    assert statistics[:, STATISTICS.index("lost")].max() == 0
    errors, inside = compare(hand, estimated, deviations, truth)
    assert np.sqrt(np.mean(errors**2)) < 2.0
    assert np.median(errors) < 0.6
    assert inside.mean() > 0.9
    # A deviation that is honest is not far too large, either.
    index = [hand.position_index(name) for name in ANGLES]
    assert np.degrees(np.median(deviations[:, index])) < 2.0
    rows = model_inequalities(hand).only_of(ANGLES)
    assert rows.rows
    order = [hand.position_index(name) for name in rows.columns]
    assert (estimated[:, order] @ rows.phi.T <= rows.b + 1e-6).all()
    held = [hand.position_index(name) for name in SHAPE]
    np.testing.assert_allclose(estimated[:, held], truth[:, held])
    assert np.isnan(deviations[:, held]).all()


def bent(generator):
    """(8,) a hand within Table 1, some degrees from its bounds [rad]."""
    angles, flexion = [], generator.uniform(15, 70)
    for side in (-1, 1):
        bend = generator.uniform(10, 60)
        angles += [
            side * generator.uniform(4, 15),
            flexion + generator.uniform(-10, 10),
            bend,
            bend + generator.uniform(-5, 5),
        ]
    return np.radians(angles)


@pytest.mark.slow
def test_a_loss_is_said_and_the_matcher_asked(hand, camera, renderer, search):
    """The hand is bent otherwise from one frame to the next."""
    cut, generator = 15, np.random.default_rng(0)
    before, after = bent(generator), bent(generator)
    swing = 0.4 * (true_angles() - true_angles().mean(axis=0))
    truth = positions(search, np.vstack([before + swing[:cut], after + swing[cut:]]))
    images = [renderer.label_image(q) for q in truth]
    estimated, deviations, statistics, restart = play(images, search, camera)
    lost = statistics[:, STATISTICS.index("lost")]
    assert not lost[:cut].any()
    assert lost[cut : cut + 5].any()
    assert not lost[cut + 5 :].any()
    assert search.count == 2
    first, second = np.flatnonzero(restart)
    assert first == 0
    assert cut < second < cut + 5
    errors, inside = compare(hand, estimated, deviations, truth)
    assert errors[cut].max() > 10
    # Axes beside a match some degrees off err by more than they say, for a frame or two.
    for frames in (slice(3, cut), slice(second + 3, None)):
        assert np.sqrt(np.mean(errors[frames] ** 2)) < 2.5
        assert inside[frames].mean() > 0.85


def test_meshcat_shows_both_hands(camera, search):
    meshcat = StartMeshcat()
    truth = positions(search, true_angles(1))[0]
    diagram, _ = build_hand_tracking(search, camera, SEGMENTS, truth, PERIOD, meshcat)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.5 * PERIOD)
    for name in ("true", "estimated"):
        assert meshcat.HasPath(f"/drake/visualizer/{name}/two_finger_hand/palm")


def test_bad_arguments_are_named(hand, camera, search):
    body = ContourObservation(search.tree, [camera])
    observation = AxisObservation(body, camera, SEGMENTS)
    n = len(body.layout)
    with pytest.raises(SettingsError, match="transition"):
        AxisSensor(observation, np.eye(3), search, camera)
    other = BeamSearch(hand.pose_tree(root_position=(0.0, 0.0, 0.0), held=SHAPE))
    with pytest.raises(SettingsError, match="one pose tree"):
        AxisSensor(observation, np.eye(n), other, camera)


def test_without_a_hand_there_is_nothing_to_start_from(camera, search):
    body = ContourObservation(search.tree, [camera])
    observation = AxisObservation(body, camera, SEGMENTS)
    sensor = AxisSensor(observation, np.eye(len(body.layout)), search, camera)
    context = sensor.CreateDefaultContext()
    output = sensor.GetOutputPort("matched_state")
    assert np.isnan(output.Eval(context)).all()
    image = ImageLabel16I(camera.width, camera.height)
    image.mutable_data[:] = EMPTY
    sensor.GetInputPort("label_image").FixValue(context, image)
    assert np.isnan(output.Eval(context)).all()
    assert search.count == 0
