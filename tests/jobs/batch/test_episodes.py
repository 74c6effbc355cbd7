"""Episodes in batches: one row for each and camera, and who has moved."""

import csv
import io
import json

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from drake_pose.errors import SettingsError
from drake_pose.jobs.batch.episodes_table import COLUMNS, episodes_table
from drake_pose.jobs.batch.job import read_job
from drake_pose.jobs.batch.tasks import plan_scene
from drake_pose.jobs.registration.settings import AuditSettings
from tests.cli import run_command
from tests.registration.episodes import painted_episode
from tests.registration.recordings import write_episode


def totals(place, turn_deg=0.0, sd=0.001):
    X_WC = np.eye(4)
    X_WC[:3, :3] = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    X_WC[:3, 3] = place
    camera = {
        "X_WC": X_WC.tolist(), "covariance": (sd**2 * np.eye(6)).tolist(), "off_mm": None,
        "off_deg": None, "translation_sd_mm": 1e3 * sd, "rotation_sd_deg": 0.1,
        "time_offset_s": 0.02, "time_offset_sd_s": 0.001,
    }  # fmt: skip
    named = [{"what": "joint", "name": "A4", "text": ""}]
    return {
        "frame_count": 9, "agreeing_count": 8, "contradictions": named, "cameras": {"left": camera}
    }  # fmt: skip


def test_a_camera_has_moved_that_differs_significantly_from_the_episode_before():
    episodes = {
        "first": totals([1.0, 0.0, 0.5]),
        # Within what two errors of a millimetre an axis make.
        "same": totals([1.001, -0.001, 0.5]),
        "bumped": totals([1.0, 0.02, 0.5], 1.0),
        "failed": {},
        "again": totals([1.0, 0.02, 0.5], 1.0),
    }
    rows = list(csv.DictReader(io.StringIO(episodes_table(episodes))))
    assert tuple(rows[0]) == COLUMNS
    assert [row["moved"] for row in rows] == ["", "no", "yes", "no"]
    assert float(rows[2]["moved_deg"]) == pytest.approx(1.0)
    assert float(rows[2]["moved_mm"]) == pytest.approx(np.hypot(21.0, 1.0))
    assert (rows[0]["joints"], rows[0]["agreeing"]) == ("A4", "8")
    assert episodes_table({"scene": {"frame_count": 3, "agreeing_count": 3}}) is None


def test_an_episode_of_a_job_has_the_settings_of_audits(tmp_path):
    painted = painted_episode(tmp_path, frames=6)
    write_episode(tmp_path / "scene", painted)
    entry = {"scene": "scene", "model": "boxes.urdf", "audit": True, "every": 2, "units": "rad"}
    (tmp_path / "jobs.yaml").write_text(yaml.safe_dump({"scenes": {"one": entry}}))
    (job,) = read_job(tmp_path / "jobs.yaml")
    assert isinstance(job.settings, AuditSettings)
    assert (job.settings.every, job.settings.units, job.audit) == (2, "rad", True)
    (task,) = plan_scene(job, tmp_path / "out")
    assert len(task.frames) == 3
    del entry["audit"]
    (tmp_path / "jobs.yaml").write_text(yaml.safe_dump({"scenes": {"one": entry}}))
    with pytest.raises(SettingsError, match="units: for audits"):
        read_job(tmp_path / "jobs.yaml")


@pytest.mark.slow
def test_episodes_are_audited_in_a_batch(tmp_path):
    painted = painted_episode(tmp_path, late=0.04)
    write_episode(tmp_path / "scene", painted)
    entry = {"scene": "scene", "model": "boxes.urdf", "audit": True, "overlay": False}
    (tmp_path / "jobs.yaml").write_text(yaml.safe_dump({"scenes": {"one": entry}}))
    out = tmp_path / "out"
    arguments = ["batch", str(tmp_path / "jobs.yaml"), "--out", str(out)]
    for _ in range(2):
        result = run_command(arguments)
        assert result.exit_code == 0, result.output
        (row,) = csv.DictReader((out / "episodes.csv").open(newline=""))
        assert float(row["time_offset_s"]) == pytest.approx(0.04, abs=0.005)
        assert row["off_mm"] == ""
        place = [float(row[name]) for name in "xyz"]
        np.testing.assert_allclose(place, painted.camera.X_WC[:3, 3], atol=0.01)
        arguments += ["--resume"] if len(arguments) == 4 else []
    assert json.loads((out / "batch.json").read_text())["scenes"]["one"]["state"] == "finished"
