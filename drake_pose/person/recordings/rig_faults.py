"""A calibration that the silhouettes contradict before anybody is fitted: mirrored or exchanged.

Silhouettes of a consistent rig are filled by their visual hull (silhouette coherence, Hernandez,
Schmitt and Cipolla 2007); a rig that only a mirrored or exchanged picture mends is faulty.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.person.rays import triangulate
from drake_pose.person.recordings.figures import find_figures, pixels_per_metre

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Silhouettes of a sound rig are filled but for this much.
_UNFILLED = 0.01
# What happened leaves no more than this much, and this share of what was unfilled.
_LEFT, _EXPLAINED = 0.03, 0.35
# Where more is unfilled and nothing explains it, the rig is not sound.
_CONTRADICTING = 0.3
# Points of the hull's grid are so far apart, and so far from its middle to the side and up; grids
# whose middles differ by less than the last are the same [m].
_SPACING, _SIDE, _HEIGHT, _LATTICE = 0.04, 1.1, 1.3, 0.25


@dataclass(frozen=True)
class RigFault:
    """What the silhouettes of all cameras together say against their calibration.

    In a ring of four, opposite cameras exchanged are all cameras mirrored: then that is said.

    Args:
        mirrored: the cameras whose pictures are mirrored, left for right.
        exchanged: the two cameras whose pictures are each other's.
        filled: what share of the silhouettes a body can fill, by camera.
    """

    mirrored: tuple[str, ...]
    exchanged: tuple[str, ...]
    filled: Mapping[str, float]

    @property
    def is_undone(self) -> bool:
        """Whether it is known what happened."""
        return bool(self.mirrored or self.exchanged)

    def undo(self, masks: Mapping[str, Mask]) -> dict[str, Mask]:
        """The masks (H, W) of a frame by camera, mirrored and exchanged back."""
        partner = dict(zip(self.exchanged, reversed(self.exchanged), strict=True))
        found = {}
        for name, mask in masks.items():
            turned = np.ascontiguousarray(mask[:, ::-1]) if name in self.mirrored else mask
            found[partner.get(name, name)] = turned
        return found


def find_rig_fault(
    cameras: Mapping[str, Camera], frames: Sequence[Mapping[str, Mask]]
) -> RigFault | None:
    """What is wrong with a rig as a whole, by one person's masks in some frames; None: nothing."""
    frames = [masks for masks in frames if len(masks) >= 2]
    if not frames:
        return None
    hulls = _Hulls(cameras)
    filled = hulls.filled(frames, RigFault((), (), {}))
    unfilled = 1.0 - float(np.mean(list(filled.values())))
    if unfilled < _UNFILLED:
        return None
    best, least = RigFault((), (), filled), unfilled
    for mirrored, exchanged in _guesses(cameras, list(filled)):
        guess = RigFault(mirrored, exchanged, filled)
        left = 1.0 - float(np.mean(list(hulls.filled(frames, guess).values())))
        if left < least:
            best, least = guess, left
    if least < min(_LEFT, _EXPLAINED * unfilled):
        return best
    return RigFault((), (), filled) if unfilled > _CONTRADICTING else None


def _guesses(
    cameras: Mapping[str, Camera], names: Sequence[str]
) -> Iterator[tuple[tuple[str, ...], tuple[str, ...]]]:
    """Which cameras may be mirrored, or exchanged."""
    yield tuple(names), ()
    for name in names:
        yield (name,), ()
    for one, other in combinations(names, 2):
        a, b = cameras[one], cameras[other]
        if (a.width, a.height) == (b.width, b.height):
            yield (), (one, other)


class _Hulls:
    """Grids about the person, and what each camera sees of them."""

    def __init__(self, cameras: Mapping[str, Camera]) -> None:
        self._cameras = cameras
        self._views: dict[tuple[str, tuple[int, ...]], _HullView] = {}

    def filled(self, frames: Sequence[Mapping[str, Mask]], guess: RigFault) -> dict[str, float]:
        """What share of the silhouettes the hull can fill, by camera, if a guess is undone."""
        shares: dict[str, list[float]] = {}
        for frame in frames:
            masks = {name: mask for name, mask in guess.undo(frame).items() if mask.any()}
            used = [self._cameras[name] for name in masks]
            middles = [find_figures(mask)[0].middle for mask in masks.values()]
            cell = tuple(int(k) for k in np.rint(triangulate(used, middles) / _LATTICE))
            views = [self._view(name, cell) for name in masks]
            seen = [view.cells(mask) for view, mask in zip(views, masks.values(), strict=True)]
            allowed = [view.inside(cells) for view, cells in zip(views, seen, strict=True)]
            inside = np.logical_and.reduce(allowed)
            for name, view, cells in zip(masks, views, seen, strict=True):
                shares.setdefault(name, []).append(view.filled(cells, inside))
        return {name: float(np.mean(own)) for name, own in shares.items()}

    def _view(self, name: str, cell: tuple[int, ...]) -> _HullView:
        if (name, cell) not in self._views:
            side, height = (np.arange(-end, end, _SPACING) for end in (_SIDE, _HEIGHT))
            grid = np.stack(np.meshgrid(side, side, height, indexing="ij"), axis=-1)
            points = grid.reshape(-1, 3) + _LATTICE * np.array(cell, dtype=np.float64)
            self._views[name, cell] = _HullView(self._cameras[name], points)
        return self._views[name, cell]


class _HullView:
    """A camera's share in the hull of a grid's points (n, 3) [m]; a cell is a point's size."""

    def __init__(self, camera: Camera, points: Array) -> None:
        uv, depth = camera.project(points)
        self._reach = max(1.0, _SPACING * pixels_per_metre(camera, points.mean(axis=0)))
        self._shape = (
            int(np.ceil(camera.height / self._reach)),
            int(np.ceil(camera.width / self._reach)),
        )
        with np.errstate(invalid="ignore"):
            cells = np.floor((uv + 0.5) / self._reach)
            seen = (depth > 0.0) & (cells >= 0).all(axis=1)
            seen &= (cells[:, 0] < self._shape[1]) & (cells[:, 1] < self._shape[0])
        column, row = np.nan_to_num(cells).T
        self._cells = np.where(seen, row * self._shape[1] + column, -1).astype(np.int64)

    def cells(self, mask: Mask) -> Mask:
        """Which cells (h, w) a mask (H, W) touches."""
        height, width = self._shape
        size = int(np.ceil(height * self._reach)), int(np.ceil(width * self._reach))
        padded = np.zeros(size, np.float32)
        padded[: mask.shape[0], : mask.shape[1]] = mask
        small = cv2.resize(padded, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(small > 0.25)

    def inside(self, cells: Mask) -> Mask:
        """Which points (n,) cells (h, w) and those beside them allow; all that are not seen."""
        return np.asarray(np.where(self._cells < 0, True, _grown(cells).ravel()[self._cells]))

    def filled(self, cells: Mask, inside: Mask) -> float:
        """What share of the cells (h, w) the points that are inside (n,) fill."""
        found = np.zeros(cells.size, dtype=np.bool_)
        chosen = self._cells[inside]
        found[chosen[chosen >= 0]] = True
        total = int(cells.sum())
        return float((_grown(found.reshape(cells.shape)) & cells).sum()) / total if total else 1.0


def _grown(cells: Mask) -> Mask:
    return np.asarray(cv2.dilate(cells.view(np.uint8), np.ones((3, 3), np.uint8)) > 0)
