import json
import threading
import time
from http.client import HTTPConnection
from pathlib import Path

import numpy as np
import pytest

from drake_pose.body import bundled_model, load_model
from drake_pose.errors import OutputError, SettingsError
from drake_pose.files.folder import write_summary
from drake_pose.files.records import FrameRecord, PoseTable
from drake_pose.jobs.live.scene import run_live
from drake_pose.jobs.live.walk import (
    Player,
    open_page,
    recorded_player,
    simulated_player,
    stride_positions,
    wait_for_browser,
    wait_for_replay,
    walk,
)
from drake_pose.person.date.walking import WALK
from tests.cli import run_command


@pytest.fixture(scope="module")
def page():
    return open_page()


def record(folder, ahead, lost=()):
    """A result of capture with fitted lengths: the person stands, then stands ahead."""
    model = load_model(bundled_model("person").with_name("person_shape.urdf"), check=False)
    rows = []
    standing = stride_positions(model)[-1]
    for index, x in enumerate(ahead):
        q = standing.copy()
        q[model.position_index("position_x")] = x
        if index in lost:
            q[:] = np.nan
        rows.append(FrameRecord(f"{index:04d}", q, None, None if index in lost else 0.1, 0.1))
    PoseTable(folder, model.position_names, with_base=False).write(rows)
    write_summary(folder, {"model": model.path.name, "frame_rate_hz": 10.0})


def test_recorded_capture_is_played_and_repeated_from_the_start(tmp_path, page):
    record(tmp_path, [0.0] * 10 + [0.4] * 20 + [0.0] * 10, lost=range(12, 18))
    player = recorded_player(tmp_path, None, None)
    assert player.q.shape[0] == 40
    assert np.isnan(player.q[12:18]).all()
    said, asked = [], []

    def again():
        asked.append(1)
        return len(asked) < 2

    found = walk(player, page, speed=0.0, on_command=said.append, again=again)
    assert len(asked) == 2
    assert found["seconds"] == pytest.approx(4.0)
    assert said == 2 * ["walk ahead", "", "walk ahead", ""]
    # 20 frames of 0.1 s, without the six in which nobody is found.
    assert found["commands"]["walk ahead"] == pytest.approx(1.4, abs=0.05)
    assert found["x"] - WALK.start[0] == pytest.approx(1.4 * WALK.speed, abs=0.1)


def test_results_that_cannot_be_played_say_why(tmp_path):
    record(tmp_path / "lost", [0.0, 0.0], lost=(0, 1))
    record(tmp_path / "good", [0.0])
    for name, model, rate_hz, error, words in (
        ("lost", None, 30.0, OutputError, "no person was found"),
        ("good", None, 0.0, SettingsError, "positive"),
        ("good", bundled_model("hand"), 30.0, OutputError, "another model"),
        ("nothing", None, 30.0, OutputError, "not a result folder"),
    ):
        with pytest.raises(error, match=words):
            recorded_player(tmp_path / name, model, rate_hz)


def test_walk_ends_by_itself():
    words = ["walk", "--simulate", "--no-browser", "--seconds", "16", "--speed", "0", "--json"]
    done = run_command(words)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["seconds"] == pytest.approx(16.0)
    assert found["commands"]["walk ahead"] > 2.0
    assert found["x"] > WALK.start[0] + 2.0
    assert "http://localhost:" in done.stderr


def test_simulated_person_turns_both_ways(page):
    player = simulated_player()
    found = walk(Player(player.model, player.q[780:1110]), page, speed=0.0)
    assert found["commands"]["turn left"] > 1.0
    assert found["commands"]["turn right"] > 1.0


def test_wrong_usage_is_refused(tmp_path):
    one_second = ["--simulate", "--seconds", "1"]
    for words in (
        [str(tmp_path), "--simulate"],
        *([*one_second, *more] for more in (["--rate", "9"], ["--model", "x"], ["--port", "80"])),
        ["--seconds", "0"],
        ["--seconds", "inf"],
        ["--seconds", "1", "--speed", "-1"],
        ["--seconds", "1", "--speed", "nan"],
    ):
        done = run_command(["walk", "--no-browser", *words])
        assert done.exit_code == 2
        assert words[-2] in done.stderr or words[-1] == "--simulate"


def test_port_that_is_taken_is_named(page):
    port = int(page.web_url().rpartition(":")[2])
    with pytest.raises(SettingsError, match=f"port {port}"):
        open_page(port)


@pytest.mark.skipif(not Path("/proc/net/tcp").is_file(), reason="the system lists no sockets")
def test_page_listens_on_the_loopback_address_only(page):
    addresses = []
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        for line in Path(table).read_text(encoding="ascii").splitlines()[1:]:
            _, local, _, state, *_ = line.split()
            address, port = local.split(":")
            if state == "0A" and int(port, 16) == page.port():
                addresses.append(address)
    # 127.0.0.1 or ::1 in the byte order of the kernel.
    assert addresses
    assert set(addresses) <= {"0100007F", "0" * 24 + "01000000"}


def connect(url):
    """Connect to a page's web socket as a browser does."""
    opened = HTTPConnection("localhost", int(url.rpartition(":")[2]), timeout=10.0)
    key = {"Sec-WebSocket-Version": "13", "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}
    opened.request("GET", "/", headers=key | {"Connection": "Upgrade", "Upgrade": "websocket"})
    assert opened.getresponse().status == 101
    return opened


def test_waiting_for_a_browser_ends_after_the_timeout(page):
    assert not wait_for_browser(page, patience=0.1)


def test_recording_waits_for_a_browser_and_can_be_repeated(tmp_path, monkeypatch):
    record(tmp_path, [0.0] * 5)
    pages, browsers = [], []
    monkeypatch.setattr(
        "drake_pose.jobs.live.walk.open_page", lambda _: pages.append(open_page()) or pages[0]
    )
    urls, begun, presses = [], [], []

    def open_later():
        time.sleep(0.5)
        assert not begun, "played before a browser was there"
        browsers.append(connect(urls[0]))

    def press(page):
        """Click once, then raise Ctrl-C."""
        presses.append(page)
        return len(presses) == 1

    def run(*arguments, **others):
        begun.append(pages[0].GetNumActiveConnections())
        return run_live(*arguments, **others)

    opening = threading.Thread(target=open_later)
    monkeypatch.setattr("webbrowser.open", lambda url: urls.append(url) or opening.start())
    monkeypatch.setattr("drake_pose.jobs.live.walk.wait_for_replay", press)
    monkeypatch.setattr("drake_pose.jobs.live.walk.run_live", run)
    done = run_command(["walk", str(tmp_path), "--speed", "0", "--json"])
    opening.join()
    browsers[0].close()
    assert done.exit_code == 0, done.output
    assert begun == [1, 1]
    assert len(presses) == 2
    assert json.loads(done.stdout)["seconds"] == pytest.approx(0.5)
    assert "waiting until a browser" in done.stderr


def test_button_or_ctrl_c_ends_the_wait_for_a_repeat(monkeypatch, page):
    # The browser's message for a click: a map of two strings as MessagePack.
    texts = ["type", "button", "name", "play again"]
    packed = b"\x82" + b"".join(bytes([0xA0 + len(text)]) + text.encode() for text in texts)
    monkeypatch.setattr("time.sleep", lambda _: page._InjectWebsocketMessage(message=packed))
    assert wait_for_replay(page)
    assert "play again" not in page.GetButtonNames()

    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("time.sleep", interrupt)
    assert not wait_for_replay(page)
    assert "play again" not in page.GetButtonNames()


def test_walker_without_keys_stays_where_it_is(page):
    found = walk(Player(), page, seconds=1.0, speed=0.0)
    assert (found["x"], found["y"], found["heading_deg"]) == WALK.start
    assert not any(found["commands"].values())
