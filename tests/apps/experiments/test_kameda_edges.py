from dataclasses import replace

import pytest

from drake_pose.apps.experiments.kameda.experiment import beam_experiment_search, run_experiment
from drake_pose.apps.experiments.kameda.inner_edges import edge_lines, settle_by_edges


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
    assert str(counts["edges_keep_truth"]) in edge_lines(counts)
