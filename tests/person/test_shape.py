"""A tracker of a person of known shape."""

import numpy as np
import pytest

from drake_pose.body import ArticulatedModel
from drake_pose.errors import UnknownNameError
from drake_pose.person.pose_tracker import KnownShape, shape_parts, shape_values, tracker_of_person


def test_tracker_has_the_known_lengths_and_radius_scales(shaped_person: ArticulatedModel) -> None:
    tree = shaped_person.pose_tree()
    names = np.array([name for node in tree.nodes for name in node.value_names])
    held = shape_values(tree)
    assert held.any()
    assert not held[: len(tree.nodes[0].value_names)].any()
    length, (parts, groups) = str(names[held][0]), shape_parts(tree)
    # Left, right and end pieces belong to one part.
    assert len(parts) < len(tree.nodes)
    assert not any(word in part for part in parts for word in ("left_", "right_", "_end"))
    plain = tracker_of_person(tree, None)
    known = tracker_of_person(tree, KnownShape({length: 0.07}, {parts[2]: 1.5}))
    rest = known.fit.kinematics.flatten(tree.default_values())
    rest[names == length] = 0.07
    np.testing.assert_allclose(known.search._rest, rest)
    for group, one, other in zip(groups, plain.fit.outlines, known.fit.outlines, strict=True):
        wide = 1.5 if group == 2 else 1.0
        times = np.array([wide, 1.0, wide])
        np.testing.assert_allclose(other.vertices, times * one.vertices, atol=1e-9)


@pytest.mark.parametrize(
    ("shape", "word"),
    [(KnownShape({"nose": 0.1}, {}), "nose"), (KnownShape({}, {"tail": 2.0}), "tail")],
)
def test_unknown_lengths_and_parts_are_refused(
    shaped_person: ArticulatedModel, shape: KnownShape, word: str
) -> None:
    with pytest.raises(UnknownNameError, match=word):
        tracker_of_person(shaped_person.pose_tree(), shape)
