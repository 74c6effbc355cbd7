"""Which files of a scene's folder are masks, of which camera and frame, and which are left over."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path

from drake_pose.errors import SceneError
from drake_pose.silhouette.pictures.video_pictures import VIDEOS, VideoPictures

_SUFFIX = ".png"
_IMAGES = (".png", ".jpg", ".jpeg")
_NUMBER = re.compile("([0-9]+)")


@dataclass(frozen=True)
class Leftovers:
    """What lies in a scene's folder and is not used.

    ``uncalibrated`` counts masks in folders of no camera; ``doubled``: further masks of the same
    (camera, frame); ``foreign``: files that are no masks, "" for those in no camera's folder.
    """

    uncalibrated: Mapping[str, int] = field(default_factory=dict)
    doubled: Mapping[tuple[str, str], tuple[Path, ...]] = field(default_factory=dict)
    foreign: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class SceneFiles:
    """A scene's mask files by (camera, frame), its frames in natural order, and what is left."""

    masks: Mapping[tuple[str, str], Path]
    frames: tuple[str, ...]
    leftovers: Leftovers = field(default_factory=Leftovers)


def natural_key(name: str) -> tuple[tuple[str, int], ...]:
    """What names are sorted by: texts and the numbers in them in turn, so that 2 precedes 10."""
    texts = _NUMBER.split(name)
    return tuple(zip(texts[::2], [*map(int, texts[1::2]), -1], strict=True))


def close_names(name: str, known: Iterable[str]) -> list[str]:
    """Those known names that a misspelt one may stand for."""
    lower = {one.lower(): one for one in known}
    return [lower[one] for one in get_close_matches(name.lower(), lower, n=2)]


def find_masks(folder: Path, cameras: Iterable[str]) -> SceneFiles:
    """Finds masks/<camera>/<frame>.png, or masks/<frame>.png of a single camera.

    Hidden files are passed over. Folders that belong to no camera, and files that are no PNG
    pictures, are left over. Cameras that number their frames with and without leading zeros mean
    the same frames.

    Raises:
        SceneError: names a folder that cannot be read or holds no masks of a camera.
    """
    names = list(cameras)
    root = folder / "masks"
    if not root.is_dir():
        raise SceneError(f"{folder}: has no folder masks/<camera>/<frame>.png")
    flat, foreign = _list_pictures(root)
    folders = [entry.name for entry in _visible(root) if entry.is_dir()]
    found = {name: _list_pictures(root / name) for name in folders}
    known = {name: found[name][0] for name in names if name in found}
    strangers = {name: len(files) for name, (files, _) in found.items() if name not in names}
    if flat and not any(known.values()):
        if len(names) != 1:
            raise SceneError(
                f"{root}: masks that lie in no camera's folder need exactly one camera, but there "
                f"are {len(names)}: {', '.join(names)}"
            )
        known, flat = {names[0]: flat}, []
    if not any(known.values()):
        raise SceneError(_no_masks(root, names, strangers, found))
    masks, frames, doubled = _join_frames(known)
    beside = [name for name in foreign if not name.endswith("/")]
    others = {"": (*beside, *(path.name for path in flat))}
    others |= {name: found[name][1] for name in names if name in found}
    kept = {name: files for name, files in others.items() if files}
    return SceneFiles(masks, frames, Leftovers(strangers, doubled, kept))


def find_images(
    folder: Path, cameras: Iterable[str], frames: Iterable[str] = ()
) -> dict[tuple[str, str], Path]:
    """Finds images/<camera>/<frame>.png or .jpg by (camera, frame); none where there is no folder.

    Of a camera without such a folder the video videos/<camera>.mp4 is each of its frames, which are
    named 000000, 000001 and so on, or as known ``frames`` of these numbers are named already.

    Raises:
        SceneError: a folder or video that cannot be read.
    """
    found: dict[tuple[str, str], Path] = {}
    known = {int(frame): frame for frame in frames if frame.isdecimal()}
    for camera in cameras:
        own = folder / "images" / camera
        if own.is_dir():
            names = [entry.name for entry in _visible(own) if not entry.is_dir()]
            pictures = [Path(name) for name in names if Path(name).suffix.lower() in _IMAGES]
            found |= {(camera, name.stem): own / name for name in pictures}
            continue
        video = find_video(folder, camera)
        if video is not None:
            count = VideoPictures(video).count
            names = [known.get(number, f"{number:06d}") for number in range(count)]
            found |= {(camera, name): video for name in names}
    return found


def find_video(folder: Path, camera: str) -> Path | None:
    """The video of a camera in a scene's folder; None where there is none."""
    files = [folder / "videos" / f"{camera}{suffix}" for suffix in VIDEOS]
    return next((file for file in files if file.is_file()), None)


def _no_masks(
    root: Path,
    names: list[str],
    strangers: Mapping[str, int],
    found: Mapping[str, tuple[list[Path], tuple[str, ...]]],
) -> str:
    """What to say where no camera has a mask."""
    text = f"{root}: holds no mask <camera>/<frame>.png of: {', '.join(names)}"
    if strangers:
        text += f"; folder {', '.join(strangers)} belongs to no camera of the camera file"
    others = [f"{name}/{file}" for name in names if name in found for file in found[name][1]]
    if others:
        text += f"; {others[0]} is {'a folder' if others[0].endswith('/') else 'no PNG picture'}"
    return text


def _visible(folder: Path) -> list[os.DirEntry[str]]:
    """A folder's entries by name, but for hidden ones, such as those that macOS leaves behind."""
    try:
        with os.scandir(folder) as entries:
            seen = [entry for entry in entries if not entry.name.startswith(".")]
    except OSError as error:
        raise SceneError(f"{folder}: cannot be read: {error.strerror}") from error
    return sorted(seen, key=lambda entry: entry.name)


def _list_pictures(folder: Path) -> tuple[list[Path], tuple[str, ...]]:
    """The PNG files of a folder, and the names of its other files."""
    pictures, others = [], []
    for entry in _visible(folder):
        if entry.is_dir():
            others.append(f"{entry.name}/")
        elif entry.name.lower().endswith(_SUFFIX):
            pictures.append(folder / entry.name)
        else:
            others.append(entry.name)
    return pictures, tuple(others)


def _join_frames(
    files: Mapping[str, list[Path]],
) -> tuple[dict[tuple[str, str], Path], tuple[str, ...], dict[tuple[str, str], tuple[Path, ...]]]:
    """Masks by camera and frame, the frames, and what is there twice."""
    stems = {file: file.stem for own in files.values() for file in own}
    spelt = sorted(set(stems.values()), key=lambda stem: (-len(stem), stem))
    keys = {stem: natural_key(stem) for stem in spelt}
    name_of = {stem: stem for stem in spelt}
    if sum(bool(own) for own in files.values()) > 1:
        first: dict[tuple[tuple[str, int], ...], str] = {}
        name_of = {stem: first.setdefault(keys[stem], stem) for stem in spelt}
    masks: dict[tuple[str, str], Path] = {}
    doubled: dict[tuple[str, str], tuple[Path, ...]] = {}
    for camera, own in files.items():
        for file in sorted(own, key=lambda file: (-len(stems[file]), file.name)):
            key = camera, name_of[stems[file]]
            if key in masks:
                doubled[key] = (*doubled.get(key, ()), file)
            else:
                masks[key] = file
    frames = sorted({frame for _, frame in masks}, key=lambda name: (keys[name], name))
    order = {frame: k for k, frame in enumerate(frames)}
    cameras = {camera: k for k, camera in enumerate(files)}
    listed = sorted(masks, key=lambda key: (cameras[key[0]], order[key[1]]))
    return {key: masks[key] for key in listed}, tuple(frames), doubled
