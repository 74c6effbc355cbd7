"""Contour measurements, compared with Drake's renderer, edge points and known answers."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import RootRotation, load_model
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import SettingsError
from drake_pose.filtering.contour_observation import CONTOUR, ROOT_SHIFT, ContourObservation
from drake_pose.fit.colours import COLOURS, Colour, part_distances, weigh_parts
from drake_pose.fit.contour_fit import Comparison
from drake_pose.fit.evidence import find_edge_points
from drake_pose.fit.kernel import Sum
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.body.models import LIMB_URDF, write_limb
from tests.filtering.tracks import CAMERA, GREEN, ORANGE, lit, make_background, painted
from tests.jobs.scenes import camera
from tests.search.arms import crane
from tests.search.bodies import front_camera, near_camera

TRUTH = np.array([0.2, 0.9, -0.6])
AT_ORIGIN = {"root_position": np.zeros(3)}


@pytest.fixture(scope="module")
def observation(body):
    return ContourObservation(body.pose_tree(), [CAMERA])


@pytest.fixture(scope="module")
def near(body):
    return ContourObservation(body.pose_tree(), [near_camera()])


@pytest.fixture(scope="module")
def mask(body):
    """The body at TRUTH in the near camera."""
    return LabelRenderer(body, near_camera()).mask(TRUTH)


def descend(observation, seen, x, steps=5):
    """Make Gauss-Newton steps from a state."""
    moving, distance = len(observation.layout.moving), None
    for k in range(steps):
        measured = observation.measure(seen, x, distance, k)
        distance = measured.distance
        H = measured.H[:, :moving]
        step = np.linalg.solve(H.T @ H + 1e-3 * np.eye(moving), H.T @ measured.y)
        x = x.copy()
        x[:moving] += step
    return x, measured


def test_measurements_lead_to_the_pose_that_drake_rendered(body, observation):
    x_true = observation.state(TRUTH)
    masks = [LabelRenderer(body, CAMERA).mask(TRUTH)]
    start = x_true + np.r_[0.12, -0.15, 0.1, np.zeros(3)]
    x, measured = descend(observation, observation.gather_evidence(masks), start)
    q, X_WB = observation.positions(x)
    # Segments have 12 to 24 pixels: a quarter of a pixel is a degree.
    np.testing.assert_allclose(q, TRUTH, atol=np.radians(2.5))
    np.testing.assert_allclose(X_WB, np.eye(4), atol=1e-9)
    assert measured.distance < 0.6
    assert measured.is_explained
    wrong, area = observation.difference(x, [(CAMERA, masks[0])])
    assert area == np.count_nonzero(masks[0])
    assert wrong == np.count_nonzero(observation.draw(x, CAMERA) != masks[0]) < 0.02 * area


def test_information_is_that_of_independent_pieces_of_edge(body):
    """For motions of the whole body: by the sum of squared velocities along its edge's normals."""
    tree = body.pose_tree("trunk", **AT_ORIGIN)
    own = ContourObservation(tree, [near_camera()], True, True)
    x = own.state(TRUTH)
    mask = own.draw(x, near_camera())
    measured, edge = own.measure(own.gather_evidence([mask]), x), find_edge_points(mask, 1.0)
    # The picture's right is the world's y, its up the world's z.
    y, z = own.root_position(x)[1:]
    about = edge.uv - near_camera().center_x - [300.0 * y, -300.0 * z]
    velocities = {
        "root_shift_y": 300.0 * edge.normals[:, 0],
        "root_shift_z": -300.0 * edge.normals[:, 1],
        "log_scale": np.sum(edge.normals * about, axis=1),
    }
    V = np.array(list(velocities.values()))
    index = own.layout.indices(list(velocities))
    expected = (V * edge.lengths) @ V.T / (CONTOUR.deviation**2 * CONTOUR.correlation)
    found = (measured.H.T @ measured.H)[np.ix_(index, index)]
    sizes = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / sizes, expected / sizes, atol=0.06)
    assert measured.length == pytest.approx(edge.lengths.sum(), rel=0.05)
    assert np.abs(measured.H[:, own.layout.index("root_shift_x")]).max() < 1e-9


def test_values_are_the_jacobian_times_the_displacement(near, mask):
    """A wide robust scale; a prior draws to the middle of the limits."""
    truth, seen = near.state(TRUTH), near.gather_evidence([mask])
    for element in range(3):
        for step in (0.03, -0.03):
            x = truth.copy()
            x[element] += step
            measured = near.measure(seen, x)
            expected = measured.H @ (truth - x)
            assert np.linalg.norm(measured.y - expected) < 0.25 * np.linalg.norm(measured.y)
            np.testing.assert_array_equal(measured.predict(x)[0], 0.0)
    # The scale of the robust weights follows the distance found before.
    far = truth + np.r_[0.3, np.zeros(5)]
    wide, narrow = (near.measure(seen, far, distance) for distance in (None, 0.1))
    assert narrow.distance < wide.distance
    # Excluded parts measure nothing.
    excluded = np.zeros((1, 3), bool)
    excluded[0, 2] = True
    assert not near.measure(seen, truth, excluded_parts=excluded).H[:, 2].any()


def test_the_prior_is_uniform_between_limits_and_counts_as_information(body, near, mask):
    own = ContourObservation(body.pose_tree(), [near_camera()], prior_weight=0.5)
    x, seen = near.state(TRUTH), near.gather_evidence([mask])
    middle, deviation = 0.5 * (body.lower + body.upper), (body.upper - body.lower) / np.sqrt(12.0)
    off = (TRUTH - middle) / deviation
    assert own.prior_distance(x) == pytest.approx(off @ off)
    plain, drawn = (one.measure(seen, x) for one in (near, own))
    more = drawn.H.T @ drawn.H - plain.H.T @ plain.H
    np.testing.assert_allclose(more[:3, :3], 0.5 * np.diag(deviation**-2.0), rtol=1e-6, atol=1e-6)
    pull = drawn.H.T @ drawn.y - plain.H.T @ plain.y
    np.testing.assert_allclose(pull[:3], -0.5 * off / deviation, rtol=1e-6)
    turning = ContourObservation(
        body.pose_tree("trunk", **AT_ORIGIN, root_rotation=RootRotation.free()), [CAMERA]
    )
    assert len(turning.prior.mean) == 2


def test_known_and_estimated_root_positions_agree(body):
    home, shift = np.array([0.0, 0.05, 0.04]), np.array([0.0, 0.03, -0.02])
    tree, there = body.pose_tree("trunk", root_position=home), home + shift
    held, moves = (ContourObservation(tree, [CAMERA], root_moves=one) for one in (False, True))
    x = moves.state(TRUTH)
    at_home = moves.draw(x, CAMERA)
    x[moves.layout.indices(ROOT_SHIFT)] = shift
    np.testing.assert_allclose(moves.root_position(x), there)
    known = held.seen_by(held.cameras, there)
    seen = known.draw(held.state(TRUTH), CAMERA)
    np.testing.assert_allclose(known.root_position(held.state(TRUTH)), there)
    assert not np.array_equal(seen, at_home)
    np.testing.assert_array_equal(moves.draw(x, CAMERA), seen)
    found, _ = descend(moves, moves.gather_evidence([seen]), moves.state(TRUTH), steps=8)
    np.testing.assert_allclose(found[moves.layout.indices(ROOT_SHIFT)][1:], shift[1:], atol=0.004)
    # The unknown scale of a parallel camera moves the body about its centre.
    scaled = ContourObservation(tree, [CAMERA], True, True)
    x = scaled.state(TRUTH)
    x[:3], x[scaled.layout.index("log_scale")] = TRUTH, 0.3
    x[scaled.layout.indices(ROOT_SHIFT)] = shift
    assert scaled.scale(x) == pytest.approx(np.exp(0.3))
    q, X_WB = scaled.positions(x)
    again = scaled.state(q, X_WB, scaled.scale(x))
    np.testing.assert_allclose(again, x, atol=1e-9)


def test_turned_rotates_only_the_root(body):
    free, limited = RootRotation.free(), RootRotation.limited([("x", -30.0, 30.0)])
    own = ContourObservation(
        body.pose_tree("trunk", **AT_ORIGIN, root_rotation=free), [CAMERA], True, True
    )
    x = np.random.default_rng(0).normal(size=len(own.layout)) * 0.1
    R = Rotation.from_rotvec([0.3, -0.2, 0.1]).as_matrix()
    turned = own.turned(x, R)
    before, after = (own.node_poses(one)[0, :3, :3] for one in (x, turned))
    scale = own.scale(x)
    np.testing.assert_allclose(after / scale, R @ before / scale, atol=1e-9)
    moved = {own.layout.names[i] for i in np.flatnonzero(turned != x)}
    assert moved == {f"root_rotation_{axis}" for axis in "xyz"}
    for rotation in ({}, {"root_rotation": limited}):
        held = ContourObservation(body.pose_tree("trunk", **AT_ORIGIN, **rotation), [CAMERA])
        with pytest.raises(SettingsError, match="freely"):
            held.turned(np.zeros(len(held.layout)), R)


def test_skin_is_drawn_with_angles_wrapped_into_the_limits(tmp_path):
    """A full turn more is the same pose, but would bend a band of skin by a fraction of it."""
    model = load_model(write_limb(tmp_path, text=LIMB_URDF.replace("2.5", "3.2")), check=False)
    own = ContourObservation(model.pose_tree(), [near_camera()])
    inside = own.state(np.array([0.2, 1.1, 0.4, 0.3, -0.5]))
    drawn = own.draw(inside, near_camera())
    for name in ("elbow", "wrist_x"):
        beyond = inside.copy()
        beyond[own.layout.index(name)] += 2.0 * np.pi
        np.testing.assert_array_equal(own.draw(beyond, near_camera()), drawn)


def test_angles_that_turn_around_have_no_limits_and_the_tracks_turns(tmp_path):
    own = ContourObservation(crane(tmp_path).pose_tree(), [camera("front")])
    with pytest.warns(UserWarning, match="no joint has a limit"):
        assert not len(own.inequalities())
    for lower, upper in ((-1, 2), (4, 6), (-0.4, 0.1)):
        narrow = crane(tmp_path, f'lower="{lower}" upper="{upper}"')
        rows = ContourObservation(narrow.pose_tree(), [camera("front")]).inequalities()
        assert rows.rows == (f"luff >= {lower}", f"luff <= {upper}")
    # A search returns angles within half a turn; the track is two turns further. The limits of the
    # second joint span two turns.
    last, (swing, luff) = own.state(np.array([13.0, 3.0])), own.layout.indices(["swing", "luff"])
    found = own.unwrapped(own.state(np.array([0.4, -2.0])), last)
    np.testing.assert_allclose(found[[swing, luff]], [0.4 + 4.0 * np.pi, -2.0 + 2.0 * np.pi])
    assert np.all(found[len(own.layout.moving) :] == 0.0)
    assert own.is_angle("swing")
    assert not own.is_angle("log_scale")


def test_tiles_hold_the_edges_and_what_does_not_fit(near, mask):
    seen, side = near.gather_evidence([mask]), 30.0
    edge = find_edge_points(mask, 0.5 * CONTOUR.spacing)
    costs, lengths = near.tile_costs(seen, near.state(TRUTH), side)
    expected = np.zeros((64, 64))
    for (u, v), length in zip(edge.uv, edge.lengths, strict=True):
        expected[int(v // side), int(u // side)] += length
    np.testing.assert_allclose(lengths[0], expected)
    assert costs.sum() < 0.1 * edge.lengths.sum()
    moved = near.state(TRUTH + 0.4 * np.eye(3)[2])
    off = near.draw(moved, near_camera()) != mask
    tiles = off.reshape(16, 30, 16, 30).any(axis=(1, 3))
    risen = near.tile_costs(seen, moved, side)[0] - costs
    assert risen[0, :16, :16][tiles].sum() > 0.9 * np.abs(risen).sum()
    # A contour that is far off costs about its length.
    assert 0.3 * off.sum() / 20.0 < risen.sum() < 2.0 * edge.lengths.sum()


def test_what_a_search_leaves_open_is_uniform_between_its_bounds(near):
    values, low, high = TRUTH, TRUTH - np.array([0.3, 0.1, 0.0]), TRUTH + np.array([0.1, 0.2, 0.5])
    joints = [
        SimpleNamespace(low=a, high=b, determined=known)
        for a, b, known in zip(low, high, (False, True, False), strict=True)
    ]
    draws = np.random.default_rng(0).uniform(low, high, (100_000, 3)) - values
    expected = np.sqrt(np.mean(draws**2, axis=0)) * [1, 0, 1]
    found = near.spread(joints, values, False)
    np.testing.assert_allclose(found[:3], expected, rtol=0.01)
    assert not found[3:].any()
    for one in joints:
        one.determined = True
    assert near.spread(joints, values, False) is None
    joints[0].determined = False
    hidden = near.spread(joints, values, True)
    assert hidden[0] == pytest.approx(np.sqrt(np.mean(np.linspace(-1.0, 0.6, 4001) ** 2)), rel=1e-3)


def test_the_covariance_of_a_frame_has_what_is_left_open(near, mask):
    x = near.state(TRUTH)
    measured, area = near.measure(near.gather_evidence([mask]), x), np.count_nonzero(mask)
    plain = near.covariance(measured, area)
    spread = np.array([0.1, 0.0, 0.2, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(
        near.covariance(measured, area, spread) - plain, np.diag([0.01, 0, 0.04])
    )
    # About a pixel at the end of a segment of 36 to 72 pixels.
    assert (np.abs(np.sqrt(np.diag(plain)) - 0.025) < 0.01).all()
    assert (np.linalg.eigvalsh(plain) > 0.0).all()


def test_frames_without_evidence_and_invalid_arguments(body, observation):
    x, pinhole = observation.state(np.zeros(3)), circle_of_cameras(1, face_camera=False)
    for mask in (None, np.zeros((200, 200), dtype=bool)):
        assert observation.measure(observation.gather_evidence([mask]), x) is None
    for masks, word in (([], "1 masks expected"), ([np.zeros((50, 60), bool)], "60 x 50")):
        with pytest.raises(SettingsError, match=word):
            observation.gather_evidence(masks)
    for cameras, scale, word in (
        ([], False, "one camera"),
        (list(pinhole.values()), True, "parallel"),
        ([front_camera(), front_camera(name="other")], True, "parallel"),
    ):
        with pytest.raises(SettingsError, match=word):
            ContourObservation(body.pose_tree(), cameras, True, scale)
    for picture, word in (
        (np.zeros((100, 200, 3), dtype=np.uint8), "200 x 100"),
        (np.zeros((200, 200), dtype=np.uint8), "red, green and blue"),
        (np.zeros((200, 200, 3)), "float64"),
    ):
        with pytest.raises(SettingsError, match=f"front.*{word}"):
            observation.gather_evidence([None], [picture], observation.uninformed_histograms())


# Pictures without masks.


def bin_index(colour):
    """Return the index of a colour's histogram bin."""
    return int(np.dot(colour >> 4, [256, 16, 1]))


def test_colours_lead_to_the_true_pose(near, mask):
    generator = np.random.default_rng(3)
    picture, x = painted(mask, make_background(generator), generator), near.state(TRUTH)
    colours = near.update_histograms([picture], x, near.uninformed_histograms(), True)
    seen = near.gather_evidence([None], [picture], colours)
    found, measured = descend(near, seen, x + np.r_[0.12, -0.15, 0.1, 0, 0, 0], steps=6)
    # Segments have 36 to 72 pixels.
    np.testing.assert_allclose(near.positions(found)[0], TRUTH, atol=np.radians(2.5))
    assert measured.distance < 0.8
    # A mask is used instead of the picture.
    assert not near.gather_evidence([mask], [picture], colours).has_pictures
    assert not near.gather_evidence([None], [picture]).has_pictures


def test_histograms_hold_the_colours_on_both_sides_of_the_contour_and_decay(near, mask):
    known, x = near.uninformed_histograms(), near.state(TRUTH)
    for colour in (ORANGE, np.array([20, 20, 200])):
        before = known
        known = near.update_histograms([lit(mask, colour)], x, known)
        seen = known[0, known[0, :, Colour.ON].sum(axis=-1) > 0]
        assert len(seen) == 3
        np.testing.assert_allclose(seen[:, :2].sum(axis=-1), 1.0, rtol=1e-4)
        # At bends of the contour, the strips overlap its other side.
        assert np.all(seen[:, Colour.BESIDE, bin_index(GREEN)] > 0.8)
    assert bin_index(ORANGE) < COLOURS
    np.testing.assert_allclose(seen[:, Colour.ON, bin_index(ORANGE)], 0.9, atol=0.1)
    excluded = np.array([[False, True, False]])
    again = near.update_histograms([lit(mask)], x, before, True, excluded)
    changed = (again != before).any(axis=(0, 2, 3))
    np.testing.assert_array_equal(again[excluded], before[excluded])
    assert not changed[1]


def test_a_body_with_the_backgrounds_colour_is_not_measured(near):
    plain, x = np.full((480, 480, 4), 120, dtype=np.uint8), near.state(TRUTH)
    colours = near.update_histograms([plain], x, near.uninformed_histograms(), True)
    assert near.measure(near.gather_evidence([None], [plain], colours), x) is None


def test_part_distances_come_from_the_cameras_with_enough_evidence():
    sums = np.zeros((2, 5, 6))
    sums[..., Sum.COMPARED], sums[..., Sum.WEIGHT] = 50.0, 2.0
    for node, distances in enumerate([(1.0, 1.0), (1.0, 9.0), (3.0, 4.0), (9.0, 9.0)]):
        sums[:, node, Sum.SQUARES] = 2.0 * np.square(distances)
    # There is hardly any evidence of the last part.
    sums[:, 3, Sum.COMPARED] = 5.0
    expected = [1.0, np.sqrt(2.0 / (1 + 1 / 81)), np.sqrt(2.0 / (1 / 9 + 1 / 16)), 0.0]
    np.testing.assert_allclose(part_distances(sums), expected)
    assert not part_distances(np.zeros((2, 5, 6))).any()


def test_parts_with_scattered_search_lines_have_less_weight():
    sums = np.zeros((2, 4, 6))
    sums[..., Sum.WEIGHT] = 1.0
    # The last row belongs to the masks' edges.
    sums[0, :, Sum.SQUARES] = 0.25, 1.44, 100.0, 50.0
    normal = np.ones((2, 3, 12, 12)), np.ones((2, 3, 12))
    compared = Comparison(*normal, sums, np.zeros((2, 3, 13)), None)
    weigh_parts(compared, 0.7, [np.zeros((1, 1, 3), np.uint8), None])
    expected = np.sqrt((0.25 + 1.44 + 100.0) / 3.0 / np.array([0.49, 1.44, 4.0]))
    np.testing.assert_allclose(compared.A[0, :, 3, 4], expected)
    np.testing.assert_allclose(compared.b[0, :, 5], expected)
    assert np.all(compared.A[1] == 1.0)
