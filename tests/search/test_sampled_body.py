"""Areas, balls and orders of a sampled body, against drawings of whole grids."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import RootRotation
from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.search import Scoring
from drake_pose.search.sampled_body import GridSettings, SampledBody
from drake_pose.silhouette.scoring import draw_mask
from tests.search.bodies import box_link, forked_body, joint, load_body, swinging_chain


def random_rows(maker, count):
    return maker.choices[np.random.default_rng(1).integers(len(maker.choices), size=count)]


@pytest.mark.parametrize("count", [1, 2])
def test_objectives_and_areas_are_those_of_drawings(maker, count):
    problem = maker.make(np.random.default_rng(0), views=count, noise=0.05)
    sampled, masks = maker.body.sampled, np.array([view.mask for view in problem.views])
    scoring = Scoring(sampled, problem.views)
    np.testing.assert_array_equal(scoring.J(maker.choices), problem.Js)
    assert scoring.silhouette_area == masks.sum()
    nodes = range(len(sampled.values))
    first = maker.choices[0]
    X_WN = sampled.poses(first[None])[0]
    areas = [[one.sum() for one in maker.draw_node(i, sampled.values_at(first), count)]
             for i in nodes]  # fmt: skip
    assert scoring.mean_node_areas(X_WN) == pytest.approx(np.mean(areas, axis=0), abs=2.0)
    for row in random_rows(maker, 5):
        values, X_WN = sampled.values_at(row), sampled.poses(row[None])[0]
        np.testing.assert_allclose(X_WN, maker.tree.node_poses(values), atol=1e-12)
        parts = np.array([maker.draw_node(i, values, count) for i in nodes])
        for placed in ([], [0], [0, 2], [*nodes]):
            left = masks & ~parts[placed].any(axis=0)
            regions = scoring.uncovered(placed, row, X_WN)
            np.testing.assert_array_equal([mask > 0 for mask, _ in regions], left)
            for node in nodes:
                found = scoring.candidate_areas(node, row[[node]], X_WN[[node]], regions)
                outside, covered = (parts[node] & ~masks), (parts[node] & left)
                np.testing.assert_array_equal(found[0][:, 0], outside.sum(axis=(1, 2)))
                assert found[1].item() == covered.sum()
            for k in range(count):
                drawn = scoring.draw(placed, row[placed], X_WN[placed], k)
                np.testing.assert_array_equal(drawn, parts[placed].any(axis=0)[k])


def test_reach_balls_contain_a_node_and_all_below_it_at_all_samples(maker):
    body, tree, slack = maker.body, maker.tree, []
    for row in random_rows(maker, 100):
        X_WN, values = body.sampled.poses(row[None])[0], body.sampled.values_at(row)
        surfaces = body.sampled.surfaces.at(values)
        for i, node in enumerate(tree.nodes):
            X_WP = np.eye(4) if node.parent < 0 else X_WN[node.parent]
            centre = X_WP[:3, :3] @ body.reach_balls[i, :3] + X_WP[:3, 3]
            points = [
                surfaces[j].vertices @ X_WN[j, :3, :3].T + X_WN[j, :3, 3] for j in tree.subtrees[i]
            ]
            far = np.linalg.norm(np.vstack(points) - centre, axis=1).max()
            slack.append(1.0 - far / body.reach_balls[i, 3])
    # They are not much larger than needed.
    assert -1e-9 <= min(slack) < 0.2


def test_inscribed_balls_lie_within_the_node_or_about_its_childrens_joints(maker):
    body, nodes, shown_count = maker.body, maker.tree.nodes, 0
    ring = np.array([[np.cos(a), np.sin(a)] for a in np.arange(12) * np.pi / 6])
    for row in random_rows(maker, 15):
        X_WN, values = body.sampled.poses(row[None])[0], body.sampled.values_at(row)
        for i, node in enumerate(nodes):
            shown = [i, *node.children]
            drawn = np.any([maker.draw_node(j, values, 2) for j in shown], axis=0)
            X_WP = np.eye(4) if node.parent < 0 else X_WN[node.parent]
            p_PB = body.p_PB[i][row[i]]
            for camera, mask in zip(maker.cameras, drawn, strict=True):
                uv, _ = camera.project(p_PB @ X_WP[:3, :3].T + X_WP[:3, 3])
                around = uv[:, None] + 100.0 * body.ball_radii[i][:, None, None] * ring
                u, v = np.rint(around.reshape(-1, 2)).astype(int).T
                seen = (u >= 0) & (v >= 0) & (u < maker.side) & (v < maker.side)
                # Up to a pixel, by which a ball's edge is rounded.
                near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
                assert near[v[seen], u[seen]].all()
                shown_count += np.count_nonzero(seen)
            # The farthest from the node's joint comes first.
            away = np.linalg.norm(p_PB[:10] - body.sampled.X_PN[i][row[i]][:3, 3], axis=1)
            assert away[0] >= away[: len(p_PB) - len(node.children)].max() - 1e-9
    assert shown_count > 1000


def test_a_moved_root_moves_everything_at_it(tmp_path):
    model, position = swinging_chain(tmp_path, 3), np.array([0.1, 0.2, 0.3])
    rotation = RootRotation.limited([("x", -60, 60)])
    tree = model.pose_tree(root="segment_0", root_position=np.zeros(3), root_rotation=rotation)
    body = SampledBody(tree, GridSettings(interval=0.5))
    moved = body.with_root_position(position)
    again = SampledBody(tree.with_root_position(position), GridSettings(interval=0.5))
    for i in range(3):
        np.testing.assert_allclose(moved.sampled.X_PN[i], again.sampled.X_PN[i])
        np.testing.assert_allclose(moved.p_PB[i], again.p_PB[i])
    np.testing.assert_allclose(moved.reach_balls, again.reach_balls, atol=1e-9)
    assert not np.allclose(body.sampled.X_PN[0], moved.sampled.X_PN[0])


def test_orders_place_parents_first_and_ends_of_limbs_last(tmp_path):
    parts = [box_link("trunk", 10, 40), joint("turn", "revolute", "world", "trunk", (-1.0, 1.0))]
    for side, size in (("short", 8), ("long", 16)):
        parts += [
            box_link(f"{side}_upper", 4, size),
            joint(f"{side}_1", "revolute", "trunk", f"{side}_upper", (-1.0, 1.0)),
            box_link(f"{side}_lower", 3, size),
            joint(f"{side}_2", "revolute", f"{side}_upper", f"{side}_lower", (-1.0, 1.0)),
        ]
    body = SampledBody(load_body(tmp_path, *parts).pose_tree(), GridSettings(interval=0.5))
    nodes = body.sampled.tree.nodes
    names = [[nodes[i].name for i in order] for order in (body.order, body.limb_order)]
    assert names[0] == ["trunk", "long_upper", "short_upper", "long_lower", "short_lower"]
    assert names[1] == ["trunk", "long_upper", "long_lower", "short_upper", "short_lower"]
    assert body.forked == [node.name == "trunk" for node in nodes]
    for placed in map(frozenset, ((), (0,), (0, 1), (0, 1, 2), (0, 1, 2, 3, 4))):
        open_nodes, waiting = body.frontier(placed)
        assert waiting == [
            k for k, n in enumerate(nodes)
            if k not in placed and (n.parent < 0 or n.parent in placed)
        ]  # fmt: skip
        assert open_nodes.tolist() == [
            k for k in sorted(placed) if any(child not in placed for child in nodes[k].children)
        ]


def test_mean_areas_are_those_of_drawings_from_all_sides(tmp_path):
    """Of convex parts; a pinhole shows them at the roots' mean distance."""
    body = SampledBody(forked_body(tmp_path).pose_tree(), GridSettings(interval=0.5))
    camera = ParallelCamera("flat", 200, 200, 300.0, 99.5, 99.5, np.eye(4))
    for node, outline in enumerate(body.sampled.outlines):
        areas = []
        for R in Rotation.random(60, random_state=6).as_matrix():
            X_CN = np.eye(4)
            X_CN[:3, :3], X_CN[:3, 3] = R, -R @ outline.ball[:3]
            areas.append(draw_mask([outline], X_CN[None], camera).sum())
        assert body.mean_area(node, camera) == pytest.approx(np.mean(areas), rel=0.08)
    far = np.eye(4)
    far[:3, 3] = 0.0, 0.0, -4.0
    eye = PinholeCamera("eye", 200, 200, 500.0, 500.0, 99.5, 99.5, far)
    distances = np.linalg.norm(body.sampled.X_PN[0][:, :3, 3] - far[:3, 3], axis=1)
    np.testing.assert_allclose(body.root_distances(eye), distances)
    scale = (500.0 / distances.mean() / 300.0) ** 2
    assert body.mean_area(1, eye) == pytest.approx(scale * body.mean_area(1, camera))
