"""Points of a scene matched between pictures that one camera took from several places."""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from drake_pose.arrays import Array, Indices, Picture
from drake_pose.camera.models import PinholeCamera


class MatchSettings(NamedTuple):
    """Settings of the matching; chosen on pictures of 320 to 1280 pixels' width."""

    features: int = 1200  # Maximum number of features of a picture.
    contrast: float = 0.02  # Minimum contrast of a feature, as of OpenCV's SIFT.
    # Maximum distance of a match's descriptors over that of the second best (Lowe's test).
    ratio: float = 0.8
    # Minimum motion of a match [pixel]. A point that moves less is on the gripper or tells nothing.
    still: float = 3.0
    epipolar: float = 2.0  # Maximum distance of an inlier from its epipolar line [pixel].
    least: int = 12  # Minimum number of matches of a pair of pictures.


MATCHING = MatchSettings()


class Matches(NamedTuple):
    """n points, each matched between two pictures.

    frames: (n, 2) indices of the pictures. uv: (n, 2, 2) the point's place (u, v) in each [pixel].
    """

    frames: Indices
    uv: Array


class Sightings(NamedTuple):
    """Points of the scene seen in several pictures.

    frames, points: (n,) index of the picture and of the point. uv: (n, 2) the place [pixel].
    """

    frames: Indices
    points: Indices
    uv: Array


def match_pictures(pictures: Sequence[Picture]) -> tuple[Matches, Sightings]:
    """Match points between all pairs of RGB pictures (H, W, 3), and join the matches to tracks."""
    sift = cv2.SIFT.create(MATCHING.features, contrastThreshold=MATCHING.contrast)
    features = [sift.detectAndCompute(cv2.cvtColor(p, cv2.COLOR_RGB2GRAY), None) for p in pictures]
    uv = [np.array([k.pt for k in keys], np.float64).reshape(-1, 2) for keys, _ in features]
    # RootSIFT: Hellinger's distance of the histograms.
    descriptors = [
        None if d is None else np.sqrt(d / np.maximum(d.sum(axis=1, keepdims=True), 1e-9))
        for _, d in features
    ]
    first = np.cumsum([0, *map(len, uv)])
    pairs, kept = [], []
    for i, j in combinations(range(len(pictures)), 2):
        rows = _mutual(descriptors[i], descriptors[j])
        matched = np.stack([uv[i][rows[:, 0]], uv[j][rows[:, 1]]], axis=1)
        moves = np.linalg.norm(matched[:, 1] - matched[:, 0], axis=1) > MATCHING.still
        rows, matched = rows[moves], matched[moves]
        rows = rows[_on_epipolar_lines(matched)]
        pairs.append(rows + first[[i, j]])
        kept.append(np.tile([i, j], (len(rows), 1)))
    edges, frames = np.concatenate(pairs), np.concatenate(kept)
    everything, picture = np.concatenate(uv), np.repeat(np.arange(len(uv)), np.diff(first))
    return Matches(frames, everything[edges]), _tracks(edges, picture, everything)


def _mutual(a: Array | None, b: Array | None) -> Indices:
    """Return (n, 2) rows of a and b that are mutual nearest neighbours and pass Lowe's ratio test.

    a, b: (., 128) unit descriptors of two pictures; None: a picture has no features.
    """
    if a is None or b is None or min(len(a), len(b)) < 2:
        return np.zeros((0, 2), np.intp)
    alike = a @ b.T
    best = alike.argmax(axis=1)
    rows = np.arange(len(a))
    first = alike[rows, best]
    mutual = alike.argmax(axis=0)[best] == rows
    alike[rows, best] = -1.0
    # The distance of unit vectors follows from their cosine.
    near, second = (np.sqrt(np.maximum(2.0 - 2.0 * cos, 0.0)) for cos in (first, alike.max(axis=1)))
    rows = rows[mutual & (near < MATCHING.ratio * second)]
    return np.stack([rows, best[rows]], axis=1)


def _on_epipolar_lines(uv: Array) -> NDArray[np.bool_]:
    """Return which of a pair's matches (n, 2, 2) agree with one epipolar geometry."""
    if len(uv) >= MATCHING.least:
        cv2.setRNGSeed(0)
        a, b = np.ascontiguousarray(uv[:, 0]), np.ascontiguousarray(uv[:, 1])
        F, mask = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, MATCHING.epipolar, 0.99, 1000)
        if F is not None and mask is not None and np.count_nonzero(mask) >= MATCHING.least:
            return np.asarray(mask.ravel() > 0)
    return np.zeros(len(uv), np.bool_)


def _tracks(edges: Indices, picture: Indices, uv: Array) -> Sightings:
    """Return the tracks that matches join, without tracks with two features in one picture.

    ``edges``: (n, 2) indices of matched features. ``picture``: (features,) index of each feature's
    picture. ``uv``: (features, 2) their places [pixel].
    """
    count = len(picture)
    graph = coo_array((np.ones(len(edges)), edges.T), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    size = np.bincount(label)
    used = np.flatnonzero(size[label] > 1)
    pairs = np.column_stack([label[used], picture[used]])
    _, inverse, times = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    # A track with two features in a picture is dropped: which feature is right is not known.
    ambiguous = np.unique(label[used][times[inverse.ravel()] > 1])
    used = used[~np.isin(label[used], ambiguous)]
    _, points = np.unique(label[used], return_inverse=True)
    return Sightings(picture[used], points, uv[used])


def rays(camera: PinholeCamera, uv: Array) -> Array:
    """Return rays (..., 3) with z = 1, in the camera's frame, through uv (..., 2) [pixel]."""
    f, c = (camera.focal_x, camera.focal_y), (camera.center_x, camera.center_y)
    xy = (uv - c) / f
    return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
