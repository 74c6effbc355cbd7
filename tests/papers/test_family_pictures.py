"""Pictures of families: a column for each, and what stands on them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from drake_pose.papers.kameda.experiment import (
    beam_experiment_search,
    draw_values,
    experiment_camera,
)
from drake_pose.papers.kameda.family_pictures import save_families
from drake_pose.search.grid.families.search import find_families, samples_at
from tests.search.grid_problems import show_pose


@pytest.mark.slow
def test_a_column_for_each_family(tmp_path: Path) -> None:
    search, camera = beam_experiment_search(), experiment_camera()
    generator = np.random.default_rng(77)
    for _ in range(20):
        values = draw_values(search, "grid", generator)
        view = show_pose(search.sampled, values, camera)
        samples = samples_at(search.sampled, values)
        assert samples is not None
        answer = find_families(search.body, [view], samples, 0.0)
        if answer.family_count == 2:
            break
    assert answer.family_count == 2
    model = search.tree.model
    both = cv2.imread(str(save_families(tmp_path / "out" / "both.png", model, answer, [view])))
    one = cv2.imread(str(save_families(tmp_path / "one.png", model, answer, [view], most=1)))
    assert both.shape[0] == one.shape[0]
    assert both.shape[1] > 1.8 * one.shape[1]
    # Both columns hold colours: the segments.
    colourful = np.ptp(both.astype(int), axis=2) > 60
    half = both.shape[1] // 2
    assert colourful[:, :half].mean() > 0.02
    assert colourful[:, half:].mean() > 0.02
