import json

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_pose.jobs.live.scene import load_live_scene, run_live
from drake_pose.jobs.live.walk import live_player, open_page, walk
from drake_pose.person.date.walking import WALK
from tests.cli import run_command
from tests.jobs.live_scenes import RATE_HZ, absent, standing, write_studio

REST, AHEAD, AWAY = round(1.4 * RATE_HZ), round(1.0 * RATE_HZ), round(0.6 * RATE_HZ)


@pytest.fixture(scope="module")
def studio(tmp_path_factory, person):
    """Videos of a person who rests, stands ahead, leaves, and returns."""
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
    # Simulated time, so that a busy computer skips no frame.
    player = live_player(scene, person.path, None, lambda: scene.open_sensors(live=False))
    found = walk(player, open_page(), on_command=commands.append, on_report=reports.append)
    assert commands == ["walk ahead", "", "walk ahead"]
    assert reports == ["the person is found", "the person is lost", "the person is found"]
    walked = found["commands"]["walk ahead"]
    assert walked == pytest.approx((2 * AHEAD + 2) / RATE_HZ, abs=0.4)
    # The avatar moves at its walking speed; loss and return of the person do not move it.
    assert found["x"] - WALK.start[0] == pytest.approx(walked * WALK.speed, abs=0.1)
    assert abs(found["y"] - WALK.start[1]) < 0.05
    assert found["seconds"] > REST / RATE_HZ > 1.0
    assert 0.6 < found["found_share"] < 0.95


def test_recordings_play_as_if_live(studio, person):
    words = ["walk", "--live", str(studio), "--model", str(person.path), "--no-browser", "--json"]
    done = run_command([*words, "--seconds", "1.5"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert set(found["commands"]) == {"turn left", "turn right", "walk ahead", "walk behind"}
    assert "http://localhost:" in done.stderr
    assert 0.0 < found["seconds"] < 2.5


def test_wrong_usage_is_refused(studio, tmp_path):
    live = ["--live", str(studio)]
    for words in ([*live, "--simulate"], ["--shape", str(studio)]):
        assert run_command(["walk", *words, "--no-browser"]).exit_code == 2
    done = run_command(["walk", "--live", str(tmp_path), "--no-browser"])
    assert done.exit_code == 1
    assert "sources.yaml" in done.stderr


def test_a_slow_computer_skips_ahead(studio, monkeypatch):
    clock = {"now": 0.0}
    monkeypatch.setattr("drake_pose.jobs.live.scene.time.monotonic", lambda: clock["now"])
    sensors = load_live_scene(studio).open_sensors(live=False)
    builder = DiagramBuilder()
    builder.AddSystem(sensors)
    diagram = builder.Build()
    sensors.live = True
    times = []

    def work(context):
        if not times or context.get_time() > times[-1]:
            times.append(context.get_time())
            clock["now"] += 1.0

    run_live(diagram, sensors, 10.0, monitor=work)
    # Each period takes a second of the clock; simulated time does not catch up.
    assert len(times) == pytest.approx(10, abs=1)
