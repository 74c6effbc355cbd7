import json
import math

import numpy as np
import pytest

from drake_pose.commands.main import app
from drake_pose.errors import SettingsError
from drake_pose.jobs.live.local_proxy import open_page
from drake_pose.jobs.live.run import run_live
from drake_pose.jobs.live.scene import load_live_scene
from drake_pose.jobs.live.settings import LiveSettings
from drake_pose.jobs.live.walk import SETTLE, walk_live
from drake_pose.person.date.walk_commands import SPEED
from drake_pose.systems.walk import START
from tests.cli import CliRunner
from tests.jobs.live_scenes import RATE_HZ, absent, standing, write_studio

REST, AHEAD, AWAY = round(1.4 * RATE_HZ), round(1.0 * RATE_HZ), round(0.6 * RATE_HZ)


@pytest.fixture(scope="module")
def studio(tmp_path_factory, person):
    """Videos: a person rests, stands ahead, is gone, and is back where the person was."""
    folder = tmp_path_factory.mktemp("studio")
    step = [standing(person, x) for x in np.linspace(0.0, 0.4, 5)]
    poses = [standing(person)] * REST + step + [standing(person, 0.4)] * AHEAD
    poses += [absent(person)] * AWAY + [standing(person, 0.4)] * AHEAD
    write_studio(folder, person, poses, "videos")
    return folder


@pytest.mark.slow
def test_person_before_the_cameras_walks_is_lost_and_found_again(studio, person):
    scene = load_live_scene(studio)
    commands, reports = [], []
    found = walk_live(
        scene,
        open_page(),
        person.path,
        # The simulation's time, so that a busy computer skips nothing.
        open_sensors=lambda: scene.open_sensors(live=False),
        on_command=commands.append,
        on_report=reports.append,
    )
    assert commands == ["walk ahead", "", "walk ahead"]
    assert reports == ["the person is found", "the person is lost", "the person is found"]
    walked = found["commands"]["walk ahead"]
    assert walked == pytest.approx((2 * AHEAD + 2) / RATE_HZ, abs=0.4)
    # The walker goes at the walking pace, and neither loss nor return moves him otherwise.
    assert found["x"] - START[0] == pytest.approx(walked * SPEED, abs=0.1)
    assert abs(found["y"] - START[1]) < 0.05
    assert found["seconds"] > REST / RATE_HZ > SETTLE
    assert 0.6 < found["found_share"] < 0.95


def test_recordings_are_walked_as_if_live(studio, person):
    words = ["walk", "--live", str(studio), "--model", str(person.path), "--no-browser", "--json"]
    done = CliRunner().invoke(app, [*words, "--seconds", "1.5"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert set(found["commands"]) == {"turn left", "turn right", "walk ahead", "walk behind"}
    assert 0.0 < found["seconds"] < 2.5
    assert "http://localhost:" in done.stderr


@pytest.mark.slow
def test_workers_look_through_the_cameras(studio, person):
    words = ["walk", "--live", str(studio), "--model", str(person.path), "--no-browser", "--json"]
    done = CliRunner().invoke(app, [*words, "--workers", "2"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    # Recordings lose nothing with workers, however busy the computer is.
    assert found["commands"]["walk ahead"] == pytest.approx((2 * AHEAD + 2) / RATE_HZ, abs=0.4)
    assert found["seconds"] > REST / RATE_HZ


def test_wrong_usage_is_refused(studio, tmp_path):
    done = CliRunner().invoke(app, ["walk", "--live", str(studio), "--simulate", "--no-browser"])
    assert done.exit_code == 2
    for words in (
        ["--workers", "2"],
        ["--live", str(studio), "--workers", "2", "--scheduler", "a"],
    ):
        assert CliRunner().invoke(app, ["walk", *words, "--no-browser"]).exit_code == 2
    done = CliRunner().invoke(app, ["walk", "--live", str(tmp_path), "--no-browser"])
    assert done.exit_code == 1
    assert "sources.yaml" in done.stderr
    with pytest.raises(SettingsError, match="positive"):
        LiveSettings(seconds=math.inf)


def test_a_slow_computer_does_not_make_up_for_lost_time(studio, monkeypatch):
    clock = {"now": 0.0}
    monkeypatch.setattr("drake_pose.jobs.live.run.time.monotonic", lambda: clock["now"])
    scene = load_live_scene(studio)
    sensors = scene.open_sensors(live=False)
    from pydrake.systems.framework import DiagramBuilder

    builder = DiagramBuilder()
    sensors.add(builder)
    diagram = builder.Build()
    sensors.live = True
    times = []

    def work(context):
        if not times or context.get_time() > times[-1]:
            times.append(context.get_time())
            clock["now"] += 1.0

    run_live(diagram, sensors, 10.0, lambda _: None, monitor=work)
    # Ten seconds of the clock, one a period: the simulation's time does not run after it.
    assert len(times) == pytest.approx(10, abs=1)
