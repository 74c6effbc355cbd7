"""What masks say before anybody is fitted: figures, persons, and a rig that they contradict.

Persons are where figures of views meet. Silhouettes of a consistent rig are filled by their visual
hull (silhouette coherence, Hernandez, Schmitt and Cipolla 2007); a rig that only a mirrored or
exchanged picture mends is faulty.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np

from drake_pose.arrays import Array, Indices, Mask, Picture
from drake_pose.camera.models import Camera
from drake_pose.fit import contour_fit
from drake_pose.person.views import meeting_points, triangulate, viewing_rays

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
    sizes = {name: (cameras[name].width, cameras[name].height) for name in filled}
    pairs = [pair for pair in combinations(filled, 2) if sizes[pair[0]] == sizes[pair[1]]]
    mirrored = [tuple(filled), *((name,) for name in filled)]
    for guess in (
        *(RigFault(names, (), filled) for names in mirrored),
        *(RigFault((), pair, filled) for pair in pairs),
    ):
        left = 1.0 - float(np.mean(list(hulls.filled(frames, guess).values())))
        if left < least:
            best, least = guess, left
    if least < min(_LEFT, _EXPLAINED * unfilled):
        return best
    return RigFault((), (), filled) if unfilled > _CONTRADICTING else None


class _Raster(NamedTuple):
    """A camera's picture in cells (h, w) of so many pixels."""

    camera: Camera
    shape: tuple[int, int]
    pixels: float

    @staticmethod
    def about(camera: Camera, middle: Array) -> "_Raster":
        """The cells that are as large as the grid about a place (3,) is fine."""
        pixels = max(1.0, _SPACING * pixels_per_metre(camera, middle))
        shape = int(np.ceil(camera.height / pixels)), int(np.ceil(camera.width / pixels))
        return _Raster(camera, shape, pixels)

    def cells(self, points: Array) -> Indices:
        """In which cell (n,) each point is seen, row after row; -1: in none."""
        uv, depth = self.camera.project(points)
        with np.errstate(invalid="ignore"):
            column, row = np.floor((uv.T + 0.5) / self.pixels)
            seen = (depth > 0.0) & (column >= 0) & (column < self.shape[1])
            seen &= (row >= 0) & (row < self.shape[0])
        return np.where(seen, row * self.shape[1] + column, -1.0).astype(np.int64)

    def touched(self, mask: Mask) -> Mask:
        """Which cells (h, w) a mask (H, W) touches."""
        height, width = self.shape
        size = int(np.ceil(height * self.pixels)), int(np.ceil(width * self.pixels))
        padded = np.zeros(size, np.float32)
        padded[: mask.shape[0], : mask.shape[1]] = mask
        small = cv2.resize(padded, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(small > 0.25)


class _Hulls:
    """Visual hulls of persons, on grids about them."""

    def __init__(self, cameras: Mapping[str, Camera]) -> None:
        self._cameras = cameras
        self._first: dict[tuple[str, tuple[int, ...]], Indices] = {}

    def filled(self, frames: Sequence[Mapping[str, Mask]], guess: RigFault) -> dict[str, float]:
        """What share of the silhouettes the hull can fill, by camera, if a guess is undone."""
        shares: dict[str, list[float]] = {}
        for frame in frames:
            masks = {name: mask for name, mask in guess.undo(frame).items() if mask.any()}
            used = [self._cameras[name] for name in masks]
            middles = [find_figures(mask)[0].middle for mask in masks.values()]
            cell = tuple(int(k) for k in np.rint(triangulate(used, middles) / _LATTICE))
            points = _grid(cell)
            middle = points.mean(axis=0)
            rasters = [_Raster.about(camera, middle) for camera in used]
            touched = [one.touched(mask) for one, mask in zip(rasters, masks.values(), strict=True)]
            # What touched cells and those beside them allow, and all that is not seen. Each camera
            # looks at what the ones before it left, which soon is little.
            cells: list[Indices] = []
            for raster, own in zip(rasters, touched, strict=True):
                key = raster.camera.name, cell
                known = None if cells else self._first.get(key)
                seen = raster.cells(points) if known is None else known
                if not cells:
                    self._first[key] = seen
                inside = (seen < 0) | _grown(own).ravel()[seen]
                points, cells = points[inside], [one[inside] for one in (*cells, seen)]
            for name, chosen, own in zip(masks, cells, touched, strict=True):
                hull = np.zeros(own.size, dtype=np.bool_)
                hull[chosen[chosen >= 0]] = True
                fills = _grown(hull.reshape(own.shape)) & own
                shares.setdefault(name, []).append(fills.sum() / own.sum() if own.any() else 1.0)
        return {name: float(np.mean(own)) for name, own in shares.items()}


def _grid(cell: tuple[int, ...]) -> Array:
    """The grid's points (n, 3) about a cell of the lattice [m]."""
    side, height = (np.arange(-end, end, _SPACING) for end in (_SIDE, _HEIGHT))
    grid = np.stack(np.meshgrid(side, side, height, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(grid + _LATTICE * np.array(cell, dtype=np.float64))


def _grown(cells: Mask) -> Mask:
    return np.asarray(cv2.dilate(cells.view(np.uint8), np.ones((3, 3), np.uint8)) > 0)


# So fine [pixels of the shorter side] figures are told apart.
_RASTER = 240
# A figure of less than this share of the picture's largest is a speck, or a part of another.
_SPECK = 0.05
# Nobody is as small as this many pixels, or this share of the picture.
_LEAST_PIXELS, _LEAST_SHARE = 16.0, 2e-4
# Middles of one person's silhouettes lie no farther apart, other persons stand farther off [m].
_WITHIN = 0.35
_APART = 0.5
# What speaks for a place: a figure around it whose middle it is, one that covers it, none there.
_FITS, _COVERS, _MISSES = 1.0, 0.4, -1.0
# Another person's silhouettes are no smaller than this share of the first's.
_LEAST_AREA = 0.25
# How many of the best places are looked at more closely.
_LOOKED_AT = 8


class Figure(NamedTuple):
    """A connected part of a mask: middle (2,) [pixel], area, box (4,) left, top, right, bottom."""

    middle: Array
    area: float
    box: Array


@dataclass(frozen=True, eq=False)
class Person:
    """Somebody whom two cameras see or more.

    Args:
        place: (3,) the middle of the body [m].
        figures: by the camera's index, the index of the figure of nobody else.
        area: of the middle one of these figures, of two the smaller one [pixel^2].
    """

    place: Array
    figures: dict[int, int] = field(default_factory=dict)
    area: float = 0.0


def find_figures(mask: Mask) -> tuple[Figure, ...]:
    """The figures of a mask (H, W), the largest first; specks are left out."""
    step = _step(mask)
    small = _small(mask, step)
    left, top, width, height = cv2.boundingRect(small)
    if not width:
        return ()
    # Most of a picture is empty, and to label that takes as long.
    inner = np.ascontiguousarray(small[top : top + height, left : left + width])
    _, _, boxes, middles = cv2.connectedComponentsWithStats(inner)
    corner = np.array([left, top], dtype=np.float64)
    found = [
        Figure(
            step * (corner + middle),
            float(step * step * box[cv2.CC_STAT_AREA]),
            step * np.concatenate([corner + box[:2], corner + box[:2] + box[2:4]]),
        )
        for middle, box in zip(middles[1:], boxes[1:], strict=True)
    ]
    found.sort(key=lambda one: -one.area)
    least = max(_LEAST_PIXELS, _LEAST_SHARE * mask.size)
    return tuple(one for one in found if one.area > max(least, _SPECK * found[0].area))


def cut_figures(mask: Mask, unwanted: Sequence[Figure]) -> Mask:
    """A mask (H, W) without some of its figures."""
    if not unwanted:
        return mask
    step = _step(mask)
    count, labels, _, middles = cv2.connectedComponentsWithStats(_small(mask, step))
    middles = step * middles
    gone = np.zeros(count, dtype=np.uint8)
    for figure in unwanted:
        gone[1 + int(np.argmin(np.linalg.norm(middles[1:] - figure.middle, axis=1)))] = 1
    # What the raster left out of a figure lies within one step of it.
    small = gone[labels]
    if step > 1:
        small = cv2.dilate(small, np.ones((3, 3), np.uint8))
    height, width = mask.shape
    large = np.repeat(np.repeat(small, step, axis=0), step, axis=1)[:height, :width]
    return np.asarray(mask & (large == 0))


def find_persons(
    cameras: Sequence[Camera], figures: Sequence[Sequence[Figure]]
) -> tuple[Person, ...]:
    """The persons whom two cameras or more see by masks' figures, the best supported first."""
    if all(len(own) <= 1 for own in figures):
        seers = [k for k, own in enumerate(figures) if own]
        if len(seers) < 2:
            return ()
        place = _place(cameras, figures, dict.fromkeys(seers, 0))
        offs = [metres_off(cameras[k], figures[k][0].middle, place[None])[0] for k in seers]
        if max(offs) < _WITHIN:
            return (_person(place, dict.fromkeys(seers, 0), figures),)
    free = [set(range(len(own))) for own in figures]
    persons: list[Person] = []
    while True:
        best = _best_person(cameras, figures, free)
        if best is None or (persons and not _is_other(best, persons)):
            return tuple(persons)
        persons.append(best)
        for camera, index in best.figures.items():
            free[camera].discard(index)


def _place(
    cameras: Sequence[Camera], figures: Sequence[Sequence[Figure]], taken: Mapping[int, int]
) -> Array:
    """(3,) where the figures that are taken, by the camera's index, have their middle [m]."""
    middles = [figures[k][i].middle for k, i in taken.items()]
    return triangulate([cameras[k] for k in taken], middles)


def _person(place: Array, taken: dict[int, int], figures: Sequence[Sequence[Figure]]) -> Person:
    areas = sorted(figures[k][i].area for k, i in taken.items())
    return Person(place, taken, areas[(len(areas) - 1) // 2])


def _best_person(
    cameras: Sequence[Camera], figures: Sequence[Sequence[Figure]], free: Sequence[set[int]]
) -> Person | None:
    """The best supported place of which two cameras have a figure that is still free."""
    middles = [np.array([figure.middle for figure in own]).reshape(-1, 2) for own in figures]
    is_free = [
        np.isin(np.arange(len(own)), list(left)) for own, left in zip(figures, free, strict=True)
    ]
    places = meeting_points(cameras, middles, 2.0 * _WITHIN, is_free)
    if not len(places):
        return None
    scores, nearest = _support(cameras, figures, free, places)
    best: tuple[float, float, Person] | None = None
    # Places of the same figures are one person's.
    looked_at = np.argsort(-scores)[:_LOOKED_AT]
    for own in dict.fromkeys(map(tuple, nearest[looked_at].tolist())):
        taken = {k: i for k, i in enumerate(own) if i >= 0}
        if len(taken) < 2:
            continue
        place = _place(cameras, figures, taken)
        score, again = _support(cameras, figures, free, place[None])
        taken = {k: i for k, i in enumerate(again[0].tolist()) if i >= 0}
        if len(taken) < 2:
            continue
        person = _person(_place(cameras, figures, taken), taken, figures)
        if best is None or (float(score[0]), person.area) > best[:2]:
            best = float(score[0]), person.area, person
    return None if best is None else best[2]


def _support(
    cameras: Sequence[Camera],
    figures: Sequence[Sequence[Figure]],
    free: Sequence[set[int]],
    places: Array,
) -> tuple[Array, Indices]:
    """What speaks (n,) for somebody at places (n, 3), and by camera (n, m) the figure, or -1."""
    scores = np.zeros(len(places))
    taken = np.full((len(places), len(cameras)), -1)
    for k, (camera, own) in enumerate(zip(cameras, figures, strict=True)):
        uv, depth = camera.project(places)
        with np.errstate(invalid="ignore"):
            seen = (depth > 0.0) & (uv >= 0.0).all(axis=1)
            seen &= (uv < [camera.width, camera.height]).all(axis=1)
        if not own:
            scores += _MISSES * seen
            continue
        offs = np.array([metres_off(camera, figure.middle, places) for figure in own])
        offs[[i for i in range(len(own)) if i not in free[k]]] = np.inf
        nearest = offs.argmin(axis=0)
        off = offs.min(axis=0)
        boxes = np.array([figure.box for figure in own])
        with np.errstate(invalid="ignore"):
            within = (uv[:, None] >= boxes[:, :2]) & (uv[:, None] <= boxes[:, 2:])
        covered = np.any(np.all(within, axis=2), axis=1)
        fits = seen & (off < _WITHIN)
        taken[:, k] = np.where(fits, nearest, -1)
        points = np.where(covered, _COVERS, _MISSES)
        points[fits] = _FITS - 0.5 * off[fits] / _WITHIN
        scores += points * seen
    return scores, taken


def _is_other(person: Person, persons: Sequence[Person]) -> bool:
    """Whether somebody stands apart from all others, and is no part of them."""
    if person.area < _LEAST_AREA * max(one.area for one in persons):
        return False
    return all(np.linalg.norm((person.place - one.place)[:2]) > _APART for one in persons)


def pixels_per_metre(camera: Camera, place: Array) -> float:
    """How large a metre is in a picture at a place (3,), however far to the side [pixel/m]."""
    return float(contour_fit.pixels_per_metre(contour_fit.pack_cameras([camera]), place)[0])


def metres_off(camera: Camera, uv: Array, places: Array) -> Array:
    """How far (n,) the ray of a pixel (2,) passes by places (n, 3) [m]."""
    origin, direction = viewing_rays(camera, uv[None])
    across = places - origin
    along = across @ direction[0]
    return np.asarray(np.linalg.norm(across - along[:, None] * direction, axis=1))


def _step(mask: Mask) -> int:
    return max(1, min(mask.shape) // _RASTER)


def _small(mask: Mask, step: int) -> Picture:
    return np.ascontiguousarray(mask[::step, ::step]).view(np.uint8)
