"""Several persons in view: which of them is followed, and which figures of the masks are his."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Mask
from drake_pose.camera.models import Camera
from drake_pose.person.figures import (
    Figure,
    Person,
    cut_figures,
    find_figures,
    find_persons,
    metres_off,
    pixels_per_metre,
)
from drake_pose.person.views import FrameViews, edge_spacing, see_silhouette, triangulate

ReadFrame = Callable[[int], Mapping[str, Mask]]
"""Gives the masks (H, W) of a frame, counted from 0, by camera; one may be missing."""

# From one frame to the next a person's middle moves no farther, and so much more in each more [m].
_STEP, _STEP_MORE = 0.4, 0.1
# A figure that is as large as this share of the person, and farther off [m], is no part of him.
_FAR, _LARGE = 0.7, 0.25
# In this many frames, or somewhat more, the person is measured.
_MEASURED = 20
# A mask whose figures are all the person's.
_ALONE: tuple[tuple[Figure, ...], bool] = ((), False)


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


class Look(NamedTuple):
    """What cameras see in a frame: by name those with a mask, its figures, and the persons."""

    cameras: Mapping[str, Camera]
    figures: Mapping[str, tuple[Figure, ...]]
    persons: tuple[Person, ...]

    def sort(self, person: Person | None) -> dict[str, tuple[tuple[Figure, ...], bool]]:
        """By camera the figures of others, and whether the person and another are one figure.

        The person is None where he is away.
        """
        others = [one for one in self.persons if one is not person]
        found = {}
        for k, (name, own) in enumerate(self.figures.items()):
            if person is None:
                found[name] = own, False
                continue
            camera, merged = self.cameras[name], False
            taken = {one.figures[k] for one in others if k in one.figures}
            away: list[Figure] = []
            for i, figure in enumerate(own):
                if person.figures.get(k) == i:
                    hidden = [one for one in others if k not in one.figures]
                    merged |= any(_covers(camera, figure, one) for one in hidden)
                elif i in taken and k not in person.figures and _covers(camera, figure, person):
                    merged = True
                elif i in taken or _is_strangers(camera, figure, person, others, k, own):
                    away.append(figure)
            found[name] = tuple(away), merged
        return found


def look_for_persons(cameras: Mapping[str, Camera], masks: Mapping[str, Mask]) -> Look:
    """Who is seen in a frame's masks (H, W)."""
    figures = {name: find_figures(mask) for name, mask in masks.items()}
    used = {name: cameras[name] for name in masks}
    return Look(used, figures, find_persons(list(used.values()), list(figures.values())))


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
        looks = [look_for_persons(cameras, read(frame)) for frame in range(count)]
        middle = middle_of_view(list(cameras.values()))
        followed = follow_one([one.persons for one in looks], middle, is_sequence)
        # By frame and camera: the figures of others, and whether the person is one with them.
        self._others = [
            one.sort(person) if one.persons else dict.fromkeys(one.figures, _ALONE)
            for one, person in zip(looks, followed, strict=True)
        ]
        self._seeing = [
            {name for name, own in one.figures.items() if len(own) > len(others[name][0])}
            for one, others in zip(looks, self._others, strict=True)
        ]
        self.height, self.covering = _measure(looks)

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


def _measure(looks: Sequence[Look]) -> tuple[float, float]:
    """How high the largest figures are by the calibration [m]; what share of all fill the picture.

    Those fill it that reach all four sides, as backgrounds do.
    """
    heights: list[float] = []
    covering = []
    for k, look in enumerate(looks):
        seen = {look.cameras[name]: own[0] for name, own in look.figures.items() if own}
        for camera, figure in seen.items():
            width, height = figure.box[2:] - figure.box[:2]
            covering.append(width > 0.98 * camera.width and height > 0.98 * camera.height)
        if k % max(1, len(looks) // _MEASURED) == 0 and len(seen) >= 2:
            place = triangulate(list(seen), [figure.middle for figure in seen.values()])
            for camera, figure in seen.items():
                height = float(figure.box[3] - figure.box[1])
                heights.append(height / pixels_per_metre(camera, place))
    return (
        float(np.median(heights)) if heights else float("nan"),
        float(np.mean(covering)) if covering else 0.0,
    )


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
    look = look_for_persons(cameras, masks)
    persons = look.persons
    if not persons:
        return KeptPerson(masks, None)
    if place is None:
        middle = middle_of_view([cameras[name] for name in masks])
        person = max(persons, key=lambda one: _standing(one, middle))
    else:
        person = min(persons, key=lambda one: float(np.linalg.norm(one.place - place)))
    found = look.sort(person)
    return KeptPerson(
        {name: cut_figures(mask, found[name][0]) for name, mask in masks.items()},
        person,
        tuple(name for name, (unwanted, _) in found.items() if unwanted),
        tuple(name for name, (_, is_merged) in found.items() if is_merged),
    )


def keep_views(frame: FrameViews, place: Array | None = None) -> tuple[FrameViews, KeptPerson]:
    """What cameras see of one person only, who was at a place (3,) [m], as in keep_person."""
    cameras = {camera.name: camera for camera in frame.cameras}
    kept = keep_person(cameras, {one.name: view.region for one, view in frame.pairs}, place)
    alone = [
        see_silhouette(kept.masks[one.name], edge_spacing(one)) if one.name in kept.cut else view
        for one, view in frame.pairs
    ]
    return FrameViews(frame.cameras, alone), kept


def middle_of_view(cameras: Sequence[Camera]) -> Array:
    """(3,) the point nearest to where all cameras look [m]."""
    middles = [np.array([0.5 * (c.width - 1), 0.5 * (c.height - 1)]) for c in cameras]
    return triangulate(cameras, middles)


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
