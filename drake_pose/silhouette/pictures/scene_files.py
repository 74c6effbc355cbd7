"""Which files of a scene's folder are masks, of which camera and frame, and which are left over."""

import os
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

from drake_pose.camera.picture_files import (
    SUFFIXES,
    VIDEOS,
    VideoPictures,
    frame_number,
    in_order,
    natural_key,
)
from drake_pose.errors import SceneError, SettingsError, UnknownNameError

# Rates of videos that differ by more were not meant to be one.
_RATES = 1.01


class MaskFiles(NamedTuple):
    """A scene's mask files by (camera, frame), folders of no camera, and what is not used."""

    masks: dict[tuple[str, str], Path]
    strangers: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def common_rate(videos: Mapping[str, Path]) -> tuple[float | None, tuple[str, ...]]:
    """Pictures a second of cameras' videos, if one says so; a warning where they drift apart.

    Raises SceneError: a video cannot be read, or their rates are others.
    """
    opened = {name: VideoPictures(path) for name, path in videos.items()}
    rates = {name: one.rate_hz for name, one in opened.items() if one.rate_hz is not None}
    if not rates:
        return None, ()
    slow, fast = min(rates, key=lambda one: rates[one]), max(rates, key=lambda one: rates[one])
    ratio = rates[fast] / rates[slow]
    off = min(one.count for one in opened.values()) * (ratio - 1.0)
    text = (
        f"{videos[slow]} has {rates[slow]:.5g} pictures a second, {videos[fast]} {rates[fast]:.5g}:"
        f" pictures of one number must be of one moment, but at the end they are {off:.0f} "
        "pictures apart; bring the videos to one rate (ffmpeg -i VIDEO -r RATE NEW)"
    )
    if ratio > _RATES:
        raise SceneError(text)
    return next(iter(rates.values())), (text,) if off >= 1.0 else ()


def select_frames(known: Sequence[str], wanted: Sequence[str], where: str) -> tuple[str, ...]:
    """Returns the frames that were asked for, in the scene's order.

    Args:
        wanted: names, or ranges ``FIRST:LAST`` that include both ends; all frames where empty.
            A number stands for the frame whose name is that number, with or without zeros before.
        where: the scene, for messages.

    Raises:
        UnknownNameError: there is no such frame.
        SettingsError: a range ends before it begins.
    """
    places = {frame: k for k, frame in enumerate(known)}

    def place(name: str) -> int:
        if name in places:
            return places[name]
        number = frame_number(name)
        same = [k for k, frame in enumerate(known) if frame_number(frame) == number]
        if number is None or len(same) != 1:
            raise UnknownNameError("frame", name, known, where)
        return same[0]

    chosen: set[int] = set()
    for text in wanted:
        first, colon, last = (text, "", "") if text in places else text.partition(":")
        ends = place(first), place(last if colon else first)
        if ends[1] < ends[0]:
            raise SettingsError(f"--frame: the range '{text}' ends before it begins")
        chosen.update(range(ends[0], ends[1] + 1))
    return tuple(frame for k, frame in enumerate(known) if k in chosen or not wanted)


def find_masks(folder: Path, cameras: Iterable[str]) -> MaskFiles:
    """Finds masks/<camera>/<frame>.png, or masks/<frame>.png of a single camera.

    Hidden files are passed over. Folders that belong to no camera, and files that are no PNG
    pictures, are left over. Cameras that number their frames with and without leading zeros mean
    the same frames.

    Raises SceneError: names a folder that cannot be read or holds no masks of a camera.
    """
    names = list(cameras)
    root = folder / "masks"
    if not root.is_dir():
        raise SceneError(f"{folder}: has no folder masks/<camera>/<frame>.png")
    flat, foreign = _list_pictures(root)
    found = {
        entry.name: _list_pictures(root / entry.name) for entry in _visible(root) if entry.is_dir()
    }
    known = {name: found[name][0] for name in names if name in found}
    strangers = {name: len(files) for name, (files, _) in found.items() if name not in names}
    if flat and not any(known.values()):
        if len(names) != 1:
            raise SceneError(
                f"{root}: masks that lie in no camera's folder need exactly one camera, but there "
                f"are {len(names)}: {', '.join(names)}"
            )
        known, flat = {names[0]: flat}, []
    others = {name: found[name][1] for name in names if name in found}
    if not any(known.values()):
        raise SceneError(_no_masks(root, names, strangers, others))
    beside = [name for name in foreign if not name.endswith("/")]
    others[""] = [*beside, *(path.name for path in flat)]
    masks, doubled = _join_frames(known)
    warnings = [
        *_say_unused(strangers, [name for name in names if not known.get(name)]),
        *doubled,
        *(
            f"{f'masks/{name}' if name else 'masks'}: {files[0]}"
            f"{f' and {len(files) - 1} more' if len(files) > 1 else ''} left out: masks are PNG "
            "pictures in masks/<camera>"
            for name, files in others.items()
            if files
        ),
    ]
    return MaskFiles(masks, tuple(strangers), tuple(warnings))


def find_images(
    folder: Path, cameras: Iterable[str], frames: Iterable[str] = ()
) -> dict[tuple[str, str], Path]:
    """Finds images/<camera>/<frame>.png or .jpg by (camera, frame); none where there is no folder.

    Of a camera without such a folder the video videos/<camera>.mp4 is each of its frames, which are
    named 000000, 000001 and so on, or as known ``frames`` of these numbers are named already.

    Raises SceneError: a folder or video that cannot be read.
    """
    found: dict[tuple[str, str], Path] = {}
    known = {int(frame): frame for frame in frames if frame.isdecimal()}
    for camera in cameras:
        own = folder / "images" / camera
        videos = [folder / "videos" / f"{camera}{suffix}" for suffix in VIDEOS]
        if own.is_dir():
            names = [Path(entry.name) for entry in _visible(own) if not entry.is_dir()]
            pictures = [name for name in names if name.suffix.lower() in SUFFIXES]
            found |= {(camera, name.stem): own / name for name in pictures}
        elif video := next((file for file in videos if file.is_file()), None):
            numbers = range(VideoPictures(video).count)
            # No picture takes less than a byte. A recording that was not closed has no number.
            if not 0 < len(numbers) <= video.stat().st_size:
                raise SceneError(
                    f"{video}: does not say how many pictures it has, or more than it can hold; "
                    f"make it whole: ffmpeg -i {video.name} -c copy NEW"
                )
            found |= {(camera, known.get(k, f"{k:06d}")): video for k in numbers}
    return found


def _no_masks(
    root: Path, names: Sequence[str], strangers: Iterable[str], others: Mapping[str, Sequence[str]]
) -> str:
    """What to say where no camera has a mask."""
    text = f"{root}: holds no mask <camera>/<frame>.png of: {', '.join(names)}"
    if listed := ", ".join(strangers):
        text += f"; folder {listed} belongs to no camera of the camera file"
    if files := [f"{name}/{file}" for name, own in others.items() for file in own]:
        text += f"; {files[0]} is {'a folder' if files[0].endswith('/') else 'no PNG picture'}"
    return text


def _say_unused(strangers: Mapping[str, int], unused: Sequence[str]) -> list[str]:
    """Folders without calibration, and cameras without masks."""
    lower = {name.lower(): name for name in unused}
    found = []
    for name, count in strangers.items():
        close = get_close_matches(name.lower(), lower, n=1)
        advice = f"is it '{lower[close[0]]}'?" if close else "calibrate it"
        found.append(
            f"masks/{name}: no camera '{name}' in cameras.yaml; its {count} masks are left out: "
            f"{advice}"
        )
    return found + [
        f"camera '{name}' of cameras.yaml has no masks in masks/{name}; the others go on"
        for name in unused
    ]


def _visible(folder: Path) -> list[os.DirEntry[str]]:
    """A folder's entries by name, but for hidden ones, such as those that macOS leaves behind."""
    try:
        with os.scandir(folder) as entries:
            seen = [entry for entry in entries if not entry.name.startswith(".")]
    except OSError as error:
        raise SceneError(f"{folder}: cannot be read: {error.strerror}") from error
    for entry in seen:
        # Python stands in for the bytes of other encodings by what cannot be written to any file.
        if any("\ud800" <= character <= "\udfff" for character in entry.name):
            raise SceneError(f"{folder}: the name {entry.name!r} is no UTF-8 text; rename it")
    return sorted(seen, key=lambda entry: entry.name)


def _list_pictures(folder: Path) -> tuple[list[Path], list[str]]:
    """The PNG files of a folder, and the names of its other files."""
    pictures, others = [], []
    for entry in _visible(folder):
        if entry.is_dir():
            others.append(f"{entry.name}/")
        elif entry.name.lower().endswith(".png"):
            pictures.append(folder / entry.name)
        else:
            others.append(entry.name)
    return pictures, others


def _join_frames(
    files: Mapping[str, Sequence[Path]],
) -> tuple[dict[tuple[str, str], Path], list[str]]:
    """Masks by camera and frame, whose longest spelling is its name, and what is there twice."""
    spelt = {file.stem for own in files.values() for file in own}
    several = sum(map(bool, files.values())) > 1
    first: dict[object, str] = {}
    name_of = {
        stem: first.setdefault(natural_key(stem) if several else stem, stem)
        for stem in sorted(spelt, key=lambda stem: (-len(stem), stem))
    }
    masks: dict[tuple[str, str], Path] = {}
    doubled = []
    for camera, own in files.items():
        by_frame: dict[str, list[Path]] = {}
        for file in sorted(own, key=lambda file: (-len(file.stem), file.name)):
            by_frame.setdefault(name_of[file.stem], []).append(file)
        for frame in in_order(by_frame):
            used, *again = by_frame[frame]
            masks[camera, frame] = used
            if again:
                names = ", ".join(file.name for file in again)
                doubled.append(
                    f"camera '{camera}', frame {frame}: {used.name} is used, {names} is the same "
                    "frame again"
                )
    return masks, doubled
