"""Pose sets from damaged masks: intervals, undetermined joints, flips, self-motions."""

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import simplify_surfaces
from drake_pose.search import ViewsFit
from drake_pose.search.self_motions import counter_turns, flips
from drake_pose.search.settings import RobustSettings
from drake_pose.search.views_fit import FittedPose, RobustModes, distinct
from drake_pose.silhouette.outline import TreeSurfaces
from tests.body.models import joint, link, urdf, write
from tests.search.arms import arm_cameras, arm_tree, damaged_views, draw_view, is_held, split
from tests.search.bodies import swinging_chain

TRUTH = np.array([0.6, 0.7, -0.7, 0.9, 0.3])
FINE = tuple(AnnealingStage(scale, 0.0125, 8) for scale in (0.025, 0.0125))


def find(kinematics, views, values, settings=None):
    fit = ViewsFit(kinematics, simplify_surfaces(TreeSurfaces(kinematics.tree)), views)
    modes = RobustModes(fit, lambda: True, settings)
    return modes.find([fit.refine(values, FINE)], lambda values: float(values[0]))


@pytest.fixture(scope="module")
def kinematics(tmp_path_factory):
    return TreeKinematics(arm_tree(tmp_path_factory.mktemp("arm")))


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


def test_without_time_intervals_follow_from_the_covariance(kinematics):
    views = damaged_views(kinematics.tree, TRUTH, 1)
    fit = ViewsFit(kinematics, simplify_surfaces(TreeSurfaces(kinematics.tree)), views)
    pose = fit.refine(TRUTH, FINE)
    before = fit.evaluations
    answer = RobustModes(fit, lambda: False).find([pose], lambda _: 0.0)
    assert answer.mode_count == 1
    assert fit.evaluations - before < 5
    assert all(one.low < one.high for one in answer.joints)


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


VALUES = np.array([0.6, 0.7, -0.7, 0.9, 0.3])


def poses(kinematics, values):
    """Return X_WN (nodes, 4, 4) by the pose tree instead of the compiled kinematics."""
    return kinematics.tree.node_poses(split(kinematics.tree, values))


def test_flips_keep_the_pose_of_the_last_link(kinematics):
    found = flips(kinematics, VALUES)
    before = poses(kinematics, VALUES)
    assert found
    for flip in found:
        after = poses(kinematics, flip.values)
        np.testing.assert_allclose(after[-1], before[-1], atol=1e-9)
        assert np.abs(flip.values - VALUES).max() > 0.1
        assert ((flip.values >= kinematics.lower) & (flip.values <= kinematics.upper)).all()
        np.testing.assert_array_equal(flip.values[~flip.changed], VALUES[~flip.changed])
    # Turret and roll turn by half a turn, the shoulder changes its sign.
    expected = VALUES + np.pi * np.array([-1, 0, 1, 0, 0])
    expected[1] *= -1
    best = min(found, key=lambda flip: np.abs(flip.values - expected).max())
    np.testing.assert_allclose(best.values, expected, atol=1e-9)
    assert best.mirrored.tolist() == [False, True, False, False, False]
    assert best.changed.tolist() == [True, True, True, False, False]


def test_flipping_twice_returns_to_the_start(kinematics):
    for flip in flips(kinematics, VALUES):
        back = [again.values for again in flips(kinematics, flip.values)]
        assert min(np.abs(values - VALUES).max() for values in back) < 1e-9


def test_flips_outside_the_limits_are_left_out(kinematics):
    # The turret's limits are +-150 degrees, so 10 cannot become 190 degrees.
    values = np.radians([10.0, 40.0, -30.0, 50.0, 20.0])
    assert flips(kinematics, values) == []


def test_counter_turns_keep_the_pose_of_later_links(kinematics):
    # With the shoulder upright, turret and roll have the same axis.
    values = np.array([0.6, 0.0, -0.5, 0.9, 0.3])
    found = counter_turns(kinematics, values, np.radians(30.0))
    turned = [one for one in found if one[0] != values[0] and one[2] != values[2]]
    assert turned
    before = poses(kinematics, values)
    for one in turned:
        np.testing.assert_allclose(poses(kinematics, one)[-1], before[-1], atol=1e-9)
    assert all(((one >= kinematics.lower) & (one <= kinematics.upper)).all() for one in found)


def test_a_planar_chain_has_counter_turns_but_no_flips(tmp_path):
    kinematics = TreeKinematics(swinging_chain(tmp_path, 3).pose_tree())
    values = np.array([0.3, -0.4, 0.5])
    assert flips(kinematics, values) == []
    for one in counter_turns(kinematics, values, 0.5):
        changed = np.flatnonzero(one != values)
        assert len(changed) == 2
        # With parallel axes the two changes cancel, except for full turns.
        assert (one - values).sum() == pytest.approx(0.0, abs=1e-9)
