"""`drake-pose audit`: errors and outlier frames, from masks, cameras and joint positions."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import Camera
from drake_pose.errors import CameraError, DrakePoseError, MaskError, SettingsError
from drake_pose.jobs.registration.audit import SceneAudit, audit_scene
from drake_pose.jobs.registration.result import corrected
from drake_pose.registration.findings import Finding
from tests.cli import Result, run_to_end
from tests.files.test_page import require_plain_page
from tests.jobs.registration.arm_scenes import JOINTS, ArmScene, write_arm_scene
from tests.registration.arm_pictures import shifted
from tests.written_files import write_mask


def run(scene: ArmScene, *more: object) -> Result:
    words = scene.folder, "--model", scene.model, "--joints", scene.joints
    return run_to_end("audit", *words, *more)


@pytest.fixture(scope="module")
def audited(tmp_path_factory: pytest.TempPathFactory) -> ArmScene:
    """Eight frames of two cameras; frame 2 has the positions of frame 6."""
    scene = write_arm_scene(tmp_path_factory.mktemp("audited"), count=8)
    save_cameras(scene.folder / "cameras.yaml", scene.cameras)
    rows = scene.rows()
    rows[1 + 2] = [rows[1 + 2][0], *rows[1 + 6][1:]]
    scene.write_rows(rows)
    return scene


@pytest.fixture(scope="module")
def found(audited, tmp_path_factory) -> tuple[Path, dict[str, Any]]:
    """The result folder, and the command's JSON."""
    out = tmp_path_factory.mktemp("audit") / "out"
    return out, json.loads(run(audited, "--out", out, "--json").stdout)


def audit_with(scene: ArmScene, cameras: dict[str, Camera], folder: Path) -> SceneAudit:
    """Audit a scene with other cameras."""
    save_cameras(folder / "cameras.yaml", cameras)
    return audit_scene(scene.folder, scene.model, scene.joints, cameras=folder / "cameras.yaml")


class TestAudit:
    def test_frame_with_wrong_positions_is_an_outlier(self, found) -> None:
        out, summary = found
        assert [one["name"] for one in summary["findings"]] == ["0002"]
        assert summary["findings"][0]["what"] == "frame"
        assert "'0002'" in summary["findings"][0]["text"]
        assert (summary["frame_count"], summary["agreeing_count"]) == (8, 7)
        assert summary["frames"]["0003"]["agrees"]
        assert summary["principal_point_px"] is None
        assert summary == json.loads((out / "summary.json").read_text())
        assert {path.name for path in out.rglob("*.png")} == {"0002.png"}

    def test_a_scene_s_own_table_is_used(self, audited, found, tmp_path) -> None:
        own, (_, summary) = audited.copy(tmp_path), found
        table = own.joints.rename(own.folder / "joint_angles.csv")
        again = audit_scene(own.folder, own.model)
        assert again.summary["findings"] == summary["findings"]
        lines = table.read_text().splitlines()
        without_a_joint = [line.rpartition(",")[0] for line in lines]
        of_another = [lines[0].replace(JOINTS[0], "elsewhere"), *lines[1:]]
        for other, wrong in ((of_another, "elsewhere"), (without_a_joint, JOINTS[-1])):
            table.write_text("\n".join(other))
            with pytest.raises(DrakePoseError, match=rf"{table.name}.*{wrong}"):
                audit_scene(own.folder, own.model)
        table.unlink()
        with pytest.raises(SettingsError, match="positions of all joints"):
            audit_scene(own.folder, own.model)

    def test_page_shows_intervals_and_minimum_detectable_offsets(self, audited, tmp_path):
        """The elbow's encoder reads two degrees too high; the correction is -2 degrees."""
        own, out = audited.copy(tmp_path / "scene"), tmp_path / "out"
        own.add_to("elbow_turn", np.radians(2.0))
        summary = audit_scene(own.folder, own.model, own.joints, out).summary
        text = (out / "report.html").read_text()
        answer = require_plain_page(text, summary["warnings"]).by_id["answer"]
        assert answer.startswith("Error found: joint 'elbow_turn' reads ")
        assert "1 of 8 frames is an outlier: 0002." in answer
        rows = re.findall(r"<tr>(.*?)</tr>", text, re.S)
        (elbow,) = (row for row in rows if row.startswith("<td>elbow_turn</td>"))
        low, high = map(float, re.search(r" deg \(([-+.\d]+) to ([-+.\d]+)\)", elbow).groups())
        assert low < -2.0 < high
        assert high - low < 1.0
        for name, least in summary["minimum_detectable"].items():
            (row,) = (row for row in rows if row.startswith(f"<td>{name}</td>"))
            assert ("none" if least is None else f"{least:.2g}") in row
        places = out.glob("overlay_as_given/left/*.png")
        assert {path.stem for path in places} >= {"0003", "0004"}

    def test_wrong_camera_pose_is_found(self, audited, tmp_path: Path) -> None:
        """The given pose of one camera is off by 2 cm."""
        left = audited.cameras["left"]
        moved = {**audited.cameras, "left": shifted(left, *(0.02 * left.X_WC[:3, 0]))}
        result = audit_with(audited, moved, tmp_path)
        named = [(one["what"], one["name"]) for one in result.summary["findings"]]
        assert named == [("camera", "left"), ("frame", "0002")]
        assert result.summary["findings"][0]["shift_mm"] == pytest.approx(20.0, abs=5.0)
        assert result.folder is None

    def test_half_pixel_error_of_principal_points_is_reported(self, audited, tmp_path):
        moved = {
            name: replace(one, center_x=one.center_x + 0.5, center_y=one.center_y + 0.5)
            for name, one in audited.cameras.items()
        }
        result = audit_with(audited, moved, tmp_path)
        told, warnings = result.summary["principal_point_px"], "\n".join(result.warnings)
        assert [one["name"] for one in result.summary["findings"]] == ["0002"]
        np.testing.assert_allclose(told["offset"], -0.5, atol=0.15)
        assert "half a pixel" in warnings
        assert "CameraInfo's numbers" in warnings

    def test_unknown_cameras_are_refused(self, audited, tmp_path: Path) -> None:
        own = audited.copy(tmp_path)
        own.edit_cameras("left", X_WC=None)
        with pytest.raises(CameraError, match=r"'left'.*drake-pose register"):
            audit_scene(own.folder, own.model, own.joints)

    def test_unexplained_and_empty_masks(self, audited, tmp_path: Path) -> None:
        own, nothing = audited.copy(tmp_path), np.zeros((240, 320), bool)
        corner = nothing.copy()
        corner[:12, :12] = True
        for name in own.cameras:
            write_mask(own.folder / "masks" / name / "0001.png", corner)
            write_mask(own.folder / "masks" / name / "0003.png", nothing)
        result = audit_scene(own.folder, own.model, own.joints)
        kinds = {one["name"]: one["cause"] for one in result.summary["findings"]}
        assert kinds["0001"] == "unexplained"
        assert [text for text in result.warnings if "0003" in text and "nothing" in text]
        assert result.summary["frame_count"] == 7
        for path in own.folder.rglob("*.png"):
            write_mask(path, nothing)
        with pytest.raises(MaskError, match="no mask shows the body"):
            audit_scene(own.folder, own.model, own.joints)


def test_corrected_values_are_the_true_ones() -> None:
    """Logged values with an error, and the finding that corrects them."""
    names, truth = ("a", "b", "slide"), np.array([0.3, -0.7, 0.05])
    nothing = Finding("joint", "", 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
    logged = (
        (np.add(truth, [0.0, 0.2, 0.0]), {"name": "b", "angle": -0.2, "angle_sd": 0.01}),
        (np.add(truth, [0.0, 0.0, 0.01]), {"name": "slide", "shift": -0.01, "shift_sd": 0.1}),
        (truth * [1, -1, 1], {"kind": "sign", "name": "b"}),
        (truth - 0.1, {"kind": "joints", "joints": dict.fromkeys(names, 0.1)}),
    )
    for values, error in logged:
        found = corrected(values, names, replace(nothing, **error))
        np.testing.assert_allclose(found, truth)
    for kind in ("camera", "base", "unexplained", "clock"):
        np.testing.assert_array_equal(corrected(truth, names, replace(nothing, kind=kind)), truth)
