import io
import math

from rich.console import Console

from drake_pose.papers.tables import figure_table


def test_table_shows_figures_side_by_side():
    rows = {"a": ("count [mm]", "{}"), "b": ("ratio", "{:.1%}"), "none": ("nowhere", "{}")}
    table = figure_table(
        "T", rows, {"one [deg]": {"a": None, "b": math.nan}, "two": {"a": 4, "b": 0.25}}
    )
    console = Console(file=io.StringIO(), width=100)
    console.print(table)
    text = console.file.getvalue()
    for word in ("count [mm]", "one [deg]"):
        assert word in text
    assert "nowhere" not in text
    assert [list(one.cells) for one in table.columns[1:]] == [["-", "-"], ["4", "25.0%"]]
