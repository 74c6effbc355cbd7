"""Many scenes are audited: what contradicts is told by scene; finished ones are left alone."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from drake_pose.camera.camera_files import save_cameras
from tests.cli import run_command
from tests.jobs.registration.arm_scenes import ArmScene, write_arm_scene


@pytest.fixture
def jobs(tmp_path: Path) -> Path:
    """A scene that is right, one with a frame whose elbow reads otherwise, one without joints."""
    base = tmp_path
    (base / "first").mkdir()
    right = write_arm_scene(base / "first")
    save_cameras(base / "cameras.yaml", right.cameras)
    (base / "second").mkdir()
    wrong: ArmScene = right.copy(base / "second")
    rows = wrong.rows()
    column = rows[0].index("elbow_turn")
    rows[3][column] = str(float(rows[3][column]) + np.radians(10.0))
    wrong.write_rows(rows)
    content = {
        "defaults": {"model": "first/arm.urdf", "camera_file": "cameras.yaml", "overlay": False},
        "scenes": {
            "right": {"scene": "first/scene", "audit": "first/joints.csv"},
            "wrong": {"scene": "second/scene", "audit": "second/joints.csv"},
            "lost": {"scene": "second/scene", "audit": "nowhere.csv"},
        },
    }
    (base / "jobs.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    return base / "jobs.yaml"


@pytest.mark.slow
def test_what_contradicts_is_named_by_scene_and_the_rest_is_resumed(jobs: Path) -> None:
    out = jobs.parent / "out"
    audited = run_command(["batch", str(jobs), "--out", str(out)])
    # The scene that failed did not stop the others.
    assert audited.exit_code == 1
    assert "scene 'lost'" in audited.stderr
    assert "nowhere.csv" in audited.stderr
    assert "frame 0002" in audited.stdout
    scenes = json.loads((out / "batch.json").read_text())["scenes"]
    assert [scenes[name]["state"] for name in scenes] == ["finished", "finished", "failed"]
    assert scenes["right"]["contradictions"] == []
    assert scenes["right"]["agreeing_count"] == scenes["right"]["frame_count"] == 5
    with (out / "contradictions.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    (told,) = json.loads((out / "wrong" / "summary.json").read_text())["contradictions"]
    (named,) = scenes["wrong"]["contradictions"]
    assert row == {"scene": "wrong", "what": "frame", "name": "0002", "text": told["text"]}
    assert named == {name: row[name] for name in ("what", "name", "text")}

    before = {name: (out / name / "summary.json").stat().st_mtime_ns for name in ("right", "wrong")}
    content = yaml.safe_load(jobs.read_text())
    content["scenes"]["found"] = content["scenes"].pop("lost") | {"audit": "first/joints.csv"}
    (jobs.parent / "more.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    given = ["batch", str(jobs.parent / "more.yaml"), "--out", str(out), "--resume", "--json"]
    result = run_command(given)
    assert result.exit_code == 0, result.output
    scenes = json.loads(result.stdout)["scenes"]
    assert scenes["found"]["state"] == "finished"
    for name, time in before.items():
        assert (out / name / "summary.json").stat().st_mtime_ns == time
    assert scenes["wrong"]["contradictions"] == [named]
    # Masks that are others by now are not those that were audited.
    masks = jobs.parent / "first" / "scene" / "masks" / "left"
    (masks / "0000.png").write_bytes((masks / "0001.png").read_bytes())
    result = run_command(given)
    assert result.exit_code == 1
    assert "masks of frame 0000 were replaced" in " ".join(result.stderr.split())
