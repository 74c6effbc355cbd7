"""Sums of groups of cameras are the sum of all cameras."""

import numpy as np
import pytest

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.camera.models import circle_of_cameras
from drake_pose.fit.contour_fit import (
    ContourFit,
    SumRequest,
    Views,
    add_cameras,
    add_sums,
    answer_request,
    compare_placed,
    pack_cameras,
    pack_request,
    pack_sum,
    pack_surfaces,
    pack_views,
    unpack_sum,
    unpack_surfaces,
)
from drake_pose.fit.evidence import NO_EDGE, find_edge_points, pack_evidence
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.silhouette.areas.scoring import draw_mask

STEPS = (AnnealingStage(0.08, 0.06), AnnealingStage(0.04, 0.06), AnnealingStage(0.02, 0.05))
GROUPS = ((0, 2, 5), (1,), (3, 4))


class World:
    """A person before six cameras, of which one sees nobody."""

    def __init__(self):
        tree = load_model(bundled_model("person"), check=False).pose_tree()
        self.fit = ContourFit(tree)
        self.values = self.fit.kinematics.flatten(tree.default_values())
        self.cameras = list(circle_of_cameras(6, size=(320, 240), face_camera=False).values())
        X_WN = self.fit.kinematics.poses(self.values)
        self.edges = [
            find_edge_points(draw_mask(self.fit.outlines, camera.X_CW @ X_WN, camera), 4.0)
            for camera in self.cameras
        ]
        self.edges[4] = NO_EDGE
        self.start = self.values + np.random.default_rng(1).uniform(-0.1, 0.1, len(self.values))
        self.start = np.clip(self.start, self.fit.lower, self.fit.upper)

    def part(self, index, placement, step):
        """What some cameras say, as one who has only these would."""
        cameras = pack_cameras([self.cameras[k] for k in index])
        views = Views(cameras, pack_evidence([self.edges[k] for k in index]))
        weights = self.fit.weights(cameras, placement, step)
        return add_cameras(*compare_placed(placement.packed, placement.X_WN, views, weights))

    def grouped(self, placement, step):
        parts = [self.part(index, placement, step) for index in GROUPS]
        return add_sums(parts, len(placement.X_WN))


@pytest.fixture(scope="module")
def world():
    return World()


def test_groups_say_what_all_cameras_say(world):
    compared = world.fit.compare(pack_views(world.cameras, world.edges), world.start, STEPS[0])
    grouped = world.grouped(compared.placement, STEPS[0])
    for all_at_once, of_groups in zip(compared.total, grouped, strict=True):
        scale = np.abs(all_at_once).max()
        np.testing.assert_allclose(of_groups, all_at_once, rtol=0.0, atol=1e-13 * scale)
    assert scale > 0.0


def test_nothing_is_lost_on_the_way(world):
    placement = world.fit.body.place(world.start)
    index = GROUPS[0]
    cameras = pack_cameras([world.cameras[k] for k in index])
    weights = world.fit.weights(cameras, placement, STEPS[1])
    times = 0.1 + np.arange(len(index)) / 3.0
    kept = {(10 + k, t): world.edges[k] for k, t in zip(index, times, strict=True)}
    request = SumRequest(
        [world.cameras[k].name for k in index], times, cameras, weights, placement.packed,
        placement.X_WN,
    )  # fmt: skip
    data = pack_request(request, [10 + k for k in index])
    surfaces = unpack_surfaces(pack_surfaces(placement.packed))
    for sent, got in zip(placement.packed, surfaces, strict=True):
        np.testing.assert_array_equal(sent, got)
        assert sent.dtype == got.dtype
    answer = answer_request(data, surfaces, lambda k, t: kept.get((k, t)))
    assert answer is not None
    here = world.part(index, placement, STEPS[1])
    for one, two in zip(unpack_sum(pack_sum(answer)), here, strict=True):
        np.testing.assert_array_equal(one, two)
        assert one.flags.c_contiguous
        assert one.flags.writeable
    del kept[10 + index[1], times[1]]
    assert answer_request(data, surfaces, lambda k, t: kept.get((k, t))) is None
