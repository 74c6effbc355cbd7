"""A real robot arm in damaged masks: found, and honest about what hardly shows."""

from pathlib import Path

import numpy as np
import pytest

from tests.jobs.arm_figures import BASE, flipped_arms, measure_arm


def test_flips_are_eight_and_all_different() -> None:
    values = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    found = [tuple(np.round(one % (2.0 * np.pi), 6)) for one in flipped_arms(values)]
    assert len(set(found)) == 8


@pytest.mark.slow
def test_the_recorded_arm(shared_data: Path) -> None:
    figures = list(measure_arm(shared_data / "arm_two_views"))
    for one in figures:
        assert (one.excess <= 0.03).all(), one
        assert one.held[BASE].all(), one
    # As often as claimed: how the flange is turned hardly shows.
    assert np.mean([one.held for one in figures]) >= 0.95
    assert np.median([one.errors[BASE] for one in figures]) <= 1.5
    # Nobody can tell from these masks how the flange is turned.
    assert not any(one.determined[-1] for one in figures)
