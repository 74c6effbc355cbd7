"""Connected components ("figures") of masks, the persons that they show, and which one to follow.

A person is where figures of several views meet in space. Figures of other persons are cut out.
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
"""Returns the masks (H, W) of a frame by camera; frames count from 0. A camera may lack a mask."""

# Largest distance of a person's middle from the rays of the person's figures [m].
_MAX_RAY_DISTANCE = 0.35


class Figure(NamedTuple):
    """A connected component of a mask."""

    middle: Array  # (2,) centroid [pixel].
    area: float  # [pixel^2].
    box: Array  # (4,) left, top, right, bottom [pixel].


@dataclass(frozen=True, eq=False)
class Person:
    """A person seen by two or more cameras."""

    position: Array  # (3,) middle of the body [m].
    # Index of the person's figure, by index of the camera.
    figures: dict[int, int] = field(default_factory=dict)
    area: float = 0.0  # Median area of these figures, of an even number the lower one [pixel^2].


def find_figures(
    mask: Mask, *, speck: float = 0.05, least_fraction: float = 2e-4
) -> tuple[Figure, ...]:
    """Return the figures of a mask (H, W), the largest first, without specks.

    ``speck``: figures below this fraction of the largest one's area are specks. ``least_fraction``:
    a figure's area must exceed this fraction of the picture's area.
    """
    small, step = _coarse(mask)
    left, top, width, height = cv2.boundingRect(small)
    if not width:
        return ()
    # Most of a picture is empty, and labelling takes as long there.
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
    least = max(least_fraction * mask.size, speck * found[0].area)
    return tuple(one for one in found if one.area > least)


def cut_figures(mask: Mask, unwanted: Sequence[Figure]) -> Mask:
    """Return a mask (H, W) without the unwanted ones of its figures, as of `find_figures`."""
    if not unwanted:
        return mask
    small, step = _coarse(mask)
    count, labels, _, middles = cv2.connectedComponentsWithStats(small)
    middles = step * middles
    gone = np.zeros(count, dtype=np.uint8)
    for figure in unwanted:
        gone[1 + int(np.argmin(np.linalg.norm(middles[1:] - figure.middle, axis=1)))] = 1
    # Pixels of a figure that the subsampling skipped lie within one step.
    cut = gone[labels] if step == 1 else cv2.dilate(gone[labels], np.ones((3, 3), np.uint8))
    height, width = mask.shape
    large = np.repeat(np.repeat(cut, step, axis=0), step, axis=1)[:height, :width]
    return np.asarray(mask & (large == 0))


def _coarse(mask: Mask) -> tuple[Picture, int]:
    """Return every step-th pixel of a mask (H, W) as bytes 0 and 1, and the step.

    240 to 479 pixels remain on the shorter side; smaller masks stay whole.
    """
    step = max(1, min(mask.shape) // 240)
    return np.ascontiguousarray(mask[::step, ::step]).view(np.uint8), step


def find_persons(
    cameras: Sequence[Camera], figures: Sequence[Sequence[Figure]]
) -> tuple[Person, ...]:
    """Return the persons that two or more cameras see, the best supported first; () if none.

    ``figures``: of each camera's mask, in the order of `cameras`.
    """
    if all(len(own) <= 1 for own in figures):
        taken = {k: 0 for k, own in enumerate(figures) if own}
        if len(taken) < 2:
            return ()
        person = _person(cameras, figures, taken)
        position = person.position[None]
        distances = [ray_distances(cameras[k], figures[k][0].middle, position)[0] for k in taken]
        if max(distances) < _MAX_RAY_DISTANCE:
            return (person,)
    free = [set(range(len(own))) for own in figures]
    middles = [np.array([figure.middle for figure in own]).reshape(-1, 2) for own in figures]
    persons: list[Person] = []
    while True:
        pairs = zip(figures, free, strict=True)
        is_candidate = [np.isin(np.arange(len(own)), list(rest)) for own, rest in pairs]
        positions = meeting_points(cameras, middles, 2.0 * _MAX_RAY_DISTANCE, is_candidate)
        best: tuple[float, float, Person] | None = None
        scores, nearest = _support(cameras, figures, free, positions)
        # The best few are examined. Places with the same nearest figures belong to one person.
        for chosen in dict.fromkeys(map(tuple, nearest[np.argsort(-scores)[:8]].tolist())):
            taken = {k: i for k, i in enumerate(chosen) if i >= 0}
            if len(taken) < 2:
                continue
            position = _person(cameras, figures, taken).position
            score, confirmed = _support(cameras, figures, free, position[None])
            taken = {k: i for k, i in enumerate(confirmed[0].tolist()) if i >= 0}
            if len(taken) < 2:
                continue
            person = _person(cameras, figures, taken)
            if best is None or (float(score[0]), person.area) > best[:2]:
                best = float(score[0]), person.area, person
        if best is None or (persons and not is_separate(best[2], persons)):
            return tuple(persons)
        persons.append(best[2])
        for camera, index in best[2].figures.items():
            free[camera].discard(index)


def _person(
    cameras: Sequence[Camera], figures: Sequence[Sequence[Figure]], taken: dict[int, int]
) -> Person:
    """Return the person seen as some of the `figures`: `taken` has their indices by camera."""
    chosen = [figures[k][i] for k, i in taken.items()]
    areas = sorted(figure.area for figure in chosen)
    position = triangulate([cameras[k] for k in taken], [figure.middle for figure in chosen])
    return Person(position, taken, areas[(len(areas) - 1) // 2])


def _support(
    cameras: Sequence[Camera],
    figures: Sequence[Sequence[Figure]],
    free: Sequence[set[int]],
    positions: Array,
    *,
    covers: float = 0.4,
) -> tuple[Array, Indices]:
    """Score positions (n, 3) by the figures that support a person there.

    A free figure adds 0.5 to 1 if its ray passes within 0.35 m.

    ``figures``: of each camera's mask. ``free``: indices of the figures of each camera that belong
    to no person yet. ``covers``: score of a figure whose box only covers the position. A camera
    that sees the position, but no figure there, subtracts 1.

    Returns (n,) sums of the scores over the cameras whose picture contains the position; (n,
    cameras) index of the nearest free figure, -1 where no ray passes within 0.35 m.
    """
    scores = np.zeros(len(positions))
    taken = np.full((len(positions), len(cameras)), -1)
    for k, (camera, own) in enumerate(zip(cameras, figures, strict=True)):
        uv, depth = camera.project(positions)
        with np.errstate(invalid="ignore"):
            is_visible = (depth > 0.0) & (uv >= 0.0).all(axis=1)
            is_visible &= (uv < [camera.width, camera.height]).all(axis=1)
        if not own:
            scores -= is_visible
            continue
        distances = np.array([ray_distances(camera, figure.middle, positions) for figure in own])
        distances[[i for i in range(len(own)) if i not in free[k]]] = np.inf
        nearest = distances.argmin(axis=0)
        distance = distances.min(axis=0)
        boxes = np.array([figure.box for figure in own])
        with np.errstate(invalid="ignore"):
            within = (uv[:, None] >= boxes[:, :2]) & (uv[:, None] <= boxes[:, 2:])
        covered = np.any(np.all(within, axis=2), axis=1)
        fits = is_visible & (distance < _MAX_RAY_DISTANCE)
        taken[:, k] = np.where(fits, nearest, -1)
        points = np.where(covered, covers, -1.0)
        points[fits] = 1.0 - 0.5 * distance[fits] / _MAX_RAY_DISTANCE
        scores += points * is_visible
    return scores, taken


def is_separate(
    person: Person, persons: Sequence[Person], least_area: float = 0.25, apart: float = 0.5
) -> bool:
    """Return whether a person is large enough, and far enough from others, to be one of its own.

    ``persons``: one or more others that were found already. ``least_area``: least `area` of the
    person, as a fraction of the others' largest. ``apart``: least horizontal distance from all
    others [m].
    """
    if person.area < least_area * max(one.area for one in persons):
        return False
    return all(np.linalg.norm((person.position - one.position)[:2]) > apart for one in persons)


def pixels_per_metre(camera: Camera, position: Array) -> float:
    """Return the size of a metre at the depth of a position (3,) in a picture [pixel/m]."""
    return float(contour_fit.pixels_per_metre(contour_fit.pack_cameras([camera]), position)[0])


def ray_distances(camera: Camera, uv: Array, positions: Array) -> Array:
    """Return the distances (n,) of positions (n, 3) from the ray of a pixel (2,) [m]."""
    origin, direction = viewing_rays(camera, uv[None])
    across = positions - origin
    along = across @ direction[0]
    return np.asarray(np.linalg.norm(across - along[:, None] * direction, axis=1))


def middle_of_view(cameras: Sequence[Camera]) -> Array:
    """Return the point (3,) nearest to the rays of all pictures' middles [m]."""
    middles = [np.array([0.5 * (c.width - 1), 0.5 * (c.height - 1)]) for c in cameras]
    return triangulate(cameras, middles)


def sort_figures(
    cameras: Mapping[str, Camera],
    figures: Mapping[str, Sequence[Figure]],
    persons: Sequence[Person],
    person: Person | None,
    large: float = 0.25,
) -> dict[str, tuple[tuple[Figure, ...], bool]]:
    """Find the figures of other persons, and where they merge with the followed person.

    A figure is another's if it belongs to another person, if its ray passes nearer to another
    person's middle, or if it is a stranger's.

    Args:
        cameras: by name.
        figures: of each mask by camera, in the order of the persons' camera indices.
        persons: all persons found in the frame.
        person: the followed one, without figures where hidden; None: absent.
        large: a figure is a stranger's if its ray is too far from the followed person for any part
            of a body, and it is larger than this fraction of the followed person's figure.

    Returns:
        By camera: the figures of others, all figures where the person is absent; and whether the
        person and another are one figure.
    """

    def covers(camera: Camera, figure: Figure, one: Person) -> bool:
        """Return whether a person's middle appears in the box of a figure."""
        uv, depth = camera.project(one.position[None])
        left, top, right, bottom = figure.box
        return bool(depth[0] > 0.0 and left <= uv[0, 0] <= right and top <= uv[0, 1] <= bottom)

    others = [one for one in persons if one is not person]
    positions = np.array([one.position for one in others]).reshape(-1, 3)
    found = {}
    for k, (name, own) in enumerate(figures.items()):
        if person is None:
            found[name] = tuple(own), False
            continue
        camera, merged = cameras[name], False
        taken = {one.figures[k] for one in others if k in one.figures}
        away: list[Figure] = []
        for i, figure in enumerate(own):
            off = ray_distances(camera, figure.middle, person.position[None])[0]
            if person.figures.get(k) == i:
                hidden = [one for one in others if k not in one.figures]
                merged |= any(covers(camera, figure, one) for one in hidden)
            elif i in taken and k not in person.figures and covers(camera, figure, person):
                merged = True
            elif (
                i in taken
                or ray_distances(camera, figure.middle, positions).min(initial=np.inf) < off
                or (
                    k in person.figures
                    and off >= 2.0 * _MAX_RAY_DISTANCE
                    and figure.area > large * own[person.figures[k]].area
                )
            ):
                away.append(figure)
        found[name] = tuple(away), merged
    return found


def keep_person(
    cameras: Mapping[str, Camera], masks: Mapping[str, Mask], position: Array | None = None
) -> tuple[dict[str, Mask], Person | None, tuple[str, ...], tuple[str, ...]]:
    """Keep one person in the masks of a frame, and cut out all others.

    ``cameras``, ``masks``: cameras, and masks (H, W) of those that have one, by name. ``position``:
    (3,) where the person was in the last frame [m]. None: the person with the largest figures is
    kept, of equal ones the nearer one to the middle of the cameras' view.

    Returns the masks without other persons, by camera; the person, None where fewer than two
    cameras see anybody, and masks stay as they are; the cameras whose masks others were cut out of;
    and the cameras in which the person and another are one figure, which is left whole.
    """
    used = {name: cameras[name] for name in masks}
    figures = {name: find_figures(mask) for name, mask in masks.items()}
    persons = find_persons(list(used.values()), list(figures.values()))
    if not persons:
        return dict(masks), None, (), ()
    if position is None:
        middle = middle_of_view(list(used.values()))
        person = max(persons, key=lambda one: _prominence(one, middle))
    else:
        person = min(persons, key=lambda one: float(np.linalg.norm(one.position - position)))
    found = sort_figures(cameras, figures, persons, person)
    return (
        {name: cut_figures(mask, found[name][0]) for name, mask in masks.items()},
        person,
        tuple(name for name, (unwanted, _) in found.items() if unwanted),
        tuple(name for name, (_, is_merged) in found.items() if is_merged),
    )


def keep_views(
    frame: FrameViews, position: Array | None = None
) -> tuple[FrameViews, tuple[str, ...], tuple[str, ...]]:
    """Keep one person in a frame's views, as `keep_person` does in masks.

    `position` is where the person was in the last frame (3,) [m]; None: the largest is kept.

    Returns the views; the names of the cameras whose regions others were cut out of; and of those
    in which the person and another are one figure.
    """
    cameras = {camera.name: camera for camera in frame.cameras}
    regions = {one.name: view.region for one, view in frame.pairs}
    masks, _, cut, merged = keep_person(cameras, regions, position)
    alone = [
        see_silhouette(masks[one.name], edge_spacing(one)) if one.name in cut else view
        for one, view in frame.pairs
    ]
    return FrameViews(frame.cameras, alone), cut, merged


def follow_one(
    frames: Sequence[Sequence[Person]], middle: Array, is_sequence: bool
) -> list[Person | None]:
    """Choose the person to follow: the one seen longest and largest.

    ``frames``: persons found in each frame. ``middle``: (3,) middle of the cameras' view [m]; of
    equally large persons the nearer is chosen. ``is_sequence``: whether the frames follow each
    other; if not, the largest in each is chosen.

    Returns the person in each frame: without figures where hidden for a while, None where absent.
    """
    if not is_sequence:
        return [max(own, key=lambda one: _prominence(one, middle), default=None) for own in frames]
    tracks = find_tracks(frames)
    if not tracks:
        return [None] * len(frames)
    main = max(tracks, key=lambda track: sum(_prominence(one, middle)[0] for one in track.values()))
    # A person who is present only while the main one is absent is taken for the same person.
    for track in sorted(tracks, key=len, reverse=True):
        if not set(range(min(track), max(track) + 1)) & set(main):
            main = main | track
    known = sorted(main)
    positions = np.array([main[k].position for k in known])
    found: list[Person | None] = [None] * len(frames)
    for k in range(known[0], known[-1] + 1):
        position = np.array([np.interp(k, known, positions[:, axis]) for axis in range(3)])
        found[k] = main.get(k, Person(position))
    return found


def find_tracks(frames: Sequence[Sequence[Person]], step: float = 0.4) -> list[dict[int, Person]]:
    """Link persons from frame to frame, nearest ones first.

    ``frames``: persons found in each frame. ``step``: largest movement of a person's middle from
    one frame in which the person is seen to the next [m]. Returns the track of each person:
    positions and figures by index of the frame.
    """
    tracks: list[dict[int, Person]] = []
    for k, persons in enumerate(frames):
        pairs = []
        for t, track in enumerate(tracks):
            last = track[max(track)].position
            for p, person in enumerate(persons):
                distance = float(np.linalg.norm(person.position - last))
                if distance < step:
                    pairs.append((distance, t, p))
        free_tracks, free = set(range(len(tracks))), set(range(len(persons)))
        for _, t, p in sorted(pairs):
            if t in free_tracks and p in free:
                tracks[t][k] = persons[p]
                free_tracks.discard(t)
                free.discard(p)
        tracks += [{k: persons[p]} for p in sorted(free)]
    return tracks


def _prominence(person: Person, middle: Array) -> tuple[float, float]:
    """Return a sort key, greatest for the largest person, of equal ones nearest to `middle`."""
    return person.area, -float(np.linalg.norm(person.position - middle))


@dataclass(frozen=True, eq=False)
class ViewFaults:
    """Frames in which persons were absent, merged or in company; frames count from 0.

    Args:
        no_person: frames in which fewer than two cameras see the person.
        blind: by camera, frames in which it sees no person, but two others do.
        others: by camera, frames in which it sees other persons.
        merged: by camera, frames in which the person and others are one figure.
    """

    no_person: tuple[int, ...] = ()
    blind: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    others: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    merged: Mapping[str, tuple[int, ...]] = field(default_factory=dict)


class PersonRecording:
    """The masks of one person, without other persons and without cameras that were left out.

    Attributes:
        height: median height of what is seen, by the calibration [m]; nan where no two cameras see
            a person.
        covering: fraction of the masks whose largest figure reaches all four sides, as
            backgrounds do.

    Args:
        cameras: by name.
        read: returns the masks of a frame; each of `count` frames is read once here.
        is_sequence: whether frames follow each other; if not, the largest person in each is taken.
    """

    def __init__(
        self, cameras: Mapping[str, Camera], read: ReadFrame, count: int, is_sequence: bool
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
            if len(seen) >= 2:
                used = [cameras[name] for name in seen]
                position = triangulate(used, [figure.middle for figure in seen.values()])
                for camera, figure in zip(used, seen.values(), strict=True):
                    height = float(figure.box[3] - figure.box[1])
                    heights.append(height / pixels_per_metre(camera, position))
        self.height = float(np.median(heights)) if heights else float("nan")
        self.covering = float(np.mean(covering)) if covering else 0.0
        middle = middle_of_view(list(cameras.values()))
        followed = follow_one(persons, middle, is_sequence)
        # By frame and camera: figures of others, and whether the person is one figure with them.
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
        """Frames in which two cameras that are not left out see the person."""
        return [k for k in range(self._count) if len(self.cameras_at(k)) >= 2]

    def cameras_at(self, frame: int) -> set[str]:
        """Return the names of the cameras that see the person in a frame and are not left out."""
        return {
            name for name in self._seeing[frame] if frame < self._left_out.get(name, self._count)
        }

    def leave_out(self, name: str, first: int) -> None:
        """Leave a camera out from frame `first` on."""
        self._left_out[name] = first

    def read(self, frame: int, with_all: bool = False) -> dict[str, Mask]:
        """Return the masks (H, W) of a frame by camera, without other persons.

        Cameras that do not see the person have none. `with_all`: left-out cameras have masks, too.
        """
        wanted = self._seeing[frame] if with_all else self.cameras_at(frame)
        return {
            name: cut_figures(mask, self._others[frame][name][0])
            for name, mask in self._read(frame).items()
            if name in wanted
        }

    def faults(self) -> ViewFaults:
        """Return where the person was absent, or others were in view, in all frames."""
        seen = set(self.seen)
        found: list[dict[str, list[int]]] = [{}, {}, {}]
        for frame, own in enumerate(self._others):
            for name, (strangers, is_merged) in own.items():
                is_blind = name not in self._seeing[frame] and frame in seen
                for applies, kind in zip(
                    (is_blind, bool(strangers) or is_merged, is_merged), found, strict=True
                ):
                    if applies:
                        kind.setdefault(name, []).append(frame)
        no_person = sorted(set(range(self._count)) - seen)
        return ViewFaults(
            tuple(no_person), *({k: tuple(v) for k, v in one.items()} for one in found)
        )
