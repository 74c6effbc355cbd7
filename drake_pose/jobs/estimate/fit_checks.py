"""Whether the poses that were found explain the pictures, and what to look at where they do not."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.models import Camera
from drake_pose.jobs.estimate.scene_checks import frame_ranges
from drake_pose.results.folder import PoseRow
from drake_pose.results.summary import FrameRecord
from drake_pose.results.texts import percent
from drake_pose.search.estimates import View

BADLY_EXPLAINED = 0.25
"""From this E_total on, a pose explains its pictures badly."""

# From this E_total on (median of the frames), two cameras that are matched together are compared.
# More are compared only where the pictures are explained badly: a real person in four leaves 15 to
# 18 %, and one of several that disagrees is known by its IoU.
_DOUBTFUL = 0.12
# Cameras contradict each other where each alone leaves less than this share of what all together
# leave; and what is put right leaves as little.
_LEFT = 0.5
# How many frames are compared, and how many pairs of cameras exchanged.
_FRAMES, _PAIRS = 2, 3
# A joint stands at a limit if it is so near to it, as a share of its range.
_AT_LIMIT = 1e-3

Match = Callable[[str, Sequence[View]], float]
"""E_total of the best pose of a frame in views."""


@dataclass(frozen=True)
class Contradiction:
    """Cameras that one pose does not explain together; all compared ones, where nobody can tell.

    Args:
        exchanged: whether it is explained once their pictures are exchanged.
        together, alone, after: E_total by all cameras, by each alone, and with pictures exchanged.
    """

    cameras: tuple[str, ...]
    exchanged: bool
    together: float
    alone: Mapping[str, float]
    after: float

    @property
    def text(self) -> str:
        """The warning."""
        names = " and ".join(f"'{name}'" for name in self.cameras)
        before = f"E_total is {percent(self.together)} together"
        if self.exchanged:
            return (
                f"cameras {names} are exchanged, it seems: {before}, but {percent(self.after)} "
                "with each other's pictures; exchange their folders of masks, or their names in "
                "cameras.yaml"
            )
        each = ", ".join(f"'{name}' {percent(error)}" for name, error in self.alone.items())
        if len(self.cameras) < len(self.alone):
            others = "the others" if len(self.alone) > 2 else "the other one"
            what = f"camera {names} contradicts {others}"
        else:
            what = f"cameras {names} contradict each other"
        return (
            f"{what}: {before}, alone {each}; has one moved since it was calibrated, are masks of "
            "another camera or instant, is X_WC the camera's pose in the world, in metres?"
        )


def poor_fit_warnings(
    rows: Sequence[PoseRow],
    records: Mapping[str, FrameRecord],
    model: ArticulatedModel,
    held: Iterable[str],
) -> tuple[str, ...]:
    """One warning where poses explain their pictures badly; `held` positions were not searched."""
    # A followed person is judged by the contours (describe_fit): others in view are in the masks.
    judged = {frame: one for frame, one in records.items() if one.share is None}
    errors = {frame: one.E_total for frame, one in judged.items() if one.E_total is not None}
    bad = [frame for frame, error in errors.items() if error >= BADLY_EXPLAINED]
    if not bad:
        return ()
    several = f"of {len(errors)}, E_total {percent(float(np.median([errors[f] for f in bad])))}"
    several = several if len(bad) > 1 else f"E_total {percent(errors[bad[0]])}"
    at_limits = _at_limits([row for row in rows if row.frame in set(bad)], model)
    advice = ["the cameras (exchanged? moved?)", "the model and its scale", "its limits"]
    if at_limits:
        advice[-1] += f" ({', '.join(at_limits)} at a limit)"
    if names := ", ".join(held):
        advice.append(f"what is held ({names})")
    return (
        f"frame {frame_ranges(bad, list(records))} ({several}): the pose explains the pictures "
        f"badly, so it may be wrong; look at the overlays, the masks, {', '.join(advice)} and "
        "where the root is",
    )


def _at_limits(rows: Sequence[PoseRow], model: ArticulatedModel) -> list[str]:
    """The positions that stand at a limit in most of some frames; three at most."""
    q = np.array([row.q for row in rows])
    with np.errstate(invalid="ignore"):
        near = _AT_LIMIT * (model.upper - model.lower)
        at_limit = ((q <= model.lower + near) | (q >= model.upper - near)) & np.isfinite(near)
    turns_freely = (model.upper - model.lower) >= 2.0 * np.pi
    is_one = (at_limit.mean(axis=0) > 0.5) & (model.lower < model.upper) & ~turns_freely
    return [model.position_names[k] for k in np.flatnonzero(is_one)][:3]


def find_contradiction(
    match: Match,
    cameras: Sequence[Camera],
    read: Callable[[str, str], np.ndarray],
    seen: Iterable[tuple[str, str]],
    records: Mapping[str, FrameRecord],
) -> Contradiction | None:
    """Cameras that contradict each other; nothing is matched where the poses fit.

    `read` gives the mask (H, W) of a camera's frame, `seen` is (camera, frame) of those there are.
    """
    known = {f: one.E_total for f, one in records.items() if one.E_total is not None}
    limit = _DOUBTFUL if len(cameras) == 2 else BADLY_EXPLAINED
    if len(cameras) < 2 or not known or np.median(list(known.values())) < limit:
        return None
    present = set(seen)
    whole = [f for f in known if all((camera.name, f) in present for camera in cameras)]
    # The usual ones: in the worst, there may be more that is wrong.
    usual = sorted(whole, key=lambda frame: abs(known[frame] - np.median(list(known.values()))))
    frames = {f: {camera.name: read(camera.name, f) for camera in cameras} for f in usual[:_FRAMES]}
    if not frames:
        return None
    return _Rig(match, cameras, frames).contradiction(
        float(np.mean([known[frame] for frame in frames])), records
    )


class _Rig:
    """Cameras and their masks (H, W) by name in some frames, matched in other combinations."""

    def __init__(
        self,
        match: Match,
        cameras: Sequence[Camera],
        frames: Mapping[str, Mapping[str, np.ndarray]],
    ) -> None:
        self._match, self._frames = match, frames
        self._cameras = {camera.name: camera for camera in cameras}

    def contradiction(
        self, together: float, records: Mapping[str, FrameRecord]
    ) -> Contradiction | None:
        """What together, E_total of all cameras, comes from, if the cameras are at fault."""
        names = list(self._cameras)
        ious = {n: np.mean([records[f].ious.get(n, 0.0) for f in self._frames]) for n in names}
        worst = sorted(names, key=lambda name: ious[name])
        for one, other in self._pairs(worst):
            after = self._E_total({n: {one: other, other: one}.get(n, n) for n in names})
            if after < _LEFT * together:
                return Contradiction((one, other), True, together, {}, after)
        alone = {name: self._E_total({name: name}) for name in names}
        areas = [sum(float(m[n].sum()) for m in self._frames.values()) for n in names]
        if np.average(list(alone.values()), weights=areas) < _LEFT * together:
            return Contradiction(self._one_of(worst, together), False, together, alone, np.nan)
        # A camera whose place the model's own contradicts is not explained even alone.
        bad = tuple(name for name in names if alone[name] >= BADLY_EXPLAINED)
        good = [error for name, error in alone.items() if name not in bad]
        if bad and good and max(good) < _LEFT * min(alone[name] for name in bad):
            return Contradiction(bad, False, together, alone, np.nan)
        return None

    def _one_of(self, worst: Sequence[str], together: float) -> tuple[str, ...]:
        """The camera without which the others agree, of those that fit worst; else all."""
        if len(worst) > 2:
            left = {n: self._E_total({m: m for m in worst if m != n}) for n in worst[:_PAIRS]}
            first = min(left, key=lambda name: left[name])
            if left[first] < _LEFT * together:
                return (first,)
        return tuple(self._cameras)

    def _pairs(self, names: Sequence[str]) -> list[tuple[str, str]]:
        """Pairs of cameras with pictures of one size; the first names come first."""
        sizes = {name: (c.width, c.height) for name, c in self._cameras.items()}
        alike = [(a, b) for a, b in combinations(names, 2) if sizes[a] == sizes[b]]
        return alike[:_PAIRS]

    def _E_total(self, owners: Mapping[str, str]) -> float:
        """Mean over the frames, each camera given the mask of another (or its own)."""
        return float(
            np.mean(
                [
                    self._match(
                        frame,
                        [View(self._cameras[name], masks[own]) for name, own in owners.items()],
                    )
                    for frame, masks in self._frames.items()
                ]
            )
        )
