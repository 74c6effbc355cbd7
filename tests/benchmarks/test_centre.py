"""What the benchmark of the process in the middle measures is the answer of one process."""

import numpy as np
import pytest

from tests.benchmarks.centre import SimulatedViews, measure_centre, measure_polls


@pytest.mark.slow
def test_groups_follow_as_one_process_does():
    views = SimulatedViews(6, 4)
    alone, apart = measure_centre(views, 0), measure_centre(views, 2)
    assert alone.q.shape == apart.q.shape == (4, len(views.first))
    assert np.abs(alone.q - views.first).max() > 0.0
    np.testing.assert_allclose(apart.q, alone.q, rtol=0.0, atol=1e-9)
    assert alone.sum_bytes == 0.0
    # A sum is some kilobytes, and there is one for each round.
    assert 10_000.0 < apart.sum_bytes < 100_000.0


@pytest.mark.slow
def test_polls_cost_something():
    assert 0.0 < measure_polls(2, 4, 100.0) < 1.0
