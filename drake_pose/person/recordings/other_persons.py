"""Several persons in view: which of them is followed, and which figures of the masks are his."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.person.rays import meeting_of_all
from drake_pose.person.recordings.figures import (
    Figure,
    Person,
    cut_figures,
    find_figures,
    find_persons,
    metres_off,
)
from drake_pose.person.silhouette_view import SilhouetteView, see_silhouette

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# From one frame to the next a person's middle moves no farther, and so much more in each more [m].
_STEP = 0.4
_STEP_MORE = 0.1
# A figure that is as large as this share of the person, and farther off [m], is no part of him.
_FAR = 0.7
_LARGE = 0.25


class Sorted(NamedTuple):
    """Whose a frame's figures are.

    Attributes:
        others: for each camera the figures of others.
        merged: for each camera whether the person and another are one figure.
    """

    others: tuple[tuple[Figure, ...], ...]
    merged: tuple[bool, ...]


@dataclass(frozen=True, eq=False)
class KeptPerson:
    """A frame's masks without other persons.

    Args:
        masks: by camera, of (H, W).
        person: the person; None where fewer than two cameras see anybody.
        cut: the cameras whose masks had others in them, who were cut out.
        merged: the cameras in which the person and another are one figure, which is left whole.
    """

    masks: Mapping[str, Mask]
    person: Person | None
    cut: tuple[str, ...] = ()
    merged: tuple[str, ...] = ()


def keep_person(
    cameras: Mapping[str, Camera], masks: Mapping[str, Mask], place: Array | None = None
) -> KeptPerson:
    """A frame's masks of one person only.

    Args:
        cameras: by name.
        masks: of some of the cameras.
        place: (3,) where the person was in the last frame [m]; None: the one whose figures are the
            largest is taken, of two alike the one nearer to where the cameras look.
    """
    names = list(masks)
    used = [cameras[name] for name in names]
    figures = [find_figures(masks[name]) for name in names]
    persons = find_persons(used, figures)
    if not persons:
        return KeptPerson(masks, None)
    if place is None:
        person = max(persons, key=lambda one: _standing(one, middle_of_view(used)))
    else:
        person = min(persons, key=lambda one: float(np.linalg.norm(one.place - place)))
    others = [one for one in persons if one is not person]
    found = sort_figures(used, figures, person, others)
    kept = dict(masks)
    for name, unwanted in zip(names, found.others, strict=True):
        if unwanted:
            kept[name] = cut_figures(masks[name], unwanted)
    return KeptPerson(
        kept,
        person,
        tuple(name for name, unwanted in zip(names, found.others, strict=True) if unwanted),
        tuple(name for name, merged in zip(names, found.merged, strict=True) if merged),
    )


def middle_of_view(cameras: Sequence[Camera]) -> Array:
    """(3,) the point nearest to where all cameras look [m]."""
    middles = [np.array([0.5 * (c.width - 1), 0.5 * (c.height - 1)]) for c in cameras]
    return meeting_of_all(cameras, middles)


def sort_figures(
    cameras: Sequence[Camera],
    figures: Sequence[Sequence[Figure]],
    person: Person | None,
    others: Sequence[Person],
) -> Sorted:
    """Whose figures are whose.

    Args:
        cameras: the cameras.
        figures: of each camera's mask.
        person: who is followed; None where he is away.
        others: who else is there.
    """
    if person is None:
        return Sorted(tuple(tuple(own) for own in figures), (False,) * len(cameras))
    unwanted, merged = [], []
    for k, (camera, own) in enumerate(zip(cameras, figures, strict=True)):
        taken = {one.figures[k] for one in others if k in one.figures}
        shared = False
        away: list[Figure] = []
        for i, figure in enumerate(own):
            if person.figures.get(k) == i:
                hidden = [one for one in others if k not in one.figures]
                shared |= any(_covers(camera, figure, one) for one in hidden)
            elif i in taken:
                if k not in person.figures and _covers(camera, figure, person):
                    shared = True
                else:
                    away.append(figure)
            elif _is_strangers(camera, figure, person, others, k, own):
                away.append(figure)
        unwanted.append(tuple(away))
        merged.append(shared)
    return Sorted(tuple(unwanted), tuple(merged))


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
        largest = [max(own, key=lambda one: _standing(one, middle), default=None) for own in frames]
        return list(largest)
    tracks = _tracks(frames)
    if not tracks:
        return [None] * len(frames)
    main = max(tracks, key=lambda track: sum(_standing(one, middle)[0] for one in track.values()))
    # Who is there only while he is not is himself, come back.
    for track in sorted(tracks, key=len, reverse=True):
        if not set(range(min(track), max(track) + 1)) & set(main):
            main = main | track
    return _filled(main, len(frames))


def _tracks(frames: Sequence[Sequence[Person]]) -> list[dict[int, Person]]:
    """Who is who from frame to frame: the nearest go together."""
    tracks: list[dict[int, Person]] = []
    for k, persons in enumerate(frames):
        pairs = []
        for t, track in enumerate(tracks):
            last = max(track)
            reach = _STEP + _STEP_MORE * (k - last - 1)
            for p, person in enumerate(persons):
                distance = float(np.linalg.norm(person.place - track[last].place))
                if distance < reach:
                    pairs.append((distance, t, p))
        free_tracks, free = set(range(len(tracks))), set(range(len(persons)))
        for _, t, p in sorted(pairs):
            if t in free_tracks and p in free:
                tracks[t][k] = persons[p]
                free_tracks.discard(t)
                free.discard(p)
        tracks += [{k: persons[p]} for p in sorted(free)]
    return tracks


def _filled(track: Mapping[int, Person], count: int) -> list[Person | None]:
    """A track, frame by frame; where it is broken, somebody without figures on a straight way."""
    known = sorted(track)
    places = np.array([track[k].place for k in known])
    found: list[Person | None] = [None] * count
    for k in range(known[0], known[-1] + 1):
        way = np.array([np.interp(k, known, places[:, axis]) for axis in range(3)])
        found[k] = track.get(k, Person(way))
    return found


def _standing(person: Person, middle: Array) -> tuple[float, float]:
    """What one is chosen by: first how large one is seen, then how near to the middle."""
    return person.area, -float(np.linalg.norm(person.place - middle))


def _covers(camera: Camera, figure: Figure, person: Person) -> bool:
    """Whether a figure's box is about a person's middle."""
    uv, depth = camera.project(person.place[None])
    left, top, right, bottom = figure.box
    inside = left <= uv[0, 0] <= right and top <= uv[0, 1] <= bottom
    return bool(depth[0] > 0.0 and inside)


def _is_strangers(
    camera: Camera,
    figure: Figure,
    person: Person,
    others: Sequence[Person],
    k: int,
    own: Sequence[Figure],
) -> bool:
    """Whether a figure that nobody has is a part of others, or of somebody else."""
    off = metres_off(camera, figure.middle, person.place[None])[0]
    if others:
        places = np.array([one.place for one in others])
        if metres_off(camera, figure.middle, places).min() < off:
            return True
    if k not in person.figures or off < _FAR:
        return False
    return figure.area > _LARGE * own[person.figures[k]].area


class KeptViews(NamedTuple):
    """What cameras say of one person only.

    Attributes:
        views: what each of them says.
        cut: the names of cameras whose views had others in them, who were cut out.
        merged: the names of those in which the person and another are one figure, left whole.
    """

    views: list[SilhouetteView]
    cut: tuple[str, ...]
    merged: tuple[str, ...]


def keep_views(
    cameras: Sequence[Camera],
    views: Sequence[SilhouetteView],
    spacing: Callable[[Camera], float],
    place: Array | None = None,
) -> KeptViews:
    """What cameras say of one person only, for a tracker that sees frame after frame.

    Args:
        cameras: of different names.
        views: what each of them says.
        spacing: from edge point to edge point in a camera's pictures [pixel].
        place: (3,) where the person was in the last frame [m], as in keep_person.
    """
    kept = keep_person(
        {camera.name: camera for camera in cameras},
        {camera.name: view.region for camera, view in zip(cameras, views, strict=True)},
        place,
    )
    alone = [
        see_silhouette(kept.masks[camera.name], spacing(camera))
        if camera.name in kept.cut
        else view
        for camera, view in zip(cameras, views, strict=True)
    ]
    return KeptViews(alone, kept.cut, kept.merged)
