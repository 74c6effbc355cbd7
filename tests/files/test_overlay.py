"""Overlays, pixel by pixel, against their definition and OpenCV's text."""

import cv2
import numpy as np
import pytest
import trimesh

from drake_pose.body import TriangleMesh
from drake_pose.camera.models import PinholeCamera
from drake_pose.files import overlay
from drake_pose.files.overlay import PALETTE, draw_overlay, draw_shapes, paint_agreement
from drake_pose.silhouette.outline import outline_from_mesh

RNG = np.random.default_rng(3)


def rectangle(shape, rows, columns):
    mask = np.zeros(shape, dtype=bool)
    mask[slice(*rows), slice(*columns)] = True
    return mask


def require_text(picture, text, left, base):
    """Assert that a text, half as large as OpenCV's, begins at a pixel of an RGB picture."""
    drawn = np.zeros(picture.shape[:2], np.uint8)
    cv2.putText(drawn, text, (left, base), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 15, 1, cv2.LINE_AA)
    full = drawn == 15
    assert full.sum() > 20
    assert (picture[full] > 245).all()


def test_agreement_has_its_colours_and_borders():
    """A border is a pixel of the body left of, or above, another segment of the body."""
    mask, body = RNG.random((2, 12, 15)) < 0.7
    names = {(1, 1): "AGREEMENT", (1, 0): "MISSING", (0, 1): "EXCESS", (0, 0): "BACKGROUND"}
    for segments in (RNG.integers(0, 3, (12, 15)), np.zeros((12, 15), int)):
        expected = np.zeros((12, 15, 3), np.uint8)
        for v, u in np.ndindex(12, 15):
            beside = [(a, b) for a, b in ((v, u + 1), (v + 1, u)) if a < 12 and b < 15]
            others = [k for k in beside if body[k] and segments[k] != segments[v, u]]
            name = "OUTLINE" if body[v, u] and others else names[mask[v, u], body[v, u]]
            expected[v, u] = getattr(overlay, f"{name}_RGB")
        np.testing.assert_array_equal(paint_agreement(mask, body, segments), expected)
    np.testing.assert_array_equal(paint_agreement(mask, body), expected)


@pytest.mark.parametrize(
    ("size", "rows", "columns", "scale"),
    [
        # Margins are 8 pixels and .12 of the larger of width and height, less 1.
        ((700, 900), (300, 340), (500, 560), 6), ((90, 60), (2, 40), (3, 59), 8),
        ((600, 1000), (100, 150), (100, 500), 2), ((1900, 1100), (1000, 1600), (300, 610), 1),
        ((30, 30), (10, 11), (20, 21), 8),
    ],
)  # fmt: skip
def test_overlays_are_cropped_enlarged_and_named(size, rows, columns, scale):
    mask = rectangle(size, rows, columns) & (RNG.random(size) < 0.9)
    mask[rows[0], columns[0]] = mask[rows[1] - 1, columns[1] - 1] = True
    body = rectangle(size, rows, (columns[0], columns[1] - 9)) & (RNG.random(size) < 0.7)
    segments = np.zeros(size)
    drawn = draw_overlay(mask, body, segments, "front  frame 7")
    picture = PALETTE[drawn]
    margin = 8 + int(0.12 * (max(rows[1] - rows[0], columns[1] - columns[0]) - 1))
    window = tuple(slice(max(0, a - margin), b + margin) for a, b in (rows, columns))
    inside = paint_agreement(mask[window], body[window])
    inside = inside.repeat(scale, axis=0).repeat(scale, axis=1)
    pad = max(0, 560 - inside.shape[1])
    assert picture.shape == (36 + len(inside) + 38, inside.shape[1] + pad, 3)
    left = pad // 2
    np.testing.assert_array_equal(picture[36:-38, left : left + inside.shape[1]], inside)
    if left:
        assert (picture[36:-38, :left] == overlay.BACKGROUND_RGB).all()
    require_text(picture, "front  frame 7", 10, 22)
    for k, (name, part, colour) in enumerate((
        ("agreement", mask & body, overlay.AGREEMENT_RGB),
        ("missing", mask & ~body, overlay.MISSING_RGB),
        ("excess", body & ~mask, overlay.EXCESS_RGB),
    )):  # fmt: skip
        left = 10 + k * (picture.shape[1] // 3)
        require_text(picture[-38:], f"{name} {100 * part.sum() / mask.sum():.1f} %", left + 24, 25)
        box = (picture[-38:] == colour).all(axis=2)
        np.testing.assert_array_equal(
            box[:, left : left + 17], rectangle((38, 17), (10, 27), (0, 17))
        )


@pytest.mark.parametrize(("height", "width"), [(400, 1), (1000, 2)])
def test_pictures_have_the_bodys_contour_and_borders(height, width):
    picture = RNG.integers(40, 90, (height, 700, 3), dtype=np.uint8)
    body, segments = rectangle(picture.shape[:2], (150, 350), (200, 550)), np.zeros((height, 700))
    segments[:, 400:] = 1
    line = body & ~rectangle(picture.shape[:2], (151, 349), (201, 549))
    expected, window = picture.copy(), (slice(101, 399), slice(151, 599))
    expected[line if width == 1 else cv2.dilate(line * 1.0, np.ones((3, 3))) > 0] = 213, 94, 0
    expected[150:350, 399] = 0
    found = draw_overlay(picture, body, segments, "t")[36:, 56:-56]
    # OpenCV rounds the corners of thick lines.
    assert (found != expected[window]).any(axis=2).sum() <= 8 * (width - 1)
    untouched = draw_overlay(picture, np.zeros_like(body), None, "t")
    np.testing.assert_array_equal(untouched[36:], picture)


def test_shapes_are_contours_over_the_silhouette():
    mask = rectangle((600, 600), (100, 500), (100, 500))
    shapes = [rectangle((600, 600), (100, 500), one) for one in ((150, 450), (200, 400))]
    picture, margin = draw_shapes(mask, shapes, ("the file's", "corrected"), "title"), 8 + 47
    inside = picture[36:-38, 25:-25]
    assert inside.shape == (400 + 2 * margin, 400 + 2 * margin, 3)
    # A line is three pixels wide; the second contour covers the first.
    row = inside[margin + 200]
    for colour, columns in ((overlay.MISSING_RGB, (50, 349)), (overlay.EXCESS_RGB, (100, 299))):
        at = np.flatnonzero((row == colour).all(axis=1)) - margin
        np.testing.assert_array_equal(at, [k + c for c in columns for k in (-1, 0, 1)])
    assert (row[margin + 60] == overlay.AGREEMENT_RGB).all()
    assert (inside[:margin] == overlay.BACKGROUND_RGB)[:-2].all()
    for k, text in enumerate(("silhouette", "the file's", "corrected")):
        require_text(picture[-38:], text, 34 + k * (picture.shape[1] // 3), 25)
    # A picture is not cropped, and has no silhouette in its legend.
    seen = np.full((600, 600, 3), 77, np.uint8)
    whole = draw_shapes(seen, shapes[:1], ("the file's",), "title")
    assert whole.shape == (36 + 600 + 38, 600, 3)
    assert (whole[136 + 200, 150] == overlay.MISSING_RGB).all()


def test_modes_are_drawn_along_the_axis_and_from_the_side():
    """Boxes of a body fill .96 of a drawing by their diagonal; those that are known are blue."""
    sides, X_WN = np.array([0.2, 0.4, 0.6]), np.repeat(np.eye(4)[None], 2, axis=0)
    half = trimesh.creation.box(sides * [1, 1, 0.5])
    outlines = 2 * [outline_from_mesh(TriangleMesh(half.vertices, half.faces))]
    X_WN[:, :3, 3] = [[1.0, 2.0, 2.85], [1.0, 2.0, 3.15]]
    eye = PinholeCamera("c", 64, 48, 50.0, 50.0, 31.5, 23.5, np.eye(4))
    one = overlay.draw_modes([(outlines, X_WN)], eye, np.array([True, False]))
    assert one.shape == (2 * 416, 380, 3)
    for rows, text, lengths, known in (
        (one[:416], "as the camera sees it", (0.4, 0.2), 1.0),
        (one[416:], "from the side", (0.4, 0.6), 0.5),
    ):
        require_text(rows, text, 10, 22)
        shown = (rows[36:] != overlay.BACKGROUND_RGB).any(axis=2)
        for found, length in zip(np.nonzero(shown), lengths, strict=True):
            wide = 0.96 * 380 * length / np.linalg.norm(sides)
            assert np.ptp(found) + 1 == pytest.approx(wide, abs=1.01)
            assert 0.5 * (found.min() + found.max()) == pytest.approx(189.5, abs=0.51)
        blue, grey = (
            (rows[36:][shown] == c).all(axis=1).mean()
            for c in (overlay.KNOWN_RGB, overlay.OPEN_RGB)
        )
        assert (blue, grey) == (pytest.approx(known, abs=0.01), pytest.approx(1 - known, abs=0.01))
    # The middle line between two nodes is a border.
    assert (one[416 + 36 + 190, 186:194] == 0).all(axis=1).sum() == 1
    two = overlay.draw_modes([(outlines, X_WN)] * 2, eye, np.array([True, True]))
    assert two.shape == (2 * 416, 760, 3)
    require_text(two[416:, 380:], "from the side  pose 2 of 2", 10, 22)


def test_png_of_rgb_and_of_palette_indices_are_equal():
    numbers = np.arange(len(PALETTE), dtype=np.uint8).reshape(4, -1)
    for picture in (numbers, PALETTE[numbers]):
        data = np.frombuffer(overlay.encode_png(picture), np.uint8)
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(decoded[..., ::-1], PALETTE[numbers])
