"""Layouts, beliefs and linearised functions, compared with algebra and exact moments."""

import numpy as np
import pytest

from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.filtering.state import (
    Belief,
    StateLayout,
    covariance_from,
    factor_of,
    linearise_over,
    make_belief,
    mix,
    numerical_jacobian,
    require_jacobian,
    wrapped_difference,
)
from tests.filtering.segment import END, LAYOUT, START, end_slope


def test_a_constant_acceleration_moves_places_and_rates():
    layout = StateLayout(("a", "b"), ("c",))
    assert layout.names == ("a", "b", "rate_a", "rate_b", "c")
    assert layout.indices(["c", "rate_a"]).tolist() == [4, 2]
    assert len(layout) == 5
    x, decay = np.arange(1.0, 6.0), 0.7
    moved = [x[0] + decay * x[2], x[1] + decay * x[3], decay * x[2], decay * x[3], x[4]]
    np.testing.assert_allclose(layout.transition(decay) @ x, moved)
    np.testing.assert_allclose(layout.transition() @ x, [4.0, 6.0, 3.0, 4.0, 5.0])
    # In a step an acceleration of 1 moves a place by 1/2 and its rate by 1.
    pushes = np.array([[0.5, 0.0, 1.0, 0.0, 0.0], [0.0, 0.5, 0.0, 1.0, 0.0]]).T
    expected = pushes @ np.diag([0.0, 3.0]) ** 2 @ pushes.T
    np.testing.assert_allclose(layout.process_noise({"a": 0.0, "b": 3.0}), expected)


@pytest.mark.parametrize("rank", [1, 3, 5])
def test_factors_and_covariances_are_inverse_also_if_singular(rank):
    sizes = np.array([1e-6, 1.0, 1e3, 1.0, 1.0])
    factor = sizes[:, None] * np.random.default_rng(rank).normal(size=(5, rank))
    found, scale = covariance_from(factor), np.outer(sizes, sizes)
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_allclose(found / scale, factor @ factor.T / scale, rtol=2e-9, atol=1e-12)
    assert (np.diag(np.linalg.cholesky(found)) > 0.0).all()
    singular = factor @ factor.T
    singular[:, 2], singular[2] = 0.0, 0.0
    root = factor_of(singular)
    np.testing.assert_allclose(root @ root.T / scale, singular / scale, atol=1e-10)


def test_beliefs_are_symmetric_and_may_be_hardly_indefinite():
    Q = np.array([[2.0, 0.3 + 1e-6], [0.3, 1.0]])
    belief = make_belief([1.0, 2.0], Q)
    np.testing.assert_array_equal(belief.covariance, [[2, 0.3 + 5e-7], [0.3 + 5e-7, 1]])
    np.testing.assert_allclose(belief.deviations(), [np.sqrt(2.0), 1.0])
    # The lowest eigenvalue of the correlations is minus the excess over 1.
    make_belief([0, 0], [[1, 1 + 9e-9], [1 + 9e-9, 1]])
    for excess in (1.2e-8, 2e-8):
        with pytest.raises(SettingsError, match="indefinite"):
            make_belief([0, 0], [[1, 1 + excess], [1 + excess, 1]])


def test_a_mixture_has_the_moments_of_its_parts():
    generator = np.random.default_rng(0)
    roots, means = generator.normal(size=(3, 2, 2)), generator.normal(size=(3, 2))
    parts = [Belief(mean, root @ root.T) for mean, root in zip(means, roots, strict=True)]
    weights = np.array([0.5, 0.3, 0.2])
    found = mix(weights, parts)
    np.testing.assert_allclose(found.mean, weights @ means)
    second = [one.covariance + np.outer(one.mean, one.mean) for one in parts]
    expected = np.tensordot(weights, second, 1) - np.outer(found.mean, found.mean)
    np.testing.assert_allclose(found.covariance, expected)


def test_differences_of_angles_are_the_shortest():
    a, b = np.random.default_rng(1).uniform(-9.0, 9.0, (2, 50, 2))
    found = wrapped_difference(a.copy(), b, np.array([True, False]))
    np.testing.assert_allclose(found[:, 0], np.angle(np.exp(1j * (a - b)[:, 0])))
    np.testing.assert_array_equal(found[:, 1], (a - b)[:, 1])


def quadratic(generator):
    """Return values and Jacobian of a quadratic function of 3 elements, and its coefficients."""
    C, A = generator.normal(size=(2, 3, 3)), generator.normal(size=(2, 3))
    C += C.transpose(0, 2, 1)
    return lambda x: (A @ x + 0.5 * np.einsum("kij,i,j->k", C, x, x), A + C @ x), A, C


@pytest.mark.parametrize("has_jacobian", [True, False])
def test_linearise_over_has_the_exact_moments_of_quadratics(has_jacobian):
    function, A, C = quadratic(np.random.default_rng(0))
    root = np.tril(np.random.default_rng(1).normal(size=(3, 3)))
    belief, no_angles = Belief(np.array([0.3, -1.0, 2.0]), root @ root.T), np.zeros(2, dtype=bool)
    values = None if has_jacobian else lambda x: function(x)[0]
    line = linearise_over(function, belief, no_angles, values)
    CP, value = C @ belief.covariance, function(belief.mean)[0]
    np.testing.assert_allclose(line.value, value + 0.5 * np.trace(CP, axis1=1, axis2=2))
    np.testing.assert_allclose(line.slope, A + C @ belief.mean)
    np.testing.assert_allclose(line.remainder, 0.5 * np.einsum("aij,bji->ab", CP, CP))
    R = belief.root
    np.testing.assert_allclose(line.bends, np.einsum("in,kij,jm->knm", R, C, R), atol=1e-10)
    np.testing.assert_array_equal(line.at, belief.mean)


@pytest.mark.parametrize("has_jacobian", [True, False])
def test_linearise_over_keeps_the_tangent_where_it_cannot_see(has_jacobian):
    """Without variance, where a value is NaN at a sigma point, and over a full turn."""

    called = []

    def function(x):
        called.append(x)
        seen = np.array([np.sin(x[0]), np.nan if x[0] > 0.4 else x[0] * x[1], np.pi - 0.1 * x[0]])
        slope = np.array([[np.cos(x[0]), 0.0], [x[1], x[0]], [-0.1, 0.0]])
        seen[2] = np.remainder(seen[2] + np.pi, 2.0 * np.pi) - np.pi
        return seen, slope

    at = Belief(np.array([0.1, 3.0]), np.diag([0.04, 0.0]))
    values = None if has_jacobian else lambda x: function(x)[0]
    line = linearise_over(function, at, np.array([False, False, True]), values)
    # Steps that change no value need no second derivatives, here the Jacobian at the mean.
    assert len(called) == (5 if has_jacobian else 6)
    end = np.sqrt(3.0) * 0.2
    secant = (np.sin(0.1 + end) - np.sin(0.1 - end)) / (2.0 * end)
    np.testing.assert_allclose(line.slope, [[secant, 0.0], [3.0, 0.1], [-0.1, 0.0]], atol=1e-9)
    np.testing.assert_allclose(line.value[1:], function(at.mean)[0][1:], atol=1e-9)
    np.testing.assert_allclose(line.remainder[1:], 0.0, atol=1e-12)


def test_numerical_jacobians_have_nine_digits():
    no_angles, size = np.zeros(2, dtype=bool), 1.0
    x = np.array([0.3, -1.0, 40.0])
    found = numerical_jacobian(END.function, x, no_angles, size)
    np.testing.assert_allclose(found, end_slope(x), atol=1e-8)
    # The error of central differences grows with the square of the step.
    cube = numerical_jacobian(lambda x: x**3, np.array([0.0, 2.0]), no_angles, 1000.0)
    np.testing.assert_allclose(np.diag(cube) - [0.0, 12.0], np.square([6e-3, 12e-3]), rtol=1e-3)


@pytest.mark.parametrize(
    ("element", "wrong", "is_refused"),
    [
        (2, 1.5e-4, False),  # Beside an entry of about 1,
        (2, 4e-4, True),
        (1, 1.5e-6, False),  # and of 0.
        (1, 4e-6, True),
        (1, np.nan, True),
        (2, np.inf, True),
    ],
)
def test_wrong_jacobians_are_refused(element, wrong, is_refused):
    x, no_angles = np.array([-0.5, 0.0, 1.0]), np.zeros(2, dtype=bool)
    slope = end_slope(x)
    slope[0, element] += wrong
    given = (lambda z: (END.function(z), slope), x, ("u", "v"), LAYOUT.names, no_angles, "it")
    if is_refused:
        with pytest.raises(SettingsError, match=f"it: .* of 'u' by '{LAYOUT.names[element]}'"):
            require_jacobian(*given)
    else:
        require_jacobian(*given)
    # Nothing is said of values that are not defined.
    hidden = (lambda z: (np.full(2, np.nan), np.full((2, 3), 9.0)), *given[1:])
    require_jacobian(*hidden)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: make_belief([np.nan, 0], np.eye(2)), "'0' is NaN"),
        (lambda: make_belief([0, 0], [[1, np.inf], [np.inf, 1]]), "'0' is NaN or infinity"),
        (lambda: make_belief([0, 0], [[1, 0], [0, np.nan]]), "'1' is NaN"),
        (lambda: make_belief([0, 0], [[1, 0.5 + 4e-6], [0.5, 1]]), "symmetric"),
        (lambda: make_belief([0, 0], np.eye(3)), "fit"),
        (lambda: make_belief([0, 0], np.eye(2), LAYOUT, "it"), "it has .* 3 elements"),
        (lambda: make_belief(np.ones(3), np.diag([1.0, 1, -1]), LAYOUT), "'length'"),
        (lambda: LAYOUT.process_noise({"angle": -1.0}), "'angle'"),
        (lambda: LAYOUT.process_noise({"angle": np.inf}), "'angle'"),
        (lambda: LAYOUT.process_noise({}), "'angle'"),
        (lambda: LAYOUT.process_noise({"length": 1.0}), "length"),
        (lambda: LAYOUT.index("width"), "'width'"),
        (lambda: StateLayout(("a", "a"), ()), "'a'"),
        (
            lambda: require_jacobian(
                lambda x: (x[:2], np.eye(2)), START.mean, ("u", "v"), LAYOUT.names, END.wraps, "it"
            ),
            r"it gives values \(2,\) and a Jacobian \(2, 2\)",
        ),
    ],
)
def test_invalid_arguments_are_refused_by_name(make, word):
    with pytest.raises((SettingsError, UnknownNameError), match=word):
        make()
