"""A calibration that the silhouettes contradict before anybody is fitted: mirrored or exchanged.

Pictures that are mirrored against their calibration, or that lie in another camera's folder, leave
silhouettes that no body can fill. Where mirroring or exchanging them again lets a body fill them
all, that is what happened.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.person.rays import meeting_of_all
from drake_pose.person.recordings.figures import find_figures
from drake_pose.person.recordings.hull import HullView, coherence, hull_grid

Mask = NDArray[np.bool_]

# Silhouettes of a sound rig are filled but for this much.
_UNFILLED = 0.01
# What happened leaves no more than this much, and this share of what was unfilled.
_LEFT, _EXPLAINED = 0.03, 0.35
# Where more is unfilled and nothing explains it, the rig is not sound.
_CONTRADICTING = 0.3
# Grids whose middles differ by less are the same [m].
_LATTICE = 0.25


@dataclass(frozen=True)
class RigFault:
    """What the silhouettes of all cameras together say against their calibration.

    In a ring of four, opposite cameras exchanged are all cameras mirrored: then that is said.

    Args:
        mirrored: the cameras whose pictures are mirrored, left for right.
        exchanged: the two cameras whose pictures are each other's.
        filled: what share of the silhouettes a body can fill, by camera.
        filled_after: and once that is undone.
    """

    mirrored: tuple[str, ...]
    exchanged: tuple[str, ...]
    filled: Mapping[str, float]
    filled_after: Mapping[str, float]

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
    """What is wrong with a rig as a whole; None where nothing is.

    Args:
        cameras: by name.
        frames: the masks (H, W) of one person in some frames, by camera.
    """
    frames = [masks for masks in frames if len(masks) >= 2]
    if not frames:
        return None
    room = _Room(cameras)
    sound = RigFault((), (), {}, {})
    filled = room.filled(frames, sound)
    unfilled = 1.0 - float(np.mean(list(filled.values())))
    if unfilled < _UNFILLED:
        return None
    best, least = sound, unfilled
    after = filled
    for guess in _guesses(cameras, list(filled)):
        found = room.filled(frames, guess)
        left = 1.0 - float(np.mean(list(found.values())))
        if left < least:
            best, least, after = guess, left, found
    if least < min(_LEFT, _EXPLAINED * unfilled):
        return RigFault(best.mirrored, best.exchanged, filled, after)
    if unfilled > _CONTRADICTING:
        return RigFault((), (), filled, filled)
    return None


def _guesses(cameras: Mapping[str, Camera], names: Sequence[str]) -> Iterator[RigFault]:
    """What may have happened to a rig."""
    yield RigFault(tuple(names), (), {}, {})
    for name in names:
        yield RigFault((name,), (), {}, {})
    for one, other in combinations(names, 2):
        a, b = cameras[one], cameras[other]
        if (a.width, a.height) == (b.width, b.height):
            yield RigFault((), (one, other), {}, {})


class _Room:
    """Grids about the person, and what each camera sees of them."""

    def __init__(self, cameras: Mapping[str, Camera]) -> None:
        self._cameras = cameras
        self._views: dict[tuple[str, tuple[int, ...]], HullView] = {}

    def filled(self, frames: Sequence[Mapping[str, Mask]], guess: RigFault) -> dict[str, float]:
        """What share of the silhouettes a body can fill, by camera, if a guess is undone."""
        shares: dict[str, list[float]] = {}
        for frame in frames:
            masks = guess.undo(frame)
            names = [name for name, mask in masks.items() if mask.any()]
            used = [self._cameras[name] for name in names]
            middles = [find_figures(masks[name])[0].middle for name in names]
            cell = tuple(int(k) for k in np.rint(meeting_of_all(used, middles) / _LATTICE))
            views = [self._view(name, cell) for name in names]
            cells = [view.cells(masks[name]) for view, name in zip(views, names, strict=True)]
            for name, share in zip(names, coherence(views, cells), strict=True):
                shares.setdefault(name, []).append(float(share))
        return {name: float(np.mean(own)) for name, own in shares.items()}

    def _view(self, name: str, cell: tuple[int, ...]) -> HullView:
        key = name, cell
        if key not in self._views:
            grid = hull_grid(_LATTICE * np.array(cell, dtype=np.float64))
            self._views[key] = HullView(self._cameras[name], grid)
        return self._views[key]
