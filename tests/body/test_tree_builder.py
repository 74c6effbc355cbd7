"""Pose trees against Drake's plant: random bodies, every root, bases, held and followed joints."""

import numpy as np
import pytest

from drake_pose.body import PoseTree, RootRotation, load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import ModelError, SettingsError, UnknownNameError
from tests.body import models as bodies
from tests.body.models import (
    HAND,
    HAND_JOINTS,
    HAND_LINKS,
    joint,
    link,
    link_poses,
    random_urdf,
    urdf,
    write,
)


def assert_as_drake(tree: PoseTree, samples: int = 3) -> None:
    """Compare node_poses, positions_from and values_from_positions with Drake's plant."""
    model, random = tree.model, np.random.default_rng(1)
    bounds = [tree.value_bounds(i) for i in range(len(tree.nodes))]
    drawn = [random.uniform(low, high, (samples, len(low))) for low, high in bounds]
    for k, X_WN in enumerate(tree.node_poses_batch(drawn)):
        values = [rows[k] for rows in drawn]
        q, X_WB = tree.positions_from(values)
        poses = link_poses(model, q)
        again = tree.node_poses(tree.values_from_positions(q, X_WB))
        np.testing.assert_allclose(again, X_WN, atol=1e-9)
        np.testing.assert_allclose(TreeKinematics(tree).poses(np.hstack(values)), X_WN, atol=1e-9)
        for node, X, given in zip(tree.nodes, X_WN, values, strict=True):
            np.testing.assert_allclose(X_WB @ poses[node.name], X, atol=1e-9)
            assert np.all(q[list(node.positions)] == given[: len(node.positions)])
        for follower, leader, multiplier, offset in tree.followers:
            assert q[follower] == pytest.approx(multiplier * q[leader] + offset)
        for index, value in tree.held.items():
            assert q[index] == value


def assert_structure(tree: PoseTree) -> None:
    nodes, model = tree.nodes, tree.model
    for k, node in enumerate(nodes):
        assert node.depth == (0 if node.parent < 0 else nodes[node.parent].depth + 1)
        assert node.children == tuple(i for i, one in enumerate(nodes) if one.parent == k)
        below = {k}.union(*(tree.subtrees[child] for child in node.children))
        assert tree.subtrees[k] == tuple(sorted(below))
        # Only a followed branch may leave a link without geometry that joins no others.
        joins = len(node.children) > 1 or bool(tree.followers)
        assert joins or not node.mesh.is_empty
        assert tree.node_index(node.name) == k
        assert tree.source(k) == (node.parent if tree.placements[k].follows else k)
    assert tree.leaves == tuple(k for k, node in enumerate(nodes) if not node.children)
    order = [(node.depth, model.link_index(node.name)) for node in nodes]
    assert order == sorted(order)
    drawn = sum(len(mesh.triangles) for mesh in model.link_meshes.values())
    assert sum(len(node.mesh.triangles) for node in nodes) == drawn


@pytest.mark.filterwarnings("ignore:.*is written to follow")
@pytest.mark.parametrize("seed", range(20))
def test_random_bodies_match_drake_from_any_root(tmp_path, seed):
    rng = np.random.default_rng(seed)
    model = load_model(write(tmp_path, random_urdf(rng)), check=False)
    own = model.pose_tree()
    trees = [own]
    limited = RootRotation.limited([("y", -170.0, 180.0), ("z", -10.0, 10.0)])
    turns = [None, RootRotation.free(20.0), RootRotation.fixed(), limited]
    for root, turn in zip(rng.choice(sorted(model.link_meshes), 4), turns, strict=True):
        trees.append(model.pose_tree(root, root_position=[0.3, 0.2, 0.1], root_rotation=turn))
        assert trees[-1].nodes[0].name == root
        X_WN = trees[-1].node_poses(trees[-1].default_values())
        np.testing.assert_allclose(X_WN[0, :3, 3], [0.3, 0.2, 0.1], atol=1e-12)
    searched = [name for node in own.nodes for name in node.position_names]
    held = {str(rng.choice(searched)): 0.2} if searched else {}
    held = {name: value for name, value in held.items() if not name.startswith("l")}
    trees.append(model.pose_tree(held=held))
    for tree in trees:
        assert_as_drake(tree)
        assert_structure(tree)
    # Whatever is not enforced is searched by itself.
    values = {position for node in own.nodes for position in node.positions}
    for coupling in model.couplings:
        pair = set(coupling[:2])
        is_still = {model.position_names[k] for k in pair} & set(own.unobserved_positions)
        assert pair <= values or is_still or pair & {one.follower for one in own.followers}


PALM = [
    *(link("palm", ""), link("thumb"), link("finger")),
    joint("wrist", "revolute", "world", "palm"),
    joint("t", "revolute", "palm", "thumb"),
    joint("f", "revolute", "palm", "finger"),
]
BESIDE = [
    *(link("table"), link("cup"), link("handle")),
    joint("t", "fixed", "world", "table", limits=None),
    joint("h", "revolute", "cup", "handle"),
]


def test_nodes_of_links_without_geometry_and_of_the_world(tmp_path):
    chain = [("trunk", -1), ("arm", 0), ("leg", 0), ("hand", 1)]
    for text, root, nodes in (
        (bodies.FLOATING_URDF, None, chain),
        # A branching link without geometry is a node with an empty mesh ...
        (urdf(*PALM), None, [("palm", -1), ("thumb", 0), ("finger", 0)]),
        # ... but is skipped where re-rooting makes it part of a chain.
        (urdf(*PALM), "finger", [("finger", -1), ("thumb", 0)]),
        # Geometry welded to the world is a further root beside a floating body.
        (urdf(*BESIDE), "handle", [("handle", -1), ("cup", 0), ("table", -1)]),
    ):
        model = load_model(write(tmp_path, text), check=False)
        tree = model.pose_tree(root, root_position=None if root is None else [0, 0, 1])
        if text == bodies.FLOATING_URDF:
            assert tree.unobserved_positions == ("toe_joint",)
        assert [(node.name, node.parent) for node in tree.nodes] == nodes
        assert [node.mesh.is_empty for node in tree.nodes] == [name == "palm" for name, _ in nodes]
        assert_as_drake(tree)
        roots = [k for k, node in enumerate(tree.nodes) if node.parent < 0]
        if root == "handle":
            # Only the first root's body moves; what stands beside it stays.
            values = tree.default_values()
            q, X_WB = tree.positions_with_root_at(values, np.array([0.3, 0.1, 0.2]))
            poses = link_poses(model, q)
            placed = [(X_WB @ poses[tree.nodes[k].name])[:3, 3] for k in roots]
            before = tree.node_poses(values)[roots[1:], :3, 3]
            np.testing.assert_allclose(placed, [[0.3, 0.1, 0.2], *before], atol=1e-9)


@pytest.mark.parametrize("step", [1, -1], ids=["leader first", "leader last"])
def test_followers_hang_on_the_node_that_leads_them(tmp_path, step):
    model = load_model(write(tmp_path, urdf(*HAND_LINKS, *HAND_JOINTS[::step])), check=False)
    tree = model.pose_tree()
    assert TreeKinematics(tree).names == ("wrist", "lead", "scratch", "far")
    sources = [tree.nodes[tree.source(i)].name for i in range(6)]
    assert sources == ["palm", "one", "one", "one", "nail", "far"]
    q, _ = tree.positions_from([0.3 + 0 * values for values in tree.default_values()])
    lead, mirror, bend = (model.position_index(name) for name in ("lead", "mirror", "bend"))
    np.testing.assert_allclose(q[[mirror, bend]], [0.1 - q[lead], -0.5 * q[lead]])
    with pytest.warns(UserWarning, match=r"joint 'bend' is .* joint 'lead' \(<mimic>: -0.5"):
        tree.values_from_positions(q + 0.1 * (np.arange(len(q)) == bend))


def test_leaders_and_followers_of_held_joints_are_held(tmp_path):
    model = load_model(write(tmp_path, HAND), check=False)
    for held in ({"mirror": -0.3}, {"lead": 0.4}, {"bend": -0.2}, {"mirror": -0.3, "lead": 0.4}):
        tree = model.pose_tree(held=held)
        assert_as_drake(tree)
        found = {model.position_names[k]: value for k, value in tree.held.items()}
        expected = {"lead": 0.4, "mirror": -0.3, "bend": -0.2, "far": 0.4}
        assert found == {name: pytest.approx(value) for name, value in expected.items()}
    with pytest.raises(SettingsError, match=r"'mirror' is held at -0.3, but it follows .* 'lead'"):
        model.pose_tree(held={"mirror": -0.3, "lead": 0.1})


def planar_robot(*more):
    """A body that slides and rotates in a plane, and an arm."""
    free = {"limits": None, "origin": ""}
    parts = [
        *(link(name, "") for name in ("bx", "bz")),
        *map(link, ("body", "arm")),
        joint("x", "prismatic", "world", "bx", axis="1 0 0", limits=None),
        joint("z", "prismatic", "bx", "bz", axis="0 0 1", **free),
        joint("turn", "continuous", "bz", "body", axis="0 1 0", **free),
        joint("shoulder", "revolute", "body", "arm"),
    ]
    return "".join([*parts, *more])


def test_unlimited_slides_place_the_only_object(tmp_path):
    model = load_model(write(tmp_path, urdf(planar_robot())), check=False)
    slides = [model.position_index("x"), model.position_index("z")]
    moved = model.pose_tree(root_position=(1.0, -2.0, 3.0))
    turned = model.pose_tree("arm", root_position=(0.0, 0.0, 0.0))
    with pytest.warns(UserWarning, match=r"no limits.* a lower and an upper limit .*: x, z"):
        own = model.pose_tree()
    assert own.assumed == ("x", "z")
    for tree in (own, moved, turned):
        assert_as_drake(tree)
        assert tree is turned or dict(tree.held) == dict.fromkeys(slides, 0.0)
    assert model.pose_tree(held={"x": 0.0, "z": 0.1}).warnings == []
    X_WN = moved.node_poses(moved.default_values())
    np.testing.assert_allclose(X_WN[0, :3, 3], (1.0, -2.0, 3.0), atol=1e-12)


def slides_and_turns(*axes, turns=("1 0 0", "0 1 0", "0 0 1"), bent=""):
    """A hand and a finger that three slides and three turns carry; `bent`: the turns' origin."""
    kinds = [("prismatic", 'lower="-5" upper="5"')] * len(axes) + [("revolute", None)] * len(turns)
    names = [f"b{k}" for k in range(len(kinds) - 1)]
    carried, parts = [*names, "hand"], [link(name, "") for name in names]
    for k, ((kind, limits), axis) in enumerate(zip(kinds, (*axes, *turns), strict=True)):
        where = {"axis": axis, "origin": bent if limits is None else "", "limits": limits}
        where["limits"] = limits or 'lower="-1" upper="1"'
        parts.append(
            joint(f"j{k}", kind, "world" if k == 0 else carried[k - 1], carried[k], **where)
        )
    return urdf(*parts, link("hand"), link("finger"), joint("f", "revolute", "hand", "finger"))


def test_base_joints_take_up_the_roots_pose_if_they_reach_it(tmp_path):
    """Held ones stay where the others suffice; values are within the limits if possible."""
    axes = ("1 0 0", "0 1 0", "0 0 1", "1 1 0")
    model = load_model(write(tmp_path, slides_and_turns(*axes)), check=False)
    tree = model.pose_tree("finger", root_position=[1, 2, 3], held={"j3": 0.7, "f": 0.1})
    assert dict(tree.held) == {3: 0.7, 7: 0.1}
    assert_as_drake(tree)
    # A pose that values within the limits reach is reached by such.
    rng = np.random.default_rng(0)
    for _ in range(10):
        q = rng.uniform(model.lower, model.upper)
        q[[3, 7]] = 0.7, 0.1
        pose = link_poses(model, q)["finger"]
        rotation = RootRotation.fixed(pose[:3, :3])
        at = {
            "root_position": pose[:3, 3],
            "root_rotation": rotation,
            "held": {"j3": 0.7, "f": 0.1},
        }
        placed = model.pose_tree("finger", **at)
        found, X_WB = placed.positions_from(placed.default_values())
        np.testing.assert_array_equal(X_WB, np.eye(4))
        np.testing.assert_allclose(link_poses(model, found)["finger"], pose, atol=1e-9)
        assert np.all((found >= model.lower - 1e-8) & (found <= model.upper + 1e-8))
    arm = slides_and_turns(turns=("1 0 0", "0 1 0", "0 0 1") * 2, bent='xyz="0.1 0.2 0.3"')
    far = load_model(write(tmp_path, arm), check=False).pose_tree("finger", root_position=[9, 9, 9])
    with pytest.raises(ModelError, match=r"'j0', 'j1'.*reach"):
        far.positions_from(far.default_values())


def test_three_slides_carry_the_root_to_a_given_position(tmp_path):
    turns, place = ("1 0 0", "0 1 0"), (1.0, -2.0, 0.5)

    def tree_of(*axes, **more):
        text = slides_and_turns(*axes, turns=turns, **more)
        return load_model(write(tmp_path, text), check=False).pose_tree(root_position=place)

    tree = tree_of("1 0 0", "0 1 1", "0 1 -1")
    assert_as_drake(tree)
    assert list(tree.held) == [0, 1, 2]
    X_WN = tree.node_poses(tree.default_values())
    np.testing.assert_allclose(X_WN[0, :3, 3], place, atol=1e-12)
    with pytest.raises(ModelError, match="j0, j1, j2 do not span"):
        tree_of("1 0 0", "0 1 0", "1 1 0")
    with pytest.raises(ModelError, match="origin moves"):
        tree_of("1 0 0", "0 1 0", "0 0 1", bent='xyz="0 0.1 0.1"')


def test_refusals_name_the_culprit(models, tmp_path):
    ball = link("ball") + joint("y", "prismatic", "world", "ball", limits=None)
    hand = link("hand") + joint("grip", "prismatic", "arm", "hand", limits=None)
    texts = {"two": planar_robot(ball), "grip": planar_robot(hand), "both": link("a") + link("b")}
    made = {k: load_model(write(tmp_path, urdf(t)), check=False) for k, t in texts.items()}
    made |= models
    held, still = {"x": 0.0, "z": 0.1, "y": 0.2}, RootRotation.fixed()
    made["two"].pose_tree(held=held)
    made["welded"].pose_tree(held={"a1": 1.0 + 5e-7})
    for name, root, arguments, error, words in (
        ("floating", "nose", {}, UnknownNameError, "link 'nose'.*trunk"),
        ("floating", "between", {}, ModelError, "'between' has no visual geometry"),
        ("floating", None, {"held": {"nose": 1.0}}, UnknownNameError, "joint 'nose'"),
        ("floating", "leg", {}, SettingsError, "root_position"),
        ("floating", None, {"root_position": [0, 0, np.nan]}, SettingsError, "three finite"),
        ("floating", None, {"root_position": [0, 0]}, SettingsError, "three finite"),
        ("floating", None, {"held": {"slide": np.inf}}, SettingsError, "finite number"),
        ("floating", None, {"held": {"slide": 0.4}}, SettingsError, r"'slide' .* 0\.4, outside"),
        ("welded", None, {"held": {"a1": 1.1}}, SettingsError, "'a1'.*outside"),
        ("jointed", "arm", {"root_position": [0, 0, 0], "held": {"head_y": 0.0}}, SettingsError,
         "head_y cannot be held.*'arm'"),
        ("two", None, {}, ModelError, r"'x', 'z', 'y' have no limits.*of 2 objects"),
        ("two", None, {"held": held, "root_position": [0, 0, 0]}, SettingsError, "several links"),
        ("grip", None, {}, ModelError, "joint 'grip' has no limits"),
        ("two", None, {"held": held, "root_rotation": still}, SettingsError, "one of body, ball"),
        ("both", None, {}, ModelError, "a, b float freely"),
    ):  # fmt: skip
        with pytest.raises(error, match=words):
            made[name].pose_tree(root, **arguments)
