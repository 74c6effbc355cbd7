"""Why angles are wrong in experiment A: what is hidden, what edges show, what K cuts off."""

from dataclasses import replace

import numpy as np
import pytest

from drake_pose.papers.kameda.causes import causes_of_wrong_angles
from drake_pose.papers.kameda.chest_candidates import chest_ranks, share_within
from drake_pose.papers.kameda.experiment import (
    experiment_camera,
    experiment_search,
    run_experiment,
)
from drake_pose.silhouette.areas.scoring import draw_mask


@pytest.fixture(scope="module")
def search():
    return experiment_search()


def at(search, **degrees):
    """The nodes' values where all angles are 0 but those given."""
    model = search.tree.model
    q = np.zeros(len(model.position_names))
    for name, value in degrees.items():
        q[model.position_index(name)] = np.radians(value)
    return search.tree.values_from_positions(q)


def test_a_hand_before_the_belly_is_hidden_from_behind(search):
    camera = experiment_camera()
    behind = replace(camera, X_WC=np.diag([-1.0, -1.0, 1.0, 1.0]) @ camera.X_WC)
    arm = {"right_upper_arm_x": -15, "right_upper_arm_y": 60, "right_forearm_x": -60}
    true, found = at(search, **arm), at(search, **arm, right_hand_x=20)
    before = causes_of_wrong_angles(search.sampled, camera, true, found)
    assert (before.hidden, before.inner_edges) == (False, True)
    after = causes_of_wrong_angles(search.sampled, behind, true, found)
    assert (after.hidden, after.inner_edges) == (True, False)
    assert causes_of_wrong_angles(search.sampled, camera, true, true) == (False, False)


def test_the_chests_rank_is_that_of_areas_counted_in_masks(search):
    result = run_experiment(search, images=1, seed=5)
    ranks, lengths = chest_ranks(result)
    trial, nodes = result.trials[0], [node.name for node in search.tree.nodes]
    head, chest = nodes.index("head"), nodes.index("chest")

    def masks(values):
        X_CN = result.camera.X_CW @ search.tree.node_poses(values)
        outlines = search.sampled.surfaces.at(values)
        return [draw_mask([outlines[i]], X_CN[[i]], result.camera) for i in (head, chest)], (
            draw_mask(outlines, X_CN, result.camera)
        )

    (true_head, true_chest), silhouette = masks(trial.true_values)
    covered = []
    for values in search.sampled.values[chest]:
        posed = list(trial.true_values)
        posed[chest] = values
        (_, mask), _ = masks(posed)
        if (mask & ~silhouette).sum() <= search.settings.outside_limit:
            covered.append(int((mask & silhouette & ~true_head).sum()))
    own = int((true_chest & silhouette & ~true_head).sum())
    assert lengths[0] == pytest.approx(len(covered), abs=1)
    better = sum(one > own + 3 for one in covered)
    worse = sum(one < own - 3 for one in covered)
    assert 1 + better <= ranks[0] <= len(covered) - worse
    assert share_within(ranks, [int(ranks[0]) - 1, int(ranks[0])]) == [0.0, 1.0]
