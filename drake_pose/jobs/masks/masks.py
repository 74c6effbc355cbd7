"""Pictures, videos, or masks of other tools in, a scene out."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from drake_pose.camera.picture_files import Picture
from drake_pose.errors import DrakePoseError, MaskError, OutputError, SceneError
from drake_pose.jobs.masks.finding import (
    compare_with_empty_room,
    cut_boxes,
    find_by_model,
    read_given_masks,
    segment_by_network,
)
from drake_pose.jobs.masks.settings import MaskSettings
from drake_pose.jobs.masks.sources import CAMERAS, SCENE, UNNAMED, FoundMask, Source, open_source
from drake_pose.results.folder import OVERLAY, SUMMARY, require_empty
from drake_pose.silhouette.pictures.masks import write_mask

BACKGROUND, MASKS = "background", "masks"
_PARTIAL = "masks.part"
# Of the mask's outline in an overlay, (red, green, blue): Okabe and Ito's vermilion.
_OUTLINE_RGB = (213, 94, 0)
# A second patch of this fraction of the largest one's area may be another object.
_SECOND = 0.25
# Beyond this fraction of the picture no surroundings are seen.
_FULL = 0.98
# Of the picture's border; an object that is cut off covers less of it, the background more.
_BORDER = 0.6


@dataclass(frozen=True)
class SceneMasks:
    """What was written: the scene's folder, and what its ``summary.json`` holds.

    By camera and frame that is each mask's area [pixel], or why there is none, and its warnings.
    """

    folder: Path
    summary: Mapping[str, Any]

    @property
    def count(self) -> int:
        """How many masks the scene has."""
        return int(self.summary["mask_count"])

    @property
    def warnings(self) -> tuple[str, ...]:
        """All warnings, each with the picture's name."""
        return tuple(self.summary["warnings"])


def make_masks(
    source: str | Path,
    out: str | Path,
    settings: MaskSettings | None = None,
    *,
    overlay: bool = True,
    on_mask: Callable[[int], None] = lambda _: None,
) -> SceneMasks:
    """Writes a scene whose masks are those of another tool, or are found in pictures.

    The scene has ``masks/<camera>/<frame>.png``, or ``masks/<frame>.png`` of a single camera that
    nothing names; the source's ``cameras.yaml`` and ``scene.yaml``, where it has them; and
    ``overlay/<camera>/<frame>.jpg``, the pictures with the masks' outlines. A picture whose mask is
    empty or full gets none, and a warning. Until all are there, masks lie in ``masks.part``.

    Args:
        source: see ``open_source``.
        out: the scene's folder; new or empty.
        on_mask: called after each picture with the number of those done.

    Raises:
        DrakePoseError: names the file, camera or frame at fault; no picture has a good mask.
    """
    settings, folder = settings or MaskSettings(), Path(out)
    require_empty(folder)
    opened = open_source(Path(source), settings.cameras)
    writer = _Writer(folder, opened, settings, overlay)
    try:
        for k, found in enumerate(_find(opened, settings), 1):
            writer.add(found)
            on_mask(k)
        return writer.finish()
    except DrakePoseError:
        writer.discard()
        raise


def _find(source: Source, settings: MaskSettings) -> Iterator[FoundMask]:
    """The masks, one by one."""
    background = settings.background
    if settings == MaskSettings(largest=settings.largest, cameras=settings.cameras):
        # Beside its pictures a scene may have those of the empty room, which say what is meant.
        room = source.path / BACKGROUND
        background = room if room.is_dir() else None
    ways = (background, settings.box, settings.model, settings.network)
    if source.annotated and any(way is not None for way in ways):
        raise SceneError(
            f"{source.path}: has annotations, but the object is to be found in pictures"
        )
    if background is not None:
        return compare_with_empty_room(source, background)
    if settings.box is not None:
        return cut_boxes(source, settings.box)
    if settings.model is not None:
        return find_by_model(source, settings.model, settings)
    if settings.network is not None:
        return segment_by_network(source, settings.network, settings)
    return read_given_masks(source, settings)


class _Writer:
    """Writes masks, then the scene around them."""

    def __init__(self, folder: Path, source: Source, settings: MaskSettings, overlay: bool) -> None:
        self._folder, self._source, self._settings = folder, source, settings
        self._overlay = overlay
        self._summary: dict[str, dict[str, Any]] = {}
        self._warnings: list[str] = []
        self._refused: list[str] = []
        self._count = 0

    def add(self, found: FoundMask) -> None:
        """Judges a mask, and writes it where it is good."""
        if self._settings.largest:
            found = replace(found, mask=largest_patch(found.mask))
        refusal = found.refusal or refuse_mask(found.mask)
        warnings = (*found.warnings, *(() if refusal else doubt_mask(found.mask)))
        entry: dict[str, Any] = {"refusal": refusal} if refusal else {"area": int(found.mask.sum())}
        entry |= {"warnings": list(warnings)} if warnings else {}
        self._summary.setdefault(found.camera, {})[found.frame] = entry
        self._warnings += [f"{found.where}: {text}" for text in warnings]
        if refusal:
            self._refused.append(f"{found.where}: {refusal}")
        else:
            self._write(self._place(_PARTIAL, found, ".png"), found.mask)
            self._count += 1
        if self._overlay and found.picture is not None:
            data = _draw_outline(found.picture, found.mask, bool(refusal))
            self._write(self._place(OVERLAY, found, ".jpg"), data)

    def finish(self) -> SceneMasks:
        """Writes what else belongs to the scene; MaskError: no picture has a good mask."""
        if not self._count:
            more = len(self._refused) - 1
            first = self._refused[0] if self._refused else f"{self._source.path}: has no picture"
            raise MaskError(first + (f" (and {more} more)" if more > 0 else ""))
        warnings = [f"{text}; no mask is written" for text in self._refused] + self._warnings
        if self._source.cameras is None and set(self._summary) != {UNNAMED}:
            warnings.append(
                f"{self._folder}: its cameras {', '.join(self._summary)} have no {CAMERAS}, which "
                "estimate needs (--cameras)"
            )
        summary = {
            "source": str(self._source.path),
            "settings": self._settings.as_json(),
            "mask_count": self._count,
            "cameras": self._summary,
            "warnings": warnings,
        }
        try:
            self._write_scene_file()
            if self._source.camera_file is not None:
                shutil.copyfile(self._source.camera_file, self._folder / CAMERAS)
            text = json.dumps(summary, indent=2, ensure_ascii=False)
            (self._folder / SUMMARY).write_text(text + "\n", encoding="utf-8")
            (self._folder / _PARTIAL).rename(self._folder / MASKS)
        except OSError as error:
            raise OutputError(f"{self._folder}: cannot be written: {error.strerror}") from error
        return SceneMasks(self._folder, summary)

    def _write_scene_file(self) -> None:
        """The source's own, or what a video says."""
        own = self._source.path / SCENE
        if self._source.path.is_dir() and own.is_file():
            shutil.copyfile(own, self._folder / SCENE)
        elif self._source.videos:
            rate = self._source.frame_rate_hz()
            content = {"sequence": True} | ({} if rate is None else {"frame_rate_hz": rate})
            (self._folder / SCENE).write_text(yaml.safe_dump(content), encoding="utf-8")

    def discard(self) -> None:
        """Removes what was written; the folder was new or empty."""
        for name in (_PARTIAL, OVERLAY):
            shutil.rmtree(self._folder / name, ignore_errors=True)

    def _place(self, folder: str, found: FoundMask, suffix: str) -> Path:
        """Where a mask or an overlay belongs."""
        return self._folder / folder / found.camera / f"{found.frame}{suffix}"

    def _write(self, path: Path, content: np.ndarray) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if content.dtype == np.bool_:
                write_mask(path, content)
            else:
                path.write_bytes(content.tobytes())
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def _draw_outline(picture: Picture, mask: np.ndarray, refused: bool) -> np.ndarray:
    """A JPEG file of a picture (H, W, 3) with the mask's outline; one that is refused is dark."""
    drawn = np.array(picture[:, :, ::-1] // (3 if refused else 1))
    contours, _ = cv2.findContours(mask.view(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, contours, -1, _OUTLINE_RGB[::-1], 1)
    return np.asarray(cv2.imencode(".jpg", drawn)[1])


def refuse_mask(mask: np.ndarray) -> str:
    """Why a mask (H, W) cannot be used: it is empty or full; "" where it can."""
    if not mask.any():
        return "the object is not found: the mask is empty"
    if mask.mean() >= _FULL:
        return "the mask fills the picture: nothing tells the object from the rest"
    return ""


def doubt_mask(mask: np.ndarray) -> list[str]:
    """Why a mask (H, W) that is not empty may show something else."""
    warnings = []
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean()
    if border > _BORDER:
        warnings.append(
            f"the mask covers {border:.0%} of the picture's border: is it the background?"
        )
    _, _, statistics, middles = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    areas = statistics[1:, cv2.CC_STAT_AREA]
    first, second = [*np.argsort(-areas, kind="stable"), 0][:2]
    if len(areas) > 1 and areas[second] > _SECOND * areas[first]:
        (x0, y0), (x1, y1) = np.rint(middles[[1 + first, 1 + second]]).astype(int)
        warnings.append(
            f"there are two patches, of {areas[first]} pixels about ({x0}, {y0}) and of "
            f"{areas[second]} about ({x1}, {y1}): two objects? --largest keeps the larger one"
        )
    return warnings


def largest_patch(mask: np.ndarray) -> np.ndarray:
    """The largest connected patch of a mask (H, W); what is empty stays so."""
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8))
    if count <= 2:
        return mask
    return np.asarray(labels == 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA])))
