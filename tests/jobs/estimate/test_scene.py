"""Estimates of scenes: result folders, unknown roots and cameras, packages."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_pose.body import load_model
from drake_pose.errors import SettingsError
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.search import PaperSearchSettings
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.cli import assert_refused, run_command, run_json, run_to_end
from tests.jobs.scenes import (
    LINK,
    NAMES,
    URDF,
    TinyScene,
    camera,
    read_rows,
    run_estimate,
    write_joints,
    write_scene,
    write_truth,
)


def positions(out: Path) -> dict[str, np.ndarray]:
    """Return the positions by frame [rad]."""
    rows = read_rows(out / "poses.csv")
    return {row["frame"]: np.array([float(row[name]) for name in NAMES]) for row in rows}


def test_result_folder(tiny_scene, out):
    run_estimate(tiny_scene, out)
    assert {"joints.csv", "modes.csv", "overlay", "poses.csv", "report.html", "summary.json"} <= {
        path.name for path in out.iterdir()
    }
    rows = read_rows(out / "poses.csv")
    assert list(rows[0]) == ["frame", *NAMES, "error", "seconds"]
    assert [row["frame"] for row in rows] == list(tiny_scene.truth)
    for row in rows:
        assert 0.0 <= float(row["error"]) < 0.005
        assert float(row["seconds"]) > 0.0
    for frame, q in positions(out).items():
        np.testing.assert_allclose(q, tiny_scene.truth[frame], atol=np.radians(0.5))
    page = (out / "replay.html").read_text()
    assert page.lstrip().startswith("<!DOCTYPE html>")
    assert 'src="http' not in page


def test_summary(tiny_scene, out):
    options = ["--method", "paper", "--frame", "0:1", "--json", "--no-replay", "--hold", "lift=20"]
    result, summary = run_estimate(tiny_scene, out, *options)
    assert summary == json.loads(result.stdout)
    assert not (out / "replay.html").exists()
    assert summary["complete"] is True
    assert (summary["frame_count"], summary["found_count"]) == (2, 2)
    assert summary["settings"]["hold"] == {"lift": 20.0}
    assert set(summary["versions"]) >= {"drake_pose", "drake", "numpy"}
    errors = [float(row["error"]) for row in read_rows(out / "poses.csv")]
    assert summary["mean_E_total"] == pytest.approx(np.mean(errors), rel=1e-6)
    frame = summary["frames"]["0001"]
    assert frame["found"] is True
    assert frame["runs"] >= 3
    assert frame["E_total"] == pytest.approx(errors[1], rel=1e-6)
    lift, luff = np.degrees(list(positions(out).values())).T
    np.testing.assert_allclose(lift, 20.0, atol=1e-5)
    # The published search has samples 10 degrees apart.
    np.testing.assert_allclose(luff, 10.0 * np.round(luff / 10.0), atol=1e-5)


def test_error_agrees_with_drakes_renderer_and_nothing_is_written_without_a_folder(tiny_scene):
    heard = []
    settings = EstimateSettings(method="paper", hold={"luff": -90.0}, frames=("1", "2"))
    result = estimate_scene(
        tiny_scene.folder, tiny_scene.model, None, settings,
        on_frame=lambda *what: heard.append(what[:3]),
    )  # fmt: skip
    scene = load_scene(tiny_scene.folder)
    renderer = LabelRenderer(load_model(tiny_scene.model), scene.cameras["front"])
    for frame, row in result.records.items():
        mask = scene.read("front", frame)
        wrong = np.count_nonzero(mask != renderer.mask(row.q))
        assert row.E_total == pytest.approx(wrong / mask.sum(), abs=0.003)
    assert (result.folder, result.found_count) == (None, 2)
    assert heard == [(0, 2, ""), (1, 2, "0001"), (2, 2, "0002")]


def test_several_cameras_are_used_together(tmp_path):
    scene = write_scene(tmp_path / "scene", [(20.0, -40.0)], ["front", "side"])
    for names in (["front", "side"], ["side"]):
        out, options = tmp_path / str(len(names)), [f"--camera={name}" for name in names]
        _, summary = run_estimate(scene, out, "--method", "paper", *options, "--no-replay")
        assert len(summary["frames"]["0000"]["outside_limit"]) == len(names)
        assert sorted(path.name for path in (out / "overlay").iterdir()) == names


def test_estimates_are_compared_with_measured_positions_of_the_scene(own_scene):
    held = ["--hold", "lift=27", "--frame", "0", "--no-replay"]
    table, out = own_scene.folder / "joint_angles.csv", own_scene.folder.parent
    write_truth(own_scene)
    result, summary = run_estimate(own_scene, out / "a", *held)
    assert "Joint errors" in result.stdout
    assert summary["frames"]["0000"]["joint_errors"]["lift"] == pytest.approx(7.0)
    assert summary["joint_errors"]["lift"]["largest"] == pytest.approx(7.0)
    # A table of another model is ignored.
    for text, warnings in (
        ("frame,A1\n0,0.5\n", []),
        ("frame,lift\n1,0.5\n", ["has no row of an estimated frame"]),
    ):
        table.write_text(text)
        _, summary = run_estimate(own_scene, out / str(len(warnings)), *held)
        assert summary["joint_errors"] == {}
        assert len(summary["warnings"]) == len(warnings)
        assert all(part in summary["warnings"][0] for part in warnings)


def test_another_root_with_a_position_for_each_frame(own_scene):
    plant, rows = MultibodyPlant(0.0), {}
    Parser(plant).AddModels(str(own_scene.model))
    plant.Finalize()
    context, jib = plant.CreateDefaultContext(), plant.GetBodyByName("jib")
    for frame, q in own_scene.truth.items():
        plant.SetPositions(context, q)
        rows[frame] = ["hook", *plant.EvalBodyPoseInWorld(context, jib).translation()]
    centres = write_joints(own_scene.folder / "centres.csv", ["joint", "x", "y", "z"], rows)
    out = own_scene.folder.parent / "out"
    root = ["--root", "jib", "--root-position", f"{centres}:hook", "--root-rotation", "x=-180:180"]
    run_estimate(own_scene, out, "--method", "paper", *root)
    for frame, q in positions(out).items():
        np.testing.assert_allclose(q, own_scene.truth[frame], atol=1e-8)
    for row in read_rows(out / "poses.csv"):
        assert [float(row[f"base_{axis}"]) for axis in "xyz"] == pytest.approx([0, 0, 0], abs=1e-8)
        assert abs(float(row["base_qw"])) == pytest.approx(1.0)


def test_a_frame_without_a_pose(own_scene, out, monkeypatch):
    strict = partial(PaperSearchSettings, outside_limit=0.0)
    monkeypatch.setattr("drake_pose.jobs.estimate.inputs.PaperSearchSettings", strict)
    options = ["--method", "paper", "--no-replay", "--hold", "lift=-90"]
    lost, summary = run_estimate(own_scene, out, *options, status=1)
    (warning,) = summary["warnings"]
    assert "frame 0000-0002 (3 of 3): no pose was found" in warning
    assert lost.stderr.count(warning) == 1
    assert "no pose was found in any frame" in lost.stderr
    rows = read_rows(out / "poses.csv")
    assert [row["frame"] for row in rows] == list(summary["frames"])
    assert {row[name] for row in rows for name in (*NAMES, "error")} == {""}
    assert summary["found_count"] == 0
    assert summary["frames"]["0000"]["found"] is False
    assert (out / "overlay" / "front" / "0000.png").is_file()


def test_intervals_and_modes_are_written_and_kept_on_resume(tmp_path, out):
    """One camera, angles between the samples: some mode's intervals contain the truth."""
    scene = write_scene(tmp_path / "between", [(13.0, -47.0), (-31.0, -22.0)])
    run_estimate(scene, out, "--frame", "1", "--no-replay")
    before = (out / "poses.csv").read_text().splitlines()[1]
    _, summary = run_estimate(scene, out, "--resume", "--no-replay")
    assert list(summary["frames"]) == ["0000", "0001"]
    assert all(frame["runs"] for frame in summary["frames"].values())
    assert (out / "poses.csv").read_text().splitlines()[2] == before
    joints, modes = (
        {
            (row["frame"], row["joint"]): row
            for row in read_rows(out / file)
            if row.get("mode", "1") == "1"
        }
        for file in ("joints.csv", "modes.csv")
    )
    found = positions(out)
    assert list(joints) == [(frame, name) for frame in scene.truth for name in NAMES]
    for (frame, name), row in joints.items():
        k = NAMES.index(name)
        truth, value = np.degrees(scene.truth[frame][k]), np.degrees(found[frame][k])
        assert abs(value - truth) < 2.0
        # A pixel, the assumed error of the camera, is half the width of a link here.
        assert row["determined"] == "yes" or name == "luff"
        assert float(row["low"]) <= truth <= float(row["high"]) < float(row["low"]) + 30.0
        assert float(modes[frame, name]["value"]) == pytest.approx(value, abs=1e-3)


def test_constraints_that_are_not_enforced_are_warned_of(tiny_scene, tmp_path, out):
    text = URDF.replace('<joint name="bolt" type="fixed">', '<joint name="bolt" type="prismatic">')
    end = text.index("</joint>", text.index('<joint name="luff"'))
    model = tmp_path / "loose.urdf"
    model.write_text(f'{text[:end]}<mimic joint="gone"/>{text[end:]}')
    scene, options = replace(tiny_scene, model=model), ("--frame", "0", "--no-replay")
    result, summary = run_estimate(scene, out, "--method", "paper", *options)
    warnings = run_json("check", model)["warnings"]
    assert summary["warnings"] == warnings
    for named, warning in zip(("<mimic>", "place the object in the world"), warnings, strict=True):
        assert named in warning
        assert warning in result.stderr


@pytest.fixture
def bare_scene(own_scene):
    """A scene of masks without cameras.yaml."""
    (own_scene.folder / "cameras.yaml").unlink()
    for path in (own_scene.folder / "masks" / "front").iterdir():
        path.rename(own_scene.folder / "masks" / path.name)
    shutil.rmtree(own_scene.folder / "masks" / "front")
    return own_scene


def run(scene: TinyScene, out: Path, *more: str) -> dict:
    """Return the record of the first frame, whose positions are checked."""
    _, summary = run_estimate(scene, out, "--method", "beam", "--frame", "0", "--no-replay", *more)
    q = positions(out)["0000"]
    np.testing.assert_allclose(q, scene.truth["0000"], atol=np.radians(6.0))
    return summary["frames"]["0000"]


def test_masks_without_cameras_give_pose_and_scale(bare_scene, out):
    """A parallel camera approximates the pinhole camera that drew the masks."""
    record = run(bare_scene, out)
    assert record["E_total"] < 0.08
    true_camera = camera("front")
    # The crane stands in the world's origin.
    depth = np.linalg.norm(true_camera.X_WC[:2, 3])
    assert record["camera_scale"] == pytest.approx(true_camera.focal_x / depth, rel=0.06)
    assert (out / "overlay" / "camera" / "0000.png").is_file()
    # Without intervals each joint has the range of its limits.
    limits = load_model(bare_scene.model, check=False)
    for k, joint in enumerate(record["joints"].values()):
        ends = np.degrees([limits.lower[k], limits.upper[k]])
        assert not joint["determined"]
        assert [joint["low"], joint["high"]] == pytest.approx(ends)


def test_an_unknown_root_position_is_estimated(tiny_scene, out):
    record = run(tiny_scene, out, "--root-position", "unknown")
    assert record["E_total"] < 0.03
    assert record["camera_scale"] is None


def test_options_that_need_a_known_root_are_refused(tiny_scene, bare_scene):
    settings = EstimateSettings(method="paper")
    for scene, more in ((bare_scene, None), (tiny_scene, "unknown")):
        with pytest.raises(SettingsError, match="method beam"):
            estimate_scene(scene.folder, scene.model, None, replace(settings, root_position=more))


BOOM = LINK.format(name="boom", z=0.25, size="0.1 0.12 0.5")


def test_a_missing_package_is_named_and_must_stay_the_same_on_resume(out, tiny_scene, tmp_path):
    """The boom of the model is a mesh of a package elsewhere."""
    folder = tmp_path / "far away" / "crane parts"
    folder.mkdir(parents=True)
    trimesh.creation.box((0.1, 0.12, 0.5)).export(folder / "boom.stl")
    model = tmp_path / "robots" / "crane.urdf"
    model.parent.mkdir()
    mesh = BOOM.replace('<box size="0.1 0.12 0.5"/>', '<mesh filename="package://parts/boom.stl"/>')
    model.write_text(tiny_scene.model.read_text().replace(BOOM, mesh))
    words = [*replace(tiny_scene, model=model).estimate(out), "--no-replay", "--no-overlay"]
    for command in (words, ["check", str(model)]):
        missing = ("link 'boom': mesh 'package://parts/boom.stl'", "--package parts=FOLDER")
        assert_refused(run_command(command), *missing)
    run_to_end("check", model, "--package", f"parts={folder}")
    run_to_end(*words, "--package", f"parts={folder}", "--frame", "0")
    moved = shutil.copytree(folder, folder.with_name("moved"))
    again = [*words, "--resume", "--frame", "0:1", "--package"]
    assert_refused(run_command([*again, f"parts={moved}"]), "packages")
    run_to_end(*again, f"parts={folder}")
    summary = json.loads((out / "summary.json").read_text())
    assert summary["settings"]["packages"] == {"parts": str(folder)}
    assert summary["found_count"] == 2
