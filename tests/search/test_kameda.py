import math

import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.search import PaperSearch, PaperSearchSettings, View
from drake_pose.silhouette.scoring import draw_mask
from tests.search.bodies import (
    box_link,
    forked_body,
    front_camera,
    joint,
    load_body,
    swinging_chain,
)
from tests.search.naive_search import NaiveSearch


def silhouette(search, camera, values):
    X_CN = camera.X_CW @ search.tree.node_poses(values)
    return draw_mask(search.sampled.outlines, X_CN, camera)


def random_silhouette(search, camera, generator):
    values = [grid[generator.integers(len(grid))] for grid in search.sampled.values]
    return silhouette(search, camera, values)


@pytest.fixture
def sliders(tmp_path):
    """A 20 x 10 box that slides right, and on it a 6 x 8 box that slides up [pixel]."""
    return load_body(
        tmp_path,
        box_link("wide", 20, 10),
        joint("right", "prismatic", "world", "wide", (-0.1, 0.1), axis="0 1 0"),
        box_link("small", 6, 8),
        joint("up", "prismatic", "wide", "small", (0.0, 0.08), axis="0 0 1"),
    ).pose_tree()


def slider_search(tree, **settings):
    return PaperSearch(tree, PaperSearchSettings(length_interval=0.04, **settings))


def test_step_6_goes_back_to_the_nearest_ancestor_with_an_untried_candidate(tmp_path):
    """The best candidate of the first box is wrong: there is no place for the arm below it.

    The mask has a blot of 10 x 10 pixels on the left, which the first box covers entirely. On the
    right is the true body: 10 x 8 pixels of the first box, so its score is smaller there, and an
    arm of 20 x 4 below.
    """
    model = load_body(
        tmp_path,
        box_link("first", 10, 10),
        joint("slide", "prismatic", "world", "first", (-0.2, 0.2), axis="0 1 0"),
        box_link("arm", 4, 20, z=-15.0),
        joint("weld_like", "prismatic", "first", "arm", (0.0, 0.0), axis="0 1 0"),
    )
    search = PaperSearch(
        model.pose_tree(), PaperSearchSettings(length_interval=0.2, outside_limit=20.0)
    )
    camera = front_camera()
    mask = silhouette(search, camera, [np.array([0.2]), np.array([0.0])])
    mask[45:47, 65:75] = False  # two rows of the true first box are missing: 20 pixels outside
    mask[45:55, 25:35] = True  # the blot, at slide = -0.2
    result = search.match([View(camera, mask)])
    np.testing.assert_allclose(result.q, [0.2, 0.0])
    # Step 3 runs for the box, for the arm without success, and for the arm again.
    assert result.runs == 3
    assert result.J == 20 + 100


def test_a_failed_search_is_reported(sliders):
    mask = np.zeros((100, 100), dtype=bool)
    mask[2:4, 2:4] = True
    result = slider_search(sliders, outside_limit=0.0).match([View(front_camera(), mask)])
    assert (result.found, result.runs, result.stopped_by) == (False, 1, "end")
    assert np.isnan(result.q).all()


def test_automatic_threshold_doubles_until_a_pose_is_found(sliders):
    mask = np.zeros((100, 100), dtype=bool)
    mask[46:54, 41:59] = True
    result = slider_search(sliders).match([View(front_camera(), mask)])
    # 12.6 % of the mean of 200 and 48 pixels is 15.6; the wide box has 56 pixels outside.
    assert result.found
    assert result.outside_limit[0] == pytest.approx(0.126 * 124 * 4)
    assert result.runs == 1 + 1 + 2


@pytest.mark.parametrize("K", [1, 5])
@pytest.mark.parametrize("body", ["chain3", "chain4", "fork"])
def test_search_equals_a_naive_implementation_of_the_paper(tmp_path, body, K):
    """Pose, J, first J and runs of step 3 equal those of the naive implementation."""
    model = forked_body(tmp_path) if body == "fork" else swinging_chain(tmp_path, int(body[-1]))
    r = 12.0
    settings = PaperSearchSettings(outside_limit=r, candidate_limit=K, interval=math.radians(30))
    search = PaperSearch(model.pose_tree(), settings)
    camera = front_camera(shift=0.1234)
    generator = np.random.default_rng(K)
    for _ in range(4):
        mask = random_silhouette(search, camera, generator)
        naive = NaiveSearch(search, camera, mask, r, K).run()
        result = search.match([View(camera, mask)])
        assert result.runs == naive.runs
        assert result.found == (naive.best is not None)
        if result.found:
            assert result.J == naive.best[0]
            assert result.first_E_total * mask.sum() == pytest.approx(naive.first_J)
            for i, values in naive.best[1].items():
                np.testing.assert_array_equal(result.node_values[i], values)


def test_a_second_view_determines_a_turn_invisible_in_the_first(tmp_path):
    """Of two cameras at right angles one sees the disc's sign of rotation."""
    model = load_body(
        tmp_path,
        box_link("disc", 12, 12, y=3.0),
        joint("spin", "revolute", "world", "disc", (-1.5, 1.5), axis="0 0 1"),
    )
    search = PaperSearch(
        model.pose_tree(), PaperSearchSettings(interval=math.radians(10), outside_limit=5.0)
    )
    front = front_camera()
    side = front_camera(name="side").with_pose(
        np.array([[1.0, 0, 0, 0], [0, 0, 1, -5], [0, -1, 0, 0], [0, 0, 0, 1]])
    )
    turn = [np.array([math.radians(-40)])]
    views = [View(camera, silhouette(search, camera, turn)) for camera in (front, side)]
    result = search.match(views)
    np.testing.assert_allclose(result.q, turn[0])
    assert result.J == 0
    assert len(result.outside_limit) == 2


def test_the_run_limit_is_reported(tmp_path):
    settings = PaperSearchSettings(run_limit=2, outside_limit=50.0)
    search = PaperSearch(swinging_chain(tmp_path, 3).pose_tree(), settings)
    camera = front_camera()
    mask = random_silhouette(search, camera, np.random.default_rng(3))
    result = search.match([View(camera, mask)])
    assert (result.found, result.runs, result.stopped_by) == (False, 2, "run_limit")


def test_settings_out_of_range_are_refused():
    for bad in ({"interval": 0.0}, {"candidate_limit": 0}, {"outside_limit": -1.0},
                {"run_limit": 0}, {"interval": math.nan}, {"length_interval": -1.0}):  # fmt: skip
        with pytest.raises(SettingsError, match=next(iter(bad))):
            PaperSearchSettings(**bad)
