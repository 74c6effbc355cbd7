"""Checks of scenes with several cameras: each fault becomes a warning that names it."""

import filecmp
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from drake_pose.arrays import Mask
from drake_pose.camera.models import Camera, intrinsics_warnings
from drake_pose.camera.picture_files import natural_key
from drake_pose.errors import MaskError, SceneError
from drake_pose.input_files import require_regular
from drake_pose.silhouette.pictures.scenes import Scene, load_scene


def read_scene(
    path: Path,
    wanted: Sequence[str],
    frames: Sequence[str],
    cameras: Mapping[str, Camera] | None,
    every: int,
    sequence: bool = False,
) -> tuple[Scene, tuple[str, ...]]:
    """Return a checked scene of the wanted cameras, and the names of its frames.

    These are the wanted frames that are kept and have a mask or a picture, in the scene's order.

    Args:
        path: the scene's folder.
        wanted: names of cameras; empty: all that have files.
        frames: names of frames, or ranges ``FIRST:LAST``; empty: all.
        cameras: cameras by name that replace those of the folder; None: the folder's.
        every: every n-th frame is kept, the first wanted one included.
        sequence: whether the scene is a sequence if its scene.yaml does not say.

    Raises DrakePoseError, which names the file, camera or frame that is invalid or missing.
    """
    scene = check_scene(load_scene(path, cameras, wanted, sequence)).of_cameras(wanted)
    scene, frames = scene.every(every, frames)
    return scene, scene.frames_with_files(frames)


def check_scene(scene: Scene) -> Scene:
    """Return a scene with warnings, without frozen cameras' masks; ``scale_unknown``: unchanged."""
    if scene.scale_unknown:
        return scene
    known, files = scene.frames, {*scene.masks, *scene.images}
    warnings = [*scene.warnings, *intrinsics_warnings(scene.cameras.values())]
    several = len(scene.cameras) > 1
    for name in scene.cameras if several else ():
        missing = [frame for frame in known if (name, frame) not in files]
        if count := (len(known) - len(missing)) * bool(missing):
            warnings.append(
                f"camera '{name}' has {count} of {len(known)} frames; it lacks "
                f"{frame_ranges(missing, known)}, which are estimated without it"
            )
    if scene.sequence and not scene.images:
        warnings += _check_gaps(known)
        if several:
            frozen, repeated = _find_repeats(scene)
            removed = {(name, frame) for name, frames in frozen.items() for frame in frames}
            masks = {key: path for key, path in scene.masks.items() if key not in removed}
            scene = replace(scene, masks=masks)
            warnings += [
                f"camera '{name}' shows its last picture again in frame "
                f"{frame_ranges(frames, known)}, while the others' changed: left out there; did "
                "the camera freeze or drop frames?"
                for name, frames in frozen.items()
            ]
            if repeated:
                warnings.append(
                    f"frame {frame_ranges(repeated, known)}: all cameras show the previous frame "
                    "again; was it recorded twice?"
                )
    return replace(scene, warnings=tuple(warnings))


def check_upright(cameras: Iterable[Camera], min_component: float = 0.5) -> tuple[str, ...]:
    """Return no warning if up in the pictures is the world's z, as persons require, else one.

    ``min_component``: there is no warning if all components of the mean up direction are smaller,
    since the cameras then look so steeply that up is undetermined.
    """
    up = -np.mean([camera.X_WC[:3, 1] for camera in cameras], axis=0)
    axis = int(np.argmax(np.abs(up)))
    if (axis == 2 and up[2] > 0.0) or abs(up[axis]) < min_component:
        return ()
    return (
        f"cameras.yaml: up in the pictures is the world's {'+' if up[axis] > 0.0 else '-'}"
        f"{'xyz'[axis]}, but should be +z: the world lies on its side or upside down; rotate X_WC",
    )


def leave_out_unreadable(scene: Scene, frames: Iterable[str]) -> Scene:
    """Return a scene without unreadable masks of frames of which other cameras' can be read.

    A mask without an object counts as unreadable. The scene gets one warning for each camera.

    ``frames``: names of the frames that are checked.

    Raises MaskError: a mask cannot be read, and no other camera has a readable one of that frame.
    """
    refused: dict[tuple[str, str], str] = {}
    for frame in frames:
        errors: dict[str, MaskError] = {}
        present = scene.cameras_of(frame)
        for name in present:
            try:
                scene.read(name, frame)
            except MaskError as error:
                errors[name] = error
        if present and len(errors) == len(present):
            raise errors[present[0]]
        refused |= {(name, frame): str(error) for name, error in errors.items()}
    masks = {key: path for key, path in scene.masks.items() if key not in refused}
    texts = describe_unreadable(refused, scene.frames)
    return replace(scene, masks=masks, warnings=(*scene.warnings, *texts))


def require_readable(refused: Mapping[tuple[str, str], str], scene: Scene) -> None:
    """Raise SceneError, with the first reason by (camera, frame), if all masks were refused."""
    if refused and len(refused) == len(scene.masks):
        first = next(iter(refused.values()))
        raise SceneError(f"{scene.path}: none of {len(refused)} masks can be used: {first}")


def describe_unreadable(
    refused: Mapping[tuple[str, str], str], known: Sequence[str]
) -> tuple[str, ...]:
    """Return one warning per camera about refused masks (camera, frame); known: all frames."""
    found = []
    for camera in dict.fromkeys(name for name, _ in refused):
        frames = [frame for name, frame in refused if name == camera]
        first = refused[camera, frames[0]]
        found.append(f"frame {frame_ranges(frames, known)} without camera '{camera}': {first}")
    return tuple(found)


def frame_ranges(frames: Iterable[str], known: Sequence[str], max_ranges: int = 6) -> str:
    """Return frames as at most ``max_ranges`` ranges first-last, in the order of ``known``."""
    order = {frame: k for k, frame in enumerate(known)}
    places = np.sort([order[frame] for frame in frames]).astype(int)
    runs = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1) if len(places) else []
    texts = [known[run[0]] + (f"-{known[run[-1]]}" if len(run) > 1 else "") for run in runs]
    rest = sum(map(len, runs[max_ranges:]))
    return ", ".join(texts[:max_ranges]) + (f" and {rest} more" if rest else "")


def _find_repeats(scene: Scene, min_change: float = 0.02) -> tuple[dict[str, list[str]], list[str]]:
    """Return the frames in which a camera alone repeats, by camera; and those in which all do.

    ``min_change``: change of the other cameras' silhouettes, as a fraction of their area, from
    which a camera that shows no change is frozen.
    """
    # Masks whose file equals that of the frame before; unreadable ones are not repeated.
    repeats = set[tuple[str, str]]()
    for name in scene.cameras:
        before: tuple[Path, int] | None = None
        for frame in scene.frames:
            path, size = scene.masks.get((name, frame)), None
            if path is not None:
                with suppress(OSError):
                    size = require_regular(path)
                    if before and before[1] == size and filecmp.cmp(before[0], path, shallow=False):
                        repeats.add((name, frame))
            before = None if path is None or size is None else (path, size)
    frozen: dict[str, list[str]] = {}
    repeated = []
    for last, frame in pairwise(scene.frames):
        both = [name for name in scene.cameras_of(frame) if (name, last) in scene.masks]
        alike = [name for name in both if (name, frame) in repeats]
        others = [name for name in both if name not in alike]
        if len(both) > 1 and not others:
            repeated.append(frame)
        elif alike and len(others) > len(alike):
            changes = []
            for name in others:
                with suppress(MaskError):
                    a, b = (scene.read(name, f, may_be_empty=True) for f in (last, frame))
                    changes.append((a != b).sum() / max(a.sum(), b.sum(), 1))
            if changes and float(np.median(changes)) > min_change:
                for name in alike:
                    frozen.setdefault(name, []).append(frame)
    return frozen, repeated


def _check_gaps(frames: Sequence[str]) -> list[str]:
    """Return one warning about numbers missing between consecutively numbered frames, or none.

    Numbers are missing where a step between frames is twice the median step or more. Names that
    differ in more than the last number are not consecutive.
    """
    keys = [natural_key(frame) for frame in frames]
    if len(keys) < 3 or any(key[-1][0] for key in keys):
        return []
    if len({(key[:-2], key[-2][0]) for key in keys}) > 1:
        return []
    steps = np.diff([key[-2][1] for key in keys])
    usual_step = max(1, int(np.median(steps)))
    missing = steps // usual_step - 1
    wide = np.flatnonzero(missing > 0)
    if not len(wide):
        return []
    count, first = missing[wide].sum(), wide[0]
    return [
        f"{count} frames dropped by all cameras, the first between {frames[first]} and "
        f"{frames[first + 1]}; the times of all later frames do not include them"
    ]


def read_mask_of(
    scene: Scene,
    camera: str,
    frame: str,
    *,
    may_be_empty: bool,
    most: float = 0.5,
    most_of_edge: float = 0.75,
) -> Mask:
    """Return a camera's mask (H, W) of a frame.

    ``camera``, ``frame``: their names. ``may_be_empty``: whether a mask without the body is
    accepted. ``most``, ``most_of_edge``: a mask is inverted if the body fills more than these
    fractions of both the picture and its edge.

    Raises MaskError: the mask cannot be read, is empty and must not be, or is inverted.
    """
    mask = scene.read(camera, frame, may_be_empty=may_be_empty)
    edge = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    if edge.mean() > most_of_edge and (fraction := float(mask.mean())) > most:
        raise MaskError(
            f"{scene.masks[camera, frame]}: white fills {100.0 * fraction:.0f} % of the picture "
            "and its edge: the mask seems to be inverted; the body must be white, all else black"
        )
    return mask
