"""Landmarks of the bundled models against Drake, and invalid landmark files."""

import numpy as np
import pytest

from drake_pose import body
from drake_pose.errors import ModelError, SettingsError, UnknownNameError
from tests.body.models import link_poses

JOINT_CENTRES = {"head_top", "neck"} | {
    f"{side}_{name}"
    for side in ("left", "right")
    for name in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
}
BODIES = [
    *map(body.bundled_model, ("woman", "man", "person")),
    body.bundled_model("person").with_name("person_shape.urdf"),
]
# ANSUR II means of women and men, and their averages [mm]: forearm, stature, ankle, knee.
LENGTHS = {
    "woman": (241.3, 1628.5, 62.7, 465.9),
    "man": (267.9, 1756.2, 72.9, 491.7),
    "person": (254.6, 1692.35, 67.8, 478.8),
}


@pytest.mark.parametrize("path", BODIES, ids=lambda path: path.stem)
@pytest.mark.parametrize("root", [None, "left_shin"])
def test_bundled_landmarks_match_drakes_link_poses(path, root):
    """From the model's positions, and from a pose tree that may be re-rooted."""
    model = body.load_model(path, check=False)
    landmarks, rng = body.load_landmarks(path), np.random.default_rng(1)
    assert set(landmarks) == JOINT_CENTRES
    tree = model.pose_tree(root, root_position=None if root is None else [0.3, -0.2, 0.5])
    placed = body.landmarks_of_nodes(tree, landmarks)
    assert placed.names == tuple(landmarks)
    for _ in range(3):
        values = tree.values_from_positions(rng.uniform(model.lower, model.upper))
        (q, X_WB), X_WN = tree.positions_from(values), tree.node_poses(values)
        poses = link_poses(model, q)
        expected = [(X_WB @ poses[one.link] @ [*one.point, 1.0])[:3] for one in landmarks.values()]
        np.testing.assert_allclose(body.landmark_positions(model, landmarks, q, X_WB), expected)
        batch = placed.positions(np.stack([X_WN, X_WN]))
        np.testing.assert_allclose(batch, [expected, expected], atol=1e-9)
        np.testing.assert_array_equal(placed.positions(X_WN), batch[0])


@pytest.mark.parametrize("path", BODIES, ids=lambda path: path.stem)
def test_bundled_landmarks_match_anthropometric_means(path):
    model = body.load_model(path, check=False)
    landmarks = body.load_landmarks(path)
    zero = np.zeros(len(model.position_names))
    at = dict(zip(landmarks, body.landmark_positions(model, landmarks, zero) * 1e3, strict=True))
    forearm, stature, ankle, knee = LENGTHS[path.parent.name]
    floor = at["head_top"][2] - stature
    for side in ("left", "right"):
        drop = at[f"{side}_elbow"][2] - at[f"{side}_wrist"][2]
        found = drop, at[f"{side}_ankle"][2] - floor, at[f"{side}_knee"][2] - floor
        np.testing.assert_allclose(found, (forearm, ankle, knee), atol=2.0)
    assert at["left_wrist"][1] > 100 > -100 > at["right_wrist"][1]


def test_errors_name_invalid_links_and_positions(models):
    model = models["floating"]
    wrong, q = (
        {"elbow": body.Landmark("elbow_link", np.zeros(3))},
        np.array(model.default_positions),
    )
    for call in (
        lambda: body.landmark_positions(model, wrong, q),
        lambda: body.landmarks_of_nodes(model.pose_tree(), wrong),
    ):
        with pytest.raises(
            UnknownNameError, match=r"landmarks.yaml: 'elbow'.*no link 'elbow_link'"
        ):
            call()
    with pytest.raises(ModelError, match="'end' is on link 'toe'"):
        body.landmarks_of_nodes(model.pose_tree(), {"end": body.Landmark("toe", np.zeros(3))})
    for bad in (q[:-1], np.full_like(q, np.nan)):
        with pytest.raises(SettingsError, match="finite numbers"):
            body.landmark_positions(model, {}, bad)


def test_errors_name_the_file_and_the_entry(tmp_path):
    texts = ("", "landmarks: {}", "landmarks: [1, 2]", "landmarks: {a: {link: b}}\nother: 1")
    for text, complaint in (
        *((text, "one mapping 'landmarks'") for text in texts),
        ("landmarks: {a: 3}", "'a': expected a mapping of link, point"),
        ("landmarks: {a: {link: b}}", "'a': point"),
        ("landmarks: {a: {link: b, point: [0, 0, 0], more: 1}}", "'a': .*more"),
        ("landmarks: {a: {link: 3, point: [0, 0, 0]}}", "'a': .*link"),
        ("landmarks: {a: {link: '', point: [0, 0, 0]}}", "'a': link"),
        ("landmarks: {a: {link: b, point: [0, 0]}}", "'a': point"),
        ("landmarks: {a: {link: b, point: [0, 0, .nan]}}", "'a': point"),
        ("landmarks: [", "not a YAML file"),
    ):
        file = tmp_path / "landmarks.yaml"
        file.write_text(text, encoding="utf-8")
        with pytest.raises(ModelError, match=complaint) as caught:
            body.load_landmarks(tmp_path / "thing.urdf")
        assert str(file) in str(caught.value)
