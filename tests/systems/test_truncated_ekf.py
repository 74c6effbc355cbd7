"""The filter as a system, compared with the filter, and a plant's motion with its integral."""

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia, UnitInertia
from scipy.integrate import solve_ivp

from drake_pose.errors import SettingsError
from drake_pose.filtering.hand import HAND_STATE
from drake_pose.filtering.hand_silhouette import HandSilhouette
from drake_pose.filtering.inequalities import from_bounds
from drake_pose.filtering.motion import constant_velocity
from drake_pose.filtering.state import Belief, StateLayout
from drake_pose.filtering.truncated_filter import FilterSettings, TruncatedFilter
from drake_pose.filtering.update import FunctionObservation
from drake_pose.papers.shimada import experiment_filter
from drake_pose.papers.shimada_sequences import make_sequence, true_states
from drake_pose.silhouette.pictures.label_renderer import mask_to_label_image
from drake_pose.systems.truncated_ekf import STATISTICS, HandSensor, TruncatedEkf, plant_motion
from tests.systems.bench import Bench

PERIOD = 1 / 30
LAYOUT = StateLayout(("swing",), ("length",))
LIMITS = from_bounds(["swing", "length"], [-2.0, 0.2], [2.0, 2.0])
ABOUT = Belief(np.array([0.5, 0.0, 1.0]), np.diag([0.2, 0.2, 0.1]) ** 2)


@pytest.fixture(scope="module")
def hand():
    f, observation = experiment_filter()
    return f, observation, make_sequence(35.0, "full", observation, np.random.default_rng(5))


def swinging(period=0.1, **settings):
    """Return a filter for a swinging rod whose end one camera measures."""
    end = FunctionObservation(
        ("u", "v"), 0.02, lambda x: x[2] * np.array([np.sin(x[0]), -np.cos(x[0])])
    )
    motion = constant_velocity(LAYOUT, {"swing": 0.5}, period)
    return TruncatedFilter(LAYOUT, end, LIMITS, motion, FilterSettings(**settings))


def statistic(run, name):
    return run["statistics"][STATISTICS.index(name)]


def test_a_system_equals_the_filter(hand):
    """Also without a measurement, and in static views, whose offsets are part of the state."""
    f, observation, sequence = hand
    rows = sequence.measurements[:24].copy()
    rows[6:8] = np.nan
    noise = np.sqrt(observation.variances)
    rows[16:] = rows[16] + noise * np.random.default_rng(0).normal(size=rows[16:].shape)
    rows[17:, -1] = np.nan
    run, n, active = Bench(TruncatedEkf(f, sequence.guess, PERIOD)), len(HAND_STATE), 0
    state, counts = f.start(sequence.guess), []
    assert not run["active_limits"].any()
    for t, y in enumerate(rows):
        state = f.update(f.predict(state) if t else state, y)
        run.update(PERIOD * t, measurement=y)
        counts.append(state.view[1])
        np.testing.assert_array_equal(run["estimated_state"], state.best.mean)
        cut = np.isin(f.inequalities.rows, state.hypotheses[0].active)
        np.testing.assert_array_equal(run["active_limits"], cut)
        active += cut.sum()
    assert active > 0
    assert max(counts[:17]) < counts[-1] == run.system.filter_state(run.context).view[1]
    np.testing.assert_array_equal(run["covariance"], state.estimate.covariance.ravel())
    np.testing.assert_array_equal(run["overall_state"], state.overall.mean)
    np.testing.assert_array_equal(run["overall_covariance"], state.overall.covariance.ravel())
    weights, states = run["hypothesis_weights"], run["hypothesis_states"].reshape(8, n)
    covariances = run["hypothesis_covariances"].reshape(8, -1)
    for k, one in enumerate(state.hypotheses):
        assert weights[k] == one.weight
        np.testing.assert_array_equal(states[k], one.belief.mean)
        np.testing.assert_array_equal(covariances[k], one.belief.covariance.ravel())
    count = len(state.hypotheses)
    assert not weights[count:].any()
    assert np.isnan(states[count:]).all()
    assert np.isnan(covariances[count:]).all()
    np.testing.assert_array_equal(run["statistics"][:4], [24, count, state.distance, state.count])


def test_a_loss_is_reported_and_a_reset_ends_it(hand):
    """A hand that jumps is lost, and the filter restarts from the reset state."""
    f, _, sequence = hand
    moved, lost = sequence.measurements[:20].copy(), []
    # The hand jumps in each frame, which contradicts a constant velocity.
    moved[8:14, :2] += np.where(np.arange(8, 14) % 2, 150.0, -150.0)[:, None]
    run = Bench(TruncatedEkf(f, sequence.guess, PERIOD))
    for t, y in enumerate(moved):
        run.update(PERIOD * t, measurement=y, reset_state=sequence.states[t])
        lost.append(statistic(run, "lost"))
    # By default the track is lost after three consecutive unlikely measurements.
    np.testing.assert_array_equal(lost[:11], [*np.zeros(10), 1])
    assert lost[-1] == 0
    np.testing.assert_allclose(run["estimated_state"][:2], sequence.states[19, :2], atol=3)


def test_it_restarts_when_told_and_at_first():
    run, x = Bench(TruncatedEkf(swinging(), ABOUT)), np.array([0.9, 0.0, 1.2])
    run.update(0.0, restart=[0.0], reset_state=x)
    np.testing.assert_allclose(run["estimated_state"], x, atol=1e-6)
    start = run["covariance"]
    run.update(0.1, reset_state=x - 0.3)
    np.testing.assert_allclose(run["estimated_state"], x, atol=0.01)
    assert np.abs(run["covariance"] - start).max() > 1e-4
    run.update(0.2, restart=[1.0], reset_state=x * np.nan)
    np.testing.assert_allclose(run["estimated_state"], x, atol=0.01)
    run.update(0.3, reset_state=x - 0.3)
    np.testing.assert_allclose(run["estimated_state"], x - 0.3, atol=1e-6)
    np.testing.assert_allclose(run["covariance"], start, rtol=1e-3, atol=1e-6)


def test_a_measurement_can_have_its_own_noise(hand):
    """The model's noise, ten times larger noise, and NaN in either where nothing is measured."""
    f, observation, sequence = hand
    y, R, deviations = sequence.measurements[0], np.diag(observation.variances), []
    hidden, unknown = y.copy(), R.copy()
    hidden[:9], unknown[:9], unknown[:, :9] = np.nan, np.nan, np.nan
    for seen, noise in ((y, None), (y, R), (y, 100.0 * R), (hidden, R), (y, unknown)):
        run = Bench(TruncatedEkf(f, sequence.guess, PERIOD))
        if noise is not None:
            run.give(measurement_covariance=noise.ravel())
        run.update(measurement=seen)
        deviations.append(np.sqrt(np.diag(run["covariance"].reshape(len(HAND_STATE), -1))))
    np.testing.assert_array_equal(deviations[0], deviations[1])
    assert (deviations[2][:2] > 2 * deviations[1][:2]).all()
    np.testing.assert_array_equal(deviations[3], deviations[4])


def test_a_contexts_parameters_set_the_filter():
    """As in a filter constructed with them; more hypotheses than the ports hold are refused."""
    settings = FilterSettings(linearisation="tangent", iterations=5)
    run, other = (Bench(TruncatedEkf(swinging(**k), ABOUT)) for k in ({}, vars(settings)))
    run.context.get_mutable_abstract_parameter(0).set_value(settings)
    for t, y in enumerate(([0.5, -0.8], [0.6, -0.7])):
        for one in (run, other):
            one.update(0.1 * t, measurement=y)
    for port in ("estimated_state", "covariance"):
        np.testing.assert_array_equal(run[port], other[port])
    # Its patience is set only in the context.
    run.context.get_mutable_numeric_parameter(0).SetFromVector([1.0, 0.5])
    assert statistic(run.update(0.3, measurement=[1.5, 0.2]), "lost") == 1
    for value, word in ((FilterSettings(hypothesis_cap=9), "8 hypotheses"), ("joint", "not str")):
        run.context.get_mutable_abstract_parameter(0).set_value(value)
        with pytest.raises(SettingsError, match=word):
            run.update(0.4)
    with pytest.raises(SettingsError, match=r"backwards, from 0\.1 s to 0\.05 s"):
        other.update(0.05)
    other.system.SetDefaultContext(other.context)
    other.update(0.05)


def test_the_period_is_the_motions():
    """Updates at 0, 0.02, ... s; the one at the end of the simulation is pending, unless later."""
    for offset, steps in ((0.0, 5), (0.019, 5), (0.021, 4)):
        run = Bench(TruncatedEkf(swinging(0.02), ABOUT, offset=offset)).advance(0.1)
        assert statistic(run, "step") == steps


def pendulum(time_step, name="swing"):
    """Return a plant with a point mass of 1 kg 0.8 m below a joint."""
    plant = MultibodyPlant(time_step)
    inertia = SpatialInertia(1.0, [0.0, 0.0, -0.8], UnitInertia(0.64, 0.64, 0.0))
    rod = plant.AddRigidBody("rod", inertia)
    plant.AddJoint(RevoluteJoint(name, plant.world_frame(), rod.body_frame(), [0.0, 1.0, 0.0]))
    plant.Finalize()
    return plant


@pytest.mark.parametrize("time_step", [0.0, 1e-3])
def test_plant_motion_integrates_the_differential_equation(time_step):
    motion = plant_motion(pendulum(time_step), LAYOUT, 1e-6 * np.eye(3), 0.1)
    for x in ([0.5, -1.0, 0.3], [2.5, 3.0, 0.3]):
        expected = solve_ivp(
            lambda t, z: [z[1], -9.81 / 0.8 * np.sin(z[0])], (0.0, 0.1), x[:2], rtol=1e-10
        ).y[:, -1]
        found, slope = motion.predict(np.array(x))
        # A discrete plant's steps of 1 ms cause an error of that order.
        np.testing.assert_allclose(found[:2], expected, atol=0.01 if time_step else 1e-5)
        assert found[2] == x[2]
        assert np.isfinite(slope).all()
    TruncatedFilter(LAYOUT, swinging().observation, LIMITS, motion).start(ABOUT)


def test_the_hand_sensor_measures_near_the_prediction():
    belief_filter, truth = experiment_filter()[0], true_states(35.0, np.zeros(6))[24]
    silhouette = HandSilhouette(belief_filter, 480, 400, (239.5, 199.5))
    belief = Belief(truth, np.diag(np.full(len(truth), 1e-8)))
    run = Bench(HandSensor(silhouette)).give(estimated_state=truth, statistics=[3.0, 1, 0, 0, 0])
    run.give(covariance=belief.covariance.ravel())
    assert np.isnan(run["measurement"]).all()
    assert run["difference"] == 1.0
    image = silhouette.draw(truth) > 0
    # The scale of the first frame is known; a later one's prediction is a step ahead.
    for step in (3.0, 0.0):
        run.give(label_image=mask_to_label_image(image), statistics=[step, 1.0, 0.0, 0.0, 0.0])
        seen = (belief_filter.predict_belief(belief),) if step else (belief, 1.0)
        found = silhouette.measure(image, *seen)
        np.testing.assert_array_equal(run["measurement"], found.y)
        np.testing.assert_array_equal(run["measurement_covariance"], found.covariance.ravel())
        np.testing.assert_array_equal(run["rough_state"], found.rough)
        assert np.count_nonzero(np.isfinite(found.y)) > 15


def test_invalid_arguments_are_refused(hand):
    (f, _, sequence), rod, plants = hand, swinging(), (pendulum(0.0), pendulum(1e-3))
    for make, given, word in (
        (TruncatedEkf, (f, sequence.guess, 0.0), "period"),
        (TruncatedEkf, (f, sequence.guess, 0.1, 0), "patience"),
        (TruncatedEkf, (f, sequence.guess, 0.1, 1, 1.0), "loss_probability"),
        (TruncatedEkf, (f, sequence.guess, 0.1, 1, -0.1), "loss_probability"),
        (TruncatedEkf, (f, Belief(np.full(37, np.nan), np.eye(37)), 0.1), "NaN"),
        (TruncatedEkf, (f, ABOUT), "per step"),
        (TruncatedEkf, (rod, ABOUT, 0.5), r"the motion's period is 0\.1 s, not 0\.5"),
        (TruncatedEkf, (LAYOUT, ABOUT), "a TruncatedFilter, not StateLayout"),
        (TruncatedEkf, (rod, ABOUT.mean), "a Belief, .* ndarray"),
        (TruncatedEkf, (rod, Belief(np.zeros(2), np.eye(2))), "3 elements"),
        (plant_motion, (plants[0], StateLayout(("turn",), ()), np.eye(2), 0.1), "swing; .* turn"),
        (plant_motion, (plants[0], LAYOUT, np.eye(3), 0.0), "period"),
        (plant_motion, (plants[1], LAYOUT, np.eye(3), 0.1005), "multiple"),
    ):
        with pytest.raises(SettingsError, match=word):
            make(*given)
