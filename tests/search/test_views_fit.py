"""Pose sets from damaged masks: intervals, undetermined joints, flips, self-motions."""

import cv2
import numpy as np
import pytest
from scipy.stats import t as student

from drake_pose.body import load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.fit.covariance import Distances, estimate_sizes, values_covariance, vuong_statistic
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import simplify_surfaces
from drake_pose.search import View, ViewsFit, views_fit
from drake_pose.search.self_motions import Flip
from drake_pose.search.views_fit import (
    FittedPose,
    RobustModes,
    RobustSettings,
    distinct,
    refine_best,
)
from drake_pose.silhouette.outline import TreeSurfaces
from tests.body.models import joint, link, urdf, write
from tests.search.arms import arm_cameras, damaged_views, draw_view, is_held

TRUTH = np.array([0.6, 0.7, -0.7, 0.9, 0.3])
FINE = tuple(AnnealingStage(scale, 0.0125, 8) for scale in (0.025, 0.0125))


def find(kinematics, views, values, settings=None):
    fit = ViewsFit(kinematics, simplify_surfaces(TreeSurfaces(kinematics.tree)), views)
    modes = RobustModes(fit, lambda: True, settings)
    return modes.find([fit.refine(values, FINE)], lambda values: float(values[0]))


@pytest.fixture(scope="module")
def kinematics(tree):
    return TreeKinematics(tree)


def test_intervals_contain_the_true_values_and_widen_with_damage(kinematics):
    tree = kinematics.tree
    clean = [draw_view(tree, TRUTH, camera) for camera in arm_cameras(640, 480)]
    widths = []
    for views in (clean, damaged_views(tree, TRUTH, 1)):
        answer = find(kinematics, views, TRUTH)
        assert is_held(answer, TRUTH)
        mode = answer.modes[0]
        assert mode.J == mode.q[0]
        widths.append([one.high - one.low for one in mode.joints])
        for one, value in zip(mode.joints, mode.q, strict=True):
            assert one.holds(value)
    assert np.all(np.array(widths[0]) < np.radians(10.0))
    # Also without damage an error of a pixel in each camera is assumed.
    assert np.median(np.array(widths[1]) / widths[0]) > 1.03


def test_a_turn_about_an_axis_of_symmetry_is_not_determined(tmp_path):
    """A cylinder's turn about its axis is invisible: its interval is the whole range."""
    box, cylinder = '<box size="0.1 0.2 0.6"/>', '<cylinder radius="0.05" length="0.3"/>'
    shape = '<visual><origin xyz="0 0 {}"/><geometry>{}</geometry></visual>'
    tilts, spins = 'lower="-1.5" upper="1.5"', 'lower="-2" upper="2.5"'
    text = urdf(
        link("boom", shape.format(0.3, box)),
        link("knob", shape.format(0.15, cylinder)),
        joint("tilt", "revolute", "world", "boom", origin="", axis="1 0 0", limits=tilts),
        joint("spin", "revolute", "boom", "knob", origin='xyz="0 0 0.6"', limits=spins),
    )
    tree = load_model(write(tmp_path, text)).pose_tree()
    values = np.array([0.4, 0.2])
    views = [draw_view(tree, values, camera) for camera in arm_cameras()]
    tilt, spin = find(TreeKinematics(tree), views, values).joints
    assert tilt.determined
    assert tilt.holds(0.4)
    assert not spin.determined
    assert (spin.low, spin.high) == (-2.0, 2.5)


def test_refinement_respects_limits_and_held_values(kinematics):
    views = [draw_view(kinematics.tree, TRUTH, camera) for camera in arm_cameras()]
    fit = ViewsFit(kinematics, simplify_surfaces(TreeSurfaces(kinematics.tree)), views)
    outside = kinematics.upper + 0.5
    found = fit.refine(outside, FINE, held=(1,))
    assert found.values[1] == outside[1]
    free = [0, 2, 3, 4]
    assert (found.values[free] <= kinematics.upper[free]).all()
    assert (found.values[free] >= kinematics.lower[free]).all()
    start = TRUTH + np.array([0.05, -0.05, 0.04, 0.05, -0.05])
    near = fit.refine(start, FINE)
    assert near.cost < 0.2 * fit.cost(start, FINE[-1])
    assert np.abs(near.values - TRUTH).max() < np.radians(1.5)


@pytest.mark.parametrize("stage", [FINE[-1], AnnealingStage(0.1, 0.04, 6)])
def test_costs_are_one_for_each_pixel_of_contour_that_is_far_off(kinematics, stage):
    """Of both contours; a shift by more than the scale costs about half, a small one its square."""
    tree, cameras = kinematics.tree, arm_cameras(640, 480)
    outlines = simplify_surfaces(TreeSurfaces(tree))
    masks = [draw_view(tree, TRUTH, camera).mask for camera in cameras]
    contours = [cv2.findContours(m.view(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
                for m in masks]  # fmt: skip
    length = sum(cv2.arcLength(one, True) for found in contours for one in found)
    size = np.sqrt(np.mean([mask.sum() for mask in masks]))
    scale, costs = stage.scale * size, []
    for by in (0.0, 0.1 * scale, 0.2 * scale, 1.7 * scale, 200.0):
        moved = [np.roll(mask, round(by), axis=1) for mask in masks]
        views = [View(*pair) for pair in zip(cameras, moved, strict=True)]
        fit = ViewsFit(kinematics, outlines, views)
        costs.append(fit.cost(TRUTH, stage))
        tiles = fit.tile_costs(TRUTH, stage)
        assert tiles.sum() == pytest.approx(costs[-1])
        assert (fit.evaluations, fit.camera_count) == (2, 2)
    # Tiles along the contours, with sides of a fifth of the size.
    assert 0.8 < np.count_nonzero(tiles) / (2.0 * length / (0.2 * size)) < 1.6
    assert fit.size == pytest.approx(size)
    assert fit.edge_length == pytest.approx(length, rel=0.1)
    assert costs[4] == pytest.approx(2.0 * fit.edge_length, rel=0.05)
    assert 0.35 < costs[3] / costs[4] < 0.55
    assert costs[0] < 0.05 * costs[4]
    if scale > 5.0:
        assert 3.0 < (costs[2] - costs[0]) / (costs[1] - costs[0]) < 4.5
        rough = tuple(outlines[::-1])
        # Stages of a large spacing compare the rough surfaces.
        other = ViewsFit(kinematics, outlines, views, rough)
        assert other.cost(TRUTH, FINE[-1]) == fit.cost(TRUTH, FINE[-1])
        assert other.cost(TRUTH, stage) != fit.cost(TRUTH, stage)


def test_only_the_best_distinct_starts_are_refined_further(kinematics):
    views = [draw_view(kinematics.tree, TRUTH, camera) for camera in arm_cameras()]
    fit = ViewsFit(kinematics, simplify_surfaces(TreeSurfaces(kinematics.tree)), views)
    near, far = TRUTH + 0.05, TRUTH - np.array([0.0, 1.2, 0.0, 1.2, 0.0])
    passes = [(FINE[:1], 3), (FINE[1:], 2)]
    best, other = refine_best(fit, [far, near, near + 0.01], passes, lambda: True)
    np.testing.assert_allclose(best.values, TRUTH, atol=0.02)
    assert np.abs(other.values - TRUTH).max() > 0.3
    assert best.cost == pytest.approx(fit.cost(best.values, FINE[-1]), rel=0.3)
    # Without time the first start alone is refined.
    (late,) = refine_best(fit, [far, near], passes, lambda: False)
    np.testing.assert_allclose(late.values, other.values, atol=0.1)


def test_distinct_keeps_the_best_of_equal_poses():
    places = ((0.0, 3), (0.01, 1), (1.0, 2), (1.049, 4), (2.0 * np.pi, 5))
    poses = [FittedPose(np.array([x, 0.0]), cost) for x, cost in places]
    assert [pose.cost for pose in distinct(poses, 5)] == [1, 2, 5]
    assert [pose.cost for pose in distinct(poses, 5, np.array([True, False]))] == [1, 2]
    assert [pose.cost for pose in distinct(poses, 5, apart=0.03)] == [1, 2, 4, 5]
    assert [pose.cost for pose in distinct(poses, 1)] == [1]


class Valley:
    """A fit whose costs are known: a valley about a pose along ``along``, with defects of masks.

    The cost of a pose that is off by d along the valley is d^2 / width^2 in each of 100 tiles;
    defects of the masks move `scatter` from one tile to another.
    """

    edge_length, camera_count = 1000.0, 2

    def __init__(self, kinematics, along, deviation, width, scatter=0.2, truth=TRUTH):
        self.kinematics, self.along, self.truth = kinematics, np.array(along, float), truth
        self.index = int(np.argmax(np.abs(self.along)))
        self.deviation, self.width, self.scatter = deviation, width, scatter
        self.started = []

    def tile_costs(self, values, stage):
        d = float((values - self.truth)[self.index] / self.along[self.index])
        costs = np.full(100, 1.0 + (d / self.width) ** 2)
        costs[:50] += self.scatter * (d != 0.0)
        costs[50:] -= self.scatter * (d != 0.0)
        return costs

    def refine(self, values, stages, held=()):
        self.started.append(values - self.truth)
        (k,) = held or (self.index,)
        d = (values - self.truth)[k] / self.along[k]
        return FittedPose(self.truth + d * self.along)

    def distances(self, values, stage):
        rng, count = np.random.default_rng(0), 40
        across = np.eye(5) - np.outer(self.along, self.along) / (self.along @ self.along)
        X = rng.normal(0.0, 300.0, (count, 5)) @ across
        X += (
            rng.normal(0.0, 1.0 / self.deviation / np.sqrt(count), (count, 1))
            * self.along
            / (self.along @ self.along)
        )
        effects = np.array([np.eye(count)] * 2 + [np.zeros((count, count))] * 3)
        y, pictures = rng.normal(size=count), np.zeros(count, int)
        return Distances(y, X, effects, X.T @ X, np.zeros((count, 60)), pictures)


def covariance_of(valley):
    residuals = valley.distances(TRUTH, None)
    sizes = estimate_sizes(residuals, valley.kinematics.is_angle)
    return values_covariance(residuals, sizes, np.arange(5), valley.kinematics.is_angle)


def test_narrow_intervals_are_students(kinematics):
    """With six degrees of freedom for each camera, and within the limits."""
    valley = Valley(kinematics, [1.0, 0.5, 0.0, 0.0, 0.0], 0.004, 0.02)
    found = RobustModes(valley, lambda: True).around(TRUTH, 7.0)
    widths = student.ppf(0.975, 12) * np.sqrt(np.diag(covariance_of(valley)))
    assert widths.max() < np.radians(3.0)
    (mode,) = found.modes
    np.testing.assert_allclose([one.low for one in mode.joints], TRUTH - widths)
    np.testing.assert_allclose([one.high for one in mode.joints], TRUTH + widths)
    assert (mode.J, mode.size, found.tolerance) == (7.0, 1, 0.0)
    assert all(found.determined)
    assert not valley.started
    # Where most of the contours do not fit, nothing is determined.
    valley.edge_length = 99.0
    assert not any(RobustModes(valley, lambda: True).around(TRUTH, 7.0).determined)


def test_wide_intervals_end_where_the_cost_grows_significantly(kinematics, monkeypatch):
    """The moved value draws the others along, as far as the covariance says at first."""
    monkeypatch.setattr(views_fit, "flips", lambda *_: [])
    along = np.array([1.0, -0.6, 0.0, 0.0, 0.3])
    valley = Valley(kinematics, along, 0.2, 1.8, scatter=1.0)
    assert RobustModes(valley, lambda: True).around(TRUTH, 0.0).joints[0].low < TRUTH[0] - 0.3
    assert not valley.started
    found = RobustModes(valley, lambda: True).find([FittedPose(TRUTH)], lambda _: 3.0)
    reach = np.linspace(1e-3, 2.0, 4000)
    best = valley.tile_costs(TRUTH, None)
    grown = [
        vuong_statistic(valley.tile_costs(TRUTH + d * along, None), best) >= 1.96 for d in reach
    ]
    end = reach[int(np.argmax(grown))]
    (mode,) = found.modes
    for k in (0, 1, 4):
        ends = np.array([mode.joints[k].low, mode.joints[k].high]) - TRUTH[k]
        np.testing.assert_allclose(ends, [-end * abs(along[k]), end * abs(along[k])], rtol=0.2)
    narrow = student.ppf(0.975, 12) * np.sqrt(np.diag(covariance_of(valley)))[2]
    assert mode.joints[2].high - TRUTH[2] == pytest.approx(narrow)
    for one in valley.started:
        np.testing.assert_allclose(one / one[0], along, atol=0.02)
    # Steps grow by a factor of 1.6 and are at most half a radian long.
    firsts = sorted({round(abs(one[0]), 6) for one in valley.started})
    assert firsts[0] < 0.5
    # Without time values are not moved, and the interval is that of the covariance.
    stuck = Valley(kinematics, along, 0.2, 1.8)
    RobustModes(stuck, lambda: False).find([FittedPose(TRUTH)], lambda _: 3.0)
    assert not stuck.started


def test_poses_as_good_are_modes_or_widen_one(kinematics, monkeypatch):
    """A pose within a mode's intervals is one of its poses; one that costs more is none."""
    monkeypatch.setattr(views_fit, "flips", lambda *_: [])
    valley = Valley(kinematics, [1.0, 0.0, 0.0, 0.0, 0.0], 0.004, 2.0, scatter=1.0)
    inside, beside, above = (TRUTH + np.eye(5)[0] * by for by in (1e-3, 0.5, 1.5))
    costs = [valley.tile_costs(one, None) for one in (TRUTH, beside, above)]
    assert vuong_statistic(costs[1], costs[0]) < 1.96 < vuong_statistic(costs[2], costs[0])
    poses = [FittedPose(one) for one in (TRUTH, inside, beside, above)]
    found = RobustModes(valley, lambda: True).find(poses, lambda values: float(values[0]))
    assert [one.J for one in found.modes] == [TRUTH[0], beside[0]]
    assert [one.size for one in found.modes] == [2, 1]
    assert found.tolerance == pytest.approx(float((costs[1] - costs[0]).sum()))
    assert not found.joints[0].determined
    assert found.joints[0].low < TRUTH[0] < beside[0] < found.joints[0].high
    # The first pose is a mode even if another one is better, and there may be no time for others.
    turned = RobustModes(valley, lambda: False).find(poses[::-1], lambda values: float(values[0]))
    assert [one.J for one in turned.modes] == [above[0]]
    few = RobustSettings(modes=1)
    assert len(RobustModes(valley, lambda: True, few).find(poses, lambda _: 0.0).modes) == 1


def test_flipped_modes_have_flipped_intervals(kinematics, monkeypatch):
    """A mirrored value's ends change sides; one that ended at a limit may extend to the new one."""
    along = np.eye(5)[1]
    narrow = Valley(kinematics, along, 0.004, 2.0, scatter=1.0)
    width = student.ppf(0.975, 12) * np.sqrt(covariance_of(narrow)[1, 1])
    truth = TRUTH.copy()
    lower, upper = kinematics.lower[1], kinematics.upper[1]
    for truth[1], at_limit in ((0.0, False), (upper - 0.5 * width, True)):
        valley = Valley(kinematics, along, 0.004, 2.0, scatter=1.0, truth=truth)
        other = truth - 0.5 * along
        for changed, mirrored in ((False, False), (True, False), (True, True)):
            flip = Flip(other, changed * along.astype(bool), mirrored * along.astype(bool))
            monkeypatch.setattr(views_fit, "flips", lambda *_, flip=flip: [flip, flip])
            find = RobustModes(valley, lambda: True).find
            first, second = find([FittedPose(truth)], lambda values: float(values[1])).modes
            # The same flip again is within the new mode.
            assert (first.J, second.J, second.size) == (truth[1], other[1], 2)
            for k in (0, 2, 3, 4):
                assert second.joints[k].holds(truth[k])
            below, above = width, (0.5 if at_limit else 1.0) * width
            if at_limit and changed:
                above = np.inf
            if mirrored:
                below, above = above, below
            ends = max(lower, other[1] - below), min(upper, other[1] + above)
            assert (second.joints[1].low, second.joints[1].high) == pytest.approx(ends)
