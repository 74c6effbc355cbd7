import cv2
import numpy as np

from drake_pose.files import overlay
from drake_pose.files.overlay import PALETTE, draw_shapes, paint_agreement


def rectangle(shape, rows, columns):
    mask = np.zeros(shape, dtype=bool)
    mask[rows, columns] = True
    return mask


def count(picture, colour):
    return int((picture == np.array(colour, dtype=np.uint8)).all(axis=2).sum())


def test_agreement_missing_and_excess_have_their_colours():
    mask = rectangle((6, 8), slice(1, 5), slice(1, 5))
    body = rectangle((6, 8), slice(1, 5), slice(3, 7))
    picture = paint_agreement(mask, body)
    for colour, (row, column), pixels in (
        (overlay.BACKGROUND_RGB, (0, 0), 24),
        (overlay.MISSING_RGB, (2, 1), 8),
        (overlay.AGREEMENT_RGB, (2, 3), 8),
        (overlay.EXCESS_RGB, (2, 6), 8),
    ):
        assert tuple(picture[row, column]) == colour
        assert count(picture, colour) == pixels


def test_borders_are_pixels_of_the_body_before_another_segment():
    """To the right or below, both within the body."""
    rng = np.random.default_rng(3)
    body, segments = rng.random((12, 15)) < 0.8, rng.integers(0, 3, (12, 15))
    drawn = (paint_agreement(body, body, segments) == overlay.OUTLINE_RGB).all(axis=2)
    for v, u in np.ndindex(12, 15):
        differs = any(
            a < 12 and b < 15 and body[a, b] and segments[a, b] != segments[v, u]
            for a, b in ((v, u + 1), (v + 1, u))
        )
        assert drawn[v, u] == (body[v, u] and differs)
    assert count(paint_agreement(body, body), overlay.OUTLINE_RGB) == 0


def test_shapes_are_contours_over_the_silhouette():
    mask = rectangle((600, 600), slice(100, 500), slice(100, 500))
    first = rectangle((600, 600), slice(100, 500), slice(150, 450))
    corrected = rectangle((600, 600), slice(100, 500), slice(200, 400))
    names = ("the file's", "corrected")
    picture = draw_shapes(mask, [first, corrected], names, "title")
    legend = draw_shapes(mask, [np.zeros_like(mask)] * 2, names, "title")
    # The upper and lower sides coincide, and the second contour covers the first.
    for colour, own in (
        (overlay.MISSING_RGB, 2 * 400 + 2 * 100),
        (overlay.EXCESS_RGB, 2 * 400 + 2 * 200),
    ):
        shown = count(picture, colour) - count(legend, colour)
        assert own < shown < 4 * own
    assert count(picture, overlay.AGREEMENT_RGB) > 0.95 * 400 * 400


def test_png_of_rgb_and_of_palette_indices_are_equal():
    numbers = np.arange(len(PALETTE), dtype=np.uint8).reshape(4, -1)
    for picture in (numbers, PALETTE[numbers]):
        data = np.frombuffer(overlay.encode_png(picture), np.uint8)
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(decoded[..., ::-1], PALETTE[numbers])
