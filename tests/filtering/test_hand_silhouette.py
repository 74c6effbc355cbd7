"""The two-finger hand measured in unlabelled silhouettes that Drake renders."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from drake_pose.body import bundled_model, load_model
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import MaskError
from drake_pose.filtering.hand import FLEXIONS, HAND_STATE, MEASURED, plant_positions
from drake_pose.filtering.hand_silhouette import HAND, HandSilhouette, RoughBody, match_axes
from drake_pose.filtering.state import Belief, wrapped_difference
from drake_pose.fit.evidence import EdgePoints, find_edge_points
from drake_pose.papers.shimada import experiment_filter
from drake_pose.papers.shimada_sequences import first_guess, true_states
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

WIDTH, HEIGHT = 480, 400
CENTER = (239.5, 199.5)
FILTER, OBSERVATION = experiment_filter()
SILHOUETTE = HandSilhouette(FILTER, WIDTH, HEIGHT, CENTER)


@pytest.fixture(scope="module")
def render():
    """Return a function that renders the mask of a state at scale 1 by Drake."""
    model = load_model(bundled_model("two_finger_hand"), check=False)
    model = model.reshaped(link_scales={"palm": (1.0, 1.1, 1.0)})
    X_WC = np.eye(4)
    X_WC[2, 3] = -1.0
    renderer = LabelRenderer(model, ParallelCamera("top", WIDTH, HEIGHT, 1000.0, *CENTER, X_WC))
    return lambda x: renderer.mask(plant_positions(x, model.position_names, 1000.0))


def hand(t, r_13=35.0, phase=0.0):
    """Return a true state at scale 1."""
    x = true_states(r_13, np.full(6, phase))[t]
    x[2:6] /= np.linalg.norm(x[2:6])
    return x


def sure_of(x):
    """Return a belief with a small covariance about a state."""
    guess = first_guess(x, np.random.default_rng(0))
    return Belief(x, 1e-6 * guess.covariance)


def normalised(found, x):
    """Return errors (39,) [standard deviations], NaN where hidden."""
    error = wrapped_difference(found.y, OBSERVATION.predict(x)[0], OBSERVATION.wraps)
    return error / np.sqrt(np.maximum(np.diag(found.covariance), 1e-12))


@pytest.mark.parametrize("seed", [0, 3])
def test_lines_and_tips_equal_the_true_hands_from_table_2s_guess(render, seed):
    """After a search, because the guess's silhouette differs by more than a tenth."""
    x = hand(20 + 10 * seed, 40.0)
    guess = FILTER.start(first_guess(x, np.random.default_rng(seed))).best
    mask = render(x)
    assert np.count_nonzero(SILHOUETTE.draw(guess.mean) != mask) > 0.1 * np.count_nonzero(mask)
    found = SILHOUETTE.measure(mask, guess, 1.0)
    off = normalised(found, x)
    off = off[np.isfinite(off)]
    assert len(off) >= 15
    # A segment that points at the camera may be mistaken for another's end.
    assert np.mean(np.abs(off) < 3) > 0.9
    wrong = np.count_nonzero(SILHOUETTE.draw(found.rough) != mask)
    assert found.difference == wrong / np.count_nonzero(mask) < 0.045
    assert found.y[MEASURED.index("scale")] == 1.0


def test_noise_covers_the_errors(render):
    """Near the true state, over many poses; hidden knuckles and the wrist are not measured."""
    off = []
    for t in range(0, 55, 4):
        x = hand(t, 35.0, 0.3 * math.sin(t))
        off.append(normalised(SILHOUETTE.measure(render(x), sure_of(x)), x))
    off = np.array(off)
    measured = np.isfinite(off).any(axis=0)
    names = {name for name, seen in zip(MEASURED, measured, strict=True) if not seen}
    knuckles = {f"point_{i}{j}_{a}" for i in (1, 2) for j in (0, 1, 2) for a in "xy"}
    assert names == {"wrist_x", "wrist_y", "scale", *knuckles}
    assert 0.2 < np.sqrt(np.nanmean(off**2)) < 1.0
    assert np.nanmax(np.abs(off)) < 4


def test_hidden_joints_are_measured_half_a_radius_inside_the_silhouette(render):
    """With a small standard deviation across the edge and a large one along it."""
    x = hand(24)
    x[HAND_STATE.index(FLEXIONS[0])] = 0.0
    mask = render(x)
    tip = OBSERVATION.drawing(x)[3] + CENTER
    # A foreign object covers the end of a finger.
    near = np.hypot(*np.moveaxis(np.indices(mask.shape)[::-1].T - tip, -1, 0)).T < 45.0
    mask &= ~near
    tolerant = HandSilhouette(FILTER, WIDTH, HEIGHT, CENTER, 0.9, 0.9)
    found = tolerant.measure(mask, sure_of(x))
    points, edge = (
        OBSERVATION.drawing(found.rough)[:8] + CENTER,
        find_edge_points(mask, HAND.spacing),
    )
    beyond = [k for k in range(8) if not mask[tuple(np.rint(points[k]).astype(int)[::-1])]]
    assert beyond
    for k in beyond:
        rows = slice(2 + 2 * k, 4 + 2 * k)
        way = points[k] - found.y[rows] - CENTER
        nearest = np.linalg.norm(edge.uv - points[k], axis=1).min()
        # A radius is 8 mm, about 8 pixels.
        radius = 8.0 * np.sum(found.rough[2:6] ** 2)
        inside = 0.5 * radius * min(nearest, 1.0)
        assert np.linalg.norm(way) - nearest == pytest.approx(inside, abs=1e-9)
        sizes, axes = np.linalg.eigh(found.covariance[rows, rows])
        np.testing.assert_allclose(np.sqrt(sizes), [0.5 * radius, 10.0 * radius])
        assert abs(axes[:, 0] @ way) == pytest.approx(np.linalg.norm(way))


def test_blank_and_foreign_silhouettes_measure_nothing(render):
    x = hand(24)
    blank = np.zeros((HEIGHT, WIDTH), dtype=np.bool_)
    other = blank.copy()
    other[20:380, 30:450] = True
    for mask in (blank, other):
        found = SILHOUETTE.measure(mask, sure_of(x))
        assert np.isnan(found.y).all()
        assert found.difference > 0.25
    with pytest.raises(MaskError, match="480"):
        SILHOUETTE.measure(np.zeros((3, 3), dtype=np.bool_), sure_of(x))


# A finger that ends in a tip, and one edge of a palm, in an image of their own.
ALONG = np.array([0.8, 0.6])
ACROSS = np.array([-0.6, 0.8])
ENDS = np.array([[[60.0, 50.0], [108.0, 86.0]], [[20.0, 110.0], [80.0, 110.0]]])
WIDTHS = np.array([8.0, 0.0])
ORIGIN = (30.0, 40.0)


def rough(sides=((True, True), (True, False)), drawn=None):
    blank = np.zeros((140, 140), np.uint8)
    return RoughBody(
        ENDS, WIDTHS, np.array(sides), np.array([0]), blank if drawn is None else drawn
    )


def side_of(line, sign, shift=0.0, turn=0.0, count=41):
    """Return edge points along a side of a line that is moved and turned about its middle."""
    start, end = ENDS[line]
    along = (end - start) / np.linalg.norm(end - start)
    normal = np.array([-along[1], along[0]])
    lever = np.linspace(-0.5, 0.5, count) * np.linalg.norm(end - start)
    across = sign * WIDTHS[line] + shift + turn * lever
    uv = 0.5 * (start + end) + lever[:, None] * along + across[:, None] * normal
    return uv, np.tile(sign * normal, (count, 1))


def edge_of(*parts, length=1.5):
    uv, normals = (np.vstack(one) for one in zip(*parts, strict=True))
    return EdgePoints(uv, normals, np.full(len(uv), length), uv.mean(axis=0))


def round_tip(move=(0.0, 0.0), count=41):
    """Return edge points of the half circle about the tip, moved."""
    angles = np.linspace(-0.5, 0.5, count) * np.pi
    normals = np.cos(angles)[:, None] * ALONG + np.sin(angles)[:, None] * ACROSS
    return ENDS[0, 1] + move + 8.0 * normals, normals


def expected_line(line, slopes, shift, turn, one_sided):
    """Return alpha, rho and their covariance, from the slopes (n, 2) of the points."""
    start, end = ENDS[line]
    along = (end - start) / np.linalg.norm(end - start)
    alpha = math.atan2(along[1], along[0]) + math.atan(turn)
    normal = np.array([-math.sin(alpha), math.cos(alpha)])
    middle = 0.5 * (start + end) - ORIGIN + shift * np.array([-along[1], along[0]])
    noise = HAND.edge_deviation**2 * HAND.correlation
    C = noise * np.linalg.inv(1.5 * slopes.T @ slopes)
    C[0, 0] += HAND.min_offset_deviation**2 + one_sided * HAND.width_deviation**2
    C[1, 1] += HAND.min_angle_deviation**2
    # rho = normal(alpha)^T middle.
    J = np.array([[0.0, 1.0], [1.0, -middle @ [math.cos(alpha), math.sin(alpha)]]])
    return np.array([alpha, normal @ middle]), J @ C @ J.T


@pytest.mark.parametrize("line", [0, 1])
@pytest.mark.parametrize(("shift", "turn"), [(0.0, 0.0), (-1.2, 0.03)])
def test_a_line_is_fitted_to_its_sides_by_least_squares(line, shift, turn):
    """Points of the outer 8 % of a line's ends are not used."""
    for signs in ((1.0, -1.0), (1.0,)) if line == 0 else ((1.0,),):
        edge = edge_of(*(side_of(line, sign, shift, turn) for sign in signs))
        found = match_axes(edge, rough(), 4.0, ORIGIN)
        lever = np.linspace(-0.5, 0.5, 41)[4:-4] * 60.0
        slopes = np.tile(np.column_stack([np.ones(len(lever)), lever]), (len(signs), 1))
        lines, covariance = expected_line(line, slopes, shift, turn, line == 0 and len(signs) == 1)
        np.testing.assert_allclose(found.lines[line], lines, atol=1e-9)
        np.testing.assert_allclose(found.line_covariances[line], covariance, rtol=1e-6)
        assert np.isnan(found.lines[1 - line]).all()


def test_a_tip_is_fitted_to_its_rim():
    for move in ((0.0, 0.0), (0.3, -0.2)):
        points, normals = round_tip(move)
        found = match_axes(edge_of((points, normals)), rough(), 4.0, ORIGIN)
        np.testing.assert_allclose(found.tips[0], ENDS[0, 1] + move - ORIGIN, atol=0.02)
        if not any(move):
            used = normals[normals @ ALONG > 0.1]
            C = HAND.edge_deviation**2 * HAND.correlation * np.linalg.inv(1.5 * used.T @ used)
            C += HAND.min_tip_deviation**2 * np.eye(2)
            np.testing.assert_allclose(found.tip_covariances[0], C, rtol=1e-6)
    sides = edge_of(side_of(0, 1.0), side_of(0, -1.0))
    assert np.isnan(match_axes(sides, rough(), 4.0, ORIGIN).tips).all()


def test_outliers_have_little_weight():
    """Compared with the minimum of the Geman-McClure cost at its final scale of 2 pixels."""
    uv, normals = side_of(1, 1.0)
    uv[8:16, 1] += 3.5
    found = match_axes(edge_of((uv, normals)), rough(), 4.0, ORIGIN)
    used = np.abs(uv[:, 0] - 50.0) < 0.42 * 60.0 - 1e-6
    lever, off = uv[used, 0] - 50.0, uv[used, 1] - 110.0

    def cost(z):
        r = (off - z[0] - z[1] * lever) / 2.0
        return np.sum(r**2 / (1.0 + r**2))

    best = minimize(cost, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-9}).x
    rho = 110.0 - 40.0 + best[0]
    np.testing.assert_allclose(found.lines[1, 1], rho - 20.0 * best[1], atol=0.03)
    assert found.lines[1, 0] == pytest.approx(math.atan(best[1]), abs=2e-3)
    residual = off - best[0] - best[1] * lever
    w = 1.5 / (1.0 + (residual / 2.0) ** 2) ** 2
    slopes = np.column_stack([np.ones(len(lever)), lever])
    noise = HAND.correlation * max((w @ residual**2) / w.sum(), HAND.edge_deviation**2)
    C = noise * np.linalg.inv((w[:, None] * slopes).T @ slopes)
    deviation = found.line_covariances[1, 0, 0] - HAND.min_angle_deviation**2
    assert deviation == pytest.approx(C[1, 1], rel=0.1)


def test_points_that_are_far_or_face_elsewhere_or_hidden_sides_are_not_matched():
    uv, normals = side_of(1, 1.0)
    turned = normals @ Rotation.from_rotvec([0, 0, 0.7]).as_matrix()[:2, :2]
    slightly = normals @ Rotation.from_rotvec([0, 0, 0.5]).as_matrix()[:2, :2]
    covered = np.zeros((140, 140), np.uint8)
    covered[112:] = 1
    for points, facing, gate, body, is_seen in (
        (uv + 3.9 * normals, normals, 4.0, rough(), True),
        (uv + 4.1 * normals, normals, 4.0, rough(), False),
        (uv - 4.1 * normals, normals, 4.0, rough(), False),
        (uv, slightly, 4.0, rough(), True),
        (uv, turned, 4.0, rough(), False),
        (uv, normals, 4.0, rough(drawn=covered), False),
        (uv, normals, 4.0, rough(sides=((True, True), (False, False))), False),
        (uv[18:23], normals[18:23], 4.0, rough(), True),
        (uv[19:22], normals[19:22], 4.0, rough(), False),  # Too short for a direction.
    ):
        found = match_axes(edge_of((points, facing)), body, gate, ORIGIN)
        assert np.isfinite(found.lines[1]).all() == is_seen
