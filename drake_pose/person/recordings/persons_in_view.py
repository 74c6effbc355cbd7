"""Several persons in view: which of them is followed, and which figures of the masks are his."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.person.rays import triangulate
from drake_pose.person.recordings.figures import (
    Figure,
    Person,
    cut_figures,
    find_figures,
    find_persons,
    metres_off,
    pixels_per_metre,
)
from drake_pose.person.views import FrameViews, edge_spacing, see_silhouette

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Figures = Sequence[Sequence[Figure]]
"""Of each camera's mask."""
ReadFrame = Callable[[int], Mapping[str, Mask]]
"""Gives the masks (H, W) of a frame, counted from 0, by camera; one may be missing."""

# From one frame to the next a person's middle moves no farther, and so much more in each more [m].
_STEP, _STEP_MORE = 0.4, 0.1
# A figure that is as large as this share of the person, and farther off [m], is no part of him.
_FAR, _LARGE = 0.7, 0.25
# In this many frames, or somewhat more, the person is measured.
_MEASURED = 20


@dataclass(frozen=True, eq=False)
class ViewFaults:
    """What was in view or was not; frames are counted from 0.

    Args:
        nobody: the frames in which fewer than two cameras see the person.
        blind: by camera, the frames in which it sees nobody, but two others do.
        others: by camera, the frames in which it sees others, too.
        merged: by camera, those of them in which person and others are one figure.
    """

    nobody: tuple[int, ...] = ()
    blind: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    others: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    merged: Mapping[str, tuple[int, ...]] = field(default_factory=dict)


class PersonRecording:
    """The masks of one person, without those of cameras that see nobody or are left out.

    Attributes:
        height: of what is seen, by the cameras' calibration [m]; nan where two cameras see nobody.
        covering: in what share of the masks the largest figure reaches all four sides.

    Args:
        read: gives the masks of a frame; all `count` are read once.
        is_sequence: whether they follow each other.
    """

    def __init__(
        self, cameras: Mapping[str, Camera], read: ReadFrame, count: int, is_sequence: bool
    ) -> None:
        self._read, self._count = read, count
        self._left_out: dict[str, int] = {}
        figures: list[dict[str, tuple[Figure, ...]]] = []
        persons: list[tuple[Person, ...]] = []
        for frame in range(count):
            figures.append({name: find_figures(mask) for name, mask in read(frame).items()})
            used = [cameras[name] for name in figures[-1]]
            persons.append(find_persons(used, list(figures[-1].values())))
        followed = follow_one(persons, middle_of_view(list(cameras.values())), is_sequence)
        # By frame and camera: the figures of others, and whether the person is one with them.
        self._others: list[dict[str, tuple[tuple[Figure, ...], bool]]] = []
        self._seeing: list[set[str]] = []
        for own, person, present in zip(figures, followed, persons, strict=True):
            sorted_: list[tuple[tuple[Figure, ...], bool]] = [((), False)] * len(own)
            if present:
                others = [one for one in present if one is not person]
                used = [cameras[name] for name in own]
                sorted_ = sort_figures(used, list(own.values()), person, others)
            self._others.append(dict(zip(own, sorted_, strict=True)))
            self._seeing.append(
                {k for k, all_ in own.items() if len(all_) > len(self._others[-1][k][0])}
            )
        self.height = _height(cameras, figures)
        self.covering = _covering(cameras, figures)

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
            name: cut_figures(mask, others) if (others := self._others[frame][name][0]) else mask
            for name, mask in self._read(frame).items()
            if name in wanted
        }

    def faults(self) -> ViewFaults:
        """What was in view or was not."""
        seen = self.seen
        blind: dict[str, list[int]] = {}
        others: dict[str, list[int]] = {}
        merged: dict[str, list[int]] = {}
        for frame in range(self._count):
            for name, (strangers, is_merged) in self._others[frame].items():
                if name not in self._seeing[frame] and frame in seen:
                    blind.setdefault(name, []).append(frame)
                if strangers or is_merged:
                    others.setdefault(name, []).append(frame)
                if is_merged:
                    merged.setdefault(name, []).append(frame)
        nobody = set(range(self._count)) - set(seen)
        found = [{k: tuple(v) for k, v in one.items()} for one in (blind, others, merged)]
        return ViewFaults(tuple(sorted(nobody)), *found)


def _height(
    cameras: Mapping[str, Camera], frames: Sequence[Mapping[str, tuple[Figure, ...]]]
) -> float:
    """How high the largest figures are where their rays come nearest to each other [m]."""
    heights = []
    for figures in frames[:: max(1, len(frames) // _MEASURED)]:
        seen = {cameras[name]: own[0] for name, own in figures.items() if own}
        if len(seen) < 2:
            continue
        place = triangulate(list(seen), [figure.middle for figure in seen.values()])
        for camera, figure in seen.items():
            _, top, _, bottom = figure.box
            heights.append(float(bottom - top) / pixels_per_metre(camera, place))
    return float(np.median(heights)) if heights else float("nan")


def _covering(
    cameras: Mapping[str, Camera], frames: Sequence[Mapping[str, tuple[Figure, ...]]]
) -> float:
    """In what share of the masks the largest figure reaches all four sides, as backgrounds do."""
    found = []
    for figures in frames:
        for name, own in figures.items():
            if own:
                width, height = own[0].box[2:] - own[0].box[:2]
                camera = cameras[name]
                found.append(width > 0.98 * camera.width and height > 0.98 * camera.height)
    return float(np.mean(found)) if found else 0.0


@dataclass(frozen=True, eq=False)
class KeptPerson:
    """A frame's masks (H, W) without other persons, by camera.

    Args:
        person: None where fewer than two cameras see anybody.
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
    """A frame's masks of one person only, who was at a place (3,) [m] in the last frame.

    None: the one whose figures are the largest, of two alike nearer to where the cameras look.
    """
    used = [cameras[name] for name in masks]
    figures = [find_figures(mask) for mask in masks.values()]
    persons = find_persons(used, figures)
    if not persons:
        return KeptPerson(masks, None)
    if place is None:
        person = max(persons, key=lambda one: _standing(one, middle_of_view(used)))
    else:
        person = min(persons, key=lambda one: float(np.linalg.norm(one.place - place)))
    others = [one for one in persons if one is not person]
    found = dict(zip(masks, sort_figures(used, figures, person, others), strict=True))
    kept = {
        name: cut_figures(mask, found[name][0]) if found[name][0] else mask
        for name, mask in masks.items()
    }
    cut = tuple(name for name, (unwanted, _) in found.items() if unwanted)
    return KeptPerson(kept, person, cut, tuple(k for k, (_, merged) in found.items() if merged))


def keep_views(frame: FrameViews, place: Array | None = None) -> tuple[FrameViews, KeptPerson]:
    """What cameras see of one person only, who was at a place (3,) [m], as in keep_person."""
    pairs = list(zip(frame.cameras, frame.views, strict=True))
    kept = keep_person(
        {camera.name: camera for camera in frame.cameras},
        {camera.name: view.region for camera, view in pairs},
        place,
    )
    alone = [
        see_silhouette(kept.masks[camera.name], edge_spacing(camera))
        if camera.name in kept.cut
        else view
        for camera, view in pairs
    ]
    return FrameViews(frame.cameras, alone), kept


def middle_of_view(cameras: Sequence[Camera]) -> Array:
    """(3,) the point nearest to where all cameras look [m]."""
    middles = [np.array([0.5 * (c.width - 1), 0.5 * (c.height - 1)]) for c in cameras]
    return triangulate(cameras, middles)


def sort_figures(
    cameras: Sequence[Camera], figures: Figures, person: Person | None, others: Sequence[Person]
) -> list[tuple[tuple[Figure, ...], bool]]:
    """For each camera the figures of others, and whether the person and another are one figure.

    The person is None where he is away.
    """
    if person is None:
        return [(tuple(own), False) for own in figures]
    found = []
    for k, (camera, own) in enumerate(zip(cameras, figures, strict=True)):
        taken = {one.figures[k] for one in others if k in one.figures}
        merged = False
        away: list[Figure] = []
        for i, figure in enumerate(own):
            if person.figures.get(k) == i:
                hidden = [one for one in others if k not in one.figures]
                merged |= any(_covers(camera, figure, one) for one in hidden)
            elif i in taken:
                if k not in person.figures and _covers(camera, figure, person):
                    merged = True
                else:
                    away.append(figure)
            elif _is_strangers(camera, figure, person, others, k, own):
                away.append(figure)
        found.append((tuple(away), merged))
    return found


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
    tracks = _tracks(frames)
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
