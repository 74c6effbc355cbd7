import json

import numpy as np
import pytest

from drake_pose.body import bundled_model, load_model
from drake_pose.jobs.demo import run_demo, stored_scene
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.cli import run_command
from tests.jobs.scenes import read_rows


def test_demo(tmp_path):
    out = tmp_path / "demo"
    result = run_command(["demo", "--out", str(out)])
    assert result.exit_code == 0, result.output
    scene = load_scene(stored_scene("human"))
    (camera,) = scene.cameras.values()
    (frame,) = scene.frames
    overlay = out / "overlay" / camera.name / f"{frame}.png"
    for part in ("left_upper_arm_x", "Pose found", "start here", str(overlay)):
        assert part in result.stdout
    assert overlay.is_file()
    (row,) = read_rows(out / "poses.csv")
    model = load_model(bundled_model("man"))
    q = np.array([float(row[name]) for name in model.position_names])
    mask = scene.read(camera.name, frame)
    difference = (LabelRenderer(model, camera).mask(q) ^ mask).sum() / mask.sum()
    assert float(row["error"]) == pytest.approx(difference, abs=0.003)
    # The paper reports a mean of 22.3 %, with a model of the person.
    assert difference < 0.2
    ankle = np.array([float(read_rows(scene.path / "root_position.csv")[0][a]) for a in "xyz"])
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, q)
    foot = model.plant.EvalBodyPoseInWorld(context, model.plant.GetBodyByName("right_foot"))
    np.testing.assert_allclose(foot.translation(), ankle, atol=1e-6)

    (out / "mine.txt").write_text("mine")
    refused = run_command(["demo", "--out", str(out)])
    assert refused.exit_code == 1
    assert "not empty" in refused.stderr


@pytest.mark.parametrize("scene", [None, "elsewhere"])
def test_only_an_earlier_demonstration_is_replaced(tmp_path, monkeypatch, scene):
    (tmp_path / "overlay" / "front").mkdir(parents=True)
    (tmp_path / "overlay" / "front" / "0010.png").touch()
    known = {"scene": scene or str(stored_scene("human"))}
    (tmp_path / "summary.json").write_text(json.dumps(known))
    left = []
    monkeypatch.setattr(
        "drake_pose.jobs.demo.estimate_scene", lambda *given, **_: left.extend(given[2].iterdir())
    )
    run_demo(tmp_path)
    assert len(left) == (0 if scene is None else 2)
