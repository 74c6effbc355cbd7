"""Laws of a filter for a user's system, compared with other filters and Monte Carlo."""

import numpy as np
import pytest

from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.filtering.inequalities import from_bounds
from drake_pose.filtering.motion import FunctionMotion, LinearMotion, constant_velocity
from drake_pose.filtering.state import Belief, StateLayout, linearise_over
from drake_pose.filtering.truncated_filter import FilterSettings, TruncatedFilter
from drake_pose.filtering.update import FunctionObservation
from tests.benchmarks import filters

LAYOUT = StateLayout(("angle",), ("length",))
FREE = from_bounds(LAYOUT.names, np.full(3, -np.inf), np.full(3, np.inf))
STEP = constant_velocity(LAYOUT, {"angle": 0.5}, 0.1)
START = Belief(np.array([0.6, 0.1, 1.0]), np.diag([0.2, 0.3, 0.15]) ** 2)
SLOPE = np.array([[1.0, 0.0, 0.5], [0.0, 0.0, -1.0]])
LINEAR = FunctionObservation(("a", "b"), [0.1, 0.3], lambda x: SLOPE @ x, lambda x: SLOPE)


def end_of(x):
    return x[2] * np.array([np.cos(x[0]), np.sin(x[0])])


def end_slope(x):
    cosine, sine = np.cos(x[0]), np.sin(x[0])
    return np.array([[-x[2] * sine, 0, cosine], [x[2] * cosine, 0, sine]])


END = FunctionObservation(("u", "v"), 0.05, end_of, end_slope)


def make(observation=END, rows=FREE, motion=STEP, **settings):
    return TruncatedFilter(LAYOUT, observation, rows, motion, FilterSettings(**settings))


def begin(*observation, **motion):
    return make(*observation, **motion).start(START)


def follow(f, measured, start=START):
    state, beliefs = f.start(start), []
    for t, y in enumerate(measured):
        state = f.update(f.predict(state) if t else state, y)
        beliefs.append(state.best)
    return beliefs


def draw(generator, observation, frames=20, start=START):
    """Return true states drawn from the start and the motion, and their measurements."""
    x = start.mean + start.root @ generator.normal(size=3)
    states, root = [], np.linalg.cholesky(STEP.noise + 1e-15 * np.eye(3))
    for t in range(frames):
        if t:
            x = STEP.transition @ x + root @ generator.normal(size=3)
        states.append(x)
    noise = np.sqrt(observation.variances) * generator.normal(size=(frames, 2))
    return np.array(states), np.array([observation.function(x) for x in states]) + noise


def test_linear_models_without_limits_give_the_kalman_filter():
    """Compared with the least-squares solution of all frames at once."""
    _, measured = draw(np.random.default_rng(0), LINEAR)
    measured[5, 0] = np.nan
    found = follow(make(LINEAR), measured)[-1]
    # Unknowns: the first state and the noise of each step, whitened.
    n, frames = 3, len(measured)
    roots = [START.root, *[np.linalg.cholesky(STEP.noise + 1e-18 * np.eye(3))] * (frames - 1)]
    now, mean, rows, values = np.zeros((n, n * frames)), START.mean, [], []
    for t, y in enumerate(measured):
        if t:
            now, mean = STEP.transition @ now, STEP.transition @ mean
        now[:, n * t : n * t + n] += roots[t]
        partly_occluded = np.isfinite(y)
        weigh = 1.0 / np.sqrt(LINEAR.variances[partly_occluded])
        rows.append(weigh[:, None] * SLOPE[partly_occluded] @ now)
        values.append(weigh * (y - SLOPE @ mean)[partly_occluded])
    A, b = np.concatenate(rows), np.concatenate(values)
    covariance = np.linalg.inv(np.eye(n * frames) + A.T @ A)
    np.testing.assert_allclose(found.mean, mean + now @ (covariance @ A.T @ b), atol=1e-6)
    np.testing.assert_allclose(found.covariance, now @ covariance @ now.T, atol=1e-8)


def test_motion_models_equal_stone_soups():
    linear = pytest.importorskip("stonesoup.models.transition.linear")
    from datetime import timedelta

    time = {"time_interval": timedelta(seconds=0.1)}
    for memory, theirs in (
        (np.inf, linear.ConstantVelocity(0.25)),
        (0.4, linear.OrnsteinUhlenbeck(0.25, 1 / 0.4)),
    ):
        ours = constant_velocity(LAYOUT, {"angle": 0.5}, 0.1, memory)
        np.testing.assert_allclose(ours.transition[:2, :2], theirs.matrix(**time), atol=1e-12)
        np.testing.assert_allclose(ours.noise[:2, :2], theirs.covar(**time), atol=1e-12)


def test_tangents_give_stone_soups_extended_kalman_filter():
    pytest.importorskip("stonesoup", reason="Stone Soup is not installed")
    from datetime import datetime, timedelta

    from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
    from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import ExtendedKalmanUpdater

    class Ends(NonLinearGaussianMeasurement):
        @property
        def ndim_meas(self):
            return 2

        def function(self, state, noise=False, **kwargs):
            return end_of(np.asarray(state.state_vector, dtype=float).ravel())[:, None]

        def jacobian(self, state, **kwargs):
            return end_slope(np.asarray(state.state_vector, dtype=float).ravel())

    model = Ends(3, [0, 1, 2], np.diag(END.variances))
    _, measured = draw(np.random.default_rng(1), END)
    ours = follow(make(END, linearisation="tangent"), measured)
    step = LinearGaussianTimeInvariantTransitionModel(
        transition_matrix=STEP.transition, covariance_matrix=STEP.noise
    )
    predictor = KalmanPredictor(step)
    updater = ExtendedKalmanUpdater()
    start_time = datetime(2020, 1, 1)
    state = GaussianState(START.mean[:, None], START.covariance, timestamp=start_time)
    for t, (y, belief) in enumerate(zip(measured, ours, strict=True)):
        at = start_time + timedelta(seconds=0.1 * t)
        prediction = predictor.predict(state, timestamp=at) if t else state
        detection = Detection(y[:, None], timestamp=at, measurement_model=model)
        state = updater.update(SingleHypothesis(prediction, detection))
        np.testing.assert_allclose(belief.mean, np.ravel(state.mean), atol=1e-8)
        np.testing.assert_allclose(belief.covariance, state.covar, atol=1e-8)


def test_nees_is_one_for_linearisation_over_the_belief():
    """By Monte Carlo: true states drawn from the initial belief, with a curved measurement."""
    wide = Belief(START.mean, np.diag([0.6, 0.3, 0.3]) ** 2)
    nees = {"spread": [], "tangent": []}
    for seed in range(120):
        states, measured = draw(np.random.default_rng(seed), END, 15, wide)
        for linearisation, values in nees.items():
            beliefs = follow(make(linearisation=linearisation), measured, wide)
            for x, belief in zip(states, beliefs, strict=True):
                error = belief.mean - x
                values.append(error @ np.linalg.solve(belief.covariance, error) / 3)
    means = {name: np.mean(values) for name, values in nees.items()}
    assert means["spread"] == pytest.approx(1.0, abs=0.12)
    assert means["tangent"] > means["spread"] + 0.1


def test_a_ring_of_look_alikes_has_its_mixture():
    """Only the distance of a point is measured: the posterior is a ring, cut by limits."""
    layout = StateLayout((), ("x", "y"))
    far = FunctionObservation(("distance",), 0.1, lambda x: np.array([np.hypot(*x)]))
    still = LinearMotion(np.eye(2), np.zeros((2, 2)), 0.1)
    start = Belief(np.array([0.4, 0.1]), np.diag([0.7, 0.7]) ** 2)
    limits, settings = from_bounds(["x"], [-0.5], [2.0]), FilterSettings(hypothesis_cap=16)
    f = TruncatedFilter(layout, far, limits, still, settings)
    state = f.start(start)
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 2.0, 400), np.linspace(-2, 2, 640)), -1)
    log = -0.5 * (((grid - start.mean) / 0.7) ** 2).sum(axis=-1)
    for _ in range(3):
        state = f.update(state, np.array([1.0]))
        log -= 0.5 * ((np.hypot(*np.moveaxis(grid, -1, 0)) - 1.0) / 0.1) ** 2
    density = (np.exp(log) / np.exp(log).sum())[..., None]
    mean = (density * grid).sum(axis=(0, 1))
    off = (grid - mean).reshape(-1, 2)
    np.testing.assert_allclose(state.overall.mean, mean, atol=0.05)
    expected = (density.reshape(-1, 1) * off).T @ off
    np.testing.assert_allclose(state.overall.covariance, expected, atol=0.04)
    estimate = state.estimate
    off = estimate.mean - state.overall.mean
    np.testing.assert_allclose(estimate.covariance - np.outer(off, off), state.overall.covariance)


def test_limits_stop_rates():
    """A joint that moves beyond its limit has been stopped; its rate is no longer known."""
    f = make(rows=from_bounds(["angle"], [-0.2], [1.5]))
    for angle, is_free in ((0.5, True), (1.49, False)):
        before = f.start(Belief(np.array([angle, 3.0, 1.0]), np.diag([0.02, 0.1, 0.1]) ** 2))
        after = f.predict(before).best
        known = after.deviations()[1]
        assert known < 0.5 if is_free else known == pytest.approx(3.0, rel=0.1)


def test_defaults_beat_a_clipped_ekf_on_an_arm_of_unknown_lengths():
    """And stay inside the limits, in a few runs of the benchmark's arm."""
    ends, low = (1, 3), []
    ours, plain = (
        filters.measure(filters.FILTERS[name], ends, range(2000, 2006))
        for name in ("ours, defaults", "plain EKF, clipped to the limits")
    )
    assert ours[0] < plain[0]
    assert ours[1] < plain[1]
    assert 0.5 < ours[2] < 1.5
    for seed in range(2000, 2003):
        run = filters.draw_run(seed, ends)
        found = filters.FILTERS["ours, defaults"](filters.observe(ends), filters.motion(), run)
        rows = filters.LIMITS.for_columns(filters.LAYOUT.names)
        low.append((rows.b - found.means @ rows.phi.T).min())
    assert min(low) > -1e-9


def test_shifted_prior_moves_the_posterior_by_their_covariance_ratio():
    """By the posterior's covariance times the inverse of the prior's."""
    y, shift = np.array([1.0, -0.8]), np.array([0.1, -0.2, 0.3])
    f, free = make(LINEAR), []
    for mean in (START.mean, START.mean + shift):
        free.append(f.update(f.start(Belief(mean, START.covariance)), y).best)
    ratio = free[0].covariance @ np.linalg.inv(START.covariance)
    np.testing.assert_allclose(free[1].mean - free[0].mean, ratio @ shift, atol=1e-10)


def test_linearise_over_is_exact_for_quadratics():
    """In mean and covariance, compared with Monte Carlo of correlated elements."""
    generator = np.random.default_rng(0)
    C, A = generator.normal(size=(2, 3, 3)), generator.normal(size=(2, 3))
    C += C.transpose(0, 2, 1)
    root = np.tril(generator.normal(size=(3, 3)))
    belief = Belief(generator.normal(size=3), root @ root.T)

    def function(x):
        return A @ x + 0.5 * np.einsum("kij,i,j->k", C, x, x), A + C @ x

    line, called = (
        linearise_over(function, belief, np.zeros(2, dtype=bool), values)
        for values in (None, lambda x: function(x)[0])
    )
    for one, other in zip(line, called, strict=True):
        np.testing.assert_allclose(other, one, atol=1e-9)
    x = belief.mean + generator.normal(size=(400_000, 3)) @ root.T
    values = x @ A.T + 0.5 * np.einsum("kij,ni,nj->nk", C, x, x)
    spread = line.slope @ belief.covariance @ line.slope.T + line.remainder
    scale = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(line.value / scale, values.mean(axis=0) / scale, atol=0.01)
    np.testing.assert_allclose(
        np.cov(values.T) / np.outer(scale, scale), spread / np.outer(scale, scale), atol=0.03
    )


def test_linearise_over_a_certain_belief_gives_the_tangent():
    covariance = np.diag([0.04, 0.0, 0.0])
    line = linearise_over(END.predict, Belief(START.mean, covariance), END.wraps)
    np.testing.assert_allclose(line.slope[:, 2], end_slope(START.mean)[:, 2])
    narrow = linearise_over(END.predict, Belief(START.mean, 1e-14 * np.eye(3)), END.wraps)
    np.testing.assert_allclose(narrow.slope, end_slope(START.mean), atol=1e-6)
    assert np.abs(narrow.remainder).max() < 1e-20


@pytest.mark.parametrize("memory", [np.inf, 0.4])
def test_prediction_over_a_second_does_not_depend_on_the_period(memory):
    ends = []
    for count in (1, 10, 200):
        step = constant_velocity(LAYOUT, {"angle": 0.5}, 1.0 / count, memory)
        mean, P = START.mean, START.covariance
        for _ in range(count):
            mean, P = step.transition @ mean, step.transition @ P @ step.transition.T + step.noise
        ends.append((mean, P))
    for mean, P in ends[1:]:
        np.testing.assert_allclose(mean, ends[0][0], atol=1e-12)
        np.testing.assert_allclose(P, ends[0][1], atol=1e-12)
    if memory == np.inf:
        # In one second the rate's standard deviation is s, the angle's s / sqrt(3).
        noise = constant_velocity(LAYOUT, {"angle": 0.5}, 1.0).noise
        np.testing.assert_allclose(np.sqrt(np.diag(noise)), [0.5 / np.sqrt(3.0), 0.5, 0.0])


def test_function_motion_equals_linear_motion():
    _, measured = draw(np.random.default_rng(2), END)
    function = FunctionMotion(lambda x: STEP.transition @ x, STEP.noise, STEP.period)
    for linearisation in ("spread", "tangent"):
        plain, called = (
            follow(make(motion=motion, linearisation=linearisation), measured)[-1]
            for motion in (STEP, function)
        )
        np.testing.assert_allclose(called.mean, plain.mean, atol=1e-8)
        np.testing.assert_allclose(called.covariance, plain.covariance, atol=1e-8)


def test_nonlinear_motion_matches_monte_carlo():
    """For a pendulum's step over a wide belief."""

    def swing(x):
        return np.array([x[0] + 0.3 * x[1], x[1] - 0.3 * 9.8 * np.sin(x[0]) / x[2], x[2]])

    f = make(motion=FunctionMotion(swing, 1e-6 * np.eye(3), 0.3))
    found = f.predict_belief(START)
    draws = START.mean + np.random.default_rng(0).normal(size=(100_000, 3)) @ START.root.T
    ends = np.array([swing(x) for x in draws[:20_000]])
    scale = ends.std(axis=0)
    np.testing.assert_allclose(found.mean / scale, ends.mean(axis=0) / scale, atol=0.05)
    np.testing.assert_allclose(found.deviations() / scale, 1.0, atol=0.05)


WRONG = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, -1.0]])


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (
            lambda: begin(
                FunctionObservation(("u", "v"), 0.05, end_of, lambda x: WRONG * end_slope(x))
            ),
            r"the observation: the Jacobian of 'v' by 'length' is -0\.56.*differences give 0\.56",
        ),
        (
            lambda: begin(motion=FunctionMotion(np.sin, STEP.noise, 0.1, lambda x: np.eye(3))),
            "the motion: the Jacobian of 'angle' by 'angle' is 1, differences give 0.82",
        ),
        (lambda: begin(FunctionObservation(("u",), 0.05, end_of)), r"observation gives .* \(2,\)"),
        (
            lambda: begin(motion=FunctionMotion(lambda x: x[:2], STEP.noise, 0.1)),
            r"the motion gives values \(2,\)",
        ),
        (lambda: FunctionObservation(("u", "v"), [0.1, 0.0], end_of), "positive"),
        (lambda: FunctionObservation(("u", "v"), [0.1] * 3, end_of), "2 measurements"),
        (lambda: FunctionObservation(("u", "v"), 0.1, end_of, angles=["w"]), "'w'"),
        (lambda: TruncatedFilter(LAYOUT, END, FREE, STEP.noise), "ndarray has no noise"),
        (lambda: TruncatedFilter(LAYOUT, end_of, FREE, STEP), "function has no names"),
        (lambda: TruncatedFilter(LAYOUT, END, FREE, STEP, {}), "FilterSettings, not dict"),
        (lambda: make(motion=LinearMotion(np.eye(2), STEP.noise, 0.1)), "transition: expected"),
        (lambda: make(motion=LinearMotion(np.eye(3), np.eye(2), 0.1)), "noise: expected"),
        (lambda: TruncatedFilter(("angle",), END, FREE, STEP), "StateLayout, not tuple"),
        (lambda: TruncatedFilter(LAYOUT, END, [], STEP), "Inequalities, not list"),
        (lambda: make().start((START.mean, START.covariance)), "a Belief, not tuple"),
        (lambda: make().start(Belief(np.zeros(2), np.eye(2))), "3 elements"),
        (lambda: FunctionObservation("uv", 0.05, end_of), "different names, not 'uv'"),
        (lambda: make(linearisation="straight"), "spread, tangent"),
        (lambda: make(persistence=-1.0), "persistence"),
        (lambda: constant_velocity(LAYOUT, {"angle": 1.0}, 0.0), "period 0"),
        (lambda: constant_velocity(LAYOUT, {"elbow": 1.0}, 0.1), "'elbow'"),
    ],
)
def test_invalid_arguments_are_refused_by_name(act, words):
    with pytest.raises((SettingsError, UnknownNameError), match=words):
        act()


def test_correct_jacobians_with_angles_and_nan_pass():
    """Also where an angle wraps, and where a measurement is NaN."""

    def partly_occluded(x):
        return np.array([np.arctan2(np.sin(x[0]), np.cos(x[0])), np.nan, x[2]])

    bearing = FunctionObservation(
        ("angle", "hidden", "length"), 0.1, partly_occluded, angles=["angle"]
    )
    start = Belief(np.array([np.pi, 0.0, 1.0]), START.covariance)
    f = make(bearing)
    found = f.update(f.start(start), np.array([-np.pi + 0.1, 5.0, 1.0]))
    assert found.count == 2
    assert found.best.mean[0] == pytest.approx(np.pi + 0.08, abs=0.01)
