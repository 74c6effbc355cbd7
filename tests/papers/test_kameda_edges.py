from dataclasses import replace

import numpy as np
import pytest

from drake_pose.papers.kameda.experiment import beam_experiment_search, run_experiment
from drake_pose.papers.kameda.inner_edges import (
    edge_lines,
    noisy_edges,
    settle_by_edges,
)
from drake_pose.search.grid.families.inner_edges import edges_of_labels


@pytest.mark.slow
def test_edges_settle_what_the_silhouette_leaves_open() -> None:
    result = run_experiment(beam_experiment_search(), images=20, seed=2026)
    # Few poses, so that all are judged, and one silhouette that leaves nothing open.
    few = [one for one in result.trials if 1 < one.result.pose_set.size < 100]
    alone = [one for one in result.trials if one.result.pose_set.size == 1]
    counts = settle_by_edges(replace(result, trials=(*few, *alone[:1])))
    assert counts["ambiguous"] == len(few) > 1
    assert 0 < counts["edges_narrow"] <= counts["ambiguous"]
    assert counts["edges_settle"] <= counts["edges_narrow"]
    assert counts["edges_settle_rightly"] == counts["edges_settle"]
    assert counts["edges_keep_truth"] == counts["ambiguous"]
    # With edges to the pixel nothing that can be settled is left open.
    assert counts["edges_settle"] + counts["edges_undecidable"] == counts["ambiguous"]
    assert str(counts["edges_keep_truth"]) in edge_lines(counts)
    noisy = settle_by_edges(replace(result, trials=tuple(few)), noise=0.2)
    assert noisy["edges_keep_truth"] == noisy["ambiguous"] == len(few)
    assert 0 < noisy["edges_settle"] <= counts["edges_settle"]
    assert noisy["edges_settle_rightly"] == noisy["edges_settle"]
    assert noisy["edges_undecidable"] == counts["edges_undecidable"]


def test_noise_loses_moves_and_adds_edges() -> None:
    segments = np.zeros((80, 80), dtype=np.int64)
    segments[:, 40:] = 1
    edges = edges_of_labels(segments, np.ones((80, 80), dtype=np.bool_))
    noisy = noisy_edges(edges, 0.3, np.random.default_rng(0))
    columns = np.nonzero(noisy.edges)[1]
    near = np.abs(columns - 39) <= 1
    assert 0.4 < near.sum() / 80 < 0.9
    assert (~near).any()
    assert (noisy.errors.missing, noisy.errors.wrong) == (0.3, 0.075)
    assert noisy_edges(edges, 0.9, np.random.default_rng(0)).edges[:, 38:41].sum() < near.sum()
