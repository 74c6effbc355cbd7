"""Compare searches of a body with deformable skin with brute force."""

import itertools

import numpy as np
import pytest

from drake_pose.camera.models import ParallelCamera
from drake_pose.search import (
    BeamSearch,
    BeamSearchSettings,
    PaperSearch,
    PaperSearchSettings,
    SampledTree,
    Scoring,
    View,
)
from drake_pose.silhouette.outline import TreeSurfaces
from drake_pose.silhouette.scoring import draw_mask
from tests.body.models import load_limb
from tests.search.naive_search import NaiveSearch

INTERVAL = 0.8


@pytest.fixture(scope="module")
def limb(tmp_path_factory):
    return load_limb(tmp_path_factory.mktemp("limb"))


def side_camera():
    """Return a camera at an oblique angle, with the shoulder near the image centre."""
    turn = 0.3
    c, s = np.cos(turn), np.sin(turn)
    X_WC = np.array([[-s, 0, -c, 4.0], [c, 0, -s, 1.0], [0, -1, 0, 0.2], [0, 0, 0, 1.0]])
    return ParallelCamera("side", 120, 120, 90.0, 60.2, 60.1, X_WC)


def view_of(tree, values):
    camera = side_camera()
    surfaces = TreeSurfaces(tree).at(values)
    return View(camera, draw_mask(surfaces, camera.X_CW @ tree.node_poses(values), camera))


def random_samples(sampled, rng):
    return np.array([rng.integers(len(values)) for values in sampled.values])


def test_the_objective_includes_the_skin(limb):
    tree = limb.pose_tree()
    sampled = SampledTree(tree, PaperSearchSettings(interval=INTERVAL))
    rng = np.random.default_rng(0)
    target = random_samples(sampled, rng)
    view = view_of(tree, [v[t] for v, t in zip(sampled.values, target, strict=True)])
    scoring = Scoring(sampled, [view])
    samples = np.array([target, *(random_samples(sampled, rng) for _ in range(20))])
    Js = scoring.J(samples)
    assert Js[0] == 0
    for J, taken in zip(Js, samples, strict=True):
        mask = view_of(tree, [v[t] for v, t in zip(sampled.values, taken, strict=True)]).mask
        assert np.count_nonzero(mask ^ view.mask) == J


@pytest.mark.parametrize("seed", range(2))
def test_paper_search_with_skin_equals_a_naive_implementation(limb, seed):
    tree = limb.pose_tree()
    settings = PaperSearchSettings(interval=INTERVAL, outside_limit=8.0, candidate_limit=3)
    search = PaperSearch(tree, settings)
    rng = np.random.default_rng(seed)
    values = [rng.uniform(*tree.value_bounds(i)) for i in range(3)]
    view = view_of(tree, values)
    result = search.match([view])
    naive = NaiveSearch(search, view.camera, view.mask, 8.0, 3).run()
    assert result.found == (naive.best is not None)
    assert result.runs == naive.runs
    if naive.best is not None:
        assert result.J == naive.best[0]


def test_beam_search_with_skin_finds_the_minimum(limb):
    tree = limb.pose_tree()
    search = BeamSearch(tree, BeamSearchSettings(interval=INTERVAL))
    sampled = search.sampled
    rng = np.random.default_rng(10)
    target = [v[t] for v, t in zip(sampled.values, random_samples(sampled, rng), strict=True)]
    assert search.match([view_of(tree, target)]).J == 0
    values = [rng.uniform(*tree.value_bounds(i)) for i in range(3)]
    view = view_of(tree, values)
    scoring = Scoring(sampled, [view])
    samples = np.array(list(itertools.product(*(range(len(v)) for v in sampled.values))))
    assert search.match([view]).J == scoring.J(samples).min()
