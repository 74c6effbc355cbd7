"""Date's stages on recorded colour pictures, from the command line."""

import csv
import json
import time

import cv2
import numpy as np
import pytest
import yaml

from drake_pose.commands.main import app
from drake_pose.errors import SceneError, SettingsError
from drake_pose.jobs.live.capture import LiveSettings
from drake_pose.jobs.live.paper_capture import METHOD, capture_paper
from drake_pose.jobs.live.scene import load_live_scene
from drake_pose.person.date.recognition import registered_positions
from drake_pose.person.date.skeleton import load_skeleton
from tests.cli import CliRunner
from tests.jobs.live_scenes import RATE_HZ, load_person, standing, write_studio

PLACE = (0.12, -0.1, 1.55)
HEADING = 0.3


@pytest.fixture(scope="module")
def person():
    return load_person()


@pytest.fixture(scope="module")
def skeleton(person):
    return load_skeleton(person)


@pytest.fixture(scope="module")
def path(person, skeleton):
    """A person who raises both arms to the registered pose, then reaches forward."""
    relaxed, shown = standing(person), registered_positions(skeleton)
    goal = np.array(shown)
    for name, degrees in (("left_upper_arm_x", -50), ("left_upper_arm_z", 30)):
        goal[person.position_index(name)] = np.radians(degrees)
    goal[person.position_index("left_forearm_x")] = np.radians(-50)
    for q in (relaxed, shown, goal):
        q[skeleton.head_positions] = PLACE
        q[skeleton.head_angles[0]] = HEADING
    up = [relaxed + share * (shown - relaxed) for share in np.linspace(0.0, 1.0, 5)]
    return [*up, shown, shown, *(shown + s * (goal - shown) for s in np.linspace(0.1, 1.0, 8))]


@pytest.fixture(scope="module")
def studio(tmp_path_factory, person, path):
    folder = tmp_path_factory.mktemp("studio")
    write_studio(folder, person, path, "videos", cameras=6, size=(320, 240))
    return folder


@pytest.mark.slow
def test_person_is_followed_from_the_registered_pose_on(studio, person, skeleton, path, tmp_path):
    out = tmp_path / "out"
    words = ["capture", str(studio), "--method", "paper", "--no-replay", "--json"]
    done = CliRunner().invoke(app, [*words, "--out", str(out)])
    assert done.exit_code == 0, done.output
    summary = json.loads(done.stdout)
    assert summary["method"] == METHOD
    assert "before the registered pose" in done.stderr
    with (out / "poses.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(path)
    assert [row["error"] == "" for row in rows[:4]] == [True] * 4
    assert all(row["error"] != "" for row in rows[5:])
    for row, q in zip(rows[5:], path[5:], strict=True):
        found = np.array([float(row[name]) for name in person.position_names])
        head, left_hand, right_hand, *feet = np.linalg.norm(
            skeleton.features(found) - skeleton.features(q), axis=1
        )
        # A hand's middle is told by what cameras of 320 x 240 see of its skin.
        assert max(head, left_hand, right_hand) < 0.06
        assert max(feet) < 0.08
        elbow = skeleton.limb_points(found, "left_arm")[1] - skeleton.limb_points(q, "left_arm")[1]
        assert np.linalg.norm(elbow) < 0.08
    assert (out / "joint_centres.trc").is_file()
    assert "as published" in (out / "report.html").read_text()


class Devices:
    """Recordings that stand for cv2.VideoCapture: what is shown goes on with the frames captured.

    So a slow machine sees all of it. One camera fails for a while.
    """

    FAILS = (3, range(10, 14))

    def __init__(self, folder):
        self.shown = 0
        self._pictures = {}
        for path in folder.glob("*.avi"):
            recording = cv2.VideoCapture(str(path))
            pictures = []
            while (read := recording.read())[0]:
                pictures.append(read[1])
            self._pictures[int(path.stem.rsplit("_", 1)[1])] = pictures

    def open(self, number):
        return Device(self, number)

    def works(self, number):
        camera, shown = self.FAILS
        return number != camera or self.shown not in shown

    def picture(self, number):
        return self._pictures[number][min(self.shown, len(self._pictures[number]) - 1)]


class Device:
    def __init__(self, devices, number):
        self._devices, self._number = devices, number

    def isOpened(self):
        return self._devices.works(self._number)

    def set(self, what, value):
        return True

    def read(self):
        time.sleep(1.0 / RATE_HZ)
        if not self.isOpened():
            return False, None
        return True, self._devices.picture(self._number)

    def release(self):
        pass


@pytest.mark.slow
def test_person_before_live_cameras_is_followed(person, skeleton, path, tmp_path, monkeypatch):
    shown = path[5:]
    goal, last = shown[-1], len(shown) + 8
    folder = tmp_path / "live"
    folder.mkdir()
    write_studio(folder, person, shown, "videos", cameras=6, size=(320, 240))
    devices = Devices(folder)
    entries = yaml.safe_load((folder / "sources.yaml").read_text())
    for number, entry in enumerate(entries.values()):
        entry |= {"kind": "device", "location": number, "rate_hz": RATE_HZ}
    (folder / "sources.yaml").write_text(yaml.safe_dump(entries))
    monkeypatch.setattr(cv2, "VideoCapture", devices.open)
    monkeypatch.setattr("drake_pose.camera.sources.live.FIRST_PAUSE", 0.05)
    reports, heard = [], []

    def on_frame(count, found):
        heard.append(found)
        devices.shown = count
        is_back = any("'camera_3' returned" in text for text in reports)
        if (count >= last and is_back) or count == 40 * last:
            raise KeyboardInterrupt

    result = capture_paper(
        load_live_scene(folder),
        tmp_path / "out",
        person.path,
        LiveSettings(replay=False),
        on_report=reports.append,
        on_frame=on_frame,
    )
    assert result.interrupted
    with (tmp_path / "out" / "poses.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["error"] != "" for row in rows] == heard
    assert all(heard[1:])
    for row, q in ((rows[1], shown[0]), (rows[-1], goal)):
        found = np.array([float(row[name]) for name in person.position_names])
        off = np.linalg.norm(skeleton.features(found) - skeleton.features(q), axis=1)
        assert max(off[:3]) < 0.06
        assert max(off[3:]) < 0.08
    sources = json.loads((tmp_path / "out" / "summary.json").read_text())["sources"]
    assert {one["kind"] for one in sources.values()} == {"device"}
    told = "\n".join(reports)
    assert "'3' stopped; it is tried again" in told
    assert "'3' answers again" in told
    changes = [change["what"] for change in sources["camera_3"]["changes"]]
    assert changes[:2] == ["stopped", "returned"]


@pytest.mark.slow
def test_whoever_never_shows_the_registered_pose_is_refused(tmp_path, person):
    write_studio(tmp_path, person, [standing(person)] * 3, "videos", cameras=3)
    with pytest.raises(SettingsError, match=r"registered pose.*likest silhouettes"):
        capture_paper(load_live_scene(tmp_path), tmp_path / "out", person.path)
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_captured_so_is_refused_before(tmp_path, person):
    write_studio(tmp_path, person, [standing(person)], "masks")
    with pytest.raises(SceneError, match="'camera_0' delivers masks"):
        capture_paper(load_live_scene(tmp_path), tmp_path / "out")
    with pytest.raises(SettingsError, match="give no shape"):
        capture_paper(
            load_live_scene(tmp_path), tmp_path / "out", settings=LiveSettings(shape=tmp_path)
        )
    words = ["capture", str(tmp_path), "--out", str(tmp_path / "out"), "--method", "paper"]
    done = CliRunner().invoke(app, [*words, "--no-track"])
    assert done.exit_code == 2
    done = CliRunner().invoke(app, [*words, "--face-camera", "camera_0"])
    assert done.exit_code == 2
    (tmp_path / "sources.yaml").unlink()
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 1
    assert "has no sources.yaml" in done.stderr
