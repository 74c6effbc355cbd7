"""Batches of audits: errors by scene, and finished audits are kept."""

import json

import numpy as np
import pytest
import yaml

from drake_pose.camera.camera_files import save_cameras
from tests.cli import run_json, run_to_end
from tests.jobs.registration.arm_scenes import write_arm_scene
from tests.jobs.scenes import read_rows


@pytest.mark.slow
def test_errors_are_listed_by_scene_and_finished_audits_are_kept(tmp_path, out):
    """A correct scene, one with a frame whose elbow reading is wrong, one without joints."""
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
    right = write_arm_scene(tmp_path / "first")
    save_cameras(tmp_path / "cameras.yaml", right.cameras)
    wrong = right.copy(tmp_path / "second")
    rows = wrong.add_to("elbow_turn", np.radians(10.0))
    wrong.write_rows([*right.rows()[:3], rows[3], *right.rows()[4:]])
    given = {"model": "first/arm.urdf", "camera_file": "cameras.yaml", "overlay": False}
    scenes = {
        "right": {"scene": "first/scene", "audit": "first/joints.csv"},
        "wrong": {"scene": "second/scene", "audit": "second/joints.csv"},
        "lost": {"scene": "second/scene", "audit": "nowhere.csv"},
    }
    path = tmp_path / "jobs.yaml"
    path.write_text(yaml.safe_dump({"defaults": given, "scenes": scenes}, sort_keys=False))
    # The failed scene does not stop the others.
    audited = run_to_end("batch", path, "--out", out, status=1)
    assert "scene 'lost'" in audited.stderr
    assert "nowhere.csv" in audited.stderr
    assert "frame 0002" in audited.stdout
    told = json.loads((out / "batch.json").read_text())["scenes"]
    assert [one["state"] for one in told.values()] == ["finished", "finished", "failed"]
    assert told["right"]["findings"] == []
    assert told["right"]["agreeing_count"] == told["right"]["frame_count"] == 5
    (row,) = read_rows(out / "findings.csv")
    (found,) = json.loads((out / "wrong" / "summary.json").read_text())["findings"]
    (named,) = told["wrong"]["findings"]
    assert row == {"scene": "wrong", "what": "frame", "name": "0002", "text": found["text"]}
    assert named == {name: row[name] for name in ("what", "name", "text")}

    written = [out / name / "summary.json" for name in ("right", "wrong")]
    before = [file.stat().st_mtime_ns for file in written]
    scenes["found"] = scenes.pop("lost") | {"audit": "first/joints.csv"}
    path.write_text(yaml.safe_dump({"defaults": given, "scenes": scenes}, sort_keys=False))
    words = ["batch", path, "--out", out, "--resume"]
    told = run_json(*words)["scenes"]
    assert told["found"]["state"] == "finished"
    assert [file.stat().st_mtime_ns for file in written] == before
    assert told["wrong"]["findings"] == [named]
    # A finished audit whose masks have changed is refused.
    masks = right.folder / "masks" / "left"
    (masks / "0000.png").write_bytes((masks / "0001.png").read_bytes())
    result = run_to_end(*words, status=1)
    assert "masks of frame 0000 were replaced" in " ".join(result.stderr.split())
