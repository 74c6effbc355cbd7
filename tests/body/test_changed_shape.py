"""Models whose parts are left out or longer than in their file."""

import numpy as np
import pytest

from drake_pose.body.model import load_model
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import ModelError, UnknownNameError
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.search.bodies import forked_body, front_camera


def area(model, q, scale=1.0):
    """How much Drake draws of it [pixel]."""
    camera = front_camera(300, shift=0.2)
    wide = ParallelCamera(
        "wide", 300, 300, scale * 100.0, camera.center_x, camera.center_y, camera.X_WC
    )
    return int(np.count_nonzero(LabelRenderer(model, wide).mask(q)))


def test_a_link_without_looks_is_drawn_by_nobody(tmp_path):
    model = forked_body(tmp_path)
    q = np.array([0.1, 1.5, -1.5])
    without = model.without(["left"])
    assert "left" not in without.link_meshes
    assert without.position_names == model.position_names
    # The left arm is a box of 4 x 15 pixels, of which the trunk hides little.
    assert 40 < area(model, q) - area(without, q) <= 60
    with pytest.raises(UnknownNameError, match="tail"):
        model.without(["tail"])


def test_a_body_stretched_alike_everywhere_is_seen_larger(tmp_path):
    model = forked_body(tmp_path)
    q = np.array([0.1, 1.2, -0.8])
    double = model.reshaped(factors={name: (2.0, 2.0, 2.0) for name in model.link_names})
    assert area(double, q) == pytest.approx(area(model, q, scale=2.0), rel=0.02)
    assert area(double, q) > 3.5 * area(model, q)
    tree, larger = model.pose_tree(), double.pose_tree()
    before, after = (t.node_poses(t.values_from_positions(q)) for t in (tree, larger))
    np.testing.assert_allclose(after[:, :3, 3], 2.0 * before[:, :3, 3], atol=1e-12)


def test_only_urdf_models_change_their_shape(tmp_path):
    path = tmp_path / "ball.sdf"
    path.write_text(
        '<sdf version="1.9"><model name="m"><link name="a"><visual name="v"><geometry><sphere>'
        "<radius>0.1</radius></sphere></geometry></visual></link></model></sdf>"
    )
    model = load_model(path)
    assert not model.changes_shape
    with pytest.raises(ModelError, match="URDF"):
        model.without(["a"])
