"""Models with links hidden, scaled or shifted, and with joint offsets."""

from dataclasses import replace

import numpy as np
import pytest

from drake_pose.body import load_model, reshaped
from drake_pose.errors import UnknownNameError
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.body.models import JOINTED_BASE_URDF, link_poses, write
from tests.search.bodies import front_camera


def area(model, q, scale=1.0):
    """The area of a model in Drake's rendering [pixel]."""
    camera = replace(front_camera(300, shift=0.2), pixels_per_metre=scale * 100.0)
    return int(np.count_nonzero(LabelRenderer(model, camera).mask(q)))


def test_hidden_link_is_not_rendered(body):
    q = np.array([0.1, 1.5, -1.5])
    without = body.without(["left"])
    assert "left" not in without.link_meshes
    assert without.position_names == body.position_names
    # The left arm is a box of 4 x 15 pixels, slightly occluded by the trunk.
    assert 40 < area(body, q) - area(without, q) <= 60
    with pytest.raises(UnknownNameError, match="tail"):
        body.without(["tail"])


def test_uniform_link_scales_equal_a_larger_image_scale(body):
    q = np.array([0.1, 1.2, -0.8])
    double = body.reshaped(link_scales={name: (2.0, 2.0, 2.0) for name in body.link_names})
    assert area(double, q) == pytest.approx(area(body, q, scale=2.0), rel=0.02)
    assert area(double, q) > 3.5 * area(body, q)
    tree, larger = body.pose_tree(), double.pose_tree()
    before, after = (t.node_poses(t.values_from_positions(q)) for t in (tree, larger))
    np.testing.assert_allclose(after[:, :3, 3], 2.0 * before[:, :3, 3], atol=1e-12)


def test_joint_offsets_move_links_and_keep_physical_limits(tmp_path):
    zeros = {"x": 0.3, "head_y": 0.2, "neck": -0.4}
    model = load_model(write(tmp_path, JOINTED_BASE_URDF), check=False)
    text = reshaped(JOINTED_BASE_URDF, joint_offsets=zeros)
    other = load_model(write(tmp_path, text, "other.urdf"), check=False)
    offsets = np.array([zeros.get(name, 0.0) for name in model.position_names])
    np.testing.assert_allclose([other.lower, other.upper], [model.lower, model.upper] - offsets)
    q = np.random.default_rng(1).uniform(-0.5, 0.5, len(offsets))
    expected = link_poses(model, q + offsets)
    for name, X in link_poses(other, q).items():
        np.testing.assert_allclose(X, expected[name], atol=1e-12)


def test_shifts_move_joints_and_meshes_in_their_link_frames(tmp_path):
    model = load_model(write(tmp_path, JOINTED_BASE_URDF), check=False)
    shift, move = np.array([0.1, -0.2, 0.3]), np.array([-0.3, 0.1, 0.2])
    other = model.reshaped(joint_shifts={"neck": shift}, link_shifts={"chest": move})
    q = np.random.default_rng(2).uniform(-0.5, 0.5, len(model.position_names))
    X, Y = link_poses(model, q), link_poses(other, q)
    np.testing.assert_allclose(Y["head"], X["head"])
    chest = Y["chest"][:3, 3] - X["chest"][:3, 3]
    np.testing.assert_allclose(chest, X["head"][:3, :3] @ shift, atol=1e-12)
    arm = Y["arm"][:3, 3] - X["arm"][:3, 3] - chest
    np.testing.assert_allclose(arm, X["chest"][:3, :3] @ move, atol=1e-12)
    for name, by in (("head", 0.0), ("chest", move), ("arm", 0.0)):
        before, after = model.link_meshes[name], other.link_meshes[name]
        np.testing.assert_allclose(after.vertices, before.vertices + by, atol=1e-12)
    with pytest.raises(UnknownNameError, match="tail"):
        model.reshaped(link_shifts={"tail": move})
