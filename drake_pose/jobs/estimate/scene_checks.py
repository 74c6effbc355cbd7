"""What is wrong with a scene of several cameras but leaves enough to go on: each fault is named."""

from __future__ import annotations

import filecmp
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drake_pose.camera.models import Camera
from drake_pose.errors import MaskError, SceneError
from drake_pose.regular_files import require_regular
from drake_pose.silhouette.pictures.scene_files import close_names, natural_key
from drake_pose.silhouette.pictures.scenes import Scene

# A camera that stands still while the others' silhouettes change by so much of their area.
_CHANGED = 0.02
# Cameras that look up or down steeply do not say where up is.
_UPRIGHT = 0.5
# Ranges of frames that are listed before "and more".
_LISTED = 6


@dataclass(frozen=True)
class CheckedScene:
    """A scene without what cannot be used, and what was wrong with it."""

    scene: Scene
    warnings: tuple[str, ...]


def check_scene(scene: Scene) -> CheckedScene:
    """The faults of a scene's files, and it without masks of cameras that stood still alone."""
    if scene.scale_unknown:
        return CheckedScene(scene, ())
    warnings = _check_leftovers(scene)
    if len(scene.cameras) > 1:
        warnings += _check_counts(scene)
    if scene.sequence:
        warnings += _check_gaps(scene)
        if len(scene.cameras) > 1:
            repeats = find_repeats(scene)
            frozen = _find_frozen(scene, repeats)
            warnings += _describe_frozen(scene, frozen)
            gone = {(name, frame) for name, frames in frozen.items() for frame in frames}
            masks = {key: path for key, path in scene.masks.items() if key not in gone}
            scene = replace(scene, masks=masks)
            warnings += _check_repeated(scene, repeats)
    return CheckedScene(scene, tuple(warnings))


def check_upright(cameras: Sequence[Camera]) -> tuple[str, ...]:
    """Whether the pictures' up is the world's z, as it must be where a person is to stand."""
    up = -np.mean([camera.X_WC[:3, 1] for camera in cameras], axis=0)
    axis = int(np.argmax(np.abs(up)))
    if (axis == 2 and up[2] > 0.0) or abs(up[axis]) < _UPRIGHT:
        return ()
    text = (
        f"cameras.yaml: up in the pictures is the world's {'+' if up[axis] > 0.0 else '-'}"
        f"{'xyz'[axis]}, but should be +z: the world lies on its side or upside down; turn X_WC"
    )
    return (text,)


def leave_out_unreadable(
    scene: Scene, cameras: Iterable[str], frames: Iterable[str]
) -> CheckedScene:
    """A scene without masks that cannot be read, where another camera has the frame, too.

    Raises:
        MaskError: a mask cannot be read, and no other camera has a readable one of that frame.
    """
    names = list(cameras)
    refused: dict[tuple[str, str], str] = {}
    for frame in frames:
        errors: dict[str, MaskError] = {}
        present = [name for name in names if (name, frame) in scene.masks]
        for name in present:
            try:
                scene.read(name, frame)
            except MaskError as error:
                errors[name] = error
        if present and len(errors) == len(present):
            raise errors[present[0]]
        refused |= {(name, frame): str(error) for name, error in errors.items()}
    masks = {key: path for key, path in scene.masks.items() if key not in refused}
    return CheckedScene(replace(scene, masks=masks), describe_unreadable(refused, scene))


def require_readable(refused: Mapping[tuple[str, str], str], scene: Scene) -> None:
    """Refuses a scene none of whose masks can be read: SceneError says why of the first."""
    if refused and len(refused) == len(scene.masks):
        first = next(iter(refused.values()))
        raise SceneError(f"{scene.path}: none of {len(refused)} masks can be used: {first}")


def describe_unreadable(refused: Mapping[tuple[str, str], str], scene: Scene) -> tuple[str, ...]:
    """One warning a camera of what is wrong with the masks of (camera, frame)."""
    found = []
    for camera in dict.fromkeys(name for name, _ in refused):
        frames = [frame for name, frame in refused if name == camera]
        listed = frame_ranges(frames, scene.frames)
        first = refused[camera, frames[0]]
        found.append(f"frame {listed} without camera '{camera}': {first}")
    return tuple(found)


def frame_ranges(frames: Iterable[str], known: Sequence[str]) -> str:
    """Frames as text: those that follow each other as first-last; many are not all listed."""
    order = {frame: k for k, frame in enumerate(known)}
    indices = sorted(order[frame] for frame in frames)
    parts: list[tuple[int, int]] = []
    for index in indices:
        if parts and parts[-1][1] == index - 1:
            parts[-1] = parts[-1][0], index
        else:
            parts.append((index, index))
    texts = [known[a] if a == b else f"{known[a]}-{known[b]}" for a, b in parts[:_LISTED]]
    rest = sum(b - a + 1 for a, b in parts[_LISTED:])
    return ", ".join(texts) + (f" and {rest} more" if rest else "")


def find_repeats(scene: Scene) -> set[tuple[str, str]]:
    """The masks, (camera, frame), whose file is that of the frame before again, byte for byte.

    Files are read only where sizes are equal; what cannot be read is like none.
    """
    found = set()
    for name in scene.cameras:
        last: tuple[Path, int] | None = None
        for frame in scene.frames:
            path, size = scene.masks.get((name, frame)), None
            if path is not None:
                with suppress(OSError):
                    size = require_regular(path)
                    if last and last[1] == size and filecmp.cmp(last[0], path, shallow=False):
                        found.add((name, frame))
            last = None if path is None or size is None else (path, size)
    return found


def _find_frozen(scene: Scene, repeats: set[tuple[str, str]]) -> dict[str, tuple[str, ...]]:
    """By camera, the frames in which its picture is the last one again while all others changed."""
    found: dict[str, list[str]] = {}
    for last, frame in zip(scene.frames, scene.frames[1:], strict=False):
        alike = [name for name in scene.cameras if (name, frame) in repeats]
        if not alike:
            continue
        both = [name for name in scene.cameras_of(frame) if (name, last) in scene.masks]
        others = [name for name in both if name not in alike]
        if len(others) > len(alike) and _has_changed(scene, others, last, frame):
            for name in alike:
                found.setdefault(name, []).append(frame)
    return {name: tuple(frames) for name, frames in found.items()}


def _has_changed(scene: Scene, names: Sequence[str], last: str, frame: str) -> bool:
    """Whether the silhouettes of cameras changed more than a hand behind the body would."""
    changes = []
    for name in names:
        try:
            one, other = (scene.read(name, f, may_be_empty=True) for f in (last, frame))
        except MaskError:
            continue
        area = max(int(one.sum()), int(other.sum()), 1)
        changes.append(float((one != other).sum()) / area)
    return bool(changes) and float(np.median(changes)) > _CHANGED


def _describe_frozen(scene: Scene, frozen: Mapping[str, Sequence[str]]) -> list[str]:
    return [
        f"camera '{name}' shows its last picture again in frame "
        f"{frame_ranges(frames, scene.frames)}, while the others' changed: left out there; did "
        "the camera stand still, or drop frames?"
        for name, frames in frozen.items()
    ]


def _check_repeated(scene: Scene, repeats: set[tuple[str, str]]) -> list[str]:
    """Frames that are the last one again in every camera."""
    repeated = []
    for last, frame in zip(scene.frames, scene.frames[1:], strict=False):
        both = [name for name in scene.cameras_of(frame) if (name, last) in scene.masks]
        if len(both) > 1 and all((name, frame) in repeats for name in both):
            repeated.append(frame)
    if not repeated:
        return []
    listed = frame_ranges(repeated, scene.frames)
    text = f"frame {listed}: all cameras show the frame before again; was it recorded twice?"
    return [text]


def _check_leftovers(scene: Scene) -> list[str]:
    """Folders without calibration, cameras without masks, files that are not used."""
    found = []
    unused = [name for name in scene.cameras if not any(owner == name for owner, _ in scene.masks)]
    for name, count in scene.leftovers.uncalibrated.items():
        close = close_names(name, unused)
        advice = f"is it '{close[0]}'?" if close else "calibrate it"
        found.append(
            f"masks/{name}: no camera '{name}' in cameras.yaml; its {count} masks are left out: "
            f"{advice}"
        )
    for name in unused:
        found.append(
            f"camera '{name}' of cameras.yaml has no masks in masks/{name}; the others go on"
        )
    for (name, frame), files in scene.leftovers.doubled.items():
        used = scene.masks[name, frame].name
        others = ", ".join(file.name for file in files)
        found.append(
            f"camera '{name}', frame {frame}: {used} is used, {others} is the same frame again"
        )
    for name, names in scene.leftovers.foreign.items():
        folder = f"masks/{name}" if name else "masks"
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        found.append(
            f"{folder}: {names[0]}{more} left out: masks are PNG pictures in masks/<camera>"
        )
    return found


def _check_counts(scene: Scene) -> list[str]:
    """Cameras that lack frames which others have."""
    counts = {
        name: sum((name, frame) in scene.masks for frame in scene.frames) for name in scene.cameras
    }
    found = []
    for name, count in counts.items():
        lacking = [frame for frame in scene.frames if (name, frame) not in scene.masks]
        if not count or not lacking:
            continue
        found.append(
            f"camera '{name}' has {count} of {len(scene.frames)} frames; it lacks "
            f"{frame_ranges(lacking, scene.frames)}, where the others go on without it"
        )
    return found


def _check_gaps(scene: Scene) -> list[str]:
    """Numbers that no camera has between frames that are numbered one by one."""
    keys = [natural_key(frame) for frame in scene.frames]
    if len(keys) < 3 or any(key[:-2] != keys[0][:-2] or key[-1][0] for key in keys):
        return []
    numbers = np.array([key[-2][1] for key in keys])
    steps = np.diff(numbers)
    usual = int(np.median(steps))
    wide = np.flatnonzero(steps > usual) if usual > 0 else np.empty(0, dtype=int)
    if not len(wide):
        return []
    texts = [f"between {scene.frames[k]} and {scene.frames[k + 1]}" for k in wide[:_LISTED]]
    rest = f" and at {len(wide) - _LISTED} more places" if len(wide) > _LISTED else ""
    missing = int((steps[wide] // usual - 1).sum())
    text = (
        f"{missing} frames dropped by all cameras {', '.join(texts)}{rest}; the times of all later "
        "frames count on without them"
    )
    return [text]
