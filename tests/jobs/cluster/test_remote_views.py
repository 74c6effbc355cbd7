"""Live capture with workers that look through the cameras."""

import itertools
import math
import os
import signal
from contextlib import nullcontext
from typing import NamedTuple

import numpy as np
import pytest

from drake_pose.camera.frame_source import SourceSpecification
from drake_pose.errors import ClusterError, SceneError
from drake_pose.jobs.cluster.remote_views import ClusterSensors
from drake_pose.jobs.cluster.scheduler import assign_cameras
from drake_pose.jobs.live.scene import load_live_scene, run_live
from drake_pose.person.shape import tracker_of_person
from drake_pose.systems.person.live_capture import build_live_capture
from tests.cli import run_command
from tests.jobs.live_scenes import RATE_HZ, standing, write_studio

FRAMES = 40
GAP = range(9, 16)


@pytest.fixture(scope="module")
def scene(tmp_path_factory, person):
    """Masks by four cameras of a person who raises an arm; one of the cameras pauses."""
    folder = tmp_path_factory.mktemp("studio")
    write_studio(folder, person, [standing(person, arm_deg=30.0 + 0.5 * k) for k in range(FRAMES)],
                 "masks", 4)  # fmt: skip
    for k in GAP:
        (folder / "masks" / "camera_1" / f"{k:04d}.png").unlink()
    return load_live_scene(folder)


class Frame(NamedTuple):
    time: float
    q: np.ndarray
    views: list[str]


class Capture:
    """Runs sensors to the end, and keeps what came out."""

    def __init__(self, scene, person, sensors, on_frame=lambda count: None):
        tracker = tracker_of_person(person.pose_tree(), None)
        diagram = build_live_capture(tracker, scene.cameras, sensors)
        self.frames, self.reports = [], []

        def note(context):
            moment = diagram.GetOutputPort("time").Eval(context)[0]
            if math.isnan(moment) or (self.frames and moment == self.frames[-1].time):
                return
            q = np.array(diagram.GetOutputPort("estimated_positions").Eval(context))
            ports = {name: diagram.GetOutputPort(f"silhouette_{name}") for name in scene.cameras}
            views = [name for name, port in ports.items() if port.Eval(context) is not None]
            self.frames.append(Frame(moment, q, views))
            on_frame(len(self.frames))

        try:
            run_live(diagram, sensors, 60.0, self.reports.append, monitor=note)
            self.used = {name: count.used for name, count in sensors.counts().items()}
        finally:
            sensors.close()

    @property
    def text(self):
        return "\n".join(self.reports)

    def times(self, camera):
        """When a camera was used, in frames."""
        return [round(one.time * RATE_HZ) for one in self.frames if camera in one.views]

    def same_as(self, other):
        """The same answer: sums over cameras are added in another order."""
        return [one.time for one in self.frames] == [one.time for one in other.frames] and all(
            np.allclose(one.q, two.q, rtol=0.0, atol=1e-9, equal_nan=True)
            and one.views == two.views
            for one, two in zip(self.frames, other.frames, strict=True)
        )


@pytest.fixture(scope="module")
def here(scene, person):
    """What this process sees by itself."""
    return Capture(scene, person, scene.open_sensors())


@pytest.mark.slow
def test_workers_see_what_this_process_sees(scene, person, cluster, here):
    sensors = ClusterSensors(cluster, scene)
    groups = sensors.groups
    assert [list(group.sources) for group in groups] == [
        ["camera_0", "camera_1"], ["camera_2", "camera_3"],
    ]  # fmt: skip
    assert groups[0].address != groups[1].address
    there = Capture(scene, person, sensors)
    assert len(there.frames) == FRAMES
    assert there.same_as(here)
    # Most frames were added up by the workers.
    assert min(group.keeper.answers for group in groups) > FRAMES
    assert not set(GAP) & set(there.times("camera_1"))
    assert max(there.times("camera_1")) == FRAMES - 1
    for text in ("camera 'camera_1' stopped at 0.53 s", "camera 'camera_1' returned at 1.07 s"):
        assert text in there.text
        assert text in here.text
    views = sum(group.views for group in groups)
    assert views == 4 * FRAMES - len(GAP)
    assert sum(group.view_bytes for group in groups) / views < 240 * 180 * 3 / 10


@pytest.mark.slow
def test_recording_loses_nothing_with_its_worker(scene, person, cluster, here):
    sensors = ClusterSensors(cluster, scene)
    victim = cluster.run(os.getpid)[sensors.groups[0].address]

    def kill(count):
        if count == 4:
            os.kill(victim, signal.SIGKILL)

    there = Capture(scene, person, sensors, kill)
    assert there.same_as(here)
    assert "the worker of camera 'camera_0', 'camera_1' was lost" in there.text
    assert "a worker goes on with camera 'camera_0', 'camera_1'" in there.text
    cluster.wait_for_workers(2, timeout=60)


@pytest.mark.slow
def test_live_capture_goes_on_without_a_worker_that_stops(scene, person, cluster, monkeypatch):
    monkeypatch.setattr("drake_pose.jobs.cluster.remote_views._SILENCE", 0.3)
    ticks = itertools.count()
    # A clock that waits for the slowest machine that runs this test.
    sensors = ClusterSensors(cluster, scene, live=True, clock=lambda: next(ticks) / RATE_HZ)
    victim = cluster.run(os.getpid)[sensors.groups[1].address]

    def stop(count):
        if count in (4, 14):
            os.kill(victim, signal.SIGSTOP if count == 4 else signal.SIGCONT)

    there = Capture(scene, person, sensors, stop)
    assert "the worker of camera 'camera_2', 'camera_3' does not answer" in there.text
    assert "a worker goes on with camera 'camera_2', 'camera_3'" in there.text
    assert "camera 'camera_3' stopped at" in there.text
    assert "camera 'camera_3' returned at" in there.text
    alone = [
        one.time
        for one in there.frames
        if "camera_0" in one.views and not {"camera_2", "camera_3"} & set(one.views)
    ]
    assert alone, "the others went on"
    assert max(one.time for one in there.frames if "camera_3" in one.views) > max(alone)


def test_source_that_cannot_be_opened_is_named(scene, cluster, tmp_path, person):
    write_studio(tmp_path, person, [standing(person)], "masks", 2)
    broken = load_live_scene(tmp_path)
    (tmp_path / "masks" / "camera_1" / "0000.png").unlink()
    with pytest.raises(SceneError, match="camera_1"):
        ClusterSensors(cluster, broken)


def device(name, location):
    return SourceSpecification(name, "device", location, 64, 48)


def test_a_camera_is_looked_through_where_it_hangs():
    cameras = [device("left", "0"), device("right", "0"), device("door", "rtsp://10.0.0.9/live")]
    here = {"tcp://10.0.0.1:7001": (), "tcp://10.0.0.1:7002": ()}
    assert [len(place.specifications) for place in assign_cameras(cameras, here)] == [2, 1]
    two = {"tcp://10.0.0.1:7001": ("left",), "tcp://10.0.0.2:7001": ("right",)}
    places = assign_cameras(cameras, two)
    found = {place.specifications[0].camera: place.hosts for place in places}
    assert found == {"left": {"10.0.0.1"}, "right": {"10.0.0.2"}, "door": set()}
    assert places[0].allows("tcp://10.0.0.1:7009")
    assert not places[0].allows("tcp://10.0.0.2:7001")
    with pytest.raises(ClusterError, match=r"camera 'left' hangs on one of 10\.0\.0\.1, 10"):
        assign_cameras(cameras, dict.fromkeys(two, ()))
    with pytest.raises(ClusterError, match="no workers"):
        assign_cameras(cameras, {})


@pytest.mark.slow
def test_command(scene, cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(
        "drake_pose.jobs.cluster.scheduler.open_cluster", lambda *_: nullcontext(cluster)
    )
    arguments = ["capture", str(scene.path), "--out", str(tmp_path / "out"), "--no-fit-shape",
                 "--no-replay", "--seconds", "0.3"]  # fmt: skip
    both = run_command([*arguments, "--workers", "2", "--scheduler", "tcp://here:1"])
    assert both.exit_code == 2
    result = run_command([*arguments, "--workers", "2"])
    assert result.exit_code == 0, result.stderr
    assert len((tmp_path / "out" / "poses.csv").read_text().splitlines()) == 1 + 5
