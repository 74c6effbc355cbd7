"""A tracker of a person of known shape."""

import numpy as np

from drake_pose.fit.surfaces import with_radius_scales
from drake_pose.person.pose_tracker import PersonShape, shape_parts, shape_values, tracker_of_person


def test_tracker_has_the_known_lengths_and_radius_scales(shaped_person):
    tree = shaped_person.pose_tree()
    held = shape_values(tree)
    assert held.any()
    assert not held[: len(tree.nodes[0].value_names)].any()
    parts, groups = shape_parts(tree)
    # Left, right and end pieces belong to one part.
    assert len(parts) < len(tree.nodes)
    assert not any(word in part for part in parts for word in ("left_", "right_", "_end"))
    plain = tracker_of_person(tree, None)
    scales = np.where(np.array(groups) == 2, 1.5, 1.0)
    values = np.where(np.cumsum(held) == 1, 0.07 * held, 0.0)
    outlines = with_radius_scales(plain.fit.outlines, scales)
    nothing = np.zeros((0, 0))
    known = tracker_of_person(tree, PersonShape({}, {}, values, nothing, nothing, outlines))
    q = known.positions(known.with_held(np.full(len(held), 0.3)))
    np.testing.assert_allclose(known.values(q)[held], values[held])
    np.testing.assert_allclose(known.values(q)[~held], 0.3)
    for scale, one, other in zip(scales, plain.fit.outlines, known.fit.outlines, strict=True):
        times = np.array([scale, 1.0, scale])
        np.testing.assert_allclose(other.vertices, times * one.vertices, atol=1e-9)
