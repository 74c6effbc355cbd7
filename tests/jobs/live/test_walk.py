import contextlib
import json
import math
import socket
import threading
import time

import numpy as np
import pytest

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.commands.main import app
from drake_pose.errors import OutputError, SettingsError
from drake_pose.files.folder import write_summary
from drake_pose.files.records import PoseRow, PoseTable
from drake_pose.jobs.live.local_proxy import open_page
from drake_pose.jobs.live.run import run_live
from drake_pose.jobs.live.walk import (
    REPLAY,
    Player,
    key_player,
    recorded_player,
    show,
    simulated_player,
    stride_positions,
    wait_for_replay,
    walk,
)
from drake_pose.person.date.walk_commands import SPEED
from drake_pose.systems.walk import START
from tests.cli import CliRunner


def record(folder, ahead, lost=()):
    """A result of capture with the model whose lengths are fitted: stands, then stands ahead."""
    model = load_model(bundled_model("person").with_name("person_shape.urdf"), check=False)
    rows = []
    standing = stride_positions(model)[-1]
    for index, x in enumerate(ahead):
        q = standing.copy()
        q[model.position_index("position_x")] = x
        if index in lost:
            q[:] = np.nan
        rows.append(PoseRow(f"{index:04d}", q, None, math.nan if index in lost else 0.1, 0.1))
    PoseTable(folder, model.position_names, with_base=False).write(rows)
    write_summary(folder, {"model": model.path.name, "frame_rate_hz": 10.0})
    return model


def test_recorded_capture_is_walked(tmp_path):
    ahead = [0.0] * 10 + [0.4] * 20 + [0.0] * 10
    record(tmp_path, ahead, lost=range(12, 18))
    player = recorded_player(tmp_path, None, None)
    assert player.q.shape[0] == 40
    assert np.isnan(player.q[12:18]).all()
    said = []
    found = walk(player, open_page(), speed=0.0, on_command=said.append)
    assert found["seconds"] == pytest.approx(4.0)
    assert said == ["walk ahead", "", "walk ahead", ""]
    # 20 frames of a tenth of a second, less the six in which nobody is found.
    assert found["commands"]["walk ahead"] == pytest.approx(1.4, abs=0.05)
    assert found["x"] - START[0] == pytest.approx(1.4 * SPEED, abs=0.1)


def test_results_that_cannot_be_played_say_why(tmp_path):
    record(tmp_path / "lost", [0.0, 0.0], lost=(0, 1))
    with pytest.raises(OutputError, match="nobody was found"):
        recorded_player(tmp_path / "lost", None, 30.0)
    record(tmp_path / "good", [0.0])
    with pytest.raises(SettingsError, match="positive"):
        recorded_player(tmp_path / "good", None, 0.0)
    with pytest.raises(OutputError, match="no column"):
        recorded_player(tmp_path / "good", bundled_model("hand"), 30.0)
    with pytest.raises(OutputError):
        recorded_player(tmp_path / "nothing", None, 30.0)


def test_command_ends_by_itself():
    words = ["walk", "--simulate", "--no-browser", "--seconds", "16", "--speed", "0", "--json"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["seconds"] == pytest.approx(16.0)
    assert found["commands"]["walk ahead"] > 2.0
    assert found["x"] > START[0] + 2.0
    assert "http://localhost:" in done.stderr


def test_simulated_person_turns_both_ways():
    player = simulated_player()
    turning = Player(player.model, player.q[780:1110], player.rate_hz)
    found = walk(turning, open_page(), speed=0.0)
    assert found["commands"]["turn left"] > 1.0
    assert found["commands"]["turn right"] > 1.0


def test_wrong_usage_is_refused(tmp_path):
    both = CliRunner().invoke(app, ["walk", str(tmp_path), "--simulate", "--no-browser"])
    assert both.exit_code == 2
    for words in (["--rate", "9"], ["--model", "x"], ["--port", "80"]):
        one_second = ["walk", "--simulate", "--no-browser", "--seconds", "1"]
        assert CliRunner().invoke(app, [*one_second, *words]).exit_code == 2
    numbers = (["--seconds", "0"], ["--seconds", "1", "--speed", "-1"])
    for words in (*numbers, ["--seconds", "inf"], ["--seconds", "1", "--speed", "nan"]):
        done = CliRunner().invoke(app, ["walk", "--no-browser", *words])
        assert done.exit_code == 2
        assert words[-2] in done.stderr


def test_port_that_is_taken_is_named():
    page = open_page()
    port = int(page.web_url().rpartition(":")[2])
    with pytest.raises(SettingsError, match=f"port {port}"):
        open_page(port)


def test_browser_that_does_not_open_is_not_waited_for_for_ever(monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)
    page = open_page()
    assert not show(page, patience=0.1)
    assert opened == [page.web_url()]


@contextlib.contextmanager
def shown(url):
    """A page that a browser shows, as far as its server can tell."""
    place = url.removeprefix("http://")
    with socket.create_connection(("127.0.0.1", int(place.rpartition(":")[2]))) as opened:
        opened.sendall(
            f"GET / HTTP/1.1\r\nHost: {place}\r\nOrigin: {url}\r\nConnection: Upgrade\r\n"
            "Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
        )
        yield


def test_recording_waits_for_a_browser_and_is_played_again(tmp_path, monkeypatch):
    record(tmp_path, [0.0] * 5)
    pages, browsers = [], contextlib.ExitStack()
    monkeypatch.setattr(
        "drake_pose.jobs.live.local_proxy.open_page",
        lambda _: pages.append(open_page()) or pages[0],
    )
    urls, begun, presses = [], [], []

    def open_later():
        time.sleep(0.5)
        assert not begun, "played before a browser was there"
        browsers.enter_context(shown(*urls))

    def press(page):
        """Play again once; then Ctrl-C."""
        presses.append(page)
        return len(presses) == 1

    def run(*arguments, **others):
        begun.append(pages[0].GetNumActiveConnections())
        return run_live(*arguments, **others)

    opening = threading.Thread(target=open_later)
    monkeypatch.setattr("webbrowser.open", lambda url: urls.append(url) or opening.start())
    monkeypatch.setattr("drake_pose.jobs.live.walk.wait_for_replay", press)
    monkeypatch.setattr("drake_pose.jobs.live.walk.run_live", run)
    with browsers:
        done = CliRunner().invoke(app, ["walk", str(tmp_path), "--speed", "0", "--json"])
        opening.join()
    assert done.exit_code == 0, done.output
    assert begun == [1, 1]
    assert len(presses) == 2
    assert json.loads(done.stdout)["seconds"] == pytest.approx(0.5)
    assert "waiting until a browser" in done.stderr


def test_button_and_control_c_end_the_wait_for_another_play(monkeypatch):
    page = open_page()
    # What the browser sends for a button: a map of two texts as MessagePack.
    texts = ["type", "button", "name", REPLAY]
    packed = b"\x82" + b"".join(bytes([0xA0 + len(text)]) + text.encode() for text in texts)
    monkeypatch.setattr("time.sleep", lambda _: page._InjectWebsocketMessage(message=packed))
    assert wait_for_replay(page)
    assert REPLAY not in page.GetButtonNames()

    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("time.sleep", interrupt)
    assert not wait_for_replay(page)
    assert REPLAY not in page.GetButtonNames()


def test_a_walk_once_more_begins_at_the_start():
    player, asked = key_player(), []
    q = np.tile(stride_positions(player.model)[-1], (5, 1))
    q[1:, player.model.position_index("position_x")] = 0.4
    page = open_page()
    once = walk(Player(player.model, q), page, speed=0.0)
    assert once["x"] > START[0]
    again = walk(
        Player(player.model, q),
        page,
        speed=0.0,
        again=lambda: not asked.append(1) and len(asked) < 3,
    )
    assert len(asked) == 3
    assert again == once


def test_keys_alone_leave_the_walker_where_he_is():
    found = walk(key_player(), open_page(), seconds=1.0, speed=0.0)
    assert (found["x"], found["y"], found["heading_deg"]) == START
    assert not any(found["commands"].values())
