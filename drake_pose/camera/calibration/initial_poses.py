"""First poses of several cameras: pairs that saw the board at the same instants, chained."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from drake_pose.camera.calibration.board import Detection
from drake_pose.camera.calibration.intrinsics import LensEstimate, inverse_pose
from drake_pose.errors import CameraError

Array = NDArray[np.float64]
Detections = Mapping[str, Mapping[str, Detection]]
"""Detections by camera, then by frame."""


def picture_error(
    points: Array, detection: Detection, estimate: LensEstimate, X_CB: Array
) -> float:
    """Root mean square distance of a picture's corners from where a board's pose puts them [pixel].

    Infinite where the board would be behind the camera.
    """
    p_C = points[detection.corners] @ X_CB[:3, :3].T + X_CB[:3, 3]
    if p_C[:, 2].min() <= 0.0:
        return float("inf")
    difference = estimate.lens.project(p_C) - detection.uv
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))


def pair_pose(
    points: Array,
    detections: Detections,
    lenses: Mapping[str, LensEstimate],
    first: str,
    second: str,
) -> tuple[Array, float] | None:
    """The second camera's pose in the first's frame (4, 4), from the instants both saw the board.

    Every shared instant proposes a pose; the one wins that explains the other instants best by
    its median, so that a minority of spoilt pictures does no harm.

    Returns:
        The pose and the median error [pixel]; None where the cameras share no picture.
    """
    shared = [frame for frame in detections[first] if frame in detections[second]]
    if not shared:
        return None
    best, best_error = np.eye(4), np.inf
    a, b = lenses[first], lenses[second]
    for proposer in shared:
        X_AB = a.X_CB[proposer] @ inverse_pose(b.X_CB[proposer])
        errors = [
            picture_error(points, detections[first][frame], a, X_AB @ b.X_CB[frame])
            for frame in shared
        ]
        # A proposer explains itself: it has no say where others can be asked.
        others = [e for frame, e in zip(shared, errors, strict=True) if frame != proposer]
        error = float(np.median(others or errors))
        if error < best_error or proposer == shared[0]:
            best, best_error = X_AB, error
    return best, best_error


def chain_cameras(
    points: Array, detections: Detections, lenses: Mapping[str, LensEstimate]
) -> dict[str, Array]:
    """Poses (4, 4) of all cameras in the first one's frame, by the most trustworthy pairs.

    Raises:
        CameraError: when the cameras fall into groups that share no picture.
    """
    require_shared_pictures(detections)
    names = list(detections)
    pairs: dict[tuple[int, int], Array] = {}
    costs = []
    for i, j in combinations(range(len(names)), 2):
        found = pair_pose(points, detections, lenses, names[i], names[j])
        if found is None:
            continue
        shared = sum(frame in detections[names[j]] for frame in detections[names[i]])
        pairs[i, j], pairs[j, i] = found[0], inverse_pose(found[0])
        # More shared instants and a smaller error make a better link; both stay positive.
        costs.append((i, j, (1.0 + min(found[1], 1e6)) / shared))
    rows, columns, values = ([c[k] for c in costs] for k in range(3))
    graph = coo_array((values, (rows, columns)), shape=(len(names), len(names))).tocsr()
    tree = minimum_spanning_tree(graph)
    order, parents = breadth_first_order(tree, 0, directed=False)
    poses = {names[0]: np.eye(4)}
    for child in order[1:]:
        parent = int(parents[child])
        poses[names[child]] = poses[names[parent]] @ pairs[parent, int(child)]
    return {name: poses[name] for name in names}


def board_poses(
    points: Array,
    detections: Detections,
    lenses: Mapping[str, LensEstimate],
    poses: dict[str, Array],
) -> dict[str, Array]:
    """The board's pose (4, 4) in the cameras' common frame at each instant.

    Every camera that saw the board proposes one; the one with the smallest median error wins.
    """
    frames = list(dict.fromkeys(frame for seen in detections.values() for frame in seen))
    found = {}
    for frame in frames:
        seers = [name for name in detections if frame in detections[name]]
        proposals = [poses[name] @ lenses[name].X_CB[frame] for name in seers]
        errors = [
            np.median(
                [
                    picture_error(
                        points,
                        detections[name][frame],
                        lenses[name],
                        inverse_pose(poses[name]) @ proposal,
                    )
                    for name in seers
                ]
            )
            for proposal in proposals
        ]
        found[frame] = proposals[int(np.argmin(errors))]
    return found


def require_shared_pictures(detections: Detections) -> None:
    """Checks that instants which several cameras saw tie all cameras together.

    Raises:
        CameraError: when the cameras fall into groups that share no picture.
    """
    names = list(detections)
    shared = [
        (i, j)
        for i, j in combinations(range(len(names)), 2)
        if set(detections[names[i]]) & set(detections[names[j]])
    ]
    rows, columns = np.array(shared, dtype=int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(shared)), (rows, columns)), shape=(len(names), len(names)))
    count, groups = connected_components(graph, directed=False)
    if count == 1:
        return
    parts = [
        [name for name, group in zip(names, groups, strict=True) if group == g]
        for g in range(count)
    ]
    parts.sort(key=len)
    listing = "; ".join(", ".join(f"'{name}'" for name in part) for part in parts)
    few = ", ".join(f"'{name}'" for name in parts[0])
    raise CameraError(
        f"camera {few} shares no picture of the board with the others (groups: {listing}): show "
        "the board to cameras of both groups at the same instant (the same file name), or leave "
        f"camera {few} out"
    )
