import json

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_pose.errors import OutputError, SceneError
from drake_pose.jobs.live import capture_live, load_live_scene, run_live, take_empty_room
from tests.cli import run_command
from tests.jobs.live_scenes import RATE_HZ, absent, standing, write_studio
from tests.jobs.scenes import read_rows

FRAMES = 12
GAP, HOLE = range(5, 10), 11
SHOWN = [k for k in range(FRAMES + 1) if k != HOLE]


@pytest.fixture(scope="module")
def studio(tmp_path_factory, person):
    """Masks of a person who raises an arm; at first nobody is in view, and cameras pause."""
    folder = tmp_path_factory.mktemp("studio")
    poses = [absent(person)] + [standing(person, arm_deg=30.0 + 3.0 * k) for k in range(FRAMES)]
    write_studio(folder, person, poses, "masks")
    for k in GAP:
        (folder / "masks" / "camera_1" / f"{k:04d}.png").unlink()
    broken = folder / "masks" / "camera_2" / "0004.png"
    for path in (broken, *folder.glob(f"masks/*/{HOLE:04d}.png")):
        path.write_bytes(b"\x89PNG\r\n\x1a\n broken")
    return folder


@pytest.fixture(scope="module")
def captured(studio, person, tmp_path_factory):
    out, reports = tmp_path_factory.mktemp("results") / "out", []
    scene = load_live_scene(studio)
    result = capture_live(scene, out, person.path, replay=False, on_report=reports.append)
    return out, result, "\n".join(reports)


def test_person_is_captured_frame_by_frame(captured, person):
    out, result, _ = captured
    assert not result[1]
    poses = {row["frame"]: row for row in read_rows(out / "poses.csv")}
    assert list(poses) == [f"{k:06d}" for k in SHOWN]
    rows = list(poses.values())
    assert rows[0]["error"] == "", "nobody was there"
    found = [np.degrees(float(row["left_upper_arm_z"])) for row in rows[2:]]
    off = np.abs(np.array(found) - 30.0 - 3.0 * (np.array(SHOWN[2:]) - 1.0))
    # Three small pictures do not always determine an arm, and not the first pose.
    assert np.median(off) < 3.0
    assert np.sort(off)[-2] < 9.0
    times = [float(row["time"]) for row in read_rows(out / "timestamps.csv")]
    np.testing.assert_allclose(times, np.array(SHOWN) / RATE_HZ, atol=1e-6)
    assert result[0].summary["frame_rate_hz"] == pytest.approx(RATE_HZ)
    assert result[0].summary["mean_iou"] > 0.85
    assert (out / "joint_centres.trc").is_file()
    # The intervals: nobody, then doubt, then positions; with one camera less they are wider.
    widths = {}
    for row in read_rows(out / "joints.csv"):
        is_angle = person.position_kinds[person.position_index(row["joint"])] == "angle"
        low, high, factor = float(row["low"]), float(row["high"]), np.degrees(1.0) ** is_angle
        value = factor * float(poses[row["frame"]][row["joint"]])
        assert low - 1e-3 <= value <= high + 1e-3
        widths.setdefault(row["frame"], []).append((high - low) / factor)
    assert list(widths) == [f"{k:06d}" for k in SHOWN[2:]]
    fewer, all_three = ([np.median(widths[f"{k:06d}"]) for k in own] for own in (GAP, (2, 3, 10)))
    assert np.mean(fewer) > np.mean(all_three)


def test_stops_and_returns_of_cameras_are_reported(captured):
    out, result, text = captured
    for part in ("'camera_1' stopped at 0.27 s", "'camera_1' returned at 0.67 s", "0004.png"):
        assert part in text
    summary = json.loads((out / "summary.json").read_text())
    assert set(summary["frames"]["000006"]["ious"]) == {"camera_0", "camera_2"}
    assert set(summary["frames"]["000010"]["ious"]) == {"camera_0", "camera_1", "camera_2"}
    sources = summary["sources"]
    assert [one["dropped"] for one in sources.values()] == [1, 1 + len(GAP), 2]
    assert [one["what"] for one in sources["camera_1"]["changes"]] == ["stopped", "returned"]
    assert not result[2] or "could not be used" in result[2][0]


def test_ctrl_c_keeps_all_frames(studio, person, tmp_path):
    def interrupt(count, found):
        if count == 6:
            raise KeyboardInterrupt

    scene = load_live_scene(studio)
    _, interrupted, _ = capture_live(
        scene, tmp_path / "out", person.path, replay=False, on_frame=interrupt
    )
    assert interrupted
    assert len(read_rows(tmp_path / "out" / "poses.csv")) == 6
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["complete"]
    assert (tmp_path / "out" / "joint_centres.trc").is_file()


@pytest.mark.slow
def test_command_captures_and_refuses(studio, captured, person, tmp_path):
    words = ["capture", str(studio), "--model", str(person.path), "--no-replay"]
    done = run_command([*words, "--out", str(tmp_path / "a"), "--seconds", "0.3", "--json"])
    assert done.exit_code == 0, done.output
    assert 3 <= json.loads(done.stdout)["frame_count"] <= 6
    done = run_command([*words, "--out", str(tmp_path / "b")])
    assert done.exit_code == 0, done.output
    assert "0004.png" in done.stderr
    assert "stopped at 0.27 s, returned at 0.67 s" in done.stdout
    for more, status, text in (
        ([*words, "--out", str(captured[0])], 1, "not empty"),
        ([*words, "--out", str(tmp_path / "c"), "--frame", "3"], 2, "sources.yaml"),
        (["capture", str(tmp_path), "--out", "c", "--seconds", "3"], 2, "sources.yaml"),
    ):
        done = run_command(more)
        assert done.exit_code == status
        assert text in done.stderr


@pytest.mark.slow
def test_shape_is_fitted_to_a_video(person, tmp_path):
    folder = tmp_path / "studio"
    folder.mkdir()
    poses = [standing(person, arm_deg=20.0 + 4.0 * k) for k in range(10)]
    write_studio(folder, person, poses, "videos", cameras=4)
    found = capture_live(load_live_scene(folder), tmp_path / "out", replay=False)[0].summary
    assert found["found_count"] >= 9  # The first frame may have look-alikes.
    assert found["mean_iou"] > 0.85
    assert len(found["lengths_m"]) > 5


def test_empty_room_is_taken_once(person, tmp_path):
    with pytest.raises(SceneError, match=r"sources\.yaml"):
        load_live_scene(tmp_path)
    write_studio(tmp_path, person, [absent(person)] * 3, "videos", cameras=2)
    with pytest.raises(OutputError, match="exists already"):
        take_empty_room(tmp_path, 2)
    for path in sorted((tmp_path / "empty").glob("*/*")):
        path.unlink()
    with pytest.raises(SceneError, match="3 of 9"):
        take_empty_room(tmp_path, 9)
    done = run_command(["empty-room", str(tmp_path), "--pictures", "2"])
    assert done.exit_code == 0, done.output
    assert len(list((tmp_path / "empty").glob("*/*.png"))) == 4
    assert set(load_live_scene(tmp_path).backgrounds) == {"camera_0", "camera_1"}


def test_a_slow_computer_skips_ahead(studio, monkeypatch):
    clock = {"now": 0.0}
    monkeypatch.setattr("drake_pose.jobs.live.time.monotonic", lambda: clock["now"])
    sensors = load_live_scene(studio).open_sensors()
    builder = DiagramBuilder()
    builder.AddSystem(sensors)
    diagram = builder.Build()
    sensors.live = True
    times = []

    def work(context):
        if not times or context.get_time() > times[-1]:
            times.append(context.get_time())
            clock["now"] += 1.0

    run_live(diagram, sensors, 10.0, lambda _: None, work)
    # Each period takes a second of the clock; simulated time does not catch up.
    assert len(times) == pytest.approx(10, abs=1)
