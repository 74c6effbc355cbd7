"""Episodes of two cameras of which no pose explains one."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drake_pose.camera.camera_files import load_cameras, save_cameras
from tests.benchmarks.registration import pose_error
from tests.cli import run_to_end
from tests.jobs.scenes import read_rows
from tests.registration.episodes import PaintedEpisode, painted_episode
from tests.registration.recordings import write_episode


@pytest.fixture(scope="module")
def half_wrong(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, PaintedEpisode]:
    """An episode of cameras 'back' and 'camera', whose pictures of 'back' are in reversed order."""
    folder = tmp_path_factory.mktemp("half_wrong")
    painted = painted_episode(folder)
    write_episode(folder / "scene", painted)
    reversed_pictures = replace(painted, pictures=painted.pictures[::-1])
    write_episode(folder / "other", reversed_pictures)
    (folder / "other/images/camera").rename(folder / "scene/images/back")
    cameras = [replace(painted.camera, name=name) for name in ("back", "camera")]
    save_cameras(folder / "scene/cameras.yaml", cameras)
    return folder / "scene", painted


@pytest.mark.slow
def test_an_accepted_camera_is_written_without_a_refused_one(half_wrong, tmp_path):
    scene, painted = half_wrong
    out = tmp_path / "out"
    words = ["register", scene, "--model", painted.path, "--out", out, "--export", "ros"]
    said = run_to_end(*words, status=1).stderr
    assert "warning: left out: camera 'back': no pose explains its pictures" in said
    assert "error: 1 of 2 cameras refused: back" in said
    (written,) = load_cameras(out / "cameras.yaml").values()
    assert written.name == "camera"
    error = pose_error(written.X_WC, painted.camera.X_WC)
    assert np.linalg.norm(error[3:]) < 0.012
    summary = json.loads((out / "summary.json").read_text())
    assert "no pose explains its pictures" in summary["refused"]["back"]
    assert [*summary["cameras"]] == ["camera"]
    # The entry of a single camera at the top level would look like the whole result.
    assert "X_WC" not in summary
    assert "1 refused, see the warnings: back." in (out / "report.html").read_text()
    files = [one.relative_to(out).as_posix() for one in out.rglob("*")]
    assert not [one for one in files if "back" in one]


@pytest.mark.slow
def test_audits_and_their_batch_name_a_refused_camera(half_wrong, tmp_path):
    scene, painted = half_wrong
    words = ["audit", scene, "--model", painted.path, "--out", tmp_path / "audit", "--no-overlay"]
    said = run_to_end(*words, status=1).stderr
    assert "error: 1 of 2 cameras refused: back" in said
    summary = json.loads((tmp_path / "audit/summary.json").read_text())
    (finding,) = [one for one in summary["findings"] if one["what"] == "refused"]
    assert finding["name"] == "back"
    assert finding["text"].startswith("camera 'back': no pose explains its pictures")
    assert [*summary["found_cameras"]] == ["camera"]
    jobs = tmp_path / "jobs.yaml"
    entry = {"scene": str(scene), "model": str(painted.path), "audit": True, "overlay": False}
    jobs.write_text(json.dumps({"scenes": {"both": entry}}))
    run_to_end("batch", jobs, "--out", tmp_path / "all", "--workers", "0")
    named = [(row["scene"], row["what"], row["name"])
             for row in read_rows(tmp_path / "all/findings.csv")]  # fmt: skip
    assert ("both", "refused", "back") in named
    rows = read_rows(tmp_path / "all/episodes.csv")
    assert [(row["scene"], row["camera"]) for row in rows] == [("both", "camera")]


@pytest.mark.slow
def test_an_episode_without_an_accepted_camera_is_refused(half_wrong, tmp_path):
    scene, painted = half_wrong
    out = tmp_path / "out"
    words = ["register", scene, "--model", painted.path, "--out", out, "--camera", "back"]
    assert "error: camera 'back': no pose" in run_to_end(*words, status=1).stderr
    assert not out.exists()
