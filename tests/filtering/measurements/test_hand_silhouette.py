"""The two-finger hand measured in unlabelled silhouettes that Drake renders."""

import math

import numpy as np
import pytest

from drake_pose.body import bundled_model, load_model
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import MaskError
from drake_pose.filtering.hand import (
    FLEXIONS,
    HAND_STATE,
    LENGTHS,
    MEASURED,
    SPREADS,
    plant_positions,
)
from drake_pose.filtering.hand_silhouette import HAND, HandSilhouette, match_axes
from drake_pose.filtering.state import Belief, wrapped_difference
from drake_pose.fit.evidence import find_edge_points
from drake_pose.papers.shimada import experiment_filter
from drake_pose.papers.shimada_sequences import first_guess, true_states
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

WIDTH, HEIGHT = 480, 400
CENTER = (239.5, 199.5)
FILTER, OBSERVATION = experiment_filter()
SILHOUETTE = HandSilhouette(FILTER, WIDTH, HEIGHT, CENTER)
SEEN = np.r_[HAND_STATE.indices((*SPREADS, *FLEXIONS)), HAND_STATE.indices(LENGTHS)]


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


@pytest.mark.parametrize("length", [0.025, 0.05])
def test_drawn_segments_have_no_gap(render, length):
    x = hand(24)
    x[HAND_STATE.indices(("length_13", "length_23"))] = length
    assert np.mean(SILHOUETTE.draw(x).astype(bool) != render(x)) < 0.005


@pytest.mark.parametrize("seed", [0, 3])
def test_lines_and_tips_equal_the_true_hands_from_table_2s_guess(render, seed):
    x = hand(20 + 10 * seed, 40.0)
    guess = FILTER.start(first_guess(x, np.random.default_rng(seed))).best
    mask = render(x)
    found = SILHOUETTE.measure(mask, guess, 1.0)
    off = normalised(found, x)
    visible_errors = off[np.isfinite(off)]
    assert len(visible_errors) >= 15
    # The measurement is relative to the final rough pose.
    edge, gate = find_edge_points(mask, HAND.spacing), SILHOUETTE._unit * HAND.gates[-1]
    lines = match_axes(edge, SILHOUETTE._rough(found.rough), gate, CENTER).lines.ravel()
    end = MEASURED.index("scale")
    measured = found.y[end - len(lines) : end]
    shown = np.isfinite(measured)
    np.testing.assert_array_equal(measured[shown], lines[shown])
    # A segment that points at the camera may be mistaken for another's end.
    assert np.mean(np.abs(visible_errors) < 3) > 0.9
    assert found.difference < 0.045
    assert np.count_nonzero(SILHOUETTE.draw(guess.mean) != mask) > 0.1 * np.count_nonzero(mask)
    again = SILHOUETTE.measure(mask, guess, 1.0)
    np.testing.assert_array_equal(found.y, again.y)


def test_noise_covers_the_errors(render):
    """Near the true state, over many poses; hidden knuckles and the wrist are not measured."""
    off = []
    for t in range(0, 55, 3):
        x = hand(t, 35.0, 0.3 * math.sin(t))
        off.append(normalised(SILHOUETTE.measure(render(x), sure_of(x)), x))
    off = np.array(off)
    measured = np.isfinite(off).any(axis=0)
    names = {name for name, seen in zip(MEASURED, measured, strict=True) if not seen}
    knuckles = {f"point_{i}{j}_{a}" for i in (1, 2) for j in (0, 1, 2) for a in "xy"}
    assert names == {"wrist_x", "wrist_y", "scale", *knuckles}
    assert 0.2 < np.sqrt(np.nanmean(off**2)) < 1.0
    assert np.nanmax(np.abs(off)) < 4


def test_occluded_parts_are_not_measured(render):
    """The tip and last segment of a finger bent over the palm have no edge."""
    x = hand(24)
    x[HAND_STATE.indices(FLEXIONS[3:])] = np.radians((80.0, 85.0, 80.0))
    x[2:6] = np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0
    y = SILHOUETTE.measure(render(x), sure_of(x)).y
    hidden = ("alpha_23", "rho_23", "point_23_x", "point_23_y")
    assert np.isnan(y[[MEASURED.index(name) for name in hidden]]).all()
    assert np.isfinite(y[[MEASURED.index(name) for name in ("alpha_11", "alpha_palm_left")]]).all()


def test_joints_outside_the_silhouette_are_measured_half_a_radius_inside(render):
    """With a small standard deviation across the edge and a large one along it."""
    x = hand(24)
    mask = render(x)
    bent = x.copy()
    bent[HAND_STATE.index(SPREADS[0])] -= np.radians(40.0)
    edge, y = find_edge_points(mask, 1.0), np.full(len(MEASURED), np.nan)
    R = np.diag(OBSERVATION.variances)
    SILHOUETTE._add_hidden_points(bent, mask, edge, y, R)
    measured = np.flatnonzero(np.isfinite(y)).reshape(-1, 2)
    assert 2 <= len(measured) < 8
    for rows in measured:
        u, v = np.rint(y[rows] + CENTER).astype(int)
        assert mask[v, u]
        point = OBSERVATION.drawing(bent)[(rows[0] - 2) // 2] + CENTER
        way, beyond = point - y[rows] - CENTER, np.linalg.norm(edge.uv - point, axis=1).min()
        # A radius is 8 mm, about 8 pixels.
        assert np.linalg.norm(way) - beyond == pytest.approx(0.5 * 8.0, abs=0.5)
        block = R[np.ix_(rows, rows)]
        assert way @ block @ way / (way @ way) < 0.02 * np.trace(block)


def test_partly_visible_hands_are_measured_where_visible(render):
    x = hand(24)
    for shift in ((0.0, -170.0), (0.0, 200.0), (260.0, 0.0)):
        moved = x.copy()
        moved[:2] += shift
        assert np.isfinite(SILHOUETTE.measure(render(moved), sure_of(moved)).y).any()


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
