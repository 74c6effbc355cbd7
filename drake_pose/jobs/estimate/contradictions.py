"""Whether cameras contradict each other where the poses do not explain the pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import combinations

import numpy as np

from drake_pose.camera.models import Camera
from drake_pose.results.records import FrameRecord
from drake_pose.results.summary import BADLY_EXPLAINED
from drake_pose.results.texts import percent
from drake_pose.search.estimates import View

# From this E_total on (median of the frames), two cameras that are matched together are compared.
# More are compared only where the pictures are explained badly: a real person in four leaves 15 to
# 18 %, and one of several that disagrees is known by its IoU.
_DOUBTFUL = 0.12
# Cameras contradict each other where each alone leaves less than this share of what all together
# leave; and what is put right leaves as little.
_LEFT = 0.5
# How many frames are compared, and how many pairs of cameras exchanged.
_FRAMES, _PAIRS = 2, 3

Match = Callable[[str, Sequence[View]], float]
"""E_total of the best pose of a frame in views."""


def find_contradiction(
    match: Match,
    cameras: Mapping[str, Camera],
    read: Callable[[str, str], np.ndarray],
    seen: Iterable[tuple[str, str]],
    records: Mapping[str, FrameRecord],
) -> list[str]:
    """A warning of cameras that contradict each other; nothing is matched where the poses fit.

    `read` gives the mask (H, W) of a camera's frame, `seen` is (camera, frame) of those there are.
    """
    known = {f: one.E_total for f, one in records.items() if one.E_total is not None}
    usual = float(np.median(list(known.values()))) if known else 0.0
    if len(cameras) < 2 or usual < (_DOUBTFUL if len(cameras) == 2 else BADLY_EXPLAINED):
        return []
    present = set(seen)
    whole = [f for f in known if all((name, f) in present for name in cameras)]
    # The usual ones: in the worst, there may be more that is wrong.
    chosen = sorted(whole, key=lambda frame: abs(known[frame] - usual))[:_FRAMES]
    if not chosen:
        return []
    masks = {frame: {name: read(name, frame) for name in cameras} for frame in chosen}

    def error(owners: Mapping[str, str]) -> float:
        """E_total, mean over the frames, each camera given the mask of another (or its own)."""
        pairs = owners.items()
        views = {f: [View(cameras[k], own[o]) for k, o in pairs] for f, own in masks.items()}
        return float(np.mean([match(frame, views[frame]) for frame in chosen]))

    together = float(np.mean([known[frame] for frame in chosen]))
    ious = {n: np.mean([records[f].ious.get(n, 0.0) for f in chosen]) for n in cameras}
    worst = sorted(cameras, key=lambda name: ious[name])
    sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
    alike = [pair for pair in combinations(worst, 2) if sizes[pair[0]] == sizes[pair[1]]]
    for one, other in alike[:_PAIRS]:
        after = error({n: {one: other, other: one}.get(n, n) for n in cameras})
        if after < _LEFT * together:
            return [_say_exchanged(one, other, together, after)]
    alone = {name: error({name: name}) for name in cameras}
    areas = [sum(float(own[name].sum()) for own in masks.values()) for name in cameras]
    bad: Sequence[str] = [name for name in cameras if alone[name] >= BADLY_EXPLAINED]
    good = [alone[name] for name in cameras if name not in bad]
    if np.average(list(alone.values()), weights=areas) < _LEFT * together:
        bad = _one_of(worst, together, error) or list(cameras)
    # A camera whose place the model's own contradicts is not explained even alone.
    elif not (bad and good and max(good) < _LEFT * min(alone[name] for name in bad)):
        return []
    return [_say_contradiction(bad, together, alone)]


def _one_of(
    worst: Sequence[str], together: float, error: Callable[[Mapping[str, str]], float]
) -> Sequence[str]:
    """The camera without which the others agree, of those that fit worst; none: all."""
    if len(worst) > 2:
        left = {n: error({m: m for m in worst if m != n}) for n in worst[:_PAIRS]}
        first = min(left, key=lambda name: left[name])
        if left[first] < _LEFT * together:
            return [first]
    return []


def _say_exchanged(one: str, other: str, together: float, after: float) -> str:
    return (
        f"cameras '{one}' and '{other}' are exchanged, it seems: E_total is {percent(together)} "
        f"together, but {percent(after)} with each other's pictures; exchange their folders of "
        "masks, or their names in cameras.yaml"
    )


def _say_contradiction(cameras: Sequence[str], together: float, alone: Mapping[str, float]) -> str:
    names = " and ".join(f"'{name}'" for name in cameras)
    each = ", ".join(f"'{name}' {percent(error)}" for name, error in alone.items())
    what = f"cameras {names} contradict each other"
    if len(cameras) < len(alone):
        others = "the others" if len(alone) > 2 else "the other one"
        what = f"camera {names} contradicts {others}"
    return (
        f"{what}: E_total is {percent(together)} together, alone {each}; has one moved since it "
        "was calibrated, are masks of another camera or instant, is X_WC the camera's pose in the "
        "world, in metres?"
    )
