import math
from dataclasses import replace

import numpy as np
import pytest

from drake_pose.body import RootRotation, bundled_model, load_model
from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.errors import SettingsError
from drake_pose.search import (
    BeamSearchSettings,
    RootPlacementSearch,
    View,
    most_connected_node,
    root_rotates_freely,
)
from drake_pose.search.root_placement import choose_root_samples
from drake_pose.search.root_places import (
    find_root_places,
    in_camera,
    root_steps,
    scale_camera,
    slide_root,
)
from drake_pose.search.sampled_body import SampledBody
from drake_pose.silhouette.scoring import draw_mask
from drake_pose.workers import use_workers
from tests.search.bodies import box_link, front_camera, joint, load_body

SETTINGS = BeamSearchSettings(interval=math.radians(30.0))


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    """A trunk with two unequal arms that turns in the image plane and slides anywhere."""
    slides, parent = [], "world"
    for name, axis in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1")):
        carriage = f"carriage_{name}"
        slides.append(f'<link name="{carriage}"/>')
        slides.append(joint(f"slide_{name}", "prismatic", parent, carriage, (-9.0, 9.0), axis=axis))
        parent = carriage
    return load_body(
        tmp_path_factory.mktemp("body"),
        *slides,
        box_link("trunk", 10, 24, z=-12.0),
        joint("trunk_turn", "revolute", parent, "trunk", (-1.2, 1.2)),
        box_link("left", 4, 15, y=1.0, z=-7.0),
        joint("left_turn", "revolute", "trunk", "left", (-0.2, 2.2), y=4.0, z=-2.0),
        box_link("right", 5, 12, y=-1.0, z=-5.0),
        joint("right_turn", "revolute", "trunk", "right", (-2.2, 0.2), y=-4.0, z=-2.0),
    )


TRUE_ANGLES = {"trunk_turn": 0.4, "left_turn": 1.3, "right_turn": -0.9}
PLACE = np.array([0.0, 0.13, 0.31])
EYE = PinholeCamera("eye", 200, 200, 300.0, 300.0, 99.5, 99.5, front_camera().X_WC)


def picture(body, camera, position, angles=TRUE_ANGLES):
    """Return the silhouette (H, W) of the body, placed by the plant's own joints."""
    q = np.array(body.default_positions)
    named = dict(zip(("slide_x", "slide_y", "slide_z"), position, strict=True)) | angles
    for name, value in named.items():
        q[body.position_index(name)] = value
    tree = body.pose_tree()
    X_WN = tree.node_poses(tree.values_from_positions(q))
    search = RootPlacementSearch(tree, SETTINGS)
    return draw_mask(search.sampled.outlines, camera.X_CW @ X_WN, camera)


def angle_errors(body, result):
    return [abs(result.q[body.position_index(name)] - value) for name, value in TRUE_ANGLES.items()]


@pytest.mark.parametrize(
    ("ranges", "free"),
    [
        ((2.0, 2.0, 1.0), True),
        ((1.0, 2.0, 2.0), True),
        ((2.0, 2.0, 0.9), False),
        ((1.9, 2.0, 1.0), False),
        ((2.0, 2.0), False),
        ((2.0, 2.0, 0.0, 1.0), True),
        ((2.0, 2.0, 1.0, 1.0), False),
    ],
)
def test_three_angles_at_the_root_give_every_rotation(tmp_path, ranges, free):
    """``ranges`` in half turns: two full turns and a half turn give every rotation."""
    names = [f"gimbal_{k}" for k in range(len(ranges) - 1)] + ["ball"]
    parts = [f'<link name="{name}"/>' for name in names[:-1]]
    for k, (one, half_turns) in enumerate(zip(names, ranges, strict=True)):
        half, axis = 0.5 * math.pi * half_turns, ("0 0 1", "0 1 0", "1 0 0")[k % 3]
        parent = names[k - 1] if k else "world"
        parts.append(joint(f"turn_{k}", "revolute", parent, one, (-half, half), axis=axis))
    arms = [box_link(f"arm_{k}", 4, 4, y=3.0) for k in range(3)]
    arms += [joint(f"swing_{k}", "revolute", "ball", f"arm_{k}", (-1.0, 1.0)) for k in range(3)]
    arms += [box_link("finger", 2, 2), joint("bend", "revolute", "arm_0", "finger", (0.0, 1.0))]
    tree = load_body(tmp_path, *parts, box_link("ball", 10, 10), *arms).pose_tree()
    assert root_rotates_freely(tree) == free
    assert most_connected_node(tree) == "ball"


@pytest.fixture(scope="module")
def seen(body):
    """The body in a parallel camera of 100 pixels per metre, with the trunk at PLACE."""
    camera = front_camera(160)
    return View(camera, picture(body, camera, PLACE))


SIDE = replace(
    front_camera(160),
    name="side",
    X_WC=np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    @ front_camera(160).X_WC,
)


@pytest.mark.parametrize(
    ("cameras", "position", "axes", "given"),
    [
        # A camera's wrong scale is found; along its axis the position is arbitrary.
        ([front_camera(160)], PLACE, "yz", {"scale": 100.0 / 7.0}),
        ([front_camera(160)], PLACE, "yz", {}),
        ([front_camera(160)], PLACE, "xyz", {"known": True}),
        ([front_camera(160)], PLACE, "xyz", {"known": True, "scale": 2.0}),
        # A pinhole sees the depth, two cameras the position in space.
        ([EYE], np.array([3.8, 0.05, 0.1]), "xyz", {}),
        ([front_camera(160), SIDE], np.array([0.21, -0.12, 0.18]), "xyz", {}),
    ],
)
def test_positions_and_scales_are_found(body, cameras, position, axes, given):
    scale, known = given.get("scale", 1.0), position if "known" in given else None
    shown = [picture(body, camera, position) for camera in cameras]
    if "scale" in given:
        (camera,) = cameras
        cameras = [replace(camera, pixels_per_metre=camera.pixels_per_metre / scale)]
    views = [View(*pair) for pair in zip(cameras, shown, strict=True)]
    search = RootPlacementSearch(body.pose_tree(), SETTINGS, scale_unknown="scale" in given)
    result = search.match(views, known)
    assert result.E_total < 0.06
    assert result.scale == pytest.approx(scale, rel=0.04)
    assert max(angle_errors(body, result)) < 0.1
    for k, axis in enumerate("xyz"):
        if axis in axes:
            near = 0.08 if cameras == [EYE] else 1e-9 if known is not None else 0.03
            assert result.root_position[k] == pytest.approx(position[k], abs=near)
        q = result.q[body.position_index(f"slide_{axis}")]
        assert q == pytest.approx(result.root_position[k], abs=1e-9)


def test_results_depend_neither_on_workers_nor_on_the_root(body, seen):
    """The same silhouette is searched with the trunk and with an arm as the root."""
    rotation = RootRotation.limited([("x", -180.0, 180.0)])
    other = body.pose_tree("left", root_position=np.zeros(3), root_rotation=rotation)
    found = []
    for tree, workers in ((body.pose_tree(), 1), (body.pose_tree(), 3), (other, 1)):
        with use_workers(workers):
            found.append(RootPlacementSearch(tree, SETTINGS).match([seen]))
    own, again, turned = found
    np.testing.assert_array_equal(own.q, again.q)
    assert (own.runs, own.first_J) == (again.runs, again.first_J)
    assert abs(own.E_total - turned.E_total) < 0.03
    # The plant's joints cannot turn the body about the arm, so X_WB is turned instead.
    assert max(angle_errors(body, turned)[1:]) < 0.1
    assert math.atan2(*turned.X_WB[[2, 1], 1]) == pytest.approx(TRUE_ANGLES["trunk_turn"], abs=0.1)


def test_a_root_may_lie_beyond_the_image_border(body):
    camera = front_camera(160)
    search = RootPlacementSearch(body.pose_tree(), SETTINGS)
    for place in ((0.1, 0.8), (0.1, -0.8), (0.8, 0.1), (-0.8, 0.1)):
        mask = picture(body, camera, (0.0, *place))
        (layer,) = find_root_places(search.body, [View(camera, mask)], False, None)
        positions = layer.positions[:, 1:]
        assert np.linalg.norm(positions - place, axis=1).min() < 0.04
        # The picture ends at 0.8 m; only the side that the silhouette touches is left.
        left = np.abs(positions).max(axis=0) > 0.81
        assert left.tolist() == [abs(one) == 0.8 for one in place]


def test_a_zero_time_limit_returns_a_placement(body, seen):
    settings = replace(SETTINGS, time_limit=0.0)
    result = RootPlacementSearch(body.pose_tree(), settings).match([seen])
    assert (result.found, result.stopped_by) == (True, "time_limit")


def test_an_unknown_scale_needs_one_parallel_camera(body):
    search = RootPlacementSearch(body.pose_tree(), SETTINGS, scale_unknown=True)
    with pytest.raises(SettingsError, match="eye"):
        search.match([View(EYE, np.ones((200, 200), dtype=np.bool_))])
    with pytest.raises(SettingsError, match="at least one view"):
        search.match([])


def test_root_steps_have_the_spacing_of_the_candidates():
    mask = np.zeros((200, 200), dtype=np.bool_)
    mask[50:170, 50:170] = True
    # The camera is at x = 5 m; a twelfth of the silhouette's extent is 10 pixels.
    near, far, aside = (
        root_steps([View(EYE, mask)], np.array([5.0 - depth, y, 0.0]))
        for depth, y in ((1.12, 0.0), (1.12**2, 0.0), (1.12, 2.0 * 10.0 / 300.0 * 1.12))
    )
    assert near - far == pytest.approx([0.0, 0.0, 1.0])
    assert np.abs(aside - near) == pytest.approx([2.0, 0.0, 0.0])


@pytest.mark.parametrize("parallel", [True, False])
def test_the_best_rotations_of_the_root_are_chosen(parallel):
    """Compare with drawing every rotation at every position."""
    tree = load_model(bundled_model("hand")).pose_tree(
        "palm", root_position=np.zeros(3), root_rotation=RootRotation.free(interval_deg=60.0)
    )
    body = SampledBody(tree, BeamSearchSettings(interval=math.radians(60.0)))
    X_WC = np.array([[0.0, 0.0, -1.0, 0.5], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]])
    X_WC = np.vstack([X_WC, [0.0, 0.0, 0.0, 1.0]])
    if parallel:
        camera = ParallelCamera("c", 60, 50, 260.0, 29.5, 24.5, X_WC)
    else:
        camera = PinholeCamera("c", 60, 50, 130.0, 130.0, 29.5, 24.5, X_WC)
    X_WR, outline = body.sampled.X_PN[0], body.sampled.outlines[0]
    positions = np.array([[0.0, 0.0, 0.0], [0.0, 0.02, -0.015], [0.0, -0.05, 0.06]])

    def drawn(position, rotation):
        X_WN = X_WR[rotation].copy()
        X_WN[:3, 3] += position - X_WR[0, :3, 3]
        return draw_mask([outline], (camera.X_CW @ X_WN)[None], camera)

    mask = drawn(np.array([0.0, 0.003, 0.002]), 11)
    chosen = choose_root_samples(body, [View(camera, mask)], positions, 30, 2)
    places, rotations = np.divmod(chosen, len(X_WR))
    assert (np.bincount(places) == 30).all()
    for k, position in enumerate(positions):
        masks = [drawn(position, rotation) for rotation in range(len(X_WR))]
        costs = [2.0 * (one & ~mask).sum() - (one & mask).sum() for one in masks]
        best = np.argsort(costs)[:10]
        # Shifting by whole pixels may exchange rotations of nearly equal cost.
        missing = set(best) - set(rotations[places == k])
        assert len(missing) <= 1


@pytest.fixture(scope="module")
def sampled(body):
    return RootPlacementSearch(body.pose_tree(), SETTINGS).body


def random_pose(sampled, seed, p_WR):
    """Return X_WN (nodes, 4, 4) of a random grid pose with its root at p_WR (3,)."""
    rng, grid = np.random.default_rng(seed), sampled.sampled
    samples = np.array([[rng.integers(len(X)) for X in grid.X_PN]])
    X_WN = grid.poses(samples)[0]
    X_WN[:, :3, 3] += p_WR - X_WN[0, :3, 3]
    return X_WN


@pytest.mark.parametrize("seed", range(4))
def test_the_true_place_lies_between_candidates(sampled, seed):
    """Within half a spacing in the picture, and half a step of the depth or scale."""
    p_WR = np.random.default_rng(seed + 10).uniform(-0.12, 0.12, 3)
    X_WN, outlines = random_pose(sampled, seed, p_WR), sampled.sampled.outlines
    flat = replace(front_camera(160), pixels_per_metre=110.0)
    for camera, unknown in ((EYE, False), (flat, True), (flat, False)):
        mask = draw_mask(outlines, camera.X_CW @ X_WN, camera)
        given = replace(flat, pixels_per_metre=40.0) if unknown else camera
        layers = find_root_places(sampled, [View(given, mask)], unknown, None)
        rows = [np.flatnonzero(mask.any(axis=axis)) for axis in (0, 1)]
        extent = np.sqrt(np.prod([one[-1] - one[0] + 1 for one in rows]))
        off = []
        for layer in layers:
            (view,) = layer.views
            uv, depth = view.camera.project(layer.positions)
            place, true_depth = camera.project(p_WR[None])
            sizes = np.full(len(uv), layer.scale * 40.0 / 110.0 if unknown else 1.0)
            if camera is EYE:
                sizes = true_depth[0] / depth
                assert np.ptp(depth) < 1e-9
            apart = np.linalg.norm(uv - place, axis=1) / (extent / 12.0)
            off += [*zip(apart, np.abs(np.log(sizes)) / np.log(1.12), strict=True)]
            outside = np.array(
                [np.hypot(*(np.argwhere(mask)[:, ::-1] - one).T).min() for one in uv]
            )
            assert outside.max() <= 0.75 * extent / 12.0 + 0.75
            # Candidates fill the silhouette.
            if not unknown:
                for one in np.argwhere(mask)[::97, ::-1]:
                    assert np.abs(uv - one).max(axis=1).min() <= 0.51 * extent / 12.0 + 1e-6
        assert any(a <= 0.72 and b <= 0.501 for a, b in off)
        if len(layers) > 1:
            steps = np.array([
                layer.scale if unknown else 1.0 / camera.project(layer.positions[:1])[1][0]
                for layer in layers
            ])  # fmt: skip
            logs = np.log(steps / steps[0]) / np.log(1.12)
            np.testing.assert_allclose(logs, np.round(logs), atol=1e-6)
            assert (np.diff(np.abs(logs)) > -1e-6).all()
            assert len({*np.round(logs).tolist()}) == len(layers) == round(np.ptp(logs)) + 1


def test_candidates_in_space_are_seen_by_all_cameras(sampled):
    """A grid about the point nearest to all rays holds the true place within half a spacing."""
    front = front_camera(160)
    c, s = np.cos(0.9), np.sin(0.9)
    turn = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
    cameras = (EYE, replace(front, X_WC=turn @ front.X_WC, name="side"))
    for seed in range(3):
        p_WR = np.random.default_rng(seed).uniform(-0.1, 0.1, 3)
        X_WN = random_pose(sampled, seed, p_WR)
        views = [
            View(one, draw_mask(sampled.sampled.outlines, one.X_CW @ X_WN, one)) for one in cameras
        ]
        (places,) = find_root_places(sampled, views, False, None)
        spacing = np.diff(np.unique(np.round(places.positions[:, 2], 9))).min()
        assert np.abs(places.positions - p_WR).max(axis=1).min() <= 0.501 * spacing
        for view in views:
            uv = view.camera.project(places.positions)[0]
            nearest = [np.hypot(*(np.argwhere(view.mask)[:, ::-1] - one).T).min() for one in uv]
            box = np.argwhere(view.mask)
            extent = np.sqrt(np.prod(np.ptp(box, axis=0) + 1))
            assert max(nearest) <= 0.75 * extent / 12.0 + 0.75
        # About a twelfth of the body's size.
        size = float(np.sqrt(np.prod(np.ptp(np.argwhere(views[1].mask), axis=0) + 1))) / 100.0
        assert 0.4 * size < 12.0 * spacing < 2.5 * size
    # Two cameras side by side do not tell the depth: the larger silhouette gives layers.
    near = [View(replace(EYE, name=name), views[0].mask) for name in "ab"]
    assert len(find_root_places(sampled, near, False, None)) > 1


def test_a_slid_root_is_seen_at_the_same_place_by_a_scaled_camera():
    camera = replace(front_camera(160), pixels_per_metre=50.0)
    p_WR = np.array([0.2, 0.3, -0.1])
    for factor in (0.5, 1.7):
        scaled, moved = scale_camera(camera, 1.0 / factor), slide_root(camera, p_WR, factor)
        assert scaled.pixels_per_metre == pytest.approx(50.0 / factor)
        np.testing.assert_allclose(scaled.project(moved[None])[0], camera.project(p_WR[None])[0])
        assert in_camera(camera, moved)[2] == pytest.approx(in_camera(camera, p_WR)[2])
