"""Landmarks of the bundled models against Drake, and invalid landmark files."""

import numpy as np
import pytest

from drake_pose.body import (
    Landmark,
    bundled_model,
    landmark_positions,
    landmarks_of_nodes,
    load_landmarks,
    load_model,
)
from drake_pose.errors import ModelError, SettingsError, UnknownNameError
from tests.body.models import FLOATING_URDF, link_poses, write

JOINT_CENTRES = {"head_top", "neck"} | {
    f"{side}_{name}"
    for side in ("left", "right")
    for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
}
BODIES = [
    *map(bundled_model, ("woman", "man", "person")),
    bundled_model("person").with_name("person_shape.urdf"),
]
# Distances between landmarks [mm]: ANSUR II means of women and men, and their averages.
LENGTHS = {
    "woman": {"forearm": 241.3, "stature": 1628.5, "ankle": 62.7, "knee": 465.9},
    "man": {"forearm": 267.9, "stature": 1756.2, "ankle": 72.9, "knee": 491.7},
    "person": {"forearm": 254.6, "stature": 1692.35, "ankle": 67.8, "knee": 478.8},
}


@pytest.mark.parametrize("path", BODIES, ids=lambda path: path.stem)
@pytest.mark.parametrize("root", [None, "left_shin"])
def test_bundled_landmarks_match_drakes_link_poses(path, root):
    """From the model's positions, and from a pose tree that may be re-rooted."""
    model = load_model(path, check=False)
    landmarks, rng = load_landmarks(path), np.random.default_rng(1)
    assert set(landmarks) == JOINT_CENTRES
    tree = model.pose_tree(root, root_position=None if root is None else [0.3, -0.2, 0.5])
    placed = landmarks_of_nodes(tree, landmarks)
    assert placed.names == tuple(landmarks)
    for _ in range(3):
        values = tree.values_from_positions(rng.uniform(model.lower, model.upper))
        (q, X_WB), X_WN = tree.positions_from(values), tree.node_poses(values)
        poses = link_poses(model, q)
        expected = [(X_WB @ poses[one.link] @ [*one.point, 1.0])[:3] for one in landmarks.values()]
        np.testing.assert_allclose(landmark_positions(model, landmarks, q, X_WB), expected)
        batch = placed.positions(np.stack([X_WN, X_WN]))
        np.testing.assert_allclose(batch, [expected, expected], atol=1e-9)
        np.testing.assert_array_equal(placed.positions(X_WN), batch[0])


@pytest.mark.parametrize("path", BODIES, ids=lambda path: path.stem)
def test_bundled_landmarks_match_anthropometric_means(path):
    model = load_model(path, check=False)
    landmarks = load_landmarks(path)
    zero = np.zeros(len(model.position_names))
    at = dict(zip(landmarks, landmark_positions(model, landmarks, zero) * 1e3, strict=True))
    measured = LENGTHS[path.parent.name]
    floor = at["head_top"][2] - measured["stature"]
    for side in ("left", "right"):
        assert at[f"{side}_ankle"][2] - floor == pytest.approx(measured["ankle"], abs=2.0)
        assert at[f"{side}_knee"][2] - floor == pytest.approx(measured["knee"], abs=2.0)
        drop = at[f"{side}_elbow"][2] - at[f"{side}_wrist"][2]
        assert drop == pytest.approx(measured["forearm"], abs=2.0)
    assert at["left_wrist"][1] > 100 > -100 > at["right_wrist"][1]


def test_errors_name_invalid_links_and_positions(tmp_path):
    model = load_model(write(tmp_path, FLOATING_URDF), check=False)
    wrong = {"elbow": Landmark("elbow_link", np.zeros(3))}
    q = np.array(model.default_positions)
    with pytest.raises(UnknownNameError, match=r"landmarks.yaml: 'elbow'.*no link 'elbow_link'"):
        landmark_positions(model, wrong, q)
    with pytest.raises(UnknownNameError, match=r"'elbow'.*no link 'elbow_link'"):
        landmarks_of_nodes(model.pose_tree(), wrong)
    with pytest.raises(ModelError, match="'end' is on link 'toe'"):
        landmarks_of_nodes(model.pose_tree(), {"end": Landmark("toe", np.zeros(3))})
    for bad in (q[:-1], np.full_like(q, np.nan)):
        with pytest.raises(SettingsError, match="finite numbers"):
            landmark_positions(model, {}, bad)


def test_errors_name_the_file_and_the_entry(tmp_path):
    for text, complaint in (
        ("", "one mapping 'landmarks'"),
        ("landmarks: {}", "one mapping 'landmarks'"),
        ("landmarks: [1, 2]", "one mapping 'landmarks'"),
        ("landmarks: {a: {link: b, point: [0, 0, 0]}}\nother: 1", "one mapping 'landmarks'"),
        ("landmarks: {a: 3}", "'a': expected a mapping of link, point"),
        ("landmarks: {a: {link: b}}", "'a': point"),
        ("landmarks: {a: {link: b, point: [0, 0, 0], more: 1}}", "'a': .*more"),
        ("landmarks: {a: {link: 3, point: [0, 0, 0]}}", "'a': .*link"),
        ("landmarks: {a: {link: '', point: [0, 0, 0]}}", "'a': link"),
        ("landmarks: {a: {link: b, point: [0, 0]}}", "'a': point"),
        ("landmarks: {a: {link: b, point: [0, 0, .nan]}}", "'a': point"),
        ("landmarks: {a: {link: b, point: [0, 0, x]}}", "'a': .*x"),
        ("landmarks: {a: {link: b, point: 3}}", "'a': point"),
        ("landmarks: {a: {link: b, point: [0, 0, 0]}, a: 3}", "given twice"),
        ("landmarks: [", "not a YAML file"),
    ):
        file = tmp_path / "landmarks.yaml"
        file.write_text(text, encoding="utf-8")
        with pytest.raises(ModelError, match=complaint) as caught:
            load_landmarks(tmp_path / "thing.urdf")
        assert str(file) in str(caught.value)
