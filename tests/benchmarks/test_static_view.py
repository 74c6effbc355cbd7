import numpy as np
import pytest

from tests.benchmarks import static_view
from tests.benchmarks.static_view import WAYS, compare_ways


@pytest.mark.slow
def test_all_frames_at_once_come_nearer_than_the_first_frames_tangent():
    found = compare_ways(runs=10, seed=5)
    assert set(found) == set(WAYS)
    errors = {name: values[:, 1].mean() for name, values in found.items()}
    nees = {name: values[:, 0].mean() for name, values in found.items()}
    filtered = errors["the filter: the first frame's tangent"]
    assert errors["iterated smoother, curvature as noise"] < filtered
    assert errors["particles, each fitted"] < filtered
    # None of them is surer than it may be.
    assert max(nees.values()) < 2.0


def test_the_table_has_a_row_for_each_way(monkeypatch, capsys):
    made = {name: np.ones((1, 3)) for name in WAYS}
    asked = []
    monkeypatch.setattr(
        static_view, "compare_ways", lambda runs, seed: asked.append((runs, seed)) or made
    )
    monkeypatch.setattr("sys.argv", ["static_view", "3"])
    static_view.main()
    assert asked == [(3, 0)]
    shown = capsys.readouterr().out
    assert all(name in shown for name in WAYS)
