"""A recording's masks of one person: without others in view, and cameras that see nobody."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

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
    pixels_per_metre,
)
from drake_pose.person.recordings.other_persons import (
    Sorted,
    follow_one,
    middle_of_view,
    sort_figures,
)
from drake_pose.person.recordings.person_capture import ReadFrame

Mask = NDArray[np.bool_]

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
        cameras: by name.
        read: gives the masks (H, W) of a frame, counted from 0, by camera.
        count: how many frames there are; all are read once.
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
        self._sorted = [
            _sort(cameras, own, one, present)
            for own, one, present in zip(figures, followed, persons, strict=True)
        ]
        self._seeing = [
            {name for k, (name, all_) in enumerate(own.items()) if len(all_) > len(whose.others[k])}
            for own, whose in zip(figures, self._sorted, strict=True)
        ]
        self._names = [list(own) for own in figures]
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
        others = dict(zip(self._names[frame], self._sorted[frame].others, strict=True))
        return {
            name: cut_figures(mask, others[name]) if others[name] else mask
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
            for k, name in enumerate(self._names[frame]):
                whose = self._sorted[frame]
                if name not in self._seeing[frame] and frame in seen:
                    blind.setdefault(name, []).append(frame)
                if whose.others[k] or whose.merged[k]:
                    others.setdefault(name, []).append(frame)
                if whose.merged[k]:
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
        place = meeting_of_all(list(seen), [figure.middle for figure in seen.values()])
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


def _sort(
    cameras: Mapping[str, Camera],
    figures: Mapping[str, tuple[Figure, ...]],
    person: Person | None,
    persons: Sequence[Person],
) -> Sorted:
    """Whose the figures of a frame are."""
    used = [cameras[name] for name in figures]
    own = list(figures.values())
    if not persons:
        return Sorted(((),) * len(own), (False,) * len(own))
    others = [one for one in persons if one is not person]
    return sort_figures(used, own, person, others)
