"""Edges inside the silhouette: of hand-made pictures, and as a judge among poses."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.search.inner_edges import (
    EdgeErrors,
    _turn_subtrees,
    choose_by_edges,
    edges_of_labels,
    find_borders,
)
from drake_pose.search.pose_families import find_families, samples_at
from drake_pose.search.sampled_body import SampledBody
from drake_pose.search.settings import BeamSearchSettings
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.search.bodies import box_link, front_camera, joint, load_body
from tests.search.grid_problems import show_pose


def two_halves(column):
    segments = np.full((40, 60), -1)
    segments[5:35, 10:50] = 0
    segments[5:35, column:50] = 1
    return segments


def test_borders_lie_between_segments_and_not_at_the_silhouette():
    borders = find_borders(two_halves(30))
    expected = np.zeros((40, 60), dtype=np.bool_)
    expected[5:35, 29] = True
    assert np.array_equal(borders, expected)


@pytest.mark.parametrize(("shift", "at_least", "below"), [(0, -1, 1), (1, -150, -1), (3, -999, 0)])
def test_edges_are_likely_where_they_are_expected(shift, at_least, below):
    segments = two_halves(30)
    edges = edges_of_labels(segments, segments >= 0)
    found = [edges.log_likelihood(two_halves(30 + far)) for far in (shift, shift + 2)]
    assert at_least <= found[0] < below
    assert found[0] > found[1] or shift == 3


def test_half_an_edge_is_likelier_than_none():
    segments = two_halves(30)
    edges = edges_of_labels(segments, segments >= 0)
    half = np.where(np.arange(40)[:, None] < 20, segments, np.where(segments >= 0, 0, -1))
    plain = np.where(segments >= 0, 0, -1)
    found = [edges.log_likelihood(one) for one in (segments, half, plain)]
    assert found == sorted(found, reverse=True)
    assert len(set(found)) == 3


class Product:
    """A graph of all poses of some nodes' samples."""

    def __init__(self, allowed):
        self.allowed = allowed
        self.size = int(np.prod([one.sum() for one in allowed]))

    def restricted(self, allowed):
        both = zip(self.allowed, allowed, strict=True)
        return Product([own if one is None else own & one for own, one in both])

    def members(self):
        return np.array([*itertools.product(*map(np.flatnonzero, self.allowed))])


COUNT = 5


def test_turning_one_limb_after_the_other_ends_where_none_is_better():
    """A sum of each node's own misfit: whose least is found node by node, by few of all poses."""
    target, judged = np.array([3, 0, 4]), {}

    def judge(samples):
        judged[tuple(samples.tolist())] = -float(np.abs(samples - target).sum())
        return judged[tuple(samples.tolist())]

    graph = Product([np.ones(COUNT, bool)] * 3)
    tree = SimpleNamespace(subtrees=[(0,), (1,), (2,)])
    sampled = SimpleNamespace(tree=tree, values=[np.zeros((COUNT, 1))] * 3)
    answer = SimpleNamespace(sampled=sampled, graph=graph)
    _turn_subtrees(answer, np.array([0, 2, 1]), judge, 100, np.random.default_rng(0))
    assert judged[tuple(target.tolist())] == 0.0
    assert len(judged) < 6 * COUNT


def test_what_may_be_seen_sums_to_one():
    errors = EdgeErrors(missing=0.3, wrong=0.1, patch=3)
    assert np.allclose(np.exp(errors.log_pixel).sum(axis=1), 1.0)
    assert np.exp(errors.log_patch(50, 100.0)).sum() == pytest.approx(1.0)


@pytest.mark.parametrize("values", [{"missing": 0.0}, {"wrong": -1.0}, {"patch": 0}])
def test_errors_out_of_range_are_refused(values):
    with pytest.raises(SettingsError, match=next(iter(values))):
        EdgeErrors(**values)


def test_pictures_that_do_not_fit_are_refused():
    segments = two_halves(30)
    with pytest.raises(SettingsError, match="same camera"):
        edges_of_labels(segments, np.ones((30, 60), dtype=np.bool_))
    with pytest.raises(SettingsError, match="empty"):
        edges_of_labels(np.zeros((40, 60), dtype=int), np.zeros((40, 60), dtype=np.bool_))


@pytest.fixture
def arm_before_trunk(tmp_path):
    """Fifteen poses with one silhouette, the samples of one of them, and what draws them."""
    model = load_body(
        tmp_path,
        box_link("trunk", 40, 40),
        joint("turn", "revolute", "world", "trunk", (0.0, 0.0)),
        box_link("arm", 4, 14, y=1.0, z=-6.0),
        '<joint name="swing" type="revolute"><parent link="trunk"/><child link="arm"/>'
        '<origin xyz="0.1 0 0"/><axis xyz="1 0 0"/>'
        '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>',
    )
    body = SampledBody(model.pose_tree(), BeamSearchSettings(interval=0.4))
    camera = front_camera(80, shift=0.137)
    values = [np.zeros(1), np.array([1.2])]
    view = show_pose(body.sampled, values, camera)
    samples = samples_at(body.sampled, values)
    assert samples is not None
    answer = find_families(body, [view], np.zeros(2, dtype=np.int64), 0.0)
    assert answer.size == 15
    return answer, samples, LabelRenderer(model, camera)


def show_segments(answer, samples, renderer):
    values = [grid[t] for grid, t in zip(answer.sampled.values, samples, strict=True)]
    return renderer.segments(*answer.sampled.tree.positions_from(values))


@pytest.mark.parametrize("most", [300, 12])
def test_a_hand_before_the_trunk_is_found_by_its_edges(arm_before_trunk, most):
    """The silhouette shows nothing of it, its edges everything."""
    answer, samples, renderer = arm_before_trunk
    seen = show_segments(answer, samples, renderer)
    choice = choose_by_edges(
        answer, [edges_of_labels(seen, seen >= 0)], [renderer.segments], most=most
    )
    assert choice.left == 1
    # Of twelve of fifteen poses nobody knows what the other three would say.
    assert choice.settled == (most == 300)
    assert np.array_equal(choice.samples[0], samples)
    assert not choice.rules_out(samples)
    judged = {tuple(row) for row in choice.samples.tolist()}
    for member in answer.graph.members():
        others = tuple(member.tolist()) in judged and not np.array_equal(member, samples)
        assert choice.rules_out(member) == others
    assert choice.probabilities[0] == pytest.approx(1.0)
    assert choice.exhaustive == (most == 300)
    assert choice.joints[-1].holds(1.2)
    assert choice.joints[-1].determined == choice.exhaustive


def test_noise_on_the_edges_leaves_the_true_pose(arm_before_trunk):
    """Edges damaged at the rates that are stated, in squares that lie anywhere: 100 draws."""
    answer, samples, renderer = arm_before_trunk
    seen = show_segments(answer, samples, renderer)
    exact, generator = edges_of_labels(seen, seen >= 0), np.random.default_rng(5)
    drawn = [show_segments(answer, member, renderer) for member in answer.graph.members()]
    left = []
    for _ in range(100):
        lost = np.kron(generator.random((17, 17)) < 0.2, np.ones((5, 5), dtype=np.bool_))
        row, column = generator.integers(5, size=2)
        places = np.argwhere(exact.edges & ~lost[row : row + 80, column : column + 80])
        places += generator.integers(-1, 2, places.shape)
        damaged = np.zeros_like(exact.edges)
        damaged[tuple(places.T)] = True
        row, column = generator.choice(np.argwhere(exact.mask))
        damaged[row, column : column + 5] = True
        edges, pictures = replace(exact, edges=damaged & exact.mask), iter(drawn)
        choice = choose_by_edges(answer, [edges], [lambda *_, them=pictures: next(them)])
        assert not choice.rules_out(samples)
        left.append(choice.left)
    assert np.median(left) <= 5
