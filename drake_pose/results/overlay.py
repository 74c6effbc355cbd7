"""Pictures to judge a match by: agreement, missing and excess told apart at a glance."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

# Okabe and Ito's blue and vermilion differ for every kind of colour vision, and in a grey print.
BACKGROUND_RGB = (24, 24, 24)
AGREEMENT_RGB = (215, 215, 215)
MISSING_RGB = (0, 114, 178)
EXCESS_RGB = (213, 94, 0)
OUTLINE_RGB = (0, 0, 0)

_TEXT_RGB = (255, 255, 255)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_LINE_HEIGHT = 26
_LEAST_WIDTH = 560
_LEAST_HEIGHT = 480
_MARGIN = 0.12


def paint_agreement(
    mask: np.ndarray, body: np.ndarray, segments: np.ndarray | None = None
) -> np.ndarray:
    """Colours (H, W, 3) every pixel by whether silhouette and body agree there.

    Either is alone in MISSING_RGB or EXCESS_RGB. Borders between segments (H, W) are drawn.
    """
    picture = np.full((*mask.shape, 3), BACKGROUND_RGB, dtype=np.uint8)
    picture[mask & body] = AGREEMENT_RGB
    picture[mask & ~body] = MISSING_RGB
    picture[body & ~mask] = EXCESS_RGB
    if segments is not None:
        picture[_inner_borders(body, segments)] = OUTLINE_RGB
    return picture


def draw_overlay(
    mask: np.ndarray, body: np.ndarray, segments: np.ndarray | None, title: Sequence[str]
) -> np.ndarray:
    """Draws the overlay of one camera and frame, with a legend.

    Args:
        mask, body: (H, W) bool, silhouette and estimated body; all False where no pose was found.
        segments: (H, W) int, which segment is seen, or None.
        title: lines of text above the picture.

    Returns:
        (h, w, 3) uint8: the surroundings, enlarged by a whole number where small, and the legend.
    """
    rows, columns = _surroundings(mask | body)
    window = (slice(*rows), slice(*columns))
    picture = paint_agreement(mask, body, segments)[window]
    height, width = picture.shape[:2]
    picture = _widen(_enlarged(picture, _enlargement(height, width)), _LEAST_WIDTH)
    area = max(1, int(mask.sum()))
    legend = [
        (AGREEMENT_RGB, f"agreement {100.0 * (mask & body).sum() / area:.1f} %"),
        (MISSING_RGB, f"missing {100.0 * (mask & ~body).sum() / area:.1f} %"),
        (EXCESS_RGB, f"excess {100.0 * (body & ~mask).sum() / area:.1f} %"),
    ]
    return np.vstack(
        [_text_band(title, picture.shape[1]), picture, _legend_band(legend, picture.shape[1])]
    )


def draw_over_picture(
    picture: np.ndarray, body: np.ndarray, segments: np.ndarray | None, title: Sequence[str]
) -> np.ndarray:
    """Draws the body's contour, and the borders between its parts, over a picture (H, W, 3).

    Otherwise as draw_overlay; the whole picture where no pose was found.
    """
    painted = picture.copy()
    contours, _ = cv2.findContours(body.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(painted, contours, -1, EXCESS_RGB, max(1, len(picture) // 500))
    if segments is not None:
        painted[_inner_borders(body, segments)] = OUTLINE_RGB
    rows, columns = _surroundings(body)
    painted = _widen(painted[slice(*rows), slice(*columns)], _LEAST_WIDTH)
    return np.vstack([_text_band(title, painted.shape[1]), painted])


def draw_shapes(
    mask: np.ndarray, shapes: Sequence[np.ndarray], names: Sequence[str], title: Sequence[str]
) -> np.ndarray:
    """Draws the contours of one or two named bodies (H, W) over a silhouette; see draw_overlay."""
    colours = (MISSING_RGB, EXCESS_RGB)[: len(shapes)]
    rows, columns = _surroundings(np.logical_or.reduce([mask, *shapes]))
    window = (slice(*rows), slice(*columns))
    scale = _enlargement(rows[1] - rows[0], columns[1] - columns[0])
    grown = [_enlarged(one[window], scale) for one in (mask, *shapes)]
    picture = np.full((*grown[0].shape, 3), BACKGROUND_RGB, dtype=np.uint8)
    picture[grown[0]] = AGREEMENT_RGB
    for shape, colour in zip(grown[1:], colours, strict=True):
        contours, _ = cv2.findContours(shape.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, contours, -1, colour, 2)
    picture = _widen(picture, _LEAST_WIDTH)
    legend = [(AGREEMENT_RGB, "silhouette"), *zip(colours, names, strict=True)]
    return np.vstack(
        [_text_band(title, picture.shape[1]), picture, _legend_band(legend, picture.shape[1])]
    )


def encode_png(picture: np.ndarray) -> bytes:
    """Returns a picture (H, W, 3) uint8, red, green, blue, as a PNG file's bytes."""
    _, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    return data.tobytes()


def _inner_borders(body: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Pixels of the body whose right or lower neighbour is another segment of the body."""
    borders = np.zeros_like(body)
    right = body[:, :-1] & body[:, 1:] & (segments[:, :-1] != segments[:, 1:])
    lower = body[:-1] & body[1:] & (segments[:-1] != segments[1:])
    borders[:, :-1] |= right
    borders[:-1] |= lower
    return borders


def _surroundings(shown: np.ndarray) -> tuple[tuple[int, int], tuple[int, int]]:
    """The rows and columns around what is shown, with a margin; the picture's where nothing is."""
    if not shown.any():
        return (0, shown.shape[0]), (0, shown.shape[1])
    spans = [np.flatnonzero(shown.any(axis=axis)) for axis in (1, 0)]
    margin = 8 + int(_MARGIN * max(span[-1] - span[0] for span in spans))
    first, second = (
        (max(0, int(span[0]) - margin), min(size, int(span[-1]) + 1 + margin))
        for span, size in zip(spans, shown.shape, strict=True)
    )
    return first, second


def _enlargement(height: int, width: int) -> int:
    """By how much a small picture is enlarged."""
    return max(1, min(_LEAST_HEIGHT // height, 2 * _LEAST_WIDTH // width, 8))


def _enlarged(picture: np.ndarray, scale: int) -> np.ndarray:
    return np.repeat(np.repeat(picture, scale, axis=0), scale, axis=1)


def _widen(picture: np.ndarray, width: int) -> np.ndarray:
    """Pads a picture with background on both sides, so that the text below it has room."""
    height, own = picture.shape[:2]
    left = max(0, width - own) // 2
    wide = np.full((height, max(width, own), 3), BACKGROUND_RGB, dtype=np.uint8)
    wide[:, left : left + own] = picture
    return wide


def _text_band(lines: Sequence[str], width: int) -> np.ndarray:
    band = np.zeros((_LINE_HEIGHT * len(lines) + 10, width, 3), dtype=np.uint8)
    for number, line in enumerate(lines):
        _put_text(band, line, (10, _LINE_HEIGHT * (number + 1) - 4))
    return band


def _legend_band(legend: Sequence[tuple[tuple[int, int, int], str]], width: int) -> np.ndarray:
    band = np.zeros((_LINE_HEIGHT + 12, width, 3), dtype=np.uint8)
    step = width // len(legend)
    for number, (colour, text) in enumerate(legend):
        left = 10 + number * step
        cv2.rectangle(band, (left, 10), (left + 16, 26), colour, cv2.FILLED)
        _put_text(band, text, (left + 24, 25))
    return band


def _put_text(picture: np.ndarray, text: str, position: tuple[int, int]) -> None:
    cv2.putText(picture, text, position, _FONT, 0.5, _TEXT_RGB, 1, cv2.LINE_AA)
