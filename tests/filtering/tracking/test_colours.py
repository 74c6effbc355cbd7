"""An orange body before a coloured background, painted over Drake's label images."""

import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.filtering.contour_observation import ContourObservation
from drake_pose.filtering.contour_tracker import Tracker
from drake_pose.fit import colours
from drake_pose.fit.colours import COLOURS, LINES, Colour, part_distances, weigh_parts
from drake_pose.fit.contour_fit import Comparison
from drake_pose.fit.kernel import Sum
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.filtering.measurements.test_contour import descend
from tests.filtering.tracking.test_match_and_track import PERIOD
from tests.search.bodies import near_camera

SIDE = 480
ORANGE, GREEN = np.array([230, 130, 40]), np.array([60, 140, 60])


@pytest.fixture(scope="module")
def camera():
    return near_camera(SIDE)


@pytest.fixture(scope="module")
def renderer(body, camera):
    return LabelRenderer(body, camera)


@pytest.fixture
def observation(body, camera):
    return ContourObservation(body.pose_tree(), [camera])


TRUTH = np.array([0.2, 0.9, -0.6])


def make_background(generator):
    """Return a background (SIDE, SIDE, 3) of patches in all colours except orange."""
    patches = generator.integers(0, 256, (24, 24, 3))
    patches[..., 2] = np.maximum(patches[..., 2], 90)
    return patches.repeat(20, axis=0).repeat(20, axis=1)


def painted(mask, background, generator):
    """Return a picture of an orange body before a background, with noise."""
    noise = generator.normal(0.0, 6.0, (*mask.shape, 3))
    return np.clip(np.where(mask[..., None], ORANGE, background) + noise, 0, 255).astype(np.uint8)


class Painter:
    """Paints masks before a background of its own."""

    def __init__(self, seed):
        self.generator = np.random.default_rng(seed)
        self.background = make_background(self.generator)

    def __call__(self, mask):
        return painted(mask, self.background, self.generator)


def bin_index(colour):
    """Return the index of a colour's histogram bin."""
    return int(np.dot(colour >> 4, [256, 16, 1]))


def track_pictures(observation, pictures):
    """Return a tracker, and its track of the body at TRUTH after the pictures."""
    tracker = Tracker(observation.tree, observation.cameras, PERIOD)
    track = tracker.start(observation.state(TRUTH))
    for k, picture in enumerate(pictures):
        track = tracker.follow(track, [None], k == 0, pictures=[picture])
    return tracker, track


def test_colours_lead_to_the_true_pose(observation, renderer):
    picture = Painter(3)(renderer.mask(TRUTH))
    x = observation.state(TRUTH)
    colours = observation.update_histograms([picture], x, observation.uninformed_histograms(), True)
    seen = observation.gather_evidence([None], [picture], colours)
    found, measured = descend(observation, seen, x + np.r_[0.12, -0.15, 0.1, 0, 0, 0], steps=6)
    # Segments have 12 to 24 pixels: a quarter of a pixel is a degree.
    np.testing.assert_allclose(observation.positions(found)[0], TRUTH, atol=np.radians(2.5))
    assert measured.distance < 0.8


def test_histograms_hold_the_colours_on_both_sides_of_the_contour(observation, renderer):
    picture = np.where(renderer.mask(TRUTH)[..., None], ORANGE, GREEN).astype(np.uint8)
    known = observation.update_histograms(
        [picture], observation.state(TRUTH), observation.uninformed_histograms()
    )
    seen = known[0, known[0, :, Colour.ON].sum(axis=-1) > 0]
    assert len(seen) == 3
    for side, colour in ((Colour.ON, ORANGE), (Colour.BESIDE, GREEN)):
        assert bin_index(colour) < COLOURS
        # At bends of the contour, the strips overlap its other side.
        assert np.all(seen[:, side, bin_index(colour)] > 0.8)
        np.testing.assert_allclose(seen[:, side].sum(axis=-1), 1.0, rtol=1e-4)


def test_old_histograms_decay_at_the_rate(observation, renderer, monkeypatch):
    monkeypatch.setattr(colours, "LINES", LINES._replace(learning_rate=0.25, max_residual=100.0))
    mask, known = renderer.mask(TRUTH), observation.uninformed_histograms()
    for colour in (ORANGE, np.array([20, 20, 200])):
        picture = np.where(mask[..., None], colour, GREEN).astype(np.uint8)
        known = observation.update_histograms([picture], observation.state(TRUTH), known)
    fractions = known[0, :, Colour.ON, bin_index(ORANGE)]
    np.testing.assert_allclose(fractions[fractions > 0], 0.75, atol=0.06)


def test_a_body_with_the_backgrounds_colour_is_not_measured(observation):
    plain = np.full((SIDE, SIDE, 4), 120, dtype=np.uint8)
    x = observation.state(TRUTH)
    colours = observation.update_histograms([plain], x, observation.uninformed_histograms(), True)
    assert observation.measure(observation.gather_evidence([None], [plain], colours), x) is None
    tracker, track = track_pictures(observation, [])
    assert tracker.follow(track, [None], pictures=[plain]).lost


def test_a_covered_lens_loses_the_track_and_changes_no_histogram(observation, renderer):
    tracker, track = track_pictures(observation, [Painter(6)(renderer.mask(TRUTH))])
    dark = tracker.follow(track, [None], pictures=[np.zeros((SIDE, SIDE, 3), dtype=np.uint8)])
    assert dark.lost
    np.testing.assert_array_equal(dark.colours, track.colours)


def test_a_lost_track_has_the_predictions_uncertainty(observation, renderer):
    """Its search lines may have found another object's edges."""
    paint, mask = Painter(7), renderer.mask(TRUTH)
    tracker, track = track_pictures(observation, [paint(mask)] * 3)
    assert not track.lost
    aside = paint(np.roll(mask, 9, axis=1))
    expected = tracker.filter.predict(track.state).best
    lost = tracker.follow(track, [None], pictures=[aside])
    assert lost.lost
    now = lost.state.best
    assert np.all(now.deviations() >= 0.95 * expected.deviations())
    assert np.all(np.abs(now.mean - expected.mean) <= 1.01 * now.deviations())
    # The uncertainty never decreases while the track is lost.
    again = tracker.follow(lost, [None], pictures=[aside])
    later = again.state.best.deviations()[:3]
    assert not again.lost or np.all(later >= 0.95 * now.deviations()[:3])


def test_a_lost_part_increases_its_joints_uncertainty(observation, renderer):
    """The outermost arm jumps; the other parts stay, and update their histograms."""
    paint = Painter(8)
    tracker, track = track_pictures(observation, [paint(renderer.mask(TRUTH)) for _ in range(4)])
    jumped = TRUTH + np.array([0.0, 0.0, 1.2])
    after = tracker.follow(track, [None], pictures=[paint(renderer.mask(jumped))])
    assert after.lost
    lost = after.measurement.hidden_parts[0]
    assert 0 < np.count_nonzero(lost) < len(lost)
    before = tracker.filter.predict(track.state).best.deviations()
    now = after.state.best.deviations()
    error = np.abs(observation.positions(after.state.best.mean)[0] - jumped)
    assert np.all(now[:2] < 0.9 * before[:2])
    assert now[2] >= 0.95 * before[2]
    assert np.all(error[:2] < np.radians(4.0))
    changed = np.any(after.colours != track.colours, axis=(0, 2, 3))
    np.testing.assert_array_equal(changed, ~lost)


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
    sums[1, :, Sum.SQUARES] = 50.0
    compared = Comparison(
        np.ones((2, 3, 12, 12)), np.ones((2, 3, 12)), sums, np.zeros((2, 3, 13)), None
    )
    weigh_parts(compared, 0.7, [np.zeros((1, 1, 3), np.uint8), None])
    overall = (0.25 + 1.44 + 100.0) / 3.0
    expected = np.sqrt(overall / np.array([0.49, 1.44, 4.0]))
    np.testing.assert_allclose(compared.A[0, :, 3, 4], expected)
    np.testing.assert_allclose(compared.b[0, :, 5], expected)
    assert np.all(compared.A[1] == 1.0)
    assert np.all(compared.b[1] == 1.0)


@pytest.mark.parametrize(
    ("picture", "said"),
    [
        (np.zeros((100, SIDE, 3), dtype=np.uint8), "480 x 100"),
        (np.zeros((SIDE, SIDE), dtype=np.uint8), "red, green and blue"),
        (np.zeros((SIDE, SIDE, 3)), "float64"),
    ],
)
def test_pictures_of_another_size_are_refused_by_name(observation, picture, said):
    with pytest.raises(SettingsError, match=f"front.*{said}"):
        observation.gather_evidence([None], [picture], observation.uninformed_histograms())
