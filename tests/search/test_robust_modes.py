"""Pose sets from damaged masks: intervals, undetermined joints, flips, self-motions."""

import numpy as np
import pytest
from scipy.stats import t as student

from drake_pose.body import load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.fit.covariance import (
    Distances,
    estimate_sizes,
    values_covariance,
    vuong_statistic,
)
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import simplify_surfaces
from drake_pose.search import ViewsFit, views_fit
from drake_pose.search.self_motions import Flip, flips
from drake_pose.search.views_fit import FittedPose, RobustModes, RobustSettings, distinct
from drake_pose.silhouette.outline import TreeSurfaces
from tests.body.models import joint, link, urdf, write
from tests.search.arms import arm_cameras, damaged_views, draw_view, is_held, split

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


def test_flips_are_separate_modes(kinematics):
    """If no difference is significant, all flips are modes and no value is determined."""
    tree = kinematics.tree
    views = [draw_view(tree, TRUTH, camera) for camera in arm_cameras()]
    nothing = RobustSettings(significance=1e6, modes=5)
    assert not any(find(kinematics, views, TRUTH, nothing).determined)
    answer = find(kinematics, damaged_views(tree, TRUTH, 1), TRUTH)
    flipped = [flip.values for flip in flips(kinematics, answer.modes[0].q)]
    for mode in answer.modes[1:]:
        gaps = [np.abs(mode.q - values).max() for values in flipped]
        assert min(gaps) < np.radians(15.0)


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


def test_distinct_keeps_the_best_of_equal_poses():
    poses = [FittedPose(np.array([x, 0.0]), cost) for x, cost in ((0, 3), (0.01, 1), (1, 2))]
    assert [pose.cost for pose in distinct(poses, 5)] == [1, 2]
    assert [pose.cost for pose in distinct(poses, 1)] == [1]


def poses(kinematics, values):
    """Return X_WN (nodes, 4, 4) by the pose tree instead of the compiled kinematics."""
    return kinematics.tree.node_poses(split(kinematics.tree, values))


def test_flips_keep_the_pose_of_the_last_link(kinematics):
    found = flips(kinematics, TRUTH)
    before = poses(kinematics, TRUTH)
    assert found
    for flip in found:
        after = poses(kinematics, flip.values)
        np.testing.assert_allclose(after[-1], before[-1], atol=1e-9)
        assert np.abs(flip.values - TRUTH).max() > 0.1
        assert ((flip.values >= kinematics.lower) & (flip.values <= kinematics.upper)).all()
        np.testing.assert_array_equal(flip.values[~flip.changed], TRUTH[~flip.changed])
    # Turret and roll turn by half a turn, the shoulder changes its sign.
    expected = TRUTH + np.pi * np.array([-1, 0, 1, 0, 0])
    expected[1] *= -1
    best = min(found, key=lambda flip: np.abs(flip.values - expected).max())
    np.testing.assert_allclose(best.values, expected, atol=1e-9)
    assert best.mirrored.tolist() == [False, True, False, False, False]
    assert best.changed.tolist() == [True, True, True, False, False]


def test_flipping_twice_returns_to_the_start(kinematics):
    for flip in flips(kinematics, TRUTH):
        back = [again.values for again in flips(kinematics, flip.values)]
        assert min(np.abs(values - TRUTH).max() for values in back) < 1e-9


def test_flips_outside_the_limits_are_left_out(kinematics):
    # The turret's limits are +-150 degrees, so 10 cannot become 190 degrees.
    values = np.radians([10.0, 40.0, -30.0, 50.0, 20.0])
    assert flips(kinematics, values) == []


class Valley:
    """A fit whose costs are known: a valley about TRUTH along `along`, with defects of masks.

    The cost of a pose that is off by d along the valley is d^2 / width^2 in each of 100 tiles;
    defects of the masks move `scatter` from one tile to another.
    """

    edge_length, camera_count = 1000.0, 2

    def __init__(self, kinematics, along, deviation, width, scatter=0.2):
        self.kinematics, self.along = kinematics, np.array(along, float)
        self.deviation, self.width, self.scatter = deviation, width, scatter
        self.started = []

    def tile_costs(self, values, stage):
        d = float((values - TRUTH)[0] / self.along[0])
        costs = np.full(100, 1.0 + (d / self.width) ** 2)
        costs[:50] += self.scatter * (d != 0.0)
        costs[50:] -= self.scatter * (d != 0.0)
        return costs

    def refine(self, values, stages, held=()):
        self.started.append(values - TRUTH)
        (k,) = held or (0,)
        d = (values - TRUTH)[k] / self.along[k]
        return FittedPose(TRUTH + d * self.along)

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
    valley = Valley(kinematics, [1.0, 0.0, 0.0, 0.0, 0.0], 0.004, 2.0, scatter=1.0)
    other = TRUTH + np.array([0.5, 0.4, 0.0, 0.0, 0.0])
    settled = other.copy()
    settled[1:] = TRUTH[1:]
    changed, mirrored = np.array([1, 1, 0, 1, 0], bool), np.array([0, 1, 0, 0, 0], bool)
    monkeypatch.setattr(views_fit, "flips", lambda *_: [Flip(other, changed, mirrored)])
    modes = RobustModes(valley, lambda: True)
    lower, upper = kinematics.local_limits(TRUTH)
    low = TRUTH - np.array([0.05, 0.1, 0.1, 0.0, 0.1])
    high = TRUTH + np.array([0.02, 0.03, 0.0, 0.1, 0.1])
    # The third ends at a limit without being changed, the fourth is.
    high[2], low[3] = upper[2], lower[3]
    modes._best_costs = valley.tile_costs(TRUTH, None)
    found = [FittedPose(TRUTH, low=low, high=high)]
    modes._add_flipped(found, found[0])
    assert len(found) == 2
    np.testing.assert_allclose(found[1].values, settled)
    np.testing.assert_allclose(
        found[1].low, [settled[0] - 0.05, TRUTH[1] - 0.03, TRUTH[2] - 0.1, lower[3], TRUTH[4] - 0.1]
    )
    np.testing.assert_allclose(
        found[1].high, [settled[0] + 0.02, TRUTH[1] + 0.1, upper[2], TRUTH[3] + 0.1, TRUTH[4] + 0.1]
    )
    # The same flip again is within the new mode.
    modes._add_flipped(found, found[0])
    assert [one.size for one in found] == [1, 2]
