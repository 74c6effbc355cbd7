"""Answers with their proof and their set, against the definition over whole grids."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.search.grid.beam_search import BeamSearch
from drake_pose.search.grid.examination import ExaminationSettings, examine
from drake_pose.search.grid.pose_families import samples_at
from drake_pose.search.settings import BeamSearchSettings

INTERVAL = 0.4


def search_of(maker, examination):
    return BeamSearch(maker.tree, BeamSearchSettings(interval=INTERVAL), examination)


def test_what_is_proved_is_the_best_of_the_grid(maker):
    examined = search_of(maker, ExaminationSettings(proof_poses=10**6, family_poses=10**6))
    generator = np.random.default_rng(5)
    for noise, views in itertools.product((0.0, 0.003, 0.01, 0.03), (1, 2)):
        problem = maker.make(generator, views=views, noise=noise, on_grid=noise == 0.0)
        result = examined.match(problem.views)
        best = problem.best[1]
        assert result.proved_optimal
        assert result.J == result.lower_bound == best
        assert not result.budget_spent
        samples = samples_at(maker.body.sampled, result.node_values)
        assert samples is not None
        assert tuple(samples.tolist()) in problem.within(best)
        area = sum(int(view.mask.sum()) for view in problem.views)
        assert result.E_total == pytest.approx(best / area)
        q, X_WB = maker.tree.positions_from(result.node_values)
        np.testing.assert_array_equal(result.q, q)
        np.testing.assert_array_equal(result.X_WB, X_WB)
        answer = result.pose_set
        assert answer is not None
        assert answer.complete
        assert answer.size == len(problem.within(best + answer.tolerance))


def test_a_worse_pose_is_replaced(maker):
    search = search_of(maker, None)
    generator = np.random.default_rng(8)
    for noise in (0.0, 0.01) * 3:
        problem = maker.make(generator, views=1, noise=noise, on_grid=noise == 0.0)
        found = search.match(problem.views)
        assert found.pose_set is None
        assert found.proved_optimal == (found.J == 0)
        wrong = int(generator.integers(len(problem.Js)))
        values = tuple(maker.body.sampled.values_at(problem.choices[wrong]))
        bad = replace(found, node_values=values, J=float(problem.Js[wrong]))
        mended = examine(search.body, problem.views, bad, ExaminationSettings())
        assert mended.proved_optimal
        assert mended.J == problem.best[1] < bad.J
        samples = samples_at(maker.body.sampled, mended.node_values)
        assert samples is not None
        assert tuple(samples.tolist()) in problem.within(mended.J)


def test_a_pose_between_the_samples_is_refused(maker):
    search = search_of(maker, None)
    problem = maker.make(np.random.default_rng(7), views=1, noise=0.0, on_grid=True)
    result = search.match(problem.views)
    values = tuple(value + 0.1 for value in result.node_values)
    moved = replace(result, node_values=values)
    with pytest.raises(SettingsError, match="not on the body's sampling grid"):
        examine(search.body, problem.views, moved, ExaminationSettings())


@pytest.mark.parametrize(
    "limit", [{"proof_poses": 1}, {"memory": 8_000}, {"proof_time_limit": 0.0}]
)
def test_a_limit_leaves_a_true_bound_and_no_false_proof(maker, limit):
    search = search_of(maker, None)
    generator = np.random.default_rng(12)
    proved = []
    for number in range(12):
        problem = maker.make(generator, views=1, noise=0.01, on_grid=False)
        start = int(np.argsort(problem.Js)[number])
        values = search.sampled.values_at(problem.choices[start])
        found = replace(search.match(problem.views), node_values=values, J=float(problem.Js[start]))
        settings = ExaminationSettings(family_poses=1, **limit)
        proof = examine(search.body, problem.views, found, settings)
        assert proof.lower_bound <= problem.best[1] <= proof.J <= found.J
        assert proof.J in problem.Js
        assert proof.budget_spent or proof.proved_optimal
        assert proof.pose_set.complete or not any(proof.pose_set.determined)
        proved.append(proof.proved_optimal)
    assert not all(proved)


@pytest.mark.parametrize(
    "settings",
    [
        {"tolerance": -1.0},
        {"families": 0},
        {"proof_poses": 0},
        {"memory": 0},
        {"proof_time_limit": -1.0},
        {"family_time_limit": float("nan")},
        {"proof_time_limit": float("inf")},
    ],
)
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(SettingsError, match=r"time_limit|positive|or more"):
        ExaminationSettings(**settings)
