"""Pictures of the empty room, which tell a person from the background."""

from __future__ import annotations

import time
from pathlib import Path

import cv2

from drake_pose.camera.sources.files import load_sources, open_source
from drake_pose.camera.sources.frame_source import (
    FrameSource,
    Picture,
    SourceSpecification,
)
from drake_pose.errors import OutputError, SceneError

# How long it is waited for a camera [s].
_PATIENCE = 30.0
# Between two looks at live cameras [s].
_PAUSE = 0.005


def take_empty_room(folder: Path, count: int, patience: float = _PATIENCE) -> dict[str, Path]:
    """Writes the first pictures of every camera that has a background folder into that folder.

    Args:
        folder: has cameras.yaml and sources.yaml.
        count: how many pictures of each camera.
        patience: how long it is waited for pictures [s].

    Returns:
        By camera, where they are.

    Raises:
        SceneError: a camera gives too few pictures, or none needs a background.
        OutputError: a background folder holds something already, or cannot be written.
    """
    specifications = {
        name: one for name, one in load_sources(folder).items() if one.background is not None
    }
    if not specifications:
        raise SceneError(f"{folder}: all sources deliver masks, so none needs a background")
    places = {name: Path(str(one.background)) for name, one in specifications.items()}
    for name, place in places.items():
        if place.exists() and (not place.is_dir() or any(place.iterdir())):
            raise OutputError(
                f"{place}: the background of camera '{name}' exists already; move it away first"
            )
    pictures = _take(specifications, count, patience)
    for name, place in places.items():
        try:
            place.mkdir(parents=True, exist_ok=True)
            for k, picture in enumerate(pictures[name]):
                _, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
                (place / f"{k:03d}.png").write_bytes(data.tobytes())
        except OSError as error:
            raise OutputError(f"{place}: cannot be written: {error.strerror}") from error
    return places


def _take(
    specifications: dict[str, SourceSpecification], count: int, patience: float
) -> dict[str, list[Picture]]:
    """This many pictures of each camera."""
    pictures: dict[str, list[Picture]] = {name: [] for name in specifications}
    sources: dict[str, FrameSource] = {}
    try:
        for name, one in specifications.items():
            sources[name] = open_source(one)
        end = time.monotonic() + patience
        while any(len(some) < count for some in pictures.values()):
            for name, source in sources.items():
                if len(pictures[name]) < count and (taken := source.read()) is not None:
                    pictures[name].append(taken.picture.astype("uint8"))
            slow = [name for name, some in pictures.items() if len(some) < count]
            if slow and (sources[slow[0]].ended or time.monotonic() > end):
                problems = "; ".join(sources[slow[0]].problems)
                raise SceneError(
                    f"camera '{slow[0]}' gave {len(pictures[slow[0]])} of {count} pictures"
                    f"{': ' if problems else ''}{problems}"
                )
            time.sleep(_PAUSE)
    finally:
        for source in sources.values():
            source.close()
    return pictures
