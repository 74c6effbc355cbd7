"""The ways to find masks: other tools', by a box, a network, the empty room, the model."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from drake_pose.body.model import load_model
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera
from drake_pose.camera.picture_files import SUFFIXES, Picture, read_picture
from drake_pose.camera.sources.recorded import find_picture_files
from drake_pose.errors import (
    CameraError,
    MaskError,
    SceneError,
    SettingsError,
    UnknownNameError,
)
from drake_pose.jobs.estimate.searches import make_tree
from drake_pose.jobs.masks.settings import MEDIAN, MaskSettings
from drake_pose.jobs.masks.sources import CAMERAS, FoundMask, Source
from drake_pose.jobs.registration.positions import read_known_positions
from drake_pose.results.settings import EstimateSettings
from drake_pose.search.segmentation.pose_and_mask import (
    FoundPose,
    PoseAndMask,
    PoseAndMaskSettings,
)
from drake_pose.silhouette.pictures.scene_files import natural_key
from drake_pose.silhouette.segmentation.background import (
    Background,
    background_of_recording,
    background_support,
    learn_background,
    person_region,
)
from drake_pose.silhouette.segmentation.grab_cut import cut_box
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
# Pose and colours that overlap less do not agree, or hardly.
_REFUSED, _DOUBTED = 0.85, 0.9
# A value so many standard deviations from its start is suspicious.
_FAR = 3.0


def read_given_masks(source: Source, settings: MaskSettings) -> Iterator[FoundMask]:
    """Masks of other tools in COCO files, pictures or videos.

    Raises:
        MaskError: names the file; it is no mask, or which class is meant is not said.
        UnknownNameError: there is no such class.
    """
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


def cut_boxes(source: Source, box: Sequence[float]) -> Iterator[FoundMask]:
    """What GrabCut finds in a box, x, y, width and height [pixel], in all pictures.

    Raises:
        SettingsError: the box tells no object from its surroundings.
    """
    for camera in source.names:
        for frame, where, picture in source.read(camera):
            try:
                mask = cut_box(picture, box)
            except SettingsError as error:
                raise SettingsError(f"{where}: {error}") from error
            part = mask.sum() / (box[2] * box[3])
            warnings: tuple[str, ...] = ()
            if part > _ALL_OF_BOX or 0.0 < part < _NONE_OF_BOX:
                warnings = (f"the mask is {part:.1%} of its box: find it another way",)
            yield FoundMask(camera, frame, where, mask, picture, "", warnings)


def segment_by_network(source: Source, file: Path, settings: MaskSettings) -> Iterator[FoundMask]:
    """The masks that a network finds in all pictures.

    Raises:
        SettingsError: the network cannot be read, or does not take the pictures.
    """
    taken = (settings.network_size, settings.network_mean, settings.network_std)
    network = SegmentationNetwork(file, settings.classes, *taken, settings.network_bgr)
    for camera in source.names:
        for frame, where, picture in source.read(camera):
            try:
                mask = network.find(picture)
            except SettingsError as error:
                raise SettingsError(f"{where}: {error}") from error
            yield FoundMask(camera, frame, where, mask, picture)


def compare_with_empty_room(source: Source, background: Path | str) -> Iterator[FoundMask]:
    """Masks of what differs from the background, as of ``MaskSettings.background``.

    Raises:
        SceneError: a camera has no background, or one of another size.
        SettingsError: a recording too short for a median.
    """
    rooms = {name: _background(source, name, background) for name in source.names}
    for name, (room, doubt) in rooms.items():
        warnings: tuple[str, ...] = (doubt,) if doubt else ()
        for frame, where, picture in source.read(name):
            if picture.shape != room.mean.shape:
                height, width = room.mean.shape[:2]
                raise SceneError(
                    f"{where}: is not of the background's size, {width} x {height} (width x height)"
                )
            mask = person_region(picture, room)
            if mask.mean() > _CHANGED:
                warnings += (
                    f"{mask.mean():.0%} of it differ from the background: did the light change, or "
                    "the camera move?",
                )
            yield FoundMask(name, frame, where, mask, picture, "", warnings)
            warnings = ()


def _background(source: Source, camera: str, given: Path | str) -> tuple[Background, str]:
    """A camera's background, and why it is not good; "" where it is."""
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
    return learn_background(pictures), ""


def _background_files(given: Path, camera: str) -> list[Path]:
    """The pictures of the empty room before a camera."""
    if given.is_file():
        return [given]
    if (given / camera).is_dir():
        return list(find_picture_files(given / camera, camera).values())
    for suffix in SUFFIXES:
        if (given / f"{camera}{suffix}").is_file():
            return [given / f"{camera}{suffix}"]
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


def _doubt(room: Background, recording: Sequence[Picture]) -> str:
    """Why a recording's median is no good background; "" where it is one."""
    support = background_support(recording, room)
    masks = [person_region(picture, room) for picture in recording]
    doubtful = [float((support[mask] < _SUPPORT).mean()) for mask in masks if mask.any()]
    part = float(np.median(doubtful)) if doubtful else 0.0
    if part <= _DOUBTFUL:
        return ""
    return (
        f"the median of {len(recording)} pictures is no good background, here and in this camera's "
        f"other pictures: in {part:.0%} of the masks' area it is seen in fewer than three of four "
        "pictures, so the body may stand in it; give pictures of the empty room, or a longer "
        "recording in which the body leaves every place"
    )


def find_by_model(source: Source, model: Path, settings: MaskSettings) -> Iterator[FoundMask]:
    """The masks of a body whose pose is about known in each frame (``settings.start``).

    Raises:
        CameraError: a camera has no X_WC.
        SceneError: a frame has no row in the table of joint positions.
    """
    cameras = _placed_cameras(source)
    body = load_model(model, package_paths=settings.packages)
    kinematics = TreeKinematics(make_tree(body, EstimateSettings(hold=settings.hold)))
    if settings.start is None:
        raise SceneError(f"{model}: needs rough joint positions of each frame (--start FILE.csv)")
    table = read_known_positions(settings.start, kinematics)
    seen = {
        name: {frame: (where, picture) for frame, where, picture in source.read(name)}
        for name in source.names
    }
    frames = sorted({frame for own in seen.values() for frame in own}, key=natural_key)
    starts = [
        table.of(frame, next(name for name in seen if frame in seen[name])) for frame in frames
    ]
    pictures = [
        [own[frame][1] if frame in own else None for own in seen.values()] for frame in frames
    ]
    search = PoseAndMask(
        kinematics, cameras, PoseAndMaskSettings(angle=math.radians(settings.start_error))
    )
    found = search.run(pictures, starts)
    warned = table.warnings
    for c, (name, own) in enumerate(seen.items()):
        for frame, pose in zip(frames, found, strict=True):
            mask = pose.masks[c]
            if mask is not None:
                where, picture = own[frame]
                refusal, warnings = _judge(pose, c, kinematics.names)
                yield FoundMask(name, frame, where, mask, picture, refusal, (*warned, *warnings))
                warned = ()


def _placed_cameras(source: Source) -> list[Camera]:
    """The cameras of all pictures, which have an X_WC."""
    if source.cameras is None:
        raise CameraError(
            f"{source.path}: a model's silhouette needs to know the cameras: {CAMERAS} or --cameras"
        )
    for name in source.names:
        if name in source.cameras.links:
            raise CameraError(
                f"{source.camera_file}: camera '{name}' rides on a link, but the background "
                "beside a body is told from cameras that stand still"
            )
        if name in source.cameras.unplaced:
            raise CameraError(
                f"{source.camera_file}: camera '{name}' needs X_WC: where it stands before the body"
            )
    return [source.cameras.cameras[name] for name in source.names]


def _judge(pose: FoundPose, camera: int, names: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """Why a mask is not good, and what is suspicious of it."""
    agreement = pose.agreements[camera]
    if agreement < _REFUSED:
        return (
            "pose and colours do not agree: the model's silhouette and what colours tell from the "
            f"background overlap by {agreement:.0%} (IoU); is the start too far off, the object "
            "hidden, or the model another?",
            (),
        )
    warnings = []
    if agreement < _DOUBTED:
        warnings.append(
            f"pose and colours hardly agree: they overlap by {agreement:.0%} (IoU); look at the "
            "overlay"
        )
    worst = int(np.argmax(np.abs(pose.deviations)))
    if abs(pose.deviations[worst]) > _FAR:
        warnings.append(
            f"joint {names[worst]} is {abs(pose.deviations[worst]):.1f} standard deviations from "
            "its start (--start-error); look at the overlay"
        )
    return "", tuple(warnings)
