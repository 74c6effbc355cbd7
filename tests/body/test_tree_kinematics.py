"""Compiled kinematics against the pose tree and finite differences."""

import numpy as np
import pytest

from drake_pose.body import RootRotation, load_model
from drake_pose.body.link_graph import JointMap
from drake_pose.body.tree_kinematics import TreeKinematics, link_vectors
from drake_pose.errors import ModelError, SettingsError
from drake_pose.fit.parameters import BodyParameters
from drake_pose.fit.surfaces import VERY_FEW, simplify_surfaces
from drake_pose.silhouette.outline import TreeSurfaces
from tests.body.models import FLOATING_URDF, HAND, JOINTED_BASE_URDF, JOINTS_SDF, WELDED_URDF, write
from tests.fit.motions import assert_motions_are_derivatives

_TURNED = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
_LIMITED = RootRotation.limited([("y", -90, 90), ("z", -20, 30)], rotation=_TURNED)
_LEG = {"root": "leg", "root_position": (0.0, 0.2, 0.0), "root_rotation": _LIMITED}
_TREES = {
    "free": (FLOATING_URDF, "f.urdf", {"root_rotation": RootRotation.free()}),
    "floating": (FLOATING_URDF, "f.urdf", {"root_position": (0.3, -0.2, 0.9)}),
    "re-rooted": (FLOATING_URDF, "f.urdf", {"root": "hand", "root_position": (0.3, 0.2, 0.1)}),
    "re-rooted, limited": (FLOATING_URDF, "f.urdf", _LEG),
    "jointed base": (JOINTED_BASE_URDF, "j.urdf", {}),
    "known root": (JOINTED_BASE_URDF, "j.urdf", {"root_position": (1.0, 2.0, 3.0)}),
    "welded": (WELDED_URDF, "w.urdf", {}),
    "held": (WELDED_URDF, "w.urdf", {"held": {"a1": 0.3}}),
    "all joints": (JOINTS_SDF, "j.sdf", {}),
    "all joints re-rooted": (JOINTS_SDF, "j.sdf", {"root": "f", "root_position": (0, 0, 0)}),
}


@pytest.fixture(scope="module", params=list(_TREES))
def kinematics(request, tmp_path_factory):
    text, name, arguments = _TREES[request.param]
    path = write(tmp_path_factory.mktemp("model"), text, name)
    return TreeKinematics(load_model(path, check=False).pose_tree(**arguments))


def draw(kinematics, seed):
    lower, upper = (np.clip(b, -5.0, 5.0) for b in (kinematics.lower, kinematics.upper))
    values = np.random.default_rng(seed).uniform(lower, upper)
    # Near no rotation at all, too.
    values[:3] *= (1e-6, 1e-3, 1.0)[seed % 3] if kinematics.tree.turns_root_freely else 1.0
    return values


def move(motions, j, points):
    """Velocities (nodes, n, 3) of points (nodes, n, 3) in the world by motion j."""
    omega, v, sigma = motions.twists[j, :3], motions.twists[j, 3:6], motions.twists[j, 6]
    velocities = np.cross(np.broadcast_to(omega, points.shape), points) + v + sigma * points
    return velocities * motions.moves[:, j, None, None]


def test_poses_match_the_pose_tree(kinematics):
    for seed in range(5):
        values = draw(kinematics, seed)
        expected = kinematics.tree.node_poses(kinematics.split(values))
        assert np.abs(kinematics.poses(values) - expected).max() < 1e-12
        assert np.array_equal(kinematics.flatten(kinematics.split(values)), values)


def test_motions_match_finite_differences_of_poses(kinematics):
    p_N = np.random.default_rng(3).normal(size=(len(kinematics.tree.nodes), 4, 3))
    step = 1e-6
    for seed in range(3):
        values = draw(kinematics, seed)
        motions = kinematics.motions(values)

        def place(values):
            X_WN = kinematics.poses(values)
            return np.einsum("nij,nkj->nki", X_WN[:, :3, :3], p_N) + X_WN[:, None, :3, 3]

        for j in range(len(values)):
            shift = step * np.eye(len(values))[j]
            difference = (place(values + shift) - place(values - shift)) / (2 * step)
            assert np.abs(move(motions, j, place(values)) - difference).max() < 1e-7


def test_motions_of_a_body_against_finite_differences(tmp_path):
    """Of joints that follow others, too, and with link scales."""
    tree = load_model(write(tmp_path, HAND), check=False).pose_tree()
    kinematics = TreeKinematics(tree)
    low, high = np.maximum(kinematics.lower, -1.0), np.minimum(kinematics.upper, 1.0)
    values = np.random.default_rng(1).uniform(low, high)
    surfaces = simplify_surfaces(TreeSurfaces(tree), VERY_FEW)
    body = BodyParameters(kinematics, surfaces, offsets=link_vectors(tree))
    for logs in ([], [0.0] * 4 + np.linspace(0.1, 0.2, len(body.links)).tolist()):
        assert_motions_are_derivatives(body, np.append(values, logs))


def test_translation_and_scale_move_the_first_roots_tree(kinematics):
    values = draw(kinematics, 2)
    motions = kinematics.motions(values, translation=True, scale=True)
    m = len(values)
    assert motions.twists.shape == (m + 4, 7)
    points = np.random.default_rng(1).normal(size=(len(motions.X_WN), 3, 3))
    for k in range(3):
        assert np.allclose(move(motions, m + k, points)[0], np.eye(3)[k])
    scaling = move(motions, m + 3, points)[0]
    assert np.allclose(scaling, points[0] - motions.X_WN[0, :3, 3])
    # Parents come first.
    roots: list[int] = []
    for i, node in enumerate(kinematics.tree.nodes):
        roots.append(i if node.parent < 0 else roots[node.parent])
    assert motions.moves[:, m:].any(axis=1).tolist() == [root == 0 for root in roots]


def test_wrong_numbers_of_values_are_refused(kinematics):
    with pytest.raises(SettingsError, match="values expected"):
        kinematics.motions(np.zeros(len(kinematics.names) + 1))
    with pytest.raises(SettingsError, match="values of the nodes expected"):
        kinematics.flatten([np.zeros(9) for _ in kinematics.tree.nodes])


def test_unsupported_joint_motion_is_refused():
    with pytest.raises(ModelError, match="joint 'odd' moves in a way"):
        JointMap.measure(
            lambda q: np.eye(4) + 1e-3 * q[0] ** 2 * np.eye(4)[:, [3, 0, 1, 2]], 1, "odd"
        )
