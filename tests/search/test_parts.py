"""Parts of bodies that are placed anew, against all placements of the grid."""

import itertools

import numpy as np
import pytest

from drake_pose.search.parts import NeighbourhoodSearch, PartSearch, find_parts, find_reflections
from drake_pose.search.refinement import RefinementBody, RefinementProblem
from tests.search.arms import gripper
from tests.search.bodies import box_link, forked_body, joint, load_body, swinging_chain
from tests.search.grid_problems import ProblemMaker


def test_parts_do_not_extend_over_a_fork_or_start_at_a_follower(tmp_path):
    """A chain has no reflection; its ends have one to three nodes."""
    fork, fingers, chain = (
        model.pose_tree()
        for model in (
            forked_body(tmp_path), gripper(tmp_path, follows=True), swinging_chain(tmp_path, 5)
        )
    )  # fmt: skip
    assert [(part.nodes, part.held) for part in find_parts(fork)] == [
        ((1,), ()), ((2,), ()), ((0,), (1, 2)),
    ]  # fmt: skip
    assert [part.nodes for part in find_parts(fingers)] == [(2, 3), (1, 2, 3), (0,)]
    assert [part.nodes for part in find_parts(chain)] == [(4,), (3, 4), (2, 3, 4), (0,), (1,)]
    assert find_reflections(chain) == ()
    (whole,) = find_reflections(fork)
    assert (whole.nodes, whole.sources, whole.held) == ((0, 1, 2), (0, 2, 1), ())


@pytest.fixture(scope="module")
def parts_of(maker):
    """The parts of bodies without skin, which the search leaves out."""
    if any(node.skin is not None for node in maker.tree.nodes):
        pytest.skip("has skin")
    body = RefinementBody(maker.tree)
    return body, PartSearch(body, maker.body.sampled.values)


def placements(body, part, grids, parameters):
    """Return the parameters of all placements of a part on its grid."""
    nodes = [node for node in part.nodes if body.tree.source(node) == node]
    found = []
    for samples in itertools.product(*(grids[node] for node in nodes)):
        placed = parameters.copy()
        for node, values in zip(nodes, samples, strict=True):
            placed[:-4][body.kinematics.value_nodes == node] = values
        found.append(placed)
    return np.array(found)


@pytest.mark.parametrize("views", [1, 2])
def test_the_best_placement_of_an_end_is_proposed_first(maker, parts_of, views):
    """It is that of least J of all placements of the grid; further ones differ."""
    body, search = parts_of
    shown = maker.make(np.random.default_rng(2), views=views, on_grid=True)
    problem = RefinementProblem(body, shown.views)
    sampled = maker.body.sampled
    for row in maker.choices[[0, len(maker.choices) // 2]]:
        start = body.parameters(sampled.values_at(row))
        for part in search.parts:
            found = search.propose(problem, start, part)
            assert 1 <= len(found) <= 3
            if part.held:
                # The children keep their direction.
                for pose in found:
                    before, after = (body.poses(one)[list(part.held)] for one in (start, pose))
                    near = np.abs(before[:, :3, :3] - after[:, :3, :3]).max(axis=(1, 2)) < 0.02
                    inside = (pose > body.lower + 0.01) & (pose < body.upper - 0.01)
                    own = inside[:-4][np.isin(body.kinematics.value_nodes, part.held)]
                    assert near[own].all()
                continue
            tried = placements(body, part, sampled.values, start)
            Js = [problem.J(one) for one in tried]
            assert problem.J(found[0]) == min(Js)
            for pose in found:
                assert np.abs(tried - pose).max(axis=1).min() == 0.0
            assert len({tuple(pose) for pose in found}) == len(found)


def test_discs_contain_a_part_at_all_joint_values(maker, parts_of):
    """They are not much larger than needed; the wrong pixels in them are counted."""
    body, search = parts_of
    problem = RefinementProblem(body, maker.make(np.random.default_rng(3), views=2).views)
    start = body.parameters(maker.body.sampled.values_at(maker.choices[1]))
    errors = np.zeros(len(search.parts))
    for k, view in enumerate(problem.views):
        discs = search.reaches(problem, start)[k]
        v, u = np.nonzero(problem.mismatch(start)[k])
        for j, (part, (x, y, r)) in enumerate(zip(search.parts, discs, strict=True)):
            errors[j] += np.count_nonzero((u - x) ** 2 + (v - y) ** 2 < r**2)
            far = []
            for pose in placements(body, part, maker.body.sampled.values, start)[::3]:
                for node, X_WN in zip(part.nodes, body.poses(pose)[list(part.nodes)], strict=True):
                    vertices = body.surfaces.rigid[node].vertices
                    uv, _ = view.camera.project(vertices @ X_WN[:3, :3].T + X_WN[:3, 3])
                    far.append(np.linalg.norm(uv - [x, y], axis=1).max())
            turns = body.kinematics.is_angle[np.isin(body.kinematics.value_nodes, part.nodes)]
            if turns.all():
                assert 0.55 * r < max(far) < 1.001 * r
    np.testing.assert_allclose(search.errors_near(problem, start), errors, rtol=0.2, atol=12.0)


def test_a_misplaced_end_is_corrected(maker, parts_of):
    """By tries of each part near an error."""
    body, search = parts_of
    for seed in (4, 5):
        generator = np.random.default_rng(seed)
        problem = RefinementProblem(body, maker.make(generator, views=2, on_grid=True).views)
        row = maker.choices[len(maker.choices) // 3]
        pose = body.parameters(maker.body.sampled.values_at(row))
        neighbourhood = NeighbourhoodSearch(problem, search)
        assert neighbourhood.improve(pose, 1e9)[1] == problem.J(pose)
        assert neighbourhood.improve(pose, 0.0, deadline=0.0)[1] == problem.J(pose)
        once, J = neighbourhood.improve(pose, 0.0, tries=1)
        assert J == problem.J(once) <= problem.J(pose)
        found, J = NeighbourhoodSearch(problem, search).improve(pose, 0.0, everywhere=True)
        assert J == problem.J(found) <= 0.25 * problem.J(pose)
        assert ((found >= body.lower) & (found <= body.upper)).all()


def test_stored_poses_that_are_as_good_are_alternatives(tmp_path):
    """An arm that is turned towards the camera looks as one that is turned away."""
    turns = joint("flip", "revolute", "trunk", "arm", (-1.3, 1.3), axis="0 1 0", y=3.0, z=8.0)
    parts = (
        box_link("trunk", 14, 20),
        joint("turn", "revolute", "world", "trunk", (-0.4, 0.4)),
        box_link("arm", 4, 20, z=10.0),
    )
    maker = ProblemMaker(load_body(tmp_path, *parts, turns).pose_tree(), interval=0.4)
    body = RefinementBody(maker.tree)
    problem = RefinementProblem(body, maker.show([np.array([0.2]), np.array([0.8])]).views)
    away, towards, other = (
        body.parameters([np.array([0.2]), np.array([value])]) for value in (0.8, -0.8, 0.0)
    )
    assert problem.J(away) == problem.J(towards) == 0
    search = NeighbourhoodSearch(problem, PartSearch(body, maker.body.sampled.values))
    search.consider([away, towards, towards + 1e-3, other], 0.0)
    (found,) = search.others(away, 2.0, 0.1)
    np.testing.assert_allclose(found, towards, atol=0.02)
    assert search.others(away, -1.0, 0.1) == search.others(away, 2.0, 2.0) == []
