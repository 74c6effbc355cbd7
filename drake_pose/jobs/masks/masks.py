"""Pictures, videos, or masks of other tools in, a scene out."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from drake_pose.camera.picture_files import Picture
from drake_pose.errors import DrakePoseError, MaskError, OutputError
from drake_pose.files.folder import OVERLAY, write_file, write_summary, writes_folder
from drake_pose.jobs.masks.finding import REFUSED, find_masks
from drake_pose.jobs.masks.settings import MaskSettings
from drake_pose.jobs.masks.sources import UNNAMED, Source, open_source
from drake_pose.silhouette.pictures.masks import encode_mask
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scene_files import common_rate
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE, SCENE_FILE

_PARTIAL = "masks.part"
# Of the mask's outline in an overlay, (blue, green, red): Okabe and Ito's vermilion.
_OUTLINE_BGR = (0, 94, 213)
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


@writes_folder
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
    opened = open_source(Path(source), settings.cameras)
    cameras: dict[str, dict[str, Any]] = {}
    doubts: list[str] = []
    refused: list[str] = []
    try:
        for done, found in enumerate(find_masks(opened, settings), 1):
            mask = largest_patch(found.mask) if settings.largest else found.mask
            refusal = found.refusal or refuse_mask(mask)
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
        summary = _summarize(opened, settings, cameras, refused, doubts, folder)
        _write_scene(opened, folder, summary)
    except DrakePoseError:
        for name in (_PARTIAL, OVERLAY):
            shutil.rmtree(folder / name, ignore_errors=True)
        raise
    return SceneMasks(folder, summary)


def _summarize(
    source: Source,
    settings: MaskSettings,
    cameras: Mapping[str, Mapping[str, Any]],
    refused: Sequence[str],
    doubts: Sequence[str],
    folder: Path,
) -> dict[str, Any]:
    """What summary.json says; MaskError: no picture has a good mask."""
    count = sum(map(len, cameras.values())) - len(refused)
    if not count:
        first, *more = refused or [f"{source.path}: has no picture"]
        raise MaskError(first + (f" (and {len(more)} more)" if more else ""))
    warnings = [*(f"{text}; no mask is written" for text in refused), *doubts]
    warnings += common_rate(source.videos)[1]
    if settings.model is None:
        warnings += [text for name, own in cameras.items() for text in _doubt_camera(name, own)]
    if source.cameras is None and set(cameras) != {UNNAMED}:
        warnings.append(
            f"{folder}: its cameras {', '.join(cameras)} have no {CAMERA_FILE}, which estimate "
            "needs (--cameras)"
        )
    return {
        "source": str(source.path),
        "settings": settings.as_json(),
        "mask_count": count,
        "cameras": cameras,
        "warnings": warnings,
    }


def _doubt_camera(name: str, frames: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """A warning of the masks that a camera's pictures do not tell."""
    known = {frame: one["agreement"] for frame, one in frames.items() if "agreement" in one}
    bad = [frame for frame, agreement in known.items() if agreement < REFUSED]
    if bad:
        usual = float(np.median([known[frame] for frame in bad]))
        yield (
            f"camera '{name or 'camera'}', frame {frame_ranges(bad, list(frames))} ({len(bad)} of "
            f"{len(frames)}): masks and pictures hardly agree: by a box or threshold that is a "
            f"little other, the masks are others (IoU {usual:.0%}); look at the overlays"
        )


def _write_scene(source: Source, folder: Path, summary: Mapping[str, Any]) -> None:
    """Writes what else belongs to the scene; its masks come last."""
    own = source.path / SCENE_FILE
    try:
        if source.path.is_dir() and own.is_file():
            shutil.copyfile(own, folder / SCENE_FILE)
        elif source.videos:
            rate, _ = common_rate(source.videos)
            content = {"sequence": True} | ({} if rate is None else {"frame_rate_hz": rate})
            write_file(folder, SCENE_FILE, yaml.safe_dump(content))
        if source.camera_file is not None:
            shutil.copyfile(source.camera_file, folder / CAMERA_FILE)
        write_summary(folder, summary)
        (folder / _PARTIAL).rename(folder / "masks")
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written: {error.strerror}") from error


def _draw_outline(picture: Picture, mask: np.ndarray, refused: bool) -> bytes:
    """A JPEG file of a picture (H, W, 3) with the mask's outline; one that is refused is dark."""
    drawn = np.array(picture[:, :, ::-1] // (3 if refused else 1))
    contours, _ = cv2.findContours(mask.view(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, contours, -1, _OUTLINE_BGR, 1)
    return cv2.imencode(".jpg", drawn)[1].tobytes()


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
