import json

import pytest

from drake_pose.commands.main import app
from drake_pose.errors import SettingsError
from drake_pose.filtering.kalman.truncated_filter import FilterSettings, TruncatedFilter
from drake_pose.papers.shimada.experiment import experiment_filter
from drake_pose.papers.shimada.static_view import run_static_experiment


@pytest.mark.slow
def test_staring_does_not_make_sure_and_new_views_still_correct():
    result = run_static_experiment(runs=4, seed=1, marks=(55, 400))
    assert (result.nees.mean(axis=0) < 1.7).all()
    figures = result.as_json()["static_frames"]
    assert figures["after_new_views"]["length_error_mean"] < 0.5
    assert figures["after_new_views"]["length_error_mean"] < figures["400"]["length_error_mean"]
    assert result.nees_after.mean() < 2.0
    assert result.table().row_count == 2


@pytest.mark.slow
def test_what_was_learned_is_not_unlearned():
    result = run_static_experiment(runs=4, seed=2, marks=(400,), start="learned")
    assert result.nees.mean() < 2.0
    assert result.errors.mean() < 0.5
    assert "after_new_views" not in result.as_json()["static_frames"]


def test_without_views_it_becomes_overconfident(monkeypatch):
    """The stated flaw shows as soon as every frame counts as new."""
    init = TruncatedFilter.__init__

    def forgetful(self, layout, observation, inequalities, noise, settings=None):
        init(self, layout, observation, inequalities, noise, FilterSettings(novelty=0.0))

    monkeypatch.setattr(TruncatedFilter, "__init__", forgetful)
    result = run_static_experiment(runs=2, seed=1, marks=(400,))
    assert result.nees.mean() > 10


def test_the_moving_sequence_is_all_new_views():
    f, _ = experiment_filter()
    assert f.novelty > 0
    paper, _ = experiment_filter(FilterSettings(truncation="sequential"))
    assert paper.novelty == 0


@pytest.mark.parametrize(
    ("bad", "word"),
    [
        ({"runs": 0}, "runs"),
        ({"marks": (0,)}, "marks"),
        ({"truncation": "x"}, "truncation"),
        ({"observed": "x"}, "observed"),
        ({"start": "x"}, "start"),
    ],
)
def test_bad_arguments_are_named(bad, word):
    with pytest.raises(SettingsError, match=word):
        run_static_experiment(**bad)


def test_the_command_stares(capsys):
    with pytest.raises(SystemExit) as ended:
        app(["reproduce", "shimada", "--runs", "1", "--static", "60", "--json"])
    assert ended.value.code == 0
    figures = json.loads(capsys.readouterr().out)["static_frames"]
    assert list(figures) == ["55", "60", "after_new_views"]


@pytest.mark.slow
def test_two_thousand_frames_of_one_view():
    result = run_static_experiment(runs=3, seed=5, marks=(55, 500, 2000))
    assert (result.nees.mean(axis=0) <= 2.0).all()
    assert result.errors_after.mean() < 0.5
