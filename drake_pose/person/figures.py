"""Figures of masks, the persons whom they show, and which of these is followed.

Persons are where figures of several views meet. The figures of others are cut out of the masks.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from drake_pose.arrays import Array, Indices, Mask, Picture
from drake_pose.camera.models import Camera
from drake_pose.fit import contour_fit
from drake_pose.person.views import (
    FrameViews,
    edge_spacing,
    meeting_points,
    see_silhouette,
    triangulate,
    viewing_rays,
)

ReadFrame = Callable[[int], Mapping[str, Mask]]
"""Gives the masks (H, W) of a frame, counted from 0, by camera; one may be missing."""

# Middles of one person's silhouettes lie no farther apart [m].
_WITHIN = 0.35


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
        figures: by the camera's index, the index of the figure that is this person's alone.
        area: of the middle one of these figures, of two the smaller one [pixel^2].
    """

    place: Array
    figures: dict[int, int] = field(default_factory=dict)
    area: float = 0.0


def find_figures(
    mask: Mask,
    *,
    speck: float = 0.05,
    least_pixels: float = 16.0,
    least_fraction: float = 2e-4,
) -> tuple[Figure, ...]:
    """The figures of a mask (H, W), the largest first; specks are left out.

    Args:
        speck: a figure of less than this fraction of the largest is a speck, or a part of another.
        least_pixels, least_fraction: a person is larger than this many pixels, and than this
            fraction of the picture.
    """
    small, step = _coarse(mask)
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
    least = max(least_pixels, least_fraction * mask.size)
    return tuple(one for one in found if one.area > max(least, speck * found[0].area))


def cut_figures(mask: Mask, unwanted: Sequence[Figure]) -> Mask:
    """A mask (H, W) without some of its figures."""
    if not unwanted:
        return mask
    small, step = _coarse(mask)
    count, labels, _, middles = cv2.connectedComponentsWithStats(small)
    middles = step * middles
    gone = np.zeros(count, dtype=np.uint8)
    for figure in unwanted:
        gone[1 + int(np.argmin(np.linalg.norm(middles[1:] - figure.middle, axis=1)))] = 1
    # What the raster left out of a figure lies within one step of it.
    cut = gone[labels] if step == 1 else cv2.dilate(gone[labels], np.ones((3, 3), np.uint8))
    height, width = mask.shape
    large = np.repeat(np.repeat(cut, step, axis=0), step, axis=1)[:height, :width]
    return np.asarray(mask & (large == 0))


def _coarse(mask: Mask) -> tuple[Picture, int]:
    """Every step-th pixel of a mask, 240 of its shorter side, and the step."""
    step = max(1, min(mask.shape) // 240)
    return np.ascontiguousarray(mask[::step, ::step]).view(np.uint8), step


def find_persons(
    cameras: Sequence[Camera], figures: Sequence[Sequence[Figure]], looked_at: int = 8
) -> tuple[Person, ...]:
    """The persons whom two cameras or more see by masks' figures, the best supported first."""
    if all(len(own) <= 1 for own in figures):
        taken = {k: 0 for k, own in enumerate(figures) if own}
        if len(taken) < 2:
            return ()
        person = _person(cameras, figures, taken)
        place = person.place[None]
        if max(metres_off(cameras[k], figures[k][0].middle, place)[0] for k in taken) < _WITHIN:
            return (person,)
    free = [set(range(len(own))) for own in figures]
    middles = [np.array([figure.middle for figure in own]).reshape(-1, 2) for own in figures]
    persons: list[Person] = []
    while True:
        is_free = [
            np.isin(np.arange(len(own)), list(left))
            for own, left in zip(figures, free, strict=True)
        ]
        places = meeting_points(cameras, middles, 2.0 * _WITHIN, is_free)
        best: tuple[float, float, Person] | None = None
        scores, nearest = _support(cameras, figures, free, places)
        # The best places are looked at more closely; those of the same figures are one person's.
        for own in dict.fromkeys(map(tuple, nearest[np.argsort(-scores)[:looked_at]].tolist())):
            taken = {k: i for k, i in enumerate(own) if i >= 0}
            if len(taken) < 2:
                continue
            place = _person(cameras, figures, taken).place
            score, again = _support(cameras, figures, free, place[None])
            taken = {k: i for k, i in enumerate(again[0].tolist()) if i >= 0}
            if len(taken) < 2:
                continue
            person = _person(cameras, figures, taken)
            if best is None or (float(score[0]), person.area) > best[:2]:
                best = float(score[0]), person.area, person
        if best is None or (persons and not is_another(best[2], persons)):
            return tuple(persons)
        persons.append(best[2])
        for camera, index in best[2].figures.items():
            free[camera].discard(index)


def _person(
    cameras: Sequence[Camera], figures: Sequence[Sequence[Figure]], taken: dict[int, int]
) -> Person:
    """Who has the figures that are taken, by the camera's index."""
    chosen = [figures[k][i] for k, i in taken.items()]
    areas = sorted(figure.area for figure in chosen)
    place = triangulate([cameras[k] for k in taken], [figure.middle for figure in chosen])
    return Person(place, taken, areas[(len(areas) - 1) // 2])


def _support(
    cameras: Sequence[Camera],
    figures: Sequence[Sequence[Figure]],
    free: Sequence[set[int]],
    places: Array,
    *,
    covers: float = 0.4,
    misses: float = -1.0,
) -> tuple[Array, Indices]:
    """What speaks (n,) for somebody at places (n, 3), and by camera (n, m) the figure, or -1.

    Args:
        covers, misses: a figure whose middle the place is counts up to 1; one that only covers it,
            or none at all, counts as much.
    """
    scores = np.zeros(len(places))
    taken = np.full((len(places), len(cameras)), -1)
    for k, (camera, own) in enumerate(zip(cameras, figures, strict=True)):
        uv, depth = camera.project(places)
        with np.errstate(invalid="ignore"):
            seen = (depth > 0.0) & (uv >= 0.0).all(axis=1)
            seen &= (uv < [camera.width, camera.height]).all(axis=1)
        if not own:
            scores += misses * seen
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
        points = np.where(covered, covers, misses)
        points[fits] = 1.0 - 0.5 * off[fits] / _WITHIN
        scores += points * seen
    return scores, taken


def is_another(
    person: Person, persons: Sequence[Person], least_area: float = 0.25, apart: float = 0.5
) -> bool:
    """Whether somebody stands apart from all others [m], and is no part of them.

    Another person's silhouettes are no smaller than the fraction `least_area` of the largest.
    """
    if person.area < least_area * max(one.area for one in persons):
        return False
    return all(np.linalg.norm((person.place - one.place)[:2]) > apart for one in persons)


def pixels_per_metre(camera: Camera, place: Array) -> float:
    """How large a metre is in a picture at a place (3,), however far to the side [pixel/m]."""
    return float(contour_fit.pixels_per_metre(contour_fit.pack_cameras([camera]), place)[0])


def metres_off(camera: Camera, uv: Array, places: Array) -> Array:
    """How far (n,) the ray of a pixel (2,) passes by places (n, 3) [m]."""
    origin, direction = viewing_rays(camera, uv[None])
    across = places - origin
    along = across @ direction[0]
    return np.asarray(np.linalg.norm(across - along[:, None] * direction, axis=1))


def middle_of_view(cameras: Sequence[Camera]) -> Array:
    """(3,) the point nearest to where all cameras look [m]."""
    middles = [np.array([0.5 * (c.width - 1), 0.5 * (c.height - 1)]) for c in cameras]
    return triangulate(cameras, middles)


def sort_figures(
    cameras: Mapping[str, Camera],
    figures: Mapping[str, Sequence[Figure]],
    persons: Sequence[Person],
    person: Person | None,
    *,
    far: float = 0.7,
    large: float = 0.25,
) -> dict[str, tuple[tuple[Figure, ...], bool]]:
    """By camera the figures of others, and whether the person and another are one figure.

    Args:
        figures: of each mask, in the order of the persons' camera indices.
        person: who is followed; None: he is away.
        far, large: a figure of no known person is a stranger's if it is farther off [m], and
            larger than this fraction of the followed person's figure.
    """

    def covers(camera: Camera, figure: Figure, one: Person) -> bool:
        uv, depth = camera.project(one.place[None])
        left, top, right, bottom = figure.box
        return bool(depth[0] > 0.0 and left <= uv[0, 0] <= right and top <= uv[0, 1] <= bottom)

    others = [one for one in persons if one is not person]
    places = np.array([one.place for one in others]).reshape(-1, 3)
    found = {}
    for k, (name, own) in enumerate(figures.items()):
        if person is None:
            found[name] = tuple(own), False
            continue
        camera, merged = cameras[name], False
        taken = {one.figures[k] for one in others if k in one.figures}
        away: list[Figure] = []
        for i, figure in enumerate(own):
            off = metres_off(camera, figure.middle, person.place[None])[0]
            if person.figures.get(k) == i:
                hidden = [one for one in others if k not in one.figures]
                merged |= any(covers(camera, figure, one) for one in hidden)
            elif i in taken and k not in person.figures and covers(camera, figure, person):
                merged = True
            elif (
                i in taken
                or metres_off(camera, figure.middle, places).min(initial=np.inf) < off
                or (
                    k in person.figures
                    and off >= far
                    and figure.area > large * own[person.figures[k]].area
                )
            ):
                away.append(figure)
        found[name] = tuple(away), merged
    return found


def keep_person(
    cameras: Mapping[str, Camera], masks: Mapping[str, Mask], place: Array | None = None
) -> tuple[dict[str, Mask], Person | None, tuple[str, ...], tuple[str, ...]]:
    """A frame's masks of one person only, who was at a place (3,) [m] in the last frame.

    None: the one whose figures are the largest, of two alike nearer to where the cameras look.

    Returns:
        The masks without other persons, by camera; the person, None where fewer than two cameras
        see anybody; the cameras whose masks had others in them, who were cut out; and those in
        which the person and another are one figure, which is left whole.
    """
    used = {name: cameras[name] for name in masks}
    figures = {name: find_figures(mask) for name, mask in masks.items()}
    persons = find_persons(list(used.values()), list(figures.values()))
    if not persons:
        return dict(masks), None, (), ()
    if place is None:
        middle = middle_of_view(list(used.values()))
        person = max(persons, key=lambda one: _standing(one, middle))
    else:
        person = min(persons, key=lambda one: float(np.linalg.norm(one.place - place)))
    found = sort_figures(cameras, figures, persons, person)
    return (
        {name: cut_figures(mask, found[name][0]) for name, mask in masks.items()},
        person,
        tuple(name for name, (unwanted, _) in found.items() if unwanted),
        tuple(name for name, (_, is_merged) in found.items() if is_merged),
    )


def keep_views(
    frame: FrameViews, place: Array | None = None
) -> tuple[FrameViews, tuple[str, ...], tuple[str, ...]]:
    """What cameras see of one person only, and the cameras cut and merged, as of keep_person."""
    cameras = {camera.name: camera for camera in frame.cameras}
    regions = {one.name: view.region for one, view in frame.pairs}
    masks, _, cut, merged = keep_person(cameras, regions, place)
    alone = [
        see_silhouette(masks[one.name], edge_spacing(one)) if one.name in cut else view
        for one, view in frame.pairs
    ]
    return FrameViews(frame.cameras, alone), cut, merged


def follow_one(
    frames: Sequence[Sequence[Person]], middle: Array, is_sequence: bool
) -> list[Person | None]:
    """Who is followed in each frame: the one who is seen longest and largest.

    Args:
        frames: the persons in each frame.
        middle: (3,) of the cameras' view [m].
        is_sequence: whether the frames follow each other; else the largest is taken in each.

    Returns:
        Where he is hidden for a while, somebody without figures in between; None where he is away.
    """
    if not is_sequence:
        return [max(own, key=lambda one: _standing(one, middle), default=None) for own in frames]
    tracks = find_tracks(frames)
    if not tracks:
        return [None] * len(frames)
    main = max(tracks, key=lambda track: sum(_standing(one, middle)[0] for one in track.values()))
    # Who is there only while he is not is himself, come back.
    for track in sorted(tracks, key=len, reverse=True):
        if not set(range(min(track), max(track) + 1)) & set(main):
            main = main | track
    known = sorted(main)
    places = np.array([main[k].place for k in known])
    found: list[Person | None] = [None] * len(frames)
    for k in range(known[0], known[-1] + 1):
        way = np.array([np.interp(k, known, places[:, axis]) for axis in range(3)])
        found[k] = main.get(k, Person(way))
    return found


def find_tracks(
    frames: Sequence[Sequence[Person]], step: float = 0.4, more: float = 0.1
) -> list[dict[int, Person]]:
    """Who is who from frame to frame: the nearest go together.

    A person's middle moves by no more than `step` from one frame to the next, and by `more` in each
    frame in which he is hidden [m].
    """
    tracks: list[dict[int, Person]] = []
    for k, persons in enumerate(frames):
        pairs = []
        for t, track in enumerate(tracks):
            last = max(track)
            for p, person in enumerate(persons):
                distance = float(np.linalg.norm(person.place - track[last].place))
                if distance < step + more * (k - last - 1):
                    pairs.append((distance, t, p))
        free_tracks, free = set(range(len(tracks))), set(range(len(persons)))
        for _, t, p in sorted(pairs):
            if t in free_tracks and p in free:
                tracks[t][k] = persons[p]
                free_tracks.discard(t)
                free.discard(p)
        tracks += [{k: persons[p]} for p in sorted(free)]
    return tracks


def _standing(person: Person, middle: Array) -> tuple[float, float]:
    """What one is chosen by: first how large one is seen, then how near to the middle."""
    return person.area, -float(np.linalg.norm(person.place - middle))


@dataclass(frozen=True, eq=False)
class ViewFaults:
    """What was in view or was not; frames are counted from 0.

    Args:
        nobody: the frames in which fewer than two cameras see the person.
        blind: by camera, the frames in which it sees no person, but two others do.
        others: by camera, the frames in which it sees others, too.
        merged: by camera, those of them in which person and others are one figure.
    """

    nobody: tuple[int, ...] = ()
    blind: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    others: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    merged: Mapping[str, tuple[int, ...]] = field(default_factory=dict)


class PersonRecording:
    """The masks of one person, without those of cameras that do not see it or are left out.

    Attributes:
        height: of what is seen, by the calibration [m]; nan where no two cameras see a person.
        covering: in what fraction of the masks the largest figure reaches all four sides, as
            backgrounds do.

    Args:
        read: gives the masks of a frame; all `count` are read once.
        is_sequence: whether they follow each other.
        measured: in this many frames, or somewhat more, the person is measured.
    """

    def __init__(
        self,
        cameras: Mapping[str, Camera],
        read: ReadFrame,
        count: int,
        is_sequence: bool,
        measured: int = 20,
    ) -> None:
        self._read, self._count = read, count
        self._left_out: dict[str, int] = {}
        figures: list[dict[str, tuple[Figure, ...]]] = []
        persons, heights, covering = [], [], []
        for frame in range(count):
            own = {name: find_figures(mask) for name, mask in read(frame).items()}
            figures.append(own)
            persons.append(find_persons([cameras[name] for name in own], list(own.values())))
            seen = {name: found[0] for name, found in own.items() if found}
            for name, figure in seen.items():
                width, height = figure.box[2:] - figure.box[:2]
                covering.append(
                    width > 0.98 * cameras[name].width and height > 0.98 * cameras[name].height
                )
            if frame % max(1, count // measured) == 0 and len(seen) >= 2:
                used = [cameras[name] for name in seen]
                place = triangulate(used, [figure.middle for figure in seen.values()])
                for camera, figure in zip(used, seen.values(), strict=True):
                    height = float(figure.box[3] - figure.box[1])
                    heights.append(height / pixels_per_metre(camera, place))
        self.height = float(np.median(heights)) if heights else float("nan")
        self.covering = float(np.mean(covering)) if covering else 0.0
        middle = middle_of_view(list(cameras.values()))
        followed = follow_one(persons, middle, is_sequence)
        # By frame and camera: the figures of others, and whether the person is one with them.
        self._others = [
            sort_figures(cameras, own, found, person) if found else dict.fromkeys(own, ((), False))
            for own, found, person in zip(figures, persons, followed, strict=True)
        ]
        self._seeing = [
            {name for name, found in own.items() if len(found) > len(others[name][0])}
            for own, others in zip(figures, self._others, strict=True)
        ]

    @property
    def seen(self) -> list[int]:
        """The frames in which two cameras see the person that are not left out."""
        return [k for k in range(self._count) if len(self.cameras_at(k)) >= 2]

    def cameras_at(self, frame: int) -> set[str]:
        """The cameras that see the person and are not left out."""
        return {
            name for name in self._seeing[frame] if frame < self._left_out.get(name, self._count)
        }

    def leave_out(self, name: str, first: int) -> None:
        """Leaves a camera out from a frame on."""
        self._left_out[name] = first

    def read(self, frame: int, with_all: bool = False) -> dict[str, Mask]:
        """The masks of a frame by camera, those of cameras that were left out if wanted."""
        wanted = self._seeing[frame] if with_all else self.cameras_at(frame)
        return {
            name: cut_figures(mask, self._others[frame][name][0])
            for name, mask in self._read(frame).items()
            if name in wanted
        }

    def faults(self) -> ViewFaults:
        """What was in view or was not."""
        seen = set(self.seen)
        found: list[dict[str, list[int]]] = [{}, {}, {}]
        for frame, own in enumerate(self._others):
            for name, (strangers, is_merged) in own.items():
                is_blind = name not in self._seeing[frame] and frame in seen
                for told, kind in zip(
                    (is_blind, bool(strangers) or is_merged, is_merged), found, strict=True
                ):
                    if told:
                        kind.setdefault(name, []).append(frame)
        nobody = sorted(set(range(self._count)) - seen)
        return ViewFaults(tuple(nobody), *({k: tuple(v) for k, v in one.items()} for one in found))
