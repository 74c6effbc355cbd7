"""What many cameras cost the process in the middle, measured with simulated views.

Workers' sums come from another process, by the connection and the bytes of real workers; so what is
counted here is the middle's own: views taken in, sums asked for and added, the fit, the diagram.
"""

from __future__ import annotations

import multiprocessing
import pickle
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.camera.models import Camera
from drake_pose.camera.rigs import circle_of_cameras
from drake_pose.camera.sources.frame_source import FrameSource, SourceSpecification, TimedPicture
from drake_pose.errors import ClusterError
from drake_pose.fit.surfaces import FEW, few_triangles
from drake_pose.jobs.cluster.camera_worker import EdgeServer, WatchReply, WatchRequest
from drake_pose.jobs.cluster.lines import Answer, Line, Listening, serve
from drake_pose.jobs.cluster.remote_keeper import RemoteKeeper
from drake_pose.jobs.live.run import FrameWatch, LiveFrame
from drake_pose.person.date.skeleton import load_skeleton
from drake_pose.person.date.walking_motion import make_motion
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.shape import tracker_of_person
from drake_pose.person.views import (
    FrameViews,
    KeptEdge,
    edge_spacing,
    pack_view,
    see_silhouette,
    unpack_view,
)
from drake_pose.silhouette.areas.bending import TreeSurfaces
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.systems.person.live_capture import add_person_tracker
from drake_pose.systems.person.silhouette_sensor import RemoteSensors

Array = NDArray[np.float64]

_HOST = "127.0.0.1"
_RATE_HZ = 30.0
_FRAMES, _MOTION_FRAMES = 30, 360
# Until the workers' process has loaded everything [s].
_PATIENCE = 120.0
_TASKS = 50
# As often as a capture looks for replies [s].
_POLL_PAUSE = 0.0005


@dataclass(frozen=True, eq=False)
class CentreFigures:
    """What following a person costs the process in the middle.

    Args:
        cameras: how many.
        groups: into so many they are divided; 0: this process compares all contours.
        seconds: of the processor in this process, a frame in the median [s].
        q: (frames, nq) the poses found.
        sum_bytes: of one worker's sums and the requests for them, a frame.
    """

    cameras: int
    groups: int
    seconds: float
    q: Array
    sum_bytes: float = 0.0


class SimulatedViews:
    """What cameras around a person would send.

    Attributes:
        cameras: by name.
        packed: by camera, a view a frame.
        tracker: of the person.
        first: (nq,) the person's true pose in the first frame.

    Args:
        count: of cameras.
        frames: how many.
    """

    def __init__(self, count: int, frames: int = _FRAMES) -> None:
        model = load_model(bundled_model("person"), check=False)
        poses = make_motion(load_skeleton(model), _MOTION_FRAMES, 0).q[:frames]
        self.first = poses[0]
        self.tracker: PersonPoseTracker = tracker_of_person(model.pose_tree(), None)
        self.cameras: dict[str, Camera] = dict(circle_of_cameras(count, face_camera=False))
        fit = self.tracker.fit
        outlines = few_triangles(TreeSurfaces(fit.tree), FEW)
        placed = [fit.kinematics.poses(self.tracker.values(q)) for q in poses]
        self.packed = {
            name: [
                pack_view(
                    see_silhouette(
                        draw_mask(outlines, camera.X_CW @ X_WN, camera), edge_spacing(camera)
                    )
                )
                for X_WN in placed
            ]
            for name, camera in self.cameras.items()
        }

    def fewer(self, count: int) -> SimulatedViews:
        """Of so many of the cameras, as far as possible all around."""
        names = list(self.cameras)
        index = np.linspace(0, len(names), count, endpoint=False).astype(int)
        one = object.__new__(SimulatedViews)
        one.first, one.tracker = self.first, self.tracker
        one.cameras = {names[k]: self.cameras[names[k]] for k in index}
        one.packed = {name: self.packed[name] for name in one.cameras}
        return one


class _PackedSource(FrameSource):
    """Gives views that are packed already."""

    def __init__(self, camera: Camera, views: Sequence[bytes]) -> None:
        size = camera.width, camera.height
        super().__init__(SourceSpecification(camera.name, "folder", "simulated", *size, _RATE_HZ))
        self._views, self._next = views, 0

    @property
    def ended(self) -> bool:
        return self._next >= len(self._views)

    def close(self) -> None:
        """Nothing is held open."""

    def _read(self) -> TimedPicture | None:
        if self.ended:
            return None
        k, self._next = self._next, self._next + 1
        packed = np.frombuffer(self._views[k], dtype=np.uint8)
        return TimedPicture(_time(k), str(k), packed)


def measure_centre(views: SimulatedViews, groups: int) -> CentreFigures:
    """Follows the person by views of some groups of cameras; 0 groups: all in this process."""
    with _keepers(views, groups) as keepers:
        sources = {
            name: _PackedSource(camera, views.packed[name])
            for name, camera in views.cameras.items()
        }
        sensors = RemoteSensors(sources, views.cameras, keepers=keepers)
        asked = {keeper: keeper.bytes for keeper in keepers.values()}
        seconds, q = _follow(views, sensors, set(keepers.values()))
        size = sum(keeper.bytes - before for keeper, before in asked.items())
    size_of_one = size / (len(q) * max(groups, 1))
    return CentreFigures(len(views.cameras), groups, float(np.median(seconds)), q, size_of_one)


def measure_polls(groups: int, cameras: int, view_bytes: float) -> float:
    """What it costs the centre to ask workers once for what their cameras see, all of them [s].

    Args:
        groups: how many workers.
        cameras: how many of them all.
        view_bytes: of one view.
    """
    names = [str(k) for k in range(cameras // groups)]
    view = (0.0, "0", secrets.token_bytes(round(view_bytes)))
    counts = dict.fromkeys(names, 0)
    rates: dict[str, float | None] = dict.fromkeys(names, _RATE_HZ)
    reply = WatchReply(dict.fromkeys(names, (view,)), dropped=counts, rates=rates)
    specifications = tuple(SourceSpecification(name, "folder", "", 640, 480) for name in names)
    after = dict.fromkeys(names, 0.0)
    request = WatchRequest("", specifications, after, after, 1, 0.0)
    with _child(_serve_polls, groups, pickle.dumps(reply)) as listening:
        lines = [Line(_HOST, port, listening.key) for port in listening.ports]
        _ask_all(lines, request)
        begin = time.process_time()
        for _ in range(_TASKS):
            _ask_all(lines, request)
        seconds = (time.process_time() - begin) / _TASKS
        for line in lines:
            line.close()
    return seconds


def _ask_all(lines: Sequence[Line], request: WatchRequest) -> None:
    """Asks all workers, as soon as they are connected, and takes their replies."""
    for line in lines:
        while not line.send(pickle.dumps(request)):
            time.sleep(_POLL_PAUSE)
    waiting = list(lines)
    while waiting:
        replies = [line.receive() for line in waiting]
        for data in replies:
            if data is not None:
                pickle.loads(data)
        waiting = [line for line, data in zip(waiting, replies, strict=True) if data is None]
        time.sleep(_POLL_PAUSE)


def _follow(
    views: SimulatedViews, sensors: RemoteSensors, keepers: set[RemoteKeeper]
) -> tuple[list[float], Array]:
    """The processor's seconds of each frame but the first, and all poses."""
    builder = DiagramBuilder()
    builder.AddNamedSystem("remote_sensors", sensors)
    silhouettes = {name: sensors.GetOutputPort(f"silhouette_{name}") for name in views.cameras}
    system = add_person_tracker(
        builder,
        views.tracker,
        views.cameras,
        silhouettes,
        sensors.period,
        sensors.GetOutputPort("time"),
    )
    for name, port in silhouettes.items():
        builder.ExportOutput(port, f"silhouette_{name}")
    for index in range(system.num_output_ports()):
        port = system.get_output_port(index)
        builder.ExportOutput(port, port.get_name())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = system.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    tracker = views.tracker
    system.set_person(context, tracker.start(tracker.values(views.first)))
    frames: list[LiveFrame] = []
    simulator.set_monitor(FrameWatch(diagram, views.cameras, frames.append))
    seconds = []
    rounds, count = len(tracker.schedule.follow), len(next(iter(views.packed.values())))
    for k in range(count):
        answers = sum(keeper.answers for keeper in keepers)
        begin = time.process_time()
        simulator.AdvanceTo((k + 0.5) * sensors.period)
        seconds.append(time.process_time() - begin)
        if sum(keeper.answers for keeper in keepers) - answers < rounds * len(keepers):
            raise ClusterError(f"a worker did not answer in frame {k}; measure an idle machine")
    return seconds[1:], np.array([frame.q for frame in frames])


@contextmanager
def _keepers(views: SimulatedViews, groups: int) -> Iterator[Mapping[str, RemoteKeeper]]:
    """By camera, who has its edges: another process, in so many groups."""
    if not groups:
        yield {}
        return
    names = [list(part) for part in np.array_split(np.array(list(views.cameras)), groups)]
    names = [[str(name) for name in group] for group in names]
    packed = [{name: views.packed[name] for name in group} for group in names]
    keepers = {}
    with _child(_serve_sums, packed) as listening:
        for group, port in zip(names, listening.ports, strict=True):
            keeper = RemoteKeeper(group, print)
            keeper.move_to(Line(_HOST, port, listening.key))
            keepers.update(dict.fromkeys(group, keeper))
        try:
            _connect(views, keepers)
            yield keepers
        finally:
            for keeper in set(keepers.values()):
                keeper.close()


@contextmanager
def _child(function: Callable[..., None], *arguments: object) -> Iterator[Listening]:
    """Another process, and where it listens."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=function, args=(there, *arguments), daemon=True)
    process.start()
    there.close()
    try:
        yield here.recv()
    finally:
        here.close()
        process.join()


def _connect(views: SimulatedViews, keepers: Mapping[str, RemoteKeeper]) -> None:
    """Asks until everybody answers."""
    tracker, end = views.tracker, time.monotonic() + _PATIENCE
    last = tracker.start(tracker.values(views.first))
    seen = [
        unpack_view(views.packed[name][0], KeptEdge(keeper, name, _time(0)))
        for name, keeper in keepers.items()
    ]
    while not all(keeper.answers for keeper in keepers.values()):
        if time.monotonic() > end:
            raise ClusterError("the simulated workers do not get ready")
        tracker.follow(last, FrameViews(list(views.cameras.values()), seen))


def _serve_sums(pipe: Connection, groups: Sequence[Mapping[str, Sequence[bytes]]]) -> None:
    """Serves the edges of all groups until the pipe is closed."""
    servers = [EdgeServer(len(group)) for group in groups]
    for server, group in zip(servers, groups, strict=True):
        for number, views in enumerate(group.values()):
            for k, data in enumerate(views):
                server.put(number, _time(k), unpack_view(data).edge)
    _serve(pipe, [server.answer for server in servers])


def _serve_polls(pipe: Connection, groups: int, reply: bytes) -> None:
    """Answers every poll alike until the pipe is closed."""
    _serve(pipe, [lambda _: reply] * groups)


def _serve(pipe: Connection, answers: Sequence[Answer]) -> None:
    """Says where it listens, and answers until the pipe is closed."""
    closed = threading.Event()
    pipe.send(serve(_HOST, answers, closed))
    with suppress(EOFError):
        pipe.recv()
    closed.set()


def _time(frame: int) -> float:
    """A frame's time stamp [s]."""
    return frame / _RATE_HZ
