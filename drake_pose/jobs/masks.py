"""Masks for a scene: read from other tools, or segmented by a background."""

import math
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml

from drake_pose.arrays import Mask, Picture
from drake_pose.camera.picture_files import SUFFIXES, find_pictures, natural_key, read_picture
from drake_pose.errors import (
    DrakePoseError,
    MaskError,
    OutputError,
    SceneError,
    SettingsError,
    require_known,
)
from drake_pose.files.folder import OVERLAY, write_file, write_summary, writes_folder
from drake_pose.files.settings import MaskSettings
from drake_pose.jobs.mask_sources import Source, open_source
from drake_pose.silhouette.pictures.masks import encode_mask, intersection_over_union
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE, SCENE_FILE
from drake_pose.silhouette.segmentation import (
    Background,
    background_of_recording,
    learn_background,
    person_region,
)

MIN_AGREEMENT = 0.85
"""Minimum IoU of masks by two thresholds, below which they are doubtful."""
_PARTIAL = "masks.part"


class FoundMask(NamedTuple):
    """The mask of one picture."""

    camera: str  # The camera's name.
    frame: str  # The frame's name.
    where: str  # Origin of the picture, for messages.
    mask: Mask  # (H, W) bool.
    picture: Picture | None = None  # (H, W, 3) RGB; None if only the mask is given.
    warnings: tuple[str, ...] = ()  # Messages for the user.
    # Lowest IoU with masks by other thresholds; nan if not known.
    agreement: float = math.nan


@dataclass(frozen=True)
class SceneMasks:
    """A written scene of masks."""

    folder: Path  # The scene's folder.
    # Content of its summary.json: for each camera and frame the mask's area [pixel] or why it was
    # rejected, and warnings.
    summary: Mapping[str, Any]

    @property
    def warnings(self) -> tuple[str, ...]:
        """All warnings; each names its picture or camera."""
        return tuple(self.summary["warnings"])


@writes_folder
def make_masks(
    source: str | Path,
    out: str | Path,
    settings: MaskSettings | None = None,
    *,
    overlay: bool = True,
    on_mask: Callable[[int], None] = lambda _: None,
) -> SceneMasks:
    """Write a scene of masks, read from another tool or segmented in pictures.

    The scene has ``masks/<camera>/<frame>.png`` (``masks/<frame>.png`` for a camera without a
    name), the source's ``cameras.yaml`` and ``scene.yaml`` if they exist, and
    ``overlay/<camera>/<frame>.jpg``, the pictures with the masks' contours. An empty or full mask
    is not written and causes a warning. Until all masks are written they are in ``masks.part``.

    Args:
        source: as in `open_source`.
        out: folder for the scene; it must be new or empty.
        settings: the segmentation; None: defaults.
        overlay: whether overlays are written.
        on_mask: called after each picture with the number of finished ones.

    Returns:
        The scene's folder and summary.

    Raises:
        DrakePoseError: the message names the file, camera or frame at fault; or no mask is usable.
    """
    settings, folder = settings or MaskSettings(), Path(out)
    opened = open_source(Path(source), settings.cameras, settings.episode)
    cameras: dict[str, dict[str, Any]] = {}
    doubts: list[str] = []
    refused: list[str] = []
    try:
        for done, found in enumerate(find_masks(opened, settings), 1):
            mask = largest_patch(found.mask) if settings.largest else found.mask
            refusal = refuse_mask(mask)
            warnings = [*found.warnings, *([] if refusal else doubt_mask(mask))]
            entry: dict[str, Any] = {"refusal": refusal} if refusal else {"area": int(mask.sum())}
            entry |= {"warnings": warnings} if warnings else {}
            entry |= {} if math.isnan(found.agreement) else {"agreement": found.agreement}
            cameras.setdefault(found.camera, {})[found.frame] = entry
            doubts += [f"{found.where}: {text}" for text in warnings]
            place = f"{found.camera}/{found.frame}".lstrip("/")
            if refusal:
                refused.append(f"{found.where}: {refusal}")
            else:
                write_file(folder, f"{_PARTIAL}/{place}.png", encode_mask(mask))
            if overlay and found.picture is not None:
                drawn = _draw_outline(found.picture, mask, bool(refusal))
                write_file(folder, f"{OVERLAY}/{place}.jpg", drawn)
            on_mask(done)
        count = sum(map(len, cameras.values())) - len(refused)
        if not count:
            first, *more = refused or [f"{opened.path}: has no picture"]
            raise MaskError(first + (f" (and {len(more)} more)" if more else ""))
        warnings = [*(f"{text}; no mask is written" for text in refused), *doubts]
        warnings += opened.warnings
        warnings += [text for name, own in cameras.items() for text in _doubt_camera(name, own)]
        if opened.cameras is None and set(cameras) != {""}:
            warnings.append(
                f"{folder}: there is no {CAMERA_FILE} for the cameras {', '.join(cameras)}, which "
                "estimate needs; add it, or give --cameras"
            )
        summary = {
            "source": str(opened.path),
            "settings": settings.as_json(),
            "mask_count": count,
            "cameras": cameras,
            "warnings": warnings,
        }
        _write_scene(opened, folder, summary)
    except DrakePoseError:
        for name in (_PARTIAL, OVERLAY):
            shutil.rmtree(folder / name, ignore_errors=True)
        raise
    return SceneMasks(folder, summary)


def _doubt_camera(name: str, frames: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Yield warnings if a camera's masks, or the order of its frames, are doubtful.

    ``frames``: its entries of the summary.
    """
    texts = {tuple(text for text, _ in natural_key(frame)) for frame in frames}
    hashes = [frame for frame in frames if len(re.findall(r"\d(?=[A-Za-z])", frame)) > 1]
    found = [text for frame in hashes for text in re.findall("[0-9a-f]{8,}", frame)]
    hexadecimal = {text for text in found if not text.isdigit()}
    if hashes and (len(texts) > 1 or len(hexadecimal) > 1):
        yield (
            f"camera '{name or 'camera'}': the frames' names have parts like random ones, such as "
            f"'{hashes[0]}': their order is hardly that of the pictures, and joint tables need the "
            "same names; name the pictures 0000.png, 0001.png and so on before annotating them"
        )
    known = {frame: one["agreement"] for frame, one in frames.items() if "agreement" in one}
    bad = [frame for frame, agreement in known.items() if agreement < MIN_AGREEMENT]
    if bad:
        usual = float(np.median([known[frame] for frame in bad]))
        yield (
            f"camera '{name or 'camera'}', frame {frame_ranges(bad, list(frames))} ({len(bad)} of "
            f"{len(frames)}): the masks are doubtful: a slightly different threshold gives other "
            f"masks (IoU {usual:.0%}); check the overlays"
        )


def _write_scene(source: Source, folder: Path, summary: Mapping[str, Any]) -> None:
    """Write scene.yaml and cameras.yaml (if known) and summary.json; rename masks.part to masks."""
    own = source.path / SCENE_FILE
    try:
        if source.path.is_dir() and own.is_file():
            shutil.copyfile(own, folder / SCENE_FILE)
        elif source.streams:
            content: dict[str, Any] = {"sequence": True}
            if source.rate_hz is not None:
                content["frame_rate_hz"] = round(source.rate_hz, 6)
            write_file(folder, SCENE_FILE, yaml.safe_dump(content))
        if source.camera_file is not None:
            shutil.copyfile(source.camera_file, folder / CAMERA_FILE)
        write_summary(folder, summary)
        (folder / _PARTIAL).rename(folder / "masks")
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error


def _draw_outline(picture: Picture, mask: Mask, refused: bool) -> bytes:
    """Return the JPEG file of a picture (H, W, 3) with a mask's contour, dark if ``refused``."""
    drawn = np.array(picture[:, :, ::-1] // (3 if refused else 1))
    contours, _ = cv2.findContours(mask.view(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    vermilion_bgr = (0, 94, 213)
    cv2.drawContours(drawn, contours, -1, vermilion_bgr, 1)
    return cv2.imencode(".jpg", drawn)[1].tobytes()


def refuse_mask(mask: Mask, max_fraction: float = 0.98) -> str:
    """Return why a mask (H, W) is rejected: it is empty, or over ``max_fraction`` full; or ""."""
    if not mask.any():
        return "the object is not found: the mask is empty"
    if mask.mean() >= max_fraction:
        return (
            "the mask fills the picture: object and background are not separated, or the light or "
            "the camera has changed"
        )
    return ""


def doubt_mask(mask: Mask, max_border: float = 0.6, second_patch: float = 0.25) -> list[str]:
    """Return warnings that a mask (H, W), not empty, may show something else than the object.

    ``mask``: the mask. ``max_border``: maximum fraction of the picture's border that an object
    covers. ``second_patch``: minimum area of a second object, as a fraction of the largest region's
    area.
    """
    warnings = []
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean()
    if border > max_border:
        warnings.append(
            f"the mask covers {border:.0%} of the picture's border; check that it shows the "
            "object, and that neither the light nor the camera has changed"
        )
    _, _, statistics, middles = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    areas = statistics[1:, cv2.CC_STAT_AREA]
    first, second = [*np.argsort(-areas, kind="stable"), 0][:2]
    if len(areas) > 1 and areas[second] > second_patch * areas[first]:
        (x0, y0), (x1, y1) = np.rint(middles[[1 + first, 1 + second]]).astype(int)
        warnings.append(
            f"the mask has two regions, of {areas[first]} pixels around ({x0}, {y0}) and of "
            f"{areas[second]} around ({x1}, {y1}); if they are two objects, --largest keeps the "
            "larger one"
        )
    return warnings


def largest_patch(mask: Mask) -> Mask:
    """Return the largest connected region of a mask (H, W)."""
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    if count <= 2:
        return mask
    return np.asarray(labels == 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA])))


def find_masks(
    source: Source, settings: MaskSettings, thresholds: Sequence[float] = (0.7, 1.4)
) -> Iterator[FoundMask]:
    """Yield the masks of a source by camera and frame, read or segmented as the settings say.

    A segmented mask is the region that differs from the camera's background.

    ``source``: the source of the pictures or masks. ``settings``: the segmentation. ``thresholds``:
    factors of the background's noise for masks to compare with.

    Raises DrakePoseError: the message names the file, camera or frame at fault.
    """
    background = settings.background
    if background is None and not settings.classes and not source.annotated:
        # Without a segmentation method, a folder of background pictures implies one.
        beside = source.path / "background"
        background = beside if beside.is_dir() else None
    if background is None:
        yield from _read_given(source, settings)
        return
    if source.annotated:
        raise SceneError(f"{source.path}: has annotations; segmentation needs pictures")
    # All backgrounds are read before the first mask is written.
    rooms = {name: _background(source, name, background) for name in source.names}
    for camera, (room, doubts) in rooms.items():
        backgrounds = [room.with_noise(k) for k in (1.0, *thresholds)]
        for frame, where, picture in source.read(camera):
            if picture.shape != room.mean.shape:
                height, width = room.mean.shape[:2]
                raise SceneError(
                    f"{where}: differs in size from the background, {width} x {height} "
                    "(width x height)"
                )
            mask, *again = (person_region(picture, one) for one in backgrounds)
            agreement = min(intersection_over_union(mask, one) for one in again)
            yield FoundMask(camera, frame, where, mask, picture, doubts, agreement)
            # The background's warnings are given once.
            doubts = ()


def _read_given(source: Source, settings: MaskSettings) -> Iterator[FoundMask]:
    """Yield the masks of other tools in COCO files (``settings.classes``), pictures or videos."""
    areas = [area for _, picture in source.annotated for area in picture.areas]
    known = sorted({name for name, _, area in areas if area})
    numbers = {number: name for name, number, area in areas if area}
    if not settings.classes and len(known) > 1:
        raise MaskError(
            f"{source.path}: has the classes {', '.join(known)}; choose those of the object: "
            f"--class '{known[0]}', or --class all"
        )
    classes = {name if name in known else numbers.get(name, name) for name in settings.classes}
    if not classes or "all" in classes:
        classes = set(known)
    require_known("class", classes, known, str(source.path))
    pictures = source.annotated_pictures()
    found = ((name, frame, one) for name, own in pictures.items() for frame, one in own.items())
    for camera, frame, entry in found:
        where = f"{entry.source}: picture '{entry.name}'"
        source.check_size(camera, (entry.height, entry.width), where)
        try:
            mask = entry.draw(classes)
        except (KeyError, TypeError, ValueError) as error:
            raise MaskError(f"{where}: a segmentation cannot be drawn: {error}") from error
        boxes = sum(not area for *_, area in entry.areas)
        left_out = f"{boxes} annotations have a box, but no area: left out"
        yield FoundMask(camera, frame, where, mask, warnings=(left_out,) if boxes else ())
    for camera in source.names:
        for frame, where, mask in source.read(camera, as_masks=True):
            yield FoundMask(camera, frame, where, mask)


def _background(
    source: Source, camera: str, given: Path | str, max_count: int = 60
) -> tuple[Background, tuple[str, ...]]:
    """Return a camera's background model, and warnings; raise a SceneError if there is no picture.

    ``given``: as ``MaskSettings.background``. ``max_count``: a median uses between this number and
    twice as many pictures of a long recording.
    """
    if given == "median":
        # Pictures evenly spread over a recording of unknown length.
        kept, step = list[Picture](), 1
        for k, (_, where, picture) in enumerate(source.read(camera)):
            if kept and picture.shape != kept[0].shape:
                raise SceneError(f"{where}: differs in size from the pictures before")
            if k % step == 0:
                kept.append(picture)
                if len(kept) == 2 * max_count:
                    kept, step = kept[::2], 2 * step
        try:
            room = background_of_recording(kept)
        except SettingsError as error:
            raise SettingsError(f"camera '{camera}': {error}") from error
        return room, _doubt_median(room, kept)
    folder = Path(given)
    if (folder / camera).is_dir():
        files = list(find_pictures(folder / camera, camera).values())
    else:
        single = (folder, *(folder / f"{camera}{suffix}" for suffix in SUFFIXES))
        files = [file for file in single if file.is_file()][:1]
    if not files:
        raise SceneError(
            f"{folder}: has no background picture of camera '{camera}'; add {camera}.png or a "
            f"folder {camera}, or give --background median"
        )
    pictures = []
    for file in files:
        pictures.append(read_picture(file))
        source.check_size(camera, pictures[-1].shape, str(file))
    return learn_background(pictures), ()


def _doubt_median(
    room: Background, recording: Sequence[Picture], radius: float = 0.3, stays: float = 0.6
) -> tuple[str, ...]:
    """Return a warning if the body stays around one place, so that the median may show it.

    ``room``: the background from the median. ``recording``: pictures (H, W, 3) spread over the
    recording. ``radius``: radius within which the body stays, as a fraction of the square root of
    its area. ``stays``: fraction of the pictures from which the body stays near one point
    (simulated arms: 0.8 and more; a person walking by: 0.3).
    """
    masks = [person_region(picture, room) for picture in recording]
    bodies = [mask.astype(np.uint8) for mask in masks if mask.any()]
    size = math.sqrt(float(np.median([mask.sum() for mask in bodies] or [0])))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(radius * size) + 1,) * 2)
    about = sum((cv2.dilate(mask, disc).astype(np.float32) for mask in bodies), np.zeros((1, 1)))
    if about.max() <= stays * len(masks):
        return ()
    y, x = np.unravel_index(int(np.argmax(about)), about.shape)
    return (
        f"the body stays around one place of this camera's pictures, ({x}, {y}): parts that do not "
        "move, such as an arm's base, count as background and are missing in the masks; give "
        "pictures of the empty room, or a recording in which the body leaves every place",
    )
