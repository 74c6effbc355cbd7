"""The continuous search: from silhouettes to a refined pose with intervals."""

import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.search.beam_search import BeamSearch
from drake_pose.search.estimates import View
from drake_pose.search.kameda import PaperSearch
from drake_pose.search.multi_start import MultiStartSearch
from drake_pose.silhouette.areas.bending import TreeSurfaces
from drake_pose.silhouette.areas.scoring import draw_mask
from tests.search.bodies import front_camera, swinging_chain


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    return swinging_chain(tmp_path_factory.mktemp("chain"), 3).pose_tree()


@pytest.fixture(scope="module")
def search(tree):
    return MultiStartSearch(tree)


def view_of(tree, values, side=200, shift=0.37):
    camera = front_camera(side, shift=shift)
    outlines = TreeSurfaces(tree).at(values)
    return View(camera, draw_mask(outlines, camera.X_CW @ tree.node_poses(values), camera))


def drawn_values(tree, rng):
    return [rng.uniform(*tree.value_bounds(i)) for i in range(len(tree.nodes))]


def test_poses_between_the_samples_are_found(tree, search):
    rng = np.random.default_rng(4)
    errors, inside = [], []
    for _ in range(6):
        values = drawn_values(tree, rng)
        view = view_of(tree, values)
        found = search.match([view])
        q, _ = tree.positions_from(found.node_values)
        np.testing.assert_allclose(found.q, q)
        drawn = view_of(tree, found.node_values)
        assert found.J == np.count_nonzero(drawn.mask != view.mask)
        assert found.E_total == pytest.approx(found.J / np.count_nonzero(view.mask))
        errors.append(
            np.degrees(np.abs(np.concatenate(found.node_values) - np.concatenate(values)))
        )
        joints = found.pose_set.joints
        flat = np.concatenate(values)
        inside += [j.holds(v) for j, v in zip(joints, flat, strict=True) if j.determined]
    assert np.median(errors) < 1.0
    assert len(inside) >= 12
    assert np.mean(inside) > 0.85


def test_families_are_as_good_as_the_best(tree, search):
    view = view_of(tree, drawn_values(tree, np.random.default_rng(10)))
    found = search.match([view])
    families = found.pose_set.families
    assert families[0].J == found.J
    assert found.pose_set.family_count == len(families)
    for family in families:
        assert family.J <= found.J + found.pose_set.tolerance
        np.testing.assert_allclose(family.q, tree.positions_from(family.node_values)[0])
        assert family.joints[0].holds(family.node_values[0][0])


def test_nothing_is_determined_where_the_body_does_not_fit(tree, search):
    values = drawn_values(tree, np.random.default_rng(6))
    view = view_of(tree, values)
    assert any(joint.determined for joint in search.match([view]).pose_set.joints)
    spoilt = view.mask.copy()
    spoilt[5:60, 5:60] = True
    joints = search.match([View(view.camera, spoilt)]).pose_set.joints
    assert not any(joint.determined for joint in joints)


@pytest.mark.parametrize("make", [BeamSearch, MultiStartSearch, PaperSearch])
def test_no_view_is_refused(tree, make):
    with pytest.raises(SettingsError, match="at least one view"):
        make(tree).match([])
