"""The ways to find masks: other tools', by a box, a network, the empty room, the model."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from drake_pose.body import load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.camera.picture_files import SUFFIXES, Mask, Picture, read_picture
from drake_pose.camera.source_files import find_picture_files
from drake_pose.errors import (
    CameraError,
    MaskError,
    SceneError,
    SettingsError,
    UnknownNameError,
)
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.searches import make_tree
from drake_pose.jobs.masks.settings import MEDIAN, MaskSettings
from drake_pose.jobs.masks.sources import FoundMask, Source
from drake_pose.jobs.registration.positions import read_known_positions
from drake_pose.search import (
    FoundPose,
    PoseAndMask,
    PoseAndMaskSettings,
)
from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.pictures.scene_files import in_order
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE
from drake_pose.silhouette.segmentation.background import (
    Background,
    background_of_recording,
    background_support,
    cut_box,
    learn_background,
    person_region,
)
from drake_pose.silhouette.segmentation.mask_pictures import (
    ALL,
    mask_of_video_picture,
    read_mask_picture,
)
from drake_pose.silhouette.segmentation.network import SegmentationNetwork

# This many pictures of a recording make its median.
_MOST = 60
# Where less than this fraction of a recording shows the median it may be the body's.
_SUPPORT = 0.75
# A background is not good where so much of the masks is in doubt.
_DOUBTFUL = 0.5
# The light or the camera has changed where so much of a picture is off.
_CHANGED = 0.6
# A mask that is nearly all of its box, or nearly none, was not told from its surroundings.
_ALL_OF_BOX, _NONE_OF_BOX = 0.95, 0.03
REFUSED = 0.85
"""A mask and what else its picture tells that overlap less (IoU) do not agree."""
_DOUBTED = 0.9
# A value so many standard deviations from its start is suspicious.
_FAR = 3.0

# What a picture tells well is found with a box so much smaller or larger, as a share of its side,
# and with thresholds so many times as large, too.
_BOX_SHARES, _THRESHOLDS = (-0.05, 0.05), (0.7, 1.4)
# A body that is within a share of its size of one place in so many of a recording's pictures stays
# there: 0.8 and more of simulated arms, 0.3 of who walks by.
_ABOUT, _STAYS = 0.3, 0.6

Find = Callable[[str, Picture], tuple[Mask, float, tuple[str, ...]]]
"""The mask of a camera's picture, how well that tells it, and what its user should look at."""


def find_masks(source: Source, settings: MaskSettings) -> Iterator[FoundMask]:
    """The masks of a source, one by one, in the way that the settings choose.

    Raises DrakePoseError: names the file, camera or frame at fault.
    """
    background = settings.background
    if settings == MaskSettings(largest=settings.largest, cameras=settings.cameras):
        # Beside its pictures a scene may have those of the empty room, which say what is meant.
        room = source.path / "background"
        background = room if room.is_dir() else None
    if all(way is None for way in (background, settings.box, settings.model, settings.network)):
        return _read_given(source, settings)
    if source.annotated:
        raise SceneError(
            f"{source.path}: has annotations, but the object is to be found in pictures"
        )
    if background is None and settings.box is None and settings.model is not None:
        return _find_by_model(source, settings.model, settings)
    if background is not None:
        return _find_each(source, _by_empty_room(source, background))
    if settings.box is not None:
        return _find_each(source, partial(_by_box, settings.box))
    assert settings.network is not None
    network = SegmentationNetwork(
        settings.network, settings.classes, settings.network_size, settings.network_mean,
        settings.network_std, settings.network_bgr,
    )  # fmt: skip
    return _find_each(source, lambda _, picture: (network.find(picture), math.nan, ()))


def _find_each(source: Source, find: Find) -> Iterator[FoundMask]:
    """What is found in each picture by itself; errors name the picture."""
    for camera in source.names:
        for frame, where, picture in source.read(camera):
            try:
                mask, agreement, warnings = find(camera, picture)
            except (SceneError, SettingsError) as error:
                raise type(error)(f"{where}: {error}") from error
            yield FoundMask(camera, frame, where, mask, picture, "", warnings, agreement)


def _read_given(source: Source, settings: MaskSettings) -> Iterator[FoundMask]:
    """Masks of other tools in COCO files, pictures or videos."""
    if source.annotated:
        yield from _read_annotated(source, settings.classes)
    for camera, files in source.pictures.items():
        for frame, path in files.items():
            mask = read_mask_picture(path, settings.pixels, settings.classes)
            source.check_size(camera, mask.shape, str(path))
            yield FoundMask(camera, frame, str(path), mask)
    for camera in source.videos:
        for frame, where, picture in source.read(camera):
            yield FoundMask(camera, frame, where, mask_of_video_picture(picture, where))


def _read_annotated(source: Source, wanted: Sequence[str]) -> Iterator[FoundMask]:
    files = [coco for _, coco in source.annotated]
    known = sorted({name for coco in files for name in coco.classes})
    numbers = {number: name for coco in files for number, name in coco.names.items()}
    classes = {name if name in known else numbers.get(name, name) for name in wanted}
    if not wanted and len(known) > 1:
        raise MaskError(
            f"{source.path}: has the classes {', '.join(known)}; say which are the object: "
            f"--class '{known[0]}', or --class all"
        )
    if not wanted or ALL in wanted:
        classes = set(known)
    for name in classes - set(known):
        raise UnknownNameError("class", name, known, str(source.path))
    for camera, frame, coco, picture in source.annotated_pictures():
        where = f"{coco.path}: picture '{picture.file}'"
        source.check_size(camera, (picture.height, picture.width), where)
        try:
            mask = picture.draw(classes)
        except ValueError as error:
            raise MaskError(f"{where}: {error}") from error
        warnings = coco.warnings if picture is coco.pictures[0] else ()
        yield FoundMask(camera, frame, where, mask, warnings=warnings)


def _by_box(box: Sequence[float], _: str, picture: Picture) -> tuple[Mask, float, tuple[str, ...]]:
    """GrabCut within x, y, width and height [pixel]."""
    mask, (x, y, w, h) = cut_box(picture, box), box
    part = mask.sum() / (w * h)
    is_good = part == 0.0 or _NONE_OF_BOX <= part <= _ALL_OF_BOX
    again = []
    for share in _BOX_SHARES:
        # Around a larger one there may be nothing left.
        with suppress(SettingsError):
            other = (x - share * w, y - share * h, w + 2.0 * share * w, h + 2.0 * share * h)
            again.append(cut_box(picture, other))
    warnings = () if is_good else (f"the mask is {part:.1%} of its box: find it another way",)
    return mask, _agreement(mask, again), warnings


def _agreement(mask: Mask, again: Iterable[Mask]) -> float:
    """The least IoU of a mask and those that were found otherwise; nan where there is none."""
    return min((intersection_over_union(mask, one) for one in again), default=math.nan)


def _by_empty_room(source: Source, background: Path | str) -> Find:
    """What differs from the background, as of ``MaskSettings.background``."""
    known = {name: _background(source, name, background) for name in source.names}
    doubts = {name: told for name, (_, told) in known.items()}
    rooms = {
        name: [replace(room, deviation=times * room.deviation) for times in (1.0, *_THRESHOLDS)]
        for name, (room, _) in known.items()
    }

    def find(camera: str, picture: Picture) -> tuple[Mask, float, tuple[str, ...]]:
        room = rooms[camera][0]
        if picture.shape != room.mean.shape:
            height, width = room.mean.shape[:2]
            raise SceneError(
                f"is not of the background's size, {width} x {height} (width x height)"
            )
        mask, *again = (person_region(picture, one) for one in rooms[camera])
        # A bad background is told of once.
        warnings = doubts.pop(camera, ())
        if mask.mean() > _CHANGED:
            warnings += (
                f"{mask.mean():.0%} of it differ from the background: did the light change, or "
                "the camera move?",
            )
        return mask, _agreement(mask, again), warnings

    return find


def _background(
    source: Source, camera: str, given: Path | str
) -> tuple[Background, tuple[str, ...]]:
    """A camera's background, and why it is not good."""
    if given == MEDIAN:
        recording = _spread_pictures(source, camera)
        try:
            room = background_of_recording(recording)
        except SettingsError as error:
            raise SettingsError(f"camera '{camera}': {error}") from error
        return room, _doubt(room, recording)
    pictures = []
    for file in _background_files(Path(given), camera):
        pictures.append(read_picture(file, SceneError))
        source.check_size(camera, pictures[-1].shape, str(file))
    return learn_background(pictures), ()


def _background_files(given: Path, camera: str) -> list[Path]:
    """The pictures of the empty room before a camera."""
    if (given / camera).is_dir():
        return list(find_picture_files(given / camera, camera).values())
    for file in (given, *(given / f"{camera}{suffix}" for suffix in SUFFIXES)):
        if file.is_file():
            return [file]
    raise SceneError(
        f"{given}: has no picture of the empty room before camera '{camera}': {camera}.png, or a "
        f"folder {camera}; or give --background median"
    )


def _spread_pictures(source: Source, camera: str) -> list[Picture]:
    """Some pictures, spread evenly over a recording whose length nobody knows."""
    kept: list[Picture] = []
    step = 1
    for k, (_, where, picture) in enumerate(source.read(camera)):
        if kept and picture.shape != kept[0].shape:
            raise SceneError(f"{where}: has another size than the pictures before")
        if k % step == 0:
            kept.append(picture)
            if len(kept) == 2 * _MOST:
                kept, step = kept[::2], 2 * step
    return kept


def _doubt(room: Background, recording: Sequence[Picture]) -> tuple[str, ...]:
    """Why a recording's median is no good background."""
    support = background_support(recording, room)
    masks = [person_region(picture, room) for picture in recording]
    doubtful = [float((support[mask] < _SUPPORT).mean()) for mask in masks if mask.any()] or [0.0]
    part = float(np.median(doubtful))
    text = (
        f"the median of {len(recording)} pictures is no good background, here and in this camera's "
        f"other pictures: in {part:.0%} of the masks' area it is seen in fewer than three of four "
        "pictures, so the body may stand in it; give pictures of the empty room, or a longer "
        "recording in which the body leaves every place"
    )
    texts: tuple[str, ...] = (text,) if part > _DOUBTFUL else ()
    seen = [mask.astype(np.uint8) for mask in masks if mask.any()]
    size = math.sqrt(float(np.median([mask.sum() for mask in seen] or [0])))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(_ABOUT * size) + 1,) * 2)
    about = sum((cv2.dilate(mask, disc).astype(np.float32) for mask in seen), np.zeros((1, 1)))
    if about.max() > _STAYS * len(masks):
        y, x = np.unravel_index(int(np.argmax(about)), about.shape)
        texts += (
            f"this camera's pictures show what moves about one place, ({x}, {y}): what of it "
            "stands still there, as an arm's base does, is taken for the empty room and is not in "
            "the masks; give pictures of the empty room",
        )
    return texts


def _find_by_model(source: Source, model: Path, settings: MaskSettings) -> Iterator[FoundMask]:
    """The masks of a body whose pose is about known in each frame (``settings.start``)."""
    assert settings.start is not None
    cameras = _placed_cameras(source)
    body = load_model(model, package_paths=settings.packages)
    kinematics = TreeKinematics(make_tree(body, EstimateSettings(hold=settings.hold)))
    table = read_known_positions(settings.start, kinematics)
    seen = {
        name: {frame: (where, picture) for frame, where, picture in source.read(name)}
        for name in source.names
    }
    frames = in_order(frame for own in seen.values() for frame in own)
    starts = [table.of(one, next(name for name in seen if one in seen[name])) for one in frames]
    pictures = [[own[one][1] if one in own else None for own in seen.values()] for one in frames]
    how = PoseAndMaskSettings(angle=math.radians(settings.start_error))
    poses = PoseAndMask(kinematics, cameras, how).run(pictures, starts)
    found, warned = dict(zip(frames, poses, strict=True)), table.warnings
    for c, (name, own) in enumerate(seen.items()):
        for frame, pose in found.items():
            mask = pose.masks[c]
            if mask is not None:
                where, picture = own[frame]
                refusal, warnings = _judge(pose, c, kinematics.names)
                told = (*warned, *warnings)
                agreed = pose.agreements[c]
                yield FoundMask(name, frame, where, mask, picture, refusal, told, agreed)
                warned = ()


def _placed_cameras(source: Source) -> list[Camera]:
    """The cameras of all pictures, which have an X_WC."""
    file = source.cameras
    if file is None:
        raise CameraError(
            f"{source.path}: a model's silhouette needs to know the cameras: {CAMERA_FILE} or "
            "--cameras"
        )
    for name in source.names:
        where = f"{source.camera_file}: camera '{name}'"
        if name in file.links:
            raise CameraError(
                f"{where} rides on a link, but the background beside a body is told from cameras "
                "that stand still"
            )
        if name in file.unplaced:
            raise CameraError(f"{where} needs X_WC: where it stands before the body")
    return [file.cameras[name] for name in source.names]


def _judge(pose: FoundPose, camera: int, names: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """Why a mask is not good, and what is suspicious of it."""
    agreement = pose.agreements[camera]
    if agreement < REFUSED:
        return (
            "pose and colours do not agree: the model's silhouette and what colours tell from the "
            f"background overlap by {agreement:.0%} (IoU); is the start too far off, the object "
            "hidden, or the model another?",
            (),
        )
    warnings, off = [], np.abs(pose.deviations)
    if agreement < _DOUBTED:
        warnings.append(
            f"pose and colours hardly agree: they overlap by {agreement:.0%} (IoU); look at the "
            "overlay"
        )
    worst = int(np.argmax(off))
    if off[worst] > _FAR:
        warnings.append(
            f"joint {names[worst]} is {off[worst]:.1f} standard deviations from its start "
            "(--start-error); look at the overlay"
        )
    return "", tuple(warnings)
