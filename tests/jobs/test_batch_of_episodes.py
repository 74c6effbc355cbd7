"""Batches of audited episodes: a row for each camera, and moved cameras."""

import csv
import io
import json

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from drake_pose.camera.camera_files import describe_camera, load_cameras
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import SettingsError
from drake_pose.files.settings import AuditSettings
from drake_pose.jobs.batch import run_batch
from drake_pose.jobs.batch_tasks import Outcome, plan_scene, read_job
from drake_pose.jobs.episodes_table import COLUMNS, batch_page, episodes_table
from tests.cli import run_to_end
from tests.files.test_report_page import require_plain_page
from tests.jobs.scenes import read_rows
from tests.registration.episodes import painted_episode
from tests.registration.recordings import write_episode


def totals(place, turn_deg=0.0, sd=0.001):
    X_WC = np.eye(4)
    X_WC[:3, :3] = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    X_WC[:3, 3] = place
    entry = describe_camera(PinholeCamera("left", 640, 480, 500.0, 500.0, 320.0, 240.0, X_WC))
    camera = {
        "camera": entry, "X_WC": X_WC.tolist(), "focal_sd_px": None,
        "covariance": (sd**2 * np.eye(6)).tolist(), "off_mm": None,
        "off_deg": None, "translation_sd_mm": 1e3 * sd, "rotation_sd_deg": 0.1,
        "time_offset_s": 0.02, "time_offset_sd_s": 0.001,
    }  # fmt: skip
    named = [{"what": "joint", "name": "A4", "text": ""}]
    return {
        "frame_count": 9, "agreeing_count": 8, "findings": named, "cameras": {"left": camera}
    }  # fmt: skip


def rows_of(files):
    return list(csv.DictReader(io.StringIO(files["episodes.csv"])))


def test_a_significant_difference_to_earlier_episodes_is_a_move(tmp_path):
    episodes = {
        "first": totals([1.0, 0.0, 0.5]),
        # Within the error of two poses with 1 mm per axis.
        "same": totals([1.001, -0.001, 0.5]),
        "bumped": totals([1.0, 0.02, 0.5], 1.0),
        "failed": {},
        "again": totals([1.0, 0.02, 0.5], 1.0),
    }
    found, moves = episodes_table(episodes)
    rows = rows_of(found)
    assert tuple(rows[0]) == COLUMNS
    assert [row["moved"] for row in rows] == ["", "no", "yes", "no"]
    assert float(rows[2]["moved_deg"]) == pytest.approx(1.0)
    assert float(rows[2]["moved_mm"]) == pytest.approx(np.hypot(20.5, 0.5))
    assert (rows[0]["joints"], rows[0]["agreeing"]) == ("A4", "8")
    files = [row["camera_file"] for row in rows]
    assert files == ["cameras_1.yaml", "cameras_1.yaml", "cameras_2.yaml", "cameras_2.yaml"]
    (tmp_path / "before.yaml").write_text(found["cameras_1.yaml"])
    before = load_cameras(tmp_path / "before.yaml")["left"]
    np.testing.assert_allclose(before.X_WC[:3, 3], [1.0005, -0.0005, 0.5])
    assert [row["pose"] for row in rows] == ["1", "1", "2", "2"]
    assert moves[0].startswith("camera 'left' moved by 1.00 degrees and 20.5 mm before")
    assert moves[1:] == (
        "camera 'left', pose 1: first, same", "camera 'left', pose 2: bumped, again"
    )  # fmt: skip
    assert episodes_table({"scene": {"frame_count": 3, "agreeing_count": 3}}) == ({}, ())
    one = {"state": "finished", "errors": [], "frame_count": 8, "agreeing_count": 8, "findings": []}
    content = {"scenes": dict.fromkeys(episodes, one), "moves": moves}
    batch_page(tmp_path, content, episodes).write(tmp_path)
    page = require_plain_page((tmp_path / "report.html").read_text())
    assert page.by_id["answer"].startswith(f"5 of 5 scenes finished. C{moves[0][1:]}.")
    assert {"left: shift [mm]", "left: turn [deg]"} <= {*page.plots}


def test_a_camera_that_is_put_back_shares_its_earlier_pose():
    """Poses are shared by many episodes although each differs from the next by chance."""
    rng = np.random.default_rng(3)
    places = np.array([[1.0, 0.0, 0.5]] * 8 + [[1.0, 0.02, 0.5]] * 8 + [[1.0, 0.0, 0.5]] * 8)
    noisy = places + rng.normal(0.0, 0.001, places.shape)
    found, moves = episodes_table({f"e{k:02d}": totals(list(one)) for k, one in enumerate(noisy)})
    rows = rows_of(found)
    assert [row["pose"] for row in rows] == ["1"] * 8 + ["2"] * 8 + ["1"] * 8
    assert [row["scene"] for row in rows if row["moved"] == "yes"] == ["e08", "e16"]
    assert any("moved back to pose 1" in one and "e16" in one for one in moves)
    _, moves = episodes_table({k: totals([1.0, 0.0, 0.5]) for k in ("a", "b")})
    assert moves == ("camera 'left' has one pose in all 2 episodes",)


def test_episodes_start_at_the_cameras_of_the_first(tmp_path, out):
    """Also if the first fails; and in a resumed batch, whose first episode is done already."""
    painted = painted_episode(tmp_path, frames=6)
    for name in ("one", "two", "three"):
        write_episode(tmp_path / "set" / name, painted)
    entry = {"model": "boxes.urdf", "audit": True}
    scenes = {name: {"scene": f"set/{name}"} for name in ("one", "two", "three")}
    (tmp_path / "jobs.yaml").write_text(yaml.safe_dump({"defaults": entry, "scenes": scenes}))
    done = []

    def work(task):
        done.append((task.job.name, task.near))
        # The frames of two cameras, one of which does not show the body in one picture.
        return Outcome("lost" if task.job.name == "one" else None, 0.0, {"frame_count": 11})

    batch = run_batch(read_job(tmp_path / "jobs.yaml"), out, work=work)
    assert batch.failed == ("one",)
    assert batch.scenes["two"].frame_count == 11
    first = out / "one"
    assert sorted(done[1:]) == [("three", first), ("two", first)]
    assert done[0] == ("one", None)


def test_combined_pose_is_the_information_weighted_mean():
    # A slow drift of insignificant steps is a move as well.
    far = 5.0 * 0.001
    drifting = {str(k): totals([k * far, 0.0, 0.0], sd=0.002) for k in range(9)}
    moved = [row["moved"] for row in rows_of(episodes_table(drifting)[0])]
    assert 0 < moved.count("yes") < 5
    # The second camera has not moved and has one pose in all files.
    episodes = {str(k): totals([float(k), 0.0, 0.0]) for k in range(2)}
    sds = (0.001, 0.002)
    for one, x, sd in zip(episodes.values(), (0.0, 0.005), sds, strict=True):
        one["cameras"]["right"] = totals([x, 0.0, 0.0], sd=sd)["cameras"]["left"]
    found, _ = episodes_table(episodes)
    files = [yaml.safe_load(found[f"cameras_{k}.yaml"]) for k in (1, 2)]
    assert [file["left"]["X_WC"][0][3] for file in files] == [0.0, 1.0]
    weighted = np.average([0.0, 0.005], weights=np.power(sds, -2.0))
    assert [file["right"]["X_WC"][0][3] for file in files] == pytest.approx([weighted] * 2)


def test_episodes_of_a_job_have_the_settings_of_audits(tmp_path, out):
    painted = painted_episode(tmp_path, frames=6)
    write_episode(tmp_path / "scene", painted)
    entry = {"scene": "scene", "model": "boxes.urdf", "audit": True, "every": 2, "units": "rad"}

    def read(scenes):
        (tmp_path / "jobs.yaml").write_text(yaml.safe_dump({"scenes": scenes}))
        return read_job(tmp_path / "jobs.yaml")

    (job,) = read({"one": entry})
    assert isinstance(job.settings, AuditSettings)
    assert (job.settings.every, job.settings.units, job.audit) == (2, "rad", True)
    (task,) = plan_scene(job, out)
    assert len(task.frames) == 3
    jobs = read({"data": entry | {"episodes": "8:10"}})
    assert [job.name for job in jobs] == ["data_000008", "data_000009", "data_000010"]
    assert [job.settings.episode for job in jobs] == [8, 9, 10]
    for wrong in ("8", "9:8", 3):
        with pytest.raises(SettingsError, match="scene 'data': episodes"):
            read({"data": entry | {"episodes": wrong}})
    with pytest.raises(SettingsError, match="an estimate has no setting units"):
        read({"one": entry | {"audit": None}})


@pytest.mark.slow
def test_episodes_are_audited_in_a_batch(tmp_path, out):
    """The second episode starts at the camera of the first."""
    painted = painted_episode(tmp_path, late=0.04)
    entry = {"model": "boxes.urdf", "audit": True, "overlay": False}
    scenes = {name: {"scene": f"set/{name}"} for name in ("one", "two")}
    for name in scenes:
        write_episode(tmp_path / "set" / name, painted)
    (tmp_path / "jobs.yaml").write_text(yaml.safe_dump({"defaults": entry, "scenes": scenes}))
    words = ["batch", tmp_path / "jobs.yaml", "--out", out]
    for more in ([], ["--resume"]):
        run_to_end(*words, *more)
        rows = read_rows(out / "episodes.csv")
        assert [row["pose"] for row in rows] == ["1", "1"]
        for row in rows:
            assert float(row["time_offset_s"]) == pytest.approx(0.04, abs=0.005)
            assert row["off_mm"] == ""
            place = [float(row[name]) for name in "xyz"]
            np.testing.assert_allclose(place, painted.camera.X_WC[:3, 3], atol=0.01)
        assert "shift [mm]" in (out / "report.html").read_text()
    seconds = [json.loads((out / k / "summary.json").read_text())["seconds"] for k in scenes]
    assert seconds[1] < seconds[0]
    assert json.loads((out / "batch.json").read_text())["scenes"]["one"]["state"] == "finished"
