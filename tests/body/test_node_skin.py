"""Skin bands: vertices at rest and in motion, re-rooted trees, and invalid skin files."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import ArticulatedModel, ModelSkin, RootRotation, load_model
from drake_pose.errors import DrakePoseError, ModelError, UnknownNameError
from tests.body import models as limbs
from tests.body.models import REACH, band_entry, link_poses, load_limb, tube_obj

WRIST = ("wrist_x", "wrist_z", "wrist_y")


def in_frame(X, points):
    return points @ X[:3, :3].T + X[:3, 3]


def test_vertex_rotates_by_its_weight_times_the_angle(tmp_path):
    root, node, hand = load_limb(tmp_path).pose_tree().nodes
    assert root.skin is None
    # The weight is the smoothstep of the way along the limb.
    for skin in (node.skin, hand.skin):
        at = (REACH - skin.mesh.vertices[:, 2]) / (2.0 * REACH)
        np.testing.assert_allclose(skin.weights, at * at * (3.0 - 2.0 * at), atol=1e-6)
    angles = np.array([-2.1, -0.4, 0.0, 1.0, 2.4])
    found = node.skin.vertices(angles[:, None])
    for angle, p_N in zip(angles, found, strict=True):
        # The elbow rotates about x; its origin is fixed in the parent.
        whole = Rotation.from_rotvec([angle, 0, 0]).inv()
        part = Rotation.from_rotvec(node.skin.weights[:, None] * np.array([angle, 0.0, 0.0]))
        expected = (whole * part).apply(np.array(node.skin.mesh.vertices))
        np.testing.assert_allclose(p_N, expected, atol=1e-14)


@pytest.mark.parametrize("seed", range(2))
def test_ends_of_a_band_move_rigidly_with_their_links(tmp_path, seed):
    """Drake's poses of both links move the band's ends; other joints do not move the band."""
    model = load_limb(tmp_path)
    skin = ModelSkin(model)
    q, mixed = np.random.default_rng(seed).uniform(model.lower, model.upper, (2, 5))
    rest = np.zeros(5)
    for band, p_W, p_W0 in zip(skin.bands, skin.vertices(q), skin.vertices(rest), strict=True):
        for link, weight in ((band.parent, 0.0), (band.child, 1.0)):
            rigid = band.weights == weight
            assert rigid.sum() == 5
            X_0 = link_poses(model, q)[link] @ np.linalg.inv(link_poses(model, rest)[link])
            np.testing.assert_allclose(p_W[rigid], in_frame(X_0, p_W0[rigid]), atol=1e-14)
    wrist = [model.position_index(name) for name in WRIST]
    mixed[wrist] = q[wrist]
    in_hand = [
        in_frame(np.linalg.inv(link_poses(model, at)["hand"]), skin.vertices(at)[1])
        for at in (q, mixed)
    ]
    np.testing.assert_allclose(in_hand[0], in_hand[1], atol=1e-12)
    for mesh, p_W0, band in zip(skin.meshes, skin.vertices(rest), skin.bands, strict=True):
        X = link_poses(model, rest)[band.child]
        np.testing.assert_allclose(p_W0, in_frame(X, mesh.vertices), atol=1e-14)


@pytest.mark.parametrize("root", ["lower", "hand"])
def test_rerooted_tree_has_the_same_band(tmp_path, root):
    model = load_limb(tmp_path)
    skin = ModelSkin(model)
    q = np.random.default_rng(2).uniform(model.lower, model.upper)
    position = link_poses(model, q)[root][:3, 3]
    tree = model.pose_tree(root, root_position=position, root_rotation=RootRotation.free())
    values = tree.values_from_positions(q)
    X_WN = tree.node_poses(values)
    banded = [one for one in zip(tree.nodes, values, X_WN, strict=True) if one[0].skin is not None]
    found = [in_frame(X, node.skin.vertices(part[None])[0]) for node, part, X in banded]
    assert len(found) == 2
    for expected in skin.vertices(q):
        assert min(np.abs(p_W - expected).max() for p_W in found) < 1e-12
    assert any(node.skin.inverted for node, *_ in banded)


def test_band_of_a_welded_link_belongs_to_its_group(tmp_path):
    """The band is given in the frame of a link that is welded to the node's link."""
    extra = (
        '<link name="cuff"/><joint name="fix" type="fixed"><parent link="lower"/>'
        '<child link="cuff"/><origin xyz="0.01 0 0.02" rpy="0.2 0.3 0.4"/></joint></robot>'
    )
    text = limbs.LIMB_URDF.replace("</robot>", extra)
    plain = load_limb(tmp_path)
    folder = tmp_path / "welded"
    folder.mkdir()
    path = limbs.write_limb(folder, "bands:\n" + band_entry("upper", "cuff"), text)
    model = load_model(path, check=False)
    X_LC = link_poses(plain, np.zeros(5))["lower"]
    X_LC = np.linalg.inv(X_LC) @ link_poses(model, np.zeros(5))["cuff"]
    node = model.pose_tree().nodes[1]
    assert node.name == "lower"
    moved = in_frame(X_LC, plain.skin[0].mesh.vertices)
    np.testing.assert_allclose(node.skin.mesh.vertices, moved)
    q = np.array([0.3, 1.1, 0.2, 0.1, -0.4])
    (p_W,) = ModelSkin(model).vertices(q)
    in_node = node.skin.vertices(q[None, [1]])[0]
    np.testing.assert_allclose(p_W, in_frame(link_poses(model, q)["lower"], in_node), atol=1e-12)


def test_invalid_bands_and_skin_files_are_refused(tmp_path):
    tube, entry = tube_obj(), band_entry("upper", "lower")
    (tmp_path / "open.obj").write_text(tube[: tube.rindex("f ")])
    texts = [("bands:\n" + entry + entry, "two bands between")]
    texts += [
        (one, "limb.skin") for one in ("- 1", "bands: 3", "bands: [1", "bands: []", "other: 1")
    ]
    for changes, message in (
        ({"mesh": "none.obj"}, "none.obj does not exist"),
        ({"mesh": None}, "name its mesh"),
        *(({"axis": one}, "axis must be three f") for one in ([0, 0, 0], [0, 1], [0, 1, "nan"])),
        ({"begin": 0.1}, "begin below end"),
        ({"end": ".inf"}, "begin below end"),
        ({"colour": [2, 0, 0]}, "colour must be three numbers from 0 to 1"),
        ({"child": "upper"}, "parent and child must be two links"),
        ({"length": 3}, "length"),
        ({"begin": "x"}, "parent, child, mesh, axis, begin"),
        ({"mesh": "open.obj"}, "not closed"),
    ):
        changed = band_entry(**({"parent": "upper", "child": "lower"} | changes))
        texts.append(("bands:\n" + changed, message))
    for text, message in texts:
        with pytest.raises(ModelError, match=message):
            load_limb(tmp_path, text)
    path = limbs.write_limb(tmp_path, "bands:\n" + band_entry("upper", "paw"))
    for check in (False, True):
        with pytest.raises((UnknownNameError, ModelError), match=r"skin\.yaml has no link 'paw'"):
            load_model(path, check=check)


def test_band_must_join_neighbours(tmp_path):
    for parent, child, use, message in (
        ("upper", "hand", ArticulatedModel.pose_tree, "not neighbours"),
        ("world", "lower", ArticulatedModel.pose_tree, "not neighbours"),
        ("lower", "upper", ModelSkin, "exchanged"),  # On conversion for Drake.
    ):
        with pytest.raises(DrakePoseError, match=message):
            use(load_limb(tmp_path, "bands:\n" + band_entry(parent, child)))
