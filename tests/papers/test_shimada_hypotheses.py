import json

import numpy as np
import pytest

from drake_pose.commands.main import app
from drake_pose.errors import SettingsError
from drake_pose.papers.shimada.experiment import experiment_filter
from drake_pose.papers.shimada.hypotheses import OBLIQUENESS, run_hypotheses_experiment
from drake_pose.papers.shimada.motion import true_states
from drake_pose.papers.shimada.pictures import save_hypotheses


@pytest.fixture(scope="module")
def result():
    return run_hypotheses_experiment(runs=20, seed=0)


def test_the_motion_obeys_table_1():
    rows = experiment_filter()[0].inequalities
    generator = np.random.default_rng(0)
    for _ in range(50):
        states = true_states(35.0, generator.uniform(-0.6, 0.6, 6), OBLIQUENESS)
        assert (rows.b - states @ rows.phi.T).min() >= -1e-9


def test_a_hypothesis_is_born_lives_and_dies_once(result):
    keys = [(one.run, one.frames[0], one.frames[-1], one.reason) for one in result.fates]
    firsts = [one for one in result.fates if one.frames[0] == 1 and one.run == 0]
    assert len(keys) > 20
    assert firsts
    for one in result.fates:
        assert np.array_equal(np.diff(one.frames), np.ones(len(one.frames) - 1))
        assert len(one.means) == len(one.frames)
        assert np.isnan(one.weights[-1]) == bool(one.reason)
    weights = np.zeros((20, 56))
    for one in result.fates:
        weights[one.run, one.frames] += np.nan_to_num(one.weights)
    assert weights[:, 1:] == pytest.approx(1.0)


def test_inequalities_reject_wrong_hypotheses_that_the_pictures_did_not(result):
    later = [one for one in result.fates if one.reason == "constraint" and one.lived]
    assert len(later) >= 3
    assert np.mean([one.wrong for one in later]) > 0.6
    rows = experiment_filter()[0].inequalities
    beyond = []
    for one in later:
        k = rows.rows.index(one.row)
        assert one.c < -4
        assert rows.phi[k] @ one.means[-2] <= rows.b[k] + 1e-9
        beyond.append(rows.phi[k] @ one.means[-1] > rows.b[k])
    # A row that comes late is judged after those before it have cut.
    assert np.mean(beyond) > 0.6


def test_what_is_drawn_was_wrong_and_another_pose(result, tmp_path):
    dead, survivor = result.shown()
    assert dead.wrong
    assert dead.lived >= 2
    assert survivor.frames[0] < dead.frames[-1] < survivor.frames[-1]
    before = int(dead.frames[-1]) - 1
    assert np.degrees(np.abs(dead.at(before) - survivor.at(before))[6:14]).max() > 8
    files = save_hypotheses(result, tmp_path)
    assert [file.name for file in files] == ["figure_9_hypotheses.png"]
    assert files[0].stat().st_size > 20000


def test_the_iterated_filter_has_no_such_hypotheses(capsys, tmp_path):
    """Linearised again and again, mirrored predictions come to the same."""
    with pytest.raises(SystemExit) as ended:
        app(["reproduce", "shimada", "--hypotheses", "--runs", "2", "--truncation", "joint",
             "--iterations", "20", "--out", str(tmp_path / "out"), "--json"])  # fmt: skip
    assert ended.value.code == 0
    written = capsys.readouterr()
    figures = json.loads(written.out)
    assert figures["rejected_later_than_made"] == 0
    assert figures["became_another"] > 0
    assert "nothing to draw" in written.err


def test_the_papers_filter_is_the_default(capsys):
    with pytest.raises(SystemExit) as ended:
        app(["reproduce", "shimada", "--hypotheses", "--runs", "1", "--json"])
    assert ended.value.code == 0
    figures = json.loads(capsys.readouterr().out)
    assert (figures["truncation"], figures["iterations"]) == ("sequential", 1)


@pytest.mark.parametrize(
    ("bad", "word"),
    [({"runs": 0}, "runs"), ({"truncation": "x"}, "truncation"), ({"observed": "x"}, "observed")],
)
def test_bad_arguments_are_named(bad, word):
    with pytest.raises(SettingsError, match=word):
        run_hypotheses_experiment(**bad)


@pytest.mark.parametrize("other", [("--static", "5"), ("--truncation", "all")])
def test_it_is_an_experiment_of_its_own(other, capsys):
    with pytest.raises(SystemExit) as ended:
        app(["reproduce", "shimada", "--hypotheses", *other])
    assert ended.value.code == 2
    assert "--hypotheses" in capsys.readouterr().err
