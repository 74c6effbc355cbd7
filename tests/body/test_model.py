"""Loading of models, changes of their shape, base joints, and calibration targets."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from drake_pose import body
from drake_pose.errors import ModelError, UnknownNameError
from tests.body import models as bodies


def test_positions_limits_and_defaults(tmp_path):
    text = bodies.FLOATING_URDF.replace('lower="-0.2" upper="0.3"', 'lower="0.1" upper="0.3"')
    model = body.load_model(bodies.write(tmp_path, text), check=False)
    names = dict(zip(model.position_names, range(13), strict=False))
    base = tuple(f"trunk_{one}" for one in ("qw", "qx", "qy", "qz", "x", "y", "z"))
    assert model.position_names[:7] == base
    kinds = [model.position_kinds[k] for k in (0, names["hip"], names["slide"])]
    assert kinds == ["quaternion", "angle", "length"]
    assert not model.periodic[[0, names["slide"]]].any()
    assert (model.lower[names["hip"]], model.upper[names["hip"]]) == (-np.pi, np.pi)
    assert np.isinf(model.lower[:7]).all()
    assert model.default_positions[names["slide"]] == 0.1
    assert model.carried_by("arm") == ("arm", "hand", "welded")
    for call in (model.position_index, model.link_index, model.carried_by):
        with pytest.raises(UnknownNameError, match="nose"):
            call("nose")
    with pytest.raises(ModelError, match=r"gone\.urdf does not exist"):
        body.load_model(tmp_path / "gone.urdf")
    with pytest.raises(ModelError, match="is not a file"):
        body.load_model(tmp_path, check=False)


def visual(shape, turn=""):
    return f"<visual>{turn}<geometry>{shape}</geometry></visual>"


TURNED = '<origin xyz="0 0 0" rpy="0 0 1.5707963267948966"/>'


@pytest.mark.parametrize(
    ("shape", "factors"),
    [
        ('<box size="0.1 0.2 0.3"/>', (1, 2, 4)),
        ('<mesh filename="box.stl"/>', (1, 2, 4)),
        ('<mesh filename="box.stl" scale="1 3 1"/>', (1, 2, 4)),
        ('<drake:ellipsoid a="0.1" b="0.2" c="0.3"/>', (1, 2, 4)),
        ('<sphere radius="0.1"/>', (2, 2, 2)),
        ('<cylinder radius="0.1" length="0.5"/>', (2, 2, 4)),
    ],
)
def test_shapes_scale_as_their_type_allows(tmp_path, shape, factors):
    """Spheres and radii, and whatever is rotated in its link, by the geometric mean."""
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "box.stl")
    for turn, expected in (("", factors), (TURNED, (2, 2, 2))):
        path = bodies.write(tmp_path, bodies.urdf(bodies.link("a", visual(shape, turn))))
        model = body.load_model(path, check=False)
        other = model.reshaped(link_scales={"a": (1.0, 2.0, 4.0)})
        sizes = [np.ptp(one.link_meshes["a"].vertices, axis=0) for one in (model, other)]
        np.testing.assert_allclose(sizes[1] / sizes[0], expected, rtol=1e-6)


def test_shifts_and_scales_move_joints_and_meshes_in_their_link_frames(tmp_path):
    model = body.load_model(bodies.write(tmp_path, bodies.JOINTED_BASE_URDF), check=False)
    shift, move = np.array([0.1, -0.2, 0.3]), np.array([-0.3, 0.1, 0.2])
    other = model.reshaped(joint_shifts={"neck": shift}, link_shifts={"chest": move})
    q = np.random.default_rng(2).uniform(-0.5, 0.5, len(model.position_names))
    X, Y = bodies.link_poses(model, q), bodies.link_poses(other, q)
    np.testing.assert_allclose(Y["head"], X["head"])
    chest = Y["chest"][:3, 3] - X["chest"][:3, 3]
    np.testing.assert_allclose(chest, X["head"][:3, :3] @ shift, atol=1e-12)
    arm = Y["arm"][:3, 3] - X["arm"][:3, 3] - chest
    np.testing.assert_allclose(arm, X["chest"][:3, :3] @ move, atol=1e-12)
    scale = np.array([2.0, 3.0, 0.5])
    Y = bodies.link_poses(model.reshaped(link_scales={"chest": scale}), q)
    np.testing.assert_allclose(Y["chest"], X["chest"], atol=1e-12)
    p_CA, placed = (np.linalg.inv(one["chest"]) @ one["arm"][:, 3] for one in (X, Y))
    np.testing.assert_allclose(placed[:3], scale * p_CA[:3], atol=1e-12)
    for name, by in (("head", 0.0), ("chest", move), ("arm", 0.0)):
        before, after = model.link_meshes[name], other.link_meshes[name]
        np.testing.assert_allclose(after.vertices, before.vertices + by, atol=1e-12)


def test_joint_offsets_move_links_and_keep_physical_limits(tmp_path):
    zeros = {"x": 0.3, "head_y": 0.2, "neck": -0.4, "shoulder": 0.0}
    text = bodies.JOINTED_BASE_URDF.replace('"neck" type="revolute"', '"neck" type="continuous"')
    model = body.load_model(bodies.write(tmp_path, text), check=False)
    changed = bodies.write(tmp_path, body.reshaped(text, joint_offsets=zeros), "other.urdf")
    other = body.load_model(changed, check=False)
    offsets = np.array([zeros.get(name, 0.0) for name in model.position_names])
    limited = ~model.is_unlimited_angle
    for own, before in ((other.lower, model.lower), (other.upper, model.upper)):
        np.testing.assert_allclose(own[limited], (before - offsets)[limited])
    q = np.random.default_rng(1).uniform(-0.5, 0.5, len(offsets))
    expected = bodies.link_poses(model, q + offsets)
    for name, X in bodies.link_poses(other, q).items():
        np.testing.assert_allclose(X, expected[name], atol=1e-12)


def test_hidden_links_have_neither_surface_nor_skin(tmp_path, models):
    limb, urdf_model, sdf_model = bodies.load_limb(tmp_path), models["welded"], models["all_joints"]
    assert (limb.changes_shape, sdf_model.changes_shape) == (True, False)
    assert [band.child for band in limb.without(["upper"]).skin] == ["hand"]
    assert limb.reshaped(hidden=["lower"]).skin == ()
    double = limb.reshaped(link_scales={"lower": (2.0, 3.0, 4.0)}).skin
    for band, before, scale in zip(double, limb.skin, ((2, 3, 4), (1, 1, 1)), strict=True):
        np.testing.assert_allclose(band.mesh.vertices, before.mesh.vertices * scale)
    for model, name in ((urdf_model, "upper"), (sdf_model, "b")):
        left = model.without([name])
        assert {*model.link_meshes} - {*left.link_meshes} == {name}
        drawn = left.plant.GetVisualGeometriesForBody(left.plant.GetBodyByName(name))
        assert bool(drawn) == (model is sdf_model)
        with pytest.raises(UnknownNameError, match="tail"):
            model.without(["tail"])
        with pytest.raises(ModelError, match="visual geometry"):
            model.without(list(model.link_meshes))
    for change in (sdf_model.reshaped, lambda: sdf_model.with_base_joints(np.eye(4))):
        with pytest.raises(ModelError, match="only the shape of a URDF"):
            change()


def test_a_target_moves_on_six_joints_and_the_robot_keeps_its_poses(models):
    """Along x, y, z of its first pose, then about x, y, z; only the target has a surface."""
    model, rng = models["floating"], np.random.default_rng(5)
    X_WO = np.eye(4)
    X_WO[:3, :3] = Rotation.from_euler("xyz", [0.4, -0.3, 0.9]).as_matrix()
    X_WO[:3, 3] = 0.5, 0.2, -0.1
    mesh = body.TriangleMesh(0.1 * np.eye(3), np.array([[0, 1, 2]]))
    found = model.with_target("hand", mesh, X_WO)
    carrying = [found.position_index(name) for name in body.TARGET_POSITIONS]
    np.testing.assert_array_equal(found.lower[carrying], -10.0)
    np.testing.assert_array_equal(found.upper[carrying], 10.0)
    names = [name for name in model.position_names if name in found.position_names]
    own = [model.position_index(name) for name in names]
    for _ in range(3):
        q, before = np.array(found.default_positions), np.array(model.default_positions)
        before[own] = q[[found.position_index(name) for name in names]] = rng.uniform(
            -0.3, 0.3, len(own)
        )
        q[carrying] = values = rng.uniform(-1.0, 1.0, 6)
        move = np.eye(4)
        move[:3, :3] = Rotation.from_euler("XYZ", values[3:]).as_matrix()
        move[:3, 3] = values[:3]
        poses = bodies.link_poses(found, q)
        for name, X in (bodies.link_poses(model, before) | {"target": X_WO @ move}).items():
            np.testing.assert_allclose(poses[name], X, atol=1e-9)
    sizes = {name: np.ptp(one.vertices, axis=0).max() for name, one in found.link_meshes.items()}
    assert sorted(size > 1e-3 for size in sizes.values()) == [False, False, True]
    assert found.skin == ()
    with pytest.raises(UnknownNameError):
        model.with_target("nothing", mesh, X_WO)


def test_base_joints_move_a_model_in_the_world(tmp_path):
    """Along x, y, z of the world, then about z, y, x; at zero its base is where it was placed."""
    weld = bodies.joint("weld", "fixed", "world", "foot", limits=None)
    links = bodies.link("world", ""), bodies.link("foot"), bodies.link("arm", bodies.SPHERE)
    text = bodies.urdf(*links, weld, bodies.joint("turn", "revolute", "foot", "arm"))
    plain = body.load_model(bodies.write(tmp_path, text), check=False)
    start = np.eye(4)
    start[:3, :3] = Rotation.from_euler("xyz", [0.4, -0.2, 0.7]).as_matrix()
    start[:3, 3] = (0.1, 0.2, 0.3)
    model = plain.with_base_joints(start)
    rng = np.random.default_rng(4)
    for values in (np.zeros(6), rng.uniform(-1.0, 1.0, 6)):
        q = np.zeros(len(model.position_names))
        q[[model.position_index(name) for name in body.BASE_JOINTS]] = values
        q[model.position_index("turn")] = 0.3
        placed = start.copy()
        placed[:3, :3] = Rotation.from_euler("ZYX", values[3:]).as_matrix() @ start[:3, :3]
        placed[:3, 3] += values[:3]
        poses, before = bodies.link_poses(model, q), bodies.link_poses(plain, np.array([0.3]))
        for name in ("foot", "arm"):
            np.testing.assert_allclose(poses[name], placed @ before[name], atol=1e-9)
    ends = model.upper[[model.position_index(name) for name in body.BASE_JOINTS]]
    np.testing.assert_allclose(ends, [100.0] * 3 + [np.pi] * 3)
