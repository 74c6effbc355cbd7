import math

import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.papers.kameda.experiment import (
    PAPER,
    beam_experiment_search,
    draw_values,
    experiment_camera,
    experiment_search,
    run_experiment,
    side_camera,
)
from drake_pose.papers.kameda.pictures import save_pictures
from drake_pose.papers.kameda.table import experiment_table, spread_over_seeds
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer


@pytest.fixture(scope="module")
def result():
    return run_experiment(experiment_search(), images=8, seed=5)


def test_the_camera_is_the_papers():
    camera = experiment_camera()
    assert (camera.width, camera.height, camera.pixels_per_metre) == (700, 700, 226.0)
    # The world's y is the picture's right, z its up, x comes towards the camera.
    pixels, _ = camera.project(np.array([[0.0, 0, 0], [0, 1, 0], [0, 0, 1]]))
    np.testing.assert_allclose(pixels[1] - pixels[0], [226, 0], atol=1e-9)
    np.testing.assert_allclose(pixels[2] - pixels[0], [0, -226], atol=1e-9)


def test_the_side_camera_sees_depth():
    """It stands along the world's y and looks back: what comes towards the front goes left."""
    camera = side_camera()
    np.testing.assert_allclose(camera.X_WC[:3, 3], [0.0, 5.0, 0.0], atol=1e-12)
    pixels, depths = camera.project(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]))
    np.testing.assert_allclose(pixels[1] - pixels[0], [-226, 0], atol=1e-9)
    np.testing.assert_allclose(pixels[2] - pixels[0], [0, 0], atol=1e-9)
    np.testing.assert_allclose(pixels[3] - pixels[0], [0, -226], atol=1e-9)
    assert depths[2] < depths[0]


def test_lattice_angles_are_multiples_of_20_degrees_inside_table_2():
    search = experiment_search()
    values = draw_values(search, "grid", np.random.default_rng(1))
    for node, node_values in zip(search.tree.nodes, values, strict=True):
        model = search.tree.model
        for index, value in zip(node.positions, node_values, strict=True):
            assert model.lower[index] - 1e-9 <= value <= model.upper[index] + 1e-9
            if model.position_kinds[index] == "angle":
                assert math.degrees(value) / 20 == pytest.approx(round(math.degrees(value) / 20))


def test_continuous_angles_are_not_on_the_lattice_and_the_root_stays():
    search = experiment_search()
    values = draw_values(search, "continuous", np.random.default_rng(1))
    np.testing.assert_array_equal(values[0][:3], 0.0)
    off = [abs(math.degrees(v) / 20 - round(math.degrees(v) / 20)) for v in values[0][3:]]
    assert max(off) > 0.01


def test_the_figures_are_what_drake_draws(result):
    """E_total, recomputed from Drake's own label images of the true and the found pose."""
    renderer = LabelRenderer(result.search.tree.model, result.camera)
    for trial in result.trials:
        if trial.result.found:
            q_true, _ = result.search.tree.positions_from(trial.true_values)
            true, found = renderer.mask(q_true), renderer.mask(trial.result.q)
            # The two renderers differ by at most 0.2 % of a mask each.
            expected = (true ^ found).sum() / true.sum()
            assert trial.E_total == pytest.approx(expected, abs=0.004)


def test_json_has_the_keys_of_the_paper(result):
    figures = result.as_json()
    assert set(PAPER) | {"median_seconds"} <= set(figures)
    assert figures["images"] == 8
    assert figures["mean_e_total"] == pytest.approx(np.mean([t.E_total for t in result.trials]))
    assert figures["min_runs"] <= figures["mean_runs"]
    assert experiment_table([[result]]).row_count >= len(PAPER)


def test_the_same_seed_gives_the_same_figures(result):
    again = run_experiment(experiment_search(), images=8, seed=5).as_json()
    for key in ("mean_e_total", "exact", "pose_equal", "improved", "mean_runs"):
        assert again[key] == result.as_json()[key]


def test_poses_not_found_are_counted_apart():
    """With one candidate for each segment there is no way back: it often ends without a pose."""
    search = experiment_search(candidate_limit=1)
    partly = run_experiment(search, images=8, seed=5)
    figures = partly.as_json()
    found = [trial.result.E_total for trial in partly.trials if trial.result.found]
    assert 0 < len(found) < 8
    assert figures["not_found"] == 8 - len(found)
    assert figures["mean_e_total"] == pytest.approx(np.mean(found))


def test_a_cost_for_what_lies_outside_finds_more_exactly(result):
    weighted = run_experiment(experiment_search(outside_weight=10.0), images=8, seed=5)
    assert weighted.as_json()["outside_weight"] == 10.0
    assert result.as_json()["outside_weight"] == 0.0
    assert weighted.as_json()["exact"] >= 4 > result.as_json()["exact"]


def test_the_spread_over_seeds_is_that_of_its_runs(result):
    other = run_experiment(experiment_search(), images=8, seed=6)
    spread = spread_over_seeds([result, other])
    both = [one.as_json()["mean_e_total"] for one in (result, other)]
    assert spread["mean_e_total"]["min"] == min(both)
    assert spread["mean_e_total"]["max"] == max(both)
    assert spread["mean_e_total"]["mean"] == pytest.approx(np.mean(both))
    assert "seed" not in spread
    assert " to " in str(list(experiment_table([[result, other]]).columns[2].cells))


def test_nothing_outside_allowed_is_exact_far_more_often():
    """The paper's own expectation in section 6.1 for r = 0."""
    strict = run_experiment(experiment_search(outside_limit=0.0), images=12, seed=5)
    assert strict.as_json()["exact"] >= 7
    for trial in strict.trials:
        if trial.pose_equal:
            assert trial.exact


@pytest.fixture(scope="module")
def wide_result():
    return run_experiment(beam_experiment_search(), images=12, seed=5)


def test_the_wide_search_matches_every_silhouette_exactly(wide_result):
    """Without being told r, in one run over poses that the paper's search mostly misses."""
    figures = wide_result.as_json()
    assert figures["exact"] == figures["proved"] == figures["truth_in_set"] == 12
    assert figures["method"] == "beam"


def test_the_truth_is_in_the_set(wide_result):
    for trial in wide_result.trials:
        answer = trial.result.pose_set
        values = np.concatenate(trial.true_values)
        for joint, value in zip(answer.joints, values, strict=True):
            assert joint.holds(value)


def test_three_columns_stand_side_by_side(result, wide_result):
    table = experiment_table([[result], [wide_result]])
    assert [column.header for column in table.columns] == [
        "figure",
        "paper",
        "the paper's method",
        "beam search",
    ]
    assert table.row_count > experiment_table([[result]]).row_count


def test_the_wide_search_has_its_own_pictures(wide_result, tmp_path):
    names = {file.name for file in save_pictures(wide_result, tmp_path / "pictures")}
    assert "figure_11_milliseconds.png" in names
    ambiguous = any(one.result.pose_set.family_count > 1 for one in wide_result.trials)
    assert ("families_1.png" in names) == ambiguous


def test_pictures_are_written(result, tmp_path):
    files = save_pictures(result, tmp_path / "pictures")
    assert any("figure_11" in file.name for file in files)
    assert all(file.stat().st_size > 5000 for file in files)


def test_no_images_are_refused():
    with pytest.raises(SettingsError, match="images"):
        run_experiment(experiment_search(), images=0)
