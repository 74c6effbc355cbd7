"""Masks of other tools, one by one."""

from __future__ import annotations

from collections.abc import Sequence

from drake_pose.errors import MaskError, UnknownNameError
from drake_pose.jobs.masks.found import FoundMask, FoundMasks
from drake_pose.jobs.masks.settings import MaskSettings
from drake_pose.jobs.masks.sources import Source, cameras_of_annotations
from drake_pose.silhouette.segmentation.mask_pictures import (
    ALL,
    mask_of_video_picture,
    read_mask_picture,
)


def read_given_masks(source: Source, settings: MaskSettings) -> FoundMasks:
    """Masks in files of annotations, pictures or videos.

    Raises:
        MaskError: names the file; it is no mask, or which class is meant is not said.
    """
    if source.annotated:
        yield from _read_annotated(source, settings)
        return
    for camera, files in source.pictures.items():
        for frame, path in files.items():
            mask = read_mask_picture(path, settings.pixels, settings.classes)
            source.check_size(camera, mask.shape[1], mask.shape[0], str(path))
            yield FoundMask(camera, frame, str(path), mask)
    for camera in source.videos:
        for frame, where, picture in source.read(camera):
            yield FoundMask(camera, frame, where, mask_of_video_picture(picture, where))


def _read_annotated(source: Source, settings: MaskSettings) -> FoundMasks:
    """Masks that files of annotations describe."""
    classes = _select_classes(source, settings.classes)
    for camera, frame, file, k in cameras_of_annotations(source):
        picture = file.pictures[k]
        where = f"{file.path}: picture '{picture.file}'"
        source.check_size(camera, picture.width, picture.height, where)
        try:
            mask = picture.draw(classes)
        except ValueError as error:
            raise MaskError(f"{where}: {error}") from error
        yield FoundMask(camera, frame, where, mask, warnings=() if k else file.warnings)


def _select_classes(source: Source, wanted: Sequence[str]) -> set[str]:
    """The names of the classes that are the object, in all files together."""
    files = [one for _, one in source.annotated]
    known = sorted({name for one in files for name in one.classes})
    if ALL in wanted:
        return set(known)
    if not wanted:
        if len(known) > 1:
            raise MaskError(
                f"{source.path}: has the classes {', '.join(known)}; say which are the object: "
                f"--class '{known[0]}', or --class all"
            )
        return set(known)
    numbers = {number: name for one in files for number, name in one.names.items()}
    found = {name if name in known else numbers.get(name, name) for name in wanted}
    for name in found - set(known):
        raise UnknownNameError("class", name, known, str(source.path))
    return found
