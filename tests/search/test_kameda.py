"""Kameda's search against a naive implementation of the paper, in bodies of four kinds."""

import math

import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.search import PaperSearch, PaperSearchSettings, View
from tests.search.bodies import box_link, front_camera, joint, load_body
from tests.search.naive_search import NaiveSearch


@pytest.mark.parametrize(("views", "K", "r"), [(1, 1, 12.0), (1, 8, 100.0), (2, 3, 20.0)])
def test_search_equals_a_naive_implementation_of_the_paper(maker, views, K, r):
    """Pose, J, first J and runs of step 3, from masks of grid poses and of others."""
    settings = PaperSearchSettings(outside_limit=r, candidate_limit=K, **maker.grid)
    search, generator = PaperSearch(maker.tree, settings), np.random.default_rng(K)
    for k in range(4):
        shown = maker.make(generator, views=views, on_grid=k < 2, noise=0.01 * (k == 3)).views
        naive = NaiveSearch(maker, [view.mask for view in shown], r, K).run()
        result = search.match(shown)
        assert (result.runs, result.found) == (naive.runs, naive.best is not None)
        assert result.outside_limit == (r,) * views
        assert result.stopped_by == "end"
        if result.found:
            area = sum(view.mask.sum() for view in shown)
            assert (result.J, result.area) == (naive.best[0], area)
            assert result.first_J == naive.first_J
            for i, values in naive.best[1].items():
                np.testing.assert_array_equal(result.node_values[i], values)
        else:
            assert np.isnan(result.q).all()


@pytest.fixture(scope="module")
def sliders(tmp_path_factory):
    """A 20 x 10 box that slides right, and on it a 6 x 8 box that slides up [pixel]."""
    return load_body(
        tmp_path_factory.mktemp("sliders"),
        box_link("wide", 20, 10),
        joint("right", "prismatic", "world", "wide", (-0.1, 0.1), axis="0 1 0"),
        box_link("small", 6, 8),
        joint("up", "prismatic", "wide", "small", (0.0, 0.08), axis="0 0 1"),
    ).pose_tree()


@pytest.mark.parametrize(
    ("rows", "settings", "expected"),
    [
        # 12.6 % of the mean of 200 and 48 pixels is 15.6; the wide box has 56 pixels outside, so
        # the threshold is doubled twice. The wide box is placed three times.
        (np.s_[46:54, 41:59], {}, (0.126 * 124 * 4, 1 + 1 + 2, "end")),
        (np.s_[46:54, 41:59], {"run_limit": 2}, (0.126 * 124 * 2, 2, "run_limit")),
        (np.s_[46:54, 41:59], {"run_limit": 3}, (0.126 * 124 * 4, 3, "run_limit")),
        (np.s_[2:4, 2:4], {"outside_limit": 0.0}, (0.0, 1, "end")),
    ],
)
def test_the_threshold_doubles_until_a_pose_is_found(sliders, rows, settings, expected):
    mask = np.zeros((100, 100), dtype=bool)
    mask[rows] = True
    search = PaperSearch(sliders, PaperSearchSettings(length_interval=0.04, **settings))
    result = search.match([View(front_camera(), mask)])
    found = result.outside_limit[0], result.runs, result.stopped_by
    assert found == (pytest.approx(expected[0]), *expected[1:])
    assert result.found == (expected[1] == 4)


def test_a_pose_found_before_the_run_limit_is_returned(maker):
    """The first whole pose, after one run for each node."""
    shown, nodes = maker.make(np.random.default_rng(1), views=1).views, len(maker.tree.nodes)
    limited = PaperSearchSettings(run_limit=nodes, outside_limit=1e4, **maker.grid)
    result = PaperSearch(maker.tree, limited).match(shown)
    assert (result.found, result.runs) == (True, nodes)
    assert result.E_total <= result.first_E_total


def test_the_root_is_where_it_is_given(sliders):
    shown = np.zeros((100, 100), dtype=bool)
    shown[30:40, 50:70] = True
    for position in (None, np.array([0.0, 0.1, 0.15])):
        search = PaperSearch(sliders, PaperSearchSettings(length_interval=0.04, outside_limit=60.0))
        result = search.match([View(front_camera(), shown)], position)
        assert result.found == (position is not None)


def test_settings_out_of_range_are_refused():
    for bad in ({"interval": 0.0}, {"candidate_limit": 0}, {"outside_limit": -1.0},
                {"run_limit": 0}, {"interval": math.nan}, {"length_interval": -1.0}):  # fmt: skip
        with pytest.raises(SettingsError, match=next(iter(bad))):
            PaperSearchSettings(**bad)
