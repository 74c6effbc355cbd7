"""Placed roots, sampling grids and limits of pose trees."""

import numpy as np
import pytest

from drake_pose.body import RootRotation
from drake_pose.body.pose_tree import axis_samples, product_grid, require_tree
from drake_pose.body.root import even_rotations
from drake_pose.errors import SettingsError, UnknownNameError
from tests.body.models import link_poses

FULL = 2.0 * np.pi


@pytest.mark.parametrize("name", ["floating", "jointed", "welded", "all_joints"])
def test_a_placed_root_moves_the_whole_body(models, name):
    """By Drake's plant: the root's origin is at the place, and all else keeps its relative pose."""
    model, rng = models[name], np.random.default_rng(3)
    given = {"root_position": np.zeros(3), "root_rotation": RootRotation.free()}
    tree = model.pose_tree(**given if name == "welded" else {})
    assert tree.turns_root_freely == (name == "welded")
    assert repr(tree).startswith(f"<PoseTree of {model!r}: {len(tree.nodes)} nodes")
    bounds = [tree.value_bounds(k) for k in range(len(tree.nodes))]
    values = [rng.uniform(0.5 * low, 0.5 * high) for low, high in bounds]
    before = tree.node_poses(values)
    for place in (np.array([0.05, -0.04, 0.06]), before[0, :3, 3]):
        q, X_WB = tree.positions_with_root_at(values, place)
        poses = link_poses(model, q)
        placed = np.array([X_WB @ poses[node.name] for node in tree.nodes])
        shifted = before.copy()
        shifted[:, :3, 3] += place - before[0, :3, 3]
        np.testing.assert_allclose(placed, shifted, atol=1e-9)
        moved = tree.with_root_position(place)
        origin = moved.node_poses(moved.default_values())[0, :3, 3]
        np.testing.assert_allclose(origin, place, atol=1e-9)


def test_grids_are_all_combinations_of_their_axes(models):
    """The last value changes fastest; lengths have an interval of their own; held: one sample."""
    limited = RootRotation.limited([("y", -40, 40), ("z", 10, 30)], interval_deg=20.0)
    for tree, root_interval in (
        (models["all_joints"].pose_tree(held={"screw": 0.3}), 0.9),
        (models["welded"].pose_tree(root_rotation=limited), np.radians(20.0)),
    ):
        for k, node in enumerate(tree.nodes):
            # Free rotations are no combinations: see ``even_rotations``.
            if len(node.value_names) not in (1, 2):
                continue
            placement, axes = tree.placements[k], []
            for j, (low, high) in enumerate(zip(*tree.value_bounds(k), strict=True)):
                spacing = (root_interval if k == 0 else 0.9) if placement.is_angle[j] else 0.2
                periodic = bool(placement.periodic[j])
                own = [low] if low == high else axis_samples(low, high, spacing, is_angle=periodic)
                axes.append(own)
            expected = np.array(np.meshgrid(*axes, indexing="ij")).reshape(len(axes), -1).T
            np.testing.assert_allclose(tree.grid(k, 0.9, 0.2), expected)
    for own, interval in ((45.0, np.radians(45.0)), (None, 0.9)):
        tree = models["floating"].pose_tree(root_rotation=RootRotation.free(own))
        np.testing.assert_array_equal(tree.grid(0, 0.9), even_rotations(interval))


def test_samples_are_multiples_sorted_by_magnitude_negative_first():
    """By brute force; a full turn of an angle has each direction once."""
    rng = np.random.default_rng(0)
    drawn = [
        (*np.sort(rng.integers(-40, 40, 2) / 4.0), rng.integers(1, 9) / 4.0) for _ in range(99)
    ]
    for low, high, step in [*drawn, (-0.3, -0.1, 1.0), (0.25, 0.35, 0.2)]:
        multiples = step * np.arange(-80, 81)
        inside = multiples[(multiples >= low) & (multiples <= high)]
        expected = sorted(inside, key=lambda one: (abs(one), one)) or [(low + high) / 2]
        found = axis_samples(low, high, step, is_angle=False)
        np.testing.assert_allclose(found, expected, atol=1e-12)
        turn = axis_samples(low, high, step, is_angle=True)
        if inside.size == 0 or np.ptp(inside) < FULL:
            np.testing.assert_array_equal(turn, found)
        else:
            assert len(turn) == np.ceil(FULL / step - 1e-9)
            assert np.ptp(turn) < FULL
            assert set(turn) <= set(found)
    # Limits that miss a multiple by rounding are inside, and no sample is beyond them.
    third = np.radians(20.0)
    for count, is_angle in ((18, True), (19, False)):
        samples = axis_samples(-np.pi, np.pi, third, is_angle=is_angle)
        assert len(samples) == count
        assert max(np.abs(samples)) <= np.pi


def test_refusals_name_the_culprit(models):
    floating = models["floating"]
    tree = floating.pose_tree()
    with pytest.raises(UnknownNameError, match="tail"):
        tree.node_index("tail")
    assert len(product_grid([range(10)] * 3, "head", 1000)) == 1000
    assert len(axis_samples(0.0, 4.0, 1.0, is_angle=True, max_samples=5)) == 5
    for make, words in (
        (lambda: tree.relative_transforms(1, np.zeros((3, 1))), "shape"),
        (lambda: tree.relative_transforms(1, np.zeros(2)), "shape"),
        (lambda: tree.node_poses([np.zeros(0)]), "4 arrays"),
        (lambda: product_grid([range(10)] * 3, "head", 999), "node 'head'"),
        (lambda: axis_samples(-1.0, 1.0, 1e-12, is_angle=True), r"1e-12.*larger interval"),
        (lambda: axis_samples(0.0, 5.0, 1.0, is_angle=True, max_samples=5), "6 samples"),
        *((lambda bad=bad: tree.grid(0, bad), "'interval'") for bad in (0.0, -1.0, np.inf, np.nan)),
        (lambda: tree.grid(0, 0.5, np.nan), "'length_interval'"),
        (lambda: require_tree(floating), "ArticulatedModel, 'thing'"),
        (lambda: require_tree(3), "not a int$"),
    ):
        with pytest.raises(SettingsError, match=words):
            make()
