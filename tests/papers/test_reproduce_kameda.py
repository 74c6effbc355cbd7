"""Experiments B and C, and what the command `reproduce kameda` refuses."""

import json

import pytest

from drake_pose.commands.main import app
from drake_pose.errors import SceneError
from drake_pose.jobs.demo import stored_scene
from drake_pose.papers.kameda_real_pictures import REAL_EXPERIMENTS
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.cli import CliRunner


def reproduce(*options):
    return CliRunner().invoke(app, ["reproduce", "kameda", *options])


def test_a_folder_that_holds_something_is_refused(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    refused = reproduce("--experiment", "C", "--out", str(tmp_path))
    assert refused.exit_code == 1
    assert "not empty" in refused.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_the_pictures_are_there():
    frames = [load_scene(stored_scene(one.scene)).frames for one in REAL_EXPERIMENTS.values()]
    assert frames[0] == ("0000", "0010", "0020", "0030", "0040", "0049")
    assert len(frames[1]) == 2
    with pytest.raises(SceneError, match="'none'"):
        stored_scene("none")


@pytest.mark.slow
def test_both_methods_find_the_hand(tmp_path):
    """One of two pictures; E_total is compared with Drake's label image of the pose found."""
    made = reproduce("--experiment", "C", "--images", "1", "--out", str(tmp_path / "c"), "--json")
    assert made.exit_code == 0, made.output
    ours = json.loads(made.stdout)
    paper = ours["paper_method"]
    assert (ours["images"], paper["images"], ours["paper_images"]) == (1, 1, 3)
    assert (ours["method"], paper["method"]) == ("beam", "paper")
    assert ours["paper_mean_e_total"] == 0.172
    for figures in (ours, paper):
        assert figures["not_found"] == 0
        assert figures["mean_e_total"] == figures["e_total"]["0000"]
        folder = tmp_path / "c" / figures["method"]
        record = json.loads((folder / "summary.json").read_text())["frames"]["0000"]
        (iou,) = record["ious"].values()
        # Of an area J of their difference, whichever of the two bodies it lies outside of.
        assert 1 - iou - 0.005 <= figures["mean_e_total"] <= (1 - iou) / iou + 0.005
        assert len(list(folder.rglob("overlay/*/0000.png"))) == 1
    assert ours["mean_e_total"] < min(0.172, paper["mean_e_total"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--experiment", "D"), ("--experiment", "A", "B", "C")),
        (("--experiment", "B", "--seed", "1"), ("--seed", "--experiment A")),
        (("--experiment", "C", "--outside-limit", "9"), ("--outside-limit", "--experiment A")),
        (("--mismatch",), ("continuous",)),
        (("--views", "1"), ("continuous",)),
        (("--views", "0", "--angles", "continuous"), ("views",)),
        (("--angles", "continuous", "--method", "paper"), ("grid",)),
        (("--angles", "continuous", "--outside-limit", "200"), ("grid",)),
        (("--angles", "odd"), ("--angles", "grid", "continuous")),
        (("--edges",), ("--method beam",)),
        (("--edge-noise", "0.1", "--method", "beam"), ("--edges",)),
    ],
)
def test_what_means_nothing_is_refused(options, words):
    refused = reproduce("--images", "1", *options)
    assert refused.exit_code == 2
    for word in words:
        assert word in refused.stderr


def test_the_searches_stand_beside_the_one_that_was_asked_for():
    words = ("--images", "1", "--seeds", "2", "--renderer", "own", "--json")
    made = reproduce(*words, "--outside-weight", "10")
    assert made.exit_code == 0, made.output
    weighted = json.loads(made.stdout)
    paper = weighted["paper_method"]
    assert (weighted["outside_weight"], paper["outside_weight"]) == (10.0, 0.0)
    for one in (weighted, paper):
        assert one["spread"]["mean_runs"]["min"] <= one["mean_runs"]
        assert not {"seed", "images", "total_seconds"} & set(one["spread"])
