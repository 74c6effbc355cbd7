"""Sums over cameras by a connection: the same answer, whoever adds up; no waiting for the dead."""

import threading
import time
from multiprocessing.connection import Listener

import numpy as np
import pytest

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.camera.rigs import circle_of_cameras
from drake_pose.fit.camera_sums import SumRequest
from drake_pose.fit.contour_fit import ContourFit, pack_cameras
from drake_pose.jobs.cluster.edge_server import READY, SUMS, EdgeServer, EdgeStore
from drake_pose.jobs.cluster.remote_keeper import RemoteKeeper
from drake_pose.person.silhouette_tracker import SilhouetteTracker
from drake_pose.person.silhouette_view import KeptEdge, SilhouetteView, see_silhouette
from drake_pose.person.view_packing import pack_view, unpack_view
from drake_pose.silhouette.areas.scoring import draw_mask

HOST, KEY = "127.0.0.1", b"of the watch"
TIME = 1.0 / 3.0


class World:
    """A person before six cameras, and the person a moment before."""

    def __init__(self):
        self.tracker = SilhouetteTracker(
            ContourFit(load_model(bundled_model("person"), check=False).pose_tree())
        )
        fit = self.tracker.fit
        self.cameras = list(circle_of_cameras(6, size=(320, 240), face_camera=False).values())
        self.before = fit.kinematics.flatten(fit.tree.default_values())
        now = self.before + np.random.default_rng(0).uniform(-0.03, 0.03, len(self.before))
        X_WN = fit.kinematics.poses(np.clip(now, fit.lower, fit.upper))
        masks = [draw_mask(fit.outlines, camera.X_CW @ X_WN, camera) for camera in self.cameras]
        self.views = [see_silhouette(mask, 4.0) for mask in masks]
        self.here = self.follow(self.views)

    def follow(self, views):
        return self.tracker.follow(self.tracker.start(self.before), self.cameras, views)

    def kept(self, keepers):
        """The views, whose edges keepers of two cameras each have; None: nobody else has them."""
        kept = []
        for k, view in enumerate(self.views):
            keeper = keepers[k // 2]
            whose = None if keeper is None else KeptEdge(keeper, self.cameras[k].name, TIME)
            kept.append(SilhouetteView(view.region, view.edge, whose))
        return kept

    def names(self, group):
        return [camera.name for camera in self.cameras[2 * group : 2 * group + 2]]

    def serve(self, group, key=KEY):
        """A server that has the edges of two cameras."""
        store = EdgeStore(self.names(group))
        for k in (2 * group, 2 * group + 1):
            store.put(self.cameras[k].name, TIME, self.views[k].edge)
        return EdgeServer(HOST, key, store)

    def connected(self, group, server, reports):
        keeper = RemoteKeeper(self.names(group), KEY, reports.append)
        keeper.move_to(HOST, server.port)
        for _ in range(2000):
            self.follow(self.kept([keeper if k == group else None for k in range(3)]))
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


def test_the_answer_is_that_of_one_process(world):
    reports = []
    servers = [world.serve(group) for group in range(2)]
    keepers = [world.connected(group, server, reports) for group, server in enumerate(servers)]
    asked = [keeper.answers for keeper in keepers]
    # One group's edges are in this process.
    world.same(world.follow(world.kept([*keepers, None])))
    rounds = len(world.tracker.settings.rounds)
    assert [keeper.answers - n for keeper, n in zip(keepers, asked, strict=True)] == [rounds] * 2
    assert not reports
    for one in (*keepers, *servers):
        one.close()


def test_who_adds_up_elsewhere_unpacks_nothing(world):
    reports = []
    servers = [world.serve(group) for group in range(3)]
    keepers = [world.connected(group, server, reports) for group, server in enumerate(servers)]
    views = [
        unpack_view(pack_view(view), KeptEdge(keepers[k // 2], world.cameras[k].name, TIME))
        for k, view in enumerate(world.views)
    ]
    world.same(world.follow(views))
    assert not any({"region", "edge"} & set(vars(view)) for view in views)
    for one in (*keepers, *servers):
        one.close()


def test_a_moment_that_is_not_kept_any_more_is_compared_here(world):
    reports = []
    server = world.serve(0)
    keeper = world.connected(0, server, reports)
    server._store = EdgeStore(world.names(0))
    before = keeper.answers
    world.same(world.follow(world.kept([keeper, None, None])))
    assert keeper.answers == before
    assert not reports
    keeper.close()
    server.close()


def test_an_answer_that_nobody_took_is_not_taken_for_another(world):
    server = world.serve(0)
    keeper = world.connected(0, server, [])
    placement = world.tracker.fit.body.place(world.before)
    step = world.tracker.settings.rounds[0]
    index = slice(0, 2)
    cameras = pack_cameras(world.cameras[index])
    weights = world.tracker.fit.weights(cameras, placement, step)
    times = np.full(2, TIME)
    request = SumRequest(world.names(0), times, cameras, weights, placement.packed, placement.X_WN)
    assert keeper.ask(request), "of another pose than the next one's; something fails then"
    world.same(world.follow(world.kept([keeper, None, None])))
    keeper.close()
    server.close()


class Silent:
    """Has the surfaces, and answers so many requests; then it is silent, or hangs up."""

    def __init__(self, hangs_up):
        self.listener = Listener((HOST, 0), authkey=KEY)
        self.port = self.listener.address[1]
        self.asked = threading.Event()
        self.connected = threading.Event()
        threading.Thread(target=self.run, args=(hangs_up,), daemon=True).start()

    def run(self, hangs_up):
        connection = self.listener.accept()
        assert connection.recv_bytes() == SUMS
        connection.recv_bytes()
        connection.send_bytes(READY)
        self.connected.set()
        connection.recv_bytes()
        self.asked.set()
        if hangs_up:
            connection.close()
        else:
            self.kept = connection


@pytest.mark.parametrize("hangs_up", [False, True])
def test_nobody_waits_for_the_dead(world, hangs_up):
    reports = []
    silent = Silent(hangs_up)
    keeper = RemoteKeeper(world.names(1), KEY, reports.append)
    keeper.move_to(HOST, silent.port)
    views = world.kept([None, keeper, None])
    world.same(world.follow(views))
    assert silent.connected.wait(20.0)
    time.sleep(0.2)
    begin = time.monotonic()
    world.same(world.follow(views))
    assert silent.asked.is_set()
    assert time.monotonic() - begin < 5.0
    # Who watches a worker says himself that it died.
    assert len(reports) == (not hangs_up)
    begin = time.monotonic()
    world.same(world.follow(views))
    assert time.monotonic() - begin < 0.5, "it is not asked again at once"
    keeper.close()


def test_who_does_not_know_the_key_is_not_answered(world):
    reports = []
    server = world.serve(2, b"another")
    keeper = world.connected(2, server, reports)
    assert not keeper.answers
    assert "camera 'camera_4', 'camera_5' cannot be asked for" in reports[0]
    world.same(world.follow(world.kept([None, None, keeper])))
    server.close()


def test_old_pictures_are_forgotten(world):
    store = EdgeStore(["left", "right"])
    edge = world.views[0].edge
    for k in range(100):
        store.put("right", 0.1 * k, edge)
    assert store.find(1, 0.1 * 99) is edge
    assert store.find(1, 0.0) is None
    assert store.find(0, 0.1 * 99) is None
    assert store.find(2, 0.1 * 99) is None
