import json
from pathlib import Path

from drake_pose.jobs.demo import demo_scene, demo_settings
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.cli import run_to_end
from tests.jobs.scenes import read_rows


def test_demo(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    result = run_to_end("demo", "--out", out)
    scene = load_scene(demo_scene())
    (camera,) = scene.cameras.values()
    (frame,) = scene.frames
    overlay = out / "overlay" / camera.name / f"{frame}.png"
    for part in ("left_upper_arm_x", "E_total", "seconds", str(overlay)):
        assert part in result.stdout
    assert overlay.is_file()
    (row,) = read_rows(out / "poses.csv")
    # The paper reports 22.3 % in the mean, with a model of the person herself.
    assert float(row["error"]) < 0.2

    (out / "mine.txt").write_text("mine")
    other = tmp_path / "other"
    other.mkdir()
    (other / "summary.json").write_text(json.dumps({"scene": "elsewhere"}))
    for folder, kept in ((out, {"mine.txt", "poses.csv"}), (other, {"summary.json"})):
        assert "not empty" in run_to_end("demo", "--out", folder, status=1).stderr
        assert kept <= {path.name for path in folder.iterdir()}


def test_the_recipe_is_the_papers() -> None:
    settings = demo_settings(demo_scene())
    assert settings.root == "right_foot"
    assert settings.root_position == (demo_scene() / "root_position.csv", "right_ankle")
    assert "BSD 3-Clause License" in (demo_scene() / "NOTICE").read_text()
