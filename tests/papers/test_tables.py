"""What all experiments' tables and pictures have in common."""

import io
import math

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from drake_pose.errors import SettingsError
from drake_pose.papers.tables import (
    figure_table,
    require_choice,
    require_counts,
    save_figure,
    save_picture,
    spread_over_seeds,
)

RUNS = ({"seed": 3, "a": 1, "b": 0.5, "c": "x"}, {"seed": 4, "a": 4, "b": 0.25, "c": "x"})


def test_the_spread_is_that_of_the_runs():
    spread = spread_over_seeds(RUNS, without=("seed",))
    assert spread == {
        "a": {"mean": 2.5, "min": 1.0, "max": 4.0},
        "b": {"mean": 0.375, "min": 0.25, "max": 0.5},
    }


def test_a_table_shows_one_run_or_mean_and_ends_of_several():
    rows = {"a": ("count [mm]", "{}"), "b": ("ratio", "{:.1%}"), "none": ("nowhere", "{}")}
    table = figure_table("T", rows, {"one [deg]": {"a": None, "b": math.nan}, "several": RUNS})
    console = Console(file=io.StringIO(), width=100)
    console.print(table)
    text = console.file.getvalue()
    for word in ("count [mm]", "one [deg]", "2.5 (1 to 4)", "37.5% (25.0% to 50.0%)"):
        assert word in text
    assert "nowhere" not in text
    assert [list(column.cells) for column in table.columns][1] == ["-", "-"]


def test_counts_and_choices_are_refused_by_name():
    require_counts(runs=1)
    with pytest.raises(SettingsError, match="images must be 1 or more, not 0"):
        require_counts(runs=1, images=0)
    with pytest.raises(SettingsError, match="angle must be one of a, b, not 'c'"):
        require_choice("angle", "c", ("a", "b"))


def test_pictures_are_written_with_their_colours(tmp_path):
    picture = np.zeros((4, 5, 3), dtype=np.uint8)
    picture[..., 0] = 200
    # In folders that are not there, and again in those that are.
    for _ in range(2):
        path = save_picture(picture, tmp_path / "new" / "deeper" / "red.png")
        np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], picture)
        drawn = save_figure(Figure(), tmp_path / "drawn" / "deeper" / "empty.png")
        assert drawn.stat().st_size > 100
