"""The method of Date et al. on recorded colour pictures, from the command line."""

import json

import numpy as np
import pytest

from drake_pose.errors import SceneError, SettingsError
from drake_pose.jobs.live import capture_live, load_live_scene
from drake_pose.person.date.skeleton import registered_positions
from tests.cli import run_command
from tests.jobs.live_scenes import standing, write_studio
from tests.jobs.scenes import read_rows

PLACE = (0.12, -0.1, 1.55)
HEADING = 0.3


@pytest.fixture(scope="module")
def path(person, skeleton):
    """A person who raises both arms to the registered pose, then reaches forward."""
    relaxed, shown = standing(person), registered_positions(skeleton)
    goal = np.array(shown)
    for name, degrees in (("left_upper_arm_x", -50), ("left_upper_arm_z", 30)):
        goal[person.position_index(name)] = np.radians(degrees)
    goal[person.position_index("left_forearm_x")] = np.radians(-50)
    for q in (relaxed, shown, goal):
        q[skeleton.head_positions] = PLACE
        q[skeleton.head_angles[0]] = HEADING
    up = [relaxed + share * (shown - relaxed) for share in np.linspace(0.0, 1.0, 5)]
    return [*up, shown, shown, *(shown + s * (goal - shown) for s in np.linspace(0.1, 1.0, 8))]


@pytest.fixture(scope="module")
def studio(tmp_path_factory, person, path):
    folder = tmp_path_factory.mktemp("studio")
    write_studio(folder, person, path, "videos", cameras=6, size=(320, 240))
    return folder


@pytest.mark.slow
def test_person_is_tracked_from_the_registered_pose(studio, person, skeleton, path, tmp_path):
    out = tmp_path / "out"
    words = ["capture", str(studio), "--method", "paper", "--no-replay", "--json"]
    done = run_command([*words, "--out", str(out)])
    assert done.exit_code == 0, done.output
    summary = json.loads(done.stdout)
    assert summary["method"] == "paper_capture"
    assert "before the registered pose" in done.stderr
    rows = read_rows(out / "poses.csv")
    assert len(rows) == len(path)
    assert [row["error"] == "" for row in rows[:4]] == [True] * 4
    assert all(row["error"] != "" for row in rows[5:])
    for row, q in zip(rows[5:], path[5:], strict=True):
        found = np.array([float(row[name]) for name in person.position_names])
        head, left_hand, right_hand, *feet = np.linalg.norm(
            skeleton.features(found) - skeleton.features(q), axis=1
        )
        # The position of a hand is that of its skin in pictures of 320 x 240.
        assert max(head, left_hand, right_hand) < 0.06
        assert max(feet) < 0.08
        elbow = skeleton.limb_points(found, "left_arm")[1] - skeleton.limb_points(q, "left_arm")[1]
        assert np.linalg.norm(elbow) < 0.08
    assert (out / "joint_centres.trc").is_file()
    assert "as published" in (out / "report.html").read_text()


@pytest.mark.slow
def test_a_recording_without_the_registered_pose_is_refused(tmp_path, person):
    write_studio(tmp_path, person, [standing(person)] * 3, "videos", cameras=3)
    with pytest.raises(SettingsError, match=r"registered pose.*best similarity"):
        capture_live(load_live_scene(tmp_path), tmp_path / "out", person.path, method="paper")
    assert not (tmp_path / "out").exists()


def test_inputs_unfit_for_the_paper_method_are_refused(tmp_path, person):
    write_studio(tmp_path, person, [standing(person)], "masks")
    scene, out = load_live_scene(tmp_path), tmp_path / "out"
    with pytest.raises(SceneError, match="'camera_0' delivers masks"):
        capture_live(scene, out, method="paper")
    words = ["capture", str(tmp_path), "--out", str(tmp_path / "out"), "--method", "paper"]
    for more in (["--no-track"], ["--face-camera", "camera_0"]):
        assert run_command([*words, *more]).exit_code == 2
    (tmp_path / "sources.yaml").unlink()
    done = run_command(words)
    assert done.exit_code == 1
    assert "sources.yaml" in done.stderr
