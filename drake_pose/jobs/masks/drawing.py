"""A page in the browser on which boxes and lines are drawn, and the masks of GrabCut shown."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np

from drake_pose.camera.picture_files import Picture
from drake_pose.errors import DrakePoseError, SettingsError
from drake_pose.jobs.live.local_proxy import listen, refuse
from drake_pose.jobs.masks.sources import Source
from drake_pose.jobs.masks.strokes import ANY_CAMERA, read_entry
from drake_pose.silhouette.segmentation.grab_cut import Strokes, cut_out

# Nobody draws in more pictures; all are kept.
_MOST = 300
# What is drawn in a picture is less [byte].
_LARGEST = 1 << 20


def draw_strokes(
    source: Source, port: int | None = None, on_page: Callable[[str], None] = lambda _: None
) -> dict[tuple[str, str], Strokes]:
    """Shows a page, and waits until its user has marked the object in pictures.

    Args:
        source: pictures.
        port: of the page, on the loopback address alone; any free one where not given.
        on_page: is told the page's address.

    Returns:
        What is marked, by camera and frame.

    Raises:
        SettingsError: too many pictures, or the port is taken.
    """
    pictures: dict[tuple[str, str], Picture] = {}
    for camera in source.names:
        for frame, _, picture in source.read(camera):
            pictures[camera, frame] = picture
            if len(pictures) > _MOST:
                raise SettingsError(
                    f"{source.path}: has more than {_MOST} pictures; nobody draws in so many: name "
                    "a folder of some of them, or find their masks another way"
                )
    desk = _Desk(pictures)
    with _serving(desk, port) as address:
        on_page(address)
        desk.done.wait()
    return desk.marks


class _Desk:
    """The pictures, and what is marked in them."""

    def __init__(self, pictures: dict[tuple[str, str], Picture]) -> None:
        self._pictures = pictures
        self._keys = list(pictures)
        self._lock = threading.Lock()
        self.marks: dict[tuple[str, str], Strokes] = {}
        self.done = threading.Event()

    def listed(self) -> list[dict[str, Any]]:
        """The pictures' names and sizes."""
        return [
            {
                "name": f"{camera or ANY_CAMERA}, frame {frame}",
                "width": picture.shape[1],
                "height": picture.shape[0],
            }
            for (camera, frame), picture in self._pictures.items()
        ]

    def picture(self, number: int) -> bytes:
        """A picture as a PNG file."""
        picture = self._pictures[self._keys[number]]
        return cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()

    def cut(self, number: int, entry: dict[str, Any]) -> bytes:
        """Keeps what is marked in a picture, and gives its mask as a PNG file: opaque around it.

        Raises:
            DrakePoseError: what is marked is no box or line, or not enough.
        """
        key = self._keys[number]
        with self._lock:
            self.marks.pop(key, None)
            strokes = read_entry(entry, f"picture {number}")
            mask = cut_out(self._pictures[key], strokes)
            self.marks[key] = strokes
        shade = np.zeros((*mask.shape, 4), dtype=np.uint8)
        shade[~mask] = (0, 0, 0, 170)
        return cv2.imencode(".png", shade)[1].tobytes()

    def forget(self, number: int) -> None:
        """Nothing is marked in a picture any more."""
        with self._lock:
            self.marks.pop(self._keys[number], None)


@contextmanager
def _serving(desk: _Desk, port: int | None) -> Iterator[str]:
    """The page's server; its address."""
    try:
        listening = listen(port)
    except OSError as error:
        raise SettingsError(
            f"port {port}: the page cannot listen there: {error.strerror}"
        ) from error
    number = listening.getsockname()[1]
    handler = type("Handler", (_Handler,), {"desk": desk, "port": number})
    server = ThreadingHTTPServer(("127.0.0.1", number), handler, False)
    server.socket.close()
    server.socket = listening
    thread = threading.Thread(target=server.serve_forever, name="drawing_page", daemon=True)
    thread.start()
    try:
        yield f"http://localhost:{number}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


class _Handler(BaseHTTPRequestHandler):
    """Answers the page's requests, and no others'."""

    desk: _Desk
    port: int

    def do_GET(self) -> None:
        """The page, the list of pictures, a picture."""
        if self._refused():
            return
        url = urlsplit(self.path)
        if url.path == "/":
            page = files("drake_pose.jobs.masks").joinpath("drawing_page.html").read_bytes()
            self._answer("text/html; charset=utf-8", page)
        elif url.path == "/pictures":
            self._answer("application/json", json.dumps(self.desk.listed()).encode())
        elif url.path == "/picture" and (number := self._number(url.query)) is not None:
            self._answer("image/png", self.desk.picture(number))
        else:
            self.send_error(404)

    def do_POST(self) -> None:
        """What is marked in a picture, or that all is."""
        # A page of another origin may send a form unasked, but not without its origin.
        if self._refused(origin=True):
            return
        url = urlsplit(self.path)
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > _LARGEST:
            self.send_error(413)
            return
        body = self.rfile.read(int(length))
        if url.path == "/done":
            self._answer("text/plain", b"")
            self.desk.done.set()
            return
        number = self._number(url.query)
        if url.path != "/mask" or number is None:
            self.send_error(404)
            return
        try:
            entry = json.loads(body)
            if entry:
                self._answer("image/png", self.desk.cut(number, entry))
            else:
                self.desk.forget(number)
                self._answer("text/plain", b"")
        except (DrakePoseError, ValueError) as error:
            self._answer("text/plain; charset=utf-8", str(error).encode(), 400)

    def _number(self, query: str) -> int | None:
        """Which picture is asked for; None: there is no such."""
        text = parse_qs(query).get("picture", [""])[0]
        known = text.isdecimal() and int(text) < len(self.desk.listed())
        return int(text) if known else None

    def _refused(self, origin: bool = False) -> bool:
        """Whether a request is not the page's own, and was answered so."""
        hosts, origins = (self.headers.get_all(name, []) for name in ("Host", "Origin"))
        refusal = refuse(hosts, origins, self.port)
        if refusal is None and origin and "Origin" not in self.headers:
            refusal = "Origin is missing"
        if refusal is not None:
            text = f"Refused: {refusal}. Open this page at http://localhost:{self.port}\n"
            self._answer("text/plain; charset=utf-8", text.encode(), 403)
        return refusal is not None

    def _answer(self, kind: str, data: bytes, status: int = 200) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(data)

    def log_message(self, format: str, *args: Any) -> None:
        """Says nothing."""
