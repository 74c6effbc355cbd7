"""Links that are longer: nodes stand where Drake has them, and move as finite differences say."""

import numpy as np
import pytest

from drake_pose.body import RootRotation, load_model
from drake_pose.body.tree_kinematics import TreeKinematics, joint_offsets
from drake_pose.fit.parameters import BodyParameters
from drake_pose.silhouette.areas.outline import outline_from_mesh
from tests.body.models import joint, link, urdf
from tests.fit.motions import assert_motions_are_derivatives


# A wrist of two joints, no link that is seen between them; a mount that is welded on before the
# last joint; and a second joint on a link.
def box(*size):
    return f'<visual><geometry><box size="{" ".join(map(str, size))}"/></geometry></visual>'


LIMITS = 'lower="-2" upper="2"'
URDF = urdf(
    link("base", box(0.2, 0.3, 0.1)),
    link("upper", box(0.1, 0.1, 0.4)),
    link("gimbal", ""),
    link("wrist", box(0.05, 0.1, 0.2)),
    link("mount", ""),
    link("finger", box(0.02, 0.02, 0.1)),
    link("flag", box(0.02, 0.2, 0.1)),
    joint("turn", "revolute", "base", "upper", limits=LIMITS,
          origin='xyz="0.1 0 0" rpy="0.1 0.2 0.3"'),
    joint("pitch", "revolute", "upper", "gimbal", limits=LIMITS, axis="0 1 0",
          origin='xyz="0.02 0.1 0.3" rpy="0 0.4 0"'),
    joint("yaw", "revolute", "gimbal", "wrist", limits=LIMITS, axis="1 0 1",
          origin='xyz="0.12 0 0"'),
    joint("weld", "fixed", "wrist", "mount", limits=None, origin='xyz="0 0 0.1" rpy="0 0 1"'),
    joint("slide", "prismatic", "mount", "finger", limits='lower="-0.1" upper="0.1"',
          axis="0 1 1", origin='xyz="0 0.05 0"'),
    joint("wave", "revolute", "upper", "flag", limits=LIMITS, axis="1 0 0",
          origin='xyz="0.2 0 0.1"'),
)  # fmt: skip
# For each link with a length: its joints' origins, and the same 1.25 times as far.
LONGER = {
    "base": {"0.1 0 0": "0.125 0 0"},
    "upper": {"0.02 0.1 0.3": "0.025 0.125 0.375", "0.2 0 0.1": "0.25 0 0.125"},
    "gimbal": {"0.12 0 0": "0.15 0 0"},
}
VALUES = {"turn": 0.4, "pitch": -0.7, "yaw": 0.9, "slide": 0.05, "wave": 0.6}


def kinematics_of(path, text, root):
    path.write_text(text)
    fixed, place = RootRotation.fixed(np.eye(3)), np.array([0.1, -0.2, 0.3])
    model = load_model(path, check=False)
    return TreeKinematics(model.pose_tree(root, root_position=place, root_rotation=fixed))


@pytest.fixture(params=["base", "finger", "flag"])
def body(tmp_path, request):
    """The tree walks joints outwards from the base, inwards from the finger, and both ways."""
    kinematics = kinematics_of(tmp_path / "odd.urdf", URDF, request.param)
    outlines = [outline_from_mesh(node.mesh) for node in kinematics.tree.nodes]
    return BodyParameters(kinematics, outlines, offsets=joint_offsets(kinematics.tree))


def parameters(body, logs, placed=(0.0, 0.0, 0.0, 0.0)):
    values = [VALUES[name] for name in body.kinematics.names]
    return np.array([*values, *placed, *(logs.get(link, 0.0) for link in body.links)])


def test_links_with_a_length(body):
    assert set(body.links) == {"base", "upper", "gimbal", "mount"}


@pytest.mark.parametrize("link", LONGER)
def test_nodes_stand_where_drake_has_them(link, body, tmp_path):
    text = URDF
    for origin, longer in LONGER[link].items():
        assert text.count(f'"{origin}"') == 1
        text = text.replace(f'"{origin}"', f'"{longer}"')
    theta = parameters(body, {link: np.log(1.25)})
    root = body.kinematics.tree.root
    drake = kinematics_of(tmp_path / "longer.urdf", text, root)
    assert drake.names == body.kinematics.names
    expected = drake.poses(theta[: len(drake.names)])
    np.testing.assert_allclose(body.place(theta).X_WN, expected, atol=1e-12)


def test_a_joint_behind_a_weld_is_moved_from_the_link_s_own_joint(body):
    offset = next(one for one in joint_offsets(body.kinematics.tree) if one.link == "mount")
    # The slide stands 0.1 up the wrist and 0.05 along the y axis of what is turned there by 1 rad.
    assert np.linalg.norm(offset.p_L) == pytest.approx(np.hypot(0.1, 0.05))
    np.testing.assert_allclose(offset.p_L, [0.0, 0.05, 0.1], atol=1e-12)


def test_derivatives(body):
    """Also of a body that has grown about its root and is shifted."""
    logs = {"base": 0.1, "upper": -0.2, "gimbal": 0.3, "mount": -0.1}
    theta = parameters(body, logs, (0.1, -0.2, 0.3, 0.15))
    assert_motions_are_derivatives(body, theta)
