"""Overlays of body and silhouette: agreement, silhouette only (missing), body only (excess)."""

import io
import zlib
from collections.abc import Callable, Collection, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.silhouette.outline import Outline, outline_from_mesh
from drake_pose.silhouette.scoring import draw_labels

Colour = tuple[int, int, int]

# Blue and vermilion of Okabe and Ito can be distinguished by colour-blind people and in grey.
BACKGROUND_RGB = (24, 24, 24)
AGREEMENT_RGB = (215, 215, 215)
MISSING_RGB = (0, 114, 178)
EXCESS_RGB = (213, 94, 0)
OUTLINE_RGB = (0, 0, 0)
KNOWN_RGB, OPEN_RGB = (86, 160, 210), (150, 150, 150)

_TEXT_RGB = (255, 255, 255)
# Overlays of silhouettes have few colours: drawing and encoding palette indices takes a third of
# the time of RGB. First 16 greys for smoothed text, then background, mask only, body only, both.
_TEXT, _FIRST = 15, 16
PALETTE = np.array(
    [[17 * k] * 3 for k in range(_FIRST)]
    + [BACKGROUND_RGB, MISSING_RGB, EXCESS_RGB, AGREEMENT_RGB],
    dtype=np.uint8,
)
"""(colours, 3) RGB palette of the overlays (H, W) of silhouettes."""
_BACKGROUND, _MISSING, _EXCESS, _AGREEMENT = range(_FIRST, len(PALETTE))
_OUTLINE = 0


def paint_agreement(
    mask: np.ndarray, body: np.ndarray, segments: np.ndarray | None = None
) -> np.ndarray:
    """Return an RGB picture (H, W, 3) uint8 of where a mask and a body agree.

    Both is AGREEMENT_RGB, mask only MISSING_RGB, body only EXCESS_RGB, neither BACKGROUND_RGB.

    ``mask``: (H, W) bool silhouette. ``body``: (H, W) bool, the estimated body. ``segments``: (H,
    W) int, index of the body's segment at each pixel, whose borders are drawn in OUTLINE_RGB; None:
    no borders.
    """
    return PALETTE[_number_agreement(mask, body, segments)]


def _number_agreement(
    mask: np.ndarray, body: np.ndarray, segments: np.ndarray | None
) -> np.ndarray:
    """Return `paint_agreement`'s picture, of the same arguments, as indices (H, W) of PALETTE."""
    picture = _FIRST + mask.view(np.uint8) + 2 * body.view(np.uint8)
    _draw_borders(picture, body, segments, _OUTLINE)
    return picture


def draw_overlay(
    observed: np.ndarray, body: np.ndarray, segments: np.ndarray | None, title: str
) -> np.ndarray:
    """Draw the overlay of one camera and frame, cropped to the body and silhouette.

    Args:
        observed: (H, W) bool silhouette to compare the body with, or (H, W, 3) picture over which
            the body's contour is drawn.
        body: (H, W) bool, the estimated body; all False if no pose was found.
        segments: (H, W) int, index of the body's segment at each pixel, whose borders are drawn;
            None: no borders.
        title: text above the picture.

    Returns (h, w, 3) uint8 RGB over a picture; (h, w) uint8 indices into PALETTE, with a legend,
    over a silhouette. Small pictures are enlarged by an integer.
    """
    width = max(1, len(observed) // 500)
    window = _surroundings(body if observed.ndim == 3 else observed | body)
    observed, body = observed[window], body[window]
    segments = None if segments is None else segments[window]
    if observed.ndim == 3:
        painted = observed.copy()
        _draw_contour(painted, body, EXCESS_RGB, width)
        _draw_borders(painted, body, segments, OUTLINE_RGB)
        return _framed(_enlarged(painted), title)
    picture = _enlarged(_number_agreement(observed, body, segments))
    silhouette, both, drawn = (
        int(np.count_nonzero(one)) for one in (observed, observed & body, body)
    )
    area = max(1, silhouette)
    legend = [
        (_AGREEMENT, f"agreement {100.0 * both / area:.1f} %"),
        (_MISSING, f"missing {100.0 * (silhouette - both) / area:.1f} %"),
        (_EXCESS, f"excess {100.0 * (drawn - both) / area:.1f} %"),
    ]
    return _framed(picture, title, legend)


def draw_shapes(
    observed: np.ndarray, shapes: Sequence[np.ndarray], names: Sequence[str], title: str
) -> np.ndarray:
    """Draw the contours of one or two bodies over a silhouette or picture.

    Args:
        observed: (H, W) bool silhouette, which is cropped to bodies and silhouette; or (H, W, 3)
            uint8 RGB picture, which is not cropped.
        shapes: one or two bodies (H, W) bool.
        names: their names in the legend.
        title: text above the picture.

    Returns (h, w, 3) uint8 RGB.
    """
    legend, window, picture = list[tuple[Colour, str]](), (slice(None), slice(None)), observed
    if observed.ndim == 2:
        window = _surroundings(np.logical_or.reduce([observed, *shapes]))
        picture = np.where(observed[..., None], AGREEMENT_RGB, BACKGROUND_RGB)
        legend = [(AGREEMENT_RGB, "silhouette")]
    picture = _enlarged(picture[window])
    for shape, colour, name in zip(shapes, (MISSING_RGB, EXCESS_RGB), names, strict=False):
        _draw_contour(picture, _enlarged(shape[window]), colour, 2)
        legend.append((colour, name))
    return _framed(picture, title, legend)


def body_drawer(
    tree: PoseTree, visible_nodes: Collection[str] | None
) -> Callable[[Camera, Array], NDArray[np.intp]]:
    """Return a function that draws the body as seen by a camera, at values (m,) of the pose tree.

    The drawing (H, W) has for each pixel the index of the drawn node that it shows, or -1.

    visible_nodes: names of the nodes that are drawn; None: all.
    """
    kinematics, names = TreeKinematics(tree), visible_nodes
    shown = [k for k, node in enumerate(tree.nodes) if names is None or node.name in names]
    outlines = [outline_from_mesh(tree.nodes[k].mesh) for k in shown]

    def draw(camera: Camera, values: Array) -> NDArray[np.intp]:
        X_CN = camera.X_CW @ kinematics.poses(values)[shown]
        labels = draw_labels(outlines, np.arange(1, len(shown) + 1), X_CN, camera)
        return np.asarray(labels, np.intp) - 1

    return draw


def draw_modes(
    bodies: Sequence[tuple[Sequence[Outline], Array]], camera: Camera, known: Mask, side: int = 380
) -> Picture:
    """Draw poses of a body along a camera's axis, and from its side; several have a row each.

    ``bodies``: outlines of the nodes, and their poses X_WN (nodes, 4, 4), of each pose. ``known``:
    (nodes,) nodes in blue; others are grey. ``side``: side of a drawing [pixel].

    Returns (h, w, 3) uint8 RGB.
    """
    colours = np.array([BACKGROUND_RGB, *np.where(known[:, None], KNOWN_RGB, OPEN_RGB)], np.uint8)
    turn, rows = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), list[Picture]()
    for number, (outlines, X_WN) in enumerate(bodies, 1):
        points = [o.vertices @ X[:3, :3].T + X[:3, 3] for o, X in zip(outlines, X_WN, strict=True)]
        ends = np.array([f(np.concatenate(points), axis=0) for f in (np.min, np.max)])
        middle, size = ends.mean(axis=0), float(np.linalg.norm(ends[1] - ends[0]))
        row, of = [], f"  pose {number} of {len(bodies)}" if len(bodies) > 1 else ""
        for R, words in ((np.eye(3), "as the camera sees it"), (turn, "from the side")):
            X_WC = np.array(camera.X_WC)
            X_WC[:3, :3] = X_WC[:3, :3] @ R
            X_WC[:3, 3] = middle - size * X_WC[:3, 2]
            half = 0.5 * (side - 1)
            view = ParallelCamera("", side, side, 0.96 * side / size, half, half, X_WC)
            nodes = draw_labels(outlines, range(1, 1 + len(outlines)), view.X_CW @ X_WN, view)
            drawn = colours[nodes]
            _draw_borders(drawn, nodes > 0, nodes, OUTLINE_RGB)
            row.append(_framed(drawn, words + of, least_width=side))
        rows.append(np.hstack(row) if len(bodies) > 1 else np.vstack(row))
    return np.vstack(rows)


def encode_png(picture: np.ndarray) -> bytes:
    """Return the PNG file of an RGB picture (H, W, 3) uint8, or of indices (H, W) into PALETTE."""
    if picture.ndim == 2:
        image, stream = Image.fromarray(picture), io.BytesIO()
        image.putpalette(PALETTE.tobytes())
        # Areas of one colour are runs: other strategies take twice as long for larger files.
        image.save(stream, "PNG", compress_level=1, compress_type=zlib.Z_RLE)
        return stream.getvalue()
    _, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    return data.tobytes()


def _draw_contour(picture: np.ndarray, body: np.ndarray, colour: Colour, width: int) -> None:
    """Draw the contours of a body (H, W) bool, ``width`` pixels wide, into a picture (H, W, 3)."""
    shape = body.astype(np.uint8)
    contours, _ = cv2.findContours(shape, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, colour, width)


def _draw_borders(
    picture: np.ndarray, body: np.ndarray, segments: np.ndarray | None, colour: Colour | int
) -> None:
    """Colour the body's pixels whose right or lower neighbour is another segment of the body.

    ``picture``: (H, W, 3) RGB or (H, W) indices of PALETTE, as ``colour``; changed in place.
    ``segments``: (H, W) index of the segment at each pixel; None: nothing is drawn.
    """
    if segments is None:
        return
    borders = np.zeros(body.shape, dtype=np.bool_)
    borders[:, :-1] = body[:, 1:] & (segments[:, :-1] != segments[:, 1:])
    borders[:-1] |= body[1:] & (segments[:-1] != segments[1:])
    picture[borders & body] = colour


def _surroundings(shown: np.ndarray, margin_fraction: float = 0.12) -> tuple[slice, slice]:
    """Return slices of rows and columns around the True pixels of ``shown`` (H, W).

    They are those of the whole picture if no pixel is True. The margin is 8 pixels and the fraction
    ``margin_fraction`` of the larger of the pixels' width and height.
    """
    left, top, width, height = cv2.boundingRect(shown.view(np.uint8))
    if not width:
        return slice(None), slice(None)
    margin = 8 + int(margin_fraction * (max(width, height) - 1))
    rows = slice(max(0, top - margin), top + height + margin)
    return rows, slice(max(0, left - margin), left + width + margin)


def _enlarged(picture: np.ndarray, width_to: int = 1120, height_to: int = 480) -> np.ndarray:
    """Return a picture (H, W) or (H, W, 3) enlarged by the largest integer, at most 8, that fits.

    It fits a width ``width_to`` and height ``height_to`` [pixel]; a larger picture keeps its size.
    """
    height, width = picture.shape[:2]
    scale = max(1, min(height_to // height, width_to // width, 8))
    size = width * scale, height * scale
    return cv2.resize(picture.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)


def _framed(
    picture: np.ndarray,
    title: str,
    legend: Sequence[tuple[Colour | int, str]] = (),
    least_width: int = 560,
    band: int = 36,
) -> np.ndarray:
    """Return a picture with a band for the title above it, and one for the legend below it.

    ``picture``: (H, W, 3) uint8 RGB, or (H, W) uint8 indices into PALETTE; so is the result.
    ``title``: text above the picture. ``legend``: colour (RGB or index, as in the picture) and text
    of each entry; empty: no band. ``least_width``: width to which a narrower picture is padded on
    both sides [pixel]. ``band``: height of a band [pixel].
    """
    numbered = picture.ndim == 2
    ground, text_colour = (_BACKGROUND, _TEXT) if numbered else (BACKGROUND_RGB, _TEXT_RGB)
    pad = max(0, least_width - picture.shape[1])
    wide = cv2.copyMakeBorder(
        picture, band, band + 2 if legend else 0, pad // 2, pad - pad // 2,
        cv2.BORDER_CONSTANT, value=ground,
    )  # fmt: skip
    wide[:band] = 0
    _put_text(wide, title, (10, band - 14), text_colour)
    if legend:
        below = wide[-band - 2 :]
        below[:] = 0
        step = below.shape[1] // len(legend)
        for number, (colour, text) in enumerate(legend):
            left = 10 + number * step
            cv2.rectangle(below, (left, 10), (left + 16, 26), colour, cv2.FILLED)
            _put_text(below, text, (left + 24, 25), text_colour)
    return wide


def _put_text(
    picture: np.ndarray, text: str, position: tuple[int, int], colour: Colour | int
) -> None:
    """Draw a text into a picture, with its lower left corner at ``position`` (x, y) [pixel]."""
    cv2.putText(picture, text, position, cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
