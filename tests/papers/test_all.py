import html
import json

import pytest

from drake_pose.commands.main import app
from drake_pose.errors import OutputError
from drake_pose.papers import all_experiments
from drake_pose.papers.all_experiments import (
    BESIDE,
    EXPERIMENTS,
    FIGURES,
    REPORT,
    Experiment,
    Outcome,
    reproduce_all,
)
from tests.cli import CliRunner


def quiet(_what, _total):
    return lambda _done: None


class Interrupted(Exception):
    pass


@pytest.fixture
def two_experiments(monkeypatch):
    """Two that write down that they ran; the second is interrupted the first time."""
    ran = []

    def first(_short, folder, _count):
        ran.append("first")
        (folder / "some.png").write_bytes(b"no picture")
        beside = [("E", "{x} %", "22.3 % < 30 %", {"x": 34}, "15 %")]
        return Outcome({"value": float("nan")}, ["a <table>"], beside)

    def second(_short, folder, _count):
        ran.append("second")
        (folder / "half.txt").write_text("half")
        if ran.count("second") == 1:
            raise Interrupted
        return Outcome({}, [])

    experiments = (Experiment("first", "A & B", "x", first), Experiment("second", "C", "y", second))
    monkeypatch.setattr(all_experiments, "EXPERIMENTS", experiments)
    return ran


def test_what_is_finished_is_kept_and_the_rest_made_again(two_experiments, tmp_path):
    with pytest.raises(Interrupted):
        reproduce_all(tmp_path, True, quiet, lambda _text: None)
    assert (tmp_path / "first" / FIGURES).is_file()
    assert not (tmp_path / "second").exists()
    assert "Not finished: second" in (tmp_path / REPORT).read_text()
    reproduce_all(tmp_path, True, quiet, lambda _text: None)
    assert two_experiments == ["first", "second", "second"]
    page = (tmp_path / REPORT).read_text()
    assert "Not finished" not in page
    assert "A &amp; B" in page
    assert "a &lt;table&gt;" in page
    assert "<td>E</td><td>22.3 % &lt; 30 %</td><td>34 %</td><td>15 %</td>" in page
    assert "data:image/png" in page
    assert json.loads((tmp_path / "first" / FIGURES).read_text()) == {"value": None}
    assert not list(tmp_path.glob("*.part"))


def test_other_settings_are_refused(two_experiments, tmp_path):
    with pytest.raises(Interrupted):
        reproduce_all(tmp_path, True, quiet, lambda _text: None)
    with pytest.raises(OutputError, match="other settings"):
        reproduce_all(tmp_path, False, quiet, lambda _text: None)


def test_a_folder_that_holds_something_is_refused_without_resume(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    refused = CliRunner().invoke(app, ["reproduce", "all", "--short", "--out", str(tmp_path)])
    assert refused.exit_code == 1
    assert "not empty" in refused.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.slow
def test_all_of_it_short(tmp_path):
    made = CliRunner().invoke(app, ["reproduce", "all", "--short", "--out", str(tmp_path / "all")])
    assert made.exit_code == 0, made.output
    page = (tmp_path / "all" / REPORT).read_text()
    assert page.count("</tr>") > 25
    for experiment in EXPERIMENTS:
        beside = json.loads((tmp_path / "all" / experiment.name / BESIDE).read_text())
        assert beside["cpu_seconds"] > 0
        assert beside["figures"] or "not in the paper" in experiment.title
        for row in beside["figures"]:
            assert html.escape(row["paper"]) in page
        assert json.loads((tmp_path / "all" / experiment.name / FIGURES).read_text())
        assert experiment.title.split(":")[0] in html.unescape(page)
    assert "Short" in page
    assert page.count("data:image/png") >= 10
