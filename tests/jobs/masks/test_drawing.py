"""The page on which an object is marked: by plain requests, and in a real browser."""

import asyncio
import contextlib
import http.client
import json
import shutil
import subprocess
import threading
import time

import cv2
import numpy as np
import pytest
from tornado.websocket import websocket_connect

from drake_pose import MaskSettings, load_scene, make_masks
from drake_pose.errors import MaskError
from drake_pose.jobs.masks.strokes import read_strokes
from tests.jobs.masks.rooms import iou

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--remote-debugging-port=0", "--remote-allow-origins=*", "--window-size=1000,800",
]  # fmt: skip


@pytest.fixture
def stills(tmp_path):
    """Two pictures of a blue box before a yellow table, and the truth."""
    rng = np.random.default_rng(3)
    folder, true = tmp_path / "stills", {}
    folder.mkdir()
    for k in range(2):
        mask = np.zeros((120, 160), bool)
        mask[30:90, 40 + 10 * k : 110 + 10 * k] = True
        colours = np.where(mask[:, :, None], (190, 80, 60), (70, 180, 200))
        noisy = (colours + 12.0 * rng.standard_normal(colours.shape)).clip(0, 255)
        cv2.imwrite(str(folder / f"{k}.png"), noisy.astype(np.uint8))
        true[str(k)] = mask
    return folder, true


@pytest.fixture
def page(stills, tmp_path):
    """A page that waits, and the thread that will write the masks."""
    address, opened = [], threading.Event()

    def show(url):
        address.append(url)
        opened.set()

    def work_at_masks():
        # Tests that mark nothing get no masks.
        with contextlib.suppress(MaskError):
            make_masks(stills[0], tmp_path / "out", MaskSettings(draw=True), on_page=show)

    work = threading.Thread(target=work_at_masks, daemon=True)
    work.start()
    assert opened.wait(20.0)
    yield address[0], work
    if work.is_alive():
        ask(address[0], "POST", "/done")
        work.join(20.0)


def ask(url, method, path, body=None, **headers):
    """Status and content of the answer to a request; those of the page's own by default."""
    own = {"Host": url.removeprefix("http://"), "Origin": url} | headers
    connection = http.client.HTTPConnection("127.0.0.1", int(url.rpartition(":")[2]), timeout=20)
    connection.putrequest(method, path, skip_host=True)
    data = b"" if body is None else json.dumps(body).encode()
    for name, value in {**own, "Content-Length": str(len(data))}.items():
        if value is not None:
            connection.putheader(name, value)
    connection.endheaders(data)
    answer = connection.getresponse()
    return answer.status, answer.read()


def test_page_serves_itself_and_no_other(page):
    url, _ = page
    assert ask(url, "GET", "/")[0] == 200
    assert ask(url, "GET", "/", Origin=None)[0] == 200
    for path in ("/", "/pictures", "/picture?picture=0"):
        assert ask(url, "GET", path, Host="evil.example")[0] == 403
        assert ask(url, "GET", path, Origin="http://evil.example")[0] == 403
    for path in ("/done", "/mask?picture=0"):
        assert ask(url, "POST", path, {}, Origin=None)[0] == 403
        assert ask(url, "POST", path, {}, Origin="http://evil.example")[0] == 403
        assert ask(url, "POST", path, {}, Host="evil.example")[0] == 403


def test_what_is_no_mark_is_refused_and_the_page_goes_on(page):
    url, _ = page
    for path in ("/picture?picture=2", "/picture?picture=-1", "/../settings.py", "/none"):
        assert ask(url, "GET", path)[0] == 404
    for entry in ({"box": [1]}, {"box": [900, 1, 3, 4]}, {"object": 3}, [1], "x", {"a": 1}):
        assert ask(url, "POST", "/mask?picture=0", entry)[0] == 400
    assert ask(url, "POST", "/mask?picture=7", {"box": [1, 2, 30, 40]})[0] == 404
    status, data = ask(url, "POST", "/mask?picture=0", {"box": [30, 20, 95, 85]})
    assert status == 200
    shade = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert shade.shape == (120, 160, 4)
    assert json.loads(ask(url, "GET", "/pictures")[1])[1]["name"] == "camera, frame 1"


class Browser:
    """A headless Chromium, driven by its own protocol."""

    def __init__(self, folder):
        self.process = subprocess.Popen(
            [CHROMIUM, *FLAGS, f"--user-data-dir={folder}", "about:blank"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        file, end = folder / "DevToolsActivePort", time.monotonic() + 60.0
        while not (file.is_file() and file.read_text().strip()) and time.monotonic() < end:
            time.sleep(0.1)
        self.port = int(file.read_text().split()[0])
        self.count = 0

    async def open(self):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)
        connection.request("GET", "/json")
        targets = json.loads(connection.getresponse().read())
        (target,) = [one for one in targets if one["type"] == "page"]
        self.socket = await websocket_connect(target["webSocketDebuggerUrl"])

    async def call(self, method, **parameters):
        self.count += 1
        await self.socket.write_message(
            json.dumps({"id": self.count, "method": method, "params": parameters})
        )
        while True:
            answer = json.loads(await self.socket.read_message())
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]

    async def tell(self, expression):
        """The value of an expression in the page."""
        found = await self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        return found["result"].get("value")

    async def until(self, expression):
        for _ in range(300):
            if await self.tell(expression):
                return
            await asyncio.sleep(0.1)
        raise AssertionError(expression)

    async def drag(self, *points):
        """Draws through points of the picture [pixel]."""
        left, top = await self.tell("(b => [b.left, b.top])(drawn_canvas())")
        kinds = ["mousePressed", *["mouseMoved"] * (len(points) - 1), "mouseReleased"]
        for kind, (x, y) in zip(kinds, [*points, points[-1]], strict=True):
            await self.call(
                "Input.dispatchMouseEvent", type=kind, x=left + x, y=top + y, button="left",
                buttons=1, clickCount=1,
            )  # fmt: skip


async def mark(browser, url):
    """Boxes in both pictures, a line beside the object in the second one."""
    await browser.open()
    await browser.call("Page.enable")
    await browser.call("Page.navigate", url=url)
    await browser.until("typeof pictures !== 'undefined' && pictures.length === 2")
    await browser.until("document.getElementById('picture').naturalWidth === 160")
    await browser.tell(
        "window.drawn_canvas = () => document.getElementById('drawn').getBoundingClientRect()"
    )
    shown = "!document.getElementById('shade').hidden && document.getElementById('shade').complete"
    await browser.drag((30, 20), (80, 60), (125, 105))
    await browser.until(shown)
    await browser.tell("document.getElementById('next').click()")
    await browser.until("here === 1 && document.getElementById('shade').hidden")
    await browser.drag((30, 20), (80, 60), (135, 105))
    await browser.until(shown)
    await browser.tell("document.querySelector('input[value=background]').click()")
    await browser.drag((33, 24), (130, 24))
    await browser.until(
        "drawn[1].length === 2 && document.getElementById('said').textContent !== '...'"
    )
    await browser.tell("document.getElementById('done').click()")
    await browser.until("document.body.textContent.includes('can be closed')")


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
def test_masks_are_drawn_in_a_real_browser(page, stills, tmp_path):
    url, work = page
    browser = Browser(tmp_path / "profile")
    try:
        asyncio.run(mark(browser, url))
    finally:
        browser.process.terminate()
        browser.process.wait(20)
    work.join(30.0)
    assert not work.is_alive()
    made = load_scene(tmp_path / "out")
    for frame, true in stills[1].items():
        assert iou(made.read("camera", frame), true) > 0.97
    marks = read_strokes(tmp_path / "out" / "strokes.yaml")
    assert marks["", "0"].box == pytest.approx((29.5, 19.5, 95.0, 85.0), abs=1.1)
    assert len(marks["", "1"].background) == 1
    again = make_masks(
        stills[0], tmp_path / "again", MaskSettings(strokes=tmp_path / "out" / "strokes.yaml")
    )
    assert again.count == 2
