"""Edges inside the silhouette: of hand-made pictures, and as a judge among poses."""

from pathlib import Path

import numpy as np
import pytest

from drake_pose.apps.experiments.kameda.experiment import (
    beam_experiment_search,
    draw_values,
    experiment_camera,
)
from drake_pose.errors import SettingsError
from drake_pose.matching.grid.families.inner_edges import (
    choose_by_edges,
    edges_of_colours,
    edges_of_labels,
    find_borders,
    rank_families,
)
from drake_pose.matching.grid.families.search import find_families, samples_at
from drake_pose.matching.grid.sampled_body import SampledBody
from drake_pose.matching.grid.settings import BeamSearchSettings
from drake_pose.silhouette import LabelRenderer
from tests.matching.bodies import box_link, front_camera, joint, load_body
from tests.matching.grid_problems import show_pose


def two_halves(column: int) -> np.ndarray:
    segments = np.full((40, 60), -1)
    segments[5:35, 10:50] = 0
    segments[5:35, column:50] = 1
    return segments


def test_borders_lie_between_segments_and_not_at_the_silhouette() -> None:
    borders = find_borders(two_halves(30))
    expected = np.zeros((40, 60), dtype=np.bool_)
    expected[5:35, 29] = True
    assert np.array_equal(borders, expected)


@pytest.mark.parametrize(("shift", "agreement"), [(0, 1.0), (2, 1.0), (3, 0.0), (-6, 0.0)])
def test_edges_match_within_the_tolerance(shift: int, agreement: float) -> None:
    segments = two_halves(30)
    edges = edges_of_labels(segments, segments >= 0)
    assert edges.agreement(two_halves(30 + shift)) == agreement


def test_half_an_edge_agrees_by_half() -> None:
    segments = two_halves(30)
    edges = edges_of_labels(segments, segments >= 0)
    half = np.where(np.arange(40)[:, None] < 20, segments, np.where(segments >= 0, 0, -1))
    # 15 of 30 rows, two more within the tolerance; beside them a border along row 20.
    assert 0.4 < edges.agreement(half) < 0.8
    plain = np.where(segments >= 0, 0, -1)
    assert edges.agreement(plain) == 0.0
    assert edges_of_labels(plain, segments >= 0).agreement(plain) == 1.0


def test_colours_show_the_same_edges_and_their_noise_is_borne() -> None:
    generator = np.random.default_rng(1)
    segments = two_halves(30)
    colours = np.array([[200, 60, 60], [60, 60, 200], [0, 0, 0]])[segments]
    noise = generator.integers(-8, 9, (*segments.shape, 3))
    picture = np.clip(colours + noise, 0, 255).astype(np.uint8)
    edges = edges_of_colours(picture, segments >= 0)
    assert edges.agreement(segments) > 0.9
    assert edges.agreement(two_halves(20)) < 0.1


def test_pictures_that_do_not_fit_are_refused() -> None:
    segments = two_halves(30)
    with pytest.raises(SettingsError, match="same camera"):
        edges_of_labels(segments, np.ones((30, 60), dtype=np.bool_))
    with pytest.raises(SettingsError, match="empty"):
        edges_of_colours(np.zeros((40, 60, 3), dtype=np.uint8), np.zeros((40, 60), dtype=np.bool_))


@pytest.mark.parametrize("most", [300, 12])
def test_a_hand_before_the_trunk_is_found_by_its_edges(tmp_path: Path, most: int) -> None:
    """The silhouette shows nothing of it, its edges everything."""
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
    tree, camera = body.sampled.tree, front_camera(80, shift=0.137)
    values = [np.zeros(1), np.array([1.2])]
    view = show_pose(body.sampled, values, camera)
    samples = samples_at(body.sampled, values)
    assert samples is not None
    answer = find_families(body, [view], np.zeros(2, dtype=np.int64), 0.0)
    assert answer.size == 15
    renderer = LabelRenderer(model, camera)
    seen = renderer.segments(*tree.positions_from(values))
    choice = choose_by_edges(
        answer, [edges_of_labels(seen, view.mask)], [renderer.segments], most=most
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
    assert choice.agreements[0] == 1.0
    assert choice.exhaustive == (most == 300)
    assert choice.joints[-1].holds(1.2)
    assert choice.joints[-1].determined == choice.exhaustive


@pytest.mark.slow
def test_experiment_a_edges_never_speak_against_the_truth() -> None:
    search, camera = beam_experiment_search(), experiment_camera()
    generator = np.random.default_rng(77)
    renderer = LabelRenderer(search.tree.model, camera)
    before, after = 0.0, 0
    for _ in range(12):
        values = draw_values(search, "grid", generator)
        view = show_pose(search.sampled, values, camera)
        samples = samples_at(search.sampled, values)
        assert samples is not None
        answer = find_families(search.body, [view], samples, 0.0)
        if not 1.0 < answer.size <= 100.0:
            continue
        seen = renderer.segments(*search.tree.positions_from(values))
        edges = [edges_of_labels(seen, view.mask)]
        choice = choose_by_edges(answer, edges, [renderer.segments])
        left = {tuple(row) for row in choice.samples[: choice.left].tolist()}
        assert tuple(samples.tolist()) in left
        ranks = rank_families(answer, edges, [renderer.segments])
        assert len(ranks) == len(answer.families)
        assert ranks.max() <= choice.agreements[0] + 1e-9
        before, after = before + answer.size, after + choice.left
    assert after < 0.5 * before
