import html
import io
import json
import math

import pytest
from rich.console import Console

from drake_pose.commands.main import app
from drake_pose.errors import (
    OutputError,
    SettingsError,
    require_at_least,
    require_choice,
)
from drake_pose.papers import all_experiments
from drake_pose.papers.all_experiments import EXPERIMENTS, Experiment, reproduce_all
from drake_pose.papers.tables import figure_table, spread_over_seeds
from tests.cli import CliRunner


def quiet(_what, _total):
    return lambda _done: None


class Interrupted(Exception):
    pass


@pytest.fixture
def two_experiments(monkeypatch):
    """Two experiments that record their runs; the second one is interrupted the first time."""
    ran = []

    def first(_short, folder, _count):
        ran.append("first")
        (folder / "some.png").write_bytes(b"no picture")
        beside = [("E", "{x} %", "22.3 % < 30 %", {"x": 34}, "15 %")]
        return {"value": float("nan")}, ["a <table>"], beside

    def second(_short, folder, _count):
        ran.append("second")
        (folder / "half.txt").write_text("half")
        if ran.count("second") == 1:
            raise Interrupted
        return {}, [], ()

    experiments = (Experiment("first", "A & B", "x", first), Experiment("second", "C", "y", second))
    monkeypatch.setattr(all_experiments, "EXPERIMENTS", experiments)
    return ran


def test_finished_experiments_are_kept_and_others_repeated(two_experiments, tmp_path):
    with pytest.raises(Interrupted):
        reproduce_all(tmp_path, True, quiet, lambda _text: None)
    assert (tmp_path / "first" / "figures.json").is_file()
    assert not (tmp_path / "second").exists()
    assert "Not finished: second" in (tmp_path / "report.html").read_text()
    reproduce_all(tmp_path, True, quiet, lambda _text: None)
    assert two_experiments == ["first", "second", "second"]
    page = (tmp_path / "report.html").read_text()
    assert "Not finished" not in page
    assert "A &amp; B" in page
    assert "a &lt;table&gt;" in page
    assert "<td>E</td><td>22.3 % &lt; 30 %</td><td>34 %</td><td>15 %</td>" in page
    assert "data:image/png" in page
    assert json.loads((tmp_path / "first" / "figures.json").read_text()) == {"value": None}
    assert not list(tmp_path.glob("*.part"))


def test_other_settings_are_refused(two_experiments, tmp_path):
    with pytest.raises(Interrupted):
        reproduce_all(tmp_path, True, quiet, lambda _text: None)
    with pytest.raises(OutputError, match="other settings"):
        reproduce_all(tmp_path, False, quiet, lambda _text: None)


@pytest.mark.slow
def test_all_experiments_run_short(tmp_path):
    made = CliRunner().invoke(app, ["reproduce", "all", "--short", "--out", str(tmp_path / "all")])
    assert made.exit_code == 0, made.output
    page = (tmp_path / "all" / "report.html").read_text()
    assert page.count("</tr>") > 25
    for experiment in EXPERIMENTS:
        beside = json.loads((tmp_path / "all" / experiment.name / "paper.json").read_text())
        assert beside["cpu_seconds"] > 0
        assert beside["figures"] or "not in the paper" in experiment.title
        for row in beside["figures"]:
            assert html.escape(row["paper"]) in page
        assert json.loads((tmp_path / "all" / experiment.name / "figures.json").read_text())
        assert experiment.title.split(":")[0] in html.unescape(page)
    assert "Short" in page
    assert page.count("data:image/png") >= 10


RUNS = ({"seed": 3, "a": 1, "b": 0.5, "c": "x"}, {"seed": 4, "a": 4, "b": 0.25, "c": "x"})


def test_spread_over_seeds():
    spread = spread_over_seeds(RUNS, without=("seed",))
    assert spread == {
        "a": {"mean": 2.5, "min": 1.0, "max": 4.0},
        "b": {"mean": 0.375, "min": 0.25, "max": 0.5},
    }


def test_table_shows_one_run_or_mean_minimum_and_maximum():
    rows = {"a": ("count [mm]", "{}"), "b": ("ratio", "{:.1%}"), "none": ("nowhere", "{}")}
    table = figure_table("T", rows, {"one [deg]": {"a": None, "b": math.nan}, "several": RUNS})
    console = Console(file=io.StringIO(), width=100)
    console.print(table)
    text = console.file.getvalue()
    for word in ("count [mm]", "one [deg]", "2.5 (1 to 4)", "37.5% (25.0% to 50.0%)"):
        assert word in text
    assert "nowhere" not in text
    assert [list(column.cells) for column in table.columns][1] == ["-", "-"]


def test_bad_counts_and_choices_are_named():
    require_at_least(1, runs=1)
    with pytest.raises(SettingsError, match="images must be 1 or more, not 0"):
        require_at_least(1, runs=1, images=0)
    with pytest.raises(SettingsError, match="angle must be one of a, b, not 'c'"):
        require_choice("angle", "c", ("a", "b"))
