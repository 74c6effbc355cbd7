"""Sums over cameras by a connection: the same answer, whoever adds up; no waiting for the dead."""

import os
import threading
import time

import numpy as np
import psutil
import pytest
import zmq

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import ClusterError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.jobs.cluster.camera_worker import EdgeServer
from drake_pose.jobs.cluster.lines import Line, RemoteKeeper, serve
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.views import FrameViews, KeptEdge, pack_view, see_silhouette, unpack_view
from drake_pose.silhouette.areas.scoring import draw_mask

HOST = "127.0.0.1"
TIME = 1.0 / 3.0


class World:
    """A person before four cameras, and the person a moment before."""

    def __init__(self):
        self.tracker = PersonPoseTracker(
            ContourFit(load_model(bundled_model("person"), check=False).pose_tree())
        )
        fit = self.tracker.fit
        self.cameras = list(circle_of_cameras(4, size=(160, 120), face_camera=False).values())
        self.names = [camera.name for camera in self.cameras]
        self.before = fit.kinematics.flatten(fit.tree.default_values())
        now = self.before + np.random.default_rng(0).uniform(-0.03, 0.03, len(self.before))
        X_WN = fit.kinematics.poses(np.clip(now, fit.lower, fit.upper))
        masks = [draw_mask(fit.outlines, camera.X_CW @ X_WN, camera) for camera in self.cameras]
        self.views = [see_silhouette(mask, 4.0) for mask in masks]
        self.here = self.follow(self.views)

    def follow(self, views):
        return self.tracker.follow(self.tracker.start(self.before), FrameViews(self.cameras, views))

    def kept(self, *keepers):
        """Packed views whose edges are kept: of the first two cameras, and of the others."""
        return [
            unpack_view(
                pack_view(view),
                None if keepers[k // 2] is None else KeptEdge(keepers[k // 2], self.names[k], TIME),
            )
            for k, view in enumerate(self.views)
        ]

    def server(self, group):
        """A server that has the edges of two cameras."""
        server = EdgeServer(2)
        for k in range(2):
            server.put(k, TIME, self.views[2 * group + k].edge)
        return server

    def keeper(self, group, answer, closed, reports):
        """Who asks for two cameras' sums, when it is answered for the first time or gives up."""
        listening = serve(HOST, [answer], closed)
        keeper = RemoteKeeper(self.names[2 * group : 2 * group + 2], reports.append)
        keeper.move_to(Line(HOST, listening.ports[0], listening.key))
        groups = [keeper if k == group else None for k in range(2)]
        for _ in range(2000):
            self.follow(self.kept(*groups))
            if keeper.answers or reports:
                return keeper
            time.sleep(0.01)
        raise AssertionError("never connected")

    def same(self, state):
        np.testing.assert_allclose(state.values, self.here.values, rtol=0.0, atol=1e-9)
        assert state.share == pytest.approx(self.here.share, abs=1e-9)


@pytest.fixture(scope="module")
def world():
    return World()


@pytest.fixture
def closed():
    event = threading.Event()
    yield event
    event.set()


def test_the_answer_is_that_of_one_process_which_unpacks_nothing(world, closed):
    reports = []
    keepers = [world.keeper(k, world.server(k).answer, closed, reports) for k in range(2)]
    asked = [keeper.answers for keeper in keepers]
    views = world.kept(*keepers)
    world.same(world.follow(views))
    assert not any({"region", "edge"} & set(vars(view)) for view in views)
    rounds = len(world.tracker.schedule.follow)
    assert [keeper.answers - n for keeper, n in zip(keepers, asked, strict=True)] == [rounds] * 2
    # One group's edges are in this process.
    world.same(world.follow(world.kept(keepers[0], None)))
    assert not reports
    for keeper in keepers:
        keeper.move_to(None)


def test_moments_that_are_not_kept_are_compared_here_and_old_ones_are_forgotten(world, closed):
    reports = []
    server = world.server(0)
    keeper = world.keeper(0, server.answer, closed, reports)
    for k in range(100):
        server.put(1, 10.0 + k, world.views[0].edge)
    assert server.find(1, 109.0) is world.views[0].edge
    assert server.find(1, TIME) is None
    before = keeper.answers
    world.same(world.follow(world.kept(keeper, None)))
    assert keeper.answers == before
    assert not reports
    keeper.move_to(None)


def test_an_answer_that_nobody_took_is_not_taken_for_another(closed):
    def echo(parts):
        time.sleep(0.2 if parts[0] == b"late" else 0.0)
        return parts[0]

    listening = serve(HOST, [echo], closed)
    line = Line(HOST, listening.ports[0], listening.key)
    while not line.send(b"late"):
        time.sleep(0.01)
    assert line.receive(0.02) is None
    end = time.monotonic() + 10.0
    while not line.send(b"next") and time.monotonic() < end:
        time.sleep(0.01)
    assert line.receive(5.0) == b"next"
    line.close()


def test_nobody_waits_for_the_silent(world, closed):
    reports, server = [], world.server(1)
    silent = threading.Event()

    def answer(parts):
        if silent.is_set():
            closed.wait()
        return server.answer(parts)

    keeper = world.keeper(1, answer, closed, reports)
    silent.set()
    views = world.kept(None, keeper)
    begin = time.monotonic()
    world.same(world.follow(views))
    assert time.monotonic() - begin > 0.4
    assert len(reports) == 1
    assert "sums of camera 'camera_2', 'camera_3' do not come in time" in reports[0]
    begin = time.monotonic()
    world.same(world.follow(views))
    assert time.monotonic() - begin < 0.4, "it is not asked again at once"
    keeper.move_to(None)


def test_who_does_not_know_the_key_is_not_answered(world, closed):
    asked, reports, end = [], [], time.monotonic() + 0.5
    listening = serve(HOST, [asked.append], closed)
    keeper = RemoteKeeper(world.names[:2], reports.append)
    keeper.move_to(Line(HOST, listening.ports[0], zmq.curve_keypair()[0]))
    while time.monotonic() < end:
        world.same(world.follow(world.kept(keeper, None)))
    assert not asked
    assert not keeper.answers
    keeper.move_to(None)


def test_a_server_listens_at_its_own_address_alone(closed):
    listening = serve(HOST, [lambda parts: b"", lambda parts: b""], closed)
    open_at = {
        one.laddr.port: one.laddr.ip
        for one in psutil.Process(os.getpid()).net_connections(kind="inet")
        if one.status == psutil.CONN_LISTEN
    }
    assert [open_at[port] for port in listening.ports] == [HOST, HOST]
    with pytest.raises(ClusterError, match=r"192\.0\.2\.1"):
        serve("192.0.2.1", [lambda parts: b""], threading.Event())
