"""Weights of explanations: conserved, whatever is merged or given up."""

import numpy as np
import pytest

from drake_pose.filtering.hypotheses import Hypothesis, merge_twins, normalise, prune
from drake_pose.filtering.state import Belief


def at(place, log_weight, deviation=1.0):
    belief = Belief(np.array([place, 0.0]), np.diag([deviation**2, 1.0]))
    return Hypothesis(belief, belief, log_weight, log_weight - 2.0)


def total(hypotheses):
    return sum(one.weight for one in hypotheses)


def gains(hypotheses):
    """How much heavier each is without the limits: what no weighing among others changes."""
    return [one.log_evidence - one.log_weight for one in hypotheses]


@pytest.mark.parametrize("common", [0.0, -800.0, 800.0])
def test_weights_add_up_to_one_and_keep_their_ratios(common):
    found = normalise([at(0.0, common - 1.0), at(1.0, common + 2.0), at(2.0, common)])
    assert [one.belief.mean[0] for one in found] == [1.0, 2.0, 0.0]
    expected = np.exp([2.0, 0.0, -1.0])
    np.testing.assert_allclose([one.weight for one in found], expected / expected.sum())
    np.testing.assert_allclose(gains(found), -2.0)


def test_twins_are_one_with_the_weight_of_both():
    """Nearer than so many deviations of the heavier in every element."""
    some = normalise([at(0.0, 0.0, 2.0), at(0.55, -1.0), at(0.65, -2.0), at(0.7, -3.0)])
    kept, rejected = merge_twins(some, 0.3, 7)
    assert [one.belief.mean[0] for one in kept] == [0.0, 0.65]
    assert [(one.step, one.reason) for one in rejected] == [(7, "twin")] * 2
    assert total(kept) == pytest.approx(1.0)
    assert kept[0].weight == pytest.approx(some[0].weight + some[1].weight)
    np.testing.assert_allclose(gains(kept), -2.0)


def test_what_is_given_up_is_too_light_or_one_too_many():
    some = [at(float(k), -1.5 * k) for k in range(5)]
    weights = [one.weight for one in normalise(some)]
    for cap, smallest, count, reasons in (
        (5, 0.0, 5, []),
        (2, 0.0, 2, ["cap"] * 3),
        (5, 0.5 * (weights[2] + weights[3]), 3, ["weight"] * 2),
        (2, 0.5 * (weights[2] + weights[3]), 2, ["cap", "weight", "weight"]),
        # The heaviest stays in any case.
        (1, 0.99, 1, ["weight"] * 4),
    ):
        kept, rejected = prune(some, cap, smallest, 3)
        assert [one.belief.mean[0] for one in kept] == list(range(count))
        assert [one.reason for one in rejected] == reasons
        assert total(kept) == pytest.approx(1.0)
