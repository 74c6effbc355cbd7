"""Pose trees against Drake's plant, sampling grids, and root rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import BASE_JOINTS, TARGET_POSITIONS, RootRotation, TriangleMesh, load_model
from drake_pose.body.pose_tree import axis_samples, product_grid
from drake_pose.body.root import even_rotations
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import ModelError, SettingsError, UnknownNameError
from drake_pose.search.estimates import PoseSet, joint_estimates
from tests.body import models as bodies
from tests.body.models import SPHERE, joint, link, link_poses, urdf, write


def largest_difference_from_drake(model, tree, *, samples=20):
    """Largest difference of node_poses, positions_from and values_from_positions from Drake."""
    random = np.random.default_rng(1)
    bounds = [tree.value_bounds(i) for i in range(len(tree.nodes))]
    drawn = [random.uniform(low, high, (samples, len(low))) for low, high in bounds]
    worst = 0.0
    for k, X_WN in enumerate(tree.node_poses_batch(drawn)):
        values = [rows[k] for rows in drawn]
        q, X_WB = tree.positions_from(values)
        poses = link_poses(model, q)
        again = tree.node_poses(tree.values_from_positions(q, X_WB))
        worst = max(worst, np.abs(again - X_WN).max())
        for node, X, given in zip(tree.nodes, X_WN, values, strict=True):
            worst = max(worst, np.abs(X_WB @ poses[node.name] - X).max())
            assert np.all(q[list(node.positions)] == given[: len(node.positions)])
    return worst


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    texts = {"floating": bodies.FLOATING_URDF, "jointed": bodies.JOINTED_BASE_URDF}
    texts["welded"] = bodies.WELDED_URDF
    folder = tmp_path_factory.mktemp("models")
    files = {name: write(folder, text, f"{name}.urdf") for name, text in texts.items()}
    files["all_joints"] = write(folder, bodies.JOINTS_SDF, "all_joints.sdf")
    return {name: load_model(file, check=False) for name, file in files.items()}


def loaded(folder, *parts):
    return load_model(write(folder, urdf(*parts)), check=False)


def test_links_without_geometry_and_welded_links_merge(models):
    floating = models["floating"]
    tree = floating.pose_tree()
    assert [node.name for node in tree.nodes] == ["trunk", "arm", "leg", "hand"]
    assert [node.parent for node in tree.nodes] == [-1, 0, 0, 1]
    assert [node.depth for node in tree.nodes] == [0, 1, 1, 2]
    assert tree.nodes[0].children == (1, 2)
    assert tree.nodes[1].position_names == ("shoulder_x", "shoulder_y")
    assert tree.leaves == (2, 3)
    assert tree.unobserved_positions == ("toe_joint",)
    hand = floating.link_meshes["hand"].triangles
    welded = floating.link_meshes["welded"].triangles
    assert len(tree.nodes[3].mesh.triangles) == len(hand) + len(welded)


@pytest.mark.parametrize(
    ("name", "root"),
    [
        *(("floating", root) for root in (None, "trunk", "arm", "hand", "welded", "leg")),
        *(("jointed", root) for root in ("head", "chest", "arm")),
        *(("welded", root) for root in (None, "base", "upper", "lower")),
        *(("all_joints", root) for root in ("a", "c", "e", "f")),
    ],
)
@pytest.mark.parametrize("kind", ["own", "free", "fixed", "limited"])
def test_every_tree_matches_drake(models, name, root, kind):
    rotation = {"own": None, "free": RootRotation.free(20.0), "fixed": RootRotation.fixed()}
    rotation["limited"] = RootRotation.limited([("y", -170.0, 180.0), ("z", -10.0, 10.0)])
    at = {"root_position": [0.3, 0.2, 0.1], "root_rotation": rotation[kind]}
    tree = models[name].pose_tree(root, **at)
    assert largest_difference_from_drake(models[name], tree, samples=4) < 1e-9
    place = tree.node_poses(tree.default_values())[0][:3, 3]
    np.testing.assert_allclose(place, [0.3, 0.2, 0.1], atol=1e-12)
    if root is not None:
        assert tree.nodes[0].name == root
    if name == "jointed":
        _, X_WB = tree.positions_from(tree.default_values())
        np.testing.assert_array_equal(X_WB, np.eye(4))


def planar_robot(*more):
    """A body that slides and rotates in a plane, and an arm."""
    free = {"limits": None, "origin": ""}
    return urdf(
        *(link(name, "") for name in ("bx", "bz")),
        *map(link, ("body", "arm")),
        joint("x", "prismatic", "world", "bx", axis="1 0 0", limits=None),
        joint("z", "prismatic", "bx", "bz", axis="0 0 1", **free),
        joint("turn", "continuous", "bz", "body", axis="0 1 0", **free),
        joint("shoulder", "revolute", "body", "arm"),
        *more,
    )


def test_unlimited_slides_place_the_only_object(tmp_path):
    model = load_model(write(tmp_path, planar_robot()), check=False)
    slides = [model.position_index("x"), model.position_index("z")]
    moved = model.pose_tree(root_position=(1.0, -2.0, 3.0))
    turned = model.pose_tree("arm", root_position=(0.0, 0.0, 0.0))
    with pytest.warns(UserWarning, match=r"no limits.* a lower and an upper limit .*: x, z"):
        own = model.pose_tree()
    for tree in (own, moved, turned):
        assert largest_difference_from_drake(model, tree) < 1e-9
    for tree in (own, moved):
        assert dict(tree.held) == dict.fromkeys(slides, 0.0)
    kinematics = TreeKinematics(own)
    ends = kinematics.lower, kinematics.upper, kinematics.lower == kinematics.upper
    found = PoseSet((), joint_estimates(kinematics, *ends), 0.0, True, 1).position_intervals(own)
    assert np.isnan(found[:, slides]).all()
    assert model.pose_tree(held={"x": 0.0, "z": 0.1}).warnings == []
    X_WN = moved.node_poses(moved.default_values())
    np.testing.assert_allclose(X_WN[0, :3, 3], (1.0, -2.0, 3.0), atol=1e-12)


def test_unlimited_slides_are_refused_if_searched(tmp_path):
    ball = link("ball") + joint("y", "prismatic", "world", "ball", limits=None)
    model = load_model(write(tmp_path, planar_robot(ball)), check=False)
    with pytest.raises(ModelError, match=r"'x', 'z', 'y' have no limits.*of 2 objects"):
        model.pose_tree()
    held = {"x": 0.0, "z": 0.1, "y": 0.2}
    model.pose_tree(held=held)
    with pytest.raises(SettingsError, match="several links are attached to the world"):
        model.pose_tree(root_position=[0.0, 0.0, 0.0], held=held)
    hand = link("hand") + joint("grip", "prismatic", "arm", "hand", limits=None)
    model = load_model(write(tmp_path, planar_robot(hand)), check=False)
    with pytest.raises(ModelError, match="joint 'grip' has no limits"):
        model.pose_tree()


def test_planar_joint_matches_drake_and_needs_limits(tmp_path):
    planar = """<sdf version="1.9" xmlns:drake="http://drake.mit.edu"><model name="m">
    <link name="a"><visual name="v"><geometry><sphere><radius>0.1</radius></sphere></geometry>
    </visual></link><link name="b"><pose>1 2 3 0.1 0.2 0.3</pose><visual name="v"><geometry><sphere>
    <radius>0.1</radius></sphere></geometry></visual></link>
    <drake:joint name="p" type="planar"><drake:parent>a</drake:parent>
    <drake:child>b</drake:child><drake:damping>0 0 0</drake:damping></drake:joint></model></sdf>"""
    path = write(tmp_path, planar, "planar.sdf")
    with pytest.raises(ModelError, match=r"joints 'p_x', 'p_y' have no limits"):
        load_model(path, check=False).pose_tree()
    limits = {"p_x": (-1.0, 1.0), "p_y": (0.0, 2.0)}
    model = load_model(path, limits=limits, check=False)
    assert model.upper[model.position_index("p_y")] == 2.0
    assert largest_difference_from_drake(model, model.pose_tree()) < 1e-9
    with pytest.raises(UnknownNameError, match="joint 'nose'"):
        load_model(path, limits={"nose": (0.0, 1.0)}, check=False)


HAND = [
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
HANGING = [
    *(link("ball", SPHERE), link("upper"), link("lower")),
    joint("a1", "revolute", "world", "upper"),
    joint("a2", "revolute", "upper", "lower"),
]


def test_nodes_of_links_without_geometry_and_of_the_world(tmp_path):
    for parts, root, nodes in (
        # A branching link without geometry is a node with an empty mesh ...
        (HAND, None, [("palm", -1), ("thumb", 0), ("finger", 0)]),
        # ... but is skipped where re-rooting makes it part of a chain.
        (HAND, "finger", [("finger", -1), ("thumb", 0)]),
        # Geometry welded to the world is a further root beside a floating body.
        (BESIDE, "handle", [("handle", -1), ("cup", 0), ("table", -1)]),
        # So are links attached to a world without geometry.
        (HANGING, None, [("ball", -1), ("upper", -1), ("lower", 1)]),
    ):
        model = loaded(tmp_path, *parts)
        tree = model.pose_tree(root, root_position=None if root is None else [0, 0, 1])
        assert [(node.name, node.parent) for node in tree.nodes] == nodes
        assert [node.mesh.is_empty for node in tree.nodes] == [name == "palm" for name, _ in nodes]
        assert largest_difference_from_drake(model, tree) < 1e-9


def test_errors_of_arguments_name_the_culprit(models):
    for root, arguments, error, words in (
        ("nose", {}, UnknownNameError, "link 'nose'.*trunk"),
        ("between", {}, ModelError, "'between' has no visual geometry"),
        (None, {"held": {"nose": 1.0}}, UnknownNameError, "joint 'nose'"),
        ("leg", {}, SettingsError, "root_position"),
        (None, {"root_position": [0, 0, np.nan]}, SettingsError, "three finite"),
        (None, {"held": {"slide": np.inf}}, SettingsError, "finite number"),
        (None, {"held": {"slide": 0.4}}, SettingsError, r"'slide' .* 0\.4, outside its limits, -0"),
    ):
        with pytest.raises(error, match=words):
            models["floating"].pose_tree(root, **arguments)


def test_invalid_grids_values_and_models_are_refused(models, tmp_path):
    tree, two = models["floating"].pose_tree(), loaded(tmp_path, link("a"), link("b"))
    held = {"root_position": [0, 0, 0], "held": {"head_y": 0.0}}
    for make, words in (
        (lambda: models["jointed"].pose_tree("arm", **held), "cannot be held"),
        (lambda: tree.relative_transforms(1, np.zeros((3, 1))), "shape"),
        (lambda: product_grid([range(1000)] * 3, "head"), "node 'head'"),
        (lambda: axis_samples(-1.0, 1.0, 1e-12, is_angle=True), r"1e-12.*larger interval"),
        *((lambda bad=bad: tree.grid(0, bad), "positive number") for bad in (0.0, -1.0, np.inf)),
        (lambda: tree.grid(0, np.nan), "'interval' is nan: give a positive number"),
        (lambda: tree.grid(0, 0.5, np.nan), "'length_interval'"),
    ):
        with pytest.raises(SettingsError, match=words):
            make()
    with pytest.raises(ModelError, match="a, b float freely"):
        two.pose_tree()


TWENTY = np.radians(20.0)


def test_samples_are_sorted_by_magnitude_negative_first():
    for lower, upper, expected in (
        (-60, 60, [0, -20, 20, -40, 40, -60, 60]),
        (-100, 10, [0, -20, -40, -60, -80, -100]),
        (0, 40, [0, 20, 40]),
        (25, 35, [30]),
        (5, 5, [5]),
        (50, 110, [60, 80, 100]),
    ):
        samples = axis_samples(np.radians(lower), np.radians(upper), TWENTY, is_angle=True)
        np.testing.assert_allclose(np.degrees(samples), expected, atol=1e-9)
        assert min(samples) >= np.radians(lower)
        assert max(samples) <= np.radians(upper)


def test_full_turn_has_each_direction_once():
    samples = np.degrees(axis_samples(-np.pi, np.pi, TWENTY, is_angle=True))
    assert len(samples) == 18
    assert len(np.unique(np.round(samples % 360.0, 6))) == 18
    assert len(axis_samples(-np.pi, np.pi, TWENTY, is_angle=False)) == 19


def test_limited_rotation_applies_axes_in_order():
    rotation = RootRotation.limited([("y", -180, 180), ("z", -10, 10)])
    values = np.array([[0.5, 0.1]])
    expected = Rotation.from_euler("y", 0.5) * Rotation.from_euler("z", 0.1)
    np.testing.assert_allclose(rotation.rotations(values)[0], expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotation.values_from(expected.as_matrix()), [0.5, 0.1], atol=1e-9)
    assert rotation.value_names == ("root_y", "root_z")


def test_invalid_rotations_are_refused():
    for make, message in (
        (lambda: RootRotation.fixed(np.diag([1.0, 1.0, -1.0])), "not a 3 x 3 rotation"),
        (lambda: RootRotation.fixed(np.zeros((2, 2))), "not a 3 x 3 rotation"),
        (lambda: RootRotation.fixed(np.full((3, 3), np.nan)), "not a 3 x 3 rotation"),
        (lambda: RootRotation.free(0.0), "interval"),
        (lambda: RootRotation.limited([("y", 10, -10)]), "lower first"),
        (lambda: RootRotation.limited([("y", 0, 1), ("y", 0, 1)]), "different"),
        (lambda: RootRotation.limited([]), "one to three"),
    ):
        with pytest.raises(SettingsError, match=message):
            make()


@pytest.mark.parametrize("name", ["floating", "jointed", "welded", "all_joints"])
def test_a_placed_root_moves_the_whole_body(models, name):
    """By Drake's plant: the root's origin is at the place, and all else keeps its relative pose."""
    model, rng = models[name], np.random.default_rng(3)
    given = {"root_position": np.zeros(3)} if name == "welded" else {}
    if name == "welded":
        given["root_rotation"] = RootRotation.free()
    tree = model.pose_tree(**given)
    assert tree.turns_root_freely == (name == "welded")
    count = sum(len(node.value_names) for node in tree.nodes)
    assert repr(tree) == f"<PoseTree of {model!r}: {len(tree.nodes)} nodes, {count} values>"
    bounds = [tree.value_bounds(k) for k in range(len(tree.nodes))]
    values = [rng.uniform(0.5 * low, 0.5 * high) for low, high in bounds]
    before = tree.node_poses(values)
    for place in (np.array([0.05, -0.04, 0.06]), before[0, :3, 3]):
        q, X_WB = tree.positions_with_root_at(values, place)
        poses = link_poses(model, q)
        placed = np.array([X_WB @ poses[node.name] for node in tree.nodes])
        np.testing.assert_allclose(placed[0, :3, 3], place, atol=1e-9)
        shifted = before.copy()
        roots = [k for k, node in enumerate(tree.nodes) if node.parent < 0]
        assert roots == [0]
        shifted[:, :3, 3] += place - before[0, :3, 3]
        np.testing.assert_allclose(placed, shifted, atol=1e-9)


def test_grids_are_all_combinations_of_their_axes(models):
    """The last value changes fastest; lengths have an interval of their own."""
    tree = models["all_joints"].pose_tree()
    for k, node in enumerate(tree.nodes):
        if not node.value_names or len(node.value_names) > 2:
            continue
        lower, upper = tree.value_bounds(k)
        axes = []
        for j in range(len(node.value_names)):
            spacing = 0.9 if tree.placements[k].is_angle[j] else 0.2
            periodic = bool(tree.placements[k].periodic[j])
            axes.append(axis_samples(lower[j], upper[j], spacing, is_angle=periodic))
        grid = tree.grid(k, 0.9, 0.2)
        expected = np.array(np.meshgrid(*axes, indexing="ij")).reshape(len(axes), -1).T
        np.testing.assert_allclose(grid, expected)


def test_a_target_moves_on_six_joints_and_the_robot_keeps_its_poses(models):
    """Along x, y, z of its first pose, then about x, y, z; only the target has a surface."""
    model, rng = models["floating"], np.random.default_rng(5)
    X_WO = np.eye(4)
    X_WO[:3, :3] = Rotation.from_euler("xyz", [0.4, -0.3, 0.9]).as_matrix()
    X_WO[:3, 3] = 0.5, 0.2, -0.1
    mesh = TriangleMesh(0.1 * np.eye(3), np.array([[0, 1, 2]]))
    found = model.with_target("hand", mesh, X_WO)
    carrying = [found.position_index(name) for name in TARGET_POSITIONS]
    np.testing.assert_array_equal(found.lower[carrying], -10.0)
    np.testing.assert_array_equal(found.upper[carrying], 10.0)
    for _ in range(3):
        q = np.array(found.default_positions)
        joints = [name for name in model.position_names if name in found.position_names]
        q[[found.position_index(name) for name in joints]] = rng.uniform(-0.3, 0.3, len(joints))
        values = rng.uniform(-1.0, 1.0, 6)
        q[carrying] = values
        poses = link_poses(found, q)
        move = np.eye(4)
        move[:3, :3] = Rotation.from_euler("XYZ", values[3:]).as_matrix()
        move[:3, 3] = values[:3]
        np.testing.assert_allclose(poses["target"], X_WO @ move, atol=1e-9)
        own = np.array(model.default_positions)
        for name in joints:
            own[model.position_index(name)] = q[found.position_index(name)]
        for name, X in link_poses(model, own).items():
            np.testing.assert_allclose(poses[name], X, atol=1e-9)
    sizes = {name: np.ptp(one.vertices, axis=0).max() for name, one in found.link_meshes.items()}
    assert sorted(size > 1e-3 for size in sizes.values()) == [False, False, True]
    assert found.skin == ()
    with pytest.raises(UnknownNameError):
        model.with_target("nothing", mesh, X_WO)


def test_base_joints_move_a_model_in_the_world(tmp_path):
    """Along x, y, z of the world, then about z, y, x; at zero its base is where it was placed."""
    weld = joint("weld", "fixed", "world", "foot", limits=None)
    links = link("world", ""), link("foot"), link("arm", SPHERE)
    text = urdf(*links, weld, joint("turn", "revolute", "foot", "arm"))
    plain = load_model(write(tmp_path, text), check=False)
    start = np.eye(4)
    start[:3, :3] = Rotation.from_euler("xyz", [0.4, -0.2, 0.7]).as_matrix()
    start[:3, 3] = (0.1, 0.2, 0.3)
    model = plain.with_base_joints(start)
    rng = np.random.default_rng(4)
    for values in (np.zeros(6), rng.uniform(-1.0, 1.0, 6)):
        q = np.zeros(len(model.position_names))
        q[[model.position_index(name) for name in BASE_JOINTS]] = values
        q[model.position_index("turn")] = 0.3
        placed = start.copy()
        placed[:3, :3] = Rotation.from_euler("ZYX", values[3:]).as_matrix() @ start[:3, :3]
        placed[:3, 3] += values[:3]
        poses, before = link_poses(model, q), link_poses(plain, np.array([0.3]))
        for name in ("foot", "arm"):
            np.testing.assert_allclose(poses[name], placed @ before[name], atol=1e-9)
    turns = [model.position_index(name) for name in BASE_JOINTS[3:]]
    np.testing.assert_allclose(model.upper[turns], np.pi)
    shifts = [model.position_index(name) for name in BASE_JOINTS[:3]]
    np.testing.assert_array_equal(model.upper[shifts], 100.0)


@pytest.mark.parametrize("degrees", [30.0, 60.0])
def test_even_rotations_are_near_to_every_rotation_and_apart(degrees):
    """About as many as cells of the interval's size fill all rotations."""
    interval = np.radians(degrees)
    found = Rotation.from_rotvec(even_rotations(interval))
    assert found[0].magnitude() == 0.0
    assert (np.diff(found.magnitude()) > -1e-8).all()
    drawn = Rotation.random(300, random_state=1)
    nearest = [(found.inv() * one).magnitude().min() for one in drawn]
    assert max(nearest) < 0.95 * interval
    assert len(found) == pytest.approx(8.0 * np.pi**2 / interval**3, rel=0.3)
    apart = [np.sort((found.inv() * one).magnitude())[1] for one in found[::7]]
    assert min(apart) > 0.3 * interval
